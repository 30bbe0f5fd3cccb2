"""Sensor noise of many simulations at once: the numbers of ``np.random.default_rng((seed, step)).standard_normal``, bit for bit.

NumPy makes a generator in 40 µs under Python's lock, which for 128 simulations is a quarter of a control step on 16 cores. Here
``SeedSequence``, PCG64 and the ziggurat method for float32 are compiled loops without that lock, so blocks of simulations run
in parallel. The ziggurat's tables are those of Numba, which has them from NumPy.

Letters in shapes: N simulations.
"""

import math
from typing import NamedTuple

import numba
import numpy as np
from numba.np.random._constants import (
    fi_float,
    ki_float,
    wi_float,
    ziggurat_nor_inv_r_f,
    ziggurat_nor_r_f,
)

_TAIL, _TAIL_INVERSE = np.float32(ziggurat_nor_r_f), np.float32(ziggurat_nor_inv_r_f)
_MULTIPLIER = (
    np.uint64(0x2360ED051FC65DA4),
    np.uint64(0x4385DF649FCCF645),
)  # of PCG64: high and low half
_HALF, _LOW = np.uint64(32), np.uint64(0xFFFFFFFF)


class ScanNoise(NamedTuple):
    """Standard normal random numbers for N simulations. Row i equals the first draws of ``np.random.default_rng((seeds[i],
    steps[i]))``."""

    seeds: np.ndarray
    """(N,) seeds of the scenes, 0 … 2⁶³ − 1."""
    steps: np.ndarray
    """(N,) numbers of the steps, 0 … 2³² − 1."""

    def of(self, start: int, end: int) -> "ScanNoise":
        """The noise of the simulations ``start`` … ``end`` (excluded) of the N."""
        return ScanNoise(self.seeds[start:end], self.steps[start:end])

    def draw(self, shape: tuple[int, ...]) -> np.ndarray:
        """(N, …) float32 standard normal numbers; ``shape`` is the whole shape, with N first."""
        normal = np.empty(shape, np.float32)
        _fill(
            self.seeds.astype(np.uint64),
            self.steps.astype(np.uint64),
            normal.reshape(shape[0], -1),
        )
        return normal


@numba.njit(inline="always")
def _hashed(value, constant, multiplier):
    value = np.uint32(value ^ constant)
    constant = np.uint32(constant * multiplier)
    value = np.uint32(value * constant)
    return np.uint32(value ^ (value >> np.uint32(16))), constant


@numba.njit(nogil=True, cache=True)
def _seed_words(seed, step, words):
    """``SeedSequence((seed, step)).generate_state(4, uint64)`` into ``words`` (4,)."""
    entropy, pool = np.zeros(4, np.uint32), np.zeros(4, np.uint32)
    entropy[0] = np.uint32(seed & _LOW)
    if seed >> _HALF:
        entropy[1], entropy[2] = np.uint32(seed >> _HALF), np.uint32(step)
    else:
        entropy[1] = np.uint32(step)
    constant = np.uint32(0x43B0D7E5)
    for i in range(4):
        pool[i], constant = _hashed(entropy[i], constant, np.uint32(0x931E8875))
    for source in range(4):
        for i in range(4):
            if i != source:
                value, constant = _hashed(pool[source], constant, np.uint32(0x931E8875))
                mixed = np.uint32(np.uint32(0xCA01F9DD) * pool[i]) - np.uint32(
                    np.uint32(0x4973F715) * value
                )
                mixed = np.uint32(mixed)
                pool[i] = np.uint32(mixed ^ (mixed >> np.uint32(16)))
    constant = np.uint32(0x8B51F9DD)
    for i in range(4):
        low, constant = _hashed(pool[2 * i % 4], constant, np.uint32(0x58F38DED))
        high, constant = _hashed(pool[(2 * i + 1) % 4], constant, np.uint32(0x58F38DED))
        words[i] = np.uint64(low) | np.uint64(high) << _HALF


@numba.njit(inline="always")
def _high_product(a, b):
    """Upper 64 bits of a b."""
    a_low, a_high, b_low, b_high = a & _LOW, a >> _HALF, b & _LOW, b >> _HALF
    middle = a_high * b_low + (a_low * b_low >> _HALF)
    other = a_low * b_high + (middle & _LOW)
    return a_high * b_high + (middle >> _HALF) + (other >> _HALF)


@numba.njit(inline="always")
def _advance(state):
    """PCG64's state (high, low, increment's high, low) ← state · multiplier + increment, modulo 2¹²⁸."""
    high, low = _MULTIPLIER
    next_low = state[1] * low
    next_high = _high_product(state[1], low) + state[0] * low + state[1] * high
    state[1] = next_low + state[3]
    state[0] = next_high + state[2] + np.uint64(state[1] < next_low)


@numba.njit(nogil=True, cache=True)
def _next(state, buffer):
    """Next 32 random bits; ``buffer`` (2,): whether the upper half of the last 64 is still there, and that half."""
    if buffer[0]:
        buffer[0] = np.uint64(0)
        return np.uint32(buffer[1])
    _advance(state)
    bits, turn = state[0] ^ state[1], state[0] >> np.uint64(58)
    bits = bits >> turn | bits << (np.uint64(64) - turn & np.uint64(63))
    buffer[0], buffer[1] = np.uint64(1), bits >> _HALF
    return np.uint32(bits & _LOW)


@numba.njit(inline="always")
def _next_share(state, buffer):
    """0 … 1, float32."""
    return np.float32(_next(state, buffer) >> np.uint32(8)) * np.float32(
        1.0 / 16777216.0
    )


@numba.njit(nogil=True, cache=True)
def _fill(seeds, steps, normal):
    words, state, buffer = (
        np.zeros(4, np.uint64),
        np.zeros(4, np.uint64),
        np.zeros(2, np.uint64),
    )
    for n in range(len(seeds)):
        _seed_words(seeds[n], steps[n], words)
        state[0], state[1], buffer[0] = np.uint64(0), np.uint64(0), np.uint64(0)
        state[2] = words[2] << np.uint64(1) | words[3] >> np.uint64(63)
        state[3] = words[3] << np.uint64(1) | np.uint64(1)
        _advance(state)
        low = state[1] + words[1]
        state[0] = state[0] + words[0] + np.uint64(low < words[1])
        state[1] = low
        _advance(state)
        for k in range(normal.shape[1]):
            normal[n, k] = _normal(state, buffer)


@numba.njit(nogil=True, cache=True)
def _normal(state, buffer):
    """Ziggurat method, float32, as NumPy's ``random_standard_normal_f``."""
    while True:
        bits = _next(state, buffer)
        layer = bits & np.uint32(0xFF)
        size = bits >> np.uint32(9) & np.uint32(0x7FFFFF)
        x = np.float32(size) * wi_float[layer]
        if bits >> np.uint32(8) & np.uint32(1):
            x = -x
        if size < ki_float[layer]:
            return x
        if layer == 0:
            while True:
                xx = -_TAIL_INVERSE * np.float32(
                    math.log1p(-_next_share(state, buffer))
                )
                yy = -np.float32(math.log1p(-_next_share(state, buffer)))
                if yy + yy > xx * xx:
                    return (
                        -(_TAIL + xx)
                        if size >> np.uint32(8) & np.uint32(1)
                        else _TAIL + xx
                    )
        height = (fi_float[layer - np.uint32(1)] - fi_float[layer]) * _next_share(
            state, buffer
        ) + fi_float[layer]
        if height < math.exp(-0.5 * np.float64(x) * np.float64(x)):
            return x

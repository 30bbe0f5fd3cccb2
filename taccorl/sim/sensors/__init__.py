"""Sensors of the twin, one file each: register a ``SensorConfig`` with ``@sensors.register("name")`` to add one.

Steps of every sensor, in this order (``Sensor.sense``):

1. law: depth and rate of the taxels → reading, a number per taxel, 0 where nothing touches;
2. transforms: effects of the sensor's material and wiring, reading → reading, one after the other;
3. gain, resting counts, noise, analogue-digital converter → counts on the wire.

Effects (a nonlinear law, creep, crosstalk, dead taxels, drift) are always transforms.

Letters in shapes: N sims, P pads, K taxels = R rows · C columns.
"""

import abc
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from taccorl.data.sensor_spec import SensorSpec
from taccorl.errors import TaccorlError
from taccorl.plugins import Registry
from taccorl.sim.sensors.noise import ScanNoise

type Noise = np.random.Generator | Sequence[np.random.Generator] | ScanNoise | None
"""One generator for all sims; or one each, so that a sim's noise is the same alone and in a batch, which ``ScanNoise`` computes
faster; or no noise."""


class Transform(Protocol):
    """Effect between the sensor's law, which computes a reading from depth, and its gain, which makes counts of it.

    Letters in shapes: N simulations, P pads, R rows and C columns of taxels."""

    def __call__(
        self, reading: np.ndarray, ids: np.ndarray | None = None, /
    ) -> np.ndarray:
        """Change a reading (n, P, R, C) of the simulations ``ids`` (n,) (all by default); the shape stays the same. A transform
        with a memory keeps it per simulation and is called once per scan."""
        ...


def as_wire(frames: np.ndarray, spec: SensorSpec) -> np.ndarray:
    """Reorder ``frames`` (..., R, C) in the pad's layout to (..., wire rows, wire columns); a view."""
    return frames.swapaxes(-1, -2) if spec.wire.transpose else frames


class Sensor(abc.ABC):
    """Simulated tactile pads of one kind: resting counts of the individual boards, and transforms (effects) between law and
    gain.

    Letters in shapes: N simulations, P pads, R rows and C columns of taxels, K = R · C, S samples of a history."""

    def __init__(
        self,
        spec: SensorSpec,
        pads: Sequence[str],
        baseline: np.ndarray,
        transforms: Sequence[Transform],
    ) -> None:
        self.spec, self.pads, self.baseline = spec, tuple(pads), baseline
        self.transforms = list(transforms)
        """Transforms in the order in which they are applied; without any, a reading passes unchanged bit for bit."""

    @abc.abstractmethod
    def reading(
        self, depth_m: np.ndarray, depth_rate_mps: np.ndarray, time_s: np.ndarray | None
    ) -> np.ndarray:
        """Law of the sensor: depth and rate of the taxels → normalised reading (N, P, R, C).

        Args:
            depth_m, depth_rate_mps: (N, P, K), or (S, N, P, K) at S times.
            time_s: (S,) these times before the stamp [s]; None: one instant.
        """

    @abc.abstractmethod
    def clean_counts(self, reading: np.ndarray) -> np.ndarray:
        """Counts above baseline for ``reading`` (N, P, R, C), without noise, rounding and limits, for callers that simulate the
        converter themselves. Same shape, float."""

    @abc.abstractmethod
    def digitise(self, reading: np.ndarray, noise: Noise) -> np.ndarray:
        """Gain, resting counts, noise and converter: reading (N, P, R, C) → counts on the wire, same shape."""

    def above_baseline(self, counts: np.ndarray) -> np.ndarray:
        """(N, P × R × C) int16 counts above baseline of ``counts`` (N, P, R, C) on the wire: ``observation.tactile`` of the
        dataset, pad after pad, row after row."""
        above = np.subtract(counts, self.baseline, dtype=np.int16, casting="unsafe")
        return above.reshape(len(above), -1)


@dataclass(kw_only=True)
class SensorConfig(abc.ABC):
    """Settings of one kind of tactile sensor; ``build`` makes the sensor."""

    seed: int = 0
    """Seed from which differences between boards (resting counts) are drawn."""

    @abc.abstractmethod
    def build(
        self, pads: Sequence[str], transforms: Sequence[Transform] = ()
    ) -> Sensor:
        """Build the sensor for these pads, in their order, with the effects ``transforms`` between law and gain, in their
        order."""


sensors: Registry[type[SensorConfig]] = Registry("sensor", "taccorl.sim.sensors")


def standard_normal(noise: Noise, shape: tuple[int, ...]) -> np.ndarray | None:
    """Standard normal random numbers of ``shape`` (N, ...), float32, one simulation after the other; None without noise. Raises
    TaccorlError: the number of generators differs from that of simulations."""
    if noise is None:
        return None
    if isinstance(noise, np.random.Generator):
        return noise.standard_normal(shape, dtype=np.float32)
    count = len(noise.seeds if isinstance(noise, ScanNoise) else noise)
    if count != shape[0]:
        raise TaccorlError(
            f"noise: {count} generators for {shape[0]} simulations; give one each, or one for all"
        )
    if isinstance(noise, ScanNoise):
        return noise.draw(shape)
    return np.stack([rng.standard_normal(shape[1:], dtype=np.float32) for rng in noise])

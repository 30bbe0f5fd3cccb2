"""Touch effects whose reading depends on earlier ones: one scan in the simulation, a whole recording in a replay."""

import math
from abc import abstractmethod
from collections.abc import Mapping
from typing import ClassVar

import numba
import numpy as np

from taccorl.sim.effects.effect import Memory, TouchEffect, effect, number

TIMES_S = (0.1, 1.0, 10.0, 100.0, 1000.0)
"""Time constants of the parts whose sum is logarithmic creep (a Prony series, one part for each decade of time)."""
_GAP_S = 0.008  # readings closer than this are not kept beside each other; pads are scanned 100 times a second


class RememberingEffect(TouchEffect):
    """Base of touch effects with memory: they compute a whole sequence of scans at once; one scan is a sequence of length 1.

    A replay of a recording (``taccorl.alignment.touch.model``) thus needs one call instead of thousands, with the same code as
    the simulation. Other effects with a memory work too, called scan by scan.

    Letters in shapes: S scans, K taxels of all chosen pads."""

    windows: ClassVar = True
    holds_scan: ClassVar[bool] = True
    """True: the input is taken as constant since the scan before. False: it is taken as linear, or the path between scans has no
    influence."""
    kept: ClassVar[str] = "held"
    """Name of the array (N, M, P, R, C) in the memory."""
    elements: ClassVar[int] = 1
    """M."""

    def memory(self, num_sims: int, pad_shape: tuple[int, int]) -> Memory:
        return {
            self.kept: np.zeros(
                (num_sims, self.elements, len(self.pads), *pad_shape), np.float32
            )
        }

    @abstractmethod
    def fill(
        self, own: np.ndarray, memory: Memory, dt_s: np.ndarray, seen: np.ndarray
    ) -> None:
        """Fill ``seen`` (S, N, K) with the readings in consecutive scans, from those of ideal pads, ``own`` (S, N, K); change
        ``memory`` from its state before the first scan to that after the last. ``dt_s`` (S, N) is the time since the scan
        before."""

    def scans(self, own: np.ndarray, memory: Memory, dt_s: np.ndarray) -> np.ndarray:
        """Readings of the chosen pads P in S consecutive scans, a new array (S, N, P, R, C) of the same type.

        Args:
            own: (S, N, P, R, C) readings of ideal pads.
            memory: arrays (N, …) with the state before the first scan; changed to the state after the last.
            dt_s: (S, N) time since the scan before.
        """
        seen, flat = (
            np.empty(own.shape, own.dtype),
            (*own.shape[:2], -1),
        )  # in order, so that its flat form is a view
        self.fill(own.reshape(flat), memory, dt_s, seen.reshape(flat))
        return seen

    def reading(
        self, reading: np.ndarray, memory: Memory, time_s: np.ndarray, dt_s: np.ndarray
    ) -> np.ndarray:
        reading, own = reading.copy(), reading[:, self.slots]
        reading[:, self.slots] = self.scans(own[None], memory, dt_s[None])[0]
        return reading


class CreepingEffect(RememberingEffect):
    """Base class of the effects of creep. The reading is r = f + a Σ mᵢ with ṁᵢ = (f − mᵢ) / τᵢ: f is the reading without creep,
    a the share of the creep, τᵢ [s] its time constants. r is at least 0, unless ``below_rest`` is true.

    The equation is solved exactly for a reading that was constant since the last scan."""

    kept: ClassVar = "crept"
    share: float
    """a; a parameter of each effect, with its own range."""
    below_rest: bool
    """True: after a release readings may be below 0 where a < 0; for sensors whose reading at rest is no lower end."""

    @property
    @abstractmethod
    def times_s(self) -> tuple[float, ...]:
        """Time constants τᵢ [s]."""

    def memory(self, num_sims: int, pad_shape: tuple[int, int]) -> Memory:
        return {
            "crept": np.zeros(
                (num_sims, len(self.times_s), len(self.pads), *pad_shape), np.float32
            )
        }

    def fill(
        self, own: np.ndarray, memory: Memory, dt_s: np.ndarray, seen: np.ndarray
    ) -> None:
        lowest = -np.inf if self.below_rest or self.share > 0.0 else 0.0
        _approach(
            own, (1.0, self.share, lowest), self.times_s, dt_s, memory["crept"], seen
        )


@effect("taxel_creep", slot="material")
class TaxelCreep(CreepingEffect):
    """Creep of the readings: r = f + a m with ṁ = (f − m) / τ. The reading is f at once and (1 + a) f after a long time; after
    release a m remains and decays. Standard linear solid. a < 0 is relaxation: the reading decreases under a constant load."""

    below_rest: bool = False
    share: float = number(
        "a",
        "1",
        0,
        0.2,
        (-0.8, 2),
        "Velostat: 0.29 in 0.77 s (Lupasic/tactile-sensor-velostat)",
    )
    time_constant_s: float = number(
        "τ", "s", None, 0.8, (0.05, 30), "the same Velostat taxel"
    )

    @property
    def times_s(self) -> tuple[float, ...]:
        return (self.time_constant_s,)

    @classmethod
    def starts(cls, seen: Mapping[str, float]) -> list[dict[str, float]]:
        """Start values of a search, parameter → value each: a fast increase, a slow increase, a decrease."""
        return [
            {"share": a, "time_constant_s": tau_s}
            for a, tau_s in ((0.3, 0.3), (0.3, 3.0), (-0.3, 1.0))
        ]


@effect("taxel_log_creep", slot="material")
class TaxelLogCreep(CreepingEffect):
    """Creep over many time scales: r = f + a Σ mᵢ with ṁᵢ = (f − mᵢ) / τᵢ, τᵢ = 0.1 s … 1000 s. After t seconds of load, 0.2 s
    and more, r is (1 + a log₁₀(t / 0.018 s)) f within 0.03 a f. a < 0 is relaxation."""

    only: ClassVar = (
        "cells",
    )  # presses of pads are too short to tell it from ``taxel_creep``
    below_rest: bool = False
    share: float = number("a", "1", 0, 0.05, (-0.15, 0.3), "a choice: 5 % a decade")

    @property
    def times_s(self) -> tuple[float, ...]:
        return TIMES_S

    @classmethod
    def starts(cls, seen: Mapping[str, float]) -> list[dict[str, float]]:
        """Start values of a search, parameter → value each: an increase and a decrease."""
        return [{"share": 0.05}, {"share": -0.05}]


@effect("taxel_hysteresis", slot="material")
class TaxelHysteresis(RememberingEffect):
    """Hysteresis of the readings: r stays constant while (1 − h) f ≤ r ≤ (1 + h) f, and follows the limit that it reaches
    (Prandtl's play with a width in proportion to f).

    The reading is (1 − h) f during loading, (1 + h) f during unloading, and 0 without contact."""

    holds_scan: ClassVar = False
    half_width: float = number("h", "1", 0, 0.1, (0, 0.5))

    def fill(
        self, own: np.ndarray, memory: Memory, dt_s: np.ndarray, seen: np.ndarray
    ) -> None:
        low, high = np.float32(1.0 - self.half_width), np.float32(1.0 + self.half_width)
        _carry_along(
            own,
            low,
            high,
            np.zeros(1, np.float32),
            memory["held"].reshape(own.shape[1], 1, -1),
            seen,
        )


@effect("taxel_play", slot="material")
class TaxelPlay(RememberingEffect):
    """Hysteresis of fixed width: r stays constant while |f − r| ≤ w, and is carried along at the ends of this band (Prandtl's
    play operator).

    The reading is f − w during loading and f + w during unloading, at any speed, and w remains after release. A band in
    proportion to the load is ``taxel_hysteresis``. A search looks for it in sensors of cells only: pads were studied without it.
    Noise of a measured load widens the fitted band by about half of its standard deviation.

    With e > 0 a share e of the load is read at once, beside the play of w / (1 − e); with u > 0 this play is the mean of several
    with widths within ± u of it (Prandtl and Ishlinskii), so that loops are round, as of elastic and plastic layers."""

    holds_scan: ClassVar = False
    only: ClassVar = ("cells",)
    elements: ClassVar = 8
    optional: ClassVar = {"elastic": "", "spread": ""}
    half_width: float = number(
        "w",
        "reading",
        0,
        0.2,
        (0, 3),
        "a choice: 2 % of the rated load of a sensor of cells",
    )
    elastic: float = number(
        "e", "1", 0, 0.5, (0, 0.95), "a choice; 0: the play carries all of the load"
    )
    spread: float = number("u", "1", 0, 0.5, (0, 0.95), "a choice; 0: one play")

    def fill(
        self, own: np.ndarray, memory: Memory, dt_s: np.ndarray, seen: np.ndarray
    ) -> None:
        one, wide = (
            np.float32(1.0),
            1.0 + self.spread * np.linspace(-1.0, 1.0, self.elements),
        )
        widths = (self.half_width / (1.0 - self.elastic) * wide).astype(np.float32)
        _carry_along(
            own,
            one,
            one,
            widths,
            memory["held"].reshape(own.shape[1], self.elements, -1),
            seen,
        )
        seen[:] = np.float32(self.elastic) * own + np.float32(1.0 - self.elastic) * seen


@effect("touch_delay", slot="taxel")
class TouchDelay(RememberingEffect):
    """Delay of the readings: r(t) = f(t − d), with linear interpolation between scans. Before the reset readings count as 0."""

    holds_scan: ClassVar = False
    delay_s: float = number("d", "s", 0, 0.03, (0, 0.2), "a choice: three scans")

    def memory(self, num_sims: int, pad_shape: tuple[int, int]) -> Memory:
        shape = (num_sims, math.ceil(self.delay_s / _GAP_S) + 2)
        return {
            "past": np.zeros((*shape, len(self.pads), *pad_shape), np.float32),
            "age_s": np.zeros(shape),
        }

    def fill(
        self, own: np.ndarray, memory: Memory, dt_s: np.ndarray, seen: np.ndarray
    ) -> None:
        past = memory["past"].reshape(*memory["past"].shape[:2], -1)
        _recall(
            own,
            np.asarray(dt_s, float),
            past,
            memory["age_s"],
            float(self.delay_s),
            seen,
        )


@effect("touch_lag", slot="taxel")
class TouchLag(RememberingEffect):
    """Low-pass of the readings: ṙ = (f − r) / T. Solved exactly for a reading that was constant since the last scan."""

    kept: ClassVar = "smooth"
    time_constant_s: float = number(
        "T", "s", 0, 0.03, (0, 0.5), "a choice: three scans"
    )

    def fill(
        self, own: np.ndarray, memory: Memory, dt_s: np.ndarray, seen: np.ndarray
    ) -> None:
        _approach(
            own,
            (0.0, 1.0, -np.inf),
            (self.time_constant_s,),
            dt_s,
            memory["smooth"],
            seen,
        )


def _approach(
    own: np.ndarray,
    law: tuple[float, float, float],
    times_s: tuple[float, ...],
    dt_s: np.ndarray,
    parts: np.ndarray,
    seen: np.ndarray,
) -> None:
    """Fill ``seen`` (S, N, K) with max(w f + a Σ mᵢ, lowest), ``law`` = (w, a, lowest), where each of ``parts`` (N, M, …)
    approaches f, ``own`` (S, N, K), with one of the M time constants ``times_s`` [s]."""
    reached = -np.expm1(-dt_s[..., None] / np.array(times_s)).astype(own.dtype)
    whole, share, lowest = np.array(law, np.float32)
    _step(
        own,
        reached,
        whole,
        share,
        lowest,
        parts.reshape(own.shape[1], len(times_s), -1),
        seen,
    )


@numba.njit(cache=True)
def _step(
    own: np.ndarray,
    reached: np.ndarray,
    whole: np.float32,
    share: np.float32,
    lowest: np.float32,
    parts: np.ndarray,
    seen: np.ndarray,
) -> None:
    for s in range(own.shape[0]):
        for n in range(own.shape[1]):
            for k in range(own.shape[2]):
                total = np.float32(0)
                for m in range(parts.shape[1]):
                    parts[n, m, k] += (own[s, n, k] - parts[n, m, k]) * reached[s, n, m]
                    total += parts[n, m, k]
                seen[s, n, k] = max(whole * own[s, n, k] + share * total, lowest)


@numba.njit(cache=True)
def _carry_along(
    own: np.ndarray,
    low: np.float32,
    high: np.float32,
    widths: np.ndarray,
    held: np.ndarray,
    seen: np.ndarray,
) -> None:
    """``held`` (N, M, K) is kept between ``low`` and ``high`` times ``own`` (S, N, K), ∓ ``widths`` (M,), in every scan. ``seen``
    is the mean of the M."""
    for s in range(own.shape[0]):
        for n in range(own.shape[1]):
            for k in range(own.shape[2]):
                total, load = np.float32(0), max(own[s, n, k], np.float32(0))
                for m in range(widths.size):
                    least, most = low * load - widths[m], high * load + widths[m]
                    held[n, m, k] = min(max(held[n, m, k], least), most)
                    total += held[n, m, k]
                seen[s, n, k] = total / np.float32(widths.size)


@numba.njit(cache=True)
def _recall(
    own: np.ndarray,
    dt_s: np.ndarray,
    past: np.ndarray,
    age_s: np.ndarray,
    delay_s: float,
    seen: np.ndarray,
) -> None:
    """``past`` (N, H, K), the newest first, takes up ``own`` (S, N, K); ``seen`` is what there was ``delay_s`` ago.

    A simulation that stands still (dt 0), and scans that follow each other quickly, replace the newest."""
    last = past.shape[1] - 1
    for s in range(own.shape[0]):
        for n in range(own.shape[1]):
            is_apart = dt_s[s, n] > 0.0 and age_s[n, 1] - age_s[n, 0] >= _GAP_S
            age_s[n] += dt_s[s, n]
            if is_apart:
                for h in range(last, 0, -1):
                    age_s[n, h] = age_s[n, h - 1]
                    past[n, h] = past[n, h - 1]
            age_s[n, 0] = 0.0
            past[n, 0] = own[s, n]
            h = 0
            while h < last - 1 and age_s[n, h + 1] < delay_s:
                h += 1
            span = age_s[n, h + 1] - age_s[n, h]
            share = min((delay_s - age_s[n, h]) / span, 1.0) if span > 0.0 else 0.0
            for k in range(own.shape[2]):
                seen[s, n, k] = past[n, h, k] + share * (
                    past[n, h + 1, k] - past[n, h, k]
                )

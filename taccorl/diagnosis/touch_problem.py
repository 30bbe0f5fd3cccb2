"""The pads as a problem for the search: k_n, k_d and each pad's zero are always fitted; candidates are effects on readings.

A recording's channels are the taxels that matter in it, at most ``MAX_CHANNELS``: those the object comes near and those that
read something. They are simulated with the whole pads around them. A row is the mean of ``FRAMES_A_ROW`` frames: what many scans
say together stands out of noise in which each of them is lost. All rows are kept while something touches and for a second
after, one in five otherwise.

Letters in shapes: T frames, S rows, P pads, R × C taxels, C channels.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from taccorl.alignment.noise_floor import repeat_pairs
from taccorl.alignment.repeats import overlay
from taccorl.alignment.touch import noise_level
from taccorl.alignment.touch_model import TouchModel
from taccorl.alignment.touch_motion import TouchMotion
from taccorl.diagnosis.problem import Candidate, Free, Recording, Values, candidate
from taccorl.errors import TaccorlError
from taccorl.sim.effects import effects as registry
from taccorl.sim.effects.effect import BoardEffect, Effect, TouchEffect
from taccorl.sim.effects.pad_frame import PadFrameEffect
from taccorl.sim.effects.taxel_gain_map import TaxelGainMap
from taccorl.sim.robot import PAD_TAXELS
from taccorl.sim.twin import TwinConfig

MAX_CHANNELS = 64
FRAMES_A_ROW = 5
"""50 ms: a delay of a fifth of that still moves the mean of a press's edge."""
_SELDOM = 5  # of the rows in which nothing happens one in so many is kept
_SIGNAL = 1.3  # a taxel reads something if its RMS in contact is so many times its noise
_FIXED = {
    "taxel_power_law": {"reference": 1.0},  # another reference is another k_n
    "taxel_gain_map": {"share": 1.0},  # the map itself is estimated
}
_INDEPENDENT_ROWS = 4.0  # so many rows say about a gain what an independent one would
_MOST_GAIN = 5.0
_TAXELS = math.prod(PAD_TAXELS)


@dataclass(frozen=True, eq=False)
class _Chosen:
    """What a recording holds for the simulation."""

    motion: TouchMotion
    rows: np.ndarray
    """(S,) numbers of rows."""
    taxels: np.ndarray
    """(C,) flat numbers within (P, R, C)."""


class TouchProblem:
    """Satisfies ``taccorl.diagnosis.problem.Problem``. Simulates and measures in counts above baseline.

    Args:
        motions: all recordings that will be looked at; noise and facts for starts come from them.
        config: the twin. Its own touch effects on just these pads are ``present``: fitted anew with everything else. Its others
            act as they are and are no candidates here.
            Those that repeat another one's motion (``Measurement.repeat_of``) say what the pads do not repeat.

    Raises:
        TaccorlError: recordings of different pads, none, or none without contact for a while.
    """

    def __init__(self, motions: Sequence[TouchMotion], config: TwinConfig) -> None:
        self.noise = noise_level(motions)
        self.pads = self.noise.pads
        shown = [e for e in config.effects if _shows(type(e)) and not e.is_absent and {*e.acts_on()} & {*self.pads}]
        own = [e for e in shown if {*e.acts_on()} == {*self.pads}]
        self.present = tuple(effect.name for effect in own)
        others = [e for e in config.effects if not any(e is mine for mine in own)]
        self._model = TouchModel(dataclasses.replace(config, effects=others))
        self.floor_count = np.maximum(_still_floor(motions), _repeat_floor(motions, self.noise.std_count.shape))
        """(P, R, C) of a row, each taxel: its noise; where a motion was repeated, what it does not repeat."""
        sensor = self._model.sensor
        k_n, k_d = sensor.normal_stiffness_per_m, sensor.normal_damping_s_per_m
        zeros = [
            Free(name=f"zero_{pad}", unit="count", start=0.0, low=-30.0, high=30.0, scale=1.0) for pad in self.pads
        ]
        self.base: tuple[Free, ...] = (
            Free(name="k_n", unit="1/m", start=k_n, low=k_n / 30, high=k_n * 30, log=True),
            Free(name="k_d", unit="s/m", start=k_d, low=0.0, high=0.2 * k_n, scale=0.005 * k_n),
            *zeros,
        )
        peak = max(float(np.quantile(m.measured.max(axis=(1, 2, 3)), 0.99)) for m in motions)
        self.seen = {
            "peak_reading": max(peak, 1.0) / sensor.gain_count,
            "duration_s": max(float(m.time_s[-1, 0] - m.time_s[0, 0]) for m in motions),
        }
        near = np.any([m.near(0.0).any(axis=0) for m in motions], axis=0)
        self._num_gains = min(int(near.sum()), MAX_CHANNELS)  # gains that the channels can show
        taken = {e.name for e in shown} - {*self.present}
        self.candidates = {
            name: self._candidate(cls) for name in registry if _shows(cls := registry.get(name)) and name not in taken
        }
        self.start: Values = {f.name: f.start for f in self.base} | {
            f.name: getattr(e, f.name.split(".", 1)[1]) for e in own for f in self.candidates[e.name].frees
        }
        """To start a search from: the twin's own numbers."""

    def _candidate(self, cls: type[Effect]) -> Candidate:
        found = candidate(cls, self.seen, pads=list(self.pads), **_FIXED.get(cls.name, {}))
        fixed = {f"{cls.name}.{p}" for p in _FIXED.get(cls.name, {})}
        frees = tuple(f for f in found.frees if f.name not in fixed)
        starts = tuple({k: v for k, v in start.items() if k not in fixed} for start in found.starts) if frees else ({},)
        return dataclasses.replace(
            found, frees=frees, starts=starts, num_maps=self._num_gains if cls is TaxelGainMap else 0
        )

    def recording(self, motion: TouchMotion) -> Recording:
        """A motion as the search sees it.

        Raises:
            TaccorlError: it is of other pads than the problem.
        """
        if motion.pads != self.pads:
            raise TaccorlError(
                f"{motion.name}: it touches {', '.join(motion.pads)}, the problem is {', '.join(self.pads)}"
            )
        happens = np.asarray(~motion.undisturbed(after_s=1.0).all(axis=1))
        in_row = _rows(happens) > 0
        rows = np.flatnonzero(in_row | (np.arange(len(in_row)) % _SELDOM == 0))
        taxels = self._taxels(motion, happens)
        return Recording(
            name=motion.name,
            time_s=_rows(motion.time_s.mean(axis=1))[rows],
            measured=_rows(motion.measured)[rows].reshape(len(rows), -1)[:, taxels],
            floor=self.floor_count.ravel()[taxels],
            channels=tuple(self._channel(t) for t in taxels),
            data=_Chosen(motion, rows, taxels),
        )

    def _taxels(self, motion: TouchMotion, happens: np.ndarray) -> np.ndarray:
        """Flat numbers of those that the object comes near or that read something; evenly taken if they are too many."""
        signal = np.square(motion.measured[happens] - self.noise.mean_count).mean(axis=0) ** 0.5
        matters = motion.near(3e-4).any(axis=0) | (signal > _SIGNAL * self.noise.std_count)
        found = np.flatnonzero(matters)
        if len(found) == 0:
            raise TaccorlError(f"{motion.name}: the object comes near no taxel and none reads anything")
        some = np.random.default_rng(0).permutation(found)[:MAX_CHANNELS]  # favours no row
        return np.sort(some)

    def _channel(self, taxel: int) -> str:
        pad, row, column = np.unravel_index(taxel, self.floor_count.shape)
        return f"{self.pads[pad]}[{row}, {column}] [count]"

    def simulate(self, base: Mapping[str, float], effects: Sequence[Effect], recording: Recording) -> np.ndarray:
        """(S, C) counts above baseline."""
        chosen: _Chosen = recording.data
        return _rows(self._counts(base, effects, chosen.motion, chosen.taxels))[chosen.rows]

    def _counts(
        self, base: Mapping[str, float], effects: Sequence[Effect], motion: TouchMotion, taxels: np.ndarray
    ) -> np.ndarray:
        """(T, C) of taxels (C,) by their flat numbers."""
        reading = self._model.simulate(motion, base["k_n"], base["k_d"], effects)
        sensor, spec = self._model.sensor, self._model.spec
        counts = sensor.gain_count * reading.reshape(len(reading), -1)[:, taxels]
        counts += np.array([base[f"zero_{pad}"] for pad in self.pads], np.float32)[taxels // _TAXELS]
        baseline = motion.baseline.reshape(-1)[taxels]
        return np.clip(counts, -baseline, spec.max_count - baseline)

    def learn(self, values: Mapping[str, float]) -> None:
        """Starts of searches hang on the recordings alone."""

    def prepare(
        self, base: Mapping[str, float], effects: Sequence[Effect], recordings: Sequence[Recording]
    ) -> list[Effect]:
        """``effects`` with the gain map of all taxels, if there is one among them, estimated from ``recordings``."""
        if not any(isinstance(effect, TaxelGainMap) for effect in effects):
            return list(effects)
        gains = self._gains(dict(base), [e for e in effects if not isinstance(e, TaxelGainMap)], recordings)
        return [TaxelGainMap.of(gains, self.pads) if isinstance(e, TaxelGainMap) else e for e in effects]

    def _gains(self, base: Values, effects: Sequence[Effect], recordings: Sequence[Recording]) -> np.ndarray:
        """(P, R, C) empirical Bayes: g_k ~ N(1, τ²), where each taxel's least squares is as sure as its load was great.

        τ comes from the spread of the least-squares gains beyond their own errors. Taxels that nothing pressed keep gain 1.
        Gains are relative to their median: k_n has the rest.
        """
        material = [e for e in effects if e.layer != "baseline"]
        zeros = {f"zero_{pad}": 0.0 for pad in self.pads}
        everywhere = np.arange(self.floor_count.size)
        load, product = np.zeros(self.floor_count.size), np.zeros(self.floor_count.size)
        for recording in recordings:
            motion, rows = recording.data.motion, recording.data.rows
            rows = rows[np.isfinite(recording.measured).any(axis=1)]  # the others are for validation
            alone = self._counts(base | zeros, material, motion, everywhere)
            rest = self._counts(base, effects, motion, everywhere) - alone
            measured = motion.measured.reshape(len(alone), -1)
            cut = measured >= self._model.spec.max_count - motion.baseline.reshape(-1) - 1  # the converter's end
            pressed = _rows(np.where(cut, 0.0, alone))[rows]
            load += np.square(pressed).sum(axis=0)
            product += (pressed * _rows(measured - rest)[rows]).sum(axis=0)
        variance = _INDEPENDENT_ROWS * np.square(self.floor_count.ravel()) / np.maximum(load, 1e-12)
        known = variance < 0.1**2
        if known.sum() < 2:
            return np.ones(self.floor_count.shape)
        least = product[known] / load[known]
        least /= np.median(least)
        spread = float(np.mean(np.square(least - 1.0) - variance[known]))
        gains = np.ones_like(load)
        if spread > 0:
            gains[known] = 1.0 + (least - 1.0) * spread / (spread + variance[known])
        return np.clip(gains, 0.0, _MOST_GAIN).reshape(self.floor_count.shape)


def _shows(cls: type[Effect]) -> bool:
    """Whether an effect changes what pads read in a matched replay, by numbers that can be fitted."""
    if not issubclass(cls, TouchEffect) or issubclass(cls, BoardEffect):
        return False
    return issubclass(cls, PadFrameEffect) or cls.reading is not Effect.reading


def _rows(frames: np.ndarray) -> np.ndarray:
    """Means of ``FRAMES_A_ROW`` frames (T, …) → rows; frames left over at the end fall away."""
    whole = len(frames) // FRAMES_A_ROW * FRAMES_A_ROW
    return frames[:whole].reshape(-1, FRAMES_A_ROW, *frames.shape[1:]).mean(axis=1, dtype=float)


def _still_floor(motions: Sequence[TouchMotion]) -> np.ndarray:
    """(P, R, C) counts: standard deviation of rows that nothing disturbs, from the differences of neighbours, because a zero
    that drifts is no noise; at least rounding."""
    squares, freedom = np.zeros(motions[0].measured.shape[1:]), np.zeros((len(motions[0].pads), 1, 1))
    for motion in motions:
        rows, still = _rows(motion.measured), _rows(motion.undisturbed()) == 1.0
        for p in range(len(motion.pads)):
            both = still[1:, p] & still[:-1, p]
            squares[p] += np.square(np.diff(rows[:, p], axis=0)[both]).sum(axis=0) / 2
            freedom[p] += int(both.sum())
    return np.maximum(np.sqrt(squares / np.maximum(freedom, 1)), 1 / math.sqrt(12))


def _repeat_floor(motions: Sequence[TouchMotion], shape: tuple[int, ...]) -> np.ndarray:
    """(P, R, C) RMS difference of repeats / √2 in counts, the second brought to the first's times; 0 without any."""
    of_name = {motion.name: motion for motion in motions}
    squares, rows = np.zeros(shape), 0
    for one, repeat in repeat_pairs([motion.measurement for motion in motions]):
        first, second = of_name[one.name], of_name[repeat.name]
        time_s = first.time_s.mean(axis=1) + overlay(one, repeat).shift_s
        other_s = second.time_s.mean(axis=1)
        inside = (time_s >= other_s[0]) & (time_s <= other_s[-1])
        after = np.clip(np.searchsorted(other_s, time_s[inside]), 1, len(other_s) - 1)
        share = ((time_s[inside] - other_s[after - 1]) / (other_s[after] - other_s[after - 1]))[:, None, None, None]
        laid = second.measured[after - 1] * (1 - share) + second.measured[after] * share
        difference = _rows(first.measured[inside] - laid)
        squares += np.square(difference).sum(axis=0)
        rows += len(difference)
    return np.sqrt(squares / (2 * rows)) if rows else squares

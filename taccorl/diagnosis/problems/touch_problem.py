"""The pads as a problem for the search: k_n, k_d and each pad's zero are always fitted; candidates are effects on readings.

A recording's channels are at most ``MAX_CHANNELS`` taxels: those that the object comes near and those above the noise. They are
simulated with all taxels around them that the object comes near. A row is the mean of ``FRAMES_A_ROW``
frames: averaging reduces the noise. All rows are kept during contact and for a second after, otherwise one in five. A taxel's
gain can only be known if it was pressed: taxels that no fit recording pressed are left out of validation and test recordings,
for every effect (``recordings``).

Letters in shapes: T frames, S rows, P pads, R × C taxels, C channels.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from taccorl.alignment.measurements.folder import repeat_pairs
from taccorl.alignment.measurements.noise_floor import DISAGREE
from taccorl.alignment.measurements.repeats import overlay
from taccorl.alignment.touch.calibration import noise_level
from taccorl.alignment.touch.model import TouchModel
from taccorl.alignment.touch.motion import TouchMotion
from taccorl.data.touch_checks import taxel_list
from taccorl.diagnosis.search.problem import (
    Candidate,
    Free,
    Recording,
    Values,
    WithoutMaps,
    candidate,
)
from taccorl.errors import TaccorlError
from taccorl.sim.effects import effects as registry
from taccorl.sim.effects.effect import BoardEffect, Effect, TouchEffect
from taccorl.sim.effects.pads import PadFrameEffect, TaxelGainMap
from taccorl.sim.twin import TwinConfig

MAX_CHANNELS = 64
"""Most taxels of a recording that are channels of the search."""
FRAMES_A_ROW = 5
"""Number of frames per row (50 ms): a delay of a fifth of it still changes the mean at the edge of a press."""
_SELDOM = 5  # of the rows in which nothing happens one in so many is kept
_SIGNAL = (
    1.3  # a taxel reads something if its RMS in contact is so many times its noise
)
FIXED: dict[str, dict[str, float]] = {
    "taxel_power_law": {"reference": 1.0},  # another reference is another k_n
    "taxel_gain_map": {"share": 1.0},  # the map itself is estimated
}
_INDEPENDENT_ROWS = 4.0  # so many rows say about a gain what an independent one would
_MOST_GAIN = 5.0
_PRESSED_M, _PRESSED_FRAMES = (
    5e-5,
    25,
)  # a taxel that deep for a quarter of a second is pressed
DEAD_GAIN = 0.1
"""A taxel is dead if its gain is below this share of the median gain."""
ODD_SPREADS, ODD_BY = 4.0, 0.2
"""A gain is odd if it is this many standard deviations (robust) of all and this share of their median from it. A choice."""
FEWEST_SHARED = 8
"""Least number of pressed taxels that a validation recording must share with the fit recordings for judging a gain map on it."""
_WINDOW_M = 1e-3  # taxels that the object comes so near to are simulated,
_RIM = 1  # and so many rows and columns around them


@dataclass(frozen=True, eq=False)
class _Chosen:
    """What a recording holds for the simulation."""

    motion: TouchMotion
    rows: np.ndarray
    """(S,) numbers of rows."""
    taxels: np.ndarray
    """(C,) flat numbers within (P, R, C)."""
    cut: TouchMotion
    """All frames of a window of the pads, ``kept`` those of the rows only."""
    kept: TouchMotion
    window: np.ndarray
    """(K,) flat numbers of the window's taxels within (P, R, C)."""
    channels: np.ndarray
    """(C,) places of ``taxels`` in ``window``."""

    @property
    def start_s(self) -> float:
        return float(self.motion.time_s[0].mean())

    @cached_property
    def measured(self) -> np.ndarray:
        """(S, K) counts of the window's taxels."""
        return _rows(self.kept.measured).reshape(len(self.rows), -1)

    def at_end(self, max_count: int) -> np.ndarray:
        """(S, K) bool: the converter was at its end in some frame of the row."""
        return (
            _rows(self.kept.measured >= max_count - self.kept.baseline - 1).reshape(
                len(self.rows), -1
            )
            > 0
        )


@dataclass(frozen=True, kw_only=True)
class GainStatistics:
    """Statistics of the gains of pressed taxels."""

    log_std: float
    """Standard deviation of ln g over taxels that are not dead, without the estimation error of each."""
    num_dead: int
    """Number of taxels with a gain below ``DEAD_GAIN``."""
    num_taxels: int
    """Number of pressed taxels, dead ones included."""
    odd: str = ""
    """Text of ``odd_cells``."""


@dataclass(frozen=True)
class _Gains:
    """Estimated gains."""

    gains: np.ndarray
    """(P, R, C) as the map has them."""
    least: np.ndarray
    """(K,) least-squares gains of the taxels that were pressed enough, divided by their median."""
    variance: np.ndarray
    """(K,) squared standard error of each of these gains."""


class TouchProblem(WithoutMaps):
    """Search problem of the pads (a ``diagnosis.search.problem.Problem``), in counts above baseline.

    Args:
        motions: all recordings; noise and facts for start values come from them.
        config: configuration of the twin. Its touch effects on exactly these pads are ``present``: they are fitted again with
            all other numbers. Its other effects act unchanged and are no candidates.

    Recordings that repeat another one (``Measurement.repeat_of``) determine the variation between repeats.

    Raises:
        TaccorlError: there is no recording, recordings are of different pads, or none has enough time without contact.
    """

    known = ()
    numbers = "k_n, k_d and each pad's zero fitted"
    measured = f"means of {FRAMES_A_ROW} frames"
    fit: Sequence[Recording]
    validation: Sequence[Recording]
    test: Sequence[Recording]

    def __init__(self, motions: Sequence[TouchMotion], config: TwinConfig) -> None:
        self._level = noise_level(motions)
        self.pads = self._level.pads
        shown = [
            e
            for e in config.effects
            if _shows(type(e)) and not e.is_absent and {*e.acts_on()} & {*self.pads}
        ]
        own = [e for e in shown if {*e.acts_on()} == {*self.pads}]
        self.present = tuple(effect.name for effect in own)
        others = [e for e in config.effects if not any(e is mine for mine in own)]
        self._model = TouchModel(dataclasses.replace(config, effects=others))
        self._still_count = _still_floor(motions)
        repeated = _repeat_floor(motions, self._still_count)
        self.floor_count = np.maximum(self._still_count, repeated.taxel_count)
        """(P, R, C) noise floor of a row of each taxel [counts], with the variation between repeats, if any."""
        self._touched_count = repeated.touched_count
        self._lower_bound = not repeat_pairs(m.measurement for m in motions)
        self.not_shared: list[str] = []
        """Validation recordings that press hardly any taxel which a fit recording presses (``recordings``)."""
        sensor = self._model.sensor
        k_n, k_d = sensor.normal_stiffness_per_m, sensor.normal_damping_s_per_m
        zeros = [
            Free(
                name=f"zero_{pad}",
                unit="count",
                start=0.0,
                low=-30.0,
                high=30.0,
                scale=1.0,
            )
            for pad in self.pads
        ]
        self.base: tuple[Free, ...] = (
            Free(
                name="k_n", unit="1/m", start=k_n, low=k_n / 30, high=k_n * 30, log=True
            ),
            Free(
                name="k_d",
                unit="s/m",
                start=k_d,
                low=0.0,
                high=0.2 * k_n,
                scale=0.005 * k_n,
            ),
            *zeros,
        )
        peak = max(
            float(np.quantile(m.measured.max(axis=(1, 2, 3)), 0.99)) for m in motions
        )
        self.seen = {
            "peak_reading": max(peak, 1.0) / sensor.gain_count,
            "duration_s": max(float(m.time_s[-1, 0] - m.time_s[0, 0]) for m in motions),
        }
        near = np.any([m.near(0.0).any(axis=0) for m in motions], axis=0)
        self._num_gains = min(
            int(near.sum()), MAX_CHANNELS
        )  # gains that the channels can show
        taken = {e.name for e in shown} - {*self.present}
        self.candidates = {
            name: self._candidate(cls)
            for name in registry
            if _shows(cls := registry.get(name)) and name not in taken
        }
        self.start: Values = {f.name: f.start for f in self.base} | {
            f.name: getattr(e, f.name.split(".", 1)[1])
            for e in own
            for f in self.candidates[e.name].frees
        }
        """Start values of a search: the twin's own numbers."""

    @property
    def repeats_differ(self) -> bool:
        """Whether repeats differ ``DISAGREE`` times as much as the noise of rows."""
        return self._touched_count > DISAGREE * float(np.median(self._still_count))

    def _candidate(self, cls: type[Effect]) -> Candidate:
        found = candidate(
            cls, self.seen, pads=list(self.pads), **FIXED.get(cls.name, {})
        )
        return (
            dataclasses.replace(found, num_maps=self._num_gains)
            if cls is TaxelGainMap
            else found
        )

    def recordings(
        self,
        fit: Sequence[TouchMotion],
        validation: Sequence[TouchMotion],
        test: Sequence[TouchMotion] = (),
    ) -> tuple[list[Recording], list[Recording], list[Recording]]:
        """Motions in the form for the search: (fit, validation, test), each in the order of the motions. From validation and test
        motions, taxels that no fit motion presses are left out; none is left out if fewer than ``FEWEST_SHARED`` would remain
        (``not_shared``)."""
        known = np.any([_pressed(m) for m in fit], axis=0)
        self.not_shared = [
            m.name for m in validation if (_pressed(m) & known).sum() < FEWEST_SHARED
        ]
        self.fit = [self.recording(m) for m in fit]
        self.validation, self.test = (
            [self.recording(m, known) for m in side] for side in (validation, test)
        )
        return self.fit, self.validation, self.test

    @property
    def noise(self) -> str:
        """Text of the noise floor of the fit recordings' rows."""
        count = float(np.median(np.concatenate([r.floor for r in self.fit])))
        bound = "; a lower bound: record a press twice" * self._lower_bound
        return f"{count:.2g} counts, a taxel's mean over {FRAMES_A_ROW} frames (the median taxel{bound})"

    def recording(
        self, motion: TouchMotion, known: np.ndarray | None = None
    ) -> Recording:
        """A motion in the form for the search.

        Args:
            known: (P · R · C,) bool, taxels whose gain can be known; None: all.

        Raises:
            TaccorlError: the motion is of other pads than the problem.
        """
        if motion.pads != self.pads:
            raise TaccorlError(
                f"{motion.name}: it touches {', '.join(motion.pads)}, but the problem is about {', '.join(self.pads)}"
            )
        happens = _happens(motion)
        rows = _kept_rows(happens)
        taxels = self._taxels(motion, happens, known)
        touched = (
            _rows(motion.near(0.0))[rows].reshape(len(rows), -1)[:, taxels].mean(axis=0)
        )
        floor = (
            np.square(self._still_count.ravel()[taxels])
            + touched * self._touched_count**2
        )
        return Recording(
            name=motion.name,
            time_s=_rows(motion.time_s.mean(axis=1))[rows],
            measured=_rows(motion.measured)[rows].reshape(len(rows), -1)[:, taxels],
            floor=np.maximum(self.floor_count.ravel()[taxels], np.sqrt(floor)),
            channels=tuple(self._channel(t) for t in taxels),
            data=self._chosen(motion, rows, taxels),
        )

    def _taxels(
        self, motion: TouchMotion, happens: np.ndarray, known: np.ndarray | None
    ) -> np.ndarray:
        """Flat numbers of those that the object comes near or that read something; evenly taken if they are too many."""
        signal = (
            np.square(motion.measured[happens] - self._level.mean_count).mean(axis=0)
            ** 0.5
        )
        matters = motion.near(3e-4).any(axis=0) | (
            signal > _SIGNAL * self._level.std_count
        )
        if known is not None and (_pressed(motion) & known).sum() >= FEWEST_SHARED:
            matters &= (known | ~_pressed(motion)).reshape(matters.shape)
        found = np.flatnonzero(matters)
        if len(found) == 0:
            raise TaccorlError(
                f"{motion.name}: the object comes near no taxel, and no taxel reads anything: "
                "correct radius_m and position_m of its `pressed` in measurements.yaml, or leave the recording out"
            )
        some = np.random.default_rng(0).permutation(found)[
            :MAX_CHANNELS
        ]  # favours no row
        return np.sort(some)

    def _chosen(
        self, motion: TouchMotion, rows: np.ndarray, taxels: np.ndarray
    ) -> _Chosen:
        matters = motion.near(_WINDOW_M).any(axis=0)
        matters.reshape(-1)[taxels] = True
        _, rows_there, columns_there = np.nonzero(matters)
        rectangle = (
            _span(rows_there, motion.layout.rows),
            _span(columns_there, motion.layout.columns),
        )
        number = np.arange(matters.size).reshape(matters.shape)
        window = number[:, *rectangle].ravel()
        every = np.ones(len(motion.time_s), dtype=bool)
        kept = np.zeros_like(every)
        kept[(rows[:, None] * FRAMES_A_ROW + np.arange(FRAMES_A_ROW)).ravel()] = True
        cuts = motion.cut(every, rectangle), motion.cut(kept, rectangle)
        return _Chosen(
            motion, rows, taxels, *cuts, window, np.searchsorted(window, taxels)
        )

    def _channel(self, taxel: int) -> str:
        pad, row, column = np.unravel_index(taxel, self.floor_count.shape)
        return f"{self.pads[pad]}[{row}, {column}] [count]"

    def simulate(
        self, base: Mapping[str, float], effects: Sequence[Effect], recording: Recording
    ) -> np.ndarray:
        """(S, C) simulated counts above baseline, means of ``FRAMES_A_ROW`` frames.

        Args:
            base: ``k_n`` [1/m], ``k_d`` [s/m] and ``zero_PAD`` [counts] of each pad.
            effects: effects in addition to those of the twin that are not fitted.
        """
        chosen: _Chosen = recording.data
        return self._counts(base, effects, chosen, chosen.channels)

    def _counts(
        self,
        base: Mapping[str, float],
        effects: Sequence[Effect],
        chosen: _Chosen,
        places: np.ndarray,
    ) -> np.ndarray:
        """(S, C) of rows, of the taxels at ``places`` (C,) of the window."""
        taxels = chosen.window[places]
        model, numbers = self._model, (base["k_n"], base["k_d"], effects)
        all_frames = model.remembers(effects)
        if model.windowed(effects):
            cut = chosen.cut if all_frames else chosen.kept
            reading = model.simulate(cut, *numbers, start_s=chosen.start_s)
        else:
            places, all_frames = taxels, True
            reading = model.simulate(chosen.motion, *numbers)
        zero = np.array([base[f"zero_{pad}"] for pad in self.pads])[
            taxels // chosen.motion.layout.num_taxels
        ]
        low = -chosen.motion.baseline.reshape(-1)[taxels].astype(float)
        seen = reading.reshape(len(reading), -1)[:, places].astype(float)
        counts = _rows(
            np.clip(
                model.sensor.gain_count * seen + zero, low, low + model.spec.max_count
            )
        )
        return counts[chosen.rows] if all_frames else counts

    def prepare(
        self,
        base: Mapping[str, float],
        effects: Sequence[Effect],
        recordings: Sequence[Recording],
    ) -> list[Effect]:
        """Copy of ``effects`` in which a gain map, if there is one, is estimated for all taxels from ``recordings``, with the
        other effects and the always fitted numbers ``base``."""
        if not any(isinstance(effect, TaxelGainMap) for effect in effects):
            return list(effects)
        gains = self._gains(
            dict(base),
            [e for e in effects if not isinstance(e, TaxelGainMap)],
            recordings,
        )
        return [
            TaxelGainMap.of(gains.gains, self.pads)
            if isinstance(e, TaxelGainMap)
            else e
            for e in effects
        ]

    def _gains(
        self, base: Values, effects: Sequence[Effect], recordings: Sequence[Recording]
    ) -> "_Gains":
        """Empirical Bayes: g_k ~ N(1, τ²), where each taxel's least squares is as sure as its load was great.

        τ comes from the spread of the least-squares gains beyond their own errors. Taxels that nothing pressed keep gain 1.
        Gains are relative to their median: k_n has the rest.
        """
        material = [e for e in effects if e.slot != "baseline"]
        zeros = {f"zero_{pad}": 0.0 for pad in self.pads}
        load, product = np.zeros(self.floor_count.size), np.zeros(self.floor_count.size)
        for recording in recordings:
            chosen: _Chosen = recording.data
            there = np.isfinite(recording.measured).any(
                axis=1
            )  # the others are for validation
            everywhere = np.arange(len(chosen.window))
            alone = self._counts(base | zeros, material, chosen, everywhere)
            rest = np.array([base[f"zero_{pad}"] for pad in self.pads])[
                chosen.window // chosen.motion.layout.num_taxels
            ]
            if len(material) < len(effects):
                rest = self._counts(base, effects, chosen, everywhere) - alone
            pressed = np.where(chosen.at_end(self._model.spec.max_count), 0.0, alone)[
                there
            ]
            load[chosen.window] += np.square(pressed).sum(axis=0)
            product[chosen.window] += (pressed * (chosen.measured - rest)[there]).sum(
                axis=0
            )
        variance = (
            _INDEPENDENT_ROWS
            * np.square(self.floor_count.ravel())
            / np.maximum(load, 1e-12)
        )
        known = variance < 0.1**2
        gains = np.ones_like(load)
        if known.sum() < 2:
            return _Gains(gains.reshape(self.floor_count.shape), gains[:0], gains[:0])
        least = product[known] / load[known]
        least /= np.median(least)
        spread = float(np.mean(np.square(least - 1.0) - variance[known]))
        if spread > 0:
            gains[known] = 1.0 + (least - 1.0) * spread / (spread + variance[known])
        gains = np.clip(gains, 0.0, _MOST_GAIN).reshape(self.floor_count.shape)
        return _Gains(gains, least, variance[known])

    def gain_statistics(
        self,
        base: Mapping[str, float],
        effects: Sequence[Effect],
        recordings: Sequence[Recording],
    ) -> GainStatistics:
        """Statistics of the gains of the taxels that ``recordings`` press, with ``effects`` other than a gain map and the always
        fitted numbers ``base``."""
        found = self._gains(
            dict(base),
            [e for e in effects if not isinstance(e, TaxelGainMap)],
            recordings,
        )
        dead, odd = found.least < DEAD_GAIN, odd_cells(found.gains, self.pads)
        alive = np.maximum(found.least[~dead], DEAD_GAIN)
        square = 0.0
        if len(alive) > 1:
            own = found.variance[~dead] / np.square(alive)  # of ln g
            square = max(float(np.var(np.log(alive), ddof=1) - own.mean()), 0.0)
        return GainStatistics(
            log_std=math.sqrt(square),
            num_dead=int(dead.sum()),
            num_taxels=len(dead),
            odd=odd,
        )


def odd_cells(gains: np.ndarray, pads: Sequence[str]) -> str:
    """Text that names pad, row and column of taxels that read nothing, or far more or less than the others, by the ``gains``
    (P, R, C) of a map, which are 1 where nothing pressed; empty if there are none."""
    known = gains[gains != 1.0]
    middle = float(np.median(known)) if known.size else 1.0
    dead, off = (gains != 1.0) & (gains < DEAD_GAIN * middle), np.abs(gains - middle)
    most = (
        max(
            ODD_SPREADS * 1.4826 * float(np.median(np.abs(known - middle))),
            ODD_BY * middle,
        )
        if known.size
        else 0.0
    )
    odd = (gains != 1.0) & ~dead & (off > most)
    named = [
        f"{pad}: {taxel_list(dead[p])} read nothing"
        for p, pad in enumerate(pads)
        if dead[p].any()
    ]
    for p, pad in enumerate(pads):
        if odd[p].any():
            ends = dict.fromkeys(
                f"{end / middle:.2g}"
                for end in (gains[p][odd[p]].min(), gains[p][odd[p]].max())
            )
            named.append(
                f"{pad}: {taxel_list(odd[p])} read {' … '.join(ends)} times as much as the median one"
            )
    return "; ".join(named)


def _shows(cls: type[Effect]) -> bool:
    """Whether an effect changes what pads read in a matched replay, by numbers that can be fitted."""
    if (
        not issubclass(cls, TouchEffect)
        or issubclass(cls, BoardEffect)
        or "pads" not in cls.kinds()
    ):
        return False
    return issubclass(cls, PadFrameEffect) or cls.reading is not Effect.reading


def _rows(frames: np.ndarray) -> np.ndarray:
    """Means of ``FRAMES_A_ROW`` frames (T, …) → rows; frames left over at the end fall away."""
    whole = len(frames) // FRAMES_A_ROW * FRAMES_A_ROW
    return (
        frames[:whole]
        .reshape(-1, FRAMES_A_ROW, *frames.shape[1:])
        .mean(axis=1, dtype=float)
    )


def _still_floor(motions: Sequence[TouchMotion]) -> np.ndarray:
    """(P, R, C) counts: standard deviation of rows that nothing disturbs, from the differences of neighbours, because a zero
    that drifts is no noise; at least rounding."""
    squares, freedom = (
        np.zeros(motions[0].measured.shape[1:]),
        np.zeros((len(motions[0].pads), 1, 1)),
    )
    for motion in motions:
        rows, still = _rows(motion.measured), _rows(motion.undisturbed()) == 1.0
        for p in range(len(motion.pads)):
            both = still[1:, p] & still[:-1, p]
            squares[p] += np.square(np.diff(rows[:, p], axis=0)[both]).sum(axis=0) / 2
            freedom[p] += int(both.sum())
    return np.maximum(np.sqrt(squares / np.maximum(freedom, 1)), 1 / math.sqrt(12))


@dataclass(frozen=True)
class _Repeats:
    """What the repeats of motions differ by, as standard deviations of one recording in counts; 0 without any."""

    taxel_count: np.ndarray
    """(P, R, C) of each taxel, over the rows that a recording keeps."""
    touched_count: float
    """Beyond its noise, of a taxel while the object touches it: openings and places that do not repeat move all of them alike, on
    whatever part of the pad they are."""


def _repeat_floor(motions: Sequence[TouchMotion], still_count: np.ndarray) -> _Repeats:
    """RMS difference of repeats, the second brought to the first's times, over √(1 + the interpolation's gain of noise).

    Args:
        still_count: (P, R, C) noise of a row of each taxel.
    """
    of_name = {motion.name: motion for motion in motions}
    squares, rows, beyond, touches = np.zeros(still_count.shape), 0, 0.0, 0.0
    for one, repeat in repeat_pairs([motion.measurement for motion in motions]):
        first, second = of_name[one.name], of_name[repeat.name]
        time_s = first.time_s.mean(axis=1) + overlay(one, repeat).shift_s
        other_s = second.time_s.mean(axis=1)
        inside = (time_s >= other_s[0]) & (time_s <= other_s[-1])
        after = np.clip(np.searchsorted(other_s, time_s[inside]), 1, len(other_s) - 1)
        share = (time_s[inside] - other_s[after - 1]) / (
            other_s[after] - other_s[after - 1]
        )
        part = share[:, None, None, None]
        laid = second.measured[after - 1] * (1 - part) + second.measured[after] * part
        kept = _kept_rows(_happens(first)[inside])
        difference = _rows(first.measured[inside] - laid)[kept]
        variance = (
            np.square(difference)
            / (1.0 + _noise_gain(share)[kept])[:, None, None, None]
        )
        squares += variance.sum(axis=0)
        rows += len(variance)
        touched = _rows(first.near(0.0)[inside])[kept]
        beyond += float((touched * (variance - np.square(still_count))).sum())
        touches += float(touched.sum())
    if rows == 0:
        return _Repeats(squares, 0.0)
    return _Repeats(
        np.sqrt(squares / rows), math.sqrt(max(beyond, 0.0) / max(touches, 1.0))
    )


def _noise_gain(share: np.ndarray) -> np.ndarray:
    """(S,) variance of a row of frames (T,) that lie at ``share`` between two neighbours each, where a row of the neighbours
    themselves has variance 1: n frames take 1 − w of the first, w of the last, and 1 + a change of w of those between."""
    whole = len(share) // FRAMES_A_ROW * FRAMES_A_ROW
    of_row = share[:whole].reshape(-1, FRAMES_A_ROW)
    between = 1.0 - np.diff(of_row, axis=1)
    ends = np.square(1.0 - of_row[:, 0]) + np.square(of_row[:, -1])
    return (np.square(between).sum(axis=1) + ends) / FRAMES_A_ROW


def _happens(motion: TouchMotion) -> np.ndarray:
    """(T,) bool: something is near a pad, or was in the second before."""
    return np.asarray(~motion.undisturbed(after_s=1.0).all(axis=1))


def _kept_rows(happens: np.ndarray) -> np.ndarray:
    """Numbers of the rows that a recording keeps."""
    in_row = _rows(happens) > 0
    return np.flatnonzero(in_row | (np.arange(len(in_row)) % _SELDOM == 0))


def _pressed(motion: TouchMotion) -> np.ndarray:
    """(P · R · C,) bool: taxels that are pressed long enough for their gain to be known."""
    return ((motion.depth()[0] > _PRESSED_M).sum(axis=0) >= _PRESSED_FRAMES).ravel()


def _span(there: np.ndarray, size: int) -> slice:
    """From the first to the last of these numbers, with the rim."""
    return slice(
        max(int(there.min()) - _RIM, 0), min(int(there.max()) + _RIM + 1, size)
    )

"""Compare touch with the grippers: each pad should read contact while its own gripper holds a part, and only then.

    hold     the gripper's command goes on closing, its state does not: a part is between the fingers
    lag      first contact of the pad − moment at which the gripper came to its held opening

Letters in shapes: T rows.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_dilation, uniform_filter1d

from taccorl.data.command_checks import LAG_SURE, find_lag
from taccorl.data.episode import Episode
from taccorl.data.finding import Finding, finding, listed, not_judged
from taccorl.data.spec import ACTION, STATE
from taccorl.data.timing import runs
from taccorl.data.touch_checks import JUDGE_S, Pad

HOLD_GAP_M = 0.003
"""Least distance of the commanded from the measured opening in a hold [m]: more than the calibration offset, less than in any
firm grip (8 mm is usual)."""
HOLD_SPEED_M_PER_S = 0.010
"""Highest closing speed of a gripper that is stopped by a part [m/s]: it closes freely at 50 to 200 mm/s, and creeps while the
pads yield."""
HOLD_MIN_S = 0.3  # Shortest hold [s]
HOLD_MERGE_S = 0.2  # Longest interruption at which two holds count as one [s]
STOP_BAND_M = 0.001
"""A gripper within this distance of its held opening has reached the part [m]: the pad's rubber yields about as much."""
HOLD_EDGE_S = 0.2
"""Time that is removed from both ends of a hold before its contact is judged [s]: clock errors and creep blur the ends."""
HOLD_SUM_S = 0.3  # Least total time of holds for judging a pad [s]
FEELS, SILENT = 0.8, 0.2
"""A pad reads a hold if it is in contact in more than the first share of the hold's rows; it is silent if in less than the
second share."""
TOUCH_LAG_S = (-0.13, 0.15)
"""Plausible times from the gripper's stop to the first contact [s]. Contact can come first, since pads are soft (the twin's
pads, which yield 1.5 mm at 30 N: 0.06 s earlier for the right hand of assembly_2 and 0.11 s for the left, 0.12 s at most in 95 %
of 20 demonstrations); scans at 100 Hz and drivers make it later."""
TOUCH_LAG_SEARCH_S = 1.5  # Time around the gripper's stop in which the first contact is searched [s]
PAD_LAG_S = 0.1
"""Largest accepted time between the first contacts of the two pads of a gripper [s]: a part may touch one finger first, but not
for three rows of force."""
OPEN_SHARE = 0.8
"""Share of the episode's widest opening above which a gripper is open, so that nothing should touch its pads."""
RELEASE_S = 0.3  # Time after a release that is not used as rest [s]: the sensor's film creeps back
REST_MIN_S = 0.3  # Least time of rest at each end of an episode for judging drift [s]
DRIFT_SHARE = 1 / 3
"""Largest accepted drift in an episode, as a share of the sensor's noise_count (15 counts): a drift of 5 counts is a third of
the contact threshold."""
OFFSET_SHARE = 0.05
"""Largest accepted share of a pad's taxels (19 of 384) that rest above noise_count: residual touch, or single defective taxels.
"""


@dataclass(frozen=True)
class Hold:
    """A period in which a gripper holds a part: first row, end, and when the gripper stopped."""

    first: int
    """First row in which the gripper stands still."""
    end: int
    stop_s: float | None
    """Episode time [s] at which the gripper came within STOP_BAND_M of its held opening; None if the hold began before row 0."""


def find_holds(opening: np.ndarray, command: np.ndarray, fps: int) -> list[Hold]:
    """Return the holds of one gripper, in order, from its ``opening`` (T,) and commanded opening ``command`` (T,), both in m, at
    ``fps`` rows per second."""
    opening, command = opening.astype(float), command.astype(float)
    if len(opening) < 3:
        return []
    speed = np.abs(np.gradient(uniform_filter1d(opening, 3))) * fps
    still = (opening - command > HOLD_GAP_M) & (speed < HOLD_SPEED_M_PER_S)
    for first, end in runs(~still):
        if first > 0 and end < len(still) and end - first <= HOLD_MERGE_S * fps:
            still[first:end] = True
    holds = []
    for first, end in runs(still):
        if end - first < HOLD_MIN_S * fps:
            continue
        held = float(np.median(opening[first:end])) + STOP_BAND_M
        wider = np.flatnonzero(opening[:end] > held)
        wider = wider[wider < (first + end) // 2]
        stop_s = None
        if len(wider) and wider[-1] + 1 < len(opening):
            k = int(wider[-1])
            stop_s = (k + (opening[k] - held) / max(opening[k] - opening[k + 1], 1e-9)) / fps
        holds.append(Hold(first, end, stop_s))
    return holds


@dataclass(frozen=True)
class Grippers:
    """Openings, commands and holds of the grippers in an episode."""

    opening: dict[str, np.ndarray]
    """Arm → (T,) measured opening [m]."""
    holds: dict[str, list[Hold]]

    def held(self, arm: str, *, cut: int = 0, grow: int = 0) -> np.ndarray:
        """(T,) bool: the arm holds a part. Holds are shortened by ``cut`` rows, or lengthened by ``grow`` rows, at both ends."""
        rows = np.zeros(len(self.opening[arm]), dtype=bool)
        for hold in self.holds[arm]:
            rows[max(hold.first + cut - grow, 0) : max(hold.end - cut + grow, 0)] = True
        return rows

    def rest(self, arm: str, fps: int) -> np.ndarray:
        """(T,) bool: the gripper is open, and at least ``RELEASE_S`` have passed since its last release."""
        opening = self.opening[arm]
        closed = self.held(arm) | (opening < OPEN_SHARE * opening.max())
        return ~binary_dilation(closed, np.ones(2 * round(RELEASE_S * fps) + 1, dtype=bool))


def read_grippers(episode: Episode) -> Grippers | None:
    """Read the grippers of an episode; None if state or command have no gripper in m."""
    arms = [arm for arm in episode.arms() if arm.gripper is not None]
    if not arms or not all(np.isfinite(episode.arrays[k]).all() for k in (STATE, ACTION)):
        return None
    opening = {a.name: episode.arrays[STATE][:, a.gripper] for a in arms}
    command = {a.name: episode.arrays[ACTION][:, a.gripper] for a in arms}
    return Grippers(opening, {a: find_holds(opening[a], command[a], episode.spec.fps) for a in opening})


def check_touch_and_grip(episode: Episode, key: str, pads: list[Pad], grippers: Grippers) -> Iterator[Finding]:
    """Compare the pads of the feature ``key`` with the grippers, by all checks."""
    fps, what = episode.spec.fps, "touch against grippers"
    own = [pad for pad in pads if pad.arm in grippers.opening]
    if episode.num_rows < JUDGE_S * fps:
        yield not_judged(key, what, f"{episode.num_rows / fps:.1f} s, it takes {JUDGE_S:g} s")
    elif not own:
        yield not_judged(key, what, f"pads {[p.name for p in pads]} name no arm with a gripper")
    else:
        if any(grippers.holds.values()):
            yield from _check_holds(key, own, grippers, fps)
        else:
            yield not_judged(key, what, "no gripper holds anything (command past a stalled state)")
        yield from _check_drift(key, own, grippers)
        for pad in own:
            yield from _check_offset(key, pad, grippers.rest(pad.arm, fps))


# ---- holds ----


def _share(contact: np.ndarray, rows: np.ndarray, fps: int) -> float:
    """Share of ``rows`` in contact; NaN where they are too few to say."""
    return float(contact[rows].mean()) if rows.sum() >= HOLD_SUM_S * fps else math.nan


def swapped_pads(pads: list[Pad], grippers: Grippers, fps: int) -> list[str] | None:
    """Return the names of pads that read contact during holds of the other arm instead of their own, sorted; None if no arm ever
    holds alone.

    While one arm holds alone, one of its own pads must read nothing and one of the other arm's pads must read contact. If the
    other arm also holds alone at some time, the opposite must be true then.
    """
    if len(grippers.opening) != 2:
        return []
    edge, arms = round(HOLD_EDGE_S * fps), list(grippers.opening)
    alone = {a: grippers.held(a, cut=edge) & ~grippers.held(b, grow=edge) for a, b in (arms, arms[::-1])}
    shares = {(p.name, a): _share(p.contact, rows, fps) for p in pads for a, rows in alone.items()}
    if np.isnan(list(shares.values())).all():
        return None

    def feels(pad: Pad, arm: str) -> bool:
        return shares[pad.name, arm] >= FEELS

    def silent(pad: Pad, arm: str) -> bool:
        return shares[pad.name, arm] <= SILENT

    found: set[str] = set()
    for holding, resting in (arms, arms[::-1]):
        own, others = [p for p in pads if p.arm == holding], [p for p in pads if p.arm == resting]
        absent = [p for p in own if silent(p, holding) and not silent(p, resting)]
        intruding = [p for p in others if feels(p, holding) and not feels(p, resting)]
        if len(intruding) < len(others):  # not all exchanged: an absent pad must at least feel something elsewhere
            absent = [p for p in absent if p.contact.sum() >= HOLD_SUM_S * fps]
        if absent and intruding:
            found |= {p.name for p in absent + intruding}
    return sorted(found)


def _check_holds(key: str, pads: list[Pad], grippers: Grippers, fps: int) -> Iterator[Finding]:
    swapped = swapped_pads(pads, grippers, fps)
    if swapped:  # holds then say nothing about silence or time
        text = (
            f"{listed(swapped)} feel what the other arm's gripper holds, and not what their own holds: topics of left and right "
            "pads exchanged (or of left and right arms, if the pictures agree with the pads); correct `channels` in the "
            "recording spec"
        )
        yield finding("swapped_pads", key, text)
        return
    for check in (_check_silence, _check_lag, _check_pad_lag):
        yield from check(key, pads, grippers, fps)
    if swapped is None:
        yield not_judged(key, "swapped pads", "the grippers hold only at the same time")


def _check_silence(key: str, pads: list[Pad], grippers: Grippers, fps: int) -> Iterator[Finding]:
    held = {a: grippers.held(a, cut=round(HOLD_EDGE_S * fps)) for a in grippers.opening}
    felt = {pad.name: _share(pad.contact, held[pad.arm], fps) for pad in pads}
    judged = [name for name, share in felt.items() if not math.isnan(share)]
    silent = [name for name in judged if felt[name] <= SILENT]
    if silent and len(silent) == len(judged) and not any(pad.contact.any() for pad in pads):
        loudest = max(float(np.abs(p.counts[held[p.arm]]).max()) for p in pads if p.name in silent)
        seconds = sum(float(rows.sum()) for rows in held.values()) / fps
        text = (
            f"grippers hold parts for {seconds:.1f} s and no pad feels anything but noise (up to {loudest:.0f} counts, "
            f"neighbouring taxels unlike each other, or below noise_count {pads[0].noise_count:g}): pads unplugged, wrong wire "
            "layout (rows, columns, transpose), or another recording's touch"
        )
        yield finding("noise_only", key, text)
    elif silent:
        text = (
            f"{listed(silent)} never in contact while the gripper holds a part and other pads feel theirs: pad unplugged, or the "
            "part is held beside it"
        )
        yield finding("silent_pad", key, text)


def touch_lags(pad: Pad, grippers: Grippers, fps: int) -> list[float]:
    """Return the times [s] from the gripper's stop to the pad's first contact, one per hold in which both are found; negative if
    contact comes first."""
    lags, reach, before = [], round(TOUCH_LAG_SEARCH_S * fps), 0
    for hold in grippers.holds[pad.arm]:
        if hold.stop_s is not None:
            stop = round(hold.stop_s * fps)
            onset = _onset(pad, max(stop - reach, before), min(stop + reach, hold.end))
            if onset is not None:
                lags.append(onset / fps - hold.stop_s)
        before = hold.end
    return lags


def _onset(pad: Pad, first: int, end: int) -> float | None:
    """Row, to a fraction, at which the pad begins to feel something that lasts; None if it does already or never does."""
    lasting = [(a, b) for a, b in runs(pad.contact[first:end]) if b - a >= HOLD_SUM_S * pad.fps or b == end - first]
    if not lasting or lasting[0][0] == 0:
        return None
    row = first + lasting[0][0]
    level = pad.smooth[row - 1 : row + 1].max(axis=(1, 2))
    return row - 1 + float(np.clip((pad.noise_count - level[0]) / max(level[1] - level[0], 1e-9), 0.0, 1.0))


def lag_text(lag_s: float) -> str:
    """Text of a lag [s], such as ``0.120 s before`` (negative) or ``0.300 s after``."""
    return f"{abs(lag_s):.3f} s {'before' if lag_s < 0 else 'after'}"


def _check_lag(key: str, pads: list[Pad], grippers: Grippers, fps: int) -> Iterator[Finding]:
    low, high = TOUCH_LAG_S[0] - 1 / fps, TOUCH_LAG_S[1] + 1 / fps
    found = {pad.name: lags for pad in pads if (lags := touch_lags(pad, grippers, fps))}
    odd = {name: lag for name, lags in found.items() if not low <= (lag := float(np.median(lags))) <= high}
    if not odd:
        return
    each = ", ".join(f"{name} {lag_text(lag)}" for name, lag in odd.items())
    # One clock that is off moves all pads the same way. Both ways at once: each feels the other gripper's part.
    exchanged = min(odd.values()) < low and max(odd.values()) > high
    advice = (
        "some are too early and some too late: left and right pads (or the arms' joint topics) exchanged? Correct them in the "
        "spec"
        if exchanged
        else "their clock is off by this time; set `clock` or `latency_s` on these pads' channels"
    )
    text = (
        f"pads first feel the part at odd times from the gripper's stop on it: {each} (plausible {low:.2f} to {high:.2f} s): "
        f"{advice}"
    )
    yield finding("touch_lag", key, text, severity="error" if exchanged else None)


def _check_pad_lag(key: str, pads: list[Pad], grippers: Grippers, fps: int) -> Iterator[Finding]:
    """The two pads of a gripper feel the same part: their total counts must rise and fall together."""
    for arm in sorted(grippers.opening):
        both = [pad for pad in pads if pad.arm == arm and pad.contact.any()]
        if len(both) != 2:
            continue
        totals = [pad.smooth.mean(axis=(1, 2))[:, None] for pad in both]
        lag = find_lag(totals[0], totals[1], fps, (-1.0, 1.0))
        if lag.correlation >= LAG_SURE and abs(lag.lag_s) > PAD_LAG_S:
            first, second = both if lag.lag_s > 0 else both[::-1]
            text = (
                f"{second.name} feels everything {abs(lag.lag_s):.3f} s after {first.name}, though both hold the same part "
                f"(limit {PAD_LAG_S:g} s): one is on another clock, or exchanged with the other gripper's"
            )
            yield finding("pad_lag", key, text)


# ---- rest ----


def rest_change(counts: np.ndarray, rest: np.ndarray, fps: int) -> tuple[float, float] | None:
    """Change of the resting level of ``counts`` (T, R, C) between the first and the last rest [counts], and the time between [s].

    ``rest`` (T,) bool marks the rows at rest. Median over the half of the pad that is touched least: the film under a contact
    creeps. None without rest at both ends.
    """
    found = [r for r in runs(rest) if r[1] - r[0] >= REST_MIN_S * fps]
    if not found:
        return None
    first, last = found[0], found[-1]
    if first == last:
        third = (first[1] - first[0]) // 3
        first, last = (first[0], first[0] + third), (last[1] - third, last[1])
    seconds = (sum(last) - sum(first)) / 2 / fps
    if min(first[1] - first[0], last[1] - last[0]) < REST_MIN_S * fps or seconds < 0.5 * len(counts) / fps:
        return None
    change = counts[slice(*last)].mean(axis=0) - counts[slice(*first)].mean(axis=0)
    peak = counts.max(axis=0)
    return float(np.median(change[peak <= np.median(peak)])), seconds


def rest_level(counts: np.ndarray, rest: np.ndarray, fps: int) -> float | None:
    """Median resting level [counts] of ``counts`` (T, R, C) in the episode's first stretch of ``rest`` (T,) bool; None without
    one."""
    found = [r for r in runs(rest) if r[1] - r[0] >= REST_MIN_S * fps]
    return float(np.median(counts[slice(*found[0])].mean(axis=0))) if found else None


def _check_drift(key: str, pads: list[Pad], grippers: Grippers) -> Iterator[Finding]:
    found = {pad.name: rest_change(pad.counts, grippers.rest(pad.arm, pad.fps), pad.fps) for pad in pads}
    unknown = [name for name, change in found.items() if change is None]
    limit = DRIFT_SHARE * pads[0].noise_count
    drifting = {name: change for name, change in found.items() if change is not None and abs(change[0]) > limit}
    if drifting:
        each = ", ".join(f"{n} {c:+.1f} counts in {s:.1f} s ({c / s:+.2f} counts/s)" for n, (c, s) in drifting.items())
        text = (
            f"untouched taxels drift: {each}; limit {limit:g} counts an episode, a third of noise_count: warm up the pads, take "
            "a new baseline for each recording"
        )
        yield finding("baseline_drift", key, text)
    if unknown:
        why = "the gripper does not rest open at both ends"
        yield not_judged(key, f"baseline drift of {listed(unknown)}", why)


def _check_offset(key: str, pad: Pad, rest: np.ndarray) -> Iterator[Finding]:
    if rest.sum() < REST_MIN_S * pad.fps:
        return
    level = np.median(pad.counts[rest], axis=0)
    off = (np.abs(level) > pad.noise_count) & ~pad.stuck
    if off.mean() > OFFSET_SHARE:
        middle = float(np.median(level[off]))
        why = "touched while the baseline was taken" if middle < 0 else "still touched, or drifted"
        text = (
            f"{pad.name}: {int(off.sum())} taxels rest at {middle:+.0f} counts (median) with the gripper open: {why}; record "
            "with the pads free for the first second"
        )
        yield finding("baseline_offset", key, text)

"""Compare touch with the grippers: each pad should read contact while its own gripper holds a part, and only then.

    hold     the gripper's command goes on closing, its state does not: a part is between the fingers
    lag      first contact of the pad − moment at which the gripper came to its held opening

Shapes: T rows.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_dilation, uniform_filter1d

from taccorl.data.episode import Episode
from taccorl.data.finding import Finding, finding, listed, not_judged
from taccorl.data.joint_checks import LAG_SURE, find_lag
from taccorl.data.spec import ACTION, STATE
from taccorl.data.timing import runs
from taccorl.data.touch_checks import JUDGE_S, Pad

HOLD_GAP_M = 0.003  # Least commanded past the measured opening in a hold [m]: above offsets, below any firm grip (8 mm)
HOLD_SPEED_M_PER_S = 0.010
"""Highest closing speed of a stopped gripper [m/s]: free 50 to 200 mm/s; it creeps as pads yield."""
HOLD_MIN_S = 0.3  # Shortest hold [s]
HOLD_MERGE_S = 0.2  # Longest interruption at which two holds count as one [s]
STOP_BAND_M = 0.001
"""Within this distance of its held opening a gripper has reached the part [m]: rubber yields as much."""
HOLD_EDGE_S = 0.2  # Time removed from both ends of a hold before its contact is judged [s]: clock errors and creep
HOLD_SUM_S = 0.3  # Least total time of holds for judging a pad [s]
OPEN_SHARE = 0.8  # Share of the episode's widest opening above which nothing should touch a gripper's pads
RELEASE_S = 0.3  # Time after a release that is not used as rest [s]: the sensor's film creeps back


class Hold(NamedTuple):
    """A period in which a gripper holds a part: first row, end, and when it came within ``STOP_BAND_M`` of its held opening
    [s]; None if the hold began before row 0."""

    first: int
    end: int
    stop_s: float | None


def find_holds(opening: np.ndarray, command: np.ndarray, fps: int) -> list[Hold]:
    """Holds of one gripper, in order, from its ``opening`` (T,) and commanded opening ``command`` (T,) [m]."""
    opening, command = opening.astype(float), command.astype(float)
    if len(opening) < 3:
        return []
    speed = np.abs(np.gradient(uniform_filter1d(opening, 3))) * fps
    still = (opening - command > HOLD_GAP_M) & (speed < HOLD_SPEED_M_PER_S)
    for first, end in runs(~still):
        if first > 0 and end < len(still) and end - first <= HOLD_MERGE_S * fps:
            still[first:end] = True
    holds = []
    for first, end in (
        run for run in runs(still) if run[1] - run[0] >= HOLD_MIN_S * fps
    ):
        held, stop_s = float(np.median(opening[first:end])) + STOP_BAND_M, None
        wider = np.flatnonzero(opening[: min(end, (first + end) // 2)] > held)
        if len(wider) and wider[-1] + 1 < len(opening):
            k = int(wider[-1])
            stop_s = (
                k + (opening[k] - held) / max(opening[k] - opening[k + 1], 1e-9)
            ) / fps
        holds.append(Hold(first, end, stop_s))
    return holds


class Grippers(NamedTuple):
    """Arm → (T,) measured opening [m], and its holds."""

    opening: dict[str, np.ndarray]
    holds: dict[str, list[Hold]]

    def held(self, arm: str, *, cut: int = 0) -> np.ndarray:
        """(T,) bool: the arm holds a part; holds are shortened by ``cut`` rows at both ends, or lengthened by −``cut``."""
        rows = np.zeros(len(self.opening[arm]), dtype=bool)
        for hold in self.holds[arm]:
            rows[max(hold.first + cut, 0) : max(hold.end - cut, 0)] = True
        return rows

    def rest(self, arm: str, fps: int) -> np.ndarray:
        """(T,) bool: the gripper is open, and at least ``RELEASE_S`` have passed since its last release."""
        opening = self.opening[arm]
        closed = self.held(arm) | (opening < OPEN_SHARE * opening.max())
        return ~binary_dilation(
            closed, np.ones(2 * round(RELEASE_S * fps) + 1, dtype=bool)
        )


def read_grippers(episode: Episode) -> Grippers | None:
    """The grippers of an episode; None if state or command have no gripper in m."""
    arms = [arm for arm in episode.arms() if arm.gripper is not None]
    if not arms or not all(
        np.isfinite(episode.arrays[k]).all() for k in (STATE, ACTION)
    ):
        return None
    opening, command = (
        {a.name: episode.arrays[key][:, a.gripper] for a in arms}
        for key in (STATE, ACTION)
    )
    return Grippers(
        opening,
        {a: find_holds(opening[a], command[a], episode.spec.fps) for a in opening},
    )


def check_touch_and_grip(
    episode: Episode, key: str, pads: list[Pad]
) -> Iterator[Finding]:
    """Compare the pads of the feature ``key`` with the grippers, by all checks."""
    fps, what, grippers = (
        episode.spec.fps,
        "touch against grippers",
        read_grippers(episode),
    )
    own = [pad for pad in pads if grippers and pad.arm in grippers.opening]
    if grippers is None:
        yield not_judged(
            key, what, "state and action have no number in m that is named `gripper`"
        )
    elif episode.num_rows < JUDGE_S * fps:
        yield not_judged(
            key, what, f"{episode.num_rows / fps:.1f} s, it takes {JUDGE_S:g} s"
        )
    elif not own:
        yield not_judged(
            key, what, f"pads {[p.name for p in pads]} name no arm with a gripper"
        )
    else:
        if not any(grippers.holds.values()):
            yield not_judged(
                key, what, "no gripper holds anything (command past a stalled state)"
            )
        elif swapped := swapped_pads(
            own, grippers, fps
        ):  # holds then say nothing about silence or time
            text = f"{listed(swapped)} feel what the other arm's gripper holds, and not what their own holds: left and "
            text += "right pads exchanged (or the arms, if the pictures agree with the pads); correct `channels` in "
            yield finding("swapped_pads", key, f"{text}the recording spec")
        else:
            for compare in (_silent, _touch_lag, _pad_lag):
                yield from compare(key, own, grippers, fps)
            if swapped is None:
                yield not_judged(
                    key, "swapped pads", "the grippers hold only at the same time"
                )
        for compare in (_drift, _offset):
            yield from compare(key, own, grippers, fps)


# ---- holds ----

FEELS, SILENT = (
    0.8,
    0.2,
)  # A pad reads a hold if in contact in more of its rows; is silent in less than that share
TOUCH_LAG_S = (-0.13, 0.15)
"""Plausible times from the gripper's stop to the first contact [s]. Contact can come first, since pads are soft (the twin's pads,
1.5 mm at 30 N: 0.06 and 0.11 s for the hands of assembly_2, 0.12 s at most in 95 % of 20 demonstrations); scans at 100 Hz and
drivers make it later."""
TOUCH_LAG_SEARCH_S = (
    1.5  # Time around the gripper's stop in which the first contact is searched [s]
)
PAD_LAG_S = 0.1  # Largest time between first contacts of a gripper's pads [s]: one first, but not for three rows
PAD_LAG_LEAVES = 0.5  # Most of what the best shift within that time leaves that a lag leaves: short stretches fit many


def _share(contact: np.ndarray, rows: np.ndarray, fps: int) -> float:
    """Share of ``rows`` in contact; NaN where they are too few to say."""
    return float(contact[rows].mean()) if rows.sum() >= HOLD_SUM_S * fps else math.nan


def swapped_pads(pads: list[Pad], grippers: Grippers, fps: int) -> list[str] | None:
    """Sorted names of pads that read contact during holds of the other arm instead of their own; None if no arm ever holds
    alone. While one arm holds alone, one of its own pads must read nothing and one of the other arm's must read contact; if the
    other arm also holds alone at some time, the opposite must be true then."""
    if len(grippers.opening) != 2:
        return []
    edge, arms = round(HOLD_EDGE_S * fps), list(grippers.opening)
    alone = {
        a: grippers.held(a, cut=edge) & ~grippers.held(b, cut=-edge)
        for a, b in (arms, arms[::-1])
    }
    shares = {
        (p.name, a): _share(p.contact, rows, fps)
        for p in pads
        for a, rows in alone.items()
    }
    if np.isnan(list(shares.values())).all():
        return None
    feels = {key: share >= FEELS for key, share in shares.items()}
    silent = {key: share <= SILENT for key, share in shares.items()}
    found: set[str] = set()
    for holding, resting in (arms, arms[::-1]):
        others = [p for p in pads if p.arm == resting]
        absent = [
            p
            for p in pads
            if p.arm == holding
            and silent[p.name, holding]
            and not silent[p.name, resting]
        ]
        intruding = [
            p for p in others if feels[p.name, holding] and not feels[p.name, resting]
        ]
        if len(intruding) < len(
            others
        ):  # not all exchanged: an absent pad must at least feel something elsewhere
            absent = [p for p in absent if p.contact.sum() >= HOLD_SUM_S * fps]
        found |= {p.name for p in absent + intruding} if absent and intruding else set()
    return sorted(found)


def _silent(
    key: str, pads: list[Pad], grippers: Grippers, fps: int
) -> Iterator[Finding]:
    held = {a: grippers.held(a, cut=round(HOLD_EDGE_S * fps)) for a in grippers.opening}
    shares = {pad.name: _share(pad.contact, held[pad.arm], fps) for pad in pads}
    judged = {name: share for name, share in shares.items() if not math.isnan(share)}
    silent = [name for name, share in judged.items() if share <= SILENT]
    if (
        silent
        and len(silent) == len(judged)
        and not any(pad.contact.any() for pad in pads)
    ):
        loudest = max(
            float(np.abs(p.counts[held[p.arm]]).max()) for p in pads if p.name in silent
        )
        text = f"grippers hold parts for {sum(rows.sum() for rows in held.values()) / fps:.1f} s and no pad feels "
        text += f"anything but noise (up to {loudest:.0f} counts, neighbours unlike each other, or below noise_count "
        text += f"{pads[0].noise_count:g}): pads unplugged, wrong wire layout (rows, columns, transpose), or another's "
        yield finding("noise_only", key, f"{text}touch")
    elif silent:
        text = f"{listed(silent)} never in contact while the gripper holds a part and other pads feel theirs: pad "
        yield finding(
            "silent_pad", key, f"{text}unplugged, or the part is held beside it"
        )


def touch_lags(pad: Pad, grippers: Grippers, fps: int) -> list[float]:
    """Times [s] from the gripper's stop to the pad's first contact, one per hold in which both are found; negative if contact
    comes first."""
    lags, reach, before = [], round(TOUCH_LAG_SEARCH_S * fps), 0
    for hold in grippers.holds[pad.arm]:
        if hold.stop_s is not None:
            stop = round(hold.stop_s * fps)
            first, end = max(stop - reach, before), min(stop + reach, hold.end)
            long = [
                (a, b)
                for a, b in runs(pad.contact[first:end])
                if b - a >= HOLD_SUM_S * fps or b == end - first
            ]
            if (
                long and long[0][0] > 0
            ):  # it begins to feel something that lasts, at a fraction of a row
                row = first + long[0][0]
                level = pad.smooth[row - 1 : row + 1].max(axis=(1, 2))
                part = float(
                    np.clip(
                        (pad.noise_count - level[0]) / max(level[1] - level[0], 1e-9),
                        0.0,
                        1.0,
                    )
                )
                lags.append((row - 1 + part) / fps - hold.stop_s)
        before = hold.end
    return lags


def odd_lags(
    lags: dict[str, list[float]], tolerance_s: float = 0.0, least: int = 1
) -> tuple[dict[str, float], str]:
    """Pads whose median lag is not plausible [s], and the text that names them; ``least``: fewest lags of a pad."""
    low, high = TOUCH_LAG_S[0] - tolerance_s, TOUCH_LAG_S[1] + tolerance_s
    medians = {
        name: float(np.median(found))
        for name, found in lags.items()
        if len(found) >= least
    }
    odd = {name: lag for name, lag in medians.items() if not low <= lag <= high}
    each = ", ".join(
        f"{name} {abs(lag):.3f} s {'before' if lag < 0 else 'after'}"
        for name, lag in odd.items()
    )
    what = "pads first feel the part at odd times from the gripper's stop on it"
    return odd, f"{what}: {each} (medians; plausible {low:.2f} to {high:.2f} s)"


def _touch_lag(
    key: str, pads: list[Pad], grippers: Grippers, fps: int
) -> Iterator[Finding]:
    odd, text = odd_lags(
        {pad.name: touch_lags(pad, grippers, fps) for pad in pads}, 1 / fps
    )
    # One clock that is off moves all pads the same way. Both ways at once: each feels the other gripper's part.
    if odd and min(odd.values()) < 0 < max(odd.values()):
        text += ": some too early and some too late: left and right pads (or the arms' joint topics) exchanged? "
        yield finding("touch_lag", key, f"{text}Correct the spec", severity="error")
    elif odd:
        text += ": their clock is off by this time; set `clock` or `latency_s` on these pads' channels"
        yield finding("touch_lag", key, text)


def _pad_lag(
    key: str, pads: list[Pad], grippers: Grippers, fps: int
) -> Iterator[Finding]:
    """The two pads of a gripper feel the same part: their total counts must rise and fall together."""
    for arm in sorted(grippers.opening):
        both = [pad for pad in pads if pad.arm == arm and pad.contact.any()]
        if len(both) != 2:
            continue
        one, other = (pad.smooth.mean(axis=(1, 2))[:, None] for pad in both)
        lag, near = (find_lag(one, other, fps, (-far, far)) for far in (1.0, PAD_LAG_S))
        left, near_left = (
            1.0 - lag.correlation**2,
            1.0 - max(near.correlation, 0.0) ** 2,
        )
        if (
            lag.correlation >= LAG_SURE
            and abs(lag.lag_s) > PAD_LAG_S
            and left < PAD_LAG_LEAVES * near_left
        ):
            first, second = both if lag.lag_s > 0 else both[::-1]
            text = f"{second.name} feels everything {abs(lag.lag_s):.3f} s after {first.name}, though both hold the "
            text += f"same part (limit {PAD_LAG_S:g} s): one is on another clock, or "
            yield finding("pad_lag", key, f"{text}exchanged with the other gripper's")


# ---- rest ----

REST_MIN_S = 0.3  # Least time of rest at each end of an episode for judging drift [s]
DRIFT_SHARE = 1 / 3
"""Largest accepted drift in an episode, as a share of noise_count (15): a third of the contact threshold."""
OFFSET_SHARE = 0.05  # Largest share of taxels (19 of 384) that rest above noise_count: residual touch, single defects


def rest_change(
    counts: np.ndarray, rest: np.ndarray, fps: int
) -> tuple[float, float] | None:
    """Change of the resting level of ``counts`` (T, R, C) between the first and the last ``rest`` (T,) bool [counts], and the
    time between [s]; None without rest at both ends. Median over the half of the pad that is touched least: the film creeps."""
    found = [r for r in runs(rest) if r[1] - r[0] >= REST_MIN_S * fps]
    if not found:
        return None
    first, last = found[0], found[-1]
    if first == last:
        third = (first[1] - first[0]) // 3
        first, last = (first[0], first[0] + third), (last[1] - third, last[1])
    seconds = (sum(last) - sum(first)) / 2 / fps
    if (
        min(first[1] - first[0], last[1] - last[0]) < REST_MIN_S * fps
        or seconds < 0.5 * len(counts) / fps
    ):
        return None
    change = counts[slice(*last)].mean(axis=0) - counts[slice(*first)].mean(axis=0)
    peak = counts.max(axis=0)
    return float(np.median(change[peak <= np.median(peak)])), seconds


def rest_level(counts: np.ndarray, rest: np.ndarray, fps: int) -> float | None:
    """Median of ``counts`` (T, R, C) in the first stretch of ``rest`` (T,) bool; None without one."""
    found = [r for r in runs(rest) if r[1] - r[0] >= REST_MIN_S * fps]
    return float(np.median(counts[slice(*found[0])].mean(axis=0))) if found else None


def _drift(
    key: str, pads: list[Pad], grippers: Grippers, fps: int
) -> Iterator[Finding]:
    found = {
        pad.name: rest_change(pad.counts, grippers.rest(pad.arm, fps), fps)
        for pad in pads
    }
    limit = DRIFT_SHARE * pads[0].noise_count
    drifting = {
        name: change
        for name, change in found.items()
        if change is not None and abs(change[0]) > limit
    }
    if drifting:
        each = ", ".join(
            f"{n} {c:+.1f} counts in {s:.1f} s ({c / s:+.2f} counts/s)"
            for n, (c, s) in drifting.items()
        )
        text = f"untouched taxels drift: {each}; limit {limit:g} counts an episode, a third of noise_count: warm up "
        yield finding(
            "baseline_drift",
            key,
            f"{text}the pads, take a new baseline for each recording",
        )
    if unknown := [name for name, change in found.items() if change is None]:
        yield not_judged(
            key,
            f"baseline drift of {listed(unknown)}",
            "the gripper does not rest open at both ends",
        )


def _offset(
    key: str, pads: list[Pad], grippers: Grippers, fps: int
) -> Iterator[Finding]:
    for pad in pads:
        rest = grippers.rest(pad.arm, fps)
        level = (
            np.median(pad.counts[rest], axis=0)
            if rest.sum() >= REST_MIN_S * fps
            else np.zeros(pad.stuck.shape)
        )
        off = (np.abs(level) > pad.noise_count) & ~pad.stuck
        if off.mean() > OFFSET_SHARE:
            middle = float(np.median(level[off]))
            why = (
                "touched while the baseline was taken"
                if middle < 0
                else "still touched, or drifted"
            )
            text = f"{pad.name}: {off.sum()} taxels rest at {middle:+.0f} counts (median) with the gripper open: "
            yield finding(
                "baseline_offset",
                key,
                f"{text}{why}; record with the pads free for the first second",
            )

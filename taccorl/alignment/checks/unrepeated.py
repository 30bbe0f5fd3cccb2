"""Differences between repeats of one motion, per signal: size, time, and whether dropped commands explain them.

    ratio       RMS difference of repeats, divided by the noise from rest, residue and rounding
    bursts      the smallest share of half-second blocks that holds 80 % of the squared difference
    dropped     pulses that point backwards along the motion, found by ``held_commands`` in every recording

What differs until a joint that rested elsewhere is moved is left out. With a ratio above 3 the floor from repeats would hide a
missing effect of that size, whatever its cause. Dropped commands are reported where pulses of the right sign clearly outnumber
those of the opposite sign; a disturbance torque or dry friction produces both alike. Events that gather at one place between two
turns of the target are play or sticking.

Letters in shapes: T rows, J signals, B blocks of rows.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from taccorl.alignment.checks.held_commands import Dropped, find_dropped
from taccorl.alignment.checks.registry import check, find
from taccorl.alignment.measurements.correlation import BLOCK_S
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.alignment.measurements.noise_floor import (
    BURST_POWER,
    BURST_SHARE,
    DISAGREE,
    SignalFloor,
    laid_pairs,
    noise_floor,
    without_beginning,
)
from taccorl.alignment.measurements.repeats import overlay
from taccorl.data.finding import Finding, not_judged
from taccorl.errors import TaccorlError

MOST_TIMES = 5  # Most times that a text lists


class Block(NamedTuple):
    """Difference of two recordings of one motion within ``BLOCK_S``."""

    rms: float  # RMS of the difference / √2 [rad, m]
    first: str
    second: str  # Name of the recording that repeats it
    begin_s: float  # Start of the block in the first recording [s]
    end_s: float  # End of the block in the first recording [s]


class Pair(NamedTuple):
    """Two recordings of one motion: their names, times in the first (T,) [s], and difference of one signal (T,) [rad, m]."""

    first: str
    second: str
    time_s: np.ndarray
    difference: np.ndarray

    def blocks(self) -> Iterator[Block]:
        """Differences in blocks of ``BLOCK_S``."""
        rows = max(2, round(BLOCK_S / float(np.median(np.diff(self.time_s)))))
        for k in range(0, len(self.time_s) - rows + 1, rows):
            own = self.difference[k : k + rows]
            rms = (
                float(np.sqrt(0.5 * np.nanmean(own**2)))
                if np.isfinite(own).any()
                else 0.0
            )
            yield Block(
                rms,
                self.first,
                self.second,
                float(self.time_s[k]),
                float(self.time_s[k + rows - 1]),
            )


@check("error", "clock_rate")
def check_clock_rates(
    measurements: Sequence[Measurement],
) -> Iterator[tuple[str, Finding]]:
    """Recordings that differ from others of their motion by the rate of their clock: the commands agree once the times of one are
    multiplied by a factor. The usual rate is the median of the motion, of two recordings that of rows of the whole set."""
    groups: dict[str, list[Measurement]] = {}
    for m in measurements:
        groups.setdefault(m.repeat_of or m.name, []).append(m)
    rows_s = float(np.median([m.period_s for m in measurements] or [0.0]))
    for group in groups.values():
        lasts_s = np.array([_lasts_s(m) for m in group])
        if len(group) == 2:  # the one whose rows are as elsewhere, else the first
            off = [abs(m.period_s - rows_s) for m in group]
            usual_s = lasts_s[int(off[1] < off[0])]
        else:
            usual_s = float(np.median(lasts_s))
        usual = group[int(np.abs(lasts_s - usual_s).argmin())]
        for m, own_s in zip(group, lasts_s, strict=True):
            factor = usual_s / own_s if own_s > 0.0 else 1.0
            stretched = dataclasses.replace(m, time_s=m.time_s * factor)
            if m is usual or _agree(usual, m) or not _agree(usual, stretched):
                continue
            text = (
                f"its commands last {own_s:.3f} s, those of {usual.name}, the same ones, {usual_s:.3f} s: the clock of one of "
                f"the two runs at another rate. Multiply the times of {m.name} by {factor:.5g} if that of {usual.name} is "
                "right, or log both by one clock"
            )
            yield m.name, find("clock_rate", "time", text)


def _lasts_s(m: Measurement) -> float:
    """Time from the first change of a target to the last one [s]; 0 without any."""
    rows = np.flatnonzero(np.any(np.diff(m.target, axis=0) != 0.0, axis=1))
    return float(m.time_s[rows[-1]] - m.time_s[rows[0]]) if len(rows) else 0.0


def _agree(a: Measurement, b: Measurement) -> bool:
    """Whether the commands of two recordings are the same ones at the same times."""
    try:
        overlay(a, b)
    except TaccorlError:
        return False
    return True


@check("warning", "dropped_commands", "does_not_repeat", "drift")
@check("note", "not_judged")
def check_repeatability(
    measurements: Sequence[Measurement],
) -> Iterator[tuple[str, Finding]]:
    """Recordings with dropped commands, and those that differ by far more than their noise from one that they repeat: name, and
    finding; each signal's under the recording that shows it most. A note under the first one if there are no repeats. ``drift``,
    which needs a model, is found by machines (``diagnosis.search.drift``)."""
    groups: dict[tuple[str, ...], list[Measurement]] = {}
    for m in measurements:
        groups.setdefault(m.signals, []).append(m)
    for group in groups.values():
        name, what = group[0].name, "what the robot does not repeat"
        try:
            pairs, floors = laid_pairs(group), noise_floor(group)
        except TaccorlError as error:
            yield name, not_judged("", what, str(error))
            continue
        # Without logged targets the measured position is the input: repeats with other positions were another motion.
        moved = [
            s
            for s in floors
            if any(np.ptp(m.target[:, m.column(s)]) > 0 for m in group)
        ]
        moved = [s for s in moved if group[0].target_kind(s) != "effort"]
        differences: dict[str, list[Pair]] = {signal: [] for signal in moved}
        for a, b, laid in pairs:
            later = without_beginning(laid.difference["position"], a.rate_hz)
            for signal, own in differences.items():
                own.append(
                    Pair(a.name, b.name, laid.time_s, later[:, a.column(signal)])
                )
        if moved and not any(
            np.isfinite(pair.difference).any()
            for own in differences.values()
            for pair in own
        ):
            held = (
                "; until then models of torque targets are held near the measured position"
                * group[0].held
            )
            why = "of the recordings without errors none repeats another (repeat_of). Record one motion twice"
            yield name, not_judged("", what, why + held)
        for signal, own in differences.items():
            dropped = find_dropped(group, group[0].column(signal))
            certain = dropped is not None and dropped.certain
            if dropped is not None and certain:
                yield _dropped(signal, dropped)
            unit = "mrad" if group[0].units[group[0].column(signal)] == "rad" else "mm"
            yield from _unrepeated(signal, unit, own, floors[signal], certain)


def _dropped(signal: str, d: Dropped) -> tuple[str, Finding]:
    worst, times_s = max(d.times_s.items(), key=lambda item: len(item[1]))
    where = ", ".join(f"{t:.2f}" for t in times_s[:MOST_TIMES])
    more = f" and {len(times_s) - MOST_TIMES} more" if len(times_s) > MOST_TIMES else ""
    text = (
        f"{signal}: commands were dropped or repeated: {d.found} times in {len(d.times_s)} recordings the joint moved as if "
        f"the previous target stayed in force for {d.held / d.found:.1f} commands on average ({d.mirrored} events of the "
        f"opposite sign, which only noise and unmodelled physics produce); at least {d.rate:.1%} of {d.commands} commands. In "
        f"{worst} at {where} s{more}. Of the twin's effects only dropped_commands does that: look for lost frames on the bus "
        "(taccorl ingest inspect, candump) or a driver that skips commands when its queue is full"
    )
    return worst, find("dropped_commands", signal, text)


def _unrepeated(
    signal: str, unit: str, pairs: Sequence[Pair], floor: SignalFloor, certain: bool
) -> Iterator[tuple[str, Finding]]:
    """The difference of repeats of one signal, if it is more than ``DISAGREE`` times the signal's noise without use of repeats:
    the largest of the estimates from rest, from the high-frequency residue and from rounding. ``unit``: a thousandth of the unit
    of its position. ``certain``: dropped commands explain it."""
    quiet = floor.quiet
    squares = np.concatenate([np.empty(0), *(pair.difference**2 for pair in pairs)])
    repeats = (
        float(np.sqrt(np.nanmean(squares) / 2)) if np.isfinite(squares).any() else 0.0
    )
    odd = dict(next((e.left_out for e in floor.estimates if e.method == "repeats"), ()))
    if repeats <= DISAGREE * quiet and not odd:
        return
    blocks = sorted((block for pair in pairs for block in pair.blocks()), reverse=True)
    worst = blocks[0] if blocks else pairs[0]
    power = np.cumsum([block.rms**2 for block in blocks])
    count = (
        int(np.searchsorted(power, BURST_POWER * power[-1])) + 1
        if len(power) and power[-1] > 0
        else 0
    )
    share = count / len(blocks) if count else 1.0
    bursts = [block for block in blocks[:count] if block.rms > DISAGREE * quiet]
    if odd:
        each = (
            f"{p.second} from {p.first} {odd[p.second]:.0f} times"
            for p in pairs
            if p.second in odd
        )
        how = f"{', '.join(each)} as much as the other repeats, so that the noise floor is {floor.words()}"
    elif share < BURST_SHARE and bursts:
        some = ", ".join(
            f"{b.begin_s:.2f} to {b.end_s:.2f} s" for b in bursts[:MOST_TIMES]
        )
        how = (
            f"in bursts: {share:.0%} of the time holds {BURST_POWER:.0%} of it ({bursts[0].first} against {bursts[0].second}: "
            f"{some}; up to {bursts[0].rms * 1e3:.3g} {unit}). The noise floor leaves the bursts out"
        )
    else:
        how = (
            f"all the time ({share:.0%} of it holds {BURST_POWER:.0%}), most {worst.second} from {worst.first}. The noise floor "
            f"contains it{' and is not known' * floor.is_unknown}, so a missing effect below that is not found: record a third, "
            "or if one of the two is wrong, remove that `repeat_of`"
        )
    cause = (
        "dropped commands explain it (see dropped_commands)"
        if certain
        else "dropped commands were searched for and do not explain it: a disturbance torque, dry friction, slip, "
        "two clocks, or a number that changes with time, which diagnose names"
    )
    text = (
        f"{signal} does not repeat: two recordings of one motion differ by {repeats * 1e3:.3g} {unit}, {repeats / quiet:.1f} "
        f"times the noise of {quiet * 1e3:.3g} {unit} at rest and between rows, {how}; {cause}"
    )
    yield next(iter(odd), worst.second), find("does_not_repeat", signal, text)

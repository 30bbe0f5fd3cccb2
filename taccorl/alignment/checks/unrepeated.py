"""Differences between repeats of one motion, per signal: size, time, and whether dropped commands explain them.

    ratio       RMS difference of repeats, divided by the noise from rest, residue and rounding
    bursts      the smallest share of half-second blocks that holds 80 % of the squared difference
    dropped     pulses that point backwards along the motion, found by ``held_commands`` in every recording

With a ratio above 3 the floor from repeats would hide a missing effect of that size, whatever its cause. Dropped commands
are reported where pulses of the right sign clearly outnumber those of the opposite sign; a disturbance torque or dry friction
produces both alike. Events that gather where the target turns are play or sticking.

Letters in shapes: T rows, J signals, B blocks of rows.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import binom

from taccorl.alignment.checks.held_commands import HeldCommands, find_held_commands
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.alignment.measurements.noise_floor import noise_floor, repeat_pairs
from taccorl.alignment.measurements.repeats import overlay
from taccorl.data.finding import Finding, not_judged
from taccorl.errors import TaccorlError

DISAGREE = 3.0
"""Ratio of the floor from repeats to the floor from rest, residue or rounding above which they disagree."""
BLOCK_S = 0.5
"""Length of a block in which the difference of two repeats is measured [s]."""
BURST_POWER, BURST_SHARE = 0.8, 0.25
"""A difference is intermittent if the first share of its square lies in less than the second share of the time."""
LEAST_EVENTS, MIRRORED = 6, 4
"""Dropped commands are reported from ``LEAST_EVENTS`` + ``MIRRORED`` × events of the opposite sign on: an effect
that makes the joint lag (a torque limit) leaves up to four that are none."""
BY_CHANCE = 0.01
"""Holds are taken for play or sticking friction, not for dropped commands, if commands dropped at random times would put as
many of them at turns of the target with a probability below this."""
MOST_TIMES = 5
"""Most times that a text lists."""


@dataclass(frozen=True, kw_only=True)
class Burst:
    """Period in which two recordings of one motion differ most."""

    first: str
    """Name of the first recording."""
    second: str
    """Name of the recording that repeats it."""
    begin_s: float
    """Start of the burst in the first recording [s]."""
    end_s: float
    """End of the burst in the first recording [s]."""
    rms: float
    """RMS of the difference / √2 [rad, m]."""


@dataclass(frozen=True, kw_only=True)
class Dropped:
    """Dropped commands of one signal in all recordings."""

    times_s: dict[str, tuple[float, ...]]
    """Recording → times at which a previous target stayed in force."""
    hold_rows: float
    """Mean length of a hold, in commands."""
    commands: int
    """Number of changes of the command that were searched."""
    found: int
    """Number of dropped commands that were found in all recordings."""
    mirrored: int
    """Number of events of the opposite sign, which estimates that of false events."""
    holds: int
    """Number of holds: times in which the joint follows an old command. Commands dropped one after the other are one hold."""
    at_turns: int
    """Number of holds that lie where the target changes direction or begins to move."""
    turn_share: float
    """Share of all updates of the command at which a hold of these lengths would lie at a turn: the probability for one hold if
    commands were dropped at random times."""

    @property
    def certain(self) -> bool:
        """True if pulses of the right sign clearly outnumber those of the opposite sign and do not gather where the target turns,
        so that commands were dropped. Play and sticking hold a joint where its target turns."""
        gathered = binom.sf(self.at_turns - 1, self.holds, self.turn_share) < BY_CHANCE
        return self.found >= LEAST_EVENTS + MIRRORED * self.mirrored and not gathered

    @property
    def rate(self) -> float:
        """Share of commands that were found dropped. It is a lower bound, because slow motion does not show them."""
        return self.found * self.hold_rows / max(self.commands, 1)


@dataclass(frozen=True, kw_only=True)
class Unrepeated:
    """Differences between repeats of one signal."""

    signal: str
    """Name of the signal."""
    unit: str
    """Unit of its position, rad or m."""
    repeats: float | None
    """RMS difference of repeats / √2 [rad, m]; None without repeats."""
    quiet: float
    """Noise of the signal without use of repeats: the largest of the estimates from rest, from the high-frequency residue and
    from rounding [rad, m]."""
    burst_share: float | None
    """Share of the time that holds ``BURST_POWER`` of the squared difference; None without repeats."""
    bursts: tuple[Burst, ...]
    """Blocks that together hold that share, the largest first; of them those whose RMS is more than 3 times ``quiet``."""
    dropped: Dropped | None
    """Dropped commands; None if they could not be searched."""

    @property
    def ratio(self) -> float | None:
        """``repeats`` / ``quiet``; None without repeats."""
        return None if self.repeats is None else self.repeats / self.quiet

    @property
    def disagree(self) -> bool:
        """True if ``ratio`` is above 3: the repeats differ by more than the signal's noise."""
        return self.ratio is not None and self.ratio > DISAGREE

    @property
    def intermittent(self) -> bool:
        """True if most of the squared difference lies in a short part of the time."""
        return self.burst_share is not None and self.burst_share < BURST_SHARE


def unrepeated(measurements: Sequence[Measurement]) -> list[Unrepeated]:
    """Differences between repeats for every signal that is commanded to move and was measured, one item per signal."""
    measurements = list(measurements)
    pairs = [(a, b, overlay(a, b)) for a, b in repeat_pairs(measurements)]
    floors = noise_floor(measurements)
    found = []
    for signal, floor in floors.items():
        j = measurements[0].column(signal)
        if not any(np.ptp(m.target[:, j]) > 0 for m in measurements):
            continue
        by = {e.method: e.value for e in floor.estimates}
        quiet = max((by[k] for k in ("rest", "residue", "quantisation") if k in by), default=floor.value)
        share, bursts = _bursts([(a, b, laid.time_s, laid.difference["position"][:, j]) for a, b, laid in pairs], quiet)
        found.append(
            Unrepeated(
                signal=signal,
                unit=measurements[0].units[j],
                repeats=_repeats_rms([laid.difference["position"][:, j] for _, _, laid in pairs]),
                quiet=quiet,
                burst_share=share,
                bursts=bursts,
                dropped=_dropped(measurements, j),
            )
        )
    return found


def _repeats_rms(differences: Sequence[np.ndarray]) -> float | None:
    squares = np.concatenate([d**2 for d in differences]) if differences else np.empty(0)
    return float(np.sqrt(np.nanmean(squares) / 2)) if np.isfinite(squares).any() else None


def _bursts(
    pairs: Sequence[tuple[Measurement, Measurement, np.ndarray, np.ndarray]], quiet: float
) -> tuple[float | None, tuple[Burst, ...]]:
    blocks: list[tuple[float, Burst]] = []
    for a, b, time_s, difference in pairs:
        rows = max(2, round(BLOCK_S * a.rate_hz))
        for k in range(0, len(difference) - rows + 1, rows):
            power = (
                0.5 * float(np.nanmean(difference[k : k + rows] ** 2))
                if np.isfinite(difference[k : k + rows]).any()
                else 0.0
            )
            place = {"begin_s": float(time_s[k]), "end_s": float(time_s[k + rows - 1])}
            blocks.append((power, Burst(first=a.name, second=b.name, rms=power**0.5, **place)))
    total = sum(power for power, _ in blocks)
    if not total > 0:
        return None, ()
    blocks.sort(key=lambda block: -block[0])
    count = int(np.searchsorted(np.cumsum([power for power, _ in blocks]), BURST_POWER * total)) + 1
    return count / len(blocks), tuple(burst for _, burst in blocks[:count] if burst.rms > DISAGREE * quiet)


def _dropped(measurements: Sequence[Measurement], j: int) -> Dropped | None:
    times, found, mirrored, commands, held, holds, at_turns, expected = {}, 0, 0, 0, 0.0, 0, 0, 0.0
    for m in measurements:
        followed = m.target_kind(m.signals[j]) == "position" and np.isfinite(m.target[:, j]).all()
        if m.num_rows < 3 or m.pressed is not None or not followed:
            continue
        seen: HeldCommands | None = find_held_commands(m.target[:, j], m.measured[:, j], m.period_s)
        if seen is None:
            continue
        found, mirrored, commands = found + len(seen.events), mirrored + len(seen.mirrored), commands + seen.updates
        holds, at_turns = holds + seen.holds, at_turns + seen.at_turns
        expected += seen.turn_share * seen.holds
        held += sum(e.rows for e in seen.events) / seen.period_rows
        if seen.events:
            times[m.name] = tuple(float(m.time_s[e.row]) for e in seen.events)
    if not commands:
        return None
    hold = held / found if found else 0.0
    return Dropped(
        times_s=times,
        hold_rows=hold,
        commands=commands,
        found=found,
        mirrored=mirrored,
        holds=holds,
        at_turns=at_turns,
        turn_share=expected / holds if holds else 0.0,
    )


# findings --------------------------------------------------------------------------------------------------------------


def check_repeatability(measurements: Sequence[Measurement]) -> dict[str, list[Finding]]:
    """Check repeatability: recording → findings, each signal's under the recording that shows it most. Recordings without
    findings are left out.

    Findings: ``dropped_commands`` (warning), ``does_not_repeat`` (warning: repeats differ by far more than their noise),
    ``not_judged`` (note, under the first recording: there are no repeats, or they cannot be compared).
    """
    groups: dict[tuple[str, ...], list[Measurement]] = {}
    for m in measurements:
        groups.setdefault(m.signals, []).append(m)
    found: dict[str, list[Finding]] = {}
    for group in groups.values():
        try:
            signals = unrepeated(group)
        except TaccorlError as error:
            found.setdefault(group[0].name, []).append(not_judged("", "what the robot does not repeat", str(error)))
            continue
        if signals and all(s.repeats is None for s in signals):
            why = "no recording repeats another (repeat_of). Record one motion twice; dropped commands were searched for without"
            found.setdefault(group[0].name, []).append(not_judged("", "what the robot does not repeat", why))
        for s in signals:
            if s.dropped is not None and s.dropped.certain:
                worst = max(s.dropped.times_s, key=lambda name: len(s.dropped.times_s[name]))  # pyright: ignore[reportOptionalMemberAccess]
                found.setdefault(worst, []).append(_dropped_finding(s, s.dropped, worst))
            if s.disagree:
                name = s.bursts[0].second if s.bursts else group[0].name
                found.setdefault(name, []).append(_repeat_finding(s))
    return found


def _dropped_finding(s: Unrepeated, d: Dropped, worst: str) -> Finding:
    where = ", ".join(f"{t:.2f}" for t in d.times_s[worst][:MOST_TIMES])
    more = f" and {len(d.times_s[worst]) - MOST_TIMES} more" if len(d.times_s[worst]) > MOST_TIMES else ""
    text = (
        f"{s.signal}: commands were dropped or repeated: {d.found} times in {len(d.times_s)} recordings the joint moved as "
        f"if the previous target stayed in force for {d.hold_rows:.1f} commands on average ({d.mirrored} events of the "
        "opposite sign, which only noise and unmodelled physics produce); at least "
        f"{d.rate:.1%} of {d.commands} commands. In {worst} at {where} s{more}. No effect of the twin explains that: "
        "look for lost frames on the bus (taccorl ingest inspect, candump) or a driver that skips commands when its queue is full"
    )
    return Finding("dropped_commands", "warning", s.signal, text)


def _repeat_finding(s: Unrepeated) -> Finding:
    factor, unit = (1e3, "mrad") if s.unit == "rad" else (1e3, "mm")
    assert s.repeats is not None
    if s.intermittent and s.bursts:
        some = ", ".join(f"{b.begin_s:.2f} to {b.end_s:.2f} s" for b in s.bursts[:MOST_TIMES])
        how = (
            f"in bursts: {s.burst_share:.0%} of the time holds {BURST_POWER:.0%} of it ({s.bursts[0].first} against "
            f"{s.bursts[0].second}: {some}; up to {max(b.rms for b in s.bursts) * factor:.3g} {unit}). The noise floor leaves "
            "the bursts out"
        )
    else:
        how = (
            f"all the time ({s.burst_share or 1.0:.0%} of it holds {BURST_POWER:.0%}). The noise floor contains it, so a missing "
            "effect below that is not found"
        )
    cause = (
        "dropped commands explain it (see dropped_commands)"
        if s.dropped is not None and s.dropped.certain
        else "dropped commands were searched for and do not explain it: a disturbance torque, dry friction, slip, or two clocks"
    )
    text = (
        f"{s.signal} does not repeat: two recordings of one motion differ by {s.repeats * factor:.3g} {unit}, {s.ratio:.1f} "
        f"times the noise of {s.quiet * factor:.3g} {unit} at rest and between rows, {how}; {cause}"
    )
    return Finding("does_not_repeat", "warning", s.signal, text)

"""Motions of one joint or axis of a machine that a file describes: where and how fast it may move, the answer of its model, and
the motion to record next (``excitation`` says how motions are scored).

Nothing about limits is guessed. The range is given, or that of existing recordings, or that of the file; the speed is given, or
the fastest of existing recordings. A motion that needs more effort than the file allows is made smaller.

Letters in shapes: T rows.
"""

import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from taccorl.alignment.measurements.folder import Measurements
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.alignment.measurements.motions import LIBRARY, RATE_HZ, REST_S, Motion, Room
from taccorl.data.origin import Origin
from taccorl.diagnosis.experiment_design.aimed import AIMED, BEYOND, ENDS, JUMPS, reach
from taccorl.diagnosis.experiment_design.aimed import SIZES as AIMED_SIZES
from taccorl.diagnosis.experiment_design.excitation import (
    Explanation,
    Plan,
    PlannedMotion,
    best_first,
    check_rivals,
    explanations,
    floors_between,
)
from taccorl.diagnosis.experiment_design.other_pose import InOtherPose, OtherPose
from taccorl.diagnosis.machines.machine import GainsAre, Machine
from taccorl.diagnosis.search.problem import Values
from taccorl.errors import TaccorlError

MOTIONS = tuple(motion for motion in LIBRARY if motion.gain == 1.0 and not motion.payload_kg)
"""Motions of the library that are played with the machine's present gains and without a payload."""
MARGIN = 0.05
"""Share of the range that is kept free at both ends."""
SWEEP_SHARE = 0.6
"""Amplitude of the sweep as a share of half the range, as for the PiPER (``Room.of``)."""
SMALL_SHARE = 0.02
"""Amplitude of the small chirp as a share of half the range."""
EFFORT_SHARE = 0.8
"""Largest share of the effort limit that a planned motion may need."""
SPEED_SLACK = 1.05
"""Multiple of the highest speed that the answer to an aimed motion may have: targets that follow it are overshot."""
SIZES = (1.0, 0.7, 0.5, 0.35, 0.25)
"""Factors on the amplitude, tried in turn until the motion's effort is within the limit."""


@dataclass(frozen=True, kw_only=True)
class Ground:
    """Where, how fast and how one part of a machine may be moved."""

    machine: Machine
    """The machine."""
    part: str
    """Name of the joint or axis."""
    room: Room
    """Range of its motion."""
    like: Measurement | None = None
    """Recording whose pose, gains and masses the planned motions take over; None: the values of the machine's file are used."""
    pose: OtherPose | None = None
    """Pose of the other joints, if it is not that of ``like``."""

    @property
    def span(self) -> tuple[float, float]:
        """Lowest and highest position of planned motions [rad, m]."""
        return self.room.middle_rad - self.room.wide_rad, self.room.middle_rad + self.room.wide_rad

    @property
    def rate_hz(self) -> float:
        """Rate of the planned targets [Hz]: that of ``like``, else 200."""
        return float(RATE_HZ) if self.like is None else self.like.rate_hz

    @property
    def has_effort(self) -> bool:
        """Whether the machine is expected to log efforts: hobby servos (law pwm) do not."""
        return self.machine.drive(self.part).logs_effort

    def positions(self, motion: Motion, size: float = 1.0) -> np.ndarray:
        """(T,) positions of a motion [rad, m] at ``rate_hz``, its amplitudes multiplied by ``size``."""
        room = dataclasses.replace(self.room, wide_rad=size * self.room.wide_rad, sweep_rad=size * self.room.sweep_rad)
        made = motion.target(room)
        rows = round(len(made) * self.rate_hz / RATE_HZ)
        return np.interp(np.arange(rows) / self.rate_hz, np.arange(len(made)) / RATE_HZ, made)

    def commanded(self, name: str, positions: np.ndarray) -> Measurement:
        """A measurement that commands ``positions`` (T,) [rad, m], or their speed where the part takes velocities; not yet
        answered."""
        drive, rows = self.machine.drive(self.part), len(positions)
        like = self.like if self.pose is None else self.pose.like
        if like is None:
            like = Measurement(
                name=name,
                time_s=np.zeros(rows),
                target=np.zeros((rows, 1)),
                measured=np.zeros((rows, 1)),
                signals=(self.part,),
                units=(drive.unit,),
                target_kinds=(drive.target_kind,),
            )
        j = like.column(self.part)
        target, measured = (np.tile(values[0], (rows, 1)) for values in (like.target, like.measured))
        target[:, j] = positions
        if drive.target_kind == "velocity":
            target[:, j] = np.diff(positions, append=positions[-1]) * self.rate_hz
        measured[:, j] = positions[0]
        for name, position in (self.pose.positions if self.pose else {}).items():
            measured[:, like.column(name)] = position
            if like.target_kind(name) == "position":
                target[:, like.column(name)] = position
        nothing = dict.fromkeys(
            ("velocity", "effort", "load", "torque_ff", "supply_v", "enabled", "command_s"), np.empty(0)
        )
        return dataclasses.replace(
            like,
            **nothing,
            name=name,
            time_s=np.arange(rows) / self.rate_hz,
            target=target,
            measured=measured,
            repeat_of=None,
            touch=None,
            findings=(),
            origin=Origin("twin", "imagined: the twin's own answer"),
        )

    def answered(self, m: Measurement) -> tuple[Measurement, np.ndarray]:
        """The measurement with the positions that the machine's model answers, from where it comes to rest; and (T,) efforts
        [N·m, N]."""
        j = m.column(self.part)
        first = self.machine.answer(self.part, m).reported
        settled = first[min(round(0.9 * REST_S * self.rate_hz), len(first) - 1)]
        measured = m.measured.copy()
        measured[:, j] = settled
        answer = self.machine.answer(self.part, dataclasses.replace(m, measured=measured))
        measured[:, j] = answer.reported
        return dataclasses.replace(m, measured=measured), answer.effort

    def fitted(self, motion: Motion) -> tuple[Measurement, np.ndarray]:
        """The answered motion in the largest of ``SIZES`` whose effort is within the limit of the part, and its efforts (T,)
        [N·m, N].

        Raises:
            TaccorlError: even the smallest needs more, or moves beyond the range.
        """
        limit = self.machine.drive(self.part).effort_limit
        peak = 0.0
        for size in SIZES:
            m, effort = self.answered(self.commanded(motion.name, self.positions(motion, size)))
            peak = float(np.abs(effort).max())
            if np.isfinite(m.measured[:, m.column(self.part)]).all() and (
                limit is None or peak <= EFFORT_SHARE * limit
            ):
                return m, effort
        raise TaccorlError(
            f"needs {peak:.3g} of {limit:g} {_effort_unit(self)} even at {SIZES[-1]:.0%} of its size"
            if limit is not None
            else "the model does not answer it with finite positions"
        )

    def aimed(self, motion: Motion, effect: str, values: Values) -> tuple[Measurement, np.ndarray, float]:
        """Scale the motion that ``aimed.AIMED`` has for an effect, so that it just exceeds the limit which the effect states (a
        torque, speed or angle). If range, speed or effort limit do not allow that, it is as large as they allow.

        Returns:
            The motion with the simulated answer of the joint; its efforts (T,) [N·m, N]; and the largest value that it reaches
            in multiples of the limit (1: just at the limit).

        Raises:
            TaccorlError: even the smallest needs more, or the part takes no positions.
        """
        drive, room = self.machine.drive(self.part), self.room
        if drive.target_kind != "position" and motion is JUMPS:
            raise TaccorlError("targets of a velocity cannot jump in position")
        allowed = np.inf if drive.effort_limit is None else EFFORT_SHARE * drive.effort_limit
        best: tuple[Measurement, np.ndarray, float] | None = None
        why = ""
        for size in (0.5 / (0.5 - MARGIN),) if motion is ENDS else AIMED_SIZES:
            positions = self.positions(motion, size)
            m, effort = self.answered(self.commanded(motion.name, positions))
            answer = m.measured[:, m.column(self.part)]
            if not np.isfinite(answer).all():
                break
            peak, speed = _at_once(positions, effort), float(np.abs(np.gradient(answer, 1.0 / self.rate_hz)).max())
            if peak > allowed or speed > SPEED_SLACK * room.speed_rad_per_s:
                why = (
                    f"needs {peak:.3g} {_effort_unit(self)} and {speed:.3g} {drive.unit}/s, allowed are {allowed:.3g} and "
                    f"{room.speed_rad_per_s:.3g}"
                )
                break
            far = reach(effect, values, positions, answer, effort, self.rate_hz)
            best = (m, effort, far) if best is None or far > best[2] else best
            if far >= BEYOND:
                break
        if best is None:
            raise TaccorlError(why or "the model does not answer it with finite positions")
        return best


def _at_once(positions: np.ndarray, effort: np.ndarray) -> float:
    """Largest effort [N·m, N] of an answer to ``positions`` (T,). That at the instant of a jump, which decays before the next row
    shows it, is extrapolated from the two rows after it."""
    jumps = np.flatnonzero(np.diff(positions)) + 1
    rows = np.minimum(np.concatenate([jumps, jumps + 1]), len(effort) - 2)
    before = np.abs(2.0 * effort[rows] - effort[rows + 1])
    return float(max(np.abs(effort).max(), before.max(initial=0.0)))


def _effort_unit(ground: Ground) -> str:
    return "N" if ground.machine.drive(ground.part).unit == "m" else "N·m"


def ground_of(
    machine: Machine,
    part: str,
    measurements: Measurements | None = None,
    *,
    span: Sequence[float] = (),
    speed: float | None = None,
) -> Ground:
    """Collect what limits planned motions of one part: its range of positions and its highest speed.

    Args:
        measurements: existing recordings.
        span: lowest and highest position [rad, m].
        speed: highest speed [rad/s, m/s].

    Raises:
        TaccorlError: range or speed are not known, or the part is driven by torque.
    """
    if part not in machine.units:
        raise TaccorlError(f"{machine.name}: no {machine.part_word} {part!r}; it has {', '.join(machine.units)}")
    drive = machine.drive(part)
    if drive.target_kind in ("torque", "effort"):
        raise TaccorlError(
            f"{part} is driven by {drive.target_kind}: one that moves the real machine within limits cannot be planned from its "
            "model; plan the motion for a position or velocity law"
        )
    moved = [m for m in (measurements.all if measurements else ()) if part in m.signals and np.ptp(m.moved(part)) > 0.0]
    seen = [m.measured[:, m.column(part)] for m in moved]
    low, high = (
        (float(span[0]), float(span[1]))
        if len(span) == 2
        else (min(float(np.nanmin(q)) for q in seen), max(float(np.nanmax(q)) for q in seen))
        if seen
        else drive.limits or (0.0, 0.0)
    )
    if len(span) not in (0, 2) or not low < high:
        raise TaccorlError(
            f"--span: the range in which {part} may move [{drive.unit}] is not known: no recordings, and no limits in its file; "
            "give --span=[lowest, highest]"
        )
    if drive.limits is not None and (low < drive.limits[0] - 1e-9 or high > drive.limits[1] + 1e-9) and len(span) == 2:
        raise TaccorlError(
            f"--span=[{low:g}, {high:g}]: beyond the limits of {part}, {list(drive.limits)} {drive.unit}"
        )
    if speed is None and moved:
        speed = max(float(np.nanquantile(np.abs(np.gradient(m.moved(part), m.period_s)), 0.99)) for m in moved)
    if speed is None or not speed > 0.0:
        raise TaccorlError(
            f"--speed: how fast {part} may move is not known without recordings; give --speed= in {drive.unit}/s"
        )
    wide = (0.5 - MARGIN) * (high - low)
    room = Room(
        middle_rad=0.5 * (low + high),
        wide_rad=wide,
        sweep_rad=SWEEP_SHARE * wide,
        speed_rad_per_s=speed,
        small_rad=SMALL_SHARE * wide,
    )
    fit = [m for m in moved if measurements is not None and m in measurements.fit]
    return Ground(machine=machine, part=part, room=room, like=fit[0] if fit else None)


def plan_machine(
    ground: Ground,
    rivals: Sequence[str],
    *,
    measurements: Measurements | None,
    floor: float,
    fitted: Mapping[str, Values] | None = None,
    gains: GainsAre = "auto",
    done: Callable[[str], None] = lambda _: None,
) -> Plan[PlannedMotion]:
    """Score the motions that need neither changed gains nor a payload by how far apart they keep the rivals, best first. Rivals
    that do nothing below a limit get further motions, which are aimed at it (``aimed``).

    Args:
        rivals: effects to separate, two or more.
        measurements: existing recordings; those that move the part are part of every fit.
        floor: noise floor of the position [rad, m], where there are no recordings.
        fitted: effect → all numbers of the machine with it, if it was fitted; otherwise typical values are used.
        done: function that is called with the name of each motion that was scored.

    Raises:
        TaccorlError: there are fewer than two rivals, or one cannot act on the part.
    """
    check_rivals(rivals)
    part = ground.part
    known = [m for m in (measurements.fit if measurements else ()) if part in m.signals and np.ptp(m.moved(part)) > 0.0]
    with_effort = bool(known) and all(m.has_effort()[m.column(part)] for m in known)
    planned, refused, reached = [], {}, {}

    def told_by(m: Measurement) -> dict[str, Explanation]:
        problem = ground.machine.motion_problem(part, Measurements((*known, m)), gains)
        return explanations(problem, rivals, problem.start, fitted or {})

    def far(m: Measurement, effort: np.ndarray, told: Mapping[str, Explanation]) -> dict[str, float]:
        target, answer = m.target[:, m.column(part)], m.measured[:, m.column(part)]
        if m.target_kind(part) == "velocity":
            target = np.cumsum(target) / ground.rate_hz
        own = [name for name in rivals if name in AIMED]
        return {name: reach(name, told[name].values, target, answer, effort, ground.rate_hz) for name in own}

    def score(motion: Motion, m: Measurement, effort: np.ndarray) -> None:
        j = m.column(part)
        noisy = m.measured.copy()
        noisy[:, j] += floor * np.random.default_rng(0).standard_normal(m.num_rows)
        efforts = np.full_like(noisy, np.nan)
        efforts[:, j] = effort
        new = dataclasses.replace(m, measured=noisy, **({"effort": efforts} if with_effort else {}))
        problem = ground.machine.motion_problem(part, Measurements((*known, new)), gains)
        floors = problem.fit[0].floor if known else np.array([floor])
        recordings = [*problem.fit[:-1], dataclasses.replace(problem.fit[-1], floor=floors)]
        present = [problem.candidates[name].make(problem.start) for name in problem.present]
        told = explanations(problem, rivals, problem.start, fitted or {})
        asked = problem if ground.pose is None else InOtherPose(problem, ground.pose, recordings[-1].name)
        ways = {
            f"{a} | {b}": floors_between(asked, present, told[a], told[b], recordings)
            for a, b in itertools.combinations(rivals, 2)
        }
        reached[motion.name] = far(m, effort, told)
        peak = float(np.abs(effort).max())
        planned.append(PlannedMotion(motion=motion, target=m.target[:, j], peak_torque_nm=peak, ways=ways))

    suspected: Mapping[str, Explanation] = {}
    for motion in MOTIONS:
        try:
            m, effort = ground.fitted(motion)
        except TaccorlError as error:
            refused[motion.name] = str(error)
        else:
            suspected = suspected or told_by(m)
            score(motion, m, effort)
        done(motion.name)
    for name in (n for n in suspected if n in AIMED):
        for motion in AIMED[name]:
            label = dataclasses.replace(motion, name=f"{motion.name}_{name}")
            try:
                m, effort, _ = ground.aimed(motion, name, suspected[name].values)
            except TaccorlError as error:
                refused[label.name] = str(error)
            else:
                score(label, m, effort)
    best = {name: max((r.get(name, 0.0) for r in reached.values()), default=0.0) for name in suspected if name in AIMED}
    return Plan(
        part=part,
        rivals=tuple(rivals),
        floor=floor,
        planned=best_first(planned),
        refused=refused,
        pose={} if ground.pose is None else dict(ground.pose.positions),
        reaches=best,
    )

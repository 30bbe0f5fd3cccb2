"""Motions of one joint or axis: where and how fast it may move, how its model answers, and the motion to record next (``plan``
says how motions are scored). At the PiPER they include other gains and a payload; those of robot and axis files are played at the
present gains.

Nothing about limits is guessed. The range is given, or that of existing recordings, or that of the file; the speed is given, or
the fastest of existing recordings. A motion that needs more effort than the file allows is made smaller. The PiPER's limits are
known, and its motions keep their size.

Letters in shapes: T rows.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from taccorl.alignment.controller import arm_joint
from taccorl.alignment.measurements.folder import Measurements
from taccorl.alignment.measurements.measurement import UNITS, Measurement
from taccorl.alignment.measurements.motions import (
    LIBRARY,
    OPENING_M,
    POSES,
    RATE_HZ,
    REST_S,
    Motion,
    Room,
    joint_number,
)
from taccorl.data.origin import Origin
from taccorl.diagnosis.experiment_design.aimed import AIMED, ENDS, JUMPS, at_once, reach
from taccorl.diagnosis.experiment_design.plan import Explanation, Part, Planned, Scene
from taccorl.diagnosis.machines.machine import GainsAre, Machine
from taccorl.diagnosis.machines.piper import PiperTwin
from taccorl.diagnosis.problems.joints import moves
from taccorl.diagnosis.search.problem import Values
from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.twin import TwinConfig

MOTIONS = tuple(
    motion for motion in LIBRARY if motion.gain == 1.0 and not motion.payload_kg
)
"""Motions of the library that are played with the machine's present gains and without a payload."""
MARGIN = 0.05
"""Share of the range that is kept free at both ends."""
SWEEP_SHARE = 0.6
"""Amplitude of the sweep as a share of half the range, as for the PiPER (``Room.of``)."""
SMALL_SHARE = 0.02
"""Amplitude of the small chirp as a share of half the range."""
EFFORT_SHARE = 0.8
"""Largest share of the effort limit that a planned motion may need."""
EFFORT_NOISE_SHARE = 5e-3
"""Noise of efforts that have not been recorded yet, as a share of the largest one. A choice."""
SPEED_SLACK = 1.05
"""Multiple of the highest speed that the answer to an aimed motion may have: targets that follow it are overshot."""
SIZES = (1.0, 0.7, 0.5, 0.35, 0.25)
"""Factors on the amplitude, tried in turn until the motion's effort is within the limit."""
BEYOND = 1.3
"""Multiple of the limit at which a motion is aimed. A choice."""
AIMED_SIZES = tuple(float(x) for x in np.geomspace(0.002, 1.0, 50))
"""Factors on the amplitude of an aimed motion that are tried, the smallest first."""


@dataclass(frozen=True, kw_only=True)
class Ground:
    """Where, how fast and how one part of a machine may be moved."""

    machine: Machine
    part: str
    room: Room
    """Range of its motion."""
    like: Measurement | None = None
    """Recording whose pose, gains and masses the planned motions take over; None: the values of the machine's file are used."""

    @property
    def of_piper(self) -> bool:
        """Whether it is a joint of the PiPER, whose limits are known."""
        return isinstance(self.machine, PiperTwin)

    @property
    def span(self) -> tuple[float, float]:
        """Lowest and highest position of planned motions [rad, m]."""
        return (
            self.room.middle_rad - self.room.wide_rad,
            self.room.middle_rad + self.room.wide_rad,
        )

    @property
    def rate_hz(self) -> float:
        """Rate of the planned targets [Hz]: that of ``like``, else 200."""
        return float(RATE_HZ) if self.like is None else self.like.rate_hz

    @property
    def has_effort(self) -> bool:
        """Whether the machine is expected to log efforts: hobby servos (law pwm) do not."""
        return self.machine.drive(self.part).logs_effort

    @property
    def effort_unit(self) -> str:
        """N·m, or N of a slide."""
        return UNITS[self.machine.drive(self.part).unit][1]

    def positions(self, motion: Motion, size: float = 1.0) -> np.ndarray:
        """(T,) positions of a motion [rad, m] at ``rate_hz``, its amplitudes multiplied by ``size``."""
        room = dataclasses.replace(
            self.room,
            wide_rad=size * self.room.wide_rad,
            sweep_rad=size * self.room.sweep_rad,
        )
        made = motion.target(room)
        rows = round(len(made) * self.rate_hz / RATE_HZ)
        return np.interp(
            np.arange(rows) / self.rate_hz, np.arange(len(made)) / RATE_HZ, made
        )

    def commanded(
        self,
        name: str,
        positions: np.ndarray,
        gain: float = 1.0,
        payload_kg: float = 0.0,
    ) -> Measurement:
        """A measurement that commands ``positions`` (T,) [rad, m], or their speed where the part takes velocities; not yet
        answered.

        Args:
            gain: factor on the gains that ``like`` states.
            payload_kg: mass in the PiPER's gripper [kg].
        """
        drive, rows, like = self.machine.drive(self.part), len(positions), self.like
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
        target, measured = (
            np.tile(values[0], (rows, 1)) for values in (like.target, like.measured)
        )
        target[:, j] = positions
        if drive.target_kind == "velocity":
            target[:, j] = np.diff(positions, append=positions[-1]) * self.rate_hz
        measured[:, j] = positions[0]
        arm = self.part.split("_", 1)[0]
        nothing = dict.fromkeys(
            (
                "velocity",
                "effort",
                "load",
                "torque_ff",
                "supply_v",
                "enabled",
                "command_s",
            ),
            np.empty(0),
        )
        return dataclasses.replace(
            like,
            **nothing,
            name=name,
            time_s=np.arange(rows) / self.rate_hz,
            target=target,
            measured=measured,
            kp={
                signal: kp * gain if signal == self.part else kp
                for signal, kp in like.kp.items()
            },
            kd={
                signal: kd * gain if signal == self.part else kd
                for signal, kd in like.kd.items()
            },
            payload_kg=like.payload_kg | ({arm: payload_kg} if payload_kg else {}),
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
        answer = self.machine.answer(
            self.part, dataclasses.replace(m, measured=measured)
        )
        measured[:, j] = answer.reported
        return dataclasses.replace(m, measured=measured), answer.effort

    def fitted(self, motion: Motion) -> tuple[Measurement, np.ndarray]:
        """The answered motion in the largest of ``SIZES`` (at the PiPER in its own size) whose effort is within the limit of the
        part, and its efforts (T,) [N·m, N]. Raises TaccorlError: even the smallest needs more, or moves beyond the range."""
        drive, limit = self.machine.drive(self.part), self.allowed_effort
        sizes, peak = SIZES[:1] if self.of_piper else SIZES, 0.0
        for size in sizes:
            positions = self.positions(motion, size)
            low, high = float(positions.min()), float(positions.max())
            if (
                self.of_piper
                and drive.limits is not None
                and not drive.limits[0] <= low <= high <= drive.limits[1]
            ):
                raise TaccorlError(
                    f"goes to {low:.2f} … {high:.2f} {drive.unit}, beyond the joint's limits"
                )
            m, effort = self.answered(
                self.commanded(motion.name, positions, motion.gain, motion.payload_kg)
            )
            peak = float(np.abs(effort).max())
            if np.isfinite(m.measured[:, m.column(self.part)]).all() and peak <= limit:
                return m, effort
        if drive.effort_limit is None:
            raise TaccorlError("the model does not answer it with finite positions")
        smaller = f" even at {sizes[-1]:.0%} of its size" * (len(sizes) > 1)
        raise TaccorlError(
            f"needs {peak:.3g} of {drive.effort_limit:g} {self.effort_unit}{smaller}"
        )

    @property
    def allowed_effort(self) -> float:
        """Largest effort of a planned motion [N·m, N]."""
        limit = self.machine.drive(self.part).effort_limit
        return (
            math.inf
            if limit is None
            else limit
            if self.of_piper
            else EFFORT_SHARE * limit
        )

    def aimed(
        self, motion: Motion, effect: str, values: Values
    ) -> tuple[Measurement, np.ndarray, float]:
        """Scale the motion that ``AIMED`` has for an effect, so that it just exceeds the limit which the effect states (a torque,
        speed or angle). If range, speed or effort limit do not allow that, it is as large as they allow.

        Returns:
            The motion with the simulated answer of the joint; its efforts (T,) [N·m, N]; and the largest value that it reaches
            in multiples of the limit (1: just at the limit).

        Raises TaccorlError: even the smallest needs more, or the part takes no positions."""
        drive, room, allowed = (
            self.machine.drive(self.part),
            self.room,
            self.allowed_effort,
        )
        if drive.target_kind != "position" and motion.target is JUMPS.target:
            raise TaccorlError("targets of a velocity cannot jump in position")
        best: tuple[Measurement, np.ndarray, float] | None = None
        why = ""
        for size in (
            (0.5 / (0.5 - MARGIN),) if motion.target is ENDS.target else AIMED_SIZES
        ):
            positions = self.positions(motion, size)
            m, effort = self.answered(self.commanded(motion.name, positions))
            answer = m.measured[:, m.column(self.part)]
            if not np.isfinite(answer).all():
                break
            peak, speed = (
                at_once(positions, effort),
                float(np.abs(np.gradient(answer, 1.0 / self.rate_hz)).max()),
            )
            if peak > allowed or speed > SPEED_SLACK * room.speed_rad_per_s:
                why = (
                    f"needs {peak:.3g} {self.effort_unit} and {speed:.3g} {drive.unit}/s, allowed are {allowed:.3g} and "
                    f"{room.speed_rad_per_s:.3g}"
                )
                break
            far = reach(effect, values, positions, answer, effort, self.rate_hz)
            best = (m, effort, far) if best is None or far > best[2] else best
            if far >= BEYOND:
                break
        if best is None:
            raise TaccorlError(
                why or "the model does not answer it with finite positions"
            )
        return best


def ground_of(
    machine: Machine,
    part: str,
    measurements: Measurements | None = None,
    *,
    span: Sequence[float] = (),
    speed: float | None = None,
) -> Ground:
    """Collect what limits planned motions of one part of a robot or axis file: its range of positions and its highest speed.

    Args:
        measurements: existing recordings.
        span: lowest and highest position [rad, m].
        speed: highest speed [rad/s, m/s].

    Raises TaccorlError: range or speed are not known, or the part is driven by torque."""
    if part not in machine.units:
        raise TaccorlError(
            f"{machine.name}: no {machine.part_word} {part!r}; it has {', '.join(machine.units)}"
        )
    drive = machine.drive(part)
    if drive.target_kind in ("torque", "effort"):
        raise TaccorlError(
            f"{part} is driven by {drive.target_kind}: a motion that keeps the real machine within limits cannot be planned "
            "from its model; plan the motion for a position or velocity law"
        )
    moved = [m for m in (measurements.all if measurements else ()) if _moved(m, part)]
    seen = [m.measured[:, m.column(part)] for m in moved]
    low, high = drive.limits or (0.0, 0.0)
    if len(span) == 2:
        low, high = float(span[0]), float(span[1])
    elif seen:
        low, high = (
            min(float(np.nanmin(q)) for q in seen),
            max(float(np.nanmax(q)) for q in seen),
        )
    if len(span) not in (0, 2) or not low < high:
        raise TaccorlError(
            f"--span: the range in which {part} may move [{drive.unit}] is not known: no recordings, and no limits in its file; "
            "give --span=[lowest, highest]"
        )
    if (
        drive.limits is not None
        and (low < drive.limits[0] - 1e-9 or high > drive.limits[1] + 1e-9)
        and len(span) == 2
    ):
        raise TaccorlError(
            f"--span=[{low:g}, {high:g}]: beyond the limits of {part}, {list(drive.limits)} {drive.unit}"
        )
    if speed is None and moved:
        speed = max(
            float(np.nanquantile(np.abs(np.gradient(m.moved(part), m.period_s)), 0.99))
            for m in moved
        )
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


def _moved(m: Measurement, part: str) -> bool:
    return part in m.signals and bool(np.ptp(m.moved(part)) > 0.0)


def arm_ground(config: TwinConfig, signal: str, pose: np.ndarray) -> Ground:
    """Limits of a joint of the PiPER in ``pose`` (7,), angles of its arm's joints and opening [rad, m], with the joint in the
    middle of its motions: within its limits, and with a sweep whose torque is within ``motions.TORQUE_NM``. Raises TaccorlError:
    there is no such joint, or it cannot move about its pose."""
    number, arm = joint_number(signal), signal.split("_", 1)[0]
    body, middle = (
        arm_joint.rigid(config, signal, pose, 0.0, []),
        float(pose[number - 1]),
    )
    weight = body.gravity_sin * math.sin(middle) + body.gravity_cos * math.cos(middle)
    room = Room.of(number, middle, body.inertia, weight)
    if min(room.wide_rad, room.sweep_rad) <= 0:
        raise TaccorlError(
            f"{signal} is at {middle:.3f} rad, at its limit; give a pose with room to both sides"
        )
    rest = np.zeros((2, len(ROBOT.action_names)))
    rest[:, ROBOT.arm_slice(arm)] = pose
    machine = PiperTwin(config)
    kp, kd = ({signal: machine.numbers(signal)[name][0]} for name in ("kp", "kd"))
    like = Measurement(
        name="rest",
        time_s=np.arange(2) / RATE_HZ,
        target=rest,
        measured=rest,
        kp=kp,
        kd=kd,
    )
    return Ground(machine=machine, part=signal, room=room, like=like)


def rest_pose(signal: str, measurements: Measurements | None) -> np.ndarray:
    """Pose (7,) of the PiPER's arm [rad, m] while this joint is moved: that of recordings that move it, else that of
    ``motions.POSES``."""
    swept = (
        [m for m in measurements.fit if moves(m, signal)]
        if measurements is not None
        else []
    )
    pose = np.array([*POSES[joint_number(signal) - 1], OPENING_M])
    for k, name in enumerate(_of_arm(signal)):
        if swept and name in swept[0].signals:
            pose[k] = swept[0].target[0, swept[0].column(name)]
    return pose


def _of_arm(signal: str) -> list[str]:
    """The joints and the gripper of the PiPER's arm of ``signal``."""
    return [
        f"{signal.split('_', 1)[0]}_{joint}" for joint in (*ROBOT.joints, "gripper")
    ]


class JointPart(Part):
    """A joint of the PiPER or of a robot file, or an axis. Motions with other gains and a payload are the PiPER's only. Rivals
    that do nothing below a limit get further motions, which are aimed at it, but for the PiPER's.

    Args:
        ground: where and how it may be moved.
        floor: noise floor of the position [rad, m], of recordings that do not exist yet.
        measurements: existing recordings; those that move the part are part of every fit.
        gains: treatment of gains in fits.
        efforts: the motor's effort is recorded with planned motions, too. At robot and axis files it is anyway where all existing
            recordings have it. It is compared with theirs, or if one has none, those are left out.
    """

    def __init__(
        self,
        ground: Ground,
        floor: float,
        measurements: Measurements | None = None,
        *,
        gains: GainsAre = "auto",
        efforts: bool = False,
    ) -> None:
        self.machine, self.name, self.ground, self.floor = (
            ground.machine,
            ground.part,
            ground,
            floor,
        )
        self.measurements = measurements
        self.gains: GainsAre = gains
        of_piper, fit = (
            ground.of_piper,
            () if measurements is None else measurements.fit,
        )
        self.library = LIBRARY if of_piper else MOTIONS
        self.drive = self.machine.drive(self.name)
        self.rate_hz = RATE_HZ if of_piper else ground.rate_hz
        known = [m for m in fit if (moves if of_piper else _moved)(m, self.name)]
        if (
            of_piper and ground.like is not None
        ):  # what a table lacks stands as in the planned motions
            rest = ground.like.target[0]
            known = [
                m if m.signals == ROBOT.action_names else m.on_robot(rest)
                for m in known
            ]
        self.have_efforts = bool(known) and all(
            m.has_effort()[m.column(self.name)] for m in known
        )
        self.efforts = efforts or (self.have_efforts and not of_piper)
        self.known = known if self.have_efforts or not self.efforts else []
        if of_piper and ground.like is not None:
            at = {
                name: ground.like.target[0, ROBOT.action_names.index(name)]
                for name in _of_arm(self.name)
            }
            self.pose = {
                name: round(float(q), 4) for name, q in at.items() if name != self.name
            }

    @property
    def column(self) -> str:
        """Name of the column of its targets."""
        return f"{self.name}.{'qd_target' if self.drive.target_kind == 'velocity' else 'q_target'}"

    def offer(self, item: Motion, suspected: Mapping[str, Explanation]) -> Planned:
        ground = self.ground
        if not item.aims:
            m, effort = ground.fitted(item)
        elif item.aims in suspected:
            m, effort, _ = ground.aimed(item, item.aims, suspected[item.aims].values)
        else:
            raise TaccorlError("no motion of the library may be recorded")
        target = m.target[:, m.column(self.name)]
        return Planned(
            part=self,
            item=item,
            columns={self.column: target},
            peak=float(np.abs(effort).max()),
            made=(m, effort),
        )

    def scene(self, p: Planned) -> Scene:
        m, effort = p.made
        j = m.column(self.name)
        noisy, efforts = m.measured.copy(), np.full_like(m.measured, np.nan)
        noisy[:, j] += self.floor * np.random.default_rng(0).standard_normal(m.num_rows)
        if self.efforts:
            noise = 0.0 if self.have_efforts else EFFORT_NOISE_SHARE * p.peak
            efforts[:, j] = effort + noise * np.random.default_rng(1).standard_normal(
                m.num_rows
            )
        new = dataclasses.replace(m, measured=noisy, effort=efforts)
        problem = self.machine.motion_problem(
            self.name, Measurements((*self.known, new)), self.gains
        )
        own = [self.floor, *([EFFORT_NOISE_SHARE * p.peak] if self.efforts else [])]
        floors = problem.fit[0].floor if self.known else np.array(own)
        last = dataclasses.replace(problem.fit[-1], floor=floors)
        return Scene(problem, [*problem.fit[:-1], last])

    def aimed(self, rivals: Sequence[str]) -> Sequence[Motion]:
        limited = (
            [] if self.ground.of_piper else [name for name in rivals if name in AIMED]
        )
        every = [(motion, name) for name in limited for motion in AIMED[name]]
        return [
            dataclasses.replace(motion, name=f"{motion.name}_{name}", aims=name)
            for motion, name in every
        ]

    def reach(self, p: Planned, told: Mapping[str, Explanation]) -> dict[str, float]:
        m, effort = p.made
        target, answer = (
            m.target[:, m.column(self.name)],
            m.measured[:, m.column(self.name)],
        )
        if self.drive.target_kind == "velocity":
            target = np.cumsum(target) / self.ground.rate_hz
        own = (
            {}
            if self.ground.of_piper
            else {name: e.values for name, e in told.items() if name in AIMED}
        )
        return {
            name: reach(name, v, target, answer, effort, self.ground.rate_hz)
            for name, v in own.items()
        }

    def with_efforts(self) -> "JointPart | None":
        if self.efforts or not self.drive.logs_effort:
            return None
        part = JointPart(
            self.ground, self.floor, self.measurements, gains=self.gains, efforts=True
        )
        part.label, part.where = "with_efforts", "with the motor's effort recorded, too"
        if not self.have_efforts:
            noise = f"{EFFORT_NOISE_SHARE:.1%} of the largest"
            part.where = f"{part.where} (its noise taken as {noise})"
        return part

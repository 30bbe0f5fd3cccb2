"""Choose the motion to record next: the one that best separates rival explanations after a refit (T-optimal design). This module
is for joints; ``presses`` uses the same measure for presses of the pads.

T-optimal design (Atkinson and Fedorov 1975): for rivals A and B and a motion, a measurement is simulated with A, and B with all
its numbers is fitted to it; the residual in noise floors is the discrimination, the smaller one of both directions. Below about
one floor the recording would not separate the rivals. Existing recordings are part of both fits.
"""

import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from taccorl.alignment.controller import arm_bench
from taccorl.alignment.controller.joint_model import JointModel
from taccorl.alignment.controller.joint_recording import joint_motion
from taccorl.alignment.measurements.folder import Measurements
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.alignment.measurements.motions import (
    LIBRARY,
    OPENING_M,
    POSES,
    RATE_HZ,
    TORQUE_NM,
    Motion,
    Room,
    joint_number,
)
from taccorl.data.origin import Origin
from taccorl.diagnosis.problems.joint_problem import GainsAre, JointProblem
from taccorl.diagnosis.problems.joints import moves
from taccorl.diagnosis.search.fit import fit, rms, stacked
from taccorl.diagnosis.search.problem import Problem, Recording, Values, chosen
from taccorl.errors import TaccorlError, nearest
from taccorl.robots import ROBOT
from taccorl.sim.effects.effect import Effect
from taccorl.sim.twin import TwinConfig

TELLS = 1.25
"""Discrimination [noise floors] from which on a recording separates two rivals: √(1 + 1.25²) = 1.6."""
SAME = 0.25
"""Two effects count as the same if they differ by less than so many floors on every motion."""
STEPS = 12
"""Most steps of the solver in a refit."""


@dataclass(frozen=True, kw_only=True)
class Planned:
    """A recording that could be made, with its discrimination between rivals."""

    ways: dict[str, tuple[float, float]]
    """"a | b" → residual [floors] after a refit of b to data simulated with a, and of a to data simulated with b."""

    @property
    def discrimination(self) -> dict[str, float]:
        """Pair "a | b" → discrimination in noise floors, the smaller of both directions."""
        return {pair: min(ways) for pair, ways in self.ways.items()}

    @property
    def worst(self) -> float:
        """Smallest discrimination over all pairs of rivals [floors]."""
        return min(self.discrimination.values(), default=0.0)

    @property
    def mean(self) -> float:
        """Mean discrimination over all pairs of rivals [floors]; 0 without a pair."""
        return float(np.mean(list(self.discrimination.values()))) if self.discrimination else 0.0


@dataclass(frozen=True, kw_only=True)
class PlannedMotion(Planned):
    """A motion of a joint that could be recorded."""

    motion: Motion
    """The motion of the library."""
    target: np.ndarray
    """(T,) targets [rad; of a slide m], at 200 Hz or at the rate of existing recordings."""
    peak_torque_nm: float
    """Largest torque of the motor in the twin, gravity compensation included [N·m; of a slide N]."""


@dataclass(frozen=True, kw_only=True)
class Plan[PlannedT: Planned]:
    """Recordings that could be made for one part, best first."""

    part: str
    """Name of the part: ``left_joint5``, ``left pads``."""
    rivals: tuple[str, ...]
    """Names of the effects to separate."""
    floor: float
    """Noise floor: of a joint's angle [rad], of a slide [m], or of a taxel's row [counts]."""
    planned: tuple[PlannedT, ...]
    refused: dict[str, str]
    """Motion or press → reason why it must not be recorded."""
    pose: dict[str, float] = field(default_factory=dict)
    """Positions of the arm's other joints and gripper during the motion [rad, m]; empty for presses."""
    reaches: dict[str, float] = field(default_factory=dict)
    """Rival that does nothing below a limit → how far the motions go toward it, 1 at the limit; empty if there is none, or they
    were not aimed."""

    @property
    def hopeless(self) -> tuple[str, ...]:
        """Pairs ("a | b") of rivals that no recording of the plan separates: ``best`` is below 1.25 floors."""
        pairs = [f"{a} | {b}" for a, b in itertools.combinations(self.rivals, 2)]
        return tuple(pair for pair in pairs if self.best(pair) < TELLS)

    @property
    def separates_nothing(self) -> bool:
        """Whether no recording of the plan separates any two of the rivals, whichever of them is true."""
        return all(max(ways) < TELLS for p in self.planned for ways in p.ways.values())

    def best(self, pair: str) -> float:
        """Discrimination of ``pair`` ("a | b") on the recording that separates it best [floors]; 0 if nothing may be recorded."""
        return max((p.discrimination[pair] for p in self.planned), default=0.0)


def plan(
    config: TwinConfig,
    signal: str,
    rivals: Sequence[str],
    *,
    pose: np.ndarray,
    floor_rad: float,
    measurements: Measurements | None = None,
    fitted: Mapping[str, Values] | None = None,
    gains: GainsAre = "auto",
    done: Callable[[str], None] = lambda _: None,
) -> Plan[PlannedMotion]:
    """Score every motion of the library, best first.

    Args:
        signal: name of the joint.
        rivals: effects to separate, two or more.
        pose: (7,) pose of the arm [rad, m], with the joint in the middle of its motions.
        floor_rad: noise floor of the angle [rad].
        measurements: existing recordings.
        fitted: effect → all numbers of the twin with it, if it was fitted; otherwise typical values are used.
        done: function that is called with the name of each motion that was scored.

    Raises:
        TaccorlError: there are fewer than two rivals, or the joint cannot move about its pose.
    """
    check_rivals(rivals)
    room = room_of(config, signal, pose)
    if min(room.wide_rad, room.sweep_rad) <= 0:
        raise TaccorlError(
            f"{signal} is at {room.middle_rad:.3f} rad, at its limit; give a pose with room to both sides"
        )
    planned, refused = [], {}
    for motion in LIBRARY:
        target = motion.target(room)
        peak = peak_torque_nm(config, signal, pose, motion, target)
        limit = TORQUE_NM[joint_number(signal) - 1]
        column = ROBOT.action_names.index(signal)
        if target.min() < ROBOT.action_low[column] or target.max() > ROBOT.action_high[column]:
            refused[motion.name] = f"goes to {target.min():.2f} … {target.max():.2f} rad, beyond the joint's limits"
        elif peak > limit:
            refused[motion.name] = f"needs {peak:.1f} N·m of {limit:g}"
        else:
            apart = _apart(config, signal, rivals, pose, motion, target, floor_rad, measurements, fitted or {}, gains)
            planned.append(PlannedMotion(motion=motion, target=target, peak_torque_nm=peak, ways=apart))
        done(motion.name)
    return Plan(
        part=signal,
        rivals=tuple(rivals),
        floor=floor_rad,
        planned=best_first(planned),
        refused=refused,
        pose=other_joints(signal, pose),
    )


def other_joints(signal: str, pose: np.ndarray) -> dict[str, float]:
    """The arm's ``pose`` (7,) as name of the joint or gripper → position [rad, m], without the joint under test."""
    arm = signal.split("_", 1)[0]
    names = [f"{arm}_{joint}" for joint in (*ROBOT.joints, "gripper")]
    return {name: round(float(value), 4) for name, value in zip(names, pose, strict=True) if name != signal}


def check_rivals(rivals: Sequence[str]) -> None:
    """Check that there are effects to separate.

    Raises:
        TaccorlError: there are fewer than two.
    """
    if len(set(rivals)) < 2:
        raise TaccorlError(f"give two or more effects to separate, found {', '.join(rivals) or 'none'}")


def best_first[PlannedT: Planned](planned: Sequence[PlannedT]) -> tuple[PlannedT, ...]:
    """``planned``, sorted by ``worst`` and then by ``mean``, the largest first."""
    return tuple(sorted(planned, key=lambda p: (-p.worst, -p.mean)))


def room_of(config: TwinConfig, signal: str, pose: np.ndarray) -> Room:
    """Range of motion of the joint about ``pose`` (7,), angles of its arm's joints and opening [rad, m]."""
    number = joint_number(signal)
    body = arm_bench.rigid(config, signal, pose, 0.0, [])
    middle = float(pose[number - 1])
    weight = body.gravity_sin * math.sin(middle) + body.gravity_cos * math.cos(middle)
    return Room.of(number, middle, body.inertia, weight)


def rest_pose(signal: str, measurements: Measurements | None) -> np.ndarray:
    """Pose (7,) of the arm [rad, m] while this joint is moved: that of recordings that move it, else that of
    ``motions.POSES``."""
    arm, number = signal.split("_", 1)[0], joint_number(signal)
    swept = [m for m in measurements.fit if moves(m, signal)] if measurements is not None else []
    pose = np.array([*POSES[number - 1], OPENING_M])
    for k, name in enumerate([f"{arm}_{joint}" for joint in (*ROBOT.joints, "gripper")]):
        if swept and name in swept[0].signals:
            pose[k] = swept[0].target[0, swept[0].column(name)]
    return pose


def posed(signal: str, pose: np.ndarray, positions: Mapping[str, float]) -> np.ndarray:
    """``pose`` (7,) of the arm of ``signal`` with other joints, or its gripper, at ``positions`` [rad, m].

    Raises:
        TaccorlError: a name is none of them, or a position is beyond its limits.
    """
    arm = signal.split("_", 1)[0]
    names = [f"{arm}_{joint}" for joint in (*ROBOT.joints, "gripper")]
    found = pose.copy()
    for name, position in positions.items():
        if name == signal or name not in names:
            raise TaccorlError(f"--pose: {name} is no other joint of the {arm} arm; {nearest(name, names)}")
        column = ROBOT.action_names.index(name)
        low, high = float(ROBOT.action_low[column]), float(ROBOT.action_high[column])
        if not low <= position <= high:
            raise TaccorlError(
                f"--pose: {name} {position:g} is beyond its limits, {round(low, 6):g} … {round(high, 6):g}"
            )
        found[names.index(name)] = position
    return found


def imagined(
    config: TwinConfig, signal: str, pose: np.ndarray, motion: Motion, target: np.ndarray, floor_rad: float
) -> Measurement:
    """Simulated measurement of a motion with the twin, with noise, in place of a recording that does not exist yet.

    Args:
        pose: (7,) angles of the arm's joints and its opening [rad, m]; the entry of the joint itself is not used.
        target: (T,) targets of the joint at 200 Hz [rad].
        floor_rad: standard deviation of the noise [rad].
    """
    j = ROBOT.action_names.index(signal)
    arm = signal.split("_", 1)[0]
    targets = np.zeros((len(target), len(ROBOT.action_names)))
    targets[:, ROBOT.arm_slice(arm)] = pose
    targets[:, j] = target
    k = joint_number(signal) - 1
    control = config.controller_of(arm)
    m = Measurement(
        name=motion.name,
        time_s=np.arange(len(target)) / RATE_HZ,
        target=targets,
        measured=targets.copy(),
        kp={signal: control.kp_nm_per_rad[k] * motion.gain},
        kd={signal: control.kd_nms_per_rad[k] * motion.gain},
        payload_kg={arm: motion.payload_kg} if motion.payload_kg else {},
        origin=Origin("twin", "imagined: the twin's own answer"),
    )
    m.measured[:, j] += control.torque_ff_nm[k] / (control.kp_nm_per_rad[k] * motion.gain)  # where it rests
    model = JointModel(config, signal)
    answer = model.simulate(joint_motion(m, config, signal), model.gains)
    noise = floor_rad * np.random.default_rng(0).standard_normal(len(target))
    m.measured[:, j] = answer.reported + noise
    return m


def peak_torque_nm(config: TwinConfig, signal: str, pose: np.ndarray, motion: Motion, target: np.ndarray) -> float:
    """Largest torque of the motor during a motion, including gravity compensation [N·m]; ``pose`` (7,) and ``target`` (T,) are as
    in ``imagined``."""
    m = imagined(config, signal, pose, motion, target, 0.0)
    model, seen = JointModel(config, signal), joint_motion(m, config, signal)
    answer = model.simulate(seen, model.gains)
    return float(np.abs(model.motor_nm(seen, answer)).max())


def _apart(
    config: TwinConfig,
    signal: str,
    rivals: Sequence[str],
    pose: np.ndarray,
    motion: Motion,
    target: np.ndarray,
    floor_rad: float,
    measurements: Measurements | None,
    fitted: Mapping[str, Values],
    gains: GainsAre,
) -> dict[str, tuple[float, float]]:
    """Pair → floors between the two on this motion, each being the truth."""
    new = imagined(config, signal, pose, motion, target, floor_rad)
    known = [m for m in measurements.fit if moves(m, signal)] if measurements is not None else []
    known = [m if m.signals == ROBOT.action_names else m.on_robot(new.target[0]) for m in known]
    problem = JointProblem(config, signal, Measurements((*known, new)), gains=gains, effort=False)
    recordings = [dataclasses.replace(r, floor=np.array([floor_rad])) for r in problem.fit]
    present = [problem.candidates[name].make(problem.start) for name in problem.present]
    told = explanations(problem, rivals, problem.start, fitted)
    return {
        f"{a} | {b}": floors_between(problem, present, told[a], told[b], recordings)
        for a, b in itertools.combinations(rivals, 2)
    }


@dataclass(frozen=True, kw_only=True)
class Explanation:
    """An explanation of the recordings: one effect with all fitted numbers of the part."""

    values: Values
    """All fitted numbers of the part, those of the effect included."""
    effect: Effect
    """The effect with these values."""


def explanations(
    problem: Problem, rivals: Sequence[str], start: Mapping[str, float], fitted: Mapping[str, Values]
) -> dict[str, Explanation]:
    """Name of each rival → its explanation, with the numbers that were ``fitted`` with it, or typical values.

    Args:
        start: numbers of the part without a rival.
        fitted: effect → all numbers with it, if it was fitted.

    Raises:
        TaccorlError: a rival is not a candidate of the problem.
    """
    found = {}
    for c in chosen(problem, rivals):
        typical = {f.name: f.start for f in c.frees} | c.starts[len(c.starts) // 2]
        values = dict(start) | typical | fitted.get(c.name, {})
        found[c.name] = Explanation(values=values, effect=c.make(values))
    return found


def floors_between(
    problem: Problem, present: Sequence[Effect], a: Explanation, b: Explanation, recordings: Sequence[Recording]
) -> tuple[float, float]:
    """Residual RMS [noise floors] between two explanations on the last recording: (after fitting b to data simulated from a,
    after fitting a to data simulated from b).

    Args:
        present: effects of the twin in both explanations; their numbers are fitted, too.
        recordings: existing recordings, followed by the one that could be made.
    """

    def left(truth: Explanation, other: Explanation) -> float:
        effects = [*present, truth.effect]
        said = [dataclasses.replace(r, measured=problem.simulate(truth.values, effects, r)) for r in recordings]
        names = (*(e.name for e in present), other.effect.name)
        model = fit(problem, said, names, other.values, STEPS)
        return rms(stacked(problem, model.values, model.effects, said[-1:]))

    return left(a, b), left(b, a)

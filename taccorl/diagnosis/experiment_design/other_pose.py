"""Another pose of a robot's other joints for a motion of one joint, in which a tilted base or a mass that the model lacks loads
that joint otherwise. A spring, friction or a drive's fault are as they were.

A pose is accepted if it is within the joints' limits, if holding it needs at most ``HOLD_SHARE`` of each effort limit, and if on
the way to it and during the motion no two shapes of the model touch that did not touch where the recordings were made. Meshes are
not read, so links without primitive shapes are not checked; they are counted.
"""

import copy
import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from taccorl.alignment.controller.rigid_joint import rigid_terms
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.diagnosis.machines.machine import Machine
from taccorl.diagnosis.machines.robot import RobotMachine
from taccorl.diagnosis.problems.tilted_base import weights_by_turn
from taccorl.diagnosis.search.problem import Case, Recording
from taccorl.diagnosis.search.solve import Startable
from taccorl.errors import TaccorlError, nearest
from taccorl.sim.effects.effect import Effect
from taccorl.sim.effects.load import Unbalance

FARTHEST = {"rad": 1.0, "m": 0.2}
"""Largest displacement of each other joint from its present position when a pose is chosen, by the joint's unit. The values are
not measured."""
TRIED = 200
"""Number of poses that are compared before one is chosen."""
HOLD_SHARE = 0.8
"""Largest share of a joint's effort limit that holding a pose may need."""
PLACES = 100
"""Number of positions along each way at which shapes are compared."""
WAY_SPEED = {"rad": 0.2, "m": 0.02}
"""Highest speed on the way to the pose, by the joint's unit [rad/s, m/s]. The values are not measured."""


@dataclass(frozen=True)
class OtherPose:
    """Pose of the other joints during planned motions of one joint."""

    robot: RobotMachine
    part: str
    """The joint that moves."""
    like: Measurement
    """Recording of the present pose, with all joints of the model."""
    here: np.ndarray
    """(nq,) present pose [rad, m]."""
    positions: Mapping[str, float]
    """Other joint → its position in the new pose [rad, m]."""
    span: tuple[float, float]
    """Lowest and highest position of the part's motion [rad, m]."""

    @property
    def there(self) -> np.ndarray:
        """(nq,) the new pose [rad, m]."""
        pose, model = self.here.copy(), self.robot.robot.rigid.model
        for name, position in self.positions.items():
            pose[model.joint(name).qposadr[0]] = position
        return pose

    @property
    def driven(self) -> tuple[str, ...]:
        """Those of the other joints that take position targets, so that a table can hold them."""
        joints = self.robot.robot.config.joints
        return tuple(
            n
            for n in self.positions
            if n in joints and joints[n].target_kind == "position"
        )

    @property
    def unchecked(self) -> int:
        """Number of moving links without a shape in the model, whose collisions are not checked."""
        model = self.robot.robot.rigid.model
        shaped = {
            int(b)
            for b in model.geom_bodyid[
                (model.geom_contype | model.geom_conaffinity) > 0
            ]
        }
        return len({int(b) for b in model.jnt_bodyid} - shaped)

    def way(self, rate_hz: float) -> dict[str, np.ndarray]:
        """``driven`` → (T,) targets [rad, m] from the present position to that of the pose, a half wave of a cosine at
        ``rate_hz``."""
        units = self.robot.units
        model = self.robot.robot.rigid.model
        begin = {
            name: float(self.here[model.joint(name).qposadr[0]]) for name in self.driven
        }
        far = {name: self.positions[name] - begin[name] for name in self.driven}
        seconds = max(
            (0.5 * np.pi * abs(d) / WAY_SPEED[units[name]] for name, d in far.items()),
            default=0.0,
        )
        rows = np.arange(int(np.ceil(seconds * rate_hz)) + 1)
        share = 0.5 - 0.5 * np.cos(np.pi * rows / max(len(rows) - 1, 1))
        return {name: begin[name] + share * d for name, d in far.items()}

    def wrong(self) -> str:
        """Why the pose must not be recorded; empty if nothing speaks against it."""
        robot, model = self.robot.robot, copy.copy(self.robot.robot.rigid.model)
        model.opt.disableflags = (
            0  # without constraints, as it was compiled, nothing touches
        )
        for name, position in self.positions.items():
            limits = robot.rigid.joints[name].limits
            if limits is not None and not limits[0] <= position <= limits[1]:
                return f"{name} {position:.4g} is beyond its limits, {limits[0]:.4g} … {limits[1]:.4g} {self.robot.units[name]}"
        data = mujoco.MjData(model)
        data.qpos[:] = self.there
        mujoco.mj_forward(model, data)
        for name, joint in robot.config.joints.items():
            held = abs(float(data.qfrc_bias[model.joint(name).dofadr[0]]))
            if (
                name != self.part
                and joint.effort_limit is not None
                and held > HOLD_SHARE * joint.effort_limit
            ):
                return f"{name} needs {held:.3g} of its effort_limit {joint.effort_limit:g} to hold the weight there"
        allowed = {
            pair
            for pose in self._sweep(self.here)
            for pair in touching(model, data, pose)
        }
        ways = self.here + np.linspace(0.0, 1.0, PLACES)[:, None] * (
            self.there - self.here
        )
        for pose in (*ways, *self._sweep(self.there)):
            for a, b in sorted(touching(model, data, pose) - allowed):
                at = ", ".join(
                    f"{n} {pose[model.joint(n).qposadr[0]]:.3g}"
                    for n in (self.part, *self.positions)
                )
                return f"{_name(model, a)} touches {_name(model, b)} at {at}"
        return ""

    def _sweep(self, pose: np.ndarray) -> Iterator[np.ndarray]:
        """Poses (nq,) with the part along its span."""
        address = self.robot.robot.rigid.model.joint(self.part).qposadr[0]
        for position in np.linspace(*self.span, PLACES):
            swept = pose.copy()
            swept[address] = position
            yield swept

    def change(self) -> float:
        """By how much a weight loads the part otherwise than in the present pose: the change of the sine and cosine of its weight
        with each small turn of the base, relative to their size in both poses, 0 … 1; and half the change of its inertia."""
        robot = self.robot.robot
        before, after = (
            weights_by_turn(robot, self.part, [pose])
            for pose in (self.here, self.there)
        )
        size = np.linalg.norm(before) + np.linalg.norm(after)
        first, then = (
            rigid_terms(robot.rigid.model, self.part, pose).inertia
            for pose in (self.here, self.there)
        )
        turned = float(np.linalg.norm(after - before) / size) if size > 0 else 0.0
        return turned + 0.5 * abs(then - first) / max(first, then)


def stated_pose(
    machine: Machine,
    part: str,
    like: Measurement | None,
    span: tuple[float, float],
    positions: Mapping[str, float],
) -> OtherPose:
    """The pose with the other joints at ``positions`` [rad, m], others of them as in the recording ``like``.

    Args:
        span: lowest and highest position of the part's motion [rad, m].

    Raises TaccorlError: the machine has no other joints, there is no recording, a name is none of another joint, or the pose must
    not be recorded."""
    pose = _begun(machine, part, like, span)
    others = [name for name in pose.robot.units if name != part]
    for name in positions:
        if name not in others:
            raise TaccorlError(
                f"--pose: {name} is no other joint of {machine.name}; {nearest(name, others)}"
            )
    pose = dataclasses.replace(pose, positions=dict(positions))
    if why := pose.wrong():
        raise TaccorlError(f"--pose: {why}; give other positions")
    return pose


def chosen_pose(
    machine: Machine,
    part: str,
    like: Measurement | None,
    span: tuple[float, float],
    others: Sequence[str],
) -> OtherPose:
    """Of ``TRIED`` random poses within ``FARTHEST`` of the present one the one with the greatest ``change`` that may be recorded.

    Args:
        span: lowest and highest position of the part's motion [rad, m].
        others: joints whose position changes what the part carries.

    Raises:
        TaccorlError: there is no recording, or none of the poses may be recorded.
    """
    begun, rng = _begun(machine, part, like, span), np.random.default_rng(0)
    model, joints = begun.robot.robot.rigid.model, begun.robot.robot.rigid.joints
    poses = []
    for _ in range(TRIED):
        positions = {}
        for name in others:
            now, far = (
                float(begun.here[model.joint(name).qposadr[0]]),
                FARTHEST[joints[name].unit],
            )
            low, high = joints[name].limits or (-np.inf, np.inf)
            room = 0.05 * (high - low) if np.isfinite(high - low) else 0.0
            positions[name] = float(
                rng.uniform(
                    max(now - far, min(low + room, now)),
                    min(now + far, max(high - room, now)),
                )
            )
        poses.append(
            dataclasses.replace(
                begun, positions={n: round(x, 3) for n, x in positions.items()}
            )
        )
    why = ""
    for pose in sorted(poses, key=lambda pose: -pose.change()):
        if not (found := pose.wrong()):
            return pose
        why = why or found
    raise TaccorlError(
        f"no pose of {', '.join(others)} near the present one may be recorded ({why}); state one: --pose={{…}}"
    )


def _begun(
    machine: Machine, part: str, like: Measurement | None, span: tuple[float, float]
) -> OtherPose:
    if not isinstance(machine, RobotMachine):
        raise TaccorlError(f"--pose: {machine.name} has no other joints; remove it")
    if like is None:
        raise TaccorlError(
            f"--pose: no recording states the present pose of {part}; give --measurements="
        )
    whole = machine.robot.joint(part).whole(like)
    return OtherPose(
        machine, part, whole, machine.robot.joint(part).pose(whole), {}, span
    )


def touching(
    model: mujoco.MjModel, data: mujoco.MjData, pose: np.ndarray
) -> set[tuple[int, int]]:
    """Pairs of bodies, by their ids, whose shapes touch at ``pose`` (nq,) [rad, m]."""
    data.qpos[:] = pose
    mujoco.mj_fwdPosition(model, data)
    bodies = model.geom_bodyid[data.contact.geom[data.contact.dist <= 0.0]]
    return {(int(min(a, b)), int(max(a, b))) for a, b in bodies}


def _name(model: mujoco.MjModel, body: int) -> str:
    return model.body(body).name or f"body {body}"


def in_other_pose(problem: Startable, pose: OtherPose, new: str) -> Startable:
    """``problem`` with the recording ``new`` in another pose than the others. There an ``unbalance`` has the sine and cosine of a
    base that leans as little as explains it in the present pose; other effects are as they are."""
    here, there = (
        weights_by_turn(pose.robot.robot, pose.part, [at])
        for at in (pose.here, pose.there)
    )
    turned = there @ np.linalg.pinv(here, rcond=1e-6)

    def moved(e: Effect) -> Effect:
        if not isinstance(e, Unbalance):
            return e
        sine, cosine = turned @ [
            e.torque_nm * np.cos(e.hangs_at_rad),
            -e.torque_nm * np.sin(e.hangs_at_rad),
        ]
        other = copy.copy(e)  # also beyond the largest torque of a search
        other.torque_nm, other.hangs_at_rad = (
            float(np.hypot(sine, cosine)),
            float(np.arctan2(-cosine, sine)),
        )
        return other

    def simulate_all(
        cases: Sequence[Case], recordings: Sequence[Recording]
    ) -> list[list[np.ndarray]]:
        there = [(base, [moved(e) for e in effects]) for base, effects in cases]
        return [
            problem.simulate_all(there if r.name == new else cases, [r])[0]
            for r in recordings
        ]

    changed = copy.copy(problem)
    changed.simulate_all = simulate_all
    changed.simulate = lambda base, effects, recording: simulate_all(
        [(base, effects)], [recording]
    )[0][0]
    return changed

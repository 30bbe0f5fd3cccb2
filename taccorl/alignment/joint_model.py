"""One joint of the twin against one recording, in about a millisecond: what identification runs thousands of times.

The other joints move as they were measured. Inertia and weight are those of the compiled arm, so what is identified here holds
in the twin; ``tests/alignment/test_joint_model.py`` compares with MuJoCo, effect by effect, and with the whole twin.

Letters in shapes: T rows.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from taccorl.alignment import arm_bench
from taccorl.alignment.arm_bench import Rigid, of_joint, split_signal
from taccorl.alignment.joint_kernel import Drive, simulate
from taccorl.alignment.joint_motion import JointMotion as JointMotion
from taccorl.alignment.joint_motion import joint_motion as joint_motion
from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.effects.effect import Effect
from taccorl.sim.twin import TwinConfig

GRAVITY_M_PER_S2 = 9.81
_COMMAND_HZ = 150.0  # taccorl.sim.replay sends slower rows in straight lines of such steps
_ADDITIVE = {
    "added_inertia",
    "viscous",
    "quadratic_drag",
    "coulomb",
    "load_friction",
    "command_delay",
    "encoder_delay",
    "speed_delay",
}
_FACTORS = {"gravity_carried", "torque_scale", "encoder_scale"}


class Gains(NamedTuple):
    """τ = K_p (q* − q) − K_d q̇ + T_ref. Of a sliding axis N/m, N·s/m, N."""

    kp: float
    """N·m/rad."""
    kd: float
    """N·m·s/rad."""
    torque_ff: float
    """N·m."""


class PayloadLever(NamedTuple):
    """By how much a payload whose place no recording states is off the place where the twin has it: m g (s sin q + c cos q)."""

    sin_m: float = 0.0
    """s."""
    cos_m: float = 0.0
    """c."""


AT_ITS_PLACE = PayloadLever()


@dataclass(frozen=True)
class JointResponse:
    """What the joint did, row by row with the recording."""

    reported: np.ndarray
    """(T,) rad."""
    effort: np.ndarray
    """(T,) N·m that the motor gives at the time of each row, before its command acts: ``Replay.effort`` of the row before."""


class JointModel:
    """A joint of the twin ``config``, effects of the config that act on it included.

    Raises:
        TaccorlError: no such joint, or a gripper.
    """

    def __init__(self, config: TwinConfig, signal: str) -> None:
        arm, joint = split_signal(signal)
        k = ROBOT.joints.index(joint)
        control = config.controller_of(arm)
        self.signal = signal
        self.unit: Literal["rad", "m"] = "rad"
        self.gains = Gains(control.kp_nm_per_rad[k], control.kd_nms_per_rad[k], control.torque_ff_nm[k])
        """As the twin's config has them."""
        self.timestep_s = config.physics.timestep_s
        self._config: TwinConfig | None = config
        self._own = of_joint(config.effects, signal)
        self._rigid: dict[tuple, Rigid] = {}

    @classmethod
    def axis(
        cls,
        name: str,
        inertia: float,
        *,
        gains: Gains,
        unit: Literal["rad", "m"] = "rad",
        timestep_s: float = 1.0 / 1200.0,
    ) -> "JointModel":
        """An axis that is not the arm's: an inertia [kg m²], or a mass [kg] on a slide with ``unit`` m, without weight.

        Effects reach it by ``Effect.drive`` whatever joints they name; those without one are refused.
        """
        model = cls.__new__(cls)
        model.signal, model.unit, model.gains, model.timestep_s = name, unit, gains, timestep_s
        model._config, model._own, model._rigid = None, [], {(): Rigid(inertia)}
        return model

    def simulate(
        self, motion: JointMotion, gains: Gains, effects: Sequence[Effect] = (), lever: PayloadLever = AT_ITS_PLACE
    ) -> JointResponse:
        """Its answer to the recording's targets, from rest at ``motion.start``.

        Args:
            gains: those of a recording with ``kp_scale`` = 1.
            effects: besides the config's; one of the same name takes the place of the config's.
            lever: left out where effects have no ``drive`` and MuJoCo runs.

        Raises:
            TaccorlError: rows that are no whole number of physics steps, or an effect that an axis cannot have.
        """
        sent, parts, hold = self._sent(motion)
        present = self._effects(effects)
        kp, kd = gains.kp * motion.kp_scale, gains.kd * motion.kd_scale
        scaled = Gains(kp, kd, gains.torque_ff)
        drives = [(effect.name, effect.drive()) for effect in present]
        numbers = _combined([(name, drive) for name, drive in drives if drive is not None])
        if numbers is None or any(drive is None for _, drive in drives):
            return self._in_mujoco(motion, scaled, present, sent, parts, hold)
        bodies = [effect for effect, (_, drive) in zip(present, drives, strict=True) if not drive]
        drive = Drive(*scaled, **self._body(motion, bodies)._asdict())._replace(**numbers)
        weight = 0.0 if motion.payload_at_known else motion.payload_kg * GRAVITY_M_PER_S2
        drive = drive._replace(
            gravity_sin=drive.gravity_sin + weight * lever.sin_m,
            gravity_cos=drive.gravity_cos + weight * lever.cos_m,
        )
        drive = Drive(*(float(x) for x in drive))
        reported, effort = simulate(drive, sent, motion.coupling_nm, motion.start, hold, parts, self.timestep_s)
        return JointResponse(reported, effort)

    def carried_nm(self, motion: JointMotion, angles: np.ndarray) -> np.ndarray:
        """(T,) what the motor gives besides its effort to carry the weight that it knows of, at ``angles`` (T,) rad."""
        body = self._body(motion, [])
        return body.compensation_sin * np.sin(angles) + body.compensation_cos * np.cos(angles)

    def inertia_kgm2(self, motion: JointMotion) -> float:
        """Of the joint with all that it moves in the recording's pose, rotor and known payload included."""
        return self._body(motion, []).inertia

    def weight_nm(self, motion: JointMotion, angles: np.ndarray) -> np.ndarray:
        """(T,) weight that the controller has to hold at ``angles`` (T,) rad: what is not carried for it."""
        body = self._body(motion, [])
        sine, cosine = body.gravity_sin - body.compensation_sin, body.gravity_cos - body.compensation_cos
        return sine * np.sin(angles) + cosine * np.cos(angles)

    def is_weighed(self, motion: JointMotion) -> bool:
        """Whether weight acts about the joint: not about one whose axis is vertical."""
        body = self._body(motion, [])
        return math.hypot(body.gravity_sin, body.gravity_cos) > 1e-6

    def _effects(self, effects: Sequence[Effect]) -> list[Effect]:
        if self._config is None:
            return [effect for effect in effects if not effect.is_absent]
        names = {effect.name for effect in effects}
        return of_joint([*(e for e in self._own if e.name not in names), *effects], self.signal)

    def _body(self, motion: JointMotion, bodies: Sequence[Effect]) -> Rigid:
        if self._config is None:
            return self._rigid[()]
        key = (motion.pose.tobytes(), motion.payload_kg, motion.payload_at_m, *map(repr, bodies))
        if key not in self._rigid:
            if len(self._rigid) > 1000:  # a search that changes bodies would fill the memory
                self._rigid.clear()
            self._rigid[key] = arm_bench.rigid(
                self._config, self.signal, motion.pose, motion.payload_kg, bodies, motion.payload_at_m
            )
        return self._rigid[key]

    def _sent(self, motion: JointMotion) -> tuple[np.ndarray, int, int]:
        """Targets as ``taccorl.sim.replay`` sends them: (T · parts,), parts, and physics steps for each."""
        steps = 1.0 / (motion.rate_hz * self.timestep_s)
        if abs(steps - round(steps)) > 1e-6 * steps or round(steps) < 1:
            raise TaccorlError(
                f"{motion.name}: {motion.rate_hz:g} Hz is {steps:.3f} physics steps of {self.timestep_s * 1e3:.3f} ms a "
                f"row; bring it to {1 / (max(1, round(steps)) * self.timestep_s):g} Hz first (Measurement.resampled)"
            )
        parts = math.ceil(_COMMAND_HZ / motion.rate_hz)
        while round(steps) % parts:
            parts -= 1
        if parts == 1:
            return motion.target, 1, round(steps)
        following = np.append(motion.target[1:], motion.target[-1])
        share = np.arange(1, parts + 1) / parts
        sent = motion.target[:, None] + share * (following - motion.target)[:, None]
        return sent.ravel(), parts, round(steps) // parts

    def _in_mujoco(
        self, motion: JointMotion, gains: Gains, effects: Sequence[Effect], sent: np.ndarray, parts: int, hold: int
    ) -> JointResponse:
        if self._config is None:
            unknown = [effect.name for effect in effects if effect.drive() is None]
            raise TaccorlError(
                f"{self.signal}: an axis without an arm knows effects by their numbers in the one-joint model, and "
                f"{' and '.join(unknown or sorted(e.name for e in effects))} cannot be had there; leave it out"
            )
        steps = np.arange(len(sent) * hold) / (parts * hold)
        coupling = np.interp(steps, np.arange(len(motion.coupling_nm)), motion.coupling_nm)
        reported, effort = arm_bench.run(
            self._config,
            self.signal,
            sent,
            hold,
            coupling,
            gains=gains,
            start=motion.start,
            pose=motion.pose,
            payload_kg=motion.payload_kg,
            payload_at_m=motion.payload_at_m,
            effects=effects,
        )
        return JointResponse(reported[::parts], effort[::parts])


def _combined(drives: Sequence[tuple[str, Mapping[str, float]]]) -> dict[str, float] | None:
    """One set of numbers; None where two effects want one number that does not simply add up."""
    numbers: dict[str, float] = {}
    one_way = 0.0  # a F of asymmetric friction, a constant torque
    for name, drive in drives:
        one_way += drive.get("coulomb", 0.0) * drive.get("asymmetry", 0.0)
        for key, value in drive.items():
            if key not in Drive._fields:
                raise TaccorlError(f"effect {name}: drive() names {key!r}, which the one-joint model lacks")
            if key not in numbers:
                numbers[key] = value
            elif key in _ADDITIVE:
                numbers[key] += value
            elif key in _FACTORS:
                numbers[key] *= value
            else:
                return None
    if numbers.get("coulomb"):
        numbers["asymmetry"] = one_way / numbers["coulomb"]
    return numbers

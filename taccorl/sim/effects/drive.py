"""Effects in the drive: what its controller does, and what the motor makes of the controller's torque."""

import math
import warnings
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, ClassVar

import mujoco
import numpy as np

from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.effects.effect import (
    ArmEffect,
    JointEffect,
    Memory,
    Parameter,
    effect,
    number,
)
from taccorl.sim.effects.live_model import LiveModel

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig

_GAINS = ("actuator_gainprm", "actuator_biasprm")
_LEFT = 1e-6  # of K_p within a dead band: the command that has arrived, delays included, is read off MuJoCo's force
_POSITION = 1  # mjINPUT_POS of mjtype.h, for which Python has no name
MOST_LOST = 0.5
"""Largest share of a joint's inertia by which ``speed_delay`` may reduce it in MuJoCo. A choice with which all six joints are
stable. A longer delay is applied in part, with a warning."""
POSES = 64
"""Number of random poses of the arm in which the inertia of its joints is computed."""


@effect("error_deadband", slot="law", needs=("target", "position"))
class ErrorDeadband(JointEffect):
    """Dead band of the position error: τ = K_p d(q* − q) − K_d q̇ + T_ref with d(e) = e − w sign e beyond ± w, and 0 within.

    Whether the error is in the band is determined at the end of each physics step, for the next step. The error is that of the
    joint's angle times an encoder's scale; an encoder's bias and an integral are not subject to the dead band."""

    rewrites: ClassVar = _GAINS
    kept: ClassVar = ("error_rad",)
    width_rad: float = number("w", "rad", 0, 0.005, (0, 0.1))

    def look(self, live: LiveModel) -> Sequence[np.ndarray]:
        return (live.error_rad(self.acts_on()),)

    def rewrite(self, live: LiveModel, memory: Memory) -> None:
        error, motors = memory["error_rad"], live.actuators(self.acts_on())
        gain, bias = live.own("actuator_gainprm"), live.own("actuator_biasprm")
        inside = np.abs(error) <= self.width_rad
        stiffness = -bias[:, motors, 1]
        bias[:, motors, 0] -= np.where(
            inside, 0.0, stiffness * self.width_rad * np.sign(error)
        )
        bias[:, motors, 1] *= np.where(inside, _LEFT, 1.0)
        gain[:, motors, 0] *= np.where(
            inside & ~live.integrates(self.acts_on()), _LEFT, 1.0
        )


@effect("gravity_mismatch", slot="law", needs="weight")
class GravityMismatch(ArmEffect):
    """Error of the gravity compensation: τ_comp = s c g(q), with the configured share c (``robot.gravity_compensation``). The
    controller's masses differ from the arm's by the factor s.

    At rest a joint deviates from its target by (s − 1) c g(q) / K_p, which is greatest when the arm is stretched out."""

    share: float = number(
        "s", "1", 1, 0.9, (0, 2),
        "the two published mass sets of this arm: 3.6 and 2.2 kg moving (taccorl/robots/bimanual_piper.py)", over_kp=True,
    )  # fmt: skip

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for arm in self.arms():
            for body in spec.bodies:
                if body.name.startswith(f"{arm}_"):
                    body.gravcomp *= self.share


@effect("integral_action", slot="law", needs=("target", "position"))
class IntegralAction(JointEffect):
    """Integral part of the controller: τ = K_p (q* − q) + K_p r I − K_d q̇ + T_ref with İ = q* − q. A joint at rest beside its
    target moves to it at rate r.

    At the start of an episode or a replay, I has the value that holds the joint where it is. A physics step applies I_n and
    computes I_{n+1} = I_n + h (q*_n − q_n). Implemented as MuJoCo's PID actuator. An encoder's bias on the same joint is not
    integrated. Laws velocity and cascade: τ = K_d (u + r ∫ u dt), u = q̇* − q̇ or K_p / K_d (q* − q) − q̇; r is 1 / T_i."""

    rate_per_s: float = number(
        "r",
        "1/s",
        0,
        0.5,
        (0, 500),
        "a choice: K_i / K_p; position loops have up to 5, loops of speed 10 to 200",
    )

    @classmethod
    def starts(cls, seen: Mapping[str, float]) -> list[dict[str, float]]:
        """Start values of a search, parameter → value each: rates of slow position loops, and those of velocity loops."""
        return [*super().starts(seen), {"rate_per_s": 6.0}, {"rate_per_s": 25.0}]

    def feel(
        self, live: LiveModel, memory: Memory, ids: np.ndarray, dt_s: float
    ) -> None:
        if (
            dt_s == 0
        ):  # at rest for ever: the integral has balanced what acts on the joint
            motors, dofs = live.actuators(self.acts_on()), live.dofs(self.acts_on())
            lever = (
                live.model.actuator_gear[motors, 0]
                * live.model.actuator_gainprm[motors, 0]
            )
            left_nm = live.seen("qfrc_smooth")[np.ix_(ids, dofs)]
            live.seen("act")[np.ix_(ids, live.integrals(self.acts_on()))] -= (
                left_nm / lever
            )

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for name in self.acts_on():
            actuator = spec.actuator(name)
            if actuator.gaintype == mujoco.mjtGain.mjGAIN_PID:
                raise TaccorlError(
                    f"effect {self.name}: {name} has an integral already, and the loop of a twin has one; remove one effect"
                )
            kp, bias = actuator.gainprm[0], actuator.biasprm.copy()
            actuator.set_to_pid(
                kp=kp, kv=-bias[2], ki=kp * self.rate_per_s, ctrlspec=_POSITION
            )
            scale = (
                -bias[1] / kp
            )  # of an encoder: what this actuator sees and integrates is scale · q
            actuator.gear[0] *= scale
            actuator.gainprm[0] /= scale
            actuator.biasprm[:3] = [bias[0] / scale, -kp / scale, bias[2] / scale**2]


@effect("position_integral", slot="law", needs=("target", "position"))
class PositionIntegral(IntegralAction):
    """Integral part of the position loop of a cascade: τ = K_d (u + …), u = K_p / K_d (e + r ∫ e dt) − q̇ with e = q* − q, where
    ``integral_action`` is the integral of u in the speed loop.

    In a loop that is no cascade both effects are the same: laws impedance and pwm of axis and robot files have only
    ``integral_action``, and a twin in MuJoCo has one of them at a joint."""

    rate_per_s: float = number(
        "r", "1/s", 0, 1.0, (0, 100), "a choice: position loops have up to 5"
    )


# MuJoCo reduces an inertia, when all other effects on it are there
@effect("speed_delay", slot="load", needs="velocity")
class SpeedDelay(JointEffect):
    """Delay τ of the velocity in the controller: −K_d (q̇ − τ q̈), to first order in τ an inertia of −K_d τ.

    τ is the sum of half a sampling period for the difference of two samples, half a period for the output that is held, and the
    time constant of the velocity's filter. The diagnosis fits τ with the gains if the recordings determine it (recorded effort,
    known weight, commanded gains), so that it is not a candidate of the search. The one-joint model has a low-pass, −K_d w with
    τ ẇ = q̇ − w. In a whole twin in MuJoCo only the inertia is changed, and efforts lack K_d τ q̈, which the motor supplies."""

    fitted: ClassVar = False
    delay_s: float = number(
        "τ", "s", 0, 2e-4, (0, 3e-3),
        "a choice: typical is a loop of 5 kHz; at most one of 1 kHz that filters its speed over 2 ms",
    )  # fmt: skip

    @classmethod
    def accepted(cls, p: Parameter) -> tuple[float, float]:
        return (
            -p.high,
            p.high,
        )  # below 0: a speed that is newer than the difference of two samples of the file's loop

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        joints = list(self.chosen(spec))
        least = _least_inertia(spec, [joint.name for joint in joints])
        for joint, inertia in zip(joints, least, strict=True):
            arm, name = joint.name.split("_", 1)
            control = config.controller_of(arm)
            kd, most = (
                control.kd_nms_per_rad[ROBOT.joints.index(name)],
                MOST_LOST * inertia,
            )
            lost = kd * self.delay_s
            joint.armature -= min(lost, most)
            if lost > most:
                warnings.warn(
                    f"effect speed_delay: {joint.name}: {1e3 * self.delay_s:.3g} ms would reduce the inertia by {lost:.3g} "
                    f"kg·m², more than {MOST_LOST:.0%} of the least inertia that the joint has in any pose, {inertia:.3g} "
                    f"kg·m²; MuJoCo applies {1e3 * most / kd:.3g} ms",
                    stacklevel=2,
                )


def _least_inertia(spec: mujoco.MjSpec, names: list[str]) -> np.ndarray:
    """(J,) kg·m² of joints, 1 / (M⁻¹)_jj, the least of ``POSES`` drawn poses: below it no pose has a mass matrix that is not
    positive."""
    model = spec.compile()
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    ids = [model.joint(name).id for name in names]
    dofs, places = model.jnt_dofadr[ids], model.jnt_qposadr[ids]
    least = np.full(len(names), np.inf)
    unit, answer = np.eye(model.nv)[dofs], np.empty((len(dofs), model.nv))
    for _ in range(POSES):
        data.qpos[places] = rng.uniform(*model.jnt_range[ids].T)
        mujoco.mj_forward(model, data)
        mujoco.mj_solveM(model, data, answer, unit)
        least = np.minimum(least, 1.0 / answer[np.arange(len(dofs)), dofs])
    return least


class _ScaledTorque(JointEffect):
    """Base of effects that scale the motor's whole torque, gravity compensation included; efforts are the scaled torques."""

    rewrites: ClassVar[tuple[str, ...]] = (*_GAINS, "qfrc_applied")
    kept: ClassVar[tuple[str, ...]] = ("carried_nm",)

    def look(self, live: LiveModel) -> Sequence[np.ndarray]:
        return (live.of_joints("qfrc_gravcomp", self.acts_on()),)

    def scale(self, live: LiveModel, memory: Memory, factor: np.ndarray) -> None:
        """Scale controller and gravity compensation by ``factor`` (N, number of joints, or 1)."""
        for name in _GAINS:
            live.own(name)[:, live.actuators(self.acts_on())] *= factor[..., None]
        live.scale_carried(self.acts_on(), memory["carried_nm"], factor)


@effect("direction_gain", slot="torque", needs="effort")
class DirectionGain(_ScaledTorque):
    """Gain of the drive that differs with the direction: where the motor's torque τ, gravity compensation included, is negative,
    it is g τ. A drive that commands a speed (laws ``cascade`` and ``velocity`` of axis and robot files) has g q̇* where the
    commanded speed q̇* is negative, and its torque is not scaled.

    Of a cylinder with one rod g is a ratio of areas: pressure on the rod's side gives less force, and the same flow more speed.
    Whether the torque is negative is determined at the end of each physics step, for the next step."""

    kept: ClassVar = ("carried_nm", "motor_nm")
    factor: float = number(
        "g",
        "1",
        1,
        0.7,
        (0.2, 5),
        "a choice: areas of one-rod cylinders differ by 1.2 to 2",
    )

    def look(self, live: LiveModel) -> Sequence[np.ndarray]:
        return (*super().look(live), live.motor_torque_nm(self.acts_on()))

    def rewrite(self, live: LiveModel, memory: Memory) -> None:
        self.scale(live, memory, np.where(memory["motor_nm"] < 0.0, self.factor, 1.0))


@effect("torque_fade", slot="torque", needs="effort")
class TorqueFade(_ScaledTorque):
    """Loss of torque over time: τ_motor = [1 − t / T_f]₊ (K_p (q* − q) − K_d q̇ + T_ref + c g(q)), with the time t since the
    reset and the rate 1 / T_f."""

    rate_per_min: float = number("R", "1/min", 0, 0.3, (0, 3))

    def rewrite(self, live: LiveModel, memory: Memory) -> None:
        left = np.maximum(1.0 - self.rate_per_min / 60 * live.seen("time"), 0.0)
        self.scale(live, memory, left.reshape(-1, 1))


@effect("torque_lag", slot="torque", needs="effort")
class TorqueLag(JointEffect):
    """Lag of the motor's torque: T τ̇ = u − τ with the controller's output u = K_p (q* − q) − K_d q̇ + T_ref. The gravity
    compensation does not lag.

    Backward Euler, so that the effect vanishes with T: with β = h / (h + T) a physics step applies τ_{n+1} = β u_{n+1} + (1 − β)
    τ_n, where MuJoCo evaluates u_{n+1} at the end of the step as it does without lag: the actuator's gains are β K_p, β K_d, and
    its bias is β T_ref + (1 − β) τ_n. At the start of an episode or a replay τ = u."""

    rewrites: ClassVar = _GAINS
    kept: ClassVar = ("torque_nm", "new_share")
    time_constant_s: float = number(
        "T",
        "s",
        0,
        0.005,
        (0, 0.1),
        "a choice: a winding's L / R and the drive's filters",
    )

    def memory(self, num_sims: int, pad_shape: tuple[int, int]) -> Memory:
        memory = super().memory(num_sims, pad_shape)
        memory["new_share"] += 1.0  # without lag until it is known what it begins with
        return memory

    def feel(
        self, live: LiveModel, memory: Memory, ids: np.ndarray, dt_s: float
    ) -> None:
        torque, pid = (
            live.seen("actuator_force")[:, live.actuators(self.acts_on())],
            live.integrates(self.acts_on()),
        )
        if dt_s == 0:  # an integral balances the joint at rest
            torque[:, pid] -= live.of_joints("qfrc_smooth", self.acts_on())[:, pid]
        step_s = live.model.opt.timestep
        memory["torque_nm"][ids], memory["new_share"][ids] = (
            torque[ids],
            step_s / (step_s + self.time_constant_s),
        )

    def rewrite(self, live: LiveModel, memory: Memory) -> None:
        motors, share = live.actuators(self.acts_on()), memory["new_share"]
        for name in _GAINS:
            live.own(name)[:, motors] *= share[..., None]
        live.own("actuator_biasprm")[:, motors, 0] += (1 - share) * memory["torque_nm"]


@effect("torque_saturation", slot="torque", needs="effort")
class TorqueSaturation(JointEffect):
    """Limit of the motor's torque: |τ| ≤ τ_max, where τ is the sum of the controller's torque and the gravity compensation.

    Implemented by MuJoCo's ``actuatorfrcrange`` with ``actuatorgravcomp``, a limit at the joint. While the limit is reached, K_d
    does not damp the motion."""

    torque_max_nm: float = number(
        "τ_max", "N·m", math.inf, 8, (0.05, 200),
        "torque range of the MIT mode, ±8 N·m by default (piper_sdk issues 73, 91 and 99)", over_kp=True,
    )  # fmt: skip

    @classmethod
    def starts(cls, seen: Mapping[str, float]) -> list[dict[str, float]]:
        """Starts of fits, name → limit [N·m]: 55 to 97 % of the largest simulated motor torque; the largest measured one."""
        peak_nm = seen.get("peak_motor_nm", seen["peak_torque_nm"])
        values = [s * peak_nm for s in (0.55, 0.75, 0.88, 0.97)] + [
            seen[n] for n in ("peak_measured_nm",) if n in seen
        ]
        return [
            {"torque_max_nm": cls.clipped("torque_max_nm", value)} for value in values
        ]

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for joint in self.chosen(spec):
            joint.actgravcomp, joint.actfrclimited = True, True
            joint.actfrcrange = [-self.torque_max_nm, self.torque_max_nm]


@effect("torque_scale", slot="torque", needs="effort")
class TorqueScale(_ScaledTorque):
    """Scale of the motor's torque: τ_motor = g (K_p (q* − q) − K_d q̇ + T_ref + c g_w(q)). The factor g acts on the controller's
    torque and on the gravity compensation c g_w(q)."""

    rewrites: ClassVar = ("qfrc_applied",)
    factor: float = number(
        "g",
        "1",
        1,
        0.8,
        (0.2, 5),
        "a choice; one firmware of this arm gives 4 times the torque (piper_sdk issue 73)",
    )

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for name in self.acts_on():
            actuator = spec.actuator(name)
            actuator.gainprm[0] *= self.factor
            actuator.biasprm[:3] *= self.factor

    def rewrite(self, live: LiveModel, memory: Memory) -> None:
        live.scale_carried(self.acts_on(), memory["carried_nm"], self.factor)


@effect("torque_speed_limit", slot="torque", needs=("effort", "velocity"))
class TorqueSpeedLimit(JointEffect):
    """Torque limit that depends on the speed: |τ| ≤ τ_s [1 − |q̇| / v₀]₊ where the motor drives (τ q̇ > 0), |τ| ≤ τ_s where it
    brakes or stands.

    A motor at supply voltage U with winding resistance R and torque constant k_t has at most τ = k_t (U − k_t q̇) / R: the
    torque-speed line of a DC motor's datasheet, from the stall torque τ_s = k_t U / R to the no-load speed v₀ = U / k_t. When
    the motor brakes, the back-EMF adds to the supply, and the drive's current limit applies; it is assumed to be at τ_s, as in
    Isaac Lab's ``DCMotor``. τ is the sum of the controller's torque and the gravity compensation; τ_s and v₀ are values at the
    joint, after the gear. The speed is that at the end of each physics step, for the next step. While the limit is reached, K_d
    does not damp the motion."""

    equals_when_wide: ClassVar = {"torque_saturation": "no_load_rad_per_s"}
    rewrites: ClassVar = ("jnt_actfrcrange",)
    kept: ClassVar = ("speed_rad_per_s",)
    stall_nm: float = number(
        "τ_s", "N·m", math.inf, 8, (0.05, 200), "as torque_saturation", over_kp=True
    )
    no_load_rad_per_s: float = number(
        "v₀", "rad/s", None, 4, (0.1, 50), "joints reach 180–225 °/s (PiPER manual)"
    )

    @classmethod
    def starts(cls, seen: Mapping[str, float]) -> list[dict[str, float]]:
        """Start values of a search: stall torques near the largest commanded torque, no-load speeds near the largest speed."""
        peak_nm, fastest = (
            seen.get("peak_motor_nm", seen["peak_torque_nm"]),
            seen["peak_speed_rad_per_s"],
        )
        ends = (("stall_nm", peak_nm), ("no_load_rad_per_s", fastest))
        pairs = ((0.7, 2.0), (1.3, 1.3), (3.0, 1.1), (1.3, 0.85))
        return [
            {
                name: cls.clipped(name, k * most)
                for (name, most), k in zip(ends, pair, strict=True)
            }
            for pair in pairs
        ]

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for joint in self.chosen(spec):
            most_nm = self.stall_nm
            if (
                joint.actfrclimited == mujoco.mjtLimited.mjLIMITED_TRUE
            ):  # torque_saturation came first
                most_nm = min(most_nm, joint.actfrcrange[1])
            joint.actgravcomp, joint.actfrclimited = True, True
            joint.actfrcrange = [-most_nm, most_nm]

    def look(self, live: LiveModel) -> Sequence[np.ndarray]:
        return (live.of_joints("qvel", self.acts_on()),)

    def rewrite(self, live: LiveModel, memory: Memory) -> None:
        speed, span = memory["speed_rad_per_s"], live.own("jnt_actfrcrange")
        joints = live.model.dof_jntid[live.dofs(self.acts_on())]
        driving_nm = self.stall_nm * np.maximum(
            1.0 - np.abs(speed) / self.no_load_rad_per_s, 0.0
        )
        least, most = span[:, joints, 0], span[:, joints, 1]
        span[:, joints, 0] = np.maximum(
            least, -np.where(speed < 0, driving_nm, self.stall_nm)
        )
        span[:, joints, 1] = np.minimum(
            most, np.where(speed > 0, driving_nm, self.stall_nm)
        )

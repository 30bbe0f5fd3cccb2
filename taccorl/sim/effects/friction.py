"""Friction of joints: dry, viscous and what is between and beyond them."""

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, ClassVar

import mujoco
import numpy as np

from taccorl.errors import TaccorlError
from taccorl.sim.effects.effect import JointEffect, Memory, effect, number
from taccorl.sim.effects.live_model import LiveModel

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig

_NO_INPUT = 16  # mjINPUT_NONE of mjtype.h, for which Python has no name
BRISTLE_DAMPING_S = 0.001
"""Damping of bristles over their stiffness [s]: they settle in a physics step."""
DRY_TIME_S, DRY_SHARE = 0.002, 0.9999
"""Time constant [s] and impedance of MuJoCo's constraint for dry friction."""
SOFT_SHARE, SOFT_MOST, SOFT_TIME_S = 0.9, 0.95, 0.02
"""Impedance without a distance and at most, and time constant [s], of MuJoCo's constraint for dry friction by default
(solimpfriction, solreffriction)."""
AT_RAD_PER_S = 0.1
"""v₁, the speed at which F of ``power_law_friction`` is stated [rad/s; m/s of a slide]. A choice."""


def add_dry_friction(joint: mujoco.MjsJoint, torque_nm: float) -> None:
    """Add dry friction that holds a joint at rest. With MuJoCo's default settings the friction is soft: it acts as a damping of
    11 N·m·s/rad on joint 5, and a joint that rests within F / K_p of its target drifts to it within a second. With the settings
    used here it drifts at 4e-6 rad/s."""
    joint.frictionloss += torque_nm
    joint.solref_friction = [DRY_TIME_S, 1.0]
    joint.solimp_friction = [DRY_SHARE, DRY_SHARE, 0.001, 0.5, 2.0]


def add_bristles(
    spec: mujoco.MjSpec, joint: str, torque_nm: float, presliding_rad: float
) -> None:
    """Add dry friction F [N·m] by Dahl's bristles, which bend by about x_p [rad] before the joint slides, as LuGre terms."""
    k = torque_nm / presliding_rad
    add_passive_torque(
        spec,
        joint,
        "presliding",
        lugre=[k, BRISTLE_DAMPING_S * k, torque_nm, torque_nm, 1.0],
    )


def add_passive_torque(
    spec: mujoco.MjSpec, joint: str, what: str, **terms: list[float]
) -> None:
    """Add the actuator ``{joint}_{what}``: MuJoCo's DC motor without input and current, of which only the ``cogging`` or
    ``lugre`` terms act. ``torque_saturation`` of the same joint limits the sum of this actuator and the motor."""
    actuator = spec.add_actuator(
        name=f"{joint}_{what}", trntype=mujoco.mjtTrn.mjTRN_JOINT, target=joint
    )
    actuator.set_to_dcmotor(
        motorconst=[0.0, 0.0], resistance=1.0, ctrlspec=_NO_INPUT, **terms
    )


class _LiveFriction(JointEffect):
    """Base of dry friction whose limit follows from the state at the end of each physics step, for the next step."""

    rewrites: ClassVar = ("dof_frictionloss",)
    kept: ClassVar = ("friction_nm",)

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for joint in self.chosen(spec):
            add_dry_friction(joint, 0.0)

    def rewrite(self, live: LiveModel, memory: Memory) -> None:
        live.own("dof_frictionloss")[:, live.dofs(self.acts_on())] += memory[
            "friction_nm"
        ]


@effect("asymmetric_friction", slot="friction", needs="velocity")
class AsymmetricFriction(JointEffect):
    """Dry friction that depends on the direction: τ = −F (1 + a sign q̇) sign q̇; at rest any τ with −F (1 + a) ≤ τ ≤ F (1 − a).
    With a > 0 friction is greater in the positive direction.

    The torque equals −F sign q̇ − a F, so that it is implemented as Coulomb friction and a constant torque. It does not come
    from the motor: efforts do not include it."""

    same_with_torque_ff: ClassVar = ("coulomb_friction",)
    torque_nm: float = number(
        "F", "N·m", 0, 0.4, (0, 20), "as coulomb_friction", over_kp=True
    )
    asymmetry: float = number("a", "1", None, 0.3, (-0.9, 0.9))

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for name, joint in zip(self.acts_on(), self.chosen(spec), strict=True):
            add_dry_friction(joint, self.torque_nm)
            # A cogging torque of no periods: its sine is 1 everywhere.
            constant = [-self.asymmetry * self.torque_nm, 0.0, math.pi / 2]
            add_passive_torque(spec, name, "asymmetry", cogging=constant)


@effect("coulomb_friction", slot="friction", needs="velocity")
class CoulombFriction(JointEffect):
    """Dry friction of a joint: τ = −F sign(q̇); at rest any τ with |τ| ≤ F. The joint stops up to F / K_p before its target.

    With x_p > 0 it has the bristles of ``presliding``, which bend before the joint slides."""

    same_with_torque_ff: ClassVar = ("asymmetric_friction",)
    optional: ClassVar = {"presliding_rad": "presliding"}
    torque_nm: float = number(
        "F", "N·m", 0, 0.4, (0, 20),
        "0.2–0.8 N·m fitted to a Unitree Go2 (iit-DLSLab/sim2real-robot-identification); 0.3 in Menagerie’s PiPER",
        over_kp=True,
    )  # fmt: skip
    presliding_rad: float = number(
        "x_p", "rad", 0, 1e-4, (0, 1e-2), "a choice; 0: the friction is rigid"
    )

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for name, joint in zip(self.acts_on(), self.chosen(spec), strict=True):
            if self.presliding_rad > 0.0 and self.torque_nm > 0.0:
                add_bristles(spec, name, self.torque_nm, self.presliding_rad)
            else:
                add_dry_friction(joint, self.torque_nm)


@effect("load_friction", slot="friction", needs=("velocity", "load"))
class LoadFriction(_LiveFriction):
    """Dry friction in proportion to the load of the gear: τ = −μ |τ_motor − τ_load| sign q̇; at rest |τ| ≤ μ |τ_motor − τ_load|.

    τ_motor is the torque of the drive, gravity compensation included. τ_load is the torque of the load on the joint: its weight
    (and Coriolis forces) pull with τ_load = −g(q), where +g(q) is the torque that holds it. So |τ_motor − τ_load| = |τ_motor +
    g(q)|: twice the weight's torque in a joint that holds it (Rhoban BAM, ICRA 2025, their model M2)."""

    kept: ClassVar = ("passed_nm",)
    share: float = number(
        "μ", "1", 0, 0.1, (0, 0.5),
        "a choice; hobby servos need such a term (Duclusaud et al., ICRA 2025; their Dynamixel XL330 logs, Rhoban/bam)",
    )  # fmt: skip

    def look(self, live: LiveModel) -> Sequence[np.ndarray]:
        return (
            np.abs(
                live.motor_torque_nm(self.acts_on())
                + live.of_joints("qfrc_bias", self.acts_on())
            ),
        )

    def rewrite(self, live: LiveModel, memory: Memory) -> None:
        live.own("dof_frictionloss")[:, live.dofs(self.acts_on())] += (
            self.share * memory["passed_nm"]
        )


@effect("gear_friction", slot="friction", needs=("velocity", "load"))
class GearFriction(_LiveFriction):
    """Loss of a gear: dry friction in proportion to the torque that its motor gives, τ = −μ |τ_motor| sign q̇; at rest |τ| ≤ μ
    |τ_motor|. τ_motor is the torque of the drive, gravity compensation included. 1 − μ is the gear's efficiency."""

    kept: ClassVar = ("passed_nm",)
    share: float = number(
        "μ", "1", 0, 0.1, (0, 0.5),
        "a choice; 1 − μ of 0.8 … 0.95 is usual for planetary, harmonic and cycloidal gears",
    )  # fmt: skip

    def look(self, live: LiveModel) -> Sequence[np.ndarray]:
        return (np.abs(live.motor_torque_nm(self.acts_on())),)

    def rewrite(self, live: LiveModel, memory: Memory) -> None:
        live.own("dof_frictionloss")[:, live.dofs(self.acts_on())] += (
            self.share * memory["passed_nm"]
        )


@effect("position_dependent_friction", slot="friction", needs=("position", "velocity"))
class PositionDependentFriction(_LiveFriction):
    """Dry friction about one angle of the joint: τ = −F(q) sign q̇ with F(q) = F₀ exp(−((q − q₀) / w)²); at rest any τ with |τ|
    ≤ F(q).

    Causes are a dent in a bearing, a cable guide, or a gear that is out of true. Armstrong-Hélouvry, "Control of Machines with
    Friction", 1991, ch. 3, measured gear friction that depends on the position. With w of about a radian the law also
    approximates F (1 + a cos(2 (q − q₀))), since cos² x ≈ exp(−x²): for a ≥ 0.6, no additional Coulomb friction is required over
    a range of ± 1 rad. It does not approximate a sinusoid of several turns, as of a bent shaft before the gear. q is the motor's
    angle."""

    equals_when_wide: ClassVar = {"coulomb_friction": "width_rad"}
    torque_nm: float = number(
        "F₀", "N·m", 0, 0.4, (0, 20), "as coulomb_friction", over_kp=True
    )
    angle_rad: float = number(
        "q₀",
        "rad",
        None,
        0.55,
        (-4, 4),
        "a choice; a search takes it from the recordings",
    )
    width_rad: float = number(
        "w", "rad", None, 0.1, (0.005, 2),
        "a choice: a tooth or a cable guide is narrow, a gear out of true is as wide as a radian",
    )  # fmt: skip

    @classmethod
    def starts(cls, seen: Mapping[str, float]) -> list[dict[str, float]]:
        """Start values of a search, parameter → value each: narrow spots side by side over the recorded range, and wide ones
        at its middle and its ends."""
        span = max(seen["span_rad"], 0.02)
        low = seen.get("lowest_rad", -0.5 * span)
        spots = [(place, 0.12) for place in np.arange(1, 12, 2) / 12] + [
            (place, 0.35) for place in (0.0, 0.5, 1.0)
        ]
        spots.sort()  # the middle one stands for all where one is enough
        most_nm = min(
            max(0.1 * seen["peak_torque_nm"], 1e-3), cls.clipped("torque_nm", math.inf)
        )
        return [
            {
                "torque_nm": most_nm,
                "angle_rad": cls.clipped("angle_rad", low + place * span),
                "width_rad": cls.clipped("width_rad", share * span),
            }
            for place, share in spots
        ]

    def look(self, live: LiveModel) -> Sequence[np.ndarray]:
        angle = live.seen("qpos")[:, live.angles(self.acts_on())]
        return (
            self.torque_nm
            * np.exp(-(((angle - self.angle_rad) / self.width_rad) ** 2)),
        )


@effect("power_law_friction", slot="friction", needs="velocity")
class PowerLawFriction(_LiveFriction):
    """Friction of grease, which thins with the shear rate (Herschel and Bulkley 1926): τ = −(F_y + F (1 + a sign q̇) (|q̇| / v₁)ⁿ)
    sign q̇ with v₁ = 0.1 rad/s (0.1 m/s of a slide) and 0 < n < 1; at rest any τ with |τ| ≤ F_y. The part F lies between Coulomb
    (n = 0) and viscous friction (n = 1); with a > 0 it is greater in the positive direction."""

    reduces_to: ClassVar = {"coulomb_friction": "exponent"}
    equals_when_wide: ClassVar = {"viscous_friction": "exponent"}
    optional: ClassVar = {"yield_nm": "coulomb_friction"}
    torque_nm: float = number(
        "F", "N·m", 0, 0.4, (0, 20), "as coulomb_friction", over_kp=True
    )
    exponent: float = number(
        "n",
        "1",
        None,
        0.4,
        (0, 1),
        "a choice; 0.7 fits a real drive (EMPS, docs/your_robot.md)",
    )
    asymmetry: float = number("a", "1", None, 0, (-0.9, 0.9))
    yield_nm: float = number(
        "F_y", "N·m", 0, 0.4, (0, 20), "as coulomb_friction", over_kp=True
    )

    @property
    def reads_as(self) -> str:
        sides = f", asymmetric by {self.asymmetry:.2g}" if self.asymmetry else ""
        return (
            f"dry friction that the speed hardly changes{sides}"
            if self.exponent < 0.1
            else ""
        )

    def look(self, live: LiveModel) -> Sequence[np.ndarray]:
        speed = live.of_joints("qvel", self.acts_on())
        grown = (
            self.torque_nm
            * (np.abs(speed) / AT_RAD_PER_S) ** self.exponent
            * (speed != 0.0)
        )
        return (self.yield_nm + grown * (1.0 + self.asymmetry * np.sign(speed)),)


@effect("presliding", slot="friction", needs=("velocity", "dry_friction"))
class Presliding(JointEffect):
    """Bristles of the Coulomb friction F that the joint has: τ = −F z / x_p, ż = q̇ − |q̇| z / x_p. After a reversal the friction
    approaches F as 1 − exp(−x / x_p) with the distance x; at rest it is a spring of stiffness F / x_p.
    Model of Dahl (1968), "A solid friction model", with exponent 1. No candidate: a search fits x_p of ``coulomb_friction``, and
    this effect only where a file states it. MuJoCo's physics step in the twin is too long for bristles below 0.1 mrad."""

    presliding_rad: float = number("x_p", "rad", 0, 1e-4, (0, 1e-2))

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for name, joint in zip(self.acts_on(), self.chosen(spec), strict=True):
            for k, other in enumerate(config.effects):
                if (
                    other.name not in ("coulomb_friction", "asymmetric_friction")
                    or name not in other.acts_on()
                ):
                    continue
                is_later, has_own = (
                    k > config.effects.index(self),
                    getattr(other, "presliding_rad", 0.0) > 0.0,
                )
                if is_later or has_own:
                    why = (
                        "comes after it; list it before"
                        if is_later
                        else "has bristles of its own; remove one"
                    )
                    raise TaccorlError(
                        f"effect presliding of {name}: {other.name} {why}"
                    )
            most_nm, joint.frictionloss = joint.frictionloss, 0.0
            if most_nm > 0.0:
                add_bristles(spec, name, most_nm, self.presliding_rad)


@effect("quadratic_drag", slot="friction", needs="velocity")
class QuadraticDrag(JointEffect):
    """Drag in proportion to the squared speed: τ = −c q̇ |q̇|. At half the speed a quarter of it remains, so that a change of
    K_d can reproduce it at one speed only. Implemented as the second coefficient of MuJoCo's polynomial joint damping."""

    drag_nms2_per_rad2: float = number(
        "c", "N·m·s²/rad²", 0, 2, (0, 50), "0.3 N·m at 0.4 rad/s", over_kp=True
    )

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for joint in self.chosen(spec):
            joint.damping[1] += self.drag_nms2_per_rad2


@effect("soft_friction", slot="friction", needs="velocity")
class SoftFriction(JointEffect):
    """MuJoCo's own dry friction (``frictionloss``), which creeps where Coulomb friction sticks: τ = −S (q̈ + b q̇), at most F
    either way, with b = 2 / (0.95 T) and S = 9 M, M = 1 / (M⁻¹)ⱼⱼ the inertia about the joint with all others free, at the
    model's zero pose. A constant torque τ < F moves it at τ / (S b): at 1 mrad/s for τ / M = 1 rad/s².

    0.9 and 0.95 are the impedances of MuJoCo's default ``solimpfriction``, T the time constant of its ``solreffriction``, which
    MuJoCo does not let below two physics steps; T = 0 stands for the default, 0.02 s. In the twin it is the friction of a tendon
    about the joint alone, beside any rigid friction of the joint."""

    optional: ClassVar = {"time_constant_s": ""}
    torque_nm: float = number(
        "F", "N·m", 0, 0.4, (0, 20), "as coulomb_friction", over_kp=True
    )
    time_constant_s: float = number(
        "T", "s", 0, 0.02, (0, 0.5), "MuJoCo's default; 0 stands for it"
    )

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for name in self.acts_on():
            tendon = spec.add_tendon(name=f"{name}_soft_friction")
            tendon.wrap_joint(name, 1.0)
            tendon.frictionloss = self.torque_nm
            time_s = self.time_constant_s or SOFT_TIME_S
            tendon.solref_friction = [time_s, 1.0]
            tendon.solimp_friction = [SOFT_SHARE, SOFT_MOST, 0.001, 0.5, 2.0]


@effect("stribeck_friction", slot="friction", needs="velocity")
class StribeckFriction(JointEffect):
    """Friction that decreases with the speed: |τ| = F (1 + s exp(−(q̇ / v_s)²)) when sliding, after an elastic deflection of up
    to x_p before sliding.

    LuGre bristle model (Canudas de Wit et al. 1995): F is the Coulomb friction, s F the additional torque of stiction.
    Implemented as MuJoCo's passive DC motor, with one additional activation in the state."""

    reduces_to: ClassVar = {"coulomb_friction": "stiction_share"}
    torque_nm: float = number(
        "F", "N·m", 0, 0.3, (0, 20), "as coulomb_friction", over_kp=True
    )
    stiction_share: float = number("s", "1", None, 1, (0, 3))
    stribeck_rad_per_s: float = number("v_s", "rad/s", None, 0.05, (0.005, 1))
    presliding_rad: float = number(
        "x_p", "rad", None, 5e-4, (1e-4, 1e-2), "stiffness of bristles: F (1 + s) / x_p"
    )

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        most_nm = self.torque_nm * (1.0 + self.stiction_share)
        stiffness = most_nm / self.presliding_rad
        for name in self.acts_on():
            lugre = [
                stiffness,
                BRISTLE_DAMPING_S * stiffness,
                self.torque_nm,
                most_nm,
                self.stribeck_rad_per_s,
            ]
            add_passive_torque(spec, name, "stribeck", lugre=lugre)


@effect("viscous_friction", slot="friction", needs="velocity")
class ViscousFriction(JointEffect):
    """Viscous friction: τ = −b q̇. For a joint that follows given targets, b has the same effect as a larger K_d: positions
    cannot distinguish them. To determine b, change the gains between recordings, or record torques."""

    damping_nms_per_rad: float = number(
        "b", "N·m·s/rad", 0, 1, (0, 50),
        "a choice; 0.15 fitted to a Unitree Go2 (iit-DLSLab/sim2real-robot-identification)", over_kp=True,
    )  # fmt: skip

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for joint in self.chosen(spec):
            joint.damping[0] += self.damping_nms_per_rad

"""Presliding: dry friction that a joint's file states already gives way like a spring before the joint slides."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import mujoco

from taccorl.errors import TaccorlError
from taccorl.sim.effects import effects
from taccorl.sim.effects.dry_friction import add_passive_torque
from taccorl.sim.effects.effect import JointEffect, parameter
from taccorl.sim.effects.stribeck_friction import BRISTLE_DAMPING_S

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig

_FRICTION = ("coulomb_friction", "asymmetric_friction")


@effects.register("presliding")
@dataclass(kw_only=True)
class Presliding(JointEffect):
    """Bristles of the Coulomb friction F that the joint has: τ = −F z / x_p, ż = q̇ − |q̇| z / x_p. After a reversal the friction
    approaches F as 1 − exp(−x / x_p) with the distance x; at rest it is a spring of stiffness F / x_p.

    Model of Dahl (1968), "A solid friction model", with exponent 1. A candidate for joints and axes whose files state
    ``coulomb_friction``; without any it does nothing. Implemented as MuJoCo's passive DC motor with its LuGre terms, in place
    of the dry friction, which must be earlier in the list of effects. The twin's physics step is too long for bristles below 0.1
    mrad there.
    """

    name: ClassVar = "presliding"
    needs: ClassVar = ("velocity", "dry_friction")
    equation: ClassVar = "τ = −F z / x_p, ż = q̇ − |q̇| z / x_p"
    in_words: ClassVar = (
        "Before it slides, a contact with dry friction bends like a brush: after each reversal friction rises over a "
        "short way."
    )
    at_a_policy: ClassVar = "At rest the joint gives way a little, and returns; small corrections are not lost."
    to_record: ClassVar = "Slow, small triangles of a few x_p, with holds; efforts show the spring."
    near_twins: ClassVar = {
        "power_law_friction": "Both soften a reversal; only bristles do so at the slowest speed: a triangle at 0.005 rad/s.",
        "stribeck_friction": "The same bristles under friction that falls with the speed: hold, then creep at 0.01 rad/s.",
    }
    presliding_rad: float = parameter(
        unit="rad",
        symbol="x_p",
        absent=0.0,
        low=0.0,
        high=1e-2,
        typical=1e-4,
        source="a choice",
    )

    def drive(self) -> dict[str, float]:
        return {"coulomb_presliding": self.presliding_rad}

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        after = config.effects[config.effects.index(self) + 1 :] if self in config.effects else []
        for name, joint in zip(self.acts_on(), self.chosen(spec), strict=True):
            for other in after:
                if other.name in _FRICTION and name in other.acts_on():
                    raise TaccorlError(
                        f"effect presliding of {name} comes before {other.name}, whose bristles it describes; list it after"
                    )
            most_nm, joint.frictionloss = joint.frictionloss, 0.0
            if most_nm > 0.0:
                stiffness = most_nm / self.presliding_rad
                lugre = [stiffness, BRISTLE_DAMPING_S * stiffness, most_nm, most_nm, 1.0]
                add_passive_torque(spec, name, "presliding", lugre=lugre)

"""Stribeck friction: greater at rest and in slow motion than in fast motion; joints stick and slip."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import mujoco

from taccorl.sim.effects import effects
from taccorl.sim.effects.dry_friction import add_passive_torque
from taccorl.sim.effects.effect import JointEffect, parameter

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig

BRISTLE_DAMPING_S = 0.001  # over their stiffness: they settle in a physics step


@effects.register("stribeck_friction")
@dataclass(kw_only=True)
class StribeckFriction(JointEffect):
    """Friction that decreases with the speed: |τ| = F (1 + s exp(−(q̇ / v_s)²)) when sliding, after an elastic deflection of up
    to x_p before sliding.

    LuGre bristle model (Canudas de Wit et al. 1995): F is the Coulomb friction, s F the additional torque of stiction.
    Implemented as MuJoCo's passive DC motor, with one additional activation in the state.
    """

    name: ClassVar = "stribeck_friction"
    needs: ClassVar = ("velocity",)
    equation: ClassVar = "|τ| = F (1 + s exp(−(q̇ / v_s)²))"
    in_words: ClassVar = (
        "Friction that is greatest at rest and falls once the joint moves, as in greased gears: the joint sticks and"
        " slips."
    )
    at_a_policy: ClassVar = (
        "Fine motion comes in jumps, and a joint that has stood still needs a larger command to start."
    )
    to_record: ClassVar = "Long holds, then creeping at 0.01 rad/s, in both directions."
    near_twins: ClassVar = {
        "presliding": "The same bristles; without friction that falls with the speed they are presliding: hold, then creep.",
        "coulomb_friction": "Alike but at the slowest; hold, then creep at 0.01 rad/s.",
    }
    reduces_to: ClassVar = {"coulomb_friction": "stiction_share"}
    torque_nm: float = parameter(
        unit="N·m",
        symbol="F",
        absent=0.0,
        low=0.0,
        high=20.0,
        typical=0.3,
        over="kp",
        source="as coulomb_friction",
    )
    stiction_share: float = parameter(
        unit="1",
        symbol="s",
        absent=None,
        low=0.0,
        high=3.0,
        typical=1.0,
        source="a choice",
    )
    stribeck_rad_per_s: float = parameter(
        unit="rad/s",
        symbol="v_s",
        absent=None,
        low=0.005,
        high=1.0,
        typical=0.05,
        source="a choice",
    )
    presliding_rad: float = parameter(
        unit="rad",
        symbol="x_p",
        absent=None,
        low=1e-4,
        high=1e-2,
        typical=5e-4,
        source="a choice; stiffness of the bristles is F (1 + s) / x_p",
    )

    def drive(self) -> dict[str, float]:
        return {
            "stribeck_torque": self.torque_nm,
            "stribeck_share": self.stiction_share,
            "stribeck_speed": self.stribeck_rad_per_s,
            "presliding": self.presliding_rad,
        }

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        most_nm = self.torque_nm * (1.0 + self.stiction_share)
        stiffness = most_nm / self.presliding_rad
        for name in self.acts_on():
            lugre = [stiffness, BRISTLE_DAMPING_S * stiffness, self.torque_nm, most_nm, self.stribeck_rad_per_s]
            add_passive_torque(spec, name, "stribeck", lugre=lugre)

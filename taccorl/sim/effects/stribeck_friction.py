"""Stribeck friction: greater at rest and in slow motion than in fast motion; joints stick and slip."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import mujoco

from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import JointEffect, parameter

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig

_BRISTLE_DAMPING_S = 0.001  # over their stiffness: they settle in a physics step
_NO_INPUT = 16  # mjINPUT_NONE of mjtype.h, for which Python has no name


@effects.register("stribeck_friction")
@dataclass(kw_only=True)
class StribeckFriction(JointEffect):
    """|τ| = F (1 + s exp(−(q̇ / v_s)²)) when sliding, after a springy presliding of up to x_p.

    LuGre bristles (Canudas de Wit et al. 1995): F is Coulomb's part, s F what stiction adds to it. Built as MuJoCo's passive DC
    motor, with one activation more in the state.
    """

    name: ClassVar = "stribeck_friction"
    torque_nm: float = parameter(
        unit="N·m",
        symbol="F",
        absent=0.0,
        low=0.0,
        high=20.0,
        typical=0.3,
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

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        most_nm = self.torque_nm * (1.0 + self.stiction_share)
        stiffness = most_nm / self.presliding_rad
        for name in self.acts_on():
            friction = spec.add_actuator(name=f"{name}_stribeck", trntype=mujoco.mjtTrn.mjTRN_JOINT, target=name)
            friction.set_to_dcmotor(
                motorconst=[0.0, 0.0],
                resistance=1.0,
                lugre=[stiffness, _BRISTLE_DAMPING_S * stiffness, self.torque_nm, most_nm, self.stribeck_rad_per_s],
                ctrlspec=_NO_INPUT,
            )

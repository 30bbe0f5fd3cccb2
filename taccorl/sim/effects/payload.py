"""Payload: a mass on the hand that the controller does not compensate."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import mujoco

from taccorl.robots import ROBOT
from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import ArmEffect, Parameter, parameter

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig

_RADIUS_M = 0.02  # of the ball, for its inertia
FARTHEST_M = 2.0
"""Largest distance that a file may state [m]: bounds of the place are those of a search on the PiPER, and robot files describe
larger machines."""


@effects.register("payload")
@dataclass(kw_only=True)
class Payload(ArmEffect):
    """Unknown payload: a ball of mass m fixed to link 6 at c. It adds the torque m g × lever arm to every joint, and its
    inertia.

    It has no contacts.
    """

    name: ClassVar = "payload"
    needs: ClassVar = ("bodies",)
    equation: ClassVar = "τ_j = −m g ∂z_c/∂q_j on every joint, and m's inertia"
    in_words: ClassVar = (
        "Something heavy is fixed to the hand that nobody told the controller of: a tool, a sensor, a camera."
    )
    at_a_policy: ClassVar = "The arm sags when it reaches out, and parts are met too low."
    to_record: ClassVar = "Holds in several poses and a slow triangle of shoulder and elbow; efforts settle the mass."
    near_twins: ClassVar = {
        "gravity_mismatch": (
            "Weight that is not carried in both; a payload weighs most on the wrist and has inertia: holds in several "
            "poses."
        ),
    }
    mass_kg: float = parameter(
        unit="kg",
        symbol="m",
        absent=0.0,
        low=0.0,
        high=1.5,
        typical=0.2,
        over="kp",
        source="a choice; the rated payload is 1.5 kg (PiPER manual)",
    )
    x_link6_m: float = parameter(
        unit="m",
        symbol="c_x",
        absent=None,
        low=-0.15,
        high=0.15,
        typical=0.0,
        source="a choice: middle of the hand",
    )
    y_link6_m: float = parameter(
        unit="m",
        symbol="c_y",
        absent=None,
        low=-0.15,
        high=0.15,
        typical=0.0,
        source="a choice: middle of the hand",
    )
    z_link6_m: float = parameter(
        unit="m",
        symbol="c_z",
        absent=None,
        low=-0.05,
        high=0.25,
        typical=0.1,
        source="a choice: between flange and pads (TCP at 0.168)",
    )

    def drive(self) -> dict[str, float]:
        return {}

    @classmethod
    def accepted(cls, p: Parameter) -> tuple[float, float]:
        return (-FARTHEST_M, FARTHEST_M) if p.unit == "m" else super().accepted(p)

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        inertia = 0.4 * self.mass_kg * _RADIUS_M**2
        for arm in self.arms():
            ball = spec.body(f"{arm}_{ROBOT.hand}").add_body(name=f"{arm}_payload")
            ball.mass, ball.explicitinertial = self.mass_kg, True
            ball.ipos = [self.x_link6_m, self.y_link6_m, self.z_link6_m]
            ball.inertia = [inertia] * 3

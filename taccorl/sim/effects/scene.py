"""Effects of contacts between parts, fixtures and pads."""

import math
from typing import TYPE_CHECKING

import mujoco

from taccorl.robots import ROBOT
from taccorl.sim.effects.effect import Effect, effect, number

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig


@effect("contact_compliance", slot="robot", needs="contact")
class ContactCompliance(Effect):
    """Contact stiffness of every part and fixture multiplied by k, and contact damping by √k, so that the damping ratio stays. k
    < 1 is softer.

    MuJoCo's contact spring acts on accelerations: under the same force a light part penetrates deeper than a heavy one."""

    stiffness_factor: float = number(
        "k",
        "1",
        1,
        0.1,
        (0.005, 2),
        "a choice; above 2 the nominal 8e5 /s² are more than a physics step can follow",
    )

    def acts_on(self) -> list[str]:
        return ["parts"]

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        arms = [f"{arm}_base_link" for arm in ROBOT.arms]
        for body in spec.worldbody.bodies:
            if body.name in arms:
                continue
            for geom in (
                *body.geoms,
                *(g for child in body.find_all("body") for g in child.geoms),
            ):
                first, second = geom.solref[:2]
                if first > 0:  # time constant and damping ratio
                    geom.solref[0] = first / math.sqrt(self.stiffness_factor)
                else:  # stiffness and damping themselves, as negative numbers
                    geom.solref[:2] = [
                        first * self.stiffness_factor,
                        second * math.sqrt(self.stiffness_factor),
                    ]


@effect("contact_friction", slot="robot", needs="contact")
class ContactFriction(Effect):
    """Sliding friction of every part and fixture with everything that touches it: μ = c μ_scene, with the coefficient μ_scene of
    the scene, randomised or not."""

    factor: float = number(
        "c",
        "1",
        1,
        0.5,
        (0.05, 4),
        "a choice; the paper draws μ from 0.3 to 0.7, App. E",
    )

    def acts_on(self) -> list[str]:
        return ["parts"]

    def friction(self, friction: float) -> float:
        return self.factor * friction

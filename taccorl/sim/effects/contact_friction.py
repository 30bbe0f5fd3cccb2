"""Contact friction: sliding friction of parts differs from the model's."""

from dataclasses import dataclass
from typing import ClassVar

from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import Effect, parameter


@effects.register("contact_friction")
@dataclass(kw_only=True)
class ContactFriction(Effect):
    """Sliding friction of every part and fixture with everything that touches it: μ = c μ_scene, with the coefficient μ_scene of
    the scene, randomised or not."""

    name: ClassVar = "contact_friction"
    needs: ClassVar = ("contact",)
    layer: ClassVar = "robot"
    equation: ClassVar = "|F_t| ≤ c μ N"
    in_words: ClassVar = (
        "Parts slip in the fingers and on each other at another force than the model says: dust, oil, wear."
    )
    at_a_policy: ClassVar = (
        "Grasps that hold in the twin slip on the robot, and parts jam or slide where they should not."
    )
    to_record: ClassVar = "A held part pulled until it slips, at two grip forces, with gripper effort recorded."
    near_twins: ClassVar = {}
    factor: float = parameter(
        unit="1",
        symbol="c",
        absent=1.0,
        low=0.05,
        high=4.0,
        typical=0.5,
        source="a choice; the paper draws μ from 0.3 to 0.7, App. E",
    )

    def acts_on(self) -> list[str]:
        return ["parts"]

    def friction(self, friction: float) -> float:
        return self.factor * friction

"""Contact compliance: parts and fixtures give way more, or less, where something presses them."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import mujoco

from taccorl.robots import ROBOT
from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import Effect, parameter

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig


@effects.register("contact_compliance")
@dataclass(kw_only=True)
class ContactCompliance(Effect):
    """Contact stiffness of every part and fixture multiplied by k, and contact damping by √k, so that the damping ratio stays. k
    < 1 is softer.

    MuJoCo's contact spring acts on accelerations: under the same force a light part penetrates deeper than a heavy one.
    """

    name: ClassVar = "contact_compliance"
    needs: ClassVar = ("contact",)
    layer: ClassVar = "robot"
    equation: ClassVar = "a = −k K r − √k B ṙ"
    in_words: ClassVar = (
        "Parts are softer, or harder, than the model says: foam, rubber or thin walls instead of solid plastic."
    )
    at_a_policy: ClassVar = (
        "Parts sink into each other where they would stop, so insertions learnt in the twin jam on the robot."
    )
    to_record: ClassVar = "The same press on two parts of different mass, with gripper effort and opening recorded."
    near_twins: ClassVar = {
        "pad_compliance": (
            "Both let the fingers close further; a part's own contact changes with its mass. Press two parts."
        ),
        "depth_offset": "A part that gives way also closes the gripper further; press two parts of different mass.",
    }
    stiffness_factor: float = parameter(
        unit="1",
        symbol="k",
        absent=1.0,
        low=0.005,
        high=2.0,
        typical=0.1,
        source="a choice; above 2 the nominal 8e5 /s² are more than a physics step can follow",
    )

    def acts_on(self) -> list[str]:
        return ["parts"]

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        arms = [f"{arm}_base_link" for arm in ROBOT.arms]
        for body in spec.worldbody.bodies:
            if body.name in arms:
                continue
            for geom in (*body.geoms, *(g for child in body.find_all("body") for g in child.geoms)):
                first, second = geom.solref[:2]
                if first > 0:  # time constant and damping ratio
                    geom.solref[0] = first / math.sqrt(self.stiffness_factor)
                else:  # stiffness and damping themselves, as negative numbers
                    geom.solref[:2] = [first * self.stiffness_factor, second * math.sqrt(self.stiffness_factor)]

"""Backlash: between motor and link there is play."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import mujoco

from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import JointEffect, parameter
from taccorl.sim.effects.transmission import add_transmission_joint

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig


@effects.register("backlash")
@dataclass(kw_only=True)
class Backlash(JointEffect):
    """The link is free within ± w of the motor (total play 2 w) and is carried along at its ends; weight decides which end.

    Controller and encoder see the motor. Built as a second, limited hinge between the motor's joint and the link, so the model
    has one joint more: ``left_joint5_backlash``. Its ends are stiff, but not rigid: 10–20 µrad remain of a play that goes to 0.
    """

    name: ClassVar = "backlash"
    play_rad: float = parameter(
        unit="rad",
        symbol="2w",
        absent=0.0,
        low=0.0,
        high=0.1,
        typical=0.005,
        source="a choice",
    )

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for motor in self.chosen(spec):
            play = add_transmission_joint(motor, "backlash")
            play.limited, play.range = True, [-self.play_rad / 2, self.play_rad / 2]
            play.solref_limit = [0.002, 1.0]
            play.solimp_limit = [0.99, 0.99, 0.001, 0.5, 2.0]

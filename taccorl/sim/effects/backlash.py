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
    """Play of the gear: the link moves freely within ± p / 2 of the motor, and the motor moves it at both ends. ``play_rad`` p is
    the whole play, from one end to the other. The weight of the link decides at which end it rests.

    Controller and encoder are on the motor's side. The effect is a second hinge with limits between the motor's joint and the
    link, so that the model has one more joint: ``left_joint5_backlash``. The limits are stiff, but not rigid: 10–20 µrad of
    motion remain if the play approaches 0.
    """

    name: ClassVar = "backlash"
    needs: ClassVar = ("position",)
    equation: ClassVar = "|q_link − q_motor| ≤ p / 2; no torque passes in between"
    in_words: ClassVar = (
        "The gear has play: the link can be turned a little by hand while the motor stands. Weight lays it against "
        "one side."
    )
    at_a_policy: ClassVar = (
        "The hand is where the encoder says only to within the play, and jumps where the weight changes sides."
    )
    to_record: ClassVar = "Chirps of less than 1°, and slow motion through poses where the weight changes sides."
    near_twins: ClassVar = {
        "joint_compliance": (
            "The link moves against the motor in both; play does so all at once and without resonance: record small "
            "motions about two poses."
        ),
        "error_deadband": (
            "Both let the joint hang within a band; weight moves it there under the encoder's eyes only with a dead "
            "band."
        ),
    }
    play_rad: float = parameter(
        unit="rad",
        symbol="p",
        absent=0.0,
        low=0.0,
        high=0.1,
        typical=0.005,
        source="a choice",
    )

    def drive(self) -> dict[str, float]:
        return {"backlash": self.play_rad}

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for motor in self.chosen(spec):
            play = add_transmission_joint(motor, "backlash")
            play.limited, play.range = True, [-self.play_rad / 2, self.play_rad / 2]
            play.solref_limit = [0.002, 1.0]
            play.solimp_limit = [0.99, 0.99, 0.001, 0.5, 2.0]

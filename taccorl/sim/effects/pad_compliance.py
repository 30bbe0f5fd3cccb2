"""Pad compliance: the pads are softer or harder than configured."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import mujoco

from taccorl.errors import TaccorlError
from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import TouchEffect, parameter

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig


@effects.register("pad_compliance")
@dataclass(kw_only=True)
class PadCompliance(TouchEffect):
    """Stiffness of a pad: k times ``robot.pad_stiffness_n_per_m``. The same force compresses the pad by 1 / k of the depth.

    A sensor's gain changes readings in the same way; only the opening of the fingers distinguishes the two.
    """

    name: ClassVar = "pad_compliance"
    needs: ClassVar = ("contact",)
    layer: ClassVar = "robot"
    equation: ClassVar = "N = k K δ"
    in_words: ClassVar = "The pads' rubber gives way more, or less, than the model says under the same force."
    at_a_policy: ClassVar = "The same command leaves another grip force and another opening; parts slip or are crushed."
    to_record: ClassVar = "Presses at three commanded forces with gripper effort and opening recorded."
    near_twins: ClassVar = {
        "k_n": (
            "A sensor's gain does the same to readings; only how far the fingers close tells them apart: record the "
            "opening."
        ),
        "contact_compliance": (
            "Both let the fingers close further; a part's own contact changes with its mass. Press two parts."
        ),
    }
    stiffness_factor: float = parameter(
        unit="1",
        symbol="k",
        absent=1.0,
        low=0.05,
        high=20.0,
        typical=0.5,
        source="a choice, as the nominal stiffness is",
    )

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        if config.robot.pads != "sprung":
            raise TaccorlError(
                f"effect pad_compliance: the twin's pads are {config.robot.pads}, without stiffness; set robot.pads to sprung"
            )
        for pad in self.pads:
            for joint in spec.joint(f"{pad}_spring").parent.joints:
                joint.stiffness[0] *= self.stiffness_factor

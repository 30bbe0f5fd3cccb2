"""Depth offset: a pad is thicker or thinner than in the model."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import parameter
from taccorl.sim.effects.pad_frame import PadFrameEffect


@effects.register("depth_offset")
@dataclass(kw_only=True)
class DepthOffset(PadFrameEffect):
    """Offset of the depth: δ = δ_model + d, as by a pad (box and taxels) that is thicker by d and touches at an opening that is
    greater by d.

    In a replay of a measured opening, every taxel is deeper by d. In the simulation, contact begins earlier, and the same
    command presses harder.
    """

    name: ClassVar = "depth_offset"
    equation: ClassVar = "δ = δ_model + d"
    in_words: ClassVar = (
        "The pads touch a little earlier or later than the model says: a thicker cover, a worn one, a gripper "
        "whose zero is off."
    )
    at_a_policy: ClassVar = (
        "Contact begins at another opening than in training, so it squeezes too hard or lets parts slip."
    )
    to_record: ClassVar = (
        "Slow presses to three depths on an object of known size: the offset shifts the opening of first touch."
    )
    near_twins: ClassVar = {
        "k_n": "With one depth only, deeper and stiffer read the same; press to three depths.",
        "taxel_threshold": (
            "A dead zone also delays the first reading; an object with a curved face shows that an offset widens the "
            "patch and a dead zone narrows it for the same peak. Press at two speeds."
        ),
        "contact_compliance": (
            "A part that gives way also closes the gripper further; press two parts of different mass."
        ),
    }
    offset_m: float = parameter(
        unit="m",
        symbol="d",
        absent=0.0,
        low=-1e-3,
        high=1e-3,
        typical=1e-4,
        source="a choice: pads are cut by hand, 3.6 mm thick (FlexiTac simulation settings)",
    )

    def offset_pad_m(self, pad: str) -> np.ndarray:
        return np.array([0.0, 0.0, self.offset_m])

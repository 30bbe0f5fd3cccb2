"""Assembly #2: a plug goes into an open cradle in the air, which supports it only if its centre of mass is inside.

The left hand holds the cradle with its open side up, the right hand slides the plug in along the cradle's axis; both lie on
the table at first, their axes along y. If it is released too early, the plug tips over the cradle's lip (the paper's failure
analysis).
"""

from pathlib import Path

import numpy as np

from taccorl.sim.part import Fit
from taccorl.sim.task import Scene, Verdict, fell, tasks
from taccorl.tasks.air_assembly.scene import LIFTED_M, AirAssembly
from taccorl.tasks.assembly_2.parts import cradle_plug, open_cradle

_COM_INSIDE_M = 0.002
_IN_TILT_RAD, _IN_LATERAL_M = (
    np.deg2rad(5.0),
    0.004,
)  # it lies on the cradle's floor, between its walls


@tasks.register("assembly_2")
class Assembly2(AirAssembly):
    """Task: insert the plug into the cradle, with both parts in the hands, then release the plug.

    Failures: ``fell_out``: the plug is in the air, and neither hand nor cradle touches it; ``unsupported``: it was released and
    hangs in the cradle with its centre of mass outside.
    """

    name = "assembly_2"
    instruction = (
        "put the violet plug into the teal cradle in the air so that it stays there"
    )
    parts = ("plug", "cradle")
    mating = (("plug", "cradle"),)
    failures = {"dropped": 0.0, "fell_out": 0.1, "unsupported": 1.0}  # noqa: RUF012
    hole = "cradle"
    expert = f"{__package__}.expert:Assembly2Expert"
    mimicgen = Path(__file__).with_name("mimicgen.yaml")

    def __init__(self, difficulty: str = "train") -> None:
        super().__init__(difficulty)
        self.plug = cradle_plug("plug")
        self.holder = open_cradle("cradle", self.clearance_m)
        self.com_from_tip_m = float(self.plug.com_part_m[2])
        """z_com; a change of mass scales all of the plug, so the point stays."""

    def look(self, scene: Scene) -> Verdict:
        fit, plug = self.fit(scene), scene.poses("plug")
        touching = scene.contact("plug", "cradle").touching
        released = ~scene.pads_touching("plug").any(1)
        in_the_air = released & ~touching & (plug[:, 2, 3] > LIFTED_M)
        com_inside_m = fit.depth_m - self.com_from_tip_m
        return Verdict(
            goal=self.joined(scene),
            failures={
                "dropped": fell(plug) | fell(scene.poses("cradle")),
                "fell_out": in_the_air,
                "unsupported": released
                & touching
                & (fit.depth_m > 0)
                & (com_inside_m <= _COM_INSIDE_M),
            },
            partial=(touching & self._inside(fit)).astype(int),
            measures={
                "depth_m": fit.depth_m,
                "com_inside_m": com_inside_m,
                "tilt_rad": fit.tilt_rad,
                "lateral_m": fit.lateral_m,
            },
        )

    def _inside(self, fit: Fit) -> np.ndarray:
        com_inside = fit.depth_m - self.com_from_tip_m > _COM_INSIDE_M
        return (
            com_inside & (fit.tilt_rad < _IN_TILT_RAD) & (fit.lateral_m < _IN_LATERAL_M)
        )

    def is_in_place(self, scene: Scene, fit: Fit) -> np.ndarray:
        return self._inside(fit) & scene.contact("plug", "cradle").touching

"""Assembly #1: a tenon goes into a mortise in the air, the axes level; with a wrong direction the plug wedges or slides off.

The left hand holds the socket, the right hand the plug; both lie on the table at first, their axes along y.
"""

from pathlib import Path

import numpy as np

from taccorl.sim.part import Fit
from taccorl.sim.task import Scene, Verdict, fell, tasks
from taccorl.tasks.air_assembly.scene import AirAssembly
from taccorl.tasks.assembly_1.parts import tenon_plug, tenon_socket

_IN_DEPTH_M, _IN_TILT_RAD, _IN_LATERAL_M = 0.034, np.deg2rad(2.0), 0.003
_WEDGED_M, _WEDGED_N = (0.004, 0.030), 15.0
_AT_MOUTH_M = (
    -0.002
)  # depth beyond which the plug's end is at the socket's face or has passed it


@tasks.register("assembly_1")
class Assembly1(AirAssembly):
    """Task: insert the plug into the socket, with both parts in the hands."""

    name = "assembly_1"
    instruction = "insert the orange plug into the grey socket in the air"
    parts = ("plug", "socket")
    mating = (("plug", "socket"),)
    # Paper, failure analysis: a wrong direction of insertion ends in wedging, or in sliding past the mortise.
    # The expert touches the socket beside the mortise for 0.2 s at most (16 scenes, simulated).
    failures = {"dropped": 0.0, "wedged": 1.0, "sliding": 1.0}  # noqa: RUF012
    hole = "mortise"
    expert = f"{__package__}.expert:Assembly1Expert"
    mimicgen = Path(__file__).with_name("mimicgen.yaml")

    def __init__(self, difficulty: str = "train") -> None:
        super().__init__(difficulty)
        self.plug = tenon_plug("plug")
        self.holder = tenon_socket("socket", self.clearance_m)
        # Let go, the plug's head hangs by what the play allows: 1.7° at 0.5 mm, 3.4° where it is easy.
        self.in_tilt_rad = max(_IN_TILT_RAD, 1.15 * 2 * self.clearance_m / _IN_DEPTH_M)

    def look(self, scene: Scene) -> Verdict:
        fit, contact = self.fit(scene), scene.contact("plug", "socket")
        beside = fit.lateral_m >= _IN_LATERAL_M
        between = (fit.depth_m > _WEDGED_M[0]) & (fit.depth_m < _WEDGED_M[1]) & ~beside
        return Verdict(
            goal=self.joined(scene),
            failures={
                "dropped": fell(scene.poses("plug")) | fell(scene.poses("socket")),
                "wedged": between & (contact.force_n > _WEDGED_N),
                "sliding": beside & (fit.depth_m > _AT_MOUTH_M) & contact.touching,
            },
            partial=self._inside(fit).astype(int),
            measures={
                "depth_m": fit.depth_m,
                "tilt_rad": fit.tilt_rad,
                "lateral_m": fit.lateral_m,
            },
        )

    def _inside(self, fit: Fit) -> np.ndarray:
        return (
            (fit.depth_m >= _IN_DEPTH_M)
            & (fit.tilt_rad < self.in_tilt_rad)
            & (fit.lateral_m < _IN_LATERAL_M)
        )

    def is_in_place(self, scene: Scene, fit: Fit) -> np.ndarray:
        return self._inside(fit)

"""Assembly #1: a tenon goes into a mortise in the air, the axes level; with a wrong direction the plug wedges or slides off.

The left hand holds the socket, the right hand the plug; both lie on the table at first, their axes along y.
"""

from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np

from taccorl.sim.part import Fit, Part, add_part, measure_fit, on_table
from taccorl.sim.randomize import OBJECT_FRICTION, symmetric
from taccorl.sim.task import Reset, Scene, Subtask, Task, Verdict, at_rest, fell, tasks
from taccorl.tasks.assembly_1.parts import tenon_plug, tenon_socket

SOCKET_AT_M, PLUG_AT_M = (0.30, 0.14), (0.30, -0.16)  # of their mating ends, nominal
HOME_RAD = {
    "left": (0.003, 1.732, -0.883, -0.528, 0.884, -1.213),
    "right": (-0.003, 1.732, -0.883, 0.528, 0.884, 1.213),
}
# The table says Δp ∈ [−0.03, 0.03] m for a part that stands on the table: x and y.
PAPER_ROWS = (
    OBJECT_FRICTION,
    symmetric("plug_position", (0.03, 0.03), "m"),
    symmetric("socket_position", (0.03, 0.03), "m"),
    symmetric("plug_mass", 0.03, "kg"),
    symmetric("socket_mass", 0.03, "kg"),
)
LIFTED_M = 0.03
_IN_DEPTH_M, _IN_TILT_RAD, _IN_LATERAL_M = 0.034, np.deg2rad(2.0), 0.003
_WEDGED_M, _WEDGED_N = (0.004, 0.030), 15.0
_AT_MOUTH_M = -0.002  # depth beyond which the plug's end is at the socket's face or has passed it


@tasks.register("assembly_1")
class Assembly1(Task):
    """Task: insert the plug into the socket, with both parts in the hands."""

    name = "assembly_1"
    instruction = "insert the orange plug into the grey socket in the air"
    parts = ("plug", "socket")
    mating = (("plug", "socket"),)
    # Paper, failure analysis: a wrong direction of insertion ends in wedging, or in sliding past the mortise.
    # The expert touches the socket beside the mortise for 0.2 s at most (16 scenes, simulated).
    failures = {"dropped": 0.0, "wedged": 1.0, "sliding": 1.0}  # noqa: RUF012
    home_rad = HOME_RAD
    rows = PAPER_ROWS
    expert = f"{__package__}.expert:Assembly1Expert"
    mimicgen = Path(__file__).with_name("mimicgen.yaml")

    def __init__(self, difficulty: str = "train") -> None:
        super().__init__(difficulty)
        self.plug: Part = tenon_plug("plug")
        self.socket: Part = tenon_socket("socket", self.clearance_m)
        # Let go, the plug's head hangs by what the play allows: 1.7° at 0.5 mm, 3.4° where it is easy.
        self.in_tilt_rad = max(_IN_TILT_RAD, 1.15 * 2 * self.clearance_m / _IN_DEPTH_M)

    def add_parts(self, spec: mujoco.MjSpec) -> None:
        add_part(spec, self.plug)
        add_part(spec, self.socket)

    def reset(self, draw: dict[str, np.ndarray]) -> Reset:
        return lying_apart(self.plug, self.socket, draw)

    def look(self, scene: Scene) -> Verdict:
        fit, contact = self._fit(scene), scene.contact("plug", "socket")
        beside = fit.lateral_m >= _IN_LATERAL_M
        between = (fit.depth_m > _WEDGED_M[0]) & (fit.depth_m < _WEDGED_M[1]) & ~beside
        return Verdict(
            goal=self._inserted(scene),
            failures={
                "dropped": fell(scene.poses("plug")) | fell(scene.poses("socket")),
                "wedged": between & (contact.force_n > _WEDGED_N),
                "sliding": beside & (fit.depth_m > _AT_MOUTH_M) & contact.touching,
            },
            partial=self._inside(fit).astype(int),
            measures={"depth_m": fit.depth_m, "tilt_rad": fit.tilt_rad, "lateral_m": fit.lateral_m},
        )

    def _fit(self, scene: Scene) -> Fit:
        mate = self.plug.mate
        assert mate is not None
        hole = scene.poses("socket") @ self.socket.holes["mortise"].part_from_hole
        return measure_fit(hole, scene.poses("plug") @ mate.part_from_mate, mate.num_turns)

    def _inside(self, fit: Fit) -> np.ndarray:
        return (fit.depth_m >= _IN_DEPTH_M) & (fit.tilt_rad < self.in_tilt_rad) & (fit.lateral_m < _IN_LATERAL_M)

    def _inserted(self, scene: Scene) -> np.ndarray:
        inside = np.asarray(~scene.pads_touching("plug").any(1))
        if inside.any():
            inside &= self._inside(self._fit(scene))
        return inside & at_rest(scene, "plug", "socket") if inside.any() else inside

    def subtasks(self) -> dict[str, tuple[Subtask, ...]]:
        return lift_and_join("socket", "plug", self._inserted)


def lying_apart(plug: Part, holder: Part, draw: dict[str, np.ndarray]) -> Reset:
    """Poses of two parts on the table with their axes along y, the holder on the left, mating ends towards each other."""
    plug_xy, holder_xy = PLUG_AT_M + draw["plug_position"], SOCKET_AT_M + draw["socket_position"]
    return Reset(
        poses={
            plug.name: on_table(plug, plug_xy, -np.pi / 2),
            holder.name: on_table(holder, holder_xy, np.pi / 2),
        },
        mass_change_kg={plug.name: float(draw["plug_mass"][0]), holder.name: float(draw["socket_mass"][0])},
        friction=float(draw["friction"][0]),
    )


def lift_and_join(holder: str, plug: str, joined: Callable[[Scene], np.ndarray]) -> dict[str, tuple[Subtask, ...]]:
    """Subtasks in which each hand lifts a part and both are joined in the air."""

    def lifted(part: str) -> Callable[[Scene], np.ndarray]:
        return lambda scene: scene.poses(part)[:, 2, 3] > LIFTED_M

    return {
        "left": (
            Subtask(name=f"grasp {holder}", done=lifted(holder)),
            Subtask(name=f"hold {holder}", done=joined),
        ),
        "right": (
            Subtask(name=f"grasp {plug}", done=lifted(plug)),
            Subtask(name=f"insert {plug}", done=joined),
        ),
    }

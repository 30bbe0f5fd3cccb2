"""A block on the table; it is lifted when its underside is 3 cm above the table's top."""

from pathlib import Path

import mujoco
import numpy as np

from taccorl.sim.part import TCP_ABOVE_M, Grasp, Part, add_part, frame_pose, on_table
from taccorl.sim.randomize import OBJECT_FRICTION, symmetric
from taccorl.sim.shapes import box_between, with_mass
from taccorl.sim.task import Reset, Scene, Subtask, Task, Verdict, fell, tasks

BLOCK_AT_M, HEIGHT_M = (0.28, -0.20), 0.040
_LIFTED_M = 0.03


@tasks.register("lift_block")
class LiftBlock(Task):
    """One hand, one part, no clearance: the same at every difficulty."""

    name = "lift_block"
    instruction = "lift the yellow block"
    parts = ("block",)
    time_limit_s = 10.0
    home_rad = {  # noqa: RUF012
        "left": (-0.310, 1.704, -0.795, 0.0, 0.749, -0.310),
        "right": (0.310, 1.704, -0.795, 0.0, 0.749, 0.310),
    }
    rows = (OBJECT_FRICTION, symmetric("block_position", (0.02, 0.02), "m"))
    expert = f"{__package__}.expert:LiftBlockExpert"
    mimicgen = Path(__file__).with_name("mimicgen.yaml")

    def __init__(self, difficulty: str = "train") -> None:
        super().__init__(difficulty)
        grasp = Grasp(part_from_tcp=frame_pose((-1, 0, 0), (0, 0, -1), (0, 0, TCP_ABOVE_M)), width_m=0.020)
        solids = with_mass([box_between((-0.020, -0.010, 0), (0.020, 0.010, HEIGHT_M), "yellow")], 0.05)
        self.block = Part(name="block", solids=solids, grasps={"top": grasp})

    def add_parts(self, spec: mujoco.MjSpec) -> None:
        add_part(spec, self.block)

    def reset(self, draw: dict[str, np.ndarray]) -> Reset:
        pose = on_table(self.block, BLOCK_AT_M + draw["block_position"], 0.0)
        return Reset(poses={"block": pose}, friction=float(draw["friction"][0]))

    def look(self, scene: Scene) -> Verdict:
        lifted = self._lifted(scene)
        return Verdict(goal=lifted, failures={"dropped": fell(scene.poses("block"))}, partial=lifted.astype(int))

    def subtasks(self) -> dict[str, tuple[Subtask, ...]]:
        def gripped(scene: Scene) -> np.ndarray:
            return np.asarray(scene.pads_touching("block")[:, 2:].all(1))

        grasp, lift = Subtask(name="grasp block", done=gripped), Subtask(name="lift block", done=self._lifted)
        return {"left": (), "right": (grasp, lift)}

    def _lifted(self, scene: Scene) -> np.ndarray:
        return scene.poses("block")[:, 2, 3] > _LIFTED_M

"""The empty bench: no parts, no goal. For sweeps, replay of joint recordings and teleoperation."""

import mujoco
import numpy as np

from taccorl.sim.task import Reset, Scene, Subtask, Task, Verdict, tasks


@tasks.register("bench")
class Bench(Task):
    """Task without parts and goal: two arms and a table."""

    name = "bench"
    instruction = "move the arms"
    parts = ()
    failures = {}  # noqa: RUF012
    home_rad = {  # noqa: RUF012
        "left": (0.003, 1.732, -0.883, -0.528, 0.884, -1.213),
        "right": (-0.003, 1.732, -0.883, 0.528, 0.884, 1.213),
    }

    def add_parts(self, spec: mujoco.MjSpec) -> None:
        """Adds nothing: the bench has no parts."""

    def reset(self, draw: dict[str, np.ndarray]) -> Reset:
        return Reset(poses={})

    def look(self, scene: Scene) -> Verdict:
        never = np.zeros(scene.num_sims, bool)
        return Verdict(goal=never, failures={}, partial=never.astype(int))

    def subtasks(self) -> dict[str, tuple[Subtask, ...]]:
        return {"left": (), "right": ()}

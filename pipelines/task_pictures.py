"""``make pictures``: the four tasks as the cameras and the pads see them, for the README (docs/task_*.png). All simulated."""

from pathlib import Path

import cv2
import numpy as np

from taccorl.demos.collect import ExpertSource, Plan
from taccorl.robots import ROBOT
from taccorl.sim.simulation import Simulation

TASKS = ("test_tube", "puzzle", "assembly_1", "assembly_2")
VIEWS = (ROBOT.cameras[0], ROBOT.cameras[-1])
MOMENTS = (0.0, 0.4, 0.75, 1.0)  # shares of the episode
SIZE = (240, 320)  # rows, columns of a picture
OUT = Path("docs")


def episode(sim: Simulation, plan: Plan, seed: int) -> np.ndarray:
    """States (T, row_size) of one successful attempt."""
    for k in range(20):
        sim.reset([seed + k])
        states = []
        for action in plan.source.actions(sim, np.random.default_rng([seed + k, 1])):
            states.append(sim.state_rows()[0])
            sim.step(action[None].astype(float))
            if sim.judge.outcome.over[0]:
                break
        if sim.judge.outcome.success[0]:
            return np.array(states)
    raise SystemExit(f"{plan.task}: no success in 20 attempts")


def main() -> None:
    """One strip a task: ``VIEWS`` at four moments."""
    for task in TASKS:
        plan = Plan(task=task, source=ExpertSource())
        sim = plan.make()
        states = episode(sim, plan, seed=1)
        chosen = states[[round(m * (len(states) - 1)) for m in MOMENTS]]
        rows = [[], []]
        for pictures in sim.render_states(chosen, VIEWS, size=SIZE):
            for row, name in zip(rows, VIEWS, strict=True):
                row.append(pictures[name])
        strip = np.concatenate([np.concatenate(row, axis=1) for row in rows])
        path = OUT / f"task_{task}.png"
        cv2.imwrite(str(path), strip[:, :, ::-1])
        print(f"{path}: {sim.task.instruction} ({len(states) / 30:.0f} s, simulated)")
        sim.close()


if __name__ == "__main__":
    main()

"""``make pictures``: the tasks as the cameras see them (docs/task_*.png), and their rows in docs/twin.md. All simulated."""

import re
from pathlib import Path

import cv2
import numpy as np

from taccorl.episodes.sources.collect import CollectPlan
from taccorl.episodes.sources.expert import ExpertSource
from taccorl.robots import ROBOT
from taccorl.sim.simulation import Simulation
from taccorl.sim.task import tasks
from taccorl.tasks.experts import tasks_with_expert

VIEWS = (ROBOT.cameras[0], ROBOT.cameras[-1])
MOMENTS = (0.0, 0.4, 0.75, 1.0)  # shares of the episode
SIZE = (240, 320)  # rows, columns of a picture
OUT = Path("docs")
PAGE = OUT / "twin.md"


def with_rows(page: str) -> str:
    """The page with one row for each task in its table of pictures."""
    rows = [f"| `{name}` | ![{tasks.get(name).instruction}](task_{name}.png) |\n" for name in tasks_with_expert()]
    return re.sub(r"(?<=^\|---\|---\|\n)(\|.*\n)+", "".join(rows), page, count=1, flags=re.MULTILINE)


def episode(sim: Simulation, plan: CollectPlan, seed: int) -> np.ndarray:
    """States (T, row_size) of one successful attempt."""
    for k in range(20):
        sim.reset([seed + k])
        states = []
        for targets in plan.source.actions(sim, np.random.default_rng([seed + k, 1])):
            states.append(sim.state_rows()[0])
            sim.step(targets.sent[None].astype(float))
            if sim.judge.outcome.over[0]:
                break
        if sim.judge.outcome.success[0]:
            return np.array(states)
    raise SystemExit(f"{plan.task}: no success in 20 attempts")


def main() -> None:
    """One strip a task: ``VIEWS`` at four moments."""
    for task in tasks_with_expert():
        plan = CollectPlan(task=task, source=ExpertSource())
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
    PAGE.write_text(with_rows(PAGE.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()

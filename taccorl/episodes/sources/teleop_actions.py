"""Action files: the actions of a finished demonstration, which executed again give the same episode.

One JSON value a line; what has other lines, or does not end with the last one, is no finished demonstration:

    {"format": "taccorl actions 1", "task": "assembly_1", "seed": 123, "twin": "…", "time_limit_s": 300, …}    the scene
    [0.003, 1.732, …]                                                           14 float32 (rad, m), one line a control step
    {"end": "finished", "outcome": "success"}
"""

import itertools
import json
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

import taccorl
from taccorl.episodes.attempt import Actions, Targets, outcome_of
from taccorl.errors import TaccorlError
from taccorl.lineage.files import write_durably
from taccorl.robots import ROBOT
from taccorl.sim.simulation import Simulation
from taccorl.sim.twin import CONTROL_HZ
from taccorl.sim.twin_file import twin_text

FORMAT = "taccorl actions 1"


def scene_of(sim: Simulation) -> dict[str, Any]:
    """Definition of the scene to which simulation 0 was reset, as JSON values: name of the property (task, seed …) → value."""
    return {
        "task": sim.task.name,
        "difficulty": sim.task.difficulty,
        "randomization": float(sim.randomization_scale),
        "seed": int(sim.seeds[0]),
        "twin": twin_text(sim.config),
    }


def give_time(sim: Simulation, seconds: float) -> None:
    """Set the time limit of an episode to ``seconds`` [s], because a person is slower than an expert."""
    sim.judge.limit_steps = round(seconds * CONTROL_HZ)


def write_actions(folder: Path, sim: Simulation, actions: Sequence[np.ndarray]) -> Path:
    """Write the float32 ``actions`` (14,) that simulation 0 of ``sim`` has executed since its reset, and the outcome that they
    had, to a new file ``folder/TASK_SEED_NNN.jsonl``; it survives a power cut, and is there as a whole or not at all."""
    scene, limit_s = scene_of(sim), sim.judge.limit_steps / CONTROL_HZ
    about = {
        "names": list(ROBOT.action_names),
        "units": "rad, gripper openings in m",
        "control_hz": CONTROL_HZ,
    }
    about |= {"created": datetime.now(UTC).isoformat(timespec="seconds")}
    about |= {"mujoco": mujoco.__version__, "taccorl": taccorl.__version__}
    # A float32 is written as the float64 of the same value, which JSON gives back exactly.
    rows = (np.asarray(action, np.float32).tolist() for action in actions)
    end = {"end": "finished", "outcome": outcome_of(sim)}
    lines = [{"format": FORMAT, **scene, "time_limit_s": limit_s, **about}, *rows, end]
    names = (
        folder / f"{scene['task']}_{scene['seed']}_{k:03d}.jsonl"
        for k in itertools.count()
    )
    path = next(name for name in names if not name.exists())
    write_durably(path, "".join(f"{json.dumps(line)}\n" for line in lines))
    return path


@dataclass(frozen=True)
class ActionFile:
    """Content of one action file: scene, actions of a demonstration, and how it ended."""

    path: Path
    header: dict[str, Any]
    """First line of the file: the scene, versions."""
    actions: np.ndarray
    """(T, 14) float32 actions [rad, m]."""
    end: str | None
    """``finished``; other values, and None, are of demonstrations that were not."""
    outcome: str | None
    """``success``, or the failure's category."""

    @classmethod
    def read(cls, path: Path) -> "ActionFile":
        """Read a file. Raises TaccorlError: it is not an action file, or damaged; the message names file and line."""
        values: list[Any] = []
        try:
            for line in (
                Path(path).read_text(encoding="utf-8").rpartition("\n")[0].splitlines()
            ):  # the last one is whole
                values.append(json.loads(line))
        except (OSError, ValueError) as error:
            raise TaccorlError(
                f"{path}:{len(values) + 1}: is damaged: {error}"
            ) from error
        header = values[0] if values else None
        if not isinstance(header, dict) or header.get("format") != FORMAT:
            raise TaccorlError(
                f"{path}: is not an action file: its first line must contain {FORMAT!r}"
            )
        last = values.pop() if isinstance(values[-1], dict) and len(values) > 1 else {}
        for k, row in enumerate(rows := values[1:], 2):
            if not isinstance(row, list) or len(row) != len(ROBOT.action_names):
                raise TaccorlError(
                    f"{path}:{k}: expected {len(ROBOT.action_names)} numbers, found {str(row)[:60]}"
                )
        actions = np.array(rows, np.float32).reshape(-1, len(ROBOT.action_names))
        return cls(Path(path), header, actions, last.get("end"), last.get("outcome"))


def find_finished(folder: Path, scene: dict[str, Any]) -> ActionFile | None:
    """The newest finished demonstration of the same scene, recorded with this version of MuJoCo; None without one."""
    wanted = {**scene, "mujoco": mujoco.__version__}
    for path in sorted(
        folder.glob(f"{scene['task']}_{scene['seed']}_*.jsonl"), reverse=True
    ):
        file = ActionFile.read(path)
        if file.end == "finished" and all(
            file.header.get(key) == value for key, value in wanted.items()
        ):
            return file
    return None


def replay(file: ActionFile, sim: Simulation) -> Actions:
    """Iterate over the actions of a file, as a source does. Raises TaccorlError: the episode had ended with these actions when
    they were recorded, and does not end now."""
    give_time(sim, file.header["time_limit_s"])
    for action in file.actions:
        yield Targets(action, action)
    if file.outcome not in (None, "unfinished") and not sim.judge.outcome.over[0]:
        raise TaccorlError(
            f"{file.path}: recorded as {file.outcome} after {len(file.actions)} control steps (MuJoCo "
            f"{file.header.get('mujoco')}, taccorl {file.header.get('taccorl')}), but its outcome here is {outcome_of(sim)}: "
            "the twin differs from the one in which it was recorded. Nothing of it was kept."
        )

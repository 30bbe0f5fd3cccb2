"""Action files: the actions of a demonstration, written step by step; executed again they give the same episode.

A file is one JSON value a line, so that a process killed at any moment leaves one that can be read:

    {"format": "taccorl actions 1", "task": "assembly_1", "seed": 123, "twin": "…", "time_limit_s": 300, …}    the scene
    [0.003, 1.732, …]                                                           14 float32 (rad, m), one line a control step
    {"end": "finished", "outcome": "success"}          or "discarded"; missing if the demonstrator's process was cut off
"""

import json
import os
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Self

import mujoco
import numpy as np

import taccorl
from taccorl.episodes.attempt import Actions, Targets, outcome_of
from taccorl.errors import TaccorlError
from taccorl.lineage.files import flush
from taccorl.robots import ROBOT
from taccorl.sim.simulation import Simulation
from taccorl.sim.twin import CONTROL_HZ
from taccorl.sim.twin_file import twin_text

FORMAT = "taccorl actions 1"
_SCENE = ("task", "difficulty", "randomization", "seed", "twin")
"""What must be equal for a file to be of the same scene."""
_ENDS = ("finished", "discarded")


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


class ActionLog:
    """Appends actions to a new file ``folder/TASK_SEED_NNN.jsonl``. Each action is written at once, and the file is synchronised
    to disk every second."""

    def __init__(self, folder: Path, sim: Simulation) -> None:
        """Create the file of the actions that simulation 0 of ``sim`` will execute; it has just been reset to its scene."""
        scene = scene_of(sim)
        folder.mkdir(parents=True, exist_ok=True)
        self.path, self._descriptor = _create(folder, f"{scene['task']}_{scene['seed']}")
        self.num_actions = 0
        self._write(
            {
                "format": FORMAT,
                **scene,
                "time_limit_s": sim.judge.limit_steps / CONTROL_HZ,
                "names": list(ROBOT.action_names),
                "units": "rad, gripper openings in m",
                "control_hz": CONTROL_HZ,
                "created": datetime.now(UTC).isoformat(timespec="seconds"),
                "mujoco": mujoco.__version__,
                "taccorl": taccorl.__version__,
            }
        )
        os.fsync(self._descriptor)
        flush(folder)

    def append(self, action: np.ndarray) -> None:
        """Append the action (14,) of one control step, as float32."""
        # A float32 is written as the float64 of the same value, which JSON gives back exactly.
        self._write(np.asarray(action, np.float32).tolist())
        self.num_actions += 1
        if self.num_actions % CONTROL_HZ == 0:
            os.fsync(self._descriptor)

    def end(self, end: str, outcome: str) -> None:
        """Write the last line, which states how the demonstration ended (``end``: finished or discarded) and its ``outcome``."""
        assert end in _ENDS, end
        self._write({"end": end, "outcome": outcome})
        self.close()

    def close(self) -> None:
        """Flush the file to the disk. A file that is closed without ``end`` counts as cut off."""
        if self._descriptor >= 0:
            os.fsync(self._descriptor)
            os.close(self._descriptor)
            self._descriptor = -1

    def _write(self, value: Any) -> None:
        line = json.dumps(value, ensure_ascii=False).encode() + b"\n"
        while line:
            line = line[os.write(self._descriptor, line) :]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _create(folder: Path, name: str) -> tuple[Path, int]:
    for k in range(10_000):
        path = folder / f"{name}_{k:03d}.jsonl"
        try:
            return path, os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND, 0o666)
        except FileExistsError:
            continue
    raise TaccorlError(f"{folder} holds 10000 action files of {name}: move some away")


@dataclass(frozen=True)
class ActionFile:
    """Content of one action file: scene, actions of a demonstration, and how it ended."""

    path: Path
    header: dict[str, Any]
    """First line of the file: the scene, versions."""
    actions: np.ndarray
    """(T, 14) float32 actions [rad, m]."""
    end: str | None
    """finished or discarded; None: the demonstration was interrupted, so that the actions are incomplete."""
    outcome: str | None
    """``success``, or the failure's category; None: the demonstration was interrupted."""

    @property
    def scene(self) -> dict[str, Any]:
        return {key: self.header[key] for key in _SCENE}

    @classmethod
    def read(cls, path: Path) -> "ActionFile":
        """Read a file. An incomplete last line is left out. Raises TaccorlError: it is not an action file, or damaged; the
        message names file and line."""
        try:
            lines = Path(path).read_bytes().split(b"\n")
        except OSError as error:
            raise TaccorlError(f"{path}: cannot be read: {error}") from error
        values = [
            _value(path, k, line) for k, line in enumerate(lines[:-1], 1)
        ]  # what follows the last newline is cut off
        header = values[0] if values else None
        if not isinstance(header, dict) or header.get("format") != FORMAT:
            raise TaccorlError(f"{path}: is not an action file: its first line must contain {FORMAT!r}")
        missing = [key for key in (*_SCENE, "time_limit_s") if key not in header]
        if missing:
            raise TaccorlError(f"{path}:1: {missing[0]!r} is missing: the scene cannot be made again")
        last = values[-1] if len(values) > 1 and isinstance(values[-1], dict) else {}
        rows = values[1:-1] if last else values[1:]
        for k, row in enumerate(rows, 2):
            if not isinstance(row, list) or len(row) != len(ROBOT.action_names):
                raise TaccorlError(f"{path}:{k}: expected {len(ROBOT.action_names)} numbers, found {str(row)[:60]}")
        actions = np.array(rows, np.float32).reshape(-1, len(ROBOT.action_names))
        return cls(Path(path), header, actions, last.get("end"), last.get("outcome"))


def _value(path: Path, number: int, line: bytes) -> Any:
    try:
        return json.loads(line)
    except ValueError as error:
        raise TaccorlError(f"{path}:{number}: is damaged: {error}") from error


def find_finished(folder: Path, scene: dict[str, Any]) -> ActionFile | None:
    """The newest finished demonstration of the same scene, recorded with this version of MuJoCo; None without one."""
    wanted = {**scene, "mujoco": mujoco.__version__}
    for path in sorted(folder.glob(f"{scene['task']}_{scene['seed']}_*.jsonl"), reverse=True):
        file = ActionFile.read(path)
        if file.end == "finished" and all(file.header.get(key) == value for key, value in wanted.items()):
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

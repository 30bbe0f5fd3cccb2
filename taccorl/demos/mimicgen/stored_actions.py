"""Demonstrations stored as seeds and float32 actions: a folder with ``meta.json``, ``actions.npy`` and, where the arms were
disturbed, ``intended.npy``.

    meta.json     format, task, difficulty, twin (a file's text), randomization, spec, origin, domain, versions, action_time,
                  report; of each episode: attempt, scene_seed, rows, last_state (SHA-256 of the last state row), provenance
    actions.npy   (ΣT, 14) float32 joint targets [rad] and openings [m] as they were executed, episode after episode
    intended.npy  (ΣT, 14) float32 the dataset's ``action`` of these rows

24 kB an episode. ``taccorl execute`` makes a dataset of it where it is needed.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from taccorl.data.spec import find_spec, load_dataset_spec
from taccorl.demos.mimicgen.execution import Demonstration
from taccorl.demos.mimicgen.spec import GatesSpec
from taccorl.errors import DatasetError
from taccorl.robots import ROBOT

FORMAT = 3
"""Version of the folder's format."""
META, ACTIONS, INTENDED = "meta.json", "actions.npy", "intended.npy"
SIMULATION = ("task", "difficulty", "twin", "randomization", "origin", "root_seed", "mujoco", "taccorl", "sources")
"""Keys that describe the simulation of all episodes in a folder, as in an episode's provenance."""
DOMAIN = "domain"
"""Further key of it, absent if the domain is ``twin``."""
MIMICGEN = "mimicgen"
"""Key of an episode's provenance that states how it was generated."""


@dataclass(frozen=True, eq=False)
class StoredActions:
    """Content of a folder of stored actions: its meta.json, and one demonstration per episode."""

    root: Path
    meta: dict[str, Any]
    """Content of ``meta.json``."""
    demonstrations: list[Demonstration]

    @property
    def is_disturbed(self) -> bool:
        """True if the arms were disturbed, so that executed and intended actions differ."""
        return self.meta["disturbed"]

    @property
    def gates(self) -> GatesSpec:
        """Acceptance criteria that an execution must meet."""
        return GatesSpec(**self.meta["spec"]["gates"])

    @property
    def simulation(self) -> dict[str, Any]:
        """Value of each key of ``SIMULATION`` (and ``DOMAIN``), which determine the simulation: task, difficulty, twin, origin,
        root seed, versions …
        """
        return {key: self.meta[key] for key in (*SIMULATION, DOMAIN) if key in self.meta}


def write_stored(
    folder: Path,
    simulation: Mapping[str, Any],
    spec: Mapping[str, Any],
    report: Mapping[str, Any],
    demonstrations: Sequence[Demonstration],
) -> None:
    """Write a folder of stored actions.

    Args:
        simulation: values for the keys ``SIMULATION``.
        spec: spec of the generation as JSON values; an execution must meet its ``gates``.
        report: counts of the run that made the demonstrations, as JSON values.
    """
    intended = [d.intended for d in demonstrations if d.intended is not None]
    episodes = [
        {"attempt": d.attempt, "scene_seed": d.scene_seed, "rows": len(d.actions), "last_state": d.last_state}
        | {"provenance": d.provenance}
        for d in demonstrations
    ]
    meta = {"format": FORMAT, **{key: simulation[key] for key in SIMULATION}, "spec": spec}
    meta |= {DOMAIN: simulation[DOMAIN]} if DOMAIN in simulation else {}
    meta |= {"disturbed": bool(intended)}
    meta |= {"action_time": action_time(), "report": report, "episodes": episodes}
    np.save(folder / ACTIONS, np.concatenate([d.actions for d in demonstrations]))
    if intended:
        np.save(folder / INTENDED, np.concatenate(intended))
    (folder / META).write_text(json.dumps(meta, ensure_ascii=False) + "\n", encoding="utf-8")


def read_stored(root: Path) -> StoredActions:
    """Read a folder of stored actions.

    Raises:
        DatasetError: no such folder, another format or action-time convention, or files of other lengths than meta.json says.
    """
    path = root / META
    if not path.is_file():
        raise DatasetError(
            f"{root}: is not a folder of stored actions (no {META}); write one with taccorl augment --rows=actions"
        )
    try:
        meta = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise DatasetError(f"{path}: is not JSON ({error}): copy the folder again") from error
    if not isinstance(meta, dict) or meta.get("format") != FORMAT:
        found = meta.get("format") if isinstance(meta, dict) else type(meta).__name__
        raise DatasetError(
            f"{path}: has format {found!r}, but this taccorl reads {FORMAT}; make it again: taccorl augment "
            "--rows=actions"
        )
    missing = [key for key in (*SIMULATION, "spec", "disturbed", "action_time", "episodes") if key not in meta]
    if missing:
        raise DatasetError(f"{path}: has no {', '.join(missing)}: damaged, copy the folder again")
    if meta["action_time"] != action_time():
        raise DatasetError(
            f"{path}: action_time is {meta['action_time']}, this taccorl executes {action_time()}; make it again: "
            "taccorl augment --rows=actions"
        )
    for i, episode in enumerate(meta["episodes"]):
        lost = [key for key in ("attempt", "scene_seed", "rows", "last_state", "provenance") if key not in episode]
        if lost:
            raise DatasetError(f"{path}: episode {i} has no {', '.join(lost)}: damaged, copy the folder again")
    rows = [episode["rows"] for episode in meta["episodes"]]
    actions = _read_actions(root / ACTIONS, sum(rows))
    intended = _read_actions(root / INTENDED, sum(rows)) if meta["disturbed"] else None
    ends = np.cumsum(rows)
    return StoredActions(
        root,
        meta,
        [
            Demonstration(
                attempt=episode["attempt"],
                scene_seed=episode["scene_seed"],
                actions=actions[end - num : end],
                intended=None if intended is None else intended[end - num : end],
                last_state=episode["last_state"],
                provenance=episode["provenance"],
            )
            for episode, num, end in zip(meta["episodes"], rows, ends, strict=True)
        ],
    )


def action_time() -> str | None:
    """Value of ``DatasetSpec.action_time`` for stored actions: when an action is reached."""
    return load_dataset_spec(find_spec("taccorl_bimanual")).action_time


def _read_actions(path: Path, num_rows: int) -> np.ndarray:
    try:
        actions = np.load(path)
    except (OSError, ValueError, EOFError) as error:
        raise DatasetError(
            f"{path}: cannot be read ({type(error).__name__}: {error}): copy the folder whole"
        ) from error
    if actions.shape != (num_rows, ROBOT.num_actions) or actions.dtype != np.float32:
        raise DatasetError(
            f"{path}: {actions.dtype} {list(actions.shape)}, {META} says float32 [{num_rows}, {ROBOT.num_actions}]: "
            "copy the folder whole"
        )
    return actions

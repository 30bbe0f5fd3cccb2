"""Demonstrations stored as seeds and float32 actions: a folder with ``meta.json``, ``actions.npy`` and, where the arms were
disturbed, ``intended.npy``.

    meta.json     format, task, difficulty, twin (a file's text), randomization, spec, origin, domain, versions, action_time,
                  report; of each episode: attempt, scene_seed, rows, last_state (SHA-256 of the last state row), provenance
    actions.npy   (ΣT, 14) float32 joint targets [rad] and openings [m] as they were executed, episode after episode
    intended.npy  (ΣT, 14) float32 the dataset's ``action`` of these rows

24 kB an episode. ``taccorl execute`` makes a dataset of it where it is needed: each demonstration is executed again.
"""

import hashlib
import itertools
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from taccorl.data.episode import EXECUTED
from taccorl.data.spec import DatasetSpec, find_spec, load_dataset_spec
from taccorl.episodes.attempt import Attempt, Targets, act
from taccorl.episodes.recorder import EpisodeRecorder
from taccorl.episodes.sources.mimicgen.gates import GateKeeper, foreign_contact
from taccorl.episodes.sources.mimicgen.spec import GatesSpec
from taccorl.errors import DatasetError
from taccorl.robots import ROBOT
from taccorl.sim.simulation import Simulation

FORMAT = 3
"""Version of the folder's format."""
META, ACTIONS, INTENDED = "meta.json", "actions.npy", "intended.npy"
SIMULATION = ("task", "difficulty", "twin", "randomization", "origin", "root_seed", "mujoco", "taccorl", "sources")
"""Keys that describe the simulation of all episodes in a folder, as in an episode's provenance."""
DOMAIN = "domain"
"""Further key of it, absent if the domain is ``twin``."""
MIMICGEN = "mimicgen"
"""Key of an episode's provenance that states how it was generated."""
DIFFERS = "last_state_differs"
"""Key in it: true if executing the stored actions ended in a different simulator state than the attempt."""
_FACTS = ("attempt", "scene_seed", "rows", "last_state", "provenance")  # of an episode, in meta.json
_PAD_NOISE = 2  # with the scene's seed


@dataclass(frozen=True, kw_only=True, eq=False)
class Demonstration:
    """A stored success: scene seed, actions, last state, provenance. Executing it again gives all rows."""

    attempt: int
    """Number of the attempt, from 0."""
    scene_seed: int
    actions: np.ndarray
    """(T, 14) float32 joint targets [rad] and openings [m] as they were executed."""
    intended: np.ndarray | None
    """(T, 14) float32 the dataset's ``action`` if it differs from the executed one; None: equal to ``actions``."""
    last_state: str
    """``state_digest`` after the last action."""
    provenance: dict[str, object] = field(default_factory=dict)

    @property
    def facts(self) -> dict[str, Any]:
        return {"rows": len(self.actions)} | {key: getattr(self, key) for key in _FACTS if key != "rows"}


@dataclass(frozen=True, eq=False)
class StoredActions:
    """Content of a folder of stored actions: its meta.json, and one demonstration per episode."""

    root: Path
    meta: dict[str, Any]
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
    """Write a folder of stored actions. ``simulation``: values for the keys ``SIMULATION``. ``spec``: spec of the generation as
    JSON values; an execution must meet its ``gates``. ``report``: counts of the run that made the demonstrations, as JSON values.
    """
    intended = [d.intended for d in demonstrations if d.intended is not None]
    meta = {"format": FORMAT, **{key: simulation[key] for key in SIMULATION}, "spec": spec}
    meta |= {DOMAIN: simulation[DOMAIN]} if DOMAIN in simulation else {}
    meta |= {"disturbed": bool(intended)}
    meta |= {"action_time": action_time(), "report": report, "episodes": [d.facts for d in demonstrations]}
    np.save(folder / ACTIONS, np.concatenate([d.actions for d in demonstrations]))
    if intended:
        np.save(folder / INTENDED, np.concatenate(intended))
    (folder / META).write_text(json.dumps(meta, ensure_ascii=False) + "\n", encoding="utf-8")


def read_stored(root: Path) -> StoredActions:
    """Read a folder of stored actions. Raises DatasetError: no such folder, another format or action-time convention, or files of
    other lengths than meta.json says."""
    path = root / META
    if not path.is_file():
        raise DatasetError(f"{root}: no stored actions (no {META}); write them with taccorl augment --rows=actions")
    try:
        meta = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise DatasetError(f"{path}: is not JSON ({error}): copy the folder again") from error
    if not isinstance(meta, dict) or meta.get("format") != FORMAT:
        found = meta.get("format") if isinstance(meta, dict) else type(meta).__name__
        raise DatasetError(f"{path}: has format {found!r}, not {FORMAT}; make it again: taccorl augment --rows=actions")
    missing = [key for key in (*SIMULATION, "spec", "disturbed", "action_time", "episodes") if key not in meta]
    if missing:
        raise DatasetError(f"{path}: has no {', '.join(missing)}: damaged, copy the folder again")
    if meta["action_time"] != action_time():
        raise DatasetError(f"{path}: action_time {meta['action_time']}: taccorl augment --rows=actions")
    for i, episode in enumerate(meta["episodes"]):
        lost = [key for key in _FACTS if key not in episode]
        if lost:
            raise DatasetError(f"{path}: episode {i} has no {', '.join(lost)}: damaged, copy the folder again")
    rows = [episode["rows"] for episode in meta["episodes"]]
    actions = _read_actions(root / ACTIONS, sum(rows))
    intended = _read_actions(root / INTENDED, sum(rows)) if meta["disturbed"] else None
    ends = np.cumsum(rows)
    demonstrations = [
        Demonstration(
            actions=actions[end - num : end],
            intended=None if intended is None else intended[end - num : end],
            **{key: episode[key] for key in _FACTS if key != "rows"},
        )
        for episode, num, end in zip(meta["episodes"], rows, ends, strict=True)
    ]
    return StoredActions(root, meta, demonstrations)


def action_time() -> str | None:
    """Value of ``DatasetSpec.action_time`` for stored actions: when an action is reached."""
    return load_dataset_spec(find_spec("taccorl_bimanual")).action_time


def _read_actions(path: Path, num_rows: int) -> np.ndarray:
    try:
        actions = np.load(path)
    except (OSError, ValueError, EOFError) as error:
        raise DatasetError(f"{path}: cannot be read ({type(error).__name__}: {error}): copy it whole") from error
    if actions.shape != (num_rows, ROBOT.num_actions) or actions.dtype != np.float32:
        raise DatasetError(
            f"{path}: {actions.dtype} {list(actions.shape)}, {META} says float32 [{num_rows}, {ROBOT.num_actions}]: "
            "copy the folder whole"
        )
    return actions


def execute(sim: Simulation, demonstration: Demonstration, rows: DatasetSpec, gates: GatesSpec) -> Attempt:
    """Execute a demonstration again and record its rows. Facts of the result: ``differs``, whether its last state is another one.

    MuJoCo on another CPU may differ in the last bit, and contact amplifies the difference: then success and the acceptance
    criteria ``gates`` decide. Outcomes: ``success``; a failure category of the task; ``not reproduced``; a criterion (gate) that
    was not met.
    """
    seed, actions, intended = demonstration.scene_seed, demonstration.actions, demonstration.intended
    if intended is None and EXECUTED in rows.features:
        intended = actions
    sim.reset([seed])
    recorder, keeper = EpisodeRecorder(sim, rows, np.random.default_rng([seed, _PAD_NOISE])), GateKeeper(sim)
    labels = intended if intended is not None else itertools.repeat(None)
    outcome, reason = act(sim, map(Targets, actions, labels), recorder, keeper.watch)
    differs = state_digest(sim) != demonstration.last_state
    if not differs:
        outcome, reason = "success", ""  # as it was judged when it was made
    elif outcome != "success":
        outcome = "not reproduced" if outcome == "unfinished" else outcome
        reason = "executed again, the stored actions end in another state, without success"
    else:
        keeper.see_actions(actions)
        states = np.stack([row["sim.state"] for row in recorder.rows])
        outcome, reason = keeper.measured.refused(gates) or foreign_contact(sim, states) or ("success", "")
    made = demonstration.provenance | ({DIFFERS: True} if differs else {})
    return Attempt(
        outcome=outcome,
        reason=reason,
        name=f"{sim.task.name} attempt {demonstration.attempt}",
        recorder=recorder,
        provenance={MIMICGEN: made},
        facts={"differs": differs},
    )


def state_digest(sim: Simulation) -> str:
    """SHA-256 (64 hexadecimal digits) of the state row of simulation 0, bit for bit."""
    return hashlib.sha256(np.ascontiguousarray(sim.state_rows()[0]).tobytes()).hexdigest()

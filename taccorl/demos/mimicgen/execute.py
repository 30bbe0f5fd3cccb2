"""Stored actions into a LeRobot dataset, on the machine where it is needed: each demonstration is executed once, on any engine.

Demonstrations that are no success here, or do not pass the gates, are left out and counted: another CPU may differ in the last
bit (``execution.py``). The numbers are the same whatever becomes of the pictures: encoded as video, rendered later into the
cache of training frames (``taccorl.training.rendered_frames``), or left out.
"""

import dataclasses
import functools
import json
import os
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import mujoco
import numpy as np

import taccorl
from taccorl.data.dataset import PROVENANCE
from taccorl.data.spec import DatasetSpec, find_spec, load_dataset_spec
from taccorl.demos.collect import assemble, in_the_way
from taccorl.demos.mimicgen.augment import write_execution
from taccorl.demos.mimicgen.execution import execute
from taccorl.demos.mimicgen.from_dataset import simulation_told
from taccorl.demos.mimicgen.stored_actions import StoredActions, read_stored
from taccorl.demos.recorder import EpisodeRecorder, with_simulator
from taccorl.errors import DatasetError, TaccorlError, nearest
from taccorl.lineage.engines import Engine, LocalEngine
from taccorl.lineage.manifest import read_manifest
from taccorl.lineage.stage import Artefact, Stage
from taccorl.lineage.store import Store
from taccorl.sim.simulation import Simulation

PicturesAs = Literal["video", "cache", "none"]
_SECONDS = ("physics", "touch", "writing")


@dataclass(frozen=True)
class Executed:
    """One demonstration, executed again."""

    artefact: Artefact
    """entry.json, and of a success dataset/ and episodes.json."""
    seconds: dict[str, float]
    """That each of its parts took; empty where the store had it."""


@dataclass(frozen=True, kw_only=True)
class ExecutePlan:
    """What to make of stored actions."""

    source: Path
    pictures: PicturesAs = "video"
    part_poses: bool = False
    """Rows have the poses of the task's parts (``observation.environment_state``)."""

    def __post_init__(self) -> None:
        if self.pictures not in get_args(PicturesAs):
            raise TaccorlError(f"--pictures={self.pictures}: {nearest(self.pictures, get_args(PicturesAs))}")

    def contract(self, stored: StoredActions, sim: Simulation, *, pictures: bool) -> DatasetSpec:
        """What a row holds."""
        spec = load_dataset_spec(find_spec("taccorl_bimanual"))
        return with_simulator(spec, sim, pictures=pictures, executed=stored.is_disturbed, parts=self.part_poses)

    @property
    def config(self) -> dict[str, Any]:
        """What an execution depends on besides the stored actions."""
        parts = {"part_poses": True} if self.part_poses else {}  # executions of before there was a choice remain valid
        return parts | {
            "videos": self.pictures == "video",
            "mujoco": mujoco.__version__,
            "taccorl": taccorl.__version__,
        }


def execute_stored(
    plan: ExecutePlan, out: Path, store: Store, engine: Engine | None = None, progress: Callable[[str], None] = print
) -> tuple[dict[str, Any], dict[str, float]]:
    """A LeRobot dataset at ``out``; returns its report and the mean seconds of each part of the executions that were made now.

    Raises:
        DatasetError: no stored actions, or changed since they were written; none of them is a success here.
        InTheWayError: something else is at ``out``.
    """
    source = _source(plan.source, store)
    stored = _stored(plan.source, source.digest)[0]
    num = len(stored.demonstrations)
    if os.path.lexists(out) and not _may_be_of(plan, source, num, out, store):
        raise in_the_way(out, _DATASET, stored.meta["task"])
    sim = _stored(plan.source, source.digest)[1]
    spec = plan.contract(stored, sim, pictures=plan.pictures != "none")
    # Touch is compiled once here and found by the workers; else each of them compiles it, a minute on sixteen cores.
    sim.reset([0])
    EpisodeRecorder(sim, spec, np.random.default_rng(0)).step(sim.targets[0])
    made: list[Executed] = (engine or LocalEngine()).map(
        functools.partial(_run, plan, source, store),
        range(num),
        on_done=lambda i, _: progress(f"demonstration {i} of {num}: executed"),
        name=lambda i: f"demonstration {i}",
    )
    entries = [json.loads((each.artefact.path / "entry.json").read_text(encoding="utf-8")) for each in made]
    kept = [each.artefact for each, entry in zip(made, entries, strict=True) if entry["outcome"] == "success"]
    report = _report(stored, entries)
    if not kept:
        raise DatasetError(
            f"{plan.source}: none of its {num} demonstrations is a success here ({report['dropped']}); nothing was written to "
            f"{out}. They were made with mujoco {stored.meta['mujoco']}, taccorl {stored.meta['taccorl']}; here are mujoco "
            f"{mujoco.__version__}, taccorl {taccorl.__version__}: make them here, taccorl augment"
        )

    def write(_: Any, inputs: list[Path], folder: Path) -> None:
        from taccorl.data.lerobot_format import declare_pictures

        assemble(spec, report, inputs, folder)
        if plan.pictures == "cache":
            declare_pictures(folder, spec)

    store.run(dataclasses.replace(_DATASET, fn=write), _dataset_config(plan), kept, destination=out)
    return report, mean_seconds([each.seconds for each in made])


def mean_seconds(seconds: Sequence[dict[str, float]]) -> dict[str, float]:
    """Part → mean of those that have any."""
    known = [each for each in seconds if each]
    return {key: sum(each[key] for each in known) / len(known) for key in known[0]} if known else {}


def _source(root: Path, store: Store) -> Artefact:
    """
    Raises:
        DatasetError: no such folder, or its files are others than those that were written.
    """
    read_stored(root)
    source, written = store.source(root), read_manifest(root)
    if written and written["digest"] != source.digest:
        raise DatasetError(
            f"{root}: its files are not as written: damaged, or changed since. Copy the folder again, or make it again: "
            "taccorl augment --rows=actions"
        )
    return source


def _may_be_of(plan: ExecutePlan, source: Artefact, num: int, out: Path, store: Store) -> bool:
    """Whether the dataset at ``out`` is made of executions of this very plan."""
    manifest = read_manifest(out)
    if not manifest or manifest["stage"] != _DATASET.name or manifest["config"] != _dataset_config(plan):
        return False
    keys = {store.key(_EXECUTION, plan.config | {"demonstration": i}, [source]) for i in range(num)}
    return {entry["key"] for entry in manifest["inputs"]} <= keys


def _dataset_config(plan: ExecutePlan) -> dict[str, Any]:
    return {"pictures": plan.pictures} | ({"part_poses": True} if plan.part_poses else {})


def _not_yet(config: Any, inputs: list[Path], folder: Path) -> None:
    raise NotImplementedError("the function comes with the demonstrations")


_EXECUTION = Stage("execution", _not_yet, 1)
_DATASET = Stage("executed", _not_yet, 1, manifest=f"{PROVENANCE}/manifest.json")


def _run(plan: ExecutePlan, source: Artefact, store: Store, i: int) -> Executed:
    """Demonstration ``i``, from the store if it has been executed."""
    seconds: dict[str, float] = {}

    def build(config: Any, inputs: list[Path], folder: Path) -> None:
        stored, sim = _stored(source.path, source.digest)
        demonstration = stored.demonstrations[i]
        done = execute(sim, demonstration, plan.contract(stored, sim, pictures=config["videos"]), stored.gates)
        began_s = time.perf_counter()
        if done.outcome == "success":
            told = stored.simulation | {"attempt": demonstration.attempt, "images": config["videos"]}
            write_execution(done, demonstration, told, folder)
        entry = {"attempt": demonstration.attempt, "rows": len(demonstration.actions), "outcome": done.outcome}
        entry |= {"reason": done.reason, "differs": not done.is_same}
        (folder / "entry.json").write_text(json.dumps(entry), encoding="utf-8")
        written_s = time.perf_counter() - began_s
        found = (done.recorder.physics_s, done.recorder.touch_s, written_s)
        seconds.update(zip(_SECONDS, found, strict=True))

    config = plan.config | {"demonstration": i}
    return Executed(store.run(dataclasses.replace(_EXECUTION, fn=build), config, [source]), seconds)


def _report(stored: StoredActions, entries: list[dict[str, Any]]) -> dict[str, Any]:
    kept = [e for e in entries if e["outcome"] == "success"]
    return {
        "task": stored.meta["task"],
        "origin": stored.meta["origin"],
        "demonstrations": len(entries),
        "differs": sum(e["differs"] for e in entries),
        "dropped": dict(sorted(Counter(e["outcome"] for e in entries if e["outcome"] != "success").items())),
        "episodes": len(kept),
        "rows": sum(e["rows"] for e in kept),
        "entries": entries,
    }


_read: dict[str, tuple[StoredActions, Simulation]] = {}


def _stored(root: Path, digest: str) -> tuple[StoredActions, Simulation]:
    """Stored actions and their simulation, made once in a process."""
    if digest not in _read:
        _read.clear()
        stored = read_stored(root)
        _read[digest] = stored, simulation_told(stored.simulation)
    return _read[digest]

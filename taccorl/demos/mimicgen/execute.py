"""Make a LeRobot dataset from stored actions where it is needed: each demonstration is executed once, on any engine.

Demonstrations that do not succeed here, or do not meet the acceptance criteria, are left out and counted: another CPU may
differ in the last bit (``execution.py``). The numbers are the same whatever becomes of the pictures: encoded as video, rendered
later into the cache of training frames (``taccorl.training.rendered_frames``), or left out.
"""

import functools
import itertools
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco

import taccorl
from taccorl.data.spec import DatasetSpec
from taccorl.demos import attempts
from taccorl.demos.mimicgen.augment import write_execution
from taccorl.demos.mimicgen.execution import execute
from taccorl.demos.mimicgen.from_dataset import make_simulation
from taccorl.demos.mimicgen.stored_actions import StoredActions, read_stored
from taccorl.demos.recorder import origin_told, row_spec
from taccorl.errors import DatasetError, TaccorlError
from taccorl.lineage.engines import Engine, LocalEngine
from taccorl.lineage.manifest import read_manifest
from taccorl.lineage.stage import Artefact, Stage
from taccorl.lineage.store import Store
from taccorl.sim.simulation import Simulation

_SECONDS = ("physics", "touch", "writing")
_SAME = ("task", "difficulty", "twin", "randomization")  # of all sources


@dataclass(frozen=True)
class Executed:
    """Result of executing one demonstration again: its artefact, and the time of each part of the work."""

    artefact: Artefact
    """Artefact with entry.json, and for a success dataset/ and episodes.json."""
    seconds: dict[str, float]
    """Part of the work → time it took [s]; empty if the result was in the store."""


@dataclass(frozen=True, kw_only=True)
class ExecutePlan:
    """Settings of an execution of stored actions: pictures, resolution, sources."""

    sources: tuple[Path, ...]
    """Folders of stored actions of one task, difficulty, twin and randomisation."""
    pictures: attempts.PicturesAs = "video"
    """How pictures are stored: ``video`` in the dataset, ``cache`` in the frame cache of training only, ``none``."""
    rows_per_picture: int = 1
    """k: with ``cache``, the rows 0, k, 2k … of each episode have pictures."""
    part_poses: bool = False
    """True: rows hold the poses of the task's parts (``observation.environment_state``)."""

    def __post_init__(self) -> None:
        if not self.sources:
            raise TaccorlError("missing --source=…, a folder of stored actions: taccorl augment --rows=actions")
        attempts.check_pictures(self.pictures, self.rows_per_picture)

    def contract(self, sim: Simulation, *, pictures: bool, executed: bool) -> DatasetSpec:
        """Data spec of the dataset's rows.

        Args:
            executed: rows also hold the executed targets, because the arms were disturbed in one of the sources.
        """
        return row_spec(sim, pictures=pictures, executed=executed, parts=self.part_poses)

    @property
    def config(self) -> dict[str, Any]:
        """Settings on which an execution depends, besides the stored actions, as JSON values; part of the store's key."""
        parts = {"part_poses": True} if self.part_poses else {}  # executions of before there was a choice remain valid
        return parts | {
            "videos": self.pictures == "video",
            "mujoco": mujoco.__version__,
            "taccorl": taccorl.__version__,
        }


def execute_stored(
    plan: ExecutePlan, out: Path, store: Store, engine: Engine | None = None, progress: attempts.Progress = print
) -> tuple[dict[str, Any], dict[str, float]]:
    """Publish a LeRobot dataset at ``out``; returns its report and the mean seconds of each part of the executions made now.

    Raises:
        DatasetError: a source holds no stored actions, or they were changed; or none of them succeeds here.
        InTheWayError: something else is at ``out``.
    """
    sources = [_source(root, store) for root in plan.sources]
    found = [_stored(source) for source in sources]
    _check_alike(found)
    executed = any(stored.is_disturbed for stored in found)
    items = [
        _Item(source, i, executed != stored.is_disturbed)
        for source, stored in zip(sources, found, strict=True)
        for i in range(len(stored.demonstrations))
    ]
    attempts.check_destination(
        out, _DATASET, found[0].meta["task"], lambda manifest: _may_be_of(plan, items, manifest, store)
    )
    sim = _simulation(found[0])
    spec = plan.contract(sim, pictures=plan.pictures != "none", executed=executed)
    attempts.compile_touch(sim)
    made: list[Executed] = (engine or LocalEngine()).map(
        functools.partial(_run, plan, store),
        items,
        on_done=lambda item, _: progress(f"{item}: executed"),
        name=str,
    )
    entries = [attempts.read_entry(each.artefact.path) for each in made]
    kept = [each.artefact for each, entry in zip(made, entries, strict=True) if attempts.is_success(entry)]
    for item, entry in zip(items, entries, strict=True):
        entry["source"] = str(item.source.path)
    report = _report(found[0], entries)
    if not kept:
        names, meta = ", ".join(map(str, plan.sources)), found[0].meta
        raise DatasetError(
            f"{names}: none of {len(items)} demonstrations is a success here ({report['dropped']}); nothing was written to "
            f"{out}. They were made with mujoco {meta['mujoco']}, taccorl {meta['taccorl']}; this installation has mujoco "
            f"{mujoco.__version__}, taccorl {taccorl.__version__}: generate them again with it (taccorl augment)"
        )

    def write(_: Any, inputs: list[Path], folder: Path) -> None:
        cached_rows = plan.rows_per_picture if plan.pictures == "cache" else None
        attempts.assemble(spec, report, inputs, folder, rows_per_picture=cached_rows, engine=engine)

    store.run(_DATASET.bound(write), _dataset_config(plan), kept, destination=out)
    return report, mean_seconds([each.seconds for each in made])


def mean_seconds(seconds: Sequence[dict[str, float]]) -> dict[str, float]:
    """Part of the work → mean time of the executions that have it [s]; ``seconds`` has one dict (part → time [s]) for each
    execution.
    """
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
            f"{root}: its files are damaged or were changed. Copy the folder again, or make it again: taccorl augment "
            "--rows=actions"
        )
    return source


def _check_alike(found: Sequence[StoredActions]) -> None:
    """
    Raises:
        DatasetError: sources of several simulations, or one that is given twice.
    """
    first = found[0]
    for other in found[1:]:
        for key in _SAME:
            if other.meta[key] != first.meta[key]:
                there, here = _first_difference(str(other.meta[key]), str(first.meta[key]))
                raise DatasetError(
                    f"--source={other.root}: its {key} differs from that of {first.root} ({there}; {here}): execute them into "
                    "separate datasets, and join these with taccorl merge"
                )
        if (there := origin_told(other.simulation)) != (here := origin_told(first.simulation)):
            raise DatasetError(
                f"--source={other.root} is {there}, {first.root} is {here}: execute them into datasets of their own, taccorl "
                "merge joins those"
            )
    roots = [one.root.resolve() for one in found]
    if twice := [one.root for one in found if roots.count(one.root.resolve()) > 1]:
        raise DatasetError(f"--source={twice[0]} is given twice: give each folder once")


def _first_difference(one: str, other: str) -> tuple[str, str]:
    """The first lines that differ."""
    lines = itertools.zip_longest(one.splitlines(), other.splitlines(), fillvalue="nothing")
    return next(((a.strip()[:80], b.strip()[:80]) for a, b in lines if a != b), (one, other))


def _may_be_of(plan: ExecutePlan, items: Sequence["_Item"], manifest: dict[str, Any], store: Store) -> bool:
    """Whether a dataset with that manifest is made of executions of this very plan."""
    keys = {store.key(_EXECUTION, item.config(plan), [item.source]) for item in items}
    return manifest["config"] == _dataset_config(plan) and {entry["key"] for entry in manifest["inputs"]} <= keys


def _dataset_config(plan: ExecutePlan) -> dict[str, Any]:
    every = {"rows_per_picture": plan.rows_per_picture} if plan.rows_per_picture > 1 else {}
    return {"pictures": plan.pictures} | every | ({"part_poses": True} if plan.part_poses else {})


_EXECUTION = Stage("execution", version=2)
_DATASET = Stage("executed", manifest=attempts.DATASET_MANIFEST)


@dataclass(frozen=True)
class _Item:
    """A demonstration of one of the sources."""

    source: Artefact
    index: int
    adds_executed: bool
    """Its rows say what was executed, though that is the action itself: other sources' arms were disturbed."""

    def config(self, plan: ExecutePlan) -> dict[str, Any]:
        """What its execution depends on besides the stored actions."""
        executed = {"executed": True} if self.adds_executed else {}
        return plan.config | executed | {"demonstration": self.index}

    def __str__(self) -> str:
        return f"{self.source.path}, demonstration {self.index}"


def _run(plan: ExecutePlan, store: Store, item: _Item) -> Executed:
    """One demonstration, from the store if it has been executed."""
    seconds: dict[str, float] = {}

    def build(config: Any, inputs: list[Path], folder: Path) -> None:
        stored = _stored(item.source)
        sim, demonstration = _simulation(stored), stored.demonstrations[item.index]
        executed = stored.is_disturbed or item.adds_executed
        spec = plan.contract(sim, pictures=config["videos"], executed=executed)
        done = execute(sim, demonstration, spec, stored.gates)
        began_s = time.perf_counter()
        if done.outcome == "success":
            told = stored.simulation | {"attempt": demonstration.attempt, "images": config["videos"]}
            write_execution(done, demonstration, told, folder)
        entry = {"attempt": demonstration.attempt, "rows": len(done.recorder.rows), "outcome": done.outcome}
        entry |= {"reason": done.reason, "differs": not done.is_same}
        (folder / "entry.json").write_text(json.dumps(entry), encoding="utf-8")
        written_s = time.perf_counter() - began_s
        found = (done.recorder.physics_s, done.recorder.touch_s, written_s)
        seconds.update(zip(_SECONDS, found, strict=True))

    return Executed(store.run(_EXECUTION.bound(build), item.config(plan), [item.source]), seconds)


def _report(stored: StoredActions, entries: list[dict[str, Any]]) -> dict[str, Any]:
    kept = [e for e in entries if attempts.is_success(e)]
    return {
        "task": stored.meta["task"],
        **origin_told(stored.simulation).record(),
        "demonstrations": len(entries),
        "differs": sum(e["differs"] for e in entries),
        "dropped": attempts.outcomes([e for e in entries if not attempts.is_success(e)]),
        "episodes": len(kept),
        "rows": sum(e["rows"] for e in kept),
        "entries": entries,
    }


_read: dict[str, StoredActions] = {}
_open: dict[str, Simulation] = {}


def _stored(source: Artefact) -> StoredActions:
    """Stored actions, read once in a process."""
    if source.digest not in _read:
        _read[source.digest] = read_stored(source.path)
    return _read[source.digest]


def _simulation(stored: StoredActions) -> Simulation:
    """Of stored actions, made once in a process."""
    key = json.dumps([stored.meta[key] for key in _SAME])
    if key not in _open:
        _open.clear()
        _open[key] = make_simulation(stored.simulation)
    return _open[key]

"""Numbered attempts in the twin, common to collect, augment, correct and execute: plan → attempt → store → report → dataset.

An attempt is an artefact of the store with an ``entry.json``, which states its outcome and its number of rows. A success also has
dataset/ and episodes.json, or the actions from which its rows can be made. Only successes are published.
"""

import abc
import functools
import json
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import mujoco
import numpy as np

import taccorl
from taccorl.data.dataset import PROVENANCE, dataset_spec_to_json, write_records
from taccorl.data.joining import in_threads
from taccorl.data.spec import DatasetSpec
from taccorl.demos.recorder import row_spec
from taccorl.errors import InTheWayError, TaccorlError, nearest
from taccorl.lineage.destinations import is_free
from taccorl.lineage.engines import Engine, LocalEngine
from taccorl.lineage.errors import EngineError
from taccorl.lineage.manifest import read_manifest
from taccorl.lineage.processes import Care, Failed
from taccorl.lineage.stage import Artefact, Stage
from taccorl.sim.simulation import Simulation
from taccorl.sim.task import tasks
from taccorl.sim.twin import TwinConfig
from taccorl.sim.twin_file import load_twin, twin_text

REPORT = "collect_report.json"
"""File in the dataset's meta/taccorl/ with the counts of a run."""
DATASET_MANIFEST = f"{PROVENANCE}/manifest.json"
PicturesAs = Literal["video", "cache", "none"]
"""How pictures of a dataset are stored: in it as videos, in the frame cache of training only, not at all."""
_CARE = Care(limit_s=600.0, tries=2)  # an attempt takes seconds, with pictures on a slow machine a minute

Entry = dict[str, Any]
"""Content of an ``entry.json``."""
Progress = Callable[[str], None]
"""Function that is called with a text about what has been done."""


@dataclass(frozen=True, kw_only=True)
class AttemptPlan:
    """Settings that all plans of numbered attempts in the twin have in common: task, number of episodes, twin, scenes."""

    task: str
    episodes: int
    difficulty: str = "train"
    """Clearance on each side of mating parts: ``easy`` 1.0 mm, ``train`` 0.5 mm, ``hard`` 0.3 mm."""
    twin: Path | None = None
    """A twin.yaml; the nominal twin if not given."""
    randomization: float = 1.0
    """Factor on the ranges of the task's randomisation at reset, 0 … 1; 0: the nominal scene."""
    images: bool = True
    """True: rows have the pictures of all cameras."""
    seed: int = 0
    """Seed from which the seeds of all attempts follow."""

    def __post_init__(self) -> None:
        """
        Raises:
            TaccorlError: a number is out of its range.
        """
        for name, least in (("episodes", 1), ("seed", 0)):
            if getattr(self, name) < least:
                raise TaccorlError(f"--{name}={getattr(self, name)}: at least {least}")
        if not 0 <= self.randomization <= 1:
            raise TaccorlError(
                f"--randomization={self.randomization:g}: give a share of the task's reset ranges, from 0 to 1"
            )

    def twin_config(self) -> TwinConfig:
        """The twin of the attempts."""
        return load_twin(self.twin) if self.twin else TwinConfig()

    def make(self) -> Simulation:
        """Make the simulation of this plan.

        Raises:
            TaccorlError: the task or difficulty is unknown; the message names the nearest.
        """
        return Simulation(tasks.get(self.task)(self.difficulty), self.twin_config(), scale=self.randomization)

    def scene_config(self) -> dict[str, Any]:
        """Settings on which scenes and physics depend, besides seeds, as JSON values: name → value; part of the store's keys."""
        return {
            "task": self.task,
            "difficulty": self.difficulty,
            "twin": twin_text(self.twin_config()),
            "randomization": self.randomization,
            "mujoco": mujoco.__version__,
            "taccorl": taccorl.__version__,
        }


@dataclass(frozen=True, kw_only=True)
class RowsPlan(AttemptPlan):
    """An ``AttemptPlan`` whose successes become a dataset: how pictures are stored, and whether rows have the parts' poses."""

    pictures: PicturesAs = "video"
    """How pictures are stored: ``video`` in the dataset, ``cache`` in the frame cache of training only; with ``images=False``
    not at all."""
    rows_per_picture: int = 1
    """k: with ``cache``, the rows 0, k, 2k … of each episode have pictures."""
    part_poses: bool = False
    """True: rows hold the poses of the task's parts (``observation.environment_state``)."""

    def __post_init__(self) -> None:
        """
        Raises:
            TaccorlError: as ``AttemptPlan``; or there is no such way to store pictures.
        """
        super().__post_init__()
        check_pictures(self.stored_as, self.rows_per_picture)

    @property
    def stored_as(self) -> PicturesAs:
        """How pictures are stored, ``none`` with ``images=False``."""
        return self.pictures if self.images else "none"

    @property
    def kept_pictures(self) -> dict[str, Any]:
        """Part of the published dataset's configuration: how its pictures are stored."""
        return {"pictures": self.stored_as, "rows_per_picture": self.rows_per_picture}

    def contract(self, sim: Simulation) -> DatasetSpec:
        """Data spec of an attempt's rows."""
        return row_spec(sim, pictures=self.stored_as == "video", executed=True, parts=self.part_poses)

    def published(self, sim: Simulation) -> DatasetSpec:
        """Data spec of the published dataset, with the cameras whose pictures are in the frame cache."""
        return row_spec(sim, pictures=self.stored_as != "none", executed=True, parts=self.part_poses)

    @property
    def cached_rows(self) -> int | None:
        """``rows_per_picture``; None if pictures are not in the frame cache."""
        return self.rows_per_picture if self.stored_as == "cache" else None


def check_pictures(pictures: str, rows_per_picture: int) -> None:
    """
    Raises:
        TaccorlError: there is no such way to store pictures, or it has one for every row.
    """
    if pictures not in get_args(PicturesAs):
        raise TaccorlError(f"--pictures={pictures}: {nearest(pictures, get_args(PicturesAs))}")
    if rows_per_picture < 1:
        raise TaccorlError(f"--rows_per_picture={rows_per_picture}: at least 1")
    if rows_per_picture > 1 and pictures != "cache":
        raise TaccorlError(
            f"--rows_per_picture={rows_per_picture} needs --pictures=cache; with --pictures={pictures} every row has a picture "
            "or none has: remove it"
        )


def compile_touch(sim: Simulation) -> None:
    """Compile the computation of touch in this process, so that workers find it on disk instead of compiling it at once."""
    sim.reset([0])
    sim.touch(np.random.default_rng(0))


class Following(abc.ABC):
    """Work that follows from an attempt, such as to draw its pictures. It is pickled for worker processes."""

    @abc.abstractmethod
    def run(self) -> None:
        """Do it."""

    @abc.abstractmethod
    def __str__(self) -> str:
        """Its name in messages."""


def _attempt_or_following(run: Callable[..., Artefact], item: Any, *end: Failed) -> Artefact | None:
    if not isinstance(item, Following):
        return run(item, *end)
    if end:
        raise EngineError(f"{item}: {end[0].reason}")
    item.run()
    return None


def run_attempts(
    run: Callable[..., Artefact],
    numbers: Sequence[Any],
    engine: Engine,
    *,
    said: Callable[[Entry], str],
    progress: Progress,
    name: str = "attempt",
    then: Callable[[Any, Artefact, Entry], Sequence[Any]] = lambda number, artefact, entry: (),
) -> list[tuple[Artefact, Entry]]:
    """Run attempts on an engine, except those that are in the store. Return their artefacts and entries in the order of
    ``numbers``.

    Args:
        run: function of an attempt's number that makes the attempt; pickled for worker processes. If the process died twice or
            did not end, the function is called in this process with the number and the way the process ended.
        said: function that returns the text that the progress display shows for an entry.
        then: function of an attempt's number, artefact and entry that returns the numbers of further attempts, which follow the
            others, and ``Following`` work. Both are begun before what waits.
    """
    entries: dict[Path, Entry] = {}

    def on_done(item: Any, artefact: Artefact | None) -> Sequence[Any]:
        if artefact is None:
            return ()
        entry = entries[artefact.path] = read_entry(artefact.path)
        progress(f"{name} {item}: {said(entry)}")
        return then(item, artefact, entry)

    made = engine.map(
        (either := functools.partial(_attempt_or_following, run)),
        numbers,
        on_done=on_done,
        name=lambda item: str(item) if isinstance(item, Following) else f"{name} {item}",
        care=_CARE,
        instead=either,
    )
    return [(artefact, entries[artefact.path]) for artefact in made if artefact is not None]


_kept: dict[str, Any] = {}


def made_once[T](key: Any, make: Callable[[], T]) -> T:
    """Result of ``make``, such as a simulation, which is made once in a process for the same ``key`` (JSON). Only the newest
    result is kept, because a process works on one plan at a time."""
    text = json.dumps(key, sort_keys=True)
    if text not in _kept:
        _kept.clear()
        _kept[text] = make()
    return _kept[text]


def is_success(entry: Entry) -> bool:
    """Whether the entry states a success."""
    return entry["outcome"] == "success"


def successes(entries: Sequence[Entry]) -> int:
    """Number of successes among ``entries``."""
    return sum(map(is_success, entries))


def outcomes(entries: Sequence[Entry]) -> dict[str, int]:
    """Outcome → number of entries, in alphabetical order."""
    return dict(sorted(Counter(entry["outcome"] for entry in entries).items()))


def read_entry(folder: Path) -> Entry:
    """Return the content of the ``entry.json`` of an attempt."""
    return json.loads((folder / "entry.json").read_text(encoding="utf-8"))


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file with one key per line."""
    path.write_text(json.dumps(value, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def check_destination(out: Path, stage: Stage, task: str, may_be_ours: Callable[[dict[str, Any]], bool]) -> None:
    """Fail early if ``out`` is occupied: otherwise the store would refuse only after hours of attempts.

    Args:
        may_be_ours: function that decides from the manifest of an existing dataset whether it is the one to be made.

    Raises:
        InTheWayError: something else is at ``out``; the message states what.
    """
    if is_free(out):
        return
    manifest = read_manifest(out) if out.is_dir() else {}
    if manifest and manifest["stage"] == stage.name and may_be_ours(manifest):
        return
    if manifest:
        held = (
            f"holds {manifest['stage']} v{manifest['stage_version']}, key {manifest['key']}, made {manifest['created']}"
        )
    else:
        kind = f"a folder of {sum(1 for _ in out.rglob('*'))} entries" if out.is_dir() else "a file"
        held = f"is {kind} without a taccorl manifest"
    raise InTheWayError(
        f"{out} is occupied: it {held}; this run makes {stage.name} v{stage.version} of {task}. Nothing was changed: give "
        "another --out, or move the existing folder away."
    )


def assemble(
    spec: DatasetSpec,
    report: dict[str, Any],
    shards: list[Path],
    folder: Path,
    *,
    rows_per_picture: int | None = None,
    engine: Engine | None = None,
) -> None:
    """Merge the datasets of the kept attempts, in the folders ``shards``, into one at ``folder``, with their provenance and
    ``report`` in meta/taccorl/.

    Args:
        rows_per_picture: k: pictures of the rows 0, k, 2k … are in the frame cache and not in the shards; the dataset states it.
        engine: where datasets without videos are merged; this process if not given.
    """
    from taccorl.data.lerobot_format import declare_pictures, merge

    merge(
        [shard / "dataset" for shard in shards], folder, in_threads if engine in (None, LocalEngine()) else engine.map
    )
    meta = folder / PROVENANCE
    records = [record for shard in shards for record in json.loads((shard / "episodes.json").read_text())]
    write_records(folder, records)
    write_json(meta / REPORT, report)
    write_json(meta / "dataset_spec.json", dataset_spec_to_json(spec))
    if rows_per_picture is not None:
        declare_pictures(folder, spec, rows_per_picture)

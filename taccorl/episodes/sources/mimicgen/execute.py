"""Plan that makes a dataset of stored actions where it is needed: each demonstration is executed once.

Demonstrations that do not succeed here, or do not meet the acceptance criteria, are left out and counted: another CPU may differ
in the last bit. The numbers are the same whatever becomes of the pictures: encoded as video, rendered later into the cache of
training frames (``taccorl.training.rendered_frames``), or left out.
"""

import functools
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import mujoco

import taccorl
from taccorl.episodes.attempt import Attempt, Entry
from taccorl.episodes.plan import Listed, Plan, Step, outcomes, twin_of_text
from taccorl.episodes.recorder import origin_told
from taccorl.episodes.sources.mimicgen.stored import StoredActions, execute, read_stored
from taccorl.errors import DatasetError, TaccorlError
from taccorl.lineage.manifest import DATASET_MANIFEST, read_manifest
from taccorl.lineage.stage import Artefact, Stage
from taccorl.lineage.store import Store
from taccorl.sim.twin import TwinConfig

_SAME = ("task", "difficulty", "twin", "randomization")  # of all sources
_EXECUTION = Stage("execution", version=2)


@functools.lru_cache
def _read(source: Artefact) -> StoredActions:
    """Stored actions, read once in a process."""
    return read_stored(source.path)


@dataclass(frozen=True)
class Execution:
    """One demonstration of one of the sources."""

    source: Artefact
    index: int
    attempt: int
    """Number of the attempt that made it."""

    def __str__(self) -> str:
        return f"{self.source.path}, demonstration {self.index}"


@dataclass(frozen=True, kw_only=True)
class ExecutePlan(Plan):
    """Settings of an execution of stored actions: sources, which state task and twin, and pictures."""

    task: str = field(init=False)
    sources: tuple[Artefact, ...]
    """Folders of stored actions (``stored_sources``) of one task, difficulty, twin and randomisation."""

    word: ClassVar[str] = "execution of"
    dataset: ClassVar[Stage] = Stage("executed", manifest=DATASET_MANIFEST)

    def __post_init__(self) -> None:
        """Raises DatasetError: sources of several simulations, or one that is given twice; TaccorlError: no source, or no such
        way to store pictures."""
        if not self.sources:
            raise TaccorlError("missing --source=…, a folder of stored actions: taccorl augment --rows=actions")
        found = self.stored
        _check_alike(found)
        for key in ("task", "difficulty", "randomization"):
            object.__setattr__(self, key, found[0].meta[key])
        object.__setattr__(self, "origin", origin_told(found[0].simulation))
        super().__post_init__()

    @property
    def stored(self) -> list[StoredActions]:
        return [_read(source) for source in self.sources]

    def twin_config(self) -> TwinConfig:
        return twin_of_text(self.stored[0].meta["twin"])

    @property
    def executes(self) -> bool:
        return any(stored.is_disturbed for stored in self.stored)

    @property
    def wanted(self) -> int | None:
        return None

    @functools.cached_property
    def items(self) -> list[Execution]:
        pairs = zip(self.sources, self.stored, strict=True)
        return [Execution(s, i, d.attempt) for s, stored in pairs for i, d in enumerate(stored.demonstrations)]

    def schedule(self, at_once: int) -> Listed:
        return Listed(self.items)

    def config(self, item: Execution) -> dict[str, Any]:
        """What its execution depends on besides the stored actions. Keys of before there was a choice remain valid."""
        parts = {"part_poses": True} if self.part_poses else {}
        parts |= {"executed": True} if self.executes != _read(item.source).is_disturbed else {}
        made_by = {"mujoco": mujoco.__version__, "taccorl": taccorl.__version__}
        return parts | {"videos": self.stored_as == "video", **made_by, "demonstration": item.index}

    def inputs(self, item: Execution) -> list[Artefact]:
        return [item.source]

    @property
    def steps(self) -> tuple[Step, ...]:
        return (Step(_EXECUTION, self._attempt),)

    def _attempt(self, item: Execution, config: dict[str, Any], inputs: list[Path]) -> Attempt:
        stored, (sim, spec, _) = _read(item.source), self.opened()
        done = execute(sim, stored.demonstrations[item.index], spec, stored.gates)
        told = stored.simulation | {"attempt": item.attempt, "images": config["videos"]}
        return replace(done, provenance=told | done.provenance, source_digest=told["sources"])

    def entry(self, item: Execution, done: Attempt) -> Entry:
        entry = {"attempt": item.attempt, "rows": done.rows, "outcome": done.outcome, "reason": done.reason}
        return entry | {"differs": False} | done.facts

    def dataset_config(self, entries: Sequence[Entry] | None) -> dict[str, Any]:
        every = {"rows_per_picture": self.rows_per_picture} if self.rows_per_picture > 1 else {}
        return {"pictures": self.pictures} | every | ({"part_poses": True} if self.part_poses else {})

    def items_of(self, report: dict[str, Any]) -> list[Execution]:
        return self.items

    def report(self, entries: Sequence[Entry]) -> dict[str, Any]:
        entries = [e | {"source": str(item.source.path)} for e, item in zip(entries, self.items, strict=True)]
        report = super().report(entries)
        counts = {"demonstrations": report.pop("attempts"), "differs": sum(e["differs"] for e in entries)}
        del report["outcomes"]
        return report | counts | {"dropped": outcomes([e for e in entries if not self.keeps(e)])}

    def nothing(self, report: dict[str, Any], out: Path) -> TaccorlError:
        names, meta = ", ".join(str(source.path) for source in self.sources), self.stored[0].meta
        return DatasetError(
            f"{names}: none of {report['demonstrations']} demonstrations is a success here ({report['dropped']}); nothing was "
            f"written to {out}. They were made with mujoco {meta['mujoco']}, taccorl {meta['taccorl']}; this installation has "
            f"mujoco {mujoco.__version__}, taccorl {taccorl.__version__}: generate them again with it (taccorl augment)"
        )


def stored_sources(roots: Sequence[Path], store: Store) -> tuple[Artefact, ...]:
    """Folders of stored actions as artefacts. Raises DatasetError: no such folder, or its files are others than those that were
    written."""
    found = []
    for root in roots:
        read_stored(root)
        source, written = store.source(root), read_manifest(root)
        if written and written["digest"] != source.digest:
            raise DatasetError(f"{root}: its files were changed. Copy it again, or taccorl augment --rows=actions")
        found.append(source)
    return tuple(found)


def _check_alike(found: Sequence[StoredActions]) -> None:
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
            raise DatasetError(f"--source={other.root} is {there}, {first.root} is {here}: execute each, then merge")
    roots = [one.root.resolve() for one in found]
    if twice := [one.root for one in found if roots.count(one.root.resolve()) > 1]:
        raise DatasetError(f"--source={twice[0]} is given twice: give each folder once")


def _first_difference(one: str, other: str) -> tuple[str, str]:
    lines = itertools.zip_longest(one.splitlines(), other.splitlines(), fillvalue="nothing")
    return next(((a.strip()[:80], b.strip()[:80]) for a, b in lines if a != b), (one, other))

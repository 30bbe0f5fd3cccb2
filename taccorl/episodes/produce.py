"""Produce a dataset of numbered attempts: plan → attempts → rows → report → dataset, on any engine.

An attempt is an artefact of the store. Its key contains everything that it depends on, so a run that was killed continues, other
settings never mix with it, and any number of workers gives the same dataset. An attempt that kills its process twice
(``crashed``) or does not end (``hung``) is counted like any other that failed. Only kept attempts are published.
"""

import functools
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from taccorl.data.dataset import PROVENANCE, dataset_spec_to_json, write_records
from taccorl.data.joining import in_threads
from taccorl.data.spec import DatasetSpec
from taccorl.episodes.attempt import read_json, write_json
from taccorl.episodes.plan import REPORT, Drawing, Made, Plan
from taccorl.errors import InTheWayError
from taccorl.lineage.destinations import check_writable, is_free
from taccorl.lineage.engines import Engine, LocalEngine
from taccorl.lineage.manifest import read_manifest
from taccorl.lineage.processes import Care
from taccorl.lineage.stage import Artefact
from taccorl.lineage.store import Store
from taccorl.sim.simulation import Simulation

_CARE = Care(
    limit_s=600.0, tries=2
)  # an attempt takes seconds, with pictures on a slow machine a minute

Progress = Callable[[str], None]
"""Function that is called with a text about what has been done."""


class Pictures(Protocol):
    """Pictures of a dataset that is being produced: they are drawn while other attempts run."""

    def add(
        self, demonstration: Artefact, rows: int
    ) -> Callable[[Simulation, np.ndarray], None]:
        """Add the next episode of the dataset, which has ``rows`` rows. Returns a function that renders its pictures; a worker
        process calls it with a simulation and the episode's states (T, row_size)."""
        ...


@dataclass(frozen=True)
class Produced:
    report: dict[str, Any]
    """Content of its collect_report.json."""
    made: list[Made]
    """Attempts that count, in their order."""

    @property
    def seconds(self) -> dict[str, float]:
        """Part of the work → mean time of the attempts with rows that were made in this run [s]."""
        return mean_seconds([made.seconds for made in self.made])


def produce(
    plan: Plan,
    out: Path,
    store: Store,
    progress: Progress = print,
    engine: Engine | None = None,
    pictures: Pictures | None = None,
) -> Produced:
    """Make the attempts of ``plan`` that ``store`` does not have, and the dataset of those that are kept at ``out``. ``engine``:
    where attempts run; this process if not given, and if a person acts. ``pictures``: told of each episode, in their order, when
    those before it are known. Raises InTheWayError: ``out`` holds something else. Raised before the first attempt if that can be
    decided, otherwise after the last; TaccorlError: nothing was made; the message states why."""
    check_out(plan, out, store)
    sim = plan.opened().sim  # what does not fit is refused before anything runs
    spec = plan.published(sim)
    if plan.repeatable:
        sim.reset([0])
        sim.touch(
            np.random.default_rng(0)
        )  # compiled once, and not in each worker at the same time
    run = functools.partial(plan.run, store)
    engine = engine or LocalEngine()
    at_work = _Run(plan, engine.at_once, progress, pictures)
    if plan.repeatable:
        names = {
            "name": lambda item: (
                str(item) if isinstance(item, Drawing) else f"{plan.word} {item}"
            )
        }
        engine.map(
            run,
            [*at_work.first()],
            on_done=at_work.on_done,
            care=_CARE,
            instead=run,
            **names,
        )
    else:
        in_order(run, at_work.first(), at_work.on_done)
    made = at_work.counted()
    report = plan.report([each.entry for each in made])
    kept = [each.artefact for each in made if plan.keeps(each.entry)]
    if not kept:
        raise plan.nothing(report, out)

    def write(_: Any, inputs: list[Path], folder: Path) -> None:
        _assemble(spec, report, inputs, folder, plan.cached_rows, engine)

    config = plan.dataset_config([each.entry for each in made])
    store.run(plan.dataset.bound(write), config, kept, destination=out)
    return Produced(report, made)


class _Run:
    """Attempts of a run that have ended, and what follows from them."""

    def __init__(
        self, plan: Plan, at_once: int, progress: Progress, pictures: Pictures | None
    ) -> None:
        self._plan, self._progress, self._pictures = plan, progress, pictures
        self._schedule = plan.schedule(at_once)
        self._items: list[Any] = []
        self._made: dict[Any, Made] = {}
        self._drawn = 0
        """Number of attempts, in order, whose pictures are drawn or not needed."""

    def first(self) -> Iterable[Any]:
        self._items += (first := list(self._schedule.first()))
        return first

    def on_done(self, item: Any, made: Made | None) -> Sequence[Any]:
        if made is None:
            return ()
        plan, entry = self._plan, made.entry
        self._made[item] = made
        self._progress(f"{plan.word} {item}: {said(entry)}{self._count()}")
        self._items += (following := list(self._schedule.after(item, made)))
        return [*following, *self._drawings()]

    def _count(self) -> str:
        wanted = self._plan.wanted
        return (
            f" ({sum(made.success for made in self._made.values())} of {wanted})"
            if wanted
            else ""
        )

    def _drawings(self) -> list[Drawing]:
        found = []
        while (
            self._pictures
            and self._drawn < len(self._items)
            and (item := self._items[self._drawn]) in self._made
        ):
            made = self._made[item]
            if self._plan.keeps(made.entry):
                draw = self._pictures.add(made.artefact, made.entry["rows"])
                found.append(Drawing(self._plan, item, made.artefact.path, draw))
            self._drawn += 1
        return found

    def counted(self) -> list[Made]:
        """In the order of the attempts, up to the last success that is wanted."""
        found = list[Made]()
        for item in self._items:
            if (
                self._plan.wanted is not None
                and sum(made.success for made in found) == self._plan.wanted
            ):
                break
            found.append(self._made[item])
        return found


def in_order[T](
    run: Callable[[Any], T],
    first: Iterable[Any],
    on_done: Callable[[Any, T], Iterable[Any]],
) -> None:
    """Run attempts one after another in this process; errors end them."""
    todo = deque(first)
    while todo:
        item = todo.popleft()
        todo += on_done(item, run(item))


def said(entry: dict[str, Any]) -> str:
    """What a line of progress says of an attempt."""
    after = f" after {entry['seconds']:.1f} s" if "seconds" in entry else ""
    return f"{entry['outcome']}{after}" + (
        f", {entry['reason']}" if entry.get("reason") else ""
    )


def mean_seconds(seconds: Sequence[dict[str, float]]) -> dict[str, float]:
    """Part of the work → mean time of the episodes that have it [s]; ``seconds`` has one dict (part → time [s]) for each
    episode.
    """
    known = [each for each in seconds if each]
    return (
        {key: sum(each[key] for each in known) / len(known) for key in known[0]}
        if known
        else {}
    )


def check_out(plan: Plan, out: Path, store: Store) -> None:
    """Fail early if ``out`` is occupied: otherwise the store would refuse only after hours of attempts. Raises InTheWayError:
    something other than the result of this plan is at ``out``; the message states what."""
    if is_free(out):
        check_writable(out)
        return
    if manifest := read_manifest(out) if out.is_dir() else {}:
        config = plan.dataset_config(None)
        if (
            manifest["stage"] == plan.dataset.name
            and manifest["config"].items() >= config.items()
            and (report := out / PROVENANCE / REPORT).is_file()
            and plan.may_be_made_of(
                read_json(report), {entry["key"] for entry in manifest["inputs"]}, store
            )
        ):
            return  # made of attempts of this very plan, and of as many successes
        other = [
            key for key in config if manifest["config"].get(key) != config[key]
        ] or ["attempts (source, seed, number, what is kept of each)"]
        made = f"{manifest['stage']} v{manifest['stage_version']}, made {manifest['created']}"
        held = f"holds {made}, which differs in {', '.join(other)}"
    else:
        kind = (
            f"a folder of {sum(1 for _ in out.rglob('*'))} entries"
            if out.is_dir()
            else "a file"
        )
        held = f"is {kind} without a taccorl manifest"
    raise InTheWayError(
        f"{out} is occupied: it {held}; this run makes {plan.dataset.name} v{plan.dataset.version} of {plan.task}. Nothing "
        "was changed: give another --out, or move the existing folder away."
    )


def _assemble(
    spec: DatasetSpec,
    report: dict[str, Any],
    shards: list[Path],
    folder: Path,
    rows_per_picture: int | None,
    engine: Engine,
) -> None:
    """Merge the datasets of the kept attempts, in the folders ``shards``, into one at ``folder``, with their provenance and
    ``report`` in meta/taccorl/. ``rows_per_picture``: k: pictures of the rows 0, k, 2k … are in the frame cache and not in the
    shards; the dataset states it. ``engine``: where datasets without videos are merged."""
    from taccorl.data.lerobot_format import declare_pictures, merge

    merge(
        [shard / "dataset" for shard in shards],
        folder,
        in_threads if engine == LocalEngine() else engine.map,
    )
    meta = folder / PROVENANCE
    write_records(
        folder,
        [record for shard in shards for record in read_json(shard / "episodes.json")],
    )
    write_json(meta / REPORT, report)
    write_json(meta / "dataset_spec.json", dataset_spec_to_json(spec))
    if rows_per_picture is not None:
        declare_pictures(folder, spec, rows_per_picture)

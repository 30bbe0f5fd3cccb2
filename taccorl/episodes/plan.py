"""Plan of numbered attempts in the twin: what all of them have in common, and what a kind of attempt defines.

``produce`` runs any plan. Kinds: ``CollectPlan`` (expert, person), ``AugmentPlan`` (MimicGen), ``CorrectionPlan``
(policy, then expert).
"""

import abc
import functools
import json
import tempfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple, Protocol, get_args

import mujoco
import numpy as np

import taccorl
from taccorl.data.dataset import Dataset
from taccorl.data.origin import TWIN_ORIGIN, Origin
from taccorl.data.spec import DatasetSpec
from taccorl.episodes.attempt import Attempt, Entry, read_json, write_attempt
from taccorl.episodes.recorder import row_spec
from taccorl.errors import TaccorlError, nearest
from taccorl.lineage.errors import EngineError
from taccorl.lineage.processes import Failed
from taccorl.lineage.stage import Artefact, Stage
from taccorl.lineage.store import Store
from taccorl.sim.simulation import Simulation
from taccorl.sim.task import tasks
from taccorl.sim.twin import TwinConfig
from taccorl.sim.twin_file import load_twin, twin_text

REPORT = "collect_report.json"
"""File in the dataset's meta/taccorl/ with the counts of a run."""
PicturesAs = Literal["video", "cache", "none"]
"""How pictures of a dataset are stored: in it as videos, in the frame cache of training only, not at all."""


@dataclass(frozen=True)
class Made:
    """A finished attempt in the store."""

    artefact: Artefact
    """entry.json; of a kept attempt also dataset/ with episodes.json."""
    entry: Entry
    seconds: dict[str, float] = field(default_factory=dict)
    """Part of the work → time it took [s]; empty if the attempt was in the store."""

    @property
    def success(self) -> bool:
        return self.entry["outcome"] == "success"


class Schedule(Protocol):
    """Which attempts are made. What it returns follows from the plan and the outcomes alone, in any order of ending."""

    def first(self) -> Iterable[Any]:
        """Attempts to begin with."""
        ...

    def after(self, item: Any, made: Made) -> Iterable[Any]:
        """Attempts to start when ``item`` has ended."""
        ...


@dataclass(frozen=True)
class Listed:
    """Schedule of a list of attempts."""

    items: Sequence[Any]

    def first(self) -> Iterable[Any]:
        return self.items

    def after(self, item: Any, made: Made) -> Iterable[Any]:
        return ()


class Needed:
    """Schedule of the numbers 0, 1, … until the plan has its successes. An attempt is started when it is needed even if all that
    run succeed: the attempts follow from the plan alone, whatever their order of ending and number at the same time.
    """

    def __init__(
        self,
        plan: "Plan",
        at_once: int = 1,
        advice: "Callable[[Made], str] | None" = None,
    ) -> None:
        """``at_once``: number of attempts that may run at the same time. ``advice``: as ``Plan.advice``, in place of it."""
        self._plan, self._advice = plan, advice or plan.advice
        self._unjudged = plan.many + at_once - 1
        """Most attempts to start before it is known whether they are hopeless."""
        self._made: dict[int, Made] = {}
        self._started = self._successes = 0
        self._in_order: Counter[str] = Counter()
        """Outcomes of the attempts before the first whose outcome is unknown."""

    def first(self) -> range:
        """Attempts to begin with."""
        plan, running = self._plan, self._started - len(self._made)
        number = plan.episodes - self._successes - running
        if self._in_order.total() < plan.many:
            number = min(number, self._unjudged - self._started)
        if not plan.repeatable:
            number = min(number, 1 - running)  # a person's attempts follow one another
        started, self._started = self._started, self._started + max(number, 0)
        return range(started, self._started)

    def after(self, item: int, made: Made) -> range:
        """Take the result of attempt ``item``, which has ended, and return the numbers of the attempts to start now. Raises
        TaccorlError: an automatic demonstrator fails so often that the task or the twin must be faulty; for a person there is no
        limit."""
        plan, self._made[item] = self._plan, made
        self._successes += made.success
        while (num := self._in_order.total()) in self._made:
            self._in_order[self._made[num].entry["outcome"]] += 1
            tried, successes = num + 1, self._in_order["success"]
            if (
                plan.repeatable
                and tried >= plan.many
                and successes < plan.least * tried
            ):
                kinds = ", ".join(
                    f"{n} {kind}" for kind, n in sorted(self._in_order.items())
                )
                first = next(
                    made for _, made in sorted(self._made.items()) if not made.success
                )
                raise TaccorlError(
                    f"{plan.task}: {tried - successes} of {tried} failed ({kinds}); {self._advice(first)}"
                )
        return self.first()


class Opened(NamedTuple):
    """What a process makes once for all attempts of a plan."""

    sim: Simulation
    spec: DatasetSpec
    """Data spec of an attempt's rows."""
    actor: Any
    """Result of ``Plan.actor``."""


class Step(NamedTuple):
    stage: Stage
    attempt: Callable[[Any, dict[str, Any], list[Path]], Attempt]
    """Function of the attempt, its configuration and the folders of its inputs, then those of the steps before."""


@dataclass(frozen=True)
class Drawing:
    """Draws the pictures of a kept attempt while others run."""

    plan: "Plan"
    item: Any
    folder: Path
    draw: Callable[[Simulation, np.ndarray], None]
    """Function of a simulation and the states (T, row_size) of the episode."""

    def run(self, end: Failed | None) -> None:
        """Draw them. Raises EngineError: the process that drew them died or was stopped."""
        if end:
            raise EngineError(f"{self}: {end.reason}")
        self.draw(
            self.plan.opened().sim,
            Dataset(self.folder / "dataset").values(0, ["sim.state"])["sim.state"],
        )

    def __str__(self) -> str:
        return f"pictures of {self.plan.word} {self.item}"


@dataclass(frozen=True, kw_only=True)
class Plan(abc.ABC):
    """Settings of numbered attempts in the twin, and of the dataset of those that are kept."""

    task: str
    episodes: int = 20
    """Number of successful episodes to make."""
    difficulty: str = "train"
    """Clearance on each side of mating parts: ``easy`` 1.0 mm, ``train`` 0.5 mm, ``hard`` 0.3 mm."""
    twin: Path | None = None
    """A twin.yaml; the nominal twin if not given."""
    randomization: float = 1.0
    """Factor on the ranges from which a reset of the task draws, from 0 (always the nominal scene) to 1 (the full ranges)."""
    images: bool = True
    """True: rows have the pictures of all cameras."""
    pictures: PicturesAs = "video"
    """How pictures are stored: ``video`` in the dataset, ``cache`` in the frame cache of training only; with ``images=False``
    not at all."""
    rows_per_picture: int = 1
    """k: with ``cache``, the rows 0, k, 2k … of each episode have pictures."""
    part_poses: bool = False
    """True: each row has the poses of the task's parts, in ``observation.environment_state``."""
    seed: int = 0
    """Seed from which the seeds of all attempts follow."""
    origin: Origin = TWIN_ORIGIN
    """Origin of all outputs; its domain is ``surrogate`` if the twin stands in for the robot."""

    word: ClassVar[str] = "attempt"
    """What an attempt is called in lines of progress."""
    dataset: ClassVar[Stage]
    """Stage that publishes the dataset."""
    many: ClassVar[int] = 20
    """Number of attempts after which a success rate means something."""
    least: ClassVar[float] = 0.25
    """Share of successes below which so many attempts are hopeless."""
    counts_errors: ClassVar[bool] = False
    """True: an attempt that raises an error is counted as a failure; False: the error ends the run."""

    def __post_init__(self) -> None:
        """Raises TaccorlError: a number is out of its range, or there is no such way to store pictures."""
        for name, least in (("episodes", 1), ("seed", 0), ("rows_per_picture", 1)):
            if getattr(self, name) < least:
                raise TaccorlError(f"--{name}={getattr(self, name)}: at least {least}")
        if not 0 <= self.randomization <= 1:
            raise TaccorlError(
                f"--randomization={self.randomization:g}: give a share of the reset ranges, 0 to 1"
            )
        if self.pictures == "cache" and not self.images:
            raise TaccorlError(
                "--pictures=cache and --images=false contradict one another: remove one"
            )
        if (how := self.stored_as) not in get_args(PicturesAs):
            raise TaccorlError(
                f"--pictures={how}: {nearest(how, get_args(PicturesAs))}"
            )
        if self.rows_per_picture > 1 and how != "cache":
            raise TaccorlError(
                f"--rows_per_picture={self.rows_per_picture} needs --pictures=cache, not {how}"
            )

    # scene and rows ---------------------------------------------------------------------------------------------------

    def twin_config(self) -> TwinConfig:
        return load_twin(self.twin) if self.twin else TwinConfig()

    def make(self) -> Simulation:
        """Make the simulation of this plan. Raises TaccorlError: the task or difficulty is unknown; the message names the
        nearest."""
        return Simulation(
            tasks.get(self.task)(self.difficulty),
            self.twin_config(),
            scale=self.randomization,
        )

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

    @functools.cached_property
    def scene(self) -> dict[str, Any]:
        """``scene_config`` when it was first needed; worker processes get it with the plan."""
        return self.scene_config()

    @property
    def stored_as(self) -> PicturesAs:
        """How pictures are stored, ``none`` with ``images=False``."""
        return self.pictures if self.images else "none"

    @property
    def kept_pictures(self) -> dict[str, Any]:
        """Part of the published dataset's configuration: how its pictures are stored."""
        return {"pictures": self.stored_as, "rows_per_picture": self.rows_per_picture}

    @property
    def cached_rows(self) -> int | None:
        """``rows_per_picture``; None if pictures are not in the frame cache."""
        return self.rows_per_picture if self.stored_as == "cache" else None

    @property
    def executes(self) -> bool:
        """True if rows also hold the executed targets, because ``action`` may differ from them."""
        return True

    def contract(self, sim: Simulation) -> DatasetSpec:
        """Data spec of an attempt's rows."""
        return row_spec(
            sim,
            pictures=self.stored_as == "video",
            executed=self.executes,
            parts=self.part_poses,
        )

    def published(self, sim: Simulation) -> DatasetSpec:
        """Data spec of the published dataset, with the cameras whose pictures are in the frame cache."""
        return row_spec(
            sim,
            pictures=self.stored_as != "none",
            executed=self.executes,
            parts=self.part_poses,
        )

    def actor(self, sim: Simulation) -> Any:
        """What acts in the attempts, if it is made once for all of them."""
        return None

    def opened(self) -> Opened:
        """Simulation, data spec and actor, made once in a process. Raises TaccorlError: the file of the twin has changed since
        ``scene`` was read."""

        def make() -> Opened:
            if self.scene_config() != self.scene:
                raise TaccorlError(
                    f"{self.twin} was changed while attempts ran; run the command again"
                )
            sim = self.make()
            return Opened(sim, self.contract(sim), self.actor(sim))

        own = [self.stored_as == "video", self.part_poses, self.executes]
        return made_once(
            [type(self).__name__, self.scene, own, self.actor_config()], make
        )

    def actor_config(self) -> Any:
        """Settings on which ``actor`` depends, as JSON values."""
        return None

    # attempts ---------------------------------------------------------------------------------------------------------

    @property
    def repeatable(self) -> bool:
        """False if a person acts: attempts are then made one after another in this process."""
        return True

    @property
    def wanted(self) -> int | None:
        """Number of successes after which attempts do not count; None: all attempts count."""
        return self.episodes

    def schedule(self, at_once: int) -> Schedule:
        """Which attempts are made, if ``at_once`` of them may run at the same time."""
        return Needed(self, at_once)

    def advice(self, failed: Made) -> str:
        """End of the message of the error if attempts are hopeless, the first of which is ``failed``."""
        return "nothing was written"

    @property
    @abc.abstractmethod
    def steps(self) -> tuple[Step, ...]:
        """Stages of an attempt; each follows if the one before is a success."""

    @abc.abstractmethod
    def config(self, item: Any) -> dict[str, Any]:
        """Settings on which an attempt depends, besides its inputs, as JSON values; part of the store's key."""

    def inputs(self, item: Any) -> list[Artefact]:
        """Artefacts from which an attempt is made."""
        return []

    @abc.abstractmethod
    def entry(self, item: Any, done: Attempt) -> Entry:
        """Content of entry.json."""

    def lost(self, item: Any, end: Failed) -> Attempt:
        """Attempt whose process died or was stopped, which is its outcome."""
        return Attempt(outcome=end.process, reason=end.reason)

    def keeps(self, entry: Entry) -> bool:
        """True if the attempt becomes an episode of the dataset."""
        return entry["outcome"] == "success"

    def run(self, store: Store, item: Any, end: Failed | None = None) -> Made | None:
        """Make an attempt, unless it is in the store, or draw what a ``Drawing`` asks for. Called in worker processes. ``end``:
        the way its process ended, if it died or was stopped; it is then the outcome."""
        if isinstance(item, Drawing):
            return item.run(end)
        before, seconds, made = list[Path](), dict[str, float](), None
        for step in self.steps:
            if made is not None and not made.success:
                break

            def attempt(config: Any, inputs: list[Path], step: Step = step) -> Attempt:
                return (
                    self.lost(item, end)
                    if end
                    else step.attempt(item, config, inputs + before)
                )

            entry = functools.partial(self.entry, item)
            write = functools.partial(
                write_attempt, attempt, entry, self.keeps, self.counts_errors, seconds
            )
            artefact = store.run(
                step.stage.bound(write), self.config(item), self.inputs(item)
            )
            before.append(artefact.path)
            made = Made(artefact, read_json(artefact.path / "entry.json"), seconds)
        return made

    # result -----------------------------------------------------------------------------------------------------------

    def dataset_config(self, entries: Sequence[Entry] | None) -> dict[str, Any]:
        """Settings of the published dataset, part of its key in the store. ``entries`` of the attempts that count; None before
        the first attempt, when only settings that do not depend on attempts are known."""
        return {"task": self.task}

    def items_of(self, report: dict[str, Any]) -> Iterable[Any] | None:
        """Attempts of which a dataset with that report may be made; None if it cannot be one of this plan's."""
        return (
            [entry["attempt"] for entry in report["entries"]]
            if report["episodes"] == self.episodes
            else None
        )

    def may_be_made_of(
        self, report: dict[str, Any], keys: set[str], store: Store
    ) -> bool:
        """True if a dataset with that report, of artefacts with those ``keys``, may be the one of this plan."""
        items, stage = self.items_of(report), self.steps[-1].stage
        return items is not None and keys <= {
            store.key(stage, self.config(i), self.inputs(i)) for i in items
        }

    def report(self, entries: Sequence[Entry]) -> dict[str, Any]:
        """Counts of a run by outcome, and each attempt, as JSON values."""
        kept = [entry for entry in entries if self.keeps(entry)]
        return {
            "task": self.task,
            **self.origin.record(),
            "attempts": len(entries),
            "outcomes": outcomes(entries),
            "episodes": len(kept),
            "rows": sum(entry["rows"] for entry in kept),
            "entries": list(entries),
        }

    def nothing(self, report: dict[str, Any], out: Path) -> TaccorlError:
        """The error if no attempt is kept."""
        return TaccorlError(
            f"{self.task}: no attempt succeeded, nothing was written to {out}: {report['outcomes']}"
        )


_kept: dict[str, Any] = {}


def made_once[T](key: Any, make: Callable[[], T]) -> T:
    """Result of ``make``, such as a simulation, which is made once in a process for the same ``key`` (JSON). Only the newest
    result is kept, because a process works on one plan at a time."""
    text = json.dumps(key, sort_keys=True)
    if text not in _kept:
        _kept.clear()
        _kept[text] = make()
    return _kept[text]


def seed_of(root: int, words: str, k: int) -> int:
    """Scene seed of attempt ``k`` (0 … 2⁶² − 1) of those that ``words`` names, independent of the other attempts and of their
    number.
    """
    sequence = np.random.SeedSequence(root, spawn_key=(zlib.crc32(words.encode()), k))
    return int(sequence.generate_state(1, np.uint64)[0] >> np.uint64(2))


def outcomes(entries: Sequence[Entry]) -> dict[str, int]:
    """Outcome → number of entries, in alphabetical order."""
    return dict(sorted(Counter(entry["outcome"] for entry in entries).items()))


def twin_of_text(text: str) -> TwinConfig:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "twin.yaml"
        path.write_text(text, encoding="utf-8")
        return load_twin(path)

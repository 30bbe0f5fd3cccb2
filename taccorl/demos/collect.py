"""Collect demonstrations in the twin into a LeRobot dataset, or into recordings in the format of the robot's drivers. Every
attempt is a pure function of the configuration and its own seed, and is kept in the store when it has finished: a run that was
stopped continues, and the same command gives the same dataset.
"""

import abc
import dataclasses
import functools
import json
import zlib
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, Protocol

import draccus
import numpy as np

from taccorl.data.dataset import PROVENANCE, Dataset, episode_record
from taccorl.data.origin import TWIN_ORIGIN, Origin
from taccorl.data.spec import DatasetSpec
from taccorl.demos import attempts
from taccorl.demos.experts import expert_of
from taccorl.demos.experts.scripted import ScriptedExpertConfig
from taccorl.demos.recorder import EpisodeRecorder, row_spec, told_origin
from taccorl.errors import TaccorlError, UnreachableError
from taccorl.lineage.canonical import canonical
from taccorl.lineage.destinations import is_free
from taccorl.lineage.engines import Engine, LocalEngine
from taccorl.lineage.processes import Failed
from taccorl.lineage.stage import Artefact, Stage
from taccorl.lineage.store import Store
from taccorl.sim.simulation import Simulation
from taccorl.sim.twin import CONTROL_HZ
from taccorl.surrogate.twin_recording import write_twin_mcap

ATTEMPT_VERSION = 4
COLLECTION_VERSION = 3
_MANY = 20  # attempts after which a success rate means something
AFTER_S = 1.0  # an attempt whose demonstrator has finished is watched for so long


class Targets(NamedTuple):
    """Targets of one control step, (14,) each [rad, m]."""

    sent: np.ndarray
    """What the robot executes: a dataset's ``sim.executed``."""
    intended: np.ndarray
    """What a policy is to learn: a dataset's ``action``. It differs from ``sent`` where a demonstrator errs or is disturbed."""


Actions = Iterator[Targets]
"""Targets of one attempt, one per control step."""


@dataclass(frozen=True, kw_only=True)
class Source(draccus.ChoiceRegistry, abc.ABC):
    """Source of demonstrations: --source.type=expert, keyboard, gamepad, leader."""

    repeatable: ClassVar[bool] = True
    """True if the same seed gives the same actions."""

    @abc.abstractmethod
    def actions(self, sim: Simulation, rng: np.random.Generator) -> Actions:
        """Iterate over the targets of one attempt; the source reads the simulation between them. Ends when the demonstration is
        finished.
        """


@Source.register_subclass("expert")
@dataclass(frozen=True, kw_only=True)
class ExpertSource(Source):
    """The task's scripted expert, with human-like errors that it corrects when it is blocked."""

    hands: ScriptedExpertConfig = field(default_factory=ScriptedExpertConfig)
    """Speeds and human-like errors of the expert's hands."""

    def actions(self, sim: Simulation, rng: np.random.Generator) -> Actions:
        expert = expert_of(sim.task)(sim, rng, self.hands)
        expert.start()
        after = 0
        while after < round(AFTER_S * CONTROL_HZ):
            after += expert.done
            action = expert.act()
            yield Targets(action, expert.intended(action))


@dataclass(frozen=True, kw_only=True)
class Plan(attempts.RowsPlan):
    """Settings of a collection: task, number of episodes, source, twin."""

    episodes: int = 20
    """Number of successful episodes to collect."""
    source: Source = field(default_factory=ExpertSource)
    keep_failures: bool = False
    """True: failed attempts become episodes too, labelled as failures."""
    origin: Origin = TWIN_ORIGIN
    """Origin of all outputs; its domain is ``surrogate`` if the twin stands in for the robot."""

    @property
    def num_attempts(self) -> int | None:
        """Largest number of attempts; None: as many as needed."""
        return None

    def hopeless(self, attempts: int, successes: int) -> bool:
        """True if an automatic demonstrator fails so often (fewer than a quarter of at least 20 ``attempts`` are ``successes``)
        that the task or the twin must be faulty. There is no limit for a person.
        """
        return self.source.repeatable and attempts >= _MANY and successes < attempts / 4

    def attempt_seed(self, k: int) -> int:
        """Seed of attempt ``k`` (0 … 2⁶² − 1), independent of the other attempts and of their number."""
        sequence = np.random.SeedSequence(self.seed, spawn_key=(zlib.crc32(self.task.encode()), k))
        return int(sequence.generate_state(1, np.uint64)[0] >> np.uint64(2))


@dataclass
class Attempt(EpisodeRecorder):
    """Recorded rows of one attempt of a collection, and its outcome."""

    outcome: str = "unfinished"
    """Outcome as from ``outcome_of``, or ``unreachable``: the demonstrator requested a pose that the arm cannot reach."""
    reason: str = ""
    """Description of the unreachable pose; empty for other outcomes."""

    def is_kept(self, plan: Plan) -> bool:
        """Whether ``plan`` keeps the attempt as an episode. An attempt without rows is never kept."""
        return self.outcome == "success" or (plan.keep_failures and bool(self.rows))


def attempt(plan: Plan, sim: Simulation, spec: DatasetSpec, k: int, *, dense: bool = False) -> Attempt:
    """Run attempt ``k`` up to success, failure, the time limit, or the end of the demonstrator's actions. ``dense``: also keep a
    trajectory at 200 Hz.
    """
    seed = plan.attempt_seed(k)
    sim.reset([seed])
    recorder = Attempt(sim, spec, np.random.default_rng([seed, 2]), dense=dense)
    try:
        for targets in plan.source.actions(sim, np.random.default_rng([seed, 1])):
            recorder.step(targets.sent, intended=targets.intended)
            if sim.judge.outcome.over[0]:
                break
        recorder.outcome = outcome_of(sim)
    except UnreachableError as error:
        recorder.outcome, recorder.reason = "unreachable", str(error)
    return recorder


def outcome_of(sim: Simulation) -> str:
    """``success``, the failure's category, or ``unfinished``."""
    outcome = sim.judge.outcome
    return "success" if outcome.success[0] else str(outcome.failure[0]) or "unfinished"


class Pictures(Protocol):
    """Pictures of a dataset that is being collected: they are drawn while other attempts run."""

    def add(self, demonstration: Artefact, rows: int) -> "Callable[[Simulation, np.ndarray], None]":
        """Add the next episode of the dataset, which has ``rows`` rows. Returns a function that renders its pictures; a worker
        process calls it with a simulation and the episode's states (T, row_size)."""
        ...


@dataclass(frozen=True)
class _Drawing(attempts.Following):
    """Draws the pictures of attempt ``number``, which is kept."""

    plan: Plan
    scene: dict[str, Any]
    number: int
    demonstration: Path
    draw: Callable[[Simulation, np.ndarray], None]

    def run(self) -> None:
        sim, _ = _simulation(self.plan, self.scene)
        self.draw(sim, Dataset(self.demonstration / "dataset").values(0, ["sim.state"])["sim.state"])

    def __str__(self) -> str:
        return f"pictures of attempt {self.number}"


def collect(
    plan: Plan,
    out: Path,
    store: Store,
    progress: attempts.Progress = print,
    engine: Engine | None = None,
    pictures: Pictures | None = None,
) -> dict[str, Any]:
    """Collect ``plan.episodes`` successes into a LeRobot dataset at ``out``; returns the content of its collect_report.json.

    Args:
        engine: where the attempts of a repeatable source run; this process if not given. A person demonstrates in this
            process.
        pictures: of a repeatable source: told of each episode, in their order, when those before it are known.

    Raises:
        InTheWayError: ``out`` holds something else. Raised before the first attempt if that can be decided, otherwise after the
            last.
        TaccorlError: three of four attempts of an expert fail, which indicates a faulty task or twin.
    """
    attempts.check_destination(out, _COLLECTION, plan.task, lambda manifest: _may_be_of(plan, manifest, out, store))
    scene = plan.scene_config()
    sim, _ = _simulation(plan, scene)  # what does not fit is refused before anything runs
    spec = plan.published(sim)
    if plan.source.repeatable:
        attempts.compile_touch(sim)
    said = _Said(plan)

    one = functools.partial(run_attempt, plan, scene, store)
    advice = f"nothing was written to {out}. To view a failure: taccorl collect --task={plan.task} --keep_failures=true"
    engine = engine or LocalEngine()
    needed = _Needed(plan, advice, engine.at_once)
    if plan.source.repeatable:
        ended: dict[int, tuple[Artefact, attempts.Entry]] = {}
        in_order = 0

        def then(k: int, artefact: Artefact, entry: attempts.Entry) -> list[Any]:
            nonlocal in_order
            ended[k], drawings = (artefact, entry), list[Any]()
            while pictures is not None and in_order in ended:
                demonstration, its = ended.pop(in_order)
                if its["kept"]:
                    draw = pictures.add(demonstration, its["rows"])
                    drawings.append(_Drawing(plan, scene, in_order, demonstration.path, draw))
                in_order += 1
            return [*needed.after(k, entry["outcome"]), *drawings]

        done = attempts.run_attempts(one, needed.first(), engine, said=said, progress=progress, then=then)
        made, entries = [artefact for artefact, _ in done], [entry for _, entry in done]
    else:
        made, entries = list[Artefact](), list[attempts.Entry]()
        for k in needed.one_by_one(entries):
            made.append(one(k))
            entries.append(attempts.read_entry(made[-1].path))
            progress(f"attempt {k}: {said(entries[-1])}")
    shards = [artefact for artefact, entry in zip(made, entries, strict=True) if entry["kept"]]
    report = _report(plan, entries)
    config = {"task": plan.task, "attempts": [e["seed"] for e in entries if e["kept"]], "twin": scene["twin"]}
    config |= plan.kept_pictures

    def write(_: Any, inputs: list[Path], folder: Path) -> None:
        attempts.assemble(spec, report, inputs, folder, rows_per_picture=plan.cached_rows, engine=engine)

    store.run(_COLLECTION.bound(write), config, shards, destination=out)
    return report


def run_attempt(plan: Plan, scene: dict[str, Any], store: Store, k: int, end: Failed | None = None) -> Artefact:
    """Run attempt ``k``, unless the store has the result. The artefact holds entry.json, for a kept attempt also dataset/ and
    episodes.json.

    Args:
        end: the way its process ended, if it died or was stopped; it is then the outcome.

    Raises:
        TaccorlError: the file of the twin has changed since.
    """
    config = _attempt_config(plan, scene, k)

    def build(config: Any, inputs: list[Path], folder: Path) -> None:
        if end is not None:
            _write_entry(folder, k, config["seed"], outcome=end.process, reason=end.reason)
            return
        sim, spec = _simulation(plan, scene)
        _build_attempt(plan, sim, spec, k, config, folder)

    return store.run(_DEMONSTRATION.bound(build), config, [])


def _simulation(plan: Plan, scene: dict[str, Any]) -> tuple[Simulation, DatasetSpec]:
    """Simulation and data spec of the plan's attempts, made once in a process."""

    def make() -> tuple[Simulation, DatasetSpec]:
        if plan.scene_config() != scene:
            raise TaccorlError(
                f"{plan.twin} was changed while attempts ran; run the command again with one version of it"
            )
        sim = plan.make()
        return sim, plan.contract(sim)

    return attempts.made_once(["collect", scene, plan.stored_as == "video", plan.part_poses], make)


class _Said:
    """Text of the progress display for an attempt, which counts the successes so far."""

    def __init__(self, plan: Plan) -> None:
        self._episodes, self._successes = plan.episodes, 0

    def __call__(self, entry: attempts.Entry) -> str:
        self._successes += attempts.is_success(entry)
        return f"{entry['outcome']} after {entry['seconds']:.1f} s ({self._successes} of {self._episodes})"


_DEMONSTRATION = Stage("demonstration", version=ATTEMPT_VERSION)
_COLLECTION = Stage("collection", version=COLLECTION_VERSION, manifest=attempts.DATASET_MANIFEST)


def _may_be_of(plan: Plan, manifest: dict[str, Any], out: Path, store: Store) -> bool:
    """Whether the dataset at ``out`` is made of attempts of this very plan, and of as many."""
    report = out / PROVENANCE / attempts.REPORT
    if not report.is_file():
        return False
    told, scene = json.loads(report.read_text()), plan.scene_config()
    if not manifest["config"].items() >= plan.kept_pictures.items():
        return False
    count, enough = told["attempts"], plan.num_attempts
    if told["outcomes"].get("success", 0) != plan.episodes and count != enough:
        return False
    if enough is not None and count > enough:
        return False
    return {entry["key"] for entry in manifest["inputs"]} <= {
        store.key(_DEMONSTRATION, _attempt_config(plan, scene, k), []) for k in range(count)
    }


def _attempt_config(plan: Plan, scene: dict[str, Any], k: int) -> dict[str, Any]:
    """Settings on which attempt ``k`` depends, the scene's (``Plan.scene_config``) included; not the number of attempts."""
    source = {"type": plan.source.get_choice_name(type(plan.source)), **dataclasses.asdict(plan.source)}
    own = {
        "source": source,
        "seed": plan.attempt_seed(k),
        "videos": plan.stored_as == "video",
        **told_origin(plan.origin),
    }
    return canonical(scene | own | {"part_poses": plan.part_poses, "keep_failures": plan.keep_failures})


def _build_attempt(plan: Plan, sim: Simulation, spec: DatasetSpec, k: int, config: Any, folder: Path) -> None:
    """Stage ``demonstration``: entry.json, and dataset/ with episodes.json if the attempt is kept."""
    from taccorl.data.lerobot_format import write_episodes

    recorder = attempt(plan, sim, spec, k)
    kept, rows = recorder.is_kept(plan), len(recorder.rows)
    if kept:
        episode = recorder.episode(f"{plan.task} seed {config['seed']}", config)
        write_episodes([episode], folder / "dataset")
        attempts.write_json(folder / "episodes.json", [episode_record(episode, "")])
    _write_entry(folder, k, config["seed"], outcome=recorder.outcome, reason=recorder.reason, kept=kept, rows=rows)


def _write_entry(
    folder: Path, k: int, seed: int, *, outcome: str, reason: str, kept: bool = False, rows: int = 0
) -> None:
    entry = {"attempt": k, "seed": seed, "outcome": outcome, "kept": kept, "rows": rows, "seconds": rows / CONTROL_HZ}
    attempts.write_json(folder / "entry.json", entry | ({"reason": reason} if reason else {}))


def _report(plan: Plan, entries: list[dict[str, Any]]) -> dict[str, Any]:
    return {
        "task": plan.task,
        **plan.origin.record(),
        "attempts": len(entries),
        "outcomes": attempts.outcomes(entries),
        "episodes": sum(e["kept"] for e in entries),
        "rows": sum(e["rows"] for e in entries if e["kept"]),
        "entries": entries,
    }


def collect_recordings(plan: Plan, out: Path, progress: attempts.Progress = print) -> list[Path]:
    """Collect ``plan.episodes`` successes as MCAP files ``out/TASK_000.mcap`` … in the format of the robot's drivers; returns
    their paths. Failures, if they are kept, get numbers of the same sequence, but do not count.

    Raises:
        TaccorlError: ``out`` is not empty, or three of four attempts of an expert fail.
    """
    if not is_free(out):
        raise TaccorlError(f"{out} holds files already; nothing was changed: give another folder")
    sim = plan.make()
    spec = row_spec(sim, pictures=False, executed=True)
    written: list[Path] = []
    said = _Said(plan)

    entries: list[attempts.Entry] = []
    for k in _Needed(plan, f"the recordings made so far are in {out}").one_by_one(entries):
        recorder = attempt(plan, sim, spec, k, dense=True)
        if recorder.is_kept(plan):
            path = out / f"{plan.task}_{len(written):03d}.mcap"
            part = path.with_suffix(".part")
            origin = Origin("surrogate", f"recording of the {plan.origin.text}")  # it stands for a robot's
            success = recorder.outcome == "success"
            write_twin_mcap(part, sim, recorder.trajectory(), success=success, origin=origin)
            part.replace(path)
            written.append(path)
        entries.append({"outcome": recorder.outcome, "seconds": len(recorder.rows) / CONTROL_HZ})
        progress(f"attempt {k}: {said(entries[-1])}")
    return written


class _Needed:
    """Numbers 0, 1, … of the attempts to run until the plan has its successes. An attempt is started when it is needed even if
    all that run succeed: the attempts follow from the plan alone, whatever their order of ending and number at the same time.
    """

    def __init__(self, plan: Plan, advice: str, at_once: int = 1) -> None:
        """
        Args:
            advice: end of the message of the error.
            at_once: number of attempts that may run at the same time.
        """
        self._plan, self._advice = plan, advice
        self._unjudged = _MANY + at_once - 1
        """Most attempts to start before it is known whether they are hopeless."""
        self._outcomes: dict[int, str] = {}
        self._started = self._successes = 0
        self._in_order: Counter[str] = Counter()
        """Outcomes of the attempts before the first whose outcome is unknown."""

    def first(self) -> range:
        """Attempts to begin with."""
        plan, running = self._plan, self._started - len(self._outcomes)
        number = plan.episodes - self._successes - running
        if self._in_order.total() < _MANY:
            number = min(number, self._unjudged - self._started)
        if not plan.source.repeatable:
            number = min(number, 1 - running)  # a person's attempts follow one another
        if plan.num_attempts is not None:
            left = plan.num_attempts - self._started
            # past the last, the plan states what is missing
            number = min(number, left if left or running or plan.keep_failures else 1)
        started, self._started = self._started, self._started + max(number, 0)
        return range(started, self._started)

    def after(self, k: int, outcome: str) -> range:
        """Attempts to start after the outcome of attempt ``k`` became known.

        Raises:
            TaccorlError: the attempts are hopeless (``Plan.hopeless``).
        """
        self._outcomes[k] = outcome
        self._successes += outcome == "success"
        while (num := self._in_order.total()) in self._outcomes:
            self._in_order[self._outcomes[num]] += 1
            successes = self._in_order["success"]
            if self._plan.hopeless(num + 1, successes):
                kinds, failed = ", ".join(sorted(self._in_order)), num + 1 - successes
                raise TaccorlError(
                    f"{self._plan.task}: {failed} of {num + 1} attempts failed ({kinds}); {self._advice}"
                )
        return self.first()

    def one_by_one(self, entries: Sequence[attempts.Entry]) -> Iterator[int]:
        """All attempts, one after the other; the entry of each is in ``entries`` when the next is asked for."""
        todo = deque(self.first())
        while todo:
            yield (k := todo.popleft())
            todo += self.after(k, entries[k]["outcome"])

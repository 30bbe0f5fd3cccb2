"""Demonstrations in the twin into a LeRobot dataset, or into recordings as the robot's drivers would write them.

Every attempt is a pure function of the configuration and its own seed, and is in the store once it is finished: a run that was
stopped continues, and the same command gives the same dataset.
"""

import abc
import dataclasses
import functools
import json
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import draccus
import mujoco
import numpy as np

import taccorl
from taccorl.data.dataset import PROVENANCE, dataset_spec_to_json, episode_record
from taccorl.data.spec import DatasetSpec, find_spec, load_dataset_spec
from taccorl.demos.experts import expert_of
from taccorl.demos.experts.scripted import ScriptedExpertConfig
from taccorl.demos.recorder import ORIGIN, EpisodeRecorder, with_simulator
from taccorl.demos.twin_recording import write_twin_mcap
from taccorl.errors import InTheWayError, TaccorlError, UnreachableError
from taccorl.lineage.canonical import canonical
from taccorl.lineage.destinations import is_free
from taccorl.lineage.manifest import read_manifest
from taccorl.lineage.stage import Artefact, Stage
from taccorl.lineage.store import Store
from taccorl.sim.simulation import Simulation
from taccorl.sim.task import tasks
from taccorl.sim.twin import CONTROL_HZ, TwinConfig
from taccorl.sim.twin_file import load_twin, twin_text

ATTEMPT_VERSION = 3
COLLECTION_VERSION = 2
_MANY = 20  # attempts after which a success rate means something
AFTER_S = 1.0  # an attempt whose demonstrator has finished is watched for so long

Actions = Iterator[np.ndarray]
Progress = Callable[[str], None]


@dataclass(frozen=True, kw_only=True)
class Source(draccus.ChoiceRegistry, abc.ABC):
    """Source of demonstrations: --source.type=expert, keyboard, gamepad, leader."""

    repeatable: ClassVar[bool] = True
    """The same seed gives the same actions."""

    @abc.abstractmethod
    def actions(self, sim: Simulation, rng: np.random.Generator) -> Actions:
        """Actions (14,) of one attempt; reads the simulation between them. Ends when the demonstrator has finished."""


@Source.register_subclass("expert")
@dataclass(frozen=True, kw_only=True)
class ExpertSource(Source):
    """The task's scripted expert, with human-like errors that it corrects when it is blocked."""

    hands: ScriptedExpertConfig = field(default_factory=ScriptedExpertConfig)
    """How human the hands are."""

    def actions(self, sim: Simulation, rng: np.random.Generator) -> Actions:
        expert = expert_of(sim.task)(sim, rng, self.hands)
        expert.start()
        for _ in range(round(AFTER_S * CONTROL_HZ)):
            while not expert.done:
                yield expert.act()
            yield expert.act()


@dataclass(frozen=True, kw_only=True)
class Plan:
    """Settings of a collection: task, number of episodes, source, twin."""

    task: str
    episodes: int = 20
    """Successful ones."""
    source: Source = field(default_factory=ExpertSource)
    difficulty: str = "train"
    twin: Path | None = None
    """A twin.yaml; the nominal twin if not given."""
    randomization: float = 1.0
    """Share of the paper's ranges: 0 is the nominal scene."""
    images: bool = True
    seed: int = 0
    keep_failures: bool = False
    """Keep failed attempts as episodes too, labelled so."""
    origin: str = ORIGIN
    """Label of everything that is made: "surrogate: …" where the twin plays the robot."""

    def __post_init__(self) -> None:
        if self.episodes < 1:
            raise TaccorlError(f"--episodes={self.episodes}: at least one")
        if self.seed < 0:
            raise TaccorlError(f"--seed={self.seed}: seeds are 0, 1, 2, …")
        if not 0 <= self.randomization <= 1:
            raise TaccorlError(
                f"--randomization={self.randomization:g}: it is a share of the paper's reset ranges, from 0 to 1"
            )

    def twin_config(self) -> TwinConfig:
        """The twin to demonstrate in."""
        return load_twin(self.twin) if self.twin else TwinConfig()

    def make(self) -> Simulation:
        """Make the simulation of this plan.

        Raises:
            TaccorlError: unknown task or difficulty, with the near name.
        """
        return Simulation(tasks.get(self.task)(self.difficulty), self.twin_config(), scale=self.randomization)

    @property
    def num_attempts(self) -> int | None:
        """Largest number of attempts; None: as many as needed."""
        return None

    def hopeless(self, attempts: int, successes: int) -> bool:
        """True if an automatic demonstrator fails so often that something must be wrong. For a person there is no limit."""
        return self.source.repeatable and attempts >= _MANY and successes < attempts / 4

    def attempt_seed(self, k: int) -> int:
        """Seed of attempt ``k``: independent of all others and of how many there are."""
        sequence = np.random.SeedSequence(self.seed, spawn_key=(zlib.crc32(self.task.encode()), k))
        return int(sequence.generate_state(1, np.uint64)[0] >> np.uint64(2))


@dataclass
class Attempt(EpisodeRecorder):
    """Recorded data of one attempt, and its outcome."""

    outcome: str = "unfinished"
    """As ``outcome_of``, or ``unreachable``: the demonstrator wanted a pose that its arm does not reach."""
    reason: str = ""
    """Which pose."""

    def is_kept(self, plan: Plan) -> bool:
        """Whether ``plan`` keeps the attempt as an episode. An attempt without rows is never kept."""
        return self.outcome == "success" or (plan.keep_failures and bool(self.rows))


def attempt(plan: Plan, sim: Simulation, spec: DatasetSpec, k: int, *, dense: bool = False) -> Attempt:
    """Run attempt ``k`` up to success, failure, the time limit, or the end of the demonstrator's actions."""
    seed = plan.attempt_seed(k)
    sim.reset([seed])
    recorder = Attempt(sim, spec, np.random.default_rng([seed, 2]), dense=dense)
    try:
        for action in plan.source.actions(sim, np.random.default_rng([seed, 1])):
            recorder.step(action)
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


def collect(plan: Plan, out: Path, store: Store, progress: Progress = print) -> dict[str, Any]:
    """A LeRobot dataset of ``plan.episodes`` successes at ``out``; returns the report.

    Raises:
        InTheWayError: ``out`` holds something else, as far as can be told before the first attempt; else after the last.
        TaccorlError: three of four attempts of an expert fail: something is wrong with the task or the twin.
    """
    _check_out(plan, out, store)
    sim = plan.make()
    spec = with_simulator(load_dataset_spec(find_spec("taccorl_bimanual")), sim, pictures=plan.images)
    twin = twin_text(plan.twin_config())
    shards: list[Artefact] = []
    entries: list[dict[str, Any]] = []
    successes = k = 0
    enough = plan.num_attempts if plan.keep_failures else None
    while successes < plan.episodes and k != enough:
        config = _attempt_config(plan, twin, k)
        build = functools.partial(_build_attempt, plan, sim, spec, k)
        artefact = store.run(dataclasses.replace(_DEMONSTRATION, fn=build), config, [])
        entry = json.loads((artefact.path / "entry.json").read_text())
        entries.append(entry)
        successes += entry["outcome"] == "success"
        if entry["kept"]:
            shards.append(artefact)
        progress(f"attempt {k}: {entry['outcome']} after {entry['seconds']:.1f} s ({successes} of {plan.episodes})")
        k += 1
        if plan.hopeless(k, successes):
            raise TaccorlError(
                f"{plan.task}: {k - successes} of {k} attempts failed ({', '.join(sorted({e['outcome'] for e in entries}))}); "
                f"nothing was written to {out}. Look at one: taccorl collect --task={plan.task} --keep_failures=true"
            )
    report = _report(plan, entries)
    config = {"task": plan.task, "attempts": [e["seed"] for e in entries if e["kept"]], "twin": twin}
    collection = dataclasses.replace(_COLLECTION, fn=lambda _, inputs, folder: assemble(spec, report, inputs, folder))
    store.run(collection, config, shards, destination=out)
    sim.close()
    return report


def _not_yet(config: Any, inputs: list[Path], folder: Path) -> None:
    raise NotImplementedError("this stage is run with its function bound to the attempts; it cannot be called directly")


_DEMONSTRATION = Stage("demonstration", _not_yet, ATTEMPT_VERSION)
_COLLECTION = Stage("collection", _not_yet, COLLECTION_VERSION, manifest=f"{PROVENANCE}/manifest.json")
REPORT = "collect_report.json"


def _check_out(plan: Plan, out: Path, store: Store) -> None:
    """Refuses what cannot be the dataset of this plan: hours of attempts would end at the store's refusal."""
    if not is_free(out) and not _may_be_of(plan, out, store):
        raise in_the_way(out, _COLLECTION, plan.task)


def in_the_way(out: Path, stage: Stage, task: str) -> InTheWayError:
    """The error that names what occupies ``out``, where ``stage`` was to publish a dataset of ``task``."""
    manifest = read_manifest(out)
    if manifest:
        held = (
            f"holds {manifest['stage']} v{manifest['stage_version']}, key {manifest['key']}, made {manifest['created']}"
        )
    else:
        kind = f"a folder of {sum(1 for _ in out.rglob('*'))} entries" if out.is_dir() else "a file"
        held = f"is {kind} without a taccorl manifest"
    return InTheWayError(
        f"{out} is in the way: it {held}; this run makes {stage.name} v{stage.version} of {task}. "
        "Nothing was touched: give another destination, or move that one away yourself."
    )


def _may_be_of(plan: Plan, out: Path, store: Store) -> bool:
    """Whether the dataset at ``out`` is made of attempts of this very plan, and of as many."""
    manifest, report = read_manifest(out), out / PROVENANCE / REPORT
    if not manifest or manifest["stage"] != _COLLECTION.name or not report.is_file():
        return False
    told, twin = json.loads(report.read_text()), twin_text(plan.twin_config())
    count, enough = told["attempts"], plan.num_attempts
    if told["outcomes"].get("success", 0) != plan.episodes and count != enough:
        return False
    if enough is not None and count > enough:
        return False
    attempts = {store.key(_DEMONSTRATION, _attempt_config(plan, twin, k), []) for k in range(count)}
    return {entry["key"] for entry in manifest["inputs"]} <= attempts


def _attempt_config(plan: Plan, twin: str, k: int) -> dict[str, Any]:
    """What an attempt depends on; not on how many there are."""
    source = {"type": plan.source.get_choice_name(type(plan.source)), **dataclasses.asdict(plan.source)}
    config = {
        "task": plan.task,
        "difficulty": plan.difficulty,
        "twin": twin,
        "randomization": plan.randomization,
        "source": source,
        "seed": plan.attempt_seed(k),
        "images": plan.images,
        "keep_failures": plan.keep_failures,
        "origin": plan.origin,
        "mujoco": mujoco.__version__,
        "taccorl": taccorl.__version__,
    }
    return canonical(config)


def _build_attempt(
    plan: Plan, sim: Simulation, spec: DatasetSpec, k: int, config: Any, inputs: list[Path], folder: Path
) -> None:
    """Stage ``demonstration``: entry.json, and dataset/ with episodes.json if the attempt is kept."""
    from taccorl.data.lerobot_format import write_episodes

    recorder = attempt(plan, sim, spec, k)
    kept, rows = recorder.is_kept(plan), len(recorder.rows)
    entry = {"attempt": k, "seed": config["seed"], "outcome": recorder.outcome, "kept": kept, "rows": rows}
    entry["seconds"] = rows / CONTROL_HZ
    if recorder.reason:
        entry["reason"] = recorder.reason
    if kept:
        episode = recorder.episode(f"{plan.task} seed {config['seed']}", config)
        episode = dataclasses.replace(episode, origin=plan.origin)
        write_episodes([episode], folder / "dataset")
        _dump(folder / "episodes.json", [episode_record(episode, "")])
    _dump(folder / "entry.json", entry)


def assemble(spec: DatasetSpec, report: dict[str, Any], shards: list[Path], folder: Path) -> None:
    """Kept attempts, each dataset/ with episodes.json, merged at ``folder``, with their provenance in meta/taccorl/."""
    from taccorl.data.lerobot_format import merge

    merge([shard / "dataset" for shard in shards], folder)
    meta = folder / PROVENANCE
    meta.mkdir(parents=True, exist_ok=True)
    records = [record for shard in shards for record in json.loads((shard / "episodes.json").read_text())]
    _dump(meta / "episodes.json", records)
    _dump(meta / REPORT, report)
    _dump(meta / "dataset_spec.json", dataset_spec_to_json(spec))


def _report(plan: Plan, entries: list[dict[str, Any]]) -> dict[str, Any]:
    outcomes = {e["outcome"] for e in entries}
    return {
        "task": plan.task,
        "origin": plan.origin,
        "attempts": len(entries),
        "outcomes": {o: sum(e["outcome"] == o for e in entries) for o in sorted(outcomes)},
        "episodes": sum(e["kept"] for e in entries),
        "rows": sum(e["rows"] for e in entries if e["kept"]),
        "entries": entries,
    }


def collect_recordings(plan: Plan, out: Path, progress: Progress = print) -> list[Path]:
    """``plan.episodes`` successes as MCAP files ``out/TASK_000.mcap`` …, as the robot's drivers would write them.

    Failures, if they are kept, are numbered with them and not counted.

    Raises:
        TaccorlError: ``out`` holds something already.
    """
    if not is_free(out):
        raise TaccorlError(f"{out} holds files already; nothing was touched: give another folder")
    sim = plan.make()
    spec = with_simulator(load_dataset_spec(find_spec("taccorl_bimanual")), sim, pictures=False)
    written: list[Path] = []
    successes = k = 0
    enough = plan.num_attempts if plan.keep_failures else None
    while successes < plan.episodes and k != enough:
        recorder = attempt(plan, sim, spec, k, dense=True)
        success = recorder.outcome == "success"
        successes += success
        progress(f"attempt {k}: {recorder.outcome} after {len(recorder.rows) / CONTROL_HZ:.1f} s")
        if recorder.is_kept(plan):
            path = out / f"{plan.task}_{len(written):03d}.mcap"
            part = path.with_suffix(".part")
            origin = f"surrogate recording from the {plan.origin}"
            write_twin_mcap(part, sim, recorder.trajectory(), success=success, origin=origin)
            part.replace(path)
            written.append(path)
        k += 1
        if plan.hopeless(k, successes):
            raise TaccorlError(
                f"{plan.task}: only {successes} of {k} attempts succeeded; those kept so far are in {out}"
            )
    return written


def _dump(path: Path, value: Any) -> None:
    path.write_text(json.dumps(value, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")

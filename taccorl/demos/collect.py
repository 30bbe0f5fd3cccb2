"""Demonstrations in the twin into a LeRobot dataset, or into recordings as the robot's drivers would write them.

Every attempt is a pure function of the configuration and its own seed, and lies in the store once it is done: a run that was
stopped goes on, and the same command gives the same dataset.
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
from taccorl.demos.experts import experts
from taccorl.demos.experts.scripted import ScriptedExpertConfig
from taccorl.demos.recorder import ORIGIN, EpisodeRecorder, with_simulator
from taccorl.demos.twin_recording import write_twin_mcap
from taccorl.errors import TaccorlError
from taccorl.lineage.canonical import canonical
from taccorl.lineage.stage import Artefact, Stage
from taccorl.lineage.store import Store
from taccorl.sim.simulation import Simulation
from taccorl.sim.tasks import tasks
from taccorl.sim.twin import CONTROL_HZ, TwinConfig
from taccorl.sim.twin_file import load_twin, twin_text

ATTEMPT_VERSION = 1
_MANY = 20  # attempts after which a success rate means something
_AFTER_S = 1.0  # an attempt whose demonstrator has finished is watched for so long

Actions = Iterator[np.ndarray]
Progress = Callable[[str], None]


@dataclass(frozen=True, kw_only=True)
class Source(draccus.ChoiceRegistry, abc.ABC):
    """Who demonstrates: --source.type=expert, keyboard, gamepad, leader."""

    repeatable: ClassVar[bool] = True
    """The same seed gives the same actions."""

    @abc.abstractmethod
    def actions(self, sim: Simulation, rng: np.random.Generator) -> Actions:
        """Actions (14,) of one attempt, looking at the simulation between them; ends when the demonstrator has finished."""


@Source.register_subclass("expert")
@dataclass(frozen=True, kw_only=True)
class ExpertSource(Source):
    """The task's scripted expert, human-like and correcting by touch."""

    hands: ScriptedExpertConfig = field(default_factory=ScriptedExpertConfig)
    """How human the hands are."""

    def actions(self, sim: Simulation, rng: np.random.Generator) -> Actions:
        expert = experts.get(sim.task.name)(sim, rng, self.hands)
        expert.start()
        for _ in range(round(_AFTER_S * CONTROL_HZ)):
            while not expert.done:
                yield expert.act()
            yield expert.act()


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What to collect."""

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

    def twin_config(self) -> TwinConfig:
        """The twin to demonstrate in."""
        return load_twin(self.twin) if self.twin else TwinConfig()

    def make(self) -> Simulation:
        """Its simulation.

        Raises:
            TaccorlError: unknown task or difficulty, with the near name.
        """
        return Simulation(tasks.get(self.task)(self.difficulty), self.twin_config(), scale=self.randomization)

    @property
    def num_attempts(self) -> int | None:
        """How many there can be; None: as many as it takes."""
        return None

    def hopeless(self, attempts: int, successes: int) -> bool:
        """Whether a demonstrator that works by itself fails so often that something is wrong. A person may try for ever."""
        return self.source.repeatable and attempts >= _MANY and successes < attempts / 4

    def attempt_seed(self, k: int) -> int:
        """Seed of attempt ``k``: independent of all others and of how many there are."""
        sequence = np.random.SeedSequence(self.seed, spawn_key=(zlib.crc32(self.task.encode()), k))
        return int(sequence.generate_state(1, np.uint64)[0] >> np.uint64(2))


def attempt(plan: Plan, sim: Simulation, spec: DatasetSpec, k: int, *, dense: bool = False) -> EpisodeRecorder:
    """Run attempt ``k`` to its end: success, failure, time limit, or the demonstrator has finished."""
    seed = plan.attempt_seed(k)
    sim.reset([seed])
    recorder = EpisodeRecorder(sim, spec, np.random.default_rng([seed, 2]), dense=dense)
    for action in plan.source.actions(sim, np.random.default_rng([seed, 1])):
        recorder.step(action)
        if sim.judge.outcome.over[0]:
            break
    return recorder


def outcome_of(sim: Simulation) -> str:
    """``success``, the failure's category, or ``unfinished``."""
    outcome = sim.judge.outcome
    return "success" if outcome.success[0] else str(outcome.failure[0]) or "unfinished"


def collect(plan: Plan, out: Path, store: Store, progress: Progress = print) -> dict[str, Any]:
    """A LeRobot dataset of ``plan.episodes`` successes at ``out``; returns the report.

    Raises:
        TaccorlError: three of four attempts of an expert fail: something is wrong with the task or the twin.
    """
    sim = plan.make()
    spec = with_simulator(load_dataset_spec(find_spec("taccorl_bimanual")), sim, pictures=plan.images)
    twin = twin_text(plan.twin_config())
    shards: list[Artefact] = []
    entries: list[dict[str, Any]] = []
    successes = k = 0
    enough = plan.num_attempts if plan.keep_failures else None
    while successes < plan.episodes and k != enough:
        config = _attempt_config(plan, twin, k)
        stage = Stage("demonstration", functools.partial(_build_attempt, plan, sim, spec, k), ATTEMPT_VERSION)
        artefact = store.run(stage, config, [])
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
    stage = Stage("collection", lambda _, inputs, folder: _assemble(spec, report, inputs, folder), manifest=_MANIFEST)
    store.run(stage, config, shards, destination=out)
    sim.close()
    return report


_MANIFEST = "meta/taccorl/manifest.json"


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
    outcome = outcome_of(sim)
    keep = outcome == "success" or plan.keep_failures
    entry = {"attempt": k, "seed": config["seed"], "outcome": outcome, "kept": keep, "rows": len(recorder.rows)}
    entry["seconds"] = len(recorder.rows) / CONTROL_HZ
    if keep:
        episode = recorder.episode(f"{plan.task} seed {config['seed']}", config)
        episode = dataclasses.replace(episode, origin=plan.origin)
        write_episodes([episode], folder / "dataset")
        _dump(folder / "episodes.json", [episode_record(episode, "")])
    _dump(folder / "entry.json", entry)


def _assemble(spec: DatasetSpec, report: dict[str, Any], shards: list[Path], folder: Path) -> None:
    """Stage ``collection``: the kept attempts merged, with their provenance in meta/taccorl/."""
    from taccorl.data.lerobot_format import merge

    merge([shard / "dataset" for shard in shards], folder)
    meta = folder / PROVENANCE
    meta.mkdir(parents=True, exist_ok=True)
    records = [record for shard in shards for record in json.loads((shard / "episodes.json").read_text())]
    _dump(meta / "episodes.json", records)
    _dump(meta / "collect_report.json", report)
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

    Raises:
        TaccorlError: ``out`` holds something already.
    """
    if out.exists() and any(out.iterdir()):
        raise TaccorlError(f"{out} holds files already; nothing was touched: give another folder")
    sim = plan.make()
    spec = with_simulator(load_dataset_spec(find_spec("taccorl_bimanual")), sim, pictures=False)
    written: list[Path] = []
    k = 0
    enough = plan.num_attempts if plan.keep_failures else None
    while len(written) < plan.episodes and k != enough:
        recorder = attempt(plan, sim, spec, k, dense=True)
        outcome = outcome_of(sim)
        progress(f"attempt {k}: {outcome} after {len(recorder.rows) / CONTROL_HZ:.1f} s")
        if outcome == "success" or plan.keep_failures:
            path = out / f"{plan.task}_{len(written):03d}.mcap"
            part = path.with_suffix(".part")
            origin = f"surrogate recording from the {plan.origin}"
            write_twin_mcap(part, sim, recorder.trajectory(), success=outcome == "success", origin=origin)
            part.replace(path)
            written.append(path)
        k += 1
        if plan.hopeless(k, len(written)):
            raise TaccorlError(f"{plan.task}: only {len(written)} of {k} attempts succeeded; {out} holds those")
    return written


def _dump(path: Path, value: Any) -> None:
    path.write_text(json.dumps(value, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")

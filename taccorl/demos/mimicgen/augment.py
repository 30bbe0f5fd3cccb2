"""Sources into a dataset of N new successes: attempts in the store, on any engine, the first N by number.

An attempt's key is made of all that decides: the spec, the sources' content, the twin, the seed, its number. So a run that was
killed goes on where it was, another spec or other sources never mix with it, and any number of workers gives the same dataset.
"""

import dataclasses
import functools
import json
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

import taccorl
from taccorl.data.dataset import episode_record
from taccorl.data.spec import find_spec, load_dataset_spec
from taccorl.demos.collect import assemble
from taccorl.demos.mimicgen.attempt import Attempted, Attempts
from taccorl.demos.mimicgen.from_dataset import read_sources
from taccorl.demos.mimicgen.source import SourcePool
from taccorl.demos.mimicgen.spec import MimicSpec, check_task
from taccorl.demos.recorder import ORIGIN, with_simulator
from taccorl.errors import TaccorlError
from taccorl.lineage.canonical import canonical
from taccorl.lineage.engines import Engine, LocalEngine
from taccorl.lineage.stage import Artefact, Stage
from taccorl.lineage.store import Store
from taccorl.sim.simulation import Simulation
from taccorl.sim.tasks import tasks
from taccorl.sim.twin import CONTROL_HZ, TwinConfig
from taccorl.sim.twin_file import load_twin, twin_text

VERSION = 1  # of an attempt
_ROUND = 20  # attempts between two looks at how many have succeeded
_HOPELESS = 0.05  # of a hundred attempts
_HUNDRED = 100

Progress = Callable[[str], None]


@dataclass(frozen=True, kw_only=True)
class AugmentPlan:
    """What to generate."""

    spec: MimicSpec
    episodes: int = 200
    """Successful ones."""
    difficulty: str = "train"
    twin: Path | None = None
    """Where the new episodes happen; the nominal twin if not given. It need not be the sources' twin."""
    randomization: float = 1.0
    """Share of the paper's ranges."""
    images: bool = True
    seed: int = 0
    origin: str = field(default=ORIGIN)

    def __post_init__(self) -> None:
        if self.episodes < 1:
            raise TaccorlError(f"--episodes={self.episodes}: at least one")
        if self.seed < 0:
            raise TaccorlError(f"--seed={self.seed}: seeds are 0, 1, 2, …")

    def twin_config(self) -> TwinConfig:
        """The twin to generate in."""
        return load_twin(self.twin) if self.twin else TwinConfig()

    def make(self) -> Simulation:
        """Its simulation."""
        task = tasks.get(self.spec.task)(self.difficulty)
        check_task(self.spec, task)
        return Simulation(task, self.twin_config(), scale=self.randomization)

    def config(self, k: int) -> dict[str, Any]:
        """What attempt ``k`` depends on besides the sources; not on how many there are."""
        return canonical(
            {
                "task": self.spec.task,
                "spec": dataclasses.asdict(self.spec),
                "difficulty": self.difficulty,
                "twin": twin_text(self.twin_config()),
                "randomization": self.randomization,
                "images": self.images,
                "origin": self.origin,
                "root_seed": self.seed,
                "attempt": k,
                "mujoco": mujoco.__version__,
                "taccorl": taccorl.__version__,
            }
        )


def augment(
    plan: AugmentPlan, source: Path, out: Path, store: Store, engine: Engine | None = None, progress: Progress = print
) -> dict[str, Any]:
    """A LeRobot dataset at ``out`` of ``plan.episodes`` successes made of those at ``source``; returns the report.

    Raises:
        TaccorlError: sources that do not fit, something else at ``out``, or hardly any attempt succeeds.
    """
    sources = store.source(source)
    engine, entries, made = engine or LocalEngine(), [], []
    _attempts(plan, sources.path, sources.digest)  # before anything is sent away: what does not fit is refused here
    while (successes := sum(e["outcome"] == "success" for e in entries)) < plan.episodes:
        if len(entries) >= _HUNDRED and successes < _HOPELESS * len(entries):
            raise TaccorlError(
                f"{plan.spec.task}: {successes} of {len(entries)} attempts succeeded, nothing was written to {out}. Failures: "
                f"{_outcomes(entries)}"
            )
        numbers = list(range(len(entries), len(entries) + _ROUND))
        fn = functools.partial(run_attempt, plan, sources, store)
        for k, artefact in zip(numbers, engine.map(fn, numbers, name=lambda k: f"attempt {k}"), strict=True):
            entry = json.loads((artefact.path / "entry.json").read_text())
            entries.append(entry)
            made.append(artefact)
            successes += entry["outcome"] == "success"
            progress(f"attempt {k}: {entry['outcome']} after {entry['seconds']:.1f} s ({successes} of {plan.episodes})")
            if successes == plan.episodes:
                break
    kept = [artefact for artefact, entry in zip(made, entries, strict=True) if entry["outcome"] == "success"]
    report = _report(plan, entries)
    spec = with_simulator(load_dataset_spec(find_spec("taccorl_bimanual")), plan.make(), pictures=plan.images)

    def collection(_: Any, inputs: list[Path], folder: Path) -> None:
        assemble(spec, report, inputs, folder)

    stage = Stage("augmented", collection, VERSION, manifest="meta/taccorl/manifest.json")
    store.run(
        stage, {"task": plan.spec.task, "spec": plan.spec.digest, "attempts": len(entries)}, kept, destination=out
    )
    return report


def run_attempt(plan: AugmentPlan, sources: Artefact, store: Store, k: int) -> Artefact:
    """Attempt ``k``, from the store if it has been made: entry.json, actions.npy, and of a success dataset/, episodes.json."""

    def build(config: Any, inputs: list[Path], folder: Path) -> None:
        _build(plan, sources, k, config, folder)

    return store.run(Stage("mimicgen", build, VERSION), plan.config(k), [sources])


def _build(plan: AugmentPlan, sources: Artefact, k: int, config: dict[str, Any], folder: Path) -> None:
    from taccorl.data.lerobot_format import write_episodes

    attempts = _attempts(plan, sources.path, sources.digest)
    spec = with_simulator(load_dataset_spec(find_spec("taccorl_bimanual")), attempts.sim, pictures=plan.images)
    try:
        done = attempts.run(k)
        recorder = attempts.redo(done, spec, np.random.default_rng([done.scene_seed, 2])) if done.success else None
    except Exception as error:  # one attempt must not end a run of hundreds; it is counted, with where it broke
        where = traceback.extract_tb(error.__traceback__)[-1]
        reason = f"{type(error).__name__}: {error} ({Path(where.filename).name}:{where.lineno})"
        done, recorder = Attempted(k, -1, "error", reason), None
    entry = {
        "attempt": k,
        "outcome": done.outcome,
        "rows": len(done.actions),
        "seconds": len(done.actions) / CONTROL_HZ,
    }
    entry |= {"reason": done.reason, "scene_seed": done.scene_seed, "provenance": done.provenance}
    np.save(folder / "actions.npy", done.actions)
    if done.success and recorder is not None:
        told = {key: value for key, value in config.items() if key != "spec"} | {"mimicgen": done.provenance}
        episode = recorder.episode(f"{plan.spec.task} attempt {k}", told | {"sources": sources.digest})
        episode = dataclasses.replace(episode, origin=plan.origin)
        write_episodes([episode], folder / "dataset")
        (folder / "episodes.json").write_text(json.dumps([episode_record(episode, sources.digest)]), encoding="utf-8")
    (folder / "entry.json").write_text(json.dumps(entry, indent=1, ensure_ascii=False), encoding="utf-8")


_made: dict[str, Attempts] = {}


def _attempts(plan: AugmentPlan, path: Path, digest: str) -> Attempts:
    """Sources and model, made once in a process."""
    key = json.dumps([plan.config(0), digest], sort_keys=True)
    if key not in _made:
        _made.clear()
        sim = plan.make()
        _made[key] = Attempts(SourcePool(plan.spec, read_sources(path, plan.spec)), sim, plan.seed)
    return _made[key]


def _outcomes(entries: list[dict[str, Any]]) -> dict[str, int]:
    return dict(sorted(Counter(e["outcome"] for e in entries).items()))


def _report(plan: AugmentPlan, entries: list[dict[str, Any]]) -> dict[str, Any]:
    return {
        "task": plan.spec.task,
        "origin": plan.origin,
        "attempts": len(entries),
        "outcomes": _outcomes(entries),
        "episodes": sum(e["outcome"] == "success" for e in entries),
        "rows": sum(e["rows"] for e in entries if e["outcome"] == "success"),
        "entries": [{key: value for key, value in e.items() if key != "provenance"} for e in entries],
    }

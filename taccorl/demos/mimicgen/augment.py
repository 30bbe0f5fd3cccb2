"""Generate a dataset of N new successes from sources: attempts in the store, on any engine; the first N successes by number.

An attempt's key contains everything that it depends on: the spec, the sources' content, the twin, the seed, its number. So a
run that was killed continues, another spec or other sources never mix with it, and any number of workers gives the same
dataset. An attempt that kills its process twice (``crashed``) or does not end (``hung``) is counted like any other that failed.
Attempts are physics; rows of a success, with touch and pictures, are another artefact, which ``rows: actions`` leaves out.
"""

import dataclasses
import functools
import json
import shlex
import traceback
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from taccorl.data.dataset import PROVENANCE, episode_record
from taccorl.data.episode import Episode
from taccorl.data.origin import TWIN_ORIGIN, Origin
from taccorl.data.spec import DatasetSpec
from taccorl.demos import attempts
from taccorl.demos.mimicgen.attempt import Attempted, Attempts, attempt_seeds
from taccorl.demos.mimicgen.execution import DIFFERS, Demonstration, Execution, execute
from taccorl.demos.mimicgen.from_dataset import make_simulation, read_sources
from taccorl.demos.mimicgen.grips import grips_report
from taccorl.demos.mimicgen.source import SourcePool
from taccorl.demos.mimicgen.spec import GatesSpec, MimicSpec, check_task
from taccorl.demos.mimicgen.stored_actions import META, MIMICGEN, write_stored
from taccorl.demos.mimicgen.stratify import ResetSpace, first_attempts, next_round
from taccorl.demos.recorder import row_spec, told_origin
from taccorl.errors import TaccorlError, nearest
from taccorl.lineage.canonical import canonical
from taccorl.lineage.engines import Engine, LocalEngine
from taccorl.lineage.manifest import read_manifest
from taccorl.lineage.processes import Failed
from taccorl.lineage.stage import Artefact, Stage
from taccorl.lineage.store import Store
from taccorl.sim.randomize import Row, draw
from taccorl.sim.simulation import Simulation
from taccorl.sim.task import tasks
from taccorl.sim.twin import CONTROL_HZ

VERSION = 5  # of an attempt
ROWS_VERSION = 3  # of a success's rows
AUGMENTED_VERSION = 4  # of the dataset
ACTIONS_VERSION = 3  # of stored actions
_ROUND = (
    20  # attempts at a time at least, where 200 episodes are wanted: several workers have something to do to the end
)
_HOPELESS = 0.05  # of a hundred attempts
_HUNDRED = 100

Rows = Literal["dataset", "actions"]


@dataclass(frozen=True)
class Made:
    """A finished attempt in the store: its folder, entry and time."""

    folder: Path
    """Folder of the attempt as from ``run_attempt``, without rows."""
    entry: dict[str, Any]
    """Content of entry.json: outcome and number of rows."""
    seconds: float
    """Time that its process took, rows included [s]."""


@dataclass(frozen=True, kw_only=True)
class AugmentPlan(attempts.AttemptPlan):
    """Settings of a generation: spec (which states the task), number of episodes, twin, seed."""

    task: str = field(init=False)
    spec: MimicSpec
    episodes: int = 200
    """Number of successful episodes to generate, in the plan's twin, which may differ from that of the sources."""
    stratify: bool = False
    """True: choose attempts in boxes of the reset space with few episodes (``stratify.py``). It changes which attempts are made,
    not their results."""
    origin: Origin = TWIN_ORIGIN
    """Origin of the episodes; a surrogate's where the twin stands in for the robot."""
    rows: Rows = "dataset"
    """Kind of output: a LeRobot dataset, or seeds and actions (``stored_actions.py``). The attempts are the same."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "task", self.spec.task)
        super().__post_init__()
        if self.rows not in get_args(Rows):
            raise TaccorlError(f"--rows={self.rows}: {nearest(self.rows, get_args(Rows))}")
        if self.stratify and not self.space.rows:
            raise TaccorlError(
                f"--stratify=true: a reset of {self.task} randomises nothing, so that there are no boxes to fill"
            )

    @functools.cached_property
    def space(self) -> ResetSpace:
        """Reset space of the task; without any row if ``randomization`` is 0."""
        return ResetSpace(self._rows if self.randomization > 0 else (), self.randomization)

    @functools.cached_property
    def _rows(self) -> tuple[Row, ...]:
        return tuple(tasks.get(self.task)(self.difficulty).rows)

    def scene_seed(self, k: int) -> int:
        """Scene seed of attempt ``k``."""
        return attempt_seeds(self.seed, self.task, k)[0]

    def draw(self, k: int) -> dict[str, np.ndarray]:
        """Values that the reset of attempt ``k`` draws at random (poses of parts and others): name of the row → (components,) in
        the row's unit. Nothing is simulated.
        """
        return draw(self._rows, np.random.default_rng(self.scene_seed(k)), self.randomization)

    @property
    def stage(self) -> Stage:
        """Stage that publishes the successes."""
        return _AUGMENTED if self.rows == "dataset" else _ACTIONS

    def make(self) -> Simulation:
        """Make the simulation of this plan, whose task the spec must fit."""
        sim = super().make()
        check_task(self.spec, sim.task)
        return sim

    def contract(self, sim: Simulation) -> DatasetSpec:
        """Data spec of a new episode's rows."""
        return row_spec(sim, pictures=self.images, executed=self.spec.datagen_config.has_intended)

    def config(self, k: int) -> dict[str, Any]:
        """Settings on which attempt ``k`` depends, besides the sources, as JSON values; not the number of attempts."""
        own = {"spec": dataclasses.asdict(self.spec), "images": self.images, **told_origin(self.origin)}
        return canonical(self.scene_config() | own | {"root_seed": self.seed, "attempt": k})


def augment(
    plan: AugmentPlan,
    source: Path,
    out: Path,
    store: Store,
    engine: Engine | None = None,
    progress: attempts.Progress = print,
) -> dict[str, Any]:
    """Generate ``plan.episodes`` successes from those at ``source`` into ``out``, as ``plan.rows`` states; returns the report,
    JSON values as in collect_report.json.

    Raises:
        TaccorlError: the sources do not fit or were changed, something else is at ``out``, or hardly any attempt succeeds.
    """
    sources = store.dataset(source)
    made: list[Artefact] = []
    entries: list[attempts.Entry] = []
    # Before anything is sent away: what does not fit is refused here.
    first = _attempts(plan, sources.path, sources.digest)
    spec, grips = plan.contract(first.sim), grips_report(first.pool.sources)
    while (successes := attempts.successes(entries)) < plan.episodes:
        if entries:
            progress(f"{successes} of {plan.episodes} after {len(entries)} attempts")
        if len(entries) >= _HUNDRED and successes < _HOPELESS * len(entries):
            failed = next(a.path for a, e in zip(made, entries, strict=True) if not attempts.is_success(e))
            raise TaccorlError(
                f"{plan.task}: {successes} of {len(entries)} attempts succeeded, nothing was written to {out}. Failures: "
                f"{attempts.outcomes(entries)}. To view one: taccorl view {shlex.quote(str(failed))}"
            )
        done = attempts.run_attempts(
            functools.partial(run_attempt, plan, sources, store),
            _next_numbers(plan, entries),
            engine or LocalEngine(),
            said=lambda entry: f"{entry['outcome']} after {entry['seconds']:.1f} s",
            progress=progress,
        )
        for artefact, entry in done:
            made.append(artefact)
            entries.append(entry)
            if attempts.successes(entries) == plan.episodes:
                break
    kept = [a for a, e in zip(made, entries, strict=True) if attempts.is_success(e)]
    report = _report(plan, entries) | {"grips": grips}
    config = {"task": plan.task, "spec": plan.spec.digest, "attempts": len(entries)}
    config |= {"stratify": True} if plan.stratify else {}

    def write(_: Any, inputs: list[Path], folder: Path) -> None:
        if plan.rows == "dataset":
            attempts.assemble(spec, report, inputs, folder)
        else:
            common = plan.config(0) | {"sources": sources.digest}
            write_stored(
                folder, common, dataclasses.asdict(plan.spec), report, [demonstration_of(path) for path in inputs]
            )

    store.run(plan.stage.bound(write), config, kept, destination=out)
    return report


def _next_numbers(plan: AugmentPlan, entries: list[dict[str, Any]]) -> list[int]:
    """Numbers of the attempts to make next, ascending; follows from the ``entries`` of the rounds before alone."""
    if plan.stratify:
        done = [(entry["attempt"], attempts.is_success(entry)) for entry in entries]
        return next_round(plan.space, lambda k: plan.space.boxes(plan.draw(k)), plan.episodes, done)
    # Never fewer than are missing, so none of them is in vain but for the few at the end.
    num = min(max(plan.episodes - attempts.successes(entries), min(_ROUND, plan.episodes // 10)), _HUNDRED)
    return list(range(len(entries), len(entries) + num))


def check_out(plan: AugmentPlan, source: Path, out: Path, store: Store) -> None:
    """Fail early if ``out`` is occupied by something other than a dataset of this plan.

    Raises:
        InTheWayError: something else is at ``out``; the message states what.
    """
    attempts.check_destination(
        out, plan.stage, plan.task, lambda manifest: _may_be_of(plan, manifest, store.source(source), out, store)
    )


def _may_be_of(plan: AugmentPlan, manifest: dict[str, Any], sources: Artefact, out: Path, store: Store) -> bool:
    """Whether what is at ``out`` is made of attempts of this very plan, and of as many successes."""
    path = out / (PROVENANCE / attempts.REPORT if plan.rows == "dataset" else META)
    if not path.is_file():
        return False
    told = json.loads(path.read_text(encoding="utf-8"))
    told = told if plan.rows == "dataset" else told["report"]
    if told["episodes"] != plan.episodes or ("stratify" in told) != plan.stratify:
        return False
    stage = _ROWS if plan.rows == "dataset" else _ATTEMPT
    return {entry["key"] for entry in manifest["inputs"]} <= {
        store.key(stage, plan.config(e["attempt"]), [sources]) for e in told["entries"]
    }


def made_attempts(plan: AugmentPlan, source: Path, store: Store, num: int) -> list[Made]:
    """Read the plan's first ``num`` attempts from the store, in their order, without making any.

    Raises:
        TaccorlError: one of them is missing, or fewer attempts give all successes of the plan.
    """
    sources, found, entries = store.source(source), [], []
    while len(found) < num:
        numbers = _next_numbers(plan, entries)[: num - len(found)]
        if not numbers:
            raise TaccorlError(
                f"{num} attempts are requested, but {plan.episodes} successes were reached after {len(found)}; for more "
                "attempts, give more --episodes"
            )
        for k in numbers:
            attempt = store.find(_ATTEMPT, plan.config(k), [sources])
            if attempt is None:
                raise TaccorlError(f"{store.root}: attempt {k} is missing; run taccorl augment again to make it again")
            # As in run_attempt: rows count only where the attempt is a success, whatever rows an attempt before it left.
            wanted = plan.rows == "dataset" and attempts.is_success(attempts.read_entry(attempt.path))
            rows = store.find(_ROWS, plan.config(k), [sources]) if wanted else None
            parts = [attempt.path, *([rows.path] if rows else [])]
            entry = attempts.read_entry(parts[-1])
            found.append(Made(attempt.path, entry, sum(read_manifest(part)["seconds"] for part in parts)))
            entries.append(entry)
    return found


def run_attempt(plan: AugmentPlan, sources: Artefact, store: Store, k: int, end: Failed | None = None) -> Artefact:
    """Make attempt ``k``, unless it is in the store: entry.json, actions.npy, and intended.npy if it is disturbed. For a success
    whose rows the plan requires: also an artefact with entry.json, dataset/, episodes.json.

    Args:
        end: the way its process ended, if it died or was stopped; it is then the outcome.
    """
    lost = end and Attempted(k, plan.scene_seed(k), end.process, end.reason)

    def build(config: Any, inputs: list[Path], folder: Path) -> None:
        _write(lost or _run(plan, sources, k), folder)

    attempt = store.run(_ATTEMPT.bound(build), plan.config(k), [sources])
    if plan.rows == "actions" or not attempts.is_success(attempts.read_entry(attempt.path)):
        return attempt

    def build_rows(config: Any, inputs: list[Path], folder: Path) -> None:
        if lost:
            _dump_entry(_entry_of(lost), folder)
        else:
            _build_rows(plan, sources, attempt.path, config, folder)

    # A function of the sources alone, as the attempt is: its key is known where the attempt is gone.
    return store.run(_ROWS.bound(build_rows), plan.config(k), [sources])


def demonstration_of(folder: Path) -> Demonstration:
    """Read a stored attempt as a demonstration."""
    entry, intended = attempts.read_entry(folder), folder / "intended.npy"
    return Demonstration(
        attempt=entry["attempt"],
        scene_seed=entry["scene_seed"],
        actions=np.load(folder / "actions.npy"),
        intended=np.load(intended) if intended.is_file() else None,
        last_state=entry["last_state"],
        provenance=entry["provenance"],
    )


def is_attempt(folder: Path) -> bool:
    """Whether a folder was written by ``run_attempt``."""
    manifest = read_manifest(folder) if folder.is_dir() else None
    return bool(manifest) and manifest["stage"] == _ATTEMPT.name


def attempt_episode(folder: Path) -> Episode:
    """Execute an attempt, usually a failed one, again from its stored actions and scene seed, with touch, and return it as an
    episode.

    Raises:
        TaccorlError: the attempt ended before its first action.
    """
    config, entry, stored = _config(folder), attempts.read_entry(folder), demonstration_of(folder)
    if not len(stored.actions):
        raise TaccorlError(
            f"{folder}: attempt {entry['attempt']} has no actions to show; its outcome is {entry['outcome']}: "
            f"{entry['reason']}"
        )
    sim = make_simulation(config)
    spec = row_spec(sim, pictures=config["images"], executed=stored.intended is not None)
    recorder = execute(sim, stored, spec, GatesSpec(**config["spec"]["gates"])).recorder
    told = {key: value for key, value in config.items() if key != "spec"} | {"mimicgen": entry["provenance"]}
    ended = f"{entry['outcome']}: {entry['reason']}" if entry["reason"] else entry["outcome"]
    episode = recorder.episode(f"{config['task']} attempt {entry['attempt']}, {ended}", told)
    return dataclasses.replace(episode, success=entry["outcome"] == "success")


def _config(folder: Path) -> dict[str, Any]:
    """Of an attempt, as ``AugmentPlan.config`` gave it."""
    manifest = read_manifest(folder)
    assert manifest is not None, folder
    return manifest["config"]


_ATTEMPT = Stage("mimicgen", version=VERSION)
_ROWS = Stage("mimicgen_rows", version=ROWS_VERSION)
_AUGMENTED = Stage("augmented", version=AUGMENTED_VERSION, manifest=attempts.DATASET_MANIFEST)
_ACTIONS = Stage("actions", version=ACTIONS_VERSION)


def _run(plan: AugmentPlan, sources: Artefact, k: int) -> Attempted:
    try:
        return _attempts(plan, sources.path, sources.digest).run(k)
    except Exception as error:  # one attempt must not end a run of hundreds; it is counted, with where it broke
        return Attempted(k, -1, "error", _where(error))


def _build_rows(plan: AugmentPlan, sources: Artefact, attempt: Path, config: dict[str, Any], folder: Path) -> None:
    """Of a success."""
    sim = _attempts(plan, sources.path, sources.digest).sim
    stored, entry = demonstration_of(attempt), attempts.read_entry(attempt)
    try:
        done = execute(sim, stored, plan.contract(sim), plan.spec.gates)
        entry |= {"outcome": done.outcome, "reason": done.reason}
    except Exception as error:
        done, entry = None, entry | {"outcome": "error", "reason": _where(error)}
    if done and done.outcome == "success":
        told = {key: value for key, value in config.items() if key != "spec"} | {"sources": sources.digest}
        write_execution(done, stored, told, folder)
    _dump_entry(entry, folder)


def write_execution(done: Execution, stored: Demonstration, told: dict[str, Any], folder: Path) -> None:
    """Write the rows of an execution as dataset/ with one episode, and its record episodes.json."""
    from taccorl.data.lerobot_format import write_episodes

    made = stored.provenance if done.is_same else stored.provenance | {DIFFERS: True}
    episode = done.recorder.episode(f"{told['task']} attempt {stored.attempt}", told | {MIMICGEN: made})
    write_episodes([episode], folder / "dataset")
    (folder / "episodes.json").write_text(json.dumps([episode_record(episode, told["sources"])]), encoding="utf-8")


def _where(error: Exception) -> str:
    """An error and the line that raised it."""
    where = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__}: {error} ({Path(where.filename).name}:{where.lineno})"


def _write(done: Attempted, folder: Path) -> None:
    """What every attempt leaves."""
    np.save(folder / "actions.npy", done.actions)
    if done.intended is not None:
        np.save(folder / "intended.npy", done.intended)
    _dump_entry(_entry_of(done), folder)


def _entry_of(done: Attempted) -> dict[str, Any]:
    rows = len(done.actions)
    entry = {"attempt": done.k, "outcome": done.outcome, "rows": rows, "seconds": rows / CONTROL_HZ}
    entry |= {"reason": done.reason, "scene_seed": done.scene_seed, "last_state": done.last_state}
    return entry | {"provenance": done.provenance}


def _dump_entry(entry: dict[str, Any], folder: Path) -> None:
    (folder / "entry.json").write_text(json.dumps(entry, indent=1, ensure_ascii=False), encoding="utf-8")


def _attempts(plan: AugmentPlan, path: Path, digest: str) -> Attempts:
    """Sources and model, made once in a process."""

    def make() -> Attempts:
        sim = plan.make()
        return Attempts(SourcePool(plan.spec, read_sources(path, plan.spec)), sim, plan.seed)

    return attempts.made_once(["augment", plan.config(0), digest], make)


def _report(plan: AugmentPlan, entries: list[dict[str, Any]]) -> dict[str, Any]:
    report = {
        "task": plan.task,
        **plan.origin.record(),
        "attempts": len(entries),
        "outcomes": attempts.outcomes(entries),
        "episodes": attempts.successes(entries),
        "rows": sum(e["rows"] for e in entries if attempts.is_success(e)),
        "entries": [{k: v for k, v in e.items() if k not in ("provenance", "last_state")} for e in entries],
    }
    if plan.stratify:
        first = entries[: first_attempts(plan.episodes)]
        report["stratify"] = {
            "first_attempts": len(first),
            "first_successes": attempts.successes(first),
            "passed_over": entries[-1]["attempt"] + 1 - len(entries),
        }
    return report

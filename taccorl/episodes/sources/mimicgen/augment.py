"""Plan that generates demonstrations from source demonstrations (MimicGen) until N attempts have succeeded.

Attempts are numbered, and the successes with the lowest numbers are written. An attempt stores its actions; the rows of a
success, with touch and pictures, are an artefact of their own.
"""

import dataclasses
import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from taccorl.data.episode import Episode
from taccorl.episodes.attempt import Attempt, Entry, read_json
from taccorl.episodes.plan import Made, Plan, Step
from taccorl.episodes.recorder import row_spec, told_origin
from taccorl.episodes.sources.mimicgen.attempt import Attempts, attempt_seeds
from taccorl.episodes.sources.mimicgen.from_dataset import make_simulation, read_sources
from taccorl.episodes.sources.mimicgen.grips import grips_report
from taccorl.episodes.sources.mimicgen.source import SourcePool
from taccorl.episodes.sources.mimicgen.spec import GatesSpec, MimicSpec, check_task
from taccorl.episodes.sources.mimicgen.stored import Demonstration, execute
from taccorl.errors import TaccorlError
from taccorl.lineage.canonical import canonical
from taccorl.lineage.manifest import DATASET_MANIFEST, read_manifest
from taccorl.lineage.processes import Failed
from taccorl.lineage.stage import Artefact, Stage
from taccorl.robots import ROBOT
from taccorl.sim.simulation import Simulation
from taccorl.sim.twin import CONTROL_HZ

_ATTEMPT = Stage("mimicgen", version=5)
_ROWS = Stage("mimicgen_rows", version=3)


@dataclass(frozen=True, kw_only=True)
class AugmentPlan(Plan):
    """Settings of a generation: spec (which states the task), sources, number of episodes, twin, seed."""

    task: str = field(init=False)
    spec: MimicSpec
    sources: Artefact | None = None
    """Dataset of the sources (``Store.dataset``)."""
    episodes: int = 200
    """Number of successful episodes to generate, in the plan's twin, which may differ from that of the sources."""

    dataset: ClassVar[Stage] = Stage("augmented", version=4, manifest=DATASET_MANIFEST)
    many: ClassVar[int] = 100
    least: ClassVar[float] = 0.05
    counts_errors: ClassVar[bool] = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "task", self.spec.task)
        super().__post_init__()

    def scene_seed(self, k: int) -> int:
        return attempt_seeds(self.seed, self.task, k)[0]

    def make(self) -> Simulation:
        """Make the simulation of this plan, whose task the spec must fit."""
        sim = super().make()
        check_task(self.spec, sim.task)
        return sim

    @property
    def executes(self) -> bool:
        return self.spec.datagen_config.has_intended

    def actor(self, sim: Simulation) -> Attempts:
        (sources,) = self.inputs(0)
        return Attempts(
            SourcePool(self.spec, read_sources(sources.path, self.spec)), sim, self.seed
        )

    def actor_config(self) -> Any:
        return [self.config(0), self.inputs(0)[0].digest]

    def advice(self, failed: Made) -> str:
        return f"nothing was written. To view one: taccorl view {shlex.quote(str(failed.artefact.path))}"

    def config(self, item: int) -> dict[str, Any]:
        own = {
            "spec": dataclasses.asdict(self.spec),
            "images": self.images,
            "videos": self.stored_as == "video",
        }
        own |= {"part_poses": self.part_poses, **told_origin(self.origin)}
        return canonical(self.scene | own | {"root_seed": self.seed, "attempt": item})

    def inputs(self, item: int) -> list[Artefact]:
        if self.sources is None:
            raise TaccorlError(
                f"mimicgen of {self.task}: no sources; give a dataset of demonstrations"
            )
        return [self.sources]

    @property
    def steps(self) -> tuple[Step, ...]:
        # Rows are a function of the sources alone, as the attempt is: their key is known where the attempt is gone.
        return (Step(_ATTEMPT, self._physics), Step(_ROWS, self._rows))

    def _physics(
        self, item: int, config: dict[str, Any], inputs: list[Path]
    ) -> Attempt:
        done = self.opened().actor.run(item)
        arrays = {"actions": done.actions} | (
            {} if done.intended is None else {"intended": done.intended}
        )
        facts = {"last_state": done.last_state, "provenance": done.provenance}
        return Attempt(
            outcome=done.outcome, reason=done.reason, arrays=arrays, facts=facts
        )

    def _rows(self, item: int, config: dict[str, Any], inputs: list[Path]) -> Attempt:
        (sources,), (sim, spec, _), folder = (
            self.inputs(item),
            self.opened(),
            inputs[-1],
        )
        done, before = (
            execute(sim, demonstration_of(folder), spec, self.spec.gates),
            read_json(folder / "entry.json"),
        )
        told = _without_spec(config) | {"sources": sources.digest} | done.provenance
        facts = {"last_state": before["last_state"], "provenance": before["provenance"]}
        return dataclasses.replace(
            done, provenance=told, source_digest=sources.digest, facts=facts
        )

    def lost(self, item: int, end: Failed) -> Attempt:
        nothing = np.zeros((0, ROBOT.num_actions), np.float32)
        return dataclasses.replace(super().lost(item, end), arrays={"actions": nothing})

    def entry(self, item: int, done: Attempt) -> Entry:
        rows = len(done.arrays.get("actions", ())) or done.rows
        entry = {
            "attempt": item,
            "outcome": done.outcome,
            "rows": rows,
            "seconds": rows / CONTROL_HZ,
        }
        entry |= {
            "reason": done.reason,
            "scene_seed": self.scene_seed(item),
            "last_state": "",
            "provenance": {},
        }
        return entry | done.facts

    def dataset_config(self, entries: Sequence[Entry] | None) -> dict[str, Any]:
        own = (
            super().dataset_config(entries)
            | {"spec": self.spec.digest}
            | self.kept_pictures
        )
        return own | ({} if entries is None else {"attempts": len(entries)})

    def report(self, entries: Sequence[Entry]) -> dict[str, Any]:
        report = super().report(entries)
        report["entries"] = [
            {k: v for k, v in e.items() if k not in ("provenance", "last_state")}
            for e in entries
        ]
        return report | {"grips": grips_report(self.opened().actor.pool.sources)}


def demonstration_of(folder: Path) -> Demonstration:
    entry, intended = read_json(folder / "entry.json"), folder / "intended.npy"
    return Demonstration(
        actions=np.load(folder / "actions.npy"),
        intended=np.load(intended) if intended.is_file() else None,
        **{
            key: entry[key]
            for key in ("attempt", "scene_seed", "last_state", "provenance")
        },
    )


def is_attempt(folder: Path) -> bool:
    """Whether a folder is an attempt of a generation."""
    manifest = read_manifest(folder) if folder.is_dir() else None
    return bool(manifest) and manifest["stage"] == _ATTEMPT.name


def attempt_episode(folder: Path) -> Episode:
    """Execute an attempt, usually a failed one, again from its stored actions and scene seed, with touch, and return it as an
    episode. Raises TaccorlError: the attempt ended before its first action."""
    config, entry = read_manifest(folder)["config"], read_json(folder / "entry.json")
    if not entry["rows"]:
        raise TaccorlError(
            f"{folder}: has no actions to show; its outcome is {entry['outcome']}: {entry['reason']}"
        )
    sim, stored = make_simulation(config), demonstration_of(folder)
    spec = row_spec(
        sim, pictures=config["images"], executed=stored.intended is not None
    )
    recorder = execute(sim, stored, spec, GatesSpec(**config["spec"]["gates"])).recorder
    assert recorder is not None
    ended = (
        f"{entry['outcome']}: {entry['reason']}"
        if entry["reason"]
        else entry["outcome"]
    )
    told = _without_spec(config) | {"mimicgen": entry["provenance"]}
    episode = recorder.episode(
        f"{config['task']} attempt {entry['attempt']}, {ended}", told
    )
    return dataclasses.replace(episode, success=entry["outcome"] == "success")


def _without_spec(config: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in config.items() if key != "spec"}

"""Collect demonstrations of a source (expert, person, action files) in the twin into a LeRobot dataset, or into recordings in the
format of the robot's drivers. Every attempt is a function of the plan and its own seed.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from taccorl.data.finding import listed
from taccorl.data.origin import Origin
from taccorl.data.spec import DatasetSpec
from taccorl.episodes.attempt import Attempt, Entry, Source, act
from taccorl.episodes.plan import Made, Needed, Plan, Step, seed_of
from taccorl.episodes.produce import Progress, in_order, said
from taccorl.episodes.recorder import EpisodeRecorder, row_spec, told_origin
from taccorl.episodes.sources.expert import ExpertSource
from taccorl.errors import TaccorlError
from taccorl.lineage.canonical import canonical
from taccorl.lineage.destinations import is_free
from taccorl.lineage.manifest import DATASET_MANIFEST
from taccorl.lineage.stage import Artefact, Stage
from taccorl.sim.simulation import Simulation
from taccorl.sim.twin import CONTROL_HZ
from taccorl.surrogate.twin_recording import write_twin_mcap

_DEMONSTRATION = Stage("demonstration", version=4)


@dataclass(frozen=True, kw_only=True)
class CollectPlan(Plan):
    """Settings of a collection: task, number of successful episodes, source, twin."""

    source: Source = field(default_factory=ExpertSource)
    keep_failures: bool = False
    """True: failed attempts are written as episodes, too, with success = false."""

    dataset: ClassVar[Stage] = Stage("collection", version=3, manifest=DATASET_MANIFEST)

    @property
    def repeatable(self) -> bool:
        return self.source.repeatable

    def attempt_seed(self, k: int) -> int:
        return seed_of(self.seed, self.task, k)

    def advice(self, failed: Made) -> str:
        return f"nothing was written. To view a failure: taccorl collect --task={self.task} --keep_failures=true"

    def config(self, item: int) -> dict[str, Any]:
        source = {
            "type": self.source.get_choice_name(type(self.source)),
            **dataclasses.asdict(self.source),
        }
        own = {
            "source": source,
            "seed": self.attempt_seed(item),
            "videos": self.stored_as == "video",
        }
        own |= {"part_poses": self.part_poses, "keep_failures": self.keep_failures}
        return canonical(self.scene | own | told_origin(self.origin))

    @property
    def steps(self) -> tuple[Step, ...]:
        return (Step(_DEMONSTRATION, self._attempt),)

    def _attempt(
        self, item: int, config: dict[str, Any], inputs: list[Path]
    ) -> Attempt:
        sim, spec, _ = self.opened()
        return dataclasses.replace(attempt(self, sim, spec, item), provenance=config)

    def entry(self, item: int, done: Attempt) -> Entry:
        kept = done.outcome == "success" or (self.keep_failures and done.rows > 0)
        entry = {
            "attempt": item,
            "seed": self.attempt_seed(item),
            "outcome": done.outcome,
            "kept": kept,
        }
        entry |= {"rows": done.rows, "seconds": done.rows / CONTROL_HZ}
        return entry | ({"reason": done.reason} if done.reason else {})

    def keeps(self, entry: Entry) -> bool:
        return entry["kept"]

    def dataset_config(self, entries: Sequence[Entry] | None) -> dict[str, Any]:
        seeds = (
            {}
            if entries is None
            else {"attempts": [e["seed"] for e in entries if e["kept"]]}
        )
        return (
            super().dataset_config(entries)
            | seeds
            | {"twin": self.scene["twin"]}
            | self.kept_pictures
        )

    def items_of(self, report: dict[str, Any]) -> Sequence[int] | None:
        return (
            range(report["attempts"])
            if report["outcomes"].get("success", 0) == self.episodes
            else None
        )


def attempt(
    plan: CollectPlan,
    sim: Simulation,
    spec: DatasetSpec,
    k: int,
    *,
    dense: bool = False,
) -> Attempt:
    """Run attempt ``k`` up to success, failure, the time limit, or the end of the demonstrator's actions. ``dense``: also keep a
    trajectory at 200 Hz.
    """
    seed = plan.attempt_seed(k)
    sim.reset([seed])
    recorder = EpisodeRecorder(sim, spec, np.random.default_rng([seed, 2]), dense=dense)
    outcome, reason = act(
        sim, plan.source.actions(sim, np.random.default_rng([seed, 1])), recorder
    )
    return Attempt(
        outcome=outcome,
        reason=reason,
        name=f"{plan.task} seed {seed}",
        recorder=recorder,
    )


def collect_recordings(
    plan: CollectPlan, out: Path, progress: Progress = print
) -> list[Path]:
    """Collect ``plan.episodes`` successes as MCAP files ``out/TASK_000.mcap`` … in the format of the robot's drivers; returns
    their paths. Failures, if they are kept, get numbers of the same sequence, but do not count. Raises TaccorlError: ``out`` is
    not empty, or three of four attempts of an expert fail."""
    if not is_free(out):
        parts = listed(sorted(path.name for path in out.glob("*.part")))
        stopped = (
            f", {parts} of a run that was stopped: unfinished, it may be deleted"
            if parts
            else ""
        )
        raise TaccorlError(
            f"{out} holds files already{stopped}; nothing was changed: give another folder"
        )
    sim = plan.make()
    spec = row_spec(sim, pictures=False, executed=True)
    origin = Origin(
        "surrogate", f"recording of the {plan.origin.text}"
    )  # it stands for a robot's
    needed, written = (
        Needed(plan, advice=lambda _: f"the recordings made so far are in {out}"),
        list[Path](),
    )

    def record(k: int) -> Entry:
        done = attempt(plan, sim, spec, k, dense=True)
        entry = plan.entry(k, done)
        if plan.keeps(entry) and done.recorder is not None:
            path = out / f"{plan.task}_{len(written):03d}.mcap"
            part, success = path.with_suffix(".part"), done.outcome == "success"
            write_twin_mcap(
                part, sim, done.recorder.trajectory(), success=success, origin=origin
            )
            written.append(part.replace(path))
        return entry

    def on_done(k: int, entry: Entry) -> range:
        progress(f"attempt {k}: {said(entry)} ({len(written)} recordings)")
        return needed.after(k, Made(Artefact(out, ""), entry))

    in_order(record, needed.first(), on_done)
    return written

"""``taccorl augment --source=outputs/assembly_2 --task=assembly_2 [--episodes=200] [--out=outputs/assembly_2_augmented]``

Generate a LeRobot dataset of many new, successful demonstrations with touch and pictures from a few demonstrations in the twin
(``taccorl collect``): MimicGen for two hands, which keeps the path of held objects. Yield, failures by cause, with a command that
shows one of each, and different grips of the sources are printed at the end. The dataset is the same for any number of workers:
--engine.workers=2, --engine.type=ray. An attempt that kills its process twice, or does not end within ten
minutes, counts as failed. With --engine.workers=1 attempts run in the command's own process, which such an attempt would end.

With --pictures=cache no video is encoded: frames are rendered into the cache from which lerobot-train --dataset.cache=… reads
them, at the policy's --resolution.
"""

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from taccorl.cli.parse import verb
from taccorl.cli.produced import (
    OriginOptions,
    PictureOptions,
    Place,
    SceneOptions,
    own_first,
    settings,
)
from taccorl.errors import TaccorlError

if TYPE_CHECKING:
    from taccorl.episodes.produce import Produced
    from taccorl.episodes.sources.mimicgen.augment import AugmentPlan
    from taccorl.lineage.store import Store


@own_first
@dataclass(kw_only=True)
class AugmentConfig(OriginOptions, PictureOptions, SceneOptions):
    """Generate many demonstrations from a few."""

    source: Path
    """Dataset of successful demonstrations from the twin, of this task."""
    task: str
    """Task of the demonstrations: {tasks}."""
    episodes: int = 200
    """Number of successful demonstrations to generate."""
    out: Path | None = None
    """The dataset's folder; outputs/TASK_augmented if not given. It must be empty or not exist."""
    spec: str | None = None
    """MimicGen settings: a file like mimicgen.yaml of a task's folder; the task's own if not given."""


@verb(AugmentConfig)
def run(config: AugmentConfig) -> int:
    """Generate the demonstrations. Returns the exit status 0."""
    from taccorl.cli.progress import Attempts, is_success
    from taccorl.episodes.produce import produce
    from taccorl.episodes.sources.mimicgen.grips import grips_warning, grips_words
    from taccorl.evaluation.statistics import told_rate
    from taccorl.lineage.store import Store

    plan = _plan(config, Store(config.store))
    place = Place.of(
        config,
        plan,
        config.out or Path("outputs") / f"{config.task}_augmented",
        [config.source],
    )
    store = place.store
    produced = produce(
        plan, place.out, store, Attempts(plan.episodes, is_success), config.engine
    )
    report = produced.report
    lines = [
        f"yield:   {told_rate(report['episodes'], report['attempts'])}",
        *view_commands(plan, produced, store),
    ]
    lines.append(f"sources: {grips_words(report['grips'])}")
    lines += [f"warning: {': '.join(grips_warning(plan.task))}"] * bool(
        report["grips"]["few"]
    )
    place.written(plan, produced, lines)
    print(f"next:    {place.next_command(plan)}")
    return 0


def view_commands(
    plan: "AugmentPlan", produced: "Produced", store: "Store"
) -> list[str]:
    """Lines, one for each cause of failure: the command that opens the first attempt that failed so and has actions."""
    first = {
        each.entry["outcome"]: each
        for each in reversed(produced.made)
        if each.entry["rows"] and not each.success
    }
    lines = []
    for outcome, each in sorted(first.items()):
        k = each.entry["attempt"]
        physics = (
            store.find(plan.steps[0].stage, plan.config(k), plan.inputs(k))
            or each.artefact
        )
        lines.append(
            f"view:    {shlex.join(['taccorl', 'view', str(physics.path)])}  ({outcome}: {each.entry['reason']})"
        )
    return lines


def _plan(config: AugmentConfig, store: "Store") -> "AugmentPlan":
    """What was asked for, if there is such a task, spec and twin, and the sources can be any. Raises TaccorlError: names what
    is not there, with the near name."""
    from taccorl.episodes.sources.mimicgen.augment import AugmentPlan
    from taccorl.episodes.sources.mimicgen.from_dataset import open_sources
    from taccorl.episodes.sources.mimicgen.spec import check_task, load_mimic_spec
    from taccorl.sim.task import tasks

    task = tasks.get(config.task)(config.difficulty)
    spec = load_mimic_spec(config.spec or config.task)
    if spec.task != config.task:
        raise TaccorlError(
            f"--spec={config.spec} is of task {spec.task}, --task={config.task}"
        )
    check_task(spec, task)
    open_sources(config.source, config.task)
    return AugmentPlan(
        **settings(config, AugmentPlan, spec=spec, sources=store.dataset(config.source))
    )

"""``taccorl augment --source=outputs/assembly_2 --task=assembly_2 [--episodes=200] [--out=outputs/assembly_2_augmented]``

Generate a LeRobot dataset of many new, successful demonstrations with touch and pictures from a few demonstrations in the twin
(``taccorl collect``): MimicGen for two hands, which keeps the path of held objects. A report of yield, coverage and failures is
written beside it. The dataset is the same for any number of workers: --engine.workers=2, --engine.type=ray,
--engine.type=slurm. An attempt that kills its process twice, or does not end within ten minutes, counts as failed. With
--engine.workers=1 attempts run in the command's own process, which such an attempt would end.

--rows=actions writes seeds and float32 actions, 24 kB an episode, instead of a dataset: physics only. ``taccorl execute`` makes
the dataset on the machine where it is needed.
"""

import shlex
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from taccorl.cli.parse import verb
from taccorl.cli.produced import OriginOptions, Place, SceneOptions, own_first, settings
from taccorl.errors import TaccorlError
from taccorl.lineage.engines import LocalEngine

if TYPE_CHECKING:
    from taccorl.episodes.sources.mimicgen.augment import AugmentPlan
    from taccorl.lineage.store import Store


@own_first
@dataclass(kw_only=True)
class AugmentConfig(OriginOptions, SceneOptions):
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
    stratify: bool = False
    """After the first half, start attempts in scenes like those with few successes so far; the report shows the effect."""
    rows: str = "dataset"
    """Kind of output. dataset; or actions: only seeds and actions, for taccorl execute."""


@verb(AugmentConfig)
def run(config: AugmentConfig) -> int:
    """Generate the demonstrations. Returns the exit status 0."""
    from taccorl.cli.progress import Attempts, is_success
    from taccorl.episodes.produce import produce
    from taccorl.episodes.sources.mimicgen.coverage import Share, Spent
    from taccorl.episodes.sources.mimicgen.grips import grips_warning, grips_words
    from taccorl.lineage.processes import cpu_s
    from taccorl.lineage.store import Store
    from taccorl.report.augmented import pages_of, write_report

    plan = _plan(config, Store(config.store))
    place = Place.of(config, plan, config.out or Path("outputs") / f"{config.task}_augmented", [config.source])
    out, store = place.out, place.store
    pages_of(out)
    before, began = {path.name for path in store.artefacts()}, Spent(cpu_s(children=True), time.perf_counter())
    produced = produce(plan, out, store, Attempts(plan.episodes, is_success), config.engine)
    report = produced.report
    spent = Spent(cpu_s(children=True) - began.cpu_s, time.perf_counter() - began.wall_s)
    known = isinstance(config.engine, LocalEngine) and before.isdisjoint(m.artefact.path.name for m in produced.made)
    page = write_report(plan, config.source, out, store, produced, spent=spent if known else None)
    share, chosen = Share(successes=report["episodes"], attempts=report["attempts"]), report.get("stratify")
    filled = []
    if chosen is not None:
        share = Share(successes=chosen["first_successes"], attempts=chosen["first_attempts"])
        filled = [f"filled:  {report['attempts']} attempts in all, {chosen['passed_over']} passed over"]
    lines = [f"yield:   {share}" + ", before any was chosen for its draw" * (chosen is not None), *filled]
    lines.append(f"sources: {grips_words(report['grips'])}")
    lines += [f"warning: {': '.join(grips_warning(plan.task))}"] * bool(report["grips"]["few"])
    if known:
        lines.append(
            f"run:     {spent.wall_s / 60:.1f} min, {spent.cpu_s / report['episodes']:.1f} CPU-s for each episode"
        )
    place.written(plan, produced, [*lines, f"report:  {page}"])
    execute = shlex.join(["taccorl", "execute", f"--source={out}", f"--out={out}_dataset"])
    print(f"next:    {place.next_command(plan) if plan.rows == 'dataset' else execute}")
    return 0


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
        raise TaccorlError(f"--spec={config.spec} is of task {spec.task}, --task={config.task}")
    check_task(spec, task)
    open_sources(config.source, config.task)
    return AugmentPlan(**settings(config, AugmentPlan, spec=spec, sources=store.dataset(config.source)))

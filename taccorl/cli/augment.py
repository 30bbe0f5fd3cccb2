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
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from taccorl.cli.card import add_card
from taccorl.cli.output_lock import check_apart, hold
from taccorl.cli.parse import parse, shared_fields
from taccorl.data.origin import TWIN_ORIGIN, Origin
from taccorl.errors import TaccorlError
from taccorl.lineage.engines import Engine, LocalEngine
from taccorl.report.section import Section

if TYPE_CHECKING:
    from taccorl.demos.mimicgen.augment import AugmentPlan


@dataclass(kw_only=True)
class AugmentConfig:
    """Generate many demonstrations from a few."""

    source: Path
    """Dataset of successful demonstrations from the twin, of this task."""
    task: str
    """Task of the demonstrations: {tasks}."""
    episodes: int = 200
    """Number of successful demonstrations to generate."""
    out: Path | None = None
    """The dataset's folder; outputs/TASK_augmented if not given. It must be empty or not exist."""
    store: Path = Path("outputs/store")
    """Folder that keeps finished attempts, so that a second run continues where the first ended."""
    difficulty: str = "train"
    """Clearance on each side of mating parts: easy 1.0 mm, train 0.5 mm, hard 0.3 mm."""
    twin: Path | None = None
    """A twin.yaml; the nominal twin if not given. It may differ from the twin of the source demonstrations."""
    spec: str | None = None
    """MimicGen settings: a file like mimicgen.yaml of a task's folder; the task's own if not given."""
    images: bool = True
    """Render the three cameras (needs OpenGL)."""
    seed: int = 0
    """Seed of all attempts, at least 0; another seed gives other scenes."""
    stratify: bool = False
    """After the first half, start attempts in scenes like those with few successes so far; the report shows the effect."""
    rows: str = "dataset"
    """Kind of output. dataset; or actions: only seeds and actions, for taccorl execute."""
    domain: Literal["twin", "surrogate"] = "twin"
    """Domain of all outputs; ``surrogate``: the twin stands in for the robot."""
    origin: str = TWIN_ORIGIN.text
    """Description of the origin in all outputs."""
    engine: Engine = field(default_factory=LocalEngine)
    """Where attempts run: --engine.type=local --engine.workers=2, slurm, ray."""


def main(argv: list[str]) -> int:
    """Run ``taccorl augment`` with the words ``argv`` after it; returns the exit status of ``run``."""
    return run(parse(AugmentConfig, argv, positional=None))


def run(config: AugmentConfig) -> int:
    """Generate the demonstrations. Returns the exit status 0."""
    from taccorl.cli.progress import Attempts, is_success
    from taccorl.demos.mimicgen.augment import augment, check_out, made_attempts
    from taccorl.demos.mimicgen.coverage import Share
    from taccorl.demos.mimicgen.grips import grips_warning, grips_words
    from taccorl.demos.mimicgen.report import Spent
    from taccorl.lineage.processes import cpu_s
    from taccorl.lineage.store import Store
    from taccorl.report.augmented import pages_of, write_report
    from taccorl.report.terminal import show

    plan = _plan(config)
    out = config.out or Path("outputs") / f"{config.task}_augmented"
    hold(out)
    check_apart(out, (("--source", config.source), ("--store", config.store)))
    pages_of(out)
    store = Store(config.store)
    check_out(plan, config.source, out, store)
    before, began = {path.name for path in store.artefacts()}, Spent(cpu_s(children=True), time.perf_counter())
    report = augment(plan, config.source, out, store, config.engine, Attempts(plan.episodes, is_success))
    spent = Spent(cpu_s(children=True) - began.cpu_s, time.perf_counter() - began.wall_s)
    used = [made.folder for made in made_attempts(plan, config.source, store, report["attempts"])]
    known = isinstance(config.engine, LocalEngine) and not any(folder.name in before for folder in used)
    grips = report["grips"]
    page = write_report(plan, config.source, out, store, report["attempts"], grips, spent=spent if known else None)
    share = Share(successes=report["episodes"], attempts=report["attempts"])
    said = f"({report['episodes']} episodes, {report['rows']} rows): {report['domain']}: {report['origin']}"
    lines = [f"{config.rows + ':':8s} {out}  {said}"]
    if (chosen := report.get("stratify")) is not None:
        share = Share(successes=chosen["first_successes"], attempts=chosen["first_attempts"])
        lines.append(f"filled:  {report['attempts']} attempts in all, {chosen['passed_over']} passed over")
    lines.insert(1, f"yield:   {share}" + ", before any was chosen for its draw" * (chosen is not None))
    lines.append(f"sources: {grips_words(grips)}")
    lines += [f"warning: {': '.join(grips_warning(plan.task))}"] * bool(grips["few"])
    if known:
        lines.append(
            f"took:    {spent.wall_s / 60:.1f} min, {spent.cpu_s / report['episodes']:.1f} CPU-s for each episode"
        )
    show(Section(text=[*lines, f"report:  {page}"]))
    if plan.rows == "dataset":
        add_card(out)
    execute = shlex.join(["taccorl", "execute", f"--source={out}", f"--out={out}_dataset"])
    view = f"taccorl view {shlex.quote(str(out))} --episode=0"
    show(Section(text=[f"next:    {view if plan.rows == 'dataset' else execute}"]))
    return 0


def _plan(config: AugmentConfig) -> "AugmentPlan":
    """What was asked for, if there is such a task, spec and twin, and the sources can be any.

    Raises:
        TaccorlError: names what is not there, with the near name.
    """
    from taccorl.demos.mimicgen.augment import AugmentPlan
    from taccorl.demos.mimicgen.from_dataset import open_sources
    from taccorl.demos.mimicgen.spec import check_task, load_mimic_spec
    from taccorl.sim.task import tasks

    task = tasks.get(config.task)(config.difficulty)
    spec = load_mimic_spec(config.spec or config.task)
    if spec.task != config.task:
        raise TaccorlError(f"--spec={config.spec} is of task {spec.task}, --task={config.task}")
    check_task(spec, task)
    open_sources(config.source, config.task)
    own = {"spec": spec, "origin": Origin(config.domain, config.origin)}
    plan = AugmentPlan(**shared_fields(config, AugmentPlan) | own)
    plan.twin_config()
    return plan

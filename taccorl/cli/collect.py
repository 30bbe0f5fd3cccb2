"""``taccorl collect --task=assembly_1 [--source.type=expert] [--episodes=20] [--out=outputs/assembly_1]``

Collect demonstrations in the twin into a LeRobot dataset with touch, simulator state, subtasks and success. With
``--as_recording=true`` into MCAP files as the robot's drivers would write them, for ``taccorl ingest``.

A person demonstrates with ``--source.type=keyboard``, ``gamepad`` or ``leader``; actions are stored in ``outputs/teleop``, and
``taccorl collect --source.type=actions --source.path=FILE`` makes the episode from them again.
"""

import shlex
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from taccorl.cli.card import add_card
from taccorl.cli.output_lock import hold
from taccorl.cli.parse import parse
from taccorl.data.origin import TWIN_ORIGIN, Origin
from taccorl.demos import teleop
from taccorl.demos.collect import ExpertSource, Plan, Source, collect, collect_recordings
from taccorl.demos.teleop_actions import ActionsSource
from taccorl.errors import TaccorlError
from taccorl.lineage.engines import Engine, LocalEngine
from taccorl.lineage.store import Store


@dataclass(kw_only=True)
class CollectConfig:
    """Collect demonstrations in the twin."""

    task: str | None = None
    """Task: {tasks}. Files of actions state their own."""
    source: Source = field(default_factory=ExpertSource)
    """Source of the demonstrations: --source.type=expert, keyboard, gamepad, leader, actions."""
    episodes: int = 20
    """Number of successful demonstrations to write."""
    out: Path | None = None
    """Folder of the dataset or the recordings; outputs/TASK if not given. It must be empty or not exist."""
    store: Path = Path("outputs/store")
    """Folder that keeps finished attempts, so that a second run continues where the first ended."""
    difficulty: str = "train"
    """Clearance on each side of mating parts: easy 1.0 mm, train 0.5 mm, hard 0.3 mm."""
    twin: Path | None = None
    """A twin.yaml; the nominal twin if not given."""
    randomization: float = 1.0
    """Factor on the ranges of the task's randomisation at reset, 0 … 1; 0: the nominal scene."""
    images: bool = True
    """Render the three cameras (needs OpenGL)."""
    as_recording: bool = False
    """Write MCAP recordings instead of a dataset."""
    keep_failures: bool = False
    """Also write failed attempts."""
    seed: int = 0
    """Seed of all attempts, at least 0; another seed gives other scenes."""
    domain: Literal["twin", "surrogate"] = "twin"
    """Domain of all outputs; ``surrogate``: the twin stands in for the robot, as recordings always do."""
    origin: str = TWIN_ORIGIN.text
    """Description of the origin in all outputs."""
    engine: Engine = field(default_factory=LocalEngine)
    """Where attempts of a source that is not a person run: --engine.type=local --engine.workers=2, slurm, ray; for datasets."""


def main(argv: list[str]) -> int:
    """Run ``taccorl collect`` with the words ``argv`` after it; returns the exit status of ``run``."""
    return run(parse(CollectConfig, argv, positional=None))


def run(config: CollectConfig) -> int:
    """Collect the demonstrations. Returns the exit status 0."""
    if not config.task and not isinstance(config.source, ActionsSource):
        from taccorl.sim.task import tasks

        raise TaccorlError(f"missing --task=, one of {', '.join(tasks)}; --help says more")
    plan = Plan(
        task=config.task or "",
        episodes=config.episodes,
        source=config.source,
        difficulty=config.difficulty,
        twin=config.twin,
        randomization=config.randomization,
        images=config.images,
        seed=config.seed,
        keep_failures=config.keep_failures,
        origin=Origin(config.domain, config.origin),
    )
    if isinstance(plan.source, ActionsSource):
        plan = plan.source.plan(plan)
    if config.engine != LocalEngine() and (config.as_recording or not plan.source.repeatable):
        why = "--as_recording=true" if config.as_recording else "a person demonstrates"
        raise TaccorlError(f"--engine: with several processes the attempts have no order, and {why}: remove --engine")
    teleop.use_leader_driver(_lerobot_leader)
    from taccorl.cli.tables import Attempts, is_success

    out = config.out or Path("outputs") / plan.task
    hold(out)
    if config.as_recording:
        written = collect_recordings(plan, out, Attempts(plan.episodes, is_success))
        print(f"{len(written)} recordings in {out}: surrogate: of the {plan.origin.text}")
        words = ["taccorl", "ingest", str(out), "--spec=piper_flexitac_mcap", f"--out={out}_dataset"]
        print(f"next: {shlex.join(words)}")
        return 0
    report = collect(plan, out, Store(config.store), Attempts(plan.episodes, is_success), config.engine)
    print(f"{out}: {report['episodes']} episodes, {report['rows']} rows, {report['attempts']} attempts: {plan.origin}")
    add_card(out)
    print(f"next: taccorl view {shlex.quote(str(out))}")
    return 0


def _lerobot_leader(source: teleop.LeaderSource) -> teleop.LeaderDevice:
    from taccorl.lerobot_plugin.leader import (
        open_leader,
    )  # imports LeRobot and torch: only where leader arms are asked for

    return open_leader(source)

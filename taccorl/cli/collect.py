"""``taccorl collect --task=assembly_1 [--source.type=expert] [--episodes=20] [--out=outputs/assembly_1]``

Collect demonstrations in the twin into a LeRobot dataset with touch, simulator state, subtasks and success. With
``--as_recording=true`` into MCAP files as the robot's drivers would write them, for ``taccorl ingest``.

Policies learn from thousands of demonstrations whose grips differ. Their pictures go into the frame cache of training, for every
third row, and the arms are pushed off their path at times:

    taccorl collect --task=assembly_1 --episodes=3500 --source.hands.grasp_m=0.004 --source.hands.grasp_rad=0.06 \\
        --source.hands.pulse_rad=0.02 --pictures=cache --resolution=84x112 --rows_per_picture=3 --part_poses=true \\
        --engine.workers=16 --out=outputs/many

A person demonstrates with ``--source.type=keyboard``, ``gamepad`` or ``leader``; actions are stored in ``outputs/teleop``, and
``taccorl collect --source.type=actions --source.path=FILE`` makes the episode from them again.
"""

import contextlib
import math
import shlex
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from taccorl.cli.card import add_card
from taccorl.cli.execute import render_cache, training_command
from taccorl.cli.output_lock import hold
from taccorl.cli.parse import cached_resolution, cached_rows, parse, shared_fields
from taccorl.data.origin import TWIN_ORIGIN, Origin
from taccorl.demos import teleop
from taccorl.demos.collect import ExpertSource, Plan, Source, collect, collect_recordings
from taccorl.demos.teleop_actions import ActionsSource
from taccorl.errors import TaccorlError
from taccorl.lineage.destinations import is_free
from taccorl.lineage.engines import Engine, LocalEngine
from taccorl.lineage.processes import workers_kept
from taccorl.lineage.store import Store
from taccorl.robots import ROBOT
from taccorl.sim.spaces import IMAGE_SHAPE
from taccorl.sim.twin import CONTROL_HZ

if TYPE_CHECKING:
    from taccorl.training.rendered_frames import DrawnFrames

_NUMBERS_BYTES = 3500  # of a row: touch in 16 bits, joints, actions, poses
_SHARE = 0.7  # of a GPU's memory: training itself takes some 10 GB of 80


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
    pictures: str = "video"
    """How pictures are stored. video; cache: frames that only lerobot-train --dataset.cache can read."""
    rows_per_picture: int | None = None
    """With --pictures=cache: only every k-th row has a picture, and training draws these rows; 3 if not given."""
    resolution: str | None = None
    """Rows x columns of frames in the cache, such as 112x112, equal to --policy.image_resolution; the cameras' own 224x224 if
    not given."""
    part_poses: bool = False
    """Write the poses of the task's parts into every row (observation.environment_state), for
    --policy.part_poses and --policy.pose_loss."""
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
    rows = cached_rows(config.rows_per_picture, config.pictures)
    own = {"task": config.task or "", "rows_per_picture": rows, "origin": Origin(config.domain, config.origin)}
    plan = Plan(**shared_fields(config, Plan) | own)
    if isinstance(plan.source, ActionsSource):
        plan = plan.source.plan(plan)
    if config.engine != LocalEngine() and (config.as_recording or not plan.source.repeatable):
        why = "--as_recording=true" if config.as_recording else "a person demonstrates"
        raise TaccorlError(f"--engine: with several processes the attempts have no order, and {why}: remove --engine")
    teleop.use_leader_driver(_lerobot_leader)
    from taccorl.cli.progress import Attempts, is_success

    out = config.out or Path("outputs") / plan.task
    cached = plan.cached_rows is not None
    resolution = cached_resolution(config.resolution, plan.stored_as)
    if config.as_recording and (cached or plan.part_poses):
        line = "--as_recording=true writes what the robot's drivers record: remove --pictures and --part_poses"
        raise TaccorlError(line)
    hold(out)
    if config.as_recording:
        written = collect_recordings(plan, out, Attempts(plan.episodes, is_success))
        print(f"{len(written)} recordings in {out}: surrogate: of the {plan.origin.text}")
        words = ["taccorl", "ingest", str(out), "--spec=piper_flexitac_mcap", f"--out={out}_dataset"]
        print(f"next: {shlex.join(words)}")
        return 0
    store = Store(config.store)
    if cached:
        print(_memory(plan, resolution))
    with workers_kept(), _drawn(plan, resolution, out, store) as drawn:
        report = collect(plan, out, store, Attempts(plan.episodes, is_success), config.engine, drawn)
        print(
            f"{out}: {report['episodes']} episodes, {report['rows']} rows, {report['attempts']} attempts: {plan.origin}"
        )
        if failed := {outcome: num for outcome, num in report["outcomes"].items() if outcome != "success"}:
            print(f"failed: {', '.join(f'{num} {outcome}' for outcome, num in failed.items())}")
        if cached:
            render_cache(out, resolution, store, config.engine, drawn)
    add_card(out)
    if cached:
        print(f"next: {training_command(out, resolution, config.store)}")
    else:
        print(f"next: taccorl view {shlex.quote(str(out))}")
    return 0


@contextlib.contextmanager
def _drawn(plan: Plan, resolution: tuple[int, int] | None, out: Path, store: Store) -> "Iterator[DrawnFrames | None]":
    """Frames that are drawn while attempts run; None for videos, for a person's demonstrations, and if ``out`` is there."""
    if plan.cached_rows is None or not plan.source.repeatable:
        yield None
        return
    from taccorl.training.frame_cache import FRAMES
    from taccorl.training.rendered_frames import DrawnFrames

    spec = plan.published(plan.make())  # what does not fit is refused before anything is written
    with store.scratch(FRAMES, {"of": str(out.absolute())}) as folder:  # also removes what a killed run has left
        yield DrawnFrames(spec, plan.rows_per_picture, resolution, store, folder) if is_free(out) else None


def _memory(plan: Plan, resolution: tuple[int, int] | None) -> str:
    """Memory that training will take for the frames and numbers of the plan's dataset, at most, and what fits on two GPUs."""
    from taccorl.sim.task import tasks

    rows = tasks.get(plan.task)(plan.difficulty).time_limit_s * CONTROL_HZ
    pixels = math.prod(resolution or IMAGE_SHAPE[:2])
    episode = rows * (_NUMBERS_BYTES + 3 * pixels * len(ROBOT.cameras) / plan.rows_per_picture)
    fits = ", ".join(f"{int(_SHARE * gb * 1e9 / episode)} on a GPU of {gb} GB" for gb in (24, 80))
    return (
        f"memory of training: at most {plan.episodes * episode / 1e9:.1f} GB ({plan.episodes} episodes as long as the time limit "
        f"of {rows / CONTROL_HZ:g} s; experts take about half of it). Episodes of that length that fit beside training: {fits}"
    )


def _lerobot_leader(source: teleop.LeaderSource) -> teleop.LeaderDevice:
    from taccorl.lerobot_plugin.leader import (
        open_leader,
    )  # imports LeRobot and torch: only where leader arms are asked for

    return open_leader(source)

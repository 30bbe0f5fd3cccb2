"""``taccorl collect --task=assembly_1 [--source.type=expert] [--episodes=20] [--out=outputs/assembly_1]``

Collect demonstrations in the twin into a LeRobot dataset with touch, simulator state, subtasks and success. With
``--as_recording=true`` into MCAP files as the robot's drivers would write them, for ``taccorl ingest``.

Policies learn from thousands of demonstrations whose grips differ. Their pictures go into the frame cache of training, for every
third row, and the arms are pushed off their path at times:

    taccorl collect --task=assembly_1 --episodes=3500 --source.hands.grasp_m=0.004 \\
        --source.hands.grasp_rad=0.06 --source.hands.pulse_rad=0.02 --pictures=cache \\
        --resolution=84x112 --rows_per_picture=3 --part_poses=true --engine.workers=16 \\
        --out=outputs/many

A person demonstrates with leader arms, ``--source.type=leader``; actions are stored in ``outputs/teleop``, and the same command
makes the episodes of finished demonstrations again.
"""

import contextlib
import math
import shlex
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from taccorl.cli.output_lock import hold
from taccorl.cli.parse import verb
from taccorl.cli.produced import (
    OriginOptions,
    PictureOptions,
    Place,
    RandomizedOptions,
    own_first,
    settings,
)
from taccorl.episodes.attempt import Source
from taccorl.episodes.produce import produce
from taccorl.episodes.sources import teleop
from taccorl.episodes.sources.collect import CollectPlan, collect_recordings
from taccorl.episodes.sources.expert import ExpertSource
from taccorl.errors import TaccorlError
from taccorl.lineage.destinations import is_free
from taccorl.lineage.engines import LocalEngine
from taccorl.lineage.processes import workers_kept
from taccorl.robots import ROBOT
from taccorl.sim.spaces import IMAGE_SHAPE
from taccorl.sim.twin import CONTROL_HZ

if TYPE_CHECKING:
    from taccorl.training.rendered_frames import DrawnFrames

_NUMBERS_BYTES = 3500  # of a row: touch in 16 bits, joints, actions, poses
_SHARE = 0.7  # of a GPU's memory: training itself takes some 10 GB of 80


@own_first
@dataclass(kw_only=True)
class CollectConfig(OriginOptions, PictureOptions, RandomizedOptions):
    """Collect demonstrations in the twin."""

    task: str | None = None
    """Task: {tasks}."""
    source: Source = field(default_factory=ExpertSource)
    """Source of the demonstrations: --source.type=expert or leader."""
    episodes: int = 20
    """Number of successful demonstrations to write."""
    out: Path | None = None
    """Folder of the dataset or the recordings; outputs/TASK if not given. It must be empty or not exist."""
    as_recording: bool = False
    """Write MCAP recordings instead of a dataset."""
    keep_failures: bool = False
    """Also write failed attempts."""


@verb(CollectConfig)
def run(config: CollectConfig) -> int:
    """Collect the demonstrations. Returns the exit status 0."""
    if not config.task:
        from taccorl.sim.task import tasks

        raise TaccorlError(
            f"missing --task=, one of {', '.join(tasks)}; --help says more"
        )
    plan = CollectPlan(**settings(config, CollectPlan, task=config.task or ""))
    if config.engine != LocalEngine() and (config.as_recording or not plan.repeatable):
        why = "--as_recording=true" if config.as_recording else "a person demonstrates"
        raise TaccorlError(
            f"--engine: with several processes the attempts have no order, and {why}: remove --engine"
        )
    teleop.use_leader_driver(_lerobot_leader)
    from taccorl.cli.progress import Attempts, is_success

    out, progress = (
        config.out or Path("outputs") / plan.task,
        Attempts(plan.episodes, is_success),
    )
    if config.as_recording:
        if plan.cached_rows is not None or plan.part_poses:
            raise TaccorlError(
                "--as_recording=true writes what the robot's drivers record: remove --pictures and --part_poses"
            )
        hold(out)
        written = collect_recordings(plan, out, progress)
        print(
            f"{len(written)} recordings in {out}: surrogate: of the {plan.origin.text}"
        )
        words = [
            "taccorl",
            "ingest",
            str(out),
            "--spec=piper_flexitac_mcap",
            f"--out={out}_dataset",
        ]
        print(f"next: {shlex.join(words)}")
        return 0
    place = Place.of(config, plan, out)
    if plan.cached_rows is not None:
        print(_memory(plan, place.resolution))
    with workers_kept(), _drawn(plan, place) as drawn:
        produced = produce(plan, out, place.store, progress, config.engine, drawn)
        place.written(plan, produced, drawn=drawn)
    print(f"next:    {place.next_command(plan)}")
    return 0


@contextlib.contextmanager
def _drawn(plan: CollectPlan, place: Place) -> "Iterator[DrawnFrames | None]":
    """Frames that are drawn while attempts run; None for videos, for a person's demonstrations, and if the dataset is there."""
    if plan.cached_rows is None or not plan.repeatable:
        yield None
        return
    from taccorl.training.frame_cache import FRAMES
    from taccorl.training.rendered_frames import DrawnFrames

    spec = plan.published(
        plan.make()
    )  # what does not fit is refused before anything is written
    store, free = place.store, is_free(place.out)
    with store.scratch(
        FRAMES, {"of": str(place.out.absolute())}
    ) as folder:  # also removes what a killed run has left
        yield (
            DrawnFrames(spec, plan.rows_per_picture, place.resolution, store, folder)
            if free
            else None
        )


def _memory(plan: CollectPlan, resolution: tuple[int, int] | None) -> str:
    """Memory that training will take for the frames and numbers of the plan's dataset, at most, and what fits on two GPUs."""
    from taccorl.sim.task import tasks

    rows = tasks.get(plan.task)(plan.difficulty).time_limit_s * CONTROL_HZ
    pixels = math.prod(resolution or IMAGE_SHAPE[:2])
    episode = rows * (
        _NUMBERS_BYTES + 3 * pixels * len(ROBOT.cameras) / plan.rows_per_picture
    )
    fits = ", ".join(
        f"{int(_SHARE * gb * 1e9 / episode)} on a GPU of {gb} GB" for gb in (24, 80)
    )
    return (
        f"memory of training: at most {plan.episodes * episode / 1e9:.1f} GB ({plan.episodes} episodes as long as the time limit "
        f"of {rows / CONTROL_HZ:g} s; experts take about half of it). Episodes of that length that fit beside training: {fits}"
    )


def _lerobot_leader(source: teleop.LeaderSource) -> Any:
    from taccorl.lerobot_plugin.leader import open_leader  # imports LeRobot and torch

    return open_leader(source)

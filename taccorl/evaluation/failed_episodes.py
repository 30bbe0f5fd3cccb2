"""Failed episodes, executed again from their actions: pictures at a few instants, and an ``Episode`` for Rerun."""

import contextlib
import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader

from taccorl.data.episode import Episode
from taccorl.data.origin import TWIN_ORIGIN, Origin
from taccorl.episodes.recorder import EpisodeRecorder, row_spec
from taccorl.errors import TaccorlError
from taccorl.evaluation.evaluate import Scenes
from taccorl.evaluation.rollouts import Rollout
from taccorl.robots import ROBOT
from taccorl.sim.simulation import Simulation
from taccorl.sim.task import tasks
from taccorl.surrogate.drivers import CAMERA_TOPICS

NUM_INSTANTS = 6
"""Number of instants of an episode that are shown."""
JPEG_BEGIN = b"\xff\xd8"


@dataclass(frozen=True)
class FailedEpisode:
    """One failed episode, executed again: its rows for Rerun, and pictures at a few instants."""

    rollout: Rollout
    """Result of the episode when it was first run."""
    episode: Episode | None
    """All rows of the episode, simulated again for Rerun; None for a trial on a robot, whose recording is shown instead."""
    pictures: np.ndarray | None
    """(cameras × rows, instants × columns, 3) uint8: one row of pictures per camera, instants from first to last; None: not
    rendered."""
    instants_s: tuple[float, ...]
    """Episode times of the columns of pictures [s]."""


def choose_failures(rollouts: Sequence[Rollout], num: int) -> list[Rollout]:
    """Return at most ``num`` failures with at least one action: one of each pair (task, category) in turn, in the order of the
    rows."""
    by_category: dict[tuple[str, str], list[Rollout]] = {}
    for rollout in rollouts:
        if not rollout.row.success and rollout.row.steps:
            by_category.setdefault((rollout.row.task, rollout.row.outcome), []).append(
                rollout
            )
    chosen: list[Rollout] = []
    for turn in range(max((len(those) for those in by_category.values()), default=0)):
        chosen += [those[turn] for those in by_category.values() if turn < len(those)]
    return chosen[:num]


def execute_again(scenes: Scenes, rollout: Rollout, *, images: bool) -> FailedEpisode:
    """Run a failed episode again: the same scene, actions and touch, bit for bit. Raises TaccorlError: the outcome differs from
    that of the row, so that the scenes are not those of the rollout."""
    row = rollout.row
    sim = Simulation(
        tasks.get(row.task)(scenes.difficulty),
        scenes.twin_config(),
        scale=scenes.randomization,
    )
    if scenes.episode_length is not None:
        sim.judge.limit_steps = scenes.episode_length
    sim.reset([row.seed])
    recorder = EpisodeRecorder(sim, row_spec(sim, pictures=images))
    for action in rollout.actions:
        recorder.sensor_rng = np.random.default_rng(
            (row.seed, len(recorder.rows))
        )  # as the environment's pads
        recorder.step(action)
    outcome = sim.judge.outcome
    end = "success" if outcome.success[0] else str(outcome.failure[0])
    if end not in ("", row.outcome) or int(outcome.partial[0]) != row.partial:
        raise TaccorlError(
            f"{row.task} seed {row.seed}: executed again, the episode ends as {end or 'running'} instead of {row.outcome}"
        )
    name = f"{row.task} seed {row.seed}, {row.outcome}{': ' + row.reason if row.reason else ''}"
    simulation = {
        "policy": row.policy,
        "task": row.task,
        "seed": row.seed,
        "twin": str(scenes.twin or "nominal"),
    }
    origin = Origin(TWIN_ORIGIN.domain, f"{TWIN_ORIGIN.text}; actions of {row.policy}")
    episode = dataclasses.replace(recorder.episode(name, simulation), origin=origin)
    instants = np.unique(
        np.linspace(0, len(recorder.rows) - 1, NUM_INSTANTS).round().astype(int)
    )
    pictures = None
    if images:
        columns = [
            np.concatenate([views[camera] for camera in ROBOT.cameras])
            for views in sim.render_states(
                episode.arrays["sim.state"][instants], ROBOT.cameras
            )
        ]
        pictures = np.concatenate(columns, axis=1)
    return FailedEpisode(rollout, episode, pictures, tuple(instants / episode.spec.fps))


def recorded_failures(
    rollouts: Sequence[Rollout], folder: Path
) -> list[tuple[FailedEpisode, Path]]:
    """Failed trials on a robot that have a recording in ``folder``, be it complete or not: pictures from the recording, and the
    path of that file. Trials without a recording are left out."""
    found = []
    for rollout in rollouts:
        path, frames = (
            folder / f"{rollout.row.task}_seed_{rollout.row.seed}.mcap",
            {t: [] for t in CAMERA_TOPICS.values()},
        )
        if not path.is_file():
            continue
        with path.open("rb") as file, contextlib.suppress(McapError):
            for _, channel, message in NonSeekingReader(file).iter_messages(
                list(frames), log_time_order=False
            ):
                frames[channel.topic].append((message.log_time, message.data))
        rows = []
        for stamped in filter(None, frames.values()):
            chosen = [
                stamped[k]
                for k in np.linspace(0, len(stamped) - 1, NUM_INSTANTS)
                .round()
                .astype(int)
            ]
            jpegs = (
                np.frombuffer(data[data.find(JPEG_BEGIN) :], np.uint8)
                for _, data in chosen
            )
            rows.append(
                np.concatenate(
                    [
                        np.asarray(cv2.imdecode(x, cv2.IMREAD_COLOR))[..., ::-1]
                        for x in jpegs
                    ],
                    axis=1,
                )
            )
            times = tuple(1e-9 * (stamp - chosen[0][0]) for stamp, _ in chosen)
        if rows:
            found.append(
                (FailedEpisode(rollout, None, np.concatenate(rows), times), path)
            )
    return found

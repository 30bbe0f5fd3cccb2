"""Failed episodes, executed again from their actions: pictures at a few instants, and an ``Episode`` for Rerun."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from taccorl.data.cutting import open_episodes
from taccorl.data.episode import Episode
from taccorl.data.origin import TWIN_ORIGIN, Origin
from taccorl.episodes.recorder import EpisodeRecorder, row_spec
from taccorl.errors import TaccorlError
from taccorl.evaluation.evaluate import Scenes
from taccorl.evaluation.rollouts import Rollout
from taccorl.robots import ROBOT
from taccorl.sim.simulation import Simulation
from taccorl.sim.task import tasks

NUM_INSTANTS = 6
"""Number of instants of an episode that are shown."""
RECORDED_SPEC = "piper_flexitac_mcap"
"""Spec of the recordings of a robot's trials."""


@dataclass(frozen=True)
class FailedEpisode:
    """One failed episode, executed again: its rows for Rerun, and pictures at a few instants."""

    rollout: Rollout
    """Result of the episode when it was first run."""
    episode: Episode
    """All rows of the repeated episode, for Rerun."""
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
            by_category.setdefault((rollout.row.task, rollout.row.outcome), []).append(rollout)
    chosen: list[Rollout] = []
    for turn in range(max((len(those) for those in by_category.values()), default=0)):
        chosen += [those[turn] for those in by_category.values() if turn < len(those)]
    return chosen[:num]


def execute_again(scenes: Scenes, rollout: Rollout, *, images: bool) -> FailedEpisode:
    """Run a failed episode again: the same scene, actions and touch, bit for bit. Raises TaccorlError: the outcome differs from
    that of the row, so that the scenes are not those of the rollout."""
    row = rollout.row
    sim = Simulation(tasks.get(row.task)(scenes.difficulty), scenes.twin_config(), scale=scenes.randomization)
    if scenes.episode_length is not None:
        sim.judge.limit_steps = scenes.episode_length
    sim.reset([row.seed])
    recorder = EpisodeRecorder(sim, row_spec(sim, pictures=images))
    for action in rollout.actions:
        recorder.sensor_rng = np.random.default_rng((row.seed, len(recorder.rows)))  # as the environment's pads
        recorder.step(action)
    outcome = sim.judge.outcome
    end = "success" if outcome.success[0] else str(outcome.failure[0])
    if end not in ("", row.outcome) or int(outcome.partial[0]) != row.partial:
        raise TaccorlError(
            f"{row.task} seed {row.seed}: executed again, the episode ends as {end or 'running'} instead of {row.outcome}"
        )
    name = f"{row.task} seed {row.seed}, {row.outcome}{': ' + row.reason if row.reason else ''}"
    simulation = {"policy": row.policy, "task": row.task, "seed": row.seed, "twin": str(scenes.twin or "nominal")}
    origin = Origin(TWIN_ORIGIN.domain, f"{TWIN_ORIGIN.text}; actions of {row.policy}")
    episode = dataclasses.replace(recorder.episode(name, simulation), origin=origin)
    instants = np.unique(np.linspace(0, len(recorder.rows) - 1, NUM_INSTANTS).round().astype(int))
    pictures = None
    if images:
        columns = [
            np.concatenate([views[camera] for camera in ROBOT.cameras])
            for views in sim.render_states(episode.arrays["sim.state"][instants], ROBOT.cameras)
        ]
        pictures = np.concatenate(columns, axis=1)
    return FailedEpisode(rollout, episode, pictures, tuple(instants / episode.spec.fps))


def recorded_failures(rollouts: Sequence[Rollout], folder: Path) -> tuple[list[tuple[FailedEpisode, Path]], list[str]]:
    """Failed trials of a robot with pictures from their recordings in ``folder``, and these; and notes about those without."""
    found, notes = [], []
    for rollout in rollouts:
        path = folder / f"{rollout.row.task}_seed_{rollout.row.seed}.mcap"
        try:
            with open_episodes(path, RECORDED_SPEC) as episodes:
                longest = max(episodes, key=lambda episode: episode.num_rows)  # a pause of the arms divides it
                rows = np.unique(np.linspace(0, longest.num_rows - 1, NUM_INSTANTS).round().astype(int)).tolist()
                shown = [np.concatenate(list(x.values())) for k, x in enumerate(longest.pictures()) if x and k in rows]
                pictures = np.concatenate(shown, axis=1) if shown else None
                times = tuple(row / longest.spec.fps for row in rows)
                found.append((FailedEpisode(rollout, longest, pictures, times), path))
        except TaccorlError as error:
            notes.append(f"note: seed {rollout.row.seed} is shown without pictures: {error}")
    return found, notes

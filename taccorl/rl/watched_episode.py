"""Episodes of environment 0 of the rollouts for Rerun, with the critic's values.

A rollout keeps only seed, actions and values. They are executed again separately, bit for bit, so that watching costs the
rollout nothing and does not change its random numbers.

Letters in shapes: n executed actions of a decision, A action, T control steps.
"""

import dataclasses
from dataclasses import dataclass, field

import numpy as np
from torch import Tensor

from taccorl.data.episode import Episode
from taccorl.data.spec import FeatureSpec
from taccorl.evaluation.episodes import EpisodeRow
from taccorl.evaluation.evaluate import Scenes
from taccorl.evaluation.failed_episodes import execute_again
from taccorl.evaluation.rollouts import Rollout
from taccorl.rl.twin_shard import Acted
from taccorl.robots import ROBOT
from taccorl.sim.twin import CONTROL_HZ

VALUE = "rl.value"
"""Key of the feature with the critic's value, (T, 1) float32."""


@dataclass(frozen=True)
class WatchedEpisode:
    """Seed, actions and critic values of one finished episode of environment 0."""

    seed: int
    """Scene seed of the episode."""
    outcome: str
    """``success``, ``timeout`` or the failure."""
    partial: int
    """Number of goals in place at the end."""
    actions_TA: np.ndarray
    """Executed joint targets [rad, m], float32."""
    values_T: np.ndarray
    """float32 value V of the decision that each control step belongs to."""


@dataclass
class EpisodeWatch:
    """Records the present episode of environment 0, and keeps the first one that ended."""

    chunks: list[np.ndarray] = field(default_factory=list)
    """Executed actions of the present episode, (n, A) for each decision [rad, m]; n control steps are executed for a decision."""
    values: list[np.ndarray] = field(default_factory=list)
    """The critic's value of each decision of the present episode, repeated for its n actions: (n,) each."""
    ended: WatchedEpisode | None = None
    """First episode that ended since this was set to None."""

    def see(self, acted: Acted, value_N: Tensor) -> None:
        """Record one decision, with the critic's values before it."""
        actions_nA = acted.actions_NnA[0, : acted.num_steps_N[0]].copy()
        self.chunks.append(actions_nA)
        self.values.append(
            np.full(len(actions_nA), float(value_N[0]), dtype=np.float32)
        )
        if acted.outcome_N[0] is None:
            return
        # An episode that began in a state of an earlier one cannot be executed again from its seed.
        if self.ended is None and not acted.began_later_N[0]:
            seed, outcome, partial = (
                int(acted.seed_N[0]),
                str(acted.outcome_N[0]),
                int(acted.partial_N[0]),
            )
            actions_TA, values_T = (
                np.concatenate(self.chunks),
                np.concatenate(self.values),
            )
            self.ended = WatchedEpisode(seed, outcome, partial, actions_TA, values_T)
        self.chunks, self.values = [], []


def executed_again(
    watched: WatchedEpisode, scenes: Scenes, policy: str, *, images: bool
) -> Episode:
    """Execute a watched episode again; returns its rows with the feature ``rl.value``. Raises TaccorlError: the repeated
    episode has another outcome."""
    steps = len(watched.actions_TA)
    row = EpisodeRow(
        policy=policy, task=scenes.tasks[0], seed=watched.seed, outcome=watched.outcome, partial=watched.partial,
        max_partial=0, steps=steps, time_s=steps / CONTROL_HZ, subtask_end_s={}, clipped_steps=0,
    )  # fmt: skip
    rollout = Rollout(
        row,
        watched.actions_TA,
        np.zeros((0, len(ROBOT.action_names))),
        np.zeros((0, len(ROBOT.arms))),
    )
    episode = execute_again(scenes, rollout, images=images).episode
    assert episode is not None, "it was executed"
    value = FeatureSpec(
        dtype="float32",
        shape=(1,),
        unit="1",
        frame="critic",
        rate_hz=CONTROL_HZ,
        range=(-1e12, 1e12),
    )
    spec = dataclasses.replace(
        episode.spec, features=episode.spec.features | {VALUE: value}
    )
    return dataclasses.replace(
        episode, spec=spec, arrays=episode.arrays | {VALUE: watched.values_T[:, None]}
    )

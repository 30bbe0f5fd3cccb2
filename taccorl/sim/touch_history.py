"""The last L touch readings of every environment, for policies that read a history.

    history = TouchHistory(envs.num_envs, 10)
    observation, _ = envs.reset(seed=0)
    history.reset(observation["observation.tactile"])
    chunk = envs.step_chunk(policy(history.window))
    history.follow(chunk)

Letters in shapes: N environments, L readings, H control steps of a chunk, K taxels.
"""

import numpy as np

from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.spaces import TACTILE_KEY
from taccorl.sim.vector_env import Chunk


class TouchHistory:
    """The last L readings of each environment, on the CPU. At the start of an episode the first reading is repeated."""

    def __init__(self, num_envs: int, length: int) -> None:
        """
        Args:
            length: L ≥ 1.
        """
        if length < 1:
            raise TaccorlError(f"touch history: length {length}; give at least 1")
        self.window = np.zeros((num_envs, length, ROBOT.num_taxels), dtype=np.int16)
        """(N, L, K) counts above baseline, oldest first."""

    def reset(self, first: np.ndarray, mask: np.ndarray | None = None) -> None:
        """Fill the windows of the environments in ``mask`` (N,) bool (all by default) with their first readings ``first`` (N,
        K)."""
        mask = np.ones(len(self.window), dtype=bool) if mask is None else mask
        self.window[mask] = first[mask, None]

    def append(self, readings: np.ndarray, num_steps: np.ndarray) -> None:
        """Append the first ``num_steps`` (N,) of the ``readings`` (N, H, K) to each window."""
        length = self.window.shape[1]
        both = np.concatenate([self.window, readings], axis=1)
        newest = num_steps[:, None] + np.arange(length)
        self.window = np.take_along_axis(both, newest[:, :, None], axis=1)

    def follow(self, chunk: Chunk) -> None:
        """Append the readings of a chunk. An environment that was reset within it starts a new window with the new episode's
        first reading."""
        self.append(chunk.tactile, chunk.num_steps)
        if "_final_obs" in chunk.info:
            self.reset(chunk.observation[TACTILE_KEY], chunk.info["_final_obs"])

"""Deterministic sequence of scene seeds for each environment, a function of the first seed and the episode's number only."""

import functools
from collections.abc import Sequence

import numpy as np

from taccorl.errors import TaccorlError


@functools.lru_cache(maxsize=1 << 16)
def episode_seed(root: int, index: int, episode: int) -> int:
    """Scene seed (0 … 2³² − 1) of the ``episode``-th episode of environment ``index``, both from 0: a pure function of ``root``,
    the first seed, and both numbers."""
    return int(
        np.random.SeedSequence(root, spawn_key=(index, episode)).generate_state(1)[0]
    )


class EpisodeSeeds:
    """Seed sequences of N environments.

    With one seed s, environment i's k-th episode has ``episode_seed(s, i, k)``. With one seed sᵢ for each environment,
    environment i begins with scene seed sᵢ and continues with ``episode_seed(sᵢ, 0, k)``, k = 1, 2, …"""

    def __init__(self, num_envs: int, seed: int | None) -> None:
        """With ``seed`` None, the first seed comes from the operating system's entropy."""
        self.num_envs = num_envs
        self._roots, self._indices = [0] * num_envs, [0] * num_envs
        self._itself_first, self._num_drawn = [False] * num_envs, [0] * num_envs
        self.begin(
            int(np.random.SeedSequence().generate_state(1)[0])
            if seed is None
            else seed,
            range(num_envs),
        )

    def begin(self, seed: int | Sequence[int], ids: Sequence[int] | range) -> None:
        """Restart the seed sequences of environments ``ids``. Raises TaccorlError: a seed is negative, or the number of seeds
        is neither 1 nor N."""
        alone = not isinstance(seed, int | np.integer)
        seeds: list[int] = list(seed) if alone else [seed] * self.num_envs  # pyright: ignore[reportArgumentType, reportAssignmentType]
        if len(seeds) != self.num_envs or any(s < 0 for s in seeds):
            raise TaccorlError(
                f"seed: {seed} is neither a number ≥ 0 nor {self.num_envs}, one per environment"
            )
        for i in ids:
            self._roots[i], self._indices[i] = int(seeds[i]), 0 if alone else i
            self._itself_first[i], self._num_drawn[i] = alone, 0

    def draw(self, i: int) -> int:
        """Scene seed of environment ``i``'s next episode."""
        episode = self._num_drawn[i]
        self._num_drawn[i] += 1
        if episode == 0 and self._itself_first[i]:
            return self._roots[i]
        return episode_seed(self._roots[i], self._indices[i], episode)

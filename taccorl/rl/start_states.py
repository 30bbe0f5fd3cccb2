"""States from the policy's own episodes in which later episodes start: after each arm's first grasp, before an arm has finished.

Most decisions of an episode are transport, which a policy trained on demonstrations has learned. Episodes that begin shortly
before the parts meet have several times as many decisions in the phase where the policy fails. The states come from the policy's
own episodes, so that it really reaches them. The newest ones are kept in a ring buffer.
"""

import dataclasses
from typing import Any

import numpy as np

from taccorl.sim.simulation import Simulation, Snapshot

NUM_STATES = 256
"""States that all shards of a run keep together."""
_KEPT = 0.1
"""Share of such states that is kept, one a decision."""
_TIME_LEFT = 1 / 3
"""Share of the time limit that has to be left."""


class StartStates:
    """Ring buffer of states of single environments with their windows of touch. It also draws which new episodes start in a
    stored state.

    Letters in shapes: N environments, W control steps of a window, K taxels."""

    def __init__(self, share: float = 0.0, size: int = 1) -> None:
        """``share``: share of episodes that begin in a stored state, once there are some; 0: nothing is stored."""
        self._share, self._size = share, size
        self.restart(0)

    def restart(self, seed: int | tuple[int, ...]) -> None:
        """Delete all states, and restart the random numbers from ``seed``."""
        self._rng = np.random.default_rng(seed)
        self._kept: list[tuple[Snapshot, np.ndarray]] = []
        self._next = 0

    def __len__(self) -> int:
        return len(self._kept)

    def see(self, sim: Simulation, window_NWK: np.ndarray, over_N: np.ndarray) -> None:
        """Store states of environments whose episodes continue, except states in which the goal is reached. ``over_N``: bool,
        the episode has ended."""
        if not self._share:
            return
        subtask, counts = (
            sim.judge.subtask,
            [len(subtasks) for subtasks in sim.task.subtasks().values()],
        )
        in_time_N = sim.judge.steps <= (1 - _TIME_LEFT) * sim.judge.limit_steps
        held_N = (
            ((subtask >= 1) & (subtask < counts)).all(axis=1)
            & (sim.judge.held == 0)
            & in_time_N
            & ~over_N
        )
        for i in np.flatnonzero(held_N & (self._rng.random(len(held_N)) < _KEPT)):
            self._kept[self._next : self._next + 1] = [
                (sim.snapshot(np.array([i])), window_NWK[i].copy())
            ]
            self._next = (self._next + 1) % self._size

    def draw(self, over_N: np.ndarray) -> dict[int, tuple[Snapshot, np.ndarray]]:
        """Draw which of the environments where ``over_N`` (bool) is true start in a stored state: their numbers, with the state
        and its window of touch (W, K)."""
        chosen_N = (
            over_N & (self._rng.random(len(over_N)) < self._share) & bool(self._kept)
        )
        numbers = self._rng.integers(max(1, len(self._kept)), size=chosen_N.sum())
        return {
            int(i): self._kept[k]
            for i, k in zip(np.flatnonzero(chosen_N), numbers, strict=True)
        }

    def state_dict(self) -> dict[str, Any]:
        """State from which a run continues bit for bit, as ``load_state_dict`` takes it."""
        kept = [
            (dataclasses.asdict(snapshot), window) for snapshot, window in self._kept
        ]
        return {
            "kept": kept,
            "next": self._next,
            "generator": self._rng.bit_generator.state,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state from ``state_dict``."""
        self._kept = [(Snapshot(**fields), window) for fields, window in state["kept"]]
        self._next = state["next"]
        self._rng.bit_generator.state = state["generator"]

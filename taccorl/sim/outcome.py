"""Outcome of an episode: success if the goal predicate holds for half a second, failure, or time limit."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from taccorl.robots import ROBOT
from taccorl.sim.task import HOLD_S, Task, Verdict

if TYPE_CHECKING:
    from taccorl.sim.simulation import Simulation


BAD_ACTION = "bad_action"
"""Failure category of an episode whose action was NaN, or a target far beyond the limits."""


@dataclass(frozen=True)
class Outcome:
    """Outcome of each of N episodes so far: success, failure, and number of goals in place."""

    success: np.ndarray
    """(N,) bool: the goal has held for 0.5 s after release, and nothing had failed before."""
    failure: np.ndarray
    """(N,) object: '' or the failure category: one of the task's, ``timeout``, ``diverged`` or ``bad_action``."""
    partial: np.ndarray
    """(N,) int: number of the task's goals in place at the newest step (``Verdict.partial``)."""

    @property
    def over(self) -> np.ndarray:
        """(N,) bool: the episode has ended, with success or failure."""
        return self.success | (self.failure != "")


class Judge:
    """Derives the outcomes of N episodes from the predicates of each control step (``Verdict``), and keeps the counters for it: a
    success or failure counts when its condition has lasted long enough."""

    def __init__(self, task: Task, num_sims: int, control_hz: int) -> None:
        self.task, self.control_hz = task, control_hz
        self.hold_steps = round(HOLD_S * control_hz)
        self.limit_steps = round(task.time_limit_s * control_hz)
        self.held = np.zeros(num_sims, dtype=np.int64)
        self.steps = np.zeros(num_sims, dtype=np.int64)
        self.success = np.zeros(num_sims, dtype=bool)
        self.failure = np.full(num_sims, "", dtype=object)
        self.lasted = np.zeros((num_sims, len(task.failures)), dtype=np.int64)
        """(N, categories) control steps for which each failure has been seen without a break."""
        self._limits = np.array(
            [max(1, round(seconds * control_hz)) for seconds in task.failures.values()]
        )
        self.subtask = np.zeros((num_sims, len(ROBOT.arms)), dtype=np.int64)
        """(N, 2) index of each arm's current subtask; one past the last when all are done."""
        self.verdict: Verdict | None = None
        self._subtasks = task.subtasks()

    @property
    def outcome(self) -> Outcome:
        """Copies of the present outcomes of all N episodes."""
        assert self.verdict is not None, "reset the simulation first"
        return Outcome(self.success.copy(), self.failure.copy(), self.verdict.partial)

    def reset(self, ids: np.ndarray, scene: "Simulation") -> None:
        """Start new episodes in the simulations ``ids`` (n,), whose scene has just been drawn."""
        self.held[ids] = self.steps[ids] = 0
        self.success[ids], self.failure[ids] = False, ""
        self.subtask[ids] = self.lasted[ids] = 0
        self.verdict = self.task.look(scene)

    def restart_clock(self) -> None:
        """Restart the time limit and the hold counters of success and failure; finished subtasks stay finished."""
        self.steps[:] = self.held[:] = 0
        self.lasted[:] = 0

    def update(self, scene: "Simulation", ids: np.ndarray | None = None) -> None:
        """Update the outcomes after a control step of the simulations ``ids`` (n,) (all by default). A finished episode keeps
        its outcome."""
        verdict = self.verdict = self.task.look(scene)
        stepped = np.zeros(len(self.held), dtype=bool)
        stepped[slice(None) if ids is None else ids] = True
        running = stepped & ~self.success & (self.failure == "")
        self.steps[running] += 1
        held = np.where(verdict.goal & ~scene.diverged, self.held + 1, 0)
        self.held = np.where(stepped, held, self.held)
        self.success |= running & (self.held >= self.hold_steps)
        running &= ~self.success
        seen = (
            np.array([verdict.failures[name] for name in self.task.failures], bool)
            .reshape(-1, len(self.held))
            .T
        )
        self.lasted = np.where(
            stepped[:, None], np.where(seen, self.lasted + 1, 0), self.lasted
        )
        failed, late = self.lasted >= self._limits, self.steps >= self.limit_steps
        if failed.any() or late.any() or scene.diverged.any():
            first = np.column_stack([failed, np.ones(len(self.held), bool)]).argmax(1)
            failure = np.array([*self.task.failures, ""], dtype=object)[
                first
            ]  # the first, or none
            failure[(failure == "") & late] = "timeout"
            failure[scene.diverged] = "diverged"
            self.failure[running] = failure[running]
        # Only the current subtask may end, and one a step at most: an edge before its turn does not count.
        before = self.subtask.copy()
        for a, arm in enumerate(ROBOT.arms):
            for k, subtask in enumerate(self._subtasks[arm]):
                waiting = stepped & (before[:, a] == k)
                if waiting.any():
                    self.subtask[waiting & subtask.done(scene), a] = k + 1

    def fail(self, ids: np.ndarray, category: str) -> None:
        """End the unfinished episodes of the simulations ``ids`` (n,) as failures of this category."""
        self.failure[ids[~self.outcome.over[ids]]] = category

    def snapshot(self, ids: np.ndarray) -> dict[str, np.ndarray]:
        """Name of each counter → its values (n, …) in the simulations ``ids`` (n,), for ``restore``."""
        return {
            name: getattr(self, name)[ids].copy()
            for name in ("held", "lasted", "steps", "success", "failure", "subtask")
        }

    def restore(
        self, rows: dict[str, np.ndarray], ids: np.ndarray, scene: "Simulation"
    ) -> None:
        """Set the counters of the simulations ``ids`` (n,) from ``rows``, which ``snapshot`` returned."""
        for name, values in rows.items():
            getattr(self, name)[ids] = values
        self.verdict = self.task.look(scene)

"""Roll out one batch of episodes: any actor in ``TaccorlVectorEnv``, each episode up to its own end.

Letters in shapes: N environments, T control steps of an episode.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from taccorl.errors import TaccorlError, nearest
from taccorl.evaluation.episodes import NO_PICTURES, SUCCESS, EpisodeRow
from taccorl.robots import ROBOT
from taccorl.sim.outcome import BAD_ACTION
from taccorl.sim.part_poses import posed_bodies
from taccorl.sim.spaces import IMAGE_KEYS, STATE_KEY, TACTILE_KEY, Observation
from taccorl.sim.twin import CONTROL_HZ
from taccorl.sim.vector_env import TaccorlVectorEnv, shaped

PICTURES = ("clear", "randomised")
"""How an actor sees the pictures: as they are rendered, or changed by the image rows of the paper's randomisation."""
HIDDEN = ("touch", "cameras", "touch_at_mate", "cameras_at_mate")
"""What can be hidden from an actor: always, or from when each arm is in its last subtask."""
Progress = Callable[[str], None]
"""Function that is called with a text while episodes run."""


@dataclass(frozen=True)
class Acted:
    """Actions of an actor in one control step of N environments, and the environments that it gave up."""

    actions: np.ndarray
    """(N, 14) targets [rad, m]."""
    given_up: dict[int, tuple[str, str]] = field(default_factory=dict)
    """Environment → (category, reason), where the actor has no action; the episode ends."""


class Actor(Protocol):
    """Interface of a policy or an expert for rollouts."""

    @property
    def name(self) -> str:
        """Label of the actor in rows."""
        ...

    @property
    def needs_images(self) -> bool:
        """Whether the actor ever uses camera pictures; if not, nothing is rendered."""
        ...

    @property
    def needs_part_poses(self) -> bool:
        """Whether observations must have the poses of the task's parts."""
        ...

    def looks_now(self) -> bool:
        """Whether ``act`` uses the newest pictures; otherwise it gets the previous ones, and nothing is rendered."""
        ...

    @property
    def max_batch(self) -> int | None:
        """Largest number of environments; None: any number."""
        ...

    def restart(self, stream: int = 0) -> None:
        """Prepare for the first batch of a task: the state of the random numbers becomes that of a new evaluation. Another
        ``stream`` gives other numbers."""
        ...

    def begin(self, envs: TaccorlVectorEnv, pictures: str) -> None:
        """Prepare the actor for new episodes; called after the reset of all environments.

        ``pictures``: one of ``PICTURES``, how the actor is to see the pictures, which ``act`` gets as they are rendered."""
        ...

    def act(self, observation: Observation) -> Acted:
        """Next action of each environment, (N, 14) targets [rad, m]; the rows of finished environments are ignored.

        ``observation``: key of the environment → array with N rows; pictures are the newest that were rendered."""
        ...


@dataclass(frozen=True)
class Rollout:
    """Result of one episode: its row, actions and states. Of a robot's trial, the row only: there is a recording of the rest."""

    row: EpisodeRow
    actions: np.ndarray = field(
        default_factory=lambda: np.empty((0, len(ROBOT.action_names)), np.float32)
    )
    """(T, 14) float32 actions as the actor returned them."""
    states: np.ndarray = field(
        default_factory=lambda: np.empty((0, len(ROBOT.action_names)), np.float32)
    )
    """(T + 1, 14) float32 ``observation.state`` before each action, and after the last."""
    subtasks: np.ndarray = field(
        default_factory=lambda: np.empty((0, len(ROBOT.arms)), np.int16)
    )
    """(T + 1, 2) int16 index of each arm's subtask before each action, and after the last."""


class _Running:
    """Bookkeeping of one environment's episode."""

    def __init__(
        self,
        names: Mapping[str, Sequence[str]],
        actions: np.ndarray,
        states: np.ndarray,
        subtasks: np.ndarray,
        state: np.ndarray,
        touch: np.ndarray,
        place: dict[str, float],
        facts: dict[str, Any],
    ) -> None:
        """
        Args:
            actions: (limit, 14) float32 array that the episode fills. ``limit``: control steps before the time limit.
            states: (limit + 1, 14) float32 array, likewise; and ``subtasks``, (limit + 1, 2) int16. They are parts of arrays that
                are allocated once for all environments. A small array kept in every step, between the large temporary ones of
                the pictures, fragments the heap: 32 environments then took 13 GB in 900 steps.
            state: (14,) ``observation.state`` after the reset; ``touch``, of pads [counts]; ``place``: ``EpisodeRow.reset``.
        """
        self._actions, self._states, self._subtasks = actions, states, subtasks
        self._states[0], self._subtasks[0], self.facts = state, facts["subtask"], facts
        self.steps = 0
        self.clipped_steps = 0
        self.subtask_end_s: dict[str, dict[str, float | None]] = {
            arm: dict.fromkeys(own) for arm, own in names.items()
        }
        self.end: tuple[str, str] | None = None
        """Outcome and reason."""
        self.touch, self.place = touch, place
        self.forces: dict[str, float] = {}
        """``PART_on_OTHER_n``, of mating parts after the last step."""

    @property
    def actions(self) -> np.ndarray:
        """(T, 14) float32 so far."""
        return self._actions[: self.steps]

    @property
    def states(self) -> np.ndarray:
        """(T + 1, 14) float32 so far."""
        return self._states[: self.steps + 1]

    @property
    def subtasks(self) -> np.ndarray:
        """(T + 1, 2) int16 so far."""
        return self._subtasks[: self.steps + 1]

    def stepped(
        self, action: np.ndarray, facts: dict[str, Any], state: np.ndarray
    ) -> None:
        self.facts = facts
        if facts["failure"] == BAD_ACTION:  # not carried out
            self.end = (BAD_ACTION, str(facts["reason"]))
            return
        self._actions[self.steps] = action
        self.steps += 1
        self._states[self.steps], self._subtasks[self.steps] = state, facts["subtask"]
        self.clipped_steps += bool(facts["clipped"])
        now_s = facts["steps"] / CONTROL_HZ
        for arm, done in zip(ROBOT.arms, facts["subtask"], strict=True):
            for name in list(self.subtask_end_s[arm])[: int(done)]:
                if self.subtask_end_s[arm][name] is None:
                    self.subtask_end_s[arm][name] = now_s
        if facts["is_success"] or facts["failure"]:
            self.end = (SUCCESS if facts["is_success"] else str(facts["failure"]), "")


def checked_pictures(pictures: str, option: str = "--pictures") -> str:
    """``pictures``, if it is one of ``PICTURES``. Raises TaccorlError: it is not."""
    if pictures not in PICTURES:
        raise TaccorlError(f"{option}={pictures}: {nearest(pictures, PICTURES)}")
    return pictures


def checked_hidden(hidden: Sequence[str], option: str = "--hide") -> None:
    """Check that all of ``hidden`` are of ``HIDDEN``, each once. Raises TaccorlError: one is not, or is given twice."""
    for what in hidden:
        if what not in HIDDEN:
            raise TaccorlError(f"{option}={what}: {nearest(what, HIDDEN)}")
        if hidden.count(what) > 1:
            raise TaccorlError(f"{option}={what}: give it once")


def _without(
    observation: Observation, hidden: Sequence[str], is_last_N: np.ndarray
) -> Observation:
    """The observation with zeros in what is hidden from the policy. ``is_last_N``: whether all arms of the environment are in
    their last subtask."""
    left = dict(observation)
    for what in hidden:
        sensor, _, when = what.partition("_")
        rows_N = is_last_N if when == "at_mate" else np.ones_like(is_last_N)
        for key in (TACTILE_KEY,) if sensor == "touch" else IMAGE_KEYS.values():
            if rows_N.any() and key in left:
                left[key] = left[key].copy()
                left[key][rows_N] = 0
    return left


def roll_out(
    envs: TaccorlVectorEnv,
    actor: Actor,
    seeds: Sequence[int],
    progress: Progress | None = None,
    *,
    pictures: str = "clear",
    hidden: Sequence[str] = (),
) -> list[Rollout]:
    """Run one episode in each of the N environments, in the scenes ``seeds``; returns N results in their order. Each episode ends
    by itself: by success, failure, time limit, divergence or a bad action as the environment decides, or with a category that the
    actor states.

    Args:
        envs: environments with ``AutoresetMode.DISABLED``, and ``images="on_request"`` if the actor needs pictures.
        hidden: of ``HIDDEN``.

    Raises:
        TaccorlError: the number of seeds differs from that of environments, or the actions are not (N, 14).
    """
    observation, _ = envs.reset(seed=[int(seed) for seed in seeds])
    names = {
        arm: [s.name for s in own] for arm, own in envs.sim.task.subtasks().items()
    }
    num, limit, size = (
        envs.num_envs,
        envs.sim.judge.limit_steps,
        len(ROBOT.action_names),
    )
    memory = (
        np.empty((num, limit, size), np.float32),
        np.empty((num, limit + 1, size), np.float32),
    )
    memory += (np.empty((num, limit + 1, len(ROBOT.arms)), np.int16),)
    began = (
        observation[STATE_KEY],
        observation[TACTILE_KEY],
        _places(envs),
        _each(envs.facts(), num),
    )
    running = [_Running(names, *own) for own in zip(*memory, *began, strict=True)]
    actor.begin(envs, checked_pictures(pictures))
    views: Observation = {}
    while True:
        if actor.needs_images and actor.looks_now():
            views = envs.observe(images=True)
        shown = {**views, **observation}
        acted = actor.act(
            _without(shown, hidden, _in_last_subtask(running, names))
            if hidden
            else shown
        )
        actions = shaped(acted.actions, envs.num_envs).astype(np.float32)
        for i, end in acted.given_up.items():
            running[i].end = running[i].end or end
        over = np.array([one.end is not None for one in running])
        if over.all():
            break
        # The environment may still move one that the actor gave up: it is held where it is.
        actions[over] = observation[STATE_KEY][over]
        observation, *_ = envs.step(actions)
        facts = _each(envs.facts(), envs.num_envs)
        forces = {
            f"{one}_on_{other}_n": envs.sim.contact(one, other).force_n
            for one, other in envs.sim.task.mating
        }
        for i in np.flatnonzero(~over):
            running[i].stepped(actions[i], facts[i], observation[STATE_KEY][i])
            running[i].touch = observation[TACTILE_KEY][i].copy()
            running[i].forces = {
                name: float(force[i]) for name, force in forces.items()
            }
        over = np.array([one.end is not None for one in running])
        if progress is not None:
            successes = sum(
                one.end is not None and one.end[0] == SUCCESS for one in running
            )
            steps = max(one.steps for one in running)
            progress(
                f"step {steps} of {envs.sim.judge.limit_steps}: {over.sum()} of {len(over)} over, {successes} succeeded"
            )
        if over.all():
            break
    seen = pictures if actor.needs_images else NO_PICTURES
    return [
        _rollout(envs, actor, int(seed), seen, hidden, one)
        for seed, one in zip(seeds, running, strict=True)
    ]


def _places(envs: TaccorlVectorEnv) -> list[dict[str, float]]:
    """``EpisodeRow.reset`` of each environment."""
    places: list[dict[str, float]] = [{} for _ in range(envs.num_envs)]
    for body in posed_bodies(envs.sim.task):
        for place, pose in zip(places, envs.sim.poses(body), strict=True):
            yaw = math.atan2(pose[1, 0], pose[0, 0])
            place |= {
                f"{body}_x_m": float(pose[0, 3]),
                f"{body}_y_m": float(pose[1, 3]),
                f"{body}_yaw_rad": yaw,
            }
    return places


def _in_last_subtask(
    running: Sequence[_Running], names: Mapping[str, Sequence[str]]
) -> np.ndarray:
    last = np.array([len(names[arm]) - 1 for arm in ROBOT.arms])
    return np.array([(one.subtasks[-1] >= last).all() for one in running])


def _rollout(
    envs: TaccorlVectorEnv,
    actor: Actor,
    seed: int,
    pictures: str,
    hidden: Sequence[str],
    one: _Running,
) -> Rollout:
    assert one.end is not None
    outcome, reason = one.end
    largest = one.touch.reshape(len(ROBOT.arms), -1).max(axis=1)
    touched = {
        f"{arm}_touch_counts": counts
        for arm, counts in zip(ROBOT.arms, largest, strict=True)
    }
    row = EpisodeRow(
        policy=actor.name,
        task=envs.task,
        seed=seed,
        outcome=outcome,
        partial=int(one.facts["partial"]),
        max_partial=envs.sim.task.max_partial,
        steps=one.steps,
        time_s=one.steps / CONTROL_HZ,
        subtask_end_s=one.subtask_end_s,
        clipped_steps=one.clipped_steps,
        # A diverged simulation has no measures: JSON knows no NaN.
        measures={
            k: float(v)
            for k, v in (one.facts["measures"] | touched | one.forces).items()
            if np.isfinite(v)
        },
        reset=one.place,
        reason=reason,
        pictures=pictures,
        hidden=", ".join(hidden),
    )
    return Rollout(row, one.actions.copy(), one.states.copy(), one.subtasks.copy())


def _each(facts: dict[str, Any], n: int) -> list[dict[str, Any]]:
    """The facts of each environment."""
    return [
        {
            k: {name: v[i] for name, v in values.items()}
            if isinstance(values, dict)
            else values[i]
            for k, values in facts.items()
        }
        for i in range(n)
    ]

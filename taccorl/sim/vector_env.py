"""N twins of one task as a ``gymnasium.vector.VectorEnv`` on one batch: single control steps or whole action chunks.

    envs = TaccorlVectorEnv("assembly_1", 128)
    observation, info = envs.reset(seed=0)
    chunk = envs.step_chunk(policy(observation))  # (128, H, 14)

Autoreset is ``SAME_STEP`` unless ``DISABLED`` is asked for: an episode that ends is reset within the call that ended it. The
observation returned is then the new episode's first; ``info["final_obs"]`` and ``info["final_info"]`` are of the instant before
the reset. Letters in shapes: N environments, H control steps of a chunk.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from taccorl.errors import TaccorlError, nearest
from taccorl.robots import ROBOT
from taccorl.sim.actions import beyond_reason, why_bad
from taccorl.sim.episode_seeds import EpisodeSeeds
from taccorl.sim.outcome import BAD_ACTION
from taccorl.sim.part_poses import part_pose_names, part_poses
from taccorl.sim.sensors.noise import ScanNoise
from taccorl.sim.simulation import Simulation, Snapshot, checked_seeds
from taccorl.sim.spaces import (
    IMAGE_KEYS,
    IMAGE_SHAPE,
    PARTS_KEY,
    STATE_KEY,
    TACTILE_KEY,
    Observation,
    action_space,
    observation_space,
)
from taccorl.sim.task import tasks
from taccorl.sim.twin import CONTROL_HZ, TwinConfig
from taccorl.sim.twin_file import load_twin

Images = Literal["never", "always", "on_request"]
"""When pictures are rendered: never, with every observation, or on request only."""
_OPTIONS = ("state", "reset_mask")
_NOT_FOR_US = "lerobot_new_rollout"  # LeRobot's rollout marks a new episode by it (lerobot/envs/utils.py, 0.6.1)


def shaped(actions: np.ndarray, *leading: int | None) -> np.ndarray:
    """``actions`` as an array (*leading, 14). A ``None`` in ``leading`` stands for any size ≥ 1. Raises TaccorlError: it has
    another shape."""
    actions, wanted = np.asarray(actions), (*leading, ROBOT.num_actions)
    if actions.ndim != len(wanted) or not all(
        n == w or (w is None and n) for n, w in zip(actions.shape, wanted, strict=True)
    ):
        shape = ", ".join("H" if w is None else str(w) for w in wanted)
        raise TaccorlError(
            f"action: shape {actions.shape}, expected ({shape}): {', '.join(ROBOT.action_names)}"
        )
    return actions


@dataclass(frozen=True, kw_only=True)
class Chunk:
    """Result of a chunk of actions: observation, rewards, and which environments ended."""

    observation: Observation  # Observation after the chunk; of an episode that ended, the first one of the next episode
    reward: (
        np.ndarray
    )  # (N,) sum of the rewards in the chunk: 1 where the task succeeded within it
    terminated: np.ndarray  # (N,) bool: succeeded or failed within the chunk
    truncated: np.ndarray  # (N,) bool: ran out of time within the chunk
    num_steps: (
        np.ndarray
    )  # (N,) number of executed actions; a finished episode executes none
    tactile: np.ndarray
    """(N, H / every, 1536) int16 counts above baseline after every ``touch_every``-th control step, for policies that read a
    history; after the end of an episode, those of its end."""
    info: dict[str, Any]
    """Privileged information as of ``TaccorlVectorEnv``, after the chunk; ``final_obs`` and ``final_info`` of episodes that
    ended."""


class TaccorlVectorEnv(gymnasium.vector.VectorEnv):
    """N environments of ``task``. Reward is 1 at the step that completes the task, else 0.

    An episode terminates with success or failure (``info["failure"]``) and is truncated when time is up. A simulation that
    diverges fails as ``diverged``, ``info["seed"]`` holds its scene seed, and its last observation is the one before it
    diverged. An action that is NaN or far beyond the limits is not executed: its episode fails as ``bad_action``,
    ``info["reason"]`` says why. The others go on.

    Seeds (``EpisodeSeeds``): after ``reset(seed=s)`` environment i's k-th episode has the scene seed ``episode_seed(s, i, k)``.
    After ``reset(seed=[s0, s1, …])`` environment i begins with scene seed sᵢ itself, so that a value of ``info["seed"]``
    reproduces its scene.

    ``info`` has, for each environment: ``is_success``, ``failure`` ('' or the category), ``partial``, ``seed``, ``subtask``
    (left, right), ``steps``, ``clipped`` (an action lay beyond the limits), ``reason`` ('' or which joint of a bad action) and
    ``measures`` (privileged, names with units)."""

    def __init__(
        self,
        task: str,
        num_envs: int = 1,
        *,
        difficulty: str = "train",
        twin: TwinConfig | str | Path | None = None,
        images: Images = "never",
        randomization: float = 1.0,
        seed: int | None = None,
        num_threads: int = 0,
        autoreset: AutoresetMode = AutoresetMode.SAME_STEP,
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
        part_poses: bool = False,
        physics: str = "c",
    ) -> None:
        """The task's scene is compiled here; nothing is placed before ``reset``.

        Args:
            images: ``always`` renders with every observation (once per chunk), ``on_request`` only in ``observe(images=True)``.
            randomization: share of the task's reset ranges; 0 is the nominal scene.
            num_threads: threads of the physics; 0: all CPUs. Results do not depend on it.
            autoreset: ``SAME_STEP`` or ``DISABLED`` (a finished episode is frozen until ``reset(options={"reset_mask": (N,)
                bool})``).
            max_episode_steps: None: the task's own time limit.
            part_poses: observations have the parts' poses (``observation.environment_state``), which are privileged.
            physics: ``c``, or ``warp`` with ``WarpSettings``: on a GPU, for a thousand environments and more.

        Raises:
            TaccorlError: unknown task, difficulty or setting; unreadable twin, or one without a requested camera.
        """
        _one_of("images", images, ("never", "always", "on_request"))
        _one_of(
            "autoreset", autoreset, (AutoresetMode.SAME_STEP, AutoresetMode.DISABLED)
        )
        _one_of("render_mode", render_mode, (None, "rgb_array"))
        self.sim = Simulation(
            tasks.get(task)(difficulty),
            load_twin(Path(twin)) if isinstance(twin, str | Path) else twin,
            num_sims=num_envs,
            num_threads=num_threads,
            scale=randomization,
            physics=physics,
        )
        self.sim.require_cameras(
            ROBOT.cameras
            if images != "never"
            else ROBOT.cameras[:1]
            if render_mode
            else []
        )
        checked_seeds([] if seed is None else seed)
        if max_episode_steps is not None:
            if (
                not isinstance(max_episode_steps, int | np.integer)
                or max_episode_steps < 1
            ):
                raise TaccorlError(
                    f"max_episode_steps: {max_episode_steps!r} is no whole number ≥ 1"
                )
            self.sim.judge.limit_steps = max_episode_steps
        self.num_envs, self.task, self.task_description = (
            num_envs,
            task,
            self.sim.task.instruction,
        )
        self.images, self.autoreset, self.render_mode = images, autoreset, render_mode
        self.metadata = {
            "autoreset_mode": autoreset,
            "render_modes": ["rgb_array"],
            "render_fps": CONTROL_HZ,
        }
        self.single_observation_space = observation_space(
            images == "always",
            len(part_pose_names(self.sim.task)) if part_poses else None,
        )
        self.single_action_space = action_space()
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._seeds = EpisodeSeeds(num_envs, seed)
        self._begun = False
        self._over, self._clipped = (
            np.zeros(num_envs, dtype=bool),
            np.zeros(num_envs, dtype=bool),
        )
        self._state = np.zeros((num_envs, ROBOT.num_actions), dtype=np.float32)
        self._tactile = np.zeros((num_envs, ROBOT.num_taxels), dtype=np.int16)
        self._parts = (
            np.zeros((num_envs, len(part_pose_names(self.sim.task))), dtype=np.float32)
            if part_poses
            else None
        )
        self._pictures = {
            name: np.zeros((num_envs, *IMAGE_SHAPE), dtype=np.uint8)
            for name in ROBOT.cameras
            if images != "never"
        }
        self._reason = np.full(num_envs, "", dtype=object)
        self._unseen = np.zeros(num_envs, dtype=bool)
        """(N,) bool: moved since its pictures were rendered."""
        self._unfelt = np.zeros(num_envs, dtype=bool)
        """(N,) bool: moved since its pads were read."""
        self._facts: dict[str, Any] = {}

    @property
    def _all(self) -> np.ndarray:
        return np.arange(self.num_envs)

    @property
    def _max_episode_steps(self) -> int:
        """LeRobot's evaluation asks for it by this name."""
        return self.sim.judge.limit_steps

    # gymnasium's interface --------------------------------------------------------------------------------------------

    def reset(  # pyright: ignore[reportIncompatibleMethodOverride]
        self,
        *,
        seed: int | Sequence[int] | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> tuple[Observation, dict[str, Any]]:
        """Start new episodes in all environments, or in those of ``reset_mask``; returns the observation and ``info`` of all.

        Args:
            seed: one seed for the sequences of all environments, or one scene seed for each environment; None: the next episodes
                of the present sequences.
            options: ``state``: a ``Snapshot`` to begin from; ``reset_mask``: (N,) bool, which environments to reset.
        """
        self._check_open("reset")
        checked_seeds([] if seed is None else seed)
        options = {
            name: value
            for name, value in (options or {}).items()
            if name != _NOT_FOR_US
        }
        for name in options:
            _one_of("reset option", name, _OPTIONS)
        ids = (
            self._mask_ids(options["reset_mask"])
            if "reset_mask" in options
            else self._all
        )
        if not self._begun and len(ids) < self.num_envs:
            raise TaccorlError(
                "reset: the first reset must be of all environments; remove reset_mask"
            )
        state = options.get("state")
        if state is not None:
            self.sim.check_snapshot(state, ids)  # before any of it acts
        super().reset(seed=seed if isinstance(seed, int) else None)
        if seed is not None:
            self._seeds.begin(seed, ids.tolist())
        self._begin(ids, state)
        self._begun = True
        return self.observe(self.images == "always"), _masked(
            self.facts(), np.isin(self._all, ids)
        )

    def step(
        self, actions: np.ndarray
    ) -> tuple[Observation, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One control step (1/30 s) with the targets ``actions`` (N, 14) [rad, m].

        Returns observation, reward (N,), terminated (N,), truncated (N,) and ``info``, as gymnasium defines them. Raises
        TaccorlError: wrong shape."""
        chunk = self.step_chunk(shaped(actions, self.num_envs)[:, None])
        return (
            chunk.observation,
            chunk.reward,
            chunk.terminated,
            chunk.truncated,
            chunk.info,
        )

    def step_chunk(self, actions: np.ndarray, *, touch_every: int = 1) -> Chunk:
        """H control steps with the targets ``actions`` (N, H, 14) [rad, m], as a policy gives them. An episode that ends within
        the chunk is frozen until autoreset.

        Args:
            touch_every: the pads are read after every so many control steps, for callers that need no other readings. Physics
                on a GPU stay there in between.

        Raises:
            TaccorlError: wrong shape, or H is no multiple of ``touch_every``.
        """
        self._check_open("step")
        actions = shaped(actions, self.num_envs, None)
        horizon = actions.shape[1]
        if touch_every < 1 or horizon % touch_every:
            raise TaccorlError(
                f"touch_every={touch_every}: must divide the {horizon} control steps of a chunk"
            )
        if not self._begun:
            raise TaccorlError("step: call reset() first")
        reward, num_steps = (
            np.zeros(self.num_envs),
            np.zeros(self.num_envs, dtype=np.int64),
        )
        num_readings = horizon // touch_every
        tactile = np.empty(
            (self.num_envs, num_readings, ROBOT.num_taxels), dtype=np.int16
        )
        self._clipped = np.zeros(self.num_envs, dtype=bool)
        for k in range(horizon):
            is_read = (k + 1) % touch_every == 0
            advanced, earned = self._advance(actions[:, k], lean=not is_read)
            num_steps += advanced
            reward += earned
            if is_read:
                self._feel()
                tactile[:, k // touch_every] = self._tactile
        facts = self._facts
        truncated = np.asarray(facts["failure"] == "timeout")
        observation, info = self._end()
        return Chunk(
            observation=observation,
            reward=reward,
            terminated=(facts["is_success"] | (facts["failure"] != "")) & ~truncated,
            truncated=truncated,
            num_steps=num_steps,
            tactile=tactile,
            info=info,
        )

    def render(self) -> tuple[np.ndarray, ...] | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The first camera's picture of every environment, (224, 224, 3) uint8 RGB each; None without ``render_mode``."""
        self._check_open("render")
        if self.render_mode is None:
            return None
        if self.images == "never":
            return tuple(self.sim.render(ROBOT.cameras[:1])[ROBOT.cameras[0]])
        self._look()
        return tuple(self._pictures[ROBOT.cameras[0]])

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Return N values: the attribute, or the method's result, ``name`` for each environment, as gymnasium's own vector
        environments."""
        value = getattr(self, name)
        value = value(*args, **kwargs) if callable(value) else value
        return value if isinstance(value, tuple) else (value,) * self.num_envs

    def close_extras(self) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        self.sim.close()

    def _check_open(self, what: str) -> None:
        if self.closed:
            raise TaccorlError(f"{what}: this environment was closed; make a new one")

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """As ``call``."""
        return self.call(name)

    # what is seen -----------------------------------------------------------------------------------------------------

    def observe(self, images: bool = False) -> Observation:
        """Newest observation of all environments; ``images`` renders the pictures now (for ``images="on_request"``)."""
        if images and self.images == "never":
            raise TaccorlError(
                'observe: images are "never" rendered here; make the environment with "on_request"'
            )
        self._check_open("observe")
        observation = {STATE_KEY: self._state.copy(), TACTILE_KEY: self._tactile.copy()}
        if self._parts is not None:
            observation[PARTS_KEY] = self._parts.copy()
        if images:
            self._look()
            observation |= {
                IMAGE_KEYS[name]: pictures for name, pictures in self._pictures.items()
            }
        return observation

    def _look(self) -> None:
        """Render those that have moved. Pictures that were handed out are never written to again."""
        ids = np.flatnonzero(self._unseen & ~self.sim.diverged)
        if not ids.size:
            return
        for name, new in self.sim.render(ROBOT.cameras, ids).items():
            if len(ids) < self.num_envs:
                pictures = self._pictures[name].copy()
                pictures[ids] = new
                new = pictures
            self._pictures[name] = new
        self._unseen[ids] = False

    def facts(self) -> dict[str, Any]:
        """Privileged information on each episode: a copy of the arrays (N, …) in ``info``, by their names; ``measures`` is a dict
        of such arrays."""
        return _each(self._facts, np.copy)

    # one episode after another ----------------------------------------------------------------------------------------

    def _begin(self, ids: np.ndarray, state: Snapshot | None = None) -> None:
        """New episodes in ``ids``."""
        self.sim.reset([self._seeds.draw(i) for i in ids.tolist()], ids)
        if state is not None:
            self.sim.restore(state, ids)
        self._over[ids], self._clipped[ids], self._reason[ids] = (
            self.sim.judge.outcome.over[ids],
            False,
            "",
        )
        self._take(np.isin(self._all, ids))
        self._feel()

    def _advance(
        self, actions: np.ndarray, *, lean: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """One control step of those that are not over: (N,) bool, which of them it moved, and (N,) reward. ``lean``: as
        ``Simulation.step``."""
        actions = self._refuse_bad(actions)
        running = ~self._over
        if not running.any():
            return running, np.zeros(self.num_envs)
        ids = None if running.all() else np.flatnonzero(running)
        self.sim.step(actions, ids, lean=lean)
        self._clipped = self._clipped | (running & self.sim.clipped)
        self._take(running)
        outcome = self.sim.judge.outcome
        self._over = outcome.over
        return running, (running & outcome.success).astype(np.float64)

    def _refuse_bad(self, actions: np.ndarray) -> np.ndarray:
        """``actions`` (N, 14) that the simulation takes; episodes with a bad one end."""
        bad = np.any(beyond_reason(actions), axis=1)
        if not bad.any():
            return actions
        ended = np.asarray(bad & ~self._over)
        if ended.any():
            ids = np.flatnonzero(ended)
            self.sim.judge.fail(ids, BAD_ACTION)
            for i in ids.tolist():
                self._reason[i] = why_bad(actions[i])
            self._over = self._over | ended
            self._facts = _rows_from(self._facts, self._judged(), ended)
        return np.where(bad[:, None], self.sim.targets, actions)

    def _take(self, rows: np.ndarray) -> None:
        """Read joints, parts and outcomes in ``rows`` (N,) bool, which have moved. A diverged simulation's sensors keep what
        they read before."""
        valid = rows & ~self.sim.diverged
        self._state = np.where(
            valid[:, None], self.sim.proprioception(), self._state
        ).astype(np.float32)
        if self._parts is not None:
            self._parts = np.where(valid[:, None], part_poses(self.sim), self._parts)
        self._unfelt |= valid
        self._unseen |= valid
        facts = self._judged()
        self._facts = facts if rows.all() else _rows_from(self._facts, facts, rows)

    def _feel(self) -> None:
        """Read the pads of those that have moved since they were read.

        The pads' noise follows from scene seed and step alone, so that neither company nor a restored state changes it."""
        self.sim.refresh()
        rows = self._unfelt & ~self.sim.diverged
        self._unfelt[:] = False
        if not rows.any():
            return
        noise = ScanNoise(self.sim.seeds, self.sim.judge.steps)
        if rows.all():
            self._tactile = self.sim.touch(noise)
            return
        ids = np.flatnonzero(rows)
        noise = ScanNoise(noise.seeds[ids], noise.steps[ids])
        self._tactile = self._tactile.copy()  # it may have been handed out
        self._tactile[ids] = self.sim.touch(noise, ids)

    def _judged(self) -> dict[str, Any]:
        judge = self.sim.judge
        outcome, verdict = judge.outcome, judge.verdict
        assert verdict is not None
        return {
            "is_success": outcome.success,
            "failure": outcome.failure,
            "partial": np.array(outcome.partial),
            "seed": self.sim.seeds.copy(),
            "subtask": judge.subtask.copy(),
            "steps": judge.steps.copy(),
            "clipped": self._clipped.copy(),
            "reason": self._reason.copy(),
            "measures": {
                name: np.array(values) for name, values in verdict.measures.items()
            },
        }

    def _end(self) -> tuple[Observation, dict[str, Any]]:
        """Observation and info after a chunk, and autoreset of what is over."""
        images, ended, info = self.images == "always", self._over.copy(), {}
        if self.autoreset is AutoresetMode.SAME_STEP and ended.any():
            before, ids = self.observe(images), np.flatnonzero(ended)
            info = {
                "final_obs": np.full(self.num_envs, None, dtype=object),
                "final_info": _masked(self.facts(), ended),
            }
            for i in ids.tolist():
                info["final_obs"][i] = {
                    name: values[i].copy() for name, values in before.items()
                }
            info |= {f"_{name}": ended.copy() for name in info}
            self._begin(ids)
        return self.observe(images), info | _masked(
            self.facts(), np.ones(self.num_envs, dtype=bool)
        )

    def _mask_ids(self, mask: Any) -> np.ndarray:
        mask = np.asarray(mask)
        if mask.shape != (self.num_envs,) or mask.dtype != bool or not mask.any():
            raise TaccorlError(
                f"reset_mask: expected ({self.num_envs},) bool with at least one True, found {mask!r}"
            )
        return np.flatnonzero(mask)


def _one_of(what: str, value: Any, known: Sequence[Any]) -> None:
    if value not in known:
        raise TaccorlError(
            f"{what}: {value!r} does not exist; {nearest(str(value), map(str, known))}"
        )


def _each(
    facts: dict[str, Any], change: Callable[[np.ndarray], np.ndarray]
) -> dict[str, Any]:
    return {
        name: _each(v, change) if isinstance(v, dict) else change(v)
        for name, v in facts.items()
    }


def _rows_from(
    old: dict[str, Any], new: dict[str, Any], rows: np.ndarray
) -> dict[str, Any]:
    """``old`` with ``rows`` (N,) bool of ``new``."""
    merged = {}
    for name, values in new.items():
        if isinstance(values, dict):
            merged[name] = _rows_from(old[name], values, rows)
        else:
            merged[name] = old[name].copy()
            merged[name][rows] = values[rows]
    return merged


def _masked(info: dict[str, Any], mask: np.ndarray) -> dict[str, Any]:
    """With gymnasium's ``_name`` (N,) bool beside each entry: whose it is."""
    inner = {
        name: _masked(values, mask) if isinstance(values, dict) else values
        for name, values in info.items()
    }
    return inner | {f"_{name}": mask.copy() for name in info}

"""One twin as a gymnasium environment: ``gymnasium.make("taccorl.sim.env:taccorl/Assembly1-v0")``.

Importing this registers every task as ``taccorl/<Task>-v0``; ``gymnasium.make_vec`` gives the native vector environment.
"""

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode

from taccorl.sim.simulation import Simulation
from taccorl.sim.spaces import Observation
from taccorl.sim.task import tasks
from taccorl.sim.twin import CONTROL_HZ
from taccorl.sim.vector_env import TaccorlVectorEnv, shaped


class TaccorlEnv(gymnasium.Env):
    """``task`` in the twin, one simulation; ``TaccorlVectorEnv`` with N = 1, so equal to it bit for bit.

    Reward is 1 at the step that completes the task, else 0. Terminates with success or failure, truncates when time is up;
    after that the episode is frozen until ``reset``. ``reset(seed=s)`` gives the scene of seed s; without a seed the next one
    of the sequence ``episode_seed(s, 0, k)`` is used. ``info``: as in ``TaccorlVectorEnv``, one value each."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": CONTROL_HZ}  # noqa: RUF012

    def __init__(
        self,
        task: str,
        *,
        images: bool = True,
        render_mode: str | None = None,
        **settings: Any,
    ) -> None:
        """``settings`` and errors: ``TaccorlVectorEnv``."""
        one: dict[str, Any] = {
            "num_threads": 1,
            "autoreset": AutoresetMode.DISABLED,
            "render_mode": render_mode,
        }
        self._envs = TaccorlVectorEnv(
            task, images="always" if images else "never", **settings, **one
        )
        self.task, self.task_description, self.render_mode = (
            task,
            self._envs.task_description,
            render_mode,
        )
        self.observation_space = self._envs.single_observation_space
        self.action_space = self._envs.single_action_space

    @property
    def sim(self) -> Simulation:
        """The simulation, for snapshots and privileged state."""
        return self._envs.sim

    @property
    def _max_episode_steps(self) -> int:
        """LeRobot's evaluation asks for it by this name."""
        return self.sim.judge.limit_steps

    def reset(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode; returns observation and ``info``. ``options={"state": snapshot}`` begins it bit-exactly from the
        state that ``sim.snapshot()`` returned."""
        observation, _ = self._envs.reset(
            seed=None if seed is None else [seed], options=options
        )
        super().reset(seed=seed)
        return _only(observation), _only(self._envs.facts())

    def step(
        self, action: np.ndarray
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """One control step (1/30 s) with the targets ``action`` (14,) [rad, m].

        Returns observation, reward, terminated, truncated and ``info``, as gymnasium defines them. Raises TaccorlError:
        wrong shape, or a target that is NaN or far beyond the limits."""
        observation, reward, terminated, truncated, _ = self._envs.step(
            shaped(action)[None]
        )
        facts = _only(self._envs.facts())
        return (
            _only(observation),
            float(reward[0]),
            bool(terminated[0]),
            bool(truncated[0]),
            facts,
        )

    def render(self) -> np.ndarray | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The front camera's picture (224, 224, 3) uint8 RGB; None without ``render_mode``."""
        pictures = self._envs.render()
        return None if pictures is None else pictures[0].copy()

    def close(self) -> None:
        """Free OpenGL contexts. The environment cannot be used afterwards."""
        self._envs.close()


def _only(batch: dict[str, Any]) -> dict[str, Any]:
    """The one row of each array; single values as Python's own."""
    rows = {
        name: _only(values) if isinstance(values, dict) else values[0]
        for name, values in batch.items()
    }
    return {
        name: value.item() if isinstance(value, np.generic) else value
        for name, value in rows.items()
    }


def env_id(task: str) -> str:
    """Gymnasium's name of a task: ``test_tube`` → ``taccorl/TestTube-v0``."""
    return f"taccorl/{''.join(word.capitalize() for word in task.split('_'))}-v0"


def register_envs() -> None:
    """Register every task with gymnasium. A second call changes nothing."""
    for name in tasks:
        if env_id(name) not in gymnasium.registry:
            gymnasium.register(
                id=env_id(name),
                entry_point="taccorl.sim.env:TaccorlEnv",
                vector_entry_point="taccorl.sim.vector_env:TaccorlVectorEnv",
                max_episode_steps=round(tasks.get(name).time_limit_s * CONTROL_HZ),
                kwargs={"task": name},
            )


register_envs()

"""The twin's environments under the names that LeRobot's ``preprocess_observation`` reads (lerobot/envs/utils.py, 0.6.1).

LeRobot turns ``pixels/<camera>`` into ``observation.images.<camera>``, ``agent_pos`` into ``observation.state``, and puts
``observation.`` before any other name. Here, not in ``lerobot_plugin``, so that worker processes start without torch.
"""

from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np

from taccorl.robots import ROBOT
from taccorl.sim.env import TaccorlEnv
from taccorl.sim.part_poses import PARTS_KEY
from taccorl.sim.spaces import IMAGE_KEYS, STATE_KEY, TACTILE_KEY, Observation
from taccorl.sim.vector_env import TaccorlVectorEnv


def raw_names(observation: Observation) -> dict[str, Any]:
    """Return an observation, or a batch of them, under LeRobot's raw names: ``agent_pos``, ``tactile``, ``environment_state`` and
    ``pixels``; the last two only if it has part poses and pictures. Counts become float32, as LeRobot's recorder requires."""
    pixels = {
        name: observation[IMAGE_KEYS[name]]
        for name in ROBOT.cameras
        if IMAGE_KEYS[name] in observation
    }
    return {
        **({"pixels": pixels} if pixels else {}),
        **(
            {"environment_state": observation[PARTS_KEY]}
            if PARTS_KEY in observation
            else {}
        ),
        "agent_pos": observation[STATE_KEY],
        "tactile": observation[TACTILE_KEY].astype(np.float32),
    }


def _raw_space(space: gymnasium.Space) -> gymnasium.spaces.Dict:
    assert isinstance(space, gymnasium.spaces.Dict)
    counts = space[TACTILE_KEY]
    assert isinstance(counts, gymnasium.spaces.Box)
    tactile = gymnasium.spaces.Box(
        counts.low.astype(np.float32), counts.high.astype(np.float32)
    )
    pixels = gymnasium.spaces.Dict(
        {name: space[IMAGE_KEYS[name]] for name in ROBOT.cameras}
    )
    parts = {"environment_state": space[PARTS_KEY]} if PARTS_KEY in space.spaces else {}
    return gymnasium.spaces.Dict(
        {"pixels": pixels, "agent_pos": space[STATE_KEY], "tactile": tactile, **parts}
    )


class _Raw(gymnasium.Env if TYPE_CHECKING else object):
    """Raw names in what ``reset`` and ``step`` of the next class return."""

    def reset(self, **arguments: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        observation, info = super().reset(**arguments)
        return raw_names(observation), info

    def step(self, action: np.ndarray) -> Any:
        observation, *others = super().step(action)
        return raw_names(observation), *others


class LeRobotEnv(_Raw, TaccorlEnv):
    """``TaccorlEnv`` with LeRobot's raw names; observations always have pictures."""

    def __init__(self, task: str, **settings: Any) -> None:
        super().__init__(task, images=True, **settings)
        self.observation_space = _raw_space(self.observation_space)


class LeRobotVectorEnv(_Raw, TaccorlVectorEnv):  # pyright: ignore[reportIncompatibleMethodOverride, reportIncompatibleVariableOverride]
    """``TaccorlVectorEnv`` with LeRobot's raw names; observations always have pictures.

    A finished episode is frozen: LeRobot's rollout steps until all episodes have finished, and ignores the steps of an episode
    after its end."""

    def __init__(self, task: str, num_envs: int, **settings: Any) -> None:
        super().__init__(
            task,
            num_envs,
            images="always",
            autoreset=gymnasium.vector.AutoresetMode.DISABLED,
            **settings,
        )
        self.single_observation_space = _raw_space(self.single_observation_space)
        self.observation_space = gymnasium.vector.utils.batch_space(
            self.single_observation_space, num_envs
        )

"""The twin as LeRobot's environment: ``lerobot-eval --policy.path=… --env.type=taccorl --env.task=assembly_2``.

A policy receives ``observation.state``, ``observation.images.front|left_wrist|right_wrist`` and ``observation.tactile``.
"""

import os
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import gymnasium
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig

from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT

# The simulation is imported when an environment is made: lerobot-train loads this plug-in even where it needs none.
_IMAGES = {
    f"observation.images.{name}": PolicyFeature(FeatureType.VISUAL, (224, 224, 3))
    for name in ROBOT.cameras
}
_FEATURES = {
    "action": PolicyFeature(FeatureType.ACTION, (ROBOT.num_actions,)),
    "agent_pos": PolicyFeature(FeatureType.STATE, (ROBOT.num_actions,)),
    "tactile": PolicyFeature(FeatureType.STATE, (ROBOT.num_taxels,)),
    **_IMAGES,
}
_FEATURES_MAP = {
    "action": "action",
    "agent_pos": "observation.state",
    "tactile": "observation.tactile",
    **{key: key for key in _IMAGES},
}
_PARTS = "environment_state"
_FPS = 30


@EnvConfig.register_subclass("taccorl")
@dataclass
class TaccorlEnvConfig(EnvConfig):
    """Settings of a task in the twin for LeRobot. Synchronous environments share one batch and its threads, asynchronous ones
    are processes."""

    task: str | None = "assembly_1"
    """A task of the twin, shipped or of your own; ``taccorl collect --help`` lists them."""
    fps: int = _FPS
    """Control steps per second; the twin supports no other value."""
    features: dict[str, PolicyFeature] = field(default_factory=lambda: dict(_FEATURES))
    """Name in the environment → type and shape of the feature."""
    features_map: dict[str, str] = field(default_factory=lambda: dict(_FEATURES_MAP))
    """Name in the environment → name in datasets and policies."""
    difficulty: str = "train"
    """Clearance on each side of mating parts: easy 1.0 mm, train 0.5 mm, hard 0.3 mm."""
    twin: str | None = None
    """Path of a twin.yaml; None: the nominal twin."""
    randomization: float = 1.0
    """Factor on the ranges from which a reset of the task draws, from 0 (always the nominal scene) to 1 (the full ranges)."""
    episode_length: int | None = None
    """Control steps after which an episode ends; None: the task's own time limit."""
    part_poses: bool = False
    """Observe the poses of the task's parts, too (``observation.environment_state``), for policies with --policy.part_poses."""
    physics: str = "c"
    """c: MuJoCo on the CPU; warp: MuJoCo Warp on a GPU (extra gpu). warp:device=cuda:1,contacts=128,constraints=512: settings."""

    def __post_init__(self) -> None:
        if self.fps != _FPS:
            raise TaccorlError(
                f"--env.fps={self.fps}: the twin makes {_FPS} control steps per second; remove it"
            )
        if self.part_poses:
            from taccorl.sim.part_poses import part_pose_names
            from taccorl.sim.task import tasks

            numbers = len(part_pose_names(tasks.get(str(self.task))))
            self.features[_PARTS] = PolicyFeature(FeatureType.ENV, (numbers,))
            self.features_map[_PARTS] = f"observation.{_PARTS}"

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Keyword arguments of one environment (``TaccorlEnv``): name → value."""
        return {
            "difficulty": self.difficulty,
            "twin": self.twin,
            "randomization": self.randomization,
            "max_episode_steps": self.episode_length,
            "render_mode": "rgb_array",
            "part_poses": self.part_poses,
            "physics": self.physics,
        }

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, gymnasium.vector.VectorEnv]]:
        """Create the environments: ``{"taccorl": {0: environments}}``, in LeRobot's form.

        LeRobot's own way, ``gymnasium.make`` in each worker, fails: workers do not know the plug-in's ids.

        Raises:
            TaccorlError: task or difficulty is unknown (the message names the nearest), or the twin cannot be read.
        """
        from taccorl.sim.lerobot_env import LeRobotEnv, LeRobotVectorEnv

        task, settings = str(self.task), self.gym_kwargs
        if use_async_envs and n_envs > 1:
            make = partial(LeRobotEnv, task, **settings)
            envs = gymnasium.vector.AsyncVectorEnv(
                [make] * n_envs,
                context="forkserver",
                autoreset_mode=gymnasium.vector.AutoresetMode.SAME_STEP,
            )
        else:
            num_threads = min(n_envs, len(os.sched_getaffinity(0)))
            envs = LeRobotVectorEnv(task, n_envs, num_threads=num_threads, **settings)
        return {self.type: {0: envs}}

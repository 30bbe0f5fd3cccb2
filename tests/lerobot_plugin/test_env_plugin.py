"""LeRobot finds ``--env.type=taccorl`` and makes environments of it; its policies get the names of the dataset."""

from dataclasses import dataclass

import numpy as np
import pytest
from lerobot.envs import make_env

from taccorl.errors import TaccorlError
from taccorl.lerobot_plugin.env import TaccorlEnvConfig
from taccorl.robots import ROBOT
from taccorl.sim.env import TaccorlEnv
from taccorl.sim.spaces import IMAGE_SHAPE
from tests.fresh_python import fresh_python

KEYS = {
    "observation.state",
    "observation.tactile",
    *(f"observation.images.{name}" for name in ROBOT.cameras),
}


def env_config(**settings):
    return TaccorlEnvConfig(**settings)


def test_command_line_becomes_the_config() -> None:
    import draccus
    from lerobot.envs.configs import EnvConfig

    import taccorl.lerobot_plugin  # noqa: F401

    @dataclass
    class Evaluation:
        env: EnvConfig

    said = {
        "type": "taccorl",
        "task": "assembly_2",
        "difficulty": "hard",
        "twin": "a/twin.yaml",
        "episode_length": 40,
    }
    config = draccus.parse(
        Evaluation, args=[f"--env.{name}={value}" for name, value in said.items()]
    ).env
    assert config == env_config(
        task="assembly_2", difficulty="hard", twin="a/twin.yaml", episode_length=40
    )
    assert config.type == "taccorl" and config.fps == 30
    with pytest.raises(TaccorlError, match="fps=50"):
        env_config(fps=50)


def test_features_are_those_of_the_dataset_spec() -> None:
    from lerobot.envs.utils import env_to_policy_features

    from taccorl.data.spec import find_spec, load_dataset_spec

    features = env_to_policy_features(env_config())
    spec = load_dataset_spec(find_spec("taccorl_bimanual"))
    wanted = {
        name: tuple(f.shape) for name, f in spec.features.items() if not f.optional
    }
    found = {name: f.shape for name, f in features.items()}
    for name, shape in wanted.items():
        assert found.pop(name) == (
            shape if len(shape) == 1 else (shape[2], *shape[:2])
        )  # LeRobot: channels first
    assert not found
    assert (
        wanted["observation.tactile"] == (ROBOT.num_taxels,)
        and wanted["observation.images.front"] == IMAGE_SHAPE
    )


@pytest.mark.parametrize(
    "in_processes", [False, pytest.param(True, marks=pytest.mark.slow)]
)
def test_lerobots_own_rollout_runs(in_processes: bool) -> None:
    """The loop of ``lerobot-eval``, with a policy that stays where it is."""
    import torch
    from lerobot.scripts.lerobot_eval import rollout

    class Stay(torch.nn.Module):
        seen: list[dict] = []  # noqa: RUF012

        def reset(self) -> None:
            self.seen.clear()

        def select_action(self, observation: dict) -> torch.Tensor:
            self.seen.append(observation)
            return observation["observation.state"]

    config, frames = env_config(task="assembly_1", episode_length=4), []
    envs = make_env(config, n_envs=2, use_async_envs=in_processes)["taccorl"][0]
    pipelines = config.get_env_processors()
    done = rollout(
        envs,
        Stay(),  # pyright: ignore[reportArgumentType]
        *pipelines,
        preprocessor=lambda batch: batch,  # pyright: ignore[reportArgumentType]
        postprocessor=lambda action: action,  # pyright: ignore[reportArgumentType]
        seeds=[1000, 1001],
        render_callback=lambda envs: frames.append(np.stack(envs.call("render"))),
    )
    assert (
        done["action"].shape == (2, 4, 14)
        and done["done"][:, -1].all()
        and not done["done"][:, :-1].any()
    )
    assert done["reward"].sum() == 0 and not done["success"].any()
    assert set(Stay.seen[0]) >= KEYS and Stay.seen[0]["task"][0].startswith(
        "insert the orange plug"
    )
    front = Stay.seen[0]["observation.images.front"]
    assert (
        front.shape == (2, 3, 224, 224)
        and front.dtype == Stay.seen[0]["observation.tactile"].dtype == torch.float32
    )
    assert 0.2 < float(front.mean()) < 0.8 < float(front.max()) <= 1
    assert [f.shape for f in frames] == [
        (2, 224, 224, 3)
    ] * 5 and envs.unwrapped.metadata["render_fps"] == 30
    envs.close()
    # Scenes are those of the seeds, and the same in one batch as in processes.
    single = TaccorlEnv("assembly_1", images=False)
    observation = single.reset(seed=1001)[0]
    for seen in Stay.seen:
        assert np.array_equal(
            seen["observation.tactile"][1].numpy(), observation["observation.tactile"]
        )
        assert np.array_equal(
            seen["observation.state"][1].numpy(), observation["observation.state"]
        )
        observation = single.step(observation["observation.state"])[0]


def test_unknown_task_is_named_with_its_neighbour() -> None:
    with pytest.raises(TaccorlError, match="no task 'puzle'; did you mean 'puzzle'"):
        make_env(env_config(task="puzle"))


@pytest.mark.slow
def test_loading_the_plugin_loads_no_simulator() -> None:
    code = (
        "import sys, lerobot.envs.configs, lerobot.policies; before = set(sys.modules); import taccorl.lerobot_plugin\n"
        "new = set(sys.modules) - before; assert all(m.startswith(('taccorl', 'lerobot.cameras')) for m in new), new\n"
        "assert 'mujoco' not in sys.modules\n"
    )
    assert fresh_python("-c", code).returncode == 0


def test_worker_processes_need_no_torch() -> None:
    code = "import sys, taccorl.sim.lerobot_env; assert not {'torch', 'lerobot'} & {m.split('.')[0] for m in sys.modules}"
    assert fresh_python("-c", code, MUJOCO_GL="egl").returncode == 0


def test_poses_of_the_parts_are_observed_on_request():
    plain, told = (
        TaccorlEnvConfig(task="test_tube"),
        TaccorlEnvConfig(task="test_tube", part_poses=True),
    )
    assert (
        "environment_state" not in plain.features and not plain.gym_kwargs["part_poses"]
    )
    assert told.features["environment_state"].shape == (
        27,
    )  # tube, rack and the stand, nine numbers each
    assert told.features_map["environment_state"] == "observation.environment_state"
    assert told.gym_kwargs["part_poses"]

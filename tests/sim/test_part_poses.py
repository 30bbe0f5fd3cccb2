"""Poses of the parts: in the order of the task, the simulator's own, and the same in rows and environments."""

import gymnasium
import numpy as np
import pytest

from taccorl.episodes.recorder import EpisodeRecorder, row_spec
from taccorl.sim.env import TaccorlEnv
from taccorl.sim.lerobot_env import raw_names
from taccorl.sim.part_poses import PARTS_KEY, part_pose_names, part_poses, posed_bodies
from taccorl.sim.simulation import Simulation
from taccorl.sim.task import tasks
from taccorl.sim.vector_env import TaccorlVectorEnv


@pytest.mark.parametrize("task", ["assembly_2", "test_tube"])
def test_numbers_are_the_simulators_poses(task):
    sim = Simulation(tasks.get(task)(), num_sims=2)
    sim.reset([3, 4])
    found, names = part_poses(sim), part_pose_names(sim.task)
    assert found.shape == (2, len(names)) and found.dtype == np.float32
    for k, body in enumerate(posed_bodies(sim.task)):
        assert names[9 * k] == f"{body}.x" and names[9 * k + 8] == f"{body}.r21"
        pose = sim.poses(body)
        expected = np.concatenate([pose[:, :3, 3], pose[:, :3, 0], pose[:, :3, 1]], axis=1).astype(np.float32)
        np.testing.assert_array_equal(found[:, 9 * k : 9 * k + 9], expected)
    assert not np.array_equal(found[0], found[1])


def test_rows_and_environments_have_the_same_numbers():
    """The same scene and actions; the row's poses are of the instant of its state, and can be had again from its sim.state."""
    envs = TaccorlVectorEnv("assembly_2", 2, part_poses=True, num_threads=1)
    observation, _ = envs.reset(seed=[5, 6])
    sim = Simulation(tasks.get("assembly_2")())
    spec = row_spec(sim, pictures=False, parts=True)
    assert spec.features[PARTS_KEY].names == part_pose_names(sim.task)
    sim.reset([5])
    recorder, seen = EpisodeRecorder(sim, spec), []
    actions = observation["observation.state"] + np.float32(0.05)
    for _ in range(4):
        seen.append((observation["observation.state"][0], observation[PARTS_KEY][0]))
        recorder.step(actions[0])
        observation = envs.step(actions)[0]
    arrays = recorder.episode("test", {}).arrays
    np.testing.assert_array_equal(arrays["observation.state"], np.stack([state for state, _ in seen]))
    np.testing.assert_array_equal(arrays[PARTS_KEY], np.stack([poses for _, poses in seen]))
    again = Simulation(tasks.get("assembly_2")())
    again.restore_rows(arrays["sim.state"][2:3], arrays["sim.seed"][2])
    np.testing.assert_allclose(part_poses(again)[0], arrays[PARTS_KEY][2], atol=1e-6)
    assert (np.abs(arrays[PARTS_KEY]) <= np.array(spec.features[PARTS_KEY].limits)[:, 1]).all()
    envs.close()


def test_environments_show_poses_on_request_only():
    env = TaccorlEnv("assembly_1", images=False)
    assert PARTS_KEY not in env.reset(seed=0)[0] and PARTS_KEY not in env.observation_space.spaces  # pyright: ignore
    told = TaccorlEnv("assembly_1", images=False, part_poses=True)
    observation, _ = told.reset(seed=0)
    assert told.observation_space.contains(observation) and observation[PARTS_KEY].shape == (18,)
    np.testing.assert_array_equal(observation[PARTS_KEY], part_poses(told.sim)[0])
    np.testing.assert_array_equal(raw_names(observation)["environment_state"], observation[PARTS_KEY])
    made = gymnasium.make("taccorl.sim.env:taccorl/Assembly1-v0", images=False, part_poses=True)
    assert PARTS_KEY in made.reset(seed=0)[0]
    for one in (env, told, made):
        one.close()

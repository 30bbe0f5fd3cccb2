"""The gymnasium environment keeps gymnasium's contract, repeats itself bit for bit, and says what is wrong with an action."""

import warnings
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from expert_episode import MIDDLE, SEED, expert_episode
from gymnasium.utils.env_checker import check_env

from taccorl.episodes.recorder import EpisodeRecorder, row_spec
from taccorl.errors import TaccorlError
from taccorl.sim.env import TaccorlEnv, env_id
from taccorl.sim.episode_seeds import episode_seed
from taccorl.sim.lerobot_env import raw_names
from taccorl.sim.part_poses import PARTS_KEY, part_pose_names, part_poses, posed_bodies
from taccorl.sim.simulation import Simulation
from taccorl.sim.task import tasks
from taccorl.sim.twin_file import load_twin
from taccorl.sim.vector_env import TaccorlVectorEnv

STATE, TACTILE = "observation.state", "observation.tactile"


@pytest.fixture(scope="module")
def env() -> TaccorlEnv:
    return TaccorlEnv("assembly_1", images=False)


def same(one: dict, other: dict) -> bool:
    return one.keys() == other.keys() and all(
        np.array_equal(one[k], other[k]) for k in one
    )


def test_gymnasium_checks_pass(env: TaccorlEnv) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Joint angles are neither bounded nor scaled to ±1: that is the robot's business, gymnasium only recommends it.
        warnings.filterwarnings(
            "ignore", message=".*infinity|.*symmetric and normalized"
        )
        warnings.filterwarnings("ignore", message=".*no render modes|.*render_mode")
        check_env(env, skip_render_check=True, skip_close_check=True)


def test_every_task_is_registered_with_its_own_time_limit() -> None:
    assert (
        env_id("test_tube") == "taccorl/TestTube-v0"
        and env_id("assembly_1") == "taccorl/Assembly1-v0"
    )
    for name in tasks:
        assert gymnasium.spec(env_id(name)).max_episode_steps == round(
            30 * tasks.get(name).time_limit_s
        )


def test_gymnasium_makes_one_and_many() -> None:
    one = gymnasium.make(
        "taccorl.sim.env:taccorl/Assembly1-v0", images=False, difficulty="easy"
    )
    assert (
        isinstance(one.unwrapped, TaccorlEnv)
        and one.unwrapped.sim.task.clearance_m == 0.001
    )
    many = gymnasium.make_vec("taccorl/Assembly1-v0", num_envs=2, num_threads=1)
    assert isinstance(many.unwrapped, TaccorlVectorEnv) and many.num_envs == 2
    observation, _ = many.reset(seed=[4, 5])
    assert same(
        {name: values[0] for name, values in observation.items()}, one.reset(seed=4)[0]
    )


def test_expert_actions_earn_one_reward_at_the_last_step(env: TaccorlEnv) -> None:
    episode = expert_episode()
    env.reset(options={"state": episode.middle})
    rewards, infos = [], []
    for action in episode.actions[MIDDLE:]:
        _, reward, terminated, truncated, info = env.step(action)
        rewards.append(reward)
        infos.append(info)
        assert truncated is False and terminated == info["is_success"]
    assert rewards[-1] == 1.0 and sum(rewards) == 1.0
    last = infos[-1]
    assert (
        last["is_success"] is True
        and last["failure"] == ""
        and last["partial"] == 1
        and last["seed"] == SEED
    )
    assert last["steps"] == len(episode.actions) and last["subtask"].tolist() == [2, 2]
    assert last["measures"]["depth_m"] > 0.034
    # The part was in place for 0.5 s, 15 control steps, before it counted.
    assert [info["is_success"] for info in infos[-16:]] == [False] * 15 + [True]


def test_an_episode_that_is_over_stands_still(env: TaccorlEnv) -> None:
    episode = expert_episode()
    env.reset(options={"state": episode.late})
    for action in episode.actions[-3:]:
        end = env.step(action)
    before = env.sim.snapshot().physics
    again = env.step(episode.actions[0])
    assert (
        same(end[0], again[0])
        and again[1] == 0.0
        and again[2] is True
        and again[4]["is_success"] is True
    )
    assert np.array_equal(env.sim.snapshot().physics, before)


def test_a_restored_success_is_not_rewarded_again(env: TaccorlEnv) -> None:
    episode = expert_episode()
    env.reset(options={"state": episode.late})
    for action in episode.actions[-3:]:
        env.step(action)
    env.reset(options={"state": env.sim.snapshot()})
    _, reward, terminated, _, _ = env.step(episode.actions[-1])
    assert reward == 0.0 and terminated is True


def test_an_episode_goes_on_bit_exactly_from_its_middle(env: TaccorlEnv) -> None:
    episode = expert_episode()
    env.reset(options={"state": episode.middle})
    straight = []
    for k, action in enumerate(episode.actions[MIDDLE : MIDDLE + 30]):
        if k == 17:
            state = env.sim.snapshot()
        straight.append(env.step(action))
    env.reset(seed=99)  # something else in between
    env.step(episode.actions[0])
    observation, info = env.reset(options={"state": state})
    assert (
        same(observation, straight[16][0])
        and info["steps"] == MIDDLE + 17
        and info["seed"] == SEED
    )
    for k in range(17, 30):
        observation, _, _, _, info = env.step(episode.actions[MIDDLE + k])
        assert same(observation, straight[k][0])
        assert info["measures"] == straight[k][4]["measures"]
    assert np.abs(observation[TACTILE]).max() > 30  # the pads did feel something


def test_pads_are_noisy_yet_repeatable(env: TaccorlEnv) -> None:
    first = env.reset(seed=3)[0]
    later = env.step(first[STATE])[0]
    assert not np.array_equal(
        first[TACTILE], later[TACTILE]
    )  # nothing touches: only noise differs
    # Noise of σ = 1.3 counts, then floor: √(1.3² + 1/12) = 1.33; n = 1536, so ± 5 % is two standard errors of σ.
    assert first[TACTILE].std() == pytest.approx(1.33, rel=0.15)
    assert same(env.reset(seed=3)[0], first) and same(env.step(first[STATE])[0], later)


def test_wrong_actions_are_named(env: TaccorlEnv) -> None:
    action = env.reset(seed=0)[0][STATE]
    with pytest.raises(
        TaccorlError, match=r"action: shape \(13,\), expected \(14\): left_joint1"
    ):
        env.step(action[:13])
    broken = action.copy()
    broken[9] = np.nan
    for bad, why in (
        (broken, "right_joint3 is nan"),
        (np.rad2deg(action), "Joints are in rad"),
    ):
        _, reward, terminated, truncated, info = env.step(bad)
        assert (reward, terminated, truncated) == (0.0, True, False)
        assert (
            info["failure"] == "bad_action"
            and why in info["reason"]
            and info["steps"] == 0
        )
        env.reset(seed=0)
    beyond = action.copy()
    beyond[6] = 0.2  # m; the gripper opens 0.07
    assert env.step(beyond)[4]["clipped"] is True
    assert (
        env.step(np.clip(action, env.action_space.low, env.action_space.high))[4][
            "clipped"
        ]
        is False
    )


def test_limits_of_the_action_space_are_within_reach_of_float32(
    env: TaccorlEnv,
) -> None:
    env.reset(seed=0)
    for _ in range(20):
        assert env.step(env.action_space.sample())[4]["clipped"] is False
    assert env.action_space.low.dtype == np.float32 and env.action_space.shape == (14,)


def test_wrong_settings_are_named(env: TaccorlEnv, tmp_path: Path) -> None:
    with pytest.raises(
        TaccorlError, match="no task 'asembly_1'; did you mean 'assembly_1'"
    ):
        TaccorlEnv("asembly_1")
    with pytest.raises(TaccorlError, match="no difficulty 'hrd'; did you mean 'hard'"):
        TaccorlEnv("assembly_1", difficulty="hrd")
    with pytest.raises(
        TaccorlError, match="reset option: 'sate' does not exist; did you mean 'state'"
    ):
        env.reset(options={"sate": None})
    with pytest.raises(TaccorlError, match=r"twin\.yaml"):
        TaccorlEnv("assembly_1", twin=tmp_path / "twin.yaml")
    with pytest.raises(TaccorlError, match=r"call reset\(\) first"):
        TaccorlEnv("assembly_1", images=False).step(np.zeros(14))


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"max_episode_steps": 0}, "max_episode_steps: 0 is no whole number ≥ 1"),
        ({"max_episode_steps": 2.5}, "max_episode_steps: 2.5 is no"),
        ({"randomization": 2.0}, r"randomization: 2\.0 .* give 0"),
        ({"seed": -1}, "seed: -1 is no whole number"),
        ({"seed": 2**63}, f"seed: {2**63} is no whole number"),
        ({"twin": {"robot": {}}}, r"twin: found \{'robot'.*give a TwinConfig"),
    ],
)
def test_settings_beyond_reason_are_named(settings: dict, said: str) -> None:
    with pytest.raises(TaccorlError, match=said):
        TaccorlEnv("bench", images=False, **settings)


def test_a_reset_that_is_refused_changes_nothing() -> None:
    env = TaccorlEnv("bench", images=False, seed=4)
    env.reset()
    before = env.sim.state_rows()
    other = TaccorlEnv("bench", images=False, randomization=0.5)
    other.reset()
    for arguments, said in (
        ({"options": {"state": 1}}, r"state: 1.*Snapshot; give.*sim\.snapshot\(\)"),
        (
            {"options": {"state": other.sim.snapshot()}},
            "another task, difficulty, twin or randomisation",
        ),
        ({"seed": -1}, "seed: -1 is no whole number"),
        ({"seed": 2**70}, f"seed: {2**70} is no whole number"),
    ):
        with pytest.raises(TaccorlError, match=said):
            env.reset(**arguments)
    np.testing.assert_array_equal(env.sim.state_rows(), before)
    assert env.reset()[1]["seed"] == episode_seed(
        4, 0, 1
    )  # and no seed of the stream was used up
    assert env.reset(seed=2**63 - 1)[1]["seed"] == 2**63 - 1


def test_a_closed_environment_frees_its_renderers_and_says_so(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    env, closed = TaccorlEnv("bench", images=False), []
    monkeypatch.setattr(env.sim, "close", lambda: closed.append("sim"))
    env.reset(seed=0)
    env.close()
    env.close()
    assert closed == ["sim"]
    for use in (env.reset, env.render, lambda: env.step(np.zeros(14))):
        with pytest.raises(
            TaccorlError, match="this environment was closed; make a new one"
        ):
            use()


def test_a_twin_without_a_camera_is_refused_only_where_pictures_are_wanted(
    tmp_path: Path,
) -> None:
    path = tmp_path / "twin.yaml"
    path.write_text("cameras: {front: null}\n")
    said = "twin.*camera front;.*left_wrist,.*images"
    with pytest.raises(TaccorlError, match=said):
        TaccorlEnv("bench", twin=path)
    with pytest.raises(TaccorlError, match=said):
        TaccorlEnv("bench", twin=path, images=False, render_mode="rgb_array")
    with pytest.raises(TaccorlError, match=said):
        TaccorlVectorEnv("bench", twin=path, images="on_request")
    TaccorlEnv("bench", twin=path, images=False).reset(seed=0)
    sim = Simulation(tasks.get("bench")(), load_twin(path))
    with pytest.raises(TaccorlError, match=said):
        row_spec(sim, pictures=True)
    row_spec(sim, pictures=False)


def test_a_twin_file_is_obeyed(tmp_path: Path) -> None:
    path = tmp_path / "twin.yaml"
    path.write_text("physics:\n  steps_per_control_step: 20\n")
    assert TaccorlEnv(
        "assembly_1", images=False, twin=str(path)
    ).sim.model.opt.timestep == pytest.approx(1 / 600)
    path.write_text("fizzics: 1\n")
    with pytest.raises(TaccorlError, match="fizzics"):
        TaccorlEnv("assembly_1", twin=path)


# ---- poses of the parts ----


@pytest.mark.parametrize("task", ["assembly_2", "test_tube"])
def test_numbers_are_the_simulators_poses(task):
    sim = Simulation(tasks.get(task)(), num_sims=2)
    sim.reset([3, 4])
    found, names = part_poses(sim), part_pose_names(sim.task)
    assert found.shape == (2, len(names)) and found.dtype == np.float32
    for k, body in enumerate(posed_bodies(sim.task)):
        assert names[9 * k] == f"{body}.x" and names[9 * k + 8] == f"{body}.r21"
        pose = sim.poses(body)
        expected = np.concatenate(
            [pose[:, :3, 3], pose[:, :3, 0], pose[:, :3, 1]], axis=1
        ).astype(np.float32)
        np.testing.assert_array_equal(found[:, 9 * k : 9 * k + 9], expected)
    assert not np.array_equal(found[0], found[1])


def test_rows_and_environments_have_the_same_numbers():
    """An environment and the recorder of datasets get the same scene and actions. Each row holds the poses of the parts at the
    time of its joint state, and a simulation restored to the row's ``sim.state`` has the same poses."""
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
    np.testing.assert_array_equal(
        arrays["observation.state"], np.stack([state for state, _ in seen])
    )
    np.testing.assert_array_equal(
        arrays[PARTS_KEY], np.stack([poses for _, poses in seen])
    )
    again = Simulation(tasks.get("assembly_2")())
    again.restore_rows(arrays["sim.state"][2:3], arrays["sim.seed"][2])
    np.testing.assert_allclose(part_poses(again)[0], arrays[PARTS_KEY][2], atol=1e-6)
    assert (
        np.abs(arrays[PARTS_KEY]) <= np.array(spec.features[PARTS_KEY].limits)[:, 1]
    ).all()
    envs.close()


def test_environments_show_poses_on_request_only():
    env = TaccorlEnv("assembly_1", images=False)
    assert (
        PARTS_KEY not in env.reset(seed=0)[0]
        and PARTS_KEY not in env.observation_space.spaces
    )  # pyright: ignore
    told = TaccorlEnv("assembly_1", images=False, part_poses=True)
    observation, _ = told.reset(seed=0)
    assert told.observation_space.contains(observation) and observation[
        PARTS_KEY
    ].shape == (18,)
    np.testing.assert_array_equal(observation[PARTS_KEY], part_poses(told.sim)[0])
    np.testing.assert_array_equal(
        raw_names(observation)["environment_state"], observation[PARTS_KEY]
    )
    made = gymnasium.make(
        "taccorl.sim.env:taccorl/Assembly1-v0", images=False, part_poses=True
    )
    assert PARTS_KEY in made.reset(seed=0)[0]
    for one in (env, told, made):
        one.close()

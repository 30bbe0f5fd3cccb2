"""N environments in one batch equal N single ones, bit for bit, whatever the company, the threads, the chunks and the faults."""

from collections.abc import Sequence

import numpy as np
import pytest
from expert_episode import MIDDLE, SEED, ExpertEpisode, expert_episode, together
from gymnasium.vector import AutoresetMode

from taccorl.errors import TaccorlError
from taccorl.sim.env import TaccorlEnv
from taccorl.sim.simulation import Simulation
from taccorl.sim.vector_env import TaccorlVectorEnv

STATE, TACTILE, FRONT = (
    "observation.state",
    "observation.tactile",
    "observation.images.front",
)
NUM_STEPS = 12


def vector(num_envs: int, **settings) -> TaccorlVectorEnv:
    return TaccorlVectorEnv("assembly_1", num_envs, **{"num_threads": 1} | settings)


def for_all(actions: np.ndarray, num_envs: int) -> np.ndarray:
    """(H, 14) → (N, H, 14)."""
    return np.repeat(actions[None], num_envs, axis=0)


def row(batch: dict, i: int) -> dict:
    return {
        name: values[i] for name, values in batch.items() if not name.startswith("_")
    }


def same(one: dict, other: dict) -> bool:
    """Bit for bit, nested."""
    return one.keys() == other.keys() and all(
        same(one[k], other[k])
        if isinstance(one[k], dict)
        else np.array_equal(one[k], other[k])
        for k in one
    )


@pytest.fixture(scope="module")
def episode() -> ExpertEpisode:
    return expert_episode()


@pytest.fixture(scope="module")
def alone(episode: ExpertEpisode) -> list[list[dict]]:
    """What single environments observe: scenes 7, 8, 9 from their beginning, and the expert's from its middle."""
    env = TaccorlEnv("assembly_1", images=False)
    runs = []
    for start, actions in [
        *(({"seed": s}, episode.actions) for s in (7, 8, 9)),
        ({}, episode.actions[MIDDLE:]),
    ]:
        options = {} if start else {"state": episode.middle}
        observations = [env.reset(**start, options=options)[0]]
        observations += [env.step(action)[0] for action in actions[:NUM_STEPS]]
        runs.append(observations)
    return runs


@pytest.mark.parametrize(
    ("num_envs", "num_threads"), [(1, 1), (3, 1), (3, 2), (8, 1), (8, 2)]
)
def test_company_and_threads_change_no_bit(num_envs, num_threads, alone, episode):
    envs = vector(num_envs, num_threads=num_threads)
    observation, _ = envs.reset(seed=[7 + i for i in range(num_envs)])
    for k in range(NUM_STEPS + 1):
        for i in range(min(num_envs, 3)):
            assert same(row(observation, i), alone[i][k]), (i, k)
        observation = envs.step(np.repeat(episode.actions[None, k], num_envs, axis=0))[
            0
        ]
    observation, _ = envs.reset(
        options={"state": together(*[episode.middle] * num_envs)}
    )
    for k in range(NUM_STEPS):
        assert same(row(observation, num_envs - 1), alone[3][k]), k
        observation = envs.step(
            np.repeat(episode.actions[None, MIDDLE + k], num_envs, axis=0)
        )[0]
    assert (
        np.abs(observation[TACTILE][-1]).max() > 30
    )  # and there was something to feel


def test_a_chunk_equals_its_single_steps(episode):
    by_chunk, by_step = vector(3), vector(3)
    state = together(*[episode.middle] * 3)
    for envs in (by_chunk, by_step):
        envs.reset(seed=1, options={"state": state})
    actions = (
        for_all(episode.actions[MIDDLE : MIDDLE + 8], 3)
        + np.linspace(0, 0.01, 3)[:, None, None]
    )
    chunk = by_chunk.step_chunk(actions)
    steps = [by_step.step(actions[:, k]) for k in range(8)]
    assert same(chunk.observation, steps[-1][0]) and same(chunk.info, steps[-1][4])
    assert np.array_equal(
        chunk.tactile, np.stack([s[0][TACTILE] for s in steps], axis=1)
    )
    assert chunk.num_steps.tolist() == [8, 8, 8] and chunk.reward.tolist() == [0, 0, 0]
    assert not np.array_equal(chunk.observation[STATE][0], chunk.observation[STATE][2])


def test_success_within_a_chunk_counts_once_and_the_rest_of_it_is_not_carried_out(
    episode,
):
    envs, single = vector(2), TaccorlEnv("assembly_1", images=False)
    envs.reset(seed=[3, 4], options={"state": together(episode.late, episode.middle)})
    actions = np.stack(
        [
            np.r_[episode.actions[-3:], episode.actions[:5]],
            episode.actions[MIDDLE : MIDDLE + 8],
        ]
    )
    chunk = envs.step_chunk(actions)
    assert chunk.num_steps.tolist() == [3, 8] and chunk.reward.tolist() == [1.0, 0.0]
    assert chunk.terminated.tolist() == [True, False] and chunk.truncated.tolist() == [
        False,
        False,
    ]
    single.reset(options={"state": episode.late})
    for action in episode.actions[-3:]:
        end = single.step(action)
    assert (
        same(chunk.info["final_obs"][0], end[0]) and chunk.info["final_obs"][1] is None
    )
    assert np.array_equal(
        chunk.tactile[0, 2:], np.repeat(end[0][TACTILE][None], 6, axis=0)
    )
    final = chunk.info["final_info"]
    assert final["is_success"].tolist() == [True, False] and final[
        "_is_success"
    ].tolist() == [True, False]
    assert final["steps"][0] == len(episode.actions) and final["seed"][0] == SEED
    assert chunk.info["is_success"].tolist() == [False, False] and chunk.info[
        "steps"
    ].tolist() == [0, MIDDLE + 8]
    fresh = single.reset(seed=int(chunk.info["seed"][0]))[0]
    assert same(row(chunk.observation, 0), fresh)
    # The one that was reset goes on as a fresh one does.
    observation = envs.step(episode.actions[:2])[0]
    assert same(row(observation, 0), single.step(episode.actions[0])[0])


def test_autoreset_happens_in_the_step_that_ends_an_episode(episode):
    envs, frozen = (
        vector(2, max_episode_steps=3),
        vector(2, max_episode_steps=3, autoreset=AutoresetMode.DISABLED),
    )
    assert envs.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    for e in (envs, frozen):
        e.reset(seed=5)
        e.step(episode.actions[:2])
        e.step(episode.actions[:2])
    before = frozen.step(episode.actions[:2])
    observation, reward, terminated, truncated, info = envs.step(episode.actions[:2])
    assert truncated.all() and not terminated.any() and not reward.any()
    assert all(same(info["final_obs"][i], row(before[0], i)) for i in range(2))
    assert info["final_info"]["failure"].tolist() == ["timeout", "timeout"]
    assert info["failure"].tolist() == ["", ""] and info["steps"].tolist() == [0, 0]
    single = TaccorlEnv("assembly_1", images=False)
    assert all(
        same(row(observation, i), single.reset(seed=int(info["seed"][i]))[0])
        for i in range(2)
    )
    assert not envs.step(episode.actions[:2])[3].any()


def test_without_autoreset_what_is_over_waits_for_the_mask(episode):
    envs = vector(2, autoreset=AutoresetMode.DISABLED)
    envs.reset(seed=1, options={"state": together(episode.late, episode.middle)})
    ended = envs.step_chunk(for_all(episode.actions[-3:], 2))
    still = envs.step_chunk(for_all(episode.actions[:2], 2))
    assert ended.terminated.tolist() == still.terminated.tolist() == [True, False]
    assert (
        ended.reward.tolist() == [1, 0]
        and still.reward.tolist() == [0, 0]
        and still.num_steps.tolist() == [0, 2]
    )
    assert (
        same(row(ended.observation, 0), row(still.observation, 0))
        and "final_obs" not in still.info
    )
    assert not np.array_equal(ended.observation[STATE][1], still.observation[STATE][1])
    observation, info = envs.reset(options={"reset_mask": np.array([True, False])})
    assert info["steps"].tolist() == [0, MIDDLE + 5] and info["_steps"].tolist() == [
        True,
        False,
    ]
    assert same(row(observation, 1), row(still.observation, 1))
    assert not envs.step(episode.actions[:2])[2].any()


def test_seeds_are_a_function_of_root_environment_and_episode(episode):
    def expected(root: int, i: int, k: int) -> int:
        return int(np.random.SeedSequence(root, spawn_key=(i, k)).generate_state(1)[0])

    for num_envs in (2, 3):
        envs = vector(num_envs, max_episode_steps=1)
        seeds = [envs.reset(seed=11)[1]["seed"]]
        for _ in range(2):
            seeds.append(
                envs.step(np.repeat(episode.actions[:1], num_envs, axis=0))[4]["seed"]
            )
        assert np.stack(seeds).T.tolist() == [
            [expected(11, i, k) for k in range(3)] for i in range(num_envs)
        ]
    envs = vector(2, max_episode_steps=1)
    first = envs.reset(seed=[20, 30])[1]["seed"].tolist()
    second = envs.step(episode.actions[:2])[4]["seed"].tolist()
    assert first == [20, 30] and second == [expected(20, 0, 1), expected(30, 0, 1)]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("broken", ["qpos", "qvel"])
def test_a_diverged_simulation_fails_alone(broken, episode):
    healthy, ill = vector(3), vector(3)
    runs: dict[str, list] = {"healthy": [], "ill": []}
    for name, envs in (("healthy", healthy), ("ill", ill)):
        envs.reset(
            seed=[SEED, 2, 3], options={"state": together(*[episode.middle] * 3)}
        )
        for k in range(6):
            if name == "ill" and k == 2:
                envs.sim.arrays[broken][1, 20] = np.nan
            runs[name].append(
                envs.step(np.repeat(episode.actions[None, MIDDLE + k], 3, axis=0))
            )
    for k in range(6):
        for i in (0, 2):
            assert same(row(runs["ill"][k][0], i), row(runs["healthy"][k][0], i)), (
                k,
                i,
            )
    _, reward, terminated, truncated, info = runs["ill"][2]
    assert (
        terminated.tolist() == [False, True, False]
        and not truncated.any()
        and not reward.any()
    )
    assert (
        info["final_info"]["failure"][1] == "diverged"
        and info["final_info"]["seed"][1] == SEED
    )
    assert same(
        info["final_obs"][1], row(runs["ill"][1][0], 1)
    )  # its last sound observation
    # Its next episode is as if nothing had happened.
    single = TaccorlEnv("assembly_1", images=False)
    assert same(row(runs["ill"][2][0], 1), single.reset(seed=int(info["seed"][1]))[0])
    for k in range(3, 6):
        assert same(
            row(runs["ill"][k][0], 1), single.step(episode.actions[MIDDLE + k])[0]
        )


class Camera:
    """Stands in for OpenGL: every picture shows the number of its simulation and how often it was taken."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.asked: list[list[int]] = []
        monkeypatch.setattr(
            Simulation, "render", lambda sim, *args: self.render(sim, *args)
        )

    def render(
        self, sim: Simulation, cameras: Sequence[str], ids: np.ndarray | None = None
    ) -> dict[str, np.ndarray]:
        ids = np.arange(sim.num_sims) if ids is None else ids
        self.asked.append(ids.tolist())
        pictures = np.zeros((len(ids), 224, 224, 3), np.uint8)
        pictures += (10 * ids + len(self.asked))[:, None, None, None].astype(np.uint8)
        return {name: pictures.copy() for name in cameras}


def test_pictures_are_taken_only_when_asked_for(monkeypatch, episode):
    camera = Camera(monkeypatch)
    envs = vector(2, images="on_request")
    observation, _ = envs.reset(seed=0)
    chunk = envs.step_chunk(for_all(episode.actions[:3], 2))
    assert (
        not camera.asked and FRONT not in observation and FRONT not in chunk.observation
    )
    assert FRONT not in envs.observation_space.spaces
    seen = envs.observe(images=True)
    assert camera.asked == [[0, 1]] and seen[FRONT][:, 0, 0, 0].tolist() == [1, 11]
    assert (
        same(envs.observe(images=True), seen) and len(camera.asked) == 1
    )  # nothing has moved
    never = vector(2)
    never.reset(seed=0)
    with pytest.raises(TaccorlError, match="on_request"):
        never.observe(images=True)


def test_a_chunk_takes_one_picture_and_one_more_of_what_ended(monkeypatch, episode):
    camera = Camera(monkeypatch)
    envs = vector(2, images="always", render_mode="rgb_array")
    first, _ = envs.reset(
        seed=0, options={"state": together(episode.late, episode.middle)}
    )
    assert first in envs.observation_space
    chunk = envs.step_chunk(for_all(episode.actions[-3:], 2))
    assert camera.asked == [[0, 1], [0, 1], [0]]
    assert chunk.info["final_obs"][0][FRONT][0, 0, 0] == 2  # before the reset
    assert chunk.observation[FRONT][:, 0, 0, 0].tolist() == [3, 12]  # after it
    assert first[FRONT][:, 0, 0, 0].tolist() == [
        1,
        11,
    ]  # handed out, not written to again
    frames = envs.render()
    assert (
        frames is not None
        and [f[0, 0, 0] for f in frames] == [3, 12]
        and len(camera.asked) == 3
    )


def test_what_stands_still_is_not_drawn_again(monkeypatch, episode):
    camera = Camera(monkeypatch)
    envs = vector(2, images="always", autoreset=AutoresetMode.DISABLED)
    envs.reset(seed=0, options={"state": together(episode.late, episode.middle)})
    seen = [
        envs.step_chunk(for_all(episode.actions[-3:], 2)).observation[FRONT]
        for _ in range(2)
    ]
    assert camera.asked == [[0, 1], [0, 1], [1]]
    assert [pictures[:, 0, 0, 0].tolist() for pictures in seen] == [[2, 12], [2, 13]]


def test_wrong_input_is_named(episode):
    with pytest.raises(
        TaccorlError, match="images: 'alway' does not exist; did you mean 'always'"
    ):
        vector(1, images="alway")
    envs = vector(2)
    with pytest.raises(TaccorlError, match=r"call reset\(\) first"):
        envs.step(episode.actions[:2])
    with pytest.raises(TaccorlError, match="remove reset_mask"):
        envs.reset(options={"reset_mask": np.array([True, False])})
    with pytest.raises(TaccorlError, match=r"seed: \[1, 2, 3\] is neither"):
        envs.reset(seed=[1, 2, 3])
    with pytest.raises(TaccorlError, match="seed: -4 is no whole number"):
        vector(1, seed=-4)
    envs.reset(seed=0)
    for wrong in (episode.actions[:3], episode.actions[0], episode.actions[:2, :13]):
        with pytest.raises(TaccorlError, match=r"action: shape .* expected \(2, 14\)"):
            envs.step(wrong)
    with pytest.raises(TaccorlError, match=r"expected \(2, H, 14\)"):
        envs.step_chunk(np.zeros((2, 0, 14)))
    with pytest.raises(TaccorlError, match="reset_mask"):
        envs.reset(options={"reset_mask": np.array([0, 1])})


def test_calls_answer_for_every_environment():
    envs = vector(3)
    assert (
        envs.call("task_description")
        == ("insert the orange plug into the grey socket in the air",) * 3
    )
    assert envs.get_attr("_max_episode_steps") == (900, 900, 900)


def test_a_bad_action_ends_its_own_episode_and_is_not_carried_out(episode):
    healthy, ill = vector(3), vector(3)
    actions = for_all(episode.actions[MIDDLE : MIDDLE + 4], 3)
    broken = actions.copy()
    broken[1, 2, 9], broken[2, 3, 1] = np.nan, 90.0  # degrees
    chunks = []
    for envs, given in ((healthy, actions), (ill, broken)):
        envs.reset(
            seed=[SEED, 2, 3], options={"state": together(*[episode.middle] * 3)}
        )
        chunks.append(envs.step_chunk(given))
    sound, chunk = chunks
    assert chunk.num_steps.tolist() == [4, 2, 3] and not chunk.reward.any()
    assert (
        chunk.terminated.tolist() == [False, True, True] and not chunk.truncated.any()
    )
    final = chunk.info["final_info"]
    assert final["failure"].tolist() == ["", "bad_action", "bad_action"]
    assert (
        final["reason"][1].startswith("action: right_joint3 is nan")
        and "left_joint2 is 90" in final["reason"][2]
    )
    assert final["steps"].tolist() == [MIDDLE + 4, MIDDLE + 2, MIDDLE + 3]
    assert same(row(chunk.observation, 0), row(sound.observation, 0))
    # What came before the bad action was carried out, and the pads stand still after it.
    assert np.array_equal(chunk.tactile[1, :2], sound.tactile[1, :2])
    assert np.array_equal(
        chunk.tactile[1, 2:], np.repeat(sound.tactile[1, 1:2], 2, axis=0)
    )
    assert chunk.info["failure"].tolist() == ["", "", ""] and chunk.info[
        "reason"
    ].tolist() == ["", "", ""]
    single = TaccorlEnv("assembly_1", images=False)
    assert same(
        row(chunk.observation, 1), single.reset(seed=int(chunk.info["seed"][1]))[0]
    )


def test_an_episode_that_is_over_takes_any_action_without_autoreset(episode):
    envs = vector(2, autoreset=AutoresetMode.DISABLED)
    envs.reset(seed=0)
    nonsense = np.full((2, 1, 14), np.nan)
    assert envs.step_chunk(nonsense).terminated.all()
    still = envs.step_chunk(nonsense)
    assert (
        still.num_steps.tolist() == [0, 0]
        and still.info["failure"].tolist() == ["bad_action"] * 2
    )

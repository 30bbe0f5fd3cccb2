"""Rollouts beside evaluation: the same input, the same actions without noise, the same touch; and exact resuming."""

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode
from tiny_checkpoint import write_checkpoint

from taccorl.errors import TaccorlError
from taccorl.evaluation.policy_actor import open_checkpoint
from taccorl.policies.tactile_pi05.image_randomization import PICTURES_CHANGED
from taccorl.policies.tactile_pi05.scene_pictures import ScenePictures
from taccorl.rl import checkpoint, start_states
from taccorl.rl.flow_policy import TactileFlowPolicy
from taccorl.rl.flow_sde import FlowSDE
from taccorl.rl.rollout import Clock
from taccorl.rl.settings import EnvSettings, FlowSDESettings, PolicySettings
from taccorl.rl.shards import LocalShard
from taccorl.rl.start_states import StartStates
from taccorl.rl.twin_shard import TwinShard
from taccorl.rl.twin_world import TwinWorld
from taccorl.sim.episode_seeds import episode_seed
from taccorl.sim.vector_env import TaccorlVectorEnv

N = 2
TOUCH = "observation.tactile"


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory) -> Any:
    return open_checkpoint(
        write_checkpoint(tmp_path_factory.mktemp("checkpoint")), "cpu"
    )


@pytest.fixture(scope="module")
def envs() -> Iterator[TaccorlVectorEnv]:
    made = envs_of(N, 12)
    yield made
    made.close()


def envs_of(num: int, steps: int) -> TaccorlVectorEnv:
    still = {"autoreset": AutoresetMode.DISABLED, "num_threads": 1}
    return TaccorlVectorEnv(
        "assembly_2", num, images="on_request", max_episode_steps=steps, **still
    )


def make_world(
    envs: TaccorlVectorEnv,
    opened: Any,
    seed: int = 5,
    privileged: bool = True,
    **other: Any,
) -> TwinWorld:
    return world_of([envs], opened, seed, privileged=privileged, **other)


def world_of(
    all_envs: list[TaccorlVectorEnv],
    opened: Any,
    seed: int = 5,
    *,
    privileged: bool = True,
    share: float = 0.0,
    size: int = 1,
    history: int = 10,
    stride: int = 1,
    num_actions: int = 1,
    pictures: str = "clear",
) -> TwinWorld:
    first, shards = 0, []
    for envs in all_envs:
        options = {
            "history": history,
            "stride": stride,
            "num_actions": num_actions,
            "privileged": privileged,
            "starts": StartStates(share, size),
        }
        shards.append(LocalShard(partial(TwinShard, envs, first=first, **options)))
        first += envs.num_envs
    changes = (
        ScenePictures.of_policy(opened.config) if pictures == "randomised" else None
    )
    made = TwinWorld(shards, opened, Clock(), changes)
    made.restart(seed)
    return made


def twins(world: TwinWorld) -> TwinShard:
    """Those of the first shard."""
    (shard, *_) = world.shards
    assert isinstance(shard, LocalShard)
    return shard.twins


def home(world: TwinWorld, n: int = 5) -> torch.Tensor:
    """Chunks that the postprocessor turns into the state: both are normalised by the same limits."""
    return world.observe().batch["observation.state"][:, None].expand(-1, n, -1)


@pytest.mark.parametrize("pictures", ["clear", "randomised"])
def test_without_noise_actions_are_those_of_evaluation(envs, opened, pictures):
    """Two chunks of five steps through ``select_action`` and through a rollout, from the same noise."""
    actor = opened.load(0)
    noise = [
        torch.randn(N, 10, 32, generator=torch.Generator().manual_seed(k))
        for k in range(2)
    ]
    world = make_world(envs, opened, pictures=pictures)
    given = iter(noise)
    actor.policy.model.sample_noise = lambda shape, device: next(given)
    actor.begin(envs, pictures)
    observation, expected, windows = envs.observe(images=True), [], []
    for _ in range(10):
        views = envs.observe(images=True)
        expected.append(actor.act({**views, **observation}).actions)
        windows.append(torch.stack(list(actor.policy._felt[TOUCH])))
        observation = envs.step(expected[-1].astype(np.float32))[0]

    policy = TactileFlowPolicy(actor.policy, PolicySettings(), num_steps=4)
    world.restart(5)
    executed: list[np.ndarray] = []
    step = envs.step_chunk

    def noted(actions: np.ndarray, **options: Any) -> Any:
        executed.append(actions.copy())
        return step(actions, **options)

    envs.step_chunk = noted  # pyright: ignore
    quiet = FlowSDE(FlowSDESettings(level=0.0))
    for k in range(2):
        seen = world.observe().batch
        assert (PICTURES_CHANGED in seen) == (pictures == "randomised")
        filled = torch.cat(
            [windows[5 * k][:1]] * (10 - len(windows[5 * k])) + [windows[5 * k]]
        ).transpose(0, 1)
        assert torch.equal(seen[TOUCH], filled)
        draws = quiet.draw(N, (10, 32), torch.Generator())._replace(
            initial_BHD=noise[k]
        )
        world.act(policy.actions(policy.sample(seen, quiet, draws)[0].chunk_BHD))
    envs.step_chunk = step  # pyright: ignore
    np.testing.assert_allclose(
        np.concatenate(executed, 1), np.stack(expected, 1), atol=2e-6
    )


def test_ratios_of_randomised_pictures_are_1_before_the_first_update(envs, opened):
    """The stored pictures are scored as they were seen: whole values, cropped and changed once."""
    world, policy = (
        make_world(envs, opened, pictures="randomised"),
        opened.load(0).policy,
    )
    actor, sde = (
        TactileFlowPolicy(policy, PolicySettings(), num_steps=4),
        FlowSDE(FlowSDESettings(level=0.5)),
    )
    seen, clear = world.observe().batch, make_world(envs, opened).observe().batch
    draws = actor.draw(N, sde, torch.Generator().manual_seed(3))
    sampled, _ = actor.sample(seen, sde, draws)
    scored = actor.log_prob(
        seen, sde, sampled.before_BSHD, sampled.after_BSHD, draws.step_BS
    )
    torch.testing.assert_close(scored, sampled.log_prob_B, rtol=0, atol=1e-5)
    front = "observation.images.front"
    assert seen[front].dtype == torch.uint8 and seen[front].shape == (
        N,
        3,
        *policy.config.image_resolution,
    )
    assert clear[front].shape[-2:] == (224, 224) and PICTURES_CHANGED not in clear
    picture = policy._preprocess_images(
        {k: x / 255 if x.dtype == torch.uint8 else x for k, x in seen.items()}
    )[0][0]
    torch.testing.assert_close(picture, 2 * (seen[front] / 255) - 1, rtol=0, atol=1e-6)


def test_time_limit_gives_the_last_observation_before_the_reset(envs, opened):
    """12 control steps, 5 a chunk: the third chunk ends after two."""
    world = make_world(envs, opened)
    first = world.observe()
    for _ in range(2):
        acted = world.act(home(world))
        assert (
            acted.last is None
            and acted.outcome_N.tolist() == [None, None]
            and not acted.truncated_N.any()
        )
    acted = world.act(home(world) + 0.3)
    assert (
        acted.truncated_N.all()
        and not acted.terminated_N.any()
        and acted.outcome_N.tolist() == ["timeout", "timeout"]
    )
    assert acted.last is not None and acted.reward_N.tolist() == [0, 0]
    now = world.observe()
    assert not torch.equal(
        acted.last.batch["observation.state"], now.batch["observation.state"]
    )
    assert (
        not torch.equal(acted.last.privileged_NP, now.privileged_NP)
        and now.privileged_NP.shape == first.privileged_NP.shape
    )
    assert envs.facts()["seed"].tolist() == [episode_seed(5, i, 1) for i in range(N)]
    assert torch.equal(
        now.batch[TOUCH][:, :1].expand(-1, 10, -1), now.batch[TOUCH]
    )  # the past is forgotten


@pytest.mark.parametrize(("history", "stride"), [(10, 1), (3, 4)])
def test_readings_after_the_end_are_not_in_the_last_window(
    envs, opened, history, stride
):
    world = make_world(envs, opened, history=history, stride=stride)
    assert world.observe().batch[TOUCH].shape == (N, history, 1536)
    readings = [envs.observe()[TOUCH]]
    step = envs.step_chunk

    def keep(actions: np.ndarray, **options: Any) -> Any:
        chunk = step(actions, **options)
        readings.extend(chunk.tactile[:, k] for k in range(int(chunk.num_steps[0])))
        return chunk

    envs.step_chunk = keep  # pyright: ignore
    acted = [world.act(home(world)) for _ in range(3)][-1]
    envs.step_chunk = step  # pyright: ignore
    assert acted.last is not None and len(readings) == 13
    expected = np.stack(readings[-1 - (history - 1) * stride :: stride], axis=1) / 75
    np.testing.assert_allclose(acted.last.batch[TOUCH].numpy(), expected, atol=1e-5)


@pytest.mark.parametrize(("stride", "reads"), [(4, 1), (8, 1), (2, 2), (3, 4)])
def test_pads_are_read_only_where_a_window_needs_it(opened, stride, reads):
    """Decisions of 4 actions and 12 control steps an episode: the same windows as with a reading after every control step, also
    the last one before time runs out, by 4 / gcd(stride, 4) … readings a decision."""
    rare, each = envs_of(2, 12), envs_of(2, 12)
    worlds = [
        make_world(rare, opened, history=3, stride=stride, num_actions=4),
        make_world(each, opened, history=3, stride=stride),
    ]
    assert [twins(world)._touch_every for world in worlds] == [4 // reads, 1]
    num_read, touch = 0, rare.sim.touch

    def counted(noise: Any) -> np.ndarray:
        nonlocal num_read
        num_read += 1
        return touch(noise)

    rare.sim.touch = counted  # pyright: ignore
    for _ in range(3):
        actions = home(worlds[0], 4)
        acted = [world.act(actions) for world in worlds]
        seen = [world.observe().batch[TOUCH] for world in worlds]
        assert torch.equal(*seen)
    assert num_read == 3 * reads + 1  # and one after the reset
    last = [one.last.batch[TOUCH] for one in acted]
    assert len(last[0]) == 2
    assert torch.equal(*last)
    for envs in (rare, each):
        envs.close()


def test_an_action_that_is_no_action_ends_the_episode_as_a_failure(envs, opened):
    world = make_world(envs, opened)
    chunk = home(world).clone()
    chunk[1, 3, 2] = torch.nan
    acted = world.act(chunk)
    assert acted.outcome_N.tolist() == [
        None,
        "bad_action",
    ] and acted.terminated_N.tolist() == [False, True]
    assert acted.reward_N.tolist() == [0, 0]
    assert envs.facts()["seed"].tolist() == [
        episode_seed(5, 0, 0),
        episode_seed(5, 1, 1),
    ]


def test_a_reset_is_of_its_rows_only(envs, opened):
    world = make_world(envs, opened)
    world.act(home(world))
    before = world.observe()
    twins(world).reset(np.array([False, True]))
    after = world.observe()
    assert envs.facts()["steps"].tolist() == [5, 0]
    assert envs.facts()["seed"].tolist() == [
        episode_seed(5, 0, 0),
        episode_seed(5, 1, 1),
    ]
    for key, value in before.batch.items():
        assert torch.equal(value[0], after.batch[key][0]), key


@pytest.mark.parametrize("pictures", ["clear", "randomised"])
def test_a_stopped_world_goes_on_bit_for_bit(envs, opened, tmp_path, pictures):
    world = make_world(envs, opened, pictures=pictures)
    moves = [
        0.2 * torch.randn(N, 5, 14, generator=torch.Generator().manual_seed(k))
        for k in range(4)
    ]
    world.observe()
    world.act(moves[0])
    checkpoint.write_state(tmp_path / "pretrained_model", world.state_dict())

    def go_on(world: TwinWorld) -> list[torch.Tensor]:
        found = []
        for move in moves[1:]:  # over a reset
            seen = world.observe()
            found += [
                *seen.batch.values(),
                seen.privileged_NP,
                torch.from_numpy(world.act(move).truncated_N),
            ]
        return found

    expected = go_on(world)
    again = make_world(envs, opened, seed=77, pictures=pictures)
    again.load_state_dict(checkpoint.load_state(tmp_path / "pretrained_model"))
    assert all(torch.equal(a, b) for a, b in zip(go_on(again), expected, strict=True))


# states of earlier episodes -------------------------------------------------------------------------------------------


def later_world(
    envs: TaccorlVectorEnv, opened: Any, share: float = 1.0, size: int = 3
) -> TwinWorld:
    return world_of([envs], opened, share=share, size=size)


def test_episodes_begin_in_states_of_earlier_ones_with_their_touch_and_are_counted_apart(
    envs, opened, monkeypatch
):
    """12 control steps, 5 a chunk. One third of the time must be left: states after 5 steps are kept, those after 10 are not."""
    monkeypatch.setattr(start_states, "_KEPT", 1.0)
    world = later_world(envs, opened)
    envs.sim.judge.subtask[0] = (
        2  # environment 0 is done, says the judge, environment 1 holds its parts
    )
    envs.sim.judge.subtask[1] = 1
    world.act(home(world) + 0.1)
    assert len(twins(world).starts) == 1
    kept = envs.sim.snapshot(np.array([1]))
    felt = world.observe().batch[TOUCH][1]
    world.act(home(world))
    assert len(twins(world).starts) == 1, "too late"
    acted = world.act(home(world))
    assert (
        acted.outcome_N.tolist() == ["timeout", "timeout"]
        and not acted.began_later_N.any()
    )
    for i in range(N):
        now = envs.sim.snapshot(np.array([i]))
        np.testing.assert_array_equal(now.physics, kept.physics)
        assert (
            now.judge["steps"] == kept.judge["steps"] == 5 and now.seeds == kept.seeds
        )
        assert torch.equal(world.observe().batch[TOUCH][i], felt)
    world.act(home(world))
    acted = world.act(home(world))  # 5 + 5 + 2 of 12 steps
    assert (
        acted.outcome_N.tolist() == ["timeout", "timeout"] and acted.began_later_N.all()
    )


def test_with_states_of_earlier_episodes_a_world_resumes_bit_for_bit(
    envs, opened, monkeypatch
):
    monkeypatch.setattr(start_states, "_KEPT", 0.7)
    world = later_world(envs, opened, share=0.5, size=2)

    def steps(num: int) -> list[torch.Tensor]:
        found = []
        for _ in range(num):
            envs.sim.judge.subtask[:] = 1
            world.act(home(world) + 0.05)
            found.append(world.observe().batch["observation.state"].clone())
        return found

    steps(8)
    assert len(twins(world).starts) == 2, "the ring is full"
    state = world.state_dict()
    expected = steps(9)
    world = later_world(envs, opened, share=0.5, size=2)
    world.load_state_dict(state)
    assert all(
        torch.equal(one, other) for one, other in zip(steps(9), expected, strict=True)
    )


def test_a_share_beyond_one_is_refused():
    with pytest.raises(TaccorlError, match=r"start_share=1\.5"):
        EnvSettings(start_share=1.5)


# shards ---------------------------------------------------------------------------------------------------------------


def test_shards_give_what_one_gives(opened):
    """Three environments at once, and as two and one: scenes, touch, randomised pictures, outcomes, last observations."""

    def made(*sizes: int) -> TwinWorld:
        return world_of(
            [envs_of(size, 8) for size in sizes], opened, 7, pictures="randomised"
        )

    one, two = made(3), made(2, 1)
    assert one.num_envs == two.num_envs == 3
    twins(one).reset(np.array([False, True, False]))
    twins(two).reset(np.array([False, True]))
    shift = 0.05 * torch.arange(3)[:, None, None]
    resumed = None
    for step in range(4):
        seen, other = one.observe(), two.observe()
        assert torch.equal(seen.privileged_NP, other.privileged_NP)
        for key, value in seen.batch.items():
            assert torch.equal(value, other.batch[key]), key
        chunk = home(one) + shift
        found = [world.act(chunk) for world in (one, two)]
        assert np.array_equal(found[0].outcome_N, found[1].outcome_N)
        assert (found[0].last is None) == (found[1].last is None) == (step in (0, 2))
        if found[0].last is not None and found[1].last is not None:
            assert torch.equal(found[0].last.batch[TOUCH], found[1].last.batch[TOUCH])
            assert torch.equal(found[0].last.privileged_NP, found[1].last.privileged_NP)
        if step == 2:
            resumed = two.state_dict()
    now = two.observe()
    assert resumed is not None
    two.load_state_dict(resumed)
    two.act(chunk)
    assert torch.equal(two.observe().privileged_NP, now.privileged_NP)
    one.close()
    two.close()

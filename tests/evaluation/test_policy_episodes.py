"""A policy's episodes for corrections: in batches, once, and bit for bit what one simulation does again."""

from pathlib import Path

import numpy as np
import pytest
from test_rollouts import StandIn

from taccorl.episodes.sources.correct import CorrectionPlan, correct_episode, read_policy_episode
from taccorl.evaluation.policy_episodes import policy_episodes
from taccorl.lineage.store import Store


def plan(**changes: object) -> CorrectionPlan:
    values: dict = {"task": "assembly_2", "policy": "stand-in", "policy_digest": "0", "episodes": 3, "images": False}
    return CorrectionPlan(**{**values, "episode_length": 6, **changes})


def wobble(step: int, actions: np.ndarray, envs: object) -> None:
    actions[:, :6] += 0.02 * np.sin(step + np.arange(len(actions)))[:, None]


def test_each_episode_is_made_once_and_executed_again_bit_for_bit(tmp_path: Path) -> None:
    store, loaded = Store(tmp_path), list[StandIn]()

    def load() -> StandIn:
        loaded.append(StandIn(wobble))
        return loaded[-1]

    found = policy_episodes(plan(), load, 2, store)
    assert len(found) == 2 and len(loaded) == 1 and loaded[0].streams == [0, 1]
    sim = plan().make()
    for k, seed in enumerate(plan().scene_seeds):
        episode = read_policy_episode(found[k // 2].path, k % 2)
        assert (episode.seed, episode.outcome, len(episode.actions)) == (seed, "timeout", 6)
        sim.reset([seed])
        for t, action in enumerate(episode.actions):
            assert np.array_equal(sim.proprioception()[0].astype(np.float32), episode.states[t])
            assert np.array_equal(sim.judge.subtask[0], episode.subtasks[t])
            sim.step(action[None].astype(float))
        assert np.array_equal(sim.proprioception()[0].astype(np.float32), episode.states[-1])
    sim.close()
    assert policy_episodes(plan(takeover="all"), load, 2, store) == found and len(loaded) == 1
    more = policy_episodes(plan(episodes=5), load, 2, store)  # the first batch is there, the second has one more scene
    assert more[0] == found[0] and loaded[-1].streams[-2:] == [1, 2]
    num = len(loaded)
    policy_episodes(plan(policy_digest="1"), load, 2, store)
    assert len(loaded) == num + 1


def standing() -> StandIn:
    return StandIn(wobble)


@pytest.mark.slow
def test_batches_in_several_processes_are_the_same(tmp_path: Path) -> None:
    one = policy_episodes(plan(), standing, 1, Store(tmp_path / "one"))
    other = policy_episodes(plan(), standing, 1, Store(tmp_path / "other"), workers=2)
    assert [batch.digest for batch in one] == [batch.digest for batch in other]


@pytest.mark.slow
def test_the_expert_completes_what_a_policy_of_a_batch_began(tmp_path: Path) -> None:
    its = plan(episodes=2)
    found = policy_episodes(its, lambda: StandIn(wobble), 2, Store(tmp_path))
    sim = its.make()
    done = [correct_episode(its, sim, its.contract(sim), read_policy_episode(found[0].path, k)) for k in range(2)]
    assert [one.outcome for one in done] == ["success", "success"]
    assert [one.facts["cause"] for one in done] == ["drawn before the grasp"] * 2
    sim.close()

"""A policy's episodes for corrections: in batches, once, and bit for bit what one simulation does again."""

from pathlib import Path

import numpy as np
import pytest
from test_rollouts import StandIn

from taccorl.demos.correct import CorrectionPlan, correct_episode, read_policy_episode
from taccorl.evaluation.policy_episodes import policy_episodes
from taccorl.lineage.store import Store


def plan(**changes: object) -> CorrectionPlan:
    values: dict = {"task": "assembly_2", "policy": "stand-in", "policy_digest": "0", "episodes": 3, "images": False}
    return CorrectionPlan(**{**values, "episode_length": 6, **changes})


def wobble(step: int, actions: np.ndarray, envs: object) -> None:
    actions[:, :6] += 0.02 * np.sin(step + np.arange(len(actions)))[:, None]


def test_each_episode_is_made_once_and_executed_again_bit_for_bit(tmp_path: Path) -> None:
    store, loaded = Store(tmp_path), []

    def load() -> StandIn:
        loaded.append(StandIn(wobble))
        return loaded[-1]

    found = policy_episodes(plan(), load, 2, store)
    assert loaded[0].restarts == 1
    sim = plan().make()
    for k, seed in enumerate(plan().scene_seeds):
        episode = read_policy_episode(found.path, k)
        assert (episode.seed, episode.outcome, len(episode.actions)) == (seed, "timeout", 6)
        sim.reset([seed])
        for t, action in enumerate(episode.actions):
            assert np.array_equal(sim.proprioception()[0].astype(np.float32), episode.states[t])
            sim.step(action[None].astype(float))
        assert np.array_equal(sim.proprioception()[0].astype(np.float32), episode.states[-1])
    sim.close()
    assert policy_episodes(plan(takeover="all"), load, 2, store) == found and len(loaded) == 1
    policy_episodes(plan(policy_digest="1"), load, 2, store)
    assert len(loaded) == 2


@pytest.mark.slow
def test_the_expert_completes_what_a_policy_of_a_batch_began(tmp_path: Path) -> None:
    its = plan(episodes=2)
    found = policy_episodes(its, lambda: StandIn(wobble), 2, Store(tmp_path))
    sim = its.make()
    done = [correct_episode(its, sim, its.contract(sim), read_policy_episode(found.path, k)) for k in range(2)]
    assert [one.outcome for one in done] == ["success", "success"]
    assert [one.cause for one in done] == ["drawn before the grasp"] * 2
    sim.close()

"""Windows of readings whose numbers say environment and step."""

import numpy as np
import pytest

from taccorl.errors import TaccorlError
from taccorl.sim.touch_history import TouchHistory
from taccorl.sim.vector_env import TaccorlVectorEnv

TACTILE = "observation.tactile"


def reading(*numbers: int) -> np.ndarray:
    """(N, K), each row the same number."""
    return np.repeat(np.array(numbers, np.int16)[:, None], 1536, axis=1)


def shown(history: TouchHistory) -> list[list[int]]:
    assert (history.window == history.window[:, :, :1]).all()
    return history.window[:, :, 0].tolist()


def test_the_first_reading_is_repeated_and_the_newest_is_last() -> None:
    history = TouchHistory(2, 3)
    history.reset(reading(10, 20))
    assert shown(history) == [[10, 10, 10], [20, 20, 20]]
    steps = np.stack([reading(11, 21), reading(12, 22)], axis=1)
    history.append(steps, np.array([2, 1]))  # the second one stood still in the second step
    assert shown(history) == [[10, 11, 12], [20, 20, 21]]
    history.append(np.stack([reading(k, 20 + k) for k in range(5)], axis=1), np.array([5, 0]))
    assert shown(history) == [[2, 3, 4], [20, 20, 21]]
    history.reset(reading(90, 91), np.array([False, True]))
    assert shown(history) == [[2, 3, 4], [91, 91, 91]]
    with pytest.raises(TaccorlError, match="length 0"):
        TouchHistory(2, 0)


def test_it_follows_chunks_over_the_end_of_an_episode() -> None:
    """Environment 1 gets NaN in the third of four steps: it moved twice, and begins anew."""
    envs = TaccorlVectorEnv("bench", 2, num_threads=1)
    observation, _ = envs.reset(seed=0)
    first = observation[TACTILE]
    history = TouchHistory(2, 6)
    history.reset(first)
    actions = np.repeat(envs.sim.targets[:, None], 4, axis=1)
    actions[1, 2, 3] = np.nan
    chunk = envs.step_chunk(actions)
    history.follow(chunk)
    assert np.array_equal(history.window[0], np.concatenate([[first[0]] * 2, chunk.tactile[0]]))
    assert np.array_equal(history.window[1], np.repeat(chunk.observation[TACTILE][1:], 6, axis=0))
    assert not np.array_equal(chunk.tactile[1, 1], chunk.observation[TACTILE][1])  # noise of another scan

"""A recorded demonstration can be done again from its own rows, to the last bit."""

import numpy as np
import pytest

from taccorl.episodes.attempt import outcome_of
from taccorl.episodes.recorder import EpisodeRecorder, row_spec
from taccorl.episodes.sources.collect import CollectPlan, attempt
from taccorl.episodes.sources.expert import ExpertSource
from taccorl.sim.task import HOLD_S
from taccorl.sim.twin import CONTROL_HZ


@pytest.fixture(scope="module")
def recorded():
    plan = CollectPlan(task="assembly_1", source=ExpertSource(), seed=3)
    sim = plan.make()
    spec = row_spec(sim, pictures=False, executed=True)
    recorder = attempt(plan, sim, spec, 0).recorder
    assert outcome_of(sim) == "success"
    return plan, sim, spec, recorder.episode("demo", {"seed": plan.attempt_seed(0)})


def test_stored_actions_reproduce_the_stored_states_bit_for_bit(recorded):
    plan, sim, spec, episode = recorded
    sim.reset([plan.attempt_seed(0)])
    again = EpisodeRecorder(sim, spec)
    for sent, intended in zip(
        episode.arrays["sim.executed"], episode.arrays["action"], strict=True
    ):
        again.step(sent, intended=intended)
    other = again.episode("again", {})
    for key in (
        "sim.state",
        "observation.state",
        "action",
        "sim.subtask",
        "sim.success",
    ):
        np.testing.assert_array_equal(other.arrays[key], episode.arrays[key])
    assert other.success


def test_touch_can_be_recomputed_from_a_stored_state(recorded):
    _, sim, _, episode = recorded
    noise_rng = np.random.default_rng([int(episode.arrays["sim.seed"][0, 0]), 2])
    for row in range(3):
        _restore(sim, episode, row)
        np.testing.assert_array_equal(
            sim.touch(noise_rng)[0], episode.arrays["observation.tactile"][row]
        )
    touched = int(np.abs(episode.arrays["observation.tactile"]).sum(1).argmax())
    _restore(sim, episode, touched)
    clean = sim.touch()[0].astype(int)
    noisy = episode.arrays["observation.tactile"][touched].astype(int)
    inside = (clean > 20) & (clean < 150)
    assert inside.sum() > 20
    assert (
        np.abs(noisy - clean)[inside].max() <= 1 + 5 * 1.3
    )  # five standard deviations and a step


def _restore(sim, episode, row: int) -> None:
    sim.restore_rows(
        episode.arrays["sim.state"][row : row + 1], episode.arrays["sim.seed"][row]
    )


def test_any_stored_row_restores_the_encoders_and_the_run_goes_on_bit_exactly(recorded):
    _, sim, _, episode = recorded
    for row in (0, 100, 250):
        _restore(sim, episode, row)
        for later in range(row, row + 3):
            np.testing.assert_array_equal(
                sim.state_rows()[0], episode.arrays["sim.state"][later]
            )
            sim.step(episode.arrays["sim.executed"][later : later + 1].astype(float))
    for row in (
        0,
        len(episode.arrays["action"]) // 2,
        len(episode.arrays["action"]) - 1,
    ):
        _restore(sim, episode, row)
        np.testing.assert_array_equal(
            sim.proprioception()[0].astype("f4"),
            episode.arrays["observation.state"][row],
        )


def test_success_comes_after_the_hold_and_ends_the_episode(recorded):
    *_, episode = recorded
    success = episode.arrays["sim.success"][:, 0]
    assert success[-1] == 1 and success[:-1].sum() == 0
    assert len(success) > HOLD_S * CONTROL_HZ


def test_subtask_labels_rise_one_at_a_time_and_become_stages(recorded):
    *_, episode = recorded
    subtask = episode.arrays["sim.subtask"]
    steps = np.diff(subtask, axis=0)
    assert ((steps == 0) | (steps == 1)).all()
    assert episode.stages[0] == (0, "left: grasp socket, right: grasp plug")
    assert any("right: insert plug" in name for _, name in episode.stages)
    assert episode.provenance["simulation"]["seed"] == episode.arrays["sim.seed"][0, 0]

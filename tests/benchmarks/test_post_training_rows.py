"""Figures of post-training in π0.5's size, measured with the smallest backbone on a CPU: the steps that are timed do run."""

import pytest

from pipelines.benchmarks.rl import post_training_rows


@pytest.mark.slow
def test_full_size_figures_time_a_decision_and_an_update_of_the_same_policy():
    rows = {row.name: row for row in post_training_rows("tiny", "cpu", "CPU", num_envs=2, num_decisions=4)}
    decision, step, ratio = rows.values()
    assert decision.name.startswith("one decision of 2 environments") and decision.value > 0
    assert step.name.startswith("one optimiser step of 4 decisions") and step.value > 0
    assert ratio.value <= 1e-5  # sampled and scored by the same function, in float32

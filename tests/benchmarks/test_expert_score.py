"""Figures of the benchmarks: experts' grips, MimicGen's attempts in a stiffer twin, and post-training, whose steps do run."""

import dataclasses

import numpy as np
import pytest

from pipelines.benchmarks.expert_score import score_expert
from pipelines.benchmarks.generation_score import _holds, score_generation, stiffened
from pipelines.benchmarks.rl import post_training_rows
from taccorl.episodes.sources.mimicgen.attempt import Generated
from taccorl.episodes.sources.mimicgen.from_dataset import read_sources
from taccorl.episodes.sources.mimicgen.spec import load_mimic_spec
from taccorl.episodes.sources.mimicgen.stored import state_digest
from taccorl.sim.simulation import Simulation
from taccorl.sim.task import tasks
from taccorl.sim.twin import TwinConfig
from taccorl.tasks.assembly_2.scene import Assembly2
from taccorl.tasks.experts import expert_of, tasks_with_expert
from taccorl.tasks.experts.hands import ScriptedExpertConfig

WITH_EXPERT = tasks_with_expert()


@pytest.mark.parametrize(
    "task",
    ["assembly_1", *(pytest.param(t, marks=pytest.mark.slow) for t in WITH_EXPERT[1:])],
)
def test_an_expert_s_grip_is_felt_and_saturates_no_taxel(task):
    sim = Simulation(tasks.get(task)())
    sim.reset([3])
    expert = expert_of(sim.task)(sim, np.random.default_rng(3), ScriptedExpertConfig())
    expert.start()
    highest, above = 0, 0
    while not sim.judge.outcome.over[0]:
        sim.step(expert.act()[None].astype(float))
        if sim.judge.steps[0] % 10 == 0:
            highest = max(highest, int(sim.sensor.digitise(sim.reading(), None).max()))
            above = max(above, int(sim.touch()[0].max()))
    assert (
        sim.judge.outcome.success[0] and highest < 255
    )  # the wire's maximum: there force would be cut off
    assert above > 60  # twice the contact threshold


@pytest.mark.slow
def test_looking_at_every_physics_step_sees_at_least_as_deep_and_changes_nothing():
    coarse, fine = (
        score_expert("assembly_1", 1, every_step=every) for every in (False, True)
    )
    assert fine.duration_s == coarse.duration_s
    assert fine.corrections == coarse.corrections
    assert fine.penetration_m[0] >= coarse.penetration_m[0] > 0
    assert fine.penetration_m[0] < 0.0002


def test_a_stiffened_twin_has_other_gains_and_nothing_else():
    twin = TwinConfig()
    soft = stiffened(twin, 0.5)
    assert soft.controller.kp_nm_per_rad[0] == 0.5 * 1813.0  # paper App. B.1
    assert soft.controller.kd_nms_per_rad == twin.controller.kd_nms_per_rad
    assert stiffened(soft, 2.0) == twin
    assert twin.controller.kp_nm_per_rad[0] == 1813.0


@pytest.mark.slow
def test_a_score_counts_every_attempt_and_what_it_took(collected):
    spec = load_mimic_spec("assembly_2")
    score = score_generation(
        spec, read_sources(collected, spec), TwinConfig(), 2, seed=11, check=True
    )
    assert len(score.outcomes) == len(score.cpu_s) == 2
    assert len(score.duration_s) == score.outcomes.count("success") > 0
    assert min(score.cpu_s) > 0
    assert all(5 < duration < 30 for duration in score.duration_s)
    assert score.broken == 0


def test_what_is_not_in_place_or_ends_elsewhere_does_not_hold():
    sim = Simulation(Assembly2())
    sim.reset([5])
    still = np.tile(
        sim.arrays["ctrl"][0, sim.action_actuators].astype(np.float32), (3, 1)
    )
    for action in still:
        sim.step(action[None].astype(float))
    done = Generated(
        attempt=0,
        scene_seed=5,
        outcome="success",
        actions=still,
        intended=None,
        last_state=state_digest(sim),
    )
    assert not _holds(sim, done)  # the same state, but the plug stands on the table
    assert not _holds(sim, dataclasses.replace(done, actions=still[:2]))


@pytest.mark.slow
def test_full_size_figures_time_a_decision_and_an_update_of_the_same_policy():
    rows = {
        row.name: row
        for row in post_training_rows("tiny", "cpu", "CPU", num_envs=2, num_decisions=4)
    }
    decision, step, ratio = rows.values()
    assert (
        decision.name.startswith("one decision of 2 environments")
        and decision.value > 0
    )
    assert step.name.startswith("one optimiser step of 4 decisions") and step.value > 0
    assert ratio.value <= 1e-5  # sampled and scored by the same function, in float32

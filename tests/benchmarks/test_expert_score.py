"""What the experts do to the parts and to the pads, task by task."""

import numpy as np
import pytest

from pipelines.benchmarks.expert_score import score_expert
from taccorl.sim.simulation import Simulation
from taccorl.sim.task import tasks
from taccorl.tasks.experts import expert_of, tasks_with_expert
from taccorl.tasks.experts.hands import ScriptedExpertConfig

WITH_EXPERT = tasks_with_expert()


@pytest.mark.parametrize("task", ["assembly_1", *(pytest.param(t, marks=pytest.mark.slow) for t in WITH_EXPERT[1:])])
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
    assert sim.judge.outcome.success[0]
    assert highest < 255  # the wire's maximum: there force would be cut off
    assert above > 60  # twice the contact threshold


@pytest.mark.slow
def test_looking_at_every_physics_step_sees_at_least_as_deep_and_changes_nothing():
    coarse, fine = (score_expert("assembly_1", 1, every_step=every) for every in (False, True))
    assert fine.duration_s == coarse.duration_s
    assert fine.corrections == coarse.corrections
    assert fine.penetration_m[0] >= coarse.penetration_m[0] > 0
    assert fine.penetration_m[0] < 0.0002

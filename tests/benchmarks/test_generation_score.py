"""What the figures of MimicGen are made of: attempts in a twin of another stiffness, and what is kept done a third time."""

import dataclasses

import numpy as np
import pytest

from pipelines.benchmarks.generation_score import _holds, score_generation, stiffened
from taccorl.episodes.sources.mimicgen.attempt import Generated
from taccorl.episodes.sources.mimicgen.from_dataset import read_sources
from taccorl.episodes.sources.mimicgen.spec import load_mimic_spec
from taccorl.episodes.sources.mimicgen.stored import state_digest
from taccorl.sim.simulation import Simulation
from taccorl.sim.twin import TwinConfig
from taccorl.tasks.assembly_2.scene import Assembly2


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
    score = score_generation(spec, read_sources(collected, spec), TwinConfig(), 2, seed=11, check=True)
    assert len(score.outcomes) == len(score.cpu_s) == 2
    assert len(score.duration_s) == score.outcomes.count("success") > 0
    assert min(score.cpu_s) > 0
    assert all(5 < duration < 30 for duration in score.duration_s)
    assert score.broken == 0


def test_what_is_not_in_place_or_ends_elsewhere_does_not_hold():
    sim = Simulation(Assembly2())
    sim.reset([5])
    still = np.tile(sim.arrays["ctrl"][0, sim.action_actuators].astype(np.float32), (3, 1))
    for action in still:
        sim.step(action[None].astype(float))
    done = Generated(
        attempt=0, scene_seed=5, outcome="success", actions=still, intended=None, last_state=state_digest(sim)
    )
    assert not _holds(sim, done)  # the same state, but the plug stands on the table
    assert not _holds(sim, dataclasses.replace(done, actions=still[:2]))

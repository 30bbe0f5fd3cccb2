"""A robot to collect from that is not the user's twin, and says so."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from pipelines.surrogate_twin import ORIGIN, draw_surrogate_twin
from taccorl.errors import TaccorlError
from taccorl.sim.simulation import Simulation
from taccorl.sim.task import tasks
from taccorl.sim.twin import TwinConfig
from taccorl.sim.twin_file import load_twin, save_twin


def test_a_secret_is_one_robot_and_another_secret_another(tmp_path: Path) -> None:
    robots = [draw_surrogate_twin(secret) for secret in range(20)]
    assert robots[3] == draw_surrogate_twin(3)
    assert all(a != b for k, a in enumerate(robots) for b in robots[:k])
    save_twin(robots[3], tmp_path / "surrogate.yaml")
    assert load_twin(tmp_path / "surrogate.yaml") == robots[3]
    with pytest.raises(TaccorlError, match="secret -1"):
        draw_surrogate_twin(-1)


def test_it_says_that_it_is_a_surrogate_wherever_it_is_written_down() -> None:
    assert "not a robot" in ORIGIN
    assert all(
        "surrogate" in effect.evidence and "secret 7" in effect.evidence for effect in draw_surrogate_twin(7).effects
    )


def test_arms_cameras_and_pads_are_others_than_the_twins() -> None:
    robot, nominal = draw_surrogate_twin(7), TwinConfig()
    assert robot.sensor.gain_count != nominal.sensor.gain_count  # pyright: ignore[reportAttributeAccessIssue]
    acts_on = {(effect.name, *effect.acts_on()) for effect in robot.effects}
    assert len(acts_on) == 2 * 3 + 1 + 3  # friction, weight, delay of each arm; pads; each camera
    sims = [Simulation(tasks.get("assembly_2")("train"), config) for config in (nominal, robot)]
    for name in ("front", "left_wrist", "right_wrist"):
        poses = [np.concatenate([sim.model.camera(name).pos, sim.model.camera(name).quat]) for sim in sims]
        assert 1e-4 < np.abs(poses[1] - poses[0]).max() < 0.15
    without = dataclasses.replace(robot, effects=[], sensor=nominal.sensor)
    assert without == nominal  # all that differs is said
    for sim in sims:
        sim.close()

"""Outcomes depend on those rows of derived fields alone that a GPU copies back in each control step."""

import numpy as np
import pytest

from taccorl.sim.simulation import Simulation
from taccorl.sim.task import tasks


@pytest.mark.parametrize("task", ["assembly_1", "assembly_2", "puzzle", "test_tube"])
def test_rows_that_are_not_copied_back_are_not_read(task):
    """All others are NaN: verdict and joint states stay what they were, and so do subtasks."""
    sim = Simulation(tasks.get(task)(), num_sims=3)
    sim.reset([1, 2, 3])
    sim.step(sim.targets + 0.01)
    before = sim.task.look(sim)
    joints = sim.proprioception()
    done = [s.done(sim) for arm in sim.task.subtasks().values() for s in arm]
    for name, rows in sim._judged.items():
        only = np.full_like(sim.arrays[name], np.nan)
        only[:, rows] = sim.arrays[name][:, rows]
        assert name == "sensordata" or np.isnan(only).any()
        sim.arrays[name] = only
    after = sim.task.look(sim)
    np.testing.assert_array_equal(before.goal, after.goal)
    np.testing.assert_array_equal(before.partial, after.partial)
    for of in ("failures", "measures"):
        for name, values in getattr(before, of).items():
            assert np.isfinite(values).all()
            np.testing.assert_array_equal(values, getattr(after, of)[name])
    np.testing.assert_array_equal(joints, sim.proprioception())
    again = [s.done(sim) for arm in sim.task.subtasks().values() for s in arm]
    np.testing.assert_array_equal(done, again)


def test_the_list_of_rows_can_be_too_short():
    """Without the plug's row the verdict of assembly_1 is another: the test above would see it."""
    sim = Simulation(tasks.get("assembly_1")(), num_sims=1)
    sim.reset([1])
    depth_m = sim.task.look(sim).measures["depth_m"]
    sim.arrays["xpos"] = sim.arrays["xpos"].copy()
    sim.arrays["xpos"][:, sim.model.body("plug").id] = np.nan
    assert np.isfinite(depth_m).all()
    assert np.isnan(sim.task.look(sim).measures["depth_m"]).all()

"""N simulations in lock-step: the same bits alone, in a batch and on any threads; state in, state out; bad actions."""

import numpy as np
import pytest

from taccorl.errors import TaccorlError
from taccorl.sim.effects import make_effect
from taccorl.sim.simulation import SUB_COMMANDS, Simulation, Watch
from taccorl.sim.task import tasks
from taccorl.sim.twin import TwinConfig
from taccorl.tasks.assembly_1.scene import Assembly1


def waving(steps: int) -> np.ndarray:
    """(steps, 14) joint targets that move both arms and grippers, as float32."""
    sim = Simulation(Assembly1())
    sim.reset([0])
    t = np.arange(1, steps + 1)[:, None] / 30
    phase = np.arange(14)
    wave = 0.1 * np.sin(2 * np.pi * 0.7 * t + phase) - 0.1 * np.sin(phase)
    wave[:, [6, 13]] = -0.03 * (1 - np.cos(2 * np.pi * 0.5 * t))
    return (sim.targets[0] + wave).astype(np.float32)


ACTIONS = waving(25)


def scene(task: str = "assembly_1", difficulty: str = "train", effect: tuple = (), scale: float = 1.0) -> Simulation:
    effects = [make_effect(effect[0], **effect[1])] if effect else []
    sim = Simulation(tasks.get(task)(difficulty), TwinConfig(effects=effects), scale=scale)
    sim.reset([5])
    return sim


CREEP, HYSTERESIS = ("taxel_creep", {"share": 0.3}), ("taxel_hysteresis", {"half_width": 0.1})


@pytest.mark.parametrize(
    ("mine", "other"),
    [
        ({}, {"task": "assembly_2"}),
        ({}, {"task": "bench"}),
        ({}, {"difficulty": "hard"}),
        ({}, {"effect": ("coulomb_friction", {"torque_nm": 0.4})}),
        ({"effect": ("coulomb_friction", {"torque_nm": 0.5})}, {"effect": ("coulomb_friction", {"torque_nm": 0.4})}),
        ({"effect": CREEP}, {"effect": HYSTERESIS}),
        ({}, {"scale": 0.0}),
    ],
)
def test_a_state_of_another_scene_is_refused_before_anything_is_written(mine: dict, other: dict):
    sim, origin = scene(**mine), scene(**other)
    sim.step(sim.targets + 0.01)
    state, rows = sim.batch.state.copy(), sim.state_rows()
    foreign, foreign_rows = origin.snapshot(), origin.state_rows()
    if rows.shape == foreign_rows.shape:  # else sizes tell them apart
        said = "another task, difficulty, twin or randomisation.*assembly_1, train"
    else:
        said = "another t"
    with pytest.raises(TaccorlError, match=r"another t(ask|win)"):
        sim.restore(foreign)
    with pytest.raises(TaccorlError, match=said):
        sim.restore_rows(foreign_rows, [5])
    np.testing.assert_array_equal(sim.batch.state, state)
    np.testing.assert_array_equal(sim.state_rows(), rows)
    assert sim.judge.steps[0] == 1


def test_a_state_of_the_same_scene_made_anew_is_taken():
    for settings in ({}, {"effect": CREEP}, {"difficulty": "hard", "scale": 0.5}):
        origin, sim = scene(**settings), scene(**settings)
        origin.step(origin.targets + 0.01)
        sim.restore(origin.snapshot())
        np.testing.assert_array_equal(sim.state_rows(), origin.state_rows())
        sim.reset([1])
        sim.restore_rows(origin.state_rows(), origin.seeds)
        np.testing.assert_array_equal(sim.state_rows(), origin.state_rows())


def test_a_row_begins_with_its_scene_and_then_has_the_physics():
    sim = scene()
    row = sim.state_rows()[0]
    assert row.shape == (sim.row_size,)
    assert 0 < row[0] < 1 and row[0] * 2**52 == int(row[0] * 2**52)
    np.testing.assert_array_equal(row[1 : 1 + sim.batch.nstate], sim.batch.state[0])
    spoilt = row.copy()
    spoilt[0] += 2**-52  # the last bit
    with pytest.raises(TaccorlError, match="randomisation"):
        sim.restore_rows(spoilt[None], [5])
    with pytest.raises(TaccorlError, match="2 seeds"):
        sim.restore_rows(row[None], [5, 6])
    with pytest.raises(TaccorlError, match="states to draw: rows"):
        next(sim.render_states(sim.snapshot().physics, ["front"]))


@pytest.mark.parametrize("effects", [[], ["command_delay", "command_lag", "taxel_creep"]])
def test_a_simulation_that_is_not_stepped_keeps_everything(effects: list[str]):
    typical = [effect(name) for name in effects]
    sim = Simulation(Assembly1(), TwinConfig(effects=typical), num_sims=3)
    alone = Simulation(Assembly1(), TwinConfig(effects=typical))
    sim.reset([3, 7, 11])
    alone.reset([7])
    for k, action in enumerate(ACTIONS[:6]):
        before = sim.snapshot()
        sim.judge.held[[0, 2]] = 4 + k  # would be broken off if they were judged
        executed, targets = sim.executed.copy(), sim.targets.copy()
        # clipped, if it counted
        beyond = action + np.where(np.arange(3) == 1, 0.0, 4.0)[:, None] * (np.arange(14) == 0)
        sim.step(beyond, np.array([1]))
        alone.step(action[None])
        now = sim.snapshot()
        for i in (0, 2):
            np.testing.assert_array_equal(now.physics[i], before.physics[i])
            np.testing.assert_array_equal(sim.targets[i], targets[i])
            np.testing.assert_array_equal(sim.executed[i], executed[i])
            for name, values in before.memory.items():
                np.testing.assert_array_equal(now.memory[name][i], values[i], err_msg=name)
        assert sim.judge.steps.tolist() == [0, k + 1, 0]
        assert sim.judge.held[[0, 2]].tolist() == [4 + k] * 2
        assert not sim.clipped.any()
    np.testing.assert_array_equal(sim.batch.state[1], alone.batch.state[0])
    np.testing.assert_array_equal(sim.targets[1], alone.targets[0])


def effect(name: str):
    return make_effect(name, **{p.name: p.typical for p in type(make_effect(name)).parameters()})


def test_watching_changes_nothing():
    plain, watched = Simulation(Assembly1()), Simulation(Assembly1())
    seen = []
    for sim in (plain, watched):
        sim.reset([4])
    for action in ACTIONS[:8]:
        plain.step(action[None])
        watched.step(
            action[None], watch=Watch(range(6, 41, 6), lambda step: seen.append((step, watched.touch().sum())))
        )
    np.testing.assert_array_equal(plain.batch.state, watched.batch.state)
    assert [step for step, _ in seen[:6]] == [6, 12, 18, 24, 30, 36]


def test_targets_move_in_a_straight_line_over_the_control_step():
    sim = Simulation(tasks.get("bench")())
    sim.reset([0])
    start, goal = sim.targets[0].copy(), sim.targets[0] + 0.05
    goal[[6, 13]] = 0.03
    asked = []
    every = sim.config.physics.steps_per_control_step // SUB_COMMANDS
    watch = Watch(range(every, SUB_COMMANDS * every + 1, every), lambda _: asked.append(sim.arrays["ctrl"][0].copy()))
    sim.step(goal[None], watch=watch)
    line = [start + (goal - start) * k / SUB_COMMANDS for k in range(1, SUB_COMMANDS + 1)]
    np.testing.assert_allclose(np.array(asked)[:, sim.action_actuators], line, atol=1e-12)


def test_reset_draws_mass_and_friction_into_each_simulation_s_own_model():
    sim = Simulation(Assembly1(), num_sims=2)
    sim.reset([1, 2])
    for i in range(2):
        model = sim.batch.get_model(i)
        draw = sim.draws[i]
        assert model.body("plug").mass[0] == pytest.approx(0.080 + draw["plug_mass"][0])
        assert model.body("socket").mass[0] == pytest.approx(0.150 + draw["socket_mass"][0])
        assert model.geom("plug_0").friction[0] == pytest.approx(draw["friction"][0])
        assert model.geom("table").friction[0] == 0.6
        nominal = sim.model.body("plug").inertia / sim.model.body("plug").mass
        np.testing.assert_allclose(model.body("plug").inertia / model.body("plug").mass, nominal)
    assert sim.draws[0]["friction"][0] != sim.draws[1]["friction"][0]


def test_contact_of_an_undeclared_pair_is_an_error():
    sim = Simulation(Assembly1())
    sim.reset([0])
    with pytest.raises(TaccorlError, match="has only the pairs"):
        sim.contact("socket", "plug")

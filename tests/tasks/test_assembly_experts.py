"""The experts of both assemblies: they succeed by touch, gently, in the order of the subtasks; without touch they do not."""

from dataclasses import dataclass, field

import numpy as np
import pytest

from taccorl.sim.simulation import Simulation
from taccorl.sim.task import tasks
from taccorl.tasks.experts import expert_of
from taccorl.tasks.experts.hands import EXACT, ScriptedExpertConfig
from taccorl.tasks.experts.scripted import ScriptedExpert

TASKS = ("assembly_1", "assembly_2")
SEED = {"assembly_1": 12, "assembly_2": 0}  # the first try misses the hole


@dataclass
class Told:
    """What one episode was like."""

    expert: ScriptedExpert
    steps: int = 0
    success: bool = False
    failure: str = ""
    penetration_m: float = 0.0
    force_n: list[float] = field(default_factory=list)
    subtasks: list[tuple[int, int]] = field(default_factory=list)
    actions: list[np.ndarray] = field(default_factory=list)


def episode(
    sim: Simulation, seed: int, config: ScriptedExpertConfig | None = None, longest_s: float = 30.0, rng_seed: int = 7
) -> Told:
    sim.reset([seed])
    expert = expert_of(sim.task)(sim, np.random.default_rng([seed, rng_seed]), config)
    expert.start()
    told = Told(expert)
    while not sim.judge.outcome.over[0] and told.steps < 30 * longest_s:
        told.actions.append(expert.act())
        sim.step(told.actions[-1][None])
        told.steps += 1
        contact = sim.contact(*sim.task.mating[0])
        told.penetration_m = max(told.penetration_m, float(contact.penetration_m[0]))
        told.force_n.append(float(contact.force_n[0]))
        current = tuple(sim.judge.subtask[0].tolist())
        if not told.subtasks or told.subtasks[-1] != current:
            told.subtasks.append(current)
    told.success, told.failure = bool(sim.judge.outcome.success[0]), str(sim.judge.outcome.failure[0])
    return told


@pytest.fixture(scope="module")
def sims() -> dict[str, Simulation]:
    return {name: Simulation(tasks.get(name)()) for name in TASKS}


@pytest.fixture(scope="module")
def human(sims) -> dict[str, Told]:
    return {name: episode(sims[name], SEED[name]) for name in TASKS}


@pytest.mark.parametrize("name", TASKS)
def test_the_plug_gets_in_after_a_correction_by_touch(human, name):
    told = human[name]
    assert told.success
    assert told.failure == ""
    assert 1 <= len(told.expert.events) <= 4
    assert told.steps < 20 * 30
    assert all("right: blocked at" in what for _, what in told.expert.events)


@pytest.mark.parametrize("name", TASKS)
def test_it_is_gentle_and_within_reach(human, name):
    told = human[name]
    assert told.penetration_m < 2e-4
    assert 5 < max(told.force_n) < 30  # the rim was felt, and the hand gave in
    assert told.expert.unreachable_m < 1e-4


@pytest.mark.parametrize("name", TASKS)
def test_a_correction_follows_a_force_and_relieves_it(human, name):
    told = human[name]
    for step, _ in told.expert.events:
        before, after = max(told.force_n[step - 8 : step + 1]), told.force_n[step + 14]
        assert before > 2
        assert after < 0.25 * before


@pytest.mark.parametrize("name", TASKS)
def test_the_subtasks_end_in_order_and_the_last_two_together(human, name):
    path = human[name].subtasks
    assert path[0] == (0, 0)
    assert set(path[1:-2]) <= {(1, 0), (0, 1)}
    assert path[-2:] == [(1, 1), (2, 2)]
    assert path == sorted(path, key=sum)  # none begins again


@pytest.mark.slow
@pytest.mark.parametrize("name", TASKS)
def test_exact_hands_need_no_correction(sims, name):
    told = episode(sims[name], 3, EXACT)
    assert told.success
    assert told.expert.events == []
    assert told.steps < 14 * 30
    assert max(told.force_n) < 5


@pytest.mark.slow
def test_hands_that_feel_nothing_fail_where_touch_succeeds(sims, human):
    numb = ScriptedExpertConfig(feel_m=1.0, feel_rad=10.0, give_way=0.0)
    told = episode(sims["assembly_1"], SEED["assembly_1"], numb, longest_s=human["assembly_1"].steps / 30 + 3)
    assert not told.success
    assert told.expert.events == []
    assert max(told.force_n) > 1.2 * max(human["assembly_1"].force_n)  # and they press


def test_the_same_seeds_give_the_same_episode_bit_for_bit(sims, human):
    first, again = human["assembly_2"], episode(sims["assembly_2"], SEED["assembly_2"], longest_s=4.0)
    np.testing.assert_array_equal(again.actions, first.actions[: again.steps])
    other = episode(sims["assembly_2"], SEED["assembly_2"], longest_s=2.0, rng_seed=8)
    assert np.abs(np.array(other.actions) - first.actions[: other.steps]).max() > 1e-3


def test_a_hand_waits_at_its_part_for_the_other_and_never_meets_it(sims, human):
    expert = human["assembly_1"].expert
    assert {"holder waits", "plug is in"} >= expert.flags >= {"holder waits"}
    gap_m = np.linalg.norm(expert.tcp("left")[:3, 3] - expert.tcp("right")[:3, 3])
    assert gap_m > 0.06  # pads are 24 mm wide and lean apart

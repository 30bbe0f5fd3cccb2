"""Arms that are pushed off their way while the action still leads to where they were to be; and what must be exact is exact."""

import dataclasses

import numpy as np
import pytest

from taccorl.alignment.dataset_rows import read_dataset
from taccorl.data.dataset import Dataset
from taccorl.demos.mimicgen.attempt import Attempts
from taccorl.demos.mimicgen.augment import AugmentPlan, attempt_episode, augment, made_attempts
from taccorl.demos.mimicgen.disturbance import Exact, disturbed, drift, strengths
from taccorl.demos.mimicgen.from_dataset import read_sources
from taccorl.demos.mimicgen.source import SourcePool
from taccorl.demos.mimicgen.spec import DisturbanceSpec, load_mimic_spec, with_options
from taccorl.errors import DatasetError
from taccorl.lineage.store import Store
from taccorl.sim.actions import ACTION_HIGH, ACTION_LOW
from taccorl.sim.robot import ARMS
from taccorl.sim.simulation import Simulation
from taccorl.sim.tasks.assembly_2 import Assembly2

LEFT, RIGHT = np.r_[:6], np.r_[7:13]
SPEC = with_options(load_mimic_spec("assembly_2"), disturbance=DisturbanceSpec(joint_rad=0.02, time_s=0.7))


@pytest.fixture(scope="module")
def two_hands():
    """(T, 14) and (T, 2): the left gripper moves in row 20, both arms have to be exact from row 100 on."""
    intended = ((ACTION_LOW + ACTION_HIGH) / 2 + np.linspace(-0.1, 0.1, 120)[:, None]).astype(np.float32)
    intended[:, [6, 13]] = 0.05
    intended[20:, 6] = 0.01
    return intended, np.tile(np.arange(120)[:, None] >= 100, (1, 2))


def test_nothing_drifts_where_a_gripper_moves_or_parts_meet(two_hands):
    left, right = strengths(*two_hands).T
    # 12 steps without, 12 steps of a ramp
    assert [left[k] for k in (2, 8, 20, 32, 38, 44, 76, 82, 88, 110)] == [0.5, 0, 0, 0, 0.5, 1, 1, 0.5, 0, 0]
    assert [right[k] for k in (0, 20, 76, 82, 88, 119)] == [1, 1, 1, 0.5, 0, 0]  # its own gripper rests
    assert (strengths(two_hands[0][:, [*RIGHT, 13] * 2], np.zeros((120, 2), bool)) == 1).all()


def test_a_drift_has_the_spread_and_the_time_that_were_asked_for():
    off = drift(40_000, DisturbanceSpec(joint_rad=0.02, time_s=0.7), np.random.default_rng(0))
    assert off.shape == (40_000, 12)
    assert (off[0] == 0).all()
    np.testing.assert_allclose(off.std(0), 0.02, rtol=0.08)  # 40 000 rows are 1900 times 21: 1.6 % standard error
    lagged = [np.corrcoef(x[:-21], x[21:])[0, 1] for x in off.T]  # 0.7 s at 30 Hz
    np.testing.assert_allclose(np.mean(lagged), np.exp(-1), atol=0.03)
    assert np.abs(np.corrcoef(off.T) - np.eye(12)).max() < 0.15


def test_joints_are_pushed_and_openings_are_not(two_hands):
    intended, is_exact = two_hands
    executed = disturbed(intended, is_exact, DisturbanceSpec(joint_rad=0.02), np.random.default_rng(1))
    assert executed.dtype == np.float32
    np.testing.assert_array_equal(executed[:, [6, 13]], intended[:, [6, 13]])
    pushed = (executed != intended)[:, [*LEFT, *RIGHT]].reshape(-1, 2, 6)
    np.testing.assert_array_equal(pushed[1:].any(2), strengths(intended, is_exact)[1:] > 0)
    assert not pushed[0].any()
    far = disturbed(intended, is_exact, DisturbanceSpec(joint_rad=50.0), np.random.default_rng(1))
    assert ((far >= ACTION_LOW) & (far <= ACTION_HIGH)).all()
    np.testing.assert_array_equal(disturbed(intended, is_exact, DisturbanceSpec(), np.random.default_rng(1)), intended)


def test_an_arm_is_exact_that_grips_on_the_table_and_both_are_once_parts_have_met(collected):
    episode, sim = Dataset(collected).episode(1), Simulation(Assembly2())
    sim.reset(episode.arrays["sim.seed"][0])
    exact, found, touch = Exact(sim), [], []
    for action in episode.arrays["action"]:
        found.append(exact.look())
        touch.append(bool(sim.contact("plug", "cradle").touching[0]))
        sim.step(action[None].astype(np.float64))
    found, met = np.array(found), touch.index(True)
    assert not all(touch[met:])  # inside its play the plug does not touch all the time …
    assert found[met:].all()  # … and that they have met is remembered
    assert not found[0].any()
    for a, column in enumerate((6, 13)):
        closing = int(np.argmax(np.diff(episode.arrays["action"][:, column]) < -0.002))
        on_the_table = np.flatnonzero(found[:met, a])  # gripped there, and nowhere else
        assert len(on_the_table)
        assert closing < on_the_table.min()
        assert on_the_table.max() < closing + 40


@pytest.fixture(scope="module")
def pool(collected):
    return SourcePool(SPEC, read_sources(collected, SPEC))


@pytest.fixture(scope="module")
def both(pool):
    """The first attempt that succeeds disturbed, and the same one undisturbed."""
    sim, calm = (
        Simulation(Assembly2()),
        dataclasses.replace(SPEC, datagen_config=load_mimic_spec("assembly_2").datagen_config),
    )
    attempts = Attempts(pool, sim, seed=11)
    pushed = next(done for k in range(8) if (done := attempts.run(k)).success)
    return pushed, Attempts(SourcePool(calm, pool.sources), sim, seed=11).run(pushed.k)


def tcps(actions, scene_seed):
    """(T, 2, 3) [m] where the hands are before each action."""
    sim, found = Simulation(Assembly2()), []
    sim.reset([scene_seed])
    for action in actions:
        found.append(np.stack([sim.tcp(arm)[0, :3, 3] for arm in ARMS]))
        sim.step(action[None].astype(np.float64))
    return np.stack(found), sim.state_rows()[0]


@pytest.mark.slow
def test_a_disturbed_hand_leaves_its_way_and_is_back_where_it_grips(both):
    pushed, calm = both
    assert calm.success
    assert calm.intended is None
    num = min(len(pushed.actions), len(calm.actions))
    np.testing.assert_array_equal(pushed.intended[:num], calm.actions[:num])
    np.testing.assert_array_equal(pushed.intended[num:], np.tile(calm.actions[-1:], (len(pushed.intended) - num, 1)))
    (way, state), (calm_way, _) = tcps(pushed.actions, pushed.scene_seed), tcps(calm.actions, calm.scene_seed)
    np.testing.assert_array_equal(state, pushed.last_state)
    off_mm = 1e3 * np.linalg.norm(way[:num] - calm_way[:num], axis=2)
    strength = strengths(pushed.intended, np.zeros((len(pushed.intended), 2), bool))[:num]
    grips = [int(np.argmax(strength[:, a] == 0)) + 12 for a in range(2)]
    for a, grip in enumerate(grips):
        full = off_mm[:grip, a][strength[:grip, a] == 1]
        assert np.median(full) > 4
        assert full.max() < 60
        assert off_mm[grip, a] < 1.5  # 0.4 s after the last push, four time constants of the arm


@pytest.mark.slow
def test_rows_show_what_was_intended_and_keep_what_was_executed(both, pool):
    pushed, _ = both
    sim = Simulation(Assembly2())
    attempts = Attempts(pool, sim, seed=11)
    spec = AugmentPlan(spec=SPEC, images=False).rows(sim)
    done = dataclasses.replace(pushed, provenance={})
    recorder = attempts.redo(done, spec)
    assert done.success, done.reason
    episode = recorder.episode("pushed", {})
    np.testing.assert_array_equal(episode.arrays["action"], pushed.intended)
    np.testing.assert_array_equal(episode.arrays["sim.executed"], pushed.actions)
    # Where an arm is off, the action leads back: it does not move along with the joints.
    off = (pushed.actions - pushed.intended)[:, [*LEFT, *RIGHT]]
    led = (episode.arrays["action"] - episode.arrays["observation.state"])[:, [*LEFT, *RIGHT]]
    hard = np.abs(off) > 0.02
    assert np.corrcoef(off[hard], led[hard])[0, 1] < -0.5


@pytest.mark.slow
def test_an_attempt_that_fails_when_disturbed_says_so(pool):
    wild = with_options(SPEC, disturbance=DisturbanceSpec(joint_rad=0.3))
    done = Attempts(SourcePool(wild, pool.sources), Simulation(Assembly2()), seed=11).run(0)
    assert not done.success
    assert done.reason == "disturbed; undisturbed it succeeds"
    assert done.intended is not None


@pytest.mark.slow
def test_a_disturbed_dataset_says_how_and_is_no_source(collected, tmp_path):
    plan = AugmentPlan(spec=SPEC, episodes=1, images=False)
    augment(plan, collected, tmp_path / "new", Store(tmp_path / "store"), progress=lambda _: None)
    episode = Dataset(tmp_path / "new").episode(0)
    told = episode.provenance["simulation"]
    assert told["mimicgen"]["disturbance"] == {"joint_rad": 0.02, "time_s": 0.7}
    assert not np.array_equal(episode.arrays["sim.executed"], episode.arrays["action"])
    (measured,) = read_dataset(tmp_path / "new")  # what is compared with the twin is what was sent
    np.testing.assert_array_equal(measured.target, episode.arrays["sim.executed"][:-1])
    merged = dataclasses.replace(episode, arrays={k: v for k, v in episode.arrays.items() if k != "sim.executed"})
    with pytest.raises(DatasetError, match=r"sim\.executed, what was sent to them, is not there: taccorl merge"):
        merged.executed()
    attempts = made_attempts(plan, collected, Store(tmp_path / "store"), told["mimicgen"]["attempt"] + 1)
    again = attempt_episode(attempts[-1])
    for key in ("action", "sim.executed", "sim.state"):
        np.testing.assert_array_equal(again.arrays[key], episode.arrays[key])
    with pytest.raises(DatasetError, match=r"pushed off their way .* Give the dataset that it was made of"):
        read_sources(tmp_path / "new", SPEC)

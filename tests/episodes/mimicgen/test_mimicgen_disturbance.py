"""Arms that are pushed off their way while the action still leads to where they were to be; and what must be exact is exact."""

import dataclasses
import math

import numpy as np
import pytest

from taccorl.alignment.measurements.dataset_rows import read_dataset
from taccorl.data.dataset import Dataset
from taccorl.episodes.produce import produce
from taccorl.episodes.sources.mimicgen.attempt import Attempts
from taccorl.episodes.sources.mimicgen.augment import AugmentPlan, attempt_episode
from taccorl.episodes.sources.mimicgen.director import Ahead, ArmTarget
from taccorl.episodes.sources.mimicgen.disturbance import Disturbance, Exact, drifted
from taccorl.episodes.sources.mimicgen.from_dataset import read_sources
from taccorl.episodes.sources.mimicgen.source import SourcePool
from taccorl.episodes.sources.mimicgen.spec import DisturbanceSpec, load_mimic_spec, with_options
from taccorl.episodes.sources.mimicgen.stored import execute, state_digest
from taccorl.errors import DatasetError
from taccorl.lineage.store import Store
from taccorl.robots import ROBOT
from taccorl.sim.simulation import Simulation
from taccorl.tasks.assembly_2.scene import Assembly2

LEFT, RIGHT = np.r_[:6], np.r_[7:13]
SPEC = with_options(load_mimic_spec("assembly_2"), disturbance=DisturbanceSpec(joint_rad=0.02, time_s=0.7))
FREE = Ahead(math.inf, math.inf)


def arm_targets(left_m: float = 0.05, right_m: float = 0.05) -> dict[str, ArmTarget]:
    return {arm: ArmTarget(goal=np.eye(4), opening_m=m) for arm, m in zip(ROBOT.arms, (left_m, right_m), strict=True)}


def strengths_of(steps) -> np.ndarray:
    """(T, 2) of (arm_targets, ahead of the left, ahead of the right, is exact) in turn."""
    disturbance, found = Disturbance(DisturbanceSpec(joint_rad=0.02), np.random.default_rng(1)), []
    for arm_target, left, right, exact in steps:
        disturbance.update(arm_target, {"left": left, "right": right}, np.array(exact))
        found.append(disturbance.strength)
    return np.array(found)


def test_nothing_drifts_from_0_8_s_before_a_gripper_moves_to_0_4_s_after():
    # The left gripper moves in row 60 alone: it is 59 steps ahead after the first.
    ahead = [Ahead(59 - k if k < 60 else math.inf, math.inf) for k in range(100)]
    found = strengths_of([(arm_targets(0.05 if k < 60 else 0.01), ahead[k], FREE, (False, False)) for k in range(100)])
    left, right = found.T
    # 12 + 12 steps without before it, 12 after it, 12 steps of a ramp
    assert [left[k] for k in (0, 23, 29, 35, 47, 60, 72, 78, 84, 99)] == [1, 1, 0.5, 0, 0, 0, 0, 0.5, 1, 1]
    assert (right == 1).all()  # its own gripper rests


def test_nothing_drifts_from_0_4_s_before_contact_of_either_arm_nor_while_another_moves_it():
    contact = [Ahead(math.inf, max(40 - k, 0)) for k in range(60)]
    taken = [Ahead(0, 0)] * 20
    left = [*contact, *taken, *[FREE] * 40]
    found = strengths_of([(arm_targets(), each, FREE, (False, False)) for each in left])
    np.testing.assert_array_equal(found[:, 0], found[:, 1])
    assert [found[k, 0] for k in (0, 16, 22, 28, 40, 79)] == [1, 1, 0.5, 0, 0, 0]
    # 0.4 s after the last row that the expert moved, and a ramp; the other arm's contact keeps an arm only while it is ahead
    assert [found[k, 0] for k in (91, 97, 103, 119)] == [0, 0.5, 1, 1]


def test_an_exact_arm_does_not_drift_and_the_other_does():
    found = strengths_of([(arm_targets(), FREE, FREE, (k == 20, False)) for k in range(60)])
    assert [found[k, 0] for k in (19, 20, 32, 38, 44)] == [1, 0, 0, 0.5, 1]
    assert (found[:, 1] == 1).all()


def test_a_drift_has_the_spread_and_the_time_that_were_asked_for():
    rng, spec, off = np.random.default_rng(0), DisturbanceSpec(joint_rad=0.02, time_s=0.7), [np.zeros(12)]
    for _ in range(39_999):
        off.append(drifted(off[-1], spec, rng))
    off = np.array(off)
    np.testing.assert_allclose(off.std(0), 0.02, rtol=0.08)  # 40 000 rows are 1900 times 21: 1.6 % standard error
    lagged = [np.corrcoef(x[:-21], x[21:])[0, 1] for x in off.T]  # 0.7 s at 30 Hz
    np.testing.assert_allclose(np.mean(lagged), np.exp(-1), atol=0.03)
    assert np.abs(np.corrcoef(off.T) - np.eye(12)).max() < 0.15


def executed(joint_rad: float, exact=(False, False)) -> tuple[np.ndarray, np.ndarray]:
    """(60, 14) what is sent, and (14,) what was intended in each row."""
    disturbance, intended = Disturbance(DisturbanceSpec(joint_rad=joint_rad), np.random.default_rng(1)), None
    intended = ((ROBOT.action_low + ROBOT.action_high) / 2).astype(np.float32)
    sent = []
    for _ in range(60):
        disturbance.update(arm_targets(), {"left": FREE, "right": FREE}, np.array(exact))
        sent.append(disturbance.executed(intended))
    return np.array(sent), intended


def test_joints_are_pushed_and_openings_are_not():
    sent, intended = executed(0.02)
    assert sent.dtype == np.float32
    assert (sent[:, [6, 13]] == intended[[6, 13]]).all()
    assert (sent[0] == intended).all()  # a drift begins at 0
    assert (sent[1:, [*LEFT, *RIGHT]] != intended[[*LEFT, *RIGHT]]).all()
    one, _ = executed(0.02, exact=(True, False))
    assert (one[:, LEFT] == intended[LEFT]).all()
    np.testing.assert_array_equal(one[:, RIGHT], sent[:, RIGHT])
    far, _ = executed(50.0)
    assert ((far >= ROBOT.action_low.astype(np.float32)) & (far <= ROBOT.action_high.astype(np.float32))).all()


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


@pytest.fixture(scope="module", params=["replay", "closed_loop_expert"])
def pool(request, collected):
    spec = with_options(SPEC, contact_mode=request.param)
    return SourcePool(spec, read_sources(collected, spec))


@pytest.fixture(scope="module")
def pushed(pool):
    """The first attempt that succeeds."""
    attempts = Attempts(pool, Simulation(Assembly2()), seed=11)
    return next(done for k in range(8) if (done := attempts.run(k)).success)


@pytest.mark.slow
def test_a_disturbed_attempt_drifts_in_transport_and_is_exact_where_it_grips_and_joins(pushed, pool):
    sim = Simulation(Assembly2())
    sim.reset([pushed.scene_seed])
    exact, off = Exact(sim), np.abs(pushed.actions - pushed.intended)
    assert (off[:, [6, 13]] == 0).all()
    is_exact, touch = np.zeros((len(pushed.actions), 2), bool), []
    for t, action in enumerate(pushed.actions):
        is_exact[t] = exact.look()
        touch.append(bool(sim.contact("plug", "cradle").touching[0]))
        sim.step(action[None].astype(np.float64))
    met = touch.index(True)
    is_exact[met:] = True
    if (
        pool.spec.datagen_config.contact_mode == "closed_loop_expert"
    ):  # its own errors in contact are not intended either
        is_exact[met - 60 :] = False
    for a, joints in enumerate((LEFT, RIGHT)):
        assert is_exact[:, a].any()
        assert (off[is_exact[:, a], joints.min() : joints.max() + 1] == 0).all()
    assert state_digest(sim) == pushed.last_state  # what is stored is what was executed
    for a, (joints, column) in enumerate(((LEFT, 6), (RIGHT, 13))):
        closes = int(np.argmax(np.diff(pushed.actions[:, column]) < -0.002))
        assert (off[closes - 20 : closes + 12, joints] == 0).all(), a
        assert np.median(off[2 : closes - 40, joints]) > 0.005  # of a standard deviation of 0.02


@pytest.mark.slow
def test_rows_show_what_was_intended_and_keep_what_was_executed(pushed, pool):
    sim = Simulation(Assembly2())
    spec = AugmentPlan(spec=SPEC, images=False).contract(sim)
    done = execute(sim, pushed, spec, pool.spec.gates)
    assert not done.facts["differs"] and done.outcome == "success"
    episode = done.recorder.episode("pushed", {})
    np.testing.assert_array_equal(episode.arrays["action"], pushed.intended)
    np.testing.assert_array_equal(episode.arrays["sim.executed"], pushed.actions)
    # Where an arm is off, the action leads back: it does not move along with the joints.
    off = (pushed.actions - pushed.intended)[:, [*LEFT, *RIGHT]]
    led = (episode.arrays["action"] - episode.arrays["observation.state"])[:, [*LEFT, *RIGHT]]
    hard = np.abs(off) > 0.02
    assert np.corrcoef(off[hard], led[hard])[0, 1] < -0.5


@pytest.mark.slow
def test_a_disturbed_dataset_says_how_and_is_no_source(collected, tmp_path):
    store = Store(tmp_path / "store")
    plan = AugmentPlan(spec=SPEC, sources=store.dataset(collected), episodes=1, images=False)
    made = produce(plan, tmp_path / "new", store, lambda _: None).made
    episode = Dataset(tmp_path / "new").episode(0)
    told = episode.provenance["simulation"]
    assert told["mimicgen"]["disturbance"] == {"joint_rad": 0.02, "time_s": 0.7}
    assert not np.array_equal(episode.arrays["sim.executed"], episode.arrays["action"])
    (measured,) = read_dataset(tmp_path / "new")  # what is compared with the twin is what was sent
    np.testing.assert_array_equal(measured.target, episode.arrays["sim.executed"][:-1])
    merged = dataclasses.replace(episode, arrays={k: v for k, v in episode.arrays.items() if k != "sim.executed"})
    with pytest.raises(DatasetError, match=r"\(sim\.executed\) are not stored: merge omits them"):
        merged.executed()
    again = attempt_episode(
        store.find(plan.steps[0].stage, plan.config(made[-1].entry["attempt"]), plan.inputs(0)).path
    )
    for key in ("action", "sim.executed", "sim.state"):
        np.testing.assert_array_equal(again.arrays[key], episode.arrays[key])
    said = r"disturbed .*datagen_config/disturbance.* Give the dataset from which it was made"
    with pytest.raises(DatasetError, match=said):
        read_sources(tmp_path / "new", SPEC)

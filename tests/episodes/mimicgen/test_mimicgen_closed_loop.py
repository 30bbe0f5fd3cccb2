"""``closed_loop_expert``: the source's motion up to contact, pushed off its way, then hands that feel; sources pass the gates."""

import dataclasses
import math
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from ideal_hands import BOX, HZ, TOUCH_ROW, demonstration, mimic_spec, pose, scene

from taccorl.alignment.measurements.dataset_rows import read_dataset
from taccorl.data.dataset import Dataset
from taccorl.data.episode import EXECUTED, INTENDED
from taccorl.episodes.produce import produce
from taccorl.episodes.recorder import row_spec
from taccorl.episodes.sources.collect import CollectPlan
from taccorl.episodes.sources.mimicgen.attempt import Attempts, Generated, TwinScene
from taccorl.episodes.sources.mimicgen.augment import AugmentPlan, attempt_episode
from taccorl.episodes.sources.mimicgen.director import Ahead, ArmTarget, Director
from taccorl.episodes.sources.mimicgen.disturbance import Disturbance, Exact, drifted
from taccorl.episodes.sources.mimicgen.from_dataset import read_sources
from taccorl.episodes.sources.mimicgen.source import Source, SourcePool
from taccorl.episodes.sources.mimicgen.spec import (
    DisturbanceSpec,
    GatesSpec,
    MimicSpec,
    NoiseSpec,
    check_task,
    load_mimic_spec,
    with_options,
)
from taccorl.episodes.sources.mimicgen.stored import execute, state_digest
from taccorl.errors import DatasetError, SpecError, TaccorlError
from taccorl.lineage.store import Store
from taccorl.robots import ROBOT
from taccorl.sim.simulation import Simulation
from taccorl.sim.task import tasks
from taccorl.tasks.assembly_2.scene import Assembly2
from taccorl.tasks.experts import expert_of
from taccorl.tasks.experts.kinematics import ArmKinematics
from taccorl.tasks.experts.mating import Mating
from taccorl.tasks.experts.scripted import ScriptedExpert
from taccorl.tasks.experts.se3 import inverse

LEAD = 15  # GenerationSpec.contact_lead_steps
SEED = 13  # its first attempt succeeds after two corrections


# the director: who moves which hand when ----------------------------------------------------------------------------------


class Sinking:
    """Contact hands that go down by a millimetre a step: the left one for 5 steps, the right one for 8."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.draw = rng.random()
        self.taken: list[tuple[int, str, str]] = []
        self.left: dict[str, int] = {}
        self.arm_targets: dict[str, ArmTarget] = {}
        self.count = 0

    @property
    def corrections(self) -> list[tuple[int, str]]:
        return []

    def take(self, arm: str, subtask: str, arm_target: ArmTarget) -> None:
        self.taken.append((self.count, arm, subtask))
        self.left[arm], self.arm_targets[arm] = {"left": 5, "right": 8}[arm], arm_target

    def step(self) -> Mapping[str, ArmTarget]:
        self.count += 1
        going = [arm for arm, num in self.left.items() if num]
        for arm in going:
            self.left[arm] -= 1
            self.arm_targets[arm] = ArmTarget(
                goal=pose(0, 0, -0.001) @ self.arm_targets[arm].goal,
                opening_m=0.02,
                noisy=False,
            )
        return {arm: self.arm_targets[arm] for arm in going}


def directed(
    spec: MimicSpec, *, felt: bool, moved_m: float = 0.0, source: Source | None = None
) -> tuple[Director, dict[str, np.ndarray]]:
    """Arm → goals (steps, 4, 4) of a director with ideal hands, the plug moved."""
    world = scene(plug=pose(0.30 + moved_m, -0.16, 0.02))
    pool = SourcePool(spec, [source or demonstration(scene())])
    director = Director(
        pool,
        world,
        world.openings,
        np.random.default_rng(0),
        hz=HZ,
        contact_hands=Sinking if felt else None,
    )
    goals = {arm: [] for arm in BOX}
    while not director.done:
        for arm, arm_target in director.step(world).items():
            world.execute(arm, arm_target.goal, arm_target.opening_m)
            goals[arm].append(arm_target.goal)
    return director, {arm: np.array(of) for arm, of in goals.items()}


@pytest.mark.parametrize("scheme", ["replay", "none"])
def test_hands_are_taken_over_at_the_contact_row_and_left_alone_until_then(scheme):
    spec = mimic_spec(scheme, noise=NoiseSpec(position_m=0.002))
    _, replayed = directed(spec, felt=False, moved_m=0.05)
    director, goals = directed(spec, felt=True, moved_m=0.05)
    hands = director.contact_hands
    assert isinstance(hands, Sinking)
    assert [
        (arm, subtask) for _, arm, subtask in sorted(hands.taken, key=lambda t: t[1])
    ] == [("left", "join cradle"), ("right", "join plug")]
    at = {arm: step for step, arm, _ in hands.taken}
    first = min(at.values())
    assert first >= TOUCH_ROW - LEAD  # the bridges come on top
    for arm in BOX:  # up to then draws of the noise are the same, too
        np.testing.assert_array_equal(goals[arm][:first], replayed[arm][:first])
        assert (goals[arm][at[arm]] != replayed[arm][at[arm]]).any()
    assert (at["left"] == at["right"]) == (
        scheme == "replay"
    )  # apart, each has its own time


def test_a_source_that_touches_nothing_is_replayed_to_its_end():
    source = demonstration(scene())
    untouched = dataclasses.replace(
        source, mated={body: np.zeros_like(of) for body, of in source.mated.items()}
    )
    director, _ = directed(mimic_spec(), felt=True, source=untouched)
    assert isinstance(director.contact_hands, Sinking)
    assert director.contact_hands.taken == []


# in the twin --------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def sim():
    return Simulation(Assembly2())


@pytest.fixture(scope="module")
def pools(collected) -> dict[str, SourcePool]:
    spec = load_mimic_spec("assembly_2")
    sources = read_sources(collected, spec)
    modes = ("replay", "closed_loop_expert")
    return {
        mode: SourcePool(with_options(spec, contact_mode=mode), sources)
        for mode in modes
    }


@pytest.fixture(scope="module")
def felt(pools, sim) -> Generated:
    """The first attempt that succeeds after a correction by touch at the mouth."""
    attempts = Attempts(pools["closed_loop_expert"], sim, SEED)
    return next(
        done
        for k in range(12)
        if (done := attempts.run(k)).success and at_the_mouth(done)
    )


def at_the_mouth(done: Generated) -> list[int]:
    """Rows of corrections of what is blocked less than 4 mm deep; deeper, the walls go on pressing."""
    corrections = done.provenance["corrections"]
    assert isinstance(corrections, list)
    return [
        row
        for row, what in corrections
        if float(re.search(r"blocked at (\S+) mm", what)[1]) < 4
    ]  # pyright: ignore


@pytest.fixture(scope="module")
def replayed(pools, sim, felt) -> Generated:
    """The same attempt without touch."""
    return Attempts(pools["replay"], sim, SEED).run(felt.attempt)


def forces_n(sim: Simulation, done: Generated) -> np.ndarray:
    """(T,) between the parts, after each action."""
    sim.reset([done.scene_seed])
    forces = []
    for action in done.actions:
        sim.step(action[None].astype(np.float64))
        forces.append(float(sim.contact("plug", "cradle").force_n[0]))
    return np.array(forces)


@pytest.mark.slow
def test_up_to_contact_it_is_the_replay_bit_for_bit_and_from_then_on_it_is_not(
    sim, felt, replayed
):
    num = min(len(felt.actions), len(replayed.actions))
    differs = (felt.actions[:num] != replayed.actions[:num]).any(axis=1)
    taken = int(np.argmax(differs))
    assert differs[taken:].mean() > 0.99
    touched = int(np.argmax(forces_n(sim, replayed) > 0))
    # 15 steps before the source touches; this scene is another
    assert touched - 3 * LEAD < taken <= touched - LEAD // 2
    assert not forces_n(sim, felt)[:taken].any()


@pytest.mark.slow
def test_the_provenance_says_who_moved_the_hands_and_what_was_felt(felt, replayed):
    assert felt.provenance["contact_mode"] == "closed_loop_expert"
    assert replayed.provenance["contact_mode"] == "replay"
    assert "corrections" not in replayed.provenance
    assert felt.provenance["spec"] != replayed.provenance["spec"]
    corrections = felt.provenance["corrections"]
    assert isinstance(corrections, list)
    assert all("right: blocked at" in what for _, what in corrections)


@pytest.mark.slow
def test_the_action_of_a_row_aims_at_the_hole_where_the_hand_aimed_beside_it(
    sim, felt, replayed
):
    assert felt.provenance[INTENDED] is True and INTENDED not in replayed.provenance
    assert replayed.intended is None
    task = sim.task
    mating = Mating.of(task.plug, task.holder, task.hole)
    kinematics, right = (
        ArmKinematics("right", sim.config.robot),
        ROBOT.joint_slice("right"),
    )
    sim.reset([felt.scene_seed])
    scene, off_m = TwinScene(sim), []
    for action, intended in zip(felt.actions, felt.intended, strict=True):
        depth_m = float(mating.fit(scene).depth_m)
        if -0.019 < depth_m < -0.002 and (action != intended)[right].any():
            # x and y in the hole's frame of the plug's leading end, if the hand were at the executed or the intended target.
            hole = scene.body(mating.holder) @ mating.holder_from_hole
            held = (
                inverse(scene.tcp("right"))
                @ scene.body(mating.held)
                @ mating.held_from_mate
            )
            bias_rad = sim.proprioception()[0, right] - action[right]
            poses = [
                kinematics.pose(x[right].astype(float) + bias_rad) @ held
                for x in (action, intended)
            ]
            off_m.append([(inverse(hole) @ pose)[:2, 3] for pose in poses])
        sim.step(action[None].astype(np.float64))
    executed, meant = np.array(off_m).transpose(1, 0, 2)
    assert len(off_m) > 10
    errors = np.linalg.norm(executed - meant, axis=1)
    assert 0.0003 < np.median(errors) < 0.004  # an aim 1 mm off on each axis
    assert np.median(np.linalg.norm(meant, axis=1)) < np.median(
        np.linalg.norm(executed, axis=1)
    )


@pytest.mark.slow
def test_it_is_bit_identical_in_another_simulation_whatever_ran_before(pools, felt):
    attempts = Attempts(pools["closed_loop_expert"], Simulation(Assembly2()), SEED)
    attempts.run(felt.attempt + 1)
    again = attempts.run(felt.attempt)
    np.testing.assert_array_equal(again.actions, felt.actions)
    assert again.last_state == felt.last_state
    assert again.provenance == felt.provenance


@pytest.mark.slow
def test_a_success_is_executed_again_from_its_actions(sim, felt):
    rows = row_spec(sim, pictures=False, executed=True)
    done = execute(sim, felt, rows, GatesSpec())
    assert not done.facts["differs"] and done.outcome == "success"
    np.testing.assert_array_equal(
        [row[EXECUTED] for row in done.recorder.rows], felt.actions
    )
    np.testing.assert_array_equal(
        [row["action"] for row in done.recorder.rows], felt.intended
    )
    gates = felt.provenance["gates"]
    assert isinstance(gates, dict)
    assert 3 < gates["force_n"] < 80


@pytest.mark.slow
@pytest.mark.parametrize("task", ["assembly_1", "puzzle", "test_tube"])
def test_every_task_is_finished_by_its_expert(task, tmp_path: Path):
    plan = CollectPlan(task=task, episodes=1, images=False, seed=3)
    produce(plan, tmp_path / "dataset", Store(tmp_path / "store"), lambda _: None)
    spec = with_options(load_mimic_spec(task), contact_mode="closed_loop_expert")
    attempts = Attempts(
        SourcePool(spec, read_sources(tmp_path / "dataset", spec)),
        Simulation(tasks.get(task)()),
        SEED,
    )
    done = [attempts.run(k) for k in range(3)]
    assert sum(d.success for d in done) >= 2, [d.outcome for d in done]
    if (
        task == "puzzle"
    ):  # three pieces, each felt into its hole, the source's motion between
        felt = [
            what.split(" blocked")[0]
            for d in done
            for _, what in d.provenance["corrections"]
        ]  # pyright: ignore
        assert {"right: triangle", "left: circle", "right: heart"} <= set(felt)


# specs --------------------------------------------------------------------------------------------------------------------


def test_options_are_checked_like_a_file():
    spec = load_mimic_spec("assembly_2")
    with pytest.raises(
        TaccorlError,
        match=r"contact_mode: 'replai' is not one of replay, .*did you mean 'replay'",
    ):
        with_options(spec, contact_mode="replai")
    closed = with_options(spec, contact_mode="closed_loop_expert")
    check_task(closed, Assembly2())
    assert closed.digest != spec.digest
    with pytest.raises(
        SpecError, match="assembly_2: datagen_config → retarget: eef_command"
    ):
        check_task(with_options(closed, retarget="eef_command"), Assembly2())


def test_an_expert_that_cannot_begin_in_the_middle_is_refused(monkeypatch, pools, sim):
    expert = expert_of(tasks.get("assembly_2"))
    assert expert.can_finish()
    monkeypatch.setattr(expert, "finish", ScriptedExpert.finish)
    said = r"the expert of assembly_2 cannot start in the middle of a subtask: .* finish\(\)"
    with pytest.raises(SpecError, match=said):
        check_task(pools["closed_loop_expert"].spec, Assembly2())
    with pytest.raises(SpecError, match=said):
        Attempts(pools["closed_loop_expert"], sim, SEED)
    check_task(pools["replay"].spec, Assembly2())
    sim.reset([0])
    with pytest.raises(TaccorlError, match="cannot start within 'insert plug'"):
        expert(sim, np.random.default_rng(0)).finish("right", "insert plug")


LEFT, RIGHT = np.r_[:6], np.r_[7:13]
SPEC = with_options(
    load_mimic_spec("assembly_2"),
    disturbance=DisturbanceSpec(joint_rad=0.02, time_s=0.7),
)
FREE = Ahead(math.inf, math.inf)


def arm_targets(left_m: float = 0.05, right_m: float = 0.05) -> dict[str, ArmTarget]:
    return {
        arm: ArmTarget(goal=np.eye(4), opening_m=m)
        for arm, m in zip(ROBOT.arms, (left_m, right_m), strict=True)
    }


def strengths_of(steps) -> np.ndarray:
    """(T, 2) of (arm_targets, ahead of the left, ahead of the right, is exact) in turn."""
    disturbance, found = (
        Disturbance(DisturbanceSpec(joint_rad=0.02), np.random.default_rng(1)),
        [],
    )
    for arm_target, left, right, exact in steps:
        disturbance.update(arm_target, {"left": left, "right": right}, np.array(exact))
        found.append(disturbance.strength)
    return np.array(found)


def test_nothing_drifts_from_0_8_s_before_a_gripper_moves_to_0_4_s_after():
    # The left gripper moves once, from row 59 to row 60: in row k that is 59 − k steps ahead.
    ahead = [Ahead(59 - k if k < 60 else math.inf, math.inf) for k in range(100)]
    found = strengths_of(
        [
            (arm_targets(0.05 if k < 60 else 0.01), ahead[k], FREE, (False, False))
            for k in range(100)
        ]
    )
    left, right = found.T
    # 12 + 12 steps without before it, 12 after it, 12 steps of a ramp
    assert [left[k] for k in (0, 23, 29, 35, 47, 60, 72, 78, 84, 99)] == [
        1,
        1,
        0.5,
        0,
        0,
        0,
        0,
        0.5,
        1,
        1,
    ]
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
    found = strengths_of(
        [(arm_targets(), FREE, FREE, (k == 20, False)) for k in range(60)]
    )
    assert [found[k, 0] for k in (19, 20, 32, 38, 44)] == [1, 0, 0, 0.5, 1]
    assert (found[:, 1] == 1).all()


def test_a_drift_has_the_spread_and_the_time_that_were_asked_for():
    rng, spec, off = (
        np.random.default_rng(0),
        DisturbanceSpec(joint_rad=0.02, time_s=0.7),
        [np.zeros(12)],
    )
    for _ in range(39_999):
        off.append(drifted(off[-1], spec, rng))
    off = np.array(off)
    np.testing.assert_allclose(
        off.std(0), 0.02, rtol=0.08
    )  # 40 000 rows are 1900 times 21: 1.6 % standard error
    lagged = [np.corrcoef(x[:-21], x[21:])[0, 1] for x in off.T]  # 0.7 s at 30 Hz
    np.testing.assert_allclose(np.mean(lagged), np.exp(-1), atol=0.03)
    assert np.abs(np.corrcoef(off.T) - np.eye(12)).max() < 0.15


def executed(joint_rad: float, exact=(False, False)) -> tuple[np.ndarray, np.ndarray]:
    """(60, 14) what is sent, and (14,) what was intended in each row."""
    disturbance, intended = (
        Disturbance(DisturbanceSpec(joint_rad=joint_rad), np.random.default_rng(1)),
        None,
    )
    intended = ((ROBOT.action_low + ROBOT.action_high) / 2).astype(np.float32)
    sent = []
    for _ in range(60):
        disturbance.update(
            arm_targets(), {"left": FREE, "right": FREE}, np.array(exact)
        )
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
    assert (
        (far >= ROBOT.action_low.astype(np.float32))
        & (far <= ROBOT.action_high.astype(np.float32))
    ).all()


def test_an_arm_is_exact_that_grips_on_the_table_and_both_are_once_parts_have_met(
    collected,
):
    episode, sim = Dataset(collected).episode(1), Simulation(Assembly2())
    sim.reset(episode.arrays["sim.seed"][0])
    exact, found, touch = Exact(sim), [], []
    for action in episode.arrays["action"]:
        found.append(exact.look())
        touch.append(bool(sim.contact("plug", "cradle").touching[0]))
        sim.step(action[None].astype(np.float64))
    found, met = np.array(found), touch.index(True)
    assert not all(
        touch[met:]
    )  # inside its play the plug does not touch all the time …
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
def test_a_disturbed_attempt_drifts_in_transport_and_is_exact_where_it_grips_and_joins(
    pushed, pool
):
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
        assert (
            np.median(off[2 : closes - 40, joints]) > 0.005
        )  # of a standard deviation of 0.02


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
    led = (episode.arrays["action"] - episode.arrays["observation.state"])[
        :, [*LEFT, *RIGHT]
    ]
    hard = np.abs(off) > 0.02
    assert np.corrcoef(off[hard], led[hard])[0, 1] < -0.5


@pytest.mark.slow
def test_a_disturbed_dataset_says_how_and_is_no_source(collected, tmp_path):
    store = Store(tmp_path / "store")
    plan = AugmentPlan(
        spec=SPEC, sources=store.dataset(collected), episodes=1, images=False
    )
    made = produce(plan, tmp_path / "new", store, lambda _: None).made
    episode = Dataset(tmp_path / "new").episode(0)
    told = episode.provenance["simulation"]
    assert told["mimicgen"]["disturbance"] == {"joint_rad": 0.02, "time_s": 0.7}
    assert not np.array_equal(episode.arrays["sim.executed"], episode.arrays["action"])
    (measured,) = read_dataset(
        tmp_path / "new"
    )  # what is compared with the twin is what was sent
    np.testing.assert_array_equal(measured.target, episode.arrays["sim.executed"][:-1])
    merged = dataclasses.replace(
        episode, arrays={k: v for k, v in episode.arrays.items() if k != "sim.executed"}
    )
    with pytest.raises(
        DatasetError, match=r"\(sim\.executed\) are not stored: merge omits them"
    ):
        merged.executed()
    again = attempt_episode(
        store.find(
            plan.steps[0].stage, plan.config(made[-1].entry["attempt"]), plan.inputs(0)
        ).path
    )
    for key in ("action", "sim.executed", "sim.state"):
        np.testing.assert_array_equal(again.arrays[key], episode.arrays[key])
    said = r"disturbed .*datagen_config/disturbance.* Give the dataset from which it was made"
    with pytest.raises(DatasetError, match=said):
        read_sources(tmp_path / "new", SPEC)

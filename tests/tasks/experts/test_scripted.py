"""The scripted demonstrator's hands: where they go, what they learn, what they feel, and that a seed decides it all."""

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.part import Part
from taccorl.sim.simulation import Simulation
from taccorl.sim.task import tasks
from taccorl.sim.twin import PhysicsConfig, TwinConfig
from taccorl.tasks.assembly_1.scene import Assembly1
from taccorl.tasks.experts import expert_of
from taccorl.tasks.experts.hands import (
    DT_S,
    EXACT,
    Pulses,
    ScriptedExpertConfig,
    follow,
)
from taccorl.tasks.experts.mating import Aim, Mating, deflection
from taccorl.tasks.experts.scripted import Script, ScriptedExpert
from taccorl.tasks.experts.se3 import inverse, rotvec, transform, turn


class OneHand(ScriptedExpert):
    """The left arm does what a test asks for, the right one nothing."""

    def __init__(
        self,
        sim: Simulation,
        work: Callable[["OneHand"], Script],
        config=EXACT,
        seed: int = 0,
    ) -> None:
        super().__init__(sim, np.random.default_rng(seed), config)
        self.work = work
        sim.reset([0])
        self.start()

    def script(self, arm: str) -> Script:
        return self.work(self) if arm == "left" else iter(())


@pytest.fixture(scope="module")
def sim() -> Simulation:
    return Simulation(Assembly1(), scale=0.0)


def run(
    expert: OneHand, each: Callable[[], object] = lambda: None, longest: int = 300
) -> list:
    seen = []
    for _ in range(longest):
        expert.sim.step(expert.act()[None])
        seen.append(each())
        if expert.done:
            return seen
    raise AssertionError("the script never ended")


def shifted(pose: np.ndarray, by_m: tuple) -> np.ndarray:
    goal = pose.copy()
    goal[:3, 3] += by_m
    return goal


def off_m(expert: OneHand) -> float:
    return float(
        np.linalg.norm(expert.tcp("left")[:3, 3] - expert.hands["left"].pose[:3, 3])
    )


def forgetful(learns: bool) -> Callable[[OneHand], Script]:
    """Forget the bias, then move by 60 mm and settle."""

    def work(expert: OneHand) -> Script:
        hand = expert.hands["left"]
        hand.bias_rad, hand.learns = np.zeros(6), learns
        yield from expert.move(
            "left", shifted(hand.pose, (0.05, 0.02, -0.02)), settle=True
        )

    return work


def test_the_hand_learns_how_far_its_joints_rest_from_their_targets(sim):
    expert = OneHand(sim, forgetful(learns=True))
    run(expert)
    assert off_m(expert) < 5e-4
    rest = np.array(ROBOT.torque_ff_nm) / ROBOT.kp_nm_per_rad
    assert rest[4] == pytest.approx(0.01145, abs=1e-5)
    # What is left after a settle may still be 0.4 mm over a lever of 0.26 m.
    np.testing.assert_allclose(expert.hands["left"].bias_rad, rest, atol=0.002)


def test_a_move_ends_where_it_was_asked_to_and_is_fastest_in_the_middle(sim):
    goals = {}

    def work(expert: OneHand) -> Script:
        goals["from"] = expert.hands["left"].pose.copy()
        goals["to"] = shifted(goals["from"] @ turn((0, 0.1, 0)), (0, -0.1, 0))
        yield from expert.move("left", goals["to"], speed_mps=0.1)

    expert = OneHand(sim, work)
    poses = run(expert, lambda: expert.hands["left"].pose.copy())
    np.testing.assert_allclose(poses[-1], goals["to"], atol=1e-12)
    # the last step has no new arm_target
    path_m = np.array([goals["from"][1, 3], *(pose[1, 3] for pose in poses[:-1])])
    steps_m = -np.diff(path_m)
    assert len(steps_m) == round(
        1.875 * 0.1 / 0.1 * 30
    )  # a minimum jerk's peak is 15/8 of its mean speed
    assert steps_m.max() / DT_S == pytest.approx(0.1, rel=0.01)
    assert steps_m[0] < 0.002 * 0.1  # 10 x³ of the way after one of 56 steps
    assert steps_m[-1] < 0.002 * 0.1
    assert steps_m.argmax() in (len(steps_m) // 2 - 1, len(steps_m) // 2)


def test_closing_asks_for_the_part_less_what_motor_and_pads_give(sim):
    expert = OneHand(sim, lambda expert: expert.close("left", 0.030, force_n=30.0))
    run(expert)
    robot = sim.config.robot
    motor_m, pad_m = (
        30.0 / robot.grip_stiffness_n_per_m,
        30.0 / robot.pad_stiffness_n_per_m,
    )
    assert motor_m == pytest.approx(0.015)  # 30 N / 2000 N/m
    assert expert.hands["left"].opening_m == pytest.approx(0.030 - 0.015 - 2 * pad_m)


def socket(sim: Simulation) -> Part:
    assert isinstance(sim.task, Assembly1)
    return sim.task.holder


def wander(expert: OneHand) -> Script:
    home = expert.hands["left"].pose.copy()
    part = socket(expert.sim)
    yield from expert.move("left", expert.near(shifted(home, (0.03, 0.03, 0))))
    yield from expert.pause("left")
    yield from expert.move(
        "left", expert.grasp(part, "tail", lean_rad=0.4, lift_m=0.05, pivot_m=0.02)
    )


def actions(sim: Simulation, config: ScriptedExpertConfig, seed: int) -> np.ndarray:
    expert = OneHand(sim, wander, config, seed)
    made = []
    for _ in range(75):
        made.append(expert.act())
        sim.step(made[-1][None])
    return np.array(made)


def test_the_tremor_has_the_spread_that_was_asked_for(sim):
    expert = OneHand(
        sim, lambda expert: expert.pause("left", 1e3, 1e3), ScriptedExpertConfig()
    )
    hand, seen = expert.hands["left"], []
    for _ in range(3000):
        expert._shaken(hand)
        seen.append(hand.tremor)
    spread = np.std(seen[30:], axis=0)
    # 100 s of a noise that is correlated over 0.3 s are some 170 independent draws: ±5 % a standard deviation, three of them
    np.testing.assert_allclose(spread, [4e-4] * 3 + [4e-3] * 3, rtol=0.2)


def test_a_lean_turns_the_hand_about_the_part_and_not_about_the_tcp(sim):
    expert, part = OneHand(sim, wander), socket(sim)
    upright = expert.grasp(part, "tail")
    leaning = expert.grasp(part, "tail", lean_rad=0.3, pivot_m=0.025)
    spot = (0, 0, 0.025, 1)
    np.testing.assert_allclose(leaning @ spot, upright @ spot, atol=1e-15)
    np.testing.assert_allclose(rotvec(upright, leaning), (0, 0.3, 0), atol=1e-12)
    assert (leaning[:3, 3] - upright[:3, 3]) @ upright[:3, 0] == pytest.approx(
        -0.025 * np.sin(0.3)
    )  # from −x


def test_grips_miss_what_is_meant_by_the_spread_that_was_asked_for(sim):
    config = ScriptedExpertConfig(grasp_m=0.004, grasp_rad=0.06)
    expert, meant = OneHand(sim, wander, config), transform((0.3, 0.1, 0.2))
    grips = [inverse(meant) @ expert.gripped(meant) for _ in range(2000)]
    x, y, z = np.array([grip[:3, 3] for grip in grips]).T
    # x: normal, turned by some 0.06 rad; z: 2 |N| − 1, with mean 2 √(2 / π) − 1 = 0.596 and deviation 2 √(1 − 2 / π) = 1.206
    assert np.std(x) == pytest.approx(0.004, rel=0.08) and abs(
        np.mean(x)
    ) < 3 * 0.004 / np.sqrt(2000)
    assert np.mean(z) == pytest.approx(0.596 * 0.004, rel=0.15) and np.std(
        z
    ) == pytest.approx(1.206 * 0.004, rel=0.08)
    assert np.abs(y).max() < 0.002
    turned = np.array([rotvec(np.eye(4), grip) for grip in grips])
    np.testing.assert_allclose(
        np.std(turned, axis=0), np.array((0.3, 1, 0.3)) * 0.06, rtol=0.1
    )


def test_the_target_of_a_reach_is_the_grip_that_was_meant_and_the_hand_goes_elsewhere(
    sim,
):
    meant: list[np.ndarray] = []

    def work(expert: OneHand) -> Script:
        meant.append(shifted(expert.hands["left"].pose, (0.05, 0, -0.03)))
        yield from expert.reach(
            "left",
            meant[0],
            lambda pose: pose @ transform((0, 0, -0.02)),
            speed_mps=0.1,
        )

    for config in (ScriptedExpertConfig(grasp_m=0.004), EXACT):
        meant.clear()
        expert = OneHand(sim, work, config, seed=4)
        run(expert)
        hand = expert.hands["left"]
        np.testing.assert_allclose(hand.intended, meant[0], atol=1e-12)
        off_m = np.linalg.norm(hand.pose[:3, 3] - meant[0][:3, 3])
        assert off_m > 0.002 if config.grasp_m else off_m < 1e-12


def test_actions_stay_within_the_limits_whatever_is_asked(sim):
    def work(expert: OneHand) -> Script:
        expert.hands["left"].opening_m = 0.2
        yield from expert.move(
            "left", shifted(expert.hands["left"].pose, (0.8, 0, 0.5)), speed_mps=1.0
        )

    expert = OneHand(sim, work)
    made = np.array(run(expert, expert.act))
    assert made.dtype == np.float32
    assert (made >= ROBOT.action_low).all()
    assert (made <= ROBOT.action_high).all()
    assert not sim.clipped.any()
    assert expert.unreachable_m > 0.1  # and what could not be reached is told


def test_a_lag_follows_a_ramp_as_its_differential_equation_says():
    lag_s, num = np.array(ROBOT.kd_nms_per_rad) / ROBOT.kp_nm_per_rad, 20_000
    start, before, after = np.full(6, 0.1), np.full(6, 0.15), np.full(6, 0.25)
    x = start.copy()
    for k in range(num):  # Euler: wrong by some 1 / num of the way
        target = before + (after - before) * (k + 0.5) / num
        x = x + DT_S / num * (target - x) / lag_s
    np.testing.assert_allclose(follow(start, before, after, lag_s), x, atol=1e-6)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_known_force_is_felt_in_its_direction_and_size(sim, axis):
    expert = OneHand(sim, lambda expert: expert.pause("left", 1.0, 1.0))
    hand = expert.hands["left"]
    hand.learns = False
    body = sim.model.body("left_link6").id
    force_n = np.zeros(6)
    force_n[axis] = 5.0
    xfrc = sim.batch.bind("xfrc_applied")
    xfrc[0, body] = force_n
    try:
        run(expert)
    finally:
        xfrc[0, body] = 0.0
    # Δq = K⁻¹ Jᵀ F, the force at the body's centre of mass; finite differences for both Jacobians
    kinematics, joints = expert.kinematics["left"], hand.joints_rad
    com = np.r_[sim.model.body_ipos[body] - (0, 0, 0.168), 1.0]
    columns, tcp_columns = np.zeros((3, 6)), np.zeros((3, 6))
    for j, nudge in enumerate(np.eye(6) * 1e-6):
        plus, minus = kinematics.pose(joints + nudge), kinematics.pose(joints - nudge)
        columns[:, j], tcp_columns[:, j] = (
            ((plus - minus) @ com)[:3] / 2e-6,
            (plus - minus)[:3, 3] / 2e-6,
        )
    expected = tcp_columns @ (columns.T @ force_n[:3] / ROBOT.kp_nm_per_rad)
    pushed = expert.pushed("left")[:3]
    assert pushed[axis] > 2e-4
    np.testing.assert_allclose(pushed, expected, atol=5e-5)


class Still:
    """A scene in which the holder stands still: all that ``Aim`` asks for."""

    def __init__(self, holder: np.ndarray) -> None:
        self.holder = holder

    def body(self, name: str) -> np.ndarray:
        return self.holder


@pytest.fixture
def aim() -> tuple[Still, Mating, Aim]:
    rng = np.random.default_rng(8)
    task = Assembly1()
    still = Still(transform((0.3, 0.05, 0.2)) @ turn(rng.normal(size=3)))
    part_from_tcp = task.plug.grasps["head"].part_from_tcp @ turn((0, 0.4, 0))
    return still, Mating.of(task.plug, task.holder, "mortise"), Aim(
        off_m=np.array((0.001, -0.0005)), off_rad=np.array((0.01, 0, -0.02)), part_from_tcp=part_from_tcp, turned=np.eye(4)
    )  # fmt: skip


def test_an_error_of_direction_turns_the_part_about_its_leading_end(aim):
    still, mating, aimed = aim
    mate = (
        aimed.pose(still, mating, 0.0)
        @ inverse(aimed.part_from_tcp)
        @ mating.held_from_mate
    )
    off = inverse(still.holder @ mating.holder_from_hole) @ mate
    np.testing.assert_allclose(off[:3, 3], (0.001, -0.0005, 0), atol=1e-15)
    np.testing.assert_allclose(rotvec(np.eye(4), off), (0.01, 0, -0.02), atol=1e-12)


def test_what_is_intended_is_the_action_without_tremor_and_error_of_the_aim(sim):
    def work(expert: OneHand) -> Script:
        yield from expert.move("left", goal, intended=lambda: exact)
        for _ in range(30):
            yield

    for config in (EXACT, replace(EXACT, tremor_m=0.0004, tremor_rad=0.004)):
        sim.reset([0])
        start = sim.tcp("left")[0]
        goal, exact = (
            shifted(start, (0.02, 0.001, 0.03)),
            shifted(start, (0.02, 0, 0.03)),
        )
        expert = OneHand(sim, work, config)
        left, kinematics = ROBOT.joint_slice("left"), expert.kinematics["left"]
        off_m, shaken = [], []
        for _ in range(60):
            action = expert.act()
            intended = expert.intended(action)
            bias_rad = expert.hands["left"].bias_rad
            meant, sent = (
                kinematics.pose(x[left].astype(float) + bias_rad)
                for x in (intended, action)
            )
            off_m.append(sent[:3, 3] - meant[:3, 3])
            shaken.append(
                np.linalg.norm(sent[:3, 3] - expert.hands["left"].pose[:3, 3])
            )
            sim.step(action[None])
            if expert.done:
                break
        np.testing.assert_allclose(off_m[0], 0, atol=1e-3)
        if config is EXACT:  # the right arm does not move; the left one is 1 mm beside
            right = ROBOT.joint_slice("right")
            np.testing.assert_allclose(intended[right], action[right], atol=1e-5)
            np.testing.assert_allclose(off_m[-2], (0, 0.001, 0), atol=2e-5)
            assert np.all(np.diff([y for _, y, _ in off_m[:-1]]) > -2e-5)
        else:  # the last intended target does not tremble
            np.testing.assert_allclose(meant[:3, 3], exact[:3, 3], atol=2e-5)
            assert max(shaken) > 1e-4


def test_a_pulse_is_a_squared_sine_at_random_times():
    pulses, seen, displaced = Pulses(0.02, np.random.default_rng(3)), [], []
    for _ in range(600):
        seen.append(pulses.next_rad(allowed=True))
        displaced.append(pulses.displaces)
    seen = np.array(seen)
    at = np.flatnonzero(np.abs(seen).max(1) > 0)
    runs = np.split(at, np.flatnonzero(np.diff(at) > 1) + 1)
    assert len(runs) >= 3
    for run in runs:
        n = len(run)
        assert 8 <= n <= 22 and displaced[run[-1] + 3] and not displaced[run[-1] + 6]
        shape = np.sin(np.pi * np.arange(1, n + 1) / (n + 1)) ** 2
        np.testing.assert_allclose(
            seen[run], shape[:, None] * seen[run[n // 2]] / shape[n // 2], atol=1e-12
        )
    amplitudes = np.concatenate([np.abs(seen[run]).max(0) for run in runs])
    assert 0.005 < np.sqrt(np.mean(amplitudes**2)) < 0.04


@pytest.mark.parametrize(
    ("task", "held", "resting"),
    [
        ("assembly_1", "plug", ()),
        pytest.param("test_tube", "tube", ("left",), marks=pytest.mark.slow),
    ],
)
def test_pulses_come_at_rest_and_in_the_grip_but_not_before_the_hole_or_on_what_stands(
    task, held, resting
):
    sim = Simulation(
        tasks.get(task)(), TwinConfig(physics=PhysicsConfig(steps_per_control_step=20))
    )
    sim.reset([4])
    expert = expert_of(sim.task)(
        sim, np.random.default_rng(4), ScriptedExpertConfig(pulse_rad=0.02)
    )
    expert.start()
    near, pulsed = 0, {"open": 0, "gripped": 0}
    while not expert.done and expert.step_count < 900:
        hands, mating = expert.hands, expert.hands["right"].mating
        is_near = mating is not None and mating.fit(expert).depth_m > -0.008
        rests = {arm for arm in resting if hands[arm].rests}
        holds = sim.pads_touching(held)[0, 2:].all()
        sim.step(expert.act()[None])
        moved = {arm for arm, rad in expert._pulse_rad.items() if rad.any()}
        assert not (moved if is_near else moved & rests)
        near += is_near
        if moved:
            pulsed["gripped" if holds else "open"] += 1
    assert near > 60 and min(pulsed.values()) > 20  # of some 400 steps
    assert expert.hands["right"].mating is None  # let go


def test_what_is_intended_and_what_the_hand_learns_have_no_pulses(sim):
    def slowly(expert: OneHand) -> Script:
        yield from expert.move(
            "left",
            shifted(expert.hands["left"].pose, (0.03, 0.03, 0.03)),
            speed_mps=0.02,
        )

    meant, off_rad = [], []
    for pulse_rad in (0.05, 0.0):
        expert = OneHand(sim, slowly, replace(EXACT, pulse_rad=pulse_rad), seed=2)
        for _ in range(140):
            action = expert.act()
            meant.append(expert.intended(action))
            off_rad.append(np.abs(meant[-1] - action).max())
            sim.step(action[None])
    assert max(off_rad[:140]) > 0.02 and max(off_rad[140:]) < 1e-4
    # The estimated offset of the joints differs a little, as the arm is elsewhere when it is estimated.
    np.testing.assert_allclose(meant[:140], meant[140:], atol=0.004)


def test_a_motion_without_an_aim_brings_what_is_intended_back_to_the_pose(sim):
    def work(expert: OneHand) -> Script:
        yield from expert.move("left", goal, intended=lambda: exact)
        yield from expert.move("left", start)

    sim.reset([0])
    start = sim.tcp("left")[0]
    goal, exact = shifted(start, (0, 0.001, 0.01)), shifted(start, (0, 0, 0.01))
    expert = OneHand(sim, work)
    run(expert)
    np.testing.assert_allclose(
        expert.hands["left"].intended, expert.hands["left"].pose, atol=1e-12
    )


def test_a_wrist_that_is_held_aside_gives_way_until_nothing_pushes_but_along_the_axis(
    aim,
):
    still, mating, aimed = aim
    wanted = aimed.pose(still, mating, 0.01)
    hole = (still.holder @ mating.holder_from_hole)[:3, :3]
    held = wanted @ turn(
        (0.01, -0.02, 0.015)
    )  # a vice holds the hand 1 mm aside, 2 mm back and turned by 27 mrad
    held[:3, 3] += hole @ (0.0008, -0.0006, -0.002)
    sizes = []
    for _ in range(60):
        pushed = deflection(aimed.pose(still, mating, 0.01), held)
        sizes.append(
            np.linalg.norm(np.r_[(hole.T @ pushed[:3])[:2], 0.15 * pushed[3:]])
        )
        aimed = aimed.giving_way(still, mating, 0.1 * pushed)
    assert all(
        after < 0.93 * before for before, after in pairwise(sizes)
    )  # a tenth less each time
    left = deflection(aimed.pose(still, mating, 0.01), held)
    np.testing.assert_allclose(
        hole.T @ left[:3], (0, 0, -0.002), atol=5e-6
    )  # what holds it back, it still feels
    np.testing.assert_allclose(left[3:], 0, atol=1e-4)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("pulse_rad", -0.02),
        ("pulse_rad", 100.0),
        ("grasp_m", math.nan),
        ("grasp_m", 0.2),
        ("aim_m", math.inf),
        ("speed", 0.0),
    ],
)
def test_hands_that_make_no_sense_are_refused(name, value):
    with pytest.raises(TaccorlError, match=rf"hands\.{name}="):
        ScriptedExpertConfig(**{name: value})


def test_one_expert_drives_one_simulation():
    with pytest.raises(TaccorlError, match="one simulation, not 2"):
        OneHand(Simulation(Assembly1(), num_sims=2), wander)

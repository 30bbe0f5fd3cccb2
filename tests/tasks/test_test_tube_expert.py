"""The demonstrator of Test Tube Insertion: it succeeds, gently, within reach, and touches nothing but its parts."""

import itertools

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from taccorl.robots import ROBOT
from taccorl.sim.simulation import Simulation
from taccorl.tasks.experts.hands import EXACT, ScriptedExpertConfig
from taccorl.tasks.experts.kinematics import ArmKinematics
from taccorl.tasks.experts.se3 import transform, turn
from taccorl.tasks.test_tube import expert as test_tube
from taccorl.tasks.test_tube.expert import TestTubeExpert
from taccorl.tasks.test_tube.scene import TestTube

JOINT_LOW, JOINT_HIGH = np.array([link.range_rad for link in ROBOT.links]).T
MARGIN_RAD = 0.1
FASTEST_RADPS = 3.0  # of a joint's target; the arm's slowest joint is rated for 3.14 rad/s


@pytest.fixture(scope="module")
def sim() -> Simulation:
    return Simulation(TestTube())


def margin_rad(joints: np.ndarray) -> float:
    """To the nearest joint limit, of joints (..., 6)."""
    return float(np.minimum(joints - JOINT_LOW, JOINT_HIGH - joints).min())


class Episode:
    """One run to its end, and what was seen meanwhile."""

    def __init__(self, sim: Simulation, seed: int, config: ScriptedExpertConfig | None = None) -> None:
        self.seed = seed
        sim.reset([seed])
        self.expert = TestTubeExpert(sim, np.random.default_rng([seed, 7]), config)
        self.expert.start()
        self.data = mujoco.MjData(sim.model)
        self.penetration_m, self.subtasks, self.actions, joints = 0.0, [], [], []
        self.met: set[frozenset[str]] = set()
        while not sim.judge.outcome.over[0]:
            self.actions.append(self.expert.act())
            sim.step(self.actions[-1][None])
            self.penetration_m = max(self.penetration_m, sim.contact("tube", "rack").penetration_m[0])
            joints.append(np.delete(sim.proprioception()[0], [6, 13]).reshape(2, 6))
            self.subtasks.append(tuple(sim.judge.subtask[0].tolist()))
            if len(joints) % 5 == 0:
                self.met |= self._contacts(sim)
        self.outcome, self.duration_s = sim.judge.outcome, len(joints) / 30
        self.margin_rad = margin_rad(np.array(joints))
        self.speed_radps = np.abs(np.diff(np.delete(self.actions, [6, 13], axis=1), axis=0)).max() * 30

    def _contacts(self, sim: Simulation) -> set[frozenset[str]]:
        """Pairs of what touches: part, stand, table, or an arm's pads or anything else of it."""
        data, model = self.data, sim.model
        data.qpos[:] = sim.arrays["qpos"][0]
        data.mocap_pos[:], data.mocap_quat[:] = sim.arrays["mocap_pos"][0], sim.arrays["mocap_quat"][0]
        mujoco.mj_fwdPosition(model, data)
        bodies = [[model.body(model.geom_bodyid[g]).name for g in contact.geom] for contact in data.contact]
        return {frozenset(self._kind(body) for body in pair) for pair in bodies}

    @staticmethod
    def _kind(body: str) -> str:
        arm, _, rest = body.partition("_")
        return f"{arm} {'pads' if rest.startswith('pad') else 'arm'}" if rest else body


@pytest.fixture(scope="module", params=[1, pytest.param(0, marks=pytest.mark.slow)])
def episode(sim, request) -> Episode:
    return Episode(sim, request.param)


@pytest.mark.slow
def test_it_succeeds_within_twenty_seconds(episode):
    assert episode.outcome.success[0], episode.outcome.failure
    assert episode.duration_s < 20


def test_subtasks_of_each_arm_end_in_order(episode):
    left, right = (list(dict.fromkeys(arm)) for arm in zip(*episode.subtasks, strict=True))
    assert left == [0, 1, 2]
    assert right == [0, 1, 2, 3]
    assert episode.subtasks == sorted(episode.subtasks)


def test_tube_and_rack_hardly_press_into_each_other(episode):
    assert episode.penetration_m < 0.2e-3


def test_hands_touch_their_parts_and_nothing_else(episode):
    """No hand meets the table, the stand, the rack's body (right), the other hand or a camera."""
    hands = {pair for pair in episode.met if any(" " in kind for kind in pair)}
    assert hands == {frozenset(("right pads", "tube")), frozenset(("left pads", "rack"))}


def test_joints_stay_off_their_limits_and_do_not_jump(episode):
    """The wrist goes through its singularity, joint 5 = 0, while the tube turns."""
    assert episode.margin_rad > MARGIN_RAD
    assert episode.speed_radps < FASTEST_RADPS
    assert episode.expert.unreachable_m < 1e-4


def test_the_same_seed_gives_the_same_actions(sim, episode):
    sim.reset([episode.seed])
    expert = TestTubeExpert(sim, np.random.default_rng([episode.seed, 7]))
    expert.start()
    for action in episode.actions[:60]:
        assert np.array_equal(expert.act(), action)
        sim.step(action[None])


@pytest.mark.slow
def test_exact_hands_need_no_correction(sim):
    episode = Episode(sim, 2, EXACT)
    assert episode.outcome.success[0]
    assert episode.expert.events == []


@pytest.mark.parametrize(("along_mm", "kept_mm"), [(40, 60.0), (62, 62.0), (80, 64.5)])
def test_a_grasp_is_moved_along_the_tube_to_where_fingers_fit(sim, along_mm, kept_mm):
    """Between the stand's block, whose edge is 79 mm from the tube's bottom, and what the rack covers in the end."""
    sim.reset([3])
    expert = TestTubeExpert(sim, np.random.default_rng(0), EXACT)
    tube = expert.body("tube")
    lean = np.deg2rad(33)
    approach = np.array([-np.cos(lean), 0, -np.sin(lean)])  # in the tube's frame: down, and towards its bottom
    x_axis = np.array([np.sin(lean), 0, -np.cos(lean)])
    grip = transform((0, 0, along_mm * 1e-3), np.stack([x_axis, np.cross(approach, x_axis), approach], axis=1))
    grip[:3, 3] += 0.003 * approach  # the pose may lie anywhere along the approach
    kept = np.linalg.inv(tube) @ expert._kept_clear(tube @ grip)
    crossing = kept[:3, 3] - 0.003 * approach
    assert crossing == pytest.approx((0, 0, kept_mm * 1e-3), abs=1e-9)
    assert kept[:3, :3] == pytest.approx(grip[:3, :3], abs=1e-12)


def test_every_corner_of_the_reset_range_is_within_reach(sim):
    """Right hand before and on the lying tube, and with it lifted, at ±20 mm and ±20°: 0.1 rad and more off every limit."""
    arm, home = ArmKinematics("right", sim.config.robot), np.array(TestTube.home_rad["right"])
    assert margin_rad(home) > MARGIN_RAD
    tcp = sim.task.tube.grasps["middle"].part_from_tcp @ turn((0, test_tube._LEAN_RIGHT_RAD, 0))
    for dx, dy, yaw_deg in itertools.product((-0.02, 0.02), (-0.02, 0.02), (-20, 20)):
        drawn = {"tube_position": np.array((dx, dy)), "tube_yaw": np.array([np.deg2rad(yaw_deg)])}
        scene = sim.task.reset(drawn | {"holder_position": np.zeros(2), "friction": np.array([0.5])})
        lying = scene.poses["tube"]
        tube = transform(lying[:3], Rotation.from_quat(lying[3:], scalar_first=True).as_matrix())
        grip = tube @ tcp @ transform((0, 0, -test_tube._TOWARDS_TIPS_M))
        up = grip.copy()
        up[2, 3] += 0.06
        for pose in (grip @ transform((0, 0, -0.06)), grip, up):
            joints, error_m = arm.solve(pose, home)
            assert error_m < 1e-4
            assert margin_rad(joints) > MARGIN_RAD

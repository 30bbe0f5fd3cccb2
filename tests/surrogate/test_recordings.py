"""What the surrogate robot is asked to do, and what its recordings look like to those who read them."""

import mujoco
import numpy as np
import pytest

from taccorl.alignment.checks.telemetry import check_measurements
from taccorl.alignment.measurements import motions
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.robots import ROBOT
from taccorl.sim.twin import TwinConfig, empty_bench
from taccorl.surrogate.cases import draw_case
from taccorl.surrogate.recordings import recordings
from taccorl.surrogate.robot import Robot, inertia_and_weight

MOTIONS = (*motions.DESIGNS["pack"], *motions.VALIDATION, *motions.TEST)
JOINTS = range(1, 7)


def room_of(joint: int) -> motions.Room:
    pose = motions.POSES[joint - 1]
    return motions.Room.of(
        joint, pose[joint - 1], *inertia_and_weight(np.array(pose), joint)
    )


@pytest.fixture(scope="module")
def case():
    return draw_case(["coulomb_friction"], 3, signal="right_joint5")


@pytest.fixture(scope="module")
def measurements(case):
    return recordings(case)


@pytest.mark.parametrize("joint", JOINTS)
@pytest.mark.parametrize("motion", MOTIONS, ids=lambda m: m.name)
def test_motions_keep_limits_and_speed_and_begin_and_end_at_rest(motion, joint):
    for off in (-0.1, 0.1):  # middles are drawn
        pose = motions.POSES[joint - 1]
        room = motions.Room.of(
            joint, pose[joint - 1] + off, *inertia_and_weight(np.array(pose), joint)
        )
        target = motion.target(room)
        low, high = ROBOT.links[joint - 1].range_rad
        assert low < target.min() and target.max() < high
        # amplitudes change within the chirp, too
        assert (
            np.abs(np.diff(target)).max() * motions.RATE_HZ
            < 1.3 * motions.SPEED_RAD_PER_S
        )
        rest = round(motions.REST_S * motions.RATE_HZ)
        assert np.ptp(target[:rest]) == 0 and np.ptp(target[-rest:]) < 1e-3
        assert np.ptp(target) > 0.03


@pytest.mark.parametrize("joint", JOINTS)
def test_torques_stay_within_what_is_allowed(joint):
    room, pose = room_of(joint), motions.POSES[joint - 1]
    inertia, _ = inertia_and_weight(np.array(pose), joint)
    robot = Robot(
        f"left_joint{joint}", (inertia * 18.0**2, 2 * inertia * 18.0, 0.0), [], pose
    )
    for motion in motions.DESIGNS["pack"][:4]:
        run = robot.run(motion, room)
        assert (
            np.abs(run.effort[:, joint - 1] + robot.carried_nm(run)).max()
            < motions.TORQUE_NM[joint - 1]
        )
        assert np.abs(run.velocity[:, joint - 1]).max() < 4.0


@pytest.mark.parametrize("joint", JOINTS)
def test_over_the_wide_range_the_arm_touches_nothing(joint):
    model = empty_bench(TwinConfig()).compile()
    data = mujoco.MjData(model)
    for arm in ("left", "right"):
        for k, angle in enumerate((0.0, 1.732, -0.883, 0.0, 0.2, 0.0)):
            data.qpos[model.joint(f"{arm}_joint{k + 1}").qposadr] = angle
        for finger in "ab":
            data.qpos[model.joint(f"{arm}_finger_{finger}").qposadr] = (
                motions.OPENING_M / 2
            )
    room = room_of(joint)
    for k, angle in enumerate(motions.POSES[joint - 1]):
        data.qpos[model.joint(f"left_joint{k + 1}").qposadr] = angle
    for angle in np.linspace(
        room.middle_rad - room.wide_rad - 0.1, room.middle_rad + room.wide_rad + 0.1, 40
    ):
        data.qpos[model.joint(f"left_joint{joint}").qposadr] = angle
        mujoco.mj_forward(model, data)
        assert data.ncon == 0


def test_recordings_are_divided_and_hold_what_readers_want(measurements):
    names = [m.name for m in measurements.fit]
    assert names == [
        "chirp",
        "chirp_again",
        "wide_triangle",
        "steps",
        "small_chirp",
        "chirp_2x_gain",
        "chirp_payload",
    ]
    assert [m.name for m in measurements.validation] == [
        "held_chirp",
        "held_triangle",
        "held_steps",
        "held_steps_again",
    ]
    assert len(measurements.test) == 2
    by_name: dict[str, Measurement] = {m.name: m for m in measurements.all}
    assert by_name["chirp_again"].repeat_of == "chirp"
    assert by_name["chirp_payload"].payload_kg == {"right": motions.KNOWN_KG}
    for m in measurements.all:
        assert m.rate_hz == 200
        assert m.origin.domain == "surrogate" and "not a robot" in m.origin.text
        assert (
            np.isfinite(m.measured).all() and m.has_effort()[m.column("right_joint5")]
        )


@pytest.mark.slow
def test_checks_of_telemetry_find_no_fault(measurements):
    for name, findings in check_measurements(measurements.all).items():
        # A soft drive sags under a load: that is so, and a check may say so.
        # Dry friction lets the joint stand elsewhere after the same steps: that is so, too.
        allowed = {
            "chirp_payload": {"start_offset"},
            "held_steps_again": {"does_not_repeat"},
        }.get(name, set())
        assert {
            f.check for f in findings if f.severity in ("error", "warning")
        } <= allowed, name


def test_readings_come_in_the_drivers_steps(measurements):
    m = measurements.fit[0]
    step = np.radians(0.001)
    joints = [k for k in range(14) if k % 7 != 6]
    np.testing.assert_allclose(
        m.measured[:, joints] / step, np.round(m.measured[:, joints] / step), atol=1e-6
    )
    np.testing.assert_allclose(m.effort * 1000, np.round(m.effort * 1000), atol=1e-6)


def test_the_other_arm_rests_and_the_other_joints_wobble_a_little(measurements):
    m = measurements.fit[0]
    left = slice(0, 6)
    np.testing.assert_allclose(
        (m.measured[:, left] - m.target[:, left]).mean(axis=0),
        np.array(ROBOT.torque_ff_nm) / ROBOT.kp_nm_per_rad,
        atol=3e-5,
    )
    case = draw_case([], 3, signal="right_joint5", design="chirp")
    run = case.robot.run(motions.DESIGNS["chirp"][0], case.room)
    wobble = np.ptp(run.angle, axis=0)
    assert 1e-6 < wobble[1] < 5e-3
    assert wobble[4] > 0.3

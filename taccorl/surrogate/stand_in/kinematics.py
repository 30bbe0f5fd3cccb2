"""Kinematics of the two PiPER arms as they stand on the stand-in's table: forward for pictures, inverse for key poses.

World frame: x forward from the arms, y to the left, z up, origin on the table between the two mounts.
"""

import numpy as np

from taccorl.robots import ROBOT

ARMS = ROBOT.arms
JOINT_NAMES = (*ROBOT.joints, "gripper")  # as piper_ros names them
JOINT_LIMITS_RAD = np.array([link.range_rad for link in ROBOT.links])  # lower, upper
MOUNT_POS_WORLD = {"left": (0.0, 0.30, 0.26), "right": (0.0, -0.30, 0.26)}
"""Arm → position of its base in the world frame [m]."""

# Parent-to-link origins (xyz in m, fixed-axis rpy in rad), each joint turning about its own z: piper_description.urdf
_LINK_ORIGINS = (
    ((0.0, 0.0, 0.123), (0.0, 0.0, 0.0)),
    ((0.0, 0.0, 0.0), (1.5708, -0.1359, -3.1416)),
    ((0.28503, 0.0, 0.0), (0.0, 0.0, -1.7939)),
    ((-0.021984, -0.25075, 0.0), (1.5708, 0.0, 0.0)),
    ((0.0, 0.0, 0.0), (-1.5708, 0.0, 0.0)),
    ((0.0, -0.091, 0.0), (1.5708, 0.0, 0.0)),
)
_LIMIT_MARGIN_RAD = 0.02  # key poses keep this far from the limits, so that a trembling hand stays inside


def _transform(xyz: tuple[float, ...], rpy: tuple[float, ...]) -> np.ndarray:
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    pose = np.eye(4)
    pose[:3, :3] = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    pose[:3, 3] = xyz
    return pose


_PARENT_FROM_LINK = np.stack([_transform(xyz, rpy) for xyz, rpy in _LINK_ORIGINS])


def link_poses(arm: str, joints_rad: np.ndarray) -> np.ndarray:
    """World-from-link poses of links 1 to 6, (N, 6, 4, 4) [m], for joint angles ``joints_rad`` (N, 6)."""
    n = len(joints_rad)
    world_from_link = np.empty((n, ROBOT.num_joints, 4, 4))
    pose = np.tile(np.eye(4), (n, 1, 1))
    pose[:, :3, 3] = MOUNT_POS_WORLD[arm]
    for i in range(ROBOT.num_joints):
        turn = np.zeros((n, 4, 4))
        c, s = np.cos(joints_rad[:, i]), np.sin(joints_rad[:, i])
        turn[:, 0, 0], turn[:, 0, 1], turn[:, 1, 0], turn[:, 1, 1] = c, -s, s, c
        turn[:, 2, 2] = turn[:, 3, 3] = 1.0
        pose = pose @ _PARENT_FROM_LINK[i] @ turn
        world_from_link[:, i] = pose
    return world_from_link


def tcp_pos_world(world_from_link6: np.ndarray) -> np.ndarray:
    """(..., 3) point in the middle between the pads in the world frame [m], from link-6 poses ``world_from_link6`` (..., 4,
    4)."""
    return world_from_link6[..., :3, 3] + ROBOT.tcp_from_hand_m * world_from_link6[..., :3, 2]


def solve_joints(arm: str, tcp_world: np.ndarray) -> np.ndarray:
    """Joint angles (K, 6) [rad] that bring the middle between the pads to ``tcp_world`` (K, 3) [m] with the gripper pointing
    down, by damped Gauss–Newton within limits.

    The left gripper closes along x (across the rack), the right one along y (across the tube).
    """
    closing_axis = (1.0, 0.0, 0.0) if arm == "left" else (0.0, 1.0, 0.0)
    place, tilt = 20.0, 0.5  # weights per metre and per unit vector: rather tilt than miss the place
    wanted = np.concatenate(
        [place * tcp_world, np.tile(tilt * np.array([0.0, 0.0, -1.0, *closing_axis]), (len(tcp_world), 1))], axis=1
    )

    def task(joints: np.ndarray) -> np.ndarray:
        pose = link_poses(arm, joints)[:, -1]
        return np.concatenate([place * tcp_pos_world(pose), tilt * pose[:, :3, 2], tilt * pose[:, :3, 1]], axis=1)

    low, high = JOINT_LIMITS_RAD[:, 0] + _LIMIT_MARGIN_RAD, JOINT_LIMITS_RAD[:, 1] - _LIMIT_MARGIN_RAD
    start = (-0.3, 2.1, -1.5, 0.0, 0.9, 1.3) if arm == "left" else (0.3, 2.1, -1.5, 0.0, 0.9, 0.3)
    joints = np.tile(np.array(start), (len(tcp_world), 1))
    for _ in range(50):
        value = task(joints)
        jacobian = np.stack([(task(joints + step) - value) / 1e-6 for step in 1e-6 * np.eye(ROBOT.num_joints)], axis=2)
        gradient = np.einsum("kij,ki->kj", jacobian, wanted - value)
        hessian = np.einsum("kij,kil->kjl", jacobian, jacobian) + 1e-4 * np.eye(ROBOT.num_joints)
        joints = np.clip(joints + np.linalg.solve(hessian, gradient[..., None])[..., 0], low, high)
    return joints

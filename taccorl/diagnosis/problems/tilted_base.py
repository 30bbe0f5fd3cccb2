"""Tilt of a robot's base that would load a joint as an effect ``unbalance`` does."""

from collections.abc import Sequence

import numpy as np

from taccorl.alignment.controller.rigid_joint import rigid_terms
from taccorl.alignment.machines.robot_file import Robot
from taccorl.alignment.machines.robot_joint import under_gravity
from taccorl.alignment.measurements.measurement import Measurement

MOST_LEFT = 0.1
"""Largest share of an unbalance that a tilt may leave unexplained (a choice)."""
MOST_RAD = 0.2
"""Largest tilt that is called one [rad], 11° (a choice)."""


def tilt_like(
    robot: Robot,
    joint: str,
    recordings: Sequence[Measurement],
    torque_nm: float,
    hangs_at_rad: float,
) -> np.ndarray | None:
    """(3,) unit vector along gravity, in the model's frame, that loads a joint with A sin(q − q₀) more than the robot file has
    it, while the other joints stand as at the beginning of the recordings, of several on average; None if no tilt up to
    ``MOST_RAD`` does.

    The weight is linear in gravity, which a base turned by the small vector ω has as g − ω × g. Two numbers, S = A cos q₀ and
    C = −A sin q₀, give the two components of ω across g. Only one of them loads a joint with a horizontal axis: there S and C
    must be in its proportion.

    Args:
        torque_nm, hangs_at_rad: A and q₀ of ``unbalance``.
    """
    now = robot.rigid.model.opt.gravity + robot.more_gravity
    wanted = torque_nm * np.array([np.cos(hangs_at_rad), -np.sin(hangs_at_rad)])
    weights = weights_by_turn(
        robot, joint, [robot.joint(joint).pose(m) for m in recordings]
    )
    turn = np.linalg.lstsq(weights, wanted, rcond=1e-6)[0]
    left = float(np.linalg.norm(weights @ turn - wanted))
    if np.linalg.norm(turn) > MOST_RAD or left > MOST_LEFT * float(
        np.linalg.norm(wanted)
    ):
        return None
    down = now - np.cross(turn, now)
    return down / np.linalg.norm(down)


def weights_by_turn(
    robot: Robot, joint: str, poses: Sequence[np.ndarray]
) -> np.ndarray:
    """(2, 3) change of S and C in the torque S sin q + C cos q that holds the weight of a hinge [N·m], for a small turn of the
    base about each axis of the model's frame [rad]; the mean of several poses (nq,). 0 for a slide."""
    now = robot.rigid.model.opt.gravity + robot.more_gravity
    weights = np.empty((2, 3))
    for k, axis in enumerate(np.eye(3)):
        model = under_gravity(robot.rigid.model, -np.cross(axis, now))
        terms = [rigid_terms(model, joint, pose) for pose in poses]
        weights[:, k] = np.mean([(t.gravity_sin, t.gravity_cos) for t in terms], axis=0)
    return weights


def change_between_poses(
    robot: Robot, joint: str, recordings: Sequence[Measurement], down: np.ndarray
) -> float:
    """By how much the torque differs between the poses of the recordings by which a hinge is loaded more if gravity has the
    direction ``down`` (3,): largest distance of its S and C from their mean, as a share of the mean."""
    now = robot.rigid.model.opt.gravity + robot.more_gravity
    model = under_gravity(robot.rigid.model, np.linalg.norm(now) * down - now)
    terms = [rigid_terms(model, joint, robot.joint(joint).pose(m)) for m in recordings]
    loads = np.array([(t.gravity_sin, t.gravity_cos) for t in terms])
    mean = loads.mean(axis=0)
    return float(
        np.linalg.norm(loads - mean, axis=1).max() / max(np.linalg.norm(mean), 1e-12)
    )

"""Rigid-body dynamics of the arm, computed independently of MuJoCo: torques by Newton–Euler recursion, inertia by composite
bodies.

    M(q) q̈ + c(q, q̇) + g(q) = τ

Figures from ``taccorl.sim.robot`` (masses, frames); equations from Featherstone, Rigid Body Dynamics Algorithms, 2008, §5.3 and
§6.2, in 3-vectors: every link's quantities in its own frame, its joint along z.
"""

import math
from typing import NamedTuple

import numba
import numpy as np
from scipy.spatial.transform import Rotation

from taccorl.robots import ROBOT
from taccorl.robots.bimanual_piper import FINGER_MASS_KG, INERTIAS
from taccorl.sim.robot import RobotConfig

GRAVITY = 9.81  # [m/s²]
NUM_JOINTS = ROBOT.num_joints  # Joints of one arm, without the gripper
_BALL_RADIUS_M = 0.02  # of a payload


class Bodies(NamedTuple):
    """Links 1 to 6 as arrays; hand, fingers, pads and payload are part of link 6."""

    turn: np.ndarray  # (6, 3, 3) rotation parent-from-link at joint angle 0
    origin: np.ndarray  # (6, 3) origin of each link in its parent's frame [m]
    mass: np.ndarray  # (6,) masses [kg]
    moment: (
        np.ndarray
    )  # (6, 3) first moment: mass times centre of mass, in the link's frame [kg·m]
    inertia: np.ndarray  # (6, 3, 3) inertia about the link's origin [kg·m²]


def bodies(
    config: RobotConfig,
    opening_m: float,
    balls: tuple[tuple[float, float, float, float], ...] = (),
) -> Bodies:
    """Rigid bodies of the arm of ``config`` with its gripper open by ``opening_m``. ``balls``: point masses fixed to link 6:
    mass [kg], x, y, z [m]."""
    inertias = INERTIAS[config.inertias]
    mass = np.array([body.mass_kg for body in inertias])
    moment = np.array([np.multiply(body.mass_kg, body.com_link_m) for body in inertias])
    inertia = np.empty((NUM_JOINTS, 3, 3))
    for k, body in enumerate(inertias):
        xx, yy, zz, xy, xz, yz = body.about_com_kgm2()
        about_com = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        inertia[k] = about_com + _of_point(body.mass_kg, np.array(body.com_link_m))
    round_ones = [
        (m, np.array(at), [0.4 * m * _BALL_RADIUS_M**2] * 3) for m, *at in balls
    ]
    for at_kg, at_m, own in (*_hand(config, opening_m), *round_ones):
        mass[-1] += at_kg
        moment[-1] += at_kg * at_m
        inertia[-1] += np.diag(own) + _of_point(at_kg, at_m)
    turn = np.array(
        [
            Rotation.from_euler("xyz", link.rpy_parent_rad).as_matrix()
            for link in ROBOT.links
        ]
    )
    return Bodies(
        turn,
        np.array([link.pos_parent_m for link in ROBOT.links], dtype=float),
        mass,
        moment,
        inertia,
    )


def _hand(
    config: RobotConfig, opening_m: float
) -> list[tuple[float, np.ndarray, list[float]]]:
    """Fingers and pads: mass, place in link 6, own inertia; as ``taccorl.sim.robot`` states them."""
    parts = []
    for side in (1.0, -1.0):
        finger = np.array(
            [0.0, side * (0.01 + opening_m / 2), ROBOT.finger_from_hand_m + 0.02]
        )
        parts.append((FINGER_MASS_KG[config.inertias], finger, [2e-5, 2e-5, 5e-6]))
        if config.pads == "sprung":
            pad = np.array(
                [
                    0.0,
                    side * (ROBOT.pad_thickness_m + opening_m) / 2,
                    ROBOT.tcp_from_hand_m,
                ]
            )
            parts.append((0.004, pad, [1.4e-6, 1.4e-6, 2e-7]))
    return parts


def _of_point(mass: float, at: np.ndarray) -> np.ndarray:
    return mass * ((at @ at) * np.eye(3) - np.outer(at, at))


@numba.njit(cache=True, inline="always")
def _link_turn(turn, angle, out):
    c, s = math.cos(angle), math.sin(angle)
    for i in range(3):
        out[i, 0] = turn[i, 0] * c + turn[i, 1] * s
        out[i, 1] = turn[i, 1] * c - turn[i, 0] * s
        out[i, 2] = turn[i, 2]


@numba.njit(cache=True)
def torques(b: Bodies, q, v, a, gravity):
    """(6,) joint torques [N·m] for acceleration ``a`` (6,) [rad/s²] at angles ``q`` (6,) [rad] and velocities ``v`` (6,) [rad/s]
    under ``gravity`` [m/s²]: recursive Newton–Euler."""
    rot = np.empty((NUM_JOINTS, 3, 3))
    force, couple = np.empty((NUM_JOINTS, 3)), np.empty((NUM_JOINTS, 3))
    w = np.zeros(3)
    dw = np.zeros(3)
    acc = np.array([0.0, 0.0, gravity])
    lift, here = np.empty(3), np.empty(3)
    for i in range(NUM_JOINTS):
        r = rot[i]
        _link_turn(b.turn[i], q[i], r)
        x, y, z = b.origin[i, 0], b.origin[i, 1], b.origin[i, 2]
        # Acceleration of the link's origin: a + ω̇ × p + ω × (ω × p)
        wp = w[0] * x + w[1] * y + w[2] * z
        ww = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
        lift[0] = acc[0] + dw[1] * z - dw[2] * y + w[0] * wp - x * ww
        lift[1] = acc[1] + dw[2] * x - dw[0] * z + w[1] * wp - y * ww
        lift[2] = acc[2] + dw[0] * y - dw[1] * x + w[2] * wp - z * ww
        w0 = r[0, 0] * w[0] + r[1, 0] * w[1] + r[2, 0] * w[2]
        w1 = r[0, 1] * w[0] + r[1, 1] * w[1] + r[2, 1] * w[2]
        w2 = r[0, 2] * w[0] + r[1, 2] * w[1] + r[2, 2] * w[2]
        d0 = r[0, 0] * dw[0] + r[1, 0] * dw[1] + r[2, 0] * dw[2]
        d1 = r[0, 1] * dw[0] + r[1, 1] * dw[1] + r[2, 1] * dw[2]
        d2 = r[0, 2] * dw[0] + r[1, 2] * dw[1] + r[2, 2] * dw[2]
        dw[0], dw[1], dw[2] = d0 + w1 * v[i], d1 - w0 * v[i], d2 + a[i]
        w[0], w[1], w[2] = w0, w1, w2 + v[i]
        for k in range(3):
            acc[k] = r[0, k] * lift[0] + r[1, k] * lift[1] + r[2, k] * lift[2]
        # f = m a + ω̇ × h + ω × (ω × h),  n = I ω̇ + ω × I ω + h × a,  h = m c
        x, y, z = b.moment[i, 0], b.moment[i, 1], b.moment[i, 2]
        wh = w[0] * x + w[1] * y + w[2] * z
        ww = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
        m = b.mass[i]
        force[i, 0] = m * acc[0] + dw[1] * z - dw[2] * y + w[0] * wh - x * ww
        force[i, 1] = m * acc[1] + dw[2] * x - dw[0] * z + w[1] * wh - y * ww
        force[i, 2] = m * acc[2] + dw[0] * y - dw[1] * x + w[2] * wh - z * ww
        inertia = b.inertia[i]
        for k in range(3):
            here[k] = inertia[k, 0] * w[0] + inertia[k, 1] * w[1] + inertia[k, 2] * w[2]
            couple[i, k] = (
                inertia[k, 0] * dw[0] + inertia[k, 1] * dw[1] + inertia[k, 2] * dw[2]
            )
        couple[i, 0] += w[1] * here[2] - w[2] * here[1] + y * acc[2] - z * acc[1]
        couple[i, 1] += w[2] * here[0] - w[0] * here[2] + z * acc[0] - x * acc[2]
        couple[i, 2] += w[0] * here[1] - w[1] * here[0] + x * acc[1] - y * acc[0]
    out = np.empty(NUM_JOINTS)
    for i in range(5, -1, -1):
        out[i] = couple[i, 2]
        if i > 0:
            _to_parent(
                rot[i], b.origin[i], force[i], couple[i], force[i - 1], couple[i - 1]
            )
    return out


@numba.njit(cache=True, inline="always")
def _to_parent(r, p, force, couple, force_parent, couple_parent):
    """Adds a link's force and couple, turned and moved, to its parent's."""
    f0 = r[0, 0] * force[0] + r[0, 1] * force[1] + r[0, 2] * force[2]
    f1 = r[1, 0] * force[0] + r[1, 1] * force[1] + r[1, 2] * force[2]
    f2 = r[2, 0] * force[0] + r[2, 1] * force[1] + r[2, 2] * force[2]
    n0 = r[0, 0] * couple[0] + r[0, 1] * couple[1] + r[0, 2] * couple[2]
    n1 = r[1, 0] * couple[0] + r[1, 1] * couple[1] + r[1, 2] * couple[2]
    n2 = r[2, 0] * couple[0] + r[2, 1] * couple[1] + r[2, 2] * couple[2]
    force_parent[0] += f0
    force_parent[1] += f1
    force_parent[2] += f2
    couple_parent[0] += n0 + p[1] * f2 - p[2] * f1
    couple_parent[1] += n1 + p[2] * f0 - p[0] * f2
    couple_parent[2] += n2 + p[0] * f1 - p[1] * f0


@numba.njit(cache=True)
def mass_matrix(b: Bodies, q):
    """(6, 6) mass matrix [kg·m²] at angles ``q`` (6,) [rad] by composite rigid bodies, without rotors."""
    rot = np.empty((NUM_JOINTS, 3, 3))
    mass, moment, inertia = b.mass.copy(), b.moment.copy(), b.inertia.copy()
    half, turned = np.empty((3, 3)), np.empty(3)
    for i in range(NUM_JOINTS):
        _link_turn(b.turn[i], q[i], rot[i])
    for i in range(5, 0, -1):
        r, p, m = rot[i], b.origin[i], mass[i]
        for k in range(3):
            turned[k] = (
                r[k, 0] * moment[i, 0] + r[k, 1] * moment[i, 1] + r[k, 2] * moment[i, 2]
            )
            for n in range(3):
                half[k, n] = (
                    r[k, 0] * inertia[i, 0, n]
                    + r[k, 1] * inertia[i, 1, n]
                    + r[k, 2] * inertia[i, 2, n]
                )
        # About the parent's origin: R I Rᵀ + (2 p·h + m p·p) 1 − (p hᵀ + h pᵀ + m p pᵀ), with h = R m c
        pp = p[0] * p[0] + p[1] * p[1] + p[2] * p[2]
        trace = 2.0 * (p[0] * turned[0] + p[1] * turned[1] + p[2] * turned[2]) + m * pp
        for k in range(3):
            for n in range(3):
                inertia[i - 1, k, n] += (
                    half[k, 0] * r[n, 0] + half[k, 1] * r[n, 1] + half[k, 2] * r[n, 2]
                    - p[k] * turned[n] - turned[k] * p[n] - m * p[k] * p[n]
                )  # fmt: skip
            inertia[i - 1, k, k] += trace
            moment[i - 1, k] += turned[k] + m * p[k]
        mass[i - 1] += m
    out = np.empty((NUM_JOINTS, NUM_JOINTS))
    force, couple = np.zeros((NUM_JOINTS, 3)), np.zeros((NUM_JOINTS, 3))
    for j in range(NUM_JOINTS):
        for i in range(j + 1):
            for k in range(3):
                force[i, k] = couple[i, k] = 0.0
        # The composite body j turned about its own z with 1 rad/s²
        force[j, 0], force[j, 1] = -moment[j, 1], moment[j, 0]
        for k in range(3):
            couple[j, k] = inertia[j, k, 2]
        for i in range(j, -1, -1):
            out[i, j] = out[j, i] = couple[i, 2]
            if i > 0:
                _to_parent(
                    rot[i],
                    b.origin[i],
                    force[i],
                    couple[i],
                    force[i - 1],
                    couple[i - 1],
                )
    return out


@numba.njit(cache=True)
def factor(a):
    """Cholesky factorisation of ``a`` (6, 6), in place in the lower half; returns nothing."""
    for j in range(NUM_JOINTS):
        for k in range(j):
            a[j, j] -= a[j, k] * a[j, k]
        a[j, j] = math.sqrt(a[j, j])
        for i in range(j + 1, NUM_JOINTS):
            for k in range(j):
                a[i, j] -= a[i, k] * a[j, k]
            a[i, j] /= a[j, j]


@numba.njit(cache=True, inline="always")
def solve(a, x):
    """Replace ``x`` (6,) by A⁻¹ x, in place; ``a`` (6, 6) is A after ``factor``."""
    for i in range(NUM_JOINTS):
        for k in range(i):
            x[i] -= a[i, k] * x[k]
        x[i] /= a[i, i]
    for i in range(5, -1, -1):
        for k in range(i + 1, NUM_JOINTS):
            x[i] -= a[k, i] * x[k]
        x[i] /= a[i, i]

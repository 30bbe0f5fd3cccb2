"""Uncertainty of a fitted camera pose, from noise of the edges and from errors of the twin's shapes and joint zeros.

Noise: residuals of one body's outline in one frame are correlated, so that these groups are treated as the independent samples
(a sandwich estimate). In addition each body's shape may differ from the twin's by ``SHAPE_M``, and each joint may have a zero
error of ``JOINT_RAD``; both are the same in all frames, so that more pictures do not reduce them. They are propagated through
the least squares: frames with equal poses average nothing.

Letters in shapes: M matched points, J joints of both arms.
"""

import math
from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from taccorl.alignment.camera.fit import (
    Level,
    PoseFit,
    distances,
    moved,
    seen_from,
    slopes,
    space_slopes,
    weights,
)
from taccorl.alignment.camera.view import TwinView
from taccorl.alignment.least_squares import sandwich
from taccorl.robots import ROBOT

AXES = (
    "turn about right",
    "turn about up",
    "turn about back",
    "shift right",
    "shift up",
    "shift back",
)
"""Names of the six numbers of a pose: rotation vector [rad] about, and translation [m] along, the nominal camera's x, y, z."""
SHAPE_M = 0.001
"""Standard deviation, along each axis, of the displacement of a body's outline from the twin's [m]. A choice: covers and fingers
differ by so much."""
JOINT_RAD = 0.002  # Standard deviation of the error of a joint's zero [rad]. A choice: 1 mm at half a metre.
WANTED = np.r_[np.full(3, np.deg2rad(0.3)), np.full(3, 0.004)]
"""Requested accuracy of each number: 0.3°, 4 mm. It is used only to compare angles with lengths."""


@dataclass(frozen=True)
class Covariance:
    """Covariance of the six numbers of a fitted camera pose, in the order and units of ``AXES`` [rad, m]."""

    noise: np.ndarray
    """(6, 6) part from the scatter of the distances between the twin's projected outlines and the edges in the pictures."""
    twin: np.ndarray  # (6, 6) part from errors of the twin's shapes and joint zeros

    @property
    def total(self) -> np.ndarray:
        """Total covariance (6, 6)."""
        return self.noise + self.twin

    @property
    def half_width(self) -> np.ndarray:
        """Half widths (6,) of the 95 % intervals [rad, m]."""
        return 1.96 * np.sqrt(np.diag(self.total))

    @property
    def correlation(self) -> np.ndarray:
        """Correlation matrix (6, 6)."""
        deviation = np.sqrt(np.diag(self.total))
        return self.total / np.outer(deviation, deviation)

    def worst(self) -> tuple[float, str]:
        """The least certain direction: half width of its 95 % interval as a multiple of ``WANTED``, and text that names its
        components."""
        values, vectors = np.linalg.eigh(self.total / np.outer(WANTED, WANTED))
        along = vectors[:, -1] / vectors[np.argmax(np.abs(vectors[:, -1])), -1]
        # An axis with less than a third of the longest component is not named.
        named = [
            k for k in np.argsort(-np.abs(along)).tolist() if abs(along[k]) >= 0.35
        ]
        width = 1.96 * float(np.sqrt(values[-1]))
        half = [
            f"{math.degrees(x):.2f}°" if k < 3 else f"{1e3 * x:.1f} mm"
            for k, x in enumerate(self.half_width)
        ]
        return width, " together with ".join(f"{AXES[k]} (±{half[k]})" for k in named)


def covariance(
    view: TwinView, joints: np.ndarray, level: Level, solution: PoseFit
) -> Covariance | None:
    """Covariance of ``solution`` from the frames with joints (F, 14); None if the edges do not determine all six numbers."""
    seen = seen_from(view, solution.offset, solution.outlines.points)
    found = solution.matches.found
    apart = distances(seen, solution.matches, level.intrinsics)
    jacobian = slopes(seen, solution.matches, level.intrinsics)
    weighted = weights(apart)[:, None] * jacobian
    information = weighted.T @ jacobian
    if np.linalg.cond(information * np.outer(WANTED, WANTED)) > 1e10:
        return None
    frames, bodies = solution.outlines.frames[found], solution.outlines.bodies[found]
    groups = np.unique(np.stack([frames, bodies], axis=1), axis=0, return_inverse=True)[
        1
    ].ravel()
    scores = np.zeros((groups.max() + 1, 6))
    np.add.at(scores, groups, weighted * apart[:, None])
    by_point = space_slopes(seen, solution.matches, level.intrinsics)
    shifts = _shifts(view, joints, solution.offset, seen[found], frames, bodies)
    twin = np.stack([weighted.T @ (by_point * shift).sum(1) for shift in shifts])
    # From a step in the camera's own frame to the pose's numbers.
    steps = 1e-6 * np.eye(6)
    bent = [moved(solution.offset, step) - solution.offset for step in steps]
    bend, inverse = np.stack(bent, axis=1) / 1e-6, np.linalg.inv(information)
    noise = sandwich(scores, inverse, 6)
    shape = inverse @ twin.T @ twin @ inverse
    return Covariance(noise=bend @ noise @ bend.T, twin=bend @ shape @ bend.T)


def _shifts(
    view: TwinView,
    joints: np.ndarray,
    offset: np.ndarray,
    seen: np.ndarray,
    frames: np.ndarray,
    bodies: np.ndarray,
) -> list[np.ndarray]:
    """How points ``seen`` (M, 3) of ``bodies`` (M,) in ``frames`` (M,) would move in the camera's frame [m], each
    source of error one standard deviation off: three axes of each body, then each joint."""
    model, data = view.model, view.data
    mount = model.body(view.camera.body).id
    position, turn = view.pose(offset)
    owners = np.unique(bodies)
    found = np.zeros(
        (3 * len(owners) + len(ROBOT.arms) * len(ROBOT.joints), len(seen), 3)
    )
    names = [f"{arm}_{joint}" for arm in ROBOT.arms for joint in ROBOT.joints]
    for frame, row in enumerate(joints):
        view.place(row)
        mounted = Rotation.from_matrix(data.xmat[mount].reshape(3, 3))
        world_from_camera = mounted.as_matrix() @ turn
        eye = data.xpos[mount] + mounted.apply(position)
        for k, body in enumerate(owners):
            mine = (frames == frame) & (bodies == body)
            axes = data.xmat[body].reshape(3, 3).T @ world_from_camera
            found[3 * k : 3 * k + 3, mine] = SHAPE_M * axes[:, None]
        here = frames == frame
        world = seen[here] @ world_from_camera.T + eye
        for j, name in enumerate(names):
            joint = model.joint(name).id
            carried = np.array(
                [_carries(model, joint, int(body)) for body in range(model.nbody)],
                float,
            )
            lever = np.cross(data.xaxis[joint], world - data.xanchor[joint])
            relative = (
                carried[bodies[here]] - carried[mount]
            )  # a camera on the arm moves along
            found[3 * len(owners) + j, here] = (
                JOINT_RAD * (lever * relative[:, None]) @ world_from_camera
            )
    return list(found)


def _carries(model: mujoco.MjModel, joint: int, body: int) -> bool:
    """Whether a body is the joint's own or further out."""
    while body > 0 and body != model.jnt_bodyid[joint]:
        body = int(model.body_parentid[body])
    return body > 0

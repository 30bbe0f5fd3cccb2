"""Least squares of camera calibration: draw the outlines, match them with the pictures' edges, move the camera, repeat.

Letters in shapes: F frames, P points.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import qmc

from taccorl.alignment.camera.edges import PictureEdges, twin_edges
from taccorl.alignment.camera.view import TwinView
from taccorl.sim.cameras import Intrinsics

_POINTS = 800  # of a frame, drawn at random from its outlines
_REACH_PX = (
    (16.0, 12.0, 8.0, 6.0),
    (6.0, 5.0, 4.0),
    (4.0, 3.0, 3.0, 3.0),
)  # coarse to fine, render by render
_AROUND = np.r_[
    np.full(3, np.deg2rad(3.0)), np.full(3, 0.03)
]  # of the start, searched before the first step
_TRIED, _KEPT, _FOLLOWED = (
    256,
    8,
    2,
)  # poses around the start; the best, refined in small pictures; in larger ones
_SAME = np.r_[
    np.full(3, np.deg2rad(0.4)), np.full(3, 0.004)
]  # poses closer than this will end in one
_FAR_PX = 6.0  # a point further from its edge counts no more


class Level(NamedTuple):
    """The pictures at one size of the image pyramid."""

    intrinsics: Intrinsics  # Intrinsics scaled to this size
    edges: list[PictureEdges]  # Edges of each picture, F items


class Outlines(NamedTuple):
    """Points on the arms' outlines in all frames, rendered at one camera pose."""

    points: np.ndarray  # (P, 3) positions in the mount's frame [m]
    normals: np.ndarray  # (P, 2) unit vectors across the outline in the picture
    frames: np.ndarray  # (P,) index of the frame
    bodies: np.ndarray  # (P,) index of the body


class Matches(NamedTuple):
    """Picture edges that were matched with points of the outlines."""

    found: np.ndarray  # (P,) bool: a picture edge of similar direction is within reach
    edges: np.ndarray  # (P, 2) positions of the matched edges as (u, v) [px]
    across: np.ndarray  # (P, 2) unit normals of the matched edges


@dataclass(frozen=True)
class PoseFit:
    """Result of the least squares: pose and misfit."""

    offset: np.ndarray  # (6,) estimated pose: rotation vector [rad] and translation [m] relative to the nominal mount
    last_change: np.ndarray  # (6,) change of the pose in the last iteration [rad, m]
    outlines: Outlines  # Outlines rendered at the last pose
    matches: Matches  # Their matches in the pictures


def levels(pictures: Sequence[np.ndarray], intrinsics: Intrinsics) -> list[Level]:
    """Image pyramid, coarse to fine: F pictures, each (rows, columns, 3) uint8, at a quarter, half, full and double size; sizes
    with fewer than 100 or more than 480 rows are left out."""
    found = []
    for factor in (4, 2, 1, 0.5):
        rows, columns = (
            round(intrinsics.rows / factor),
            round(intrinsics.columns / factor),
        )
        if 100 <= rows <= 480:
            small = [
                cv2.resize(p, (columns, rows), interpolation=cv2.INTER_AREA)
                for p in pictures
            ]
            found.append(
                Level(
                    intrinsics.scaled(rows, columns), [PictureEdges(p) for p in small]
                )
            )
    return found


def outlines(
    view: TwinView, joints: np.ndarray, offset: np.ndarray, at: Intrinsics
) -> Outlines:
    """Outlines of the twin's arms in F frames, at most 800 points per frame. ``joints``: (F, 14) joint angles and gripper
    openings [rad, m]. ``offset``: (6,) camera pose at which they are rendered [rad, m]. ``at``: intrinsics, which state the size
    of the rendered pictures."""
    rng = np.random.default_rng(0)
    position, turn = view.pose(offset)
    parts = []
    for frame, row in enumerate(joints):
        edges = twin_edges(*view.labels(row, offset, at.rows, at.columns), at)
        keep = np.arange(len(edges.points))
        if len(keep) > _POINTS:
            keep = np.sort(rng.choice(keep, _POINTS, replace=False))
        points = edges.points[keep] @ turn.T + position
        parts.append(
            (points, edges.normals[keep], np.full(len(keep), frame), edges.bodies[keep])
        )
    return Outlines(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def seen_from(view: TwinView, offset: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Transform ``points`` (P, 3) [m] from the mount's frame to the camera's, for a camera at pose ``offset`` (6,); returns
    (P, 3)."""
    position, turn = view.pose(offset)
    return (points - position) @ turn


def pixels_of(seen: np.ndarray, at: Intrinsics) -> np.ndarray:
    """Project points ``seen`` (P, 3) [m] of the camera's frame to pixels (P, 2) as (u, v); NaN for points behind the camera."""
    depth = np.where(seen[:, 2] < 0, -seen[:, 2], np.nan)
    return np.stack(
        [
            at.cx_px + at.fx_px * seen[:, 0] / depth,
            at.cy_px - at.fy_px * seen[:, 1] / depth,
        ],
        axis=1,
    )


def match(drawn: Outlines, seen: np.ndarray, level: Level, reach_px: float) -> Matches:
    """Match the P points of ``drawn``, at positions ``seen`` (P, 3) [m] in the camera's frame, with picture edges within
    ``reach_px``."""
    pixels = pixels_of(seen, level.intrinsics)
    found = np.zeros(len(pixels), bool)
    edges, across = np.zeros((len(pixels), 2)), np.zeros((len(pixels), 2))
    for frame, picture in enumerate(level.edges):
        mine = drawn.frames == frame
        edges[mine], across[mine], found[mine] = picture.match(
            pixels[mine], drawn.normals[mine], reach_px
        )
    return Matches(found, edges, across)


def distances(seen: np.ndarray, matches: Matches, at: Intrinsics) -> np.ndarray:
    """(M,) signed distances from the edges' lines to the M matched points [px]; ``seen`` (P, 3) are all points in the camera's
    frame [m]."""
    apart = pixels_of(seen[matches.found], at) - matches.edges[matches.found]
    return (apart * matches.across[matches.found]).sum(1)


def space_slopes(seen: np.ndarray, matches: Matches, at: Intrinsics) -> np.ndarray:
    """Derivatives (M, 3) of ``distances`` by the points' positions in the camera's frame [px/m]; ``seen`` (P, 3) as there."""
    x, y, z = seen[matches.found].T
    across = matches.across[matches.found] * [at.fx_px, at.fy_px]
    return np.stack(
        [
            -across[:, 0] / z,
            across[:, 1] / z,
            (across[:, 0] * x - across[:, 1] * y) / z**2,
        ],
        axis=1,
    )


def slopes(seen: np.ndarray, matches: Matches, at: Intrinsics) -> np.ndarray:
    """Derivatives (M, 6) of ``distances`` by a small rotation [px/rad] and translation [px/m] of the camera in its own frame;
    ``seen`` (P, 3) as there."""
    by_point = space_slopes(seen, matches, at)
    # The camera turned by ω and shifted by t sees a point at x − ω × x − t.
    return np.concatenate([np.cross(by_point, seen[matches.found]), -by_point], axis=1)


def moved(offset: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Pose ``offset`` (6,) [rad, m] rotated and translated by ``step`` (6,) in its own frame; returns (6,)."""
    turn = Rotation.from_rotvec(offset[:3])
    return np.r_[
        (turn * Rotation.from_rotvec(step[:3])).as_rotvec(),
        offset[3:] + turn.apply(step[3:]),
    ]


def solve(
    view: TwinView, joints: np.ndarray, levels: Sequence[Level], start: np.ndarray
) -> PoseFit:
    """Fit the pose (6,) at which the outlines of the arms at ``joints`` (F, 14) [rad, m] coincide with the edges in ``levels``.
    ``start``: (6,) pose [rad, m]; many poses within 3° and 30 mm of it along each axis are compared first."""
    reaches = (
        _REACH_PX[-len(levels) :] if len(levels) > 1 else [_REACH_PX[0] + _REACH_PX[-1]]
    )
    tried = [
        _descend(view, joints, levels[0], reaches[0], one)
        for one in _starts(view, joints, levels[0], start)
    ]
    tried.sort(
        key=lambda solution: misfit(view, solution.offset, solution.outlines, levels[0])
    )
    for level, reach_px in zip(levels[1:], reaches[1:], strict=True):
        tried = [
            _descend(view, joints, level, reach_px, one.offset)
            for one in _distinct(tried)
        ]
        tried.sort(
            key=lambda solution: misfit(view, solution.offset, solution.outlines, level)
        )
    return tried[0]


def _distinct(tried: list[PoseFit]) -> list[PoseFit]:
    """The best few of solutions, best first, that are not one and the same: many starts end in one place."""
    chosen: list[PoseFit] = []
    for solution in tried:
        if all(
            (np.abs(solution.offset - other.offset) > _SAME).any() for other in chosen
        ):
            chosen.append(solution)
    return chosen[:_FOLLOWED]


def misfit(view: TwinView, offset: np.ndarray, drawn: Outlines, level: Level) -> float:
    """Misfit, 0 … 1, of the outlines ``drawn`` at pose ``offset`` (6,): mean over the points of their distance from the matched
    edge divided by 6 px; points without a matched edge count as 1."""
    seen = seen_from(view, offset, drawn.points)
    matches = match(drawn, seen, level, _FAR_PX)
    apart = np.abs(distances(seen, matches, level.intrinsics))
    return float(
        (np.minimum(apart / _FAR_PX, 1.0).sum() + (~matches.found).sum())
        / max(len(seen), 1)
    )


def _starts(
    view: TwinView, joints: np.ndarray, level: Level, start: np.ndarray
) -> list[np.ndarray]:
    """``start`` and the best of many poses around it."""
    drawn = outlines(view, joints, start, level.intrinsics)
    spread = 2 * qmc.Sobol(6, rng=0).random(_TRIED) - 1
    around = [moved(start, step) for step in spread * _AROUND]
    around.sort(key=lambda offset: misfit(view, offset, drawn, level))
    return [start, *around[:_KEPT]]


def _descend(
    view: TwinView,
    joints: np.ndarray,
    level: Level,
    reaches_px: Sequence[float],
    start: np.ndarray,
) -> PoseFit:
    """Draw, match, move; the reach of matches shrinks from one drawing to the next."""
    offset = before = start
    for reach_px in reaches_px:
        before = offset
        drawn = outlines(view, joints, offset, level.intrinsics)
        for _ in range(3):  # matchings between two renderings
            seen = seen_from(view, offset, drawn.points)
            offset = moved(
                offset,
                _step(seen, match(drawn, seen, level, reach_px), level.intrinsics),
            )
    drawn = outlines(view, joints, offset, level.intrinsics)
    matches = match(drawn, seen_from(view, offset, drawn.points), level, reaches_px[-1])
    return PoseFit(offset, offset - before, drawn, matches)


def weights(apart: np.ndarray) -> np.ndarray:
    """Weights (M,), at most 1, of residuals ``apart`` (M,) [px] under the soft L1 loss; close to 1 for small residuals."""
    return 1 / np.sqrt(1 + apart**2)  # residuals beyond 1 px count less


def _step(seen: np.ndarray, matches: Matches, at: Intrinsics) -> np.ndarray:
    """(6,) that brings the matched points closest to their edges: least squares with
    soft L1, by Gauss-Newton steps that are reweighted. A direction that the edges do not
    determine hardly moves: a step is expected within ``_AROUND``."""
    step = np.zeros(6)
    if matches.found.sum() < 50:
        return step
    for _ in range(2):  # steps between two matchings
        there = Rotation.from_rotvec(-step[:3]).apply(seen - step[3:])
        apart, jacobian = distances(there, matches, at), slopes(there, matches, at)
        weighted = weights(apart)[:, None] * jacobian
        information = weighted.T @ jacobian + np.diag(_AROUND**-2.0)
        step -= np.linalg.solve(information, weighted.T @ apart)
    return step

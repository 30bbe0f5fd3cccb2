"""Camera calibration: move the twin's camera until its arms match those in the pictures (paper App. B.3).

The arms' outlines are rendered at the joint angles that were reported with the pictures and at the present estimate of the
camera pose, and matched with the edges of the pictures (``edges``). Least squares reduce the distances across the edges
(``fit``), and the outlines are rendered again, from coarse pictures to fine ones. Only the arms are used: joint angles say
nothing about the table and the parts. It works for a fixed camera and for one on a wrist, whose pose is relative to the link to
which it is fixed.

The start is the twin's own mount, within about 3° and 30 mm along each axis. Intrinsics are those of the twin: set them to the
camera_info of your own camera.

Letters in shapes: F frames.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from taccorl.alignment.camera.edges import twin_edges
from taccorl.alignment.camera.fit import (
    Level,
    PoseFit,
    distances,
    levels,
    match,
    outlines,
    pixels_of,
    seen_from,
    solve,
)
from taccorl.alignment.camera.interval import Covariance, covariance
from taccorl.alignment.camera.view import TwinView, as_offset
from taccorl.data.origin import UNSTATED, Origin
from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.cameras import CameraConfig
from taccorl.sim.twin import TwinConfig

FEWEST_FRAMES = 4  # Least number of frames of a calibration
_HOLD_OUT = 4  # one frame in so many is kept out of the fit
_REACH_PX = 6.0  # a held-out outline without an edge within this counts as this far off
_FOUND, _FAR = (
    0.5,
    3.0,
)  # of a fit that may be believed: share of held-out outlines with an edge, mean distance [px]


@dataclass(frozen=True, kw_only=True)
class CameraFrames:
    """Pictures of one camera, and the joint angles reported at their times. Raises TaccorlError: the shapes do not fit
    together."""

    pictures: (
        np.ndarray
    )  # (F, rows, columns, 3) uint8 RGB pictures, as recorded or letterboxed by ingest
    joints: (
        np.ndarray
    )  # (F, 14) joint angles [rad] and gripper openings [m], in the order of actions
    stages: dict[str, int] = field(default_factory=dict)
    """"initial", "grasp", "insertion" → index of the frame. These frames are not used in the fit and are shown in the
    overlays."""
    name: str = "pictures"  # Name of the episode, for messages
    origin: Origin = UNSTATED  # Origin of the pictures

    def __post_init__(self) -> None:
        if (
            self.pictures.ndim != 4
            or self.pictures.shape[-1] != 3
            or self.pictures.dtype != np.uint8
        ):
            raise TaccorlError(
                f"{self.name}: pictures are {self.pictures.dtype} {self.pictures.shape}; expected uint8 (F, rows, columns, 3), "
                "all of one size"
            )
        if (
            self.joints.shape != (len(self.pictures), ROBOT.num_actions)
            or not np.isfinite(self.joints).all()
        ):
            raise TaccorlError(
                f"{self.name}: joints are {self.joints.shape} for {len(self.pictures)} pictures; expected one row per picture, "
                f"of {ROBOT.num_actions} finite numbers [rad, m], in the order of actions"
            )
        if any(not 0 <= frame < len(self.pictures) for frame in self.stages.values()):
            raise TaccorlError(
                f"{self.name}: stages {self.stages} name frames that do not exist (frames are 0 … {len(self.joints) - 1})"
            )


@dataclass(frozen=True, kw_only=True)
class CameraFit:
    """Result of a calibration. Poses (6,) are relative to the nominal mount, as ``CameraOffset``: rotation vector [rad],
    translation [m]."""

    camera: CameraConfig
    """The twin's camera with its new offset, for ``save_twin``; unchanged if ``problems`` is not empty."""
    start: np.ndarray  # (6,) pose in the twin before the calibration
    offset: np.ndarray  # (6,) estimated pose
    half_width: np.ndarray
    """(6,) half width of the estimate's 95 % interval, from edge noise and from errors of the twin's shapes and joint zeros;
    infinite for directions that the pictures do not determine."""
    correlation: np.ndarray
    """(6, 6) correlation matrix of the estimate, in the order of ``offset``; NaN if the pictures do not determine all of it."""
    before_px: float
    """Mean distance across the edges between outlines and picture edges in held-out frames, before the calibration [pixels of
    the pictures]."""
    after_px: float  # The same after the calibration [px]
    problems: tuple[str, ...]
    """Reasons why the result is not a valid calibration (not converged, not identifiable); empty if it is valid."""
    overlays: dict[str, np.ndarray]
    """Stage → picture as in the paper: picture, twin, outlines before and after, (rows, columns, 3) uint8 RGB."""
    num_frames: int  # Number of frames that the fit used
    num_held_out: int  # Number of frames that the fit did not use
    name: str  # ``CameraFrames.name``

    @property
    def converged(self) -> bool:
        """True if ``problems`` is empty: the result is a valid calibration."""
        return not self.problems

    def twin(self, config: TwinConfig) -> TwinConfig:
        """``config`` with the calibrated camera. The new offset contains the whole error of the mount. So ``camera_pose`` effects
        on this camera are removed. Raises TaccorlError: the calibration is not valid."""
        if self.problems:
            raise TaccorlError(
                f"camera {self.camera.name}: {'; '.join(self.problems)}. The twin keeps its camera"
            )
        cameras = [
            self.camera if camera.name == self.camera.name else camera
            for camera in config.cameras
        ]
        return dataclasses.replace(
            without_effects(config, self.camera.name, ("camera_pose",)), cameras=cameras
        )


def without_effects(
    config: TwinConfig, camera: str, names: Sequence[str]
) -> TwinConfig:
    """Copy of ``config`` without the effects ``names`` on ``camera``; one that acts on several cameras stays on the others."""
    kept = []
    for effect in config.effects:
        if effect.name not in names or camera not in effect.acts_on():
            kept.append(effect)
        elif others := [c for c in effect.acts_on() if c != camera]:
            kept.append(dataclasses.replace(effect, cameras=others))
    return dataclasses.replace(config, effects=kept)


def calibrate_camera(
    frames: CameraFrames, config: TwinConfig, camera: str
) -> CameraFit:
    """Fit the pose of the twin's ``camera`` so that its arms match those in the pictures.

    Every fourth frame and the frames of the stages are held out: they are not used in the fit, and errors and overlays are
    computed from them. The fit starts at the twin's mount. Raises TaccorlError: there is no such camera, there are too few
    frames, the pictures are of another stream, or no arm is in view."""
    if len(frames.joints) < FEWEST_FRAMES:
        raise TaccorlError(
            f"{frames.name}: {len(frames.joints)} frames; a calibration needs at least {FEWEST_FRAMES}, with the arms in "
            "different poses: three for the fit and one for validation. Eight or more are better"
        )
    with TwinView(config, camera, frames.pictures.shape[1:3]) as view:
        inside = view.inside(frames.pictures)
        held = _held_out(frames)
        fit, test = (
            levels(list(inside[rows]), view.intrinsics) for rows in (~held, held)
        )
        drawn = outlines(view, frames.joints[~held], view.start, view.intrinsics)
        # Fewer points in a frame are a fingertip.
        if len(drawn.points) < 60 * (~held).sum():
            raise TaccorlError(
                f"camera {camera}: at its pose in the twin, the camera hardly shows the arms in {frames.name}: "
                f"{len(drawn.points)} points of their outlines in {(~held).sum()} frames. Record the arms in the middle of the "
                "picture, or correct the camera's mount in the twin by hand"
            )
        solution = solve(view, frames.joints[~held], fit, view.start)
        sure = covariance(view, frames.joints[~held], fit[-1], solution)
        before, after = (
            _judge(view, frames.joints[held], pose, test[-1])
            for pose in (view.start, solution.offset)
        )
        problems = _problems(frames, solution, sure, before, after)
        shown = {
            stage: overlay(
                view,
                inside[k],
                frames.joints[k],
                view.start,
                solution.offset,
                frames.origin,
            )
            for stage, k in frames.stages.items()
        }
        return CameraFit(
            camera=view.camera
            if problems
            else dataclasses.replace(view.camera, offset=as_offset(solution.offset)),
            start=view.start,
            offset=solution.offset,
            half_width=sure.half_width if sure else np.full(6, np.inf),
            correlation=sure.correlation if sure else np.full((6, 6), np.nan),
            before_px=before[0],
            after_px=after[0],
            problems=problems,
            overlays=shown,
            num_frames=int((~held).sum()),
            num_held_out=int(held.sum()),
            name=frames.name,
        )


def _held_out(frames: CameraFrames) -> np.ndarray:
    held = np.zeros(len(frames.joints), dtype=bool)
    held[_HOLD_OUT - 1 :: _HOLD_OUT] = True
    spare = len(held) - FEWEST_FRAMES + 1  # three frames are fitted, whatever else
    for frame in frames.stages.values():
        held[frame] = held[frame] or held.sum() < spare
    return held


def _judge(
    view: TwinView, joints: np.ndarray, offset: np.ndarray, level: Level
) -> tuple[float, float]:
    """Mean distance of the outlines at a pose from the edges [px of the pictures], and the share that has an edge at all."""
    drawn = outlines(view, joints, offset, level.intrinsics)
    if not len(drawn.points):
        return _REACH_PX, 0.0
    scale = level.intrinsics.rows / view.window.rows
    seen = seen_from(view, offset, drawn.points)
    matches = match(drawn, seen, level, _REACH_PX * scale)
    apart = np.abs(distances(seen, matches, level.intrinsics)) / scale
    return float((apart.sum() + _REACH_PX * (~matches.found).sum()) / len(seen)), float(
        matches.found.mean()
    )


def _problems(
    frames: CameraFrames,
    solution: PoseFit,
    sure: Covariance | None,
    before: tuple[float, float],
    after: tuple[float, float],
) -> tuple[str, ...]:
    found = []
    if after[1] < _FOUND or after[0] > _FAR:
        found.append(
            f"not converged: in held-out frames {after[1]:.0%} of the outlines have an edge beside them, {after[0]:.1f} px "
            "away in the mean: the arms are not in the pictures, or not where the joints say, or the start is too far off. "
            "Look at an overlay; check that pictures and joints are of the same instants, and the camera's mount in the twin"
        )
    elif after[0] > before[0] + 0.1:
        found.append(
            f"not converged: held-out frames fit worse than before ({before[0]:.2f} → {after[0]:.2f} px); record more poses"
        )
    if sure is None:
        return (
            *found,
            "not identifiable: the outlines in view do not fix all six numbers; record poses with more of the arms",
        )
    if (np.abs(solution.last_change) > sure.half_width).any():
        found.append(
            "not converged: the last render still moved it by more than its interval"
        )
    width, direction = sure.worst()
    spread = float(np.ptp(frames.joints, axis=0).max())
    if spread < 0.02:  # rad, m: one pose
        found.append(
            f"not identifiable: all {len(frames.joints)} frames show one pose, so no error of the twin averages out and none is "
            f"held out; worst known: {direction}. Record poses that differ"
        )
    elif width > 10.0:  # 3° or 40 mm, wider than the errors to be found
        found.append(
            f"not identifiable: {direction} can hardly be told; record poses that differ more"
        )
    return tuple(found)


BEFORE_RGB, AFTER_RGB = (230, 60, 50), (40, 200, 90)  # Colours of the outlines
_STRIP = 22  # rows for a panel's title


def overlay(
    view: TwinView,
    picture: np.ndarray,
    joints: np.ndarray,
    before: np.ndarray,
    after: np.ndarray,
    origin: Origin,
) -> np.ndarray:
    """Figure of four panels side by side, (rows + 22, 4 · columns, 3) uint8 RGB: the picture; the twin after the calibration; the
    picture with the twin's outlines before, and after.

    Args:
        picture: (rows, columns, 3) uint8 RGB without bars.
        joints: (14,) rad, m.
        before, after: poses (6,).
        origin: of the picture; its domain is written above it.
    """
    kind = f"{origin.domain} picture" if origin.domain else "picture"
    panels = [(kind, picture), ("twin, after", view.picture(joints, after))]
    for title, pose, color in (
        ("before", before, BEFORE_RGB),
        ("after", after, AFTER_RGB),
    ):
        panels.append(
            (f"outlines {title}", _drawn_over(view, picture, joints, pose, color))
        )
    return np.concatenate([_titled(title, image) for title, image in panels], axis=1)


def _drawn_over(
    view: TwinView,
    picture: np.ndarray,
    joints: np.ndarray,
    pose: np.ndarray,
    color: tuple[int, int, int],
) -> np.ndarray:
    at = view.intrinsics
    edges = twin_edges(*view.labels(joints, pose, at.rows, at.columns), at)
    gray = cv2.cvtColor(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB)
    image = (0.6 * gray + 50).astype(np.uint8)
    u, v = np.round(pixels_of(edges.points, at)).astype(int).T
    image[np.clip(v, 0, at.rows - 1), np.clip(u, 0, at.columns - 1)] = color
    return image


def _titled(title: str, image: np.ndarray) -> np.ndarray:
    strip = np.full((_STRIP, image.shape[1], 3), 255, np.uint8)
    cv2.putText(
        strip,
        title,
        (4, _STRIP - 7),
        cv2.FONT_HERSHEY_SIMPLEX,
        0.42,
        (20, 20, 20),
        1,
        cv2.LINE_AA,
    )
    return np.concatenate([strip, image])

"""Brightness and sharpness of a camera's pictures relative to the twin's: parameters of the effect ``camera_exposure``.

At the fitted pose, a pixel of the picture and the same pixel of the twin show the same object. Tone: log y = γ (log g + log x),
a straight line through the medians of the picture's grey values over those of the twin. Light, the objects' colours and the
camera's exposure are described together, because pictures cannot separate them. Blur: an additional blur flattens an edge less
if the edge is already soft, by √((σ² + s₂²) / (σ² + s₁²)) from one extra blur to another (Zhuo and Sim 2011); the twin's own σ
is taken off.
"""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from taccorl.alignment.camera.calibration import CameraFrames
from taccorl.alignment.camera.fit import levels, match, outlines, pixels_of, seen_from
from taccorl.alignment.camera.view import TwinView
from taccorl.errors import TaccorlError
from taccorl.sim.effects.cameras import toned
from taccorl.sim.twin import TwinConfig

_BLURS_PX = (1.0, 2.0)  # s₁, s₂
_FROM_EDGE_PX = (
    4  # pixels closer to an edge of the twin are not compared: the fit is not perfect
)
_FEWEST = 200  # pixels in a bin that counts
_USED = (6.0, 249.0)  # grey values that are neither cut off nor noise alone
_LEAST_STEP = 15.0  # grey values across an edge whose width is measured


@dataclass(frozen=True, kw_only=True)
class LightFit:
    """Tone and blur of a camera relative to the twin. Intervals are 95 %, from the scatter over frames."""

    gain: float  # g in log y = γ (log g + log x), for grey values x of the twin and y of the picture
    gain_interval: tuple[float, float]  # (low, high)
    gamma: float  # γ in the same equation
    gamma_interval: tuple[float, float]  # (low, high)
    blur_px: float  # Blur of the recorded stream beyond the twin's own [px]; 0 if the pictures are sharper
    blur_interval_px: tuple[float, float]  # (low, high) [px]
    grey_before: float  # Mean difference of the grey values between picture and twin [levels of 255], away from edges
    grey_after: float  # Mean difference of the grey values [levels of 255] after gain and gamma are applied to the twin


def camera_light(frames: CameraFrames, config: TwinConfig, camera: str) -> LightFit:
    """Fit gain, gamma and blur of ``camera``, whose pose in the twin is already calibrated. Raises TaccorlError: there are fewer
    than three frames, the twin's or the given pictures have a single grey value, or no edge of the twin is in the pictures."""
    if len(frames.joints) < 3:
        raise TaccorlError(
            f"{frames.name}: {len(frames.joints)} frames; brightness and blur need at least three"
        )
    with TwinView(config, camera, frames.pictures.shape[1:3]) as view:
        inside = view.inside(frames.pictures)
        drawn = [view.picture(row, view.start) for row in frames.joints]
        grey = [
            (_grey(one), _grey(other)) for one, other in zip(drawn, inside, strict=True)
        ]
        flat = [_flat(one) for one, _ in grey]
        pairs = [
            (one[at], other[at]) for (one, other), at in zip(grey, flat, strict=True)
        ]
        tone = _over_frames(
            lambda chosen: _tone(*_joined(pairs, chosen), camera), len(pairs)
        )
        widths = _widths(view, frames.joints, inside, drawn, camera)
        stream_px = view.camera.recording_size[1] / view.window.columns
        blur = (
            _over_frames(lambda chosen: np.array([_blur(widths, chosen)]), len(pairs))
            * stream_px
        )
    x, y = _joined(pairs, np.arange(len(pairs)))
    (gain, gamma), low, high = tone
    return LightFit(
        gain=float(gain),
        gain_interval=(float(low[0]), float(high[0])),
        gamma=float(gamma),
        gamma_interval=(float(low[1]), float(high[1])),
        blur_px=float(blur[0, 0]),
        blur_interval_px=(float(blur[1, 0]), float(blur[2, 0])),
        grey_before=float(np.abs(y - x).mean()),
        grey_after=float(np.abs(y - toned(x, gain, gamma)).mean()),
    )


def _grey(picture: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(np.float32)


def _flat(grey: np.ndarray) -> np.ndarray:
    """(rows, columns) bool: away from every step in the twin's picture."""
    steps = (
        cv2.morphologyEx(grey, cv2.MORPH_GRADIENT, np.ones((3, 3))) > _LEAST_STEP
    ).astype(np.uint8)
    return (
        cv2.dilate(steps, np.ones((2 * _FROM_EDGE_PX + 1, 2 * _FROM_EDGE_PX + 1))) == 0
    )


def _joined(
    pairs: list[tuple[np.ndarray, np.ndarray]], chosen: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    return np.concatenate([pairs[k][0] for k in chosen]), np.concatenate(
        [pairs[k][1] for k in chosen]
    )


def _tone(x: np.ndarray, y: np.ndarray, camera: str) -> np.ndarray:
    """Gain and gamma from grey values of the twin and of the pictures."""
    bin_of = np.digitize(x, np.linspace(0, 255, 24 + 1))
    rows = []
    for k in np.unique(bin_of):
        mine = bin_of == k
        middle = float(np.median(x[mine])), float(np.median(y[mine]))
        if mine.sum() >= _FEWEST and all(
            _USED[0] < value < _USED[1] for value in middle
        ):
            rows.append((*np.log(np.array(middle) / 255), mine.sum()))
    if len(rows) < 3:
        raise TaccorlError(
            f"camera {camera}: only {len(rows)} grey levels, neither black nor white, occur in both the pictures and the twin; "
            "three are needed. Light the bench so that arms and table are visible"
        )
    log_x, log_y, count = np.array(rows).T
    slope, start = np.polyfit(log_x, log_y, 1, w=np.sqrt(np.sqrt(count)))
    if slope <= 0.05:
        areas = "areas that are bright in the twin are dark in the pictures"
        raise TaccorlError(f"camera {camera}: {areas}: fit the camera's pose first")
    return np.array([np.exp(start / slope), slope])


def _widths(
    view: TwinView,
    joints: np.ndarray,
    pictures: np.ndarray,
    drawn: list[np.ndarray],
    camera: str,
) -> list[tuple[np.ndarray, np.ndarray]]:
    """For each frame, of outlines that the picture has as edges: ratio of the gradients after two more blurs, in the picture
    and in the twin."""
    lines = outlines(view, joints, view.start, view.intrinsics)
    every = levels(list(pictures), view.intrinsics)
    level = next(level for level in every if level.intrinsics.rows == view.window.rows)
    seen = seen_from(view, view.start, lines.points)
    matches = match(lines, seen, level, 3.0)
    here = pixels_of(seen, level.intrinsics)
    found = []
    for frame, (picture, twin) in enumerate(zip(pictures, drawn, strict=True)):
        mine = matches.found & (lines.frames == frame)
        found.append(
            (_flatter(picture, matches.edges[mine]), _flatter(twin, here[mine]))
        )
    if sum(len(one) for one, _ in found) < _FEWEST:
        none = "no edges of the arms are at their positions in the twin"
        raise TaccorlError(f"camera {camera}: {none}; fit the camera's pose first")
    return found


def _flatter(picture: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    grey = _grey(picture)
    sizes = []
    for sigma in _BLURS_PX:
        soft = cv2.GaussianBlur(grey, (0, 0), sigma)
        dx, dy = (cv2.Sobel(soft, cv2.CV_32F, k, 1 - k, ksize=3) for k in (1, 0))
        size = np.hypot(dx, dy)
        # The steepest of the pixels around: where exactly the edge runs need not be known.
        peak = cv2.dilate(size, np.ones((3, 3)))
        u, v = np.round(pixels).astype(int).T
        sizes.append(
            peak[np.clip(v, 0, size.shape[0] - 1), np.clip(u, 0, size.shape[1] - 1)]
        )
    strong = sizes[0] > _LEAST_STEP
    return sizes[0][strong] / sizes[1][strong]


def _blur(widths: list[tuple[np.ndarray, np.ndarray]], chosen: np.ndarray) -> float:
    """σ [px] of the pictures beyond the twin's, from how much edges flatten."""
    flatter = (
        np.median(np.concatenate([widths[k][side] for k in chosen])) for side in (0, 1)
    )
    first, second = (s**2 for s in _BLURS_PX)
    picture, twin = (
        (second - r * first) / (r - 1)
        for r in (max(float(one), 1.001) ** 2 for one in flatter)
    )
    return float(np.sqrt(max(picture - twin, 0.0)))


def _over_frames(
    estimate: Callable[[np.ndarray], np.ndarray], num_frames: int
) -> np.ndarray:
    """(3, numbers): the estimate from all frames, and its 95 % interval by a jackknife over them."""
    whole = estimate(np.arange(num_frames))
    without = np.stack(
        [estimate(np.delete(np.arange(num_frames), k)) for k in range(num_frames)]
    )
    error = np.sqrt(
        (num_frames - 1) * np.mean((without - without.mean(0)) ** 2, axis=0)
    )
    return np.stack([whole, whole - 1.96 * error, whole + 1.96 * error])

"""Latency of a camera, from the change between consecutive pictures compared with that in the twin.

The twin is rendered with the joint angles at each picture's time; the change between two of its pictures follows the arms'
motion without delay. The change between measured pictures is the same curve with a delay: the shift with the best agreement is
the latency, to a fraction of a frame. Light and colours scale the curve and do not move it. The camera's pose hardly matters.

The change is computed in cells of the picture, because the arm enters one cell while it leaves another.

Letters in shapes: T pictures, S shifts, C cells.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from scipy.interpolate import CubicSpline

from taccorl.alignment.camera.view import TwinView
from taccorl.errors import TaccorlError
from taccorl.sim.twin import TwinConfig

EARLIEST_S, LATEST_S = -0.1, 0.3
"""Range of latencies that are searched [s]. A negative latency would mean pictures ahead of the joints: a clock error."""
_STEP_S = 0.001
_ROWS, _CELL = (
    60,
    10,
)  # pixels of the small pictures that are compared, and of the cells in which they are
_DRAWS = 200
_FEWEST_S = 3.0


@dataclass(frozen=True, kw_only=True)
class LatencyFit:
    """Estimated latency of a camera, with its interval."""

    latency_s: (
        float  # Latency [s]: a picture shows the scene at its time stamp minus this
    )
    interval_s: tuple[
        float, float
    ]  # 95 % interval [s], by a bootstrap over blocks of pictures
    correlation: float
    """Correlation, at that latency, of the motion in the recorded pictures with the motion in the twin's pictures."""
    problems: tuple[str, ...]  # Reasons why the result is not valid; empty if it is


def camera_latency(
    pictures: Iterable[np.ndarray],
    time_s: np.ndarray,
    joints: np.ndarray,
    config: TwinConfig,
    camera: str,
) -> LatencyFit:
    """Estimate the latency of ``camera`` from pictures T × (rows, columns, 3) uint8 with time stamps ``time_s`` (T,). ``joints``:
    (T, 14) rad, m, as reported at the same times. Raises TaccorlError: the pictures cover less than 3 s, times are not even, or
    the number of rows differs from that of pictures."""
    time_s = np.asarray(time_s, float)
    if len(time_s) < 3 or time_s[-1] - time_s[0] < _FEWEST_S:
        raise TaccorlError(
            f"camera {camera}: {len(time_s)} pictures cover less than {_FEWEST_S:g} s, too little to estimate a latency"
        )
    period_s = float(np.median(np.diff(time_s)))
    if np.abs(np.diff(time_s) - period_s).max() > 0.2 * period_s:
        raise TaccorlError(
            f"camera {camera}: pictures are not evenly spaced by {period_s * 1e3:.1f} ms; give rows of an aligned episode"
        )
    measured, twin = _changes(pictures, joints, config, camera)
    if len(measured) != len(time_s) - 1:
        raise TaccorlError(
            f"camera {camera}: {len(measured) + 1} pictures for {len(time_s)} rows"
        )
    middle_s = (time_s[1:] + time_s[:-1]) / 2
    shifts = (
        np.arange(round(EARLIEST_S / _STEP_S), round(LATEST_S / _STEP_S) + 1) * _STEP_S
    )
    kept = (middle_s >= middle_s[0] + LATEST_S) & (
        middle_s <= middle_s[-1] + EARLIEST_S
    )
    curve = CubicSpline(middle_s, twin)
    shifted = np.stack([curve(middle_s[kept] - shift) for shift in shifts])
    one, other = (
        measured[kept] - measured[kept].mean(0),
        shifted - shifted.mean(1, keepdims=True),
    )
    moments = _Moments((other * one).sum(2), (other**2).sum(2), (one**2).sum(1))
    agree = _correlation(moments, np.ones(int(kept.sum())))
    best = int(np.argmax(agree))
    # Blocks of 0.7 s, longer than a movement's rise.
    drawn = _bootstrap(moments, max(1, round(0.7 / period_s)), shifts)
    low, high = np.quantile(drawn, [0.025, 0.975])
    return LatencyFit(
        latency_s=float(shifts[best]),
        interval_s=(float(low), float(high)),
        correlation=float(agree[best]),
        problems=_problems(agree, best, shifts, twin),
    )


def _changes(
    pictures: Iterable[np.ndarray], joints: np.ndarray, config: TwinConfig, camera: str
) -> tuple[np.ndarray, np.ndarray]:
    """(T − 1, C) mean change of the grey values from picture to picture in each cell, measured and in the twin."""
    view: TwinView | None = None
    before: list[np.ndarray] = []
    measured, twin = [], []
    try:
        for picture, row in zip(pictures, joints, strict=False):
            if view is None:
                view = TwinView(
                    config, camera, (int(picture.shape[0]), int(picture.shape[1]))
                )
            now = [
                _small(image)
                for image in (
                    view.inside(picture[None])[0],
                    view.picture(row, view.start),
                )
            ]
            for changes, new, old in zip((measured, twin), now, before, strict=False):
                changes.append(_cells(np.abs(new - old)))
            before = now
    finally:
        if view is not None:
            view.close()
    return np.array(measured), np.array(twin)


def _small(picture: np.ndarray) -> np.ndarray:
    columns = round(_ROWS * picture.shape[1] / picture.shape[0])
    gray = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    return cv2.resize(gray, (columns, _ROWS), interpolation=cv2.INTER_AREA).astype(
        np.float32
    )


def _cells(change: np.ndarray) -> np.ndarray:
    """(C,) mean of each whole cell of a picture."""
    rows, columns = (n // _CELL for n in change.shape)
    cells = change[: rows * _CELL, : columns * _CELL].reshape(
        rows, _CELL, columns, _CELL
    )
    return cells.mean(axis=(1, 3)).ravel()


class _Moments(NamedTuple):
    """What a correlation over any draw of pictures is made of, for each of them, summed over cells after centring."""

    both: np.ndarray  # (S, T) twin at a shift times measured
    twin: np.ndarray  # (S, T) twin at a shift, squared
    measured: np.ndarray  # (T,) squared


def _correlation(moments: _Moments, weights: np.ndarray) -> np.ndarray:
    """(S,) of the twin's curves at each shift with the measured ones, each picture counted ``weights`` (T,) times."""
    spread = np.sqrt((moments.twin @ weights) * (moments.measured @ weights))
    return (moments.both @ weights) / np.maximum(spread, 1e-12)


def _bootstrap(moments: _Moments, block: int, shifts: np.ndarray) -> np.ndarray:
    """Best shifts of ``_DRAWS`` draws of blocks of pictures."""
    rng = np.random.default_rng(0)
    block_of = np.arange(len(moments.measured)) // block
    num = int(block_of[-1]) + 1
    best = []
    for _ in range(_DRAWS):
        drawn = np.bincount(rng.integers(0, num, num), minlength=num)
        best.append(
            shifts[np.argmax(_correlation(moments, drawn[block_of].astype(float)))]
        )
    return np.array(best)


def _problems(
    agree: np.ndarray, best: int, shifts: np.ndarray, twin: np.ndarray
) -> tuple[str, ...]:
    if np.ptp(twin, axis=0).max() < 0.5:
        return ("the arms hardly move in this view: record them going to and fro",)
    if agree[best] < 0.5:  # the curves do not show the same motion
        return (
            f"the pictures change otherwise than the arms move (correlation {agree[best]:.2f}): another camera's pictures, a "
            f"clock that is off by more than {LATEST_S:g} s, or something else moves in view",
        )
    if best in (0, len(shifts) - 1):
        return (
            f"beyond {shifts[best]:g} s: the clocks of pictures and joints are not one; compare their stamps",
        )
    return ()

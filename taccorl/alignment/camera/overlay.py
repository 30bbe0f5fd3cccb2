"""Overlay of twin and picture, as in the paper's figure of camera calibration (App. B.3)."""

import cv2
import numpy as np

from taccorl.alignment.camera.edges import twin_edges
from taccorl.alignment.camera.fit import pixels_of
from taccorl.alignment.camera.view import TwinView
from taccorl.data.origin import Origin

BEFORE_RGB, AFTER_RGB = (230, 60, 50), (40, 200, 90)
"""Colours of the outlines."""
_STRIP = 22  # rows for a panel's title


def overlay(
    view: TwinView, picture: np.ndarray, joints: np.ndarray, before: np.ndarray, after: np.ndarray, origin: Origin
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
    for title, pose, color in (("before", before, BEFORE_RGB), ("after", after, AFTER_RGB)):
        panels.append((f"outlines {title}", _drawn_over(view, picture, joints, pose, color)))
    return np.concatenate([_titled(title, image) for title, image in panels], axis=1)


def _drawn_over(
    view: TwinView, picture: np.ndarray, joints: np.ndarray, pose: np.ndarray, color: tuple[int, int, int]
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
    cv2.putText(strip, title, (4, _STRIP - 7), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (20, 20, 20), 1, cv2.LINE_AA)
    return np.concatenate([strip, image])

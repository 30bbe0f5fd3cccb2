"""Colours of all views, RGB: a joint, a pad or a line has the same colour in plots, heatmaps, figure and sheet.

Lines stay apart on dark ground and for colour-blind eyes (Okabe and Ito's set, lightened).
"""

import functools

import cv2
import numpy as np

LINE_COLORS = (
    (86, 180, 233),
    (230, 159, 0),
    (0, 190, 140),
    (240, 228, 66),
    (220, 110, 60),
    (214, 140, 190),
    (150, 150, 255),
    (190, 190, 190),
)
PAD_COLORS = ((86, 180, 233), (0, 190, 140), (230, 159, 0), (214, 140, 190))
ARM_COLORS = {"left": (96, 165, 250), "right": (251, 146, 60)}
PAIR_COLORS = ((235, 235, 235), (240, 90, 190))
"""Colours of two episodes side by side: white and magenta, because blue and orange are the arms' colours."""
NOISE_COLOR = (148, 163, 184)
CONTACT_COLOR = (220, 38, 38)
GROUND_COLOR = (15, 23, 42)
HEATMAP = "turbo"
"""Rerun's name of the colour map for heatmaps. Low counts stay visible on a scale for the sensor's whole range."""


def heat(share: np.ndarray) -> np.ndarray:
    """Colours (…, 3) uint8 RGB of the heatmaps' colour map for ``share`` (…), 0 … 1; values outside get the end's colour."""
    level = (255 * np.clip(np.asarray(share, dtype=float), 0.0, 1.0)).astype(np.uint8)
    return _heat_table()[level]


@functools.cache
def _heat_table() -> np.ndarray:
    """(256, 3): OpenCV starts its threads for every call, 12 ms for the 384 taxels of a pad."""
    return cv2.applyColorMap(
        np.arange(256, dtype=np.uint8).reshape(-1, 1), cv2.COLORMAP_TURBO
    )[:, 0, ::-1]

"""Cut of the black bars of letterboxed pictures, for policies whose pictures are not square.

Datasets and the twin letterbox each camera's picture into a square frame: 480 × 640 pixels become 168 × 224 between bars of
28 rows. A policy with ``--policy.image_resolution=[84,112]`` gets the picture between the bars only.
"""

import math
from typing import Any

import numpy as np
import torch

from taccorl.errors import TaccorlError

_BLACK = 8 / 255  # mean of bars; a video's compression leaves up to 3 / 255


def without_bars(
    pictures: Any,
    resolution: tuple[int, int] | None,
    name: str,
    *,
    channels_last: bool = False,
    check: bool = True,
) -> Any:
    """Cut the black bars off square ``pictures``, so that they have the aspect of ``resolution``, the policy's (rows, columns).
    Pictures that are not square, and all if ``resolution`` is square or None, are returned unchanged. ``pictures``: array or
    tensor, (…, rows, columns), or (…, rows, columns, 3) if ``channels_last``; uint8, or float in [0, 1]. ``name``: of the
    pictures, for messages. ``check``: compute whether the bars are black. Raises TaccorlError: they are not."""
    rows, columns = pictures.shape[-3:-1] if channels_last else pictures.shape[-2:]
    if resolution is None or rows != columns or resolution[0] == resolution[1]:
        return pictures
    factor = min(rows / resolution[0], columns / resolution[1])
    height, width = round(resolution[0] * factor), round(resolution[1] * factor)
    top, left = (rows - height) // 2, (columns - width) // 2
    inside: Any = ..., slice(top, top + height), slice(left, left + width)
    middle = pictures[(*inside, slice(None)) if channels_last else inside]
    white = 255 if pictures.dtype in (np.uint8, torch.uint8) else 1
    num_cut = math.prod(pictures.shape) - math.prod(middle.shape)
    if (
        check
        and (mean := (float(pictures.sum()) - float(middle.sum())) / num_cut / white)
        > _BLACK
    ):
        raise TaccorlError(
            f"{name}: of {rows}×{columns} pictures --policy.image_resolution=[{resolution[0]},{resolution[1]}] uses the middle "
            f"{height}×{width}, but outside of it they are not black (mean {255 * mean:.0f} of 255), so they are not letterboxed "
            "to this aspect: give a square resolution, or one of the cameras' own aspect"
        )
    return middle

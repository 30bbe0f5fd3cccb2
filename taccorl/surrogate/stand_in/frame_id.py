"""Frame id in a picture: 16 bits in the upper left corner, 2 × 8 blocks of 8 × 8 pixels, first bit first."""

import numpy as np

from taccorl.errors import TaccorlError

BLOCK_PX = 8
"""Side of a block [pixels]."""
_BITS = (2, 8)  # rows, columns of blocks
SMALLEST_PICTURE = (_BITS[0] * BLOCK_PX * 3, _BITS[1] * BLOCK_PX)  # rows, columns


def draw_frame_id(picture: np.ndarray, frame_id: int) -> None:
    """Draw the lower 16 bits of ``frame_id`` into a uint8 picture (rows, columns, 3); white is 1."""
    bits = (frame_id >> np.arange(15, -1, -1)) & 1
    corner = np.kron(bits.reshape(_BITS), np.full((BLOCK_PX, BLOCK_PX), 255)).astype(np.uint8)
    picture[: corner.shape[0], : corner.shape[1]] = corner[..., None]


def read_frame_id(image_rgb: np.ndarray) -> int:
    """Frame id, 0 … 65535, of the stand-in picture ``image_rgb`` (rows, columns, 3) at its native size; survives JPEG and video.

    Raises:
        TaccorlError: a block is neither black nor white, so this is no stand-in picture, or it was resized.
    """
    rows, columns = (count * BLOCK_PX for count in _BITS)
    corner = np.asarray(image_rgb)[:rows, :columns].astype(float).mean(axis=-1)
    blocks = corner.reshape(_BITS[0], BLOCK_PX, _BITS[1], BLOCK_PX)[:, 2:-2, :, 2:-2]
    levels = blocks.mean(axis=(1, 3)).ravel()
    if np.any(np.abs(levels - 127.5) < 50):
        raise TaccorlError(
            f"no frame id in this {image_rgb.shape[0]} × {image_rgb.shape[1]} picture: its corner blocks have levels "
            f"{levels.round().astype(int).tolist()}, not all black or white. "
            "Only stand-in pictures at their native size carry one."
        )
    return int((levels > 127.5) @ (1 << np.arange(15, -1, -1)))

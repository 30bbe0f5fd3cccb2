"""Synthetic camera pictures of test recordings: a random texture, shifted by the joint angles; upper left, the frame's number."""

from collections.abc import Iterator

import cv2
import numpy as np

from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.surrogate.drivers import ARMS
from tests.recordings.story import Story

BLOCK_PX = 8  # side of a block of the frame id: 16 bits, first bit first
_BITS = (2, 8)  # rows, columns of blocks


class Dark:
    """Cameras that see nothing, at no cost."""

    def pictures_bgr(self, camera, time_s, frame_ids):
        for _ in frame_ids:
            yield np.zeros((96, 128, 3), np.uint8)


def draw_frame_id(picture: np.ndarray, frame_id: int) -> None:
    """Draw the lower 16 bits of ``frame_id`` into a uint8 picture (rows, columns, 3); white is 1."""
    bits = (frame_id >> np.arange(15, -1, -1)) & 1
    corner = np.kron(bits.reshape(_BITS), np.full((BLOCK_PX, BLOCK_PX), 255)).astype(
        np.uint8
    )
    picture[: corner.shape[0], : corner.shape[1]] = corner[..., None]


def read_frame_id(image_rgb: np.ndarray) -> int:
    """Frame id, 0 … 65535, of the picture ``image_rgb`` (rows, columns, 3) at its native size; survives JPEG and video. Raises
    TaccorlError: a block is neither black nor white, so this is no stand-in picture, or it was resized."""
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


class Scene:
    """A wrist camera's table is shifted by its arm's joints; the front camera has a disc on it for the hand of each arm."""

    def __init__(self, story: Story, camera_size: tuple[int, int], seed: int) -> None:
        self.story, self.size = story, camera_size
        self._rng = {
            camera: np.random.default_rng([seed, 3, c])
            for c, camera in enumerate(ROBOT.cameras)
        }
        rows, columns = camera_size
        grain = (
            np.random.default_rng(7).normal(0, 1, (rows, columns, 1)).astype(np.float32)
        )
        coarse = cv2.resize(
            grain[: rows // 8, : columns // 8],
            (columns, rows),
            interpolation=cv2.INTER_CUBIC,
        )
        self._table = (
            np.array([108, 152, 190], np.float32) + 10 * grain + 24 * coarse[..., None]
        )

    def pictures_bgr(
        self, camera: str, time_s: np.ndarray, frame_ids: np.ndarray
    ) -> Iterator[np.ndarray]:
        """Iterate over pictures of ``camera``, one uint8 (rows, columns, 3) in BGR for each of the times ``time_s`` (N,) [s]. The
        noise depends on the number of pictures drawn before."""
        rows, columns = self.size
        state, rng = self.story.at("state", time_s), self._rng[camera]
        for joints, frame_id in zip(state, frame_ids.tolist(), strict=True):
            if camera == "front":
                picture = self._table.copy()
                for arm, colour in zip(
                    ARMS, ((60, 60, 200), (200, 90, 40)), strict=True
                ):
                    turn, reach, *_ = joints[ROBOT.joint_slice(arm)]
                    at = (
                        round(columns * (0.5 - 0.6 * turn)),
                        round(rows * (0.2 + 0.2 * reach)),
                    )
                    cv2.circle(picture, at, rows // 8, colour, -1)
            else:
                shift = np.rint(
                    rows * joints[ROBOT.joint_slice(camera.split("_")[0])][:2]
                ).astype(int)
                picture = np.roll(self._table, shift.tolist(), axis=(1, 0))
            noise = rng.normal(0, 4, (rows // 2, columns // 2, 1)).astype(np.float32)
            picture = (
                picture
                + cv2.resize(noise, (columns, rows), interpolation=cv2.INTER_NEAREST)[
                    ..., None
                ]
            )
            picture = np.clip(picture, 0, 255).astype(np.uint8)
            draw_frame_id(picture, frame_id)
            yield picture

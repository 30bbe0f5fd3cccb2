"""Select frames of an episode for camera calibration.

Frames in which the arms are at rest are independent of the latency; different poses determine more than many frames.
"""

from collections.abc import Iterator

import numpy as np

from taccorl.alignment.camera.calibration import CameraFrames
from taccorl.alignment.measurements.recorded import signal_names
from taccorl.data.episode import Episode
from taccorl.data.spec import STATE
from taccorl.errors import TaccorlError, nearest
from taccorl.robots import ROBOT
from taccorl.sim.robot import link_poses

PICTURE = "observation.images."


def camera_frames(
    episode: Episode, camera: str, num_frames: int = 16, latency_s: float = 0.0
) -> CameraFrames:
    """Select rows of an episode at which the arms are at rest in different poses, and the stages of the paper's figure.
    ``num_frames``: number of frames to select, without those of the stages. ``latency_s``: age of the scene in a picture relative
    to its row [s]; 0 if ingest has already corrected for it. Raises TaccorlError: there is no such camera, or the state does not
    hold the robot's joints and grippers."""
    joints = joint_rows(episode)
    time_s = episode.time_s
    shown = np.column_stack(
        [np.interp(time_s - latency_s, time_s, column) for column in joints.T]
    )
    stages = stage_rows(joints)
    rows = sorted({*stages.values(), *_different(joints, num_frames)})
    first = zip(range(rows[-1] + 1), all_pictures(episode, camera), strict=False)
    pictures = {row: picture for row, picture in first if row in rows}
    if len(pictures) < len(rows):
        raise TaccorlError(
            f"{episode.name}: camera {camera} has {len(pictures)} of the {len(rows)} pictures requested"
        )
    return CameraFrames(
        pictures=np.stack([pictures[row] for row in rows]),
        joints=shown[rows],
        stages={stage: rows.index(row) for stage, row in stages.items()},
        name=episode.name,
        origin=episode.origin,
    )


def joint_rows(episode: Episode) -> np.ndarray:
    """(T, 14) joint angles [rad] and gripper openings [m] of the T rows as reported, in the order of actions. Raises
    TaccorlError: the state lacks a joint or gripper."""
    names = signal_names(episode.spec)
    if missing := [name for name in ROBOT.action_names if name not in names]:
        raise TaccorlError(
            f"{episode.name}: {STATE} has no {', '.join(missing[:3])}{' …' if len(missing) > 3 else ''}; camera "
            f"calibration needs all {ROBOT.num_actions} joints and grippers"
        )
    return episode.arrays[STATE].astype(float)[
        :, [names.index(name) for name in ROBOT.action_names]
    ]


def stage_rows(joints: np.ndarray) -> dict[str, int]:
    """Rows of the stages in the paper's figure, from joints (T, 14) [rad, m] alone. Returns stage → index of the row: "initial"
    (0), "grasp" (a hand has just closed; absent if none closes) and "insertion" (hands closest together)."""
    stages = {"initial": 0}
    openings = joints[:, ROBOT.gripper_indices]
    moved = np.ptp(openings, axis=0)
    closed = (openings < openings.min(0) + 0.25 * moved) & (
        moved > 0.2 * ROBOT.opening_max_m
    )
    if closed.any():
        stages["grasp"] = int(np.argmax(closed.any(1)))
    hands = [
        link_poses(joints[:, ROBOT.joint_slice(arm)])[:, -1, :3, 3]
        for arm in ROBOT.arms
    ]
    # Bases stand side by side, along y; how far apart does not change which row it is by much.
    apart = np.linalg.norm((hands[0] - hands[1]) + [0.0, 0.6, 0.0], axis=1)
    stages["insertion"] = int(len(apart) - 1 - np.argmin(apart[::-1]))
    return stages


def _different(joints: np.ndarray, num_frames: int) -> list[int]:
    """Rows among the slower ones, each as far as can be from those before it."""
    # A gripper that moves from end to end counts as half a radian.
    scaled = joints * ROBOT.per_action(1.0, 0.5 / ROBOT.opening_max_m)
    speed = np.linalg.norm(np.gradient(scaled, axis=0), axis=1)
    slow = np.flatnonzero(speed <= np.quantile(speed, 0.5))
    chosen = [int(slow[0])]
    distance = np.full(len(slow), np.inf)
    for _ in range(min(num_frames, len(slow)) - 1):
        distance = np.minimum(
            distance, np.linalg.norm(scaled[slow] - scaled[chosen[-1]], axis=1)
        )
        chosen.append(int(slow[np.argmax(distance)]))
    return chosen


def all_pictures(episode: Episode, camera: str) -> Iterator[np.ndarray]:
    """Iterate over the (rows, columns, 3) uint8 pictures of a camera, row by row. Raises TaccorlError: the episode has no such
    camera."""
    key = PICTURE + camera
    if key not in episode.picture_keys:
        known = [k.removeprefix(PICTURE) for k in episode.picture_keys]
        raise TaccorlError(
            f"{episode.name} has no camera {camera!r}; {nearest(camera, known)}"
        )
    for pictures in episode.pictures():
        yield pictures[key]

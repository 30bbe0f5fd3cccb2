"""The two PiPER arms as a figure of capsules: joint frames are exact, thicknesses and stands schematic. It uses no physics and
no meshes.

Frames: ``base`` is an arm's mounting plate (z up, x forward), ``link_i`` turns with joint i about its own z axis; in link 6,
z points out of the gripper and y is the way the fingers slide. Letters in shapes: T rows (time).
"""

import re

import numpy as np
import rerun as rr
from scipy.spatial.transform import Rotation

from taccorl.data.episode import Episode
from taccorl.robots import ROBOT
from taccorl.views.colors import ARM_COLORS, LINE_COLORS, heat
from taccorl.views.rrd import EpisodeLog
from taccorl.views.touch import Pad

# Schematic from here on.
BASE_POS_WORLD = {"left": (0.0, 0.3, 0.0), "right": (0.0, -0.3, 0.0)}
BONE_RADIUS_M = (
    0.045,
    0.0,
    0.036,
    0.032,
    0.0,
    0.028,
    0.024,
)  # base, link 1 to 6; 0: no bone, its child sits on it
# Radius, length, and place on the joint's own axis: frames 1 and 2, and 4 and 5, have one origin, their drums do not.
JOINT_DRUMS_M = (
    (0.056, 0.030, -0.070),
    (0.046, 0.100, 0.0),
    (0.042, 0.090, 0.0),
    (0.040, 0.026, -0.075),
    (0.034, 0.074, 0.0),
    (0.034, 0.026, 0.010),
)
PAD_THICKNESS_M = 0.003
"""Thickness of the drawn pads [m]."""
FINGER_THICKNESS_M = 0.010
"""Thickness of the drawn fingers [m]."""
PLATE_COLOR = (71, 85, 105)
FINGER_COLOR = (51, 65, 85)


def arms_of(episode: Episode) -> dict[str, np.ndarray]:
    """Side → (T, 7) joint angles 1 to 6 [rad] and gripper opening [m], for the PiPER arms that the episode's state names."""
    feature = episode.spec.features.get("observation.state")
    if feature is None or "piper" not in episode.spec.robot_type.lower():
        return {}
    index = {re.sub(r"\.pos$", "", name): i for i, name in enumerate(feature.names)}
    found = {}
    for side in BASE_POS_WORLD:
        names = [f"{side}_joint_{i}" for i in range(1, ROBOT.num_joints + 1)] + [
            f"{side}_gripper"
        ]
        if all(name in index for name in names):
            found[side] = episode.arrays["observation.state"][
                :, [index[name] for name in names]
            ].astype(float)
    return found


def link_poses(joints_rad: np.ndarray) -> np.ndarray:
    """(T, 7, 4, 4) base_from_link of the base and links 1 to 6 [m], for ``joints_rad`` (T, 6)."""
    from taccorl.sim import robot  # with MuJoCo, which only this needs

    poses = robot.link_poses(joints_rad)
    return np.concatenate(
        [np.broadcast_to(np.eye(4), (len(poses), 1, 4, 4)), poses], axis=1
    )


def pad_poses(link6_poses: np.ndarray, opening_m: np.ndarray) -> np.ndarray:
    """(T, 2, 4, 4) base_from_pad, poses of the pads' faces; finger a slides along +y of link 6, finger b along −y.

    ``link6_poses`` (T, 4, 4) is base_from_link of link 6, ``opening_m`` (T,) the distance between the pads."""
    poses = np.repeat(link6_poses[:, None], 2, axis=1)
    for finger, sign in enumerate((1.0, -1.0)):
        offset = np.zeros((len(opening_m), 3))
        offset[:, 1], offset[:, 2] = (
            sign * opening_m / 2,
            ROBOT.finger_from_hand_m + ROBOT.pad.length_m / 2,
        )
        poses[:, finger, :3, 3] += np.einsum(
            "tij,tj->ti", link6_poses[:, :3, :3], offset
        )
    return poses


def tool_paths(episode: Episode) -> dict[str, np.ndarray]:
    """Side → (T, 3) world positions of the point in the middle between the pads [m]."""
    paths = {}
    for side, joints in arms_of(episode).items():
        faces = pad_poses(link_poses(joints[:, :-1])[:, -1], joints[:, -1])
        paths[side] = faces[:, :, :3, 3].mean(axis=1) + BASE_POS_WORLD[side]
    return paths


def floor_z_m(episode: Episode) -> float:
    """World height of the drawn floor [m]: just below the lowest finger, because the height of the arms is not recorded."""
    lowest = min(path[:, 2].min() for path in tool_paths(episode).values())
    return min(0.0, float(lowest) - ROBOT.pad.length_m / 2 - 0.01)


def log_figure(log: EpisodeLog, pads: list[Pad]) -> None:
    """Log the arms under ``/figure``; the colour of a pad shows its sum of counts on the pad's fixed scale."""
    log.static("figure", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    by_name = {pad.name: pad for pad in pads}
    for side, joints in arms_of(log.episode).items():
        root = f"figure/{side}"
        poses = link_poses(joints[:, :-1])
        _log_still_parts(log, root, side, floor_z_m(log.episode))
        for i in range(1, len(ROBOT.links) + 1):
            _send_poses(log, f"{root}/link_{i}", poses[:, i])
        faces = pad_poses(poses[:, -1], joints[:, -1])
        for finger, name in enumerate(ROBOT.fingers):
            _send_poses(log, f"{root}/finger_{name}", faces[:, finger])
            pad = by_name.get(f"{side}_{name}")
            if pad is None:
                log.static(
                    f"{root}/finger_{name}/pad",
                    rr.Boxes3D.from_fields(colors=[PLATE_COLOR]),
                )
            else:  # never static as well: what is static hides what changes
                log.send(
                    f"{root}/finger_{name}/pad",
                    rr.Boxes3D.columns(colors=pad_colors(pad)),
                )
        path = tool_paths(log.episode)[side] - BASE_POS_WORLD[side]
        log.static(
            f"{root}/tool_path",
            rr.LineStrips3D([path], colors=[(*ARM_COLORS[side], 120)], radii=0.0015),
        )


def pad_colors(pad: Pad) -> np.ndarray:
    """(T,) colour of a pad as RGBA in uint32, from 0 (no active taxels) up to ``Pad.full_sum_count``."""
    rgb = heat(pad.sum_count / pad.full_sum_count).astype(np.uint32)
    return (rgb[:, 0] << 24) | (rgb[:, 1] << 16) | (rgb[:, 2] << 8) | 255


def _send_poses(log: EpisodeLog, path: str, poses: np.ndarray) -> None:
    quat_xyzw = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    columns = rr.Transform3D.columns(translation=poses[:, :3, 3], quaternion=quat_xyzw)
    log.send(path, columns)


def _log_still_parts(log: EpisodeLog, root: str, side: str, floor_z: float) -> None:
    """Everything that does not change its shape, each in the frame of the link that carries it."""
    log.static(root, rr.Transform3D(translation=BASE_POS_WORLD[side]))
    height, top = 0.03 - floor_z, 0.03
    stand = rr.Cylinders3D(
        lengths=[height],
        radii=[0.07],
        centers=[(0, 0, top - height / 2)],
        colors=[PLATE_COLOR],
        fill_mode="solid",
    )
    log.static(f"{root}/stand", stand)
    label = rr.Points3D(
        [(0, 0.12 * np.sign(BASE_POS_WORLD[side][1]), floor_z)],
        labels=[f"{side} arm"],
        radii=0.001,
        colors=[ARM_COLORS[side]],
        show_labels=True,
    )
    log.static(f"{root}/label", label)
    ends = [link.pos_parent_m for link in ROBOT.links] + [(0.0, 0.0, 0.1)]
    for i, (radius, end) in enumerate(zip(BONE_RADIUS_M, ends, strict=True)):
        link = f"{root}/link_{i}" if i else root
        if radius:
            log.static(
                f"{link}/bone", _capsule(np.array(end), radius, ARM_COLORS[side])
            )
        if i:
            radius, length, z = JOINT_DRUMS_M[i - 1]
            drum = rr.Cylinders3D(
                lengths=[length],
                radii=[radius],
                centers=[(0, 0, z)],
                colors=[LINE_COLORS[i - 1]],
                fill_mode="solid",
            )
            log.static(f"{link}/joint", drum)
    rail = rr.Boxes3D(
        half_sizes=[(0.018, 0.055, 0.016)],
        centers=[(0, 0, 0.116)],
        colors=[FINGER_COLOR],
        fill_mode="solid",
    )
    log.static(f"{root}/link_6/rail", rail)
    for name, sign in zip(ROBOT.fingers, (1.0, -1.0), strict=True):
        behind = sign * (PAD_THICKNESS_M + FINGER_THICKNESS_M / 2)
        for part, thickness, y, color in (
            ("body", FINGER_THICKNESS_M, behind, FINGER_COLOR),
            ("pad", PAD_THICKNESS_M, sign * PAD_THICKNESS_M / 2, None),
        ):
            half = (ROBOT.pad.width_m / 2, thickness / 2, ROBOT.pad.length_m / 2)
            box = rr.Boxes3D(
                half_sizes=[half], centers=[(0, y, 0)], colors=color, fill_mode="solid"
            )
            log.static(f"{root}/finger_{name}/{part}", box)


def _capsule(
    end: np.ndarray, radius_m: float, color: tuple[int, int, int]
) -> rr.Capsules3D:
    """From the link's origin to ``end``."""
    turn = Rotation.align_vectors([end], [(0.0, 0.0, 1.0)])[0]
    return rr.Capsules3D(
        lengths=[np.linalg.norm(end)],
        radii=[radius_m],
        quaternions=[rr.Quaternion(xyzw=turn.as_quat())],
        colors=[color],
        fill_mode="solid",
    )

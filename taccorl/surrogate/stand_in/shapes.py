"""The stand-in's arms and parts as boxes and capsules, and their outlines as a camera sees them. Colours are BGR."""

from dataclasses import dataclass

import numpy as np

from taccorl.surrogate.stand_in.kinematics import ARMS
from taccorl.surrogate.stand_in.story import STAND_HEIGHT_M

# N pictures, B boxes, K capsules, P polygons, C corners

_WHITE, _DARK, _STEEL, _PAD = (236, 236, 232), (62, 60, 58), (150, 148, 146), (40, 140, 226)
_RACK, _TUBE, _CAP, _STAND = (178, 122, 62), (214, 206, 150), (52, 56, 206), (120, 190, 214)
_HOLE = (46.0, 30.0, 18.0)

# Boxes: (frame, centre, half extents, colour), m. finger+ and finger− lie on link 6, moved along its y by the opening.
_ARM_BOXES = (
    ("link6", (0.0, 0.0, 0.092), (0.022, 0.052, 0.026), _DARK),
    ("link6", (-0.105, 0.0, 0.025), (0.012, 0.021, 0.011), _STEEL),  # wrist camera
    ("link6", (-0.058, 0.0, 0.045), (0.045, 0.007, 0.005), _DARK),  # and its bracket
    ("finger+", (0.0, 0.0135, 0.166), (0.013, 0.0065, 0.042), _DARK),
    ("finger-", (0.0, -0.0135, 0.166), (0.013, 0.0065, 0.042), _DARK),
    ("finger+", (0.0, 0.0035, 0.168), (0.012, 0.0035, 0.032), _PAD),
    ("finger-", (0.0, -0.0035, 0.168), (0.012, 0.0035, 0.032), _PAD),
)
_PART_BOXES = (
    # The rack in pieces: painting far to near sorts whole polygons, so none may be long.
    *(("rack", (0.0, y, 0.025), (0.020, 0.025, 0.025), _RACK) for y in (-0.05, 0.0, 0.05)),
    ("stand", (0.0, 0.0, STAND_HEIGHT_M), (0.020, 0.020, STAND_HEIGHT_M), _STAND),
)
# Capsules: (frame, from, to, radius, colour), m
_ARM_CAPSULES = (
    ("link1", (0.0, 0.0, -0.10), (0.0, 0.0, 0.0), 0.045, _DARK),
    ("link2", (0.0, 0.0, -0.040), (0.0, 0.0, 0.040), 0.046, _DARK),
    ("link2", (0.0, 0.0, 0.0), (0.285, 0.0, 0.0), 0.037, _WHITE),
    ("link3", (0.0, 0.0, -0.040), (0.0, 0.0, 0.040), 0.042, _DARK),
    ("link3", (0.0, 0.0, 0.0), (-0.021, -0.235, 0.0), 0.033, _WHITE),
    ("link5", (0.0, 0.0, -0.030), (0.0, 0.0, 0.030), 0.032, _DARK),
    ("link5", (0.0, 0.0, 0.0), (0.0, -0.070, 0.0), 0.026, _WHITE),
    ("link6", (0.0, 0.0, 0.0), (0.0, 0.0, 0.055), 0.028, _WHITE),
)
_PART_CAPSULES = (
    ("tube", (0.0, 0.0, 0.009), (0.0, 0.0, 0.034), 0.009, _TUBE),  # the part that goes into the rack
    ("tube", (0.0, 0.0, 0.034), (0.0, 0.0, 0.088), 0.009, _TUBE),
    ("tube", (0.0, 0.0, 0.098), (0.0, 0.0, 0.110), 0.010, _CAP),
)
_BOXES = (*((f"{arm} {frame}", *rest) for arm in ARMS for frame, *rest in _ARM_BOXES), *_PART_BOXES)
_CAPSULES = (*((f"{arm} {frame}", *rest) for arm in ARMS for frame, *rest in _ARM_CAPSULES), *_PART_CAPSULES)
_SHADOW_CASTERS = (
    *_CAPSULES,
    *((f"{arm} {f}", (0.0, 0.0, 0.09), (0.0, 0.0, 0.19), 0.013, _DARK) for arm in ARMS for f in ("finger+", "finger-")),
    ("rack", (0.0, -0.055, 0.025), (0.0, 0.055, 0.025), 0.024, _RACK),
)
_HOLES_Y_M = ((-0.045, -0.05), (-0.005, 0.0))  # hole in the rack, middle of the piece of rack it is in

_CAPSULE_LAYERS = ((1.0, 0.0, 0.62), (0.80, 0.12, 0.88), (0.38, 0.34, 1.06))  # width, shift to the light, brightness
_CUBE_CORNERS = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
_CUBE_FACES = np.array([(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)])
_CUBE_NORMALS = np.array([(-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), (0, 0, -1), (0, 0, 1)], float)
_TO_LIGHT_WORLD = np.array([0.30, 0.35, 0.89])
_NEAREST_M = 0.035  # what has a corner nearer than this is left out


@dataclass(frozen=True)
class View:
    """Poses of a camera in N pictures, and its intrinsics."""

    camera_from_world: np.ndarray  # (N, 4, 4), z forward, x right, y down
    focal_px: float
    rows: int
    columns: int

    def project(self, points_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (N, ..., 2) as (u, v), and depth (N, ...) [m] along the optical axis, of ``points_world`` (N, ..., 3) [m]."""
        flat = points_world.reshape(len(points_world), -1, 3)
        rotation, shift = self.camera_from_world[:, :3, :3], self.camera_from_world[:, None, :3, 3]
        seen = flat @ rotation.transpose(0, 2, 1) + shift
        depth_m = seen[..., 2]
        pixels = self.focal_px * seen[..., :2] / np.maximum(depth_m, 1e-3)[..., None]
        pixels += [self.columns / 2, self.rows / 2]
        return pixels.reshape((*points_world.shape[:-1], 2)), depth_m.reshape(points_world.shape[:-1])

    def on_screen(self, outlines_px: np.ndarray) -> np.ndarray:
        """(...) bool: the outlines ``outlines_px`` (..., C, 2), C corners as (u, v), may overlap the picture."""
        low, high = outlines_px.min(axis=-2), outlines_px.max(axis=-2)
        sane = np.maximum(-low, high).max(axis=-1) < 2e4  # beyond this OpenCV's fixed-point coordinates overflow
        return np.all((high > 0) & (low < [self.columns, self.rows]), axis=-1) & sane

    def pixel_from_table(self, n: int) -> np.ndarray:
        """Homography (3, 3) of picture n: world (x, y, 1) [m] on the table to pixels."""
        lens = np.array([[self.focal_px, 0, self.columns / 2], [0, self.focal_px, self.rows / 2], [0, 0, 1]])
        return lens @ self.camera_from_world[n][:3, [0, 1, 3]]


@dataclass(frozen=True)
class Polygons:
    """Convex polygons in N pictures, P in each."""

    outline_px: np.ndarray  # (N, P, C, 2)
    depth_m: np.ndarray  # (N, P)
    visible: np.ndarray  # (N, P)
    colour_bgr: np.ndarray  # (N, P, 3)


def box_polygons(frames: dict[str, np.ndarray], view: View) -> Polygons:
    """The faces of all boxes that are turned towards the camera.

    Args:
        frames: frame of a link or part → its poses in the world (N, 4, 4) [m].
    """
    pose = np.stack([frames[frame] for frame, *_ in _BOXES], axis=1)
    corners = np.stack([np.array(centre) + _CUBE_CORNERS * half for _, centre, half, _ in _BOXES])
    world = np.einsum("nbij,bkj->nbki", pose[..., :3, :3], corners) + pose[:, :, None, :3, 3]
    pixels, depth_m = view.project(world)
    face_px, face_m = pixels[:, :, _CUBE_FACES], depth_m[:, :, _CUBE_FACES]  # (N, B, 6, 4, 2), (N, B, 6, 4)
    normals = np.einsum("nbij,fj->nbfi", pose[..., :3, :3], _CUBE_NORMALS)
    eye_world = np.linalg.inv(view.camera_from_world)[:, None, None, :3, 3]
    towards_us = np.sum((eye_world - world[:, :, _CUBE_FACES[:, 0]]) * normals, axis=-1) > 0
    brightness = 0.72 + 0.36 * (normals @ _TO_LIGHT_WORLD)
    colour = np.array([colour for *_, colour in _BOXES], float)[:, None] * brightness[..., None]
    n = len(pose)
    return Polygons(
        face_px.reshape(n, -1, 4, 2),
        face_m.mean(axis=-1).reshape(n, -1),
        (towards_us & (face_m.min(axis=-1) > _NEAREST_M)).reshape(n, -1),
        colour.reshape(n, -1, 3),
    )


def capsule_polygons(frames: dict[str, np.ndarray], view: View, hidden_arm: str | None) -> Polygons:
    """Polygons of all capsules, three outlines each from dark to light; without a wrist camera's own arm, ``hidden_arm``.

    Args:
        frames: frame of a link or part → its poses in the world (N, 4, 4) [m].
        hidden_arm: name of the arm whose capsules are left out; None: none.
    """
    capsules = [c for c in _CAPSULES if not (hidden_arm and c[0].startswith(hidden_arm))]
    ends, radius_m = _capsule_ends(frames, capsules)
    pixels, depth_m = view.project(ends)  # (N, K, 2, 2), (N, K, 2)
    radius_px = view.focal_px * radius_m[:, None] / np.maximum(depth_m, _NEAREST_M)
    across = _left_normal(pixels[:, :, 1] - pixels[:, :, 0])
    light_px = view.camera_from_world[:, :2, :3] @ _TO_LIGHT_WORLD
    to_light = np.sign(np.einsum("nki,ni->nk", across, light_px))[..., None] * across
    outlines = [
        _stadium(pixels + shift * radius_px[..., None] * to_light[:, :, None], width * radius_px)
        for width, shift, _ in _CAPSULE_LAYERS
    ]
    colour = np.array([colour for *_, colour in capsules], float)
    n, layers = len(pixels), len(_CAPSULE_LAYERS)
    depth = np.concatenate([depth_m.mean(axis=-1) - 1e-4 * layer for layer in range(layers)], axis=1)
    return Polygons(
        np.concatenate(outlines, axis=1),
        depth,
        np.tile(depth_m.min(axis=-1) > 2 * _NEAREST_M, (1, layers)),
        np.tile(np.concatenate([brightness * colour for *_, brightness in _CAPSULE_LAYERS]), (n, 1, 1)),
    )


def hole_polygons(frames: dict[str, np.ndarray], view: View) -> Polygons:
    """Polygons of the holes in the rack's upper face, painted right after the piece of the rack that contains them.

    Args:
        frames: as ``box_polygons``; of them ``rack``, (N, 4, 4), is used.
    """
    angle = np.linspace(0, 2 * np.pi, 14, endpoint=False)
    ring = 0.012 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    points = np.stack([np.vstack([ring + np.array([0.0, y, 0.05]), [0.0, piece, 0.05]]) for y, piece in _HOLES_Y_M])
    pose = frames["rack"]
    pixels, depth_m = view.project(np.einsum("nij,hkj->nhki", pose[:, :3, :3], points) + pose[:, None, None, :3, 3])
    depth = depth_m[..., -1]
    return Polygons(pixels[:, :, :-1], depth - 0.001, depth > _NEAREST_M, np.tile(_HOLE, (*depth.shape, 1)))


def shadow_outlines_px(frames: dict[str, np.ndarray], view: View) -> list[np.ndarray]:
    """Outlines (S, C, 2) [pixels] of all S shadows on the table, one array for each of the N pictures.

    Args:
        frames: frame of a link or part → its poses in the world (N, 4, 4) [m].
    """
    ends, radius_m = _capsule_ends(frames, list(_SHADOW_CASTERS))
    ground = ends[..., :2] - ends[..., 2:] * _TO_LIGHT_WORLD[:2] / _TO_LIGHT_WORLD[2]
    outline = _stadium(ground, np.broadcast_to(radius_m[:, None], ground.shape[:-1]))
    pixels, depth_m = view.project(np.pad(outline, ((0, 0), (0, 0), (0, 0), (0, 1))))
    visible = view.on_screen(pixels) & (depth_m.min(axis=-1) > _NEAREST_M)
    return [pixels[n, visible[n]] for n in range(len(pixels))]


def _capsule_ends(frames: dict[str, np.ndarray], capsules: list[tuple]) -> tuple[np.ndarray, np.ndarray]:
    """World end points (N, K, 2, 3) and radii (K,)."""
    pose = np.stack([frames[frame] for frame, *_ in capsules], axis=1)
    ends = np.array([[start, end] for _, start, end, *_ in capsules], float)
    world = np.einsum("nkij,kej->nkei", pose[..., :3, :3], ends) + pose[:, :, None, :3, 3]
    return world, np.array([radius for *_, radius, _ in capsules])


def _left_normal(direction: np.ndarray) -> np.ndarray:
    length = np.maximum(np.linalg.norm(direction, axis=-1, keepdims=True), 1e-6)
    return np.stack([-direction[..., 1], direction[..., 0]], axis=-1) / length


def _stadium(ends: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """Outlines (N, K, 14, 2) around two ends (N, K, 2, 2) with radii (N, K, 2)."""
    across = _left_normal(ends[:, :, 1] - ends[:, :, 0])
    along = np.stack([across[..., 1], -across[..., 0]], axis=-1)
    angle = np.linspace(-np.pi / 2, np.pi / 2, 7)
    arc = np.cos(angle)[:, None] * along[:, :, None] + np.sin(angle)[:, None] * across[:, :, None]  # (N, K, 7, 2)
    return np.concatenate(
        [ends[:, :, 1:] + radii[:, :, 1, None, None] * arc, ends[:, :, :1] - radii[:, :, 0, None, None] * arc], axis=2
    )

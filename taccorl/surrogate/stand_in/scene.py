"""Pictures of the stand-in: arms, rack and tube on a cutting mat, painted far to near as shaded polygons with OpenCV."""

from collections.abc import Iterator

import cv2
import numpy as np

from taccorl.robots import ROBOT
from taccorl.surrogate.stand_in.backdrop import SHADE, front_backdrop, sensor_noise, table_from_texel, table_texture
from taccorl.surrogate.stand_in.frame_id import draw_frame_id
from taccorl.surrogate.stand_in.kinematics import ARMS, link_poses
from taccorl.surrogate.stand_in.shapes import (
    Polygons,
    View,
    box_polygons,
    capsule_polygons,
    hole_polygons,
    shadow_outlines_px,
)
from taccorl.surrogate.stand_in.story import Story

CAMERAS = ROBOT.cameras
"""Names of the cameras."""

# Camera and the point it looks at [m], vertical field of view [deg]
_FRONT_SIGHT = ((1.12, 0.0, 0.66), (0.25, 0.0, 0.21), 49.0)  # world frame
_WRIST_SIGHT = ((-0.105, 0.0, 0.040), (-0.012, 0.0, 0.190), 58.0)  # link-6 frame; fov of RealSense D405
_FLOOR_BGR = (88, 92, 96)
_SUBPIXEL_BITS = 4


class Scene:
    """Draws the pictures of each camera from the true signals of a recording (``Story``)."""

    def __init__(self, story: Story, camera_size: tuple[int, int], seed: int) -> None:
        self.story = story
        self.rows, self.columns = camera_size
        self._rng = {camera: np.random.default_rng([seed, 3, c]) for c, camera in enumerate(CAMERAS)}
        view = self._view("front", {}, 1)
        self._backdrop = front_backdrop(
            self.rows, self.columns, view.pixel_from_table(0), lambda points: view.project(points[None])[0][0]
        )
        self._backdrop_in_shade = cv2.convertScaleAbs(self._backdrop, alpha=SHADE)

    def pictures_bgr(self, camera: str, time_s: np.ndarray, frame_ids: np.ndarray) -> Iterator[np.ndarray]:
        """Iterate over pictures of ``camera``, one uint8 (rows, columns, 3) in BGR for each of the times ``time_s`` (N,) [s]. The
        noise depends on the number of pictures drawn before.

        Args:
            frame_ids: (N,) frame ids that are drawn into the pictures.
        """
        if len(time_s) == 0:
            return
        frames = self._frames(time_s)
        view = self._view(camera, frames, len(time_s))
        own_arm = None if camera == "front" else camera.split("_")[0]
        layers = (
            box_polygons(frames, view),
            capsule_polygons(frames, view, hidden_arm=own_arm),
            hole_polygons(frames, view),
        )
        drawn = tuple(layer.visible & view.on_screen(layer.outline_px) for layer in layers)
        shadows = shadow_outlines_px(frames, view)
        for n, frame_id in enumerate(frame_ids):
            picture = self._table_and_shadows(camera, view, n, shadows[n])
            _paint(picture, layers, drawn, n)
            self._add_noise(camera, picture)
            draw_frame_id(picture, int(frame_id))
            yield picture

    def _frames(self, time_s: np.ndarray) -> dict[str, np.ndarray]:
        """World poses (N, 4, 4) of everything that boxes, capsules and cameras are fixed to."""
        frames: dict[str, np.ndarray] = {}
        state = self.story.state(time_s)
        for arm in ARMS:
            links = link_poses(arm, state[:, ROBOT.joint_slice(arm)])
            for i, link in enumerate(ROBOT.links):
                frames[f"{arm} {link.name}"] = links[:, i]
            for side, finger in ((0.5, "finger+"), (-0.5, "finger-")):
                pose = links[:, -1].copy()
                pose[:, :3, 3] += side * state[:, ROBOT.gripper_index(arm), None] * pose[:, :3, 1]
                frames[f"{arm} {finger}"] = pose
        left, right = (frames[f"{arm} {ROBOT.hand}"] for arm in ARMS)
        parts = [self.story.part_poses(float(t), left[n], right[n]) for n, t in enumerate(time_s)]
        return frames | {name: np.stack([poses[name] for poses in parts]) for name in parts[0]}

    def _view(self, camera: str, frames: dict[str, np.ndarray], count: int) -> View:
        position, target, fovy_deg = _FRONT_SIGHT if camera == "front" else _WRIST_SIGHT
        up = np.array([0.0, 0.0, 1.0] if camera == "front" else [-1.0, 0.0, 0.0])
        forward = np.subtract(target, position)
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, up)
        right /= np.linalg.norm(right)
        base_from_camera = np.eye(4)
        base_from_camera[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
        base_from_camera[:3, 3] = position
        if camera == "front":
            world_from_camera = np.tile(base_from_camera, (count, 1, 1))
        else:
            world_from_camera = frames[f"{camera.split('_')[0]} {ROBOT.hand}"] @ base_from_camera
        focal_px = 0.5 * self.rows / np.tan(np.radians(fovy_deg / 2))
        return View(np.linalg.inv(world_from_camera), focal_px, self.rows, self.columns)

    def _table_and_shadows(self, camera: str, view: View, n: int, shadows_px: np.ndarray) -> np.ndarray:
        if camera == "front":
            picture, in_shade = self._backdrop.copy(), self._backdrop_in_shade
        else:
            warp, size = view.pixel_from_table(n) @ table_from_texel(self.rows), (self.columns, self.rows)
            picture = cv2.warpPerspective(table_texture(self.rows), warp, size, borderValue=_FLOOR_BGR)
            in_shade = cv2.convertScaleAbs(picture, alpha=SHADE)
        mask = np.zeros(picture.shape[:2], np.uint8)
        for outline in _fixed_point(shadows_px):
            cv2.fillConvexPoly(mask, outline, 255, shift=_SUBPIXEL_BITS)
        return cv2.copyTo(in_shade, mask, picture)

    def _add_noise(self, camera: str, picture: np.ndarray) -> None:
        """New in every picture, so that only a frozen camera repeats itself."""
        y, x = self._rng[camera].integers(0, 32, 2)
        cv2.add(picture, sensor_noise(self.rows, self.columns)[y : y + self.rows, x : x + self.columns], dst=picture)


def _paint(picture: np.ndarray, layers: tuple[Polygons, ...], drawn: tuple[np.ndarray, ...], n: int) -> None:
    """Picture n's polygons, those of ``drawn`` (N, P) of each layer, the farthest first."""
    chosen = []
    for polygons, seen in zip(layers, drawn, strict=True):
        p = np.flatnonzero(seen[n])
        outlines, colours = _fixed_point(polygons.outline_px[n, p]), np.minimum(polygons.colour_bgr[n, p], 255).tolist()
        chosen += zip(polygons.depth_m[n, p].tolist(), outlines, colours, strict=True)
    for _, outline, colour in sorted(chosen, key=lambda polygon: -polygon[0]):
        cv2.fillConvexPoly(picture, outline, colour, cv2.LINE_AA, _SUBPIXEL_BITS)


def _fixed_point(pixels: np.ndarray) -> np.ndarray:
    return np.round(pixels * (1 << _SUBPIXEL_BITS)).astype(np.int32)

"""Render one camera of the twin with the arms at given joint angles, for comparison with a picture.

Frames: *mount* is the body to which the camera is fixed (``CameraConfig.body``: the world, or link 6 of an arm), *camera* is
MuJoCo's (x right, y up, looking along −z). A pose is a vector (6,) = (ω, t) [rad, m] relative to the nominal mount, as
``CameraOffset``: R = R₀·exp(ω), p = p₀ + R₀·t. Pixels as in ``taccorl.sim.cameras``. The scene has arms and table only, because
joint angles do not determine the poses of parts.
"""

import dataclasses

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from taccorl.errors import TaccorlError, nearest
from taccorl.robots import ROBOT
from taccorl.sim.cameras import (
    CameraConfig,
    CameraOffset,
    Window,
    add_cameras,
    letterbox_window,
    offset_pose,
)
from taccorl.sim.effects.added import AddedEffects, present
from taccorl.sim.rendering import Renderer, style
from taccorl.sim.twin import TwinConfig, empty_bench


class TwinView:
    """The twin's camera ``name`` in pictures of ``size`` (rows, columns), which may be letterboxed as ingest does it.

    Call ``close`` at the end, or use it in a ``with`` statement. Raises TaccorlError: the twin has no such camera."""

    def __init__(self, config: TwinConfig, name: str, size: tuple[int, int]) -> None:
        cameras = {camera.name: camera for camera in config.cameras}
        if name not in cameras:
            raise TaccorlError(
                f"camera {name!r} is not in the twin; {nearest(name, cameras)}"
            )
        self.camera: CameraConfig = cameras[name]
        self.size = size
        self.window: Window = letterbox_window(self.camera.recording_size, size)
        self.intrinsics = self.camera.recorded_intrinsics().scaled(
            self.window.rows, self.window.columns
        )
        """Intrinsics of the picture without its black bars."""
        spec = empty_bench(config)
        add_cameras(spec, [self.camera])
        style(spec)
        for effect in present(config.effects):
            if effect.slot == "camera" and name in effect.acts_on():
                here = dataclasses.replace(
                    effect, cameras=[name]
                )  # it may act on cameras that this scene lacks
                here.edit(spec, dataclasses.replace(config, cameras=[self.camera]))
        self.model = spec.compile()
        self.model.cam_resolution[0] = (
            1  # not said: the view fills its frame, there are no bars
        )
        self.data = mujoco.MjData(self.model)
        self._encoder = AddedEffects(
            config.effects, self.data.time * np.ones(1)
        ).encoder
        self._joints = [
            self._qpos(f"{arm}_{joint}") for arm in ROBOT.arms for joint in ROBOT.joints
        ]
        self._fingers = [
            [self._qpos(f"{arm}_finger_{finger}") for finger in ROBOT.fingers]
            for arm in ROBOT.arms
        ]
        bare = dataclasses.replace(self.camera, offset=CameraOffset())
        self._nominal = bare.pose()
        turn = Rotation.from_quat(self.model.cam_quat[0], scalar_first=True).as_matrix()
        self.start = self.offset_of(self.model.cam_pos[0].copy(), turn)
        """(6,) camera pose in the twin: its offset, and the change by effects."""
        self.robot = np.array(
            [
                self.model.body(i).name.startswith(ROBOT.arms)
                for i in range(self.model.nbody)
            ]
        )
        """(bodies,) bool: the body belongs to an arm."""
        self._renderers: dict[tuple[int, int], Renderer] = {}

    def pose(self, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Position (3,) [m] and rotation mount-from-camera (3, 3) of the pose ``offset`` (6,) [rad, m]."""
        position, quat = offset_pose(*self._nominal, as_offset(offset))
        return position, Rotation.from_quat(quat, scalar_first=True).as_matrix()

    def offset_of(self, position: np.ndarray, turn: np.ndarray) -> np.ndarray:
        """Pose (6,) of a camera at ``position`` (3,) [m] with the rotation mount-from-camera ``turn`` (3, 3)."""
        nominal = Rotation.from_quat(self._nominal[1], scalar_first=True).inv()
        turned = (nominal * Rotation.from_matrix(turn)).as_rotvec()
        return np.r_[turned, nominal.apply(position - self._nominal[0])]

    def place(self, joints: np.ndarray) -> None:
        """Place arms and fingers for reported ``joints`` (14,) [rad, m], with the effects of encoders removed."""
        joints = joints - (self._encoder(joints[None])[0] - joints)
        self.data.qpos[self._joints] = joints[ROBOT.joint_indices]
        self.data.qpos[self._fingers] = joints[ROBOT.gripper_indices, None] / 2
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)

    def labels(
        self, joints: np.ndarray, offset: np.ndarray, rows: int, columns: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Body and depth of each pixel of a rendered picture. ``joints``: (14,) joint angles and gripper openings [rad, m].
        ``offset``: (6,) camera pose [rad, m]. Returns (rows, columns) int, index of the body that the pixel shows, 0 if it shows
        no arm; and (rows, columns), depth along the optical axis [m], infinite where nothing is shown."""
        self._turn(joints, offset)
        geoms, depth_m = self._renderer(rows, columns).labels(self.data)[0]
        bodies = np.where(geoms >= 0, self.model.geom_bodyid[geoms], 0)
        return np.where(self.robot[bodies], bodies, 0), depth_m

    def picture(self, joints: np.ndarray, offset: np.ndarray) -> np.ndarray:
        """Picture without bars, (rows, columns, 3) uint8 RGB, with the arms at ``joints`` (14,) [rad, m], the camera at
        ``offset`` (6,)."""
        self._turn(joints, offset)
        return self._renderer(self.window.rows, self.window.columns).render(
            [self.data]
        )[0, 0]

    def inside(self, pictures: np.ndarray) -> np.ndarray:
        """The pictures (F, rows, columns, 3) without their black bars. Raises TaccorlError: the pictures have another size, or
        the bars are not black."""
        if pictures.shape[1:] != (*self.size, 3) or pictures.dtype != np.uint8:
            raise TaccorlError(
                f"camera {self.camera.name}: pictures are {pictures.dtype} {pictures.shape[1:]}, expected uint8 "
                f"({self.size[0]}, {self.size[1]}, 3)"
            )
        w = self.window
        cut = np.s_[:, w.top : w.top + w.rows, w.left : w.left + w.columns]
        bars = np.ones(self.size, dtype=bool)
        bars[cut[1:]] = False
        # Video blurs over the edge of a bar by a pixel or two.
        bars = (
            bars
            & np.roll(bars, 2, 0)
            & np.roll(bars, -2, 0)
            & np.roll(bars, 2, 1)
            & np.roll(bars, -2, 1)
        )
        # JPEG and video leave black bars as dark as 24.
        if bars.any() and np.percentile(pictures[:, bars], 95) > 24:
            stream = self.camera.recording_size
            raise TaccorlError(
                f"camera {self.camera.name}: pictures of {self.size[0]}×{self.size[1]} are not pictures of a "
                f"{stream[0]}×{stream[1]} stream with black bars: pixels where the bars should be are not black. Set the "
                "camera's recording_size in the twin to what the robot records (rows, columns), with the intrinsics of that "
                "stream"
            )
        return pictures[cut]

    def close(self) -> None:
        """Free OpenGL contexts."""
        for renderer in self._renderers.values():
            renderer.close()
        self._renderers.clear()

    def __enter__(self) -> "TwinView":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _turn(self, joints: np.ndarray, offset: np.ndarray) -> None:
        self.model.cam_pos[0], self.model.cam_quat[0] = offset_pose(
            *self._nominal, as_offset(offset)
        )
        self.place(joints)
        mujoco.mj_camlight(self.model, self.data)

    def _qpos(self, joint: str) -> int:
        return int(self.model.joint(joint).qposadr[0])

    def _renderer(self, rows: int, columns: int) -> Renderer:
        if (rows, columns) not in self._renderers:
            self._renderers[rows, columns] = Renderer(
                self.model, [self.camera.name], rows, columns
            )
        return self._renderers[rows, columns]


def as_offset(offset: np.ndarray) -> CameraOffset:
    """The pose ``offset`` (6,) = (ω, t) [rad, m] as the ``CameraOffset`` of a ``CameraConfig``."""
    return CameraOffset(
        rotation_rad=tuple(offset[:3].tolist()),
        translation_m=tuple(offset[3:].tolist()),
    )

"""The bench's RealSense cameras: intrinsics before and after ingest's letterbox, and mounts in the model.

Pixels: (0, 0) is the centre of the top left pixel, u to the right, v down, as OpenCV and librealsense count.
Camera frame: MuJoCo's, x right, y up, looking along −z. (The optical frame of ROS is the same one turned by 180° about x.)
"""

import dataclasses
import math
from collections.abc import Iterable
from dataclasses import dataclass, field

import mujoco
import numpy as np

from taccorl.errors import TaccorlError, nearest
from taccorl.robots import ROBOT

MOST_PX = 8192
"""Most rows and columns of a picture."""


@dataclass(frozen=True, kw_only=True)
class Window:
    """Area of a picture within its letterboxed frame [pixels]; black bars are all around it."""

    top: int
    """Rows above the area."""
    left: int
    """Columns left of the area."""
    rows: int
    columns: int


def letterbox_window(recorded: tuple[int, int], frame: tuple[int, int]) -> Window:
    """The part of ``frame`` (rows, columns) that a picture of ``recorded`` (rows, columns) fills after ingest.

    It uses the arithmetic of ``taccorl.data.pictures.letterbox``; a test compares both."""
    factor = min(frame[0] / recorded[0], frame[1] / recorded[1])
    rows, columns = (
        max(1, round(recorded[0] * factor)),
        max(1, round(recorded[1] * factor)),
    )
    return Window(
        top=(frame[0] - rows) // 2,
        left=(frame[1] - columns) // 2,
        rows=rows,
        columns=columns,
    )


@dataclass(frozen=True, kw_only=True)
class Intrinsics:
    """Pinhole camera: u = fx·x/depth + cx, v = fy·y_down/depth + cy, for pictures of ``rows`` × ``columns``. No distortion."""

    rows: int
    columns: int
    fx_px: float  # Focal length along the columns [pixels]
    fy_px: float  # Focal length along the rows [pixels]
    cx_px: float  # Column of the principal point; 0 is the centre of the leftmost pixel
    cy_px: float  # Row of the principal point; 0 is the centre of the topmost pixel

    def scaled(self, rows: int, columns: int) -> "Intrinsics":
        """Intrinsics of the same view in a picture of ``rows`` × ``columns`` pixels: a pixel centre c moves to (c + ½)·s − ½, as
        in OpenCV's resize."""
        down, right = rows / self.rows, columns / self.columns
        return Intrinsics(
            rows=rows,
            columns=columns,
            fx_px=self.fx_px * right,
            fy_px=self.fy_px * down,
            cx_px=(self.cx_px + 0.5) * right - 0.5,
            cy_px=(self.cy_px + 0.5) * down - 0.5,
        )

    @property
    def vertical_fov_rad(self) -> float:
        """Angle between the top and the bottom edge, for a centred principal point [rad]."""
        return 2 * math.atan(self.rows / 2 / self.fy_px)


@dataclass(frozen=True, kw_only=True)
class ColorSensor:
    """The imager behind a RealSense's colour stream. Its pixels are square, its principal point is nominally central."""

    rows: int
    columns: int
    fov_rows: int
    """Number of the imager's rows that the published vertical field of view spans."""
    vertical_fov_deg: float
    """Published vertical field of view [°]."""

    @property
    def focal_px(self) -> float:
        """Focal length in the imager's own pixels."""
        return self.fov_rows / 2 / math.tan(math.radians(self.vertical_fov_deg) / 2)


COLOR_SENSORS = {
    # Datasheet 337029: RGB sensor 1920 × 1080, 69.4° × 42.5° (± 3°). Square pixels make that 69.3° × 42.5°, and the SDK
    # reports 69.30° × 42.47° of one unit (librealsense issue 4179).
    "d415": ColorSensor(rows=1080, columns=1920, fov_rows=1080, vertical_fov_deg=42.5),
    # The colour of a D405 comes from its left stereo imager, 1280 × 800 pixels of 3 µm: 58° over 720 rows (Intel's chart:
    # 84° × 58° depth, 87° × 58° colour, librealsense issue 11427; only 58° is in both). f = 649 px; factory values of
    # units that were published lie between 641 and 655.
    "d405": ColorSensor(rows=800, columns=1280, fov_rows=720, vertical_fov_deg=58.0),
}
"""Model of a RealSense → its colour imager."""


def sensor_intrinsics(model: str, rows: int, columns: int) -> Intrinsics:
    """Nominal colour intrinsics of a RealSense ``model`` ("d415" or "d405") streaming ``rows`` × ``columns``.

    The camera takes the largest centred window of the stream's aspect from its imager and scales it down: 640 × 480 is 1440
    × 1080 of a D415's 1920 × 1080 (54.8° × 42.5°; librealsense issue 7170 measured 55°) and 1067 × 800 of a D405's 1280 ×
    800 (78.8° × 63.3°). Units differ by up to 3°: give the camera_info of your own where you have it. Raises TaccorlError:
    no such model."""
    if model not in COLOR_SENSORS:
        raise TaccorlError(
            f"camera model {model!r}: no intrinsics; {nearest(model, COLOR_SENSORS)}"
        )
    sensor = COLOR_SENSORS[model]
    focal = sensor.focal_px * max(rows / sensor.rows, columns / sensor.columns)
    return Intrinsics(
        rows=rows,
        columns=columns,
        fx_px=focal,
        fy_px=focal,
        cx_px=(columns - 1) / 2,
        cy_px=(rows - 1) / 2,
    )


@dataclass(frozen=True, kw_only=True)
class CameraOffset:
    """Small error of a camera mount, found by calibration, or hidden in a surrogate robot.

    In the nominal camera's own frame: R = R₀·exp(ω), p = p₀ + R₀·t. With all zero the pose is the nominal one."""

    rotation_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """ω, rotation vector about the camera's x (right), y (up), z (back)."""
    translation_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """t, translation along the same axes [m]."""


@dataclass(frozen=True, kw_only=True)
class CameraConfig:
    """Settings of one colour camera: mount, model, recorded size and intrinsics."""

    name: str
    """Name of the camera; its dataset feature is ``observation.images.<name>``."""
    body: str = "world"
    """MuJoCo body to which the camera is fixed."""
    position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Optical centre of the colour imager in the body's frame [m]."""
    look_at_m: tuple[float, float, float] | None = None
    """Point in the body's frame [m] that the camera's optical axis passes through. Exactly one of ``look_at_m`` and
    ``quat_wxyz`` is given."""
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Direction in the body's frame that points up in the picture; used with ``look_at_m`` only."""
    quat_wxyz: tuple[float, float, float, float] | None = None
    """Orientation of the camera frame in the body's frame, as an alternative to ``look_at_m``."""
    model: str = "d415"
    """RealSense model: "d415" or "d405"."""
    recording_size: tuple[int, int] = (480, 640)
    """Rows and columns of the stream that the robot records; datasets hold it letterboxed."""
    intrinsics: Intrinsics | None = None
    """Measured intrinsics of the stream (its camera_info); None: the nominal ones of ``model``."""
    offset: CameraOffset = field(default_factory=CameraOffset)
    """Error of the mount; zero by default."""

    def __post_init__(self) -> None:
        if (self.look_at_m is None) == (self.quat_wxyz is None):
            raise TaccorlError(
                f"camera {self.name}: give either look_at_m or quat_wxyz, exactly one of them"
            )
        if not all(0 < n <= MOST_PX for n in self.recording_size):
            raise TaccorlError(
                f"camera {self.name}: recording_size {self.recording_size}: from 1 to {MOST_PX}"
            )
        if self.intrinsics and (self.intrinsics.rows, self.intrinsics.columns) != tuple(
            self.recording_size
        ):
            size = f"{self.intrinsics.rows}×{self.intrinsics.columns}"
            raise TaccorlError(
                f"camera {self.name}: intrinsics of {size} pictures, not {self.recording_size}"
            )

    def recorded_intrinsics(self) -> Intrinsics:
        """Intrinsics of the stream as recorded, before the letterbox."""
        return self.intrinsics or sensor_intrinsics(self.model, *self.recording_size)

    def pose(self) -> tuple[np.ndarray, np.ndarray]:
        """Return position (3,) [m] and quaternion wxyz (4,) of the camera frame in the body's, offset included."""
        position = np.array(self.position_m, float)
        if self.quat_wxyz is not None:
            quat = np.array(self.quat_wxyz, float)
        else:
            quat = look_at_quat(
                position, np.array(self.look_at_m, float), np.array(self.up, float)
            )
        return offset_pose(position, quat, self.offset)


def bench_cameras() -> tuple[CameraConfig, ...]:
    """The robot's cameras at their nominal mounts, in the order of ``ROBOT.camera_mounts``."""
    return tuple(
        CameraConfig(**dataclasses.asdict(mount)) for mount in ROBOT.camera_mounts
    )


def look_at_quat(
    position_m: np.ndarray, target_m: np.ndarray, up: np.ndarray
) -> np.ndarray:
    """Quaternion wxyz (4,) of a camera at ``position_m`` (3,) with ``target_m`` (3,) in the middle of its picture and ``up``
    (3,) pointing up in it; all in one frame. Raises TaccorlError: the target is the position, or lies straight along ``up``."""
    back = np.asarray(position_m, float) - target_m
    right = np.cross(up, back)
    if np.linalg.norm(right) < 1e-9 * max(1.0, float(np.linalg.norm(back))):
        raise TaccorlError(
            f"camera: from {position_m} to {target_m} is parallel to up = {up}: give another `up`"
        )
    back, right = back / np.linalg.norm(back), right / np.linalg.norm(right)
    quat = np.empty(4)
    mujoco.mju_mat2Quat(
        quat, np.stack([right, np.cross(back, right), back], axis=1).ravel()
    )
    return quat


def offset_pose(
    position_m: np.ndarray, quat_wxyz: np.ndarray, offset: CameraOffset
) -> tuple[np.ndarray, np.ndarray]:
    """Move a camera pose by ``offset`` in its own frame: R = R₀·exp(ω), p = p₀ + R₀·t. Bit-identical at zero.

    Takes and returns position ``position_m`` (3,) and quaternion ``quat_wxyz`` (4,) of the camera frame, both in the body's
    frame."""
    vector = np.array(offset.rotation_rad, float)
    angle = float(np.linalg.norm(vector))
    turn, moved, shift = np.empty(4), np.empty(4), np.empty(3)
    mujoco.mju_axisAngle2Quat(
        turn, vector / angle if angle else np.array([1.0, 0.0, 0.0]), angle
    )
    mujoco.mju_mulQuat(moved, quat_wxyz, turn)
    mujoco.mju_rotVecQuat(shift, np.array(offset.translation_m, float), quat_wxyz)
    return position_m + shift, moved


def add_cameras(spec: mujoco.MjSpec, cameras: Iterable[CameraConfig]) -> None:
    """Put ``cameras`` on their bodies. The model remembers the recorded size, so that a renderer can letterbox. Raises
    TaccorlError: the body does not exist, or the model already has a camera of that name."""
    for config in cameras:
        body = spec.worldbody if config.body == "world" else spec.body(config.body)
        if body is None:
            known = [b.name for b in spec.bodies]
            raise TaccorlError(
                f"camera {config.name}: no body {config.body!r}; {nearest(config.body, known)}"
            )
        if spec.camera(config.name) is not None:
            raise TaccorlError(
                f"camera {config.name}: the model has a camera of that name already"
            )
        rows, columns = config.recording_size
        position, quat = config.pose()
        camera = body.add_camera(
            name=config.name, pos=position, quat=quat, resolution=[columns, rows]
        )
        camera.fovy = math.degrees(config.recorded_intrinsics().vertical_fov_rad)
        if config.intrinsics is not None:
            _draw_measured(camera, config.intrinsics)


def _draw_measured(camera: mujoco.MjsCamera, measured: Intrinsics) -> None:
    """Draw fx ≠ fy and a principal point off the centre. MuJoCo's interactive viewer stretches such a camera to its window,
    which is why nominal ones go by their angle alone."""
    camera.sensor_size = [
        measured.columns * 1e-6,
        measured.rows * 1e-6,
    ]  # only its ratio to focal_pixel counts
    camera.focal_pixel = [measured.fx_px, measured.fy_px]
    # Found by rendering: MuJoCo 4.0 moves the picture against this offset, both across and down.
    camera.principal_pixel = [
        (measured.columns - 1) / 2 - measured.cx_px,
        (measured.rows - 1) / 2 - measured.cy_px,
    ]


def project(
    points_world: np.ndarray,
    position_world: np.ndarray,
    world_from_camera: np.ndarray,
    intrinsics: Intrinsics,
) -> np.ndarray:
    """Project ``points_world`` (…, 3) [m] to pixels (…, 2) as (u, v) = (column, row); NaN for points behind the camera.

    ``position_world`` (3,) and ``world_from_camera`` (3, 3) are ``data.cam_xpos`` and ``data.cam_xmat`` of the camera."""
    x, y, z = np.moveaxis((points_world - position_world) @ world_from_camera, -1, 0)
    depth = np.where(z < 0, -z, np.nan)
    u = intrinsics.fx_px * x / depth + intrinsics.cx_px
    v = intrinsics.fy_px * -y / depth + intrinsics.cy_px
    return np.stack([u, v], axis=-1)

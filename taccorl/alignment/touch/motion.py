"""Depth of each taxel in a known object during a measurement, from geometry alone without dynamics (paper App. B.2).

The measured opening gives the poses of the fingers, and the pose of the object is known, so that a taxel's depth δ and its rate
δ̇ follow at the instants at which the board scanned it. Where the object is thicker than the opening, the pads were pressed in
by the difference: a sprung pad of the twin yields by the same amount, so that its taxels have the same depth
(``taccorl.sim.pad``).

An object is fixed to the hand (``tcp``: a jig on the gripper, or a part that stays in its grasp) or to the bench (``world``);
then the arm's measured joints are used as well, and an error of 0.2 mrad makes 0.1 mm.

Letters in shapes: T frames, P pads, R × C taxels, I instants of a scan, S rows of the measurement.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import savgol_filter

from taccorl.alignment.measurements.measurement import Measurement, TouchPad
from taccorl.alignment.measurements.pressed import PressedObject
from taccorl.data.sensor_spec import SensorSpec, load_sensor_spec
from taccorl.data.spec import find_spec
from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.robots.robot_spec import PadLayout
from taccorl.sim.felt_shapes import ShapeTables, shapes_of
from taccorl.sim.robot import RobotConfig, link_poses, mount_pos_world_m
from taccorl.sim.sensors import as_wire
from taccorl.sim.sensors.flexitac import scan_instants_s
from taccorl.sim.shapes import Capsule, Solid, add_geom
from taccorl.sim.touch_kernel import depth_in_body
from taccorl.sim.twin import TwinConfig

_STEP_S = 5e-4  # of central differences of the pads' poses, along splines through the smoothed rows
_NEAR_M = 1e-3  # a pad that never comes so near to the object takes no part


@dataclass(frozen=True, kw_only=True, eq=False)
class TouchMotion:
    """Matched contact replay: poses of the taxels in the object, frame by frame, and the measured counts. Made by
    ``touch_motion``."""

    measurement: Measurement = field(repr=False)  # Measurement from which it was made
    pads: tuple[
        str, ...
    ]  # Names of the pads that the object came near, in the order of ``ROBOT.pads``
    time_s: (
        np.ndarray
    )  # (T, P) time stamps on the measurement's clock: ends of scans [s]
    measured: np.ndarray  # (T, P, R, C) int16 counts above baseline
    baseline: np.ndarray  # (P, R, C) resting counts
    object_from_pad: np.ndarray
    """(T, P, I, 3, 4) pose of each pad in the object's frame at the instants at which the taxels of ``groups`` were read."""
    velocity: (
        np.ndarray
    )  # (T, P, I, 3, 4) time derivative of ``object_from_pad`` [1/s, m/s]
    groups: (
        np.ndarray
    )  # (I, G) flat indices of the taxels that are read at each instant
    shapes: ShapeTables  # Shapes of the object, in its own frame
    clearance_m: np.ndarray
    """(T, P, I) lower bound of the distance from the taxels' plane to the object [m]; below 0 they may overlap."""
    layout: PadLayout  # Arrangement of the taxels of a whole pad; ``window`` states which of them are simulated
    window: tuple[slice, slice] = (slice(None), slice(None))
    """Rows and columns of the pads that are simulated; all of them unless the motion is a ``cut``."""

    @property
    def name(self) -> str:
        """Name of the measurement."""
        return self.measurement.name

    _known: dict[tuple, tuple[np.ndarray, np.ndarray]] = field(
        default_factory=dict, init=False, repr=False
    )

    def depth(
        self, offsets_m: tuple[tuple[float, float, float], ...] = ()
    ) -> tuple[np.ndarray, np.ndarray]:
        """Depth of the object in each taxel [m] and its rate [m/s], (T rows, P pads, R, C taxels) float32, 0 without contact.
        ``offsets_m``: how far each pad's taxels lie from their nominal place, (x, y, z) in the pad's frame [m]; empty: 0."""
        if not any(any(offset) for offset in offsets_m):
            offsets_m = ()
        if offsets_m not in self._known:
            while len(self._known) >= 4:  # what a fit asks for again and again
                del self._known[next(iter(self._known))]
            self._known[offsets_m] = self._depth(offsets_m)
        return self._known[offsets_m]

    def cut(self, frames: np.ndarray, window: tuple[slice, slice]) -> "TouchMotion":
        """Copy with some frames, rows and columns only, to make the repeated simulations of a fit cheaper. ``frames``: (T,) bool,
        frames to keep. ``window``: rows and columns to keep."""
        number = np.arange(self.layout.num_taxels).reshape(self.layout.shape)
        local = np.full(number.size, -1)
        local[number[window].ravel()] = np.arange(number[window].size)
        groups = local[self.groups]
        instants, places = (groups >= 0).any(axis=1), (groups >= 0).any(axis=0)
        groups = groups[np.ix_(instants, places)]
        if (groups < 0).any():
            less = f"taxels {window} do not include all taxels that the board reads at the same instant"
            raise TaccorlError(f"touch motion: {less}")
        arrays = {
            name: np.ascontiguousarray(getattr(self, name)[frames][:, :, instants])
            for name in ("object_from_pad", "velocity", "clearance_m")
        }
        return dataclasses.replace(
            self,
            time_s=self.time_s[frames],
            measured=self.measured[frames][:, :, *window],
            baseline=self.baseline[:, *window],
            groups=groups,
            window=window,
            **arrays,
        )

    def _depth(
        self, offsets_m: tuple[tuple[float, float, float], ...]
    ) -> tuple[np.ndarray, np.ndarray]:
        offset = np.array(offsets_m or [(0.0, 0.0, 0.0)] * len(self.pads))
        taxel_xy = np.stack(np.meshgrid(*self.layout.taxel_axes_m()), axis=2)[
            self.window
        ]
        xyz = np.append(
            taxel_xy.reshape(-1, 2), np.zeros((taxel_xy.size // 2, 1)), axis=1
        )
        # Taxels of a group lie in a line: what is common to them goes into the position, what differs into the grid.
        first = xyz[self.groups[:, 0]]
        along = xyz[self.groups[0]] - first[0]
        grid = np.stack([along[:, 0], along[:, 1], np.ones(len(along))])
        start = np.append(
            first + offset[:, None], np.ones((len(offset), len(first), 1)), axis=2
        )  # (P, I, 4)
        frame, pad, instant = np.nonzero(self.clearance_m < offset[:, None, 2])
        at = start[pad, instant]
        flat = (
            _moved(self.object_from_pad[frame, pad, instant], at),
            _moved(self.velocity[frame, pad, instant], at),
        )
        felt_m, felt_mps = depth_in_body(self.shapes, *flat, grid)
        taxels = np.zeros(
            (2, *self.clearance_m.shape[:2], self.groups.size), np.float32
        )
        where = frame[:, None], pad[:, None], self.groups[instant]
        taxels[0][where], taxels[1][where] = felt_m, felt_mps
        taxels.flags.writeable = False
        depth_m, rate_mps = taxels.reshape(*taxels.shape[:3], *taxel_xy.shape[:2])
        return depth_m, rate_mps

    def near(self, margin_m: float) -> np.ndarray:
        """(T, P, R, C) bool: the taxel would touch if it were ``margin_m`` further out of the pad."""
        return self.depth(((0.0, 0.0, margin_m),) * len(self.pads))[0] > 0

    def undisturbed(self, after_s: float = 1.0) -> np.ndarray:
        """(T, P) bool: nothing is near the pad, and nothing touched it during the last ``after_s`` [s]."""
        # An object within 0.3 mm of a pad may touch it.
        near = self.near(3e-4).any(axis=(2, 3))
        last = np.where(near, self.time_s, -np.inf)
        return self.time_s - np.maximum.accumulate(last, axis=0) > after_s


def _moved(matrices: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(n, 3, 3) rows x, y, 1 of a pad's plane, whose origin is moved to points (n, 4)."""
    moved = matrices[..., [0, 1, 3]]
    moved[..., 2] = np.einsum("nxk,nk->nx", matrices, points)
    return moved


def twin_pads(config: TwinConfig) -> dict[str, TouchPad]:
    """Name → pad of the twin."""
    sensor = _sensor_spec(config)
    shape = sensor.rows, sensor.columns
    return {name: TouchPad(name, shape, sensor.gain_per_count) for name in ROBOT.pads}


def lacking_pads(measurement: Measurement, config: TwinConfig, arm: str) -> str:
    """Text: which pads of an arm the twin has and the recording has not, by name and
    shape; empty if it has them."""
    pads = twin_pads(config)
    own = [pads[f"{arm}_{finger}"] for finger in ROBOT.fingers]
    touch = measurement.touch
    alike = [] if touch is None else [(p.name, p.shape) for p in touch.pads]
    if touch is None or all((pad.name, pad.shape) in alike for pad in own):
        return ""
    recorded = ", ".join(map(str, touch.pads))
    return f"it has {recorded}, the twin's {arm} arm has {', '.join(map(str, own))}"


def _sensor_spec(config: TwinConfig) -> SensorSpec:
    """Spec of the twin's pads."""
    has_spec = hasattr(config.sensor, "spec")
    name = config.sensor.spec if has_spec else "flexitac_v2"  # pyright: ignore[reportAttributeAccessIssue]
    return load_sensor_spec(find_spec(name))


def touch_motion(
    measurement: Measurement, config: TwinConfig, pressed: PressedObject
) -> TouchMotion:
    """Make the matched contact replay of a measurement, from its gripper openings and its pad frames. ``config``: configuration
    of the twin, for the robot's mounts and the sensor's scan. Raises TaccorlError: there are no frames of the pads, they are of
    other pads than the twin's, openings or joints were not measured, or the object never came near a pad."""
    if measurement.touch is None:
        none = "the recording has no frames of the pads; record them, or remove this recording"
        raise TaccorlError(f"{measurement.name}: {none}")
    if lacking := lacking_pads(measurement, config, pressed.arm):
        raise TaccorlError(
            f"{measurement.name}: its pads are not the twin's: {lacking}; remove `pressed`"
        )
    spec = _sensor_spec(config)
    instants_s, number = (
        scan_instants_s(spec),
        np.arange(spec.rows * spec.columns).reshape(spec.rows, spec.columns),
    )
    names = [f"{pressed.arm}_{finger}" for finger in ROBOT.fingers]
    parts = {pad.name: part for pad, part in measurement.touch.parts.items()}
    own = [parts[name] for name in names]
    stamps = np.concatenate([part.time_s for part in own], axis=1)
    covered = (stamps + instants_s[0] >= measurement.time_s[0]) & (
        stamps <= measurement.time_s[-1]
    )
    frames = covered.all(axis=1)
    if frames.sum() < 10:
        raise TaccorlError(
            f"{measurement.name}: {frames.sum()} of {len(frames)} frames of the pads lie between its first and its last row; "
            "check the clocks of pads and joints"
        )
    stamps = stamps[frames]
    moving = _Fingers(measurement, config.robot, pressed)
    times = stamps[:, :, None] + instants_s
    pose, later, earlier = (
        moving.object_from_pad(times + shift) for shift in (0.0, _STEP_S, -_STEP_S)
    )
    shapes, corners_m = shapes_in_object(pressed.solids)
    layout = dataclasses.replace(ROBOT.pad, rows=spec.rows, columns=spec.columns)
    counts = np.stack([part.counts for part in own], axis=1)
    resting = np.stack([part.baseline for part in own])
    motion = TouchMotion(
        measurement=measurement,
        pads=tuple(names),
        time_s=stamps,
        measured=counts[frames].reshape(-1, len(own), *layout.shape),
        baseline=resting.reshape(len(own), *layout.shape),
        object_from_pad=pose,
        velocity=(later - earlier) / (2 * _STEP_S),
        groups=as_wire(number, spec).copy(),
        shapes=shapes,
        layout=layout,
        clearance_m=((corners_m - pose[..., None, :, 3]) @ pose[..., :, 2, None])[
            ..., 0
        ].min(axis=-1),
    )
    comes_near = motion.near(_NEAR_M).any(axis=(0, 2, 3))
    if not comes_near.any():
        raise TaccorlError(
            f"{measurement.name}: the object never comes within {_NEAR_M * 1e3:g} mm of the pads of the {pressed.arm} arm, "
            f"whose opening is at least {np.nanmin(moving.opening_m) * 1e3:.2f} mm; check the object's size, pose and frame"
        )
    return _only(motion, np.flatnonzero(comes_near))


def _only(motion: TouchMotion, pads: np.ndarray) -> TouchMotion:
    if len(pads) == len(motion.pads):
        return motion
    arrays: dict[str, Any] = {
        name: np.ascontiguousarray(getattr(motion, name)[:, pads])
        for name in ("time_s", "measured", "object_from_pad", "velocity", "clearance_m")
    }
    kept = tuple(motion.pads[p] for p in pads)
    return dataclasses.replace(
        motion, pads=kept, baseline=motion.baseline[pads], **arrays
    )


class _Fingers:
    """Poses of both pads of an arm in the object's frame, at any time of a measurement."""

    def __init__(
        self, measurement: Measurement, robot: RobotConfig, pressed: PressedObject
    ) -> None:
        names = [f"{pressed.arm}_gripper"]
        if pressed.frame == "world":
            names += [f"{pressed.arm}_{joint}" for joint in ROBOT.joints]
        rows = measurement.measured[:, [measurement.column(name) for name in names]]
        there = np.isfinite(rows).all(axis=1)
        if there.mean() < 0.5:
            raise TaccorlError(
                f"{measurement.name}: {', '.join(names)} were measured in only {there.mean():.0%} of the rows; depths cannot "
                "be computed without them"
            )
        # Savitzky–Golay of third order over 45 ms, 9 rows at 200 Hz: an opening's noise of
        # 10 µm falls to 6 µm and 0.5 mm/s.
        window = max(5, round(0.045 * measurement.rate_hz)) // 2 * 2 + 1
        if there.sum() < window:
            raise TaccorlError(
                f"{measurement.name}: {there.sum()} measured rows are too few; {window} are needed"
            )
        time_s = measurement.time_s
        even = np.column_stack(
            [np.interp(time_s, time_s[there], column[there]) for column in rows.T]
        )
        self._rows = CubicSpline(time_s, savgol_filter(even, window, 3, axis=0))
        self._pressed, self._robot = pressed, robot
        self.opening_m = even[:, 0]

    def object_from_pad(self, time_s: np.ndarray) -> np.ndarray:
        """(T, 2, I, 3, 4) at times (T, 2, I): finger a, then finger b."""
        rows = self._rows(time_s)
        tcp_from_pad = np.zeros((*time_s.shape, 3, 4))
        for f, side in enumerate((1.0, -1.0)):
            z, y = np.array([0.0, -side, 0.0]), np.array([0.0, 0.0, 1.0])
            tcp_from_pad[:, f, :, :, :3] = np.stack([np.cross(y, z), y, z], axis=1)
            tcp_from_pad[:, f, :, 1, 3] = side * rows[:, f, :, 0] / 2
        object_from_frame = np.linalg.inv(self._pressed.pose)
        if self._pressed.frame == "tcp":
            return _compose(object_from_frame, tcp_from_pad)
        tcp = link_poses(rows[..., 1:])[..., -1, :, :]
        tcp[..., :3, 3] += ROBOT.tcp_from_hand_m * tcp[..., :3, 2]
        tcp[..., :3, 3] += mount_pos_world_m(self._pressed.arm, self._robot)
        return _compose(object_from_frame @ tcp, tcp_from_pad)


def _compose(a_from_b: np.ndarray, b_from_c: np.ndarray) -> np.ndarray:
    """(..., 4, 4) and (..., 3, 4) → (..., 3, 4)."""
    composed = a_from_b[..., :3, :3] @ b_from_c
    composed[..., 3] += a_from_b[..., :3, 3]
    return composed


def shapes_in_object(solids: Sequence[Solid]) -> tuple[ShapeTables, np.ndarray]:
    """The G solids that touch (no ballast). Returns the solids in double precision, for ``depth_in_body``; and the corners (8 G,
    3) [m] of their bounding boxes."""
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body(name="pressed")
    for k, solid in enumerate(s for s in solids if s.touches):
        if isinstance(solid, Capsule) and solid.half_height_m == 0:
            pos, size = solid.part_from_solid[:3, 3], [solid.radius_m, 0, 0]
            body.add_geom(
                name=f"{k}", type=mujoco.mjtGeom.mjGEOM_SPHERE, pos=pos, size=size
            )
        else:
            add_geom(spec, body, solid, f"pressed_{k}")
    model = spec.compile()
    shapes = shapes_of(model, list(range(model.ngeom)), np.float64)
    signs = np.array(np.meshgrid(*[(-1.0, 1.0)] * 3)).reshape(3, -1).T
    boxes = [
        model.geom_aabb[g, :3] + signs * model.geom_aabb[g, 3:] for g in shapes.geom
    ]
    corners = [
        box @ pose[:, :3].T + pose[:, 3]
        for box, pose in zip(boxes, shapes.body_from_geom, strict=True)
    ]
    return shapes, np.concatenate(corners)

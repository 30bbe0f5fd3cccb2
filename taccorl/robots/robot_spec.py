"""Description of a robot: arms, joints, limits, gains, cameras, pads, and the order of the numbers of an action.

Frames: *hand* is the last link of an arm. TCP: middle between the pads, z = approach direction, the fingers close along y.
Letters in shapes: A numbers of an action, arm after arm, of each its joints [rad], base to hand, then its gripper's opening [m].
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np


@dataclass(frozen=True, kw_only=True)
class Link:
    """One link of an arm and its joint, which turns about the link's z axis."""

    name: str
    pos_parent_m: tuple[float, float, float]
    """Origin of the joint in the parent link's frame [m]."""
    rpy_parent_rad: tuple[float, float, float]
    """Fixed-axis roll, pitch, yaw of the joint in the parent link's frame [rad], as in URDF."""
    range_rad: tuple[float, float]
    """Lowest and highest angle of the joint [rad]."""


@dataclass(frozen=True, kw_only=True)
class Inertia:
    """Mass, centre of mass and inertia of one link, in the link's frame."""

    mass_kg: float
    com_link_m: tuple[float, float, float]
    """Centre of mass in the link's frame [m]."""
    inertia_kgm2: tuple[float, float, float, float, float, float]
    """Ixx, Iyy, Izz, Ixy, Ixz, Iyz [kg·m²]."""
    about: Literal["link", "com"]
    """Point of reference of ``inertia_kgm2``."""

    def about_com_kgm2(self) -> np.ndarray:
        """(6,) Ixx, Iyy, Izz, Ixy, Ixz, Iyz about the centre of mass (parallel axes) [kg·m²]."""
        if self.about == "com":
            return np.array(self.inertia_kgm2)
        x, y, z = self.com_link_m
        shift = np.array(
            [y * y + z * z, x * x + z * z, x * x + y * y, -x * y, -x * z, -y * z]
        )
        return np.array(self.inertia_kgm2) - self.mass_kg * shift


@dataclass(frozen=True, kw_only=True)
class PadLayout:
    """Arrangement of the taxels of one tactile pad. Index of a taxel = row · columns + column."""

    rows: int
    """Number of rows, from palm to tip."""
    columns: int
    """Number of columns, across the finger."""
    pitch_m: float
    """Distance between neighbouring taxels [m], the same along rows and columns."""

    @property
    def shape(self) -> tuple[int, int]:
        """Number of rows and columns."""
        return self.rows, self.columns

    @property
    def num_taxels(self) -> int:
        """Number of taxels of one pad."""
        return self.rows * self.columns

    @property
    def length_m(self) -> float:
        """Length of the pad from palm to tip [m]."""
        return self.rows * self.pitch_m

    @property
    def width_m(self) -> float:
        """Width of the pad across the finger [m]."""
        return self.columns * self.pitch_m

    def taxel_axes_m(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the positions of the columns, (columns,), along the pad's x axis and of the rows, (rows,), along its y axis [m];
        0 is the pad's middle.
        """
        x, y = (
            (np.arange(n) - (n - 1) / 2) * self.pitch_m
            for n in (self.columns, self.rows)
        )
        return x, y


@dataclass(frozen=True, kw_only=True)
class CameraMount:
    """Nominal mount of one colour camera of the robot: body, position, direction, model."""

    name: (
        str  # Name of the camera, as in the dataset's key ``observation.images.<name>``
    )
    body: str = "world"  # Body to which the camera is fixed
    model: str  # Name of its imager in ``taccorl.sim.cameras.COLOR_SENSORS``
    position_m: tuple[float, float, float]  # Optical centre in the body's frame [m]
    look_at_m: tuple[
        float, float, float
    ]  # Point in the body's frame that appears in the middle of the picture [m]
    up: tuple[float, float, float] = (
        0.0,
        0.0,
        1.0,
    )  # Direction in the body's frame that points up in the picture


@dataclass(frozen=True, kw_only=True)
class RobotSpec:
    """A robot of equal arms with a two-finger gripper each. State and action have the same numbers in the same order."""

    arms: tuple[
        str, ...
    ]  # Names of the arms; they are the prefixes of the names of everything on an arm
    joints: tuple[
        str, ...
    ]  # Names of one arm's joints without the arm's prefix, base to hand
    links: tuple[
        Link, ...
    ]  # Links of one arm, base to hand: link k is moved by joint k
    kp_nm_per_rad: tuple[
        float, ...
    ]  # K_p of each joint's controller [N·m/rad], in τ = K_p (q* − q) − K_d q̇ + T_ref
    kd_nms_per_rad: tuple[float, ...]  # K_d of each joint's controller [N·m·s/rad]
    torque_ff_nm: tuple[float, ...]  # T_ref of each joint's controller [N·m]
    fingers: tuple[
        str, ...
    ]  # Names of the fingers of one gripper; each finger has a pad
    finger_stroke_m: float  # Travel of each finger [m]
    finger_from_hand_m: float  # Distance of the fingers' origin from the hand's origin, along the hand's z axis [m]
    tcp_from_hand_m: (
        float  # Distance of the TCP from the hand's origin, along the hand's z axis [m]
    )
    grip_force_max_n: float  # Greatest closing force of each finger [N]
    pad: PadLayout  # Taxels of every pad
    pad_thickness_m: float  # Height of the taxels above the finger [m]
    camera_mounts: tuple[
        CameraMount, ...
    ]  # Cameras, in the order of the dataset's keys

    @property
    def hand(self) -> str:
        """Name of an arm's last link, without the arm's prefix."""
        return self.links[-1].name

    @property
    def opening_max_m(self) -> float:
        """Greatest distance between the pads of a gripper [m]."""
        return 2 * self.finger_stroke_m

    @property
    def pads(self) -> tuple[str, ...]:
        """Names of the pads in the order of ``observation.tactile``."""
        return tuple(f"{arm}_{finger}" for arm in self.arms for finger in self.fingers)

    @property
    def num_taxels(self) -> int:
        """K: number of taxels of all pads together."""
        return len(self.pads) * self.pad.num_taxels

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras in the order of the dataset's keys."""
        return tuple(mount.name for mount in self.camera_mounts)

    # numbers of an action, and of a state --------------------------------------------------------------------------------

    @property
    def num_joints(self) -> int:
        """Number of joints of one arm, without its gripper."""
        return len(self.joints)

    @property
    def num_per_arm(self) -> int:
        """Number of values in an action that belong to one arm: its joints and its gripper."""
        return self.num_joints + 1

    @property
    def num_actions(self) -> int:
        """A: number of values in an action, and in a state."""
        return len(self.arms) * self.num_per_arm

    @cached_property
    def action_names(self) -> tuple[str, ...]:
        """(A,) names ``<arm>_<joint>`` and ``<arm>_gripper`` of the numbers of an action."""
        return tuple(
            f"{arm}_{name}" for arm in self.arms for name in (*self.joints, "gripper")
        )

    def arm_slice(self, arm: str) -> slice:
        """Slice of the joints and the gripper of ``arm`` in an action of A numbers.

        Raises:
            ValueError: no such arm.
        """
        first = self.arms.index(arm) * self.num_per_arm
        return slice(first, first + self.num_per_arm)

    def joint_slice(self, arm: str) -> slice:
        """Slice of the joints of ``arm`` in an action of A numbers.

        Raises:
            ValueError: no such arm.
        """
        first = self.arms.index(arm) * self.num_per_arm
        return slice(first, first + self.num_joints)

    def gripper_index(self, arm: str) -> int:
        """Index of the gripper of ``arm`` in an action of A numbers, from 0.

        Raises:
            ValueError: no such arm.
        """
        return self.arms.index(arm) * self.num_per_arm + self.num_joints

    @property
    def gripper_indices(self) -> list[int]:
        """Index of each arm's gripper in an action of A numbers, in the order of the arms."""
        return [self.gripper_index(arm) for arm in self.arms]

    @property
    def joint_indices(self) -> list[int]:
        """Index of each joint, grippers left out, in an action of A numbers."""
        grippers = self.gripper_indices
        return [k for k in range(self.num_actions) if k not in grippers]

    def per_action(self, joint: float, gripper: float) -> np.ndarray:
        """(A,) float64: ``joint`` for every joint, ``gripper`` for every gripper."""
        return np.array([*[joint] * self.num_joints, gripper] * len(self.arms), float)

    @cached_property
    def action_low(self) -> np.ndarray:
        """(A,) float64 lower limits [rad, m], rounded to float32 inwards: a clipped action is stored exactly.

        A gripper's limit is 0, which float32 has.
        """
        low = np.nextafter(self._limits[:, 0], np.float32(1), dtype=np.float32).astype(
            float
        )
        low[self.gripper_indices] = 0.0
        return low

    @cached_property
    def action_high(self) -> np.ndarray:
        """(A,) float64 upper limits [rad, m], rounded to float32 inwards."""
        return np.nextafter(self._limits[:, 1], np.float32(0), dtype=np.float32).astype(
            float
        )

    @property
    def _limits(self) -> np.ndarray:
        one_arm = [*(link.range_rad for link in self.links), (0.0, self.opening_max_m)]
        return np.array(one_arm * len(self.arms), np.float32)

"""Model of the PiPER arms for MuJoCo: links, grippers, pads and cameras' brackets from the numbers of ``taccorl.robots``.

World frame: x forward from the arms, y to the left, z up, origin on the table between the two mounts. Link i turns about
its own z axis. TCP: middle between the pads, z = approach direction, the fingers close along y.
"""

from dataclasses import dataclass
from typing import Literal

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from taccorl.errors import TaccorlError, nearest
from taccorl.robots import ROBOT
from taccorl.robots.bimanual_piper import (
    CAPSULES,
    DARK,
    FINGER_MASS_KG,
    HAND_BOXES,
    INERTIAS,
    PAD_COLOR,
    STEEL,
)
from taccorl.sim.settings import check_numbers


@dataclass(kw_only=True)
class RobotConfig:
    """Physical parameters of both arms, their grippers and pads."""

    inertias: str = "manufacturer"
    """Source of the link masses: ``manufacturer`` (3.6 kg moving) or ``menagerie`` (2.2 kg moving)."""
    mount_height_m: float = 0.2
    """Height of the arms' bases above the table. Our choice: with it every task is reached within the joint limits."""
    mount_spacing_m: float = 0.6
    """Distance of the two bases along y. Our choice."""
    armature_kgm2: float = 0.01
    """Rotor inertia reflected to each joint [kg·m²]. Not published; its effect is far below the uncertainty of the calibrated
    gains."""
    gravity_compensation: float = 1.0
    """Share of the arm's weight that the controller compensates; 1: all (MuJoCo ``gravcomp``)."""
    pads: Literal["sprung", "rigid"] = "sprung"
    """Sprung: each pad is a plate on a spring, so that its depth depends on the force and not on the part's mass. Rigid: a fixed
    box."""
    pad_stiffness_n_per_m: float = 2e4
    """Stiffness of one whole pad; 10 N compress it by 0.5 mm. A choice, to be calibrated on a robot."""
    pad_damping_ns_per_m: float = 30.0
    """Damping of one whole pad [N·s/m]."""
    pad_tilt_stiffness_nm_per_rad: tuple[float, float] = (40.0, 16.0)
    """Tilt stiffness of a pad that is pressed off its middle: along the finger, and across it. Without it a load that twists
    the part would leave no trace in the taxels. A plate on a uniform bed would have K L² / 12 = 6.8 and 1.0; a part that covers
    a part of the pad tilts it less. A choice, to be calibrated on a robot."""
    grip_stiffness_n_per_m: float = 2000.0
    """Closing force of each finger per metre by which the commanded opening is below the actual one. A choice: with the
    smallest command, 0, a part 18 mm wide is held with 30 N, because both pads yield by 1.5 mm."""
    grip_damping_ns_per_m: float = 40.0
    """Damping of each finger's motion [N·s/m]."""
    grip_force_max_n: float = ROBOT.grip_force_max_n
    """Greatest closing force of each finger; by default the gripper's rated clamping force."""

    def __post_init__(self) -> None:
        if self.inertias not in INERTIAS:
            raise TaccorlError(
                f"robot.inertias: no mass set {self.inertias!r}; {nearest(self.inertias, INERTIAS)}"
            )
        if self.pads not in ("sprung", "rigid"):
            raise TaccorlError(
                f"robot.pads: {self.pads!r} is neither 'sprung' nor 'rigid'"
            )
        if len(self.pad_tilt_stiffness_nm_per_rad) != 2:
            raise TaccorlError(
                f"robot.pad_tilt_stiffness_nm_per_rad: {self.pad_tilt_stiffness_nm_per_rad} is not two numbers; give one "
                "along the finger and one across it"
            )
        check_numbers(
            "robot",
            self,
            finite=("mount_height_m", "gravity_compensation"),
            not_negative=(
                "armature_kgm2",
                "pad_damping_ns_per_m",
                "grip_damping_ns_per_m",
            ),
            positive=(
                "mount_spacing_m",
                "pad_stiffness_n_per_m",
                "pad_tilt_stiffness_nm_per_rad",
                "grip_stiffness_n_per_m",
                "grip_force_max_n",
            ),
        )


def link_poses(joints_rad: np.ndarray) -> np.ndarray:
    """Base-from-link poses (…, J, 4, 4) of an arm's links for ``joints_rad`` (…, J), by plain matrix products: the tests'
    reference."""
    poses = np.empty((*joints_rad.shape[:-1], len(ROBOT.links), 4, 4))
    pose = np.broadcast_to(np.eye(4), (*joints_rad.shape[:-1], 4, 4))
    for i, link in enumerate(ROBOT.links):
        fixed = np.eye(4)
        fixed[:3, :3] = Rotation.from_euler("xyz", link.rpy_parent_rad).as_matrix()
        fixed[:3, 3] = link.pos_parent_m
        turn = np.zeros_like(pose)
        turn[..., 3, 3] = 1.0
        turn[..., :3, :3] = (
            Rotation.from_rotvec(
                joints_rad[..., i, None].reshape(-1, 1) * np.array([0.0, 0.0, 1.0])
            )
            .as_matrix()
            .reshape(*joints_rad.shape[:-1], 3, 3)
        )
        pose = pose @ fixed @ turn
        poses[..., i, :, :] = pose
    return poses


_SIDE_BIT = {
    arm: 2 << a for a, arm in enumerate(ROBOT.arms)
}  # an arm touches parts, table, other arms, never itself
PART_BIT = 1
"""Bit of ``contype`` and ``conaffinity`` of parts (MuJoCo's default), pads and table; arms have it in ``conaffinity`` only."""


def mount_pos_world_m(arm: str, config: RobotConfig) -> tuple[float, float, float]:
    """World position (x, y, z) of an arm's base [m]. Bases stand side by side along y, the first arm on the left."""
    side = (len(ROBOT.arms) - 1) / 2 - ROBOT.arms.index(arm)
    return 0.0, side * config.mount_spacing_m, config.mount_height_m


def add_arm(spec: mujoco.MjSpec, arm: str, config: RobotConfig) -> None:
    """Add one arm at its mount. Names: ``left_link1`` … ``left_link6``, joints ``left_joint1`` …, ``left_finger_a``, pads
    ``left_a``, site ``left_tcp``; each taxel frame is the site named like its pad, at the undeformed pad's surface."""
    base = spec.worldbody.add_body(
        name=f"{arm}_base_link", pos=mount_pos_world_m(arm, config)
    )
    _geom(
        base,
        arm,
        type=mujoco.mjtGeom.mjGEOM_CYLINDER,
        size=[0.055, 0.035, 0],
        pos=[0, 0, 0.035],
        rgba=STEEL,
    )
    if config.mount_height_m > 0:
        half = config.mount_height_m / 2
        _geom(
            base,
            arm,
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[0.06, 0.06, half],
            pos=[0, 0, -half],
            rgba=DARK,
        )
    body = base
    for joint, link, inertia in zip(
        ROBOT.joints, ROBOT.links, INERTIAS[config.inertias], strict=True
    ):
        quat = Rotation.from_euler("xyz", link.rpy_parent_rad).as_quat(
            scalar_first=True
        )
        body = body.add_body(
            name=f"{arm}_{link.name}", pos=link.pos_parent_m, quat=quat
        )
        body.gravcomp = config.gravity_compensation
        body.mass, body.ipos, body.explicitinertial = (
            inertia.mass_kg,
            inertia.com_link_m,
            True,
        )
        body.fullinertia = inertia.about_com_kgm2()
        body.add_joint(
            name=f"{arm}_{joint}",
            axis=[0, 0, 1],
            range=link.range_rad,
            armature=config.armature_kgm2,
        )
        for owner, start, end, radius, color in CAPSULES:
            if owner == link.name:
                capsule = mujoco.mjtGeom.mjGEOM_CAPSULE
                _geom(
                    body,
                    arm,
                    type=capsule,
                    fromto=[*start, *end],
                    size=[radius, 0, 0],
                    rgba=color,
                )
    for centre, half, color in HAND_BOXES:
        _geom(
            body, arm, type=mujoco.mjtGeom.mjGEOM_BOX, size=half, pos=centre, rgba=color
        )
    body.add_site(
        name=f"{arm}_tcp",
        pos=[0, 0, ROBOT.tcp_from_hand_m],
        size=[0.002, 0.002, 0.002],
        group=4,
    )
    for finger in ROBOT.fingers:
        _add_finger(spec, body, arm, finger, config)
    # One motor drives both fingers through a rack: they stay mirror images.
    spec.add_equality(
        name=f"{arm}_fingers",
        type=mujoco.mjtEq.mjEQ_JOINT,
        name1=f"{arm}_finger_a",
        name2=f"{arm}_finger_b",
        data=[0, 1] + [0] * 10,
        solref=[0.005, 1],
        solimp=[0.99, 0.999, 0.0001, 0.5, 2],
    )


def _geom(body: mujoco.MjsBody, arm: str, **settings) -> None:
    others = sum(bit for other, bit in _SIDE_BIT.items() if other != arm)
    body.add_geom(
        contype=_SIDE_BIT[arm], conaffinity=PART_BIT | others, mass=0, **settings
    )


def _add_finger(
    spec: mujoco.MjSpec,
    hand: mujoco.MjsBody,
    arm: str,
    finger: str,
    config: RobotConfig,
) -> None:
    """Finger ``a`` sits on the +y side of link 6 and opens along +y; ``b`` is its mirror image."""
    side = 1.0 if finger == "a" else -1.0
    pad_z = ROBOT.tcp_from_hand_m - ROBOT.finger_from_hand_m
    body = hand.add_body(
        name=f"{arm}_finger_{finger}", pos=[0, 0, ROBOT.finger_from_hand_m]
    )
    body.gravcomp = config.gravity_compensation
    body.mass, body.ipos, body.explicitinertial = (
        FINGER_MASS_KG[config.inertias],
        [0, side * 0.01, 0.02],
        True,
    )
    body.inertia = [2e-5, 2e-5, 5e-6]
    slide = mujoco.mjtJoint.mjJNT_SLIDE
    # The armature is the gripper motor's rotor as the finger feels it; damping its gear. Neither is published.
    motor, stroke = {"armature": 0.1, "damping": 5.0}, [0, ROBOT.finger_stroke_m]
    body.add_joint(
        name=f"{arm}_finger_{finger}",
        type=slide,
        axis=[0, side, 0],
        range=stroke,
        **motor,
    )
    box = mujoco.mjtGeom.mjGEOM_BOX
    back = side * (ROBOT.pad_thickness_m + 0.0055)
    _geom(
        body,
        arm,
        type=box,
        size=[0.011, 0.005, 0.043],
        pos=[0, back, pad_z - 0.012],
        rgba=DARK,
    )
    holder = body
    if config.pads == "sprung":
        holder = body.add_body(name=f"{arm}_pad_{finger}", pos=[0, 0, 0])
        holder.gravcomp = config.gravity_compensation
        holder.mass, holder.ipos, holder.explicitinertial = (
            0.004,
            [0, side * ROBOT.pad_thickness_m / 2, pad_z],
            True,
        )
        holder.inertia = [1.4e-6, 1.4e-6, 2e-7]
        holder.add_joint(
            name=f"{arm}_{finger}_spring",
            type=slide,
            axis=[0, side, 0],
            range=[-0.0002, 0.004],
            stiffness=config.pad_stiffness_n_per_m,
            damping=config.pad_damping_ns_per_m,
        )
        for axis, stiffness in zip(
            "xz", config.pad_tilt_stiffness_nm_per_rad, strict=True
        ):
            holder.add_joint(
                name=f"{arm}_{finger}_tilt_{axis}",
                axis=[axis == "x", 0, axis == "z"],
                pos=[0, side * ROBOT.pad_thickness_m / 2, pad_z],
                range=[-0.1, 0.1],
                stiffness=stiffness,
                damping=stiffness
                * config.pad_damping_ns_per_m
                / config.pad_stiffness_n_per_m,
            )
    holder.add_geom(
        name=f"{arm}_{finger}",
        type=box,
        size=[ROBOT.pad.width_m / 2, ROBOT.pad_thickness_m / 2, ROBOT.pad.length_m / 2],
        pos=[0, side * ROBOT.pad_thickness_m / 2, pad_z],
        rgba=PAD_COLOR,
        contype=PART_BIT,
        conaffinity=PART_BIT,
        mass=0 if config.pads == "sprung" else 0.004,
        **PAD_CONTACT,
    )
    # Taxel frame: z out of the pad, y from palm to tip.
    z_axis, y_axis = np.array([0.0, -side, 0.0]), np.array([0.0, 0.0, 1.0])
    matrix = np.stack([np.cross(y_axis, z_axis), y_axis, z_axis], axis=1)
    quat = Rotation.from_matrix(matrix).as_quat(scalar_first=True)
    body.add_site(
        name=f"{arm}_{finger}",
        pos=[0, 0, pad_z],
        quat=quat,
        size=[0.001, 0.001, 0.001],
        group=4,
    )
    spec.add_exclude(bodyname1=holder.name, bodyname2=hand.name)


PAD_CONTACT = {
    # Of pads on each other and on the table only: on a part, the part's own contact settings count (its priority is higher).
    "friction": [0.01, 0.005, 0.0001],
    "condim": 4,
    "solref": [0.002, 1],
    "solimp": [0.95, 0.99, 0.001, 0.5, 2],
}

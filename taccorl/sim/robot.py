"""The AgileX PiPER arm as a table of numbers, and the arm, gripper and pads built from it.

Joint frames, limits and one set of masses are the manufacturer's (agilexrobotics/Piper_ros, piper_description.urdf, commit
116596c); the other set is MuJoCo Menagerie's (agilex_piper/piper.xml, commit 0bee963). They differ by a third in moving
mass, which is one reason why a calibrated arm needs a feed-forward torque. Geometry is our own primitives.

World frame: x forward from the arms, y to the left, z up, origin on the table between the two mounts. Link i turns about
its own z axis. TCP: middle between the pads, z = approach direction, the fingers close along y.
"""

from dataclasses import dataclass
from typing import Literal

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from taccorl.errors import TaccorlError, nearest
from taccorl.sim.settings import check_numbers

ARMS = ("left", "right")
JOINTS = ("joint1", "joint2", "joint3", "joint4", "joint5", "joint6")
FINGERS = ("a", "b")  # a closes along −y of link 6, b along +y; pad left_a is the drivers' left_robot_left_finger
PADS = tuple(f"{arm}_{finger}" for arm in ARMS for finger in FINGERS)
"""Pad order of ``observation.tactile`` (data_specs/taccorl_bimanual.yaml)."""

PAD_TAXELS = (32, 12)  # rows from palm to tip, columns across; FlexiTac-V2, paper App. A
TAXEL_PITCH_M = 0.002  # FlexiTac-V2
PAD_LENGTH_M, PAD_WIDTH_M = PAD_TAXELS[0] * TAXEL_PITCH_M, PAD_TAXELS[1] * TAXEL_PITCH_M
PAD_THICKNESS_M = 0.0036  # FlexiTac simulation settings: taxels lie 3.6 mm above the finger
FINGER_STROKE_M = 0.035  # each finger; the gripper opens 70 mm (PiPER manual)
FINGER_FROM_LINK6_M = 0.1358  # along z (URDF)
TCP_FROM_LINK6_M = 0.168  # middle of the pads, along z


@dataclass(frozen=True, kw_only=True)
class Link:
    """One link: where its joint sits in its parent, and how far it turns."""

    name: str
    pos_parent_m: tuple[float, float, float]
    rpy_parent_rad: tuple[float, float, float]
    """Fixed-axis roll, pitch, yaw, as URDF states them."""
    range_rad: tuple[float, float]


LINKS = (
    Link(name="link1", pos_parent_m=(0, 0, 0.123), rpy_parent_rad=(0, 0, 0), range_rad=(-2.618, 2.618)),
    Link(name="link2", pos_parent_m=(0, 0, 0), rpy_parent_rad=(1.5708, -0.1359, -3.1416), range_rad=(0.0, 3.14)),
    Link(name="link3", pos_parent_m=(0.28503, 0, 0), rpy_parent_rad=(0, 0, -1.7939), range_rad=(-2.967, 0.0)),
    Link(name="link4", pos_parent_m=(-0.021984, -0.25075, 0), rpy_parent_rad=(1.5708, 0, 0), range_rad=(-1.745, 1.745)),
    Link(name="link5", pos_parent_m=(0, 0, 0), rpy_parent_rad=(-1.5708, 0, 0), range_rad=(-1.22, 1.22)),
    Link(name="link6", pos_parent_m=(8.8259e-5, -0.091, 0), rpy_parent_rad=(1.5708, 0, 0), range_rad=(-2.0944, 2.0944)),
)


@dataclass(frozen=True, kw_only=True)
class Inertia:
    """Mass, centre of mass and inertia of one link, in the link's frame."""

    mass_kg: float
    com_link_m: tuple[float, float, float]
    inertia_kgm2: tuple[float, float, float, float, float, float]
    """Ixx, Iyy, Izz, Ixy, Ixz, Iyz."""
    about: Literal["link", "com"]
    """Which point ``inertia_kgm2`` is about."""

    def about_com_kgm2(self) -> np.ndarray:
        """(6,) Ixx, Iyy, Izz, Ixy, Ixz, Iyz about the centre of mass (parallel axes)."""
        if self.about == "com":
            return np.array(self.inertia_kgm2)
        x, y, z = self.com_link_m
        shift = np.array([y * y + z * z, x * x + z * z, x * x + y * y, -x * y, -x * z, -y * z])
        return np.array(self.inertia_kgm2) - self.mass_kg * shift


def _rows(about: Literal["link", "com"], *rows: tuple) -> tuple[Inertia, ...]:
    return tuple(Inertia(mass_kg=m, com_link_m=com, inertia_kgm2=inertia, about=about) for m, com, inertia in rows)


# kg, m, kg·m². The URDF writes its inertias as if about the centre of mass, but about the link frame they make sense:
# link 3 has 13.5e-3 of which 0.5 kg · (0.148 m)² = 11.0e-3, and 2.5e-3 is what a 0.5 kg rod of its length has.
# Link 3's Ixy has its sign turned: about the centre of mass no body could have it as listed (a negative eigenvalue).
# Link 6 and the gripper's base are one body; the flange's own 1.5e-3 (for 7 g!) is left out.
INERTIAS: dict[str, tuple[Inertia, ...]] = {
    "manufacturer": _rows(
        "link",
        (0.71, (0.00032, -0.00041, -0.00348), (0.00050027, 0.00040879, 0.00045802, 7.8e-7, 6.26e-6, 4.62e-6)),
        (1.16, (0.21852, -0.00861, 0.00126), (0.00111915, 0.06763251, 0.067559, 0.00182916, 0.00019233, 7.67e-6)),
        (0.50, (-0.01999, -0.14808, -0.00053), (0.01347608, 0.00046377, 0.01363321, -0.00161034, 6.6e-7, 1.62e-6)),
        (0.38, (0.00013, -0.00076, -0.00394), (0.00017844, 0.00018914, 0.00014613, 6.2e-7, 6.7e-7, 4.08e-6)),
        (0.383, (0.00018, -0.06104, -0.00227), (0.00172318, 0.00017936, 0.00171172, 2.59e-6, 1e-7, 9.9e-6)),
        (0.457, (-0.000181, 0.00008, 0.03236), (0.000929, 0.000714, 0.000394, 0, 0, 0)),
    ),
    # Turned from Menagerie's link frames into the manufacturer's: same origins, about z by −90, −7.79, 100.78, 180, 180
    # and 0 degrees. The 1e-3 of links 5 and 6 are its placeholders.
    "menagerie": _rows(
        "com",
        (0.097868, (0.00031, -0.00132, -0.00923), (9.25e-5, 7.767e-5, 8.246e-5, -1.1e-7, 9.9e-7, 1.98e-6)),
        (0.290889, (0.14709, -0.02256, 0.00175), (1.581e-4, 1.719e-3, 1.775e-3, 1.409e-4, -1.1e-6, -9.6e-7)),
        (0.290848, (-0.01569, -0.10446, 0.00051), (2.218e-4, 1.009e-4, 2.419e-4, -7.58e-6, 6.4e-7, 8.2e-7)),
        (0.127087, (-0.00028, 0.00103, -0.00473), (3.82e-5, 4.87e-5, 4.106e-5, -4.9e-8, -4.9e-8, -6.7e-8)),
        (0.144711, (-0.00009, -0.05668, -0.00196), (1e-3, 1e-3, 1e-3, 0, 0, 0)),
        (1.2, (0.00103, 0.01218, 0.03155), (1e-3, 1e-3, 1e-3, 0, 0, 0)),
    ),
}
FINGER_MASS_KG = {"manufacturer": 0.025, "menagerie": 0.0265}


@dataclass(kw_only=True)
class RobotConfig:
    """Both arms, their grippers and pads."""

    inertias: str = "manufacturer"
    """Mass set: ``manufacturer`` (3.6 kg moving) or ``menagerie`` (2.2 kg moving)."""
    mount_height_m: float = 0.2
    """Of the arms' bases above the table. Our choice: with it every task is reached within the joint limits."""
    mount_spacing_m: float = 0.6
    """Between the two bases, along y. Our choice."""
    armature_kgm2: float = 0.01
    """Rotor inertia as seen by each joint. Not published; far below what the calibrated gains can tell."""
    gravity_compensation: float = 1.0
    """Share of the arm's weight that the controller carries; 1 = all (MuJoCo ``gravcomp``)."""
    pads: Literal["sprung", "rigid"] = "sprung"
    """Sprung: each pad is a plate on a spring, so its depth follows the force and not the part's mass."""
    pad_stiffness_n_per_m: float = 2e4
    """Of one whole pad; 10 N press it in by 0.5 mm. A choice, to be calibrated on a robot."""
    pad_damping_ns_per_m: float = 30.0
    pad_tilt_stiffness_nm_per_rad: tuple[float, float] = (40.0, 16.0)
    """Of a pad that is pressed off its middle: along the finger, across it. Without it a load that twists the part would
    leave no trace in the taxels. A plate on a uniform bed would have K L² / 12 = 6.8 and 1.0; a part that covers a part of
    the pad tilts it less. A choice, to be calibrated on a robot."""
    grip_stiffness_n_per_m: float = 2000.0
    """Closing force of each finger for each metre that the command lies below the opening. A choice: with commands that end
    at 0 it takes 30 N to hold a part 18 mm wide."""
    grip_damping_ns_per_m: float = 40.0
    grip_force_max_n: float = 40.0
    """PiPER gripper, rated clamping force."""

    def __post_init__(self) -> None:
        if self.inertias not in INERTIAS:
            raise TaccorlError(f"robot.inertias: no mass set {self.inertias!r}; {nearest(self.inertias, INERTIAS)}")
        if self.pads not in ("sprung", "rigid"):
            raise TaccorlError(f"robot.pads: {self.pads!r} is neither 'sprung' nor 'rigid'")
        if len(self.pad_tilt_stiffness_nm_per_rad) != 2:
            raise TaccorlError(
                f"robot.pad_tilt_stiffness_nm_per_rad: {self.pad_tilt_stiffness_nm_per_rad} is not two numbers; give one "
                "along the finger and one across it"
            )
        check_numbers(
            "robot",
            self,
            finite=("mount_height_m", "gravity_compensation"),
            not_negative=("armature_kgm2", "pad_damping_ns_per_m", "grip_damping_ns_per_m"),
            positive=(
                "mount_spacing_m",
                "pad_stiffness_n_per_m",
                "pad_tilt_stiffness_nm_per_rad",
                "grip_stiffness_n_per_m",
                "grip_force_max_n",
            ),
        )


def link_poses(joints_rad: np.ndarray) -> np.ndarray:
    """Base-from-link of links 1 to 6 by plain matrix products, (..., 6, 4, 4), for joints (..., 6): the tests' reference."""
    poses = np.empty((*joints_rad.shape[:-1], 6, 4, 4))
    pose = np.broadcast_to(np.eye(4), (*joints_rad.shape[:-1], 4, 4))
    for i, link in enumerate(LINKS):
        fixed = np.eye(4)
        fixed[:3, :3] = Rotation.from_euler("xyz", link.rpy_parent_rad).as_matrix()
        fixed[:3, 3] = link.pos_parent_m
        turn = np.zeros_like(pose)
        turn[..., 3, 3] = 1.0
        turn[..., :3, :3] = (
            Rotation.from_rotvec(joints_rad[..., i, None].reshape(-1, 1) * np.array([0.0, 0.0, 1.0]))
            .as_matrix()
            .reshape(*joints_rad.shape[:-1], 3, 3)
        )
        pose = pose @ fixed @ turn
        poses[..., i, :, :] = pose
    return poses


_WHITE, _DARK, _STEEL, _PAD = (0.90, 0.90, 0.88, 1), (0.16, 0.17, 0.19, 1), (0.55, 0.57, 0.60, 1), (0.72, 0.74, 0.78, 1)
# Capsules of the arm's body: link, from, to [m], radius [m], colour
_CAPSULES = (
    ("link1", (0, 0, -0.060), (0, 0, 0), 0.045, _DARK),
    ("link2", (0, 0, -0.040), (0, 0, 0.040), 0.046, _DARK),
    ("link2", (0, 0, 0), (0.285, 0, 0), 0.037, _WHITE),
    ("link3", (0, 0, -0.040), (0, 0, 0.040), 0.042, _DARK),
    ("link3", (0, 0, 0), (-0.021, -0.235, 0), 0.033, _WHITE),
    ("link5", (0, 0, -0.030), (0, 0, 0.030), 0.032, _DARK),
    ("link5", (0, 0, 0), (0, -0.070, 0), 0.026, _WHITE),
    ("link6", (0, 0, 0), (0, 0, 0.055), 0.028, _WHITE),
)
# Boxes of the hand on link 6: centre, half extents [m], colour
_HAND_BOXES = (
    ((0, 0, 0.092), (0.022, 0.052, 0.026), _DARK),
    ((-0.100, 0, 0.025), (0.012, 0.021, 0.011), _STEEL),  # wrist camera
    ((-0.058, 0, 0.012), (0.045, 0.007, 0.005), _DARK),  # and its bracket
)
_SIDE_BIT = {"left": 2, "right": 4}  # an arm touches parts, table and the other arm, never itself
PART_BIT = 1


def add_arm(spec: mujoco.MjSpec, arm: str, config: RobotConfig) -> None:
    """One arm at its mount. Names: ``left_link1`` … ``left_link6``, joints ``left_joint1`` …, ``left_finger_a``, pads
    ``left_a``, site ``left_tcp``; each taxel frame is the site named like its pad, at the undeformed pad's surface."""
    y = (0.5 if arm == "left" else -0.5) * config.mount_spacing_m
    base = spec.worldbody.add_body(name=f"{arm}_base_link", pos=[0, y, config.mount_height_m])
    _geom(base, arm, type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[0.055, 0.035, 0], pos=[0, 0, 0.035], rgba=_STEEL)
    if config.mount_height_m > 0:
        half = config.mount_height_m / 2
        _geom(base, arm, type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.06, 0.06, half], pos=[0, 0, -half], rgba=_DARK)
    body = base
    for link, inertia in zip(LINKS, INERTIAS[config.inertias], strict=True):
        quat = Rotation.from_euler("xyz", link.rpy_parent_rad).as_quat(scalar_first=True)
        body = body.add_body(name=f"{arm}_{link.name}", pos=link.pos_parent_m, quat=quat)
        body.gravcomp = config.gravity_compensation
        body.mass, body.ipos, body.explicitinertial = inertia.mass_kg, inertia.com_link_m, True
        body.fullinertia = inertia.about_com_kgm2()
        joint = f"{arm}_joint{link.name[-1]}"
        body.add_joint(name=joint, axis=[0, 0, 1], range=link.range_rad, armature=config.armature_kgm2)
        for owner, start, end, radius, color in _CAPSULES:
            if owner == link.name:
                capsule = mujoco.mjtGeom.mjGEOM_CAPSULE
                _geom(body, arm, type=capsule, fromto=[*start, *end], size=[radius, 0, 0], rgba=color)
    for centre, half, color in _HAND_BOXES:
        _geom(body, arm, type=mujoco.mjtGeom.mjGEOM_BOX, size=half, pos=centre, rgba=color)
    body.add_site(name=f"{arm}_tcp", pos=[0, 0, TCP_FROM_LINK6_M], size=[0.002, 0.002, 0.002], group=4)
    for finger in FINGERS:
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
    other = _SIDE_BIT["right" if arm == "left" else "left"]
    body.add_geom(contype=_SIDE_BIT[arm], conaffinity=PART_BIT | other, mass=0, **settings)


def _add_finger(spec: mujoco.MjSpec, hand: mujoco.MjsBody, arm: str, finger: str, config: RobotConfig) -> None:
    """Finger ``a`` sits on the +y side of link 6 and opens along +y; ``b`` is its mirror image."""
    side = 1.0 if finger == "a" else -1.0
    pad_z = TCP_FROM_LINK6_M - FINGER_FROM_LINK6_M
    body = hand.add_body(name=f"{arm}_finger_{finger}", pos=[0, 0, FINGER_FROM_LINK6_M])
    body.gravcomp = config.gravity_compensation
    body.mass, body.ipos, body.explicitinertial = FINGER_MASS_KG[config.inertias], [0, side * 0.01, 0.02], True
    body.inertia = [2e-5, 2e-5, 5e-6]
    slide = mujoco.mjtJoint.mjJNT_SLIDE
    # The armature is the gripper motor's rotor as the finger feels it; damping its gear. Neither is published.
    body.add_joint(
        name=f"{arm}_finger_{finger}",
        type=slide,
        axis=[0, side, 0],
        range=[0, FINGER_STROKE_M],
        armature=0.1,
        damping=5.0,
    )
    box = mujoco.mjtGeom.mjGEOM_BOX
    back = side * (PAD_THICKNESS_M + 0.0055)
    _geom(body, arm, type=box, size=[0.011, 0.005, 0.043], pos=[0, back, pad_z - 0.012], rgba=_DARK)
    holder = body
    if config.pads == "sprung":
        holder = body.add_body(name=f"{arm}_pad_{finger}", pos=[0, 0, 0])
        holder.gravcomp = config.gravity_compensation
        holder.mass, holder.ipos, holder.explicitinertial = 0.004, [0, side * PAD_THICKNESS_M / 2, pad_z], True
        holder.inertia = [1.4e-6, 1.4e-6, 2e-7]
        holder.add_joint(
            name=f"{arm}_{finger}_spring",
            type=slide,
            axis=[0, side, 0],
            range=[-0.0002, 0.004],
            stiffness=config.pad_stiffness_n_per_m,
            damping=config.pad_damping_ns_per_m,
        )
        for axis, stiffness in zip("xz", config.pad_tilt_stiffness_nm_per_rad, strict=True):
            holder.add_joint(
                name=f"{arm}_{finger}_tilt_{axis}",
                axis=[axis == "x", 0, axis == "z"],
                pos=[0, side * PAD_THICKNESS_M / 2, pad_z],
                range=[-0.1, 0.1],
                stiffness=stiffness,
                damping=stiffness * config.pad_damping_ns_per_m / config.pad_stiffness_n_per_m,
            )
    holder.add_geom(
        name=f"{arm}_{finger}",
        type=box,
        size=[PAD_WIDTH_M / 2, PAD_THICKNESS_M / 2, PAD_LENGTH_M / 2],
        pos=[0, side * PAD_THICKNESS_M / 2, pad_z],
        rgba=_PAD,
        contype=PART_BIT,
        conaffinity=PART_BIT,
        mass=0 if config.pads == "sprung" else 0.004,
        **PAD_CONTACT,
    )
    # Taxel frame: z out of the pad, y from palm to tip.
    z_axis, y_axis = np.array([0.0, -side, 0.0]), np.array([0.0, 0.0, 1.0])
    matrix = np.stack([np.cross(y_axis, z_axis), y_axis, z_axis], axis=1)
    quat = Rotation.from_matrix(matrix).as_quat(scalar_first=True)
    body.add_site(name=f"{arm}_{finger}", pos=[0, 0, pad_z], quat=quat, size=[0.001, 0.001, 0.001], group=4)
    spec.add_exclude(bodyname1=holder.name, bodyname2=hand.name)


PAD_CONTACT = {
    # Of pads on each other and on the table only: on a part, the part's own contact settings count (its priority is higher).
    "friction": [0.01, 0.005, 0.0001],
    "condim": 4,
    "solref": [0.002, 1],
    "solimp": [0.95, 0.99, 0.001, 0.5, 2],
}

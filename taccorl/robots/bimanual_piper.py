"""Two AgileX PiPER arms with a FlexiTac-V2 pad on each finger: every number of the robot.

Joint frames, limits and one set of masses are the manufacturer's (agilexrobotics/Piper_ros, piper_description.urdf, commit
116596c); the other set is MuJoCo Menagerie's (agilex_piper/piper.xml, commit 0bee963). They differ by a third in moving
mass, which is one reason why a calibrated arm needs a feed-forward torque. Shapes are our own primitives.
"""

from typing import Literal

from taccorl.robots.robot_spec import CameraMount, Inertia, Link, PadLayout, RobotSpec

_LINKS = (
    Link(
        name="link1",
        pos_parent_m=(0, 0, 0.123),
        rpy_parent_rad=(0, 0, 0),
        range_rad=(-2.618, 2.618),
    ),
    Link(
        name="link2",
        pos_parent_m=(0, 0, 0),
        rpy_parent_rad=(1.5708, -0.1359, -3.1416),
        range_rad=(0.0, 3.14),
    ),
    Link(
        name="link3",
        pos_parent_m=(0.28503, 0, 0),
        rpy_parent_rad=(0, 0, -1.7939),
        range_rad=(-2.967, 0.0),
    ),
    Link(
        name="link4",
        pos_parent_m=(-0.021984, -0.25075, 0),
        rpy_parent_rad=(1.5708, 0, 0),
        range_rad=(-1.745, 1.745),
    ),
    Link(
        name="link5",
        pos_parent_m=(0, 0, 0),
        rpy_parent_rad=(-1.5708, 0, 0),
        range_rad=(-1.22, 1.22),
    ),
    Link(
        name="link6",
        pos_parent_m=(8.8259e-5, -0.091, 0),
        rpy_parent_rad=(1.5708, 0, 0),
        range_rad=(-2.0944, 2.0944),
    ),
)
_ARMS = ("left", "right")

BIMANUAL_PIPER = RobotSpec(
    arms=_ARMS,
    joints=("joint1", "joint2", "joint3", "joint4", "joint5", "joint6"),
    links=_LINKS,
    # J0 … J5 of the paper are joint1 … joint6 here. Table in Fig. "Per-joint controller SysID", App. B.1.
    kp_nm_per_rad=(1813.0, 1392.4, 974.8, 587.1, 151.1, 151.8),
    kd_nms_per_rad=(159.4, 123.7, 87.9, 69.8, 17.1, 16.5),
    torque_ff_nm=(0.12, -0.44, 0.04, -0.12, 1.73, 0.07),
    fingers=(
        "a",
        "b",
    ),  # a closes along −y of link 6, b along +y; pad left_a is the drivers' left_robot_left_finger
    finger_stroke_m=0.035,  # the gripper opens 70 mm (PiPER manual)
    finger_from_hand_m=0.1358,  # URDF
    tcp_from_hand_m=0.168,
    grip_force_max_n=40.0,  # PiPER gripper, rated clamping force
    pad=PadLayout(rows=32, columns=12, pitch_m=0.002),  # FlexiTac-V2, paper App. A
    pad_thickness_m=0.0036,  # FlexiTac simulation settings
    # The paper's three cameras (App. A): a fixed D415 in front, a D405 on each wrist. The mounts are ours, the paper gives none.
    camera_mounts=(
        CameraMount(
            name="front",
            model="d415",
            position_m=(0.87, 0.0, 0.54),
            look_at_m=(0.27, 0.0, 0.09),
        ),
        *(
            CameraMount(
                name=f"{arm}_wrist",
                body=f"{arm}_{_LINKS[-1].name}",
                model="d405",
                position_m=(-0.09, 0.0, 0.06),  # both pads show over the hand
                look_at_m=(0.0, 0.0, 0.2),
                up=(-1.0, 0.0, 0.0),  # fingers enter the picture from below
            )
            for arm in _ARMS
        ),
    ),
)


def _rows(about: Literal["link", "com"], *rows: tuple) -> tuple[Inertia, ...]:
    return tuple(
        Inertia(mass_kg=m, com_link_m=com, inertia_kgm2=inertia, about=about)
        for m, com, inertia in rows
    )


# kg, m, kg·m². The URDF writes its inertias as if about the centre of mass, but about the link frame they make sense:
# link 3 has 13.5e-3 of which 0.5 kg · (0.148 m)² = 11.0e-3, and 2.5e-3 is what a 0.5 kg rod of its length has.
# Link 3's Ixy has its sign turned: about the centre of mass no body could have it as listed (a negative eigenvalue).
# Link 6 and the gripper's base are one body; the flange's own 1.5e-3 (for 7 g!) is left out.
INERTIAS: dict[str, tuple[Inertia, ...]] = {
    "manufacturer": _rows(
        "link",
        (
            0.71,
            (0.00032, -0.00041, -0.00348),
            (0.00050027, 0.00040879, 0.00045802, 7.8e-7, 6.26e-6, 4.62e-6),
        ),
        (
            1.16,
            (0.21852, -0.00861, 0.00126),
            (0.00111915, 0.06763251, 0.067559, 0.00182916, 0.00019233, 7.67e-6),
        ),
        (
            0.50,
            (-0.01999, -0.14808, -0.00053),
            (0.01347608, 0.00046377, 0.01363321, -0.00161034, 6.6e-7, 1.62e-6),
        ),
        (
            0.38,
            (0.00013, -0.00076, -0.00394),
            (0.00017844, 0.00018914, 0.00014613, 6.2e-7, 6.7e-7, 4.08e-6),
        ),
        (
            0.383,
            (0.00018, -0.06104, -0.00227),
            (0.00172318, 0.00017936, 0.00171172, 2.59e-6, 1e-7, 9.9e-6),
        ),
        (0.457, (-0.000181, 0.00008, 0.03236), (0.000929, 0.000714, 0.000394, 0, 0, 0)),
    ),
    # Turned from Menagerie's link frames into the manufacturer's: same origins, about z by −90, −7.79, 100.78, 180, 180
    # and 0 degrees. The 1e-3 of links 5 and 6 are its placeholders.
    "menagerie": _rows(
        "com",
        (
            0.097868,
            (0.00031, -0.00132, -0.00923),
            (9.25e-5, 7.767e-5, 8.246e-5, -1.1e-7, 9.9e-7, 1.98e-6),
        ),
        (
            0.290889,
            (0.14709, -0.02256, 0.00175),
            (1.581e-4, 1.719e-3, 1.775e-3, 1.409e-4, -1.1e-6, -9.6e-7),
        ),
        (
            0.290848,
            (-0.01569, -0.10446, 0.00051),
            (2.218e-4, 1.009e-4, 2.419e-4, -7.58e-6, 6.4e-7, 8.2e-7),
        ),
        (
            0.127087,
            (-0.00028, 0.00103, -0.00473),
            (3.82e-5, 4.87e-5, 4.106e-5, -4.9e-8, -4.9e-8, -6.7e-8),
        ),
        (0.144711, (-0.00009, -0.05668, -0.00196), (1e-3, 1e-3, 1e-3, 0, 0, 0)),
        (1.2, (0.00103, 0.01218, 0.03155), (1e-3, 1e-3, 1e-3, 0, 0, 0)),
    ),
}
"""Source of the masses (``RobotConfig.inertias``) → inertia of each link, base to hand."""
FINGER_MASS_KG = {"manufacturer": 0.025, "menagerie": 0.0265}
"""Source of the masses → mass of one finger [kg]."""

WHITE, DARK = (0.90, 0.90, 0.88, 1), (0.16, 0.17, 0.19, 1)  # red, green, blue, opacity
STEEL, PAD_COLOR = (0.55, 0.57, 0.60, 1), (0.72, 0.74, 0.78, 1)
# Capsules of the arm's body: link, from, to [m], radius [m], colour
CAPSULES = (
    ("link1", (0, 0, -0.060), (0, 0, 0), 0.045, DARK),
    ("link2", (0, 0, -0.040), (0, 0, 0.040), 0.046, DARK),
    ("link2", (0, 0, 0), (0.285, 0, 0), 0.037, WHITE),
    ("link3", (0, 0, -0.040), (0, 0, 0.040), 0.042, DARK),
    ("link3", (0, 0, 0), (-0.021, -0.235, 0), 0.033, WHITE),
    ("link5", (0, 0, -0.030), (0, 0, 0.030), 0.032, DARK),
    ("link5", (0, 0, 0), (0, -0.070, 0), 0.026, WHITE),
    ("link6", (0, 0, 0), (0, 0, 0.055), 0.028, WHITE),
)
# Boxes of the hand on link 6: centre, half extents [m], colour
HAND_BOXES = (
    ((0, 0, 0.092), (0.022, 0.052, 0.026), DARK),
    ((-0.100, 0, 0.025), (0.012, 0.021, 0.011), STEEL),  # wrist camera
    ((-0.058, 0, 0.012), (0.045, 0.007, 0.005), DARK),  # and its bracket
)

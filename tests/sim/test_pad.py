"""Pads on a rig of two fingers that squeeze a part: depth, rate, batch, what they feel, and what the part's mass does."""

from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
from mujoco.batch import Batch

from taccorl.errors import TaccorlError
from taccorl.robots.robot_spec import PadLayout
from taccorl.sim.pad import KINEMATIC_FIELDS, OneSim, PadArray, Touch
from taccorl.sim.shapes import triangle_outline

PADS = ("a", "b")
STIFFNESS_N_PER_M = 1e4
PAD_CONTACT = (
    'friction=".01 .005 .0001" condim="4" solref=".004 1" solimp=".95 .99 .001 .5 2"'
)
SURFACE = 'friction="1 .005 .0001" condim="4"'
PARTS = {
    "box": f'<geom type="box" size=".01 .015 .02" {SURFACE}/>',
    "cylinder": f'<geom type="cylinder" size=".01 .02" {SURFACE}/>',
    "cylinder end on": f'<geom type="cylinder" size=".01 .02" euler="0 90 0" {SURFACE}/>',
    "capsule": f'<geom type="capsule" size=".01 .02" {SURFACE}/>',
    "sphere": f'<geom type="sphere" size=".012" {SURFACE}/>',
    "prism": f'<geom type="mesh" mesh="triangle" {SURFACE}/>',
    "tiled": f'<geom type="box" size=".01 .01 .01" pos="0 0 .01" {SURFACE}/>'
    f'<geom type="box" size=".01 .01 .01" pos="0 0 -.01" {SURFACE}/>',
}
SMALL = 'pos="0 0 0" diaginertia="1e-5 1e-5 1e-5"'


def finger_xml(pad: str, side: int, sprung: bool = True, tilts: bool = False) -> str:
    """A finger on the −x (side −1) or +x side that closes along x; its pad's rows run along z, palm below."""
    tilt = "".join(
        f'<joint name="{pad}_tilt_{name}" axis="{axis}" pos="{side * 0.0018} 0 0" stiffness="{stiffness}" damping=".05"/>'
        for name, axis, stiffness in (("y", "0 1 0", 10), ("z", "0 0 1", 4))
    )
    box = f'<geom name="{pad}" type="box" size=".0018 .012 .032" pos="{side * 0.0018} 0 0" {PAD_CONTACT}/>'
    spring = (
        '<body><inertial mass=".004" pos="0 0 0" diaginertia="1.4e-6 1.4e-6 2e-7"/>'
        f'<joint name="{pad}_spring" type="slide" axis="{side} 0 0" stiffness="{STIFFNESS_N_PER_M}" damping="30"/>'
        f"{tilt if tilts else ''}{box}</body>"
    )
    return (
        f'<body name="finger_{pad}" pos="{side * 0.02} 0 0"><inertial mass=".05" {SMALL}/>'
        f'<joint name="finger_{pad}" type="slide" axis="{-side} 0 0" damping="20"/>'
        f'<geom name="bone_{pad}" type="box" size=".004 .011 .04" pos="{side * 0.0081} 0 0"/>'
        f'<site name="{pad}" xyaxes="0 {-side} 0 0 0 1"/>{spring if sprung else box}</body>'
    )


def model_of(bodies: str) -> mujoco.MjModel:
    # A triangle of 30 mm; a side faces finger a, the corner opposite points to finger b.
    outline = triangle_outline(0.03).tolist()
    triangle = " ".join(f"{y} {-x} {z}" for z in (-0.01, 0.01) for x, y in outline)
    return mujoco.MjModel.from_xml_string(
        '<mujoco><option timestep=".002" integrator="discrete" cone="elliptic" impratio="50"/>'
        f'<asset><mesh name="triangle" vertex="{triangle}"/></asset><worldbody>{bodies}</worldbody>'
        '<actuator><motor name="a" joint="finger_a"/><motor name="b" joint="finger_b"/></actuator></mujoco>'
    )


def rig(
    part: str,
    mass_kg: float = 0.04,
    sprung: bool = True,
    tilts: bool = False,
    height_m: float = 0.0,
) -> mujoco.MjModel:
    """Two fingers and a part that hangs between them by friction."""
    solids = (
        f'<freejoint name="part"/><inertial mass="{mass_kg}" {SMALL}/>{PARTS[part]}'
    )
    body = f'<body name="part" pos="0 0 {height_m}">{solids}</body>'
    return model_of(
        finger_xml("a", -1, sprung, tilts) + finger_xml("b", 1, sprung, tilts) + body
    )


def squeezed(
    model: mujoco.MjModel, force_n: float, time_s: float = 0.6
) -> mujoco.MjData:
    """After squeezing from rest with this force on each finger."""
    data = mujoco.MjData(model)
    data.ctrl[:] = force_n
    while data.time < time_s:
        mujoco.mj_step(model, data)
    mujoco.mj_forward(model, data)
    return data


def state_of(fields: dict[str, np.ndarray]) -> Any:
    """Arrays as ``Kinematics``."""
    return SimpleNamespace(**fields)


def touch_of(model: mujoco.MjModel, data: mujoco.MjData) -> Touch:
    return PadArray(model, PADS).touch(OneSim(data))


# ---- where and how deep ----


def test_ball_is_felt_at_the_row_and_column_where_it_is() -> None:
    """Rows run from the palm (−z) to the tip (+z), columns along the pad's x, which is +y on finger a and −y on b."""
    row, column, radius_m, depth_m = 28, 2, 0.004, 0.0005
    z, y = (row - 15.5) * 0.002, (column - 5.5) * 0.002
    ball = f'<body name="part" pos="{-0.02 - depth_m + radius_m} {y} {z}"><freejoint/><geom size="{radius_m}"/></body>'
    model = model_of(finger_xml("a", -1) + finger_xml("b", 1) + ball)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    pads = PadArray(model, PADS)
    deep = pads.penetration(OneSim(data)).depth_m.reshape(2, 32, 12)
    assert deep[1].max() == 0
    # A taxel 2 mm beside the deepest is √((R − d)² + (2 mm)²) from the ball's middle.
    beside = radius_m - np.hypot(radius_m - depth_m, 0.002)
    assert beside < 0
    assert deep[0, row, column] == pytest.approx(depth_m, abs=1e-9)
    assert np.count_nonzero(deep) == 1
    model.body_pos[model.body("part").id] += (-2 * (-0.02 - depth_m + radius_m), 0, 0)
    mujoco.mj_resetData(model, data)
    data.qpos[-7] *= -1  # the same ball in front of finger b
    mujoco.mj_forward(model, data)
    deep = pads.penetration(OneSim(data)).depth_m.reshape(2, 32, 12)
    assert np.argwhere(deep[1]).tolist() == [[row, 11 - column]]
    assert pads.taxel_pos_pad[row * 12 + column] == pytest.approx([y, z, 0])


def test_taxels_lie_as_the_layout_says() -> None:
    """3 rows × 2 columns, 4 mm apart: x = ∓2 mm, y = −4, 0, 4 mm. A ball over row 2, column 0 is felt there only."""
    layout = PadLayout(rows=3, columns=2, pitch_m=0.004)
    radius_m, depth_m = 0.004, 0.0005
    ball = f'<body name="part" pos="{-0.02 - depth_m + radius_m} -0.002 0.004"><freejoint/><geom size="{radius_m}"/></body>'
    model = model_of(finger_xml("a", -1) + finger_xml("b", 1) + ball)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    pads = PadArray(model, PADS, layout)
    expected = [(-2, -4), (2, -4), (-2, 0), (2, 0), (-2, 4), (2, 4)]
    np.testing.assert_allclose(pads.taxel_pos_pad[:, :2] * 1e3, expected, atol=1e-12)
    deep = pads.penetration(OneSim(data)).depth_m
    assert deep.shape == (1, 2, 6)
    assert np.argwhere(deep[0]).tolist() == [[0, 4]]
    assert deep[0, 0, 4] == pytest.approx(depth_m, abs=1e-9)


def test_all_parts_on_one_pad_are_felt_and_of_those_at_one_taxel_the_deepest() -> None:
    """Balls of 4 mm radius, 0.3, 0.5 and 0.4 mm deep; two at the taxel of row 20 and column 5, one at row 8."""
    places = {"one": (20, 0.3e-3), "two": (20, 0.5e-3), "three": (8, 0.4e-3)}
    balls = "".join(
        f'<body name="{name}" pos="{-0.02 - depth_m + 0.004} -.001 {(row - 15.5) * 0.002}"><freejoint/><geom size=".004"/></body>'
        for name, (row, depth_m) in places.items()
    )
    model = model_of(finger_xml("a", -1) + finger_xml("b", 1) + balls)
    data = mujoco.MjData(model)
    for name, speed in (("one", 0.01), ("two", 0.02), ("three", 0.03)):
        data.qvel[model.body(name).dofadr[0]] = -speed
    mujoco.mj_forward(model, data)
    touch = PadArray(model, PADS).penetration(OneSim(data))
    deep, rate = (a[0, 0].reshape(32, 12) for a in touch)
    assert np.argwhere(deep).tolist() == [[8, 5], [20, 5]]
    assert deep[[8, 20], 5] == pytest.approx([0.4e-3, 0.5e-3], abs=1e-9)
    assert rate[[8, 20], 5] == pytest.approx([0.03, 0.02], abs=1e-8)


@pytest.mark.parametrize("tilts", [False, True])
@pytest.mark.parametrize("part", PARTS)
def test_rate_is_the_central_difference_of_the_depth_along_any_motion(
    part: str, tilts: bool
) -> None:
    """Of plain penetration and of what sprung pads read; part, fingers and pads move and turn at random."""
    model = rig(part, tilts=tilts)
    data = squeezed(model, 10.0)
    pads, state = PadArray(model, PADS), OneSim(data)
    start = data.qpos.copy()
    rng = np.random.default_rng(0)
    step_s = 1e-4  # depth in single precision is good to some 1e-9 m
    compared = fastest = 0.0
    for _ in range(8):
        speed = rng.normal(0, 0.02, model.nv)
        speed[model.joint("part").dofadr[0] + 3 :] = rng.normal(0, 1.0, 3)
        data.qvel[:] = speed
        felt: dict[str, list[Touch]] = {"penetration": [], "touch": []}
        for time_s in (-step_s, 0.0, step_s):
            data.qpos[:] = start
            mujoco.mj_integratePos(model, data.qpos, speed, time_s)
            mujoco.mj_forward(model, data)
            for name, touches in felt.items():
                touches.append(getattr(pads, name)(state))
        for before, now, after in felt.values():
            # Not where a face, an edge or the deepest taxel takes turns with another.
            bend = np.abs(after.depth_m - 2.0 * now.depth_m + before.depth_m)
            smooth = (before.depth_m > 0) & (after.depth_m > 0) & (bend < 1e-8)
            difference = (after.depth_m.astype(float) - before.depth_m) / (2 * step_s)
            assert np.abs(now.depth_rate_mps - difference)[smooth].max(initial=0) < 1e-4
            compared += smooth.sum()
            fastest = max(
                fastest, float(np.abs(now.depth_rate_mps[smooth]).max(initial=0))
            )
    assert compared > 50
    assert fastest > 0.02


# ---- batch ----


@pytest.mark.parametrize("part", ["tiled", "cylinder", "prism"])
def test_batch_gives_the_bits_of_each_sim_alone(part: str) -> None:
    model = rig(part)
    data = squeezed(model, 10.0)
    state = np.zeros(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_INTEGRATION))
    mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_INTEGRATION)
    num_sims = 70
    batch = Batch(model, num_sims, 1)
    batch.state[:] = state
    rng = np.random.default_rng(1)
    joint = model.joint("part")
    batch.qpos[:, joint.qposadr[0] : joint.qposadr[0] + 3] += rng.normal(
        0, 0.002, (num_sims, 3)
    )
    batch.qvel[:] = rng.normal(0, 0.05, (num_sims, model.nv))
    bound = {field: batch.bind(field) for field in KINEMATIC_FIELDS}
    batch.forward()
    pads = PadArray(model, PADS)
    together = pads.touch(batch)
    assert (together.depth_m.max(axis=(1, 2)) > 0).mean() > 0.5
    assert len(np.unique(together.depth_m.sum(axis=2))) > num_sims / 2
    one = mujoco.MjData(model)
    for sim in range(num_sims):
        batch.get_data(sim, one)
        mujoco.mj_forward(model, one)
        row = state_of({field: array[sim : sim + 1] for field, array in bound.items()})
        for alone in (pads.touch(row), pads.touch(OneSim(one))):
            assert alone.depth_m.tobytes() == together.depth_m[sim].tobytes()
            assert (
                alone.depth_rate_mps.tobytes() == together.depth_rate_mps[sim].tobytes()
            )


def test_sim_that_diverged_reads_nothing_and_leaves_the_others_alone() -> None:
    model = rig("box")
    data = squeezed(model, 10.0, time_s=0.1)
    fields = {
        field: np.repeat(getattr(data, field)[None], 3, axis=0)
        for field in KINEMATIC_FIELDS
    }
    pads = PadArray(model, PADS)

    sound = pads.touch(state_of(fields))
    for array in fields.values():
        array[1] = np.nan
    touch = pads.touch(state_of(fields))
    for now, before in zip(touch, sound, strict=True):
        assert not now[1].any()
        assert (now[[0, 2]] == before[[0, 2]]).all()


def test_fields_bound_after_the_last_step_are_refused() -> None:
    model = rig("box")
    batch = Batch(model, 2, 1)
    said = (
        r"site 'a' has no orientation: bind site_xpos, .* before the batch's last step"
    )
    with pytest.raises(TaccorlError, match=said):
        PadArray(model, PADS).touch(batch)


# ---- mass ----


def readings_m(part: str, sprung: bool, force_n: float = 10.0) -> np.ndarray:
    """(2 masses, 2 pads): deepest taxel under a part of 40 and of 300 g."""
    return np.array(
        [
            (lambda m: touch_of(m, squeezed(m, force_n)).depth_m[0].max(axis=1))(
                rig(part, mass_kg, sprung)
            )
            for mass_kg in (0.04, 0.3)
        ]
    )


@pytest.mark.parametrize(
    "part", ["box", "cylinder", "cylinder end on", "sphere", "tiled"]
)
def test_sprung_pads_read_the_grip_force_whatever_the_parts_mass(part: str) -> None:
    for force_n in (2.5, 10.0):
        assert readings_m(part, True, force_n) == pytest.approx(
            force_n / STIFFNESS_N_PER_M, rel=1e-3
        )


@pytest.mark.parametrize("part", ["box", "cylinder", "sphere", "tiled"])
def test_pads_that_tilt_read_the_same_under_a_light_and_a_heavy_part(part: str) -> None:
    """Gripped 20 mm from the pads' middle."""
    touches = []
    for mass_kg in (0.04, 0.3):
        model = rig(part, mass_kg, tilts=True, height_m=0.02)
        data = squeezed(model, 10.0)
        tilt_rad = abs(data.joint("a_tilt_y").qpos[0])
        assert tilt_rad > 0.005
        touches.append(touch_of(model, data).depth_m[0])
        if (
            part == "sphere"
        ):  # one spot: pressed in by 10 N / K and by the tilt times its distance from the middle
            assert touches[-1].max() == pytest.approx(
                0.001 + tilt_rad * data.body("part").xpos[2], rel=0.01
            )
    light, heavy = touches
    assert heavy.max(axis=1) == pytest.approx(light.max(axis=1), rel=0.025)
    assert heavy.sum(axis=1) == pytest.approx(light.sum(axis=1), rel=0.05)


def test_prism_on_its_side_reads_the_force_on_the_flat_pad() -> None:
    assert readings_m("prism", True)[:, 0] == pytest.approx(0.001, rel=1e-3)


def test_deepest_taxel_moves_as_the_spring_does() -> None:
    model = rig("box")
    data = squeezed(model, 10.0, time_s=0.05)  # still closing
    touch = touch_of(model, data)
    for p, pad in enumerate(PADS):
        spring = data.joint(f"{pad}_spring")
        deepest = touch.depth_m[0, p].argmax()
        assert abs(spring.qvel[0]) > 1e-4
        assert touch.depth_m[0, p, deepest] == pytest.approx(spring.qpos[0], abs=1e-9)
        assert touch.depth_rate_mps[0, p, deepest] == pytest.approx(
            spring.qvel[0], abs=1e-7
        )


def test_plate_that_tilts_is_pressed_in_by_a_plane() -> None:
    """Finger a, plate in by 1 mm and turned by 0.02 rad about +y (its pivot 1.8 mm behind the surface) and −0.01 rad about z.

    About y the tip (+z) goes to +x, out of the finger, by z · tan 0.02; about z the +y side goes to +x by y · tan 0.01."""
    model = rig("box", tilts=True)
    data = mujoco.MjData(model)
    data.joint("a_spring").qpos[:] = 0.001
    data.joint("a_tilt_y").qpos[:], data.joint("a_tilt_z").qpos[:] = 0.02, -0.01
    mujoco.mj_forward(model, data)
    pads = PadArray(model, PADS)
    compression = pads.compression(OneSim(data))
    across, along, _ = pads.taxel_pos_pad.T  # pad x is +y in the world, pad y is +z
    expected = 0.001 - np.tan(0.02) * along - np.tan(0.01) * across
    # Plus second-order terms of the pivot's 1.8 mm: 1.8e-3 · 2.5e-4 = 0.5 µm.
    assert compression.depth_m[0, 0] == pytest.approx(expected, abs=2e-6)
    assert compression.depth_m[0, 1] == pytest.approx(0, abs=1e-9)


# ---- what is felt ----


def gripper(extra: str = "") -> mujoco.MjModel:
    """Both fingers on one hand that moves, closed so far that the pads overlap by 1 mm."""
    hand = f'<body name="hand"><inertial mass="1" {SMALL}/><joint type="slide"/>{finger_xml("a", -1)}{finger_xml("b", 1)}</body>'
    return model_of(hand + extra)


def test_closing_on_nothing_the_pads_feel_each_other_but_not_the_hands_bones() -> None:
    model = gripper()
    data = mujoco.MjData(model)
    data.joint("finger_a").qpos[:] = data.joint("finger_b").qpos[:] = 0.0205
    mujoco.mj_forward(model, data)
    deep = PadArray(model, PADS).penetration(OneSim(data)).depth_m
    # Each site is 0.5 mm beyond the middle: 1 mm inside the other pad's box of 3.6 × 24 × 64 mm; 1 mm from its rim, too.
    assert deep == pytest.approx(0.001, abs=1e-8)
    # Through the other pad (3.6 mm) into its bone: only the pad is felt, from behind less and less.
    data.joint("finger_a").qpos[:] = data.joint("finger_b").qpos[:] = 0.0225
    mujoco.mj_forward(model, data)
    assert PadArray(model, PADS).penetration(OneSim(data)).depth_m.max() == 0


def test_other_arms_and_the_table_are_felt() -> None:
    other = '<body name="elbow" pos="-.018 0 .03"><joint type="slide"/><geom size=".005"/></body>'
    table = '<geom name="table" type="plane" size="1 1 1" pos="0 0 -.03"/>'
    for extra, low, high in ((other, 24, 32), (table, 0, 1)):
        model = gripper(extra)
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        rows = np.argwhere(
            PadArray(model, PADS)
            .penetration(OneSim(data))
            .depth_m[0, 0]
            .reshape(32, 12)
        )[:, 0]
        assert len(rows)
        assert low <= rows.min() <= rows.max() <= high


def test_geoms_that_do_not_collide_are_not_felt() -> None:
    ghost = '<body pos="-.018 0 .03"><joint type="slide"/><geom size=".005" contype="0" conaffinity="0"/></body>'
    model = gripper(ghost)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert not PadArray(model, PADS).penetration(OneSim(data)).depth_m.any()


# ---- names ----


def test_sprung_pads_are_named_and_an_unknown_pad_is_refused_with_the_nearest_name() -> (
    None
):
    assert PadArray(rig("box"), PADS).sprung == PADS
    assert PadArray(rig("box", sprung=False), PADS).sprung == ()
    with pytest.raises(
        TaccorlError,
        match=r"pad 'bone_c': the model has no site of that name; known: a, b",
    ):
        PadArray(rig("box"), ("a", "bone_c"))


def test_plain_penetration_of_sprung_pads_still_holds_the_sinking() -> None:
    light, heavy = (
        PadArray(m, PADS).penetration(OneSim(squeezed(m, 10.0))).depth_m.max(axis=2)
        for m in (rig("sphere", 0.04), rig("sphere", 0.3))
    )
    assert (light > 1.15 * heavy).all()

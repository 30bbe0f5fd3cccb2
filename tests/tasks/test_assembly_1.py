"""Assembly #1: what counts as in, what as wedged, and the misses that come close."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from taccorl.errors import TaccorlError
from taccorl.sim.outcome import Judge
from taccorl.sim.part import Mate
from taccorl.sim.randomize import draw
from taccorl.sim.simulation import Simulation
from taccorl.sim.task import Contact
from taccorl.tasks.air_assembly.scene import HOLDER_AT_M, PLUG_AT_M
from taccorl.tasks.assembly_1.scene import Assembly1

TASK = Assembly1()
MATE = cast(Mate, TASK.plug.mate)
IN: dict[str, Any] = {"depth_mm": 36.0}  # in the socket, let go, at rest


def placed(
    depth_mm: float,
    tilt_deg: float = 0.0,
    aside_mm: float = 0.0,
    turned_deg: float = 0.0,
    speed_mps: float = 0.0,
    pads: tuple[int, ...] = (),
    force_n: float = 0.0,
    height_m: float = 0.16,
) -> dict:
    """One scene: the socket in the air, the plug's tip ``depth_mm`` behind its mouth; the socket moves, too."""
    socket = np.eye(4)
    socket[:3, :3] = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]).T
    socket[:3, 3] = (0.32, 0.03, height_m)
    mate = np.eye(4)
    mate[:3, :3] = Rotation.from_euler("zx", (turned_deg, tilt_deg), degrees=True).as_matrix()
    mate[:3, 3] = (aside_mm / 1e3, 0, depth_mm / 1e3)
    plug = socket @ TASK.holder.holes["mortise"].part_from_hole @ mate @ np.linalg.inv(MATE.part_from_mate)
    drift = np.array((0.1, 0, 0))  # both hands move together: what counts is the one against the other
    return {
        "poses": {"plug": plug, "socket": socket},
        "velocities": {"plug": np.add(drift, (0, speed_mps, 0)), "socket": drift},
        "pads": [k in pads for k in range(4)],
        "force_n": force_n,
    }


def scene(*cases: dict) -> Any:
    """N scenes, one a row."""
    forces = np.array([case["force_n"] for case in cases])
    contact = Contact(forces > 0, np.zeros(len(cases)), forces)
    pads = {
        "plug": np.array([case["pads"] for case in cases]),
        "socket": np.tile([True, True, False, False], (len(cases), 1)),
    }
    return SimpleNamespace(
        num_sims=len(cases),
        diverged=np.zeros(len(cases), bool),
        poses=lambda body: np.stack([case["poses"][body] for case in cases]),
        velocities=lambda body: np.stack([case["velocities"][body] for case in cases]),
        pads_touching=lambda body: pads[body],
        contact=lambda body, other: contact,
    )


# success ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("case", "goal"),
    [
        (IN, True),
        ({"depth_mm": 34.1}, True),
        ({"depth_mm": 33.9}, False),  # not deep enough
        (IN | {"pads": (2,)}, False),  # one pad still touches it
        (IN | {"pads": (0,)}, False),  # even the other hand's
        (IN | {"speed_mps": 0.021}, False),  # in flight through the socket
        (IN | {"speed_mps": 0.019}, True),
        (IN | {"tilt_deg": 1.9}, True),
        (IN | {"tilt_deg": 2.1}, False),
        (IN | {"turned_deg": 180.0}, True),  # the tenon looks the same
        (IN | {"aside_mm": 4.0}, False),  # beside the socket, as deep
    ],
)
def test_the_plug_is_in_when_deep_straight_let_go_and_at_rest(case, goal):
    assert TASK.look(scene(placed(**case))).goal.tolist() == [goal]


def test_each_simulation_is_looked_at_on_its_own():
    verdict = TASK.look(scene(placed(**IN), placed(10.0), placed(36.0, pads=(3,))))
    assert verdict.goal.tolist() == [True, False, False]
    assert verdict.partial.tolist() == [1, 0, 1]  # in place counts as partial while it is still held
    np.testing.assert_allclose(verdict.measures["depth_m"], (0.036, 0.010, 0.036), atol=1e-12)


def test_where_it_is_easy_the_plug_may_hang_by_what_the_play_allows():
    # 2 · 1.0 mm / 34 mm = 3.37°, 15 % more is 3.88°
    easy = Assembly1("easy")
    assert easy.look(scene(placed(36.0, tilt_deg=3.4))).goal[0]
    assert not easy.look(scene(placed(36.0, tilt_deg=4.1))).goal[0]
    assert Assembly1("hard").in_tilt_rad == TASK.in_tilt_rad == pytest.approx(np.deg2rad(2))


def test_an_unknown_difficulty_is_named_with_a_near_one():
    with pytest.raises(TaccorlError, match=r"hart.*did you mean.*hard"):
        Assembly1("hart")


# failure ----------------------------------------------------------------------------------------------------------------


def after(seconds: float, *cases: dict) -> list[str]:
    judge, seen = Judge(TASK, len(cases), 30), scene(*cases)
    judge.reset(np.arange(len(cases)), seen)
    for _ in range(round(seconds * 30)):
        judge.update(seen)
    return judge.outcome.failure.tolist()


def test_a_plug_that_is_pressed_half_way_in_for_a_second_is_wedged():
    pressed = placed(20.0, force_n=16.0, pads=(2, 3))
    assert after(0.9, pressed) == [""]
    assert after(1.0, pressed) == ["wedged"]


@pytest.mark.parametrize(
    "case",
    [
        {"depth_mm": 20.0, "force_n": 14.0},  # a push that people call gentle
        {"depth_mm": 3.0, "force_n": 20.0},  # on the rim
        {"depth_mm": 31.0, "force_n": 20.0},  # home
    ],
)
def test_a_push_elsewhere_or_a_gentle_one_is_no_wedge(case):
    assert after(2.0, placed(pads=(2, 3), **case)) == [""]


@pytest.mark.parametrize("depth_mm", [-1.9, 0.0, 20.0])  # on the socket's face, and past it
def test_a_plug_that_touches_the_socket_beside_the_mortise_for_a_second_is_sliding(depth_mm):
    beside = placed(depth_mm, aside_mm=5.0, force_n=1.0, pads=(2, 3))
    assert after(0.9, beside) == [""]
    assert after(1.0, beside) == ["sliding"]


@pytest.mark.parametrize(
    "case",
    [
        {"depth_mm": -1.0, "aside_mm": 2.9, "force_n": 10.0},  # at the mortise's edge, where aiming again helps
        {"depth_mm": -2.1, "aside_mm": 5.0, "force_n": 10.0},  # another place of the parts touches
        {"depth_mm": 20.0, "aside_mm": 5.0, "force_n": 0.0},  # beside the socket, without contact
    ],
)
def test_a_plug_at_the_edge_or_without_contact_is_not_sliding(case):
    assert after(2.0, placed(pads=(2, 3), **case)) == [""]


def test_a_part_below_the_table_or_beyond_it_is_dropped_at_once():
    fallen = placed(-300.0, height_m=-0.03)
    assert after(1 / 30, fallen, placed(-300.0)) == ["dropped", ""]


# the bench --------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def sim() -> Simulation:
    return Simulation(Assembly1())


def test_both_parts_lie_on_the_table_within_the_papers_ranges(sim):
    assert [row.name for row in TASK.rows] == [
        "friction", "plug_position", "socket_position", "plug_mass", "socket_mass",
    ]  # fmt: skip
    corners = []
    for seed in range(40):
        reset = TASK.reset(draw(Assembly1.rows, np.random.default_rng(seed)))
        for part, at in (("plug", PLUG_AT_M), ("socket", HOLDER_AT_M)):
            shift = reset.poses[part][:2] - at
            assert np.abs(shift).max() <= 0.03
            assert abs(reset.mass_change_kg[part]) <= 0.03
            corners.append(np.abs(shift).max())
    assert max(corners) > 0.027  # the ranges are used
    for seed in (1, 7, 30):  # lying means: a tenth of a second later they lie where they were put, to a hair
        sim.reset([seed])
        before = {part: sim.poses(part)[0].copy() for part in TASK.parts}
        for _ in range(3):
            sim.step(sim.arrays["ctrl"][:, sim.action_actuators])
        for part, pose in before.items():
            np.testing.assert_allclose(sim.poses(part)[0], pose, atol=5e-4)


def test_the_axes_lie_along_y_mating_ends_towards_each_other(sim):
    sim.reset([3])
    hole = sim.poses("socket")[0] @ TASK.holder.holes["mortise"].part_from_hole
    mate = sim.poses("plug")[0] @ MATE.part_from_mate
    np.testing.assert_allclose(hole[:3, 2], (0, 1, 0), atol=1e-6)
    np.testing.assert_allclose(mate[:3, 2], (0, 1, 0), atol=1e-6)
    assert hole[1, 3] - mate[1, 3] > 0.2


def test_a_plug_that_lies_in_the_socket_succeeds_after_half_a_second_and_not_before(sim):
    sim.reset([0])
    mate_from_plug = np.linalg.inv(MATE.part_from_mate)
    put(sim, "plug", sim.poses("socket")[0] @ lifted(0.036) @ mate_from_plug)
    still = sim.arrays["ctrl"][:, sim.action_actuators].copy()
    held = 0
    while not sim.judge.outcome.over[0] and held < 60:
        sim.step(still)
        held += 1
    assert sim.judge.outcome.success[0]
    assert 15 <= held <= 24  # 0.5 s, after it has come to rest on the mortise's floor
    assert sim.judge.verdict.measures["tilt_rad"][0] < np.deg2rad(2)


def lifted(depth_m: float) -> np.ndarray:
    pose = np.eye(4)
    pose[2, 3] = depth_m
    return pose


def put(sim: Simulation, part: str, pose: np.ndarray) -> None:
    at = sim.model.joint(part).qposadr[0]
    sim.arrays["qpos"][0, at : at + 7] = np.r_[
        pose[:3, 3], Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True)
    ]
    sim.batch.forward(np.array([0]))


# subtasks ---------------------------------------------------------------------------------------------------------------


def test_a_grasp_is_done_when_its_part_is_three_centimetres_up():
    low, high = placed(-200.0, height_m=0.029), placed(-200.0, height_m=0.031)
    for arm in ("left", "right"):
        assert TASK.subtasks()[arm][0].done(scene(low, high)).tolist() == [False, True]
        assert TASK.subtasks()[arm][1].done(scene(high, placed(**IN))).tolist() == [False, True]

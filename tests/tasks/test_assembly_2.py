"""Assembly #2: the cradle carries the plug only where its centre of mass is inside; predicates, near misses, and the physics."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from taccorl.sim.outcome import Judge
from taccorl.sim.part import Mate
from taccorl.sim.randomize import draw
from taccorl.sim.simulation import Simulation
from taccorl.sim.task import Contact
from taccorl.tasks.assembly_2.scene import Assembly2

TASK = Assembly2()
MATE = cast(Mate, TASK.plug.mate)
# Of the plug, from its tip: 28.8 g of plastic, split by volume 20·20·36 : 24·20·30 = 1 : 1 at 18 and 51 mm, and a 41.2 g core
# at 8.2 mm: (14.4 · 18 + 14.4 · 51 + 41.2 · 8.2) / 70
COM_MM = 19.02
IN: dict[str, Any] = {"depth_mm": 33.0}


def placed(
    depth_mm: float,
    tilt_deg: float = 0.0,
    aside_mm: float = 0.0,
    speed_mps: float = 0.0,
    pads: tuple[int, ...] = (),
    touching: bool = True,
    height_m: float = 0.16,
) -> dict:
    """One scene: the cradle level in the air, its open side up, the plug's tip ``depth_mm`` behind its mouth."""
    cradle = np.eye(4)
    cradle[:3, :3] = np.array([[-1.0, 0, 0], [0, 0, 1], [0, 1, 0]]).T
    cradle[:3, 3] = (0.32, 0.03, height_m)
    mate = np.eye(4)
    mate[:3, :3] = Rotation.from_euler("x", tilt_deg, degrees=True).as_matrix()
    mate[:3, 3] = (aside_mm / 1e3, 0, depth_mm / 1e3)
    plug = cradle @ TASK.holder.holes["cradle"].part_from_hole @ mate @ np.linalg.inv(MATE.part_from_mate)
    return {
        "poses": {"plug": plug, "cradle": cradle},
        "velocities": {"plug": np.array((0, 0, -speed_mps)), "cradle": np.zeros(3)},
        "pads": [k in pads for k in range(4)],
        "touching": touching,
    }


def scene(*cases: dict) -> Any:
    """N scenes, one a row."""
    touching = np.array([case["touching"] for case in cases])
    contact = Contact(touching, np.zeros(len(cases)), touching * 0.7)
    pads = np.array([case["pads"] for case in cases])
    return SimpleNamespace(
        num_sims=len(cases),
        diverged=np.zeros(len(cases), bool),
        poses=lambda body: np.stack([case["poses"][body] for case in cases]),
        velocities=lambda body: np.stack([case["velocities"][body] for case in cases]),
        pads_touching=lambda body: pads,
        contact=lambda body, other: contact,
    )


# predicates -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("case", "goal"),
    [
        (IN, True),
        ({"depth_mm": COM_MM + 2.1}, True),
        ({"depth_mm": COM_MM + 1.9}, False),  # over the lip by a hair: the rim of the predicate
        (IN | {"touching": False, "speed_mps": 0.2}, False),  # in flight above the cradle
        (IN | {"touching": False}, False),  # at the top of its flight
        (IN | {"speed_mps": 0.03}, False),  # sliding
        (IN | {"pads": (2, 3)}, False),  # still held
        (IN | {"tilt_deg": 6.0}, False),  # leaning on a wall
        (IN | {"aside_mm": 5.0}, False),
    ],
)
def test_the_plug_is_carried_when_its_centre_of_mass_is_inside_and_nothing_else_holds_it(case, goal):
    assert TASK.look(scene(placed(**case))).goal.tolist() == [goal]


def test_the_centre_of_mass_is_the_parts_own_and_a_change_of_mass_leaves_it_where_it_is():
    assert TASK.com_from_tip_m * 1e3 == pytest.approx(COM_MM, abs=0.02)
    sim = Simulation(TASK)
    body = sim.model.body("plug")
    assert sim.model.body_ipos[body.id, 1] == pytest.approx(0, abs=1e-9)
    np.testing.assert_allclose(sim.model.body_ipos[body.id], TASK.plug.com_part_m, atol=1e-7)
    reset = TASK.reset(draw(Assembly2.rows, np.random.default_rng(1)))
    assert set(reset.mass_change_kg) == {"plug", "cradle"}  # the table's socket is the cradle


def after(seconds: float, *cases: dict) -> list[str]:
    judge, seen = Judge(TASK, len(cases), 30), scene(*cases)
    judge.reset(np.arange(len(cases)), seen)
    for _ in range(round(seconds * 30)):
        judge.update(seen)
    return judge.outcome.failure.tolist()


def test_a_plug_in_the_air_that_nothing_touches_has_fallen_out():
    falling = placed(10.0, touching=False, speed_mps=0.5)
    assert after(0.07, falling) == [""]  # it may hop while it is let down
    assert after(0.1, falling) == ["fell_out"]


def test_a_plug_on_the_table_has_not_fallen_out_of_anything():
    on_table = placed(-300.0, touching=False, height_m=0.02)
    assert after(2.0, on_table) == [""]


def test_a_plug_that_hangs_over_the_lip_for_a_second_is_unsupported():
    hanging = placed(15.0, tilt_deg=12.0)
    assert after(0.9, hanging) == [""]
    assert after(1.0, hanging, placed(15.0, pads=(2, 3))) == ["unsupported", ""]  # the hand may hold it there


def test_a_part_beyond_the_table_is_dropped():
    assert after(1 / 30, placed(-300.0, height_m=-0.03), placed(-300.0)) == ["dropped", ""]


# the physics ------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def sim() -> Simulation:
    return Simulation(TASK, scale=0.0)


def left_to_itself(sim: Simulation, depth_m: float) -> str:
    """The plug is set into the cradle, which lies on the table: 9.5 mm under the plug, enough for it to tip over the lip."""
    sim.reset([0])
    mate = np.eye(4)
    mate[:3, 3] = (0, 1e-4 - TASK.clearance_m, depth_m)
    put(sim, "plug", sim.poses("cradle")[0] @ mate @ np.linalg.inv(MATE.part_from_mate))
    still = sim.arrays["ctrl"][:, sim.action_actuators].copy()
    for _ in range(60):
        sim.step(still)
        if sim.judge.outcome.over[0]:
            break
    outcome = sim.judge.outcome
    return "success" if outcome.success[0] else str(outcome.failure[0])


def put(sim: Simulation, part: str, pose: np.ndarray) -> None:
    joint = sim.model.joint(part)
    at, speed = joint.qposadr[0], joint.dofadr[0]
    quat = Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True)
    sim.arrays["qpos"][0, at : at + 7] = np.r_[pose[:3, 3], quat]
    sim.arrays["qvel"][0, speed : speed + 6] = 0.0
    sim.batch.forward(np.array([0]))


@pytest.mark.parametrize(
    ("depth_mm", "ends_as"),
    [(12.0, "unsupported"), (17.0, "unsupported"), (21.5, "success"), (23.0, "success"), (33.0, "success")],
)
def test_the_cradle_carries_the_plug_where_its_centre_of_mass_is_inside(sim, depth_mm, ends_as):
    assert left_to_itself(sim, depth_mm / 1e3) == ends_as


def test_the_cradle_lies_with_its_open_side_up_and_its_mouth_towards_the_plug(sim):
    sim.reset([0])
    np.testing.assert_allclose(sim.poses("cradle")[0][:3, 1:3], np.array([(0, 0, 1), (0, 1, 0)]).T, atol=1e-6)
    np.testing.assert_allclose(sim.poses("plug")[0][:3, 1:3], np.array([(0, 0, 1), (0, -1, 0)]).T, atol=1e-6)

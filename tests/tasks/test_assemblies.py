"""Both assemblies: what counts as in, what as a failure, the misses that come close, and the physics of the cradle."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from task_scenes import pose_at, stay

from taccorl.sim.outcome import Judge
from taccorl.sim.randomize import draw
from taccorl.sim.simulation import Simulation
from taccorl.sim.task import Contact
from taccorl.tasks.air_assembly.scene import HOLDER_AT_M, PLUG_AT_M, AirAssembly
from taccorl.tasks.assembly_1.scene import Assembly1
from taccorl.tasks.assembly_2.scene import Assembly2

ONE, TWO = Assembly1(), Assembly2()
BOTH = pytest.mark.parametrize("task", [ONE, TWO], ids=lambda task: task.name)
# Of the second's plug, from its tip: 28.8 g of plastic, split by volume 20·20·36 : 24·20·30 = 1 : 1 at 18 and 51 mm, and a
# 41.2 g core at 8.2 mm: (14.4 · 18 + 14.4 · 51 + 41.2 · 8.2) / 70
COM_MM = 19.02
DEPTH_MM = {"assembly_1": 36.0, "assembly_2": 33.0}  # in the hole, let go, at rest
HOLDER_AXES = {
    "socket": [[0.0, 0, 1], [1, 0, 0], [0, 1, 0]],
    "cradle": [[-1.0, 0, 0], [0, 0, 1], [0, 1, 0]],
}


def plug_from_tip(task: AirAssembly) -> np.ndarray:
    assert task.plug.mate is not None
    return np.linalg.inv(task.plug.mate.part_from_mate)


def placed(
    task: AirAssembly,
    depth_mm: float | None = None,
    tilt_deg: float = 0.0,
    aside_mm: float = 0.0,
    turned_deg: float = 0.0,
    speed_mps: float = 0.0,
    pads: tuple[int, ...] = (),
    force_n: float = 0.7,
    height_m: float = 0.16,
) -> dict:
    """One scene: the holder in the air, the plug's tip ``depth_mm`` behind its mouth; both hands move together."""
    depth_mm = DEPTH_MM[task.name] if depth_mm is None else depth_mm
    holder = pose_at(0.32, 0.03, height_m)
    holder[:3, :3] = np.array(HOLDER_AXES[task.holder.name]).T
    mate = pose_at(aside_mm / 1e3, 0, depth_mm / 1e3)
    mate[:3, :3] = Rotation.from_euler(
        "zx", (turned_deg, tilt_deg), degrees=True
    ).as_matrix()
    plug = (
        holder
        @ task.holder.holes[task.hole].part_from_hole
        @ mate
        @ plug_from_tip(task)
    )
    drift = np.array((0.1, 0, 0))  # what counts is the one against the other
    return {
        "poses": {"plug": plug, task.holder.name: holder},
        "velocities": {
            "plug": np.add(drift, (0, speed_mps, 0)),
            task.holder.name: drift,
        },
        "pads": {
            "plug": [k in pads for k in range(4)],
            task.holder.name: [True, True, False, False],
        },
        "force_n": force_n,
    }


def scene(*cases: dict) -> Any:
    """N scenes, one a row."""
    forces = np.array([case["force_n"] for case in cases])
    return SimpleNamespace(
        num_sims=len(cases),
        diverged=np.zeros(len(cases), bool),
        poses=lambda body: np.stack([case["poses"][body] for case in cases]),
        velocities=lambda body: np.stack([case["velocities"][body] for case in cases]),
        pads_touching=lambda body: np.array([case["pads"][body] for case in cases]),
        contact=lambda body, other: Contact(forces > 0, np.zeros(len(cases)), forces),
    )


def after(task: AirAssembly, seconds: float, *cases: dict) -> list[str]:
    judge, seen = Judge(task, len(cases), 30), scene(*cases)
    judge.reset(np.arange(len(cases)), seen)
    for _ in range(round(seconds * 30)):
        judge.update(seen)
    return judge.outcome.failure.tolist()


@pytest.mark.parametrize(
    ("task", "case", "goal"),
    [
        (ONE, {}, True),
        (ONE, {"depth_mm": 34.1}, True),
        (ONE, {"depth_mm": 33.9}, False),  # not deep enough
        (ONE, {"pads": (2,)}, False),  # one pad still touches it
        (ONE, {"pads": (0,)}, False),  # even the other hand's
        (ONE, {"speed_mps": 0.021}, False),  # in flight through the socket
        (ONE, {"speed_mps": 0.019}, True),
        (ONE, {"tilt_deg": 1.9}, True),
        (ONE, {"tilt_deg": 2.1}, False),
        (ONE, {"turned_deg": 180.0}, True),  # the tenon looks the same
        (ONE, {"aside_mm": 4.0}, False),  # beside the socket, as deep
        # 2 · 1.0 mm / 34 mm = 3.37°, 15 % more is 3.88°
        (Assembly1("easy"), {"tilt_deg": 3.4}, True),
        (Assembly1("easy"), {"tilt_deg": 4.1}, False),
        (Assembly1("hard"), {"tilt_deg": 2.1}, False),
        (TWO, {}, True),
        (TWO, {"depth_mm": COM_MM + 2.1}, True),
        (
            TWO,
            {"depth_mm": COM_MM + 1.9},
            False,
        ),  # over the lip by a hair: the rim of the predicate
        (TWO, {"force_n": 0.0, "speed_mps": 0.2}, False),  # in flight above the cradle
        (TWO, {"force_n": 0.0}, False),  # at the top of its flight
        (TWO, {"speed_mps": 0.03}, False),  # sliding
        (TWO, {"pads": (2, 3)}, False),  # still held
        (TWO, {"tilt_deg": 6.0}, False),  # leaning on a wall
        (TWO, {"aside_mm": 5.0}, False),
    ],
)
def test_the_plug_is_in_when_deep_straight_supported_let_go_and_at_rest(
    task, case, goal
):
    assert task.look(scene(placed(task, **case))).goal.tolist() == [goal]


def test_each_simulation_is_looked_at_on_its_own():
    verdict = ONE.look(scene(placed(ONE), placed(ONE, 10.0), placed(ONE, pads=(3,))))
    assert verdict.goal.tolist() == [True, False, False]
    assert verdict.partial.tolist() == [
        1,
        0,
        1,
    ]  # in place counts as partial while it is still held
    np.testing.assert_allclose(
        verdict.measures["depth_m"], (0.036, 0.010, 0.036), atol=1e-12
    )


HELD = {"pads": (2, 3)}


@pytest.mark.parametrize(
    ("task", "case", "seconds", "failure"),
    [
        (ONE, HELD | {"depth_mm": 20.0, "force_n": 16.0}, 1.0, "wedged"),
        (
            ONE,
            HELD | {"depth_mm": 20.0, "force_n": 14.0},
            2.0,
            "",
        ),  # a push that people call gentle
        (ONE, HELD | {"depth_mm": 3.0, "force_n": 20.0}, 2.0, ""),  # on the rim
        (ONE, HELD | {"depth_mm": 31.0, "force_n": 20.0}, 2.0, ""),  # home
        (
            ONE,
            HELD | {"depth_mm": -1.9, "aside_mm": 5.0, "force_n": 1.0},
            1.0,
            "sliding",
        ),  # on the socket's face
        (
            ONE,
            HELD | {"depth_mm": 20.0, "aside_mm": 5.0, "force_n": 1.0},
            1.0,
            "sliding",
        ),  # and past it
        (
            ONE,
            HELD | {"depth_mm": -1.0, "aside_mm": 2.9, "force_n": 10.0},
            2.0,
            "",
        ),  # at the edge: aim again
        (
            ONE,
            HELD | {"depth_mm": -2.1, "aside_mm": 5.0, "force_n": 10.0},
            2.0,
            "",
        ),  # another place of the parts
        (
            ONE,
            HELD | {"depth_mm": 20.0, "aside_mm": 5.0, "force_n": 0.0},
            2.0,
            "",
        ),  # beside it, without contact
        (
            TWO,
            {"depth_mm": 10.0, "force_n": 0.0, "speed_mps": 0.5},
            0.1,
            "fell_out",
        ),  # it may hop while it is let down
        (
            TWO,
            {"depth_mm": -300.0, "force_n": 0.0, "height_m": 0.02},
            2.0,
            "",
        ),  # on the table
        (
            TWO,
            {"depth_mm": 15.0, "tilt_deg": 12.0},
            1.0,
            "unsupported",
        ),  # it hangs over the lip
        (TWO, HELD | {"depth_mm": 15.0}, 2.0, ""),  # the hand may hold it there
        *(
            (
                task,
                {"depth_mm": -300.0, "height_m": -0.03, "force_n": 0.0},
                1 / 30,
                "dropped",
            )
            for task in (ONE, TWO)
        ),
        *(
            (task, {"depth_mm": -300.0, "force_n": 0.0} | HELD, 2.0, "")
            for task in (ONE, TWO)
        ),
    ],
)
def test_a_failure_is_named_when_it_has_lasted(task, case, seconds, failure):
    assert after(task, seconds, placed(task, **case)) == [failure]
    if failure:
        assert after(task, seconds - 1 / 30, placed(task, **case)) == [""]


@BOTH
def test_a_grasp_is_done_when_its_part_is_three_centimetres_up(task):
    low, high = (
        placed(task, -200.0, height_m=0.029),
        placed(task, -200.0, height_m=0.031),
    )
    own = task.subtasks()["left"]
    assert own[0].done(scene(low, high)).tolist() == [False, True]
    for arm in ("left", "right"):
        assert task.subtasks()[arm][1].done(scene(high, placed(task))).tolist() == [
            False,
            True,
        ]


@pytest.fixture(scope="module")
def sims() -> dict[str, Simulation]:
    return {task.name: Simulation(task, scale=0.0) for task in (ONE, TWO)}


@BOTH
def test_parts_lie_where_they_are_drawn_mating_ends_towards_each_other(sims, task):
    reset = task.reset(values := draw(task.rows, np.random.default_rng(1)))
    for part, at, row in (
        ("plug", PLUG_AT_M, "plug"),
        (task.holder.name, HOLDER_AT_M, "socket"),
    ):
        np.testing.assert_allclose(
            reset.poses[part][:2] - at, values[f"{row}_position"], atol=1e-12
        )
        assert (
            reset.mass_change_kg[part] == values[f"{row}_mass"]
        )  # the table's socket is the cradle
    sim = sims[task.name]
    sim.reset([0])
    before = {part: sim.poses(part)[0].copy() for part in task.parts}
    hole = before[task.holder.name] @ task.holder.holes[task.hole].part_from_hole
    mate = before["plug"] @ np.linalg.inv(plug_from_tip(task))
    np.testing.assert_allclose([hole[:3, 2], mate[:3, 2]], 2 * [(0, 1, 0)], atol=1e-6)
    assert hole[1, 3] - mate[1, 3] > 0.2
    if task is TWO:  # open sides up
        np.testing.assert_allclose(
            [before["cradle"][:3, 1], before["plug"][:3, 1]], 2 * [(0, 0, 1)], atol=1e-6
        )
    stay(sim, 3)  # a tenth of a second later they lie where they were put, to a hair
    for part, pose in before.items():
        np.testing.assert_allclose(sim.poses(part)[0], pose, atol=5e-4)

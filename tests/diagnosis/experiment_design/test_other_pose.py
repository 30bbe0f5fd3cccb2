"""Motions of one joint with the others in another pose: an arm of two joints whose pan joint feels a leaning base by the cosine
of the lift joint. The post stands beside the arm where lift is 0.6 rad."""

import csv
import dataclasses
import json
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from simulated_slide import logged, robot_machine

from taccorl.alignment.measurements.folder import Measurements
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.cli.main import main
from taccorl.diagnosis.experiment_design import motions
from taccorl.diagnosis.experiment_design.motions import JointPart, ground_of, posed
from taccorl.diagnosis.experiment_design.other_pose import (
    FARTHEST,
    WAY_SPEED,
    chosen_pose,
    in_other_pose,
    stated_pose,
)
from taccorl.diagnosis.experiment_design.plan import TELLS, scored
from taccorl.diagnosis.machines.load import load_machine
from taccorl.diagnosis.machines.machine import Machine
from taccorl.errors import TaccorlError
from taccorl.sim.effects.load import Unbalance

MODEL = """<mujoco><compiler angle="radian"/><worldbody>
<body name="post" pos="0.3 0 -0.05"><geom type="sphere" size="0.05"/></body>
<body name="column"><inertial pos="0 0 0.1" mass="2" diaginertia="0.01 0.01 0.01"/>
<joint name="pan" axis="0 0 1" range="-2 2" armature="0.1"/>
<body name="arm" pos="0 0 0.2"><inertial pos="0.3 0 0" mass="3" diaginertia="0.003 0.05 0.05"/>
<geom type="capsule" fromto="0.1 0 0 0.5 0 0" size="0.03"/>
<joint name="lift" axis="0 1 0" range="-2 2" armature="0.1"/></body></body></worldbody></mujoco>"""
FILE = """kind: robot
model: arm.xml
gravity_compensation: 1.0
joints:
  pan: {kp: 300.0, kd: 12.0, rotor_inertia: 0.1, loop_hz: 1000.0}
  lift: {kp: 300.0, kd: 12.0, rotor_inertia: 0.1, loop_hz: 1000.0, effort_limit: 20.0}
"""
SPAN = (-0.5, 0.5)
FITTED = {
    "unbalance": {"unbalance.torque_nm": 2.0, "unbalance.hangs_at_rad": 0.0},
    "cable_spring": {
        "cable_spring.stiffness_nm_per_rad": 2.0,
        "cable_spring.rest_rad": 0.0,
    },
}
RIVALS = (*FITTED,)


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    return robot_machine(tmp_path, MODEL, FILE)


def swung(machine: Machine, seed: int, hz: float) -> Measurement:
    """The pan joint swings by 0.5 rad, as the model answers, and lift stands at 0."""
    time_s = np.arange(1000) * 0.005
    moving = np.clip(time_s - 1.0, 0.0, None)
    target = np.column_stack(
        [0.5 * np.sin(2 * np.pi * hz * moving) * np.clip(moving, 0, 1), np.zeros(1000)]
    )
    rows = {"time_s": time_s, "target": target, "measured": target.copy()}
    m = logged(f"swing_{seed}", ("pan", "lift"), ("rad", "rad"), **rows)
    m.measured[:, 0] = machine.answer("pan", m).reported
    return dataclasses.replace(
        m,
        measured=m.measured
        + np.random.default_rng(seed).normal(0.0, 1e-4, target.shape),
    )


def test_the_chosen_pose_is_the_one_with_another_weight_that_touches_nothing(machine):
    """The pan joint feels a leaning base, and the inertia of the arm, by cos(lift), least at ± 1 rad; at 1 it is in the post."""
    like = swung(machine, 1, 0.3)
    pose = chosen_pose(machine, "pan", like, SPAN, ["lift"])
    assert -FARTHEST["rad"] <= pose.positions["lift"] < -0.95 * FARTHEST["rad"]
    size = math.cos(pose.positions["lift"])
    mass, own = 3 * 0.3**2, (0.003, 0.05)
    heavy = [
        0.01 + mass * c * c + own[0] * (1 - c * c) + own[1] * c * c for c in (1.0, size)
    ]
    assert pose.change() == pytest.approx(
        (1 - size) / (1 + size) + 0.5 * (1 - heavy[1] / heavy[0]), rel=0.1
    )
    way = pose.way(200.0)["lift"]
    assert way[0] == pytest.approx(0.0, abs=1e-3) and way[-1] == pytest.approx(
        pose.positions["lift"]
    )
    assert (
        0.9 * WAY_SPEED["rad"] < np.abs(np.diff(way)).max() * 200.0 <= WAY_SPEED["rad"]
    )
    assert pose.unchecked == 1  # the column has no shape


@pytest.mark.parametrize(
    ("positions", "limit", "words"),
    [
        # 0.25 cos q − 0.3 sin q = 0.05 + 0.03 m, first at 0.488 rad; the way is looked at every 0.009 rad
        ({"lift": 0.9}, 20.0, ("post touches arm", "lift 0.491")),
        ({"lift": 2.5}, 20.0, ("lift 2.5", "-2 … 2")),
        (
            {"lift": -0.2},
            10.0,
            ("lift needs 8.6", "effort_limit 10"),
        ),  # 3 · 9.81 · 0.3 · cos 0.2 = 8.65 of 8
        ({"left": 0.1}, 20.0, ("left", "lift")),
        ({"pan": 0.1}, 20.0, ("pan is no other joint", "lift")),
    ],
)
def test_a_pose_that_must_not_be_recorded_is_refused(
    tmp_path, machine, positions, limit, words
):
    like = swung(machine, 1, 0.3)
    (tmp_path / "robot.yaml").write_text(FILE.replace("20.0", str(limit)))
    with pytest.raises(TaccorlError) as error:
        stated_pose(load_machine(tmp_path / "robot.yaml"), "pan", like, SPAN, positions)
    assert all(word in str(error.value) for word in words), error.value


def test_another_pose_tells_a_leaning_base_from_a_spring_where_the_present_one_does_not(
    machine,
):
    """Within ± 0.5 rad, sin q and q differ by 1 % of the torque; at lift -1 the base loads 0.54 as much, the spring as before."""
    known = Measurements((swung(machine, 1, 0.3), swung(machine, 2, 0.5)))
    ground, apart = ground_of(machine, "pan", known), []
    for positions in ({}, {"lift": -1.0}):
        pose = (
            stated_pose(machine, "pan", ground.like, ground.span, positions)
            if positions
            else None
        )
        part = JointPart(dataclasses.replace(ground, pose=pose), 1e-4, known)
        apart.append(scored(part, RIVALS, FITTED).best("unbalance | cable_spring"))
        assert part.pose == positions
    assert apart[0] < 0.5 * TELLS and apart[1] > 2 * TELLS, apart


def test_an_unbalance_beyond_the_largest_of_a_search_acts_in_another_pose(machine):
    """At lift 0 the base loads 1 / cos 1 = 1.85 times as much as at -1."""
    m, lowered = swung(machine, 1, 0.3), np.array([0.0, -1.0])
    m = dataclasses.replace(m, target=m.target + lowered, measured=m.measured + lowered)
    problem: Any = SimpleNamespace(
        simulate_all=lambda cases, recordings: [[cases[0][1]]]
    )
    changed = in_other_pose(
        problem, stated_pose(machine, "pan", m, SPAN, {"lift": 0.0}), "new"
    )
    (e,) = changed.simulate(
        {}, [Unbalance(torque_nm=9.9, hangs_at_rad=0.0)], SimpleNamespace(name="new")
    )
    assert e.torque_nm == pytest.approx(9.9 / np.cos(1.0), rel=1e-3)


@pytest.mark.parametrize("asked", [True, False])
def test_excite_plans_another_pose_where_the_diagnosis_asks(
    asked, tmp_path, machine, capsys, monkeypatch
):
    """Also where nothing asks, but no motion in the present pose separates the rivals."""
    monkeypatch.setattr(
        motions, "MOTIONS", [m for m in motions.MOTIONS if m.name == "wide_triangle"]
    )
    sweeps, out = tmp_path / "sweeps", tmp_path / "plan"
    sweeps.mkdir()
    for seed in (1, 2):
        m = swung(machine, seed, 0.3)
        columns = np.column_stack([m.time_s, m.measured, m.target])
        header = "t,pan.q,lift.q,pan.q_target,lift.q_target"
        np.savetxt(
            sweeps / f"{m.name}.csv", columns, "%.8g", ",", header=header, comments=""
        )
    rows = [
        {"name": name, "base": {}, "values": values} for name, values in FITTED.items()
    ]
    found = {
        "one_pose": {"unbalance": ["lift"]} if asked else {},
        "rounds": [{"evidence": rows}],
        "rivals": {},
    }
    (tmp_path / "report.json").write_text(json.dumps({"diagnoses": {"pan": found}}))
    words = [
        "excite",
        "pan",
        f"--twin={tmp_path / 'robot.yaml'}",
        f"--measurements={sweeps}",
        "--num=1",
    ]
    words += [f"--diagnosis={tmp_path}", f"--effects={','.join(RIVALS)}"]
    assert main([*words, f"--out={out}"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert ("lift stood in one pose" in text) == asked
    assert (
        "unbalance | cable_spring: 0." in text and "with other joints at lift -" in text
    ) != asked
    plan = yaml.safe_load((out / "plan.yaml").read_text())
    (motion,) = plan["motions"]
    place = plan if asked else motion
    assert (
        place["pose"]["lift"] < -0.9
        and "no shape" in place["how"]
        and ("pose" in plan) == asked
    )
    assert (
        motion["floors_apart"]["unbalance | cable_spring"] > TELLS
        and "pick either" not in text
    )
    with (out / motion["table"]).open() as file:
        assert {float(row["lift.q_target"]) for row in csv.DictReader(file)} == {
            place["pose"]["lift"]
        }
    with (out / place["way_to_the_pose"]).open() as file:
        way = [float(row["lift.q_target"]) for row in csv.DictReader(file)]
    assert way[0] == pytest.approx(0.0, abs=1e-3) and way[-1] == place["pose"]["lift"]
    assert main([*words, "--pose={lift: 0.9}", f"--out={tmp_path / 'other'}"]) == 2
    assert "post" in capsys.readouterr().err and not (tmp_path / "other").exists()


def test_the_pose_of_a_piper_arm_is_changed_within_its_limits():
    pose = np.array([0.0, 1.732, -0.883, 0.0, 0.2, 0.0, 0.02])
    assert posed("left_joint5", pose, {"left_joint2": 1.2}).tolist() == [
        0.0,
        1.2,
        -0.883,
        0.0,
        0.2,
        0.0,
        0.02,
    ]
    for positions, word in (
        ({"left_joint2": 9.0}, "limits"),
        ({"right_joint2": 1.0}, "left_joint"),
        ({"left_joint5": 0.0}, "other"),
    ):
        with pytest.raises(TaccorlError, match=word):
            posed("left_joint5", pose, positions)

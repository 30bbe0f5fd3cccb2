"""``taccorl excite`` and ``taccorl surrogate`` with the file of a user's own machine, as a user types them. Simulated."""

import csv
import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import yaml
from axes import altered

from taccorl.alignment.checks.telemetry import check_measurement
from taccorl.alignment.measurements.folder import Measurements
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.diagnosis.experiment_design.motions import (
    EFFORT_SHARE,
    JUMPS,
    MARGIN,
    MOTIONS,
    Ground,
    ground_of,
)
from taccorl.diagnosis.machines.load import load_machine
from taccorl.diagnosis.machines.machine import Addition
from taccorl.diagnosis.machines.robot import RobotMachine

VERB, ONE_LINE = "", True
SLIDE = """kind: axis
name: slide
unit: m
inertia: 40.0
kp: 40000.0
kd: 2000.0
limits: [-0.15, 0.15]
effort_limit: 200.0
"""


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    (tmp_path / "drive.yaml").write_text(SLIDE)
    return tmp_path / "drive.yaml"


def ground(
    drive: Path, speed: float | None = 0.4, span: Sequence[float] = ()
) -> Ground:
    return ground_of(RobotMachine.load(drive), "slide", speed=speed, span=span)


def swept(drive: Path, hidden: RobotMachine, rows_early: int = 0) -> Measurement:
    g = ground(drive)
    m, _ = dataclasses.replace(g, machine=hidden).answered(
        g.commanded("sweep", g.positions(MOTIONS[0], 0.5))
    )
    noise = 2e-5 * np.random.default_rng(3).standard_normal(m.measured.shape)
    return dataclasses.replace(
        m, measured=np.roll(m.measured, -rows_early, axis=0) + noise
    )


def test_planned_motions_keep_range_speed_and_effort(drive):
    """0.3 m of stroke less 5 % at both ends; 80 % of 200 N, and 0.4 m/s."""
    g = ground(drive)
    assert (
        g.room.wide_rad == pytest.approx((0.5 - MARGIN) * 0.3)
        and g.room.middle_rad == 0.0
    )
    made = 0
    for motion in MOTIONS:
        fastest = np.abs(np.diff(g.positions(motion))).max() * g.rate_hz
        assert fastest <= 1.3 * 0.4, (
            motion.name
        )  # a chirp's frequency rises within its period
        try:
            m, effort = g.fitted(motion)
        except Exception as error:
            assert "of 200 N even at 25%" in str(error)
            continue
        made += 1
        assert np.abs(effort).max() <= EFFORT_SHARE * 200.0
        assert np.abs(m.target).max() <= 0.15 * (1 - 2 * MARGIN) + 1e-9
    assert made >= 4


def test_a_velocity_law_gets_velocities_that_sum_to_the_motion(tmp_path):
    (tmp_path / "v.yaml").write_text(SLIDE.replace("kp: 40000.0\n", "law: velocity\n"))
    g = ground(tmp_path / "v.yaml")
    positions = g.positions(MOTIONS[0])
    m = g.commanded("x", positions)
    assert m.target_kind("slide") == "velocity"
    assert np.cumsum(m.target[:-1, 0]) / g.rate_hz == pytest.approx(
        positions[1:] - positions[0], abs=1e-12
    )


@pytest.mark.parametrize(
    ("kd", "rows_early", "said"),
    [
        (2400.0, 0, []),
        (2000.0, 1, [("shifted_from_twin", "error")]),
        (2400.0, 1, [("clock_or_effect", "warning")]),
    ],
)
def test_damping_is_not_taken_for_an_early_clock_and_an_early_clock_is(
    drive, kd, rows_early, said
):
    """20 % more damping lags by 0.2 · 2000 / 40000 = 10 ms, two rows, and no clock is off; a row early is an error. Both at
    once are a lag of one row, which speeds that are sent along would leave as well."""
    axis = RobotMachine.load(drive)
    m = swept(drive, RobotMachine(altered(axis.robot, kd=kd), axis.name), rows_early)
    found = axis.compare(Measurements((m,))).clock["sweep"]
    assert [(f.check, f.severity) for f in found] == said, found


@pytest.mark.parametrize(
    ("name", "values", "warns"),
    [
        (
            "velocity_feedforward",
            {"share": 0.2},
            True,
        ),  # takes 0.2 · 2000 / 40000 s off the lag: 10 ms, two rows
        ("velocity_feedforward", {"share": 1.2}, False),
        ("integral_action", {"rate_per_s": 1.0}, False),
    ],
)
def test_an_effect_that_takes_lag_off_is_no_early_clock_and_is_named(
    drive, name, values, warns
):
    axis = RobotMachine.load(drive)
    hidden = RobotMachine(altered(axis.robot, effects=[(name, values)]), axis.name)
    m = swept(drive, hidden)
    found = [
        f
        for f in axis.compare(Measurements((m,))).clock["sweep"]
        if f.check != "not_judged"
    ]
    assert [(f.check, f.severity, name in f.text) for f in found] == [
        ("clock_or_effect", "warning", True)
    ] * warns
    assert not any("target_rows_late" in f.text or "latency_s" in f.text for f in found)
    assert not hidden.compare(Measurements((m,))).clock["sweep"], (
        "withdrawn where the effect is in the file"
    )
    assert not any(f.severity == "error" for f in check_measurement(m))


@pytest.mark.parametrize(
    ("change", "limits", "words"),
    [
        (("limits: [-0.15, 0.15]\n", ""), {}, "--span=[lowest, highest]"),
        (("", ""), {"speed": None}, "--speed= in m/s"),
        (("", ""), {"span": [-0.3, 0.1]}, "beyond the limits of slide"),
        (("kp: 40000.0\nkd: 2000.0\n", "law: torque\n"), {}, "driven by torque"),
    ],
)
def test_limits_that_nobody_stated_are_not_guessed(tmp_path, change, limits, words):
    (tmp_path / "d.yaml").write_text(SLIDE.replace(*change) if change[0] else SLIDE)
    with pytest.raises(Exception, match=words.replace("[", r"\[")):
        ground(tmp_path / "d.yaml", **limits)


def suspected(folder: Path, **values: dict[str, float]) -> Path:
    """A diagnosis that fitted these effects to the slide."""
    rows = [
        {"name": n, "base": {}, "values": {f"{n}.{k}": x for k, x in own.items()}}
        for n, own in values.items()
    ]
    folder.mkdir(exist_ok=True)
    (folder / "report.json").write_text(
        json.dumps({"diagnoses": {"slide": {"rounds": [{"evidence": rows}]}}})
    )
    return folder


@pytest.mark.parametrize(
    ("limit_n", "within"), [(80.0, (1.3, 1.6)), (180.0, (0.6, 0.8 * 200.0 / 180.0))]
)
def test_motions_are_aimed_at_a_suspected_limit(drive, limit_n, within):
    """A jump d of the target is 40 000 N/m · d at once, which must be within 80 % of 200 N; 180 N are not."""
    g, values = ground(drive), {"torque_saturation.torque_max_nm": limit_n}
    m, effort, far = g.aimed(JUMPS, "torque_saturation", values)
    assert within[0] <= far <= within[1] and far == pytest.approx(
        np.abs(effort).max() / limit_n
    )
    assert (
        np.abs(effort).max()
        < 40000.0 * np.abs(np.diff(m.target[:, 0])).max()
        <= 1.05 * EFFORT_SHARE * 200.0
    )
    assert np.abs(np.gradient(m.measured[:, 0], 1.0 / g.rate_hz)).max() <= 1.05 * 0.4


def test_excite_says_which_suspected_limit_no_motion_reaches_and_by_how_much(
    drive, said, tmp_path
):
    """A stop at 0.14 m is within the limits of 0.15 m; 180 N are more than 80 % of 200 N."""
    found = suspected(
        tmp_path / "diagnosis",
        torque_saturation={"torque_max_nm": 180.0},
        end_stop={"stiffness_nm_per_rad": 5e4, "angle_rad": 0.14},
    )
    words = [
        "--effects=[torque_saturation,end_stop]",
        f"--twin={drive}",
        f"--diagnosis={found}",
        f"--out={tmp_path / 'p'}",
    ]
    _, text = said("excite", *words, "--speed=0.4", "--floor_rad=5e-6")
    reaches = yaml.safe_load((tmp_path / "p" / "plan.yaml").read_text())["reaches"]
    assert reaches["end_stop"] == pytest.approx(0.15 / 0.14, rel=0.01)
    assert 0.6 < reaches["torque_saturation"] < 160.0 / 180.0
    assert (
        f"torque_saturation: no motion reaches the suspected limit, the nearest goes to {reaches['torque_saturation']:.0%}"
        in text
    )
    assert "effort_limit 200" in text and "end_stop: no motion" not in text


def test_excite_writes_targets_that_the_axis_can_follow(drive, said, tmp_path):
    out = tmp_path / "plan"
    words = [
        "--effects=[coulomb_friction,viscous_friction]",
        f"--twin={drive}",
        f"--out={out}",
        "--num=1",
    ]
    code, text = said("excite", *words, "--speed=0.4")
    assert code == 2 and "--floor_rad: the noise of slide" in text
    code, text = said("excite", *words, "--speed=0.4", "--floor_rad=5e-6")
    assert code == 0 and " N " in text and "N·m" not in text
    plan = yaml.safe_load((out / "plan.yaml").read_text())
    (motion,) = plan["motions"]
    assert (
        motion["peak_effort"] <= 160.0 and min(motion["floors_apart"].values()) > 1.25
    )
    with (out / motion["table"]).open() as file:
        head, *rows = csv.reader(file)
    assert (
        head == ["t", "slide.q_target"]
        and np.abs(np.array(rows, dtype=float)[:, 1]).max() <= 0.15
    )


def test_a_surrogate_of_the_users_axis_is_refused_with_the_way_out(
    drive, said, tmp_path
):
    out = tmp_path / "made"
    code, text = said("surrogate", "--secret=4", f"--twin={drive}", f"--out={out}")
    assert code == 2 and "taccorl excite" in text and not out.exists()


def test_a_surrogate_of_the_users_cells_has_their_units_and_ends(said, tmp_path):
    (tmp_path / "foot.yaml").write_text(
        "kind: cells\ncells: [foot]\nload: {unit: kPa, rated: 400}\n"
        "reading: {unit: V, lowest: 0.0, highest: 3.3, falls: true}\nrate_hz: 250\n"
    )
    out = tmp_path / "made"
    code, text = said(
        "surrogate",
        "--secret=5",
        f"--twin={tmp_path / 'foot.yaml'}",
        f"--out={out}",
        "--effects=[]",
    )
    assert code == 0 and "simulated" in text
    t, load, volts, _ = np.loadtxt(
        out / "presses" / "presses.csv", delimiter=",", skiprows=3
    ).T
    assert (
        np.diff(t).mean() == pytest.approx(1 / 250, rel=1e-3) and 350 < load.max() < 420
    )
    assert 0.0 <= volts.min() < volts.max() <= 3.3
    assert np.corrcoef(load, volts)[0, 1] < -0.99, "the reading falls under load"
    code, text = said(
        "surrogate",
        "--secret=5",
        f"--twin={tmp_path / 'foot.yaml'}",
        "--effects=[taxel_crosstalk]",
    )
    assert code == 2 and "needs a grid" in text


TWO_JOINTS = """<mujoco><worldbody><body><joint name="shoulder" axis="0 0 1"/>
<inertial pos="0.1 0 0" mass="1" diaginertia="1 1 1"/>
<body pos="0.3 0 0"><joint name="elbow" axis="0 0 1"/><inertial pos="0.1 0 0" mass="1" diaginertia="1 1 1"/></body>
</body></worldbody></mujoco>
"""


def test_effects_that_one_diagnosis_found_at_two_joints_are_added_together(
    said, tmp_path
):
    (tmp_path / "arm.xml").write_text(TWO_JOINTS)
    twin = tmp_path / "arm.yaml"
    twin.write_text(
        "kind: robot\nmodel: arm.xml\njoints: {shoulder: {kp: 50, kd: 5}, elbow: {kp: 20, kd: 2}}\n"
    )
    found = {"shoulder": ("viscous_friction", {"damping_nms_per_rad": 0.7})}
    found["elbow"] = ("coulomb_friction", {"torque_nm": 0.4})
    common = {
        "present": [],
        "base": {"torque_ff": 0.1},
        "intervals": {},
        "at_bound": [],
        "rounds": [],
        "steps": [],
    }
    diagnoses = {
        part: common | {"effects": [{"effect": name} | values]}
        for part, (name, values) in found.items()
    }
    (tmp_path / "d").mkdir()
    words = [
        "taccorl",
        "diagnose",
        "'my sweeps'",
        f"--twin={twin}",
        "--until=noise_floor",
        "--columns=c.yaml",
    ]
    words += ["--validation_every=3", "'--joints=[elbow,shoulder]'"]
    provenance = {
        "twin, SHA-256": load_machine(twin).digest(),
        "command": " ".join(words),
    }
    verdicts = {
        part: {"finding": f"{part} lacks {name}"} for part, (name, _) in found.items()
    }
    report = {"provenance": provenance, "diagnoses": diagnoses, "verdicts": verdicts}
    (tmp_path / "d" / "report.json").write_text(json.dumps(report))
    found_by = f"--diagnosis={tmp_path / 'd'}"
    code, text = said(
        "add-effect", "viscous_friction,coulomb_friction", f"--twin={twin}", found_by
    )
    both = tmp_path / "arm+viscous_friction+coulomb_friction.yaml"
    words = "next: taccorl compare 'my sweeps' --columns=c.yaml --validation_every=3 '--joints=[shoulder,elbow]' "
    words += f"--twin={twin} --against={both}"
    assert code == 0 and words in text, text
    made = yaml.safe_load(both.read_text())["joints"]
    for part, (name, values) in found.items():
        (effect,) = made[part]["effects"]
        assert effect["effect"] == name and effect.items() >= values.items()
    code, text = said("add-effect", "viscous_friction", f"--twin={both}", found_by)
    assert code == 2 and "another twin" in text


def test_friction_of_a_sliding_joint_is_told_in_newtons_and_written_as_any_effect(
    said, tmp_path
):
    (tmp_path / "gantry.xml").write_text(
        TWO_JOINTS.replace('name="elbow"', 'name="elbow" type="slide"')
    )
    twin = tmp_path / "gantry.yaml"
    twin.write_text(
        "kind: robot\nmodel: gantry.xml\njoints: {shoulder: {kp: 50, kd: 5}, elbow: {kp: 8000, kd: 400}}\n"
    )
    machine = load_machine(twin)
    units = {}
    for part in ("shoulder", "elbow"):
        effect = machine.effect("viscous_friction", part, {"damping_nms_per_rad": 3.0})
        assert effect is not None
        units[part] = effect.parameters()[0].unit
        machine = machine.with_additions([Addition(part, [effect], {}, {})])
    assert units == {"shoulder": "N·m·s/rad", "elbow": "N·s/m"}
    machine.save(tmp_path / "with.yaml")
    joints = yaml.safe_load((tmp_path / "with.yaml").read_text())["joints"]
    assert all(
        joints[part]["effects"][0]["damping_nms_per_rad"] == 3.0 for part in units
    )

"""Checks of the efforts of joints that ``--joints`` does not name."""

from pathlib import Path

import numpy as np
import pytest

from taccorl.alignment.checks.registry import find
from taccorl.alignment.measurements.folder import Measurements
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.cli.measured import _of_asked, checked
from taccorl.data.origin import Origin
from taccorl.diagnosis.machines.load import load_machine

WRONG = 20.0
MODEL = """<mujoco><worldbody><body><joint name="x" type="slide" axis="1 0 0" range="-1 1"/>
<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
<body><joint name="y" type="slide" axis="0 1 0" range="-1 1"/>
<inertial pos="0 0 0" mass="2" diaginertia="1 1 1"/></body></body></worldbody></mujoco>"""
FILE = """kind: robot
model: arm.xml
gravity_compensation: 0.0
joints:
  x: {kp: 900.0, kd: 60.0, gains: fitted}
  y: {kp: 600.0, kd: 40.0, gains: fitted}
"""


def gantry(folder: Path) -> tuple:
    """Two slides of 3 and 2 kg at right angles, of which the first reports 20 times its force."""
    (folder / "arm.xml").write_text(MODEL)
    (folder / "robot.yaml").write_text(FILE)
    time_s = np.arange(2000) / 200.0
    fade = np.clip(np.minimum(time_s - 0.5, 9.5 - time_s), 0.0, 1.0) ** 2
    wave = 2 * np.pi * (0.2 * time_s + 0.1 * time_s**2)
    target = 0.1 * fade[:, None] * np.sin(np.stack([wave, 1.3 * wave], axis=1))
    kp, kd, mass = np.array([[900.0, 600.0], [60.0, 40.0], [3.0, 2.0]])
    q, v, rows = np.zeros(2), np.zeros(2), []
    for goal in target:
        rows.append((q, kp * (goal - q) - kd * v))
        for _ in range(10):
            v = v + 5e-4 * (kp * (goal - q) - kd * v) / mass
            q = q + 5e-4 * v
    position, force = np.array(rows).transpose(1, 0, 2)
    rng = np.random.default_rng(0)
    m = Measurement(
        name="both.csv",
        time_s=time_s,
        signals=("x", "y"),
        units=("m", "m"),
        target=target,
        measured=position + 1e-5 * rng.standard_normal(position.shape),
        effort=force * [WRONG, 1.0] + 0.02 * rng.standard_normal(position.shape),
        origin=Origin("twin", "simulated by the test, not a machine"),
    )
    return load_machine(folder / "robot.yaml"), Measurements((m,))


@pytest.mark.parametrize(
    ("check", "feature", "severity"),
    [
        ("wrong_inertia", "x", "warning"),
        ("reversed_effort", "x", "warning"),
        ("wrong_inertia", "y", "error"),
        ("beyond_limits", "x", "error"),
    ],
)
def test_only_efforts_of_joints_that_are_not_asked_for_become_warnings(
    check: str, feature: str, severity: str
) -> None:
    assert _of_asked(find(check, feature, "far off"), ["y"]).severity == severity


@pytest.mark.slow
def test_an_inertia_that_is_far_off_stops_only_the_joint_that_has_it(
    tmp_path: Path,
) -> None:
    machine, own = gantry(tmp_path)
    assert checked(machine, own, "not diagnosed") is None
    assert checked(machine, own, "not diagnosed", joints=["x"]) is None
    found = checked(machine, own, "not diagnosed", joints=["y"])
    assert found is not None
    of_x = [f for f in found["both.csv"] if f.check == "wrong_inertia"]
    assert [(f.feature, f.severity) for f in of_x] == [("x", "warning")]

"""Columns that are exchanged or turned in all recordings, which only the model shows; recordings are replays of the model."""

import dataclasses
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from simulated_slide import logged, robot_machine

from taccorl.alignment.checks.effort_time import LawFit, law_fit
from taccorl.alignment.checks.telemetry import check_measurements, one_cause
from taccorl.alignment.measurements.folder import Measurements
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.diagnosis.comparison.replays import replay_joints
from taccorl.diagnosis.machines.machine import Addition
from taccorl.diagnosis.machines.robot import RobotMachine
from taccorl.sim.effects import make_effect

ARM = """<mujoco><compiler angle="radian"/><worldbody>
<body><joint name="yaw" axis="0 0 1"/><inertial mass="2" pos="0 0 .05" diaginertia=".01 .01 .01"/>
<body pos="0 0 .1"><joint name="shoulder" axis="0 1 0"/><inertial mass="2.5" pos=".06 0 .15" diaginertia=".02 .02 .004"/>
<body pos="0 0 .3"><joint name="elbow" axis="0 1 0"/><inertial mass="1.2" pos=".05 0 .12" diaginertia=".006 .006 .001"/>
</body></body></body></worldbody></mujoco>"""
JOINTS = ("yaw", "shoulder", "elbow")
FILE = "kind: robot\nmodel: arm.xml\ngravity_compensation: 1.0\njoints:\n" + "".join(
    f"  {name}: {{kp: {kp}, kd: {kd}, gains: commanded, rotor_inertia: {rotor}}}\n"
    for name, kp, kd, rotor in zip(
        JOINTS, (120, 150, 80), (6, 9, 3), (0.04, 0.06, 0.03), strict=True
    )
)
COLUMNS = ("measured", "target", "effort")


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> RobotMachine:
    return robot_machine(tmp_path_factory.mktemp("arm"), ARM, FILE)


def recordings(machine: RobotMachine) -> list[Measurement]:
    """A chirp of shoulder and elbow, a slow motion of the elbow, and one so slow that either joint's model reproduces it."""
    time_s, found = np.arange(1600) / 200, []
    for name, phase, moved in (
        ("chirp", 0.8 * time_s + 0.1 * time_s**2, (0.0, 0.4, 0.3)),
        ("slow", 0.15 * time_s, (0.0, 0.0, 0.9)),
        ("creep", 0.02 * time_s, (0.0, 0.03, 0.03)),
    ):
        waves = np.sin(
            2 * np.pi * phase[:, None] * np.array([1.0, 0.7, 1.0])
        ) * np.clip(time_s[:, None] - 0.5, 0, 1)
        target, zero = np.array([0.1, 0.5, 0.7]) + waves * moved, np.zeros((1600, 3))
        m = logged(
            name,
            JOINTS,
            ("rad",) * 3,
            time_s=time_s,
            target=target,
            measured=target,
            effort=zero,
        )
        noise = np.random.default_rng(len(found)).standard_normal((2, 1600, 3))
        for _ in range(3):  # each joint answers to the motion of the others
            done = replay_joints(machine.robot, machine._whole(m), JOINTS)
            m = dataclasses.replace(m, measured=done.reported, effort=done.effort)
        found.append(
            dataclasses.replace(
                m,
                measured=m.measured + 1e-4 * noise[0],
                effort=m.effort + 0.02 * noise[1],
            )
        )
    return found


def errors(machine: RobotMachine, made: list[Measurement]) -> set[tuple[str, str]]:
    found, own = check_measurements(made), machine.check(Measurements(tuple(made)))
    one = one_cause({m.name: [*found[m.name], *own[m.name]] for m in made}, made)
    return {
        (f.check, f.topic or f.feature)
        for findings in one.values()
        for f in findings
        if f.severity == "error"
    }


def changed(
    m: Measurement, columns: tuple[str, ...], order: list[int], sign: Any = 1.0
) -> Measurement:
    return dataclasses.replace(
        m, **{name: getattr(m, name)[:, order] * sign for name in columns}
    )


@pytest.mark.parametrize(
    "columns",
    [COLUMNS, ("measured", "target"), ("measured",), ("target",), ("effort",)],
)
def test_exchanged_columns_of_two_joints_are_named(
    machine: RobotMachine, columns: tuple[str, ...]
) -> None:
    right = [dataclasses.replace(m, source=Path("a.csv")) for m in recordings(machine)]
    if columns == ("measured", "target"):
        right = [
            dataclasses.replace(m, velocity=np.gradient(m.measured, 0.005, axis=0))
            for m in right
        ]
    wrong = [changed(m, columns, [0, 2, 1]) for m in right]
    assert errors(machine, wrong) == {("swapped_joints", "elbow ↔ shoulder")}
    if (
        len(columns) > 1
    ):  # the columns file that is printed; velocities are right as they are
        said = {
            f.text
            for own in machine.check(Measurements(tuple(wrong))).values()
            for f in own
        }
        (text,) = {
            line for text in said for line in re.findall("`(changes: .*?}})`", text)
        }
        keys = ("q", "q_target", *["tau"] * ("effort" in columns))
        pairs = [
            (a, b, key)
            for key in keys
            for a, b in (("shoulder", "elbow"), ("elbow", "shoulder"))
        ]
        assert yaml.safe_load(text)["changes"] == {
            f"{a}.{key}": {"column": f"{b}.{key}"} for a, b, key in pairs
        }


def test_exchanged_targets_are_named_at_a_joint_that_is_held_too(
    machine: RobotMachine,
) -> None:
    """The elbow's motion shakes the held shoulder by 30 mrad; no other fault is said of it."""
    m = recordings(machine)[1]
    shaken = m.measured + np.array([0.0, 0.03, 0.0]) * np.sin(20.0 * m.time_s)[:, None]
    found = errors(machine, [dataclasses.replace(m, measured=m.target, target=shaken)])
    assert {("exchanged_target", "elbow"), ("exchanged_target", "shoulder")} <= found
    assert not {check for check, _ in found} & {"dead_channel", "swapped_joints"}


@pytest.mark.parametrize("joint", ["shoulder", "elbow"])
def test_a_position_against_its_command_is_no_joint_that_is_turned_in_all_columns(
    machine: RobotMachine, joint: str
) -> None:
    """The weight is reversed in the model as well, which the reversed position explains."""
    sign = [-1.0 if name == joint else 1.0 for name in JOINTS]
    made = [
        changed(m, ("measured",), [0, 1, 2], np.array(sign))
        for m in recordings(machine)
    ]
    assert errors(machine, made) == {("reversed", joint)}


def test_a_joint_that_is_turned_in_all_columns_is_named_where_its_weight_shows_it(
    machine: RobotMachine,
) -> None:
    right = recordings(machine)
    turned = [changed(m, COLUMNS, [0, 1, 2], [1.0, 1.0, -1.0]) for m in right]
    assert errors(machine, turned) == {("wrong_sign", "sign of elbow")}
    assert (
        errors(
            machine,
            [dataclasses.replace(m, effort=np.full((1600, 3), np.nan)) for m in turned],
        )
        == set()
    )
    assert (
        errors(
            machine, [changed(m, COLUMNS, [0, 1, 2], [-1.0, 1.0, 1.0]) for m in right]
        )
        == set()
    )


@pytest.mark.parametrize(
    "place",
    [
        "-.05 0 .12",
        *(
            pytest.param(p, marks=pytest.mark.slow)
            for p in ("-.05 0 -.12", ".12 0 -.05")
        ),
    ],
)
@pytest.mark.parametrize(
    "carried", ["1.0", pytest.param("0.0", marks=pytest.mark.slow)]
)
def test_another_centre_of_mass_is_no_wrong_sign_of_effort_or_joint(
    place: str, carried: str, tmp_path: Path
) -> None:
    """The law of the drives holds whatever turns: only a reversed effort breaks it, at its own joint."""
    (tmp_path / "model").mkdir()
    file = FILE.replace("compensation: 1.0", f"compensation: {carried}")
    stated = robot_machine(tmp_path, ARM, file)
    there = robot_machine(tmp_path / "model", ARM.replace(".05 0 .12", place), file)
    made = recordings(there)
    assert errors(stated, made) == set()
    against = [changed(m, ("effort",), [0, 1, 2], [1.0, 1.0, -1.0]) for m in made]
    assert errors(stated, against) == {("reversed_effort", "elbow")}


def test_a_reversed_effort_that_most_recordings_hardly_show_is_that_and_no_other_time(
    machine: RobotMachine, tmp_path: Path
) -> None:
    """Noise of 2 N·m in slow motions hides the law of all recordings together, not that of the two quick ones. The forearm's
    centre of mass is elsewhere, so that inertia does not show the sign."""
    there = robot_machine(tmp_path, ARM.replace(".05 0 .12", ".12 0 -.05"), FILE)
    quick, slow, creep = (
        changed(m, ("effort",), [0, 1, 2], [1.0, 1.0, -1.0]) for m in recordings(there)
    )
    noise = np.random.default_rng(5).standard_normal((4, 1600, 3)) * [0.0, 0.0, 2.0]
    made = [quick, dataclasses.replace(quick, name="quicker")]
    for k, m in enumerate([slow, creep] * 2):
        made.append(
            dataclasses.replace(m, name=f"{m.name}_{k}", effort=m.effort + noise[k])
        )
    law = machine.robot.config.joints["elbow"]
    fits = [law_fit(law, own, "elbow") for own in (made, made[:1])]
    assert [fit and fit.sign for fit in fits] == [0, -1], "or the case is none"
    assert errors(machine, made) == {("reversed_effort", "elbow")}


def test_gains_beside_a_target_share_that_no_drive_has_show_no_sign_of_the_effort() -> (
    None
):
    """Fits of a surrogate of kp 60, kd 5, 0.036 kg·m², right efforts (r 32), and of reversed ones of another mass (r 1.5)."""
    assert LawFit(-0.0419, 0.0439, (0.006, 0.005), 0.178, 1.321).sign == 0
    assert LawFit(-1.8815, -1.4905, (0.106, 0.066), 0.326, 2.879).sign == -1


@pytest.mark.parametrize(
    ("kp", "kd", "noisy"),
    [
        (2, 2, 0),
        (1, 2, 0),
        (2, 1, 1),
        (1, 1, 1),
        pytest.param(2, 1, 0, marks=pytest.mark.slow),
    ],
)
def test_efforts_show_the_gains_of_drives(
    machine: RobotMachine, kp: int, kd: int, noisy: int, tmp_path: Path
) -> None:
    """Also beside friction, and with noise of 3 rad/s · 1 mrad / (√2 · 5 ms) = 0.4 N·m in the elbow's law."""
    stated = re.sub(
        r"kp: (\d+), kd: (\d+)",
        lambda m: f"kp: {kp * int(m[1])}, kd: {kd * int(m[2])}",
        FILE,
    )
    made = (
        hidden(machine, "coulomb_friction", {"torque_nm": 0.5}, "elbow")
        if noisy
        else recordings(machine)
    )
    noise = noisy * 1e-3 * np.random.default_rng(9).standard_normal((1600, 3))
    made = [dataclasses.replace(m, measured=m.measured + noise) for m in made]
    found = robot_machine(tmp_path, ARM, stated).check(Measurements(tuple(made)))
    said = {
        f.feature: re.findall(r"k[pd]: ([\d.]+)", f.text)
        for own in found.values()
        for f in own
    }
    named = {(1, 1): set(), (2, 2): {"other_scale"}}.get((kp, kd), {"other_gains"})
    assert {f.check for own in found.values() for f in own} == named
    for name, true in (
        (("shoulder", (150.0, 9.0)), ("elbow", (80.0, 3.0))) if said else ()
    ):
        assert [float(x) for x in said.pop(name)] == pytest.approx(
            true, rel=0.1 if noisy else 0.02
        )
    assert not said, "the yaw stands still"


EXCHANGED = ("swapped_joints", "elbow ↔ shoulder")
HIDDEN = [
    ("command_delay", {"delay_s": 0.03}, set()),
    ("coulomb_friction", {"torque_nm": 3.0}, {EXCHANGED}),
    pytest.param(
        "command_lag", {"time_constant_s": 0.05}, set(), marks=pytest.mark.slow
    ),
    pytest.param(
        "torque_saturation", {"torque_max_nm": 4.0}, set(), marks=pytest.mark.slow
    ),
    pytest.param(
        "unbalance",
        {"torque_nm": 3.0, "hangs_at_rad": 1.0},
        {EXCHANGED},
        marks=pytest.mark.slow,
    ),
    pytest.param("armature", {"added_kgm2": 0.2}, {EXCHANGED}, marks=pytest.mark.slow),
]
"""Effect, its numbers, and what is said of exchanged columns besides: laws show those where the effect is not in the drive."""


def hidden(
    machine: RobotMachine, effect: str, numbers: dict[str, float], *joints: str
) -> list[Measurement]:
    return recordings(
        machine.with_additions(
            [Addition(j, [make_effect(effect, **numbers)], {}, {}) for j in joints]
        )
    )


@pytest.mark.parametrize(("effect", "numbers", "named"), HIDDEN)
def test_effects_are_no_exchange_and_no_turned_sign_and_hide_none(
    machine: RobotMachine,
    effect: str,
    numbers: dict[str, float],
    named: set[tuple[str, str]],
) -> None:
    made = hidden(machine, effect, numbers, "shoulder", "elbow")
    said = {check for check, _ in errors(machine, made)}
    assert not said & {"swapped_joints", "exchanged_target", "wrong_sign", "reversed"}
    unseen = [dataclasses.replace(m, effort=np.full((1600, 3), np.nan)) for m in made]
    for own in (made, unseen):
        # no other gains, time or sign of efforts either
        assert not any(machine.check(Measurements(tuple(own))).values())
    for columns in (COLUMNS, COLUMNS[:2]) if named else ():
        assert (
            errors(machine, [changed(m, columns, [0, 2, 1]) for m in made]) == named
        ), columns


@pytest.mark.parametrize(
    ("effect", "number", "late"),
    [("armature", "added_kgm2", 0), ("command_delay", "delay_s", 1)],
)
def test_another_inertia_is_no_late_clock(
    machine: RobotMachine, effect: str, number: str, late: int
) -> None:
    clock = machine.compare(
        Measurements(tuple(hidden(machine, effect, {number: 0.02}, "elbow")[:2]))
    ).clock
    assert (
        any(f.check == "shifted_from_twin" for own in clock.values() for f in own)
        == late
    )


def test_without_efforts_the_replay_names_columns_that_are_exchanged_besides_friction(
    machine: RobotMachine,
) -> None:
    """Friction of 0.6 N·m at the elbow leaves 5 times less of the replay with the right columns, but not all."""
    made = hidden(machine, "coulomb_friction", {"torque_nm": 0.6}, "elbow")
    silent = [dataclasses.replace(m, effort=np.full((1600, 3), np.nan)) for m in made]
    assert errors(machine, silent) == set()
    assert errors(machine, [changed(m, COLUMNS, [0, 2, 1]) for m in silent]) == {
        EXCHANGED
    }
    alone = made[1:2]  # moves the elbow alone: then replay and law must both say so
    assert errors(machine, alone) == set()
    assert errors(machine, [changed(m, COLUMNS, [0, 2, 1]) for m in alone]) == {
        EXCHANGED
    }

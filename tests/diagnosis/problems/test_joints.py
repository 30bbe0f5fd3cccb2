"""Joint by joint, and the twin that comes out of it."""

import dataclasses
from signal import SIGKILL, raise_signal

import numpy as np
import pytest
from imagined_motions import SIGNAL, recorded
from made_rows import of_signal

from taccorl.alignment.measurements.folder import Measurements
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.alignment.measurements.motions import (
    AGAIN,
    CHIRP,
    VALIDATION,
    joint_number,
)
from taccorl.diagnosis.comparison.compare import compare
from taccorl.diagnosis.machines.machine import diagnose_parts
from taccorl.diagnosis.machines.piper import PiperTwin
from taccorl.diagnosis.problems.joints import (
    MOVES_RAD,
    JointFinding,
    add_effect,
    diagnose_joint,
    each,
    moves,
    of_joints,
    set_numbers,
    swept_joints,
)
from taccorl.diagnosis.search.result import SearchConfig
from taccorl.errors import TaccorlError
from taccorl.report.account import account
from taccorl.robots import ROBOT
from taccorl.sim.effects import effects, make_effect
from taccorl.sim.twin import TwinConfig
from taccorl.sim.twin_file import load_twin, save_twin, twin_digest

TRUTH_NM = 1.0
CONSIDERED = ("coulomb_friction", "asymmetric_friction", "viscous_friction", "backlash")
WITHOUT = [name for name in effects if name not in CONSIDERED]
ONE = SearchConfig(max_effects=1)


def still(name: str = "still", **spans: float) -> Measurement:
    """A recording whose targets go from 0 to the spans, as {left_joint5: 0.1}."""
    target = np.zeros((50, 14))
    for signal, span in spans.items():
        target[25:, ROBOT.action_names.index(signal)] = span
    return Measurement(
        name=name, time_s=np.arange(50) / 200, target=target, measured=target.copy()
    )


def sweeps(
    signal: str = SIGNAL, torque_nm: float = TRUTH_NM, stated: bool = True
) -> Measurements:
    arm, joint = signal.split("_")
    truth = TwinConfig(
        effects=[
            make_effect(
                "coulomb_friction", torque_nm=torque_nm, arm=arm, joints=[joint]
            )
        ]
    )
    made = [
        recorded(truth, m, k, signal=signal, stated=stated)
        for k, m in enumerate((CHIRP, AGAIN, VALIDATION[0]))
    ]
    return Measurements(tuple(made[:2]), (made[2],))


@pytest.fixture(scope="module")
def finding() -> JointFinding:
    return diagnose_joint(
        TwinConfig(), SIGNAL, sweeps(stated=False), search=ONE, without=WITHOUT
    )


def test_gains_that_recordings_state_wrongly_are_found_and_no_effect_instead():
    """The drive runs kp of the twin; the recordings state half as much again."""
    right = sweeps(torque_nm=0.0)
    true_kp, true_kd = (getattr(right.fit[0], name)[SIGNAL] for name in ("kp", "kd"))
    stated = {"kp": {SIGNAL: 1.5 * true_kp}, "kd": {SIGNAL: true_kd}}
    fit, validation = (
        tuple(dataclasses.replace(m, **stated) for m in own)
        for own in (right.fit, right.validation)
    )
    found = diagnose_joint(
        TwinConfig(), SIGNAL, Measurements(fit, validation), search=ONE, without=WITHOUT
    ).diagnosis
    assert found.names == ()
    assert found.errors["after"]["validation"] < 1.2
    # kp of the twin, which the recordings say they multiply by 1.5.
    assert 1.5 * found.base["kp"] / found.base["kd"] == pytest.approx(
        true_kp / true_kd, rel=0.02
    )


def test_recordings_of_other_joints_are_left_out():
    own, other, both = (
        still("own", left_joint5=0.1),
        still("other", left_joint2=0.1),
        still("both", left_joint2=0.1, left_joint5=0.1),
    )
    kept = of_joints(Measurements((own, other), (both,), (other,)), ["left_joint5"])
    assert (kept.fit, kept.validation, kept.test) == ((own,), (both,), ())


def test_a_joint_is_moved_by_what_was_measured_where_its_targets_are_no_positions():
    pushed = dataclasses.replace(still("pushed"), target_kinds=("torque",) * 14)
    assert not moves(pushed, SIGNAL)
    pushed.measured[25:, ROBOT.action_names.index(SIGNAL)] = 0.1
    assert moves(pushed, SIGNAL)


def test_a_joint_is_swept_if_a_fit_recording_commands_it_to_move():
    few = 0.9 * MOVES_RAD
    fit = (
        still("a", left_joint5=0.1, left_joint2=few),
        still("b", right_joint1=-0.2, left_gripper=0.03),
    )
    validation = (still("c", left_joint6=0.1),)
    assert swept_joints(Measurements(fit, validation)) == (SIGNAL, "right_joint1")
    assert swept_joints(Measurements((still(),))) == ()
    assert (
        moves(fit[0], SIGNAL)
        and not moves(fit[0], "left_joint2")
        and not moves(fit[1], SIGNAL)
    )


def test_a_signal_that_a_recording_lacks_does_not_move_in_it():
    assert not moves(
        of_signal("drive", 1.0, np.eye(3)[0], np.eye(3)[0], "drive", "m"), SIGNAL
    )


def test_a_joint_that_no_fit_recording_moves_is_refused():
    with pytest.raises(TaccorlError, match="right_joint1: no fit recording moves it"):
        diagnose_joint(TwinConfig(), "right_joint1", sweeps())


def test_the_friction_is_found_at_its_joint_with_fitted_gains(finding):
    d = finding.diagnosis
    assert (finding.part, finding.rows_split) == (
        SIGNAL,
        False,
    ) and finding.numbers.startswith("gains fitted")
    assert d.names == ("coulomb_friction",) and d.status == "at_floor"
    assert d.after.values["coulomb_friction.torque_nm"] == pytest.approx(
        TRUTH_NM, rel=0.03
    )
    assert "asymmetric_friction" in d.rivals["coulomb_friction"]
    assert finding.recordings == {
        "fit": ("chirp", "chirp_again"),
        "validation": ("held_chirp",),
        "test": (),
    }
    assert len(finding.floors) == 1, "no effort was recorded"


@pytest.mark.slow
def test_recordings_that_leave_the_joint_alone_are_left_out(finding):
    made = sweeps(stated=False)
    more = dataclasses.replace(made, fit=(*made.fit, still("other", right_joint1=0.3)))
    again = diagnose_joint(TwinConfig(), SIGNAL, more, search=ONE, without=WITHOUT)
    assert (
        again.recordings == finding.recordings
        and again.diagnosis.errors == finding.diagnosis.errors
    )


@pytest.mark.slow
def test_without_validation_recordings_the_last_rows_judge():
    made = dataclasses.replace(sweeps(), validation=())
    found = diagnose_joint(TwinConfig(), SIGNAL, made, search=ONE, without=WITHOUT)
    assert found.rows_split and found.recordings["validation"] == ()
    assert found.diagnosis.names == ("coulomb_friction",)
    n = made.fit[0].num_rows
    # 60 % of the rows of both chirps were fitted to
    assert len(found.diagnosis.after.residuals) == 2 * round(0.6 * n)


@pytest.mark.slow
def test_two_workers_find_the_same_as_one():
    made = [sweeps(SIGNAL), sweeps("right_joint6", 0.4)]
    named = [
        dataclasses.replace(
            m, name=f"{m.name} {k}", repeat_of=m.repeat_of and f"{m.repeat_of} {k}"
        )
        for k, of in enumerate(made)
        for m in of.fit
    ]
    both = Measurements(tuple(named))
    joints = swept_joints(both)
    assert joints == (SIGNAL, "right_joint6")
    told: list[str] = []
    found = [
        diagnose_parts(
            PiperTwin.nominal(),
            joints,
            both,
            search=ONE,
            without=WITHOUT,
            workers=n,
            done=told.append,
        )
        for n in (1, 2)
    ]
    assert sorted(told) == sorted(2 * joints)
    for one, two in zip(*found, strict=True):
        assert one.part == two.part and one.diagnosis.names == two.diagnosis.names == (
            "coulomb_friction",
        )
        assert one.diagnosis.base == two.diagnosis.base
        assert one.diagnosis.errors == two.diagnosis.errors
        assert one.diagnosis.effects == two.diagnosis.effects


def of_left_arm(**shares: float) -> Measurements:
    """Recordings of joints, each with Coulomb friction of 1 N·m and its own share of the weight that is compensated."""
    fit, validation = [], []
    for joint, share in shares.items():
        friction = make_effect(
            "coulomb_friction", torque_nm=1.0, arm="left", joints=[joint]
        )
        truth = TwinConfig(
            effects=[make_effect("gravity_mismatch", arm="left", share=share), friction]
        )
        for k, m in enumerate((CHIRP, AGAIN, VALIDATION[0])):
            made = recorded(truth, m, k, signal=f"left_{joint}")
            again = made.repeat_of and f"{made.repeat_of} {joint}"
            (fit if k < 2 else validation).append(
                dataclasses.replace(made, name=f"{made.name} {joint}", repeat_of=again)
            )
    return Measurements(tuple(fit), tuple(validation))


@pytest.mark.parametrize("other", [0.5, pytest.param(1.0, marks=pytest.mark.slow)])
def test_weight_that_an_arm_does_not_compensate_is_one_number_or_no_cause(other):
    made = of_left_arm(joint2=0.5, joint3=other)
    without = [
        name
        for name in effects
        if name not in ("coulomb_friction", "gravity_mismatch", "unbalance")
    ]
    found = diagnose_parts(
        PiperTwin.nominal(), swept_joints(made), made, without=without
    )
    mended = PiperTwin.nominal().mended(found)[0].config.effects
    shares = [e.share for e in mended if e.name == "gravity_mismatch"]
    if (
        other == 1.0
    ):  # the joint beside it compensates its weight: then the share of the arm is no cause
        assert shares == []
        of_arm = account(found[0].part, found[0].diagnosis)
        assert of_arm.values("shared_without", "name") == ["gravity_mismatch"]
        assert found[1].diagnosis.names == ("coulomb_friction",)
        return
    assert shares == [pytest.approx(0.5, abs=0.01)]
    assert sum("gravity_mismatch" in f.diagnosis.names for f in found) == 1
    frictions = {
        e.joints[0]: e.torque_nm for e in mended if e.name == "coulomb_friction"
    }
    assert frictions == {
        "joint2": pytest.approx(1.0, abs=0.03),
        "joint3": pytest.approx(1.0, abs=0.03),
    }


def test_a_worker_that_dies_or_fails_is_told_with_its_joint_and_what_to_do():
    asked = {f"left_joint{k}": SIGKILL for k in (2, 3)}
    said = r"left_joint\d: .*killed by SIGKILL.*lack of memory.*--workers=1 needs less"
    with pytest.raises(TaccorlError, match=said):
        each(raise_signal, asked, 2, print)
    for workers in (1, 2):
        with pytest.raises(TaccorlError, match=r"^no joint 'left_joint7'"):
            each(
                joint_number,
                {"one": "left_joint1", "other": "left_joint7"},
                workers,
                print,
            )


def test_the_mended_twin_is_at_the_floor_and_comes_back_from_its_file(
    finding, tmp_path
):
    nominal = TwinConfig()
    twin = PiperTwin(nominal).mended([finding])[0].config
    assert nominal == TwinConfig(), "the twin that went in is as it was"
    save_twin(twin, tmp_path / "twin.yaml")
    read = load_twin(tmp_path / "twin.yaml")
    assert twin_digest(read) == twin_digest(twin) and read == twin
    (effect,) = read.effects
    assert effect.acts_on() == [SIGNAL] and "validation error" in effect.evidence
    low, high = effect.interval["torque_nm"]
    assert low < vars(effect)["torque_nm"] < high
    ratio = [
        next(
            s.ratio
            for s in compare(c, sweeps(stated=False)).scores()
            if s.use == "validation" and s.kind == "position"
        )
        for c in (nominal, read)
    ]
    assert ratio[0] > 10.0 and ratio[1] < 1.25


def test_gains_go_to_one_arm_and_leave_the_other(tmp_path):
    twin = TwinConfig()
    set_numbers(
        twin,
        "left_joint3",
        {"kp": 500.0, "kd": 40.0, "torque_ff": -1.0, "effort_scale": 2.0},
    )
    plain = TwinConfig().controller
    assert twin.controller == plain == twin.controller_of("right")
    left = twin.controller_of("left")
    assert (left.kp_nm_per_rad[2], left.kd_nms_per_rad[2], left.torque_ff_nm[2]) == (
        500.0,
        40.0,
        -1.0,
    )
    for k in (0, 1, 3, 4, 5):
        assert left.kp_nm_per_rad[k] == plain.kp_nm_per_rad[k]
    set_numbers(twin, "left_joint1", {"torque_ff": 0.25})
    assert (left.torque_ff_nm[0], left.kp_nm_per_rad[2]) == (0.25, 500.0), (
        "the second joint keeps the first"
    )
    save_twin(twin, tmp_path / "twin.yaml")
    read = load_twin(tmp_path / "twin.yaml")
    assert read == twin and read.controller_of("right") == plain


def friction(torque_nm: float, arm: str, *joints: str):
    return make_effect(
        "coulomb_friction",
        torque_nm=torque_nm,
        arm=arm,
        joints=list(joints or ROBOT.joints),
    )


def torques(config: TwinConfig) -> dict[str, float]:
    """Joint → its friction; each may be named once."""
    found = {}
    for effect in config.effects:
        for signal in effect.acts_on():
            assert signal not in found
            found[signal] = vars(effect)["torque_nm"]
    return found


def test_an_entry_of_all_joints_gives_up_the_one_that_is_replaced(tmp_path):
    twin = TwinConfig(effects=[friction(0.1, "both")])
    add_effect(twin, friction(0.7, "left", "joint5"))
    expected = {
        f"{arm}_{joint}": 0.1 for arm in ROBOT.arms for joint in ROBOT.joints
    } | {SIGNAL: 0.7}
    assert torques(twin) == expected
    save_twin(twin, tmp_path / "twin.yaml")
    assert torques(load_twin(tmp_path / "twin.yaml")) == expected
    add_effect(twin, friction(0.2, "both"))
    assert torques(twin) == dict.fromkeys(expected, 0.2) and len(twin.effects) == 1


def test_other_joints_and_other_effects_stay_as_they_are():
    others = [
        friction(0.1, "left", "joint4"),
        make_effect("backlash", play_rad=0.01, arm="left", joints=["joint5"]),
    ]
    twin, new = TwinConfig(effects=list(others)), friction(0.7, "left", "joint5")
    add_effect(twin, new)
    assert twin.effects == [*others, new]
    assert all(kept is old for kept, old in zip(twin.effects, others, strict=False))


@pytest.mark.parametrize(
    ("name", "number", "of_all", "where", "places"),
    [
        ("payload", "mass_kg", {"arm": "both"}, {"arm": "left"}, {"left": 0.5, "right": 0.2}),
        ("touch_lag", "time_constant_s", {}, {"pads": ["left_a", "right_b"]},
         dict.fromkeys(ROBOT.pads, 0.2) | {"left_a": 0.5, "right_b": 0.5}),
    ],
)  # fmt: skip
def test_an_effect_of_an_arm_or_of_pads_leaves_the_others_their_own(
    name, number, of_all, where, places
):
    twin = TwinConfig(effects=[make_effect(name, **{number: 0.2}, **of_all)])
    add_effect(twin, make_effect(name, **{number: 0.5}, **where))
    assert sorted(
        (p, vars(e)[number]) for e in twin.effects for p in e.acts_on()
    ) == sorted(places.items())

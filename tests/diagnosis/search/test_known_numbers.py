"""Numbers that a machine's file marks as known stay, and a wrong one is named: a slide of 100 kg with 20 N of friction."""

from pathlib import Path
from typing import Any

import pytest
from axes import altered, config_of, problem_of
from made_problem import Bump, Hidden, MadeProblem, Ripple, record
from simulated_slide import AXIS, FRICTION_N, MASS_KG, recorded_slide

from taccorl.alignment.machines.robot_file import load_robot
from taccorl.diagnosis.search.problem import Stopped, holding
from taccorl.diagnosis.search.result import Diagnosis, SearchConfig
from taccorl.diagnosis.search.solve import solve
from taccorl.errors import TaccorlError


def found(*candidates: str, **changed: Any) -> Diagnosis:
    problem = problem_of(altered(AXIS, **changed), recorded_slide())
    without = [
        n for n in problem.candidates if n not in (*candidates, *problem.present)
    ]
    return solve(
        "drive",
        problem,
        problem.fit,
        problem.validation,
        (),
        SearchConfig(max_effects=1),
        without,
    ).diagnosis


def test_a_known_mass_stays_and_the_rest_is_found_beside_it():
    d = found("coulomb_friction", inertia=MASS_KG, known=("inertia",))
    assert d.names == ("coulomb_friction",) and d.status == "at_floor"
    assert d.after.values["inertia"] == MASS_KG
    assert (
        "inertia" not in d.base
        and "inertia" not in d.intervals
        and "torque_ff" in d.base
    )
    assert d.after.values["coulomb_friction.torque_nm"] == pytest.approx(
        FRICTION_N, rel=0.02
    )
    assert d.remarks == ()


@pytest.mark.slow
def test_a_wrong_known_mass_is_named_with_the_mass_that_the_recordings_have():
    """The file says 80 kg; the recordings 100."""
    d = found("coulomb_friction", inertia=80.0, known=("inertia",))
    assert d.after.values["inertia"] == 80.0
    (remark,) = d.remarks
    assert "inertia 80 kg" in remark and "`known`" in remark
    assert float(remark.split("with inertia ")[1].split(" ")[0]) == pytest.approx(
        MASS_KG, rel=0.01
    )


def test_a_stop_after_an_effect_was_added_keeps_it_beside_known_numbers():
    """The known gain is right; of ripple and bump the ripple is there when the user stops."""
    problem: Any = MadeProblem(Ripple, Bump)
    problem.start, problem.present, problem.known = (
        {"gain": 3.0, "offset": 0.0},
        (),
        ("gain",),
    )
    problem.base = holding(problem.base, problem.known, problem.start)
    recordings = [
        record(k, Ripple(strength=1.0), Bump(strength=1.0), noise=0.1) for k in range(2)
    ]
    said = [""]

    def progress(text: str) -> None:
        said.append(text)
        if any(one.startswith("ripple, validation error") for one in said):
            raise Stopped

    assert solve(
        "made", problem, recordings[:1], recordings[1:], (), progress=progress
    ).diagnosis.names == ("ripple",)


@pytest.mark.parametrize(
    ("stated", "names", "num"), [(2.0, ("hidden",), 1), (3.0, (), 0)]
)
def test_an_effect_that_only_makes_up_for_a_wrong_known_number_is_named(
    stated: float, names: tuple[str, ...], num: int
):
    """The gain is 3. ``hidden`` has the same signal: with a gain of 2 held, one unit of it is found."""
    problem: Any = MadeProblem(Hidden)
    problem.start, problem.present, problem.known = (
        {"gain": stated, "offset": 0.0},
        (),
        ("gain",),
    )
    problem.base = holding(problem.base, problem.known, problem.start)
    d = solve("made", problem, [record(0), record(1)], [record(2)], ()).diagnosis
    assert d.names == names and len(d.remarks) == num
    assert d.after.values["gain"] == stated
    if num:
        assert d.after.values["hidden.strength"] == pytest.approx(1.0, abs=0.02)
        assert "gain 2 " in d.remarks[0] and "in place of hidden" in d.remarks[0]
        assert float(d.remarks[0].split("; gain ")[1].split(" ")[0]) == pytest.approx(
            3.0, abs=0.02
        )


def test_an_effect_that_is_known_to_be_absent_is_not_added_and_its_absence_is_doubted():
    d = found("coulomb_friction", inertia=MASS_KG, known=("coulomb_friction",))
    assert d.names == ()
    (remark,) = d.remarks
    assert "coulomb_friction is marked as known to be absent" in remark
    assert float(
        remark.split("coulomb_friction.torque_nm ")[1].split(" ")[0]
    ) == pytest.approx(FRICTION_N, rel=0.05)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("inertias", "did you mean .inertia"),
        ("effort_limit", "effort_limit"),
        ("coulomb_friction.torque_nm", "no effect"),
    ],
)
def test_a_name_that_no_diagnosis_moves_is_refused_with_its_line(
    tmp_path: Path, name: str, words: str
):
    path = tmp_path / "drive.yaml"
    lines = [
        "kind: axis",
        "name: drive",
        "unit: m",
        "inertia: 80",
        "kp: 4.0e4",
        "kd: 2800",
        f"known: [{name}]",
    ]
    path.write_text("\n".join(lines), encoding="utf-8")
    with pytest.raises(TaccorlError, match=words) as error:
        load_robot(path)
    assert "drive.yaml:7:" in str(error.value) and name in str(error.value)


def test_what_is_known_is_read_as_it_is_written(tmp_path: Path):
    friction = ("coulomb_friction", {"torque_nm": FRICTION_N})
    axis = altered(
        AXIS,
        effects=(friction,),
        known=("inertia", "coulomb_friction.torque_nm", "backlash"),
    )
    (tmp_path / "drive.yaml").write_text(axis.text(axis.path), encoding="utf-8")
    assert config_of(load_robot(tmp_path / "drive.yaml")).known == (
        config_of(axis).known
    )

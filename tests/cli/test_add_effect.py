"""``taccorl add-effect`` as a user types it, with a diagnosis of sweeps that the twin itself made (not a robot's)."""

import json
from pathlib import Path
from typing import Any

import pytest
import yaml
from imagined_motions import QUICK_AGAIN, QUICK_CHIRP, QUICK_VALIDATION, recorded
from simulated_sweeps import write_folder

from taccorl.alignment.measurements.folder import Measurements
from taccorl.cli.main import main
from taccorl.robots import ROBOT
from taccorl.sim.effects import effects, make_effect
from taccorl.sim.twin import TwinConfig
from taccorl.sim.twin_file import load_twin, save_twin

VERB, ONE_LINE = "add-effect", True
SIGNAL = "left_joint4"  # the paper's J3
TRUTH_NM = 0.8
KEPT = (
    "coulomb_friction",
    "asymmetric_friction",
)  # the search among more is tested elsewhere


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``sweeps/``, ``twin.yaml`` and ``diagnosis/`` of it, with gains fitted."""
    path = tmp_path_factory.mktemp("add_effect")
    truth = TwinConfig(
        effects=[
            make_effect(
                "coulomb_friction", torque_nm=TRUTH_NM, arm="left", joints=["joint4"]
            )
        ]
    )
    made = [
        recorded(truth, m, k, signal=SIGNAL, stated=False, effort=True)
        for k, m in enumerate((QUICK_CHIRP, QUICK_AGAIN, QUICK_VALIDATION))
    ]
    write_folder(
        path / "sweeps",
        Measurements(tuple(made[:2]), (made[2],)),
        ROBOT.action_names[:7],
    )
    save_twin(TwinConfig(), path / "twin.yaml")
    without = ",".join(name for name in effects if name not in KEPT)
    words = [
        f"--twin={path / 'twin.yaml'}",
        f"--out={path / 'diagnosis'}",
        f"--without=[{without}]",
    ]
    assert main(["diagnose", str(path / "sweeps"), *words]) == 0
    return path


@pytest.fixture
def words(folder: Path) -> list[str]:
    return [f"--twin={folder / 'twin.yaml'}", f"--diagnosis={folder / 'diagnosis'}"]


@pytest.mark.parametrize(
    ("key", "names", "says"),
    [
        pytest.param(
            "at_bound", ["kp"], "the fit ended with kp", marks=pytest.mark.slow
        ),
        ("at_bound", [], ""),
        ("undetermined", ["kd"], "its recordings do not determine kd;"),
    ],
)
def test_numbers_at_a_bound_or_undetermined_are_written_with_a_warning(
    folder, said, tmp_path, key, names, says
):
    report = json.loads((folder / "diagnosis" / "report.json").read_text())
    assert report["diagnoses"][SIGNAL][key] == []
    report["diagnoses"][SIGNAL][key] = names
    (tmp_path / "report.json").write_text(json.dumps(report))
    words = [
        f"--twin={folder / 'twin.yaml'}",
        f"--diagnosis={tmp_path}",
        f"--out={tmp_path / 'new.yaml'}",
    ]
    code, text = said("coulomb_friction", *words)
    assert code == 0
    assert (
        f"warning: {SIGNAL}: {says}" in text
        if names
        else f"warning: {SIGNAL}: the fit ended" not in text
    )


def test_what_was_found_goes_into_a_copy_and_the_error_falls(folder, said, words):
    before = (folder / "twin.yaml").read_bytes()
    code, text = said("coulomb_friction", *words)
    copy = folder / "twin+coulomb_friction.yaml"
    assert code == 0 and f"wrote {copy}" in text
    assert f"{SIGNAL}: old new coulomb_friction.torque_nm – 0." in text
    assert (folder / "twin.yaml").read_bytes() == before
    twin = load_twin(copy)
    (effect,) = twin.effects
    assert effect.acts_on() == [SIGNAL] and vars(effect)["torque_nm"] == pytest.approx(
        TRUTH_NM, rel=0.03
    )
    low, high = effect.interval["torque_nm"]
    assert (
        low < vars(effect)["torque_nm"] < high and "validation error" in effect.evidence
    )
    # gains that were refitted with it come along, for this joint of this arm
    found = json.loads((folder / "diagnosis" / "report.json").read_text())["diagnoses"][
        SIGNAL
    ]
    assert twin.controller_of("left").kp_nm_per_rad[3] == pytest.approx(
        found["base"]["kp"]
    )
    old, new = TwinConfig().controller.kp_nm_per_rad[3], found["base"]["kp"]
    assert f" kp {old:.5g} {new:.5g} N·m/rad " in text
    assert (
        twin.controller_of("left").kp_nm_per_rad[:3]
        == TwinConfig().controller.kp_nm_per_rad[:3]
    )
    assert twin.controller_of("right") == TwinConfig().controller
    out = folder / "compared"
    code, text = said(
        folder / "sweeps",
        f"--twin={folder / 'twin.yaml'}",
        f"--against={copy}",
        f"--out={out}",
        verb="compare",
    )
    assert code == 0
    report = json.loads((out / "report.json").read_text())
    held = [
        next(
            s["ratio"]
            for s in report[k]
            if s["use"] == "validation" and s["kind"] == "position"
        )
        for k in ("scores", "scores_after")
    ]
    assert held[0] > 4.0 and held[1] < 1.25
    code, text = said("coulomb_friction", *words)
    assert code == 2 and "already exists; give another --out" in text


def test_an_effect_that_was_tied_may_be_taken_instead(said, words, tmp_path):
    code, text = said("asymmetric_friction", *words, f"--out={tmp_path / 'new.yaml'}")
    assert code == 0 and "noise floors with asymmetric_friction" in text
    (effect,) = load_twin(tmp_path / "new.yaml").effects
    assert effect.name == "asymmetric_friction" and effect.acts_on() == [SIGNAL]
    assert vars(effect)["torque_nm"] == pytest.approx(TRUTH_NM, rel=0.05)


@pytest.mark.parametrize("name", ["J3", "joint4", "left_joint4"])
def test_the_joint_has_three_names(name, said, words, tmp_path):
    assert (
        said(
            "coulomb_friction",
            *words,
            f"--joints=[{name}]",
            f"--out={tmp_path / 'new.yaml'}",
        )[0]
        == 0
    )
    assert load_twin(tmp_path / "new.yaml").effects[0].acts_on() == [SIGNAL]


def test_numbers_by_hand_need_no_diagnosis(said, tmp_path):
    out = tmp_path / "new.yaml"
    words = [
        "coulomb_friction",
        f"--diagnosis={tmp_path}",
        f"--out={out}",
        "--values={torque_nm: 0.4}",
    ]
    assert said(*words)[0] == 2, "which joints?"
    code, text = said(*words, "--joints=[J3]")
    control = TwinConfig().controller
    assert code == 0
    kept = f"stay: kp {control.kp_nm_per_rad[3]:.4g} N·m/rad, kd {control.kd_nms_per_rad[3]:.4g} N·m·s/rad"
    assert (
        text.count("coulomb_friction.torque_nm – 0.4 N·m") == text.count(kept) == 2
    )  # of both arms
    code, text = said(
        "coulomb_friction",
        f"--twin={out}",
        "--joints=[left_joint4]",
        "--values={torque_nm: 0.5}",
    )
    assert code == 0 and "coulomb_friction.torque_nm 0.4 0.5 N·m" in text
    found = {
        tuple(e.acts_on()): (vars(e)["torque_nm"], e.evidence)
        for e in load_twin(out).effects
    }
    assert found == {
        ("left_joint4",): (0.4, "by hand"),
        ("right_joint4",): (0.4, "by hand"),
    }


def test_an_effect_of_all_pads_by_hand(said, tmp_path):
    out = tmp_path / "new.yaml"
    assert said("touch_lag", f"--out={out}", "--values={time_constant_s: 0.03}")[0] == 0
    assert len(load_twin(out).effects[0].acts_on()) == 4


def test_each_joint_gets_what_its_diagnosis_tells_and_what_is_left_out_is_said(
    folder, said, tmp_path
):
    report = json.loads((folder / "diagnosis" / "report.json").read_text())
    own, other, off = (
        report["diagnoses"][SIGNAL],
        "left_joint5",
        [{"name": "torque_ff"}],
    )
    report["verdicts"][other] = report["verdicts"][SIGNAL]

    def wrote(names: str, *diagnoses: dict) -> str:
        report["diagnoses"] = dict(zip((SIGNAL, other), diagnoses, strict=True))
        (tmp_path / "report.json").write_text(json.dumps(report))
        out = tmp_path / f"{len([*tmp_path.iterdir()])}.yaml"
        code, text = said(
            names,
            f"--twin={folder / 'twin.yaml'}",
            f"--diagnosis={tmp_path}",
            f"--out={out}",
        )
        assert code == 0 and f"{other}: " in text
        return text

    refitted = {"effect": "viscous_friction", "damping_nms_per_rad": 1.0}
    in_file = {"effects": [refitted], "present": ["viscous_friction"]}
    both = wrote("torque_ff", own | {"changed": off}, own | in_file | {"changed": off})
    assert (
        f"not written: {SIGNAL}: torque_ff was refitted beside coulomb_friction; `taccorl add-effect"
        in both
    )
    assert "coulomb_friction,torque_ff` writes them together" in both
    viscous = [*off, {"name": "viscous_friction.damping_nms_per_rad"}]
    both = wrote(
        "torque_ff,viscous_friction",
        own | in_file | {"changed": viscous},
        own | in_file | {"changed": off},
    )
    assert f"{SIGNAL}: " in both and "not written" not in both


def test_a_diagnosis_of_another_twin_is_refused(folder, said, tmp_path):
    other = TwinConfig()
    other.controller.kp_nm_per_rad[0] += 1.0
    save_twin(other, tmp_path / "other.yaml")
    code, text = said(
        "coulomb_friction",
        f"--twin={tmp_path / 'other.yaml'}",
        f"--diagnosis={folder / 'diagnosis'}",
    )
    assert code == 2 and "was made with another twin" in text and "twin.yaml" in text
    assert [p.name for p in tmp_path.iterdir()] == ["other.yaml"]


@pytest.mark.parametrize(
    ("own", "message"),
    [
        (["coulomb_frictoin"], "coulomb_friction"),
        (["slew_limit"], "slew_limit was not fitted in"),
        (["kd"], "kd is not off in that diagnosis; what it found: coulomb_friction"),
        (["touch_lag"], "touch_lag was not fitted in"),
        (
            ["coulomb_friction", "--joints=[J4]"],
            f"J4: no such joint is swept in these recordings; known: {SIGNAL}",
        ),
        (
            ["coulomb_friction", "--joints=[joint4]", "--values={torque_nm: -1}"],
            "outside of",
        ),
        (
            ["touch_lag", "--joints=[joint4]", "--values={time_constant_s: 0.03}"],
            "is not an effect of joints",
        ),
    ],
)
def test_what_cannot_be_added_is_refused(own, message, said, words, tmp_path):
    code, text = said(*own, *words, f"--out={tmp_path / 'new.yaml'}")
    assert code == 2 and message in text
    assert not (tmp_path / "new.yaml").exists()


@pytest.mark.parametrize(
    ("effect", "number"),
    [("coulomb_friction", "torque_nm: 0.4"), ("payload", "mass_kg: 0.2")],
)
def test_without_a_diagnosis_the_way_out_is_said(
    effect, number, folder, said, tmp_path
):
    words = [
        f"--twin={folder / 'twin.yaml'}",
        f"--diagnosis={tmp_path}",
        f"--out={tmp_path / 'new.yaml'}",
    ]
    code, text = said(effect, *words)
    assert (
        code == 2
        and "run `taccorl diagnose` first" in text
        and f"--values={{{number}}}" in text
    )


def test_in_place_changes_the_file_itself_and_nothing_else(folder, said, tmp_path):
    path = tmp_path / "twin.yaml"
    path.write_bytes((folder / "twin.yaml").read_bytes())
    words = [
        "coulomb_friction",
        f"--diagnosis={folder / 'diagnosis'}",
        "--in_place=true",
    ]
    assert said(*words)[0] == 2, "of which file?"
    assert said(*words, f"--twin={path}", f"--out={tmp_path / 'new.yaml'}")[0] == 2
    assert said(*words, f"--twin={path}")[0] == 0
    assert [p.name for p in tmp_path.iterdir()] == ["twin.yaml"]
    assert (
        yaml.safe_load(path.read_text())["effects"][0]["effect"] == "coulomb_friction"
    )
    code, text = said(*words, f"--twin={path}")
    assert code == 2 and "another twin" in text, "it is one now"


@pytest.mark.parametrize(
    ("name", "stated"),
    [
        ("coulomb_frictoin", "did you mean 'coulomb_friction'"),
        (
            "kd,comand_delay",
            "comand_delay: no such effect; did you mean 'command_delay'",
        ),
        ("nosuch", "nosuch: no such effect; known: armature, "),
        ("coulomb_friction", "no diagnosis there; run `taccorl diagnose` first"),
        ("kd", "no diagnosis there; run `taccorl diagnose` first"),
    ],
)
def test_an_unknown_effect_is_named_before_the_missing_diagnosis(
    name: str, stated: str, said: Any, tmp_path: Path
):
    code, text = said(name, f"--diagnosis={tmp_path}", f"--out={tmp_path / 'new.yaml'}")
    assert code == 2 and stated in text
    assert ("no such effect" in text) == ("first" not in stated)

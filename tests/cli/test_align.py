"""``taccorl align`` as a user types it, on recordings of a twin with other numbers (simulated, not a robot's)."""

import copy
import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_press import K_D, K_N, ball_at, press
from one_joint import recorded
from simulated_sweeps import SIGNAL, friction, sweeps, write_folder

from taccorl.alignment.checks.clock import SHIFTED
from taccorl.alignment.checks.registry import find
from taccorl.alignment.measurements.folder import Measurements
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.alignment.touch.match import MATCH_NUMBERS
from taccorl.cli.align import _beside_fitted, _section
from taccorl.data.finding import Finding
from taccorl.diagnosis.align import Alignment, FittedNumber, align_part, aligned
from taccorl.diagnosis.comparison import compare
from taccorl.diagnosis.machines.piper import PiperTwin
from taccorl.robots import ROBOT
from taccorl.sim.effects import make_effect
from taccorl.sim.twin import TwinConfig
from taccorl.sim.twin_file import load_twin, save_twin

J = ROBOT.joints.index("joint5")


def other_gains() -> TwinConfig:
    """The nominal twin, but for K_d and T_ref of left_joint5."""
    config = TwinConfig()
    control = copy.deepcopy(config.controller_of("left"))
    control.kd_nms_per_rad[J] *= 1.5
    control.torque_ff_nm[J] += 0.8
    config.arm_controllers["left"] = control
    return config


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("align")
    write_folder(path / "sweeps", sweeps(other_gains(), seconds=3.0))
    return path


def test_gains_are_found_and_the_error_falls_to_the_noise(
    folder: Path, said: Any, tmp_path: Path
):
    code, text = said("align", folder / "sweeps", "--out=found")
    assert code == 0, text
    report = json.loads((tmp_path / "found" / "report.json").read_text())
    [part] = report["parts"]
    assert (
        part["part"] == SIGNAL
        and part["judged_by"] == ["sweep_2.csv"]
        and part["trouble"] == ""
    )
    assert part["before"] > 4 * part["after"] and part["after"] == pytest.approx(
        2e-4, rel=0.2
    )  # 0.2 mrad of noise
    had, truth = TwinConfig().controller_of("left"), other_gains().controller_of("left")
    numbers = {n["name"]: n for n in part["numbers"]}
    lag = truth.kd_nms_per_rad[J] / truth.kp_nm_per_rad[J]
    half = (numbers["kd/kp"]["high"] - numbers["kd/kp"]["low"]) / 2
    assert abs(numbers["kd/kp"]["value"] - lag) < 2 * half < 0.05 * lag
    assert numbers["kd/kp"]["before"] == pytest.approx(
        had.kd_nms_per_rad[J] / had.kp_nm_per_rad[J]
    )
    # The twin that was written has them; other joints, and the other arm, are as they were.
    twin = load_twin(tmp_path / "found" / "twin.yaml")
    now = twin.controller_of("left")
    assert now.torque_ff_nm[J] == pytest.approx(truth.torque_ff_nm[J], rel=0.01)
    assert now.kd_nms_per_rad[J] == pytest.approx(truth.kd_nms_per_rad[J], rel=0.005)
    assert now.kp_nm_per_rad == had.kp_nm_per_rad and numbers["kp"]["fixed"]
    assert (
        now.kp_nm_per_rad[:J] == had.kp_nm_per_rad[:J]
        and now.kd_nms_per_rad[:J] == had.kd_nms_per_rad[:J]
    )
    assert twin.controller_of("right") == TwinConfig().controller_of("right")
    assert "mrad" in said("compare", folder / "sweeps", "--twin=found/twin.yaml")[1]


def test_the_paper_s_spsa_writes_a_twin(folder: Path, said: Any, tmp_path: Path):
    words = ["--method=spsa", "--seed=1", "--out=found"]
    code, text = said("align", folder / "sweeps", *words)
    assert code == 0, text
    report = json.loads((tmp_path / "found" / "report.json").read_text())
    assert "--method=spsa --seed=1" in report["command"]
    [part] = report["parts"]
    assert part["trouble"] == "" and part["after"] < 0.5 * part["before"]
    assert any(r.startswith("SPSA: loss (eq. 9)") for r in part["remarks"])
    numbers = {n["name"]: n for n in part["numbers"]}
    assert not numbers["kp"]["fixed"], "the paper fits all three"
    truth = other_gains().controller_of("left")
    ratio = truth.kd_nms_per_rad[J] / truth.kp_nm_per_rad[J]
    assert numbers["kd/kp"]["value"] == pytest.approx(ratio, rel=0.05)
    assert numbers["kd/kp"]["low"] < ratio < numbers["kd/kp"]["high"]
    control = load_twin(tmp_path / "found" / "twin.yaml").controller_of("left")
    assert control.kp_nm_per_rad[J] == numbers["kp"]["value"]
    assert control.kd_nms_per_rad[J] == numbers["kd"]["value"]
    assert control.torque_ff_nm[J] == numbers["torque_ff"]["value"]


@pytest.mark.parametrize(
    ("words", "stated"),
    [
        (["--method=anneal"], "anneal"),
        (["--seed=3"], "--method=spsa"),
        (["--method=spsa", "--seed=-1"], "--seed=-1"),
        (["--method=spsa", "--pads=left"], "--joints="),
        (["--method=spsa", "--cameras=[front]"], "--joints="),
    ],
)
def test_a_search_that_cannot_be_or_has_no_effect_is_refused(
    words: list[str], stated: str, folder: Path, said: Any, tmp_path: Path
):
    code, text = said("align", folder / "sweeps", *words, "--out=found")
    assert code == 2 and stated in text
    assert not (tmp_path / "found").exists()


def scaled(kp: float, kd: float) -> TwinConfig:
    """The nominal twin with other gains of left_joint5."""
    config = TwinConfig()
    control = copy.deepcopy(config.controller_of("left"))
    control.kp_nm_per_rad[J] *= kp
    control.kd_nms_per_rad[J] *= kd
    config.arm_controllers["left"] = control
    return config


def earlier(m: Measurement) -> Measurement:
    """``m`` whose positions stand one row too early."""
    measured = np.concatenate([m.measured[1:], m.measured[-1:]])
    return dataclasses.replace(m, measured=measured)


def test_gains_are_fitted_before_a_lead_is_an_error(
    folder: Path, said: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Of K_d 1.5 times the twin's, here with leads that only the twin's gains show."""
    lead = find(SHIFTED, SIGNAL, f"{SIGNAL}: 5 ms (1.0 rows): write rows")
    replays = iter([lead] * 4 + [None] * 4)

    def judge(*_: Any, **__: Any) -> list[Finding]:
        found = next(replays)
        return [] if found is None else [found]

    monkeypatch.setattr(compare, "check_against_twin", judge)
    code, text = said("align", folder / "sweeps")
    assert code == 0, text
    assert next(replays, "none left") == "none left", "each recording is judged twice"
    assert "write rows" not in text
    assert (tmp_path / "alignment" / "twin.yaml").exists()


def test_a_lead_is_found_beside_fitted_gains(said: Any, tmp_path: Path):
    """Gains off by two hide a row; only the fitted ones show it, and none are written."""
    made = sweeps(scaled(1.0, 0.5), seconds=3.0)
    uses = (
        tuple(map(earlier, side)) for side in (made.fit, made.validation, made.test)
    )
    write_folder(tmp_path / "sweeps", Measurements(*uses, rule=made.rule))
    code, text = said("align", "sweeps")
    assert code == 1, text
    assert "target_rows_late: 1" in text
    assert not (tmp_path / "alignment" / "twin.yaml").exists()


def test_what_floors_are_left_is_not_called_agreement():
    left = Alignment(part=SIGNAL, numbers=(), unchanged=True, floors_left=14.0)
    (line,) = map(str, _section(left).text)
    assert "14 noise floors" in line and "agree" not in line
    (line,) = map(str, _section(dataclasses.replace(left, floors_left=1.1)).text)
    assert "the recordings agree with the twin's numbers" in line


@pytest.mark.slow
def test_gains_are_not_fitted_to_a_clock_that_is_50_ms_late(said: Any, tmp_path: Path):
    made = sweeps(other_gains(), seconds=3.0)
    rows = round(0.05 / made.fit[0].period_s)

    def later(m: Measurement) -> Measurement:
        return dataclasses.replace(
            m,
            measured=np.concatenate(
                [np.repeat(m.measured[:1], rows, 0), m.measured[:-rows]]
            ),
        )

    uses = (tuple(map(later, side)) for side in (made.fit, made.validation, made.test))
    write_folder(tmp_path / "sweeps", Measurements(*uses, rule=made.rule))
    code, text = said("align", "sweeps")
    late_ms = float(
        re.search(r"comes (\d+) ms after the replay, in \d of \d recordings", text)[1]
    )  # pyright: ignore
    assert (
        code == 1 and 45 <= late_ms <= 60 and text.index(SIGNAL) < text.index("comes")
    )
    assert (
        not (tmp_path / "alignment" / "twin.yaml").exists()
        and "--accept=shifted_from_twin" in text
    )
    code, _ = said(
        "align", "sweeps", "--accept=shifted_from_twin", "--out=nevertheless"
    )
    assert code == 0 and (tmp_path / "nevertheless" / "twin.yaml").exists()


@pytest.mark.slow
def test_gains_that_stand_in_for_a_missing_effect_are_said_to_do_so(
    said: Any, tmp_path: Path
):
    write_folder(tmp_path / "sweeps", sweeps(friction(2.0), seconds=3.0))
    _, text = said("align", "sweeps")
    [part] = json.loads((tmp_path / "alignment" / "report.json").read_text())["parts"]
    assert part["floors_left"] > 2
    assert "alignment/twin.yaml" not in text.split("next:")[-1], (
        "the effect is looked for in the twin that was given"
    )


def test_gains_whose_replay_is_worse_are_not_written_and_other_larger_errors_are_said():
    """K_d 1.5 times that of the recordings, as if a fit had found it."""
    made = sweeps(TwinConfig(), seconds=3.0)
    machine = PiperTwin(TwinConfig(), "twin")
    had = machine.config.controller_of("left").kd_nms_per_rad[J]
    kd = FittedNumber("kd", "N·m·s/rad", had, 1.5 * had, had, 2.0 * had)
    one = Alignment(part=SIGNAL, numbers=(kd,), before=2.0, after=1.0)
    before = machine.compare(made)
    (judged,) = _beside_fitted(machine, [one], made, before, ())
    assert "position error of validation" in judged.trouble
    assert aligned(TwinConfig(), [judged]) == (TwinConfig(), "")
    # Without validation recordings it is the error of the fit's that judges.
    alone = dataclasses.replace(made, validation=())
    (judged,) = _beside_fitted(machine, [one], alone, machine.compare(alone), ())
    assert "position error of fit" in judged.trouble
    (same,) = _beside_fitted(
        machine, [dataclasses.replace(one, numbers=())], made, before, ()
    )
    assert not same.trouble and not same.remarks
    # The recordings of another twin agree on validation, and not in the others.
    other = sweeps(other_gains(), seconds=3.0)
    mixed = dataclasses.replace(other, validation=made.validation)
    turned = PiperTwin(other_gains(), "twin")
    back = dataclasses.replace(kd, value=had)
    zero = FittedNumber("torque_ff", "N·m", 0.8, 0.0, -1.0, 1.0)
    one = dataclasses.replace(one, numbers=(back, zero))
    (judged,) = _beside_fitted(turned, [one], mixed, turned.compare(mixed), ())
    assert not judged.trouble and "position error of fit" in judged.remarks[0]


def test_right_gains_stay_as_they_are():
    # Recordings of the twin itself: whether the fit is better on the validation recording is chance, and then nothing is changed.
    found = []
    for seed in range(4):
        fit, validation = (
            recorded(SIGNAL, k, seconds=4.0) for k in (2 * seed, 2 * seed + 1)
        )
        found.append(
            align_part(
                SIGNAL,
                TwinConfig(),
                Measurements((fit,), (validation,), rule="by hand"),
            )
        )
    assert all(a.unchanged or a.after <= a.before for a in found) and not any(
        a.trouble for a in found
    )
    kept = next(a for a in found if a.unchanged)
    assert aligned(TwinConfig(), [kept]) == (TwinConfig(), "")


def test_what_would_be_overwritten_or_is_no_piper_is_refused(
    folder: Path, said: Any, tmp_path: Path
):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("keep")
    code, text = said("align", folder / "sweeps", "--out=mine")
    assert (
        code == 2
        and "mine" in text
        and (tmp_path / "mine" / "notes.txt").read_text() == "keep"
    )
    (tmp_path / "axis.yaml").write_text(
        "kind: axis\nname: carriage\nunit: m\ninertia: 1.0\nkp: 10.0\nkd: 1.0\n"
    )
    code, text = said("align", folder / "sweeps", "--twin=axis.yaml")
    assert code == 2 and "axis.yaml" in text
    code, text = said("align", folder / "sweeps", "--cameras=[frnt]")
    assert code == 2 and "frnt" in text and "front" in text
    code, text = said(
        "align", folder / "sweeps", "--joints=[left_joint5]", "--cameras=[front]"
    )
    assert code == 2 and "--cameras=front" in text and "sweeps" in text
    assert not (tmp_path / "alignment").exists()
    code, text = said("align", folder / "sweeps", "--out=mine/notes.txt/found")
    assert (
        code == 2 and "--out=mine/notes.txt/found" in text and "fitted" not in text
    ), "before the fit"


def test_pads_get_stiffness_and_damping_and_what_has_no_validation_says_so():
    config, ball = TwinConfig(), ball_at(0.001, 0.003)
    presses = [dataclasses.replace(press(seed), pressed=ball) for seed in (0, 1)]
    found = align_part(
        "left pads", config, Measurements((presses[0],), (presses[1],), rule="by hand")
    )
    assert found.trouble == "" and found.after < found.before
    match = found.record()["touch_match"]
    for number in MATCH_NUMBERS:
        assert match["before"][number.name] > 0 and match["after"][number.name] > 0
    assert match["before"]["rms_count"] == found.before
    assert match["after"]["histogram_count"] < 0.2 * match["before"]["histogram_count"]
    assert match["before"]["undefined"] == match["after"]["undefined"] == {}
    (counts,) = re.findall(r"λ_noise (\S+) counts", found.remarks[0])
    (option,) = re.findall(r"--policy\.noise_threshold=(\S+)", found.remarks[1])
    assert (
        0 < float(counts) == pytest.approx(75 * float(option), rel=1e-3)
    )  # reading = counts / 75
    twin, why = aligned(config, [found])
    assert why == "" and vars(twin.sensor)["normal_stiffness_per_m"] == pytest.approx(
        K_N, rel=0.01
    )
    assert vars(twin.sensor)["normal_damping_s_per_m"] == pytest.approx(K_D, rel=0.1)
    alone = align_part(
        "left pads", config, Measurements((presses[0],), (), rule="by hand")
    )
    assert "validation" in alone.trouble
    assert aligned(config, [alone])[0] == config


@pytest.mark.slow
def test_intervals_say_what_they_assume_and_a_twin_that_fits_already_is_no_trouble():
    truth = other_gains()
    truth.controller_of("left").kp_nm_per_rad[J] *= 1.3
    made = sweeps(truth, seconds=3.0)
    control = truth.controller_of("left")
    kp, kd = control.kp_nm_per_rad[J], control.kd_nms_per_rad[J]
    found = align_part(SIGNAL, TwinConfig(), Measurements(made.fit, (), rule="by hand"))
    numbers = {n.name: n for n in found.numbers}
    assert numbers["kd/kp"].low < kd / kp < numbers["kd/kp"].high
    assert numbers["kd"].high < 0.8 * kd, (
        "K_d is fitted for the twin's K_p, which is 1.3 times too low"
    )
    assert any("K_p is the twin's" in r for r in found.remarks)
    assert found.judged_by == found.fitted_to and any(
        "validation" in r for r in found.remarks
    )
    stated = tuple(dataclasses.replace(m, kp={SIGNAL: kp}) for m in made.fit)
    known = align_part(
        SIGNAL, TwinConfig(), Measurements(stated, made.validation, rule="by hand")
    )
    kd_known = next(n for n in known.numbers if n.name == "kd")
    assert kd_known.low < kd < kd_known.high and not any(
        "K_p" in r or "validation" in r for r in known.remarks
    )
    again = align_part(SIGNAL, truth, made)
    assert again.trouble == "" and again.after == pytest.approx(again.before, rel=0.02)


def test_a_latency_that_may_be_zero_is_removed_from_the_aligned_camera_only():
    late = make_effect("camera_latency", cameras=["front", "left_wrist"], delay_s=0.02)
    config = TwinConfig(effects=[late])
    none = make_effect("camera_latency", cameras=["front"], delay_s=0.0)
    [left] = aligned(
        config, [Alignment(part="camera front", effects=(none,), twin=TwinConfig())]
    )[0].effects
    assert left == dataclasses.replace(late, cameras=["left_wrist"])


@pytest.mark.slow
def test_a_camera_is_aligned_from_a_dataset(said: Any, tmp_path: Path):
    off = {
        "turn_x_rad": 0.02,
        "turn_y_rad": -0.015,
        "shift_x_m": -0.01,
        "shift_z_m": 0.01,
    }
    effects = [
        make_effect("camera_pose", cameras=["front"], **off),
        make_effect("camera_exposure", cameras=["front"], gain=0.8),
    ]
    save_twin(TwinConfig(effects=effects), tmp_path / "robot.yaml")
    code, text = said(
        "collect",
        "--task=assembly_1",
        "--episodes=1",
        "--twin=robot.yaml",
        "--out=seen",
        "--store=store",
    )
    assert code == 0, text
    code, text = said("align", "seen", "--cameras=[front]", "--out=found")
    assert code == 0, text
    [part] = json.loads((tmp_path / "found" / "report.json").read_text())["parts"]
    assert part["trouble"] == "" and part["after"] < 0.7 * part["before"]
    numbers = {n["name"]: n for n in part["numbers"]}
    assert numbers["turn_x"]["value"] == pytest.approx(0.02, abs=0.005)
    assert numbers["shift_z"]["value"] == pytest.approx(0.01, abs=0.005)
    assert numbers["gain"]["value"] == pytest.approx(0.8, abs=0.05)
    twin = load_twin(tmp_path / "found" / "twin.yaml")
    front = next(c for c in twin.cameras if c.name == "front")
    assert (
        np.linalg.norm(np.array(front.offset.rotation_rad) - [0.02, -0.015, 0.0])
        < 0.006
    )
    assert [e.name for e in twin.effects] in (
        ["camera_exposure"],
        ["camera_latency", "camera_exposure"],
    )
    assert sorted(p.name for p in (tmp_path / "found").glob("*.png"))

"""``taccorl excite --pads`` as a user types it."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from taccorl.alignment.measurements.folder import PressedNote
from taccorl.cli.main import main
from taccorl.diagnosis.experiment_design import presses

RIVALS = "--effects=[touch_delay,touch_lag]"
OF_NAME = {p.name: p for p in presses.LIBRARY}


@pytest.fixture(autouse=True)
def two_presses(monkeypatch: pytest.MonkeyPatch) -> None:
    """What takes seconds to score, not minutes."""
    monkeypatch.setattr(presses, "LIBRARY", (OF_NAME["rod_across"], OF_NAME["quick_taps"]))


@pytest.fixture
def said(capsys: pytest.CaptureFixture[str]) -> Any:
    def run(*words: Any) -> tuple[int, str]:
        code = main(["excite", *map(str, words)])
        shown = capsys.readouterr()
        assert "Traceback" not in shown.out + shown.err
        return code, " ".join((shown.out + shown.err).split())

    return run


@pytest.mark.slow
def test_a_plan_tables_of_targets_and_what_to_say_of_them(said: Any, tmp_path: Path):
    out = tmp_path / "plan"
    code, text = said("--pads=right", RIVALS, f"--out={out}", "--num=2")
    assert code == 0 and "right pads: noise floors (0.6 counts, a taxel's mean over 5 frames)" in text
    plan = yaml.safe_load((out / "plan.yaml").read_text())
    assert (plan["pads"], plan["rate_hz"]) == ("right pads", 200)
    assert plan["tells_apart"] == ["touch_delay", "touch_lag"]
    assert [p["table"] for p in plan["presses"]] == ["1_quick_taps.csv", "2_rod_across.csv"]
    assert sorted(p.name for p in out.iterdir()) == ["1_quick_taps.csv", "2_rod_across.csv", "plan.yaml"]
    apart = [p["floors_apart"]["touch_delay | touch_lag"] for p in plan["presses"]]
    assert apart[0] > 2.0 > apart[1] > 0.0
    for entry, name in zip(plan["presses"], ("quick_taps", "rod_across"), strict=True):
        with (out / entry["table"]).open() as file:
            head, *rows = csv.reader(file)
        assert head == ["t", "right_gripper.q_target", "right_gripper.opening"]
        time_s, target, opening = np.array(rows, dtype=float).T
        assert np.allclose(np.diff(time_s), 1 / 200) and len(rows) == round(entry["seconds"] * 200)
        assert entry["range_m"] == pytest.approx([target.min(), target.max()], abs=1e-9)
        assert target.min() >= 0 and target.max() <= 0.07
        assert opening == pytest.approx(OF_NAME[name].opening_m(), abs=1e-6)
        pressed = PressedNote(**entry["pressed"])
        assert pressed.arm == "right" and pressed.radius_m == {"sphere": 0.012, "rod": 0.008}[pressed.shape]
        deepest = pressed.radius_m - opening.min() / 2
        assert entry["depth_m"] == pytest.approx(deepest, abs=1e-6)
        assert entry["peak_force_n"] == pytest.approx(2e4 * deepest, abs=0.06)
        assert opening.min() - target.min() == pytest.approx(10 * deepest, abs=3e-6), "20 kN/m on 2 kN/m"


def test_rivals_and_numbers_come_from_a_diagnosis_s_left_pads(said: Any, tmp_path: Path):
    values = {"touch_delay": {"delay_s": 0.06}, "touch_lag": {"time_constant_s": 0.06}}
    base = {"k_n": 900.0, "k_d": 4.0, "zero_left_a": 0.0, "zero_left_b": 0.0}
    evidence = [{"name": n, "base": base, "values": {f"{n}.{k}": x for k, x in v.items()}} for n, v in values.items()]
    found = {"rivals": {"touch_delay": ["touch_lag"]}, "rounds": [{"evidence": evidence}]}
    (tmp_path / "report.json").write_text(json.dumps({"diagnoses": {"left pads": found}}))
    code, _ = said("--pads=left", f"--diagnosis={tmp_path}", f"--out={tmp_path / 'plan'}")
    plan = yaml.safe_load((tmp_path / "plan" / "plan.yaml").read_text())
    assert code == 0 and plan["tells_apart"] == ["touch_delay", "touch_lag"]
    # both twice as late as is typical; typical ones leave 3.1 floors with k_n = 1200, so with 900 they leave 2.3
    assert plan["presses"][0]["floors_apart"]["touch_delay | touch_lag"] > 3.3


def test_what_only_one_truth_would_show_is_said(said: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(presses, "LIBRARY", (OF_NAME["long_hold"],))
    code, text = said("--pads=left", "--effects=taxel_creep,touch_lag", f"--out={tmp_path / 'plan'}")
    assert code == 1 and "taxel_creep | touch_lag: 0." in text
    assert "if it is taxel_creep, long_hold shows it (4." in text


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--pads=lft", RIVALS], "--pads=lft: no such arm; did you mean 'left'"),
        (["left_joint5", "--pads=left", RIVALS], "left_joint5 and --pads=left: give one of them"),
        (["--pads=left", "--effects=[touch_lag,backlash]"], "backlash is not an effect of pads"),
        (["left_joint5", "--effects=[touch_lag,touch_delay]"], "no effect 'touch_lag' for this part"),
        (["--pads=left", "--effects=[touch_lag]"], "two or more effects"),
        (["--pads=left"], "names no rival effects of left pads; give --effects=touch_lag,touch_delay"),
        (["--pads=left", RIVALS, "--gains=fitted"], "--gains applies to joints only; remove it with --pads=left"),
        ([], "or --pads=left for the pads of that arm"),
    ],
)
def test_what_cannot_be_done_is_said_and_nothing_written(words: list[str], message: str, said: Any, tmp_path: Path):
    code, text = said(*words, f"--out={tmp_path / 'plan'}", f"--diagnosis={tmp_path}")
    assert code == 2 and message in text
    assert not (tmp_path / "plan").exists()

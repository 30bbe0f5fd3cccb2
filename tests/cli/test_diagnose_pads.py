"""The story of the pads as a user types it: surrogate, compare, diagnose, add-effect, compare (simulated, not a robot)."""

import dataclasses
import io
import json
import re
import shutil
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import pytest
import yaml

from taccorl.alignment.measurements.folder import INDEX
from taccorl.alignment.touch.match import MATCH_NUMBERS
from taccorl.cli.main import main
from taccorl.sim.effects import effects
from taccorl.sim.sensors.flexitac import FlexiTacConfig
from taccorl.sim.twin_file import load_twin, save_twin
from taccorl.surrogate import touch
from tests.cli.printed import commands

VERB = ""
DEPTHS = touch.pad_presses((3e-4, 6e-4, 1e-3), (0.12, 0.5), 0.4, after_s=2.0)
HELD = touch.pad_presses((8e-4, 4e-4), (0.1, 0.4), 0.5, after_s=2.0)
FIT = touch.Press(name="press", knots=DEPTHS)
SHORT = {
    "fit": (FIT, dataclasses.replace(FIT, name="again", repeat_of="press")),
    "validation": (touch.Press(name="held", knots=HELD, x_m=0.0, z_m=0.002),),
    "test": (),
}
CONSIDERED = ("taxel_saturation", "taxel_creep", "baseline_drift", "touch_lag")
FEW = f"--without=[{','.join(name for name in effects if name not in CONSIDERED)}]"


def surrogate(folder: Path, effect: str, strength: float, patched: bool = True) -> Path:
    with pytest.MonkeyPatch.context() as patch:
        if patched:
            patch.setattr(touch, "_USES", SHORT)
        words = [
            "--secret=4",
            "--pads=left",
            f"--effects=[{effect}]",
            f"--strength={strength}",
            f"--out={folder}",
        ]
        assert main(["surrogate", *words]) == 0
    return folder


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``presses/`` with three short presses, and ``twin.yaml``."""
    return surrogate(tmp_path_factory.mktemp("pads") / "robot", "taxel_saturation", 8.0)


@pytest.fixture(scope="module")
def robot(made: Path) -> Path:
    """What was diagnosed from it, in ``found/``, and ``said.txt``."""
    words = [
        f"--twin={made / 'twin.yaml'}",
        f"--out={made / 'found'}",
        FEW,
        "--until=noise_floor",
    ]
    with redirect_stdout(io.StringIO()) as said:
        assert main(["diagnose", str(made / "presses"), *words]) == 0
    (made / "said.txt").write_text(said.getvalue())
    return made


@pytest.mark.slow
def test_the_paper_s_five_numbers_are_in_align_and_compare(
    made: Path, said: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    presses, twin = made / "presses", f"--twin={made / 'twin.yaml'}"
    said("align", presses, twin, "--pads=left", "--out=aligned")
    [part] = json.loads((tmp_path / "aligned" / "report.json").read_text())["parts"]
    before, after = part["touch_match"]["before"], part["touch_match"]["after"]
    names = [number.name for number in MATCH_NUMBERS]
    assert len(names) == 5 and set(names) < set(before) == set(after)
    assert all(before[name] > 0 and after[name] > 0 for name in names)
    assert before["undefined"] == after["undefined"] == {}
    # Of a twin whose pads are 30 % stiffer: another twin, other numbers.
    config = load_twin(made / "twin.yaml")
    config.sensor.normal_stiffness_per_m *= 1.3  # pyright: ignore
    save_twin(config, tmp_path / "stiff.yaml")
    words = [presses, twin, "--against=stiff.yaml", "--out=compared"]
    code, text = said("compare", *words)
    assert code == 0 and all(number.label in text for number in MATCH_NUMBERS)
    report = json.loads((tmp_path / "compared" / "report.json").read_text())
    one, other = report["touch_match"], report["touch_match_after"]
    keys = [(m["pad"], m["use"]) for m in one]
    assert keys == [(m["pad"], m["use"]) for m in other]
    assert set(keys) >= {("left_a", "validation"), ("left_b", "fit")}
    for soft, stiff in zip(one, other, strict=True):
        assert 0 < soft["mask_iou"] < 1 and soft["centroid_m"] < 2e-3
        assert soft["temporal_count"] < stiff["temporal_count"]
    assert report["touch_match_refitted"] == []
    assert "Touch match" in (tmp_path / "compared" / "report.html").read_text()


@pytest.mark.slow
def test_the_report_holds_the_effect_with_its_numbers(robot: Path):
    report = json.loads((robot / "found" / "report.json").read_text())
    assert list(report["diagnoses"]) == ["left pads"], (
        "the gripper moves, and no joint is swept"
    )
    found = report["diagnoses"]["left pads"]
    assert found["status"] == "at_floor"
    assert [(e["effect"], e["pads"]) for e in found["effects"]] == [
        ("taxel_saturation", ["left_a", "left_b"])
    ]
    assert {"k_n", "k_d", "zero_left_a", "zero_left_b"} == set(found["base"])
    assert all(e["bic"] is not None for r in found["rounds"] for e in r["evidence"])
    assert "left pads" in report["can_tell"]
    (data,) = report["data"]
    assert data.startswith("surrogate: ") and data.endswith("not a robot; left pads")
    cells = {(c["signal"], c["regime"]): c["ratio"] for c in report["where"]["cells"]}
    # Saturation leaves 1.8 floors once k_n, k_d and zeros are refitted, nearly all of it in contact.
    assert cells["left_a", "in contact"] > 1.2 * cells["left_a", "no contact"]
    assert {"loading", "hold", "unloading", "middle third"} <= {
        regime for _, regime in cells
    }
    page = (robot / "found" / "report.html").read_text()
    assert "<h2>Touch</h2>" in page and "ΔBIC" in page
    for signal in ("touch", "left_a", "left_b"):
        before, after = (
            next(
                s["ratio"]
                for s in report[k]
                if s["signal"] == signal and s["use"] == "validation"
            )
            for k in ("scores", "scores_after")
        )
        assert after < 0.35 * before and after < 1.35


@pytest.mark.slow
def test_what_was_found_goes_into_a_copy_and_the_error_falls(
    robot: Path, said: Any, tmp_path: Path
):
    out = tmp_path / "new.yaml"
    twin = f"--twin={robot / 'twin.yaml'}"
    words = [
        "taxel_saturation",
        twin,
        "--pads=left",
        f"--diagnosis={robot / 'found'}",
        f"--out={out}",
    ]
    code, text = said("add-effect", *words)
    assert code == 0 and text.startswith("left pads:")
    printed = {words[0]: words for words in map(str.split, text.splitlines()) if words}
    limit = printed["taxel_saturation.limit"]
    assert limit[1] == "–" and 0.3 <= float(limit[2]) < 0.4 and limit[3] == "reading"
    assert printed["k_n"][1] != printed["k_n"][2]
    new, old = load_twin(out), load_twin(robot / "twin.yaml")
    found = json.loads((robot / "found" / "report.json").read_text())["diagnoses"][
        "left pads"
    ]
    (effect,) = new.effects
    assert effect.acts_on() == ["left_a", "left_b"]
    assert vars(effect)["limit"] == pytest.approx(found["effects"][0]["limit"])
    truth = json.loads(_sealed(said, robot))
    assert vars(effect)["limit"] == pytest.approx(
        truth["hidden"][0]["values"]["limit"], rel=0.15
    )
    assert isinstance(new.sensor, FlexiTacConfig) and isinstance(
        old.sensor, FlexiTacConfig
    )
    assert new.sensor.normal_stiffness_per_m == pytest.approx(
        found["base"]["k_n"], rel=1e-12
    )
    assert new.sensor.normal_damping_s_per_m == pytest.approx(
        found["base"]["k_d"], rel=1e-12
    )
    assert new.controller == old.controller and not new.arm_controllers
    code, text = said("compare", robot / "presses", twin, f"--against={out}")
    assert code == 0
    for pad in ("left_a", "left_b"):
        line = next(
            x.split()
            for x in text.splitlines()
            if x.startswith(f"{pad} touch") and "validation" in x
        )
        before, after = float(line[9]), float(line[15])
        assert line[5] == line[11] == "counts" and before > 4.0 and after < 1.35
    assert "data: surrogate: " in text and "not a robot" in text


def _sealed(said: Any, robot: Path) -> str:
    return said("surrogate", f"--reveal={robot}")[1]


@pytest.mark.slow
def test_terminal_and_page_tell_noise_evidence_and_numbers(robot: Path):
    text, page = (
        (robot / "said.txt").read_text(),
        (robot / "found" / "report.html").read_text(),
    )
    account = json.loads((robot / "found" / "report.json").read_text())["verdicts"]
    facts = {f["id"] for f in account["left pads"]["facts"]}
    assert {"missing", "fitted", "judged", "floor"} <= facts
    assert account["left pads"]["kind"] == "effects"
    assert "taxel_saturation: limit" in text and "03_held.mcap" in text
    assert "lower bound" not in text, "one press is recorded twice"
    assert "taxel_saturation" in page and "strong" in page and "ΔBIC" in page
    assert "error of means of 5 frames [noise floors]" in page
    assert re.search(r"<td[^>]*>k_n</td>\s*<td[^>]*>695\.8<", page), "the twin's own"


@pytest.mark.slow
def test_until_the_noise_floor_the_mended_twin_is_written(robot: Path):
    assert "found/twin.yaml" in (robot / "said.txt").read_text()
    new = load_twin(robot / "found" / "twin.yaml")
    assert [e.name for e in new.effects] == ["taxel_saturation"]
    base = json.loads((robot / "found" / "report.json").read_text())["diagnoses"][
        "left pads"
    ]["base"]
    assert isinstance(
        new.sensor, FlexiTacConfig
    ) and new.sensor.normal_stiffness_per_m == pytest.approx(base["k_n"])


@pytest.mark.slow
def test_of_an_arm_that_was_not_diagnosed_there_is_nothing_to_add(
    robot: Path, said: Any, tmp_path: Path
):
    words = [
        "taxel_saturation",
        f"--twin={robot / 'twin.yaml'}",
        f"--diagnosis={robot / 'found'}",
    ]
    code, text = said("add-effect", *words, "--pads=right", f"--out={tmp_path / 'x'}")
    assert (
        code == 2
        and "--pads=right: the recordings have no pads of that arm; " in text
        and "left" in text
    )
    code, text = said("add-effect", "touch_lag", *words[1:], f"--out={tmp_path / 'x'}")
    assert (
        code == 2
        and "left pads: " in text
        and "touch_lag" in text
        and "--values=" in text
    )
    assert not (tmp_path / "x").exists()


def test_by_hand_an_effect_may_act_on_the_pads_of_one_arm(said: Any, tmp_path: Path):
    out = tmp_path / "x.yaml"
    words = [f"--out={out}", "--values={time_constant_s: 0.03}"]
    code, text = said("add-effect", "touch_lag", *words, "--pads=lft")
    assert code == 2 and "did you mean 'left'" in text
    assert said("add-effect", "touch_lag", *words, "--pads=left")[0] == 0
    assert load_twin(out).effects[0].acts_on() == ["left_a", "left_b"]
    code, text = said(
        "add-effect",
        "coulomb_friction",
        "--pads=left",
        "--values={torque_nm: 0.1}",
        f"--out={tmp_path / 'y'}",
    )
    assert code == 2 and "is an effect of joints; remove --pads" in text


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["--pads=right"],
            "--pads=right: the recordings have no pads of that arm; known: left",
        ),
        pytest.param(
            ["--joints=J3"], "no fit recording moves a joint", marks=pytest.mark.slow
        ),
    ],
)
def test_what_is_not_there_is_said(
    words: list[str], message: str, made: Path, said: Any, tmp_path: Path
):
    code, text = said("diagnose", made / "presses", f"--out={tmp_path / 'out'}", *words)
    assert code == 2 and message in " ".join(text.split())
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"arm": "right"},
            "01_press.mcap: the object never comes within 1 mm of the pads of the right arm",
        ),
        ({"shape": "cube"}, "'cube' is not one of 'sphere', 'rod'"),
    ],
)
@pytest.mark.parametrize(
    "verb", ["compare", pytest.param("diagnose", marks=pytest.mark.slow)]
)
def test_a_wrong_object_is_an_error_with_a_way_out(
    verb, change, message, made, said, tmp_path
):
    presses = tmp_path / "presses"
    presses.mkdir()
    for name in ("01_press.mcap", "03_held.mcap"):
        (presses / name).symlink_to(made / "presses" / name)
    index = yaml.safe_load((made / "presses" / INDEX).read_text())
    del index["recordings"]["02_again.mcap"]
    index["recordings"]["01_press.mcap"]["pressed"] |= change
    (presses / INDEX).write_text(yaml.safe_dump(index))
    words = [f"--out={tmp_path / 'out'}"]
    code, text = said(verb, presses, *words)
    assert code == 2 and message in " ".join(text.split())
    assert not (tmp_path / "out").exists()


def test_without_a_word_of_what_was_pressed_the_way_out_is_said(
    made: Path, said: Any, tmp_path: Path
):
    shutil.copy(made / "presses" / "01_press.mcap", tmp_path)
    code, text = said("diagnose", tmp_path, f"--out={tmp_path / 'out'}")
    assert code == 2 and "state `pressed` in measurements.yaml" in " ".join(
        text.split()
    )


@pytest.mark.slow
def test_a_drifting_zero_is_found_among_all_effects(tmp_path: Path, said: Any):
    folder = surrogate(tmp_path / "robot", "baseline_drift", 8.0, patched=False)
    words = [
        f"--twin={folder / 'twin.yaml'}",
        f"--out={folder / 'found'}",
        "--workers=1",
    ]
    code, text = said("diagnose", folder / "presses", *words)
    found = json.loads((folder / "found" / "report.json").read_text())["diagnoses"][
        "left pads"
    ]
    assert found["effects"][0]["effect"] == "baseline_drift"
    (drift,) = found["effects"]
    truth = json.loads(_sealed(said, folder))["hidden"][0]["values"]["rate_per_min"]
    assert drift["rate_per_min"] == pytest.approx(truth, rel=0.03)
    assert "overwhelming" in (folder / "found" / "report.html").read_text()
    add = "taccorl add-effect baseline_drift --pads=left"
    assert any(command.startswith(add) for command in commands(text))
    assert (
        found["errors"]["after"]["validation"]
        < 0.25 * found["errors"]["fitted"]["validation"]
    )
    assert code == int(found["status"] != "at_floor"), (
        "taxels do not drift alike: that may be something else"
    )

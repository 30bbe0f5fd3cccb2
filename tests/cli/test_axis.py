"""An axis by itself as a user types it: compare, diagnose, add-effect, compare. Simulated by this test, not a real drive."""

import json
import math
import re
import shlex
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from axes import config_of

from taccorl.alignment.machines.robot_file import load_robot
from taccorl.sim.effects import effects
from tests.cli.printed import commands, facts

VERB = ""
MASS_KG, FRICTION_N, KP, KD = 40.0, 12.0, 4e4, 2000.0
RATE_HZ, PARTS = 250, 40
CONSIDERED = ("coulomb_friction", "viscous_friction", "command_delay")
FEW = f"--without=[{','.join(name for name in effects if name not in CONSIDERED)}]"
FILE = f"kind: axis\nname: slide\nunit: m\ninertia: {MASS_KG}\nkp: {KP}\nkd: {KD}\nlimits: [-0.15, 0.15]\nforce_unit_n: 10.0\n"


def write(
    path: Path, amplitude_m: float, hz: float, seed: int, effort: float = 1.0, damping: float = 0.0,
    friction_n: float = FRICTION_N, log: bool = False,
) -> None:  # fmt: skip
    """A mass with dry friction, and ``damping`` [N·s/m], under PD control, at 0.1 ms: equations of this test. ``log``: the target
    moves on evenly from row to row and is not logged."""
    time_s = np.arange(4 * RATE_HZ) / RATE_HZ
    fade = np.clip(np.minimum(time_s - 0.3, 3.7 - time_s) / 0.4, 0, 1)
    target = (
        amplitude_m * fade**2 * (3 - 2 * fade) * np.sin(2 * np.pi * hz * (time_s - 0.3))
    )
    dt_s, at, speed, goal, rows = 1.0 / (RATE_HZ * PARTS), 0.0, 0.0, 0.0, []
    stops = dt_s * friction_n / MASS_KG
    for following in target.tolist():
        rows.append((at, KP * (goal - at) - KD * speed))
        for asked in (
            np.linspace(goal, following, PARTS + 1)[:-1].tolist()
            if log
            else [following] * PARTS
        ):
            free = speed + dt_s * (KP * (asked - at) - (KD + damping) * speed) / MASS_KG
            speed = (
                0.0 if abs(free) <= stops else free - math.copysign(1.0, free) * stops
            )
            at += dt_s * speed
        goal = following
    rng = np.random.default_rng(seed)
    noise = rng.standard_normal((2, len(rows))) * [[2e-5], [1.0]]
    lines = ["t,slide.q,slide.tau" if log else "t,slide.q,slide.q_target,slide.tau"]
    for t, goal, (q, tau), (dq, dtau) in zip(
        time_s, target, rows, noise.T, strict=True
    ):
        lines.append(
            f"{t:.4f},{q + dq:.7f},{'' if log else f'{goal:.7f},'}{effort * (tau + dtau):.4f}"
        )
    path.write_text("\n".join(lines) + "\n")


def made(folder: Path, file: str = FILE, **how: Any) -> Path:
    (folder / "bench").mkdir()
    for name, amplitude_m, hz, seed in (
        ("one", 0.1, 0.6, 1),
        ("again", 0.1, 0.6, 2),
        ("held", 0.08, 0.8, 3),
    ):
        write(folder / "bench" / f"{name}.csv", amplitude_m, hz, seed, **how)
    (folder / "bench" / "measurements.yaml").write_text(
        "recordings:\n  again.csv: {repeat_of: one.csv}\n  held.csv: {use: validation}\n"
    )
    (folder / "drive.yaml").write_text(file)
    return folder


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made(tmp_path_factory.mktemp("axis"))


def error(report: Path, use: str, kind: str) -> float:
    found = json.loads((report / "report.json").read_text())["scores"]
    return next(s["rmse"] for s in found if (s["use"], s["kind"]) == (use, kind))


def test_rows_that_all_stand_twice_are_named_and_not_compared(bench, tmp_path, said):
    head, *rows = (bench / "bench" / "one.csv").read_text().splitlines()
    (tmp_path / "twice").mkdir()
    (tmp_path / "twice" / "one.csv").write_text(
        "\n".join([head, *(row for row in rows for _ in range(2))]) + "\n"
    )
    code, text = said("compare", tmp_path / "twice", f"--twin={bench / 'drive.yaml'}")
    assert code == 1 and "time_backwards" in text and "not compared" in text


def write_smooth(path: Path, seed: int, *, steps: bool = False) -> None:
    """The mass without friction under a target that moves on at 0.1 ms, or steps 0.2 ms after a row, logged at 250 Hz."""
    dt_s = 1.0 / (RATE_HZ * PARTS)
    time_s = np.arange(4 * RATE_HZ * PARTS) * dt_s
    fade = np.clip(np.minimum(time_s - 0.3, 3.7 - time_s) / 0.4, 0, 1)
    target = 0.1 * fade**2 * (3 - 2 * fade) * np.sin(2 * np.pi * 0.6 * (time_s - 0.3))
    if steps:
        target = 0.1 * ((time_s - 0.2002) // 0.6 % 2 == 0)
    at = speed = 0.0
    rng = np.random.default_rng(seed)
    lines = ["t,slide.q,slide.q_target"]
    for k, goal in enumerate(target.tolist()):
        if k % PARTS == 0:
            lines.append(
                f"{time_s[k]:.4f},{at + 2e-5 * rng.standard_normal():.7f},{goal:.7f}"
            )
        speed += dt_s * (KP * (goal - at) - KD * speed) / MASS_KG
        at += dt_s * speed
    path.write_text("\n".join(lines) + "\n")


def test_a_drive_whose_targets_are_logged_too_slowly_is_compared_once_its_rate_is_stated(
    tmp_path, said
):
    (tmp_path / "bench").mkdir()
    for name, seed in (("one", 1), ("again", 2)):
        write_smooth(tmp_path / "bench" / f"{name}.csv", seed)
    (tmp_path / "bench" / "measurements.yaml").write_text(
        "recordings:\n  again.csv: {repeat_of: one.csv}\n"
    )
    (tmp_path / "held.yaml").write_text(FILE)
    (tmp_path / "drive.yaml").write_text(FILE + "command_hz: 10000\n")
    code, text = said(
        "compare",
        tmp_path / "bench",
        f"--twin={tmp_path / 'held.yaml'}",
        f"--out={tmp_path / 'a'}",
    )
    assert code == 1 and "shifted_from_twin" in text and "command_hz" in text
    code, text = said(
        "compare",
        tmp_path / "bench",
        f"--twin={tmp_path / 'drive.yaml'}",
        f"--out={tmp_path / 'b'}",
    )
    assert code == 0 and "shifted_from_twin" not in text, text
    # noise of 2e-5 m; held, half a row of 4 ms at 0.38 m/s is 7e-4 m
    assert error(tmp_path / "b", "fit", "position") < 4e-5
    write_smooth(tmp_path / "bench" / "steps.csv", 3, steps=True)
    code, text = said(
        "compare", tmp_path / "bench", f"--twin={tmp_path / 'drive.yaml'}"
    )
    assert code == 0 and "measured_before_command" not in text, text
    assert (
        "measured_before_command"
        in said("compare", tmp_path / "bench", f"--twin={tmp_path / 'held.yaml'}")[1]
    )


@pytest.mark.slow
def test_friction_of_an_axis_is_found_and_added_and_the_error_falls(
    bench, said, tmp_path
):
    drive = bench / "drive.yaml"
    code, text = said(
        "compare", bench / "bench", f"--twin={drive}", f"--out={tmp_path / 'before'}"
    )
    assert code == 0 and "slide position" in text and "slide effort" in text
    code, text = said(
        "diagnose",
        bench / "bench",
        f"--twin={drive}",
        f"--out={tmp_path / 'found'}",
        FEW,
    )
    assert code in (0, 1) and "slide lacks coulomb_friction" in text, text
    assert "_joint" not in text and "PiPER" not in text
    assert re.search(r"coulomb_friction: torque_nm [\d.]+ N\b", text)
    assert "N·m" not in text
    add = f"taccorl add-effect coulomb_friction --twin={drive}"
    assert any(command.startswith(add) for command in commands(text))
    page = (tmp_path / "found" / "report.html").read_text()
    assert page.count("<img") >= 5 and "slide" in page
    code, text = said(
        "add-effect",
        "coulomb_friction",
        f"--twin={drive}",
        f"--diagnosis={tmp_path / 'found'}",
    )
    assert code == 0
    mended = load_robot(bench / "drive+coulomb_friction.yaml")
    (effect,) = config_of(mended).effects
    assert effect.name == "coulomb_friction"
    # The model takes steps of 0.2 ms.
    assert effect.torque_nm == pytest.approx(FRICTION_N, rel=0.15)
    low, high = effect.interval["torque_nm"]
    assert low < effect.torque_nm < high
    new = tmp_path / "after"
    assert (
        said(
            "compare",
            bench / "bench",
            f"--twin={bench / 'drive+coulomb_friction.yaml'}",
            f"--out={new}",
        )[0]
        == 0
    )
    for kind in ("position", "effort"):
        assert error(new, "validation", kind) < 0.3 * error(
            tmp_path / "before", "validation", kind
        )
    assert drive.read_text() == FILE


@pytest.mark.parametrize("friction_n", [FRICTION_N, 0.0])
def test_a_log_of_positions_and_efforts_alone_shows_the_friction(
    said, tmp_path, friction_n: float
):
    """A friction of 12 N is found, within 2 % and without a constant force beside it; where there is none, nothing is found."""
    made(
        tmp_path,
        re.sub("kp: .*\nkd: .*\n", "law: effort\n", FILE),
        friction_n=friction_n,
        log=True,
    )
    drive, found = tmp_path / "drive.yaml", tmp_path / "found"
    code, text = said(
        "diagnose", tmp_path / "bench", f"--twin={drive}", f"--out={found}", FEW
    )
    d = json.loads((found / "report.json").read_text())["diagnoses"]["slide"]
    assert [e["effect"] for e in d["effects"]] == ["coulomb_friction"] * (
        friction_n > 0.0
    ), text
    assert (
        code == 0 and not d["changed"] and d["errors"]["after"]["validation"] < 1.1
    ), text
    assert d["intervals"]["torque_ff"] == pytest.approx([0.0, 0.0], abs=0.2)
    low, high = d["intervals"].get("coulomb_friction.torque_nm", (0.0, 0.0))
    assert low <= friction_n <= high and high - low < 0.02 * FRICTION_N


KNOWS = f"{FILE}effects: [{{effect: coulomb_friction, torque_nm: {FRICTION_N}}}]\n"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "before", "true", "file"),
    [
        (
            "coulomb_friction.torque_nm",
            3.0,
            FRICTION_N,
            KNOWS.replace(": 12.0", ": 3.0"),
        ),
        (
            "inertia",
            48.0,
            MASS_KG,
            KNOWS.replace(": 40.0", ": 48.0") + "known: [kp, kd, coulomb_friction]\n",
        ),
    ],
)
def test_a_number_of_the_file_that_is_off_is_the_result_and_is_written(
    bench, said, tmp_path, monkeypatch, name, before, true, file
):
    """What `diagnose` states and what `compare` prints with the written file is one number."""
    monkeypatch.chdir(tmp_path)
    Path("drive.yaml").write_text(file)
    words = (bench / "bench", "--twin=drive.yaml", FEW)
    code, text = said("diagnose", *words)
    report = json.loads(Path("diagnosis/report.json").read_text())
    d = report["diagnoses"]["slide"]
    (c,) = d["changed"]
    low, high = d["intervals"][name]
    assert (c["name"], c["before"]) == (name, before) and low < c["after"] < high
    assert (
        c["after"] == pytest.approx(true, rel=0.15)
        and c["without"] > 3.0 * d["errors"]["after"]["validation"]
    )
    (fact,) = facts(Path("diagnosis"), "slide")["changed"]
    after = {"value": c["after"], "unit": c["unit"], "low": low, "high": high}
    assert (fact["name"], fact["before"], fact["after"]) == (name, before, after)
    assert code == 0
    printed = shlex.split(text.split("taccorl add-effect ")[-1].splitlines()[0])
    assert printed == [name.partition(".")[0], "--twin=drive.yaml"]
    code, text = said("add-effect", *printed)
    assert code == 0 and report["verdicts"]["slide"]["title"] in text, text
    text = said(*shlex.split(text.split("next: taccorl ")[1].splitlines()[0]))[1]
    shown = re.search(r"validation ([\d.]+) → ([\d.]+) × floor", text)
    stated = [d["errors"][stage]["validation"] for stage in ("before", "after")]
    assert shown and [*map(float, shown.groups())] == pytest.approx(stated, rel=0.02), (
        text
    )
    text = said("diagnose", *words, "--until=noise_floor")[1]
    assert "wrote diagnosis/drive.yaml" in text and "--until" not in text
    assert (
        Path("diagnosis/drive.yaml").read_text()
        == Path(f"drive+{printed[0]}.yaml").read_text()
    )
    for changed, added, way in (
        ([], [], "--values" if "." in name else "inertia is not off in that diagnosis"),
        (
            [c],
            [{"effect": "viscous_friction", "damping_nms_per_rad": 1.0}],
            f"add-effect {printed[0]},viscous_friction",
        ),
    ):
        d |= {"changed": changed, "effects": [*d["effects"], *added]}
        Path("diagnosis/report.json").write_text(json.dumps(report))
        code, text = said("add-effect", *printed, "--out=other.yaml")
        assert code == 2 and way in text, text


def test_gains_that_nobody_knows_are_written_by_the_command_that_is_printed(
    bench, said, tmp_path
):
    """The file has half of the drive's kp, and its friction."""
    (twin := tmp_path / "half.yaml").write_text(
        KNOWS.replace(f"kp: {KP}", f"kp: {KP / 2}\ngains: fitted")
    )
    out = tmp_path / "d"
    code, text = said(
        "diagnose", bench / "bench", f"--twin={twin}", f"--out={out}", FEW
    )
    own = facts(out, "slide")
    kp = next(v for v in own["changed"] if v["name"] == "kp")
    assert code == 0 and kp["before"] == KP / 2
    assert kp["after"]["value"] == pytest.approx(KP, rel=0.05)
    add = next(c for c in commands(text) if c.startswith("taccorl add-effect"))
    code, text = said(*shlex.split(add)[1:])
    assert code == 0, text
    code, text = said(*shlex.split(commands(text)[-1])[1:])
    assert code == 0 and "half+" in text, text


@pytest.mark.slow
def test_any_part_of_what_was_found_is_written_once_and_leaves_the_error_that_was_stated(
    tmp_path, said, monkeypatch
):
    """12 N of dry friction and 150 N·s/m; the file knows neither. Errors are of position and effort together."""
    monkeypatch.chdir(made(tmp_path, damping=150.0))
    code, text = said(
        "diagnose",
        "bench",
        "--twin=drive.yaml",
        "--out=found",
        FEW,
        "--until=noise_floor",
    )
    d = json.loads(Path("found/report.json").read_text())["diagnoses"]["slide"]
    both = [e["effect"] for e in d["effects"]]
    assert sorted(both) == ["coulomb_friction", "viscous_friction"], text
    printed = shlex.split(commands(text)[-1])
    assert printed == [
        "taccorl",
        "compare",
        "bench",
        "--twin=drive.yaml",
        "--against=found/drive.yaml",
    ]
    assert said(*printed[1:], "--out=as_printed")[0] == 0
    stated = {tuple(sorted(o["added"])): o["errors"] for o in d["offers"]} | {
        tuple(sorted(both)): d["errors"]["after"]
    }
    for names in (both, both[::-1], both[:1], both[1:]):
        out = f"{'+'.join(names)}.yaml"
        code, text = said(
            "add-effect",
            ",".join(names),
            "--twin=drive.yaml",
            "--diagnosis=found",
            f"--out={out}",
        )
        assert code == 0, text
        written = config_of(load_robot(Path(out))).effects
        assert sorted(e.name for e in written) == sorted(names)
        code, text = said(
            "compare",
            "bench",
            "--twin=drive.yaml",
            f"--against={out}",
            f"--out=with_{out}",
        )
        scores = json.loads(Path(f"with_{out}/report.json").read_text())["scores_after"]
        for use in ("fit", "validation"):
            left = np.sqrt(
                np.mean([s["ratio"] ** 2 for s in scores if s["use"] == use])
            )
            assert left == pytest.approx(stated[tuple(sorted(names))][use], rel=0.02), (
                names,
                use,
            )
    assert (
        Path(f"{'+'.join(both)}.yaml").read_bytes()
        == Path("found/drive.yaml").read_bytes()
    )
    alone, beside = (
        next(
            e.torque_nm
            for e in config_of(load_robot(Path(path))).effects
            if e.name == "coulomb_friction"
        )
        for path in ("coulomb_friction.yaml", "found/drive.yaml")
    )
    assert beside == pytest.approx(12.0, rel=0.05) and abs(alone / beside - 1) > 0.2
    code, text = said(
        "add-effect",
        f"{both[0]},{both[0]}",
        "--twin=drive.yaml",
        "--diagnosis=found",
        "--out=x.yaml",
    )
    assert code == 0 and len(config_of(load_robot(Path("x.yaml"))).effects) == 1
    code, text = said(
        "add-effect",
        f"{both[0]},slew_limit",
        "--twin=drive.yaml",
        "--diagnosis=found",
        "--out=y.yaml",
    )
    assert code == 2 and "slew_limit" in text and not Path("y.yaml").exists()


def test_test_recordings_alone_are_compared_and_files_of_one_name_are_told_apart(
    bench, said, tmp_path, monkeypatch
):
    (tmp_path / "bench").mkdir()
    (tmp_path / "new").mkdir()
    (tmp_path / "bench" / "one.csv").write_text(
        (bench / "bench" / "one.csv").read_text()
    )
    (tmp_path / "bench" / "measurements.yaml").write_text(
        "recordings: {one.csv: {use: test}}\n"
    )
    other = tmp_path / "new" / "drive.yaml"
    other.write_text(
        f"{FILE}effects: [{{effect: coulomb_friction, torque_nm: {FRICTION_N}}}]\n"
    )
    words = (tmp_path / "bench", f"--twin={bench / 'drive.yaml'}")
    code, text = said(
        "compare", *words, f"--against={other}", f"--out={tmp_path / 'both'}"
    )
    assert code == 0 and "new/drive" in text, text
    found = json.loads((tmp_path / "both" / "report.json").read_text())
    assert {f"{bench.name}/drive, SHA-256", "new/drive, SHA-256"} <= found[
        "provenance"
    ].keys()
    before, after = (
        next(s for s in found[k] if s["kind"] == "position")
        for k in ("scores", "scores_after")
    )
    monkeypatch.chdir(tmp_path)  # drive.yaml beside new/drive.yaml
    (tmp_path / "drive.yaml").write_text(FILE)
    assert (
        " new/drive "
        in said("compare", "bench", "--twin=drive.yaml", "--against=new/drive.yaml")[1]
    )
    assert before["use"] == "test" and after["rmse"] < 0.3 * before["rmse"]
    code, text = said("diagnose", *words)  # which fits
    assert code == 2 and "one.csv" in text and "use: fit" in text


def test_an_effect_by_hand_needs_no_name_of_the_only_axis(bench, said, tmp_path):
    words = [
        "coulomb_friction",
        f"--twin={bench / 'drive.yaml'}",
        "--values={torque_nm: 3.0}",
    ]
    assert said("add-effect", *words, f"--out={tmp_path / 'x.yaml'}")[0] == 0
    (effect,) = config_of(load_robot(tmp_path / "x.yaml")).effects
    assert (effect.torque_nm, effect.presliding_rad) == (3.0, 0.0)
    assert effect.evidence == "by hand"
    code, text = said(
        "add-effect", *words, "--pads=left", f"--out={tmp_path / 'y.yaml'}"
    )
    assert code == 2 and "drive has no pads" in text
    code, text = said(
        "add-effect", *words, "--joints=[slde]", f"--out={tmp_path / 'y.yaml'}"
    )
    assert code == 2 and "--joints=slde: no such joint; did you mean 'slide'" in text


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("inertia: 40.0", "inertia: 4.0", "Write `inertia: "),
        (
            "limits: [-0.15, 0.15]",
            "limits: [0.0, 0.05]",
            "its limits in drive.yaml are [0, 0.05]. Write the `unit:` of slide.q",
        ),
        ("name: slide", "name: sled", "did you mean"),
        ("name: slide", "name: ' '", "the name is blank"),
        (
            "kind: axis",
            f"kind: axis\neffects: [{2 * '{effect: coulomb_friction, torque_nm: 1}, '}]",
            "friction stands twice",
        ),
    ],
)
def test_a_file_of_another_axis_is_refused(bench, said, tmp_path, old, new, message):
    (tmp_path / "drive.yaml").write_text(FILE.replace(old, new))
    code, text = said("compare", bench / "bench", f"--twin={tmp_path / 'drive.yaml'}")
    assert code != 0 and message in text


@pytest.mark.parametrize("in_the_file", [False, True])
def test_efforts_of_other_gains_name_these_and_no_effect(
    bench, said, tmp_path, in_the_file
):
    shutil.copytree(bench / "bench", tmp_path / "bench")
    gains = {} if in_the_file else {"kp": {"slide": 2 * KP}, "kd": {"slide": KD}}
    index = {
        "one.csv": gains,
        "again.csv": gains | {"repeat_of": "one.csv"},
        "held.csv": gains | {"use": "validation"},
    }
    (tmp_path / "bench" / "measurements.yaml").write_text(
        json.dumps({"recordings": index})
    )
    (tmp_path / "drive.yaml").write_text(
        FILE.replace(f"kp: {KP}", f"kp: {2 * KP if in_the_file else KP}")
    )
    words = (
        "diagnose",
        tmp_path / "bench",
        f"--twin={tmp_path / 'drive.yaml'}",
        f"--out={tmp_path / 'd'}",
        FEW,
    )
    code, text = said(*words)
    assert (
        code == 1
        and re.search("slide: not diagnosed: .*`kp: (3.[89]|4)[0-9.]*e.04`", text)
        and "lacks" not in text
    )
    assert in_the_file or "slide lacks" in said(*words, "--accept=other_gains")[1]


def test_gains_per_degree_are_suspected_before_an_effect(bench, said, tmp_path):
    """kp 57.3 times too small lags by kd / kp = 2.9 s behind a sine of 0.6 Hz: nearly all of the motion is left."""
    (tmp_path / "degrees.yaml").write_text(
        FILE.replace(f"kp: {KP}", f"kp: {KP / 57.3}")
    )
    code, text = said("compare", bench / "bench", f"--twin={tmp_path / 'degrees.yaml'}")
    off = re.findall(r"slide: the replay is off by (\d+)%.*kp", text)
    assert code == 0 and len(off) == 1 and 60 < int(off[0]) < 140, text
    assert (
        "off by"
        not in said("compare", bench / "bench", f"--twin={bench / 'drive.yaml'}")[1]
    )
    (tmp_path / "start.yaml").write_text(
        FILE.replace(f"kp: {KP}", f"kp: {KP / 57.3}\ngains: fitted")
    )
    text = said("compare", bench / "bench", f"--twin={tmp_path / 'start.yaml'}")[1]
    assert "gains: fitted" in text and "per degree" not in text


def test_columns_with_a_factor_mend_sign_and_unit(bench, said, tmp_path):
    (tmp_path / "bench").mkdir()
    write(tmp_path / "bench" / "one.csv", 0.1, 0.6, 1, effort=-1e3)
    code, text = said("compare", tmp_path / "bench", f"--twin={bench / 'drive.yaml'}")
    assert code == 1 and "`factor: -1`" in text
    (tmp_path / "bench" / "columns.yaml").write_text(
        "time: {column: t, unit: s}\nsignals: {slide: {q: {column: slide.q, unit: m}, q_target: {column: slide.q_target, "
        "unit: m}, tau: {column: slide.tau, unit: N, factor: -0.001}}}\n"
    )
    (tmp_path / "bench" / "measurements.yaml").write_text("columns: columns.yaml\n")
    code, text = said("compare", tmp_path / "bench", f"--twin={bench / 'drive.yaml'}")
    assert code == 0 and "slide effort" in text


def test_a_stage_that_moves_by_a_millimetre_is_compared_and_one_that_stands_is_not(
    said, tmp_path
):
    """± 0.9 mm are 9000 of the noise's 0.2 µm; 9 µm are 45."""
    (tmp_path / "drive.yaml").write_text(FILE)
    for name, amplitude_m in (("small", 0.9e-3), ("still", 4.5e-6)):
        (tmp_path / name).mkdir()
        time_s = np.arange(4 * RATE_HZ) / RATE_HZ
        target = amplitude_m * np.sin(2 * np.pi * 0.6 * np.clip(time_s - 0.3, 0.0, 3.0))
        q = np.concatenate([np.zeros(13), target[:-13]]) + 2e-7 * np.random.default_rng(
            1
        ).standard_normal(len(time_s))
        lines = [
            f"{t:.4f},{x:.9f},{goal:.9f}"
            for t, x, goal in zip(time_s, q, target, strict=True)
        ]
        (tmp_path / name / "one.csv").write_text(
            "\n".join(["t,slide.q,slide.q_target", *lines]) + "\n"
        )
        code, text = said(
            "compare",
            tmp_path / name,
            f"--twin={tmp_path / 'drive.yaml'}",
            f"--out={tmp_path / name}_out",
        )
        assert ("no_motion" in text) == (name == "still"), text
        assert code == 0 if name == "small" else "slide by less than 2e-05 m" in text


def test_a_column_of_another_name_is_not_blamed_on_a_robot(bench, said, tmp_path):
    (tmp_path / "bench").mkdir()
    table = (bench / "bench" / "one.csv").read_text().replace("slide.", "slid.")
    (tmp_path / "bench" / "one.csv").write_text(table)
    code, text = said("compare", tmp_path / "bench", f"--twin={bench / 'drive.yaml'}")
    assert (
        code == 2
        and "has no 'slid' (did you mean 'slide'" in text
        and "robot" not in text
    )

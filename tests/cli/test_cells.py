"""A sensor of cells by the command line: compare, diagnose, add-effect, and messages about files that do not fit."""

import csv
import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import yaml

from taccorl.alignment.machines.cells_file import cells_text, load_cells
from taccorl.surrogate.cells import draw_cells, write_cells
from tests.cli.printed import facts

SENSOR = """\
kind: cells
cells: [thumb]
load: {unit: N, rated: 20}
reading: {unit: count, lowest: 0, highest: 1023}
"""
T_S = np.arange(0, 20, 0.01)
LOAD_N = np.interp(
    T_S, [0, 3, 4, 8, 9, 12, 13, 16, 17, 20], [0, 0, 10, 10, 0, 0, 18, 18, 0, 0]
)


@pytest.fixture(scope="module")
def creeping(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recordings of a simulated cell that creeps, and ``taxel.yaml``, which does not know it."""
    folder = tmp_path_factory.mktemp("cells") / "simulated"
    write_cells(draw_cells("taxel_creep", 11), folder)
    return folder


def table(folder: Path, name: str = "press.csv", **columns: np.ndarray) -> Path:
    """A press of a linear cell of 40 counts per N; ``columns`` replace or add columns (two underscores for a dot)."""
    rng = np.random.default_rng(1)
    found = {"t": T_S, "force_n": LOAD_N + 0.01 * rng.standard_normal(len(T_S))}
    found["thumb.reading"] = np.round(40 * LOAD_N + 20 + rng.standard_normal(len(T_S)))
    found |= {key.replace("__", "."): values for key, values in columns.items()}
    folder.mkdir(exist_ok=True)
    with (folder / name).open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(found)
        writer.writerows(
            [[f"{x:.7g}" for x in row] for row in zip(*found.values(), strict=True)]
        )
    return folder / name


def test_a_copied_press_is_pointed_out(tmp_path, said):
    (tmp_path / "sensor.yaml").write_text(SENSOR)
    first = table(tmp_path / "presses")
    (first.parent / "z.csv").write_bytes(first.read_bytes())
    _, shown = said("compare", first.parent, f"--twin={tmp_path / 'sensor.yaml'}")
    assert "copied_recording: z.csv is press.csv, number for number" in shown


@pytest.mark.slow
def test_a_hidden_effect_is_found_added_and_the_error_falls(creeping, said):
    sensor, presses, out = (
        creeping / "taxel.yaml",
        creeping / "presses",
        creeping / "diagnosis",
    )
    code, shown = said(
        "compare", presses, f"--twin={sensor}", f"--out={creeping / 'compared'}"
    )
    assert code == 0 and "fingertip touch" in shown and "loading" in shown
    assert "simulated force cells" in shown
    code, shown = said("diagnose", presses, f"--twin={sensor}", f"--out={out}")
    assert code == 0 and [*facts(out, "fingertip")][0] == "effects"
    assert "fingertip lacks taxel_creep  [confidence: high]" in shown
    assert "taccorl excite" not in shown, "no effect does as well"
    page = (out / "report.html").read_text()
    for words in (
        "gain and offset of each cell fitted",
        "simulated force cells",
        "reading over load",
        "taxel_creep",
        "phase",
    ):
        assert words in page
    code, shown = said(
        "add-effect", "taxel_creep", f"--twin={sensor}", f"--diagnosis={out}"
    )
    assert code == 0
    given = f"--twin={creeping / 'taxel+taxel_creep.yaml'}", f"--measurements={presses}"
    printed = re.findall(
        "`taccorl (diagnose .*?)`",
        said("excite", "--effects=taxel_creep,touch_lag", *given)[1],
    )
    for k, command in enumerate(printed):
        assert said(*shlex.split(command), f"--out={creeping / f'printed_{k}'}")[0] in (
            0,
            1,
        ), command
    assert [given[0] in command for command in printed] == [True]
    mended = load_cells(creeping / "taxel+taxel_creep.yaml")
    assert [e.name for e in mended.effects] == ["taxel_creep"] and len(
        mended.gain
    ) == len(mended.offset) == 1
    code, shown = said(
        "compare",
        presses,
        f"--twin={sensor}",
        f"--against={creeping / 'taxel+taxel_creep.yaml'}",
        f"--out={out / 'both'}",
    )
    assert code == 0
    report = json.loads((out / "both" / "report.json").read_text())
    before, after = (
        {s["use"]: s["ratio"] for s in report[key]}
        for key in ("scores", "scores_after")
    )
    for use in ("fit", "validation", "test"):
        assert before[use] > 2.5 and after[use] < 1.2, (use, before, after)


def test_the_next_press_is_planned_with_the_columns_of_recordings(
    creeping, said, tmp_path
):
    words = [
        "excite",
        f"--twin={creeping / 'taxel.yaml'}",
        f"--measurements={creeping / 'presses'}",
    ]
    rivals = "--effects=taxel_creep,touch_lag"
    code, shown = said(
        *words,
        rivals,
        "--span=[0,12]",
        "--speed=40",
        "--num=2",
        f"--out={tmp_path / 'plan'}",
    )
    assert code == 0 and "12 N" in shown and "count, the median cell" in shown
    plan = yaml.safe_load((tmp_path / "plan" / "plan.yaml").read_text())
    assert (plan["sensor"], plan["rate_hz"], len(plan["presses"])) == (
        "fingertip",
        100.0,
        2,
    )
    scores = [
        press["floors_apart"]["taxel_creep | touch_lag"] for press in plan["presses"]
    ]
    assert scores == sorted(scores, reverse=True) and scores[0] > 1.25
    for press in plan["presses"]:
        with (tmp_path / "plan" / press["table"]).open() as file:
            head, *rows = csv.reader(file)
        assert head == ["t", "force_n"]
        time_s, load = np.array(rows, dtype=float).T
        assert (
            load.max() == pytest.approx(press["highest_load"], rel=1e-3)
            and load.max() <= 12.0
        )
        assert np.abs(np.diff(load)).max() * 100 <= 40.0 + 1e-3
        assert time_s[-1] == pytest.approx(press["seconds"], abs=0.06)

    for asked, expected in (
        ([rivals, "--joint=thumb"], "--joint"),
        ([rivals, "--gains=fitted"], "--gains"),
        ([rivals, "--pads=left"], "--pads=left"),
        ([], "--effects=touch_lag,touch_delay"),
    ):
        code, shown = said(
            *words, *asked, f"--diagnosis={tmp_path}", f"--out={tmp_path / 'none'}"
        )
        assert code == 2 and expected in shown
    assert (
        "--measurements"
        in said(words[0], words[1], rivals, f"--out={tmp_path / 'none'}")[1]
    )
    assert not (tmp_path / "none").exists()


def test_a_simulated_sensor_is_written_with_its_truth_sealed(tmp_path, said):
    code, shown = said(
        "surrogate",
        "--secret=3",
        "--cells=true",
        "--effects=[taxel_threshold]",
        "--out=made",
    )
    assert code == 0 and "simulated, not a real one" in shown
    assert (
        "taxel_threshold" not in (tmp_path / "made" / "sealed_truth.json").read_text()
    )
    assert "taxel_threshold" in said("surrogate", "--reveal=made")[1]
    assert load_cells(tmp_path / "made" / "taxel.yaml").names == ("thumb",)
    assert said("compare", "made/presses", "--twin=made/taxel.yaml")[0] == 0
    assert (
        "no hidden effect 'creep'"
        in said("surrogate", "--secret=3", "--cells=true", "--effects=[creep]")[1]
    )
    assert (
        "--pads applies to robots"
        in said("surrogate", "--secret=3", "--cells=true", "--pads=left")[1]
    )


def test_an_effect_can_be_added_by_hand_and_a_wrong_one_is_refused(tmp_path, said):
    (tmp_path / "taxel.yaml").write_text(SENSOR + "gain: [40]\noffset: [20]\n")
    code, _ = said(
        "add-effect",
        "taxel_threshold",
        "--twin=taxel.yaml",
        "--values={threshold: 0.2}",
    )
    assert code == 0
    mended = load_cells(tmp_path / "taxel+taxel_threshold.yaml")
    assert mended.gain == [40.0]
    assert mended.effects[0].threshold == 0.2  # pyright: ignore[reportAttributeAccessIssue]
    code, shown = said(
        "add-effect", "coulomb_friction", "--twin=taxel.yaml", "--values={torque_nm: 1}"
    )
    assert (
        code == 2 and "coulomb_friction is not an effect of a sensor of cells" in shown
    )


def test_a_file_is_written_as_it_is_read(tmp_path):
    path = tmp_path / "grid.yaml"
    path.write_text(
        "kind: cells\nrows: 2\ncolumns: 3\nload: {unit: kPa, rated: 50, shared: false}\nreading: {unit: kohm, falls: true}\n"
        "effects:\n- {effect: taxel_crosstalk, share: 0.1}\n- {effect: taxel_creep, share: -0.1, time_constant_s: 2}\n"
    )
    config = load_cells(path)
    assert (
        config.names == ("r0c0", "r0c1", "r0c2", "r1c0", "r1c1", "r1c2")
        and config.sign == -1
    )
    again = tmp_path / "again.yaml"
    again.write_text(cells_text(config))
    assert load_cells(again) == config and "pads" not in cells_text(config)


@pytest.mark.parametrize(
    ("old", "new", "line", "words"),
    [
        ("unit: N,", "unit: n,", 3, "'n' is not a unit of force, pressure or depth; known: MPa, N"),
        ("unit: count", "unit: counts", 4, "'counts' is not a unit of a reading; did you mean 'count'"),
        ("rated: 20", "rated: 0", 3, "rated 0 N; give the greatest load, above 0"),
        ("lowest: 0", "lowest: 2000", 4, "lowest 2000 is not below highest 1023"),
        ("cells: [thumb]", "rows: 2", 2, "a grid needs both"),
        ("cells: [thumb]\n", "", 1, "give names, `cells: [thumb]`, or a grid"),
        ("highest: 1023}", "highest: 1023}\ngain: [1, 2]\noffset: [1, 2]", 5, "2 numbers for 1 cells"),
        ("highest: 1023}", "highest: 1023}\neffects: [{effect: pad_shift}]", 5, "pad_shift acts on pads, not on cells"),
        ("highest: 1023}", "highest: 1023}\neffects: [{effect: taxel_ghosting, share: 0.1}]", 5, "needs neighbours; give rows"),
        ("kind: cells", "kind: cell", 1, "there is no kind of machine 'cell'; did you mean 'cells'"),
        ("cells: [thumb]", "cellz: [thumb]", 2, "unknown key 'cellz'"),
    ],
)  # fmt: skip
def test_a_wrong_line_of_the_file_is_said_with_the_way_out(
    tmp_path, said, old, new, line, words
):
    table(tmp_path / "presses")
    (tmp_path / "taxel.yaml").write_text(SENSOR.replace(old, new))
    code, shown = said("compare", "presses", "--twin=taxel.yaml")
    assert code == 2 and words in shown
    assert f"taxel.yaml:{line}:" in shown
    assert not re.search(r"\b(\w+): \1:", shown), "a key is said once"


def held(values: np.ndarray, rows: int) -> np.ndarray:
    return values[np.arange(len(values)) // rows * rows]


@pytest.mark.parametrize(
    ("columns", "words"),
    [
        (
            {"thumb__reading": 900 - 40 * LOAD_N},
            "wrong_sign: thumb: the reading falls under load; write `falls: true` below `reading:`",
        ),
        ({"force_n": np.full(len(T_S), 8.0)}, "constant_load"),
        ({"force_n": LOAD_N + 3.0}, "no_rest: less than 0.5 s without load (below 0.4 N)"),
        ({"force_n": LOAD_N * 1000}, "load_unit: the load reaches 1.8e+04 N, 900 times the rated 20 N"),
        ({"thumb__reading": np.where(LOAD_N > 0.5, 1023, 20)}, "saturated: thumb: 100% of the loaded rows are at an end"),
        (
            {"thumb__reading": 200 * LOAD_N + 20},
            "beyond_ends: thumb: readings are 20 … 3620 count, beyond lowest 0 … highest 1023",
        ),
        ({"thumb__reading": np.full(len(T_S), 20.0)}, "no_reading: thumb: the reading never changes under load"),
        ({"force_n": held(LOAD_N + 0.01 * np.sin(17 * T_S), 10)}, "load_held: the load changes every 10 rows only"),
    ],
)  # fmt: skip
def test_a_wrong_recording_is_said_with_what_to_do_and_nothing_is_compared(
    tmp_path, said, columns, words
):
    table(tmp_path / "presses", **columns)
    (tmp_path / "taxel.yaml").write_text(SENSOR)
    for verb in ("compare", "diagnose"):
        code, shown = said(verb, "presses", "--twin=taxel.yaml")
        assert code == 1 and words in " ".join(shown.split())


def test_another_rate_than_the_file_says_is_an_error_and_can_be_accepted(
    tmp_path, said
):
    table(tmp_path / "presses")
    (tmp_path / "taxel.yaml").write_text(SENSOR + "rate_hz: 1000\n")
    code, shown = said("compare", "presses", "--twin=taxel.yaml")
    assert code == 1
    assert "other_rate: 100 rows a second; write `rate_hz: 100`" in " ".join(
        shown.split()
    )
    assert (
        said("compare", "presses", "--twin=taxel.yaml", "--accept=other_rate")[0] == 0
    )


def test_the_cell_at_fault_is_named_and_no_fit_recording_is_called_sound(
    tmp_path, said
):
    (tmp_path / "taxel.yaml").write_text(SENSOR.replace("[thumb]", "[thumb, index]"))
    for name in ("one.csv", "two.csv"):
        table(
            tmp_path / "presses", name, index__reading=np.where(LOAD_N > 0.5, 1023, 20)
        )
    code, shown = said("compare", "presses", "--twin=taxel.yaml")
    lines = [line for line in shown.splitlines() if "saturated:" in line]
    assert code == 1 and len(lines) == 1 and "1 more" in lines[0], shown
    assert "index" in lines[0] and "thumb" not in lines[0]
    assert shown.count("saturated") == 2 and "--accept=saturated" in shown
    assert not any(line.startswith("ok") for line in shown.splitlines())


def test_missing_and_unknown_columns_are_named(tmp_path, said):
    (tmp_path / "taxel.yaml").write_text(SENSOR)
    folder = tmp_path / "presses"
    folder.mkdir()
    (folder / "press.csv").write_text("t,force_n\n0,0\n0.01,0\n")
    assert (
        "no column 'thumb.reading'; it has t, force_n"
        in said("compare", "presses", "--twin=taxel.yaml")[1]
    )
    (folder / "press.csv").write_text("t,force,thumb.reading\n0,0,1\n0.01,0,1\n")
    assert (
        "column 'force' is not a column of this sensor (did you mean 'force_n'"
        in said("compare", "presses", "--twin=taxel.yaml")[1]
    )
    (folder / "press.csv").write_text("t,force_n,thumb.reading\n0,0,1\n0.01,,1\n")
    assert (
        "press.csv:3: column 'force_n': is empty"
        in said("compare", "presses", "--twin=taxel.yaml")[1]
    )
    (folder / "press.csv").write_text(
        "t,force_n,thumb.reading\n0,0,1\n0.01,0,1\n0.005,0,1\n"
    )
    assert (
        "time does not increase at row 3"
        in said("compare", "presses", "--twin=taxel.yaml")[1]
    )


def test_a_columns_file_gives_other_names_and_units(tmp_path, said):
    table(tmp_path / "ours")
    (tmp_path / "taxel.yaml").write_text(SENSOR)
    other = tmp_path / "theirs"
    other.mkdir()
    rows = (tmp_path / "ours" / "press.csv").read_text().splitlines()[1:]
    scaled = [[float(x) for x in row.split(",")] for row in rows]
    text = [
        "stamp;Fz;adc3",
        *(f"{1e3 * t:.6g};{f / 9.80665e-3:.7g};{y:g}" for t, f, y in scaled),
    ]
    (other / "press.csv").write_text("\n".join(text) + "\n")
    columns = (
        "time: {column: stamp, unit: ms}\nseparator: semicolon\nload: {column: Fz, unit: gf}\norigin: a test\n"
        "cells:\n  thumb: {reading: {column: adc3, unit: count}}\n"
    )
    (tmp_path / "columns.yaml").write_text(columns)
    ours, theirs = (
        said("compare", folder, "--twin=taxel.yaml", *more)
        for folder, more in (("ours", []), ("theirs", ["--columns=columns.yaml"]))
    )
    assert ours[0] == theirs[0] == 0
    assert "data: domain not stated: a test" in theirs[1]
    one, other = (
        next(
            line.split(") ")[1].split()[0]
            for line in shown.splitlines()
            if "touch" in line
        )
        for _, shown in (ours, theirs)
    )
    assert float(other) == pytest.approx(float(one), rel=0.01)  # RMSE in counts
    for old, new, words in (
        (
            "unit: gf",
            "unit: kPa",
            "columns.yaml:3: load → unit: 'kPa' is not of the same kind as the cells file's unit N",
        ),
        (
            "unit: count",
            "unit: mV",
            "columns.yaml:6: cells → thumb → reading → unit: 'mV' is not of the same kind",
        ),
        (
            "thumb:",
            "finger:",
            "columns.yaml:6: cells → finger: the cells file has no cell 'finger'",
        ),
    ):
        (tmp_path / "columns.yaml").write_text(columns.replace(old, new))
        assert (
            words
            in said("compare", "theirs", "--twin=taxel.yaml", "--columns=columns.yaml")[
                1
            ]
        )

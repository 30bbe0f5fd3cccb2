"""CSV and parquet: units are converted as written, never guessed; errors name file, line and column."""

import dataclasses
import math
import re
import subprocess
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from taccorl.alignment.checks.telemetry import check_measurement
from taccorl.alignment.measurements.folder import read_measurements
from taccorl.alignment.measurements.tables import load_table_spec, read_table
from taccorl.data.origin import Origin
from taccorl.errors import RecordingError, SpecError, TaccorlError
from taccorl.robots import ROBOT

COLUMNS = """\
time: {column: stamp, unit: ms}
signals:
  left_joint5:
    q: {column: pos, unit: deg}
    q_target: {column: cmd, unit: deg}
    qd: {column: speed, unit: rpm}
    tau: {column: torque, unit: Nmm}
  left_gripper:
    q: {column: open, unit: mm}
    q_target: {column: open_cmd, unit: mm}
"""
TABLE = "stamp,pos,cmd,speed,torque,open,open_cmd,note\n" + "".join(
    f"{1000 + 5 * k},{10 + k},{20 + k},{30},{400 + k},{k},{k + 1},\n" for k in range(4)
)


def written(
    folder: Path, table: str = TABLE, columns: str = COLUMNS
) -> tuple[Path, Path]:
    (folder / "run.csv").write_text(table)
    (folder / "columns.yaml").write_text(columns)
    return folder / "run.csv", folder / "columns.yaml"


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_every_unit_is_converted_by_its_own_factor(tmp_path, kind: str):
    path, columns = written(tmp_path)
    if kind == "parquet":
        numbers = np.loadtxt(path, delimiter=",", skiprows=1, usecols=range(7))
        path = tmp_path / "run.parquet"
        pq.write_table(
            pa.table(dict(zip(TABLE.split(",")[:7], numbers.T, strict=True))), path
        )
    m = read_table(path, load_table_spec(columns))
    assert (m.signals, m.units) == (("left_joint5", "left_gripper"), ("rad", "m"))
    np.testing.assert_allclose(m.time_s, [0, 0.005, 0.010, 0.015], atol=1e-12)
    assert m.start_ns == 1_000_000_000
    np.testing.assert_allclose(m.measured[:, 0], np.radians([10, 11, 12, 13]))
    np.testing.assert_allclose(m.target[:, 0], np.radians([20, 21, 22, 23]))
    np.testing.assert_allclose(m.velocity[:, 0], 30 * 2 * math.pi / 60)
    np.testing.assert_allclose(m.effort[:, 0], [0.4, 0.401, 0.402, 0.403])
    np.testing.assert_allclose(m.measured[:, 1], [0, 0.001, 0.002, 0.003])
    assert np.isnan(m.effort[:, 1]).all()


@pytest.mark.parametrize(
    ("late", "rows", "targets"),
    [(0, 4, [20, 21, 22, 23]), (1, 3, [21, 22, 23]), (-1, 3, [20, 21, 22])],
)
def test_targets_that_the_file_shows_rows_late_are_put_in_their_place(
    tmp_path, late, rows, targets
):
    # late = 1: row k holds the target in force from row k − 1 on, so row 0's stands in row 1. −1: row 1's stands in row 0.
    path, columns = written(tmp_path, columns=COLUMNS + f"target_rows_late: {late}\n")
    m = read_table(path, load_table_spec(columns))
    assert m.num_rows == rows
    np.testing.assert_allclose(np.degrees(m.target[:, 0]), targets)
    np.testing.assert_allclose(
        np.degrees(m.measured[:, 0]),
        [10, 11, 12] if late == 1 else [10, 11, 12, 13][-rows:],
    )
    assert m.time_s[0] == 0


def test_semicolons_and_blank_lines(tmp_path):
    path, columns = written(
        tmp_path, TABLE.replace(",", ";") + "\n", COLUMNS + "separator: semicolon\n"
    )
    assert read_table(path, load_table_spec(columns)).num_rows == 4
    with pytest.raises(
        RecordingError, match="by semicolon; write `separator: semicolon`"
    ):
        read_table(path)


def test_a_column_s_zero_is_subtracted_before_its_factor(tmp_path):
    """512 counts are 0, 300 / 1024 ° a count: 522 counts are 2.93°. A pulse of 1500 µs is 0, 0.09° a µs."""
    q = "{column: adc, unit: deg, factor: 0.29296875, zero: 512}"
    signal = (
        f"a: {{q: {q}, q_target: {{column: us, unit: deg, factor: 0.09, zero: 1500}}}}"
    )
    table = "t,adc,us\n0.00,512,1500\n0.02,522,1600\n"
    path, columns = written(
        tmp_path, table, f"time: {{column: t, unit: s}}\nsignals: {{{signal}}}\n"
    )
    m = read_table(path, load_table_spec(columns))
    np.testing.assert_allclose(np.degrees(m.measured[:, 0]), [0.0, 2.9296875])
    np.testing.assert_allclose(np.degrees(m.target[:, 0]), [0.0, 9.0])


def test_several_spaces_part_columns_as_one(tmp_path):
    """As logs of robot drivers have them, and tables aligned by blanks."""
    table = "t  a.q   a.q_target \n0.00  1.5    2\n0.01  -1.5  2  \n0.02 1.0   2.5\n"
    signal = (
        "a: {q: {column: a.q, unit: rad}, q_target: {column: a.q_target, unit: rad}}"
    )
    spec = f"separator: space\ntime: {{column: t, unit: s}}\nsignals: {{{signal}}}\n"
    path, columns = written(tmp_path, table, spec)
    m = read_table(path, load_table_spec(columns))
    assert m.measured[:, 0].tolist() == [1.5, -1.5, 1.0] and m.target[
        :, 0
    ].tolist() == [2.0, 2.0, 2.5]
    with pytest.raises(RecordingError, match="by space; write `separator: space`"):
        read_table(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            ("1005,11,21", "1005,,21"),
            r"run.csv:3: column 'pos': is empty; leave the row out",
        ),
        (("1005,11,21", "1005,abc,21"), r"run.csv:3: column 'pos': 'abc' is no number"),
        (
            ("1005,11,21", '1005,"1,1",21'),
            r"run.csv:3: column 'pos': '1,1' is no number.*decimal: comma",
        ),
        (
            ("1005,11,21", "1005,nan,21"),
            r"run.csv:3: column 'pos': nan is not finite.*0.25 s",
        ),
        (("1005,11,21", "1005,11,99,21"), r"run.csv:3: 9 cells,.*header.*8"),
        (("stamp,pos", "stamp,poss"), r"run.csv: no column 'pos'; did you mean 'poss'"),
        (
            ("speed,torque", "pos,torque"),
            r"run.csv: column 'pos'.*twice|no column 'speed'",
        ),
    ],
)
def test_wrong_cells_are_named_by_line_and_column(tmp_path, change, message):
    path, columns = written(tmp_path, TABLE.replace(*change, 1))
    with pytest.raises(RecordingError, match=message):
        read_table(path, load_table_spec(columns))


@pytest.mark.parametrize("cell", ["", "nan"])
def test_a_column_without_any_number_is_to_be_left_out_and_no_row(
    tmp_path: Path, cell: str
) -> None:
    path, rows = (
        tmp_path / "run.csv",
        [f"{0.01 * k:.2f},0.1,0.2,{cell}" for k in range(5)],
    )
    path.write_text(
        "\n".join(["t,left_joint5.q,left_joint5.q_target,left_joint5.tau", *rows])
    )
    said = "column 'left_joint5.tau': no row holds a number"
    with pytest.raises(RecordingError, match=f"run.csv: {said}: leave the column out"):
        read_table(path)
    values = {
        "t": np.arange(5) / 100,
        "left_joint5.q": np.ones(5),
        "left_joint5.q_target": np.ones(5),
    }
    pq.write_table(
        pa.table(values | {"left_joint5.tau": np.full(5, np.nan)}),
        tmp_path / "run.parquet",
    )
    with pytest.raises(RecordingError, match=f"run.parquet: {said}"):
        read_table(tmp_path / "run.parquet")
    (tmp_path / "two.csv").write_text(path.read_text().replace(",0.2,", f",{cell},"))
    with pytest.raises(RecordingError) as every:
        read_measurements(tmp_path)
    assert (
        "run.csv, run.parquet: column 'left_joint5.tau'; two.csv: column 'left_joint5."
        in str(every.value)
    )
    assert str(every.value).count("'left_joint5.q_target'") == 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            ("unit: deg", "unit: degree"),
            r"columns.yaml:4: signals → left_joint5 → q → unit: 'degree'.*unit.*q; did you mean 'deg'",
        ),
        (
            ("unit: rpm", "unit: mm/s"),
            r"columns.yaml:3: signals → left_joint5: q.*deg.*qd.*mm/s:.*slide\?",
        ),
        (
            ("unit: Nmm", "unit: mA"),
            r"columns.yaml:7:.*'mA'.*unit.*tau.*torque constant",
        ),
        (
            ("unit: ms", "unit: msec"),
            r"columns.yaml:1: time → unit: 'msec'.*unit.*time",
        ),
        (("column: speed", "column: pos"), r"column 'pos' is used twice"),
        (("left_gripper", "right_joint1"), r"right_joint1.*rad"),
        (
            ("    q_target: {column: open_cmd, unit: mm}\n", ""),
            r"key 'q_target' is missing",
        ),
        (("signals:", "signal:"), r"unknown key 'signal'; did you mean 'signals'"),
        (("time:", "separator: colon\ntime:"), r"columns.yaml:1: separator: 'colon'"),
        (
            ("time:", "encoding: latin-11\ntime:"),
            r"columns.yaml:1: encoding: 'latin-11'.*latin-1",
        ),
        (
            ("time:", "encoding: hex\ntime:"),
            r"columns.yaml:1: encoding: 'hex'",
        ),  # Python's, but none of text
    ],
)
def test_wrong_columns_files_are_named_by_line(tmp_path, change, message):
    _, columns = written(tmp_path, columns=COLUMNS.replace(*change, 1))
    with pytest.raises(SpecError, match=message):
        load_table_spec(columns)


@pytest.mark.parametrize(
    ("header", "message"),
    [
        (
            "t,left_joint5.q",
            "column 'left_joint5.q_target' is missing; left_joint5 has q",
        ),
        (
            "t,left_joint7.q,left_joint7.q_target",
            "has no 'left_joint7' .did you mean 'left_joint",
        ),
        ("t", "signal"),
    ],
)
def test_a_table_in_our_own_words_must_have_all_of_them(tmp_path, header, message):
    (tmp_path / "x.csv").write_text(
        header + "\n" + ",".join("0" for _ in header.split(",")) + "\n"
    )
    with pytest.raises(RecordingError, match=message):
        read_table(tmp_path / "x.csv")


TIME, POS = "time,left_joint5.q,left_joint5.q_target", "t,left_joint5.pos"


@pytest.mark.parametrize(
    ("header", "message"),
    [(TIME, "no column 't'"), (POS, f"column 2 '{POS[2:]}' is not NAME.q")],
)
def test_other_names_get_a_draft_of_a_columns_file(
    tmp_path: Path, header: str, message: str
):
    with pytest.raises(RecordingError, match=message) as error:
        read_table(written(tmp_path, header + "\n0,0,0\n")[0])
    draft = str(error.value).partition("--columns=columns.yaml: ")[2]
    *_, spec = written(
        tmp_path,
        columns=draft.replace("TODO", "a", 1)
        .replace("TODO", "b", 1)
        .replace("TODO", "c"),
    )
    target = load_table_spec(spec).signals["left_joint1"].q_target
    assert target is not None and (target.column, target.unit) == ("c", "rad")


def test_a_signal_of_another_machine_needs_no_robot_name(tmp_path):
    drive = "{q: {column: a, unit: m}, q_target: {column: b, unit: m}}"
    columns = f"time: {{column: t, unit: s}}\nsignals: {{drive: {drive}}}\n"
    path, spec = written(tmp_path, "t,a,b\n0,1,2\n0.001,1,2\n", columns)
    m = read_table(path, load_table_spec(spec))
    assert (m.signals, m.units) == (("drive",), ("m",))
    with pytest.raises(Exception, match=r"the PiPER has no signal 'drive'.*--twin"):
        m.on_robot(np.zeros(14))


def test_empty_and_missing_files(tmp_path):
    (tmp_path / "empty.csv").write_text("")
    (tmp_path / "broken.parquet").write_bytes(b"PAR1 but no more")
    (tmp_path / "short.csv").write_text("t,left_joint5.q,left_joint5.q_target\n0,0,0\n")
    (tmp_path / "cut.csv").write_text(
        "t,left_joint5.q,left_joint5.q_target\n0,0,0\n0.01,0,-"
    )
    (tmp_path / "latin.csv").write_bytes("t,F [µN]\n0,1\n".encode("latin-1"))
    for name, message in (
        ("empty.csv", "is empty"),
        ("broken.parquet", "cannot be read as parquet"),
        ("short.csv", "1 rows"),
        (
            "cut.csv",
            "cut.csv:3: the last row ends at column 'left_joint5.q_target'; cut off .* copy the file again",
        ),
        ("latin.csv", "latin.csv:1: .*utf-8.*0xb5.*encoding: latin-1"),
    ):
        with pytest.raises(RecordingError, match=message):
            read_table(tmp_path / name)


GERMAN = "# domain: surrogate\n" + TABLE.replace(",", ";").replace("stamp", "Zeit [µs]")
"""The table as a German Excel writes it: semicolons, decimal commas (5 ms are 5000,0 µs) and letters that are not ASCII."""
for _k in range(4):
    GERMAN = GERMAN.replace(f"\n{1000 + 5 * _k};", f"\n{1000000 + 5000 * _k},0;")
GERMAN_COLUMNS = "separator: semicolon\ndecimal: comma\n" + COLUMNS.replace(
    "{column: stamp, unit: ms}", '{column: "Zeit [µs]", unit: us}'
)


@pytest.mark.parametrize(
    ("written_in", "stated"),
    [
        ("utf-8", ""),
        ("utf-8-sig", ""),
        ("utf-16", ""),  # with a byte order mark
        ("utf-16-le", "utf-16-le"),  # without
        ("latin-1", "latin-1"),
        (
            "utf-8-sig",
            "latin-1",
        ),  # the mark is certain, the columns file may be for other files of the folder
    ],
)
def test_encodings_and_decimal_commas_give_the_same_numbers(
    tmp_path: Path, written_in: str, stated: str
) -> None:
    path, columns = written(tmp_path)
    plain = read_table(path, load_table_spec(columns))
    other = tmp_path / "german.csv"
    other.write_bytes(GERMAN.encode(written_in))
    (tmp_path / "german.yaml").write_text(
        GERMAN_COLUMNS + (f"encoding: {stated}\n" if stated else "")
    )
    m = read_table(other, load_table_spec(tmp_path / "german.yaml"))
    np.testing.assert_array_equal(m.measured, plain.measured)
    np.testing.assert_allclose(m.time_s, plain.time_s, atol=1e-9)
    assert m.origin.domain == "surrogate"


@pytest.mark.parametrize(
    ("content", "keys", "words"),
    [
        (GERMAN.encode("latin-1"), "", ["german.csv:2:", "0xb5", "encoding: latin-1"]),
        (GERMAN.encode("utf-16-le"), "", ["german.csv:2:", "0xb5", "utf-16-le"]),
        (TABLE.encode("utf-16-le"), "plain", ["german.csv:1:", "encoding: utf-16-le"]),
        (GERMAN.encode(), "encoding: utf-16\n", ["german.csv:", "utf-16", "state"]),
        (
            GERMAN.encode().replace(b"1005000,0", b"1.005.000,0"),
            "",
            ["german.csv:4:", "'1.005.000,0'", "decimal"],
        ),
        (
            TABLE.replace("1005,", "1005,5,").encode(),
            "plain",
            ["german.csv:3:", "9 cells", "decimal: comma"],
        ),
    ],
)
def test_other_text_than_stated_is_named_with_the_way_out(
    tmp_path: Path, content: bytes, keys: str, words: list[str]
):
    (tmp_path / "german.csv").write_bytes(content)
    (tmp_path / "german.yaml").write_text(
        COLUMNS if keys == "plain" else GERMAN_COLUMNS + keys
    )
    with pytest.raises(RecordingError) as error:
        read_table(tmp_path / "german.csv", load_table_spec(tmp_path / "german.yaml"))
    assert all(word in str(error.value) for word in words), error.value


def test_supply_and_enabled_of_an_axis_are_read_and_a_robot_refuses_them(
    tmp_path: Path,
):
    """Ticks of 2π / 4096 rad, tenths of a volt, and a motor that is off in the last row."""
    table = "stamp,pos,goal,volts,torque\n0,2048,2048,74,1\n10,2148,2248,73,1\n20,2248,2248,72,0\n"
    spec = (
        "time: {column: stamp, unit: ms}\nsignals:\n  servo:\n    q: {column: pos, unit: rad, factor: 0.00153398}\n"
        "    q_target: {column: goal, unit: rad, factor: 0.00153398}\n    supply: {column: volts, unit: V, factor: 0.1}\n"
        '    enabled: {column: torque, unit: "1"}\n'
    )
    path, columns = written(tmp_path, table, spec)
    m = read_table(path, load_table_spec(columns))
    np.testing.assert_allclose(m.supply_v[:, 0], [7.4, 7.3, 7.2])
    np.testing.assert_array_equal(m.enabled[:, 0], [1, 1, 0])
    with pytest.raises(
        RecordingError, match=r"run\.csv: row 2 .*servo\.enabled is 0\.5; write 0"
    ):
        read_table(
            written(tmp_path, table.replace("73,1", "73,0.5"), spec)[0],
            load_table_spec(columns),
        )
    less = "stamp,pos,goal,volts\n0,2048,2048,74\n10,2148,2248,73\n20,2248,2248,72\n"
    with pytest.raises(RecordingError, match="no column 'torque'"):
        read_table(written(tmp_path, less, spec)[0], load_table_spec(columns))
    written(tmp_path, less, spec.replace('unit: "1"', 'unit: "1", if_missing: 1'))
    np.testing.assert_array_equal(
        read_table(path, load_table_spec(columns)).enabled, np.ones((3, 1))
    )
    for change, message in (
        ({}, "left_joint5 has a supply voltage"),
        ({"supply_v": np.empty(0)}, r"left_joint5 has a motor that is off at 0\.020 s"),
    ):
        robots = dataclasses.replace(m, signals=("left_joint5",), **change)
        with pytest.raises(TaccorlError, match=message):
            robots.on_robot(np.zeros(len(ROBOT.action_names)))


def test_a_table_of_position_and_effort_alone_has_no_target(tmp_path):
    table, columns = written(
        tmp_path,
        columns=COLUMNS.replace("    q_target: {column: cmd, unit: deg}\n", ""),
    )
    m = read_table(table, load_table_spec(columns))
    assert m.target_kinds == ("effort", "position")
    assert m.target[:, 0] == pytest.approx(m.measured[:, 0])
    assert m.effort[:, 0] == pytest.approx([0.4, 0.401, 0.402, 0.403])  # 400 … 403 N·mm


def test_a_csv_file_that_states_its_origin_keeps_it_without_its_columns_file(
    tmp_path: Path,
) -> None:
    path, columns = written(
        tmp_path, "# domain: surrogate\n# origin: simulated force cells\n" + TABLE
    )
    (tmp_path / "copied").mkdir()
    copied = tmp_path / "copied" / "run.csv"
    copied.write_bytes(path.read_bytes())
    spec = load_table_spec(columns)
    assert read_table(copied, spec).origin == Origin(
        "surrogate", "simulated force cells"
    )
    np.testing.assert_array_equal(
        read_table(copied, spec).measured,
        read_table(written(tmp_path)[0], spec).measured,
    )
    columns.write_text(COLUMNS + "domain: real\n")
    with pytest.raises(
        RecordingError,
        match=r"copied/run.csv: the columns file states domain 'real'.*surrogate",
    ):
        read_table(copied, load_table_spec(columns))
    copied.write_text("# domain: simulated\n" + TABLE.replace("12", "x", 1))
    with pytest.raises(
        RecordingError, match=r"run.csv:5: column"
    ):  # lines are counted from the first of the file
        read_table(copied, spec)
    copied.write_text("# domain: simulated\n" + TABLE)
    with pytest.raises(RecordingError, match=r"run.csv: unknown domain 'simulated'"):
        read_table(copied, spec)


def test_a_columns_file_may_state_only_what_differs_from_taccorls_own_names(
    tmp_path: Path,
) -> None:
    names = "t,left_joint5.q,left_joint5.q_target,left_joint5.tau,left_joint6.q,left_joint6.q_target\n"
    table = names + "".join(f"{k / 200},{k},{-k},{2 * k},{k},{k}\n" for k in range(8))
    file = "time: {column: t, unit: s}\nchanges: {left_joint5.q: {factor: -1}, left_joint5.tau: {unit: mNm, zero: 2}}\n"
    path, columns = written(tmp_path, table, file)
    found, k = read_table(path, load_table_spec(columns)), np.arange(8.0)
    values = np.column_stack([found.measured, found.target, found.effort[:, 0]])
    np.testing.assert_allclose(
        values, np.column_stack([-k, k, -k, k, 1e-3 * (2 * k - 2)])
    )
    columns.write_text("target_rows_late: 1\n")
    np.testing.assert_allclose(
        read_table(path, load_table_spec(columns)).target[:, 0], -k[1:]
    )
    columns.write_text(
        "changes: {left_joint5.q: {column: left_joint6.q}, left_joint6.q: {column: left_joint5.q}}\n"
    )
    np.testing.assert_allclose(
        read_table(path, load_table_spec(columns)).measured,
        found.measured[:, ::-1] * [1, -1],
    )
    wrong_ones = {
        "5.q: {unit: Nm}": "kind of rad",
        "5.q: {factor: 0}": "other than 0",
        "4.q: {zero: 1}": "no column",
    }
    wrong_ones |= {"5.q: {column: left_joint6.q}": "used twice"}
    for wrong, message in wrong_ones.items():
        columns.write_text(
            f"time: {{column: t, unit: s}}\nchanges: {{left_joint{wrong}}}\n"
        )
        with pytest.raises(RecordingError, match=message):
            read_table(path, load_table_spec(columns))
    columns.write_text(COLUMNS + "changes: {left_joint5.q: {factor: -1}}\n")
    with pytest.raises(SpecError, match="stands beside changes"):
        load_table_spec(columns)


def test_the_command_that_keeps_the_rows_before_a_frozen_channel_leaves_a_sound_table(
    tmp_path: Path,
) -> None:
    t, rng = np.arange(1600) / 200, np.random.default_rng(0)
    target = 0.4 * np.sin(2 * np.pi * 0.5 * np.clip(t - 0.5, 0.0, None))
    q = np.interp(t - 0.08, t, target) + 1e-4 * rng.standard_normal(1600)
    q[1100:1200] = q[1100]
    rows = "".join(
        f"{a:.6g},{b:.9g},{c:.9g}\n" for a, b, c in zip(t, q, target, strict=True)
    )
    path, _ = written(
        tmp_path,
        "# domain: surrogate\n# origin: a test\nt,left_joint5.q,left_joint5.q_target\n"
        + rows,
    )
    (frozen,) = (
        f for f in check_measurement(read_table(path)) if f.check == "frozen_channel"
    )
    (command,) = re.findall("`(head [^`]*)`", frozen.text)
    subprocess.run(command, shell=True, check=True, cwd=tmp_path)
    assert not any(
        f.severity == "error"
        for f in check_measurement(read_table(tmp_path / "run_cut.csv"))
    )

"""Columns of an array by a pattern: each cell gets its own column, and a table that does not fit is named."""

from pathlib import Path

import pytest

from taccorl.alignment.machines.cell_tables import (
    CellMeasurement,
    load_cell_columns,
    read_cell_table,
)
from taccorl.alignment.machines.cells_file import CellsConfig, Load, Reading
from taccorl.errors import RecordingError, SpecError

HEAD = "time: {column: stamp, unit: ms}\nload: {column: Fz, unit: gf, zero: 50, factor: 2}\n"
GRID = (
    HEAD + 'array: {reading: {column: "taxel_{row}_{column}", unit: count}, first: 1}\n'
)
INDEX = (
    HEAD
    + 'array: {reading: {column: "t{index}", unit: count}, first: 0, order: row by row}\n'
)


def grid(rows: int = 2, columns: int = 3, **other: object) -> CellsConfig:
    shape = other or {"rows": rows, "columns": columns}
    return CellsConfig(
        **shape, load=Load(unit="N", rated=10), reading=Reading(unit="count")
    )  # pyright: ignore[reportArgumentType]


def read(
    folder: Path, columns: str, header: list[str], config: CellsConfig
) -> CellMeasurement:
    """A table of four rows; the cell in column k of the table reads 100 k in the first row, and one more in each row."""
    (folder / "columns.yaml").write_text(columns)
    rows = [
        [f"{10 * t}", "100", *(f"{100 * k + t}" for k in range(len(header)))]
        for t in range(4)
    ]
    text = "\n".join(",".join(row) for row in [["stamp", "Fz", *header], *rows])
    (folder / "press.csv").write_text(text + "\n")
    return read_cell_table(
        folder / "press.csv", config, load_cell_columns(folder / "columns.yaml", config)
    )


@pytest.mark.parametrize(
    ("columns", "header", "config", "first_row"),
    [
        # Columns of the table in any order, as an 8 × 10 array writes them in one line
        (
            GRID,
            [
                "taxel_2_1",
                "taxel_1_1",
                "taxel_1_2",
                "taxel_1_3",
                "taxel_2_2",
                "taxel_2_3",
            ],
            {},
            [1, 2, 3, 0, 4, 5],
        ),
        (
            GRID,
            [f"taxel_{i:02}_{j:02}" for i in (1, 2) for j in (1, 2, 3)],
            {},
            [0, 1, 2, 3, 4, 5],
        ),
        (INDEX, ["t0", "t1", "t2", "t3", "t4", "t5", "temp5"], {}, [0, 1, 2, 3, 4, 5]),
        # t0 t2 t4
        # t1 t3 t5
        (
            INDEX.replace("row by", "column by").replace("by row", "by column"),
            [f"t{k}" for k in range(6)],
            {},
            [0, 2, 4, 1, 3, 5],
        ),
        (
            INDEX.replace(", order: row by row", ""),
            ["t1", "t0"],
            {"cells": ["thumb", "index"]},
            [1, 0],
        ),
    ],
)
def test_a_pattern_finds_the_column_of_every_cell(
    tmp_path: Path, columns: str, header: list[str], config: dict, first_row: list[int]
) -> None:
    m = read(tmp_path, columns, header, grid(**config))
    assert m.measured[0].tolist() == [100 * k for k in first_row]
    assert m.measured[3].tolist() == [100 * k + 3 for k in first_row]
    assert m.target[0, 0] == pytest.approx(
        (100 - 50) * 2 * 9.80665e-3
    )  # zero and factor, gf → N


def test_an_array_of_loads_is_read_by_its_own_pattern(tmp_path: Path) -> None:
    config = grid(1, 2)
    config.load.shared = False
    columns = (
        "time: {column: stamp, unit: ms}\narray:\n  reading: {column: 't{index}', unit: count}\n"
        "  load: {column: 'F{index}', unit: N}\n  first: 0\n  order: row by row\n"
    )
    m = read(tmp_path, columns, ["F1", "t0", "t1", "F0"], config)
    assert m.measured[0].tolist() == [100, 200] and m.target[0].tolist() == [300, 0]


def test_the_columns_file_of_own_loads_in_the_documentation_reads_the_load_of_each_cell(
    tmp_path: Path,
) -> None:
    text = (Path(__file__).parents[3] / "docs" / "your_robot.md").read_text(
        encoding="utf-8"
    )
    (block,) = (
        part.split("```")[0]
        for part in text.split("```yaml\n")[1:]
        if "Fz3" in part.split("```")[0]
    )
    load = Load(unit="N", rated=3, shared=False)
    config = CellsConfig(
        cells=["thumb", "index"], load=load, reading=Reading(unit="count")
    )
    (tmp_path / "columns.yaml").write_text(block)
    (tmp_path / "press.csv").write_text(
        "stamp,adc4,adc3,Fz3,Fz4\n0,10,20,30,40\n10,11,21,31,41\n"
    )
    m = read_cell_table(
        tmp_path / "press.csv",
        config,
        load_cell_columns(tmp_path / "columns.yaml", config),
    )
    assert m.measured.tolist() == [[20, 10], [21, 11]]
    assert m.target[0].tolist() == pytest.approx(
        [30 * 9.80665e-3, 40 * 9.80665e-3]
    )  # gf → N


POSITION = "position: {x: {column: px, unit: cm}, y: {column: py, unit: um}}\n"


def test_the_position_of_a_probe_is_read_in_mm(tmp_path: Path) -> None:
    config = grid(cells=["thumb"], same_place_mm=0.5)
    columns = HEAD + POSITION + "cells: {thumb: {reading: {column: a, unit: count}}}\n"
    m = read(tmp_path, columns, ["px", "a", "py"], config)
    assert m.position_mm[1].tolist() == [
        pytest.approx(10 * 1),
        pytest.approx(1e-3 * 201),
    ]
    for text, sensor, words in (
        (
            columns.replace("unit: cm", "unit: deg"),
            config,
            ["position → x → unit", "'deg'"],
        ),
        (columns.replace(POSITION, ""), config, ["position", "same_place_mm"]),
        (columns, grid(cells=["thumb"]), ["position", "same_place_mm:"]),
    ):
        (tmp_path / "columns.yaml").write_text(text)
        with pytest.raises(SpecError, match=r"columns\.yaml:\d+: ") as error:
            load_cell_columns(tmp_path / "columns.yaml", sensor)
        assert all(word in str(error.value) for word in words), error.value


@pytest.mark.parametrize(
    ("columns", "header", "words"),
    [
        (INDEX, ["t0", "t1", "t3", "t4", "t5"], ["1 of 6", "t2"]),  # a gap
        (
            INDEX,
            ["t0", "t1", "t2", "t3", "t4", "t5", "t05"],
            ["'t5'", "'t05'"],
        ),  # two of one cell
        (INDEX, [f"t{k}" for k in range(7)], ["'t6'", "2 × 3"]),  # one of no cell
        (
            INDEX,
            [f"t{k}" for k in range(1, 7)],
            ["'t6'", "from 0", "first"],
        ),  # counted from 1
        (INDEX, ["s0", "s1"], ["'t{index}'", "s0, s1"]),  # none that fits
        (
            GRID,
            [f"taxel_{i}_{j}" for i in (1, 2, 3) for j in (1, 2)],
            ["'taxel_3_1'", "2 × 3"],
        ),  # 3 × 2
    ],
)
def test_a_table_that_does_not_fit_the_pattern_is_named(
    tmp_path: Path, columns: str, header: list[str], words: list[str]
) -> None:
    with pytest.raises(RecordingError, match=r"press\.csv: ") as error:
        read(tmp_path, columns, header, grid())
    assert all(word in str(error.value) for word in words), error.value


@pytest.mark.parametrize(
    ("columns", "config", "words"),
    [
        (
            INDEX.replace(", order: row by row", ""),
            {},
            ["array → order", "order: row by row"],
        ),  # nothing is guessed
        (INDEX.replace("first: 0, ", ""), {}, ["'first'"]),
        (
            GRID.replace("first: 1", "first: 1, order: row by row"),
            {},
            ["array → order"],
        ),
        (GRID, {"cells": ["thumb", "index"]}, ["array → reading → column", "{index}"]),
        (INDEX.replace("{index}", "3"), {}, ["array → reading → column", "'t3'"]),
        (INDEX.replace("{index}", "{k}"), {}, ["array → reading → column", "'t{k}'"]),
        (
            GRID.replace("_{column}", ""),
            {},
            ["array → reading → column", "'taxel_{row}'"],
        ),
        (
            INDEX + "cells: {r0c0: {reading: {column: a, unit: count}}}\n",
            {},
            ["cells", "array"],
        ),
        (HEAD, {}, ["cells", "array"]),
        (GRID.replace('"', ""), {}, ["columns.yaml:3", "quotes"]),
        (
            INDEX.replace("unit: count", "unit: mV"),
            {},
            ["array → reading → unit", "'mV'"],
        ),
        (INDEX.replace("factor: 2", "factor: 0"), {}, ["load → factor"]),
    ],
)
def test_a_pattern_that_leaves_something_open_is_refused(
    tmp_path: Path, columns: str, config: dict, words: list[str]
):
    (tmp_path / "columns.yaml").write_text(columns)
    with pytest.raises(SpecError, match=r"columns\.yaml:\d+: ") as error:
        load_cell_columns(tmp_path / "columns.yaml", grid(**config))
    assert all(word in str(error.value) for word in words), error.value

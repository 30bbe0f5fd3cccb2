"""The study of sensors of cells: what counts as exact, its table, and its section of the page."""

import dataclasses

from pipelines import diagnosis_page
from pipelines.studies.cells import CellsRow, run_cells, table

ROW = CellsRow(
    hidden="taxel_creep",
    seed=1,
    found=("taxel_creep",),
    named=True,
    status="at_floor",
    before=9.0,
    after=1.0,
    error=0.02,
    cpu_s=2.0,
)


def test_exact_is_the_hidden_effect_alone_and_of_a_clean_sensor_nothing():
    assert ROW.exact
    assert not dataclasses.replace(ROW, found=("taxel_creep", "touch_lag")).exact
    assert not dataclasses.replace(ROW, found=()).exact
    assert dataclasses.replace(ROW, hidden="", found=()).exact
    assert not dataclasses.replace(ROW, before=1.4).material


def test_the_table_has_a_line_an_effect_and_names_each_case_that_was_not_exact():
    wrong = dataclasses.replace(ROW, seed=2, found=("touch_lag",), error=float("nan"), status="something_else")
    lines = table([ROW, wrong, dataclasses.replace(ROW, seed=3, before=1.2, found=())])
    assert "| taxel_creep | 3 | 2 | 1 of 2 | 9.00 | 1.00 | 2.0% |" in lines
    assert "taxel_creep (seed 2): touch_lag, something_else" in lines[-1]
    assert "taxel_creep (seed 3): nothing, at_floor" in lines[-1]


def test_one_case_is_run():
    row = run_cells("", 3)
    assert row.exact and row.status == "nothing_missing"
    assert row.after < 1.3


def test_a_section_is_replaced_and_others_stay(tmp_path, monkeypatch):
    page = tmp_path / "page.md"
    page.write_text("# Own\n\n## Design\n\ntext\n")
    monkeypatch.setattr(diagnosis_page, "PAGE", page)
    diagnosis_page.replace_section("Axes", "one")
    diagnosis_page.replace_section("Cells", "two")
    diagnosis_page.replace_section("Axes", "three")
    own, marker, others = page.read_text().partition(diagnosis_page.OTHERS)
    assert own == "# Own\n\n## Design\n\ntext\n\n"
    assert marker
    assert others == "\n\n## Cells\n\ntwo\n\n## Axes\n\nthree\n"

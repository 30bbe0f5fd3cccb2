"""Benchmarks: arithmetic of a row, goals, the page, and what a partial run keeps."""

import dataclasses
import datetime
import importlib
import json
import math
import pkgutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import pipelines.benchmarks
from pipelines.benchmarks import rows
from pipelines.benchmarks import rows as module
from pipelines.benchmarks import run as runner
from pipelines.benchmarks.rows import BENCHMARKS, Row, benchmark, meets
from pipelines.benchmarks.run import machine, render, run
from taccorl.errors import TaccorlError
from taccorl.lineage.processes import cpu_s
from tests.fresh_python import fresh_python


@pytest.fixture
def only_mine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """No registered benchmarks but the test's own; files go to an empty folder."""
    registered: dict = {}
    monkeypatch.setattr(module, "BENCHMARKS", registered)
    monkeypatch.setattr(runner, "BENCHMARKS", registered)
    monkeypatch.setattr(runner, "ROOT", tmp_path)
    monkeypatch.setattr(runner, "JSON_PATH", tmp_path / "bench.json")
    monkeypatch.setattr(runner, "PAGE_PATH", tmp_path / "docs" / "benchmarks.md")
    monkeypatch.setattr(runner.pkgutil, "iter_modules", lambda path: iter(()))
    return tmp_path


def stored(folder: Path) -> dict[str, dict]:
    return {row["name"]: row for row in json.loads((folder / "bench.json").read_text())}


# ---- arithmetic ----


@pytest.mark.parametrize(
    ("value", "goal", "met"),
    [
        (4.0, "≥ 4", True),
        (3.999, "≥ 4", False),
        (1.5, "< 1.5", False),
        (1.499, "< 1.5", True),
        (5.0, "≤ 5", True),
        (5.1, "> 5", True),
        (3.0, "= 3", True),
        (999.0, "< 1,000", True),
        (0.0, "≥ 0 of 20", True),
        (1.0, "", None),
        (float("nan"), "≥ 4", False),
    ],
)
def test_goals_are_read_as_written(value: float, goal: str, met: bool | None) -> None:
    assert meets(value, goal) is met


@pytest.mark.parametrize("goal", ["4", "at least 4", "≥4", ">= 4", "≥ four", "≥"])
def test_a_goal_that_cannot_be_read_is_an_error_that_shows_one(goal: str) -> None:
    with pytest.raises(TaccorlError, match="≥ 4"):
        meets(1.0, goal)


def test_cpu_seconds_count_this_process_and_its_ended_children() -> None:
    before, with_children = cpu_s(), cpu_s(children=True)
    sum(range(3_000_000))
    subprocess.run([sys.executable, "-c", "sum(range(10_000_000))"], check=True)
    own = cpu_s() - before
    assert 0 < own < cpu_s(children=True) - with_children


def test_the_machine_is_described_without_its_name() -> None:
    import platform

    assert "cores" in machine() and platform.node() not in machine()


def test_a_cost_is_told_in_steps_of_the_reference_loop(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(module, "reference_step_s", lambda: 1e-5)
    row = module.against_reference("touch", [90e-6, 80e-6, 40e-6], "≤ 9")
    assert (row.value, row.unit, row.n) == (
        pytest.approx(8.0),
        "reference steps",
        3,
    )  # median 80 µs of 10 µs each
    assert row.spread == pytest.approx(2.5)  # (9 − 4) / 2
    assert (row.rival, row.rival_value) == (
        "one reference step, µs CPU",
        pytest.approx(10.0),
    )


def test_no_goal_is_one_of_cpu_seconds_but_on_a_named_gpu() -> None:
    """The same code took 49 and 241 µs on two machines."""
    absolute = (
        "CPU-s",
        "s",
        "ms",
        "µs",
        "µs/env",
        "ms CPU",
        "s (wall)",
        "env steps/CPU-s",
    )
    rows = json.loads(runner.JSON_PATH.read_text())
    judged = [
        row["name"]
        for row in rows
        if row["unit"] in absolute and row["met"] is not None
    ]
    assert all("NVIDIA" in name for name in judged), judged
    assert render(rows) == runner.PAGE_PATH.read_text(), (
        "docs/benchmarks.md is what make bench writes"
    )


# ---- a run ----


def test_a_row_is_completed_stored_and_rendered(
    only_mine: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    @benchmark("reading")
    def _() -> Iterator[Row]:
        yield Row(
            name="rows",
            value=4.5,
            unit="×",
            goal="≥ 4",
            rival="default",
            rival_value=2.0,
            n=3,
            spread=0.25,
        )
        yield Row(name="time", value=1.6, unit="CPU-s", goal="< 1.5", n=5, spread=0.1)
        yield Row.of([12345.678], name="size", unit="MB")
        yield Row.of([1.0], name="a: yield", unit="%", goal="≥ 2")
        yield Row.of([2.0, 4.0], name="b: yield", unit="%", goal="≥ 2")

    rows = run()
    assert [r.met for r in rows] == [True, False, None, False, True]
    assert list(stored(only_mine))[:3] == [
        "reading: rows",
        "reading: time",
        "reading: size",
    ]
    first = stored(only_mine)["reading: rows"]
    assert first["date"] == datetime.date.today().isoformat()
    assert first["command"] == "make bench ONLY=reading"
    assert first == dataclasses.asdict(rows[0])
    page = (only_mine / "docs/benchmarks.md").read_text()
    assert (
        f"| **reading** | A, {first['date']} | | |\n| rows |" in page
        and f"\nA {machine()}.\n" in page
    )
    assert "| rows | 4.5 ± 0.25 × | ≥ 4 | 3 |" in page
    assert "| time | **1.6 ± 0.1** CPU-s | < 1.5 | 5 |" in page
    assert "| yield | a **1**, b 3 ± 1 % | ≥ 2 | 1 … 2 |" in page
    assert "size" not in page, "without a goal: in bench.json only"
    shown = capsys.readouterr().out
    assert "NOT MET" in shown and "bench.json and docs/benchmarks.md written" in shown


def test_a_partial_run_keeps_the_rows_of_the_others_and_replaces_its_own(
    only_mine: Path,
) -> None:
    value = [1.0]

    @benchmark("b")
    def _() -> Iterator[Row]:
        name = "old name" if value[0] == 1.0 else "new name"
        yield Row(name=name, value=value[0], unit="s", goal="≤ 9", n=1, spread=0.0)

    @benchmark("a")
    def _() -> Iterator[Row]:
        yield Row(name="x: y", value=7.0, unit="s", n=1, spread=0.0)

    run()
    assert list(stored(only_mine)) == ["a: x: y", "b: old name"]
    a_before = stored(only_mine)["a: x: y"]
    value[0] = 2.0
    run("b")
    assert list(stored(only_mine)) == ["a: x: y", "b: new name"]
    assert stored(only_mine)["a: x: y"] == a_before
    page = (only_mine / "docs/benchmarks.md").read_text()
    assert "new name" in page and "old name" not in page


def test_rows_of_another_machine_stay_beside_ones_own(
    only_mine: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kind = ["2 cores"]
    monkeypatch.setattr(runner, "machine", lambda: kind[0])

    @benchmark("pictures")
    def _() -> Iterator[Row]:
        yield Row(name=f"drawn by {kind[0]}", value=1.0, unit="ms", n=1, spread=0.0)

    run()
    kind[0] = "a lent GPU"
    run()
    run()
    assert list(stored(only_mine)) == [
        "pictures: drawn by 2 cores",
        "pictures: drawn by a lent GPU",
    ]


def test_a_benchmark_that_fails_does_not_cost_the_figures_of_the_others(
    only_mine: Path,
) -> None:
    @benchmark("first")
    def _() -> Iterator[Row]:
        yield Row(name="x", value=1.0, unit="s", n=1, spread=0.0)

    @benchmark("second")
    def _() -> Iterator[Row]:
        raise RuntimeError("the rival crashed")
        yield

    with pytest.raises(RuntimeError, match="the rival crashed"):
        run()
    assert list(stored(only_mine)) == ["first: x"]


def test_cells_cannot_break_the_table() -> None:
    row = Row(
        name="a: b | c",
        value=1.0,
        unit="s|h",
        n=1,
        spread=0.0,
        met=True,
        machine="2 cores",
    )
    line = render([dataclasses.asdict(row)]).splitlines()[-1]
    assert line.replace("\\|", "").count("|") == 5  # four cells


def test_an_unknown_name_is_told_with_the_nearest(only_mine: Path) -> None:
    @benchmark("ingest")
    def _() -> Iterator[Row]:
        yield Row(name="x", value=1.0, unit="s", n=1, spread=0.0)

    with pytest.raises(
        TaccorlError, match="no benchmark 'ingst'; did you mean 'ingest'"
    ):
        run("ingst")
    assert not (only_mine / "bench.json").exists()


def test_a_bare_word_would_run_everything_and_is_refused() -> None:
    done = fresh_python("-m", "pipelines.benchmarks", "ingest")
    assert done.returncode == 2
    assert "--only=" in done.stderr


# ---- every benchmark of ``make bench`` runs to its end, at the smallest size that its module's constants allow ----

MODULES = [
    m.name
    for m in pkgutil.iter_modules(pipelines.benchmarks.__path__)
    if not m.name.startswith("__")
]
for _name in MODULES:
    importlib.import_module(f"pipelines.benchmarks.{_name}")
ON_A_GPU = ("full_size", "full_adapters", "full_post_training", "physics_on_gpu")
SUITE = """
def test_one(record_property):
    record_property("mcap: files", 2)
    record_property("mcap: wrong", 0)
"""
TINY: dict[str, dict[str, Any]] = {  # module → its constants
    "cameras": {"_OFFSETS": 1, "_OTHERS": 1, "_CAMERAS": ("front",)},
    "demonstrations": {
        "EXPERT_EPISODES": 1, "PENETRATION_EPISODES": 1, "MIMICGEN_ATTEMPTS": 2, "MIMICGEN_SOURCES": 1,
        "COST_ATTEMPTS": 2, "COST_SOURCES": 1, "tasks_with_expert": lambda: ("assembly_2",),
    },
    "diagnosis": {"HIDDEN": ("coulomb_friction",), "HIDDEN_IN_PADS": ("taxel_saturation",), "ARMS": (410,)},
    "gpu": {"WORLDS": (2,), "WORLDS_ON_CPU": (2,), "NUM_ENVS": 2, "REPEATS": 1, "ACTIONS": 2},
    "paper_search": {"SEEDS": 1},
    "policies": {"REPEATS": 1},
    "recordings": {"RECORDING_S": 4.0, "LONG_RECORDING_S": 5.0, "RIVAL_ROWS": 5, "REPEATS": 1},
    "rl": {"NUM_SIMS": 2, "REPEATS": 1, "_CHUNKS": (1,), "_CPUS": 2},
    "sim": {"NUM_SIMS": 2, "REPEATS": 1},
    "training": {"EPISODE_ROWS": 16, "BATCH": 4, "WORKERS": 1, "EPOCHS": 1, "CACHED_PX": 32, "CACHED_BATCH": 8},
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("name", BENCHMARKS)
def test_a_benchmark_yields_figures_at_tiny_size(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (suite := tmp_path / "test_suite.py").write_text(SUITE)
    words = {"CORRUPTION": (suite,), "DAMAGE": (suite,)}
    for of, constants in (TINY | {"recordings": TINY["recordings"] | words}).items():
        for constant, value in constants.items():
            monkeypatch.setattr(f"pipelines.benchmarks.{of}.{constant}", value)
    monkeypatch.setattr(rows, "REFERENCE_STEPS", 100)
    figures = list(BENCHMARKS[name]())
    assert figures or name in ON_A_GPU
    for row in figures:
        assert row.n >= 1 and math.isfinite(row.value) and math.isfinite(row.spread), (
            row
        )
        assert meets(row.value, row.goal) in ((True, False) if row.goal else (None,))

"""Every benchmark of ``make bench`` runs to its end, at the smallest size that its module's constants allow."""

import importlib
import math
import pkgutil
from pathlib import Path
from typing import Any

import pytest

import pipelines.benchmarks
from pipelines.benchmarks import rows
from pipelines.benchmarks.rows import BENCHMARKS, meets

MODULES = [m.name for m in pkgutil.iter_modules(pipelines.benchmarks.__path__) if not m.name.startswith("__")]
for _name in MODULES:
    importlib.import_module(f"pipelines.benchmarks.{_name}")
ON_A_GPU = ("full_size", "full_post_training", "physics_on_gpu")
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
    "policies": {"REPEATS": 1},
    "recordings": {"RECORDING_S": 4.0, "LONG_RECORDING_S": 5.0, "RIVAL_ROWS": 5, "REPEATS": 1},
    "rl": {"NUM_SIMS": 2, "REPEATS": 1, "_CHUNKS": (1,), "_CPUS": 2},
    "sim": {"NUM_SIMS": 2, "REPEATS": 1},
    "training": {"EPISODE_ROWS": 16, "BATCH": 4, "WORKERS": 1, "EPOCHS": 1, "CACHED_PX": 32, "CACHED_BATCH": 8},
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("name", BENCHMARKS)
def test_a_benchmark_yields_figures_at_tiny_size(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (suite := tmp_path / "test_suite.py").write_text(SUITE)
    words = {"CORRUPTION": (suite,), "DAMAGE": (suite,), "KILLS": (suite,)}
    for module, constants in (TINY | {"recordings": TINY["recordings"] | words}).items():
        for constant, value in constants.items():
            monkeypatch.setattr(f"pipelines.benchmarks.{module}.{constant}", value)
    monkeypatch.setattr(rows, "REFERENCE_STEPS", 100)
    figures = list(BENCHMARKS[name]())
    assert figures or name in ON_A_GPU
    for row in figures:
        assert row.n >= 1 and math.isfinite(row.value) and math.isfinite(row.spread), row
        assert meets(row.value, row.goal) in ((True, False) if row.goal else (None,))

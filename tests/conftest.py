"""Shared by all tests: one small stand-in recording, the dataset made from it by the real commands, and demonstrations."""

import os
from pathlib import Path

import pytest

os.environ.setdefault("HF_HUB_OFFLINE", "1")
os.environ.setdefault("SVT_LOG", "1")
# Tests run side by side (make test): one thread each, also in the processes that they start. Before NumPy is imported.
for _threads in ("OMP", "OPENBLAS", "MKL", "NUMBA"):
    os.environ.setdefault(f"{_threads}_NUM_THREADS", "1")

SPEC = "piper_flexitac_mcap"


@pytest.fixture(scope="session")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two 4 s stand-in recordings, three cameras at 240×320."""
    from taccorl.demos.stand_in import StandInConfig, write_mcap

    folder = tmp_path_factory.mktemp("recordings")
    for k in range(2):
        write_mcap(folder / f"stand_in_{k}.mcap", StandInConfig(duration_s=4.0, seed=k, camera_size=(240, 320)))
    return folder


@pytest.fixture(scope="session")
def dataset(recordings: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The dataset that ``taccorl ingest`` makes of ``recordings``."""
    from taccorl.cli.main import main

    folder = tmp_path_factory.mktemp("ingested")
    out = folder / "dataset"
    assert main(["ingest", str(recordings), f"--spec={SPEC}", f"--out={out}", f"--store={folder / 'store'}"]) == 0
    return out


@pytest.fixture(scope="session")
def collected(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset with two demonstrations of assembly_2 from the twin, without pictures: sources of MimicGen."""
    from taccorl.demos.collect import Plan, collect
    from taccorl.lineage.store import Store

    folder = tmp_path_factory.mktemp("mimicgen_sources")
    plan = Plan(task="assembly_2", episodes=2, images=False, seed=3)
    collect(plan, folder / "dataset", Store(folder / "store"), lambda _: None)
    return folder / "dataset"

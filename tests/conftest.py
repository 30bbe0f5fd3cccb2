"""Shared by all tests: one small stand-in recording, the dataset made from it by the real commands, and demonstrations."""

import logging
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from filelock import FileLock

os.environ.setdefault("HF_HUB_OFFLINE", "1")
os.environ.setdefault("SVT_LOG", "1")
# Tests run side by side (make test): one thread each, also in the processes that they start. Before NumPy is imported.
for _threads in ("OMP", "OPENBLAS", "MKL", "NUMBA"):
    os.environ.setdefault(f"{_threads}_NUM_THREADS", "1")

SPEC = "piper_flexitac_mcap"


def made_once(
    factory: pytest.TempPathFactory, name: str, make: Callable[[Path], object]
) -> Path:
    """A folder that ``make`` fills, one for all processes of a run. Tests read it and change copies only."""
    if "PYTEST_XDIST_WORKER" not in os.environ:
        folder = factory.mktemp(name)
        make(folder)
        return folder
    folder = factory.getbasetemp().parent / name
    with FileLock(folder.with_suffix(".lock")):
        if not folder.with_suffix(".made").exists():
            shutil.rmtree(
                folder, ignore_errors=True
            )  # of a process that failed half-way
            folder.mkdir()
            make(folder)
            folder.with_suffix(".made").touch()
    return folder


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Folders of few and long tests first, so that processes side by side end at about the same time."""
    items.sort(key=lambda item: "/training/" not in item.nodeid)


@pytest.fixture(autouse=True)
def without_lerobots_log_handlers() -> Iterator[None]:
    """LeRobot's commands add a logging handler that writes to ``sys.stderr``. pytest replaces and closes that stream after each
    test, so that a message of a later test would fail: such handlers are removed."""
    root = logging.getLogger()
    before, level = set(root.handlers), root.level
    yield
    for handler in set(root.handlers) - before:
        root.removeHandler(handler)
    root.setLevel(level)


@pytest.fixture(scope="session")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny tactile policy; tests only read it."""
    from tiny_checkpoint import write_checkpoint

    return write_checkpoint(tmp_path_factory.mktemp("checkpoint"))


@contextmanager
def figures_once() -> Iterator[None]:
    """Only the first figure that each plotting function makes is rendered; its picture stands in for later ones, because
    rendering is most of the time of a report. All figures are still constructed."""
    from taccorl.report import page

    drawn, draw_all = dict[Any, str](), page._uri

    def once(draw: Callable[[], Any]) -> str:
        made = draw()
        kind = made if isinstance(made, bytes) else draw.__qualname__
        if kind not in drawn:
            drawn[kind] = draw_all(lambda: made)
        return drawn[kind]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(page, "_uri", once)
        yield


@pytest.fixture(scope="session", autouse=True)
def pictures_once(request: pytest.FixtureRequest) -> Iterator[None]:
    """In ``make test`` ``figures_once``, and the first contact sheet of a card stands in for later ones: it is a fifth of the
    time of a small ``ingest``."""
    from taccorl.views import card

    if request.config.option.markexpr != "not slow":
        yield
        return
    draw, drawn = card.draw_sheet, list[Any]()
    with figures_once(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            card,
            "draw_sheet",
            lambda episode: (
                drawn[0] if drawn else drawn.append(draw(episode)) or drawn[0]
            ),
        )
        yield


@pytest.fixture(scope="session")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two 4 s stand-in recordings, three cameras at 240×320."""
    from tests.recordings.stand_in import StandInConfig, write_mcap

    def make(folder: Path) -> None:
        for k in range(2):
            write_mcap(
                folder / f"stand_in_{k}.mcap",
                StandInConfig(duration_s=4.0, seed=k, camera_size=(240, 320)),
            )

    return made_once(tmp_path_factory, "recordings", make)


@pytest.fixture(scope="session")
def dataset(recordings: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The dataset that ``taccorl ingest`` makes of ``recordings``."""
    from taccorl.cli.main import main

    def make(folder: Path) -> None:
        words = [
            f"--spec={SPEC}",
            f"--out={folder / 'dataset'}",
            f"--store={folder / 'store'}",
        ]
        assert main(["ingest", str(recordings), *words]) == 0

    return made_once(tmp_path_factory, "ingested", make) / "dataset"


@pytest.fixture(scope="session")
def collected(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset with two demonstrations of assembly_2 from the twin, without pictures: sources of MimicGen."""
    from taccorl.episodes.produce import produce
    from taccorl.episodes.sources.collect import CollectPlan
    from taccorl.lineage.store import Store

    def make(folder: Path) -> None:
        plan = CollectPlan(task="assembly_2", episodes=2, images=False, seed=3)
        produce(plan, folder / "dataset", Store(folder / "store"), lambda _: None)

    return made_once(tmp_path_factory, "mimicgen_sources", make) / "dataset"

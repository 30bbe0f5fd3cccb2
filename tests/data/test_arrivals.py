"""Which recordings of a watched folder are complete, told by a clock of the test's own."""

import os
from pathlib import Path

import pytest

from taccorl.data.ingest import Arrivals, Job
from taccorl.data.recording import Source
from taccorl.data.spec import load_recording_spec

SPEC = load_recording_spec("piper_flexitac_mcap")


def changed(path: Path, size: int, time_ns: int) -> None:
    path.write_bytes(b"x" * size)
    os.utime(path, ns=(time_ns, time_ns))


def arrivals(folder: Path) -> Arrivals:
    def find() -> list[Job]:
        return [
            Job(Source(p, (p,)), SPEC, "piper_flexitac_mcap", folder / "store") for p in sorted(folder.glob("*.mcap"))
        ]

    return Arrivals(find, settled_s=5.0)


def names(jobs: list[Job]) -> list[str]:
    return [job.source.path.name for job in jobs]


def test_a_recording_is_new_once_when_it_has_not_changed_for_the_time_of_settling(tmp_path: Path) -> None:
    watched = arrivals(tmp_path)
    assert watched.look(0.0) == []
    changed(tmp_path / "a.mcap", 10, 1)
    assert watched.look(10.0) == [] and names(watched.growing) == ["a.mcap"]
    assert watched.look(14.9) == []
    assert names(watched.look(15.0)) == ["a.mcap"]
    assert watched.look(16.0) == []
    assert names(watched.complete) == ["a.mcap"] and watched.growing == []


@pytest.mark.parametrize(("size", "time_ns"), [(20, 1), (10, 2)])
def test_a_change_of_size_or_time_starts_the_time_again_also_after_it_was_complete(tmp_path, size, time_ns):
    watched = arrivals(tmp_path)
    changed(tmp_path / "a.mcap", 10, 1)
    watched.look(0.0)
    assert names(watched.look(6.0)) == ["a.mcap"]
    changed(tmp_path / "a.mcap", size, time_ns)
    assert watched.look(7.0) == [] and watched.complete == []
    assert watched.look(11.9) == []
    assert names(watched.look(12.0)) == ["a.mcap"]


def test_several_are_told_apart_and_one_that_goes_is_forgotten(tmp_path: Path) -> None:
    watched = arrivals(tmp_path)
    changed(tmp_path / "a.mcap", 10, 1)
    watched.look(0.0)
    changed(tmp_path / "b.mcap", 10, 1)
    assert names(watched.look(5.0)) == ["a.mcap"] and names(watched.growing) == ["b.mcap"]
    (tmp_path / "a.mcap").unlink()
    assert names(watched.look(10.0)) == ["b.mcap"] and names(watched.complete) == ["b.mcap"]

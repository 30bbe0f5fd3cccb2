"""Files that ask for more than a machine has, or for files that are not theirs: one recording refused, the others read."""

import time
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from test_hdf5 import ROWS, state, write

from taccorl.data import ingest as ingest_module
from taccorl.data.ingest import find_jobs, ingest, ingest_one
from taccorl.data.inspection import inspect_source
from taccorl.data.recording import Source, readers
from taccorl.data.spec import load_recording_spec
from taccorl.errors import RecordingError

SECRET = "secret.bin"
OTHER = "other.h5"
SHAPE = (ROWS, 14)


def external(file: h5py.File, name: str) -> None:
    path = Path(file.filename).with_name(SECRET)
    np.full(SHAPE, 0.01, np.float32).tofile(path)
    file.create_dataset(name, SHAPE, "f4", external=[(str(path), 0, h5py.h5f.UNLIMITED)])


def virtual(file: h5py.File, name: str) -> None:
    path = Path(file.filename).with_name(OTHER)
    with h5py.File(path, "w") as other:
        other["x"] = np.full(SHAPE, 0.01, np.float32)
    layout = h5py.VirtualLayout(SHAPE, "f4")
    layout[:] = h5py.VirtualSource(str(path), "x", SHAPE)
    file.create_virtual_dataset(name, layout)


@pytest.mark.parametrize(
    ("make", "facts"),
    [
        (lambda f, n: f.create_dataset(n, (ROWS, 10**10), "f4"), ("[10000000000]", "37.3 GiB", "1 GiB")),
        (
            lambda f, n: f.create_dataset(n, (ROWS, 14 * 10**6), "f4", chunks=(ROWS, 10**6), compression="gzip"),
            ("62 rows", "[14000000]", "3.2 GiB", "smaller chunks"),
        ),
        (
            lambda f, n: f.create_dataset(
                n, SHAPE, "f8", maxshape=(None, None), chunks=(1, 250 * 10**6), compression="gzip"
            ),
            ("1.9 GiB", "1 GiB"),  # HDF5 unpacks whole chunks, and these are wider than the rows
        ),
        (lambda f, n: f.create_dataset(n, SHAPE, "f4"), ("none of its 62 rows was ever written",)),
        (external, (SECRET, "external storage", "not opened")),
        (virtual, (OTHER, "virtual dataset", "not opened")),
    ],
)
def test_a_dataset_that_must_not_be_read_costs_its_own_recording_only(make, facts, tmp_path):
    folder = tmp_path / "in"
    write(folder / "episode_0.hdf5")
    with h5py.File(write(folder / "episode_1.hdf5"), "a") as file:
        del file["action"]
        make(file, "action")
    spec = load_recording_spec("cobot_magic_hdf5")
    jobs = find_jobs([folder / f"episode_{k}.hdf5" for k in (1, 0)], spec, "s", tmp_path / "store", dry_run=True)
    refused, written = ingest(jobs, tmp_path / "out", None)["recordings"]
    assert (refused["outcome"], written["outcome"]) == ("refused", "written")
    assert "episode_1.hdf5: /action: " in refused["reason"]
    assert all(fact in refused["reason"] for fact in facts)


def test_rows_that_were_never_written_are_no_zeros(tmp_path):
    path = write(tmp_path / "e.hdf5")
    with h5py.File(path, "a") as file:
        del file["action"]
        file.create_dataset("action", SHAPE, "f4", chunks=(10, 14))[:30] = np.stack([state(k + 1) for k in range(30)])
    reader = readers.get("hdf5")(Source(path, (path,)))
    assert len(list(reader.messages({"/action"}))) == 30
    assert reader.damage[0].reason == "/action, rows 30 to 39 cannot be read (never written)"


def test_a_thousand_million_rows_are_refused_at_once(tmp_path):
    path = tmp_path / "e.hdf5"
    with h5py.File(path, "w") as file:
        file.create_dataset("action", (10**9, 14), "f4", chunks=(1000, 14))[:1000] = 1.0
    begin_s = time.monotonic()
    reader = readers.get("hdf5")(Source(path, (path,)))
    with pytest.raises(RecordingError, match=r"e.hdf5: /action: it claims 1,000,000,000 rows; at most 1,000,000"):
        list(reader.messages({"/action"}, stamps_only={"/action"}))
    (topic,) = inspect_source("hdf5", Source(path, (path,))).topics
    assert topic.num_messages == 0 and "1,000,000,000 rows" in topic.problem
    assert time.monotonic() - begin_s < 5


def test_a_recording_that_needs_too_much_memory_does_not_end_the_batch(tmp_path, monkeypatch):
    path = write(tmp_path / "e.hdf5")

    def too_much(*_: Any) -> None:
        np.empty(10**15)  # 8 PB

    monkeypatch.setattr(ingest_module, "opened", too_much)
    (job,) = find_jobs([path], load_recording_spec("cobot_magic_hdf5"), "s", tmp_path / "store", dry_run=True)
    entry = ingest_one(job)
    assert entry["outcome"] == "refused"
    assert "more memory than there is" in entry["reason"]

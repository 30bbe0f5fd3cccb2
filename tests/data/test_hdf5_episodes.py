"""HDF5 files with many episodes, time stamps and rates of their own."""

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from small_arm import arrays, ingest, write_hdf5, write_spec

from taccorl.cli.main import main
from taccorl.data.dataset import Dataset
from taccorl.data.draft import draft_specs
from taccorl.data.inspection import inspect_source
from taccorl.data.recording import Source, find_sources, readers

# ---- many episodes in one file ----


def write_demos(path: Path, names: list[str], rows: list[int], **attributes: Any) -> Path:
    """Groups of a small arm's episodes, each with its own motion."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        for k, (name, count) in enumerate(zip(names, rows, strict=True)):
            group = file.create_group(name)
            group.attrs.update({"num_samples": count, **attributes})
            for topic, values in arrays(count, start_s=float(k)).items():
                group[topic.strip("/")] = values
        file["mask/train"] = np.array([b"demo_0"])
    return path


@pytest.mark.parametrize(
    ("names", "parts"),
    [
        (["data/demo_0", "data/demo_1", "data/demo_10"], ["demo_0", "demo_1", "demo_10"]),  # robomimic, MimicGen
        (["episode_2", "episode_10", "episode_1"], ["episode_1", "episode_2", "episode_10"]),
        (["data/demo_0"], ["demo_0"]),
        (["0", "1"], ["0", "1"]),
        (["a/demo_0", "b/demo_0"], ["a/demo_0", "b/demo_0"]),
        (["take1", "take2"], ["take1", "take2"]),  # an unknown word, but rows of different number
    ],
)
def test_each_numbered_group_of_episodes_is_a_recording(tmp_path, names, parts):
    rows = [60 + 3 * k for k in range(len(names))]
    path = write_demos(tmp_path / "rec.hdf5", names, rows)
    found = [source for _, source in find_sources(path)]
    assert [source.part for source in found] == parts
    code, report = ingest(path, write_spec(tmp_path, reader="hdf5"))
    entries = report.get("recordings", [report])
    assert (code, {e["outcome"] for e in entries}) == (0, {"written"})
    by_part = {e["part"]: sum(x["rows"] for x in e["episodes"]) for e in entries}
    order = sorted(range(len(names)), key=lambda k: parts.index(next(p for p in parts if names[k].endswith(p))))
    assert list(by_part.items()) == [(part, rows[k]) for part, k in zip(parts, order, strict=True)]
    dataset = Dataset(tmp_path / "out")
    for index, k in enumerate(order):
        state = dataset.episode(index).arrays["observation.state"]
        assert np.abs(state - arrays(rows[k], float(k))["/observations/qpos"]).max() < 1e-6


def test_groups_of_arms_are_no_episodes_and_not_guessed_to_be_arms(tmp_path):
    values = {f"/robot_{k}/{name}": np.zeros((40, 6)) for k in range(2) for name in ("qpos", "action")}
    path = write_hdf5(tmp_path / "rec.hdf5", values)
    ((_, source),) = find_sources(path)
    assert source.part is None
    text = draft_specs(inspect_source("hdf5", source)).recording
    assert "observation.state: {channels: [robot_0_qpos]," in text
    assert "# robot_1_qpos:" in text


def test_one_inspection_and_one_draft_stand_for_all_episodes_of_a_file(tmp_path, capsys):
    path = write_demos(tmp_path / "rec.hdf5", [f"data/demo_{k}" for k in range(12)], [60] * 12)
    assert main(["ingest", "inspect", str(path)]) == 0
    out = capsys.readouterr().out
    assert out.count("how it is read") == 1
    assert out.count("the same topics as") == 11
    assert "shape: [4]" in out and "shape: [12]" not in out


# ---- time stamps and rates of the file ----


def stamps(
    rows: int = 120, rate_hz: float = 30.0, unit_s: float = 1.0, start_s: float = 1.76e9, gap_s: float = 0.0
) -> np.ndarray:
    times = start_s + np.arange(rows) / rate_hz
    times[rows // 2 :] += gap_s
    return np.rint(times / unit_s).astype(np.int64) if unit_s < 1 else times


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("timestamp", stamps(rate_hz=20.0, gap_s=2.0)),
        ("timestamp", stamps(rate_hz=20.0, start_s=0.0)),
        ("timestamps_ns", stamps(rate_hz=20.0, unit_s=1e-9)),
        ("camera_time_ms", stamps(rate_hz=20.0, unit_s=1e-3, start_s=5.0)),
        ("odd", stamps(rate_hz=20.0)),  # no name, but from 1970 and rising
        ("stamp", stamps(gap_s=-1.5)),
    ],
)
def test_time_stamps_of_the_file_that_differ_from_the_spec_are_named(tmp_path, name, values):
    path = write_hdf5(tmp_path / "rec.hdf5", arrays() | {f"/observations/{name}": values})
    code, entry = ingest(path, write_spec(tmp_path, reader="hdf5"))
    assert (code, entry["outcome"]) == (1, "refused")
    assert f"time stamps /observations/{name}" in entry["reason"]
    assert "`clock: header`" in entry["reason"]


@pytest.mark.parametrize("clock", ["log", "header"])
@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300, -1e300])
def test_a_stamp_that_is_no_time_is_named_with_its_row(tmp_path, value, clock):
    times = stamps()
    times[40] = value
    path = write_hdf5(tmp_path / "rec.hdf5", arrays() | {"/timestamp": times})
    code, entry = ingest(path, write_spec(tmp_path, ("clock: log", f"clock: {clock}"), reader="hdf5"))
    assert (code, entry["outcome"]) == (1, "refused")
    assert f"/timestamp of row 40 is {value:g}" in entry["reason"]


def test_time_stamps_of_the_file_are_used_if_the_spec_says_so(tmp_path):
    """20 rows a second, a gap of 2 s in the middle: two episodes of 3 s each, sampled at 30 Hz."""
    path = write_hdf5(tmp_path / "rec.hdf5", arrays() | {"/timestamp": stamps(rate_hz=20.0, gap_s=2.0)})
    spec = write_spec(
        tmp_path,
        ("clock: log", "clock: header"),
        ("rate_hz: 30, max_age_s: 0.1", "rate_hz: 20, max_age_s: 0.1"),
        reader="hdf5",
    )
    _, entry = ingest(path, spec)
    assert entry["outcome"] == "split"
    rows = [e["rows"] for e in entry["episodes"]]
    assert rows == pytest.approx([90, 90], abs=3)
    state = Dataset(tmp_path / "out").episode(0).arrays["observation.state"]
    truth = arrays()["/observations/qpos"]
    # The first command is for 1 / 20 s, due at row 1: row k is at k / 30 + 1 / 60 s and shows sample floor((2 k + 1) / 3).
    for k in range(80):
        if (2 * k + 1) % 3:  # else between two samples, to a nanosecond
            assert np.abs(state[k] - truth[(2 * k + 1) // 3]).max() < 1e-6


@pytest.mark.parametrize(
    "extra",
    [
        {"/timestamp": stamps()},
        {"/timestamp": stamps() + np.random.default_rng(0).uniform(-5e-3, 5e-3, 120)},  # jitter of a loop
        {"/frame_index": np.arange(120), "/timestep": np.arange(120.0), "/rewards": np.zeros(120)},
        {"/lift": np.linspace(0, 1, 120)},  # rises, but not from 1970 and not named
    ],
)
def test_fitting_stamps_and_other_columns_are_no_obstacle(tmp_path, extra):
    path = write_hdf5(tmp_path / "rec.hdf5", arrays() | extra)
    assert ingest(path, write_spec(tmp_path, reader="hdf5"))[1]["outcome"] == "written"


@pytest.mark.parametrize(
    ("fps", "rate"), [("30", 30), ("29.97 Hz", 29.97), (29.97, 29.97), (b"25", 25), ("fast", None)]
)
def test_a_rate_of_the_file_may_be_a_text(tmp_path, fps, rate):
    path = write_hdf5(tmp_path / "rec.hdf5", arrays(), fps=fps)
    reader = readers.get("hdf5")(Source(path, (path,)))
    times = [m.log_ns for m in reader.messages({"/action"})]
    assert np.diff(times).mean() == pytest.approx(1e9 / (rate or 1.0), rel=1e-6)
    _, entry = ingest(path, write_spec(tmp_path, reader="hdf5"))
    assert entry["outcome"] == ("written" if rate in (30, None) else "refused"), entry["reason"]
    if rate not in (30, None):
        spec = write_spec(
            tmp_path, *[("rate_hz: 30, max_age_s: 0.1", f"rate_hz: {rate}, max_age_s: 0.1")], reader="hdf5"
        )
        assert ingest(path, spec, "--replace=true")[1]["outcome"] == "written"

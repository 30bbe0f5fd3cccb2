"""HDF5 files as cobot_magic and ALOHA write them, made here so that every number and picture is known."""

import dataclasses
import functools
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest
from edited import changed_specs
from small_arm import arrays, ingest, write_hdf5, write_spec

from taccorl.cli.main import main
from taccorl.data.cutting import Cutter
from taccorl.data.dataset import Dataset
from taccorl.data.draft import draft_specs
from taccorl.data.inspection import inspect_source
from taccorl.data.readers import hdf5
from taccorl.data.recording import Source, find_sources, load_recording, opened, readers
from taccorl.data.spec import load_recording_spec
from taccorl.errors import RecordingError

CAMERAS = ("cam_high", "cam_left_wrist", "cam_right_wrist")
ROWS = 62
SIZE = (48, 64)


def state(row: int) -> np.ndarray:
    """Within cobot_magic's limits; the last joint tells the row."""
    return np.array(
        [0.1, 0.2, -0.3, 0, 0, 0, 0.01, 0.1, 0.2, -0.3, 0, 0, 0, row * 1e-3], np.float32
    )


def picture(camera: int, row: int) -> np.ndarray:
    """RGB: red tells the row, green the camera."""
    return np.broadcast_to(
        np.array([4 * row, 60 * camera, 20], np.uint8), (*SIZE, 3)
    ).copy()


def jpeg(image: np.ndarray) -> bytes:
    ok, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    assert ok
    return data.tobytes()


def write(
    path: Path,
    *,
    compressed: bool = False,
    rows: int = ROWS,
    action_rows: int | None = None,
) -> Path:
    """One episode: action k is the state of row k + 1, as collect_data.py pairs them."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        file.attrs.update({"sim": False, "compress": compressed})
        file["observations/qpos"] = np.stack([state(k) for k in range(rows)])
        file["observations/qvel"] = np.zeros((rows, 14), np.float32)
        file["action"] = np.stack([state(k + 1) for k in range(action_rows or rows)])
        for c, camera in enumerate(CAMERAS):
            pictures = [picture(c, k) for k in range(rows)]
            name = f"observations/images/{camera}"
            if not compressed:
                file.create_dataset(name, data=np.stack(pictures), chunks=(1, *SIZE, 3))
                continue
            packed = [jpeg(image) for image in pictures]
            padded = np.zeros((rows, max(map(len, packed))), np.uint8)
            for k, data in enumerate(packed):
                padded[k, : len(data)] = np.frombuffer(data, np.uint8)
            file[name] = padded
        if compressed:
            file["compress_len"] = np.zeros((3, rows))
    return path


spec_with = functools.partial(changed_specs, spec="cobot_magic_hdf5")


def messages(path: Path, topic: str, **options: Any) -> list:
    return list(readers.get("hdf5")(Source(path, (path,))).messages({topic}, **options))


# 1/30 s is no whole number of ns: three lengths that round differently.
@pytest.mark.parametrize(
    ("compressed", "rows"), [(False, 62), (True, 62), (True, 63), (True, 64)]
)
def test_an_episode_has_every_row_with_its_state_its_command_and_its_pictures(
    tmp_path, compressed, rows
):
    path = write(tmp_path / "episode_0.hdf5", compressed=compressed, rows=rows)
    with opened(
        Source(path, (path,)), load_recording_spec("cobot_magic_hdf5")
    ) as recording:
        (episode,) = Cutter(recording).cut().episodes
        # The file pairs a row with the next row's command, as the dataset does: all its rows, as they are.
        assert episode.num_rows == rows
        assert np.array_equal(
            episode.arrays["observation.state"],
            np.stack([state(k) for k in range(rows)]),
        )
        assert np.array_equal(
            episode.arrays["action"], np.stack([state(k + 1) for k in range(rows)])
        )
        shown = list(episode.pictures())
        assert len(shown) == rows
        for row, pictures in enumerate(shown):
            for camera, name in enumerate(("front", "left_wrist", "right_wrist")):
                red, green, blue = pictures[f"observation.images.{name}"][
                    112, 112
                ]  # middle of the letterbox
                assert abs(int(red) - 4 * row) <= 2
                assert abs(int(green) - 60 * camera) <= 2
                assert abs(int(blue) - 20) <= 2


@pytest.mark.parametrize(
    "fps", [30, 60, 7]
)  # 1/60 s and 1/7 s are rounded up and down to nanoseconds
def test_commands_in_force_at_their_row_move_by_one_row(
    tmp_path: Path, fps: int
) -> None:
    path = write(tmp_path / "episode_0.hdf5")
    rate = (
        ("rate_hz: 30", f"rate_hz: {fps}"),
        ("max_age_s: 0.05", f"max_age_s: {1.5 / fps}"),
    )
    for lead, expected_rows in ((1, ROWS), (0, ROWS - 1)):
        spec = load_recording_spec(
            spec_with(tmp_path, *rate, ("lead_frames: 1", f"lead_frames: {lead}"))
        )
        assert spec.contract is not None
        spec = dataclasses.replace(
            spec, contract=dataclasses.replace(spec.contract, fps=fps)
        )
        with opened(Source(path, (path,)), spec) as recording:
            (episode,) = Cutter(recording).cut().episodes
            # File: action k = state(k + 1). Lead 0 says that it was in force at row k: then row t's is the file's t + 1.
            assert episode.num_rows == expected_rows
            expected = np.stack([state(k + 2 - lead) for k in range(expected_rows)])
            assert np.array_equal(episode.arrays["action"], expected)
            assert np.array_equal(
                episode.arrays["observation.state"],
                np.stack([state(k) for k in range(expected_rows)]),
            )


def test_a_command_without_lead_frames_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "episode_0.hdf5")
    spec = load_recording_spec(spec_with(tmp_path, (", lead_frames: 1", "")))
    with pytest.raises(
        RecordingError,
        match=r"'command' fills action: key 'lead_frames' is missing.*1: row k of /action",
    ):
        load_recording(Source(path, (path,)), spec, tmp_path)


def test_everything_can_be_looked_at_without_a_spec(tmp_path: Path) -> None:
    path = write(tmp_path / "e.hdf5", rows=3)
    reader = readers.get("hdf5")(Source(path, (path,)))
    seen = list(reader.messages(None))
    assert len(seen) == 3 * 6  # qpos, qvel, action, three cameras
    assert all(m.value is None and m.stamp_ns is None for m in seen)
    assert sorted({m.log_ns for m in seen}) == [
        0,
        10**9,
        2 * 10**9,
    ]  # no rate known: one row a second, and said so
    assert reader.metadata["time"]["rate"].startswith("the file names no rate")


def test_only_the_asked_part_is_read(tmp_path: Path) -> None:
    path = write(tmp_path / "e.hdf5", rows=9)
    part = messages(path, "/action", start_ns=2 * 10**9, end_ns=4 * 10**9)
    assert [float(m.value[-1]) for m in part] == pytest.approx([0.003, 0.004, 0.005])


def test_attributes_and_texts_are_there_for_the_instruction(tmp_path: Path) -> None:
    path = write(tmp_path / "e.hdf5")
    with h5py.File(path, "a") as file:
        file.attrs["instruction"] = "put it in"
        file["told"] = "insert the tube"
    by_key = spec_with(
        tmp_path,
        (
            "{from: spec, text: insert the test tube into the rack}",
            "{from: metadata, key: instruction}",
        ),
    )
    with opened(Source(path, (path,)), load_recording_spec(by_key)) as recording:
        assert Cutter(recording).cut().episodes[0].instruction == "put it in"
    by_topic = spec_with(
        tmp_path,
        (
            "{from: spec, text: insert the test tube into the rack}",
            "{from: topic, topic: /told}",
        ),
    )
    with opened(Source(path, (path,)), load_recording_spec(by_topic)) as recording:
        assert Cutter(recording).cut().episodes[0].instruction == "insert the tube"


def test_other_ways_to_keep_compressed_pictures_are_read(tmp_path: Path) -> None:
    path = tmp_path / "e.hdf5"
    packed = [jpeg(picture(1, k)) for k in range(3)]
    with h5py.File(path, "w") as file:
        file["fixed"] = np.array(packed, dtype=f"S{max(map(len, packed))}")
        ragged = file.create_dataset("ragged", (3,), h5py.vlen_dtype(np.uint8))
        for k, data in enumerate(packed):
            ragged[k] = np.frombuffer(data, np.uint8)
    reader = readers.get("hdf5")(Source(path, (path,)))
    assert {t.name for t in reader.topics().values()} == {"CompressedImage"}
    for topic in ("/fixed", "/ragged"):
        for k, message in enumerate(messages(path, topic)):
            decoded = cv2.imdecode(
                np.frombuffer(bytes(message.value), np.uint8), cv2.IMREAD_COLOR
            )
            assert abs(int(decoded[5, 5, 2]) - 4 * k) <= 2


def test_datasets_of_unequal_length_are_refused_by_name(tmp_path: Path) -> None:
    path = write(tmp_path / "e.hdf5", action_rows=60)
    with pytest.raises(RecordingError, match=r"/action.*60 rows,.*/observations/.*"):
        load_recording(
            Source(path, (path,)), load_recording_spec("cobot_magic_hdf5"), tmp_path
        )


def test_a_rate_that_the_file_contradicts_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "e.hdf5", rows=3)
    with h5py.File(path, "a") as file:
        file.attrs["frequency"] = 50.0
    with pytest.raises(
        RecordingError, match=r"attribute frequency: 50 Hz, the spec: 30 Hz"
    ):
        load_recording(
            Source(path, (path,)), load_recording_spec("cobot_magic_hdf5"), tmp_path
        )


def test_two_rates_or_two_leads_for_one_file_are_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "e.hdf5", rows=3)
    mixed = load_recording_spec(
        spec_with(tmp_path, ("cam_high, rate_hz: 30", "cam_high, rate_hz: 15"))
    )
    with pytest.raises(RecordingError, match=r"'qpos'.*'front'.*at"):
        load_recording(Source(path, (path,)), mixed, tmp_path)
    twice = load_recording_spec(
        spec_with(tmp_path, ("topic: /action", "topic: /observations/qpos"))
    )
    with pytest.raises(
        RecordingError, match=r"'command': lead_frames.*1,.*another channel of"
    ):
        load_recording(Source(path, (path,)), twice, tmp_path)


def test_what_is_no_whole_hdf5_file_is_said_in_plain_words(tmp_path: Path) -> None:
    path = write(tmp_path / "e.hdf5")
    whole = path.read_bytes()
    for content, words in (
        (b"", r"is empty \(0 bytes\)"),
        (b"not of that kind" * 100, "is not an HDF5 file"),
        (whole[: len(whole) // 2], "is cut off .*copy it again from the robot"),
    ):
        path.write_bytes(content)
        reader = readers.get("hdf5")(Source(path, (path,)))
        with pytest.raises(RecordingError, match=words):
            reader.topics()
        with pytest.raises(RecordingError, match=words):
            list(reader.messages(None))


def test_a_damaged_chunk_costs_its_own_rows_only_and_is_reported(
    tmp_path: Path,
) -> None:
    path = tmp_path / "e.hdf5"
    values = np.random.default_rng(0).normal(size=(40, 14))
    with h5py.File(path, "w") as file:
        file.create_dataset("qpos", data=values, chunks=(10, 14), compression="gzip")
        file["other"] = np.arange(40.0)
        where = file["qpos"].id.get_chunk_info_by_coord((20, 0))
    content = bytearray(path.read_bytes())
    content[where.byte_offset : where.byte_offset + where.size] = bytes(where.size)
    path.write_bytes(content)
    reader = readers.get("hdf5")(Source(path, (path,)))
    for _ in range(2):  # read again, it is one damage still
        found = list(reader.messages({"/qpos", "/other"}))
        kept = [m for m in found if m.topic == "/qpos"]
        assert [m.log_ns // 10**9 for m in kept] == [*range(20), *range(30, 40)]
        assert np.array_equal(
            [m.value for m in kept], values[[*range(20), *range(30, 40)]]
        )
        assert sum(m.topic == "/other" for m in found) == 40
        (damage,) = reader.damage
        assert (damage.byte_start, damage.byte_end) == (
            where.byte_offset,
            where.byte_offset + where.size,
        )
        assert damage.reason.startswith("/qpos, rows 20 to 29 cannot be read")
        assert (damage.start_ns, damage.end_ns) == (20 * 10**9, 29 * 10**9)


def test_a_damaged_picture_costs_its_row_only(tmp_path: Path) -> None:
    path = write(tmp_path / "e.hdf5")
    with h5py.File(path, "a") as file:
        front = "observations/images/cam_high"
        pictures = file[front][:]
        del file[front]
        dataset = file.create_dataset(
            front, data=pictures, chunks=(1, *SIZE, 3), compression="gzip"
        )
        where = dataset.id.get_chunk_info_by_coord((30, 0, 0, 0))
    content = bytearray(path.read_bytes())
    content[where.byte_offset : where.byte_offset + where.size] = bytes(where.size)
    path.write_bytes(content)
    with opened(
        Source(path, (path,)), load_recording_spec("cobot_magic_hdf5")
    ) as recording:
        cutter = Cutter(recording)
        with pytest.raises(
            RecordingError, match=r"front: the picture logged at .* is broken"
        ):
            list(cutter.cut().episodes[0].pictures())
        assert cutter.drop_broken_pictures() == 1
        (episode,) = cutter.cut().episodes
        reds = [
            int(p["observation.images.front"][112, 112, 0]) // 4
            for p in episode.pictures()
        ]
        # 33 ms without a picture is less than max_age_s: row 30 shows the picture of row 29.
        assert reds == [*range(30), 29, *range(31, ROWS)]


def test_values_of_another_kind_are_refused_when_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "e.hdf5"
    with h5py.File(path, "w") as file:
        file["pairs"] = np.zeros(3, dtype=[("a", float), ("b", int)])
        file["fine"] = np.zeros(3)
    assert len(messages(path, "/fine")) == 3
    with pytest.raises(RecordingError, match=r"/pairs: values of type .* are not read"):
        messages(path, "/pairs")


# ---- many episodes in one file ----


def write_demos(
    path: Path, names: list[str], rows: list[int], **attributes: Any
) -> Path:
    """Write an HDF5 file of a small arm: for each of ``names`` a group, an episode of as many samples as ``rows`` says."""
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
        (
            ["data/demo_0", "data/demo_1", "data/demo_10"],
            ["demo_0", "demo_1", "demo_10"],
        ),  # robomimic, MimicGen
        (
            ["episode_2", "episode_10", "episode_1"],
            ["episode_1", "episode_2", "episode_10"],
        ),
        (["data/demo_0"], ["demo_0"]),
        (["0", "1"], ["0", "1"]),
        (["a/demo_0", "b/demo_0"], ["a/demo_0", "b/demo_0"]),
        (
            ["take1", "take2"],
            ["take1", "take2"],
        ),  # an unknown word, but rows of different number
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
    order = sorted(
        range(len(names)),
        key=lambda k: parts.index(next(p for p in parts if names[k].endswith(p))),
    )
    assert list(by_part.items()) == [
        (part, rows[k]) for part, k in zip(parts, order, strict=True)
    ]
    dataset = Dataset(tmp_path / "out")
    for index, k in enumerate(order):
        state = dataset.episode(index).arrays["observation.state"]
        assert (
            np.abs(state - arrays(rows[k], float(k))["/observations/qpos"]).max() < 1e-6
        )


def test_groups_of_arms_are_no_episodes_and_not_guessed_to_be_arms(tmp_path):
    values = {
        f"/robot_{k}/{name}": np.zeros((40, 6))
        for k in range(2)
        for name in ("qpos", "action")
    }
    path = write_hdf5(tmp_path / "rec.hdf5", values)
    ((_, source),) = find_sources(path)
    assert source.part is None
    text = draft_specs(inspect_source("hdf5", source)).recording
    assert "observation.state: {channels: [robot_0_qpos]," in text
    assert "# robot_1_qpos:" in text


def test_one_inspection_and_one_draft_stand_for_all_episodes_of_a_file(
    tmp_path, capsys
):
    path = write_demos(
        tmp_path / "rec.hdf5", [f"data/demo_{k}" for k in range(12)], [60] * 12
    )
    assert main(["ingest", "inspect", str(path)]) == 0
    out = capsys.readouterr().out
    assert out.count("how it is read") == 1
    assert out.count("the same topics as") == 11
    assert "shape: [4]" in out and "shape: [12]" not in out


# ---- time stamps and rates of the file ----


def stamps(
    rows: int = 120,
    rate_hz: float = 30.0,
    unit_s: float = 1.0,
    start_s: float = 1.76e9,
    gap_s: float = 0.0,
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
def test_time_stamps_of_the_file_that_differ_from_the_spec_are_named(
    tmp_path, name, values
):
    path = write_hdf5(
        tmp_path / "rec.hdf5", arrays() | {f"/observations/{name}": values}
    )
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
    code, entry = ingest(
        path, write_spec(tmp_path, ("clock: log", f"clock: {clock}"), reader="hdf5")
    )
    assert (code, entry["outcome"]) == (1, "refused")
    assert f"/timestamp of row 40 is {value:g}" in entry["reason"]


def test_time_stamps_of_the_file_are_used_if_the_spec_says_so(tmp_path):
    """20 rows a second, a gap of 2 s in the middle: two episodes of 3 s each, sampled at 30 Hz."""
    path = write_hdf5(
        tmp_path / "rec.hdf5",
        arrays() | {"/timestamp": stamps(rate_hz=20.0, gap_s=2.0)},
    )
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
        {
            "/timestamp": stamps() + np.random.default_rng(0).uniform(-5e-3, 5e-3, 120)
        },  # jitter of a loop
        {
            "/frame_index": np.arange(120),
            "/timestep": np.arange(120.0),
            "/rewards": np.zeros(120),
        },
        {"/lift": np.linspace(0, 1, 120)},  # rises, but not from 1970 and not named
    ],
)
def test_fitting_stamps_and_other_columns_are_no_obstacle(tmp_path, extra):
    path = write_hdf5(tmp_path / "rec.hdf5", arrays() | extra)
    assert ingest(path, write_spec(tmp_path, reader="hdf5"))[1]["outcome"] == "written"


@pytest.mark.parametrize(
    ("fps", "rate"),
    [("30", 30), ("29.97 Hz", 29.97), (29.97, 29.97), (b"25", 25), ("fast", None)],
)
def test_a_rate_of_the_file_may_be_a_text(tmp_path, fps, rate):
    path = write_hdf5(tmp_path / "rec.hdf5", arrays(), fps=fps)
    reader = readers.get("hdf5")(Source(path, (path,)))
    times = [m.log_ns for m in reader.messages({"/action"})]
    assert np.diff(times).mean() == pytest.approx(1e9 / (rate or 1.0), rel=1e-6)
    _, entry = ingest(path, write_spec(tmp_path, reader="hdf5"))
    assert entry["outcome"] == ("written" if rate in (30, None) else "refused"), entry[
        "reason"
    ]
    if rate not in (30, None):
        spec = write_spec(
            tmp_path,
            *[("rate_hz: 30, max_age_s: 0.1", f"rate_hz: {rate}, max_age_s: 0.1")],
            reader="hdf5",
        )
        assert ingest(path, spec, "--replace=true")[1]["outcome"] == "written"


# ---- files that state more than they hold ----


def stated(path: Path, rows: int, **how: Any) -> Path:
    """Two topics of ``rows`` equal rows of 8 numbers, compressed to next to nothing."""
    with h5py.File(path, "w") as file:
        for name in ("qpos", "action"):
            values = np.zeros((rows, 8))
            file.create_dataset(name, data=values, **{"compression": "gzip", **how})
    return path


@pytest.mark.parametrize("limit", ["FREE_ROWS", "FREE_BYTES"])
def test_more_rows_or_bytes_than_the_file_can_hold_are_refused_unread(
    limit: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """12 800 rows of 64 bytes are 819 200, of which about 2000 are stored: a harmless
    file, which passes with the usual limits."""
    path = stated(tmp_path / "e.hdf5", 6400, chunks=(6400, 8))
    reader = readers.get("hdf5")(Source(path, (path,)))
    assert sum(1 for _ in reader.messages(None)) == 2 * 6400
    monkeypatch.setattr(hdf5, limit, 10_000, raising=False)
    with pytest.raises(RecordingError, match=r"e\.hdf5: .* of which the file holds"):
        next(reader.messages({"/qpos", "/action"}))


def test_a_file_that_holds_its_rows_is_read_beyond_these_limits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "e.hdf5"
    with h5py.File(path, "w") as file:
        values = np.random.default_rng(0).normal(size=(500, 8))
        file.create_dataset("qpos", data=values, compression="gzip")
        file.create_dataset("effort", data=np.zeros((500, 8)), compression="gzip")
    monkeypatch.setattr(hdf5, "FREE_ROWS", 10, raising=False)
    monkeypatch.setattr(hdf5, "FREE_BYTES", 10, raising=False)
    reader = readers.get("hdf5")(Source(path, (path,)))
    assert sum(1 for _ in reader.messages(None)) == 1000


def test_more_episodes_than_the_limit_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "e.hdf5"
    with h5py.File(path, "w") as file:
        for k in range(5):
            file[f"data/demo_{k}/qpos"] = np.zeros((3, 2))
    assert len(find_sources(path, reader="hdf5")) == 5
    monkeypatch.setattr(hdf5, "MOST_EPISODES", 4, raising=False)
    hdf5._groups_of_file.cache_clear()
    with pytest.raises(RecordingError, match=r"5 groups .* at most 4"):
        find_sources(path, reader="hdf5")

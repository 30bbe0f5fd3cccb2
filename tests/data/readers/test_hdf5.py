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

from taccorl.data.cutting import Cutter
from taccorl.data.recording import Source, load_recording, opened, readers
from taccorl.data.spec import load_recording_spec
from taccorl.errors import RecordingError

CAMERAS = ("cam_high", "cam_left_wrist", "cam_right_wrist")
ROWS = 62
SIZE = (48, 64)


def state(row: int) -> np.ndarray:
    """Within cobot_magic's limits; the last joint tells the row."""
    return np.array([0.1, 0.2, -0.3, 0, 0, 0, 0.01, 0.1, 0.2, -0.3, 0, 0, 0, row * 1e-3], np.float32)


def picture(camera: int, row: int) -> np.ndarray:
    """RGB: red tells the row, green the camera."""
    return np.broadcast_to(np.array([4 * row, 60 * camera, 20], np.uint8), (*SIZE, 3)).copy()


def jpeg(image: np.ndarray) -> bytes:
    ok, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    assert ok
    return data.tobytes()


def write(path: Path, *, compressed: bool = False, rows: int = ROWS, action_rows: int | None = None) -> Path:
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
@pytest.mark.parametrize(("compressed", "rows"), [(False, 62), (True, 62), (True, 63), (True, 64)])
def test_an_episode_has_every_row_with_its_state_its_command_and_its_pictures(tmp_path, compressed, rows):
    path = write(tmp_path / "episode_0.hdf5", compressed=compressed, rows=rows)
    with opened(Source(path, (path,)), load_recording_spec("cobot_magic_hdf5")) as recording:
        (episode,) = Cutter(recording).cut().episodes
        # The file pairs a row with the next row's command, as the dataset does: all its rows, as they are.
        assert episode.num_rows == rows
        assert np.array_equal(episode.arrays["observation.state"], np.stack([state(k) for k in range(rows)]))
        assert np.array_equal(episode.arrays["action"], np.stack([state(k + 1) for k in range(rows)]))
        shown = list(episode.pictures())
        assert len(shown) == rows
        for row, pictures in enumerate(shown):
            for camera, name in enumerate(("front", "left_wrist", "right_wrist")):
                red, green, blue = pictures[f"observation.images.{name}"][112, 112]  # middle of the letterbox
                assert abs(int(red) - 4 * row) <= 2
                assert abs(int(green) - 60 * camera) <= 2
                assert abs(int(blue) - 20) <= 2


@pytest.mark.parametrize("fps", [30, 60, 7])  # 1/60 s and 1/7 s are rounded up and down to nanoseconds
def test_commands_in_force_at_their_row_move_by_one_row(tmp_path: Path, fps: int) -> None:
    path = write(tmp_path / "episode_0.hdf5")
    rate = (("rate_hz: 30", f"rate_hz: {fps}"), ("max_age_s: 0.05", f"max_age_s: {1.5 / fps}"))
    for lead, expected_rows in ((1, ROWS), (0, ROWS - 1)):
        spec = load_recording_spec(spec_with(tmp_path, *rate, ("lead_frames: 1", f"lead_frames: {lead}")))
        assert spec.contract is not None
        spec = dataclasses.replace(spec, contract=dataclasses.replace(spec.contract, fps=fps))
        with opened(Source(path, (path,)), spec) as recording:
            (episode,) = Cutter(recording).cut().episodes
            # File: action k = state(k + 1). Lead 0 says that it was in force at row k: then row t's is the file's t + 1.
            assert episode.num_rows == expected_rows
            expected = np.stack([state(k + 2 - lead) for k in range(expected_rows)])
            assert np.array_equal(episode.arrays["action"], expected)
            assert np.array_equal(
                episode.arrays["observation.state"], np.stack([state(k) for k in range(expected_rows)])
            )


def test_a_command_without_lead_frames_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "episode_0.hdf5")
    spec = load_recording_spec(spec_with(tmp_path, (", lead_frames: 1", "")))
    with pytest.raises(
        RecordingError, match=r"'command' fills action: key 'lead_frames' is missing.*1: row k of /action"
    ):
        load_recording(Source(path, (path,)), spec, tmp_path)


def test_everything_can_be_looked_at_without_a_spec(tmp_path: Path) -> None:
    path = write(tmp_path / "e.hdf5", rows=3)
    reader = readers.get("hdf5")(Source(path, (path,)))
    seen = list(reader.messages(None))
    assert len(seen) == 3 * 6  # qpos, qvel, action, three cameras
    assert all(m.value is None and m.stamp_ns is None for m in seen)
    assert sorted({m.log_ns for m in seen}) == [0, 10**9, 2 * 10**9]  # no rate known: one row a second, and said so
    assert reader.metadata["time"]["rate"].startswith("the file names no rate")
    with h5py.File(path, "a") as file:
        file.attrs["fps"] = 50
    assert [m.log_ns for m in messages(path, "/action")] == [0, 20_000_000, 40_000_000]


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
        tmp_path, ("{from: spec, text: insert the test tube into the rack}", "{from: metadata, key: instruction}")
    )
    with opened(Source(path, (path,)), load_recording_spec(by_key)) as recording:
        assert Cutter(recording).cut().episodes[0].instruction == "put it in"
    by_topic = spec_with(
        tmp_path, ("{from: spec, text: insert the test tube into the rack}", "{from: topic, topic: /told}")
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
            decoded = cv2.imdecode(np.frombuffer(bytes(message.value), np.uint8), cv2.IMREAD_COLOR)
            assert abs(int(decoded[5, 5, 2]) - 4 * k) <= 2


def test_datasets_of_unequal_length_are_refused_by_name(tmp_path: Path) -> None:
    path = write(tmp_path / "e.hdf5", action_rows=60)
    with pytest.raises(RecordingError, match=r"/action.*60 rows,.*/observations/.*"):
        load_recording(Source(path, (path,)), load_recording_spec("cobot_magic_hdf5"), tmp_path)


def test_a_rate_that_the_file_contradicts_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "e.hdf5", rows=3)
    with h5py.File(path, "a") as file:
        file.attrs["frequency"] = 50.0
    with pytest.raises(RecordingError, match=r"attribute frequency: 50 Hz, the spec: 30 Hz"):
        load_recording(Source(path, (path,)), load_recording_spec("cobot_magic_hdf5"), tmp_path)


def test_two_rates_or_two_leads_for_one_file_are_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "e.hdf5", rows=3)
    mixed = load_recording_spec(spec_with(tmp_path, ("cam_high, rate_hz: 30", "cam_high, rate_hz: 15")))
    with pytest.raises(RecordingError, match=r"'qpos'.*'front'.*at"):
        load_recording(Source(path, (path,)), mixed, tmp_path)
    twice = load_recording_spec(spec_with(tmp_path, ("topic: /action", "topic: /observations/qpos")))
    with pytest.raises(RecordingError, match=r"'command': lead_frames.*1,.*another channel of"):
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


def test_a_damaged_chunk_costs_its_own_rows_only_and_is_reported(tmp_path: Path) -> None:
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
        assert np.array_equal([m.value for m in kept], values[[*range(20), *range(30, 40)]])
        assert sum(m.topic == "/other" for m in found) == 40
        (damage,) = reader.damage
        assert (damage.byte_start, damage.byte_end) == (where.byte_offset, where.byte_offset + where.size)
        assert damage.reason.startswith("/qpos, rows 20 to 29 cannot be read")
        assert (damage.start_ns, damage.end_ns) == (20 * 10**9, 29 * 10**9)


def test_a_damaged_picture_costs_its_row_only(tmp_path: Path) -> None:
    path = write(tmp_path / "e.hdf5")
    with h5py.File(path, "a") as file:
        front = "observations/images/cam_high"
        pictures = file[front][:]
        del file[front]
        dataset = file.create_dataset(front, data=pictures, chunks=(1, *SIZE, 3), compression="gzip")
        where = dataset.id.get_chunk_info_by_coord((30, 0, 0, 0))
    content = bytearray(path.read_bytes())
    content[where.byte_offset : where.byte_offset + where.size] = bytes(where.size)
    path.write_bytes(content)
    with opened(Source(path, (path,)), load_recording_spec("cobot_magic_hdf5")) as recording:
        cutter = Cutter(recording)
        with pytest.raises(RecordingError, match=r"front: the picture logged at .* is broken"):
            list(cutter.cut().episodes[0].pictures())
        assert cutter.drop_broken_pictures() == 1
        (episode,) = cutter.cut().episodes
        reds = [int(p["observation.images.front"][112, 112, 0]) // 4 for p in episode.pictures()]
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

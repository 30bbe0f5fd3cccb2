"""Datasets that LeRobot itself wrote, read back; and the same datasets with a planted fault."""

import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from by_lerobot import write_with_lerobot

from taccorl.data.dataset import (
    Dataset,
    dataset_spec_from_json,
    dataset_spec_to_json,
    episode_record,
)
from taccorl.data.episode import ChannelTiming, Episode
from taccorl.data.origin import UNSTATED, Origin
from taccorl.data.spec import data_specs_folder, load_dataset_spec
from taccorl.errors import DatasetError, SpecError

FRONT, WRIST = "observation.images.front", "observation.images.wrist"
LENGTHS = (20, 23, 18)
TASKS = ("insert the tube", "take the tube out", "insert the tube")
MP4 = f"videos/{FRONT}/chunk-000/file-000.mp4"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"
ENCODERS = {
    "h264": {"vcodec": "h264", "g": 2},
    "h264 with long groups and B frames": {
        "vcodec": "h264",
        "g": 250,
        "preset": "medium",
    },
    "libsvtav1": {"vcodec": "libsvtav1", "g": 2, "preset": 12},
}


def grey(camera: str, row: int) -> int:
    """Level of row's picture; 8 apart, so that compression cannot turn one into another."""
    return 20 + 8 * row if camera == FRONT else 240 - 8 * row


def tactile(episode: int, row: int) -> np.ndarray:
    return (np.arange(1536) % 97 - 40 + 3 * row - episode).astype(np.int16)


def state(episode: int, row: int) -> np.ndarray:
    return np.array([episode, row, 0.1 * row], np.float32)


def rows_of(episode: int) -> list[dict[str, Any]]:
    return [
        {
            "observation.state": state(episode, row),
            "observation.tactile": tactile(episode, row),
            "observation.grip": np.array([row], np.float32),
            "observation.matrix": np.full((2, 2), row, np.float32),
            "observation.note": "hello",
            "next.done": np.array([row == LENGTHS[episode] - 1]),
            FRONT: np.full((64, 64, 3), grey(FRONT, row), np.uint8),
            WRIST: np.full((64, 64, 3), grey(WRIST, row), np.uint8),
            "task": TASKS[episode],
        }
        for row in range(LENGTHS[episode])
    ]


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Encoder → dataset of three episodes; read only."""
    folder = tmp_path_factory.mktemp("made_by_lerobot")
    roots = {name: folder / name.replace(" ", "_") for name in ENCODERS}
    for name, root in roots.items():
        options = {
            "robot_type": "toy",
            "streaming_encoding": True,
            "encoder_queue_maxsize": 64,
        }
        names = {"observation.state": ["a", "b", "c"]}
        write_with_lerobot(
            root, map(rows_of, range(3)), encoder=ENCODERS[name], names=names, **options
        )
    return roots


@pytest.fixture
def copy(made: dict[str, Path], tmp_path: Path) -> Path:
    """A copy to break."""
    root = tmp_path / "copy"
    shutil.copytree(made["h264"], root)
    return root


def remux(path: Path, change: Callable[[int, Any], bool]) -> None:
    """Writes a video's packets again without decoding; ``change(n, packet)`` says whether the n-th stays."""
    out = path.with_suffix(".new.mp4")
    with av.open(str(path)) as source, av.open(str(out), "w") as target:
        stream = source.streams.video[0]
        copied = target.add_stream_from_template(stream)
        packets = sorted(
            (p for p in source.demux(stream) if p.size), key=lambda p: p.dts
        )
        for n, packet in enumerate(packets):
            if change(n, packet):
                packet.stream = copied
                target.mux(packet)
    out.replace(path)


def edit_episodes(root: Path, change: Callable[[list[dict[str, Any]]], None]) -> None:
    rows = pq.read_table(root / EPISODES).to_pylist()
    change(rows)
    pq.write_table(pa.Table.from_pylist(rows), root / EPISODES)


def edit_info(root: Path, **changes: Any) -> None:
    path = root / "meta" / "info.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def write_provenance(root: Path, name: str, value: Any) -> Path:
    path = root / "meta" / "taccorl" / name
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(value))
    return path


@pytest.mark.parametrize("encoder", ENCODERS)
def test_every_row_of_every_episode_shows_its_own_picture(
    made: dict[str, Path], encoder: str
) -> None:
    dataset = Dataset(made[encoder])
    assert dataset.num_episodes == 3
    for index, length in enumerate(LENGTHS):
        episode = dataset.episode(index)
        for _ in range(2):  # the stream starts anew at every call
            shown = list(episode.pictures())
            assert len(shown) == length
            for camera in (FRONT, WRIST):
                found = np.array([picture[camera].mean() for picture in shown])
                expected = np.array([grey(camera, row) for row in range(length)])
                assert np.abs(found - expected).max() <= 3  # neighbours differ by 8
        assert (
            shown[0][FRONT].shape == (64, 64, 3) and shown[0][FRONT].dtype == np.uint8
        )


def test_pictures_are_pixel_for_pixel_those_of_lerobots_own_reader(
    made: dict[str, Path],
) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    root = made["h264 with long groups and B frames"]
    theirs = LeRobotDataset(
        "local/made", root=root, video_backend="pyav", return_uint8=True
    )
    ours = [
        picture
        for index in range(3)
        for picture in Dataset(root).episode(index).pictures()
    ]
    for row in (0, 19, 20, 41, 43, 60):  # both sides of each episode's border
        assert np.array_equal(
            np.moveaxis(np.asarray(theirs[row][FRONT]), 0, -1), ours[row][FRONT]
        )


def test_frames_of_a_part_of_an_episode_are_those_rows(made: dict[str, Path]) -> None:
    frames = list(Dataset(made["libsvtav1"]).frames(1, FRONT, 7, 12))
    assert [round((f.mean() - 20) / 8) for f in frames] == [7, 8, 9, 10, 11]
    assert list(Dataset(made["libsvtav1"]).frames(1, FRONT, 7, 7)) == []


def test_numbers_tasks_and_names_come_back_exactly(made: dict[str, Path]) -> None:
    for index, length in enumerate(LENGTHS):
        episode = Dataset(made["h264"]).episode(index)
        assert episode.instruction == TASKS[index] and episode.num_rows == length
        assert episode.arrays["observation.tactile"].dtype == np.int16
        assert np.array_equal(
            episode.arrays["observation.tactile"],
            [tactile(index, row) for row in range(length)],
        )
        assert np.array_equal(
            episode.arrays["observation.state"],
            [state(index, row) for row in range(length)],
        )
        assert episode.arrays["observation.grip"].shape == (length, 1)
        assert episode.spec.features["observation.state"].names == ("a", "b", "c")
        assert (episode.success, episode.origin, episode.baselines, episode.timing) == (
            None,
            UNSTATED,
            {},
            (),
        )


def test_features_that_a_spec_cannot_say_are_listed_with_the_reason(
    made: dict[str, Path],
) -> None:
    dataset = Dataset(made["h264"])
    assert set(dataset.skipped) == {"observation.note", "next.done"}
    assert dataset.skipped["next.done"].startswith("bool [1]: numbers are read")
    numbers = {
        "observation.state",
        "observation.tactile",
        "observation.grip",
        "observation.matrix",
    }
    assert set(dataset.spec.features) == {*numbers, FRONT, WRIST}
    assert dataset.spec.features["observation.matrix"].layout == (2, 2)
    unknown = dataset.spec.features["observation.tactile"]
    assert (unknown.unit, unknown.frame, unknown.range) == (
        "unknown",
        "unknown",
        (-np.inf, np.inf),
    )


def test_a_frame_that_is_missing_in_the_middle_is_named_and_never_shown_as_another(
    copy: Path,
) -> None:
    remux(copy / MP4, lambda n, packet: n != 20 + 7)
    dataset = Dataset(copy)
    # Episode 1 begins at 20/30 s; its row 7 was at 27/30 = 0.9 s.
    assert dataset.video_problems() == [
        f"{MP4}: episode 1: 22 frames for 23 rows; row 7 has none at 0.9000 s"
    ]
    with pytest.raises(
        DatasetError, match=r"episode 1: no frame at 0\.9000 s for row 7 of 23"
    ):
        list(dataset.episode(1).pictures())
    assert len(list(dataset.episode(2).pictures())) == 18


def test_dropped_frames_that_moved_all_later_ones_are_named(copy: Path) -> None:
    """What LeRobot's streaming encoder does when its queue is full: fewer frames, at the times of the first ones."""

    def drop_three(n: int, packet: Any) -> bool:
        if n > 27:
            packet.pts, packet.dts = (
                packet.pts - 3 * 512,
                packet.dts - 3 * 512,
            )  # 512 ticks of 1/15360 s: one frame
        return not 25 <= n <= 27

    remux(copy / MP4, drop_three)
    assert Dataset(copy).video_problems() == [
        f"{MP4}: episode 2: 15 frames for 18 rows; row 15 has none at 1.9333 s"
    ]
    with pytest.raises(DatasetError, match=r"no frame at 1\.9333 s for row 15 of 18"):
        list(Dataset(copy).episode(2).pictures())


def test_a_start_that_is_one_frame_late_is_named_although_every_row_finds_a_frame(
    copy: Path,
) -> None:
    def late(rows: list[dict[str, Any]]) -> None:
        rows[1][f"videos/{FRONT}/from_timestamp"] += 1 / 30

    edit_episodes(copy, late)
    assert Dataset(copy).video_problems() == [
        f"{MP4}: episode 2: 1 of its frames are also those of episode 1",
        f"{MP4}: 61 frames for 61 rows of episodes 0 to 2: 1 frames belong to no row, first at 0.6667 s",
    ]


def test_frames_that_belong_to_no_row_are_named(copy: Path) -> None:
    edit_episodes(copy, lambda rows: rows.pop())
    edit_info(copy, total_episodes=2)
    assert Dataset(copy).video_problems() == [
        f"videos/{camera}/chunk-000/file-000.mp4: 61 frames for 43 rows of episodes 0 to 1: 18 frames belong to no row, "
        f"first at 1.4333 s"
        for camera in (FRONT, WRIST)
    ]


def test_a_video_that_is_cut_off_missing_or_none_is_named(copy: Path) -> None:
    whole = (copy / MP4).read_bytes()
    (copy / MP4).write_bytes(whole[: len(whole) - 300])
    assert "episode 2" in " ".join(Dataset(copy).video_problems())
    (copy / MP4).write_bytes(b"nothing of a video" * 100)
    assert (
        Dataset(copy)
        .video_problems()[0]
        .startswith(f"{MP4}: is not a video (InvalidDataError")
    )
    (copy / MP4).unlink()
    assert Dataset(copy).video_problems() == [
        f"{MP4}: is missing: copy the whole dataset"
    ]
    with pytest.raises(DatasetError, match="is missing"):
        next(Dataset(copy).episode(0).pictures())
    assert Dataset(copy).episode(0).num_rows == 20  # its numbers are there all the same


def test_a_folder_that_is_no_dataset_says_what_is_missing(tmp_path: Path) -> None:
    (tmp_path / "insert_tube").mkdir()
    with pytest.raises(DatasetError, match="did you mean 'insert_tube'"):
        Dataset(tmp_path / "insert_tub")
    with pytest.raises(DatasetError, match=r"there is no meta/info\.json"):
        Dataset(tmp_path / "insert_tube")


@pytest.mark.parametrize(
    ("version", "words"),
    [
        (
            "v2.1",
            "v2.1 dataset,.*v3.*-m lerobot.scripts.convert_dataset_v21_to_v30 .*--repo-id=local/copy",
        ),
        ("v1.6", "dataset v1.6,.*v3.*LeRobot converts v2.1"),
        ("v4.0", "dataset v4.0,.*v3"),
    ],
)
def test_other_versions_are_named_with_the_way_out(
    copy: Path, version: str, words: str
) -> None:
    edit_info(copy, codebase_version=version)
    with pytest.raises(DatasetError, match=words):
        Dataset(copy)


def test_an_incomplete_dataset_says_what_is_missing(copy: Path) -> None:
    edit_info(copy, total_episodes=5)
    with pytest.raises(
        DatasetError, match=r"5 episodes,.*meta/episodes lists 3, episode 3.*missing"
    ):
        Dataset(copy)
    edit_info(copy, total_episodes=3, fps=29.97)
    with pytest.raises(DatasetError, match=r"fps 29\.97;.*whole numbers"):
        Dataset(copy)
    edit_info(copy, fps=30)
    data = copy / "data/chunk-000/file-000.parquet"
    content = data.read_bytes()
    data.write_bytes(
        content[: len(content) // 2]
    )  # a writer that died: parquet has no footer
    with pytest.raises(
        DatasetError, match=r"file-000\.parquet: is not a whole parquet file"
    ):
        Dataset(copy).episode(0)
    data.unlink()
    with pytest.raises(
        DatasetError, match=r"1 data files are missing, first .*file-000\.parquet"
    ):
        Dataset(copy)
    (copy / "meta/info.json").write_text("{")
    with pytest.raises(DatasetError, match=r"info\.json: is not JSON"):
        Dataset(copy)


def test_missing_rows_are_no_shorter_episode(copy: Path) -> None:
    data = copy / "data/chunk-000/file-000.parquet"
    table = pq.read_table(data)
    pq.write_table(table.take([k for k in range(len(table)) if k != 25]), data)
    assert Dataset(copy).episode(0).num_rows == 20
    with pytest.raises(DatasetError, match=r"episode 1:.*22 rows,.*rows 0.*22.*order"):
        Dataset(copy).episode(1)


def test_an_episode_that_is_not_there_is_an_error(made: dict[str, Path]) -> None:
    for index in (3, -1):
        with pytest.raises(
            DatasetError, match=f"no episode {index}; it has 3, counted from 0"
        ):
            Dataset(made["h264"]).episode(index)


def test_rows_with_several_tasks_are_stages(copy: Path) -> None:
    data = copy / "data/chunk-000/file-000.parquet"
    table = pq.read_table(data)
    tasks = [0] * 5 + [1] * 15 + table["task_index"].to_pylist()[20:]
    column = table.column_names.index("task_index")
    pq.write_table(
        table.set_column(column, "task_index", pa.array(tasks, pa.int64())), data
    )
    episode = Dataset(copy).episode(0)
    assert episode.instruction == TASKS[0]
    assert episode.stages == ((0, TASKS[0]), (5, TASKS[1]))


# ---- meta/taccorl


@pytest.mark.parametrize("name", ["taccorl_bimanual", "cobot_magic"])
def test_a_shipped_spec_survives_json_exactly(name: str, tmp_path: Path) -> None:
    spec = load_dataset_spec(data_specs_folder() / f"{name}.yaml")
    path = tmp_path / "dataset_spec.json"
    path.write_text(json.dumps(dataset_spec_to_json(spec), allow_nan=False))
    assert dataset_spec_from_json(path) == spec


def test_a_derived_spec_has_no_ranges_and_is_not_written_down(
    made: dict[str, Path],
) -> None:
    with pytest.raises(DatasetError, match=r"observation\.state has no valid range"):
        dataset_spec_to_json(Dataset(made["h264"]).spec)


def ranged_spec(root: Path) -> dict[str, Any]:
    """The derived spec of a dataset, with a range for everything."""
    spec = Dataset(root).spec
    features = {
        key: dataclasses.replace(f, range=(-1e3, 1e3))
        for key, f in spec.features.items()
    }
    return json.loads(
        json.dumps(dataset_spec_to_json(dataclasses.replace(spec, features=features)))
    )


def test_a_spec_of_another_version_or_with_unknown_keys_is_refused(
    made: dict[str, Path], tmp_path: Path
) -> None:
    plain = ranged_spec(made["h264"])
    path = tmp_path / "dataset_spec.json"
    path.write_text(json.dumps(plain | {"spec_version": 7}))
    with pytest.raises(SpecError, match="7; this taccorl reads version 1"):
        dataset_spec_from_json(path)
    path.write_text(json.dumps(plain | {"fsp": 30}))
    with pytest.raises(SpecError, match="did you mean 'fps'"):
        dataset_spec_from_json(path)


def test_a_dataset_is_read_by_the_spec_it_carries_if_that_is_its_own(
    copy: Path,
) -> None:
    derived = ranged_spec(copy)
    path = write_provenance(
        copy, "dataset_spec.json", derived | {"name": "told", "robot_type": "told"}
    )
    assert Dataset(copy).spec.robot_type == "told"
    for key, value, words in (
        ("fps", 50, "50 fps,.*info.json 30"),
        (
            "features",
            derived["features"] | {"action": derived["features"]["observation.state"]},
            "action,.*info",
        ),
        (
            "features",
            derived["features"]
            | {
                "observation.state": derived["features"]["observation.state"]
                | {"shape": [4], "names": []}
            },
            r"observation.state is float32 \[4\], but info\.json states float32 \[3\]",
        ),
    ):
        path.write_text(json.dumps(derived | {key: value}))
        with pytest.raises(DatasetError, match=words):
            Dataset(copy)
    without = {
        key: f for key, f in derived["features"].items() if key != "observation.grip"
    }
    path.write_text(json.dumps(derived | {"features": without}))
    assert Dataset(copy).skipped["observation.grip"] == "not in the dataset's own spec"
    assert "observation.grip" not in Dataset(copy).episode(0).arrays


def told_episode(index: int) -> Episode:
    """What ingest knew of the episode that became ``index``."""
    return Episode(
        name=f"run_{index}.mcap",
        spec=None,  # type: ignore[arg-type]  # not part of the record
        start_ns=1_700_000_000_000_000_001 + index,
        arrays={"observation.tactile": np.zeros((LENGTHS[index], 1536), np.int16)},
        pictures=lambda: iter(()),
        picture_keys=(),
        instruction=TASKS[index],
        success=(True, False, None)[index],
        origin=Origin("surrogate", "stand-in, not a robot"),
        timing=(
            ChannelTiming(
                "left_a",
                "observation.tactile",
                "asof",
                100.0,
                2,
                0.05,
                0.004,
                0.011,
                duplicates=3,
            ),
        ),
        baselines={"observation.tactile": np.arange(1536) % 40},
        stages=((0, "reach"), (7, "insert")) if index == 1 else (),
        provenance={"recording": f"/recordings/run_{index}.mcap", "part": None},
    )


def test_what_lerobots_files_cannot_say_survives_in_episodes_json(copy: Path) -> None:
    told = [told_episode(index) for index in range(3)]
    write_provenance(
        copy, "episodes.json", [episode_record(e, f"digest {e.name}") for e in told]
    )
    dataset = Dataset(copy)
    for index, original in enumerate(told):
        found = dataset.episode(index)
        assert found.start_ns == original.start_ns
        assert found.success is original.success
        assert found.origin == original.origin
        assert found.timing == original.timing
        assert found.stages == original.stages
        assert np.array_equal(
            found.baselines["observation.tactile"],
            original.baselines["observation.tactile"],
        )
        assert found.provenance["recording"] == f"/recordings/run_{index}.mcap"
        assert found.provenance["source_digest"] == f"digest run_{index}.mcap"
        assert episode_record(found, f"digest run_{index}.mcap") == episode_record(
            original, f"digest run_{index}.mcap"
        )


def test_records_that_are_not_of_these_episodes_are_refused(copy: Path) -> None:
    records = [episode_record(told_episode(index), "") for index in range(3)]
    path = write_provenance(copy, "episodes.json", records[:2])
    with pytest.raises(
        DatasetError, match=r"lists 2 episodes, 43 rows,.*dataset.*3 episodes, 61 rows"
    ):
        Dataset(copy)
    path.write_text(
        json.dumps([{**records[0], "timing": [{"chanel": "x"}]}, *records[1:]])
    )
    with pytest.raises(
        DatasetError,
        match=r"episodes\.json: not in the form in which taccorl writes it",
    ):
        Dataset(copy)

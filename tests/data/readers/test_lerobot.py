"""LeRobot datasets as recordings: one with our features and touch, one of somebody else's with odd features."""

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml
from by_lerobot import write_described, write_with_lerobot

from taccorl.data.cutting import Cutter
from taccorl.data.dataset import Dataset
from taccorl.data.draft import draft_specs
from taccorl.data.episode import Episode
from taccorl.data.inspection import inspect_source
from taccorl.data.origin import Origin
from taccorl.data.recording import find_sources, opened, readers
from taccorl.data.spec import (
    RecordingSpec,
    data_specs_folder,
    load_dataset_spec,
    load_recording_spec,
)
from taccorl.errors import DatasetError, RecordingError

ROWS = (40, 41)
CAMERAS = ("front", "left_wrist", "right_wrist")
PADS = ("left_a", "left_b", "right_a", "right_b")
BASELINE = 10 + np.arange(1536) % 31
INSTRUCTIONS = ("insert the tube", "take the tube out")


def joints(row: int) -> np.ndarray:
    low = [0.0, 0.5, -0.5, 0, 0, 0, 0.01]
    return np.array([*low, *low], np.float32) + np.float32(row * 1e-3)


def counts(index: int, row: int) -> np.ndarray:
    """(1536,) counts above baseline: at rest for 35 rows, then another one on every taxel."""
    return (
        (np.arange(1536) * 7 + index) % 200 if row >= 35 else np.zeros(1536)
    ).astype(np.int16)


def grey(camera: str, row: int) -> int:
    return 20 + 5 * row if camera == "front" else 240 - 5 * row


def made_episode(index: int) -> Episode:
    spec = load_dataset_spec(data_specs_folder() / "taccorl_bimanual.yaml")
    rows = range(ROWS[index])
    return Episode(
        name=f"run_{index}",
        spec=spec,
        start_ns=0,
        arrays={
            "observation.state": np.stack([joints(k) for k in rows]),
            "action": np.stack([joints(k + 1) for k in rows]),
            "observation.tactile": np.stack([counts(index, k) for k in rows]),
        },
        pictures=lambda: (
            {
                f"observation.images.{c}": np.full((224, 224, 3), grey(c, k), np.uint8)
                for c in CAMERAS
            }
            for k in rows
        ),
        picture_keys=tuple(f"observation.images.{c}" for c in CAMERAS),
        instruction=INSTRUCTIONS[index],
        success=index == 0,
        origin=Origin(text="made in a test"),
        baselines={"observation.tactile": BASELINE},
    )


@pytest.fixture(scope="session")
def ours(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A taccorl dataset of two episodes; read only."""
    return write_described(
        tmp_path_factory.mktemp("ours") / "dataset",
        [made_episode(index) for index in range(2)],
    )


@pytest.fixture(scope="session")
def theirs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Somebody's dataset at 10 rows a second: texts, flags, a shaped array, pictures in the parquet file."""
    rows = [
        {
            "observation.state": np.array([row, -row], np.float32),
            "observation.tactile.left": np.arange(384, dtype=np.float32).reshape(12, 32)
            + row,
            "observation.images.top": np.full((16, 16, 3), row, np.uint8),
            "next.done": np.array([row == 5]),
            "note": f"row {row}",
            "task": "look",
        }
        for row in range(6)
    ]
    root, pictures = (
        tmp_path_factory.mktemp("theirs") / "dataset",
        ["observation.images.top"],
    )
    return write_with_lerobot(
        root, [rows], fps=10, images=pictures, names={"observation.state": ["a", "b"]}
    )


def reader_of(root: Path, index: int = 0, spec: str | None = None) -> Any:
    name, source = find_sources(root)[index]
    assert name == "lerobot"
    return readers.get(name)(source, load_recording_spec(spec) if spec else None)


def values(found: list, topic: str) -> np.ndarray:
    return np.array([m.value for m in found if m.topic == topic])


def test_every_episode_is_a_recording_with_its_files(
    ours: Path, tmp_path: Path
) -> None:
    sources = [source for _, source in find_sources(ours)]
    assert [s.part for s in sources] == ["episode_000000", "episode_000001"]
    assert sources[0].files[0] == ours / "data/chunk-000/file-000.parquet"
    assert len(sources[0].files) == 1 + len(CAMERAS)
    assert all(p.is_file() for s in sources for p in s.files)
    for name in ("one", "two"):
        shutil.copytree(ours, tmp_path / name)
    assert len(find_sources(tmp_path)) == 4  # a folder of datasets


@pytest.mark.parametrize("index", [0, 1])
def test_a_taccorl_dataset_comes_back_row_for_row_through_its_recording_spec(
    ours: Path, index: int
) -> None:
    original = made_episode(index)
    _, source = find_sources(ours)[index]
    with opened(source, load_recording_spec("taccorl_lerobot")) as recording:
        (episode,) = Cutter(recording).cut().episodes
        assert episode.num_rows == ROWS[index]
        for key, expected in original.arrays.items():
            assert np.array_equal(episode.arrays[key], expected), key
        assert np.array_equal(episode.baselines["observation.tactile"], BASELINE)
        assert episode.instruction == INSTRUCTIONS[index]
        assert episode.success is (index == 0)
        assert episode.origin == Origin(text="made in a test")
        for row, shown in enumerate(episode.pictures()):
            for camera in CAMERAS:
                # neighbours differ by 5
                assert (
                    abs(
                        shown[f"observation.images.{camera}"].mean() - grey(camera, row)
                    )
                    <= 2
                )
        assert row == ROWS[index] - 1


def lerobot_spec(lead_frames: int) -> RecordingSpec:
    spec = load_recording_spec("taccorl_lerobot")
    command = dataclasses.replace(spec.channels["command"], lead_frames=lead_frames)
    return dataclasses.replace(spec, channels={**spec.channels, "command": command})


def test_a_command_is_read_as_the_dataset_states_its_time(ours):
    with (
        pytest.raises(
            RecordingError,
            match=r"reached at row k \+ 1 .*action_time next_row\).*it needs 1",
        ),
        opened(find_sources(ours)[0][1], lerobot_spec(0)),
    ):
        pass


def test_a_pads_topic_is_what_the_pad_had_sent(ours: Path) -> None:
    found = list(
        reader_of(ours, 1).messages({f"observation.tactile/{pad}" for pad in PADS})
    )
    for p, pad in enumerate(PADS):
        raw = values(found, f"observation.tactile/{pad}")
        assert raw.shape == (ROWS[1], 384)
        # Row 0 is at rest: the baseline alone. The wire sends 12 rows × 32 columns of the pad's 32 × 12 taxels.
        assert np.array_equal(
            raw[0], BASELINE[p * 384 : (p + 1) * 384].reshape(32, 12).T.ravel()
        )
        touched = (
            (BASELINE + counts(1, 35))[p * 384 : (p + 1) * 384]
            .reshape(32, 12)
            .T.ravel()
        )
        assert np.array_equal(raw[35], touched)


def test_rows_have_the_dataset_grids_times_and_only_the_asked_part_is_decoded(
    ours: Path,
) -> None:
    reader = reader_of(ours)
    front = "observation.images.front"
    times = [m.log_ns for m in reader.messages({front}, stamps_only={front})]
    assert times[:4] == [0, 33_333_333, 66_666_667, 100_000_000]
    part = list(reader.messages({front}, start_ns=times[7], end_ns=times[9]))
    assert [m.log_ns for m in part] == times[7:10]
    assert [round((m.value.mean() - 20) / 5) for m in part] == [7, 8, 9]
    assert (
        len(list(reader.messages(None)))
        == ROWS[0] * len([t for t in reader.topics() if t != "task"]) + 1
    )


def test_features_of_other_peoples_datasets_are_topics_in_their_own_shape(
    theirs: Path,
) -> None:
    reader = reader_of(theirs)
    kinds = reader.topics()
    assert kinds["observation.tactile.left"].shape == (12, 32)
    assert "convert_image_to_video" in kinds["observation.images.top"].undecodable
    assert "timestamp" not in kinds
    found = list(
        reader.messages(
            {
                "observation.tactile.left",
                "next.done",
                "note",
                "task",
                "observation.state",
            }
        )
    )
    assert values(found, "observation.tactile.left").shape == (6, 12, 32)
    assert values(found, "observation.tactile.left")[4, 0, 3] == 7.0
    assert values(found, "next.done").ravel().tolist() == [False] * 5 + [True]
    assert values(found, "note").tolist() == [f"row {k}" for k in range(6)]
    assert [(m.log_ns, m.value) for m in found if m.topic == "task"] == [(0, "look")]
    assert [m.log_ns for m in found if m.topic == "note"] == [
        k * 100_000_000 for k in range(6)
    ]
    assert reader.metadata["episode"] == {
        "instruction": "look"
    }  # nobody said whether it succeeded
    with pytest.raises(
        RecordingError,
        match=r"observation\.images\.top: pictures inside the parquet files",
    ):
        list(reader.messages({"observation.images.top"}))


def with_times(root: Path, copy: Path, stamped_s: list[float]) -> Path:
    shutil.copytree(root, copy)
    data = copy / "data/chunk-000/file-000.parquet"
    table = pq.read_table(data)
    place = table.column_names.index("timestamp")
    pq.write_table(
        table.set_column(place, "timestamp", pa.array(stamped_s, pa.float32())), data
    )
    return copy


def test_times_are_kept_as_stamped_and_deleted_rows_leave_a_gap(
    theirs: Path, tmp_path: Path
) -> None:
    gap = with_times(theirs, tmp_path / "gap", [0.0, 0.1, 0.2, 0.7, 0.8, 0.9])
    assert [m.log_ns // 10**8 for m in reader_of(gap).messages({"note"})] == [
        0,
        1,
        2,
        7,
        8,
        9,
    ]
    odd = with_times(theirs, tmp_path / "odd", [0.0, 0.13, 0.21, 0.34, 0.4, 0.5])
    found = [m.log_ns / 1e9 for m in reader_of(odd).messages({"note"})]
    assert found == pytest.approx([0.0, 0.13, 0.21, 0.34, 0.4, 0.5], abs=1e-6)


def test_a_dataset_that_does_not_open_is_a_recording_error(
    ours: Path, tmp_path: Path
) -> None:
    shutil.copytree(ours, tmp_path / "copy")
    info = tmp_path / "copy/meta/info.json"
    whole = info.read_text()
    info.write_text(whole.replace('"v3.0"', '"v2.1"'))
    with pytest.raises(RecordingError, match=r"v2\.1 dataset,.*v3.*Convert"):
        find_sources(tmp_path / "copy")
    info.write_text(whole)
    (
        tmp_path / "copy/videos/observation.images.front/chunk-000/file-000.mp4"
    ).write_bytes(b"no video")
    with pytest.raises(RecordingError, match=r"file-000\.mp4: is not a video"):
        list(reader_of(tmp_path / "copy").messages({"observation.images.front"}))


def test_a_dataset_without_baselines_gives_the_counts_it_has(
    ours: Path, tmp_path: Path
) -> None:
    shutil.copytree(ours, tmp_path / "copy")
    (tmp_path / "copy/meta/taccorl/episodes.json").unlink()
    (first, *_) = reader_of(tmp_path / "copy").messages({"observation.tactile/left_a"})
    assert not first.value.any()


@pytest.mark.parametrize("how", ["no file", "not in the table"])
def test_a_camera_without_videos_is_missed_only_by_specs_that_read_it(
    ours: Path, tmp_path: Path, how: str
) -> None:
    root, key = shutil.copytree(ours, tmp_path / "d"), "observation.images.front"
    shutil.rmtree(root / "videos" / key)
    if how == "not in the table":  # as taccorl collect --pictures=cache leaves it
        (path,) = (root / "meta/episodes").glob("*/*.parquet")
        table = pq.read_table(path)
        pq.write_table(
            table.drop_columns(
                [n for n in table.column_names if n.startswith(f"videos/{key}/")]
            ),
            path,
        )
    feature = "{dtype: video, shape: [224, 224, 3], unit: rgb8, frame: f, rate_hz: 30, range: [0, 255]}"
    for camera in ("left_wrist", "front"):
        (tmp_path / f"{camera}_data.yaml").write_text(
            f"spec_version: 1\nname: d\nrobot_type: r\nfps: 30\nfeatures:\n  observation.images.{camera}: {feature}\n"
        )
        (tmp_path / f"{camera}.yaml").write_text(
            f"spec_version: 1\ndataset: {camera}_data.yaml\nreader: lerobot\nclock: log\nepisodes: {{by: whole_file}}\n"
            "instruction: {from: topic, topic: task}\n"
            f"channels:\n  c: {{topic: observation.images.{camera}, rate_hz: 30, max_age_s: 0.08}}\n"
            f"features:\n  observation.images.{camera}: {{channels: [c], align: asof}}\n"
        )

    def pictures(camera: str) -> list[Any]:
        (_, source), _ = find_sources(root)
        assert all(file.is_file() for file in source.files)
        reader = readers.get("lerobot")(
            source, load_recording_spec(tmp_path / f"{camera}.yaml")
        )
        return list(reader.messages({f"observation.images.{camera}"}))

    assert len(pictures("left_wrist")) == ROWS[0]
    with pytest.raises(RecordingError, match=r"observation\.images\.front"):
        pictures("front")


def test_drafts_keep_the_names_that_a_dataset_gives_its_joints(
    theirs: Path, ours: Path
) -> None:
    expected = {theirs: ["a", "b"], ours: ["left_joint_1.pos", "left_joint_2.pos"]}
    for root, names in expected.items():
        ((reader, source), *_) = find_sources(root)
        draft = yaml.safe_load(draft_specs(inspect_source(reader, source)).dataset)
        assert draft["features"]["observation.state"]["names"][:2] == names
        assert (
            len(draft["features"]["observation.state"]["names"])
            == draft["features"]["observation.state"]["shape"][0]
        )


@pytest.mark.parametrize(
    "place",
    [
        "../outside/{file_index}.parquet",
        "/outside.parquet",
        "data/../../x.parquet",
        "data/{",
        "data/{chunk_index:>3000000000}.parquet",
        "data/{chunk_index.__class__}.parquet",
    ],
)
def test_a_data_path_that_leads_out_of_the_dataset_is_not_opened(
    ours: Path, tmp_path: Path, place: str
) -> None:
    copy = shutil.copytree(ours, tmp_path / "copy")
    info = json.loads((copy / "meta/info.json").read_text())
    info["data_path"] = place
    (copy / "meta/info.json").write_text(json.dumps(info))
    with pytest.raises(RecordingError, match=r"copy/meta") as caught:
        find_sources(copy)
    if "data/{" in place:  # which is no template of numbers
        assert repr(place) in str(caught.value)
    else:
        assert place in str(caught.value) and "points outside of the dataset" in str(
            caught.value
        )


def test_files_are_compared_with_the_digests_that_a_dataset_holds(
    ours: Path, dataset: Path, tmp_path: Path
) -> None:
    reader = reader_of(ours)
    assert list(reader.messages({"task"}))
    # entries of a store know no places
    assert "no digests" in reader.unprotected and str(ours) not in reader.unprotected
    copy = shutil.copytree(dataset, tmp_path / "copy")
    reader = reader_of(copy)
    assert list(reader.messages({"task"})) and reader.unprotected == ""
    (copy / "meta/stats.json").write_text(
        "{}"
    )  # LeRobot's recompute_stats may have written it
    assert list(reader_of(copy).messages({"task"}))
    for name in ("data/chunk-000/file-000.parquet", "meta/taccorl/episodes.json"):
        content = (copy / name).read_bytes()
        (copy / name).write_bytes(
            content[:100] + bytes([content[100] ^ 1]) + content[101:]
        )
        with pytest.raises(
            RecordingError,
            match=f"{name} is not what was written.*remove that manifest|is not JSON",
        ):
            list(reader_of(copy).messages({"task"}))
        (copy / name).write_bytes(content)


def test_absurd_rates_and_shapes_are_refused_or_left_out(
    ours: Path, tmp_path: Path
) -> None:
    copy = shutil.copytree(ours, tmp_path / "copy")
    shutil.rmtree(copy / "meta/taccorl")
    info = json.loads((copy / "meta/info.json").read_text())
    info["features"]["observation.state"]["shape"] = [10**10]
    (copy / "meta/info.json").write_text(json.dumps(info))
    assert "10,000,000" in Dataset(copy).skipped["observation.state"]
    (copy / "meta/info.json").write_text(json.dumps(info | {"fps": 10**30}))
    with pytest.raises(DatasetError, match="fps 1000000000000000000000000000000"):
        Dataset(copy)


def test_files_of_a_dataset_may_be_links_as_in_the_hubs_cache(
    ours: Path, tmp_path: Path
) -> None:
    copy = shutil.copytree(ours, tmp_path / "snapshots" / "copy")
    path = next((copy / "data").rglob("*.parquet"))
    path.symlink_to(path.rename(tmp_path / "blob"))
    assert len(find_sources(copy)) == 2

"""What inspection measures is what was recorded, and its draft is a spec once its TODOs are replaced."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer

from taccorl.data.inspection import Inventory, TopicSummary, draft_spec, inspect_source
from taccorl.data.recording import Source, TopicType, find_sources
from taccorl.data.spec import data_specs_folder, load_recording_spec
from taccorl.demos.stand_in import (
    CAMERA_TOPICS,
    COMMAND_TOPICS,
    PAD_TOPICS,
    STATE_TOPICS,
    StandInConfig,
    write_cobot_magic_hdf5,
    write_mcap,
)
from taccorl.errors import RecordingError, SpecError

FRONT = CAMERA_TOPICS["front"]
BAGS = Path("/work/shared/data/bags")


def inspect(path: Path) -> Inventory:
    return inspect_source(*find_sources(path)[0])


def topic(inventory: Inventory, name: str) -> TopicSummary:
    [found] = [t for t in inventory.topics if t.topic == name]
    return found


@pytest.fixture(scope="module")
def stand_in(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Any]:
    path = tmp_path_factory.mktemp("stand_in") / "a.mcap"
    config = StandInConfig(duration_s=3.0, camera_size=(96, 128), gap=(FRONT, 1.0, 1.4), clock_offset_s={FRONT: -0.1})
    return path, write_mcap(path, config)


# ---- measured ----


def test_counts_rates_gaps_and_skews_are_those_of_the_recording(stand_in: tuple[Path, Any]) -> None:
    path, truth = stand_in
    found = inspect(path)
    assert len(found.topics) == 15  # 11 channels, the markers, and three that no spec names
    assert found.reader == "mcap"
    assert found.duration_s == pytest.approx(max(t.max() for t in truth.log_s.values()), abs=0.02)
    for name, times_s in truth.log_s.items():
        assert topic(found, name).num_messages == len(times_s)
    assert topic(found, STATE_TOPICS["left"]).rate_hz == pytest.approx(200, rel=1e-6)
    assert topic(found, PAD_TOPICS["left_robot_left_finger"]).rate_hz == pytest.approx(100, rel=0.01)
    front = topic(found, FRONT)
    steps = np.diff(truth.sampled_s[FRONT])
    assert front.longest_gap_s == pytest.approx(steps.max(), abs=1e-6)
    assert steps.max() > 0.4
    assert front.num_gaps == (steps > 1.5 * np.median(steps)).sum()
    # its clock is 0.1 s behind, so its log time is that much more after its stamp
    assert front.skew_s == pytest.approx(np.median(truth.log_s[FRONT] - truth.sampled_s[FRONT]) + 0.1, abs=1e-6)
    assert not front.sim_time


def test_repeated_and_zero_stamps_are_counted(stand_in: tuple[Path, Any]) -> None:
    path, truth = stand_in
    command = topic(inspect(path), COMMAND_TOPICS["right"])
    assert command.zero_stamps == 8  # 0.04 s at 200 Hz
    stamps = truth.sampled_s[COMMAND_TOPICS["right"]][8:]
    assert command.repeated == len(stamps) - len(np.unique(stamps))
    assert topic(inspect(path), STATE_TOPICS["right"]).zero_stamps == 0


def test_simulation_time_is_recognised(tmp_path: Path) -> None:
    write_mcap(tmp_path / "a.mcap", StandInConfig(duration_s=2.0, camera_size=(96, 128), sim_time_stamps=True))
    found = inspect(tmp_path / "a.mcap")
    assert topic(found, FRONT).sim_time
    assert not topic(found, PAD_TOPICS["left_robot_left_finger"]).sim_time, "it has no stamp at all"
    assert "clock: log" in draft_spec(found)


def test_damage_and_metadata_are_told(stand_in: tuple[Path, Any], tmp_path: Path) -> None:
    data = stand_in[0].read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) * 2 // 3])
    found = inspect(tmp_path / "cut.mcap")
    assert "without a footer" in found.damage[0].reason
    assert found.metadata["taccorl"]["origin"] == "surrogate stand-in, not a robot"
    assert 0 < topic(found, FRONT).num_messages < 80


def test_an_empty_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").touch()
    with pytest.raises(RecordingError, match="is empty"):
        inspect(tmp_path / "a.mcap")


# ---- which shipped spec fits ----


def test_a_shipped_spec_fits_only_with_its_types_and_its_markers(tmp_path: Path) -> None:
    small: dict[str, Any] = {"duration_s": 2.0, "camera_size": (96, 128)}
    write_mcap(tmp_path / "ros2.mcap", StandInConfig(**small))
    write_mcap(tmp_path / "json.mcap", StandInConfig(**small, encoding="json"))
    write_mcap(tmp_path / "unmarked.mcap", StandInConfig(**small, gap=("/episode", 0.0, 9.0)))
    write_cobot_magic_hdf5(tmp_path / "a.hdf5", StandInConfig(**small))
    assert inspect(tmp_path / "ros2.mcap").fits == ("piper_flexitac_mcap",)
    assert inspect(tmp_path / "json.mcap").fits == (), "its pictures are foxglove.CompressedImage"
    assert inspect(tmp_path / "unmarked.mcap").fits == (), "the spec wants /episode"
    assert inspect(tmp_path / "a.hdf5").fits == ("cobot_magic_hdf5",)


# ---- the draft ----


def fill_in(draft: str) -> str:
    """As a person would who knows the robot: every TODO replaced, no other line touched."""
    features = {
        "observation.state": "joint_states_left, joint_states_right",
        "action": "joint_states_ctrl_left, joint_states_ctrl_right",
        "observation.images.front": "camera_f",
        "observation.images.left_wrist": "camera_l",
        "observation.images.right_wrist": "camera_r",
        "observation.tactile": ", ".join(PAD_TOPICS[pad].strip("/") for pad in PAD_TOPICS),
    }
    draft = draft.replace("text: TODO", "text: insert the tube")
    draft = draft.replace("pick: [TODO]", "pick: [joint1, joint2, joint3, joint4, joint5, joint6, gripper]")
    for key, channels in features.items():
        for todo in ("[TODO, TODO, TODO, TODO]", "[TODO]"):
            draft = draft.replace(f"  {key}: {{channels: {todo}", f"  {key}: {{channels: [{channels}]")
    assert "TODO," not in draft and "[TODO" not in draft
    return draft


@pytest.mark.parametrize("encoding", ["ros2", "json", "protobuf"])
def test_a_draft_with_its_todos_replaced_is_a_spec_that_reads_the_recording(encoding: Any, tmp_path: Path) -> None:
    from taccorl.data.cutting import open_episodes

    path = tmp_path / "a.mcap"
    truth = write_mcap(path, StandInConfig(duration_s=2.5, camera_size=(96, 128), encoding=encoding))
    (tmp_path / "mine.yaml").write_text(fill_in(draft_spec(inspect(path), tmp_path)))
    spec = load_recording_spec(tmp_path / "mine.yaml")
    assert spec.clock == "header" and spec.clock_of("left_robot_left_finger") == "log"
    with open_episodes(path, spec) as episodes:
        [episode] = episodes
        assert episode.num_rows > 70
        at_s = episode.start_ns * 1e-9 - 1_780_000_000 + np.arange(episode.num_rows) / 30
        error = np.abs(episode.arrays["observation.state"] - truth.story.state(at_s))
        assert np.median(error) < 0.005 and np.ptp(episode.arrays["observation.state"], axis=0).max() > 0.3


def test_a_draft_is_no_spec_before_its_todos_are_replaced(stand_in: tuple[Path, Any], tmp_path: Path) -> None:
    draft = draft_spec(inspect(stand_in[0]), tmp_path)
    (tmp_path / "draft.yaml").write_text(draft)
    with pytest.raises(SpecError, match="TODO"):
        load_recording_spec(tmp_path / "draft.yaml")
    (tmp_path / "forgotten.yaml").write_text(fill_in(draft).replace("insert the tube", "TODO"))
    with pytest.raises(SpecError, match=r"forgotten.yaml:8: instruction → text: is empty or still to do"):
        load_recording_spec(tmp_path / "forgotten.yaml")


def test_a_draft_names_a_dataset_spec_that_is_there_wherever_it_lies(
    stand_in: tuple[Path, Any], tmp_path: Path
) -> None:
    found = inspect(stand_in[0])
    there = data_specs_folder() / "recordings"
    assert "dataset: ../taccorl_bimanual.yaml " in draft_spec(found)
    assert "dataset: ../taccorl_bimanual.yaml " in draft_spec(found, there)
    assert f"dataset: {data_specs_folder()}/taccorl_bimanual.yaml " in draft_spec(found, tmp_path)


def _bag(path: Path, topics: dict[str, str]) -> Path:
    """JSON topics of these types, three messages each."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        for name, kind in topics.items():
            schema = writer.register_schema(kind, "jsonschema", b'{"type": "object"}')
            channel = writer.register_channel(name, "json", schema)
            for k in range(3):
                writer.add_message(channel, 10**18 + k * 10**7, json.dumps({"data": [1.0]}).encode(), publish_time=0)
        writer.finish()
    return path


def test_topics_with_like_or_odd_names_get_channel_names_of_their_own(tmp_path: Path) -> None:
    import yaml

    names = {
        "/cam/image_raw": "sensor_msgs/Image",
        "/cam/color/image_raw/compressed": "sensor_msgs/CompressedImage",
        "/cam/compressed": "sensor_msgs/CompressedImage",
        "/cam-1": "sensor_msgs/Image",
        "/cam.1": "sensor_msgs/Image",
        "/a, b: {c} #d": "std_msgs/Float64MultiArray",
        "123": "std_msgs/Float64MultiArray",
        "true": "std_msgs/Float64MultiArray",
        "/": "std_msgs/Float64MultiArray",
        "/tätig/😀": "std_msgs/Float64MultiArray",
    }
    draft = yaml.safe_load(draft_spec(inspect(_bag(tmp_path / "a.mcap", names))))
    channels = draft["channels"]
    assert {c["topic"] for c in channels.values()} == set(names)
    assert len(channels) == len(names)
    assert all(isinstance(name, str) and name[0].isalpha() for name in channels)
    assert {c["type"] for c in channels.values()} == set(names.values())


def test_a_file_that_names_no_rate_leaves_it_to_the_user(tmp_path: Path) -> None:
    write_cobot_magic_hdf5(tmp_path / "a.hdf5", StandInConfig(duration_s=2.0, camera_size=(96, 128)))
    draft = draft_spec(inspect(tmp_path / "a.hdf5"))
    assert "observations_qpos: {topic: /observations/qpos, rate_hz: TODO, max_age_s: TODO}" in draft
    assert "one of observations_images_cam_high, observations_images_cam_left_wrist" in draft


def test_what_cannot_be_decoded_is_named_once(stand_in: tuple[Path, Any]) -> None:
    [odd] = [t for t in inspect(stand_in[0]).topics if t.type.undecodable]
    assert odd.topic == "/enable_srv/_service_event"
    assert odd.problem.count(odd.topic) == 1
    nameless = TopicSummary("/x", TopicType("|V4", "hdf5", "not read"), 1, 0, 0, 0.0, 0.0, 0, False, 0.0, 0.0, 0, 0)
    assert nameless.problem == "/x: not read"
    inventory = Inventory(Source(Path("a\nb.h5"), ()), "hdf5", (nameless,), {}, ())
    assert "  # not used: /x: not read" in draft_spec(inventory)
    assert draft_spec(inventory).startswith("# Draft from a b.h5: ")


@pytest.mark.skipif(not BAGS.is_dir(), reason="other people's bags are not here")
def test_every_draft_of_other_peoples_bags_is_yaml() -> None:
    import yaml

    folders = [p for p in sorted(BAGS.rglob("*")) if p.is_dir()]
    drafts = 0
    for folder in folders:
        try:
            sources = find_sources(folder)
        except RecordingError:
            continue  # a folder of folders
        for name, source in sources:
            draft = yaml.safe_load(draft_spec(inspect_source(name, source)))
            assert {"dataset", "reader", "channels", "features"} <= set(draft)
            drafts += 1
    assert drafts >= 8

"""What inspection measures is what was recorded, and drafts are specs once their TODOs are replaced as the comments say."""

import base64
import json
import re
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest
import yaml
from edited import rewrite
from mcap.writer import Writer
from mcap_ros2.writer import Writer as Ros2Writer

from taccorl.cli.main import main
from taccorl.data.dataset import Dataset
from taccorl.data.draft import Drafts, draft_specs
from taccorl.data.inspection import Inventory, TopicSummary, inspect_source
from taccorl.data.recording import Source, TopicType, find_sources
from taccorl.data.spec import load_recording_spec
from taccorl.errors import SpecError
from taccorl.surrogate.drivers import (
    CAMERA_TOPICS,
    COMMAND_TOPICS,
    PAD_TOPICS,
    STATE_TOPICS,
)
from tests.recordings.ros_messages import JOINT_STATE, PICTURE
from tests.recordings.stand_in import StandInConfig, write_cobot_magic_hdf5, write_mcap

START_NS = 1_780_000_000 * 10**9
JOINTS = [f"panda_joint{k}" for k in range(1, 8)]
PIXEL = base64.b64encode(
    cv2.imencode(".png", np.zeros((1, 1, 3), np.uint8))[1].tobytes()
).decode()


def drafted(path: Path, name: str = "mine.yaml") -> Drafts:
    return draft_specs(inspect_source(*find_sources(path)[0]), Path(name))


def one_arm(
    path: Path,
    command: str = "/arm/joint_command",
    duration_s: float = 4.0,
    pictures: bool = True,
) -> Path:
    """A seven-joint arm, with one camera if ``pictures``, as its ROS 2 drivers write it: joints at 100 Hz, JPEG at 15 Hz."""
    with path.open("wb") as file:
        writer = Ros2Writer(file)
        joints = writer.register_msgdef("sensor_msgs/msg/JointState", JOINT_STATE)
        jpeg = writer.register_msgdef("sensor_msgs/msg/CompressedImage", PICTURE)
        for k in range(round(duration_s * 100)):
            time_ns = START_NS + k * 10**7
            header = {
                "stamp": {"sec": time_ns // 10**9, "nanosec": time_ns % 10**9},
                "frame_id": "",
            }
            for topic, lag in (("/arm/joint_states", 0.1), (command, 0.0)):
                position = [0.3 * np.sin(k / 100 + j - lag) for j in range(7)]
                message = {
                    "header": header,
                    "name": JOINTS,
                    "position": position,
                    "velocity": [],
                    "effort": [],
                }
                writer.write_message(topic, joints, message, time_ns + 10**6, time_ns)
            if pictures and k % 7 == 0:
                image = (
                    np.random.default_rng(k)
                    .integers(0, 255, (12, 16, 3), np.uint8)
                    .repeat(10, 0)
                    .repeat(10, 1)
                )
                data = cv2.imencode(".jpg", image)[1].tobytes()
                message = {"header": header, "format": "jpeg", "data": data}
                writer.write_message(
                    "/wrist/image_raw/compressed",
                    jpeg,
                    message,
                    time_ns + 10**6,
                    time_ns,
                )
        writer.finish()
    return path


def fill_in(folder: Path, **values: str) -> None:
    """The first thing that the comment behind each TODO proposes, no other line touched."""
    written = {
        "text": "pick up the cup",
        "unit": "rad",
        "range": "[-3.14, 3.14]",
        **values,
    }
    for path in folder.glob("mine*.yaml"):
        text = re.sub(
            r"(\w+): (\[?)TODO(?=\b)",
            lambda m: f"{m[1]}: {m[2]}{written[m[1]]}",
            path.read_text(),
        )
        path.write_text(text)
        assert "TODO" not in "".join(line.split("#")[0] for line in text.splitlines())


def inspect_and_ingest(recording: Path, folder: Path, **values: str) -> Dataset:
    assert (
        main(["ingest", "inspect", str(recording), f"--draft={folder / 'mine.yaml'}"])
        == 0
    )
    fill_in(folder, **values)
    words = [
        str(recording),
        f"--spec={folder / 'mine.yaml'}",
        f"--out={folder / 'out'}",
        f"--store={folder / 'store'}",
    ]
    assert main(["ingest", *words]) == 0
    return Dataset(folder / "out")


def test_a_robot_with_one_arm_and_one_camera_is_ingested_by_its_drafts(
    tmp_path, capsys
):
    dataset = inspect_and_ingest(one_arm(tmp_path / "a.mcap"), tmp_path)
    printed = capsys.readouterr().out
    assert f"names of /arm/joint_states: {', '.join(JOINTS)}" in printed
    assert f"and of its dataset: {tmp_path / 'mine_dataset.yaml'}" in printed
    assert set(dataset.spec.features) == {
        "observation.state",
        "action",
        "observation.images.wrist",
    }
    assert dataset.spec.features["action"].names == tuple(
        f"{name}.pos" for name in JOINTS
    )
    assert dataset.spec.features["observation.images.wrist"].shape == (224, 224, 3)
    assert dataset.spec.fps == 14  # 100 / 7 pictures a second
    episode = dataset.episode(0)
    at_s = (episode.start_ns - START_NS) * 1e-9 + np.arange(episode.num_rows) / 14
    assert episode.num_rows > 50
    for key, lag in (
        ("observation.state", 0.1),
        ("action", -1 / 14),
    ):  # an action is reached at the next row
        expected = 0.3 * np.sin(at_s[:, None] + np.arange(7) - lag)
        # the newest sample may be 10 ms old, and 0.3 rad/s is the fastest
        assert np.abs(episode.arrays[key] - expected).max() < 0.3 * 0.011


def test_without_pictures_rows_are_as_frequent_as_the_positions(tmp_path: Path) -> None:
    dataset = inspect_and_ingest(
        one_arm(tmp_path / "a.mcap", duration_s=2.0, pictures=False), tmp_path
    )
    assert dataset.spec.fps == 100  # and not 30, which would leave out two of three
    assert 190 <= dataset.episode(0).num_rows <= 200


@pytest.mark.parametrize("chosen", ["teach_values", "arm_joint_states"])
def test_without_a_topic_named_as_a_command_the_user_chooses(
    chosen: str, tmp_path: Path
) -> None:
    path = one_arm(tmp_path / "a.mcap", command="/teach/values", duration_s=0.5)
    assert (
        main(["ingest", "inspect", str(path), f"--draft={tmp_path / 'mine.yaml'}"]) == 0
    )
    text = (tmp_path / "mine.yaml").read_text()
    [action] = [line for line in text.splitlines() if line.startswith("  action:")]
    assert action.endswith(
        "# no topic is named as a command: teach_values (uncomment it above), or arm_joint_states, as measured"
    )
    if chosen == "teach_values":
        text = text.replace("  # teach_values: ", "  teach_values: ")
    (tmp_path / "mine.yaml").write_text(text)
    fill_in(tmp_path, channels=chosen)
    spec = load_recording_spec(tmp_path / "mine.yaml")
    assert spec.features["action"].channels == (chosen,)
    assert spec.features["observation.state"].channels == ("arm_joint_states",)


def test_two_arms_with_pads_are_drafted_and_ingested_with_touch(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write_mcap(path, StandInConfig(duration_s=2.5, camera_size=(96, 128)))
    dataset = inspect_and_ingest(path, tmp_path)
    assert (
        dataset.num_rows(0) > 60
        and np.abs(dataset.episode(0).arrays["observation.tactile"]).max() > 30
    )
    spec = load_recording_spec(tmp_path / "mine.yaml")
    names = spec.target.features["observation.state"].names
    assert (names[0], names[13], len(names)) == (
        "left_joint1.pos",
        "right_gripper.pos",
        14,
    )
    assert spec.target.features["action"].names == names
    assert spec.target.features["observation.tactile"].size == 4 * 32 * 12
    assert spec.target.sensors["observation.tactile"].name == "flexitac_v2"
    assert spec.channels["joint_states_ctrl_left"].pick[-1] == "gripper"
    assert spec.clock == "header" and spec.clock_of("left_robot_left_finger") == "log"


def test_a_file_that_names_no_rate_leaves_it_to_the_user(tmp_path: Path) -> None:
    path = tmp_path / "a.hdf5"
    write_cobot_magic_hdf5(path, StandInConfig(duration_s=2.0, camera_size=(96, 128)))
    drafts = drafted(path)
    assert (
        "qpos: {topic: /observations/qpos, rate_hz: TODO, max_age_s: TODO}"
        in drafts.recording
    )
    dataset = inspect_and_ingest(
        path, tmp_path, rate_hz="30", max_age_s="0.08", fps="30"
    )
    assert {
        k: f.size for k, f in dataset.spec.features.items() if f.dtype != "video"
    } == {
        "observation.state": 14,
        "action": 14,  # not with the mobile base's
    }
    assert "observation.images.cam_high" in dataset.spec.features


def test_drafts_are_no_spec_before_their_todos_are_replaced(tmp_path: Path) -> None:
    path = one_arm(tmp_path / "a.mcap", duration_s=0.5)
    drafts = drafted(path)
    (tmp_path / "mine.yaml").write_text(drafts.recording)
    (tmp_path / "mine_dataset.yaml").write_text(drafts.dataset)
    with pytest.raises(SpecError, match=r"mine_dataset.yaml:\d+: .*'TODO'") as raised:
        load_recording_spec(tmp_path / "mine.yaml")
    todo = {
        n
        for n, line in enumerate(drafts.dataset.splitlines(), 1)
        if ": TODO" in line.split("#")[0]
    }
    assert {
        int(n) for n in re.findall(r"\d+", str(raised.value).split("yaml", 1)[1])
    } == todo, "all of them at once"
    fill_in(tmp_path, unit="TODO".lower())
    with pytest.raises(SpecError, match=r"unit: 'todo' is not a unit"):
        load_recording_spec(tmp_path / "mine.yaml")


def _bag(path: Path, topics: dict[str, str], numbers: Any = (1.0,)) -> Path:
    """JSON topics of these types, three messages each."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        for name, kind in topics.items():
            schema = writer.register_schema(kind, "jsonschema", b'{"type": "object"}')
            channel = writer.register_channel(name, "json", schema)
            data = PIXEL if "Image" in kind else list(numbers)
            for k in range(3):
                writer.add_message(
                    channel,
                    10**18 + k * 10**7,
                    json.dumps({"data": data}).encode(),
                    publish_time=0,
                )
        writer.finish()
    return path


def test_topics_with_like_or_odd_names_get_channel_names_of_their_own(
    tmp_path: Path,
) -> None:
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
    drafts = drafted(_bag(tmp_path / "a.mcap", names))
    text = re.sub(
        r"^  # (?!not used)", "  ", drafts.recording, flags=re.MULTILINE
    )  # those that are spare as well
    draft = yaml.safe_load(text)
    channels = draft["channels"]
    assert {c["topic"] for c in channels.values()} == set(names)
    assert len(channels) == len(names)
    assert all(isinstance(name, str) and name[0].isalpha() for name in channels)
    assert {c["type"] for c in channels.values()} == set(names.values())


def _counts(path: Path, arrays: dict[str, np.ndarray]) -> Path:
    """HDF5 datasets of three equal rows each, beside joints."""
    with h5py.File(path, "w") as file:
        file["/observations/qpos"] = np.zeros((3, 2))
        for name, row in arrays.items():
            file[name] = np.stack([row] * 3)
    return path


def test_touch_in_json_is_drafted(tmp_path: Path) -> None:
    path = _bag(
        tmp_path / "a.mcap",
        {"/left_finger": "std_msgs/UInt8MultiArray"},
        numbers=[7] * 384,
    )
    touch = yaml.safe_load(drafted(path).dataset)["features"]["observation.tactile"]
    assert (touch["shape"], touch["pads"]) == (
        [384],
        ["left_finger"],
    ) and "flexitac_v2" in touch["sensor"]


def test_pads_that_no_shipped_sensor_fits_get_a_sensor_file_with_what_is_known(
    tmp_path: Path,
) -> None:
    arrays = {
        "/tactile/a": np.zeros((5, 8), np.uint16),
        "/tactile/b": np.zeros((5, 8), np.uint16),
    }
    drafts = drafted(
        _counts(
            tmp_path / "a.hdf5", arrays | {"/tactile/other": np.zeros(7, np.uint16)}
        )
    )
    sensor = yaml.safe_load(drafts.sensor)
    assert (sensor["rows"], sensor["columns"], sensor["wire"]["dtype"]) == (
        5,
        8,
        "uint16",
    )
    assert (
        sensor["adc_bits"]
        == sensor["noise_count"]
        == sensor["gain_per_count"]
        == "TODO"
    )
    touch = yaml.safe_load(drafts.dataset)["features"]["observation.tactile"]
    assert (touch["shape"], touch["pads"], touch["sensor"]) == (
        [80],
        ["tactile_a", "tactile_b"],
        "mine_sensor.yaml",
    )
    assert (
        "# not used: /tactile/other: 7 counts of uint16" in drafts.recording
    )  # another kind than the first


def test_counts_under_a_topic_that_is_not_named_as_touch_are_named_and_left_out(
    tmp_path: Path,
) -> None:
    drafts = drafted(
        _counts(tmp_path / "a.hdf5", {"/board/adc": np.zeros(32, np.uint8)})
    )
    assert not drafts.sensor and "observation.tactile" not in drafts.dataset
    assert "# not used: /board/adc: 32 counts of uint8" in drafts.recording


FRONT = CAMERA_TOPICS["front"]


def inspect(path: Path) -> Inventory:
    return inspect_source(*find_sources(path)[0])


def topic(inventory: Inventory, name: str) -> TopicSummary:
    [found] = [t for t in inventory.topics if t.topic == name]
    return found


@pytest.fixture(scope="module")
def stand_in(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Any]:
    path = tmp_path_factory.mktemp("stand_in") / "a.mcap"
    config = StandInConfig(
        duration_s=3.0,
        camera_size=(96, 128),
        gap=(FRONT, 1.0, 1.4),
        clock_offset_s={FRONT: -0.1},
    )
    return path, write_mcap(path, config)


# ---- measured ----


def test_counts_rates_gaps_skews_and_repeats_are_those_of_the_recording(
    stand_in: tuple[Path, Any],
) -> None:
    path, truth = stand_in
    found = inspect(path)
    assert (
        len(found.topics) == 15
    )  # 11 channels, the markers, and three that no spec names
    assert found.reader == "mcap"
    assert found.duration_s == pytest.approx(
        max(t.max() for t in truth.log_s.values()), abs=0.02
    )
    for name, times_s in truth.log_s.items():
        assert topic(found, name).num_messages == len(times_s)
    assert topic(found, STATE_TOPICS["left"]).rate_hz == pytest.approx(200, rel=1e-6)
    assert topic(found, PAD_TOPICS["left_robot_left_finger"]).rate_hz == pytest.approx(
        100, rel=0.01
    )
    front = topic(found, FRONT)
    steps = np.diff(truth.sampled_s[FRONT])
    assert (
        front.longest_gap_s == pytest.approx(steps.max(), abs=1e-6)
        and steps.max() > 0.4
    )
    assert front.num_gaps == (steps > 1.5 * np.median(steps)).sum()
    # its clock is 0.1 s behind, so its log time is that much more after its stamp
    assert front.skew_s == pytest.approx(
        np.median(truth.log_s[FRONT] - truth.sampled_s[FRONT]) + 0.1, abs=1e-6
    )
    assert not front.sim_time

    command = topic(found, COMMAND_TOPICS["right"])
    assert command.zero_stamps == 8  # 0.04 s at 200 Hz
    stamps = truth.sampled_s[COMMAND_TOPICS["right"]][8:]
    assert command.repeated == len(stamps) - len(np.unique(stamps))
    assert topic(found, STATE_TOPICS["right"]).zero_stamps == 0


# ---- which shipped spec fits ----


def test_a_shipped_spec_fits_only_with_its_types_and_its_markers(
    tmp_path: Path,
) -> None:
    small: dict[str, Any] = {"duration_s": 2.0, "camera_size": (96, 128)}
    write_mcap(tmp_path / "ros2.mcap", StandInConfig(**small))
    types = {FRONT: "foxglove_msgs/msg/CompressedImage"}
    rewrite(tmp_path / "ros2.mcap", tmp_path / "foxglove.mcap", list, types=types)
    write_mcap(
        tmp_path / "unmarked.mcap", StandInConfig(**small, gap=("/episode", 0.0, 9.0))
    )
    write_cobot_magic_hdf5(tmp_path / "a.hdf5", StandInConfig(**small))
    assert inspect(tmp_path / "ros2.mcap").fits == ("piper_flexitac_mcap",)
    assert inspect(tmp_path / "foxglove.mcap").fits == (), (
        "its pictures are foxglove's CompressedImage"
    )
    assert inspect(tmp_path / "unmarked.mcap").fits == (), "the spec wants /episode"
    assert inspect(tmp_path / "a.hdf5").fits == ("cobot_magic_hdf5",)


def test_what_cannot_be_decoded_is_named_once(stand_in: tuple[Path, Any]) -> None:
    [odd] = [t for t in inspect(stand_in[0]).topics if t.type.undecodable]
    assert odd.topic == "/enable_srv/_service_event"
    assert odd.problem.count(odd.topic) == 1
    nameless = TopicSummary(
        "/x",
        TopicType("|V4", "hdf5", "not read"),
        1,
        0,
        0,
        0.0,
        0.0,
        0,
        False,
        0.0,
        0.0,
        0,
        0,
    )
    assert nameless.problem == "/x: not read"
    inventory = Inventory(Source(Path("a\nb.h5"), ()), "hdf5", (nameless,), {}, ())
    assert "  # not used: /x: not read" in draft_specs(inventory).recording
    assert draft_specs(inventory).recording.startswith(r"# Draft from a\nb.h5: ")


def json_recording(path: Path, layout: list[int]) -> Path:
    """JSON messages of types of one's own: joints, their targets, JPEG in base64, and 64 whole numbers with a layout."""
    sizes = [{"label": "axis", "size": n, "stride": 64} for n in layout]
    rng = np.random.default_rng(0)
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channels = {
            topic: writer.register_channel(
                topic,
                "json",
                writer.register_schema(kind, "jsonschema", b'{"type": "object"}'),
            )
            for topic, kind in (
                ("/arm/state", "MyJoints"),
                ("/arm/target", "MyJoints"),
                ("/pad/left", "Pad"),
                ("/cam/front", "Shot"),
            )
        }
        for k in range(120):
            joints = {"name": ["pan", "lift"], "position": [k / 100, -k / 200]}
            counts = {
                "layout": {"dim": sizes},
                "data": rng.integers(0, 900, 64).tolist(),
            }
            sent = {
                "/arm/state": joints,
                "/arm/target": joints,
                "/pad/left": counts,
                "/cam/front": {"format": "png", "data": PIXEL},
            }
            for topic, message in sent.items():
                at = START_NS + k * 10_000_000
                data = json.dumps(message).encode()
                writer.add_message(
                    channels[topic], log_time=at, publish_time=at, data=data
                )
        writer.finish()
    return path


@pytest.mark.parametrize(
    ("layout", "shape"),
    [([4, 16], (4, 16)), ([8, 8], (8, 8)), ([], (64,)), ([4, 4], (64,))],
)
def test_types_of_ones_own_are_drafted_by_their_fields(layout, shape, tmp_path):
    ((reader, source),) = find_sources(json_recording(tmp_path / "a.mcap", layout))
    inventory = inspect_source(reader, source)
    of = {t.topic: t for t in inventory.topics}
    assert of["/arm/state"].names == of["/arm/target"].names == ("pan", "lift")
    assert of["/pad/left"].counts == ("uint16", shape)
    assert of["/cam/front"].is_picture and not of["/cam/front"].problem
    recording = yaml.safe_load(draft_specs(inventory).recording)
    assert recording["features"] == {
        "observation.state": {"channels": ["arm_state"], "align": "asof"},
        "action": {"channels": ["arm_target"], "align": "asof"},
        "observation.images.cam_front": {"channels": ["cam_front"], "align": "asof"},
        "observation.tactile": {"channels": ["pad_left"], "align": "asof"},
    }


def test_what_is_like_nothing_is_not_drafted(tmp_path):
    """A battery's state is neither a joint nor a picture, nor an array."""
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("Battery", "jsonschema", b'{"type": "object"}')
        channel = writer.register_channel("/battery", "json", schema)
        for k in range(5):
            data = json.dumps({"voltage": 24.0, "data": None, "name": "main"}).encode()
            writer.add_message(
                channel, log_time=START_NS + k, publish_time=START_NS + k, data=data
            )
        writer.finish()
    ((reader, source),) = find_sources(path)
    (topic,) = inspect_source(reader, source).topics
    assert (topic.like, topic.names, topic.num_values) == ("", (), None)

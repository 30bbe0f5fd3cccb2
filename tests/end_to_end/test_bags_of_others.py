"""Bags written by other people's tools, through the real commands. They lie beside the project and are never copied."""

import json
from pathlib import Path

import numpy as np
import pytest

from taccorl.cli.main import main
from taccorl.data.dataset import Dataset

BAGS = Path(__file__).resolve().parents[3] / "shared" / "data" / "bags"
pytestmark = pytest.mark.skipif(
    not BAGS.is_dir(), reason=f"no bags of others at {BAGS}"
)

DATASET_SPEC = """
spec_version: 1
name: imu_and_pose
robot_type: somebody_elses
fps: 20
action_time: next_row
features:
  observation.state: {dtype: float32, shape: [3], names: [wx, wy, wz], unit: rad/s, frame: imu, rate_hz: 25, range: [-1000, 1000]}
  action:            {dtype: float32, shape: [3], names: [x, y, z], unit: m, frame: world, rate_hz: 25, range: [-1000, 1000]}
"""
RECORDING_SPEC = """
spec_version: 1
dataset: imu_and_pose.yaml
reader: db3
clock: header
episodes: {by: whole_file, min_s: 1.0}
instruction: {from: spec, text: wave the sensor}
channels:
  wx: {topic: /imu, type: sensor_msgs/msg/Imu, field: angular_velocity.x, rate_hz: 25, max_age_s: 0.1}
  wy: {topic: /imu, type: sensor_msgs/msg/Imu, field: angular_velocity.y, rate_hz: 25, max_age_s: 0.1}
  wz: {topic: /imu, type: sensor_msgs/msg/Imu, field: angular_velocity.z, rate_hz: 25, max_age_s: 0.1}
  x:  {topic: /pose, type: geometry_msgs/msg/PoseStamped, field: pose.position.x, rate_hz: 25, max_age_s: 0.1}
  y:  {topic: /pose, type: geometry_msgs/msg/PoseStamped, field: pose.position.y, rate_hz: 25, max_age_s: 0.1}
  z:  {topic: /pose, type: geometry_msgs/msg/PoseStamped, field: pose.position.z, rate_hz: 25, max_age_s: 0.1}
features:
  observation.state: {channels: [wx, wy, wz], align: asof}
  action:            {channels: [x, y, z], align: asof}
"""
IMU = "plotjuggler_imu_db3"


@pytest.mark.parametrize(
    ("name", "words"),
    [
        (
            "rosbag2_tests_mcap/bag_with_topics_and_service_events",
            ("/test_topic1", "/test_service1/_service_event"),
        ),
        ("rosbag2_tests_mcap/cdr_test", ("/array_topic", "/test_topic")),
        ("rosbag2_tests_mcap/wrong_rmw_test", ("/array_topic", "wrong_format")),
        ("rosbag2_wbag_split", ("AAA", "HHH")),
        ("rosbag2_seek_db3", ("topic1", "test_msgs/BasicTypes")),
        (IMU, ("/imu", "/battery", "/pose")),
    ],
)
def test_inspect_describes_every_one(
    name: str, words: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["ingest", "inspect", str(BAGS / name)]) == 0
    printed = capsys.readouterr().out
    for word in (*words, "reader:"):
        assert word in printed
    assert max(map(len, printed.splitlines())) < 1000, "no page of settings in one line"


def test_a_real_imu_bag_becomes_a_dataset_with_its_own_values(tmp_path: Path) -> None:
    (tmp_path / "imu_and_pose.yaml").write_text(DATASET_SPEC)
    spec = tmp_path / "imu.yaml"
    spec.write_text(RECORDING_SPEC)
    out = tmp_path / "out"
    words = [
        "ingest",
        str(BAGS / IMU),
        f"--spec={spec}",
        f"--out={out}",
        f"--store={tmp_path / 'store'}",
    ]
    code = main(words)
    report = json.loads((tmp_path / "out.ingest_report.json").read_text())
    entry = report["recordings"][0]
    assert (code, entry["outcome"]) == (0, "written"), entry["reason"]
    episode = Dataset(out).episode(0)
    assert episode.num_rows == pytest.approx(62.56 * 20, abs=4)
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    with AnyReader([BAGS / IMU], default_typestore=get_typestore(Stores.LATEST)) as bag:
        found = [
            (m.header.stamp.sec * 10**9 + m.header.stamp.nanosec, m.angular_velocity.z)
            for c, _, raw in bag.messages(
                [c for c in bag.connections if c.topic == "/imu"]
            )
            for m in [bag.deserialize(raw, c.msgtype)]
        ]
    stamps, values = np.array([s for s, _ in found]), np.array([v for _, v in found])
    for row in (0, 17, episode.num_rows - 1):
        at = episode.start_ns + round(row * 1e9 / 20)
        newest = np.searchsorted(stamps, at, side="right") - 1
        assert episode.arrays["observation.state"][row, 2] == pytest.approx(
            values[newest], rel=1e-6
        )

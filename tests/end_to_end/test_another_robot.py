"""A robot that the project does not know: five joints and a gripper, one camera, two pads of 16 × 16. Two YAML files and a sensor
file, drafted from its recording, bring it from the recording to an action of the tactile policy; no Python names it."""

import os
import re
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from mcap_ros2.writer import Writer

from taccorl.cli.main import main
from taccorl.data.dataset import Dataset
from tests.recordings.ros_messages import JOINT_STATE, PICTURE

START_NS = 1_780_000_000 * 10**9
NAMES = ["base", "shoulder", "elbow", "wrist_pitch", "wrist_roll", "gripper"]
DURATION_S = 3.0
REST_COUNT, PEAK_COUNT = 12, 150
COUNTS = """std_msgs/MultiArrayLayout layout
uint8[] data
===
MSG: std_msgs/MultiArrayLayout
std_msgs/MultiArrayDimension[] dim
uint32 data_offset
===
MSG: std_msgs/MultiArrayDimension
string label
uint32 size
uint32 stride
"""


def joints(time_s: float) -> np.ndarray:
    """(6,) [rad, m]: the gripper closes from 1 s on, and holds from 2 s on."""
    opening_m = 0.04 - 0.03 * np.clip(time_s - 1.0, 0.0, 1.0)
    return np.append(0.4 * np.sin(1.2 * time_s + np.arange(5)), opening_m)


def touch(time_s: float) -> np.ndarray:
    """(16, 16) counts of both pads: a bump at row 4, column 10 that grows while the gripper closes below 20 mm."""
    rows, columns = np.mgrid[:16, :16]
    press = np.clip((0.02 - joints(time_s)[5]) / 0.01, 0.0, 1.0)
    return np.round(
        REST_COUNT
        + PEAK_COUNT * press * np.exp(-((rows - 4) ** 2 + (columns - 10) ** 2) / 8.0)
    )


def record(path: Path) -> Path:
    """Joints and commands at 100 Hz (the robot 50 ms behind), pads at 50 Hz without a header, JPEG at 30 Hz."""
    messages = []
    for k in range(round(DURATION_S * 100)):
        for topic, lag_s in (("/arm/joint_states", 0.05), ("/arm/joint_commands", 0.0)):
            messages.append(
                (
                    k * 10_000_000,
                    topic,
                    {"name": NAMES, "position": joints(k / 100 - lag_s).tolist()},
                )
            )
    for k in range(round(DURATION_S * 50)):
        for topic in ("/touch/inner", "/touch/outer"):
            data = touch(k / 50).astype(np.uint8).tobytes()
            messages.append(
                (
                    k * 20_000_000,
                    topic,
                    {"layout": {"dim": [], "data_offset": 0}, "data": data},
                )
            )
    for k in range(round(DURATION_S * 30)):
        picture = np.full((96, 128, 3), 3 * (k % 60), np.uint8)
        cv2.putText(
            picture, str(k), (10, 60), cv2.FONT_HERSHEY_SIMPLEX, 1.5, (255, 255, 255), 3
        )
        data = cv2.imencode(".jpg", picture)[1].tobytes()
        messages.append(
            (k * 10**9 // 30, "/cam/image/compressed", {"format": "jpeg", "data": data})
        )
    with path.open("wb") as file:
        writer = Writer(file)
        kinds = {
            "arm": writer.register_msgdef("sensor_msgs/msg/JointState", JOINT_STATE),
            "touch": writer.register_msgdef("std_msgs/msg/UInt8MultiArray", COUNTS),
            "cam": writer.register_msgdef("sensor_msgs/msg/CompressedImage", PICTURE),
        }
        for after_ns, topic, message in sorted(messages, key=lambda m: m[0]):
            time_ns = START_NS + after_ns
            stamp = {
                "stamp": {"sec": time_ns // 10**9, "nanosec": time_ns % 10**9},
                "frame_id": "",
            }
            filled = message | ({"header": stamp} if "layout" not in message else {})
            if "name" in message:
                filled |= {"velocity": [], "effort": []}
            writer.write_message(
                topic, kinds[topic.split("/")[1]], filled, time_ns, time_ns
            )
        writer.finish()
    return path


def fill_in(folder: Path) -> None:
    """Replace each TODO of the drafts as its owner would."""
    told = {
        "text": "squeeze the ball",
        "unit": "[rad, rad, rad, rad, rad, m]",
        "range": "[-3.14, 3.14]",
        "rows": "16",
        "columns": "16",
        "max_spread_count": "8",
        "noise_count": "6",
        "gain_per_count": "0.01",
    }
    for path in folder.glob("mine*.yaml"):
        path.write_text(
            re.sub(
                r"(\w+): TODO\b", lambda m: f"{m[1]}: {told[m[1]]}", path.read_text()
            )
        )


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recorded, inspected, ingested."""
    folder = tmp_path_factory.mktemp("another_robot")
    recording = record(folder / "squeeze.mcap")
    assert (
        main(["ingest", "inspect", str(recording), f"--draft={folder / 'mine.yaml'}"])
        == 0
    )
    assert {p.name for p in folder.glob("*.yaml")} == {
        "mine.yaml",
        "mine_dataset.yaml",
        "mine_sensor.yaml",
    }
    fill_in(folder)
    where = [f"--out={folder / 'out'}", f"--store={folder / 'store'}"]
    assert (
        main(["ingest", str(recording), f"--spec={folder / 'mine.yaml'}", *where]) == 0
    )
    return folder / "out"


def test_its_recording_becomes_a_dataset_with_its_own_joints_and_pads(dataset, capsys):
    there = Dataset(dataset)
    assert there.spec.features["observation.state"].names == tuple(
        f"{name}.pos" for name in NAMES
    )
    assert there.spec.features["observation.tactile"].shape == (2 * 16 * 16,)
    episode = there.episode(0)
    at_s = (episode.start_ns - START_NS) * 1e-9 + episode.time_s
    # Pads are read at 50 Hz: the newest frame is up to 20 ms old, in which the bump grows by 60 counts at most.
    pads = episode.arrays["observation.tactile"].reshape(-1, 2, 16, 16)
    expected = np.stack([touch(t) - REST_COUNT for t in at_s])
    assert np.abs(pads - expected[:, None]).max() <= 61
    held = at_s > 2.1
    assert held.sum() > 20 and (pads[held] == expected[held][:, None]).all()
    assert np.unravel_index(pads[-1, 0].argmax(), (16, 16)) == (
        4,
        10,
    )  # neither transposed nor exchanged
    main(["check", str(dataset)])
    said = capsys.readouterr().out
    assert "touch_inner" in said and "touch_outer" in said and "error" not in said


def test_its_episode_is_drawn_with_its_own_pads(dataset, tmp_path):
    sheet = tmp_path / "sheet.png"
    assert main(["view", str(dataset), f"--sheet={sheet}"]) == 0
    picture = cv2.imread(str(sheet))
    assert picture is not None and picture.shape[0] > 1000
    assert main(["view", str(dataset), f"--save={tmp_path / 'x.rrd'}"]) == 0


def test_what_the_twin_or_a_cut_file_has_nothing_for_is_said(dataset, tmp_path, capsys):
    (tmp_path / "twin.yaml").write_text("effects: []\n")
    words = [
        str(dataset),
        f"--against={tmp_path / 'twin.yaml'}",
        f"--save={tmp_path / 'x.rrd'}",
    ]
    assert main(["view", *words]) == 2
    said = capsys.readouterr().err
    assert "two PiPER arms" in said and "14 targets" in said and "has 6" in said
    (tmp_path / "cut.mcap").write_bytes(
        (dataset.parent / "squeeze.mcap").read_bytes()[:3000]
    )
    spec = dataset.parent / "mine.yaml"
    where = [f"--out={tmp_path / 'out'}", f"--store={tmp_path / 'store'}"]
    assert main(["ingest", str(tmp_path / "cut.mcap"), f"--spec={spec}", *where]) == 1
    assert (
        "cut.mcap bytes" in capsys.readouterr().out
    )  # where it is damaged, not that it names no topics


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_tactile_policy_is_trained_on_it_and_gives_its_actions(dataset, tmp_path):
    import torch
    from lerobot.policies.factory import make_pre_post_processors

    from taccorl.policies.tactile_pi05.configuration_tactile_pi05 import (
        TactilePI05Config,
    )
    from taccorl.policies.tactile_pi05.modeling_tactile_pi05 import TactilePI05Policy

    words = [
        "--policy.type=tactile_pi05",
        "--policy.backbone=tiny",
        "--policy.device=cpu",
        "--policy.push_to_hub=false",
    ]
    words += [
        "--dataset.repo_id=local/other",
        f"--dataset.root={dataset}",
        "--steps=2",
        "--batch_size=2",
        "--save_freq=2",
    ]
    words += ["--num_workers=0", f"--output_dir={tmp_path / 'run'}"]
    train = [str(Path(sys.executable).with_name("lerobot-train")), *words]
    done = subprocess.run(
        train,
        capture_output=True,
        text=True,
        env={**os.environ, "HF_HUB_OFFLINE": "1"},
        timeout=500,
    )
    assert done.returncode == 0, done.stderr[-3000:]

    folder = tmp_path / "run/checkpoints/last/pretrained_model"
    policy = TactilePI05Policy.from_pretrained(folder).eval()
    assert isinstance(policy.config, TactilePI05Config)
    before, after = make_pre_post_processors(policy.config, str(folder))
    episode = Dataset(dataset).episode(0)
    row = episode.num_rows - 1
    [picture] = [
        p["observation.images.cam_image"]
        for k, p in enumerate(episode.pictures())
        if k == row
    ]
    observation = {
        "observation.state": torch.from_numpy(
            episode.arrays["observation.state"][[row]]
        ),
        "observation.tactile": torch.from_numpy(
            episode.arrays["observation.tactile"][[row]]
        ),
        "observation.images.cam_image": torch.from_numpy(picture / 255.0)
        .float()
        .permute(2, 0, 1)[None],
        "task": ["squeeze the ball"],
    }
    action = after(policy.select_action(before(observation)))
    assert action.shape == (1, len(NAMES)) and bool(torch.isfinite(action).all())

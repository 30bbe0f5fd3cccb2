"""Synthetic recording (stand-in): files like those of a bimanual PiPER with FlexiTac pads, with optional faults.

Tests and benchmarks need files that look and fail like real ones, and whose true signals are known. Every file says
``surrogate``. The same configuration gives the same bytes.

    write_mcap(path, StandInConfig(duration_s=6.0))    as ROS 2 drivers and rosbag2 would
    write_cobot_magic_hdf5(path, StandInConfig())      as cobot_magic's collect_data.py would
"""

import heapq
import json
from dataclasses import asdict
from pathlib import Path

import cv2
import h5py
import numpy as np
from mcap.writer import CompressionType, Writer

from taccorl.data.origin import Origin, labelled
from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.surrogate.stand_in.config import (
    CAMERA_HZ,
    CAMERA_TOPICS,
    COMMAND_TOPICS,
    EPISODE_TOPIC,
    PAD_TOPICS,
    PIPER_RAD_PER_DEG,
    START_UNIX_NS,
    STATE_TOPICS,
    StandInConfig,
)
from taccorl.surrogate.stand_in.frame_id import read_frame_id
from taccorl.surrogate.stand_in.kinematics import JOINT_LIMITS_RAD, JOINT_NAMES
from taccorl.surrogate.stand_in.messages import MessageWriter
from taccorl.surrogate.stand_in.scene import CAMERAS, Scene
from taccorl.surrogate.stand_in.story import PAD_WIRE_SHAPE, PADS, Story, plan_episodes
from taccorl.surrogate.stand_in.streams import StandInTruth, Streams, as_piper_publishes, jpeg

__all__ = [
    "CAMERAS",
    "CAMERA_TOPICS",
    "COMMAND_TOPICS",
    "EPISODE_TOPIC",
    "JOINT_LIMITS_RAD",
    "JOINT_NAMES",
    "PADS",
    "PAD_TOPICS",
    "PAD_WIRE_SHAPE",
    "PIPER_RAD_PER_DEG",
    "START_UNIX_NS",
    "STATE_TOPICS",
    "StandInConfig",
    "StandInTruth",
    "publish",
    "read_frame_id",
    "write_cobot_magic_hdf5",
    "write_mcap",
]

ORIGIN = Origin("surrogate", "stand-in recording, not a robot")
"""Origin that every file states."""


def write_mcap(path: Path, config: StandInConfig) -> StandInTruth:
    """Write one recording in the format of the robot's drivers and rosbag2; an existing file is replaced."""
    streams, story = _stand_in(config)
    publish(path, streams, _label(config))
    return streams.truth(story)


def _stand_in(config: StandInConfig) -> tuple[Streams, Story]:
    plans = plan_episodes(config.duration_s, config.episodes, config.outcomes, config.seed)
    story = Story(plans, config.duration_s, config.command_lead_s, config.contact_delay_s, config.seed)
    return Streams(config, story, Scene(story, config.camera_size, config.seed)), story


def publish(path: Path, streams: Streams, label: dict[str, str]) -> None:
    """Write all messages into one MCAP file in the format of rosbag2; an existing file is replaced.

    Args:
        label: the MCAP metadata record ``taccorl``: its ``origin`` states what the file is.
    """
    config = streams.config
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        compression = CompressionType[config.compression.upper()]
        writer = Writer(file, chunk_size=config.chunk_size_bytes, compression=compression)
        writer.start(profile="ros2" if config.encoding == "ros2" else "", library="taccorl")
        writer.add_metadata("taccorl", label)
        encoder = MessageWriter(writer, config.encoding)
        for event in heapq.merge(*streams.all(), key=lambda event: event.log_s):
            encoder.write(event.topic, event.ros_type, event.message, START_UNIX_NS + round(event.log_s * 1e9))
            streams.note(event)
        writer.finish()


def _label(config: StandInConfig) -> dict[str, str]:
    """The MCAP metadata record that says what this file is."""
    default = asdict(StandInConfig())
    return {
        **labelled(ORIGIN),
        "seed": str(config.seed),
        "duration_s": f"{config.duration_s:g}",
        "episodes": str(config.episodes),
        "instruction": config.instruction,
        "differs_from_default": json.dumps({k: v for k, v in asdict(config).items() if v != default[k]}),
    }


def write_cobot_magic_hdf5(path: Path, config: StandInConfig) -> StandInTruth:
    """Write one episode in the layout of cobot_magic's ``collect_data.py``: 30 frames per second, no times, no task.

    Row t of ``action`` is the command of frame t + 1. Pictures are RGB; as JPEG (``hdf5_jpeg``) they are ordinary files
    padded with zeros to one length, their own lengths in ``compress_len`` (camera, frame).

    Raises:
        TaccorlError: the configuration has more than one episode, and the format holds one only.
    """
    if config.episodes != 1:
        raise TaccorlError(f"stand-in: a cobot_magic file holds one episode, not {config.episodes}. Set episodes=1.")
    streams, story = _stand_in(config)
    time_s = np.arange(int(config.duration_s * CAMERA_HZ)) / CAMERA_HZ
    arms = {
        "observations/qpos": as_piper_publishes(story.state(time_s), config.joints_in_degrees),
        "observations/qvel": story.velocity(time_s),
        "observations/effort": story.effort(time_s),
        "action": as_piper_publishes(story.command(time_s + 1 / CAMERA_HZ), config.joints_in_degrees),
    }
    arms["observations/qvel"][:, ROBOT.gripper_indices] = 0.0  # PiPER reports none for its grippers
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        file.attrs.update({"sim": False, "compress": config.hdf5_jpeg} | labelled(ORIGIN))
        for name, rows in arms.items():
            file[name] = np.roll(rows, ROBOT.num_per_arm if config.swap_arms else 0, axis=1).astype(np.float32)
        file["base_action"] = np.zeros((len(time_s), 2), np.float32)
        lengths = np.zeros((len(CAMERAS), len(time_s)), np.float32)
        for c, camera in enumerate(CAMERAS):
            lengths[c] = _write_pictures(file, camera, time_s, streams)
        if config.hdf5_jpeg:
            file["compress_len"] = lengths
    return streams.truth(story)


def _write_pictures(file: h5py.File, camera: str, time_s: np.ndarray, streams: Streams) -> np.ndarray:
    """Fills one camera's dataset and returns the length of every JPEG (0 for raw pictures)."""
    config, lengths = streams.config, np.zeros(len(time_s))
    name = "observations/images/" + ("cam_high" if camera == "front" else f"cam_{camera}")
    if config.hdf5_jpeg:
        pictures = file.create_dataset(name, (len(time_s), 1), np.uint8, maxshape=(len(time_s), None), chunks=(1, 4096))
    else:
        pictures = file.create_dataset(name, (len(time_s), *config.camera_size, 3), np.uint8)
    for n, picture in enumerate(streams.pictures_bgr(camera, time_s)):
        if config.hdf5_jpeg:
            data = np.frombuffer(jpeg(picture, config.jpeg_quality), np.uint8)
            lengths[n] = len(data)
            pictures.resize(max(len(data), pictures.shape[1]), axis=1)
            pictures[n, : len(data)] = data
        else:
            pictures[n] = cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)
    return lengths

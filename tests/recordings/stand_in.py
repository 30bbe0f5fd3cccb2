"""Synthetic recording (stand-in): files like those of a bimanual PiPER with FlexiTac pads, with optional faults.

Tests and benchmarks need files that look and fail like real ones, and whose true signals are known. Every file says
``surrogate``. The same configuration gives the same bytes.

    write_mcap(path, StandInConfig(duration_s=6.0))    as ROS 2 drivers and rosbag2 would
    write_cobot_magic_hdf5(path, StandInConfig())      as cobot_magic's collect_data.py would
"""

import json
from array import array
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from taccorl.data.origin import Origin, labelled
from taccorl.robots import ROBOT
from taccorl.surrogate import drivers
from tests.recordings.pictures import Scene
from tests.recordings.story import Story, plan_episodes

ORIGIN = Origin("surrogate", "stand-in recording, not a robot")
_JOINT_TOPICS = (*drivers.STATE_TOPICS.values(), *drivers.COMMAND_TOPICS.values())
SPEC_TOPICS = (
    *_JOINT_TOPICS,
    *drivers.CAMERA_TOPICS.values(),
    *drivers.PAD_TOPICS.values(),
    drivers.EPISODE_TOPIC,
)
"""All topics that the shipped data spec names."""

Gap = tuple[str, float, float]  # topic, from, to [s since the start]


@dataclass(frozen=True, kw_only=True)
class StandInConfig(drivers.DriverConfig):
    """Settings of a stand-in recording. Faults are absent by default."""

    episodes: int = 1  # Number of episodes: equal time slots of at least 2 s, each with one attempt between its markers
    outcomes: tuple[str, ...] = ("success",)
    """Closing markers, repeated over the episodes; in an episode with ``failure`` the tube misses the hole."""
    # Faults
    joints_in_degrees: bool = False  # Fault: joint messages are in degrees
    swap_arms: bool = False
    """Fault: the joint topics of each arm hold the other arm's messages (exchanged CAN adapters); cameras and pads are
    correct."""
    sim_time_stamps: bool = (
        False  # Fault: header stamps count from 0, while log times are wall-clock times
    )
    clock_offset_s: dict[str, float] = field(default_factory=dict)
    """Fault: topic → time by which its clock is ahead [s]. It moves the header stamp, or the log time of messages without a
    header."""
    gap: Gap | list[Gap] | tuple[()] = ()
    """Fault: missing messages, (topic, from, to) in seconds since the start; one or several."""
    frozen_camera: str | None = None
    """Fault: name of a camera that repeats one picture, with new stamps, after a third of the recording."""
    swap_pads: tuple[str, str] | None = (
        None  # Fault: two pads whose messages are published under each other's topic
    )

    @property
    def gaps(self) -> list[Gap]:
        """``gap`` as a list, empty if there is none."""
        given = self.gap
        return [given] if isinstance(given, tuple) and len(given) == 3 else list(given)


@dataclass(frozen=True, kw_only=True)
class StandInTruth:
    """True signals of a recording. Times in seconds since the start, which is ``START_UNIX_NS``; left arm first."""

    story: Story
    """The truth at any time: ``state(t)``, ``command(t)``, ``velocity(t)``, ``grip(arm, t)``, ``clean_counts(pad, t)``."""
    contact_s: dict[str, list[tuple[float, float]]]
    """Arm → (start, end) of the contact of its pads [s], one interval per episode."""
    sampled_s: dict[str, np.ndarray]
    """Topic → true time of what each message shows [s]: stamp without clock faults, or middle of a pad's scan. MCAP only."""
    log_s: dict[
        str, np.ndarray
    ]  # Topic → log time of each message [s], clock faults included. MCAP only
    frame_ids: dict[str, np.ndarray]
    """Camera → frame id in each published picture: the index of the camera's tick, counting lost ones."""


class StandInStreams(drivers.Streams):
    """The drivers' streams with faults, and a record of what was published. Use one object per file."""

    config: StandInConfig

    def __init__(
        self,
        config: StandInConfig,
        true: drivers.TrueSignals,
        scene: drivers.CameraPictures,
    ) -> None:
        super().__init__(config, true, scene)
        self._sampled_s = {topic: array("d") for topic in SPEC_TOPICS}
        self._log_s = {topic: array("d") for topic in SPEC_TOPICS}
        self._frame_ids = {camera: array("q") for camera in drivers.CAMERAS}
        self._still: dict[str, bytes] = {}
        self._renamed: dict[str, str] = {}
        if config.swap_arms:
            self._renamed |= {
                a: b
                for topics in (drivers.STATE_TOPICS, drivers.COMMAND_TOPICS)
                for a, b in _each_other(*topics.values())
            }
        if config.swap_pads:
            self._renamed |= dict(
                _each_other(*(drivers.PAD_TOPICS[pad] for pad in config.swap_pads))
            )

    def all(self) -> list[Iterator[drivers.Event]]:
        return [self._with_faults(stream) for stream in super().all()]

    def _with_faults(self, stream: Iterator[drivers.Event]) -> Iterator[drivers.Event]:
        config = self.config
        for event in stream:
            topic = self._renamed.get(event.topic, event.topic)
            message: Any = event.message
            offset_s = config.clock_offset_s.get(topic, 0.0)
            log_s = event.log_s + (
                0.0 if isinstance(message, dict) and "header" in message else offset_s
            )
            if (
                isinstance(message, dict)
                and "header" in message
                and message["header"]["stamp"]["sec"]
            ):
                message["header"]["stamp"] = self._stamp(event.sampled_s + offset_s)
            tick = event.tick
            if topic in _JOINT_TOPICS and config.joints_in_degrees:
                joints = message["position"][: ROBOT.num_joints]
                message["position"][: ROBOT.num_joints] = [
                    x / drivers.PIPER_RAD_PER_DEG for x in joints
                ]
            if (
                topic == drivers.CAMERA_TOPICS.get(config.frozen_camera or "")
                and tick >= self._freezes_at
            ):
                message = message | {
                    "data": self._still.setdefault(topic, message["data"])
                }
                tick = self._freezes_at
            time_s = event.sampled_s - (
                drivers.SCAN_S / 2 if topic in drivers.PAD_TOPICS.values() else 0.0
            )
            if any(
                topic == gap and start_s <= time_s < end_s
                for gap, start_s, end_s in config.gaps
            ):
                continue
            if topic in SPEC_TOPICS:
                self._sampled_s[topic].append(event.sampled_s)
                self._log_s[topic].append(log_s)
            for camera in (
                camera
                for camera in drivers.CAMERAS
                if drivers.CAMERA_TOPICS[camera] == topic
            ):
                self._frame_ids[camera].append(tick)
            yield event._replace(log_s=log_s, topic=topic, message=message)

    @property
    def _freezes_at(self) -> int:
        """The tick after which a frozen camera only repeats itself."""
        return int(self.config.duration_s / 3 * drivers.CAMERA_HZ)

    def _stamp(self, time_s: float) -> dict[str, int]:
        ns = round(time_s * 1e9)
        ns = max(ns, 0) if self.config.sim_time_stamps else drivers.START_UNIX_NS + ns
        return {"sec": ns // 10**9, "nanosec": ns % 10**9}

    def pictures_bgr(self, camera: str, time_s: np.ndarray) -> Iterator[np.ndarray]:
        """Pictures without loss or jitter, one for each tick of ``time_s`` (N,) [s]; for formats without time stamps."""
        ticks = np.arange(len(time_s))
        if camera == self.config.frozen_camera:
            ticks = np.minimum(ticks, self._freezes_at)
        self._frame_ids[camera].extend(ticks.tolist())
        still = None
        for picture, tick, k in zip(
            self.scene.pictures_bgr(camera, time_s[ticks], ticks),
            ticks,
            range(len(ticks)),
            strict=True,
        ):
            still = picture if tick == k else still
            assert still is not None
            yield still

    def truth(self, story: Story) -> StandInTruth:
        """True signals of the recording, available once the file is written."""
        return StandInTruth(
            story=story,
            contact_s={arm: story.contact_s(arm) for arm in drivers.ARMS},
            sampled_s={
                topic: np.array(times) for topic, times in self._sampled_s.items()
            },
            log_s={topic: np.array(times) for topic, times in self._log_s.items()},
            frame_ids={
                camera: np.array(ids) for camera, ids in self._frame_ids.items()
            },
        )


def _each_other(a: str, b: str) -> Iterator[tuple[str, str]]:
    yield from ((a, b), (b, a))


def _stand_in(config: StandInConfig) -> tuple[StandInStreams, Story]:
    plans = plan_episodes(
        config.duration_s, config.episodes, config.outcomes, config.seed
    )
    story = Story(plans, config.duration_s, config.seed)
    return StandInStreams(
        config, story, Scene(story, config.camera_size, config.seed)
    ), story


def write_mcap(path: Path, config: StandInConfig) -> StandInTruth:
    """Write one recording in the format of the robot's drivers and rosbag2; an existing file is replaced."""
    streams, story = _stand_in(config)
    default = asdict(StandInConfig())
    label = {
        **labelled(ORIGIN),
        "seed": str(config.seed),
        "duration_s": f"{config.duration_s:g}",
        "episodes": str(config.episodes),
        "instruction": config.instruction,
        "differs_from_default": json.dumps(
            {k: v for k, v in asdict(config).items() if v != default[k]}
        ),
    }
    drivers.publish(path, streams, label)
    return streams.truth(story)


def write_cobot_magic_hdf5(path: Path, config: StandInConfig) -> StandInTruth:
    """Write one episode in the layout of cobot_magic's ``collect_data.py``: 30 frames per second, no times, no task.

    Row t of ``action`` is the command of frame t + 1. Pictures are JPEG files padded with zeros to one length, their own
    lengths in ``compress_len`` (camera, frame)."""
    streams, story = _stand_in(config)
    time_s = np.arange(int(config.duration_s * drivers.CAMERA_HZ)) / drivers.CAMERA_HZ
    arms = {
        "observations/qpos": drivers.as_piper_publishes(story.at("state", time_s)),
        "observations/qvel": story.at("velocity", time_s),
        "observations/effort": story.at("effort", time_s),
        "action": drivers.as_piper_publishes(
            story.at("command", time_s + 1 / drivers.CAMERA_HZ)
        ),
    }
    if config.joints_in_degrees:
        for name in ("observations/qpos", "action"):
            arms[name][:, ROBOT.joint_indices] /= drivers.PIPER_RAD_PER_DEG
    arms["observations/qvel"][:, ROBOT.gripper_indices] = (
        0.0  # PiPER reports none for its grippers
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        file.attrs.update({"sim": False, "compress": True} | labelled(ORIGIN))
        for name, rows in arms.items():
            file[name] = np.roll(
                rows, ROBOT.num_per_arm if config.swap_arms else 0, axis=1
            ).astype(np.float32)
        file["base_action"] = np.zeros((len(time_s), 2), np.float32)
        lengths = np.zeros((len(drivers.CAMERAS), len(time_s)), np.float32)
        for c, camera in enumerate(drivers.CAMERAS):
            lengths[c] = _write_pictures(file, camera, time_s, streams)
        file["compress_len"] = lengths
    return streams.truth(story)


def _write_pictures(
    file: h5py.File, camera: str, time_s: np.ndarray, streams: StandInStreams
) -> np.ndarray:
    """Fills one camera's dataset and returns the length of every JPEG."""
    config, lengths = streams.config, np.zeros(len(time_s))
    name = "observations/images/" + (
        "cam_high" if camera == "front" else f"cam_{camera}"
    )
    pictures = file.create_dataset(
        name, (len(time_s), 1), np.uint8, maxshape=(len(time_s), None), chunks=(1, 4096)
    )
    for n, picture in enumerate(streams.pictures_bgr(camera, time_s)):
        data = np.frombuffer(drivers.jpeg(picture, config.jpeg_quality), np.uint8)
        lengths[n] = len(data)
        pictures.resize(max(len(data), pictures.shape[1]), axis=1)
        pictures[n, : len(data)] = data
    return lengths

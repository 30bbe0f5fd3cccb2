"""What the drivers of a bimanual PiPER with FlexiTac pads write: one lazy stream of messages per topic, in order of log time,
computed from true signals. ``publish`` writes them as an MCAP file in the format of rosbag2.
"""

import heapq
import math
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple, Protocol

import numpy as np
from mcap.writer import CompressionType, Writer

from taccorl.robots import ROBOT
from taccorl.surrogate import driver_messages as messages
from taccorl.surrogate.driver_messages import MessageWriter

START_UNIX_NS = 1_780_000_000 * 10**9  # wall clock when every recording begins
ARMS, CAMERAS, JOINT_NAMES = (
    ROBOT.arms,
    ROBOT.cameras,
    (*ROBOT.joints, "gripper"),
)  # as piper_ros names them
PADS = (
    "left_robot_left_finger",
    "left_robot_right_finger",
    "right_robot_left_finger",
    "right_robot_right_finger",
)
PAD_WIRE_SHAPE = (
    12,
    32,
)  # rows across the finger, columns from palm to finger tip, as FlexiTac's board sends them
STATE_TOPICS = {
    arm: f"/joint_states_{arm}" for arm in ARMS
}  # Arm → topic of its measured joints
COMMAND_TOPICS = {
    arm: f"/joint_states_ctrl_{arm}" for arm in ARMS
}  # Arm → topic of its commands
CAMERA_TOPICS = {
    "front": "/camera_f/color/image_raw/compressed",
    "left_wrist": "/camera_l/color/image_raw/compressed",
    "right_wrist": "/camera_r/color/image_raw/compressed",
}
"""Camera → topic of its pictures."""
PAD_TOPICS = {pad: f"/{pad}" for pad in PADS}  # Pad → topic of its frames
EPISODE_TOPIC = "/episode"  # Topic of the markers of episodes
EXTRA_TOPICS_HZ = {
    "/arm_status_left": 50,
    "/tf": 30,
    "/enable_srv/_service_event": 2,
}  # no data spec names these
JOINT_HZ, CAMERA_HZ, PAD_HZ = 200, 30, 100  # Message rates [Hz]
PIPER_RAD_PER_DEG = 0.017444  # in piper_ros; π/180 would be 0.0174533, so published positions are 0.053 % too small
SCAN_S = 0.010  # a FlexiTac frame is read row by row during its whole period
_SLICE_S = 1  # streams work in slices of this length, so memory does not grow with pictures and readings


@dataclass(frozen=True, kw_only=True)
class DriverConfig:
    """Contents of a recording, and how arms and drivers behave. "Jitter" is the standard deviation of a normal draw; a latency
    adds its magnitude."""

    duration_s: float = 6.0  # Duration of the recording [s]
    seed: int = 0  # Seed of everything that is random
    instruction: str = (
        "insert the test tube into the rack"  # Task text of every episode
    )
    camera_size: tuple[int, int] = (480, 640)  # Rows and columns of pictures
    jpeg_quality: int = 85  # JPEG quality of pictures, 0 … 100
    compression: Literal["none", "lz4", "zstd"] = "lz4"
    """Compression of MCAP chunks. The pictures are JPEG, which does not become smaller, so that a fast method suffices."""
    chunk_size_bytes: int = 1 << 20  # Size of an MCAP chunk before compression [bytes]
    camera_stamp_jitter_s: float = (
        0.0006  # Standard deviation of the time of a picture from its tick [s]
    )
    camera_latency_s: float = 0.030  # Log time − stamp of pictures [s]
    camera_latency_jitter_s: float = (
        0.004  # σ of the normal number whose absolute value is added to it [s]
    )
    camera_loss_probability: float = 0.004  # Probability that a picture is lost
    joint_latency_s: float = 0.0012  # Log time − stamp of joint messages [s]
    joint_latency_jitter_s: float = (
        0.0004  # σ of the normal number whose absolute value is added to it [s]
    )
    joint_repeat_probability: float = 0.02
    """Probability that a joint message repeats the last values and stamp, because the driver's loop at 200 Hz found no new CAN
    frame."""
    command_silence_s: float = 0.04
    """Time until the first command on CAN [s]; before it, messages have stamp 0 and zeros."""
    pad_latency_s: float = 0.004
    """Time from the end of a scan to the end of the host's read [s]; the latter is the only time that a pad message has."""
    pad_latency_jitter_s: float = (
        0.0005  # σ of the normal number whose absolute value is added to it [s]
    )
    pad_noise_counts: float = (
        1.3  # Standard deviation of the noise of each taxel and frame [counts]
    )
    pad_gain_spread: float = (
        0.10  # Standard deviation of the taxels' gains, relative to their mean
    )


class Marks(NamedTuple):
    """Markers of an episode; times in seconds from the start of the recording."""

    start_s: float
    end_s: float
    outcome: str  # Closing marker: success, failure or discard


class TrueSignals:
    """Base of sources of true signals at N instants, given in seconds since the start of the recording."""

    plans: Sequence[Marks]  # Markers of every episode

    def at(self, signal: str, time_s: np.ndarray) -> np.ndarray:
        """(N, 14) of joints and grippers at ``time_s`` (N,) [s]: their state or command [rad, m], velocity [rad/s, m/s] or effort
        [N·m, N]."""
        raise NotImplementedError

    def clean_counts(self, pad: str, time_s: np.ndarray) -> np.ndarray:
        """(N, 12, 32) counts above baseline in wire order; ``time_s`` is (N,), or (N, 12) with one instant per row of the
        wire."""
        raise NotImplementedError


class CameraPictures(Protocol):
    """Interface of a source of the cameras' pictures."""

    def pictures_bgr(
        self, camera: str, time_s: np.ndarray, frame_ids: np.ndarray
    ) -> Iterator[np.ndarray]:
        """Iterate over pictures of ``camera``, one uint8 (rows, columns, 3) in BGR for each of the times ``time_s`` (N,) [s].
        ``frame_ids``: (N,) frame ids of the pictures."""
        ...


class Event(NamedTuple):
    """One message to be written to the file."""

    log_s: float  # Log time, since the start of the recording [s]
    sampled_s: float  # True time of what the message shows [s]
    topic: str
    ros_type: str  # Name of its ROS type
    message: messages.Message | bytes  # Its fields, or its bytes as they are written
    tick: int = 0  # Number of the picture, counting lost ones


def as_piper_publishes(joints: np.ndarray) -> np.ndarray:
    """``joints`` (N, 14) [rad, m] as piper_ros publishes them, (N, 14): counts of 0.001° and 0.001 mm, times its own factor."""
    published = np.empty_like(joints)
    published[:, ROBOT.gripper_indices] = (
        np.round(joints[:, ROBOT.gripper_indices] * 1e6) * 1e-6
    )
    degrees = np.round(np.degrees(joints[:, ROBOT.joint_indices]) * 1e3) * 1e-3
    published[:, ROBOT.joint_indices] = degrees * PIPER_RAD_PER_DEG
    return published


def jpeg(picture_bgr: np.ndarray, quality: int) -> bytes:
    """The picture ``picture_bgr`` (rows, columns, 3) uint8 as the bytes of an ordinary JPEG file with ``quality`` 0 … 100."""
    import cv2

    done, data = cv2.imencode(".jpg", picture_bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert done
    return data.tobytes()


class Streams:
    """Streams of messages of one recording."""

    def __init__(
        self, config: DriverConfig, story: TrueSignals, scene: CameraPictures | None
    ) -> None:
        self.config, self.story, self.scene = config, story, scene
        self.baseline_counts = {
            pad: self._random(f"baseline {pad}").uniform(10, 40, PAD_WIRE_SHAPE)
            for pad in PADS
        }

    def all(self) -> list[Iterator[Event]]:
        """One iterator of events per topic, each in order of log time."""
        return [
            *(self._joints(STATE_TOPICS[arm], arm, command=False) for arm in ARMS),
            *(self._joints(COMMAND_TOPICS[arm], arm, command=True) for arm in ARMS),
            *(
                self._camera(CAMERA_TOPICS[camera], camera, self.scene)
                for camera in CAMERAS
                if self.scene
            ),
            *(self._pad(PAD_TOPICS[pad], pad) for pad in PADS),
            self._markers(),
            *(self._extra(topic) for topic in EXTRA_TOPICS_HZ),
        ]

    def _random(self, purpose: str) -> np.random.Generator:
        return np.random.default_rng([self.config.seed, zlib.crc32(purpose.encode())])

    def _slices(self, hz: int) -> Iterator[np.ndarray]:
        """The ticks of a clock, one array per time slice."""
        count = int(self.config.duration_s * hz)
        for first in range(0, count, _SLICE_S * hz):
            yield np.arange(first, min(first + _SLICE_S * hz, count))

    def _joints(self, topic: str, arm: str, command: bool) -> Iterator[Event]:
        """Seven positions, six velocities, seven efforts; 200 Hz, now and then the last message once more."""
        config, rng, story = self.config, self._random(topic), self.story
        columns, own_joints = ROBOT.arm_slice(arm), ROBOT.joint_slice(arm)
        last_stamp_s = log_s = 0.0
        for ticks in self._slices(JOINT_HZ):
            tick_s = ticks / JOINT_HZ
            fresh_s = np.where(
                rng.random(len(ticks)) < config.joint_repeat_probability,
                last_stamp_s,
                tick_s,
            )
            stamp_s = np.maximum.accumulate(fresh_s)
            last_stamp_s = float(stamp_s[-1])
            jitter_s = np.abs(rng.normal(0, config.joint_latency_jitter_s, len(ticks)))
            arrival_s = tick_s + config.joint_latency_s + jitter_s
            joints = story.at("command" if command else "state", stamp_s)
            position = as_piper_publishes(joints)[:, columns].tolist()
            velocity = story.at("velocity", stamp_s)[:, own_joints].tolist()
            effort = story.at("effort", stamp_s)[:, columns].tolist()
            for n, stamp in enumerate(stamp_s.tolist()):
                log_s = max(log_s, float(arrival_s[n]))
                message = {
                    "header": _header(stamp, ""),
                    "name": list(JOINT_NAMES),
                    "position": position[n],
                }
                if command:
                    message |= {
                        "velocity": [0.0] * ROBOT.num_joints,
                        "effort": [0.0] * ROBOT.num_per_arm,
                    }
                    if (
                        tick_s[n] < config.command_silence_s
                    ):  # the driver has not seen a command yet
                        message["header"]["stamp"] = {"sec": 0, "nanosec": 0}
                        message["position"] = [0.0] * ROBOT.num_per_arm
                else:
                    message |= {"velocity": velocity[n], "effort": effort[n]}
                yield Event(log_s, stamp, topic, messages.JOINT_STATE, message)

    def _camera(
        self, topic: str, camera: str, scene: CameraPictures
    ) -> Iterator[Event]:
        """JPEG pictures at 30 Hz, every camera with its own phase, some lost on the way."""
        config, rng, log_s = self.config, self._random(topic), 0.0
        phase_s = rng.uniform(0, 1 / CAMERA_HZ)
        for ticks in self._slices(CAMERA_HZ):
            stamp_s = (
                ticks / CAMERA_HZ
                + phase_s
                + rng.normal(0, config.camera_stamp_jitter_s, len(ticks))
            )
            latency_s = config.camera_latency_s + np.abs(
                rng.normal(0, config.camera_latency_jitter_s, len(ticks))
            )
            kept = rng.random(len(ticks)) >= config.camera_loss_probability
            pictures = scene.pictures_bgr(camera, stamp_s[kept], ticks[kept])
            for n in np.flatnonzero(kept).tolist():
                stamp = float(stamp_s[n])
                log_s = max(log_s, stamp + float(latency_s[n]))
                header = _header(stamp, f"{topic.split('/')[1]}_color_optical_frame")
                data = jpeg(next(pictures), config.jpeg_quality)
                message = {"header": header, "format": "jpeg", "data": data}
                yield Event(
                    log_s,
                    stamp,
                    topic,
                    messages.COMPRESSED_IMAGE,
                    message,
                    int(ticks[n]),
                )

    def _pad(self, topic: str, pad: str) -> Iterator[Event]:
        """12 × 32 bytes (10-bit readings, two bits dropped) at 100 Hz, scanned row by row. No header."""
        config, rng, log_s = self.config, self._random(pad), -math.inf
        rows = PAD_WIRE_SHAPE[0]
        gain = np.clip(
            rng.normal(1.0, config.pad_gain_spread, PAD_WIRE_SHAPE), 0.5, 1.5
        )
        rng.integers(
            60, 120, PAD_WIRE_SHAPE
        )  # unused: recordings keep the bytes that their seed had before
        phase_s, row_s = (
            rng.uniform(0, 1 / PAD_HZ),
            SCAN_S * (np.arange(rows) + 0.5) / rows,
        )
        for ticks in self._slices(PAD_HZ):
            scan_s = ticks / PAD_HZ + phase_s  # its beginning
            latency_s = config.pad_latency_s + np.abs(
                rng.normal(0, config.pad_latency_jitter_s, len(ticks))
            )
            counts = self.baseline_counts[pad] + gain * self.story.clean_counts(
                pad, scan_s[:, None] + row_s
            )
            counts = counts + rng.normal(0, config.pad_noise_counts, counts.shape)
            wire = np.clip(np.round(counts), 0, 255).astype(np.uint8)
            for n, start in enumerate(scan_s.tolist()):
                log_s = max(log_s, start + SCAN_S + float(latency_s[n]))
                yield Event(
                    log_s,
                    start + SCAN_S / 2,
                    topic,
                    messages.UINT8_ARRAY,
                    pad_message(wire[n]),
                )

    def _markers(self) -> Iterator[Event]:
        for plan in self.story.plans:
            for time_s, text in (
                (plan.start_s, f"start:{self.config.instruction}"),
                (plan.end_s, plan.outcome),
            ):
                yield Event(
                    time_s, time_s, EPISODE_TOPIC, messages.STRING, {"data": text}
                )

    def _extra(self, topic: str) -> Iterator[Event]:
        """What a real bag holds besides: a status without header, transforms, a service event nobody can decode."""
        status = dict.fromkeys(
            (
                "ctrl_mode",
                "arm_status",
                "mode_feedback",
                "teach_status",
                "motion_status",
            ),
            1,
        )
        status |= {"trajectory_num": 0, "err_code": 0}
        origin = {
            "translation": {"x": 0.0, "y": 0.3, "z": 0.26},
            "rotation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
        }
        for ticks in self._slices(EXTRA_TOPICS_HZ[topic]):
            for time_s in (ticks / EXTRA_TOPICS_HZ[topic]).tolist():
                if topic == "/arm_status_left":
                    yield Event(time_s, time_s, topic, messages.ARM_STATUS, status)
                elif topic == "/tf":
                    header = _header(time_s, "table")
                    transform = {
                        "header": header,
                        "child_frame_id": "left_base_link",
                        "transform": origin,
                    }
                    yield Event(
                        time_s, time_s, topic, messages.TF, {"transforms": [transform]}
                    )
                else:
                    yield Event(
                        time_s,
                        time_s,
                        topic,
                        messages.SERVICE_EVENT,
                        b"\x00\x01\x00\x00\x01",
                    )


def pad_message(wire: np.ndarray) -> messages.Message:
    """Message of one frame ``wire`` (12, 32) uint8."""
    rows, columns = PAD_WIRE_SHAPE
    sizes = (("rows", rows, rows * columns), ("cols", columns, columns))
    dim = [
        {"label": label, "size": size, "stride": stride}
        for label, size, stride in sizes
    ]
    return {"layout": {"dim": dim, "data_offset": 0}, "data": wire.tobytes()}


def _header(stamp_s: float, frame_id: str) -> messages.Message:
    ns = START_UNIX_NS + round(stamp_s * 1e9)
    return {"stamp": {"sec": ns // 10**9, "nanosec": ns % 10**9}, "frame_id": frame_id}


def publish(path: Path, streams: Streams, label: dict[str, str]) -> None:
    """Write all messages into one MCAP file in the format of rosbag2; an existing file is replaced. ``label``: the MCAP
    metadata record ``taccorl``: its ``origin`` states what the file is."""
    config = streams.config
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        compression = CompressionType[config.compression.upper()]
        writer = Writer(
            file, chunk_size=config.chunk_size_bytes, compression=compression
        )
        encoder = MessageWriter(writer)
        writer.start(profile=encoder.profile, library="taccorl")
        writer.add_metadata("taccorl", label)
        for event in heapq.merge(*streams.all(), key=lambda event: event.log_s):
            encoder.write(
                event.topic,
                event.ros_type,
                event.message,
                START_UNIX_NS + round(event.log_s * 1e9),
            )
        writer.finish()

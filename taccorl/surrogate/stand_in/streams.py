"""Messages of the stand-in's drivers: one lazy stream per topic, in order of log time."""

import math
import zlib
from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import cv2
import numpy as np

from taccorl.robots import ROBOT
from taccorl.surrogate.stand_in import messages
from taccorl.surrogate.stand_in.config import (
    CAMERA_HZ,
    CAMERA_TOPICS,
    COMMAND_TOPICS,
    EPISODE_TOPIC,
    EXTRA_TOPICS_HZ,
    JOINT_HZ,
    PAD_HZ,
    PAD_TOPICS,
    PIPER_RAD_PER_DEG,
    SCAN_S,
    SPEC_TOPICS,
    START_UNIX_NS,
    STATE_TOPICS,
    StandInConfig,
)
from taccorl.surrogate.stand_in.kinematics import ARMS, JOINT_NAMES
from taccorl.surrogate.stand_in.scene import CAMERAS
from taccorl.surrogate.stand_in.story import PAD_WIRE_SHAPE, PADS, EpisodePlan, Story

_SLICE_S = 1  # streams work in slices of this length, so memory does not grow with pictures and readings


@dataclass(frozen=True, kw_only=True)
class StandInTruth:
    """True signals of a recording. Times in seconds since the start, which is ``START_UNIX_NS``; left arm first."""

    config: StandInConfig
    """Configuration of the recording."""
    story: Story
    """The truth at any time: ``state(t)``, ``command(t)``, ``velocity(t)``, ``grip(arm, t)``, ``clean_counts(pad, t)``."""
    time_s: np.ndarray
    """(T,) every 5 ms [s]."""
    state: np.ndarray
    """(T, 14) joints [rad] and gripper opening [m]."""
    command: np.ndarray
    """(T, 14) commands [rad, m]."""
    contact_s: dict[str, list[tuple[float, float]]]
    """Arm → (start, end) of the contact of its pads [s], one interval per episode, with ``tactile_lag_s``."""
    baseline_counts: dict[str, np.ndarray]
    """Pad → (12, 32) resting counts at the start, before noise and rounding."""
    sampled_s: dict[str, np.ndarray]
    """Topic → true time of what each message shows [s]: stamp without clock faults, or middle of a pad's scan. MCAP only."""
    log_s: dict[str, np.ndarray]
    """Topic → log time of each message [s], clock faults included. MCAP only."""
    frame_ids: dict[str, np.ndarray]
    """Camera → frame id in each published picture: the index of the camera's tick, counting lost ones."""

    @property
    def episodes(self) -> list[EpisodePlan]:
        """Start, end, outcome and plan of every episode."""
        return self.story.plans

    def clean_counts(self, pad: str, time_s: np.ndarray) -> np.ndarray:
        """(N, 12, 32) counts above baseline without gain, noise, rolling scan and faults, at instants ``time_s`` (N,) [s]."""
        return self.story.clean_counts(pad, time_s)


class TrueSignals(Protocol):
    """Interface of a source of true signals at N instants, given in seconds since the start of the recording."""

    plans: list[EpisodePlan]
    """Plans of the episodes."""

    def state(self, time_s: np.ndarray) -> np.ndarray:
        """Joints [rad] and gripper openings [m], (N, 14), at ``time_s`` (N,) [s]."""
        ...

    def command(self, time_s: np.ndarray) -> np.ndarray:
        """Commands (N, 14) [rad, m] at ``time_s`` (N,) [s]."""
        ...

    def velocity(self, time_s: np.ndarray) -> np.ndarray:
        """Velocities (N, 14) [rad/s, m/s] at ``time_s`` (N,) [s]."""
        ...

    def effort(self, time_s: np.ndarray) -> np.ndarray:
        """Efforts (N, 14) [N·m, N] at ``time_s`` (N,) [s]."""
        ...

    def clean_counts(self, pad: str, time_s: np.ndarray) -> np.ndarray:
        """(N, 12, 32) counts above baseline in wire order; ``time_s`` is (N,), or (N, 12) with one instant per row of the
        wire."""
        ...


class CameraPictures(Protocol):
    """Interface of a source of the cameras' pictures: the drawn ``Scene``, or the rendered ``TwinScene``."""

    def pictures_bgr(self, camera: str, time_s: np.ndarray, frame_ids: np.ndarray) -> Iterator[np.ndarray]:
        """Iterate over pictures of ``camera``, one uint8 (rows, columns, 3) in BGR for each of the times ``time_s`` (N,) [s].

        Args:
            frame_ids: (N,) frame ids of the pictures.
        """
        ...


class Event(NamedTuple):
    """One message to be written to the file."""

    log_s: float
    """Log time, since the start of the recording [s]."""
    sampled_s: float
    """True time of what the message shows [s]."""
    topic: str
    ros_type: str
    """Name of its ROS type."""
    message: messages.Message | bytes
    """Its fields, or its bytes as they are written."""


def as_piper_publishes(joints: np.ndarray, in_degrees: bool) -> np.ndarray:
    """``joints`` (N, 14) [rad, m] as piper_ros publishes them, (N, 14): CAN counts of 0.001° and 0.001 mm, times its own factor.

    Args:
        in_degrees: joints are published in degrees (a fault).
    """
    published = np.empty_like(joints)
    published[:, ROBOT.gripper_indices] = np.round(joints[:, ROBOT.gripper_indices] * 1e6) * 1e-6
    degrees = np.round(np.degrees(joints[:, ROBOT.joint_indices]) * 1e3) * 1e-3
    published[:, ROBOT.joint_indices] = degrees if in_degrees else degrees * PIPER_RAD_PER_DEG
    return published


def jpeg(picture_bgr: np.ndarray, quality: int) -> bytes:
    """The picture ``picture_bgr`` (rows, columns, 3) uint8 as the bytes of an ordinary JPEG file with ``quality`` 0 … 100."""
    done, data = cv2.imencode(".jpg", picture_bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert done
    return data.tobytes()


class Streams:
    """Streams of messages of one recording, and a record of what was published. Use one object per file."""

    def __init__(self, config: StandInConfig, story: TrueSignals, scene: CameraPictures) -> None:
        self.config, self.story, self.scene = config, story, scene
        self.baseline_counts = {pad: self._random(f"baseline {pad}").uniform(10, 40, PAD_WIRE_SHAPE) for pad in PADS}
        self._frame_ids = {camera: array("q") for camera in CAMERAS}
        self._sampled_s = {topic: array("d") for topic in SPEC_TOPICS}
        self._log_s = {topic: array("d") for topic in SPEC_TOPICS}

    def all(self) -> list[Iterator[Event]]:
        """One iterator of events per topic, each in order of log time."""
        config = self.config
        arm_under = dict(zip(ARMS, reversed(ARMS) if config.swap_arms else ARMS, strict=True))
        pad_under = {pad: pad for pad in PADS}
        if config.swap_pads:
            pad_under.update(zip(config.swap_pads, reversed(config.swap_pads), strict=True))
        return [
            *(self._joints(STATE_TOPICS[arm], arm_under[arm], command=False) for arm in ARMS),
            *(self._joints(COMMAND_TOPICS[arm], arm_under[arm], command=True) for arm in ARMS),
            *(self._camera(CAMERA_TOPICS[camera], camera) for camera in CAMERAS),
            *(self._pad(PAD_TOPICS[pad], pad_under[pad]) for pad in PADS),
            self._markers(),
            *(self._extra(topic) for topic in EXTRA_TOPICS_HZ),
        ]

    def note(self, event: Event) -> None:
        """Record when a published message was sampled and logged."""
        if event.topic in self._log_s:
            self._sampled_s[event.topic].append(event.sampled_s)
            self._log_s[event.topic].append(event.log_s)

    def truth(self, story: Story) -> StandInTruth:
        """True signals of the recording that ``story`` tells, available once the file is written."""
        time_s, lag_s = np.arange(0, self.config.duration_s, 1 / JOINT_HZ), self.config.tactile_lag_s
        touched = {arm: [(a + lag_s, b + lag_s) for a, b in story.contact_s(arm)] for arm in ARMS}
        return StandInTruth(
            config=self.config,
            story=story,
            time_s=time_s,
            state=story.state(time_s),
            command=story.command(time_s),
            contact_s={arm: [] for arm in ARMS} if self.config.noise_only_touch else touched,
            baseline_counts=self.baseline_counts,
            sampled_s={topic: np.array(times) for topic, times in self._sampled_s.items()},
            log_s={topic: np.array(times) for topic, times in self._log_s.items()},
            frame_ids={camera: np.array(ids) for camera, ids in self._frame_ids.items()},
        )

    def _random(self, purpose: str) -> np.random.Generator:
        return np.random.default_rng([self.config.seed, zlib.crc32(purpose.encode())])

    def _slices(self, hz: int) -> Iterator[np.ndarray]:
        """The ticks of a clock, one array per time slice."""
        count = int(self.config.duration_s * hz)
        for first in range(0, count, _SLICE_S * hz):
            yield np.arange(first, min(first + _SLICE_S * hz, count))

    def _in_gap(self, topic: str, time_s: np.ndarray) -> np.ndarray:
        inside = np.zeros(len(time_s), bool)
        for gap_topic, start_s, end_s in self.config.gaps:
            inside |= (gap_topic == topic) & (time_s >= start_s) & (time_s < end_s)
        return inside

    def _header(self, topic: str, stamp_s: float, frame_id: str) -> messages.Message:
        ns = round((stamp_s + self.config.clock_offset_s.get(topic, 0.0)) * 1e9)
        ns = max(ns, 0) if self.config.sim_time_stamps else START_UNIX_NS + ns
        return {"stamp": {"sec": ns // 10**9, "nanosec": ns % 10**9}, "frame_id": frame_id}

    def _joints(self, topic: str, arm: str, command: bool) -> Iterator[Event]:
        """Seven positions, six velocities, seven efforts; 200 Hz, now and then the last message once more."""
        config, rng, story = self.config, self._random(topic), self.story
        columns, own_joints = ROBOT.arm_slice(arm), ROBOT.joint_slice(arm)
        last_stamp_s = log_s = 0.0
        for ticks in self._slices(JOINT_HZ):
            tick_s = ticks / JOINT_HZ
            fresh_s = np.where(rng.random(len(ticks)) < config.joint_repeat_probability, last_stamp_s, tick_s)
            stamp_s = np.maximum.accumulate(fresh_s)
            last_stamp_s = float(stamp_s[-1])
            arrival_s = (
                tick_s + config.joint_latency_s + np.abs(rng.normal(0, config.joint_latency_jitter_s, len(ticks)))
            )
            joints = story.command(stamp_s) if command else story.state(stamp_s)
            position = as_piper_publishes(joints, config.joints_in_degrees)[:, columns].tolist()
            velocity = story.velocity(stamp_s)[:, own_joints].tolist()
            effort = story.effort(stamp_s)[:, columns].tolist()
            missing = self._in_gap(topic, stamp_s)
            for n, stamp in enumerate(stamp_s.tolist()):
                log_s = max(log_s, float(arrival_s[n]))
                if missing[n]:
                    continue
                message = {"header": self._header(topic, stamp, ""), "name": list(JOINT_NAMES), "position": position[n]}
                if command:
                    message |= {"velocity": [0.0] * ROBOT.num_joints, "effort": [0.0] * ROBOT.num_per_arm}
                    if tick_s[n] < config.command_silence_s:  # the driver has not seen a command yet
                        message["header"]["stamp"] = {"sec": 0, "nanosec": 0}
                        message["position"] = [0.0] * ROBOT.num_per_arm
                else:
                    message |= {"velocity": velocity[n], "effort": effort[n]}
                yield Event(log_s, stamp, topic, messages.JOINT_STATE, message)

    def _last_picture(self, camera: str) -> float:
        """The tick after which a camera only repeats itself."""
        frozen = camera == self.config.frozen_camera
        return int(self.config.duration_s / 3 * CAMERA_HZ) if frozen else math.inf

    def _camera(self, topic: str, camera: str) -> Iterator[Event]:
        """JPEG pictures at 30 Hz, every camera with its own phase, some lost on the way."""
        config, rng, log_s, still = self.config, self._random(topic), 0.0, b""
        last, phase_s = self._last_picture(camera), rng.uniform(0, 1 / CAMERA_HZ)
        for ticks in self._slices(CAMERA_HZ):
            stamp_s = ticks / CAMERA_HZ + phase_s + rng.normal(0, config.camera_stamp_jitter_s, len(ticks))
            latency_s = config.camera_latency_s + np.abs(rng.normal(0, config.camera_latency_jitter_s, len(ticks)))
            missing = rng.random(len(ticks)) < config.camera_loss_probability
            missing |= self._in_gap(topic, stamp_s)
            drawn = (~missing & (ticks <= last)) | (ticks == last)
            pictures = self.scene.pictures_bgr(camera, stamp_s[drawn], ticks[drawn])
            for n, stamp in enumerate(stamp_s.tolist()):
                if drawn[n]:
                    still = jpeg(next(pictures), config.jpeg_quality)
                if missing[n]:
                    continue
                log_s = max(log_s, stamp + float(latency_s[n]))
                self._frame_ids[camera].append(int(min(ticks[n], last)))
                header = self._header(topic, stamp, f"{topic.split('/')[1]}_color_optical_frame")
                message = {"header": header, "format": "jpeg", "data": still}
                yield Event(log_s, stamp, topic, messages.COMPRESSED_IMAGE, message)

    def pictures_bgr(self, camera: str, time_s: np.ndarray) -> Iterator[np.ndarray]:
        """Iterate over pictures of ``camera`` without loss or jitter, one uint8 (rows, columns, 3) in BGR for each tick of
        ``time_s`` (N,) [s]; for formats without time stamps."""
        last, still = self._last_picture(camera), None
        for ticks in np.array_split(np.arange(len(time_s)), math.ceil(len(time_s) / CAMERA_HZ)):
            moving = ticks[ticks <= last]
            pictures = self.scene.pictures_bgr(camera, time_s[moving], moving)
            for tick in ticks:
                still = next(pictures) if tick <= last else still
                assert still is not None
                self._frame_ids[camera].append(int(min(tick, last)))
                yield still

    def _pad(self, topic: str, pad: str) -> Iterator[Event]:
        """12 × 32 bytes (10-bit readings, two bits dropped) at 100 Hz, scanned row by row. No header."""
        config, rng, log_s = self.config, self._random(pad), -math.inf
        rows, columns = PAD_WIRE_SHAPE
        row_dim = {"label": "rows", "size": rows, "stride": rows * columns}
        layout = {"dim": [row_dim, {"label": "cols", "size": columns, "stride": columns}], "data_offset": 0}
        gain = np.clip(rng.normal(1.0, config.pad_gain_spread, PAD_WIRE_SHAPE), 0.5, 1.5)
        broken = _broken_taxels(config, pad, stuck_at=rng.integers(60, 120, PAD_WIRE_SHAPE))
        phase_s, row_s = rng.uniform(0, 1 / PAD_HZ), SCAN_S * (np.arange(rows) + 0.5) / rows
        for ticks in self._slices(PAD_HZ):
            scan_s = ticks / PAD_HZ + phase_s  # its beginning
            latency_s = config.pad_latency_s + np.abs(rng.normal(0, config.pad_latency_jitter_s, len(ticks)))
            arrival_s = scan_s + SCAN_S + latency_s + config.clock_offset_s.get(topic, 0.0)
            counts = self.baseline_counts[pad] + config.baseline_drift_counts_per_s * scan_s[:, None, None]
            if not config.noise_only_touch:
                counts = counts + gain * self.story.clean_counts(pad, scan_s[:, None] + row_s - config.tactile_lag_s)
            counts = counts + rng.normal(0, config.pad_noise_counts, counts.shape)
            wire = np.clip(np.round(counts), 0, 255).astype(np.uint8)
            wire = np.where(broken >= 0, broken.astype(np.uint8), wire)
            missing = self._in_gap(topic, scan_s)
            for n, start in enumerate(scan_s.tolist()):
                log_s = max(log_s, float(arrival_s[n]))
                if not missing[n]:
                    message = {"layout": layout, "data": wire[n].tobytes()}
                    yield Event(log_s, start + SCAN_S / 2, topic, messages.UINT8_ARRAY, message)

    def _markers(self) -> Iterator[Event]:
        for plan in self.story.plans:
            marks = ((plan.start_s, f"start:{self.config.instruction}"), (plan.end_s, plan.outcome))
            for time_s, text in marks:
                if not self._in_gap(EPISODE_TOPIC, np.array([time_s]))[0]:
                    log_s = time_s + self.config.clock_offset_s.get(EPISODE_TOPIC, 0.0)
                    yield Event(log_s, time_s, EPISODE_TOPIC, messages.STRING, {"data": text})

    def _extra(self, topic: str) -> Iterator[Event]:
        """What a real bag holds besides: a status without header, transforms, a service event nobody can decode."""
        status = dict.fromkeys(("ctrl_mode", "arm_status", "mode_feedback", "teach_status", "motion_status"), 1)
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
                    header = self._header(topic, time_s, "table")
                    transform = {"header": header, "child_frame_id": "left_base_link", "transform": origin}
                    yield Event(time_s, time_s, topic, messages.TF, {"transforms": [transform]})
                else:
                    yield Event(time_s, time_s, topic, messages.SERVICE_EVENT, b"\x00\x01\x00\x00\x01")


def _broken_taxels(config: StandInConfig, pad: str, stuck_at: np.ndarray) -> np.ndarray:
    """(12, 32) what a broken taxel always reads, −1 for a sound one."""
    broken = np.full(PAD_WIRE_SHAPE, -1)
    kinds = (
        (config.dead_taxels, np.zeros(PAD_WIRE_SHAPE)),
        (config.stuck_taxels, stuck_at),
        (config.saturated_taxels, np.full(PAD_WIRE_SHAPE, 255)),
    )
    for taxels, reading in kinds:
        for row, column in taxels.get(pad, []):
            broken[row, column] = reading[row, column]
    return broken

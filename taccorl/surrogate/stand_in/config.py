"""Settings of a stand-in recording: contents, behaviour of the imitated drivers, and faults."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Literal

from taccorl.errors import TaccorlError, nearest
from taccorl.surrogate.stand_in.frame_id import SMALLEST_PICTURE
from taccorl.surrogate.stand_in.kinematics import ARMS
from taccorl.surrogate.stand_in.messages import ENCODINGS
from taccorl.surrogate.stand_in.scene import CAMERAS
from taccorl.surrogate.stand_in.story import PADS, SHORTEST_EPISODE_S

START_UNIX_NS = 1_780_000_000 * 10**9  # wall clock when every stand-in recording begins

STATE_TOPICS = {arm: f"/joint_states_{arm}" for arm in ARMS}
"""Arm → topic of its measured joints."""
COMMAND_TOPICS = {arm: f"/joint_states_ctrl_{arm}" for arm in ARMS}
"""Arm → topic of its commands."""
CAMERA_TOPICS = {
    "front": "/camera_f/color/image_raw/compressed",
    "left_wrist": "/camera_l/color/image_raw/compressed",
    "right_wrist": "/camera_r/color/image_raw/compressed",
}
"""Camera → topic of its pictures."""
PAD_TOPICS = {pad: f"/{pad}" for pad in PADS}
"""Pad → topic of its frames."""
EPISODE_TOPIC = "/episode"
"""Topic of the markers of episodes."""
SPEC_TOPICS = (
    *STATE_TOPICS.values(),
    *COMMAND_TOPICS.values(),
    *CAMERA_TOPICS.values(),
    *PAD_TOPICS.values(),
    EPISODE_TOPIC,
)
"""All topics that the shipped data spec names."""
EXTRA_TOPICS_HZ = {"/arm_status_left": 50, "/tf": 30, "/enable_srv/_service_event": 2}  # no data spec names these

JOINT_HZ, CAMERA_HZ, PAD_HZ = 200, 30, 100
"""Message rates [Hz]."""
PIPER_RAD_PER_DEG = 0.017444  # in piper_ros; π/180 would be 0.0174533, so published positions are 0.053 % too small
SCAN_S = 0.010  # a FlexiTac frame is read row by row during its whole period
OUTCOMES = ("success", "failure", "discard")
"""Values of a closing marker."""

Taxels = dict[str, list[tuple[int, int]]]  # pad name -> (row, column) in wire order
Gap = tuple[str, float, float]  # topic, from, to [s since the start]


@dataclass(frozen=True, kw_only=True)
class StandInConfig:
    """Settings of a stand-in recording. Faults are absent by default."""

    duration_s: float = 6.0
    """Duration of the recording [s]."""
    seed: int = 0
    """Seed of everything that is random."""
    episodes: int = 1
    """Number of episodes: equal time slots of at least 2 s, each with one attempt between its markers."""
    outcomes: tuple[str, ...] = ("success",)
    """Closing markers, repeated over the episodes; in an episode with ``failure`` the tube misses the hole."""
    instruction: str = "insert the test tube into the rack"
    """Task text of every episode."""
    camera_size: tuple[int, int] = (480, 640)
    """Rows and columns of pictures."""
    jpeg_quality: int = 85
    """JPEG quality of pictures, 0 … 100."""
    encoding: Literal["ros2", "json", "protobuf"] = "ros2"
    """Encoding of messages in MCAP files."""
    compression: Literal["none", "lz4", "zstd"] = "lz4"
    """Compression of MCAP chunks. The pictures are JPEG, which does not become smaller, so that a fast method suffices."""
    chunk_size_bytes: int = 1 << 20
    """Size of an MCAP chunk before compression [bytes]."""
    hdf5_jpeg: bool = True
    """HDF5 only. True: pictures as padded JPEG (attribute ``compress``); False: raw RGB."""

    # How arms and drivers behave. "Jitter" is the standard deviation of a normal draw; a latency adds its magnitude.
    command_lead_s: float = 0.08
    """Time constant with which the arms follow their commands [s]."""
    contact_delay_s: float = 0.03
    """Time from the fingers' stop to the pads' first count [s]."""
    camera_stamp_jitter_s: float = 0.0006
    """Standard deviation of the time of a picture from its tick [s]."""
    camera_latency_s: float = 0.030
    """Log time − stamp of pictures [s]."""
    camera_latency_jitter_s: float = 0.004
    """σ of the normal number whose absolute value is added to it [s]."""
    camera_loss_probability: float = 0.004
    """Probability that a picture is lost."""
    joint_latency_s: float = 0.0012
    """Log time − stamp of joint messages [s]."""
    joint_latency_jitter_s: float = 0.0004
    """σ of the normal number whose absolute value is added to it [s]."""
    joint_repeat_probability: float = 0.02
    """Probability that a joint message repeats the last values and stamp, because the driver's loop at 200 Hz found no new CAN
    frame."""
    command_silence_s: float = 0.04
    """Time until the first command on CAN [s]; before it, messages have stamp 0 and zeros."""
    pad_latency_s: float = 0.004
    """Time from the end of a scan to the end of the host's read [s]; the latter is the only time that a pad message has."""
    pad_latency_jitter_s: float = 0.0005
    """σ of the normal number whose absolute value is added to it [s]."""
    pad_noise_counts: float = 1.3
    """Standard deviation of the noise of each taxel and frame [counts]."""
    pad_gain_spread: float = 0.10
    """Standard deviation of the taxels' gains, relative to their mean."""

    # Faults
    joints_in_degrees: bool = False
    """Fault: joint messages are in degrees."""
    swap_arms: bool = False
    """Fault: the joint topics of each arm hold the other arm's messages (exchanged CAN adapters); cameras and pads are
    correct."""
    sim_time_stamps: bool = False
    """Fault: header stamps count from 0, while log times are wall-clock times."""
    clock_offset_s: dict[str, float] = field(default_factory=dict)
    """Fault: topic → time by which its clock is ahead [s]. It moves the header stamp, or the log time of messages without a
    header."""
    gap: Gap | list[Gap] | tuple[()] = ()
    """Fault: missing messages, (topic, from, to) in seconds since the start; one or several."""
    frozen_camera: str | None = None
    """Fault: name of a camera that repeats one picture, with new stamps, after a third of the recording."""
    dead_taxels: Taxels = field(default_factory=dict)
    """Fault: taxels that always read 0."""
    stuck_taxels: Taxels = field(default_factory=dict)
    """Fault: taxels that always read the same count between 60 and 120."""
    saturated_taxels: Taxels = field(default_factory=dict)
    """Fault: taxels that always read 255."""
    swap_pads: tuple[str, str] | None = None
    """Fault: two pads whose messages are published under each other's topic."""
    baseline_drift_counts_per_s: float = 0.0
    """Fault: rate at which all resting counts rise [counts/s]."""
    noise_only_touch: bool = False
    """Fault: the pads never read contact."""
    tactile_lag_s: float = 0.0
    """Fault: time by which all touch is late [s]."""

    @property
    def gaps(self) -> list[Gap]:
        """``gap`` as a list, empty if there is none."""
        given = self.gap
        return [given] if isinstance(given, tuple) and len(given) == 3 else list(given)

    def __post_init__(self) -> None:
        slot_s = self.duration_s / self.episodes
        if slot_s < SHORTEST_EPISODE_S:
            raise TaccorlError(
                f"stand-in: {self.episodes} episodes in {self.duration_s:g} s leave {slot_s:g} s each, but an episode takes "
                f"{SHORTEST_EPISODE_S:g} s. Raise duration_s or lower episodes."
            )
        if self.camera_size[0] < SMALLEST_PICTURE[0] or self.camera_size[1] < SMALLEST_PICTURE[1]:
            raise TaccorlError(
                f"stand-in: camera_size {self.camera_size} has no room for the frame id in its corner. "
                f"Take at least {SMALLEST_PICTURE} (rows, columns)."
            )
        _check_names("encoding", [self.encoding], ENCODINGS)
        _check_names("compression", [self.compression], ("none", "lz4", "zstd"))
        _check_names("outcomes", self.outcomes, OUTCOMES)
        _check_names("clock_offset_s", self.clock_offset_s, SPEC_TOPICS)
        _check_names("gap", [topic for topic, _, _ in self.gaps], SPEC_TOPICS)
        _check_names("frozen_camera", [self.frozen_camera] if self.frozen_camera else [], CAMERAS)
        for name in ("swap_pads", "dead_taxels", "stuck_taxels", "saturated_taxels"):
            _check_names(name, getattr(self, name) or (), PADS)


def _check_names(setting: str, given: Iterable[str], known: Iterable[str]) -> None:
    for name in given:
        if name not in known:
            raise TaccorlError(f"stand-in: {setting} has {name!r}; {nearest(name, known)}")

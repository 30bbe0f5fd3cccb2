"""Recordings of a small arm with three joints, a gripper and one camera, by arithmetic: as ROS 2 MCAP, ROS 1 bag or HDF5, with
the specs that read them. Faults are planted by changing the list of messages before it is written.
"""

import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from taccorl.cli.main import main

JOINTS = ("pan", "lift", "elbow", "grip")
T0_NS = 1_760_000_000_000_000_000
STATE, COMMAND, CAMERA = "/joint_states", "/commands", "/top/image"
ROWS, COLUMNS = 32, 48
_STAMP = "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
_HEADER = f"{'=' * 80}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n{'=' * 80}\n{_STAMP}"
SCHEMAS = {
    "sensor_msgs/msg/JointState": "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\n"
    f"float64[] effort\n{_HEADER}",
    "sensor_msgs/msg/CompressedImage": f"std_msgs/Header header\nstring format\nuint8[] data\n{_HEADER}",
    "sensor_msgs/msg/Image": "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\n"
    f"uint32 step\nuint8[] data\n{_HEADER}",
    "std_msgs/msg/String": "string data\n",
    "foxglove_msgs/msg/CompressedVideo": "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n"
    f"{'=' * 80}\n{_STAMP}",
}


def motion(time_s: float) -> np.ndarray:
    """(4,) joint angles [rad] and gripper opening [m]; they never repeat within a recording."""
    t = time_s
    return np.array(
        [
            0.4 * np.sin(1.3 * t),
            0.3 * np.cos(0.9 * t),
            0.2 * np.sin(0.7 * t) - 0.5,
            0.02 + 0.01 * np.sin(t),
        ]
    )


def scene(time_s: float) -> np.ndarray:
    """(ROWS, COLUMNS, 3) uint8 RGB: left half red, and a white bar that moves."""
    picture = np.zeros((ROWS, COLUMNS, 3), np.uint8)
    picture[:, : COLUMNS // 2] = (220, 20, 20)
    picture[
        8:16, (x := int((0.5 + 0.4 * np.sin(1.1 * time_s)) * (COLUMNS - 8))) : x + 8
    ] = 255
    return picture


def jpeg(picture: np.ndarray) -> bytes:
    return cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])[
        1
    ].tobytes()


@dataclass(frozen=True)
class Sent:
    """One message: kind, fields beside the header, and both of its times."""

    topic: str
    kind: str
    fields: dict[str, Any] = field(repr=False)
    stamp_ns: int
    log_ns: int

    def later(self, seconds: float, *, log: bool = True) -> "Sent":
        """The same message with its stamp, and log time, ``seconds`` later."""
        more = round(seconds * 1e9)
        return replace(
            self,
            stamp_ns=self.stamp_ns + more,
            log_ns=self.log_ns + (more if log else 0),
        )

    @property
    def time_s(self) -> float:
        return (self.stamp_ns - T0_NS) / 1e9


def joint_state(
    topic: str, time_s: float, names: Iterable[str], values: Iterable[float]
) -> Sent:
    """A JointState that is logged 0.5 ms after its stamp."""
    ns = T0_NS + round(time_s * 1e9)
    fields = {
        "name": list(names),
        "position": list(map(float, values)),
        "velocity": [],
        "effort": [],
    }
    return Sent(topic, "sensor_msgs/msg/JointState", fields, ns, ns + 500_000)


def compressed(time_s: float, data: bytes, form: str = "jpeg") -> Sent:
    ns = T0_NS + round(time_s * 1e9)
    return Sent(
        CAMERA,
        "sensor_msgs/msg/CompressedImage",
        {"format": form, "data": data},
        ns,
        ns + 4_000_000,
    )


def raw(time_s: float, encoding: str, pixels: np.ndarray, width: int = COLUMNS) -> Sent:
    """An Image whose rows are those of ``pixels`` (rows, …)."""
    ns = T0_NS + round(time_s * 1e9)
    fields = {
        "height": len(pixels),
        "width": width,
        "encoding": encoding,
        "is_bigendian": 0,
        "step": pixels[0].nbytes,
        "data": pixels.tobytes(),
    }
    return Sent(CAMERA, "sensor_msgs/msg/Image", fields, ns, ns + 4_000_000)


def text(topic: str, time_s: float, words: str) -> Sent:
    ns = T0_NS + round(time_s * 1e9)
    return Sent(topic, "std_msgs/msg/String", {"data": words}, ns, ns)


def video(
    seconds: float = 4.0, codec: str = "libx264", form: str = "h264", every: int = 15
) -> Callable[[float], Sent]:
    """Function from a time to the frame of a video without B-frames, a key frame each ``every`` ones."""
    import av

    encoder = av.CodecContext.create(codec, "w")
    assert isinstance(encoder, av.VideoCodecContext)
    encoder.width, encoder.height, encoder.pix_fmt = COLUMNS, ROWS, "yuv420p"
    encoder.time_base, encoder.gop_size, encoder.max_b_frames = (
        Fraction(1, 30),
        every,
        0,
    )
    encoder.options = {"tune": "zerolatency", "crf": "10"}
    packets: list[bytes] = []
    for k in range(round(seconds * 30)):
        frame = av.VideoFrame.from_ndarray(scene(k / 30), format="rgb24")
        frame.pts = k
        packets += map(bytes, encoder.encode(frame))
    packets += map(bytes, encoder.encode(None))

    def sent(time_s: float) -> Sent:
        ns = T0_NS + round(time_s * 1e9)
        fields = {"format": form, "data": packets[int(time_s * 30 + 1e-6)]}
        return Sent(
            CAMERA, "foxglove_msgs/msg/CompressedVideo", fields, ns, ns + 4_000_000
        )

    return sent


def messages(
    seconds: float = 4.0, picture: Callable[[float], Sent] | None = None
) -> list[Sent]:
    """An intact recording: state and command at 100 Hz, the command 50 ms ahead; the camera at 30 Hz."""
    found = []
    for k in range(round(seconds * 100)):
        t = k / 100
        found += [
            joint_state(STATE, t, JOINTS, motion(t)),
            joint_state(COMMAND, t, JOINTS, motion(t + 0.05)),
        ]
    picture = picture or (lambda t: compressed(t, jpeg(scene(t))))
    found += [picture(k / 30 + 0.003) for k in range(round(seconds * 30))]
    return sorted(found, key=lambda m: m.log_ns)


def write_mcap(path: Path, sent: Iterable[Sent], zstd: bool = False) -> Path:
    """Write messages in this order, whatever their times; with ``zstd`` each payload is compressed, as rosbag2 can."""
    import zstandard
    from mcap.writer import Writer
    from mcap_ros2._dynamic import (
        serialize_dynamic,
    )  # the same encoder as mcap_ros2.writer, without its file

    path.parent.mkdir(parents=True, exist_ok=True)
    encoders = {
        kind: serialize_dynamic(kind, text)[kind] for kind, text in SCHEMAS.items()
    }
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=1 << 14)
        writer.start()
        channels: dict[str, int] = {}
        for m in sent:
            if m.topic not in channels:
                schema = writer.register_schema(
                    m.kind, "ros2msg", SCHEMAS[m.kind].encode()
                )
                channels[m.topic] = writer.register_channel(m.topic, "cdr", schema)
            header = {
                "stamp": {"sec": m.stamp_ns // 10**9, "nanosec": m.stamp_ns % 10**9},
                "frame_id": "cam",
            }
            about = (
                {"timestamp": header["stamp"], "frame_id": "cam"}
                if "Video" in m.kind
                else {"header": header}
            )
            about = {} if m.kind.endswith("String") else about
            data = encoders[m.kind](about | m.fields)
            data = zstandard.ZstdCompressor().compress(data) if zstd else data
            writer.add_message(channels[m.topic], m.log_ns, data, m.log_ns)
        writer.finish()
    return path


def write_bag(path: Path, sent: Iterable[Sent], ros: int) -> Path:
    """Write messages in this order as a ROS 1 bag, or a ROS 2 bag of SQLite (a folder)."""
    from rosbags.rosbag1 import Writer as Bag1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Bag2
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)
    make = (
        Bag1(path)
        if ros == 1
        else Bag2(path, version=9, storage_plugin=StoragePlugin.SQLITE3)
    )
    kinds = store.types
    with make as bag:
        connections: dict[str, Any] = {}
        for m in sent:
            if m.topic not in connections:
                connections[m.topic] = bag.add_connection(
                    m.topic, m.kind, typestore=store
                )
            stamp = kinds["builtin_interfaces/msg/Time"](*divmod(m.stamp_ns, 10**9))
            header = {"stamp": stamp, "frame_id": "cam"} | (
                {"seq": 0} if ros == 1 else {}
            )
            values = {
                k: np.array(v) if k in ("position", "velocity", "effort") else v
                for k, v in m.fields.items()
            }
            values |= (
                {"data": np.frombuffer(m.fields["data"], np.uint8)}
                if "data" in m.fields
                else {}
            )
            message = kinds[m.kind](
                header=kinds["std_msgs/msg/Header"](**header), **values
            )
            encode = store.serialize_ros1 if ros == 1 else store.serialize_cdr
            bag.write(connections[m.topic], m.log_ns, encode(message, m.kind))
    return path


DATASET = """spec_version: 1
name: small_arm
robot_type: small_arm
fps: 30
action_time: next_row
features:
  observation.state: &joints
    dtype: float32
    shape: [4]
    names: [pan.pos, lift.pos, elbow.pos, grip.pos]
    unit: [rad, rad, rad, m]
    frame: joint
    rate_hz: 100
    range: {pan.pos: [-2, 2], lift.pos: [-2, 2], elbow.pos: [-2, 2], grip.pos: [0, 0.1]}
  action: *joints
  observation.images.top: {dtype: video, shape: [32, 48, 3], unit: rgb8, frame: top, rate_hz: 30, range: [0, 255]}
"""
RECORDING = """spec_version: 1
dataset: dataset.yaml
reader: mcap
clock: header
episodes: {by: whole_file, min_s: 0.5}
instruction: {from: spec, text: put the cup on the plate}
channels:
  state: {topic: /joint_states, field: position, pick: [pan, lift, elbow, grip], rate_hz: 100, max_age_s: 0.1}
  command: {topic: /commands, field: position, pick: [pan, lift, elbow, grip], rate_hz: 100, max_age_s: 0.1}
  top: {topic: /top/image, rate_hz: 30, max_age_s: 0.1}
features:
  observation.state: {channels: [state], align: asof}
  action: {channels: [command], align: asof}
  observation.images.top: {channels: [top], align: asof}
"""
ROW_CHANNELS = """channels:
  state: {topic: /observations/qpos, rate_hz: 30, max_age_s: 0.1}
  command: {topic: /action, rate_hz: 30, max_age_s: 0.1, lead_frames: 1}
  top: {topic: /observations/images/top, rate_hz: 30, max_age_s: 0.1}
"""


def write_spec(folder: Path, *changes: tuple[str, str], reader: str = "mcap") -> Path:
    """Both specs in ``folder`` with texts replaced; the recording spec's path."""
    folder.mkdir(parents=True, exist_ok=True)
    text = RECORDING.replace("reader: mcap", f"reader: {reader}")
    if reader == "hdf5":
        head, rest = text.split("channels:", 1)
        text = (
            head.replace("clock: header", "clock: log")
            + ROW_CHANNELS
            + rest[rest.index("features:") :]
        )
    data = DATASET
    for old, new in changes:
        assert old in text + data, f"{old!r} is in neither spec"
        text, data = text.replace(old, new), data.replace(old, new)
    (folder / "dataset.yaml").write_text(data)
    (folder / "spec.yaml").write_text(text)
    return folder / "spec.yaml"


def arrays(rows: int = 120, start_s: float = 0.0) -> dict[str, np.ndarray]:
    """Path in an HDF5 file → values: an intact episode at 30 Hz."""
    times = start_s + np.arange(rows) / 30
    return {
        "/observations/qpos": np.stack([motion(t) for t in times]),
        "/action": np.stack([motion(t + 1 / 30) for t in times]),
        "/observations/images/top": np.stack([scene(t) for t in times]),
    }


def write_hdf5(path: Path, values: dict[str, np.ndarray], **attributes: Any) -> Path:
    import h5py

    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        file.attrs.update(attributes)
        for name, value in values.items():
            file[name] = value
    return path


def ingest(path: Path, spec: Path, *options: str) -> tuple[int, dict[str, Any]]:
    """``taccorl ingest`` beside the recording: exit status, and the recording's entry of the report (or the report)."""
    out = path.parent / "out"
    code = main(
        [
            "ingest",
            str(path),
            f"--spec={spec}",
            f"--out={out}",
            f"--store={path.parent / 'store'}",
            *options,
        ]
    )
    report = json.loads(out.with_name("out.ingest_report.json").read_text())
    return code, report["recordings"][0] if len(report["recordings"]) == 1 else report

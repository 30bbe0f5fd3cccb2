"""Small stand-in recordings, written once per configuration and decoded with the mcap packages' own decoders."""

import base64
import json
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory as ProtobufDecoder
from mcap_ros2.decoder import DecoderFactory as Ros2Decoder

from taccorl.surrogate.drivers import START_UNIX_NS
from tests.recordings.stand_in import StandInConfig, StandInTruth, write_mcap

SMALL: dict[str, Any] = {"duration_s": 3.0, "camera_size": (96, 128)}


@dataclass
class Recorded:
    """A recording, its truth, and what the decoders make of it."""

    path: Path
    truth: StandInTruth
    messages: dict[str, list[Any]]  # topic -> decoded messages
    log_s: dict[str, np.ndarray]
    schemas: dict[str, str]

    def stamps_s(self, topic: str) -> np.ndarray:
        """Header stamps of a ROS 2 topic, seconds since the start."""
        stamps = [(m.header.stamp.sec, m.header.stamp.nanosec) for m in self.messages[topic]]
        return np.array([(sec * 10**9 + nanosec - START_UNIX_NS) * 1e-9 for sec, nanosec in stamps])

    def positions(self, topic: str) -> np.ndarray:
        """(N, 7) as published."""
        return np.array([m.position for m in self.messages[topic]])

    def counts(self, topic: str) -> np.ndarray:
        """(N, 12, 32) as published."""
        return np.array([np.frombuffer(m.data, np.uint8) for m in self.messages[topic]]).reshape(-1, 12, 32).astype(int)


def decode(path: Path) -> Recorded:
    """Reads every topic that can be decoded; JSON by hand."""
    ros2, protobuf = Ros2Decoder(), ProtobufDecoder()
    messages, log_s, schemas = defaultdict(list), defaultdict(list), {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            if channel.topic == "/enable_srv/_service_event":
                continue
            assert schema is not None
            if channel.message_encoding == "json":
                value = json.loads(message.data)
            else:
                factory = ros2 if channel.message_encoding == "cdr" else protobuf
                decoder = factory.decoder_for(channel.message_encoding, schema)
                assert decoder is not None
                value = decoder(message.data)
            messages[channel.topic].append(value)
            log_s[channel.topic].append((message.log_time - START_UNIX_NS) * 1e-9)
            schemas[channel.topic] = schema.name
    return Recorded(path, None, messages, {k: np.array(v) for k, v in log_s.items()}, schemas)  # pyright: ignore


@pytest.fixture(scope="session")
def record(tmp_path_factory: pytest.TempPathFactory):
    """``record(**changes)`` writes a 3 s, 96 × 128 recording with these changes and decodes it."""
    made: dict[str, Recorded] = {}

    def make(**changes: Any) -> Recorded:
        config = StandInConfig(**(SMALL | changes))
        if repr(config) not in made:
            path = tmp_path_factory.mktemp("stand_in") / "recording.mcap"
            truth = write_mcap(path, config)
            made[repr(config)] = decode(path)
            made[repr(config)].truth = truth
        return made[repr(config)]

    return make


@pytest.fixture(scope="session")
def plain():
    """Turns ROS 2, JSON and protobuf messages of the same content into the same dict."""
    return _plain


def _plain(message: Any) -> dict[str, Any]:
    def of(thing: Any, *names: str) -> Any:
        for name in names:
            found = thing.get(name) if isinstance(thing, dict) else getattr(thing, name, None)
            if found is not None:
                return found
        return None

    def stamp(time: Any) -> tuple[int, int]:
        return of(time, "sec", "seconds"), of(time, "nanosec", "nsec", "nanos")

    picture_time, header = of(message, "timestamp"), of(message, "header")
    data = of(message, "data")
    if isinstance(data, str) and of(message, "format"):
        data = base64.b64decode(data)
    elif isinstance(data, list):
        data = bytes(data)
    time = picture_time if picture_time is not None else header and of(header, "stamp")
    return {
        "stamp": stamp(time) if time is not None else None,
        "frame": of(message, "frame_id") if picture_time is not None else header and of(header, "frame_id"),
        "data": data,
        "format": of(message, "format"),
        **{name: list(of(message, name) or []) for name in ("name", "position", "velocity", "effort")},
    }

"""Small stand-in recordings, written once per configuration and decoded with the mcap packages' own decoders."""

from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
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


def decode(path: Path) -> Recorded:
    ros2 = Ros2Decoder()
    messages, log_s, schemas = defaultdict(list), defaultdict(list), {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            if channel.topic == "/enable_srv/_service_event":
                continue
            assert schema is not None
            decoder = ros2.decoder_for(channel.message_encoding, schema)
            assert decoder is not None
            messages[channel.topic].append(decoder(message.data))
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

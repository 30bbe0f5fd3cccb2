"""What inspection measures is what was recorded."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from edited import rewrite

from taccorl.data.draft import draft_specs
from taccorl.data.inspection import Inventory, TopicSummary, inspect_source
from taccorl.data.recording import Source, TopicType, find_sources
from taccorl.surrogate.drivers import CAMERA_TOPICS, COMMAND_TOPICS, PAD_TOPICS, STATE_TOPICS
from tests.recordings.stand_in import StandInConfig, write_cobot_magic_hdf5, write_mcap

FRONT = CAMERA_TOPICS["front"]


def inspect(path: Path) -> Inventory:
    return inspect_source(*find_sources(path)[0])


def topic(inventory: Inventory, name: str) -> TopicSummary:
    [found] = [t for t in inventory.topics if t.topic == name]
    return found


@pytest.fixture(scope="module")
def stand_in(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Any]:
    path = tmp_path_factory.mktemp("stand_in") / "a.mcap"
    config = StandInConfig(duration_s=3.0, camera_size=(96, 128), gap=(FRONT, 1.0, 1.4), clock_offset_s={FRONT: -0.1})
    return path, write_mcap(path, config)


# ---- measured ----


def test_counts_rates_gaps_and_skews_are_those_of_the_recording(stand_in: tuple[Path, Any]) -> None:
    path, truth = stand_in
    found = inspect(path)
    assert len(found.topics) == 15  # 11 channels, the markers, and three that no spec names
    assert found.reader == "mcap"
    assert found.duration_s == pytest.approx(max(t.max() for t in truth.log_s.values()), abs=0.02)
    for name, times_s in truth.log_s.items():
        assert topic(found, name).num_messages == len(times_s)
    assert topic(found, STATE_TOPICS["left"]).rate_hz == pytest.approx(200, rel=1e-6)
    assert topic(found, PAD_TOPICS["left_robot_left_finger"]).rate_hz == pytest.approx(100, rel=0.01)
    front = topic(found, FRONT)
    steps = np.diff(truth.sampled_s[FRONT])
    assert front.longest_gap_s == pytest.approx(steps.max(), abs=1e-6)
    assert steps.max() > 0.4
    assert front.num_gaps == (steps > 1.5 * np.median(steps)).sum()
    # its clock is 0.1 s behind, so its log time is that much more after its stamp
    assert front.skew_s == pytest.approx(np.median(truth.log_s[FRONT] - truth.sampled_s[FRONT]) + 0.1, abs=1e-6)
    assert not front.sim_time


def test_repeated_and_zero_stamps_are_counted(stand_in: tuple[Path, Any]) -> None:
    path, truth = stand_in
    command = topic(inspect(path), COMMAND_TOPICS["right"])
    assert command.zero_stamps == 8  # 0.04 s at 200 Hz
    stamps = truth.sampled_s[COMMAND_TOPICS["right"]][8:]
    assert command.repeated == len(stamps) - len(np.unique(stamps))
    assert topic(inspect(path), STATE_TOPICS["right"]).zero_stamps == 0


# ---- which shipped spec fits ----


def test_a_shipped_spec_fits_only_with_its_types_and_its_markers(tmp_path: Path) -> None:
    small: dict[str, Any] = {"duration_s": 2.0, "camera_size": (96, 128)}
    write_mcap(tmp_path / "ros2.mcap", StandInConfig(**small))
    types = {FRONT: "foxglove_msgs/msg/CompressedImage"}
    rewrite(tmp_path / "ros2.mcap", tmp_path / "foxglove.mcap", list, types=types)
    write_mcap(tmp_path / "unmarked.mcap", StandInConfig(**small, gap=("/episode", 0.0, 9.0)))
    write_cobot_magic_hdf5(tmp_path / "a.hdf5", StandInConfig(**small))
    assert inspect(tmp_path / "ros2.mcap").fits == ("piper_flexitac_mcap",)
    assert inspect(tmp_path / "foxglove.mcap").fits == (), "its pictures are foxglove's CompressedImage"
    assert inspect(tmp_path / "unmarked.mcap").fits == (), "the spec wants /episode"
    assert inspect(tmp_path / "a.hdf5").fits == ("cobot_magic_hdf5",)


def test_what_cannot_be_decoded_is_named_once(stand_in: tuple[Path, Any]) -> None:
    [odd] = [t for t in inspect(stand_in[0]).topics if t.type.undecodable]
    assert odd.topic == "/enable_srv/_service_event"
    assert odd.problem.count(odd.topic) == 1
    nameless = TopicSummary("/x", TopicType("|V4", "hdf5", "not read"), 1, 0, 0, 0.0, 0.0, 0, False, 0.0, 0.0, 0, 0)
    assert nameless.problem == "/x: not read"
    inventory = Inventory(Source(Path("a\nb.h5"), ()), "hdf5", (nameless,), {}, ())
    assert "  # not used: /x: not read" in draft_specs(inventory).recording
    assert draft_specs(inventory).recording.startswith(r"# Draft from a\nb.h5: ")

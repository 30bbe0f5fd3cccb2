"""What inspection measures is what was recorded."""

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from taccorl.data.draft import draft_specs
from taccorl.data.inspection import Inventory, TopicSummary, inspect_source
from taccorl.data.recording import Source, TopicType, find_sources
from taccorl.errors import RecordingError
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


def test_simulation_time_is_recognised(tmp_path: Path) -> None:
    write_mcap(tmp_path / "a.mcap", StandInConfig(duration_s=2.0, camera_size=(96, 128), sim_time_stamps=True))
    found = inspect(tmp_path / "a.mcap")
    assert topic(found, FRONT).sim_time
    assert not topic(found, PAD_TOPICS["left_robot_left_finger"]).sim_time, "it has no stamp at all"
    assert found.fits == ("piper_flexitac_mcap",)
    [fault] = found.faults
    assert "simulation time" in fault and "/camera_f" in fault
    assert "clock: log" in draft_specs(found).recording


def test_damage_and_metadata_are_told(stand_in: tuple[Path, Any], tmp_path: Path) -> None:
    data = stand_in[0].read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) * 2 // 3])
    found = inspect(tmp_path / "cut.mcap")
    assert "without a footer" in found.damage[0].reason
    assert "it is damaged: cut.mcap bytes" in found.faults[0]
    assert found.metadata["taccorl"]["origin"] == "stand-in recording, not a robot"
    assert 0 < topic(found, FRONT).num_messages < 80


def test_names_of_joints_and_the_sensor_of_pads_are_those_in_the_messages(stand_in: tuple[Path, Any]) -> None:
    found = inspect(stand_in[0])
    assert found.faults == ()
    state = topic(found, STATE_TOPICS["left"])
    assert state.names == ("joint1", "joint2", "joint3", "joint4", "joint5", "joint6", "gripper")
    assert (state.num_values, state.sensor) == (7, None)
    for pad in PAD_TOPICS.values():
        assert (topic(found, pad).num_values, topic(found, pad).sensor) == (384, "flexitac_v2")
    assert topic(found, FRONT).num_values is None


def test_a_file_without_a_rate_has_no_times(tmp_path: Path) -> None:
    write_cobot_magic_hdf5(tmp_path / "a.hdf5", StandInConfig(duration_s=2.0, camera_size=(96, 128)))
    assert not inspect(tmp_path / "a.hdf5").times_known
    with h5py.File(tmp_path / "a.hdf5", "a") as file:
        file.attrs["fps"] = 25
    found = inspect(tmp_path / "a.hdf5")
    assert found.times_known
    assert topic(found, "/action").rate_hz == pytest.approx(25)


def test_an_empty_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").touch()
    with pytest.raises(RecordingError, match="is empty"):
        inspect(tmp_path / "a.mcap")


# ---- which shipped spec fits ----


def test_a_shipped_spec_fits_only_with_its_types_and_its_markers(tmp_path: Path) -> None:
    small: dict[str, Any] = {"duration_s": 2.0, "camera_size": (96, 128)}
    write_mcap(tmp_path / "ros2.mcap", StandInConfig(**small))
    write_mcap(tmp_path / "json.mcap", StandInConfig(**small, encoding="json"))
    write_mcap(tmp_path / "unmarked.mcap", StandInConfig(**small, gap=("/episode", 0.0, 9.0)))
    write_cobot_magic_hdf5(tmp_path / "a.hdf5", StandInConfig(**small))
    assert inspect(tmp_path / "ros2.mcap").fits == ("piper_flexitac_mcap",)
    assert inspect(tmp_path / "json.mcap").fits == (), "its pictures are foxglove.CompressedImage"
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

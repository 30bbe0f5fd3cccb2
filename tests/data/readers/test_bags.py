"""Bags that other people's tools wrote. They are not part of the project: skipped where shared/data/bags is missing."""

from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from taccorl.data.recording import find_sources, readers
from taccorl.errors import RecordingError

BAGS = Path(__file__).resolve().parents[3] / "../shared/data/bags"
pytestmark = pytest.mark.skipif(not BAGS.is_dir(), reason=f"no folder {BAGS.resolve()}")


def open_bag(name: str, *, split_bag: bool = False) -> Any:
    ((reader, source),) = find_sources(BAGS / name, split_bag=split_bag)
    return readers.get(reader)(source)


def counts(reader: Any) -> dict[str, int]:
    """Messages per topic; every message's times are read, none is decoded."""
    found = Counter()
    for message in reader.messages(None):
        assert message.value is None
        found[message.topic] += 1
    return dict(found)


def test_plotjugglers_bag_has_what_its_metadata_counts() -> None:
    reader = open_bag("plotjuggler_imu_db3")
    assert counts(reader) == {"/imu": 1565, "/battery": 1565, "/pose": 1565}
    assert reader.damage == []
    assert set(reader.topics()) == {"/imu", "/battery", "/pose", "/rosout", "/parameter_events"}
    found = list(reader.messages({"/imu", "/battery", "/pose"}))
    assert found[0].log_ns == 1588512872785162138  # starting_time and duration of metadata.yaml
    assert max(m.log_ns for m in found) - found[0].log_ns == 62560451324
    first = {m.topic: m for m in reversed(found)}
    assert first["/imu"].stamp_ns == 1588512872784906481
    assert first["/imu"].value.orientation_covariance.tolist() == list(range(9))
    assert first["/imu"].value.header.frame_id == "hello_world"


def test_rosbag2s_own_seek_bag_is_read_though_its_type_is_defined_nowhere() -> None:
    reader = open_bag("rosbag2_seek_db3")
    assert [m.log_ns for m in reader.messages(None)] == [1_000_000_000 + k * 100_000_000 for k in range(5)]
    assert "does not define test_msgs/msg/BasicTypes" in reader.topics()["topic1"].undecodable
    with pytest.raises(RecordingError, match="topic1: the bag does not define"):
        list(reader.messages({"topic1"}))


def test_service_events_do_not_take_the_other_topics_along() -> None:
    reader = open_bag("rosbag2_tests_mcap/bag_with_topics_and_service_events")
    events = {f"/test_service{n}/_service_event": 4 for n in (1, 2)}
    assert counts(reader) == {**events, "/test_topic1": 1, "/test_topic2": 1}
    assert {t for t, kind in reader.topics().items() if kind.undecodable} == set(events)
    (message,) = reader.messages({"/test_topic1"})
    assert isinstance(message.value.string_value, str)
    with pytest.raises(RecordingError, match="/test_service1/_service_event: its schema"):
        list(reader.messages({"/test_service1/_service_event"}))


def test_an_early_mcap_bag_decodes() -> None:
    reader = open_bag("rosbag2_tests_mcap/cdr_test")
    assert counts(reader) == {"/test_topic": 3, "/array_topic": 4}
    found = list(reader.messages({"/test_topic", "/array_topic"}))
    assert found[0].log_ns == 1586406456763032325
    assert all(m.stamp_ns is None for m in found)
    assert {type(m.value).__name__.rpartition("_")[2] for m in found} == {"BasicTypes", "Arrays"}


def test_a_wrong_encoding_is_named_only_when_asked_for() -> None:
    reader = open_bag("rosbag2_tests_mcap/wrong_rmw_test")
    assert counts(reader) == {"/test_topic": 3, "/array_topic": 4}
    with pytest.raises(RecordingError, match="'wrong_format' messages"):
        list(reader.messages({"/test_topic"}))


def test_five_files_of_a_split_bag_are_one_recording_in_order() -> None:
    reader = open_bag("rosbag2_wbag_split", split_bag=True)
    assert [p.name for p in reader.source.files] == [f"wbag_{n}.mcap" for n in range(5)]
    log_ns = [m.log_ns for m in reader.messages(None)]
    assert len(log_ns) == sum(counts(reader).values()) == 6074
    assert set(counts(reader)) == {c * 3 for c in "ABCDEFGH"}
    assert log_ns == sorted(log_ns)
    assert all(isinstance(m.value.data, str) for m in reader.messages({"AAA"}))
    assert len(find_sources(BAGS / "rosbag2_wbag_split")) == 5  # unless the spec says split_bag: five recordings

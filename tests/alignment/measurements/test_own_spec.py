"""Recordings of an own robot without a recording spec: the same rows as a table of them, at the streams' own rates."""

from pathlib import Path

import numpy as np
import pytest
from small_arm import Sent, arrays, joint_state, write_bag, write_hdf5, write_mcap

from taccorl.alignment.measurements.folder import read_measurements
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.errors import RecordingError

UNITS = {"joint_1": "rad", "joint_2": "rad", "slide": "m"}
RATE_HZ, SECONDS = 250, 3.0
TIMES = np.arange(round(RATE_HZ * SECONDS)) / RATE_HZ


def motion(times: np.ndarray) -> np.ndarray:
    """(T, 3) of the joints, in the order of ``UNITS``."""
    return np.stack(
        [0.4 * np.sin(2 * times), 0.3 * np.cos(3 * times), 0.05 * np.sin(times)], axis=1
    )


def sent(
    names: tuple[str, ...] = (*UNITS, "camera_pan"),
    states: str = "/joint_states",
    commands: str = "/joint_commands",
    commanded: tuple[str, ...] = (*UNITS,),
) -> list[Sent]:
    """States of ``names`` at 250 Hz, which follow targets by 20 ms; a joint that the robot file lacks is among them."""
    out: list[Sent] = []
    for time_s in TIMES:
        at = dict(zip(UNITS, motion(np.array([time_s - 0.02]))[0], strict=True))
        to = dict(zip(UNITS, motion(np.array([time_s]))[0], strict=True))
        out.append(joint_state(states, time_s, names, [at.get(n, 0.0) for n in names]))
        if commands:
            out.append(
                joint_state(
                    commands, time_s, commanded, [to.get(n, 0.0) for n in commanded]
                )
            )
    return out


def read(path: Path, units: dict[str, str] = UNITS) -> Measurement:
    return read_measurements(path, units=units, fit_needed=False).all[0]


WRITERS = {
    "mcap": lambda folder, sent: write_mcap(folder / "a.mcap", sent),
    "ROS 2 bag": lambda folder, sent: write_bag(folder / "bag", sent, ros=2),
    "ROS 1 bag": lambda folder, sent: write_bag(folder / "a.bag", sent, ros=1),
}


@pytest.mark.parametrize("write", WRITERS.values(), ids=list(WRITERS))
def test_joints_are_read_at_their_own_rate_by_their_names(write, tmp_path):
    m = read(write(tmp_path, sent()))
    assert m.signals == tuple(UNITS)
    assert m.units == ("rad", "rad", "m")
    assert np.diff(m.time_s) == pytest.approx(1 / RATE_HZ)
    assert m.num_rows >= len(TIMES) - 3
    at = m.time_s[0] + np.arange(m.num_rows) / RATE_HZ
    np.testing.assert_allclose(m.target, motion(at), atol=1e-5)
    np.testing.assert_allclose(m.measured, motion(at - 0.02), atol=1e-5)


def test_the_topics_that_were_taken_are_a_note(tmp_path):
    (found,) = [
        f
        for f in read(write_mcap(tmp_path / "a.mcap", sent())).findings
        if f.check == "own_topics"
    ]
    assert found.severity == "note"
    assert "/joint_states" in found.text and "/joint_commands" in found.text


def test_the_order_of_the_commands_names_does_not_matter(tmp_path):
    turned = tuple(reversed(UNITS))
    m = read(write_mcap(tmp_path / "a.mcap", sent(commanded=turned)))
    at = m.time_s[0] + np.arange(m.num_rows) / RATE_HZ
    for name, of_motion in zip(UNITS, motion(at).T, strict=True):
        column = m.signals.index(name)
        np.testing.assert_allclose(m.target[:, column], of_motion, atol=1e-5)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"commands": ""}, "targets: none"),
        ({"names": ("a", "b", "c")}, "positions: none"),
        ({"commanded": ("joint_1",)}, "targets: joint_1"),
    ],
    ids=["no targets", "other names", "not all targets"],
)
def test_what_is_not_to_be_seen_is_refused_with_the_way_out(changes, words, tmp_path):
    path = write_mcap(tmp_path / "a.mcap", sent(**changes))
    with pytest.raises(RecordingError) as refused:
        read(path)
    text = str(refused.value)
    assert words in text
    assert f"taccorl ingest inspect {path} --draft=spec.yaml" in text


def test_hdf5_has_no_names_and_asks_for_a_spec(tmp_path):
    path = write_hdf5(tmp_path / "a.h5", arrays())
    with pytest.raises(RecordingError, match=r"--draft=spec\.yaml"):
        read(path)


def test_a_recording_of_the_shipped_robot_keeps_its_spec(tmp_path):
    """Its joints are those of the shipped specs, so that none is made up."""
    path = write_mcap(tmp_path / "a.mcap", sent())
    with pytest.raises(RecordingError, match="joint_states_left"):
        read_measurements(path, fit_needed=False)


def test_stamps_are_those_of_the_headers(tmp_path):
    """Messages that are logged late are not late."""
    late = [
        Sent(s.topic, s.kind, s.fields, s.stamp_ns, s.log_ns + 5_000_000 * (k % 3))
        for k, s in enumerate(sent())
    ]
    m = read(write_mcap(tmp_path / "a.mcap", late))
    at = m.time_s[0] + np.arange(m.num_rows) / RATE_HZ
    np.testing.assert_allclose(m.measured, motion(at - 0.02), atol=1e-5)

"""``taccorl compare`` and ``diagnose`` of MCAP recordings with pads of any number and
shape: joints are compared, and what of touch is not compared is named."""

import base64
import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer

from taccorl.alignment.measurements.folder import (
    Measurements,
    PressedNote,
    read_measurements,
)
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.alignment.touch.motion import twin_pads
from taccorl.diagnosis.comparison.replays import in_contact
from taccorl.diagnosis.machines.piper import PiperTwin
from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.twin import TwinConfig

Pads = Mapping[str, tuple[int, int]]
JOINTS = [*(f"joint{k}" for k in range(1, 7)), "gripper"]
REST = np.array([0.0, 1.2, -1.2, 0.0, 0.3, 0.0, 0.04])
START_NS = 1_780_000_000 * 10**9
DURATION_S = 2.5
PRESSED_S = (1.0, 1.5)
REST_COUNT = 20
GAIN_PER_COUNT = 0.01  # 0.4 / 0.01: in contact above 40 counts
FLEXITAC = ROBOT.pad.shape
CASES: dict[str, Pads] = {
    "one": {"palm": (16, 16)},
    "two": {"inner": (8, 8), "outer": (8, 8)},
    "two of the twin's names": {"left_a": (8, 8), "left_b": (8, 8)},
    "three": {"palm": (4, 6), "left_a": (8, 8), "tip": (1, 5)},
    "four": dict.fromkeys(ROBOT.pads, (16, 16)),
}
SENSOR = """spec_version: 1
name: pad_{rows}x{columns}
rows: {rows}
columns: {columns}
wire: {{rows: {rows}, columns: {columns}, dtype: uint8, transpose: false}}
adc_bits: 8
wire_shift_bits: 0
rate_hz: 100
scan_time_s: 0.01
unit: adc_count
baseline: {{rule: median_of_first, frames: 30, max_spread_count: 12}}
noise_count: 15
scheme: fixed_scale
gain_per_count: {gain}
"""


def joints_at(time_s: float) -> np.ndarray:
    """(7,) [rad, m]: joint 5 swings from 0.3 s on."""
    swing = 0.3 * np.sin(3.0 * max(time_s - 0.3, 0.0))
    return REST + swing * (np.arange(7) == 4)


def frame_at(time_s: float, shape: tuple[int, int], press_count: int) -> np.ndarray:
    """Counts of a pad: noise of one count, and one pressed taxel for a while."""
    noise = (np.arange(np.prod(shape)) + round(100 * time_s)) % 3 - 1
    frame = REST_COUNT + noise
    if PRESSED_S[0] < time_s < PRESSED_S[1]:
        frame[0] = REST_COUNT + press_count
    return frame.astype(np.uint8)


def record(folder: Path, pads: Pads, press_count: int = 100) -> Path:
    """An MCAP of one PiPER arm with ``pads``, and its spec, in ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    events = []
    for k in range(round(DURATION_S * 200)):
        for topic, lag_s in (("/state", 0.01), ("/command", 0.0)):
            values = joints_at(k / 200 - lag_s)
            values = values + 1e-4 * np.sin(7.7 * k * (1 + np.arange(7)))
            message = {"name": JOINTS, "position": values.tolist()}
            events.append((5_000_000 * k, topic, message))
    for k in range(round(DURATION_S * 100)):
        for name, shape in pads.items():
            frame = frame_at(k / 100, shape, press_count)
            data = base64.b64encode(frame.tobytes()).decode()
            events.append((10_000_000 * k, f"/{name}", {"data": data}))
    path = folder / "rec.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        topics = {topic for _, topic, _ in events}
        channels = {t: writer.register_channel(t, "json", 0) for t in sorted(topics)}
        for after_ns, topic, message in sorted(events, key=lambda event: event[0]):
            at = START_NS + after_ns
            writer.add_message(channels[topic], at, json.dumps(message).encode(), at)
        writer.finish()
    write_spec(folder, pads)
    return path


def write_spec(folder: Path, pads: Pads) -> None:
    """One feature for each shape of pad, since a feature has one sensor."""
    features, mappings, channels = [], [], []
    for k, shape in enumerate(dict.fromkeys(pads.values())):
        names = [name for name, own in pads.items() if own == shape]
        numbers = {"rows": shape[0], "columns": shape[1], "gain": GAIN_PER_COUNT}
        (folder / f"sensor_{k}.yaml").write_text(SENSOR.format(**numbers))
        key = "observation.tactile" + (f".kind_{k}" if k else "")
        features.append(
            f"  {key}: {{dtype: int16, shape: [{len(names) * int(np.prod(shape))}], "
            "unit: adc_count, frame: pad, rate_hz: 100, range: [-255, 255], "
            f"sensor: sensor_{k}.yaml, pads: [{', '.join(names)}]}}"
        )
        mappings.append(f"  {key}: {{channels: [{', '.join(names)}], align: asof}}")
    for name in pads:
        channels.append(
            f"  {name}: {{topic: /{name}, field: data, rate_hz: 100, max_age_s: 0.04}}"
        )
    elements = [*(f"left_joint_{k}.pos" for k in range(1, 7)), "left_gripper.pos"]
    joint = "field: position, rate_hz: 200, max_age_s: 0.05"
    pick = f"pick: [{', '.join(JOINTS)}]"
    (folder / "dataset.yaml").write_text(
        "spec_version: 1\nname: mine\nrobot_type: mine\nfps: 30\n"
        "action_time: next_row\nfeatures:\n"
        f"  observation.state: &joints {{dtype: float32, shape: [7], "
        f"names: [{', '.join(elements)}], unit: [rad, rad, rad, rad, rad, rad, m], "
        "frame: joint, rate_hz: 200, range: [-4, 4]}\n"
        "  action: *joints\n" + "\n".join(features) + "\n"
    )
    (folder / "spec.yaml").write_text(
        "spec_version: 1\ndataset: dataset.yaml\nreader: mcap\nclock: log\n"
        "episodes: {by: whole_file}\ninstruction: {from: spec, text: press}\n"
        f"channels:\n  state: {{topic: /state, {pick}, {joint}}}\n"
        f"  command: {{topic: /command, {pick}, {joint}}}\n"
        + "\n".join(channels)
        + "\nfeatures:\n  observation.state: {channels: [state], align: asof}\n"
        "  action: {channels: [command], align: asof}\n" + "\n".join(mappings) + "\n"
    )


def measured(path: Path) -> Measurement:
    (found,) = read_measurements(path, spec=path.with_name("spec.yaml")).fit
    return found


def named(text: str, pads: Pads) -> bool:
    return all(f"{name} ({r}×{c})" in text for name, (r, c) in pads.items())


@pytest.mark.parametrize("case", CASES)
def test_joints_are_compared_beside_any_pads(case, tmp_path):
    m = measured(record(tmp_path, CASES[case], press_count=0))
    found = PiperTwin.nominal().compare(Measurements((m,)))
    assert [trace.signal for trace in found.traces] == ["left_joint5"]
    (line,) = found.left_out
    assert line.startswith("touch of rec.mcap: ") and named(line, CASES[case])


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_the_command_says_what_of_touch_is_not_compared(case, said, tmp_path):
    path = record(tmp_path / "in", CASES[case])
    out = tmp_path / "report"
    spec = path.with_name("spec.yaml")
    code, text = said("compare", path, f"--spec={spec}", f"--out={out}")
    assert code == 0
    report = json.loads((out / "report.json").read_text())
    (line,) = [t for t in report["not_compared"] if t.startswith("touch")]
    assert named(line, CASES[case])
    assert line in text


@pytest.mark.slow
def test_diagnose_names_the_touch_that_is_not_compared(said, tmp_path):
    path = record(tmp_path / "in", CASES["two"], press_count=0)
    spec = path.with_name("spec.yaml")
    _, text = said("diagnose", path, f"--spec={spec}", "--out=found")
    (line,) = [t for t in text.splitlines() if t.startswith("not compared: touch")]
    assert named(line, CASES["two"])
    assert (tmp_path / "found" / "report.json").is_file()


@pytest.mark.parametrize(
    ("press_count", "is_pressed"), [(30, False), (37, False), (45, True), (200, True)]
)
def test_contact_follows_the_gain_of_the_pad(press_count, is_pressed, tmp_path):
    """0.4 / 0.01: more than 40 counts; a count of noise either way, and 20 at rest.
    Pads that name no arm are on the arm that was measured."""
    m = measured(record(tmp_path, CASES["two"], press_count))
    expected = (m.time_s > PRESSED_S[0] + 0.05) & (m.time_s < PRESSED_S[1] - 0.05)
    found = in_contact(m.on_robot(np.zeros(14)))
    assert found[expected, 0].all() == found[:, 0].any() == is_pressed
    assert not found[~expected & (np.abs(m.time_s - 1.25) > 0.4), 0].any()
    assert not found[:, 1].any()


def test_the_pads_of_the_twin_are_found_among_others(tmp_path):
    """left_a and left_b are the twin's, `tip` is not; the counts of each are its own."""
    pads = {"tip": (1, 5), "left_a": FLEXITAC, "left_b": FLEXITAC}
    touch = measured(record(tmp_path, pads)).touch
    assert touch is not None
    assert [pad.name for pad in touch.without([*twin_pads(TwinConfig()).values()])] == [
        "tip"
    ]
    shapes = {pad.name: part.counts.shape[1] for pad, part in touch.parts.items()}
    assert shapes == {"tip": 5, "left_a": 384, "left_b": 384}
    for part in touch.parts.values():  # one taxel of each was pressed by 100 counts
        assert part.counts.max() == pytest.approx(100, abs=2)
        assert (part.counts.max(axis=0) > 50).sum() == 1


def test_an_object_pressed_by_other_pads_is_named_when_nothing_is_left(tmp_path):
    ball = PressedNote(shape="sphere", radius_m=0.012, arm="left").made()
    m = measured(record(tmp_path, CASES["two of the twin's names"]))
    pressed = Measurements((dataclasses.replace(m, pressed=ball),))
    with pytest.raises(TaccorlError, match=r"left_a .8×8.*the twin's left arm has"):
        PiperTwin.nominal().parts(pressed)


def test_touch_without_a_sensor_is_not_read_and_says_so(tmp_path):
    path = record(tmp_path, CASES["two"], press_count=0)
    dataset = tmp_path / "dataset.yaml"
    text = dataset.read_text()
    dataset.write_text(
        text.replace(", sensor: sensor_0.yaml, pads: [inner, outer]", "")
    )
    m = measured(path)
    assert m.touch is None
    found = PiperTwin.nominal().compare(Measurements((m,)))
    assert [trace.signal for trace in found.traces] == ["left_joint5"]
    (line,) = found.left_out
    assert "observation.tactile" in line and "sensor" in line

"""The data contract: shipped specs load, digests see what matters and nothing else, every broken relation has its own error."""

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from taccorl.data.sensor_spec import load_sensor_spec
from taccorl.data.spec import (
    RecordingSpec,
    data_specs_folder,
    find_spec,
    load_dataset_spec,
    load_recording_spec,
)
from taccorl.errors import SpecError

REMOVE = object()

# Two joints and two 2 × 3 pads: everything that the shipped specs have, small enough to do the arithmetic by hand.
SENSOR = yaml.safe_load("""
spec_version: 1
name: little_pad
rows: 2
columns: 3
wire: {rows: 3, columns: 2, dtype: uint8, transpose: true}
adc_bits: 10
wire_shift_bits: 2
rate_hz: 100.0
scan_time_s: 0.01
unit: adc_count
baseline: {rule: median_of_first, frames: 5, max_spread_count: 12.0}
noise_count: 15.0
scheme: fixed_scale
gain_per_count: 0.0133
""")
PADS = "dtype: int16, unit: adc_count, frame: pad, rate_hz: 100.0, range: [-255.0, 255.0], pads: [a, b]"
ARM = (
    "dtype: float32, shape: [2], names: [joint, gripper], frame: joint, rate_hz: 200.0"
)
DATASET = yaml.safe_load(f"""
spec_version: 1
name: little
robot_type: one_arm
fps: 30
action_time: next_row
video_codec: h264
features:
  observation.state: {{{ARM}, unit: [rad, m], range: {{joint: [-1.5, 1.5], gripper: [0.0, 0.1]}}}}
  action: {{{ARM}, unit: rad, range: [-2.0, 2.0]}}
  observation.images.front:
    {{dtype: video, shape: [64, 96, 3], unit: rgb8, frame: camera, rate_hz: 30.0, range: [0.0, 255.0]}}
  observation.tactile: {{{PADS}, sensor: pad.yaml, shape: [12]}}
  observation.tactile_window: {{{PADS}, sensor: pad.yaml, shape: [48], history: 4, optional: true}}
""")
PAD_CHANNEL = (
    "field: data, clock: log, latency_s: 0.01, rate_hz: 100.0, max_age_s: 0.04"
)
JOINTS = "topic: /joints, type: sensor_msgs/msg/JointState, field: position, pick: [j1, g], scale: [1.5, 1.0]"
RECORDING = yaml.safe_load(f"""
spec_version: 1
dataset: dataset.yaml
reader: mcap
clock: header
split_bag: false
max_clock_spread_s: 0.25
episodes: {{by: markers, topic: /episode, min_s: 1.0}}
instruction: {{from: markers}}
channels:
  state: {{{JOINTS}, rate_hz: 200.0, max_age_s: 0.03}}
  command: {{topic: /command, field: position, rate_hz: 200.0, drop_zero_stamp: true}}
  front: {{topic: /camera, rate_hz: 30.0, max_age_s: 0.08, channel_order: rgb}}
  pad_a: {{topic: /pad_a, {PAD_CHANNEL}}}
  pad_b: {{topic: /pad_b, {PAD_CHANNEL}}}
features:
  observation.state: {{channels: [state], align: asof}}
  action: {{channels: [command], align: hold}}
  observation.images.front: {{channels: [front], align: asof}}
  observation.tactile: {{channels: [pad_a, pad_b], align: asof}}
  observation.tactile_window: {{channels: [pad_a, pad_b], align: window}}
""")
FILES = {"pad": SENSOR, "dataset": DATASET, "recording": RECORDING}


def changed(
    document: dict[str, Any], path: tuple[Any, ...], value: Any
) -> dict[str, Any]:
    """A copy with one leaf set or removed."""
    out = copy.deepcopy(document)
    node: Any = out
    for part in path[:-1]:
        node = node[part]
    if value is REMOVE:
        del node[path[-1]]
    else:
        node[path[-1]] = value
    return out


def write(folder: Path, **documents: dict[str, Any]) -> Path:
    """The three files, some of them replaced; returns the recording spec's path."""
    for name, document in {**FILES, **documents}.items():
        (folder / f"{name}.yaml").write_text(yaml.safe_dump(document, sort_keys=False))
    return folder / "recording.yaml"


def leaves(node: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    items = (
        node.items()
        if isinstance(node, dict)
        else enumerate(node)
        if isinstance(node, list)
        else None
    )
    if items is None:
        return [path]
    return [leaf for key, child in items for leaf in leaves(child, (*path, key))]


@pytest.mark.parametrize(
    "path", sorted(data_specs_folder().rglob("*.yaml")), ids=lambda p: p.stem
)
def test_every_shipped_spec_loads(path):
    loaders = {"sensors": load_sensor_spec, "recordings": load_recording_spec}
    load = loaders.get(path.parent.name, load_dataset_spec)
    assert load(path).spec_version == 1 and find_spec(path.stem) == path


def test_shipped_tactile_numbers_are_the_papers():
    spec = load_recording_spec("piper_flexitac_mcap").target
    tactile, sensor = (
        spec.features["observation.tactile"],
        spec.sensors["observation.tactile"],
    )
    assert tactile.size == 4 * 32 * 12 == 1536
    assert spec.features["observation.tactile_window"].size == 10 * 1536
    assert sensor.max_count == (1023 >> 2) == 255
    assert abs(sensor.gain_per_count * 30 - 0.4) < 1e-6  # λ_f = 0.4 means 30 counts
    assert spec.keys("tactile") == ["observation.tactile", "observation.tactile_window"]
    assert spec.keys("vector") == ["observation.state", "action"]
    assert spec.keys("video") == [
        f"observation.images.{c}" for c in ("front", "left_wrist", "right_wrist")
    ]


def test_pipers_angle_factor_is_the_one_that_its_driver_lost():
    spec = load_recording_spec("piper_flexitac_mcap")
    for name in ("left_state", "right_state", "left_command", "right_command"):
        assert np.allclose(
            spec.channels[name].scale[:6], (np.pi / 180) / 0.017444, rtol=1e-6, atol=0
        )
        assert spec.channels[name].scale[6] == 1.0  # the gripper is in metres


def test_the_little_spec_loads_and_its_limits_stand_in_the_order_of_the_names(tmp_path):
    spec = load_recording_spec(write(tmp_path))
    assert spec.target.features["observation.state"].limits.tolist() == [
        [-1.5, 1.5],
        [0.0, 0.1],
    ]
    assert spec.target.features["action"].limits.tolist() == [[-2.0, 2.0], [-2.0, 2.0]]
    assert list(spec.mapped) == list(DATASET["features"])
    assert [spec.clock_of(c) for c in ("state", "pad_a")] == ["header", "log"]


def test_an_optional_feature_may_stay_empty_and_is_not_mapped(tmp_path):
    spec = load_recording_spec(
        write(tmp_path, recording=changed(RECORDING, WINDOW, REMOVE))
    )
    assert list(spec.mapped) == [
        k for k in DATASET["features"] if k != "observation.tactile_window"
    ]


def test_digest_ignores_comments_layout_and_the_order_of_keys(tmp_path):
    path = write(tmp_path)
    before = load_recording_spec(path).digest
    for name, document in FILES.items():
        text = yaml.safe_dump(
            document, sort_keys=True, default_flow_style=True, width=60
        )
        (tmp_path / f"{name}.yaml").write_text(f"# another layout\n{text}\n# the end\n")
    assert load_recording_spec(path).digest == before
    spelled = changed(
        RECORDING, ("channels", "state", "rate_hz"), 200
    )  # an integer for the same rate
    assert load_recording_spec(write(tmp_path, recording=spelled)).digest == before
    defaults = changed(
        RECORDING, ("split_bag",), REMOVE
    )  # it was written out with its default
    assert load_recording_spec(write(tmp_path, recording=defaults)).digest == before


SLOW = pytest.mark.slow
OTHER_WORDS = [
    "hdf5", "log", "header", "h264", "libsvtav1", "hold", "asof", "bgr", "int16", "uint16", "topic", "/other", "other", "unknown",
]  # fmt: skip


@pytest.mark.parametrize(
    ("name", "num_changed", "relations"),
    [
        (
            "pad",
            10,
            "spec_version rows columns wire.rows wire.columns wire.transpose adc_bits baseline.rule scheme",
        ),
        pytest.param(
            "dataset",
            43,
            "spec_version action_time dtype shape names sensor history",
            marks=SLOW,
        ),
        pytest.param(
            "recording", 35, "spec_version dataset by from channels align", marks=SLOW
        ),
    ],
)
def test_digest_changes_with_every_leaf(tmp_path, name, num_changed, relations):
    """One leaf at a time to another valid value. Those without one are relations, not settings, and named here."""
    before = load_recording_spec(write(tmp_path)).digest
    document, unchangeable = FILES[name], []
    for path in leaves(document):
        old: Any = document
        for part in path:
            old = old[part]
        if isinstance(old, bool):
            candidates: list[Any] = [not old]
        elif isinstance(old, int | float):
            candidates = [
                v
                for v in (
                    old + 1,
                    old * 2,
                    type(old)(old * 1.25),
                    type(old)(old + 0.01),
                )
                if v != old
            ]
        else:
            candidates = [w for w in OTHER_WORDS if w != old]
        for value in candidates:
            try:
                after = load_recording_spec(
                    write(tmp_path, **{name: changed(document, path, value)})
                ).digest
            except SpecError:
                continue
            assert after != before, (path, value)
            break
        else:
            unchangeable.append(path)
    assert len(leaves(document)) - len(unchangeable) == num_changed
    last = {
        next(p for p in reversed(path) if isinstance(p, str)) for path in unchangeable
    }
    named = {".".join(path) for path in unchangeable} if name == "pad" else last
    assert named == set(relations.split())


def test_digest_sees_which_pad_comes_first(tmp_path):
    before = load_recording_spec(write(tmp_path)).digest
    swapped = changed(RECORDING, (*TACTILE, "channels"), ["pad_b", "pad_a"])
    assert load_recording_spec(write(tmp_path, recording=swapped)).digest != before


STATE, FRONT = (
    ("features", "observation.state"),
    ("features", "observation.images.front"),
)
TACTILE, WINDOW = (
    ("features", "observation.tactile"),
    ("features", "observation.tactile_window"),
)


@pytest.mark.parametrize(
    ("path", "value", "place", "reason"),
    [
        (("rows",), 3, "wire", "3×2 with transpose: True does not give the pad's 3×3"),
        (
            ("wire", "transpose"),
            False,
            "wire",
            "3×2 with transpose: False does not give the pad's 2×3",
        ),
        (("adc_bits",), 16, "wire → dtype", "16383 counts do not fit the wire's uint8"),
        (("rows",), 0, "rows", "0 is not above 0"),
        (("gain_per_count",), -0.1, "gain_per_count", "-0.1 is not above 0"),
        (("baseline", "frames"), 0, "baseline → frames", "0 is not above 0"),
        (
            ("wire_shift_bits",),
            10,
            "wire_shift_bits",
            "10 of 10 bits leave no bit for the count",
        ),
        (
            ("adc_bits",),
            10**9,
            "wire_shift_bits",
            "leave no bit for the count",
        ),  # takes no memory to find out
        (("spec_version",), 2, "spec_version", "2; this taccorl reads version 1"),
        (
            ("unit",),
            "counts",
            "unit",
            "'counts' is not a unit of datasets; did you mean 'adc_count'?",
        ),
        (
            ("wire", "dtype"),
            "float32",
            "wire → dtype",
            "'float32' is not one of 'uint8', 'uint16'",
        ),
    ],
)
def test_a_sensor_that_cannot_be_is_refused(tmp_path, path, value, place, reason):
    write(tmp_path, pad=changed(SENSOR, path, value))
    with pytest.raises(SpecError) as caught:
        load_sensor_spec(tmp_path / "pad.yaml")
    _assert_says(caught.value, tmp_path / "pad.yaml", place, reason)


def test_counts_must_fit_the_dataset(tmp_path):
    pad = changed(
        changed(changed(SENSOR, ("adc_bits",), 16), ("wire_shift_bits",), 0),
        ("wire", "dtype"),
        "uint16",
    )
    write(tmp_path, pad=pad)
    with pytest.raises(SpecError, match="65535 counts do not fit the dataset's int16"):
        load_sensor_spec(tmp_path / "pad.yaml")
    write(tmp_path, pad=changed(pad, ("wire_shift_bits",), 1))
    assert load_sensor_spec(tmp_path / "pad.yaml").max_count == 32767  # 65535 >> 1


@pytest.mark.parametrize(
    ("path", "value", "place", "reason"),
    [
        (("fps",), 0, "fps", "0 is not a valid rate; give a number above 0"),
        (("action_time",), REMOVE, "action_time", "is missing: write `action_time: next_row`"),
        (("action_time",), "same_row", "action_time", "next_row"),
        (("features",), {}, "features", "holds nothing"),
        (("sensors",), {"a": SENSOR}, "sensors", "is not a key of this file; give `sensor:`"),
        (("features", "states"), DATASET["features"]["action"], "features → states", "`action` and `observation.*` only"),
        (("features", "observation.images/up"), DATASET["features"]["observation.images.front"], "images/up", "letters, digits"),
        ((*STATE, "shape"), [], "observation.state → shape", "[] holds nothing"),
        ((*STATE, "shape"), [0], "observation.state → shape", "[0] holds nothing"),
        ((*STATE, "shape"), [1, 2], "observation.state → shape", "LeRobot can merge and edit only flat features; write [2]"),
        ((*STATE, "shape"), [3], "observation.state → names", "2 names for 3 values"),
        ((*STATE, "names"), ["joint", "joint"], "observation.state → names", "a name stands twice"),
        ((*STATE, "unit"), ["rad"], "observation.state → unit", "1 units for 2 values"),
        ((*STATE, "unit"), ["rad", "furlong"], "state → unit", "'furlong' is not a unit of datasets; known: 1, A, Hz"),
        ((*STATE, "unit"), ["radian", "m"], "observation.state → unit", "did you mean 'rad'?"),
        ((*STATE, "unit"), ["deg", "m"], "state → unit", "'deg': datasets hold rad; convert with `scale: [0.0174533]`"),
        ((*STATE, "unit"), ["rad", "mm"], "observation.state → unit", "'mm': datasets hold m; convert with `scale: [0.001]`"),
        (("features", "action", "unit"), "TODO", "features → action → unit", "'TODO' is not a unit of datasets"),
        ((*FRONT, "unit"), "rgb", "images.front → unit", "did you mean 'rgb8'?"),
        ((*STATE, "rate_hz"), -1, "observation.state → rate_hz", "-1 is not a valid rate; give a number above 0"),
        ((*STATE, "range", "gripper"), [0.1, 0.1], "observation.state → range", "a lower bound is not below its upper bound"),
        ((*STATE, "range", "gripper"), REMOVE, "observation.state → range", "no range for gripper"),
        ((*STATE, "range", "griper"), [0, 1], "observation.state → range → griper", "no such name; did you mean 'gripper'?"),
        (("features", "action", "range"), {"a": [0, 1]}, "action → range → a", "no such name; known: gripper, joint"),
        (("features", "action", "range"), {}, "action → range", "no range for joint, gripper"),
        ((*TACTILE, "range"), {}, "observation.tactile → range", "no range for unnamed values"),
        (("features", "action", "pads"), ["a"], "features → action", "`pads` and `history` need `sensor`"),
        (("features", "action", "history"), 2, "features → action", "`pads` and `history` need `sensor`"),
        (("features", "action", "unit"), REMOVE, "features → action", "key 'unit' is missing"),
        (("features", "action", "frame"), REMOVE, "features → action", "key 'frame' is missing"),
        (("features", "action", "rate_hz"), REMOVE, "features → action", "key 'rate_hz' is missing"),
        (("features", "action", "range"), REMOVE, "features → action", "key 'range' is missing"),
        ((*FRONT, "shape"), [63, 96, 3], "images.front → shape", "is not [rows, columns, 3] with even rows and columns"),
        ((*FRONT, "shape"), [3, 64, 96], "images.front → shape", "is not [rows, columns, 3]"),
        ((*FRONT, "range"), [255, 0], "images.front → range", "a lower bound is not below its upper bound"),
        ((*FRONT, "sensor"), "pad.yaml", "images.front → sensor", "has no effect on pictures"),
        ((*FRONT, "names"), ["a"], "images.front → names", "has no effect on pictures"),
        ((*FRONT, "history"), 2, "images.front", "one unit, one range and no history"),
        # 1 reading × 2 pads × 2×3 taxels = 12; 4 readings = 48
        ((*TACTILE, "shape"), [13], "observation.tactile → shape", "1 × 2 pads × 2×3 taxels (little_pad) are int16 [12]"),
        ((*TACTILE, "dtype"), "float32", "observation.tactile → shape", "float32 [12], but 1 × 2 pads"),
        ((*TACTILE, "pads"), ["a"], "observation.tactile → shape", "are int16 [6]"),
        ((*TACTILE, "pads"), ["a", "a"], "observation.tactile → pads", "a pad stands twice"),
        ((*WINDOW, "history"), 5, "observation.tactile_window → shape", "5 × 2 pads × 2×3 taxels (little_pad) are int16 [60]"),
        ((*TACTILE, "sensor"), "pda.yaml", "tactile → sensor", "no file 'pda.yaml' beside it; did you mean 'pad.yaml'"),
    ],
)  # fmt: skip
def test_a_dataset_that_cannot_be_is_refused(tmp_path, path, value, place, reason):
    write(tmp_path, dataset=changed(DATASET, path, value))
    with pytest.raises(SpecError) as caught:
        load_dataset_spec(tmp_path / "dataset.yaml")
    _assert_says(caught.value, tmp_path / "dataset.yaml", place, reason)


CHANNELS = ("channels",)


@pytest.mark.parametrize(
    ("path", "value", "place", "reason"),
    [
        (("dataset",), "datset.yaml", "dataset", "no file 'datset.yaml' beside it; did you mean 'dataset.yaml'?"),
        (("contract",), DATASET, "contract", "is not a key of this file; give `dataset:`"),
        (("features", "observation.stat"), RECORDING["features"]["action"], "stat", "did you mean 'observation.state'?"),
        (("features", "action"), REMOVE, "features", "nothing fills action of dataset.yaml"),
        (("features", "action", "channels"), ["comand"], "action → channels", "no channel 'comand'; did you mean 'command'?"),
        (("features", "action", "channels"), [], "action → channels", "names no channel, or the same channel twice"),
        ((*TACTILE, "channels"), ["pad_a", "pad_a"], "tactile → channels", "names no channel, or the same channel twice"),
        ((*TACTILE, "channels"), ["pad_a"], "observation.tactile → channels", "1 channels for pads ['a', 'b']"),
        ((*CHANNELS, "spare"), {"topic": "/t", "rate_hz": 1}, "channels → spare", "no feature uses it"),
        ((*CHANNELS, "command", "max_age_s"), 0.1, "command → max_age_s", "has no effect: action has the last value"),
        ((*CHANNELS, "state", "max_age_s"), REMOVE, "channels → state", "key 'max_age_s' is missing: observation.state is"),
        ((*CHANNELS, "state", "max_age_s"), 0, "state → max_age_s", "0.0 s: every row would be stale"),
        ((*CHANNELS, "state", "rate_hz"), 0, "state → rate_hz", "0.0 is not a valid rate; give a number above 0"),
        ((*CHANNELS, "state", "pick"), ["j1"], "state → channels", "pick 1 values together; observation.state has 2"),
        ((*CHANNELS, "state", "scale"), [1, 2, 3], "state → scale", "3 factors for 2 picked values"),
        ((*CHANNELS, "state", "field"), REMOVE, "state → pick", "names elements of a `field`"),
        ((*CHANNELS, "pad_a", "scale"), [2], "pad_a → scale", "has no effect"),
        ((*CHANNELS, "front", "pick"), ["a"], "front → pick", "has no effect"),
        ((*CHANNELS, "state", "clock"), "hedaer", "state → clock", "did you mean 'header'?"),
        ((*CHANNELS, "state", "lead_frames"), 0, "state → lead_frames", "no effect with reader: mcap"),
        ((*CHANNELS, "state", "channel_order"), "bgr", "state → channel_order", "it fills no video feature"),
        (("reader",), "hdf5", "split_bag", "no effect with reader: hdf5"),
        (("reader",), "lerobot", "split_bag", "no effect with reader: lerobot"),
        (("max_clock_spread_s",), 0, "max_clock_spread_s", "no two clocks agree so closely"),
        ((*FRONT, "align"), "window", "images.front", "a picture comes from one channel, aligned by hold or asof"),
        ((*FRONT, "channels"), ["front", "state"], "images.front", "a picture comes from one channel"),
        ((*TACTILE, "align"), "window", "tactile → align", "window with history: 1; a window needs history > 1"),
        ((*WINDOW, "align"), "asof", "tactile_window → align", "asof with history: 4"),
        (("episodes", "topic"), REMOVE, "episodes", "`topic` goes with `by: markers`, and only with it"),
        (("episodes", "by"), "whole_file", "episodes", "`topic` goes with `by: markers`, and only with it"),
        (("instruction",), {"from": "spec"}, "instruction", "`text` is missing with `from: spec`"),
        (("instruction",), {"from": "spec", "text": " "}, "instruction → text", "is empty"),
        (("instruction",), {"from": "topic", "key": "k", "topic": "/t"}, "instruction", "`key` has no effect with `from: topic`"),
        (("instruction",), {"from": "markers", "text": "go"}, "instruction", "`text` has no effect with `from: markers`"),
        (("reader",), REMOVE, "", "key 'reader' is missing"),
        (("clock",), REMOVE, "", "key 'clock' is missing"),
        (("spec_version",), 3, "spec_version", "3; this taccorl reads version 1"),
    ],
)  # fmt: skip
def test_a_recording_spec_that_cannot_be_obeyed_is_refused(
    tmp_path, path, value, place, reason
):
    with pytest.raises(SpecError) as caught:
        load_recording_spec(write(tmp_path, recording=changed(RECORDING, path, value)))
    _assert_says(caught.value, tmp_path / "recording.yaml", place, reason)


def test_markers_cannot_name_the_instruction_without_markers(tmp_path):
    recording = changed(RECORDING, ("episodes",), {"by": "whole_file"})
    with pytest.raises(
        SpecError, match=r"instruction → from:.*markers.*`episodes: by: markers`"
    ):
        load_recording_spec(write(tmp_path, recording=recording))


def test_an_error_in_a_file_that_is_referred_to_names_that_file(tmp_path):
    path = write(tmp_path, pad=changed(SENSOR, ("rows",), "two"))
    with pytest.raises(SpecError) as caught:
        load_recording_spec(path)
    assert str(caught.value).startswith(
        f"{tmp_path}/pad.yaml:3: rows: expected int, found 'two'"
    )


def test_an_unknown_spec_names_the_nearest_shipped_one():
    with pytest.raises(
        SpecError,
        match=r"no spec 'piper_flexitac': .* did you mean 'piper_flexitac_mcap'",
    ):
        load_recording_spec("piper_flexitac")


def test_a_path_comes_before_a_shipped_name(tmp_path, monkeypatch):
    write(tmp_path)
    (tmp_path / "recording.yaml").rename(tmp_path / "piper_flexitac_mcap")
    monkeypatch.chdir(tmp_path)
    spec = load_recording_spec("piper_flexitac_mcap")
    assert isinstance(spec, RecordingSpec)
    assert spec.target.name == "little"


def _assert_says(error: SpecError, file: Path, place: str, reason: str) -> None:
    """``file:line: … place …: … reason``, one line, the line being that of the last key of ``place`` that is in the file."""
    message = str(error)
    head, _, rest = message.removeprefix(str(file)).partition(": ")
    assert message.startswith(str(file)), message
    assert head.startswith(":")
    line = int(head[1:])
    assert "\n" not in message
    assert place in rest, message
    assert reason in rest, message
    lines = file.read_text().splitlines()
    assert 1 <= line <= len(lines)
    keys = [k for k in place.split(" → ") if k and f"{k}:" in file.read_text()]
    if keys and "." not in keys[-1]:
        assert keys[-1] in lines[line - 1], (message, lines[line - 1])


def test_action_time_without_an_action_is_refused(tmp_path):
    features = {"observation.state": DATASET["features"]["observation.state"]}
    (tmp_path / "pads.yaml").write_text(
        yaml.safe_dump({**DATASET, "features": features}, sort_keys=False)
    )
    with pytest.raises(
        SpecError,
        match="action_time: has no effect without a feature 'action'; remove it",
    ):
        load_dataset_spec(tmp_path / "pads.yaml")


@pytest.mark.parametrize("reader", ["hdf5", "lerobot"])
@pytest.mark.parametrize(
    "key",
    [
        "max_clock_spread_s: 0.3",
        "field: position",
        "pick: [a]",
        "drop_zero_stamp: true",
    ],
)
def test_a_key_of_messages_is_refused_for_files_of_rows(
    tmp_path: Path, reader: str, key: str
) -> None:
    text = (data_specs_folder() / "recordings" / "cobot_magic_hdf5.yaml").read_text()
    text = text.replace("reader: hdf5", f"reader: {reader}").replace(
        "dataset: ..", f"dataset: {data_specs_folder()}"
    )
    if key.startswith("max"):
        text = text.replace("reader:", f"{key}\nreader:")
    else:
        text = text.replace("lead_frames: 1", f"lead_frames: 1, {key}")
    (tmp_path / "spec.yaml").write_text(text)
    with pytest.raises(
        SpecError, match=f"{key.split(':')[0]}: has no effect with reader: {reader}"
    ):
        load_recording_spec(tmp_path / "spec.yaml")

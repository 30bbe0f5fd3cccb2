"""Draft the specs for a recording: a recording spec, the dataset spec, and a sensor spec if its pads are of an unknown kind.

Filled in is what the recording states: topics, types, names of joints, rates, shapes. What it does not state (units, valid
ranges, the instruction) is ``TODO`` with a comment that says what to write there.
"""

import itertools
import json
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from taccorl.data.inspection import JOINTS, TEXTS, Inventory, TopicSummary
from taccorl.data.spec import UNITS, data_specs_folder, load_sensor_spec
from taccorl.errors import printable

COMMAND_WORDS = ("command", "cmd", "ctrl", "target", "action", "master", "leader", "desired", "goal")
"""Words in the names of topics that hold commands."""
TOUCH_WORDS = ("tact", "touch", "taxel", "skin", "finger", "pad")  # Words in the names of topics that hold touch
STATE_WORDS = ("qpos", "state", "position", "joint")  # Words in the names of topics that hold measured positions
YAML_WORDS = ("true", "false", "yes", "no", "on", "off", "null", "y", "n")
"""Words that YAML does not read as text unless they are quoted."""
PICTURE_SHAPE = (224, 224, 3)
"""Rows, columns and colours of pictures in a drafted dataset: the input size of π0.5. Pictures are letterboxed to it."""
FPS = 30
"""Greatest row rate of a drafted dataset with pictures [Hz], and that of one with neither pictures nor positions."""
ROW_CLOCK_READERS = ("hdf5", "lerobot")
"""Readers of files that hold rows without times. Their drafts state ``lead_frames``: the row for which a command is valid."""
ACTION_TIME = "action_time: next_row   # action of row t: the last command sent before row t + 1"
ROW_ACTION_TIME = (
    "action_time: this_row   # action of row t: sent right after the observation of row t, as by LeRobot's record loop; "
    "next_row: reached at row t + 1"
)
COUNT_UNIT = "adc_count"
STALE_PERIODS = 2.4  # ``max_age_s`` of a drafted channel, in periods of the channel


class Drafts(NamedTuple):
    """Texts of a drafted recording spec, dataset spec and sensor spec, in YAML."""

    recording: str
    dataset: str
    sensor: str = ""
    """Text of the sensor spec for pads that no shipped sensor fits; empty if there are none."""

    def files(self, path: Path) -> dict[Path, str]:
        """File → text. The recording spec is at ``path``, the other specs are beside it."""
        texts = {path: self.recording, dataset_path(path): self.dataset, sensor_path(path): self.sensor}
        return {place: text for place, text in texts.items() if text}


def dataset_path(path: Path) -> Path:
    """Path of the dataset spec that is drafted beside the recording spec at ``path``."""
    return path.with_name(f"{path.stem}_dataset.yaml")


def sensor_path(path: Path) -> Path:
    """Path of the sensor spec that is drafted beside the recording spec at ``path``."""
    return path.with_name(f"{path.stem}_sensor.yaml")


def draft_specs(inventory: Inventory, path: Path = Path("draft.yaml")) -> Drafts:
    """Draft a recording spec for ``path``, and the specs beside it that it needs."""
    roles = _roles(inventory)
    sensor = _sensor(inventory, roles, path) if roles.pads and not roles.pads[0].sensor else ""
    return Drafts(_recording(inventory, roles, path), _dataset(inventory, roles, path), sensor)


# ---- which topic is what ----


@dataclass(frozen=True)
class _Roles:
    states: list[TopicSummary]
    commands: list[TopicSummary]
    """Topics of commands; empty if no topic is named as a command."""
    pictures: list[TopicSummary]
    pads: list[TopicSummary]
    """Topics of pads of one kind: a shipped sensor, or an unknown one."""
    vectors: list[TopicSummary]
    """Topics of poses, wrenches, IMU readings and the like; each becomes one feature."""
    spare: list[TopicSummary]
    """Other topics with numbers, which the draft lists for the user to choose from."""
    names: dict[tuple[str, tuple[str, ...]], str]
    """``TopicSummary.key`` → channel."""

    @property
    def used(self) -> list[TopicSummary]:
        return [*self.states, *self.commands, *self.pictures, *self.pads, *self.vectors]

    def vector_key(self, t: TopicSummary) -> str:
        """Feature of one of ``vectors``; names that mean something to LeRobot or to us are not for them."""
        name = self.names[t.key]
        if t.topic.startswith("observation.tactile"):
            return t.topic
        taken = name in ("state", "environment_state", "tactile")
        return f"observation.{name}_vector" if taken else f"observation.{name}"


def _roles(inventory: Inventory) -> _Roles:
    useful = [t for t in inventory.topics if t.num_messages and not t.problem]
    topics = {t.topic for t in useful}
    pictures = [t for t in useful if t.is_picture and f"{t.topic}/compressed" not in topics]
    pads = [t for t in useful if t.sensor] or [t for t in useful if t.counts and _says(t, TOUCH_WORDS)]
    pads = [t for t in pads if (t.sensor, t.counts) == (pads[0].sensor, pads[0].counts)]
    vectors = [t for t in useful if t.units]
    touch = [t for t in useful if t.topic.startswith("observation.tactile") and t.num_values and t not in pads]
    numbers = [t for t in useful if t.num_values and not (t.sensor or t.counts or t.units) and t not in touch]
    commands = [t for t in numbers if _says(t, COMMAND_WORDS)]
    commands = [t for t in commands if t.names] or commands
    measured = [t for t in numbers if not _says(t, COMMAND_WORDS)]
    states = [t for t in measured if t.holds(JOINTS) and t.names] or [t for t in measured if _says(t, STATE_WORDS)]
    states = [t for t in states if not any(t.topic == s.topic and set(t.names) < set(s.names) for s in states)]
    numbered = _numbered_alike(states)  # arms of one robot, or episodes? Not guessed
    states = [t for t in states if t not in numbered]
    states = _one_of_each(states) or (measured if len(measured) == 1 else [])
    # a mobile base has commands of its own: one topic that alone commands all of the state is enough
    commands = next(([t] for t in commands if t.num_values == sum(s.num_values or 0 for s in states)), commands)
    commands = commands or [t for t in vectors if _says(t, COMMAND_WORDS)]  # a mobile base's velocity, a target pose
    measured = [*(t for t in vectors if not _says(t, COMMAND_WORDS)), *touch]
    spare = [t for t in (*numbers, *vectors) if t not in (*commands, *states, *measured)]
    return _Roles(states, commands, pictures, pads, measured, spare, _channel_names(useful))


def _one_of_each(topics: list[TopicSummary]) -> list[TopicSummary]:
    """Of several topics with the same joints of the same arm, the one that is named most as a state."""
    best: dict[Any, TopicSummary] = {}
    for t in sorted(topics, key=lambda t: (not _says(t, STATE_WORDS), len(t.topic))):
        best.setdefault((t.names or t.topic, _side(t)), t)
    return [t for t in topics if t in best.values()]


def _numbered_alike(topics: list[TopicSummary]) -> list[TopicSummary]:
    """Datasets of a file that differ from an earlier one in the number of a group alone: /robot_0/qpos and /robot_1/qpos."""
    seen: set[str] = set()
    found = []
    for t in topics:
        groups, _, name = t.topic.rpartition("/")
        pattern = f"{re.sub(r'[0-9]+', '#', groups)}/{name}"
        if t.type.shape is not None and "#" in pattern and pattern in seen:
            found.append(t)
        seen.add(pattern)
    return found


def _side(t: TopicSummary) -> str:
    words = re.split(r"[^a-z]+", t.topic.lower())
    return next((w for w in words if w in ("left", "right")), "")


def _says(t: TopicSummary, hints: tuple[str, ...]) -> bool:
    """Whether a word of the topic is, or begins with, one of ``hints``."""
    return any(word.startswith(hints) for word in re.split(r"[^a-z]+", t.topic.lower()))


def _channel_names(topics: list[TopicSummary]) -> dict[tuple[str, tuple[str, ...]], str]:
    """``TopicSummary.key`` → a short name of its own."""
    names: dict[tuple[str, tuple[str, ...]], str] = {}
    for t in topics:
        words = re.sub(r"[^A-Za-z0-9/]+", "_", t.topic).strip("/_").split("/")
        short = [w for w in words if w not in ("image_raw", "compressed", "color")]
        name = re.sub(r"^observations?_(images_)?", "", "_".join(short)) or "channel"
        name = "_".join(words) if name in names.values() else name
        name = name if name[0].isalpha() and name.lower() not in YAML_WORDS else f"channel_{name}"
        numbered = (f"{name}_{k}" for k in itertools.count(2))
        names[t.key] = name if name not in names.values() else next(n for n in numbered if n not in names.values())
    return names


# ---- the recording spec ----


def _recording(inventory: Inventory, roles: _Roles, path: Path) -> str:
    stamped = [t for t in roles.used if t.stamped]
    clock = "header" if stamped and not any(t.sim_time for t in stamped) else "log"
    texts = [t for t in inventory.topics if t.num_messages and t.holds(TEXTS)]
    known = inventory.times_known
    rate = "" if known else f"; rate_hz: the recorder's rows a second, max_age_s: {STALE_PERIODS} / rate_hz"
    row_clock = inventory.reader in ROW_CLOCK_READERS
    if row_clock:
        rate += "; lead_frames of action: 1 if the command of row k is sent after its observation, 0 if before; "
        rate += "scale: one factor for each element where its unit is another, [0.0174533, …] for degrees"
    unused = [t for t in inventory.topics if t not in roles.used and t not in roles.spare and t not in texts]
    lines = [
        *_head(inventory),
        f"dataset: {_yaml(dataset_path(path).name)}   # what the dataset shall hold, drafted beside this file",
        f"reader: {inventory.reader}",
        f"clock: {clock}",
        "episodes: {by: whole_file, min_s: 1.0}"
        + (f"   # or {{by: markers, topic: {_yaml(texts[0].topic)}, min_s: 1.0}}" if texts else ""),
        "instruction: {from: topic, topic: task}"
        if inventory.reader == "lerobot"
        else "instruction: {from: spec, text: TODO}   # the sentence that the policy reads: pick up the cup",
        f"channels:   # each must be used by a feature below{rate}",
        *(
            f"  {roles.names[t.key]}: {_channel(t, clock, known, row_clock and t in roles.commands)}"
            for t in roles.used
        ),
        *(f"  # {roles.names[t.key]}: {_channel(t, clock, known)}" for t in roles.spare),
        *(f"  # not used: {printable(_unused(t))}" for t in unused),
        "features:   # several channels are joined in the order of the list",
        *_mappings(roles),
    ]
    return "\n".join(lines) + "\n"


def _unused(t: TopicSummary) -> str:
    if t.problem or t.counts is None:
        return t.problem or f"{t.topic} ({t.type.name})"
    dtype, shape = t.counts
    how = "a channel like the others, in a feature like those of data_specs/taccorl_bimanual.yaml, with a sensor file"
    return f"{t.topic}: {' × '.join(map(str, shape))} counts of {dtype}. If it is a tactile pad: {how}"


def _head(inventory: Inventory) -> list[str]:
    return [
        f"# Draft from {printable(inventory.source.name)}: replace every TODO as the comment behind it says,",
        "# check every line; `taccorl ingest … --dry_run=true` tells what is still wrong.",
        "spec_version: 1",
    ]


def _mappings(roles: _Roles) -> list[str]:
    def line(key: str, topics: list[TopicSummary]) -> str:
        return f"  {key}: {{channels: [{', '.join(roles.names[t.key] for t in topics)}], align: asof}}"

    found = [line("observation.state", roles.states)] if roles.states else []
    if roles.commands:
        found.append(line("action", roles.commands))
    elif roles.states:
        states = ", ".join(roles.names[t.key] for t in roles.states)
        spare = " or ".join(roles.names[t.key] for t in roles.spare)
        other = f"{spare} (uncomment it above), or " if spare else ""
        found.append(
            f"  action: {{channels: [TODO], align: asof}}   # no topic is named as a command: {other}{states}, as measured"
        )
    found += [line(f"observation.images.{roles.names[t.key]}", [t]) for t in roles.pictures]
    found += [line(roles.vector_key(t), [t]) for t in roles.vectors]
    return found + ([line("observation.tactile", roles.pads)] if roles.pads else [])


def _channel(t: TopicSummary, clock: str, rate_known: bool, is_row_command: bool = False) -> str:
    parts = [f"topic: {_yaml(t.topic)}"]
    if t.type.name and t.type.name != "no schema" and t.type.shape is None:
        parts.append(f"type: {_yaml(t.type.name)}")
    if t.holds(JOINTS):
        parts += ["field: position", f"pick: [{', '.join(_yaml(n) for n in t.names)}]"]
    elif t.units:
        parts.append(f"pick: [{', '.join(t.names)}]")
    elif t.num_values and t.type.shape is None:
        parts.append("field: data")
    if clock == "header" and not t.stamped:
        parts.append("clock: log")
    if clock == "header" and t.zero_stamps:
        parts.append("drop_zero_stamp: true")
    if rate_known:
        rate_hz = _rate_hz([t])
        parts += [f"rate_hz: {rate_hz:g}", f"max_age_s: {max(0.03, round(STALE_PERIODS / rate_hz, 3)):g}"]
    else:
        parts += ["rate_hz: TODO", "max_age_s: TODO"]
    if is_row_command:
        parts.append("lead_frames: 1")
    return "{" + ", ".join(parts) + "}"


# ---- the dataset spec ----


def _dataset(inventory: Inventory, roles: _Roles, path: Path) -> str:
    known = inventory.times_known
    pace = [t for t in roles.pictures or roles.states if t.rate_hz]
    # Without pictures rows cost little, and what compares motions wants all of them.
    fps = max(1, round(min(FPS if roles.pictures else math.inf, _rate_hz(pace)))) if pace else FPS
    note = "" if fps <= FPS else f"   # rows a second, as the positions have; {FPS} are enough for a policy"
    unknown = "TODO   # the recorder's rows a second, as rate_hz below"
    action_time = ROW_ACTION_TIME if inventory.reader in ROW_CLOCK_READERS else ACTION_TIME
    lines = [
        *_head(inventory),
        "# Two PiPER arms with FlexiTac pads? Then name data_specs/taccorl_bimanual.yaml and its features instead.",
        f"name: {_yaml(re.sub(r'[^A-Za-z0-9_]+', '_', path.stem))}",
        "robot_type: my_robot   # any name, the same for all datasets of this robot",
        f"fps: {f'{fps}{note}' if known else unknown}",
        *([action_time] if roles.states or roles.commands else []),
        "features:",
    ]
    elements = _elements(roles.states, roles)
    if roles.states:
        lines += _numbers("observation.state", roles.states, elements, known)
    else:
        lines.append("  # no observation.state: no topic here is named or shaped like joint positions")
    if roles.commands:
        own = _elements(roles.commands, roles)
        # one order of the same joints keeps one set of names, whatever the topics are called
        same = [t.names for t in roles.commands] == [t.names for t in roles.states]
        lines += _numbers("action", roles.commands, elements if same else own, known)
    elif roles.states:
        lines += ["  # as observation.state; another number of values if the channels of `action` have another"]
        lines += _numbers("action", roles.states, elements, known)
    for t in roles.vectors:
        lines += _numbers(roles.vector_key(t), [t], list(t.names), known)
    for t in roles.pictures:
        name, rate = roles.names[t.key], f"{_rate_hz([t]):g}" if known else "TODO"
        lines += [
            f"  observation.images.{name}:",
            f"    {{dtype: video, shape: {list(PICTURE_SHAPE)}, unit: rgb8, frame: {name}_optical, rate_hz: {rate}, "
            "range: [0, 255]}",
        ]
    return "\n".join(lines + (_touch(roles, path, known) if roles.pads else [])) + "\n"


def _elements(topics: list[TopicSummary], roles: _Roles) -> list[str]:
    """A name for each value, with its arm's in front where there are several; none where messages name nothing."""
    if not all(t.names for t in topics):
        return []
    found: list[str] = []
    for t in topics:
        prefix = f"{_side(t) or roles.names[t.key]}_" if len(topics) > 1 else ""
        for name in t.names:
            plain = re.sub(r"[^A-Za-z0-9_.]+", "_", name).strip("_") or "joint"
            full = plain if plain.startswith(prefix) else f"{prefix}{plain}"
            full = full if full.endswith(".pos") or not t.holds(JOINTS) else f"{full}.pos"
            found.append(full if full not in found else f"{len(found)}_{full}")
    return found


def _numbers(key: str, topics: list[TopicSummary], elements: list[str], known: bool) -> list[str]:
    size = sum(t.num_values or 0 for t in topics)
    layout = (topics[0].type.shape or ()) if len(topics) == 1 else ()
    each = elements[0] if elements else ""
    known_units = ", ".join(u for u in UNITS if u not in (COUNT_UNIT, "rgb8", "unknown"))
    units = [u for t in topics for u in t.units]
    unit = f"TODO   # one for all, rad, or a list of {size}, [rad, …, m]; known: {known_units}"
    if units and all(units):
        unit = units[0] if len(set(units)) == 1 else f"[{', '.join(units)}]"
    frames = {t.frame for t in topics if t.units} - {""}
    stated = _yaml(frames.pop()) if len(frames) == 1 else "TODO   # in which the values are: base_link"
    frame = stated if units else "joint"
    widest = "[-3.14, 3.14]" if not units else "[-1, 1]" if set(units) == {"wxyz"} else "[-10, 10]"
    return [
        f"  {key}:",
        "    dtype: float32",
        f"    shape: [{size}]",
        *([f"    layout: {list(layout)}"] if len(layout) > 1 else []),
        *([f"    names: [{', '.join(_yaml(n) for n in elements)}]"] if elements else []),
        f"    unit: {unit}",
        f"    frame: {frame}",
        f"    rate_hz: {f'{_rate_hz(topics):g}' if known else 'TODO'}",
        f"    range: TODO   # lowest and highest valid value for all, {widest}"
        + (f", or for each: {{{each}: [-2.6, 2.6], …}}" if each else ""),
    ]


def _touch(roles: _Roles, path: Path, known: bool) -> list[str]:
    """Feature of the pads."""
    pads, name = [roles.names[t.key] for t in roles.pads], roles.pads[0].sensor
    rate = f"{_rate_hz(roles.pads):g}" if known else "TODO"
    if name:
        place = data_specs_folder() / "sensors" / f"{name}.yaml"
        shipped = load_sensor_spec(place)
        size, unit, most = shipped.rows * shipped.columns, shipped.unit, str(shipped.max_count)
    else:
        place = Path(sensor_path(path).name)
        assert roles.pads[0].counts is not None
        dtype, shape = roles.pads[0].counts
        size, unit, most = math.prod(shape), COUNT_UNIT, str(np.iinfo(dtype).max) if dtype == "uint8" else "TODO"
    note = "" if most != "TODO" else "   # ± the largest count that the converter sends"
    return [
        "  observation.tactile:",
        f"    {{dtype: int16, shape: [{len(pads) * size}], unit: {unit}, frame: pad, rate_hz: {rate}, "
        f"range: [-{most}, {most}],{note}",
        f"     sensor: {_yaml(str(place))}, pads: [{', '.join(pads)}]}}",
    ]


def _sensor(inventory: Inventory, roles: _Roles, path: Path) -> str:
    """Sensor spec of pads that no shipped one fits."""
    assert roles.pads[0].counts is not None
    dtype, shape = roles.pads[0].counts
    size = math.prod(shape)
    pairs = [(rows, size // rows) for rows in range(1, size + 1) if size % rows == 0]
    likely = sorted(pairs, key=lambda p: (abs(math.log(p[0] / p[1])), p))[:3]
    rows, columns = map(str, shape) if len(shape) == 2 else ("TODO", "TODO")
    known = roles.pads[0].rate_hz if inventory.times_known else 0.0
    bits = {"uint8": "8   # of the converter; if it has more, wire_shift_bits low ones are not sent"}
    lines = [
        f"# Draft from {printable(inventory.source.name)}: replace every TODO as the comment behind it says.",
        "spec_version: 1",
        f"name: {_yaml(re.sub(r'[^A-Za-z0-9_]+', '_', sensor_path(path).stem))}",
        f"rows: {rows}   # of taxels; rows × columns are {size}: {', '.join(f'{r} × {c}' for r, c in likely)} …",
        f"columns: {columns}",
        f"wire: {{rows: {rows}, columns: {columns}, dtype: {dtype}, transpose: false}}   "
        "# as it is sent, row after row; transpose: true if its rows are the pad's columns",
        f"adc_bits: {bits.get(dtype, 'TODO   # of the converter, at most 15: 10, 12')}",
        "wire_shift_bits: 0",
        f"rate_hz: {f'{known:.3g}' if known else 'TODO   # readings a second'}",
        f"scan_time_s: {f'{1 / known:.3g}' if known else 'TODO'}   # time of one scan of the pad, at most 1 / rate_hz",
        f"unit: {COUNT_UNIT}",
        "baseline: {rule: median_of_first, frames: 30, max_spread_count: TODO}   "
        "# a pad whose first 30 frames spread more, in counts, is not at rest: 12",
        "noise_count: TODO   # counts above the baseline that an untouched taxel may show: 15",
        "scheme: fixed_scale",
        "gain_per_count: TODO   # the policy reads counts × gain and calls a taxel above 0.4 touched: 0.0133 for 30 counts",
    ]
    return "\n".join(lines) + "\n"


def _rate_hz(topics: list[TopicSummary]) -> float:
    """The rate of the slowest topic, rounded to three digits, or to a whole number if it is within 1 % of one."""
    rate_hz = min(t.rate_hz or 1.0 for t in topics)
    return float(f"{rate_hz:.3g}") if abs(round(rate_hz) - rate_hz) > 0.01 * rate_hz else float(round(rate_hz))


def _yaml(text: str) -> str:
    """A text as YAML reads it back; quoted unless it is plainly a name or path."""
    plain = re.fullmatch(r"/?[A-Za-z_][A-Za-z0-9_/.-]*", text)
    return text if plain and text.lower() not in YAML_WORDS else printable(json.dumps(text, ensure_ascii=False))

"""Draft the specs for a recording: a recording spec, the dataset spec, and a sensor spec if its pads are of an unknown kind.

Filled in is what the recording states: topics, types, names of joints, rates, shapes. What it does not state (units, valid
ranges, the instruction) is ``TODO`` with a comment that says what to write there.
"""

import json
import math
import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from taccorl.data.inspection import JOINTS, TEXTS, Inventory, TopicSummary
from taccorl.data.sensor_spec import UNITS, load_sensor_spec
from taccorl.data.spec import data_specs_folder
from taccorl.errors import printable

COMMAND_WORDS = (
    "command",
    "cmd",
    "ctrl",
    "target",
    "action",
    "master",
    "leader",
    "desired",
    "goal",
)
"""Words in the names of topics that hold commands; below: touch, and measured positions."""
TOUCH_WORDS = ("tact", "touch", "taxel", "skin", "finger", "pad")
STATE_WORDS = ("qpos", "state", "position", "joint")
YAML_WORDS = ("true", "false", "yes", "no", "on", "off", "null", "y", "n")
"""Words that YAML does not read as text unless they are quoted."""
PICTURE_SHAPE = (
    224,
    224,
    3,
)  # Of pictures in a drafted dataset: the input size of π0.5, to which they are letterboxed
FPS = 30  # Greatest row rate of a draft with pictures [Hz], and that of one with neither pictures nor positions
# Of rows without times: their drafts state ``lead_frames``, the row of a command
ROW_CLOCK_READERS = ("hdf5", "lerobot")
ACTION_TIME = "action_time: next_row   # a guess: action of row t: the last command sent before row t + 1"
ROW_ACTION_TIME = (
    "action_time: this_row   # a guess: action of row t: sent right after the observation of row t, as by LeRobot's record loop; "
    "next_row: reached at row t + 1"
)
COUNT_UNIT = "adc_count"
STALE_PERIODS = 2.4  # ``max_age_s`` of a drafted channel, in periods of the channel


class Drafts(NamedTuple):
    """Texts of a drafted recording spec, dataset spec and sensor spec, in YAML; the last is empty if a shipped one fits."""

    recording: str
    dataset: str
    sensor: str = ""

    def files(self, path: Path) -> dict[Path, str]:
        """File → text. The recording spec is at ``path``, the other specs are beside it."""
        return {
            place: text
            for place, text in zip(draft_paths(path), self, strict=True)
            if text
        }


def draft_paths(path: Path) -> tuple[Path, Path, Path]:
    """Paths of a recording spec that is drafted at ``path``, and of the dataset and sensor specs beside it."""
    return path, _beside(path, "dataset"), _beside(path, "sensor")


def _beside(path: Path, kind: str) -> Path:
    return path.with_name(f"{path.stem}_{kind}.yaml")


def draft_specs(inventory: Inventory, path: Path = Path("draft.yaml")) -> Drafts:
    """Draft a recording spec for ``path``, and the specs beside it that it needs."""
    draft = _Draft(inventory, path)
    lines = [
        draft.recording(),
        draft.dataset(),
        draft.sensor() if draft.pads and not draft.pads[0].sensor else [],
    ]
    return Drafts(*("\n".join([*text, ""]) if text else "" for text in lines))


class _Draft:
    """Roles of the topics of a recording, and the lines of its specs."""

    def __init__(self, inventory: Inventory, path: Path) -> None:
        self.inventory, self.path, self.known = inventory, path, inventory.times_known
        self.row_clock = inventory.reader in ROW_CLOCK_READERS
        useful = [t for t in inventory.topics if t.num_messages and not t.problem]
        topics = {t.topic for t in useful}
        self.names = _channel_names(useful)
        """``TopicSummary.key`` → channel."""
        self.pictures = [
            t for t in useful if t.is_picture and f"{t.topic}/compressed" not in topics
        ]
        pads = [t for t in useful if t.sensor] or [
            t for t in useful if t.counts and _says(t, TOUCH_WORDS)
        ]
        self.pads = [
            t for t in pads if (t.sensor, t.counts) == (pads[0].sensor, pads[0].counts)
        ]
        """Topics of pads of one kind: a shipped sensor, or an unknown one."""
        vectors = [t for t in useful if t.units]
        touch = [
            t
            for t in useful
            if t.topic.startswith("observation.tactile")
            and t.num_values
            and t not in self.pads
        ]
        numbers = [
            t
            for t in useful
            if t.num_values and not (t.sensor or t.counts or t.units) and t not in touch
        ]
        commands = [t for t in numbers if _says(t, COMMAND_WORDS)]
        commands = [t for t in commands if t.names] or commands
        measured = [t for t in numbers if not _says(t, COMMAND_WORDS)]
        states = [t for t in measured if t.holds(JOINTS) and t.names] or [
            t for t in measured if _says(t, STATE_WORDS)
        ]
        states = [
            t
            for t in states
            if not any(
                t.topic == s.topic and set(t.names) < set(s.names) for s in states
            )
        ]
        states = _one_of_each([t for t in states if t not in _numbered_alike(states)])
        self.states = states or (measured if len(measured) == 1 else [])
        # a mobile base has commands of its own: one topic that alone commands all of the state is enough
        size = sum(s.num_values or 0 for s in self.states)
        commands = next(([t] for t in commands if t.num_values == size), commands)
        self.commands = commands or [
            t for t in vectors if _says(t, COMMAND_WORDS)
        ]  # a base's velocity, a target pose
        self.vectors = [*(t for t in vectors if not _says(t, COMMAND_WORDS)), *touch]
        self.used = [
            *self.states,
            *self.commands,
            *self.pictures,
            *self.pads,
            *self.vectors,
        ]
        self.spare = [
            t
            for t in (*numbers, *vectors)
            if t not in (*self.commands, *self.states, *self.vectors)
        ]
        """Other topics with numbers, which the draft lists for the user to choose from."""

    def head(self) -> list[str]:
        return [
            f"# Draft from {printable(self.inventory.source.name)}: replace every TODO as the comment behind it says,",
            "# check every line; `taccorl ingest … --dry_run=true` tells what is still wrong.",
            "spec_version: 1",
        ]

    def channels(self, topics: list[TopicSummary]) -> str:
        return ", ".join(self.names[t.key] for t in topics)

    def vector_key(self, t: TopicSummary) -> str:
        """Feature of one of ``vectors``; names that mean something to LeRobot or to us are not for them."""
        name = self.names[t.key]
        if t.topic.startswith("observation.tactile"):
            return t.topic
        taken = name in ("state", "environment_state", "tactile")
        return f"observation.{name}_vector" if taken else f"observation.{name}"

    # ---- the recording spec ----

    def recording(self) -> list[str]:
        inventory, stamped = self.inventory, [t for t in self.used if t.stamped]
        clock = "header" if stamped and not any(t.sim_time for t in stamped) else "log"
        texts = [t for t in inventory.topics if t.num_messages and t.holds(TEXTS)]
        rate = (
            ""
            if self.known
            else f"; rate_hz: the recorder's rows a second, max_age_s: {STALE_PERIODS} / rate_hz"
        )
        if self.row_clock:
            rate += "; lead_frames of action: 1 if the command of row k is sent after its observation, 0 if before; "
            rate += "scale: one factor for each element where its unit is another, [0.0174533, …] for degrees"
        unused = [
            t
            for t in inventory.topics
            if t not in self.used and t not in self.spare and t not in texts
        ]
        markers = (
            f"; or {{by: markers, topic: {_yaml(texts[0].topic)}, min_s: 1.0}}"
            if texts
            else ""
        )
        said = "instruction: {from: spec, text: TODO}   # the sentence that the policy reads: pick up the cup"
        return [
            *self.head(),
            f"dataset: {_yaml(_beside(self.path, 'dataset').name)}   # what the dataset shall hold, drafted beside this file",
            f"reader: {inventory.reader}",
            f"clock: {clock}",
            f"episodes: {{by: whole_file, min_s: 1.0}}   # min_s is a guess{markers}",
            "instruction: {from: topic, topic: task}"
            if inventory.reader == "lerobot"
            else said,
            f"channels:   # each must be used by a feature below; max_age_s is a guess{rate}",
            *(
                f"  {self.names[t.key]}: {self.channel(t, clock, self.row_clock and t in self.commands)}"
                for t in self.used
            ),
            *(f"  # {self.names[t.key]}: {self.channel(t, clock)}" for t in self.spare),
            *(f"  # not used: {printable(_unused(t))}" for t in unused),
            "features:   # several channels are joined in the order of the list",
            *self.mappings(),
        ]

    def mappings(self) -> list[str]:
        line = "  {}: {{channels: [{}], align: asof}}".format
        found = (
            [line("observation.state", self.channels(self.states))]
            if self.states
            else []
        )
        if self.commands:
            found.append(line("action", self.channels(self.commands)))
        elif self.states:
            spare = " or ".join(self.names[t.key] for t in self.spare)
            other = f"{spare} (uncomment it above), or " if spare else ""
            text = f"no topic is named as a command: {other}{self.channels(self.states)}, as measured"
            found.append(f"{line('action', 'TODO')}   # {text}")
        found += [
            line(f"observation.images.{self.names[t.key]}", self.names[t.key])
            for t in self.pictures
        ]
        found += [line(self.vector_key(t), self.names[t.key]) for t in self.vectors]
        return found + (
            [line("observation.tactile", self.channels(self.pads))] if self.pads else []
        )

    def channel(self, t: TopicSummary, clock: str, is_row_command: bool = False) -> str:
        parts = [f"topic: {_yaml(t.topic)}"]
        if t.type.name and t.type.name != "no schema" and t.type.shape is None:
            parts.append(f"type: {_yaml(t.type.name)}")
        if t.holds(JOINTS):
            parts += [
                "field: position",
                f"pick: [{', '.join(_yaml(n) for n in t.names)}]",
            ]
        elif t.units:
            parts.append(f"pick: [{', '.join(t.names)}]")
        elif t.num_values and t.type.shape is None:
            parts.append("field: data")
        parts += ["clock: log"] if clock == "header" and not t.stamped else []
        parts += (
            ["drop_zero_stamp: true"] if clock == "header" and t.zero_stamps else []
        )
        rate_hz = _rate_hz([t])
        age = f"{max(0.03, round(STALE_PERIODS / rate_hz, 3)):g}"
        parts += (
            [f"rate_hz: {rate_hz:g}", f"max_age_s: {age}"]
            if self.known
            else ["rate_hz: TODO", "max_age_s: TODO"]
        )
        return (
            "{"
            + ", ".join([*parts, *(["lead_frames: 1"] if is_row_command else [])])
            + "}"
        )

    # ---- the dataset spec ----

    def dataset(self) -> list[str]:
        pace = [t for t in self.pictures or self.states if t.rate_hz]
        # Without pictures rows cost little, and what compares motions wants all of them.
        fps = (
            max(1, round(min(FPS if self.pictures else math.inf, _rate_hz(pace))))
            if pace
            else FPS
        )
        unknown = "TODO   # the recorder's rows a second, as rate_hz below"
        note = (
            ""
            if fps <= FPS
            else f"   # rows a second, as the positions have; {FPS} are enough for a policy"
        )
        lines = [
            *self.head(),
            "# Two PiPER arms with FlexiTac pads? Then name data_specs/taccorl_bimanual.yaml and its features instead.",
            f"name: {_yaml(re.sub(r'[^A-Za-z0-9_]+', '_', self.path.stem))}",
            "robot_type: my_robot   # any name, the same for all datasets of this robot",
            f"fps: {f'{fps}{note}' if self.known else unknown}",
            *(
                [ROW_ACTION_TIME if self.row_clock else ACTION_TIME]
                if self.states or self.commands
                else []
            ),
            "features:",
        ]
        elements = self.elements(self.states)
        if self.states:
            lines += self.numbers("observation.state", self.states, elements)
        else:
            lines.append(
                "  # no observation.state: no topic here is named or shaped like joint positions"
            )
        if self.commands:
            # one order of the same joints keeps one set of names, whatever the topics are called
            same = [t.names for t in self.commands] == [t.names for t in self.states]
            lines += self.numbers(
                "action",
                self.commands,
                elements if same else self.elements(self.commands),
            )
        elif self.states:
            lines += [
                "  # as observation.state; another number of values if the channels of `action` have another"
            ]
            lines += self.numbers("action", self.states, elements)
        for t in self.vectors:
            lines += self.numbers(self.vector_key(t), [t], list(t.names))
        for t in self.pictures:
            name, rate = (
                self.names[t.key],
                f"{_rate_hz([t]):g}" if self.known else "TODO",
            )
            text = f"    {{dtype: video, shape: {list(PICTURE_SHAPE)}, unit: rgb8, frame: {name}_optical, "
            lines += [
                f"  observation.images.{name}:",
                f"{text}rate_hz: {rate}, range: [0, 255]}}",
            ]
        return lines + (self.touch() if self.pads else [])

    def elements(self, topics: list[TopicSummary]) -> list[str]:
        """A name for each value, with its arm's in front where there are several; none where messages name nothing."""
        found: list[str] = []
        for t in topics if all(t.names for t in topics) else ():
            prefix = f"{_side(t) or self.names[t.key]}_" if len(topics) > 1 else ""
            for name in t.names:
                plain = re.sub(r"[^A-Za-z0-9_.]+", "_", name).strip("_") or "joint"
                full = plain if plain.startswith(prefix) else f"{prefix}{plain}"
                full = (
                    full
                    if full.endswith(".pos") or not t.holds(JOINTS)
                    else f"{full}.pos"
                )
                found.append(full if full not in found else f"{len(found)}_{full}")
        return found

    def numbers(
        self, key: str, topics: list[TopicSummary], elements: list[str]
    ) -> list[str]:
        size = sum(t.num_values or 0 for t in topics)
        layout = (topics[0].type.shape or ()) if len(topics) == 1 else ()
        known_units = ", ".join(
            u for u in UNITS if u not in (COUNT_UNIT, "rgb8", "unknown")
        )
        units = [u for t in topics for u in t.units]
        unit = f"TODO   # one for all, rad, or a list of {size}, [rad, …, m]; known: {known_units}"
        if units and all(units):
            unit = units[0] if len(set(units)) == 1 else f"[{', '.join(units)}]"
        frames = {t.frame for t in topics if t.units} - {""}
        stated = (
            _yaml(frames.pop())
            if len(frames) == 1
            else "TODO   # in which the values are: base_link"
        )
        widest = (
            "[-3.14, 3.14]"
            if not units
            else "[-1, 1]"
            if set(units) == {"wxyz"}
            else "[-10, 10]"
        )
        each = f", or for each: {{{elements[0]}: [-2.6, 2.6], …}}" if elements else ""
        return [
            *(f"  {key}:", "    dtype: float32", f"    shape: [{size}]"),
            *([f"    layout: {list(layout)}"] if len(layout) > 1 else []),
            *(
                [f"    names: [{', '.join(_yaml(n) for n in elements)}]"]
                if elements
                else []
            ),
            f"    unit: {unit}",
            f"    frame: {stated if units else 'joint'}",
            f"    rate_hz: {f'{_rate_hz(topics):g}' if self.known else 'TODO'}",
            f"    range: TODO   # lowest and highest valid value for all, {widest}{each}",
        ]

    def touch(self) -> list[str]:
        """Feature of the pads."""
        name, rate = (
            self.pads[0].sensor,
            f"{_rate_hz(self.pads):g}" if self.known else "TODO",
        )
        if name:
            place = data_specs_folder() / "sensors" / f"{name}.yaml"
            shipped = load_sensor_spec(place)
            size, unit, most = (
                shipped.rows * shipped.columns,
                shipped.unit,
                str(shipped.max_count),
            )
        else:
            assert self.pads[0].counts is not None
            (dtype, shape), place = (
                self.pads[0].counts,
                Path(_beside(self.path, "sensor").name),
            )
            size, unit, most = (
                math.prod(shape),
                COUNT_UNIT,
                str(np.iinfo(dtype).max) if dtype == "uint8" else "TODO",
            )
        note = (
            ""
            if most != "TODO"
            else "   # ± the largest count that the converter sends"
        )
        text = f"    {{dtype: int16, shape: [{len(self.pads) * size}], unit: {unit}, frame: pad, rate_hz: {rate}, "
        text += f"range: [-{most}, {most}],{note}"
        return [
            "  observation.tactile:",
            text,
            f"     sensor: {_yaml(str(place))}, pads: [{self.channels(self.pads)}]}}",
        ]

    # ---- the sensor spec ----

    def sensor(self) -> list[str]:
        """Sensor spec of pads that no shipped one fits."""
        assert self.pads[0].counts is not None
        dtype, shape = self.pads[0].counts
        size = math.prod(shape)
        pairs = [
            (rows, size // rows) for rows in range(1, size + 1) if size % rows == 0
        ]
        likely = sorted(pairs, key=lambda p: (abs(math.log(p[0] / p[1])), p))[:3]
        rows, columns = map(str, shape) if len(shape) == 2 else ("TODO", "TODO")
        known = self.pads[0].rate_hz if self.known else 0.0
        bits = {
            "uint8": "8   # of the converter; if it has more, wire_shift_bits low ones are not sent"
        }
        return [
            self.head()[0].removesuffix(",") + ".",
            "spec_version: 1",
            f"name: {_yaml(re.sub(r'[^A-Za-z0-9_]+', '_', _beside(self.path, 'sensor').stem))}",
            f"rows: {rows}   # of taxels; rows × columns are {size}: {', '.join(f'{r} × {c}' for r, c in likely)} …",
            f"columns: {columns}",
            f"wire: {{rows: {rows}, columns: {columns}, dtype: {dtype}, transpose: false}}   "
            "# as it is sent, row after row; transpose: true if its rows are the pad's columns",
            f"adc_bits: {bits.get(dtype, 'TODO   # of the converter, at most 15: 10, 12')}",
            "wire_shift_bits: 0   # a guess",
            f"rate_hz: {f'{known:.3g}' if known else 'TODO   # readings a second'}",
            f"scan_time_s: {f'{1 / known:.3g}' if known else 'TODO'}   # a guess: time of one scan, at most 1 / rate_hz",
            f"unit: {COUNT_UNIT}",
            "baseline: {rule: median_of_first, frames: 30, max_spread_count: TODO}   "
            "# 30 is a guess; a pad whose first 30 frames spread more, in counts, is not at rest: 12",
            "noise_count: TODO   # counts above the baseline that an untouched taxel may show: 15",
            "scheme: fixed_scale   # a guess",
            "gain_per_count: TODO   # the policy reads counts × gain and calls a taxel above 0.4 touched: 0.0133 for 30 counts",
        ]


def _one_of_each(topics: list[TopicSummary]) -> list[TopicSummary]:
    """Of several topics with the same joints of the same arm, the one that is named most as a state."""
    best: dict[Any, TopicSummary] = {}
    for t in sorted(topics, key=lambda t: (not _says(t, STATE_WORDS), len(t.topic))):
        best.setdefault((t.names or t.topic, _side(t)), t)
    return [t for t in topics if t in best.values()]


def _numbered_alike(topics: list[TopicSummary]) -> list[TopicSummary]:
    """Datasets of a file that differ from an earlier one in the number of a group alone, /robot_0/qpos and /robot_1/qpos: arms
    of one robot, or episodes? Not guessed."""
    seen: set[str] = set()
    found = []
    for t in topics:
        groups, _, name = t.topic.rpartition("/")
        pattern = f"{re.sub(r'[0-9]+', '#', groups)}/{name}"
        found += (
            [t]
            if t.type.shape is not None and "#" in pattern and pattern in seen
            else []
        )
        seen.add(pattern)
    return found


def _words(t: TopicSummary) -> list[str]:
    return re.split(r"[^a-z]+", t.topic.lower())


def _side(t: TopicSummary) -> str:
    return next((w for w in _words(t) if w in ("left", "right")), "")


def _says(t: TopicSummary, hints: tuple[str, ...]) -> bool:
    """Whether a word of the topic is, or begins with, one of ``hints``."""
    return any(word.startswith(hints) for word in _words(t))


def _channel_names(
    topics: list[TopicSummary],
) -> dict[tuple[str, tuple[str, ...]], str]:
    """``TopicSummary.key`` → a short name of its own."""
    names: dict[tuple[str, tuple[str, ...]], str] = {}
    for t in topics:
        words = re.sub(r"[^A-Za-z0-9/]+", "_", t.topic).strip("/_").split("/")
        short = [w for w in words if w not in ("image_raw", "compressed", "color")]
        name = re.sub(r"^observations?_(images_)?", "", "_".join(short)) or "channel"
        name = "_".join(words) if name in names.values() else name
        name = (
            name
            if name[0].isalpha() and name.lower() not in YAML_WORDS
            else f"channel_{name}"
        )
        numbered = (name, *(f"{name}_{k}" for k in range(2, len(names) + 3)))
        names[t.key] = next(n for n in numbered if n not in names.values())
    return names


def _unused(t: TopicSummary) -> str:
    if t.problem or t.counts is None:
        return t.problem or f"{t.topic} ({t.type.name})"
    how = "a channel like the others, in a feature like those of data_specs/taccorl_bimanual.yaml, with a sensor file"
    return f"{t.topic}: {' × '.join(map(str, t.counts[1]))} counts of {t.counts[0]}. If it is a tactile pad: {how}"


def _rate_hz(topics: list[TopicSummary]) -> float:
    """The rate of the slowest topic, rounded to three digits, or to a whole number if it is within 1 % of one."""
    rate_hz = min(t.rate_hz or 1.0 for t in topics)
    return (
        float(f"{rate_hz:.3g}")
        if abs(round(rate_hz) - rate_hz) > 0.01 * rate_hz
        else float(round(rate_hz))
    )


def _yaml(text: str) -> str:
    """A text as YAML reads it back; quoted unless it is plainly a name or path."""
    plain = re.fullmatch(r"/?[A-Za-z_][A-Za-z0-9_/.-]*", text)
    return (
        text
        if plain and text.lower() not in YAML_WORDS
        else printable(json.dumps(text, ensure_ascii=False))
    )

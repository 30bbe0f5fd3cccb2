"""Write a surrogate robot as files: MCAP in the drivers' format, the twin with which its user starts, and the sealed truth.

FOLDER/sweeps/*.mcap, measurements.yaml    for ``taccorl compare`` and ``diagnose``; recordings of pads: presses/
FOLDER/twin.yaml                           without the hidden effects
FOLDER/sealed_truth.json                   outside the folder of measurements, so that no command reads it

Surrogate pads are written in the same way; their measurements.yaml states the pressed objects.
"""

import base64
import dataclasses
import json
import shutil
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from taccorl.alignment.measurements.folder import INDEX, Measurements
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.alignment.measurements.table_files import origin_lines
from taccorl.data.origin import labelled
from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.twin import TwinConfig
from taccorl.sim.twin_file import save_twin
from taccorl.surrogate import drivers
from taccorl.surrogate.cases import Case
from taccorl.surrogate.driver_messages import UINT8_ARRAY
from taccorl.surrogate.recordings import robot_recordings
from taccorl.surrogate.touch import TouchCase, pressed_notes, touch_recordings
from taccorl.surrogate.touch_hidden import OUTSIDE_TOUCH, REGISTERED_TOUCH

SWEEPS, PRESSES, TWIN, TRUTH = "sweeps", "presses", "twin.yaml", "sealed_truth.json"
"""Names of the folders and files in the output folder."""
FINGERS_LAG_S = 0.03  # Time constant with which surrogate fingers follow their command [s]. A choice.
_NOTE = "What is hidden in this surrogate robot. Compare and diagnose do not read it; `taccorl surrogate --reveal` prints it."


class _Rows(drivers.TrueSignals):
    """A measurement as the drivers' story: what stands in its rows, between which nobody asks. A driver that measures no
    velocity or effort sends zeros."""

    def __init__(self, measurement: Measurement) -> None:
        self.measurement = measurement
        self.plans: list[drivers.Marks] = []
        self.duration_s = measurement.num_rows / measurement.rate_hz
        self._rows = {"state": measurement.measured, "command": measurement.target}
        self._rows |= {
            name: np.nan_to_num(getattr(measurement, name))
            for name in ("velocity", "effort")
        }

    def at(self, signal: str, time_s: np.ndarray) -> np.ndarray:
        row = np.rint(np.asarray(time_s) * self.measurement.rate_hz).astype(int)
        return self._rows[signal][np.clip(row, 0, self.measurement.num_rows - 1)]

    def clean_counts(self, pad: str, time_s: np.ndarray) -> np.ndarray:
        """(N, 12, 32) in wire order: nothing is touched."""
        return np.zeros((len(time_s), *drivers.PAD_WIRE_SHAPE))


class _Sweep(drivers.Streams):
    """Joints, commands and pads; no camera looks at a sweep."""

    def __init__(self, config: drivers.DriverConfig, rows: _Rows) -> None:
        super().__init__(config, rows, None)
        self._touch = rows.measurement.touch

    def _pad(self, topic: str, pad: str) -> Iterator[drivers.Event]:
        """The frames that were measured, byte for byte, logged when they had been scanned: no time is lost on the wire."""
        if self._touch is None:
            yield from super()._pad(topic, pad)
            return
        shape, k = (-1, len(drivers.PADS), *ROBOT.pad.shape), drivers.PADS.index(pad)
        wire = (
            (self._touch.counts + self._touch.baseline)
            .reshape(shape)[:, k]
            .swapaxes(1, 2)
            .astype(np.uint8)
        )
        for stamp, frame in zip(self._touch.time_s[:, k].tolist(), wire, strict=True):
            yield drivers.Event(
                stamp,
                stamp - drivers.SCAN_S / 2,
                topic,
                UINT8_ARRAY,
                drivers.pad_message(frame),
            )

    def all(self) -> list[Iterator[drivers.Event]]:
        """One stream per topic, each in order of log time."""
        return [
            *(
                self._joints(drivers.STATE_TOPICS[arm], arm, command=False)
                for arm in ROBOT.arms
            ),
            *(
                self._joints(drivers.COMMAND_TOPICS[arm], arm, command=True)
                for arm in ROBOT.arms
            ),
            *(self._pad(drivers.PAD_TOPICS[pad], pad) for pad in drivers.PAD_TOPICS),
        ]


def _write_recording(
    path: Path, measurement: Measurement, seed: int, repeat_of: str | None
) -> None:
    """Write one recording in the format of the robot's drivers; an existing file is replaced. ``repeat_of``: name of the
    recording that it repeats; None if it is no repeat."""
    story = _Rows(measurement)
    told = measurement.instruction
    config = drivers.DriverConfig(
        duration_s=story.duration_s, seed=seed, instruction=told, pad_gain_spread=0.0
    )
    label = labelled(measurement.origin) | {
        "instruction": told,
        "repeat_of": repeat_of or "",
    }
    label |= {
        key: json.dumps(getattr(measurement, key))
        for key in ("kp", "kd", "gain_scale", "payload_kg")
    }
    drivers.publish(path, _Sweep(config, story), label)


Progress = Callable[[str, int, int], None]
"""Function that is called with the name of a recording, the number of recordings written, and of all."""


def write_recordings(
    cases: Sequence[Case], folder: Path, progress: Progress | None = None
) -> int:
    """Write a robot's joints, of one twin, as files into ``folder``; returns the number of recordings. Raises TaccorlError: the
    folder holds other files."""
    uses = _uses(robot_recordings(cases))
    truth: dict[str, object] = (
        {"joints": [c.truth() for c in cases]} if len(cases) > 1 else cases[0].truth()
    )
    with _beside(Path(folder)) as part:
        _fill(part, truth, cases[0].twin, uses, {}, progress)
    return len(uses)


def _uses(made: Measurements) -> list[tuple[str, Measurement]]:
    return [
        (use, m) for use in ("fit", "validation", "test") for m in getattr(made, use)
    ]


def write_touch_recordings(
    case: TouchCase, folder: Path, progress: Progress | None = None
) -> Measurements:
    """Write surrogate pads as files: as ``write_recordings``, with the pressed object of each recording. Raises TaccorlError:
    the folder holds other files."""
    made = touch_recordings(case)
    uses = [(use, _commanded(m, case.arm)) for use, m in _uses(made)]
    with _beside(Path(folder)) as part:
        _fill(part, case.truth(), case.twin, uses, pressed_notes(case), progress)
    return made


@contextmanager
def _beside(folder: Path) -> Iterator[Path]:
    """A folder beside ``folder`` to write into, which then takes its place: half a robot never stands there. Raises
    TaccorlError: the folder holds something that is no surrogate's, or there is no room."""
    if folder.exists() and any(folder.iterdir()) and not (folder / TRUTH).is_file():
        raise TaccorlError(
            f"{folder}: it contains files that are not of a surrogate robot; give another --out="
        )
    part = folder.with_name(f"{folder.name}.part")
    shutil.rmtree(part, ignore_errors=True)  # of a run that was killed
    try:
        yield part
    except OSError as error:
        shutil.rmtree(part, ignore_errors=True)
        raise TaccorlError(
            f"{folder}: {error.strerror or error}; nothing was written or replaced there: make room, or give another --out="
        ) from error
    folder.mkdir(exist_ok=True)
    for name in (SWEEPS, PRESSES):
        shutil.rmtree(folder / name, ignore_errors=True)
    for path in part.iterdir():
        path.replace(folder / path.name)
    part.rmdir()


def _fill(
    folder: Path,
    truth: dict[str, object],
    twin: TwinConfig,
    uses: Sequence[tuple[str, Measurement]],
    pressed: dict[str, dict[str, Any]],
    progress: Progress | None,
) -> None:
    files = {m.name: f"{k:02d}_{m.name}.mcap" for k, (_, m) in enumerate(uses, 1)}
    recordings = folder / (PRESSES if pressed else SWEEPS)
    recordings.mkdir(parents=True)
    seal(folder, truth)
    for k, (_, m) in enumerate(uses):
        if progress is not None:
            progress(files[m.name], k, len(uses))
        _write_recording(
            recordings / files[m.name],
            m,
            k,
            files[m.repeat_of] if m.repeat_of else None,
        )
    notes: dict[str, dict[str, Any]] = {files[m.name]: {"use": use} for use, m in uses}
    for name, of in pressed.items():
        notes[files[name]]["pressed"] = of
    _write_yaml(recordings / INDEX, {"recordings": notes})
    save_twin(twin, folder / TWIN)


def write_tables(
    folder: Path,
    kind: str,
    columns: Mapping[str, Any],
    made: Measurements,
    table: Callable[[Any], Mapping[str, np.ndarray]],
    truth: dict[str, object],
) -> None:
    """Write recordings as CSV files into FOLDER/KIND, with a columns file and a measurements.yaml, and the sealed truth.
    ``columns``: content of the columns file. ``table``: function of a measurement that returns its columns, name → (T,). Raises
    FileExistsError: the folder exists."""
    folder.mkdir(parents=True)
    (folder / kind).mkdir()
    notes: dict[str, dict[str, str]] = {}
    for use, m in _uses(made):
        own, path = table(m), folder / kind / f"{m.name}.csv"
        header = origin_lines(m.origin) + ",".join(own)
        values = np.column_stack([*own.values()])
        np.savetxt(
            path,
            values,
            fmt="%.8g",
            delimiter=",",
            header=header,
            comments="",
            encoding="utf-8",
        )
        notes[path.name] = {"use": use} | (
            {"repeat_of": f"{m.repeat_of}.csv"} if m.repeat_of else {}
        )
    _write_yaml(folder / kind / "columns.yaml", columns)
    _write_yaml(folder / kind / INDEX, {"columns": "columns.yaml", "recordings": notes})
    seal(folder, truth)


def _write_yaml(path: Path, content: Mapping[str, Any]) -> None:
    text = yaml.safe_dump(
        dict(content),
        sort_keys=False,
        default_flow_style=None,
        allow_unicode=True,
        width=120,
    )
    path.write_text(text, encoding="utf-8")


def _commanded(m: Measurement, arm: str) -> Measurement:
    """Made presses know where the fingers are, not what they were told: a command that they follow with a lag and a row late."""
    gripper, target = m.column(f"{arm}_gripper"), m.target.copy()
    opening = target[:, gripper]
    told = opening + FINGERS_LAG_S * np.gradient(opening, m.period_s)
    target[:, gripper] = np.append(told[1:], told[-1])
    return dataclasses.replace(m, target=target)


def draw_touch_secret(seed: int) -> tuple[str, ...]:
    """Names of the effects that the pads of this seed hide: one of the registry, with a probability of 10 % none, of 15 % one
    from outside of it."""
    rng = np.random.default_rng([seed, zlib.crc32(b"secret pads")])
    fate = rng.random()
    if fate < 0.1:
        return ()
    return (str(rng.choice(OUTSIDE_TOUCH if fate < 0.25 else REGISTERED_TOUCH)),)


def seal(folder: Path, truth: dict[str, object]) -> None:
    """Write the true values into a file in encoded form, so that nobody reads them by mistake."""
    text = base64.b64encode(json.dumps(truth, ensure_ascii=False).encode()).decode()
    (folder / TRUTH).write_text(
        json.dumps({"note": _NOTE, "sealed": text}, indent=1), encoding="utf-8"
    )


def reveal(folder: Path) -> dict[str, object]:
    """The sealed truth of ``folder``, as ``Case.truth``, ``TouchCase.truth`` or ``MachineSurrogate.truth`` made it. Raises
    TaccorlError: there is no sealed truth, or it is damaged."""
    path = Path(folder) / TRUTH
    if not path.is_file():
        raise TaccorlError(
            f"{path}: no such file; give the folder that `taccorl surrogate --out=` wrote"
        )
    try:
        return json.loads(
            base64.b64decode(json.loads(path.read_text(encoding="utf-8"))["sealed"])
        )
    except (ValueError, KeyError, TypeError) as error:
        raise TaccorlError(
            f"{path}: its truth cannot be read ({error}); make the robot again"
        ) from error

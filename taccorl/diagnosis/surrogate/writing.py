"""A surrogate robot as files: MCAP as the drivers write it, the twin that its user starts from, and the sealed truth.

FOLDER/sweeps/*.mcap, measurements.yaml    for ``taccorl compare`` and ``diagnose``
FOLDER/twin.yaml                           without the hidden effects
FOLDER/sealed_truth.json                   beside the measurements and not among them: nothing that reads them reads it
"""

import base64
import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import yaml

from taccorl.alignment.measurement import Measurement
from taccorl.alignment.measurements import INDEX, Measurements
from taccorl.demos.stand_in import publish
from taccorl.demos.stand_in_config import COMMAND_TOPICS, PAD_TOPICS, STATE_TOPICS, StandInConfig
from taccorl.demos.stand_in_story import PAD_WIRE_SHAPE, EpisodePlan
from taccorl.demos.stand_in_streams import Event, Streams
from taccorl.diagnosis.surrogate.cases import Case
from taccorl.diagnosis.surrogate.recordings import recordings
from taccorl.errors import TaccorlError
from taccorl.sim.robot import ARMS
from taccorl.sim.twin_file import save_twin

SWEEPS, TWIN, TRUTH = "sweeps", "twin.yaml", "sealed_truth.json"
_NOTE = "What is hidden in this surrogate robot. Compare and diagnose do not read it; `taccorl surrogate --reveal` prints it."


class _Rows:
    """A measurement as the drivers' story: what stands in its rows, between which nobody asks."""

    def __init__(self, measurement: Measurement) -> None:
        self.measurement = measurement
        self.plans: list[EpisodePlan] = []
        self.duration_s = measurement.num_rows / measurement.rate_hz

    def _at(self, values: np.ndarray, time_s: np.ndarray) -> np.ndarray:
        row = np.rint(np.asarray(time_s) * self.measurement.rate_hz).astype(int)
        return values[np.clip(row, 0, len(values) - 1)]

    def state(self, time_s: np.ndarray) -> np.ndarray:
        """(N, 14)."""
        return self._at(self.measurement.measured, time_s)

    def command(self, time_s: np.ndarray) -> np.ndarray:
        """(N, 14)."""
        return self._at(self.measurement.target, time_s)

    def velocity(self, time_s: np.ndarray) -> np.ndarray:
        """(N, 14)."""
        return self._at(self.measurement.velocity, time_s)

    def effort(self, time_s: np.ndarray) -> np.ndarray:
        """(N, 14)."""
        return self._at(self.measurement.effort, time_s)

    def clean_counts(self, pad: str, time_s: np.ndarray) -> np.ndarray:
        """(N, 12, 32) in wire order: nothing is touched."""
        return np.zeros((len(time_s), *PAD_WIRE_SHAPE))


class _Dark:
    """No camera looks at a sweep."""

    def pictures_bgr(self, camera: str, time_s: np.ndarray, frame_ids: np.ndarray) -> Iterator[np.ndarray]:
        """None."""
        return iter(())


class _Sweep(Streams):
    """Joints, commands and pads."""

    def all(self) -> list[Iterator[Event]]:
        """One stream per topic, each in order of log time."""
        return [
            *(self._joints(STATE_TOPICS[arm], arm, command=False) for arm in ARMS),
            *(self._joints(COMMAND_TOPICS[arm], arm, command=True) for arm in ARMS),
            *(self._pad(PAD_TOPICS[pad], pad) for pad in PAD_TOPICS),
        ]


def write_recording(path: Path, measurement: Measurement, seed: int, repeat_of: str | None) -> None:
    """One recording as the robot's drivers write it; replaces the file if there is one."""
    story = _Rows(measurement)
    config = StandInConfig(
        duration_s=story.duration_s, seed=seed, instruction=measurement.instruction, pad_gain_spread=0.0
    )
    label = {"origin": measurement.origin, "instruction": measurement.instruction, "repeat_of": repeat_of or ""}
    label |= {key: json.dumps(getattr(measurement, key)) for key in ("kp", "kd", "gain_scale", "payload_kg")}
    publish(path, _Sweep(config, story, _Dark()), label)


def write_recordings(case: Case, folder: Path) -> Measurements:
    """The whole robot as files, and what was written.

    Raises:
        TaccorlError: the folder holds something that is no surrogate's.
    """
    folder = Path(folder)
    _cleared(folder)
    made = recordings(case)
    files = {m.name: f"{k:02d}_{m.name}.mcap" for k, m in enumerate(made.all, 1)}
    uses = {m.name: use for use in ("fit", "held_out", "test") for m in getattr(made, use)}
    (folder / SWEEPS).mkdir(parents=True)
    seal(folder, case.truth())
    for k, m in enumerate(made.all):
        write_recording(folder / SWEEPS / files[m.name], m, k, files[m.repeat_of] if m.repeat_of else None)
    index = {"recordings": {files[name]: {"use": use} for name, use in uses.items()}}
    (folder / SWEEPS / INDEX).write_text(yaml.safe_dump(index, sort_keys=False), encoding="utf-8")
    save_twin(case.twin, folder / TWIN)
    return made


def _cleared(folder: Path) -> None:
    if not folder.exists() or not any(folder.iterdir()):
        return
    if not (folder / TRUTH).is_file():
        raise TaccorlError(f"{folder}: it holds something that is no surrogate robot; give another --out=")
    for name in (TRUTH, TWIN):
        (folder / name).unlink(missing_ok=True)
    shutil.rmtree(folder / SWEEPS, ignore_errors=True)


def seal(folder: Path, truth: dict[str, object]) -> None:
    """The truth into its file, so that nobody reads it by mistake."""
    text = base64.b64encode(json.dumps(truth, ensure_ascii=False).encode()).decode()
    (folder / TRUTH).write_text(json.dumps({"note": _NOTE, "sealed": text}, indent=1), encoding="utf-8")


def reveal(folder: Path) -> dict[str, object]:
    """What was sealed in ``folder``.

    Raises:
        TaccorlError: there is no sealed truth, or it is damaged.
    """
    path = Path(folder) / TRUTH
    if not path.is_file():
        raise TaccorlError(f"{path}: no such file; give the folder that `taccorl surrogate --out=` wrote")
    try:
        return json.loads(base64.b64decode(json.loads(path.read_text(encoding="utf-8"))["sealed"]))
    except (ValueError, KeyError, TypeError) as error:
        raise TaccorlError(f"{path}: its truth cannot be read ({error}); make the robot again") from error

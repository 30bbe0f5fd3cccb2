"""Episode: one attempt on one clock, with numbers as arrays and pictures as a stream. The writer, checks and views use it.

Letters in shapes: T rows (time), K taxels, L history.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from taccorl.data.finding import Finding
from taccorl.data.origin import UNSTATED, Origin
from taccorl.data.spec import ACTION, STATE, DatasetSpec
from taccorl.errors import DatasetError

EXECUTED = "sim.executed"
"""Feature with the targets that were sent to the twin, if they differ from the intended ones in ``action``."""
INTENDED = "intended_action"
"""Key in an episode's provenance. True: ``action`` holds the scripted expert's targets without its aiming error and tremor."""
Pictures = dict[str, np.ndarray]  # Feature key → (rows, columns, 3) uint8 RGB


@dataclass(frozen=True)
class Video:
    """The part of a video file of a LeRobot dataset that shows one episode, a frame per row."""

    path: Path
    from_s: float
    num_frames: int


@dataclass(frozen=True)
class ChannelTiming:
    """Timing of one channel's samples at the rows of this episode; all in seconds."""

    channel: str
    feature: str
    align: str  # Rule by which its samples are assigned to rows (``MappingSpec.align``)
    rate_hz: float
    gaps: int  # Intervals longer than 1.5 median intervals
    longest_gap_s: float
    age_median_s: float
    """Median age of the samples that the rows show [s]; ``age_max_s``: the largest. Row time − sample time; for ``action`` the
    time of the next row − sample time."""
    age_max_s: float
    duplicates: int = 0  # Number of samples that repeat the time of an earlier one
    out_of_order: int = (
        0  # Number of samples that are older than the one before them in the file
    )
    zero_stamps: int = 0  # Number of samples that were dropped because their stamp is 0
    skipped: dict[str, int] = field(
        default_factory=dict
    )  # Reason → number of messages that give the channel no sample
    nominal_hz: float = 0.0  # Rate that the recording spec states for the channel [Hz]; 0 if it states none


@dataclass(frozen=True)
class Arm:
    """Indices of the elements of ``observation.state`` and ``action`` that belong to one arm."""

    name: str
    """Prefix of the elements' names (``left``, ``right``), without the underscore; empty for a robot with one arm."""
    joints: np.ndarray
    """(n,) indices of the elements that are joint angles [rad], from base to wrist."""
    gripper: int | None
    """Index of the element that is the gripper's opening [m]; None without a gripper."""


@dataclass(frozen=True)
class Episode:
    """One episode, cut and aligned: T rows at ``spec.fps``, and facts about its origin."""

    name: str  # Name for messages and titles: recording and episode
    spec: DatasetSpec
    start_ns: int  # Time of row 0 on the recording's clock [ns]
    arrays: dict[
        str, np.ndarray
    ]  # Feature key → (T, size): every feature of the episode that is not a video
    pictures: Callable[[], Iterator[Pictures]]
    """Calling it streams the T rows' pictures from the start, for the video features of ``picture_keys``."""
    picture_keys: tuple[str, ...]
    instruction: str  # Sentence that the policy reads
    success: bool | None = (
        None  # True or False as the operator's marker states; None without a marker
    )
    origin: Origin = UNSTATED
    timing: tuple[ChannelTiming, ...] = ()
    picture_rows: dict[str, np.ndarray] = field(default_factory=dict)
    """Video key → (T,) index of the source picture that each row shows, for finding frozen cameras; empty for an episode of a
    dataset."""
    baselines: dict[str, np.ndarray] = field(default_factory=dict)
    """Tactile key → (K,) counts of the untouched pad that were subtracted from the readings."""
    videos: dict[str, Video] = field(
        default_factory=dict
    )  # Video key → file, where the episode comes from a dataset
    stages: tuple[
        tuple[int, str], ...
    ] = ()  # (first row, name) of the task's stages, where known
    provenance: dict[str, object] = field(default_factory=dict)
    """Facts about how the episode was made, as JSON values: recording, simulation …"""
    stored_rows: int = 0
    """Number of rows that the dataset states; used where no array of numbers was read."""
    findings: tuple[Finding, ...] = ()
    """Findings about the recording's samples, at the full rate of the channels (rows hold only some of the samples)."""

    @property
    def num_rows(self) -> int:
        """T: number of rows, of pictures where there are no numbers."""
        columns = (*self.arrays.values(), *self.picture_rows.values())
        return len(columns[0]) if columns else self.stored_rows

    @property
    def time_s(self) -> np.ndarray:
        """(T,) seconds since row 0."""
        return np.arange(self.num_rows) / self.spec.fps

    def executed(self) -> np.ndarray:
        """(T, A) targets that were sent: the actions, or where ``action`` is what was intended (of a disturbed arm, or of an
        expert that aims with an error) the targets that were sent. Raises DatasetError: those are not stored."""
        told = self.provenance.get("simulation")
        made = (
            told.get("mimicgen", told.get("correction"))
            if isinstance(told, dict)
            else None
        )
        if EXECUTED in self.arrays:
            return self.arrays[EXECUTED]
        if isinstance(made, dict) and ("disturbance" in made or INTENDED in made):
            text = f"{self.name}: its actions are what was intended, those sent ({EXECUTED}) are not stored: merge "
            raise DatasetError(
                f"{text}omits them. Give the dataset as it was before the merge"
            )
        return self.arrays["action"]

    def joints(self, key: str, unit: str) -> np.ndarray:
        """(size,) bool: True for the elements of feature ``key`` that have this unit."""
        return np.array([u == unit for u in self.spec.features[key].units])

    def element_names(self, key: str) -> tuple[str, ...]:
        """Name of every element of a feature; ``key[0]``, ``key[1]`` … where the spec names none."""
        return self.spec.features[key].element_names(key)

    def state_arms(self) -> list[Arm]:
        """Arms by the prefixes ``left_`` and ``right_`` of the names in ``observation.state``, never by position; elements
        without a prefix belong to the arm without a name."""
        names, units = self.element_names(STATE), self.spec.features[STATE].units
        prefixes = [
            next((p for p in ("left", "right") if n.startswith(f"{p}_")), "")
            for n in names
        ]
        arms = []
        for prefix in sorted(set(prefixes)):
            own = [i for i, p in enumerate(prefixes) if p == prefix]
            grippers = [
                i for i in own if units[i] == "m" and names[i].endswith("gripper.pos")
            ]
            joints = np.array([i for i in own if units[i] == "rad"], dtype=int)
            arms.append(Arm(prefix, joints, next(iter(grippers), None)))
        return arms

    def arms(self) -> list[Arm]:
        """Arms of an episode whose state and command have the same names; none if they differ or one is missing."""
        if STATE not in self.arrays or ACTION not in self.arrays:
            return []
        return (
            self.state_arms()
            if self.element_names(STATE) == self.spec.features[ACTION].names
            else []
        )

    def pads(self, key: str) -> dict[str, np.ndarray]:
        """Pad name → (T, rows, columns) counts above baseline, the newest reading in each row of tactile feature ``key``."""
        feature, sensor = self.spec.features[key], self.spec.sensors[key]
        counts = self.arrays[key].reshape(
            -1, feature.history, len(feature.pads), sensor.rows, sensor.columns
        )
        return {pad: counts[:, -1, p] for p, pad in enumerate(feature.pads)}

"""A measurement: commands and measured positions on one clock. The twin is compared with it row by row.

The rule of every row, and of every reader: **the target of row k is in force from time k on, and the position of row k is
where the joint was at time k**, before that target could act. ``taccorl.sim.replay`` follows the same rule. An error of one row
(5 ms) turned K_p 151 into 690 in an identification (MuJoCo's sensordata after a step is the state before it).

Letters in shapes: T rows, J signals (of the robot: in the order of actions), N touch frames, K taxels.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Literal, Self

import numpy as np

from taccorl.alignment.measurements.pressed import PressedObject
from taccorl.alignment.measurements.registers import UnsignedColumn
from taccorl.data.episode import ChannelTiming
from taccorl.data.finding import Finding
from taccorl.data.origin import UNSTATED, Origin
from taccorl.errors import TaccorlError, nearest, plain_name, printable
from taccorl.robots import ROBOT

UNITS = {
    "rad": ("rad/s", "N·m"),
    "m": ("m/s", "N"),
}  # Unit of a position → units of its velocity and effort


def unit_of(name: str) -> str:
    """Unit of the position of one of the PiPER's signals: "m" of a gripper, "rad" of a joint."""
    return "m" if name.endswith("gripper") else "rad"


TargetKind = Literal["position", "velocity", "torque", "effort"]
"""Quantity that a target states. ``effort``: no target was logged; the measured effort is the input of a model (law effort)."""
ROBOT_UNITS = tuple(unit_of(name) for name in ROBOT.action_names)
"""Units of the PiPER's signals, in the order of actions."""


@dataclass(frozen=True)
class TouchPad:
    """One pad of a recording."""

    name: str
    """Name of the pad in the dataset spec. It begins with the name of the arm that carries it: ``left_a``."""
    shape: tuple[int, int]
    """Number of rows and number of columns of the pad's taxels."""
    gain_per_count: float = 1 / 75
    """Normalised reading = counts above baseline × gain."""

    def __str__(self) -> str:
        return f"{self.name} ({self.shape[0]}×{self.shape[1]})"


@dataclass(frozen=True, kw_only=True)
class Touch:
    """Frames of P pads at their own rate. Pads are scanned at different times, so that each has its own times."""

    time_s: np.ndarray
    """(N, P) times [s] of the ends of each pad's scans, on the measurement's clock, in the order of ``pads``."""
    counts: np.ndarray
    """(N, K) int16 counts above baseline, unclipped: the taxels of one pad after
    those of the other, row after row."""
    baseline: np.ndarray  # (K,) counts that were subtracted
    pads: tuple[TouchPad, ...] = tuple(
        TouchPad(name, ROBOT.pad.shape) for name in ROBOT.pads
    )
    """The P pads; the twin's if not given."""

    def __post_init__(self) -> None:
        num_taxels = sum(math.prod(pad.shape) for pad in self.pads)
        shapes = self.time_s.shape[1], self.counts.shape[1], len(self.baseline)
        if shapes != (len(self.pads), num_taxels, num_taxels):
            pads = ", ".join(map(str, self.pads))
            raise TaccorlError(
                f"touch: times of {shapes[0]} pads, {shapes[1]} taxels and "
                f"{shapes[2]} resting counts, but the pads are {pads}"
            )

    @property
    def parts(self) -> dict[TouchPad, "Touch"]:
        """Pad → its frames alone, in the order of ``pads``."""
        found, first = {}, 0
        for p, pad in enumerate(self.pads):
            taxels = slice(first, first := first + math.prod(pad.shape))
            found[pad] = Touch(
                time_s=self.time_s[:, p : p + 1],
                counts=self.counts[:, taxels],
                baseline=self.baseline[taxels],
                pads=(pad,),
            )
        return found

    def without(self, known: Sequence[TouchPad]) -> list[TouchPad]:
        """The pads that have another name or shape than each of ``known``."""
        alike = {(pad.name, pad.shape) for pad in known}
        return [pad for pad in self.pads if (pad.name, pad.shape) not in alike]


@dataclass(frozen=True, kw_only=True)
class Stated:
    """Facts about one recording that its rows do not hold."""

    kp: dict[str, float] = field(
        default_factory=dict
    )  # Signal → commanded K_p [N·m/rad, N/m], if stated
    kd: dict[str, float] = field(
        default_factory=dict
    )  # Signal → commanded K_d [N·m·s/rad, N·s/m], if stated
    gain_scale: dict[str, float] = field(default_factory=dict)
    """Signal → factor of both gains relative to those of the other recordings, if only this is known."""
    payload_kg: dict[str, float] = field(default_factory=dict)
    """Arm, or name of an axis → known mass of the payload [kg]."""
    lever_m: dict[str, float] = field(default_factory=dict)
    """Axis → distance from it to its payload [m], if it differs from that in the file."""
    arm_kg: dict[str, float] = field(default_factory=dict)
    """Axis → mass of the arm that holds the payload [kg]: a uniform rod from the axis to the lever's end."""
    payload_position_m: dict[str, tuple[float, float, float]] = field(
        default_factory=dict
    )
    """Arm → centre of mass of the payload in link 6's frame [m] (origin at the flange, z along the hand); by default the TCP,
    (0, 0, 0.168)."""

    @classmethod
    def names(cls) -> list[str]:
        """Names of these facts."""
        return [f.name for f in dataclasses.fields(Stated)]


@dataclass(frozen=True, kw_only=True)
class Measurement(Stated):
    """One recording on one clock, at the rate at which commands were sent. Raises TaccorlError: the shapes do not fit
    together."""

    known_units: ClassVar[tuple[str, ...]] = tuple(UNITS)
    name: str  # Name of the recording: its file or folder name, or its dataset's name and episode
    time_s: np.ndarray
    """(T,) times since the first row [s]. They are even for recordings; a table keeps its own times, which are checked."""
    target: np.ndarray  # (T, J) targets [rad, m], in force from ``time_s[k]`` on
    measured: np.ndarray  # (T, J) positions [rad, m] at ``time_s[k]``; NaN in longer gaps of the measurement
    velocity: np.ndarray = field(default_factory=lambda: np.empty(0))
    """(T, J) velocities [rad/s, m/s] as reported by the driver; NaN if it reports none."""
    effort: np.ndarray = field(default_factory=lambda: np.empty(0))
    """(T, J) efforts [N·m, N] as reported by the driver; NaN if it reports none. PiPER firmware may report another scale."""
    load: np.ndarray = field(default_factory=lambda: np.empty(0))
    """(T, J) known external torques on the joints [N·m, N], positive if they drive the joint forwards; empty if there are
    none."""
    torque_ff: np.ndarray = field(default_factory=lambda: np.empty(0))
    """(T, J) torques that the controller is known to have added to its law [N·m, N], which are part of ``effort``; empty if
    there are none."""
    supply_v: np.ndarray = field(default_factory=lambda: np.empty(0))
    """(T, J) supply voltages of the motors [V]; NaN where not recorded; empty if never recorded."""
    enabled: np.ndarray = field(default_factory=lambda: np.empty(0))
    """(T, J) 0 while the motor is off, else 1; empty if it is never off."""
    command_s: np.ndarray = field(default_factory=lambda: np.empty(0))
    """(T,) arrival times of each row's targets [s], on the clock of ``time_s``; empty if they equal the rows' times."""
    signals: tuple[str, ...] = (
        ROBOT.action_names
    )  # (J,) names of the signals, in the order of the columns
    units: tuple[str, ...] = ROBOT_UNITS  # Unit of each signal's position: rad or m
    target_kinds: tuple[
        TargetKind, ...
    ] = ()  # Quantity that ``target`` states for each signal; positions if not given
    quantum: np.ndarray = field(default_factory=lambda: np.empty(0))
    """(J,) step between neighbouring encoder readings [rad, m], found before any interpolation; 0 if none is visible."""
    touch: Touch | None = None  # Frames of the pads; None if there are none
    source: Path = Path()  # File or dataset from which it was read
    origin: Origin = UNSTATED  # Origin as the file states it
    instruction: str = ""  # Task text of the recording; empty if it has none
    start_ns: int = 0  # Time of row 0 on the recording's clock [ns]
    repeat_of: str | None = (
        None  # Name of the measurement whose commands this one repeats; None if it is no repeat
    )
    held: bool = False
    """True: models of law torque are held near the measured position, since no recording repeats another: replays would drift."""
    pressed: PressedObject | None = None
    """Known object between the fingers of one arm, if stated; the arm's pads are compared with the twin's for it."""
    time_error_s: float = 0.0
    """Largest time by which a row's position and target may differ from its time [s] (rows of a dataset show the last sample)."""
    timing: tuple[
        ChannelTiming, ...
    ] = ()  # Timing of each channel's samples; empty for tables
    registers: tuple[UnsignedColumn, ...] = ()
    """Columns that may hold registers logged without their sign."""
    findings: tuple[Finding, ...] = ()  # Findings that were made while reading it

    def __post_init__(self) -> None:
        shape = (len(self.time_s), len(self.signals))
        for name in self.signals:
            plain_name(name, f"measurement {printable(self.name)}")
        for name in ("velocity", "effort"):
            if getattr(self, name).size == 0:
                object.__setattr__(self, name, np.full(shape, np.nan))
        if self.quantum.size == 0:
            object.__setattr__(self, "quantum", np.zeros(shape[1]))
        for name in ("target", "measured", "velocity", "effort", *self.extra_columns):
            found = getattr(self, name).shape
            if found != shape:
                raise TaccorlError(
                    f"measurement {self.name}: {name} is {found}, but times and signals require {shape}"
                )
        lengths = {
            len(self.units),
            len(self.target_kinds) or shape[1],
            len(set(self.signals)),
        }
        if lengths != {shape[1]} or self.quantum.shape != shape[1:]:
            other = f"units, quantum and names have other lengths than signals {self.signals}"
            raise TaccorlError(f"measurement {self.name}: {other}")
        for unit in (unit for unit in self.units if unit not in self.known_units):
            raise TaccorlError(
                f"measurement {self.name}: units are {' or '.join(self.known_units)}, not {unit!r}"
            )

    @property
    def extra_columns(self) -> list[str]:
        """Names of those fields among ``load``, ``torque_ff``, ``supply_v`` and ``enabled`` that this measurement has."""
        return [
            name
            for name in ("load", "torque_ff", "supply_v", "enabled")
            if getattr(self, name).size
        ]

    @property
    def columns(self) -> list[str]:
        """Names of the fields besides times that have an entry for each row, (T, …)."""
        return ["target", "measured", "velocity", "effort", *self.extra_columns]

    @property
    def num_rows(self) -> int:
        """T."""
        return len(self.time_s)

    @cached_property
    def period_s(self) -> float:
        """Median time between rows [s]."""
        return (
            float(np.median(np.diff(self.time_s)))
            if self.num_rows > 1
            else float("nan")
        )

    @property
    def rate_hz(self) -> float:
        """Row rate [Hz], rounded to a thousandth."""
        return round(1.0 / self.period_s, 3)

    def is_copy_of(self, other: "Measurement") -> bool:
        """Whether all numbers are the same, as of a copied file (or a simulation without noise): then it is no repeat."""
        names = ("time_s", "target", "measured", "velocity", "effort")
        pairs = [(getattr(self, name), getattr(other, name)) for name in names]
        if self.touch is not None and other.touch is not None:
            pairs.append((self.touch.counts, other.touch.counts))
        return all(np.array_equal(one, two, equal_nan=True) for one, two in pairs)

    def column(self, signal: str) -> int:
        """Index j of a signal in ``signals`` and in the columns of the arrays. Raises TaccorlError: there is no signal of that
        name."""
        if signal not in self.signals:
            raise TaccorlError(
                f"{self.name} has no signal {signal!r}; {nearest(signal, self.signals)}"
            )
        return self.signals.index(signal)

    def target_kind(self, signal: str) -> TargetKind:
        """Quantity that the target of a signal commands: position, velocity, torque, or effort (no target)."""
        return (
            self.target_kinds[self.column(signal)] if self.target_kinds else "position"
        )

    def known_load(self, signal: str) -> np.ndarray:
        """(T,) known external torque on a signal [N·m, N]; 0 if there is none."""
        return (
            self.load[:, self.column(signal)]
            if self.load.size
            else np.zeros(self.num_rows)
        )

    def twin_cannot_take(self, signal: str) -> str:
        """Text: data of a signal that the PiPER's twin cannot use, and the remedy; empty if there are none."""
        j = self.column(signal)
        if self.known_load(signal).any():
            return "a known load; remove the column"
        if self.torque_ff.size and self.torque_ff[:, j].any():
            return "a torque_ff of its own in each row; remove the column"
        if self.supply_v.size and np.isfinite(self.supply_v[:, j]).any():
            return "a supply voltage; remove supply_v"
        if self.enabled.size and not self.enabled[:, j].all():
            row = int(np.argmin(self.enabled[:, j]))
            return f"a motor that is off at {self.time_s[row]:.3f} s; cut the recording there"
        stated = next(
            (key for key in ("lever_m", "arm_kg") if signal in getattr(self, key)), ""
        )
        return stated and f"{stated}; remove it from measurements.yaml"

    def moved(self, signal: str) -> np.ndarray:
        """(T,) positions [rad, m] from which the motion of a signal is determined: the commanded positions, or the measured ones
        if the targets are velocities or torques."""
        return (
            self.target if self.target_kind(signal) == "position" else self.measured
        )[:, self.column(signal)]

    def only(self, signals: Sequence[str]) -> Self:
        """A copy of the measurement that has only these signals."""
        at = [self.column(signal) for signal in signals]
        names = ("target", "measured", "velocity", "effort", *self.extra_columns)
        return dataclasses.replace(
            self,
            **{name: getattr(self, name)[:, at] for name in names},
            quantum=self.quantum[at],
            signals=tuple(signals),
            units=tuple(self.units[j] for j in at),
            target_kinds=tuple(self.target_kinds[j] for j in at)
            if self.target_kinds
            else (),
        )

    def with_position_targets(self, positions: np.ndarray) -> Self:
        """The measurement with ``positions`` (T, J) as targets of those signals whose targets are no positions."""
        if not self.target_kinds:
            return self
        kept = np.array([kind == "position" for kind in self.target_kinds])
        return dataclasses.replace(
            self, target=np.where(kept, self.target, positions), target_kinds=()
        )

    def has_effort(self) -> np.ndarray:
        """(J,) bool: the signal's effort was recorded, and is not always 0."""
        return np.isfinite(self.effort).any(axis=0) & (
            np.nan_to_num(self.effort) != 0
        ).any(axis=0)

    def resampled(self, rate_hz: float) -> Self:
        """The measurement resampled to an even ``rate_hz`` by linear interpolation, which keeps the mean time of every command
        and position. Raises TaccorlError: there are less than two rows, or time does not increase."""
        if self.num_rows < 2 or (np.diff(self.time_s) <= 0).any():
            raise TaccorlError(
                f"{self.name}: its time does not increase: it cannot be resampled to {rate_hz:g} Hz"
            )
        time_s = (
            self.time_s[0]
            + np.arange(int((self.time_s[-1] - self.time_s[0]) * rate_hz + 1e-6) + 1)
            / rate_hz
        )
        columns = {
            name: np.apply_along_axis(
                lambda column: np.interp(time_s, self.time_s, column),
                0,
                getattr(self, name),
            )
            for name in self.columns
        }
        if self.enabled.size:
            columns["enabled"] = np.where(columns["enabled"] < 0.5, 0.0, 1.0)
        return dataclasses.replace(
            self, time_s=time_s, command_s=np.empty(0), **columns
        )

    def on_robot(self, rest: np.ndarray) -> "Measurement":
        """The measurement extended to all signals of the robot, in the order of actions: missing ones stay at ``rest`` (14,)
        [rad, m] and count as not measured. Raises TaccorlError: the robot lacks a signal, or has it in another unit."""
        for name, unit in zip(self.signals, self.units, strict=True):
            if name not in ROBOT.action_names:
                raise TaccorlError(
                    f"{self.name}: the PiPER has no signal {name!r}; give the file of another robot with --twin, or rename the "
                    f"signal in the columns file; {nearest(name, ROBOT.action_names)}"
                )
            if unit != unit_of(name):
                raise TaccorlError(
                    f"{self.name}: {name} is in {unit}, the robot's is in {unit_of(name)}"
                )
            if (kind := self.target_kind(name)) != "position":
                raise TaccorlError(
                    f"{self.name}: {name} is commanded by {kind}, the robot's joints by position"
                )
            if extra := self.twin_cannot_take(name):
                raise TaccorlError(
                    f"{self.name}: {name} has {extra}: the PiPER's twin cannot use this"
                )
        extra = dict.fromkeys(self.extra_columns, np.empty(0))
        plain = dataclasses.replace(self, **extra, target_kinds=())
        return plain.extended(
            dict(zip(ROBOT.action_names, ROBOT_UNITS, strict=True)), rest
        )

    def extended(
        self, units: Mapping[str, str], rest: Sequence[float] | np.ndarray
    ) -> Self:
        """The measurement extended to the signals ``units`` (signal → unit of its position), in their order: missing ones stay at
        ``rest`` [rad, m] and count as not measured."""
        at, names = [list(units).index(name) for name in self.signals], tuple(units)
        absent = {"load": 0.0, "torque_ff": 0.0, "enabled": 1.0}
        columns = ("measured", "velocity", "effort", *self.extra_columns)
        arrays = {
            name: np.full((self.num_rows, len(units)), absent.get(name, np.nan))
            for name in columns
        }
        arrays |= {"target": np.tile(np.asarray(rest, float), (self.num_rows, 1))}
        for name, values in arrays.items():
            values[:, at] = getattr(self, name)
        kinds = tuple(
            self.target_kind(name) if name in self.signals else "position"
            for name in names
        )
        quantum = np.zeros(len(units))
        quantum[at] = self.quantum
        more: dict[str, Any] = {
            "signals": names,
            "units": tuple(units.values()),
            "quantum": quantum,
        }
        return dataclasses.replace(
            self, **arrays, **more, target_kinds=kinds if self.target_kinds else ()
        )


def other_arm(signal: str) -> str:
    """Name of the other arm's signal: ``left_joint5`` → ``right_joint5``; a name without an arm is returned unchanged."""
    swap = {"left_": "right_", "right_": "left_"}
    return next(
        (
            new + signal.removeprefix(old)
            for old, new in swap.items()
            if signal.startswith(old)
        ),
        signal,
    )

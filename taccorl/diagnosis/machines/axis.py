"""One driven axis as a machine: ``kind: axis`` (``taccorl.alignment.machines.axis_file``)."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from scipy.signal import savgol_filter

from taccorl.alignment.checks.clock import beside_onsets, check_against_twin
from taccorl.alignment.checks.effort_time import LawFit, check_effort_time, law_of_all
from taccorl.alignment.checks.robot import beyond_effort, in_degrees, reversed_effort
from taccorl.alignment.checks.telemetry import least_motion
from taccorl.alignment.controller.drive_law import SHORTEST_STEP_S, with_gains
from taccorl.alignment.controller.joint_model import JointModel, JointResponse, with_more_lead, with_other_numbers
from taccorl.alignment.machines.axis_file import AxisConfig, DrivenAxis, axis_digest, axis_text, load_axis
from taccorl.alignment.measurements.folder import Measurements, Use
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.alignment.measurements.noise_floor import SignalFloor, noise_floor
from taccorl.data.finding import Finding as DataFinding
from taccorl.diagnosis.comparison.compare import traces_of
from taccorl.diagnosis.comparison.replays import Response
from taccorl.diagnosis.comparison.result import USES, Comparison, Kind
from taccorl.diagnosis.machines.machine import Addition, Counted, Drive, GainsAre, Machine, machines, numbers_of
from taccorl.diagnosis.problems.axis_problem import AxisProblem, axis_motion, simulated
from taccorl.errors import TaccorlError, nearest
from taccorl.sim.effects.effect import Effect
from taccorl.sim.twin_file import write_whole

SMOOTH_S = 0.05
"""Window of the quadratic whose second derivative is the measured acceleration [s]."""
INERTIA_OFF = 5.0
"""Ratio of the file's inertia to that in the recording from which on the file must be wrong."""
INERTIA_SURE = 0.6
"""Least correlation of acceleration with torque (less friction, damping, weight) at which the inertia is compared."""


@machines.register("axis")
@dataclass(frozen=True)
class Axis(Machine):
    """A single driven axis as a machine; the axis is its only part."""

    config: AxisConfig
    """Content of the axis file."""
    name: str
    """The file's stem."""
    part_word: ClassVar[str] = "axis"

    @classmethod
    def load(cls, path: Path) -> Self:
        return cls(load_axis(path), Path(path).stem)

    def save(self, path: Path) -> None:
        write_whole(path, axis_text(self.config))

    def digest(self) -> str:
        return axis_digest(self.config)

    @property
    def effects(self) -> tuple[str, ...]:
        return tuple(e.name for e in self.config.effects)

    def numbers(self, part: str) -> dict[str, tuple[float, str]]:
        c = self.config
        own = {"inertia": (c.inertia, "kg·m²"), **c.numbers}
        own |= {name: (getattr(c, name), "s") for name in ("target_late_s", "speed_late_s")}
        own |= {name: (getattr(c, name), "N·m") for name in ("weight_sin", "weight_cos")[c.unit == "m" :]}
        return {name: (value, c.scale.unit_of(unit)) for name, (value, unit) in own.items()} | numbers_of(c.made())

    @property
    def units(self) -> Mapping[str, str]:
        return {self.config.name: self.config.unit}

    def check(self, measurements: Measurements) -> dict[str, list[DataFinding]]:
        """Check recordings: positions and efforts beyond the limits, an impossible inertia, an effort of the wrong sign or time.
        Returns recording → findings."""
        found, config, file = {}, self.config, f"{self.name}.yaml"
        fit = law_of_all(config, [m for m in measurements.all if config.name in m.signals], config.name)
        for m in measurements.all:
            self._check_signal(m)
            wrong = [*_beyond_limits(config, m), *beyond_effort(config, m, config.name, file)]
            found[m.name] = wrong or _wrong_inertia(config, m, fit)
        stated = {config.name: config} if config.gains == "commanded" else {}
        every = [with_gains(m, stated) for m in measurements.all]
        whole = {m.name: config.inertia + axis_motion(config, m).mounted_kgm2 for m in every}
        check_effort_time(config, every, found, config.name, file, lambda m: whole[m.name])
        return found

    def parts(self, measurements: Measurements) -> tuple[str, ...]:
        name = self.config.name
        for m in measurements.fit:
            self._check_signal(m)
            q = m.measured[:, m.column(name)]
            if np.nanmax(q) - np.nanmin(q) > least_motion(m, name):
                return (name,)
        least = max(least_motion(m, name) for m in measurements.fit)
        raise TaccorlError(f"no fit recording moves {name} by more than {least:.2g} {self.config.unit}; record motions")

    def _check_signal(self, m: Measurement) -> None:
        if self.config.name not in m.signals:
            raise TaccorlError(
                f"{m.name} has no signal {self.config.name!r}, which its file names; {nearest(self.config.name, m.signals)}"
            )

    def _compared(self, measurements: Measurements, name: str, progress: Counted) -> Comparison:
        uses: list[tuple[Use, Measurement]] = [(use, m) for use in USES for m in getattr(measurements, use)]
        every = [m for _, m in uses]
        floors: dict[Kind, dict[str, SignalFloor]] = {kind: noise_floor(every, kind) for kind in ("position", "effort")}
        signal, traces, clock = self.config.name, [], {}
        for k, (use, m) in enumerate(uses):
            progress(m.name, k, len(uses))
            motion = axis_motion(self.config, m)
            answer = simulated(self.config, motion, [])
            own, reported = m.only([signal]), answer.reported[:, None]
            positions = own.with_position_targets(reported)
            is_held = self.config.law == "effort"  # at the measured position
            followed = np.full_like(reported, np.nan) if is_held else reported
            traces += traces_of(positions, use, Response(positions, "joint", followed, answer.effort[:, None]), floors)
            if self.config.target_kind == "position" and np.isfinite(motion.measured).any():
                floor = {signal: floors["position"][signal].value}
                uncertain = [signal] if self.config.law == "pwm" or self.config.gains == "fitted" else []
                model = JointModel(DrivenAxis(self.config))
                changed, rivals = partial(with_other_numbers, model, motion), partial(with_more_lead, model, motion)
                clock[m.name] = tuple(
                    check_against_twin(
                        own, reported, floor, uncertain, lambda _, f=changed: f(), lambda _, f=rivals: f()
                    )
                )
        progress("", len(uses), len(uses))
        if not traces:
            raise TaccorlError(f"{', '.join(m.name for m in every)}: nothing to compare: no position was measured")
        return Comparison(
            twin=name, effects=self.effects, traces=(*traces,), split=measurements.record(), clock=beside_onsets(clock)
        )

    @property
    def fitted_gains(self) -> tuple[str, ...]:
        return (self.config.name,) if self.config.gains == "fitted" else ()

    @property
    def effort_limits(self) -> Mapping[str, float]:
        return {} if self.config.effort_limit is None else {self.config.name: self.config.effort_limit}

    @property
    def command_rates(self) -> Mapping[str, float]:
        return {self.config.name: self.config.command_hz or 0.0} if self.config.law != "effort" else {}

    def drive(self, part: str) -> Drive:
        c = self.config
        return Drive(c.unit, c.limits, c.effort_limit, c.target_kind, c.law != "pwm")

    def answer(self, part: str, m: Measurement) -> JointResponse:
        return simulated(self.config, axis_motion(self.config, m), [])

    def problem(self, part: str, measurements: Measurements, gains: GainsAre) -> AxisProblem:
        if gains == "fitted":
            raise TaccorlError(f"--gains=fitted: write `gains: fitted` into {self.name}.yaml and remove --gains")
        return AxisProblem(self.config, measurements)

    def effect(
        self, name: str, part: str, values: Mapping[str, Any], base: Mapping[str, float] | None = None
    ) -> Effect | None:
        cls = self.config.effect_class(name)
        if cls is None:
            return None
        known = [*(p.name for p in cls.parameters()), "interval", "evidence"]
        for key in values:
            if key not in (*known, "arm", "joints"):
                raise TaccorlError(f"effect {name}: no parameter {key!r}; {nearest(key, known)}")
        return cls(**{key: value for key, value in values.items() if key in known})

    def with_additions(self, additions: Sequence[Addition]) -> "Axis":
        config = self.config
        for a in additions:
            timing = {"loop_s": 0.0} if a.base.get("loop_s", 0.0) < SHORTEST_STEP_S else {}  # faster than a step
            config = config.with_numbers({**a.base, **timing}).with_effects(a.effects)
        return dataclasses.replace(self, config=config)


def _beyond_limits(axis: AxisConfig, m: Measurement) -> list[DataFinding]:
    if axis.limits is None:
        return []
    q, (low, high) = m.measured[:, m.column(axis.name)], axis.limits
    beyond = np.nan_to_num(np.maximum(q - high, low - q), nan=-1.0)
    rows = np.flatnonzero(beyond > 0.02 * (high - low))
    if not len(rows):
        return []
    row = int(rows[np.argmax(beyond[rows])])
    text = (
        f"{axis.name} is at {q[row]:.4g} {axis.unit} at {m.time_s[row]:.3f} s, its limits are [{low:g}, {high:g}]; if the column "
        f"is in another unit or offset, write its `unit:` (deg, mm …) and `factor:` in a columns file, else write "
        f"`limits: [{min(low, float(np.nanmin(q))):.4g}, {max(high, float(np.nanmax(q))):.4g}]`"
    )
    return [DataFinding("beyond_limits", "error", axis.name, text, (row, row + 1))]


def _wrong_inertia(axis: AxisConfig, m: Measurement, fit: LawFit | None) -> list[DataFinding]:
    """The inertia by least squares: effort on acceleration, velocity, its sign, position's sine and cosine, a constant."""
    j = m.column(axis.name)
    q, torque = m.measured[:, j], m.effort[:, j]
    if not m.has_effort()[j] or not np.isfinite([q, torque]).all() or (m.enabled.size and not m.enabled[:, j].all()):
        return []
    rows = max(5, 2 * round(0.5 * SMOOTH_S * m.rate_hz) + 1)
    if m.num_rows < 4 * rows:
        return []
    v, a = (savgol_filter(q, rows, 2, deriv=d, delta=m.period_s) for d in (1, 2))
    around = np.column_stack([v, np.sign(v), np.sin(q), np.cos(q), np.ones_like(q), m.known_load(axis.name)])
    left = [x - around @ np.linalg.lstsq(around, x, rcond=None)[0] for x in (a, savgol_filter(torque, rows, 2))]
    size = float(np.linalg.norm(left[0]) * np.linalg.norm(left[1]))
    alike = float(left[0] @ left[1]) / size if size > 0 else 0.0
    against = math.sqrt(1.0 - alike**2) if alike < 0.0 else 1.0
    if (reversed_ := reversed_effort(m, axis.name, against, fit)) or alike < INERTIA_SURE:
        return reversed_
    inertia = float(left[0] @ left[1]) / float(left[0] @ left[0])
    ratio = inertia / (axis.inertia + (mounted := axis_motion(axis, m).mounted_kgm2))
    if 1 / INERTIA_OFF <= ratio <= INERTIA_OFF:
        return []
    degrees = in_degrees(ratio, axis.name, axis.unit)
    text = (
        f"effort and acceleration of {axis.name} say {inertia:.3g} {axis.scale.unit_of('kg·m²')}, its file "
        f"{inertia / ratio:.3g}: {ratio:.2g} times.{degrees}{' Else write' if degrees else ' Write'} `inertia: "
        f"{max(inertia - mounted, 1e-3 * inertia):.3g}`, or the right unit or factor of q and tau in a columns file"
    )
    return [DataFinding("wrong_inertia", "error", axis.name, text)]

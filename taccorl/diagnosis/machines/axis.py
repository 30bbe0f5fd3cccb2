"""One driven axis as a machine: ``kind: axis`` (``taccorl.alignment.machines.axis_file``)."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np

from taccorl.alignment.checks.effort_time import check_effort_time, law_of_all
from taccorl.alignment.checks.robot import (
    beyond_effort,
    beyond_limits,
    in_degrees,
    wrong_inertia,
)
from taccorl.alignment.checks.telemetry import least_motion
from taccorl.alignment.controller.drive_law import with_gains
from taccorl.alignment.controller.joint_model import JointModel, JointResponse
from taccorl.alignment.controller.joint_motion import JointMotion
from taccorl.alignment.machines.axis_file import (
    AxisConfig,
    DrivenAxis,
    axis_digest,
    axis_text,
    load_axis,
)
from taccorl.alignment.measurements.folder import Measurements
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.data.finding import Finding as DataFinding
from taccorl.diagnosis.comparison.compare import compare_joints
from taccorl.diagnosis.comparison.result import Comparison
from taccorl.diagnosis.machines.machine import (
    Addition,
    Counted,
    Drive,
    GainsAre,
    Machine,
    machines,
    numbers_of,
)
from taccorl.diagnosis.problems.axis_problem import AxisProblem, axis_motion, simulated
from taccorl.errors import TaccorlError, nearest
from taccorl.sim.effects.effect import Effect
from taccorl.sim.twin_file import write_whole


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
        own |= {
            name: (getattr(c, name), "s") for name in ("target_late_s", "speed_late_s")
        }
        own |= {
            name: (getattr(c, name), "N·m")
            for name in ("weight_sin", "weight_cos")[c.unit == "m" :]
        }
        return {
            name: (value, c.scale.unit_of(unit)) for name, (value, unit) in own.items()
        } | numbers_of(c.made())

    @property
    def units(self) -> Mapping[str, str]:
        return {self.config.name: self.config.unit}

    def check(self, measurements: Measurements) -> dict[str, list[DataFinding]]:
        """Check recordings: positions and efforts beyond the limits, an impossible inertia, an effort of the wrong sign or time.
        Returns recording → findings."""
        found, config, file, model = (
            {},
            self.config,
            f"{self.name}.yaml",
            JointModel(DrivenAxis(self.config)),
        )
        fit = law_of_all(
            config,
            [m for m in measurements.all if config.name in m.signals],
            config.name,
        )
        for m in measurements.all:
            self._check_signal(m)
            wrong = beyond_limits(m, config.name, config.limits, file) + beyond_effort(
                config, m, config.name, file
            )
            found[m.name] = wrong or wrong_inertia(
                model, m, fit, partial(_inertia_words, config)
            )
        stated = {config.name: config} if config.gains == "commanded" else {}
        every = [with_gains(m, stated) for m in measurements.all]
        whole = {
            m.name: config.inertia + axis_motion(config, m).mounted_kgm2 for m in every
        }
        check_effort_time(
            config, every, found, config.name, file, lambda m: whole[m.name]
        )
        return found

    def parts(self, measurements: Measurements) -> tuple[str, ...]:
        name = self.config.name
        for m in measurements.fit:
            self._check_signal(m)
            q = m.measured[:, m.column(name)]
            if np.nanmax(q) - np.nanmin(q) > least_motion(m, name):
                return (name,)
        least = max(least_motion(m, name) for m in measurements.fit)
        raise TaccorlError(
            f"no fit recording moves {name} by more than {least:.2g} {self.config.unit}; record motions"
        )

    def _check_signal(self, m: Measurement) -> None:
        if self.config.name not in m.signals:
            raise TaccorlError(
                f"{m.name} has no signal {self.config.name!r}, which its file names; {nearest(self.config.name, m.signals)}"
            )

    def _compared(
        self, measurements: Measurements, name: str, progress: Counted
    ) -> Comparison:
        c = self.config
        return compare_joints(
            DrivenAxis(c),
            {c.name: c},
            measurements,
            lambda m: m.only([c.name]),
            name=name,
            file=f"{self.name}.yaml",
            effects=self.effects,
            uncertain=[c.name] * (c.law == "pwm" or c.gains == "fitted"),
            by_motion=False,
            progress=progress,
        )

    @property
    def fitted_gains(self) -> tuple[str, ...]:
        return (self.config.name,) if self.config.gains == "fitted" else ()

    @property
    def effort_limits(self) -> Mapping[str, float]:
        return (
            {}
            if self.config.effort_limit is None
            else {self.config.name: self.config.effort_limit}
        )

    @property
    def command_rates(self) -> Mapping[str, float]:
        return (
            {self.config.name: self.config.command_hz or 0.0}
            if self.config.law != "effort"
            else {}
        )

    def drive(self, part: str) -> Drive:
        c = self.config
        return Drive(c.unit, c.limits, c.effort_limit, c.target_kind, c.law != "pwm")

    def answer(self, part: str, m: Measurement) -> JointResponse:
        return simulated(self.config, axis_motion(self.config, m), [])

    def problem(
        self, part: str, measurements: Measurements, gains: GainsAre
    ) -> AxisProblem:
        if gains == "fitted":
            raise TaccorlError(
                f"--gains=fitted: write `gains: fitted` into {self.name}.yaml and remove --gains"
            )
        return AxisProblem(self.config, measurements)

    def effect(self, name: str, part: str, values: Mapping[str, Any]) -> Effect | None:
        cls = self.config.effect_class(name)
        if cls is None:
            return None
        known = [*(p.name for p in cls.parameters()), "interval", "evidence"]
        for key in values:
            if key not in (*known, "arm", "joints"):
                raise TaccorlError(
                    f"effect {name}: no parameter {key!r}; {nearest(key, known)}"
                )
        return cls(**{key: value for key, value in values.items() if key in known})

    def with_additions(self, additions: Sequence[Addition]) -> "Axis":
        config = self.config
        for a in additions:
            config = config.with_numbers(a.base).with_effects(a.effects)
        return dataclasses.replace(self, config=config)


def _inertia_words(
    axis: AxisConfig, motion: JointMotion, seen: float, known: float
) -> str:
    degrees = in_degrees(seen / known, axis.name, axis.unit)
    return (
        f"effort and acceleration of {axis.name} say {seen:.3g} {axis.scale.unit_of('kg·m²')}, its file {known:.3g}: "
        f"{seen / known:.2g} times.{degrees}{' Else write' if degrees else ' Write'} `inertia: "
        f"{max(seen - motion.mounted_kgm2, 1e-3 * seen):.3g}`, or the right unit or factor of q and tau in a columns file"
    )

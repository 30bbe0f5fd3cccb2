"""A driven axis that is not one of the robot's joints, as a problem for the search: a slide on a bench, a motor with a mass.

It is described in a file of its own (``configs/diagnose/emps.yaml`` is one)::

    name: drive                # the signal in the measurements
    unit: m                    # of its position: rad or m
    inertia: 100.0             # kg, or kg·m²: where the fit starts
    kp: 1.37e6                 # of the commanded law τ = kp (q* − q) − kd q̇ + torque_ff, N/m or N·m/rad
    kd: 8560.0
    force_unit_n: 10.0         # effects know their bounds for a small arm in N·m and rad; the axis is searched in
    length_unit_m: 0.25        # these units, in which its forces and ways are of that size, and told in its own

Angle and torque stand for position and force where the unit is m. Inertia is fitted; so are the gains, within ``GAINS_WITHIN`` of
those commanded, where the effort was recorded, which tells them. A few per cent of them outweigh the friction of a fast drive.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from taccorl.alignment.joint_model import Gains, JointModel, JointMotion, joint_motion
from taccorl.alignment.measurement import Measurement
from taccorl.alignment.measurements import Measurements
from taccorl.alignment.noise_floor import noise_floor
from taccorl.data.strict_yaml import Document
from taccorl.diagnosis.problem import Candidate, Free, Recording, Values, candidate
from taccorl.errors import TaccorlError
from taccorl.sim.effects import effects as registry
from taccorl.sim.effects.effect import Effect, JointEffect
from taccorl.sim.settings import check_numbers

_POWERS = {  # of force unit and length unit in each unit of a parameter
    "N·m": (1, 0),
    "rad": (0, 1),
    "rad/s": (0, 1),
    "N·m/rad": (1, -1),
    "N·m·s/rad": (1, -1),
    "N·m·s²/rad²": (1, -2),
    "kg·m²": (1, -1),
    "rad/(N·m)": (-1, 1),
}
"""Units that are not here (1, s, 1/s …) are the same on every axis."""
_SLIDE = {"N·m": "N", "rad": "m", "kg·m²": "kg"}
GAINS_WITHIN = 1.25
"""Factor to both sides."""


@dataclass(kw_only=True)
class AxisConfig:
    """One driven axis."""

    name: str
    unit: Literal["rad", "m"]
    inertia: float
    """kg·m² or kg."""
    kp: float
    """N·m/rad or N/m."""
    kd: float
    """N·m·s/rad or N·s/m."""
    torque_ff: float = 0.0
    """N·m or N."""
    force_unit_n: float = 1.0
    """N·m or N that are one unit of force in the search."""
    length_unit_m: float = 1.0
    """rad or m that are one unit of length in the search."""
    timestep_s: float = 1.0 / 1200.0

    def __post_init__(self) -> None:
        positive = ("inertia", "kp", "force_unit_n", "length_unit_m", "timestep_s")
        check_numbers("axis", self, positive=positive, not_negative=("kd",), finite=("torque_ff",))

    def factor(self, unit: str) -> float:
        """Number in the axis's units / number in the search's."""
        force, length = _POWERS.get(unit, (0, 0))
        return self.force_unit_n**force * self.length_unit_m**length

    def unit_of(self, unit: str) -> str:
        """How a parameter's unit is called on this axis: of a slide N for N·m, m for rad."""
        if self.unit == "m":
            for angular, linear in _SLIDE.items():
                unit = unit.replace(angular, linear)
        return unit.replace("(N)", "N")


def load_axis(path: Path) -> AxisConfig:
    """An axis's file.

    Raises:
        TaccorlError: with file and line.
    """
    return Document(AxisConfig, path).value


class AxisProblem:
    """An axis and recordings of it. Channels: position, and effort where it was recorded.

    Raises:
        TaccorlError: the recordings lack the axis, or have it in another unit.
    """

    def __init__(self, axis: AxisConfig, measurements: Measurements) -> None:
        self.axis, self.signal = axis, axis.name
        force, length = axis.force_unit_n, axis.length_unit_m
        stiffness = length / force
        self.gains = Gains(axis.kp * stiffness, axis.kd * stiffness, axis.torque_ff / force)
        sides = [
            [self._scaled(m) for m in side] for side in (measurements.fit, measurements.validation, measurements.test)
        ]
        everything = [m for side in sides for m in side]
        self.effort = all(m.has_effort()[m.column(axis.name)] for m in everything)
        kinds = ("position", "effort") if self.effort else ("position",)
        own = measurements.all
        self.floors = [noise_floor(own, kind)[axis.name] for kind in kinds]
        """In the axis's units."""
        inertia = axis.inertia * stiffness
        self.base = (
            Free(name="inertia", unit="kg·m²", start=inertia, low=1e-2 * inertia, high=1e2 * inertia, log=True),
            Free(name="torque_ff", unit="N·m", start=self.gains.torque_ff, low=-20.0, high=20.0),
        )
        if self.effort:
            self.base += tuple(
                Free(name=name, unit=unit, start=at, low=at / GAINS_WITHIN, high=at * GAINS_WITHIN, log=True)
                for name, unit, at in (("kp", "N·m/rad", self.gains.kp), ("kd", "N·m·s/rad", self.gains.kd))
            )
        self.fit, self.validation, self.test = ([self._recording(m) for m in side] for side in sides)
        self.candidates: dict[str, Candidate] = {}
        self.learn(self.gains._asdict() | {"inertia": inertia})
        self.start: Values = {f.name: f.start for f in self.base}
        self.present: tuple[str, ...] = ()

    def simulate(self, base: Mapping[str, float], effects: Sequence[Effect], recording: Recording) -> np.ndarray:
        """(T, C) position, and effort, in the search's units."""
        model = JointModel.axis(self.signal, base["inertia"], gains=self.gains, timestep_s=self.axis.timestep_s)
        answer = model.simulate(recording.data, self._gains(base), effects)
        return np.column_stack([answer.reported, answer.effort][: 1 + self.effort])

    def learn(self, values: Mapping[str, float]) -> None:
        """Starts of searches hang on the forces that the motor would give."""
        seen = self._seen(values)
        for name in registry:
            cls = registry.get(name)
            if not cls.fitted:
                continue
            found = candidate(cls, seen)
            knows = issubclass(cls, JointEffect) and found.make({f.name: f.start for f in found.frees}).drive()
            if knows and name != "armature":  # more inertia is the inertia, which is fitted
                self.candidates[name] = found

    def prepare(
        self, base: Mapping[str, float], effects: Sequence[Effect], recordings: Sequence[Recording]
    ) -> list[Effect]:
        """An axis has no maps."""
        return list(effects)

    def _gains(self, values: Mapping[str, float]) -> Gains:
        return self.gains._replace(**{name: values[name] for name in Gains._fields if name in values})

    def _scaled(self, m: Measurement) -> Measurement:
        j = m.column(self.signal)
        if m.units[j] != self.axis.unit:
            raise TaccorlError(f"{m.name}: {self.signal} is in {m.units[j]}, the axis's file says {self.axis.unit}")
        length, force = self.axis.length_unit_m, self.axis.force_unit_n
        return dataclasses.replace(
            m,
            target=m.target / length,
            measured=m.measured / length,
            velocity=m.velocity / length,
            effort=m.effort / force,
            quantum=m.quantum / length,
        )

    def _recording(self, m: Measurement) -> Recording:
        motion = joint_motion(m, None, self.signal)
        columns = [motion.measured, motion.effort][: 1 + self.effort]
        channels = (f"{self.signal} [{self.axis.unit}]", f"{self.signal} effort [{self.axis.unit_of('N·m')}]")
        return Recording(
            name=m.name,
            time_s=motion.time_s,
            measured=np.column_stack(columns),
            floor=np.array([f.value for f in self.floors])
            / [self.axis.length_unit_m, self.axis.force_unit_n][: 1 + self.effort],
            channels=channels[: 1 + self.effort],
            data=motion,
        )

    def _seen(self, values: Mapping[str, float]) -> dict[str, float]:
        motions: list[JointMotion] = [r.data for r in self.fit]
        model = JointModel.axis(self.signal, values["inertia"], gains=self.gains, timestep_s=self.axis.timestep_s)
        efforts = [np.abs(model.simulate(m, self._gains(values)).effort).max() for m in motions]
        speeds = np.concatenate([np.abs(np.gradient(m.target, 1.0 / m.rate_hz)) for m in motions])
        return {
            "peak_torque_nm": float(max(efforts)),
            "peak_speed_rad_per_s": float(speeds.max()),
            "span_rad": float(max(np.ptp(m.target) for m in motions)),
            "lowest_rad": min(float(np.nanmin(m.measured)) for m in motions),
            "highest_rad": max(float(np.nanmax(m.measured)) for m in motions),
            "duration_s": float(max(m.time_s[-1] for m in motions)),
        }

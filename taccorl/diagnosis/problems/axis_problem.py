"""Identification of one driven axis: its fitted numbers, candidate effects and recordings, as the search for missing effects
needs them. An axis is a slide on a bench, a motor with a mass, a servo with a pendulum.

Inertia and a constant torque are always fitted, and the weight if the file states one, or efforts show that of a slide. If the
effort was recorded, the gains are also fitted, within ``GAINS_WITHIN`` of the commanded ones, because an error of a few per
cent outweighs the friction of a fast drive. They stay, and so do the delays, if the recorded efforts are those of the file's
law, row by row, to the noise floor: a fit would use them for what the joint lacks. Unknown gains (``gains: fitted``) are fitted
within ``UNKNOWN_WITHIN``; without efforts the inertia then stays as the file states it, because positions determine ratios
only. For law ``pwm`` stall torque and back-EMF are fitted instead, within ``WINDING_WITHIN``, the accuracy of data sheets;
without efforts a supply, resistance or torque constant that explains as much alone is named instead (``of_file``). The delay of
targets is fitted up to ``TIMING_S``, since a cycle of the drive's loop is visible in the data. Unless both gains and
efforts are unknown, so is the delay of a speed that the drive filters, or the period of its loop where the file states no
``loop_hz``. The scale of efforts is fitted in place of the inertia where that decides.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

from taccorl.alignment.checks.effort_time import law_error
from taccorl.alignment.controller.drive_law import WINDING, WINDING_WITHIN
from taccorl.alignment.controller.joint_model import (
    GRAVITY_M_PER_S2,
    JointModel,
    JointResponse,
    Numbers,
    simulate_each,
)
from taccorl.alignment.controller.joint_motion import JointMotion
from taccorl.alignment.controller.joint_recording import motion_of
from taccorl.alignment.controller.lanes import LANES
from taccorl.alignment.machines.axis_file import AxisConfig, DrivenAxis
from taccorl.alignment.measurements.folder import Measurements
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.diagnosis.comparison.regimes import with_regimes
from taccorl.diagnosis.problems.joint_problem import (
    EFFORT_SCALE,
    LOOP,
    TORQUE_FF,
    floor_words,
    floors_of,
    measured_part,
    other_gain,
    recording_of,
    seen_in,
    unexplained,
    unlike_rows,
    whole_rows,
)
from taccorl.diagnosis.problems.position_waves import position_waves
from taccorl.diagnosis.search.identifiable import TIMING_S
from taccorl.diagnosis.search.problem import (
    Candidate,
    Case,
    Free,
    Recording,
    Values,
    WithoutMaps,
    candidate,
    holding,
)
from taccorl.errors import TaccorlError
from taccorl.sim.effects import effects as registry
from taccorl.sim.effects.effect import Effect
from taccorl.sim.effects.scaled import scaled

GAINS_WITHIN = 1.25
"""Factor within which commanded gains are fitted, to both sides."""
UNKNOWN_WITHIN = 10.0
"""The same for gains that nobody knows (``gains: fitted``)."""
FILTER_PERIODS = 2.0
"""Bound of the fitted delay of the speed, in periods of the drive's loop: a mean over five samples. A choice."""
WEIGHT_WITHIN = 3.0
"""Bound of the fitted weight's torque as a multiple of the file's, for both signs."""
MOST_TORQUE = 20.0
"""Bound of the constant torque [force units of the axis]."""
_NO_CANDIDATES = ("armature", "gravity_mismatch")
"""More inertia is the inertia, which is fitted; an axis carries no weight by itself."""


class AxisProblem(WithoutMaps):
    """Search problem of an axis. Channels: position, and effort if every recording has it, in the units of the axis. Raises
    TaccorlError as ``axis_motion``."""

    at_once = LANES

    def __init__(self, axis: AxisConfig, measurements: Measurements) -> None:
        self.axis, self.signal = axis, axis.name
        own, self._answers = axis.made(), {}
        self.present = tuple(e.name for e in own)
        self._bare = dataclasses.replace(axis, effects=(), known=())
        everything = measurements.all
        self.effort = all(m.has_effort()[m.column(axis.name)] for m in everything)
        kinds = ("position", "effort") if self.effort else ("position",)
        self._kinds: tuple[Literal["position", "effort"], ...] = (
            ("effort",) if axis.law == "effort" else kinds
        )
        left = [
            unexplained(JointModel(DrivenAxis(axis)), m)
            for m in everything
            if axis.law == "effort"
        ]
        self.floors = floors_of(
            everything, axis.name, effort=self.effort, unexplained=left
        )[-len(self._kinds) :]
        self.floor_values = np.array([f.value for f in self.floors])
        if (
            self.effort
            and self.floors[0].lower_bound
            and axis.law in ("impedance", "cascade")
        ):
            # Without repeats an encoder's resolution is no floor: the loop answers an error of the force by one of the position.
            self.floor_values[0] = max(
                self.floor_values[0], self.floor_values[1] / axis.loop_gains.kp
            )
        sides = (measurements.fit, measurements.validation, measurements.test)
        recordings = [[self._recording(m) for m in side] for side in sides]
        self.fit, self.validation, self.test = with_regimes(
            recordings, everything, self.floors[0]
        )
        self.known, self.loop_s = (
            axis.known,
            unlike_rows(2.0 * DrivenAxis(axis).position_age_s, everything),
        )
        self.law_error = math.inf
        if axis.gains == "commanded" and axis.loop_hz and self.effort:
            age_s, used = (
                DrivenAxis(axis).speed_delay_s,
                (*measurements.fit, *measurements.validation),
            )
            self.law_error = (
                max(law_error(axis, m, axis.name, age_s) for m in used)
                / self.floors[-1].value
            )
        self._stated = {
            f"{e.name}.{p.name}": getattr(e, p.name)
            for e in own
            for p in e.parameters()
        }
        base = (
            *self._numbers(),
            *[dataclasses.replace(EFFORT_SCALE, held=True)] * self.effort,
        )
        self.start: Values = {f.name: f.start for f in base} | self._stated
        self.base = holding(base, self.known, self.start)
        alone = (
            axis.law == "impedance" and axis.gains == "commanded" and not self.effort
        )
        if alone and axis.kd and "kd" not in axis.known:
            self.other_gain: Free | None = other_gain(
                axis.loop_gains.kd, axis.scale.unit_of("N·m·s/rad")
            )
        if (
            axis.law == "pwm"
            and not self.effort
            and not {"stall_nm", "back_emf"} & {*axis.known}
        ):
            self.of_file = tuple(
                Free(
                    name=n,
                    unit=unit,
                    start=at,
                    low=at / WINDING_WITHIN,
                    high=at * WINDING_WITHIN,
                    log=True,
                )
                for n, (at, unit) in axis.numbers.items()
                if n in WINDING and n not in axis.known
            )
        self.candidates: dict[str, Candidate] = {}
        self.learn(self.start)

    @property
    def noise(self) -> str:
        """Text of the noise floors: of the position, and of the effort if it is a channel."""
        return floor_words(self.floors)

    @property
    def numbers(self) -> str:
        """Text that states which numbers are always fitted, and from where the other numbers are taken."""
        names = [
            f.name for f in self.base if not (f.held or {*f.unless} & {*self.present})
        ]
        stated = self.axis.gains == "commanded" and self.axis.law != "pwm"
        near = (
            f" (kp and kd within a factor of {GAINS_WITHIN:g} of the stated ones)"
            * (stated and "kp" in names)
        )
        if self.law_error <= 1.0:
            near = f"; gains and times of the drive stay: efforts are its law's, to {self.law_error:.2g} noise floors"
        known = f" (known: {', '.join(self.known)})" * bool(self.known)
        return f"fitted: {', '.join(names)}{near}; other numbers as the file states them{known}"

    @property
    def measured(self) -> str:
        """Text that names the channels whose errors are minimised and reported, such as positions."""
        return " and ".join(f"{kind}s" for kind in self._kinds) + " together" * (
            len(self._kinds) > 1
        )

    def simulate_all(
        self, cases: Sequence[Case], recordings: Sequence[Recording]
    ) -> list[list[np.ndarray]]:
        """For each recording and case (T, C) simulated position [rad, m] and effort [N·m, N]; of law effort the effort alone. NaN
        after the last measured row. ``cases``: fitted numbers, and effects besides those of the file that are not fitted."""
        models = [
            JointModel(DrivenAxis(self._bare.with_numbers(base), self._bare))
            for base, _ in cases
        ]
        scales = [base.get(EFFORT_SCALE.name, 1.0) for base, _ in cases]
        numbers = [
            Numbers(
                m.gains, own, waits_s=base.get("loop_waits_s", 0.0), effort_scale=by
            )
            for m, (base, own), by in zip(models, cases, scales, strict=True)
        ]
        motions = [measured_part(recording) for recording in recordings]
        channels = slice(self._kinds[0] == "effort", 1 + self.effort)
        return [
            [
                whole_rows([a.reported, scale * a.effort][channels], r)
                for a, scale in zip(those, scales, strict=True)
            ]
            for those, r in zip(
                simulate_each(models, motions, numbers, self._answers),
                recordings,
                strict=True,
            )
        ]

    def learn(self, values: Mapping[str, float]) -> None:
        """Update the start values of effects, which depend on the forces of the motor."""
        seen = self._seen(values)
        for name in registry:
            if not registry.get(name).fitted or name in _NO_CANDIDATES:
                continue
            if self.law_error <= 1.0 and registry.get(name).slot in (
                "command",
                "law",
            ):  # the drive is as stated
                continue
            if name == "unbalance" and self._weighed:  # which is fitted
                continue
            if "dry_friction" in registry.get(name).needs and name not in self.present:
                continue
            cls = self.axis.effect_class(name)
            if cls is not None:
                c = candidate(cls, seen)
                self.candidates[name] = dataclasses.replace(
                    c, frees=holding(c.frees, self.known, self._stated)
                )

    def _numbers(self) -> tuple[Free, ...]:
        axis, unit = self.axis, self.axis.scale.unit_of
        force, inertia = axis.scale.force, axis.inertia
        heavy = GRAVITY_M_PER_S2 * inertia * (axis.unit == "m")
        most = max(
            MOST_TORQUE * force, 10.0 * abs(axis.torque_ff), WEIGHT_WITHIN * heavy
        )
        unknown = axis.gains == "fitted"
        found = [
            Free(
                name="inertia",
                unit=unit("kg·m²"),
                start=inertia,
                low=1e-2 * inertia,
                high=1e2 * inertia,
                log=True,
            )
        ] * (self.effort or not unknown)
        at = axis.torque_ff
        found.append(
            dataclasses.replace(
                TORQUE_FF, unit=unit("N·m"), start=at, low=-most, high=most, scale=force
            )
        )
        if self._weighed:
            weight = max(float(np.hypot(axis.weight_sin, axis.weight_cos)), heavy)
            for name in ("weight_sin", "weight_cos")[axis.unit == "m" :]:
                most, at = WEIGHT_WITHIN * weight, getattr(axis, name)
                found.append(
                    Free(
                        name=name,
                        unit=unit("N·m"),
                        start=at,
                        low=-most,
                        high=most,
                        scale=0.1 * weight,
                    )
                )
        if self.law_error <= 1.0:
            return tuple(found)
        if axis.law == "pwm":
            within, numbers = (
                WINDING_WITHIN,
                {"stall_nm": axis.stall_nm, "back_emf": axis.back_emf},
            )
        elif (self.effort or unknown) and axis.law != "effort":
            within = UNKNOWN_WITHIN if unknown else GAINS_WITHIN
            numbers = {"kp": axis.loop_gains.kp, "kd": axis.loop_gains.kd}
        else:
            within, numbers = 1.0, {}
        if axis.target_kind == "position":
            at = axis.target_late_s
            late = Free(
                name="target_late_s",
                unit="s",
                start=at,
                low=0.0,
                high=max(TIMING_S, at),
                scale=1e-4,
            )
            found.append(dataclasses.replace(late, unless=("command_delay",)))
        if axis.kd and axis.law != "effort" and (self.effort or not unknown):
            at = axis.speed_late_s
            high = max(
                FILTER_PERIODS / (axis.loop_hz or math.inf),
                at,
                0.0 if self.effort else TIMING_S,
            )
            late = Free(
                name="speed_late_s",
                unit="s",
                start=at,
                low=min(at, 0.0),
                high=high,
                scale=1e-4,
            )
            found.append(late if axis.loop_hz else LOOP)
        units = {"stall_nm": "N·m", "kp": "N·m/rad"}
        found += [
            Free(
                name=n,
                unit=unit(units.get(n, "N·m·s/rad")),
                start=at,
                low=at / within,
                high=at * within,
                log=True,
            )
            for n, at in numbers.items()
            if at > 0.0
        ]
        return tuple(found)

    @property
    def _weighed(self) -> bool:
        """Whether the axis's own weight is fitted: the file states it, or efforts tell that of a slide from ``torque_ff``."""
        if self.axis.unit == "m":
            return self.effort and self.axis.law != "effort"
        return bool(self.axis.weight_sin or self.axis.weight_cos)

    def _recording(self, m: Measurement) -> Recording:
        return recording_of(
            m, self.signal, axis_motion(self.axis, m), self._kinds, self.floor_values
        )

    def _seen(self, values: Mapping[str, float]) -> dict[str, float]:
        motions: list[JointMotion] = [r.data for r in self.fit]
        bare = self._bare.with_numbers(values)
        inertias = [bare.inertia + m.mounted_kgm2 for m in motions]
        answers = [simulated(bare, m, []) for m in motions]
        position = self.axis.target_kind == "position"
        asked = [
            m.target if position else a.reported
            for m, a in zip(motions, answers, strict=True)
        ]
        drive = (
            {"drive_rad_per_nm": 1.0 / bare.loop_gains.kp}
            if bare.loop_gains.kp > 0.0
            else {}
        )
        scale = self.axis.scale
        cogging = scaled("cogging", scale)
        return (
            seen_in(motions, answers, asked)
            | drive
            | position_waves(motions, inertias, cogging, length=scale.wave)
        )


def axis_motion(axis: AxisConfig, m: Measurement) -> JointMotion:
    """Data of an axis from a recording, with the gains that it states. Raises TaccorlError: the recording lacks the axis, has it
    in another unit, or commands a quantity that its law does not use."""
    j = m.column(axis.name)
    if m.units[j] != axis.unit:
        raise TaccorlError(
            f"{m.name}: {axis.name} is in {m.units[j]}, but the axis file states {axis.unit}"
        )
    return motion_of(m, axis.name, DrivenAxis(axis))


def simulated(
    axis: AxisConfig, motion: JointMotion, effects: Sequence[Effect]
) -> JointResponse:
    """Simulated response of the axis to a recording's targets, with the file's effects and ``effects``, for each row."""
    model = JointModel(DrivenAxis(axis))
    return model.simulate(motion, model.gains, effects)

"""One joint as a problem for the search: its controller's numbers, candidate effects and
recordings. Channels are the angle, and the motor's effort if every recording has it. Free
numbers of a joint without a model are those of ``axis_numbers``.

Commanded gains that the recordings state stay fixed, because fitted gains can hide a missing
effect (on the knee of a Unitree Go2 the fit gave K_p 116 for a commanded 20; recordings of
iit-DLSLab/sim2real-robot-identification).
"""

import dataclasses
import math
from collections.abc import Collection, Mapping, Sequence
from functools import lru_cache
from typing import Literal

import numpy as np

from taccorl.alignment.checks.effort_time import law_error
from taccorl.alignment.checks.motion import plateau
from taccorl.alignment.controller.arm_joint import HasJoints, joint_of
from taccorl.alignment.controller.arm_joint import selectors as selectors
from taccorl.alignment.controller.drive_law import FOLLOWED, WINDING_WITHIN
from taccorl.alignment.controller.joint_kernel import LANES
from taccorl.alignment.controller.joint_model import (
    SAME_RATE,
    Answers,
    JointModel,
    JointResponse,
    Numbers,
    PayloadLever,
    simulate_each,
)
from taccorl.alignment.controller.joint_motion import JointMotion, first_rows
from taccorl.alignment.controller.joint_recording import motion_of
from taccorl.alignment.controller.rigid_joint import RigidJoint
from taccorl.alignment.machines.robot_joint import RobotJoint
from taccorl.alignment.measurements.folder import Measurements
from taccorl.alignment.measurements.measurement import UNITS, Measurement
from taccorl.alignment.measurements.noise_floor import (
    EXACT,
    SignalFloor,
    floors_by_motion,
    noise_floor,
)
from taccorl.diagnosis.comparison.regimes import with_regimes
from taccorl.diagnosis.problems.axis_numbers import (
    DRIVE_IS_STATED,
    GAINS_WITHIN,
    OF_DRIVE,
    axis_numbers,
    no_candidates,
    of_motor,
)
from taccorl.diagnosis.problems.position_waves import position_waves
from taccorl.diagnosis.search.identifiable import EARLY_S, TIMING_S
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
from taccorl.sim.effects.drive import SpeedDelay
from taccorl.sim.effects.effect import Effect
from taccorl.sim.effects.load import Cogging
from taccorl.sim.effects.scaled import Scale
from taccorl.sim.twin import TwinConfig

GainsAre = Literal["auto", "commanded", "fitted"]
"""Treatment of gains. ``auto``: commanded if every recording states K_p and K_d, else fitted."""
# Paper App. B.1.
KP = Free(name="kp", unit="N·m/rad", start=500.0, low=10.0, high=1e5, log=True)
"""K_p, if it is fitted, with the paper's bounds."""
KD = Free(name="kd", unit="N·m·s/rad", start=50.0, low=1.0, high=1e3, log=True)
"""K_d, if it is fitted, with the paper's bounds."""
TORQUE_FF = Free(
    name="torque_ff",
    unit="N·m",
    start=0.0,
    low=-40.0,
    high=40.0,
    unless=("integral_action", "position_integral"),
)
"""Bounds of the fitted T_ref [N·m], wider than the paper's ± 8: a stiff joint with an error of 10 mrad has 18. An integral,
which begins in balance, takes up any constant torque: beside it nothing determines T_ref."""
WIDER = 100.0
"""Factor by which the bounds of K_p and K_d extend below the paper's, which are for stiff position drives."""
_GAIN_LIKE = ("torque_scale", "direction_gain")
"""Effects that a search leaves out if K_p and K_d are fitted, because other gains have the same influence on the motion. For
``direction_gain`` this holds where weight keeps the torque at one sign. Their influence on gravity compensation is looked for as
``gravity_mismatch``."""
_NOT_ON_PIPER = ("position_integral", "presliding", "soft_friction", "unbalance")
"""Effects that are no candidates on the PiPER: the figures of docs/diagnosis.md were measured without them. Its loop is no
cascade, so that the first one is ``integral_action``."""
WEIGHS = 3.0
"""Least motion due to weight [noise floors of the angle, rms] at which it determines the scale of the torques. A choice."""
EFFORT_SCALE = Free(
    name="effort_scale", unit="1", start=1.0, low=0.1, high=10.0, log=True
)
"""Ratio of reported effort to torque, which differs between versions of PiPER firmware."""
SPEED_DELAY = Free(
    name="speed_delay_s",
    unit="s",
    start=0.0,
    low=0.0,
    high=TIMING_S,
    scale=1e-3,
    leaves=True,
)
"""τ of the effect speed_delay: how late a sampled loop damps the speed. It is fitted if something besides the inertia
determines the scale of the torques; otherwise a change of K_p is equivalent (``taccorl.diagnosis.search.identifiable``)."""
POSITION_AGE = Free(
    name="position_age_s", unit="s", start=0.0, low=-1e-3, high=TIMING_S, scale=1e-4
)
"""Age of the measured position when the drive's torque acts, beyond that of the loop. It is fitted with commanded gains if the
machine states it (``RigidJoint.exact_timing``); with fitted gains a change of K_d by −K_p a is equivalent."""
TARGET_LATE = Free(
    name="target_late_s",
    unit="s",
    start=0.0,
    low=-EARLY_S,
    high=0.0,
    scale=1e-4,
    leaves=True,
    unless=("command_delay", "sensor_delay"),
)
"""Delay from a target's row until it acts, below 0 as a rule of simulators: MuJoCo's semi-implicit steps answer to a force half a
step early. An early target is no other K_d: of 1 ms 20 noise floors of 0.02 mrad stay. A late one is the effect command_delay."""
LOOP = Free(
    name="loop_s",
    unit="s",
    start=0.0,
    low=0.0,
    high=2.0 * TIMING_S,
    scale=1e-4,
    leaves=True,
)
"""Period of the drive's loop, fitted in place of ``POSITION_AGE`` where the machine's file does not state it: the position is
half a period old when the torque acts, the effort as much older or newer, the speed half a period and ``SPEED_DELAY``."""
EFFORT_AGE = Free(
    name="effort_age_s", unit="s", start=0.0, low=0.0, high=TIMING_S, scale=1e-4
)
"""Age of the reported effort, which is never newer than the torque that acts, where the twin has no timing of the loop: at an
acceleration of 20 rad/s² a quarter of a millisecond makes 0.4 N·m of K_d = 88 N·m·s/rad, as a little ``torque_lag``,
``command_delay`` or ``velocity_feedforward`` would."""
PAYLOAD_PLACE = tuple(
    Free(name=name, unit="m", start=0.0, low=-0.05, high=0.05, scale=5e-3)
    for name in ("payload_sin_m", "payload_cos_m")
)
"""Bounds of s and c of ``PayloadLever`` [m], fitted if a fit recording holds a payload at an unstated place. A choice."""
MORE_ROWS = 4
"""Rows after the last measured one simulated, too: torques are interpolated to the next row, slopes at the end one-sided."""
OF_RECORDINGS = (EFFORT_SCALE.name, EFFORT_AGE.name, *(f.name for f in PAYLOAD_PLACE))
"""Always fitted numbers that describe recordings and are not stored in the twin."""


class JointProblem(WithoutMaps):
    """Search problem of a joint of the PiPER's twin, or of another machine.

    Args:
        signal: name of the joint, for the PiPER ``left_joint5``.
        gains: ``commanded`` gains stay fixed, or gains are ``fitted``; ``auto``: fixed if every recording states them.
        effort: whether the motor's effort is a second channel if every recording has it.
        held: effects that stay as the machine has them.

    Raises:
        TaccorlError: there is no such joint, commanded gains are not stated, or recordings cannot be used.
    """

    at_once = LANES

    def __init__(
        self,
        machine: TwinConfig | HasJoints,
        signal: str,
        measurements: Measurements,
        *,
        gains: GainsAre = "auto",
        effort: bool = True,
        held: Collection[str] = (),
    ) -> None:
        joint = joint_of(machine, signal)
        self._left_out = _NOT_ON_PIPER if isinstance(machine, TwinConfig) else ()
        whole = {
            use: tuple(map(joint.whole, getattr(measurements, use)))
            for use in ("fit", "validation", "test")
        }
        measurements = dataclasses.replace(measurements, **whole)
        everything = measurements.all
        silent = [
            m.name
            for m in everything
            if any(signal not in getattr(m, name) for name in joint.gain_names)
        ]
        if gains == "commanded" and silent:
            raise TaccorlError(
                f"{silent[0]}: the commanded gains of {signal} are not stated; write {' and '.join(joint.gain_names)} into its "
                "measurements.yaml, or fit them (gains=fitted)"
            )
        self.states_gains = not silent
        """True if every recording, or the file, states gains."""
        self.signal, self.commanded = (
            signal,
            not silent and (gains != "fitted" or not joint.gain_names),
        )
        own, bare = joint.freed(held)
        self.axis: RobotJoint | None = None
        """The joint, if it has no model: its body's numbers are fitted, too."""
        if isinstance(joint, RobotJoint) and not joint.has_model:
            self.axis = joint
            self.commanded = joint.config.gains == "commanded"
            if gains == "fitted" != joint.config.gains:
                raise TaccorlError(
                    f"--gains=fitted: write `gains: fitted` of {signal} into its file and "
                    "remove --gains"
                )
        self.known = joint.known_names
        self.loop_s = unlike_rows(joint.loop_s, everything)
        self._stated = {
            f"{effect.name}.{p.name}": getattr(effect, p.name)
            for effect in own
            for p in effect.parameters()
        }
        self.present = tuple(effect.name for effect in own)
        self.model, self._answers = JointModel(bare), Answers()
        self._speed_where = self.model.joint.selectors(SpeedDelay) or {}
        self.effort = effort and all(
            m.has_effort()[m.column(signal)] for m in everything
        )
        self._first = int(
            self.model.joint.target_kind == "effort"
        )  # then the position is the input, and no channel
        if self._first and not self.effort:
            raise TaccorlError(
                f"{signal}: law effort needs the effort of every recording"
            )
        left = [unexplained(self.model, m, own) for m in everything if self._first]
        self.floors = floors_of(
            everything, signal, effort=self.effort, unexplained=left
        )[self._first :]
        """Noise floors over all recordings; a recording whose motion was repeated has its own."""
        self._own_floors = [
            floors_by_motion(everything, f.kind, left) for f in self.floors
        ]
        self._least_floor = self._floor_of_loop()
        self.law_error = self._law_error(measurements)
        sides = (measurements.fit, measurements.validation, measurements.test)
        recordings = [[self._recording(m) for m in side] for side in sides]
        self.fit, self.validation, self.test = with_regimes(
            recordings, everything, self.floors[0]
        )
        self.base, kd = self._base(), self.model.gains.kd
        if self.axis is not None:
            self.of_file = of_motor(self.axis, self.effort, everything)
        alone = self.commanded and not (
            self.effort or joint.winding or joint.facts.get("commands_speed")
        )
        if (
            alone
            and joint.target_kind == "position"
            and kd > 0.0
            and "kd" not in self.known
        ):
            self.other_gain: Free | None = other_gain(
                kd, Scale(unit=joint.unit).unit_of(KD.unit)
            )
        self.candidates: dict[str, Candidate] = {}
        self.start: Values = (
            self.model.gains._asdict() | dict(joint.winding) | self._stated
        )
        if self.axis is not None:
            self.start = {f.name: f.start for f in self.base} | self._stated
        self.learn(self.start)
        if any(f.name == SPEED_DELAY.name for f in self.base):
            delays = (e for e in bare.effects([]) if isinstance(e, SpeedDelay))
            self.start[SPEED_DELAY.name] = sum(e.delay_s for e in delays)
        self.base = holding(
            self.base, self.known, {f.name: f.start for f in self.base} | self.start
        )

    @property
    def noise(self) -> str:
        """Text of the noise floors, with their units."""
        return floor_words(self.floors)

    @property
    def numbers(self) -> str:
        """Text that states which numbers are always fitted, and from where the other numbers are taken."""
        known = f"; known: {', '.join(self.known)}" * bool(self.known)
        if self.axis is not None:
            return self._axis_words() + known
        if self.model.joint.winding:
            return f"gains as the file states them, stall torque and back-EMF fitted{known}"
        if self._first:
            return f"driven by the recorded effort{known}"
        return (
            "commanded gains"
            if self.commanded
            else f"gains fitted ({'not those of the file' if self.states_gains else 'not stated by the recordings'})"
        ) + known

    @property
    def measured(self) -> str:
        """Text that names the channels whose errors are minimised and reported, such as positions."""
        positions = "angles" if self.axis is None else "positions"
        if self._first:
            return "efforts"
        return f"{positions} and efforts together" if self.effort else positions

    def _axis_words(self) -> str:
        present = {*self.present}
        free = [f for f in self.base if not f.held and not {*f.unless} & present]
        names = ", ".join(f.name for f in free)
        if self.law_error <= DRIVE_IS_STATED:
            return (
                f"fitted: {names}; gains and times of the drive stay: efforts are its "
                f"law's, to {self.law_error:.2g} noise floors"
            )
        near = ""
        if self.commanded and any(f.name == "kp" for f in free):
            near = (
                f" (kp and kd within a factor of {GAINS_WITHIN:g} of the stated ones)"
            )
        return f"fitted: {names}{near}; other numbers as the file states them"

    def _floor_of_loop(self) -> float:
        """Least floor of an axis's position. Without repeats an encoder's resolution is no
        floor: the loop answers an error of the force by one of the position."""
        axis = self.axis
        if axis is None or not self.effort or not self.floors[0].lower_bound:
            return 0.0
        if axis.config.law not in ("impedance", "cascade"):
            return 0.0
        return self.floors[-1].value / axis.config.loop_gains.kp

    def _law_error(self, measurements: Measurements) -> float:
        """Error of the file's law of an axis [noise floors of the effort]; inf if nothing
        determines it."""
        axis = self.axis
        if axis is None or not (axis.config.loop_hz and self.effort):
            return math.inf
        if axis.config.gains != "commanded":
            return math.inf
        used = (*measurements.fit, *measurements.validation)
        age_s = axis.speed_delay_s
        errors = [law_error(axis.config, m, self.signal, age_s) for m in used]
        return max(errors) / self.floors[-1].value

    @property
    def inertia_kgm2(self) -> float:
        """Inertia of the joint [kg·m²]: the least of the fit recordings, at which the loop's timing has most influence."""
        return min(self.model.inertia_kgm2(r.data) for r in self.fit)

    def pinned_by(self, names: Sequence[str]) -> tuple[str, ...]:
        """Facts that fix the scale of the torques while the effects ``names`` are fitted, as texts: "commanded gains", "commanded
        torques", "recorded effort", "known gains", "known weight". Empty: positions identify only ratios to K_p
        (``diagnosis.search.identifiable``)."""
        commanded = self.commanded and not self.model.joint.winding
        words = (
            "commanded gains" if self.model.joint.gain_names else "commanded torques"
        )
        found = [words] * commanded + ["recorded effort"] * (
            self.effort and not commanded
        )
        found += ["known gains"] * any(
            f.held for f in self.base if f.name in ("kp", "kd")
        )
        unknown = {"gravity_mismatch", "payload"} & {*names}
        if not unknown and self._weighs():
            found.append("known weight")
        return tuple(found)

    def _weight_shows(self, least_floors: float) -> bool:
        """Whether known weight that the controller holds moves the joint by more than so many noise floors."""
        weights = np.concatenate(
            [self.model.weight_nm(r.data, self._asked(r.data)) for r in self.fit]
        )
        level = self.floors[0].value * (1.0 if self._first else self.model.gains.kp)
        return float(np.std(weights)) > least_floors * level

    def _weighs(self) -> bool:
        """Whether that weight varies more than the torque J q̈ of the motion, which else decides."""
        if not self._weight_shows(WEIGHS):
            return False
        motions: list[JointMotion] = [r.data for r in self.fit]
        weights = np.concatenate(
            [self.model.weight_nm(m, self._asked(m)) for m in motions]
        )
        torques = []
        for m in motions:
            angle = self.model.simulate(m, self.model.gains).reported
            torques.append(
                self.model.inertia_kgm2(m)
                * np.gradient(np.gradient(angle, m.time_s), m.time_s)
            )
        return float(np.std(weights)) > float(np.std(np.concatenate(torques)))

    def simulate_all(
        self, cases: Sequence[Case], recordings: Sequence[Recording]
    ) -> list[list[np.ndarray]]:
        """For each recording and case (T, C) simulated position [rad, m] and, if effort is used, effort [N·m, N] as the driver
        would report it; with ``law: effort`` the effort alone. NaN after the last measured row. ``cases``: always fitted numbers,
        and effects in addition to those of the machine that are not fitted."""
        motions = [measured_part(recording) for recording in recordings]
        models = [self._model_of(base) for base, _ in cases]
        numbers = [
            self._numbers(*case, model.joint)
            for case, model in zip(cases, models, strict=True)
        ]
        answers = simulate_each(models, motions, numbers, self._answers)
        scales = [base.get(EFFORT_SCALE.name, 1.0) for base, _ in cases]
        channels = slice(self._first, 1 + self.effort)
        return [
            [
                whole_rows([a.reported, scale * a.effort][channels], r)
                for a, scale in zip(those, scales, strict=True)
            ]
            for those, r in zip(answers, recordings, strict=True)
        ]

    def _model_of(self, values: Mapping[str, float]) -> JointModel:
        if self.axis is None:
            return self.model
        return JointModel(self.model.joint.with_values(values))

    def _numbers(
        self, base: Mapping[str, float], effects: Sequence[Effect], joint: RigidJoint
    ) -> Numbers:
        scale, waits_s = base.get(EFFORT_SCALE.name, 1.0), base.get("loop_waits_s", 0.0)
        at = joint.target_late_s  # of an axis that of ``base``
        waits_s += base.get(TARGET_LATE.name, at) - at
        if self.axis is not None:
            return Numbers(joint.gains, effects, waits_s=waits_s, effort_scale=scale)
        lever, half_s = (
            PayloadLever(*(base.get(f.name, 0.0) for f in PAYLOAD_PLACE)),
            0.5 * base.get(LOOP.name, 0.0),
        )
        if SPEED_DELAY.name in base:
            # The earliest speed of a loop of the longest period is beyond the effect's range.
            delay_s = max(base[SPEED_DELAY.name] - half_s, -SPEED_DELAY.high)
            effects = [*effects, SpeedDelay(**self._speed_where, delay_s=delay_s)]
        stated_s, (gains, facts) = (
            self.model.joint.stated_age_s,
            self.model.joint.numbers(base),
        )
        age_s = base.get(POSITION_AGE.name, stated_s) - stated_s + half_s
        facts |= (
            {"effort_age": base[EFFORT_AGE.name]} if EFFORT_AGE.name in base else {}
        )
        if half_s:
            newer = 2.0 * bool(self.model.joint.facts["effort_after"])
            speed_age = (
                2.0 * half_s * bool(gains.kd)
            )  # what the position's age takes from K_d is of no speed
            facts |= {"effort_age": (1.0 - newer) * half_s, "speed_age": speed_age}
        return Numbers(gains, effects, lever, age_s, facts, waits_s, scale)

    def learn(self, values: Mapping[str, float]) -> None:
        """Update the start values of effects, which depend on the torques of the motor with these gains."""
        seen = self._seen(values)
        if self.axis is not None:
            self._left_out = no_candidates(self.axis, self.effort)
        for name in registry:
            cls = registry.get(name)
            if self.law_error <= DRIVE_IS_STATED and cls.slot in OF_DRIVE:
                continue
            if "dry_friction" in cls.needs and name not in self.present:
                continue
            where = (
                self.model.joint.selectors(cls)
                if cls.fitted and name not in self._left_out
                else None
            )
            scaled = self.commanded and not self.model.joint.winding
            scaled = scaled or self.axis is not None
            if where is not None and (scaled or name not in _GAIN_LIKE):
                c = candidate(self.model.joint.in_units(cls), seen, **where)
                frees = holding(c.frees, self.known, self._stated)
                self.candidates[name] = dataclasses.replace(c, frees=frees)

    def _asked(self, motion: JointMotion) -> np.ndarray:
        """(T,) targets; measured positions where targets are no positions."""
        if self.model.joint.target_kind == "position":
            return motion.target
        seen = np.isfinite(motion.measured)
        return np.interp(motion.time_s, motion.time_s[seen], motion.measured[seen])

    def _base(self) -> tuple[Free, ...]:
        kp, kd, torque_ff = self.model.gains
        found = [dataclasses.replace(TORQUE_FF, start=torque_ff)]
        joint = self.model.joint
        # A drive that measures its speed has it half a loop period earlier than one that computes it from two positions. The
        # lower bound is a little below that value, so that a fit to such a drive does not end at the bound. A loop below 200 Hz
        # would have a bound that no file may state. MuJoCo damps with the speed at the end of a step, half a step early; the
        # PiPER's twin has no such timing.
        early_s = max(joint.speed_delay_s, EARLY_S * joint.exact_timing)
        newest = max(-0.6 * early_s, -SPEED_DELAY.high)
        delay = dataclasses.replace(SPEED_DELAY, low=newest)
        units = Scale(unit=joint.unit)
        if self.axis is not None:
            held = [dataclasses.replace(EFFORT_SCALE, held=True)] if self.effort else []
            error, effort = self.law_error, self.effort
            table = axis_numbers(
                self.axis, TORQUE_FF, LOOP, effort=effort, law_error=error
            )
            return (*table, *held)
        scale = [dataclasses.replace(EFFORT_SCALE, held=True)] * (
            self.effort and not self._left_out
        )
        if joint.target_kind == "effort":
            return tuple(
                dataclasses.replace(f, unit=units.unit_of(f.unit))
                for f in [*found, *scale]
            )
        if self.commanded:
            aged = (
                joint.exact_timing and kp > 0.0 and not joint.winding
            )  # a back-EMF takes it up, as fitted gains do
            at = joint.stated_age_s
            aged_by = dataclasses.replace(
                POSITION_AGE, start=at, low=at + POSITION_AGE.low
            )
            age = (
                aged_by
                if joint.position_age_s or POSITION_AGE.name in self.known
                else LOOP
            )
            found += [EFFORT_SCALE] * self.effort + [delay] * (kd > 0.0) + [age] * aged
            found += [EFFORT_AGE] * (self.effort and not joint.exact_timing)
        elif not joint.winding:
            starts = {"kp": (KP, kp), "kd": (KD, max(kd, KD.low / WIDER))}
            gains = [_around(*starts[name]) for name in joint.gain_names]
            found = (
                gains
                + found
                + [delay] * (self.effort or self._weight_shows(1.0))
                + scale
            )
            untimed = self.effort and not joint.position_age_s
            found += [LOOP if joint.exact_timing else EFFORT_AGE] * untimed
        found += [_within(name, value) for name, value in joint.winding.items()]
        if joint.exact_timing and joint.target_kind == "position":
            at = joint.target_late_s
            found.append(dataclasses.replace(TARGET_LATE, start=at, high=max(at, 0.0)))
        payloads: list[JointMotion] = [
            r.data
            for r in self.fit
            if r.data.payload_kg > 0.0 and not r.data.payload_at_known
        ]
        found = [dataclasses.replace(f, unit=units.unit_of(f.unit)) for f in found]
        return (
            *found,
            *(PAYLOAD_PLACE if any(map(self.model.is_weighed, payloads)) else ()),
        )

    def _recording(self, m: Measurement) -> Recording:
        kinds, motion = (
            ("position", "effort"),
            motion_of(m, self.signal, self.model.joint),
        )
        floors = [own[m.name][self.signal].value for own in self._own_floors]
        floors[0] = max(floors[0], self._least_floor)
        return recording_of(
            m, self.signal, motion, kinds[self._first : 1 + self.effort], floors
        )

    def _seen(self, values: Mapping[str, float]) -> dict[str, float]:
        """Facts of the fit recordings on which starts of searches hang (``Effect.starts``)."""
        motions: list[JointMotion] = [r.data for r in self.fit]
        model = self._model_of(values)
        gains, facts = model.joint.numbers(values)
        position = model.joint.target_kind == "position"
        answers = [model.simulate(m, gains, facts=facts) for m in motions]
        drive = {}
        if self.axis is not None and gains.kp > 0.0:
            drive["drive_rad_per_nm"] = 1.0 / gains.kp
        motor_nm = [
            np.abs(model.motor_nm(m, a)).max()
            for m, a in zip(motions, answers, strict=True)
        ]
        asked = [
            self._asked(m) if position else a.reported
            for m, a in zip(motions, answers, strict=True)
        ]
        waves = self._position_waves(model, motions)
        return seen_in(motions, answers, asked) | {
            **drive,
            "peak_motor_nm": float(max(motor_nm)),
            "span_rad": float(np.ptp(np.concatenate(asked))),
            **waves,
        }

    def _position_waves(
        self, model: JointModel, motions: Sequence[JointMotion]
    ) -> dict[str, float]:
        joint = self.model.joint
        inertias = [model.inertia_kgm2(m) for m in motions]
        cogging = joint.in_units(Cogging)
        return position_waves(motions, inertias, cogging, length=joint.wave)


def floor_words(floors: Sequence[SignalFloor]) -> str:
    """Text of the noise floors of a joint or axis: of its position, and of its effort if that is a channel."""
    least = f", at least {EXACT:.1%} of its changes" * (len(floors) > 1)
    return "; effort ".join(f.words() for f in floors) + least


def seen_in(
    motions: Sequence[JointMotion],
    answers: Sequence[JointResponse],
    asked: Sequence[np.ndarray],
) -> dict[str, float]:
    """Scales of recordings, from which fits of effects begin. ``asked``: (T,) positions [rad, m] that each drive aims at."""
    speeds = [
        np.abs(np.gradient(q, 1.0 / m.rate_hz)).max()
        for q, m in zip(asked, motions, strict=True)
    ]
    measured = np.abs(np.concatenate([m.effort for m in motions]))
    return {
        **(
            {"peak_measured_nm": float(np.nanmax(measured))}
            if np.isfinite(measured).any()
            else {}
        ),
        "peak_torque_nm": max(float(np.abs(a.effort).max()) for a in answers),
        "peak_speed_rad_per_s": float(max(speeds)),
        "span_rad": max(float(np.ptp(q)) for q in asked),
        "lowest_rad": min(float(np.nanmin(m.measured)) for m in motions),
        "highest_rad": max(float(np.nanmax(m.measured)) for m in motions),
        "duration_s": max(float(m.time_s[-1]) for m in motions),
    }


def unexplained(
    model: JointModel, m: Measurement, own: Sequence[Effect] = ()
) -> Measurement:
    """``m`` with what ``model``, with the effects ``own``, leaves of the joint's effort."""
    motion, effort = motion_of(m, model.signal, model.joint), m.effort.astype(float)
    effort[:, m.column(model.signal)] -= (
        FOLLOWED * model.simulate(motion, model.gains, own).effort
    )
    return dataclasses.replace(m, effort=effort)


def recording_of(
    m: Measurement,
    signal: str,
    motion: JointMotion,
    kinds: Sequence[str],
    floors: Sequence[float] | np.ndarray,
) -> Recording:
    """Channels ``kinds`` of a joint, with their noise floors (C,). An effort at a limit has none of the noise of positions and
    speeds that a drive multiplies by its gains, which is most of its floor; a quarter is assumed at least, a choice."""
    unit, share = m.units[m.column(signal)], np.ones((m.num_rows, len(kinds)))
    columns = {"position": motion.measured, "effort": motion.effort}
    names = {
        "position": f"{signal} [{unit}]",
        "effort": f"{signal} effort [{UNITS[unit][1]}]",
    }
    if kinds[-1] == "effort":
        rows, _, sd = plateau(m, m.column(signal))
        share[rows, -1] = min(max(sd / floors[-1], 0.25), 1.0)
    return Recording(
        name=m.name,
        time_s=motion.time_s,
        measured=np.column_stack([columns[kind] for kind in kinds]),
        floor=np.array(floors),
        channels=tuple(names[kind] for kind in kinds),
        data=motion,
        share=share,
        setting=(
            motion.payload_kg,
            motion.moment_kgm,
            motion.mounted_kgm2,
            round(motion.kp_scale, 3),
            round(motion.kd_scale, 3),
        ),
    )


def other_gain(kd: float, unit: str) -> Free:
    """A stated K_d [``unit``], as ``Problem.other_gain``: of positions alone viscous friction is more of it."""
    return dataclasses.replace(KD, unit=unit, start=kd, low=0.1 * kd, high=10.0 * kd)


def unlike_rows(loop_s: float, recordings: Sequence[Measurement]) -> float:
    """``loop_s``, period of a drive's loop [s], if its rate is no multiple of the rows' of a recording; else 0."""
    counts = [1.0 / (m.rate_hz * loop_s) for m in recordings if loop_s > 0.0]
    return (
        loop_s
        if any(abs(n - max(round(n), 1)) > SAME_RATE * n for n in counts)
        else 0.0
    )


def _around(gain: Free, start: float) -> Free:
    """A gain with wider bounds, which hold its start."""
    low, high = (
        min(gain.low / WIDER, 0.1 * start),
        gain.high if start < gain.high else 10.0 * start,
    )
    return dataclasses.replace(gain, start=start, low=low, high=high)


def _within(name: str, value: float) -> Free:
    """A number of the winding about the one that the file states."""
    unit = "N·m" if name == "stall_nm" else "N·m·s/rad"
    return Free(
        name=name,
        unit=unit,
        start=value,
        low=value / WINDING_WITHIN,
        high=value * WINDING_WITHIN,
        log=True,
    )


def floors_of(
    measurements: Sequence[Measurement],
    signal: str,
    *,
    effort: bool,
    unexplained: Sequence[Measurement] = (),
) -> list[SignalFloor]:
    """Noise floors of one signal: of the position, and of the effort if ``effort`` is true, in this order.
    ``unexplained``: as for ``noise_floor``.

    Raises:
        TaccorlError: the joint was never measured.
    """
    found = []
    for kind in ("position", "effort")[: 1 + effort]:
        floors = noise_floor(measurements, kind, unexplained)
        if signal not in floors:
            raise TaccorlError(
                f"{signal}: its {kind} was not measured in any recording"
            )
        found.append(floors[signal])
    return found


@lru_cache(maxsize=64)
def measured_part(recording: Recording) -> JointMotion:
    """Motion of the recording, up to a few rows after the last measured one: a fit needs nothing after it."""
    seen = np.flatnonzero(np.isfinite(recording.measured).any(axis=1))
    return (
        first_rows(recording.data, int(seen[-1]) + 1 + MORE_ROWS)
        if len(seen)
        else recording.data
    )


def whole_rows(columns: Sequence[np.ndarray], recording: Recording) -> np.ndarray:
    """(T, C) ``columns`` of fewer rows side by side, and NaN below."""
    whole = np.full((len(recording.time_s), len(columns)), np.nan)
    for k, column in enumerate(columns):
        whole[: len(column), k] = column
    return whole

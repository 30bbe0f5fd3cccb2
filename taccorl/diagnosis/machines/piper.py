"""The PiPER's twin as a machine: two arms and their pads, described by a ``twin.yaml`` (``taccorl.sim.twin_file``)."""

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Self, cast

import numpy as np

from taccorl.alignment.checks.robot import pose_unknown
from taccorl.alignment.controller.joint_model import JointModel, JointResponse
from taccorl.alignment.controller.joint_recording import joint_motion
from taccorl.alignment.measurements.folder import Measurements
from taccorl.alignment.measurements.measurement import Measurement, unit_of
from taccorl.alignment.measurements.motions import TORQUE_NM, joint_number
from taccorl.alignment.measurements.pressed import PressedObject
from taccorl.alignment.touch.motion import lacking_pads
from taccorl.data.finding import Finding as DataFinding
from taccorl.diagnosis.comparison.compare import compare
from taccorl.diagnosis.comparison.result import Comparison
from taccorl.diagnosis.machines.changed_findings import remarked
from taccorl.diagnosis.machines.machine import (
    Addition,
    Counted,
    Diagnosed,
    Drive,
    Finding,
    GainsAre,
    Machine,
    numbers_of,
)
from taccorl.diagnosis.problems import joints, pads
from taccorl.diagnosis.problems.joint_problem import JointProblem, selectors
from taccorl.diagnosis.search.changed_numbers import REFIT_WORSE
from taccorl.errors import TaccorlError, nearest
from taccorl.robots import ROBOT
from taccorl.sim.effects import effects, make_effect
from taccorl.sim.effects.effect import ArmEffect, Effect, JointEffect
from taccorl.sim.twin import TwinConfig
from taccorl.sim.twin_file import load_twin, save_twin, twin_digest


@dataclass(frozen=True)
class PiperTwin(Machine):
    """A twin of the PiPER. Its parts are joints (``left_joint5``) and pairs of pads (``left pads``)."""

    config: TwinConfig
    """Configuration of the twin."""
    name: str = "twin"
    part_word: ClassVar[str] = "joint"
    saved_words: ClassVar[str] = "it is what collect and training load"

    @classmethod
    def load(cls, path: Path) -> Self:
        return cls(load_twin(path), path.stem)

    @classmethod
    def nominal(cls) -> "PiperTwin":
        """The twin without any file."""
        return cls(TwinConfig(), "nominal twin")

    @property
    def file_name(self) -> str:
        return "twin.yaml"

    def save(self, path: Path) -> None:
        save_twin(self.config, path)

    def digest(self) -> str:
        return twin_digest(self.config)

    @property
    def effects(self) -> tuple[str, ...]:
        return tuple(e.name for e in self.config.effects)

    def numbers(self, part: str) -> dict[str, tuple[float, str]]:
        if part in _SIGNALS:
            arm, joint = part.split("_", 1)
            control, k = self.config.controller_of(arm), ROBOT.joints.index(joint)
            own = {
                "kp": (control.kp_nm_per_rad[k], "N·m/rad"),
                "kd": (control.kd_nms_per_rad[k], "N·m·s/rad"),
                "torque_ff": (control.torque_ff_nm[k], "N·m"),
            }
            return own | numbers_of(
                e for e in self.config.effects if part in e.acts_on()
            )
        words = [arm for arm in ROBOT.arms if arm in part.split()] or ROBOT.arms
        places = {f"{arm}_{finger}" for arm in words for finger in ROBOT.fingers}
        units = {"k_n": "1/m", "k_d": "s/m"}
        own = {
            name: (getattr(self.config.sensor, field), units[name])
            for name, field in pads.FIELDS.items()
        }
        return own | numbers_of(
            e for e in self.config.effects if places & {*e.acts_on()}
        )

    @property
    def units(self) -> Mapping[str, str]:
        return {name: unit_of(name) for name in ROBOT.action_names}

    def check(self, measurements: Measurements) -> dict[str, list[DataFinding]]:
        """Check recordings for faults specific to the PiPER, such as a table without an arm's other joints: inertia and weight
        are then those of the rest pose. Returns recording → findings."""
        return {
            m.name: [f for arm in ROBOT.arms for f in _pose_unknown(m, arm)]
            for m in measurements.all
        }

    def parts(self, measurements: Measurements) -> tuple[str, ...]:
        found = [
            *joints.swept_joints(measurements),
            *map(pads.part_of, pads.pressed_arms(measurements, self.config)),
        ]
        if not found:
            lacking = [
                f"; {m.name} presses pads that the twin has not: {text}"
                for m in measurements.fit
                if m.pressed is not None
                if (text := lacking_pads(m, self.config, m.pressed.arm))
            ]
            raise TaccorlError(
                "no fit recording moves a joint by 2 mrad or more, or states what pads pressed; record sweeps or presses "
                "(taccorl excite plans both), and for presses state `pressed` in measurements.yaml"
                + "".join(lacking[:1])
            )
        return tuple(found)

    def select(
        self, parts: Sequence[str], joints: Sequence[str], pads: Sequence[str]
    ) -> tuple[str, ...]:
        """Select parts by name: ``left_joint5``; ``joint5`` and the paper's ``J4`` are that joint of every arm. Pads are named by
        their arm. Returns joints, then pads."""
        swept = [p for p in parts if p in _SIGNALS]
        pressed = [p.removesuffix(" pads") for p in parts if p not in _SIGNALS]
        arms = _arms_named(pads, pressed) if pads or not joints else []
        signals = _joints_named(joints, swept) if joints or (swept and not pads) else []
        return (*signals, *map(_part_of, arms))

    def compare(
        self,
        measurements: Measurements,
        *,
        name: str = "",
        pressed: PressedObject | None = None,
        progress: Counted = lambda recording, done, total: None,
    ) -> Comparison:
        return compare(
            self.config,
            measurements,
            name=name or self.name,
            pressed=pressed,
            progress=progress,
        )

    def of_part(self, part: str, measurements: Measurements) -> Measurements:
        return (
            joints.of_joints(measurements, [part], touch=False)
            if part in _SIGNALS
            else measurements
        )

    def diagnose(
        self, part: str, measurements: Measurements, **options: Any
    ) -> Finding:
        if part in _SIGNALS:
            return joints.diagnose_joint(self.config, part, measurements, **options)
        options.pop("gains", None)  # of joints alone
        return pads.diagnose_arm(
            self.config, part.removesuffix(" pads"), measurements, **options
        )

    def effect(self, name: str, part: str, values: Mapping[str, Any]) -> Effect | None:
        if {"arm", "joints", "pads"} & {
            *values
        }:  # as a report has it: it says itself where it acts
            return make_effect(name, **values)
        where = selectors(effects.get(name), part) if part in _SIGNALS else None
        return None if where is None else make_effect(name, **where, **values)

    def by_hand(
        self,
        name: str,
        joints: Sequence[str],
        pads: Sequence[str],
        values: Mapping[str, float],
    ) -> list[Addition]:
        kind = effects.get(name)
        if all(selectors(kind, signal) is None for signal in _SIGNALS):
            if joints:
                raise TaccorlError(
                    f"{name} is not an effect of joints; remove --joints"
                )
            where = [
                f"{arm}_{finger}"
                for arm in _arms_named(pads, ROBOT.arms)
                for finger in ROBOT.fingers
            ]
            made = make_effect(name, pads=where, **values, evidence="by hand")
            return [Addition(" and ".join(pads or ["all"]) + " pads", [made], {}, {})]
        if pads:
            raise TaccorlError(f"{name} is an effect of joints; remove --pads")
        if not joints:
            raise TaccorlError(
                f"{name}: which joints? --joints=left_joint5, or joint5 for both arms"
            )
        return self._by_hand(name, _joints_named(joints, _SIGNALS), values)

    def with_additions(self, additions: Sequence[Addition]) -> "PiperTwin":
        """Add effects and numbers. k_n and k_d are common to all pads, so that values of several arms' pads must agree."""
        config = copy.deepcopy(self.config)
        of_pads = {
            a.part: (a.base, a.intervals)
            for a in additions
            if a.base and a.part not in _SIGNALS
        }
        if of_pads:
            pads.set_numbers(config, pads.agreed(of_pads))
        for a in additions:
            if a.base and a.part in _SIGNALS:
                joints.set_numbers(config, a.part, a.base)
            for effect in a.effects:
                joints.add_effect(config, effect)
        return PiperTwin(config, self.name)

    def reconsidered(
        self,
        findings: Sequence[Finding],
        measurements: Measurements,
        gains: GainsAre,
        diagnosed: Diagnosed,
    ) -> list[Finding]:
        """An effect of a whole arm with one number, ``gravity_mismatch``, that was found at a joint has the strength of the joint
        that determines it best. It is held at the arm's other joints, which are diagnosed again where it changes something. Where
        that leaves a larger error, it is not what the arm lacks: joints that named it are diagnosed without it."""
        for arm in ROBOT.arms:
            mine = [
                cast(joints.JointFinding, f)
                for f in findings
                if f.part.startswith(f"{arm}_joint")
            ]
            if not (found := _of_whole_arm(mine)):
                continue
            owner, effect = found[0]
            machine = self.with_additions([Addition(owner.part, [effect], {}, {})])
            named = [f.part for f, e in found if e.name == effect.name]
            others = [
                f
                for f in mine
                if f is not owner
                and (f.part in named or machine.differs(self, f, measurements))
            ]
            again = diagnosed(machine, [f.part for f in others], [effect.name])
            ((value, _),) = numbers_of([effect]).values()
            told = f"{effect.name} {value:.3g} of the arm, as {owner.part} shows it"
            worse = [
                f"{_left(new):.2f} instead of {_left(old):.2f} noise floors at {old.part}"
                for new, old in zip(again, others, strict=True)
                if _left(new) > REFIT_WORSE * max(_left(old), 1.0)
            ]
            text = f"judged with {told}: add both, or that first"
            if worse:
                text = f"{told} does not hold at all joints: it would leave {', '.join(worse)}"
                again = diagnosed(self, named, [effect.name])
            changed = {f.part: remarked(f, text) for f in again}
            findings = [changed.get(f.part, f) for f in findings]
        return list(findings)

    def differs(
        self,
        other: "PiperTwin",
        finding: joints.JointFinding,
        measurements: Measurements,
    ) -> bool:
        """Whether the replays of a joint differ from those of ``other`` by more than half of the joint's noise floor."""
        part, most = finding.part, 0.5 * finding.floors[0].value
        return any(
            np.abs(self.answer(part, m).reported - other.answer(part, m).reported).max()
            > most
            for m in joints.of_joints(measurements, [part]).fit
        )

    def mended(self, findings: Sequence[Finding]) -> "tuple[PiperTwin, str]":
        """The twin with everything that was found, except effects of pads if two arms need different k_n or k_d."""
        try:
            return super().mended(findings)
        except TaccorlError as error:
            found, _ = super().mended([f for f in findings if f.part in _SIGNALS])
            return found, f"the corrected twin's pads are as they were: {error}"

    def refitted(self, findings: Sequence[Finding]) -> "PiperTwin":
        try:
            return super().refitted(findings)
        except TaccorlError:
            return super().refitted([f for f in findings if f.part in _SIGNALS])

    def drive(self, part: str) -> Drive:
        column = ROBOT.action_names.index(part)
        limits = float(ROBOT.action_low[column]), float(ROBOT.action_high[column])
        return Drive("rad", limits, TORQUE_NM[joint_number(part) - 1], "position", True)

    def answer(self, part: str, m: Measurement) -> JointResponse:
        """As ``Machine.answer``; its effort is the whole torque of the motor, the gravity compensation included."""
        model, motion = (
            JointModel(self.config, part),
            joint_motion(m, self.config, part),
        )
        answer = model.simulate(motion, model.gains)
        return JointResponse(answer.reported, model.motor_nm(motion, answer))

    def motion_problem(
        self, part: str, measurements: Measurements, gains: GainsAre
    ) -> JointProblem:
        return JointProblem(self.config, part, measurements, gains=gains)

    def option_of(self, part: str) -> list[str]:
        return [] if part in _SIGNALS else [f"--pads={part.removesuffix(' pads')}"]


_SIGNALS = joints.SIGNALS
_part_of = pads.part_of


def _left(finding: Finding) -> float:
    """Validation error with what was found [floors]."""
    return finding.diagnosis.errors["after"]["validation"]


def _of_whole_arm(findings: Sequence[Finding]) -> list[tuple[Finding, Effect]]:
    """Added effects of whole arms with one number, each with its joint; first the one that is determined best."""

    def unsure(item: tuple[Finding, Effect]) -> tuple[bool, float]:
        (f, effect), (number,) = item, item[1].parameters()
        low, high = effect.interval.get(number.name, (0.0, math.inf))
        return effect.name in f.diagnosis.rivals, (high - low) / abs(
            getattr(effect, number.name) - number.absent
        )

    found = [
        (f, e)
        for f in findings
        for e in f.diagnosis.effects
        if e.name not in f.diagnosis.present
    ]
    of_arm = [
        (f, e)
        for f, e in found
        if isinstance(e, ArmEffect) and not isinstance(e, JointEffect)
    ]
    return sorted(
        (pair for pair in of_arm if len(pair[1].parameters()) == 1), key=unsure
    )


def _joints_named(names: Sequence[str], known: Sequence[str]) -> list[str]:
    """Joints that are meant, each once.

    Raises:
        TaccorlError: nothing is known, or a name that is none of them.
    """
    if not known:
        raise TaccorlError(
            "no fit recording moves a joint by 2 mrad or more; record sweeps (taccorl excite plans them)"
        )
    chosen: list[str] = [] if names else list(known)
    for name in names:
        joint = (
            f"joint{int(name[1:]) + 1}"
            if name[:1] in "Jj" and name[1:].isdigit()
            else name
        )
        joint = f"joint{joint}" if joint.isdigit() else joint
        meant = [s for s in known if joint in (s, s.split("_", 1)[1])]
        if not meant:
            raise TaccorlError(
                f"{name}: no such joint is swept in these recordings; {nearest(joint, known)}"
            )
        chosen += [s for s in meant if s not in chosen]
    return chosen


def _arms_named(names: Sequence[str], known: Sequence[str]) -> list[str]:
    """Arms whose pads are meant.

    Raises:
        TaccorlError: one whose pads are not known.
    """
    for name in names:
        if name not in ROBOT.arms:
            raise TaccorlError(
                f"--pads={name}: no such arm; {nearest(name, ROBOT.arms)}"
            )
        if name not in known:
            way_out = (
                nearest(name, known)
                if known
                else "state `pressed` in measurements.yaml"
            )
            raise TaccorlError(
                f"--pads={name}: the recordings have no pads of that arm; {way_out}"
            )
    return [arm for arm in known if not names or arm in names]


def _pose_unknown(m: Measurement, arm: str) -> list[DataFinding]:
    lacking = [f"{arm}_{j}" for j in ROBOT.joints if f"{arm}_{j}" not in m.signals]
    return pose_unknown(
        lacking * (len(lacking) < len(ROBOT.joints)), "as on the bench", f"{arm} arm"
    )

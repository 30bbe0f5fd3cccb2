"""The PiPER's twin as a machine: two arms and their pads, described by a ``twin.yaml`` (``taccorl.sim.twin_file``)."""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Self

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
from taccorl.diagnosis.problems.shared import shared_fit, with_effect
from taccorl.errors import TaccorlError, nearest
from taccorl.robots import ROBOT
from taccorl.sim.effects import effects, make_effect
from taccorl.sim.effects.effect import Effect
from taccorl.sim.twin import TwinConfig
from taccorl.sim.twin_file import load_twin, save_twin, twin_digest


@dataclass(frozen=True, repr=False)
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
        """``gravity_mismatch`` is one number of an arm: where it was found at a joint, it is
        fitted to all joints of the arm that move, which are diagnosed again with it, or
        without it if it does not hold at all of them."""
        name = "gravity_mismatch"
        for arm in ROBOT.arms:
            group = {f.part: f for f in findings if f.part.startswith(f"{arm}_joint")}
            d = {part: f.diagnosis for part, f in group.items()}
            named = {
                part: (name,)
                for part, own in d.items()
                if name in {*own.names} - {*own.present}
            }
            if not named or len(group) < 2:
                continue
            problems = {
                part: self._problem_of(f, measurements, gains)
                for part, f in group.items()
            }
            owner = next(iter(named))
            shared = problems[owner].candidates[name]
            found = shared_fit(problems, d, named, shared)
            mended = self.with_additions([Addition(owner, [found.effect], {}, {})])
            again = {} if found.worse else mended.shared_by(group, found, diagnosed)
            if not again:
                findings = self.without_shared(findings, group, named, name, diagnosed)
                continue
            again[owner] = with_effect(again[owner], d[owner], found.effect)
            findings = [again.get(f.part, f) for f in findings]
        return list(findings)

    def _problem_of(
        self, f: Finding, measurements: Measurements, gains: GainsAre
    ) -> JointProblem:
        """``motion_problem`` in which effects of the file that its diagnosis did not fit stay."""
        own = joints.of_joints(measurements, [f.part], touch=False)
        here = {e.name for e in self.config.effects if f.part in e.acts_on()}
        held = here - {*f.diagnosis.present}
        return JointProblem(self.config, f.part, own, gains=gains, held=held)

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

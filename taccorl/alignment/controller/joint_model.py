"""Simulate one joint of a machine with the targets of one recording, in about a millisecond: identification does it thousands of
times.

The other joints move as they were measured. Inertia and weight are those of the compiled model (``rigid_joint``), so that
numbers identified on the PiPER are valid in its twin; ``test_joint_model.py`` compares with MuJoCo, effect by effect, and with
the whole twin.

Letters in shapes: T rows.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from taccorl.alignment.controller.arm_joint import HasJoints, joint_of
from taccorl.alignment.controller.drive_law import FOLLOW_HZ
from taccorl.alignment.controller.drive_numbers import Drive
from taccorl.alignment.controller.joint_kernel import simulate_all
from taccorl.alignment.controller.joint_motion import JointMotion
from taccorl.alignment.controller.rigid_joint import Gains, Rigid, RigidJoint, weighs
from taccorl.errors import TaccorlError
from taccorl.sim.effects.effect import Effect
from taccorl.sim.twin import TwinConfig

GRAVITY_M_PER_S2 = 9.81
SAME_RATE = 0.02
"""Largest share by which the rates of received and logged targets may differ to count as equal: stamps are rounded."""
KEPT, KEPT_ROWS = 12, 200_000
"""Simulated responses to each recording that a model keeps, as fits ask for some again; and most rows of them in all."""
ENDS_S = 0.1
"""Time from either end of a recording in which a model of law effort is not judged [s]: the position is smoothed there from one
side, and the model settles in 1 / ``drive_law.FOLLOW_HZ``."""
_ADDITIVE = {
    "armature__added_kgm2",
    "viscous_friction__damping_nms_per_rad",
    "quadratic_drag__drag_nms2_per_rad2",
    "coulomb_friction__torque_nm",
    "load_friction__share",
    "gear_friction__share",
    "command_delay__delay_s",
    "sensor_delay__delay_s",
    "speed_delay__delay_s",
}
_FACTORS = {"gravity_mismatch__share", "torque_scale__factor", "encoder_scale__factor"}


class PayloadLever(NamedTuple):
    """Correction of the weight of a payload whose position no recording states: m g (s sin q + c cos q), relative to the
    position in the twin."""

    sin_m: float = 0.0  # Coefficient s [m]
    cos_m: float = 0.0  # Coefficient c [m]


class Numbers(NamedTuple):
    """Gains, effects and corrections of one simulation."""

    gains: Gains  # Gains of a recording with ``kp_scale`` = 1
    effects: Sequence[Effect] = ()
    """Effects in addition to those of the machine file; one with the name of an effect of the file replaces it."""
    lever: PayloadLever = PayloadLever()
    """Correction of the payload's weight; none: it is where the twin has it."""
    age_s: float = (
        0.0  # Additional age of the measured position when the drive's torque acts
    )
    facts: Mapping[str, float] | None = None
    """Overrides: name of a field of ``drive_numbers.Drive`` → value that is used instead of the joint's own."""
    waits_s: float = 0.0
    """Time for which a row's target waits until the drive's loop reads it [s]; the row's effort is newer by the same time."""
    effort_scale: float = 1.0  # Ratio of the recorded effort to the torque; under law effort that drives the model


class _Prepared(NamedTuple):
    """``Numbers`` of a simulation; the effects that change bodies; fields of ``Drive``."""

    case: Numbers
    bodies: Sequence[Effect]
    numbers: Mapping[str, float]


_ABSENT = dict.fromkeys(Drive._fields, 0.0) | Drive._field_defaults


class _Sent(NamedTuple):
    """What a drive gets in each part of a row, (T · parts,) each; ``joint_kernel.simulate`` says what."""

    target: np.ndarray
    supply: np.ndarray
    on: np.ndarray
    added: np.ndarray


Answers = dict[JointMotion, dict[tuple, tuple[np.ndarray, np.ndarray]]]
"""Motion of a recording → the newest answers to its targets."""


@dataclass(frozen=True)
class JointResponse:
    """Simulated position and motor torque of the joint, one value for each row of the recording."""

    reported: np.ndarray  # (T,) reported positions [rad]
    effort: np.ndarray
    """(T,) torque of the motor at the time of each row, before the row's command acts, within the motor's limits [N·m]; with or
    without the gravity compensation as ``RigidJoint.effort_holds_weight`` states. ``Replay.effort`` has it one row earlier."""


class JointModel:
    """Model of one joint: a given ``RigidJoint``, or joint ``signal`` of a machine with the effects of the machine's file. Raises
    TaccorlError: there is no such joint, or it is a gripper of the PiPER."""

    def __init__(
        self, of: TwinConfig | HasJoints | RigidJoint, signal: str = ""
    ) -> None:
        joint = of if isinstance(of, RigidJoint) else joint_of(of, signal)
        self.joint, self.signal, self.unit, self.gains = (
            joint,
            joint.signal,
            joint.unit,
            joint.gains,
        )
        self._rigid: dict[tuple, Rigid] = {}
        self._answers: Answers = {}

    def simulate(
        self,
        motion: JointMotion,
        gains: Gains,
        effects: Sequence[Effect] = (),
        facts: Mapping[str, float] | None = None,
        each_step: bool = False,
    ) -> JointResponse:
        """Simulate the response to one recording's targets with one set of ``Numbers``; see ``simulate_all``."""
        return self.simulate_all(
            [motion], [Numbers(gains, effects, facts=facts)], each_step
        )[0][0]

    def simulate_all(
        self,
        motions: Sequence[JointMotion],
        cases: "Sequence[Numbers]",
        each_step: bool = False,
    ) -> list[list[JointResponse]]:
        """Simulate the responses to the targets of each of ``motions``, from rest at its ``start``, with each of ``cases``, side
        by side. Their arrays are read-only. ``each_step``: give the response after each physics step, not only at the rows.
        Raises TaccorlError: a row is no whole number of physics steps, or an axis cannot have one of the effects."""
        return simulate_each(
            [self] * len(cases), motions, cases, self._answers, each_step
        )

    def _prepared(self, case: "Numbers") -> "_Prepared":
        """Prepare what does not depend on the recording."""
        present = self.joint.effects(case.effects)
        drives = {
            effect.name: drive
            for effect in present
            if (drive := effect.drive()) is not None
        }
        if unknown := [effect.name for effect in present if effect.name not in drives]:
            raise TaccorlError(
                f"{self.signal}: the one-joint model does not have {' and '.join(unknown)}; remove it"
            )
        known = {
            "speed_age": self.joint.speed_delay_s,
            **self.joint.facts,
            **(case.facts or {}),
        }
        known = {
            k: v
            for k, v in known.items()
            if k in _ADDITIVE or not any(k in d for d in drives.values())
        }
        bodies = [effect for effect in present if not drives[effect.name]]
        return _Prepared(case, bodies, _combined({"the drive": known, **drives}))

    def motor_nm(self, motion: JointMotion, answer: JointResponse) -> np.ndarray:
        """(T,) whole torque of the motor, the gravity compensation included, of a response without effects [N·m]."""
        if self.joint.effort_holds_weight:
            return answer.effort
        body, angles = self._body(motion, []), answer.reported
        return (
            answer.effort
            + body.compensation_sin * np.sin(angles)
            + body.compensation_cos * np.cos(angles)
        )

    def inertia_kgm2(self, motion: JointMotion) -> float:
        """Inertia of the joint [kg·m²] with all bodies that it moves, in the recording's pose, with rotor and known payload."""
        return self._body(motion, []).inertia

    def weight_nm(self, motion: JointMotion, angles: np.ndarray) -> np.ndarray:
        """(T,) torque of the weight that the controller must hold, without the compensated part, at ``angles`` (T,) [rad]."""
        body = self._body(motion, [])
        sine, cosine = (
            body.gravity_sin - body.compensation_sin,
            body.gravity_cos - body.compensation_cos,
        )
        return sine * np.sin(angles) + cosine * np.cos(angles)

    def is_weighed(self, motion: JointMotion) -> bool:
        """True if weight has a torque about the joint; it has none about a vertical axis."""
        return weighs(self._body(motion, []))

    def _body(self, motion: JointMotion, bodies: Sequence[Effect]) -> Rigid:
        mounted = motion.moment_kgm, motion.mounted_kgm2
        key = (
            motion.pose.tobytes(),
            motion.payload_kg,
            *mounted,
            motion.payload_at_m,
            *map(repr, bodies),
        )
        if key not in self._rigid:
            if (
                len(self._rigid) > 1000
            ):  # a search that changes bodies would fill the memory
                self._rigid.clear()
            self._rigid[key] = self.joint.rigid(motion, bodies)
        return self._rigid[key]

    def _sent(self, motion: JointMotion) -> "tuple[_Sent, int, int, float]":
        """What the machine sends, parts a row, physics steps for each part, and the step [s]."""
        step_s = self.joint.timestep_s(motion)
        steps = 1.0 / (motion.rate_hz * step_s)
        if abs(steps - round(steps)) > 1e-6 * steps or round(steps) < 1:
            raise TaccorlError(
                f"{motion.name}: {motion.rate_hz:g} Hz means {steps:.3f} physics steps of {step_s * 1e3:.3f} ms per row, which "
                f"is not a whole number; resample to {1 / (max(1, round(steps)) * step_s):g} Hz first (Measurement.resampled)"
            )
        received_hz = (
            self.joint.command_hz if self.joint.command_hz < math.inf else 1.0 / step_s
        )
        parts = received = max(1, math.ceil(received_hz / motion.rate_hz - SAME_RATE))
        late_s = max(self.joint.target_late_s, 0.0) * self.joint.keeps_times
        own_times = late_s > 0.0 or motion.command_s is not None
        if self.joint.keeps_times:
            parts = round(steps) if own_times else min(parts, round(steps))
        while round(steps) % parts:
            parts -= 1
        if self.joint.keeps_times and (own_times or received > 1):
            held = (
                0.0 if self.joint.target_kind == "effort" else 0.5 / received
            )  # no drive holds what was measured
            sent = _in_time(motion, late_s, received, parts, held)
        else:
            sent = _in_rows(motion, parts)
        return sent, parts, round(steps) // parts, step_s


def simulate_each(
    models: Sequence[JointModel],
    motions: Sequence[JointMotion],
    cases: Sequence[Numbers],
    kept: Answers,
    each_step: bool = False,
) -> list[list[JointResponse]]:
    """``JointModel.simulate_all`` in which case k has the model k: one joint with other numbers each, all with the same law.
    ``kept``: newest responses of earlier calls, which are not simulated again; this call adds its own."""
    prepared = [
        model._prepared(case) for model, case in zip(models, cases, strict=True)
    ]
    return [
        _side_by_side(models, motion, prepared, kept.setdefault(motion, {}), each_step)
        for motion in motions
    ]


def _side_by_side(
    models: Sequence[JointModel],
    motion: JointMotion,
    prepared: Sequence[_Prepared],
    kept: dict[tuple, tuple[np.ndarray, np.ndarray]],
    each_step: bool,
) -> list[JointResponse]:
    of_model = {model: model._sent(motion) for model in models}
    carrying = (
        np.zeros(len(motion.target))
        if motion.carrying_nm is None
        else motion.carrying_nm
    )
    keys: list[tuple] = []
    missing: dict[tuple, tuple[_Sent, dict[tuple, tuple[tuple, np.ndarray]]]] = {}
    for model, (case, bodies, numbers) in zip(models, prepared, strict=True):
        joint, (sent, parts, hold, step_s) = model.joint, of_model[model]
        late_s = joint.target_late_s
        when = (
            late_s,
            parts,
            hold,
            step_s,
            case.effort_scale if joint.target_kind == "effort" else 1.0,
        )
        kp, kd = case.gains.kp * motion.kp_scale, case.gains.kd * motion.kd_scale
        # K_p (q* − q(t − a)) is K_p (q* − q) + K_p a q̇.
        gains = Gains(
            kp, kd - kp * (joint.position_age_s + case.age_s), case.gains.torque_ff
        )
        body = model._body(motion, bodies)._asdict()
        held_n = body.pop("weight_n")
        drive = {**_ABSENT, **gains._asdict(), **body, **numbers}
        weight = (
            0.0 if motion.payload_at_known else motion.payload_kg * GRAVITY_M_PER_S2
        )
        drive["gravity_sin"] += weight * case.lever.sin_m
        drive["gravity_cos"] += weight * case.lever.cos_m
        # A target that acts before its row does so by a delay below 0, a later one by ``_sent``.
        waits_s = case.waits_s + min(late_s, 0.0)
        drive["command_delay__delay_s"] += waits_s
        drive["effort_age"] -= waits_s
        # An integral holds what acts on a joint at rest with any effort within the dry
        # friction.
        if any(
            drive[f"{name}__rate_per_s"] > 0.0
            for name in ("integral_action", "position_integral")
        ):
            drive["start_nm"] = motion.start_nm / case.effort_scale
        if (
            held := motion.held_nm_per_rad
        ):  # a spring about 0 and a damper more, on the motor's side
            own = drive["cable_spring__stiffness_nm_per_rad"]
            drive["cable_spring__stiffness_nm_per_rad"] += held
            drive["cable_spring__rest_rad"] *= own / (own + held)
            drive["viscous_friction__damping_nms_per_rad"] += held / (
                math.pi * FOLLOW_HZ
            )
        drive["effort_holds_weight"] = float(joint.effort_holds_weight)
        if drive["effort_after"] and late_s > 0.0:
            # A row's target arrives late_s after the row: the effort that it causes begins then, from the position at that time.
            drive["effort_after"] = 1 + math.ceil(
                late_s * motion.rate_hz * parts - 1e-9
            )
            drive["effort_age"] -= late_s
        keys.append((*when, *drive.values(), held_n, each_step, *map(repr, bodies)))
        if keys[-1] in kept:
            continue
        geared = (
            drive["backlash__play_rad"] > 0.0
            or drive["joint_compliance__compliance_rad_per_nm"] > 0.0
        )
        # Of a joint with play or a spring in its gear, steps of 0.25 ms (``Drive.midpoint``):
        # an implicit step h damps a swing with ω by h ω / 2. At 71 Hz the damping ratio is
        # 0.22 too large with steps of 1 ms, 0.06 with these.
        finer = (
            math.ceil(step_s / 2.5e-4 - 1e-9)
            if geared and drive["midpoint"] > 0.0
            else 1
        )
        loads = motion.coupling_nm + held_n + joint.moving_masses_nm(motion, bodies)
        missing.setdefault(
            (finer, geared, *when), (sent._replace(added=sent.added / when[-1]), {})
        )[1][keys[-1]] = (tuple(drive.values()), loads)
    for (finer, _, _, parts, hold, step_s, _), (sent, those) in missing.items():
        drives, loads = zip(*those.values(), strict=True)
        start = (
            motion.start,
            hold * finer,
            parts,
            step_s / finer,
            motion.start_speed,
            int(each_step),
        )
        found = simulate_all(drives, sent.target, loads, carrying, *sent[1:], *start)
        kept.update(zip(those, found, strict=True))
    answers = [JointResponse(*kept[key]) for key in keys]
    while len(kept) > min(KEPT, KEPT_ROWS // len(answers[0].reported)):
        del kept[next(iter(kept))]
    if models[0].joint.target_kind == "effort":
        return [
            _holding(of_model[m], motion, one.case, a)
            for m, one, a in zip(models, prepared, answers, strict=True)
        ]
    return answers


def _holding(
    of: tuple[_Sent, int, int, float],
    motion: JointMotion,
    case: Numbers,
    answer: JointResponse,
) -> JointResponse:
    """With the effort of a law effort: what holds the model at the measured position is beyond the effort that drives it, and
    ``torque_ff``, which the recorded effort lacks, is in neither. Within ``ENDS_S`` of either end it is the recorded one."""
    sent, parts, _, _ = of
    before = (
        np.concatenate([sent.added[:1], sent.added[parts - 1 : -1 : parts]])
        / case.effort_scale
    )
    # What a row shows is of the part before it, whose target is half a part old.
    slope = 0.5 * motion.kp_scale / parts * np.gradient(motion.target)
    held = answer.effort - before - case.gains.torque_ff + case.gains.kp * slope
    since = motion.time_s - motion.time_s[0]
    is_judged = np.minimum(since, since[-1] - since) >= ENDS_S
    return JointResponse(
        answer.reported, held * is_judged + motion.effort / case.effort_scale
    )


@lru_cache(maxsize=32)
def _in_rows(motion: JointMotion, parts: int) -> _Sent:
    """What the machine sends at the times of the rows: targets on the line from each row's to the next one's."""
    target, ones = motion.target, np.ones(len(motion.target))
    sent = _Sent(
        target,
        ones if motion.supply is None else motion.supply,
        ones if motion.on is None else motion.on,
        0.0 * ones if motion.torque_ff_nm is None else motion.torque_ff_nm,
    )
    if parts == 1:
        return sent
    following = np.append(target[1:], target[-1])
    share = np.arange(1, parts + 1) / parts
    target = (target[:, None] + share * (following - target)[:, None]).ravel()
    return _Sent(target, *(np.repeat(values, parts) for values in sent[1:]))


@lru_cache(
    maxsize=32
)  # only one number of a fit changes it, and it takes as long as a third of the simulation
def _in_time(
    motion: JointMotion, late_s: float, received: int, parts: int, held: float
) -> _Sent:
    """What is sent at its own times, ``late_s`` later: the mean of each part while the motor is on, of values that are held until
    the next comes; of targets that are received faster than they are logged the mean of the line between them, ``held`` rows
    later."""
    sent = _in_rows(motion, 1)
    # In rows: the clock of ``time_s`` and the rate may differ by a millionth.
    rows = len(motion.target)
    late = late_s * motion.rate_hz
    came = (
        np.arange(rows)
        if motion.command_s is None
        else motion.command_s * (rows - 1) / motion.time_s[-1]
    ) + late
    edges = np.arange(rows * parts + 1) / parts
    if motion.command_s is None:  # a fifth of the time of a search in ``came``
        last = np.clip(np.floor(edges - late).astype(int), 0, rows - 1)
    else:
        last = np.maximum(np.searchsorted(came, edges, side="right") - 1, 0)
    whole, since = np.diff(came), edges - came[last]

    def mean(values: np.ndarray) -> np.ndarray:
        if (values == values[0]).all():
            return np.full(rows * parts, values[0])
        before = np.concatenate([[0.0], np.cumsum(values[:-1] * whole)])
        return np.diff(before[last] + values[last] * since) * parts

    on = mean(sent.on)
    of_on = (
        (mean(values * sent.on) / np.maximum(on, 1e-9), values[0])
        for values in (sent.target, sent.supply)
    )
    target, supply = (np.where(on > 1e-9, own, first) for own, first in of_on)
    found = _Sent(target, supply, on, np.repeat(sent.added, parts))
    if received > 1:
        middle = 0.5 * (edges[1:] + edges[:-1]) - held
        # A line between measured positions lies beside their curve, and the spring on it would be an inertia.
        line = (
            np.interp(middle, came, sent.target)
            if held
            else CubicSpline(came, sent.target)(middle)
        )
        found = found._replace(target=line)
    return found


OTHER = 0.05  # Share by which numbers are changed to see what they do to a response


def with_other_numbers(model: JointModel, motion: JointMotion) -> list[np.ndarray]:
    """Reported positions with 5 % more of K_p, of K_d, and of the inertia, one at a time: what numbers that are not quite right
    change in a response. Returns (T,) [rad] for each number, in this order; gains that are 0 are left out."""
    kp, kd, torque_ff = model.gains
    more = 1.0 + OTHER
    gains = [Gains(more * kp, kd, torque_ff)] * (kp > 0.0) + [
        Gains(kp, more * kd, torque_ff)
    ] * (kd > 0.0)
    found = [model.simulate(motion, other).reported for other in gains]
    added = {"armature__added_kgm2": OTHER * model.inertia_kgm2(motion)}
    return [*found, model.simulate(motion, model.gains, facts=added).reported]


LOOK_LIKE_LEADS = {
    "velocity_feedforward": ("share", 0.1),
    "integral_action": ("rate_per_s", 0.1),
}
"""Effect that takes lag off a response → its parameter, and how much of it is added to see what it does."""


def with_more_lead(model: JointModel, motion: JointMotion) -> dict[str, np.ndarray]:
    """Reported positions with a little more, or less, of each effect that makes a response lead as a clock offset does. Returns
    effect → (T,) [rad]."""
    found = {}
    for name, (parameter, more) in LOOK_LIKE_LEADS.items():
        stronger = []
        for own in (e for e in model.joint.effects(()) if e.name == name):
            value = getattr(own, parameter)
            stronger.append(
                dataclasses.replace(
                    own, **{parameter: value + (more if value <= 1.0 else -more)}
                )
            )
        facts = {} if stronger else {f"{name}__{parameter}": more}
        found[name] = model.simulate(
            motion, model.gains, stronger, facts=facts
        ).reported
    return found


def _combined(drives: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
    """One set of numbers of ``drives``, effect → its numbers. Raises TaccorlError: two want one that does not simply add up."""
    numbers: dict[str, float] = {}
    for name, drive in drives.items():
        for key, value in drive.items():
            if key not in Drive._fields:
                raise TaccorlError(
                    f"effect {name}: drive() names {key!r}, which the one-joint model lacks"
                )
            if key not in numbers:
                numbers[key] = value
            elif key in _ADDITIVE:
                numbers[key] += value
            elif key in _FACTORS:
                numbers[key] *= value
            else:
                raise TaccorlError(
                    f"effect {name}: another effect sets {key}, too; remove one of them"
                )
    return numbers

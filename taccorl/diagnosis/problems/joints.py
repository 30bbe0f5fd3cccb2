"""Diagnose every joint that the recordings move, each separately, and write the results into the twin."""

import copy
import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from taccorl.alignment.checks.trial import least_motion
from taccorl.alignment.controller.arm_joint import HasJoints
from taccorl.alignment.measurements.folder import Measurements
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.alignment.measurements.noise_floor import (
    DISAGREE,
    Kind,
    SignalFloor,
    laid_pairs,
    noise_floor,
    without_beginning,
)
from taccorl.alignment.measurements.repeats import overlay
from taccorl.diagnosis.problems.joint_problem import (
    PAYLOAD_PLACE,
    GainsAre,
    JointProblem,
)
from taccorl.diagnosis.search.drift import Drift, Repeat, drifts
from taccorl.diagnosis.search.identifiable import (
    Known,
    absolute_numbers,
    identifiable_numbers,
)
from taccorl.diagnosis.search.problem import Progress, no_progress
from taccorl.diagnosis.search.result import Diagnosis, SearchConfig, gains_nothing
from taccorl.diagnosis.search.solve import PartFinding, solved, with_drifts
from taccorl.errors import TaccorlError
from taccorl.lineage.processes import Done, Failed, run_in_processes
from taccorl.robots import ROBOT
from taccorl.sim.effects import make_effect
from taccorl.sim.effects.effect import ArmEffect, Effect, JointEffect, TouchEffect
from taccorl.sim.twin import TwinConfig

OTHER_GAIN = 0.1
"""Share by which a gain of the plain fit must differ from the stated one before a search
with fitted gains is tried. A choice."""
MOVES_RAD = 2e-3
"""Least commanded (or, without position commands, measured) range of a joint that is diagnosed [rad]."""
SIGNALS = tuple(f"{arm}_{joint}" for arm in ROBOT.arms for joint in ROBOT.joints)
"""Names of the joints of both arms, without grippers."""


@dataclass(frozen=True, kw_only=True)
class JointFinding(PartFinding):
    """Finding about one joint."""

    floors: tuple[SignalFloor, ...]
    """Noise floor of the angle, and of the effort if it was used."""


def swept_joints(measurements: Measurements) -> tuple[str, ...]:
    """Names of the PiPER's joints that move in at least one fit recording, in the order of ``SIGNALS``."""
    return tuple(s for s in SIGNALS if any(moves(m, s) for m in measurements.fit))


def moves(m: Measurement, signal: str) -> bool:
    """True if the recording commands the joint to move, by more than 2 mrad (2 mm; alone
    in a recording ``least_motion``, if that is less), while its arm presses nothing: contact
    forces at the hand turn its joints, and the one-joint model does not include them."""
    if m.pressed is not None and signal.startswith(f"{m.pressed.arm}_"):
        return False
    if signal not in m.signals:
        return False
    positions = m.moved(signal)
    least = MOVES_RAD
    if len(m.signals) == 1:
        least = min(least, least_motion(m, signal))
    return (
        bool(np.isfinite(positions).any())
        and float(np.nanmax(positions) - np.nanmin(positions)) > least
    )


def of_joints(
    measurements: Measurements, signals: Sequence[str], *, touch: bool = True
) -> Measurements:
    """The measurements without recordings that move none of ``signals``; without those of pads if ``touch`` is False."""
    sides = {
        use: tuple(
            m if touch else dataclasses.replace(m, touch=None)
            for m in getattr(measurements, use)
            if any(moves(m, s) for s in signals)
        )
        for use in ("fit", "validation", "test")
    }
    unlisted = tuple(
        name for name in measurements.unlisted if name in [m.name for m in sides["fit"]]
    )
    return dataclasses.replace(measurements, **sides, unlisted=unlisted)


def diagnose_joint(
    machine: TwinConfig | HasJoints,
    signal: str,
    measurements: Measurements,
    *,
    gains: GainsAre = "auto",
    search: SearchConfig | None = None,
    without: Sequence[str] = (),
    progress: Progress = no_progress,
) -> JointFinding:
    """Search for the effect that is missing at one joint, in the recordings that move it.

    Args:
        without: effects that are left out of the search; those of the machine stay as they are.
        progress: function that is called with a text about the present step.

    Raises:
        TaccorlError: no fit recording moves the joint.
    """
    own = of_joints(measurements, [signal])
    if not own.fit:
        raise TaccorlError(
            f"{signal}: no fit recording moves it; record a sweep of it, or choose other joints"
        )
    drifted = drifts_of(machine, signal, own, gains)
    own = apart(own, drifted)
    problem = JointProblem(machine, signal, own, gains=gains, held=without)
    found = solved(signal, problem, search, without, progress)
    may_fit = gains == "auto" and problem.commanded and problem.axis is None
    if may_fit and _gains_do_more(problem, found):
        progress("the gains are not those of the file: search again, with gains fitted")
        freed = JointProblem(machine, signal, own, gains="fitted", held=without)
        again = solved(signal, freed, search, without, progress)
        if _removes_more(_left(again.diagnosis), _left(found.diagnosis)):
            problem, found = freed, again
    most = SearchConfig().max_effects
    if search and search.max_effects < most and _plain_does_more(found.diagnosis):
        progress("usual numbers together explain more: search for several effects")
        more = dataclasses.replace(search, max_effects=most)
        found = solved(signal, problem, more, without, progress)
    if problem.axis is not None:
        return JointFinding(**vars(found), floors=tuple(problem.floors))
    known = known_numbers(problem, found.diagnosis)
    told = vars(found) | {
        "known": known,
        "diagnosis": with_intervals(found.diagnosis, known),
        "drifts": tuple(drifted),
    }
    joint = JointFinding(**told, floors=tuple(problem.floors))
    # For other machines a finding of their checks says it.
    return with_drifts(joint, drifted) if isinstance(machine, TwinConfig) else joint


def _left(found: Diagnosis) -> float:
    """RMS error that a diagnosis leaves in validation recordings [floors]."""
    return found.errors["after"]["validation"]


def _removes_more(error: float, other: float) -> bool:
    """Whether ``error`` is lower than ``other`` [floors] by what an effect must gain."""
    return error < other and not gains_nothing(other, error)


def _plain_does_more(found: Diagnosis) -> bool:
    """Whether the plain fit, of gains, friction and a delay, leaves much less than the
    answer."""
    plain = found.plain
    return plain is not None and _removes_more(plain.errors["validation"], _left(found))


def _gains_do_more(problem: JointProblem, found: PartFinding) -> bool:
    """Whether the plain fit leaves much less than the answer, with other gains."""
    if not _plain_does_more(found.diagnosis):
        return False
    plain = found.diagnosis.plain.values if found.diagnosis.plain else {}
    stated = {n: problem.start[n] for n in ("kp", "kd") if problem.start.get(n)}
    return any(abs(plain.get(n, v) / v - 1.0) > OTHER_GAIN for n, v in stated.items())


def drifts_of(
    machine: TwinConfig | HasJoints,
    signal: str,
    measurements: Measurements,
    gains: GainsAre = "auto",
) -> list[Drift]:
    """Numbers of the joint that changed between recordings of one motion, in those that
    differ by more than the noise of their rows. ``measurements``: those that move it."""
    differing = _differing(signal, measurements)
    if not differing:
        return []
    problem = JointProblem(machine, signal, measurements, gains=gains)
    recordings = {r.name: r for r in (*problem.fit, *problem.validation, *problem.test)}
    repeats = [
        Repeat(
            recordings[first.name],
            recordings[second.name],
            1e-9 * (second.start_ns - first.start_ns) or None,
            time_s,
            difference,
        )
        for first, second, time_s, difference in differing
    ]
    # With fitted gains viscous friction is a part of K_d.
    usual = (
        ("viscous_friction", "coulomb_friction")
        if problem.commanded
        else ("coulomb_friction",)
    )
    more = [
        name
        for name in usual
        if name in problem.candidates and name not in problem.present
    ]
    return drifts(problem, repeats, (*problem.present, *more), dict(problem.start))


type Differing = tuple[Measurement, Measurement, np.ndarray, np.ndarray]
"""Two recordings of one motion, the earlier one first; times (M,) in it [s], and second − first (M,) of a joint, in its unit."""


def _differing(signal: str, measurements: Measurements) -> list[Differing]:
    """Repeats whose difference at one joint is ``DISAGREE`` times the noise of rows."""
    pairs, found = laid_pairs(measurements.all), []
    if not pairs:
        return []
    is_input = measurements.all[0].target_kind(signal) == "effort"
    kind: Kind = "effort" if is_input else "position"
    floors = noise_floor(measurements.all, kind)
    for first, second, laid in pairs:
        if second.start_ns < first.start_ns:
            first, second, laid = second, first, overlay(second, first)
        difference = without_beginning(laid.difference[kind], first.rate_hz)
        own = difference[:, first.column(signal)]
        if signal not in floors or not np.isfinite(own).any():
            continue
        if np.nanmean(own**2) > 2.0 * (DISAGREE * floors[signal].quiet) ** 2:
            found.append((first, second, laid.time_s - first.time_s[0], own))
    return found


def apart(measurements: Measurements, drifted: Sequence[Drift]) -> Measurements:
    """The measurements in which the later recordings of ``drifted`` count as motions of their
    own, so that no noise floor is taken from how they differ from those that they repeat."""
    names = {name for drift in drifted for name in (drift.first, drift.second)}
    sides = {
        use: tuple(
            dataclasses.replace(m, repeat_of=None)
            if m.name in names and m.repeat_of in names
            else m
            for m in getattr(measurements, use)
        )
        for use in ("fit", "validation", "test")
    }
    return dataclasses.replace(measurements, **sides) if names else measurements


def known_numbers(problem: JointProblem, found: Diagnosis) -> Known:
    """Of the fitted numbers of a joint: those that its recordings identify, and the range of the others."""
    pinned_by = problem.pinned_by(found.names)
    kd = problem.model.gains.kd if problem.commanded else None
    return Known(
        identifiable=identifiable_numbers(
            found.after, problem.commanded, bool(pinned_by), kd
        ),
        absolute=absolute_numbers(
            found.after,
            inertia_kgm2=problem.inertia_kgm2,
            pinned=bool(pinned_by),
            kd=kd,
        ),
        pinned_by=pinned_by,
    )


def with_intervals(found: Diagnosis, known: Known) -> Diagnosis:
    """Copy of ``found`` with the intervals of ``known.absolute``, also in its effects, with the identified numbers in their
    evidence, and with a remark where a payload is not where the twin has it."""
    effects = []
    for effect in found.effects:
        prefix = f"{effect.name}."
        own = [n.words() for n in known.identifiable if n.name.startswith(prefix)]
        words = (
            effect.evidence,
            f"identified: {', '.join(own)}" * bool(own),
            effect.reads_as,
        )
        evidence = "; ".join(filter(None, words))
        mine = [
            n
            for n in known.absolute
            if n.name.startswith(prefix) and np.isfinite([n.low, n.high]).all()
        ]
        ends = {n.name.removeprefix(prefix): (n.low, n.high) for n in mine}
        effects.append(
            dataclasses.replace(
                effect, interval=effect.interval | ends, evidence=evidence
            )
        )
    remarks = (*found.remarks, *_payload_remarks(found))
    return dataclasses.replace(
        found,
        effects=tuple(effects),
        intervals=found.intervals | known.intervals,
        remarks=remarks,
    )


def _payload_remarks(found: Diagnosis) -> list[str]:
    """A payload is elsewhere than the twin has it, and no recording states where."""
    names = [f.name for f in PAYLOAD_PLACE]
    ends = [found.intervals[name] for name in names if name in found.base]
    if not any(low > 0.0 or high < 0.0 for low, high in ends):
        return []
    off_mm = 1e3 * math.hypot(*(float(found.base[name]) for name in names))
    return [
        f"The payload pulls as if it were {off_mm:.1f} mm off the TCP. No recording states its place: state payload_position_m "
        "in measurements.yaml, else compare shows an error there that this diagnosis does not."
    ]


def each[ItemT, FindingT](
    diagnosed: Callable[[ItemT], FindingT],
    items: Mapping[str, ItemT],
    workers: int,
    done: Callable[[str], None],
) -> list[FindingT]:
    """Results of ``diagnosed`` for the item of every part, in their order, computed in ``workers`` processes, on which they do
    not depend.

    Args:
        items: part → argument of ``diagnosed``.
        done: function that is called with each finished part.

    Raises:
        TaccorlError: as ``diagnosed``, or the worker of a part died.
    """
    parts, results = list(items), dict[str, FindingT]()

    def take(index: int, outcome: Done | Failed) -> None:
        if isinstance(outcome, Failed):
            raise _failed(parts[index], outcome, workers)
        results[parts[index]] = outcome.result
        done(parts[index])

    if workers > 1 and len(parts) > 1:
        run_in_processes(
            diagnosed, list(items.values()), min(workers, len(parts)), str, take
        )
    else:
        for k, item in enumerate(items.values()):
            take(k, Done(diagnosed(item)))
    return [results[part] for part in parts]


def _failed(part: str, outcome: Failed, workers: int) -> Exception:
    if outcome.trace:
        return RuntimeError(f"{part}:\n{outcome.trace}")
    if not outcome.process:
        return TaccorlError(outcome.reason.partition(": ")[2])
    killed = f": mostly for lack of memory, of which --workers=1 needs less than --workers={workers}"
    return TaccorlError(
        f"{part}: {outcome.reason}{killed * ('SIGKILL' in outcome.reason)}"
    )


def set_numbers(config: TwinConfig, signal: str, base: Mapping[str, float]) -> None:
    """Change ``config`` in place: write fitted gains into one arm, and the delay of the speed. Payload positions and effort
    scales belong to recordings, not to the twin. ``base``: fitted number → value, each written as it was fitted."""
    arm, joint = signal.split("_", 1)
    control = config.arm_controllers.setdefault(
        arm, copy.deepcopy(config.controller_of(arm))
    )
    k = ROBOT.joints.index(joint)
    fields = {
        "kp": control.kp_nm_per_rad,
        "kd": control.kd_nms_per_rad,
        "torque_ff": control.torque_ff_nm,
    }
    for name, values in fields.items():
        if name in base:
            values[k] = float(base[name])
    if "speed_delay_s" in base:
        delay_s = float(base["speed_delay_s"])
        delay = make_effect("speed_delay", arm=arm, joints=[joint], delay_s=delay_s)
        add_effect(config, delay)


def add_effect(config: TwinConfig, effect: Effect) -> None:
    """Add an effect to ``config`` in place. It replaces an entry of the same name for the same joints or pads; an absent effect
    takes it out."""
    kept: list[Effect] = []
    for other in config.effects:
        shared = (
            set(other.acts_on()) & set(effect.acts_on())
            if other.name == effect.name
            else set()
        )
        kept += _elsewhere(other, shared) if shared else [other]
    config.effects = [*kept, *([] if effect.is_absent else [effect])]


def _elsewhere(effect: Effect, taken: set[str]) -> list[Effect]:
    """Entries that do what ``effect`` does, but not to ``taken``."""
    rest = [thing for thing in effect.acts_on() if thing not in taken]
    if isinstance(effect, JointEffect):
        arms = {
            arm: [t.removeprefix(f"{arm}_") for t in rest if t.startswith(f"{arm}_")]
            for arm in ROBOT.arms
        }
        return [
            dataclasses.replace(effect, arm=arm, joints=joints)
            for arm, joints in arms.items()
            if joints
        ]
    if isinstance(effect, ArmEffect):
        return [dataclasses.replace(effect, arm=arm) for arm in rest]
    return (
        [dataclasses.replace(effect, pads=rest)]
        if isinstance(effect, TouchEffect) and rest
        else []
    )

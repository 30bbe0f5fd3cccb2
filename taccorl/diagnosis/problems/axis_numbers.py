"""Free numbers of a joint without a model (an axis): a slide on a bench, a motor with a
mass, a servo with a pendulum. ``JointProblem`` fits them in place of its own.

| number | fitted |
|---|---|
| torque_ff | always |
| inertia | unless both gains and efforts are unknown: positions determine ratios |
| weight | where the file states one, or efforts tell that of a slide |
| kp, kd | with efforts, within ``GAINS_WITHIN``: an error of a few per cent outweighs the
  friction of a fast drive; unknown ones (``gains: fitted``) within ``UNKNOWN_WITHIN`` |
| stall torque, back-EMF | of law pwm in place of gains, within ``WINDING_WITHIN`` |
| target_late_s | where targets are positions: a cycle of the loop shows in the data;
  below 0 where the file states no loop, as it is simulated by steps then, if at all |
| speed_late_s, or loop_s | unless both gains and efforts are unknown |
| effort_scale | held; fitted in place of the inertia where that decides |

Gains and times stay where recorded efforts are those of the file's law, row by row, to the
noise floor (``DRIVE_IS_STATED``): a fit would use them for what the joint lacks.
"""

import dataclasses
import math
from collections.abc import Iterator, Sequence

import numpy as np

from taccorl.alignment.controller.drive_law import WINDING, WINDING_WITHIN
from taccorl.alignment.controller.joint_model import GRAVITY_M_PER_S2
from taccorl.alignment.machines.robot_file import JointConfig
from taccorl.alignment.machines.robot_joint import RobotJoint
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.diagnosis.search.identifiable import EARLY_S, TIMING_S
from taccorl.diagnosis.search.problem import Free

GAINS_WITHIN = 1.25
"""Factor within which commanded gains are fitted, to both sides."""
UNKNOWN_WITHIN = 10.0
"""The same for gains that nobody knows (``gains: fitted``)."""
FILTER_PERIODS = 2.0
"""Bound of the fitted delay of the speed, in periods of the drive's loop: a mean over five
samples. A choice."""
WEIGHT_WITHIN = 3.0
"""Bound of the fitted weight's torque as a multiple of the file's, for both signs."""
MOST_TORQUE = 20.0
"""Bound of the constant torque [force units of the joint]."""
DRIVE_IS_STATED = 1.0
"""Largest error of the file's law [noise floors of the effort] at which the drive is as
stated: its gains and times are not fitted, and effects in it are no candidates."""
OF_DRIVE = ("command", "law")
"""Slots of effects in the drive."""
NO_CANDIDATES = ("armature", "gravity_mismatch")
"""More inertia is the inertia, which is fitted; an axis carries no weight by itself."""


def is_weighed(joint: RobotJoint, effort: bool) -> bool:
    """Whether the axis's own weight is fitted: the file states it, or efforts tell that
    of a slide from ``torque_ff``."""
    if joint.unit == "m":
        return effort and joint.config.law != "effort"
    return bool(joint.config.weight_sin or joint.config.weight_cos)


def no_candidates(joint: RobotJoint, effort: bool) -> tuple[str, ...]:
    """Effects whose influence is that of a fitted number."""
    if is_weighed(joint, effort):
        return (*NO_CANDIDATES, "unbalance")
    return NO_CANDIDATES


def of_motor(
    joint: RobotJoint, effort: bool, measurements: Sequence[Measurement]
) -> tuple[Free, ...]:
    """Numbers of the motor of law pwm, one of which explains as much as stall torque and
    back-EMF where no efforts were recorded (``Problem.of_file``). The file's supply is none
    where a recording has its own, which is then the supply."""
    known = {*joint.config.known}
    for m in measurements:
        if m.supply_v.size and np.isfinite(m.supply_v[:, m.column(joint.signal)]).any():
            known.add("supply_v")
    if joint.config.law != "pwm" or effort or {"stall_nm", "back_emf"} & known:
        return ()
    return tuple(
        _around(name, unit, value, WINDING_WITHIN)
        for name, (value, unit) in joint.config.numbers.items()
        if name in WINDING and name not in known
    )


def axis_numbers(
    joint: RobotJoint, torque_ff: Free, loop: Free, *, effort: bool, law_error: float
) -> tuple[Free, ...]:
    """The table of the module.

    Args:
        torque_ff: constant torque of a joint with a model, whose bounds are replaced.
        loop: period of the drive's loop, fitted where the file states none.
        effort: whether efforts are a channel.
        law_error: error of the file's law [noise floors of the effort].
    """
    config = joint.config
    found = [*_of_body(joint, torque_ff, effort)]
    if law_error > DRIVE_IS_STATED:
        found += _of_times(config, loop, effort)
        found += _of_drive(joint, effort)
    return tuple(found)


def _of_body(joint: RobotJoint, torque_ff: Free, effort: bool) -> Iterator[Free]:
    config, force, unit = joint.config, joint.scale.force, joint.scale.unit_of
    inertia = config.inertia or 0.0
    heavy = GRAVITY_M_PER_S2 * inertia if joint.unit == "m" else 0.0
    if effort or config.gains != "fitted":
        yield _around("inertia", unit("kg·m²"), inertia, 100.0)
    at = config.torque_ff
    most = max(MOST_TORQUE * force, 10.0 * abs(at), WEIGHT_WITHIN * heavy)
    yield dataclasses.replace(
        torque_ff, unit=unit("N·m"), start=at, low=-most, high=most, scale=force
    )
    if is_weighed(joint, effort):
        weight = max(math.hypot(config.weight_sin, config.weight_cos), heavy)
        names = ("weight_cos",) if joint.unit == "m" else ("weight_sin", "weight_cos")
        for name in names:
            yield Free(
                name=name,
                unit=unit("N·m"),
                start=getattr(config, name),
                low=-WEIGHT_WITHIN * weight,
                high=WEIGHT_WITHIN * weight,
                scale=0.1 * weight,
            )


def _of_times(config: JointConfig, loop: Free, effort: bool) -> Iterator[Free]:
    if config.target_kind == "position":
        at = config.target_late_s
        yield Free(
            name="target_late_s",
            unit="s",
            start=at,
            low=0.0 if config.loop_hz and at >= 0.0 else min(at, -EARLY_S),
            high=max(TIMING_S, at),
            scale=1e-4,
            unless=("command_delay",),
        )
    known = effort or config.gains != "fitted"
    if not (config.kd and config.law != "effort" and known):
        return
    if not config.loop_hz:
        yield loop
        return
    at = config.speed_late_s
    least = 0.0 if effort else TIMING_S
    yield Free(
        name="speed_late_s",
        unit="s",
        start=at,
        low=min(at, 0.0),
        high=max(FILTER_PERIODS / config.loop_hz, at, least),
        scale=1e-4,
    )


def _of_drive(joint: RobotJoint, effort: bool) -> Iterator[Free]:
    config, unit = joint.config, joint.scale.unit_of
    gains, unknown = config.loop_gains, config.gains == "fitted"
    if config.law == "pwm":
        numbers = {"stall_nm": config.stall_nm, "back_emf": config.back_emf}
        within = WINDING_WITHIN
    elif (effort or unknown) and config.law != "effort":
        numbers = {"kp": gains.kp, "kd": gains.kd}
        within = UNKNOWN_WITHIN if unknown else GAINS_WITHIN
    else:
        return
    units = {"stall_nm": "N·m", "kp": "N·m/rad"}
    for name, value in numbers.items():
        if value > 0.0:
            yield _around(name, unit(units.get(name, "N·m·s/rad")), value, within)


def _around(name: str, unit: str, value: float, within: float) -> Free:
    low, high = value / within, value * within
    return Free(name=name, unit=unit, start=value, low=low, high=high, log=True)

"""One joint of the twin as a loop over physics steps, compiled: ``LANES`` responses to 10 s of targets in about a millisecond.

    (J + ΔJ) q̈ = τ_motor + τ_friction − τ_weight(q) − d(t)

It takes the same steps as MuJoCo's discrete integrator does (``mjINT_DISCRETE``, found by experiment and shown in
``tests/alignment/controller/test_joint_model.py``): with spring K and damping D taken at the end of the step,

    v⁺ = v + h (τ − h K v + f) / M̂,    M̂ = J + h D + h² K,    q⁺ = q + h v⁺

and dry friction f within ± F from a soft constraint, M̂ a = τ − h K v + f, f = −(a − a_ref) / R. K_p and K_d belong to K and D
except while the motor's torque is at its limit. With play or a spring in the gear the link is a second mass.

A machine without a twin in MuJoCo (``Drive.midpoint``) takes K and D in the middle of the step instead, which is exact to the
second order in h:

    v⁺ = v + h (τ − ½ h K v + f) / M̂,    M̂ = J + ½ h D + ¼ h² K,    q⁺ = q + ½ h (v + v⁺)

Rows follow the rule of ``alignment.measurements.measurement``: row k is the joint at the time of command k, before it acts.
"""

import math
from collections.abc import Sequence
from hashlib import sha256
from pathlib import Path
from typing import Any

import numba
import numpy as np

from taccorl.alignment.controller import arriving as _arriving
from taccorl.alignment.controller import drive_numbers as _drive_numbers
from taccorl.alignment.controller import dry_friction as _dry_friction
from taccorl.alignment.controller import lanes as _lanes
from taccorl.alignment.controller.arriving import arriving, late_speed
from taccorl.alignment.controller.drive_numbers import FAMILIES, TORQUE, VELOCITY, Drive
from taccorl.alignment.controller.dry_friction import friction, soft_friction
from taccorl.alignment.controller.lanes import (
    LANES,
    compiled,
    decayed,
    fields_as,
    holds,
    load,
    power,
    sine_and_cosine,
    store,
    where,
)
from taccorl.sim.effects.friction import AT_RAD_PER_S, BRISTLE_DAMPING_S
from taccorl.sim.effects.gear import GEAR_KGM2, LIMIT_SHARE, LIMIT_TIME_S
from taccorl.sim.effects.load import STOP_DAMPING_S

_LIMIT_RATE = 2.0 / (LIMIT_SHARE * LIMIT_TIME_S)
_LIMIT_STIFFNESS = (
    1.0 / (LIMIT_SHARE * LIMIT_TIME_S) ** 2 * LIMIT_SHARE
)  # 1/s², times the impedance
_LIMIT_SOFTNESS = (1.0 - LIMIT_SHARE) / LIMIT_SHARE
_PLACES = ("command", "midpoint", "effort_after", "sensor_delay__delay_s")
_COMMAND, _MIDPOINT, _EFFORT_AFTER, _SENSOR_DELAY = map(Drive._fields.index, _PLACES)
_fields = fields_as(Drive)


@compiled
def _limited(p: Any, torque: Any, v: Any) -> Any:
    """What the motor's greatest torque and its torque–speed line leave of ``torque``."""
    most, stall = p.torque_saturation__torque_max_nm, p.torque_speed_limit__stall_nm
    if holds(stall < math.inf):
        driving = stall * max(
            1.0 - abs(v) / p.torque_speed_limit__no_load_rad_per_s, 0.0
        )
        most = where(
            stall < math.inf, min(most, where(torque * v > 0.0, driving, stall)), most
        )
    return min(max(torque, -most), most)


@compiled
def _of_direction(p: Any, torque: Any) -> Any:
    """Factor on the motor's torque, by the sign of what is asked of it."""
    return where(
        (torque < 0.0) & (p.commands_speed == 0.0), p.direction_gain__factor, 1.0
    )


@compiled
def _reading(p: Any, q: Any) -> Any:
    """What the encoder says."""
    seen = q + p.encoder_bias__bias_rad
    if holds(p.encoder_eccentricity__amplitude_rad != 0.0):
        seen += (
            p.encoder_eccentricity__amplitude_rad
            * sine_and_cosine(seen + p.encoder_eccentricity__phase_rad)[0]
        )
    return p.encoder_scale__factor * seen


@compiled
def _asked(
    p: Any,
    kind: float,
    command: Any,
    before: Any,
    q: Any,
    v: Any,
    integral: Any,
    of_position: Any,
    supply: float,
    on: float,
    added: float,
) -> Any:
    """The controller's torque, and how far it counts as a spring and a damper. ``before`` is the command until now: whether the
    error lies within the dead band is known from it. A sampled loop adds its newest error for a whole period, of which half is to
    come, to its ``integral``, and to that of the position's error in a cascade, ``of_position``. ``kind`` is ``Drive.command``;
    ``supply``, ``on`` and ``added`` are as in ``simulate``."""
    if kind == TORQUE:
        none = 0.0 * p.kp
        return on * (command + p.torque_ff), none, none
    if kind == VELOCITY:
        integral += 0.5 * p.speed_age * command
        asked = (
            p.kd * (command - v + p.integral_action__rate_per_s * integral)
            + p.torque_ff
            + added
        )
        return (
            on * asked,
            on * p.kd * p.integral_action__rate_per_s,
            on * p.kd,
        )  # ∫ q̇ dt is the position: a spring
    slope, angle, width = (
        p.encoder_scale__factor,
        _reading(p, q),
        p.error_deadband__width_rad,
    )
    if holds(p.encoder_eccentricity__amplitude_rad != 0.0):
        at = q + p.encoder_bias__bias_rad + p.encoder_eccentricity__phase_rad
        slope *= 1.0 + p.encoder_eccentricity__amplitude_rad * sine_and_cosine(at)[1]
    error = command - angle
    stiffness, damping = p.kp * p.encoder_scale__factor, p.kd * slope
    if holds(width > 0.0):
        far = (width <= 0.0) | (abs(before - angle) > width)
        error = where(
            far,
            error - where(width > 0.0, math.copysign(width, before - angle), 0.0),
            0.0,
        )
        stiffness = where(far, stiffness, 0.0)
    if holds(p.position_integral__rate_per_s > 0.0):
        # Its positions are as old as half a period, which gives back what the newest one takes away.
        newest = 0.5 * p.speed_age * command
        error += p.position_integral__rate_per_s * (of_position + newest)
    of_way = p.commands_speed * p.encoder_scale__factor
    stiffness += (
        of_way * (p.kd + 0.5 * p.speed_age * p.kp) * p.integral_action__rate_per_s
    )
    integral += 0.5 * p.speed_age * (command - of_way * q)
    by_error = p.kp * (error + p.integral_action__rate_per_s * integral)
    factor = where(
        (by_error < 0.0) & (p.commands_speed > 0.0), p.direction_gain__factor, 1.0
    )
    by_error, stiffness = factor * by_error, factor * stiffness
    asked = by_error - damping * v + p.torque_ff + added
    full = abs(asked) > p.duty_torque
    asked = where(full, math.copysign(p.duty_torque, asked), asked)
    stiffness, damping = where(full, 0.0, stiffness), where(full, 0.0, damping)
    asked, stiffness, damping = supply * asked, supply * stiffness, supply * damping
    asked, damping = asked - p.back_emf * v, damping + p.back_emf
    return on * asked, on * stiffness, on * damping


@compiled
def _two_masses(
    p: Any,
    m11: Any,
    m22: Any,
    link: Any,
    f1: Any,
    f2: Any,
    about: Any,
    free: Any,
    v: Any,
    limit: Any,
    step_s: float,
    with_soft: bool,
) -> Any:
    """Accelerations of motor and gear, M̂ = [[m11, link], [link, m22]] in (q, gear), under forces f1 and f2 and dry friction."""
    metric, pull = m11 - link * link / m22, f1 - link / m22 * f2
    if with_soft:
        pull += soft_friction(p, pull, metric, about, free, v, limit, step_s, step_s)
    pull += friction(pull, metric, about, v, limit, step_s)
    a1 = pull / metric
    return a1, (f2 - link * a1) / m22


def _sources() -> np.ndarray:
    """() array, an argument whose type is named after the sources of the kernel and the fields of ``Drive``. Numba looks for a
    compiled kernel by the types of its arguments and the date of its own file, not by what it imports."""
    modules = (_arriving, _drive_numbers, _dry_friction, _lanes, *FAMILIES)
    texts = [
        repr(Drive._fields).encode(),
        *(Path(str(m.__file__)).read_bytes() for m in modules),
    ]
    return np.zeros((), [("of_" + sha256(b"".join(texts)).hexdigest()[:16], "u1")])


_SOURCES = _sources()


def simulate(
    drive: Any, sent: np.ndarray, coupling: np.ndarray, *more: Any
) -> tuple[np.ndarray, np.ndarray]:
    """``simulate_all`` of one drive: reported (R,) [rad], torque (R,) [N·m]."""
    return simulate_all([drive], sent, [coupling], *more, 0)[0]


def simulate_all(
    drives: Sequence[Any], sent: np.ndarray, couplings: Sequence[np.ndarray], *more: Any
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Simulate a joint with each of ``drives``, ``LANES`` of them side by side, for given targets, from equilibrium: friction,
    bristles, integrator and delays are in their steady state. R is the number of rows, F that of loads per row.

    Args:
        drives: N rows of ``Drive``, of the same law, all with play or a spring in the gear or all without.
        sent: (R · parts,) targets [rad], each held for ``hold`` physics steps.
        couplings: N of (R · F,) torque [N·m] that must be held against the other joints' motion, linear in between.
        more: ``carrying``, (R · F,) torque [N·m] that the motor adds for gravity compensation besides that of the angle, linear
            in between; of each part the ``supply`` voltage divided by the one for which the gains are valid, the share of time
            for which the motor is ``on`` and the torque [N·m] that the controller ``added`` to its law, or that something
            besides the motor adds to that of a ``TORQUE``, (R · parts,) each;
            ``start``, the angle [rad] that the encoder reports at rest; ``hold``; ``parts``, targets per row; ``step_s``, the
            physics step; ``start_speed`` [rad/s] with which it starts instead of at rest; ``every``, physics steps from one
            answer to the next, 0: those of a row.

    Returns:
        N of reported (R,) [rad] and motor torque (R,) [N·m] at each row's time, before the row's targets act. The torque is
        within the limits of the motor. Read-only.
    """
    answers = []
    for first in range(0, len(drives), LANES):
        some = [*range(first, min(first + LANES, len(drives)))]
        lane = some + some[:1] * (LANES - len(some))
        numbers, loads = (
            np.array([x[k] for k in lane], float).T.copy() for x in (drives, couplings)
        )
        found = (
            _simulated(_SOURCES, numbers, sent, loads, *more)[:, :, : len(some)]
            .transpose(2, 0, 1)
            .copy()
        )
        found.flags.writeable = False
        answers += [(one[0], one[1]) for one in found]
    return answers


@numba.njit(cache=True)
def _simulated(
    sources: np.ndarray,
    numbers: np.ndarray,
    sent: np.ndarray,
    coupling: np.ndarray,
    *more: Any,
) -> np.ndarray:
    """(2, R, LANES) reported angles and torques of drives ``numbers`` (fields of ``Drive``, LANES) with loads ``coupling``
    (R · F, LANES)."""
    carrying, supply, on, added, start, hold, parts, step_s, start_speed, every = more
    p, h = _fields(numbers), step_s
    kind, midpoint, effort_after = (
        numbers[_COMMAND, 0],
        numbers[_MIDPOINT, 0] > 0.0,
        int(numbers[_EFFORT_AFTER, 0]),
    )
    steps_of_row = every if every > 0 else hold * parts
    rows = sent.size * hold // steps_of_row
    none = 0.0 * p.kp
    coulomb = p.coulomb_friction__torque_nm + p.asymmetric_friction__torque_nm
    one_way = p.asymmetric_friction__torque_nm * p.asymmetric_friction__asymmetry
    asymmetry = where(coulomb != 0.0, one_way / coulomb, 0.0)
    bend_rad = p.presliding__presliding_rad + p.coulomb_friction__presliding_rad
    viscous, drag = (
        p.viscous_friction__damping_nms_per_rad,
        p.quadratic_drag__drag_nms2_per_rad2,
    )
    sliding_nm, stribeck_speed = (
        p.stribeck_friction__torque_nm,
        p.stribeck_friction__stribeck_rad_per_s,
    )
    power_nm, yield_nm = p.power_law_friction__torque_nm, p.power_law_friction__yield_nm
    exponent, power_asymmetry = (
        p.power_law_friction__exponent,
        p.power_law_friction__asymmetry,
    )
    spot_nm, spot_angle = (
        p.position_dependent_friction__torque_nm,
        p.position_dependent_friction__angle_rad,
    )
    spot_width = p.position_dependent_friction__width_rad
    load_share, gear_share = p.load_friction__share, p.gear_friction__share
    cogging_nm, periods, phase = (
        p.cogging__torque_nm,
        p.cogging__periods,
        p.cogging__phase_rad,
    )
    spring_stiffness, spring_rest = (
        p.cable_spring__stiffness_nm_per_rad,
        p.cable_spring__rest_rad,
    )
    stop_stiffness, stop_angle = p.end_stop__stiffness_nm_per_rad, p.end_stop__angle_rad
    sine, cosine = sine_and_cosine(p.unbalance__hangs_at_rad)
    unbalance_sin, unbalance_cos = (
        p.unbalance__torque_nm * cosine,
        -p.unbalance__torque_nm * sine,
    )
    share_carried, integral_rate = (
        p.gravity_mismatch__share,
        p.integral_action__rate_per_s,
    )
    position_rate = p.position_integral__rate_per_s
    has_integral = (integral_rate > 0.0) | (position_rate > 0.0)
    lag_s, fade_rate = p.torque_lag__time_constant_s, p.torque_fade__rate_per_min / 60.0
    torque_scale, reverse_gain = p.torque_scale__factor, p.direction_gain__factor
    compliance = p.joint_compliance__compliance_rad_per_nm
    reported, effort = answers = np.empty((2, rows, LANES))
    command, shown_command = arriving(p, numbers, sent, hold, h)
    if kind == VELOCITY:
        shown_command = command
        for n in range(len(command)):
            store(
                command,
                n,
                where(load(command, n) < 0.0, reverse_gain, 1.0) * load(command, n),
            )
    is_late, carries = holds(p.sensor_delay__delay_s > 0.0), np.any(carrying != 0.0)
    readings = np.empty((len(command) if is_late else 0, LANES))
    gravity_sin, gravity_cos = (
        p.gravity_sin + unbalance_sin,
        p.gravity_cos + unbalance_cos,
    )
    weighs = (
        (gravity_sin != 0.0)
        | (gravity_cos != 0.0)
        | (p.compensation_sin != 0.0)
        | (p.compensation_cos != 0.0)
    )
    has_weight, half_play = holds(weighs), 0.5 * p.backlash__play_rad
    geared = holds((p.backlash__play_rad > 0.0) | (compliance > 0.0))
    ahead = (
        0.5 if midpoint and not geared else 1.0
    )  # share of a step by which springs and dampers are taken ahead
    early = 0.5 * h if midpoint and geared else 0.0
    into = where(
        (half_play > 0.0) & (compliance == 0.0), 1.0, 0.5 if midpoint else 1.0
    )  # of the gear; 1 damps it
    spring = where(compliance > 0.0, 1.0 / compliance, 0.0)
    spring_damping = p.joint_compliance__damping_s * spring
    whole_inertia = (
        p.inertia + p.armature__added_kgm2
    )  # without what the controller takes off
    slow_s, turned, lost, stiff_lost, shown_slow, shown_lead = late_speed(p)
    fresh_share = ahead * h / (ahead * h + slow_s)
    with_filter = holds(fresh_share < 1.0)
    ruled_inertia = whole_inertia - p.kd * lost
    ruled_inertia -= min(early * (p.kd + p.back_emf), 0.5 * ruled_inertia)
    link = p.inertia - p.rotor_inertia  # beyond the gear
    free = ruled_inertia * (link + GEAR_KGM2) - link * link
    motor_mobility, gear_mobility = (link + GEAR_KGM2) / free, ruled_inertia / free
    static = sliding_nm * (1.0 + p.stribeck_friction__stiction_share)
    has_bristle = sliding_nm > 0.0
    bristle = where(has_bristle, static / p.stribeck_friction__presliding_rad, 0.0)
    bristle_damping = BRISTLE_DAMPING_S * bristle
    bends = (bend_rad > 0.0) & (coulomb > 0.0)
    bending = where(bends, coulomb / bend_rad, 0.0)
    newest_share = where(lag_s > 0.0, ahead * h / (lag_s + ahead * h), 1.0)
    # Effects that no lane has are left out of the steps.
    with_bristle, with_bends, with_spot = (
        holds(has_bristle),
        holds(bends),
        holds(spot_nm > 0.0),
    )
    with_cogging, with_power, with_stop = (
        holds(cogging_nm != 0.0),
        holds(power_nm > 0.0),
        holds(stop_stiffness > 0.0),
    )
    with_integral = holds(integral_rate > 0.0)
    with_load = holds((load_share > 0.0) | (gear_share > 0.0))
    with_position_integral = holds(position_rate > 0.0)
    with_soft = holds(p.soft_friction__torque_nm > 0.0)
    # MuJoCo has it from its mass matrix with all joints free, relative to the joint's own inertia.
    free_share = where(
        p.free_inertia > 0.0,
        (p.free_inertia + p.armature__added_kgm2) / whole_inertia,
        1.0,
    )
    with_given = (with_load and not midpoint) or holds(reverse_gain != 1.0)
    rubs = (
        with_load
        or with_spot
        or with_power
        or holds((coulomb > 0.0) & (bend_rad <= 0.0))
    )

    # Where it is when the encoder reports ``start``, and what is in balance there.
    q, v, late_v = none + start, none + start_speed, none + start_speed
    for _ in range(20):
        q += start - _reading(p, q)
    gear, gear_v = none, none  # angle of the link against the motor, and its rate
    stop_side = where(q <= stop_angle, 1.0, -1.0)  # it is free where it stands
    weight, carried, wrong = none, none, (_reading(p, q) - q) * p.midpoint
    for _ in range(20):
        sine, cosine = sine_and_cosine(q + gear)
        weight = gravity_sin * sine + gravity_cos * cosine
        sine, cosine = sine_and_cosine(q + wrong + gear)
        carried = share_carried * (
            p.compensation_sin * sine + p.compensation_cos * cosine + carrying[0]
        )
        load_nm = weight + load(coupling, 0)
        if geared:
            hanging = -math.copysign(half_play, load_nm) - compliance * load_nm
            soft_end = (
                load_nm * _LIMIT_SOFTNESS * gear_mobility / _LIMIT_STIFFNESS
            )  # of the play
            hanging -= where(compliance == 0.0, soft_end, 0.0)
            gear = where(abs(load_nm) > 1e-9, hanging, gear)
    integral = came = of_position = came_of_position = none
    until_now = (
        none if kind == VELOCITY else load(command, 0)
    )  # who rests was commanded no velocity
    torque = _asked(
        p,
        kind,
        until_now,
        until_now,
        q,
        v,
        integral,
        of_position,
        supply[0],
        on[0],
        added[0],
    )[0]
    needed = (
        weight
        + load(coupling, 0)
        + spring_stiffness * (q - spring_rest)
        + coulomb * asymmetry
    )
    needed -= cogging_nm * sine_and_cosine(periods * q + phase)[0]
    if kind == TORQUE:
        needed -= added[0]
    holding = torque_scale * _of_direction(
        p, where(has_integral, needed, torque + carried)
    )
    missing = needed - holding * (torque + carried)
    speeds = (
        none + 1.0 if kind == VELOCITY else p.commands_speed
    )  # 1: the integral is that of a speed's error
    of_speed = none + 1.0 if kind == VELOCITY else p.kd / where(p.kp > 0.0, p.kp, 1.0)
    slow_went, late_went = (
        speeds * of_speed * turned * slow_s,
        speeds * of_speed * (lost - 0.5 * p.speed_age),
    )
    way = (0.0 if kind == VELOCITY else 1.0) * p.encoder_scale__factor
    # Of what is new in the integral, the share that is added before a step is solved; and the factor of the angle that the step
    # moves, which is subtracted afterwards.
    along = where(speeds > 0.0, ahead * speeds, 0.5 * p.midpoint)
    went = where(
        speeds > 0.0,
        1.0 if kind == VELOCITY else way * (of_speed + 0.5 * h),
        0.5 * p.midpoint * way * h,
    )
    of_error = integral_rate * (p.kd if kind == VELOCITY else p.kp)
    of_errors = of_error + position_rate * p.kp
    if with_integral or with_position_integral:
        most = coulomb + static + yield_nm + p.soft_friction__torque_nm
        seen_nm = p.start_nm + where(
            p.effort_holds_weight == 0.0, holding * carried, 0.0
        )
        rubbed = where(
            p.start_nm < math.inf, min(max(needed - seen_nm, -most), most), 0.0
        )
        integral = where(
            integral_rate > 0.0, (missing - rubbed) / (holding * of_error), 0.0
        )
        of_position = (
            where(  # beside the integral of a speed, whose error is 0 at rest, it is 0
                (position_rate > 0.0) & (integral_rate <= 0.0),
                (missing - rubbed) / (holding * of_errors),
                0.0,
            )
        )
        torque += where(has_integral, (missing - rubbed) / holding, 0.0)
        missing = where(has_integral, rubbed, missing)
    z = where(has_bristle, min(max(-missing, -static), static) / bristle, 0.0)
    missing += z * bristle
    bent = where(bends, min(max(-missing, -coulomb), coulomb) / bending, 0.0)
    acceleration, loads_per_step = none, len(coupling) / len(command)
    row, part, within, since = 0, 0, -1, -1
    for n in range(len(command)):
        within += 1
        since += 1
        if (
            since == hold
        ):  # counted, since an integer division takes as long as a tenth of the step
            since, part = 0, part + 1
        if within == steps_of_row:
            within, row = 0, row + 1
        strength = torque_scale * max(1.0 - fade_rate * n * h, 0.0)
        at = (n + 1.0 - ahead) * loads_per_step
        newest = min(int(at), len(coupling) - 1)
        after, share = min(newest + 1, len(coupling) - 1), at - newest
        if has_weight:
            sine, cosine = sine_and_cosine(q + gear)
            weight = gravity_sin * sine + gravity_cos * cosine
            if midpoint:
                wrong = _reading(p, q) - q
                if holds(wrong != 0.0):
                    sine, cosine = sine_and_cosine(q + wrong + gear)
            carried = share_carried * (
                p.compensation_sin * sine + p.compensation_cos * cosine
            )
        load_nm = (
            weight
            + load(coupling, newest)
            + share * (load(coupling, after) - load(coupling, newest))
        )
        if carries:
            more = carrying[newest] + share * (carrying[after] - carrying[newest])
            carried = share_carried * (
                p.compensation_sin * sine + p.compensation_cos * cosine + more
            )

        # What can be seen now: the new command has not acted yet.
        now, until_now = load(command, n), load(command, max(n - 1, 0))
        by = load(shown_command, max(n - 1, 0))
        if not midpoint:
            until_now = where(p.command_delay__delay_s > 0.0, now, until_now)
        given, acts = none, now if midpoint else until_now
        summed = (
            integral + slow_went * late_v + late_went * v
        )  # the sum of a late speed lacks so much of the way
        if with_given:
            given = _asked(
                p,
                kind,
                acts,
                acts,
                q,
                v,
                summed,
                of_position,
                supply[part],
                on[part],
                added[part],
            )[0]
            given = where(lag_s > 0.0, torque, given)
        if within == 0:
            if effort_after > 0:
                by = load(shown_command, n + hold * min(effort_after - 1, parts - 1))
            seen = part if effort_after > 0 else max(part - 1, 0)
            shown, by_position, by_speed = _asked(
                p,
                kind,
                by,
                by,
                q,
                v,
                summed,
                of_position,
                supply[part],
                on[part],
                added[seen],
            )
            by_speed -= on[part] * p.back_emf  # which has no age
            older = (
                p.effort_age * (by_position * v - of_errors * (by - way * q))
                + shown_lead * by_speed * acceleration
            )
            if with_filter:
                older += shown_slow * by_speed * (v - late_v)
            older = (
                where(lag_s > 0.0, lost * by_speed * acceleration, older)
                + by_position * stiff_lost * acceleration
            )
            shown = where(lag_s > 0.0, torque, shown)
            shown_strength = strength * _of_direction(p, shown + carried)
            given_weight = shown_strength * carried
            total = _limited(p, shown_strength * (shown + older) + given_weight, v)
            store(
                effort,
                row,
                where(p.effort_holds_weight == 0.0, total - given_weight, total),
            )
            store(reported, row, _reading(p, q))
            for lane in range(LANES):
                if numbers[_SENSOR_DELAY, lane] > 0.0:
                    late = max(numbers[_SENSOR_DELAY, lane] / h, 1.0)
                    whole = math.floor(late)
                    newer = readings[n - whole, lane] if n >= whole else start
                    before = readings[n - whole - 1, lane] if n > whole else start
                    reported[row, lane] = newer + (before - newer) * (late - whole)
        if is_late:
            store(readings, n, _reading(p, q))

        strength *= _of_direction(p, given + carried)
        if with_position_integral:
            came_of_position = h * (now - way * q)
            of_position += 0.5 * p.midpoint * came_of_position
        if (
            with_integral
        ):  # that of a speed is taken ahead as the position is, which is its other part
            came = h * (now - way * q)
            if with_position_integral:
                came += h * position_rate * of_position
            integral += along * came
            summed += along * came
        asked, stiffness, damping = _asked(
            p,
            kind,
            now,
            acts,
            q,
            v,
            summed,
            of_position,
            supply[part],
            on[part],
            added[part],
        )
        by_controller = (
            damping - on[part] * p.back_emf
        )  # 0 while the duty is at its end
        if with_filter:
            slow = turned * (1.0 - fresh_share) * by_controller
            asked, damping = asked + slow * (v - late_v), damping - slow
        if early > 0.0:  # K_p (q* − q(t − ½ h)) is K_p (q* − q) + ½ h K_p q̇
            asked, damping = asked + early * stiffness * v, damping - early * stiffness
        gain = newest_share * strength
        drawn = gain * asked + (strength - gain) * torque + strength * carried
        controller_stiffness, controller_damping = stiffness, damping
        taken = strength * (by_controller * lost + stiffness * stiff_lost)
        # With steps of second order it is the torque in the middle of the step that is compared with its limit.
        ruled = (
            drawn
            + taken * acceleration
            - 0.5 * h * p.midpoint * gain * (damping * acceleration + stiffness * v)
        )
        limited = _limited(p, ruled, v)
        cut = limited != ruled
        ruled_inertia = whole_inertia - taken
        ruled_inertia -= min(early * (by_controller + p.back_emf), 0.5 * ruled_inertia)
        drawn, inertia = (
            where(cut, limited, drawn),
            where(cut, whole_inertia, ruled_inertia),
        )
        stiffness, damping = (
            where(cut, 0.0, gain * stiffness),
            where(cut, 0.0, gain * damping),
        )

        force = (
            drawn - (viscous + drag * abs(v)) * v - spring_stiffness * (q - spring_rest)
        )
        if kind == TORQUE:
            force += added[part]
        damping += viscous + 2.0 * drag * abs(v)
        stiffness += spring_stiffness
        if with_stop:
            deep = stop_side * (q - stop_angle)
            hit = (
                (stop_stiffness > 0.0)
                & (deep > 0.0)
                & (deep + STOP_DAMPING_S * stop_side * v > 0.0)
            )
            hard = where(hit, stop_stiffness, 0.0)
            force -= where(
                hit, stop_stiffness * (q - stop_angle + STOP_DAMPING_S * v), 0.0
            )
            stiffness += hard
            damping += STOP_DAMPING_S * hard
        if with_cogging:
            wave_sine, wave_cosine = sine_and_cosine(periods * q + phase)
            force += cogging_nm * wave_sine
            # Only midpoint steps take a negative stiffness, bounded so that m11 stays above half of the inertia.
            least = (
                -0.5 * inertia / (ahead * h * ahead * h) if midpoint else 0.0 * inertia
            )
            stiffness += max(-cogging_nm * periods * wave_cosine, least)
        if with_bristle:
            shares = v / stribeck_speed
            most = sliding_nm + (static - sliding_nm) * decayed(shares * shares)[0]
            decay = where(has_bristle, bristle * abs(v) / most, 0.0)
            force -= bristle * z + bristle_damping * (v - decay * z)
            damping += bristle_damping
            kept, grown = decayed(decay * h)
            z = where(has_bristle, kept * z + grown * h * v, 0.0)
        force -= coulomb * asymmetry
        limit = where(bends, 0.0, coulomb)
        if with_bends:
            slips = where(
                bends, math.copysign(bent, v * bent) / bend_rad, 0.0
            )  # −1 … 1: 1 slides
            force -= bending * bent
            if midpoint:
                far = abs(ahead * h * v) / where(bends, bend_rad, 1.0)
                stiffness += bending * max(1.0 - slips, 0.0) * decayed(far)[1]
            else:
                force -= BRISTLE_DAMPING_S * bending * (v - slips * v)
                damping += BRISTLE_DAMPING_S * bending
        if with_load:
            motor_nm = (
                limited if midpoint else _limited(p, strength * (given + carried), v)
            )
            limit += load_share * abs(motor_nm + load_nm) + gear_share * abs(motor_nm)
        if with_spot:
            off = (q - spot_angle) / spot_width
            limit += where(spot_nm > 0.0, spot_nm * decayed(off * off)[0], 0.0)
        if with_power:
            grown = power_nm * power(abs(v) / AT_RAD_PER_S, exponent)
            one_sided = grown * (
                1.0 + where(v > 0.0, power_asymmetry, -power_asymmetry)
            )
            limit += yield_nm + where((power_nm > 0.0) & (v != 0.0), one_sided, 0.0)

        if ahead < 1.0 and has_weight:
            stiffness += where(weighs, gravity_sin * cosine - gravity_cos * sine, 0.0)
        elif (
            has_weight and not geared
        ):  # MuJoCo takes the torque of its DC motor ahead, but not the weight of bodies
            stiffness += max(unbalance_sin * cosine - unbalance_cos * sine, 0.0)
        f1 = force - load_nm - ahead * h * stiffness * v
        m11 = inertia + ahead * h * damping + ahead * ahead * h * h * stiffness
        if not geared:
            if with_soft:
                apparent = free_share * (whole_inertia if midpoint else m11)
                f1 += soft_friction(p, f1, m11, m11, apparent, v, limit, ahead * h, h)
            if rubs:
                f1 += friction(f1, m11, m11, v, limit, h)
            v_next = v + h * f1 / m11
        else:
            stretch = gear - min(max(gear, -half_play), half_play)
            pulled = (spring > 0.0) & ((half_play == 0.0) | (stretch != 0.0))
            m22 = (
                link
                + GEAR_KGM2
                + where(pulled, into * h * (spring_damping + into * h * spring), 0.0)
            )
            f2 = (
                where(
                    pulled,
                    -spring * (stretch + into * h * gear_v) - spring_damping * gear_v,
                    0.0,
                )
                - load_nm
            )
            about = m11 / (motor_mobility * inertia)
            apparent = free_share * (1.0 / motor_mobility if midpoint else about)
            a1, a2 = _two_masses(
                p, m11, m22, link, f1, f2, about, apparent, v, limit, h, with_soft
            )
            touches = (spring == 0.0) & (stretch != 0.0)
            if holds(touches):
                stiffer = 1.0 + h * _LIMIT_RATE + h * h * _LIMIT_STIFFNESS
                back = (
                    -(_LIMIT_RATE * gear_v + _LIMIT_STIFFNESS * (stretch + h * gear_v))
                    / stiffer
                )
                soft = _LIMIT_SOFTNESS * gear_mobility / stiffer
                b1, b2 = _two_masses(
                    p,
                    m11,
                    m22 + 1.0 / soft,
                    link,
                    f1,
                    f2 + back / soft,
                    about,
                    apparent,
                    v,
                    limit,
                    h,
                    with_soft,
                )
                pushes = touches & ((back - b2) * stretch <= 0.0)  # it never pulls
                a1, a2 = where(pushes, b1, a1), where(pushes, b2, a2)
            v_next = v + h * a1
            gear += h * (gear_v + into * h * a2)
            gear_v += h * a2
        acceleration = (v_next - v) / h
        later = controller_damping * acceleration + controller_stiffness * (
            v + ahead * h * acceleration
        )
        torque += newest_share / ahead * (asked - ahead * h * later - torque)
        moved = h * (ahead * v_next + (1.0 - ahead) * v)
        if with_bends:
            over = moved if midpoint else h * v
            kept = decayed(abs(over) / where(bends, bend_rad, 1.0))[0]
            bent = where(
                bends, kept * bent + (1.0 - kept) * math.copysign(bend_rad, over), 0.0
            )
        if with_integral:
            integral += (1.0 - along) * came - went * moved
        if with_position_integral:
            half = 0.5 * p.midpoint
            of_position += (1.0 - half) * came_of_position - half * way * h * moved
        if with_filter:
            late_v = where(
                fresh_share < 1.0,
                late_v + fresh_share / ahead * (moved / h - late_v),
                v_next,
            )
        q += moved
        v = v_next
    return answers

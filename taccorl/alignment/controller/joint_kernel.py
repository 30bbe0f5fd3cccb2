"""One joint of the twin as a loop over physics steps, compiled: a 10 s recording in about a millisecond.

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
from collections import namedtuple
from typing import Any, NamedTuple

import numba
import numpy as np

from taccorl.sim.effects import command as _command
from taccorl.sim.effects import drive as _drive
from taccorl.sim.effects import encoder as _encoder
from taccorl.sim.effects import friction as _friction_of_joints
from taccorl.sim.effects import gear as _gear
from taccorl.sim.effects import load as _load
from taccorl.sim.effects.effect import JOINT_SLOTS, ArmEffect
from taccorl.sim.effects.friction import AT_RAD_PER_S, BRISTLE_DAMPING_S, DRY_SHARE, DRY_TIME_S
from taccorl.sim.effects.gear import GEAR_KGM2, LIMIT_SHARE, LIMIT_TIME_S
from taccorl.sim.effects.load import STOP_DAMPING_S

# Of the twin's own constraints: effects/friction.py and gear.py.
_FRICTION_RATE = 2.0 / (DRY_SHARE * DRY_TIME_S)  # 1/s, MuJoCo's b = 2 / (d_max · time constant)
_FRICTION_SOFTNESS = (1.0 - DRY_SHARE) / DRY_SHARE
_LIMIT_RATE = 2.0 / (LIMIT_SHARE * LIMIT_TIME_S)
_LIMIT_STIFFNESS = 1.0 / (LIMIT_SHARE * LIMIT_TIME_S) ** 2 * LIMIT_SHARE  # 1/s², times the impedance
_LIMIT_SOFTNESS = (1.0 - LIMIT_SHARE) / LIMIT_SHARE
MOST_LOST = 0.9
"""Largest share of the inertia that a delay of the speed may subtract; a loop that loses all of it is unstable."""
_mixed = numba.njit(_command.mixed)
_STRIDE = _command.STRIDE


POSITION, VELOCITY, TORQUE = 0.0, 1.0, 2.0
"""Codes for the quantity that a command states (``Drive.command``)."""


class _Own(NamedTuple):
    """Fields of ``Drive`` that no effect sets, in SI units, N·m and rad (for a sliding axis N and m)."""

    # Controller: τ = K_p (q* − y) − K_d q̇ + T_ref.
    kp: float
    """K_p [N·m/rad]."""
    kd: float
    """K_d [N·m·s/rad]."""
    torque_ff: float
    """T_ref [N·m]."""
    # Rigid body.
    inertia: float
    """Inertia about the joint: link and rotor [kg·m²]."""
    rotor_inertia: float = 0.0
    """Share of ``inertia`` on the motor's side of the gear [kg·m²]."""
    gravity_sin: float = 0.0
    """S [N·m] in the weight's torque S sin q + C cos q, which the motor must hold."""
    gravity_cos: float = 0.0
    """C [N·m] in the same torque."""
    compensation_sin: float = 0.0
    """S [N·m] in the torque S sin q + C cos q that the motor adds for gravity compensation."""
    compensation_cos: float = 0.0
    """C [N·m] in the same torque."""
    # Drive.
    command: float = POSITION
    """Quantity that a command states: ``POSITION``, ``VELOCITY`` (τ = K_d (q̇* − q̇) + T_ref) or ``TORQUE`` (τ = τ* + T_ref)."""
    commands_speed: float = 0.0
    """1: the command is a speed, q̇* or K_p (q* − y) / K_d, as of a velocity loop or a cascade; 0: it is a torque."""
    duty_torque: float = math.inf
    """Torque of the whole supply voltage at rest [N·m], V k_t / R, to which the controller's torque is clipped
    before the back-EMF is subtracted."""
    back_emf: float = 0.0
    """Torque per speed that the back-EMF takes, k_t k_e / R [N·m·s/rad]."""
    effort_after: float = 0.0
    """1: the reported effort of a row was measured after the row's command acted; 1 + n: after a command that acts n parts of the
    row late; 0: before."""
    effort_holds_weight: float = 0.0
    """1: the reported effort includes the torque of the gravity compensation; 0: it does not."""
    effort_age: float = 0.0
    """Mean age of the reported effort relative to the acting one [s]: a sampled loop holds its output."""
    midpoint: float = 0.0
    """1: midpoint steps, weight compensated at the encoder's angle; 0: as MuJoCo: semi-implicit Euler, at the true angle."""
    dropped_commands__seed: float = 0.0
    """Seed of the commands that are lost."""


def _numbers() -> dict[str, float]:
    """``EFFECT__PARAMETER`` → value that does nothing, of all effects that this model has: what ``Effect.drive`` gives."""
    families = [vars(family).values() for family in (_command, _drive, _encoder, _friction_of_joints, _gear, _load)]
    own = {cls for members in families for cls in members if isinstance(cls, type) and issubclass(cls, ArmEffect)}
    absent = [cls() for cls in own if cls.slot in JOINT_SLOTS]
    # In alphabetical order: numba's cache knows a field by its place, and is renewed if there are more or if this file changes.
    return dict(sorted(pair for effect in absent for pair in (effect.drive() or {}).items()))


_OF_EFFECTS = {name: value for name, value in _numbers().items() if name not in _Own._fields}
Drive = namedtuple(
    "Drive", (*_Own._fields, *_OF_EFFECTS), defaults=(*_Own._field_defaults.values(), *_OF_EFFECTS.values())
)
"""One joint with its drive: the fields of ``_Own``, and ``EFFECT__PARAMETER`` of the effects, which do nothing by default.

``speed_delay__delay_s`` acts as an inertia smaller by K_d · delay (by at most ``MOST_LOST`` of it), except while the motor's
torque is at its limit. The motor supplies this torque, so that the effort contains it."""


@numba.njit(cache=True)
def _uniform(seed: float, count: int) -> float:
    """``effects.command.uniform`` of one command, in episode 0."""
    bits = _mixed(_mixed(np.uint64(seed) << np.uint64(32)) + np.uint64(count + 1) * np.uint64(_STRIDE))
    return (bits >> np.uint64(11)) * 2.0**-53


@numba.njit(cache=True)
def _arriving(drive: Any, sent: np.ndarray, hold: int, step_s: float) -> np.ndarray:
    """(S hold,) what the controller works on in each physics step, of targets (S,) held for ``hold`` steps each."""
    held_s = hold * step_s
    reached = (
        1.0
        if drive.command_lag__time_constant_s <= 0.0
        else 1.0 - math.exp(-held_s / drive.command_lag__time_constant_s)
    )
    lagging, goal, at, before = sent[0], sent[0], sent[0], sent[0]
    commands = np.empty(sent.size * hold)
    for k in range(sent.size):
        lagging += (sent[k] - lagging) * reached
        if (
            drive.dropped_commands__probability <= 0.0
            or _uniform(drive.dropped_commands__seed, k) >= drive.dropped_commands__probability
        ):
            goal = lagging
        furthest = drive.slew_limit__speed_rad_per_s * held_s
        at = min(max(goal, at - furthest), at + furthest)
        ahead = 0.0
        if drive.velocity_feedforward__share != 0.0 and drive.kp > 0.0:
            ahead = drive.velocity_feedforward__share * drive.kd / drive.kp * (at - before) / held_s
        before = at
        commands[k * hold : (k + 1) * hold] = at + ahead
    if drive.command_delay__delay_s <= 0.0:
        return commands
    # MuJoCo reads its history before it stores: one step at least.
    late = max(drive.command_delay__delay_s / step_s, 0.0 if drive.midpoint > 0.0 else 1.0)
    whole = math.floor(late)
    share = late - whole
    arriving = np.empty_like(commands)
    for n in range(commands.size):
        newer = commands[n - whole] if n >= whole else sent[0]
        older = commands[n - whole - 1] if n > whole else sent[0]
        arriving[n] = newer + (older - newer) * share
    return arriving


@numba.njit(cache=True)
def _friction(force: float, metric: float, mobility: float, v: float, limit: float, step_s: float) -> float:
    """MuJoCo's dry friction within ± ``limit`` on a mass ``metric`` that ``force`` acts on; ``mobility`` is MuJoCo's estimate of
    1 / metric."""
    soft = _FRICTION_SOFTNESS * mobility
    reference = -_FRICTION_RATE * v / (1.0 + step_s * _FRICTION_RATE)
    a = (force + reference / soft) / (metric + 1.0 / soft)
    return min(max((reference - a) / soft, -limit), limit)


@numba.njit(cache=True)
def _limited(p: Any, torque: float, v: float) -> float:
    """What the motor's greatest torque and its torque–speed line leave of ``torque``."""
    most = p.torque_saturation__torque_max_nm
    if p.torque_speed_limit__stall_nm < math.inf:
        driving = p.torque_speed_limit__stall_nm * max(1.0 - abs(v) / p.torque_speed_limit__no_load_rad_per_s, 0.0)
        most = min(most, driving if torque * v > 0.0 else p.torque_speed_limit__stall_nm)
    return min(max(torque, -most), most)


@numba.njit(cache=True)
def _of_direction(p: Any, torque: float) -> float:
    """Factor on the motor's torque, by the sign of what is asked of it."""
    return p.direction_gain__factor if torque < 0.0 and p.commands_speed == 0.0 else 1.0


@numba.njit(cache=True)
def _reading(p: Any, q: float) -> float:
    """What the encoder says."""
    seen = q + p.encoder_bias__bias_rad
    if p.encoder_eccentricity__amplitude_rad != 0.0:
        seen += p.encoder_eccentricity__amplitude_rad * math.sin(seen + p.encoder_eccentricity__phase_rad)
    return p.encoder_scale__factor * seen


@numba.njit(cache=True)
def _asked(
    p: Any, command: float, before: float, q: float, v: float, integral: float, supply: float, on: float, added: float
) -> tuple[float, float, float]:
    """The controller's torque, and how far it counts as a spring and a damper. ``before`` is the command until now: whether the
    error lies within the dead band is known from it. ``supply``, ``on`` and ``added`` are as in ``simulate``."""
    if p.command == TORQUE:
        return on * (command + p.torque_ff + added), 0.0, 0.0
    if p.command == VELOCITY:
        asked = p.kd * (command - v + p.integral_action__rate_per_s * integral) + p.torque_ff + added
        return on * asked, on * p.kd * p.integral_action__rate_per_s, on * p.kd  # ∫ q̇ dt is the position: a spring
    slope, angle = p.encoder_scale__factor, _reading(p, q)
    if p.encoder_eccentricity__amplitude_rad != 0.0:
        slope *= 1.0 + p.encoder_eccentricity__amplitude_rad * math.cos(
            q + p.encoder_bias__bias_rad + p.encoder_eccentricity__phase_rad
        )
    error = command - angle
    stiffness, damping = p.kp * p.encoder_scale__factor, p.kd * slope
    if p.error_deadband__width_rad > 0.0:
        if abs(before - angle) <= p.error_deadband__width_rad:
            error, stiffness = 0.0, 0.0
        else:
            error -= math.copysign(p.error_deadband__width_rad, before - angle)
    by_error = p.kp * (error + p.integral_action__rate_per_s * integral)
    if by_error < 0.0 and p.commands_speed > 0.0:
        by_error, stiffness = p.direction_gain__factor * by_error, p.direction_gain__factor * stiffness
    asked = by_error - damping * v + p.torque_ff + added
    if abs(asked) > p.duty_torque:
        asked, stiffness, damping = math.copysign(p.duty_torque, asked), 0.0, 0.0
    asked, stiffness, damping = supply * asked, supply * stiffness, supply * damping
    if p.back_emf != 0.0:
        asked, damping = asked - p.back_emf * v, damping + p.back_emf
    return on * asked, on * stiffness, on * damping


@numba.njit(cache=True)
def simulate(
    drive: Any,
    sent: np.ndarray,
    coupling: np.ndarray,
    carrying: np.ndarray,
    supply: np.ndarray,
    on: np.ndarray,
    added: np.ndarray,
    start: float,
    hold: int,
    parts: int,
    step_s: float,
    start_speed: float,
    every: int = 0,
) -> tuple[np.ndarray, np.ndarray]:
    """Simulate the joint for given targets, from equilibrium: friction, bristles, integrator and delays are in their steady
    state. R is the number of rows, F that of loads per row.

    Args:
        sent: (R · parts,) targets [rad], each held for ``hold`` physics steps.
        coupling: (R · F,) torque [N·m] that must be held against the other joints' motion, linear in between.
        carrying: (R · F,) torque [N·m] that the motor adds for gravity compensation besides that of the angle, linear in between.
        supply: (R · parts,) supply voltage divided by the one for which the gains are valid.
        on: (R · parts,) share of the time for which the motor is on.
        added: (R · parts,) torque [N·m] that the controller adds to its law.
        start: angle [rad] that the encoder reports at rest.
        parts: number of targets per row.
        step_s: physics step [s].
        start_speed: speed [rad/s] with which it starts instead of at rest.
        every: physics steps from one answer to the next; 0: those of a row.

    Returns:
        reported (R,) [rad] and motor torque (R,) [N·m] at each row's time, before the row's targets act. The torque is within
        the limits of the motor.
    """
    p, h = drive, step_s
    steps_of_row = every if every > 0 else hold * parts
    rows = sent.size * hold // steps_of_row
    # Numbers of effects under the names of their equations.
    coulomb = p.coulomb_friction__torque_nm + p.asymmetric_friction__torque_nm
    one_way = p.asymmetric_friction__torque_nm * p.asymmetric_friction__asymmetry
    asymmetry = one_way / coulomb if coulomb != 0.0 else 0.0
    bend_rad = p.presliding__presliding_rad + p.coulomb_friction__presliding_rad
    load_share = p.load_friction__share
    viscous, drag = p.viscous_friction__damping_nms_per_rad, p.quadratic_drag__drag_nms2_per_rad2
    sliding_nm, stribeck_speed = p.stribeck_friction__torque_nm, p.stribeck_friction__stribeck_rad_per_s
    power_nm, exponent = p.power_law_friction__torque_nm, p.power_law_friction__exponent
    power_asymmetry = p.power_law_friction__asymmetry
    spot_nm, spot_angle = p.position_dependent_friction__torque_nm, p.position_dependent_friction__angle_rad
    spot_width = p.position_dependent_friction__width_rad
    cogging_nm, periods, phase = p.cogging__torque_nm, p.cogging__periods, p.cogging__phase_rad
    spring_stiffness, spring_rest = p.cable_spring__stiffness_nm_per_rad, p.cable_spring__rest_rad
    stop_stiffness, stop_angle = p.end_stop__stiffness_nm_per_rad, p.end_stop__angle_rad
    unbalance_sin = p.unbalance__torque_nm * math.cos(p.unbalance__hangs_at_rad)
    unbalance_cos = -p.unbalance__torque_nm * math.sin(p.unbalance__hangs_at_rad)
    share_carried, integral_rate = p.gravity_mismatch__share, p.integral_action__rate_per_s
    lag_s, fade_rate = p.torque_lag__time_constant_s, p.torque_fade__rate_per_min / 60.0
    torque_scale, reverse_gain = p.torque_scale__factor, p.direction_gain__factor
    compliance = p.joint_compliance__compliance_rad_per_nm
    reported, effort = np.empty(rows), np.empty(rows)
    command = _arriving(p, sent, hold, h)
    if p.command == VELOCITY and reverse_gain != 1.0:
        command = np.where(command < 0.0, reverse_gain * command, command)
    late = 0.0 if p.sensor_delay__delay_s <= 0.0 else max(p.sensor_delay__delay_s / h, 1.0)
    whole = math.floor(late)
    ring = np.full(whole + 2, start)  # readings of the newest steps
    carries = np.any(carrying != 0.0)
    gravity_sin, gravity_cos = p.gravity_sin + unbalance_sin, p.gravity_cos + unbalance_cos
    weighs = gravity_sin != 0.0 or gravity_cos != 0.0 or p.compensation_sin != 0.0 or p.compensation_cos != 0.0
    geared = p.backlash__play_rad > 0.0 or compliance > 0.0
    half_play = 0.5 * p.backlash__play_rad
    ahead = (
        0.5 if p.midpoint > 0.0 and not geared else 1.0
    )  # share of a step by which springs and dampers are taken ahead
    early = 0.5 * h if p.midpoint > 0.0 and geared else 0.0
    spring = 1.0 / compliance if compliance > 0.0 else 0.0
    spring_damping = p.joint_compliance__damping_s * spring
    whole_inertia = p.inertia + p.armature__added_kgm2  # without what the controller takes off
    lost = min(p.kd * p.speed_delay__delay_s, MOST_LOST * whole_inertia)
    ruled_inertia = whole_inertia - lost
    ruled_inertia -= min(early * (p.kd + p.back_emf), 0.5 * ruled_inertia)
    inertia = ruled_inertia
    link = p.inertia - p.rotor_inertia  # beyond the gear
    free = inertia * (link + GEAR_KGM2) - link * link
    motor_mobility, gear_mobility = (link + GEAR_KGM2) / free, inertia / free
    static = sliding_nm * (1.0 + p.stribeck_friction__stiction_share)
    bristle = static / p.stribeck_friction__presliding_rad if sliding_nm > 0.0 else 0.0
    bristle_damping = BRISTLE_DAMPING_S * bristle
    bends = bend_rad > 0.0 and coulomb > 0.0
    bending = coulomb / bend_rad if bends else 0.0
    newest_share = 1.0 if lag_s <= 0.0 else h / (lag_s + h)

    # Where it is when the encoder reports ``start``, and what is in balance there.
    q, v = start, start_speed
    for _ in range(20):
        q += start - _reading(p, q)
    gear, gear_v = 0.0, 0.0  # angle of the link against the motor, and its rate
    stop_side = 1.0 if q <= stop_angle else -1.0  # it is free where it stands
    weight, carried, wrong = 0.0, 0.0, (_reading(p, q) - q) * p.midpoint
    for _ in range(20):
        sine, cosine = math.sin(q + gear), math.cos(q + gear)
        weight = gravity_sin * sine + gravity_cos * cosine
        sine, cosine = math.sin(q + wrong + gear), math.cos(q + wrong + gear)
        carried = share_carried * (p.compensation_sin * sine + p.compensation_cos * cosine + carrying[0])
        load = weight + coupling[0]
        if geared and abs(load) > 1e-9:
            gear = -math.copysign(half_play, load) - compliance * load
            if compliance == 0.0:  # the soft end of the play
                gear -= load * _LIMIT_SOFTNESS * gear_mobility / _LIMIT_STIFFNESS
    integral = 0.0
    until_now = 0.0 if p.command == VELOCITY else command[0]  # who rests was commanded no velocity
    torque = _asked(p, until_now, until_now, q, v, integral, supply[0], on[0], added[0])[0]
    needed = weight + coupling[0] + spring_stiffness * (q - spring_rest) + coulomb * asymmetry
    needed -= cogging_nm * math.sin(periods * q + phase)
    holding = torque_scale * _of_direction(p, needed if integral_rate > 0.0 else torque + carried)
    missing = needed - holding * (torque + carried)
    if integral_rate > 0.0:
        integral = missing / (holding * (p.kd if p.command == VELOCITY else p.kp) * integral_rate)
        torque += missing / holding
        missing = 0.0
    z = min(max(-missing, -static), static) / bristle if bristle > 0.0 else 0.0
    bent = 0.0
    if bends:
        missing += z * bristle
        bent = min(max(-missing, -coulomb), coulomb) / bending
    acceleration, loads_per_step = 0.0, coupling.size / command.size

    row, part, within, since = 0, 0, -1, -1
    for n in range(sent.size * hold):
        within += 1
        since += 1
        if since == hold:  # counted, since an integer division takes as long as a tenth of the step
            since, part = 0, part + 1
        if within == steps_of_row:
            within, row = 0, row + 1
        strength = torque_scale * max(1.0 - fade_rate * n * h, 0.0)
        at = (n + 1.0 - ahead) * loads_per_step
        newest = min(int(at), coupling.size - 1)
        after, share = min(newest + 1, coupling.size - 1), at - newest
        if weighs:
            sine, cosine = math.sin(q + gear), math.cos(q + gear)
            weight = gravity_sin * sine + gravity_cos * cosine
            wrong = (_reading(p, q) - q) * p.midpoint
            if wrong != 0.0:
                sine, cosine = math.sin(q + wrong + gear), math.cos(q + wrong + gear)
            carried = share_carried * (p.compensation_sin * sine + p.compensation_cos * cosine)
        load = weight + coupling[newest] + share * (coupling[after] - coupling[newest])
        if carries:
            more = carrying[newest] + share * (carrying[after] - carrying[newest])
            carried = share_carried * (p.compensation_sin * sine + p.compensation_cos * cosine + more)

        # What can be seen now: the new command has not acted yet.
        until_now = command[n if p.command_delay__delay_s > 0.0 and p.midpoint == 0.0 else max(n - 1, 0)]
        given = 0.0
        if load_share > 0.0 or reverse_gain != 1.0:
            given = torque
            if lag_s <= 0.0:
                by = command[n] if p.midpoint > 0.0 and reverse_gain != 1.0 else until_now
                given = _asked(p, by, until_now, q, v, integral, supply[part], on[part], added[part])[0]
        if within == 0:
            by = command[max(n - 1, 0)]  # also of a delayed one that comes now, which MuJoCo's force has already
            if p.effort_after > 0.0:
                by = command[n + hold * min(int(p.effort_after) - 1, parts - 1)]
            seen = part if p.effort_after > 0.0 else max(part - 1, 0)
            shown, by_position, by_speed = _asked(p, by, by, q, v, integral, supply[part], on[part], added[seen])
            if lag_s > 0.0:
                shown, by_position, by_speed = torque, 0.0, 0.0
            older = p.effort_age * (by_position * v + by_speed * acceleration)
            shown_strength = strength * _of_direction(p, shown + carried)
            given_weight = shown_strength * carried
            effort[row] = _limited(p, shown_strength * (shown + older) + lost * acceleration + given_weight, v)
            if p.effort_holds_weight == 0.0:
                effort[row] -= given_weight
            reported[row] = _reading(p, q)
            if late > 0.0:
                newer, older = ring[(n - whole) % ring.size], ring[(n - whole - 1) % ring.size]
                reported[row] = newer + (older - newer) * (late - whole)
        if late > 0.0:
            ring[n % ring.size] = _reading(p, q)

        # The drive.
        strength *= _of_direction(p, given + carried)
        if integral_rate > 0.0 and p.command == VELOCITY:
            integral += ahead * h * command[n]  # taken ahead as the position is, which is its other part
        asked, stiffness, damping = _asked(
            p, command[n], until_now, q, v, integral, supply[part], on[part], added[part]
        )
        if early > 0.0:  # K_p (q* − q(t − ½ h)) is K_p (q* − q) + ½ h K_p q̇
            asked, damping = asked + early * stiffness * v, damping - early * stiffness
        gain = newest_share * strength
        drawn = gain * asked + (strength - gain) * torque + strength * carried
        controller_stiffness, controller_damping = stiffness, damping
        stiffness, damping = gain * stiffness, gain * damping
        inertia = ruled_inertia
        limited = _limited(p, drawn + lost * acceleration, v)
        if limited != drawn + lost * acceleration:
            drawn, inertia = limited, whole_inertia
            stiffness, damping = 0.0, 0.0

        # What else turns the motor's shaft.
        force = drawn
        if viscous != 0.0 or drag != 0.0:
            force -= (viscous + drag * abs(v)) * v
            damping += viscous + 2.0 * drag * abs(v)
        if spring_stiffness != 0.0:
            force -= spring_stiffness * (q - spring_rest)
            stiffness += spring_stiffness
        if stop_stiffness > 0.0:
            deep = stop_side * (q - stop_angle)
            if deep > 0.0 and deep + STOP_DAMPING_S * stop_side * v > 0.0:
                force -= stop_stiffness * (q - stop_angle + STOP_DAMPING_S * v)
                stiffness += stop_stiffness
                damping += STOP_DAMPING_S * stop_stiffness
        if cogging_nm != 0.0:
            wave = periods * q + phase
            force += cogging_nm * math.sin(wave)
            stiffness += max(-cogging_nm * periods * math.cos(wave), 0.0)
        if bristle > 0.0:
            most = sliding_nm + (static - sliding_nm) * math.exp(-((v / stribeck_speed) ** 2))
            decay = bristle * abs(v) / most
            force -= bristle * z + bristle_damping * (v - decay * z)
            damping += bristle_damping
            if decay * h > 1e-12:
                z = z * math.exp(-decay * h) - v / decay * math.expm1(-decay * h)
            else:
                z += h * v
        force -= coulomb * asymmetry
        limit = 0.0 if bends else coulomb
        if bends:
            slips = math.copysign(bent, v * bent) / bend_rad  # −1 … 1: 1 slides
            force -= bending * bent
            if p.midpoint > 0.0:
                share = max(abs(ahead * h * v) / bend_rad, 1e-9)
                stiffness += bending * max(1.0 - slips, 0.0) * -math.expm1(-share) / share
            else:
                force -= BRISTLE_DAMPING_S * bending * (v - slips * v)
                damping += BRISTLE_DAMPING_S * bending
        if load_share > 0.0:
            limit += load_share * abs(_limited(p, strength * (given + carried), v) + load)
        if spot_nm > 0.0:
            limit += spot_nm * math.exp(-(((q - spot_angle) / spot_width) ** 2))

        if power_nm > 0.0 and v != 0.0:
            grown = power_nm * (abs(v) / AT_RAD_PER_S) ** exponent
            limit += grown * (1.0 + (power_asymmetry if v > 0.0 else -power_asymmetry))

        if ahead < 1.0 and weighs:
            stiffness += gravity_sin * cosine - gravity_cos * sine
        elif weighs and not geared:  # MuJoCo takes the torque of its DC motor ahead, but not the weight of bodies
            stiffness += max(unbalance_sin * cosine - unbalance_cos * sine, 0.0)
        f1 = force - load - ahead * h * stiffness * v
        m11 = inertia + ahead * h * damping + ahead * ahead * h * h * stiffness
        if not geared:
            if limit > 0.0:
                f1 += _friction(f1, m11, 1.0 / m11, v, limit, h)
            v_next = v + h * f1 / m11
        else:
            # Masses (motor, link): M̂ = [[m11, link], [link, m22]] in (q, gear).
            a1, a2, back = 0.0, 0.0, 0.0
            stretch = gear - min(max(gear, -half_play), half_play)
            m22, f2 = link + GEAR_KGM2, -load
            if spring > 0.0 and (half_play == 0.0 or stretch != 0.0):
                m22 += h * spring_damping + h * h * spring
                f2 -= spring * (stretch + h * gear_v) + spring_damping * gear_v
            for limited in (spring == 0.0 and stretch != 0.0, False):
                n22, g2 = m22, f2
                if limited:
                    stiffer = 1.0 + h * _LIMIT_RATE + h * h * _LIMIT_STIFFNESS
                    back = -(_LIMIT_RATE * gear_v + _LIMIT_STIFFNESS * (stretch + h * gear_v)) / stiffer
                    soft = _LIMIT_SOFTNESS * gear_mobility / stiffer
                    n22 += 1.0 / soft
                    g2 += back / soft
                metric, pull = m11 - link * link / n22, f1 - link / n22 * g2
                if limit > 0.0:
                    pull += _friction(pull, metric, motor_mobility * inertia / m11, v, limit, h)
                a1 = pull / metric
                a2 = (g2 - link * a1) / n22
                if not limited or (back - a2) * stretch <= 0.0:  # it pushes, it never pulls
                    break
            v_next = v + h * a1
            gear_v += h * a2
            gear += h * gear_v
        if lag_s > 0.0:  # as the step took it: at the step's end
            at_end = asked - controller_damping * (v_next - v) - controller_stiffness * h * v_next
            torque += newest_share * (at_end - torque)
        moved = h * (ahead * v_next + (1.0 - ahead) * v)
        if bends:
            over = moved if p.midpoint > 0.0 else h * v
            kept = math.exp(-abs(over) / bend_rad)
            bent = kept * bent + (1.0 - kept) * math.copysign(bend_rad, over)
        if integral_rate > 0.0:
            if p.command == VELOCITY:
                integral += (1.0 - ahead) * h * command[n] - moved
            else:
                integral += h * (command[n] - p.encoder_scale__factor * q)
        acceleration = (v_next - v) / h
        q += moved
        v = v_next
    return reported, effort

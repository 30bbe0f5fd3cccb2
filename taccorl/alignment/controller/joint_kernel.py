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
from typing import NamedTuple

import numba
import numpy as np

from taccorl.sim.effects import dropped_commands
from taccorl.sim.effects.power_law_friction import AT_RAD_PER_S

# Of the twin's own constraints: effects/coulomb_friction.py and backlash.py (solref, solimp), transmission.py (gear's inertia).
_FRICTION_RATE = 2.0 / (0.9999 * 0.002)  # 1/s, MuJoCo's b = 2 / (d_max · time constant)
_FRICTION_SOFTNESS = (1.0 - 0.9999) / 0.9999
_LIMIT_RATE = 2.0 / (0.99 * 0.002)
_LIMIT_STIFFNESS = 1.0 / (0.99 * 0.002) ** 2 * 0.99  # 1/s², times the impedance d = 0.99
_LIMIT_SOFTNESS = (1.0 - 0.99) / 0.99
_GEAR_INERTIA = 1e-5  # kg m²
_BRISTLE_DAMPING_S = 0.001  # over their stiffness, effects/stribeck_friction.py
_STOP_DAMPING_S = 0.005  # over its stiffness, effects/end_stop.py
MOST_LOST = 0.9
"""Largest share of the inertia that a delay of the speed may subtract; a loop that loses all of it is unstable."""
_mixed = numba.njit(dropped_commands.mixed)
_STRIDE = dropped_commands.STRIDE


POSITION, VELOCITY, TORQUE = 0.0, 1.0, 2.0
"""Codes for the quantity that a command states (``Drive.command``)."""


class Drive(NamedTuple):
    """One joint with its drive, in SI units, N·m and rad (for a sliding axis N and m). The default values have no effect."""

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
    unbalance_sin: float = 0.0
    """S [N·m] in a further weight S sin q + C cos q, which an effect adds."""
    unbalance_cos: float = 0.0
    """C [N·m] in the same torque."""
    compensation_sin: float = 0.0
    """S [N·m] in the torque S sin q + C cos q that the motor adds for gravity compensation."""
    compensation_cos: float = 0.0
    """C [N·m] in the same torque."""
    gravity_carried: float = 1.0
    """Factor on the torque that the motor adds for gravity compensation."""
    # Bodies and friction.
    added_inertia: float = 0.0
    """Inertia in addition to ``inertia``, on the motor's side [kg·m²]."""
    speed_delay: float = 0.0
    """Delay of the measured velocity in the controller [s]. Its effect is that of an inertia smaller by K_d · delay (by at most
    ``MOST_LOST`` of it), except while the motor's torque is at its limit. The motor supplies this torque, so that the effort
    contains it."""
    viscous: float = 0.0
    """Coefficient of viscous friction [N·m·s/rad]."""
    quadratic_drag: float = 0.0
    """c in the torque − c |v| v [N·m·s²/rad²]."""
    coulomb: float = 0.0
    """Dry friction F [N·m]."""
    asymmetry: float = 0.0
    """a in F (1 + a sign v), with F = ``coulomb``; a constant torque − a F is added."""
    stribeck_torque: float = 0.0
    """Sliding friction F_c of the Stribeck law [N·m]; at speed v it is F_c (1 + share · exp(−(v / speed)²))."""
    stribeck_share: float = 1.0
    """Static friction beyond F_c, as a share of F_c."""
    stribeck_speed: float = 0.05
    """Speed in that law [rad/s]."""
    presliding: float = 5e-4
    """Deflection at which the bristles hold the static friction [rad]."""
    coulomb_presliding: float = 0.0
    """Deflection at which the bristles of the dry friction ``coulomb`` approach it [rad]; 0: rigid."""
    power_torque: float = 0.0
    """F [N·m] in the friction F (1 + a sign v) (|v| / 0.1 rad/s)ⁿ against the motion (for a slide 0.1 m/s)."""
    power_exponent: float = 0.35
    """n in that friction."""
    power_asymmetry: float = 0.0
    """a in that friction."""
    load_friction: float = 0.0
    """μ in |τ| ≤ μ |τ_motor − τ_load|."""
    spot_friction: float = 0.0
    """F₀ [N·m] in the friction F₀ exp(−((q − q₀) / w)²), added to ``coulomb``."""
    spot_angle: float = 0.0
    """q₀ of the friction spot [rad]."""
    spot_width: float = 0.1
    """Width w of the friction spot [rad]."""
    cogging_torque: float = 0.0
    """A [N·m] in the added torque A sin(n q + φ)."""
    cogging_periods: float = 1.0
    """n: number of periods per turn."""
    cogging_phase: float = 0.0
    """φ [rad]."""
    spring_stiffness: float = 0.0
    """Stiffness of a spring at the joint [N·m/rad]."""
    spring_rest: float = 0.0
    """Position at which that spring is relaxed [rad]."""
    stop_stiffness: float = 0.0
    """Stiffness of an elastic end stop, which the joint touches beyond ``stop_angle`` [N·m/rad]; 0: there is no stop."""
    stop_angle: float = 0.0
    """Position of the stop [rad]; the side on which the joint starts is free."""
    # The command's way.
    command_delay: float = 0.0
    """Delay from sending a command until the controller has it [s]."""
    command_lag: float = 0.0
    """Time constant of a low-pass on commands [s]."""
    drop_probability: float = 0.0
    """Probability that a command is lost. The lost ones follow from ``drop_seed``."""
    drop_seed: float = 0.0
    """Seed of these draws."""
    slew_rate: float = math.inf
    """Largest rate of change of the command [rad/s]."""
    feedforward: float = 0.0
    """Factor α on the feed-forward K_d q̇*, which is added."""
    # The control loop.
    deadband: float = 0.0
    """Half width of the dead band of the position error [rad], in which the controller does not act."""
    integral_rate: float = 0.0
    """r in K_p r ∫ e dt [1/s]; of a velocity loop in K_d r ∫ (q̇* − q̇) dt."""
    torque_lag: float = 0.0
    """Time constant with which the motor's torque follows the controller's [s]."""
    torque_max: float = math.inf
    """Largest torque of the motor [N·m]."""
    stall_torque: float = math.inf
    """Stall torque [N·m]. Limit of the torque: stall torque × (1 − |v| / no-load speed) where the motor drives, stall torque
    where it brakes."""
    no_load_speed: float = math.inf
    """No-load speed in that limit [rad/s]."""
    torque_scale: float = 1.0
    """Factor from the controller's torque to the motor's."""
    reverse_gain: float = 1.0
    """Factor on the motor's torque where it is negative; with ``commands_speed`` on the commanded speed instead."""
    commands_speed: float = 0.0
    """1: the command is a speed, q̇* or K_p (q* − y) / K_d, as of a velocity loop or a cascade; 0: it is a torque."""
    fade_rate: float = 0.0
    """Rate at which the torque fades: factor (1 − rate · t) [1/s]."""
    command: float = POSITION
    """Quantity that a command states: ``POSITION``, ``VELOCITY`` (τ = K_d (q̇* − q̇) + T_ref) or ``TORQUE`` (τ = τ* + T_ref)."""
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
    """Integration method. 1: second-order midpoint steps; 0: the semi-implicit Euler steps of MuJoCo."""
    # Gear.
    backlash: float = 0.0
    """Width of the whole play [rad]."""
    compliance: float = 0.0
    """Deflection of the gear per torque [rad/(N·m)]; 0: stiff."""
    compliance_damping: float = 0.0
    """Damping of the gear divided by its stiffness [s]."""
    # Encoder: y = scale · (q' + wave · sin(q' + phase)) with q' = q + bias. The controller sees it at once, the report is late.
    encoder_scale: float = 1.0
    """Factor of the reported position."""
    encoder_bias: float = 0.0
    """Offset of the reported position [rad]."""
    encoder_delay: float = 0.0
    """Delay of the report [s]."""
    encoder_wave: float = 0.0
    """Amplitude of the reported position's error over a turn [rad]."""
    encoder_wave_phase: float = 0.0
    """Phase of that error [rad]."""


@numba.njit(cache=True)
def _uniform(seed: float, count: int) -> float:
    """``dropped_commands.uniform`` of one command, in episode 0."""
    bits = _mixed(_mixed(np.uint64(seed) << np.uint64(32)) + np.uint64(count + 1) * np.uint64(_STRIDE))
    return (bits >> np.uint64(11)) * 2.0**-53


@numba.njit(cache=True)
def _arriving(drive: Drive, sent: np.ndarray, hold: int, step_s: float) -> np.ndarray:
    """(S hold,) what the controller works on in each physics step, of targets (S,) held for ``hold`` steps each."""
    held_s = hold * step_s
    reached = 1.0 if drive.command_lag <= 0.0 else 1.0 - math.exp(-held_s / drive.command_lag)
    lagging, goal, at, before = sent[0], sent[0], sent[0], sent[0]
    commands = np.empty(sent.size * hold)
    for k in range(sent.size):
        lagging += (sent[k] - lagging) * reached
        if drive.drop_probability <= 0.0 or _uniform(drive.drop_seed, k) >= drive.drop_probability:
            goal = lagging
        furthest = drive.slew_rate * held_s
        at = min(max(goal, at - furthest), at + furthest)
        ahead = 0.0
        if drive.feedforward != 0.0 and drive.kp > 0.0:
            ahead = drive.feedforward * drive.kd / drive.kp * (at - before) / held_s
        before = at
        commands[k * hold : (k + 1) * hold] = at + ahead
    if drive.command_delay <= 0.0:
        return commands
    # MuJoCo reads its history before it stores: one step at least.
    late = max(drive.command_delay / step_s, 0.0 if drive.midpoint > 0.0 else 1.0)
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
def _limited(p: Drive, torque: float, v: float) -> float:
    """What the motor's greatest torque and its torque–speed line leave of ``torque``."""
    most = p.torque_max
    if p.stall_torque < math.inf:
        driving = p.stall_torque * max(1.0 - abs(v) / p.no_load_speed, 0.0)
        most = min(most, driving if torque * v > 0.0 else p.stall_torque)
    return min(max(torque, -most), most)


@numba.njit(cache=True)
def _of_direction(p: Drive, torque: float) -> float:
    """Factor on the motor's torque, by the sign of what is asked of it."""
    return p.reverse_gain if torque < 0.0 and p.commands_speed == 0.0 else 1.0


@numba.njit(cache=True)
def _reading(p: Drive, q: float) -> float:
    """What the encoder says."""
    seen = q + p.encoder_bias
    if p.encoder_wave != 0.0:
        seen += p.encoder_wave * math.sin(seen + p.encoder_wave_phase)
    return p.encoder_scale * seen


@numba.njit(cache=True)
def _asked(
    p: Drive, command: float, before: float, q: float, v: float, integral: float, supply: float, on: float, added: float
) -> tuple[float, float, float]:
    """The controller's torque, and how far it counts as a spring and a damper. ``before`` is the command until now: whether the
    error lies within the dead band is known from it. ``supply``, ``on`` and ``added`` are as in ``simulate``."""
    if p.command == TORQUE:
        return on * (command + p.torque_ff + added), 0.0, 0.0
    if p.command == VELOCITY:
        asked = p.kd * (command - v + p.integral_rate * integral) + p.torque_ff + added
        return on * asked, on * p.kd * p.integral_rate, on * p.kd  # ∫ q̇ dt is the position: a spring
    slope, angle = p.encoder_scale, _reading(p, q)
    if p.encoder_wave != 0.0:
        slope *= 1.0 + p.encoder_wave * math.cos(q + p.encoder_bias + p.encoder_wave_phase)
    error = command - angle
    stiffness, damping = p.kp * p.encoder_scale, p.kd * slope
    if p.deadband > 0.0:
        if abs(before - angle) <= p.deadband:
            error, stiffness = 0.0, 0.0
        else:
            error -= math.copysign(p.deadband, before - angle)
    by_error = p.kp * (error + p.integral_rate * integral)
    if by_error < 0.0 and p.commands_speed > 0.0:
        by_error, stiffness = p.reverse_gain * by_error, p.reverse_gain * stiffness
    asked = by_error - damping * v + p.torque_ff + added
    if abs(asked) > p.duty_torque:
        asked, stiffness, damping = math.copysign(p.duty_torque, asked), 0.0, 0.0
    asked, stiffness, damping = supply * asked, supply * stiffness, supply * damping
    if p.back_emf != 0.0:
        asked, damping = asked - p.back_emf * v, damping + p.back_emf
    return on * asked, on * stiffness, on * damping


@numba.njit(cache=True)
def simulate(
    drive: Drive,
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
    start_speed: float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Simulate the joint for given targets, from equilibrium: friction, bristles, integrator and delays are in their steady
    state. R is the number of rows.

    Args:
        sent: (R · parts,) targets [rad], each held for ``hold`` physics steps.
        coupling: (R,) torque [N·m] that must be held against the other joints' motion, linear in between.
        carrying: (R,) torque [N·m] that the motor adds for gravity compensation besides that of the angle, linear in between.
        supply: (R · parts,) supply voltage divided by the one for which the gains are valid.
        on: (R · parts,) share of the time for which the motor is on.
        added: (R · parts,) torque [N·m] that the controller adds to its law.
        start: angle [rad] that the encoder reports at rest.
        parts: number of targets per row.
        step_s: physics step [s].
        start_speed: speed [rad/s] with which it starts instead of at rest.

    Returns:
        reported (R,) [rad] and motor torque (R,) [N·m] at each row's time, before the row's targets act. The torque is within
        the limits of the motor.
    """
    p, h, rows = drive, step_s, sent.size // parts
    reported, effort = np.empty(rows), np.empty(rows)
    command = _arriving(p, sent, hold, h)
    if p.command == VELOCITY and p.reverse_gain != 1.0:
        command = np.where(command < 0.0, p.reverse_gain * command, command)
    late = 0.0 if p.encoder_delay <= 0.0 else max(p.encoder_delay / h, 1.0)
    whole = math.floor(late)
    ring = np.full(whole + 2, start)  # readings of the newest steps
    carries = np.any(carrying != 0.0)
    gravity_sin, gravity_cos = p.gravity_sin + p.unbalance_sin, p.gravity_cos + p.unbalance_cos
    weighs = gravity_sin != 0.0 or gravity_cos != 0.0 or p.compensation_sin != 0.0 or p.compensation_cos != 0.0
    geared = p.backlash > 0.0 or p.compliance > 0.0
    half_play = 0.5 * p.backlash
    ahead = (
        0.5 if p.midpoint > 0.0 and not geared else 1.0
    )  # share of a step by which springs and dampers are taken ahead
    early = 0.5 * h if p.midpoint > 0.0 and geared else 0.0
    spring = 1.0 / p.compliance if p.compliance > 0.0 else 0.0
    spring_damping = p.compliance_damping * spring
    whole_inertia = p.inertia + p.added_inertia  # without what the controller takes off
    lost = min(p.kd * p.speed_delay, MOST_LOST * whole_inertia)
    ruled_inertia = whole_inertia - lost
    ruled_inertia -= min(early * (p.kd + p.back_emf), 0.5 * ruled_inertia)
    inertia = ruled_inertia
    link = p.inertia - p.rotor_inertia  # beyond the gear
    free = inertia * (link + _GEAR_INERTIA) - link * link
    motor_mobility, gear_mobility = (link + _GEAR_INERTIA) / free, inertia / free
    static = p.stribeck_torque * (1.0 + p.stribeck_share)
    bristle = static / p.presliding if p.stribeck_torque > 0.0 else 0.0
    bristle_damping = _BRISTLE_DAMPING_S * bristle
    bends = p.coulomb_presliding > 0.0 and p.coulomb > 0.0
    bending = p.coulomb / p.coulomb_presliding if bends else 0.0
    newest_share = 1.0 if p.torque_lag <= 0.0 else h / (p.torque_lag + h)

    # Where it is when the encoder reports ``start``, and what is in balance there.
    q, v = start, start_speed
    for _ in range(20):
        q += start - _reading(p, q)
    gear, gear_v = 0.0, 0.0  # angle of the link against the motor, and its rate
    stop_side = 1.0 if q <= p.stop_angle else -1.0  # it is free where it stands
    weight, carried = 0.0, 0.0
    for _ in range(20):
        sine, cosine = math.sin(q + gear), math.cos(q + gear)
        weight = gravity_sin * sine + gravity_cos * cosine
        carried = p.gravity_carried * (p.compensation_sin * sine + p.compensation_cos * cosine + carrying[0])
        load = weight + coupling[0]
        if geared and abs(load) > 1e-9:
            gear = -math.copysign(half_play, load) - p.compliance * load
            if p.compliance == 0.0:  # the soft end of the play
                gear -= load * _LIMIT_SOFTNESS * gear_mobility / _LIMIT_STIFFNESS
    integral = 0.0
    until_now = 0.0 if p.command == VELOCITY else command[0]  # who rests was commanded no velocity
    torque = _asked(p, until_now, until_now, q, v, integral, supply[0], on[0], added[0])[0]
    needed = weight + coupling[0] + p.spring_stiffness * (q - p.spring_rest) + p.coulomb * p.asymmetry
    needed -= p.cogging_torque * math.sin(p.cogging_periods * q + p.cogging_phase)
    holding = p.torque_scale * _of_direction(p, needed if p.integral_rate > 0.0 else torque + carried)
    missing = needed - holding * (torque + carried)
    if p.integral_rate > 0.0:
        integral = missing / (holding * (p.kd if p.command == VELOCITY else p.kp) * p.integral_rate)
        torque += missing / holding
        missing = 0.0
    z = min(max(-missing, -static), static) / bristle if bristle > 0.0 else 0.0
    bent = 0.0
    if bends:
        missing += z * bristle
        bent = min(max(-missing, -p.coulomb), p.coulomb) / bending
    acceleration = 0.0
    steps_of_row = hold * parts

    row, part, within, since = 0, 0, -1, -1
    for n in range(sent.size * hold):
        within += 1
        since += 1
        if since == hold:  # counted, since an integer division takes as long as a tenth of the step
            since, part = 0, part + 1
        if within == steps_of_row:
            within, row = 0, row + 1
        strength = p.torque_scale * max(1.0 - p.fade_rate * n * h, 0.0)
        share = (within + 1.0 - ahead) / steps_of_row if row + 1 < rows else 0.0
        if weighs:
            sine, cosine = math.sin(q + gear), math.cos(q + gear)
            weight = gravity_sin * sine + gravity_cos * cosine
            carried = p.gravity_carried * (p.compensation_sin * sine + p.compensation_cos * cosine)
        load = weight + coupling[row]
        if row + 1 < rows:
            load += share * (coupling[row + 1] - coupling[row])
        if carries:
            more = carrying[row] if row + 1 == rows else carrying[row] + share * (carrying[row + 1] - carrying[row])
            carried = p.gravity_carried * (p.compensation_sin * sine + p.compensation_cos * cosine + more)

        # What can be seen now: the new command has not acted yet.
        until_now = command[n if p.command_delay > 0.0 and p.midpoint == 0.0 else max(n - 1, 0)]
        given = 0.0
        if p.load_friction > 0.0 or p.reverse_gain != 1.0:
            given = torque
            if p.torque_lag <= 0.0:
                by = command[n] if p.midpoint > 0.0 and p.reverse_gain != 1.0 else until_now
                given = _asked(p, by, until_now, q, v, integral, supply[part], on[part], added[part])[0]
        if within == 0:
            by = until_now
            if p.effort_after > 0.0:
                by = command[n + hold * min(int(p.effort_after) - 1, parts - 1)]
            seen = part if p.effort_after > 0.0 else max(part - 1, 0)
            shown, by_position, by_speed = _asked(p, by, by, q, v, integral, supply[part], on[part], added[seen])
            if p.torque_lag > 0.0:
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
        if p.integral_rate > 0.0 and p.command == VELOCITY:
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
        if p.viscous != 0.0 or p.quadratic_drag != 0.0:
            force -= (p.viscous + p.quadratic_drag * abs(v)) * v
            damping += p.viscous + 2.0 * p.quadratic_drag * abs(v)
        if p.spring_stiffness != 0.0:
            force -= p.spring_stiffness * (q - p.spring_rest)
            stiffness += p.spring_stiffness
        if p.stop_stiffness > 0.0:
            deep = stop_side * (q - p.stop_angle)
            if deep > 0.0 and deep + _STOP_DAMPING_S * stop_side * v > 0.0:
                force -= p.stop_stiffness * (q - p.stop_angle + _STOP_DAMPING_S * v)
                stiffness += p.stop_stiffness
                damping += _STOP_DAMPING_S * p.stop_stiffness
        if p.cogging_torque != 0.0:
            wave = p.cogging_periods * q + p.cogging_phase
            force += p.cogging_torque * math.sin(wave)
            stiffness += max(-p.cogging_torque * p.cogging_periods * math.cos(wave), 0.0)
        if bristle > 0.0:
            most = p.stribeck_torque + (static - p.stribeck_torque) * math.exp(-((v / p.stribeck_speed) ** 2))
            decay = bristle * abs(v) / most
            force -= bristle * z + bristle_damping * (v - decay * z)
            damping += bristle_damping
            if decay * h > 1e-12:
                z = z * math.exp(-decay * h) - v / decay * math.expm1(-decay * h)
            else:
                z += h * v
        force -= p.coulomb * p.asymmetry
        limit = 0.0 if bends else p.coulomb
        if bends:
            slips = math.copysign(bent, v * bent) / p.coulomb_presliding  # −1 … 1: 1 slides
            force -= bending * bent
            if p.midpoint > 0.0:
                share = max(abs(ahead * h * v) / p.coulomb_presliding, 1e-9)
                stiffness += bending * max(1.0 - slips, 0.0) * -math.expm1(-share) / share
            else:
                force -= _BRISTLE_DAMPING_S * bending * (v - slips * v)
                damping += _BRISTLE_DAMPING_S * bending
        if p.load_friction > 0.0:
            limit += p.load_friction * abs(_limited(p, strength * (given + carried), v) + load)
        if p.spot_friction > 0.0:
            limit += p.spot_friction * math.exp(-(((q - p.spot_angle) / p.spot_width) ** 2))

        if p.power_torque > 0.0 and v != 0.0:
            grown = p.power_torque * (abs(v) / AT_RAD_PER_S) ** p.power_exponent
            limit += grown * (1.0 + (p.power_asymmetry if v > 0.0 else -p.power_asymmetry))

        if ahead < 1.0 and weighs:
            stiffness += gravity_sin * cosine - gravity_cos * sine
        elif weighs and not geared:  # MuJoCo takes the torque of its DC motor ahead, but not the weight of bodies
            stiffness += max(p.unbalance_sin * cosine - p.unbalance_cos * sine, 0.0)
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
            m22, f2 = link + _GEAR_INERTIA, -load
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
        if p.torque_lag > 0.0:  # as the step took it: at the step's end
            at_end = asked - controller_damping * (v_next - v) - controller_stiffness * h * v_next
            torque += newest_share * (at_end - torque)
        moved = h * (ahead * v_next + (1.0 - ahead) * v)
        if bends:
            over = moved if p.midpoint > 0.0 else h * v
            kept = math.exp(-abs(over) / p.coulomb_presliding)
            bent = kept * bent + (1.0 - kept) * math.copysign(p.coulomb_presliding, over)
        if p.integral_rate > 0.0:
            if p.command == VELOCITY:
                integral += (1.0 - ahead) * h * command[n] - moved
            else:
                integral += h * (command[n] - p.encoder_scale * q)
        acceleration = (v_next - v) / h
        q += moved
        v = v_next
    return reported, effort

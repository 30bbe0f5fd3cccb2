"""The surrogate robot's arm: rigid bodies, a drive with friction, gear and sampled controller, computed independently of the
twin.

    M(q) q̈ + c(q, q̇) + g(q) = τ                      six joints, M by composite bodies, c and g by Newton–Euler recursion
    τ_j = τ_drive − LuGre friction − …                equation of the joint with hidden effects; the others have the paper's gains

Intended differences from the twin: no MuJoCo anywhere; 0.125 ms steps (the twin: 0.83 ms), M, c and g computed every millisecond
for half a millisecond later, implicit damping of the drive; bristle friction (Canudas de Wit et al. 1995) instead of a
constraint; gravity compensation by a model that the controller evaluates at the encoders' angles; a gear with contact stiffness;
coloured disturbance torques on every joint. The controller of the joint under test is one of two:

    continuous   positions are sampled at 1 kHz with jitter, the drive's velocity loop is continuous
                 (K_d / J is up to 6000/s on the paper's drives, which no loop at 1 kHz could damp)
    sampled      the whole loop runs at ``1 / loop_s``: velocity is the difference of two encoder readings through a first-order
                 low-pass, and the torque is held until the next sample

Letters in shapes: 6 joints, T commands (200 Hz), M milliseconds.
"""

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numba
import numpy as np

from taccorl.surrogate.arm import (
    GRAVITY,
    NUM_JOINTS,
    Bodies,
    factor,
    mass_matrix,
    solve,
    torques,
)

SUBSTEPS = 8  # Number of integration steps per millisecond
STEP_S = 1e-3 / SUBSTEPS  # Integration step [s]
COMMAND_MS = 5  # Period of commands [ms]: they come at 200 Hz and are held
Values = dict[str, float]  # Name of a parameter → value in its unit


class Drive(NamedTuple):
    """Parameters of drive, gear and friction of the joint under test, in rad, N·m, s. By default effects are absent."""

    kp: float  # K_p [N·m/rad]
    kd: float  # K_d [N·m·s/rad]
    torque_ff: float  # T_ref [N·m]
    # friction
    viscous: float = 0.0  # Coefficient of viscous friction [N·m·s/rad]
    quadratic: float = 0.0  # c in the torque − c |v| v [N·m·s²/rad²]
    coulomb: float = 0.0  # Dry friction [N·m]
    asymmetry: float = 0.0  # a in the factor 1 ± a on the dry friction, + upwards
    stribeck: float = 0.0  # Torque that stiction adds to ``coulomb`` [N·m]
    stribeck_speed: float = 0.05  # Speed at which stiction has fallen to 1/e [rad/s]
    presliding: float = (
        3e-5  # Deflection of the bristles at the break-away torque [rad]
    )
    load_share: float = 0.0  # Dry friction per torque through the joint
    gear_share: float = 0.0  # Dry friction per torque of the motor
    angle_share: float = 0.0
    """Relative variation of the friction torque with the angle, with two periods per turn (not in the registry)."""
    angle_phase: float = 0.0  # Phase of that variation [rad]
    spot: float = 0.0  # Friction torque that a tight spot adds in its middle [N·m]
    spot_angle: float = 0.0  # Angle of the tight spot's middle [rad]
    spot_width: float = 0.1  # w in its shape exp(−(q / w)²) [rad]
    # torques that hang on the angle
    stop: float = 0.0  # Stiffness of an end stop [N·m/rad], on the far side of ``stop_angle`` from the start
    stop_angle: float = 0.0  # Angle at which the end stop begins [rad]
    cogging: float = 0.0  # Amplitude of the cogging torque [N·m]
    cogging_periods: float = 12.0  # Its periods per turn
    cogging_phase: float = 0.0  # Its phase [rad]
    spring: float = 0.0  # Stiffness of a spring at the joint [N·m/rad]
    spring_rest: float = 0.0  # Angle at which that spring is relaxed [rad]
    hysteresis: float = 0.0  # Largest torque of a magnetic hysteresis (Bouc–Wen) [N·m] (not in the registry)
    hysteresis_width: float = (
        0.05  # Travel after which the hysteresis torque is reached [rad]
    )
    hung_inertia: float = 0.0  # Inertia that is coupled to the link by a spring [kg·m²] (not in the registry)
    hung_rad_per_s: float = (
        30.0  # Natural frequency of the inertia ``hung_inertia`` on its spring [rad/s]
    )
    hung_damping: float = (
        0.05  # Damping ratio of the inertia ``hung_inertia`` on its spring
    )
    # setpoint
    delay: float = 0.0  # Delay of commands [s]
    lag: float = 0.0  # Time constant of a low-pass on commands [s]
    slew: float = math.inf  # Largest rate of change of the command [rad/s]
    feedforward: float = 0.0  # Factor on the feed-forward K_d q̇*
    # loop
    deadband: float = 0.0  # Half width of the dead band of the position error [rad]
    integral: float = 0.0  # r in K_p r ∫ e dt [1/s]
    loop_steps: int = 0
    """Number of integration steps between two samples of a sampled loop; 0: the velocity loop is continuous."""
    velocity_filter: float = (
        0.0  # Time constant of the low-pass of the velocity in a sampled loop [s]
    )
    loop_delay: float = 0.0  # Delay from the encoder to the torque, for position and velocity [s] (not in the registry)
    torque_lag: float = (
        0.0  # Time constant with which the motor's torque follows the controller's [s]
    )
    torque_max: float = math.inf  # Largest torque of the motor [N·m]
    stall: float = math.inf
    """Torque of the motor at rest [N·m]; when it drives, the torque falls linearly with the speed to 0 at ``no_load``."""
    no_load: float = math.inf  # Speed at which a driving motor has no torque [rad/s]
    torque_scale: float = 1.0  # Factor from the controller's torque to the motor's
    one_way: float = 0.0  # Share by which torques upwards are larger, and downwards smaller (not in the registry)
    sag: float = 0.0
    """Sag of the supply voltage: torques are divided by 1 + this times the motor's power [1/W] (not in the registry)."""
    sag_time: float = 0.05  # Time constant of the sag [s]
    fade: float = 0.0  # Rate at which the torque fades [1/s]
    warm_up: float = 0.0  # Rate at which the friction torque falls as grease warms up [1/s] (not in the registry)
    # gear
    motor_inertia: float = 0.01  # Inertia of the rotor at the joint [kg·m²]
    play: float = 0.0  # Width of the whole play of the gear [rad]
    compliance: float = 0.0  # Deflection of the gear per torque [rad/(N·m)]; 0: stiff
    compliance_damping: float = (
        0.002  # Damping of the gear divided by its stiffness [s]
    )
    # encoder in the loop
    encoder_scale: float = 1.0  # Factor of the reported angle
    encoder_bias: float = 0.0  # Offset of the reported angle [rad]
    encoder_wave: float = 0.0  # Amplitude of the encoder's sinusoidal error [rad]
    encoder_waves: float = 1.0
    """Periods of the encoder's error per turn: 1 for an eccentric disc, other values are not in the registry."""
    encoder_phase: float = 0.0  # Its phase [rad]


@dataclass(frozen=True, kw_only=True)
class Change:
    """Change of the plant by a hidden effect."""

    drive: Values = field(default_factory=dict)
    """Changes of fields of ``Drive``. Torques, inertias and delays are added, ``torque_scale`` is multiplied, others are
    replaced."""
    carried: float = (
        1.0  # Factor on the share of the weight that the controller compensates
    )
    ball: tuple[float, float, float, float] | None = None
    """Point mass fixed to the arm's last link: mass [kg], then its position x, y, z in the frame of link 6 [m]. None: no mass is
    added."""
    report_delay_s: float = 0.0  # Delay of the reported angles [s]
    dropped: float = 0.0
    """Probability that a command is lost, 0 … 1. The lost commands are drawn anew for each recording."""


_ADD = (
    "viscous",
    "quadratic",
    "coulomb",
    "stribeck",
    "motor_inertia",
    "cogging",
    "delay",
    "integral",
    "encoder_bias",
)


def changed(drive: Drive, changes: list[Change]) -> Drive:
    """A copy of ``drive`` with the changes of all hidden effects."""
    for change in changes:
        for name, value in change.drive.items():
            before = getattr(drive, name)
            if name in _ADD:
                value = before + value
            elif name in ("torque_scale", "encoder_scale"):
                value = before * value
            drive = drive._replace(**{name: value})
    return drive


class Arm(NamedTuple):
    """The arm and its six drives; that of the joint under test is described by its ``Drive``."""

    bodies: Bodies  # True rigid bodies
    believed: Bodies  # Rigid bodies with which the controller computes the gravity compensation
    carried: float  # Share of the weight computed from ``believed`` that the controller compensates, 0 … 1
    armature: np.ndarray  # (6,) rotor inertias [kg·m²]
    kp: (
        np.ndarray
    )  # (6,) K_p of the drives [N·m/rad]; that of the joint under test is not used
    kd: np.ndarray  # (6,) K_d of the drives [N·m·s/rad]; as for ``kp``
    torque_ff: np.ndarray  # (6,) T_ref of the drives [N·m]; as for ``kp``


class Run(NamedTuple):
    """State of the arm at every millisecond, before the controller acts."""

    angle: (
        np.ndarray
    )  # (M, 6) true angles of the motors, on the motor's side of the gear [rad]
    velocity: np.ndarray  # (M, 6) velocities of the motors [rad/s]
    effort: (
        np.ndarray
    )  # (M, 6) motor torques without gravity compensation, half a millisecond old [N·m]


@numba.njit(cache=True)
def encoder(d: Drive, angle):
    """Reading [rad] of the tested joint's encoder at ``angle`` [rad], a number or an array of any shape: scale, bias and a
    sinusoidal error; not quantised."""
    return (
        d.encoder_scale * angle
        + d.encoder_bias
        + d.encoder_wave * np.sin(d.encoder_waves * angle + d.encoder_phase)
    )


@numba.njit(cache=True, inline="always")
def _arrived(target, joint, ms, delay_ms, window_ms):
    """Command on average over the window that begins at ``ms``; rows change every 5 ms."""
    begin = ms - delay_ms
    row = math.floor(begin / COMMAND_MS)
    share = min(1.0, ((row + 1) * COMMAND_MS - begin) / window_ms)
    last = target.shape[0] - 1
    now, following = min(max(row, 0), last), min(max(row + 1, 0), last)
    return target[now, joint] * share + target[following, joint] * (1.0 - share)


@numba.njit(cache=True)
def simulate(
    arm: Arm, joint: int, d: Drive, target, start, disturbance, jitter, lead_ms: int
) -> Run:
    """Simulate the arm with targets ``target`` (T, 6) [rad] at 200 Hz, after ``lead_ms`` in which it comes to rest at the first
    target.

    Args:
        joint: index of the joint to which ``d`` belongs, 0 to 5.
        start: (6,) angles at rest at the beginning [rad].
        disturbance: (lead_ms + 5 T, 6) disturbance torques [N·m].
        jitter: (lead_ms + 5 T) jitter of the controller's cycles, in steps of 0.125 ms; 0 with a sampled loop, whose timer is the
            drive's own.
    """
    h = STEP_S
    total = lead_ms + COMMAND_MS * target.shape[0]
    num = total - lead_ms
    angle, velocity, effort = (
        np.empty((num, NUM_JOINTS)),
        np.empty((num, NUM_JOINTS)),
        np.empty((num, NUM_JOINTS)),
    )
    zero = np.zeros(NUM_JOINTS)
    q, v = start.copy(), np.zeros(NUM_JOINTS)
    qm, vm = q[joint], 0.0
    two = d.play > 0.0 or d.compliance > 0.0
    kp, kd = arm.kp.copy(), arm.kd.copy()
    kp[joint], kd[joint] = d.kp, 0.0
    given = np.zeros(NUM_JOINTS)
    held, carried = (
        np.zeros(NUM_JOINTS),
        np.zeros(NUM_JOINTS),
    )  # of the controllers; damping comes on top
    weight = torques(arm.bodies, q, zero, zero, GRAVITY)[joint]
    carry = arm.carried * torques(arm.believed, q, zero, zero, GRAVITY)[joint]
    # Integral action has done its work long ago.
    asked = (weight + d.spring * (q[joint] - d.spring_rest)) / d.torque_scale - carry
    integral = asked - d.torque_ff if d.integral > 0.0 else 0.0
    setpoint = target[0, joint]
    setpoints = np.full(COMMAND_MS, setpoint)
    filtered = asked  # torque behind the lag
    late = math.floor(d.loop_delay / h + 0.5)
    ring = np.full(late + 1, asked)
    at = 0
    lag_share = 1.0 - math.exp(-h / d.torque_lag) if d.torque_lag > 0.0 else 1.0
    command_share = 1.0 - math.exp(-1e-3 / d.lag) if d.lag > 0.0 else 1.0
    bristle, wound = 0.0, 0.0
    # of friction, for the bristles' stiffness; loads are of 3 N·m
    most = d.coulomb + d.stribeck + d.spot + 3.0 * (d.load_share + d.gear_share)
    s0 = most / d.presliding
    s1_rest = 1.4 * math.sqrt(s0 * d.motor_inertia)
    inverse = np.empty(NUM_JOINTS)
    bias = zero
    a = np.empty((NUM_JOINTS, NUM_JOINTS))
    kick = np.empty(NUM_JOINTS)
    torque, most_step = 0.0, 0.0
    stiffness = 0.0
    rub = 0.0
    sampled = d.loop_steps > 0
    loop_s = d.loop_steps * h
    window_ms = max(1.0, loop_s * 1e3)
    filter_share = (
        1.0 - math.exp(-loop_s / d.velocity_filter) if d.velocity_filter > 0.0 else 1.0
    )
    seen, seen_rate, rate = encoder(d, q[joint]), 0.0, 0.0
    stop_side = math.copysign(1.0, d.stop_angle - q[joint])
    hung, hung_v, power = q[joint], 0.0, 0.0
    hung_k = d.hung_inertia * d.hung_rad_per_s**2
    hung_c = 2.0 * d.hung_damping * d.hung_rad_per_s * d.hung_inertia
    tick, next_tick = 0, max(0, int(jitter[0]))
    for s in range(total * SUBSTEPS):
        if s % SUBSTEPS == 0:
            ms = s // SUBSTEPS
            ahead = q + 0.5e-3 * v
            a = mass_matrix(arm.bodies, ahead)
            bias = torques(arm.bodies, ahead, v, zero, GRAVITY)
            for i in range(NUM_JOINTS):
                a[i, i] += (
                    d.motor_inertia * (1.0 - two) if i == joint else arm.armature[i]
                ) + h * kd[i]
            if two and stiffness == 0.0:
                reduced = 1.0 / (1.0 / d.motor_inertia + 1.0 / a[joint, joint])
                stiffness = (
                    1.0 / d.compliance
                    if d.compliance > 0.0
                    else min(2e4, (0.4 / h) ** 2 * reduced)
                )
                rub = (
                    d.compliance_damping * stiffness
                    if d.compliance > 0.0
                    else 0.6 * math.sqrt(stiffness * reduced)
                )
            factor(a)
            inverse[:] = 0.0
            inverse[joint] = 1.0
            solve(a, inverse)
            if ms >= lead_ms:
                n = ms - lead_ms
                for i in range(NUM_JOINTS):
                    angle[n, i], velocity[n, i], effort[n, i] = q[i], v[i], given[i]
                if two:
                    angle[n, joint], velocity[n, joint] = qm, vm
        if s % SUBSTEPS == SUBSTEPS // 2:  # surely before the next tick
            for i in range(NUM_JOINTS):
                given[i] = held[i] - kd[i] * v[i]
            given[joint] = torque
        if s == next_tick:  # the controller
            ms = tick - lead_ms
            own = qm if two else q[joint]
            load = torques(
                arm.believed, q, zero, zero, GRAVITY
            )  # the pose is known well enough for that
            for i in range(NUM_JOINTS):
                carried[i] = arm.carried * load[i]
                if i != joint:
                    goal = _arrived(target, i, ms, 0.0, 1.0)
                    held[i] = kp[i] * (goal - q[i]) + arm.torque_ff[i]
            goal = _arrived(target, joint, ms, d.delay * 1e3, window_ms)
            if (
                tick % COMMAND_MS == 0
            ):  # the driver limits what it sends, from one command to the next
                most_step = d.slew * COMMAND_MS * 1e-3
            step = (goal - setpoint) * command_share
            step = min(max(step, -most_step), most_step)
            most_step -= abs(step)
            setpoint += step
            rate = (setpoint - setpoints[tick % COMMAND_MS]) / (COMMAND_MS * 1e-3)
            setpoints[tick % COMMAND_MS] = setpoint
            if not sampled:
                error = setpoint - encoder(d, own)
                error = math.copysign(max(abs(error) - d.deadband, 0.0), error)
                if ms > -lead_ms // 2:
                    integral += d.kp * d.integral * error * 1e-3
                held[joint] = (
                    d.kp * error + integral + d.kd * d.feedforward * rate + d.torque_ff
                )
            tick += 1
            if tick < total:
                next_tick = tick * SUBSTEPS + int(jitter[tick])
        if sampled and s % d.loop_steps == 0:
            now = encoder(d, qm if two else q[joint])
            seen_rate += filter_share * ((now - seen) / loop_s - seen_rate)
            seen = now
            error = setpoint - now
            error = math.copysign(max(abs(error) - d.deadband, 0.0), error)
            if s > lead_ms * SUBSTEPS // 2:
                integral += d.kp * d.integral * error * loop_s
            held[joint] = (
                d.kp * error
                + integral
                + d.kd * (d.feedforward * rate - seen_rate)
                + d.torque_ff
            )
        ms = s // SUBSTEPS
        time_s = max(0.0, s * h - lead_ms * 1e-3)
        for i in range(NUM_JOINTS):
            kick[i] = h * (
                held[i] + carried[i] - kd[i] * v[i] - bias[i] + disturbance[ms, i]
            )
        kick[joint] = h * (disturbance[ms, joint] - bias[joint])
        if d.hung_inertia > 0.0:
            back = hung_k * (hung - q[joint]) + hung_c * (hung_v - v[joint])
            kick[joint] += h * back
            hung_v -= h * back / d.hung_inertia
            hung += h * hung_v
        solve(a, kick)
        # What follows is one scalar problem: the joint's velocity is free + mobility × torque.
        mobility = h * inverse[joint]
        free = v[joint] + kick[joint]
        motor_v = vm if two else v[joint]
        motor_q = qm if two else q[joint]
        turning = (
            d.encoder_waves
            * d.encoder_wave
            * math.cos(d.encoder_waves * motor_q + d.encoder_phase)
        )
        ask, damp = held[joint], 0.0 if sampled else d.kd * (d.encoder_scale + turning)
        if late > 0:
            ring[at] = ask - damp * motor_v
            at = (at + 1) % (late + 1)
            ask, damp = ring[at], 0.0
        ask, damp = filtered + lag_share * (ask - filtered), lag_share * damp
        gain = d.torque_scale * (1.0 - d.fade * time_s)
        if d.one_way != 0.0:
            gain *= 1.0 + d.one_way * math.copysign(1.0, torque + carried[joint])
        if d.sag > 0.0:
            power += (
                h / d.sag_time * (max(0.0, (torque + carried[joint]) * motor_v) - power)
            )
            gain /= 1.0 + d.sag * power
        lift = gain * carried[joint]
        other = (
            d.cogging * math.sin(d.cogging_periods * motor_q + d.cogging_phase)
            if d.cogging != 0.0
            else 0.0
        )
        other -= d.spring * (motor_q - d.spring_rest)
        if d.stop > 0.0:
            deep = stop_side * (motor_q - d.stop_angle)
            if deep > 0.0:  # 5 ms of damping
                other -= stop_side * max(
                    0.0, d.stop * (deep + 0.005 * stop_side * motor_v)
                )
        if d.hysteresis > 0.0:
            turn = h * motor_v / d.hysteresis_width
            wound = (wound + turn) / (1.0 + abs(turn))
            other -= d.hysteresis * wound
        limit = d.coulomb
        if d.stribeck > 0.0:
            limit += d.stribeck * math.exp(-((motor_v / d.stribeck_speed) ** 2))
        if d.spot > 0.0:
            limit += d.spot * math.exp(
                -(((motor_q - d.spot_angle) / d.spot_width) ** 2)
            )
        if d.load_share > 0.0:
            limit += d.load_share * abs(torque + lift + bias[joint])
        limit += d.gear_share * abs(torque + lift)
        if d.asymmetry != 0.0:
            limit *= 1.0 + d.asymmetry * math.copysign(1.0, bristle)
        if d.angle_share != 0.0:
            limit *= 1.0 + d.angle_share * math.sin(2.0 * motor_q + d.angle_phase)
        limit *= 1.0 - d.warm_up * time_s
        stick, grip, shrink, s1 = 0.0, 0.0, 1.0, 0.0
        if most > 0.0:
            s1 = s1_rest / (1.0 + (motor_v / 0.02) ** 2)
            shrink = 1.0 + h * s0 * abs(motor_v) / max(limit, 1e-9)
            stick = (s0 + s1 / h) * bristle / shrink - s1 * bristle / h
            grip = (s0 * h + s1) / shrink
        drag = d.viscous + d.quadratic * abs(motor_v) + grip
        ask, damp = gain * ask, gain * damp
        for attempt in range(2):
            if two:
                b = h / d.motor_inertia
                push = vm + b * (ask + lift + other - stick)
                brake = 1.0 + b * (damp + drag)
                gap = qm - q[joint]
                gap = math.copysign(max(abs(gap) - 0.5 * d.play, 0.0), gap)
                through = 0.0
                if gap != 0.0 or d.play == 0.0:
                    firm = stiffness * h + rub
                    through = (stiffness * gap + firm * (push / brake - free)) / (
                        1.0 + firm * (b / brake + mobility)
                    )
                    if d.play > 0.0 and through * gap < 0.0:
                        through = 0.0  # faces part, they do not pull
                new = (push - b * through) / brake
                passed = through
            else:
                new = (free + mobility * (ask + lift + other - stick)) / (
                    1.0 + mobility * (damp + drag)
                )
                passed = (new - free) / mobility
            torque = ask - damp * new
            if attempt == 0:
                filtered = torque / gain
            ceiling = d.torque_max
            if d.stall < math.inf:
                driving = (torque + lift) * motor_v > 0.0
                left = max(0.0, 1.0 - abs(motor_v) / d.no_load) if driving else 1.0
                ceiling = min(ceiling, d.stall * left)
            if abs(torque + lift) <= ceiling:
                break
            ask, damp = math.copysign(ceiling, torque + lift) - lift, 0.0
        if most > 0.0:
            bristle = (bristle + h * new) / shrink
        for i in range(NUM_JOINTS):
            v[i] += kick[i] + h * inverse[i] * passed
            q[i] += h * v[i]
        if two:
            vm = new
            qm += h * vm
    return Run(angle, velocity, effort)

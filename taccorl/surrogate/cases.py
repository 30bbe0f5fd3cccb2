"""A surrogate robot drawn at random: joint, drive, hidden effects, and the twin with which its user starts. The strength of a
hidden effect is the error in the recordings that remains after a refit of the gains: 1 to 30 noise floors. Its parameters are
chosen for that strength, within realistic bounds.

Letters in shapes: T rows, J signals.
"""

import dataclasses
import math
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import cont2discrete, lfilter

from taccorl.alignment.measurements.motions import (
    CHIRP,
    JUDGED_ON,
    POSES,
    RATE_HZ,
    Motion,
    Room,
    joint_number,
)
from taccorl.errors import TaccorlError, nearest
from taccorl.robots import ROBOT
from taccorl.sim.controller import ControllerConfig
from taccorl.sim.robot import RobotConfig
from taccorl.sim.twin import TwinConfig
from taccorl.surrogate.hidden import (
    KINDS,
    NOT_FITTED,
    OUTSIDE,
    REGISTERED,
    Change,
    Hidden,
    Kind,
    Scale,
    Values,
    hidden_in,
    kind,
    selectors,
    within_bounds,
)
from taccorl.surrogate.plant import STEP_S, Run
from taccorl.surrogate.robot import (
    NOISE_RAD,
    PAYLOAD_LINK6_M,
    PAYLOAD_OFF_M,
    Robot,
    free_inertia,
    inertia_and_weight,
)
from taccorl.surrogate.sampled_loop import (
    FILTER_S,
    PERIODS_STEPS,
    SampledLoop,
    draw_loop,
    is_stable,
)

SEVERITY_FLOORS = (
    1.0,
    30.0,
)  # Range from which the strength of a hidden effect is drawn [floors]
SEARCHES, CLOSE_ENOUGH = 6, 0.15
"""Most steps of the search for a severity, and accepted error of the result (logarithm of the ratio)."""
OMEGA_RAD_PER_S, ZETA = (11.0, 24.0), (0.7, 1.5)
"""Ranges of natural frequency and damping ratio of soft drives (MIT mode)."""
LOOP_FLOORS = 0.5
"""Largest error that the sampling of a loop alone may leave, with refitted gains [floors]; a slower loop is an effect of its own
(``slow_velocity_filter``)."""
LOOP_DRAWS, GAIN_DRAWS, SLOWEST_S = 8, 5, PERIODS_STEPS[-1] * STEP_S + FILTER_S[1]
PAYLOAD_KG = (0.1, 0.5)  # Range of the mass that is held in every recording [kg]
COLOUR_S = (0.01, 0.1)  # Range of the time constants of coloured encoder noise [s]
_RUNAWAY_RAD = 3.0
_GEARED = ("backlash", "joint_compliance")


@dataclass(frozen=True)
class Case:
    """One surrogate robot: the joint under test, its drive and hidden effects, and the twin with which its user starts."""

    seed: int  # Seed of everything that is drawn
    signal: str  # Joint under test, such as ``left_joint5``
    gains: tuple[float, float, float]
    """True K_p [N·m/rad], K_d [N·m·s/rad], T_ref [N·m] of its drive, converted to those of a continuous controller
    (``sampled_loop``)."""
    hidden: tuple[Hidden, ...]  # The hidden effects; empty if there are none
    twin: TwinConfig
    """Twin with which the user starts: without the hidden effects, and with wrong gains if they are unknown."""
    gains_known: bool  # True: K_p and K_d are stated in the recordings, and the drive really has them
    room: Room  # Range of motion of the joint under test
    pose: tuple[
        float, ...
    ]  # (6,) pose of the arm under test [rad], with its joint in the middle
    floor_rad: float  # Expected noise floor [rad]: from the sensor, and from disturbances through the drive
    left_floors: float = 0.0  # Error that the hidden effects cause after a refit of K_p, K_d and T_ref [floors]
    design: str = "pack"  # Motions of the fit recordings: ``chirp`` or ``pack``
    loop: SampledLoop | None = (
        None  # Timing of the sampled loop; None: the velocity loop is continuous
    )
    loop_floors: float = 0.0  # Error that the loop's sampling alone causes after a refit of the gains [floors]
    payload_kg: float = 0.0
    """Known mass that is held in every recording [kg]; a design may have further recordings with a payload."""
    payload_m: tuple[float, float, float] = (
        PAYLOAD_LINK6_M  # True position of held masses in link 6's frame [m]
    )
    colour_s: float = 0.0  # Time constant of the encoder's noise [s]; 0: white noise

    @property
    def name(self) -> str:
        """Text for tables: hidden effects, joint and seed."""
        return f"{'+'.join(h.name for h in self.hidden) or 'none'} on {self.signal}, seed {self.seed}"

    def truth(self) -> dict[str, object]:
        """The true values as JSON values, for the sealed file: ``hidden`` (a dict per effect), ``gains``, ``ratios``, timing
        of the loop, …"""
        return {
            "seed": self.seed,
            "signal": self.signal,
            "hidden": [dataclasses.asdict(h) for h in self.hidden],
            "gains": dict(
                zip(
                    ("kp_nm_per_rad", "kd_nms_per_rad", "torque_ff_nm"),
                    self.gains,
                    strict=True,
                )
            ),
            "gains_known": self.gains_known,
            "floor_rad": self.floor_rad,
            "left_floors": self.left_floors,
            "design": self.design,
            "loop_hz": None if self.loop is None else 1.0 / self.loop.period_s,
            "velocity_filter_s": None if self.loop is None else self.loop.filter_s,
            "loop_floors": self.loop_floors,
            "payload_kg": self.payload_kg,
            "payload_link6_m": list(self.payload_m),
            "noise_colour_s": self.colour_s,
            "ratios": self.ratios(),
        }

    def values(self) -> dict[str, float]:
        """Name of a number, such as ``kp``, ``kd``, ``coulomb_friction.torque_nm`` → its true value. K_d is that of the drive,
        which is larger than the equivalent continuous controller's because of the loop's timing."""
        numbers = {
            "kp": self.gains[0],
            "kd": self.robot.drive.kd,
            "torque_ff": self.gains[2],
        }
        return numbers | {
            f"{h.name}.{name}": value
            for h in self.hidden
            for name, value in h.values.items()
        }

    def ratios(self) -> dict[str, float]:
        """Number → true value, for the numbers that angles alone identify: torques, stiffnesses, dampings, inertias and masses
        divided by K_p (``coulomb_friction.torque_nm/kp``); others unchanged."""
        own = {n: v for n, v in self.values().items() if n != "kp"}
        return {
            f"{n}/kp" if _is_torque(n) else n: v / self.gains[0] if _is_torque(n) else v
            for n, v in own.items()
        }

    def motion(self, motion: Motion) -> Motion:
        """``motion`` with the payload of this robot added."""
        return dataclasses.replace(
            motion, payload_kg=motion.payload_kg + self.payload_kg
        )

    @cached_property
    def robot(self) -> Robot:
        """The simulated robot with its hidden effects."""
        return self.robot_with([h.change for h in self.hidden])

    def robot_with(self, changes: Sequence[Change]) -> Robot:
        """The simulated robot with these changes in place of the hidden effects."""
        return Robot(
            self.signal,
            self.gains,
            changes,
            self.pose,
            loop=self.loop,
            payload_m=self.payload_m,
        )


def _is_torque(name: str) -> bool:
    """By its unit, which is in its name."""
    if name in ("kd", "torque_ff"):
        return True
    return "per_nm" not in name and bool(
        {"nm", "nms", "nms2", "kg", "kgm2"} & set(name.split("_"))
    )


def draw_case(
    effect_names: Sequence[str],
    seed: int,
    *,
    signal: str | None = None,
    strength: float | None = None,
    gains_known: bool = False,
    design: str = "pack",
    sampled: bool = False,
    loaded: bool = False,
    coloured: bool = False,
) -> Case:
    """Draw a robot with these hidden effects; without any, the robot equals the twin.

    Args:
        effect_names: names in ``hidden.KINDS``.
        signal: joint under test; drawn among those on which the effects can be seen.
        strength: error that each of them causes after a refit of the gains [floors]; drawn from 1 to 30 if not given.
        gains_known: the twin has the true K_p and K_d, and recordings state them.
        design: design of the recordings, on which strength is measured: ``chirp`` or ``pack``.
        sampled: the drive's whole loop is sampled, at 0.5 to 4 kHz with a low-pass of the velocity.
        loaded: a weighed mass is held in every recording.
        coloured: the encoder's noise is correlated over time.

    Raises TaccorlError: there is no hidden effect of that name, the joint cannot show it, or there is no such joint."""
    if design not in JUDGED_ON:
        raise TaccorlError(f"no design {design!r}; {nearest(design, JUDGED_ON)}")
    rng = np.random.default_rng([seed, zlib.crc32("+".join(effect_names).encode())])
    kinds = [kind(name) for name in effect_names]
    possible = [
        j for j in range(1, ROBOT.num_joints + 1) if all(j in k.joints for k in kinds)
    ]
    drawn = f"{rng.choice(ROBOT.arms)}_joint{rng.choice(possible or [1])}"
    signal = drawn if signal is None else signal
    joints = [name for name in ROBOT.action_names if not name.endswith("gripper")]
    if signal not in joints:
        raise TaccorlError(
            f"{signal!r} is not a joint of the arms; {nearest(signal, joints)}"
        )
    joint = joint_number(signal)
    for name in (
        name
        for name, k in zip(effect_names, kinds, strict=True)
        if joint not in k.joints
    ):
        seen_on = ", ".join(f"joint{j}" for j in kind(name).joints)
        raise TaccorlError(
            f"{name} cannot be seen on {signal}; choose one of {seen_on}"
        )
    pose = list(POSES[joint - 1])
    pose[joint - 1] += rng.uniform(-0.1, 0.1)
    inertia, weight = inertia_and_weight(np.array(pose), joint)
    gains = _draw_gains(rng, joint, inertia, stiff=all(k.stiff for k in kinds))
    dice = np.random.default_rng(
        [seed, zlib.crc32(b"conditions")]
    )  # apart, so that they change nothing else
    case = Case(
        seed=seed,
        signal=signal,
        gains=gains,
        hidden=(),
        twin=TwinConfig(),
        gains_known=gains_known,
        room=Room.of(joint, pose[joint - 1], inertia, weight),
        pose=tuple(pose),
        floor_rad=0.0,
        design=design,
        payload_m=_about(PAYLOAD_LINK6_M, dice),
        payload_kg=float(dice.uniform(*PAYLOAD_KG)) * loaded,
        colour_s=float(np.exp(dice.uniform(*np.log(COLOUR_S)))) * coloured,
    )
    case, quiet = _quiet(case)
    if sampled:
        case, quiet = _with_sampled_loop(
            case, quiet, dice, geared=any(n in _GEARED for n in effect_names)
        )
    plain = case.robot
    scale = Scale(
        kp=case.gains[0],
        kd=case.gains[1],
        inertia=inertia,
        torque=max(
            float(np.abs(run.effort[:, joint - 1] + plain.carried_nm(run)).max())
            for run in quiet
        ),
        speed=float(np.abs(np.diff(CHIRP.target(case.room))).max() * RATE_HZ),
        centre=case.room.middle_rad,
        sweep=case.room.sweep_rad,
        reach=max(
            float(np.abs(m.target(case.room) - case.room.middle_rad).max())
            for m in JUDGED_ON[design]
        ),
    )
    case = dataclasses.replace(case, twin=_twin(rng, joint, case.gains, gains_known))
    refit = _Refit(case, plain, quiet)
    hidden = []
    for name, k in zip(effect_names, kinds, strict=True):
        wanted = (
            math.exp(rng.uniform(*np.log(SEVERITY_FLOORS)))
            if strength is None
            else strength
        )
        if name in NOT_FITTED:  # as often as it happens, whatever that leaves
            hidden.append(
                _hidden(
                    name,
                    signal,
                    math.exp(rng.uniform(*np.log(k.severity(scale)))),
                    scale,
                    {},
                )
            )
            continue
        hidden.append(_as_strong_as(wanted, refit, name, k, scale, k.shape(rng, scale)))
    left = refit.left_floors([h.change for h in hidden])
    return dataclasses.replace(case, hidden=tuple(hidden), left_floors=left)


def case_of(config: TwinConfig, signal: str, seed: int, design: str = "pack") -> Case:
    """A joint of the robot that ``config`` describes: gains, and effects with their parameters. Its user knows K_p and K_d, and
    starts from a twin without the effects. Raises TaccorlError: as ``draw_case`` and ``hidden_in``."""
    plain = draw_case((), seed, signal=signal, gains_known=True, design=design)
    arm, joint = signal.partition("_")[0], joint_number(signal) - 1
    own = config.controller_of(arm)
    gains = own.kp_nm_per_rad[joint], own.kd_nms_per_rad[joint], own.torque_ff_nm[joint]
    twin = TwinConfig(
        controller=config.controller, arm_controllers=config.arm_controllers
    )
    case = dataclasses.replace(
        plain,
        gains=gains,
        twin=twin,
        hidden=hidden_in(config, (signal, arm), REGISTERED),
    )
    return _quiet(case)[0]


def _about(
    middle_m: tuple[float, float, float], rng: np.random.Generator
) -> tuple[float, float, float]:
    x, y, z = (
        float(m + PAYLOAD_OFF_M * n)
        for m, n in zip(middle_m, rng.standard_normal(3), strict=True)
    )
    return x, y, z


def _quiet(case: Case) -> tuple[Case, list[Run]]:
    """The case with its noise floor, and its undisturbed runs without what is hidden."""
    plain = case.robot
    quiet = [
        plain.run(case.motion(motion), case.room) for motion in JUDGED_ON[case.design]
    ]
    noisy = plain.run(
        case.motion(CHIRP), case.room, np.random.default_rng([case.seed, 1])
    )
    moved = (plain.reported(noisy) - plain.reported(quiet[0]))[:, plain.joint]
    return dataclasses.replace(
        case, floor_rad=math.hypot(NOISE_RAD, float(np.sqrt(np.mean(moved**2))))
    ), quiet


def _with_sampled_loop(
    case: Case, quiet: list[Run], rng: np.random.Generator, *, geared: bool
) -> tuple[Case, list[Run]]:
    """With a loop that is stable with these gains or, if none is, with other ones, and which alone leaves next to nothing.
    ``geared``: there will be play or a spring between motor and link. K_d of a heavy link over the rotor's inertia is then
    more than any of these loops can damp on some joints: their velocity loop stays continuous."""
    as_drawn = case, quiet
    joint = joint_number(case.signal)
    inertia, _ = inertia_and_weight(np.array(case.pose), joint)
    inertias = [
        inertia,
        free_inertia(np.array(case.pose), joint),
        *([RobotConfig().armature_kgm2] if geared else []),
    ]
    for _ in range(GAIN_DRAWS):
        refit, most_late_s = _Refit(case, case.robot, quiet), SLOWEST_S
        for _ in range(LOOP_DRAWS):
            loop = draw_loop(rng, most_late_s)
            most_late_s *= 0.7
            if not is_stable(loop, *case.gains[:2], inertias):
                continue
            sampled = dataclasses.replace(case, loop=loop)
            left = refit.left_of(sampled.robot)
            if left <= LOOP_FLOORS:
                return _quiet(dataclasses.replace(sampled, loop_floors=left))
        case, quiet = _quiet(
            dataclasses.replace(
                case, gains=_draw_gains(rng, joint, inertia, stiff=False)
            )
        )
    if geared:
        return as_drawn
    of = f"{case.signal}, seed {case.seed}"
    raise TaccorlError(
        f"no sampled loop of {of}, is stable and has little effect; choose another seed"
    )


def _draw_gains(
    rng: np.random.Generator, joint: int, inertia: float, *, stiff: bool
) -> tuple[float, float, float]:
    """From a soft drive to, one time in four, something between that and the paper's."""
    omega, zeta = rng.uniform(*OMEGA_RAD_PER_S), rng.uniform(*ZETA)
    share = rng.uniform(0.0, 1.0) * (rng.random() < 0.25) * stiff
    kp = (inertia * omega**2) ** (1 - share) * ROBOT.kp_nm_per_rad[joint - 1] ** share
    kd = (2 * zeta * omega * inertia) ** (1 - share) * ROBOT.kd_nms_per_rad[
        joint - 1
    ] ** share
    return float(kp), float(kd), float(kp * rng.uniform(-0.02, 0.02))


def _twin(
    rng: np.random.Generator, joint: int, gains: tuple[float, float, float], known: bool
) -> TwinConfig:
    """The paper's gains on the other joints, which are right; wrong ones on this."""
    control = ControllerConfig()
    wrong = (
        np.exp(rng.uniform(-math.log(2), math.log(2), 2)) if not known else np.ones(2)
    )
    control.kp_nm_per_rad[joint - 1] = gains[0] * float(wrong[0])
    control.kd_nms_per_rad[joint - 1] = gains[1] * float(wrong[1])
    control.torque_ff_nm[joint - 1] = 0.0
    return TwinConfig(controller=control)


class _Refit:
    """What hidden effects leave once K_p, K_d, T_ref have been refitted.

    Without effects a joint is J q̈ = K_p (q* − q) − K_d q̇ + T_ref, its weight being carried: what other gains change is
    computed from that, and added to what the plant does with the true ones."""

    def __init__(self, case: Case, plain: Robot, quiet: Sequence[Run]) -> None:
        self.case, self.motions = case, [case.motion(m) for m in JUDGED_ON[case.design]]
        pose, joint = np.array(case.pose), plain.joint + 1
        self._inertias = [
            inertia_and_weight(pose, joint, m.payload_kg)[0] for m in self.motions
        ]
        self._plain = self._reports(plain, quiet)
        self._linear = self._swung(0.0, 0.0)
        self._softness = np.concatenate(
            [np.full(len(m.target(case.room)), 1 / m.gain) for m in self.motions]
        )

    def _reports(self, robot: Robot, runs: Sequence[Run]) -> np.ndarray:
        """Reports of the joint under test, motion after motion."""
        return np.concatenate([robot.reported(run)[:, robot.joint] for run in runs])

    def _swung(self, log_kp: float, log_kd: float) -> np.ndarray:
        """The same by the linear joint, with gains that are off by these."""
        kp, kd, _ = self.case.gains
        out = []
        for motion, inertia in zip(self.motions, self._inertias, strict=True):
            stiffness, damping = (
                f * motion.gain / inertia
                for f in (kp * math.exp(log_kp), kd * math.exp(log_kd))
            )
            discrete: Any = cont2discrete(
                ([stiffness], [1.0, damping, stiffness]), 1 / RATE_HZ
            )
            target = motion.target(self.case.room)
            out.append(
                target[0]
                + lfilter(np.ravel(discrete[0]), discrete[1], target - target[0])
            )
        return np.concatenate(out)

    def left_floors(self, changes: Sequence[Change]) -> float:
        """RMS of the rest, in floors."""
        return self.left_of(self.case.robot_with(changes))

    def left_of(self, robot: Robot) -> float:
        """The same of a robot in the place of this case's; a loop that runs away leaves more than anything."""
        error = (
            self._reports(robot, [robot.run(m, self.case.room) for m in self.motions])
            - self._plain
        )
        scale = self.case.floor_rad * math.sqrt(len(error))
        if not np.abs(error).max() < _RUNAWAY_RAD:  # nor is NaN
            return math.inf

        def rest(x: np.ndarray) -> np.ndarray:
            log_kp, log_kd = (0.0, 0.0) if self.case.gains_known else x[1:]
            return (
                error
                - x[0] * self._softness
                - (self._swung(log_kp, log_kd) - self._linear)
            ) / scale

        start = np.zeros(1 if self.case.gains_known else 3)
        found = least_squares(
            rest, start, x_scale=np.array([0.01, 0.1, 0.1])[: len(start)], max_nfev=20
        )
        return math.sqrt(2 * found.cost)


def _hidden(
    name: str, signal: str, severity: float, scale: Scale, shape: Values
) -> Hidden:
    """The effect of this severity and shape at ``signal``, within the bounds of the registry."""
    k, where = kind(name), selectors(name, signal)
    values = within_bounds(name, k.values(severity, scale, shape))
    return Hidden(
        name=name,
        values=values,
        severity=severity,
        registered=k.registered,
        selectors=where,
    )


def _as_strong_as(
    wanted: float, refit: _Refit, name: str, k: Kind, scale: Scale, shape: Values
) -> Hidden:
    """The effect at the severity, of those that a robot could have, that leaves ``wanted`` floors, or is nearest to it."""

    def of(severity: float) -> Hidden:
        return _hidden(name, refit.case.signal, severity, scale, shape)

    return of(
        find_severity(
            wanted,
            k.severity(scale),
            lambda severity: refit.left_floors([of(severity).change]),
        )
    )


def find_severity(
    wanted: float, ends: tuple[float, float], left: Callable[[float], float]
) -> float:
    """Severity within ``ends`` (low, high) at which the error is ``wanted`` [floors], or nearest to it, to 15 %. ``left``:
    function from severity to error [floors], which must increase."""
    low, high = np.log(ends)
    found: list[
        tuple[float, float]
    ] = []  # log severity, log of what is left over what is wanted
    at = 0.5 * (low + high)
    for _ in range(SEARCHES):
        found.append((at, math.log(min(max(left(math.exp(at)), 1e-6), 1e6) / wanted)))
        below = max((f for f in found if f[1] < 0), default=None)
        above = min((f for f in found if f[1] >= 0), default=None)
        if (
            abs(found[-1][1]) < CLOSE_ENOUGH
            or (below is None and at <= low)
            or (above is None and at >= high)
        ):
            break
        if below and above and below[0] < above[0]:
            at = below[0] - below[1] * (above[0] - below[0]) / (above[1] - below[1])
        else:  # most errors grow in proportion
            at = min(max(at - found[-1][1], low), high)
    return math.exp(min(found, key=lambda f: abs(f[1]))[0])


def draw_secret(seed: int) -> tuple[str, ...]:
    """Names of the effects that the robot of this seed hides: usually one of the registry, or two, none, or one from outside of
    it."""
    rng = np.random.default_rng([seed, zlib.crc32(b"secret")])
    fate = rng.random()
    if fate < 0.1:
        return ()
    if fate < 0.25:
        return (str(rng.choice(OUTSIDE)),)
    drawn = [str(name) for name in rng.permutation(REGISTERED)]
    if fate < 0.75:
        return (drawn[0],)
    fitting = (
        name
        for name in drawn[1:]
        if set(KINDS[name].joints) & set(KINDS[drawn[0]].joints)
    )
    return drawn[0], next(fitting)

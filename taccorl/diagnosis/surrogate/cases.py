"""A surrogate robot drawn at random: which joint, which drive, what is hidden in it, and the twin that its user starts from.

How strong a hidden effect is, is said by what it leaves on the recordings after the gains have been refitted: 1 to 30 noise
floors. Its severity is searched for that, within what a robot could have.

Letters in shapes: T rows, J 14 signals.
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

from taccorl.diagnosis.motions import CHIRP, JUDGED_ON, POSES, RATE_HZ, Room, joint_number
from taccorl.diagnosis.surrogate.hidden import (
    KINDS,
    OUTSIDE,
    REGISTERED,
    Change,
    Hidden,
    Kind,
    Scale,
    Values,
    kind,
    selectors,
    within_bounds,
)
from taccorl.diagnosis.surrogate.plant import Run
from taccorl.diagnosis.surrogate.robot import NOISE_RAD, Robot, inertia_and_weight
from taccorl.errors import TaccorlError, nearest
from taccorl.sim.actions import ACTION_NAMES
from taccorl.sim.controller import KD_NMS_PER_RAD, KP_NM_PER_RAD, ControllerConfig
from taccorl.sim.robot import ARMS
from taccorl.sim.twin import TwinConfig

SEVERITY_FLOORS = (1.0, 30.0)
SEARCHES, CLOSE_ENOUGH = 6, 0.15
"""Tries for a severity; log of the ratio to what was wanted."""
OMEGA_RAD_PER_S, ZETA = (11.0, 24.0), (0.7, 1.5)
"""Natural frequency and damping of soft drives (MIT mode)."""


@dataclass(frozen=True)
class Case:
    """One surrogate robot."""

    seed: int
    signal: str
    """``left_joint5``: the joint under test."""
    gains: tuple[float, float, float]
    """True K_p, K_d, T_ref of its drive, as a continuous controller's."""
    hidden: tuple[Hidden, ...]
    twin: TwinConfig
    """What the user starts from: without the hidden effects, and with wrong gains where those are unknown."""
    gains_known: bool
    """K_p and K_d were commanded, and the drive keeps them."""
    room: Room
    pose: tuple[float, ...]
    """(6,) rad of the arm under test, its joint in the middle."""
    floor_rad: float
    """Noise floor as expected: sensor, and disturbance through the drive."""
    left_floors: float = 0.0
    """What the hidden effects leave of an error once K_p, K_d, T_ref have been refitted, in floors."""
    design: str = "pack"

    @property
    def name(self) -> str:
        return f"{'+'.join(h.name for h in self.hidden) or 'none'} on {self.signal}, seed {self.seed}"

    def truth(self) -> dict[str, object]:
        """For the sealed file."""
        return {
            "seed": self.seed,
            "signal": self.signal,
            "hidden": [dataclasses.asdict(h) for h in self.hidden],
            "gains": dict(zip(("kp_nm_per_rad", "kd_nms_per_rad", "torque_ff_nm"), self.gains, strict=True)),
            "gains_known": self.gains_known,
            "floor_rad": self.floor_rad,
            "left_floors": self.left_floors,
            "design": self.design,
        }

    @cached_property
    def robot(self) -> "Robot":
        return Robot(self.signal, self.gains, [h.change for h in self.hidden], self.pose)


def draw_case(
    effect_names: Sequence[str],
    seed: int,
    *,
    signal: str | None = None,
    strength: float | None = None,
    gains_known: bool = False,
    design: str = "pack",
) -> Case:
    """A robot in which these effects are hidden; none of them is a robot as the twin has it.

    Args:
        effect_names: of ``hidden.KINDS``.
        signal: joint under test; drawn among those on which the effects can be seen.
        strength: noise floors that each of them leaves after a refit of the gains; drawn from 1 to 30.
        gains_known: the twin has the true K_p and K_d, and recordings say so.
        design: which recordings will be made, and strength is measured on: ``chirp`` or ``pack``.

    Raises:
        TaccorlError: nothing of that name can be hidden, a joint on which it cannot be seen, or no such joint.
    """
    if design not in JUDGED_ON:
        raise TaccorlError(f"surrogate: no design {design!r}; {nearest(design, JUDGED_ON)}")
    rng = np.random.default_rng([seed, zlib.crc32("+".join(effect_names).encode())])
    kinds = [kind(name) for name in effect_names]
    drawn = (
        f"{rng.choice(ARMS)}_joint{rng.choice([j for j in range(1, 7) if all(j in k.joints for k in kinds)] or [1])}"
    )
    signal = drawn if signal is None else signal
    if signal not in ACTION_NAMES or signal.endswith("gripper"):
        raise TaccorlError(f"surrogate: {signal!r} is no joint of the arms; {nearest(signal, ACTION_NAMES)}")
    joint = joint_number(signal)
    for name, k in zip(effect_names, kinds, strict=True):
        if joint not in k.joints:
            seen_on = ", ".join(f"joint{j}" for j in k.joints)
            raise TaccorlError(f"surrogate: {name} cannot be seen on {signal}; take one of {seen_on}")
    pose = list(POSES[joint - 1])
    pose[joint - 1] += rng.uniform(-0.1, 0.1)
    inertia, weight = inertia_and_weight(np.array(pose), joint)
    room = Room.of(joint, pose[joint - 1], inertia, weight)
    gains = _draw_gains(rng, joint, inertia, stiff=all(k.stiff for k in kinds))
    plain = Robot(signal, gains, [], tuple(pose))
    quiet = [plain.run(motion, room) for motion in JUDGED_ON[design]]
    scale = Scale(
        kp=gains[0],
        kd=gains[1],
        inertia=inertia,
        torque=max(float(np.abs(run.effort[:, joint - 1] + plain.carried_nm(run)).max()) for run in quiet),
        speed=float(np.abs(np.diff(CHIRP.target(room))).max() * RATE_HZ),
        centre=room.middle_rad,
    )
    noisy = plain.run(CHIRP, room, np.random.default_rng([seed, 1]))
    moved = (plain.reported(noisy) - plain.reported(quiet[0]))[:, joint - 1]
    floor = math.hypot(NOISE_RAD, float(np.sqrt(np.mean(moved**2))))
    case = Case(
        seed=seed,
        signal=signal,
        gains=gains,
        hidden=(),
        twin=_twin(rng, joint, gains, gains_known),
        gains_known=gains_known,
        room=room,
        pose=tuple(pose),
        floor_rad=floor,
        design=design,
    )
    refit = _Refit(case, plain, quiet)
    hidden = []
    for name, k in zip(effect_names, kinds, strict=True):
        wanted = math.exp(rng.uniform(*np.log(SEVERITY_FLOORS))) if strength is None else strength
        hidden.append(_as_strong_as(wanted, refit, name, k, scale, k.shape(rng, scale)))
    left = refit.left_floors([h.change for h in hidden])
    return dataclasses.replace(case, hidden=tuple(hidden), left_floors=left)


def _draw_gains(rng: np.random.Generator, joint: int, inertia: float, *, stiff: bool) -> tuple[float, float, float]:
    """From a soft drive to, one time in four, something between that and the paper's."""
    omega, zeta = rng.uniform(*OMEGA_RAD_PER_S), rng.uniform(*ZETA)
    share = rng.uniform(0.0, 1.0) * (rng.random() < 0.25) * stiff
    kp = (inertia * omega**2) ** (1 - share) * KP_NM_PER_RAD[joint - 1] ** share
    kd = (2 * zeta * omega * inertia) ** (1 - share) * KD_NMS_PER_RAD[joint - 1] ** share
    return float(kp), float(kd), float(kp * rng.uniform(-0.02, 0.02))


def _twin(rng: np.random.Generator, joint: int, gains: tuple[float, float, float], known: bool) -> TwinConfig:
    """The paper's gains on the other joints, which are right; wrong ones on this."""
    control = ControllerConfig()
    wrong = np.exp(rng.uniform(-math.log(2), math.log(2), 2)) if not known else np.ones(2)
    control.kp_nm_per_rad[joint - 1] = gains[0] * float(wrong[0])
    control.kd_nms_per_rad[joint - 1] = gains[1] * float(wrong[1])
    control.torque_ff_nm[joint - 1] = 0.0
    return TwinConfig(controller=control)


class _Refit:
    """What hidden effects leave once K_p, K_d, T_ref have been refitted.

    Without effects a joint is J q̈ = K_p (q* − q) − K_d q̇ + T_ref, its weight being carried: what other gains change is
    computed from that, and added to what the plant does with the true ones.
    """

    def __init__(self, case: Case, plain: Robot, quiet: Sequence[Run]) -> None:
        self.case, self.motions = case, JUDGED_ON[case.design]
        pose, joint = np.array(case.pose), plain.joint + 1
        self._inertias = [inertia_and_weight(pose, joint, m.payload_kg)[0] for m in self.motions]
        self._plain = self._reports(plain, quiet)
        self._linear = self._swung(0.0, 0.0)
        self._softness = np.concatenate([np.full(len(m.target(case.room)), 1 / m.gain) for m in self.motions])

    def _reports(self, robot: Robot, runs: Sequence[Run]) -> np.ndarray:
        """Reports of the joint under test, motion after motion."""
        return np.concatenate([robot.reported(run)[:, robot.joint] for run in runs])

    def _swung(self, log_kp: float, log_kd: float) -> np.ndarray:
        """The same by the linear joint, with gains that are off by these."""
        kp, kd, _ = self.case.gains
        out = []
        for motion, inertia in zip(self.motions, self._inertias, strict=True):
            stiffness, damping = (f * motion.gain / inertia for f in (kp * math.exp(log_kp), kd * math.exp(log_kd)))
            discrete: Any = cont2discrete(([stiffness], [1.0, damping, stiffness]), 1 / RATE_HZ)
            target = motion.target(self.case.room)
            out.append(target[0] + lfilter(np.ravel(discrete[0]), discrete[1], target - target[0]))
        return np.concatenate(out)

    def left_floors(self, changes: Sequence[Change]) -> float:
        """RMS of the rest, in floors."""
        robot = Robot(self.case.signal, self.case.gains, changes, self.case.pose)
        error = self._reports(robot, [robot.run(m, self.case.room) for m in self.motions]) - self._plain
        scale = self.case.floor_rad * math.sqrt(len(error))

        def rest(x: np.ndarray) -> np.ndarray:
            log_kp, log_kd = (0.0, 0.0) if self.case.gains_known else x[1:]
            return (error - x[0] * self._softness - (self._swung(log_kp, log_kd) - self._linear)) / scale

        start = np.zeros(1 if self.case.gains_known else 3)
        found = least_squares(rest, start, x_scale=np.array([0.01, 0.1, 0.1])[: len(start)], max_nfev=20)
        return math.sqrt(2 * found.cost)


def _as_strong_as(wanted: float, refit: _Refit, name: str, k: Kind, scale: Scale, shape: Values) -> Hidden:
    """The effect at the severity, of those that a robot could have, that leaves ``wanted`` floors, or is nearest to it."""

    def of(severity: float) -> Hidden:
        values = within_bounds(name, k.values(severity, scale, shape))
        where = selectors(name, refit.case.signal)
        return Hidden(name=name, values=values, severity=severity, registered=k.registered, selectors=where)

    return of(find_severity(wanted, k.severity(scale), lambda severity: refit.left_floors([of(severity).change])))


def find_severity(wanted: float, ends: tuple[float, float], left: Callable[[float], float]) -> float:
    """Severity within ``ends`` at which ``left`` (what it leaves, in floors) is ``wanted``, or nearest to it."""
    low, high = np.log(ends)
    found: list[tuple[float, float]] = []  # log severity, log of what is left over what is wanted
    at = 0.5 * (low + high)
    for _ in range(SEARCHES):
        found.append((at, math.log(max(left(math.exp(at)), 1e-6) / wanted)))
        below = max((f for f in found if f[1] < 0), default=None)
        above = min((f for f in found if f[1] >= 0), default=None)
        if abs(found[-1][1]) < CLOSE_ENOUGH or (below is None and at <= low) or (above is None and at >= high):
            break
        if below and above and below[0] < above[0]:
            at = below[0] - below[1] * (above[0] - below[0]) / (above[1] - below[1])
        else:  # most errors grow in proportion
            at = min(max(at - found[-1][1], low), high)
    return math.exp(min(found, key=lambda f: abs(f[1]))[0])


def draw_secret(seed: int) -> tuple[str, ...]:
    """Names of what a robot of this seed hides: mostly one effect of the registry, or two, none, one from outside of it."""
    rng = np.random.default_rng([seed, zlib.crc32(b"secret")])
    fate = rng.random()
    if fate < 0.1:
        return ()
    if fate < 0.25:
        return (str(rng.choice(OUTSIDE)),)
    drawn = [str(name) for name in rng.permutation(REGISTERED)]
    if fate < 0.75:
        return (drawn[0],)
    fitting = (name for name in drawn[1:] if set(KINDS[name].joints) & set(KINDS[drawn[0]].joints))
    return drawn[0], next(fitting)

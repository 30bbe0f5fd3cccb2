"""Safety of any robot as a pure decision: which command is passed on, limited, held or refused, and why.

    reaction   what happens                                      causes
    limit      the command is clipped, and counted               speed, range
    hold       the present position is the command, until the    old observation (a channel older than max_age_s, or
               cause is over                                     without anything new for so long), no new action for
                                                                 watchdog_s
    stop       the present position is the last command; no      number that is not finite or of another shape, impossible
               command is accepted until the next connect        time, incomplete action, pressed pad, effort of a motor,
                                                                 workspace, lost connection, an observation older than
                                                                 stop_after_s

Every number that enters or leaves passes ``faults``: what is not finite is never used. The present position is the last finite
one that was measured; before there is one, no command is sent.

Letters in shapes: A numbers of an action, in the robot's own units.
"""

import logging
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from taccorl.errors import TaccorlError, nearest
from taccorl.robot_plugin.faults import Unfit, number, positive, vector
from taccorl.robots import ROBOT

_log = logging.getLogger(__name__)
AGES_S = {"state": 0.1, "camera": 0.2, "pad": 0.1}
"""Kind of a channel → largest age at which it is acted on [s]; three periods, and a camera's latency."""


@dataclass(kw_only=True)
class SafetyConfig:
    """Limits of a robot. Speeds and ranges are in the robot's own units."""

    max_speed: dict[str, float] = field(default_factory=dict)
    """End of an action's name → largest change per second, such as {gripper.pos: 0.3, pos: 2.0}; the first that fits counts.
    Empty: those of the PiPER; required for other robots, because their units are their own."""
    ranges: dict[str, list[float]] = field(default_factory=dict)
    """Name of an action → lowest and highest target; those of the PiPER are known."""
    workspace_m: list[float] = field(
        default_factory=lambda: [-0.1, 0.75, -0.6, 0.6, 0.0, 0.9]
    )
    """Box in the twin's world in which the hands must stay: x, y, z, lowest and highest each [m]. PiPER only; [] for none."""
    pad_sum_count: float = 40_000.0
    """Largest sum of a pad's counts above baseline; 384 taxels of 255 counts are 98 thousand."""
    effort: dict[str, float] = field(default_factory=dict)
    """End of an action's name → largest effort of its motor, in the robot's unit, where it reports efforts. Empty: those of the
    PiPER, none for other robots."""
    max_age_s: dict[str, float] = field(default_factory=lambda: dict(AGES_S))
    """Kind of a channel (state, camera, pad) → age from which the arms hold [s]. What is given replaces those
    kinds, and the others keep their defaults."""
    max_skew_s: float = 0.05
    """Largest time by which a sample may be stamped ahead of the clock, or before the channel's last one [s]."""
    stop_after_s: float = 1.0
    """Age of a channel from which holding becomes a stop [s]."""
    watchdog_s: float = 0.2
    """Time without a new action after which the arms hold [s]."""


PIPER_SPEED = {"gripper.pos": 0.5, ".pos": 3.0}
"""End of an action's name → largest speed of a PiPER [m/s, rad/s]; its manual allows 3.1 rad/s."""
PIPER_EFFORT = {"gripper.pos": 45.0, ".pos": 15.0}
"""End of an action's name → effort that a PiPER stops at [N, N·m]. In the twin, experts take up to 37 N and 5.6 N·m, 1.1
rad/s and 24 thousand counts of a pad."""

_NUMBER = re.compile(r"(?<!\w)-?\d[\d.e+-]*")  # in a reason of a stop, not in a name
_IMPOSSIBLE = (
    10.0  # largest speeds: no collision or hand moves a joint so fast. A choice
)
_FARTHEST_S = 1000.0  # a quarter of an hour in one direction. A choice
_AT_TARGET = 0.2  # of what a joint moves in a period at its largest speed: 0.02 rad at 3 rad/s and 30 Hz


@dataclass(frozen=True, kw_only=True)
class Reaction:
    """Reaction to one command or to one moment."""

    kind: Literal["pass", "limit", "hold", "stop"]
    target: np.ndarray | None
    """(A,) command to send; None: none, the position is already held or the robot is stopped."""
    reason: str = ""


@dataclass(kw_only=True)
class Observed:
    """Observation as the guard sees it."""

    position: np.ndarray
    """(A,) present position in the order and units of actions."""
    ages_s: Mapping[str, float]
    """Channel, ``kind`` or ``kind:name``, such as ``pad:left_a`` → age [s]."""
    pad_counts: Mapping[str, float] = field(default_factory=dict)
    """Pad → sum of its counts above baseline."""
    effort: np.ndarray | None = None
    """(A,) efforts of the motors; None: the robot reports none."""
    unchanged_s: Mapping[str, float] = field(default_factory=dict)
    """Channel → time for which it has shown nothing new, where that is known [s]."""
    notes: Mapping[str, str] = field(default_factory=dict)
    """Channel → why nothing new of it can be used, such as: it repeats itself."""
    at_s: float | None = None
    """Time at which the ages were taken [s of the guard's clock]; None: now."""


class Stopped(TaccorlError):
    """The robot was stopped for a reason of safety, and accepts no command until it is connected again."""


class Guard:
    """Decides on every command of one robot. ``names``: of the A actions. ``clock``: seconds that never go back. Raises
    TaccorlError: the unit of a robot's speeds is not stated, or an option names no action."""

    def __init__(
        self,
        config: SafetyConfig,
        names: Sequence[str],
        period_s: float,
        clock: Callable[[], float],
        *,
        piper: bool,
    ) -> None:
        self.config, self.names, self.period_s, self._clock = (
            config,
            tuple(names),
            period_s,
            clock,
        )
        for option in ("pad_sum_count", "max_skew_s", "stop_after_s", "watchdog_s"):
            positive(f"safety.{option}", getattr(config, option))
        self._max_age_s = dict(AGES_S)
        for kind, age_s in config.max_age_s.items():
            if kind not in AGES_S:
                text = f"safety.max_age_s: {nearest(kind, AGES_S)}"
                raise TaccorlError(f"{text}; kinds: {', '.join(AGES_S)}")
            self._max_age_s[kind] = positive(f"safety.max_age_s.{kind}", age_s)
        self._speed = self._by_name(
            "max_speed",
            config.max_speed or (PIPER_SPEED if piper else {}),
            required=True,
        )
        self._effort = self._by_name(
            "effort", config.effort or (PIPER_EFFORT if piper else {})
        )
        self._low = np.full(len(names), -np.inf)
        self._high = np.full(len(names), np.inf)
        if piper:
            self._low, self._high = ROBOT.action_low.copy(), ROBOT.action_high.copy()
        for name, given in config.ranges.items():
            ends = [number(f"safety.ranges.{name}", end) for end in given]
            if name not in names or len(ends) != 2 or not ends[0] < ends[1]:
                raise TaccorlError(
                    f"safety.ranges: {name}: {ends}: give [low, high] of one of {', '.join(names)}"
                )
            self._low[names.index(name)], self._high[names.index(name)] = ends
        box = [number("safety.workspace_m", end) for end in config.workspace_m]
        if box and (
            len(box) != 6
            or not all(a < b for a, b in zip(box[::2], box[1::2], strict=True))
        ):
            raise TaccorlError(
                f"safety.workspace_m={box}: give [x_low, x_high, y_low, y_high, z_low, z_high] m, or []"
            )
        self._box = np.array(box).reshape(3, 2) if box and piper else None
        self._hands = _hands() if self._box is not None else None
        self.stopped = ""
        """Reason of the stop; empty while the robot may move."""
        self.is_lost = False
        """Whether the reason is the connection or a sensor, not what the robot was told to do."""
        self.holding = ""
        """Reason for which the arms hold at present; empty while they follow."""
        self.is_unfit = False
        """Whether a number of the newest observation was refused, so that there is none."""
        self.counts = {"pass": 0, "limit": 0, "hold": 0, "stop": 0}
        self._causes: set[str] = set()  # of the present hold, or of the stop: logged
        self._now_s = -math.inf
        self._read_clock()
        self._sent: np.ndarray | None = None
        self._sent_s = self._asked_s = self._now_s
        self._late_s = 0.0  # between actions, lately
        self._observed: Observed | None = None
        self._stamps_s: dict[str, float] = {}
        """Channel → time of its newest sample."""
        self._rate = np.zeros(len(names))
        """Change of the observed position [1/s]."""

    def observed(self, seen: Observed) -> Reaction | None:
        """Take note of an observation; returns a reaction if it demands one at once."""
        self.is_unfit = True
        if fault := self._read_clock():
            return self.stop(fault, is_lost=True)
        try:
            seen, stamps_s = self._admitted(seen)
        except Unfit as error:
            return self.stop(str(error), is_lost=True)
        if jump := self._jump(seen, stamps_s["state"]):
            return self.stop(jump, is_lost=True)
        if absurd := self._absurd(seen.position):
            return self.stop(absurd, is_lost=True)
        self.is_unfit = False
        passed_s = stamps_s["state"] - self._stamps_s.get("state", -math.inf)
        if self._observed is not None and 0 < passed_s < 1:
            moved = seen.position / passed_s - self._observed.position / passed_s
            self._rate = np.clip(moved, -self._speed, self._speed)
        self._observed, self._stamps_s = seen, stamps_s
        for pad, count in seen.pad_counts.items():
            if count > self.config.pad_sum_count:
                return self.stop(
                    f"pad {pad} is pressed: {count:.0f} counts, at most {self.config.pad_sum_count:.0f}"
                )
        if (
            seen.effort is not None
            and (over := np.abs(seen.effort) > self._effort).any()
        ):
            k = int(np.argmax(over))
            return self.stop(
                f"effort of {self.names[k]}: {seen.effort[k]:.1f}, at most {self._effort[k]:g}"
            )
        return self._beyond(seen.position, "is")

    def _jump(self, seen: Observed, stamp_s: float) -> str:
        """Text on a position that no robot of these speeds can have moved to since the
        last one; empty if there is none."""
        if self._observed is None or not math.isfinite(
            before_s := self._stamps_s["state"]
        ):
            return ""
        passed_s = max(stamp_s - before_s, self.period_s) + self.config.max_skew_s
        moved = np.abs(seen.position - self._observed.position)
        if not (beyond := moved > _IMPOSSIBLE * self._speed * passed_s).any():
            return ""
        k = int(np.argmax(beyond))
        return (
            f"position of {self.names[k]} moved by {moved[k]:.3g} in {passed_s:.3g} s, more than "
            f"{_IMPOSSIBLE:g} times its largest speed {self._speed[k]:g}: the encoder or its reader is wrong"
        )

    def _absurd(self, position: np.ndarray) -> str:
        """Text on a position where no such joint can be; empty if there is none."""
        low, high = self._measured
        if not (beyond := (position < low) | (position > high)).any():
            return ""
        k = int(np.argmax(beyond))
        name = self.names[k]
        return (
            f"position of {name} is {position[k]:g}, possible is {low[k]:g} … "
            f"{high[k]:g}: the encoder, its unit or its reader is wrong; or correct "
            f"safety.ranges.{name} or safety.max_speed"
        )

    @property
    def _measured(self) -> tuple[np.ndarray, np.ndarray]:
        """(A,) lowest and highest position that a joint can have: its range and half as
        much on both sides; without a range as far as its largest speed leads in
        ``_FARTHEST_S``."""
        known = np.isfinite(self._low) & np.isfinite(self._high)
        beside = np.where(known, 0.5 * (self._high - self._low), 0.0)
        far = _FARTHEST_S * self._speed
        low = np.where(known, self._low - beside, -far)
        return low, np.where(known, self._high + beside, far)

    def _admitted(self, seen: Observed) -> tuple[Observed, dict[str, float]]:
        """The observation with every number checked, and the time of each channel's
        newest sample. Raises Unfit: a number is not finite or of another shape, a time
        is impossible, or something is missing that was there before."""
        position = vector("position", seen.position, self.names)
        effort = seen.effort
        if effort is not None:
            effort = vector("effort", effort, self.names)
        elif self._observed is not None and self._observed.effort is not None:
            raise Unfit("the robot reports no efforts any more")
        at_s = self._now_s if seen.at_s is None else number("the time", seen.at_s)
        stamps_s = {c: self._stamp(c, age, at_s) for c, age in seen.ages_s.items()}
        for channel in ("state", *self._stamps_s):
            if channel not in stamps_s:
                raise Unfit(f"{channel} has no time: is it missing?")
        counts = {p: number(f"sum of pad {p}", n) for p, n in seen.pad_counts.items()}
        unchanged_s = {
            channel: number(f"time without change of {channel}", time_s)
            for channel, time_s in seen.unchanged_s.items()
        }
        ages_s = {channel: at_s - stamp_s for channel, stamp_s in stamps_s.items()}
        found = Observed(
            position=position,
            ages_s=ages_s,
            pad_counts=counts,
            effort=effort,
            unchanged_s=unchanged_s,
            notes=seen.notes,
            at_s=at_s,
        )
        return found, stamps_s

    def _stamp(self, channel: str, age_s: float, at_s: float) -> float:
        """Time of a channel's newest sample; −inf if none came yet, whose age is inf.
        Raises Unfit: it is no time, lies ahead, or before the channel's last one."""
        if channel.partition(":")[0] not in self._max_age_s:
            raise Unfit(f"{channel}: no largest age of its kind is known")
        if age_s == math.inf:
            return -math.inf
        stamp_s = at_s - number(f"the age of {channel}", age_s)
        skew_s = self.config.max_skew_s
        if (ahead_s := stamp_s - at_s) > skew_s:
            text = f"{channel} is stamped {ahead_s:.3g} s ahead of the clock"
            raise Unfit(f"{text}, at most {skew_s:g} s")
        if (back_s := self._stamps_s.get(channel, -math.inf) - stamp_s) > skew_s:
            text = f"the time of {channel} went back by {back_s:.3g} s"
            raise Unfit(f"{text}, at most {skew_s:g} s")
        return stamp_s

    def command(self, action: Mapping[str, Any]) -> Reaction:
        """Decide on a new action, name → target."""
        if self.stopped:
            return Reaction(kind="stop", target=None, reason=self.stopped)
        if fault := self._read_clock():
            return self.stop(fault, is_lost=True)
        try:
            target = self._target(action)
        except Unfit as error:
            return self.stop(str(error))
        passed_s = self._now_s - self._asked_s if self._sent is not None else 0.0
        self._late_s, self._asked_s = max(0.9 * self._late_s, passed_s), self._now_s
        if self._observed is None:
            return self.stop("an action before the first observation")
        if (reaction := self._hold_or_stop()) is not None:
            return reaction
        if self.holding:
            _log.warning("the arms follow again: %s is over", self.holding)
            self.holding = ""
            self._causes.clear()
        before = self._observed.position if self._sent is None else self._sent
        passed_s = min(
            max(self._now_s - self._sent_s, self.period_s), 2 * self.period_s
        )
        limited = np.clip(
            target, before - self._speed * passed_s, before + self._speed * passed_s
        )
        limited = np.clip(limited, self._low, self._high)
        if not np.isfinite(limited).all():
            return self.stop("the limited action is not finite")
        if (reaction := self._beyond(limited, "would be")) is not None:
            return reaction
        kind = "pass" if np.allclose(limited, target, rtol=0, atol=1e-6) else "limit"
        self._sent, self._sent_s = limited, self._now_s
        self.counts[kind] += 1
        return Reaction(
            kind=kind, target=limited, reason="" if kind == "pass" else "speed or range"
        )

    def _target(self, action: Mapping[str, Any]) -> np.ndarray:
        """(A,) targets of an action. Raises Unfit: one is missing or no finite number."""
        if not isinstance(action, Mapping):
            raise Unfit(f"an action of type {type(action).__name__}, not name → target")
        missing = [name for name in self.names if name not in action]
        if missing:
            raise Unfit(f"an action without {', '.join(missing)}")
        return np.array([number(f"action {n}", action[n]) for n in self.names])

    def tick(self) -> Reaction | None:
        """To be called at least once a period, also if nobody commands: the watchdog. Returns a reaction if one is due."""
        fault = self._read_clock()
        if self.stopped or self._sent is None:
            return None
        if fault:
            return self.stop(fault, is_lost=True)
        reaction = self._hold_or_stop(is_idle=self.idle)
        return None if reaction is None or reaction.target is None else reaction

    def forget(self) -> None:
        """Forget what was observed and sent: the robot is elsewhere now."""
        self._observed = self._sent = None
        self._stamps_s = {}
        self._rate[:] = self._late_s = 0

    def _read_clock(self) -> str:
        """Read the clock; returns why its time cannot be, empty if it can."""
        now_s = self._clock()
        if math.isfinite(now_s) and now_s >= self._now_s:
            self._now_s = now_s
            return ""
        return f"the clock went from {self._now_s:.3f} s to {now_s:.3f} s"

    @property
    def is_late(self) -> bool:
        """True if a channel of the newest observation is older than ``max_age_s``."""
        if (seen := self._observed) is None:  # asked by another thread, too
            return False
        return any(age_s > self._most_s(c) for c, age_s in _ages_s(seen).items())

    def _most_s(self, channel: str) -> float:
        return self._max_age_s[channel.partition(":")[0]]

    @property
    def idle(self) -> bool:
        """True if nobody has commanded for ``watchdog_s``."""
        return self._now_s - self._asked_s > self.config.watchdog_s

    def stop(self, reason: str, *, is_lost: bool = False) -> Reaction:
        """Stop the robot: the reaction commands the present position, and every later action is refused with ``reason``."""
        if self.stopped:
            if self._is_new_cause(_NUMBER.sub("", reason)):
                _log.error("after the stop: %s", reason)
            return Reaction(kind="stop", target=None, reason=self.stopped)
        self._read_clock()
        self._causes = {_NUMBER.sub("", reason)}
        if self._late_s > 3 * self.period_s and not is_lost:
            reason += f"; the loop was late: no action for {self._late_s:.2f} s"
        self.stopped, self.is_lost = reason, is_lost
        self.counts["stop"] += 1
        _log.error(
            "STOPPED: %s; no command is accepted until the robot is connected again",
            reason,
        )
        return Reaction(kind="stop", target=self._here(), reason=reason)

    def _is_new_cause(self, cause: str) -> bool:
        """True for a cause that was not logged since the arms followed; it now is."""
        is_new = cause not in self._causes
        self._causes.add(cause)
        return is_new

    def _here(self) -> np.ndarray | None:
        """Present position, extrapolated from the observed one. What is at its target keeps it, because a controller rests
        a little beside its target; and so do grippers, so that what is gripped stays gripped."""
        if self._observed is None:
            return None
        passed_s = max(self._now_s - self._stamps_s["state"], 0.0)
        passed_s = min(passed_s, 2 * self.period_s)
        measured = np.clip(self._observed.position, self._low, self._high)
        here = np.clip(measured + passed_s * self._rate, self._low, self._high)
        here = np.where(np.isfinite(here), here, measured)
        if self._sent is not None:
            rests = (
                np.abs(self._sent - here) <= _AT_TARGET * self._speed * self.period_s
            )
            rests |= ["gripper" in name for name in self.names]
            here[rests] = self._sent[rests]
        return here

    def _hold_or_stop(self, *, is_idle: bool = False) -> Reaction | None:
        """Reaction to channels that are old and, if ``is_idle``, to missing actions. A
        hold repeats the present position once, and logs each of its causes once."""
        assert self._observed is not None
        causes = {}
        for channel, age_s in _ages_s(self._observed).items():
            most_s, last_s = self._most_s(channel), self.config.stop_after_s
            if age_s <= min(most_s, last_s):
                continue
            note = self._observed.notes.get(channel, "")
            kind = channel.partition(":")[0]
            limit_s, option = most_s, f"max_age_s.{kind}"
            if age_s > last_s:
                limit_s, option = last_s, "stop_after_s"
            reason = (
                f"the newest sample of {channel} is {age_s:.2f} s old, at most {limit_s:g} s (safety.{option}): "
                f"{note or 'its driver sends none'}"
            )
            if age_s > last_s:
                return self.stop(reason, is_lost=True)
            causes[f"{channel} {note}"] = reason
        if is_idle:
            causes["idle"] = f"no action for {self.config.watchdog_s:g} s"
        if not causes:
            return None
        target = None
        if not self.holding:
            target = self._here()
            self._sent, self._sent_s = target, self._now_s
            self.counts["hold"] += 1
        for cause, reason in causes.items():
            if self._is_new_cause(cause):
                _log.warning("the arms hold: %s", reason)
        self.holding = "; ".join(causes.values())
        return Reaction(kind="hold", target=target, reason=self.holding)

    def _beyond(self, position: np.ndarray, verb: str) -> Reaction | None:
        """Stop if a hand is, or would be, outside of the workspace."""
        if self._box is None or self._hands is None:
            return None
        for arm, hand in zip(ROBOT.arms, self._hands(position), strict=True):
            low, high = self._box.T  # NaN lies outside, too
            if not ((hand >= low) & (hand <= high)).all():
                place = ", ".join(f"{x:.3f}" for x in hand)
                return self.stop(
                    f"the {arm} hand {verb} at ({place}) m, outside of safety.workspace_m"
                )
        return None

    def limits(self) -> list[str]:
        """Lines: all limits in force, in the units of the robot's actions."""
        config, box = self.config, self._box
        ages = ", ".join(f"{k} {age:g} s" for k, age in self._max_age_s.items())
        place = "no limit" if box is None else f"{box.tolist()} m (x, y, z)"
        rows = zip(
            self.names, self._speed, self._low, self._high, self._effort, strict=True
        )
        measured = zip(self.names, *self._measured, strict=True)
        return [
            *(
                f"{name}: {speed:g} a second, {low:g} … {high:g}, effort {effort:g}"
                for name, speed, low, high, effort in rows
            ),
            "measured: "
            + ", ".join(f"{n} {low:g} … {high:g}" for n, low, high in measured),
            f"hands: {place}",
            f"sum of a pad: {config.pad_sum_count:g} counts",
            f"age at which the arms hold: {ages}; at which they stop: "
            f"{config.stop_after_s:g} s",
            f"time without an action: {config.watchdog_s:g} s",
            f"time stamps ahead of the clock, or back: {config.max_skew_s:g} s",
        ]

    def _by_name(
        self, option: str, limits: Mapping[str, float], *, required: bool = False
    ) -> np.ndarray:
        """(A,) limits: of each action's name the first whose end fits."""
        limits = {e: positive(f"safety.{option}.{e}", v) for e, v in limits.items()}
        found = [
            next((v for end, v in limits.items() if name.endswith(end)), math.inf)
            for name in self.names
        ]
        unused = [
            end for end in limits if not any(name.endswith(end) for name in self.names)
        ]
        without = [
            name
            for name, value in zip(self.names, found, strict=True)
            if math.isinf(value)
        ]
        if unused:
            raise TaccorlError(
                f"safety.{option}: no action ends with {unused[0]}; actions: {', '.join(self.names)}"
            )
        if required and without:
            text = f"safety.{option}: no limit for {without[0]}, whose unit only its robot knows"
            raise TaccorlError(
                f"{text}; give one per second: --robot.safety.{option}='{{pos: 90}}' for degrees"
            )
        return np.array(found)


def _ages_s(seen: Observed) -> dict[str, float]:
    """Channel → age of its last new sample [s]."""
    return {
        channel: max(age_s, seen.unchanged_s.get(channel, 0.0))
        for channel, age_s in seen.ages_s.items()
    }


def _hands() -> Callable[[np.ndarray], list[np.ndarray]]:
    """Function from (14,) [rad, m] to the positions (3,) [m] of both hands' TCPs in the twin's world."""
    from taccorl.sim.robot import RobotConfig
    from taccorl.tasks.experts.kinematics import ArmKinematics

    arms = {
        arm: ArmKinematics(arm, RobotConfig()) for arm in ROBOT.arms
    }  # in torch it takes 1 ms of every period
    return lambda state: [
        one.pose(state[ROBOT.joint_slice(arm)])[:3, 3] for arm, one in arms.items()
    ]

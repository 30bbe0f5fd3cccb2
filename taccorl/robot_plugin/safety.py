"""Safety of any robot as a pure decision: which command is passed on, limited, held or refused, and why.

    reaction   what happens                                      causes
    limit      the command is clipped, and counted               speed, range
    hold       the present position is the command, until the    old observation (a channel older than max_age_s), no new
               cause is over                                     action for watchdog_s
    stop       the present position is the last command; no      action NaN or incomplete, pressed pad, effort of a motor,
               command is accepted until the next connect        workspace, lost connection, an observation older than
                                                                 stop_after_s

Letters in shapes: A numbers of an action, in the robot's own units.
"""

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from taccorl.errors import TaccorlError
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
    """Kind of a channel (state, camera, pad) → age from which the arms hold [s]."""
    stop_after_s: float = 1.0
    """Age of a channel from which holding becomes a stop [s]."""
    watchdog_s: float = 0.2
    """Time without a new action after which the arms hold [s]."""


PIPER_SPEED = {"gripper.pos": 0.5, ".pos": 3.0}
"""End of an action's name → largest speed of a PiPER [m/s, rad/s]; its manual allows 3.1 rad/s."""
PIPER_EFFORT = {"gripper.pos": 45.0, ".pos": 15.0}
"""End of an action's name → effort that a PiPER stops at [N, N·m]. In the twin, experts take up to 37 N and 5.6 N·m, 1.1
rad/s and 24 thousand counts of a pad."""

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
        self._speed = self._by_name(
            "max_speed",
            config.max_speed or (PIPER_SPEED if piper else {}),
            required=True,
        )
        self._effort = self._by_name(
            "effort", config.effort or (PIPER_EFFORT if piper else {})
        )
        self._low, self._high = (
            np.full(len(names), -np.inf),
            np.full(len(names), np.inf),
        )
        if piper:
            self._low, self._high = ROBOT.action_low.copy(), ROBOT.action_high.copy()
        for name, ends in config.ranges.items():
            if name not in names or len(ends) != 2 or not ends[0] < ends[1]:
                raise TaccorlError(
                    f"safety.ranges: {name}: {ends}: give [low, high] of one of {', '.join(names)}"
                )
            self._low[names.index(name)], self._high[names.index(name)] = ends
        box = config.workspace_m
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
        self.counts = {"pass": 0, "limit": 0, "hold": 0, "stop": 0}
        self._sent: np.ndarray | None = None
        self._sent_s, self._asked_s, self._late_s = (
            clock(),
            clock(),
            0.0,
        )  # _late_s: between actions, lately
        self._observed: Observed | None = None
        self._at_s, self._rate = (
            clock(),
            np.zeros(len(names)),
        )  # of the observed position: its time, its change [1/s]

    def observed(self, seen: Observed) -> Reaction | None:
        """Take note of an observation; returns a reaction if it demands one at once."""
        at_s = self._clock() - seen.ages_s.get("state", 0.0)
        if self._observed is not None and 0 < at_s - self._at_s < 1:
            self._rate = (seen.position - self._observed.position) / (at_s - self._at_s)
        self._observed, self._at_s = seen, at_s
        if self.stopped:
            return None
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

    def command(self, action: Mapping[str, float]) -> Reaction:
        """Decide on a new action, name → target."""
        if self.stopped:
            return Reaction(kind="stop", target=None, reason=self.stopped)
        missing = [name for name in self.names if name not in action]
        if missing:
            return self.stop(f"an action without {', '.join(missing)}")
        target = np.array([float(action[name]) for name in self.names])
        if not np.isfinite(target).all():
            return self.stop(
                f"action {self.names[int(np.argmin(np.isfinite(target)))]} is not finite"
            )
        passed_s = self._clock() - self._asked_s if self._sent is not None else 0.0
        self._late_s, self._asked_s = max(0.9 * self._late_s, passed_s), self._clock()
        if self._observed is None:
            return self._hold("nothing was observed yet")
        if (reaction := self._too_old()) is not None:
            return reaction
        if self.holding:
            _log.warning("the arms follow again: %s is over", self.holding)
            self.holding = ""
        before = self._observed.position if self._sent is None else self._sent
        passed_s = min(
            max(self._clock() - self._sent_s, self.period_s), 2 * self.period_s
        )
        limited = np.clip(
            target, before - self._speed * passed_s, before + self._speed * passed_s
        )
        limited = np.clip(limited, self._low, self._high)
        if (reaction := self._beyond(limited, "would be")) is not None:
            return reaction
        kind = "pass" if np.allclose(limited, target, rtol=0, atol=1e-6) else "limit"
        self._sent, self._sent_s = limited, self._clock()
        self.counts[kind] += 1
        return Reaction(
            kind=kind, target=limited, reason="" if kind == "pass" else "speed or range"
        )

    def tick(self) -> Reaction | None:
        """To be called at least once a period, also if nobody commands: the watchdog. Returns a reaction if one is due."""
        if self.stopped or self._sent is None:
            return None
        if (reaction := self._too_old()) is not None:
            return reaction if reaction.target is not None else None
        if not self.holding and self.idle:
            return self._hold(f"no action for {self.config.watchdog_s:g} s")
        return None

    def forget(self) -> None:
        """Forget what was observed and sent: the robot is elsewhere now."""
        self._observed = self._sent = None
        self._rate[:] = self._late_s = 0

    @property
    def is_late(self) -> bool:
        """True if a channel of the newest observation is older than ``max_age_s``."""
        ages = self._observed.ages_s.items() if self._observed is not None else ()
        return any(age_s > self._most_s(channel) for channel, age_s in ages)

    def _most_s(self, channel: str) -> float:
        return self.config.max_age_s.get(channel.partition(":")[0], math.inf)

    @property
    def idle(self) -> bool:
        """True if nobody has commanded for ``watchdog_s``."""
        return self._clock() - self._asked_s > self.config.watchdog_s

    def stop(self, reason: str, *, is_lost: bool = False) -> Reaction:
        """Stop the robot: the reaction commands the present position, and every later action is refused with ``reason``."""
        if self.stopped:
            return Reaction(kind="stop", target=None, reason=self.stopped)
        if self._late_s > 3 * self.period_s and not is_lost:
            reason += f"; the loop was late: no action for {self._late_s:.2f} s"
        self.stopped, self.is_lost = reason, is_lost
        self.counts["stop"] += 1
        _log.error(
            "STOPPED: %s; no command is accepted until the robot is connected again",
            reason,
        )
        return Reaction(kind="stop", target=self._here(), reason=reason)

    def _here(self) -> np.ndarray | None:
        """Present position, extrapolated from the observed one. What is at its target keeps it, because a controller rests
        a little beside its target; and so do grippers, so that what is gripped stays gripped."""
        if self._observed is None:
            return None
        passed_s = min(self._clock() - self._at_s, 2 * self.period_s)
        here = np.clip(
            self._observed.position + passed_s * self._rate, self._low, self._high
        )
        if self._sent is not None:
            rests = (
                np.abs(self._sent - here) <= _AT_TARGET * self._speed * self.period_s
            )
            rests |= ["gripper" in name for name in self.names]
            here[rests] = self._sent[rests]
        return here

    def _hold(self, reason: str) -> Reaction:
        target = None
        if not self.holding:
            _log.warning("the arms hold: %s", reason)
            target = self._here()
            self.counts["hold"] += 1
            if target is not None:
                self._sent, self._sent_s = target, self._clock()
        self.holding = reason
        return Reaction(kind="hold", target=target, reason=reason)

    def _too_old(self) -> Reaction | None:
        assert self._observed is not None
        for channel, age_s in self._observed.ages_s.items():
            if age_s > self.config.stop_after_s:
                reason = f"{channel} is {age_s:.2f} s old, at most {self.config.stop_after_s:g} s"
                return self.stop(reason, is_lost=True)
            if age_s > (most_s := self._most_s(channel)):
                return self._hold(
                    f"{channel} is {age_s:.2f} s old, at most {most_s:g} s"
                )
        return None

    def _beyond(self, position: np.ndarray, verb: str) -> Reaction | None:
        """Stop if a hand is, or would be, outside of the workspace."""
        if self._box is None or self._hands is None:
            return None
        for arm, hand in zip(ROBOT.arms, self._hands(position), strict=True):
            if (hand < self._box[:, 0]).any() or (hand > self._box[:, 1]).any():
                place = ", ".join(f"{x:.3f}" for x in hand)
                return self.stop(
                    f"the {arm} hand {verb} at ({place}) m, outside of safety.workspace_m"
                )
        return None

    def _by_name(
        self, option: str, limits: Mapping[str, float], *, required: bool = False
    ) -> np.ndarray:
        """(A,) limits: of each action's name the first whose end fits."""
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
        if any(not value > 0 for value in found):
            raise TaccorlError(
                f"safety.{option}: {dict(limits)}: limits must be above 0"
            )
        return np.array(found)


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

"""LeRobot robots with touch and safety: any robot with pads, the surrogate, two PiPERs; and the surrogate's leader."""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from functools import cached_property, partial
from typing import Any

import cv2
import draccus
import numpy as np
from lerobot.robots import Robot, RobotConfig, make_robot_from_config
from lerobot.teleoperators.teleoperator import Teleoperator

from taccorl.data.pictures import letterbox
from taccorl.errors import TaccorlError
from taccorl.robot_plugin import config_robots, lerobot_hooks
from taccorl.robot_plugin.bodies import (
    ARM_NAMES,
    Body,
    LeRobotBody,
    SurrogateArms,
    SurrogatePads,
)
from taccorl.robot_plugin.config_robots import TouchOptions, TouchRobotConfig
from taccorl.robot_plugin.lerobot_hooks import TouchFeature, TouchReading
from taccorl.robot_plugin.mcap_log import McapLog
from taccorl.robot_plugin.pads import Pads, PadsConfig
from taccorl.robot_plugin.piper import TwoPipers
from taccorl.robot_plugin.safety import Guard, Observed, Reaction, Stopped
from taccorl.robot_plugin.surrogate_link import LEADER_ROLE, SurrogateLink
from taccorl.surrogate.drivers import COMMAND_TOPICS, STATE_TOPICS
from taccorl.views.colors import heat

_log = logging.getLogger(__name__)
TOUCH = "tactile"
"""Key of touch in an observation: ``observation.tactile`` of datasets and policies."""
_NO_ANSWER = (
    OSError,
    RuntimeError,
)  # of LeRobot's robots and cameras; its DeviceNotConnectedError is an OSError
HELD_SHARE = 1.2
"""Longest p99 of the period of a loop that is held, in periods: 40 ms at 30 Hz."""


class TouchRobot(Robot):
    """LeRobot's ``Robot`` made of arms and cameras (``Body``), tactile pads (``Pads``) and limits (``Guard``).

    Observations: the body's joints, pictures, and ``tactile``."""

    config_class = TouchRobotConfig
    name = "touch_robot"
    is_calibrated = True  # pyright: ignore[reportAssignmentType]

    def __init__(
        self, config: TouchOptions, clock: Callable[[], float] = time.monotonic
    ) -> None:
        super().__init__(config)
        lerobot_hooks.install()  # LeRobot's scripts are loaded by now
        self.config, self._clock = config, clock
        self.body: Body = self._body()
        pads, name = (
            self._pads_config(),
            config.type + (f"_{self.id}" if self.id else ""),
        )  # not one of two kinds
        self.pads = (
            Pads(pads, self.calibration_dir / f"{name}_pads.json", self._felt, clock)
            if pads
            else None
        )
        self.is_piper = tuple(self.body.names) == ARM_NAMES
        if config.record is not None and not self.is_piper:
            raise TaccorlError(
                f"--robot.record: recordings have the PiPER's names; {self.name} has others: remove it"
            )
        self.guard = self._new_guard()
        self.cameras = dict.fromkeys(self.body.cameras)  # LeRobot counts its keys
        self.timing: dict[str, deque[float]] = {}
        """``period``, ``policy``, and ``age of <channel>`` → newest values [s]."""
        self._lock = threading.RLock()
        self._log: McapLog | None = None
        self._thread: threading.Thread | None = None
        self._ended = threading.Event()
        self._new_picture: dict[str, tuple[np.ndarray, float]] = {}
        self._seen_s = self._sent_s = -np.inf
        self.body.listeners.append(self._sampled)

    def _body(self) -> Body:
        assert isinstance(self.config, TouchRobotConfig)
        try:
            return LeRobotBody(
                make_robot_from_config(draccus.decode(RobotConfig, self.config.robot))
            )
        except (draccus.utils.DecodingError, ValueError, ImportError) as error:
            raise TaccorlError(
                f"--robot.robot={self.config.robot}: {' '.join(str(error).split())}"
            ) from error

    def _pads_config(self) -> PadsConfig | None:
        return getattr(self.config, "pads", None)

    def _new_guard(self) -> Guard:
        return Guard(
            self.config.safety,
            self.body.names,
            1 / self.config.fps,
            self._clock,
            piper=self.is_piper,
        )

    @cached_property
    def observation_features(self) -> dict[str, Any]:
        px, sizes = self.config.picture_px, self.body.cameras
        features: dict[str, Any] = dict.fromkeys(self.body.names, float)
        features |= {name: (px, px, 3) if px else (*sizes[name], 3) for name in sizes}
        return features | (
            {TOUCH: TouchFeature.of(self.pads, self.body.origin)} if self.pads else {}
        )

    @cached_property
    def action_features(self) -> dict[str, Any]:
        return dict.fromkeys(self.body.names, float)

    @property
    def is_connected(self) -> bool:
        return self.body.is_connected

    def calibrate(self) -> None:
        """Take the pads' baseline again."""
        if self.pads is not None:
            self.pads.calibrate()

    def configure(self) -> None: ...
    def connect(self, calibrate: bool = True) -> None:
        """Connect arms, cameras and pads, and take the pads' baseline. Raises TaccorlError: the policy that LeRobot has loaded
        does not fit the robot; a part does not answer; pads are touched, exchanged or unplugged."""
        lerobot_hooks.check_policy(
            self.observation_features, self.body.names, self.pads, self.config.fps
        )
        if self.is_piper:
            lerobot_hooks.check_units()
        self.body.connect()
        try:
            if self.config.record is not None:
                said = getattr(self.body, "instruction", "") or "not stated"
                is_polled = not isinstance(
                    self.body, SurrogateArms
                )  # states come with the loop, as commands do
                topics = [
                    *COMMAND_TOPICS.values(),
                    *(STATE_TOPICS.values() if is_polled else ()),
                ]
                rates_hz = dict.fromkeys(topics, self.config.fps)
                self._log = McapLog(
                    self.config.record, self.body.origin, said, self._clock, rates_hz
                )
            if self.pads is not None:
                self.pads.connect()
        except TaccorlError:
            self.body.disconnect()
            raise
        self.guard, self.timing = self._new_guard(), {}
        self._ended.clear()
        self._thread = threading.Thread(
            target=self._watch, daemon=True, name="watchdog"
        )
        self._thread.start()

    def begin_episode(self, seed: int | None = None) -> None:
        """Begin an episode; a surrogate in the scene of ``seed``, or the next one. Raises TaccorlError: it does not answer."""
        with self._lock:
            self._seen_s = (
                self._sent_s
            ) = -np.inf  # what passed since the last episode is no period
            if self._log is not None:
                self._log.pause()
            if isinstance(self.body, SurrogateArms) and self.pads is not None:
                self.body.reset(seed)
                self.pads.forget()
                self.guard.forget()

    def instruct(self, text: str) -> None:
        """Record ``text``, the task given to LeRobot, as the instruction."""
        if self._log is not None and text:
            self._log.instruction = text

    def get_observation(self) -> dict[str, Any]:
        """The present observation. Raises Stopped: the connection is lost, or the robot does not answer."""
        try:
            if self.body.is_lost:
                raise ConnectionError("the connection is lost")
            sample = self.body.read()
        except _NO_ANSWER as error:
            with self._lock:
                self._react(
                    self.guard.stop(f"the robot does not answer: {error}", is_lost=True)
                )
            raise Stopped(f"stopped: {self.guard.stopped}") from error
        now_s = self._clock()
        ages = {
            channel: now_s - stamp_s for channel, stamp_s in sample.stamps_s.items()
        }
        for name, picture in sample.pictures.items():
            # A camera that repeats itself is as old as its last new picture: a sensor's noise is never twice the same.
            if not np.array_equal(
                self._new_picture.get(name, (np.empty(0), 0.0))[0], picture
            ):
                self._new_picture[name] = picture.copy(), now_s - ages[f"camera:{name}"]
            ages[f"camera:{name}"] = max(
                ages[f"camera:{name}"], now_s - self._new_picture[name][1]
            )
        px = self.config.picture_px
        seen: dict[str, Any] = dict(
            zip(self.body.names, sample.position.tolist(), strict=True)
        )
        seen |= {
            name: letterbox(p, px, px) if px else p
            for name, p in sample.pictures.items()
        }
        sums = {}
        if self.pads is not None:
            rows, stride = lerobot_hooks.window()
            touch, felt = self.pads.at(
                now_s, rows=rows, period_s=stride / self.config.fps
            )
            ages |= {f"pad:{name}": age_s for name, age_s in felt.items()}
            parts = dict(
                zip(
                    self.pads.names,
                    touch[-1].reshape(self.pads.layout).astype(int),
                    strict=True,
                )
            )
            sums = {
                name: float(np.maximum(counts, 0).sum())
                for name, counts in parts.items()
            }
            seen[TOUCH] = TouchReading(
                touch[-1], touch, partial(_shown, parts, self.pads.spec.max_count)
            )
        found = Observed(
            position=sample.position, ages_s=ages, pad_counts=sums, effort=sample.effort
        )
        with self._lock:
            self._react(self.guard.observed(found))
        for channel, age_s in ages.items():
            self._timed(f"age of {channel}", age_s)
        self._seen_s = self._clock()
        return seen

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Send an action as far as safety lets it pass; returns what was sent. Raises Stopped: the robot was stopped."""
        now_s = self._clock()
        if (
            self._seen_s > self._sent_s
        ):  # LeRobot's return to the first position observes nothing
            self._timed("policy", now_s - self._seen_s)
            if self._sent_s > 0:
                self._timed("period", now_s - self._sent_s)
            self._sent_s = now_s
        with self._lock:
            reaction = self.guard.command(action)
            self._react(reaction)
        if self.guard.stopped:
            raise Stopped(f"stopped: {self.guard.stopped}")
        return (
            action
            if reaction.target is None
            else dict(zip(self.body.names, reaction.target.tolist(), strict=True))
        )

    def disconnect(self) -> None:
        """Disconnect everything, and say how the loop went."""
        self._ended.set()
        if self._thread is not None:
            self._thread.join(timeout=1.0)
        if self.pads is not None:
            self.pads.close()
        self.body.disconnect()
        if self._log is not None:
            self._log.close()
        for line in self.summary():
            (print if self.config.dry_run else _log.info)(line)

    def summary(self) -> list[str]:
        """Lines: p50 and p99 of ages, latencies and the period [ms]; whether the loop is held; what safety did."""
        lines = [
            f"{self.name}{' (dry run, nothing was sent)' if self.config.dry_run else ''}: {self.body.origin}"
        ]
        for what, values in sorted(self.timing.items()):
            p50, p99 = np.percentile(list(values), [50, 99]) * 1e3
            lines.append(f"  {what}: p50 {p50:.1f} ms, p99 {p99:.1f} ms")
        periods = np.array(self.timing.get("period", ()))
        if len(periods) > 1:
            most_s = HELD_SHARE / self.config.fps
            p99, mean = float(np.percentile(periods, 99)), float(periods.mean())
            verdict = (
                "can" if p99 <= most_s and mean <= 1.015 / self.config.fps else "CANNOT"
            )
            text = f"p99 of the period {1e3 * p99:.1f} ms, at most {1e3 * most_s:.1f}; mean {1e3 * mean:.2f} ms"
            lines.append(
                f"  a loop of {self.config.fps:g} Hz {verdict} be held: {text}"
            )
        counts = ", ".join(f"{n} {kind}" for kind, n in self.guard.counts.items() if n)
        return [
            *lines,
            f"  commands and reactions: {counts or 'none'}; {self.guard.stopped or 'not stopped'}",
        ]

    def _react(self, reaction: Reaction | None) -> None:
        if (
            reaction is None
            or reaction.target is None
            or self.config.dry_run
            or self.body.is_lost
        ):
            return
        if self._log is not None:
            self._log.command(reaction.target)
        try:
            self.body.send(reaction.target)
        except _NO_ANSWER as error:  # also in the watchdog's thread, which must go on
            self.guard.stop(f"the robot takes no command: {error}", is_lost=True)

    def _watch(self) -> None:
        while not self._ended.wait(1 / self.config.fps):
            with self._lock:
                if self.body.is_lost:
                    self.guard.stop("the connection is lost", is_lost=True)
                else:
                    self._tick()

    def _tick(self) -> None:
        reaction = self.guard.tick()
        self._react(reaction)
        if self._log is not None and (self.guard.stopped or self.guard.idle):
            self._log.pause()

    def _timed(self, what: str, value_s: float) -> None:
        self.timing.setdefault(what, deque(maxlen=100_000)).append(value_s)

    def _sampled(self, kind: str, stamp_s: float, name: str, value: Any) -> None:
        if (
            self._log is not None and kind != "pad"
        ):  # a surrogate's link has pads, too: _felt writes them
            self._log.state(stamp_s, value) if kind == "state" else self._log.picture(
                stamp_s, name, value
            )

    def _felt(self, stamp_s: float, name: str, frame: np.ndarray) -> None:
        if self._log is not None:
            self._log.pad(stamp_s, name, frame)


def _shown(
    pads: dict[str, np.ndarray], most_count: float, factor: int = 6
) -> np.ndarray:
    """Counts above baseline (rows, columns) of each pad as one picture, with their names, in the colours of our views."""
    tiles = []
    for name, counts in pads.items():
        tile = np.pad(
            heat(counts / most_count).repeat(factor, 0).repeat(factor, 1),
            ((18, 4), (4, 4), (0, 0)),
        )
        tiles.append(
            cv2.putText(
                tile,
                name,
                (4, 12),
                cv2.FONT_HERSHEY_SIMPLEX,
                0.4,
                (255, 255, 255),
                1,
                cv2.LINE_AA,
            )
        )
    return np.concatenate(tiles, axis=1)


class TaccorlSurrogate(TouchRobot):
    """A surrogate robot: names, units, pads and cameras as in the data spec of the PiPERs, whose ``robot_type`` its datasets
    have so that they merge; their ``domains`` state surrogate."""

    config_class = config_robots.TaccorlSurrogateConfig
    name = "bi_piper_flexitac"

    def _body(self) -> SurrogateArms:
        assert isinstance(self.config, config_robots.TaccorlSurrogateConfig)
        link = SurrogateLink(
            self.config.port, lost_s=self.config.lost_after_s, clock=self._clock
        )
        return SurrogateArms(link, self.config.camera_names, self.config.camera_px)

    def _pads_config(self) -> PadsConfig:
        assert isinstance(self.body, SurrogateArms)
        return SurrogatePads(link=self.body.link)


class SurrogateLeader(Teleoperator):
    """Leader arms of a surrogate."""

    config_class = config_robots.SurrogateLeaderConfig
    name = "taccorl_surrogate_leader"
    is_calibrated = True  # pyright: ignore[reportAssignmentType]
    feedback_features: dict[str, Any] = {}  # noqa: RUF012  LeRobot's interface

    def __init__(self, config: config_robots.SurrogateLeaderConfig) -> None:
        super().__init__(config)
        self._link = SurrogateLink(config.port, LEADER_ROLE)

    @property
    def action_features(self) -> dict[str, Any]:
        return dict.fromkeys(ARM_NAMES, float)

    @property
    def is_connected(self) -> bool:
        return self._link.is_connected

    def connect(self, calibrate: bool = True) -> None:
        self._link.connect()

    def calibrate(self) -> None: ...
    def configure(self) -> None: ...
    def get_action(self) -> dict[str, Any]:
        """The leader's present position, name → [rad, m]. Raises TaccorlError: the surrogate is gone."""
        until = time.monotonic() + 5.0
        while self._link.lead is None or self._link.is_lost:
            if time.monotonic() > until:
                raise TaccorlError(
                    f"surrogate on port {self._link.port}: nothing comes of its leader"
                )
            time.sleep(0.005)
        return dict(zip(ARM_NAMES, self._link.lead, strict=True))

    def send_feedback(self, feedback: dict[str, Any]) -> None: ...
    def disconnect(self) -> None:
        self._link.close()


class BiPiperFlexitac(TouchRobot):
    """Two PiPERs with FlexiTac pads. Never tried on hardware."""

    config_class = config_robots.BiPiperFlexitacConfig
    name = "bi_piper_flexitac"

    def _body(self) -> Body:
        assert isinstance(self.config, config_robots.BiPiperFlexitacConfig)
        return TwoPipers(self.config)

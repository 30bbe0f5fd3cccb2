"""LeRobot robots with touch and safety: any robot with pads, the surrogate, two PiPERs; and the surrogate's leader."""

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
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
    Sample,
    SurrogateArms,
    SurrogatePads,
)
from taccorl.robot_plugin.config_robots import TouchOptions, TouchRobotConfig
from taccorl.robot_plugin.faults import (
    Repeats,
    Unfit,
    close_all,
    described,
    number,
    positive,
)
from taccorl.robot_plugin.lerobot_hooks import TouchFeature, TouchReading
from taccorl.robot_plugin.mcap_log import McapLog
from taccorl.robot_plugin.pads import REPEATED, Pads, PadsConfig
from taccorl.robot_plugin.piper import TwoPipers
from taccorl.robot_plugin.safety import Guard, Observed, Reaction, Stopped
from taccorl.robot_plugin.surrogate_link import LEADER_ROLE, SurrogateLink
from taccorl.surrogate.drivers import COMMAND_TOPICS, STATE_TOPICS
from taccorl.views.colors import heat

_log = logging.getLogger(__name__)
TOUCH = "tactile"
"""Key of touch in an observation: ``observation.tactile`` of datasets and policies."""
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
        positive("--robot.fps", config.fps)
        if config.picture_px < 0:
            text = f"--robot.picture_px={config.picture_px}: must not be below 0"
            raise TaccorlError(text)
        self.body: Body = self._body()
        pads, name = (
            self._pads_config(),
            config.type + (f"_{self.id}" if self.id else ""),
        )  # not one of two kinds
        self.pads = (
            Pads(
                pads,
                self.calibration_dir / f"{name}_pads.json",
                self._felt,
                clock,
                config.safety.max_skew_s,
            )
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
        self._new_picture: dict[str, _Picture] = {}
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
        """True from ``connect`` to ``disconnect``, also if the body is lost meanwhile:
        LeRobot disconnects only what is connected."""
        return self._thread is not None

    def calibrate(self) -> None:
        """Take the pads' baseline again."""
        if self.pads is not None:
            self.pads.calibrate()

    def configure(self) -> None: ...
    def connect(self, calibrate: bool = True) -> None:
        """Connect arms, cameras and pads, and take the pads' baseline. If one part fails, all are closed again. Raises
        TaccorlError: the policy that LeRobot has loaded does not fit the robot; a part does not answer; pads are touched,
        exchanged, dead or unplugged."""
        if self.is_connected:
            raise TaccorlError(f"{self.name} is connected already: disconnect it first")
        lerobot_hooks.check_policy(
            self.observation_features, self.body.names, self.pads, self.config.fps
        )
        if self.is_piper:
            lerobot_hooks.check_units()
        self._ended = threading.Event()  # of this connection: its watchdog keeps it
        self._new_picture, self.timing = {}, {}
        part = "arms and cameras"
        try:
            self.body.connect()
            if self.config.record is not None:
                part = "recording"
                self._log = self._new_log(self.config.record)
            if self.pads is not None:
                part = "pads"
                self.pads.connect()
            self.guard = self._new_guard()
            thread = threading.Thread(target=self._watch, daemon=True, name="watchdog")
            thread.start()
        except BaseException as error:
            log = self._log
            failures = self._close()
            if log is not None:
                log.discard()
            if isinstance(error, KeyboardInterrupt):
                raise
            is_ours = isinstance(error, TaccorlError)
            text = described(error) if is_ours else f"{part}: {described(error)}"
            raise TaccorlError("; ".join([text, *failures])) from error
        self._thread = thread

    def _new_log(self, path: Path) -> McapLog:
        said = getattr(self.body, "instruction", "") or "not stated"
        is_polled = not isinstance(
            self.body, SurrogateArms
        )  # states come with the loop, as commands do
        topics = [
            *COMMAND_TOPICS.values(),
            *(STATE_TOPICS.values() if is_polled else ()),
        ]
        rates_hz = dict.fromkeys(topics, self.config.fps)
        return McapLog(path, self.body.origin, said, self._clock, rates_hz)

    def _close(self) -> list[str]:
        """Close every part, also after one has failed; returns what failed and why."""
        self._ended.set()
        parts: dict[str, Callable[[], object]] = {}
        if self._thread is not None:
            parts["watchdog"] = partial(self._thread.join, timeout=1.0)
        if self.pads is not None:
            parts["pads"] = self.pads.close
        parts["arms and cameras"] = self.body.disconnect
        if self._log is not None:
            parts["recording"] = self._log.close
        failures = close_all(parts)
        if self._thread is not None and self._thread.is_alive():
            failures.append("watchdog: it waits for a driver that does not return")
        self._thread = self._log = None
        return failures

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
        """The present observation. Raises Stopped: the connection is lost, the robot does not answer, or a number of the
        observation is not finite, of another shape, or of an impossible time."""
        doing = "the robot does not answer"
        try:
            if self.body.is_lost:
                raise ConnectionError("the connection is lost")
            sample = self.body.read()
            doing = "the observation is unfit"
            now_s = number("the time of the clock", self._clock())
            return self._observation(sample, now_s)
        except (KeyboardInterrupt, Stopped):
            raise
        except BaseException as error:  # whatever a driver raises
            self._stop(f"{doing}: {described(error)}")
            raise Stopped(f"stopped: {self.guard.stopped}") from error

    def _observation(self, sample: Sample, now_s: float) -> dict[str, Any]:
        """Observation of a sample that was read at ``now_s``, which the guard sees first. Raises Stopped: the guard refuses it;
        Unfit: a camera or a pad gives nothing usable."""
        ages = {
            channel: math.inf
            if stamp_s == -math.inf
            else now_s - number(f"the time of {channel}", stamp_s)
            for channel, stamp_s in sample.stamps_s.items()
        }
        notes: dict[str, str] = {}
        for name in self.body.cameras:
            self._look(name, sample, notes)
        unchanged_s = {
            f"camera:{n}": now_s - p.stamp_s for n, p in self._new_picture.items()
        }
        sums, reading = {}, {}
        if self.pads is not None:
            if self.pads.broken:
                raise Unfit(self.pads.broken)
            rows, stride = lerobot_hooks.window()
            touch, felt = self.pads.at(
                now_s, rows=rows, period_s=stride / self.config.fps
            )
            ages |= {f"pad:{name}": age_s for name, age_s in felt.items()}
            faults = self.pads.faults.copy()  # the pads' threads change it
            notes |= {f"pad:{name}": text for name, text in faults.items()}
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
            reading[TOUCH] = TouchReading(
                touch[-1], touch, partial(_shown, parts, self.pads.spec.max_count)
            )
        found = Observed(
            position=sample.position,
            ages_s=ages,
            pad_counts=sums,
            effort=sample.effort,
            unchanged_s=unchanged_s,
            notes=notes,
            at_s=now_s,
        )
        with self._lock:
            self._react(self.guard.observed(found))
            if self.guard.is_unfit:
                raise Stopped(f"stopped: {self.guard.stopped}")
        px = self.config.picture_px
        seen: dict[str, Any] = dict(
            zip(self.body.names, map(float, sample.position), strict=True)
        )
        seen |= {
            name: letterbox(p.picture, px, px) if px else p.picture
            for name, p in self._new_picture.items()
        }
        for channel, age_s in ages.items():
            age_s = max(age_s, unchanged_s.get(channel, 0.0))
            self._timed(f"age of {channel}", age_s)
        self._seen_s = self._clock()
        return seen | reading

    def _look(self, name: str, sample: Sample, notes: dict[str, str]) -> None:
        """Keep a camera's picture if it is new and fit, else state in ``notes`` why not.
        Raises Unfit: there is none to keep in its place, or its time is not finite."""
        channel, shown = f"camera:{name}", self._new_picture.get(name)
        picture = sample.pictures.get(name)
        stamp_s = number(f"the time of {channel}", sample.stamps_s.get(channel))
        fault = _picture_fault(picture, self.body.cameras[name], shown)
        if fault and shown is None:
            raise Unfit(f"{channel}: {fault}")
        if fault:
            notes[channel] = fault
            return
        assert picture is not None, "that would be a fault"
        repeats = Repeats() if shown is None else shown.repeats
        if repeats.is_new(picture) or shown is None:
            self._new_picture[name] = _Picture(picture.copy(), stamp_s, repeats)
        elif stamp_s != shown.stamp_s:  # else no new picture came
            notes[channel] = REPEATED

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
        """Disconnect everything, and say how the loop went. Raises TaccorlError, after all parts were tried: what failed."""
        failures = self._close()
        for line in self.summary():
            (print if self.config.dry_run else _log.info)(line)
        if failures:
            raise TaccorlError(
                f"{self.name} is not closed whole: {'; '.join(failures)}"
            )

    def summary(self) -> list[str]:
        """Lines: p50 and p99 of ages, latencies and the period [ms]; whether the loop is held; what safety did."""
        lines = [
            f"{self.name}{' (dry run, nothing was sent)' if self.config.dry_run else ''}: {self.body.origin}"
        ]
        for what, values in sorted(self.timing.items()):
            known = np.array([x for x in values.copy() if math.isfinite(x)])
            text = f"  {what}:"
            if len(known):
                p50, p99 = np.percentile(known, [50, 99]) * 1e3
                text += f" p50 {p50:.1f} ms, p99 {p99:.1f} ms"
            if missing := len(values) - len(known):
                text += (
                    f" no sample had come in {missing} of {len(values)} observations"
                )
            lines.append(text)
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
        if self.config.dry_run:
            lines += ["  limits in force:", *(f"    {x}" for x in self.guard.limits())]
        counts = ", ".join(f"{n} {kind}" for kind, n in self.guard.counts.items() if n)
        return [
            *lines,
            f"  commands and reactions: {counts or 'none'}; {self.guard.stopped or 'not stopped'}",
        ]

    def _react(self, reaction: Reaction | None) -> None:
        """Send the command of a reaction. Any exception of the driver is a stop."""
        if reaction is None or reaction.target is None or self.config.dry_run:
            return
        try:
            if self.body.is_lost:
                return
            self.body.send(reaction.target)
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # also in the watchdog's thread
            text = f"the robot takes no command: {described(error)}"
            self.guard.stop(text, is_lost=True)
            return
        if self._log is not None:
            self._log.command(reaction.target)

    def _stop(self, reason: str) -> None:
        """Stop because of a driver; the present position is the last command."""
        with self._lock:
            self._react(self.guard.stop(reason, is_lost=True))

    def _watch(self) -> None:
        ended = self._ended
        while not ended.wait(1 / self.config.fps):
            try:
                with self._lock:
                    if self.body.is_lost:
                        self.guard.stop("the connection is lost", is_lost=True)
                    else:
                        self._tick()
            except BaseException as error:
                # Whatever a driver raises: the thread goes on.
                self._stop(f"the watchdog fails: {described(error)}")

    def _tick(self) -> None:
        if self.pads is not None and self.pads.broken:
            self._stop(self.pads.broken)
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


@dataclass
class _Picture:
    """Newest picture of a camera that is none of those before it, and its time [s]."""

    picture: np.ndarray
    stamp_s: float
    repeats: Repeats


def _picture_fault(
    picture: Any, size: tuple[int | None, ...], before: _Picture | None
) -> str:
    """Why ``picture`` is none of its camera, empty if it is. ``size``: rows and columns
    that the camera states, None if it does not; ``before``: its last picture."""
    if not isinstance(picture, np.ndarray) or picture.dtype.kind not in "ui":
        return "it gives no picture"
    kind = f"its pictures are {picture.shape} {picture.dtype}"
    if not picture.size or (None not in size and picture.shape[:2] != tuple(size)):
        return f"{kind}, not {tuple(size)}"
    if before is None or (picture.shape, picture.dtype) == (
        before.picture.shape,
        before.picture.dtype,
    ):
        return ""
    return f"{kind}, not {before.picture.shape} {before.picture.dtype}"


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
        positive("--robot.lost_after_s", self.config.lost_after_s)
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

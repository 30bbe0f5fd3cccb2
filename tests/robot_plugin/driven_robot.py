"""A robot whose drivers are functions of simulated time: its guard, pads and LeRobot
interface are real, its hardware is a bench that misbehaves as a table of faults says."""

import queue
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from taccorl.data.origin import UNSTATED
from taccorl.robot_plugin.bodies import Sample
from taccorl.robot_plugin.config_robots import TouchRobotConfig
from taccorl.robot_plugin.pads import PadsConfig
from taccorl.robot_plugin.robots import TouchRobot
from taccorl.robot_plugin.safety import SafetyConfig, Stopped

PERIOD_S = 1 / 30
NAMES = ("shoulder.pos", "elbow.pos", "gripper.pos")
PX = 8


@dataclass
class Bench:
    """Arms, camera and pads in simulated time."""

    now_s: float = 100.0
    noise_counts: float = 1.3
    """Standard deviation of a taxel's noise, as that of the stand-in drivers."""

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(0)
        self.rest = self.rng.uniform(10, 40, (12, 32))
        self.renew()

    def renew(self) -> None:
        """A bench without faults, to which nothing was sent."""
        self.change_sample: list[Callable[[Bench, Sample], None]] = []
        self.change_frame: list[Callable[[Bench, np.ndarray], Any]] = []
        """Functions of the pad's frame: another frame, (stamp [s], frame), an exception
        to raise, or None if the pad sends nothing."""
        self.clock_offset_s = 0.0
        self.lost: Any = False
        """Whether the connection is lost, or the exception that this question raises."""
        self.send_error: BaseException | None = None
        self.commands: list[Any] = []
        self.position = np.array([0.1, 0.2, 0.03])
        self.kept: dict[str, Any] = {}
        """What the faults remember."""
        self.queue: queue.Queue[Any] = queue.Queue()

    def clock(self) -> float:
        return self.now_s + self.clock_offset_s

    def picture(self) -> np.ndarray:
        return self.rng.integers(0, 255, (PX, PX, 3), np.uint8)

    def frame(self) -> np.ndarray:
        noise = self.rng.normal(0, self.noise_counts, self.rest.shape)
        return np.clip(np.round(self.rest + noise), 0, 255).astype(np.uint8)

    def scan(self) -> None:
        """The pad sends a frame."""
        found: Any = self.frame()
        for change in self.change_frame:
            found = change(self, found) if isinstance(found, np.ndarray) else found
        if isinstance(found, np.ndarray):
            found = self.now_s, found
        if found is not None:
            self.queue.put(found)


class Arms:
    """Two joints, a gripper and a camera: the ``Body`` of the robot."""

    origin, names, cameras = UNSTATED, NAMES, {"front": (PX, PX)}

    def __init__(self, bench: Bench) -> None:
        self.bench, self.listeners, self.is_connected = bench, [], False

    def connect(self) -> None:
        self.is_connected = True

    def disconnect(self) -> None:
        self.is_connected = False

    @property
    def is_lost(self) -> bool:
        if isinstance(self.bench.lost, BaseException):
            raise self.bench.lost
        return self.bench.lost

    def read(self) -> Sample:
        now_s = self.bench.now_s
        found = Sample(
            position=self.bench.position.copy(),
            effort=np.ones(3),
            pictures={"front": self.bench.picture()},
            stamps_s={"state": now_s - 0.005, "camera:front": now_s - 0.02},
        )
        for change in self.bench.change_sample:
            change(self.bench, found)
        return found

    def send(self, target: np.ndarray) -> None:
        if self.bench.send_error is not None:
            raise self.bench.send_error
        self.bench.commands.append(target)
        if np.isfinite(target).all():
            self.bench.position = target.copy()


class Pad:
    """One pad; a frame counts as read when the next one is waited for."""

    def __init__(self, bench: Bench) -> None:
        self._bench, self._is_reading = bench, False

    def read(self) -> tuple[float, np.ndarray]:
        if self._is_reading:
            self._bench.queue.task_done()
            self._is_reading = False
        try:
            found = self._bench.queue.get(timeout=0.05)
        except queue.Empty as error:
            raise TimeoutError("nothing comes") from error
        self._is_reading = True
        if isinstance(found, BaseException):
            raise found
        return found

    def close(self) -> None: ...


@dataclass(kw_only=True)
class BenchPads(PadsConfig):
    bench: Any = None
    drivers: Mapping[str, Callable[[], Any]] = field(default_factory=dict)
    """Pad → function that opens it; by default the bench's pad ``left``."""

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.drivers) or ("left",)

    def open(self, name: str) -> Any:
        return self.drivers[name]() if self.drivers else Pad(self.bench)


class DrivenRobot(TouchRobot):
    """``TouchRobot`` on a bench. Its clock is the bench's; ``pass_period`` calls the
    guard as the watchdog does, unless ``is_watched``: then the watchdog runs."""

    def __init__(
        self, folder: Path, bench: Bench, *, is_watched: bool = False, **options: Any
    ) -> None:
        self.bench = bench
        limits = {"max_speed": {"pos": 3.0}, "effort": {"pos": 10.0}}
        limits |= options.pop("safety", {})
        options.setdefault("pads", BenchPads(bench=bench))
        config = TouchRobotConfig(
            robot={}, calibration_dir=folder, safety=SafetyConfig(**limits), **options
        )
        super().__init__(config, clock=bench.clock)
        if not is_watched:
            self._watch = lambda: None

    def _body(self) -> Any:
        return Arms(self.bench)

    def connect(self, calibrate: bool = True) -> None:
        for _ in range(40):  # more than the baseline needs, stamped when it is taken
            self.bench.scan()
        super().connect()

    def pass_period(self) -> None:
        """1/30 s passes, with a frame of the pad and the watchdog."""
        self.bench.now_s += PERIOD_S
        self.bench.scan()
        assert self.pads is not None
        until_s = time.monotonic() + 5.0
        while self.bench.queue.unfinished_tasks and not self.pads.broken:
            assert time.monotonic() < until_s, "the pad's thread does not read"
            time.sleep(0.0001)
        with self._lock:
            self._tick()

    def loop(self, periods: int, act: Callable[[dict[str, Any]], Any] = dict) -> str:
        """Observe and command for so many periods, as LeRobot's loops do, with a slow
        motion that ``act`` changes. Returns the reason of a stop, empty without."""
        for _ in range(periods):
            self.pass_period()
            try:
                seen = self.get_observation()
                target = {name: seen[name] + 0.01 for name in NAMES}
                self.send_action(act(target))
            except Stopped:
                continue
        return self.guard.stopped

"""Connections that fail half-way, drivers that raise whatever they like, pads that are
dead at connect, and limits that cannot hold."""

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import draccus
import numpy as np
import pytest
from driven_robot import PERIOD_S, Bench, BenchPads, DrivenRobot, Pad

from taccorl.data.origin import UNSTATED
from taccorl.errors import TaccorlError
from taccorl.robot_plugin.bodies import LeRobotBody
from taccorl.robot_plugin.config_robots import TouchRobotConfig
from taccorl.robot_plugin.mcap_log import McapLog
from taccorl.robot_plugin.pads import Pads

ERRORS = [OSError("x"), KeyError("x"), TypeError("x"), SystemExit(2), GeneratorExit()]
"""Of drivers; the last stands for those that are no ``Exception``."""


def our_threads() -> set[str]:
    names = {thread.name for thread in threading.enumerate()}
    return {name for name in names if name == "watchdog" or name.startswith("pad ")}


def until(condition: Callable[[], Any], timeout_s: float = 5.0) -> bool:
    end_s = time.monotonic() + timeout_s
    while not condition() and time.monotonic() < end_s:
        time.sleep(0.005)
    return bool(condition())


# ---- exceptions of drivers ----


@pytest.mark.parametrize("error", ERRORS, ids=lambda e: type(e).__name__)
@pytest.mark.parametrize("where", ["lost", "send_error"])
def test_the_watchdog_outlives_any_exception_of_a_driver(
    where: str, error: BaseException, tmp_path: Path, caplog: Any
) -> None:
    robot = DrivenRobot(tmp_path, Bench(), is_watched=True)
    robot.connect()
    robot.loop(3)
    setattr(robot.bench, where, error)
    robot.bench.now_s += 0.3  # nobody commands: the watchdog would hold
    assert until(lambda: robot.guard.stopped)
    assert type(error).__name__ in robot.guard.stopped
    assert robot.guard.stopped in caplog.text
    robot.bench.renew()
    time.sleep(3 * PERIOD_S)
    assert "watchdog" in our_threads()
    assert not robot.bench.commands, "none after a stop"
    robot.disconnect()
    assert not our_threads()


class Broken:
    """A pad's driver that raises."""

    def __init__(self, read: BaseException, close: BaseException | None = None) -> None:
        self._read, self._close = read, close

    def read(self) -> Any:
        raise self._read

    def close(self) -> None:
        if self._close is not None:
            raise self._close


def refusing(error: BaseException) -> Callable[[], Any]:
    def fail() -> Any:
        raise error

    return fail


@pytest.mark.parametrize("error", ERRORS[1:], ids=lambda e: type(e).__name__)
@pytest.mark.parametrize("where", ["body", "open", "read"])
def test_a_connection_that_fails_leaves_nothing_open(
    where: str, error: BaseException, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = Bench()
    second = refusing(error) if where == "open" else lambda: Broken(error)
    drivers = {"one": lambda: Pad(bench), "two": second}
    pads = BenchPads(bench=bench, drivers=drivers)
    robot = DrivenRobot(tmp_path, bench, is_watched=True, pads=pads)
    if where == "body":
        # One arm is connected, the other fails.
        monkeypatch.setattr(robot.body, "is_connected", True)
        monkeypatch.setattr(robot.body, "connect", refusing(error))
    with pytest.raises(TaccorlError, match=type(error).__name__):
        robot.connect()
    assert not robot.body.is_connected
    assert not robot.is_connected
    assert not our_threads()


def test_a_disconnection_closes_everything_and_states_all_that_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = DrivenRobot(tmp_path, Bench(), is_watched=True)
    robot.connect()
    monkeypatch.setattr(Pad, "close", lambda _: refusing(KeyError("port"))())
    monkeypatch.setattr(robot.body, "disconnect", refusing(TypeError("bus")))
    with pytest.raises(TaccorlError) as caught:
        robot.disconnect()
    assert "pad left: 'port' (KeyError)" in str(caught.value)
    assert "bus (TypeError)" in str(caught.value)
    assert not robot.is_connected
    assert not our_threads()


def test_a_second_connection_needs_a_disconnection(tmp_path: Path) -> None:
    robot = DrivenRobot(tmp_path, Bench(), is_watched=True)
    robot.connect()
    with pytest.raises(TaccorlError, match="connected already"):
        robot.connect()
    assert robot.is_connected
    assert robot.body.is_connected
    robot.disconnect()


def test_a_recording_of_a_failed_connection_is_removed(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    pads = BenchPads(drivers={"left": lambda: Broken(TypeError("x"))})
    robot = DrivenRobot(tmp_path, Bench(), pads=pads)
    robot.config.record = path  # as trials do
    with pytest.raises(TaccorlError, match="TypeError"):
        robot.connect()
    assert not path.exists()


class Part:
    """A bus or camera of a LeRobot robot."""

    def __init__(self, is_connected: bool) -> None:
        self.is_connected = is_connected

    def disconnect(self) -> None:
        assert self.is_connected, "LeRobot's parts refuse it"
        self.is_connected = False


class HalfOpen:
    """A LeRobot robot whose bus is open and whose second camera failed."""

    name = "half"
    action_features = observation_features = {"joint.pos": float}  # noqa: RUF012

    def __init__(self) -> None:
        self.bus = Part(True)
        self.cameras = {"one": Part(True), "two": Part(False)}

    @property
    def is_connected(self) -> bool:
        return self.bus.is_connected and self.cameras["two"].is_connected

    def disconnect(self) -> None:
        raise ConnectionError("it is not connected")


def test_the_open_parts_of_a_lerobot_robot_are_closed() -> None:
    half: Any = HalfOpen()
    LeRobotBody(half).disconnect()
    assert not half.bus.is_connected
    assert not half.cameras["one"].is_connected


@pytest.mark.parametrize("picture", [np.zeros((0, 0, 3), np.uint8), "text", None])
def test_a_value_that_cannot_be_recorded_ends_the_recording_only(
    picture: Any, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    log = McapLog(tmp_path / "run.mcap", UNSTATED, "move", time.monotonic, {})
    log.picture(0.0, "front", picture)
    log.state(float("nan"), np.zeros((3, 14)))
    log.close()
    assert caplog.text.count("the recording ends here") == 1


# ---- pads at connect ----


class Wire:
    """A pad that sends what ``make`` returns, 1000 times a second."""

    def __init__(self, make: Callable[[], np.ndarray]) -> None:
        self._make = make

    def read(self) -> tuple[float, np.ndarray]:
        time.sleep(0.001)
        return time.monotonic(), self._make()

    def close(self) -> None: ...


def connected(make: Callable[[], np.ndarray], *, raw: bool = True) -> Pads:
    pads = Pads(BenchPads(drivers={"left": lambda: Wire(make)}, raw=raw))
    pads.connect(0.3)
    return pads


def stuck(value: int, part: Any = np.s_[:]) -> Callable[[], np.ndarray]:
    bench = Bench()

    def make() -> np.ndarray:
        frame = bench.frame()
        frame[part] = value
        return frame

    return make


def alternating(number: int) -> Callable[[], np.ndarray]:
    bench, frames = Bench(), list[np.ndarray]()

    def make() -> np.ndarray:
        if len(frames) < number:
            frames.append(bench.frame())
        frames.append(frames.pop(0))
        return frames[-1]

    return make


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (stuck(0), "repeats its frames"),
        (stuck(255), "repeats its frames"),
        (stuck(17), "repeats its frames"),
        (alternating(1), "repeats its frames"),
        (alternating(2), "repeats its frames"),
        (stuck(0, np.s_[:6]), "192 of 384 taxels always read 0"),
        (stuck(255, np.s_[:, 7]), "12 of 384 taxels always read 0 or 255"),
        (lambda: Bench().frame().astype(np.int64), "frames of .* int64, but"),
    ],
)
def test_dead_pads_are_refused_at_connect(
    make: Callable[[], np.ndarray], reason: str
) -> None:
    with pytest.raises(TaccorlError, match=f"pad left: .*{reason}"):
        connected(make)
    assert not our_threads()


def test_a_driver_that_filters_may_repeat_zeros_if_that_is_stated() -> None:
    pads = connected(stuck(0), raw=False)
    _, ages_s = pads.at(time.monotonic())
    assert ages_s["left"] < 0.1
    pads.close()


@pytest.mark.parametrize("noise_counts", [0.02, 0.3, 1.3])
def test_a_quiet_pad_is_no_fault(noise_counts: float, tmp_path: Path) -> None:
    """Even 0.02 counts flicker on the taxels that rest near a step of the ADC."""
    robot = DrivenRobot(tmp_path, Bench(noise_counts=noise_counts))
    robot.connect()
    assert robot.loop(100) == ""
    assert robot.guard.counts["hold"] == 0
    assert len(robot.bench.commands) == 100
    robot.disconnect()


# ---- limits ----


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -1.0, 0.0])
@pytest.mark.parametrize(
    ("option", "of"),
    [
        ("stop_after_s", lambda v: v),
        ("watchdog_s", lambda v: v),
        ("max_skew_s", lambda v: v),
        ("pad_sum_count", lambda v: v),
        ("max_age_s", lambda v: {"camera": v}),
        ("max_speed", lambda v: {"gripper.pos": v, "pos": 1.0}),
        ("effort", lambda v: {"pos": v}),
    ],
)
def test_limits_that_are_not_finite_and_positive_are_refused(
    option: str, of: Callable[[float], Any], value: float, tmp_path: Path
) -> None:
    with pytest.raises(TaccorlError, match=f"safety.{option}"):
        DrivenRobot(tmp_path, Bench(), safety={option: of(value)})


@pytest.mark.parametrize(
    ("safety", "reason"),
    [
        ({"max_age_s": {"camra": 0.4}}, "did you mean 'camera'"),
        ({"max_age_s": {"camera:front": 0.4}}, "kinds: state, camera, pad"),
        ({"ranges": {"elbow.pos": [0.0, float("nan")]}}, "safety.ranges.elbow.pos"),
        ({"workspace_m": [0, 1, 0, 1, 0, float("inf")]}, "safety.workspace_m"),
    ],
)
def test_limits_that_mean_nothing_are_refused(
    safety: dict[str, Any], reason: str, tmp_path: Path
) -> None:
    with pytest.raises(TaccorlError, match=reason):
        DrivenRobot(tmp_path, Bench(), safety=safety)


@pytest.mark.parametrize("fps", [0.0, float("nan"), -30.0])
def test_a_rate_that_is_none_is_refused(fps: float, tmp_path: Path) -> None:
    with pytest.raises(TaccorlError, match=r"--robot\.fps"):
        DrivenRobot(tmp_path, Bench(), fps=fps)


def test_ages_that_are_given_are_laid_over_the_defaults(tmp_path: Path) -> None:
    options = {"robot": {}, "safety": {"max_age_s": {"camera": 0.4}}}
    given = draccus.decode(TouchRobotConfig, options).safety.max_age_s
    robot = DrivenRobot(tmp_path, Bench(), safety={"max_age_s": given})
    robot.connect()
    robot.loop(3)
    robot.bench.change_frame = [lambda *_: None]  # the pad falls silent
    robot.loop(5)
    assert "pad:left" in robot.guard.holding
    robot.disconnect()


def test_a_dry_run_prints_the_limits_in_force(tmp_path: Path, capsys: Any) -> None:
    safety = {"max_age_s": {"camera": 0.4}, "ranges": {"elbow.pos": [-0.5, 0.7]}}
    robot = DrivenRobot(tmp_path, Bench(), dry_run=True, safety=safety)
    robot.connect()
    robot.loop(3)
    assert not robot.bench.commands
    robot.disconnect()
    shown = capsys.readouterr().out
    assert "state 0.1 s, camera 0.4 s, pad 0.1 s" in shown
    assert "elbow.pos: 3 a second, -0.5 … 0.7, effort 10" in shown
    assert "0.05 s" in shown

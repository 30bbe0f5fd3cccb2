"""Faults of drivers, alone and in pairs: nothing that is not finite is sent, nothing at
all after a stop, and every reason is in the log."""

import logging
import math
import re
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from driven_robot import NAMES, Bench, DrivenRobot

from taccorl.errors import TaccorlError
from taccorl.robot_plugin.bodies import Sample
from taccorl.robot_plugin.safety import Stopped

STALL_S = 0.3


class RustPanic(BaseException):
    """As those of drivers in Rust: no ``Exception``."""


@dataclass(frozen=True)
class Fault:
    """A fault: its reaction, a pattern of the reason, and what changes on the bench."""

    reaction: str
    reason: str
    sample: Callable[[Bench, Sample], None] | None = None
    frame: Callable[[Bench, np.ndarray], Any] | None = None
    act: Callable[[dict[str, Any]], Any] | None = None
    bench: tuple[str, Any] | None = None
    """Attribute of the bench, and its value while the fault lasts."""
    is_hung: bool = False
    """Whether the loop neither observes nor commands."""


def put(name: str, value: Any) -> Callable[[Bench, Sample], None]:
    return lambda _, sample: setattr(sample, name, value)


def stamped(channel: str, offset_s: float) -> Callable[[Bench, Sample], None]:
    def change(bench: Bench, sample: Sample) -> None:
        sample.stamps_s[channel] += offset_s

    return change


def raising(error: BaseException) -> Callable[[Bench, Sample], None]:
    def change(*_: Any) -> None:
        raise error

    return change


def pictured(picture: Callable[[Bench], Any]) -> Callable[[Bench, Sample], None]:
    def change(bench: Bench, sample: Sample) -> None:
        sample.pictures["front"] = picture(bench)

    return change


def cycled(what: str, length: int, make: Callable[[Bench], np.ndarray]) -> Any:
    """The next of ``length`` stored frames, in turn."""

    def take(bench: Bench, *_: Any) -> np.ndarray:
        key = f"{what} {length}"
        frames = bench.kept.setdefault(key, [make(bench) for _ in range(length)])
        frames.append(frames.pop(0))
        return frames[-1]

    return take


def stalled(bench: Bench, sample: Sample) -> None:
    """The state's driver repeats its last sample, with its stamp."""
    sample.stamps_s["state"] = bench.kept.setdefault(
        "stalled", sample.stamps_s["state"]
    )


def suspended(bench: Bench, sample: Sample) -> None:
    """The process stood still: the first samples after it are old."""
    if "suspended" not in bench.kept:
        bench.kept["suspended"] = True
        bench.now_s += STALL_S


def gone(bench: Bench, sample: Sample) -> None:
    del sample.pictures["front"]


def without_state(bench: Bench, sample: Sample) -> None:
    del sample.stamps_s["state"]


def dead(part: Any) -> Callable[[Bench, np.ndarray], np.ndarray]:
    """Frames whose taxels ``part`` read 0."""

    def change(bench: Bench, frame: np.ndarray) -> np.ndarray:
        if frame.shape == bench.rest.shape:  # not one of another size
            frame[part] = 0
        return frame

    return change


def stuck(part: Any) -> Callable[[Bench, np.ndarray], np.ndarray]:
    """Frames whose taxels ``part`` keep one number each, that of rest."""

    def change(bench: Bench, frame: np.ndarray) -> np.ndarray:
        if frame.shape == bench.rest.shape:  # not one of another size
            frame[part] = np.round(bench.rest).astype(np.uint8)[part]
        return frame

    return change


def acting(name: str, value: Any) -> Callable[[dict[str, Any]], Any]:
    return lambda action: (action or {}) | {name: value}


NAN3 = np.array([0.1, np.nan, 0.0])
HALF, ROW, COLUMN = np.s_[:6], np.s_[3], np.s_[:, 5]
CAMERA, PAD = "camera:front is .* old", "pad:left is .* old"
FAULTS = {
    "state nan": Fault("stop", "position of elbow.pos is nan", put("position", NAN3)),
    "state inf": Fault("stop", "position of gripper.pos is -inf", put("position", np.array([0, 0, -np.inf]))),
    "state shape": Fault("stop", r"position: of shape \(2,\)", put("position", np.zeros(2))),
    "state none": Fault("stop", "position: of type object", put("position", None)),
    "state jump": Fault("stop", "position of .* moved by .* times its largest speed", put("position", np.array([1e4, 0, 0]))),
    "state text": Fault("stop", "position: of type <U", put("position", np.array(["0", "0", "0"]))),
    "state stamp nan": Fault("stop", "time of state is nan", stamped("state", math.nan)),
    "state stamp missing": Fault("stop", "state has no time", without_state),
    "state ahead": Fault("stop", "state is stamped 0.* s ahead", stamped("state", 0.08)),
    "state back": Fault("stop", "time of state went back", stamped("state", -0.6)),
    "state stalls": Fault("hold", "state is .* old", stalled),
    "effort nan": Fault("stop", "effort of elbow.pos is nan", put("effort", NAN3)),
    "effort shape": Fault("stop", r"effort: of shape \(\)", put("effort", np.float64(1.0))),
    "effort gone": Fault("stop", "no efforts any more", put("effort", None)),
    "effort large": Fault("stop", "effort of gripper.pos: 11", put("effort", np.array([0, 0, 11.0]))),
    "read OSError": Fault("stop", "does not answer: no bus", raising(OSError("no bus"))),
    "read KeyError": Fault("stop", "does not answer: 'id' .KeyError", raising(KeyError("id"))),
    "read exit": Fault("stop", "does not answer: 3 .SystemExit", raising(SystemExit(3))),
    "read panic": Fault("stop", "does not answer: RustPanic", raising(RustPanic())),
    "send TypeError": Fault("stop", "takes no command: int", bench=("send_error", TypeError("int"))),
    "lost": Fault("stop", "connection is lost", bench=("lost", True)),
    "lost raises": Fault("stop", "does not answer: gone .IndexError", bench=("lost", IndexError("gone"))),
    "camera frozen": Fault("hold", CAMERA, pictured(cycled("picture", 1, Bench.picture))),
    "camera alternates": Fault("hold", CAMERA, pictured(cycled("picture", 2, Bench.picture))),
    "camera size": Fault("hold", r"camera:front is .* old.*\(4, 4, 3\)", pictured(lambda b: b.picture()[:4, :4])),
    "camera floats": Fault("hold", CAMERA, pictured(lambda b: b.picture() / 255)),
    "camera gone": Fault("hold", CAMERA, gone),
    "camera stamp nan": Fault("stop", "time of camera:front is nan", stamped("camera:front", math.nan)),
    "camera ahead": Fault("stop", "camera:front is stamped .* ahead", stamped("camera:front", 1e4)),
    "pad silent": Fault("hold", PAD, frame=lambda *_: None),
    "pad frozen": Fault("hold", PAD, frame=cycled("frame", 1, Bench.frame)),
    "pad alternates": Fault("hold", PAD, frame=cycled("frame", 2, Bench.frame)),
    "pad zero": Fault("hold", f"{PAD}.*reads 0", frame=dead(np.s_[:])),
    "pad half zero": Fault("hold", f"{PAD}.*reads 0", frame=dead(HALF)),
    "pad row zero": Fault("hold", f"{PAD}.*reads 0", frame=dead(ROW)),
    "pad column zero": Fault("hold", f"{PAD}.*reads 0", frame=dead(COLUMN)),
    "pad half stuck": Fault("hold", f"{PAD}.*stand still", frame=stuck(HALF)),
    "pad other half stuck": Fault("hold", f"{PAD}.*stand still", frame=stuck(np.s_[:, 16:])),
    "pad row stuck": Fault("hold", f"{PAD}.*stand still", frame=stuck(ROW)),
    "pad column stuck": Fault("hold", f"{PAD}.*stand still", frame=stuck(COLUMN)),
    "pad size": Fault("hold", PAD, frame=lambda _, f: f[:4, :4]),
    "pad floats": Fault("hold", PAD, frame=lambda _, f: f.astype(float)),
    "pad OSError": Fault("hold", PAD, frame=lambda *_: OSError("unplugged")),
    "pad KeyError": Fault("stop", "pad left: 'x' .KeyError", frame=lambda *_: KeyError("x")),
    "pad stamp nan": Fault("stop", "time of pad left is nan", frame=lambda _, f: (math.nan, f)),
    "pad ahead": Fault("stop", "pad left is stamped .* ahead", frame=lambda b, f: (b.now_s + 1e4, f)),
    "pad back": Fault("stop", "time of pad left went back", frame=lambda b, f: (b.now_s - 5, f)),
    "pad pressed": Fault("stop", "pad left is pressed", frame=lambda _, f: f // 8 + 200),
    "action nan": Fault("stop", "action elbow.pos is nan", act=acting("elbow.pos", math.nan)),
    "action inf": Fault("stop", "action elbow.pos is inf", act=acting("elbow.pos", math.inf)),
    "action text": Fault("stop", "action gripper.pos is 0.1", act=acting("gripper.pos", "0.1")),
    "action vector": Fault("stop", "action gripper.pos is", act=acting("gripper.pos", np.zeros(2))),
    "action missing": Fault("stop", "without shoulder.pos, gripper.pos", act=lambda a: {"elbow.pos": 0.0}),
    "action none": Fault("stop", "of type NoneType", act=lambda _: None),
    "policy hangs": Fault("hold", "no action for 0.2 s", is_hung=True),
    "suspended": Fault("hold", "is .* old|no action", suspended),
    "clock back": Fault("stop", "the clock went from|ahead of the clock", bench=("clock_offset_s", -1.0)),
    "clock nan": Fault("stop", "the clock went from .* to nan", bench=("clock_offset_s", math.nan)),
}  # fmt: skip
FIRST, SECOND, END = range(5, 20), range(14, 30), 40
"""Periods of the first fault, of the second, which begins when the arms hold because of
the first and outlasts it, and of the end."""


def run(robot: DrivenRobot, when: dict[str, range]) -> int:
    """Run the loop with faults at their periods; returns the number of commands at the
    stop, or −1 without one."""
    bench, at_stop = robot.bench, -1
    usual = {"lost": False, "send_error": None, "clock_offset_s": 0.0}
    for period in range(END):
        active = [FAULTS[name] for name, periods in when.items() if period in periods]
        bench.change_sample = [f.sample for f in active if f.sample]
        bench.change_frame = [f.frame for f in active if f.frame]
        for name, value in (usual | dict(f.bench for f in active if f.bench)).items():
            setattr(bench, name, value)

        def act(action: Any, active: list[Fault] = active) -> Any:
            for fault in active:
                action = fault.act(action) if fault.act else action
            return action

        if any(fault.is_hung for fault in active):
            robot.pass_period()
        else:
            robot.loop(1, act)
        if at_stop < 0 and robot.guard.stopped:
            at_stop = len(bench.commands)
    return at_stop


def check(robot: DrivenRobot, names: list[str], caplog: Any) -> None:
    """Run the faults one after the other, and assert what must hold for all."""
    bench = robot.bench
    bench.renew()
    caplog.set_level(logging.WARNING)
    caplog.clear()
    robot.connect()
    at_stop = run(robot, dict(zip(names, (FIRST, SECOND), strict=False)))
    stops = [FAULTS[name] for name in names if FAULTS[name].reaction == "stop"]
    sent = np.array(bench.commands)
    assert sent.shape == (len(bench.commands), len(NAMES))
    assert np.isfinite(sent).all()
    assert bool(robot.guard.stopped) == bool(stops), robot.guard.stopped
    if stops:
        assert re.search(stops[0].reason, robot.guard.stopped)
        assert len(bench.commands) == at_stop
        with pytest.raises(Stopped):
            robot.send_action(dict.fromkeys(NAMES, 0.1))
        assert len(bench.commands) == at_stop
    else:
        assert not robot.guard.holding
        assert np.ptp(sent[-5:], axis=0).min() > 0, "the arms follow again"
    for fault in (FAULTS[name] for name in names):
        logged = f"(the arms hold|STOPPED): .*(?:{fault.reason})"
        assert re.search(logged, caplog.text), fault.reason
        if fault.reaction == "stop":
            break
    robot.disconnect()


@pytest.fixture
def robot(tmp_path: Path) -> DrivenRobot:
    return DrivenRobot(tmp_path, Bench())


@pytest.mark.parametrize("fault", FAULTS)
def test_every_fault_has_its_reaction_and_its_reason_in_the_log(
    fault: str, robot: DrivenRobot, caplog: pytest.LogCaptureFixture
) -> None:
    check(robot, [fault], caplog)


PAIRED = (
    "state nan",
    "state back",
    "effort nan",
    "read panic",
    "action nan",
    "camera alternates",
    "pad half zero",
    "policy hangs",
    "suspended",
)
"""One fault of each kind, for the pairs of the fast tests."""


@pytest.mark.parametrize(
    ("first", "others"),
    [(first, PAIRED) for first in PAIRED]
    # 2700 ordered pairs
    + [pytest.param(first, FAULTS, marks=pytest.mark.slow) for first in FAULTS],
)
def test_of_two_faults_each_has_its_reaction(
    first: str,
    others: Iterable[str],
    robot: DrivenRobot,
    caplog: pytest.LogCaptureFixture,
) -> None:
    for second in others:
        if second != first:
            check(robot, [first, second], caplog)


@pytest.mark.parametrize(
    "name", ["state nan", "state inf", "state shape", "effort nan"]
)
def test_without_a_finite_position_nothing_is_sent(
    name: str, robot: DrivenRobot
) -> None:
    robot.connect()
    run(robot, {name: range(END)})
    assert robot.guard.stopped
    assert robot.bench.commands == []
    robot.disconnect()


@pytest.mark.parametrize("part", [HALF, np.s_[:, 16:], ROW, COLUMN])
@pytest.mark.parametrize("level", [3, 25, 254])
def test_a_pad_that_is_stuck_above_0_is_refused_at_connect(
    robot: DrivenRobot, part: Any, level: int
) -> None:
    """A part of the pad gives constant counts, not the 0 or 255 of a dead pad, and other ones in each taxel."""

    def change(bench: Bench, frame: np.ndarray) -> np.ndarray:
        frame[part] = np.minimum(level + bench.rest.astype(int)[part] % 4, 254)
        return frame

    robot.bench.change_frame = [change]
    with pytest.raises(TaccorlError, match=r"pad left: \d+ of 384 taxels.*one number"):
        robot.connect()
    assert not robot.is_connected


@pytest.mark.parametrize("noise_counts", [0.2, 0.5, 1.3, 4.0])
def test_a_pad_that_works_is_never_stuck(tmp_path: Path, noise_counts: float) -> None:
    """80 frames, 40 of them with a row that is pressed to the end of its range."""
    robot = DrivenRobot(tmp_path, Bench(noise_counts=noise_counts))
    robot.connect()
    for period in range(80):
        pressed = period > 40
        press: Any = [lambda _, f: np.concatenate([np.full_like(f[:1], 255), f[1:]])]
        robot.bench.change_frame = press if pressed else []
        robot.pass_period()
        assert robot.pads is not None
        assert not robot.pads.faults
    robot.disconnect()


@pytest.mark.parametrize(
    ("ranges", "value", "said"),
    [
        ({}, 1e6, r"position of shoulder.pos is 1e\+06, possible is -3000 … 3000"),
        ({"shoulder.pos": [-2.0, 1.0]}, 90.0, "is 90, possible is -3.5 … 2.5"),
        ({"shoulder.pos": [-2.0, 1.0]}, -1e300, "possible is -3.5 … 2.5"),
    ],
)
def test_an_absurd_first_position_is_refused(
    tmp_path: Path, ranges: dict[str, list[float]], value: float, said: str
) -> None:
    robot = DrivenRobot(tmp_path, Bench(), safety={"ranges": ranges})
    robot.connect()
    robot.bench.position[0] = value
    assert re.search(said, robot.loop(3))
    assert robot.bench.commands == []
    robot.disconnect()


def test_ages_without_a_sample_are_counted_in_the_summary(robot: DrivenRobot) -> None:
    robot.connect()
    ages = robot.timing
    ages["age of camera:front"] = deque([0.01, 0.03, math.inf, math.inf])
    ages["age of state"] = deque([math.inf])
    text = "\n".join(robot.summary())
    assert "age of camera:front: p50 20.0 ms, p99 29.8 ms" in text
    assert "no sample had come in 2 of 4 observations" in text
    assert "age of state: no sample had come in 1 of 1" in text
    assert "nan" not in text
    robot.disconnect()


def test_a_stop_repeats_the_last_finite_position(robot: DrivenRobot) -> None:
    """The joints move by 0.01 in each period. While samples are missing, the guard
    continues this motion for two periods at most."""
    robot.connect()
    robot.loop(5)
    measured, bench = robot.bench.position.copy(), robot.bench
    bench.change_sample = [put("position", NAN3)]
    assert robot.loop(1)
    np.testing.assert_allclose(bench.commands[-1], measured, atol=2 * 0.01)
    robot.disconnect()

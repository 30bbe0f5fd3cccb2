"""Teleoperation of the twin by leader arms, with MuJoCo's viewer: ``taccorl collect --source.type=leader``.

A finished demonstration is written to an action file (teleop_actions.py). The episode is then made by executing that file again:
it is as exact as an expert's, and nothing is lost when rendering or encoding fails. The same command continues where the last one
ended: a finished demonstration of a scene is executed again, not requested again.
"""

import copy
import enum
import os
import queue
import sys
import time
import warnings
import weakref
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import mujoco
import numpy as np

from taccorl.episodes.attempt import Actions, Source
from taccorl.episodes.sources.teleop_actions import (
    find_finished,
    give_time,
    replay,
    scene_of,
    write_actions,
)
from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.simulation import Simulation
from taccorl.sim.twin import CONTROL_HZ

_AFTER_S = (
    1.0  # what is called finished is watched for so long, as in the experts' episodes
)
_CATCH_UP_STEP = (
    ROBOT.per_action(0.6, 0.1) / CONTROL_HZ
)  # rad/s and m/s until arms and leader first agree
_LATE_S = 0.2  # a machine that is later than this is too slow for real time: it does not try to catch up


class Command(enum.Enum):
    """Commands of the person: name of the key, its code (GLFW's), its function. MuJoCo's viewer leaves these keys free: it takes
    all letters, 0–5, F1–F7 and most punctuation (tests/episodes/test_teleop.py)."""

    GO = (
        "Enter",
        257,
        "begin; when done: finish (all holds still for 1 s while the task is judged)",
    )
    DISCARD = ("F9", 298, "discard, and the same scene from its beginning")

    def __init__(self, key: str, code: int, meaning: str) -> None:
        self.key, self.code, self.meaning = key, code, meaning


class ViewerWindow:
    """MuJoCo's passive viewer on a copy of the scene, in real time at 30 control steps a second. Raises TaccorlError: there is no
    display, or a window cannot be opened on it."""

    def __init__(self, sim: Simulation) -> None:
        _check_display()
        import mujoco.viewer

        # A copy: what somebody changes in the viewer's panels must not reach the simulation.
        self._model = copy.copy(sim.model)
        self._data = mujoco.MjData(self._model)
        self._pressed: queue.SimpleQueue[int] = (
            queue.SimpleQueue()
        )  # filled in the window's thread
        self._said: list[str] = []
        self._next_s = 0.0
        try:
            self._viewer = mujoco.viewer.launch_passive(
                self._model,
                self._data,
                key_callback=self._pressed.put,
                show_left_ui=False,
                show_right_ui=False,
            )
        except RuntimeError as error:  # macOS: not run under mjpython
            raise TaccorlError(f"MuJoCo's viewer does not open: {error}") from error
        with self._viewer.lock():  # from behind the arms, so that left is left
            self._viewer.cam.lookat[:] = (0.3, 0.0, 0.1)
            (
                self._viewer.cam.azimuth,
                self._viewer.cam.elevation,
                self._viewer.cam.distance,
            ) = 0.0, -40.0, 1.3

    def tick(self, sim: Simulation, lines: Sequence[str]) -> None:
        """Wait for the next control step, then show simulation 0 and the text ``lines``. Raises TaccorlError: the person has
        closed the window."""
        now_s = time.monotonic()
        if now_s - self._next_s > _LATE_S:
            self._next_s = now_s
        time.sleep(max(0.0, self._next_s - now_s))
        self._next_s += 1 / CONTROL_HZ
        if not self._viewer.is_running():
            raise TaccorlError(
                "the window was closed. Run the same command again to continue."
            )
        mujoco.mj_setState(
            self._model,
            self._data,
            sim.batch.state[0],
            mujoco.mjtState.mjSTATE_INTEGRATION,
        )
        self._viewer.sync(state_only=True)
        if self._said != list(lines):
            self._said = list(lines)
            self._viewer.set_texts(
                (None, mujoco.mjtGridPos.mjGRID_TOPLEFT, "\n".join(lines), "")
            )

    def commands(self) -> list[Command]:
        """Commands of the keys pressed since the last call; other keys are MuJoCo's."""
        codes = [self._pressed.get() for _ in range(self._pressed.qsize())]
        return [
            command for code in codes for command in Command if command.code == code
        ]

    def close(self) -> None:
        self._viewer.close()


def _check_display() -> None:
    """A window can be opened here; MuJoCo's viewer would wait for ever if not."""
    way_out = (
        "Let the scripted expert demonstrate (--source.type=expert), or run this where there is a screen: at the machine "
        "itself, through ssh -X, or with an X server such as Xvfb."
    )
    if sys.platform == "linux" and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    ):
        raise TaccorlError(
            f"no display for MuJoCo's viewer: DISPLAY and WAYLAND_DISPLAY are not set. {way_out}"
        )
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        import glfw

        opens = glfw.init()
    if not opens:
        why = (
            "; ".join(str(warning.message) for warning in caught)
            or "GLFW does not say why"
        )
        raise TaccorlError(
            f"no display: DISPLAY={os.environ.get('DISPLAY', '')} does not respond ({why}). {way_out}"
        )


OpenLeader = Callable[["LeaderSource"], Any]
"""Function that opens the leader arms which a source describes: ``read()`` gives their joint angles [rad] and openings [m], (14,)
in the order of actions, ``close()`` disconnects."""
_drivers: list[OpenLeader] = []


def use_leader_driver(driver: OpenLeader) -> None:
    """Set the function that opens leader arms. The command line passes LeRobot's, which is in a higher layer."""
    _drivers[:] = [driver]


@dataclass
class _Session:
    """What stays open between demonstrations: the simulation that the person drives, its window, the leader arms."""

    sim: Simulation
    window: ViewerWindow
    device: Any

    def close(self) -> None:
        self.window.close()
        self.device.close()


_sessions: weakref.WeakKeyDictionary[Simulation, _Session] = weakref.WeakKeyDictionary()


@Source.register_subclass("leader")
@dataclass(frozen=True, kw_only=True)
class LeaderSource(Source):
    """Leader arms: any LeRobot teleoperator with 14 values, or with a mapping of its values to the 14."""

    folder: str = "outputs/teleop"
    """Folder for action files."""
    time_limit_s: float = 300.0
    """Time limit of an attempt [s], in place of the task's own, which is made for experts that move both hands at once."""
    teleop: str = ""
    """LeRobot's name of the teleoperator: bi_rebot_102_leader, bi_openarm_leader, …"""
    options: str = ""
    """YAML or JSON file with the teleoperator's own options (ports, calibration id), named as in LeRobot."""
    names: dict[str, str | None] = field(default_factory=dict)
    """The teleoperator's name of a value → taccorl's (left_joint_1.pos … right_gripper.pos), or null: not used. Only names that
    differ are needed."""
    joint_unit: str = ""
    """Unit of its joints: rad, deg, or range_m100_100 (−100 … 100 over the range of our joint). Must be given, because the
    teleoperator does not state it."""
    gripper_unit: str = ""
    """Unit of its grippers: m, or range_0_100 (0 closed, 100 open)."""
    repeatable: ClassVar[bool] = False

    def actions(self, sim: Simulation, rng: np.random.Generator) -> Actions:
        """Actions of the finished demonstration of this scene; if there is none, the person is asked to demonstrate now. Raises
        TaccorlError: there is no display or no device, or the person has closed the window."""
        scene = scene_of(sim)
        folder = Path(self.folder).expanduser()
        file = find_finished(folder, scene)
        if file is None:
            self._demonstrate(self._session(sim), folder, scene["seed"])
            file = find_finished(folder, scene)
            assert file is not None, (
                "a demonstration that has just been finished is there"
            )
        else:
            print(
                f"re-executing {file.path}; move it away, or give another --seed, to demonstrate anew"
            )
        return replay(file, sim)

    def _session(self, sim: Simulation) -> _Session:
        if sim not in _sessions:
            own = Simulation(sim.task, sim.config, scale=sim.randomization_scale)
            own.reset(sim.seeds[:1])
            window = ViewerWindow(own)
            try:
                session = _Session(own, window, self._open())
            except BaseException:
                window.close()
                raise
            weakref.finalize(sim, session.close)
            _sessions[sim] = session
        return _sessions[sim]

    def _open(self) -> Any:
        if not _drivers:
            raise TaccorlError(
                "leader: no function that opens leader arms is set; call teleop.use_leader_driver first"
            )
        device = _drivers[0](self)
        keys = "\n".join(f"  {command.key:8}{command.meaning}" for command in Command)
        print(f"{self.teleop}: connected. Keys, in the window:\n{keys}")
        return device

    def _demonstrate(self, session: _Session, folder: Path, seed: int) -> None:
        """Until the person has finished the scene, however often that takes."""
        actions = None
        while actions is None:
            session.sim.reset([seed])
            give_time(session.sim, self.time_limit_s)
            self._wait_for_begin(session)
            actions = self._drive(session)
        write_actions(folder, session.sim, actions)

    def _wait_for_begin(self, session: _Session) -> None:
        lines = [session.sim.task.instruction, f"{Command.GO.key}: begin"]
        session.window.commands()  # what was typed while the last episode was made does not count
        while Command.GO not in session.window.commands():
            session.device.read()  # a wrong unit is an error before the attempt begins
            session.window.tick(session.sim, lines)

    def _drive(self, session: _Session) -> list[np.ndarray] | None:
        """Actions of one attempt in real time; None if it is to be done again."""
        sim, window = session.sim, session.window
        hands, actions, watched, done = (
            LeaderHands(sim, session.device),
            list[np.ndarray](),
            0,
            False,
        )
        while not sim.judge.success[0] and watched < _AFTER_S * CONTROL_HZ:
            failure = str(sim.judge.failure[0])
            lines = [sim.task.instruction, *hands.lines]
            if failure:
                lines.append(
                    f"{failure}! {Command.DISCARD.key}: again; {Command.GO.key}: keep as failed"
                )
            window.tick(sim, lines)
            asked, commands = hands.read(), window.commands()
            if Command.DISCARD in commands:
                return None
            done = done or Command.GO in commands
            if failure:  # nothing moves any more until the person has said what is to become of it
                if done:
                    return actions
                continue
            actions.append(actions[-1] if done and actions else asked)
            watched += done
            sim.step(actions[-1][None].astype(np.float64))
        return actions


class LeaderHands:
    """Controls by leader arms: the twin's arms follow them, slowly at first, because they start at other angles."""

    def __init__(self, sim: Simulation, device: Any) -> None:
        self._device = device
        self._now = sim.targets[0].copy()
        self._caught_up = False
        self.lines: list[str] = []
        """Status lines of the last reading: values beyond the twin's range, and how far the arms are behind."""

    def read(self) -> np.ndarray:
        """Read the leader arms: the action (14,) [rad, m] of the next control step, float32."""
        read = self._device.read()
        wanted = np.clip(read, ROBOT.action_low, ROBOT.action_high)
        beyond = [
            name
            for name, off in zip(ROBOT.action_names, read != wanted, strict=True)
            if off
        ]
        self.lines = [f"beyond the twin's range: {', '.join(beyond)}"] if beyond else []
        if not self._caught_up:
            away = wanted - self._now
            step = np.clip(away, -_CATCH_UP_STEP, _CATCH_UP_STEP)
            self._caught_up = bool((step == away).all())
            wanted = wanted if self._caught_up else self._now + step
            self.lines.append(
                f"catching up with the leader: {np.abs(away).max():.2f} to go"
            )
        self._now = wanted
        return wanted.astype(np.float32)

"""Bodies: arms and cameras of a robot behind one interface, with the time of every sample. Tactile pads are not part of a body.

Letters in shapes: A numbers of an action.
"""

import queue
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from lerobot.robots.robot import Robot

from taccorl.data.origin import UNSTATED, Origin
from taccorl.errors import TaccorlError
from taccorl.robot_plugin.faults import close_all
from taccorl.robot_plugin.pads import PadDriver, PadsConfig
from taccorl.robot_plugin.surrogate_link import SurrogateLink
from taccorl.robots import ROBOT

ARM_NAMES = tuple(
    name.replace("_joint", "_joint_") + ".pos" for name in ROBOT.action_names
)
"""(14,) names of state and action in the data spec: left_joint_1.pos … right_gripper.pos."""
Listener = Callable[[str, float, str, Any], None]
"""Function that is called with every sample: kind (state, camera), time [s], name of the camera, and value. A state is (3, A):
position, velocity and effort, NaN where the robot does not measure them."""


@dataclass(kw_only=True)
class Sample:
    """One measurement of a robot's arms and cameras: positions, efforts, pictures, and the times at which they were taken."""

    position: np.ndarray
    """(A,) in the order and units of actions."""
    pictures: dict[str, np.ndarray] = field(default_factory=dict)
    """Camera → (rows, columns, 3) uint8 RGB."""
    stamps_s: dict[str, float] = field(default_factory=dict)
    """Channel, ``state`` or ``camera:<name>`` → time of its newest sample [s of time.monotonic]; −inf: none came yet."""
    effort: np.ndarray | None = None
    """(A,) efforts of the motors; None: not reported."""


class Body(Protocol):
    """Arms and cameras of a robot."""

    origin: Origin
    listeners: list[Listener]

    @property
    def names(self) -> Sequence[str]: ...
    @property
    def cameras(self) -> Mapping[str, tuple[int, ...]]:
        """Camera → rows and columns of its pictures."""
        ...

    def connect(self) -> None: ...
    def disconnect(self) -> None: ...
    @property
    def is_connected(self) -> bool: ...
    @property
    def is_lost(self) -> bool: ...
    def read(self) -> Sample: ...
    def send(self, target: np.ndarray) -> None:
        """Send ``target`` to the robot: (A,) positions of joints and grippers, in the units of its actions."""
        ...


def tell(listeners: Sequence[Listener], sample: Sample) -> None:
    """Pass a sample of a robot that measures no velocities to listeners."""
    unknown = np.full(len(sample.position), np.nan)
    state = np.stack(
        [sample.position, unknown, unknown if sample.effort is None else sample.effort]
    )
    for listener in listeners:
        listener("state", sample.stamps_s["state"], "", state)
        for name, picture in sample.pictures.items():
            listener("camera", sample.stamps_s[f"camera:{name}"], name, picture)


class LeRobotBody:
    """Any LeRobot robot as a body. Names, units and cameras are its own."""

    origin = UNSTATED
    is_lost = False

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.names = tuple(robot.action_features)
        self.cameras = {
            k: v[:2]
            for k, v in robot.observation_features.items()
            if isinstance(v, tuple)
        }
        unread = [name for name in self.names if name not in robot.observation_features]
        if unread:
            raise TaccorlError(
                f"robot {robot.name}: commands {', '.join(unread)}, but does not measure it"
            )
        self.listeners: list[Listener] = []

    def connect(self) -> None:
        self.robot.connect()

    def disconnect(self) -> None:
        """Disconnect the robot, or those of its parts that are connected: LeRobot's
        robots refuse to disconnect where one part failed. Raises TaccorlError, after
        all were tried: one could not be closed."""
        if failures := close_all(_connected_parts(self.robot)):
            raise TaccorlError("; ".join(failures))

    @property
    def is_connected(self) -> bool:
        return self.robot.is_connected

    def read(self) -> Sample:
        before_s = time.monotonic()
        seen = self.robot.get_observation()
        stamps = {"state": before_s}
        for name in self.cameras:
            # LeRobot's cameras state when a picture was taken; perf_counter is CLOCK_MONOTONIC on Linux.
            taken_s = getattr(
                getattr(self.robot, "cameras", {}).get(name), "latest_timestamp", None
            )
            stamps[f"camera:{name}"] = before_s if taken_s is None else taken_s
        position = np.array([float(seen[name]) for name in self.names])
        found = Sample(
            position=position,
            pictures={c: np.asarray(seen[c]) for c in self.cameras},
            stamps_s=stamps,
        )
        tell(self.listeners, found)
        return found

    def send(self, target: np.ndarray) -> None:
        self.robot.send_action(dict(zip(self.names, target.tolist(), strict=True)))


def _connected_parts(device: Any, name: str = "robot") -> dict[str, Callable[[], Any]]:
    """Name → ``disconnect`` of a LeRobot device if it is connected, else of the buses,
    cameras and arms in its attributes that are."""
    if device.is_connected:
        return {name: device.disconnect}
    found: dict[str, Callable[[], Any]] = {}
    for key, value in vars(device).items():
        parts = value if isinstance(value, dict) else {"": value}
        for own, part in parts.items():
            if hasattr(part, "is_connected") and callable(
                getattr(part, "disconnect", None)
            ):
                found |= _connected_parts(part, f"{name}.{key}.{own}".rstrip("."))
    return found


class SurrogateArms:
    """Arms and cameras of a surrogate robot that ``taccorl serve-surrogate`` simulates on this machine."""

    def __init__(self, link: SurrogateLink, cameras: Sequence[str], px: int) -> None:
        self.link, self.names = link, ARM_NAMES
        self.listeners = self.link.listeners
        self.cameras = dict.fromkeys(cameras, (px, px))
        self.origin = Origin("surrogate", "surrogate robot, not a robot")
        self.task = self.instruction = ""

    def connect(self) -> None:
        facts = self.link.connect()
        self.origin, self.instruction = (
            Origin.read(facts["origin"]),
            str(facts["instruction"]),
        )
        self.task = str(facts["task"])
        wrong = {
            n: facts["cameras"].get(n)
            for n in self.cameras
            if facts["cameras"].get(n) != list(self.cameras[n])
        }
        if wrong:
            self.link.close()
            text = f"surrogate on port {self.link.port}: its cameras are {facts['cameras'] or 'none'}, not {self.cameras}"
            raise TaccorlError(
                f"{text}: give --robot.camera_names=[…], --robot.camera_px, or serve with --camera_px"
            )
        self._wait()

    def reset(self, seed: int | None) -> None:
        """Put the bench in order: the scene of ``seed``, or the next one. Only its samples are read from now on."""
        self.link.request("reset", seed=seed)
        self._wait()

    def _wait(self) -> None:
        until = time.monotonic() + 15.0
        while not self.link.states or any(
            name not in self.link.pictures for name in self.cameras
        ):
            if time.monotonic() > until:
                silent = [n for n in self.cameras if n not in self.link.pictures] or [
                    "joint states"
                ]
                self.link.close()
                raise TaccorlError(
                    f"surrogate on port {self.link.port}: nothing comes of {', '.join(silent)}"
                )
            time.sleep(0.01)

    def disconnect(self) -> None:
        self.link.close()

    @property
    def is_connected(self) -> bool:
        return self.link.is_connected

    @property
    def is_lost(self) -> bool:
        return self.link.is_lost

    def read(self) -> Sample:
        stamp_s, (position, _, effort) = self.link.states[-1]
        found = Sample(
            position=position.copy(), effort=effort, stamps_s={"state": stamp_s}
        )
        for name in self.cameras:
            found.stamps_s[f"camera:{name}"], found.pictures[name] = self.link.pictures[
                name
            ]
        return found

    def send(self, target: np.ndarray) -> None:
        self.link.send("command", target=target.tolist())


@dataclass(kw_only=True)
class SurrogatePads(PadsConfig):
    """Pads of a surrogate, through the connection of its arms."""

    link: Any = None
    """The ``SurrogateLink`` of the arms."""

    @property
    def names(self) -> tuple[str, ...]:
        return ROBOT.pads

    def open(self, name: str) -> PadDriver:
        return _SurrogatePad(self.link, name)


class _SurrogatePad:
    """One pad of a surrogate."""

    def __init__(self, link: SurrogateLink, name: str) -> None:
        self._frames = link.pads[name]

    def read(self) -> tuple[float, np.ndarray]:
        try:
            return self._frames.get(timeout=0.1)
        except queue.Empty as error:
            raise TimeoutError("the surrogate's pad sends nothing") from error

    def close(self) -> None: ...

"""Two PiPER arms by the plug-in lerobot_robot_wego_piper 0.3.1, and LeRobot's cameras, as one body in rad and m.

Written against the published interface of the plug-in, and never tried on hardware. The plug-in gives joints as −100 … 100 and
grippers as 0 … 100 of its own ranges (0.001°, 0.001 mm), and clips what lies outside of them.
"""

import importlib
import time
from functools import partial
from typing import Any

import numpy as np
from lerobot.cameras.utils import make_cameras_from_configs

from taccorl.data.origin import UNSTATED
from taccorl.errors import TaccorlError
from taccorl.robot_plugin.bodies import ARM_NAMES, Listener, Sample, tell
from taccorl.robot_plugin.config_robots import BiPiperFlexitacConfig
from taccorl.robot_plugin.faults import close_all, described
from taccorl.robots import ROBOT

MOTORS = (*ROBOT.joints, "gripper")  # the plug-in's names: joint1 … joint6, gripper
_RAD, _M = np.pi / 180_000, 1e-6  # of one count of the plug-in's ranges
_FROM_LOW = ROBOT.per_action(
    100.0, 0.0
)  # the plug-in's units from the lower end of a range to its 0
_OLDEST_MS = 10_000  # ages are judged by safety, not by the camera


class TwoPipers:
    """Left and right arm, and the cameras. Raises TaccorlError: the plug-in is not installed, or a camera has no such name."""

    origin = UNSTATED  # only the user knows that a robot made a recording: taccorl ingest --domain=real
    is_lost = False
    names = ARM_NAMES

    def __init__(self, config: BiPiperFlexitacConfig) -> None:
        try:
            plugin = importlib.import_module("lerobot_robot_piper")
        except ImportError as error:
            text = "--robot.type=bi_piper_flexitac needs the plug-in: pip install lerobot_robot_wego_piper"
            raise TaccorlError(text) from error
        if config.left_can == config.right_can:
            raise TaccorlError(
                f"--robot.left_can and --robot.right_can are both {config.left_can}: give each its own"
            )
        ports = {"left": config.left_can, "right": config.right_can}
        self.arms: dict[str, Any] = {
            arm: plugin.PiperFollower(plugin.PiperFollowerConfig(port=port, id=arm))
            for arm, port in ports.items()
        }
        if config.cameras and tuple(config.cameras) != ROBOT.cameras:
            raise TaccorlError(
                f"--robot.cameras: {', '.join(config.cameras)}; name them {', '.join(ROBOT.cameras)}"
            )
        self._cameras: dict[str, Any] = make_cameras_from_configs(config.cameras)
        self.cameras = {
            name: (camera.height, camera.width)
            for name, camera in self._cameras.items()
        }
        self.listeners: list[Listener] = []
        self._low, self._unit = self._ranges()

    def _ranges(self) -> tuple[np.ndarray, np.ndarray]:
        """(14,) value at the lower end of the plug-in's range [rad, m], and size of one of its units [rad, m]."""
        low, unit = [], []
        for arm in ROBOT.arms:
            for motor in MOTORS:
                known = self.arms[arm].bus.calibration[motor]
                one, parts = (_M, 100.0) if motor == "gripper" else (_RAD, 200.0)
                low.append(known.range_min * one)
                unit.append((known.range_max - known.range_min) * one / parts)
        return np.array(low), np.array(unit)

    def connect(self) -> None:
        """Connect without the plug-in's own motion to its origin."""
        for arm, robot in self.arms.items():
            try:
                robot.connect(calibrate=False)
            except (Exception, SystemExit) as error:
                raise TaccorlError(
                    f"the {arm} arm does not answer: {described(error)}; piper-doctor says more"
                ) from error
        for name, camera in self._cameras.items():
            try:
                camera.connect()
            except (Exception, SystemExit) as error:
                text = f"the camera {name} does not answer: {described(error)}"
                raise TaccorlError(text) from error

    def disconnect(self) -> None:
        """Disconnect what is connected; the arms keep their torque, so that they do not
        fall. Raises TaccorlError, after all were tried: one could not be closed."""
        parts = {
            f"{arm} arm": partial(robot.disconnect, disable_torque=False)
            for arm, robot in self.arms.items()
            if robot.is_connected
        }
        for name, camera in self._cameras.items():
            if camera.is_connected:
                parts[f"camera {name}"] = camera.disconnect
        if failures := close_all(parts):
            raise TaccorlError("; ".join(failures))

    @property
    def is_connected(self) -> bool:
        return all(robot.is_connected for robot in self.arms.values())

    def read(self) -> Sample:
        now_s = time.monotonic()
        seen = [self.arms[arm].get_observation() for arm in ROBOT.arms]
        theirs = np.array(
            [float(one[f"{motor}.pos"]) for one in seen for motor in MOTORS]
        )
        found = Sample(position=self.to_ours(theirs), stamps_s={"state": now_s})
        for name, camera in self._cameras.items():
            found.pictures[name] = np.asarray(camera.read_latest(_OLDEST_MS))
            found.stamps_s[f"camera:{name}"] = (
                now_s if camera.latest_timestamp is None else camera.latest_timestamp
            )
        tell(self.listeners, found)
        return found

    def send(self, target: np.ndarray) -> None:
        theirs = self.to_theirs(target)
        for arm, robot in self.arms.items():
            values = theirs[ROBOT.arm_slice(arm)].tolist()
            robot.send_action(
                {
                    f"{motor}.pos": value
                    for motor, value in zip(MOTORS, values, strict=True)
                }
            )

    def to_ours(self, theirs: np.ndarray) -> np.ndarray:
        """(14,) of the plug-in's units in [rad, m]."""
        return self._low + (theirs + _FROM_LOW) * self._unit

    def to_theirs(self, ours: np.ndarray) -> np.ndarray:
        """(14,) [rad, m] in the plug-in's units."""
        return (ours - self._low) / self._unit - _FROM_LOW

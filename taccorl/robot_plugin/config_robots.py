"""Options of our robots in LeRobot's commands: ``--robot.type=touch_robot|taccorl_surrogate|bi_piper_flexitac``.

An SO-101 with pads, as a file for --config_path:

    robot: {type: touch_robot, safety: {max_speed: {pos: 120}},
            robot: {type: so101_follower, port: /dev/ttyACM0},
            pads: {type: flexitac, ports: {left: /dev/ttyUSB0, right: /dev/ttyUSB1}}}
"""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lerobot.cameras import CameraConfig
from lerobot.robots.config import RobotConfig
from lerobot.teleoperators.config import TeleoperatorConfig

from taccorl.errors import TaccorlError
from taccorl.robot_plugin import DEFAULT_PORT, LOST_S, MOST_PX
from taccorl.robot_plugin.pads import FlexiTacPads, PadsConfig
from taccorl.robot_plugin.safety import SafetyConfig
from taccorl.robots import ROBOT

MOST_FPS = 1000.0  # Highest rate of a loop [Hz]


@dataclass(kw_only=True)
class TouchOptions(RobotConfig):
    """Options that all our robots have."""

    safety: SafetyConfig = field(default_factory=SafetyConfig)
    """Limits and stops."""
    fps: float = 30.0
    """Rate of the loop [Hz]; must be that of the policy and of LeRobot's --fps."""
    picture_px: int = 224
    """Height and width [pixels] of observed pictures, which are scaled and padded with black; 0: those of the cameras."""
    record: Path | None = None
    """MCAP file of everything that the robot measures and is told; PiPER arms only."""
    dry_run: bool = False
    """Send no command; at the end, print ages and latencies, and whether the loop can be held."""

    def __post_init__(self) -> None:
        """Raises TaccorlError: a number is out of its range."""
        super().__post_init__()
        if not 0 <= self.picture_px <= MOST_PX:
            raise TaccorlError(
                f"--robot.picture_px={self.picture_px}: give 0 … {MOST_PX}"
            )
        if not 0 < self.fps <= MOST_FPS:
            raise TaccorlError(
                f"--robot.fps={self.fps:g}: give a rate above 0, at most {MOST_FPS:g} Hz"
            )


@RobotConfig.register_subclass("touch_robot")
@dataclass(kw_only=True)
class TouchRobotConfig(TouchOptions):
    """Any LeRobot robot with pads and safety. Names, units and cameras are the robot's own."""

    robot: dict[str, Any]
    """LeRobot's robot: {type: so101_follower, port: …}. (draccus lists the options of a robot within a robot for ever.)"""
    pads: PadsConfig | None = None
    """Pads: {type: flexitac, ports: …} or {type: driver, …}; none if not given."""
    picture_px: int = 0
    """As for the other robots, but by default pictures are left as they are."""


@RobotConfig.register_subclass("taccorl_surrogate")
@dataclass(kw_only=True)
class TaccorlSurrogateConfig(TouchOptions):
    """A surrogate robot on this machine, which ``taccorl serve-surrogate`` runs."""

    port: int = DEFAULT_PORT
    """TCP port that it prints."""
    camera_names: list[str] = field(default_factory=lambda: list(ROBOT.cameras))
    """Cameras to read; [] for none."""
    camera_px: int = 224
    """Rows and columns of its pictures (serve-surrogate --camera_px)."""
    lost_after_s: float = LOST_S
    """Time without any message of it after which the connection counts as lost [s]."""

    def __post_init__(self) -> None:
        """Raises TaccorlError: a number is out of its range."""
        super().__post_init__()
        if not 0 <= self.camera_px <= MOST_PX:
            raise TaccorlError(
                f"--robot.camera_px={self.camera_px}: give 0 … {MOST_PX}, as serve-surrogate has it"
            )
        if not 0 < self.lost_after_s < math.inf:
            raise TaccorlError(
                f"--robot.lost_after_s={self.lost_after_s:g}: give a time above 0 s"
            )


@RobotConfig.register_subclass("bi_piper_flexitac")
@dataclass(kw_only=True)
class BiPiperFlexitacConfig(TouchOptions):
    """Two PiPER arms (package lerobot_robot_wego_piper) with FlexiTac pads and LeRobot's cameras. Never tried on hardware."""

    left_can: str = "can_follower1"
    """CAN interface of the left arm."""
    right_can: str = "can_follower2"
    """CAN interface of the right arm."""
    cameras: dict[str, CameraConfig] = field(default_factory=dict)
    """front, left_wrist and right_wrist: {type: opencv, index_or_path: 0, width: 640, height: 480, fps: 30}."""
    pads: FlexiTacPads = field(default_factory=FlexiTacPads)
    """Ports of left_a, left_b, right_a and right_b, in this order."""


@TeleoperatorConfig.register_subclass("taccorl_surrogate_leader")
@dataclass(kw_only=True)
class SurrogateLeaderConfig(TeleoperatorConfig):
    """Leader arms of a surrogate, which the task's scripted expert moves in place of a person."""

    port: int = DEFAULT_PORT
    """TCP port that serve-surrogate prints."""

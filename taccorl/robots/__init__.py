"""Robots: one file per robot holds its names, sizes and numbers, and ``ROBOT`` is the one that the package works with."""

from taccorl.robots.bimanual_piper import BIMANUAL_PIPER
from taccorl.robots.robot_spec import RobotSpec

ROBOT: RobotSpec = BIMANUAL_PIPER
"""The robot that the package works with."""

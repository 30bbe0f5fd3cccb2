"""Importing this module registers TacCoRL's classes with LeRobot, which imports it by itself (see ``_shim.py``)."""

import functools

from draccus.wrappers import docstring

import taccorl.lerobot_plugin.env
import taccorl.policies.tactile_pi05.configuration_tactile_pi05
import taccorl.robot_plugin.config_robots
import taccorl.robot_plugin.lerobot_hooks
import taccorl.training.reading
from taccorl.extras import quick_columns
from taccorl.lerobot_plugin import compat

compat.follow()
taccorl.training.reading.install()
taccorl.robot_plugin.lerobot_hooks.install()
quick_columns()
# draccus searches the source of a class anew for each of the thousands of options of lerobot-train: half a second a command.
docstring.get_attribute_docstring = functools.cache(docstring.get_attribute_docstring)

"""Installed as the module ``lerobot_policy_taccorl``: LeRobot imports that by name (utils/import_utils.py, 0.6.1)."""

import taccorl.lerobot_plugin  # noqa: F401

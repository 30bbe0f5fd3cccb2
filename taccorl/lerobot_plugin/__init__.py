"""Importing this registers what TacCoRL adds to LeRobot. LeRobot does so by itself (see ``_shim.py``).

Nothing else lives here. The tactile policy will register here, too.
"""

import taccorl.lerobot_plugin.env  # noqa: F401

"""Importing this registers what TacCoRL adds to LeRobot. LeRobot does so by itself (see ``_shim.py``).

Nothing else lives here.
"""

import taccorl.lerobot_plugin.env
import taccorl.policies.tactile_pi05.configuration_tactile_pi05
import taccorl.rl.flow_ppo_config
import taccorl.training.reading

taccorl.training.reading.install()

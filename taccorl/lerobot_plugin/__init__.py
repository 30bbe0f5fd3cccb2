"""Importing this registers what TacCoRL adds to LeRobot. LeRobot does so by itself (see ``_shim.py``).

Nothing else lives here. The tactile policy and the twin's environment will register here; today the plug-in only
proves that LeRobot loads it.
"""

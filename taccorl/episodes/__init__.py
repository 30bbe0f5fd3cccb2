"""Demonstrations in the twin: experts, teleoperation, collecting."""

import taccorl.sim  # noqa: F401  says what is wrong with MUJOCO_GL before any module imports MuJoCo itself

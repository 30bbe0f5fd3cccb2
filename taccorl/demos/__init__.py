"""Demonstrations in the twin: experts, teleoperation, collecting; and the stand-in recordings that tests are made of."""

import taccorl.sim  # noqa: F401  says what is wrong with MUJOCO_GL before any module imports MuJoCo itself

"""Simulated robots in place of real ones, computed independently of the twin, and recordings in the format of their drivers."""

import taccorl.sim  # noqa: F401  says what is wrong with MUJOCO_GL before any module imports MuJoCo itself

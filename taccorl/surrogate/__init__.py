"""Simulated robots that stand in for real ones, computed apart from the twin, and recordings as their drivers write them."""

import taccorl.sim  # noqa: F401  says what is wrong with MUJOCO_GL before any module imports MuJoCo itself

"""Observation and action spaces of the twin's environments, with the names of data_specs/taccorl_bimanual.yaml."""

import numpy as np
from gymnasium.spaces import Box, Dict

from taccorl.robots import ROBOT
from taccorl.sim.part_poses import PARTS_KEY

IMAGE_SHAPE = (224, 224, 3)  # rows, columns, rgb: what π0.5 looks at
STATE_KEY, TACTILE_KEY = "observation.state", "observation.tactile"
IMAGE_KEYS = {name: f"observation.images.{name}" for name in ROBOT.cameras}
"""Name of the camera → key of its pictures."""

Observation = dict[str, np.ndarray]
"""Key of the dataset (``STATE_KEY``, ``TACTILE_KEY``, ``IMAGE_KEYS`` …) → array, with a leading axis N of several
environments.
"""


def observation_space(images: bool, part_numbers: int | None = None) -> Dict:
    """Observation space of one environment: ``observation.state`` (14,) joints [rad] and openings [m], ``observation.tactile``
    (1536,) counts above baseline, with ``images`` pictures (224, 224, 3) uint8 RGB, and ``part_numbers`` values of the parts'
    poses, if it is given."""
    counts = np.iinfo(np.int16)
    spaces = {
        STATE_KEY: Box(-np.inf, np.inf, (ROBOT.num_actions,), np.float32),
        TACTILE_KEY: Box(counts.min, counts.max, (ROBOT.num_taxels,), np.int16),
    }
    if part_numbers is not None:
        spaces[PARTS_KEY] = Box(-np.inf, np.inf, (part_numbers,), np.float32)
    if images:
        spaces |= {
            key: Box(0, 255, IMAGE_SHAPE, np.uint8) for key in IMAGE_KEYS.values()
        }
    return Dict(spaces)


def action_space() -> Box:
    """Action space (14,) float32 of one environment: targets within the joint limits [rad] and the grippers' openings [m]."""
    return Box(
        ROBOT.action_low.astype(np.float32), ROBOT.action_high.astype(np.float32)
    )

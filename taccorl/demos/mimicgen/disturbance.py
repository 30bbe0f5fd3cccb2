"""What pushes the arms of an attempt off their way, so that new episodes show the way back.

    executed(t) = intended(t) + strength(t) · drift(t)         the dataset's ``action`` is what was intended

A policy that has only seen successes does not know what to do 10 mm beside them. Here an arm drifts off while the action that
is shown still leads to where the demonstration was: DART, Laskey et al. 2017, Noise Injection for Robust Imitation Learning
(arXiv:1703.09327), with noise that lasts, as an arm follows its command in a tenth of a second and white noise hardly moves it.
"""

import math

import numpy as np

from taccorl.demos.mimicgen.spec import DisturbanceSpec
from taccorl.sim.actions import ACTION_HIGH, ACTION_LOW
from taccorl.sim.robot import ARMS
from taccorl.sim.twin import CONTROL_HZ

# T rows
_CLEAR_STEPS = 12  # before and after what must be exact: 0.4 s, four times the arm's lag
_RAMP_STEPS = 12
_MOVES_M = 2e-4  # of an opening in a step
_JOINTS, _PER_ARM = 6, 7


def disturbed(
    intended: np.ndarray, mates_touch: np.ndarray, spec: DisturbanceSpec, rng: np.random.Generator
) -> np.ndarray:
    """What is executed: joints drift, openings are as intended.

    Args:
        intended: (T, 14) float32 joint targets [rad] and openings [m].
        mates_touch: (T,) whether parts that belong together touch when the action is sent.

    Returns:
        (T, 14) float32, within the limits of actions.
    """
    off_rad, strength = drift(len(intended), spec, rng), strengths(intended, mates_touch)
    executed = intended.astype(float)
    for a in range(len(ARMS)):
        joints = slice(_PER_ARM * a, _PER_ARM * a + _JOINTS)
        executed[:, joints] += strength[:, [a]] * off_rad[:, _JOINTS * a : _JOINTS * (a + 1)]
    return np.clip(executed, ACTION_LOW, ACTION_HIGH).astype(np.float32)


def strengths(intended: np.ndarray, mates_touch: np.ndarray) -> np.ndarray:
    """(T, 2) of each arm, 0 … 1: none while its gripper moves or parts that belong together touch, nor 0.4 s before and after;
    full another 0.4 s away."""
    strength = np.ones((len(intended), len(ARMS)))
    for a in range(len(ARMS)):
        opening_m = intended[:, _PER_ARM * a + _JOINTS].astype(float)
        exact = mates_touch | (np.abs(np.diff(opening_m, prepend=opening_m[:1])) > _MOVES_M)
        rows = np.flatnonzero(exact)
        if len(rows):
            away = np.abs(np.arange(len(intended))[:, None] - rows).min(1)
            strength[:, a] = np.clip((away - _CLEAR_STEPS) / _RAMP_STEPS, 0, 1)
    return strength


def drift(num_rows: int, spec: DisturbanceSpec, rng: np.random.Generator) -> np.ndarray:
    """(T, 12) [rad] an Ornstein–Uhlenbeck process of each joint, from 0 at the first row."""
    kept = math.exp(-1 / (CONTROL_HZ * spec.time_s))
    off = np.zeros((num_rows, _JOINTS * len(ARMS)))
    for t in range(1, num_rows):
        off[t] = kept * off[t - 1] + math.sqrt(1 - kept**2) * spec.joint_rad * rng.normal(size=off.shape[1])
    return off

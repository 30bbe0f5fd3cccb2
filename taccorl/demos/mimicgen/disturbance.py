"""What pushes the arms of an attempt off their way, so that new episodes show the way back.

    executed(t) = intended(t) + strength(t) · drift(t)         the dataset's ``action`` is what was intended

A policy that has only seen successes does not know what to do 10 mm beside them. Here an arm drifts off while the action that
is shown still leads to where the demonstration was: DART, Laskey et al. 2017, Noise Injection for Robust Imitation Learning
(arXiv:1703.09327), with noise that lasts, as an arm follows its command in a tenth of a second and white noise hardly moves it.
"""

import math

import numpy as np

from taccorl.demos.mimicgen.spec import DisturbanceSpec
from taccorl.demos.mimicgen.touching import Touching
from taccorl.sim.actions import ACTION_HIGH, ACTION_LOW
from taccorl.sim.robot import ARMS
from taccorl.sim.simulation import Simulation
from taccorl.sim.twin import CONTROL_HZ

# T rows
_CLEAR_STEPS = 12  # before and after what must be exact: 0.4 s, four times the arm's lag
_RAMP_STEPS = 12
_MOVES_M = 2e-4  # of an opening in a step
_JOINTS, _PER_ARM = 6, 7


def disturbed(
    intended: np.ndarray, is_exact: np.ndarray, spec: DisturbanceSpec, rng: np.random.Generator
) -> np.ndarray:
    """What is executed: joints drift, openings are as intended.

    Args:
        intended: (T, 14) float32 joint targets [rad] and openings [m].
        is_exact: (T, 2) whether an arm may not be pushed when the action is sent (``Exact``).

    Returns:
        (T, 14) float32, within the limits of actions.
    """
    off_rad, strength = drift(len(intended), spec, rng), strengths(intended, is_exact)
    executed = intended.astype(float)
    for a in range(len(ARMS)):
        joints = slice(_PER_ARM * a, _PER_ARM * a + _JOINTS)
        executed[:, joints] += strength[:, [a]] * off_rad[:, _JOINTS * a : _JOINTS * (a + 1)]
    return np.clip(executed, ACTION_LOW, ACTION_HIGH).astype(np.float32)


class Exact:
    """When an arm may not be pushed: it grips what something else holds fast, the table for one; or what belongs together has met
    and a hand still holds one of it. Inside its play a plug does not touch all the time, so that they have met is remembered."""

    def __init__(self, sim: Simulation) -> None:
        """After a reset."""
        self._sim, self._touching = sim, Touching(sim)
        self._have_met = np.zeros(len(sim.task.mating), bool)

    def look(self) -> np.ndarray:
        """(2,) of each arm in the simulation's present state; to be called at each row."""
        sim = self._sim
        self._touching.look(sim.state_rows()[0])
        for i, pair in enumerate(sim.task.mating):
            is_held = any({arm, part} in self._touching.pairs for arm in ARMS for part in pair)
            self._have_met[i] = is_held and (self._have_met[i] or sim.contact(*pair).touching[0])
        return np.array([self._have_met.any() or self._touching.holds_fast(arm) for arm in ARMS])


def strengths(intended: np.ndarray, is_exact: np.ndarray) -> np.ndarray:
    """(T, 2) of each arm, 0 … 1: none in rows (T, 2) that are exact or while its gripper moves, nor 0.4 s before and after; full
    another 0.4 s away."""
    strength = np.ones((len(intended), len(ARMS)))
    for a in range(len(ARMS)):
        opening_m = intended[:, _PER_ARM * a + _JOINTS].astype(float)
        exact = is_exact[:, a] | (np.abs(np.diff(opening_m, prepend=opening_m[:1])) > _MOVES_M)
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

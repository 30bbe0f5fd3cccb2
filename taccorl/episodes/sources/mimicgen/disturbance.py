"""Disturbance of the arms in transport, so that new episodes contain recoveries.

    executed(t) = intended(t) + strength(t) · drift(t)         the dataset's ``action`` is the intended target

A policy that has only seen successes does not know what to do 10 mm beside them. Here an arm drifts away while the stored action
still leads to the demonstrated position: DART, Laskey et al. 2017, Noise Injection for Robust Imitation Learning
(arXiv:1703.09327), with noise that lasts, as an arm follows its command in a tenth of a second and white noise hardly moves it.

The strength of an arm is 0 while its gripper moves, while it is ``Exact``, while either arm is at contact (from
``contact_lead_steps`` before it) or moved by an expert, 0.4 s before and after that, and 0.8 s before its gripper moves. It is
computed when an action is sent, from the arm's path ahead (``Director.ahead``). So the attempt itself is disturbed, nothing is
executed twice, and an expert that moves the hands in contact starts from the disturbed state.
"""

import math
from collections.abc import Mapping

import numpy as np

from taccorl.episodes.sources.mimicgen.director import Ahead, ArmTarget
from taccorl.episodes.sources.mimicgen.spec import DisturbanceSpec
from taccorl.episodes.sources.mimicgen.touching import Touching
from taccorl.robots import ROBOT
from taccorl.sim.simulation import Simulation
from taccorl.sim.twin import CONTROL_HZ

_CLEAR_STEPS = (
    12  # before and after what must be exact: 0.4 s, four times the arm's lag
)
_APPROACH_STEPS = 12  # more before a gripper moves: a hand that comes down on a part beside its place turns or shifts it
_RAMP_STEPS = 12
_MOVES_M = 2e-4  # of an opening in a step


class Disturbance:
    """Disturbance of one attempt. Call once per control step: ``update``, then ``executed``."""

    def __init__(self, spec: DisturbanceSpec, rng: np.random.Generator) -> None:
        self._spec, self._rng = spec, rng
        self._off_rad = np.zeros(len(ROBOT.joint_indices))
        self._since = np.full(len(ROBOT.arms), np.inf)
        """(2,) steps since each arm last had to be exact."""
        self._opening_m: dict[str, float] = {}
        self.strength = np.zeros(len(ROBOT.arms))
        """(2,) present strength of each arm, 0 … 1."""
        self._is_first = True

    @property
    def pushed(self) -> list[str]:
        """Arms that are disturbed now."""
        return [
            arm
            for arm, strength in zip(ROBOT.arms, self.strength, strict=True)
            if strength > 0
        ]

    def update(
        self,
        arm_targets: Mapping[str, ArmTarget],
        ahead: Mapping[str, Ahead],
        is_exact: np.ndarray,
    ) -> None:
        """Advance the disturbance by one control step, and compute its strength for each arm. ``ahead``: of each arm, what
        follows the present targets. ``is_exact``: (2,) whether each arm must follow its source exactly now (``Exact``)."""
        contact = min(each.contact for each in ahead.values())
        before = np.empty(len(ROBOT.arms))
        for a, arm in enumerate(ROBOT.arms):
            opening_m = arm_targets[arm].opening_m
            moves = abs(opening_m - self._opening_m.get(arm, opening_m)) > _MOVES_M
            self._opening_m[arm] = opening_m
            before[a] = min(contact, max(ahead[arm].gripper - _APPROACH_STEPS, 0))
            must_be = moves or is_exact[a] or min(contact, ahead[arm].gripper) == 0
            self._since[a] = 0 if must_be else self._since[a] + 1
        self.strength = np.clip(
            (np.minimum(before, self._since) - _CLEAR_STEPS) / _RAMP_STEPS, 0, 1
        )
        if not self._is_first:
            self._off_rad = drifted(self._off_rad, self._spec, self._rng)
        self._is_first = False

    def executed(self, intended: np.ndarray) -> np.ndarray:
        """(14,) float32 within the limits of actions: joints of ``intended`` (14,) [rad] drift, openings [m] do not."""
        executed = intended.astype(float)
        executed[ROBOT.joint_indices] += (
            np.repeat(self.strength, ROBOT.num_joints) * self._off_rad
        )
        return np.clip(executed, ROBOT.action_low, ROBOT.action_high).astype(np.float32)


class Exact:
    """Decides when an arm may not be disturbed: it grips a part that something else holds (the table, for example); or mating
    parts have touched and a hand still holds one of them. A plug with clearance does not touch all the time, so that a first
    touch is remembered."""

    def __init__(self, sim: Simulation) -> None:
        """``sim``: one whose episode has just been reset."""
        self._sim, self._touching = sim, Touching(sim)
        self._have_met = np.zeros(len(sim.task.mating), bool)

    def look(self) -> np.ndarray:
        """(2,) bool: whether each arm must be exact in the simulation's present state; call it at each row."""
        sim = self._sim
        self._touching.look(sim.state_rows()[0])
        for i, pair in enumerate(sim.task.mating):
            is_held = any(
                {arm, part} in self._touching.pairs
                for arm in ROBOT.arms
                for part in pair
            )
            self._have_met[i] = is_held and (
                self._have_met[i] or sim.contact(*pair).touching[0]
            )
        return np.array(
            [
                self._have_met.any() or self._touching.holds_fast(arm)
                for arm in ROBOT.arms
            ]
        )


def drifted(
    off_rad: np.ndarray, spec: DisturbanceSpec, rng: np.random.Generator
) -> np.ndarray:
    """(12,) [rad] state of an Ornstein–Uhlenbeck process per joint, one control step after ``off_rad`` (12,)."""
    kept = math.exp(-1 / (CONTROL_HZ * spec.time_s))
    return kept * off_rad + math.sqrt(1 - kept**2) * spec.joint_rad * rng.normal(
        size=off_rad.shape
    )

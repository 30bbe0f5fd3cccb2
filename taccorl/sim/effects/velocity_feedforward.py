"""Velocity feed-forward: the controller damps the joint's speed against the commanded speed, not against rest."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from taccorl.robots import ROBOT
from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import JointEffect, Memory, parameter
from taccorl.sim.effects.live_model import LiveModel


@effects.register("velocity_feedforward")
@dataclass(kw_only=True)
class VelocityFeedforward(JointEffect):
    """Velocity feedforward of the drive: τ = K_p (q* − q) + K_d (α q̇* − q̇) + T_ref. With α = 1 the lag K_d / K_p vanishes.

    q̇*_k = (q*_k − q*_{k−1}) / Δt between two commands, constant while q*_k is in force; 0 for the first command. The controller
    gets q* + α (K_d / K_p) q̇*. The effect acts after ``command_lag`` and ``slew_limit``, whose output r is differentiated, and
    before ``command_delay``.
    """

    name: ClassVar = "velocity_feedforward"
    needs: ClassVar = ("target",)
    equation: ClassVar = "τ = K_p (q* − q) + K_d (α q̇* − q̇) + T_ref"
    in_words: ClassVar = (
        "The driver sends speeds along with positions, so the damping does not brake the motion that is wanted."
    )
    at_a_policy: ClassVar = (
        "The arm follows closely where it used to trail by K_d / K_p ≈ 0.1 s, and jumps where commands jump."
    )
    to_record: ClassVar = "Steps, and a chirp at twice the commanded gain."
    near_twins: ClassVar = {
        "command_delay": "It takes off the lag what a delay adds to it; steps and twice the gain tell.",
        "kd": "In slow motion less damping trails less as well; after a step only K_d counts.",
    }
    share: float = parameter(
        unit="1",
        symbol="α",
        absent=0.0,
        low=0.0,
        high=1.5,
        typical=0.5,
        source="a choice; 1 in the MIT mode with speeds sent",
    )

    def drive(self) -> dict[str, float]:
        return {"feedforward": self.share}

    def memory(self, num_sims: int, pad_shape: tuple[int, int]) -> Memory:
        nan, none = np.full((num_sims, ROBOT.num_actions), np.nan), np.zeros((num_sims, len(ROBOT.action_names)))
        return {"target": nan, "speed": none, "lead_s": none.copy()}

    def feel(self, live: LiveModel, memory: Memory, ids: np.ndarray, dt_s: float) -> None:
        actuators = live.actuators(self.acts_on())
        kd, kp = -live.model.actuator_biasprm[actuators, 2], -live.model.actuator_biasprm[actuators, 1]
        memory["lead_s"][ids[:, None], self.columns] = self.share * kd / kp

    def command(self, targets: np.ndarray, memory: Memory, dt_s: np.ndarray) -> np.ndarray:
        last, speed = memory["target"], memory["speed"]
        last[:] = np.where(np.isnan(last), targets, last)  # after a reset: the target at rest
        sent = dt_s > 0
        speed[sent] = (targets - last)[sent] / dt_s[sent, None]
        last[sent] = targets[sent]
        targets = targets.copy()
        targets[:, self.columns] += (memory["lead_s"] * speed)[:, self.columns]
        return targets

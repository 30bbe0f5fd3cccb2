"""Slew limit: the drive moves its target no faster than so."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from taccorl.robots import ROBOT
from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import JointEffect, Memory, parameter


@effects.register("slew_limit")
@dataclass(kw_only=True)
class SlewLimit(JointEffect):
    """Speed limit of the commands: |ṙ| ≤ v_max, and the controller's target is r, which moves towards q* by at most v_max Δt
    until the next command.

    As in ``command_lag``, the controller gets the value of r at the end of that Δt: r_k = r_{k−1} + clip(q*_k − r_{k−1}, ± v_max
    Δt). The effect acts after ``command_lag`` and before ``velocity_feedforward`` and ``command_delay``.
    """

    name: ClassVar = "slew_limit"
    needs: ClassVar = ("target",)
    equation: ClassVar = "|ṙ| ≤ v_max; τ = K_p (r − q) − K_d q̇ + T_ref"
    in_words: ClassVar = (
        "A speed limit in the drive's firmware: faster commands are followed at that speed and no faster."
    )
    at_a_policy: ClassVar = "Fast moves arrive late, and tops of fast swings are cut off; gentle motion is as trained."
    to_record: ClassVar = "A chirp or steps that are faster than the limit, and the same at half the amplitude."
    near_twins: ClassVar = {
        "command_lag": "Both round corners; a lag does so at any size: the same motion at half the amplitude.",
        "torque_speed_limit": "Both cut fast motion; a torque-speed limit moves with the load: repeat with a payload.",
        "torque_saturation": "Both cut fast, large motion; a torque limit moves with the load: repeat with a payload.",
    }
    speed_rad_per_s: float = parameter(
        unit="rad/s",
        symbol="v_max",
        absent=math.inf,
        low=0.05,
        high=20.0,
        typical=0.5,
        source="a choice",
    )

    @classmethod
    def starts(cls, seen: Mapping[str, float]) -> list[dict[str, float]]:
        """Start values of a search, parameter → value each: 35 to 98 % of the largest commanded speed."""
        low, high = cls.parameters()[0].low, cls.parameters()[0].high
        return [
            {"speed_rad_per_s": min(max(s * seen["peak_speed_rad_per_s"], low), high)}
            for s in (0.35, 0.6, 0.8, 0.92, 0.98)
        ]

    def drive(self) -> dict[str, float]:
        return {"slew_rate": self.speed_rad_per_s}

    def memory(self, num_sims: int, pad_shape: tuple[int, int]) -> Memory:
        return {"target": np.full((num_sims, ROBOT.num_actions), np.nan)}

    def command(self, targets: np.ndarray, memory: Memory, dt_s: np.ndarray) -> np.ndarray:
        limited = memory["target"]
        limited[:] = np.where(np.isnan(limited), targets, limited)  # after a reset: the target at rest
        reach = (self.speed_rad_per_s * dt_s)[:, None]
        limited += np.clip(targets - limited, -reach, reach)
        targets = targets.copy()
        targets[:, self.columns] = limited[:, self.columns]
        return targets

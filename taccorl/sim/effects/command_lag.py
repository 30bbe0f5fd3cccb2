"""Command lag: the drive smooths its targets."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import CHANNELS, JointEffect, Memory, parameter
from taccorl.sim.robot import JOINTS


@effects.register("command_lag")
@dataclass(kw_only=True)
class CommandLag(JointEffect):
    """ṙ = (q* − r) / T, and the controller works on r: a low-pass in the driver. Slow motions look delayed by T.

    Solved exactly for targets that stand between two sendings, of which r has the value at the end.
    """

    name: ClassVar = "command_lag"
    possible: ClassVar = (*JOINTS, "gripper")
    time_constant_s: float = parameter(
        unit="s",
        symbol="T",
        absent=0.0,
        low=0.0,
        high=0.5,
        typical=0.05,
        source="a choice",
    )

    def memory(self, num_sims: int) -> Memory:
        return {"target": np.full((num_sims, len(CHANNELS)), np.nan)}

    def command(self, targets: np.ndarray, memory: Memory, dt_s: np.ndarray) -> np.ndarray:
        smooth = memory["target"]
        smooth[:] = np.where(np.isnan(smooth), targets, smooth)  # after a reset: the target at rest
        reached = -np.expm1(-dt_s / self.time_constant_s)
        smooth += (targets - smooth) * reached[:, None]
        targets = targets.copy()
        targets[:, self.columns] = smooth[:, self.columns]
        return targets

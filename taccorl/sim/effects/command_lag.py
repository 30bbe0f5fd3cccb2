"""Command lag: the drive smooths its targets."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from taccorl.robots import ROBOT
from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import JointEffect, Memory, parameter


@effects.register("command_lag")
@dataclass(kw_only=True)
class CommandLag(JointEffect):
    """Low-pass of the commands: ṙ = (q* − r) / T, and the controller's target is r. Slow motions look delayed by T.

    The equation is solved exactly for targets that are constant between two commands. The controller gets the value of r at the
    end of that interval.
    """

    name: ClassVar = "command_lag"
    needs: ClassVar = ("target",)
    equation: ClassVar = "ṙ = (q* − r) / T; τ = K_p (r − q) − K_d q̇ + T_ref"
    in_words: ClassVar = "The drive smooths its targets with a low-pass before it follows them."
    at_a_policy: ClassVar = "Corners of a path are cut, and a contact is felt long after the command that made it."
    to_record: ClassVar = (
        "Steps, and a chirp up to 3 Hz or more; pressing against a known spring shows that the joint itself is stiff."
    )
    near_twins: ClassVar = {
        "torque_lag": "Three poles either way while nobody knows the gains: state them, or the same motion at twice the gain.",
        "sensor_delay": "Slow motion is late by the same time in both; steps tell: a delay stands still, a lag begins at once.",
        "command_delay": (
            "Slow motion is late by the same time in both; steps tell: a delay stands still, a lag begins at once."
        ),
        "slew_limit": "Both round corners; a lag does so at any size: the same motion at half the amplitude.",
        "joint_compliance": "A small phase in either; a small, fast chirp shows the resonance of a spring.",
        "kp": "Soft gains with much K_d lag like this in free motion; a held load tells stiffness from smoothing.",
    }
    possible: ClassVar = (*ROBOT.joints, "gripper")
    time_constant_s: float = parameter(
        unit="s",
        symbol="T",
        absent=0.0,
        low=0.0,
        high=0.5,
        typical=0.05,
        source="a choice",
    )

    def drive(self) -> dict[str, float]:
        return {"command_lag": self.time_constant_s}

    def memory(self, num_sims: int, pad_shape: tuple[int, int]) -> Memory:
        return {"target": np.full((num_sims, ROBOT.num_actions), np.nan)}

    def command(self, targets: np.ndarray, memory: Memory, dt_s: np.ndarray) -> np.ndarray:
        smooth = memory["target"]
        smooth[:] = np.where(np.isnan(smooth), targets, smooth)  # after a reset: the target at rest
        reached = -np.expm1(-dt_s / self.time_constant_s)
        smooth += (targets - smooth) * reached[:, None]
        targets = targets.copy()
        targets[:, self.columns] = smooth[:, self.columns]
        return targets

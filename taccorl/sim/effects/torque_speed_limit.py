"""Torque-speed limit: the faster a motor turns, the less torque its supply voltage can drive."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import mujoco
import numpy as np

from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import JointEffect, Memory, parameter
from taccorl.sim.effects.live_model import LiveModel

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig


@effects.register("torque_speed_limit")
@dataclass(kw_only=True)
class TorqueSpeedLimit(JointEffect):
    """Torque limit that depends on the speed: |τ| ≤ τ_s [1 − |q̇| / v₀]₊ where the motor drives (τ q̇ > 0), |τ| ≤ τ_s where it
    brakes or stands.

    A motor at supply voltage U with winding resistance R and torque constant k_t has at most τ = k_t (U − k_t q̇) / R: the
    torque-speed line of a DC motor's datasheet, from the stall torque τ_s = k_t U / R to the no-load speed v₀ = U / k_t. When
    the motor brakes, the back-EMF adds to the supply, and the drive's current limit applies; it is assumed to be at τ_s, as in
    Isaac Lab's ``DCMotor``. τ is the sum of the controller's torque and the gravity compensation; τ_s and v₀ are values at the
    joint, after the gear. The speed is that at the end of each physics step, for the next step. While the limit is reached, K_d
    does not damp the motion.
    """

    name: ClassVar = "torque_speed_limit"
    needs: ClassVar = ("effort", "velocity")
    equation: ClassVar = "|τ_motor| ≤ τ_s (1 − |q̇| / v₀) where it drives, ≤ τ_s where it brakes"
    in_words: ClassVar = (
        "The supply voltage is limited: a motor that turns fast induces a voltage of its own, and what remains drives less "
        "current. At the no-load speed no torque is left."
    )
    at_a_policy: ClassVar = "Fast moves reach their top speed late, sooner with a heavy part; slow ones are as trained."
    to_record: ClassVar = "Steps and chirps near the highest speed, once with a known payload."
    near_twins: ClassVar = {
        "torque_saturation": (
            "At one speed both are a limit of the torque; large steps from rest and fast sweeps together tell them apart."
        ),
        "slew_limit": "Both cut fast motion; a torque-speed limit moves with the load: repeat with a payload.",
    }
    equals_when_wide: ClassVar = {"torque_saturation": "no_load_rad_per_s"}
    rewrites: ClassVar = ("jnt_actfrcrange",)
    stall_nm: float = parameter(
        unit="N·m",
        symbol="τ_s",
        over="kp",
        absent=math.inf,
        low=0.05,
        high=200.0,
        typical=8.0,
        source="as torque_saturation",
    )
    no_load_rad_per_s: float = parameter(
        unit="rad/s",
        symbol="v₀",
        absent=None,
        low=0.1,
        high=50.0,
        typical=4.0,
        source="180–225 °/s are the joints' highest speeds (PiPER manual)",
    )

    @classmethod
    def starts(cls, seen: Mapping[str, float]) -> list[dict[str, float]]:
        """Start values of a search, parameter → value each: stall torques near the largest commanded torque, no-load speeds
        near the largest commanded speed.
        """
        stall, speed = cls.parameters()
        peak_nm, fastest = seen.get("peak_motor_nm", seen["peak_torque_nm"]), seen["peak_speed_rad_per_s"]
        return [
            {
                stall.name: float(np.clip(share * peak_nm, stall.low, stall.high)),
                speed.name: float(np.clip(times * fastest, speed.low, speed.high)),
            }
            for share, times in ((0.7, 2.0), (1.3, 1.3), (3.0, 1.1), (1.3, 0.85))
        ]

    def drive(self) -> dict[str, float]:
        return {"stall_torque": self.stall_nm, "no_load_speed": self.no_load_rad_per_s}

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for joint in self.chosen(spec):
            most_nm = self.stall_nm
            if joint.actfrclimited == mujoco.mjtLimited.mjLIMITED_TRUE:  # torque_saturation came first
                most_nm = min(most_nm, joint.actfrcrange[1])
            joint.actgravcomp, joint.actfrclimited = True, True
            joint.actfrcrange = [-most_nm, most_nm]

    def memory(self, num_sims: int, pad_shape: tuple[int, int]) -> Memory:
        return {"speed_rad_per_s": np.zeros((num_sims, len(self.acts_on())))}

    def feel(self, live: LiveModel, memory: Memory, ids: np.ndarray, dt_s: float) -> None:
        memory["speed_rad_per_s"][ids] = live.seen("qvel")[:, live.dofs(self.acts_on())][ids]

    def rewrite(self, live: LiveModel, memory: Memory) -> None:
        speed, span = memory["speed_rad_per_s"], live.own("jnt_actfrcrange")
        joints = live.model.dof_jntid[live.dofs(self.acts_on())]
        driving_nm = self.stall_nm * np.maximum(1.0 - np.abs(speed) / self.no_load_rad_per_s, 0.0)
        least, most = span[:, joints, 0], span[:, joints, 1]
        span[:, joints, 0] = np.maximum(least, -np.where(speed < 0, driving_nm, self.stall_nm))
        span[:, joints, 1] = np.minimum(most, np.where(speed > 0, driving_nm, self.stall_nm))

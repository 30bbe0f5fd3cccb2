"""Torque saturation: the drive gives no more than so much."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import mujoco

from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import JointEffect, parameter

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig


@effects.register("torque_saturation")
@dataclass(kw_only=True)
class TorqueSaturation(JointEffect):
    """Limit of the motor's torque: |τ| ≤ τ_max, where τ is the sum of the controller's torque and the gravity compensation.

    Implemented by MuJoCo's ``actuatorfrcrange`` with ``actuatorgravcomp``, a limit at the joint. While the limit is reached, K_d
    does not damp the motion.
    """

    name: ClassVar = "torque_saturation"
    needs: ClassVar = ("effort",)
    equation: ClassVar = "|τ_motor| ≤ τ_max"
    in_words: ClassVar = (
        "The drive's current is limited: beyond a torque nothing more comes, whatever the controller asks for."
    )
    at_a_policy: ClassVar = "Fast motions and heavy parts are late and low, while everything gentle is as trained."
    to_record: ClassVar = "Steps that are large enough to reach the limit; a gentle chirp does not show it."
    near_twins: ClassVar = {
        "torque_scale": (
            "At the peaks both give less; a limit leaves small motion alone: the same chirp at half the amplitude."
        ),
        "torque_speed_limit": (
            "At one speed both are a limit of the torque; large steps from rest and fast sweeps together tell them apart."
        ),
        "slew_limit": "Both cut fast, large motion; a torque limit moves with the load: repeat with a payload.",
    }
    torque_max_nm: float = parameter(
        unit="N·m",
        symbol="τ_max",
        absent=math.inf,
        low=0.05,
        high=200.0,
        typical=8.0,
        over="kp",
        source="torque range of the MIT mode, ±8 N·m by default (piper_sdk issues 73, 91 and 99)",
    )

    @classmethod
    def starts(cls, seen: Mapping[str, float]) -> list[dict[str, float]]:
        """Start values of a search, parameter → value each: 55 to 97 % of the largest commanded torque."""
        limit = cls.parameters()[0]
        peak_nm = seen.get("peak_motor_nm", seen["peak_torque_nm"])
        shares = (0.55, 0.75, 0.88, 0.97)
        return [{limit.name: min(max(s * peak_nm, limit.low), limit.high)} for s in shares]

    def drive(self) -> dict[str, float]:
        return {"torque_max": self.torque_max_nm}

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for joint in self.chosen(spec):
            joint.actgravcomp, joint.actfrclimited = True, True
            joint.actfrcrange = [-self.torque_max_nm, self.torque_max_nm]

"""Cable spring: hoses and cables pull a joint towards where they are relaxed."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import mujoco

from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import JointEffect, parameter

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig


@effects.register("cable_spring")
@dataclass(kw_only=True)
class CableSpring(JointEffect):
    """Spring of cables at a joint: τ = −k (q − q₀), relaxed at q₀. At rest the joint deviates from its target by k (q₀ − q) /
    K_p, which grows with the distance from q₀. Implemented as MuJoCo's joint spring."""

    name: ClassVar = "cable_spring"
    needs: ClassVar = ("position",)
    equation: ClassVar = "τ = −k (q − q₀)"
    in_words: ClassVar = (
        "Cables and hoses along the arm bend with the joint and pull it back to where they are relaxed."
    )
    at_a_policy: ClassVar = "Targets far from the middle of the range are not quite reached, always on the same side."
    to_record: ClassVar = "A slow triangle over the whole range of a joint that weight does not load, at two gains."
    near_twins: ClassVar = {
        "gravity_mismatch": (
            "Over a small range both are a slope in the angle; turn the base, which weight does not load."
        ),
        "end_stop": (
            "A soft stop is a spring that begins at an angle: sweep slowly over the whole range, the slope of the error must "
            "have a kink."
        ),
        "kp": "At one gain the spring only makes the loop softer by k / K_p; twice the gain halves that.",
        "unbalance": (
            "Over a small range both are a slope in the angle; sweep half a turn, over which a weight bends back, or record "
            "another pose of the other joints, which changes a weight and not a spring."
        ),
        "torque_ff": "With k small, k q₀ is a constant torque; the slope about it needs a wide range.",
    }
    stiffness_nm_per_rad: float = parameter(
        unit="N·m/rad",
        symbol="k",
        absent=0.0,
        low=0.0,
        high=50.0,
        typical=1.0,
        over="kp",
        source="a choice",
    )
    rest_rad: float = parameter(
        unit="rad",
        symbol="q₀",
        absent=None,
        low=-3.2,
        high=3.2,
        typical=0.0,
        source="a choice: cables are laid with the arm straight",
    )

    @classmethod
    def starts(cls, seen: Mapping[str, float]) -> list[dict[str, float]]:
        """Start values of a search, parameter → value each: a weak and a strong spring, each relaxed at either end of the
        range. Recordings determine k and k q₀.
        """
        return [
            {"stiffness_nm_per_rad": k, "rest_rad": rest}
            for k, rest in ((1 / 3, 0.0), (3.0, 0.0), (1.0, -1.0), (1.0, 1.0))
        ]

    def drive(self) -> dict[str, float]:
        return {"spring_stiffness": self.stiffness_nm_per_rad, "spring_rest": self.rest_rad}

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for joint in self.chosen(spec):
            joint.stiffness[0], joint.springref = self.stiffness_nm_per_rad, self.rest_rad

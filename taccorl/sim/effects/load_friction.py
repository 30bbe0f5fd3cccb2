"""Load-dependent friction: dry friction that grows with the torque that the gear passes on."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import mujoco
import numpy as np

from taccorl.sim.effects import effects
from taccorl.sim.effects.dry_friction import add_dry_friction
from taccorl.sim.effects.effect import JointEffect, Memory, parameter
from taccorl.sim.effects.live_model import LiveModel

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig


@effects.register("load_friction")
@dataclass(kw_only=True)
class LoadFriction(JointEffect):
    """Dry friction in proportion to the load of the gear: τ = −μ |τ_motor − τ_load| sign q̇; at rest |τ| ≤ μ |τ_motor − τ_load|.

    τ_motor is the torque of the drive, gravity compensation included. τ_load is the torque of the load on the joint: its weight
    (and Coriolis forces) pull with τ_load = −g(q), where +g(q) is the torque that holds it. So |τ_motor − τ_load| = |τ_motor +
    g(q)|: twice the weight's torque in a joint that holds it (Rhoban BAM, ICRA 2025, their model M2). Both torques are
    determined at the end of each physics step, for the next step.
    """

    name: ClassVar = "load_friction"
    needs: ClassVar = ("velocity", "load")
    equation: ClassVar = "|τ| ≤ μ |τ_motor − τ_load|, against the motion"
    in_words: ClassVar = (
        "Teeth that are pressed together rub more: friction grows with the torque that goes through the gear."
    )
    at_a_policy: ClassVar = (
        "Stretched out, or with a part in the hand, the arm stops shorter of its targets than elsewhere."
    )
    to_record: ClassVar = "A wide, slow triangle, once with a known payload: friction must follow the load."
    near_twins: ClassVar = {
        "coulomb_friction": (
            "Alike while the load is the same; move slowly where the arm reaches out and where it hangs."
        ),
        "position_dependent_friction": (
            "Where weight grows with the angle both follow it; repeat the slow sweep with a payload, which moves the load only."
        ),
    }
    rewrites: ClassVar = ("dof_frictionloss",)
    share: float = parameter(
        unit="1",
        symbol="μ",
        absent=0.0,
        low=0.0,
        high=0.5,
        typical=0.1,
        source="a choice; hobby servos need such a term (Duclusaud et al., ICRA 2025; their Dynamixel XL330 logs, Rhoban/bam)",
    )

    def drive(self) -> dict[str, float]:
        return {"load_friction": self.share}

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for joint in self.chosen(spec):
            add_dry_friction(joint, 0.0)

    def memory(self, num_sims: int, pad_shape: tuple[int, int]) -> Memory:
        return {"passed_nm": np.zeros((num_sims, len(self.acts_on())))}

    def feel(self, live: LiveModel, memory: Memory, ids: np.ndarray, dt_s: float) -> None:
        dofs = live.dofs(self.acts_on())
        motor_nm = live.motor_torque_nm(self.acts_on())
        memory["passed_nm"][ids] = np.abs(motor_nm + live.seen("qfrc_bias")[:, dofs])[ids]

    def rewrite(self, live: LiveModel, memory: Memory) -> None:
        live.own("dof_frictionloss")[:, live.dofs(self.acts_on())] += self.share * memory["passed_nm"]

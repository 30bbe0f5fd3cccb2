"""Torque scale: the drive gives a multiple of the torque that it is asked for."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import mujoco
import numpy as np

from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import JointEffect, Memory, parameter
from taccorl.sim.effects.live_model import LiveModel

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig


@effects.register("torque_scale")
@dataclass(kw_only=True)
class TorqueScale(JointEffect):
    """Scale of the motor's torque: τ_motor = g (K_p (q* − q) − K_d q̇ + T_ref + c g_w(q)). The factor g acts on the controller's
    torque and on the gravity compensation c g_w(q).

    Efforts are the scaled torques: g times the requested ones.
    """

    name: ClassVar = "torque_scale"
    needs: ClassVar = ("effort",)
    equation: ClassVar = "τ_motor = g (K_p (q* − q) − K_d q̇ + T_ref + τ_comp)"
    in_words: ClassVar = (
        "The drive's torque constant or its firmware's unit is wrong: it gives g times what it is asked for."
    )
    at_a_policy: ClassVar = (
        "The arm is stiffer or softer in contact than trained for, and sags or rises where it reaches out."
    )
    to_record: ClassVar = (
        "A known payload, or efforts that are trusted; and the same chirp with and without the payload."
    )
    near_twins: ClassVar = {
        "kp": "With K_p, K_d and T_ref free it is all of them times g, but for the weight: hold a known payload.",
        "armature": (
            "Without efforts, more inertia is less torque for all of it; weight tells: move slowly between poses, or "
            "load the hand."
        ),
        "gravity_mismatch": "A weak drive carries less as well; it also follows fast motion worse: chirp and efforts.",
        "torque_saturation": (
            "At the peaks both give less; a limit leaves small motion alone: the same chirp at half the amplitude."
        ),
        "direction_gain": "Where all torques have one sign both are a factor; motion in which they change sign separates them.",
        "torque_fade": "After a while both give less; repeat the recording at the end of the session.",
        "encoder_scale": (
            "Seen through a scaled encoder weight and inertia look smaller; a camera or a known angle tells."
        ),
    }
    rewrites: ClassVar = ("qfrc_applied",)
    factor: float = parameter(
        unit="1",
        symbol="g",
        absent=1.0,
        low=0.2,
        high=5.0,
        typical=0.8,
        source="a choice; one firmware of this arm gives 4 times the torque (piper_sdk issue 73)",
    )

    def drive(self) -> dict[str, float]:
        return {"torque_scale": self.factor}

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for name in self.acts_on():
            actuator = spec.actuator(name)
            actuator.gainprm[0] *= self.factor
            actuator.biasprm[:3] *= self.factor

    def memory(self, num_sims: int, pad_shape: tuple[int, int]) -> Memory:
        return {"carried_nm": np.zeros((num_sims, len(self.acts_on())))}

    def feel(self, live: LiveModel, memory: Memory, ids: np.ndarray, dt_s: float) -> None:
        memory["carried_nm"][ids] = live.seen("qfrc_gravcomp")[:, live.dofs(self.acts_on())][ids]

    def rewrite(self, live: LiveModel, memory: Memory) -> None:
        live.scale_carried(self.acts_on(), memory["carried_nm"], self.factor)

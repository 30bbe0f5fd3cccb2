"""Torque fade: a motor that gets warm gives less and less torque."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import JointEffect, Memory, parameter
from taccorl.sim.effects.live_model import LiveModel


@effects.register("torque_fade")
@dataclass(kw_only=True)
class TorqueFade(JointEffect):
    """Loss of torque over time: τ_motor = [1 − t / T_f]₊ (K_p (q* − q) − K_d q̇ + T_ref + c g(q)), with the time t since the
    reset and the rate 1 / T_f.

    The factor acts on the controller's torque and on the gravity compensation. Efforts are the reduced torques.
    """

    name: ClassVar = "torque_fade"
    needs: ClassVar = ("effort",)
    equation: ClassVar = "τ_motor = [1 − R t]₊ (K_p (q* − q) − K_d q̇ + T_ref + τ_comp)"
    in_words: ClassVar = (
        "Warm magnets are weaker and warm windings take less current: the same command gives less torque with time."
    )
    at_a_policy: ClassVar = "What worked on the first episode of the day sags and lags on the twentieth."
    to_record: ClassVar = "The same motion at the beginning and at the end of a minute or more of hard work."
    near_twins: ClassVar = {
        "torque_scale": "After a while both give less; repeat the recording at the end of the session.",
    }
    rewrites: ClassVar = ("actuator_gainprm", "actuator_biasprm", "qfrc_applied")
    rate_per_min: float = parameter(
        unit="1/min",
        symbol="R",
        absent=0.0,
        low=0.0,
        high=3.0,
        typical=0.3,
        source="a choice",
    )

    def drive(self) -> dict[str, float]:
        return {"fade_rate": self.rate_per_min / 60}

    def memory(self, num_sims: int, pad_shape: tuple[int, int]) -> Memory:
        return {"carried_nm": np.zeros((num_sims, len(self.acts_on())))}

    def feel(self, live: LiveModel, memory: Memory, ids: np.ndarray, dt_s: float) -> None:
        memory["carried_nm"][ids] = live.seen("qfrc_gravcomp")[:, live.dofs(self.acts_on())][ids]

    def rewrite(self, live: LiveModel, memory: Memory) -> None:
        left = np.maximum(1.0 - self.rate_per_min / 60 * live.seen("time"), 0.0).reshape(-1, 1)
        actuators = live.actuators(self.acts_on())
        live.own("actuator_gainprm")[:, actuators] *= left[..., None]
        live.own("actuator_biasprm")[:, actuators] *= left[..., None]
        live.scale_carried(self.acts_on(), memory["carried_nm"], left)

"""Integral action: the controller integrates its error until it vanishes."""

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

_POSITION = 1  # mjINPUT_POS of mjtype.h, for which Python has no name


@effects.register("integral_action")
@dataclass(kw_only=True)
class IntegralAction(JointEffect):
    """Integral part of the controller: τ = K_p (q* − q) + K_p r I − K_d q̇ + T_ref with İ = q* − q. A joint at rest beside its
    target moves to it at rate r.

    At the start of an episode or a replay, I has the value that holds the joint where it is. A physics step applies I_n and
    computes I_{n+1} = I_n + h (q*_n − q_n). Implemented as MuJoCo's PID actuator. An encoder's bias on the same joint is not
    integrated. In a velocity loop, which an axis or robot file may have, τ = K_d (q̇* − q̇ + r I) with İ = q̇* − q̇.
    """

    name: ClassVar = "integral_action"
    needs: ClassVar = ("target", "position")
    equation: ClassVar = (
        "τ = K_p (e + r ∫ e dt) − K_d q̇ + T_ref, e = q* − q; of a velocity loop K_d (e + r ∫ e dt) + T_ref, e = q̇* − q̇"
    )
    in_words: ClassVar = (
        "The drive's I-gain is on: what friction and weight leave of an error is worked off in a second or so."
    )
    at_a_policy: ClassVar = (
        "Offsets that it learnt to correct for vanish by themselves, moves overshoot, and pressing grows with time."
    )
    to_record: ClassVar = "Steps with holds of some seconds: the error creeps to nothing in each."
    near_twins: ClassVar = {
        "torque_ff": "Both take a constant error away; an integral does so within each hold: steps with long holds.",
        "kp": "In slow motion an integral looks like a stiffer loop; steps with long holds tell.",
    }
    rate_per_s: float = parameter(
        unit="1/s",
        symbol="r",
        absent=0.0,
        low=0.0,
        high=50.0,
        typical=0.5,
        source="a choice: K_i / K_p; position loops have up to 5, velocity loops 10 and more",
    )

    @classmethod
    def starts(cls, seen: Mapping[str, float]) -> list[dict[str, float]]:
        """Start values of a search, parameter → value each: rates of slow position loops, and those of velocity loops."""
        return [*super().starts(seen), {"rate_per_s": 6.0}, {"rate_per_s": 25.0}]

    def drive(self) -> dict[str, float]:
        return {"integral_rate": self.rate_per_s}

    def feel(self, live: LiveModel, memory: Memory, ids: np.ndarray, dt_s: float) -> None:
        if dt_s == 0:  # at rest for ever: the integral has balanced what acts on the joint
            motors, dofs = live.actuators(self.acts_on()), live.dofs(self.acts_on())
            lever = live.model.actuator_gear[motors, 0] * live.model.actuator_gainprm[motors, 0]
            left_nm = live.seen("qfrc_smooth")[np.ix_(ids, dofs)]
            live.seen("act")[np.ix_(ids, live.integrals(self.acts_on()))] -= left_nm / lever

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for name in self.acts_on():
            actuator = spec.actuator(name)
            kp, bias = actuator.gainprm[0], actuator.biasprm.copy()
            actuator.set_to_pid(kp=kp, kv=-bias[2], ki=kp * self.rate_per_s, ctrlspec=_POSITION)
            scale = -bias[1] / kp  # of an encoder: what this actuator sees and integrates is scale · q
            actuator.gear[0] *= scale
            actuator.gainprm[0] /= scale
            actuator.biasprm[:3] = [bias[0] / scale, -kp / scale, bias[2] / scale**2]

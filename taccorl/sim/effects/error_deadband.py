"""Error dead band: small position errors are left alone by the controller."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import JointEffect, Memory, parameter
from taccorl.sim.effects.live_model import LiveModel

_LEFT = 1e-6  # of K_p within the band: the command that has arrived, delays included, is read off MuJoCo's force


@effects.register("error_deadband")
@dataclass(kw_only=True)
class ErrorDeadband(JointEffect):
    """Dead band of the position error: τ = K_p d(q* − q) − K_d q̇ + T_ref with d(e) = e − w sign e beyond ± w, and 0 within.

    Whether the error is in the band is determined at the end of each physics step, for the next step. The error is that of the
    joint's angle times an encoder's scale; an encoder's bias and an integral are not subject to the dead band.
    """

    name: ClassVar = "error_deadband"
    needs: ClassVar = ("target", "position")
    equation: ClassVar = "τ = K_p d(e) − K_d q̇ + T_ref; d(e) = 0 where |e| ≤ w, else e − w sign e"
    in_words: ClassVar = (
        "The drive's firmware ignores small errors, so that it does not hum at rest: nothing holds the joint within ±"
        " w."
    )
    at_a_policy: ClassVar = "Corrections smaller than w do nothing, and the arm gives way by w before it resists."
    to_record: ClassVar = "Small chirps and slow triangles, once with weight on the joint and once without."
    near_twins: ClassVar = {
        "coulomb_friction": (
            "Both stop short of the target; a dead band gives way to a push, friction holds: efforts, or twice the "
            "gain."
        ),
        "backlash": (
            "Both let the joint hang within a band; weight moves it there under the encoder's eyes only with a dead "
            "band."
        ),
    }
    rewrites: ClassVar = ("actuator_gainprm", "actuator_biasprm")
    width_rad: float = parameter(
        unit="rad",
        symbol="w",
        absent=0.0,
        low=0.0,
        high=0.1,
        typical=0.005,
        source="a choice",
    )

    def drive(self) -> dict[str, float]:
        return {"deadband": self.width_rad}

    def memory(self, num_sims: int, pad_shape: tuple[int, int]) -> Memory:
        return {"error_rad": np.zeros((num_sims, len(self.acts_on())))}

    def feel(self, live: LiveModel, memory: Memory, ids: np.ndarray, dt_s: float) -> None:
        memory["error_rad"][ids] = live.error_rad(self.acts_on())[ids]

    def rewrite(self, live: LiveModel, memory: Memory) -> None:
        error, motors = memory["error_rad"], live.actuators(self.acts_on())
        gain, bias = live.own("actuator_gainprm"), live.own("actuator_biasprm")
        inside = np.abs(error) <= self.width_rad
        stiffness = -bias[:, motors, 1]
        bias[:, motors, 0] -= np.where(inside, 0.0, stiffness * self.width_rad * np.sign(error))
        bias[:, motors, 1] *= np.where(inside, _LEFT, 1.0)
        gain[:, motors, 0] *= np.where(inside & ~live.integrates(self.acts_on()), _LEFT, 1.0)

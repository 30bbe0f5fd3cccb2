"""Torque lag: the motor's torque follows what the controller asks for with a time constant."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import JointEffect, Memory, parameter
from taccorl.sim.effects.live_model import LiveModel


@effects.register("torque_lag")
@dataclass(kw_only=True)
class TorqueLag(JointEffect):
    """Lag of the motor's torque: T τ̇ = u − τ with the controller's output u = K_p (q* − q) − K_d q̇ + T_ref. The gravity
    compensation does not lag.

    Backward Euler, so that the effect vanishes with T: with β = h / (h + T) a physics step applies τ_{n+1} = β u_{n+1} + (1 − β)
    τ_n, where MuJoCo evaluates u_{n+1} at the end of the step as it does without lag: the actuator's gains are β K_p, β K_d, and
    its bias is β T_ref + (1 − β) τ_n. At the start of an episode or a replay τ = u.
    """

    name: ClassVar = "torque_lag"
    needs: ClassVar = ("effort",)
    equation: ClassVar = "T τ̇ = u − τ, u = K_p (q* − q) − K_d q̇ + T_ref"
    in_words: ClassVar = (
        "Current builds up slowly in the motor's winding, or the drive filters it: torque is a few milliseconds late."
    )
    at_a_policy: ClassVar = "Stiff joints ring after a jerk or a contact; slow motion is as trained."
    to_record: ClassVar = "A small chirp beyond 5 Hz and small steps, at twice the commanded gain."
    near_twins: ClassVar = {
        "command_lag": "Three poles either way while nobody knows the gains: state them, or the same motion at twice the gain.",
        "command_delay": "A small phase in either; the one within the loop grows with the gains: record at twice the gain.",
        "sensor_delay": "A small phase in either; the one within the loop grows with the gains: record at twice the gain.",
        "joint_compliance": (
            "A small phase within the loop in both; only a spring resonates: small chirp beyond 5 Hz at twice the gain."
        ),
    }
    rewrites: ClassVar = ("actuator_gainprm", "actuator_biasprm")
    time_constant_s: float = parameter(
        unit="s",
        symbol="T",
        absent=0.0,
        low=0.0,
        high=0.1,
        typical=0.005,
        source="a choice: a winding's L / R and the drive's filters",
    )

    def drive(self) -> dict[str, float]:
        return {"torque_lag": self.time_constant_s}

    def memory(self, num_sims: int, pad_shape: tuple[int, int]) -> Memory:
        shape = (num_sims, len(self.acts_on()))
        return {
            "torque_nm": np.zeros(shape),
            "new_share": np.ones(shape),
        }  # without lag until it is known what it begins with

    def feel(self, live: LiveModel, memory: Memory, ids: np.ndarray, dt_s: float) -> None:
        torque, pid = live.seen("actuator_force")[:, live.actuators(self.acts_on())], live.integrates(self.acts_on())
        if dt_s == 0:  # an integral balances the joint at rest
            torque[:, pid] -= live.seen("qfrc_smooth")[:, live.dofs(self.acts_on())[pid]]
        step_s = live.model.opt.timestep
        memory["torque_nm"][ids], memory["new_share"][ids] = torque[ids], step_s / (step_s + self.time_constant_s)

    def rewrite(self, live: LiveModel, memory: Memory) -> None:
        motors, share = live.actuators(self.acts_on()), memory["new_share"]
        live.own("actuator_gainprm")[:, motors] *= share[..., None]
        live.own("actuator_biasprm")[:, motors] *= share[..., None]
        live.own("actuator_biasprm")[:, motors, 0] += (1 - share) * memory["torque_nm"]

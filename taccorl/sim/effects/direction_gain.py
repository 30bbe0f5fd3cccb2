"""Direction gain: the drive gives more one way than the other, as a cylinder whose rod takes up a part of one side's area."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import JointEffect, Memory, parameter
from taccorl.sim.effects.live_model import LiveModel


@effects.register("direction_gain")
@dataclass(kw_only=True)
class DirectionGain(JointEffect):
    """Gain of the drive that differs with the direction: where the motor's torque τ, gravity compensation included, is negative,
    it is g τ. A drive that commands a speed (laws ``cascade`` and ``velocity`` of axis and robot files) has g q̇* where the
    commanded speed q̇* is negative, and its torque is not scaled.

    Of a cylinder with one rod g is a ratio of areas: pressure on the rod's side gives less force, and the same flow more speed.
    Efforts are the scaled torques. Whether the torque is negative is determined at the end of each physics step, for the next
    step.
    """

    name: ClassVar = "direction_gain"
    needs: ClassVar = ("effort",)
    equation: ClassVar = "τ_motor = g τ where τ < 0, else τ; of a drive that commands a speed q̇*: g q̇* where q̇* < 0"
    in_words: ClassVar = (
        "A cylinder has less area on the side of its rod: the same valve opening gives another force, or another speed, "
        "each way."
    )
    at_a_policy: ClassVar = (
        "The arm trails its targets by different amounts on the two ways, and presses harder one way."
    )
    to_record: ClassVar = "The same moves in both directions, at two amplitudes and two speeds; with efforts."
    near_twins: ClassVar = {
        "asymmetric_friction": (
            "At one amplitude both differ by direction alike; twice the speed, or twice the load, doubles this one only."
        ),
        "torque_ff": "At one amplitude a constant torque differs by direction as well; half of the amplitude tells.",
        "torque_scale": "Where all torques have one sign both are a factor; motion in which they change sign separates them.",
    }
    rewrites: ClassVar = ("actuator_gainprm", "actuator_biasprm", "qfrc_applied")
    factor: float = parameter(
        unit="1",
        symbol="g",
        absent=1.0,
        low=0.2,
        high=5.0,
        typical=0.7,
        source="a choice: areas of cylinders with one rod differ by a factor of 1.2 to 2",
    )

    def drive(self) -> dict[str, float]:
        return {"reverse_gain": self.factor}

    def memory(self, num_sims: int, pad_shape: tuple[int, int]) -> Memory:
        shape = (num_sims, len(self.acts_on()))
        return {"carried_nm": np.zeros(shape), "motor_nm": np.zeros(shape)}

    def feel(self, live: LiveModel, memory: Memory, ids: np.ndarray, dt_s: float) -> None:
        memory["carried_nm"][ids] = live.seen("qfrc_gravcomp")[:, live.dofs(self.acts_on())][ids]
        memory["motor_nm"][ids] = live.motor_torque_nm(self.acts_on())[ids]

    def rewrite(self, live: LiveModel, memory: Memory) -> None:
        gain = np.where(memory["motor_nm"] < 0.0, self.factor, 1.0)
        motors = live.actuators(self.acts_on())
        live.own("actuator_gainprm")[:, motors] *= gain[..., None]
        live.own("actuator_biasprm")[:, motors] *= gain[..., None]
        live.scale_carried(self.acts_on(), memory["carried_nm"], gain)

"""End stop: something stiff in the way, inside the range that the joint is expected to have."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import JointEffect, Memory, parameter
from taccorl.sim.effects.live_model import LiveModel

DAMPING_S = 0.005
"""Damping over stiffness [s]: a choice. The drive's own K_d damps motion against the stop far more."""


@effects.register("end_stop")
@dataclass(kw_only=True)
class EndStop(JointEffect):
    """Mechanical stop at the angle q_e: τ = ∓[k δ + b δ̇]₊ with δ = ±(q − q_e) beyond the stop, b = k · 5 ms. It pushes and
    never pulls.

    A spring-damper contact (Kelvin-Voigt, as in Gilardi and Sharf, "Literature survey of contact dynamics modelling", 2002) on
    one side: the joint is free on the side of q_e on which it is at the reset. q is the motor's angle. Whether the joint touches
    the stop is determined at the end of each physics step, for the next step.
    """

    name: ClassVar = "end_stop"
    needs: ClassVar = ("position", "velocity")
    equation: ClassVar = "τ = −s [k δ + b δ̇]₊, δ = s (q − q_e) > 0, s = sign(q_e − q at the start), b = k · 5 ms"
    in_words: ClassVar = (
        "A mechanical stop, a short cable or a cover that is in the way: at one angle the joint runs against it."
    )
    at_a_policy: ClassVar = (
        "Targets beyond the stop are not reached, and the arm presses against it until the drive gets hot."
    )
    to_record: ClassVar = (
        "Slow motion over the whole range, with a hold near its ends: the measured angle ends, the command goes on."
    )
    near_twins: ClassVar = {
        "cable_spring": (
            "A soft stop is a spring that begins at an angle: sweep slowly over the whole range, the slope of the error must "
            "have a kink."
        ),
    }
    rewrites: ClassVar = ("jnt_stiffness", "qpos_spring", "dof_damping")
    stiffness_nm_per_rad: float = parameter(
        unit="N·m/rad",
        symbol="k",
        over="kp",
        absent=0.0,
        low=0.0,
        high=1e5,
        typical=1e3,
        source="a choice: a plastic cover; of steel it is as stiff as the arm, above 1e4",
    )
    angle_rad: float = parameter(
        unit="rad",
        symbol="q_e",
        absent=None,
        low=-4.0,
        high=4.0,
        typical=0.55,
        source="a choice; a search takes it from the range that was recorded",
    )

    @classmethod
    def starts(cls, seen: Mapping[str, float]) -> list[dict[str, float]]:
        """Start values of a search, parameter → value each: stops at and within either end of the recorded range; stiff ones
        yield by 2 %, soft ones by 20 % of the range under the greatest torque.
        """
        stiffness, angle = cls.parameters()
        span = max(seen["span_rad"], 0.02)
        low = seen.get("lowest_rad", -0.5 * span)
        high = seen.get("highest_rad", low + span)
        reach = max(high - low, 1e-3)
        torque_nm = max(seen["peak_torque_nm"], 0.01)
        return [
            {
                stiffness.name: float(np.clip(torque_nm / (gives * reach), 1.0, stiffness.high)),
                angle.name: float(np.clip(place, angle.low, angle.high)),
            }
            for inside, gives in ((0.02, 0.02), (0.1, 0.1), (0.3, 0.2))
            for place in (low + inside * reach, high - inside * reach)
        ]

    def drive(self) -> dict[str, float]:
        return {"stop_stiffness": self.stiffness_nm_per_rad, "stop_angle": self.angle_rad}

    def memory(self, num_sims: int, pad_shape: tuple[int, int]) -> Memory:
        shape = (num_sims, len(self.acts_on()))
        return {"side": np.ones(shape), "touches": np.zeros(shape)}

    def feel(self, live: LiveModel, memory: Memory, ids: np.ndarray, dt_s: float) -> None:
        angle = live.seen("qpos")[:, live.angles(self.acts_on())][ids]
        if dt_s == 0:
            memory["side"][ids] = np.where(angle <= self.angle_rad, 1.0, -1.0)
        side = memory["side"][ids]
        deep = side * (angle - self.angle_rad)
        rate = side * live.seen("qvel")[:, live.dofs(self.acts_on())][ids]
        memory["touches"][ids] = (deep > 0) & (deep + DAMPING_S * rate > 0)

    def rewrite(self, live: LiveModel, memory: Memory) -> None:
        dofs, angles = live.dofs(self.acts_on()), live.angles(self.acts_on())
        joints = live.model.dof_jntid[dofs]
        stiffness, rest = live.own("jnt_stiffness"), live.own("qpos_spring")
        own, added = stiffness[:, joints], self.stiffness_nm_per_rad * memory["touches"]
        both = own + added
        # Two springs are one that rests in between: cable_spring may be there, too.
        middle = np.divide(own * rest[:, angles] + added * self.angle_rad, both, out=rest[:, angles], where=added > 0)
        stiffness[:, joints], rest[:, angles] = both, middle
        live.own("dof_damping")[:, dofs] += DAMPING_S * added

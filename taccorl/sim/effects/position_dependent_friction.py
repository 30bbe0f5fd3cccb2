"""Position-dependent friction: a place in the joint's range where it turns with more friction."""

from collections.abc import Mapping
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


@effects.register("position_dependent_friction")
@dataclass(kw_only=True)
class PositionDependentFriction(JointEffect):
    """Dry friction about one angle of the joint: τ = −F(q) sign q̇ with F(q) = F₀ exp(−((q − q₀) / w)²); at rest any τ with |τ|
    ≤ F(q).

    Causes are a dent in a bearing, a cable guide, or a gear that is out of true. Armstrong-Hélouvry, "Control of Machines with
    Friction", 1991, ch. 3, measured gear friction that depends on the position. With w of about a radian the law also
    approximates F (1 + a cos(2 (q − q₀))), since cos² x ≈ exp(−x²): for a ≥ 0.6, no additional Coulomb friction is required over
    a range of ± 1 rad. It does not approximate a sinusoid of several turns, as of a bent shaft before the gear. q is the motor's
    angle at the end of each physics step, for the next step.
    """

    name: ClassVar = "position_dependent_friction"
    needs: ClassVar = ("position", "velocity")
    equation: ClassVar = "τ = −F₀ exp(−((q − q₀) / w)²) sign q̇; at rest |τ| ≤ F₀ exp(−((q − q₀) / w)²)"
    in_words: ClassVar = (
        "A tight spot: turned slowly by hand the joint runs freely but for one place of its range, where it rubs, in both "
        "directions."
    )
    at_a_policy: ClassVar = (
        "About one angle the arm stops short of its targets and hangs back; elsewhere it is as trained."
    )
    to_record: ClassVar = "One slow sweep over the whole range, there and back: the friction stays at its place."
    equals_when_wide: ClassVar = {"coulomb_friction": "width_rad"}
    near_twins: ClassVar = {
        "coulomb_friction": "Over a range that is small against the spot both are alike; sweep slowly over the whole range.",
        "load_friction": (
            "Where weight grows with the angle both follow it; repeat the slow sweep with a payload, which moves the load only."
        ),
    }
    rewrites: ClassVar = ("dof_frictionloss",)
    torque_nm: float = parameter(
        unit="N·m",
        symbol="F₀",
        over="kp",
        absent=0.0,
        low=0.0,
        high=20.0,
        typical=0.4,
        source="as coulomb_friction",
    )
    angle_rad: float = parameter(
        unit="rad",
        symbol="q₀",
        absent=None,
        low=-4.0,
        high=4.0,
        typical=0.55,
        source="a choice; a search takes it from the range that was recorded",
    )
    width_rad: float = parameter(
        unit="rad",
        symbol="w",
        absent=None,
        low=0.005,
        high=2.0,
        typical=0.1,
        source="a choice: a tooth or a cable guide is narrow, a gear out of true is as wide as a radian",
    )

    @classmethod
    def starts(cls, seen: Mapping[str, float]) -> list[dict[str, float]]:
        """Start values of a search, parameter → value each: narrow spots side by side over the recorded range, and wide ones
        at its middle and its ends.
        """
        torque, angle, width = cls.parameters()
        span = max(seen["span_rad"], 0.02)
        low = seen.get("lowest_rad", -0.5 * span)
        spots = [(place, 0.12) for place in np.arange(1, 12, 2) / 12] + [(place, 0.35) for place in (0.0, 0.5, 1.0)]
        spots.sort()  # the middle one stands for all where one is enough
        most_nm = float(np.clip(0.1 * seen["peak_torque_nm"], 1e-3, torque.high))
        return [
            {
                torque.name: most_nm,
                angle.name: float(np.clip(low + place * span, angle.low, angle.high)),
                width.name: float(np.clip(share * span, width.low, width.high)),
            }
            for place, share in spots
        ]

    def drive(self) -> dict[str, float]:
        return {"spot_friction": self.torque_nm, "spot_angle": self.angle_rad, "spot_width": self.width_rad}

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for joint in self.chosen(spec):
            add_dry_friction(joint, 0.0)

    def memory(self, num_sims: int, pad_shape: tuple[int, int]) -> Memory:
        return {"friction_nm": np.zeros((num_sims, len(self.acts_on())))}

    def feel(self, live: LiveModel, memory: Memory, ids: np.ndarray, dt_s: float) -> None:
        angle = live.seen("qpos")[:, live.angles(self.acts_on())][ids]
        memory["friction_nm"][ids] = self.torque_nm * np.exp(-(((angle - self.angle_rad) / self.width_rad) ** 2))

    def rewrite(self, live: LiveModel, memory: Memory) -> None:
        live.own("dof_frictionloss")[:, live.dofs(self.acts_on())] += memory["friction_nm"]

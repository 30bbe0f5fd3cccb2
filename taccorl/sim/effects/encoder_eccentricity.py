"""Encoder eccentricity: a disc that is off its axis reads too much on one side of a turn and too little on the other."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import JointEffect, Memory, parameter
from taccorl.sim.effects.live_model import LiveModel


@effects.register("encoder_eccentricity")
@dataclass(kw_only=True)
class EncoderEccentricity(JointEffect):
    """Sinusoidal error of an encoder: y = q + A sin(q + φ), and τ = K_p (q* − y) − K_d ẏ + T_ref with ẏ = q̇ (1 + A cos(q + φ)).
    At rest the joint reports q*.

    A is the eccentricity of the encoder's disc divided by its radius. Gravity compensation uses the true pose. A physics step
    uses the error at its beginning.
    """

    name: ClassVar = "encoder_eccentricity"
    needs: ClassVar = ("position",)
    equation: ClassVar = "y = q + A sin(q + φ); τ = K_p (q* − y) − K_d ẏ + T_ref"
    in_words: ClassVar = (
        "The encoder's disc or magnet sits beside the joint's axis: angles are wrong by one wave a turn."
    )
    at_a_policy: ClassVar = (
        "The hand is off by an amount that changes over the workspace, and proprioception does not show it."
    )
    to_record: ClassVar = "A camera on the hand over the whole range of the joint; joint data alone hardly show it."
    near_twins: ClassVar = {
        "encoder_bias": "Over a part of a turn a wave is a bias; go over the whole range.",
    }
    rewrites: ClassVar = ("actuator_biasprm",)
    amplitude_rad: float = parameter(
        unit="rad",
        symbol="A",
        absent=0.0,
        low=0.0,
        high=0.1,
        typical=0.01,
        source="a choice: 0.1 mm on a disc of 10 mm",
    )
    phase_rad: float = parameter(
        unit="rad",
        symbol="φ",
        absent=None,
        low=-math.tau,
        high=math.tau,
        typical=0.0,
        source="a choice",
    )

    @classmethod
    def starts(cls, seen: Mapping[str, float]) -> list[dict[str, float]]:
        """Start values of a search, parameter → value each: sine and cosine, of both signs."""
        return [{"phase_rad": phase} for phase in (0.0, math.pi / 2, math.pi, -math.pi / 2)]

    def drive(self) -> dict[str, float]:
        return {"encoder_wave": self.amplitude_rad, "encoder_wave_phase": self.phase_rad}

    def encoder(self, values: np.ndarray) -> np.ndarray:
        values = values.copy()
        values[:, self.columns] += self.amplitude_rad * np.sin(values[:, self.columns] + self.phase_rad)
        return values

    def memory(self, num_sims: int, pad_shape: tuple[int, int]) -> Memory:
        return {"angle_rad": np.zeros((num_sims, len(self.acts_on())))}

    def feel(self, live: LiveModel, memory: Memory, ids: np.ndarray, dt_s: float) -> None:
        memory["angle_rad"][ids] = live.seen("qpos")[:, live.angles(self.acts_on())][ids]

    def rewrite(self, live: LiveModel, memory: Memory) -> None:
        turned = memory["angle_rad"] + self.phase_rad
        bias, actuators = live.own("actuator_biasprm"), live.actuators(self.acts_on())
        bias[:, actuators, 0] += bias[:, actuators, 1] * self.amplitude_rad * np.sin(turned)
        bias[:, actuators, 2] *= 1.0 + self.amplitude_rad * np.cos(turned)

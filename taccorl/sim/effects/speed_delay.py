"""Speed delay: the controller damps the speed of a moment ago, because its loop is sampled and filtered."""

import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import mujoco
import numpy as np

from taccorl.robots import ROBOT
from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import JointEffect, Parameter, parameter

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig

MOST_LOST = 0.5
"""Largest share of a joint's inertia by which the effect may reduce it in MuJoCo. A choice with which all six joints are stable.
A longer delay is applied in part, with a warning."""
POSES = 64
"""Number of random poses of the arm in which the inertia of its joints is computed."""


@effects.register("speed_delay")
@dataclass(kw_only=True)
class SpeedDelay(JointEffect):
    """Delay τ of the velocity in the controller: −K_d (q̇ − τ q̈), to first order in τ an inertia of −K_d τ.

    τ is the sum of half a sampling period for the difference of two samples, half a period for the output that is held, and the
    time constant of the velocity's filter. The diagnosis fits τ with the gains if the recordings determine it (recorded effort,
    known weight, commanded gains), so that it is not a candidate of the search. In the one-joint model the effort includes K_d τ
    q̈, which the motor supplies; in a whole twin in MuJoCo, where only the inertia is changed, it does not.
    """

    name: ClassVar = "speed_delay"
    needs: ClassVar = ("velocity",)
    equation: ClassVar = "−K_d (q̇ − τ q̈)"
    in_words: ClassVar = (
        "The motor's controller computes a few hundred to a few thousand times a second, from a speed that it filters. It "
        "damps the speed of a moment ago."
    )
    at_a_policy: ClassVar = "Stiff joints overshoot a little; slow motion is as before."
    to_record: ClassVar = "A chirp up to 3 Hz or more with the motor's effort recorded, or with a known payload."
    near_twins: ClassVar = {
        "armature": "An inertia with the other sign.",
        "kp": "Without efforts or known weight all torques together scale like 1 / inertia.",
    }
    fitted: ClassVar = False
    delay_s: float = parameter(
        unit="s",
        symbol="τ",
        absent=0.0,
        low=0.0,
        high=3e-3,
        typical=2e-4,
        source="a choice: typical is a loop of 5 kHz; at most one of 1 kHz that filters its speed over 2 ms",
    )

    @classmethod
    def accepted(cls, p: Parameter) -> tuple[float, float]:
        return (-p.high, p.high)  # below 0: a speed that is newer than the difference of two samples of the file's loop

    def drive(self) -> dict[str, float]:
        return {"speed_delay": self.delay_s}

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        joints = list(self.chosen(spec))
        least = _least_inertia(spec, [joint.name for joint in joints])
        for joint, inertia in zip(joints, least, strict=True):
            arm, name = joint.name.split("_", 1)
            control = config.controller_of(arm)
            kd, most = control.kd_nms_per_rad[ROBOT.joints.index(name)], MOST_LOST * inertia
            lost = kd * self.delay_s
            joint.armature -= min(lost, most)
            if lost > most:
                warnings.warn(
                    f"effect speed_delay: {joint.name}: {1e3 * self.delay_s:.3g} ms would reduce the inertia by {lost:.3g} "
                    f"kg·m², more than {MOST_LOST:.0%} of the least inertia that the joint has in any pose, {inertia:.3g} "
                    f"kg·m²; MuJoCo applies {1e3 * most / kd:.3g} ms",
                    stacklevel=2,
                )


def _least_inertia(spec: mujoco.MjSpec, names: list[str]) -> np.ndarray:
    """(J,) kg·m² of joints, 1 / (M⁻¹)_jj, the least of ``POSES`` drawn poses: below it no pose has a mass matrix that is not
    positive."""
    model = spec.compile()
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    ids = [model.joint(name).id for name in names]
    dofs, places = model.jnt_dofadr[ids], model.jnt_qposadr[ids]
    least = np.full(len(names), np.inf)
    unit, answer = np.eye(model.nv)[dofs], np.empty((len(dofs), model.nv))
    for _ in range(POSES):
        data.qpos[places] = rng.uniform(*model.jnt_range[ids].T)
        mujoco.mj_forward(model, data)
        mujoco.mj_solveM(model, data, answer, unit)
        least = np.minimum(least, 1.0 / answer[np.arange(len(dofs)), dofs])
    return least

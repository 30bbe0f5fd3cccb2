"""Recordings of one joint of the simulated twin, made by MuJoCo's own steps: what the one-joint model is held against."""

import dataclasses
from collections.abc import Sequence
from typing import Literal

import numpy as np

from pipelines.benchmarks.one_joint import in_mujoco
from taccorl.alignment.controller.joint_model import JointModel
from taccorl.alignment.controller.joint_motion import JointMotion
from taccorl.alignment.controller.joint_recording import joint_motion
from taccorl.alignment.controller.rigid_joint import Gains, Rigid, RigidJoint
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.data.origin import Origin
from taccorl.robots import ROBOT
from taccorl.sim.controller import ControllerConfig
from taccorl.sim.effects.effect import Effect
from taccorl.sim.twin import TwinConfig

HOME = np.array(
    [
        0.003,
        1.732,
        -0.883,
        -0.528,
        0.2,
        -0.4,
        0.06,
        -0.003,
        1.732,
        -0.883,
        0.528,
        0.2,
        0.4,
        0.06,
    ]
)
TWIN = TwinConfig()
REFERENCE_TWIN = TwinConfig(
    controller=ControllerConfig(
        kp_nm_per_rad=[500.0] * 6, kd_nms_per_rad=[50.0] * 6, torque_ff_nm=[0.0] * 6
    )
)
"""The paper's reference simulator: knows nothing of the true gains."""


@dataclasses.dataclass(frozen=True)
class AxisJoint(RigidJoint):
    """A single axis: an inertia [kg·m²], or a mass [kg] on a slide with ``unit`` m, without weight."""

    signal: str
    inertia: float
    gains: Gains
    unit: Literal["rad", "m"] = "rad"
    step_s: float = 1.0 / 1200.0

    def timestep_s(self, motion: JointMotion) -> float:
        return self.step_s

    def rigid(self, motion: JointMotion, bodies: Sequence[Effect]) -> Rigid:
        return Rigid(self.inertia)


def chirp(
    signal: str,
    seconds: float = 10.0,
    *,
    amplitude: float = 0.25,
    high_hz: float = 2.0,
    rate_hz: float = 200.0,
) -> Measurement:
    """One joint's targets from 0.1 Hz to ``high_hz`` after half a second of rest; "measured" are its targets."""
    time_s = np.arange(round(seconds * rate_hz)) / rate_hz
    phase = 2 * np.pi * (0.1 * time_s + (high_hz - 0.1) * time_s**2 / (2 * seconds))
    target = np.tile(HOME, (len(time_s), 1))
    target[:, ROBOT.action_names.index(signal)] += (
        amplitude * np.clip((time_s - 0.5) / 0.5, 0, 1) * np.sin(phase)
    )
    return Measurement(
        name=f"chirp to {high_hz:g} Hz",
        time_s=time_s,
        target=target,
        measured=target.copy(),
        origin=Origin("twin", "simulated"),
    )


def at_rest(motion: JointMotion, gains: Gains) -> JointMotion:
    """``motion`` from where its joint stands still: T_ref / K_p off its target."""
    return dataclasses.replace(
        motion, start=float(motion.target[0]) + gains.torque_ff / gains.kp
    )


def recorded(
    signal: str,
    seed: int,
    *effects: Effect,
    noise_rad: float = 2e-4,
    effort_noise_nm: float | None = None,
    seconds: float = 10.0,
    high_hz: float = 2.0,
    rows_early: int = 0,
) -> Measurement:
    """What a driver would log of the simulated twin with the paper's gains. ``rows_early``: positions paired with the commands
    of so many rows before them: a clock that is off."""
    m = chirp(signal, seconds, high_hz=high_hz)
    gains = JointModel(TWIN, signal).gains
    done = in_mujoco(
        at_rest(joint_motion(m, TWIN, signal), gains), signal, gains, effects
    )
    rng, j = np.random.default_rng(seed), m.column(signal)
    seen = done.reported + noise_rad * rng.normal(size=m.num_rows)
    m.measured[:, j] = seen
    if effort_noise_nm is not None:
        m.effort[:] = 0.0
        m.effort[:, j] = done.effort + effort_noise_nm * rng.normal(size=m.num_rows)
    keep = m.num_rows - rows_early
    return dataclasses.replace(
        m,
        **{name: getattr(m, name)[:keep] for name in ("time_s", "target")},
        **{
            name: getattr(m, name)[rows_early:]
            for name in ("measured", "velocity", "effort")
        },
    )

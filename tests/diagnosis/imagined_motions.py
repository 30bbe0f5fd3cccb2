"""Recordings of one joint that its own one-joint model made, with noise: cheap, and nothing in them is unknown. Not a robot."""

import dataclasses

import numpy as np

from taccorl.alignment.controller.joint_model import JointModel
from taccorl.alignment.controller.joint_recording import joint_motion
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.alignment.measurements.motions import RATE_HZ, Motion, Room, chirp
from taccorl.data.origin import Origin
from taccorl.diagnosis.experiment_design.motions import arm_ground, rest_pose
from taccorl.sim.twin import TwinConfig

SIGNAL = "left_joint5"
NOISE_RAD = 2e-4
NOISE_NM = 0.05


def quick(
    name: str, hz: tuple[float, float], off: float = 0.0, repeat_of: str | None = None
) -> Motion:
    """A chirp that lasts 4 s, with 0.5 s of rest before and after it. It has at most half as many rows as the library's
    motions. ``hz``: lowest and highest frequency [Hz]. ``off``: distance of the chirp from the middle of the joint's range, in
    amplitudes of the chirp."""

    def target(room: Room) -> np.ndarray:
        still = np.zeros(RATE_HZ // 2)
        motion = np.concatenate([still, chirp(4.0, *hz, room.sweep_rad), still])
        return room.middle_rad + off * room.sweep_rad + motion

    return Motion(name=name, target=target, repeat_of=repeat_of)


QUICK_CHIRP = quick("chirp", (0.2, 2.0))
QUICK_AGAIN = quick("chirp_again", (0.2, 2.0), repeat_of="chirp")
QUICK_VALIDATION = quick("held_chirp", (0.3, 1.7), off=-0.3)


def recorded(
    config: TwinConfig,
    motion: Motion,
    seed: int,
    *,
    signal: str = SIGNAL,
    stated: bool = True,
    noise_rad: float = NOISE_RAD,
    effort: bool = False,
) -> Measurement:
    """One motion of the library. ``stated``: its commanded gains are written down; else only by what factor they differ from
    the usual ones. ``effort``: it was recorded."""
    ground = arm_ground(config, signal, rest_pose(signal, None))
    m = ground.commanded(
        motion.name, ground.positions(motion), motion.gain, motion.payload_kg
    )
    model, seen = JointModel(config, signal), joint_motion(m, config, signal)
    # A robot has been at rest for long: where K_p (q* − q) + T_ref = 0.
    rest = dataclasses.replace(
        seen,
        start=seen.target[0] + model.gains.torque_ff / (motion.gain * model.gains.kp),
    )
    answer, rng = model.simulate(rest, model.gains), np.random.default_rng([seed, 77])
    j = m.column(signal)
    measured = m.measured + noise_rad * rng.standard_normal(m.measured.shape)
    measured[:, j] = answer.reported + noise_rad * rng.standard_normal(m.num_rows)
    efforts = np.full(measured.shape, np.nan)
    if effort:
        efforts[:] = 0.0  # others: reported, and nothing in it
        efforts[:, j] = answer.effort + NOISE_NM * rng.standard_normal(m.num_rows)
    gains = {} if stated else {"kp": {}, "kd": {}}
    scale = {} if stated or motion.gain == 1.0 else {signal: motion.gain}
    return dataclasses.replace(
        m,
        measured=measured,
        effort=efforts,
        gain_scale=scale,
        repeat_of=motion.repeat_of,
        origin=Origin("twin", "simulated by the joint model, not a robot"),
        **gains,
    )

"""Recordings of a surrogate robot in memory: the data that drivers would log, with noise, quantisation and metadata.

Letters in shapes: T rows, J signals.
"""

import math
import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from taccorl.alignment.measurements.folder import Measurements, split
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.alignment.measurements.motions import (
    DESIGNS,
    OPENING_M,
    RATE_HZ,
    REST_POSE,
    TEST,
    VALIDATION,
    Motion,
)
from taccorl.data.origin import Origin
from taccorl.errors import TaccorlError, nearest
from taccorl.robots import ROBOT
from taccorl.surrogate.cases import Case
from taccorl.surrogate.plant import COMMAND_MS
from taccorl.surrogate.robot import NOISE_RAD, QUANTUM_RAD, coloured

ORIGIN = "robot simulated apart from the twin, not a robot"  # Text of the origin of every recording
SPEED_NOISE_RAD_PER_S, SPEED_QUANTUM_RAD_PER_S = 5e-3, 1e-3
"""Noise of reported velocities, and the step in which PiPER reports them [rad/s]."""
EFFORT_NOISE_SHARE, EFFORT_NOISE_NM, EFFORT_QUANTUM_NM = 0.01, 0.005, 1e-3
"""Noise of efforts: share of the largest effort in the recording, and least value [N·m], both choices; step in which PiPER
reports them."""
OPENING_NOISE_M, OPENING_QUANTUM_M = 2e-6, 1e-6
"""Noise of reported openings, and the step in which PiPER reports them [m]."""


def recordings(case: Case, design: str | None = None, prefix: str = "") -> Measurements:
    """Simulate all recordings of one robot: those of the design for the fit, and others for validation and test. ``design``:
    ``chirp`` (the paper's 10 s sweep, twice) or ``pack`` (with triangle, steps, small chirp, 2× gain, payload); the case's
    by default; ``prefix``: beginning of their names. Raises TaccorlError: there is no such design."""
    if (design := design or case.design) not in DESIGNS:
        raise TaccorlError(f"no design {design!r}; {nearest(design, DESIGNS)}")
    made = [
        record(case, motion, prefix)
        for motion in (*DESIGNS[design], *VALIDATION, *TEST)
    ]
    return split(
        made,
        validation=[prefix + m.name for m in VALIDATION],
        test=[prefix + m.name for m in TEST],
    )


def robot_recordings(cases: Sequence[Case]) -> Measurements:
    """The recordings of several joints of one robot, whose names begin with the joint's; those of one joint as they are."""
    made = [
        recordings(case, prefix=f"{case.signal}_" * (len(cases) > 1)) for case in cases
    ]
    fit, validation, test = (
        [m for one in made for m in getattr(one, use)]
        for use in ("fit", "validation", "test")
    )
    return Measurements(tuple(fit), tuple(validation), tuple(test))


def record(case: Case, motion: Motion, prefix: str = "") -> Measurement:
    """Simulate one recording. The same case and motion give the same numbers, bit for bit."""
    rng = np.random.default_rng(
        [case.seed, zlib.crc32(case.name.encode()), zlib.crc32(motion.name.encode())]
    )
    robot, motion = case.robot, case.motion(motion)
    run = robot.run(motion, case.room, rng)
    own = ROBOT.joint_slice(ROBOT.arms[robot.arm])
    num_rows = len(run.angle) // COMMAND_MS
    target = np.tile([*REST_POSE, OPENING_M] * len(ROBOT.arms), (num_rows, 1))
    target[:, own] = robot.pose
    target[:, own.start + robot.joint] = motion.target(case.room)
    measured, velocity, effort = (
        target.copy(),
        np.zeros_like(target),
        np.zeros_like(target),
    )
    rest = [k for k in ROBOT.joint_indices if not own.start <= k < own.stop]
    # The other arm rests where its T_ref turns it; its weight is carried.
    measured[:, rest] += np.array(ROBOT.torque_ff_nm) / np.array(ROBOT.kp_nm_per_rad)
    measured[:, own] = robot.reported(run)
    velocity[:, own], effort[:, own] = (
        run.velocity[::COMMAND_MS],
        run.effort[::COMMAND_MS],
    )
    effort_noise = np.maximum(
        EFFORT_NOISE_SHARE * np.abs(effort).max(axis=0), EFFORT_NOISE_NM
    )
    seen = _noisy(rng, measured, NOISE_RAD, OPENING_NOISE_M, case.colour_s)
    return Measurement(
        name=prefix + motion.name,
        time_s=np.arange(num_rows) / RATE_HZ,
        target=_rounded(target, QUANTUM_RAD, OPENING_QUANTUM_M),
        measured=_rounded(seen, QUANTUM_RAD, OPENING_QUANTUM_M),
        velocity=_rounded(
            _noisy(rng, velocity, SPEED_NOISE_RAD_PER_S, 0.0),
            SPEED_QUANTUM_RAD_PER_S,
            1e-3,
        ),
        effort=_rounded(
            _noisy(rng, effort, effort_noise, 0.0), EFFORT_QUANTUM_NM, 1e-3
        ),
        origin=Origin("surrogate", f"{ORIGIN}; {case.signal} under test"),
        instruction=f"sweep of {case.signal}: {motion.name}",
        repeat_of=motion.repeat_of and prefix + motion.repeat_of,
        payload_kg={ROBOT.arms[robot.arm]: motion.payload_kg}
        if motion.payload_kg
        else {},
        # A mass that is held in every recording is one whose place was measured, too.
        payload_position_m={ROBOT.arms[robot.arm]: case.payload_m}
        if case.payload_kg
        else {},
        **_stated(case, motion),
    )


def _stated(case: Case, motion: Motion) -> dict[str, Any]:
    """What is written down of the gains: known ones in every recording, else only by what factor one is driven differently."""
    if not case.gains_known:
        return {"gain_scale": {case.signal: motion.gain}} if motion.gain != 1.0 else {}
    control, joint = (
        case.twin.controller_of(case.signal.partition("_")[0]),
        case.robot.joint,
    )
    gains = {"kp": control.kp_nm_per_rad[joint], "kd": control.kd_nms_per_rad[joint]}
    return {name: {case.signal: gain * motion.gain} for name, gain in gains.items()}


def _noisy(
    rng: np.random.Generator,
    values: np.ndarray,
    joints: float | np.ndarray,
    grippers: float,
    colour_s: float = 0.0,
) -> np.ndarray:
    size = np.broadcast_to(np.asarray(joints, dtype=float), ROBOT.num_actions).copy()
    size[ROBOT.gripper_indices] = grippers
    noise = rng.standard_normal(values.shape)
    if colour_s > 0.0:
        noise = coloured(noise, math.exp(-1.0 / (colour_s * RATE_HZ)))
    return values + size * noise


def _rounded(values: np.ndarray, joints: float, grippers: float) -> np.ndarray:
    """To the drivers' steps, of joints and of grippers."""
    step = ROBOT.per_action(joints, grippers)
    return np.round(values / step) * step

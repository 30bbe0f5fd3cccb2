"""Replay a measurement's commands in the twin: joint by joint, or with the whole twin; and its pads in the pressed object. Row k
is the state of the twin at the time of row k.

Letters in shapes: T rows.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from taccorl.alignment.controller.arm_joint import BENCH_REST as BENCH_REST
from taccorl.alignment.controller.arm_joint import HasJoints, held_payload
from taccorl.alignment.controller.joint_model import JointModel
from taccorl.alignment.controller.joint_motion import AT_TCP
from taccorl.alignment.controller.joint_recording import motion_of
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.alignment.measurements.pressed import PressedObject
from taccorl.alignment.touch.motion import TouchMotion, touch_motion
from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.bench import Bench
from taccorl.sim.replay import replay
from taccorl.sim.simulation import Simulation
from taccorl.sim.twin import TwinConfig

CONTACT_READING = 0.4
"""Normalised reading of a taxel above which it is in contact: λ_f (paper Table 3)."""
CONTACT_COUNTS = 30.0
"""λ_f of the twin's pads, at the data spec's 75 counts per reading of 1."""
DEEP_M, FELT_COUNTS = 2e-4, 1.0
"""Taxels at least this deep in an object [m] must read at least so many counts on average."""
START_S = 0.1
"""Duration of rest over which the start position of the joints is averaged [s], because the noise of one reading would excite
the twin."""


@dataclass(frozen=True)
class Response:
    """Response of the twin in a replay, row by row, with the recording that was replayed."""

    measurement: Measurement
    """The replayed recording: all signals, resampled at a rate whose period is a whole number of physics steps."""
    way: Literal["joint", "twin"]
    """joint: signals replayed one by one in the one-joint model; twin: the whole twin."""
    reported: np.ndarray
    """(T, J) reported positions [rad, m] of the machine's J signals; NaN for those that were not replayed."""
    effort: np.ndarray
    """(T, J) motor efforts at the time of each row [N·m, N]; NaN where not known."""


def replay_joints(
    machine: TwinConfig | HasJoints, m: Measurement, signals: Sequence[str]
) -> Response:
    """Replay each of ``signals`` alone, while the others move as measured; with the gains and payloads that the recording
    states."""
    m = evened(m, machine) if isinstance(machine, TwinConfig) else m
    reported, effort = np.full((2, m.num_rows, len(m.signals)), np.nan)
    for signal in signals:
        model, j = JointModel(machine, signal), m.column(signal)
        done = model.simulate(motion_of(m, signal, model.joint), model.gains)
        reported[:, j], effort[:, j] = done.reported, done.effort
    return Response(m, "joint", reported, effort)


def replay_whole(config: TwinConfig, m: Measurement) -> Response:
    """Replay with the whole twin on the empty bench, from the robot's measured start. Raises TaccorlError: the twin diverged."""
    m = evened(m, config)
    sim = Simulation(Bench(), _as_recorded(config, m))
    sim.reset([0])
    done = replay(sim, m.target, m.rate_hz, _start(m))
    if sim.diverged[0] or not np.isfinite(done.reported).all():
        raise TaccorlError(
            f"{m.name}: the twin diverged in the replay; check its gains and effects"
        )
    # ``Replay.effort`` is at the end of each command's stretch: the time of the next row.
    effort = np.concatenate(
        [np.full((1, len(ROBOT.action_names)), np.nan), done.effort[:-1]]
    )
    return Response(m, "twin", done.reported, effort)


def _as_recorded(config: TwinConfig, m: Measurement) -> TwinConfig:
    """With the gains that were commanded and the masses that were held, where the recording knows them."""
    controllers = {}
    for arm in ROBOT.arms:
        control = config.controller_of(arm)
        for key, known in (("kp_nm_per_rad", m.kp), ("kd_nms_per_rad", m.kd)):
            values = [
                known.get(f"{arm}_{joint}", value)
                for joint, value in zip(
                    ROBOT.joints, getattr(control, key), strict=True
                )
            ]
            control = dataclasses.replace(control, **{key: values})
        controllers[arm] = control
    held = [
        held_payload(arm, mass, m.payload_position_m.get(arm, AT_TCP))
        for arm, mass in m.payload_kg.items()
        if mass > 0
    ]
    return dataclasses.replace(
        config, arm_controllers=controllers, effects=[*config.effects, *held]
    )


def evened(m: Measurement, config: TwinConfig) -> Measurement:
    """The measurement, resampled to the nearest even rate whose period is a whole number of physics steps: 200 Hz for 199.97 Hz;
    ``m`` itself if it has such a rate. Raises TaccorlError: its rate is more than 1.25 times that of the physics."""
    physics_hz = 1.0 / config.physics.timestep_s
    if m.rate_hz > 1.25 * physics_hz:
        raise TaccorlError(
            f"{m.name}: {m.rate_hz:g} rows per second, but the twin makes only {physics_hz:g} steps per second"
        )
    rate_hz = physics_hz / max(1, round(physics_hz / m.rate_hz))
    even = abs(m.rate_hz - rate_hz) < 1e-3 and np.ptp(np.diff(m.time_s)) < 1e-6
    return m if even else m.resampled(rate_hz)


def _start(m: Measurement) -> np.ndarray:
    """(14,) measured at rest before the first command moves; the first target where nothing was measured."""
    changed = np.flatnonzero(np.any(m.target != m.target[0], axis=1))
    rest = min(changed[0] if len(changed) else m.num_rows, round(START_S * m.rate_hz))
    rows = m.measured[: max(rest, 1)]
    seen = np.isfinite(rows).any(axis=0)
    start = m.target[0].copy()
    start[seen] = np.nanmean(rows[:, seen], axis=0)
    return np.clip(start, ROBOT.action_low, ROBOT.action_high)


def in_contact(m: Measurement) -> np.ndarray:
    """(T, arms) bool: a pad of the arm is in contact at the time of each row; False without pads. A pad whose name begins
    with no arm's counts for each arm that was measured."""
    found = np.zeros((m.num_rows, len(ROBOT.arms)), dtype=bool)
    if m.touch is None:
        return found
    signals = zip(m.signals, m.measured.T, strict=True)
    measured = {
        signal.split("_", 1)[0]
        for signal, values in signals
        if any(np.isfinite(values))
    }
    for pad, frames in m.touch.parts.items():
        gate_count = CONTACT_READING / pad.gain_per_count
        beyond = (frames.counts > gate_count).any(axis=1)
        at_rows = np.interp(m.time_s, frames.time_s[:, 0], beyond) > 0.5
        named = {arm for arm in ROBOT.arms if pad.name.startswith(f"{arm}_")}
        arms = [arm in (named or measured) for arm in ROBOT.arms]
        found |= at_rows[:, None] & arms
    return found


def matched_contact(
    m: Measurement, config: TwinConfig, pressed: PressedObject
) -> TouchMotion:
    """Matched contact replay for the stated object, which must agree with the readings of the pads. Raises TaccorlError: as
    ``touch_motion``; the object touches no pad, or a pad in contact reads nothing."""
    motion = touch_motion(m, config, pressed)
    depth, _ = motion.depth()
    if not (depth > 0).any():
        most = float(motion.measured.max())
        told = (
            f", and their taxels read up to {most:.0f} counts"
            if most > CONTACT_COUNTS
            else ""
        )
        raise TaccorlError(
            f"{m.name}: the object comes near the pads of the {pressed.arm} arm and never touches them, according to its size, "
            f"its pose and the measured opening{told}; press it, or correct radius_m and position_m of its `pressed`"
        )
    for p, pad in enumerate(motion.pads):
        deep = depth[:, p] > DEEP_M
        if deep.any() and abs(float(motion.measured[:, p][deep].mean())) < FELT_COUNTS:
            raise TaccorlError(
                f"{m.name}: {pad} should penetrate the object by {1e3 * depth[:, p].max():.2f} mm, but its taxels read "
                "nothing; check whether the pad is connected, whether `pressed` names the right arm, and the clocks"
            )
    return motion

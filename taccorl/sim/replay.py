"""Replay: simulate a recorded command sequence in the twin, aligned in time with the measurement.

Sample k of the result is the twin at exactly the time of command k, before the command acts: positions that a driver measured
when it sent the command are compared with it row by row. (MuJoCo's own ``sensordata`` after a step is the state before it;
one step of 2 ms off turned K_p 151 into 690 in an identification, research notes.)
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from taccorl.data.episode import Episode
from taccorl.data.origin import Origin
from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.simulation import Simulation

_COMMAND_HZ = 150.0  # as Simulation.step sends them


@dataclass(frozen=True)
class Replay:
    """Result of a replay: the twin's signals, one row for each of T commands: times, reported joints, touch, efforts."""

    time_s: np.ndarray
    """(T,) times of the commands [s]."""
    reported: np.ndarray
    """(T, 14) joints [rad] and openings [m] as the encoders report them when command k is sent."""
    tactile: np.ndarray
    """(T, 1536) int16 counts above baseline at the same times."""
    effort: np.ndarray
    """(T, 14) motor torques [N·m] and gripper forces [N] at the end of the interval in which each command is in force."""


def replay(
    sim: Simulation,
    targets: np.ndarray,
    rate_hz: float,
    start: np.ndarray | None = None,
) -> Replay:
    """Simulate the commands ``targets`` (T, 14) [rad, m] at ``rate_hz`` in simulation 0, from its present scene; the caller
    resets it before.

    Between two of them the command is interpolated linearly, in steps of at most 1/150 s: rows of a dataset are samples of a
    command that moved on at 200 Hz. At rates of 150 Hz and above each command is held. ``start``: (14,) joints and openings
    as measured when the first command was sent; the first targets by default. Raises TaccorlError: the period is no whole
    number of physics steps, or a shape is wrong."""
    targets = np.asarray(targets, dtype=float)
    if (
        targets.ndim != 2
        or targets.shape[1] != ROBOT.num_actions
        or not np.isfinite(targets).all()
    ):
        raise TaccorlError(
            f"replay: targets of shape {targets.shape}, not (T, {ROBOT.num_actions}) finite rad and m"
        )
    steps = 1.0 / (rate_hz * sim.config.physics.timestep_s)
    if abs(steps - round(steps)) > 1e-6:
        raise TaccorlError(
            f"replay: {rate_hz:g} Hz is {steps:.3f} physics steps; resample to 30, 100 or 200 Hz"
        )
    parts = math.ceil(_COMMAND_HZ / rate_hz)
    while round(steps) % parts:
        parts -= 1
    share = (
        np.arange(1, parts + 1)[:, None, None] / parts
        if parts > 1
        else np.zeros((1, 1, 1))
    )  # as Simulation.step
    sim.place_arms(targets[0] if start is None else start, targets[0])
    reported, counts, effort = [], [], []
    for target, following in zip(targets, [*targets[1:], targets[-1]], strict=True):
        reported.append(sim.proprioception()[0])
        counts.append(sim.touch()[0])
        line = target + share * (following - target)
        sim.advance(
            np.broadcast_to(line, (parts, sim.num_sims, len(target))),
            round(steps) // parts,
        )
        effort.append(sim.effort()[0])
    return Replay(
        np.arange(len(targets)) / rate_hz,
        np.array(reported),
        np.array(counts),
        np.array(effort),
    )


def replay_episode(sim: Simulation, episode: Episode) -> Episode:
    """Replay an episode: its commands, with the twin's joint states and touch instead of the measured ones, without pictures.

    Where the action of row t is reached at row t + 1 (``DatasetSpec.action_time``), that of row t − 1 is in force at row t.
    No row holds the command in force at row 0 then; the first action is used for it, which is exact if the episode begins at
    rest. Raises TaccorlError: the episode does not state its action_time, or a wrong rate or shape (``replay``)."""
    episode.spec.require_action_time(episode.name)
    state, action = episode.arrays["observation.state"], episode.executed()
    in_force = (
        np.concatenate([action[:1], action[:-1]])
        if episode.spec.action_time == "next_row"
        else action
    )
    done = replay(sim, in_force, episode.spec.fps, state[0])
    arrays = {"observation.state": done.reported.astype(np.float32), "action": action}
    if "observation.tactile" in episode.spec.features:
        arrays["observation.tactile"] = done.tactile
    return replace(
        episode,
        name=f"{episode.name}, replayed in the twin",
        arrays=arrays,
        pictures=lambda: iter(()),
        picture_keys=(),
        origin=Origin("twin", f"replay of: {episode.origin.text or episode.name}"),
        picture_rows={},
        videos={},
        timing=(),
    )

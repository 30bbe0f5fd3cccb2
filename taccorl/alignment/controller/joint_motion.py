"""One joint's part of a recording: its targets, what was measured, and the torque by which other joints' motion loads it.

Letters in shapes: T rows, N numbers of a pose.
"""

from dataclasses import dataclass

import numpy as np

from taccorl.robots import ROBOT

Position = tuple[float, float, float]
AT_TCP: Position = (0.0, 0.0, ROBOT.tcp_from_hand_m)
"""m, in link 6's frame: the middle between the pads, where the PiPER's gripper holds its payload."""


@dataclass(frozen=True, kw_only=True)
class JointMotion:
    """One recording seen from one joint. Row k is the joint at the time of command k, before it acts."""

    name: str
    time_s: np.ndarray
    """(T,)."""
    rate_hz: float
    target: np.ndarray
    """(T,) rad."""
    measured: np.ndarray
    """(T,) rad; NaN where nothing was measured."""
    effort: np.ndarray
    """(T,) N·m; NaN where it was not recorded."""
    coupling_nm: np.ndarray
    """(T,) torque that the joint must hold against the measured motion of the others; 0 where they stand still."""
    start: float
    """rad: reported at rest before the first command."""
    pose: np.ndarray
    """(N,) where the other joints are held [rad, m] (of the PiPER its arm's joints and gripper); the number of the free joint is
    not used."""
    kp_scale: float = 1.0
    """Gains of this recording over those that are asked for: commanded ones, where known, over the twin's; else over those of
    the other recordings (``Measurement.gain_scale``)."""
    kd_scale: float = 1.0
    kp_known: bool = False
    """The recording says which gain was commanded."""
    kd_known: bool = False
    payload_kg: float = 0.0
    """Known mass in the gripper."""
    torque_ff_nm: np.ndarray | None = None
    """(T,) known torque that the controller adds to its law; None: none."""
    supply: np.ndarray | None = None
    """(T,) voltage of the motor over the one of its file; None: 1."""
    command_s: np.ndarray | None = None
    """(T,) when each target came, on the clock of ``time_s``; None: with its row."""
    on: np.ndarray | None = None
    """(T,) 0 while the motor is off, else 1; None: 1."""
    moment_kgm: float = 0.0
    """Σ m l of what the recording mounts on an axis,"""
    mounted_kgm2: float = 0.0
    """and Σ m l²; on a slide Σ m in kg."""
    payload_at_m: Position = AT_TCP
    """Its centre of mass in link 6's frame."""
    payload_at_known: bool = False
    """The recording states that place."""

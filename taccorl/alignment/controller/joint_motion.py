"""One joint's part of a recording: its targets, what was measured, and the torque by which other joints' motion loads it.

Letters in shapes: T rows, N numbers of a pose.
"""

import dataclasses
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from taccorl.robots import ROBOT

Position = tuple[float, float, float]
"""x, y, z [m]."""
AT_TCP: Position = (0.0, 0.0, ROBOT.tcp_from_hand_m)
"""Position in link 6's frame [m]: the middle between the pads, where the PiPER's gripper holds its payload."""


@dataclass(frozen=True, kw_only=True, eq=False)
class JointMotion:
    """Data of one joint from one recording. Row k holds the state of the joint at the time of command k, before this command
    acts. Objects are equal only if they are the same, so that results for one can be kept."""

    name: str
    time_s: np.ndarray
    """(T,) times [s]."""
    rate_hz: float
    """Row rate [Hz]."""
    target: np.ndarray
    """(T,) targets in the unit that ``target_kind`` of the joint implies [rad, rad/s or N·m]."""
    measured: np.ndarray
    """(T,) measured positions [rad]; NaN where not measured."""
    effort: np.ndarray
    """(T,) efforts [N·m]; NaN where not recorded."""
    coupling_nm: np.ndarray
    """(T,) torque that the joint must hold against the measured motion of the other joints [N·m]; 0 if they stand still. Where
    ``carrying_nm`` is given, all weight is included."""
    start: float
    """Position reported at rest before the first command [rad]."""
    start_speed: float = 0.0
    """Speed at the first row of a recording that begins in motion [rad/s]."""
    pose: np.ndarray
    """(N,) positions at which the other joints are held [rad, m] (for the PiPER its arm's joints and gripper); the entry of the
    free joint is not used."""
    positions: np.ndarray | None = None
    """(T, N) measured positions of all joints, low-pass filtered [rad, m]; None: the others are held, or no mass depends on
    them."""
    kp_scale: float = 1.0
    """Factor on the requested K_p in this recording: commanded gain over the twin's, if it is known; else over that of the other
    recordings (``Measurement.gain_scale``)."""
    kd_scale: float = 1.0
    """The same for K_d."""
    kp_known: bool = False
    """True if the recording states the commanded K_p."""
    kd_known: bool = False
    """True if the recording states the commanded K_d."""
    payload_kg: float = 0.0
    """Known mass in the gripper [kg]."""
    carrying_nm: np.ndarray | None = None
    """(T,) torque that the motor adds for gravity compensation besides that of ``Rigid`` [N·m]; None: none."""
    torque_ff_nm: np.ndarray | None = None
    """(T,) known torque that the controller adds to its law [N·m]; None: none."""
    supply: np.ndarray | None = None
    """(T,) supply voltage of the motor divided by that of its file; None: 1."""
    command_s: np.ndarray | None = None
    """(T,) arrival time of each target [s], on the clock of ``time_s``; None: the time of its row."""
    on: np.ndarray | None = None
    """(T,) 0 while the motor is off, else 1; None: always 1."""
    moment_kgm: float = 0.0
    """Σ m l of the masses that the recording mounts on an axis [kg·m]."""
    mounted_kgm2: float = 0.0
    """Σ m l² of the masses that the recording mounts on an axis [kg·m²]; on a slide Σ m [kg]."""
    payload_at_m: Position = AT_TCP
    """Centre of mass of the payload in link 6's frame [m]."""
    payload_at_known: bool = False
    """True if the recording states that position."""


@lru_cache(maxsize=32)  # the same object for the same rows, so that what is kept for it is found again
def first_rows(motion: JointMotion, rows: int) -> JointMotion:
    """``motion`` without the rows from row ``rows`` on; ``motion`` itself if it has no more."""
    whole = len(motion.time_s)
    if rows >= whole:
        return motion
    names = (
        "time_s",
        "target",
        "measured",
        "effort",
        "coupling_nm",
        "carrying_nm",
        "torque_ff_nm",
        "supply",
        "command_s",
        "on",
        "positions",
    )
    arrays = {name: getattr(motion, name) for name in names}
    return dataclasses.replace(motion, **{name: a[:rows] for name, a in arrays.items() if a is not None})

"""Motions that reach a limit (of torque, speed or angle), for effects that change nothing below it; how near a motion comes.

Letters in shapes: T rows.
"""

from collections.abc import Mapping

import numpy as np

from taccorl.alignment.measurements.motions import (
    Motion,
    between_rests,
    steps,
    triangle,
)

_SLEW_S = 0.02
"""Time over which the speed of targets is taken: a shorter excess over a limit hardly moves a joint. A choice."""
_LEVELS = np.array([0.0, 1.0, 0.0, -1.0, 0.0, 1.0, -1.0, 0.0])
JUMPS = between_rests("limit_jumps", lambda r: steps(_LEVELS * r.wide_rad, 1.0, np.inf))
"""Targets in steps to ``_LEVELS``: the largest motor torque at a given joint speed."""
RAMPS = between_rests(
    "limit_ramps", lambda r: steps(_LEVELS * r.wide_rad, 1.0, r.speed_rad_per_s)
)
"""Targets that go to ``_LEVELS`` at the largest speed of the joint: the largest speed of targets."""
ENDS = between_rests("to_the_ends", lambda r: triangle(14.0, r.wide_rad))
"""A slow triangle over the whole range."""
AIMED: Mapping[str, tuple[Motion, ...]] = {
    **dict.fromkeys(
        ("torque_saturation", "torque_speed_limit", "slew_limit"), (JUMPS, RAMPS)
    ),
    "end_stop": (ENDS,),
}
"""Effect that does nothing below a limit (a torque, a speed of targets, a torque-speed line, a mechanical stop), so that a motion
below it separates it from nothing → motions that may reach it."""


def reach(
    effect: str,
    values: Mapping[str, float],
    target: np.ndarray,
    position: np.ndarray,
    effort: np.ndarray,
    rate_hz: float,
) -> float:
    """How far a motion goes toward the limit of an effect: 1 or more reaches it.

    Args:
        effect: key of ``AIMED``.
        values: numbers of the effect, by full name.
        target: (T,) targets of a position [rad, m].
        position: (T,) positions that the machine's model answers without the effect [rad, m].
        effort: (T,) efforts of the motor in this answer [N·m, N].
    """
    own = {
        name.split(".", 1)[1]: value
        for name, value in values.items()
        if name.startswith(f"{effect}.")
    }
    if effect == "torque_saturation":
        return float(np.abs(effort).max()) / own["torque_max_nm"]
    if effect == "torque_speed_limit":
        speed = np.abs(np.gradient(position, 1.0 / rate_hz))
        return float(
            np.max(np.abs(effort) / own["stall_nm"] + speed / own["no_load_rad_per_s"])
        )
    if effect == "slew_limit":
        rows = max(1, round(_SLEW_S * rate_hz))
        return (
            float(np.abs(target[rows:] - target[:-rows]).max())
            * rate_hz
            / rows
            / own["speed_rad_per_s"]
        )
    middle = float(position[0])
    side = np.sign(own["angle_rad"] - middle) or 1.0
    return float(
        np.max(side * (position - middle)) / max(abs(own["angle_rad"] - middle), 1e-9)
    )


def at_once(positions: np.ndarray, effort: np.ndarray) -> float:
    """Largest ``effort`` (T,) [N·m, N] of a simulated motion with the targets ``positions`` (T,) [rad, m]. After a step of the
    target the effort decays within a row, so its first value is extrapolated from the two rows that follow."""
    jumps = np.flatnonzero(np.diff(positions)) + 1
    rows = np.minimum(np.concatenate([jumps, jumps + 1]), len(effort) - 2)
    before = np.abs(2.0 * effort[rows] - effort[rows + 1])
    return float(max(np.abs(effort).max(), before.max(initial=0.0)))

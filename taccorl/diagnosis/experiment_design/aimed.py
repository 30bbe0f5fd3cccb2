"""Motions that reach a suspected limit: a torque, a speed of targets, a torque-speed line, a mechanical stop. Effects of this
kind do nothing below their limit, so that a motion below it separates none of them.

Letters in shapes: T rows.
"""

from collections.abc import Mapping

import numpy as np

from taccorl.alignment.measurements.motions import RATE_HZ, REST_S, Motion, Room, steps, triangle

BEYOND = 1.3
"""Multiple of the limit at which a motion is aimed. A choice."""
SIZES = tuple(float(x) for x in np.geomspace(0.002, 1.0, 50))
"""Factors on the amplitude that are tried, the smallest first."""
_SLEW_S = 0.02
"""Time over which the speed of targets is taken: a shorter excess over a limit hardly moves a joint. A choice."""
_LEVELS = np.array([0.0, 1.0, 0.0, -1.0, 0.0, 1.0, -1.0, 0.0])


def _motion(name: str, levels: np.ndarray, jump: bool) -> Motion:
    def target(room: Room) -> np.ndarray:
        speed = np.inf if jump else room.speed_rad_per_s
        still = np.zeros(round(REST_S * RATE_HZ))
        moved = steps(levels * room.wide_rad, 1.0, speed)
        return room.middle_rad + np.concatenate([still, moved, still])

    return Motion(name=name, target=target)


JUMPS = _motion("limit_jumps", _LEVELS, jump=True)
"""Targets that jump: the most torque at a given speed of the joint."""
RAMPS = _motion("limit_ramps", _LEVELS, jump=False)
"""Targets at the highest speed."""
ENDS = Motion(
    name="to_the_ends",
    target=lambda r: r.middle_rad + np.pad(triangle(14.0, r.wide_rad), round(REST_S * RATE_HZ)),
)
"""A slow triangle over the whole range."""
AIMED: Mapping[str, tuple[Motion, ...]] = {
    "torque_saturation": (JUMPS, RAMPS),
    "torque_speed_limit": (JUMPS, RAMPS),
    "slew_limit": (JUMPS, RAMPS),
    "end_stop": (ENDS,),
}
"""Effect that does nothing below a limit → motions that may reach it."""


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
    own = {name.split(".", 1)[1]: value for name, value in values.items() if name.startswith(f"{effect}.")}
    if effect == "torque_saturation":
        return float(np.abs(effort).max()) / own["torque_max_nm"]
    if effect == "torque_speed_limit":
        speed = np.abs(np.gradient(position, 1.0 / rate_hz))
        return float(np.max(np.abs(effort) / own["stall_nm"] + speed / own["no_load_rad_per_s"]))
    if effect == "slew_limit":
        rows = max(1, round(_SLEW_S * rate_hz))
        return float(np.abs(target[rows:] - target[:-rows]).max()) * rate_hz / rows / own["speed_rad_per_s"]
    middle = float(position[0])
    side = np.sign(own["angle_rad"] - middle) or 1.0
    return float(np.max(side * (position - middle)) / max(abs(own["angle_rad"] - middle), 1e-9))

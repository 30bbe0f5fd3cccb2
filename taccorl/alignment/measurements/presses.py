"""Presses of pads and of sensors of cells: size over time in straight lines, and the object that presses pads.

Letters in shapes: T rows.
"""

import math
from dataclasses import dataclass

import numpy as np

from taccorl.alignment.measurements.folder import PressedNote
from taccorl.alignment.measurements.motions import RATE_HZ

RADIUS_M = {"sphere": 0.012, "rod": 0.008}  # Shape of the object → its radius [m]
AWAY_M = (
    -1e-3
)  # Penetration while nothing is pressed [m]: a distance of a millimetre at each pad
FRAME_S = 0.01  # Time between two frames of the pads [s]
PRESS_REST_S = 2.5  # Rest before and after the presses of pads [s]
SMOOTH_ROWS = 13  # Number of rows over which corners are rounded (65 ms), because fingers have inertia

Knots = tuple[tuple[float, float], ...]
"""(time [s], penetration into each pad [m] or share of a load) of the corners of a press, connected by straight lines."""


def in_turn(
    *each: tuple[float, float, float],
    rest_s: float,
    away: float = 0.0,
    before_s: float,
    after_s: float = 0.0,
) -> Knots:
    """Presses one after the other: (size, seconds of loading and unloading, seconds of hold), with ``rest_s`` at the size
    ``away`` after each; before the first one ``before_s``, after the last one ``after_s`` more."""
    knots, now = [(0.0, away), (before_s, away)], before_s
    for size, ramp_s, hold_s in each:
        knots += [
            (now + ramp_s, size),
            (now + ramp_s + hold_s, size),
            (now + 2 * ramp_s + hold_s, away),
        ]
        now += 2 * ramp_s + hold_s + rest_s
        knots.append((now, away))
    return (*knots, (now + after_s, away)) if after_s else tuple(knots)


def pad_presses(
    depths_m: tuple[float, ...],
    rises_s: tuple[float, ...],
    hold_s: float,
    *,
    before_s: float = PRESS_REST_S,
    between_s: float = 0.5,
    after_s: float = PRESS_REST_S,
) -> Knots:
    """Corners of presses to each of ``depths_m`` [m] within each of ``rises_s`` [s], each held for ``hold_s`` [s]. ``before_s``,
    ``between_s``, ``after_s``: rest before the first press, between two, after the last [s]."""
    each = ((depth, rise, hold_s) for depth in depths_m for rise in rises_s)
    return in_turn(
        *each, rest_s=between_s, away=AWAY_M, before_s=before_s, after_s=after_s
    )


@dataclass(frozen=True, kw_only=True)
class Press:
    """One recording of pads that could be made: an object at a position, and a depth over time."""

    name: str
    knots: Knots  # (time [s], penetration into each pad [m]); negative is a distance to the pad
    shape: str = "sphere"  # Shape of the object, a key of ``RADIUS_M``
    x_m: float = 0.001  # Position of the object's centre along x of the TCP's frame [m]
    z_m: float = 0.003
    """Position of the object's centre along z of the TCP's frame [m], not at the centre of a taxel; a rod lies across the pads,
    along x."""
    wiggle_m: float = 0.0
    """Amplitude a of a vibration that is added to the penetration [m]: a sin(2π · 2.3 Hz t) + 0.6 a sin(2π · 5.1 Hz t)."""
    repeat_of: str | None = (
        None  # Name of the press that it repeats; None if it is no repeat
    )

    def pressed(self, arm: str) -> PressedNote:
        """Entry ``pressed`` of measurements.yaml for the press."""
        place = {
            "arm": arm,
            "radius_m": RADIUS_M[self.shape],
            "position_m": (self.x_m, 0.0, self.z_m),
        }
        if self.shape == "sphere":
            return PressedNote(shape="sphere", **place)
        return PressedNote(
            shape="rod",
            length_m=0.04,
            rpy_rad=(0.0, round(math.pi / 2, 4), 0.0),
            **place,
        )

    def penetration_m(
        self, rate_hz: float = RATE_HZ, smooth_rows: int = SMOOTH_ROWS
    ) -> np.ndarray:
        """Penetration (T,) into each pad at ``rate_hz`` [m], with corners rounded over ``smooth_rows``; negative values are
        distances to the pad."""
        time_s, depth_m = np.array(self.knots).T
        at_s = (
            np.arange(
                -(smooth_rows // 2), round(time_s[-1] * rate_hz) + smooth_rows // 2
            )
            / rate_hz
        )
        depth = np.convolve(
            np.interp(at_s, time_s, depth_m),
            np.ones(smooth_rows) / smooth_rows,
            mode="valid",
        )
        angle = 2 * np.pi * np.arange(len(depth)) / rate_hz
        return depth + self.wiggle_m * (np.sin(2.3 * angle) + 0.6 * np.sin(5.1 * angle))

    def opening_m(self) -> np.ndarray:
        """(T,) opening between the fingers at 200 Hz [m]."""
        return 2 * (RADIUS_M[self.shape] - self.penetration_m())

"""Domain randomisation at reset: the physical rows of the paper's table (App. E), drawn per simulation.

Image rows are a transform that training applies (taccorl/policies/tactile_pi05/image_randomization.py).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, kw_only=True)
class Row:
    """One row of the table: a uniform distribution, and the probability with which it is applied."""

    name: str
    low: tuple[float, ...]
    high: tuple[float, ...]
    unit: str
    probability: float = 1.0

    @property
    def absent(self) -> np.ndarray:
        """Value when nothing is drawn: the middle of the range."""
        return (np.array(self.low) + np.array(self.high)) / 2


def symmetric(name: str, half: float | Sequence[float], unit: str) -> Row:
    """Row with a uniform distribution U(−half, half) for each component."""
    halves = tuple(np.atleast_1d(half).tolist())
    return Row(name=name, low=tuple(-h for h in halves), high=halves, unit=unit)


OBJECT_FRICTION = Row(name="friction", low=(0.3,), high=(0.7,), unit="1")
_DEG = math.pi / 180

PAPER_ROWS: dict[str, tuple[Row, ...]] = {
    "bench": (),
    # The table says Δp ∈ [−0.03, 0.03] m for a part that stands on the table: x and y.
    **dict.fromkeys(
        ("assembly_1", "assembly_2"),
        (
            OBJECT_FRICTION,
            symmetric("plug_position", (0.03, 0.03), "m"),
            symmetric("socket_position", (0.03, 0.03), "m"),
            symmetric("plug_mass", 0.03, "kg"),
            symmetric("socket_mass", 0.03, "kg"),
        ),
    ),
    "puzzle": (
        OBJECT_FRICTION,
        symmetric("tray_position", (0.005, 0.005), "m"),
        symmetric("tray_yaw", 5 * _DEG, "rad"),
        *(symmetric(f"{piece}_position", (0.01, 0.01), "m") for piece in ("circle", "heart", "triangle")),
        *(symmetric(f"{piece}_yaw", 10 * _DEG, "rad") for piece in ("circle", "heart", "triangle")),
        symmetric("circle_support", (0.03, 0.03), "m"),
        symmetric("heart_support", (0.03, 0.027), "m"),
        symmetric("triangle_support", (0.03, 0.027), "m"),
    ),
    "test_tube": (
        OBJECT_FRICTION,
        symmetric("tube_position", (0.02, 0.02), "m"),
        symmetric("tube_yaw", 20 * _DEG, "rad"),
        symmetric("holder_position", (0.005, 0.005), "m"),
    ),
}
"""Task → rows, values of the paper's table "Domain randomization parameter values"."""


def draw(rows: Sequence[Row], rng: np.random.Generator, scale: float = 1.0) -> dict[str, np.ndarray]:
    """One draw of every row; ``scale`` shrinks the ranges about their absent value, 0 gives the nominal scene.

    The number of random draws does not depend on the probabilities, so that one row does not change another.
    """
    values = {}
    for row in rows:
        low, high = np.array(row.low), np.array(row.high)
        made = rng.random() < row.probability
        value = rng.uniform(low, high)
        values[row.name] = row.absent + scale * (value - row.absent) if made else row.absent
    return values

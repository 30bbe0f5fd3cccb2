"""Domain randomisation at reset: rows of uniform distributions, drawn per simulation. Each task states its own (``Task.rows``).

Image rows are no part of a simulation: training draws them for each image (taccorl/policies/tactile_pi05/image_randomization.py),
rollouts with ``--pictures=randomised`` for each scene and camera (``scene_pictures.py`` beside it).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, kw_only=True)
class Row:
    """One row of the table of domain randomisation: a uniform distribution, and the probability with which it is applied."""

    name: str
    low: tuple[float, ...]
    """Lower bound of each component, in ``unit``; ``high`` likewise."""
    high: tuple[float, ...]
    unit: str
    probability: float = 1.0
    """Probability that a reset draws the row; otherwise it has the value ``absent``."""

    @property
    def absent(self) -> np.ndarray:
        """Value (components,) of the row in the nominal scene: the middle of the range."""
        return (np.array(self.low) + np.array(self.high)) / 2


def symmetric(name: str, half: float | Sequence[float], unit: str) -> Row:
    """Row with the uniform distribution U(−half, half) for each component, in ``unit``."""
    halves = tuple(np.atleast_1d(half).tolist())
    return Row(name=name, low=tuple(-h for h in halves), high=halves, unit=unit)


OBJECT_FRICTION = Row(name="friction", low=(0.3,), high=(0.7,), unit="1")
"""Sliding friction coefficient of all parts."""


def draw(
    rows: Sequence[Row], rng: np.random.Generator, scale: float = 1.0
) -> dict[str, np.ndarray]:
    """Draw a value for every one of ``rows``: name → (components,) in the row's unit.

    ``scale`` multiplies the ranges about their middle; 0 gives the nominal scene. The number of random draws does not depend on
    the probabilities, so that one row does not change another."""
    values = {}
    for row in rows:
        low, high = np.array(row.low), np.array(row.high)
        made = rng.random() < row.probability
        value = rng.uniform(low, high)
        values[row.name] = (
            row.absent + scale * (value - row.absent) if made else row.absent
        )
    return values

"""Improvement of one model over another on recordings to which neither was fitted, block by block, with its uncertainty."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from taccorl.alignment.measurements.correlation import block_sums
from taccorl.diagnosis.search.fit import Fit, layout_of, stacked
from taccorl.diagnosis.search.problem import Problem, Recording


@dataclass(frozen=True)
class Blocks:
    """Squared residuals per block of time."""

    squares: np.ndarray
    """(B,) mean squared residual of each block, in floors²."""
    weights: np.ndarray
    """(B,) share of all measured entries that each block holds; they add up to 1."""

    @property
    def mean(self) -> float:
        """Mean squared residual over all entries [floors²]."""
        return float(self.weights @ self.squares)

    def __sub__(self, other: "Blocks") -> "Blocks":
        return Blocks(self.squares - other.squares, self.weights)


def block_squares(
    problem: Problem, model: Fit, recordings: Sequence[Recording]
) -> Blocks:
    """Squared residuals of ``recordings`` in blocks of ``correlation.BLOCK_S``, all channels of a block together."""
    squares, layout = (
        np.square(stacked(problem, model.values, model.effects, recordings)),
        layout_of(recordings),
    )
    total, count = (
        block_sums(squares, layout),
        block_sums(np.ones(len(squares)), layout),
    )
    return Blocks(total / count, count / max(len(squares), 1))


def standard_score(blocks: Blocks) -> float:
    """Weighted mean divided by its standard error, with independent blocks: 2 is hardly chance. A single block gives 0."""
    count = len(blocks.squares)
    if count < 2:
        return 0.0
    scatter = (blocks.weights * (blocks.squares - blocks.mean)) ** 2
    error = float(np.sqrt(scatter.sum() * count / (count - 1)))
    return blocks.mean / error if error > 0 else 0.0


def bic_gain(parent: Fit, child: Fit, more_parameters: int) -> float:
    """Decrease of the Bayesian information criterion from ``parent`` to ``child``: 10 is strong evidence (Kass and
    Raftery 1995); negative if the criterion rises.

    The noise is known (residuals are in floors), and the residual of ``child`` above
    one floor also counts as noise. The number of rows is that of independent residuals
    of ``child``; ``parent`` may be of other recordings. ``more_parameters``: those that
    ``parent`` lacks."""
    rows = child.effective_rows
    fallen = (parent.error**2 - child.error**2) / max(1.0, child.error**2)
    return fallen * rows - more_parameters * float(np.log(rows))


def gain_of(after: Blocks, before: Blocks) -> float:
    """Share of the validation squared error above the floor, and of at least one squared floor, that a model removes.
    Negative: the model is worse; below the floor none is better than another. ``after, before``: squares of the model, and of
    the one with which it is compared [floors²]."""
    return (above_floor(before) - above_floor(after)) / max(before.mean - 1.0, 1.0)


def above_floor(squares: Blocks) -> float:
    """Mean squared validation error [floors²], at least that of one floor, below which no model is better than another."""
    return max(squares.mean, 1.0)

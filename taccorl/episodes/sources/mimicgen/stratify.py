"""Stratified generation: the reset space cut into boxes, and attempts chosen to fill boxes with few episodes
(``--stratify=true``).

The paper draws uniformly; where attempts fail more often, fewer episodes are left. What attempt k draws is known without
simulating it, so that after a first half of the attempts as they come, each round considers the next numbers, simulates those
whose draws lie where most episodes are missing, and skips the others.

    fair share of a box   N / boxes of its row, for N episodes wanted
    need of a box         max(0, 1 − episodes kept there / fair share); 0 once it is given up
    need of a draw        Σ need² over the boxes that it lies in, one in each row

Rows are counted one by one: a box of one row is filled with any draw of the others. A round follows from the rounds before it
alone, so it is the same for any number of workers and after an interruption.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from taccorl.sim.randomize import Row

SPLITS = {1: 4, 2: 3}  # of each component, for rows of one and of two components
LOOK_AHEAD = 4  # numbers that a round looks at, for each that it simulates
GIVE_UP_FAILED, GIVE_UP_YIELD = (
    20,
    0.1,
)  # failed attempts in a box, and the share of successes below which it is given up

Boxes = tuple[int, ...]
"""Box of a draw in each row, by index."""


@dataclass(frozen=True)
class ResetSpace:
    """Space of the randomisation at reset: the rows of the task's table, each cut into equal boxes."""

    rows: tuple[Row, ...]
    scale: float
    """Factor on the ranges that are drawn from."""

    def limits(self, row: Row) -> tuple[np.ndarray, np.ndarray]:
        """Return the lowest and the highest drawn values, (components,) each."""
        low, high = (row.absent + self.scale * (np.array(ends) - row.absent) for ends in (row.low, row.high))
        return low, high

    def shape(self, row: Row) -> tuple[int, ...]:
        """Number of boxes of a row along each component."""
        return (SPLITS.get(len(row.low), 1),) * len(row.low)

    def num_boxes(self, row: Row) -> int:
        return math.prod(self.shape(row))

    def edges(self, row: Row, box: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the lowest and the highest values of a box, (components,) each."""
        low, high = self.limits(row)
        size = (high - low) / self.shape(row)
        start = low + np.array(np.unravel_index(box, self.shape(row))) * size
        return start, start + size

    def boxes(self, drawn: Mapping[str, np.ndarray]) -> Boxes:
        """For each row, in the order of ``rows``, the index of the box in which a draw lies. ``drawn``: name of the row →
        (components,).
        """
        found = []
        for row in self.rows:
            (low, high), shape = self.limits(row), self.shape(row)
            place = np.clip(((drawn[row.name] - low) / (high - low) * shape).astype(int), 0, np.array(shape) - 1)
            found.append(int(np.ravel_multi_index(tuple(place), shape)))
        return tuple(found)

    def count(self, draws: Iterable[Boxes]) -> list[np.ndarray]:
        """For each row, in the order of ``rows``: (boxes,) number of ``draws`` in each box."""
        counts = [np.zeros(self.num_boxes(row)) for row in self.rows]
        for boxes in draws:
            for r, box in enumerate(boxes):
                counts[r][box] += 1
        return counts


def first_attempts(episodes: int) -> int:
    """Numbers of the first attempts 0, 1, …, which are not selected: half of the episodes, after which hardly any box is full."""
    return -(-episodes // 2)


def given_up(kept: np.ndarray, failed: np.ndarray) -> np.ndarray:
    """(boxes,) bool: boxes in which hardly any attempt succeeds, and for which no more attempts are chosen.

    ``kept`` and ``failed`` (boxes,) are the numbers of successes and failures so far.
    """
    return (failed >= GIVE_UP_FAILED) & (kept < GIVE_UP_YIELD * (kept + failed))


def next_round(
    space: ResetSpace, boxes_of: Callable[[int], Boxes], episodes: int, done: Sequence[tuple[int, bool]]
) -> list[int]:
    """Numbers of the attempts of the next round, ascending. ``boxes_of``: function that returns the boxes of an attempt's draw.
    ``done``: (number, success) of all attempts of the rounds before, in order."""
    size, first = min(max(episodes // 10, 4), 100), first_attempts(episodes)
    if len(done) < first:
        return list(range(len(done), min(first, len(done) + 100)))
    kept, failed = (space.count(boxes_of(k) for k, success in done if success is wanted) for wanted in (True, False))
    fillable = [~given_up(*counts) for counts in zip(kept, failed, strict=True)]
    start = first + (len(done) - first) // size * size * LOOK_AHEAD
    seen = {k: boxes_of(k) for k in range(start, start + size * LOOK_AHEAD)}

    def need(k: int) -> float:
        shares = (kept[r][box] * len(kept[r]) / episodes for r, box in enumerate(seen[k]) if fillable[r][box])
        return sum(max(0.0, 1 - share) ** 2 for share in shares)

    taken = []
    for _ in range(size):
        taken.append(max(seen, key=need))  # the lowest number of equals
        for r, box in enumerate(seen.pop(taken[-1])):
            kept[r][box] += 1  # as if it succeeded, so that a round does not fill one box only
    return sorted(taken)

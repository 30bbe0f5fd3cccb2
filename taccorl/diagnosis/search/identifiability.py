"""Identifiability before any fit: which effects these recordings can show, and which they cannot separate.

Every effect is simulated at a typical strength, without the part that the always fitted numbers can reproduce.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from taccorl.diagnosis.search.fit import Fit
from taccorl.diagnosis.search.problem import Problem, Recording
from taccorl.diagnosis.search.screen import alike, probe

VISIBLE = 0.75
"""Least RMS of a signature for a visible effect [floors]: √(1 + 0.75²) = 1.25, the error above which the search looks for an
effect."""
ALIKE = 0.95
"""|cos| of two signatures above which recordings do not separate two effects; a choice."""
RIDGE = 0.999
"""|correlation| of two fitted numbers above which only a combination of them is known."""


@dataclass(frozen=True, kw_only=True)
class Identifiability:
    """Effects that a set of recordings can show and separate, independent of the measured values."""

    visible: dict[str, float]
    """Effect → RMS residual that it would cause at a typical strength [floors]."""
    pairs: tuple[tuple[str, str, float], ...]
    """(one, other, |cos|) of visible effects that these recordings do not separate, the most similar first."""
    ridges: tuple[tuple[str, str, float], ...]
    """(one, other, correlation) of always fitted numbers of which only a combination is known."""

    @property
    def invisible(self) -> tuple[str, ...]:
        """Effects whose RMS residual is below ``VISIBLE``: these recordings cannot show them."""
        return tuple(name for name, size in self.visible.items() if size < VISIBLE)


def identifiability(
    problem: Problem, recordings: Sequence[Recording], here: Fit
) -> Identifiability:
    """Probe all candidates beside the effects of ``here``.

    Args:
        here: fit of the always fitted numbers to ``recordings``, with the machine's effects.
    """
    problem.learn(here.values)
    typical = [
        dataclasses.replace(c, starts=(c.starts[len(c.starts) // 2],))
        for name, c in problem.candidates.items()
        if name not in here.names
    ]
    probes = probe(problem, recordings, here, typical)
    shown = [p for p in probes if p.visible >= VISIBLE]
    pairs = [
        (a.name, b.name, alike(a, b))
        for k, a in enumerate(shown)
        for b in shown[k + 1 :]
    ]
    return Identifiability(
        visible={p.name: p.visible for p in probes},
        pairs=tuple(sorted((p for p in pairs if p[2] > ALIKE), key=lambda p: -p[2])),
        ridges=tuple(_ridges(here)),
    )


def _ridges(model: Fit) -> list[tuple[str, str, float]]:
    spread = model.covariance()
    size = np.sqrt(np.diag(spread))
    with np.errstate(invalid="ignore", divide="ignore"):
        correlation = spread / np.outer(size, size)
    over = np.argwhere(np.triu(np.abs(correlation) > RIDGE, 1))
    pairs = [
        (model.frees[i].name, model.frees[j].name, float(correlation[i, j]))
        for i, j in over
    ]
    return sorted(pairs, key=lambda p: -abs(p[2]))

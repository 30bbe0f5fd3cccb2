"""Screening: the signature that each effect would leave in these recordings, beyond what the fitted numbers can reproduce.

There is one probe simulation for each start of each effect. Its difference from the fitted model, without the part that a change
of the fitted numbers can reproduce (projection), is the effect's *signature* in these recordings. A score test (Rao) estimates
the share of the residual that the signature explains; the angle between two signatures shows whether these recordings can
separate the two effects.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from taccorl.diagnosis.search.fit import Fit, stacked_all
from taccorl.diagnosis.search.problem import Candidate, Problem, Recording, Values
from taccorl.sim.effects.effect import Parameter

INVISIBLE = 1e-6
"""RMS of a signature [floors] that is no more than rounding."""
TOO_STRONG, WEAKENED = 3.0, 4
"""A start whose signature exceeds the residual by this factor is weakened, at most so many times: a simulation in which friction
stops the arm gives no information about a small friction."""
FAR_OFF = 10.0
"""Factor beyond which a multiple of a signature is not used, because the response is no longer proportional; 2 for effects that
are absent at infinity."""
WRONG_SIGN = 0.1
"""Share of its explanation with which an effect is ranked if its start has the wrong sign."""


@dataclass(frozen=True)
class Probe:
    """Change of the simulated signals that one candidate effect, at one of its start values, would cause in the recordings."""

    name: str
    start: Values
    """Parameters of the effect in this simulation."""
    signature: np.ndarray
    """(n,) signature [floors], without the part that the fitted numbers can reproduce."""
    explained: float
    """Share of the squared residual that its best multiple within reach removes, 0 … 1."""
    multiple: float
    """The best multiple; 1 is an effect as strong as the start."""

    @property
    def visible(self) -> float:
        """RMS of ``signature``, the change that the fitted numbers cannot reproduce, in noise floors; near 0: the recordings
        cannot show this effect."""
        return float(np.sqrt(np.mean(np.square(self.signature))))

    def scaled(self, c: Candidate) -> Values:
        """The start of the effect ``c`` with its strength multiplied as the score test suggests, within its bounds."""
        values = {f.name: f.start for f in c.frees} | self.start
        if can_fade(c) and c.frees[0].log and self.multiple > 0:
            strength, by = c.frees[0], min(max(self.multiple, 0.1), 10.0)
            values[strength.name] = strength.within(by * values[strength.name])
        return values


def is_likely(c: Candidate) -> bool:
    """Whether the effect is fitted even if a small amount of it explains little: a limit has no effect until it is reached, and a
    small delay or lag looks like changed gains."""
    return bool(c.frees) and (not can_fade(c) or c.frees[0].unit == "s")


def probe(
    problem: Problem,
    recordings: Sequence[Recording],
    parent: Fit,
    candidates: Sequence[Candidate],
) -> list[Probe]:
    """Probe every start of every candidate, in addition to the effects of ``parent``; one item per start, in the order of
    ``candidates``.

    Args:
        recordings: recordings to which ``parent`` was fitted.
    """
    # A number at its bound makes up for half of what its slope says; it does not hide an effect of the other half (a delay of
    # the loop is less inertia, an armature is more).
    taken_up = _basis(
        parent.jacobian[:, [f.name not in parent.at_bound for f in parent.frees]]
    )
    left = parent.residuals - taken_up @ (taken_up.T @ parent.residuals)
    power = float(left @ left)
    most = TOO_STRONG * max(parent.error, 1.0)

    def signatures_of(trials: Sequence[tuple[Candidate, Values]]) -> list[np.ndarray]:
        found, cases = [], []
        for c, start in trials:
            values = parent.values | {f.name: f.start for f in c.frees} | start
            cases.append(
                (
                    values,
                    problem.prepare(
                        values, [*parent.effects, c.make(values)], recordings
                    ),
                )
            )
        for first in range(
            0, len(cases), 8 * problem.at_once
        ):  # not all, which may not fit into memory
            change = (
                stacked_all(
                    problem, cases[first : first + 8 * problem.at_once], recordings
                )
                - parent.residuals
            )
            found += list(change - (change @ taken_up) @ taken_up.T)
        return found

    trials = [(c, start) for c in candidates for start in c.starts]
    signatures = signatures_of(trials)
    for _ in range(WEAKENED):
        weaker = {}
        for k, (c, start) in enumerate(trials):
            size = float(np.sqrt(np.mean(np.square(signatures[k]))))
            if (
                size > most
                and (less := _weaker(c, start, 0.5 * most / size)) is not None
            ):
                weaker[k] = trials[k] = c, less
        for k, signature in zip(weaker, signatures_of([*weaker.values()]), strict=True):
            signatures[k] = signature
    probes = []
    for (c, start), signature in zip(trials, signatures, strict=True):
        own = float(signature @ signature)
        if own <= len(signature) * INVISIBLE**2 or power == 0.0:
            probes.append(Probe(c.name, start, np.zeros_like(signature), 0.0, 0.0))
            continue
        along = -float(signature @ left)
        best = along / own
        reach = FAR_OFF if can_fade(c) else 2.0
        within = min(max(best, 1.0 / reach), reach)
        share = (
            (2.0 * within * along - within * within * own) / power
            if best > 0
            else WRONG_SIGN * best * along / power
        )
        probes.append(Probe(c.name, start, signature, max(share, 0.0), best))
    return probes


def _weaker(c: Candidate, start: Values, share: float) -> Values | None:
    """The start with so much less of the effect; None for one that is absent at infinity, or hardly there already."""
    strength = _strength(c)
    if strength.absent is None or not can_fade(c):
        return None
    name = f"{c.name}.{strength.name}"
    free = next(f for f in c.frees if f.name == name)
    now = start.get(name, free.start)
    less = strength.absent + max(share, 0.03) * (now - strength.absent)
    return (
        start | {name: less}
        if abs(free.value(free.coordinate(less)) - less) < 1e-9 * abs(less) + 1e-15
        else None
    )


def _strength(c: Candidate) -> Parameter:
    return next(p for p in c.cls.parameters() if p.absent is not None)


def can_fade(c: Candidate) -> bool:
    """True if the effect has a fitted parameter whose absent value is finite, so that it can be scaled down to nothing; False
    for a limit that is absent at infinity."""
    absent = _strength(c).absent
    return bool(c.frees) and absent is not None and bool(np.isfinite(absent))


def alike(one: Probe, other: Probe) -> float:
    """|cos| of the angle between two signatures, 0 … 1; 1 if these recordings cannot separate the effects."""
    norms = float(np.linalg.norm(one.signature) * np.linalg.norm(other.signature))
    return abs(float(one.signature @ other.signature)) / norms if norms > 0 else 0.0


def _basis(jacobian: np.ndarray) -> np.ndarray:
    """Orthonormal columns (n, r) of what the fitted numbers can do."""
    size = np.linalg.norm(jacobian, axis=0)
    columns = jacobian[:, size > 0] / size[size > 0]
    if columns.shape[1] == 0:
        return columns
    left, singular, _ = np.linalg.svd(columns, full_matrices=False)
    return left[:, singular > 1e-6 * singular[0]]

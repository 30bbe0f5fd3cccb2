"""The plain fit: what one least-squares fit of the usual numbers leaves. Every answer is judged beside it.

Gains, a constant torque, inertia, viscous and dry friction, and a delay of the targets are
fitted together, once, to the recordings of the fit: what anybody fits to a drive without
asking which effect is missing. An answer that leaves as much has found no more than that.
"""

import copy
import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

from taccorl.diagnosis.search.fit import fit, rms, stacked
from taccorl.diagnosis.search.problem import Free, Problem, Recording, Values

EFFECTS = ("armature", "viscous_friction", "coulomb_friction", "command_delay")
"""Effects of the plain fit; those that a part cannot have are left out."""
TIMING = ("loop_s", "position_age_s", "speed_delay_s", "effort_age_s")
"""Numbers of a drive's loop that stay as the file has them."""
GAIN_RANGE = 100.0
"""Largest factor between a gain and its value in the file (a choice)."""
STEPS = 25
"""Most steps of the solver."""


@dataclass(frozen=True, kw_only=True)
class PlainFit:
    """Result of the plain fit."""

    values: Values
    """Number → value in the unit of its parameter. Positions alone determine only ratios of
    torques, and the sum of K_d and viscous friction: single ones may be anything then."""
    at_bound: tuple[str, ...]
    """Names of the numbers that ended at one of their bounds."""
    errors: dict[str, float]
    """fit, validation, test → RMS error [floors]."""
    cpu_s: float
    """CPU time [s]."""


def plain_fit(
    problem: Problem,
    fit_to: Sequence[Recording],
    validation: Sequence[Recording],
    test: Sequence[Recording],
    start: Mapping[str, float],
    present: Sequence[str] = (),
    held: Collection[str] = (),
) -> PlainFit | None:
    """Fit the usual numbers of a drive; None for a part that is none (a sensor, a pad).

    Args:
        fit_to, validation, test: recordings, as for ``search.diagnose``; only the first
            are fitted.
        start: values of the machine's file, from which gains start.
        present: effects of the machine's file, which are fitted, too.
        held: numbers and effects of the file that its user knows.
    """
    if "coulomb_friction" not in problem.candidates:
        return None
    known = {*problem.candidates} - {*held}
    names = [*present, *(n for n in EFFECTS if n in known and n not in present)]
    began = time.process_time()
    usual = copy.copy(problem)
    usual.base = (*_without_timing(problem, start), *_gains(problem, start, held))
    first = [problem.candidates[name].starts[:1] for name in names]
    starts = {k: v for some in first for own in some for k, v in own.items()}
    model = fit(usual, fit_to, names, {**starts, **start}, STEPS)
    uses = {"fit": fit_to, "validation": validation, "test": test}
    return PlainFit(
        values=dict(model.values),
        at_bound=model.at_bound,
        errors={
            use: rms(stacked(usual, model.values, model.effects, some))
            for use, some in uses.items()
            if some
        },
        cpu_s=time.process_time() - began,
    )


def _without_timing(problem: Problem, start: Mapping[str, float]) -> list[Free]:
    """Always fitted numbers; targets may also be early where a delay is fitted."""
    return [
        replace(f, start=start.get(f.name, f.start), held=True)
        if f.name in TIMING
        else replace(f, unless=())
        for f in problem.base
    ]


def _gains(
    problem: Problem, start: Mapping[str, float], held: Collection[str]
) -> list[Free]:
    """Gains that the problem keeps fixed; of a motor by voltage its stall torque is free."""
    fitted = {f.name for f in problem.base}
    if "stall_nm" in fitted:
        return []
    found = []
    for name in ("kp", "kd"):
        value = start.get(name, 0.0)
        if name not in fitted and name not in held and value > 0.0:
            low, high = value / GAIN_RANGE, value * GAIN_RANGE
            gain = Free(name=name, unit="", start=value, low=low, high=high, log=True)
            found.append(gain)
    return found

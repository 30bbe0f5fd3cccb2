"""Recordings of a slide with hidden effects, by the twin's own equations, for ``pairs``.

They have a random torque, noise, and other values of the numbers that every fit adjusts.

Letters in shapes: T rows.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from taccorl.alignment.measurements.folder import Measurements
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.alignment.measurements.motions import (
    AGAIN,
    CHIRP,
    PACK,
    TEST,
    VALIDATION,
    Motion,
)
from taccorl.data.origin import Origin
from taccorl.diagnosis.experiment_design.motions import EFFORT_NOISE_SHARE, Ground
from taccorl.diagnosis.machines.machine import Addition
from taccorl.diagnosis.search.fit import fit, rms
from taccorl.diagnosis.search.problem import Candidate, Recording, Values
from taccorl.diagnosis.search.solve import RecordedProblem
from taccorl.errors import TaccorlError
from taccorl.sim.effects.effect import Effect
from taccorl.surrogate.robot import coloured

NOISE_SHARE = 2e-4
"""Noise of positions, as a share of half the range."""
DISTURBANCE_SHARE, DISTURBANCE_S = 2e-3, 0.05
"""Random torque, as a share of the largest effort, and its correlation time [s]."""
SPREAD = 0.05
"""Standard deviation of the logarithms by which fitted numbers differ from the file."""
ADJUSTED = ("inertia", "kp", "kd", "stall_nm", "back_emf")
"""Numbers that differ from the file, where every fit adjusts them."""
FLOORS = (3.0, 20.0)
"""Range of strengths: error without the effect after a refit [noise floors]."""
LEAST_FLOORS = 1.5
"""An effect that leaves less is refused, because no recording would show it."""
TRIES, STEPS = 5, 8
_USES: dict[str, tuple[Motion, ...]] = {
    "fit": (CHIRP, AGAIN, *(m for m in PACK if m.gain == 1.0 and not m.payload_kg)),
    "validation": VALIDATION,
    "test": TEST,
}


@dataclass(frozen=True, kw_only=True)
class SlideCase:
    """The machine of a file, with hidden effects and other numbers at one part."""

    ground: Ground
    """Machine, part and range of motion."""
    seed: int
    """Seed of everything that is drawn."""
    hidden: tuple[Effect, ...]
    """The hidden effects."""
    numbers: Mapping[str, float]
    """Numbers that differ from the file."""


def draw_slide(ground: Ground, seed: int, effects: Sequence[str]) -> SlideCase:
    """Draw strengths of ``effects`` and other numbers for one part.

    Raises TaccorlError: an effect would not show at any strength."""
    rng = np.random.default_rng([seed, 61])
    plain = SlideCase(ground=ground, seed=seed, hidden=(), numbers={})
    made = recordings(plain, ("fit",))
    problem = ground.machine.motion_problem(ground.part, made, "auto")
    efforts = [np.abs(m.effort[:, m.column(ground.part)]).max() for m in made.fit]
    effort_floor = EFFORT_NOISE_SHARE * float(np.nanmax([*efforts, 1e-12]))
    floors = np.array([NOISE_SHARE * ground.room.wide_rad, effort_floor])
    measured = [
        dataclasses.replace(r, floor=floors[: len(r.channels)]) for r in problem.fit
    ]
    numbers = {
        f.name: problem.start.get(f.name, f.start)
        * math.exp(SPREAD * rng.standard_normal())
        for f in problem.base
        if f.name in ADJUSTED and not f.held
    }
    hidden: list[Effect] = []
    for name in effects:
        size = float(np.exp(rng.uniform(*np.log(FLOORS))))
        effect, error = _sized(problem, problem.candidates[name], measured, size, rng)
        if error < LEAST_FLOORS:
            raise TaccorlError(f"{name} leaves {error:.2f} noise floors at most")
        hidden.append(effect)
    return dataclasses.replace(plain, hidden=tuple(hidden), numbers=numbers)


def _sized(
    problem: RecordedProblem,
    c: Candidate,
    recordings_: Sequence[Recording],
    wanted: float,
    rng: np.random.Generator,
) -> tuple[Effect, float]:
    """The effect in the strength that leaves about ``wanted`` floors, or in the strongest
    possible, and the error that it leaves [noise floors]."""
    strength = next(p for p in c.cls.parameters() if p.absent is not None)
    absent, key = float(strength.absent or 0.0), f"{c.name}.{strength.name}"
    values: Values = (
        dict(problem.start)
        | {f.name: f.start for f in c.frees}
        | c.starts[int(rng.integers(len(c.starts)))]
    )
    best, error = c.make(values), _error(problem, c, values, recordings_)
    ends = dict[bool, float]()
    for _ in range(TRIES):
        if wanted / 1.5 <= error <= 1.5 * wanted:
            break
        factor = min(max(wanted / max(error, 1e-3), 0.1), 10.0)
        own = getattr(best, strength.name)
        ends[error > wanted] = own
        new = own / factor
        if math.isfinite(absent):
            new = absent + (own - absent) * factor
        if len(ends) == 2:  # one too low and one too high are known: halve the range
            new = sum(ends.values()) / 2
        new = min(max(new, strength.low), strength.high)
        if new == own:
            break
        tried = values | {key: new}
        best, error = c.make(tried), _error(problem, c, tried, recordings_)
    return best, error


def _error(
    problem: RecordedProblem,
    c: Candidate,
    values: Values,
    recordings_: Sequence[Recording],
) -> float:
    """Error without the effect after a refit [noise floors]; 0 if the machine diverges
    with it."""
    present = [problem.candidates[name].make(problem.start) for name in problem.present]
    made = [
        dataclasses.replace(
            r, measured=problem.simulate(values, [*present, c.make(values)], r)
        )
        for r in recordings_
    ]
    if not all(np.isfinite(r.measured).all() for r in made):
        return 0.0
    return rms(fit(problem, made, problem.present, problem.start, STEPS).residuals)


def recordings(
    case: SlideCase, uses: Sequence[str] = ("fit", "validation", "test")
) -> Measurements:
    """Simulated recordings of a case: the paper's sweep twice, a triangle, steps and a
    small chirp for the fit; other motions for validation and test. Motions that need too
    much effort are made smaller, or left out.

    Args:
        uses: of ``fit``, ``validation`` and ``test``, those that are simulated.
    """
    ground = case.ground
    addition = Addition(ground.part, list(case.hidden), case.numbers, {})
    hidden = dataclasses.replace(
        ground, machine=ground.machine.with_additions([addition])
    )
    sides: dict[str, list[Measurement]] = {"fit": [], "validation": [], "test": []}
    for use in uses:
        for motion in _USES[use]:
            try:
                planned, effort = ground.fitted(motion)
            except TaccorlError:
                continue
            counts = [len(side) for side in sides.values()]
            rng = np.random.default_rng([case.seed, 62, *counts])
            sides[use].append(_recorded(hidden, planned, effort, motion, rng))
    return Measurements(
        *(tuple(sides[use]) for use in ("fit", "validation", "test")), rule="by name"
    )


def _recorded(
    ground: Ground,
    planned: Measurement,
    effort: np.ndarray,
    motion: Motion,
    rng: np.random.Generator,
) -> Measurement:
    """The answer of the machine in ``ground`` to a planned motion, with noise and a random
    torque in proportion to its ``effort`` (T,)."""
    j, rows = planned.column(ground.part), planned.num_rows
    peak = float(np.abs(effort).max())
    keep = math.exp(-1.0 / (ground.rate_hz * DISTURBANCE_S))
    kicks, load = rng.standard_normal(rows), np.zeros_like(planned.target)
    kicks[0] = 0.0
    load[:, j] = DISTURBANCE_SHARE * peak * coloured(kicks, keep)
    answered, efforts = ground.answered(dataclasses.replace(planned, load=load))
    measured = answered.measured.copy()
    measured[:, j] += NOISE_SHARE * ground.room.wide_rad * rng.standard_normal(rows)
    logged = np.full_like(measured, np.nan)
    if ground.has_effort:
        logged[:, j] = efforts + EFFORT_NOISE_SHARE * peak * rng.standard_normal(rows)
    return dataclasses.replace(
        planned,
        measured=measured,
        effort=logged,
        name=motion.name,
        repeat_of=motion.repeat_of,
        origin=Origin("surrogate", "simulated by the equations of the twin"),
    )

"""Recordings of a simulated joint or axis with hidden effects, made from the user's own file, to try ``taccorl compare`` and
``diagnose`` on a machine before anything is recorded on it.

The recordings are computed by the twin's own equations, with a random torque, noise, and other values of the numbers that every
fit adjusts: what is found here is found more easily than on a real machine. Simulations that are independent of the twin are in
``taccorl.surrogate``.

FOLDER/sweeps/*.csv, columns.yaml, measurements.yaml    for ``taccorl compare`` and ``diagnose``
FOLDER/sealed_truth.json                                what is hidden; ``taccorl surrogate --reveal=FOLDER`` prints it

Letters in shapes: T rows.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

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
from taccorl.diagnosis.machines.machine import Addition, Machine
from taccorl.diagnosis.search.fit import fit, rms
from taccorl.diagnosis.search.problem import Candidate, Recording, Values
from taccorl.diagnosis.search.solve import RecordedProblem
from taccorl.errors import TaccorlError, nearest
from taccorl.sim.effects.effect import Effect
from taccorl.surrogate.robot import coloured
from taccorl.surrogate.writing import SWEEPS, write_tables

ORIGIN = "simulated by the equations of the twin (taccorl surrogate --twin)"
NOISE_SHARE = 2e-4
"""Noise of positions, as a share of half the range."""
DISTURBANCE_SHARE, DISTURBANCE_S = 2e-3, 0.05
"""Random torque, as a share of the largest effort, and its correlation time [s]."""
SPREAD = 0.05
"""Standard deviation of the logarithms by which fitted numbers differ from the file."""
ADJUSTED = ("inertia", "kp", "kd", "stall_nm", "back_emf")
"""Numbers that differ from the file, where every fit adjusts them."""
FLOORS = (3.0, 20.0)
"""Range of strengths: error that remains without the effect after a refit [noise floors]."""
LEAST_FLOORS = 1.5
"""An effect that leaves less is not hidden, because no recording would show it."""
TRIES, STEPS = 5, 8
_USES: dict[str, tuple[Motion, ...]] = {
    "fit": (CHIRP, AGAIN, *(m for m in PACK if m.gain == 1.0 and not m.payload_kg)),
    "validation": VALIDATION,
    "test": TEST,
}


@dataclass(frozen=True, kw_only=True)
class Hidden:
    """A hidden effect."""

    effect: Effect
    floors: float
    """Error that remains without it after a refit of the numbers that are always fitted [noise floors]."""


@dataclass(frozen=True, kw_only=True)
class MachineSurrogate:
    """A simulated machine: that of a file, with hidden effects and other numbers at one part."""

    ground: Ground
    """Machine, part and range of motion."""
    seed: int
    """Seed of everything that is drawn."""
    hidden: tuple[Hidden, ...]
    """The hidden effects."""
    numbers: Mapping[str, float]
    """Numbers that differ from the file."""

    @property
    def machine(self) -> Machine:
        """The simulated machine, with what is hidden."""
        addition = Addition(
            self.ground.part, [h.effect for h in self.hidden], self.numbers, {}
        )
        return self.ground.machine.with_additions([addition])

    def truth(self) -> dict[str, Any]:
        """What is hidden, as JSON values for the sealed file: keys ``data``, ``seed``, ``part``, ``hidden`` (effects with their
        parameters) and ``numbers``."""
        effects = [
            {"effect": h.effect.name, "error_floors": round(h.floors, 2)}
            | {p.name: getattr(h.effect, p.name) for p in h.effect.parameters()}
            for h in self.hidden
        ]
        about = {"data": ORIGIN, "seed": self.seed, "part": self.ground.part}
        return about | {"hidden": effects, "numbers": dict(self.numbers)}


def draw_machine(
    ground: Ground,
    seed: int,
    effects: Sequence[str] | None = None,
    strength: float | None = None,
) -> MachineSurrogate:
    """Draw hidden effects and numbers for one part.

    Args:
        effects: names of the effects to hide; one that the recordings show is drawn if not given.
        strength: error that remains without each effect after a refit [noise floors]; drawn if not given.

    Raises TaccorlError: an effect cannot act on the part, or would not show at any strength."""
    rng = np.random.default_rng([seed, 61])
    plain = MachineSurrogate(ground=ground, seed=seed, hidden=(), numbers={})
    made = recordings(plain, ("fit",))
    problem = ground.machine.motion_problem(ground.part, made, "auto")
    efforts = [np.abs(m.effort[:, m.column(ground.part)]).max() for m in made.fit]
    effort_floor = EFFORT_NOISE_SHARE * float(np.nanmax([*efforts, 1e-12]))
    floors = np.array([NOISE_SHARE * ground.room.wide_rad, effort_floor])
    told = [
        dataclasses.replace(r, floor=floors[: len(r.channels)]) for r in problem.fit
    ]
    numbers = {
        f.name: problem.start.get(f.name, f.start)
        * math.exp(SPREAD * rng.standard_normal())
        for f in problem.base
        if f.name in ADJUSTED and not f.held
    }
    known = {
        name: c for name, c in problem.candidates.items() if name not in problem.present
    }
    for name in effects or ():
        if name not in known:
            raise TaccorlError(
                f"--effects: {name} cannot be hidden in {ground.part}; {nearest(name, known)}"
            )
    wanted = (
        [*effects]
        if effects is not None
        else [str(name) for name in rng.permutation(sorted(known))]
    )
    found: list[Hidden] = []
    for name in wanted:
        if effects is None and found:
            break
        size = strength or float(np.exp(rng.uniform(*np.log(FLOORS))))
        hidden = _sized(problem, known[name], told, size, rng)
        if hidden.floors >= LEAST_FLOORS:
            found.append(hidden)
        elif effects is not None:
            raise TaccorlError(
                f"--effects: {name} in {ground.part} leaves {hidden.floors:.2f} noise floors at its strongest, less than "
                f"{LEAST_FLOORS:g}: these motions do not show it; give a wider --span or a higher --speed, or another effect"
            )
    return dataclasses.replace(plain, hidden=tuple(found), numbers=numbers)


def _sized(
    problem: RecordedProblem,
    c: Candidate,
    recordings_: Sequence[Recording],
    wanted: float,
    rng: np.random.Generator,
) -> Hidden:
    """The effect in the strength that leaves about ``wanted`` floors, or in the strongest possible."""
    strength = next(p for p in c.cls.parameters() if p.absent is not None)
    absent, key = float(strength.absent or 0.0), f"{c.name}.{strength.name}"
    values: Values = (
        dict(problem.start)
        | {f.name: f.start for f in c.frees}
        | c.starts[int(rng.integers(len(c.starts)))]
    )
    best, ends = (
        Hidden(effect=c.make(values), floors=_left(problem, c, values, recordings_)),
        dict[bool, float](),
    )
    for _ in range(TRIES):
        if wanted / 1.5 <= best.floors <= 1.5 * wanted:
            break
        factor = min(max(wanted / max(best.floors, 1e-3), 0.1), 10.0)
        own = getattr(best.effect, strength.name)
        ends[best.floors > wanted] = own
        new = (
            absent + (own - absent) * factor if math.isfinite(absent) else own / factor
        )
        if (
            len(ends) == 2
        ):  # a strength that is too low and one that is too high are known: halve the range
            new = sum(ends.values()) / 2
        new = min(max(new, strength.low), strength.high)
        if new == own:
            break
        tried = values | {key: new}
        best = Hidden(
            effect=c.make(tried), floors=_left(problem, c, tried, recordings_)
        )
    return best


def _left(
    problem: RecordedProblem,
    c: Candidate,
    values: Values,
    recordings_: Sequence[Recording],
) -> float:
    """Error without the effect after a refit [noise floors]; 0 if the machine diverges with it."""
    present = [problem.candidates[name].make(problem.start) for name in problem.present]
    said = [
        dataclasses.replace(
            r, measured=problem.simulate(values, [*present, c.make(values)], r)
        )
        for r in recordings_
    ]
    if not all(np.isfinite(r.measured).all() for r in said):
        return 0.0
    return rms(fit(problem, said, problem.present, problem.start, STEPS).residuals)


def recordings(
    case: MachineSurrogate, uses: Sequence[str] = ("fit", "validation", "test")
) -> Measurements:
    """Simulated recordings of a case: the paper's sweep twice, a triangle, steps and a small chirp for the fit; other motions for
    validation and test. Motions that need too much effort are made smaller, or left out.

    Args:
        uses: of ``fit``, ``validation`` and ``test``, those that are simulated.
    """
    hidden, ground = case.machine, case.ground
    sides: dict[str, list[Measurement]] = {"fit": [], "validation": [], "test": []}
    for use in uses:
        for motion in _USES[use]:
            try:
                planned, effort = ground.fitted(motion)
            except TaccorlError:
                continue
            rng = np.random.default_rng(
                [
                    case.seed,
                    62,
                    len(sides["fit"]),
                    len(sides["validation"]),
                    len(sides["test"]),
                ]
            )
            sides[use].append(
                _recorded(
                    dataclasses.replace(ground, machine=hidden),
                    planned,
                    effort,
                    motion,
                    rng,
                )
            )
    if not sides["fit"]:
        raise TaccorlError(
            f"{ground.part}: no motion within {ground.room.speed_rad_per_s:g} per second needs less than its effort limit"
        )
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
    j, rows = planned.column(ground.part), planned.num_rows
    peak, keep = (
        float(np.abs(effort).max()),
        math.exp(-1.0 / (ground.rate_hz * DISTURBANCE_S)),
    )
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
        origin=Origin("surrogate", ORIGIN),
    )


def write_machine(case: MachineSurrogate, folder: Path) -> Measurements:
    """Write the recordings of a case as tables, and what is hidden in a sealed file. Raises FileExistsError: the folder
    exists."""
    made, part = recordings(case), case.ground.part
    drive = case.ground.machine.drive(part)
    target = "qd_target" if drive.target_kind == "velocity" else "q_target"
    units = {
        "q": drive.unit,
        target: drive.unit + ("/s" if target == "qd_target" else ""),
    }
    units |= (
        {"tau": "N" if drive.unit == "m" else "Nm"} if case.ground.has_effort else {}
    )
    columns = {
        key: {"column": f"{part}.{key}", "unit": unit} for key, unit in units.items()
    }
    spec = {
        "time": {"column": "t", "unit": "s"},
        "domain": "surrogate",
        "origin": ORIGIN,
        "signals": {part: columns},
    }

    def table(m: Measurement) -> dict[str, np.ndarray]:
        values = {"q": m.measured, target: m.target, "tau": m.effort}
        return {"t": m.time_s} | {
            f"{part}.{key}": values[key][:, m.column(part)] for key in units
        }

    write_tables(folder, SWEEPS, spec, made, table, case.truth())
    return made

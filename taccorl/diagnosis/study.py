"""How often the search is right, on surrogate robots whose hidden effects are known: one case at a time, as a row of numbers.

Rows of any number of machines and sessions add up in one file; ``pipelines/diagnosis_study.py`` makes them and writes the page.
"""

import dataclasses
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from taccorl.diagnosis.joint_problem import JointProblem
from taccorl.diagnosis.search import Diagnosis, SearchConfig, diagnose
from taccorl.diagnosis.surrogate.cases import draw_case
from taccorl.diagnosis.surrogate.recordings import recordings
from taccorl.diagnosis.surrogate.touch import draw_touch_case, touch_recordings
from taccorl.diagnosis.touch_problem import TouchProblem
from taccorl.sim.effects import effects as registry

MATERIAL = 1.5
"""Validation error in floors, once the gains are refitted, from which a hidden effect must be found."""


IDENTICAL = (
    frozenset({"coulomb_friction", "asymmetric_friction"}),
    frozenset({"command_delay", "sensor_delay"}),
    frozenset({"gravity_mismatch", "torque_scale"}),
    frozenset({"taxel_gain_map", "taxel_gain_spread"}),
    frozenset({"taxel_gain_map", "dead_taxels"}),
)
"""The same motion from either once gains and T_ref are refitted: F (1 + a sign v) is Coulomb and a constant torque; a loop that
hears late is one that tells late; all torques scaled are other gains and a wrongly carried weight; a map of gains holds spread
and dead taxels."""


@dataclass(frozen=True, kw_only=True)
class Job:
    """One surrogate robot to be diagnosed."""

    study: str
    hidden: tuple[str, ...]
    seed: int
    design: str
    strength: float | None = None
    without: tuple[str, ...] = ()
    """Effects that the search may not know."""

    @property
    def key(self) -> str:
        """The same for the same job, whenever it is run."""
        strength = "" if self.strength is None else f" at {self.strength:g}"
        return f"{self.study} {self.design} {'+'.join(self.hidden) or 'none'}{strength} seed {self.seed}"


def run(job: Job) -> dict[str, Any]:
    """Draw the robot, record it, diagnose it with gains that nobody knows and positions only: the hardest case."""
    began = time.process_time()
    case = draw_case(job.hidden, job.seed, strength=job.strength, design=job.design)
    made = recordings(case, job.design)
    recorded = time.process_time()
    problem = JointProblem(case.twin, case.signal, made, gains="fitted", effort=False)
    found = diagnose(
        problem,
        problem.fit,
        problem.validation,
        problem.test,
        start=problem.start,
        without=job.without,
        config=SearchConfig(max_effects=len(job.hidden) + 1),
    )
    done = time.process_time()
    return {
        "key": job.key,
        **dataclasses.asdict(job),
        "signal": case.signal,
        "left_floors": round(case.left_floors, 3),
        **told(found),
        "true": [{k: float(f"{v:.5g}") for k, v in h.values.items()} for h in case.hidden],
        "recording_cpu_s": round(recorded - began, 2),
        "cpu_s": round(done - recorded, 2),
    }


def run_touch(job: Job) -> dict[str, Any]:
    """The same for pads of one arm that press known objects."""
    began = time.process_time()
    case = draw_touch_case(job.hidden, job.seed, strength=job.strength)
    motions = touch_recordings(case).motions(case.twin)
    recorded = time.process_time()
    problem = TouchProblem([m for side in motions.values() for m in side], case.twin)
    fit_to, validation, test = problem.recordings(motions["fit"], motions["validation"], motions["test"])
    config = SearchConfig(max_effects=len(job.hidden) + 1)
    found = diagnose(problem, fit_to, validation, test, start=problem.start, without=job.without, config=config)
    done = time.process_time()
    return {
        "key": job.key,
        **dataclasses.asdict(job),
        "signal": f"{case.arm} pads",
        "left_floors": round(case.left_floors, 3),
        **told(found),
        "true": [{k: float(f"{v:.5g}") for k, v in h.values.items()} for h in case.hidden],
        "recording_cpu_s": round(recorded - began, 2),
        "cpu_s": round(done - recorded, 2),
    }


def told(found: Diagnosis) -> dict[str, Any]:
    """What a diagnosis says, in plain numbers."""
    ties = {r.added: list(r.ties) for r in found.rounds if r.added}
    return {
        "status": found.status,
        "found": list(found.names),
        "first": next((r.added for r in found.rounds), None),
        "ties": ties,
        "swapped": [list(pair) for pair in found.swapped],
        "rivals": {name: list(others) for name, others in found.rivals.items()},
        "errors": {k: {use: round(e, 4) for use, e in of.items()} for k, of in found.errors.items()},
        "estimate": {k: float(f"{v:.5g}") for k, v in found.after.values.items()},
        "interval": {k: [float(f"{v:.5g}") for v in ends] for k, ends in found.intervals.items()},
        "evaluations": found.evaluations,
    }


def material(row: dict[str, Any]) -> bool:
    """Whether there was something to find."""
    return row["errors"]["fitted"]["validation"] >= MATERIAL


def exact(row: dict[str, Any]) -> bool:
    """The hidden effects, and no other one, in the end; of one hidden effect that it was the first."""
    if len(row["hidden"]) == 1:
        return bool(row["found"]) and row["found"][0] == row["hidden"][0]
    return set(row["hidden"]) <= set(row["found"])


def named(row: dict[str, Any]) -> bool:
    """Each hidden effect is found, or named as a tie, rival or near-twin of one that is."""
    said = set(row["found"])
    for name in row["found"]:
        said |= {*row["ties"].get(name, ()), *row["rivals"].get(name, ()), *registry.get(name).near_twins}
    for name, other in row["swapped"]:
        said |= {name, other, *row["ties"].get(name, ())}
    return set(row["hidden"]) <= said


def exact_but_for_algebra(row: dict[str, Any]) -> bool:
    """As ``exact``, but that of effects which no position can ever tell apart either one will do."""
    found = row["found"] if len(row["hidden"]) > 1 else row["found"][:1]
    return all(any(h == f or any({h, f} <= group for group in IDENTICAL) for f in found) for h in row["hidden"])


def silently_wrong(row: dict[str, Any]) -> bool:
    """At the floor with effects none of which is hidden, and without a word of those that are."""
    return row["status"] == "at_floor" and not set(row["found"]) & set(row["hidden"]) and not named(row)


def single(design: str, names: Sequence[str], seeds: Sequence[int]) -> list[Job]:
    """One hidden effect each."""
    return [Job(study="single", hidden=(n,), seed=s, design=design) for s in seeds for n in names]


def amplitude(design: str, names: Sequence[str], strengths: Sequence[float], seeds: Sequence[int]) -> list[Job]:
    """One hidden effect each, at strengths around those at which it begins to be found."""
    return [
        Job(study="amplitude", hidden=(n,), seed=s, design=design, strength=x)
        for s in seeds
        for x in strengths
        for n in names
    ]


def touch(names: Sequence[str], seeds: Sequence[int]) -> list[Job]:
    """One hidden effect of the pads each, press–hold–release."""
    return [Job(study="touch", hidden=(n,), seed=s, design="press") for s in seeds for n in names]


def nothing(design: str, seeds: Sequence[int]) -> list[Job]:
    """No hidden effect."""
    return [Job(study="none", hidden=(), seed=s, design=design) for s in seeds]


def removed(design: str, names: Sequence[str], seeds: Sequence[int]) -> list[Job]:
    """One hidden effect that the search does not know."""
    return [
        Job(study="removed", hidden=(n,), seed=s, design=design, without=(n,) if n in registry else ())
        for s in seeds
        for n in names
    ]


def pairs(
    design: str, couples: Sequence[tuple[str, str]], seeds: Sequence[int], strength: float | None = None
) -> list[Job]:
    """Two hidden effects at once, each drawn as a single one is, or each of that strength: both of them are there to be found."""
    return [Job(study="pairs", hidden=c, seed=s, design=design, strength=strength) for s in seeds for c in couples]

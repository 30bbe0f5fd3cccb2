"""Accuracy of the search on surrogate robots with known hidden effects: one case at a time, as a row of numbers.

Under which conditions a robot is recorded (sampled loop, efforts, weighed mass, coloured noise) hangs on its seed and on what is
hidden in it. Rows of any number of machines and sessions add up in one file; ``pipelines/diagnosis_study.py`` makes them,
``pipelines/diagnosis_page.py`` writes the page.
"""

import contextlib
import dataclasses
import math
import time
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from taccorl.alignment.checks.unrepeated import check_repeatability
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.alignment.touch.motion import touch_motion
from taccorl.diagnosis.problems.joint_problem import JointProblem
from taccorl.diagnosis.problems.touch_problem import TouchProblem
from taccorl.diagnosis.search.identifiable import identifiable_numbers, identified_value
from taccorl.diagnosis.search.result import Diagnosis, SearchConfig
from taccorl.diagnosis.search.search import diagnose
from taccorl.sim.effects import effects as registry
from taccorl.surrogate.cases import Case, draw_case
from taccorl.surrogate.hidden import KINDS
from taccorl.surrogate.recordings import recordings
from taccorl.surrogate.touch import TouchCase, draw_touch_case, touch_recordings

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
        """Key of the job, the same for equal jobs."""
        strength = "" if self.strength is None else f" at {self.strength:g}"
        return f"{self.study} {self.design} {'+'.join(self.hidden) or 'none'}{strength} seed {self.seed}"


@dataclass(frozen=True, kw_only=True)
class Conditions:
    """Conditions of the recordings of a robot, besides the hidden effects."""

    effort: bool
    """The search uses the motor's efforts, too."""
    sampled: bool
    """The drive's loop is sampled."""
    loaded: bool
    """A weighed mass is held in every recording."""
    coloured: bool
    """The encoder's noise is correlated over time."""


def conditions(job: Job) -> Conditions:
    """Every combination of them equally often over neighbouring seeds.

    Efforts and sampled loops in half of the cases, coloured noise in a quarter, a weighed mass in none (packs have a recording
    with one). Where nothing is hidden a weighed mass, a sampled loop and coloured noise in a third each, and efforts in half of
    those whose loop is not sampled: efforts fix all torques, and then a sampled loop shows by itself, as an inertia of
    −K_d (T + τ) that the twin lacks. Those robots are the study ``loop``.
    """
    if job.study == "loop":
        return Conditions(effort=True, sampled=True, loaded=False, coloured=False)
    if not job.hidden:
        k = job.seed
        sampled = k // 3 % 3 == 0
        return Conditions(
            effort=k // 27 % 2 == 0 and not sampled,
            loaded=k % 3 == 0,
            sampled=sampled,
            coloured=k // 9 % 3 == 0,
        )
    k = job.seed + zlib.crc32("+".join(job.hidden).encode())
    return Conditions(
        effort=k % 2 == 0,
        sampled=k // 2 % 2 == 0,
        coloured=k // 4 % 4 == 0,
        loaded=False,
    )


def run_job(job: Job) -> dict[str, Any]:
    """A row, of whatever the job is about."""
    return run_touch(job) if job.design == "press" else run(job)


def run(job: Job) -> dict[str, Any]:
    """Draw the robot, record it, diagnose it with gains that nobody knows: the hardest case."""
    began = time.process_time()
    how = conditions(job)
    case = draw_case(
        job.hidden,
        job.seed,
        strength=job.strength,
        design=job.design,
        sampled=how.sampled,
        loaded=how.loaded,
        coloured=how.coloured,
    )
    made = recordings(case, job.design)
    recorded = time.process_time()
    problem = JointProblem(
        case.twin, case.signal, made, gains="fitted", effort=how.effort
    )
    sides, config = (
        (problem.fit, problem.validation, problem.test),
        SearchConfig(max_effects=len(job.hidden) + 1),
    )
    found = diagnose(
        problem, *sides, start=problem.start, without=job.without, config=config
    )
    done = time.process_time()
    truth = case.values()
    if (
        how.loaded
    ):  # some millimetres off its place a mass adds a constant torque of its own
        del truth["torque_ff"]
    loop = (
        {}
        if case.loop is None
        else {
            "loop_hz": round(1 / case.loop.period_s),
            "filter_s": _short(case.loop.filter_s),
        }
    )
    return {
        **_head(job, case.signal, case),
        "conditions": [
            name
            for name, on in dataclasses.asdict(how).items()
            if on and (name != "sampled" or case.loop)
        ],
        **loop,
        **told(found),
        "findings": findings(made.all, case.signal),
        "numbers": numbers(
            found, truth, commanded=problem.commanded, effort=problem.effort
        ),
        "recording_cpu_s": round(recorded - began, 2),
        "cpu_s": round(done - recorded, 2),
    }


def run_touch(job: Job) -> dict[str, Any]:
    """As ``run``, for pads of one arm that press known objects."""
    began = time.process_time()
    case = draw_touch_case(job.hidden, job.seed, strength=job.strength)
    made = touch_recordings(case)
    sides = made.fit, made.validation, made.test
    motions = [
        [touch_motion(m, case.twin, m.pressed) for m in side if m.pressed is not None]
        for side in sides
    ]
    recorded = time.process_time()
    problem = TouchProblem([m for side in motions for m in side], case.twin)
    fit_to, validation, test = problem.recordings(*motions)
    config = SearchConfig(max_effects=len(job.hidden) + 1)
    found = diagnose(
        problem,
        fit_to,
        validation,
        test,
        start=problem.start,
        without=job.without,
        config=config,
    )
    done = time.process_time()
    truth = {"k_n": case.k_n, "k_d": case.k_d}
    truth |= {
        f"{h.name}.{name}": value
        for h in case.hidden
        for name, value in h.values.items()
    }
    return {
        **_head(job, f"{case.arm} pads", case),
        "conditions": [],
        **told(found),
        "findings": [],
        "numbers": numbers(found, truth, commanded=True, effort=False),
        "recording_cpu_s": round(recorded - began, 2),
        "cpu_s": round(done - recorded, 2),
    }


def failed(job: Job, why: str) -> dict[str, Any]:
    """The row of a case that gave no diagnosis: it is counted and shown, never dropped."""
    return {"key": job.key, **dataclasses.asdict(job), "failed": why}


def _head(job: Job, signal: str, case: Case | TouchCase) -> dict[str, Any]:
    return {
        "key": job.key,
        **dataclasses.asdict(job),
        "signal": signal,
        "left_floors": round(case.left_floors, 3),
        "true": [{k: _short(v) for k, v in h.values.items()} for h in case.hidden],
    }


def _short(value: float) -> float:
    return float(f"{value:.5g}")


def told(found: Diagnosis) -> dict[str, Any]:
    """Result of a diagnosis as plain numbers."""
    ties = {r.added: list(r.ties) for r in found.rounds if r.added}
    return {
        "status": found.status,
        "found": list(found.names),
        "first": next((r.added for r in found.rounds), None),
        "ties": ties,
        "rivals": {name: list(others) for name, others in found.rivals.items()},
        "errors": {
            k: {use: round(e, 4) for use, e in of.items()}
            for k, of in found.errors.items()
        },
        "remarks": [str(remark)[:160] for remark in found.remarks],
    }


def numbers(
    found: Diagnosis, truth: Mapping[str, float], *, commanded: bool, effort: bool
) -> dict[str, list[float]]:
    """Identifiable number → value, 95 % interval, truth. Effects that are not hidden have no truth; theirs are not here."""
    out = {}
    for n in identifiable_numbers(found.after, commanded, effort):
        with contextlib.suppress(KeyError):
            true = identified_value(n.name, truth)
            out[n.name] = [_short(v) for v in (n.value, n.low, n.high, true)]
    return out


def findings(measurements: Sequence[Measurement], signal: str) -> list[str]:
    """Findings of the recordings alone: ``dropped_commands``, ``does_not_repeat``."""
    found = check_repeatability(measurements)
    said = {f.check for _, f in found if f.severity != "note" and f.feature == signal}
    return sorted(said & {"dropped_commands", "does_not_repeat"})


def material(row: dict[str, Any]) -> bool:
    """Whether there was something to find; a case that failed counts, so that it is counted as wrong."""
    return "failed" in row or row["errors"]["fitted"]["validation"] >= MATERIAL


def exact(row: dict[str, Any]) -> bool:
    """The hidden effects, and no other one, in the end; of one hidden effect that it was the first."""
    if len(row["hidden"]) == 1:
        return bool(row["found"]) and row["found"][0] == row["hidden"][0]
    return set(row["hidden"]) <= set(row["found"])


def named(row: dict[str, Any]) -> bool:
    """Each hidden effect is found, or named as a tie, rival or near-twin of one that is."""
    said = set(row["found"])
    for name in row["found"]:
        said |= {
            *row["ties"].get(name, ()),
            *row["rivals"].get(name, ()),
            *registry.get(name).near_twins,
        }
    return all(
        h in said or (h not in registry and h in KINDS and said & set(KINDS[h].near))
        for h in row["hidden"]
    )


def exact_but_for_algebra(row: dict[str, Any]) -> bool:
    """``exact``, where effects that give identical positions (``IDENTICAL``) count as the same effect."""
    found = row["found"] if len(row["hidden"]) > 1 else row["found"][:1]
    return all(
        any(h == f or any({h, f} <= group for group in IDENTICAL) for f in found)
        for h in row["hidden"]
    )


AT_FLOOR = ("at_floor", "gains_moved")
"""Statuses that leave nothing unexplained: that gains moved follows from the twin's, which are drawn up to a factor of 2 off."""


def silently_wrong(row: dict[str, Any]) -> bool:
    """Whether the search reached the noise floor, and so reports success, although it neither found nor named a hidden effect."""
    return (
        row["status"] in AT_FLOOR
        and not set(row["found"]) & set(row["hidden"])
        and not named(row)
    )


def drop_said(row: dict[str, Any]) -> bool:
    """Lost commands are a finding, or an effect that was found."""
    return "dropped_commands" in {*row["findings"], *row["found"]}


def inside(row: dict[str, Any], *, hidden_only: bool = False) -> list[bool]:
    """For each identifiable number with a known true value: whether its 95 % interval contains it.

    Args:
        hidden_only: numbers of the hidden effects, and not those that are always fitted.
    """
    own = tuple(f"{name}." for name in row["hidden"])
    held = {}
    for name, (value, low, high, true) in row["numbers"].items():
        turns = round((value - true) / math.tau) if name.endswith(".phase_rad") else 0
        held[name] = low <= true + turns * math.tau <= high
    return [held[name] for name in held if not hidden_only or name.startswith(own)]


def jobs(
    study: str, design: str, hidden: Sequence[str], seeds: Sequence[int]
) -> list[Job]:
    """One case for each seed and each entry of ``hidden``: the name of an effect, two names joined by +, or "" for no hidden
    effect. In the study ``removed`` these effects are taken out of the search."""
    made = [
        Job(
            study=study, hidden=tuple(filter(None, h.split("+"))), seed=s, design=design
        )
        for s in seeds
        for h in hidden
    ]
    if study != "removed":
        return made
    return [
        dataclasses.replace(job, without=tuple(h for h in job.hidden if h in registry))
        for job in made
    ]

"""Numbers of a run of MimicGen: yield over the reset space with intervals, sources, failures one by one, cost. All simulated."""

import shlex
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import binomtest

import taccorl
from taccorl.episodes.plan import Made
from taccorl.episodes.sources.mimicgen.augment import AugmentPlan
from taccorl.episodes.sources.mimicgen.stratify import first_attempts, given_up
from taccorl.lineage.manifest import read_manifest
from taccorl.lineage.store import Store

GENERATOR = "taccorl augment report"
"""Text by which the files of a report are recognised."""


@dataclass(frozen=True, kw_only=True)
class Share:
    """Number of successes among a number of attempts."""

    successes: int
    attempts: int

    @property
    def rate(self) -> float:
        """Success rate, 0 … 1; NaN without attempts."""
        return self.successes / self.attempts if self.attempts else float("nan")

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the rate (Wilson); (0, 1) without attempts."""
        if not self.attempts:
            return 0.0, 1.0
        ends = binomtest(self.successes, self.attempts).proportion_ci(method="wilson")
        return float(ends.low), float(ends.high)

    def __str__(self) -> str:
        low, high = self.interval
        told = f"{100 * self.rate:.0f} % (95 %: {100 * low:.0f} … {100 * high:.0f})" if self.attempts else "–"
        return f"{self.successes} of {self.attempts}: {told}"

    def record(self) -> dict[str, Any]:
        """JSON values: ``successes``, ``attempts``, ``rate`` (None without attempts), ``interval_95`` (low, high)."""
        return asdict(self) | {"rate": self.rate if self.attempts else None, "interval_95": self.interval}


@dataclass(frozen=True, kw_only=True)
class Attempt:
    """Data of one attempt for the report: outcome, random draws of its reset, sources, size and time."""

    k: int
    """Number of the attempt, from 0."""
    outcome: str
    reason: str
    scene_seed: int
    sources: frozenset[str]
    """Names of the source episodes that it used."""
    draw: dict[str, np.ndarray]
    """Name of each row of the randomisation → drawn values (components,)."""
    rows: int
    """Number of actions that can be executed again."""
    process_s: float
    """Wall time that the attempt took in its process [s]: physics and, for a success, touch, pictures and files."""
    folder: Path

    @property
    def success(self) -> bool:
        return self.outcome == "success"

    @property
    def command(self) -> str:
        """Command line that shows the attempt in Rerun."""
        return f"taccorl view {shlex.quote(str(self.folder))}"


def read_attempts(plan: AugmentPlan, made: Sequence[Made], store: Store) -> list[Attempt]:
    """Attempts of a run, in their order. Their random draws follow from the seeds, also for attempts whose process died."""
    found = []
    for each in made:
        entry, k = each.entry, each.entry["attempt"]
        physics = store.find(plan.steps[0].stage, plan.config(k), plan.inputs(k))
        folder = each.artefact.path if physics is None else physics.path
        used = entry["provenance"].get("subtasks", [])
        found.append(
            Attempt(
                k=k,
                outcome=entry["outcome"],
                reason=entry["reason"],
                scene_seed=plan.scene_seed(k),
                sources=frozenset(s["source"] for s in used),
                draw=plan.draw(k),
                rows=entry["rows"],
                process_s=sum(read_manifest(part)["seconds"] for part in {folder, each.artefact.path}),
                folder=folder,
            )
        )
    return found


def bins_of(plan: AugmentPlan, attempts: Sequence[Attempt]) -> Iterator[dict[str, Any]]:
    """Yield the boxes into which the range of every row of the task's randomisation is divided equally, row after row, as JSON
    values: ``row``, ``unit``, ``low`` and ``high`` (ends of each component, in ``unit``), and ``share``: record of the attempts
    that started in the box. Rows that draw nothing have none."""
    places = [plan.space.boxes(a.draw) for a in attempts]
    for r, row in enumerate(plan.space.rows):
        for box in range(plan.space.num_boxes(row)):
            low, high = plan.space.edges(row, box)
            share = share_of([a for a, place in zip(attempts, places, strict=True) if place[r] == box])
            edges = {"low": low.tolist(), "high": high.tolist()}
            yield {"row": row.name, "unit": row.unit, **edges, "share": share.record()}


def share_of(attempts: Sequence[Attempt]) -> Share:
    return Share(successes=sum(a.success for a in attempts), attempts=len(attempts))


def evenness(plan: AugmentPlan, draws: Sequence[Mapping[str, np.ndarray]]) -> dict[str, Any]:
    """Evenness of episodes over the boxes, as JSON values: ``episodes``; ``emptiest``: the emptiest box; ``boxes``: number of
    boxes; ``boxes_half_full``: number of boxes with at least half their fair share, which is the number of episodes divided by
    the number of boxes of the row.

    ``draws``: for each episode, name of the row → drawn values (components,).
    """
    counts = plan.space.count(plan.space.boxes(drawn) for drawn in draws)
    shares = [count * len(count) / max(len(draws), 1) for count in counts]
    r, box = min(((r, b) for r, row in enumerate(shares) for b in range(len(row))), key=lambda at: shares[at[0]][at[1]])
    row, every = plan.space.rows[r], np.concatenate(shares)
    low, high = plan.space.edges(row, box)
    return {
        "episodes": len(draws),
        "emptiest": {
            "row": row.name,
            "unit": row.unit,
            "low": low.tolist(),
            "high": high.tolist(),
            "episodes": int(counts[r][box]),
            "share_of_fair": float(shares[r][box]),
        },
        "boxes": len(every),
        "boxes_half_full": int((every >= 0.5).sum()),
    }


def stratified(plan: AugmentPlan, attempts: Sequence[Attempt]) -> dict[str, Any] | None:
    """Effect of --stratify, as JSON values: ``first_attempts``, ``passed_over`` (number of attempts not made), ``coverage``
    (``evenness`` of three sets of episodes), ``given_up`` (boxes); None without it.
    """
    if not plan.stratify:
        return None
    first = attempts[: first_attempts(plan.episodes)]
    poor = []
    for b in bins_of(plan, attempts):
        kept, made = b["share"]["successes"], b["share"]["attempts"]
        row = next(row for row in plan.space.rows if row.name == b["row"])
        if given_up(np.array(kept), np.array(made - kept)) and kept * plan.space.num_boxes(row) < plan.episodes:
            poor.append(b)
    return {
        "first_attempts": len(first),
        "passed_over": attempts[-1].k + 1 - len(attempts),
        "coverage": {
            "first_attempts": evenness(plan, [a.draw for a in first if a.success]),
            "first_draws_had_all_succeeded": evenness(plan, [plan.draw(k) for k in range(plan.episodes)]),
            "dataset": evenness(plan, [a.draw for a in attempts if a.success]),
        },
        "given_up": poor,
    }


class Spent(NamedTuple):
    """Time spent by a run of ``taccorl augment``."""

    cpu_s: float
    wall_s: float


def numbers(plan: AugmentPlan, attempts: Sequence[Attempt], spent: Spent | None) -> dict[str, Any]:
    """All numbers of the page, as JSON values: the content of the report's JSON file."""
    share, chosen = share_of(attempts), stratified(plan, attempts)
    # Attempts that were chosen for what they draw say nothing of the yield of the paper's randomisation.
    plain = attempts[: chosen["first_attempts"]] if chosen else attempts
    failed = [a for a in attempts if not a.success]
    return {
        "generator": f"{GENERATOR}, taccorl {taccorl.__version__}",
        "task": plan.spec.task,
        "data": str(plan.origin),
        "difficulty": plan.difficulty,
        "twin": str(plan.twin) if plan.twin else "nominal",
        "seed": plan.seed,
        "spec": plan.spec.digest,
        "retarget": plan.spec.datagen_config.retarget,
        "contact_mode": plan.spec.datagen_config.contact_mode,
        "disturbance": _disturbance(plan),
        "yield": share_of(plain).record(),
        "yield_of": f"attempts 0 … {len(plain) - 1}, the paper's randomisation",
        "all_attempts": share.record(),
        "stratify": chosen,
        "bins": list(bins_of(plan, attempts)),
        "draws": [
            {"attempt": a.k, "success": a.success} | {name: value.tolist() for name, value in a.draw.items()}
            for a in attempts
        ],
        "sources": _by_source(attempts, share.successes),
        "failures": dict(Counter(a.outcome for a in failed).most_common()),
        "failed": [
            {"attempt": a.k, "outcome": a.outcome, "reason": a.reason, "seed": a.scene_seed}
            | {"command": a.command if a.rows else None}
            for a in failed
        ],
        "cost": _cost(attempts, spent),
    }


def _disturbance(plan: AugmentPlan) -> str:
    pushed = plan.spec.datagen_config.disturbance
    return f"{pushed.joint_rad:g} rad of each joint, {pushed.time_s:g} s" if pushed.joint_rad else "none"


def _by_source(attempts: Sequence[Attempt], successes: int) -> list[dict[str, Any]]:
    found = []
    for name in sorted({name for a in attempts for name in a.sources}):
        share = share_of([a for a in attempts if name in a.sources])
        found.append({"source": name, "share_of_successes": share.successes / max(successes, 1)} | share.record())
    return found


def _cost(attempts: Sequence[Attempt], spent: Spent | None) -> dict[str, Any]:
    successes = [a.process_s for a in attempts if a.success]
    failures = [a.process_s for a in attempts if not a.success]
    return {
        "process_s_per_success": sum(successes + failures) / max(len(successes), 1),
        "median_success_process_s": median(successes) if successes else None,
        "median_failure_process_s": median(failures) if failures else None,
        "cpu_s_per_success": spent.cpu_s / max(len(successes), 1) if spent else None,
        "wall_s": spent.wall_s if spent else None,
    }

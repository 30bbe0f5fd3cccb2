"""Numbers of a run of MimicGen: yield over the reset space, sources, failures one by one, cost. All simulated."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from statistics import median
from typing import Any, NamedTuple

import taccorl
from taccorl.episodes.sources.mimicgen.augment import AugmentPlan
from taccorl.episodes.sources.mimicgen.coverage import Attempt, bins_of, share_of, stratified

GENERATOR = "taccorl augment report"
"""Text by which the files of a report are recognised."""


class Spent(NamedTuple):
    """Time spent by a run of ``taccorl augment``."""

    cpu_s: float
    """CPU time of all its processes [s]."""
    wall_s: float
    """Wall time of the run [s]."""


def numbers(plan: AugmentPlan, attempts: Sequence[Attempt], spent: Spent | None) -> dict[str, Any]:
    """All numbers of the page, as JSON values: the content of the report's JSON file."""
    share, chosen = share_of(attempts), stratified(plan, attempts)
    # Attempts that were chosen for what they draw say nothing of the yield of the paper's randomisation.
    plain = attempts[: chosen["first_attempts"]] if chosen else attempts
    bins = list(bins_of(plan, attempts))
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
        "bins": [asdict(b) | {"share": b.share.record()} for b in bins],
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

"""What became of a run's attempts, and where in the reset space they began: yields with intervals, box by box."""

import json
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from taccorl.demos.mimicgen.attempt import attempt_seeds
from taccorl.demos.mimicgen.augment import AugmentPlan, made_attempts
from taccorl.lineage.manifest import read_manifest
from taccorl.lineage.store import Store
from taccorl.sim.randomize import Row, draw
from taccorl.sim.tasks import tasks

_BINS = {1: 4, 2: 3}  # of each component, for rows of one and of two components


@dataclass(frozen=True, kw_only=True)
class Share:
    """Successes among attempts."""

    successes: int
    attempts: int

    @property
    def rate(self) -> float:
        """NaN of none."""
        return self.successes / self.attempts if self.attempts else float("nan")

    @property
    def interval(self) -> tuple[float, float]:
        """95 %, Wilson's; (0, 1) of none."""
        if not self.attempts:
            return 0.0, 1.0
        ends = binomtest(self.successes, self.attempts).proportion_ci(method="wilson")
        return float(ends.low), float(ends.high)

    def __str__(self) -> str:
        low, high = self.interval
        told = f"{100 * self.rate:.0f} % (95 %: {100 * low:.0f} … {100 * high:.0f})" if self.attempts else "–"
        return f"{self.successes} of {self.attempts}: {told}"

    def told(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self) | {"rate": self.rate if self.attempts else None, "interval_95": self.interval}


@dataclass(frozen=True, kw_only=True)
class Bin:
    """A box of the reset space in one row of the paper's table, and what became of attempts that began there."""

    row: str
    unit: str
    low: tuple[float, ...]
    high: tuple[float, ...]
    share: Share


@dataclass(frozen=True, kw_only=True)
class Attempt:
    """What the report needs of one."""

    k: int
    outcome: str
    reason: str
    scene_seed: int
    sources: frozenset[str]
    draw: dict[str, np.ndarray]
    process_s: float
    """Wall clock of the process that made it."""
    folder: Path
    """In the store."""

    @property
    def success(self) -> bool:
        return self.outcome == "success"

    @property
    def command(self) -> str:
        """Opens it in Rerun."""
        return f"taccorl view {shlex.quote(str(self.folder))}"


def read_attempts(plan: AugmentPlan, source: Path, store: Store, num_attempts: int) -> list[Attempt]:
    """Out of the store. What was drawn follows from the seeds, of attempts that broke as well."""
    rows, found = tasks.get(plan.spec.task)(plan.difficulty).rows, []
    for k, folder in enumerate(made_attempts(plan, source, store, num_attempts)):
        entry = json.loads((folder / "entry.json").read_text(encoding="utf-8"))
        scene_seed, _ = attempt_seeds(plan.seed, plan.spec.task, k)
        used = entry["provenance"].get("subtasks", [])
        found.append(
            Attempt(
                k=k,
                outcome=entry["outcome"],
                reason=entry["reason"],
                scene_seed=scene_seed,
                sources=frozenset(s["source"] for s in used),
                draw=draw(rows, np.random.default_rng(scene_seed), plan.randomization),
                process_s=read_manifest(folder)["seconds"],
                folder=folder,
            )
        )
    return found


def bins_of(plan: AugmentPlan, attempts: Sequence[Attempt]) -> Iterator[Bin]:
    """Every row of the task's randomisation, cut into equal boxes. Rows of which nothing is drawn have none."""
    for row in drawn_rows(plan):
        low, high = _limits(row, plan.randomization)
        num = _BINS.get(len(low), 1)
        values = np.array([a.draw[row.name] for a in attempts]).reshape(-1, len(low))
        place = np.clip(((values - low) / (high - low) * num).astype(int), 0, num - 1)
        for box in np.ndindex(*(num,) * len(low)):
            within = [a for a, p in zip(attempts, place, strict=True) if tuple(p) == box]
            start, size = low + np.array(box) * (high - low) / num, (high - low) / num
            yield Bin(
                row=row.name,
                unit=row.unit,
                low=tuple(start.tolist()),
                high=tuple((start + size).tolist()),
                share=share_of(within),
            )


def share_of(attempts: Sequence[Attempt]) -> Share:
    """Of these."""
    return Share(successes=sum(a.success for a in attempts), attempts=len(attempts))


def drawn_rows(plan: AugmentPlan) -> list[Row]:
    """Of the paper's table, what attempts differ in."""
    return list(tasks.get(plan.spec.task)(plan.difficulty).rows) if plan.randomization > 0 else []


def _limits(row: Row, scale: float) -> tuple[np.ndarray, np.ndarray]:
    low, high = (row.absent + scale * (np.array(ends) - row.absent) for ends in (row.low, row.high))
    return low, high

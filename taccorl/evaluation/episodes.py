"""Outcomes of all episodes of an evaluation as rows, and their summaries. One line of JSON is one episode."""

import json
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import fmean, median
from typing import Any

from taccorl.errors import TaccorlError
from taccorl.evaluation.statistics import PairedComparison, wilson_interval

ROWS_FILE, SUMMARY_FILE = "episodes.jsonl", "evaluation.json"
SUCCESS = "success"
"""Outcome of a completed episode."""
NO_PICTURES = "none"
"""``EpisodeRow.pictures`` of a policy without cameras."""


@dataclass(frozen=True, kw_only=True)
class EpisodeRow:
    """One episode of one policy: task, scene, outcome, partial credit, length, subtasks."""

    policy: str
    """Name of the policy as given: the checkpoint's folder, or ``expert``."""
    task: str
    seed: int
    """Scene seed: ``reset(seed=[seed])`` of an environment reproduces the scene."""
    outcome: str
    """``success``; the task's own failure category, ``timeout`` or ``diverged``; ``bad_action``; of an expert also
    ``unreachable`` and ``unfinished``."""
    partial: int
    """Number of goals in place at the end, out of ``max_partial``."""
    max_partial: int
    """Number of the task's goals."""
    steps: int
    """Number of control steps until the end."""
    time_s: float
    """Simulated time until the end [s]."""
    subtask_end_s: dict[str, dict[str, float | None]]
    """Arm → subtask → simulated time at which it ended [s]; None: it did not end."""
    clipped_steps: int
    """Number of control steps with a target beyond the limits."""
    measures: dict[str, float] = field(default_factory=dict)
    """Measures of the task at the end; ``ARM_touch_counts``, the largest reading of an arm's pads; ``PART_on_OTHER_n``, the net
    normal force between mating parts. Names state units."""
    reset: dict[str, float] = field(default_factory=dict)
    """Position of each part, and its rotation about the vertical axis, after the reset, in the world frame: ``PART_x_m``,
    ``PART_y_m``, ``PART_yaw_rad``."""
    pictures: str = "clear"
    """How the policy saw the pictures: ``clear``, ``randomised``, or ``none`` if it uses none."""
    hidden: str = ""
    """What was hidden from the policy, of ``HIDDEN``, with commas between."""
    reason: str = ""
    """Explanation of ``bad_action`` (the joint) and ``unreachable`` (the pose); empty for other outcomes."""

    @property
    def failed_in(self) -> dict[str, str]:
        """Arm → first of its subtasks that the episode did not complete; empty for a successful episode."""
        began = {
            arm: [name for name, end in own.items() if end is None]
            for arm, own in self.subtask_end_s.items()
        }
        return {
            arm: names[0] for arm, names in began.items() if names and not self.success
        }

    @property
    def success(self) -> bool:
        """Whether the task was completed."""
        return self.outcome == SUCCESS

    @property
    def partial_credit(self) -> float:
        """0 … 1: 1 for a success, else the share of goals in place at the end."""
        return 1.0 if self.success else self.partial / self.max_partial

    def to_json(self) -> dict[str, Any]:
        """The row as JSON values: field name → value, and ``success`` (bool) and ``partial_credit`` (0 … 1)."""
        return asdict(self) | {
            "success": self.success,
            "partial_credit": self.partial_credit,
        }


@dataclass(frozen=True, kw_only=True)
class Summary:
    """Summary of the n episodes of one policy in one task: successes with interval, failures, time to success."""

    policy: str
    task: str
    pictures: str
    """How the policy saw the pictures (``EpisodeRow.pictures``)."""
    hidden: str
    """What was hidden from the policy (``EpisodeRow.hidden``)."""
    n: int
    """Number of episodes."""
    successes: int
    interval_95: tuple[float, float]
    """95 % interval of the success rate (Wilson): (low, high), 0 … 1."""
    partial_credit: float
    """Mean partial credit of all episodes, 0 … 1."""
    failures: dict[str, int]
    """Failure category → number of episodes, the most frequent first."""
    median_success_s: float | None
    """Median simulated time to success [s]; None without a success."""

    @classmethod
    def of(cls, rows: Sequence[EpisodeRow]) -> "Summary":
        """Summarise rows (≥ 1) of the same policy and task, from which the same was hidden and who saw the same pictures."""
        (policy, task, pictures, hidden), *others = {
            (row.policy, row.task, row.pictures, row.hidden) for row in rows
        }
        assert not others, "rows of one policy, one task and one kind of pictures"
        good = [row.time_s for row in rows if row.success]
        return cls(
            policy=policy,
            task=task,
            pictures=pictures,
            hidden=hidden,
            n=len(rows),
            successes=len(good),
            interval_95=wilson_interval(len(good), len(rows)),
            partial_credit=fmean(row.partial_credit for row in rows),
            failures=dict(
                Counter(row.outcome for row in rows if not row.success).most_common()
            ),
            median_success_s=median(good) if good else None,
        )

    @property
    def rate(self) -> float:
        """Success rate, 0 … 1."""
        return self.successes / self.n

    def __str__(self) -> str:
        low, high = (100 * end for end in self.interval_95)
        time = (
            ""
            if self.median_success_s is None
            else f", median time to success {self.median_success_s:.1f} s"
        )
        failures = (
            ", ".join(
                f"{category} {count}" for category, count in self.failures.items()
            )
            or "none"
        )
        return (
            f"{self.successes} of {self.n} episodes succeeded: {100 * self.rate:.1f} % (95 %: {low:.1f} … {high:.1f}), "
            f"partial credit {self.partial_credit:.2f}{time}; failures: {failures}"
        )


def summaries(rows: Iterable[EpisodeRow]) -> list[Summary]:
    """Return one summary for each policy and task, in the order of the rows."""
    return [Summary.of(group) for group in grouped(rows).values()]


def grouped(rows: Iterable[EpisodeRow]) -> dict[tuple[str, str], list[EpisodeRow]]:
    """(policy, task) → its episodes, in the order of the rows."""
    groups: dict[tuple[str, str], list[EpisodeRow]] = {}
    for row in rows:
        groups.setdefault((row.policy, row.task), []).append(row)
    return groups


def compare(
    first: Sequence[EpisodeRow], second: Sequence[EpisodeRow]
) -> dict[str, PairedComparison]:
    """Task → comparison of two policies, paired by scene seed. ``first`` and ``second`` are the episodes of one policy each.
    Raises TaccorlError: the policies were not evaluated on the same tasks and seeds."""
    one, other = (
        {(row.task, row.seed): row.success for row in rows} for rows in (first, second)
    )
    if (
        one.keys() != other.keys()
        or len(one) != len(first)
        or len(other) != len(second)
    ):
        missing = sorted(one.keys() ^ other.keys())[:3]
        raise TaccorlError(
            f"paired comparison: {len(first)} and {len(second)} episodes were not run in the same scenes"
            + (
                f"; only one of the two has {', '.join(f'{task} seed {seed}' for task, seed in missing)}"
                if missing
                else ""
            )
        )
    found = {}
    for task in dict.fromkeys(row.task for row in first):
        keys = [key for key in one if key[0] == task]
        found[task] = PairedComparison.of(
            [one[key] for key in keys], [other[key] for key in keys]
        )
    return found


def write_rows(rows: Iterable[EpisodeRow], path: Path) -> None:
    """Write one line of JSON per row."""
    lines = [json.dumps(row.to_json(), ensure_ascii=False) for row in rows]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def read_rows(path: Path) -> list[EpisodeRow]:
    """Return the rows that ``write_rows`` wrote, in the order of the file. Raises TaccorlError: a line is not a row."""
    rows = []
    for number, line in enumerate(
        path.read_text(encoding="utf-8").splitlines(), start=1
    ):
        try:
            values = json.loads(line)
            rows.append(
                EpisodeRow(
                    **{
                        k: v
                        for k, v in values.items()
                        if k not in ("success", "partial_credit")
                    }
                )
            )
        except (ValueError, TypeError, AttributeError) as error:
            raise TaccorlError(
                f"{path}, line {number}: is not an episode written by taccorl evaluate: {error}"
            ) from error
    return rows

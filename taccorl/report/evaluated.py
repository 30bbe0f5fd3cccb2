"""Sections of an evaluation: success with intervals, paired comparison, failures with pictures, preflights, every episode."""

import dataclasses
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import cv2
import mujoco
import numpy as np
from scipy.stats import mannwhitneyu

import taccorl
from taccorl.evaluation.episodes import EpisodeRow, Summary, grouped, summaries
from taccorl.evaluation.evaluate import Scenes, scenes_to_json
from taccorl.evaluation.failed_episodes import FailedEpisode
from taccorl.evaluation.preflight import Check
from taccorl.evaluation.statistics import PairedComparison
from taccorl.lineage.digest import digest_bytes
from taccorl.report import page
from taccorl.report.section import Cell, Picture, Section
from taccorl.robots import ROBOT
from taccorl.sim.spaces import IMAGE_SHAPE
from taccorl.sim.twin_file import twin_text

ORIGIN = "Simulated in the MuJoCo twin; no robot was used"
_JPEG_QUALITY = 88
_FEWEST = 5  # successes, and failures, from which their quantities are compared
_SHOWN_PX = 176  # side of a picture on the page: six instants fit beside each other


class Policy(Protocol):
    """Policy that was evaluated."""

    name: str
    digest: str
    checks: Sequence[Check]
    """Lines of its preflight."""


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """What an evaluation found."""

    scenes: Scenes
    policies: Sequence[Policy]
    rows: Sequence[EpisodeRow] = ()
    """Episodes of all policies."""
    comparisons: Mapping[str, PairedComparison] = field(default_factory=dict)
    """Task → comparison of the first policy with the second on the same scenes."""
    aimed: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Policy → task → its aims before the mate."""
    executed: Mapping[str, str]
    """Policy → executed actions of a chunk, such as ``8 of 16``."""
    against: str | None
    """The other side of the comparison, as it was given."""
    wall_s: float = 0.0
    """Time of the rollouts [s]."""
    robot: Mapping[str, Any] = field(default_factory=dict)
    """Of trials on a robot: its options, ``origin``, and ``void`` trials, which do not count; empty: in the twin."""

    @property
    def names(self) -> list[str]:
        """Names of the policies, as the episodes have them."""
        return list(dict.fromkeys(row.policy for row in self.rows))

    @property
    def about(self) -> dict[str, str]:
        """Resolved settings, versions and digests, by name."""
        aims = [
            (f"{name}, {task}", a["text"])
            for name, own in self.aimed.items()
            for task, a in own.items()
        ]
        twin = (
            {}
            if self.robot
            else {
                "digest of the twin": digest_bytes(
                    twin_text(self.scenes.twin_config()).encode()
                )
            }
        )
        return {
            **{f"digest of {one.name}": one.digest for one in self.policies},
            **{
                f"executed actions of {name}": text
                for name, text in self.executed.items()
            },
            **{f"{of}, before the mate": text for of, text in aims},
            **{name: str(value) for name, value in scenes_to_json(self.scenes).items()},
            **twin,
            **{f"robot's {name}": str(value) for name, value in self.robot.items()},
            "against": str(self.against),
            "taccorl": taccorl.__version__,
            "mujoco": mujoco.__version__,
        }

    def to_json(self) -> dict[str, Any]:
        """Content of ``evaluation.json``."""
        return {
            "policies": [
                {"name": one.name, "digest": one.digest} for one in self.policies
            ],
            "scenes": scenes_to_json(self.scenes),
            **({"robot": self.robot} if self.robot else {}),
            "about": self.about,
            "wall_s": self.wall_s,
            "scores": [
                dataclasses.asdict(s) | {"rate": s.rate} for s in summaries(self.rows)
            ],
            "comparisons": {task: c.to_json() for task, c in self.comparisons.items()},
            "before_mate": self.aimed,
            "preflight": {
                one.name: [dataclasses.asdict(c) for c in one.checks]
                for one in self.policies
            },
        }

    def lines(self) -> Section:
        """A line for each policy and task, and for each comparison."""
        lines = []
        for s in summaries(self.rows):
            seen = ", randomised pictures" * (
                s.pictures == "randomised"
            ) + f", hidden: {s.hidden}" * bool(s.hidden)
            lines.append(f"{s.policy}, {s.task}{seen}: {s}")
        if self.scenes.physics != "c":
            lines.append(
                f"physics: MuJoCo Warp ({self.scenes.physics}), float32: not the episodes of MuJoCo C"
            )
        return Section(
            text=[
                *lines,
                *(
                    f"{task}, {' against '.join(self.names)}: {c}"
                    for task, c in self.comparisons.items()
                ),
            ]
        )

    def html(self, failures: Sequence[tuple[FailedEpisode, Path]]) -> str:
        """Text of ``report.html`` with some failed episodes, which are shown with pictures, and their Rerun files."""
        found, title = summaries(self.rows), f"all {len(self.rows)} episodes"
        rows = [*map(_episode, self.rows)]
        every = Section(
            title=title, heads=_EPISODE, rows=rows, right=(2, 4, 5, 6, 7), folded=True
        )
        shown = [_failure(*failed) for failed in failures]
        checked = [
            preflight(one.name, one.checks) for one in self.policies if one.checks
        ]
        sections = [
            Section(text=[self.robot.get("origin", ORIGIN)], style="data"),
            dataclasses.replace(self.lines(), style="high"),
            _scores(found),
            *([_paired(self.comparisons, self.names)] if self.comparisons else []),
            Section(
                title="Failures",
                parts=[
                    _categories(found),
                    by_subtask(self.rows),
                    *differences(self.rows),
                    *shown,
                ],
            ),
            *(
                [
                    Section(
                        title="Checkpoint and environment", parts=checked, folded=True
                    )
                ]
                if checked
                else []
            ),
            Section(title="Episodes", parts=[every]),
            Section(
                title="How this report was made",
                rows=[*self.about.items()],
                folded=True,
            ),
        ]
        return page.html(
            f"Evaluation of {' against '.join(self.names)}",
            sections,
            "taccorl evaluate",
        )


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"


def _scores(found: Sequence[Summary]) -> Section:
    heads = (
        "policy",
        "task",
        "pictures",
        "episodes",
        "successes",
        "success rate (95 %)",
        "partial credit",
    )
    rows = []
    for s in found:
        low, high = s.interval_95
        time = "–" if s.median_success_s is None else f"{s.median_success_s:.1f} s"
        rate = f"{_percent(s.rate)} ({100 * low:.1f} … {100 * high:.1f})"
        seen = f"{s.pictures}, hidden: {s.hidden}" if s.hidden else s.pictures
        rows.append(
            [
                s.policy,
                s.task,
                seen,
                str(s.n),
                str(s.successes),
                rate,
                f"{s.partial_credit:.2f}",
                time,
            ]
        )
    note = (
        "95 %: Wilson's interval. Partial credit: 1 for a success, else the share of the task's goals in place at the end; "
        "mean of all episodes. Times are simulated. Pictures: as the policy saw them."
    )
    return Section(
        heads=(*heads, "median time to success"),
        rows=rows,
        right=range(3, 8),
        notes=[note],
    )


def _paired(
    comparisons: Mapping[str, PairedComparison], names: Sequence[str]
) -> Section:
    heads = (
        "task",
        "scenes",
        "both",
        f"only {names[0]}",
        f"only {names[1]}",
        "neither",
        "difference (95 %)",
        "p",
    )
    rows = []
    for task, c in comparisons.items():
        low, high = c.interval
        difference = (
            f"{100 * c.difference:+.1f} points ({100 * low:+.1f} … {100 * high:+.1f})"
        )
        counts = [str(k) for k in (c.n, c.both, c.only_first, c.only_second, c.neither)]
        rows.append([task, *counts, difference, f"{c.p_value:.3g}"])
    note = "Same scenes for both. Difference of the success rates with Newcombe's paired interval; p: McNemar's exact test."
    return Section(
        title="Paired comparison",
        heads=heads,
        rows=rows,
        right=range(1, 8),
        notes=[note],
    )


def _categories(found: Sequence[Summary]) -> Section:
    rows = [
        [s.policy, s.task, name, str(n), _percent(n / s.n)]
        for s in found
        for name, n in s.failures.items()
    ]
    heads = ("policy", "task", "category", "episodes", "share of all")
    return Section(
        heads=heads, rows=rows, right=(3, 4), notes=[] if rows else ["None."]
    )


def by_subtask(rows: Sequence[EpisodeRow]) -> Section:
    """Table: how many episodes began, ended and failed in each subtask of each arm."""
    cells = []
    for (policy, task), own in grouped(rows).items():
        for arm, names in own[0].subtask_end_s.items():
            begun = len(own)
            for name in names:
                ended = sum(row.subtask_end_s[arm][name] is not None for row in own)
                failed = sum(row.failed_in.get(arm) == name for row in own)
                cells.append(
                    [policy, task, arm, name, str(begun), str(ended), str(failed)]
                )
                begun = ended
    heads = ("policy", "task", "arm", "subtask", "begun", "ended", "failed in it")
    note = "Both arms work at the same time: a failure counts for each."
    return Section(
        title="By subtask", heads=heads, rows=cells, right=(4, 5, 6), notes=[note]
    )


def differences(rows: Sequence[EpisodeRow]) -> list[Section]:
    """Tables that compare failed with successful episodes: positions of the parts after the reset, measures at the end."""
    sections = []
    for (policy, task), own in grouped(rows).items():
        sides = [
            [row.reset | row.measures for row in own if row.success == success]
            for success in (True, False)
        ]
        cells = []
        for name in dict.fromkeys(
            name for side in sides for one in side for name in one
        ):
            good, bad = (
                np.array([one[name] for one in side if name in one]) for side in sides
            )
            if min(len(good), len(bad)) >= _FEWEST and np.ptp([*good, *bad]) > 0:
                when = (
                    "after the reset"
                    if any(name in row.reset for row in own)
                    else "at the end"
                )
                cells.append(
                    (
                        float(np.array(mannwhitneyu(good, bad))[1]),
                        [name, when, _middle(good), _middle(bad)],
                    )
                )
        cells.sort(key=lambda cell: cell[0])
        heads = (
            "quantity",
            "when",
            "successes: median (5 … 95 %)",
            "failures: median (5 … 95 %)",
            "p",
        )
        note = "p: Mann-Whitney test of each quantity by itself; by chance one in 20 is below 0.05."
        note = note if cells else f"Needs {_FEWEST} successes and {_FEWEST} failures."
        table = [[*cell, f"{p:.2g}"] for p, cell in cells]
        title = f"What differs between successes and failures of {policy}, {task}"
        sections.append(
            Section(
                title=title,
                heads=heads,
                rows=table,
                right=(4,),
                notes=[note],
                folded=True,
            )
        )
    return sections


def _middle(values: np.ndarray) -> str:
    low, middle, high = np.percentile(values, (5, 50, 95))
    return f"{middle:.4g} ({low:.4g} … {high:.4g})"


def _failure(failed: FailedEpisode, rrd: Path) -> Section:
    row, times = failed.rollout.row, ", ".join(f"{t:.1f}" for t in failed.instants_s)
    caption = f"{', '.join(ROBOT.cameras).replace('_', ' ')} at {times} s"
    rgb = failed.pictures
    return Section(
        title=f"{row.task}, seed {row.seed}: {row.outcome} after {row.time_s:.1f} s",
        text=[row.reason] if row.reason else [],
        figures=[] if rgb is None else [Picture(lambda: _jpeg(rgb), caption)],
        notes=[Cell(f"{rrd.parent.name}/{rrd.name}", "link")],
        command=shlex.join([str(Path(sys.executable).with_name("rerun")), str(rrd)]),
    )


def _jpeg(rgb: np.ndarray) -> bytes:
    rows, columns = (n * _SHOWN_PX // IMAGE_SHAPE[0] for n in rgb.shape[:2])
    small = cv2.resize(rgb, (columns, rows), interpolation=cv2.INTER_AREA)
    bgr = cv2.cvtColor(small, cv2.COLOR_RGB2BGR)
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[
        1
    ].tobytes()


def preflight(policy: str, checks: Sequence[Check]) -> Section:
    """What a checkpoint and the environment state, beside each other."""
    grades = {"differs": "error", "same": "good", "within": "good"}
    rows = [
        (
            c.what,
            c.policy,
            c.environment,
            Cell(c.verdict, grades.get(c.verdict, "note")),
        )
        for c in checks
    ]
    return Section(
        title=f"preflight of {policy}",
        heads=("", "checkpoint", "environment", ""),
        rows=rows,
    )


_EPISODE = (
    "policy",
    "task",
    "seed",
    "outcome",
    "time [s]",
    "partial",
    "subtasks done",
    "clipped steps",
    "reason",
)


def _episode(row: EpisodeRow) -> list[str]:
    ends = [end for own in row.subtask_end_s.values() for end in own.values()]
    done = f"{sum(end is not None for end in ends)} of {len(ends)}"
    numbers = [
        f"{row.time_s:.2f}",
        f"{row.partial} of {row.max_partial}",
        done,
        str(row.clipped_steps),
    ]
    return [row.policy, row.task, str(row.seed), row.outcome, *numbers, row.reason]

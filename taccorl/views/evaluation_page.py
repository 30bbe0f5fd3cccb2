"""The page of ``taccorl evaluate``: success with intervals, paired comparison, failures with pictures and Rerun files.

HTML with its pictures inside; the Rerun files lie beside it.
"""

import base64
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from taccorl.diagnosis.report.page import STYLE
from taccorl.evaluation.episodes import EpisodeRow, summaries
from taccorl.evaluation.failed_episodes import FailedEpisode
from taccorl.evaluation.preflight import Check
from taccorl.evaluation.statistics import PairedComparison
from taccorl.html_page import Html, document, element, figure, inline, note, table
from taccorl.robots import ROBOT
from taccorl.sim.spaces import IMAGE_SHAPE
from taccorl.views.episode import save_episode

GENERATOR = "taccorl evaluate"
_ORIGIN = "Simulated in the MuJoCo twin; no robot was used"
_JPEG_QUALITY = 88
_SHOWN_PX = 176
"""Side of a picture on the page: six instants fit beside each other."""


@dataclass(frozen=True, kw_only=True)
class EvaluationPage:
    """Content of the page of ``taccorl evaluate``: episodes, settings, comparisons, preflights, failures."""

    rows: Sequence[EpisodeRow]
    """Episodes of all policies."""
    about: dict[str, str]
    """Resolved settings, versions and digests, by name."""
    comparisons: dict[str, PairedComparison] = field(default_factory=dict)
    """Task → comparison of the first policy with the second on the same scenes."""
    preflight: dict[str, Sequence[Check]] = field(default_factory=dict)
    """Policy → lines of its preflight."""
    failures: Sequence[FailedEpisode] = ()
    """Failed episodes that are shown with pictures."""


def write_page(page: EvaluationPage, folder: Path) -> list[Path]:
    """Write ``report.html`` and ``failures/*.rrd`` into ``folder``; returns the written files, the page first.

    Raises:
        OutputError: the disk is full, or a file of another program is in the way.
    """
    files = []
    for failed in page.failures:
        row = failed.rollout.row
        rrd = folder / "failures" / f"{row.task}_seed_{row.seed}_{row.outcome}.rrd"
        rrd.parent.mkdir(exist_ok=True)
        save_episode(failed.episode, rrd, native=True)
        files.append(rrd)
    report = folder / "report.html"
    report.write_text(_html(page, files), encoding="utf-8")
    return [report, *files]


def _html(page: EvaluationPage, rrds: Sequence[Path]) -> str:
    names = list(dict.fromkeys(row.policy for row in page.rows))
    title = f"Evaluation of {names[0]}" + (f" against {names[1]}" if len(names) > 1 else "")
    parts = [
        element("h1", title),
        element("p", _ORIGIN, class_="data"),
        _scores(page.rows),
        *_comparisons(page.comparisons, names),
        element("h2", "Failures"),
        _categories(page.rows),
        *(_failure(failed, rrd) for failed, rrd in zip(page.failures, rrds, strict=True)),
        *_preflight(page.preflight),
        element("h2", "Episodes"),
        element("details", element("summary", f"all {len(page.rows)} episodes"), _episodes(page.rows)),
        element("h2", "Settings"),
        table((), [*page.about.items()]),
    ]
    return document(title, STYLE, GENERATOR, parts)


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"


def _scores(rows: Sequence[EpisodeRow]) -> Html:
    heads = (
        "policy",
        "task",
        "pictures",
        "episodes",
        "successes",
        "success rate (95 %)",
        "partial credit",
        "median time to success",
    )
    lines = []
    for s in summaries(rows):
        low, high = s.interval_95
        time = "–" if s.median_success_s is None else f"{s.median_success_s:.1f} s"
        rate = f"{_percent(s.rate)} ({100 * low:.1f} … {100 * high:.1f})"
        cells = [
            s.policy,
            s.task,
            f"{s.pictures}, hidden: {s.hidden}" if s.hidden else s.pictures,
            str(s.n),
            str(s.successes),
            rate,
            f"{s.partial_credit:.2f}",
            time,
        ]
        lines.append(cells)
    words = (
        "95 %: Wilson's interval. Partial credit: 1 for a success, else the share of the task's goals in place at the end; "
        "mean of all episodes. Times are simulated. Pictures: as the policy saw them."
    )
    return inline(table(heads, lines, numbers=range(3, 8)), note(words))


def _comparisons(comparisons: dict[str, PairedComparison], names: Sequence[str]) -> list[Html]:
    if not comparisons:
        return []
    heads = ("task", "scenes", "both", f"only {names[0]}", f"only {names[1]}", "neither", "difference (95 %)", "p")
    lines = []
    for task, c in comparisons.items():
        low, high = c.interval
        difference = f"{100 * c.difference:+.1f} points ({100 * low:+.1f} … {100 * high:+.1f})"
        counts = [str(k) for k in (c.n, c.both, c.only_first, c.only_second, c.neither)]
        lines.append([task, *counts, difference, f"{c.p_value:.3g}"])
    words = "Same scenes for both. Difference of the success rates with Newcombe's paired interval; p: McNemar's exact test."
    return [element("h2", "Paired comparison"), table(heads, lines, numbers=range(1, 8)), note(words)]


def _categories(rows: Sequence[EpisodeRow]) -> Html:
    lines = [
        [s.policy, s.task, category, str(count), _percent(count / s.n)]
        for s in summaries(rows)
        for category, count in s.failures.items()
    ]
    if not lines:
        return note("None.")
    return table(("policy", "task", "category", "episodes", "share of all"), lines, numbers=(3, 4))


def _failure(failed: FailedEpisode, rrd: Path) -> Html:
    row = failed.rollout.row
    link = f"{rrd.parent.name}/{rrd.name}"
    command = shlex.join([str(Path(sys.executable).with_name("rerun")), str(rrd)])
    title = f"{row.task}, seed {row.seed}: {row.outcome} after {row.time_s:.1f} s"
    parts = [element("h3", title)]
    if row.reason:
        parts.append(note(row.reason))
    if failed.pictures is not None:
        times = ", ".join(f"{t:.1f}" for t in failed.instants_s)
        parts.append(figure(_jpeg_uri(failed.pictures), f"{', '.join(ROBOT.cameras).replace('_', ' ')} at {times} s"))
    parts.append(element("p", element("a", link, href=link), ": ", element("code", command), class_="note"))
    return inline(*parts)


def _jpeg_uri(rgb: np.ndarray) -> str:
    rows, columns = (n * _SHOWN_PX // IMAGE_SHAPE[0] for n in rgb.shape[:2])
    small = cv2.resize(rgb, (columns, rows), interpolation=cv2.INTER_AREA)
    bgr = cv2.cvtColor(small, cv2.COLOR_RGB2BGR)
    blob = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()
    return f"data:image/jpeg;base64,{base64.b64encode(blob).decode('ascii')}"


def _preflight(preflight: dict[str, Sequence[Check]]) -> list[Html]:
    parts = [element("h2", "Checkpoint and environment")] if preflight else []
    for policy, checks in preflight.items():
        lines = [(c.what, c.policy, c.environment, c.verdict) for c in checks]
        parts.append(table(("", policy, "environment", ""), lines))
    return parts


def _episodes(rows: Sequence[EpisodeRow]) -> Html:
    heads = ("policy", "task", "seed", "outcome", "time [s]", "partial", "subtasks done", "clipped steps", "reason")
    lines = []
    for row in rows:
        ends = [end for own in row.subtask_end_s.values() for end in own.values()]
        done = f"{sum(end is not None for end in ends)} of {len(ends)}"
        numbers = [f"{row.time_s:.2f}", f"{row.partial} of {row.max_partial}", done, str(row.clipped_steps)]
        lines.append(
            [
                row.policy,
                row.task,
                str(row.seed),
                row.outcome,
                *numbers,
                row.reason,
            ]
        )
    return table(heads, lines, numbers=(2, 4, 5, 6, 7))

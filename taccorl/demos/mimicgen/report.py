"""Report of a run of MimicGen: yield over the reset space, sources, failures one by one, cost. HTML and JSON.

The page needs no other file; ``….json`` holds every number of it. Both are written beside the dataset. All simulated.
"""

import base64
import io
import json
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import numpy as np

import taccorl
from taccorl.demos.mimicgen.augment import AugmentPlan
from taccorl.demos.mimicgen.coverage import Attempt, Share, bins_of, read_attempts, share_of, stratified
from taccorl.demos.mimicgen.grips import SAME_M, SAME_RAD, grips_warning
from taccorl.demos.mimicgen.stratify import GIVE_UP_FAILED, GIVE_UP_YIELD
from taccorl.errors import TaccorlError
from taccorl.html_page import Html, document, element, figure, note, table
from taccorl.lineage.store import Store

GENERATOR = "taccorl augment report"
_HEAD_BYTES = 2048
_SHOWN = {"m": (1e3, "mm"), "rad": (180 / np.pi, "°"), "kg": (1e3, "g"), "1": (1.0, "")}
_GOOD, _BAD, _CELL = "#0072b2", "#d55e00", "#009e73"


class Spent(NamedTuple):
    """Time spent by a run of ``taccorl augment``."""

    cpu_s: float
    """CPU time of all its processes [s]."""
    wall_s: float
    """Wall time of the run [s]."""


def pages_of(out: Path) -> tuple[Path, Path]:
    """Return the paths of the report's HTML and JSON files, in this order, beside the dataset at ``out``.

    Raises:
        TaccorlError: a file that taccorl did not write is there.
    """
    pages = tuple(out.with_name(f"{out.name}.augment_report.{kind}") for kind in ("html", "json"))
    for page in pages:
        if page.exists() and GENERATOR.encode() not in page.read_bytes()[:_HEAD_BYTES]:
            raise TaccorlError(
                f"{page}: already exists and is not a report of taccorl; give another --out, or remove it"
            )
    return pages[0], pages[1]


def write_report(
    plan: AugmentPlan,
    source: Path,
    out: Path,
    store: Store,
    num_attempts: int,
    grips: dict[str, Any],
    *,
    spent: Spent | None = None,
) -> Path:
    """Write both files for the plan's first ``num_attempts`` attempts; returns the path of the page. An earlier report is
    replaced.

    Args:
        spent: time of the whole run, if all of its attempts were made in it.
    """
    told = numbers(plan, read_attempts(plan, source, store, num_attempts), spent)
    told |= {"grips": grips, "source": str(source), "dataset": str(out)}
    page, data = pages_of(out)
    for path, text in ((data, json.dumps(told, indent=1, ensure_ascii=False) + "\n"), (page, _page(plan, told))):
        part = path.with_name(f".{path.name}.part")
        part.write_text(text, encoding="utf-8")
        part.replace(path)
    return page


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


# the page -----------------------------------------------------------------------------------------------------------------

_STYLE = """
body{font:15px/1.5 system-ui,-apple-system,"Segoe UI",sans-serif;margin:0;color:#111827;background:#f8fafc}
main{max-width:1240px;margin:0 auto;padding:24px 20px 80px}
h1{font-size:26px;margin:8px 0}h2{font-size:20px;margin:36px 0 10px;border-bottom:2px solid #e5e7eb;padding-bottom:4px}
.data{background:#fef3c7;border:1px solid #f59e0b;border-radius:6px;padding:8px 12px;font-weight:600}
.verdict{font-size:17px;background:#ecfeff;border:1px solid #06b6d4;border-radius:6px;padding:10px 14px;margin:12px 0}
.note{color:#4b5563;font-size:13.5px;margin:6px 0}
table{border-collapse:collapse;background:#fff;font-size:13px;margin:8px 0}
th,td{padding:5px 9px;border-bottom:1px solid #e5e7eb;text-align:left;vertical-align:top}th{background:#f1f5f9}
td.n{text-align:right;white-space:nowrap;font-variant-numeric:tabular-nums}
.scroll{overflow-x:auto}img{max-width:100%;background:#fff;border:1px solid #e5e7eb;border-radius:6px}
code{background:#f1f5f9;padding:1px 4px;border-radius:3px;white-space:nowrap}
"""


def _page(plan: AugmentPlan, told: dict[str, Any]) -> str:
    share, plain = Share(**_counts(told["all_attempts"])), Share(**_counts(told["yield"]))
    title = f"{plan.spec.task}: {share.successes} new episodes out of {told['source']}"
    parts = [
        element("h1", title),
        element("p", str(plan.origin), class_="data"),
        element("div", f"Yield: {plain}{_of_which(told)}", class_="verdict"),
        table(
            ("", ""),
            [
                [name, str(told[name])]
                for name in (
                    "dataset",
                    "source",
                    "twin",
                    "difficulty",
                    "seed",
                    "retarget",
                    "contact_mode",
                    "disturbance",
                    "spec",
                )
            ],
        ),
        *_filled(told),
        element("h2", "Where in the reset space"),
        *_where(plan, told, share),
        element("h2", "Sources"),
        note("An attempt counts for every source that it uses; share: of the new episodes."),
        table(
            ("source", "share", "yield of attempts that use it"),
            [
                [
                    s["source"],
                    f"{100 * s['share_of_successes']:.0f} %",
                    str(Share(successes=s["successes"], attempts=s["attempts"])),
                ]
                for s in told["sources"]
            ],
            numbers=(1, 2),
        ),
        *_grips(told),
        element("h2", "Failures"),
        *_failures(told, share.attempts),
        element("h2", "Cost"),
        *_costs(told["cost"]),
    ]
    return document(title, _STYLE, GENERATOR, parts)


def _grips(told: dict[str, Any]) -> Iterator[Html]:
    """Different grips of the sources, and what follows from few."""
    yield note(
        f"Grips: where a part lies in the hand while both pads touch it. Two are the same within {1e3 * SAME_M:g} mm and "
        f"{np.degrees(SAME_RAD):g}°."
    )
    rows = [[g["arm"], g["part"], str(g["sources"]), str(g["different"])] for g in told["grips"]["hands"]]
    yield table(("hand", "part", "sources that hold it", "different grips"), rows, numbers=(2, 3))
    if told["grips"]["few"]:
        why, command = grips_warning(told["task"])
        yield note(f"{why}: {command}")


def _of_which(told: dict[str, Any]) -> str:
    if not told["stratify"]:
        return ""
    every = Share(**_counts(told["all_attempts"]))
    return (
        f" — {told['yield_of']}. The later ones were chosen for poor boxes; all together: {every.successes} of {every.attempts}, "
        "which is no yield of that randomisation."
    )


def _filled(told: dict[str, Any]) -> Iterator[Html]:
    """What --stratify did."""
    if not (chosen := told["stratify"]):
        return
    yield element("h2", "Poor boxes filled")
    yield note(
        f"After the first {chosen['first_attempts']} attempts, those were made whose draws lie in boxes with few episodes; "
        f"{chosen['passed_over']} were passed over, not simulated. Fair share of a box: episodes over the boxes of its row. "
        "The fewer the episodes, the more uneven they are by chance alone: the second line has as many as the dataset."
    )
    words = {
        "first_attempts": f"kept of the first {chosen['first_attempts']} attempts",
        "first_draws_had_all_succeeded": "the first draws, had every attempt succeeded",
        "dataset": "this dataset",
    }
    rows = []
    for key, word in words.items():
        c = chosen["coverage"][key]
        box = c["emptiest"]
        where = f"{box['row']} {_range_words(box)}: {box['episodes']}"
        half = f"{c['boxes_half_full']} of {c['boxes']}"
        rows.append([word, str(c["episodes"]), where, f"{100 * box['share_of_fair']:.0f} %", half])
    heads = ("", "episodes", "emptiest box: episodes", "of its fair share", "boxes at least half full")
    yield table(heads, rows, numbers=(1, 3, 4))
    if chosen["given_up"]:
        yield note(
            f"Given up: at least {GIVE_UP_FAILED} attempts failed there and fewer than {100 * GIVE_UP_YIELD:.0f} % succeeded."
        )
        rows = [[b["row"], _range_words(b), str(Share(**_counts(b["share"])))] for b in chosen["given_up"]]
        yield table(("row", "range", "attempts there"), rows, numbers=(2,))


def _where(plan: AugmentPlan, told: dict[str, Any], share: Share) -> Iterator[Html]:
    if not told["bins"]:
        yield note("Nothing was drawn: every attempt began in the nominal scene.")
        return
    words = (
        "What each attempt drew, over the whole range that is drawn from. In a box: successes / attempts; green: all succeeded, "
        "white: none. Whiskers and brackets: 95 % intervals (Wilson)."
    )
    picture = base64.b64encode(_png(coverage_figure(plan, told))).decode("ascii")
    yield figure(f"data:image/png;base64,{picture}", "coverage")
    yield note(words)
    poor = [b for b in told["bins"] if b["share"]["attempts"] and b["share"]["interval_95"][1] < share.rate]
    empty = sum(not b["share"]["attempts"] for b in told["bins"])
    if empty:
        yield note(f"{empty} of {len(told['bins'])} boxes had no attempt.")
    if poor:
        yield note(
            f"Boxes whose interval lies below the yield of all. Of {len(told['bins'])} boxes alike in truth, about "
            f"{0.025 * len(told['bins']):.1f} would."
        )
        rows = [[b["row"], _range_words(b), str(Share(**_counts(b["share"])))] for b in poor]
        yield table(("row", "range", "yield"), rows, numbers=(2,))
    else:
        yield note("No box's interval lies below the yield of all.")


def _counts(told: dict[str, Any]) -> dict[str, int]:
    return {key: told[key] for key in ("successes", "attempts")}


def _range_words(b: dict[str, Any]) -> str:
    scale, unit = _SHOWN[b["unit"]]
    return ", ".join(
        f"{low * scale:.3g} … {high * scale:.3g} {unit}".rstrip() for low, high in zip(b["low"], b["high"], strict=True)
    )


def _failures(told: dict[str, Any], attempts: int) -> Iterator[Html]:
    if not told["failed"]:
        yield note("None.")
        return
    rows = [[name, str(n), f"{100 * n / attempts:.0f} %"] for name, n in told["failures"].items()]
    yield table(("category", "attempts", "of all"), rows, numbers=(1, 2))
    yield note(
        "The command executes an attempt again, from its stored actions and its scene's seed, and opens it in Rerun."
    )
    rows = [
        [
            str(f["attempt"]),
            f["outcome"],
            f["reason"],
            element("code", f["command"]) if f["command"] else "nothing: it broke before an action was kept",
        ]
        for f in told["failed"]
    ]
    yield table(("attempt", "category", "why", "to look at it"), rows, numbers=(0,))


def _costs(cost: dict[str, Any]) -> Iterator[Html]:
    words = {
        "wall_s": "the whole run, by the clock on the wall [s]",
        "cpu_s_per_success": "CPU time of the whole run for each new episode [CPU-s]",
        "process_s_per_success": "attempts, failed ones too, for each new episode, wall clock of one process [s]",
        "median_success_process_s": "median attempt that succeeded: physics, again with touch, pictures, files [s]",
        "median_failure_process_s": "median attempt that failed: physics [s]",
    }
    yield table(("", ""), [[w, f"{cost[k]:.2f}"] for k, w in words.items() if cost[k] is not None], numbers=(1,))
    if cost["cpu_s_per_success"] is None:
        yield note(
            "What the whole run took is not known: attempts lay in the store already, or other machines made them."
        )


def coverage_figure(plan: AugmentPlan, told: dict[str, Any]) -> Any:
    """Matplotlib figure with one panel per row of the randomisation: draws of successes and failures, and the yield in its boxes.
    ``told`` is the result of ``numbers``.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows = plan.space.rows
    columns = min(4, len(rows))
    lines = -(-len(rows) // columns)
    figure = Figure(figsize=(3.1 * columns, 3.0 * lines + 0.7), layout="constrained", dpi=110)
    FigureCanvasAgg(figure)
    axes = figure.subplots(lines, columns, squeeze=False).ravel()
    for ax, row in zip(axes, rows, strict=False):
        scale, unit = _SHOWN[row.unit]
        boxes = [b for b in told["bins"] if b["row"] == row.name]
        values = np.array([d[row.name] for d in told["draws"]]).reshape(-1, len(row.low)) * scale
        good = np.array([d["success"] for d in told["draws"]])
        ax.set_title(row.name.replace("_", " "), fontsize=9)
        ax.tick_params(labelsize=7)
        for side in ("top", "right"):
            ax.spines[side].set_visible(False)
        (_plane if len(row.low) == 2 else _line)(ax, boxes, values, good, scale, unit)
    for ax in axes[len(rows) :]:
        ax.set_visible(False)
    from matplotlib.lines import Line2D

    points = [
        Line2D([], [], ls="", marker="o", ms=4, color=_GOOD, label="success"),
        Line2D([], [], ls="", marker="x", ms=5, color=_BAD, label="failure"),
    ]
    figure.suptitle(
        f"{plan.spec.task}: draws of {len(told['draws'])} attempts ({plan.origin})",
        fontsize=10,
        x=0.01,
        ha="left",
    )
    figure.legend(handles=points, loc="outside lower left", ncols=2, fontsize=8, frameon=False)
    return figure


def _plane(ax: Any, boxes: list[dict[str, Any]], values: np.ndarray, good: np.ndarray, scale: float, unit: str) -> None:
    """x and y: boxes shaded by yield, draws over them."""
    from matplotlib.patches import Rectangle

    for b in boxes:
        (left, bottom), (right, top) = np.array(b["low"]) * scale, np.array(b["high"]) * scale
        size, rate = (right - left, top - bottom), b["share"]["rate"] or 0.0
        ax.add_patch(Rectangle((left, bottom), *size, facecolor=_CELL, alpha=0.45 * rate, lw=0, zorder=0))
        ax.add_patch(Rectangle((left, bottom), *size, fill=False, edgecolor="#9ca3af", lw=0.6, zorder=1))
        ax.annotate(
            f"{b['share']['successes']}/{b['share']['attempts']}", (left, top), (2, -3), textcoords="offset points",
            va="top", fontsize=7, zorder=4, bbox={"facecolor": "white", "alpha": 0.75, "lw": 0, "pad": 0.6},
        )  # fmt: skip
    _points(ax, values[:, 0], values[:, 1], good)
    ax.set_xlabel(f"x [{unit}]", fontsize=8)
    ax.set_ylabel(f"y [{unit}]", fontsize=8)


def _line(ax: Any, boxes: list[dict[str, Any]], values: np.ndarray, good: np.ndarray, scale: float, unit: str) -> None:
    """One number: yield of each box with its interval, draws above (successes) and below (failures)."""
    for b in boxes:
        (low,), (high,) = np.array(b["low"]) * scale, np.array(b["high"]) * scale
        share = Share(**_counts(b["share"]))
        if share.attempts:
            bottom, top = share.interval
            ax.bar((low + high) / 2, 100 * share.rate, 0.94 * (high - low), color=_CELL, alpha=0.45, zorder=0)
            ax.vlines((low + high) / 2, 100 * bottom, 100 * top, color="#374151", lw=1)
        ax.annotate(
            f"{share.successes}/{share.attempts}", ((low + high) / 2, 0), (0, 3), textcoords="offset points", ha="center",
            fontsize=7, color="#374151",
        )  # fmt: skip
    _points(ax, values[:, 0], np.where(good, 108.0, -8.0), good)
    ax.set_ylim(-15, 115)
    ax.set_yticks([0, 50, 100])
    ax.set_ylabel("yield [%]", fontsize=8)
    if unit:
        ax.set_xlabel(f"[{unit}]", fontsize=8)


def _points(ax: Any, x: np.ndarray, y: np.ndarray, good: np.ndarray) -> None:
    ax.scatter(x[good], y[good], s=7, color=_GOOD, alpha=0.7, lw=0, zorder=2)
    ax.scatter(x[~good], y[~good], s=18, color=_BAD, marker="x", lw=1.1, zorder=3)


def _png(figure: Any) -> bytes:
    stream = io.BytesIO()
    figure.savefig(stream, format="png", facecolor="white")
    return stream.getvalue()

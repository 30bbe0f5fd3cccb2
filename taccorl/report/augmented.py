"""Report of ``taccorl augment`` beside the dataset: yield over the reset space, sources, failures one by one, cost."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from taccorl.episodes.produce import Produced
from taccorl.episodes.sources.mimicgen.augment import AugmentPlan
from taccorl.episodes.sources.mimicgen.coverage import GENERATOR, Share, Spent, numbers, read_attempts
from taccorl.episodes.sources.mimicgen.grips import SAME_M, SAME_RAD, grips_warning
from taccorl.episodes.sources.mimicgen.stratify import GIVE_UP_FAILED, GIVE_UP_YIELD
from taccorl.lineage.store import Store
from taccorl.report import page
from taccorl.report.section import Cell, Picture, Section, Value

_SHOWN = {"m": (1e3, "mm"), "rad": (180 / np.pi, "°"), "kg": (1e3, "g"), "1": (1.0, "")}
_GOOD, _BAD, _CELL = "#0072b2", "#d55e00", "#009e73"
_SETTINGS = ("dataset", "source", "twin", "difficulty", "seed", "retarget", "contact_mode", "disturbance", "spec")
_COSTS = {
    "wall_s": "the whole run, by the clock on the wall [s]",
    "cpu_s_per_success": "CPU time of the whole run for each new episode [CPU-s]",
    "process_s_per_success": "attempts, failed ones too, for each new episode, wall clock of one process [s]",
    "median_success_process_s": "median attempt that succeeded: physics, again with touch, pictures, files [s]",
    "median_failure_process_s": "median attempt that failed: physics [s]",
}
"""Number of ``numbers(…)["cost"]`` → its words."""


def pages_of(out: Path) -> tuple[Path, Path]:
    """Return the paths of the report's HTML and JSON files, in this order, beside the dataset at ``out``. Raises TaccorlError:
    a file that taccorl did not write is there."""
    html, data = (out.with_name(f"{out.name}.augment_report.{kind}") for kind in ("html", "json"))
    page.check_free((html, data), GENERATOR, "another --out")
    return html, data


def write_report(
    plan: AugmentPlan, source: Path, out: Path, store: Store, produced: Produced, *, spent: Spent | None = None
) -> Path:
    """Write both files for the attempts of a run; returns the path of the page. An earlier report is replaced. ``spent``: time
    of the whole run, if all of its attempts were made in it."""
    made = numbers(plan, read_attempts(plan, produced.made, store), spent)
    made |= {"grips": produced.report["grips"], "source": str(source), "dataset": str(out)}
    html, data = pages_of(out)
    title = f"{plan.spec.task}: {made['all_attempts']['successes']} new episodes out of {source}"
    text = json.dumps(made, indent=1, ensure_ascii=False) + "\n"
    page.write({data: text, html: page.html(title, augmented(plan, made), GENERATOR)})
    return html


def augmented(plan: AugmentPlan, made: dict[str, Any]) -> list[Section]:
    """The page; ``made`` is the content of the JSON file."""
    every, plain = _share(made["all_attempts"]), _share(made["yield"])
    which = (
        f" — {made['yield_of']}. The later ones were chosen for poor boxes; all together: {every.successes} of {every.attempts}, "
        "which is no yield of that randomisation."
    ) * bool(made["stratify"])
    sources = [[s["source"], f"{100 * s['share_of_successes']:.0f} %", str(_share(s))] for s in made["sources"]]
    return [
        Section(text=[str(plan.origin)], style="data"),
        Section(text=[f"Yield: {plain}{which}"], style="high"),
        Section(rows=[(name, str(made[name])) for name in _SETTINGS]),
        *_filled(made),
        _where(plan, made, every),
        Section(
            title="Sources",
            text=["An attempt counts for every source that it uses; share: of the new episodes."],
            heads=("source", "share", "yield of attempts that use it"),
            rows=sources,
            right=(1, 2),
            parts=[_grips(made)],
        ),
        _failures(made, every.attempts),
        _costs(made["cost"]),
    ]


def _share(record: dict[str, Any]) -> Share:
    return Share(successes=record["successes"], attempts=record["attempts"])


def _grips(made: dict[str, Any]) -> Section:
    """Different grips of the sources, and what follows from few."""
    why, command = grips_warning(made["task"]) if made["grips"]["few"] else ("", "")
    return Section(
        text=[
            f"Grips: where a part lies in the hand while both pads touch it. Two are the same within {1e3 * SAME_M:g} mm and "
            f"{np.degrees(SAME_RAD):g}°."
        ],
        heads=("hand", "part", "sources that hold it", "different grips"),
        rows=[[g["arm"], g["part"], str(g["sources"]), str(g["different"])] for g in made["grips"]["hands"]],
        right=(2, 3),
        notes=[f"{why}:"] * bool(why),
        command=command,
    )


def _filled(made: dict[str, Any]) -> Iterator[Section]:
    """What --stratify did."""
    if not (chosen := made["stratify"]):
        return
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
    yield Section(
        title="Poor boxes filled",
        text=[
            f"After the first {chosen['first_attempts']} attempts, those were made whose draws lie in boxes with few episodes; "
            f"{chosen['passed_over']} were passed over, not simulated. Fair share of a box: episodes over the boxes of its row. "
            "The fewer the episodes, the more uneven they are by chance alone: the second line has as many as the dataset."
        ],
        heads=("", "episodes", "emptiest box: episodes", "of its fair share", "boxes at least half full"),
        rows=rows,
        right=(1, 3, 4),
    )
    if chosen["given_up"]:
        limit = f"at least {GIVE_UP_FAILED} attempts failed there and fewer than {100 * GIVE_UP_YIELD:.0f} % succeeded"
        yield _boxes(chosen["given_up"], "attempts there", f"Given up: {limit}.")


def _boxes(boxes: list[dict[str, Any]], head: str, text: str) -> Section:
    rows = [[b["row"], _range_words(b), str(_share(b["share"]))] for b in boxes]
    return Section(text=[text], heads=("row", "range", head), rows=rows, right=(2,))


def _where(plan: AugmentPlan, made: dict[str, Any], every: Share) -> Section:
    title, bins = "Where in the reset space", made["bins"]
    if not bins:
        return Section(title=title, notes=["Nothing was drawn: every attempt began in the nominal scene."])
    note = (
        "What each attempt drew, over the whole range that is drawn from. In a box: successes / attempts; green: all succeeded, "
        "white: none. Whiskers and brackets: 95 % intervals (Wilson)."
    )
    poor = [b for b in bins if b["share"]["attempts"] and b["share"]["interval_95"][1] < every.rate]
    empty = sum(not b["share"]["attempts"] for b in bins)
    notes = [note, *[f"{empty} of {len(bins)} boxes had no attempt."] * bool(empty)]
    chance = f"Of {len(bins)} boxes alike in truth, about {0.025 * len(bins):.1f} would."
    parts = [_boxes(poor, "yield", f"Boxes whose interval lies below the yield of all. {chance}")] if poor else []
    notes += [] if poor else ["No box's interval lies below the yield of all."]
    figures = [Picture(lambda: coverage_figure(plan, made), "coverage")]
    return Section(title=title, figures=figures, notes=notes, parts=parts)


def _range_words(b: dict[str, Any]) -> str:
    scale, unit = _SHOWN[b["unit"]]
    return ", ".join(
        f"{low * scale:.3g} … {high * scale:.3g} {unit}".rstrip() for low, high in zip(b["low"], b["high"], strict=True)
    )


def _failures(made: dict[str, Any], attempts: int) -> Section:
    if not made["failed"]:
        return Section(title="Failures", notes=["None."])
    counts = [[name, str(n), f"{100 * n / attempts:.0f} %"] for name, n in made["failures"].items()]
    rows: list[list[Value]] = []
    for f in made["failed"]:
        command = Cell(f["command"], "code") if f["command"] else "nothing: it broke before an action was kept"
        rows.append([str(f["attempt"]), f["outcome"], f["reason"], command])
    one = Section(
        text=[
            "The command executes an attempt again, from its stored actions and its scene's seed, and opens it in Rerun."
        ],
        heads=("attempt", "category", "why", "to look at it"),
        rows=rows,
        right=(0,),
    )
    heads = ("category", "attempts", "of all")
    return Section(title="Failures", heads=heads, rows=counts, right=(1, 2), parts=[one])


def _costs(cost: dict[str, Any]) -> Section:
    rows = [(words, f"{cost[key]:.2f}") for key, words in _COSTS.items() if cost[key] is not None]
    unknown = "What the whole run took is not known: attempts lay in the store already, or other machines made them."
    return Section(title="Cost", rows=rows, right=(1,), notes=[unknown] * (cost["cpu_s_per_success"] is None))


def coverage_figure(plan: AugmentPlan, made: dict[str, Any]) -> Any:
    """Matplotlib figure with one panel per row of the randomisation: draws of successes and failures, and the yield in its boxes.
    ``made`` is the result of ``numbers``.
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
        boxes = [b for b in made["bins"] if b["row"] == row.name]
        values = np.array([d[row.name] for d in made["draws"]]).reshape(-1, len(row.low)) * scale
        good = np.array([d["success"] for d in made["draws"]])
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
        f"{plan.spec.task}: draws of {len(made['draws'])} attempts ({plan.origin})", fontsize=10, x=0.01, ha="left"
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
        share = _share(b["share"])
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

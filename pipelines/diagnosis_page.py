"""``docs/diagnosis.md`` and its pictures, from the rows of ``pipelines/diagnosis_study.py``."""

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from pipelines.studies.figures import confusion_matrix, detection_curves, half_detected
from pipelines.studies.joints_and_pads import (
    AT_FLOOR,
    MATERIAL,
    drop_said,
    exact,
    exact_but_for_algebra,
    inside,
    material,
    named,
    silently_wrong,
)
from taccorl.data.origin import Origin

PAGE = Path("docs/diagnosis.md")
OTHERS = "<!-- Other machines: each section below is written by the command that it names. -->"
"""What follows this line in the page stays."""
ORIGIN = [Origin("surrogate", "simulated robots; nothing was measured on a robot")]
SIGNAL_BINS = (0.1, 0.5, 0.75, 1.1, 1.6, 2.4, 4.0, 8.0, 16.0, 64.0)
RUN = "pack chirp pairs none loop outside removed dropped touch touch_none touch_outside"
HEAD = f"""# Is the search for missing effects right?

Written by `python -m pipelines.diagnosis_study --page`; do not edit. **Every case is a surrogate robot, simulated; no number
here is of a real robot.** The surrogate is written apart from the twin (finer steps, rigid-body dynamics of its own, bristle
friction, noise, quantisation, jitter, coloured disturbance torques), with known effects hidden in one joint or in the pads of
one arm. Nobody tells the search the gains. Thresholds were chosen on seeds 300 to 999 and 15000 to 40099; nothing was tuned
on the seeds below, which start at 50000. Single effects and clean joints were measured once more after the solver's first step
had been mended (commanded gains, which the study does not use, could leave it at its start); no share changed. **All rows are of
the search before the beam search**, which was compared with it on other cases (section "Beam search").

How a robot is recorded hangs on its seed. **Efforts** are used in half of the cases, only positions in the others. In half of
the cases the drive's whole **loop is sampled**, at 0.5 to 4 kHz, with a differentiated encoder behind a low-pass of 0.3 to 3
ms and the torque held between samples; drawn are rates that are stable at 3.2 times the gains and that alone leave at most
0.5 noise floors once the gains are refitted (a slower one is an effect of its own: `slow_velocity_filter`, among those that
are unknown to the search). Heavy joints with play or a spring in the gear, which no such loop damps, keep a continuous
velocity loop. The encoder's noise is **coloured** (10 to 100 ms) in a quarter. **Packs** have a recording with 0.3 kg between
the pads, a few millimetres off their middle. Where nothing is hidden, a third of the robots hold a **weighed mass** of 0.1 to
0.5 kg at a measured place in every recording (where only the mass was stated and the place was 2 mm off, 18 of 55 robots got
an effect, mostly `payload`), a third have a sampled loop and a third coloured noise; efforts are used in half of those whose
loop is not sampled. With efforts a sampled loop whose timing the first-order `speed_delay` does not cover shows by itself; that
has a row of its own. Pads are judged by all their taxels, each a channel.

Two rows were not reached. **Lost commands**: of those that changed the motion by at least 0.6 noise floors all were said (19 of
19); the others lost 1 to 6 % of commands in motion so slow that the loss is below the noise. **CPU of packs**: seven recordings
of a pack cost seven times one, and the search needs about 2000 simulations of each; refitting fewer candidates to the end did
not bring the slow tenth down.

*Material*: the validation error, gains refitted, is at least {MATERIAL:g} noise floors; below that there is nothing to find.
*Exact*: the hidden effect is the one that was added first; of two, both are found. *Named*: it is that, or named with it as a
tie, a rival or a near-twin by nature. *Counted as one* are pairs that no angle tells apart: Coulomb friction and asymmetric
friction, command delay and sensor delay, gravity mismatch and torque scale; of the pads a gain map, its spread and dead
taxels. *Silent*: no effect is added. *Unknown*: the hidden effect is not in the registry, or was taken from the search.
*Near-twin*: for each kind outside the registry `surrogate/hidden.py` lists, beforehand, which effects do nearly the same.
*Said*: a finding of the recordings, or an effect. *Identifiable numbers* are those that the recordings determine: from
positions the ratios of all torques, stiffnesses, dampings, inertias and masses to K_p, and times, angles and shares; with
efforts the torques, too. Their intervals are counted where the search found exactly what is hidden. *Failed* cases (an
exception, a process that died, the time limit) count as wrong in every row. Intervals are 95 % (Wilson). *Signal*: what the
effect leaves above the floor on the validation recordings once the gains are refitted, √(error² − 1) floors. *50 %
detection*: the signal at which the effect is named in half of the robots, with its 95 % interval, from curves of one
steepness (log odds 5 times log signal).

"""


def share(count: int, n: int) -> str:
    """``87 % (34 of 39; 73 … 94)``"""
    if n == 0:
        return "not measured yet"
    ends = binomtest(count, n).proportion_ci(method="wilson")
    return f"{count / n:.0%} ({count} of {n}; {100 * ends.low:.0f} … {100 * ends.high:.0f})"


def write_page(rows: list[dict]) -> None:
    """Tables, confusion matrices and detection curves."""
    cases = [r for r in rows if r["study"] not in ("machine", "reference")]
    lines = [HEAD + _how(rows), "", "| what | asked | measured | met |", "|---|---|---|---|"]
    joints = _of(cases, "single")
    lines += _singles("one hidden joint effect, pack and chirp", joints, goal=True)
    for design, words in (
        ("pack", "… pack: chirp, triangle, steps, small chirp, 2× gain, payload"),
        ("chirp", "… the paper's 10 s chirp"),
    ):
        lines += _singles(words, [r for r in joints if r["design"] == design])
    for words, condition, there in (
        ("efforts used", "effort", True),
        ("positions only", "effort", False),
        ("sampled loop", "sampled", True),
        ("continuous loop", "sampled", False),
    ):
        own = [r for r in joints if material(r) and _has(r, condition) == there]
        lines.append(_share(f"… {words}: exact, counted as one", own, exact_but_for_algebra))
    mended = [r["errors"]["after"] for r in joints if "failed" not in r and material(r) and named(r)]
    lines.append(_spread("… error after / floor, validation", [e["validation"] for e in mended], (1.1, 1.3)))
    lines.append(_spread("… error after / floor, test (no choice has seen it)", [e["test"] for e in mended]))
    for words, alike in (("of 1 to 30 floors each", False), ("of 5 floors each", True)):
        both = [r for r in _of(cases, "pairs") if material(r) and (r["strength"] is not None) == alike]
        if both:
            lines.append(_share(f"two hidden effects {words}: both named", both, named, 0.85))
            lines.append(_share("… both found, counted as one", both, exact_but_for_algebra))
            lines.append(_share("… both found to the letter", both, exact))
    lines += _clean([r for r in _of(cases, "none") if r["design"] != "press"], "nothing hidden, joints", 0.98)
    timing = _of(cases, "loop")
    lines.append(
        _share("nothing hidden but a sampled loop that efforts show: no effect added", timing, lambda r: not r["found"])
    )
    lines.append(_share("… a remark, or another status than “at the floor”", timing, _worded))
    lines += _clean([r for r in _of(cases, "none") if r["design"] == "press"], "nothing hidden, pads", 0.98)
    lines += _unknown([r for r in _of(cases, "removed") if material(r)])
    lost = _of(cases, "dropped")
    lines.append(_share("1 to 10 % of commands lost or repeated: said", lost, drop_said, 0.9))
    other = [
        r for r in cases if r["study"] in ("none", "single", "pairs") and r["design"] != "press" and "failed" not in r
    ]
    lines.append(_share("… said although none was lost (nothing hidden, one or two other effects)", other, drop_said))
    lines += _intervals([r for r in cases if r["design"] != "press"], "joints", 0.88)
    pads = [r for r in _of(cases, "touch") if material(r)]
    lines += _intervals([r for r in cases if r["design"] == "press"], "pads", 0.85)
    lines.append(
        _share(
            "one hidden effect of the pads, press–hold–release: exact, counted as one", pads, exact_but_for_algebra, 0.9
        )
    )
    lines.append(_share("… exact to the letter", pads, exact))
    held = [r["errors"]["after"]["validation"] for r in pads if "failed" not in r and exact_but_for_algebra(r)]
    lines.append(_spread("… error after / floor, validation", held, (1.1, np.inf)))
    lines.append(_spread("CPU-seconds of a joint, pack and chirp", _cpu(joints), (8.0, 20.0)))
    lines.append(_spread("… pack", _cpu([r for r in joints if r["design"] == "pack"])))
    lines.append(_spread("CPU-seconds of one arm's pads", _cpu(_of(cases, "touch")), (40.0, np.inf)))
    lines += ["", *_failures(cases)]
    for design in ("pack", "chirp", "press"):
        own = [r for r in cases if r["study"] in ("single", "touch") and r["design"] == design and "failed" not in r]
        weak = [r for r in cases if r["study"] == "amplitude" and r["design"] == design and "failed" not in r]
        if own:
            lines += _single(own, weak, design)
    kept = PAGE.read_text(encoding="utf-8").partition(OTHERS) if PAGE.exists() else ("", "", "")
    PAGE.write_text("\n".join(lines) + "\n" + "".join(kept[1:]), encoding="utf-8")
    print(PAGE)


def _of(rows: list[dict], study: str) -> list[dict]:
    return [r for r in rows if r["study"] == study]


def _has(row: dict[str, Any], condition: str) -> bool:
    return condition in row.get("conditions", ())


def _worded(row: dict[str, Any]) -> bool:
    return row["status"] != "at_floor" or bool(row["remarks"])


def _cpu(rows: list[dict]) -> list[float]:
    return [r["cpu_s"] for r in rows if "failed" not in r]


def _how(rows: list[dict]) -> str:
    """Command, machines, and what a fixed amount of work took on them."""
    machines = dict.fromkeys(f"{r['machine']}, {r['workers']} processes" for r in rows if r["study"] == "machine")
    loops = [r["cpu_s"] for r in rows if r["study"] == "reference"]
    beside = (
        f"A reference loop (200 000 MuJoCo steps of a chain of twelve links, run {len(loops)} times among the cases) took "
        f"{np.median(loops):.2f} CPU-s in the median ({min(loops):.2f} to {max(loops):.2f})."
        if loops
        else "No reference loop was run beside them."
    )
    return (
        f"Commands: `python -m pipelines.diagnosis_study {RUN}`, then `python -m pipelines.diagnosis_study --page`. "
        f"Machine: {'; '.join(machines) or 'not stated'}; one thread a case. {beside}"
    )


def _singles(what: str, rows: list[dict], *, goal: bool = False) -> list[str]:
    own = [r for r in rows if material(r)]
    asked = (0.87, 0.97) if goal else (None, None)
    return [
        _share(f"{what}: exact, counted as one", own, exact_but_for_algebra, asked[0]),
        _share("… exact to the letter", own, exact),
        _share("… named", own, named, asked[1]),
    ]


def _clean(rows: list[dict], what: str, asked: float) -> list[str]:
    if not rows:
        return []
    lines = [_share(f"{what}: silent", rows, lambda r: not r["found"], asked)]
    for words, condition in (
        ("with a weighed mass", "loaded"),
        ("with a sampled loop", "sampled"),
        ("with coloured noise", "coloured"),
        ("with efforts", "effort"),
    ):
        own = [r for r in rows if _has(r, condition)]
        if own:
            lines.append(_share(f"… {words}", own, lambda r: not r["found"]))
    unsure = [r for r in rows if "failed" not in r and not r["found"] and r["status"] != "nothing_missing"]
    lines.append(f"| … silent, but with a status other than “nothing is missing” | | {len(unsure)} of {len(rows)} | |")
    return lines


def _unknown(rows: list[dict]) -> list[str]:
    what = 'the hidden effect unknown to the search: "something else", or a near-twin at the floor'
    return [
        _share(what, rows, lambda r: r["status"] not in AT_FLOOR or named(r), 0.95),
        _share("… no near-twin needed: the status is not “at the floor”", rows, lambda r: r["status"] not in AT_FLOOR),
        _share("… no wrong effect at the floor without a word", rows, lambda r: not silently_wrong(r), 0.95),
        _share(
            "… of kinds outside the registry", [r for r in rows if not r["without"]], lambda r: not silently_wrong(r)
        ),
    ]


def _intervals(rows: list[dict], what: str, asked: float) -> list[str]:
    known = [r for r in rows if "failed" not in r and r["study"] not in ("dropped", "loop", "amplitude")]
    right = [r for r in known if r["numbers"] and set(r["found"]) == set(r["hidden"])]
    everything = [t for r in right for t in inside(r)]
    hidden = [t for r in right for t in inside(r, hidden_only=True)]
    lines = [_count(f"95 % intervals of identifiable numbers that hold the truth, {what}", everything, asked)]
    lines.append(_count("… numbers of the hidden effects only", hidden))
    for words, there in (("sampled loop", True), ("continuous loop", False)):
        own = [t for r in right if _has(r, "sampled") == there for t in inside(r)]
        if what == "joints":
            lines.append(_count(f"… {words}", own))
    return lines


def _failures(rows: list[dict]) -> list[str]:
    wrong = [r for r in rows if "failed" in r]
    lines = [f"Cases that failed: {len(wrong)} of {len(rows)}; each counts as wrong above.", ""]
    for r in wrong[:20]:
        lines.append(f"- {r['key']}: {r['failed'].strip().splitlines()[-1]}")
    return [*lines, ""] if wrong else lines


def _count(what: str, held: Sequence[bool], asked: float | None = None) -> str:
    return _line(what, sum(held), len(held), asked)


def _share(what: str, rows: list[dict], is_so: Callable[[dict], bool], asked: float | None = None) -> str:
    """A row of the table: how many of the rows are so; of those that failed none is."""
    return _line(what, sum("failed" not in r and is_so(r) for r in rows), len(rows), asked)


def _line(what: str, count: int, n: int, asked: float | None) -> str:
    met = "" if not n or asked is None else "yes" if count >= asked * n else "**no**"
    goal = "" if asked is None else f"≥ {asked:.0%}"
    return f"| {what} | {goal} | {share(count, n)} | {met} |"


def _spread(what: str, values: Sequence[float], asked: tuple[float, float] | None = None) -> str:
    """A row of the table: median and 90th percentile."""
    goal = "" if asked is None else f"≤ {asked[0]:g}" + (f" / {asked[1]:g}" if np.isfinite(asked[1]) else "")
    if not values:
        return f"| {what}, median / 90th percentile | {goal} | not measured yet | |"
    found = float(np.median(values)), float(np.percentile(values, 90))
    met = "" if asked is None else "yes" if found[0] <= asked[0] and found[1] <= asked[1] else "**no**"
    return (
        f"| {what}, median / 90th percentile | {goal} | {found[0]:.2f} / {found[1]:.2f} (n = {len(values)}) | {met} |"
    )


def _single(rows: list[dict], weak: list[dict], design: str) -> list[str]:
    names = sorted({r["hidden"][0] for r in rows})
    counts = {n: Counter(_said(r) for r in rows if r["hidden"][0] == n and material(r)) for n in names}
    counts = {n: row for n, row in counts.items() if row}
    confusion = Path(f"docs/diagnosis_confusion_{design}.png")
    confusion_matrix(counts, ORIGIN, f"Hidden and named first, material cases, design {design}").savefig(
        confusion, dpi=110
    )
    curve = Path(f"docs/diagnosis_detection_{design}.png")
    points = {n: _detections([r for r in (*rows, *weak) if r["hidden"][0] == n]) for n in names}
    title = f"Found or named, over signal to noise, design {design}"
    detection_curves(points, ORIGIN, title, SIGNAL_BINS).savefig(curve, dpi=110)
    lines = [f"## Design {design}", "", f"![confusion]({confusion.name})", "", f"![detection]({curve.name})", ""]
    lines += [
        "Strength: the first identifiable number of the hidden effect, where that was found. The surrogate's equations are not",
        "the twin's, so some of what is left is not noise.",
        "",
        "| hidden | cases | material | exact | named | 50 % detection at | error of its strength, median | within its interval |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for n in names:
        own = [r for r in rows if r["hidden"][0] == n]
        there = [r for r in own if material(r)]
        found = [r for r in there if exact(r)]
        errors = [e for r in found for e in _strength_errors(r)]
        error = f"{np.median(errors):.1%}" if errors else "–"
        within = [t for r in found for t in inside(r, hidden_only=True)[:1]]
        cells = [n, len(own), len(there), len(found), sum(map(named, there)), _half(*points[n]), error]
        lines.append("| " + " | ".join(map(str, (*cells, f"{sum(within)} of {len(within)}"))) + " |")
    return [*lines, ""]


def _said(row: dict[str, Any]) -> str:
    words = {"nothing_missing": "nothing", "something_else": "something else"}
    return str(row["first"] or words.get(str(row["status"]), "too many"))


def _signal(row: dict[str, Any]) -> float:
    """What the effect leaves above the floor, in floors, once the gains are refitted."""
    return float(np.sqrt(max(row["errors"]["fitted"]["validation"] ** 2 - 1.0, 0.01)))


def _detections(rows: list[dict]) -> tuple[np.ndarray, np.ndarray]:
    """Signals, and whether the effect was named."""
    return np.array([_signal(r) for r in rows]), np.array([named(r) for r in rows])


def _half(signals: np.ndarray, found: np.ndarray) -> str:
    """Signal to noise at which half are named, with its interval."""
    half, low, high = half_detected(signals, found)
    if np.isinf(high):
        return f"above {low:.2g}: never seen" if not found.any() else f"above {low:.2g}"
    return f"{half:.2g} ({low:.2g} … {high:.2g})" if low > 0 else f"below {high:.2g}"


def _strength_errors(row: dict[str, Any]) -> list[float]:
    """Relative error of the first identifiable number of the hidden effect."""
    own = [n for name, n in row["numbers"].items() if name.startswith(f"{row['hidden'][0]}.")]
    return [abs(value / true - 1.0) for value, _, _, true in own[:1] if true]


def replace_section(title: str, text: str) -> None:
    """Write the section ``## title`` of another machine into the page, below ``OTHERS``; an older one of that title goes."""
    own, _, others = PAGE.read_text(encoding="utf-8").partition(OTHERS)
    sections = [f"## {part}" for part in others.split("\n## ")[1:]]
    sections = [s.rstrip("\n") for s in sections if s.splitlines()[0] != f"## {title}"]
    sections.append(f"## {title}\n\n{text.rstrip()}")
    PAGE.write_text("\n\n".join([own.rstrip("\n"), OTHERS, *sections]) + "\n", encoding="utf-8")

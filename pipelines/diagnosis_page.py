"""``docs/diagnosis.md`` and its pictures, from the rows of ``pipelines/diagnosis_study.py``."""

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

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
from pipelines.studies.robots import share
from taccorl.data.origin import Origin

PAGE = Path("docs/diagnosis.md")
OTHERS = "<!-- Other machines: the tables below are printed by the command that their section names. -->"
"""What follows this line in the page stays."""
STUDY = "<!-- Study: python -m pipelines.diagnosis_study --page writes what follows, up to the next such line. -->"
"""What precedes this line in the page stays."""
ORIGIN = [Origin("surrogate", "simulated robots; nothing was measured on a robot")]
SIGNAL_BINS = (0.1, 0.5, 0.75, 1.1, 1.6, 2.4, 4.0, 8.0, 16.0, 64.0)
RUN = (
    "pack chirp pairs none loop outside removed dropped touch touch_none touch_outside"
)
HEAD = f"""## How often the search is right

**Every case is a surrogate robot, simulated**, written apart from the twin (finer steps, dynamics of its own, bristle friction,
noise, quantisation, jitter, disturbances). Known effects are hidden in one joint or the pads of one arm; the search (94553cfb)
does not know the gains. Half of the cases use efforts, half a loop sampled at 0.5 to 4 kHz. No threshold was chosen on them.

| word | meaning |
|---|---|
| material | the validation error, gains refitted, is at least {MATERIAL:g} noise floors |
| exact | the hidden effect was added first; of two, both |
| counted as one | effects that angles cannot tell apart, such as Coulomb and asymmetric friction, command and sensor delay |
| named | exact, or named beside it: a tie or rival explains these recordings as well, a near-twin acts alike by nature |
| silent; unknown | no effect is added; the hidden effect is not in the registry, or was taken from the search |
| identifiable numbers | what recordings determine: of positions times, angles, torques over K_p; of efforts torques in N·m |
| 50 % detection | √(error² − 1) floors, gains refitted, at which half of the cases are named |

Intervals are 95 % (Wilson).

"""


def write_page(rows: list[dict]) -> None:
    """Tables, confusion matrices and detection curves."""
    cases = [r for r in rows if r["study"] not in ("machine", "reference")]
    lines = [
        HEAD + _how(rows),
        "",
        "| what | asked | measured | met |",
        "|---|---|---|---|",
    ]
    joints = _of(cases, "single")
    one = [r for r in joints if material(r)]
    lines.append(
        _share(
            "one hidden joint effect, pack and chirp: exact, counted as one",
            one,
            exact_but_for_algebra,
            0.87,
        )
    )
    lines += [
        _share("… exact to the letter", one, exact),
        _share("… named", one, named, 0.97),
    ]
    for design, words in (
        ("pack", "… pack: chirp, triangle, steps, small chirp, 2× gain, payload"),
        ("chirp", "… the paper's 10 s chirp"),
    ):
        own = [r for r in joints if r["design"] == design and material(r)]
        lines.append(
            _share(f"{words}: exact, counted as one", own, exact_but_for_algebra)
        )
    for words, condition, there in (
        ("efforts used", "effort", True),
        ("positions only", "effort", False),
    ):
        own = [
            r
            for r in joints
            if material(r) and (condition in r.get("conditions", ())) == there
        ]
        lines.append(
            _share(f"… {words}: exact, counted as one", own, exact_but_for_algebra)
        )
    mended = [
        r["errors"]["after"]
        for r in joints
        if "failed" not in r and material(r) and named(r)
    ]
    lines.append(
        _spread(
            "… error after / floor, validation",
            [e["validation"] for e in mended],
            (1.1, 1.3),
        )
    )
    lines.append(
        _spread(
            "… error after / floor, test (no choice has seen it)",
            [e["test"] for e in mended],
        )
    )
    for words, alike in (("of 1 to 30 floors each", False), ("of 5 floors each", True)):
        both = [
            r
            for r in _of(cases, "pairs")
            if material(r) and (r["strength"] is not None) == alike
        ]
        if both:
            lines.append(
                _share(f"two hidden effects {words}: both named", both, named, 0.85)
            )
            lines.append(
                _share("… both found, counted as one", both, exact_but_for_algebra)
            )
            lines.append(_share("… both found to the letter", both, exact))
    lines += _clean(
        [r for r in _of(cases, "none") if r["design"] != "press"],
        "nothing hidden, joints",
        0.98,
    )
    timing = _of(cases, "loop")
    lines.append(
        _share(
            "nothing hidden but a sampled loop that efforts show: no effect added",
            timing,
            lambda r: not r["found"],
        )
    )
    lines.append(
        _share("… a remark, or another status than “at the floor”", timing, _worded)
    )
    lines += _clean(
        [r for r in _of(cases, "none") if r["design"] == "press"],
        "nothing hidden, pads",
        0.98,
    )
    lines += _unknown([r for r in _of(cases, "removed") if material(r)])
    lost = _of(cases, "dropped")
    lines.append(
        _share("1 to 10 % of commands lost or repeated: said", lost, drop_said, 0.9)
    )
    shown = [r for r in lost if r["left_floors"] >= 0.9]
    lines.append(
        _share("… where they change the motion by 0.9 floors or more", shown, drop_said)
    )
    other = [
        r
        for r in cases
        if r["study"] in ("none", "single", "pairs")
        and r["design"] != "press"
        and "failed" not in r
    ]
    lines.append(
        _share(
            "… said although none was lost (nothing hidden, one or two other effects)",
            other,
            drop_said,
        )
    )
    lines += _intervals([r for r in cases if r["design"] != "press"], "joints", 0.88)
    pads = [r for r in _of(cases, "touch") if material(r)]
    lines += _intervals([r for r in cases if r["design"] == "press"], "pads", 0.85)
    lines.append(
        _share(
            "one hidden effect of the pads, press–hold–release: exact, counted as one",
            pads,
            exact_but_for_algebra,
            0.9,
        )
    )
    lines.append(_share("… exact to the letter", pads, exact))
    held = [
        r["errors"]["after"]["validation"]
        for r in pads
        if "failed" not in r and exact_but_for_algebra(r)
    ]
    lines.append(_spread("… error after / floor, validation", held, (1.1, np.inf)))
    lines.append(
        _spread("CPU-seconds of a joint, pack and chirp", _cpu(joints), (8.0, 20.0))
    )
    lines.append(
        _spread(
            "CPU-seconds of one arm's pads", _cpu(_of(cases, "touch")), (40.0, np.inf)
        )
    )
    lines += ["", *_failures(cases)]
    for title, study, designs in (
        ("joints", "single", ("pack", "chirp")),
        ("pads", "touch", ("press",)),
    ):
        own = [
            r for r in _of(cases, study) if r["design"] in designs and "failed" not in r
        ]
        if own:
            lines += _single(own, f"Effects of {title}")
    page = PAGE.read_text(encoding="utf-8") if PAGE.exists() else ""
    before = page.partition(STUDY)[0] if STUDY in page else ""
    after = "".join(page.partition(OTHERS)[1:])
    written = "\n".join([before + STUDY, *lines, after])
    PAGE.write_text(written, encoding="utf-8")
    print(PAGE)


def _of(rows: list[dict], study: str) -> list[dict]:
    return [r for r in rows if r["study"] == study]


def _worded(row: dict[str, Any]) -> bool:
    return row["status"] != "at_floor" or bool(row["remarks"])


def _cpu(rows: list[dict]) -> list[float]:
    return [r["cpu_s"] for r in rows if "failed" not in r]


def _how(rows: list[dict]) -> str:
    """Command, machines, and what a fixed amount of work took on them."""
    machines = dict.fromkeys(
        f"{r['machine']}, {r['workers']} processes"
        for r in rows
        if r["study"] == "machine"
    )
    loops = [r["cpu_s"] for r in rows if r["study"] == "reference"]
    beside = (
        f"200 000 MuJoCo steps of a chain of twelve links took {np.median(loops):.2f} CPU-s in the median of {len(loops)} runs "
        f"({min(loops):.2f} to {max(loops):.2f})."
        if loops
        else "No reference loop was run beside them."
    )
    return (
        f"Commands: `python -m pipelines.diagnosis_study {RUN}`, then `python -m pipelines.diagnosis_study --page`. "
        f"Machine: {'; '.join(machines) or 'not stated'}; one thread a case. {beside}"
    )


def _clean(rows: list[dict], what: str, asked: float) -> list[str]:
    return (
        [_share(f"{what}: silent", rows, lambda r: not r["found"], asked)]
        if rows
        else []
    )


def _unknown(rows: list[dict]) -> list[str]:
    what = 'the hidden effect unknown to the search: "something else", or a near-twin at the floor'
    return [
        _share(what, rows, lambda r: r["status"] not in AT_FLOOR or named(r), 0.95),
        _share(
            "… no near-twin needed: the status is not “at the floor”",
            rows,
            lambda r: r["status"] not in AT_FLOOR,
        ),
        _share(
            "… no wrong effect at the floor without a word",
            rows,
            lambda r: not silently_wrong(r),
            0.95,
        ),
        _share(
            "… of kinds outside the registry",
            [r for r in rows if not r["without"]],
            lambda r: not silently_wrong(r),
        ),
    ]


def _intervals(rows: list[dict], what: str, asked: float) -> list[str]:
    known = [
        r for r in rows if "failed" not in r and r["study"] not in ("dropped", "loop")
    ]
    right = [r for r in known if r["numbers"] and set(r["found"]) == set(r["hidden"])]
    everything = [t for r in right for t in inside(r)]
    hidden = [t for r in right for t in inside(r, hidden_only=True)]
    lines = [
        _count(
            f"95 % intervals of identifiable numbers that hold the truth, {what}",
            everything,
            asked,
        )
    ]
    lines.append(_count("… numbers of the hidden effects only", hidden))
    return lines


def _failures(rows: list[dict]) -> list[str]:
    wrong = [r for r in rows if "failed" in r]
    lines = [
        f"Cases that failed: {len(wrong)} of {len(rows)}; each counts as wrong above.",
        "",
    ]
    for r in wrong[:20]:
        lines.append(f"- {r['key']}: {r['failed'].strip().splitlines()[-1]}")
    return [*lines, ""] if wrong else lines


def _count(what: str, held: Sequence[bool], asked: float | None = None) -> str:
    return _line(what, sum(held), len(held), asked)


def _share(
    what: str,
    rows: list[dict],
    is_so: Callable[[dict], bool],
    asked: float | None = None,
) -> str:
    """A row of the table: how many of the rows are so; of those that failed none is."""
    return _line(
        what, sum("failed" not in r and is_so(r) for r in rows), len(rows), asked
    )


def _line(what: str, count: int, n: int, asked: float | None) -> str:
    met = "" if not n or asked is None else "yes" if count >= asked * n else "**no**"
    goal = "" if asked is None else f"≥ {asked:.0%}"
    return f"| {what} | {goal} | {share(count, n)} | {met} |"


def _spread(
    what: str, values: Sequence[float], asked: tuple[float, float] | None = None
) -> str:
    """A row of the table: median and 90th percentile."""
    goal = (
        ""
        if asked is None
        else f"≤ {asked[0]:g}" + (f" / {asked[1]:g}" if np.isfinite(asked[1]) else "")
    )
    if not values:
        return f"| {what}, median / 90th percentile | {goal} | not measured yet | |"
    found = float(np.median(values)), float(np.percentile(values, 90))
    met = (
        ""
        if asked is None
        else "yes"
        if found[0] <= asked[0] and found[1] <= asked[1]
        else "**no**"
    )
    return f"| {what}, median / 90th percentile | {goal} | {found[0]:.2f} / {found[1]:.2f} (n = {len(values)}) | {met} |"


def _single(rows: list[dict], title: str) -> list[str]:
    """Section of the effects of ``rows``: figures of each design, and one table."""
    lines = [f"## {title}", ""]
    for design in dict.fromkeys(r["design"] for r in rows):
        own = [r for r in rows if r["design"] == design]
        names = sorted({r["hidden"][0] for r in own})
        counts = {
            n: Counter(_said(r) for r in own if r["hidden"][0] == n and material(r))
            for n in names
        }
        confusion = Path(f"docs/diagnosis_confusion_{design}.png")
        confusion_matrix(
            {n: row for n, row in counts.items() if row},
            ORIGIN,
            f"Hidden and named first, material cases, design {design}",
        ).savefig(confusion, dpi=110)
        curve = Path(f"docs/diagnosis_detection_{design}.png")
        points = {
            n: _detections([r for r in own if r["hidden"][0] == n]) for n in names
        }
        words = f"Found or named, over signal to noise, design {design}"
        detection_curves(points, ORIGIN, words, SIGNAL_BINS).savefig(curve, dpi=110)
        lines += [
            f"![confusion, {design}]({confusion.name})",
            "",
            f"![detection, {design}]({curve.name})",
            "",
        ]
    lines += [
        "| hidden | exact/named/material/cases | 50 % detection | error of first number |"
    ]
    lines += ["|---|---|---|---|"]
    for n in sorted({r["hidden"][0] for r in rows}):
        own = [r for r in rows if r["hidden"][0] == n]
        there = [r for r in own if material(r)]
        found = [r for r in there if exact(r)]
        errors = [e for r in found for e in _strength_errors(r)]
        half = _half(*_detections(own))
        error = f"{np.median(errors):.1%}" if errors else "–"
        cells = [
            n,
            f"{len(found)}/{sum(map(named, there))}/{len(there)}/{len(own)}",
            half,
            error,
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return [*lines, ""]


def _said(row: dict[str, Any]) -> str:
    words = {"nothing_missing": "nothing", "something_else": "something else"}
    return str(row["first"] or words.get(str(row["status"]), "too many"))


def _detections(rows: list[dict]) -> tuple[np.ndarray, np.ndarray]:
    """Signals, what the effect leaves above the floor in floors once the gains are refitted, and whether it was named."""
    left = np.array([row["errors"]["fitted"]["validation"] for row in rows])
    return np.sqrt(np.maximum(left**2 - 1.0, 0.01)), np.array([named(r) for r in rows])


def _half(signals: np.ndarray, found: np.ndarray) -> str:
    """Signal to noise at which half are named, with its interval."""
    half, low, high = half_detected(signals, found)
    if np.isinf(high):
        return f"above {low:.2g}"
    return f"{half:.2g} ({low:.2g} … {high:.2g})" if low > 0 else f"below {high:.2g}"


def _strength_errors(row: dict[str, Any]) -> list[float]:
    """Relative error of the first identifiable number of the hidden effect."""
    own = [
        n
        for name, n in row["numbers"].items()
        if name.startswith(f"{row['hidden'][0]}.")
    ]
    return [abs(value / true - 1.0) for value, _, _, true in own[:1] if true]

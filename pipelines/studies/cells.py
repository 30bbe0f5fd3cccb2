"""How often the search names the effect that is hidden in a simulated tactile sensor of several cells: one of thirteen, or none.

``python -m pipelines.studies.cells rows.jsonl`` runs the cases that the file lacks, in six CPU-minutes, and prints the tables
of docs/diagnosis.md. Exact: the hidden effect alone was found; nothing where none is hidden. Named: it is the first or a
tie, rival or near-twin of it. Material: the validation error, gain and offset fitted, is at least 1.5 noise floors.
"""

import time
from collections.abc import Sequence
from statistics import median_high
from typing import Any

from pipelines.studies.robots import MATERIAL_FLOORS, share_row, study
from taccorl.diagnosis.problems.cells_problem import CellsProblem
from taccorl.diagnosis.search.result import SearchConfig
from taccorl.diagnosis.search.search import diagnose
from taccorl.surrogate.cells import HIDDEN, draw_cells, simulated

ASKED = (
    *(
        "taxel_saturation",
        "taxel_power_law",
        "taxel_threshold",
        "taxel_hysteresis",
        "taxel_creep",
        "touch_lag",
    ),
    *("touch_delay", "baseline_drift", "taxel_play"),
)
"""Nine effects of a single cell that reads nothing but a load; the others need a long hold, a temperature or neighbours."""
FIRST_SEED, SENSORS, CLEAN = 50_000, 5, 20
"""Nothing was tuned on seeds from the first on."""
Row = dict[str, Any]


def jobs() -> list[tuple[int, str]]:
    """(seed, hidden effect or nothing)."""
    names = [*(name for name in HIDDEN for _ in range(SENSORS)), *[""] * CLEAN]
    return [(FIRST_SEED + k, name) for k, name in enumerate(names)]


def run(job: tuple[int, str]) -> Row:
    """Draw a sensor, record it, and search to the noise floor. Errors in noise floors; ``error``: of the first number of the
    hidden effect, as a share."""
    seed, hidden = job
    case = draw_cells(hidden, seed)
    measurements = simulated(case)
    began = time.process_time()
    problem = CellsProblem(case.config(), measurements)
    d = diagnose(
        problem,
        problem.fit,
        problem.validation,
        problem.test,
        start=problem.start,
        config=SearchConfig(),
    )
    cpu_s = time.process_time() - began
    alike = {
        n
        for name in d.names[:1]
        for n in (name, *d.rivals.get(name, ()), *d.twins.get(name, {}))
    }
    own = [
        getattr(e, name) / value
        for e in d.effects
        if e.name == hidden
        for name, value in [*case.values.items()][:1]
    ]
    return {
        "seed": seed,
        "hidden": hidden,
        "found": list(d.names),
        "named": hidden in alike if hidden else not d.names,
        "status": d.status,
        "before": round(d.errors["fitted"]["validation"], 3),
        "after": round(d.errors["after"]["test"], 3),
        "error": round(abs(own[0] - 1.0), 4) if own else None,
        "cpu_s": round(cpu_s, 2),
    }


def exact(row: Row) -> bool:
    return row["found"] == [row["hidden"]] * bool(row["hidden"])


def material(row: Row) -> bool:
    return row["before"] >= MATERIAL_FLOORS


def counted(rows: Sequence[Row]) -> list[str]:
    """Lines of Markdown: a table with the share of right answers, a table with a row for each hidden effect, and a list of the
    cases in which not exactly the hidden effect was found."""
    asked, others = (
        [r for r in rows if r["hidden"] and (r["hidden"] in ASKED) == one]
        for one in (True, False)
    )
    seen, clean = (
        [r for r in asked if material(r)],
        [r for r in rows if not r["hidden"]],
    )
    lines = ["| what | asked | measured |", "|---|---|---|"]
    lines += [
        share_row("nine effects of one cell: exact", "≥ 85 %", seen, exact),
        share_row("… exact, counting those that are not material", "", asked, exact),
        share_row(
            "… named (with ties, rivals and near-twins)", "", seen, lambda r: r["named"]
        ),
        share_row(
            "effects of a long hold, a temperature or neighbours: exact",
            "",
            [*filter(material, others)],
            exact,
        ),
        share_row("nothing hidden: silent", "≥ 98 %", clean, exact),
        "\n| hidden | cases | material | exact | before, validation | after, test | error of its number |",
        "|---|---|---|---|---|---|---|",
    ]
    for hidden in dict.fromkeys(r["hidden"] for r in rows):
        own = [r for r in rows if r["hidden"] == hidden]
        shown = [r for r in own if material(r)] if hidden else own
        known = [r["error"] for r in shown if r["error"] is not None]
        middle = (
            f"{median_high(r[name] for r in own):.2f}" for name in ("before", "after")
        )
        cells = (
            hidden or "nothing",
            len(own),
            sum(map(material, own)),
            f"{sum(map(exact, shown))} of {len(shown)}",
        )
        lines.append(
            f"| {' | '.join(map(str, (*cells, *middle, f'{median_high(known):.1%}' if known else '–')))} |"
        )
    wrong = [r for r in rows if not exact(r)]
    told = [
        f"{r['hidden'] or 'nothing'} (seed {r['seed']}): {' and '.join(r['found']) or 'nothing'}, {r['status']}"
        for r in wrong
    ]
    lines.append(f"\nNot exact: {'; '.join(told) or 'none'}.")
    return lines


if __name__ == "__main__":
    study(jobs(), run, counted)

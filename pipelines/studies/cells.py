"""How often the search is right about a simulated sensor of cells: one case with a hidden effect, and a table of many."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median_high

from taccorl.diagnosis.problems.cells_problem import CellsProblem
from taccorl.diagnosis.search.result import SearchConfig
from taccorl.diagnosis.search.search import diagnose
from taccorl.surrogate.cells import HIDDEN, draw_cells, simulated

ASKED = (
    *("taxel_saturation", "taxel_power_law", "taxel_threshold", "taxel_hysteresis", "taxel_creep", "touch_lag"),
    *("touch_delay", "baseline_drift", "taxel_play"),
)
"""Nine effects of a single cell that reads nothing but a load; the others need a long hold, a temperature or neighbours."""
MATERIAL = 1.5
"""Validation error in noise floors, gain and offset fitted, below which there is nothing to find."""
FIRST_SEED = 50_000
"""Nothing was tuned on seeds from here on."""


@dataclass(frozen=True, kw_only=True)
class CellsRow:
    """What came out of one case."""

    hidden: str
    """Empty for a clean sensor."""
    seed: int
    found: tuple[str, ...]
    named: bool
    """The hidden effect is the one that was added first, or a tie, a rival or a near-twin of it."""
    status: str
    before: float
    """Validation error in noise floors, gain and offset fitted."""
    after: float
    """Test error in noise floors with what was found."""
    error: float
    """Of the first number of the hidden effect, as a share; NaN where another effect was found."""
    cpu_s: float

    @property
    def exact(self) -> bool:
        """Exactly the hidden effect was found; of a clean sensor nothing."""
        return self.found == ((self.hidden,) if self.hidden else ())

    @property
    def material(self) -> bool:
        return self.before >= MATERIAL


def run_cells(hidden: str, seed: int) -> CellsRow:
    """Draw a sensor, record it, and search to the noise floor."""
    case = draw_cells(hidden, seed)
    measurements = simulated(case)
    began = time.process_time()
    problem = CellsProblem(case.config(), measurements)
    d = diagnose(problem, problem.fit, problem.validation, problem.test, start=problem.start, config=SearchConfig())
    cpu_s = time.process_time() - began
    first = d.names[:1]
    alike = {n for name in first for n in (name, *d.rivals.get(name, ()), *d.twins.get(name, {}))}
    truth = next(iter(case.values.items()), ("", 0.0))
    own = [e for e in d.effects if e.name == hidden]
    error = abs(getattr(own[0], truth[0]) / truth[1] - 1.0) if own else float("nan")
    return CellsRow(
        hidden=hidden,
        seed=seed,
        found=d.names,
        named=hidden in alike if hidden else not d.names,
        status=d.status,
        before=d.errors["fitted"]["validation"],
        after=d.errors["after"]["test"],
        error=error,
        cpu_s=cpu_s,
    )


def table(rows: Sequence[CellsRow]) -> list[str]:
    """Lines of Markdown: a line for each hidden effect, and each case that was not exact."""
    lines = ["| hidden | cases | material | exact | before, validation | after, test | error of its number |"]
    lines += ["|---|---|---|---|---|---|---|"]
    for hidden in (*HIDDEN, ""):
        own = [r for r in rows if r.hidden == hidden]
        seen = [r for r in own if r.material] if hidden else own
        if not own:
            continue
        cells = [hidden or "nothing", str(len(own)), str(len([r for r in own if r.material]))]
        cells += [
            f"{sum(r.exact for r in seen)} of {len(seen)}",
            f"{median_high(r.before for r in own):.2f}",
            f"{median_high(r.after for r in own):.2f}",
        ]
        known = [r.error for r in seen if r.error == r.error]
        cells += [f"{median_high(known):.1%}" if known else "–"]
        lines.append(f"| {' | '.join(cells)} |")
    wrong = [r for r in rows if not r.exact]
    told = [f"{r.hidden or 'nothing'} (seed {r.seed}): {' and '.join(r.found) or 'nothing'}, {r.status}" for r in wrong]
    return [*lines, "", f"Not exact: {'; '.join(told) or 'none'}."]

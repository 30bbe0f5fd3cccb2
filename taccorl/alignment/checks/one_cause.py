"""One cause for the findings of a set: a column that is wrong in every recording looks reversed in one and late in another.

If a signal is reversed, or exchanged with its target, in most of the recordings that have an error of it, the others are checked
again with that corrected. Those that pass have the same cause; findings that follow from it are removed.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence

from taccorl.alignment.checks.clock import EXCHANGED_COLUMNS
from taccorl.alignment.checks.telemetry import check_measurement
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.data.finding import Finding


def _turned(m: Measurement, j: int) -> Measurement:
    measured = m.measured.copy()
    measured[:, j] *= -1.0
    return dataclasses.replace(m, measured=measured)


def _exchanged(m: Measurement, j: int) -> Measurement:
    measured, target = m.measured.copy(), m.target.copy()
    measured[:, j], target[:, j] = m.target[:, j], m.measured[:, j]
    return dataclasses.replace(m, measured=measured, target=target)


CAUSES: Mapping[str, Callable[[Measurement, int], Measurement]] = {
    "reversed": _turned,
    EXCHANGED_COLUMNS: _exchanged,
}
"""Check → function that returns the recording with column j corrected."""
FOLLOWS = (
    *CAUSES, "measured_before_command", "reversed_effort", "wrong_inertia", "effort_time", "sticking_joint", "blocked",
    "dropped_commands", "does_not_repeat", "late_answer", "not_judged",
)  # fmt: skip
"""Checks whose findings about a signal may follow from these causes."""


def one_cause(found: Mapping[str, Sequence[Finding]], recordings: Sequence[Measurement]) -> dict[str, list[Finding]]:
    """Findings of a set with one cause for each signal whose columns are wrong in the same way.

    Args:
        found: name of a recording → its findings.
    """
    result = {name: list(findings) for name, findings in found.items()}
    wrong = {f.feature for findings in result.values() for f in findings if f.check in CAUSES and f.severity == "error"}
    for signal in sorted(wrong):
        of = {name: [f for f in own if f.feature == signal and f.check in FOLLOWS] for name, own in result.items()}
        errors = {name: [f for f in own if f.severity == "error"] for name, own in of.items()}
        votes = {cause: [n for n, own in errors.items() if cause in {f.check for f in own}] for cause in CAUSES}
        cause = max(votes, key=lambda c: len(votes[c]))
        others = [n for n, own in errors.items() if own and n not in votes[cause]]
        if len(votes[cause]) <= len(others):
            continue
        same = {m.name for m in recordings if m.name in others and _passes(CAUSES[cause](m, m.column(signal)), signal)}
        first = next(f for f in errors[votes[cause][0]] if f.check == cause)
        if cause == "reversed" and any(f.check == "reversed_effort" for own in errors.values() for f in own):
            first = dataclasses.replace(
                first, text=f"{first.text}. Its effort pushes against its acceleration as well: it is {signal}.q"
            )
        for name, own in result.items():
            if name in others and name not in same:
                continue  # it has a cause of its own
            result[name] = [f for f in own if f not in of[name]]
            if name == votes[cause][0]:
                result[name].append(first)
            elif name in same:
                text = f"{signal}: as in {votes[cause][0]}; with that corrected this recording passes"
                result[name].append(Finding(cause, "error", signal, text))
            else:
                result[name] += [f for f in errors[name] if f.check == cause]
    return result


def _passes(m: Measurement, signal: str) -> bool:
    left = check_measurement(m.only([signal]))
    return not any(f.severity == "error" and f.check in FOLLOWS for f in left)

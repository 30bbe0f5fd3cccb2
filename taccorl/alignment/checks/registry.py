"""The list of checks of measurements. A check is a function that yields findings; the decorator puts it into the list.

    @check("error", "reversed", needs="position", explains=("measured_before_command", "blocked"))
    def reversed_sign(t: Trial) -> Iterator[Finding]: ...

``telemetry`` runs the functions of one need after the other, in the order of the list. ``--accept`` takes the names that can
end in an error, and what a check explains is removed beside its finding.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from taccorl.data.finding import Finding, Severity
from taccorl.errors import TaccorlError, nearest


@dataclass(frozen=True)
class Check:
    """A name in the list."""

    severity: Severity  # Severity of its findings, unless one states another
    explains: tuple[
        str, ...
    ] = ()  # Checks whose findings about the same signal may follow from this one
    of_all: bool = False  # True: its findings depend on the columns of every signal


CHECKS: dict[
    str, Check
] = {}  # Name of every check of measurements. Thresholds stand beside the functions.
_FUNCTIONS: dict[str, list[Callable[..., Any]]] = {}


def check[F: Callable[..., Any]](
    severity: Severity,
    *names: str,
    needs: str = "",
    explains: tuple[str, ...] = (),
    of_all: bool = False,
) -> Callable[[F], F]:
    """Decorator that puts checks into the list, in this order. ``needs``: what a trial needs for the function to run (see
    ``run``); "": another decorator of the function says so, or other code calls it. ``explains``, ``of_all``: as in ``Check``."""
    CHECKS.update(dict.fromkeys(names, Check(severity, explains, of_all)))

    def listed(function: F) -> F:
        if needs:
            _FUNCTIONS.setdefault(needs, []).append(function)
        return function

    return listed


def run(needs: str, *trial: Any) -> list[Finding]:
    """Findings of all checks that need ``needs``, in the order of the list."""
    return [f for function in _FUNCTIONS[needs] for f in function(*trial)]


def find(
    name: str,
    feature: str,
    text: str,
    rows: tuple[int, int] | None = None,
    *,
    severity: Severity | None = None,
    topic: str = "",
) -> Finding:
    """Finding of a check in the list, with the severity that stands there if none is given."""
    return Finding(name, severity or CHECKS[name].severity, feature, text, rows, topic)


def is_cause(f: Finding) -> bool:
    """Whether other findings may follow from this one: an error, or a warning that its check never makes graver."""
    listed = CHECKS.get(f.check)
    is_warning = listed is not None and f.severity == listed.severity == "warning"
    return f.severity == "error" or is_warning


def without_explained(
    found: Mapping[str, Sequence[Finding]], causes: Sequence[Finding]
) -> dict[str, list[Finding]]:
    """``found`` (recording → findings) without what ``causes`` explain: findings about the same signal in any recording, or
    about any signal if the cause has none, or if the finding depends on all signals."""
    explained = {(e, f.feature) for f in causes for e in CHECKS[f.check].explains}
    everywhere = {
        check for check, feature in explained if not feature or CHECKS[check].of_all
    }
    return {
        name: [
            f
            for f in own
            if f.check not in everywhere and (f.check, f.feature) not in explained
        ]
        for name, own in found.items()
    }


def check_names(accept: Sequence[str]) -> None:
    """Check that ``accept`` holds names of checks that can end in an error. Raises TaccorlError: there is no check of such a
    name."""
    errors = [name for name, listed in CHECKS.items() if listed.severity == "error"]
    for name in accept:
        if name not in errors:
            raise TaccorlError(
                f"--accept={name}: no check with this name reports errors; {nearest(name, errors)}"
            )


def accepted(findings: Sequence[Finding], accept: Sequence[str]) -> list[Finding]:
    """Copy of ``findings`` in which errors of the checks named in ``accept`` are warnings that state the acceptance."""
    return [
        dataclasses.replace(
            f,
            severity="warning",
            text=f"{f.text}. An error, accepted by --accept={f.check}",
        )
        if f.severity == "error" and f.check in accept
        else f
        for f in findings
    ]

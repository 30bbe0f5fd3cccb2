"""Content of the report of a comparison or a diagnosis: its sections, and all its numbers as JSON."""

import dataclasses
import datetime
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import taccorl
from taccorl.alignment.checks.clock import UNDECIDED
from taccorl.alignment.controller.joint_model import LOOK_LIKE_LEADS
from taccorl.alignment.measurements.folder import Use
from taccorl.data.finding import Finding as Checked
from taccorl.data.origin import Origin
from taccorl.diagnosis.comparison.along import curves
from taccorl.diagnosis.comparison.cell_numbers import cell_errors
from taccorl.diagnosis.comparison.localise import WHERE_NOT_WHY, Cell
from taccorl.diagnosis.comparison.regimes import RegimeErrors, regime_errors
from taccorl.diagnosis.comparison.result import Comparison, origin_words, shown
from taccorl.diagnosis.machines.machine import Finding
from taccorl.diagnosis.search.result import Diagnosis, may_go_on
from taccorl.errors import TaccorlError
from taccorl.lineage.destinations import check_writable
from taccorl.report import compared, page
from taccorl.report.account import account, moved, with_moved
from taccorl.report.diagnosed import account_section, diagnosed, next_section
from taccorl.report.evidence import Seen, added
from taccorl.report.fact import Account, Fact
from taccorl.report.section import Section
from taccorl.report.terminal import as_text
from taccorl.sim.effects.effect import Effect

PAGE, NUMBERS = "report.html", "report.json"
"""Names of the files of a report."""
GENERATOR = "taccorl report"
"""Text by which a file is recognised as a report."""


@dataclass(frozen=True, kw_only=True, repr=False)
class Report:
    """The content of a report: comparisons, diagnoses and findings of checks."""

    title: str
    comparison: Comparison
    """Comparison with the original twin."""
    after: Comparison | None = None
    """Comparison with the corrected twin, or with another one, on the same recordings; None without one."""
    refitted: Comparison | None = None
    """Comparison with the twin whose always fitted numbers were refitted without a further effect: the reference for the
    improvement by effects."""
    found: Sequence[Finding] = ()
    """Diagnosed parts."""
    options: Sequence[str] = ()
    """Options in suggested commands, such as ``--twin=twin.yaml``."""
    next: Sequence[Fact] = ()
    """What to do next, with all parts together."""
    findings: Mapping[str, Sequence[Checked]] = field(default_factory=dict)
    """Recording → findings of the checks before the comparison."""
    provenance: Mapping[str, str] = field(default_factory=dict)
    """Origin of the report, by name: the command, the twin's file, digests."""
    stopped: str = ""
    """Sentence: which parts the search did not finish, because it was stopped; empty if it was not."""

    @property
    def origins(self) -> tuple[Origin, ...]:
        """Origins of the recordings, each once."""
        return self.comparison.origins

    @property
    def without_effects(self) -> Comparison:
        """Reference for the improvement by effects: the comparison with the refitted twin, or with the original one if nothing
        was refitted."""
        return self.comparison if self.refitted is None else self.refitted

    @property
    def last(self) -> Comparison:
        """The comparison with the corrected or other twin, or the only one."""
        return self.comparison if self.after is None else self.after

    def cells(self) -> list[Cell]:
        """Errors by regime, of positions, efforts and pads, for the twin without further effects."""
        return compared.cells_of(self.without_effects)

    def regimes(self) -> dict[str, RegimeErrors]:
        """Diagnosed joint → errors by recording and regime, of the final twin."""
        return {
            f.part: regime_errors(traces)
            for f in self.found
            if (traces := self.last.of(f.part))
        }

    def accounts(self) -> dict[str, Account]:
        """Diagnosed part → facts about it."""
        regimes, found = self.regimes(), {}
        for f in self.found:
            own = regimes.get(f.part)
            traces = self.comparison.of(f.part)
            unknown = [t.floor.words() for t in traces if t.floor.is_unknown]
            seen = Seen(
                can_tell=f.can_tell,
                known=f.known,
                errors=self.unsettled(f.part),
                drifts=getattr(f, "drifts", ()),
                led=self._led(f.part, f.diagnosis),
                remarks=own.remarks[:MOST_REMARKS] if own else (),
                repeated=self._repeated(f.part),
                floor=f.noise,
                numbers=f.numbers,
                judged_by=["the last rows of each"]
                if f.rows_split
                else f.recordings.get("validation", ()),
                floor_unknown=next(iter(unknown), ""),
                short={use: own.short(use, other) for use, other in _PAIRS}
                if own
                else None,
                has_effort=bool(self.comparison.of(f.part, "effort")),
                size=self._size(f.part),
                worst=own.worst if own else None,
                plans=not self._is_input(f.part),
                options=self.options,
            )
            found[f.part] = account(f.part, f.diagnosis, seen)
        if len(found) == 1:
            found = {
                part: Account.of_facts(part, (*a.facts, *self.next))
                for part, a in found.items()
            }
        return found

    def _size(self, part: str) -> dict[str, Any] | None:
        """Validation error of the part's position, or of its effort if the position is its
        input, in units and as a share of the motion; None if it is neither."""
        kind = "effort" if self._is_input(part) else "position"
        before, after = (
            c.score(part, kind, "validation") for c in (self.comparison, self.last)
        )
        if before is None or after is None:
            return None
        return {
            "kind": kind,
            "before": shown(before.rmse, before.unit),
            "after": shown(after.rmse, after.unit),
            "nrmse": after.nrmse,
        }

    def _is_input(self, part: str) -> bool:
        """Whether the part's position is its input (law effort), so that only its effort is compared."""
        return not self.comparison.of(part) and bool(self.comparison.of(part, "effort"))

    def _led(self, part: str, d: Diagnosis) -> tuple[int, int]:
        """Number of recordings of the part whose clock may lead in place of an added
        effect, and of all; 0 of them if most do not leave it open."""
        moved = {t.recording for t in self.comparison.of(part)}
        led = 0
        for name in moved:
            own = self.comparison.clock.get(name, ())
            led += any((f.check, f.feature) == (UNDECIDED, part) for f in own)
        looks_like_it = any(name in LOOK_LIKE_LEADS for name in added(d))
        return led if looks_like_it and 2 * led > len(moved) else 0, len(moved)

    def _repeated(self, part: str) -> bool:
        """Whether noise floors of the part include the variation between repeats."""
        traces, touches = (
            self.comparison.of(part, "effort" if self._is_input(part) else "position"),
            self.comparison.touches,
        )
        if traces:
            return not any(t.floor.lower_bound for t in traces)
        return bool(touches) and all(t.repeated for t in touches)

    def unsettled(self, part: str) -> list[str]:
        """Texts, with the recording's name, of errors that the checks found in the recordings of one part (for a joint: those
        that move it). A clock offset counts only if it is also found with the fitted twin, because a missing effect can look like
        an offset; where the search may add another effect, only if it was there before the first one, too."""
        moved = {t.recording for t in self.comparison.of(part)}
        clock = self.comparison.clock
        own = [
            (name, f)
            for name, found in self.findings.items()
            for f in found
            if f not in clock.get(name, ())
        ]
        goes_on = any(f.part == part and may_go_on(f.diagnosis) for f in self.found)
        first = {
            (n, f.feature)
            for n, found in clock.items()
            for f in found
            if f.severity == "error"
        }
        last = [
            (n, f)
            for n, found in self.last.clock.items()
            for f in found
            if not goes_on or (n, f.feature) in first
        ]
        own += [(name, f) for name, f in last if not moved or f.feature == part]
        return [
            f"{name}: {f.text}"
            for name, f in own
            if f.severity == "error" and (not moved or name in moved)
        ]

    def verdict(self) -> list[Section]:
        """What the result is: origin of the data, and the verdict on every part."""
        accounts = self.accounts()
        return [
            Section(text=[origin_words(self.origins)], style="data"),
            *([Section(text=[self.stopped])] if self.stopped else []),
            *(
                map(account_section, accounts.values())
                if accounts
                else [compared.verdict(self.comparison, self.after)]
            ),
            *([next_section(self.next)] if len(accounts) > 1 else []),
        ]

    def twins(self) -> list[Comparison]:
        """The comparisons that there are: original, refitted, corrected or other."""
        every = (self.comparison, self.refitted, self.after)
        return [one for one in every if one is not None]

    def __repr__(self) -> str:
        """The verdict and the errors of every signal, as a terminal shows them."""
        return as_text(*self.verdict(), compared.how_far(*self.twins()))

    def _repr_html_(self) -> str:
        """The verdict and the errors of every signal, for notebooks."""
        return page.fragment([*self.verdict(), compared.how_far(*self.twins())])

    def save(self, folder: Path | str) -> None:
        """Write ``report.html`` and ``report.json`` into ``folder``; an earlier report
        there is replaced.

        Raises:
            TaccorlError: other files have these names, or the folder cannot be written.
        """
        write_report(self, Path(folder))

    def sections(self) -> list[Section]:
        """The page."""
        c, regimes, twins = self.comparison, self.regimes(), self.twins()
        return [
            *self.verdict(),
            *(
                [compared.signals(self.without_effects, self.after)]
                if c.signals
                else []
            ),
            *([compared.touch(self.without_effects, self.after)] if c.touches else []),
            compared.cell_numbers(self.last),
            compared.how_far(*twins),
            *compared.pad_matches(*twins),
            *(diagnosed(f, self.origins, regimes.get(f.part)) for f in self.found),
            compared.where(
                self.without_effects,
                self.origins,
                self.after if self.refitted is not None else None,
            ),
            compared.checked(self.findings),
            compared.not_compared(c),
            self._about(twins),
        ]

    def _about(self, twins: Sequence[Comparison]) -> Section:
        split = self.comparison.split
        rows = [
            (
                "beside it" if k else "twin",
                f"{one.twin}: {', '.join(one.effects) or 'no added effects'}",
            )
            for k, one in enumerate(twins)
        ]
        for use in ("fit", "validation", "test"):
            names: Sequence[object] = split.get(use) or ()  # pyright: ignore[reportAssignmentType]
            rows.append((f"recordings, {use}", ", ".join(map(str, names)) or "none"))
        rows += [("split", str(split.get("rule", ""))), *self.provenance.items()]
        return Section(title="How this report was made", rows=rows, folded=True)


MOST_REMARKS = 3
"""Remarks about the recordings in an account; the page has all."""
_PAIRS: tuple[tuple[Use, Use], ...] = (("fit", "validation"), ("validation", "fit"))


def write_report(report: Report, folder: Path, before: str | None = None) -> Section:
    """Write ``report.html`` and ``report.json`` into ``folder``, which is created if necessary; the line that says so.
    ``before``: date of the report that was there before the verb began, or empty; None: of the one that is there. Raises
    TaccorlError: as ``check_folder``, or the folder cannot be written to."""
    there = check_folder(folder)
    replaced = there if before is None else before
    numbers = json.dumps(as_json(report), indent=1, ensure_ascii=False) + "\n"
    page.write(
        {
            folder / NUMBERS: numbers,
            folder / PAGE: page.html(report.title, report.sections(), GENERATOR),
        }
    )
    again = f" (replaced the report of {replaced})" if replaced else ""
    return Section(text=[f"wrote {folder / PAGE} and {NUMBERS}{again}"])


def numbers_of(diagnosis: Path) -> Path:
    """The report.json of a diagnosis, given its folder or this file itself."""
    return diagnosis if diagnosis.name == NUMBERS else diagnosis / NUMBERS


def check_folder(folder: Path, measurements: Path | None = None) -> str:
    """Check that a report may be written into ``folder``; returns the date of the report that it will replace, empty if there
    is none. ``measurements``: folder of recordings, which must not contain the report, because all its files are read. Raises
    TaccorlError: another file has the report's name, the folder cannot be written, or it is the folder of the recordings."""
    if (
        measurements is not None
        and measurements.is_dir()
        and folder.resolve() == measurements.resolve()
    ):
        raise TaccorlError(
            f"{folder}: contains the recordings; give another folder for the report"
        )
    if folder.exists() and not folder.is_dir():
        raise TaccorlError(f"{folder}: is a file; give a folder for the report")
    check_writable(folder)
    page.check_free([folder / PAGE, folder / NUMBERS], GENERATOR, "another folder")
    if not (folder / PAGE).exists():
        return ""
    return (
        datetime.datetime.fromtimestamp((folder / PAGE).stat().st_mtime)
        .astimezone()
        .strftime("%Y-%m-%d %H:%M")
    )


def as_json(report: Report) -> dict[str, Any]:
    """All numbers of the page as JSON values: content of ``report.json``."""
    c, after, drawn = report.comparison, report.after, report.without_effects
    return {
        "generator": f"{GENERATOR}, taccorl {taccorl.__version__}",
        "title": report.title,
        "finished": not report.stopped,
        "data": [str(origin) for origin in report.origins],
        "domains": sorted({origin.domain or "not stated" for origin in report.origins}),
        "provenance": dict(report.provenance),
        "twin": {"name": c.twin, "effects": list(c.effects)},
        "mended_twin": None
        if after is None
        else {"name": after.twin, "effects": list(after.effects)},
        "recordings": c.split,
        "findings": plain(report.findings),
        "verdicts": {part: plain(a.as_json()) for part, a in report.accounts().items()},
        "next": plain([f.as_json() for f in report.next]),
        "identified": {
            f.part: plain(f.known) for f in report.found if f.known is not None
        },
        "scores": _scores(c),
        "scores_refitted": _scores(report.refitted),
        "scores_after": _scores(after),
        "touch_match": _pad_matches(c),
        "touch_match_refitted": _pad_matches(report.refitted),
        "touch_match_after": _pad_matches(after),
        "where": {
            "note": WHERE_NOT_WHY,
            "twin": drawn.twin,
            "cells": plain(report.cells()),
        },
        "along": [
            plain(curve)
            for signal, kind in drawn.signals
            for curve in curves(drawn, signal, kind)
        ],
        "regimes": plain(report.regimes()),
        "diagnoses": {f.part: _diagnosis(f.diagnosis) for f in report.found},
        "can_tell": {f.part: plain(f.can_tell) for f in report.found},
        "drifts": {f.part: [plain(d) for d in f.drifts] for f in report.found},
        "cells": _cell_numbers(report.last),
        "not_compared": list(c.left_out),
    }


def _cell_numbers(c: Comparison) -> dict[str, Any]:
    """Gain, offset and error of each cell of a sensor, row after row; empty for other machines."""
    first = c.touches[0] if c.touches else None
    if first is None or first.cells is None:
        return {}
    errors = {
        "unit": first.unit,
        "load_unit": first.load_unit,
        "rmse_floors": plain(cell_errors(c.touches)),
    }
    return plain(first.cells) | errors


def _scores(c: Comparison | None) -> list[dict[str, Any]]:
    return (
        []
        if c is None
        else [plain(s) | {"ratio": s.ratio} for s in (*c.scores(), *c.pad_scores())]
    )


def _pad_matches(c: Comparison | None) -> list[dict[str, Any]]:
    """The paper's five numbers of each pad and use."""
    matches = {} if c is None else c.pad_matches()
    return [
        {"pad": pad, "use": use} | plain(one.record())
        for (pad, use), one in matches.items()
    ]


def _diagnosis(d: Diagnosis) -> dict[str, Any]:
    """Without the fits, whose residuals are as long as the recordings."""
    d = with_moved(d)
    left = ("before", "after", "effects", "offers")
    kept = {
        f.name: getattr(d, f.name) for f in dataclasses.fields(d) if f.name not in left
    }
    offers = [plain(o) | {"effects": effects_as_json(o.effects)} for o in d.offers]
    return plain(kept) | {
        "words": d.words,
        "moved": [*moved(d)],
        "effects": effects_as_json(d.effects),
        "offers": offers,
    }


def effects_as_json(found: Sequence[Effect]) -> list[dict[str, Any]]:
    """Effects as JSON objects: name, numbers, intervals and evidence."""
    return [{"effect": e.name} | plain(e) for e in found]


def plain(value: Any) -> Any:
    """``value`` as JSON knows it: dataclasses and mappings as objects, arrays as lists, a number that is none as null."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {
            f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)
        }
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [plain(v) for v in value]
    value = value.item() if isinstance(value, np.generic) else value
    return None if isinstance(value, float) and not math.isfinite(value) else value

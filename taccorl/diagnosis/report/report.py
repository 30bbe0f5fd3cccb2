"""Content of the report of a comparison and a diagnosis, and all its numbers as JSON."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

import taccorl
from taccorl.alignment.checks.clock import UNDECIDED
from taccorl.alignment.controller.joint_model import LOOK_LIKE_LEADS
from taccorl.data.finding import Finding
from taccorl.data.origin import Origin
from taccorl.diagnosis.comparison.along import curves
from taccorl.diagnosis.comparison.cell_numbers import cell_errors
from taccorl.diagnosis.comparison.localise import WHERE_NOT_WHY, Cell, heat_map
from taccorl.diagnosis.comparison.localise_touch import touch_heat_map
from taccorl.diagnosis.comparison.regimes import RegimeErrors, regime_errors
from taccorl.diagnosis.comparison.result import Comparison
from taccorl.diagnosis.report.verdict import Verdict, added, verdict
from taccorl.diagnosis.search.identifiability import Identifiability
from taccorl.diagnosis.search.identifiable import Known
from taccorl.diagnosis.search.result import Diagnosis
from taccorl.sim.effects.effect import Effect

PAGE, NUMBERS = "report.html", "report.json"
"""Names of the files of a report."""
GENERATOR = "taccorl report"
"""Text by which a file is recognised as a report."""


@dataclass(frozen=True, kw_only=True)
class Report:
    """The content of a report: comparisons, diagnoses and findings, from which page and JSON are written."""

    title: str
    comparison: Comparison
    """Comparison with the original twin."""
    after: Comparison | None = None
    """Comparison with the corrected twin, or with another one, on the same recordings; None without one."""
    refitted: Comparison | None = None
    """Comparison with the twin whose always fitted numbers were refitted without a further effect: the reference for the
    improvement by effects."""
    diagnoses: Mapping[str, Diagnosis] = field(default_factory=dict)
    """Part ("left_joint5", "left pads") → its diagnosis."""
    can_tell: Mapping[str, Identifiability] = field(default_factory=dict)
    """Part → effects that its recordings can show and separate, independent of the measured values."""
    known: Mapping[str, Known] = field(default_factory=dict)
    """Part → numbers that its recordings identify, and the range of those that they do not."""
    options: Sequence[str] = ()
    """Options in suggested commands, such as ``--twin=twin.yaml``."""
    findings: Mapping[str, Sequence[Finding]] = field(default_factory=dict)
    """Recording → findings of the checks before the comparison."""
    pictures: Mapping[str, bytes] = field(default_factory=dict)
    """Caption → PNG, such as a camera's overlay before and after."""
    provenance: Mapping[str, str] = field(default_factory=dict)
    """Origin of the report, by name: the command, the twin's file, digests."""

    @property
    def origins(self) -> tuple[Origin, ...]:
        """Origins of the recordings, each once."""
        return self.comparison.origins

    @property
    def without_effects(self) -> Comparison:
        """Reference for the improvement by effects: the comparison with the refitted twin, or with the original one if nothing
        was refitted."""
        return self.comparison if self.refitted is None else self.refitted

    def cells(self) -> list[Cell]:
        """Errors by regime, of positions, efforts and pads, for the twin without further effects."""
        return cells_of(self.without_effects)

    def regimes(self) -> dict[str, RegimeErrors]:
        """Diagnosed joint → errors by recording and regime, of the final twin."""
        last = self.comparison if self.after is None else self.after
        return {part: regime_errors(traces) for part in self.diagnoses if (traces := last.of(part))}

    def verdicts(self) -> dict[str, Verdict]:
        """Diagnosed part → sentences of its verdict."""
        regimes = self.regimes()
        return {
            part: verdict(
                part,
                d,
                can_tell=self.can_tell.get(part),
                known=self.known.get(part),
                data=self.unsettled(part),
                doubts=[*self._clock_or_effect(part, d), *(regimes[part].remarks if part in regimes else ())],
                options=self.options,
                repeated=self._repeated(part),
                short=_short(regimes[part]) if part in regimes else None,
                worst=regimes[part].worst if part in regimes else None,
            )
            for part, d in self.diagnoses.items()
        }

    def _clock_or_effect(self, part: str, d: Diagnosis) -> list[str]:
        """Text: most recordings of the part show a lead that the added effect and an offset of the clock explain alike."""
        moved = {t.recording for t in self.comparison.of(part)}
        clock = self.comparison.clock
        led = [n for n in moved if any((f.check, f.feature) == (UNDECIDED, part) for f in clock.get(n, ()))]
        names = [name for name in added(d) if name in LOOK_LIKE_LEADS]
        if not names or 2 * len(led) <= len(moved):
            return []
        return [
            f"the measurement leads the twin's replay in {len(led)} of {len(moved)} recordings; an offset of the clock explains "
            f"that as well as {' and '.join(names)}: compare the clocks, or record steps and fast motion"
        ]

    def _repeated(self, part: str) -> bool:
        """Whether noise floors of the part include the variation between repeats."""
        traces, touches = self.comparison.of(part), self.comparison.touches
        if traces:
            return not any(t.floor.lower_bound for t in traces)
        return bool(touches) and all(t.repeated for t in touches)

    def unsettled(self, part: str) -> list[str]:
        """Texts, with the recording's name, of errors that the checks found in the recordings of one part (for a joint: those
        that move it). A clock offset counts only if it is also found with the fitted twin, because a missing effect can look like
        an offset."""
        last = self.comparison if self.after is None else self.after
        moved = {t.recording for t in self.comparison.of(part)}
        own = [
            (name, f)
            for name, found in self.findings.items()
            for f in found
            if f not in self.comparison.clock.get(name, ())
        ]
        own += [(name, f) for name, found in last.clock.items() for f in found if not moved or f.feature == part]
        return [f"{name}: {f.text}" for name, f in own if f.severity == "error" and (not moved or name in moved)]


def _short(regimes: RegimeErrors) -> dict[str, tuple[str, ...]]:
    return {"fit": regimes.short("fit", "validation"), "validation": regimes.short("validation", "fit")}


def cells_of(c: Comparison) -> list[Cell]:
    """Errors by regime, of positions, efforts and pads."""
    return [*heat_map(c, "position"), *heat_map(c, "effort"), *touch_heat_map(c.touches)]


def as_json(report: Report) -> dict[str, Any]:
    """All numbers of the page as JSON values: content of ``report.json``."""
    c, after, refitted = report.comparison, report.after, report.refitted
    drawn = report.without_effects
    return {
        "generator": f"{GENERATOR}, taccorl {taccorl.__version__}",
        "title": report.title,
        "data": [str(origin) for origin in report.origins],
        "domains": sorted({origin.domain or "not stated" for origin in report.origins}),
        "provenance": dict(report.provenance),
        "twin": {"name": c.twin, "effects": list(c.effects)},
        "mended_twin": None if after is None else {"name": after.twin, "effects": list(after.effects)},
        "recordings": c.split,
        "findings": {name: [_plain(f) for f in found] for name, found in report.findings.items()},
        "verdicts": {part: _plain(v) for part, v in report.verdicts().items()},
        "identified": {part: _plain(known) for part, known in report.known.items()},
        "scores": [_scored(s) for s in (*c.scores(), *c.pad_scores())],
        "scores_refitted": []
        if refitted is None
        else [_scored(s) for s in (*refitted.scores(), *refitted.pad_scores())],
        "scores_after": [] if after is None else [_scored(s) for s in (*after.scores(), *after.pad_scores())],
        "where": {"note": WHERE_NOT_WHY, "twin": drawn.twin, "cells": [_plain(cell) for cell in report.cells()]},
        "along": [_plain(curve) for signal, kind in drawn.signals for curve in curves(drawn, signal, kind)],
        "regimes": {part: _plain(found) for part, found in report.regimes().items()},
        "diagnoses": {part: _diagnosis(d) for part, d in report.diagnoses.items()},
        "can_tell": {part: _plain(found) for part, found in report.can_tell.items()},
        "cells": _cell_numbers(c if after is None else after),
        "not_compared": list(c.left_out),
    }


def _cell_numbers(c: Comparison) -> dict[str, Any]:
    """Gain, offset and error of each cell of a sensor, row after row; empty for other machines."""
    first = c.touches[0] if c.touches else None
    if first is None or first.cells is None:
        return {}
    errors = {"unit": first.unit, "load_unit": first.load_unit, "rmse_floors": _plain(cell_errors(c.touches))}
    return _plain(first.cells) | errors


def _scored(score: Any) -> dict[str, Any]:
    return _plain(score) | {"ratio": score.ratio}


def _diagnosis(d: Diagnosis) -> dict[str, Any]:
    """Without the fits, whose residuals are as long as the recordings."""
    kept = {
        f.name: getattr(d, f.name) for f in dataclasses.fields(d) if f.name not in ("before", "after", *_OF_EFFECTS)
    }
    offers = [_plain(o) | {"effects": _effects(o.effects)} for o in d.offers]
    return _plain(kept) | {"words": d.words, "effects": _effects(d.effects), "offers": offers}


_OF_EFFECTS = ("effects", "offers")
"""Fields of a diagnosis whose effects are written with their names."""


def _effects(found: Sequence[Effect]) -> list[dict[str, Any]]:
    return [{"effect": e.name} | _plain(e) for e in found]


def _plain(value: Any) -> Any:
    """What JSON knows; a number that is none is null."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [_plain(v) for v in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value

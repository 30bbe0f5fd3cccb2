"""Facts of the diagnosis of one part: how much of the error is gone and with which numbers,
what is missing, what remains and where, what it may be as well, and what to record next.

A pure function of the results. ``texts.yaml`` has the lines; docs/diagnosis.md has the rule
of the confidence.
"""

import dataclasses
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from taccorl.alignment.least_squares import Free, inverse_of
from taccorl.diagnosis.problems.joint_problem import OF_RECORDINGS, TORQUE_FF
from taccorl.diagnosis.remark import Remark
from taccorl.diagnosis.search import plain as plain_fit
from taccorl.diagnosis.search.drift import Drift
from taccorl.diagnosis.search.problem import EFFORT_SCALE
from taccorl.diagnosis.search.result import (
    Changed,
    Diagnosis,
    SearchConfig,
    gains_nothing,
)
from taccorl.report.evidence import (
    Seen,
    added,
    effect_class,
    simpler_twin,
    undetermined,
)
from taccorl.report.fact import Account, Fact, Quantity, fact, when
from taccorl.report.next_recording import Advice, next_recording
from taccorl.sim.effects.effect import Effect

MOST_OF_IT, NEARLY_ALL = 0.5, 0.9
"""Shares of the squared error: from the first one on a result explains the recordings,
below the second one what is left may change it. Choices."""
LATE: Mapping[str, str] = {
    "command_delay": "positions and efforts",
    "sensor_delay": "positions",
}
"""Delay → columns of a recording that, logged late by as much, look the same."""
REPEATS_DIFFER = 0.5
"""Validation error [noise floors] below which the floor hides effects. A choice."""
GONE = 0.2
"""Share of an effect of the file below which an added one replaces it. A choice."""
DIFFER = 1.3
"""Ratio of the errors on fit and validation recordings from which on they disagree: more
than the noise of another motion causes."""
LOOP = "loop_s"
"""Period of a drive's loop, of which the file has the rate, ``loop_hz``."""
GAINS = ("kp", "kd")
NEAR = 0.05
"""Least share of the squared error that the nearest effect would take away."""


def account(part: str, d: Diagnosis, seen: Seen | None = None) -> Account:
    """The facts of one part's diagnosis, and of its recordings ``seen``."""
    of = _Part(part, d, seen or Seen())
    steps = (_title, _error, _remarks, _next)
    if of.kind == "drifting":
        steps += (_drifts, _remains)
    elif of.kind not in ("data_first", "not_converged"):
        steps += (_missing, _changed, _remains, _ties, _doubts, _drifts)
    return Account.of_facts(part, [found for step in steps for found in step(of)])


def moved(d: Diagnosis) -> dict[str, Quantity]:
    """Always fitted numbers of the machine's file whose intervals exclude its values, and
    whose return to them would raise the error by a share that counts as a loss."""
    if not _refit_helps(d):
        return {}
    ends = {name: d.intervals.get(name, (-math.inf, math.inf)) for name in d.start}
    listed = {*OF_RECORDINGS, LOOP, *(c.name for c in d.changed)}
    apart = [
        f
        for f in d.after.frees
        if f.name in {*d.base} & {*d.start} - listed
        and not ends[f.name][0] <= d.start[f.name] <= ends[f.name][1]
    ]
    return {
        f.name: Quantity.of(d.base[f.name], f.unit, ends[f.name])
        for f in _needed(d, apart)
    }


def with_moved(d: Diagnosis) -> Diagnosis:
    """``d``, whose status says that numbers of the file are off where they have to move."""
    is_off = d.status == "nothing_missing" and moved(d)
    return dataclasses.replace(d, status="numbers_off") if is_off else d


def _needed(d: Diagnosis, apart: list[Free]) -> list[Free]:
    """Those of ``apart`` that do not go back to the file's values for nothing, the cheapest
    first: all others refitted, numbers that are δ off raise the squared error by
    δᵀ Σ⁻¹ δ / n, Σ the part of (JᵀJ)⁻¹ that is theirs."""
    fit, after = d.after, d.errors["after"]["validation"]
    own = [fit.frees.index(f) for f in apart]
    variances = inverse_of(fit.jacobian.T @ fit.jacobian)[np.ix_(own, own)]
    delta = np.array(
        [f.coordinate(d.base[f.name]) - f.coordinate(d.start[f.name]) for f in apart]
    )
    returned = list[int]()
    for k in np.argsort(np.abs(delta) / np.sqrt(np.diag(variances))):
        these = [*returned, int(k)]
        inner = variances[np.ix_(these, these)]
        cost = float(delta[these] @ np.linalg.solve(inner, delta[these]))
        if gains_nothing(math.sqrt(after**2 + cost / len(fit.residuals)), after):
            returned = these
    return [f for k, f in enumerate(apart) if k not in returned]


def _refit_helps(d: Diagnosis) -> bool:
    """Whether refitted numbers alone take away a share of the error that counts."""
    before, fitted = (d.errors[stage]["validation"] for stage in ("before", "fitted"))
    return not gains_nothing(before, fitted)


def share_gone(d: Diagnosis) -> float:
    """Share of the squared validation error that is gone, of the twin as it was."""
    before, after = (d.errors[stage]["validation"] for stage in ("before", "after"))
    return 1.0 - after**2 / before**2


def is_explained(d: Diagnosis) -> bool:
    """Whether nothing is missing, or at least half of the squared error is gone."""
    if d.status == "not_converged":
        return False
    settled = d.status in ("nothing_missing", "numbers_off", "gains_moved", "at_floor")
    return settled or share_gone(d) >= MOST_OF_IT


@dataclass(frozen=True)
class _Part:
    """One part with what all its facts depend on."""

    part: str
    d: Diagnosis
    seen: Seen

    @property
    def is_short(self) -> bool:
        """Whether the search ended above the floor."""
        return self.d.status in ("something_else", "too_many")

    @property
    def numbers(self) -> list[str]:
        """Names of the numbers of the file that are off."""
        return [*moved(self.d), *(c.name for c in self.d.changed)]

    @property
    def kind(self) -> str:
        """Identifier of the title."""
        d, new = self.d, added(self.d)
        tied = any(d.rivals.get(name) for name in new)
        unclear = self.is_short and not is_explained(d)
        kinds = {
            "data_first": self.seen.errors,
            "not_converged": d.status == "not_converged",
            "drifting": self.is_short and self.seen.drifts and self.only_drifts,
            "something_else": unclear or (self.is_short and not self.named),
            "more": new and self.is_short,
            "ties": tied,
            "effects": new,
            "gains_moved": d.status == "gains_moved",
            "some_numbers_off": self.is_short,
            "numbers_off": self.numbers,
        }
        return next((kind for kind, is_so in kinds.items() if is_so), "nothing_missing")

    @property
    def only_drifts(self) -> bool:
        """Whether each added effect is one of a number that changed with time."""
        numbers = {n for d in self.seen.drifts for n in (d.number, *d.as_good)}
        return {*added(self.d)} <= {number.partition(".")[0] for number in numbers}

    @property
    def named(self) -> list[str]:
        """What explains the error: added effects with a number that the recordings
        determine, or numbers of the file."""
        new = added(self.d)
        known = [name for name in new if name not in undetermined(self.d)]
        return known if new else self.numbers


def _title(of: _Part) -> list[Fact]:
    missing = [_placed(of.d, name) for name in added(of.d)]
    drifting = list(dict.fromkeys(drift.number for drift in of.seen.drifts))
    values = {"missing": missing, "numbers": of.numbers, "drifting": drifting}
    return [fact(of.kind, part=of.part, changes=_changes(of.d), **values)]


def _changes(d: Diagnosis) -> list[str]:
    """Each number of the file that is off, with its value there and the fitted one."""
    fitted = {name: (d.start[name], q.shown) for name, q in moved(d).items()}
    stated = {c.name: (c.before, Quantity.of(c.after, c.unit).shown) for c in d.changed}
    return [
        f"{name} {before:.4g} → {after}"
        if math.isfinite(before)
        else f"{name} (not stated) → {after}"
        for name, (before, after) in (fitted | stated).items()
    ]


def _placed(d: Diagnosis, name: str) -> str:
    """``NAME in BODY`` of an effect that acts on one body of the robot, such as a payload in a link; else its name alone."""
    link = next((getattr(e, "link", "") for e in d.effects if e.name == name), "")
    return f"{name} in {link}" if link else name


def _error(of: _Part) -> list[Fact]:
    d = of.d
    before, fitted, after = (d.errors[s] for s in ("before", "fitted", "after"))
    id = "error" if "test" in after else "error_untested"
    return [
        *(fact("data_error", text=text) for text in of.seen.errors),
        *when(d.status == "not_converged", "trouble", text=d.trouble),
        fact(
            "error_rose" if share_gone(d) < 0.0 and not is_explained(d) else id,
            before=before["validation"],
            after=after["validation"],
            share=share_gone(d),
            test_before=before.get("test"),
            test_after=after.get("test"),
        ),
        *when(added(d) and _refit_helps(d), "refit", error=fitted["validation"]),
        *_plain(d),
    ]


def _plain(d: Diagnosis) -> list[Fact]:
    """What one fit of the usual numbers of a drive leaves, where the search tried it."""
    plain = getattr(d, "plain", None)
    if plain is None or not added(d):
        return []
    error, after = plain.errors["validation"], d.errors["after"]["validation"]
    is_better = error < after and not gains_nothing(after, error)
    if {*added(d)} <= {
        *plain_fit.EFFECTS
    } and not is_better:  # its own numbers: no news
        return []
    id = "plain_as_good" if gains_nothing(error, after) else "plain"
    return [fact(id, error=error)]


def _missing(of: _Part) -> Iterator[Fact]:
    d, known = of.d, of.seen.known
    every = [] if known is None or known.pinned_by else known.identifiable
    for e in (e for e in d.effects if e.name in added(d)):
        numbers = [f"{name} {number}" for name, number in _numbers(e).items()]
        id = "tried" if of.kind == "something_else" else "missing"
        yield fact(id, effect=_placed(d, e.name), numbers=numbers)
        yield from when(e.reads_as, "reads_as", text=e.reads_as)
        for n in [n for n in every if n.name.startswith(f"{e.name}.")][:1]:
            own = Quantity.of(n.value, n.unit, (n.low, n.high))
            yield fact("over_kp", name=n.name, quantity=own)
    for c in d.changed if added(d) else ():
        yield from when(_is_replaced(c), "replaces", effect=c.effect)


def _numbers(e: Effect) -> dict[str, Quantity]:
    """The fitted numbers of an effect; all of them if none has an interval."""
    every = {
        p.name: Quantity.of(getattr(e, p.name), p.unit, e.interval.get(p.name))
        for p in e.parameters()
    }
    return {name: q for name, q in every.items() if name in e.interval} or every


def _is_replaced(c: Changed) -> bool:
    """Whether the refit leaves hardly anything of an effect of the file."""
    cls = effect_class(c.effect) if c.effect else None
    absent = {p.name: p.absent for p in cls.parameters()} if cls is not None else {}
    none = absent.get(c.name.rpartition(".")[2])
    return none is not None and abs(c.after - none) < GONE * abs(c.before - none)


def _changed(of: _Part) -> Iterator[Fact]:
    d = of.d
    for name, after in moved(d).items():
        yield fact("changed", name=name, before=d.start[name], after=after)
    if gains := _kept_gains(d):
        yield fact("gains", gains=gains)
    for c in d.changed:
        ends = d.intervals.get(c.name)
        if c.name == "loop_hz":
            periods = reversed(d.intervals["loop_s"])
            ends = [1.0 / end if end > 0.0 else math.inf for end in periods]
        id = "changed_open" if c.name in d.undetermined else "changed"
        yield fact(
            id if math.isfinite(c.before) else "not_stated",
            name=c.name,
            before=c.before,
            after=Quantity.of(c.after, c.unit, ends),
            without=c.without,
        )
        is_late = c.name == "speed_delay_s"
        yield from when(is_late, "in_effect", effect="speed_delay", name=c.name)
        yield from when(is_late and c.after < 0.0, "early_speed")
        yield from when(c.name == EFFORT_SCALE, "scale_efforts", factor=1.0 / c.after)
        yield from when(c.name == TORQUE_FF.name, "tie_weight")


def _kept_gains(d: Diagnosis) -> list[str]:
    """Fitted gains of which no line says that they change: value, interval, and the value
    of the file."""
    units = {f.name: f.unit for f in d.after.frees if not f.held}
    listed = {*moved(d), *(c.name for c in d.changed)}
    return [
        f"{name} {Quantity.of(d.base[name], units[name], d.intervals.get(name))}, "
        f"in the file {d.start[name]:.4g}"
        for name in GAINS
        if name in {*units} & {*d.base} & {*d.start} - listed
    ]


def _remains(of: _Part) -> Iterator[Fact]:
    d, worst = of.d, of.seen.worst
    after, fit = (d.errors["after"][use] for use in ("validation", "fit"))
    if of.is_short or max(after, fit) > SearchConfig().floor:
        is_much = of.is_short and share_gone(d) < NEARLY_ALL
        yield fact("remains_much" if is_much else "remains", error=after)
        yield from when(of.seen.size, "size", **(of.seen.size or {}))
        if worst is not None and not d.standing_out:
            yield fact("worst", error=worst.error, place=worst.place)
    for out in d.standing_out[:1]:
        place = out.words()
        yield fact("stands_out", error=out.error, place=place, most=out.most)
        for name, error in d.nearest[:1]:
            is_near = error < (1.0 - NEAR) ** 0.5 * out.error
            yield from when(is_near, "nearest", effect=name, error=error)
    if of.is_short and not (d.standing_out or added(d)):
        for e in (e for r in d.rounds[-1:] for e in r.evidence[:1]):
            gain = {"gain": e.gain, "reason": e.verdict}
            yield from when(e.gain >= NEAR, "best_tried", effect=e.name, **gain)


def _ties(of: _Part) -> list[Fact]:
    d, new, (number, factor) = of.d, added(of.d), of.d.or_number
    instead = [(name, c.name) for c in d.changed for name in c.instead]
    efforts = EFFORT_SCALE in (number, *(name for name, _ in instead))
    led, n = of.seen.led
    simpler = simpler_twin(d)
    return [
        *(_tie(d, o, e) for e in new for o in d.rivals.get(e, ())),
        *(fact("tie_clock", columns=LATE[e], effect=e) for e in new if e in LATE),
        *(fact("tie_place", body=body) for body in d.or_in),
        *(
            fact("tie_effect", other=other, name=name)
            for other, name in instead
            if other != EFFORT_SCALE
        ),
        *(
            fact("tie_change", change=change, name=c.name)
            for c in d.changed
            for change in c.ties
        ),
        *when(efforts, "tie_efforts"),
        *when(number and not efforts, "tie_number", name=number, factor=factor),
        *when(led, "tie_lead", led=led, n=n, effects=new),
        *when(simpler, "may_be_two", **simpler),
        *when(of.is_short and new, "stands_in", effects=new),
    ]


def _tie(d: Diagnosis, other: str, effect: str) -> Fact:
    """That ``other`` in place of ``effect`` leaves as much, or how much more it leaves."""
    names = tuple(other if n == effect else n for n in added(d))
    after = d.errors["after"]["validation"]
    left = [o.errors["validation"] for o in d.offers if o.added == names]
    for error in left:
        more = max(error, 1.0) ** 2 / max(after, 1.0) ** 2 - 1.0
        if more > SearchConfig().min_gain:
            return fact("tie_more", other=other, effect=effect, more=more, error=error)
    return fact("tie", other=other, effect=effect)


def _doubts(of: _Part) -> list[Fact]:
    d, seen, config = of.d, of.seen, SearchConfig()
    fit, validation = (d.errors["after"][use] for use in ("fit", "validation"))
    test, first = d.errors["after"].get("test"), d.errors[d.baseline]["validation"]
    is_little = first <= config.little
    high, low = max(fit, validation), min(fit, validation)
    differ = high > DIFFER * max(low, 1.0)
    use = "validation" if fit > validation else "fit"
    further = (seen.short or {}).get(use, ())
    nothing = of.kind == "nothing_missing"
    return [
        *when(
            seen.floor_unknown,
            "floor_unknown_nothing" if nothing else "floor_unknown",
            text=seen.floor_unknown,
        ),
        *when(validation < REPEATS_DIFFER, "floor_wide", error=validation),
        *when(
            test and test > config.floor and validation <= config.little,
            "test_keeps",
            error=test,
            validation=validation,
        ),
        *(
            fact(
                "untested_little" if is_little else "untested",
                effect=name,
                without=d.test_without[name],
                with_it=test,
            )
            for name in d.untested
        ),
        *when(added(d) and not of.is_short and is_little, "little_gain", error=first),
        *when(differ, "fit_differs", fit=fit, validation=validation),
        *when(differ and seen.short is None, "mark_kinds", use=use),
        *when(differ and further, "mark_range", use=use, variables=further),
        *(fact("one_pose", effect=name) for name in d.one_pose),
        *when(d.at_bound, "at_bound", names=d.at_bound),
        *(fact("undetermined", effect=name) for name in undetermined(d)),
    ]


def _drifts(of: _Part) -> Iterator[Fact]:
    """Each number that changed with time, in the two recordings of one motion that
    determine it best."""
    best_first = sorted(of.seen.drifts, key=_open_width)
    for number in dict.fromkeys(drift.number for drift in best_first):
        first, *others = (drift for drift in best_first if drift.number == number)
        yield fact(
            "drift",
            name=number,
            before=Quantity.of(first.before, first.unit, first.before_interval),
            after=Quantity.of(first.after, first.unit, first.after_interval),
            first=first.first,
            second=first.second,
            share=first.share,
        )
        pairs = [f"{drift.first} and {drift.second}" for drift in others]
        yield from when(pairs, "drift_likewise", pairs=pairs)


def _open_width(drift: Drift) -> float:
    """Sum of the widths of the intervals of the two values; infinite where one is open."""
    ends = np.array([drift.before_interval, drift.after_interval])
    width = float(np.diff(ends, axis=1).sum())
    return width if math.isfinite(width) else math.inf


def _remarks(of: _Part) -> list[Fact]:
    of_fit = () if of.kind == "drifting" else of.d.remarks
    seen, every = of.seen, (*of_fit, *of.seen.remarks)
    return [
        *(
            Fact(r.id, r.values) if isinstance(r, Remark) else fact("remark", text=r)
            for r in every
        ),
        *when(seen.numbers, "fitted", text=seen.numbers),
        *when(seen.judged_by, "judged", recordings=seen.judged_by),
        *when(seen.floor, "floor", text=seen.floor),
    ]


def _next(of: _Part) -> Iterator[Fact]:
    seen = of.seen
    yield from when(seen.floor_unknown, "record_third")
    for found in next_recording(Advice(of.part, of.d, of.kind, of.numbers, seen)):
        if found.id != "plan":
            yield found
        elif seen.plans:
            command = " ".join([found.values["command"], *seen.options])
            yield fact("plan", command=command)

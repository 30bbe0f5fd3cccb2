"""Verdict of a diagnosis: the missing effect, the confidence, and what to record next, in one sentence each. A pure function of
the findings; the terminal and the page show the same sentences.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

from taccorl.data.finding import listed
from taccorl.diagnosis.comparison.regimes import RegimeError
from taccorl.diagnosis.search.identifiability import Identifiability
from taccorl.diagnosis.search.identifiable import Known
from taccorl.diagnosis.search.problem import EFFORT_SCALE
from taccorl.diagnosis.search.result import Changed, Diagnosis, SearchConfig, of_test
from taccorl.report.evidence_words import (
    effect_class,
    excite_command,
    inseparable_words,
    may_be_two,
    plannable,
    recording_word,
    separable,
    unit_words,
    unjudged,
    untested_words,
)

Kind = Literal[
    "nothing_missing",
    "numbers_off",
    "effects",
    "ties",
    "more",
    "something_else",
    "gains_moved",
    "not_converged",
    "data_first",
]
"""What a verdict says: nothing is missing, numbers of the file are off, effects are missing or tie, more is than was found, …"""
ALIKE: tuple[Kind, ...] = (
    "not_converged",
    "gains_moved",
    "nothing_missing",
    "numbers_off",
)
"""Kinds of verdict that are named after a status of the search, and follow from this status alone."""
FOUND: Mapping[Kind, str] = {
    "data_first": "{w.part}: settle the data before any effect is named: {w.first_fault}.",
    "not_converged": "{w.part}: the fit has not converged, so nothing follows from its error of {w.after:.2f} noise floors.",
    "gains_moved": "{w.part}: no effect is needed, but only with gains far from the twin's: {w.moved}.",
    "nothing_missing": "{w.part}: nothing is missing; the error is {w.after:.2f} noise floors ({refitted}).",
    "numbers_off": "{w.part}: {w.off}.",
    "something_else": "{w.part}: no known effect {w.remains}.",
    "more": "{w.part} lacks {w.names}{w.place}, and something more: {w.fell}, and the floor is not reached.",
    "ties": "{w.part} lacks {w.names}{w.place}: {w.fell}, and these recordings do not tell which it is.",
    "effects": "{w.part} lacks {w.names}{w.sizes}{w.place}: {w.fell}.",
}
"""Kind → sentence of the finding."""
UNCERTAIN: Mapping[Kind, str] = {
    "data_first": "the recordings contradict themselves or the clock",
    "not_converged": "{w.trouble}",
    "gains_moved": "wrong time stamps or gains explain the data as well as the fitted gains do",
    "something_else": "every known effect was tried, and none with determined numbers explains most of it",
    "more": "what is still missing may change what was named",
}
"""Kind of low confidence → its first reason."""
SCALED = "all efforts are off by one factor (effort_scale: a wrong torque constant)"
LATE: Mapping[str, str] = {
    "command_delay": "positions and efforts",
    "sensor_delay": "positions",
}
"""Name of an effect that is a delay → columns of a recording. If the logger had stored these columns late by that delay, the
recording would look the same as one of a robot with the effect."""
NEXT: Mapping[str, str] = {
    "data_first": "The same motions again, once the data is settled.",
    "gains_moved": "First state the commanded gains (kp, kd) and check the time stamps.",
    "too_many": "First let the search add effects until the noise floor is reached (--until=noise_floor).",
}
"""Kind or status → what to record next, where nothing else decides."""
Level = Literal["high", "moderate", "low"]
"""Confidence."""
FLOOR, LITTLE = SearchConfig().floor, SearchConfig().little
"""Largest errors [noise floors] that count as at the floor, and as little above it."""
BELOW = 0.5
"""Validation error [noise floors] below which repeats differ by so much more than the twin is off that their floor hides effects.
A choice."""
GONE = 0.2
"""Share of an effect's strength in the file below which an added effect is in place of it. A choice."""
NEAR = 0.05
"""Least share of the validation squared error above the floor that an effect removes which a verdict calls near."""
_MOST = 3  # names or reasons in one sentence
_some = partial(listed, most=_MOST)


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """Verdict on one part in three sentences: finding, confidence, and what to record next."""

    part: str
    kind: Kind
    level: Level
    """Confidence in the finding."""
    finding: str
    """Sentence: which effect is missing."""
    confidence: str
    """Sentence: confidence, and its reasons."""
    record_next: str
    """Sentence: what to record next."""
    command: str
    """Command that plans the next recording; empty if none does."""
    remarks: tuple[str, ...]
    """Remarks about the result, a sentence each."""


def verdict(
    part: str,
    d: Diagnosis,
    *,
    can_tell: Identifiability | None = None,
    known: Known | None = None,
    data: Sequence[str] = (),
    doubts: Sequence[str] = (),
    options: Sequence[str] = (),
    repeated: bool = False,
    floor: str = "",
    short: Mapping[str, Sequence[str]] | None = None,
    worst: RegimeError | None = None,
) -> Verdict:
    """Verdict on one part. ``can_tell``: effects that its recordings can show and separate. ``known``: its numbers, if they were
    divided into identified and other ones. ``data``: faults of the recordings that come before any effect. ``doubts``: other
    reasons for less confidence. ``options``: of suggested commands, such as ``--twin=twin.yaml``. ``repeated``: the noise floor
    includes what differs between repeats. ``floor``: text on one that is not known (``SignalFloor.is_unknown``). ``short``: fit,
    validation → variables whose range in the recordings of the other use its own do not cover, if it is known. ``worst``:
    recording and regime with the largest error after the fit, if they are known."""
    kind, w = _kind(d, data), _Words(part, d, known, data)
    remarks = (*d.remarks, *doubts[:_MOST])
    finding = FOUND[kind].format(w=w, refitted=refitted_words(d))
    if d.changed and kind not in ("data_first", "not_converged"):
        finding = (
            f"{finding} Numbers of the file that change: {'; '.join(changed_words(d))}."
        )
    reasons = [*_doubts(d, kind, short, floor)]
    if remarks:
        reasons.append(
            f"see the {len(remarks)} remark{'' if len(remarks) == 1 else 's'} below"
        )
    # What the recordings that no choice has seen do not confirm may be no more than noise that is not quite known.
    unsure = (d.untested and d.errors[d.baseline]["validation"] <= LITTLE) or (
        floor and kind == "nothing_missing"
    )
    unsure = unsure or (
        added(d)
        and {*_open(d), *(c.name for c in d.changed if c.name in d.undetermined)}
    )
    tied = kind == "ties" or (kind == "numbers_off" and w.instead)
    level: Level = (
        "low"
        if unsure or kind in UNCERTAIN
        else "moderate"
        if reasons or tied
        else "high"
    )
    first = (
        [UNCERTAIN[kind].format(w=w)]
        if kind in UNCERTAIN
        else []
        if reasons
        else [w.ends]
    )
    why = [reason.rstrip(".") for reason in (*first, *reasons)]
    more = f"; and {len(why) - _MOST} more" if len(why) > _MOST else ""
    words, command = _record_next(w, kind, can_tell, repeated, worst)
    return Verdict(
        part=part,
        kind=kind,
        level=level,
        finding=finding,
        confidence=f"Confidence {level}: {'; '.join(why[:_MOST])}{more}.",
        record_next=bool(floor)
        * "The motion of the two recordings that differ a third time, for the noise floor. "
        + words,
        command=" ".join([command, *options]) if command else "",
        remarks=remarks,
    )


def refitted_words(d: Diagnosis) -> str:
    """Text that names the fit of all always fitted numbers without an added effect; for a joint these are the gains."""
    return (
        "gains refitted"
        if "kp" in d.base
        else "with the numbers refitted that every fit adjusts"
    )


def changed_words(d: Diagnosis) -> list[str]:
    """Texts on the numbers of the file whose refit removes a part of the error, one for each effect or other number, such as
    ``coulomb_friction.torque_nm 0.052 → 0.252 N·m (0.246 … 0.258), else 12.30 noise floors remain``."""
    groups: dict[str, list[Changed]] = {}
    for c in d.changed:
        groups.setdefault(c.effect or c.name, []).append(c)
    alone = " without an added effect"
    return [
        f"{', '.join(_change(c, d) for c in own)}, else {own[0].without:.2f} noise floors remain{alone * own[0].alone}"
        for own in groups.values()
    ]


def _change(c: Changed, d: Diagnosis) -> str:
    low, high = d.intervals.get(c.name, (c.after, c.after))
    if c.name == "loop_hz":
        low, high = (
            1.0 / end if end > 0.0 else math.inf
            for end in reversed(d.intervals["loop_s"])
        )
    edit = (
        f": write `{c.name}: {c.after:.4g}` there, or what the drive has"
        * math.isinf(c.before)
    )
    edit += f" or, as well, {' or '.join(c.ties)}" * bool(c.ties)
    edit += (
        f": a constant {'force' if c.unit == 'N' else 'torque'}, which may be a weight"
        * (c.name == "torque_ff")
    )
    edit += ": the effect speed_delay, which add-effect writes" * (
        c.name == "speed_delay_s"
    )
    edit += f": multiply efforts by {1 / c.after:.4g}, unless a mass is missing" * (
        c.name == EFFORT_SCALE
    )
    edit += f", or {SCALED}" * (EFFORT_SCALE in c.instead and bool(added(d)))
    ends = f"{clean(low, high - low)} … {clean(high, high - low)}"
    ends = (
        f"not determined: with other numbers any of {ends} fits"
        if c.name in d.undetermined
        else ends
    )
    return f"{c.name} {c.was} → {clean(c.after, high - low)}{unit_words(c.unit)} ({ends}){edit}"


def clean(value: float, width: float) -> str:
    """A number with four digits, or those of which the half ``width`` of its interval has two; 0 if it is nothing beside it."""
    known = 0.0 < width < math.inf and 0.0 < abs(value) < math.inf
    digits = 2 + math.ceil(math.log10(2.0 * abs(value) / width)) if known else 4
    is_nothing = width < math.inf and abs(value) < 1e-6 * width
    return f"{0.0 if is_nothing else value + 0.0:.{max(4, digits)}g}"


def added(d: Diagnosis) -> tuple[str, ...]:
    """Names of the effects that were added, which the twin lacked."""
    return tuple(name for name in d.names if name not in d.present)


def _open(d: Diagnosis) -> list[str]:
    """Names of the added effects none of whose parameters the recordings determine."""
    known = {
        name.partition(".")[0] for name in d.intervals if name not in d.undetermined
    }
    unknown = {name.partition(".")[0] for name in d.undetermined} - known
    return [name for name in added(d) if name in unknown]


def _kind(d: Diagnosis, data: Sequence[str]) -> Kind:
    if data:
        return "data_first"
    if d.status in ("something_else", "too_many"):
        first, after = (
            max(d.errors[stage]["validation"], 1.0) ** 2
            for stage in (d.baseline, "after")
        )
        most = d.standing_out or first - after >= SearchConfig().sure_gain * (
            first - 1.0
        )
        return "more" if {*added(d)} - {*_open(d)} and most else "something_else"
    if d.status in ALIKE:
        return d.status
    return "ties" if any(d.rivals.get(name) for name in added(d)) else "effects"


@dataclass(frozen=True)
class _Words:
    """Values of the fields in the sentences."""

    part: str
    d: Diagnosis
    known: Known | None
    data: Sequence[str]

    @property
    def after(self) -> float:
        return self.d.errors["after"]["validation"]

    @property
    def first_fault(self) -> str:
        return self.data[0] + (
            f" (and {len(self.data) - 1} more)" if len(self.data) > 1 else ""
        )

    @property
    def remains(self) -> str:
        if added(self.d) or not self.d.standing_out:
            left = f"; {self.after:.2f} noise floors remain"
            alone = "alone " * (self.d.status == "too_many")  # tried one at a time
            return f"{alone}explains what is missing{f': with {self.names}, the nearest, {self.fell}' if added(self.d) else left}"
        place = self.d.standing_out[0]
        least = (1.0 - NEAR) ** 0.5 * place.error
        near = {
            name: f"{name} ({error:.2f})"
            for name, error in self.d.nearest
            if error < least
        }
        why = [
            e.verdict
            for r in self.d.rounds[-1:]
            for e in r.evidence
            if e.verdict and e.name in [*near][:1]
        ]
        tried = f"nearest there: {_some([*near.values()])}{f', refused: {why[0]}' if why else ''}"
        none = (
            "none comes near to it there"
            if self.d.nearest
            else "none was tried there, in a test recording"
        )
        left = f"{place.error:.2f} noise floors ({self.after:.2f} in all)"
        return f"explains what stands out: {place.words()}, {left}; {tried if near else none}"

    @property
    def trouble(self) -> str:
        return self.d.trouble or "the numbers were still moving"

    @property
    def moved(self) -> str:
        d = self.d
        pairs = [
            (g, d.start.get(g, 0.0), d.base[g]) for g in ("kp", "kd") if g in d.base
        ]
        return ", ".join(
            f"{g} {old:.4g} → {new:.4g} (× {new / old:.2g})"
            for g, old, new in pairs
            if old
        )

    @property
    def off(self) -> str:
        how = {
            c.effect or c.name: "off" if math.isfinite(c.before) else "not stated"
            for c in self.d.changed
        }
        off = " and ".join(
            SCALED if n == EFFORT_SCALE else f"{n} of the file is {word}"
            for n, word in how.items()
        )
        if not self.instead:
            return f"no effect is missing, but {off}: {self.fell}"
        missing = [name for name in self.instead if name != EFFORT_SCALE]
        ways = [f"{' or '.join(missing)} is missing instead"] * bool(missing)
        ways += [SCALED] * (EFFORT_SCALE in self.instead)
        return f"{off}, or {', or '.join(ways)}: {self.fell}, and these recordings do not tell which it is"

    @property
    def instead(self) -> tuple[str, ...]:
        """Effects that explain as much as the numbers of the file that change."""
        return tuple(dict.fromkeys(name for c in self.d.changed for name in c.instead))

    @property
    def names(self) -> str:
        """Added effects, each with all others that may be missing in its place."""
        links = {
            e.name: f"{e.name} in {link}"
            for e in self.d.effects
            if (link := getattr(e, "link", ""))
        }
        if self.d.or_in:
            last = "" if "payload" in links else " in the last link that it moves"
            links["payload"] = " or in ".join(
                (links.get("payload", f"payload{last}"), *self.d.or_in)
            )
        each = [
            " or ".join((links.get(name, name), *self.d.rivals.get(name, ())))
            for name in added(self.d)
        ]
        return ("; " if any(self.d.rivals.values()) else " and ").join(each)

    @property
    def place(self) -> str:
        """Effects of the file of which the refit beside an added effect leaves less than ``GONE``; ``SCALED``; ``LATE``."""
        found = []
        for c in self.d.changed if added(self.d) else ():
            cls = effect_class(c.effect) if c.effect else None
            own = (
                [p for p in cls.parameters() if p.name == c.name.rpartition(".")[2]]
                if cls is not None
                else []
            )
            none = own[0].absent if own else None
            if none is not None and abs(c.after - none) < GONE * abs(c.before - none):
                found.append(c.effect)
        place = f" in place of the file's {' and '.join(dict.fromkeys(found))}" * bool(
            found
        )
        number, factor = self.d.or_number
        off = (
            SCALED
            if number == EFFORT_SCALE
            else f"{number} of the file is off by a factor of {factor:.4g}"
        )
        late = "".join(
            f", or its {LATE[name]} are logged late by as much"
            for name in added(self.d)
            if name in LATE
        )
        return place + f", or {off}" * bool(number) + late

    @property
    def sizes(self) -> str:
        """The first number of each effect that was added: the absolute one where something fixes the scale of the torques."""
        if self.known is None:
            return ""
        primary = (
            self.known.absolute if self.known.pinned_by else self.known.identifiable
        )
        firsts = [
            next((n for n in primary if n.name.startswith(f"{name}.")), None)
            for name in added(self.d)
        ]
        words = [n.words() for n in firsts if n is not None]
        reads = [
            f": {e.reads_as}"
            for e in self.d.effects
            if e.name in added(self.d) and e.reads_as
        ]
        return f" ({', '.join(words)}{''.join(reads)})" if words else ""

    @property
    def fell(self) -> str:
        """From what to what the error falls, by what was added; without additions, by the refit of the twin's numbers."""
        d = self.d
        stage = d.baseline if added(d) else "before"
        whose = refitted_words(d) if stage == "fitted" else "the twin as it was"
        first, last = d.errors[stage], d.errors["after"]
        fell = f"the error falls from {first['validation']:.2f} ({whose}) to {last['validation']:.2f} noise floors"
        return fell + (
            f" (test {of_test(first['test'], last['test'])})" if "test" in last else ""
        )

    @property
    def ends(self) -> str:
        test = f"; test recordings, which no choice has seen, end at {self.d.errors['after']['test']:.2f} noise floors"
        return f"validation recordings end at {self.after:.2f}{test}"


def _doubts(
    d: Diagnosis, kind: Kind, short: Mapping[str, Sequence[str]] | None, floor: str
) -> Iterator[str]:
    if floor:
        yield f"the noise floor may be wrong, and every error with it: {floor}"
    after, first = d.errors["after"], d.errors[d.baseline]["validation"]
    fit, validation, test = after["fit"], after["validation"], after.get("test")
    named = kind in ("effects", "ties")
    others = [o for name in added(d) for o in d.rivals.get(name, ())]
    if kind == "ties" and others:
        yield f"{_some(others)} {'does' if len(others) == 1 else 'do'} as well"
    if d.or_in:
        yield f"a mass in {' or '.join(d.or_in)} explains as much"
    if test is None:
        yield "no test recording checks it: validation recordings chose the effects"
    elif test > FLOOR and validation <= LITTLE:
        yield f"test recordings, which no choice has seen, keep {test:.2f} noise floors"
    if d.untested:
        yield untested_words(d)
    if d.standing_out and added(d):
        yield f"{d.standing_out[0].words()} keeps {d.standing_out[0].error:.2f} noise floors"
    if kind in ("nothing_missing", "numbers_off") and max(fit, validation) > FLOOR:
        keep = f"fit recordings keep {fit:.2f} and validation recordings {validation:.2f} noise floors"
        yield f"{keep}, and no effect explains that"
    if validation < BELOW:
        yield f"at {validation:.2f} noise floors repeats differ by more than the twin is off; an effect below that is not found"
    if named and first <= LITTLE:
        yield (
            f"the whole gain is {first - validation:.2f} noise floors: without what was added the error is {first:.2f}, as "
            "little as noise that is not quite known may leave"
        )
    if named and validation > FLOOR:
        yield f"validation recordings keep {validation:.2f} of {first:.2f} floors, so little that no effect was looked for"
    words = {"": "", EFFORT_SCALE: "a wrong torque constant does as well"}
    also = words.get(d.or_number[0], "another gain does as well")
    clock = "a clock that stamps readings late does as well" * bool(
        {*LATE} & {*added(d)}
    )
    yield from filter(None, (also, clock, unjudged(d, short), may_be_two(d)))
    if d.one_pose:
        yield (
            f"{_some(tuple(d.one_pose))} found in one pose of the other joints, in which the weight of a tilted base or of a "
            "mass beside the axis (unbalance) acts alike: record another pose"
        )
    if d.at_bound:
        yield f"{_some(d.at_bound)} at the end of its range"
    if unknown := [*_open(d), *(c.name for c in d.changed if c.name in d.undetermined)]:
        beside = (
            ", so that what was added may stand in for an effect that is not known"
            * bool(added(d))
        )
        yield f"the recordings do not determine {_some(unknown)}{beside}"


def _record_next(
    w: _Words,
    kind: Kind,
    can_tell: Identifiability | None,
    repeated: bool,
    worst: RegimeError | None,
) -> tuple[str, str]:
    """In words, and the command that plans it."""
    part, d = w.part, w.d
    if kind in NEXT or d.status in NEXT:
        return NEXT[kind if kind in NEXT else d.status], ""
    if kind in UNCERTAIN:
        decides, command = _deciding(part, d, worst)
        if repeated:
            return f"A {decides}", command
        what = decides.split()[0]
        return (
            f"One {what} twice (repeat_of), for a better noise floor, and a {decides}",
            command,
        )
    if d.or_number[0] not in ("", EFFORT_SCALE):
        return (
            "The same motions at twice the gain, stated in measurements.yaml, or with the motor's effort.",
            "",
        )
    if kind == "ties":
        tied = [name for name in added(d) if d.rivals.get(name)]
        name = next((n for n in tied if separable(d, n, d.rivals[n])), tied[0])
        same, names = (
            inseparable_words(d, name, d.rivals[name]),
            (name, *separable(d, name, d.rivals[name])),
        )
        if len(names) == 1:
            return same, ""
        command = excite_command(part, names)
        classes = [cls for other in names if (cls := effect_class(other)) is not None]
        how = (
            ": " + " ".join(cls.to_record for cls in classes)
            if not command and classes
            else "."
        )
        words = f"A {recording_word(part, names)} that tells {_some(names)} apart{how}"
        return " ".join(
            filter(None, (words, same, _other_pose(d) if d.one_pose else ""))
        ), command
    if EFFORT_SCALE in (*w.instead, d.or_number[0]):
        return (
            "The same motions with a known load (`payload_kg`), whose part of the inertia is known.",
            "",
        )
    if w.instead:
        own, apart = (
            " and ".join(c.name for c in d.changed if c.instead),
            separable(d, w.instead[0], w.instead),
        )
        words = f"A wider motion, or another pose: it leaves {own} as before, but not the torque of {_some(w.instead)}."
        return words, excite_command(part, apart) if len(apart) > 1 else ""
    if kind == "nothing_missing":
        hidden = [
            n
            for n in (can_tell.invisible if can_tell is not None else ())
            if n not in d.present
        ]
        if not hidden:
            return "Nothing: every effect of a typical strength would have shown.", ""
        command = excite_command(part, hidden[:2]) if len(hidden) > 1 else ""
        return (
            f"Nothing, unless you suspect an effect that these recordings hardly show: {_some(hidden)}.",
            command,
        )
    if d.one_pose:
        name = next(iter(d.one_pose))
        open_ = {*(can_tell.visible if can_tell is not None else ())} - {
            name,
            *d.present,
        }
        rivals = [
            n
            for n in ("unbalance", "cable_spring", *d.twins.get(name, {}))
            if n in open_
        ]
        return _other_pose(d), excite_command(part, (name, rivals[0])) if rivals else ""
    return _a_check(w)


def _deciding(part: str, d: Diagnosis, worst: RegimeError | None) -> tuple[str, str]:
    """Of what is not explained: the recording that decides between the nearest effects, or has more of where the error is
    largest, or shows an effect more clearly."""
    near = [name for name, error in d.nearest if error <= d.standing_out[0].most]
    near = near or [
        e.name
        for r in d.rounds[-1:]
        for e in r.evidence
        if e.name not in d.names and e.gain >= NEAR
    ]
    best = [
        *near[:1],
        *(other for first in near[:1] for other in separable(d, first, near[1:])[:1]),
    ]
    command = excite_command(part, best) if len(best) == 2 else ""
    what = recording_word(part, best or d.names)
    if command:
        return (
            f"{what} that decides between the nearest effects, {' and '.join(best)}.",
            command,
        )
    if worst is not None:
        where = f"{worst.regime} ({worst.error:.2f} noise floors in {worst.recording})"
        return (
            f"{what} with more of the regime in which the error is largest: {where}.",
            "",
        )
    tried = [e.name for r in d.rounds[-1:] for e in r.evidence]
    name = next(
        (name for name in best or added(d) or tried if effect_class(name) is not None),
        None,
    )
    if name is None:
        return (
            f"{what} of another kind: slower and faster, with less and with more load.",
            "",
        )
    cls, twins = effect_class(name), plannable(d, name, d.twins.get(name, {}))
    how = f": {cls.to_record}" if cls is not None and cls.to_record else "."
    command = excite_command(part, (name, *twins[:1])) if twins else ""
    return f"{what} that shows more of what {name} explains{how}", command


def _a_check(w: _Words) -> tuple[str, str]:
    """Of what was named: a recording that tells it from its near-twin, and what fixes the scale of the torques."""
    d, scale = w.d, ""
    if w.known is not None and not w.known.pinned_by:
        kp = next((n for n in w.known.absolute if n.name == "kp"), None)
        scale = (
            f" (K_p is known only to {kp.low:.3g} … {kp.high:.3g} {kp.unit})"
            if kp is not None
            else ""
        )
    name = (*added(d), *(c.effect or c.name for c in d.changed))[0]
    twins = plannable(
        d, name, d.twins.get(name) or getattr(effect_class(name), "near_twins", ())
    )
    command = excite_command(w.part, (name, *twins[:1])) if twins else ""
    what = f"A {recording_word(w.part, (name,))}"
    check = (
        f"{what} that tells {name} from its near-twin {twins[0]}, as a check"
        if command
        else ""
    )
    effort = (
        f"; the motor's effort or a known payload, if absolute torques matter{scale}"
        if scale
        else ""
    )
    return f"{check or f'{what} of another kind, as a test'}{effort}.", command


def _other_pose(d: Diagnosis) -> str:
    """Sentence: the recording that shows whether a torque that depends on the position is the weight of something."""
    name, others = next(iter(d.one_pose.items()))
    return (
        f"The same motions in another pose, with {_some(others)} elsewhere by 0.5 rad or more: {name} keeps its numbers there if "
        "it is what is missing, the torque of a weight does not."
    )

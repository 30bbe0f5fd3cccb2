"""Verdict of a diagnosis: the missing effect, the confidence, and what to record next, in one sentence each. A pure function of
the findings; the terminal and the page show the same sentences.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from taccorl.diagnosis.comparison.regimes import RegimeError
from taccorl.diagnosis.report.evidence_words import (
    effect_class,
    excite_command,
    inseparable_words,
    may_be_two,
    recording_word,
    separable,
    unit_words,
    unjudged,
    untested_words,
)
from taccorl.diagnosis.search.identifiability import Identifiability
from taccorl.diagnosis.search.identifiable import Known
from taccorl.diagnosis.search.result import Changed, Diagnosis, SearchConfig, of_test

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
"""What a verdict says: nothing is missing, numbers of the file are off, effects are missing, effects that tie, more than was
found, …"""
Level = Literal["high", "moderate", "low"]
"""Confidence."""
FLOOR, LITTLE = SearchConfig().stop_at, SearchConfig().little
"""Largest errors [noise floors] that count as at the floor, and as little above it."""
_UNCERTAIN: tuple[Kind, ...] = ("more", "something_else", "gains_moved", "not_converged", "data_first")
GONE = 0.2
"""Share of an effect's strength in the file below which an added effect is in place of it. A choice."""
NEAR = 0.05
"""Least share of the validation squared error above the floor that an effect removes which a verdict calls near."""
_MOST = 3  # names or reasons in one sentence


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """Verdict on one part in three sentences: finding, confidence, and what to record next."""

    part: str
    """Name of the part."""
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
    short: Mapping[str, Sequence[str]] | None = None,
    worst: RegimeError | None = None,
) -> Verdict:
    """Verdict on one part.

    Args:
        can_tell: effects that its recordings can show and separate.
        known: its numbers, if they were divided into identified and other ones.
        data: faults of the recordings that must be corrected before an effect can be named.
        doubts: other reasons for less confidence, such as ranges that no validation recording covers.
        options: options of suggested commands, such as ``--twin=twin.yaml``.
        repeated: a motion of the part was repeated, so that the noise floor includes the variation between repeats.
        short: fit, validation → variables whose range in the recordings of the other use its own do not cover, if it is known.
        worst: recording and regime with the largest error after the fit, if they are known.
    """
    kind = _kind(d, data)
    told = (*d.remarks, *doubts[:_MOST])
    reasons = [*_doubts(d, kind, short), *([f"see the {_counted(len(told), 'remark')} below"] if told else [])]
    level: Level = "low" if kind in _UNCERTAIN else "moderate" if reasons or kind == "ties" else "high"
    words, command = _record_next(part, kind, d, can_tell, known, repeated, worst)
    return Verdict(
        part=part,
        kind=kind,
        level=level,
        finding=_finding(part, kind, d, known, data),
        confidence=_confidence(level, kind, d, reasons),
        record_next=words,
        command=" ".join([command, *options]) if command else "",
        remarks=tuple(told),
    )


def refitted_words(d: Diagnosis) -> str:
    """Text that names the fit of all always fitted numbers without an added effect: for a joint these are the gains, for pads and
    axes others."""
    return "gains refitted" if "kp" in d.base else "with the numbers refitted that every fit adjusts"


def changed_words(d: Diagnosis) -> list[str]:
    """Texts on the numbers of the file whose refit removes a part of the error, one for each effect or other number, such as
    ``coulomb_friction.torque_nm 0.052 → 0.252 N·m (0.246 … 0.258), else 12.30 noise floors remain``."""
    groups: dict[str, list[Changed]] = {}
    for c in d.changed:
        groups.setdefault(c.effect or c.name, []).append(c)
    found = []
    for own in groups.values():
        alone = " without an added effect" * own[0].alone
        found.append(f"{', '.join(_change(c, d) for c in own)}, else {own[0].without:.2f} noise floors remain{alone}")
    return found


def _change(c: Changed, d: Diagnosis) -> str:
    low, high = d.intervals.get(c.name, (c.after, c.after))
    return f"{c.name} {c.before:.4g} → {c.after:.4g}{unit_words(c.unit)} ({low:.4g} … {high:.4g})"


def replaced(d: Diagnosis) -> tuple[str, ...]:
    """Effects of the file of whose strength the refit beside an added effect leaves less than ``GONE``."""
    found = []
    for c in d.changed if added(d) else ():
        cls = effect_class(c.effect) if c.effect else None
        own = [p for p in cls.parameters() if p.name == c.name.rpartition(".")[2]] if cls is not None else []
        if own and own[0].absent is not None and abs(c.after - own[0].absent) < GONE * abs(c.before - own[0].absent):
            found.append(c.effect)
    return tuple(dict.fromkeys(found))


def added(d: Diagnosis) -> tuple[str, ...]:
    """Names of the effects that were added, which the twin lacked."""
    return tuple(name for name in d.names if name not in d.present)


def _kind(d: Diagnosis, data: Sequence[str]) -> Kind:
    if data:
        return "data_first"
    kinds: dict[str, Kind] = {
        "not_converged": "not_converged",
        "gains_moved": "gains_moved",
        "nothing_missing": "nothing_missing",
        "numbers_off": "numbers_off",
        "too_many": "more",
    }
    if d.status in kinds:
        return kinds[d.status]
    if d.status == "something_else":
        return "more" if added(d) else "something_else"
    return "ties" if any(d.rivals.get(name) for name in added(d)) else "effects"


def _finding(part: str, kind: Kind, d: Diagnosis, known: Known | None, data: Sequence[str]) -> str:
    """The finding, and the numbers of the file that explain a part of the error."""
    text = _found(part, kind, d, known, data)
    if not d.changed or kind in ("data_first", "not_converged"):
        return text
    return f"{text} Numbers of the file that change: {'; '.join(changed_words(d))}."


def _found(part: str, kind: Kind, d: Diagnosis, known: Known | None, data: Sequence[str]) -> str:
    after = d.errors["after"]["validation"]
    names = " and ".join(added(d))
    if kind == "data_first":
        more = f" (and {len(data) - 1} more)" if len(data) > 1 else ""
        return f"{part}: settle the data before any effect is named: {data[0]}{more}."
    if kind == "not_converged":
        return f"{part}: the fit has not converged, so nothing follows from its error of {after:.2f} noise floors."
    if kind == "gains_moved":
        return f"{part}: no effect is needed, but only with gains far from the twin's: {_moved(d)}."
    if kind == "nothing_missing":
        return f"{part}: nothing is missing; the error is {after:.2f} noise floors ({refitted_words(d)})."
    if kind == "numbers_off":
        names = " and ".join(dict.fromkeys(c.effect or c.name for c in d.changed))
        return f"{part}: no effect is missing, but {names} of the file is off: {_fell(d)}."
    if kind == "something_else":
        return f"{part}: no known effect explains what is missing; {after:.2f} noise floors remain."
    fell, instead = _fell(d), replaced(d)
    place = f" in place of the file's {' and '.join(instead)}" * bool(instead)
    if kind == "more":
        ties = {r.added: r.ties for r in d.rounds}
        others = {n: [t for t in (*ties.get(n, ()), *d.rivals.get(n, ())) if t not in d.names] for n in added(d)}
        return f"{part} lacks {_either(d, others)}{place}, and something more: {fell}, and the floor is not reached."
    if kind == "ties":
        return f"{part} lacks {_either(d, d.rivals)}{place}: {fell}, and these recordings do not tell which it is."
    return f"{part} lacks {names}{_sizes(d, known)}{place}: {fell}."


def _fell(d: Diagnosis) -> str:
    """Text: from what to what the error falls, by what was added; without additions, by the refit of the twin's numbers."""
    stage = d.baseline if added(d) else "before"
    whose = refitted_words(d) if stage == "fitted" else "the twin as it was"
    first, last = d.errors[stage], d.errors["after"]
    fell = f"the error falls from {first['validation']:.2f} ({whose}) to {last['validation']:.2f} noise floors"
    return fell + (f" (test {of_test(first['test'], last['test'])})" if "test" in last else "")


def _either(d: Diagnosis, others: Mapping[str, Sequence[str]]) -> str:
    """Added effects, each with the others that may be missing in its place."""
    return "; ".join(" or ".join(dict.fromkeys((name, *others.get(name, ())))) for name in added(d))


def _sizes(d: Diagnosis, known: Known | None) -> str:
    """The first number of each effect that was added: the absolute one where something fixes the scale of the torques."""
    if known is None:
        return ""
    primary = known.absolute if known.pinned_by else known.identifiable
    firsts = [next((n for n in primary if n.name.startswith(f"{name}.")), None) for name in added(d)]
    told = [n.words() for n in firsts if n is not None]
    return f" ({', '.join(told)})" if told else ""


def _moved(d: Diagnosis) -> str:
    pairs = [(g, d.start.get(g, 0.0), d.base[g]) for g in ("kp", "kd") if g in d.base]
    return ", ".join(f"{g} {old:.4g} → {new:.4g} (× {new / old:.2g})" for g, old, new in pairs if old)


def _doubts(d: Diagnosis, kind: Kind, short: Mapping[str, Sequence[str]] | None) -> list[str]:
    found = []
    if kind == "ties" and any(d.rivals.get(name) for name in added(d)):
        others = [o for name in added(d) for o in d.rivals.get(name, ())]
        found.append(f"{_some(others)} {'does' if len(others) == 1 else 'do'} as well")
    test = d.errors["after"].get("test")
    if test is None:
        found.append("no test recording checks it: validation recordings chose the effects")
    elif test > FLOOR and d.errors["after"]["validation"] <= LITTLE:
        found.append(f"test recordings, which no choice has seen, keep {test:.2f} noise floors")
    if d.untested:
        found.append(untested_words(d))
    after = d.errors["after"]
    if kind in ("nothing_missing", "numbers_off") and max(after["fit"], after["validation"]) > FLOOR:
        found.append(
            f"fit recordings keep {after['fit']:.2f} and validation recordings {after['validation']:.2f} noise floors, and no "
            "effect explains that"
        )
    if kind in ("effects", "ties") and (first := d.errors[d.baseline]["validation"]) <= LITTLE:
        found.append(
            f"the whole gain is {first - after['validation']:.2f} noise floors: without what was added the error is "
            f"{first:.2f}, as little as noise that is not quite known may leave"
        )
    if kind in ("effects", "ties") and after["validation"] > FLOOR:
        found.append(
            f"validation recordings keep {after['validation']:.2f} of {d.errors[d.baseline]['validation']:.2f} noise floors, so "
            "little that no effect was looked for"
        )
    found += [text for text in (unjudged(d, short), may_be_two(d)) if text]
    if d.one_pose:
        found.append(
            f"{_some(tuple(d.one_pose))} found in one pose of the other joints, in which the weight of a tilted base or of a "
            "mass beside the axis (unbalance) acts alike: record another pose"
        )
    if d.at_bound:
        found.append(f"{_some(d.at_bound)} at the end of its range")
    return found


def _confidence(level: Level, kind: Kind, d: Diagnosis, reasons: Sequence[str]) -> str:
    own: dict[Kind, str] = {
        "data_first": "the recordings contradict themselves or the clock",
        "not_converged": d.trouble or "the numbers were still moving",
        "gains_moved": "wrong time stamps or gains explain the data as well as the fitted gains do",
        "something_else": "every known effect was tried and refused",
        "more": "what is still missing may change what was named",
    }
    first = [own[kind]] if kind in own else []
    if not first and not reasons:
        test = f"; test recordings, which no choice has seen, end at {d.errors['after']['test']:.2f} noise floors"
        first = [f"validation recordings end at {d.errors['after']['validation']:.2f}{test}"]
    told = [reason.rstrip(".") for reason in (*first, *reasons)]
    more = f"; and {len(told) - _MOST} more" if len(told) > _MOST else ""
    return f"Confidence {level}: {'; '.join(told[:_MOST])}{more}."


def _record_next(
    part: str,
    kind: Kind,
    d: Diagnosis,
    can_tell: Identifiability | None,
    known: Known | None,
    repeated: bool,
    worst: RegimeError | None,
) -> tuple[str, str]:
    """In words, and the command that plans it."""
    if kind == "data_first":
        return "The same motions again, once the data is settled.", ""
    if kind == "gains_moved":
        return "Nothing yet: state the commanded gains (kp, kd in measurements.yaml) and check the time stamps.", ""
    if kind == "more" and d.status == "too_many":
        return "Nothing yet: let the search add effects until the noise floor is reached (--until=noise_floor).", ""
    if kind in ("something_else", "more", "not_converged"):
        near = [e.name for r in d.rounds[-1:] for e in r.evidence if e.name not in d.names and e.gain >= NEAR]
        best = [*near[:1], *(other for first in near[:1] for other in separable(d, first, near[1:])[:1])]
        command = excite_command(part, best) if len(best) == 2 else ""
        between = f" between the nearest effects, {' and '.join(best)}" if command else ""
        what = recording_word(part, best or d.names)
        where = f" {worst.regime} ({worst.error:.2f} noise floors in {worst.recording})" if worst is not None else ""
        if between:
            decides = f"{what} that decides{between}."
        elif where:
            decides = f"{what} with more of the regime in which the error is largest:{where}."
        else:
            tried = [e.name for r in d.rounds[-1:] for e in r.evidence]
            shown = [name for name in best or added(d) or tried if effect_class(name) is not None][:1]
            decides, command = _to_show(part, what, shown, d)
        if repeated:
            return f"A {decides}", command
        return f"One {what} twice (repeat_of), for a better noise floor, and a {decides}", command
    if kind == "ties":
        tied = [name for name in added(d) if d.rivals.get(name)]
        name = next((n for n in tied if separable(d, n, d.rivals[n])), tied[0])
        same, names = inseparable_words(d, name, d.rivals[name]), (name, *separable(d, name, d.rivals[name]))
        if len(names) == 1:
            return same, ""
        command = excite_command(part, names)
        how = (
            ""
            if command
            else ": " + " ".join(cls.to_record for other in names if (cls := effect_class(other)) is not None)
        )
        words = f"A {recording_word(part, names)} that tells {_some(names)} apart{how or '.'}"
        return " ".join(filter(None, (words, same, _other_pose(d) if d.one_pose else ""))), command
    if kind == "nothing_missing":
        hidden = list(can_tell.invisible) if can_tell is not None else []
        command = excite_command(part, hidden[:2]) if len(hidden) > 1 else ""
        if not hidden:
            return "Nothing: every effect of a typical strength would have shown.", ""
        return f"Nothing, unless you suspect an effect that these recordings hardly show: {_some(hidden)}.", command
    if d.one_pose:
        name, seen = next(iter(d.one_pose)), can_tell.visible if can_tell is not None else {}
        rivals = [n for n in ("unbalance", "cable_spring", *d.twins.get(name, {})) if n != name and n in seen]
        return _other_pose(d), excite_command(part, (name, rivals[0])) if rivals else ""
    scale = ""
    if known is not None and not known.pinned_by:
        kp = next((n for n in known.absolute if n.name == "kp"), None)
        scale = f" (K_p is known only to {kp.low:.3g} … {kp.high:.3g} {kp.unit})" if kp is not None else ""
    name = (*added(d), *(c.effect or c.name for c in d.changed))[0]
    cls = effect_class(name)
    near = d.twins.get(name) or (cls.near_twins if cls is not None else ())
    near = separable(d, name, near)
    twins = [other for other in near if effect_class(other) is not None and other not in d.present]
    command = excite_command(part, (name, *twins[:1])) if twins else ""
    what = recording_word(part, (name,))
    check = (
        f"A {what} that tells {name} from its near-twin {twins[0]}, as a check"
        if command
        else f"A {what} of another kind, as a test"
    )
    effort = f"; the motor's effort or a known payload, if absolute torques matter{scale}" if scale else ""
    return f"{check}{effort}.", command


def _to_show(part: str, what: str, names: Sequence[str], d: Diagnosis) -> tuple[str, str]:
    """What shows the effect in ``names`` (one, or none) more clearly, in words, and the command that plans it."""
    if not names:
        return f"{what} of another kind: slower and faster, with less and with more load.", ""
    (name,) = names
    cls, twins = effect_class(name), separable(d, name, d.twins.get(name, {}))
    twins = [t for t in twins if effect_class(t) is not None]
    how = f": {cls.to_record}" if cls is not None and cls.to_record else "."
    commands = (excite_command(part, (name, twin)) for twin in twins)
    return f"{what} that shows more of what {name} explains{how}", next(filter(None, commands), "")


def _other_pose(d: Diagnosis) -> str:
    """Sentence: the recording that shows whether a torque that depends on the position is the weight of something."""
    name, others = next(iter(d.one_pose.items()))
    return (
        f"The same motions in another pose, with {_some(others)} elsewhere by 0.5 rad or more: {name} keeps its numbers there if "
        "it is what is missing, the torque of a weight does not."
    )


def _counted(n: int, thing: str) -> str:
    return f"{n} {thing}{'' if n == 1 else 's'}"


def _some(names: Sequence[str]) -> str:
    more = f" and {len(names) - _MOST} more" if len(names) > _MOST else ""
    return ", ".join(names[:_MOST]) + more

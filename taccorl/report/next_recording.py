"""Facts on what to record next, and the command that plans it."""

import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from taccorl.diagnosis.search.problem import EFFORT_SCALE
from taccorl.diagnosis.search.result import Diagnosis
from taccorl.report.evidence import (
    Seen,
    added,
    effect_class,
    nested,
    plannable,
    separable,
)
from taccorl.report.fact import Fact, fact, when

NEAR_GAIN = 0.05
"""Least gain of an effect from which a recording for it is worth while."""

TOLD_APART = 2.0
"""Factor on the error from which recordings tell two effects apart (a choice)."""


@dataclass(frozen=True)
class Advice:
    """What the advice about one part depends on."""

    part: str
    d: Diagnosis
    kind: str
    """Identifier of the title (``texts.yaml``)."""
    numbers: Sequence[str]
    """Numbers of the file that are off."""
    seen: Seen

    def motion(self, *names: str) -> str:
        """Word for what is recorded: a press of pads and cells, otherwise a motion."""
        is_pressed = self.part.endswith(" pads") or _all_of("cells", names)
        return "press" if is_pressed else "motion"

    def plan(self, *names: str) -> list[Fact]:
        """The command that plans a recording which separates these effects."""
        command = excite_command(self.part, names) if len(names) > 1 else ""
        return when(command, "plan", command=command)


def next_recording(of: Advice) -> Iterator[Fact]:
    """What to record next, and the command that plans it: by the first that holds of a
    list of cases."""
    d = of.d
    instead = list(dict.fromkeys(name for c in d.changed for name in c.instead))
    off = [c.name for c in d.changed if c.instead]
    wider = fact("record_wider", numbers=off, effects=instead)
    by_efforts = EFFORT_SCALE in (*instead, d.or_number[0])
    is_open = of.kind == "not_converged" or d.status == "something_else"
    cases = [
        (of.kind == "data_first", lambda: [fact("record_data")]),
        (of.kind == "drifting", lambda: [fact("record_steady")]),
        (of.kind == "gains_moved", lambda: [fact("record_gains")]),
        (is_open, lambda: _deciding(of)),
        (d.status == "too_many", list),  # the search itself may go on
        (d.or_number[0] and not by_efforts, lambda: [fact("record_gain")]),
        (of.kind == "ties", lambda: _apart(of)),
        (by_efforts, lambda: [fact("record_load")]),
        (instead, lambda: [wider, *of.plan(*separable(d, instead[0], instead))]),
        (of.kind == "nothing_missing", lambda: _hidden(of)),
        (d.one_pose, lambda: _other_pose(of)),
        (True, lambda: _check(of)),
    ]
    yield from next(found for is_so, found in cases if is_so)()


def excite_command(part: str, names: Sequence[str]) -> str:
    """Command line that plans a recording which separates the effects ``names`` of a joint,
    an axis, pads or a sensor of cells; empty for effects that are in no registry."""
    effects = f"--effects={','.join(names)}"
    if part.endswith(" pads"):
        return f"taccorl excite --pads={part.removesuffix(' pads')} {effects}"
    if "_joint" in part or _all_of("joint", names):
        return f"taccorl excite {shlex.quote(part)} {effects}"
    return f"taccorl excite {effects}" if _all_of("cells", names) else ""


def _all_of(kind: str, names: Sequence[str]) -> bool:
    """Whether all effects ``names`` act on this kind of part; False without any."""
    classes = [effect_class(name) for name in names]
    return bool(names) and all(c is not None and kind in c.kinds() for c in classes)


def _deciding(of: Advice) -> list[Fact]:
    """What to record next where no effect explains the error: a motion that tells the
    effects with the lowest errors apart, or one that has more of the condition in which
    the error is largest, or one that shows an effect more clearly."""
    d, worst = of.d, of.seen.worst
    tried = [e for r in d.rounds[-1:] for e in r.evidence]
    near = [name for name, error in d.nearest if error <= d.standing_out[0].most]
    new = [e.name for e in tried if e.name not in d.names and e.gain >= NEAR_GAIN]
    near = near or new
    motion = of.motion(*near[:1])
    again = when(not of.seen.repeated, "record_repeat", motion=motion)
    others = [o for first in near[:1] for o in separable(d, first, near[1:])]
    if plan := of.plan(*near[:1], *others[:1]):
        both = [near[0], others[0]]
        return [*again, fact("record_apart", motion=motion, effects=both), *plan]
    if worst is not None:
        place = f"{worst.regime} ({worst.recording})"
        return [*again, fact("record_regime", motion=motion, place=place)]
    known = [*(near or added(d) or (e.name for e in tried))]
    for name, cls in ((name, effect_class(name)) for name in known):
        if cls is not None:
            how = cls.to_record or "another motion"
            plan = of.plan(name, *plannable(d, name, d.twins.get(name, {}))[:1])
            return [*again, fact("record_shown", effect=name, how=how), *plan]
    return [*again, fact("record_kinds", motion=motion)]


def _apart(of: Advice) -> Iterator[Fact]:
    """Of effects that tie: the motion that tells them apart, or why there is none."""
    d = of.d
    tied = [name for name in added(d) if d.rivals.get(name)]
    name = next((n for n in tied if separable(d, n, d.rivals[n])), tied[0])
    apart, motion = separable(d, name, d.rivals[name]), of.motion(name)
    yield from when(apart, "record_apart", motion=motion, effects=[name, *apart])
    yield from of.plan(name, *apart)
    for other in (o for o in d.rivals[name] if o not in apart):
        same = nested(d, name, other)
        if same is None:
            id = "record_either" if of.seen.has_effort else "record_efforts"
            yield fact(id, effect=name, other=other)
        else:
            yield fact("record_simpler", **same._asdict())
    yield from _other_pose(of) if apart and d.one_pose else ()


def _hidden(of: Advice) -> list[Fact]:
    names = of.seen.can_tell.invisible if of.seen.can_tell is not None else ()
    hidden = [name for name in names if name not in of.d.present]
    return [
        *when(hidden, "record_hidden", effects=hidden),
        *of.plan(*hidden[:2]),
        *when(not hidden, "record_nothing"),
    ]


def _other_pose(of: Advice) -> list[Fact]:
    """The recording that shows whether a torque that depends on the position is the weight
    of something."""
    d, can_tell = of.d, of.seen.can_tell
    name, joints = next(iter(d.one_pose.items()))
    visible = {*(can_tell.visible if can_tell is not None else ())}
    rivals = ("unbalance", "cable_spring", *d.twins.get(name, {}))
    open_ = [n for n in rivals if n in visible - {name, *d.present}]
    shown = fact("record_pose", effect=name, joints=joints)
    return [shown, *of.plan(name, *open_[:1])]


def _told_apart(d: Diagnosis, name: str) -> set[str]:
    """Effects that leave ``TOLD_APART`` times the error of the effect ``name``, which was
    added in their place, so that no other recording need separate them."""
    return {
        e.name
        for r in d.rounds
        for e in r.evidence
        if r.added == name
        and e.validation_error > TOLD_APART * max(r.validation_error, 1.0)
    }


def _check(of: Advice) -> list[Fact]:
    """Of what was named: a recording that tells it from its near-twin, and what fixes the
    scale of the torques."""
    d, known = of.d, of.seen.known
    name = [*added(d), *(n.rpartition(".")[0] or n for n in of.numbers)][0]
    near = d.twins.get(name) or getattr(effect_class(name), "near_twins", ())
    told_apart = _told_apart(d, name)
    other = plannable(d, name, [n for n in near if n not in told_apart])[:1]
    plan, motion = of.plan(name, *other), of.motion(name)
    absolute = known.absolute if known is not None and not known.pinned_by else ()
    checked = [
        fact("record_check", motion=motion, effect=name, other=twin)
        for twin in other
        if plan
    ]
    return [
        *(checked or [fact("record_test", motion=motion)]),
        *plan,
        *(
            fact("record_torques", low=n.low, high=n.high, unit=n.unit)
            for n in absolute
            if n.name == "kp"
        ),
    ]

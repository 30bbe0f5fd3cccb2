"""Findings of one part in the light of the others': with more remarks, and without what the others speak against."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import cast

from taccorl.alignment.machines.robot_joint import PAYLOAD_AT
from taccorl.diagnosis.machines.machine import Finding
from taccorl.diagnosis.problems.joint_problem import TORQUE_FF
from taccorl.diagnosis.remark import Remark
from taccorl.diagnosis.search.fit import Fit
from taccorl.diagnosis.search.identifiable import Known
from taccorl.diagnosis.search.problem import EFFORT_SCALE
from taccorl.diagnosis.search.result import Diagnosis
from taccorl.sim.effects.load import Payload

TILT = "tilt"
"""Identifier of the remark on the tilt that one joint alone suggests."""


def remarked[FindingT: Finding](f: FindingT, *remarks: str | Remark) -> FindingT:
    """The finding with more remarks about its result."""
    every = cast(tuple[str, ...], (*f.diagnosis.remarks, *remarks))
    d = dataclasses.replace(f.diagnosis, remarks=every)
    return dataclasses.replace(f, diagnosis=d)


def payloads(findings: Sequence[Finding]) -> list[Finding]:
    """Findings that add a payload."""
    return [
        f
        for f in findings
        if "payload" in f.diagnosis.names and "payload" not in f.diagnosis.present
    ]


def lacked(f: Finding) -> tuple[str, ...]:
    """Names of the effects that a finding adds, and of the numbers in the robot's file that it calls wrong."""
    return (
        *(n for n in f.diagnosis.names if n not in f.diagnosis.present),
        *numbers_off(f),
    )


def numbers_off(f: Finding) -> tuple[str, ...]:
    """Names of the numbers in the robot's file, such as ``kp``, that a finding calls wrong."""
    return tuple(c.name for c in f.diagnosis.changed)


def without_numbers(f: Finding, owner: Finding) -> Finding:
    """The finding at a joint that feels the payload of ``owner``; if that may be in another body as well, without numbers of the
    file that are off: they may make up for its place."""
    d, off = f.diagnosis, numbers_off(f)
    if not (owner.diagnosis.or_in and off):
        return f
    d = dataclasses.replace(
        d,
        changed=(),
        status="nothing_missing" if d.status == "numbers_off" else d.status,
    )
    found = Remark("payload_elsewhere", {"numbers": off, "part": owner.part})
    return remarked(dataclasses.replace(f, diagnosis=d), found)


def standing_in(d: Diagnosis, effect: str) -> tuple[str, ...]:
    """Added effects of one joint in whose place ``effect`` explains as much; that one itself if it was added. And the scale of
    its efforts where that is off instead."""
    off = tuple(
        c.name for c in d.changed if c.name == EFFORT_SCALE and effect in c.instead
    )
    return (
        *off,
        *(
            n
            for n in d.names
            if n not in d.present and effect in (n, *d.rivals.get(n, ()))
        ),
    )


def without_tilt(f: Finding) -> Finding:
    """The finding without the remark on the tilt that it alone suggests."""
    every = cast(tuple[str | Remark, ...], f.diagnosis.remarks)
    remarks = tuple(r for r in every if not (isinstance(r, Remark) and r.id == TILT))
    return dataclasses.replace(
        f, diagnosis=dataclasses.replace(f.diagnosis, remarks=remarks)
    )


def without_payload(f: Finding, joints: Sequence[str]) -> Finding:
    """The finding without a payload among the rivals of what was added, and among what ``add-effect`` may write."""
    d = f.diagnosis
    refused = "one mass, in whichever link, does not explain these joints together"

    def without(names: Sequence[str]) -> tuple[str, ...]:
        return tuple(name for name in names if name != "payload")

    rivals = {name: without(others) for name, others in d.rivals.items()}
    told = [
        [
            dataclasses.replace(e, verdict=refused) if e.name == "payload" else e
            for e in r.evidence
        ]
        for r in d.rounds
    ]
    rounds = [
        dataclasses.replace(r, ties=without(r.ties), evidence=tuple(e))
        for r, e in zip(d.rounds, told, strict=True)
    ]
    offers = tuple(o for o in d.offers if "payload" not in o.added)
    changed = tuple(
        dataclasses.replace(c, instead=without(c.instead)) for c in d.changed
    )
    d = dataclasses.replace(
        d, rivals=rivals, rounds=tuple(rounds), offers=offers, changed=changed
    )
    remark = Remark("payload_without", {"joints": list(joints)})
    return remarked(dataclasses.replace(f, diagnosis=d), remark)


def placed(
    f: Finding, model: Fit, stands_for: Mapping[str, Sequence[str]], ties: Sequence[str]
) -> Finding:
    """The finding of one joint with the values of ``model``, a fit of one payload to several joints: its mass, its intervals, and
    the numbers of the drive that every fit adjusts. A remark names the effects that the payload replaces: ``stands_for``,
    joint → effects that alone explain as much there. ``ties``: other bodies where the payload explains as much."""
    d, every = f.diagnosis, model.intervals()
    ends = {
        name: interval
        for name, interval in every.items()
        if name.startswith("payload.")
    }
    own = {name.removeprefix("payload."): interval for name, interval in ends.items()}
    mass = {"mass_kg": model.values["payload.mass_kg"], "interval": own}
    effects_ = [
        dataclasses.replace(e, **mass) if isinstance(e, Payload) else e
        for e in d.effects
    ]
    known = cast(Known, f.known)
    for old in [n for n in known.identifiable if n.name in ends]:
        low, high = ends[old.name]
        now = dataclasses.replace(old, value=model.values[old.name], low=low, high=high)
        effects_ = [
            dataclasses.replace(
                e, evidence=e.evidence.replace(old.words(), now.words())
            )
            for e in effects_
        ]
        numbers = [
            tuple(now if n.name == now.name else n for n in of)
            for of in (known.identifiable, known.absolute)
        ]
        known = dataclasses.replace(known, identifiable=numbers[0], absolute=numbers[1])
    shared = ["mass_kg", *(name for name in own if name in PAYLOAD_AT)]
    remarks = [Remark("payload_shared", {"numbers": shared})]
    if TORQUE_FF.name not in d.base:
        stays = {"name": TORQUE_FF.name, "part": f.part}
        remarks.append(Remark("torque_stays", stays))
    for part, names in stands_for.items():
        if "payload" not in names:
            other = {"effects": list(names), "part": part}
            remarks.append(Remark("payload_stands_for", other))
    of_mass = d.or_number[0] == EFFORT_SCALE and any(
        EFFORT_SCALE in names for names in stands_for.values()
    )
    number = ("", 1.0) if of_mass else d.or_number
    base = {
        name: model.values.get(f"{f.part}/{name}", value)
        for name, value in d.base.items()
    }
    more = ends | {
        name: every[f"{f.part}/{name}"] for name in base if f"{f.part}/{name}" in every
    }
    d = dataclasses.replace(
        d,
        effects=tuple(effects_),
        intervals={**d.intervals, **more},
        base=base,
        or_number=number,
    )
    changed = tuple(
        dataclasses.replace(c, after=base.get(c.name, c.after)) for c in d.changed
    )
    d = dataclasses.replace(d, changed=changed, or_in=tuple(ties))
    return remarked(dataclasses.replace(f, diagnosis=d, known=known), *remarks)


def left_of(finding: Finding) -> float:
    """Mean squared validation error that a finding leaves [noise floors²], 1 at least."""
    return max(finding.diagnosis.errors["after"]["validation"], 1.0) ** 2


def payload_of(finding: Finding) -> Payload:
    return next(e for e in finding.diagnosis.effects if isinstance(e, Payload))

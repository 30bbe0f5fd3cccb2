"""``taccorl add-effect coulomb_friction --twin=twin.yaml --joints=left_joint5``: add one physical effect to a twin.
``taccorl add-effect taxel_creep --twin=twin.yaml --pads=left``: an effect of pads.

The values are those that the last ``taccorl diagnose`` of this twin fitted, and with them the values that were refitted
together: gains of a joint, k_n and k_d of pads. An effect that was tied with the chosen one can also be added. Numbers of the
file that the diagnosis says are off are written likewise: ``taccorl add-effect kd``.
``--values={torque_nm: 0.4}`` gives values by hand instead. Prints the numbers that change, old and new, and those that stay.
Writes a copy, ``twin+coulomb_friction.yaml``, which collection, generation and training load.
"""

import json
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from taccorl.cli.output_lock import hold
from taccorl.cli.parse import verb
from taccorl.errors import TaccorlError, nearest
from taccorl.report.section import Section

if TYPE_CHECKING:
    from taccorl.diagnosis.machines.machine import Addition, Machine

Numbers = dict[str, tuple[float, str]]
"""Name → (value, unit) of the numbers of one part."""


@dataclass(kw_only=True)
class AddEffectConfig:
    """Add one physical effect to a twin."""

    effect: str
    """Name of the effect; docs/effects.md lists them. Or of a number that the diagnosis says is off, such as kd or inertia.
    Several with commas between them: what one diagnosis found, at one joint or at several. The numbers are those of a fit with
    exactly these."""
    twin: Path | None = None
    """File of the machine: a twin.yaml of the PiPER, or a file of kind robot or cells. The nominal twin if not given."""
    joints: list[str] = field(default_factory=list)
    """left_joint5; joint5 or J4 (the paper's name of it) for both arms. If not given: all joints for which the diagnosis found
    the effect."""
    pads: list[str] = field(default_factory=list)
    """left, right: the pads of these arms. If not given: the pads for which the diagnosis found the effect."""
    diagnosis: Path = Path("diagnosis")
    """Folder of the diagnosis that fitted the values, or its report.json."""
    values: dict[str, float] = field(default_factory=dict)
    """Values by hand, such as {torque_nm: 0.4}; no diagnosis is read then."""
    out: Path | None = None
    """File to write; beside the twin, with +EFFECT in its name, if not given. An existing file is not overwritten."""
    in_place: bool = False
    """Change the twin's own file instead of writing a copy."""


@verb(AddEffectConfig, positional="effect", prog="taccorl add-effect")
def run(config: AddEffectConfig) -> int:
    """Write the twin with the effect. Returns the exit status 0."""
    out = _place(config)
    hold(out)
    from taccorl.diagnosis.machines.load import load_machine
    from taccorl.report.report import numbers_of
    from taccorl.report.terminal import show

    machine = load_machine(config.twin)
    names = list(dict.fromkeys(config.effect.split(",")))
    request = Request(names, config.joints, config.pads)
    if config.values:
        new = by_hand(machine, request, config.values, "--values=")
    else:
        path = numbers_of(config.diagnosis)
        new = diagnosed(machine, request, stored(path, machine, names), path, print)
    mended = machine.with_additions(new.additions)
    for a in new.additions:
        words = Section(text=[f"  {new.reasons.get(a.part, 'by hand')}"])
        show(_changes(a.part, machine.numbers(a.part), mended.numbers(a.part)), words)
    mended.save(out)
    against = None if config.in_place else out
    show(
        Section(
            text=[
                f"wrote {out}; next: {compare_words(new.made_by, [a.part for a in new.additions], config.twin, against)}"
            ]
        )
    )
    return 0


def compare_words(
    made_by: list[str], parts: list[str], twin: Path | None, against: Path | None
) -> str:
    """Command that compares ``twin``, and ``against`` beside it, with the recordings of the diagnosis whose words ``made_by``
    are; if it was of some joints, with those of ``parts``."""
    words = made_by[2:3] or ["YOUR_RECORDINGS"]
    words += [
        w
        for w in made_by
        if w.startswith(("--spec=", "--columns=", "--validation_every=", "--accept="))
    ]
    if any(w.startswith("--joints=") for w in made_by):
        words.append(f"--joints=[{','.join(dict.fromkeys(parts))}]")
    words += [f"--twin={twin}"] * (twin is not None) + [f"--against={against}"] * (
        against is not None
    )
    return shlex.join(["taccorl", "compare", *words])


def _place(config: AddEffectConfig) -> Path:
    """Where to write, before any work is done."""
    if config.in_place:
        if config.twin is None or config.out is not None:
            raise TaccorlError(
                "--in_place=true changes the file of --twin=…; give that option, and do not give --out"
            )
        return config.twin
    source = config.twin or Path("twin.yaml")
    out = config.out or source.with_name(
        f"{source.stem}+{config.effect.replace(',', '+')}.yaml"
    )
    if out.exists():
        raise TaccorlError(f"{out}: already exists; give another --out, or remove it")
    return out


class Request(NamedTuple):
    """Effects and numbers to be added, and where."""

    names: list[str]
    joints: Sequence[str] = ()
    """Empty, as ``pads``: all parts for which the diagnosis found them."""
    pads: Sequence[str] = ()


class Change(NamedTuple):
    """Changes of a machine's file."""

    additions: "list[Addition]"
    made_by: list[str]
    """Words of the command that diagnosed; none for values by hand."""
    reasons: Mapping[str, str]
    """Part → verdict of the diagnosis, or evidence of a part of it."""


def by_hand(
    machine: "Machine", request: Request, values: Mapping[str, float], option: str
) -> Change:
    """One effect with values by hand; ``option``: begin of messages, ``--values=``.

    Raises:
        TaccorlError: several effects are asked for, or one cannot have these values.
    """
    if key := next((key for key in values if {*":="} & {*key}), ""):
        raise TaccorlError(
            f"--values: {key!r} is one word; YAML needs a colon and a space: '{{torque_nm: 0.4}}'"
        )
    if len(request.names) > 1:
        raise TaccorlError(
            f"{option}{values}: of which effect? Add one of {', '.join(request.names)} at a time"
        )
    [name] = request.names
    additions = machine.by_hand(name, request.joints, request.pads, values)
    return Change(additions, [], {})


def stored(path: Path, machine: "Machine", names: list[str]) -> dict[str, Any]:
    """Content of the report.json ``path``. Raises TaccorlError: there is none."""
    from taccorl.sim.effects import effects

    if path.is_file():
        return json.loads(path.read_text(encoding="utf-8"))
    own = effects.get(names[0]).parameters()[:1] if names[0] in effects else ()
    hand = [
        f", or give the numbers: '--values={{{number.name}: {number.typical:g}}}'"
        for number in own
    ]
    unknown = [n for n in names if n not in effects and n not in _numbers(machine)]
    if unknown:
        text = f"{unknown[0]}: no such effect; {nearest(unknown[0], effects)}"
        raise TaccorlError(f"{text}; and {path} has no diagnosis")
    raise TaccorlError(
        f"{path}: no diagnosis there; run `taccorl diagnose` first{''.join(hand)}"
    )


def diagnosed(
    machine: "Machine",
    request: Request,
    report: Mapping[str, Any],
    path: Path,
    warn: Callable[[str], None],
) -> Change:
    """Numbers of the fit with exactly these effects and numbers, part by part.

    Args:
        report: content of the diagnosis' report.json.
        path: its place, for messages.
        warn: function that gets what makes the numbers doubtful.

    Raises:
        TaccorlError: the diagnosis is of another machine, or did not fit an effect.
    """
    from taccorl.sim.effects import effects

    names = request.names
    if report.get("provenance", {}).get("twin, SHA-256") != machine.digest():
        made_with = report.get("provenance", {}).get("twin", "another twin")
        raise TaccorlError(
            f"{path}: was made with another twin ({made_with}); run `taccorl diagnose` with this one. Effects that one diagnosis "
            "found are added together: taccorl add-effect NAME,NAME"
        )
    if not report.get("finished", True):
        warn(
            f"warning: {path}: is of a diagnosis that is not finished; what was not tried may be missing instead"
        )
    diagnoses = report["diagnoses"]
    parts = machine.select(list(diagnoses), request.joints, request.pads)
    told = {
        part: {*_found(diagnoses[part]), *_changed(diagnoses[part])} for part in parts
    }
    found = {name for own in told.values() for name in own}
    for name in {*names} - found:
        if any(
            name in {*diagnoses[part]["base"], *machine.numbers(part)} for part in parts
        ):
            raise TaccorlError(
                f"{path}: {name} is not off in that diagnosis; what it found: {', '.join(sorted(found)) or 'nothing'}"
            )
        effects.get(name)
    additions, refused, left_out, written, said = [], [], [], set(), {}
    for part in parts:
        # An effect or number that the diagnosis of any joint reports is written for the joints that report it, for no others.
        wanted = {
            n
            for n in names
            if n in told[part] or (n not in found and n in _fitted(diagnoses[part]))
        }
        try:
            fit = _fit_of(wanted or {*names}, part, diagnoses[part])
        except TaccorlError as error:
            refused.append(error)
            left_out += [error] * bool(wanted & told[part])
            continue
        if fit is None:
            continue
        additions.append(_addition(machine, part, fit, warn))
        written |= {*(e["effect"] for e in fit["effects"]), *_off(diagnoses[part])}
        said[part] = (
            report["verdicts"][part]["title"]
            if fit is diagnoses[part]
            else fit["effects"][-1]["evidence"]
        )
    left = [name for name in names if name not in written]
    if refused and (request.joints or request.pads or not additions):
        raise refused[0]
    if left_out and left:
        raise left_out[0]
    for error in left_out:
        warn(f"not written: {error}")
    if left:
        tried = sorted(
            {
                e["name"]
                for d in diagnoses.values()
                for r in d["rounds"]
                for e in r["evidence"]
            }
            | found
        )
        raise TaccorlError(
            f"{path}: {left[0]} was not fitted in that diagnosis; {nearest(left[0], tried)}"
        )
    return Change(additions, shlex.split(report["provenance"].get("command", "")), said)


def _numbers(machine: "Machine") -> set[str]:
    """Names of all numbers of the machine's parts, such as kp."""
    found: set[str] = set()
    for part in machine.units:
        try:
            found |= machine.numbers(part).keys()
        except (TaccorlError, ValueError, KeyError):  # no part of its own: a gripper
            continue
    return found


def _found(diagnosis: dict[str, Any]) -> list[str]:
    """Effects that a diagnosis of one part added."""
    return [
        e["effect"]
        for e in diagnosis["effects"]
        if e["effect"] not in diagnosis["present"]
    ]


def _off(diagnosis: dict[str, Any]) -> list[str]:
    """The file's own numbers, such as kd, that a diagnosis of one part says are off; no numbers of effects, and no scale of
    efforts, which no file has."""
    from taccorl.diagnosis.search.problem import EFFORT_SCALE

    changed = [c["name"] for c in diagnosis.get("changed", ())]
    own = [name for name in changed if "." not in name and name != EFFORT_SCALE]
    return [*own, *diagnosis.get("moved", ())]


def _changed(diagnosis: dict[str, Any]) -> set[str]:
    """Names of the numbers and effects in the machine's file whose values the diagnosis of one joint found to be wrong."""
    return {
        *_off(diagnosis),
        *(
            c["name"].rpartition(".")[0]
            for c in diagnosis.get("changed", ())
            if "." in c["name"]
        ),
    }


def _fitted(diagnosis: dict[str, Any]) -> set[str]:
    """Effects of the file and of all fits of one part that can be written."""
    return {
        *diagnosis["present"],
        *(name for offer in diagnosis.get("offers", ()) for name in offer["added"]),
    }


def _fit_of(
    wanted: set[str], part: str, diagnosis: dict[str, Any]
) -> dict[str, Any] | None:
    """The fit with exactly the effects ``wanted`` beside those of the file; None if the diagnosis looked at none of them.
    Raises TaccorlError: the diagnosis refused one of them, or did not fit them together."""
    own, new = {*_found(diagnosis)}, wanted - {*diagnosis["present"], *_off(diagnosis)}
    if new == own:
        for name in wanted if not new else ():
            if name not in _changed(diagnosis):
                raise TaccorlError(
                    f"{part}: the numbers of {name} in the file explain the recordings as well as refitted ones; give "
                    "--values={…} to change them nevertheless"
                )
        return diagnosis
    if not new:
        raise TaccorlError(
            f"{part}: {', '.join(sorted(wanted))} was refitted beside {' and '.join(sorted(own))}; `taccorl add-effect "
            f"{','.join(sorted(own | wanted))}` writes them together"
        )
    for offer in diagnosis.get("offers", ()):
        if {*offer["added"]} == new:
            return offer
    rows = {e["name"]: e for r in diagnosis["rounds"] for e in r["evidence"]}
    for name in sorted(new - _fitted(diagnosis) - own):
        if name in rows:
            raise TaccorlError(
                f"{part}: the diagnosis refused {name}: {rows[name]['verdict']}; give --values={{…}} to add it nevertheless"
            )
        return None
    raise TaccorlError(
        f"{part}: the diagnosis did not fit {' and '.join(sorted(new))} together; what it found is {', '.join(sorted(own))}. "
        "Diagnose --without=[…] what you do not want"
    )


def _addition(
    machine: "Machine", part: str, fit: dict[str, Any], warn: Callable[[str], None]
) -> "Addition":
    """The change of the machine's file that a fit of one part says. ``warn`` gets which
    numbers it does not determine."""
    from taccorl.diagnosis.machines.machine import Addition

    if unknown := fit.get("undetermined"):
        warn(
            f"warning: {part}: its recordings do not determine {', '.join(unknown)}; what is written is one of many values "
            "that fit, near where they began. Other motions may need other values: record them, then diagnose again"
        )
    if ends := fit["at_bound"]:
        warn(
            f"warning: {part}: the fit ended with {', '.join(ends)} at the end of its range, so the other numbers may be "
            "wrong, too: check units, gains and time stamps, or look for more effects (--until=noise_floor)"
        )
    made = [
        machine.effect(e["effect"], part, {k: v for k, v in e.items() if k != "effect"})
        for e in fit["effects"]
    ]
    return Addition(
        part, [e for e in made if e is not None], fit["base"], fit["intervals"]
    )


def _changes(part: str, old: "Numbers", new: "Numbers") -> Section:
    """The numbers of one part that change, old and new, and those that stay."""
    from taccorl.diagnosis.comparison.cell_numbers import summarised
    from taccorl.report.fact import unit_words

    def value(number: tuple[float, str] | None) -> str:
        return "–" if number is None else f"{number[0]:.5g}"

    changed = [name for name in new if name not in old] + [
        name for name in old if old[name] != new.get(name)
    ]
    listed, families = summarised(
        {name: new[name][0] for name in changed if name in new}
    )
    rows = [
        [
            f"  {name}",
            value(old.get(name)),
            value(new.get(name)),
            unit_words((new.get(name) or old[name])[1]).strip(),
        ]
        for name in changed
        if name in {*old, *listed}
    ]
    notes = [f"  {name}: {words}" for name, words in families.items()]
    stay, families = summarised(
        {name: new[name][0] for name in new if name not in changed}
    )
    words = [
        f"{name} {number:.4g}{unit_words(new[name][1])}"
        for name, number in stay.items()
    ]
    notes += [f"  stay: {', '.join([*words, *families])}"] if words or families else []
    return Section(
        heads=(f"{part}:", "old", "new", ""),
        rows=rows,
        right=(1, 2),
        parts=[Section(text=notes)],
    )

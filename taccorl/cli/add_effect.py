"""``taccorl add-effect coulomb_friction --twin=twin.yaml --joints=left_joint5``: add one physical effect to a twin.
``taccorl add-effect taxel_creep --twin=twin.yaml --pads=left``: an effect of pads.

The values are those that the last ``taccorl diagnose`` of this twin fitted, and with them the values that were refitted
together: gains of a joint, k_n and k_d of pads. An effect that was tied with the chosen one can also be added.
``--values={torque_nm: 0.4}`` gives values by hand instead. Prints the numbers that change, old and new, and those that stay.
Writes a copy, ``twin+coulomb_friction.yaml``, which collection, generation and training load.
"""

import json
import shlex
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from taccorl.cli.parse import parse
from taccorl.errors import TaccorlError, nearest

if TYPE_CHECKING:
    from taccorl.diagnosis.machines.machine import Addition, Machine

Numbers = dict[str, tuple[float, str]]
"""Name → (value, unit) of the numbers of one part."""


@dataclass(kw_only=True)
class AddEffectConfig:
    """Add one physical effect to a twin."""

    effect: str
    """Name of the effect; docs/effects.md lists them. Several with commas between them, where one diagnosis found them at
    different joints."""
    twin: Path | None = None
    """File of the machine: a twin.yaml of the PiPER, or a file of kind axis, robot or cells. The nominal twin if not given."""
    joints: list[str] = field(default_factory=list)
    """left_joint5; joint5 or J4 (the paper's name of it) for both arms. If not given: all joints for which the diagnosis found
    the effect."""
    pads: list[str] = field(default_factory=list)
    """left, right: the pads of these arms. If not given: the pads for which the diagnosis found the effect."""
    diagnosis: Path = Path("diagnosis")
    """Folder of the diagnosis that fitted the values."""
    values: dict[str, float] = field(default_factory=dict)
    """Values by hand, such as {torque_nm: 0.4}; no diagnosis is read then."""
    out: Path | None = None
    """File to write; beside the twin, with +EFFECT in its name, if not given. An existing file is not overwritten."""
    in_place: bool = False
    """Change the twin's own file instead of writing a copy."""


def main(argv: list[str]) -> int:
    """Run ``taccorl add-effect`` with the words ``argv`` after it; returns the exit status of ``run``."""
    return run(parse(AddEffectConfig, argv, positional="effect", prog="taccorl add-effect"))


def run(config: AddEffectConfig) -> int:
    """Write the twin with the effect. Returns the exit status 0."""
    out = _place(config)
    from taccorl.diagnosis.machines.load import load_machine

    machine = load_machine(config.twin)
    by_hand = config.values
    for key in by_hand:
        if ":" in key:
            raise TaccorlError(
                f"--values: {key!r} is read as one word; YAML needs a space after the colon: '{{torque_nm: 0.4}}'"
            )
    names = config.effect.split(",")
    if by_hand and len(names) > 1:
        raise TaccorlError(f"--values={by_hand}: of which effect? Add one of {', '.join(names)} at a time")
    if by_hand:
        added = machine.by_hand(config.effect, config.joints, config.pads, by_hand)
    else:
        offers = [a for name in names for a in _diagnosed(config, machine, name, chosen=len(names) > 1)]
        # Refitted effects of the file are all written with any of them.
        added = list({(a.part, *(e.name for e in a.effects)): a for a in offers}.values())
    mended = machine.with_additions(added)
    for part in dict.fromkeys(a.part for a in added):
        _say(part, machine.numbers(part), mended.numbers(part))
        for line in dict.fromkeys(e.evidence for a in added if a.part == part for e in a.effects if e.evidence):
            print(f"  {line}")
    mended.save(out)
    print(f"wrote {out}; next: taccorl compare YOUR_RECORDINGS {shlex.quote(f'--twin={out}')}")
    return 0


def _place(config: AddEffectConfig) -> Path:
    """Where to write, before any work is done."""
    from taccorl.sim.effects import effects

    for name in config.effect.split(","):
        effects.get(name)
    if config.in_place:
        if config.twin is None or config.out is not None:
            raise TaccorlError("--in_place=true changes the file of --twin=…; give that option, and do not give --out")
        return config.twin
    source = config.twin or Path("twin.yaml")
    out = config.out or source.with_name(f"{source.stem}+{config.effect.replace(',', '+')}.yaml")
    if out.exists():
        raise TaccorlError(f"{out}: already exists; give another --out, or remove it")
    return out


def _diagnosed(config: AddEffectConfig, machine: "Machine", name: str, *, chosen: bool) -> list["Addition"]:
    """What the diagnosis of this machine says of an effect, part by part.

    Args:
        chosen: only parts at which the diagnosis added the effect.
    """
    from taccorl.diagnosis.report.report import NUMBERS

    path = config.diagnosis / NUMBERS
    if not path.is_file():
        raise TaccorlError(
            f"{path}: no diagnosis there; run `taccorl diagnose` first, or give the numbers: --values={{torque_nm: 0.4}}"
        )
    report = json.loads(path.read_text(encoding="utf-8"))
    if report.get("provenance", {}).get("twin, SHA-256") != machine.digest():
        made_with = report.get("provenance", {}).get("twin", "another twin")
        raise TaccorlError(
            f"{path}: was made with another twin ({made_with}); run `taccorl diagnose` with this one. Effects that one diagnosis "
            "found at several joints are added together: taccorl add-effect NAME,NAME"
        )
    diagnoses = report["diagnoses"]
    if chosen:
        diagnoses = {part: d for part, d in diagnoses.items() if name in [e["effect"] for e in d["effects"]]}
    wanted = config.joints or config.pads
    offers, refused = [], []
    for part in machine.select(list(diagnoses), config.joints, config.pads):
        try:
            found = _offer(machine, name, part, diagnoses[part])
        except TaccorlError as error:
            refused.append(error)
            continue
        offers += found
        if found and (unknown := diagnoses[part].get("undetermined")):
            print(
                f"warning: {part}: its recordings do not determine {', '.join(unknown)}; what is written is one of many values "
                "that fit, near where they began. Other motions may need other values: record them, then diagnose again"
            )
        ends = diagnoses[part]["at_bound"]
        if found and ends:
            print(
                f"warning: {part}: the fit ended with {', '.join(ends)} at the end of its range, so the other numbers may be "
                "wrong, too: check units, gains and time stamps, or look for more effects (--until=noise_floor)"
            )
    if refused and (wanted or not offers):
        raise refused[0]
    if not offers:
        tried = sorted({e["name"] for d in diagnoses.values() for r in d["rounds"] for e in r["evidence"]})
        raise TaccorlError(f"{path}: {name} was not fitted in that diagnosis; {nearest(name, tried)}")
    return offers


def _offer(machine: "Machine", name: str, part: str, diagnosis: dict[str, Any]) -> list["Addition"]:
    """The effect as the diagnosis would add it; of those that it did not choose, as its first round fitted it; [] if it did not.

    Raises:
        TaccorlError: the diagnosis refused it, or did not keep its numbers.
    """
    from taccorl.diagnosis.machines.machine import Addition

    kept = [e for e in diagnosis["effects"] if e["effect"] == name or e["effect"] in diagnosis["present"]]
    new = [e["effect"] for e in diagnosis["effects"] if e["effect"] not in diagnosis["present"]]
    if name in diagnosis["present"]:
        _check_changed(name, part, diagnosis, new)
    if name in [e["effect"] for e in kept] and new in ([], [name]):
        # Effects that the twin had were refitted with it.
        made = [machine.effect(e["effect"], part, {k: v for k, v in e.items() if k != "effect"}) for e in kept]
        return [Addition(part, [e for e in made if e is not None], diagnosis["base"], diagnosis["intervals"])]
    first = diagnosis["rounds"][:1]
    rows = [e for r in first for e in r["evidence"] if e["name"] == name]
    if rows and name not in (first[0]["added"], *first[0]["ties"]):
        raise TaccorlError(
            f"{part}: the diagnosis refused {name}: {rows[0]['verdict']}; give --values={{…}} to add it nevertheless"
        )
    if rows and name == "taxel_gain_map":
        others = ",".join(n for n in (first[0]["added"], *first[0]["ties"]) if n != name)
        raise TaccorlError(
            f"{part}: the diagnosis stores the map of {name} only if it added this effect; diagnose --without=[{others}]"
        )
    if not rows:
        return []
    values = {k.split(".", 1)[1]: v for k, v in rows[0]["values"].items()}
    words = f"{rows[0]['verdict']}: validation error {rows[0]['validation_error']:.2f} noise floors with it alone"
    effect = machine.effect(name, part, {**values, "evidence": words}, diagnosis["base"])
    if effect is None:
        return []
    base, refitted = rows[0]["base"], []
    for e in kept:  # effects of the twin, as they were refitted beside this one
        own = {k.removeprefix(f"{e['effect']}."): v for k, v in base.items() if k.startswith(f"{e['effect']}.")}
        left = {k: v for k, v in e.items() if k not in ("effect", "interval")}
        refitted.append(machine.effect(e["effect"], part, {**left, **own, "evidence": words}))
    return [Addition(part, [*(e for e in refitted if e is not None), effect], base, diagnosis["intervals"])]


def _check_changed(name: str, part: str, diagnosis: dict[str, Any], new: list[str]) -> None:
    """Check that the refit of ``name``, an effect of the file, can be written by itself.

    Args:
        new: effects that the diagnosis added.

    Raises:
        TaccorlError: it was refitted beside an added effect, or the file's numbers explain the recordings as well.
    """
    if new:
        way = f"taccorl add-effect {new[0]}" if len(new) == 1 else "taccorl diagnose --until=noise_floor"
        raise TaccorlError(f"{part}: {name} was refitted beside {' and '.join(new)}; `{way}` writes them together")
    if name not in [c["name"].rpartition(".")[0] for c in diagnosis.get("changed", [])]:
        raise TaccorlError(
            f"{part}: the numbers of {name} in the file explain the recordings as well as refitted ones; give --values={{…}} to "
            "change them nevertheless"
        )


def _say(part: str, old: "Numbers", new: "Numbers") -> None:
    """Print the numbers of one part that change, old and new, and those that stay."""
    from taccorl.diagnosis.comparison.cell_numbers import summarised
    from taccorl.diagnosis.report.evidence_words import unit_words

    added = [name for name in new if name not in old]
    changed = added + [name for name in old if old[name] != new.get(name)]
    listed, families = summarised({name: new[name][0] for name in changed if name in new})
    rows = [
        (name, *(_value(numbers.get(name)) for numbers in (old, new))) for name in changed if name in {*old, *listed}
    ]
    wide = [max(len(row[k]) for row in (*rows, ("", "old", "new"))) for k in range(3)]
    print(f"{part}:".ljust(wide[0] + 2), *(head.rjust(w) for head, w in zip(("old", "new"), wide[1:], strict=True)))
    for name, *values in rows:
        unit = unit_words((new.get(name) or old[name])[1])
        print(
            f"  {name:<{wide[0]}}",
            *(value.rjust(w) for value, w in zip(values, wide[1:], strict=True)),
            end=f"{unit}\n",
        )
    for name, words in families.items():
        print(f"  {name}: {words}")
    stay, families = summarised({name: new[name][0] for name in new if name not in changed})
    words = [f"{name} {value:.4g}{unit_words(new[name][1])}" for name, value in stay.items()]
    if words or families:
        print(f"  stay: {', '.join([*words, *families])}")


def _value(number: tuple[float, str] | None) -> str:
    """Five significant digits; a dash for a number that the file does not have."""
    return "–" if number is None else f"{number[0]:.5g}"

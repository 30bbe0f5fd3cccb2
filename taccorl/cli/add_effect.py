"""``taccorl add-effect coulomb_friction --twin=twin.yaml --joints=left_joint5``: the twin with one physical effect more.
``taccorl add-effect taxel_creep --twin=twin.yaml --pads=left``: of pads.

The numbers are those of the last ``taccorl diagnose`` of this twin, with those that were refitted with the effect: gains of a
joint, k_n and k_d of pads. It may also be an effect that was tied with the one that was chosen. ``--values={torque_nm: 0.4}``
gives numbers by hand instead.
Writes a copy, ``twin+coulomb_friction.yaml``, which collection, generation and training load.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from taccorl.cli.parse import parse
from taccorl.errors import TaccorlError, nearest

if TYPE_CHECKING:
    from taccorl.sim.effects.effect import Effect
    from taccorl.sim.twin import TwinConfig


@dataclass(kw_only=True)
class AddEffectConfig:
    """The twin with one physical effect more."""

    effect: str
    """Name of the effect; docs/effects.md lists them."""
    twin: Path | None = None
    """twin.yaml; the nominal twin if not given."""
    joints: list[str] = field(default_factory=list)
    """left_joint5; joint5 or J4 (the paper's name of it) for both arms. All that were diagnosed with it if not given."""
    pads: list[str] = field(default_factory=list)
    """left, right: the pads of these arms. All that were diagnosed with it if not given."""
    diagnosis: Path = Path("diagnosis")
    """Folder of the diagnosis that fitted the numbers."""
    values: dict[str, float] = field(default_factory=dict)
    """Numbers by hand, such as {torque_nm: 0.4}; no diagnosis is read then."""
    out: Path | None = None
    """File to write; beside the twin with +EFFECT in its name if not given. A file that is there is left alone."""
    in_place: bool = False
    """Change the twin's own file."""


class Entry(NamedTuple):
    """What is added to one part."""

    part: str
    """left_joint5, left pads"""
    effects: "list[Effect]"
    """The one that is added, and those of the twin that were refitted with it."""
    base: dict[str, float]
    """Numbers that were refitted with it."""
    intervals: dict[str, list[float]]


def main(argv: list[str]) -> int:
    """0: written."""
    config = parse(AddEffectConfig, argv, positional="effect", prog="taccorl add-effect")
    out = _place(config)
    from taccorl.cli.measured import twin_of
    from taccorl.diagnosis import pads
    from taccorl.diagnosis.joints import add_effect, set_numbers
    from taccorl.sim.twin_file import save_twin

    twin = twin_of(config.twin)
    entries = _by_hand(config) if config.values else _diagnosed(config, twin)
    of_pads = {e.part: (e.base, e.intervals) for e in entries if e.base and pads.pads_of(e.base)}
    shared = pads.agreed(of_pads) if of_pads else {}
    for e in entries:
        base = shared if e.part in of_pads else e.base
        if e.part in of_pads:
            pads.set_numbers(twin, base)
        elif base:
            set_numbers(twin, e.part, base, e.intervals)
        for effect in e.effects:
            add_effect(twin, effect)
            _say(e.part, effect, base)
    save_twin(twin, out)
    print(f"wrote {out}; next: taccorl compare --twin={out} --measurements=YOUR_SWEEPS")
    return 0


def _place(config: AddEffectConfig) -> Path:
    """Where to write, before any work is done."""
    from taccorl.sim.effects import effects

    effects.get(config.effect)
    if config.in_place:
        if config.twin is None or config.out is not None:
            raise TaccorlError("--in_place=true changes the file of --twin=…; give that, and no --out")
        return config.twin
    source = config.twin or Path("twin.yaml")
    out = config.out or source.with_name(f"{source.stem}+{config.effect}.yaml")
    if out.exists():
        raise TaccorlError(f"{out}: is there already; give another --out, or remove it")
    return out


def _by_hand(config: AddEffectConfig) -> list[Entry]:
    from taccorl.cli.diagnose import joints_named
    from taccorl.diagnosis.joint_problem import selectors
    from taccorl.diagnosis.joints import SIGNALS
    from taccorl.robots import ROBOT
    from taccorl.sim.effects import effects, make_effect

    found = []
    kind = effects.get(config.effect)
    if all(selectors(kind, signal) is None for signal in SIGNALS):
        if config.joints:
            raise TaccorlError(f"{config.effect} is no effect of joints; leave --joints out")
        where = {"pads": [f"{arm}_{finger}" for arm in _arms(config.pads, ROBOT.arms) for finger in ROBOT.fingers]}
        part = " and ".join(config.pads or ["all"]) + " pads"
        return [Entry(part, [make_effect(config.effect, **where, **config.values, evidence="by hand")], {}, {})]
    if config.pads:
        raise TaccorlError(f"{config.effect} is an effect of joints; leave --pads out")
    if not config.joints:
        raise TaccorlError(f"{config.effect}: which joints? --joints=left_joint5, or joint5 for both arms")
    for signal in joints_named(config.joints, SIGNALS):
        chosen = selectors(kind, signal)
        if chosen is None:
            raise TaccorlError(f"{config.effect} cannot act on {signal}")
        made = make_effect(config.effect, **chosen, **config.values, evidence="by hand")
        found.append(Entry(signal, [made], {}, {}))
    return found


def _arms(names: Sequence[str], known: Sequence[str]) -> list[str]:
    for name in names:
        if name not in known:
            raise TaccorlError(f"--pads={name}: no pads of that arm here; {nearest(name, known)}")
    return [arm for arm in known if not names or arm in names]


def _diagnosed(config: AddEffectConfig, twin: "TwinConfig") -> list[Entry]:
    """What the diagnosis of this twin says, part by part."""
    from taccorl.cli.diagnose import joints_named
    from taccorl.diagnosis.report import NUMBERS
    from taccorl.sim.twin_file import twin_digest

    path = config.diagnosis / NUMBERS
    if not path.is_file():
        raise TaccorlError(
            f"{path}: no diagnosis there; run `taccorl diagnose` first, or give the numbers: --values={{torque_nm: 0.4}}"
        )
    report = json.loads(path.read_text(encoding="utf-8"))
    if report.get("provenance", {}).get("twin, SHA-256") != twin_digest(twin):
        made_with = report.get("provenance", {}).get("twin", "another twin")
        raise TaccorlError(f"{path}: was made with another twin ({made_with}); run `taccorl diagnose` with this one")
    diagnoses = report["diagnoses"]
    joints = [part for part in diagnoses if "_joint" in part]
    arms = [part.removesuffix(" pads") for part in diagnoses if part not in joints]
    wanted = list(joints_named(config.joints, joints)) if config.joints else []
    wanted += [f"{arm} pads" for arm in _arms(config.pads, arms)] if config.pads else []
    offers, refused = [], []
    for part in wanted or diagnoses:
        try:
            offers += _offer(config.effect, part, diagnoses[part])
        except TaccorlError as error:
            refused.append(error)
    if refused and (wanted or not offers):
        raise refused[0]
    if not offers:
        tried = sorted({e["name"] for d in diagnoses.values() for r in d["rounds"] for e in r["evidence"]})
        raise TaccorlError(f"{path}: {config.effect} was not fitted there; {nearest(config.effect, tried)}")
    return offers


def _offer(name: str, part: str, diagnosis: dict[str, Any]) -> list[Entry]:
    """The effect as the diagnosis would add it; of those that it did not choose, as its first round fitted it; [] if it did not.

    Raises:
        TaccorlError: the diagnosis refused it, or did not keep its numbers.
    """
    from taccorl.diagnosis.joint_problem import selectors
    from taccorl.diagnosis.pads import pads_of
    from taccorl.sim.effects import effects, make_effect

    kept = [e for e in diagnosis["effects"] if e["effect"] == name or e["effect"] in diagnosis["present"]]
    if name in [e["effect"] for e in kept] and len(diagnosis["effects"]) - len(diagnosis["present"]) == 1:
        # Effects that the twin had were refitted with it.
        made = [make_effect(e["effect"], **{k: v for k, v in e.items() if k != "effect"}) for e in kept]
        return [Entry(part, made, diagnosis["base"], diagnosis["intervals"])]
    first = diagnosis["rounds"][:1]
    rows = [e for r in first for e in r["evidence"] if e["name"] == name]
    if rows and name not in (first[0]["added"], *first[0]["ties"]):
        raise TaccorlError(
            f"{part}: the diagnosis refused {name}: {rows[0]['verdict']}; give --values={{…}} to add it all the same"
        )
    if rows and name == "taxel_gain_map":
        others = ",".join(n for n in (first[0]["added"], *first[0]["ties"]) if n != name)
        raise TaccorlError(
            f"{part}: the map of {name} is kept only where it is what was added; diagnose --without=[{others}]"
        )
    chosen = selectors(effects.get(name), part) if "_joint" in part else {"pads": pads_of(diagnosis["base"])}
    if not rows or chosen is None:
        return []
    values = {k.split(".", 1)[1]: v for k, v in rows[0]["values"].items()}
    words = f"{rows[0]['verdict']}: validation error {rows[0]['validation_error']:.2f} noise floors with it alone"
    effect = make_effect(name, **chosen, **values, evidence=words)
    return [Entry(part, [effect], rows[0]["base"], diagnosis["intervals"])]


def _say(part: str, effect: "Effect", base: dict[str, float]) -> None:
    from taccorl.diagnosis.evidence_words import unit_words

    numbers = [f"{p.name} {getattr(effect, p.name):.4g}{unit_words(p.unit)}" for p in effect.parameters()]
    print(f"{part}: {effect.name} {', '.join(numbers)}")
    if base:
        print(f"  with {', '.join(f'{k} {v:.4g}' for k, v in base.items())}")
    if effect.evidence:
        print(f"  {effect.evidence}")

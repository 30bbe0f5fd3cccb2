"""``taccorl add-effect coulomb_friction --twin=twin.yaml --joints=left_joint5``: the twin with one physical effect more.

The numbers are those of the last ``taccorl diagnose`` of this twin, controller gains that were refitted with the effect included;
it may also be an effect that was tied with the one that was chosen. ``--values={torque_nm: 0.4}`` gives them by hand instead.
Writes a copy, ``twin+coulomb_friction.yaml``, which collection, generation and training load.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

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
    diagnosis: Path = Path("diagnosis")
    """Folder of the diagnosis that fitted the numbers."""
    values: dict[str, float] = field(default_factory=dict)
    """Numbers by hand, such as {torque_nm: 0.4}; no diagnosis is read then."""
    out: Path | None = None
    """File to write; beside the twin with +EFFECT in its name if not given. A file that is there is left alone."""
    in_place: bool = False
    """Change the twin's own file."""


def main(argv: list[str]) -> int:
    """0: written."""
    config = parse(AddEffectConfig, argv, positional="effect", prog="taccorl add-effect")
    out = _place(config)
    from taccorl.cli.measured import twin_of
    from taccorl.diagnosis.joints import add_effect, set_numbers
    from taccorl.sim.twin_file import save_twin

    twin = twin_of(config.twin)
    entries = _by_hand(config) if config.values else _diagnosed(config, twin)
    for signal, effect, base in entries:
        if base:
            set_numbers(twin, signal, base)
        add_effect(twin, effect)
        _say(signal, effect, base)
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


def _by_hand(config: AddEffectConfig) -> "list[tuple[str, Effect, dict[str, float]]]":
    from taccorl.cli.diagnose import joints_named
    from taccorl.diagnosis.joint_problem import selectors
    from taccorl.diagnosis.joints import SIGNALS
    from taccorl.sim.effects import effects, make_effect

    found = []
    kind = effects.get(config.effect)
    if all(selectors(kind, signal) is None for signal in SIGNALS):
        if config.joints:
            raise TaccorlError(f"{config.effect} is no effect of joints; leave --joints out")
        return [("all pads", make_effect(config.effect, **config.values, evidence="by hand"), {})]
    if not config.joints:
        raise TaccorlError(f"{config.effect}: which joints? --joints=left_joint5, or joint5 for both arms")
    for signal in joints_named(config.joints, SIGNALS):
        chosen = selectors(kind, signal)
        if chosen is None:
            raise TaccorlError(f"{config.effect} cannot act on {signal}")
        found.append((signal, make_effect(config.effect, **chosen, **config.values, evidence="by hand"), {}))
    return found


def _diagnosed(config: AddEffectConfig, twin: "TwinConfig") -> "list[tuple[str, Effect, dict[str, float]]]":
    """(part, effect, numbers refitted with it) of the diagnosis of this twin."""
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
    offers = {part: offer for part, d in report["diagnoses"].items() if (offer := _offer(config.effect, part, d))}
    if not offers:
        tried = sorted({e["name"] for d in report["diagnoses"].values() for r in d["rounds"] for e in r["evidence"]})
        raise TaccorlError(f"{path}: {config.effect} was not fitted there; {nearest(config.effect, tried)}")
    parts = joints_named(config.joints, tuple(offers)) if config.joints else tuple(offers)
    return [(part, *offers[part]) for part in parts]


def _offer(name: str, part: str, diagnosis: dict[str, Any]) -> "tuple[Effect, dict[str, float]] | None":
    """The effect as the diagnosis would add it; of those that it did not choose, as its first round fitted it."""
    from taccorl.diagnosis.joint_problem import selectors
    from taccorl.sim.effects import effects, make_effect

    for entry in diagnosis["effects"]:
        if entry["effect"] == name and len(diagnosis["effects"]) - len(diagnosis["present"]) == 1:
            return make_effect(
                **{"name": entry["effect"]} | {k: v for k, v in entry.items() if k != "effect"}
            ), diagnosis["base"]
    first = diagnosis["rounds"][:1]
    rows = [e for r in first for e in r["evidence"] if e["name"] == name]
    if rows and name not in (first[0]["added"], *first[0]["ties"]):
        raise TaccorlError(
            f"{part}: the diagnosis refused {name}: {rows[0]['verdict']}; give --values={{…}} to add it all the same"
        )
    chosen = selectors(effects.get(name), part) if "_joint" in part else {}
    if not rows or chosen is None:
        return None
    values = {k.split(".", 1)[1]: v for k, v in rows[0]["values"].items()}
    words = f"{rows[0]['verdict']}: held-out error {rows[0]['held_out_error']:.2f} noise floors with it alone"
    return make_effect(name, **chosen, **values, evidence=words), rows[0]["base"]


def _say(part: str, effect: "Effect", base: dict[str, float]) -> None:
    numbers: Sequence[str] = [f"{p.name} {getattr(effect, p.name):.4g} {p.unit}" for p in effect.parameters()]
    print(f"{part}: {effect.name} {', '.join(numbers)}")
    if base:
        print(f"  with {', '.join(f'{k} {v:.4g}' for k, v in base.items())}")
    if effect.evidence:
        print(f"  {effect.evidence}")

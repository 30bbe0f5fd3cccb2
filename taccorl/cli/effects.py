"""taccorl effects [NAME] [--for=joint|pads|camera|cells]
taccorl effects new NAME [--out=NAME.py] [--for=joint|cells]

List the physical effects that a model may lack: equation, unit of each parameter, knowledge that a model needs to compute it,
recording that shows it, and effects that look similar. With NAME: the whole description of one.

new    write a working example of an effect of your own, with its test: an effect of joints, or of
       pads and cells
"""

import keyword
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from taccorl.cli.parse import parse
from taccorl.errors import TaccorlError
from taccorl.lineage.destinations import write_new


@dataclass(kw_only=True)
class EffectsConfig:
    """List the physical effects, or describe one."""

    name: str = ""
    """Name of one effect; all effects if not given."""
    for_: str = ""
    """List only effects that act on joint, pads, camera, cells or scene; all if not given."""


@dataclass(kw_only=True)
class NewEffectConfig:
    """Write an example of an effect of your own."""

    name: str
    """Name of the effect in twin.yaml: small letters, digits and underscores."""
    out: Path | None = None
    """File to write; NAME.py if not given. An existing file is not overwritten."""
    for_: Literal["joint", "cells"] = "joint"
    """``joint``: a torque at a driven joint. ``cells``: a reading of a sensor of cells, or of pads."""


def main(argv: list[str]) -> int:
    """Run ``taccorl effects`` with the words ``argv`` after it; returns the exit status 0: listed, or written."""
    if argv[:1] == ["new"]:
        return _new(argv[1:])
    config = parse(EffectsConfig, argv, positional="name")
    from taccorl.sim.effects import effects
    from taccorl.sim.effects.catalogue import brief, full, names_for

    if config.name:
        cls = effects.get(config.name)
        if config.for_ and config.name not in names_for(config.for_):
            raise TaccorlError(f"{config.name} acts on {', '.join(cls.kinds())}, not on {config.for_}; leave --for out")
        print("\n".join(full(cls)))
        return 0
    print("\n\n".join("\n".join(brief(effects.get(name))) for name in names_for(config.for_)))
    return 0


def _new(argv: list[str]) -> int:
    config = parse(NewEffectConfig, argv, positional="name", prog="taccorl effects new")
    from taccorl.sim.effects import effects
    from taccorl.sim.effects.example import example

    if not config.name.isidentifier() or config.name != config.name.lower() or keyword.iskeyword(config.name):
        valid = "use small letters, digits and underscores, such as my_effect"
        raise TaccorlError(f"{config.name!r} is not a valid name of an effect; {valid}")
    if config.name in effects:
        text = f"the effect {config.name} exists already ({effects.get(config.name).__module__}); choose another name"
        raise TaccorlError(text)
    out = config.out or Path(f"{config.name}.py")
    if not out.stem.isidentifier() or out.suffix != ".py":
        raise TaccorlError(f"--out={out}: must be a Python module, such as {config.name}.py")
    try:
        write_new(out, example(config.name, out.stem, config.for_))
    except FileExistsError:
        raise TaccorlError(f"{out}: already exists; give another --out, or remove it") from None
    print(f"wrote {out}; its test: python -m pytest {out}")
    print("to use it, publish the module in your package's pyproject.toml and install the package:")
    print(f'  [project.entry-points."taccorl.plugins"]\n  {config.name} = "{out.stem}"')
    return 0

"""taccorl effects [NAME] [--for=joint|pads|camera|cells]
taccorl effects new NAME [--out=NAME.py] [--for=joint|cells]

The physical effects that a model may lack: equation, unit of each parameter, what a model must know to compute it, which
recording shows it, and which other effects look alike. With NAME: all that is known of one.

new    a working example of an effect of one's own, with its test: an effect of joints, or of pads and cells
"""

import keyword
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from taccorl.cli.parse import parse
from taccorl.errors import TaccorlError


@dataclass(kw_only=True)
class EffectsConfig:
    """taccorl effects"""

    name: str = ""
    """One effect; all of them if not given."""
    for_: str = ""
    """Only effects that act on joint, pads, camera, cells or scene; all if not given."""


@dataclass(kw_only=True)
class NewEffectConfig:
    """taccorl effects new"""

    name: str
    """Name of the effect in twin.yaml: small letters, digits and underscores."""
    out: Path | None = None
    """File to write; NAME.py if not given. A file that is there is left alone."""
    for_: Literal["joint", "cells"] = "joint"
    """``joint``: a torque at any driven joint. ``cells``: a reading of any sensor of cells, and of pads."""


def main(argv: list[str]) -> int:
    """0: listed, or written."""
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
        raise TaccorlError(
            f"{config.name!r} is no name of an effect; use small letters, digits and underscores, such as my_effect"
        )
    if config.name in effects:
        raise TaccorlError(
            f"there is an effect {config.name} already ({effects.get(config.name).__module__}); take another name"
        )
    out = config.out or Path(f"{config.name}.py")
    if not out.stem.isidentifier() or out.suffix != ".py":
        raise TaccorlError(f"--out={out}: must be a Python module, such as {config.name}.py")
    try:
        with out.open("x", encoding="utf-8") as file:  # never over a file that is there
            file.write(example(config.name, out.stem, config.for_))
    except FileExistsError:
        raise TaccorlError(f"{out}: is there already; give another --out, or remove it") from None
    print(f"wrote {out}; its test: python -m pytest {out}")
    print("to use it, publish the module in your package's pyproject.toml and install the package:")
    print(f'  [project.entry-points."taccorl.plugins"]\n  {config.name} = "{out.stem}"')
    return 0

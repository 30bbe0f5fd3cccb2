"""taccorl effects [NAME] [--for=joint|pads|camera|cells]
taccorl effects new NAME [--out=NAME] [--for=joint|cells]

List the physical effects that a model may lack: equation, unit of each parameter, knowledge that a model needs to compute it,
recording that shows it, and effects that look similar. With NAME: the whole description of one.

new    write a working effect of your own: a package of one module with its test, an effect of
       joints, or of pads and cells. Once it is installed, compare and diagnose know the effect
"""

import keyword
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from taccorl.cli.parse import parse
from taccorl.errors import TaccorlError
from taccorl.lineage.destinations import write_new

if TYPE_CHECKING:
    from taccorl.plugins import Registry


@dataclass(kw_only=True)
class EffectsConfig:
    """List the physical effects, or describe one."""

    name: str = ""
    """Name of one effect; all effects if not given."""
    for_: str = ""
    """List only effects that act on joint, pads, camera, cells or scene; all if not given."""


@dataclass(kw_only=True)
class NewConfig:
    """Write an example of an effect or a task of your own."""

    name: str
    """Name of the effect or task: small letters, digits and underscores."""
    out: Path | None = None
    """Folder of the package; NAME if not given. Nothing is overwritten."""


@dataclass(kw_only=True)
class NewEffectConfig(NewConfig):
    """Write an example of an effect of your own."""

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
            raise TaccorlError(
                f"{config.name} acts on {', '.join(cls.kinds())}, not on {config.for_}; leave --for out"
            )
        print("\n".join(full(cls)))
        return 0
    print(
        "\n\n".join(
            "\n".join(brief(effects.get(name))) for name in names_for(config.for_)
        )
    )
    return 0


def _new(argv: list[str]) -> int:
    config = parse(NewEffectConfig, argv, positional="name", prog="taccorl effects new")
    from taccorl.sim import effects

    check_new("effect", config.name, effects.effects)
    texts = Path(effects.__file__).with_name("example")
    package = write_package(config, "my_effect", [texts, texts / config.for_])
    out = package.parent
    print(f"wrote {package / '__init__.py'}: change the law there")
    print(f"its test: python -m pytest {package}")
    print(
        f"next: python -m pip install --editable {out}; taccorl effects {config.name}"
    )
    return 0


def write_package(config: NewConfig, example: str, folders: list[Path]) -> Path:
    """Write the package of an example: each ``FILE.txt`` of ``folders`` as FILE, with the
    name of ``config`` in place of ``example``. Returns the folder of the package, beside
    which its pyproject.toml is. Raises TaccorlError: one of the two is there already."""
    out = config.out or Path(config.name)
    package = out / config.name
    for path in (package, out / "pyproject.toml"):
        if path.exists():
            raise TaccorlError(
                f"{path}: is there already; nothing was changed: give another --out, or "
                "remove it"
            )
    try:
        package.mkdir(parents=True)
    except OSError as error:
        raise TaccorlError(
            f"{package}: cannot be made: {error.strerror}; give another --out"
        ) from error
    words = {example: config.name, _camel(example): _camel(config.name)}
    for path in sorted(path for folder in folders for path in folder.glob("*.txt")):
        text, name = path.read_text(encoding="utf-8"), path.stem
        for old, new in words.items():
            text, name = text.replace(old, new), name.replace(old, new)
        write_new((out if name == "pyproject.toml" else package) / name, text)
    return package


def _camel(name: str) -> str:
    return name.title().replace("_", "")


def check_new(kind: str, name: str, known: "Registry[Any]") -> None:
    """Raises TaccorlError: ``name`` cannot be that of a plug-in of this ``kind``, or ``known`` has it already."""
    if not name.isidentifier() or name != name.lower() or keyword.iskeyword(name):
        valid = f"use small letters, digits and underscores, such as my_{kind}"
        raise TaccorlError(
            f"{name!r} is not a valid name of a{'n' * (kind == 'effect')} {kind}; {valid}"
        )
    if name in known:
        raise TaccorlError(
            f"the {kind} {name} exists already ({known.get(name).__module__}); choose another name"
        )

"""Config dataclass from a command line, in the syntax of lerobot-train (draccus): ``--a.b=c``, ``--config_path=file.yaml``.

Bare words fill one named field: ``taccorl view episode.mcap`` is ``taccorl view --path=episode.mcap``.
"""

import dataclasses
import json
import sys
import typing
from collections.abc import Sequence

from taccorl.errors import TaccorlError, nearest


def parse[ConfigT](config_class: type[ConfigT], argv: Sequence[str], *, positional: str | None = None) -> ConfigT:
    """``argv`` as ``config_class``.

    Args:
        positional: field that bare words fill; a list field takes all of them.

    Raises:
        TaccorlError: unknown option, value of the wrong type, missing or surplus word.
    """
    words = [a for a in argv if not a.startswith("-")]
    options = [a for a in argv if a.startswith("-")]
    fields = {f.name: f for f in dataclasses.fields(config_class)}  # pyright: ignore[reportArgumentType]
    for option in options:
        name = option.lstrip("-").partition("=")[0].split(".")[0]
        if name not in fields and name not in ("config_path", "help", "h"):
            raise TaccorlError(f"unknown option {option!r}; {nearest(name, fields)}")
        if name in fields and "=" not in option:
            raise TaccorlError(f"option {option!r} needs a value: {option}=…")
    if words:
        if positional is None:
            raise TaccorlError(f"did not expect {words[0]!r}; options: {', '.join(f'--{n}=' for n in fields)}")
        hint = typing.get_type_hints(config_class)[positional]
        if typing.get_origin(hint) is list:
            options.append(f"--{positional}={json.dumps(words)}")
        elif len(words) == 1:
            options.append(f"--{positional}={words[0]}")
        else:
            raise TaccorlError(f"one {positional} at a time, found {' '.join(words)}")
    given = {o.lstrip("-").partition("=")[0] for o in options}
    required = [
        n
        for n, f in fields.items()
        if f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING and n not in given
    ]
    if required and not given & {"config_path", "help", "h"}:
        raise TaccorlError(f"missing {', '.join(f'--{n}=' for n in required)}; --help says more")
    import draccus
    from draccus.utils import DecodingError

    try:
        return draccus.parse(config_class, args=options)
    except DecodingError as error:
        raise TaccorlError(" ".join(str(error).split())) from error
    except SystemExit as stop:
        if stop.code in (0, None):
            sys.stdout.flush()
        raise

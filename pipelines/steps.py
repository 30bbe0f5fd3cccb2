"""One step of a pipeline: a verb's function with its configuration, or a command of LeRobot's; shown as a user would type it."""

import shlex
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from taccorl.cli.parse import command
from taccorl.errors import TaccorlError

POSITIONAL = ("paths", "path", "measurements", "effect")
"""Fields that a user types without an option name, in every verb that has them."""


def step[ConfigT](
    verb: Callable[[ConfigT], int], config: ConfigT, accepted: Sequence[int] = (0,)
) -> None:
    """Run a verb of ``taccorl``: ``run`` of a module of ``taccorl.cli``, or another function of one, such as ``lineage.explain``.
    Raises SystemExit: an error, or an exit status that is not ``accepted``."""
    name = verb.__module__.rpartition(".")[2].replace("_", "-") + (
        "" if verb.__name__ == "run" else f" {verb.__name__}"
    )
    print(
        f"\n$ {shlex.join(command(name, config, next((n for n in POSITIONAL if hasattr(config, n)), None)))}",
        flush=True,
    )
    try:
        code = verb(config)
    except TaccorlError as error:
        raise SystemExit(f"taccorl {name}: {error}") from error
    if code not in accepted:
        raise SystemExit(f"taccorl {name} ended with {code}")


def lerobot(words: Sequence[str]) -> None:
    """Run a command of LeRobot's in a process of its own; nothing without words. Raises SystemExit: it did not end with 0."""
    if not words:
        return
    print(f"\n$ {shlex.join(words)}", flush=True)
    if code := subprocess.run(
        [str(Path(sys.executable).parent / words[0]), *words[1:]]
    ).returncode:
        raise SystemExit(f"{words[0]} ended with {code}")


def chosen(words: Sequence[str], small: Sequence[str]) -> list[str]:
    """Words of a pipeline's command line, with those that ``--small`` stands for where the user says nothing else."""
    names = {word.partition("=")[0] for word in words}
    meant = [
        word
        for word in small
        if "--small" in words and word.partition("=")[0] not in names
    ]
    return [*meant, *(word for word in words if word != "--small")]


def parsed[ConfigT](
    config_class: type[ConfigT], words: Sequence[str], prog: str
) -> ConfigT:
    """Configuration of a pipeline. Raises SystemExit: with the error of ``parse``."""
    from taccorl.cli.parse import parse

    try:
        return parse(config_class, words, prog=prog)
    except TaccorlError as error:
        raise SystemExit(str(error)) from None

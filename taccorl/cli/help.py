"""Help of one verb: its description and the options that a user of the documents needs, or all options (``--help=all``)."""

import argparse
import ast
import dataclasses
import inspect
import itertools
import re
import sys
import textwrap
import typing

WIDTH = 100
"""Most columns of the short help."""
SHOWN = {
    "collect": "task episodes out source.type as_recording twin difficulty seed pictures resolution part_poses engine.workers",
    "augment": "source task episodes out pictures resolution part_poses engine.workers",
    "task new": "",
    "correct": "policy.path task episodes out takeover per_episode before_grasp seed engine.workers",
    "evaluate": "policy.path policy.type task episodes seed against twin robot pictures hide out",
    "post-train": "policy.path env.task env.twin anchor.dataset anchor.weight iterations resume rerun out",
    "init-robot": "out dataset servo law gains gravity_compensation",
    "compare": "twin against joints columns out rerun",
    "align": "twin joints pads cameras fit_kp out",
    "diagnose": "twin joints pads until columns out",
    "add-effect": "twin joints pads values out",
    "effects": "for",
    "effects new": "for out",
    "excite": "twin pads effects measurements out",
    "surrogate": "secret effects signal strength pads twin reveal out",
    "serve-surrogate": "task secret faults port",
    "ingest": "spec out dry_run domain replace",
    "ingest inspect": "draft",
    "check": "spec quick lerobot repair",
    "merge": "real sim pictures resolution out",
    "view": "episode spec against align serve save screenshot sheet",
    "lineage explain": "store",
    "lineage prune": "store keep yes",
}
"""Verb → options that its short help shows, in this order; required ones are always shown."""


def print_help(
    config_class: type, positional: str | None, prog: str | None, everything: bool
) -> None:
    """Print the docstring of the verb's module and its options, each with the docstring of its field. ``{tasks}`` there is
    replaced by the names of all tasks that have parts. Arguments as for ``parse``; ``everything``: all options."""
    from draccus.argparsing import ArgumentParser

    module = sys.modules[config_class.__module__]
    nothing, fields = dataclasses.MISSING, dataclasses.fields(config_class)  # pyright: ignore[reportArgumentType]
    required = [
        f.name for f in fields if f.default is nothing and f.default_factory is nothing
    ]
    words = []
    if positional is not None:
        several = (
            typing.get_origin(typing.get_type_hints(config_class)[positional]) is list
        )
        word = positional.upper() + " …" * several
        words = [word if positional in required else f"[{word}]"]
    words += [f"--{name}=…" for name in required if name != positional]
    prog = prog or f"taccorl {module.__name__.rpartition('.')[2]}".replace("_", "-")
    usage, said = (
        " ".join([prog, *words, "[options]"]),
        (module.__doc__ or "").strip().replace("``", ""),
    )
    parser = ArgumentParser(config_class, usage=usage, description=said).parser
    for action in parser._actions:
        if (
            action.dest.endswith(".type") and action.choices
        ):  # draccus: "Which type of Source to use"
            action.help = _docstring(config_class, action.dest.removesuffix(".type"))
        elif not (
            action.help or ""
        ).strip():  # draccus overlooks the docstring of a field with choices
            action.help = _docstring(config_class, action.dest) or action.help
        if "{tasks}" in (
            action.help or ""
        ):  # imported for the few verbs that have it: it takes a second
            from taccorl.sim.task import tasks

            named = ", ".join(name for name in tasks if tasks.get(name).parts)
            action.help = (action.help or "").replace("{tasks}", named)
        action.option_strings = [name.rstrip("_") for name in action.option_strings]
        if action.dest in required:
            action.help = f"{action.help} (required)"
        if action.dest in required or action.default is None:
            action.default = argparse.SUPPRESS  # it would read (default: None)
    if everything:
        parser.print_help()
    else:
        known = {
            name.removeprefix("--"): a
            for a in reversed(parser._actions)
            for name in a.option_strings
        }
        shown = SHOWN.get(prog.removeprefix("taccorl "), " ".join(known)).split()
        shown = [*(name for name in required if name not in shown), *shown]
        table = (
            _line(name, known[name], name == positional)
            for name in shown
            if name in known
        )
        print("\n".join([f"usage: {usage}", "", _wrapped(said), "", *table]))
        print(f"\nall {len(known.keys() - {'help', '-h'})} options: {prog} --help=all")
    sys.stdout.flush()


def _line(name: str, action: argparse.Action, is_word: bool) -> str:
    """An option with the first sentence about it (all of them if it is a choice), and its default."""
    whole = (action.help or "").replace("``", "")
    text = (whole if action.choices else re.split(r"(?<=\.)\s", whole)[0]).rstrip(".")
    if action.default not in (argparse.SUPPRESS, None, "", False) and action.default:
        text += f" (default: {action.default})"
    begin = f"  {name.upper()} " if is_word else f"  --{name} "
    return textwrap.fill(
        text, WIDTH, initial_indent=begin.ljust(20), subsequent_indent=" " * 20
    )


def _wrapped(text: str) -> str:
    """``text`` with paragraphs of at most ``WIDTH`` columns; those that fit already stay as they are."""
    done = []
    for paragraph in text.split("\n\n"):
        lines = re.sub(
            r"\n(?!taccorl )" if paragraph.startswith("taccorl ") else r"\n",
            " ",
            paragraph,
        ).splitlines()
        fits = max(map(len, paragraph.splitlines())) <= WIDTH
        done += (
            [paragraph]
            if fits
            else [
                "\n".join(
                    textwrap.fill(line, WIDTH, break_on_hyphens=False) for line in lines
                )
            ]
        )
    return "\n\n".join(done)


def _docstring(config_class: type, field: str) -> str:
    """Docstring below a field as one line, empty without one. ``pressed.shape``: field ``shape`` of the field ``pressed``."""
    outer, _, inner = field.partition(".")
    if inner:
        kind = typing.get_type_hints(config_class).get(outer)
        return (
            _docstring(kind, inner)
            if isinstance(kind, type) and dataclasses.is_dataclass(kind)
            else ""
        )
    for cls in [
        cls for cls in config_class.__mro__ if "__dataclass_fields__" in vars(cls)
    ]:
        (node,) = ast.parse(textwrap.dedent(inspect.getsource(cls))).body
        for one, below in itertools.pairwise(
            node.body if isinstance(node, ast.ClassDef) else []
        ):
            if (
                isinstance(one, ast.AnnAssign)
                and ast.unparse(one.target) == field
                and isinstance(below, ast.Expr)
            ):
                return " ".join(str(ast.literal_eval(below.value)).split())
    return ""

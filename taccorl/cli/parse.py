"""Make a configuration dataclass from a command line, in the syntax of lerobot-train (draccus): ``--a.b=c`` or ``--a.b c``,
``--config_path=file.yaml``.

Bare words fill one named field: ``taccorl view episode.mcap`` is ``taccorl view --path=episode.mcap``.
"""

import argparse
import dataclasses
import json
import re
import sys
import types
import typing
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from taccorl.cli.output_lock import hold
from taccorl.errors import TaccorlError, nearest

LONGEST_VALUE = 4000
"""Longest value of an option [characters]. Python refuses to read whole numbers of more than 4300 digits."""
DEEPEST_VALUE = 100
"""Most opening brackets in a value. PyYAML fails somewhere between 200 and 1000 levels of nesting."""
HELP = ("-h", "--help", "--help=all")
"""Options that print the help: the most used options, or all."""
_BOOLEANS = ("true", "false", "yes", "no", "on", "off")  # YAML's
_NEGATIVE = re.compile(r"-\.?\d.*")
_FORMS = {
    "int": "a whole number",
    "float": "a number",
    "dict": "names and numbers, '{name: 0.4}'",
}
_WRONG = re.compile(  # draccus' words
    r"`([\w.]+)`: (?:.*?Couldn't parse '(.*?)' into an? (int|float)\b|.*?value='(.*?)' .*? of type (dict|list|tuple)\b)"
)


def parse[ConfigT](
    config_class: type[ConfigT],
    argv: Sequence[str],
    *,
    positional: str | None = None,
    prog: str | None = None,
) -> ConfigT:
    """Parse ``argv`` into a ``config_class``. Paths and texts are taken as typed; other values are YAML, as in LeRobot. The
    place that ``--out`` names is locked until the command ends (``output_lock``). ``positional``: name of the field that words
    without an option name fill; a list field takes all of them. ``prog``: words of the command line before ``argv``, for the
    help; ``taccorl`` and the name of the config's module if not given. Raises TaccorlError: an option is unknown, a value has
    the wrong type, or a word is missing or superfluous."""
    argv = joined(argv)
    words = [a for a in argv if not a.startswith("-")]
    hints = typing.get_type_hints(config_class)
    options = [_as_field(a, hints) for a in argv if a.startswith("-")]
    if any(option in HELP for option in options):
        from taccorl.cli.help import print_help

        print_help(config_class, positional, prog, everything="--help=all" in options)
        sys.exit(0)
    for option in options:
        _check_option(option, hints)
    if words:
        if positional is None:
            raise TaccorlError(
                f"did not expect {words[0]!r}; options: {', '.join(f'--{n}=' for n in hints)}"
            )
        if any(o.startswith(f"--{positional}=") for o in options):
            text = f"{words[0]!r} and --{positional}=…: give {positional} either with or without the option's name"
            raise TaccorlError(text)
        if not all(words):
            raise TaccorlError(
                f"{positional} is empty: a shell variable that is not set?"
            )
        if len(words) > 1 and _text_kind(hints[positional]) != "list":
            raise TaccorlError(
                f"only one {positional} can be given, found {' '.join(words)}"
            )
        options += [f"--{positional}={word}" for word in words]
    texts, rest = _take_texts(options, hints)
    given = {o.lstrip("-").partition("=")[0] for o in options}
    fields = {f.name: f for f in dataclasses.fields(config_class)}  # pyright: ignore[reportArgumentType]
    missing = [n for n in _required(config_class) if n not in given]
    if missing and "config_path" not in given:
        place = (
            " (give a file or folder)"
            if positional and Path in _kinds(hints[positional])
            else ""
        )
        named = [f"--{n}={place if n == positional else ''}" for n in missing]
        raise TaccorlError(f"missing {', '.join(named)}; --help says more")
    rest += _implied_types(rest, fields)
    # YAML would read a path 2024-01-01 as a date, and cut "run #3" at the number sign.
    rest += [
        f"--{name}={json.dumps(['x'] if isinstance(value, list) else 'x')}"
        for name, value in texts.items()
    ]
    config = dataclasses.replace(_draccus(config_class, rest), **texts)  # pyright: ignore[reportArgumentType]
    if isinstance(out := getattr(config, "out", None), Path):
        hold(out)
    return config


def verb[ConfigT](
    config_class: type[ConfigT],
    *,
    positional: str | None = None,
    prog: str | None = None,
) -> Callable[[Callable[[ConfigT], int]], Callable[[ConfigT], int]]:
    """Decorator of a verb's ``run(config)``: its module gets the function ``main(argv)``, which parses the words after the verb
    and returns the exit status of ``run``. Arguments as for ``parse``."""

    def add(run: Callable[[ConfigT], int]) -> Callable[[ConfigT], int]:
        module = sys.modules[run.__module__]
        vars(module)["main"] = lambda argv: run(
            parse(config_class, argv, positional=positional, prog=prog)
        )
        return run

    return add


def command(verb: str, config: Any, positional: str | None = None) -> list[str]:
    """Words that a user types for a configuration: ``["taccorl", "collect", "--task=assembly_1"]``; settings with default
    values are left out. ``parse`` is the inverse. ``positional``: field whose value stands without an option name."""
    words = ["taccorl", *verb.split()]
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if field.name == positional:
            words += (
                [str(v) for v in value] if isinstance(value, list) else [str(value)]
            )
        elif value != _default(field):
            words += _options(field.name.rstrip("_"), value, _default(field))
    return words


def shared_fields(config: Any, kind: type) -> dict[str, Any]:
    """Values of those fields of ``config`` that the dataclass ``kind`` is made with, too."""
    names = [f.name for f in dataclasses.fields(kind) if f.init]  # pyright: ignore[reportArgumentType]
    return {name: getattr(config, name) for name in names if hasattr(config, name)}


def refuse(config: Any, names: Sequence[str], why: str) -> None:
    """Raises TaccorlError: one of these options is given."""
    for name in names:
        if getattr(config, name) != getattr(type(config)(), name):
            raise TaccorlError(f"--{name} {why}".replace(" :", ":"))


def _default(field: dataclasses.Field[Any]) -> Any:
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return field.default


def _options(name: str, value: Any, default: Any) -> list[str]:
    if dataclasses.is_dataclass(value):
        same = type(value) is type(default)
        words = [] if same else [f"--{name}.type={value.get_choice_name(type(value))}"]  # pyright: ignore
        for field in dataclasses.fields(value):
            own, usual = (
                getattr(value, field.name),
                getattr(default, field.name) if same else _default(field),
            )
            words += (
                [] if own == usual else _options(f"{name}.{field.name}", own, usual)
            )
        return words
    if isinstance(value, list) and value and isinstance(value[0], Path):
        return [f"--{name}={path}" for path in value]
    if isinstance(value, list | dict):
        return [f"--{name}={json.dumps(value, ensure_ascii=False)}"]
    return [f"--{name}={str(value).lower() if isinstance(value, bool) else value}"]


def joined(argv: Sequence[str]) -> list[str]:
    """The words ``argv`` with ``--a=b`` in place of ``--a b``. Every option takes a value; one that begins with a minus must
    be a number."""
    found: list[str] = []
    for word in argv:
        before = found[-1] if found else ""
        takes_value = (
            before.startswith("--") and "=" not in before and before not in HELP
        )
        if takes_value and (not word.startswith("-") or _NEGATIVE.fullmatch(word)):
            found[-1] = f"{before}={word}"
        else:
            found.append(word)
    return found


def _as_field(option: str, hints: dict[str, Any]) -> str:
    """``--for=x`` as ``--for_=x``: a trailing underscore keeps a field free of Python's own words."""
    name, equals, value = option.partition("=")
    return (
        f"{name}_{equals}{value}" if f"{name.removeprefix('--')}_" in hints else option
    )


def given_names(argv: Sequence[str]) -> set[str]:
    """Names of the options that are set in ``argv`` and in its --config_path, after ``parse`` has accepted them: ``out``,
    ``ppo.clip``."""
    import yaml

    names: set[str] = set()
    for option in joined(argv):
        name, _, value = option.removeprefix("--").partition("=")
        if name == "config_path":
            names |= set(
                _flat(yaml.safe_load(_path(value).read_text(encoding="utf-8")))
            )
        elif option.startswith("--"):
            names.add(name)
    return names


def _flat(values: dict[str, Any], prefix: str = "") -> list[str]:
    names = []
    for key, value in values.items():
        names += (
            _flat(value, f"{prefix}{key}.")
            if isinstance(value, dict)
            else [f"{prefix}{key}"]
        )
    return names


def _required(config_class: type) -> list[str]:
    """Fields without a default."""
    nothing = dataclasses.MISSING
    fields = dataclasses.fields(config_class)
    return [
        f.name for f in fields if f.default is nothing and f.default_factory is nothing
    ]


def _kinds(hint: Any) -> tuple[Any, ...]:
    """The kind itself, or those that a list or union is of."""
    return typing.get_args(hint) or (hint,)


def _check_option(option: str, hints: dict[str, Any]) -> None:
    """A known name with a value."""
    name, equals, value = option.lstrip("-").partition("=")
    known = [
        "config_path",
        *hints,
        *(f"{n}.{inner}" for n, hint in hints.items() for inner in _inner_names(hint)),
    ]
    if name not in known or not option.startswith("--"):
        raise TaccorlError(
            f"unknown option {option!r}; {nearest(name, [n.rstrip('_') for n in known])}"
        )
    if not equals or not value:
        raise TaccorlError(
            f"option {option!r} needs a value: --{name}={'true' if hints.get(name) is bool else '…'}"
        )
    if hints.get(name) is bool and value.lower() not in _BOOLEANS:
        raise TaccorlError(
            f"option --{name} takes true or false, found {value!r}: --{name}=true"
        )
    if (
        kinds := getattr(hints.get(name), "get_known_choices", dict)()
    ) and not value.startswith("{"):
        raise TaccorlError(
            f"{option}: choose one, --{name}.type={f' or --{name}.type='.join(kinds)}"
        )


def _inner_names(hint: Any) -> list[str]:
    """Names below a field that is a dataclass, or one of several by ``type``, at any depth: ``hands.speed``."""
    choices = getattr(hint, "get_known_choices", dict)()
    names = ["type"] if choices else []
    for kind in [*choices.values(), hint]:
        if dataclasses.is_dataclass(kind) and isinstance(kind, type):
            hints = typing.get_type_hints(kind)
            for field in dataclasses.fields(kind):
                names += [
                    field.name,
                    *(
                        f"{field.name}.{inner}"
                        for inner in _inner_names(hints[field.name])
                    ),
                ]
    return list(dict.fromkeys(names))


def _text_kind(hint: Any) -> str | None:
    """``one`` for a path or text, perhaps absent; ``list`` for a list of them; None for anything else."""
    if typing.get_origin(hint) is list:
        return "list" if typing.get_args(hint)[0] in (Path, str) else None
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        kinds = [k for k in typing.get_args(hint) if k is not type(None)]
        return _text_kind(kinds[0]) if len(kinds) == 1 else None
    return "one" if hint in (Path, str) else None


def _take_texts(
    options: list[str], hints: dict[str, Any]
) -> tuple[dict[str, Any], list[str]]:
    """Values of fields that are paths or texts, and the options that draccus is to read."""
    texts: dict[str, Any] = {}
    numbers: dict[str, list[str]] = {}
    rest: list[str] = []
    for name, hint in hints.items():
        typed = [option for option in options if option.startswith(f"--{name}=")]
        listed = any(
            option.startswith(f"--{name}=[") and option.endswith("]")
            for option in typed
        )
        if typing.get_origin(hint) is list and len(typed) > 1 and listed:
            raise TaccorlError(
                f"{typed[0]} and {typed[1]}: give --{name}=[…] once, or repeat it without brackets"
            )
    for option in options:
        name, _, value = option.removeprefix("--").partition("=")
        hint = hints.get(name)
        kind = _text_kind(hint)
        convert = _path if hint is Path or Path in typing.get_args(hint) else str
        if hint == list[int] and value.isdecimal():
            numbers.setdefault(name, []).append(value)
        elif kind == "list" and not (value.startswith("[") and value.endswith("]")):
            names = convert is str and re.fullmatch(
                r"\w+(,\w+)+", value
            )  # not such as x=[1,2]
            texts.setdefault(name, []).extend(
                map(convert, value.split(",") if names else [value])
            )
        elif kind == "one" and not (value == "null" and hint not in (Path, str)):
            texts[name] = convert(value)
        else:
            rest.append(option)
    return texts, [
        *rest,
        *(f"--{name}=[{','.join(each)}]" for name, each in numbers.items()),
    ]


def _path(value: str) -> Path:
    """The shell leaves the ~ of --out=~/data alone: a folder named ~ is never meant."""
    return Path(value).expanduser() if value.startswith("~/") else Path(value)


def _implied_types(options: list[str], fields: dict[str, Any]) -> list[str]:
    """``--engine.workers=2`` means the default engine's workers: draccus wants its type said."""
    names = {o.removeprefix("--").partition("=")[0] for o in options}
    if "config_path" in names:
        return []
    implied = []
    for field in {n.split(".")[0] for n in names if "." in n}:
        factory = fields[field].default_factory
        if f"{field}.type" not in names and hasattr(factory, "get_choice_name"):
            implied.append(f"--{field}.type={factory.get_choice_name(factory)}")
    return implied


def _draccus[ConfigT](config_class: type[ConfigT], options: list[str]) -> ConfigT:
    import draccus
    import yaml
    from draccus.utils import DraccusException

    given = []
    for option in options:
        name, _, value = option.partition("=")
        if name == "--config_path":
            _check_config_file(_path(value))
            option = f"{name}={json.dumps(str(_path(value)), ensure_ascii=False)}"
        _check_size(name, value)
        given.append(option)
    try:
        return draccus.parse(config_class, args=given, exit_on_error=False)
    except (DraccusException, argparse.ArgumentError, yaml.YAMLError) as error:
        cause: BaseException | None = error
        while cause is not None:
            if isinstance(
                cause, TaccorlError
            ):  # a config's own check says it better than draccus, which wraps it
                raise cause from None
            cause = cause.__cause__ or cause.__context__
        text = " ".join(str(error).split())
        if wrong := _WRONG.match(text):
            form = _FORMS.get(wrong[3] or wrong[5], "numbers, such as [0.1, 0.4]")
            raise TaccorlError(
                f"--{wrong[1]}={wrong[2] or wrong[4]}: expected {form}"
            ) from error
        raise TaccorlError(text) from error


def _check_size(name: str, value: str) -> None:
    """Refuse values that are too long or too deeply nested: draccus reads values as YAML, which would end in a traceback."""
    if len(value) > LONGEST_VALUE:
        text = f"{name}: {len(value):,} characters, at most {LONGEST_VALUE:,} are read: give it by --config_path"
        raise TaccorlError(text)
    if sum(map(value.count, "[{")) > DEEPEST_VALUE:
        raise TaccorlError(
            f"{name}: more than {DEEPEST_VALUE} brackets in a value: give it by --config_path"
        )


def _check_config_file(path: Path) -> None:
    from taccorl.data.strict_yaml import load_yaml

    found = load_yaml(path)
    if not isinstance(found, dict):
        raise TaccorlError(
            f"{path}: expected options and their values, found {type(found).__name__}"
        )


MOST_PX = 2048
"""Most rows or columns of a frame in the cache of training."""


def cached_resolution(text: str | None, pictures: str) -> tuple[int, int] | None:
    """(rows, columns) [pixels] of ``--resolution=112x112``, which needs ``--pictures=cache``; None if ``text`` is None. Raises
    TaccorlError: not rows x columns, or without effect."""
    if text is None:
        return None
    if pictures != "cache":
        line = f"--resolution={text} has no effect with --pictures={pictures}: remove it, or give --pictures=cache"
        raise TaccorlError(line)
    found = re.fullmatch(r"([1-9]\d*)x([1-9]\d*)", text)
    if not found or max(int(found[1]), int(found[2])) > MOST_PX:
        raise TaccorlError(
            f"--resolution={text}: rows x columns, at most {MOST_PX} each, e.g. 112x112"
        )
    return int(found[1]), int(found[2])

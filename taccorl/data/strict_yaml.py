"""Read YAML into frozen dataclasses, strictly: a wrong key or value is an error with file, line and the nearest name.

Keys that start with ``x-`` hold shared anchors and are ignored. Nothing is guessed: ``no`` is not the text "no", ``"3"`` is not
the number 3, and 010, 0x1F, 1:30 and .inf, which YAML 1.1 reads unexpectedly, are not numbers at all.

PyYAML takes half a minute for a megabyte of short list items and ends deep nesting in a RecursionError, so files have a limit.
"""

import dataclasses
import functools
import math
import re
import types
import typing
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import yaml

from taccorl.errors import SpecError, nearest

SPEC_VERSION = 1  # Version of the files' format that this code reads
MOST_BYTES = (
    1 << 18
)  # Largest YAML file that is read [bytes]; the largest shipped one has 9 kB
MOST_DIGITS = 100  # Most digits of a whole number. Python refuses more than 4300, without naming the file
MOST_SHOWN = 60  # Most characters of a value that an error message repeats
_hints = functools.cache(typing.get_type_hints)
PLAIN_INT = re.compile(r"[-+]?(0|[1-9][0-9]*)")
PLAIN_FLOAT = re.compile(
    r"[-+]?((0|[1-9][0-9]*)(\.[0-9]*)?|\.[0-9]+)([eE][-+]?[0-9]+)?"
)

Rules = Iterator[
    tuple[Any, str, str]
]  # What is wrong if true, key, text: later rules rely on earlier ones


def load_yaml(path: Path, most_bytes: int = MOST_BYTES) -> Any:
    """Read a YAML file written by another tool, as plain values, with limits on size and depth. Raises SpecError: it cannot
    be read, is larger than ``most_bytes``, or is not YAML."""
    text = read_bounded(path, most_bytes, "YAML")
    try:
        return yaml.safe_load(text)
    except (yaml.YAMLError, ValueError) as error:
        raise SpecError(
            f"{path}: is not YAML: {' '.join(str(error).split())}"
        ) from error
    except RecursionError as error:
        raise SpecError(f"{path}: is nested too deeply") from error


@functools.lru_cache(maxsize=64)
def composed(text: str) -> yaml.Node | None:
    """The nodes of a YAML text, not to be changed: they are kept for a text that is read again, such as a spec (PyYAML takes
    10 ms for a kilobyte). Raises yaml.YAMLError or RecursionError."""
    return yaml.compose(text, Loader=yaml.SafeLoader)


def read_bounded(path: Path, most_bytes: int, what: str) -> str:
    """Text of a regular file. ``what``: what it should be, for messages: ``YAML``. Raises SpecError: it cannot be read, is a
    device or a pipe, which may never end, is too large, or not UTF-8."""
    try:
        if path.exists() and not path.is_file() and not path.is_dir():
            raise SpecError(f"{path}: is a device or a pipe; give a file")
        with path.open("rb") as file:
            content = file.read(most_bytes + 1)
        if len(content) > most_bytes:
            raise SpecError(
                f"{path}: is larger than {most_bytes:,} bytes, the limit here: is it the right file?"
            )
        return content.decode("utf-8")
    except FileNotFoundError as error:
        siblings = [p.name for p in path.parent.glob("*.y*ml")]
        raise SpecError(
            f"{path}: no such file"
            + (f"; {nearest(path.name, siblings)}" if siblings else "")
        ) from error
    except IsADirectoryError as error:
        raise SpecError(f"{path}: is a folder; give a file of it") from error
    except UnicodeDecodeError as error:
        raise SpecError(
            f"{path}: cannot be read as {what}: it is not a text file in UTF-8 ({error})"
        ) from error
    except OSError as error:
        raise SpecError(f"{path}: cannot be read: {error.strerror or error}") from error


class Document[T]:
    """One YAML file read into the dataclass ``cls``, with the line of every key for error messages. Raises SpecError: the
    file is missing, is not YAML, or does not fit ``cls``."""

    def __init__(self, cls: type[T], path: Path) -> None:
        self.path = Path(path)
        self._lines: dict[str, int] = {}
        text = read_bounded(self.path, MOST_BYTES, "a spec")
        self._todo = [
            n
            for n, line in enumerate(text.splitlines(), 1)
            if re.match(r"[^#]*\bTODO\b", line)
        ]
        try:
            root = composed(text)
        except yaml.MarkedYAMLError as error:
            line = error.problem_mark.line + 1 if error.problem_mark else 1
            hint = "; indent with spaces" if "'\\t'" in str(error.problem) else ""
            hint = (
                "; put a text with { and } in quotes"
                if "got '{'" in str(error.problem)
                else hint
            )
            raise SpecError(
                f"{self.path}:{line}: is not YAML: {error.problem}{hint}"
            ) from error
        except yaml.YAMLError as error:
            raise SpecError(
                f"{self.path}: is not YAML: {' '.join(str(error).split())}"
            ) from error
        except RecursionError as error:
            raise SpecError(f"{self.path}: is nested too deeply for a spec") from error
        if root is None:
            keys = ", ".join(
                f.name for f in dataclasses.fields(typing.cast("Any", cls))
            )
            raise SpecError(f"{self.path}: is empty; its keys are {keys}")
        self.value: T = self._build(cls, root, "")

    def has(self, key: str) -> bool:
        """Whether the file states ``key`` (its path, with slashes)."""
        return key in self._lines

    def error(self, key: str, text: str) -> SpecError:
        """A SpecError that points at ``key`` (dotted path), or at its closest parent that is in the file. At a ``TODO`` of a
        draft it lists the lines of the others."""
        parts = key.split("/")
        while parts and "/".join(parts) not in self._lines:
            parts.pop()
        line = self._lines.get("/".join(parts), 1)
        place = f"{_short(key.replace('/', ' → '))}: " if key else ""
        others = [str(n) for n in self._todo if n != line] if line in self._todo else []
        text += (
            f"; TODO also in lines {', '.join(others[:MOST_SHOWN])}" if others else ""
        )
        return SpecError(f"{self.path}:{line}: {place}{text}")

    def refuse(self, rules: Iterable[tuple[Any, str, str]]) -> None:
        """Raise the error of the first rule, (what is wrong if true, key, text), that applies."""
        for wrong, key, text in rules:
            if wrong:
                raise self.error(key, text)

    def _build(self, kind: Any, node: yaml.Node, key: str) -> Any:
        self._lines.setdefault(key, node.start_mark.line + 1)
        if dataclasses.is_dataclass(kind):
            return self._dataclass(kind, node, key)
        origin, args = get_origin(kind), get_args(kind)
        if origin in (typing.Union, types.UnionType):
            return self._union(args, node, key)
        if origin is Literal:
            text = self._scalar(str, node, key)
            if text not in args:
                known = ", ".join(map(repr, args))
                raise self.error(
                    key, f"{_quoted(text)} is not one of {known}; {nearest(text, args)}"
                )
            return text
        if origin is dict:
            items = self._items(node, key)
            return {
                name: self._build(args[1], child, f"{key}/{name}" if key else name)
                for name, child in items
            }
        if origin is tuple:
            return self._tuple(args, node, key)
        return self._scalar(kind, node, key)

    def _items(self, node: yaml.Node, key: str) -> list[tuple[str, yaml.Node]]:
        if not isinstance(node, yaml.MappingNode):
            raise self.error(key, f"expected keys and values, found {_describe(node)}")
        items: dict[str, yaml.Node] = {}
        for name_node, child in node.value:
            if not isinstance(name_node, yaml.ScalarNode):
                raise self.error(
                    key, f"a key must be a word, found {_describe(name_node)}"
                )
            name = str(name_node.value)
            path = f"{key}/{name}" if key else name
            self._lines[path] = name_node.start_mark.line + 1
            if name in items:
                raise self.error(path, "stands here twice; keep one")
            if name == "<<":
                raise self.error(
                    path,
                    "merge keys are not read; write the keys out, or share one value by an anchor",
                )
            items[name] = child
        return [
            (name, child) for name, child in items.items() if not name.startswith("x-")
        ]

    def _dataclass(self, cls: Any, node: yaml.Node, key: str) -> Any:
        hints, fields = _hints(cls), {f.name: f for f in dataclasses.fields(cls)}
        # A trailing underscore keeps a YAML key free of Python's own words (`from` is `from_` in the dataclass).
        known = {name.rstrip("_"): name for name in fields}
        values: dict[str, Any] = {}
        for name, child in self._items(node, key):
            path = f"{key}/{name}" if key else name
            if name not in known:
                entries = [
                    (f, getattr(k, "__dataclass_fields__", ()))
                    for f in hints
                    for k in get_args(hints[f])[1:]
                ]
                inside = [
                    f"write `{f}: {{NAME: {{{name}: …}}}}`, in each entry"
                    for f, own in entries
                    if name in own
                ]
                raise self.error(
                    path,
                    f"unknown key {_quoted(name)}; {(inside or [nearest(name, known)])[0]}",
                )
            values[known[name]] = self._build(hints[known[name]], child, path)
        for name, field in fields.items():
            if (
                field.default is dataclasses.MISSING is field.default_factory
                and name not in values
            ):
                raise self.error(key, f"key {name.rstrip('_')!r} is missing")
        return cls(**values)

    def _tuple(
        self, args: tuple[Any, ...], node: yaml.Node, key: str
    ) -> tuple[Any, ...]:
        if not isinstance(node, yaml.SequenceNode):
            raise self.error(key, f"expected a list, found {_describe(node)}")
        kinds = args[:1] * len(node.value) if args[1:] == (Ellipsis,) else args
        if len(kinds) != len(node.value):
            raise self.error(
                key, f"expected {len(kinds)} values, found {len(node.value)}"
            )
        return tuple(
            self._build(a, c, f"{key}/{i}")
            for i, (a, c) in enumerate(zip(kinds, node.value, strict=True))
        )

    def _union(self, kinds: tuple[Any, ...], node: yaml.Node, key: str) -> Any:
        if (
            type(None) in kinds
            and isinstance(node, yaml.ScalarNode)
            and node.tag.endswith(":null")
        ):
            return None
        plain = {
            yaml.MappingNode: (dict,),
            yaml.SequenceNode: (tuple,),
            yaml.ScalarNode: (str, int, float, bool, Literal),
        }
        mapping = isinstance(node, yaml.MappingNode)
        fitting = [
            k
            for k in kinds
            if (get_origin(k) or k) in plain[type(node)]
            or (mapping and dataclasses.is_dataclass(k))
        ]
        error = self.error(key, f"does not fit: found {_describe(node)}")
        for kind in fitting:
            try:
                return self._build(kind, node, key)
            except SpecError as found:
                error = found
        raise error

    def _scalar(self, kind: Any, node: yaml.Node, key: str) -> Any:
        if not isinstance(node, yaml.ScalarNode):
            raise self.error(
                key, f"expected one {kind.__name__}, found {_describe(node)}"
            )
        tag, text = node.tag.rsplit(":", 1)[-1], str(node.value)
        plain = node.style is None  # quoted digits are a text
        if kind is bool and tag == "bool":
            return text.lower() in ("true", "yes", "on")
        if (
            kind is int
            and plain
            and len(text) <= MOST_DIGITS
            and PLAIN_INT.fullmatch(text)
        ):
            return int(text)
        # By its own rule, not by YAML 1.1's, which reads 1e-3 as a text
        if (
            kind is float
            and plain
            and PLAIN_FLOAT.fullmatch(text)
            and math.isfinite(float(text))
        ):
            return float(text)
        if kind is str and tag == "str":
            return text
        digits = (
            f"at most {MOST_DIGITS} digits"
            if len(text) > MOST_DIGITS
            else "plain digits only"
        )
        hint = {
            str: "; put it in quotes",
            int: f"; {digits}",
            float: "; plain decimal digits only",
        }.get(kind, "")
        hint += ", without quotes" * (not plain and kind in (int, float))
        raise self.error(
            key, f"expected {kind.__name__}, found {_describe(node)}{hint}"
        )


def check_version(document: Document[Any], version: int) -> None:
    """Raises SpecError: this code does not read files of that version."""
    text = f"{version}; this taccorl reads version {SPEC_VERSION}"
    document.refuse([(version != SPEC_VERSION, "spec_version", text)])


def _describe(node: yaml.Node) -> str:
    if isinstance(node, yaml.ScalarNode):
        return _quoted(str(node.value))
    return "a list" if isinstance(node, yaml.SequenceNode) else "keys and values"


def _short(text: str) -> str:
    return text if len(text) <= 4 * MOST_SHOWN else f"{text[: 4 * MOST_SHOWN]}…"


def _quoted(value: str) -> str:
    return (
        repr(value)
        if len(value) <= MOST_SHOWN
        else f"{value[:MOST_SHOWN]!r}… ({len(value):,} characters)"
    )

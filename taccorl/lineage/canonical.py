"""Configs as plain JSON data: equal configs have equal text, and the text is part of a stage's key.

Rules:

* A dataclass has a key ``type``: its draccus choice name, else its class name. Two plug-ins with the same fields
  must not share a key.
* Fields declared ``field(compare=False)`` do not affect the result (workers, progress), and are left out.
* ``Path`` and ``str`` are the same thing; an enum is its name; a tuple is a list; the order of a dict does not matter.
* ``1`` and ``1.0`` differ: a stage may treat them differently.
"""

import dataclasses
import enum
import json
import math
from collections.abc import Mapping
from pathlib import PurePath
from typing import Any

from taccorl.lineage.errors import ConfigError


def canonical(config: Any) -> Any:
    """``config`` as plain JSON data with sorted keys. Raises ConfigError: NaN, infinity, a set, an array or an object without a
    unique JSON form; the message names the field."""
    return _plain(config, "config")


def canonical_text(config: Any) -> str:
    """Unique JSON text of ``config``, in ASCII, so that it does not depend on the locale."""
    return json.dumps(
        canonical(config), sort_keys=True, allow_nan=False, separators=(",", ":")
    )


def _plain(value: Any, where: str) -> Any:
    if isinstance(value, enum.Enum):
        return value.name
    # A numpy scalar, by its shape, so that numpy need not be imported; an array of one element is still an array.
    if (
        type(value).__module__ == "numpy"
        and getattr(value, "shape", None) == ()
        and hasattr(value, "item")
    ):
        return _plain(value.item(), where)
    if value is None or isinstance(value, bool):
        return value
    if isinstance(value, int):
        return int(value)
    if isinstance(value, float):
        if not math.isfinite(value):
            raise ConfigError(
                f"{where} is {value}: not a number that JSON or a key can hold. Use None for 'not set'."
            )
        return float(value)
    if isinstance(value, str):
        return str(value)
    if isinstance(value, PurePath):
        return value.as_posix()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = [f for f in dataclasses.fields(value) if f.compare]
        plain = {"type": _type_name(value)} | {
            f.name: _plain(getattr(value, f.name), f"{where}.{f.name}") for f in fields
        }
        return dict(sorted(plain.items()))
    if isinstance(value, Mapping):
        return {
            key: _plain(value[key], f"{where}.{key}")
            for key in _sorted_keys(value, where)
        }
    if isinstance(value, list | tuple):
        return [_plain(item, f"{where}[{i}]") for i, item in enumerate(value)]
    kind = type(value).__name__
    raise ConfigError(
        f"{where} is a {kind}, which has no unique JSON form. A config holds numbers, text, paths, enums, lists, dicts and "
        "dataclasses of these; sets become sorted lists, arrays become lists or an input file."
    )


def _sorted_keys(value: Mapping[Any, Any], where: str) -> list[str]:
    for key in value:
        if not isinstance(key, str) or isinstance(key, enum.Enum):
            raise ConfigError(
                f"{where} has the key {key!r} of type {type(key).__name__}; keys are text."
            )
    return sorted(value)


def _type_name(value: Any) -> str:
    choice_name = getattr(type(value), "get_choice_name", None)
    if choice_name is not None:
        try:
            return choice_name(type(value))
        except (
            ValueError
        ):  # the class is no registered choice, only derived from a registry
            pass
    return type(value).__name__


def not_default(config: Any) -> dict[str, Any] | None:
    """The settings that differ from their defaults: dotted name → value, ``{"timing.rate_hz": 20.0}``; None if ``config`` is
    no dataclass."""
    if not dataclasses.is_dataclass(config) or isinstance(config, type):
        return None
    now = canonical(config)
    default: dict[str, Any] = {"type": now["type"]}
    for field in dataclasses.fields(config):
        if field.compare and field.default is not dataclasses.MISSING:
            default[field.name] = canonical(field.default)
        elif field.compare and field.default_factory is not dataclasses.MISSING:
            default[field.name] = canonical(field.default_factory())
    flat_default = flatten(default)
    return {
        name: value
        for name, value in flatten(now).items()
        if flat_default.get(name, _ABSENT) != value
    }


def differences(old: Any, new: Any) -> list[str]:
    """Differences of two canonical configs, one text each, such as ``["timing.rate_hz: 30.0 → 20.0"]``; empty if they are
    equal."""
    flat_old, flat_new = flatten(old), flatten(new)
    changed = []
    for name in sorted(flat_old.keys() | flat_new.keys()):
        before, after = flat_old.get(name, _ABSENT), flat_new.get(name, _ABSENT)
        if before != after:
            changed.append(f"{name or 'config'}: {show(before)} → {show(after)}")
    return changed


def flatten(plain: Any, prefix: str = "") -> dict[str, Any]:
    """Nested dicts as one dict: dotted name → value; lists stay whole. ``prefix``: name of ``plain`` itself, which begins every
    name."""
    if not isinstance(plain, dict) or not plain:
        return {prefix: plain}
    flat: dict[str, Any] = {}
    for name, value in plain.items():
        flat |= flatten(value, f"{prefix}.{name}" if prefix else name)
    return flat


def show(value: Any) -> str:
    """Text of a setting in the form in which a person would type it."""
    return (
        value
        if isinstance(value, str)
        else "absent"
        if value is _ABSENT
        else json.dumps(value)
    )


_ABSENT = object()

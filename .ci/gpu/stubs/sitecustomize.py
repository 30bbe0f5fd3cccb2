"""Empty modules for what no rollout or training of cached pictures uses: videos, .rrd files, the surrogate's server."""

import importlib.abc
import importlib.machinery
import sys
import types
from typing import Any

NAMES = ("av", "rerun", "rerun_bindings", "zmq")


def _made(name: str) -> type:
    if name.startswith("__"):
        raise AttributeError(name)
    return type(name, (Nothing,), {})


class _Classes(type):
    def __getattr__(cls, name: str) -> type:
        return _made(name)


class Nothing(metaclass=_Classes):
    """Takes every call and has every attribute."""

    def __init__(self, *args: Any, **named: Any) -> None: ...

    def __call__(self, *args: Any, **named: Any) -> "Nothing":
        return self

    def __enter__(self) -> "Nothing":
        return self

    def __exit__(self, *args: Any) -> None: ...

    def __len__(self) -> int:
        return 0

    def read(self) -> bytes:
        return b""

    def __getattr__(self, name: str) -> "Nothing":
        return _made(name)()


class _Module(types.ModuleType):
    __version__ = "0.0"

    def __getattr__(self, name: str) -> type:
        return _made(name)


class _Finder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    def find_spec(
        self, fullname: str, path: Any = None, target: Any = None
    ) -> importlib.machinery.ModuleSpec | None:
        if fullname.split(".")[0] not in NAMES:
            return None
        return importlib.machinery.ModuleSpec(fullname, self, is_package=True)

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> types.ModuleType:
        return _Module(spec.name)

    def exec_module(self, module: types.ModuleType) -> None:
        module.__path__ = []


sys.meta_path.insert(0, _Finder())

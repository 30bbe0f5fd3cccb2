"""Packages that only an extra installs (``pip install ".[lerobot]"``): imported at their first use, or named with the command
that installs them."""

import functools
import importlib
import importlib.util
import sys
from typing import Any

from taccorl.errors import TaccorlError

EXTRAS = {
    "lerobot": (
        "av",
        "cv2",
        "datasets",
        "glfw",
        "huggingface_hub",
        "lerobot",
        "mink",
        "pandas",
        "rerun",
        "torch",
        "torchvision",
        "zmq",
    ),
    "train": ("accelerate", "safetensors", "transformers"),
    "gpu": ("mujoco_warp", "warp"),
    "peft": ("peft",),
}
"""Extra of pyproject.toml → modules that it installs; ``train`` installs those of ``lerobot``, too, ``peft`` those of ``train``,
and ``gpu`` torch."""


class OnUse:
    """Stands for the module ``name`` and imports it when an attribute is read. Raises ModuleNotFoundError: not installed."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, attribute: str) -> Any:
        return getattr(importlib.import_module(self._name), attribute)


def raised(exception: str) -> tuple[type[Exception], ...]:
    """The exception ``MODULE.NAME`` for an ``except``; nothing while the module is not imported, which then raises none."""
    module, _, name = exception.rpartition(".")
    return (getattr(sys.modules[module], name),) if module in sys.modules else ()


def missing(module: str) -> str:
    """Text for a ``module`` that is not installed, with the way out; empty if it is installed, or belongs to no extra."""
    extra = next(
        (extra for extra, modules in EXTRAS.items() if module in modules), None
    )
    if extra is None or _is_installed(module):
        return ""
    return f'needs {module}, which is not installed: pip install "lerobot_policy_taccorl[{extra}]"'


def require(extra: str) -> None:
    """Raise a TaccorlError if a module of the extra is not installed: before any work is done."""
    for one in ("lerobot", "train") if extra == "train" else (extra,):
        if lacking := next(filter(None, map(missing, EXTRAS[one])), None):
            raise TaccorlError(lacking.replace(f"[{one}]", f"[{extra}]"))


def _is_installed(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:
        return False


@functools.cache
def quick_columns() -> None:
    """Make ``datasets.Features`` (4.8.5) check only the column that is set, instead of every column each time: LeRobot's table
    of episodes has 200, and opening it took three times as long. It replaces a method and uses a private attribute."""
    from datasets.features.features import Features, require_decoding

    def set_one(self: Any, column: str, feature: Any) -> None:
        dict.__setitem__(self, column, feature)
        self._column_requires_decoding[column] = require_decoding(feature)

    Features.__setitem__ = set_one  # pyright: ignore[reportAttributeAccessIssue]

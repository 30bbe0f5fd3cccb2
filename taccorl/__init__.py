"""TacCoRL: touch for vision-language-action policies, learned from recordings and a calibrated twin.

``taccorl.compare`` and the other functions of ``taccorl.api`` are imported at their first
use; ``__init__.pyi`` has their types.
"""

import importlib

__version__ = "0.1.0"
_LAZY = (
    "TaccorlError",
    "add_effect",
    "compare",
    "diagnose",
    "ingest",
    "load_episode",
    "load_robot",
    "plot",
    "read_measurements",
)


def __getattr__(name: str) -> object:
    if name not in _LAZY:
        raise AttributeError(f"module 'taccorl' has no attribute {name!r}")
    # By name: the lower layers import this package for its version only.
    return getattr(importlib.import_module("taccorl.api"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_LAZY])

"""Plug-ins: one file in a plug-in folder, one decorator; outside packages join by the entry-point group ``taccorl.plugins``.

An outside package publishes in its ``pyproject.toml``::

    [project.entry-points."taccorl.plugins"]
    my_reader = "my_package.my_reader"      # importing this module runs its @register decorators
"""

import importlib
import importlib.metadata
import pkgutil
from collections.abc import Callable, Iterator
from typing import cast

from taccorl.errors import TaccorlError, nearest

ENTRY_POINT_GROUP = "taccorl.plugins"


class Registry[T]:
    """Registry of plug-in classes of one kind, by name, filled by importing the plug-in folder and the published entry points."""

    def __init__(self, kind: str, folder: str) -> None:
        self.kind, self.folder = kind, folder
        self._entries: dict[str, T] = {}
        self._loaded = False

    def register[E](self, name: str) -> Callable[[E], E]:
        """Class decorator: ``@readers.register("mcap")``. The class keeps its own type."""

        def add(entry: E) -> E:
            # By name, not by identity: a module that failed half-way is imported afresh when somebody asks again.
            if name in self._entries and repr(self._entries[name]) != repr(entry):
                raise TaccorlError(
                    f"{self.kind} {name!r} is registered twice: {self._entries[name]} and {entry}"
                )
            self._entries[name] = cast("T", entry)
            return entry

        return add

    def _load(self) -> None:
        if self._loaded:
            return
        package = importlib.import_module(self.folder)
        for module in pkgutil.iter_modules(package.__path__):
            importlib.import_module(f"{self.folder}.{module.name}")
        for point in importlib.metadata.entry_points(group=ENTRY_POINT_GROUP):
            try:
                point.load()
            except Exception as error:  # an outside package must not take ours down, but must not fail silently
                raise TaccorlError(
                    f"plug-in {point.name!r} ({point.value}) of entry-point group {ENTRY_POINT_GROUP!r} cannot be imported: "
                    f"{type(error).__name__}: {error}. Correct or uninstall it."
                ) from error
        self._loaded = True

    def get(self, name: str) -> T:
        """The plug-in of that name.

        Raises:
            TaccorlError: nothing is registered under ``name``; the message names the nearest.
        """
        self._load()
        if name not in self._entries:
            raise TaccorlError(
                f"no {self.kind} {name!r}; {nearest(name, self._entries)}"
            )
        return self._entries[name]

    def __iter__(self) -> Iterator[str]:
        self._load()
        return iter(sorted(self._entries))

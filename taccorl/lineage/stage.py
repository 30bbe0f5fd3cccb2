"""Stage: a named step of a pipeline. Artefact: its result, or a raw source."""

import dataclasses
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from taccorl.lineage.errors import LineageError
from taccorl.lineage.manifest import MANIFEST_PLACES, read_manifest

Function = Callable[[Any, list[Path], Path], None]
"""Function of (config, paths of the inputs, output folder)."""


def _unbound(config: Any, inputs: list[Path], folder: Path) -> None:
    raise NotImplementedError("this stage has no function; bind one with Stage.bound")


@dataclass(frozen=True)
class Stage:
    """A named step of a pipeline. Increase ``version`` when its code gives other results; older artefacts are then not used."""

    name: str
    """Name of the stage, which is also that of its folder in a store."""
    fn: Function = _unbound
    """Function of config, inputs and output folder that writes files into the folder. It may remove and recreate the folder."""
    version: int = 1
    manifest: str = MANIFEST_PLACES[0]
    """Relative path of the manifest in the artefact, one of MANIFEST_PLACES."""

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]*", self.name):
            raise LineageError(
                f"stage name {self.name!r}: use only letters, digits, '_' and '-', because it names a folder."
            )
        if self.manifest not in MANIFEST_PLACES:
            raise LineageError(
                f"stage {self.name}: manifest at {self.manifest!r}, but it is found only at one of {MANIFEST_PLACES}."
            )

    def bound(self, fn: Function) -> "Stage":
        """A copy of the stage with another function, such as one that has access to a simulation."""
        return dataclasses.replace(self, fn=fn)


@dataclass(frozen=True)
class Artefact:
    """A file or folder and the digest of its content."""

    path: Path
    digest: str
    """Digest of the content, 64 hexadecimal digits."""

    @property
    def manifest(self) -> dict[str, Any]:
        """Manifest of the artefact; empty for a raw source."""
        return read_manifest(self.path)

    def __str__(self) -> str:
        return str(self.path)

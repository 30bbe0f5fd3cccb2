"""The record that lies in every artefact: which stage made it, with what config, from which inputs, and its files."""

import functools
import importlib.metadata
import json
import os
import platform
from collections.abc import Collection
from pathlib import Path
from typing import Any

import taccorl
from taccorl.lineage.digest import DigestCache, digest_each
from taccorl.lineage.errors import LineageError

MANIFEST_PLACES = ("manifest.json", "meta/taccorl/manifest.json")  # an artefact; a LeRobot dataset
FORMAT = 1  # under the key "taccorl_manifest": tells our manifest.json from anybody else's

RECORDED_PACKAGES = ("numpy", "scipy", "av", "h5py", "mcap", "rosbags", "pyarrow", "lerobot", "torch", "mujoco")


def manifest_place(folder: Path) -> str | None:
    """Where in ``folder`` its manifest lies; None if it has none."""
    for place in MANIFEST_PLACES:
        if _load(folder, place):
            return place
    return None


def read_manifest(folder: Path) -> dict[str, Any]:
    """The manifest of the artefact in ``folder``; empty if it has none, as a raw source."""
    place = manifest_place(folder)
    return _load(folder, place) if place else {}


def _load(folder: Path, place: str) -> dict[str, Any]:
    """The manifest of ``folder`` if it lies at ``place``: not somebody else's file, not that of a folder further up."""
    path = folder / place
    try:
        content = json.loads(path.read_bytes())
    except (FileNotFoundError, NotADirectoryError, IsADirectoryError, ValueError):
        return {}
    if not isinstance(content, dict) or "taccorl_manifest" not in content or content.get("place") != place:
        return {}
    if content["taccorl_manifest"] != FORMAT:
        raise LineageError(
            f"{path} has manifest format {content['taccorl_manifest']}, this taccorl ({taccorl.__version__}) reads "
            f"{FORMAT}. Update taccorl."
        )
    return content


def write_manifest(folder: Path, place: str, manifest: dict[str, Any]) -> None:
    """Write ``manifest`` to its ``place`` in ``folder``, safe from a power cut from the moment this returns."""
    path = folder / place
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("x", encoding="ascii") as file:
        json.dump({"taccorl_manifest": FORMAT, "place": place} | manifest, file, indent=1)
        file.write("\n")
        file.flush()
        os.fsync(file.fileno())


def digests_now(folder: Path, cache: DigestCache | None = None) -> dict[str, str]:
    """``{relative path: digest}`` of what counts in a source folder or artefact as it lies there today.

    That is every visible file and every file its manifest lists, without the manifest: so an untouched artefact has
    today the digest that its manifest states.
    """
    place = manifest_place(folder)
    listed: Collection[str] = read_manifest(folder).get("files", {})
    digests = digest_each(folder, cache, also=listed)
    return {name: digest for name, digest in digests.items() if name != place}


@functools.cache
def software() -> dict[str, str]:
    """Versions of python, taccorl and the installed packages that shape results; nothing about the host."""
    versions = {"python": platform.python_version(), "taccorl": taccorl.__version__}
    for package in RECORDED_PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return versions

"""Delete from the store the artefacts that no dataset was made from, and leftovers of runs that died.

The lineage of a published dataset is kept while the dataset is at the path where it was published; that of other datasets
(moved, copied) is kept if they are named. Only folders that the store itself made are ever considered: ``<stage>/<key>`` and
their temporary forms. Do not prune while a pipeline runs: it may be about to read an artefact that no dataset refers to yet.
"""

import os
import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from filelock import Timeout

from taccorl.errors import DatasetError
from taccorl.lineage.ancestors import Manifest, ancestors
from taccorl.lineage.errors import LineageError
from taccorl.lineage.manifest import read_manifest
from taccorl.lineage.store import KEY, MARKER, Store, is_store

LEFTOVER = re.compile(rf"\.({KEY.pattern})\..+")
"""Name of a temporary folder of a run: group 1 is the key of its artefact."""


@dataclass(frozen=True)
class Unneeded:
    """A folder in the store that may be deleted."""

    path: Path
    key: str
    """Key of the artefact."""
    size_bytes: int
    """Size of its files [bytes] without those that are links to a published dataset, which remain."""
    is_leftover: bool
    """True: temporary folder of a run that died; False: an artefact."""


def open_store(root: Path) -> Store:
    """Open the existing store at ``root``. Raises LineageError: ``root`` is not a store."""
    if not is_store(root):
        raise LineageError(
            f"{root} is not a taccorl store: it has no {MARKER}. Name the store with --store=FOLDER."
        )
    return Store(root)


def unneeded(store: Store, keep: Sequence[Path] = ()) -> list[Unneeded]:
    """Artefacts that no published dataset and none of ``keep`` was made from, and leftovers; deletes nothing. Raises
    DatasetError: a dataset to keep does not exist or has no manifest, so that its inputs are unknown."""
    needed = _needed_keys(store, keep)
    found = [
        _describe(path, path.name)
        for path in store.artefacts()
        if path.name not in needed
    ]
    leftovers = [
        (path, match[1])
        for path in store.folders()
        if (match := LEFTOVER.fullmatch(path.name))
    ]
    return found + [
        _describe(path, key) for path, key in leftovers if not _is_alive(store, key)
    ]


def delete(store: Store, folders: Sequence[Unneeded]) -> list[Unneeded]:
    """Delete the ``folders`` from the store. Returns those that another run is using, which are not deleted."""
    busy = []
    for folder in folders:
        if not folder.path.resolve().is_relative_to(store.root):
            raise LineageError(
                f"{folder.path} lies outside the store {store.root}: not deleted."
            )
        try:
            with store.lock(folder.key, wait=False):
                doomed = folder.path
                if not folder.is_leftover:  # first out of sight in one step: a killed prune leaves no half artefact
                    doomed = folder.path.with_name(
                        f".{folder.key}.pruned-{os.getpid()}"
                    )
                    folder.path.rename(doomed)
                shutil.rmtree(doomed)
        except Timeout:
            busy.append(folder)
    return busy


def _needed_keys(store: Store, keep: Sequence[Path]) -> set[str]:
    """The keys of the datasets and of everything they were made from."""
    datasets: list[Manifest] = []
    for path in keep:
        if not (manifest := read_manifest(path)):
            problem = (
                "has no taccorl manifest" if Path(path).exists() else "does not exist"
            )
            raise DatasetError(
                f"--keep={path} {problem}, so that its inputs are unknown. Nothing was deleted."
            )
        datasets.append(manifest)
    datasets += [read_manifest(path) for path in store.destinations.present()]
    carried = {
        key: manifest
        for one in datasets
        for key, manifest in one.get("ancestors", {}).items()
    }
    inputs = [entry for one in datasets for entry in one["inputs"]]
    return {one["key"] for one in datasets} | ancestors(
        inputs, store.find_key, carried
    ).keys()


def _is_alive(store: Store, key: str) -> bool:
    try:
        with store.lock(key, wait=False):
            return False
    except Timeout:
        return True


def _describe(path: Path, key: str) -> Unneeded:
    files = [file.lstat() for file in path.rglob("*") if not file.is_dir()]
    size_bytes = sum(file.st_size for file in files if file.st_nlink == 1)
    return Unneeded(path, key, size_bytes, is_leftover=path.name.startswith("."))

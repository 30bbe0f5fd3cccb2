"""Ancestors of an artefact: its inputs, their inputs, and so on. A published manifest contains them, because the store may be
pruned."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from taccorl.lineage.manifest import read_manifest

CARRIED = (
    "stage",
    "stage_version",
    "key",
    "digest",
    "created",
    "config",
    "config_not_default",
    "inputs",
)
"""Entries of a manifest that a descendant's manifest repeats."""

Manifest = dict[str, Any]
"""Content of a manifest file."""
Entry = dict[str, Any]
"""Entry of a manifest for an input: path, digest, and key if a stage made it."""


def ancestors(
    inputs: list[Entry],
    find_key: Callable[[str], Path | None],
    published: dict[str, Manifest] | None = None,
) -> dict[str, Manifest]:
    """Key → manifest, with the entries ``CARRIED`` only, of all artefacts from which ``inputs`` were made, at any distance,
    sorted by key; without those that cannot be found. ``find_key``: ``Store.find_key``. ``published``: key → manifest that
    published artefacts contain."""
    found: dict[str, Manifest] = {}
    carried = dict(published or {})
    todo = list(inputs)
    while todo:
        manifest = _manifest_of(todo.pop(), find_key, carried)
        if not manifest or manifest["key"] in found:
            continue
        found[manifest["key"]] = {name: manifest[name] for name in CARRIED}
        carried |= manifest.get("ancestors", {})
        todo += manifest["inputs"]
    return dict(sorted(found.items()))


def _manifest_of(
    entry: Entry, find_key: Callable[[str], Path | None], carried: dict[str, Manifest]
) -> Manifest:
    """Manifest of an input: from its own folder, from the store, or else from ``carried``. Empty for a raw source."""
    key = entry["key"]
    if key is None:
        return {}
    if (manifest := read_manifest(Path(entry["path"]))).get("key") == key:
        return manifest
    in_store = find_key(key)
    return (read_manifest(in_store) if in_store else {}) or carried.get(key, {})

"""Ancestors of an artefact: its inputs, their inputs, and so on. A published manifest contains them, because the store may be
pruned."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from taccorl.lineage.manifest import read_manifest

CARRIED = ("stage", "stage_version", "key", "digest", "created", "config", "config_not_default", "inputs")
"""Entries of a manifest that a descendant's manifest repeats."""

Manifest = dict[str, Any]
"""Content of a manifest file."""
Entry = dict[str, Any]
"""Entry of a manifest for an input: path, digest, and key if a stage made it."""


def ancestors(inputs: list[Entry], find_key: Callable[[str], Path | None]) -> dict[str, Manifest]:
    """Manifests of all artefacts from which ``inputs`` were made, directly or indirectly, except those that cannot be found.

    Args:
        find_key: function from a key to the artefact's folder, None if there is none (``Store.find_key``).

    Returns:
        Key → manifest, with the entries ``CARRIED`` only; sorted by key.
    """
    found: dict[str, Manifest] = {}
    carried: dict[str, Manifest] = {}
    todo = list(inputs)
    while todo:
        entry = todo.pop()
        manifest = manifest_of(entry, find_key, carried)
        if not manifest or manifest["key"] in found:
            continue
        found[manifest["key"]] = {name: manifest[name] for name in CARRIED}
        carried |= manifest.get("ancestors", {})
        todo += manifest["inputs"]
    return dict(sorted(found.items()))


def manifest_of(entry: Entry, find_key: Callable[[str], Path | None], carried: dict[str, Manifest]) -> Manifest:
    """Manifest of an input: from its own folder, from the store, or else from ``carried``. Empty for a raw source. ``carried``:
    key → manifest that a published artefact contains."""
    key = entry["key"]
    if key is None:
        return {}
    if (manifest := read_manifest(Path(entry["path"]))).get("key") == key:
        return manifest
    in_store = find_key(key)
    return (read_manifest(in_store) if in_store else {}) or carried.get(key, {})

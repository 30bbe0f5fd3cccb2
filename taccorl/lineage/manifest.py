"""Manifest: the record in every artefact of its stage, configuration, inputs and files."""

import contextlib
import functools
import importlib.metadata
import json
import platform
from collections.abc import Collection
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath
from typing import Any

import taccorl
from taccorl.lineage.digest import (
    DigestCache,
    digest_each,
    digest_file,
    digest_files,
    list_files,
    stamp,
)
from taccorl.lineage.errors import LineageError
from taccorl.lineage.files import write_durably

MANIFEST_PLACES = (
    "manifest.json",
    DATASET_MANIFEST := "meta/taccorl/manifest.json",
)  # an artefact; a LeRobot dataset
CARD = "README.md"
"""File name of a dataset's card. It is written after the manifest and may be edited, so that it belongs to no artefact's
digest."""
FORMAT = (
    1  # under the key "taccorl_manifest": tells our manifest.json from anybody else's
)

CHECKPOINT = "checkpoint"
"""Stage in the manifest of a policy's checkpoint, which no store has made."""
_VERIFIED = ".verified.json"  # beside the manifest
_MISSING = "missing"
RECORDED_PACKAGES = (
    "numpy",
    "scipy",
    "av",
    "h5py",
    "mcap",
    "rosbags",
    "pyarrow",
    "lerobot",
    "torch",
    "mujoco",
)
"""Packages whose versions manifests state."""


def manifest_place(folder: Path) -> str | None:
    """Relative path of the manifest in ``folder``, one of ``MANIFEST_PLACES``; None if it has none."""
    for place in MANIFEST_PLACES:
        if _load(folder, place):
            return place
    return None


def read_manifest(folder: Path) -> dict[str, Any]:
    """Content of the manifest of the artefact in ``folder``; empty if it has none, such as for a raw source."""
    place = manifest_place(folder)
    return _load(folder, place) if place else {}


def _load(folder: Path, place: str) -> dict[str, Any]:
    """The manifest of ``folder`` if it lies at ``place``: not somebody else's file, not that of a folder further up."""
    path = folder / place
    try:
        content = json.loads(path.read_bytes())
    except (FileNotFoundError, NotADirectoryError, IsADirectoryError, ValueError):
        return {}
    if (
        not isinstance(content, dict)
        or "taccorl_manifest" not in content
        or content.get("place") != place
    ):
        return {}
    if content["taccorl_manifest"] != FORMAT:
        raise LineageError(
            f"{path} has manifest format {content['taccorl_manifest']}, this taccorl ({taccorl.__version__}) reads "
            f"{FORMAT}. Update taccorl."
        )
    return content


def write_manifest(folder: Path, place: str, manifest: dict[str, Any]) -> None:
    """Write ``manifest`` to its ``place`` in ``folder``; when the function returns, the file survives a power cut."""
    write_durably(
        folder / place,
        json.dumps({"taccorl_manifest": FORMAT, "place": place} | manifest, indent=1)
        + "\n",
    )


def seal_checkpoint(
    folder: Path, keep: Collection[str] = (), stage: str = CHECKPOINT, place: str = ""
) -> None:
    """Write a manifest with the digests of the visible files of a checkpoint (or of a ``stage``, at ``place``); again when files
    are added. ``keep``: files whose digests in the present one are still right, so that weights of 14 GB are read once."""
    known, place = read_manifest(folder).get("files", {}), place or MANIFEST_PLACES[0]
    paths = {
        name: path
        for name, path in list_files(folder).items()
        if name not in (place, CARD)
    }
    files = {name: known.get(name) if name in keep else None for name in paths}
    files = {name: digest or digest_file(paths[name]) for name, digest in files.items()}
    digest = digest_files(files)
    about = {"stage": stage, "stage_version": 1, "key": digest[:16], "digest": digest}
    about |= {
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "seconds": 0.0,
    }
    about |= {
        "config": {},
        "config_not_default": {},
        "inputs": [],
        "software": software(),
    }
    write_manifest(folder, place, about | {"files": files})


def require_checkpoint(folder: Path, name: str) -> list[str]:
    """Compare a checkpoint's files with the digests beside them; they are read only if they changed since they were compared.
    Returns the files that have no digest: all of a checkpoint of another program. Raises LineageError: a file is damaged,
    changed or missing, or the list of digests is damaged."""
    place = folder / MANIFEST_PLACES[0]
    listed = read_manifest(folder).get("files", {})
    if not listed and place.is_file() and b"taccorl" in place.read_bytes():
        raise LineageError(
            f"{name}: {place.name} is damaged; copy the checkpoint again, or remove it to load without digests"
        )
    found = None if is_verified(folder) else verify(folder)
    if found and (
        bad := [
            *found.changed,
            *(f"{missing} (missing)" for missing in found.missing),
            *found.unreadable,
        ]
    ):
        more = f" and {len(bad) - 1} more files" if len(bad) > 1 else ""
        raise LineageError(
            f"{name}: {bad[0]}{more} {'are' if more else 'is'} damaged or changed since written: copy the checkpoint again, "
            f"or, if the change was intended, remove its {place.name}"
        )
    return [
        file
        for file in list_files(folder)
        if file not in listed and file not in (place.name, CARD)
    ]


def digests_now(folder: Path, cache: DigestCache | None = None) -> dict[str, str]:
    """``{relative path: digest}`` of the present files of a source folder or artefact: every visible file and every file that
    its manifest lists, except the manifest and a card that the manifest does not list. So the digest of an unchanged artefact
    equals that in its manifest."""
    place = manifest_place(folder)
    listed: Collection[str] = read_manifest(folder).get("files", {})
    digests = digest_each(folder, cache, also=listed)
    beside = {place} if place is None or CARD in listed else {place, CARD}
    return {name: digest for name, digest in digests.items() if name not in beside}


def content_digest(path: Path, cache: DigestCache | None = None) -> str:
    """SHA-256, 64 hexadecimal digits, of a file's bytes, or of the names and bytes of all files in a folder (``digests_now``)."""
    return (
        digest_files(digests_now(path, cache))
        if path.is_dir()
        else digest_file(path, cache)
    )


@dataclass(frozen=True)
class Verified:
    """Comparison of the files that a manifest lists with the files in the folder."""

    num_files: int
    """Number of files that the manifest lists."""
    changed: tuple[str, ...]
    """Relative paths of files whose content has changed since they were written."""
    missing: tuple[str, ...]
    """Relative paths of files that are not there."""
    unreadable: tuple[str, ...]
    """Relative path and reason of files that could not be read."""


def verify(folder: Path) -> Verified | None:
    """Read every file that the manifest in ``folder`` lists, and compare its SHA-256; None if there is no manifest of taccorl.

    No cache is used. Added files are ignored. If nothing differs, a hidden file in the folder records it for
    ``is_verified``, provided that the folder is writable. Raises LineageError: the manifest is damaged, or cannot be read."""
    try:
        place = manifest_place(folder)
    except (OSError, RecursionError) as error:
        raise LineageError(f"{folder}: its manifest cannot be read: {error}") from error
    if place is None:
        ours = folder / MANIFEST_PLACES[1]
        if ours.exists():
            raise LineageError(
                f"{ours}: is damaged or was written by another program: it does not state what was stored"
            )
        return None
    manifest = _load(folder, place)
    files = manifest.get("files")
    if (
        not isinstance(files, dict)
        or not files
        or manifest.get("digest") != digest_files(files)
    ):
        raise LineageError(
            f"{folder / place}: is damaged: the digest of its list of files differs from the stated one"
        )
    for name in files:
        if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
            raise LineageError(
                f"{folder / place}: is damaged: it lists {name!r}, which lies outside of {folder}"
            )
    with ThreadPoolExecutor(4) as pool:
        found = dict(
            zip(
                files,
                pool.map(lambda name: _read_again(folder / name), files),
                strict=True,
            )
        )
    seen = {name: digest for name, (digest, _, _) in found.items()}
    result = Verified(
        len(files),
        changed=tuple(
            name for name, digest in seen.items() if digest and digest != files[name]
        ),
        missing=tuple(name for name, (_, _, why) in found.items() if why == _MISSING),
        unreadable=tuple(
            f"{name} ({why})"
            for name, (_, _, why) in found.items()
            if why and why != _MISSING
        ),
    )
    if seen == files:
        with contextlib.suppress(OSError):
            marker = {
                "digest": manifest["digest"],
                "stamps": {name: mark for name, (_, mark, _) in found.items()},
            }
            (folder / place).with_name(_VERIFIED).write_text(
                json.dumps(marker), encoding="ascii"
            )
    return result


def _read_again(path: Path) -> tuple[str, list[int], str]:
    """SHA-256 of a file, size, times and inode from before it was read, and the reason if it could not be read."""
    try:
        if not path.is_file():
            return "", [], _MISSING
        before = stamp(path)  # a change while it is read leaves it unverified
        return digest_file(path), before, ""
    except (OSError, LineageError) as error:
        return "", [], getattr(error, "strerror", None) or str(error)


def is_verified(folder: Path) -> bool:
    """True if an earlier ``verify`` of ``folder`` found every file unchanged, and no size, time stamp or inode changed since."""
    try:
        place = manifest_place(folder)
        if place is None:
            return False
        marker = json.loads((folder / place).with_name(_VERIFIED).read_bytes())
        manifest = _load(folder, place)
        stamps = {name: stamp(folder / name) for name in manifest["files"]}
        return marker == {"digest": manifest["digest"], "stamps": stamps}
    except (OSError, ValueError, KeyError, TypeError, RecursionError, LineageError):
        return False


@functools.cache
def software() -> dict[str, str]:
    """Name → version of Python, taccorl and the installed packages that affect results; nothing about the host."""
    versions = {"python": platform.python_version(), "taccorl": taccorl.__version__}
    for package in RECORDED_PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return versions

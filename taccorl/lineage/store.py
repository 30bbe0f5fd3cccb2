"""Content-addressed store: a stage runs once for the same config and inputs, and survives ``kill -9`` at any point.

A stage is a plain function ``fn(config, inputs, out_dir)``. Its artefact is the folder ``root/<stage>/<key>`` with

    key = sha256(stage name, stage version, canonical config, digests of the inputs in order), first 16 hex digits.

The folder is built under a temporary name beside its final place, its manifest is written last, then one rename makes
it exist. So an artefact is either complete or not there. A lock per key (the kernel frees it when its holder dies)
lets a second run wait and find the artefact instead of making it again; under that lock, whatever a dead run left is
removed.

An artefact that is used again is compared with its manifest: a damaged one in the store is made anew, one at a destination is
refused. Sizes and times are compared always, contents (SHA-256, 1.8 GB/s and core) only of files for which no digest is known
at these times: those that are damaged, copied, or were used within 2 s of being written. So 50 GB of frames are not read twice.

A published file that equals one of an input in the store takes no space of its own where the file system allows: it is a clone
of that (reflink), else a hard link to it. What is edited in place through a hard link is then changed in the store, too, where
the comparison above finds it before it is used again. A file of the store is linked to one place at most, and ``meta``, which
LeRobot's commands change in place, to none.

The key knows contents, not names: a stage must not read meaning from an input's path. Put it into the config.
"""

import contextlib
import logging
import os
import re
import shutil
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from taccorl.errors import DISK_FAULTS, DatasetError, InTheWayError
from taccorl.lineage.ancestors import ancestors
from taccorl.lineage.canonical import (
    canonical,
    canonical_text,
    differences,
    not_default,
)
from taccorl.lineage.destinations import Destinations, is_free
from taccorl.lineage.digest import (
    READERS,
    DigestCache,
    digest_bytes,
    digest_each,
    digest_file,
    digest_files,
    is_settled,
    list_files,
    stamp,
)
from taccorl.lineage.errors import LineageError
from taccorl.lineage.files import clone_or_link, flush, this_process
from taccorl.lineage.manifest import (
    MANIFEST_PLACES,
    content_digest,
    manifest_place,
    read_manifest,
    software,
    write_manifest,
)
from taccorl.lineage.stage import Artefact, Stage

MARKER = "taccorl-store.txt"
"""Name of the file by which a folder is recognised as a store."""
MARKER_TEXT = "A taccorl store: every folder here can be made again. `taccorl lineage prune` frees space.\n"
KEY_DIGITS = 16
"""Number of hexadecimal digits of a key."""
LINKED_FROM_BYTES = 1 << 12
"""Least size of a file that is linked instead of copied: a smaller one takes one block of the disk."""
KEY = re.compile(rf"[0-9a-f]{{{KEY_DIGITS}}}")
"""Pattern of a key."""

logger = logging.getLogger(__name__)


class Store:
    """A folder of artefacts. It can be sent to other processes; all of them may use it at once."""

    def __init__(self, root: Path) -> None:
        """Open the store in folder ``root``; a missing or empty folder becomes a store when the first stage runs. Raises
        LineageError: ``root`` is a file, or a folder with other content."""
        self.root = Path(root).resolve()
        _check(self.root)
        self.digests = DigestCache(self.root / ".digests")
        self.destinations = Destinations(self.root / ".destinations")

    def make(self) -> None:
        """Create the store's folder if it does not exist, as the first stage would, so that a missing permission is found
        early. Raises OSError: the folder cannot be created."""
        _mark(self.root)
        self.digests.write_kept()

    def source(self, path: Path) -> Artefact:
        """A raw file or folder (or an earlier artefact, at any path), addressed by its present content."""
        path = Path(path).absolute()
        if path.is_dir() and not list_files(path):
            raise LineageError(
                f"{path} holds no files (files whose names start with a dot are not read)."
            )
        return Artefact(path, content_digest(path, self.digests))

    def dataset(self, root: Path) -> Artefact:
        """As ``source``, for a LeRobot dataset; checks that its files are unchanged, if it has a manifest. Its ``meta`` may
        differ, because LeRobot's commands recompute statistics in place. Raises LineageError: a file of ``data`` or
        ``videos`` was changed or removed."""
        damaged = self.damaged(root) if read_manifest(root) else []
        if changed := [
            name
            for name in damaged
            if name.startswith(("data/", "videos/", *MANIFEST_PLACES))
        ]:
            more = f" and {len(changed) - 1} more files" if len(changed) > 1 else ""
            raise LineageError(
                f"{root}: {changed[0]}{more} {'are' if more else 'is'} damaged or changed since written (taccorl lineage "
                f"explain {root}). Copy or make the dataset again; if the change was intended, use a copy of the folder "
                f"without {manifest_place(Path(root))}, which is then a new source"
            )
        return self.source(root)

    def key(self, stage: Stage, config: Any, inputs: Sequence[Artefact]) -> str:
        """Key of the artefact that ``stage`` makes from ``config`` and ``inputs``, 16 hexadecimal digits. Raises ConfigError:
        ``config`` has no plain-JSON form."""
        parts = [
            stage.name,
            str(stage.version),
            canonical_text(config),
            *(artefact.digest for artefact in inputs),
        ]
        return digest_bytes(*(part.encode() for part in parts))[:KEY_DIGITS]

    def find(
        self, stage: Stage, config: Any, inputs: Sequence[Artefact]
    ) -> Artefact | None:
        """The artefact, if the store has it undamaged; else None. Never runs a stage."""
        key = self.key(stage, config, inputs)
        found = _with_key(self._place(stage, key), key)
        return (
            found
            if found is not None and not self._warn_of_damage(found.path)
            else None
        )

    def damaged(self, folder: Path) -> list[str]:
        """Files of the artefact in ``folder`` that are not as its manifest lists them, as relative paths, or its manifest itself;
        empty if all are. A file is read only if its size or times are not those at which its digest was taken."""
        folder, manifest = Path(folder).absolute(), read_manifest(folder)
        files = manifest.get("files")
        if not isinstance(files, dict) or manifest.get("digest") != digest_files(files):
            return [manifest.get("place") or MANIFEST_PLACES[0]]

        def is_damaged(name: str) -> bool:
            try:
                return digest_file(folder / name, self.digests) != files[name]
            except (
                OSError,
                LineageError,
            ):  # missing, a folder, or a disk that does not read it
                return True

        with ThreadPoolExecutor(READERS) as pool:
            return [
                name
                for name, bad in zip(files, pool.map(is_damaged, files), strict=True)
                if bad
            ]

    def _warn_of_damage(self, folder: Path) -> bool:
        damaged = self.damaged(folder)
        if damaged:
            more = f" and {len(damaged) - 1} more files" if len(damaged) > 1 else ""
            logger.warning(
                "%s: %s%s damaged or changed since written, so that the artefact is not used",
                folder,
                damaged[0],
                more,
            )
        return bool(damaged)

    def find_key(self, key: str) -> Path | None:
        """The folder of the artefact with this key, whatever its stage; None if the store has none."""
        if not KEY.fullmatch(key):
            return None
        return next(
            (
                path
                for path in self.root.glob(f"[!.]*/{key}")
                if _is_own(path) and _is_own(path.parent)
            ),
            None,
        )

    def artefacts(self) -> list[Path]:
        """The folders of all artefacts, sorted by stage and key."""
        return [path for path in self.folders() if KEY.fullmatch(path.name)]

    def folders(self) -> list[Path]:
        """Every folder below a stage's folder, sorted by path: artefacts, and temporary folders of running or dead runs."""
        if not self.root.is_dir():
            return []
        stages = [
            path
            for path in sorted(self.root.iterdir())
            if _is_own(path) and not path.name.startswith(".")
        ]
        return [
            path
            for stage in stages
            for path in sorted(stage.iterdir())
            if _is_own(path)
        ]

    def run(
        self,
        stage: Stage,
        config: Any,
        inputs: Sequence[Artefact],
        *,
        destination: Path | None = None,
        sources: Sequence[Artefact] = (),
    ) -> Artefact:
        """Return the artefact of ``stage``; the stage is run if the store does not have it.

        Args:
            config: a dataclass or plain JSON data; passed to the stage unchanged.
            inputs: passed to the stage as paths, in this order.
            destination: publish the artefact there, outside the store, instead of under its key.
            sources: with a destination, the raw sources of this run, whose paths its manifest states. (A recording's artefact
                states only the path at which its content was first read.)

        Raises:
            DatasetError: ``destination`` has other content, which is not changed.
        """
        job = self._job(stage, config, list(inputs), destination, list(sources))
        if (found := self._existing(job)) is not None:
            if job.is_published:  # a store that was made anew knows it from now on
                self.destinations.remember(job.final, job.key)
            return found
        with self.lock(job.lock_name, what=f"{stage.name}, {job.final}"):
            for leftover in job.leftovers():
                shutil.rmtree(leftover)
            if (found := self._existing(job)) is not None:
                return found
            if not job.is_published and job.final.exists():
                self._warn_of_damage(job.final)
                shutil.rmtree(job.final)
            return self._make(job)

    def _job(
        self,
        stage: Stage,
        config: Any,
        inputs: list[Artefact],
        destination: Path | None,
        sources: list[Artefact],
    ) -> "_Job":
        key = self.key(stage, config, inputs)
        if destination is None:
            if sources:
                raise LineageError(
                    f"stage {stage.name}: `sources` are written into a destination's manifest, but there is no destination."
                )
            return _Job(
                stage,
                config,
                inputs,
                key,
                self._place(stage, key),
                lock_name=key,
                temp_prefix=f".{key}.",
            )
        final = Path(destination).absolute()
        final = (
            final.resolve() if is_free(final) else final.parent.resolve() / final.name
        )
        if final.is_relative_to(self.root) or self.root.is_relative_to(final):
            raise DatasetError(
                f"destination {final} and the store {self.root} contain one another; choose another."
            )
        lock_name = f"destination-{digest_bytes(str(final).encode())[:KEY_DIGITS]}"
        # Beside the user's folder: named after this store, whose lock alone tells if a temporary folder's maker lives.
        temp_prefix = (
            f".{final.name}.taccorl-{digest_bytes(str(self.root).encode())[:8]}-"
        )
        return _Job(
            stage,
            config,
            inputs,
            key,
            final,
            lock_name,
            temp_prefix,
            is_published=True,
            sources=sources,
        )

    def _make(self, job: "_Job") -> Artefact:
        for artefact in job.inputs:
            if not artefact.path.exists():
                raise LineageError(
                    f"stage {job.stage.name}: its input {artefact.path} no longer exists. Make or restore it first."
                )
        temp = job.final.with_name(
            f"{job.temp_prefix}{os.getpid()}-{os.urandom(2).hex()}"
        )
        temp.mkdir(parents=True)
        try:
            start_s = time.perf_counter()
            job.stage.fn(job.config, [artefact.path for artefact in job.inputs], temp)
            stamps = (
                {
                    name: stamp(path)
                    for name, path in list_files(temp, hidden=True).items()
                }
                if temp.is_dir()
                else {}
            )
            if job.is_published:
                self._share(temp, job.inputs)
                stamps = {
                    name: mark
                    for name, mark in stamps.items()
                    if stamp(temp / name) == mark
                }
            manifest = _seal(
                temp,
                job,
                time.perf_counter() - start_s,
                self._origins(job) if job.is_published else {},
            )
            if (
                job.is_published
            ):  # before it is there, so that it is never there unknown to prune
                self.destinations.remember(job.final, job.key)
            try:
                temp.rename(job.final)
            except OSError:  # something came to lie there meanwhile: the same artefact is as good as ours
                if (found := self._existing(job)) is None:
                    raise
                shutil.rmtree(temp, ignore_errors=True)
                return found
            flush(job.final.parent)
            for name, before in stamps.items():
                if is_settled(before):
                    self.digests.put(job.final / name, before, manifest["files"][name])
            return Artefact(job.final, manifest["digest"])
        except BaseException as error:
            if (
                isinstance(error, OSError)
                and error.errno in DISK_FAULTS
                and error.filename is None
            ):
                error.filename = str(
                    job.final
                )  # errors of writing to an open file name no place
            shutil.rmtree(temp, ignore_errors=True)
            raise

    def _share(self, temp: Path, inputs: Sequence[Artefact]) -> None:
        """Replace files below ``temp`` by clones of, or links to, equal files of those ``inputs`` that are in the store."""
        stored: dict[int, list[tuple[Path, str]]] = {}
        for artefact in inputs:
            if artefact.path.resolve().is_relative_to(self.root):
                for name, digest in artefact.manifest.get("files", {}).items():
                    with contextlib.suppress(OSError):
                        path = artefact.path / name
                        stored.setdefault(path.stat().st_size, []).append(
                            (path, digest)
                        )
        for name, path in list_files(temp).items():
            alike = stored.get(size := path.stat().st_size, [])
            if alike and size >= LINKED_FROM_BYTES and not name.startswith("meta/"):
                wanted = digest_file(path)
                with contextlib.suppress(
                    OSError, LineageError
                ):  # it goes on as the copy that it is
                    any(
                        digest == wanted == digest_file(source, self.digests)
                        and clone_or_link(source, path)
                        for source, digest in alike
                    )

    def _origins(self, job: "_Job") -> dict[str, Any]:
        """What a published manifest says more than one in the store: its sources, and what its inputs were made from."""
        each = dict.fromkeys(job.sources)  # a file of several recordings is named once
        sources = [
            {"path": str(source.path.absolute()), "digest": source.digest}
            for source in each
        ]
        return {
            "sources": sources,
            "ancestors": ancestors(
                [_entry(artefact) for artefact in job.inputs], self.find_key
            ),
        }

    def _existing(self, job: "_Job") -> Artefact | None:
        found = _with_key(job.final, job.key)
        damaged = self.damaged(job.final) if found is not None else []
        if not job.is_published:
            if job.final.is_mount():  # it cannot be renamed to, nor removed
                raise InTheWayError(_in_the_way(job))
            return None if damaged else found
        # LeRobot's commands change a dataset's meta in place
        changed = [
            name
            for name in damaged
            if name in MANIFEST_PLACES or not name.startswith("meta/")
        ]
        if changed:
            raise InTheWayError(
                f"{job.final} is what this run makes, but {changed[0]} is damaged or changed since written (taccorl lineage "
                f"explain {job.final}). Nothing was changed: give another destination (--out), or move that one away yourself."
            )
        if found is None and (not is_free(job.final) or job.final.is_mount()):
            raise InTheWayError(_in_the_way(job))
        return found

    def _place(self, stage: Stage, key: str) -> Path:
        return self.root / stage.name / key

    @contextlib.contextmanager
    def scratch(self, stage: Stage, config: Any) -> Iterator[Path]:
        """Context manager: a temporary folder in this store, for work from which ``stage`` will make an artefact. It is removed
        at the end; if the process dies, by the next use with the same ``config`` (plain JSON data), or by ``taccorl lineage
        prune``."""
        key = self.key(stage, config, [])
        folder = self._place(stage, key)
        with self.lock(key, what=f"{stage.name}, {folder}"):
            for leftover in folder.parent.glob(f".{key}.*"):
                shutil.rmtree(leftover)
            temp = folder.with_name(f".{key}.{os.getpid()}-{os.urandom(2).hex()}")
            temp.mkdir(parents=True)
            try:
                yield temp
            finally:
                shutil.rmtree(temp, ignore_errors=True)

    @contextlib.contextmanager
    def lock(self, name: str, *, wait: bool = True, what: str = "") -> Iterator[None]:
        """Context manager that holds the lock ``name`` of this store. The kernel releases the lock when its process ends.
        ``what``: description of the work under the lock, for the message of waiting processes; ``name`` if not given. Raises
        filelock.Timeout: another process holds it and ``wait`` is False."""
        self.make()
        folder = self.root / ".locks"
        folder.mkdir(exist_ok=True)
        # The lock file stays: removing it would let a waiter and a newcomer hold "the same" lock on two files.
        lock, holder = FileLock(folder / f"{name}.lock"), folder / f"{name}.holder"
        try:
            lock.acquire(timeout=0)
        except Timeout:
            if not wait:
                raise
            by = (
                holder.read_text(encoding="utf-8")
                if holder.is_file()
                else "another process"
            )
            logger.warning(
                "waiting for %s (store %s), held by %s; Ctrl-C ends this run",
                what or name,
                self.root,
                by,
            )
            lock.acquire()
        try:
            holder.write_text(this_process(), encoding="utf-8")
            yield
        finally:
            lock.release()


@dataclass(frozen=True)
class _Job:
    """One call of `Store.run`, with its key and places."""

    stage: Stage
    config: Any
    inputs: list[Artefact]
    key: str
    final: Path
    lock_name: str
    temp_prefix: str
    is_published: bool = False
    sources: list[Artefact] = field(default_factory=list)

    def leftovers(self) -> list[Path]:
        """Temporary folders of runs that died, if the lock is ours."""
        if not self.final.parent.is_dir():
            return []
        beside = self.final.parent.iterdir()
        return [
            path
            for path in beside
            if path.name.startswith(self.temp_prefix) and path.is_dir()
        ]


def is_store(root: Path) -> bool:
    """True if ``root`` was made by `Store`."""
    return (Path(root) / MARKER).is_file()


def _check(root: Path) -> None:
    if root.exists() and not root.is_dir():
        raise LineageError(f"store {root} is a file; give a folder.")
    if root.is_dir() and any(root.iterdir()) and not is_store(root):
        raise LineageError(
            f"{root} is not a taccorl store (it has no {MARKER}) and not empty. Give a new folder."
        )


def _mark(root: Path) -> None:
    if not is_store(root):
        _check(root)
        root.mkdir(parents=True, exist_ok=True)
        (root / MARKER).write_text(
            MARKER_TEXT
        )  # its existence is the mark, so a second writer does no harm
        logger.warning(
            "new store: %s keeps finished work, so that it is not repeated. --store=FOLDER (lerobot-train: "
            "--dataset.cache_store) names another place, taccorl lineage prune frees space",
            root,
        )


def _is_own(path: Path) -> bool:
    return path.is_dir() and not path.is_symlink()  # a link leads out of the store


def _with_key(folder: Path, key: str) -> Artefact | None:
    manifest = read_manifest(folder)
    return (
        Artefact(folder, manifest["digest"])
        if manifest.get("key") == key and "digest" in manifest
        else None
    )


def _seal(
    temp: Path, job: _Job, seconds: float, origins: dict[str, Any]
) -> dict[str, Any]:
    """Digest what the stage wrote, bring it to the disk, write the manifest; returns the manifest."""
    stage = job.stage
    files = digest_each(temp, hidden=True) if temp.is_dir() else {}
    if not files:
        raise LineageError(
            f"stage {stage.name} wrote no file into its folder, but an artefact must have one. Correct the stage."
        )
    if (
        place := stage.manifest if stage.manifest in files else manifest_place(temp)
    ) is not None:
        raise LineageError(
            f"stage {stage.name} wrote {place} itself, which only the store may write. Do not write it in the stage."
        )
    for name in files:
        flush(temp / name)
    manifest = {
        "stage": stage.name,
        "stage_version": stage.version,
        "key": job.key,
        "digest": digest_files(files),
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "seconds": round(seconds, 3),
        "config": canonical(job.config),
        "config_not_default": not_default(job.config),
        "inputs": [_entry(artefact) for artefact in job.inputs],
        **origins,
        "software": software(),
        "files": files,
    }
    write_manifest(temp, stage.manifest, manifest)
    for folder in {
        temp,
        *(
            path.parent
            for path in (temp / stage.manifest, *(temp / name for name in files))
        ),
    }:
        flush(folder)
    return manifest


def _entry(artefact: Artefact) -> dict[str, Any]:
    """An input as a manifest names it; with its key, unless it is raw or was changed since it was made."""
    manifest = artefact.manifest
    key = (
        manifest["key"] if manifest and manifest["digest"] == artefact.digest else None
    )
    return {"path": str(artefact.path), "digest": artefact.digest, "key": key}


def _in_the_way(job: _Job) -> str:
    wanted = f"{job.stage.name} v{job.stage.version}, key {job.key}"
    way_out = "Nothing was changed: give another destination (--out), or move that one away yourself."
    manifest = read_manifest(job.final)
    if not manifest:
        kind = (
            f"a folder of {sum(1 for _ in job.final.rglob('*'))} entries"
            if job.final.is_dir()
            else "a file"
        )
        return f"{job.final} is occupied: it is {kind} without a taccorl manifest; this run makes {wanted}. {way_out}"
    present = f"{manifest['stage']} v{manifest['stage_version']}, key {manifest['key']}, made {manifest['created']}"
    changes = differences(manifest["config"], canonical(job.config))
    if [entry["digest"] for entry in manifest["inputs"]] != [
        artefact.digest for artefact in job.inputs
    ]:
        changes.append(
            f"inputs: {len(manifest['inputs'])} then, {len(job.inputs)} now, not the same content"
        )
    return (
        f"{job.final} is occupied: it holds {present}; this run makes {wanted} "
        f"({'; '.join(changes) or 'same config and inputs'}). {way_out}"
    )

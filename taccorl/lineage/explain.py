"""Explain an artefact: a tree, as text, of its inputs down to the raw recordings, with everything that changed since.

``✗`` marks what no longer matches its record: a changed, missing or added file, or a raw source that is gone. An artefact that
was removed from the store is not marked, because the dataset contains its record.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from taccorl.lineage.canonical import flatten
from taccorl.lineage.digest import DigestCache, digest_files
from taccorl.lineage.errors import LineageError
from taccorl.lineage.manifest import content_digest, digests_now, read_manifest
from taccorl.lineage.store import Store

SHOWN = 12  # hex digits of a digest; changed files by name
SHOWN_ITEMS = 4  # of a list in a config
SHOWN_LETTERS = 400  # of a config: a spec or a twin goes with it whole


@dataclass
class Origin:
    """Node of the lineage tree: one artefact or raw source, its differences from the record, and its inputs."""

    title: str
    """First line of the node."""
    lines: list[str] = field(default_factory=list)
    """Further lines: configuration, software, time."""
    problems: list[str] = field(default_factory=list)
    """Differences from the record, a line each."""
    inputs: list["Origin"] = field(default_factory=list)
    """Nodes of what it was made from."""

    def num_problems(self) -> int:
        """Number of entries that no longer match their record, here and in all ancestors."""
        return len(self.problems) + sum(origin.num_problems() for origin in self.inputs)


def trace(path: Path, store: Store | None) -> Origin:
    """Lineage of ``path`` (an artefact, a dataset, a file in one, or a raw source) as a tree: its node, whose ``inputs`` are the
    nodes of what it was made from. ``store``: where inputs that are no longer at their recorded path are searched, and whose
    cache of file hashes saves reading files again; None: neither. Raises LineageError: ``path`` does not exist."""
    path = Path(path).absolute()
    if not path.exists():
        raise LineageError(f"{path} does not exist: nothing to explain.")
    folder = _artefact_around(path)
    tracer = _Tracer(store)
    return (
        tracer.raw(path, recorded=None) if folder is None else tracer.artefact(folder)
    )


def _artefact_around(path: Path) -> Path | None:
    """``path`` or the nearest folder above it whose manifest knows it."""
    for folder in (path, *path.parents):
        if manifest := read_manifest(folder):
            inside = path.relative_to(folder).as_posix()
            known = [*manifest["files"], manifest["place"]]
            if inside == "." or any(
                name == inside or name.startswith(f"{inside}/") for name in known
            ):
                return folder
    return None


class _Tracer:
    """Walks the manifests; says each thing once."""

    def __init__(self, store: Store | None) -> None:
        self.store = store
        self.cache: DigestCache | None = store.digests if store else None
        self.said: set[Path | str] = set()
        self.software: dict[str, str] = {}
        self.carried: dict[str, dict[str, Any]] = {}
        self.listed: set[str] = (
            set()
        )  # digests of the sources that the datasets above name

    def artefact(self, folder: Path, recorded: str | None = None) -> Origin:
        manifest = read_manifest(folder)
        title = _title(manifest)
        if folder in self.said:
            return Origin(f"{title}  (see above)")
        self.said.add(folder)
        now = digests_now(folder, self.cache)
        origin = Origin(
            title, self.lines(folder, manifest), _changes(manifest["files"], now)
        )
        if recorded not in (None, manifest["digest"], digest_files(now)):
            origin.problems.append(
                f"holds something else now: {_digest(str(recorded))} went into the step above"
            )
        origin.inputs = self.inputs(manifest)
        return origin

    def inputs(self, manifest: dict[str, Any]) -> list[Origin]:
        """The sources that the manifest itself names, then what it was made from."""
        self.carried |= manifest.get("ancestors", {})
        sources, above = manifest.get("sources", []), self.listed
        self.listed = above | {source["digest"] for source in sources}
        origins = [
            self.source(Path(source["path"]), source["digest"]) for source in sources
        ]
        origins += [self.input(entry) for entry in manifest["inputs"]]
        self.listed = above
        return origins

    def lines(self, folder: Path, manifest: dict[str, Any]) -> list[str]:
        made = f"made {manifest['created']} in {manifest['seconds']} s"
        if (
            manifest["software"] != self.software
        ):  # mostly the same for the whole tree: said once
            self.software = manifest["software"]
            made += " by " + ", ".join(
                f"{name} {version}" for name, version in self.software.items()
            )
        return [
            f"at {folder}: {len(manifest['files'])} files",
            made,
            f"config: {_config(manifest)}",
        ]

    def input(self, entry: dict[str, Any]) -> Origin:
        path, recorded, key = Path(entry["path"]), entry["digest"], entry["key"]
        if (
            key is None and recorded in self.listed
        ):  # equal content was read before, perhaps from elsewhere
            return Origin(f"source  {_digest(recorded)}  first read from {path}")
        if (
            not path.exists()
            and key
            and self.store
            and (moved := self.store.find_key(key))
        ):
            path = moved
        if path.exists() and read_manifest(path):
            return self.artefact(path, recorded)
        if not path.exists() and key in self.carried:
            return self.gone(path, self.carried[key])
        if not path.exists() and key:
            title = f"artefact of key {key}  {path}  {_digest(recorded)}"
            return Origin(
                title, problems=["missing: there is nothing at this path now"]
            )
        return self.source(path, recorded)

    def gone(self, path: Path, manifest: dict[str, Any]) -> Origin:
        """An artefact of which only the record is left, in the dataset that was made from it."""
        key = manifest["key"]
        if key in self.said:
            return Origin(f"{_title(manifest)}  (see above)")
        self.said.add(key)
        where = (
            f"not in the store any more: {path}"
            if path.name == key
            else f"not there any more: {path}"
        )
        origin = Origin(
            _title(manifest),
            [where, f"made {manifest['created']}", f"config: {_config(manifest)}"],
        )
        origin.inputs = self.inputs(manifest)
        return origin

    def source(self, path: Path, recorded: str) -> Origin:
        if path.exists():
            return self.raw(path, recorded)
        return Origin(
            f"source  {path}  {_digest(recorded)}",
            problems=["missing: there is nothing at this path now"],
        )

    def raw(self, path: Path, recorded: str | None) -> Origin:
        now = content_digest(path, self.cache)
        origin = Origin(f"source  {path}  {_digest(recorded or now)}")
        if recorded not in (None, now):
            origin.problems.append(f"changed since: {_digest(now)} now")
        return origin


def _title(manifest: dict[str, Any]) -> str:
    return f"{manifest['stage']} v{manifest['stage_version']}  key {manifest['key']}  {_digest(manifest['digest'])}"


def _config(manifest: dict[str, Any]) -> str:
    text = " ".join(_settings(manifest).split())  # a file's text has lines of its own
    return (
        text
        if len(text) <= SHOWN_LETTERS
        else f"{text[:SHOWN_LETTERS]}… ({len(text)} characters, all in its manifest.json)"
    )


def _settings(manifest: dict[str, Any]) -> str:
    changed = manifest["config_not_default"]
    if changed is not None:
        text = ", ".join(
            f"{name}={_readable(value)}" for name, value in changed.items()
        )
        return f"{text} (all else at its default)" if text else "all at its default"
    settings = {
        name: value
        for name, value in flatten(manifest["config"]).items()
        if value is not None
    }
    return (
        ", ".join(
            f"{name or 'value'}={_readable(value)}" for name, value in settings.items()
        )
        or "none"
    )


def _readable(value: Any) -> str:
    """A setting for the eye: text as it is, nothing for what is not set, the first few of a long list."""
    if isinstance(value, dict):
        return (
            "{"
            + ", ".join(
                f"{name}: {_readable(v)}" for name, v in value.items() if v is not None
            )
            + "}"
        )
    if isinstance(value, list):
        shown = [_readable(item) for item in value if item is not None]
        more = (
            [f"… {len(shown) - SHOWN_ITEMS} more"] if len(shown) > SHOWN_ITEMS else []
        )
        return f"[{', '.join(shown[:SHOWN_ITEMS] + more)}]"
    if value is None or isinstance(value, bool):
        return str(value).lower()
    return str(value)


def _changes(then: dict[str, str], now: dict[str, str]) -> list[str]:
    """Files that differ from the manifest, the first few by name."""
    found = [
        f"changed since: {name}, {_digest(then[name])} then, {_digest(now[name])} now"
        for name in then
        if name in now and now[name] != then[name]
    ]
    found += [
        f"missing: {name}, {_digest(then[name])} then"
        for name in then
        if name not in now
    ]
    found += [f"added since: {name}" for name in now if name not in then]
    return (
        found
        if len(found) <= SHOWN
        else [*found[:SHOWN], f"and {len(found) - SHOWN} more files like these"]
    )


def _digest(digest: str) -> str:
    return f"digest {digest[:SHOWN]}"


def render(origin: Origin) -> str:
    """Text of the tree, one line per fact, with a summary in the last line."""
    wrong = origin.num_problems()
    verdict = (
        f"✗ differs from the record in {wrong} place{'s' * (wrong > 1)}"
        if wrong
        else "✓ everything is as it was recorded"
    )
    return "\n".join([*_tree(origin), verdict])


def _tree(origin: Origin) -> list[str]:
    inner = "│  " if origin.inputs else "   "
    lines = [
        origin.title,
        *(f"{inner}{line}" for line in origin.lines),
        *(f"{inner}✗ {p}" for p in origin.problems),
    ]
    for i, child in enumerate(origin.inputs):
        last = i == len(origin.inputs) - 1
        first, *rest = _tree(child)
        lines.append(f"{'└─ ' if last else '├─ '}{first}")
        lines += [f"{'   ' if last else '│  '}{line}" for line in rest]
    return lines

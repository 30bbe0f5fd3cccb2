"""taccorl lineage explain PATH [--store=outputs/store]
taccorl lineage prune [--store=outputs/store] [--keep=DATASET ...] [--yes=true]

explain  list the inputs of a dataset or artefact, down to the raw recordings, and those that
         changed since (exit status 1 if any did)
prune    list artefacts that no dataset needs; delete them with --yes=true. Datasets are found where
         they were written; name moved or copied ones with --keep
"""

import sys
from dataclasses import dataclass, field
from pathlib import Path

from taccorl.cli.parse import parse
from taccorl.errors import TaccorlError, nearest

DEFAULT_STORE = Path("outputs/store")
"""Store that commands use if none is given."""
SHOWN_GONE = 10
"""Most paths of removed datasets that are listed."""


@dataclass(kw_only=True)
class ExplainConfig:
    """List the inputs of a dataset or artefact."""

    path: Path
    """A dataset, an artefact, a file in one of them, or a raw recording."""
    store: Path = DEFAULT_STORE
    """Store in which inputs that were moved are searched; it may be missing."""


@dataclass(kw_only=True)
class PruneConfig:
    """List, or delete, artefacts that no dataset needs."""

    store: Path = DEFAULT_STORE
    """The store to clean up."""
    keep: list[Path] = field(default_factory=list)
    """Moved or copied datasets whose lineage must stay. Repeat --keep=DATASET for each."""
    yes: bool = False
    """Delete the artefacts. Without it they are only listed."""


def main(argv: list[str]) -> int:
    """Run ``taccorl lineage`` with the words ``argv`` after it; returns the exit status: of ``explain``, or 0."""
    if not argv or argv[0] in ("-h", "--help"):
        print(__doc__)
        return 0
    if argv[0] == "explain":
        return explain(
            parse(
                ExplainConfig,
                argv[1:],
                positional="path",
                prog="taccorl lineage explain",
            )
        )
    if argv[0] == "prune":
        return _prune(parse(PruneConfig, argv[1:], prog="taccorl lineage prune"))
    raise TaccorlError(f"no verb {argv[0]!r}; {nearest(argv[0], ('explain', 'prune'))}")


def explain(config: ExplainConfig) -> int:
    """Print the inputs of a dataset or artefact. Returns the exit status, 0: everything is as it was recorded, 1: something
    changed or is missing."""
    from taccorl.lineage.explain import render, trace
    from taccorl.lineage.prune import open_store

    if config.store.exists() or config.store != DEFAULT_STORE:
        store = open_store(config.store)
    else:
        store = None
    origin = trace(config.path, store)
    print(render(origin))
    return 1 if origin.num_problems() else 0


def _prune(config: PruneConfig) -> int:
    from taccorl.lineage.prune import delete, open_store, unneeded

    store = open_store(config.store)
    folders = unneeded(store, config.keep)
    for folder in folders:
        note = "  (left by a run that died)" if folder.is_leftover else ""
        print(f"{_megabytes(folder.size_bytes)}  {folder.path}{note}")
    total = _megabytes(sum(folder.size_bytes for folder in folders)).strip()
    num_kept = len(
        {path.resolve() for path in (*store.destinations.present(), *config.keep)}
    )
    print(
        f"not needed for {_count(num_kept, 'dataset')}: {len(folders)} of {_count(len(store.folders()), 'folder')} "
        f"in {store.root}, {total}"
    )
    if gone := store.destinations.gone():
        print(
            f"{_count(len(gone), 'dataset')} gone or moved; name moved ones with --keep=DATASET:"
        )
        for path in gone[:SHOWN_GONE]:
            print(f"  {path}")
    if not folders or not config.yes:
        if folders:
            print("Nothing was deleted; add --yes=true to delete them.")
        return 0
    busy = delete(store, folders)
    print(f"Deleted {_count(len(folders) - len(busy), 'folder')}.")
    for folder in busy:
        print(
            f"Not deleted, because a run is using it now: {folder.path}",
            file=sys.stderr,
        )
    return 0


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'s' * (number != 1)}"


def _megabytes(size_bytes: int) -> str:
    return f"{size_bytes / 1e6:10.1f} MB"

"""Finding of a check in an episode: stable name, severity, place, and text with the remedy."""

from dataclasses import dataclass
from typing import Literal

LEAVE_OUT = (
    "leave the episode out (`lerobot-edit-dataset --repo_id=local/OLD --root=OLD --new_repo_id=local/NEW --new_root=NEW "
    "--operation.type=delete_episodes --operation.episode_indices=[NUMBER]` writes a dataset without it)"
)
"""Way out of a finding about wrong rows within an episode; no command removes single rows."""
Severity = Literal["error", "warning", "note"]
"""``error``: the episode's data is wrong; ``warning``: it should be looked at; ``note``: worth knowing."""


@dataclass(frozen=True)
class Finding:
    """One finding about one episode, or about one episode compared with the others of its recording."""

    check: str
    """Short stable name, e.g. ``joint_limit``."""
    severity: Severity
    """error: the episode's data is wrong, ingest quarantines it; warning: look at it; note: worth knowing."""
    feature: str
    """Name of the feature, or of the channel if the finding is about timing."""
    text: str
    """Message: the thing, the value, the place and the remedy."""
    rows: tuple[int, int] | None = None
    """First row and last row + 1 of the finding; None if it is about the whole episode."""
    topic: str = ""
    """Subject that findings on several features share; those with one topic are printed in one line. Empty: none."""


def not_judged(feature: str, what: str, why: str, topic: str = "") -> Finding:
    """Return a note (not a fault) on ``feature``: a check could not examine ``what``, for the reason ``why``.

    Args:
        topic: as in ``Finding``; ``what`` if empty.
    """
    return Finding("not_judged", "note", feature, f"{what} not judged: {why}", topic=topic or what)


def place(rows: tuple[int, int], fps: int) -> str:
    """Text of a row range, such as ``rows 30 to 44 (1.00 to 1.50 s)``."""
    return f"rows {rows[0]} to {rows[1] - 1} ({rows[0] / fps:.2f} to {rows[1] / fps:.2f} s)"


def listed(names: list[str], most: int = 4) -> str:
    """Text of the first ``most`` names, and the number of further ones."""
    rest = len(names) - most
    return ", ".join(names[:most]) + (f" and {rest} more" if rest > 0 else "")

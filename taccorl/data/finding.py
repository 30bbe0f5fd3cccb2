"""Finding of a check in an episode: stable name, severity, place, and text with the remedy."""

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

LEAVE_OUT = "leave this recording out"
"""Way out of a finding about wrong rows within an episode; no command removes single rows. For a dataset, ``leave_out`` is put in
its place."""
Severity = Literal["error", "warning", "note"]
"""``error``: the episode's data is wrong, ingest quarantines it; ``warning``: look at it; ``note``: worth knowing."""
CHECKS: dict[Severity, tuple[str, ...]] = {
    "error": (
        *("not_finite", "joint_limit", "out_of_range", "swapped_arms", "swapped_pads", "noise_only"),
        *("totals", "episode_rows", "row_index", "row_time", "dataset_index", "tasks", "statistics"),  # of a dataset
    ),
    "warning": (
        *("low_rate", "gaps", "old_samples", "jump", "idle", "frozen_state", "picture_size"),
        "sample_jump",  # between a channel's own samples
        *("dead_command", "frozen_command", "copied_command", "command_scale", "unexplained_motion"),
        "action_lag",  # too long, or not as the other arm's or episodes'; error: command after state
        "frozen_picture",  # error: half of the episode or more
        *("dead_taxel", "stuck_taxel", "noisy_pad", "frozen_touch", "silent_pad", "pad_lag"),
        "saturated",  # note: a few rows
        "touch_lag",  # error: too early on one arm and too late on the other
        *("baseline_drift", "baseline_offset"),
    ),
    "note": (
        *("duplicates", "out_of_order", "zero_stamps", "skipped"),
        *("unknown", "contact_coverage", "touch_range", "not_judged"),
    ),
}
"""Severity → the checks of episodes and datasets that have it, unless the finding itself states another. Thresholds stand beside
the functions that find them, with unit and reason."""
SEVERITIES: dict[str, Severity] = {check: severity for severity, checks in CHECKS.items() for check in checks}


@dataclass(frozen=True)
class Finding:
    """One finding about one episode, or about one episode compared with the others of its recording."""

    check: str
    """Short stable name, e.g. ``joint_limit``."""
    severity: Severity
    feature: str
    """Name of the feature, or of the channel if the finding is about timing."""
    text: str
    """Message: the thing, the value, the place and the remedy."""
    rows: tuple[int, int] | None = None
    """First row and last row + 1 of the finding; None if it is about the whole episode."""
    topic: str = ""
    """Subject that findings on several features share; those with one topic are printed in one line. Empty: none."""


def finding(
    check: str, feature: str, text: str, rows: tuple[int, int] | None = None, severity: Severity | None = None
) -> Finding:
    """Finding of a check in ``SEVERITIES``, with the severity that stands there if none is given."""
    return Finding(check, severity or SEVERITIES[check], feature, text, rows)


def leave_out(root: Path, number: int) -> str:
    """Return the advice for a faulty episode: the two shell commands that write a copy of the dataset at ``root`` (absolute)
    without episode ``number``."""
    new = root.with_name(f"{root.name}_without_{number}")
    old_root, new_root, spec, beside = (
        shlex.quote(str(p)) for p in (root, new, root / "meta/taccorl/dataset_spec.json", new / "meta/taccorl")
    )
    return (
        f"leave the episode out (`lerobot-edit-dataset --repo_id=local/old --root={old_root} --new_repo_id=local/new "
        f"--new_root={new_root} --operation.type=delete_episodes --operation.episode_indices=[{number}]` writes a dataset "
        f"without it; `install -D {spec} -t {beside}` keeps its units and pads, which LeRobot leaves behind)"
    )


def recompute_statistics(root: Path, *words: str) -> str:
    """LeRobot's command that computes ``meta/stats.json`` of the dataset at ``root`` anew, in place, without the pictures'.
    ``words``: its further options."""
    repo_id, folder = shlex.quote(f"local/{root.name}"), shlex.quote(str(root))
    place = f"--repo_id={repo_id} --root={folder} --new_root={folder}"  # without new_root it writes a copy in LeRobot's home
    return " ".join(
        ("lerobot-edit-dataset", place, "--operation.type=recompute_stats --operation.overwrite=true", *words)
    )


def not_judged(feature: str, what: str, why: str, topic: str = "") -> Finding:
    """Return a note (not a fault) on ``feature``: a check could not examine ``what``, for the reason ``why``. ``topic``: as
    in ``Finding``; ``what`` if empty."""
    return Finding("not_judged", "note", feature, f"{what} not judged: {why}", topic=topic or what)


def place(rows: tuple[int, int], fps: int) -> str:
    """Text of a row range, such as ``rows 30 to 44 (1.00 to 1.50 s)``."""
    return f"rows {rows[0]} to {rows[1] - 1} ({rows[0] / fps:.2f} to {rows[1] / fps:.2f} s)"


def listed(names: list[str], most: int = 4) -> str:
    """Text of the first ``most`` names, and the number of further ones."""
    rest = len(names) - most
    return ", ".join(names[:most]) + (f" and {rest} more" if rest > 0 else "")

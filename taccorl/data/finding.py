"""Findings of checks: stable name, severity, place, and a text with the remedy; and the list of all checks."""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

LEAVE_OUT = "leave this recording out"
"""Way out of a finding about wrong rows; for an episode of a dataset, ``leave_out`` is put in its place."""
Severity = Literal["error", "warning", "note"]
"""``error``: the data is wrong, ingest quarantines the episode; ``warning``: look at it; ``note``: worth knowing."""


@dataclass(frozen=True)
class Finding:
    """One finding about one episode, or about one episode compared with the others of its recording."""

    check: str
    severity: Severity
    feature: str
    """Name of the feature, or of the channel if the finding is about timing."""
    text: str
    rows: tuple[int, int] | None = None
    """First row and last row + 1 of the finding; None if it is about the whole episode."""
    topic: str = ""
    """Findings with one topic are printed in one line. Empty: none."""


CHECKS: dict[str, Severity] = {
    **dict.fromkeys(
        ("not_finite", "joint_limit", "out_of_range", "swapped_arms", "swapped_pads"),
        "error",
    ),
    **dict.fromkeys(
        (
            "noise_only",
            "totals",
            "episode_rows",
            "row_index",
            "row_time",
            "dataset_index",
        ),
        "error",
    ),
    **dict.fromkeys(("tasks", "statistics"), "error"),
    **dict.fromkeys(
        (
            "jump",
            "sample_jump",
            "idle",
            "frozen_state",
            "dead_command",
            "copied_command",
            "dead_state",
            "same_command",
            "touch_zeros",
            "touch_by_peak",
        ),
        "warning",
    ),
    **dict.fromkeys(
        (
            "frozen_command",
            "command_scale",
            "action_lag",
            "unexplained_motion",
            "silent_pad",
        ),
        "warning",
    ),
    **dict.fromkeys(
        (
            "stuck_taxel",
            "dead_taxel",
            "saturated",
            "noisy_pad",
            "frozen_touch",
            "touch_lag",
        ),
        "warning",
    ),
    **dict.fromkeys(
        (
            "pad_lag",
            "baseline_drift",
            "baseline_offset",
            "frozen_picture",
            "picture_size",
        ),
        "warning",
    ),
    **dict.fromkeys(("low_rate", "gaps", "old_samples"), "warning"),
    **dict.fromkeys(
        (
            "touch_range",
            "contact_coverage",
            "duplicates",
            "out_of_order",
            "zero_stamps",
        ),
        "note",
    ),
    **dict.fromkeys(("skipped", "constant_element", "averaged_quantiles"), "note"),
    "rare_motion": "warning",
}
"""Name of every check → its severity, unless the finding itself states another. Thresholds stand beside the functions."""


def finding(
    name: str,
    feature: str,
    text: str,
    rows: tuple[int, int] | None = None,
    severity: Severity | None = None,
) -> Finding:
    """Finding of a check in ``CHECKS``, with the severity that stands there if none is given."""
    return Finding(name, severity or CHECKS[name], feature, text, rows)


def leave_out(root: Path, number: int) -> str:
    """The two commands that write a copy of the dataset at ``root`` (absolute) without episode ``number``."""
    new = root.with_name(f"{root.name}_without_{number}")
    old_root, new_root, spec, beside = (
        shlex.quote(str(path))
        for path in (
            root,
            new,
            root / "meta/taccorl/dataset_spec.json",
            new / "meta/taccorl",
        )
    )
    own = f"; `install -D {spec} -t {beside}` keeps its units and pads, which LeRobot leaves behind"
    return (
        f"leave the episode out (`lerobot-edit-dataset --repo_id=local/old --root={old_root} --new_repo_id=local/new "
        f"--new_root={new_root} --operation.type=delete_episodes --operation.episode_indices=[{number}]` writes a dataset "
        f"without it{own * (root / 'meta/taccorl/dataset_spec.json').is_file()})"
    )


def recompute_statistics(root: Path, *words: str) -> str:
    """LeRobot's command that computes ``meta/stats.json`` anew, in place, without the pictures'. ``words``: more options."""
    repo_id, folder = shlex.quote(f"local/{root.name}"), shlex.quote(str(root))
    place = f"--repo_id={repo_id} --root={folder} --new_root={folder}"  # without new_root it writes a copy in LeRobot's home
    operation = "--operation.type=recompute_stats --operation.overwrite=true"
    return " ".join(("lerobot-edit-dataset", place, operation, *words))


def not_judged(feature: str, what: str, why: str, topic: str = "") -> Finding:
    """Note that a check could not examine ``what``. ``topic``: as in ``Finding``; ``what`` if empty."""
    return Finding(
        "not_judged",
        "note",
        feature,
        f"{what} could not be checked: {why}",
        topic=topic or what,
    )


def place(rows: tuple[int, int], fps: int) -> str:
    """Text of a row range, such as ``rows 30 to 44 (1.00 to 1.50 s)``."""
    return f"rows {rows[0]} to {rows[1] - 1} ({rows[0] / fps:.2f} to {rows[1] / fps:.2f} s)"


def listed(names: Sequence[str], most: int = 4) -> str:
    """Text of the first ``most`` names, and the number of further ones."""
    rest = len(names) - most
    return ", ".join(names[:most]) + (f" and {rest} more" if rest > 0 else "")

"""Different grips of source demonstrations: where a held part lies in the hand that holds it.

Generated episodes repeat the grips of their sources. A policy that sees few of them recognises the grip instead of measuring
where the part lies, and fails where its own grips lie elsewhere.
"""

import shlex
from collections.abc import Sequence
from typing import Any

import numpy as np

from taccorl.episodes.sources.mimicgen.source import Source
from taccorl.robots import ROBOT

SAME_M, SAME_RAD = 0.5e-3, np.radians(1.0)
"""Two grips are the same if the part lies less than this apart in the hand [m] and [rad]."""
FEWEST = 50
"""Fewer different grips of a part are too few to learn from."""


def tcp_from_part(source: Source, arm: str, part: str) -> np.ndarray | None:
    """(4, 4) pose of the part in the hand: of the rows in which both pads touch it and nothing else than hands does, the middle
    one; where there is none, of those in which both pads touch it. None if they never do.
    """
    held = source.held[arm][part]
    rows = np.flatnonzero(held & source.free[part])
    rows = rows if rows.size else np.flatnonzero(held)
    if not rows.size:
        return None
    row = rows[len(rows) // 2]
    return np.linalg.inv(source.arms[arm].tcp[row]) @ source.objects[part][row]


def is_same(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether two poses (4, 4) differ by less than ``SAME_M`` and ``SAME_RAD``."""
    angle_rad = np.arccos(
        np.clip((np.trace(one[:3, :3].T @ other[:3, :3]) - 1) / 2, -1, 1)
    )
    return bool(
        np.linalg.norm(one[:3, 3] - other[:3, 3]) < SAME_M and angle_rad < SAME_RAD
    )


def grips_report(sources: Sequence[Source]) -> dict[str, Any]:
    """JSON values for a report. ``hands``, for each arm and each part that it holds in a source: ``arm``, ``part``, ``sources``
    (number of sources in which both pads of the gripper hold the part) and ``different`` (number of different grips in these: a
    grip is new if it is at least ``SAME_M`` or ``SAME_RAD`` from all that were counted before, as is that of a round part turned
    about its axis). ``few``: whether one of the ``different`` is below ``FEWEST``."""
    found = []
    for arm in ROBOT.arms:
        for part in sources[0].held[arm]:
            poses = [
                pose
                for source in sources
                if (pose := tcp_from_part(source, arm, part)) is not None
            ]
            different: list[np.ndarray] = []
            for pose in poses:
                if not any(is_same(pose, known) for known in different):
                    different.append(pose)
            if poses:
                found.append(
                    {
                        "arm": arm,
                        "part": part,
                        "sources": len(poses),
                        "different": len(different),
                    }
                )
    return {"hands": found, "few": any(grips["different"] < FEWEST for grips in found)}


def grips_words(report: dict[str, Any]) -> str:
    """The numbers of ``grips_report`` as a line."""
    each = (
        f"{g['part']} in the {g['arm']} hand {g['different']} of {g['sources']} sources"
        for g in report["hands"]
    )
    return "different grips: " + (
        ", ".join(each) or "no hand holds a part with both pads"
    )


def grips_warning(task: str) -> tuple[str, str]:
    """Why few grips are too few, and the command that makes many demonstrations whose grips differ."""
    words = [
        "taccorl",
        "collect",
        f"--task={task}",
        "--episodes=3500",
        "--source.hands.grasp_m=0.004",
    ]
    words += [
        "--source.hands.grasp_rad=0.06",
        "--source.hands.pulse_rad=0.02",
        "--pictures=cache",
    ]
    words += ["--resolution=84x112", "--part_poses=true", f"--out=outputs/{task}_many"]
    why = (
        f"fewer than {FEWEST} different grips: policies learn to recognise few grips instead of measuring where a part lies in "
        "the hand: 33 % success on assembly_1 after 1000 demonstrations of 10 grips, 91 % after 1000 of the expert's, each with "
        "its own (simulated; docs/learning.md). Many grips"
    )
    return why, shlex.join(words)

"""Find frozen cameras: a camera that repeats one picture while joints move.

Two signs are used: the same source picture on many rows (``Episode.picture_rows``), and decoded pictures that do not
change. Each picture is compared as block means in grey levels, so that neither noise nor the video codec affects the result.
"""

import cv2
import numpy as np

from taccorl.data.arms import STATE, element_names, element_units, find_arms
from taccorl.data.episode import Episode, Pictures
from taccorl.data.finding import LEAVE_OUT, Finding, not_judged, place
from taccorl.data.joint_checks import FROZEN_S
from taccorl.data.timing import runs

THUMB_PX = 28
"""Block means per side of a picture: 8 × 8 pixels each at 224 × 224. Sensor noise of 3 levels changes a mean by about 0.4."""
SAME_LEVELS = 2.0  # Pictures are the same if all their block means differ by less than this [grey levels of 255]
SIGHT_RAD = 0.3  # Joint rotation that must be visible in a picture [rad]: it moves the hand by 12 cm at 0.4 m
FROZEN_SHARE = 0.5
"""Share of an episode's rows with a frozen picture from which on the finding is an error; below it is a warning."""
DARK_LEVEL = 4.0  # Mean grey level [of 255] below which a frozen picture counts as dark


def thumbnail(picture: np.ndarray) -> np.ndarray:
    """(THUMB_PX, THUMB_PX) float32 grey block means (0 … 255) of ``picture`` (rows, columns, 3) uint8 RGB."""
    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    return cv2.resize(grey.astype(np.float32), (THUMB_PX, THUMB_PX), interpolation=cv2.INTER_AREA)


def same_picture_runs(thumbs: np.ndarray) -> list[tuple[int, int]]:
    """Return the runs [first, last + 1) of pictures that all resemble the first of the run; ``thumbs`` (T, h, w) are
    ``thumbnail``s.

    Compared with the first one, not the one before: a slow change adds up and ends the stretch.
    """
    found, first = [], 0
    for row in range(1, len(thumbs) + 1):
        if row == len(thumbs) or np.abs(thumbs[row] - thumbs[first]).max() >= SAME_LEVELS:
            found.append((first, row))
            first = row
    return found


class PictureWatch:
    """Finds frozen cameras from an episode's pictures, row by row, while they are decoded for another purpose (writing)."""

    def __init__(self, episode: Episode) -> None:
        self.episode = episode
        self.restart()

    def restart(self) -> None:
        """Start again from the episode's first row."""
        self._thumbs: dict[str, list[np.ndarray]] = {key: [] for key in self.episode.picture_keys}

    def see(self, pictures: Pictures) -> None:
        """Add the pictures of the next row."""
        for key, thumbs in self._thumbs.items():
            thumbs.append(thumbnail(pictures[key]).astype(np.float16))  # exact to 1/16 of a level

    def findings(self) -> list[Finding]:
        """Return findings about frozen cameras, after all rows were added."""
        return [f for key, thumbs in self._thumbs.items() for f in _check_thumbs(self.episode, key, np.array(thumbs))]


def check_pictures(episode: Episode, *, decode: bool) -> list[Finding]:
    """Find frozen cameras in an episode; returns findings.

    Args:
        decode: also compare the decoded pictures while joints move. Without it only rows that repeat one source picture
            (``Episode.picture_rows``) are found, so nothing in an episode of a dataset.
    """
    findings = []
    for key in episode.picture_keys:
        if key in episode.picture_rows:
            findings += _check_sources(episode, key, episode.picture_rows[key])
    if not decode or not episode.picture_keys:
        return findings
    watch = PictureWatch(episode)
    for pictures in episode.pictures():
        watch.see(pictures)
    return findings + [f for f in watch.findings() if f.feature not in {g.feature for g in findings}]


def _frozen(episode: Episode, key: str, rows: tuple[int, int], what: str, num_frozen: int) -> Finding:
    share = num_frozen / episode.num_rows
    severity = "error" if share >= FROZEN_SHARE else "warning"
    return Finding(
        "frozen_picture",
        severity,
        key,
        f"{what} for {(rows[1] - rows[0]) / episode.spec.fps:.2f} s, {place(rows, episode.spec.fps)}; {share:.0%} of the "
        f"episode is frozen: the camera or its driver hung; {LEAVE_OUT}, and look at the camera's USB port",
        rows,
    )


def _check_sources(episode: Episode, key: str, numbers: np.ndarray) -> list[Finding]:
    same = np.concatenate([[False], np.diff(numbers) == 0])
    found = [(a - 1, b) for a, b in runs(same) if (b - a + 1) / episode.spec.fps >= FROZEN_S]
    if not found:
        return []
    rows = max(found, key=lambda r: r[1] - r[0])
    return [_frozen(episode, key, rows, "the same source picture", sum(b - a for a, b in found))]


def _check_thumbs(episode: Episode, key: str, thumbs: np.ndarray) -> list[Finding]:
    if len(thumbs) != episode.num_rows:
        return [not_judged(key, "pictures", f"{len(thumbs)} pictures for {episode.num_rows} rows")]
    joints = _joints_in_sight(episode, key)
    if joints is None:
        return [not_judged(key, "frozen pictures", "no joints in rad to compare with")]
    found = []
    for first, end in same_picture_runs(thumbs):
        moved = np.ptp(joints[first:end], axis=0).max(initial=0.0)
        if (end - first) / episode.spec.fps >= FROZEN_S and moved >= SIGHT_RAD:
            found.append((first, end))
    if not found:
        return []
    rows = max(found, key=lambda r: r[1] - r[0])
    dark = thumbs[rows[0]].mean() < DARK_LEVEL
    what = f"{'black' if dark else 'unchanged'} pictures while joints move by more than {SIGHT_RAD:g} rad"
    return [_frozen(episode, key, rows, what, sum(b - a for a, b in found))]


def _joints_in_sight(episode: Episode, key: str) -> np.ndarray | None:
    """(T, n) joints that the camera ought to see move: a wrist camera's own arm, else all arms."""
    if STATE not in episode.arrays or not np.isfinite(episode.arrays[STATE]).all():
        return None
    arms = find_arms(element_names(episode, STATE), element_units(episode, STATE))
    camera = key.rsplit(".", 1)[-1]
    own = [arm for arm in arms if arm.name and camera.startswith(f"{arm.name}_")] or arms
    elements = np.concatenate([arm.joints for arm in own]) if own else np.empty(0, dtype=int)
    return episode.arrays[STATE][:, elements] if len(elements) else None

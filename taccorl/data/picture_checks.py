"""Find frozen cameras: one picture is repeated while joints move.

Two signs: the same source picture on many rows (``Episode.picture_rows``), and decoded pictures that do not change, compared as
block means in grey levels, so that neither noise nor the codec matters.
"""

from collections.abc import Iterator

import numpy as np

from taccorl.data.episode import Episode, Pictures
from taccorl.data.finding import LEAVE_OUT, Finding, finding, not_judged, place
from taccorl.data.joint_checks import FROZEN_S, joints_in_sight
from taccorl.data.timing import longest, repeated, stretches
from taccorl.extras import OnUse

cv2 = OnUse("cv2")
THUMB_PX = 28  # Block means per side: 8 × 8 pixels each at 224 × 224; sensor noise of 3 levels changes one by about 0.4
SAME_LEVELS = 2.0  # Pictures are the same if all their block means differ by less than this [grey levels of 255]
SIGHT_RAD = 0.3  # Joint rotation that must be visible in a picture [rad]: it moves the hand by 12 cm at 0.4 m
FROZEN_SHARE = 0.5  # Share of an episode's rows with a frozen picture from which on the finding is an error
DARK_LEVEL = 4.0  # Mean grey level [of 255] below which a frozen picture counts as dark


def same_picture_runs(thumbs: np.ndarray) -> list[tuple[int, int]]:
    """Runs [first, last + 1) of pictures that all resemble the first of the run (a slow change adds up and ends it);
    ``thumbs``: (T, h, w) block means."""
    found, first = [], 0
    for row in range(1, len(thumbs) + 1):
        if (
            row == len(thumbs)
            or np.abs(thumbs[row] - thumbs[first]).max() >= SAME_LEVELS
        ):
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
        self._thumbs: dict[str, list[np.ndarray]] = {
            key: [] for key in self.episode.picture_keys
        }

    def see(self, pictures: Pictures) -> None:
        """Add the pictures of the next row."""
        for key, thumbs in self._thumbs.items():
            grey = cv2.cvtColor(pictures[key], cv2.COLOR_RGB2GRAY).astype(np.float32)
            thumb = cv2.resize(grey, (THUMB_PX, THUMB_PX), interpolation=cv2.INTER_AREA)
            thumbs.append(thumb.astype(np.float16))  # exact to 1/16 of a level

    def findings(self) -> list[Finding]:
        """Findings about frozen cameras, after all rows were added."""
        return [
            f
            for key, thumbs in self._thumbs.items()
            for f in _check_thumbs(self.episode, key, np.array(thumbs))
        ]


def check_pictures(episode: Episode, *, decode: bool) -> list[Finding]:
    """Find frozen cameras. ``decode``: also compare the decoded pictures; without it only rows that repeat one source picture
    are found, so nothing in an episode of a dataset."""
    same = {
        key: stretches(repeated(n), episode.spec.fps, FROZEN_S)
        for key, n in episode.picture_rows.items()
    }
    findings = [
        f
        for key, found in same.items()
        for f in _frozen(episode, key, found, "the same source picture")
    ]
    if not decode or not episode.picture_keys:
        return findings
    watch = PictureWatch(episode)
    for pictures in episode.pictures():
        watch.see(pictures)
    return findings + [
        f for f in watch.findings() if f.feature not in {g.feature for g in findings}
    ]


def _frozen(
    episode: Episode, key: str, found: list[tuple[int, int]], what: str
) -> Iterator[Finding]:
    if found:
        fps, rows, share = (
            episode.spec.fps,
            longest(found),
            sum(b - a for a, b in found) / episode.num_rows,
        )
        text = f"{what} for {(rows[1] - rows[0]) / fps:.2f} s, {place(rows, fps)}; {share:.0%} of the episode is "
        text += f"frozen: the camera or its driver hung; {LEAVE_OUT}, and look at the camera's USB port"
        yield finding(
            "frozen_picture",
            key,
            text,
            rows,
            "error" if share >= FROZEN_SHARE else None,
        )


def _check_thumbs(episode: Episode, key: str, thumbs: np.ndarray) -> Iterator[Finding]:
    joints = joints_in_sight(episode, key.rsplit(".", 1)[-1])
    if len(thumbs) != episode.num_rows:
        yield not_judged(
            key, "pictures", f"{len(thumbs)} pictures for {episode.num_rows} rows"
        )
    elif joints is None:
        yield not_judged(key, "frozen pictures", "no joints in rad to compare with")
    else:
        same = [
            r
            for r in same_picture_runs(thumbs)
            if (r[1] - r[0]) / episode.spec.fps >= FROZEN_S
        ]
        found = [
            r
            for r in same
            if np.ptp(joints[slice(*r)], axis=0).max(initial=0.0) >= SIGHT_RAD
        ]
        kind = (
            "black"
            if found and thumbs[longest(found)[0]].mean() < DARK_LEVEL
            else "unchanged"
        )
        yield from _frozen(
            episode,
            key,
            found,
            f"{kind} pictures while joints move by more than {SIGHT_RAD:g} rad",
        )

"""Source demonstrations as arrays of poses over time, cut into subtasks.

Letters in shapes: T rows. Row t holds the scene before action t.
"""

import functools
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from taccorl.episodes.sources.mimicgen.spec import UNTIL_THE_END, MimicSpec
from taccorl.errors import DatasetError

_AT_REST_ROWS = 4  # a gripper that has not moved for so long, and then does, begins to open or close


@dataclass(frozen=True, eq=False)
class ArmTrack:
    """Poses, gripper openings and commands of one arm at the T rows of a source."""

    tcp: np.ndarray  # (T, 4, 4) world-from-TCP
    goal: np.ndarray  # (T, 4, 4) world-from-TCP that action t is to reach
    joints_rad: np.ndarray  # (T, 6) joint angles of ``goal`` [rad]
    opening_m: np.ndarray  # (T,) gripper command of action t [m]
    command: np.ndarray
    """(T, 4, 4) world-from-TCP of the commanded joint angles of action t: the goal corrected by the arm's steady-state offset."""
    command_rad: np.ndarray  # (T, 6) commanded joint angles [rad]

    @functools.cached_property
    def gripper_acts(self) -> np.ndarray:
        """(T,) bool: action t begins to open or close a gripper that was still."""
        moves = np.diff(self.opening_m, prepend=self.opening_m[0]) != 0
        still = np.array(
            [not moves[max(t - _AT_REST_ROWS, 0) : t].any() for t in range(len(moves))]
        )
        return moves & still


@dataclass(frozen=True, eq=False)
class Source:
    """One successful demonstration: tracks of both arms, poses of objects, and signals that end subtasks."""

    name: str
    arms: Mapping[str, ArmTrack]
    objects: Mapping[str, np.ndarray]
    """Body → world-from-body (T, 4, 4)."""
    signals: Mapping[str, Mapping[str, np.ndarray]]
    """Arm → name of a subtask → (T,) bool: the subtask has ended."""
    mated: Mapping[str, np.ndarray]
    """Body → (T,) bool: it touches its mate."""
    free: Mapping[str, np.ndarray]
    """Body → (T,) bool: it touches only hands, so that a single hand that holds it determines its pose."""
    held: Mapping[str, Mapping[str, np.ndarray]]
    """Arm → body → (T,) bool: both pads of the arm touch it."""

    @property
    def num_rows(self) -> int:
        return len(next(iter(self.arms.values())).opening_m)

    @property
    def as_commanded(self) -> "Source":
        """The source with commands in place of goals, for ``retarget: eef_command``."""
        arms = {
            arm: replace(track, goal=track.command, joints_rad=track.command_rad)
            for arm, track in self.arms.items()
        }
        return replace(self, arms=arms)


@dataclass(frozen=True)
class Segment:
    """Rows [start, end) of a source that one subtask repeats."""

    start: int
    end: int
    """Row after the last one."""
    num_together: int = 0
    """Number of its last rows that run at the same time as the partner's."""

    @property
    def rows(self) -> slice:
        return slice(self.start, self.end)

    def __len__(self) -> int:
        return self.end - self.start


def first_rise(signal: np.ndarray, after: int) -> int | None:
    """First row r > ``after`` with signal[r − 1] false and signal[r] true, for ``signal`` (T,) bool; None without one."""
    rises = np.flatnonzero(~signal[:-1] & signal[1:]) + 1
    later = rises[rises > after]
    return int(later[0]) if len(later) else None


def subtask_ends(source: Source, arm: str, names: Sequence[str]) -> tuple[int, ...]:
    """Return for each of the arm's subtasks, in order, the row (excluded) at which it ends; the last one ends with the source.
    Raises DatasetError: a signal does not become true in its order; the message names the signal, the arm and the source."""
    signals, ends, before = source.signals.get(arm, {}), [], 0
    for k, name in enumerate(names):
        if name == UNTIL_THE_END:
            return (*ends, source.num_rows)
        where = f"{source.name}: {arm} arm, subtask {name!r}"
        end = first_rise(signals[name].astype(bool), before)
        if end is None:
            early = first_rise(signals[name].astype(bool), 0)
            if early is None:
                raise DatasetError(
                    f"{where}: the subtask never ends; collect successes, or remove this one"
                )
            raise DatasetError(
                f"{where}: ends at row {early}, before {names[k - 1]!r} at {before}, unlike the spec"
            )
        ends.append(end)
        before = end
    return (*ends[:-1], source.num_rows)


class SourcePool:
    """Source demonstrations, each cut into the subtasks of a spec."""

    def __init__(self, spec: MimicSpec, sources: Sequence[Source]) -> None:
        """Raises DatasetError: there is no source, or one does not fit: its order of subtasks contradicts the spec, or an offset
        could leave a subtask without rows."""
        if not sources:
            raise DatasetError(
                f"mimicgen of {spec.task}: no sources; taccorl collect --task={spec.task} makes some"
            )
        commanded = spec.datagen_config.retarget == "eef_command"
        self.spec, self.sources = (
            spec,
            [source.as_commanded if commanded else source for source in sources],
        )
        self._ends = [
            {arm: subtask_ends(s, arm, names) for arm, names in spec.signals.items()}
            for s in self.sources
        ]
        for i, source in enumerate(self.sources):
            self._check_lengths(i, source)

    def __len__(self) -> int:
        return len(self.sources)

    def segment(
        self, i: int, arm: str, k: int, offsets: Mapping[tuple[str, int], int]
    ) -> Segment:
        """Rows of source ``i`` that are subtask ``k`` of ``arm``, each subtask's end moved by its offset: ``offsets`` maps (arm,
        index of the subtask) → rows.

        A subtask that had to wait for another arm begins at the row where that arm's subtask ended, since the arm only waited
        before it. Subtasks that must begin together begin at the later of their first rows.
        """
        start, end = self._begin(i, arm, k, offsets), self._end(i, arm, k, offsets)
        coordination = self.spec.coordination(arm, k)
        if coordination is None:
            return Segment(start, end)
        (other, j) = next(
            p for p in coordination.eef_subtask_constraint_tuple if p != (arm, k)
        )
        other_start = self._begin(i, other, j, offsets)
        if coordination.coordination_synchronize_start:
            start = other_start = max(start, other_start)
        return Segment(
            start, end, min(end - start, self._end(i, other, j, offsets) - other_start)
        )

    def _begin(
        self, i: int, arm: str, k: int, offsets: Mapping[tuple[str, int], int]
    ) -> int:
        own = [self._end(i, arm, k - 1, offsets)] if k else [0]
        return max(
            own
            + [self._end(i, *former, offsets) for former in self.spec.formers(arm, k)]
        )

    def _end(
        self, i: int, arm: str, k: int, offsets: Mapping[tuple[str, int], int]
    ) -> int:
        return min(
            self._ends[i][arm][k] + offsets.get((arm, k), 0), self.sources[i].num_rows
        )

    def _check_lengths(self, i: int, source: Source) -> None:
        """Whatever offsets are drawn, every subtask has rows."""
        spec, limits = self.spec, {}
        for arm, subtasks in spec.subtask_configs.items():
            limits |= {
                (arm, k): s.subtask_term_offset_range for k, s in enumerate(subtasks)
            }
        latest_start = {place: high for place, (_, high) in limits.items()}
        for arm, k in limits:
            earliest_end = latest_start | {(arm, k): limits[arm, k][0]}
            segment = self.segment(i, arm, k, earliest_end)
            if segment.end <= segment.start:
                name = spec.signals[arm][k]
                raise DatasetError(
                    f"{source.name}: {arm} subtask {name!r} ends at row {self._ends[i][arm][k]}, but may begin at row "
                    f"{segment.start}: {self._why_late(arm, k)}. Check subtask_term_offset_range and the order of subtasks"
                )

    def _why_late(self, arm: str, k: int) -> str:
        formers = [
            f"{other} {self.spec.signals[other][j]!r}"
            for other, j in self.spec.formers(arm, k)
        ]
        before = [f"its own {self.spec.signals[arm][k - 1]!r}"] if k else []
        return f"after {' and '.join(before + formers) or 'the beginning'}"


def contact_row(
    source: Source, bodies: Collection[str], segment: Segment, lead: int
) -> int:
    """First row of a segment that counts as contact: ``lead`` rows before one of ``bodies`` touches its mate, but not before the
    segment's first row; the segment's end if none does.
    """
    mated = [
        source.mated[body][segment.rows] for body in bodies if body in source.mated
    ]
    if not mated:
        return segment.end
    touching = np.flatnonzero(np.logical_or.reduce(mated))
    return (
        max(segment.start + int(touching[0]) - lead, segment.start)
        if len(touching)
        else segment.end
    )

"""Checks that need no unit and no data sheet: a signal against its own range, its own noise and its command.

Datasets of ``lerobot-record`` state neither units nor limits. It takes neither to see that a joint never changes
while its command moves, that two arms get one command, or that a sensor rests at another level than before.

Shapes: T rows, J elements of a vector, K values of a touch sensor, R quiet stretches.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from taccorl.data.episode import Episode
from taccorl.data.finding import LEAVE_OUT, Finding, finding, listed, place
from taccorl.data.spec import ACTION, STATE
from taccorl.data.timing import longest, repeated, runs, stretches

# ---- joints and commands ----

MOVES_SHARE = 0.05
"""Least range of a moving element, as a share of the largest range in its vector: a leader at rest trembles by less. A smaller
one, such as a gripper's in m beside joints in degrees, takes more different values."""
OVER_NOISE = 10.0
"""Least range of a moving element, as a multiple of the typical change of its step from row to row."""
LEAST_VALUES, FINE_VALUES = 3, 20
"""Fewest different values of a moving element, of one with a large and with a small range: an encoder at rest flips between
two, and a hand that rests on a leader creeps over some more."""
FROZEN_SHARE = 0.2
"""Share of its range by which a command moves while the joint stands still bit by bit: more than friction holds."""
FROZEN_ALL_S, FROZEN_ONE_S = 0.5, 1.0
"""Least time of bit-identical states [s]: of all elements, and of one alone, which a long rest explains sooner."""
TURN_SHARE = 0.5  # Least step of an element between two rows, as a share of its range, that is a jump
OTHER_STEPS = 0.1  # Largest usual step (99 %), as a share of such a jump
LEAST_OF_RANGE = 20  # Fewest different values of an element that jumps: grippers open and close by one step
TURNS = {360.0: "degrees", 2 * math.pi: "rad", 4096.0: "ticks", 65536.0: "ticks"}
"""Full turns, and their usual units."""
NEARLY_A_TURN = (
    0.8  # Least jump, as a share of a full turn: the joint moves on during the row
)


def moving(values: np.ndarray) -> np.ndarray:
    """(J,) bool: elements of ``values`` (T, J) that move by more than their noise and a fair share of the others."""
    if len(values) < 3:
        return np.zeros(values.shape[1], dtype=bool)
    span = np.ptp(values, axis=0)
    bends = np.median(np.abs(np.diff(values, n=2, axis=0)), axis=0)
    is_large = span > MOVES_SHARE * span.max()
    num_values = np.array([len(np.unique(column)) for column in values.T])
    least = np.where(is_large, LEAST_VALUES, FINE_VALUES)
    return (num_values >= least) & (span > OVER_NOISE * bends)


@dataclass(frozen=True)
class _Pairs:
    """Elements that state and command both have, by name."""

    names: tuple[str, ...]
    state: np.ndarray
    """(T, J) of each name; ``action`` likewise."""
    action: np.ndarray

    @classmethod
    def of(cls, episode: Episode) -> "_Pairs | None":
        if not {STATE, ACTION} <= episode.arrays.keys():
            return None
        columns = [
            {name: k for k, name in enumerate(episode.element_names(key))}
            for key in (STATE, ACTION)
        ]
        names = tuple(name for name in columns[0] if name in columns[1])
        of_state, of_action = (
            episode.arrays[key][:, [own[name] for name in names]].astype(float)
            for key, own in zip((STATE, ACTION), columns, strict=True)
        )
        if not names or not np.isfinite([of_state, of_action]).all():
            return None
        return cls(names, of_state, of_action)

    def named(self, elements: np.ndarray) -> str:
        return listed([self.names[i] for i in np.flatnonzero(elements)])


def check_relative_motion(episode: Episode) -> Iterator[Finding]:
    """Joints against their own commands, whatever their units."""
    pairs = _Pairs.of(episode)
    if pairs is None:
        return
    sent, done = moving(pairs.action), moving(pairs.state)
    still = np.ptp(pairs.state, axis=0) == 0
    if (dead := still & sent).any():
        value = pairs.state[0, np.flatnonzero(dead)[0]]
        text = f"the state of {pairs.named(dead)} is {value:g} in every row while its command moves: an encoder "
        text += "that is not read, or another channel; correct `channels`, or "
        yield finding("dead_state", STATE, f"{text}{LEAVE_OUT}")
    held = np.ptp(pairs.action, axis=0) == 0
    if (dead := held & done).any() and not held.all():
        value = pairs.action[0, np.flatnonzero(dead)[0]]
        text = f"the command of {pairs.named(dead)} is {value:g} in every row while the joint moves: a dead channel, "
        yield finding(
            "dead_command", ACTION, f"{text}or another topic; correct `channels`"
        )
    yield from _frozen(pairs, sent & ~still, episode)
    yield from _one_command(pairs, sent)
    yield from _turns(episode)


def _frozen(pairs: _Pairs, sent: np.ndarray, episode: Episode) -> Iterator[Finding]:
    """Stretches in which the state stands still bit by bit while the command moves on: all of it where no arm is
    known (``joint_checks`` looks at arms), and single joints."""
    fps, span = episode.spec.fps, np.ptp(pairs.action, axis=0)

    def moved(rows: tuple[int, int], elements: np.ndarray) -> bool:
        own = np.ptp(pairs.action[slice(*rows)], axis=0) > FROZEN_SHARE * span
        return bool((own & elements).any())

    def found(elements: np.ndarray, least_s: float) -> list[tuple[int, int]]:
        same = repeated(pairs.state[:, elements])
        every = stretches(same, fps, least_s)
        return [rows for rows in every if moved(rows, elements & sent)]

    no_arms = not any(len(arm.joints) for arm in episode.arms())
    everything = np.ones(len(sent), dtype=bool)
    if no_arms and (every := found(everything, FROZEN_ALL_S)):
        rows = longest(every)
        text = f"all joints stay bit-identical for {(rows[1] - rows[0]) / fps:.2f} s while the command moves, "
        text += f"{place(rows, fps)} ({len(every)} such times): the arm is disabled, or its driver repeats "
        yield finding("frozen_state", STATE, f"{text}old values", rows)
        return
    for i in np.flatnonzero(sent):
        if "grip" in pairs.names[i]:  # a part stops it
            continue
        if every := found(np.arange(len(sent)) == i, FROZEN_ONE_S):
            rows = longest(every)
            part = np.ptp(pairs.action[slice(*rows), i]) / span[i]
            text = f"{pairs.names[i]} stays bit-identical for {(rows[1] - rows[0]) / fps:.2f} s while its command "
            text += f"moves by {part:.0%} of its range, {place(rows, fps)} ({len(every)} such times): an encoder "
            yield finding("frozen_state", STATE, f"{text}that is not read", rows)


def _one_command(pairs: _Pairs, sent: np.ndarray) -> Iterator[Finding]:
    """Two arms that get the same command while their states differ."""
    other = {
        i: pairs.names.index(name.replace("left", "right", 1))
        for i, name in enumerate(pairs.names)
        if "left" in name and name.replace("left", "right", 1) in pairs.names
    }
    own, others = [*other], [*other.values()]
    if not own or not sent[own].any():
        return
    commands = np.array_equal(pairs.action[:, own], pairs.action[:, others])
    if commands and not np.array_equal(pairs.state[:, own], pairs.state[:, others]):
        names = listed([pairs.names[i] for i in own])
        text = f"{names} have the commands of the right arm, number by number, while the states of the two differ: "
        text += "one topic stands twice in `channels`"
        yield finding("same_command", ACTION, text)


def _turns(episode: Episode) -> Iterator[Finding]:
    """Elements without a unit that step by most of their range within a row: angles that pass a full turn."""
    units, names = episode.spec.features[STATE].units, episode.element_names(STATE)
    values = episode.arrays[STATE].astype(float)
    for i in [i for i, unit in enumerate(units) if unit == "unknown"]:
        steps, span = np.abs(np.diff(values[:, i])), float(np.ptp(values[:, i]))
        large = steps > TURN_SHARE * span
        if not large.any() or len(np.unique(values[:, i])) < LEAST_OF_RANGE:
            continue
        jump, usual = float(steps.max()), float(np.quantile(steps[~large], 0.99))
        if usual > OTHER_STEPS * jump:
            continue
        row = int(np.argmax(steps))
        turn = next(
            (t for t in TURNS if NEARLY_A_TURN * t <= jump and span <= t * 1.001), None
        )
        what = (
            "a glitch, or rows are missing"
            if turn is None
            else f"an angle that passes a full turn, {turn:.4g} {TURNS[turn]}: add the turns before training "
            "(`unwrap: true` of a columns file does it for compare and diagnose)"
        )
        text = f"{names[i]} goes from {values[row, i]:.4g} to {values[row + 1, i]:.4g} between rows {row} and "
        text += f"{row + 1}, {jump / span:.0%} of its range; {large.sum()} such steps: {what}"
        yield finding("jump", STATE, text, (row, row + 2))


# ---- touch ----

ZEROS_S = (
    0.2  # Least time of frames that are all 0, of a sensor that is not 0 at rest [s]
)
RARE_SHARE = 0.3  # Largest share of such frames: a sensor that is 0 at rest has more
PEAK_SHARE = 0.99  # Least share of frames with one and the same largest value
PLATEAU_RUNS, PLATEAU_ROWS = 2, 5
"""Fewest stretches, and fewest rows in each, in which a value stands at the largest one that ever occurs."""
PLATEAU_STEPS = 20  # Least number of different values below that largest one


def check_relative_touch(episode: Episode, key: str) -> Iterator[Finding]:
    """Frames of 0, frames that are divided by their own peak, and values that are cut off."""
    values = episode.arrays[key].astype(float)
    values = values[np.isfinite(values).all(axis=1)]
    fps = episode.spec.fps
    if len(values) < 3 or not np.ptp(values):
        return
    none: np.ndarray = np.asarray(~values.any(axis=1))
    found = [r for r in runs(none) if r[1] - r[0] >= ZEROS_S * fps]
    at_rest = np.median(values[~none], axis=0) if not none.all() else np.zeros(1)
    if found and none.mean() < RARE_SHARE and np.mean(at_rest != 0) > 0.5:
        rows = longest(found)
        text = f"{key}: all values are 0 for {(rows[1] - rows[0]) / fps:.2f} s, {place(rows, fps)}, at other times "
        text += f"they are not 0 at rest: the sensor's board started again; {LEAVE_OUT}"
        yield finding("touch_zeros", key, text, rows)
    peaks = values.max(axis=1)
    is_fine = len(np.unique(values)) > PLATEAU_STEPS and values.shape[1] > 2
    if is_fine and np.mean(peaks == peaks.max()) >= PEAK_SHARE:
        text = f"{key}: the largest value of every frame is {peaks.max():g}, at rest, too: each frame was divided by "
        yield finding(
            "touch_by_peak",
            key,
            f"{text}its own peak, so that force is lost; store counts",
        )
    elif is_fine:
        yield from _plateau(key, values, fps)


def _plateau(key: str, values: np.ndarray, fps: int) -> Iterator[Finding]:
    """Values that stand at the largest one of all, or at the least one, again and again."""
    for sign, end in ((1.0, "largest"), (-1.0, "least")):
        signed = sign * values
        most = signed.max()
        full: np.ndarray = np.asarray(signed == most)
        if full.mean() > RARE_SHARE or len(np.unique(signed)) < PLATEAU_STEPS:
            continue
        long = [
            (k, r)
            for k in np.flatnonzero(full.any(axis=0))
            for r in runs(full[:, k])
            if r[1] - r[0] >= PLATEAU_ROWS
        ]
        if len(long) < PLATEAU_RUNS:
            continue
        rows = longest([r for _, r in long])
        elements = sorted({int(k) for k, _ in long})
        text = f"{key}: {len(elements)} of {values.shape[1]} values (elements {listed([*map(str, elements)])}) stand at "
        text += f"the {end} value that occurs, {sign * most:g}, in {len(long)} stretches, the longest {place(rows, fps)}: "
        yield finding(
            "saturated", key, f"{text}force is cut off there; lower the gain", rows
        )


# ---- levels of rest, across episodes ----

QUIET_S = 0.2  # Least time in which a sensor hardly changes [s]
QUIET_NOISE = (
    4.0  # Largest change in that time of a quiet sensor, as a multiple of its noise
)
SAME_SHARE, SAME_NOISE = 0.03, 4.0
"""Largest difference of two levels that are the same: as a share of the sensor's range, or in its noise."""
OTHER_SHARE, OTHER_NOISE = 0.1, 10.0
"""Least difference of two levels of rest that is reported, likewise."""
LEAST_VISITS = (
    2  # Fewest returns to a level that make it one of rest: grips differ in force
)
LEAST_TREND = 6  # Fewest quiet stretches from which a drift is judged
TREND_SHARE = 0.6  # Least share of them that lie on the line
TREND_FIT = 0.9  # Least R² of the line through those


@dataclass(frozen=True)
class Quiet:
    """Level of a sensor in a stretch in which it hardly changes."""

    episode: str
    row: int
    """Its middle, counted over all episodes."""
    level: np.ndarray
    """(K,) medians."""
    left: float
    """Largest distance from the level (RMS over values) before the next stretch; infinite at the end of the episode."""


class RestingLevels:
    """Levels of one sensor in its quiet stretches, episode after episode."""

    def __init__(self) -> None:
        self._quiet: list[Quiet] = []
        self._noise: list[float] = []
        self._ranges: list[float] = []
        self._rows = 0

    def add(self, name: str, values: np.ndarray, fps: int) -> None:
        """Add the frames ``values`` (T, K) of the episode ``name``."""
        values = values.astype(float)
        width = max(round(QUIET_S * fps), 2)
        if np.isfinite(values).all() and len(values) > 2 * width:
            steps = np.abs(np.diff(values, axis=0))
            noise_K = 1.48 * np.median(steps, axis=0) / math.sqrt(2)
            quantum = steps[steps > 0].min(initial=np.inf)
            noise = float(np.sqrt(np.mean(noise_K**2)))
            noise = max(noise, 0.3 * quantum if math.isfinite(quantum) else 0.0)
            low, high = np.quantile(values, (0.02, 0.98), axis=0)
            self._noise.append(noise)
            self._ranges.append(float(np.sqrt(np.mean((high - low) ** 2))))
            change = np.sqrt(np.mean((values[width:] - values[:-width]) ** 2, axis=1))
            quiet = runs(change <= QUIET_NOISE * noise)
            quiet = [(first, end) for first, end in quiet if end - first >= width]
            for k, (first, end) in enumerate(quiet):
                level = np.median(values[first : end + width], axis=0)
                middle = self._rows + (first + end + width) // 2
                left = math.inf
                if k + 1 < len(quiet):
                    between = values[end : quiet[k + 1][0] + 1] - level
                    left = float(np.sqrt(np.mean(between**2, axis=1)).max())
                self._quiet.append(Quiet(name, middle, level, left))
        self._rows += len(values)

    def finding(self, key: str) -> Iterator[Finding]:
        """A level of rest that steps, or drifts."""
        if len(self._quiet) < 2 * LEAST_VISITS or not (noise := max(self._noise)):
            return
        span = float(np.median(self._ranges))
        same = max(SAME_NOISE * noise, SAME_SHARE * span)
        other = max(OTHER_NOISE * noise, OTHER_SHARE * span)
        levels = np.array([q.level for q in self._quiet])
        apart = np.sqrt(np.mean((levels[:, None] - levels[None]) ** 2, axis=2))
        if (step := self._step(apart, same, other)) is not None:
            before, after = step
            where = f", within {before}"
            if before != after:
                where = f", {before} before, {after} after it"
            size = self._size(levels, before, after)
            text = f"{key}: its level of rest steps by {size:.4g} (RMS over its values; their range is {span:.4g}){where}: "
            text += "a sensor that slipped or was mounted anew; subtract the level before each contact, or record again"
            yield finding("baseline_drift", key, text)
        elif (moved := self._trend(levels)) > other:
            text = f"{key}: its level of rest drifts by {moved:.4g} over {self._rows} rows (RMS over its values; their "
            text += f"range is {span:.4g}): subtract the level before each contact, or let it warm up"
            yield finding("baseline_drift", key, text)

    def _size(self, levels: np.ndarray, before: str, after: str) -> float:
        names = [q.episode for q in self._quiet]
        first = levels[max(k for k, name in enumerate(names) if name == before)]
        second = levels[min(k for k, name in enumerate(names) if name == after)]
        return float(np.sqrt(np.mean((first - second) ** 2)))

    def _step(
        self, apart: np.ndarray, same: float, other: float
    ) -> tuple[str, str] | None:
        """Episodes of the last stretch at one level and of the first at another one, each of which the sensor returns to,
        and neither of which it has on the other side of the step."""
        near = apart <= same
        # a stretch that the sensor has only come to after it had left the one before
        is_new = np.array([True, *(q.left > other for q in self._quiet[:-1])])
        for cut in range(LEAST_VISITS, len(apart) - LEAST_VISITS + 1):
            a = (near & is_new)[:cut, :cut].sum(axis=1)
            b = (near & is_new)[cut:, cut:].sum(axis=1)
            i, j = int(np.argmax(a)), cut + int(np.argmax(b))
            if (
                min(a.max(), b.max()) >= LEAST_VISITS
                and apart[i, j] > other
                and not near[i, cut:].any()
                and not near[j, :cut].any()
            ):
                last = max(k for k in range(cut) if near[i, k])
                first = min(k for k in range(cut, len(apart)) if near[j, k])
                return self._quiet[last].episode, self._quiet[first].episode
        return None

    def _trend(self, levels: np.ndarray) -> float:
        """Change of the level along its line over all rows (RMS over values); 0 without such a line."""
        if len(levels) < LEAST_TREND:
            return 0.0
        rows = np.array([q.row for q in self._quiet], dtype=float)
        way = levels[-1] - levels[0]
        length = float(np.linalg.norm(way))
        if not length:
            return 0.0
        along = (levels - levels[0]) @ way / length
        pairs = np.triu_indices(len(rows), 1)
        runs_of = rows[pairs[1]] - rows[pairs[0]]
        slope = float(np.median((along[pairs[1]] - along[pairs[0]]) / runs_of))
        left = along - slope * rows
        left -= np.median(left)
        total = abs(slope) * float(np.ptp(rows))
        near = np.abs(left) < 0.15 * total
        if near.mean() < TREND_SHARE or near.sum() < LEAST_TREND:
            return 0.0
        explained = 1.0 - np.var(left[near]) / max(np.var(along[near]), 1e-30)
        return total / math.sqrt(levels.shape[1]) if explained >= TREND_FIT else 0.0

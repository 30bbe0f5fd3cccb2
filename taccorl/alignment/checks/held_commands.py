"""Commands that never reached the drive: the drive then holds the previous target for one or more command periods.

A dropped command k changes the applied target u_a by u(k − 1) − u(k + j) for the m rows until a command arrives. The measured
position then deviates by that pulse through the joint's own response:

    y = G u_a + r,    G: second-order lag with gain, delay and offset, fitted;   r: coloured, A(q) r = e white
    e(t) ≈ Σ over events  w(t) * pulse(t),    w = A(q) G

Each event is found by the squared residual that it explains (matching pursuit). A pulse always points backwards along the motion.
Disturbances, friction and noise have no preferred direction, so that the same search for pulses that point *forwards* estimates
the number of false events.

Letters in shapes: T rows, L rows of the response, M rows of a hold.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import toeplitz
from scipy.optimize import least_squares
from scipy.signal import lfilter

HOLDS = (1, 2, 3, 4, 6, 8, 12, 16)
"""Lengths of a hold that are searched [command periods]."""
AR_ORDER = 6
"""Order of the whitening filter A(q)."""
PASSES = 4
"""Number of fits of response and noise, each without the events found so far."""
LEAD_ROWS = 4
"""Rows of the response before the impulse: a delay of part of a row spreads it to both sides."""
RESPONSE_S = 0.4
"""Length of the response that is used [s]."""
LEAST_GAIN = 12.0
"""Least reduction of ½ Σ e²/σ² for an event: noise alone causes one in about 10⁵ rows."""
LOCAL_S = 0.5
"""Window in which a local σ is estimated, too [s]: unmodelled physics occurs in some places only."""
OMEGA_RAD_PER_S, ZETA, DELAY_ROWS = (2.0, 400.0), (0.2, 20.0), (-2.0, 12.0)
"""Ranges of the parameters of the fitted response: natural frequency [rad/s], damping ratio, delay [rows]."""
BEFORE_TURN_S, AFTER_TURN_S = 0.02, 0.075
"""An event counts as one at a turn of the target if it ends so long before it at most, or begins so long after it at most [s]."""
MOVES = 2e-3
"""Least motion of a target that can show a dropped command [rad, m]."""


@dataclass(frozen=True)
class HeldCommand:
    """One dropped command, or several in a row."""

    row: int
    """First row at which the previous target was still in force."""
    rows: int
    """Number of rows for which it was in force."""
    gain: float
    """Reduction of ½ Σ e²/σ² by the event."""


@dataclass(frozen=True)
class HeldCommands:
    """Dropped commands found in one recording of one signal."""

    events: tuple[HeldCommand, ...]
    """Dropped commands that were found."""
    mirrored: tuple[HeldCommand, ...]
    """Events of the opposite sign: their number estimates that of false events."""
    updates: int
    """Number of commands that differ from the one before."""
    visible: int
    """Number of these commands whose loss alone could be found."""
    period_rows: int
    """Rows between two updates of the command."""
    holds: int
    """Number of holds: events that follow each other without a gap are one."""
    at_turns: int
    """Number of holds that lie where the target changes direction or begins to move; there play and sticking friction hold a
    joint, too."""
    turn_share: float
    """Share of all updates of the command at which a hold of these lengths would lie at a turn: the probability for one hold if
    commands were dropped at random times."""


def find_held_commands(target: np.ndarray, measured: np.ndarray, period_s: float) -> HeldCommands | None:
    """Find dropped commands of one signal of one recording; None if there are too few measured rows or the target does not move.

    Args:
        target: (T,) commanded targets [rad, m], in force from row k on.
        measured: (T,) positions at row k [rad, m]; NaN where not measured.
        period_s: time between two rows [s].
    """
    changed = np.flatnonzero(np.diff(target) != 0) + 1
    if np.ptp(target) < MOVES or len(changed) < 50 or np.isfinite(measured).sum() < 200:
        return None
    hold = int(np.median(np.diff(changed)))
    forward: list[HeldCommand] = []
    for _ in range(PASSES):  # events bend the fitted response and the whitening filter: again without them
        applied = _applied(target, forward)
        left, response = _fitted(target, applied, measured, period_s)
        search = _Search(target, left, response, hold, changed, round(LOCAL_S / period_s), forward)
        before, (forward, backward) = forward, search.events()
        if len(forward) == len(before):
            break
    turned = _turned(target, changed, period_s)
    holds: list[tuple[int, int]] = []
    for event in forward:
        first, end = event.row, event.row + event.rows
        holds = [*holds[:-1], (holds[-1][0], end)] if holds and first <= holds[-1][1] else [*holds, (first, end)]
    near = [_near(turned, np.array([first]), end - first, period_s)[0] for first, end in holds]
    share = [float(_near(turned, changed, end - first, period_s).mean()) for first, end in holds]
    return HeldCommands(
        events=tuple(forward),
        mirrored=tuple(backward),
        updates=len(changed),
        visible=int(search.visible().sum()),
        period_rows=hold,
        holds=len(holds),
        at_turns=sum(map(int, near)),
        turn_share=float(np.mean(share)) if share else 0.0,
    )


def _turned(target: np.ndarray, changed: np.ndarray, period_s: float) -> np.ndarray:
    """Rows at which the target changes direction, or begins to move after it stood for ``AFTER_TURN_S``."""
    way = np.sign(target[changed] - target[changed - 1])
    stood = np.diff(changed, prepend=-len(target)) * period_s > AFTER_TURN_S
    return changed[stood | (np.diff(way, prepend=way[0]) != 0)]


def _near(turned: np.ndarray, rows: np.ndarray, length: int, period_s: float) -> np.ndarray:
    """(R,) bool: a hold of ``length`` rows from that row on is at a turn."""
    first, last = rows - AFTER_TURN_S / period_s, rows + length + BEFORE_TURN_S / period_s
    return np.searchsorted(turned, first, side="left") < np.searchsorted(turned, last, side="right")


def _applied(target: np.ndarray, events: Sequence[HeldCommand]) -> np.ndarray:
    """(T,) targets that were in force, if these events happened."""
    applied = target.copy()
    for event in events:
        applied[event.row : event.row + event.rows] = target[event.row - 1]
    return applied


def _fitted(
    target: np.ndarray, applied: np.ndarray, measured: np.ndarray, period_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """((T,) measured − G target, (L,) impulse response of G per row); G is fitted to what was applied."""
    u = applied - target[0]
    seen = np.isfinite(measured)
    length = round(RESPONSE_S / period_s)
    impulse = np.zeros(length + LEAD_ROWS)
    impulse[LEAD_ROWS] = 1.0  # a delay of part of a row spreads it to both sides

    wanted = measured[seen] - measured[seen].mean()

    def answer(x: np.ndarray, drive: np.ndarray) -> np.ndarray:
        late = np.interp(np.arange(len(drive)) - x[2], np.arange(len(drive)), drive, left=drive[0] * (x[2] <= 0))
        return np.asarray(lfilter(*_second_order(math.exp(x[0]), math.exp(x[1]), period_s), late))

    def residual(x: np.ndarray) -> np.ndarray:
        shape = answer(x, u)[seen]
        shape -= shape.mean()
        power = float(shape @ shape)
        return wanted - (float(shape @ wanted) / power if power > 0 else 0.0) * shape

    low, high = (np.array([math.log(OMEGA_RAD_PER_S[k]), math.log(ZETA[k]), DELAY_ROWS[k]]) for k in (0, 1))
    starts = [(math.log(w), math.log(z), 0.5) for w, z in ((12.0, 1.0), (30.0, 1.0), (60.0, 3.0), (15.0, 1.5))]
    start = min(starts, key=lambda x: float((residual(np.array(x)) ** 2).sum()))
    best = least_squares(residual, start, bounds=(low, high), x_scale=(0.1, 0.1, 0.5), max_nfev=15, ftol=1e-4).x
    design = np.column_stack([answer(best, u), np.ones(len(u))])
    solution = np.linalg.lstsq(design[seen], measured[seen], rcond=None)[0]
    commanded = np.column_stack([answer(best, target - target[0]), np.ones(len(u))])
    return measured - commanded @ solution, solution[0] * answer(best, impulse)[LEAD_ROWS:]


def _second_order(omega: float, zeta: float, period_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Numerator and denominator of ω² / (s² + 2 ζ ω s + ω²) behind a zero-order hold."""
    root = np.sqrt(complex(zeta**2 - 1.0 + 1e-9))
    s = omega * (-zeta + root), omega * (-zeta - root)
    z = np.exp(s[0] * period_s), np.exp(s[1] * period_s)
    first = 1.0 + ((s[1] * z[0] - s[0] * z[1]) / (s[0] - s[1])).real
    whole = ((1 - z[0]) * (1 - z[1])).real
    return np.array([0.0, first, whole - first]), np.array([1.0, -(z[0] + z[1]).real, (z[0] * z[1]).real])


class _Search:
    """Matching pursuit over events (row, hold), amplitude fixed by the commands."""

    def __init__(
        self,
        target: np.ndarray,
        left: np.ndarray,
        response: np.ndarray,
        hold: int,
        changed: np.ndarray,
        local: int,
        known: Sequence[HeldCommand] = (),
    ) -> None:
        self.target, self.hold, self.changed = target, hold, changed
        clean = left.copy()
        for event in known:
            at, pulse = self._pulse(event, 1.0)
            answer = np.convolve(pulse, response)[: len(target) - at]
            clean[at : at + len(answer)] -= answer
        whiten = _whitening(clean)
        self.w = lfilter(whiten, [1.0], response)
        self.e = _filtered(whiten, left)
        self.sigma = _local_sigma(_filtered(whiten, clean), local)
        self.auto = np.correlate(self.w, self.w, "full")[len(self.w) - 1 :]
        self._windows = [m * hold for m in HOLDS]

    def _pulse(self, event: HeldCommand, sign: float) -> tuple[int, np.ndarray]:
        rows = np.arange(event.row, min(event.row + event.rows, len(self.target)))
        return event.row, sign * (self.target[event.row - 1] - self.target[rows])

    def _gains(self, score: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """((R,) largest gain of a hold from each row on, (R,) its length, negative if it points forwards)."""
        last = len(self.target)
        best, lengths = np.full(len(rows), -np.inf), np.zeros(len(rows), dtype=int)
        for length in self._windows:
            at = rows[:, None] + np.arange(length)
            inside = at < last
            at = np.minimum(at, last - 1)
            pulse = (self.target[rows - 1][:, None] - self.target[at]) * inside
            cross = (pulse * score[at]).sum(axis=1)
            kernel = np.zeros(length)
            kernel[: min(length, len(self.auto))] = self.auto[:length]
            energy = np.einsum("ri,ri->r", pulse @ toeplitz(kernel), pulse) / self.sigma[rows] ** 2
            gain = np.abs(cross) - 0.5 * energy
            better = gain > best
            best = np.where(better, gain, best)
            lengths = np.where(better, np.where(cross < 0, -length, length), lengths)
        return best, lengths

    def _score(self, e: np.ndarray) -> np.ndarray:
        """(T,) Σ_i w_i e(t + i) / σ²."""
        weighted = e / self.sigma**2
        return np.correlate(np.append(weighted, np.zeros(len(self.w) - 1)), self.w, "valid")

    def visible(self) -> np.ndarray:
        """(C,) bool of the updates: the loss of this one alone explains ``LEAST_GAIN``."""
        step = np.abs(self.target[self.changed] - self.target[self.changed - 1])
        kernel = toeplitz(np.pad(self.auto, (0, max(0, self.hold - len(self.auto))))[: self.hold])
        return 0.5 * step**2 * kernel.sum() / self.sigma[self.changed] ** 2 > LEAST_GAIN

    def events(self) -> tuple[list[HeldCommand], list[HeldCommand]]:
        """Dropped commands, and events of the opposite sign; the strongest of both is taken first, so that what a strong one
        leaves is not mistaken for others."""
        e, rows = self.e.copy(), self.changed
        score = self._score(e)
        gains, lengths = self._gains(score, rows)
        reach = len(self.w) + max(self._windows)
        found: dict[float, list[HeldCommand]] = {1.0: [], -1.0: []}
        for _ in range(len(rows)):
            k = int(np.argmax(gains))
            if not gains[k] > LEAST_GAIN:
                break
            sign = math.copysign(1.0, lengths[k])
            event = HeldCommand(int(rows[k]), abs(int(lengths[k])), float(gains[k]))
            found[sign].append(event)
            at, pulse = self._pulse(event, sign)
            change = np.convolve(pulse, self.w)[: len(e) - at]
            e[at : at + len(change)] -= change
            near = np.flatnonzero(np.abs(rows - at) <= reach)
            first, end = max(0, at - reach - max(self._windows)), min(len(e), at + 2 * reach)
            until = min(len(e), end + len(self.w))
            weighted = e[first:until] / self.sigma[first:until] ** 2
            part = np.correlate(np.append(weighted, np.zeros(len(self.w) - 1)), self.w, "valid")
            score[first:end] = part[: end - first]
            gains[near], lengths[near] = self._gains(score, rows[near])
            for other in (*found[1.0], *found[-1.0]):
                gains[np.abs(rows - other.row) < other.rows] = -np.inf
        forward, backward = (sorted(found[sign], key=lambda event: event.row) for sign in (1.0, -1.0))
        return forward, backward


def _whitening(left: np.ndarray) -> np.ndarray:
    """(AR_ORDER + 1,) coefficients of A(q), by least squares over rows without gaps."""
    lagged = np.lib.stride_tricks.sliding_window_view(left, AR_ORDER + 1)
    lagged = lagged[np.isfinite(lagged).all(axis=1)]
    past, now = lagged[:, :-1][:, ::-1], lagged[:, -1]
    ridge = 1e-9 * float((past**2).sum()) * np.eye(AR_ORDER)
    return np.append(1.0, -np.linalg.solve(past.T @ past + ridge, past.T @ now))


def _filtered(whiten: np.ndarray, left: np.ndarray) -> np.ndarray:
    """(T,) A(q) r; 0 where a row of it was not measured."""
    e = np.convolve(left, whiten)[: len(left)]
    e[: len(whiten) - 1] = 0.0
    return np.where(np.isfinite(e), e, 0.0)


def _local_sigma(e: np.ndarray, window: int) -> np.ndarray:
    """(T,) standard deviation of e: robust, of the whole and of the neighbourhood, whichever is larger."""
    count = max(1, len(e) // window)
    edges = np.linspace(0, len(e), count + 1).astype(int)
    whole = 1.4826 * float(np.median(np.abs(e[e != 0]))) if (e != 0).any() else 1.0
    levels = [1.4826 * float(np.median(np.abs(e[a:b]))) for a, b in itertools.pairwise(edges)]
    middles = 0.5 * (edges[:-1] + edges[1:])
    return np.maximum(np.interp(np.arange(len(e)), middles, levels), max(whole, 1e-12))

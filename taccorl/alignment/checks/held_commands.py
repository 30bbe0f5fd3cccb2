"""Commands that never reached the drive: the drive then holds the previous target for one or more command periods.

A dropped command k changes the applied target u_a by u(k − 1) − u(k + j) for the m rows until a command arrives. The measured
position then deviates by that pulse through the joint's own response:

    y = G u_a + r,    G: second-order lag with gain, delay and offset, fitted;   r: coloured, A(q) r = e white
    e(t) ≈ Σ over events  w(t) * pulse(t),    w = A(q) G

The score of a pulse is the reduction of ½ Σ e²/σ² by it. The largest ones of their neighbourhoods are events; they are taken off,
and the score is computed again until none is left. A pulse always points backwards along the motion. Disturbances, friction and
noise have no preferred direction, so that pulses that point *forwards* estimate the number of false events.

Letters in shapes: T rows, L rows of the response, R updates of the command.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import toeplitz
from scipy.ndimage import maximum_filter1d
from scipy.optimize import least_squares
from scipy.signal import lfilter

from taccorl.alignment.checks.first_order import beside
from taccorl.alignment.measurements.measurement import Measurement

HOLDS = (
    1,
    2,
    3,
    4,
    6,
    8,
    12,
    16,
)  # Lengths of a hold that are searched [command periods]
AR_ORDER = 6  # Order of the whitening filter A(q)
PASSES = 4  # Number of fits of response and noise, each without the events found so far: events bend both
LEAD_ROWS = 4  # Rows of the response before the impulse: a delay of part of a row spreads it to both sides
RESPONSE_S = 0.4  # Length of the response that is used [s]
LEAST_GAIN = 12.0  # Least score of an event: noise alone causes one in about 10⁵ rows
LOCAL_S = 0.5  # Window in which a local σ is estimated, too [s]: unmodelled physics occurs in some places only
OMEGA_RAD_PER_S, ZETA, DELAY_ROWS = (2.0, 400.0), (0.2, 20.0), (-2.0, 12.0)
"""Ranges of the parameters of the fitted response: natural frequency [rad/s], damping ratio, delay [rows]."""
STOOD_S = (
    0.075  # A target that begins to move after it stood for so long turns there [s]
)
MOVES = 2e-3  # Least motion of a target that can show a dropped command [rad, m]
LEAST_EVENTS, MIRRORED = 6, 4
"""Dropped commands are reported from ``LEAST_EVENTS`` + ``MIRRORED`` × events of the opposite sign on: an effect
that makes the joint lag (a torque limit) leaves up to four that are none."""
BY_CHANCE = 0.01
"""Events are taken for play or sticking friction, not for dropped commands, if commands dropped at random times would gather as
much at one place between two turns of the target with a probability below this."""

type Events = list[tuple[int, int]]
"""First row at which the previous target was still in force, and number of rows for which it was."""


@dataclass(frozen=True, kw_only=True)
class Dropped:
    """Dropped commands of one signal in all recordings."""

    times_s: dict[str, tuple[float, ...]]
    """Recording → times at which a previous target stayed in force; recordings without one are left out."""
    commands: int  # Number of changes of the command that were searched
    held: float  # Number of commands during which a previous target was in force
    mirrored: int  # Number of events of the opposite sign, which estimates that of false events
    ranks: tuple[float, ...]
    """For each event the share of commands whose loss could be seen that lie before it between two turns of the target; uniform
    if commands are dropped at random times."""

    @property
    def found(self) -> int:
        """Number of dropped commands that were found in all recordings."""
        return sum(map(len, self.times_s.values()))

    @property
    def certain(self) -> bool:
        """True if pulses of the right sign clearly outnumber those of the opposite sign and do not gather at one place between
        the turns of the target, so that commands were dropped. Play and sticking hold a joint once after each turn."""
        return (
            self.found >= LEAST_EVENTS + MIRRORED * self.mirrored
            and _uniform(np.array(self.ranks)) >= BY_CHANCE
        )

    @property
    def rate(self) -> float:
        """Share of commands that were found dropped. It is a lower bound, because slow motion does not show them."""
        return self.held / self.commands


def find_dropped(measurements: Sequence[Measurement], j: int) -> Dropped | None:
    """Find dropped commands of signal ``j``; None if no recording has enough measured rows of a position target that moves."""
    times_s, commands, mirrored, held, ranks = {}, 0, 0, 0.0, []
    rng = np.random.default_rng(0)
    for m in measurements:
        target, measured = m.target[:, j], m.measured[:, j]
        changed = np.flatnonzero(np.diff(target) != 0) + 1
        followed = (
            m.pressed is None
            and m.target_kind(m.signals[j]) == "position"
            and np.isfinite(target).all()
        )
        if (
            not followed
            or np.ptp(target) < MOVES
            or len(changed) < 50
            or np.isfinite(measured).sum() < 200
        ):
            continue
        events, others, visible = _events(target, measured, changed, m.period_s)
        commands, mirrored = commands + len(changed), mirrored + len(others)
        if not events:
            continue
        times_s[m.name] = tuple(float(m.time_s[row]) for row, _ in events)
        held += sum(rows for _, rows in events) / int(np.median(np.diff(changed)))
        phase = _phase(target, changed, m.period_s)
        for row, rows in events:
            seen, own = phase[visible[rows] | (changed == row)], phase[changed == row]
            before, equal = float(np.mean(seen < own)), float(np.mean(seen == own))
            ranks.append(before + equal * rng.random())
    if not commands:
        return None
    return Dropped(
        times_s=times_s,
        commands=commands,
        held=held,
        mirrored=mirrored,
        ranks=tuple(ranks),
    )


def _phase(target: np.ndarray, changed: np.ndarray, period_s: float) -> np.ndarray:
    """(R,) time of each update since the target changed direction, or began to move after it stood for ``STOOD_S``, as a share of
    the time between two such turns."""
    way = np.sign(target[changed] - target[changed - 1])
    stood = np.diff(changed, prepend=-len(target)) * period_s > STOOD_S
    turned = np.append(
        changed[stood | (np.diff(way, prepend=way[0]) != 0)], len(target)
    )
    last = np.searchsorted(turned, changed, side="right") - 1
    return (changed - turned[last]) / (turned[last + 1] - turned[last])


def _uniform(ranks: np.ndarray) -> float:
    """Probability that numbers drawn evenly from 0 to 1 gather as much anywhere: Kuiper's test (Stephens 1970)."""
    at, n = np.sort(ranks), len(ranks)
    gathered = float(
        np.max(np.arange(1, n + 1) / n - at) + np.max(at - np.arange(n) / n)
    )
    x = (math.sqrt(n) + 0.155 + 0.24 / math.sqrt(n)) * gathered
    k = np.arange(1, 30)
    return (
        min(1.0, float(2 * np.sum((4 * (k * x) ** 2 - 1) * np.exp(-2 * (k * x) ** 2))))
        if x > 0.4
        else 1.0
    )


def _events(
    target: np.ndarray, measured: np.ndarray, changed: np.ndarray, period_s: float
) -> tuple[Events, Events, dict[int, np.ndarray]]:
    """Dropped commands, events of the opposite sign, and rows of a hold → (R,) bool: it could be seen if it began there.
    ``target``: (T,) commanded targets [rad, m], in force from row k on. ``measured``: (T,) positions at row k [rad, m]; NaN where
    not measured. ``changed``: (R,) rows in which the target changes."""
    found: Events = []
    others: Events = []
    visible: dict[int, np.ndarray] = {}
    for _ in range(PASSES):
        pulses = np.zeros(len(target))  # applied less commanded target
        for row, rows in found:
            pulses[row : row + rows] = target[row - 1] - target[row : row + rows]
        left, response = _fitted(target, target + pulses, measured, period_s)
        clean = left - np.convolve(pulses, response)[: len(target)]
        whiten = _whitening(clean)
        sigma = _local_sigma(_filtered(whiten, clean), round(LOCAL_S / period_s))
        w, before = lfilter(whiten, [1.0], response), len(found)
        found, others, visible = _pursued(
            target, _filtered(whiten, left), sigma, w, changed
        )
        if len(found) == before:
            break
    return found, others, visible


def _pursued(
    target: np.ndarray,
    e: np.ndarray,
    sigma: np.ndarray,
    w: np.ndarray,
    changed: np.ndarray,
) -> tuple[Events, Events, dict[int, np.ndarray]]:
    """Find lost and late commands by matching pursuit, in the order of rows; the commands fix each one's amplitude. ``e``: (T,)
    whitened residual, ``sigma``: its standard deviation, ``w``: (L,) response of ``e`` to the applied target."""
    lengths = np.array(HOLDS) * int(np.median(np.diff(changed)))
    auto = np.correlate(w, w, "full")[len(w) - 1 :]
    auto = np.pad(auto, (0, max(0, int(lengths[-1]) - len(auto))))
    held, last = target[changed - 1], len(target)
    ends = np.minimum(changed + lengths[:, None], last)
    energy = []
    for length in lengths:
        at = np.minimum(changed[:, None] + np.arange(length), last - 1)
        pulse = (held[:, None] - target[at]) * (
            changed[:, None] + np.arange(length) < last
        )
        energy.append(
            np.einsum("ri,ri->r", pulse @ toeplitz(auto[:length]), pulse)
            / sigma[changed] ** 2
        )
    reach, taken = len(w) + int(lengths[-1]), np.zeros(len(changed), dtype=bool)
    found: dict[bool, Events] = {True: [], False: []}
    while True:
        score = np.correlate(
            np.append(e / sigma**2, np.zeros(len(w) - 1)), w, "valid"
        )  # Σ_i w_i e(t + i) / σ²
        sums, moments = (
            np.concatenate([[0.0], np.cumsum(x)]) for x in (score, score * target)
        )
        cross = held * (sums[ends] - sums[changed]) - (moments[ends] - moments[changed])
        gains = np.abs(cross) - 0.5 * np.array(energy)
        best = np.argmax(gains, axis=0)
        gain = np.where(taken, -np.inf, np.max(gains, axis=0))
        around = np.full(last, -np.inf)
        around[changed] = gain
        peaks = np.flatnonzero(
            (gain > LEAST_GAIN)
            & (gain == maximum_filter1d(around, 2 * reach + 1)[changed])
        )
        if not len(peaks):
            visible = {
                int(rows): 0.5 * own > LEAST_GAIN
                for rows, own in zip(lengths, energy, strict=True)
            }
            return sorted(found[True]), sorted(found[False]), visible
        change = np.zeros(last)
        for k in peaks:
            row, length, backwards = (
                int(changed[k]),
                int(lengths[best[k]]),
                bool(cross[best[k], k] > 0),
            )
            found[backwards].append((row, length))
            own = held[k] - target[row : row + length]
            change[row : row + length] += own if backwards else -own
            taken |= np.abs(changed - row) < length
        e = e - np.convolve(change, w)[:last]


def _fitted(
    target: np.ndarray, applied: np.ndarray, measured: np.ndarray, period_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """((T,) measured − G target, (L,) impulse response of G per row); G is fitted to what was applied."""
    u = applied - target[0]
    seen = np.isfinite(measured)
    impulse = np.zeros(round(RESPONSE_S / period_s) + LEAD_ROWS)
    impulse[LEAD_ROWS] = 1.0  # a delay of part of a row spreads it to both sides

    def answer(x: np.ndarray, drive: np.ndarray) -> np.ndarray:
        late = np.interp(
            np.arange(len(drive)) - x[2],
            np.arange(len(drive)),
            drive,
            left=drive[0] * (x[2] <= 0),
        )
        return np.asarray(
            lfilter(*_held(math.exp(x[0]), math.exp(x[1]), period_s), late)
        )

    def residual(x: np.ndarray) -> np.ndarray:
        return beside(measured[seen], answer(x, u)[seen])[0]

    low, high = (
        np.array([math.log(OMEGA_RAD_PER_S[k]), math.log(ZETA[k]), DELAY_ROWS[k]])
        for k in (0, 1)
    )
    starts = [
        (math.log(w), math.log(z), 0.5)
        for w, z in ((12.0, 1.0), (30.0, 1.0), (60.0, 3.0), (15.0, 1.5))
    ]
    start = min(starts, key=lambda x: float((residual(np.array(x)) ** 2).sum()))
    best = least_squares(
        residual,
        start,
        bounds=(low, high),
        x_scale=(0.1, 0.1, 0.5),
        max_nfev=15,
        ftol=1e-4,
    ).x
    design = np.column_stack([answer(best, u), np.ones(len(u))])
    solution = np.linalg.lstsq(design[seen], measured[seen], rcond=None)[0]
    commanded = np.column_stack([answer(best, target - target[0]), np.ones(len(u))])
    return measured - commanded @ solution, solution[0] * answer(best, impulse)[
        LEAD_ROWS:
    ]


def _held(omega: float, zeta: float, period_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Numerator (3,) and denominator (3,), by powers of q⁻¹, of the lag ω² / (s² + 2 ζ ω s + ω²) behind held values."""
    root = np.sqrt(complex(zeta**2 - 1.0)) or 1e-5
    poles = omega * (np.array([root, -root]) - zeta)
    once, twice = (np.exp(poles * period_s * k) for k in (1, 2))
    denominator = np.array([1.0, -once.sum().real, once.prod().real])
    step = [
        1.0 + ((poles[::-1] * own) @ [1, -1] / (poles[0] - poles[1])).real
        for own in (once, twice)
    ]
    second = step[1] + denominator[1] * step[0] - step[0]
    return np.array([0.0, step[0], second]), denominator


def _whitening(left: np.ndarray) -> np.ndarray:
    """(AR_ORDER + 1,) coefficients of A(q), by least squares over rows without gaps."""
    lagged = np.lib.stride_tricks.sliding_window_view(left, AR_ORDER + 1)
    lagged = lagged[np.isfinite(lagged).all(axis=1)]
    past, now = lagged[:, :-1][:, ::-1], lagged[:, -1]
    ridge = 1e-9 * (float((past**2).sum()) or 1.0) * np.eye(AR_ORDER)
    return np.append(1.0, -np.linalg.solve(past.T @ past + ridge, past.T @ now))


def _filtered(whiten: np.ndarray, left: np.ndarray) -> np.ndarray:
    """(T,) A(q) r; 0 where a row of it was not measured."""
    e = np.convolve(left, whiten)[: len(left)]
    e[: len(whiten) - 1] = 0.0
    return np.where(np.isfinite(e), e, 0.0)


def _local_sigma(e: np.ndarray, window: int) -> np.ndarray:
    """(T,) standard deviation of e: robust, of the whole and of the neighbourhood, whichever is larger."""
    edges = np.linspace(0, len(e), max(1, len(e) // window) + 1).astype(int)
    whole = 1.4826 * float(np.median(np.abs(e[e != 0]))) if (e != 0).any() else 1.0
    levels = [
        1.4826 * float(np.median(np.abs(e[a:b]))) for a, b in itertools.pairwise(edges)
    ]
    middles = 0.5 * (edges[:-1] + edges[1:])
    return np.maximum(np.interp(np.arange(len(e)), middles, levels), max(whole, 1e-12))

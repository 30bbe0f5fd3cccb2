"""Decide whether a row's effort was measured before or after the row's target acts. Both are usual; the efforts differ by the
response to the change of the target in one row.

    τ_k − K_p (q*_(k−1) − q_k) = r K_p (q*_k − q*_(k−1)) − a K_d q̇_k + b q̈_k + F sign q̇_k + S sin q_k + C cos q_k + c

r is 0 if the effort was measured before, and 1 if after; a is about 1, b an age of position or velocity, S and C the compensated
weight. The equation is that of the controller, so that it holds whatever friction and inertia the joint has. r, a and b are of
all recordings of a joint, so that each has the weight of what it determines. F, a torque with the sign of the motion, stands for
all of the drive that looks like r in a slow triangle, whose target goes as far in each row: that alone determines nothing.
"""

import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import minimum_filter1d
from scipy.signal import lfilter, savgol_filter

from taccorl.alignment.checks.registry import check, find
from taccorl.alignment.checks.trial import noise_of_rows
from taccorl.alignment.controller.drive_law import DriveLaw
from taccorl.alignment.measurements.correlation import BLOCK_S
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.alignment.measurements.noise_floor import MOVING
from taccorl.data.finding import Finding, Severity, listed

NEAR = 0.3  # Largest distance of r from 0 or 1 for a decision
SURE = 0.1
"""Largest standard error of r for a decision; otherwise there is no finding. A drive that receives targets faster than they
are logged lies in between."""
CLIPPED = 0.98  # Rows with an effort above this share of the effort limit are not used
SMOOTH_S = 0.05  # Window of the quadratic whose slope is the velocity [s]
SIGN_SURE, MOST_SHARE = 0.5, 4.0
"""Sign and size of the gain are believed if a fit of the drive's law leaves at most this share of the RMS effort, and r is at
most 4. The effort of a well damped drive is a small difference of large terms: fits with r above 30 left as little with wrong
gains; with wrong models r was 1.5 at most. Both are choices."""
MOST_EARLY, EARLY = 10, 0.5
"""Most rows by which efforts are tried as recorded too early; and largest residual of the law at a shift, as a share of that
without a shift, for which the shift is reported. Choices."""
GAINS_LEFT, GAINS_OFF, ALIKE_GAINS = 0.25, 1.3, 1.1
"""Largest residual of the fitted law as a share of the RMS effort, for which its gains are reported; least ratio of a fitted gain
to the stated one, or its inverse; and largest ratio of both ratios that a wrong unit of the effort explains, too. Choices."""
STATED_LEFT, SHARES = (1.2, 2.0), (-0.5, 1.5)
"""Fitted gains are reported if the stated gains, with the best delay and lag of the targets, leave a residual of at least 1.2
times theirs in efforts, or 2 times in accelerations where no effort was recorded, and the share r is in this range. Choices."""
ALONE_LEFT, APART, MOVED = 0.15, 1.5, 2.0
"""Choices for gains that are fitted to each recording alone: largest residual of such a fit, as a share of the RMS effort; ratio
of the gains of two recordings from which on they are of two machines (one of 7 effects made at most 1.34); and, where efforts are
computed from accelerations, least ratio of the fitted K_p to the stated one that is reported."""
LAGS_S, DELAYS_S = (0.0, 0.02), (0.0, 0.01, 0.02)
"""Lags and delays of targets that are tried [s]; the share r stands for a row more or less."""
ALIKE = 1e-3
"""Least singular value of the unit columns of a fitted law: measured positions that equal their targets show none. A choice."""


_Equations = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


@check("error", "effort_time", "other_gains")
@check("warning", "other_scale")
def check_effort_time(
    law: DriveLaw,
    recordings: Sequence[Measurement],
    found: Mapping[str, list[Finding]],
    signal: str,
    file: str,
    inertia: Callable[[Measurement], float],
) -> None:
    """Add an error to ``found`` (recording → findings) if efforts were measured before the target acts and ``law`` states after,
    or vice versa, or if they stand rows too early; none if they agree, or if the recordings do not determine it. Where they
    follow other gains than stated, or not all the same, a warning alone (``other_scale``: both are off by one factor).
    ``recordings``: those that move the signal. Ones with an error of it, or without the gains of ``law``, are not used. ``file``:
    that states the law. ``inertia``: that of the joint in a recording [kg·m²]; its accelerations stand for efforts."""
    if law.law == "effort":  # there is no drive
        return
    wrong = {
        name
        for name, own in found.items()
        for f in own
        if f.severity == "error"
        and (f.check == "effort_unit" or f.feature in (signal, ""))
    }
    every = [m for m in recordings if m.name not in wrong]
    used = [m for m in every if all(signal in getattr(m, k) for k in law.gain_names)]

    def tell(
        check: str,
        text: str,
        severity: Severity = "error",
        told: Sequence[Measurement] = used,
    ) -> None:
        for m in told:
            found[m.name].append(find(check, signal, text, severity=severity))

    moved = [_moved(m, signal, inertia(m)) for m in every]
    # Accelerations of other joints act on this one, and ``_moved`` does not know them.
    alone = [
        m
        for m in moved
        if not (
            np.ptp(np.delete(m.target, m.column(signal), axis=1), axis=0) > MOVING
        ).any()
    ]
    if text := _two_machines(law, every, signal) or _two_machines(
        law, alone, signal, unseen=True
    ):
        tell("other_gains", text, "warning", every)
        return
    unseen = not any(m.has_effort()[m.column(signal)] for m in recordings)
    seen = {m.name: m for m in (moved if unseen else every)}
    if gains := _other_gains(law, [seen[m.name] for m in used], signal, file, unseen):
        tell(*gains, "warning")
        return
    if early := _early(law, used, signal):
        tell("effort_time", early)
        return
    if (
        used and (getattr(law, "command_hz", None) or 0.0) > used[0].rate_hz
    ):  # its target moves within the row, too
        return
    share, sd = target_share(law, used, signal) or (0.0, math.inf)
    after = abs(share - 1.0) < NEAR
    if (
        sd > SURE
        or after == law.effort_after_target
        or not (after or abs(share) < NEAR)
    ):
        return
    way = (
        "is the answer to the target of the same row"
        if after
        else "was measured before the target of its row acts"
    )
    line = (
        f"Write `effort_after_target: true` for {signal}"
        if after
        else f"Remove effort_after_target of {signal}"
    )
    text = (
        f"effort of {signal} {way} (it holds {share:.2f} ± {sd:.2f} of what the target moves in one row, by {len(used)} "
        f"recordings), and {file} says otherwise. {line} in {file}. If its driver is sure of the instant, a velocity feedforward "
        "in the drive looks like this and can be accepted"
    )
    tell("effort_time", text)


def _moved(m: Measurement, signal: str, inertia: float) -> Measurement:
    """``m`` with the torque that accelerates the joint in place of its effort."""
    effort, j = np.full_like(m.measured, np.nan), m.column(signal)
    effort[:, j] = inertia * np.gradient(
        np.gradient(m.measured[:, j], m.period_s), m.period_s
    )
    return dataclasses.replace(m, effort=effort)


def _two_machines(
    law: DriveLaw, recordings: Sequence[Measurement], signal: str, unseen: bool = False
) -> str:
    """Text if recordings determine, each alone, gains that no single machine has; else empty. ``unseen``: as in ``_other_gains``;
    K_d then contains what friction takes, which may differ."""
    alone = [
        (m.name, law_fit(law, [m], signal)) for m in recordings if law.kp and law.kd
    ]
    fits = {name: fit for name, fit in alone if fit and fit.left < ALONE_LEFT}
    for gain, place in (("kp", 0), ("kd", 1))[: 2 - unseen]:
        values = {
            n: getattr(f, gain)
            for n, f in fits.items()
            if getattr(f, gain) > 20.0 * f.sd[place]
        }
        order = sorted(values, key=lambda name: values[name])
        apart = [values[b] / values[a] for a, b in itertools.pairwise(order)]
        if apart and max(apart) > APART:
            k = 1 + int(np.argmax(apart))
            return (
                f"{signal} is not the same in all recordings: the {gain}{' over inertia' * unseen} that its "
                f"{'accelerations' if unseen else 'efforts'} follow is {values[order[k]] / values[order[0]]:.2g} times as large "
                f"in {listed(order[k:])} as in {listed(order[:k])}. Move recordings of another machine into another folder; "
                "state gains or loads that were changed in measurements.yaml (kp, kd, payload_kg)"
            )
    return ""


def _other_gains(
    law: DriveLaw,
    recordings: Sequence[Measurement],
    signal: str,
    file: str,
    unseen: bool,
) -> tuple[str, str] | None:
    """Check and text on efforts that follow the law with other gains than stated; None: they do not, or do not determine it.
    ``unseen``: efforts are inertia times acceleration, so that both gains off alike may be another inertia."""
    if law.law not in ("impedance", "cascade") or not (law.kp and law.kd):
        return None

    def times(fit: LawFit) -> tuple[float, float]:
        return fit.kp / (fit.kd if law.law == "cascade" else 1.0), fit.kd

    def near(fit: LawFit) -> bool:
        return all(1 / GAINS_OFF < gain < GAINS_OFF for gain in times(fit))

    first = law_fit(law, recordings, signal)
    if first is None or (first.left <= GAINS_LEFT and near(first)):
        return None
    fit = first
    stated = math.inf
    for delay_s, lag_s in itertools.product(DELAYS_S, LAGS_S):
        late = [_late(m, delay_s, lag_s) for m in recordings]
        found = _all_equations(law, late, signal, smooth=True)
        if found is None:
            return None
        stated = min(stated, _stated_left(found, unseen))
        later = None if lag_s else _law_fit(found)
        if later is not None and later.left < min(fit.left, EARLY * first.left):
            fit = later
    sure = min(fit.kp - 10 * fit.sd[0], fit.kd - 10 * fit.sd[1]) > 0.0
    if (
        not sure
        or fit.left > GAINS_LEFT
        or near(fit)
        or not SHARES[0] < fit.share / fit.kp < SHARES[1]
        or stated < STATED_LEFT[unseen] * fit.left
    ):
        return None
    m, (kp, kd) = recordings[0], times(fit)
    if unseen and (max(kp, 1 / kp) < MOVED or max(kp / kd, kd / kp) < GAINS_OFF):
        return None
    text = (
        f"{'acceleration times inertia' if unseen else 'effort'} of {signal} is that of its law with "
        f"`kp: {m.kp[signal] * kp:.3g}` and `kd: {m.kd[signal] * kd:.3g}`: {kp:.2f} and {kd:.2f} times the stated ones, which "
        f"leaves {fit.left:.0%} of it. If the stated gains are a guess, write what the drive runs into {file} or "
        f"measurements.yaml, or these and `gains: fitted` into {file}, which fits them"
    )
    if law.law == "impedance" and max(kp / kd, kd / kp) < ALIKE_GAINS:
        text += f"; else the effort's unit is off, `factor: {2 / (kp + kd):.3g}`, or torque_scale is missing"
        return "other_scale", text
    return "other_gains", text


def _late(m: Measurement, delay_s: float, lag_s: float = 0.0) -> Measurement:
    """``m`` with targets that act after a delay and a first-order lag."""
    rows, start, decay = (
        round(delay_s / m.period_s),
        m.target[:1],
        math.exp(-m.period_s / lag_s) if lag_s else 0.0,
    )
    late = np.concatenate(
        [np.repeat(start, rows, axis=0), m.target[: m.num_rows - rows]]
    )
    return dataclasses.replace(
        m, target=lfilter([1 - decay], [1, -decay], late, axis=0, zi=decay * start)[0]
    )


def _stated_left(found: _Equations, unseen: bool) -> float:
    """Share of the effort that the stated gains leave beside any b and integral of the position error and any r (0.5 for
    accelerations, ``unseen``)."""
    columns, effort, *_ = found
    more = columns[:, [2, 4] if unseen else [0, 2, 4]]
    rest = effort - columns[:, 3] + columns[:, 1]
    if unseen:
        rest = rest - 0.5 * columns[:, 0]
    rest = rest - more @ np.linalg.lstsq(more, rest, rcond=None)[0]
    return float(np.linalg.norm(rest)) / max(float(np.linalg.norm(effort)), 1e-300)


def _early(law: DriveLaw, recordings: Sequence[Measurement], signal: str) -> str:
    """Text if efforts are recorded one or more rows before the position and target that produced them, which no effect of a drive
    can imitate; else empty. Rows are tried one after the other, as long as the law leaves less of the efforts."""
    left = [_law_left(law, recordings, signal, 0)]
    while len(left) <= MOST_EARLY and (len(left) < 2 or left[-1][0] < left[-2][0]):
        left.append(_law_left(law, recordings, signal, len(left)))
    as_is, best = min(left[0]), int(np.argmin([stated for stated, _ in left]))
    least = left[best][0]
    if best == 0 or least > min(EARLY * as_is, SIGN_SURE):
        return ""
    rows_ms = best * recordings[0].period_s * 1e3
    return (
        f"effort of {signal} stands {best} row{'' if best == 1 else 's'} ({rows_ms:.3g} ms) too early: its law leaves "
        f"{as_is:.0%} of it at position and target of its row, and {least:.0%} so much later. Move the column {signal}.tau by "
        "as much, or leave it out; effort_after_target is no remedy: it moves the target alone"
    )


def _law_left(
    law: DriveLaw, recordings: Sequence[Measurement], signal: str, rows: int
) -> tuple[float, float]:
    """Share (RMS) of the efforts of ``rows`` rows before that the numbers of ``law`` leave, whatever weight is carried, with the
    target as stated and as not stated; 1 if the recordings do not determine it."""
    squares = np.zeros(3)
    for m in [] if law.law == "torque" else recordings:
        late = [np.repeat(m.effort[:1], rows, axis=0), m.effort[: m.num_rows - rows]]
        late = dataclasses.replace(m, effort=np.concatenate(late))
        if (found := _equations(law, late, signal)) is None:
            continue
        columns, effort, *_ = found
        rest = effort - columns[:, 3] + columns[:, 1]
        parts = (rest, rest - columns[:, 0], effort)
        squares += [float(np.mean(part**2)) for part in parts]
    before, after, size = np.sqrt(squares).tolist()
    pair = (after, before) if law.effort_after_target else (before, after)
    return (pair[0] / size, pair[1] / size) if size else (1.0, 1.0)


def law_error(law: DriveLaw, m: Measurement, signal: str, speed_age_s: float) -> float:
    """RMS [unit of the effort] of recorded efforts minus those of the file's law at the rows' own targets and positions, with a
    speed that the drive knows ``speed_age_s`` late: an error of the drive's numbers alone, whatever the joint lacks. inf if the
    recording does not determine it."""
    j, late = m.column(signal), 0 if law.effort_after_target else 1
    if (
        law.law in ("pwm", "effort", "torque")
        or not m.has_effort()[j]
        or m.num_rows < 4
    ):
        return math.inf
    kp, kd, torque_ff = law.loop_gains
    kp_scale, kd_scale = law.gain_scales(signal, m)
    q, target = m.measured[:, j], np.roll(m.target[:, j], late)
    speed = np.interp(m.time_s - speed_age_s, m.time_s, np.gradient(q, m.period_s))
    asked = (
        kp * kp_scale * (target - q)
        if law.target_kind == "position"
        else kd * kd_scale * target
    )
    error = m.effort[:, j] - asked + kd * kd_scale * speed - torque_ff
    if m.torque_ff.size:
        error = error - np.roll(m.torque_ff[:, j], late)
    rows = _of_law(law, m, j)
    rows[: late + 1 + math.ceil(speed_age_s / m.period_s)] = False
    return (
        float(np.sqrt(np.mean(error[rows] ** 2)))
        if rows.any() and np.isfinite(error[rows]).all()
        else math.inf
    )


def _of_law(law: DriveLaw, m: Measurement, j: int) -> np.ndarray:
    """(T,) whether the drive is on, and below its limit."""
    rows = np.ones(m.num_rows, dtype=bool)
    if law.effort_limit is not None:
        rows = np.abs(m.effort[:, j]) < CLIPPED * law.effort_limit
    return rows & (m.enabled[:, j] != 0.0) if m.enabled.size else rows


def target_share(
    law: DriveLaw, recordings: Sequence[Measurement], signal: str
) -> tuple[float, float] | None:
    """r (see the module; 0: measured before the target acts, 1: after) and its standard error, from the scatter of half seconds;
    None if the recordings do not determine them."""
    if (found := _all_equations(law, recordings, signal)) is None:
        return None
    columns, effort, *more = found
    solved = _solved(columns[:, :3], effort - columns[:, 3], *more)
    return None if solved is None else (float(solved[0, 0]), float(solved[1, 0]))


class LawFit(NamedTuple):
    """The law that recorded efforts follow, relative to the stated one."""

    kp: float
    """Ratio of the fitted gain of the position error to the stated one (impedance: K_p; cascade: K_p times K_d)."""
    kd: float  # Ratio of the fitted K_d to the stated one
    sd: tuple[float, float]  # Standard errors of both
    left: float  # RMS of the residual of the fitted law over the RMS of the effort, both smoothed
    share: float  # r times ``kp``, for efforts in another unit

    @property
    def sign(self) -> int:
        """Sign of ``kp``; 0 if the efforts do not determine it."""
        least = max(3.0 * self.sd[0], abs(self.share) / MOST_SHARE)
        return (
            0
            if self.left > SIGN_SURE or abs(self.kp) < least
            else (1 if self.kp > 0.0 else -1)
        )


def law_fit(
    law: DriveLaw, recordings: Sequence[Measurement], signal: str
) -> LawFit | None:
    """The law of recorded efforts, by the equation of the module with K_p free and b = 0; None if they do not determine it."""
    found = _all_equations(law, recordings, signal, smooth=True)
    return None if found is None else _law_fit(found)


def _law_fit(found: _Equations) -> LawFit | None:
    columns, effort, *more = found
    columns = columns[:, [0, 1, 3]]
    size, solved = np.linalg.norm(columns, axis=0), _solved(columns, effort, *more)
    if solved is None or not size.all():
        return None
    if np.linalg.svd(columns / size, compute_uv=False)[-1] < ALIKE:
        return None
    solution, sd = solved.tolist()
    rest = np.linalg.norm(effort - columns @ solution)
    share = float(rest / max(float(np.linalg.norm(effort)), 1e-300))
    return LawFit(solution[2], -solution[1], (sd[2], sd[1]), share, solution[0])


def law_of_all(
    law: DriveLaw, recordings: Sequence[Measurement], signal: str
) -> LawFit | None:
    """``law_fit`` of all recordings together. If that leaves the sign open, but at least two recordings have a sure sign each and
    all of these signs are reversed: the fit of the recording that leaves least."""
    whole = law_fit(law, recordings, signal)
    if whole is None or whole.sign:
        return whole
    alone = [fit for m in recordings if (fit := law_fit(law, [m], signal)) and fit.sign]
    reversed_ = len(alone) > 1 and all(fit.sign < 0 for fit in alone)
    return min(alone, key=lambda fit: fit.left) if reversed_ else whole


def _all_equations(
    law: DriveLaw,
    recordings: Sequence[Measurement],
    signal: str,
    *,
    smooth: bool = False,
) -> _Equations | None:
    """``_equations`` of all recordings; in place of half seconds (N, 2) numbers of recording and half second."""
    parts = [
        part
        for m in recordings
        if (part := _equations(law, m, signal, smooth=smooth)) is not None
    ]
    if not parts:
        return None
    columns, effort, noise, half_s = (
        np.concatenate(part) for part in zip(*parts, strict=True)
    )
    blocks = np.column_stack(
        [np.repeat(np.arange(len(parts)), [len(part[1]) for part in parts]), half_s]
    )
    return columns, effort, noise, blocks


def _solved(
    columns: np.ndarray, left: np.ndarray, noise: np.ndarray, blocks: np.ndarray
) -> np.ndarray | None:
    """(2, n) least-squares solution for the (N, n) ``columns``, and its standard errors, by the scatter between half seconds."""
    scale = np.linalg.norm(columns, axis=0)
    if scale[0] == 0.0:
        return None
    scale[scale == 0] = 1.0
    columns = columns / scale
    square = columns.T @ columns
    # The velocity is noisy, and would count for too little: its noise, from fourth differences of positions, is taken off.
    square[1, 1] -= float(noise.sum()) / scale[1] ** 2
    inverse = np.linalg.pinv(square)
    if square[1, 1] < 0.0 or inverse[0, 0] <= 0.0:  # hardly anything but noise moves
        return None
    solution = inverse @ columns.T @ left
    moves = (columns @ inverse) * (left - columns @ solution)[:, None]
    _, number = np.unique(blocks, axis=0, return_inverse=True)
    count = int(number.max()) + 1
    of_blocks = np.array([np.bincount(number.ravel(), own) for own in moves.T])
    variance = np.square(of_blocks).sum(axis=1) * count / max(count - 1, 1)
    return np.array([solution, np.sqrt(variance)]) / scale


def _equations(
    law: DriveLaw, m: Measurement, signal: str, *, smooth: bool = False
) -> _Equations | None:
    """(N, 5) what r, − a, b and K_p multiply, the last in torques of the law's, and the integral of that; (N,) the effort, all
    without what the other terms explain in this recording; (N,) squared noise of the second column; (N,) number of the half
    second. None if it cannot be judged. ``smooth``: all are filtered alike, which takes noise off and keeps the law."""
    j = m.column(signal)
    q, effort, target = m.measured[:, j], m.effort[:, j], m.target[:, j]
    if m.torque_ff.size:
        effort = effort - m.torque_ff[:, j]
    window = max(5, 2 * round(0.5 * SMOOTH_S * m.rate_hz) + 1)
    if (
        law.law in ("pwm", "effort")
        or not m.has_effort()[j]
        or not np.isfinite([q, effort, target]).all()
        or m.num_rows < 4 * window
    ):
        return None
    kp, kd, _ = law.loop_gains
    kp_scale, kd_scale = law.gain_scales(signal, m)
    damping = kd * kd_scale or 1.0  # of law torque a is the damping itself
    gain = {"position": kp * kp_scale, "velocity": kd * kd_scale, "torque": 1.0}[
        law.target_kind
    ]
    v, a = (
        np.gradient(q, m.period_s)[1:],
        savgol_filter(q, window, 2, deriv=2, delta=m.period_s)[1:],
    )
    speed, angle = savgol_filter(q, window, 2, deriv=1, delta=m.period_s)[1:], q[1:]
    asked = gain * (target[:-1] - (angle if law.target_kind == "position" else 0.0))
    others = np.column_stack(
        [np.sign(speed), np.sin(angle), np.cos(angle), np.ones_like(v)]
    )
    rows = _of_law(law, m, j)[1:]
    integral = np.cumsum(asked) * m.period_s
    every = np.column_stack(
        [gain * np.diff(target), damping * v, damping * a, asked, integral, effort[1:]]
    )
    noise = 0.5 * (damping * noise_of_rows(q) / m.period_s) ** 2
    inner = minimum_filter1d(rows, window, mode="constant")
    if smooth and 2 * inner.sum() >= len(
        rows
    ):  # few of efforts in another unit are below the limit
        every, others = (
            savgol_filter(terms, window, 2, axis=0) for terms in (every, others)
        )
        rows, noise = inner, 0.0
    every, others = every[rows], others[rows]
    if len(every) < 4 * window:
        return None
    every -= others @ np.linalg.lstsq(others, every, rcond=None)[0]
    return (
        every[:, :5],
        every[:, 5],
        np.full(len(every), noise),
        np.flatnonzero(rows) * m.period_s // BLOCK_S,
    )

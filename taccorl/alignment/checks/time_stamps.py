"""Checks of a measurement's time stamps: increasing, even, without gaps, at the stated rate."""

from collections.abc import Iterator

import numpy as np

from taccorl.alignment.checks.registry import check, find
from taccorl.alignment.checks.trial import Trial, without, write
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.alignment.measurements.tables import is_table
from taccorl.data.finding import Finding

RATE_HZ = (
    5.0,
    5000.0,
)  # Range of plausible row rates [Hz]; outside it the times are probably in another unit
GAP, JITTER = 1.5, 0.1
"""Steps above the first [median periods] are lost rows; at most a twentieth of the steps may deviate by more than the second."""
FLOAT32_S = 1e-3
"""Least distance of neighbouring numbers of 32 bits at which equal times are attributed
to that rounding [s]. A choice."""
RATE_SHARE = 0.8  # Least rate, as a share of the rate that the spec states


@check("error", "time_backwards", "time_unit")
@check("warning", "row_times", needs="rows")
def check_time(t: Trial) -> Iterator[Finding]:
    """Time stamps that do not increase, are uneven, or have gaps."""
    m = t.m
    steps = np.diff(m.time_s)
    if not np.isfinite(m.time_s).all() or (steps <= 0).any():
        bad = ~(steps > 0)
        row = int(np.argmax(bad))
        how = f"goes from {m.time_s[row]:.6f} to {m.time_s[row + 1]:.6f} s"
        ways = "sort the table by time, leave repeated rows out, or log the driver's own stamps"
        if (steps[bad] == 0).all():
            how, ways = (
                f"stands still at {m.time_s[row]:.6f} s",
                _float32(m) or "leave repeated rows out, or log stamps of their own",
            )
        elif bad.all():
            how, ways = f"{how}, backwards as all through,", "sort the table by time"
        text = f"time {how} at row {row + 1}, {int(bad.sum())} such rows: {ways}"
        yield find("time_backwards", "time", text, (row, row + 2))
        return
    if m.num_rows > 1 and not RATE_HZ[0] <= m.rate_hz <= RATE_HZ[1]:
        text = (
            f"{m.rate_hz:g} rows a second over {m.time_s[-1]:g} s: are its times in ms, µs or ns? State the unit in "
            "the columns file"
        )
        yield find("time_unit", "time", text)
        return
    yield from _steps(m, steps)
    yield from _channels(m)
    if m.time_error_s > 0:
        text = (
            f"positions and commands may lie up to {m.time_error_s * 1e3:.1f} ms from their rows' times (rows show "
            "the last sample, or have no stamps): measure gains and delays from the recordings themselves"
        )
        yield find("row_times", "time", text)


def _float32(m: Measurement) -> str:
    """Way out if the times are those of a column of float32, which rounds them to equal
    ones; empty if they are not."""
    written_s = m.start_ns * 1e-9 + m.time_s
    stored = written_s.astype(np.float32)
    spacing_s = float(np.spacing(np.abs(stored).max()))
    changed = np.diff(m.time_s) > 0
    if (
        not FLOAT32_S <= spacing_s < np.inf
        or (np.abs(written_s - stored) > 0.01 * spacing_s).any()
        or (np.diff(m.time_s)[changed] < 0.5 * spacing_s).any()
    ):
        return ""
    return (
        f"at {written_s[0]:.0f} s numbers of 32 bits are {spacing_s:g} s apart; write "
        "the column of times with 64 bits, or from the start of the recording on"
    )


@check("error", "dropped_rows", "jitter")
def _steps(m: Measurement, steps: np.ndarray) -> Iterator[Finding]:
    """Errors of tables: reading made these even where that is possible, and no replay takes the others."""
    period, severity = m.period_s, "error" if is_table(m) else "warning"
    gaps = np.flatnonzero(steps > GAP * period)
    if len(gaps):
        worst = int(gaps[np.argmax(steps[gaps])])
        lost = int(np.round(steps[gaps] / period - 1).sum())
        text = (
            f"{lost} rows are missing in {len(gaps)} gaps, the longest {steps[worst] * 1e3:.1f} ms after row "
            f"{worst} ({m.time_s[worst]:.3f} s); rows come every {period * 1e3:.2f} ms: "
            f"{write(m, f'{without(m, worst + 1)}, or', 'a replay draws a straight line there;')} record with less load on the "
            "logger"
        )
        yield find("dropped_rows", "time", text, (worst, worst + 2), severity=severity)
    off = np.abs(steps - period)[steps <= GAP * period] / period
    if len(off) and np.quantile(off, 0.95) > JITTER:
        worst = int(
            np.argmax(np.where(steps <= GAP * period, np.abs(steps - period), 0.0))
        )
        text = (
            f"steps between rows vary by ±{np.quantile(off, 0.95) * period * 1e3:.2f} ms (95 %) about "
            f"{period * 1e3:.2f} ms, worst at row {worst + 1} ({m.time_s[worst + 1]:.3f} s): times of a busy "
            "computer; log the driver's or the bus's own stamps"
        )
        yield find("jitter", "time", text, (worst, worst + 2), severity=severity)


@check("warning", "low_rate", "out_of_order")
@check("note", "duplicates")
def _channels(m: Measurement) -> Iterator[Finding]:
    for t in m.timing:
        if t.nominal_hz and t.rate_hz < RATE_SHARE * t.nominal_hz:
            text = (
                f"{t.channel} came at {t.rate_hz:.1f} Hz, the spec says {t.nominal_hz:g}: commands between are "
                "lost; correct the driver"
            )
            yield find("low_rate", t.channel, text)
        if t.duplicates > (1.0 - RATE_SHARE) * t.rate_hz * (
            m.time_s[-1] - m.time_s[0]
        ):  # a few are usual
            text = f"{t.duplicates} samples of {t.channel} repeat the stamp of another; the first of each was kept"
            yield find("duplicates", t.channel, text, topic="stamps")
        if t.out_of_order:
            text = (
                f"{t.out_of_order} samples of {t.channel} were stamped before the one ahead of them (sorted now): "
                "check its clock"
            )
            yield find("out_of_order", t.channel, text)
        if (
            t.align == "line"
            and t.age_median_s > JITTER / t.rate_hz
            and t.age_median_s > JITTER * m.period_s
        ):
            text = (
                f"samples of {t.channel} lie {t.age_median_s * 1e3:.2f} ms (median) beside the rows: they were brought to the "
                "rows in straight lines, which smooths their noise. Let one loop send commands and read positions"
            )
            yield find("jitter", t.channel, text, severity="warning")

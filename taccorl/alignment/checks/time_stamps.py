"""Checks of a measurement's time stamps: increasing, even, without gaps, at the stated rate."""

import numpy as np

from taccorl.alignment.measurements.measurement import Measurement
from taccorl.data.finding import Finding

RATE_HZ = (5.0, 5000.0)
"""Range of plausible row rates [Hz]; outside it the times are probably in another unit."""
GAP, JITTER = 1.5, 0.1
"""Steps above the first [median periods] are lost rows; at most a twentieth of the steps may deviate by more than the second."""
RATE_SHARE = 0.8
"""Least rate, as a share of the rate that the spec states."""


def check_time(m: Measurement) -> list[Finding]:
    """Findings about time stamps that do not increase, are uneven, or have gaps; empty if there are none."""
    steps = np.diff(m.time_s)
    if not np.isfinite(m.time_s).all() or (steps <= 0).any():
        row = int(np.argmax(~(steps > 0)))
        text = (
            f"time goes from {m.time_s[row]:.6f} to {m.time_s[row + 1]:.6f} s at row {row + 1}, "
            f"{int((~(steps > 0)).sum())} such rows: sort the table by time, leave repeated rows out, or log the "
            "driver's own stamps"
        )
        return [Finding("time_backwards", "error", "time", text, (row, row + 2))]
    if m.num_rows > 1 and not RATE_HZ[0] <= m.rate_hz <= RATE_HZ[1]:
        text = (
            f"{m.rate_hz:g} rows a second over {m.time_s[-1]:g} s: are its times in ms, µs or ns? State the unit in "
            "the columns file"
        )
        return [Finding("time_unit", "error", "time", text)]
    findings = _check_steps(m, steps) + _check_channels(m)
    if m.time_error_s > 0:
        text = (
            f"positions and commands may lie up to {m.time_error_s * 1e3:.1f} ms from their rows' times (rows show "
            "the last sample, or have no stamps): measure gains and delays from the recordings themselves"
        )
        findings.append(Finding("row_times", "warning", "time", text))
    return findings


def _check_steps(m: Measurement, steps: np.ndarray) -> list[Finding]:
    findings = []
    period = m.period_s
    gaps = np.flatnonzero(steps > GAP * period)
    if len(gaps):
        worst = int(gaps[np.argmax(steps[gaps])])
        lost = int(np.round(steps[gaps] / period - 1).sum())
        text = (
            f"{lost} rows are missing in {len(gaps)} gaps, the longest {steps[worst] * 1e3:.1f} ms after row "
            f"{worst} ({m.time_s[worst]:.3f} s); rows come every {period * 1e3:.2f} ms. A replay draws a straight "
            "line there: record with less load on the logger"
        )
        findings.append(Finding("dropped_rows", "warning", "time", text, (worst, worst + 2)))
    off = np.abs(steps - period)[steps <= GAP * period] / period
    if len(off) and np.quantile(off, 0.95) > JITTER:
        worst = int(np.argmax(np.where(steps <= GAP * period, np.abs(steps - period), 0.0)))
        text = (
            f"steps between rows vary by ±{np.quantile(off, 0.95) * period * 1e3:.2f} ms (95 %) about "
            f"{period * 1e3:.2f} ms, worst at row {worst + 1} ({m.time_s[worst + 1]:.3f} s): times of a busy "
            "computer; log the driver's or the bus's own stamps"
        )
        findings.append(Finding("jitter", "warning", "time", text, (worst, worst + 2)))
    return findings


def _check_channels(m: Measurement) -> list[Finding]:
    findings = []
    for t in m.timing:
        if t.nominal_hz and t.rate_hz < RATE_SHARE * t.nominal_hz:
            text = (
                f"{t.channel} came at {t.rate_hz:.1f} Hz, the spec says {t.nominal_hz:g}: commands between are "
                "lost; correct the driver"
            )
            findings.append(Finding("low_rate", "warning", t.channel, text))
        if t.out_of_order:
            text = (
                f"{t.out_of_order} samples of {t.channel} were stamped before the one ahead of them (sorted now): "
                "check its clock"
            )
            findings.append(Finding("out_of_order", "warning", t.channel, text))
        if t.align == "line" and t.age_median_s > JITTER / t.rate_hz and t.age_median_s > JITTER * m.period_s:
            text = (
                f"samples of {t.channel} lie {t.age_median_s * 1e3:.2f} ms (median) beside the rows: they were "
                "brought to the rows in straight lines, which smooths their noise. Let one loop send commands and "
                "read positions"
            )
            findings.append(Finding("jitter", "warning", t.channel, text))
    return findings

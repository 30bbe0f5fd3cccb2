"""Check of columns that hold a register of a drive without its sign: −9 was logged as 1033 or as 65527."""

import dataclasses
from collections.abc import Iterator

import numpy as np

from taccorl.alignment.checks.registry import check, find
from taccorl.alignment.checks.trial import Trial
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.alignment.measurements.registers import UnsignedColumn
from taccorl.data.finding import Finding

FROM_EFFORTS = (
    *("reversed_effort", "beyond_effort", "effort_unit", "effort_limit", "effort_time"),
    *("wrong_inertia", "other_gains", "other_scale", "frozen_effort", "dead_effort"),
)
"""Checks of efforts, which say nothing where the sign is lost."""
FROM_POSITIONS = (
    *("not_finite", "unit", "reversed", "measured_before_command", "late_answer"),
    *("blocked", "beyond_limits", "start_offset", "exchanged_target", "velocity_unit"),
)
"""Checks of positions, likewise."""


@check("error", "unsigned_effort", needs="rows", explains=FROM_EFFORTS)
@check("error", "unsigned_position", explains=(*FROM_EFFORTS, *FROM_POSITIONS))
def check_registers(t: Trial) -> Iterator[Finding]:
    """Find columns that jump by nearly a power of two of their own step at every change of sign."""
    for own in t.m.registers:
        if own.changes:
            row = min(own.row, t.m.num_rows - 1)
            why = (
                f"its column jumps by nearly {own.register.value:.12g} at {own.changes} changes of sign, first at row {row} "
                f"({t.m.time_s[row]:.3f} s)"
            )
            yield unsigned_register(own, why)


def unsigned_register(own: UnsignedColumn, why: str) -> Finding:
    """Finding on one column. ``why``: text that says what shows it."""
    text = (
        f"{own.quantity} of {own.signal} is a register read without its sign ({own.register.words()}): {why}. Write "
        f"`{own.line}` into a columns file, which reads the numbers with their sign"
    )
    name = "unsigned_effort" if own.quantity == "tau" else "unsigned_position"
    return find(name, own.signal, text)


def without_unsigned(
    m: Measurement, recordings: tuple[Measurement, ...]
) -> Measurement:
    """Copy of ``m`` without the efforts of signals whose efforts any of the ``recordings`` shows to be such registers."""
    signals = {
        own.signal
        for other in recordings
        for own in other.registers
        if own.changes and own.quantity == "tau"
    }
    if not signals:
        return m
    lost = np.isin(m.signals, sorted(signals))
    return dataclasses.replace(m, effort=np.where(lost, np.nan, m.effort))

"""Tables with jitter and lost rows come to an even grid; what was not measured stays NaN."""

from dataclasses import replace

import numpy as np
import pytest
from made_rows import of_signal

from taccorl.alignment.checks.telemetry import check_measurement
from taccorl.alignment.controller.joint_recording import joint_motion
from taccorl.alignment.measurements.even_rows import even_rows
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.alignment.measurements.tables import read_table
from taccorl.errors import TaccorlError
from taccorl.sim.twin import TwinConfig

RATE_HZ = 200.0


def command(time_s: np.ndarray) -> np.ndarray:
    return 0.3 * np.sin(2 * np.pi * 0.8 * np.clip(time_s - 0.5, 0, 5))


def table(time_s: np.ndarray, rows: np.ndarray) -> Measurement:
    """Rows stamped at ``time_s``; a command is of its row number, what is measured of its time."""
    seen = command(time_s - 0.05) + 1e-7 * np.random.default_rng(9).normal(
        size=len(rows)
    )
    return replace(
        of_signal("jittery.csv", RATE_HZ, command(rows / RATE_HZ), seen, "left_joint5"),
        time_s=time_s,
    )


def test_even_rows_stay_bit_identical():
    m = table(np.arange(1200) / RATE_HZ, np.arange(1200))
    assert even_rows(m) is m


def test_half_a_millisecond_of_jitter_is_taken_out():
    rows = np.arange(1200)
    time_s = rows / RATE_HZ + np.random.default_rng(0).normal(0, 5e-4, 1200).clip(
        -1e-3, 1e-3
    )
    m = table(time_s - time_s[0], rows)
    with pytest.raises(TaccorlError, match="not even"):
        joint_motion(m, TwinConfig(), "left_joint5")
    even = even_rows(m)
    assert even.rate_hz == RATE_HZ
    np.testing.assert_allclose(np.diff(even.time_s), 1 / RATE_HZ, rtol=1e-9)
    # every command in its row, bit by bit
    np.testing.assert_array_equal(even.target[:1200, 0], command(rows / RATE_HZ))
    start_s = float(np.median(time_s - time_s[0] - rows / RATE_HZ))
    wanted = command(even.time_s + start_s - 0.05)
    # A line through a sine of 0.3 rad, 0.8 Hz errs by up to A ω² h² / 8 = 2.4e-5 rad, a cubic by 3 A ω⁴ h⁴ / 128 = 3e-9 and the
    # noise of 1e-7, except where it starts and ends.
    smooth = (
        (np.abs(even.time_s - 0.55) > 0.01)
        & (np.abs(even.time_s - 5.55) > 0.01)
        & (even.time_s > 0)
    )
    assert np.abs(even.measured[:, 0] - wanted)[smooth].max() < 1e-6
    # Each target came with its row's stamp.
    assert (
        np.abs(even.command_s[:1200] + start_s - (time_s - time_s[0]))[1:].max() < 1e-9
    )
    (finding,) = even.findings
    assert (finding.check, finding.severity) == ("resampled", "warning")
    assert joint_motion(even, TwinConfig(), "left_joint5").rate_hz == RATE_HZ


def test_three_lost_rows_are_a_gap_and_no_line():
    rows = np.delete(np.arange(1200), [400, 401, 402])
    even = even_rows(table(rows / RATE_HZ, rows))
    assert even.num_rows == 1200
    np.testing.assert_array_equal(
        np.flatnonzero(~np.isfinite(even.measured[:, 0])), [400, 401, 402]
    )
    np.testing.assert_allclose(
        even.measured[rows, 0], command(rows / RATE_HZ - 0.05), atol=1e-6
    )
    # The command was streamed: on the line between rows 399 and 403, off the sine by A ω² (2 h)² / 2 at most.
    assert (
        np.abs(even.target[:, 0] - command(np.arange(1200) / RATE_HZ)).max()
        < 0.3 * (2 * np.pi * 0.8) ** 2 * 0.01**2
    )
    assert (
        "3 rows lost in 1 gaps" in even.findings[0].text
        and "3 of them without a measurement" in even.findings[0].text
    )
    assert {f.check for f in check_measurement(even) if f.severity == "error"} == set()
    assert np.isnan(joint_motion(even, TwinConfig(), "left_joint5").measured).sum() == 3


def test_a_command_that_changes_now_and_then_is_held_across_a_gap():
    rows = np.delete(np.arange(1200), [400, 401, 402])
    m = table(rows / RATE_HZ, rows)
    even = even_rows(replace(m, target=np.where(rows < 403, 0.0, 0.2)[:, None]))
    np.testing.assert_array_equal(
        even.target[:, 0], np.where(np.arange(1200) < 403, 0.0, 0.2)
    )


@pytest.mark.parametrize("fault", ["jitter", "gap", "many"])
def test_too_much_is_left_as_it_is_and_refused_with_a_way_out(fault):
    rows = np.arange(1200)
    if fault == "jitter":
        time_s = np.sort(
            rows / RATE_HZ + np.random.default_rng(0).uniform(-4e-3, 4e-3, 1200)
        )
    else:
        rows = (
            rows[(rows < 400) | (rows >= 460)]
            if fault == "gap"
            else rows[np.random.default_rng(1).random(1200) > 0.15]
        )
        time_s = rows / RATE_HZ
    m = table(time_s - time_s[0], rows)
    assert even_rows(m) is m
    with pytest.raises(TaccorlError, match="log the driver's or the bus's own stamps"):
        joint_motion(m, TwinConfig(), "left_joint5")


def test_a_csv_file_is_read_that_way(tmp_path):
    rows = np.delete(np.arange(400), [200, 201, 202])
    lines = [
        f"{k / RATE_HZ:.6f},{command(k / RATE_HZ):.6f},{command(k / RATE_HZ):.6f}"
        for k in rows
    ]
    path = tmp_path / "lost.csv"
    path.write_text("\n".join(["t,left_joint5.q,left_joint5.q_target", *lines]) + "\n")
    m = read_table(path)
    assert m.num_rows == 400 and m.findings[0].check == "resampled"

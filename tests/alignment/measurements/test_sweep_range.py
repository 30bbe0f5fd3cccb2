"""Both sweeps of a joint are one: what calibration is measured with, and the chirp that the diagnosis asks for."""

import numpy as np

from pipelines.benchmarks import controller as benchmarks
from taccorl.alignment.measurements.motions import (
    CHIRP,
    RATE_HZ,
    REST_S,
    SWEEP_HZ,
    SWEEP_S,
    Room,
)
from taccorl.sim.twin import TwinConfig


def assert_is_the_sweep(wave: np.ndarray, time_s: np.ndarray) -> None:
    """The sweep of ``motions`` has made f₀ t + (f₁ − f₀) t² / 2T cycles where it rises through 0, once a cycle: mean frequency
    (0.1 + 2.5) / 2 Hz times 10 s gives 13 crossings; rounding decides whether the last one is inside."""
    at = np.flatnonzero((wave[:-1] < 0) & (wave[1:] >= 0))
    zeros_s = time_s[at] - wave[at] * (time_s[at + 1] - time_s[at]) / (
        wave[at + 1] - wave[at]
    )
    low, high = SWEEP_HZ
    cycles = low * zeros_s + (high - low) * zeros_s**2 / (2 * SWEEP_S)
    np.testing.assert_allclose(cycles[:12], np.arange(1, 13), atol=0.01)


def test_the_sweep_of_the_calibration_and_the_chirp_of_the_diagnosis_have_one_range() -> (
    None
):
    motion, _ = benchmarks.sweep("left_joint5", TwinConfig())
    assert_is_the_sweep(motion.target - motion.target[0], motion.time_s)
    chirp = CHIRP.target(Room(middle_rad=0.3, wide_rad=0.5, sweep_rad=0.05)) - 0.3
    assert_is_the_sweep(chirp, np.arange(len(chirp)) / RATE_HZ - REST_S)

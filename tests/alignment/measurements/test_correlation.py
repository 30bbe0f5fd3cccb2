"""Rows that are independent, and blocks of time."""

import numpy as np
import pytest
from scipy.signal import lfilter

from taccorl.alignment.measurements.correlation import (
    Rows,
    block_of_rows,
    block_sums,
    independent_rows,
    unstacked,
)


def coloured(
    num_rows: int, num_channels: int, keep: float, seed: int = 0
) -> np.ndarray:
    """(T, C) independent AR(1) channels."""
    white = np.random.default_rng(seed).standard_normal((num_rows + 1000, num_channels))
    return lfilter([1.0], [1.0, -keep], white, axis=0)[1000:]


@pytest.mark.parametrize("channels", [1, 2, 64])
def test_channels_are_no_neighbours_in_time(channels: int):
    # AR(0.95): n (1 − a) / (1 + a) = n / 39 of each channel
    parts = [coloured(4000, channels, 0.95, seed) for seed in range(16)]
    assert independent_rows(parts) == pytest.approx(16 * 4000 * channels / 39, rel=0.25)


def test_white_noise_is_independent_and_coloured_noise_is_not():
    assert independent_rows([coloured(20000, 1, 0.0)]) == pytest.approx(20000, rel=0.1)
    assert independent_rows([coloured(20000, 1, 0.9)]) == pytest.approx(
        20000 / 19, rel=0.2
    )


def test_recordings_add_up_and_their_ends_are_no_neighbours():
    parts = [coloured(5000, 2, 0.9, seed) for seed in range(4)]
    assert independent_rows(parts) == pytest.approx(
        sum(independent_rows([p]) for p in parts)
    )


def test_unmeasured_rows_do_not_count():
    part = coloured(8000, 2, 0.9)
    part[:4000, 0] = np.nan
    part[:, 1] = np.nan
    assert independent_rows([part]) == pytest.approx(4000 / 19, rel=0.3)


def test_few_rows_and_a_channel_that_is_exactly_zero():
    assert (
        independent_rows([np.zeros((5, 1))]) == 5
        and independent_rows([np.zeros((100, 3))]) == 300
    )
    assert independent_rows([np.full((50, 1), np.nan)]) == 1


def test_a_rest_shorter_than_half_a_block_joins_the_block_before_it():
    # half a second at 100 Hz is 50 rows; 1201 rows leave one
    assert np.bincount(block_of_rows(1201, 100.0)).tolist() == [50] * 23 + [51]
    assert np.bincount(block_of_rows(124, 100.0)).tolist() == [50, 74]
    assert np.bincount(block_of_rows(125, 100.0)).tolist() == [50, 50, 25]
    assert np.bincount(block_of_rows(7, 100.0)).tolist() == [7]


def test_blocks_of_time_hold_all_channels_and_end_with_a_recording():
    layout = [Rows(np.ones((100, 2), bool), 100.0), Rows(np.ones((60, 1), bool), 100.0)]
    layout[0].measured[:10, 1] = False
    sums = block_sums(np.ones(190 + 60), layout)
    assert sums.tolist() == [
        90,
        100,
        60,
    ]  # 50 rows of two channels less ten, 50 of two, and 60 of the second recording


def test_unstacked_is_what_was_stacked():
    parts = [coloured(30, 2, 0.5), coloured(20, 3, 0.5)]
    parts[0][3, 1] = np.nan
    layout = [Rows(np.isfinite(p), 100.0) for p in parts]
    again = list(unstacked(np.concatenate([p[np.isfinite(p)] for p in parts]), layout))
    for part, other in zip(parts, again, strict=True):
        np.testing.assert_array_equal(part, other)

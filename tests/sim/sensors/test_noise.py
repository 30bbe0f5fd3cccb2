"""Noise of many simulations against NumPy's own generators."""

import numpy as np
import pytest

from taccorl.errors import TaccorlError
from taccorl.sim.sensors import standard_normal
from taccorl.sim.sensors.noise import ScanNoise


def test_noise_is_numpys_bit_for_bit() -> None:
    """Half a million numbers: the ziggurat's tail, 1 of 3700 numbers, is among them; seeds of one and of two words."""
    rng = np.random.default_rng(0)
    seeds = np.r_[0, 1, 2**32 - 1, 2**32, 2**63 - 1, rng.integers(0, 2**63, 150), rng.integers(0, 2**32, 150)]
    steps = np.r_[0, 0, 1, 5, 2**32 - 1, rng.integers(0, 900, 300)]
    expected = [np.random.default_rng(of).standard_normal(1536, np.float32) for of in zip(seeds, steps, strict=True)]
    noise = ScanNoise(seeds, steps)
    drawn = noise.draw((len(seeds), 4, 32, 12))
    assert np.abs(drawn).max() > 3.7 and np.array_equal(drawn.reshape(len(seeds), -1), np.stack(expected))
    assert np.array_equal(noise.of(3, 7).draw((4, 1536)), drawn.reshape(-1, 1536)[3:7])


def test_as_many_seeds_as_simulations_are_wanted() -> None:
    with pytest.raises(TaccorlError, match="2 generators for 3"):
        standard_normal(ScanNoise(np.arange(2), np.arange(2)), (3, 4, 32, 12))

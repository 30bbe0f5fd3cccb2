"""Intervals and tests against numbers that were worked out by hand or published."""

import itertools
import math

import pytest

from taccorl.errors import TaccorlError
from taccorl.evaluation.statistics import (
    PairedComparison,
    mcnemar_exact,
    paired_difference_interval,
    told_rate,
    wilson_interval,
)

Z2 = 3.841459  # z², z = 1.959964


def test_wilson_of_eight_in_ten() -> None:
    # Middle (0.8 + 3.841459 / 20) / 1.3841459 = 0.9920730 / 1.3841459 = 0.7167402.
    # Half 1.959964 · √(0.8 · 0.2 / 10 + 3.841459 / 400) / 1.3841459 = 1.959964 · √0.02560365 / 1.3841459 = 0.2265776.
    assert wilson_interval(8, 10) == pytest.approx((0.7167402 - 0.2265776, 0.7167402 + 0.2265776), abs=1e-6)
    assert (told_rate(8, 10), told_rate(0, 0)) == ("8 of 10: 80 % (95 %: 49 … 94)", "0 of 0: –")


def test_wilson_at_the_ends_is_exact_there() -> None:
    # p = 0: the middle and the half are both z²/2n / (1 + z²/n), so the upper end is z² / (n + z²).
    assert wilson_interval(0, 10) == (0.0, pytest.approx(Z2 / (10 + Z2), abs=1e-6))
    assert wilson_interval(128, 128) == (pytest.approx(1 - Z2 / (128 + Z2), abs=1e-6), 1.0)
    assert wilson_interval(0, 0) == (0.0, 1.0)


@pytest.mark.parametrize(("successes", "n"), [(3, 2), (-1, 2)])
def test_wilson_refuses_counts_that_cannot_be(successes: int, n: int) -> None:
    with pytest.raises(TaccorlError, match=f"{successes} successes of {n}"):
        wilson_interval(successes, n)


def test_mcnemar_is_a_fair_coin() -> None:
    # 2 · (C(12,0) + C(12,1) + C(12,2)) / 2¹² = 2 · (1 + 12 + 66) / 4096
    assert mcnemar_exact(10, 2) == mcnemar_exact(2, 10) == pytest.approx(158 / 4096)
    assert mcnemar_exact(6, 0) == pytest.approx(2 / 64)
    assert mcnemar_exact(4, 4) == 1.0 and mcnemar_exact(0, 0) == 1.0
    with pytest.raises(TaccorlError, match="-1"):
        mcnemar_exact(-1, 0)


def test_paired_difference_as_newcombe_published() -> None:
    # Newcombe 1998, table II, method 10: a, b, c, d = 36, 12, 2, 0 gives 0.0569 … 0.3404.
    assert paired_difference_interval(36, 12, 2, 0) == pytest.approx((0.0569, 0.3404), abs=5e-5)


def test_pairs_are_counted_scene_by_scene() -> None:
    paired = PairedComparison.of([True, True, False, False, True], [True, False, True, False, False])
    assert (paired.both, paired.only_first, paired.only_second, paired.neither) == (1, 2, 1, 1)
    assert paired.n == 5 and paired.difference == pytest.approx(0.2) and paired.p_value == 1.0
    low, high = paired.interval
    assert low < 0.2 < high and paired.to_json()["difference_interval_95"] == [low, high]
    assert "of 5 scenes 1 both, 2 only the first, 1 only the second, 1 neither" in str(paired)
    with pytest.raises(TaccorlError, match="2 and 1 episodes"):
        PairedComparison.of([True, True], [True])


def test_equal_policies_differ_by_nothing() -> None:
    low, high = paired_difference_interval(30, 0, 0, 98)
    assert low == pytest.approx(-high) and high < 0.06
    with pytest.raises(TaccorlError, match="one of them > 0"):
        paired_difference_interval(0, 0, 0, 0)


def test_the_paired_interval_covers_as_it_claims() -> None:
    # All outcomes of n = 12 pairs with probabilities 0.3, 0.25, 0.1, 0.35 (difference 0.15), weighted exactly.
    shares, n, covered = (0.3, 0.25, 0.1, 0.35), 12, 0.0
    for a, b, c in itertools.product(range(n + 1), repeat=3):
        d = n - a - b - c
        if d < 0:
            continue
        ways = math.factorial(n) / math.prod(math.factorial(k) for k in (a, b, c, d))
        low, high = paired_difference_interval(a, b, c, d)
        if low <= 0.15 <= high:
            covered += ways * math.prod(p**k for p, k in zip(shares, (a, b, c, d), strict=True))
    assert 0.93 < covered < 0.99

"""Statistics of success and failure: Wilson's interval, McNemar's exact test, and the difference of two paired shares.

Letters: n episodes; a both succeed, b only the first, c only the second, d neither (n = a + b + c + d).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from scipy.stats import binomtest

from taccorl.errors import TaccorlError


def wilson_interval(successes: int, n: int) -> tuple[float, float]:
    """Wilson's 95 % score interval of a share, without continuity correction: (low, high) in 0 … 1; (0, 1) if n is 0. Raises
    TaccorlError: not 0 ≤ successes ≤ n."""
    if not 0 <= successes <= n:
        raise TaccorlError(f"Wilson's interval: {successes} successes of {n} episodes")
    if n == 0:
        return 0.0, 1.0
    found = binomtest(successes, n).proportion_ci(method="wilson")
    return float(found.low), float(found.high)


def told_rate(successes: int, n: int) -> str:
    """Success rate with Wilson's interval as text: ``8 of 10: 80 % (95 %: 49 … 94)``, without percentages if n is 0."""
    low, high = (100 * end for end in wilson_interval(successes, n))
    return f"{successes} of {n}: " + (
        f"{100 * successes / n:.0f} % (95 %: {low:.0f} … {high:.0f})" if n else "–"
    )


def mcnemar_exact(only_first: int, only_second: int) -> float:
    """Two-sided p-value of McNemar's exact test: b of b + c under a binomial of 1/2. It is 1 if the two policies never disagree.

    ``only_first`` b and ``only_second`` c are the numbers of scenes on which only one of the policies succeeds. Raises
    TaccorlError: a count is negative."""
    if min(only_first, only_second) < 0:
        raise TaccorlError(
            f"McNemar's test: counts {only_first} and {only_second}; give numbers ≥ 0"
        )
    disagree = only_first + only_second
    return float(binomtest(only_first, disagree, 0.5).pvalue) if disagree else 1.0


def paired_difference_interval(
    both: int, only_first: int, only_second: int, neither: int
) -> tuple[float, float]:
    """95 % interval (low, high) of p₁ − p₂ from paired outcomes: Newcombe's method 10 (Statist. Med. 17, 2635–2650, 1998).

    Args:
        both, neither: number of scenes on which both policies succeed, and on which none does.
        only_first, only_second: number of scenes on which only one of them does.

    Wilson's intervals (l₁, u₁), (l₂, u₂) of both shares, combined with the correlation φ of the pairs:
    p₁ − p₂ − √((p₁ − l₁)² − 2 φ (p₁ − l₁)(u₂ − p₂) + (u₂ − p₂)²), and likewise above. φ = (ad − bc) / √(product of the
    four margins), with ad − bc reduced by n / 2, to 0 at the least, where it is positive; 0 if a margin is empty.

    Raises:
        TaccorlError: a count is negative, or all are 0.
    """
    a, b, c, d = both, only_first, only_second, neither
    n = a + b + c + d
    if min(a, b, c, d) < 0 or n == 0:
        raise TaccorlError(
            f"paired difference: counts {a}, {b}, {c}, {d}; give numbers ≥ 0, one of them > 0"
        )
    p1, p2 = (a + b) / n, (a + c) / n
    (l1, u1), (l2, u2) = wilson_interval(a + b, n), wilson_interval(a + c, n)
    margins = (a + b) * (c + d) * (a + c) * (b + d)
    numerator = a * d - b * c
    if numerator > 0:
        numerator = max(numerator - n / 2, 0)
    phi = numerator / math.sqrt(margins) if margins else 0.0

    def distance(first: float, second: float) -> float:
        return math.sqrt(max(first**2 - 2 * phi * first * second + second**2, 0.0))

    return p1 - p2 - distance(p1 - l1, u2 - p2), p1 - p2 + distance(u1 - p1, p2 - l2)


@dataclass(frozen=True, kw_only=True)
class PairedComparison:
    """Two policies on the same scenes: number of scenes on which both succeed, only the first, only the second, and neither."""

    both: int
    only_first: int
    only_second: int
    neither: int

    @classmethod
    def of(cls, first: Sequence[bool], second: Sequence[bool]) -> "PairedComparison":
        """Compare the successes (n,) of both policies, scene by scene. Raises TaccorlError: the arrays have different lengths."""
        if len(first) != len(second):
            raise TaccorlError(
                f"paired comparison: {len(first)} and {len(second)} episodes; give one episode of each policy per scene"
            )
        pairs = [(bool(x), bool(y)) for x, y in zip(first, second, strict=True)]
        count = pairs.count
        return cls(
            both=count((True, True)),
            only_first=count((True, False)),
            only_second=count((False, True)),
            neither=count((False, False)),
        )

    @property
    def n(self) -> int:
        """Number of scenes on which both policies were evaluated."""
        return self.both + self.only_first + self.only_second + self.neither

    @property
    def difference(self) -> float:
        """Difference p₁ − p₂ of the success rates, −1 … 1."""
        return (self.only_first - self.only_second) / self.n

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of ``difference``, from ``paired_difference_interval``."""
        return paired_difference_interval(
            self.both, self.only_first, self.only_second, self.neither
        )

    @property
    def p_value(self) -> float:
        """Two-sided p-value of McNemar's exact test."""
        return mcnemar_exact(self.only_first, self.only_second)

    def to_json(self) -> dict[str, int | float | list[float]]:
        """JSON values: ``n``, the four counts, ``difference``, ``difference_interval_95`` ([low, high]), ``mcnemar_exact_p``."""
        counts = {
            name: getattr(self, name)
            for name in ("both", "only_first", "only_second", "neither")
        }
        return {
            "n": self.n,
            **counts,
            "difference": self.difference,
            "difference_interval_95": list(self.interval),
            "mcnemar_exact_p": self.p_value,
        }

    def __str__(self) -> str:
        low, high = self.interval
        return (
            f"difference {100 * self.difference:+.1f} percentage points (95 %: {100 * low:+.1f} … {100 * high:+.1f}); "
            f"of {self.n} scenes {self.both} both, {self.only_first} only the first, {self.only_second} only the second, "
            f"{self.neither} neither; McNemar's exact test p = {self.p_value:.3g}"
        )

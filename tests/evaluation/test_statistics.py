"""Intervals and tests against numbers that were worked out by hand or published."""

import itertools
import math
from dataclasses import replace
from pathlib import Path

import pytest

from taccorl.errors import TaccorlError
from taccorl.evaluation.episodes import (
    EpisodeRow,
    compare,
    read_rows,
    summaries,
    write_rows,
)
from taccorl.evaluation.statistics import (
    PairedComparison,
    mcnemar_exact,
    paired_difference_interval,
    told_rate,
    wilson_interval,
)
from taccorl.report.evaluated import by_subtask, differences

Z2 = 3.841459  # z², z = 1.959964


def test_wilson_of_eight_in_ten() -> None:
    # Middle (0.8 + 3.841459 / 20) / 1.3841459 = 0.9920730 / 1.3841459 = 0.7167402.
    # Half 1.959964 · √(0.8 · 0.2 / 10 + 3.841459 / 400) / 1.3841459 = 1.959964 · √0.02560365 / 1.3841459 = 0.2265776.
    assert wilson_interval(8, 10) == pytest.approx(
        (0.7167402 - 0.2265776, 0.7167402 + 0.2265776), abs=1e-6
    )
    assert (told_rate(8, 10), told_rate(0, 0)) == (
        "8 of 10: 80 % (95 %: 49 … 94)",
        "0 of 0: –",
    )


def test_wilson_at_the_ends_is_exact_there() -> None:
    # p = 0: the middle and the half are both z²/2n / (1 + z²/n), so the upper end is z² / (n + z²).
    assert wilson_interval(0, 10) == (0.0, pytest.approx(Z2 / (10 + Z2), abs=1e-6))
    assert wilson_interval(128, 128) == (
        pytest.approx(1 - Z2 / (128 + Z2), abs=1e-6),
        1.0,
    )
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
    assert paired_difference_interval(36, 12, 2, 0) == pytest.approx(
        (0.0569, 0.3404), abs=5e-5
    )


def test_pairs_are_counted_scene_by_scene() -> None:
    paired = PairedComparison.of(
        [True, True, False, False, True], [True, False, True, False, False]
    )
    assert (paired.both, paired.only_first, paired.only_second, paired.neither) == (
        1,
        2,
        1,
        1,
    )
    assert (
        paired.n == 5
        and paired.difference == pytest.approx(0.2)
        and paired.p_value == 1.0
    )
    low, high = paired.interval
    assert low < 0.2 < high and paired.to_json()["difference_interval_95"] == [
        low,
        high,
    ]
    assert "of 5 scenes 1 both, 2 only the first, 1 only the second, 1 neither" in str(
        paired
    )
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
            covered += ways * math.prod(
                p**k for p, k in zip(shares, (a, b, c, d), strict=True)
            )
    assert 0.93 < covered < 0.99


# ---- rows of episodes ----


def row(
    seed: int,
    outcome: str,
    *,
    policy: str = "a",
    task: str = "puzzle",
    **changes: object,
) -> EpisodeRow:
    values: dict = {
        "policy": policy,
        "task": task,
        "seed": seed,
        "outcome": outcome,
        "partial": 0,
        "max_partial": 3,
        "steps": 30 * (seed + 1),
        "time_s": seed + 1.0,
        "subtask_end_s": {"left": {"grasp": 0.5, "insert": None}, "right": {}},
        "clipped_steps": 2,
        "measures": {"depth_m": 0.01},
    }
    return EpisodeRow(**{**values, **changes})


def test_rows_survive_a_file(tmp_path: Path) -> None:
    rows = [
        row(0, "success", partial=3),
        row(1, "bad_action", reason="left_joint1 is nan"),
    ]
    write_rows(rows, tmp_path / "episodes.jsonl")
    assert read_rows(tmp_path / "episodes.jsonl") == rows
    assert (
        '"success": true, "partial_credit": 1.0'
        in (tmp_path / "episodes.jsonl").read_text()
    )


@pytest.mark.parametrize("line", ["not json", "[1]", '{"seed": 3}'])
def test_what_is_no_row_is_named_with_its_line(line: str, tmp_path: Path) -> None:
    path = tmp_path / "episodes.jsonl"
    write_rows([row(0, "timeout")], path)
    path.write_text(path.read_text() + line + "\n")
    with pytest.raises(
        TaccorlError, match=r"episodes\.jsonl, line 2: is not an episode"
    ):
        read_rows(path)


def test_a_summary_counts_by_hand() -> None:
    rows = [
        row(0, "success"),
        row(1, "timeout", partial=2),
        row(2, "success"),
        row(3, "dropped", partial=1),
        row(4, "timeout"),
        row(0, "diverged", task="assembly_1", max_partial=1),
    ]
    one, other = summaries(rows)
    assert (one.task, one.n, one.successes) == ("puzzle", 5, 2)
    assert one.partial_credit == pytest.approx((1 + 2 / 3 + 1 + 1 / 3 + 0) / 5)
    assert (
        one.failures == {"timeout": 2, "dropped": 1}
        and list(one.failures)[0] == "timeout"
    )
    assert one.median_success_s == 2.0  # of 1 s and 3 s
    assert one.interval_95 == pytest.approx(
        (0.1176, 0.7693), abs=1e-4
    )  # Wilson, 2 of 5
    assert str(one).startswith(
        "2 of 5 episodes succeeded: 40.0 % (95 %: 11.8 … 76.9), partial credit 0.60"
    )
    assert other.median_success_s is None and str(other).endswith(
        "failures: diverged 1"
    )


def test_policies_are_paired_by_seed_not_by_order() -> None:
    first = [row(0, "success"), row(1, "timeout"), row(2, "success")]
    second = [
        row(2, "success", policy="b"),
        row(0, "timeout", policy="b"),
        row(1, "timeout", policy="b"),
    ]
    paired = compare(first, second)["puzzle"]
    assert (paired.both, paired.only_first, paired.only_second, paired.neither) == (
        1,
        1,
        0,
        1,
    )


def test_other_scenes_are_not_compared() -> None:
    with pytest.raises(
        TaccorlError, match="only one of the two has puzzle seed 1, puzzle seed 2"
    ):
        compare(
            [row(0, "success"), row(1, "success")],
            [row(0, "success"), row(2, "success")],
        )
    with pytest.raises(TaccorlError, match="2 and 1 episodes"):
        compare([row(0, "success"), row(0, "success")], [row(0, "success")])


def test_where_episodes_fail_and_what_differs_by_hand() -> None:
    # Of 15 episodes 3 fail in grasp and 2 in insert. Failures begin at 20 … 24 mm, successes at 0 … 9: of C(15, 5) = 3003 orders
    # two are so extreme, p = 2 / 3003. The depth is the same in all, and says nothing.
    ends = [(0.5, 2.0)] * 10 + [(None, None)] * 3 + [(0.5, None)] * 2
    places = [*range(10), *range(20, 25)]
    each = [{"left": dict(zip(("grasp", "insert"), end, strict=True))} for end in ends]
    rows = [
        row(k, "success" if k < 10 else "timeout", subtask_end_s=own)
        for k, own in enumerate(each)
    ]
    rows = [
        replace(one, reset={"tray_x_m": 1e-3 * place})
        for one, place in zip(rows, places, strict=True)
    ]
    assert [one.failed_in for one in rows[9:14:2]] == [
        {},
        {"left": "grasp"},
        {"left": "insert"},
    ]
    assert [line[3:] for line in by_subtask(rows).rows] == [
        ["grasp", "15", "12", "3"],
        ["insert", "12", "10", "2"],
    ]
    middles = ["0.0045 (0.00045 … 0.00855)", "0.022 (0.0202 … 0.0238)"]
    assert [one.rows for one in differences(rows)] == [
        [["tray_x_m", "after the reset", *middles, f"{2 / 3003:.2g}"]]
    ]
    ended = [
        replace(one, reset={}, measures={"depth_m": 1e-3 * place})
        for one, place in zip(rows, places, strict=True)
    ]
    diverged = [
        replace(ended[0], outcome="diverged", measures={}),
        *ended[1:],
    ]  # which has none
    assert [one.rows[0][:2] for one in differences(diverged)] == [
        ["depth_m", "at the end"]
    ]
    (few,) = differences(rows[:14])
    assert few.rows == [] and few.notes == ["Needs 5 successes and 5 failures."]

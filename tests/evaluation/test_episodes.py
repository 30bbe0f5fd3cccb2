"""Rows of episodes: written, read, summed up, compared scene by scene."""

from pathlib import Path

import pytest

from taccorl.errors import TaccorlError
from taccorl.evaluation.episodes import EpisodeRow, compare, read_rows, summaries, write_rows


def row(seed: int, outcome: str, *, policy: str = "a", task: str = "puzzle", **changes: object) -> EpisodeRow:
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
    rows = [row(0, "success", partial=3), row(1, "bad_action", reason="left_joint1 is nan")]
    write_rows(rows, tmp_path / "episodes.jsonl")
    assert read_rows(tmp_path / "episodes.jsonl") == rows
    assert '"success": true, "partial_credit": 1.0' in (tmp_path / "episodes.jsonl").read_text()


@pytest.mark.parametrize("line", ["not json", "[1]", '{"seed": 3}'])
def test_what_is_no_row_is_named_with_its_line(line: str, tmp_path: Path) -> None:
    path = tmp_path / "episodes.jsonl"
    write_rows([row(0, "timeout")], path)
    path.write_text(path.read_text() + line + "\n")
    with pytest.raises(TaccorlError, match=r"episodes\.jsonl, line 2: is not an episode"):
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
    assert one.failures == {"timeout": 2, "dropped": 1} and list(one.failures)[0] == "timeout"
    assert one.median_success_s == 2.0  # of 1 s and 3 s
    assert one.interval_95 == pytest.approx((0.1176, 0.7693), abs=1e-4)  # Wilson, 2 of 5
    assert str(one).startswith("2 of 5 episodes succeeded: 40.0 % (95 %: 11.8 … 76.9), partial credit 0.60")
    assert other.median_success_s is None and str(other).endswith("failures: diverged 1")


def test_policies_are_paired_by_seed_not_by_order() -> None:
    first = [row(0, "success"), row(1, "timeout"), row(2, "success")]
    second = [row(2, "success", policy="b"), row(0, "timeout", policy="b"), row(1, "timeout", policy="b")]
    paired = compare(first, second)["puzzle"]
    assert (paired.both, paired.only_first, paired.only_second, paired.neither) == (1, 1, 0, 1)


def test_other_scenes_are_not_compared() -> None:
    with pytest.raises(TaccorlError, match="only one of the two has puzzle seed 1, puzzle seed 2"):
        compare([row(0, "success"), row(1, "success")], [row(0, "success"), row(2, "success")])
    with pytest.raises(TaccorlError, match="2 and 1 episodes"):
        compare([row(0, "success"), row(0, "success")], [row(0, "success")])

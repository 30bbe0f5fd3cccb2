"""--stratify: boxes of the reset space, which attempts fill the poor ones, and a report that does not call that a yield."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from taccorl.episodes.plan import Made
from taccorl.episodes.sources.mimicgen.augment import AugmentPlan, Rounds
from taccorl.episodes.sources.mimicgen.coverage import Attempt, bins_of, evenness, numbers, stratified
from taccorl.episodes.sources.mimicgen.spec import load_mimic_spec
from taccorl.episodes.sources.mimicgen.stratify import Boxes, ResetSpace, first_attempts, given_up, next_round
from taccorl.errors import TaccorlError
from taccorl.lineage.stage import Artefact
from taccorl.report.augmented import augmented
from taccorl.report.page import html
from taccorl.sim.randomize import Row, symmetric

SPACE = ResetSpace((Row(name="friction", low=(0.3,), high=(0.7,), unit="1"), symmetric("plug", (0.03, 0.03), "m")), 1.0)


def plan(**changes):
    return AugmentPlan(**({"spec": load_mimic_spec("assembly_2"), "images": False, "stratify": True} | changes))


def box_of(k: int) -> Boxes:
    """Uniform over 4 × 9 boxes."""
    return tuple(np.random.default_rng(k).integers([4, 9]).tolist())


def run(
    episodes: int, succeeds: Callable[[int], bool], next_of: Callable[[list[tuple[int, bool]]], Sequence[int]]
) -> list[tuple[int, bool]]:
    """Rounds until there are enough successes, as ``augment`` makes them."""
    done = []
    while sum(success for _, success in done) < episodes:
        for k in next_of(done):
            done.append((k, succeeds(k)))
            if sum(success for _, success in done) == episodes:
                break
        assert len(done) < 20 * episodes
    return done


def filled(episodes: int, succeeds: Callable[[int], bool]) -> list[tuple[int, bool]]:
    return run(episodes, succeeds, lambda done: next_round(SPACE, box_of, episodes, done))


def emptiest(done: list[tuple[int, bool]]) -> float:
    """Episodes of the emptiest box over its fair share."""
    kept = SPACE.count(box_of(k) for k, success in done if success)
    return min(float((row * len(row) / row.sum()).min()) for row in kept)


def test_the_first_half_is_made_as_it_comes():
    assert first_attempts(20) == 10
    assert next_round(SPACE, box_of, 20, []) == list(range(10))
    assert next_round(SPACE, box_of, 1, []) == [0]
    assert next_round(SPACE, box_of, 1000, [(k, True) for k in range(450)]) == list(range(450, 500))


def test_a_round_takes_the_numbers_whose_draws_lie_where_episodes_are_missing():
    # 20 wanted of one row: fair share 5 a box. Ten attempts: boxes 0 … 3 hold 5, 4, 1, 0 episodes: needs 0, 0.2, 0.8, 1.
    space = ResetSpace(SPACE.rows[:1], 1.0)
    boxes = [0] * 5 + [1] * 4 + [2] + [0, 1, 2, 3] * 4
    # Numbers 10, 11, … lie in the boxes 0, 1, 2, 3, 0, … In turn: 13 (need 1, then 0.8), 12 before 17 (both 0.8), 17, and of
    # boxes 2 and 3, both at 0.6, the lower number: 16.
    assert next_round(space, lambda k: (boxes[k],), 20, [(k, True) for k in range(10)]) == [12, 13, 16, 17]
    # An episode that failed is none. With those of box 1: 5, 0, 1, 0; so 11, 13 (need 1), then at 0.8 the lowest: 12, 15.
    done = [(k, boxes[k] != 1) for k in range(10)]
    assert next_round(space, lambda k: (boxes[k],), 20, done) == [11, 12, 13, 15]


def test_poor_boxes_are_filled_where_the_plain_command_leaves_them_empty():
    def succeeds(k: int) -> bool:  # in box 0 of the plug three of ten, else nine of ten
        return k % 10 < (3 if box_of(k)[1] == 0 else 9)

    plain = run(200, succeeds, lambda done: range(len(done), len(done) + 20))
    chosen = filled(200, succeeds)
    assert sum(success for _, success in chosen) == 200
    assert emptiest(plain) < 0.5
    assert emptiest(chosen) > 0.75
    taken = [k for k, _ in chosen]
    assert taken == sorted(set(taken))
    assert taken[:100] == list(range(100))
    assert len(chosen) < 1.3 * len(plain)


def test_a_box_that_never_succeeds_is_given_up_and_costs_no_more_than_its_failures():
    done = filled(200, lambda k: box_of(k)[1] != 4)
    failed = sum(not success for _, success in done)
    # 20 until it is given up, what that round had left (at most its 20), and by chance 1 of 9 of the attempts of 80 more.
    assert 20 <= failed < 20 + 20 + 25
    kept = SPACE.count(box_of(k) for k, success in done if success)[1]
    assert kept[4] == 0
    assert min(kept[:4].min(), kept[5:].min()) > 0.75 * 200 / 8
    assert given_up(np.array([0, 0, 2, 3]), np.array([19, 20, 20, 20])).tolist() == [False, True, True, False]


def test_rounds_pass_over_attempts_in_whatever_order_they_end():
    """The first two, then a round of four out of sixteen, and so on up to four successes."""
    ends, found = [], []
    for seed in range(2):
        rounds, rng, made = Rounds(plan(episodes=4)), np.random.default_rng(seed), []
        todo = list(rounds.first())
        while todo:
            k = todo.pop(rng.integers(len(todo)))
            made.append(k)
            outcome = {"attempt": k, "outcome": "success" if k % 3 == 0 else "dropped"}
            todo += rounds.after(k, Made(Artefact(Path(), ""), outcome))
        assert set(made[:2]) == {0, 1} and sorted(made) != list(range(len(made)))
        assert all(2 <= k < 2 + 16 for k in made[2:6])
        assert sum(k % 3 == 0 for k in made) >= 4
        found.append(sorted(made))
        ends.append(made)
    assert found[0] == found[1] and ends[0] != ends[1]


def test_where_nothing_is_drawn_there_is_nothing_to_fill():
    with pytest.raises(TaccorlError, match=r"--stratify=true: a reset of assembly_2 draws nothing"):
        plan(randomization=0.0)


def attempts_of(some: AugmentPlan, done: list[tuple[int, bool]]) -> list[Attempt]:
    return [
        Attempt(
            k=k, outcome="success" if success else "dropped", reason="", scene_seed=some.scene_seed(k), sources=frozenset(),
            draw=some.draw(k), rows=300, process_s=1.0, folder=Path("x"),
        )
        for k, success in done
    ]  # fmt: skip


def test_the_report_says_which_attempts_a_yield_is_of():
    some = plan(episodes=40)
    friction = [row.name for row in some.space.rows].index("friction")

    def boxes(k: int) -> Boxes:
        return some.space.boxes(some.draw(k))

    # Nothing succeeds at the least friction.
    done = run(40, lambda k: boxes(k)[friction] != 0, lambda d: next_round(some.space, boxes, 40, d))
    attempts = attempts_of(some, done)
    told = numbers(some, attempts, None) | {"source": "old", "dataset": "new"}
    first = sum(success for _, success in done[:20])
    assert (told["yield"]["successes"], told["yield"]["attempts"]) == (first, 20)
    assert (told["all_attempts"]["successes"], told["all_attempts"]["attempts"]) == (40, len(done))
    chosen = told["stratify"]
    assert chosen["passed_over"] == done[-1][0] + 1 - len(done) > 0
    assert chosen["coverage"]["first_attempts"]["episodes"] == first
    assert chosen["coverage"]["dataset"]["emptiest"] | {"low": None, "high": None} == {
        "row": "friction", "unit": "1", "low": None, "high": None, "episodes": 0, "share_of_fair": 0.0,
    }  # fmt: skip
    given = [(b["row"], b["low"], b["share"]["successes"]) for b in chosen["given_up"]]
    assert given == [("friction", pytest.approx((0.3,)), 0)]
    json.dumps(told)
    hands = [{"arm": "left", "part": "cradle", "sources": 3, "different": 2}]
    page = html("", augmented(some, told | {"grips": {"hands": hands, "few": True}}), "")
    assert f"Yield: {first} of 20" in page
    assert "attempts 0 … 19, the paper&#39;s randomisation. The later ones were chosen for poor boxes" in page
    assert f"all together: 40 of {len(done)}, which is no yield of that randomisation" in page
    assert f"{chosen['passed_over']} were passed over, not simulated" in page
    assert "Given up: at least 20 attempts failed there" in page
    plain = numbers(plan(episodes=40, stratify=False), attempts, None)
    assert plain["yield"] == plain["all_attempts"]
    assert plain["stratify"] is None


def test_evenness_by_hand():
    # 12 episodes at the least friction, 4 elsewhere: of four boxes fair shares are 4; one is empty, so that its share is 0.
    some = plan(episodes=16)
    frictions = [0.35] * 12 + [0.45] * 3 + [0.55]
    draws = [some.draw(k) | {"friction": np.array([f])} for k, f in enumerate(frictions)]
    told = evenness(some, draws)
    assert told["emptiest"]["share_of_fair"] == 0
    everywhere = some.space.count(some.space.boxes(d) for d in draws)
    assert everywhere[[row.name for row in some.space.rows].index("friction")].tolist() == [12, 3, 1, 0]
    half = sum(int((row * len(row) / 16 >= 0.5).sum()) for row in everywhere)
    assert (told["boxes"], told["boxes_half_full"]) == (4 + 9 + 9 + 4 + 4, half)
    assert stratified(plan(stratify=False), attempts_of(some, [(0, True)])) is None
    assert sum(b["share"]["attempts"] for b in bins_of(some, attempts_of(some, [(0, True)]))) == 5

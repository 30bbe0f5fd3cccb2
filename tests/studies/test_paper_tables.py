"""pipelines/paper_tables.py: scores become rows once, cells are what was counted, and what was not run is said."""

import json

import matplotlib.pyplot as plt
import pytest

from pipelines.paper_tables import (
    draw_curves,
    gain,
    main,
    page,
    read,
    row_of,
    share,
    singly,
    take,
    touch_gain,
    transfer,
)

ABOUT = {
    "sensors": "touch",
    "demonstrations": 9,
    "seed": 1,
    "twin": "",
    "scored_in": "",
    "steps": 5,
}
ONE = {"task": "puzzle", "pictures": "clear", "hidden": "", "n": 96, "successes": 0}
ROW = ABOUT | ONE | {"difficulty": "train", "executed": 8, "first_scene": 70}


def test_a_score_becomes_one_row_however_often_it_is_taken(tmp_path):
    (score := tmp_path / "score_96_train_8_clear_nothing").mkdir()
    told = {
        "scores": [ONE],
        "scenes": {"difficulty": "train", "seed": 70},
        "policies": [{"digest": "d"}],
    }
    for name, text in (("settings", ABOUT), ("evaluation", told)):
        (score / f"{name}.json").write_text(json.dumps(text))
    for _ in range(2):
        take([score], tmp_path / "rows.jsonl")
    assert [ROW.items() <= row.items() for row in read(tmp_path / "rows.jsonl")] == [
        True
    ]
    # Of an iteration in which no episode ended nothing is drawn. 3 of 7 as its share.
    lines = (
        {"episodes": 7, "success": 3 / 7},
        {"episodes": 0, "success": 0.0},
        {"episodes": 64, "success": 1.0},
    )
    (tmp_path / "progress.jsonl").write_text("\n".join(map(json.dumps, lines)))
    assert "curve" not in row_of(score)
    (score / "settings.json").write_text(json.dumps(ABOUT | {"stage": "ppo"}))
    after = row_of(score)
    assert after["curve"] == [[7, 3], [0, 0], [64, 64]] and "flow_loss" not in after
    (tmp_path / "progress.jsonl").write_text(
        "\n".join(json.dumps(line | {"drift": 0.06}) for line in lines)
    )
    assert row_of(score)["flow_loss"] == [0.06, 0.06, 0.06]
    assert share([after | {"flow_loss": [0.06, 0.07, 0.05]}]).endswith(
        "of 96*, flow loss 0.06 → 0.05"
    )
    draw_curves(
        [after, ROW, after | {"curve": [[0, 0]]}], picture := tmp_path / "curves.png"
    )
    assert plt.imread(picture).shape[:2] == (374, 990)  # 3.4 and 9 inches of 110 points


def test_cells_are_what_was_counted():
    rows = [
        ROW,
        ROW | {"seed": 2, "n": 192, "successes": 27, "twin": "mended_late_ab12"},
    ]
    assert (
        share(rows) == "9 % (7 … 13) of 288; 0.0, 14.1"
    )  # 27 of 288 = 9.4 %; Wilson: 6.5 … 13.3
    assert gain({"nominal": rows[:1], "mended": rows[1:]}) == "+14; p = 2e-05"  # Fisher
    assert gain({"randomised": rows[:1], "mended": rows[1:]}, "randomised").startswith(
        "+14"
    )
    assert gain({"mended": rows[1:]}, "randomised") == "not run"
    half, full = [ROW | {"successes": 48}], [ROW | {"successes": 96}]
    # Two tasks, 95 % intervals by Wilson: 96 of 96 is 96.15 … 100 %, 48 of 96 is 40.20 … 59.80 %. The mean gain is (50 + 0) / 2
    # points, its ends are 25 - √(3.85² + 3 · 9.80²) / 2 and 25 + √(3 · 9.80²) / 2.
    assert touch_gain([full, half], [half, half]) == "+25 (+16 … +33)"
    assert touch_gain([full, half], [half, []]) == "not run"
    six = [
        [ROW | {"n": 100, "successes": k + 10 * j} for j in range(3)] for k in (0, 30)
    ]
    assert gain({"nominal": six[0], "mended": six[1]}).endswith(
        "; +7 … +53"
    )  # 30 ± 2.776 · √(200 / 3), Welch
    moved = [
        row | {"scored_in": "late_cd34", "task": "assembly_1"}
        for row in [*rows, rows[1] | {"twin": "randomised_ef56"}]
    ]
    assert {key: [*of] for key, of in transfer(moved).items()} == {
        ("late", 9): ["nominal", "mended", "randomised"]
    }
    assert transfer(after := [row | {"stage": "ppo"} for row in moved]) == {}
    assert (
        "| late | after | 0 % (0 … 4) of 96* | 14 % (10 … 20) of 192* | +14; p = 2e-05 |"
        in page(after)
    )
    puzzle = "| puzzle | cameras and touch | 16 %; 4 %; 0 %; 71 % |"
    assert (
        f"{puzzle} 0 % (0 … 4) of 96*; of 9 demonstrations | not run | not run | not run |"
        in page(rows[:1])
    )
    loud = {
        "stage": "ppo",
        "successes": 96,
        "noise": {"n": 128.0, "without": 90.6, "with": 50.0},
    }
    after = "100 % (96 … 100) of 96*; of 9 demonstrations |"
    assert f"{puzzle} not run | 90.6 → 50 % of 128; of 9 | not run | {after}" in page(
        [ROW | loud]
    )
    # Without an update nothing was trained. Each number of demonstrations has its own result.
    untrained, fewer = (
        ROW | {"stage": "ppo", "demonstrations": 0, "updates": 3},
        ROW | {"demonstrations": 8},
    )
    less, start = fewer | {"stage": "ppo", "successes": 48}, fewer | {"stage": "start"}
    told = page(
        [
            ROW | loud,
            untrained,
            untrained | {"updates": 0},
            less,
            start,
            fewer | loud | {"stage": "noise"},
        ]
    )
    both = f"{after[:-2]}; 50 % (40 … 60) of 96*; of 8 demonstrations, before 0 % (0 … 4) of 96* |"
    assert (
        f"{puzzle} not run | 90.6 → 50 % of 128; of 9 | 0 % (0 … 4) of 96*, updates: 3 | {both}"
        in told
    )
    assert "What PPO adds to it is not\nknown" in told
    beside = [*moved, moved[1] | {"twin": "", "real": 5, "sim_weight": 0.5}]
    assert len(transfer(beside)["late", 9]["nominal"]) == 1
    alone = "0 % (0 … 4) of 96* | 14 % (10 … 20) of 192* |"
    assert (
        f"| assembly_1, late: 5, 9 | not run | 14 % (10 … 20) of 192* | not run | not run | {alone}"
        in page(beside)
    )
    other = page([row | {"task": "puzzle"} for row in beside])
    assert (
        f"| puzzle, late: 5, 9 | not run | 14 % (10 … 20) of 192* | not run | not run | {alone}"
        in other
    )
    assert "| late, 9 |" not in other  # the twins' table is of assembly_1
    imitated = moved[1] | {"twin": "", "real": 5, "sim_weight": 0.95}
    anchored, start = (
        imitated | {"stage": "ppo_anchored", "beta": 5.0},
        imitated | {"stage": "start", "successes": 96},
    )
    assert (
        "| assembly_1, late | 50 % (43 … 57) of 192* | not run | not run | not run | 14 % (10 … 20) of 192* |"
        in page([imitated, anchored, start])
    )
    # One effect alone: 48 against 96 of the same 96 scenes; other scenes and a policy after PPO (its row has beta) do not count.
    late, start = (
        ROW | {"scored_in": "creep_of_late_ab12", "successes": 48},
        ROW | {"stage": "start", "successes": 96},
    )
    others = [ROW | {"first_scene": 60}, ROW | {"stage": "ppo", "beta": 0.0}]
    assert singly([late, start, *others]) == {("creep", "late"): ([start], [late])}
    assert "| creep | late | 50 % (40 … 60) of 96* | -50; p = 2e-18 |" in page(
        [late, start, *others]
    )
    grip = ROW | {"task": "assembly_1", "demonstrations": 100}
    many = grip | {"demonstrations": 1000, "successes": 48}
    told = page(
        [
            grip,
            many | {"sources": 10},
            many | {"corrected": 300, "successes": 96},
            grip | {"stage": "ppo"},
        ]
    )
    assert (
        "| cameras and touch | each its own grip | 0 % (0 … 4) of 96* | not run | not run | not run |"
        in told
    )
    assert (
        "| cameras and touch | 10 grips | not run | not run | 50 % (40 … 60) of 96* | not run |"
        in told
    )
    assert (
        "| each its own grip for 300, then corrections | not run | not run | 100 % (96 … 100) of 96* | not run |"
        in told
    )
    assert (
        "| assembly_1 | cameras and touch | 47 %; 35 %; 0 %; 92 % | 0 % (0 … 4) of 96*; of 100 demonstrations |"
        in told
    )


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("--only=[transfr]", "did you mean 'transfer'"),
        ("--take=[docs]", "no score"),
        ("--only=[]", "hours on a GPU"),
    ],
)
def test_what_cannot_be_done_is_refused(word, said):
    with pytest.raises(SystemExit, match=said):
        main([word])

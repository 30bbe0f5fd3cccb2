"""pipelines/post_train.py with ``--small``: from sources to a comparison of before and after; again, it does nothing anew."""

import json

import pytest

from pipelines import post_train


@pytest.mark.slow
def test_the_chain_ends_in_a_comparison_and_goes_on_where_it_was(tmp_path, monkeypatch):
    words = ["--small", f"--out={tmp_path / 'out'}", f"--learn_out={tmp_path / 'learn'}"]
    post_train.main(words)
    (out,) = (tmp_path / "out" / "assembly_2").iterdir()
    rows = [json.loads(line) for line in (out / "progress.jsonl").read_text().splitlines()]
    assert [row["iteration"] for row in rows] == [1, 2] and all(row["anchor_loss"] > 0 for row in rows)
    assert (out / "rollouts" / "iteration_0001.rrd").is_file()
    score = json.loads((out / "score_2" / "evaluation.json").read_text())
    assert score["scenes"]["seed"] == 60000 and score["comparisons"]["assembly_2"]["n"] == 2
    assert post_train.is_finished(out)
    commands: list[str] = []
    monkeypatch.setattr(post_train, "step", lambda verb, _: commands.append(verb.__module__))
    monkeypatch.setattr(post_train, "train", commands.append)
    post_train.main(words)
    assert commands == []


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--tsak=assembly_2"], "tsak"),
        (["--config=configs/post_train/smal.yaml"], "no such file"),
        (["--policy=outputs/a"], "both --policy and --dataset"),
    ],
)
def test_what_it_does_not_know_is_named(words, said):
    with pytest.raises(SystemExit, match=said):
        post_train.main(words)

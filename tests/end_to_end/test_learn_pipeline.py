"""pipelines/learn.py with ``--small``: from sources to a score, and again without doing anything anew."""

import json
import subprocess
from pathlib import Path

import pytest

from pipelines import learn
from taccorl.data.dataset import Dataset


@pytest.mark.slow
def test_the_chain_ends_in_a_score_and_goes_on_where_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = ["--small", f"--out={tmp_path}"]
    learn.main(words)
    out = tmp_path / "assembly_2"
    assert Dataset(out / "rows_1").num_episodes == 1
    assert len(Dataset(out / "rows_1").unstored) == 3  # cameras whose frames are in the cache alone
    (policy,) = out.glob("policy_*/checkpoints/last/pretrained_model")
    processor = json.loads((policy / "policy_preprocessor.json").read_text())
    assert any("HandPosesStep" in json.dumps(step) for step in processor["steps"])  # from the names of the dataset
    (score,) = out.glob("score_*/evaluation.json")
    assert json.loads(score.read_text())["scenes"]["seed"] == 50000
    commands: list[str] = []
    monkeypatch.setattr(learn, "step", lambda verb, _: commands.append(verb.__module__.rpartition(".")[2]))
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: pytest.fail("LeRobot was run again"))
    learn.main(words)
    assert commands == ["collect", "augment", "execute"]  # which find what they made; no training, no evaluation


@pytest.mark.parametrize(
    ("words", "said"), [(["--tsak=assembly_2"], "tsak"), (["--train=configs/learn/smal.yaml"], "no such file")]
)
def test_what_it_does_not_know_is_named(words: list[str], said: str) -> None:
    with pytest.raises(SystemExit, match=said):
        learn.main(words)

"""``taccorl correct`` as a user types it."""

import json
from pathlib import Path
from typing import Any

import pytest

from taccorl.data.dataset import Dataset


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--task=assembly2", "--policy.path=x"), "did you mean 'assembly_2'"),
        (("--task=puzzle",), "missing --policy.path=CHECKPOINT"),
        (("--task=puzzle", "--policy.type=expert"), "missing --policy.path=CHECKPOINT"),
        (("--task=puzzle", "--policy.path=x", "--takeover=al"), "--takeover=al"),
        (("--task=puzzle", "--policy.path=x", "--num_envs=0"), "--num_envs=0"),
        (("--task=puzzle", "--policy.path=x", "--policy_workers=0"), "--policy_workers=0"),
        (("--task=puzzle", "--policy.path=x", "--policy_pictures=blurred"), "--policy_pictures=blurred"),
        (("--task=puzzle", "--policy.path=x", "--resolution=28x28"), "--resolution=28x28 has no effect"),
        (("--task=puzzle", "--policy.path=x", "--out=store/x", "--store=store"), "contain one another"),
        (("--task=puzzle", "--policy.path=x", "--twin=none.yaml"), "none.yaml"),
    ],
)
def test_wrong_words_end_before_the_policy_acts(words: tuple[str, ...], message: str, said: Any) -> None:
    code, shown = said("correct", "--store=kept", *words)
    assert code == 2 and message in shown and not Path("kept").exists()


@pytest.mark.slow
def test_what_lies_at_out_is_not_touched(said: Any, tmp_path: Path) -> None:
    from tiny_checkpoint import write_checkpoint

    checkpoint = write_checkpoint(tmp_path / "policy")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "file").touch()
    code, shown = said(
        "correct", f"--policy.path={checkpoint}", "--policy.device=cpu", "--task=assembly_2", "--out=mine"
    )
    assert code == 2 and "mine is occupied" in shown and [p.name for p in (tmp_path / "mine").iterdir()] == ["file"]


@pytest.mark.slow
def test_a_folder_that_is_no_checkpoint_is_named(said: Any) -> None:
    code, shown = said("correct", "--task=puzzle", "--policy.path=nowhere", "--store=kept")
    assert code == 2 and "--policy.path=nowhere: no config.json there" in shown and not Path("kept").exists()


@pytest.mark.slow
def test_a_checkpoint_is_corrected_and_the_same_command_makes_nothing_again(said: Any, tmp_path: Path) -> None:
    from tiny_checkpoint import write_checkpoint

    checkpoint = write_checkpoint(tmp_path)
    words = ("correct", f"--policy.path={checkpoint}", "--policy.device=cpu", "--task=assembly_2", "--store=kept")
    words += ("--episodes=2", "--num_envs=2", "--episode_length=3", "--images=false", "--out=corrections")
    code, shown = said(*words)
    assert code == 0 and "preflight of" in shown and "0 of 2 episodes succeeded by themselves" in shown
    assert "takeovers: 2 (drawn before the grasp 2)" in shown and "; 0 kept out" in shown
    report = json.loads((tmp_path / "corrections/meta/taccorl/collect_report.json").read_text())
    assert Dataset(tmp_path / "corrections").num_episodes == report["episodes"] >= 1
    assert report["policy_outcomes"] == {"timeout": 2} and len(report["policy_digest"]) == 64
    before = sorted(path.stat().st_mtime_ns for path in (tmp_path / "kept").rglob("*.npy"))
    assert said(*words)[0] == 0
    assert sorted(path.stat().st_mtime_ns for path in (tmp_path / "kept").rglob("*.npy")) == before
    code, shown = said("lineage", "explain", "corrections", "--store=kept")
    assert code == 0 and "policy_episodes" in shown and report["policy_digest"] in shown

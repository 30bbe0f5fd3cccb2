"""``taccorl evaluate`` and ``taccorl correct`` as a user types them."""

import json
import pickle
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from taccorl.cli import evaluate
from taccorl.data.dataset import Dataset
from taccorl.errors import TaccorlError
from taccorl.evaluation.episodes import read_rows
from taccorl.lineage.manifest import seal_checkpoint

EXPERT = ("evaluate", "--policy.type=expert", "--task=assembly_1", "--images=false")
SHORT = ("--episodes=2", "--episode_length=4")


@pytest.mark.parametrize("here", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_an_evaluation_is_rows_summary_page_and_rerun_file(
    said: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, here: bool
) -> None:
    """``here``: the shares of two processes, pickled as for these, run in this one."""

    def mapped(run: Any, items: list[Any], name: Any) -> list[Any]:
        return [run(item) for item in pickle.loads(pickle.dumps(items))]

    if here:
        engine = SimpleNamespace(map=mapped)
        monkeypatch.setattr(evaluate, "LocalEngine", lambda workers: engine)
    code, shown = said(*EXPERT, *SHORT, "--failures=1", "--out=scored")
    assert (
        code == 0
        and "expert, assembly_1: 0 of 2 episodes succeeded: 0.0 % (95 %: 0.0 … 65.8)"
        in shown
    )
    assert "failures: timeout 2" in shown
    rows = read_rows(tmp_path / "scored/episodes.jsonl")
    assert [(r.seed, r.outcome, r.steps) for r in rows] == [
        (1000, "timeout", 4),
        (1001, "timeout", 4),
    ]
    summary = json.loads((tmp_path / "scored/evaluation.json").read_text())
    assert (
        summary["scores"][0]["failures"] == {"timeout": 2}
        and summary["scenes"]["episode_length"] == 4
    )
    assert (
        summary["about"]["mujoco"] and len(summary["about"]["digest of the twin"]) == 64
    )
    page = (tmp_path / "scored/report.html").read_text()
    link = "failures/assembly_1_seed_1000_timeout.rrd"
    assert (
        f'href="{link}"' in page
        and (tmp_path / "scored" / link).read_bytes()[:4] == b"RRF2"
    )
    assert (
        "Simulated in the MuJoCo twin; no robot was used" in page
        and "assembly_1, seed 1000: timeout after 0.1 s" in page
    )

    # Nothing of it is overwritten, and it can be the other side of a comparison.
    before = (tmp_path / "scored/episodes.jsonl").read_bytes()
    code, shown = said(*EXPERT, *SHORT, "--out=scored")
    assert (
        code == 2 and "--out=scored: holds files already; nothing was changed" in shown
    )
    assert (tmp_path / "scored/episodes.jsonl").read_bytes() == before
    code, shown = said(
        *EXPERT,
        *SHORT,
        "--failures=0",
        "--against=scored",
        "--out=again",
        "--workers=2",
    )
    assert (
        code == 0
        and "assembly_1, expert against expert (scored): difference +0.0 percentage points"
        in shown
    )
    assert (
        "of 2 scenes 0 both, 0 only the first, 0 only the second, 2 neither; McNemar's exact test p = 1"
        in shown
    )
    again = read_rows(tmp_path / "again/episodes.jsonl")
    assert again[:2] == rows and {r.policy for r in again[2:]} == {
        "expert (scored)"
    }  # from two shares, too
    code, shown = said(*EXPERT, *SHORT, "--seed=7", "--against=scored", "--out=other")
    assert (
        code == 2
        and "was evaluated on other scenes: seed 1000 there, 7 here" in shown
        and not Path("other").exists()
    )


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--task=assembly1", "--policy.type=expert"), "did you mean 'assembly_1'"),
        (("--policy.type=expert",), "missing --task="),
        (("--task=puzzle",), "give --policy.path=CHECKPOINT or --policy.type=expert, one of them"),
        (("--task=puzzle", "--policy.type=expert", "--policy.path=x"), "one of them"),
        (("--task=puzzle", "--policy.type=exprt"), "--policy.type=exprt: did you mean 'expert'?"),
        (("--task=puzzle", "--policy.type=expert", "--against=expert"), "is the evaluated policy itself"),
        (("--task=puzzle", "--policy.type=expert", "--against=nope"), "--against=nope: no such folder"),
        (("--task=puzzle", "--policy.type=expert", "--twin=none.yaml"), "none.yaml"),
        (("--task=puzzle", "--policy.type=expert", "--failures=-1"), "--failures=-1"),
        (("--task=puzzle", "--policy.type=expert", "--workers=0"), "--workers=0: at least 1"),
        (("--task=puzzle", "--policy.type=expert", "--physics=wrap", "--failures=2"), "physics=wrap: did you mean 'warp'"),
        (("--task=puzzle", "--policy.type=expert", "--physics=warp", "--failures=2"), "give --failures=0"),
        (("--task=puzzle", "--policy.type=expert", "--physics=warp", "--workers=2"), "--workers=2: --physics=warp runs all"),
        (("--task=puzzle", "--policy.path=x", "--robot.type=taccorl_surrogate", "--physics=warp"), "--physics has no effect"),
        (("--task=puzzle", "--policy.path=x", "--before_mate=1"), "--before_mate=1: 0, or 2 or more"),
        (("--task=puzzle", "--policy.type=expert", "--before_mate=2"), "--before_mate=2: asks a policy"),
        (("--task=puzzle", "--policy.type=expert", "--pictures=randomized"), "did you mean 'randomised'"),
        (("--task=puzzle", "--policy.type=expert", "--hide=touch,camera"), "--hide=camera: "),
        (("--task=puzzle", "--policy.type=expert", "--hide=touch"), "the expert reads no sensor"),
    ],
)  # fmt: skip
def test_wrong_words_end_before_any_rollout(
    words: tuple[str, ...], message: str, said: Any, tmp_path: Path
) -> None:
    code, shown = said("evaluate", *words, "--out=scored")
    assert code == 2 and message in shown and not (tmp_path / "scored").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--task=assembly2", "--policy.path=x"), "did you mean 'assembly_2'"),
        (("--task=puzzle",), "missing --policy.path=CHECKPOINT"),
        (("--task=puzzle", "--policy.type=expert"), "missing --policy.path=CHECKPOINT"),
        (("--task=puzzle", "--policy.path=x", "--takeover=al"), "--takeover=al"),
        (("--task=puzzle", "--policy.path=x", "--num_envs=0"), "--num_envs=0"),
        (
            ("--task=puzzle", "--policy.path=x", "--policy_workers=0"),
            "--policy_workers=0",
        ),
        (
            ("--task=puzzle", "--policy.path=x", "--policy_pictures=blurred"),
            "--policy_pictures=blurred",
        ),
        (
            ("--task=puzzle", "--policy.path=x", "--resolution=28x28"),
            "--resolution=28x28 has no effect",
        ),
        (
            ("--task=puzzle", "--policy.path=x", "--out=store/x", "--store=store"),
            "contain one another",
        ),
        (("--task=puzzle", "--policy.path=x", "--twin=none.yaml"), "none.yaml"),
    ],
)
def test_wrong_words_end_before_a_policy_is_corrected(
    words: tuple[str, ...], message: str, said: Any
) -> None:
    code, shown = said("correct", "--store=kept", *words)
    assert code == 2 and message in shown and not Path("kept").exists()


@pytest.mark.slow
def test_a_folder_that_is_no_checkpoint_is_named(said: Any, tmp_path: Path) -> None:
    code, shown = said("evaluate", "--task=puzzle", f"--policy.path={tmp_path}")
    assert code == 2 and f"--policy.path={tmp_path}: no config.json there" in shown
    code, shown = said(
        "evaluate", "--task=puzzle", "--policy.type=expert", f"--against={tmp_path}"
    )
    assert code == 2 and f"--against={tmp_path}: no config.json there" in shown
    code, shown = said(
        "correct", "--task=puzzle", "--policy.path=nowhere", "--store=kept"
    )
    assert code == 2 and "--policy.path=nowhere: no config.json there" in shown
    assert not any((tmp_path / name).exists() for name in ("outputs", "kept"))


def test_without_opengl_failures_come_without_pictures(said, tmp_path, monkeypatch):
    def fail(*_: Any) -> None:
        raise TaccorlError("no OpenGL here")

    monkeypatch.setattr("taccorl.sim.simulation.Simulation.render_states", fail)
    code, shown = said(*EXPERT[:-1], *SHORT, "--failures=1", "--out=scored")
    assert code == 0 and "note: failures have no pictures: no OpenGL here" in shown
    assert "timeout after 0.1 s" in (tmp_path / "scored/report.html").read_text()


def test_another_twin_is_scored_on_the_same_scenes(said: Any, tmp_path: Path) -> None:
    (tmp_path / "weak.yaml").write_text(
        "controller: {kp_nm_per_rad: [200.0, 200.0, 200.0, 100.0, 50.0, 50.0]}\n"
    )
    assert said(*EXPERT, *SHORT, "--failures=0", "--out=nominal")[0] == 0
    code, shown = said(
        *EXPERT,
        *SHORT,
        "--failures=0",
        "--twin=weak.yaml",
        "--against=nominal",
        "--out=weak",
    )
    assert code == 0 and "expert against expert (nominal)" in shown
    weak, nominal = (
        json.loads((tmp_path / name / "evaluation.json").read_text())
        for name in ("weak", "nominal")
    )
    assert weak["scenes"]["twin"] == "weak.yaml" and nominal["scenes"]["twin"] is None
    assert weak["about"]["digest of the twin"] != nominal["about"]["digest of the twin"]


@pytest.mark.slow
def test_a_checkpoint_is_preflighted_scored_and_shown(
    said: Any, checkpoint: Path, tmp_path: Path
) -> None:
    code, shown = said(
        *(
            "evaluate",
            f"--policy.path={checkpoint}",
            "--policy.device=cpu",
            "--task=assembly_1",
            "--against=expert",
        ),
        *(
            *SHORT,
            "--failures=1",
            "--pictures=randomised",
            "--before_mate=2",
            "--out=scored",
        ),
    )
    assert code == 0 and "preflight of" in shown
    rows = read_rows(tmp_path / "scored/episodes.jsonl")
    assert [row.pictures for row in rows] == [
        "randomised",
        "randomised",
        "none",
        "none",
    ]  # the expert sees none
    assert shown.index("cameras") < shown.index("0 of 2 episodes succeeded")
    page = (tmp_path / "scored/report.html").read_text()
    assert (
        "data:image/jpeg;base64," in page
        and "Paired comparison" in page
        and "Checkpoint and environment" in page
    )
    summary = json.loads((tmp_path / "scored/evaluation.json").read_text())
    held = summary["before_mate"][str(checkpoint)]["assembly_1"]
    assert held["grips"] == 2 and [len(held[k]) for k in ("kept", "error_m")] == [2, 2]
    assert (
        f"{checkpoint}, assembly_1, before the mate: keeps {held['kept'][0]:.2f} and"
        in shown
    )
    assert [p["name"] for p in summary["policies"]] == [str(checkpoint), "expert"]
    assert (
        len(summary["policies"][0]["digest"]) == 64
        and summary["comparisons"]["assembly_1"]["n"] == 2
    )
    assert (
        summary["scenes"]["pictures"] == "randomised" and "<td>randomised</td>" in page
    )
    (line,) = [
        c for c in summary["preflight"][str(checkpoint)] if c["what"] == "pictures"
    ]
    assert line["verdict"] == "same" and "crop 95 %" in line["environment"]

    other = shutil.copytree(checkpoint, tmp_path / "other")
    config = json.loads((other / "config.json").read_text())
    (other / "config.json").write_text(json.dumps({**config, "fps": 50}))
    seal_checkpoint(other)
    code, shown = said(
        "evaluate", f"--policy.path={other}", "--task=assembly_1", "--out=fast"
    )
    assert (
        code == 2
        and "rate: 50 Hz in the checkpoint, 30 Hz in the environment. Nothing was run"
        in shown
    )
    assert "preflight of" in shown and not (tmp_path / "fast").exists()


# ---- correct ----


@pytest.mark.slow
def test_what_lies_at_out_is_not_touched(said: Any, tmp_path: Path) -> None:
    from tiny_checkpoint import write_checkpoint

    checkpoint = write_checkpoint(tmp_path / "policy")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "file").touch()
    code, shown = said(
        "correct",
        f"--policy.path={checkpoint}",
        "--policy.device=cpu",
        "--task=assembly_2",
        "--out=mine",
    )
    assert (
        code == 2
        and "mine is occupied" in shown
        and [p.name for p in (tmp_path / "mine").iterdir()] == ["file"]
    )


@pytest.mark.slow
def test_a_checkpoint_is_corrected_and_the_same_command_makes_nothing_again(
    said: Any, tmp_path: Path
) -> None:
    from tiny_checkpoint import write_checkpoint

    checkpoint = write_checkpoint(tmp_path)
    words = (
        "correct",
        f"--policy.path={checkpoint}",
        "--policy.device=cpu",
        "--task=assembly_2",
        "--store=kept",
    )
    words += (
        "--episodes=2",
        "--num_envs=2",
        "--episode_length=3",
        "--images=false",
        "--out=corrections",
    )
    code, shown = said(*words)
    assert (
        code == 0
        and "preflight of" in shown
        and "0 of 2 episodes succeeded by themselves" in shown
    )
    assert (
        "takeovers: 2 (drawn before the grasp 2)" in shown and "; 0 kept out" in shown
    )
    report = json.loads(
        (tmp_path / "corrections/meta/taccorl/collect_report.json").read_text()
    )
    assert Dataset(tmp_path / "corrections").num_episodes == report["episodes"] >= 1
    assert (
        report["policy_outcomes"] == {"timeout": 2}
        and len(report["policy_digest"]) == 64
    )
    before = sorted(
        path.stat().st_mtime_ns for path in (tmp_path / "kept").rglob("*.npy")
    )
    assert said(*words)[0] == 0
    assert (
        sorted(path.stat().st_mtime_ns for path in (tmp_path / "kept").rglob("*.npy"))
        == before
    )
    code, shown = said("lineage", "explain", "corrections", "--store=kept")
    assert code == 0 and "policy_episodes" in shown and report["policy_digest"] in shown

"""pipelines/cotrain.py with its smallest numbers: collect, augment, merge, lerobot-train, lerobot-eval; and again without doing
anything anew. All of it is simulated: the real side is a surrogate robot."""

import json
import subprocess
from pathlib import Path

import pytest

from pipelines import cotrain
from taccorl.data.dataset import Dataset
from taccorl.data.origin import Origin

ROOT = Path(__file__).parents[2]
TWIN = Origin("twin", "MuJoCo twin, not a robot")


@pytest.mark.slow
@pytest.mark.timeout(1500)
@pytest.mark.parametrize("cache", ["none", "host"])
def test_demonstrations_of_both_domains_become_a_policy_and_its_scores(
    cache: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ROOT)
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    words = ["--small", f"--out={tmp_path}", f"--cache={cache}"]
    if cache == "host":
        words.append("--train_options=[--steps=4,--batch_size=4,--policy.pose_loss=0.1]")
    cotrain.main(words)
    out = tmp_path / "assembly_2"

    both = Dataset(out / "surrogate_7_and_twin")
    origins = [both.episode(k).origin for k in range(both.num_episodes)]
    num_sim = 2 if cache == "none" else 1
    assert origins[0].domain == "surrogate" and origins[1:] == [TWIN] * num_sim
    assert bool(both.unstored) == (cache == "host") == ("observation.environment_state" in both.info["features"])
    assert both.spec.action_time == "next_row"
    real = Dataset(out / "surrogate_7")
    assert real.provenance is not None and real.provenance["stage"] == "dataset"  # through recordings and ingest
    is_sim = [both.values(k, ["observation.is_sim"])["observation.is_sim"].mean() for k in range(1 + num_sim)]
    assert is_sim == [0.0] + [1.0] * num_sim
    (trained,) = out.glob("policy_*/checkpoints/last/pretrained_model/train_config.json")
    config = json.loads(trained.read_text())
    assert config["steps"] == 4 and config["policy"]["sim_weight"] == 0.5
    of_tiny_yaml = {"chunk_size": 16, "image_randomization": False}
    assert of_tiny_yaml.items() <= config["policy"].items()
    assert "surrogate" in config["dataset"]["repo_id"]

    told = json.loads((out / "outcomes.json").read_text())
    assert "surrogate" in told["data"] and told["steps"] == 4
    assert [(row["where"], row["seed"]) for row in told["outcomes"]] == [
        (f"{name} (simulated)", seed) for name in ("twin", "surrogate") for seed in (1000, 1001)
    ]
    for score in told["scores"].values():  # four steps of training insert nothing
        assert (score["successes"], score["attempts"]) == (0, 2)
        assert score["interval_95"][1] == pytest.approx(1.96**2 / (2 + 1.96**2), abs=1e-3)  # Wilson's end for 0 of 2
    page = (out / "outcomes.md").read_text()
    assert "| surrogate (simulated) | 0 of 2: 0 % (95 %: 0 … 66) |" in page and "Nothing here is of a robot" in page

    made = {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file() and path.parent != out}
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: pytest.fail("LeRobot was run again"))
    cotrain.main(words)
    again = {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file() and path.parent != out}
    assert again == made
    assert json.loads((out / "outcomes.json").read_text()) == told


def test_what_the_pipeline_does_not_know_is_named() -> None:
    with pytest.raises(SystemExit, match=r"did you mean 'secret'\?"):
        cotrain.main(["--secrte=3"])

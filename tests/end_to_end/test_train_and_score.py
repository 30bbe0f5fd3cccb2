"""From the twin to a score with stock commands: collect → lerobot-train (ACT, a few steps) → lerobot-eval in our environment."""

import json
import sys
from pathlib import Path

import pytest

from tests.fresh_python import printed as run

BIN = Path(sys.executable).parent
SMALL_ACT = (
    *("--policy.type=act", "--policy.push_to_hub=false", "--policy.device=cpu"),
    "--policy.pretrained_backbone_weights=null",
    *("--policy.dim_model=32", "--policy.n_heads=2", "--policy.dim_feedforward=32", "--policy.n_encoder_layers=1"),
    *("--policy.chunk_size=15", "--policy.n_action_steps=15"),
)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_act_trains_on_a_collected_dataset_and_is_scored_in_the_twin(tmp_path):
    dataset, trained, scored = tmp_path / "dataset", tmp_path / "trained", tmp_path / "scored"
    run(
        *(str(BIN / "taccorl"), "collect", "--task=assembly_1", "--episodes=1"),
        *(f"--out={dataset}", f"--store={tmp_path / 'store'}"),
    )
    run(
        *(str(BIN / "lerobot-train"), *SMALL_ACT, "--dataset.repo_id=local/dataset", f"--dataset.root={dataset}"),
        *("--steps=2", "--batch_size=1", "--num_workers=0", "--log_freq=1", "--save_freq=2", f"--output_dir={trained}"),
    )
    run(
        *(str(BIN / "lerobot-eval"), f"--policy.path={trained / 'checkpoints/last/pretrained_model'}"),
        *("--policy.device=cpu", "--env.type=taccorl", "--env.task=assembly_1", "--env.episode_length=15"),
        *("--eval.n_episodes=2", "--eval.batch_size=2", f"--output_dir={scored}"),
    )
    info = json.loads((scored / "eval_info.json").read_text())
    assert info["overall"]["n_episodes"] == 2
    assert info["overall"]["pc_success"] == 0.0  # two steps of training do not insert a plug in half a second

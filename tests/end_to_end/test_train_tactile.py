"""Datasets → lerobot-train (ACT; ours, stopped and resumed) → lerobot-eval in the twin; corrections: train, correct, train."""

import functools
import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from taccorl.data.dataset import Dataset
from taccorl.lineage.manifest import require_checkpoint
from taccorl.lineage.store import Store
from taccorl.sim.part_poses import PARTS_KEY
from taccorl.training.frame_cache import FrameIndex, frames_file, stored_frames
from tests.fresh_python import printed
from tests.fresh_python import printed as run

BIN = Path(sys.executable).parent


def logged(said: str, step: str) -> list[str]:
    """Learning rate and contact rate as LeRobot logs them for a step."""
    line = next(line for line in said.splitlines() if f"step:{step} " in line)
    return [word for word in line.split() if word.startswith(("lr:", "contact_rate:"))]


@pytest.mark.slow
@pytest.mark.timeout(1500)
def test_the_tactile_policy_is_trained_resumed_and_scored_by_stock_commands(tmp_path):
    from tiny_dataset import write_tiny

    from taccorl.training.cotrain import merge_domains

    real = write_tiny(tmp_path / "real", rows=(20, 15), cameras=3, picture_px=224)
    sim = write_tiny(tmp_path / "sim", rows=(25,), cameras=3, picture_px=224)
    merge_domains([real], [sim], tmp_path / "both")
    straight, stopped, scored = (
        tmp_path / "straight",
        tmp_path / "stopped",
        tmp_path / "scored",
    )
    train = [
        *(
            str(BIN / "lerobot-train"),
            "--policy.type=tactile_pi05",
            "--policy.backbone=tiny",
            "--policy.device=cpu",
        ),
        *(
            "--policy.push_to_hub=false",
            "--dataset.repo_id=local/both",
            f"--dataset.root={tmp_path / 'both'}",
        ),
        *("--steps=4", "--num_workers=0", "--log_freq=1", "--save_freq=2"),
    ]
    said = run(*train, "--batch_size=4", f"--output_dir={straight}")
    assert "loss_sim" in said and "loss_real" in said and "contact_rate" in said
    config = json.loads(
        (straight / "checkpoints/last/pretrained_model/config.json").read_text()
    )
    assert (
        config["tactile_format"]["gain_per_count"] == pytest.approx(1 / 75)
        and config["fps"] == 30
    )

    for step in ("000002", "last"):
        assert (
            require_checkpoint(
                straight / "checkpoints" / step / "pretrained_model", step
            )
            == []
        )

    # Stopped after two steps and resumed: the same rows at the same learning rate. Noise is another: LeRobot's loader draws a
    # seed for its workers from the generator that was just restored (with one that does not, see test_tactile_policy).
    shutil.copytree(straight / "checkpoints/000002", stopped / "checkpoints/000002")
    begun = stopped / "checkpoints/000002/pretrained_model/train_config.json"
    resumed = run(
        str(BIN / "lerobot-train"),
        f"--config_path={begun}",
        "--resume=true",
        f"--output_dir={stopped}",
    )
    for step in ("3", "4"):
        assert (
            logged(said, step) == logged(resumed, step) and len(logged(said, step)) == 2
        )

    # Two processes, by half of each batch: together they see the same rows.
    halves = [
        str(BIN / "torchrun"),
        "--nproc_per_node=2",
        *train,
        "--batch_size=2",
        f"--output_dir={tmp_path / 'both_trained'}",
    ]
    shared = run(*halves, ACCELERATE_USE_CPU="true", OMP_NUM_THREADS="1")
    assert "Effective batch size: 2 x 2 = 4" in shared
    assert [logged(shared, step) for step in "1234"] == [
        logged(said, step) for step in "1234"
    ]
    assert (
        require_checkpoint(
            tmp_path / "both_trained/checkpoints/last/pretrained_model", "last"
        )
        == []
    )

    run(
        *(
            str(BIN / "lerobot-eval"),
            f"--policy.path={straight / 'checkpoints/last/pretrained_model'}",
        ),
        *(
            "--policy.device=cpu",
            "--env.type=taccorl",
            "--env.task=assembly_2",
            "--env.episode_length=12",
        ),
        *("--eval.n_episodes=2", "--eval.batch_size=2", f"--output_dir={scored}"),
    )
    info = json.loads((scored / "eval_info.json").read_text())
    assert info["overall"]["n_episodes"] == 2
    assert (
        info["overall"]["pc_success"] == 0.0
    )  # four steps of training on random numbers insert nothing


SMALL_ACT = (
    *("--policy.type=act", "--policy.push_to_hub=false", "--policy.device=cpu"),
    "--policy.pretrained_backbone_weights=null",
    *(
        "--policy.dim_model=32",
        "--policy.n_heads=2",
        "--policy.dim_feedforward=32",
        "--policy.n_encoder_layers=1",
    ),
    *("--policy.chunk_size=15", "--policy.n_action_steps=15"),
)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_act_trains_on_a_collected_dataset_and_is_scored_in_the_twin(tmp_path):
    dataset, trained, scored = (
        tmp_path / "dataset",
        tmp_path / "trained",
        tmp_path / "scored",
    )
    run(
        *(str(BIN / "taccorl"), "collect", "--task=assembly_1", "--episodes=1"),
        *(f"--out={dataset}", f"--store={tmp_path / 'store'}"),
    )
    run(
        *(
            str(BIN / "lerobot-train"),
            *SMALL_ACT,
            "--dataset.repo_id=local/dataset",
            f"--dataset.root={dataset}",
        ),
        *(
            "--steps=2",
            "--batch_size=1",
            "--num_workers=0",
            "--log_freq=1",
            "--save_freq=2",
            f"--output_dir={trained}",
        ),
    )
    run(
        *(
            str(BIN / "lerobot-eval"),
            f"--policy.path={trained / 'checkpoints/last/pretrained_model'}",
        ),
        *(
            "--policy.device=cpu",
            "--env.type=taccorl",
            "--env.task=assembly_1",
            "--env.episode_length=15",
        ),
        *("--eval.n_episodes=2", "--eval.batch_size=2", f"--output_dir={scored}"),
    )
    info = json.loads((scored / "eval_info.json").read_text())
    assert info["overall"]["n_episodes"] == 2
    assert (
        info["overall"]["pc_success"] == 0.0
    )  # two steps of training do not insert a plug in half a second


ROOT = Path(__file__).parents[2]
SIZE = (28, 28)
CACHED = ("--pictures=cache", "--resolution=28x28", "--store=store")
ROWS = (*CACHED, "--rows_per_picture=3", "--part_poses=true")


@pytest.mark.slow
@pytest.mark.timeout(1500)
def test_corrections_join_demonstrations_with_the_frames_that_both_have(
    tmp_path: Path,
) -> None:
    run = functools.partial(printed, cwd=tmp_path, OMP_NUM_THREADS="2")

    def taccorl(*words: str) -> str:
        return run(sys.executable, "-m", "taccorl.cli.main", *words)

    def train(data: str, policy: str, *words: str) -> Path:
        run(
            *(
                str(BIN / "lerobot-train"),
                f"--config_path={ROOT / 'configs/learn/tiny.yaml'}",
                "--policy.device=cpu",
            ),
            *(
                "--policy.image_resolution=[28,28]",
                "--policy.sim_weight=1",
                "--policy.pose_loss=0.1",
                *words,
            ),
            *(
                f"--dataset.repo_id=local/{data}",
                f"--dataset.root={data}",
                "--dataset.cache=host",
            ),
            *(
                "--dataset.cache_store=store",
                "--steps=2",
                "--batch_size=4",
                "--num_workers=0",
            ),
            f"--output_dir={policy}",
        )
        return tmp_path / policy / "checkpoints/last/pretrained_model"

    taccorl(
        "collect", "--task=assembly_1", "--episodes=3", "--out=demonstrations", *ROWS
    )
    demonstrations = Dataset(tmp_path / "demonstrations")
    policy = train("demonstrations", "first")
    words = (
        f"--policy.path={policy}",
        "--policy.device=cpu",
        "--task=assembly_1",
        "--episodes=3",
        "--num_envs=2",
    )
    words += (
        "--episode_length=40",
        "--takeover=all",
        "--per_episode=2",
        "--before_grasp=true",
        "--out=corrections",
    )
    said = taccorl("correct", *words, *ROWS)
    assert (
        "next:    taccorl merge --sim=DEMONSTRATIONS --sim=corrections --pictures=cache --resolution=28x28"
        in said
    )
    report = json.loads(
        (tmp_path / "corrections/meta/taccorl/collect_report.json").read_text()
    )
    assert (
        report["policy_episodes"] == 3
        and report["attempts"] == 6
        and report["episodes"] >= 4
    )
    corrections = Dataset(tmp_path / "corrections")
    assert corrections.rows_per_picture == 3 and len(corrections.unstored) == 3

    said = taccorl(
        "merge", "--sim=demonstrations", "--sim=corrections", "--out=both", *CACHED
    )
    assert "rendered" not in said
    both, store = Dataset(tmp_path / "both"), Store(tmp_path / "store")
    assert (
        both.num_episodes == 3 + report["episodes"]
        and both.rows_per_picture == 3
        and len(both.unstored) == 3
    )
    assert not [key for key in both.info["features"] if key.startswith("sim.")]
    for k in range(both.num_episodes):
        source, i = (demonstrations, k) if k < 3 else (corrections, k - 3)
        for key in ("action", "observation.state", PARTS_KEY):
            np.testing.assert_array_equal(
                both.values(k, [key])[key], source.values(i, [key])[key]
            )
    parts = [
        np.load(frames_file(stored_frames(d.root, SIZE, store), both.unstored[0]))
        for d in (demonstrations, corrections)
    ]
    joined = np.load(
        frames_file(stored_frames(both.root, SIZE, store), both.unstored[0])
    )
    assert len(joined) == FrameIndex.of_dataset(both).num_frames
    np.testing.assert_array_equal(joined, np.concatenate(parts))
    train("both", "second", f"--policy.path={policy}")

"""Demonstrations and corrections at scale, with the smallest numbers: collect, train, correct, merge and train again; pictures of
every third row are in the frame cache alone. All of it is simulated; the policy learns nothing in two steps."""

import functools
import json
import sys
from pathlib import Path

import numpy as np
import pytest

from taccorl.data.dataset import Dataset
from taccorl.lineage.store import Store
from taccorl.sim.part_poses import PARTS_KEY
from taccorl.training.frame_cache import FrameIndex, frames_file, stored_frames
from tests.fresh_python import printed

ROOT = Path(__file__).parents[2]
BIN = Path(sys.executable).parent
SIZE = (28, 28)
CACHED = ("--pictures=cache", "--resolution=28x28", "--store=store")
ROWS = (*CACHED, "--rows_per_picture=3", "--part_poses=true")


@pytest.mark.slow
@pytest.mark.timeout(1500)
def test_corrections_join_demonstrations_with_the_frames_that_both_have(tmp_path: Path) -> None:
    run = functools.partial(printed, cwd=tmp_path, OMP_NUM_THREADS="2")

    def taccorl(*words: str) -> str:
        return run(sys.executable, "-m", "taccorl.cli.main", *words)

    def train(data: str, policy: str, *words: str) -> Path:
        run(
            *(str(BIN / "lerobot-train"), f"--config_path={ROOT / 'configs/learn/tiny.yaml'}", "--policy.device=cpu"),
            *("--policy.image_resolution=[28,28]", "--policy.sim_weight=1", "--policy.pose_loss=0.1", *words),
            *(f"--dataset.repo_id=local/{data}", f"--dataset.root={data}", "--dataset.cache=host"),
            *("--dataset.cache_store=store", "--steps=2", "--batch_size=4", "--num_workers=0"),
            f"--output_dir={policy}",
        )
        return tmp_path / policy / "checkpoints/last/pretrained_model"

    taccorl("collect", "--task=assembly_1", "--episodes=3", "--out=demonstrations", *ROWS)
    demonstrations = Dataset(tmp_path / "demonstrations")
    policy = train("demonstrations", "first")
    words = (f"--policy.path={policy}", "--policy.device=cpu", "--task=assembly_1", "--episodes=3", "--num_envs=2")
    words += ("--episode_length=40", "--takeover=all", "--per_episode=2", "--before_grasp=true", "--out=corrections")
    said = taccorl("correct", *words, *ROWS)
    assert "next:    taccorl merge --sim=DEMONSTRATIONS --sim=corrections --pictures=cache --resolution=28x28" in said
    report = json.loads((tmp_path / "corrections/meta/taccorl/collect_report.json").read_text())
    assert report["policy_episodes"] == 3 and report["attempts"] == 6 and report["episodes"] >= 4
    corrections = Dataset(tmp_path / "corrections")
    assert corrections.rows_per_picture == 3 and len(corrections.unstored) == 3

    said = taccorl("merge", "--sim=demonstrations", "--sim=corrections", "--out=both", *CACHED)
    assert "rendered" not in said
    both, store = Dataset(tmp_path / "both"), Store(tmp_path / "store")
    assert both.num_episodes == 3 + report["episodes"] and both.rows_per_picture == 3 and len(both.unstored) == 3
    assert not [key for key in both.info["features"] if key.startswith("sim.")]
    for k in range(both.num_episodes):
        source, i = (demonstrations, k) if k < 3 else (corrections, k - 3)
        for key in ("action", "observation.state", PARTS_KEY):
            np.testing.assert_array_equal(both.values(k, [key])[key], source.values(i, [key])[key])
    parts = [
        np.load(frames_file(stored_frames(d.root, SIZE, store), both.unstored[0]))
        for d in (demonstrations, corrections)
    ]
    joined = np.load(frames_file(stored_frames(both.root, SIZE, store), both.unstored[0]))
    assert len(joined) == FrameIndex.of_dataset(both).num_frames
    np.testing.assert_array_equal(joined, np.concatenate(parts))
    train("both", "second", f"--policy.path={policy}")

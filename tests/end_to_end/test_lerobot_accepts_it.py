"""The dataset under outside judges: LeRobot's loader, merge, viewer and trainer, and lerobot-doctor."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

BIN = Path(sys.executable).parent
OFFLINE = {**os.environ, "HF_HUB_OFFLINE": "1", "PYTHONWARNINGS": "ignore"}


def run(*words: str, timeout_s: float = 400) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [str(BIN / words[0]), *words[1:]],
        capture_output=True,
        text=True,
        timeout=timeout_s,
        env=OFFLINE,
    )


def test_lerobot_loads_every_row_with_touch_and_pictures(dataset: Path) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    loaded = LeRobotDataset("local/demo", root=dataset, video_backend="pyav")
    report = json.loads((dataset / "meta/taccorl/ingest_report.json").read_text())
    assert len(loaded) == report["rows"]
    for index in (0, len(loaded) // 2, len(loaded) - 1):
        row = loaded[index]
        assert row["observation.tactile"].shape == (1536,)
        assert row["observation.state"].shape == (14,)
        assert row["observation.images.front"].shape == (3, 224, 224)


def test_what_lerobots_tools_make_of_it_keeps_its_domain(
    dataset: Path, tmp_path: Path
) -> None:
    from lerobot.datasets.dataset_tools import delete_episodes, merge_datasets
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    from taccorl.data.dataset import Dataset, state_domains

    whole = LeRobotDataset("local/whole", root=dataset)
    delete_episodes(whole, [0], output_dir=tmp_path / "part", repo_id="local/part")
    merge_datasets(
        [whole, whole], output_repo_id="local/two", output_dir=tmp_path / "two"
    )
    for edited, num in (("part", 1), ("two", 4)):
        found = Dataset(tmp_path / edited)
        assert not (found.root / "meta/taccorl").exists()
        assert [
            found.episode_facts(i)["origin"].domain for i in range(found.num_episodes)
        ] == ["surrogate"] * num
    shutil.copytree(dataset, tmp_path / "twin")
    state_domains(tmp_path / "twin", ["twin"])
    other = LeRobotDataset("local/twin", root=tmp_path / "twin")
    with pytest.raises(ValueError, match="Same features is expected"):
        merge_datasets(
            [whole, other], output_repo_id="local/mixed", output_dir=tmp_path / "mixed"
        )


def test_lerobot_doctor_finds_nothing_to_fail(dataset: Path) -> None:
    done = run("lerobot-doctor", "check", str(dataset), "--json")
    assert done.returncode == 0, done.stdout + done.stderr
    summary = json.loads(done.stdout)["summary"]
    assert summary["FAIL"] == 0
    assert summary["PASS"] >= 8


@pytest.mark.slow
def test_lerobot_train_help_loads_our_plugin_without_a_flag() -> None:
    code = (
        "import sys; sys.argv = ['lerobot-train', '--help']\n"
        "from lerobot.scripts.lerobot_train import main\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        "assert 'lerobot_policy_taccorl' in sys.modules and 'taccorl.lerobot_plugin' in sys.modules"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=OFFLINE
    )
    assert done.returncode == 0, done.stderr
    assert "--policy" in done.stdout

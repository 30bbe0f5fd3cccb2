"""The policy's normalisation of datasets whose statistics are wrong or absent, and of elements that hardly move."""

import json
import logging
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from by_lerobot import write_with_lerobot
from lerobot.configs import NormalizationMode
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.factory import make_policy, make_pre_post_processors
from test_touch_without_unit import train

from taccorl.data.exact_statistics import QUANTILE_NAMES
from taccorl.errors import DatasetError, TaccorlError
from taccorl.policies.tactile_pi05.configuration_tactile_pi05 import TactilePI05Config
from taccorl.policies.tactile_pi05.statistics import (
    use_exact_statistics,
    with_finite_range,
)
from taccorl.training import reading

TOUCH = "observation.tactile.primary"
ROWS = 150  # of each of two episodes
WIDE = np.linspace(-1.0, 1.0, 2 * ROWS)
JOINTS = ("pan", "lift", "still", "gripper")


def write(root: Path) -> Path:
    """Elements: two that move, one that stands still at 0.02, one that is 0 but for two rows; a taxel pressed in two rows."""

    def row(k: int) -> dict[str, Any]:
        rare = float(k in (40, 41))
        joints = np.array([WIDE[k], WIDE[k] ** 2, 0.02, 0.04 * rare], np.float32)
        touch = np.array([30000 + 100 * WIDE[k], 500 * rare, 7.0], np.float32)
        values = {"observation.state": joints, "action": joints, TOUCH: touch}
        return {**values, "task": "press the button"}

    own = [f"{name}.pos" for name in JOINTS]
    names = {"observation.state": own, "action": own}
    episodes = [[row(k) for k in range(e, e + ROWS)] for e in (0, ROWS)]
    return write_with_lerobot(root, episodes, names=names)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("exact") / "dataset")


def spoil(root: Path, fault: str) -> None:
    """``fault``: as LeRobot left them; without quantiles; all quantiles equal; deviations and means of other data."""
    path = root / "meta/stats.json"
    stats = json.loads(path.read_text())
    for key in ("observation.state", "action", TOUCH):
        for name in QUANTILE_NAMES if fault == "absent" else ():
            del stats[key][name]
        for name in QUANTILE_NAMES if fault == "equal" else ():
            stats[key][name] = stats[key]["mean"]
        for name in ("std", "q99", "max") if fault == "other" else ():
            stats[key][name] = [100.0 * k for k in range(len(stats[key]["mean"]))]
    path.write_text(json.dumps(stats))


def batch_of_all(dataset: LeRobotDataset, horizon: int) -> dict[str, Any]:
    table = dataset.hf_dataset.with_format("torch")[:]
    batch = {k: table[k] for k in ("observation.state", TOUCH)}
    actions = table["action"][:, None].expand(-1, horizon, -1)
    padded = torch.zeros(len(actions), horizon, dtype=torch.bool)
    more = {"action": actions, "action_is_pad": padded}
    return {**batch, **more, "task": ["press the button"] * len(actions)}


@pytest.mark.parametrize("fault", ["none", "absent", "equal", "other"])
def test_the_policy_normalises_by_the_rows_whatever_is_stored(
    dataset, tmp_path, caplog, fault
):
    root = Path(shutil.copytree(dataset, tmp_path / "dataset"))
    spoil(root, fault)
    read = LeRobotDataset("local/other", root=root)
    config = TactilePI05Config(
        device="cpu", backbone="tiny", chunk_size=4, n_action_steps=4, tactile_history=1
    )
    with caplog.at_level(logging.WARNING):
        policy = make_policy(config, ds_meta=read.meta)
    lines = [r.getMessage() for r in caplog.records if "exact statistics" in r.message]
    assert len(lines) == 1 and f"its {2 * ROWS} rows" in lines[0]
    before, after = make_pre_post_processors(config, dataset_stats=read.meta.stats)
    plain = batch_of_all(read, config.chunk_size)
    batch = before(dict(plain))
    state, action, touch = (
        batch[k].numpy() for k in ("observation.state", "action", TOUCH)
    )
    # 1 % and 99 % of 300 rows are the 3rd and the 297th: ± 0.98662 of the first joint, exactly.
    assert np.abs(state[[2, 296], 0]) == pytest.approx(1.0, abs=1e-5)
    assert np.abs(state).max() <= 20.0 + 1e-4 and np.abs(action).max() <= 20.0 + 1e-4
    # Middle 0, half range 0.04 / 20: open is 20. Of a state that stands still its own value is 0, of an action −1.
    assert set(np.unique(state[:, 3].round(4))) == {0.0, 20.0}
    assert np.abs(state[:, 2]).max() < 1e-6 and (action[..., 2] == -1).all()
    # In use it may be elsewhere: 1 mm off is nothing to speak of, and 2 · 10⁵ with LeRobot's divisor 1e-8.
    elsewhere = plain["observation.state"][:1] + torch.tensor([0, 0, 1e-3, 0])
    used = before(
        {"observation.state": elsewhere, TOUCH: plain[TOUCH][:1], "task": [""]}
    )
    assert 0.01 < float(used["observation.state"][0, 2]) < 1.0
    # Whatever the policy says of the action that stands still, it stays where it was; the others come back.
    back = after(batch["action"])
    assert torch.allclose(back, plain["action"], atol=1e-5)
    noisy = after(batch["action"] + 0.5)
    assert torch.allclose(noisy[..., 2], torch.tensor(0.02), atol=1e-6)
    assert np.abs(touch).max() <= 20.0
    few = {k: v[38:44] for k, v in batch.items() if isinstance(v, torch.Tensor)}
    few[TOUCH] = few[TOUCH][:, None]
    loss, _ = policy.train().forward(few)
    assert np.isfinite(float(loss)) and float(loss) < 1e3


def test_low_and_high_move_apart_as_the_arithmetic_says():
    stats = {
        "min": np.array([-1.0, 0.0, 5.0]),
        "max": np.array([1.0, 8.0, 5.0]),
        "q01": np.array([-0.9, 0.0, 5.0]),
        "q99": np.array([0.7, 0.0, 5.0]),
        "std": np.array([0.5, 0.1, 0.0]),
    }
    quantiles = NormalizationMode.QUANTILES
    # h = 0.8 as it is; 8 / 20 = 0.4; 0.01 · √((0.8² + 0.4²) / 2) = 0.0063246
    state = with_finite_range(stats, quantiles, is_state=True)
    assert state["q01"] == pytest.approx([-0.9, -0.4, 5 - 0.0063246], abs=1e-6)
    assert state["q99"] == pytest.approx([0.7, 0.4, 5 + 0.0063246], abs=1e-6)
    action = with_finite_range(stats, quantiles, is_state=False)
    assert action["q01"].tolist() == [-0.9, -0.4, 5.0]
    assert action["q99"].tolist() == [0.7, 0.4, 5.0]
    deviation = with_finite_range(stats, NormalizationMode.MEAN_STD, is_state=True)
    # 8 / 20 again; 0.01 · √((0.5² + 0.4²) / 2) = 0.0045277
    assert deviation["std"] == pytest.approx([0.5, 0.4, 0.0045277], abs=1e-6)
    dead = {name: np.zeros(2) for name in stats}
    assert with_finite_range(dead, quantiles, is_state=True)["q99"].tolist() == [1, 1]
    same = with_finite_range(stats, NormalizationMode.IDENTITY, is_state=True)
    assert same == stats


def test_a_streamed_dataset_without_quantiles_is_refused(tmp_path):
    config = TactilePI05Config(device="cpu", backbone="tiny", tactile=False)
    feature = {"dtype": "float32", "shape": (2,)}
    known = {"repo_id": "local/other", "root": tmp_path, "stats": {"action": {}}}
    meta = SimpleNamespace(features={"action": feature}, **known)
    with pytest.raises(TaccorlError, match=r"no q01 and q99 of action.*--repair=COPY"):
        use_exact_statistics(config, meta)


def saved(checkpoint: Path) -> dict[str, torch.Tensor]:
    config = TactilePI05Config.from_pretrained(checkpoint)
    before, _ = make_pre_post_processors(config, pretrained_path=str(checkpoint))
    step = next(s for s in before.steps if hasattr(s, "norm_map"))
    return step.state_dict()


@pytest.mark.slow
def test_lerobots_command_trains_without_quantiles_and_resumes_with_its_own(
    dataset, tmp_path, capfd
):
    root = Path(shutil.copytree(dataset, tmp_path / "dataset"))
    spoil(root, "absent")
    out = tmp_path / "out"
    words = ["--policy.tactile_history=1", "--save_freq=2"]
    first = saved(train(root, out, *words))
    assert capfd.readouterr().err.count("normalised by exact statistics") == 1
    # Other rows' statistics: the resumed training keeps those of its checkpoint, and says nothing.
    spoil(root, "other")
    config = out / "checkpoints/last/pretrained_model/train_config.json"
    again = saved(
        train(root, out, "--resume=true", f"--config_path={config}", "--steps=4")
    )
    assert "exact statistics" not in capfd.readouterr().err
    assert first.keys() == again.keys()
    assert all(torch.equal(first[k], again[k]) for k in first)


def test_absent_statistics_are_said_with_the_way_out(dataset, tmp_path):
    root = Path(shutil.copytree(dataset, tmp_path / "dataset"))
    (root / "meta/stats.json").unlink()
    with pytest.MonkeyPatch.context() as patch:
        from lerobot.datasets import lerobot_dataset

        patch.setattr(lerobot_dataset, "DatasetReader", reading.FastReader)
        with pytest.raises(DatasetError, match=r"stats.json is absent.*--repair=COPY"):
            LeRobotDataset("local/other", root=root).hf_dataset  # noqa: B018

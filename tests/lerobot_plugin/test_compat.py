"""LeRobot after 0.6.1, imitated: each test has one of its newer signatures or results."""

from pathlib import Path
from typing import Any

import cv2
import lerobot
import numpy as np
import pytest
import torch
from lerobot.datasets import compute_stats, dataset_reader
from lerobot.policies.pi05.modeling_pi05 import PI05Pytorch

from taccorl.data.lerobot_format import _pixels_counted
from taccorl.errors import TaccorlError
from taccorl.lerobot_plugin import compat
from taccorl.policies.tactile_pi05.network import TactilePI05Pytorch
from taccorl.policies.tactile_pi05.tokenizer import ByteTokenizer, WordTokenizer
from taccorl.rl.post_train import _last_run
from taccorl.robot_plugin import lerobot_hooks
from taccorl.training import reading

GET_ITEM = "lerobot.datasets.dataset_reader:DatasetReader.get_item"


@pytest.fixture
def newer(monkeypatch: pytest.MonkeyPatch) -> None:
    """LeRobot 0.6.2, of which one function is compared; nothing of it stays."""
    monkeypatch.setattr(lerobot, "__version__", "0.6.2")
    monkeypatch.setattr(compat, "REPLACED", {GET_ITEM: compat.REPLACED[GET_ITEM]})
    monkeypatch.setattr(compat.changed, "__defaults__", (compat.REPLACED,))
    for module in (reading, lerobot_hooks):
        monkeypatch.setattr(module, "COMPARED_VERSION", module.COMPARED_VERSION)


def test_the_installed_version_has_the_parameters_of_the_table() -> None:
    stock = [
        p for p in compat.REPLACED if p.split(":")[0].startswith("lerobot.rollout")
    ]
    stock += [GET_ITEM, "lerobot.datasets.dataset_reader:DatasetReader.__init__"]
    assert not compat.changed({place: compat.REPLACED[place] for place in stock})


def test_a_newer_version_with_the_same_parameters_is_followed(newer: None) -> None:
    assert compat.follow()
    assert reading.COMPARED_VERSION == lerobot_hooks.COMPARED_VERSION == "0.6.2"


def test_a_newer_version_with_another_parameter_is_named(
    newer: None, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def get_item(self: Any, idx: int, decode: bool = True) -> dict:
        return {}

    monkeypatch.setattr(dataset_reader.DatasetReader, "get_item", get_item)
    assert not compat.follow()
    assert f"{GET_ITEM}(idx, decode=True) was {GET_ITEM}(idx)" in caplog.text
    assert reading.COMPARED_VERSION == lerobot_hooks.COMPARED_VERSION == "0.6.1"


def test_a_function_that_a_newer_version_removed_is_named() -> None:
    lines = compat.changed({"lerobot.gone:function": "self"})
    assert lines == ["lerobot.gone:function(absent) was lerobot.gone:function(self)"]


def test_a_memory_is_passed_on_to_the_prefix(monkeypatch: pytest.MonkeyPatch) -> None:
    """LeRobot's main: ``embed_prefix(…, masks, states=None, state_masks=None)``."""
    given = []

    def embed_prefix(
        self: Any, images, img_masks, tokens, masks, states=None, state_masks=None
    ):
        given.append((states, state_masks))
        return tokens, masks, masks

    monkeypatch.setattr(PI05Pytorch, "embed_prefix", embed_prefix)
    model = TactilePI05Pytorch.__new__(TactilePI05Pytorch)
    torch.nn.Module.__init__(model)
    model.paligemma_with_expert = torch.nn.Module()  # pyright: ignore
    model.fusion = model._touch = None
    tokens, mask, states = torch.zeros(1, 2), torch.ones(1, 2), torch.ones(1, 3)
    model.embed_prefix([], [], tokens, mask, states, mask)
    model.embed_prefix([], [], tokens, mask)
    assert given == [(states, mask), (None, None)]


@pytest.mark.parametrize("kind", [ByteTokenizer, WordTokenizer])
def test_a_shipped_tokenizer_is_saved_without_files(kind: Any, tmp_path: Path) -> None:
    assert kind().save_pretrained(tmp_path) == ()
    assert not [*tmp_path.iterdir()]


def test_a_histogram_of_one_dimension_counts_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """OpenCV 5 returns (256,), OpenCV 4 (256, 1)."""
    pixels = np.array([[3, 200], [3, 7], [5, 7]], np.uint8)
    stock, counts = cv2.calcHist, []
    for shape in ((256, 1), (256,)):
        monkeypatch.setattr(
            cv2, "calcHist", lambda *a, shape=shape: stock(*a).reshape(shape)
        )
        with _pixels_counted():
            running: Any = compute_stats.RunningQuantileStats()
            running.update(pixels)
        counts.append(running.counts)
    np.testing.assert_array_equal(counts[0], counts[1])
    assert counts[1].shape == (2, 256)
    assert (counts[1][0, 3], counts[1][0, 5], counts[1][1, 7]) == (2, 1, 2)


def test_the_run_of_weights_and_biases_is_read_without_lerobot(tmp_path: Path) -> None:
    """LeRobot's main has trackio where 0.6.1 has ``wandb_utils``."""
    assert _last_run(tmp_path) is None
    run = tmp_path / "wandb" / "latest-run"
    run.mkdir(parents=True)
    with pytest.raises(TaccorlError, match=r"0 files run-\*\.wandb"):
        _last_run(tmp_path)
    (run / "run-a1b2.wandb").touch()
    assert _last_run(tmp_path) == "a1b2"

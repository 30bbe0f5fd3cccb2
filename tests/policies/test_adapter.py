"""Adapters (PEFT) of lerobot-train, merged into their base wherever a policy is loaded; what is refused; a training at rate 0."""

import dataclasses
import importlib.util
import json
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.policies.factory import make_policy
from safetensors.torch import load_file, save_file
from test_touch_without_unit import train
from tiny_dataset import write_tiny
from tiny_policies import batch_of, chunk

from taccorl.cli.main import main
from taccorl.errors import TaccorlError
from taccorl.evaluation.policy_actor import open_checkpoint
from taccorl.lineage.manifest import require_checkpoint
from taccorl.policies.tactile_pi05.backbone import SIZES
from taccorl.policies.tactile_pi05.modeling_tactile_pi05 import TactilePI05Policy

needs_peft = pytest.mark.skipif(
    importlib.util.find_spec("peft") is None, reason="the extra peft is not installed"
)
FULL = (
    "--policy.type=tactile_pi05",
    "--policy.backbone=full",
    "--policy.tokenizer=words",
)
FULL += ("--policy.image_resolution=[56,56]",)
RATE_0 = ("--steps=1", "--policy.optimizer_lr=0", "--policy.scheduler_decay_lr=0")
LORA = (
    "--peft.method_type=LORA",
    "--peft.r=4",
    "--steps=3",
    "--policy.optimizer_lr=0.01",
)
STORED, NAMED = "adapter_model.safetensors", "adapter_config.json"


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SimpleNamespace]:
    """A checkpoint of the full policy in the size of tiny, and in ``plain`` its weights without touch, as of π0.5."""
    folder = tmp_path_factory.mktemp("adapters")
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(SIZES, "full", SIZES["tiny"])
        root = write_tiny(folder / "dataset", cameras=3, picture_px=224)
        whole = train(root, folder / "whole", *FULL, *RATE_0)
        weights = load_file(whole / "model.safetensors")
        (folder / "plain").mkdir()
        plain = {
            name: value
            for name, value in weights.items()
            if not name.startswith("model.tactile.")
        }
        save_file(plain, folder / "plain/model.safetensors")
        yield SimpleNamespace(folder=folder, root=root, whole=whole, weights=weights)


@pytest.fixture(scope="module", params=["whole", "plain"])
def adapter(request: pytest.FixtureRequest, place: SimpleNamespace) -> Path:
    """Of the checkpoint, whose folder is given by a link, and of the weights without touch."""
    start = (f"--policy.path={place.whole}",)
    if request.param == "plain":
        start = (*FULL, f"--policy.base_checkpoint={place.folder / 'plain'}")
    made = train(place.root, place.folder / f"adapter_{request.param}", *start, *LORA)
    assert (
        not (made / "model.safetensors").exists() and require_checkpoint(made, "") == []
    )
    assert (
        "/last/" not in (made / NAMED).read_text()
    )  # a link that leads to another base later
    return made


def weights_of(checkpoint: Path) -> dict[str, torch.Tensor]:
    return open_checkpoint(checkpoint, "cpu").load(0).policy.state_dict()


@needs_peft
def test_a_merged_adapter_acts_as_lerobots_own_and_no_other_weight_changed(
    adapter: Path, place: Any
) -> None:
    config = PreTrainedConfig.from_pretrained(adapter)
    config.pretrained_path = adapter
    theirs = make_policy(
        config, ds_meta=LeRobotDatasetMetadata("local/dataset", root=place.root)
    ).eval()
    ours, base = (
        open_checkpoint(path, "cpu").load(0).policy for path in (adapter, place.whole)
    )
    assert type(ours) is TactilePI05Policy and not ours.config.use_peft
    assert all(weight.requires_grad for weight in ours.parameters())
    batch = batch_of(True, False)
    torch.testing.assert_close(
        chunk(ours, batch), chunk(theirs, batch), atol=1e-5, rtol=0
    )
    assert (chunk(ours, batch) - chunk(base, batch)).abs().max() > 1e-3
    stored = {
        name.removeprefix("base_model.model."): x
        for name, x in load_file(adapter / STORED).items()
    }
    assert ours.state_dict().keys() == place.weights.keys()
    for name, value in ours.state_dict().items():
        adapted = name.removesuffix("weight") + "lora_A.weight" in stored
        wanted = (
            stored[name] if name.startswith("model.tactile.") else place.weights[name]
        )
        assert torch.equal(value, wanted) != adapted, name
    moved = [
        name
        for name in stored
        if "lora" not in name and not torch.equal(stored[name], place.weights[name])
    ]
    assert (
        "model.tactile.encoder.out.weight" in moved
        and "model.tactile.into_context.out.weight" in moved
    )


@needs_peft
def test_training_at_rate_0_writes_the_merged_weights(
    adapter: Path, place: Any, tmp_path: Path
) -> None:
    made = train(
        place.root,
        tmp_path / "out",
        f"--policy.path={adapter}",
        "--policy.use_peft=false",
        *RATE_0,
    )
    assert (made / "model.safetensors").is_file() and not (made / NAMED).exists()
    merged = weights_of(adapter)
    assert all(
        torch.equal(merged[name], value) for name, value in weights_of(made).items()
    )


def test_training_at_rate_0_leaves_every_bit_of_a_checkpoint(
    place: Any, tmp_path: Path
) -> None:
    made = train(place.root, tmp_path / "out", f"--policy.path={place.whole}", *RATE_0)
    assert (made / "model.safetensors").read_bytes() == (
        place.whole / "model.safetensors"
    ).read_bytes()


@needs_peft
@pytest.mark.slow
def test_post_training_an_adapter_leaves_plain_weights(
    adapter: Path, place: Any, tmp_path: Path
) -> None:
    words = [
        "--env.task=assembly_2",
        "--env.num_envs=2",
        "--env.decisions=2",
        "--env.episode_length=12",
    ]
    words += [
        "--anchor.batch_size=2",
        f"--anchor.dataset={place.root}",
        "--noise_check=false",
        "--iterations=1",
    ]
    assert (
        main(
            [
                "post-train",
                f"--policy.path={adapter}",
                f"--out={tmp_path / 'out'}",
                *words,
            ]
        )
        == 0
    )
    made = tmp_path / "out/checkpoints/last/pretrained_model"
    assert (made / "model.safetensors").is_file() and not (made / NAMED).exists()
    before, after = weights_of(adapter), weights_of(made)
    assert before.keys() == after.keys() and any(
        not torch.equal(value, after[name]) for name, value in before.items()
    )


@needs_peft
def test_an_adapter_that_cannot_be_merged_is_one_line(
    adapter: Path, tmp_path: Path, monkeypatch: Any
) -> None:
    broken = shutil.copytree(adapter, tmp_path / "adapter")
    (broken / "manifest.json").unlink()
    opened, stored, config = (
        open_checkpoint(broken),
        load_file(broken / STORED),
        json.loads((broken / NAMED).read_text()),
    )
    first = min(stored)
    for weights, said in (
        (
            {name: x for name, x in stored.items() if name != first},
            f"1 weights are missing or unknown, first {first}",
        ),
        (
            {**stored, f"{first}.more": torch.zeros(1)},
            "1 weights are missing or unknown",
        ),
        ({**stored, first: torch.zeros(3, 5)}, "size mismatch"),
    ):
        save_file(weights, broken / STORED)
        with pytest.raises(
            TaccorlError,
            match=f"{broken}: adapter .* does not fit its base policy /.*{said}",
        ):
            opened.load(0)
    (broken / STORED).unlink()
    with pytest.raises(TaccorlError, match=f"without {STORED}"):
        opened.load(0)
    digests = [opened.digest]
    with (
        monkeypatch.context() as patch,
        pytest.raises(TaccorlError, match=r"needs peft, .*: pip install .*\[peft\]"),
    ):
        patch.setitem(sys.modules, "peft", None)
        open_checkpoint(broken)
    moved = tmp_path / "moved"
    (broken / NAMED).write_text(
        json.dumps({**config, "base_model_name_or_path": str(moved)})
    )
    with pytest.raises(TaccorlError, match=f"its base policy {moved} does not exist"):
        open_checkpoint(broken)
    shutil.copytree(config["base_model_name_or_path"], moved)
    digests.append(opened.digest)
    (moved / "notes").write_text("another base")
    assert len({*digests, opened.digest}) == 3


@needs_peft
@pytest.mark.parametrize(
    ("decay", "start", "said"),
    [
        (0.0, None, "--peft: nothing to adapt"),
        (
            0.9,
            "plain",
            r"--policy\.average_decay=0\.9 .*trained with --policy\.average_decay=0",
        ),
        (0.0, "plain", "full_training_modules: needs model.tactile"),
    ],
)
def test_what_an_adapter_cannot_start_from_is_refused(
    place: Any, decay: float, start: str | None, said: str
) -> None:
    config: Any = PreTrainedConfig.from_pretrained(place.whole)
    policy = TactilePI05Policy(
        dataclasses.replace(config, pretrained_path=None, average_decay=decay)
    )
    policy.config.base_checkpoint = start
    with pytest.raises(TaccorlError, match=said):
        policy.wrap_with_peft(peft_cli_overrides={"full_training_modules": []})


def test_missing_and_damaged_weights_are_noticed_before_a_network_is_built(
    place, tmp_path, monkeypatch
):
    monkeypatch.setattr(
        "taccorl.policies.tactile_pi05.modeling_tactile_pi05.TactilePI05Pytorch", None
    )
    flipped, cut, config = (
        tmp_path / "flipped",
        tmp_path / "cut",
        PreTrainedConfig.from_pretrained(place.whole),
    )
    whole = (place.whole / "model.safetensors").read_bytes()
    for folder, data in (
        (flipped, whole[:-1] + bytes([whole[-1] ^ 0x40])),
        (cut, whole[:-1]),
    ):  # an exponent
        shutil.copytree(place.whole, folder)
        (folder / "model.safetensors").write_bytes(data)
    (cut / "manifest.json").unlink()
    for start, said in (
        (flipped, "is damaged"),
        (cut, "no weights to read"),
        (tmp_path / "none", "no weights to read"),
    ):
        with pytest.raises(
            TaccorlError, match=f"--policy.base_checkpoint={start}: .*{said}"
        ):
            TactilePI05Policy(dataclasses.replace(config, base_checkpoint=str(start)))  # pyright: ignore
        with pytest.raises(TaccorlError, match=f"checkpoint {start}: .*{said}"):
            TactilePI05Policy.from_pretrained(start, config=config)
    with pytest.raises(TypeError):  # of the network that is None
        TactilePI05Policy.from_pretrained(place.whole, config=config)

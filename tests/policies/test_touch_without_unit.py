"""Touch of other people's robots: datasets of LeRobot's own writer, trained by LeRobot's own command; and what is refused."""

import dataclasses
import math
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from by_lerobot import write_with_lerobot
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.factory import make_pre_post_processors
from lerobot.scripts import lerobot_train
from tiny_dataset import CHANGED
from tiny_policies import FORMAT, TACTILE, tiny_config

from taccorl.errors import TaccorlError
from taccorl.policies.tactile_pi05.configuration_tactile_pi05 import TactilePI05Config
from taccorl.policies.tactile_pi05.encoder import scales
from taccorl.policies.tactile_pi05.modeling_tactile_pi05 import TactilePI05Policy
from taccorl.policies.tactile_pi05.processor_tactile_pi05 import center_and_scale
from taccorl.training import reading

Touch = dict[str, tuple[str, tuple[int, ...]]]  # Feature → its type and shape
LAYOUTS: dict[str, tuple[int, str | None, Touch]] = {
    "leflexitac": (6, "video", {"observation.tactile.primary": ("float32", (12, 32))}),
    "anyskin": (
        7,
        None,
        {
            "observation.tactile.left": ("float32", (15,)),
            "observation.tactile.right": ("int16", (15,)),
        },
    ),
    "paxini": (
        16,
        "image",
        {
            "observation.tactile": ("int32", (4, 5, 9)),
            "observation.tactile.fsr": ("float32", (1,)),
        },
    ),
    "gripper": (1, None, {"observation.tactile": ("float32", (1,))}),
}
"""Dataset → number of joints, kind of its pictures, its touch."""
NETWORKS = {
    "leflexitac": ["observation/tactile/primary"],
    "anyskin": ["observation/tactile/left", "observation/tactile/right"],
    "paxini": ["observation/tactile", "observation/tactile/fsr"],
    "gripper": ["observation/tactile"],
}
HISTORY, STRIDE = 3, 2


def write(
    root: Path,
    joints: int,
    pictures: str | None,
    touch: Touch,
    rows: tuple[int, ...] = (9, 7),
) -> Path:
    rng, motion = np.random.default_rng(0), ("observation.state", "action")

    def row() -> dict[str, Any]:
        made: dict[str, Any] = {
            key: rng.normal(size=joints).astype(np.float32) for key in motion
        }
        made |= {
            key: (300 + 40 * rng.normal(size=shape)).astype(dtype)
            for key, (dtype, shape) in touch.items()
        }
        if pictures:
            made["observation.images.top"] = rng.integers(
                0, 255, (48, 64, 3), dtype=np.uint8
            )
        return made | {"task": "press the button"}

    names = {key: [f"joint_{k}.pos" for k in range(joints)] for key in motion}
    images = ["observation.images.top"] if pictures == "image" else []
    return write_with_lerobot(
        root, [[row() for _ in range(n)] for n in rows], names=names, images=images
    )


def train(root: Path, out: Path, *words: str) -> Path:
    """``lerobot-train``, the command itself; returns the folder of the last checkpoint."""
    with pytest.MonkeyPatch.context() as patch:
        for module, names in CHANGED.items():
            for name in names:
                patch.setattr(
                    module, name, getattr(module, name)
                )  # so that it is put back
        assert reading.install()
        own = ("--policy.type=tactile_pi05", "--policy.backbone=tiny")
        argv = [
            *(
                "lerobot-train",
                *(() if any(w.startswith("--policy.path") for w in words) else own),
            ),
            *(
                "--policy.device=cpu",
                "--policy.push_to_hub=false",
                "--dataset.video_backend=pyav",
            ),
            *(
                "--dataset.repo_id=local/other",
                f"--dataset.root={root}",
                f"--output_dir={out}",
                "--num_workers=0",
            ),
            *("--steps=2", "--batch_size=4", *words),
        ]
        patch.setattr(sys, "argv", argv)
        lerobot_train.main()
    return out / "checkpoints/last/pretrained_model"


@pytest.fixture(
    scope="module",
    params=[
        "leflexitac",
        *(
            pytest.param(p, marks=pytest.mark.slow)
            for p in ("anyskin", "paxini", "gripper")
        ),
    ],
)
def trained(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> SimpleNamespace:
    place = tmp_path_factory.mktemp(request.param)
    joints, pictures, touch = LAYOUTS[request.param]
    root = write(place / "dataset", joints, pictures, touch)
    window = f"--policy.tactile_history={HISTORY}", f"--policy.tactile_stride={STRIDE}"
    return SimpleNamespace(
        name=request.param,
        root=root,
        touch=touch,
        checkpoint=train(root, place / "out", *window),
        place=place,
    )


def opened(checkpoint: Path) -> tuple[TactilePI05Policy, Any, Any]:
    config = TactilePI05Config.from_pretrained(checkpoint)
    policy = TactilePI05Policy.from_pretrained(checkpoint, config=config)
    return policy, *make_pre_post_processors(config, pretrained_path=str(checkpoint))


def observation(row: dict[str, Any]) -> dict[str, Any]:
    """As a robot's loop gives it: one row, without its action."""
    told = {k: v[None] for k, v in row.items() if k.startswith("observation.")}
    return {**told, "task": [row["task"]]}


def chunk(policy: TactilePI05Policy, batch: dict[str, Any]) -> torch.Tensor:
    torch.manual_seed(7)
    return policy.predict_action_chunk(batch)


def test_touch_of_any_shape_is_trained_by_lerobots_command_and_used(trained, tmp_path):
    policy, preprocess, postprocess = opened(trained.checkpoint)
    config = policy.config
    assert config.tactile_layouts == {
        key: list(shape) for key, (_, shape) in trained.touch.items()
    }
    assert config.tactile_format is None
    every = LeRobotDataset("local/other", root=trained.root, video_backend="pyav")
    rows = [dict(row) for row in every][:9]  # pyright: ignore  # one episode
    ages = [4, 2, 0]
    batch = preprocess(
        observation(rows[8])
        | {
            key: torch.stack([rows[8 - age][key] for age in ages])[None]
            for key in trained.touch
        }
        | {"action": torch.zeros(1, config.chunk_size, rows[0]["action"].numel())}
    )
    # Gradients reach the network of every feature.
    policy.train().zero_grad()
    policy.forward(batch)[0].backward()
    encoder = policy.model.tactile.encoder
    networks = [
        name for name, _ in encoder.named_children() if name not in ("hidden", "out")
    ]
    assert networks == NETWORKS[trained.name]
    for name in networks:
        first = next(encoder.get_submodule(name).parameters())
        assert first.grad is not None and first.grad.abs().max() > 0
    # The output depends on every feature and on every reading of its window.
    policy.eval()
    plain = chunk(policy, batch)
    for key in trained.touch:
        for k in range(HISTORY):
            other = batch[key].clone()
            other[:, k] += 1
            assert not torch.equal(chunk(policy, {**batch, key: other}), plain)
    # A robot that sends row after row gets the same window.
    policy.config.n_action_steps = 1
    policy.reset()
    for row in rows:
        torch.manual_seed(7)
        action = policy.select_action(preprocess(observation(row)))
    assert torch.equal(action, plain[:, 0])
    # Saved and loaded: the same.
    for part in (policy, preprocess, postprocess):
        part.save_pretrained(tmp_path)
    again, process, _ = opened(tmp_path)
    assert torch.equal(chunk(again, batch), plain)
    for key in trained.touch:
        assert torch.equal(
            process(observation(rows[3]))[key], preprocess(observation(rows[3]))[key]
        )
    # Hidden by dropout: as without touch.
    policy.train()
    policy.config.touch_dropout = 1 - 1e-9
    hidden, _ = policy._by_contact(
        batch, lambda rows: (torch.tensor([policy.model.touch is None]),)
    )
    assert hidden[0].all()


def test_a_checkpoint_refuses_other_touch_and_the_twin(trained, tmp_path, capsys):
    from taccorl.cli.main import main

    joints, pictures, touch = LAYOUTS[trained.name]
    (first, (dtype, shape)), *others = touch.items()
    lacks = write(
        tmp_path / "lacks",
        joints,
        pictures,
        {"observation.tactile.new": (dtype, shape), **dict(others)},
    )
    path = f"--policy.path={trained.checkpoint}"
    with pytest.raises(
        TaccorlError,
        match=f"has no {first}, which --policy.tactile=true needs.*observation.tactile.new",
    ):
        train(lacks, tmp_path / "one", path)
    turned = write(
        tmp_path / "turned",
        joints,
        pictures,
        {**touch, first: (dtype, (*shape[:-1], shape[-1] + 1))},
    )
    with pytest.raises(
        TaccorlError, match=f"{first} has readings of .*, but the policy .* takes "
    ):
        train(turned, tmp_path / "two", path)
    for verb in (
        ["evaluate", "--task=assembly_1"],
        ["post-train", "--env.task=assembly_1", "--anchor.weight=0"],
    ):
        code = main([*verb, path, "--policy.device=cpu", f"--out={tmp_path / verb[0]}"])
        said = capsys.readouterr().err
        assert code == 2 and "does not fit the environment" in said
        assert all(key in said for key in touch) or "unit of touch" in said


# What a dataset states, without training.


def meta(**touch: Any) -> SimpleNamespace:
    """Of a dataset with one vector of touch and the features given."""
    features = {"observation.state": {"dtype": "float32", "shape": (14,)}, **touch}
    known = {
        "repo_id": "local/other",
        "root": "/other",
        "fps": 30,
        "stats": {},
        "episodes": {"length": [40]},
    }
    return SimpleNamespace(features=features, **known)


OWN = {
    "dtype": "int16",
    "shape": (1536,),
    "tactile": {**dataclasses.asdict(FORMAT), "layout": [1, 4, 32, 12]},
}
GRID = {"dtype": "float32", "shape": (12, 32)}
VECTOR = {"dtype": "float32", "shape": (384,)}


def matched(features: dict[str, Any], **changes: Any) -> TactilePI05Config:
    given = {k: f for k, f in tiny_config().input_features.items() if k != TACTILE}  # pyright: ignore
    given |= {
        k: PolicyFeature(FeatureType.STATE, tuple(f["shape"]))
        for k, f in features.items()
    }
    config = tiny_config(**{"tactile_format": None, "input_features": given, **changes})
    config.match_dataset(meta(**features))
    config.validate_features()
    return config


@pytest.mark.parametrize(
    ("features", "changes", "layouts"),
    [
        ({f"{TACTILE}.primary": GRID}, {}, {f"{TACTILE}.primary": (1, 12, 32)}),
        (
            {f"{TACTILE}.b": VECTOR, f"{TACTILE}.a": GRID},
            {},
            {f"{TACTILE}.a": (1, 12, 32), f"{TACTILE}.b": (1, 384)},
        ),
        (
            {TACTILE: {**VECTOR, "layout": [2, 12, 16]}},
            {},
            {TACTILE: (2, 12, 16)},
        ),  # of taccorl ingest
        (
            {TACTILE: {"dtype": "uint8", "shape": (2, 3, 4, 5)}},
            {},
            {TACTILE: (6, 4, 5)},
        ),
        # metadata of another program's
        (
            {
                TACTILE: {
                    **GRID,
                    "tactile": {"sensor": "x"},
                    "layout": ["row", "column"],
                }
            },
            {},
            {TACTILE: (1, 12, 32)},
        ),
        ({TACTILE: OWN}, {}, {TACTILE: (4, 32, 12)}),
        (
            {f"{TACTILE}.gel": VECTOR, TACTILE: OWN},
            {},
            {TACTILE: (4, 32, 12), f"{TACTILE}.gel": (1, 384)},
        ),
        # chosen: a part of them, and a vector as its grid
        (
            {f"{TACTILE}.a": VECTOR, f"{TACTILE}.b": GRID},
            {f"{TACTILE}.a": [12, 32]},
            {f"{TACTILE}.a": (1, 12, 32)},
        ),
        # pictures of a sensor are a camera
        (
            {TACTILE: OWN, f"{TACTILE}.gel": {"dtype": "video", "shape": (48, 64, 3)}},
            {},
            {TACTILE: (4, 32, 12)},
        ),
    ],
)
def test_every_feature_of_touch_is_used_or_named(features, changes, layouts, caplog):
    config = matched(features, tactile_layouts=changes or None)
    found = config.require_touch()
    assert {key: touch.layout for key, touch in found.items()} == layouts
    assert {key for key, touch in found.items() if touch.gain_per_count} == (
        {TACTILE} if features.get(TACTILE) is OWN else set()
    )
    assert {
        k for k, f in config.input_features.items() if f.type is FeatureType.ENV
    } == set(layouts)  # pyright: ignore
    assert set(config.window_delta_indices(features)) == set(layouts)
    unused = {
        k for k, f in features.items() if k not in layouts and f["dtype"] != "video"
    }
    warned = [
        r.getMessage()
        for r in caplog.records
        if r.levelname == "WARNING" and "does not use" in r.getMessage()
    ]
    assert all(any(key in text for text in warned) for key in unused) and bool(
        unused
    ) == bool(warned)
    config.match_dataset(meta(**features))  # as a checkpoint goes on
    assert config.require_touch() == found


def test_a_window_at_the_pads_own_rate_is_named_and_not_used(caplog):
    window = {
        "dtype": "int16",
        "shape": (15360,),
        "tactile": {**OWN["tactile"], "layout": [10, 4, 32, 12]},
    }
    assert list(
        matched({TACTILE: OWN, f"{TACTILE}_window": window}).require_touch()
    ) == [TACTILE]
    assert f"the policy does not use {TACTILE}_window" in caplog.text
    with pytest.raises(
        TaccorlError, match=f"has no {TACTILE}, .*It has: .*{TACTILE}_window"
    ):
        matched({f"{TACTILE}_window": window})


@pytest.mark.parametrize(
    ("features", "changes", "said"),
    [
        (
            {f"{TACTILE}.a": {"dtype": "string", "shape": (1,)}},
            {},
            f"{TACTILE}.a holds string.*remove_feature",
        ),
        (
            {f"{TACTILE}.a": GRID},
            {"contact_threshold": 0.2},
            f"contact_threshold=0.2 has no effect.*{TACTILE}.a",
        ),
        (
            {f"{TACTILE}.a": GRID},
            {"contact_min_active": 3},
            "contact_min_active=3 has no effect",
        ),
        (
            {f"{TACTILE}.a": GRID},
            {"noise_threshold": 0.1},
            "noise_threshold=0.1 has no effect",
        ),
        (
            {f"{TACTILE}.a": GRID, TACTILE: OWN},
            {"contact_min_active": 3},
            "contact_min_active=3 has no effect",
        ),
        (
            {f"{TACTILE}.a": GRID},
            {"tactile_layouts": {f"{TACTILE}.b": [15]}},
            f"has no {TACTILE}.b,.*{TACTILE}.a",
        ),
        (
            {f"{TACTILE}.a": GRID},
            {"tactile_layouts": {f"{TACTILE}.a": [32, 12]}},
            "of 12 × 32, but .* takes 32 × 12",
        ),
        (
            {f"{TACTILE}.a": VECTOR},
            {"tactile_layouts": {f"{TACTILE}.a": [12, 31]}},
            "of 384, but .* takes 12 × 31",
        ),
        (
            {f"{TACTILE}.a": GRID},
            {"tactile_format": FORMAT},
            f"has no {TACTILE},.*{TACTILE}.a",
        ),
        ({}, {}, f"has no {TACTILE}, which --policy.tactile=true needs"),
    ],
)
def test_touch_that_cannot_be_used_is_refused_by_name(features, changes, said):
    with pytest.raises(TaccorlError, match=said):
        matched(features, **changes)


def test_noise_of_pads_with_a_unit_is_suppressed_beside_touch_without():
    config = matched(
        {TACTILE: OWN, f"{TACTILE}.a": {"dtype": "float32", "shape": (2,)}},
        noise_threshold=0.1,
    )
    policy = TactilePI05Policy(config)
    rows = {
        TACTILE: torch.full((1, 10, 1536), 0.05),
        f"{TACTILE}.a": torch.full((1, 10, 2), 0.05),
    }
    readings, contact = policy._readings(rows)
    assert readings is not None and contact is not None
    assert (
        not readings[..., :1536].any()
        and (readings[..., 1536:] == 0.05).all()
        and contact.all()
    )
    names = [name for name, _ in policy.model.tactile.encoder.named_children()]
    assert names == ["pad", "observation/tactile/a", "hidden", "out"]
    assert policy.model.tactile(readings, contact).tokens_BMD.shape[:2] == (1, 16)


def test_statistics_are_of_each_element_of_a_vector_and_one_of_a_grid():
    """Vector: deviations, at least a tenth of the root mean square of all, √((3² + 0.01²) / 2) where the second hardly moves.
    Grid, by LeRobot's statistics of its columns: means 1 and 3, deviations 1 and 3: mean 2, √((1 + 9 + 1 + 1) / 2) = √6."""
    told = {
        "mean": [1.0, 2.0],
        "std": [3.0, 4.0],
        "min": [-9.0, -9.0],
        "max": [9.0, 9.0],
    }
    center, scale = center_and_scale({"x": told}, "x", is_grid=False)
    assert center.tolist() == [1, 2] and scale.tolist() == [3, 4]
    still = {**told, "std": [3.0, 0.01]}
    _, scale = center_and_scale({"x": still}, "x", is_grid=False)
    assert scale.tolist() == pytest.approx([3, 0.1 * math.sqrt((9 + 0.0001) / 2)])
    center, scale = center_and_scale(
        {"x": {**told, "mean": [1.0, 3.0], "std": [1.0, 3.0]}}, "x", is_grid=True
    )
    assert float(center) == 2 and float(scale) == pytest.approx(math.sqrt(6))


@pytest.mark.parametrize(
    ("told", "said"),
    [
        (
            {"std": [0.0, 0.0], "min": [1.0, 2.0], "max": [1.0, 2.0]},
            "x cannot be normalised.*never change",
        ),
        (
            {"std": [0.2, 0.1], "min": [1.0, 2.0], "max": [1.0, 2.0]},
            "x cannot be normalised",
        ),  # by rounding
        ({"std": [0.0, 0.0]}, "x cannot be normalised"),
        ({"mean": [math.nan, 1.0]}, "x cannot be normalised.*its mean is nan"),
        (None, "has no 'x' of x"),
    ],
)
def test_touch_without_usable_statistics_is_refused(told, said):
    whole = {
        "mean": [1.0, 2.0],
        "std": [1.0, 1.0],
        "min": [-9.0, -9.0],
        "max": [9.0, 9.0],
    }
    for is_grid in (False, True):
        with pytest.raises(TaccorlError, match=said):
            center_and_scale(
                {} if told is None else {"x": {**whole, **told}}, "x", is_grid=is_grid
            )


def test_processors_without_statistics_do_not_pass_touch_on():
    config = matched({f"{TACTILE}.a": GRID})
    process, _ = make_pre_post_processors(config)
    row = {
        "observation.state": torch.zeros(1, 14),
        f"{TACTILE}.a": torch.zeros(1, 12, 32),
        "task": ["x"],
    }
    with pytest.raises(TaccorlError, match=f"statistics of {TACTILE}.a are not known"):
        process(row)


def test_readings_without_a_unit_have_two_scales_with_both_signs():
    """One standard deviation is 100 counts: log 11 and 0.5. −10 deviations are −log 101 and, at most, −3."""
    fine, coarse = scales(torch.tensor([1.0, -10.0, 0.0]), None)
    torch.testing.assert_close(fine, torch.tensor([math.log(11), -math.log(101), 0.0]))
    torch.testing.assert_close(coarse, torch.tensor([0.5, -3.0, 0.0]))

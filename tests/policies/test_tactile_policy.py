"""Touch on its way into the policy: windows, formats, processors, weights, and what is said when they do not fit."""

import copy
import dataclasses
import math
from types import SimpleNamespace
from typing import Any

import draccus
import pytest
import torch
from lerobot.optim.optimizers import (
    AdamWConfig,
    OptimizerConfig,
    load_optimizer_state,
    save_optimizer_state,
)
from lerobot.policies.factory import make_pre_post_processors
from lerobot.policies.pi05.configuration_pi05 import PI05Config
from lerobot.policies.rtc.configuration_rtc import RTCConfig
from safetensors.torch import save_file
from tiny_policies import (
    FORMAT,
    TACTILE,
    batch_of,
    chunk,
    losses,
    plain_pi05,
    readings,
    sees_with,
    tiny_config,
    tiny_policy,
)

from taccorl.errors import TaccorlError
from taccorl.policies.tactile_pi05 import cameras
from taccorl.policies.tactile_pi05.cameras import CameraEncoder, CameraSize, NormReLU
from taccorl.policies.tactile_pi05.configuration_tactile_pi05 import (
    TactilePI05Config,
    TouchInput,
    WarmupThenCosine,
)
from taccorl.policies.tactile_pi05.encoder import StateToken, TactileEncoder, scales
from taccorl.policies.tactile_pi05.modeling_tactile_pi05 import TactilePI05Policy
from taccorl.policies.tactile_pi05.processor_tactile_pi05 import TactileReadingStep
from taccorl.policies.tactile_pi05.tokenizer import (
    ByteTokenizer,
    PromptTokenizerStep,
    WordTokenizer,
)
from taccorl.policies.tactile_pi05.weights import load_base_weights

FEATURE = {
    "dtype": "int16",
    "shape": (1536,),
    "tactile": {
        "sensor": "flexitac_v2",
        "layout": [1, 4, 32, 12],
        "pads": ["left_a", "left_b", "right_a", "right_b"],
        "scheme": "fixed_scale",
        "gain_per_count": 1 / 75,
    },
}


def metadata(**changes: Any) -> SimpleNamespace:
    """Of a dataset, as much of it as the policy reads."""
    known = {
        "repo_id": "local/demo",
        "root": "/demo",
        "fps": 30,
        "episodes": {"length": [40, 12]},
    }
    return SimpleNamespace(
        **{**known, "features": {TACTILE: FEATURE, "observation.state": {}}, **changes}
    )


@pytest.mark.parametrize(
    ("history", "ages"), [(4, (3, 2, 1, 0)), (3, (4, 2, 0)), (1, (0,))]
)
def test_the_window_is_the_last_readings_and_the_first_one_before_there_were_any(
    history, ages
):
    stride = ages[-2] if history > 1 else 5
    policy = tiny_policy(
        tactile_history=history, tactile_stride=stride, n_action_steps=1
    )
    assert policy.config.window_rows == ages[0] + 1
    batch, felt = batch_of(True, False), torch.rand(6, 2, 1536)
    for step, reading in enumerate(felt):
        torch.manual_seed(step)
        action = policy.select_action({**batch, TACTILE: reading})
        # as LeRobot fills up a dataset's windows
        window = felt[[max(0, step - age) for age in ages]].transpose(0, 1)
        assert torch.equal(
            action, chunk(policy, {**batch, TACTILE: window}, seed=step)[:, 0]
        )
    policy.reset()
    torch.manual_seed(0)
    again = policy.select_action({**batch, TACTILE: felt[5]})
    assert torch.equal(
        again,
        chunk(
            policy, {**batch, TACTILE: felt[5][:, None].expand(-1, history, -1)}, seed=0
        )[:, 0],
    )
    with pytest.raises(TaccorlError, match=r"\(1, 1536\) after \(2, 1536\).*reset\(\)"):
        policy.select_action(
            {k: v[:1] for k, v in batch.items()} | {TACTILE: felt[5, :1]}
        )


def test_an_observation_may_bring_its_window_along():
    policy, batch = tiny_policy(n_action_steps=1), batch_of(True, False)
    torch.manual_seed(7)
    assert torch.equal(policy.select_action(batch), chunk(policy, batch)[:, 0])


def test_touch_of_another_shape_or_none_is_refused():
    policy, batch = tiny_policy(), batch_of(True)
    with pytest.raises(
        TaccorlError,
        match=r"\(1, 1536\), but the policy needs \(batch, 10, 1536\).*TACCORL_NO_PATCH",
    ):
        policy.predict_action_chunk({**batch, TACTILE: readings(True)[:, -1]})
    with pytest.raises(TaccorlError, match=r"\(1, 10, 768\)"):
        policy.forward({**batch, TACTILE: readings(True)[..., :768]})
    del batch[TACTILE]
    with pytest.raises(
        TaccorlError, match=f"has no {TACTILE}; it has: observation.images.front"
    ):
        policy.forward(batch)


def test_the_format_comes_from_the_dataset_and_stays():
    config = tiny_config(tactile_format=None)
    with pytest.raises(TaccorlError, match="does not know the format of touch"):
        TactilePI05Policy(config)
    config.match_dataset(metadata())
    assert config.tactile_format == FORMAT and config.fps == 30
    config.match_dataset(metadata(repo_id="local/other"))


@pytest.mark.parametrize(
    ("told", "said"),
    [
        (
            {"features": {"observation.state": {}}},
            "has no observation.tactile, which --policy.tactile=true needs: --policy.tactile=false",
        ),
        ({"fps": 50}, "has 50 rows per second, but the checkpoint was trained with 30"),
        (
            {"episodes": {"length": [40, 9]}},
            "episode 1 has 9 rows, but the window of touch has 10",
        ),
        (
            {"features": {TACTILE: {"dtype": "int16", "shape": (1536,)}}},
            "does not state what its",
        ),
    ],
)
def test_a_dataset_that_does_not_fit_is_named_with_both_sides(told, said):
    config = tiny_config(fps=30)
    with pytest.raises(TaccorlError, match=said) as error:
        config.match_dataset(metadata(**told))
    assert "local/demo" in str(error.value)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"gain_per_count": 0.01}, "gain_per_count: 0.01 there, 0.0133333"),
        (
            {"layout": [1, 4, 12, 32]},
            "rows: 12 there, 32 in the checkpoint; columns: 32 there, 12",
        ),
        (
            {"scheme": "per_frame_max"},
            "scheme: per_frame_max there, fixed_scale in the checkpoint",
        ),
        (
            {"layout": [1, 4, 32, 16]},
            r"has shape \(1536,\), but its layout states \[1, 4, 32, 16\]",
        ),
        ({"pads": ["a", "b"]}, "names the pads a, b, but its layout states 4"),
    ],
)
def test_touch_that_is_not_the_checkpoints_is_named_with_both_sides(changed, said):
    feature = {**FEATURE, "tactile": {**FEATURE["tactile"], **changed}}
    with pytest.raises(TaccorlError, match=said):
        tiny_config().match_dataset(metadata(features={TACTILE: feature}))


def test_counts_become_readings_and_the_normaliser_leaves_them(tmp_path):
    stats = {
        key: {
            name: torch.full((size,), value)
            for name, value in (
                ("q01", -2.0),
                ("q99", 2.0),
                ("mean", 0.0),
                ("std", 1.0),
            )
        }
        for key, size in (("observation.state", 14), ("action", 14), (TACTILE, 1536))
    }
    config = tiny_config(tokenizer="bytes", tokenizer_max_length=150)
    config.validate_features()
    before, after = make_pre_post_processors(config, dataset_stats=stats)
    counts = torch.randint(-20, 240, (2, 10, 1536))  # LeRobot gives int64
    raw = {
        **{k: v for k, v in batch_of(True, False).items() if "language" not in k},
        TACTILE: counts,
        "observation.state": torch.tensor([[1.0] * 14, [-2.0] * 14]),
        "action_is_pad": torch.zeros(2, 10, dtype=torch.bool),
        "task": ["insert the plug", "move"],
    }
    seen = before(dict(raw))
    torch.testing.assert_close(seen[TACTILE], counts.float() / 75)
    torch.testing.assert_close(
        seen["observation.state"][0], torch.full((14,), 0.5)
    )  # quantiles −2 … 2 → −1 … 1
    assert torch.equal(seen["action_is_pad"], raw["action_is_pad"])
    tokens = seen["observation.language.tokens"][0][
        seen["observation.language.attention_mask"][0]
    ]
    prompt = f"Task: insert the plug, State: {' '.join(['192'] * 14)};\nAction: "
    assert bytes((tokens[1:] - 2).tolist()).decode() == prompt
    assert seen["observation.language.tokens"].shape == (2, 150)
    # Saved and loaded without being told anything, as lerobot-eval does.
    before.save_pretrained(tmp_path)
    after.save_pretrained(tmp_path)
    loaded, _ = make_pre_post_processors(config, pretrained_path=str(tmp_path))
    again = loaded(dict(raw))
    assert all(
        torch.equal(again[k], v) for k, v in seen.items() if isinstance(v, torch.Tensor)
    )


def test_relative_actions_of_a_chunk_are_relative_to_the_state_that_it_was_predicted_for(
    tmp_path,
):
    names = [f"joint_{k}" for k in range(13)] + ["gripper"]
    config = tiny_config(
        use_relative_actions=True,
        action_feature_names=names,
        n_action_steps=3,
        tactile=False,
    )
    config.validate_features()
    ones = torch.ones(14)
    action = {"q01": -0.2 * ones, "q99": 0.4 * ones, "mean": 0 * ones, "std": ones}
    stats = {
        "observation.state": {
            "q01": -2 * ones,
            "q99": 2 * ones,
            "mean": 0 * ones,
            "std": ones,
        },
        "action": action,
    }
    for steps in make_pre_post_processors(config, dataset_stats=stats):
        steps.save_pretrained(tmp_path)
    before, after = make_pre_post_processors(config, pretrained_path=str(tmp_path))
    policy = tiny_policy(
        use_relative_actions=True,
        action_feature_names=names,
        n_action_steps=3,
        tactile=False,
    )
    seen = {
        k: v
        for k, v in batch_of(False, False).items()
        if "language" not in k and k not in (TACTILE, "action")
    }
    planned = []
    plan = policy.predict_action_chunk
    policy.predict_action_chunk = lambda batch, **kw: (
        planned.append(plan(batch, **kw)) or planned[-1]
    )
    for k in range(5):
        state = torch.linspace(-0.3, 0.3, 14).expand(2, 14) + 0.05 * k
        told = policy.select_action(
            before({**seen, "observation.state": state, "task": ["move"] * 2})
        )
        sent = after(told)
        came_from, step = (0, k) if k < 3 else (3, k - 3)
        change = (planned[-1][:, step] + 1) / 2 * 0.6 - 0.2  # quantiles −0.2 … 0.4
        at_plan = torch.linspace(-0.3, 0.3, 14) + 0.05 * came_from
        at_plan[13] = 0.0  # absolute
        torch.testing.assert_close(sent, change + at_plan, atol=1e-5, rtol=0)
    assert len(planned) == 2
    # Real-time chunking: a whole chunk has the same actions, and the next one begins as what is left of it. Euler's steps of
    # LeRobot's guidance, up to 10, overshoot with fewer than 10 steps: 0.098 here.
    policy.config.rtc_config, policy.config.num_inference_steps = RTCConfig(), 4
    policy.init_rtc_processor()
    weights = policy.rtc_processor.get_prefix_weights(3, 5, 6).tolist()
    assert weights == [1, 1, 1, 0, 0, 0], (
        "of what is executed before the chunk comes; LINEAR: then 2/3, 1/3, 0"
    )
    rows = before(
        {**seen, "observation.state": at_plan.expand(2, 14), "task": ["move"] * 2}
    )
    torch.testing.assert_close(after(planned[-1])[:, 1], sent, atol=1e-5, rtol=0)
    free, guided = (
        plan(rows, inference_delay=3, prev_chunk_left_over=left)
        for left in (None, planned[-1][:, 1:6])
    )
    assert (free - planned[-1])[:, :3].abs().max() > 1 and (
        guided[:, :3] - planned[-1][:, 1:4]
    ).abs().max() < 0.05


def test_a_prompt_is_never_cut_and_other_tokenizers_are_asked_for_by_name(tmp_path):
    step = PromptTokenizerStep(tokenizer_name="bytes", max_length=12)
    assert step._tokenize_text("ä")["input_ids"].tolist() == [
        [1, 0xC3 + 2, 0xA4 + 2] + 9 * [0]
    ]
    with pytest.raises(
        TaccorlError,
        match="a prompt has 13 tokens, but the policy takes 12: 'insert plugs'",
    ):
        step._tokenize_text(["insert plugs"])
    assert len(ByteTokenizer()) == 258
    with pytest.raises(
        TaccorlError, match=r"tokenizer=.*cannot be loaded.*Without network"
    ):
        PromptTokenizerStep(tokenizer_name=str(tmp_path))
    with pytest.raises(TaccorlError, match="'per_frame_max': only 'fixed_scale'"):
        TactileReadingStep(scheme="per_frame_max")


def test_each_number_of_the_state_is_one_token_and_near_ones_start_out_alike():
    numbers = [*range(-1, 256)]
    tokens = WordTokenizer().tokens(
        f"Task: Move the TUBE, State: {' '.join(map(str, numbers))};\nAction: "
    )
    begin, task, colon, move, the, tube, comma, state, also_colon = tokens[:9]
    assert begin == 1 and colon == also_colon
    assert (
        len({task, move, the, tube, comma, state, colon}) == 7
        and min(task, move, the, tube, comma, state, colon) >= 259
    )
    assert tokens[9 : 9 + 257] == [
        n + 3 for n in numbers
    ]  # 0: filling, 1: the beginning, 2: −1
    assert (
        tokens[4:6] == WordTokenizer().tokens("the tube")[1:]
    )  # capitals are no other word
    assert (
        WordTokenizer().tokens("256 1000")[1:] != WordTokenizer().tokens("255 100")[1:]
    )
    assert all(
        259 <= token < len(WordTokenizer()) == 515
        for token in WordTokenizer().tokens("256 1000")[1:]
    )
    rows = PromptTokenizerStep(tokenizer_name="words", max_length=6)._tokenize_text(
        ["move 7", "turn the tube 12"]
    )
    assert rows["attention_mask"].sum(1).tolist() == [3, 5] and rows["input_ids"][
        0, 3:
    ].tolist() == [0, 0, 0]
    policy = tiny_policy()
    words = policy.model.paligemma_with_expert.paligemma.model.language_model.embed_tokens.weight.detach()
    numbers_ND = words[2:259] / words[2:259].norm(dim=1, keepdim=True)
    alike = numbers_ND @ numbers_ND.T
    assert alike.diagonal(1).min() > 0.7 > 0.5 > alike.diagonal(30).max()
    assert words[2:259].std() == pytest.approx(words[259:].std().item(), rel=0.1)


@pytest.mark.parametrize("is_discrete", [True, False])
def test_a_state_beside_the_prompt_is_exact_where_one_in_the_prompt_has_256_steps(
    is_discrete,
):
    """Over 2 rad a step is 8 mrad, at half a metre 4 mm: more than parts leave each other to be joined."""
    policy = tiny_policy(
        tactile=False, discrete_state_input=is_discrete, tokenizer_max_length=60
    )
    stats = {
        k: {"q01": torch.full((14,), -1.0), "q99": torch.full((14,), 1.0)}
        for k in ("observation.state", "action")
    }
    before, _ = make_pre_post_processors(policy.config, dataset_stats=stats)
    rows = {
        k: v
        for k, v in batch_of(False).items()
        if "language" not in k and k != "action"
    } | {"task": ["join them"]}
    middle = (torch.arange(14) - 7 + 0.5) / 128  # of steps
    prompts, chunks = [], []
    for state in (middle, middle + 0.003, middle + 0.01):
        seen = before({**rows, "observation.state": state[None]})
        prompts.append(seen["observation.language.tokens"])
        chunks.append(chunk(policy, seen))
    assert (
        torch.equal(prompts[0], prompts[1])
        and torch.equal(prompts[0], prompts[2]) is not is_discrete
    )
    assert torch.equal(chunks[0], chunks[1]) is is_discrete and not torch.equal(
        chunks[0], chunks[2]
    )
    number = WordTokenizer().tokens("130")[1]
    assert (number in prompts[0]) is is_discrete


def test_the_state_is_the_backbones_own_affair_unless_told():
    assert TactilePI05Config(
        backbone="full"
    ).has_discrete_state  # as π0.5 was pretrained
    assert not TactilePI05Config(backbone="small").has_discrete_state
    assert not tiny_config(discrete_state_input=None).has_discrete_state
    assert TactilePI05Config(
        backbone="small", discrete_state_input=True
    ).has_discrete_state


def test_no_joint_is_beyond_its_limit_in_the_token_of_the_state():
    """LeRobot's normaliser makes 2e8 of the noise of a joint that stood still in all of the data."""
    token = StateToken(2, 8)
    assert torch.equal(
        token(torch.tensor([[0.3, 2e8]])), token(torch.tensor([[0.3, 4.0]]))
    )


def test_a_point_is_where_its_map_is_high():
    size = CameraSize(
        stem_channels=16, blocks=((32, 2),), points=2, pooled_width=4, tokens=3
    )
    camera = CameraEncoder(size, 8)
    assert camera.maps(camera.features(torch.rand(1, 3, 84, 112))).shape == (
        1,
        2,
        21,
        28,
    )
    maps = torch.zeros(
        2, 2, 5, 9
    )  # of two pictures; sharpness 3: 40 · 3 is all of a softmax
    maps[0, 0, 1, 6] = (
        40  # of 9 columns −1 … 1 the seventh: 0.5; of 5 rows the second: −0.5
    )
    maps[0, 1, 4, 0] = 40
    maps[1, 0, 0, [2, 8]] = 40  # two alike: between them, at column 5, 0.25
    points = camera.points(
        maps
    )  # x of both maps, then y; the second of the second picture is flat, so the middle
    torch.testing.assert_close(
        points, torch.tensor([[0.5, -1.0, -0.5, 1.0], [0.25, 0.0, -1.0, 0.0]])
    )

    # A softmax that is not all in one place: of 9 columns one weighs e^(3 · 0.5 · 2) = e³, the rest 1 each.
    torch.nn.init.constant_(camera.sharpness, 0.5)
    soft = torch.zeros(1, 2, 1, 9)
    soft[0, 0, 0, 8] = 2
    weight = math.exp(3) / (math.exp(3) + 8)
    places = [-1 + column / 4 for column in range(9)]
    assert camera.points(soft)[0, 0].item() == pytest.approx(
        weight + (1 - weight) * sum(places[:8]) / 8, rel=1e-5
    )


def test_norm_sum_and_relu_are_those_of_pytorchs_modules_in_the_maps_own_precision():
    layer, x, beside = NormReLU(32), torch.randn(2, 32, 5, 4), torch.randn(2, 32, 5, 4)
    torch.nn.init.normal_(layer.weight)
    normed = torch.nn.GroupNorm(2, 32)  # 16 channels a group
    normed.load_state_dict(layer.state_dict())
    torch.testing.assert_close(layer(x, beside), (normed(x) + beside).clamp(min=0))
    with torch.autocast("cpu", torch.bfloat16):
        assert layer(x.bfloat16()).dtype == torch.bfloat16


def test_norms_are_compiled_in_training_and_on_request_in_updates_alone(monkeypatch):
    """Never where an evaluation asks: each of its batches would be compiled anew."""
    calls = []

    def noted(*given):
        calls.append(given[0].shape)
        return cameras._norm_relu(*given)

    monkeypatch.setattr(cameras, "_compiled_norm_relu", noted)
    layer, x = NormReLU(32), torch.randn(2, 32, 5, 4)
    for training, requested, gradients, compiled in (
        (True, False, True, True),
        (False, False, True, False),
        (False, True, True, True),
        (False, True, False, False),
    ):
        layer.train(training)
        layer.compiles_updates = requested
        calls.clear()
        with torch.set_grad_enabled(gradients):
            layer(x)
        assert bool(calls) == compiled


def test_each_camera_has_key_points_of_its_own_and_none_may_be_missing():
    policy, batch = tiny_policy(), batch_of(True, True)
    front, left = "observation.images.front", "observation.images.left_wrist"
    tower: Any = policy.model.paligemma_with_expert.paligemma.model.vision_tower
    images = [batch[k] for k in policy.config.image_features]
    for camera, image, tokens in zip(tower.cameras, images, tower(images), strict=True):
        assert tokens.shape == (2, 4, 96) and torch.equal(tokens, camera(image))
    assert not torch.equal(
        chunk(policy, {**batch, front: batch[left], left: batch[front]}),
        chunk(policy, batch),
    )
    del batch[left]
    for use in (chunk, losses):
        with pytest.raises(
            TaccorlError,
            match=r"backbone=tiny has weights for each camera.* no observation.images.left_wrist; ",
        ):
            use(policy, batch)
    # LeRobot's own cameras that are never there
    more, batch = tiny_policy(empty_cameras=1), batch_of(True, True)
    seen = chunk(more, batch)
    torch.nn.init.ones_(
        more.model.paligemma_with_expert.paligemma.model.vision_tower.cameras[
            3
        ].out.bias
    )
    assert torch.equal(chunk(more, batch), seen)


def test_a_tiny_of_other_layers_is_told_apart(tmp_path):
    with sees_with("patches"):
        tiny_policy().save_pretrained(tmp_path)
    with pytest.raises(
        TaccorlError,
        match=r"an earlier taccorl's tiny had other layers .* train anew\. Nothing was loaded",
    ):
        TactilePI05Policy.from_pretrained(tmp_path)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (
            {"image_resolution": (56, 84)},
            "tiny requires square pictures of a multiple of 28 pixels",
        ),
        (
            {"image_resolution": (70, 70)},
            "tiny requires square pictures of a multiple of 28 pixels",
        ),
        (
            {"backbone": "full", "image_resolution": (56, 84)},
            "full requires square pictures, such as",
        ),
    ],
)
def test_towers_of_patches_refuse_pictures_that_they_cannot_divide(changes, said):
    with sees_with("patches"), pytest.raises(TaccorlError, match=said):
        TactilePI05Policy(tiny_config(**changes))


def letterboxed(seed: int = 0, rows: int = 42, px: int = 56) -> torch.Tensor:
    frame, top = torch.zeros(2, 3, px, px), (px - rows) // 2
    frame[:, :, top : top + rows] = torch.rand(
        2, 3, rows, px, generator=torch.Generator().manual_seed(seed)
    )
    return frame


def test_pictures_of_the_cameras_aspect_are_what_lies_between_the_bars():
    """42 of 56 rows are the picture, 3 : 4 as 480 × 640; a chunk and a loss from the frame are those from the picture alone."""
    policy = tiny_policy(image_resolution=(21, 28), image_rotation_deg=0.0)
    frames = {key: letterboxed(k) for k, key in enumerate(policy.config.image_features)}
    rows = {**batch_of(True, False), **frames}
    inside = {**rows, **{key: frame[:, :, 7:49] for key, frame in frames.items()}}
    assert [image.shape for image in policy._preprocess_images(rows)[0]] == 3 * [
        (2, 3, 21, 28)
    ]
    assert torch.equal(chunk(policy, rows), chunk(policy, inside))
    policy.train()  # random crops and colours are of the picture, too
    assert torch.equal(losses(policy, rows), losses(policy, inside))
    stored = {
        key: torch.nn.functional.avg_pool2d(frame, 2)
        for key, frame in inside.items()
        if key in frames
    }
    found, wanted = (
        policy.eval()._preprocess_images({**rows, **x})[0] for x in (frames, stored)
    )
    torch.testing.assert_close(
        found, wanted
    )  # of cached frames, up to their rounding to whole values


def test_a_frame_without_the_bars_of_that_aspect_is_refused():
    policy, rows = tiny_policy(image_resolution=(21, 28)), batch_of(True, False)
    with pytest.raises(
        TaccorlError,
        match=r"images\.front: of 56×56 .*\[21,28\] uses the middle 42×56.*not black",
    ):
        policy.predict_action_chunk(rows)


def test_a_chunk_starts_from_noise_times_its_factor():
    policy, batch = tiny_policy(), batch_of(True, False)
    torch.manual_seed(7)
    noise = policy.model.sample_noise((2, 10, 32), torch.device("cpu"))
    plain, still = (
        chunk(policy, batch),
        policy.predict_action_chunk(batch, noise=torch.zeros_like(noise)),
    )
    half = policy.predict_action_chunk(batch, noise=0.5 * noise)
    policy.config.inference_noise = 0.5
    assert torch.equal(chunk(policy, batch), half) and not torch.equal(half, plain)
    assert torch.equal(policy.predict_action_chunk(batch, noise=noise), plain)
    policy.config.inference_noise = 0.0
    assert torch.equal(chunk(policy, batch, seed=1), still) and torch.equal(
        chunk(policy, batch, seed=2), still
    )
    torch.manual_seed(3)
    assert torch.equal(policy.select_action(batch), still[:, 0])


def test_readings_have_a_scale_for_light_contact_and_one_for_a_grip():
    """At 1/75 a count: 10 counts are log 2 and 0.05; 400 are log 41 and 2; −300 are 0 and −1; 1000 are log 101 and 3."""
    fine, coarse = scales(torch.tensor([10.0, 400.0, -300.0, 1000.0]) / 75, 1 / 75)
    torch.testing.assert_close(
        fine, torch.tensor([math.log(2), math.log(41), 0.0, math.log(101)])
    )
    torch.testing.assert_close(coarse, torch.tensor([0.05, 2.0, -1.0, 3.0]))
    # of a sensor with another gain: the same counts
    for ours, theirs in zip(
        scales(torch.ones(1) / 300, 1 / 300),
        scales(torch.ones(1) / 75, 1 / 75),
        strict=True,
    ):
        torch.testing.assert_close(ours, theirs)


@pytest.mark.parametrize("gain", [1 / 75, None])
@pytest.mark.parametrize(
    "layout", [(4, 32, 12), (2, 16, 16), (1, 1, 1), (3, 5, 2), (1, 15), (2, 1)]
)
def test_pads_of_any_layout_share_their_weights(layout, gain):
    torch.manual_seed(0)
    encoder = TactileEncoder({TACTILE: TouchInput(layout, gain)}, 2, 3, 8)
    pads, readings = (
        encoder.get_submodule("pad" if gain else "observation/tactile"),
        torch.rand(5, 2, *layout),
    )
    described = []
    pads.register_forward_hook(
        lambda module, inputs, out: described.append(out.unflatten(0, (5, layout[0])))
    )
    tokens, turned = (
        encoder(x.flatten(2)) for x in (readings, readings.roll(1, dims=2))
    )
    assert tokens.shape == (5, 3, 8)
    torch.testing.assert_close(described[1], described[0].roll(1, dims=1))
    aged = encoder(
        readings.flip(1).flatten(2)
    )  # the order of the readings matters, and so does that of the pads
    assert not torch.allclose(aged, tokens) and torch.allclose(turned, tokens) == (
        layout[0] == 1
    )


def test_plain_pi05s_weights_are_a_start_and_only_touch_may_be_missing(
    monkeypatch, tmp_path
):
    torch.manual_seed(3)
    plain = plain_pi05(tiny_policy(), monkeypatch)
    # As openpi names and keeps them: without "model.", with a language head.
    weights = {
        k.removeprefix("model."): v.clone() for k, v in plain.state_dict().items()
    }
    embedding = (
        "paligemma_with_expert.paligemma.model.language_model.embed_tokens.weight"
    )
    weights["paligemma_with_expert.paligemma.lm_head.weight"] = weights.pop(embedding)
    weights["paligemma_with_expert.gemma_expert.lm_head.weight"] = torch.zeros(520, 64)
    save_file(weights, tmp_path / "model.safetensors")
    torch.manual_seed(4)
    policy = TactilePI05Policy(tiny_config(image_crop=1.0))
    load_base_weights(policy, str(tmp_path))
    batch = batch_of(False, False)
    assert torch.equal(chunk(policy.eval(), batch), chunk(plain, batch))
    before = {k: v.clone() for k, v in policy.state_dict().items()}
    for name, said in (
        ("time_mlp_in.weight", "1 missing, first model.time_mlp_in.weight"),
        (None, "1 unknown here, first"),
    ):
        broken = {k: v + 1 for k, v in weights.items() if k != name}
        if name is None:
            broken["state_head.weight"] = torch.zeros(1)
        save_file(broken, tmp_path / "model.safetensors")
        with pytest.raises(TaccorlError, match=f"{said}.*Nothing was loaded"):
            load_base_weights(policy, str(tmp_path / "model.safetensors"))
    save_file(
        {**weights, "action_in_proj.weight": torch.zeros(64, 7)},
        tmp_path / "model.safetensors",
    )
    with pytest.raises(
        TaccorlError,
        match=r"1 of another shape, first model.action_in_proj.weight \(64, 7\) there, \(64, 32\)",
    ):
        load_base_weights(policy, str(tmp_path))
    assert all(torch.equal(before[k], v) for k, v in policy.state_dict().items())


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ({"backbone": "tny"}, "--policy.backbone=tny: did you mean 'tiny'"),
        (
            {"base_checkpoint": "lerobot/pi05_base"},
            "--policy.backbone=full, not with tiny",
        ),
        ({"tactile_history": 0}, "--policy.tactile_history=0: at least 1"),
        ({"tactile_stride": 0}, "--policy.tactile_stride=0: at least 1"),
        ({"inference_noise": -0.5}, "--policy.inference_noise=-0.5: 0 or more"),
        ({"touch_dropout": 1.0}, "--policy.touch_dropout=1.0.*--policy.tactile=false"),
        ({"contact_threshold": float("nan")}, "--policy.contact_threshold=nan"),
        (
            {"noise_threshold": 0.5},
            "--policy.noise_threshold=0.5: 0 to --policy.contact_threshold=0.4",
        ),
    ],
)
def test_settings_out_of_range_are_refused(setting, said):
    with pytest.raises(TaccorlError, match=said):
        tiny_config(**setting)


def test_two_steps_stop_resume_are_the_numbers_of_four_steps(tmp_path):
    def train(
        policy: TactilePI05Policy, optimizer: torch.optim.Optimizer, steps: range
    ) -> list[float]:
        losses = []
        policy.train()
        for step in steps:
            loss, _ = policy.forward(batch_of(True, False, seed=step))
            loss.backward()
            optimizer.step()
            optimizer.zero_grad()
            losses.append(loss.item())
        return losses

    torch.manual_seed(0)
    policy = TactilePI05Policy(tiny_config())
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    train(policy, optimizer, range(2))
    policy.save_pretrained(tmp_path)
    kept, generator = copy.deepcopy(optimizer.state_dict()), torch.get_rng_state()
    straight = train(policy, optimizer, range(2, 4))
    resumed = TactilePI05Policy.from_pretrained(tmp_path)
    optimizer = resumed.config.get_optimizer_preset().build(resumed.get_optim_params())
    optimizer.load_state_dict(kept)
    torch.set_rng_state(generator)
    assert train(resumed, optimizer, range(2, 4)) == straight
    assert all(
        torch.equal(resumed.state_dict()[k], v) for k, v in policy.state_dict().items()
    )


def test_the_optimizer_is_lerobots_adamw_and_its_files_are_read_again(tmp_path):
    def stepped(config: AdamWConfig) -> tuple[torch.Tensor, torch.optim.Optimizer]:
        weight = torch.nn.Parameter(torch.linspace(-1, 1, 12))
        optimizer = config.build([weight])
        for scale in (1.0, 0.1, 0.7):
            weight.grad = scale * torch.linspace(-3, 5, 12)
            optimizer.step()
        return weight.detach(), optimizer

    ours = tiny_config().get_optimizer_preset()
    settings = dataclasses.asdict(ours)
    assert (
        draccus.decode(OptimizerConfig, draccus.encode(ours, OptimizerConfig)) == ours
    )
    assert settings == dataclasses.asdict(PI05Config().get_optimizer_preset())
    (weight, optimizer), (theirs, _) = stepped(ours), stepped(AdamWConfig(**settings))
    assert torch.equal(weight, theirs)
    save_optimizer_state(optimizer, tmp_path)
    again = load_optimizer_state(
        ours.build([torch.nn.Parameter(torch.zeros(12))]), tmp_path
    )
    assert again.state_dict()["param_groups"] == optimizer.state_dict()["param_groups"]
    state, stored = again.state_dict()["state"][0], optimizer.state_dict()["state"][0]
    assert state.keys() == stored.keys() and all(
        torch.equal(state[k], v) for k, v in stored.items()
    )


def test_every_backbone_that_can_be_named_has_a_size():
    """The configuration lists them without importing transformers."""
    from taccorl.policies.tactile_pi05.backbone import SIZES
    from taccorl.policies.tactile_pi05.configuration_tactile_pi05 import _BACKBONES

    assert ("full", *SIZES) == _BACKBONES


def test_defaults_are_the_papers_table():
    config = TactilePI05Config(device="cpu")
    assert (config.tactile_history, config.prefix_tokens, config.suffix_tokens) == (
        10,
        8,
        8,
    )
    assert (config.contact_threshold, config.contact_min_active) == (0.4, 1)
    assert (config.chunk_size, config.num_inference_steps, config.sim_weight) == (
        10,
        4,
        0.5,
    )
    assert (
        config.get_optimizer_preset().lr == 2.5e-5
        and config.get_optimizer_preset().type == "fused_adamw"
    )
    optimizer = torch.optim.AdamW([torch.nn.Parameter(torch.zeros(1))], lr=2.5e-5)
    for steps in (1000, 3000):
        scheduler = config.get_scheduler_preset().build(optimizer, steps)
        assert isinstance(config.get_scheduler_preset(), WarmupThenCosine)
        rate = scheduler.lr_lambdas[0]
        assert (
            rate(0) == pytest.approx(1 / 101) and rate(50) < rate(99) < 1
        )  # T_warm = 100, however long the training
        assert rate(100) == pytest.approx(1, abs=0.03) and 2.5e-5 * rate(
            steps
        ) == pytest.approx(5e-6)

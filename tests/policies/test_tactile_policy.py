"""Touch on its way into the policy: windows, formats, processors, weights, and what is said when they do not fit."""

import copy
import dataclasses
import math
from types import SimpleNamespace
from typing import Any

import draccus
import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.optim.optimizers import AdamWConfig, OptimizerConfig, load_optimizer_state, save_optimizer_state
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
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
from taccorl.policies.tactile_pi05.configuration_tactile_pi05 import TactilePI05Config, WarmupThenCosine
from taccorl.policies.tactile_pi05.encoder import StateToken
from taccorl.policies.tactile_pi05.keypoints import KeypointCamera
from taccorl.policies.tactile_pi05.modeling_tactile_pi05 import TactilePI05Policy
from taccorl.policies.tactile_pi05.muon import MuonAdamW, orthogonal
from taccorl.policies.tactile_pi05.processor_tactile_pi05 import TactileReadingStep
from taccorl.policies.tactile_pi05.tokenizer import ByteTokenizer, PromptTokenizerStep, WordTokenizer
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
    known = {"repo_id": "local/demo", "root": "/demo", "fps": 30, "episodes": {"length": [40, 12]}}
    return SimpleNamespace(**{**known, "features": {TACTILE: FEATURE, "observation.state": {}}, **changes})


def test_defaults_are_the_papers_table():
    config = TactilePI05Config(device="cpu")
    assert (config.tactile_history, config.prefix_tokens, config.suffix_tokens) == (10, 8, 8)
    assert (config.contact_threshold, config.contact_min_active) == (0.4, 1)
    assert (config.chunk_size, config.num_inference_steps, config.sim_weight) == (10, 4, 0.5)
    assert config.get_optimizer_preset().lr == 2.5e-5 and config.get_optimizer_preset().type == "fused_adamw"
    optimizer = torch.optim.AdamW([torch.nn.Parameter(torch.zeros(1))], lr=2.5e-5)
    for steps in (1000, 3000):
        scheduler = config.get_scheduler_preset().build(optimizer, steps)
        assert isinstance(config.get_scheduler_preset(), WarmupThenCosine)
        rate = scheduler.lr_lambdas[0]
        assert rate(0) == pytest.approx(1 / 101) and rate(50) < rate(99) < 1  # T_warm = 100, however long the training
        assert rate(100) == pytest.approx(1, abs=0.03) and 2.5e-5 * rate(steps) == pytest.approx(5e-6)


def test_lerobot_finds_the_policy_by_its_name():
    import taccorl.lerobot_plugin  # noqa: F401

    assert PreTrainedConfig.get_choice_class("tactile_pi05") is TactilePI05Config
    assert get_policy_class("tactile_pi05") is TactilePI05Policy


def test_the_window_is_the_last_readings_and_the_first_one_before_there_were_any():
    policy = tiny_policy(tactile_history=4, n_action_steps=1)
    batch, felt = batch_of(True, False), torch.rand(6, 2, 1536)
    for step, reading in enumerate(felt):
        torch.manual_seed(step)
        action = policy.select_action({**batch, TACTILE: reading})
        window = felt[[max(0, step - age) for age in (3, 2, 1, 0)]].transpose(
            0, 1
        )  # as LeRobot fills up a dataset's windows
        assert torch.equal(action, chunk(policy, {**batch, TACTILE: window}, seed=step)[:, 0])
    policy.reset()
    torch.manual_seed(0)
    again = policy.select_action({**batch, TACTILE: felt[5]})
    assert torch.equal(again, chunk(policy, {**batch, TACTILE: felt[5][:, None].expand(-1, 4, -1)}, seed=0)[:, 0])
    with pytest.raises(TaccorlError, match=r"\(1, 1536\) after \(2, 1536\).*reset\(\)"):
        policy.select_action({k: v[:1] for k, v in batch.items()} | {TACTILE: felt[5, :1]})


def test_an_observation_may_bring_its_window_along():
    policy, batch = tiny_policy(n_action_steps=1), batch_of(True, False)
    torch.manual_seed(7)
    assert torch.equal(policy.select_action(batch), chunk(policy, batch)[:, 0])


def test_touch_of_another_shape_or_none_is_refused():
    policy, batch = tiny_policy(), batch_of(True)
    with pytest.raises(TaccorlError, match=r"\(1, 1536\), the policy takes \(batch, 10, 1536\).*TACCORL_NO_PATCH"):
        policy.predict_action_chunk({**batch, TACTILE: readings(True)[:, -1]})
    with pytest.raises(TaccorlError, match=r"\(1, 10, 768\)"):
        policy.forward({**batch, TACTILE: readings(True)[..., :768]})
    del batch[TACTILE]
    with pytest.raises(TaccorlError, match=f"has no {TACTILE}; it has: observation.images.front"):
        policy.forward(batch)


def test_the_format_comes_from_the_dataset_and_stays():
    config = tiny_config(tactile_format=None)
    with pytest.raises(TaccorlError, match="does not know how touch is stored"):
        TactilePI05Policy(config)
    config.match_dataset(metadata())
    assert config.tactile_format == FORMAT and config.fps == 30
    config.match_dataset(metadata(repo_id="local/other"))


@pytest.mark.parametrize(
    ("told", "said"),
    [
        (
            {"features": {"observation.state": {}}},
            "has no observation.tactile, the policy feels: --policy.tactile=false",
        ),
        ({"fps": 50}, "has 50 rows a second, the checkpoint was trained with 30"),
        ({"episodes": {"length": [40, 9]}}, "episode 1 has 9 rows, the window of touch 10"),
        ({"features": {TACTILE: {"shape": (1536,)}}}, "does not say what its"),
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
        ({"layout": [1, 4, 12, 32]}, "rows: 12 there, 32 in the checkpoint; columns: 32 there, 12"),
        ({"scheme": "per_frame_max"}, "scheme: per_frame_max there, fixed_scale in the checkpoint"),
        ({"layout": [1, 4, 32, 16]}, r"has shape \(1536,\), its layout says \[1, 4, 32, 16\]"),
        ({"pads": ["a", "b"]}, "names the pads a, b, its layout says 4"),
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
            for name, value in (("q01", -2.0), ("q99", 2.0), ("mean", 0.0), ("std", 1.0))
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
    torch.testing.assert_close(seen["observation.state"][0], torch.full((14,), 0.5))  # quantiles −2 … 2 → −1 … 1
    assert torch.equal(seen["action_is_pad"], raw["action_is_pad"])
    tokens = seen["observation.language.tokens"][0][seen["observation.language.attention_mask"][0]]
    prompt = f"Task: insert the plug, State: {' '.join(['192'] * 14)};\nAction: "
    assert bytes((tokens[1:] - 2).tolist()).decode() == prompt
    assert seen["observation.language.tokens"].shape == (2, 150)
    # Saved and loaded without being told anything, as lerobot-eval does.
    before.save_pretrained(tmp_path)
    after.save_pretrained(tmp_path)
    loaded, _ = make_pre_post_processors(config, pretrained_path=str(tmp_path))
    again = loaded(dict(raw))
    assert all(torch.equal(again[k], v) for k, v in seen.items() if isinstance(v, torch.Tensor))


def test_relative_actions_of_a_chunk_are_relative_to_the_state_that_it_was_predicted_for(tmp_path):
    names = [f"joint_{k}" for k in range(13)] + ["gripper"]
    config = tiny_config(use_relative_actions=True, action_feature_names=names, n_action_steps=3, tactile=False)
    config.validate_features()
    ones = torch.ones(14)
    action = {"q01": -0.2 * ones, "q99": 0.4 * ones, "mean": 0 * ones, "std": ones}
    stats = {"observation.state": {"q01": -2 * ones, "q99": 2 * ones, "mean": 0 * ones, "std": ones}, "action": action}
    for steps in make_pre_post_processors(config, dataset_stats=stats):
        steps.save_pretrained(tmp_path)
    before, after = make_pre_post_processors(config, pretrained_path=str(tmp_path))
    policy = tiny_policy(use_relative_actions=True, action_feature_names=names, n_action_steps=3, tactile=False)
    seen = {k: v for k, v in batch_of(False, False).items() if "language" not in k and k not in (TACTILE, "action")}
    planned = []
    plan = policy.predict_action_chunk
    policy.predict_action_chunk = lambda batch, **kw: planned.append(plan(batch, **kw)) or planned[-1]
    for k in range(5):
        state = torch.linspace(-0.3, 0.3, 14).expand(2, 14) + 0.05 * k
        told = policy.select_action(before({**seen, "observation.state": state, "task": ["move"] * 2}))
        sent = after(told)
        came_from, step = (0, k) if k < 3 else (3, k - 3)
        change = (planned[-1][:, step] + 1) / 2 * 0.6 - 0.2  # quantiles −0.2 … 0.4
        at_plan = torch.linspace(-0.3, 0.3, 14) + 0.05 * came_from
        at_plan[13] = 0.0  # absolute
        torch.testing.assert_close(sent, change + at_plan, atol=1e-5, rtol=0)
    assert len(planned) == 2


def test_a_prompt_is_never_cut_and_other_tokenizers_are_asked_for_by_name(tmp_path):
    step = PromptTokenizerStep(tokenizer_name="bytes", max_length=12)
    assert step._tokenize_text("ä")["input_ids"].tolist() == [[1, 0xC3 + 2, 0xA4 + 2] + 9 * [0]]
    with pytest.raises(TaccorlError, match="a prompt of 13 tokens, the policy takes 12: 'insert plugs'"):
        step._tokenize_text(["insert plugs"])
    assert len(ByteTokenizer()) == 258
    with pytest.raises(TaccorlError, match=r"tokenizer=.*cannot be loaded.*Without network"):
        PromptTokenizerStep(tokenizer_name=str(tmp_path))
    with pytest.raises(TaccorlError, match="'per_frame_max': only 'fixed_scale'"):
        TactileReadingStep(scheme="per_frame_max")


def test_each_number_of_the_state_is_one_token_and_near_ones_start_out_alike():
    numbers = [*range(-1, 256)]
    tokens = WordTokenizer().tokens(f"Task: Move the TUBE, State: {' '.join(map(str, numbers))};\nAction: ")
    begin, task, colon, move, the, tube, comma, state, also_colon = tokens[:9]
    assert begin == 1 and colon == also_colon
    assert (
        len({task, move, the, tube, comma, state, colon}) == 7
        and min(task, move, the, tube, comma, state, colon) >= 259
    )
    assert tokens[9 : 9 + 257] == [n + 3 for n in numbers]  # 0: filling, 1: the beginning, 2: −1
    assert tokens[4:6] == WordTokenizer().tokens("the tube")[1:]  # capitals are no other word
    assert WordTokenizer().tokens("256 1000")[1:] != WordTokenizer().tokens("255 100")[1:]
    assert all(259 <= token < len(WordTokenizer()) == 515 for token in WordTokenizer().tokens("256 1000")[1:])
    rows = PromptTokenizerStep(tokenizer_name="words", max_length=6)._tokenize_text(["move 7", "turn the tube 12"])
    assert rows["attention_mask"].sum(1).tolist() == [3, 5] and rows["input_ids"][0, 3:].tolist() == [0, 0, 0]
    policy = tiny_policy()
    words = policy.model.paligemma_with_expert.paligemma.model.language_model.embed_tokens.weight.detach()
    numbers_ND = words[2:259] / words[2:259].norm(dim=1, keepdim=True)
    alike = numbers_ND @ numbers_ND.T
    assert alike.diagonal(1).min() > 0.7 > 0.5 > alike.diagonal(30).max()
    assert words[2:259].std() == pytest.approx(words[259:].std().item(), rel=0.1)


@pytest.mark.parametrize("is_discrete", [True, False])
def test_a_state_beside_the_prompt_is_exact_where_one_in_the_prompt_has_256_steps(is_discrete):
    """Over 2 rad a step is 8 mrad, at half a metre 4 mm: more than parts leave each other to be joined."""
    policy = tiny_policy(tactile=False, discrete_state_input=is_discrete, tokenizer_max_length=60)
    stats = {
        k: {"q01": torch.full((14,), -1.0), "q99": torch.full((14,), 1.0)} for k in ("observation.state", "action")
    }
    before, _ = make_pre_post_processors(policy.config, dataset_stats=stats)
    rows = {k: v for k, v in batch_of(False).items() if "language" not in k and k != "action"} | {"task": ["join them"]}
    middle = (torch.arange(14) - 7 + 0.5) / 128  # of steps
    prompts, chunks = [], []
    for state in (middle, middle + 0.003, middle + 0.01):
        seen = before({**rows, "observation.state": state[None]})
        prompts.append(seen["observation.language.tokens"])
        chunks.append(chunk(policy, seen))
    assert torch.equal(prompts[0], prompts[1]) and torch.equal(prompts[0], prompts[2]) is not is_discrete
    assert torch.equal(chunks[0], chunks[1]) is is_discrete
    assert not torch.equal(chunks[0], chunks[2])
    number = WordTokenizer().tokens("130")[1]
    assert (number in prompts[0]) is is_discrete


def test_the_state_is_the_backbones_own_affair_unless_told():
    assert TactilePI05Config(backbone="full").has_discrete_state  # as π0.5 was pretrained
    assert not TactilePI05Config(backbone="small").has_discrete_state
    assert not tiny_config(discrete_state_input=None).has_discrete_state
    assert TactilePI05Config(backbone="small", discrete_state_input=True).has_discrete_state


def test_a_token_of_the_state_is_the_waves_of_each_joint_and_no_joint_is_beyond_its_limit():
    torch.manual_seed(0)
    token, state = StateToken(2, 8), torch.tensor([[0.3, -0.7]])
    waves = [math.pi * 2**k * x for x in (0.3, -0.7) for k in range(5)]  # ½ … 8 turns over the range of −1 … 1
    told = torch.tensor([[0.3, -0.7, *map(math.sin, waves), *map(math.cos, waves)]])
    expected = token.out(torch.nn.functional.gelu(token.hidden(told)))
    torch.testing.assert_close(token(state), expected[:, None])
    assert token(state).shape == (1, 1, 8)
    # LeRobot's normaliser makes 2e8 of the noise of a joint that stood still in all of the data.
    assert torch.equal(token(torch.tensor([[0.3, 2e8]])), token(torch.tensor([[0.3, 4.0]])))


def test_a_key_point_is_where_its_map_is_high():
    camera = KeypointCamera(2, 3, 8)
    assert camera.maps(torch.rand(1, 3, 112, 112)).shape == (1, 2, 28, 28)
    camera.maps = torch.nn.Conv2d(3, 2, 1)  # the first map: red; the second: blue
    torch.nn.init.zeros_(camera.maps.bias)
    with torch.no_grad():
        camera.maps.weight.copy_(40 * torch.tensor([[1.0, 0, 0], [0, 0, 1]])[:, :, None, None])
    image = torch.zeros(2, 3, 5, 9)
    image[0, 0, 1, 6] = 1  # of 9 columns −1 … 1 the seventh: 0.5; of 5 rows the second: −0.5
    image[0, 2, 4, 0] = 1
    image[1, 0, 0, [2, 8]] = 1  # two alike: between them, at column 5, 0.25
    points = camera.points(image)  # x of red and blue, y of red and blue; blue of the second is nowhere, so the middle
    torch.testing.assert_close(points, torch.tensor([[0.5, -1.0, -0.5, 1.0], [0.25, 0.0, -1.0, 0.0]]))

    # A softmax that is not all in one place: of 9 columns one weighs e^(3 · 0.5 · 2) = e³, the rest 1 each.
    torch.nn.init.constant_(camera.sharpness, 0.5)
    with torch.no_grad():
        camera.maps.weight *= 2 / 40
    soft = torch.zeros(1, 3, 1, 9)
    soft[0, 0, 0, 8] = 1
    weight = math.exp(3) / (math.exp(3) + 8)
    places = [-1 + column / 4 for column in range(9)]
    assert camera.points(soft)[0, 0].item() == pytest.approx(weight + (1 - weight) * sum(places[:8]) / 8, rel=1e-5)
    torch.nn.init.ones_(camera.sharpness)
    with torch.no_grad():
        camera.maps.weight *= 40 / 2

    waves = [math.pi * 2**k * p for p in (0.5, -1.0, -0.5, 1.0) for k in range(3)]
    told = torch.tensor([[0.5, -1.0, -0.5, 1.0, *map(math.sin, waves), *map(math.cos, waves)]])
    expected = camera.out(torch.nn.functional.gelu(camera.hidden(told)))
    torch.testing.assert_close(camera(image[:1]), expected.view(1, 3, 8))


def test_each_camera_has_key_points_of_its_own_and_none_may_be_missing():
    policy, batch = tiny_policy(), batch_of(True, True)
    front, left = "observation.images.front", "observation.images.left_wrist"
    tower: Any = policy.model.paligemma_with_expert.paligemma.model.vision_tower
    images = [batch[k] for k in policy.config.image_features]
    for camera, image, tokens in zip(tower.cameras, images, tower(images), strict=True):
        assert tokens.shape == (2, 4, 96) and torch.equal(tokens, camera(image))
    assert not torch.equal(chunk(policy, {**batch, front: batch[left], left: batch[front]}), chunk(policy, batch))
    del batch[left]
    for use in (chunk, losses):
        with pytest.raises(
            TaccorlError, match=r"backbone=tiny has weights for each camera.* no observation.images.left_wrist; "
        ):
            use(policy, batch)
    # LeRobot's own cameras that are never there
    more, batch = tiny_policy(empty_cameras=1), batch_of(True, True)
    seen = chunk(more, batch)
    torch.nn.init.ones_(more.model.paligemma_with_expert.paligemma.model.vision_tower.cameras[3].out.bias)
    assert torch.equal(chunk(more, batch), seen)


def test_a_tiny_that_saw_with_patches_is_told_apart(tmp_path):
    with sees_with("patches"):
        tiny_policy().save_pretrained(tmp_path)
    with pytest.raises(
        TaccorlError, match=r"it saw with patches, before tiny had key points: train anew\. Nothing was loaded"
    ):
        TactilePI05Policy.from_pretrained(tmp_path)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"backbone": "tiny", "image_resolution": (56, 84)}, "tiny takes squares, such as"),
        (
            {"backbone": "small", "image_resolution": (56, 56)},
            "small takes squares of a multiple of 16 pixels, such as",
        ),
    ],
)
def test_pictures_of_a_size_that_it_does_not_take_are_refused(changes, said):
    with pytest.raises(TaccorlError, match=said):
        TactilePI05Policy(tiny_config(**changes))


def test_plain_pi05s_weights_are_a_start_and_only_touch_may_be_missing(monkeypatch, tmp_path):
    torch.manual_seed(3)
    plain = plain_pi05(tiny_policy(), monkeypatch)
    # As openpi names and keeps them: without "model.", with a language head.
    weights = {k.removeprefix("model."): v.clone() for k, v in plain.state_dict().items()}
    embedding = "paligemma_with_expert.paligemma.model.language_model.embed_tokens.weight"
    weights["paligemma_with_expert.paligemma.lm_head.weight"] = weights.pop(embedding)
    weights["paligemma_with_expert.gemma_expert.lm_head.weight"] = torch.zeros(520, 64)
    save_file(weights, tmp_path / "model.safetensors")
    torch.manual_seed(4)
    policy = TactilePI05Policy(tiny_config())
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
    save_file({**weights, "action_in_proj.weight": torch.zeros(64, 7)}, tmp_path / "model.safetensors")
    with pytest.raises(
        TaccorlError, match=r"1 of another shape, first model.action_in_proj.weight \(64, 7\) there, \(64, 32\)"
    ):
        load_base_weights(policy, str(tmp_path))
    assert all(torch.equal(before[k], v) for k, v in policy.state_dict().items())


def test_a_checkpoint_that_cannot_be_read_is_never_a_random_policy(tmp_path):
    policy = tiny_policy()
    policy.save_pretrained(tmp_path)
    (tmp_path / "model.safetensors").unlink()
    with pytest.raises(TaccorlError, match=r"no weights to read.*model\.safetensors"):
        TactilePI05Policy.from_pretrained(tmp_path)
    (tmp_path / "model.safetensors").write_bytes(b"cut off")
    with pytest.raises(TaccorlError, match="no weights to read"):
        TactilePI05Policy.from_pretrained(tmp_path)
    with pytest.raises(TaccorlError, match=f"--policy.base_checkpoint={tmp_path}: no weights to read"):
        load_base_weights(policy, str(tmp_path))


def test_regression_predicts_one_chunk_and_its_loss_is_that_chunks_error():
    policy, batch = tiny_policy(objective="regression"), batch_of(True, False, True)
    predicted = chunk(policy, batch, seed=1)
    assert torch.equal(predicted, chunk(policy, batch, seed=2))  # no draw
    # … and one step, out of zeros, whatever the caller says
    assert torch.equal(predicted, policy.predict_action_chunk(batch, num_steps=7, noise=torch.ones(3, 10, 32)))
    errors, scale = batch["action"] - predicted, 0.02
    wanted = ((errors**2 + scale**2).sqrt() - scale).mean(dim=(1, 2))
    torch.testing.assert_close(losses(policy, batch, seed=3), wanted, rtol=1e-5, atol=1e-6)
    # Far off it is the absolute error less the scale, near by the square over twice the scale; at 0 its gradient is finite.
    near, far = predicted + 1e-4, predicted + 3.0
    assert losses(policy, {**batch, "action": far}).tolist() == pytest.approx([2.98] * 3, rel=1e-3)
    assert losses(policy, {**batch, "action": near}).tolist() == pytest.approx([1e-8 / 0.04] * 3, rel=0.05)
    policy.forward({**batch, "action": predicted})[0].backward()
    gradients = [p.grad for p in policy.model.action_out_proj.parameters()]
    assert all(gradient is not None and torch.isfinite(gradient).all() for gradient in gradients)


def test_a_regressed_chunk_in_real_time_begins_where_the_last_one_goes_on():
    policy, batch = tiny_policy(objective="regression"), batch_of(True, False)
    free = chunk(policy, batch)
    policy.config.rtc_config = RTCConfig(execution_horizon=8)  # as LeRobot's rollout does it, with its weight of 10
    policy.init_rtc_processor()
    assert policy.config.rtc_config.max_guidance_weight == 10
    led = policy.predict_action_chunk(batch, prev_chunk_left_over=free + 0.1, inference_delay=2)
    share = ((led - free) / 0.1).mean(dim=(0, 2))
    # LINEAR: what is on its way is kept; then the last chunk weighs 6/7, 5/7, …; behind the horizon not at all.
    wanted = [1, 1, *(k / 7 for k in range(6, 0, -1)), 0, 0]
    assert share.tolist() == pytest.approx(wanted, abs=1e-3)


@pytest.mark.slow
def test_regression_is_learnt_in_a_few_steps_and_kept_in_a_checkpoint(tmp_path):
    policy = tiny_policy(objective="regression", image_randomization=False, image_noise_std=0.0)
    batch, optimizer = batch_of(True, False), torch.optim.AdamW(policy.parameters(), lr=3e-3)
    first = losses(policy, batch).mean()
    for _ in range(80):
        policy.train().forward(batch)[0].backward()
        optimizer.step()
        optimizer.zero_grad()
    policy.eval()
    assert losses(policy, batch).mean() < 0.2 * first
    assert (chunk(policy, batch) - batch["action"]).abs().mean() < 0.2 * batch["action"].abs().mean()
    policy.save_pretrained(tmp_path)
    again = TactilePI05Policy.from_pretrained(tmp_path)
    assert again.config.is_regression and torch.equal(chunk(again, batch), chunk(policy, batch))


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ({"backbone": "tny"}, "--policy.backbone=tny: did you mean 'tiny'"),
        ({"objective": "regresion"}, "--policy.objective=regresion: did you mean 'regression'"),
        ({"base_checkpoint": "lerobot/pi05_base"}, "fit --policy.backbone=full only, not tiny"),
        ({"tactile_history": 0}, "--policy.tactile_history=0: at least 1"),
        ({"contact_threshold": float("nan")}, "--policy.contact_threshold=nan"),
    ],
)
def test_settings_out_of_range_are_refused(setting, said):
    with pytest.raises(TaccorlError, match=said):
        tiny_config(**setting)


@pytest.mark.parametrize("optimizer_muon", [False, True])
def test_two_steps_stop_resume_are_the_numbers_of_four_steps(optimizer_muon, tmp_path):
    def train(policy: TactilePI05Policy, optimizer: torch.optim.Optimizer, steps: range) -> list[float]:
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
    policy = TactilePI05Policy(tiny_config(optimizer_muon=optimizer_muon))
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
    assert all(torch.equal(resumed.state_dict()[k], v) for k, v in policy.state_dict().items())


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
    assert draccus.decode(OptimizerConfig, draccus.encode(ours, OptimizerConfig)) == ours
    assert settings == dataclasses.asdict(PI05Config().get_optimizer_preset())
    (weight, optimizer), (theirs, _) = stepped(ours), stepped(AdamWConfig(**settings))
    assert torch.equal(weight, theirs)
    save_optimizer_state(optimizer, tmp_path)
    again = load_optimizer_state(ours.build([torch.nn.Parameter(torch.zeros(12))]), tmp_path)
    assert again.state_dict()["param_groups"] == optimizer.state_dict()["param_groups"]
    state, stored = again.state_dict()["state"][0], optimizer.state_dict()["state"][0]
    assert state.keys() == stored.keys() and all(torch.equal(state[k], v) for k, v in stored.items())


def test_muon_moves_matrices_as_torchs_does_and_adamw_moves_the_rest(tmp_path):
    """Theirs computes in bfloat16, with 8 bits: directions differ by less than 1 in 64 of a step."""
    torch.manual_seed(0)
    shapes = ((24, 8), (8, 24), (8, 24), (16, 16))
    ours, theirs = ([torch.nn.Parameter(x.clone()) for x in start] for start in 2 * [[torch.randn(s) for s in shapes]])
    bias, their_bias = (torch.nn.Parameter(torch.linspace(-1, 1, 8)) for _ in range(2))
    idle = torch.nn.Parameter(torch.ones(3, 3))  # never has a gradient
    kind = {"lr": 1e-2, "weight_decay": 0.1}
    groups = [{"params": [bias]}, {"params": [*ours, idle], "by_muon": True}]
    optimizer = dataclasses.replace(tiny_config().get_optimizer_preset(), **kind).build(groups)
    assert isinstance(optimizer, MuonAdamW)
    muon = torch.optim.Muon(theirs, adjust_lr_fn="match_rms_adamw", **kind)
    adamw = dataclasses.replace(tiny_config().get_optimizer_preset(), **kind).build([their_bias])
    for _ in range(3):
        for p, q in zip([*ours, bias], [*theirs, their_bias], strict=True):
            p.grad = torch.randn(p.shape)
            q.grad = p.grad.clone()
        before = [p.detach().clone() for p in ours]
        for each in (optimizer, muon, adamw):
            each.step()
        assert all(torch.equal(p.grad, q.grad) for p, q in zip(ours, theirs, strict=True))
    for p, q, old in zip(ours, theirs, before, strict=True):
        assert (p - q).norm() < (p - old).norm() / 20
        step = (p - old * (1 - 1e-2 * 0.1)) / (1e-2 * 0.2 * math.sqrt(max(p.shape)))
        values = torch.linalg.svdvals(step.detach())
        assert values.min() > 0.6 and values.max() < 1.25  # nearly orthogonal, whatever the gradient's size
    assert torch.equal(bias, their_bias) and torch.equal(idle, torch.ones(3, 3))

    save_optimizer_state(optimizer, tmp_path)
    empty = [torch.nn.Parameter(torch.zeros_like(p)) for p in (bias, *ours, idle)]
    fresh = [{"params": empty[:1]}, {"params": empty[1:], "by_muon": True}]
    again = load_optimizer_state(tiny_config().get_optimizer_preset().build(fresh), tmp_path)
    stored, kept = again.state_dict(), optimizer.state_dict()
    assert stored["param_groups"] == kept["param_groups"] and stored["state"].keys() == kept["state"].keys()
    for i, state in kept["state"].items():
        assert all(torch.equal(stored["state"][i][k], v) for k, v in state.items())


def test_muon_takes_a_closure_and_leaves_bfloat16_weights_where_decay_takes_them():
    weight = torch.nn.Parameter(torch.ones(4, 4, dtype=torch.bfloat16))
    optimizer = MuonAdamW([{"params": [weight], "by_muon": True}], lr=0.5, weight_decay=0.01)

    def closure() -> float:
        weight.grad = torch.zeros_like(weight)
        return 3.5

    for _ in range(2):
        assert optimizer.step(closure) == 3.5
    # 1 − 0.5 · 0.01 = 0.995, in bfloat16 0.996; of that 0.991, in bfloat16 0.992
    assert weight.tolist() == 4 * [4 * [0.9921875]]


def test_muon_leaves_out_a_step_whose_gradients_overflowed():
    weight, bias = torch.nn.Parameter(torch.ones(3, 3)), torch.nn.Parameter(torch.ones(3))
    optimizer = MuonAdamW([{"params": [bias]}, {"params": [weight], "by_muon": True}], lr=0.1, fused=True)
    scaler = torch.amp.GradScaler("cpu")
    for factor, moves in ((math.inf, False), (1.0, True)):
        scaler.scale(factor * ((weight * torch.arange(9.0).view(3, 3)).sum() + bias.sum())).backward()
        scaler.step(optimizer)
        scaler.update()
        optimizer.zero_grad()
        for p in (weight, bias):
            assert p.isfinite().all() and torch.equal(p, torch.ones_like(p)) is not moves


def test_directions_of_muon_are_the_nearest_orthogonal_matrices():
    torch.manual_seed(0)
    for shape in ((3, 6, 20), (3, 20, 6)):
        matrices = torch.randn(shape)
        left, _, right = torch.linalg.svd(matrices, full_matrices=False)
        nearest, found = left @ right, orthogonal(1e-3 * matrices)  # of any size
        assert found.shape == shape
        # same singular vectors: what differs from the nearest one is along them only
        along = left.mT @ found @ right.mT
        off = along - torch.diag_embed(along.diagonal(dim1=1, dim2=2))
        assert off.abs().max() < 1e-3 and (found - nearest).abs().max() < 0.35


@pytest.mark.parametrize("vision", ["keypoints", "patches"])
def test_with_muon_hidden_matrices_are_a_group_and_everything_is_in_one(vision):
    with sees_with(vision):
        policy = tiny_policy(optimizer_muon=True)
    rest, hidden = policy.get_optim_params()
    names = {p: name for name, p in policy.named_parameters()}
    assert hidden["by_muon"] and "by_muon" not in rest
    assert sorted(names[p] for p in rest["params"] + hidden["params"]) == sorted(names.values())
    told = {names[p].split("layers.")[1] for p in hidden["params"]}
    parts = ("self_attn.q_proj", "self_attn.k_proj", "self_attn.v_proj", "self_attn.o_proj")
    parts += ("mlp.gate_proj", "mlp.up_proj", "mlp.down_proj")
    assert told == {f"{layer}.{part}.weight" for layer in range(3) for part in parts}
    assert len(hidden["params"]) == 2 * 3 * 7  # of the language model and of the expert
    policy.config.optimizer_muon = False
    assert len(list(policy.get_optim_params())) == len(names)


def test_every_backbone_that_can_be_named_has_a_size():
    """The configuration lists them without importing transformers."""
    from taccorl.policies.tactile_pi05.backbone import SIZES
    from taccorl.policies.tactile_pi05.configuration_tactile_pi05 import _BACKBONES

    assert ("full", *SIZES) == _BACKBONES

"""What must be exactly so: no contact is plain pi05, the cached prefix is the joint forward, a checkpoint is the policy."""

from collections.abc import Iterator
from functools import partial

import pytest
import torch
from lerobot.policies.common.vla_utils import (
    make_att_2d_masks,
    prepare_attention_masks_4d,
)
from tiny_policies import (
    PROMPT_TOKENS,
    TACTILE,
    batch_of,
    chunk,
    losses,
    plain_pi05,
    readings,
    sees_with,
    tiny_policy,
)

from taccorl.policies.tactile_pi05.gate import contact
from taccorl.policies.tactile_pi05.graphed import KeptConstants
from taccorl.policies.tactile_pi05.modeling_tactile_pi05 import TactilePI05Policy


@pytest.fixture(
    scope="module",
    params=["cameras", pytest.param("patches", marks=pytest.mark.slow)],
    autouse=True,
)
def vision(request) -> Iterator[str]:
    with sees_with(request.param):
        yield request.param


@pytest.fixture(scope="module")
def policy(vision) -> TactilePI05Policy:
    return tiny_policy(image_crop=1.0)  # LeRobot's pi05 sees whole pictures


@pytest.mark.parametrize("touched", [(False, False, False), (True, False, True, False)])
@pytest.mark.parametrize("prompt_tokens", [PROMPT_TOKENS, 157, 200])
def test_rows_without_contact_are_lerobots_pi05_bit_by_bit(
    policy, monkeypatch, prompt_tokens, touched
):
    plain, batch = (
        plain_pi05(policy, monkeypatch),
        batch_of(*touched, prompt_tokens=prompt_tokens),
    )
    for ours, theirs in (
        (chunk(policy, batch), chunk(plain, batch)),
        (losses(policy, batch), losses(plain, batch)),
    ):
        same = [
            torch.equal(one, other) for one, other in zip(ours, theirs, strict=True)
        ]
        assert same == [not touch for touch in touched]
    if not any(touched):
        assert torch.equal(losses(policy, batch, "mean"), losses(plain, batch, "mean"))


def test_tokens_without_contact_are_removed_not_zeroed(policy):
    """Their content cannot matter, no position is counted for them, and nothing looks at them."""
    batch = batch_of(True, False)
    other = {
        **batch,
        TACTILE: torch.cat([batch[TACTILE][:1], readings(True, False, seed=2)[1:]]),
    }
    assert not torch.equal(batch[TACTILE][1], other[TACTILE][1])
    assert torch.equal(chunk(policy, batch)[1], chunk(policy, other)[1])
    images, image_masks = policy._preprocess_images(batch)
    prompt = (
        batch["observation.language.tokens"],
        batch["observation.language.attention_mask"],
    )
    with policy.model.sensing(None, *policy._readings(batch)):
        _, valid, _ = policy.model.embed_prefix(images, image_masks, *prompt)
        _, suffix_valid, starts_block, _ = policy.model.embed_suffix(
            torch.zeros(2, 10, 32), torch.ones(2)
        )
    assert valid[:, -8:].tolist() == [[True] * 8, [False] * 8] and suffix_valid.sum(
        1
    ).tolist() == [18, 10]
    # Touch is a block, actions are one: the context looks at neither, touch not at actions.
    assert starts_block[0].tolist() == [1.0] + 7 * [0.0] + [1.0] + 9 * [0.0]


@pytest.mark.parametrize("is_discrete", [True, False])
def test_velocity_over_the_cached_prefix_is_that_of_the_joint_forward(is_discrete):
    policy = tiny_policy(discrete_state_input=is_discrete)
    batch, noise, time = (
        batch_of(True, False, True),
        torch.randn(3, 10, 32),
        torch.tensor([1.0, 0.75, 0.25]),
    )
    model = policy.model
    images, image_masks = policy._preprocess_images(batch)
    prompt = (
        batch["observation.language.tokens"],
        batch["observation.language.attention_mask"],
    )
    actions = torch.nn.functional.pad(batch["action"], (0, 18))
    x_t = time[:, None, None] * noise + (1 - time[:, None, None]) * actions
    seen = {}
    handle = model.action_out_proj.register_forward_hook(
        lambda *call: seen.update(joint=call[2])
    )
    with torch.no_grad(), model.sensing(policy._state(batch), *policy._readings(batch)):
        model(images, image_masks, *prompt, actions, noise, time)
        prefix, valid, starts_block = model.embed_prefix(images, image_masks, *prompt)
        model.paligemma_with_expert.paligemma.model.language_model.config._attn_implementation = "eager"
        _, cache = model.paligemma_with_expert(
            attention_mask=prepare_attention_masks_4d(
                make_att_2d_masks(valid, starts_block)
            ),
            position_ids=torch.cumsum(valid, dim=1) - 1,
            inputs_embeds=[prefix, None],
            use_cache=True,
        )
        joint = seen["joint"]
        cached = model.denoise_step(valid, cache, x_t, time)
    handle.remove()
    assert (cached - joint).abs().max() <= 1e-5


def test_the_policy_starts_as_the_pretrained_one_does_with_tokens_beside_it(policy):
    """The cross-attention's output is zero at first: the context is unchanged even in contact, only tokens join it."""
    torch.manual_seed(0)
    fresh, batch = TactilePI05Policy(policy.config), batch_of(True, True)
    images, image_masks = fresh._preprocess_images(batch)
    prompt = (
        batch["observation.language.tokens"],
        batch["observation.language.attention_mask"],
    )
    base, _, _ = fresh.model.embed_prefix(images, image_masks, *prompt)
    with fresh.model.sensing(None, *fresh._readings(batch)):
        felt, valid, _ = fresh.model.embed_prefix(images, image_masks, *prompt)
    assert torch.equal(felt[:, :-8], base) and valid[:, -8:].all()
    # and it can leave zero: the gradient at the output's weights is not
    fresh.forward(batch)[0].backward()
    assert fresh.model.tactile.into_context.out.weight.grad.abs().max() > 0
    assert fresh.model.tactile.encoder.pad[0].weight.grad.abs().max() > 0


def test_with_a_token_of_the_state_a_row_is_the_same_beside_any_other():
    policy, batch = (
        tiny_policy(discrete_state_input=False),
        batch_of(True, False, True, False),
    )
    blind = tiny_policy(discrete_state_input=False, tactile=False)
    blind.load_state_dict(
        {
            k: v
            for k, v in policy.state_dict().items()
            if not k.startswith("model.tactile.")
        }
    )
    assert torch.equal(chunk(policy, batch)[[1, 3]], chunk(blind, batch)[[1, 3]])
    assert torch.equal(losses(policy, batch)[[1, 3]], losses(blind, batch)[[1, 3]])
    other = {
        **batch,
        "observation.state": batch["observation.state"]
        + torch.tensor([[0], [0], [0.1], [0.1]]),
    }
    same = [
        torch.equal(a, b)
        for a, b in zip(chunk(policy, batch), chunk(policy, other), strict=True)
    ]
    assert same == [True, True, False, False]


@pytest.mark.parametrize("is_discrete", [True, False])
def test_saved_and_loaded_it_acts_the_same(is_discrete, tmp_path):
    policy = tiny_policy(discrete_state_input=is_discrete)
    batch = batch_of(True, False)
    policy.save_pretrained(tmp_path)
    loaded = TactilePI05Policy.from_pretrained(tmp_path)
    assert not loaded.training and loaded.config == policy.config
    assert torch.equal(chunk(loaded, batch), chunk(policy, batch))


def test_vision_only_is_lerobots_pi05(monkeypatch):
    blind, batch = tiny_policy(tactile=False, image_crop=1.0), batch_of(True, False)
    assert not any("tactile" in name for name in blind.state_dict())
    plain = plain_pi05(blind, monkeypatch)
    assert torch.equal(chunk(blind, batch), chunk(plain, batch))
    assert torch.equal(losses(blind, batch), losses(plain, batch))


def test_touch_that_training_hides_is_no_touch_and_is_never_hidden_in_use():
    policy = tiny_policy(discrete_state_input=False, touch_dropout=0.25)
    plain, blind = (
        tiny_policy(discrete_state_input=False, **x) for x in ({}, {"tactile": False})
    )
    plain.load_state_dict(policy.state_dict())
    blind.load_state_dict(
        {
            k: v
            for k, v in policy.state_dict().items()
            if not k.startswith("model.tactile.")
        }
    )
    batch = batch_of(True, True, True, True, False)
    # The sum over a longer sequence rounds otherwise, by how memory is aligned: up to 5e-7 seen of losses of 2 to 3. Touch
    # itself changes a loss by 1e-4 to 2e-2.
    same = partial(torch.isclose, rtol=0, atol=5e-6)
    hidden = 0
    for seed in range(16):
        ours, felt, unfelt = (
            losses(p.train(), batch, seed=seed) for p in (policy, plain, blind)
        )
        assert (same(ours, felt) | same(ours, unfelt)).all()
        assert same(felt, unfelt).tolist() == [False] * 4 + [True]
        hidden += int((~same(ours, felt)).sum())
    assert (
        6 <= hidden <= 26
    )  # of 64 rows in contact a quarter, 16; binomial deviation 3.5, here three of them
    # of the data, not of what is left of it
    assert policy.train().forward(batch)[1]["contact_rate"] == pytest.approx(0.8)
    assert torch.equal(chunk(policy, batch), chunk(plain, batch))
    assert torch.equal(losses(policy.eval(), batch), losses(plain.eval(), batch))


def test_gate_is_the_papers_equation():
    # two taxels above 0.4, but never in the same reading: open for m = 1, closed for m = 2
    felt = torch.zeros(4, 10, 1536)
    felt[0, 2, 5], felt[0, 7, 9] = 0.41, -0.41
    felt[1, 9, 0] = 0.4  # not above
    felt[2, 0, [3, 4]] = 3.0
    assert contact(felt, 0.4, 1).tolist() == [True, False, True, False]
    assert contact(felt, 0.4, 2).tolist() == [False, False, True, False]


def test_readings_up_to_the_noise_are_nothing():
    """λ_noise = 0.1: a row whose other readings are at most that acts as if they were 0; those above stay."""
    deaf, hears = tiny_policy(noise_threshold=0.1), tiny_policy()
    deaf.load_state_dict(hears.state_dict())
    batch = batch_of(True, True)
    quiet, loud = (batch["observation.tactile"].clone() for _ in range(2))
    quiet[quiet.abs() <= 0.4] = 0.0
    loud[loud.abs() <= 0.4] = 0.1
    noisy, silent = (
        {**batch, "observation.tactile": loud},
        {**batch, "observation.tactile": quiet},
    )
    assert torch.equal(chunk(deaf, noisy), chunk(hears, silent)) and torch.equal(
        chunk(deaf, silent), chunk(hears, silent)
    )
    assert not torch.equal(chunk(hears, noisy), chunk(hears, silent))


def test_kept_constants_change_nothing_and_are_made_once(policy):
    """What a CUDA graph needs of LeRobot's code; the graph itself needs a GPU (make bench ONLY=full_size)."""
    batch, constants = batch_of(True, False), KeptConstants()
    plain = chunk(policy, batch)
    with constants:
        assert torch.equal(chunk(policy, batch), plain)
        made = len(constants._kept)
        assert (
            made
            and torch.equal(chunk(policy, batch), plain)
            and len(constants._kept) == made
        )


def test_masked_tokens_weigh_nothing(policy):
    """As a graph has them, also where there is no contact: off by rounding, since sums are longer."""
    batch = batch_of(False, False)
    images, image_masks = policy._preprocess_images(batch)
    prompt = (
        batch["observation.language.tokens"],
        batch["observation.language.attention_mask"],
    )
    noise = torch.randn(2, 10, 32)
    plain = policy.model.sample_actions(images, image_masks, *prompt, noise=noise)
    with policy.model.sensing(None, *policy._readings(batch), masked=True):
        masked = policy.model.sample_actions(images, image_masks, *prompt, noise=noise)
    assert (masked - plain).abs().max() <= 1e-5

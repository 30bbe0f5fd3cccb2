"""Flow-SDE on tactile_pi05 (tiny): the policy's own sampling, equal ratios, gates, frozen parts, and the real anchor."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import pytest
import torch
from tiny_dataset import write_tiny
from tiny_policies import FORMAT, batch_of, tiny_policy

from taccorl.errors import TaccorlError
from taccorl.rl.critic import Critic
from taccorl.rl.flow_policy import TactileFlowPolicy
from taccorl.rl.flow_sde import FlowSDE
from taccorl.rl.ppo import PPO, Decisions
from taccorl.rl.settings import FlowSDESettings, PolicySettings, PPOSettings

TOUCHED = (True, False, True, False)


def actor(trained: str = "all", **changes: Any) -> TactileFlowPolicy:
    as_in_datasets = dataclasses.replace(FORMAT, gain_per_count=0.0133333333)
    policy = tiny_policy(tactile_format=as_in_datasets, **changes)
    return TactileFlowPolicy(policy, PolicySettings(trained=trained), num_steps=4)


def observed(*touched: bool) -> dict[str, torch.Tensor]:
    return {key: x for key, x in batch_of(*touched).items() if key != "action"}


def sde(level: float = 0.5, steps: str = "one") -> FlowSDE:
    return FlowSDE(FlowSDESettings(level=level, stochastic_steps=steps))


def draws(sampler: FlowSDE, policy: TactileFlowPolicy, n: int, seed: int = 0) -> Any:
    return sampler.draw(
        n, tuple(policy.scored_HD.shape), torch.Generator().manual_seed(seed)
    )  # pyright: ignore


@pytest.mark.parametrize("touched", [(True, True), (False, False), TOUCHED])
@pytest.mark.parametrize("relative", [False, True])
def test_level_zero_is_the_policys_own_sampling_bit_for_bit(
    touched: tuple[bool, ...], relative: bool
) -> None:
    policy = actor(use_relative_actions=relative, discrete_state_input=None)
    if relative:
        torch.nn.init.uniform_(policy.policy.steps.std_HA, 0.5, 2.0)  # pyright: ignore
    batch, quiet = observed(*touched), sde(0.0)
    given = draws(quiet, policy, len(touched))
    sampled, _ = policy.sample(batch, quiet, given)
    expected = policy.policy.predict_action_chunk(batch, noise=given.initial_BHD)
    assert torch.equal(policy.actions(sampled.chunk_BHD), expected[:, :5])


@pytest.mark.parametrize("steps", ["one", "all"])
def test_ratio_is_one_in_another_order_and_batch_size(steps: str) -> None:
    policy, sampler, batch = actor(), sde(0.5, steps), observed(*TOUCHED)
    given = draws(sampler, policy, 4)
    sampled, _ = policy.sample(batch, sampler, given)
    order = torch.tensor([2, 0, 3, 1])
    for rows in order.split(3):
        own = {key: x[rows] for key, x in batch.items()}
        with torch.no_grad():
            again = policy.log_prob(
                own,
                sampler,
                sampled.before_BSHD[rows],
                sampled.after_BSHD[rows],
                given.step_BS[rows],
            )
        torch.testing.assert_close(
            (again - sampled.log_prob_B[rows]).exp(),
            torch.ones(len(rows)),
            atol=1e-4,
            rtol=0,
        )


def test_only_executed_actions_are_scored() -> None:
    policy, sampler, batch = actor(), sde(), observed(*TOUCHED)
    assert policy.scored_HD.shape == (10, 32) and int(policy.scored_HD.sum()) == 5 * 14
    given = draws(sampler, policy, 4)
    sampled, _ = policy.sample(batch, sampler, given)
    elsewhere = sampled.after_BSHD + 10.0 * ~policy.scored_HD
    again = policy.log_prob(
        batch, sampler, sampled.before_BSHD, elsewhere, given.step_BS
    )
    torch.testing.assert_close(again, sampled.log_prob_B, atol=1e-3, rtol=0)


def test_touch_without_contact_changes_neither_probability_nor_value() -> None:
    policy, sampler, batch = actor(), sde(), observed(False, False)
    given = draws(sampler, policy, 2)
    first, features = policy.sample(batch, sampler, given)
    other = {**batch, "observation.tactile": -batch["observation.tactile"]}
    again, same = policy.sample(other, sampler, given)
    assert torch.equal(first.chunk_BHD, again.chunk_BHD) and torch.equal(
        first.log_prob_B, again.log_prob_B
    )
    assert torch.equal(features, same)
    pressed, felt = policy.sample(observed(True, True), sampler, given)
    assert not torch.equal(pressed.chunk_BHD, first.chunk_BHD) and not torch.equal(
        felt, features
    )


def test_features_are_the_mean_of_valid_tokens() -> None:
    """Longer padding of the prompt changes no feature; the state is beside them where the prompt does not have it."""
    policy, batch = actor(), observed(True, False)
    padded = dict(batch)
    for key in ("observation.language.tokens", "observation.language.attention_mask"):
        padded[key] = torch.nn.functional.pad(batch[key], (0, 8))
    torch.testing.assert_close(
        policy.features(batch), policy.features(padded), atol=1e-5, rtol=1e-4
    )
    assert policy.features(batch).shape == (2, policy.num_features) == (2, 96)
    other = actor(discrete_state_input=None)
    beside = other.features(batch)
    assert beside.shape[1] == other.num_features and torch.equal(
        beside[:, 96:], batch["observation.state"]
    )


def test_frozen_parts_have_no_gradient_and_stay() -> None:
    policy, sampler, batch = actor("expert"), sde(), observed(*TOUCHED)
    frozen = {
        n: p.detach().clone()
        for n, p in policy.policy.named_parameters()
        if "paligemma.model" in n
    }
    learner = PPO(
        policy, Critic(96), sampler, PPOSettings(actor_lr=1e-3, kl_stop=math.inf)
    )
    given = draws(sampler, policy, 4)
    sampled, features = policy.sample(batch, sampler, given)
    decisions = Decisions(
        batch, sampled.before_BSHD, sampled.after_BSHD, given.step_BS, sampled.log_prob_B, features,
        torch.zeros(4, 0), torch.tensor([1.0, -1.0, 2.0, 0.0]), torch.zeros(4),
    )  # fmt: skip
    before = [p.detach().clone() for p in policy.trained_parameters()]
    learner.update(decisions, torch.Generator())
    now = dict(policy.policy.named_parameters())
    assert frozen and all(
        torch.equal(value, now[name]) and now[name].grad is None
        for name, value in frozen.items()
    )
    assert (
        sum(
            not torch.equal(a, b)
            for a, b in zip(before, policy.trained_parameters(), strict=True)
        )
        > 10
    )


def test_pictures_in_bytes_are_those_in_float() -> None:
    policy, sampler = actor(), sde()
    batch = observed(True, False)
    bytes_ = {
        k: (x * 255).to(torch.uint8) if "images" in k else x for k, x in batch.items()
    }
    floats = {
        k: x.to(torch.float32) / 255 if x.dtype == torch.uint8 else x
        for k, x in bytes_.items()
    }
    given = draws(sampler, policy, 2)
    assert torch.equal(
        policy.sample(bytes_, sampler, given)[0].chunk_BHD,
        policy.sample(floats, sampler, given)[0].chunk_BHD,
    )


def test_an_exponential_mean_of_weights_is_what_goes_on() -> None:
    plain = tiny_policy(average_decay=0.9)
    plain.train()
    with torch.no_grad():
        plain.model.action_out_proj.bias.add_(1.0)
    acting = plain.eval().model.action_out_proj.bias.detach().clone()
    policy = TactileFlowPolicy(plain, PolicySettings(), num_steps=4)
    policy.policy.train()
    policy.policy.eval()
    assert (
        torch.equal(policy.model.action_out_proj.bias, acting)
        and policy.policy.config.average_decay == 0
    )


def anchor(policy: TactileFlowPolicy, root: Path, **changes: Any) -> Any:
    from lerobot.policies.factory import make_pre_post_processors

    import taccorl.lerobot_plugin  # noqa: F401
    from taccorl.rl.anchor import RealAnchor
    from taccorl.rl.settings import AnchorSettings

    ends = {"q01": torch.full((14,), -3.0), "q99": torch.full((14,), 3.0)}
    statistics = {"action": ends, "observation.state": ends}
    before, _ = make_pre_post_processors(policy.policy.config, dataset_stats=statistics)
    return RealAnchor(AnchorSettings(dataset=root, **changes), policy.policy, before)


def anchor_gradient(
    policy: TactileFlowPolicy, root: Path, **changes: Any
) -> torch.Tensor:
    given = anchor(policy, root, **changes)
    policy.policy.zero_grad()
    torch.manual_seed(4)
    given.backward(torch.Generator().manual_seed(0), 16)
    assert not policy.policy.training
    return torch.cat(
        [p.grad.flatten() for p in policy.trained_parameters() if p.grad is not None]
    )


def test_real_anchor_is_linear_in_beta(real: Path) -> None:
    policy = actor(
        image_randomization=False, image_noise_std=0.0, discrete_state_input=None
    )
    one, three = (
        anchor_gradient(policy, real, weight=w, batch_size=4) for w in (1.0, 3.0)
    )
    assert one.norm() > 1e-3
    torch.testing.assert_close(three, 3 * one, atol=1e-6, rtol=1e-4)


def test_real_anchor_is_a_step_of_co_training(real: Path) -> None:
    """The same rows, noise, random changes of the images and rows without touch through the policy's own loss."""
    from torch.utils.data import default_collate

    policy = actor(discrete_state_input=None, touch_dropout=0.5)
    assert policy.policy._change_images is not None
    given = anchor(policy, real, batch_size=4)
    found = anchor_gradient(policy, real, batch_size=4)
    rows = given._draw(4, torch.Generator().manual_seed(0))
    batch = default_collate([given._dataset[int(row)] for row in rows])
    batch = {
        k: x.float() / 255
        if isinstance(x, torch.Tensor) and x.dtype == torch.uint8
        else x
        for k, x in batch.items()
    }
    policy.policy.zero_grad()
    torch.manual_seed(4)
    policy.policy.train()
    policy.policy.forward(given._preprocessor(batch))[0].backward()
    policy.policy.eval()
    expected = torch.cat(
        [p.grad.flatten() for p in policy.trained_parameters() if p.grad is not None]
    )
    assert torch.equal(found, expected)


def test_touch_is_hidden_by_the_anchor_alone(real: Path) -> None:
    """With ``touch_dropout`` 0.5 chunks and probabilities are those of a policy that never hides touch. While the actor does not
    move, every ratio stays 1, also in minibatches that come after steps of the anchor, in which touch was hidden."""
    steady = {
        "discrete_state_input": None,
        "image_randomization": False,
        "image_noise_std": 0.0,
    }
    policy, never = actor(touch_dropout=0.5, **steady), actor(**steady)
    never.policy.load_state_dict(policy.policy.state_dict())
    sampler, batch = sde(), observed(*6 * [True])
    given = draws(sampler, policy, 6)
    sampled, features = policy.sample(batch, sampler, given)
    for ours, theirs in zip(
        sampled, never.sample(batch, sampler, given)[0], strict=True
    ):
        assert torch.equal(ours, theirs)
    decisions = Decisions(
        batch, sampled.before_BSHD, sampled.after_BSHD, given.step_BS, sampled.log_prob_B, features,
        torch.zeros(6, 0), torch.tensor([1.0, -1.0, 2.0, 0.0, 1.0, -3.0]), torch.zeros(6),
    )  # fmt: skip
    settings = PPOSettings(actor_lr=0.0, batch_size=3, epochs=2)
    learner = PPO(
        policy,
        Critic(policy.num_features),
        sampler,
        settings,
        anchor(policy, real, batch_size=4),
    )
    facts = learner.update(decisions, torch.Generator().manual_seed(0))
    assert facts["actor_steps"] == 4 and facts["first_ratio_error"] < 1e-5
    assert (
        abs(facts["kl"]) < 1e-9
        and facts["clip_fraction"] == 0
        and abs(facts["last_kl"]) < 1e-9
    )
    hidden, felt = (anchor_gradient(one, real, batch_size=8) for one in (policy, never))
    assert (hidden - felt).norm() > 1e-3 * felt.norm()


def test_drift_is_of_the_same_rows_and_noise_and_changes_no_random_number(
    real: Path,
) -> None:
    """It depends on the weights alone: not on β, nor on what was drawn before."""
    policy = actor(discrete_state_input=None)
    torch.manual_seed(1)
    given, state = anchor(policy, real, batch_size=3), torch.get_rng_state()
    first = given.drift()
    assert torch.equal(torch.get_rng_state(), state) and not policy.policy.training
    given.backward(torch.Generator().manual_seed(0), 16)
    assert (
        given.drift() == first == anchor(policy, real, batch_size=3, weight=0.0).drift()
    )
    with torch.no_grad():
        policy.model.action_out_proj.bias.add_(0.1)
    assert given.drift() != first


def test_only_real_rows_of_a_merged_dataset_are_used(tmp_path: Path) -> None:
    root = write_tiny(tmp_path / "both", rows=(20, 12), sim_episodes=1, cameras=3)
    given = anchor(actor(discrete_state_input=None), root)
    assert given.rows.tolist() == list(range(20, 32))


def test_anchor_data_that_do_not_fit_are_named(tmp_path: Path) -> None:
    policy = actor(discrete_state_input=None)
    with pytest.raises(TaccorlError, match=r"--anchor\.dataset=.*no LeRobot dataset"):
        anchor(policy, tmp_path)
    with pytest.raises(TaccorlError, match=r"has no observation\.images\.left_wrist"):
        anchor(policy, write_tiny(tmp_path / "one_camera"))


@pytest.mark.slow
def test_simulated_demonstrations_are_no_anchor(collected: Path) -> None:
    policy = actor(discrete_state_input=None)
    policy.policy.config.input_features = {
        k: f
        for k, f in policy.policy.config.input_features.items()
        if "images" not in k  # pyright: ignore
    }
    with pytest.raises(TaccorlError, match=r"--anchor\.allow_simulated=true"):
        anchor(policy, collected)

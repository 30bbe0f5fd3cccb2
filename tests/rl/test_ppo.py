"""PPO on the smallest policy and world: what one update may and may not do, and that many of them learn."""

import dataclasses
import math

import pytest
import torch
from reaching import DemoAnchor, LinePolicy, LineWorld, imitated

from taccorl.errors import TaccorlError
from taccorl.rl.advantages import estimate_advantages, explained_variance, normalise
from taccorl.rl.critic import Critic
from taccorl.rl.flow_sde import FlowSDE
from taccorl.rl.ppo import PPO, Decisions, policy_loss
from taccorl.rl.rollout import SUCCESS, collect, first_episodes
from taccorl.rl.settings import FlowSDESettings, PPOSettings

SETTINGS = PPOSettings(actor_lr=3e-4, critic_lr=1e-3, batch_size=64)


def ppo(
    policy: LinePolicy,
    settings: PPOSettings = SETTINGS,
    beta: float | None = None,
    steps: str = "one",
) -> PPO:
    torch.manual_seed(1)
    sde = FlowSDE(FlowSDESettings(stochastic_steps=steps))
    return PPO(
        policy,
        Critic(64, hidden=(64, 64)),
        sde,
        settings,
        None if beta is None else DemoAnchor(policy, beta),
    )


def rollout(
    learner: PPO, num_envs: int = 16, decisions: int = 12, seed: int = 0
) -> Decisions:
    generator = torch.Generator().manual_seed(seed)
    return collect(LineWorld(num_envs, seed), learner, decisions, generator).decisions


def weights(policy: LinePolicy) -> torch.Tensor:
    return torch.cat([p.detach().flatten() for p in policy.trained_parameters()])


def gradient(beta: float | None, micro_batch: int = 128) -> torch.Tensor:
    """Of one optimiser step, before clipping."""
    settings = PPOSettings(
        batch_size=192, micro_batch=micro_batch, max_grad_norm=math.inf
    )
    learner = ppo(LinePolicy(), settings, beta)
    found = rollout(learner)
    advantage = torch.randn(len(found), generator=torch.Generator().manual_seed(5))
    found = dataclasses.replace(found, advantage_M=advantage)
    learner._actor_gradient(found, torch.Generator().manual_seed(6), True)
    return torch.cat(
        [
            p.grad.flatten()
            for p in learner.actor.trained_parameters()
            if p.grad is not None
        ]
    )


def test_clipped_loss_by_hand() -> None:
    """Ratios 1.5, 0.5, 1.5, 0.5 with advantages 1, 1, −1, −1 and ε = 0.2: min(1.5, 1.2), min(0.5, 0.8), min(−1.5, −1.2),
    min(−0.5, −0.8): mean of 1.2, 0.5, −1.5, −0.8 is −0.15; the loss is its negative."""
    log_ratio = torch.tensor([1.5, 0.5, 1.5, 0.5]).log()
    log_ratio.requires_grad_()
    loss = policy_loss(log_ratio, torch.tensor([1.0, 1.0, -1.0, -1.0]), 0.2)
    assert loss.item() == pytest.approx(0.15)
    loss.backward()
    assert log_ratio.grad is not None  # none where it is clipped
    assert log_ratio.grad.tolist() == pytest.approx(
        [0.0, -0.125, 0.375, 0.0]
    )  # −ratio · A / 4, where not clipped


@pytest.mark.parametrize("steps", ["one", "all"])
def test_first_ratio_is_one(steps: str) -> None:
    learner = ppo(LinePolicy(), steps=steps)
    facts = learner.update(rollout(learner), torch.Generator())
    assert facts["first_ratio_error"] < 1e-5


def test_another_policy_than_the_one_that_acted_is_refused() -> None:
    learner = ppo(LinePolicy())
    found = rollout(learner)
    with torch.no_grad():
        learner.actor.trained_parameters()[0].add_(0.05)
    with pytest.raises(TaccorlError, match=r"ratio of probabilities differs from 1"):
        learner.update(found, torch.Generator())


def test_gradient_is_linear_in_beta_and_the_same_in_any_micro_batches() -> None:
    without, g0, g1, g2 = gradient(None), gradient(0.0), gradient(1.0), gradient(2.0)
    torch.testing.assert_close(g0, without)
    assert (g1 - g0).norm() > 0.1 * g0.norm()  # a dead anchor: 0
    torch.testing.assert_close(g2 - g0, 2 * (g1 - g0), atol=1e-6, rtol=1e-4)
    torch.testing.assert_close(
        gradient(1.0, 192), gradient(1.0, 50), atol=1e-6, rtol=1e-4
    )


def test_critic_and_actor_do_not_reach_each_other() -> None:
    learner = ppo(LinePolicy())
    found = rollout(learner)
    learner._critic_step(found, torch.arange(32))
    assert all(p.grad is None for p in learner.actor.trained_parameters())
    learner.critic_optimizer.zero_grad()
    learner._actor_gradient(found, torch.Generator(), True)
    assert all(p.grad is None for p in learner.critic.parameters())
    assert all(
        p.grad is not None and p.grad.abs().sum() > 0
        for p in learner.actor.trained_parameters()
    )
    features = torch.zeros(3, 64, requires_grad=True)
    learner.critic(features, torch.zeros(3, 0)).sum().backward()
    assert features.grad is None


def test_a_large_critic_gradient_leaves_the_actors_step() -> None:
    """Norms are clipped separately."""
    moved = []
    for scale in (1.0, 1e4):
        learner = ppo(LinePolicy())
        found = rollout(learner)
        found = Decisions(**{**vars(found), "return_M": scale * found.return_M})
        learner.update(found, torch.Generator().manual_seed(2))
        moved.append(weights(learner.actor))  # pyright: ignore
    assert torch.equal(*moved)


def test_advantages_are_normalised_over_the_rollout() -> None:
    """Another unit and another zero of rewards give the same update."""
    moved = []
    for scale, shift in ((1.0, 0.0), (10.0, 7.0)):
        learner = ppo(LinePolicy())
        found = rollout(learner)
        found = Decisions(
            **{**vars(found), "advantage_M": scale * found.advantage_M + shift}
        )
        learner.update(found, torch.Generator().manual_seed(2))
        moved.append(weights(learner.actor))  # pyright: ignore
    torch.testing.assert_close(*moved, atol=2e-5, rtol=0)
    assert (moved[0] - weights(LinePolicy())).abs().max() > 5e-4


def test_learning_rate_zero_moves_nothing() -> None:
    settings = PPOSettings(actor_lr=0.0, critic_lr=1e-3, batch_size=64, epochs=2)
    learner = ppo(LinePolicy(), settings)
    before = weights(learner.actor)  # pyright: ignore
    facts = learner.update(rollout(learner), torch.Generator())
    assert torch.equal(before, weights(learner.actor))  # pyright: ignore
    assert (
        abs(facts["kl"]) < 1e-9
        and facts["clip_fraction"] == 0
        and facts["actor_steps"] == 6
    )


def test_every_decision_is_used_once_in_an_epoch() -> None:
    learner = ppo(LinePolicy(), PPOSettings(batch_size=50))
    parts = learner._minibatches(192, torch.Generator())
    assert [len(p) for p in parts] == [50, 50, 50, 42] and sorted(
        torch.cat(list(parts)).tolist()
    ) == list(range(192))
    assert (
        len(ppo(LinePolicy(), PPOSettings())._minibatches(128 * 36, torch.Generator()))
        == 9
    )  # the paper's numbers


def test_the_anchor_has_its_rows_in_every_step() -> None:
    learner = ppo(LinePolicy(), PPOSettings(batch_size=64, micro_batch=10), beta=1.0)
    learner.update(rollout(learner), torch.Generator())
    assert learner.anchor.rows_seen == [32, 32, 32]  # pyright: ignore


def test_warm_up_trains_the_critic_only() -> None:
    learner = ppo(LinePolicy(), PPOSettings(batch_size=64, critic_warmup=1))
    before = weights(learner.actor)  # pyright: ignore
    facts = learner.update(rollout(learner), torch.Generator())
    assert torch.equal(before, weights(learner.actor)) and facts["actor_steps"] == 0  # pyright: ignore
    learner.update(rollout(learner), torch.Generator())
    assert not torch.equal(before, weights(learner.actor))  # pyright: ignore


def test_gradients_that_are_not_finite_are_skipped_and_counted() -> None:
    learner = ppo(LinePolicy(), PPOSettings(batch_size=192))
    found = rollout(learner)
    found.advantage_M[0] = torch.nan
    before = weights(learner.actor)  # pyright: ignore
    facts = learner.update(found, torch.Generator())
    assert facts["skipped_steps"] == 1 and facts["actor_steps"] == 0
    assert torch.equal(before, weights(learner.actor))  # pyright: ignore


def test_updates_stop_when_the_policy_has_moved_too_far() -> None:
    learner = ppo(
        LinePolicy(), PPOSettings(actor_lr=0.05, batch_size=16, epochs=5, kl_stop=0.02)
    )
    facts = learner.update(rollout(learner), torch.Generator())
    assert facts["kl_stopped"] == 1 and 1 <= facts["actor_steps"] < 60


@pytest.mark.parametrize("batch_size", [64, 192])
def test_a_step_that_goes_too_far_is_undone(batch_size: int) -> None:
    """The first of three steps, which the next minibatch sees, and the only one, which is measured after it."""
    learner = ppo(
        LinePolicy(), PPOSettings(actor_lr=0.05, batch_size=batch_size, adapt_lr=True)
    )
    before, state = (
        weights(learner.actor),
        learner.state_dict()["actor_optimizer"]["state"],
    )  # pyright: ignore
    facts = learner.update(rollout(learner), torch.Generator())
    assert torch.equal(before, weights(learner.actor)) and not state  # pyright: ignore
    assert not learner.actor_optimizer.state  # moments are those of before, too
    assert facts["undone_steps"] == facts["actor_steps"] == facts["kl_stopped"] == 1
    assert (
        facts["actor_lr"] == 0.05
        and learner.actor_lr == 0.025
        and facts["last_kl"] < 1e-9
    )


def test_what_is_undone_does_not_depend_on_micro_batches() -> None:
    """A step near the limit: measured on all of the first minibatch, however few decisions are in memory at once."""
    found = rollout(ppo(LinePolicy()))
    kept: dict[int, tuple[float, float]] = {}
    for micro_batch in (192, 64, 4):
        settings = PPOSettings(
            actor_lr=8e-3, batch_size=192, micro_batch=micro_batch, kl_stop=0.05
        )
        learner = ppo(LinePolicy(), settings)
        facts = learner.update(found, torch.Generator().manual_seed(2))
        kept[micro_batch] = facts["undone_steps"], facts["last_kl"]
    assert len({undone for undone, _ in kept.values()}) == 1
    assert [kl for _, kl in kept.values()] == pytest.approx(
        [kept[192][1]] * 3, rel=1e-4
    )


def test_only_the_last_step_is_undone() -> None:
    """The same order and one step less, with a limit that is never reached, gives the same policy."""
    found = rollout(ppo(LinePolicy()))
    learner = ppo(
        LinePolicy(),
        PPOSettings(actor_lr=2e-3, batch_size=16, adapt_lr=True, kl_stop=0.01),
    )
    facts = learner.update(found, torch.Generator().manual_seed(2))
    kept = int(facts["actor_steps"]) - 1
    assert facts["undone_steps"] == 1 and 0 < kept < 11 and 0 < facts["last_kl"] <= 0.01
    assert learner.actor_lr == pytest.approx(0.7 * 2e-3)
    other = ppo(
        LinePolicy(), PPOSettings(actor_lr=2e-3, batch_size=16, kl_stop=math.inf)
    )
    order = other._minibatches  # the critic has one epoch of its own
    calls = []

    def minibatches(num: int, generator: torch.Generator) -> list[torch.Tensor]:
        calls.append(num)
        return list(order(num, generator))[: kept if len(calls) == 2 else None]

    other._minibatches = minibatches  # pyright: ignore
    other.update(found, torch.Generator().manual_seed(2))
    assert torch.equal(weights(learner.actor), weights(other.actor))  # pyright: ignore
    ours, theirs = (x.actor_optimizer.state_dict()["state"] for x in (learner, other))
    assert all(
        torch.equal(ours[k][name], theirs[k][name])
        for k in theirs
        for name in theirs[k]
    )


def test_the_learning_rate_grows_while_steps_are_small_up_to_ten_times() -> None:
    learner, generator = (
        ppo(LinePolicy(), PPOSettings(actor_lr=1e-7, batch_size=192, adapt_lr=True)),
        torch.Generator(),
    )
    found = rollout(learner)
    rates = [learner.update(found, generator)["actor_lr"] for _ in range(15)]
    assert rates[:3] == pytest.approx([1e-7, 1.2e-7, 1.44e-7]) and rates[
        -1
    ] == pytest.approx(1e-6)
    learner = ppo(
        LinePolicy(), PPOSettings(actor_lr=1e-7, critic_warmup=9, adapt_lr=True)
    )
    assert learner.update(found, generator)["actor_lr"] == learner.actor_lr == 1e-7
    fixed = ppo(LinePolicy(), PPOSettings(actor_lr=1e-7))
    fixed.update(found, generator)
    assert fixed.actor_lr == 1e-7  # the paper's


def test_value_of_the_last_observation_counts_where_time_ran_out() -> None:
    """A critic that always says 7: V' = 7 after a time limit, 0 after success, so R = r + γ V' at λ = 0."""
    learner = ppo(imitated(steps=50), PPOSettings(gae_lambda=0.0))
    torch.nn.init.zeros_(learner.critic.head[-1].weight)  # pyright: ignore
    torch.nn.init.constant_(learner.critic.head[-1].bias, 7.0)  # pyright: ignore
    world = LineWorld(32)
    found = collect(world, learner, 20, torch.Generator().manual_seed(0))
    assert (
        found.facts["outcomes"][SUCCESS] > 0 and found.facts["outcomes"]["timeout"] > 0
    )
    returns = found.decisions.return_M
    wins = (returns - 1.0).abs() < 1e-5
    assert int(wins.sum()) == found.facts["outcomes"][SUCCESS]
    torch.testing.assert_close(
        returns[~wins], torch.full((int((~wins).sum()),), 0.99 * 7)
    )


def test_waiting_costs_only_gamma_unless_a_time_out_counts_as_a_failure() -> None:
    """Three hands 10 from the goal, of which 8 decisions (LIMIT) make 3.2 at most, so that time runs out. A critic that always
    says 0.6, γ = 0.9, λ = 1: the return of decision t = 0 … 7 is 0.9^(8 − t) · 0.6 with bootstrap, so that one decision more of
    waiting loses 10 % (advantage 0.54 − 0.6 = −0.06 at the end); without it is 0, and the advantage −0.6 in every decision."""
    expected = {
        True: torch.tensor([0.6 * 0.9 ** (8 - t) for t in range(8)]),
        False: torch.zeros(8),
    }
    for bootstrap, returns_T in expected.items():
        learner = ppo(
            LinePolicy(),
            PPOSettings(gamma=0.9, gae_lambda=1.0, bootstrap_time_limit=bootstrap),
        )
        torch.nn.init.zeros_(learner.critic.head[-1].weight)  # pyright: ignore
        torch.nn.init.constant_(learner.critic.head[-1].bias, 0.6)  # pyright: ignore
        world = LineWorld(3)
        world.distance[:] = 10.0
        found = collect(world, learner, 8, torch.Generator().manual_seed(0))
        assert found.facts["outcomes"] == {"timeout": 3}
        torch.testing.assert_close(
            found.decisions.return_M.reshape(8, 3), returns_T[:, None].expand(8, 3)
        )
        advantage_TN = found.decisions.advantage_M.reshape(8, 3)
        torch.testing.assert_close(advantage_TN, returns_T[:, None].expand(8, 3) - 0.6)


def test_float32_weights_keep_a_small_learning_rate() -> None:
    """At the paper's 5e-6 nearly all weights move in a few steps; in bfloat16 most would not."""
    learner = ppo(LinePolicy(), PPOSettings(batch_size=16))
    before = weights(learner.actor)  # pyright: ignore
    learner.update(rollout(learner), torch.Generator())
    assert (before != weights(learner.actor)).float().mean() > 0.99  # pyright: ignore


def test_running_normalisation_of_privileged_numbers() -> None:
    x = torch.randn(100, 3) * torch.tensor([1.0, 5.0, 0.1]) + torch.tensor(
        [0.0, 3.0, -2.0]
    )
    critic = Critic(2, 3)
    for part in x.split(17):
        critic.observe(part)
    torch.testing.assert_close(critic.mean_P, x.mean(0), atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(
        critic.square_P / 100, x.var(0, correction=0), atol=1e-4, rtol=1e-4
    )


def train(iterations: int, beta: float | None = None) -> tuple[float, float, float]:
    """Success without noise before and after, and the flow loss on the demonstrations after."""
    policy = imitated()
    learner = ppo(
        policy,
        PPOSettings(actor_lr=5e-4, critic_lr=1e-3, batch_size=512, critic_warmup=2),
        beta,
    )
    quiet = FlowSDE(FlowSDESettings(level=0.0))

    def success() -> float:
        found = first_episodes(
            LineWorld(512, seed=99), policy, quiet, torch.Generator().manual_seed(0), 10
        )
        return found.count(SUCCESS) / 512

    before, world, generator = (
        success(),
        LineWorld(128),
        torch.Generator().manual_seed(0),
    )
    for _ in range(iterations):
        found = collect(world, learner, 16, generator)
        learner.update(found.decisions, generator)
    return before, success(), DemoAnchor(policy, 1.0).drift(2000)


def test_ppo_learns_to_reach() -> None:
    before, after, _ = train(8)
    assert before < 0.3 and after > 0.8


@pytest.mark.slow
def test_the_anchor_holds_the_policy_to_the_demonstrations() -> None:
    """Flow loss on the demonstrations after 120 updates: the larger β, the smaller; success stays."""
    found = [train(120, beta) for beta in (None, 0.1, 1.0)]
    assert all(before < 0.3 and after > 0.8 for before, after, _ in found)
    free, loose, held = (drift for _, _, drift in found)
    assert held < loose < 0.5 * free


# ---- advantages ----


def test_three_decisions_by_hand() -> None:
    """γ = 0.5, λ = 0.5; the second ends the episode by its time limit, with V = 8 for the last observation.
    δ = 0 + 0.5·4 − 2 = 0; 1 + 0.5·8 − 4 = 1; 0 + 0.5·6 − 1 = 2. A = 0 + 0.25·1 = 0.25; 1; 2. R = A + V = 2.25; 5; 3."""
    column = {
        "reward_TN": [0.0, 1.0, 0.0],
        "value_TN": [2.0, 4.0, 1.0],
        "next_value_TN": [4.0, 8.0, 6.0],
        "end_TN": [False, True, False],
    }
    given = {name: torch.tensor(x)[:, None] for name, x in column.items()}
    advantage, returns = estimate_advantages(**given, gamma=0.5, gae_lambda=0.5)
    assert advantage[:, 0].tolist() == [0.25, 1.0, 2.0] and returns[:, 0].tolist() == [
        2.25,
        5.0,
        3.0,
    ]


def test_normalised_advantages_and_explained_variance() -> None:
    found = normalise(torch.tensor([1.0, 2.0, 3.0, 6.0]))  # mean 3, deviation √3.5
    assert found.tolist() == pytest.approx(
        [(x - 3) / (3.5**0.5 + 1e-5) for x in (1, 2, 3, 6)]
    )
    returns = torch.tensor([0.0, 1.0, 0.0, 1.0])
    assert explained_variance(returns + 5, returns) == pytest.approx(
        1.0
    )  # an offset is not variance
    assert explained_variance(torch.zeros(4), returns) == pytest.approx(0.0)

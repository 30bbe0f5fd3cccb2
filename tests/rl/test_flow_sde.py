"""Flow-SDE against arithmetic by hand, exact Gaussian propagation, LeRobot's integrator, and identities of probabilities."""

import math

import pytest
import torch
from lerobot.policies.common.flow_matching import euler_integrate

from taccorl.errors import TaccorlError
from taccorl.rl.flow_sde import Draws, FlowSDE
from taccorl.rl.settings import FlowSDESettings

H, D = 4, 3
ALL = torch.ones(H, D, dtype=torch.bool)


def sde(
    num_steps: int = 4, level: float = 0.5, steps: str = "one", correlation: float = 0.0
) -> FlowSDE:
    return FlowSDE(
        FlowSDESettings(
            num_steps=num_steps,
            level=level,
            stochastic_steps=steps,
            correlation=correlation,
        )
    )


def smooth(x: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
    """A velocity field without meaning that mixes all numbers of a chunk."""
    mixed = (
        x.flatten(1)
        @ torch.linspace(-1, 1, H * D * H * D, dtype=x.dtype).reshape(H * D, H * D)
        / (H * D)
    )
    return torch.tanh(mixed).reshape(x.shape) + t[:, None, None].to(x.dtype)


def to_gaussian(mean: float, std: float):
    """The exact field that carries N(0, 1) at t = 1 to N(mean, std²) at t = 0."""

    def velocity(x: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
        t = t[:, None, None].to(x.dtype)
        spread = (1 - t) ** 2 * std**2 + t**2
        off = x - (1 - t) * mean
        return t / spread * off - (
            mean + (1 - t) * std**2 / spread * off
        )  # E[ε | x] − E[a | x]

    return velocity


def draws(sampler: FlowSDE, n: int, seed: int = 0) -> Draws:
    return sampler.draw(n, (H, D), torch.Generator().manual_seed(seed))


def propagated(
    mean: float, std: float, steps: int, level: float
) -> tuple[float, float]:
    """Mean and deviation at t = 0 when all steps are stochastic: every step is affine, so both follow exactly."""
    sampler, velocity = sde(steps, level, "all"), to_gaussian(mean, std)
    points = torch.tensor([0.0, 1.0], dtype=torch.float64).reshape(2, 1, 1)
    m, var = 0.0, 1.0
    yes = torch.ones(2, 1, 1, dtype=torch.bool)
    for k, t in enumerate(sampler.times):
        at = torch.full((2,), k)
        (b,), (ab,) = sampler.mean(
            points, velocity(points, torch.full((2,), t)), at, yes
        )[0][:, 0].tolist()
        m, var = (ab - b) * m + b, (ab - b) ** 2 * var + sampler.stds[k] ** 2
    return m, math.sqrt(var)


def test_published_schedule() -> None:
    """level · √(d t / (1 − t)): 0.5·√(¼·1/¼), 0.5·√(¼·¾/¼), 0.5·√(¼·½/½), 0.5·√(¼·¼/¾)."""
    assert sde().stds == pytest.approx(
        [0.5, 0.5 * math.sqrt(0.75), 0.25, 0.5 * math.sqrt(1 / 12)]
    )
    assert sde().stds[0] == sde(10).stds[0] == 0.5 == sde(1).stds[0]


def test_one_transition_by_hand() -> None:
    """K = 4, k = 1 (t = 0.75), x = 2, v = 3: Euler 2 − 3/4 = 1.25; ε̂ = 2 + 0.25·3 = 2.75; s² = 0.1875;
    1.25 − 0.1875/1.5 · 2.75 = 0.90625. Density at 1: z = 0.09375/0.4330."""
    x, v = torch.full((1, H, D), 2.0), torch.full((1, H, D), 3.0)
    k = torch.tensor([1])
    mean, std = sde().mean(x, v, k, ALL[None])
    assert mean.unique().tolist() == pytest.approx(
        [0.90625]
    ) and std.item() == pytest.approx(math.sqrt(0.1875))
    z = (1 - 0.90625) / math.sqrt(0.1875)
    by_hand = (
        H
        * D
        * (-0.5 * z**2 - math.log(math.sqrt(0.1875)) - 0.5 * math.log(2 * math.pi))
    )
    found = sde().log_prob(
        lambda x, t: v, x[:, None], torch.ones(1, 1, H, D), k[:, None], ALL
    )
    assert found.item() == pytest.approx(by_hand, rel=1e-6)


@pytest.mark.parametrize("steps", ["one", "all"])
def test_level_zero_is_lerobots_integrator_bit_for_bit(steps: str) -> None:
    for num_steps in (1, 3, 4, 10):
        sampler = sde(num_steps, 0.0, steps)
        given = draws(sampler, 5)
        sampled = sampler.sample(smooth, given, ALL)
        assert torch.equal(
            sampled.chunk_BHD, euler_integrate(smooth, given.initial_BHD, num_steps)
        )
        assert torch.equal(sampled.log_prob_B, torch.zeros(5))


@pytest.mark.parametrize("level", [0.1, 0.5])
def test_marginals_converge_to_the_data_at_first_order(level: float) -> None:
    error = [abs(propagated(0.7, 0.2, n, level)[1] - 0.2) for n in (64, 128, 256)]
    assert error[1] / error[0] == pytest.approx(0.5, abs=0.15) and error[2] / error[
        1
    ] == pytest.approx(0.5, abs=0.2)
    assert propagated(0.7, 0.2, 4, level)[0] == pytest.approx(0.7, abs=1e-9)


@pytest.mark.parametrize("correlation", [0.0, 0.9])
@pytest.mark.parametrize("steps", ["one", "all", "last"])
def test_scoring_gives_the_log_probability_of_sampling(
    steps: str, correlation: float
) -> None:
    sampler = sde(4, 0.5, steps, correlation)
    given = draws(sampler, 64)
    sampled = sampler.sample(smooth, given, ALL)
    order = torch.randperm(64, generator=torch.Generator().manual_seed(3))
    for rows in order.split(7):  # another order and another batch size
        again = sampler.log_prob(
            smooth,
            sampled.before_BSHD[rows],
            sampled.after_BSHD[rows],
            given.step_BS[rows],
            ALL,
        )
        torch.testing.assert_close(
            (again - sampled.log_prob_B[rows]).exp(),
            torch.ones(len(rows)),
            atol=1e-5,
            rtol=0,
        )


def test_steps_are_drawn_per_sample_and_evenly() -> None:
    counts = draws(sde(), 4000).step_BS.flatten().bincount(minlength=4)
    assert (counts - 1000).abs().max() < 4 * math.sqrt(4000 * 0.25 * 0.75)
    assert draws(sde(steps="all"), 5).step_BS.tolist() == [[0, 1, 2, 3]] * 5
    assert draws(sde(steps="last"), 5).step_BS.tolist() == [[3]] * 5
    assert draws(sde(level=0.0, steps="last"), 5).step_BS.tolist() == [[-1]] * 5


def test_only_scored_numbers_get_noise_and_are_counted() -> None:
    scored = torch.zeros(H, D, dtype=torch.bool)
    scored[:2, :2] = True
    sampler = sde()
    given = draws(sampler, 200)
    last = given._replace(
        step_BS=torch.full((200, 1), 3)
    )  # so that no later step mixes the numbers
    sampled = sampler.sample(smooth, last, scored)
    euler = euler_integrate(smooth, given.initial_BHD, 4)
    assert torch.equal(sampled.chunk_BHD[:, ~scored], euler[:, ~scored])
    assert (sampled.chunk_BHD[:, scored] != euler[:, scored]).all()
    z = last.noise_BSHD[:, 0][:, scored]
    by_hand = (-0.5 * z**2).sum(1) - 4 * (
        math.log(sampler.stds[3]) + 0.5 * math.log(2 * math.pi)
    )
    torch.testing.assert_close(sampled.log_prob_B, by_hand, atol=1e-4, rtol=0)


def test_correlated_noise_has_the_stated_covariance_and_density() -> None:
    """Three of four steps are scored: s² ((1 − ρ) I + ρ 1 1ᵀ) with s = 0.144, ρ = 0.8, in each scored dimension."""
    scored = torch.zeros(H, D, dtype=torch.bool)
    scored[:3, :2] = True
    sampler = sde(steps="last", correlation=0.8)
    given = draws(sampler, 20_000)
    sampled = sampler.sample(smooth, given, scored)
    euler = euler_integrate(smooth, given.initial_BHD, 4)
    assert torch.equal(sampled.chunk_BHD[:, ~scored], euler[:, ~scored])
    mean, std = sampler.mean(
        sampled.before_BSHD[:, 0],
        smooth(sampled.before_BSHD[:, 0], torch.full((20_000,), 0.25)),
        given.step_BS[:, 0],
        scored.expand(20_000, H, D),
    )
    stated = std[0].item() ** 2 * (0.2 * torch.eye(3) + 0.8 * torch.ones(3, 3))
    noise = (sampled.chunk_BHD - mean)[:, :3, :2]
    log_prob = torch.zeros(20_000)
    normal = torch.distributions.MultivariateNormal(torch.zeros(3), stated)
    for d in range(2):
        found = noise[:, :, d].T.cov()
        assert (found / stated - 1).abs().max() < 0.05
        log_prob += normal.log_prob(noise[:, :, d])
    torch.testing.assert_close(sampled.log_prob_B, log_prob, atol=1e-3, rtol=0)
    between = noise[:, 0, 0] @ noise[:, 0, 1] / (20_000 * std[0].item() ** 2)
    assert abs(between) < 0.03  # dimensions stay independent


def test_correlation_counts_rows_with_noise_only() -> None:
    sampler = sde(level=0.0, steps="last", correlation=0.8)
    assert sampler.sample(smooth, draws(sampler, 5), ALL).log_prob_B.tolist() == [0] * 5


def test_the_level_halves_from_the_first_iteration_that_trains_the_actor() -> None:
    halved = FlowSDESettings(level=0.4, half_life=10)
    expected = {-3: 0.4, 0: 0.4, 10: 0.2, 20: 0.1}
    assert {n: halved.level_after(n) for n in expected} == pytest.approx(expected)
    assert FlowSDESettings(level=0.4).level_after(1000) == 0.4


def test_settings_out_of_range_are_named() -> None:
    with pytest.raises(TaccorlError, match=r"--noise\.half_life=-1"):
        FlowSDESettings(half_life=-1)
    for correlation in (-0.1, 1.0, math.nan):
        with pytest.raises(TaccorlError, match=r"--noise\.correlation="):
            FlowSDESettings(correlation=correlation)
    with pytest.raises(TaccorlError, match=r"--noise\.stochastic_steps=every"):
        FlowSDESettings(stochastic_steps="every")
    for level in (-1, math.inf, math.nan):  # without a density
        with pytest.raises(TaccorlError, match=rf"--noise\.level={level}"):
            FlowSDESettings(level=level)


def test_noise_of_early_steps_does_not_reach_a_certain_action() -> None:
    """Data in one point: the last step's noise alone, 0.144, and its drift, remain; that is a quarter of all decisions."""
    sampler = sde()
    given = draws(sampler, 4000)
    chunks = sampler.sample(to_gaussian(0.7, 1e-6), given, ALL).chunk_BHD
    stds = [chunks[given.step_BS[:, 0] == k].std().item() for k in range(4)]
    assert stds[:3] == pytest.approx([0, 0, 0], abs=1e-4) and stds[3] == pytest.approx(
        0.150, abs=0.003
    )

"""What policies from scratch have beyond π0.5: steps normalised by themselves, and acting with a mean of weights."""

import copy

import numpy as np
import pytest
import torch
from lerobot.configs import NormalizationMode
from tiny_policies import TACTILE, batch_of, chunk, tiny_config, tiny_policy
from torch import nn

from taccorl.errors import TaccorlError
from taccorl.policies.tactile_pi05.averaged import Averaged
from taccorl.policies.tactile_pi05.chunk_steps import ChunkSteps
from taccorl.policies.tactile_pi05.configuration_tactile_pi05 import TactilePI05Config
from taccorl.policies.tactile_pi05.mixture import IS_SIM, Mixture
from taccorl.policies.tactile_pi05.modeling_tactile_pi05 import TactilePI05Policy


def config(**settings) -> TactilePI05Config:
    values = {
        "device": "cpu",
        "backbone": "tiny",
        "chunk_size": 3,
        "n_action_steps": 3,
        "use_relative_actions": True,
    }
    return TactilePI05Config(**values | settings)


STATISTICS = {
    "action": {
        "q01": np.array([-1.0, 0.0]),
        "q99": np.array([3.0, 0.5]),
        "step_mean": np.array([[1.0, 0.25], [2.0, 0.25], [3.0, 0.25]]),
        "step_std": np.array([[0.2, 0.1], [0.4, 0.1], [0.8, 1e-6]]),
    }
}


def test_each_step_is_normalised_by_its_own_mean_and_deviation():
    """q01 … q99 is 4 wide: x = 1.2 is 0.1 normalised; μ = 1 is 0 and σ = 0.2 is 0.1 there, so z = (0.1 − 0) / 0.1 = 1."""
    steps = ChunkSteps.of_statistics(STATISTICS, config(), 2)
    np.testing.assert_allclose(steps.mean_HA, [[0, 0], [0.5, 0], [1, 0]], atol=1e-6)
    np.testing.assert_allclose(
        steps.std_HA, [[0.1, 0.4], [0.2, 0.4], [0.4, 0.01]], atol=1e-6
    )
    raw = torch.tensor([[[1.2, 0.25], [2.4, 0.35], [2.2, 0.25]]])
    half, middle = torch.tensor([2.0, 0.25]), torch.tensor([1.0, 0.25])
    lerobots = (raw - middle) / half
    torch.testing.assert_close(
        steps.normalized(lerobots),
        torch.tensor([[[1.0, 0.0], [1.0, 1.0], [-1.0, 0.0]]]),
    )
    torch.testing.assert_close(steps.restored(steps.normalized(lerobots)), lerobots)
    torch.testing.assert_close(
        steps.normalized(lerobots[:, :2]), steps.normalized(lerobots)[:, :2]
    )


def test_without_statistics_nothing_changes_and_other_normalisations_are_refused():
    steps = ChunkSteps.of_statistics(None, config(), 2)
    x = torch.randn(4, 3, 2)
    assert torch.equal(steps.normalized(x), x) and torch.equal(steps.restored(x), x)
    other = config(normalization_mapping={"ACTION": NormalizationMode.MEAN_STD})
    with pytest.raises(
        TaccorlError, match=r"normalize_steps=true.*MEAN_STD.*normalize_steps=false"
    ):
        ChunkSteps.of_statistics(STATISTICS, other, 2)


@pytest.mark.parametrize(
    ("settings", "steps", "decay"),
    [
        ({}, True, 0.0),
        ({"backbone": "small"}, True, 0.999),
        ({"use_relative_actions": False}, False, 0.0),
        ({"normalize_steps": False, "average_decay": 0.0}, False, 0.0),
        ({"backbone": "full"}, False, 0.0),
        (
            {"backbone": "full", "normalize_steps": True, "average_decay": 0.9},
            True,
            0.9,
        ),
    ],
)
def test_backbones_have_what_they_gain_from(settings, steps, decay):
    made = config(**settings)
    assert (made.normalizes_steps, made.decay_of_average) == (steps, decay)


def test_settings_that_mean_nothing_are_refused():
    with pytest.raises(TaccorlError, match="use_relative_actions=true"):
        config(use_relative_actions=False, normalize_steps=True)
    with pytest.raises(TaccorlError, match=r"average_decay=1\.0"):
        config(average_decay=1.0)


def test_the_mean_follows_its_recursion_and_changes_places_without_a_copy():
    """d_1 = 2/11, d_2 = 3/12, and not d_3 = 4/13 but 0.27, as was asked for: m_0 = 0, weights 1, 2, 3."""
    network = nn.Linear(1, 1, bias=False)
    nn.init.zeros_(network.weight)
    averaged = Averaged(network, 0.27)
    mean = 0.0
    for n, weight in enumerate((1.0, 2.0, 3.0), start=1):
        nn.init.constant_(network.weight, weight)
        averaged.update(network)
        decay = (2 / 11, 3 / 12, 0.27)[n - 1]
        mean = decay * mean + (1 - decay) * weight
    assert float(averaged.get_buffer("weight")) == pytest.approx(mean)
    trained, place = network.weight, network.weight.data_ptr()
    averaged.exchange(network)
    assert network.weight is trained  # the optimiser's own
    assert network.weight.item() == pytest.approx(mean)
    averaged.exchange(network)
    assert network.weight.item() == 3.0 and network.weight.data_ptr() == place


def trained(policy: TactilePI05Policy) -> None:
    """Three steps with large changes."""
    generator = torch.Generator().manual_seed(0)
    for _ in range(3):
        policy.train()
        with torch.no_grad():
            for p in policy.model.parameters():
                p.add_(0.05 * torch.randn(p.shape, generator=generator))
        policy.update()


@pytest.mark.parametrize("acting", [True, False])
def test_a_checkpoint_acts_with_the_mean_and_trains_on_from_the_weights(
    tmp_path, acting
):
    policy = tiny_policy(average_decay=0.5)
    trained(policy)
    weights = copy.deepcopy(policy.model.state_dict())
    before = chunk(policy.eval(), batch_of(True, False))
    policy.train(not acting)
    policy.save_pretrained(tmp_path)
    assert policy.training is not acting
    again = TactilePI05Policy.from_pretrained(tmp_path)
    assert torch.equal(chunk(again, batch_of(True, False)), before)
    assert again.averaged is not None and int(again.averaged.num_updates) == 3
    again.train()
    for name, weight in again.model.state_dict().items():
        assert torch.equal(weight, weights[name]), name
    policy.train()
    policy.averaged = None
    assert not torch.equal(chunk(policy.eval(), batch_of(True, False)), before)


def test_a_chunk_comes_back_in_lerobots_normalisation_and_its_loss_is_of_the_steps():
    policy = tiny_policy(use_relative_actions=True)
    assert policy.steps is not None
    batch = batch_of(True, False)
    plain = chunk(policy.eval(), batch)
    policy.steps.mean_HA.fill_(0.5)
    policy.steps.std_HA.fill_(2.0)
    torch.testing.assert_close(chunk(policy, batch), 2.0 * plain + 0.5)
    policy.train()
    moved = {**batch, "action": 2.0 * batch["action"] + 0.5}
    learnt = policy.prepare_action(moved)
    num = batch["action"].shape[-1]
    torch.testing.assert_close(learnt[:, :, :num], batch["action"])
    assert (learnt[:, :, num:] == 0).all()


# ---- α · E_sim + (1 − α) · E_real, exactly, for any mix ----


def statistics(share: float) -> dict:
    return {IS_SIM: {"mean": torch.tensor([share])}}


@pytest.fixture(scope="module")
def rows() -> dict[str, torch.Tensor]:
    """A dataset of 8 rows, 6 of them simulated."""
    return {
        **batch_of(*[True, False] * 4),
        IS_SIM: torch.tensor([1.0, 1, 0, 1, 1, 0, 1, 1]),
    }


def trained_on(
    rows: dict[str, torch.Tensor], alpha: float, share: float | None = None
) -> TactilePI05Policy:
    torch.manual_seed(0)
    share = rows[IS_SIM].mean().item() if share is None else share
    return TactilePI05Policy(
        tiny_config(sim_weight=alpha), dataset_stats=statistics(share)
    )


def row_losses(rows: dict[str, torch.Tensor], seed: int) -> torch.Tensor:
    """(8,) unweighted."""
    torch.manual_seed(0)
    policy = TactilePI05Policy(tiny_config())
    torch.manual_seed(seed)
    return policy.forward(rows, "none")[0].detach()


@pytest.mark.parametrize("alpha", [0.0, 0.5, 0.95, 1.0])
def test_over_the_dataset_the_loss_is_the_papers_equation(rows, alpha):
    losses, is_sim = row_losses(rows, seed=5), rows[IS_SIM] > 0.5
    policy = trained_on(rows, alpha)
    torch.manual_seed(5)
    loss, said = policy.forward(rows)
    wanted = alpha * losses[is_sim].mean() + (1 - alpha) * losses[~is_sim].mean()
    torch.testing.assert_close(loss.detach(), wanted, rtol=1e-6, atol=0)
    assert said["loss_sim"] == pytest.approx(losses[is_sim].mean().item(), rel=1e-6)
    assert said["loss_real"] == pytest.approx(losses[~is_sim].mean().item(), rel=1e-6)
    assert (
        said["loss"] == pytest.approx(wanted.item(), rel=1e-6)
        and said["contact_rate"] == 0.5
    )


@pytest.mark.parametrize("alpha", [0.0, 0.5, 0.95, 1.0])
@pytest.mark.parametrize("share", [0.1, 0.75, 0.99])
def test_the_mean_over_batches_is_the_equation_whatever_each_batch_holds(alpha, share):
    """1000 rows in batches of 4: some without a real row, some without a simulated one."""
    generator = torch.Generator().manual_seed(0)
    is_sim = torch.arange(1000) < 1000 * share
    losses = torch.rand(1000, generator=generator, dtype=torch.float64) + 3 * is_sim
    mixture = Mixture(alpha, share)
    weighted = losses * mixture.weights(is_sim)
    order = torch.randperm(1000, generator=generator)
    means = torch.stack([weighted[batch].mean() for batch in order.split(4)])
    wanted = alpha * losses[is_sim].mean() + (1 - alpha) * losses[~is_sim].mean()
    assert means.mean().item() == pytest.approx(wanted.item(), rel=1e-6)
    for batch in order.split(4):
        told = mixture.means(losses[batch], is_sim[batch])
        parts = alpha * told["loss_sim"] + (1 - alpha) * told["loss_real"]
        assert parts.item() == pytest.approx(weighted[batch].mean().item(), rel=1e-6)


def test_steps_behind_the_episodes_end_do_not_count(rows):
    pad = torch.zeros(8, 10, dtype=torch.bool)
    pad[2, 7:], pad[5, 1:] = True, True
    other = {
        **rows,
        "action": torch.where(
            pad[:, :, None], torch.full_like(rows["action"], 9.0), rows["action"]
        ),
    }
    full = row_losses(rows, seed=5)
    masked = row_losses({**rows, "action_is_pad": pad}, seed=5)
    assert torch.equal(full[[0, 1, 3, 4, 6, 7]], masked[[0, 1, 3, 4, 6, 7]])
    assert not torch.equal(full[[2, 5]], masked[[2, 5]])
    torch.manual_seed(0)
    policy = TactilePI05Policy(tiny_config())
    torch.manual_seed(5)
    errors, _, _ = policy._losses_and_fused(rows)
    torch.manual_seed(5)
    loss = policy.forward({**rows, "action_is_pad": pad})[0]
    wanted = [errors[b, : 10 - int(pad[b].sum()), :14].mean() for b in range(8)]
    torch.testing.assert_close(loss, torch.stack(wanted).mean(), rtol=1e-5, atol=0)
    # Other values in the padded actions must not make the loss infinite. Their own error is not counted, but the denoiser sees
    # them as input, as in LeRobot's pi05.
    assert torch.isfinite(row_losses({**other, "action_is_pad": pad}, seed=5)).all()


@pytest.mark.parametrize(
    ("alpha", "share", "said"),
    [
        (
            0.5,
            1.0,
            "gives real rows the weight 0.5, but according to observation.is_sim .*sim_weight=1",
        ),
        (0.95, 0.0, "gives simulated rows the weight 0.95.*--policy.sim_weight=0"),
        (0.0, 1.0, "gives real rows the weight 1"),
        (1.0, 0.0, "gives simulated rows the weight 1"),
        (1.5, 0.5, "sim_weight=1.5: α is a share"),
    ],
)
def test_a_weight_for_a_domain_without_rows_is_an_error(alpha, share, said):
    with pytest.raises(TaccorlError, match=said):
        TactilePI05Policy(
            tiny_config(sim_weight=alpha), dataset_stats=statistics(share)
        )


@pytest.mark.parametrize(("alpha", "share"), [(1.0, 1.0), (0.0, 0.0)])
def test_one_domain_alone_is_its_own_mean(rows, alpha, share):
    alone = {**rows, IS_SIM: torch.full((8, 1), share)}
    policy = trained_on(alone, alpha)
    torch.manual_seed(5)
    loss, said = policy.forward(alone)
    torch.testing.assert_close(loss.detach(), row_losses(rows, seed=5).mean())
    assert ("loss_sim" in said) == (share == 1.0) and ("loss_real" in said) == (
        share == 0.0
    )


def test_a_dataset_of_one_untold_domain_is_not_weighted(rows):
    untold = {k: v for k, v in rows.items() if k != IS_SIM}
    torch.manual_seed(0)
    policy = TactilePI05Policy(
        tiny_config(sim_weight=0.95),
        dataset_stats={TACTILE: {"mean": torch.zeros(1536)}},
    )
    torch.manual_seed(5)
    loss, said = policy.forward(untold)
    torch.testing.assert_close(loss.detach(), row_losses(rows, seed=5).mean())
    assert "loss_sim" not in said
    with pytest.raises(TaccorlError, match=r"the batch has no observation\.is_sim"):
        trained_on(rows, 0.5).forward(untold)

"""α · E_sim + (1 − α) · E_real, exactly, for any mix; padded action steps left out."""

import pytest
import torch
from tiny_policies import TACTILE, batch_of, tiny_config

from taccorl.errors import TaccorlError
from taccorl.policies.tactile_pi05.mixture import IS_SIM, Mixture
from taccorl.policies.tactile_pi05.modeling_tactile_pi05 import TactilePI05Policy


def statistics(share: float) -> dict:
    return {IS_SIM: {"mean": torch.tensor([share])}}


@pytest.fixture(scope="module")
def rows() -> dict[str, torch.Tensor]:
    """A dataset of 8 rows, 6 of them simulated."""
    return {**batch_of(*[True, False] * 4), IS_SIM: torch.tensor([1.0, 1, 0, 1, 1, 0, 1, 1])}


def trained_on(rows: dict[str, torch.Tensor], alpha: float, share: float | None = None) -> TactilePI05Policy:
    torch.manual_seed(0)
    share = rows[IS_SIM].mean().item() if share is None else share
    return TactilePI05Policy(tiny_config(sim_weight=alpha), dataset_stats=statistics(share))


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
    assert said["loss"] == pytest.approx(wanted.item(), rel=1e-6) and said["contact_rate"] == 0.5


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
    other = {**rows, "action": torch.where(pad[:, :, None], torch.full_like(rows["action"], 9.0), rows["action"])}
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
    # Whatever stands there reaches the rest only as input that the denoiser sees, as in LeRobot's pi05; its error is not counted.
    assert torch.isfinite(row_losses({**other, "action_is_pad": pad}, seed=5)).all()


@pytest.mark.parametrize(
    ("alpha", "share", "said"),
    [
        (0.5, 1.0, "gives real rows the weight 0.5, but according to observation.is_sim .*sim_weight=1"),
        (0.95, 0.0, "gives simulated rows the weight 0.95.*--policy.sim_weight=0"),
        (0.0, 1.0, "gives real rows the weight 1"),
        (1.0, 0.0, "gives simulated rows the weight 1"),
        (1.5, 0.5, "sim_weight=1.5: α is a share"),
    ],
)
def test_a_weight_for_a_domain_without_rows_is_an_error(alpha, share, said):
    with pytest.raises(TaccorlError, match=said):
        TactilePI05Policy(tiny_config(sim_weight=alpha), dataset_stats=statistics(share))


@pytest.mark.parametrize(("alpha", "share"), [(1.0, 1.0), (0.0, 0.0)])
def test_one_domain_alone_is_its_own_mean(rows, alpha, share):
    alone = {**rows, IS_SIM: torch.full((8, 1), share)}
    policy = trained_on(alone, alpha)
    torch.manual_seed(5)
    loss, said = policy.forward(alone)
    torch.testing.assert_close(loss.detach(), row_losses(rows, seed=5).mean())
    assert ("loss_sim" in said) == (share == 1.0) and ("loss_real" in said) == (share == 0.0)


def test_a_dataset_of_one_untold_domain_is_not_weighted(rows):
    untold = {k: v for k, v in rows.items() if k != IS_SIM}
    torch.manual_seed(0)
    policy = TactilePI05Policy(tiny_config(sim_weight=0.95), dataset_stats={TACTILE: {"mean": torch.zeros(1536)}})
    torch.manual_seed(5)
    loss, said = policy.forward(untold)
    torch.testing.assert_close(loss.detach(), row_losses(rows, seed=5).mean())
    assert "loss_sim" not in said
    with pytest.raises(TaccorlError, match=r"the batch has no observation\.is_sim"):
        trained_on(rows, 0.5).forward(untold)

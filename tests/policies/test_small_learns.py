"""What policies from scratch have beyond π0.5: steps normalised by themselves, and acting with a mean of weights."""

import copy

import numpy as np
import pytest
import torch
from lerobot.configs import NormalizationMode
from tiny_policies import batch_of, chunk, tiny_policy
from torch import nn

from taccorl.errors import TaccorlError
from taccorl.policies.tactile_pi05.averaged import Averaged
from taccorl.policies.tactile_pi05.chunk_steps import ChunkSteps
from taccorl.policies.tactile_pi05.configuration_tactile_pi05 import TactilePI05Config
from taccorl.policies.tactile_pi05.modeling_tactile_pi05 import TactilePI05Policy


def config(**settings) -> TactilePI05Config:
    values = {"device": "cpu", "backbone": "tiny", "chunk_size": 3, "n_action_steps": 3, "use_relative_actions": True}
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
    np.testing.assert_allclose(steps.std_HA, [[0.1, 0.4], [0.2, 0.4], [0.4, 0.01]], atol=1e-6)
    raw = torch.tensor([[[1.2, 0.25], [2.4, 0.35], [2.2, 0.25]]])
    half, middle = torch.tensor([2.0, 0.25]), torch.tensor([1.0, 0.25])
    lerobots = (raw - middle) / half
    torch.testing.assert_close(steps.normalized(lerobots), torch.tensor([[[1.0, 0.0], [1.0, 1.0], [-1.0, 0.0]]]))
    torch.testing.assert_close(steps.restored(steps.normalized(lerobots)), lerobots)
    torch.testing.assert_close(steps.normalized(lerobots[:, :2]), steps.normalized(lerobots)[:, :2])


def test_without_statistics_nothing_changes_and_other_normalisations_are_refused():
    steps = ChunkSteps.of_statistics(None, config(), 2)
    x = torch.randn(4, 3, 2)
    assert torch.equal(steps.normalized(x), x)
    assert torch.equal(steps.restored(x), x)
    other = config(normalization_mapping={"ACTION": NormalizationMode.MEAN_STD})
    with pytest.raises(TaccorlError, match=r"normalize_steps=true.*MEAN_STD.*normalize_steps=false"):
        ChunkSteps.of_statistics(STATISTICS, other, 2)


@pytest.mark.parametrize(
    ("settings", "steps", "decay"),
    [
        ({}, True, 0.0),
        ({"backbone": "small"}, True, 0.999),
        ({"use_relative_actions": False}, False, 0.0),
        ({"normalize_steps": False, "average_decay": 0.0}, False, 0.0),
        ({"backbone": "full"}, False, 0.0),
        ({"backbone": "full", "normalize_steps": True, "average_decay": 0.9}, True, 0.9),
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
    assert network.weight.item() == 3.0
    assert network.weight.data_ptr() == place


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
def test_a_checkpoint_acts_with_the_mean_and_trains_on_from_the_weights(tmp_path, acting):
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

"""The forward that trains on a GPU, against LeRobot's own; here on a CPU, where only its compiler is missing."""

import logging
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from tiny_policies import TACTILE, batch_of, losses, readings, sees_with, tiny_policy
from torch._dynamo.testing import CompileCounter

from taccorl.policies.tactile_pi05 import compiled
from taccorl.policies.tactile_pi05.compiled import Compiled, CompiledBackbone
from taccorl.policies.tactile_pi05.modeling_tactile_pi05 import TactilePI05Policy


@pytest.fixture(scope="module", params=["cameras", "patches"], autouse=True)
def vision(request) -> Iterator[str]:
    with sees_with(request.param):
        yield request.param


@pytest.fixture
def as_on_a_gpu(monkeypatch):
    """Gives the list of what its layers were called for: True, the last one."""
    called: list[bool] = []

    def joint_layer(*args):
        called.append(args[-1])
        return compiled.joint_layer(*args)

    monkeypatch.setattr(CompiledBackbone, "fuses", lambda self, device: self.training)
    monkeypatch.setattr(compiled, "_compiled_joint_layer", joint_layer)
    return called


def unchanged_images(**changes: Any) -> TactilePI05Policy:
    """A policy whose training forward draws what its evaluation draws."""
    return tiny_policy(image_randomization=False, image_noise_std=0.0, **changes)


def gradients(
    policy: TactilePI05Policy, batch: dict[str, torch.Tensor]
) -> dict[str, torch.Tensor | None]:
    policy.train().zero_grad()
    torch.manual_seed(7)
    policy.forward(batch)[0].backward()
    return {
        name: None if p.grad is None else p.grad.clone()
        for name, p in policy.named_parameters()
    }


def assert_alike(
    ours: dict[str, torch.Tensor | None], theirs: dict[str, torch.Tensor | None]
) -> None:
    assert ours.keys() == theirs.keys()
    for name, their in theirs.items():
        our = ours[name]
        if our is None:  # of the last layer, what the prefix does not need
            assert their is None or not their.any(), name
        else:
            assert (
                their is not None and (our - their).norm() <= 1e-4 * their.norm() + 1e-8
            ), name


@pytest.mark.parametrize(
    "changes", [{}, {"tactile": False}, {"train_expert_only": True}]
)
def test_its_losses_and_gradients_are_those_of_lerobots_forward(changes, request):
    policy, batch = unchanged_images(**changes), batch_of(True, True, True)
    their_losses, theirs = losses(policy.train(), batch), gradients(policy, batch)
    called = request.getfixturevalue("as_on_a_gpu")
    our_losses, ours = losses(policy.train(), batch), gradients(policy, batch)
    assert called == 2 * [False, False, True]
    torch.testing.assert_close(our_losses, their_losses, rtol=1e-5, atol=1e-6)
    assert_alike(ours, theirs)


def test_without_contact_it_is_plain_pi05_up_to_rounding(as_on_a_gpu):
    """Tokens are there, masked, so that each batch has the same shapes: their content cannot matter."""
    policy, batch = unchanged_images().train(), batch_of(False, True, False)
    other = {
        **batch,
        TACTILE: torch.cat(
            [readings(False, True, False, seed=2)[:1], batch[TACTILE][1:]]
        ),
    }
    ours = losses(policy, batch)
    torch.testing.assert_close(losses(policy, other), ours, rtol=0, atol=0)
    plain = losses(
        policy.eval(), batch
    )  # rows without contact apart: LeRobot's to the bit
    torch.testing.assert_close(ours, plain, rtol=1e-5, atol=1e-6)


def test_evaluation_recomputed_activations_and_the_setting_are_lerobots_forward():
    gpu = torch.device("cuda")
    policy = tiny_policy().train()
    backbone = policy.model.paligemma_with_expert
    assert backbone.fuses(gpu) and not backbone.fuses(torch.device("cpu"))
    policy.eval()
    assert not backbone.fuses(gpu)
    assert (
        not tiny_policy(gradient_checkpointing=True)
        .train()
        .model.paligemma_with_expert.fuses(gpu)
    )
    assert (
        not tiny_policy(compile_model=False)
        .train()
        .model.paligemma_with_expert.fuses(gpu)
    )


def test_one_graph_serves_all_layers_without_a_break(as_on_a_gpu, monkeypatch, vision):
    """The joint layer twice, as it is in the middle and as the last; three and two layers are run."""
    counters = {}
    for name in ("vision_layer", "joint_layer"):
        counters[name] = CompileCounter()
        graph = torch.compile(
            getattr(compiled, name),
            backend=counters[name],
            fullgraph=True,
            dynamic=False,
        )
        monkeypatch.setattr(compiled, f"_compiled_{name}", graph)
    expected = {"vision_layer": int(vision == "patches"), "joint_layer": 2}
    policy = tiny_policy()
    gradients(policy, batch_of(True, False))
    assert {name: c.frame_count for name, c in counters.items()} == expected
    gradients(policy, batch_of(False, False))  # no contact anywhere: the same shapes
    assert {name: c.frame_count for name, c in counters.items()} == expected


def test_where_compiling_fails_training_goes_on_and_says_so(caplog, monkeypatch):
    def refuse(*_):
        raise RuntimeError("no C compiler here")

    layer = Compiled(lambda x: x + 1)
    layer._compiled = torch.compile(layer._plain, backend=refuse)
    x = torch.zeros(2)
    monkeypatch.setattr(compiled, "_is_on_gpu", lambda _: True)
    with caplog.at_level(logging.WARNING):
        assert layer(x).tolist() == [1, 1] and layer(x).tolist() == [1, 1]
    assert (
        caplog.text.count("no C compiler here") == 1
        and "--policy.compile_model=false" in caplog.text
    )

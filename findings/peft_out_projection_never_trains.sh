#!/usr/bin/env bash
# Surprise: PEFT's target_modules="all-linear" puts an adapter on the output projection
# of torch's nn.MultiheadAttention, and counts it as trainable; attention uses that
# layer's weights without calling it, so the adapter gets no gradient, and an adapter
# that is not zero changes the policy only when it is merged.
# Hurts: who fine-tunes policies built on torch's attention (ACT, DETR-like decoders):
# attention stays frozen, while the count of parameters says otherwise. Naming the
# attention module itself as the target works.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install --quiet --disable-pip-version-check --no-compile \
    peft==0.21.2 torch==2.11.0 transformers==5.5.4 numpy==2.2.6
"$folder/bin/python" - 2> "$folder/messages" <<'PYTHON'
import sys
from importlib.metadata import version

import peft
import torch
from torch import nn


class Policy(nn.Module):
    """Attention over five steps, and a head of three joints."""

    def __init__(self):
        super().__init__()
        self.attention = nn.MultiheadAttention(16, 2, batch_first=True)
        self.head = nn.Linear(16, 3)

    def forward(self, steps):
        return self.head(self.attention(steps, steps, steps)[0])


def adapted(targets, is_zero=True):
    torch.manual_seed(0)
    lora = peft.LoraConfig(r=4, target_modules=targets, init_lora_weights=is_zero)
    return peft.get_peft_model(Policy(), lora)


def moved_by_training(targets):
    """Name of each adapted layer -> whether 20 steps of training moved its adapter."""
    policy = adapted(targets)
    steps, wanted = torch.randn(8, 5, 16), torch.randn(8, 5, 3)
    optimizer = torch.optim.Adam(
        [p for p in policy.parameters() if p.requires_grad], 1e-2
    )
    for _ in range(20):
        optimizer.zero_grad()
        nn.functional.mse_loss(policy(steps), wanted).backward()
        optimizer.step()
    return {
        name.removeprefix("base_model.model.").split(".lora_B")[0]: bool(p.any())
        for name, p in policy.named_parameters()
        if "lora_B" in name
    }


def changed_by_merging(targets):
    """Largest change of the outputs when an adapter that is not zero is merged."""
    policy = adapted(targets, is_zero=False).eval()
    steps = torch.randn(8, 5, 16)
    with torch.no_grad():
        before = policy(steps)
        return float((policy.merge_and_unload()(steps) - before).abs().max())


everything = moved_by_training("all-linear")
named = moved_by_training(["attention", "head"])
merged = changed_by_merging("all-linear"), changed_by_merging(["head"])

print(f"peft {version('peft')}, torch {torch.__version__}: adapters moved in training")
print("expected: each one; merging adapters changes no output")
print("seen: all-linear", everything)
print("      named     ", named)
print(f"      merging changes outputs by {merged[0]:.2g}; of the head alone", end=" ")
print(f"{merged[1]:.0e}")
same = (
    everything == {"attention.out_proj": False, "head": True}
    and named.get("attention.base_layer.out_proj", named.get("attention")) is True
    and merged[0] > 1e-2
    and merged[1] < 1e-4
)
if not same:
    sys.exit("CHANGED: the outcome is no longer the one that is described above")
PYTHON

"""Figures of the tactile policy; ``make bench ONLY=touch_cost`` anywhere, ``make bench ONLY=full_size`` on a GPU.

Weights are random and observations made up: what is measured is time and memory, not how well it acts.
"""

import time
from collections.abc import Callable, Iterator
from statistics import mean, median
from typing import Any

from taccorl.benchmark import Row, benchmark, spread

CAMERAS = ("front", "left_wrist", "right_wrist")
REPEATS = 5


@benchmark("touch_cost")
def touch_cost() -> Iterator[Row]:
    """What touch adds to a training step and to a chunk of the small preset, all rows in contact."""
    import torch

    device = "cuda" if torch.cuda.is_available() else "cpu"
    rows = 32 if device == "cuda" else 2
    feeling, blind = (_policy("small", device, tactile=tactile) for tactile in (True, False))
    batch = _batch(rows, device, prompt_tokens=200)
    for label, of in (("training step", _training_step), ("chunk", _chunk)):
        with_touch, without = (of(policy, batch) for policy in (feeling, blind))
        pairs = [(_time_s(with_touch, device), _time_s(without, device)) for _ in range(REPEATS + 1)][1:]
        added = [100 * (a / b - 1) for a, b in pairs]
        yield Row(
            name=f"touch in a {label} of the small preset, {rows} rows, {device}",
            value=median(added), unit="% more time", goal="≤ 15", n=REPEATS, spread=spread(added),
            rival="the same without touch, s", rival_value=mean([b for _, b in pairs]),
        )  # fmt: skip


@benchmark("full_size")
def full_size() -> Iterator[Row]:
    """π0.5's own size in bfloat16 on one GPU: a training step at batch 8, a chunk of 4 denoising steps at batch 1."""
    import torch

    if not torch.cuda.is_available():
        print("  full_size needs a GPU: nothing measured")
        return
    torch.backends.cuda.matmul.allow_tf32 = True  # as lerobot-train sets it
    policy = _policy("full", "cuda", tactile=True)
    gpu = torch.cuda.get_device_name()
    batch = _batch(1, "cuda", prompt_tokens=200)
    graphed, eager = _chunk(policy, batch), _chunk(policy, batch, cuda_graph=False)
    ours, theirs = graphed(), eager()
    difference = float((ours - theirs).abs().max() / theirs.abs().max())
    yield Row(
        name=f"chunk as a graph against step by step, bf16, {gpu}: largest difference / largest action",
        value=difference, unit="", goal="≤ 0.02", n=1, spread=0.0,
    )  # fmt: skip
    for label, compute, goal in (("as one CUDA graph", graphed, "≤ 60"), ("step by step", eager, "")):
        times_ms = [1e3 * _time_s(compute, "cuda") for _ in range(REPEATS + 1)][1:]
        yield Row(
            name=f"one chunk, 4 denoising steps, batch 1, bf16, {label}, {gpu}",
            value=median(times_ms), unit="ms", goal=goal, n=REPEATS, spread=spread(times_ms),
        )  # fmt: skip
    torch.cuda.reset_peak_memory_stats()
    step = _training_step(policy, _batch(8, "cuda", prompt_tokens=200))
    times_s = [_time_s(step, "cuda") for _ in range(REPEATS + 2)][2:]
    yield Row(
        name=f"training step, batch 8, bf16, AdamW, {gpu}",
        value=median(times_s), unit="s", goal="≤ 0.36", n=REPEATS, spread=spread(times_s),
    )  # fmt: skip
    peak = torch.cuda.max_memory_allocated() / 1e9
    yield Row(name=f"weights, gradients, AdamW and activations of it, {gpu}", value=peak, unit="GB", n=1, spread=0.0)


def _policy(backbone: str, device: str, *, tactile: bool) -> Any:
    import torch
    from lerobot.configs import FeatureType, PolicyFeature

    from taccorl.policies.tactile_pi05.configuration_tactile_pi05 import TACTILE, TactileFormat, TactilePI05Config
    from taccorl.policies.tactile_pi05.modeling_tactile_pi05 import TactilePI05Policy

    pads = ("left_a", "left_b", "right_a", "right_b")
    config = TactilePI05Config(
        backbone=backbone,
        device=device,
        dtype="bfloat16" if device == "cuda" else "float32",
        tactile=tactile,
        tactile_format=TactileFormat("flexitac_v2", pads, 32, 12, "fixed_scale", 1 / 75),
        input_features={
            "observation.state": PolicyFeature(FeatureType.STATE, (14,)),
            TACTILE: PolicyFeature(FeatureType.STATE, (1536,)),
            **{f"observation.images.{c}": PolicyFeature(FeatureType.VISUAL, (3, 224, 224)) for c in CAMERAS},
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (14,))},
    )
    torch.manual_seed(0)
    with torch.device(device):
        return TactilePI05Policy(config)


def _batch(rows: int, device: str, *, prompt_tokens: int) -> dict[str, Any]:
    """All rows in contact; half of the prompt's tokens are there."""
    import torch

    torch.manual_seed(0)
    with torch.device(device):
        return {
            **{f"observation.images.{c}": torch.rand(rows, 3, 224, 224) for c in CAMERAS},
            "observation.state": torch.rand(rows, 14),
            "observation.language.tokens": torch.randint(2, 258, (rows, prompt_tokens)),
            "observation.language.attention_mask": (torch.arange(prompt_tokens) < prompt_tokens // 2).expand(rows, -1),
            "observation.tactile": 2 * torch.rand(rows, 10, 1536),
            "action": torch.randn(rows, 10, 14),
        }


def _training_step(policy: Any, batch: dict[str, Any]) -> Callable[[], Any]:
    """Forward, backward, clipping and AdamW, under the autocast that lerobot-train uses for the policy's dtype."""
    import torch

    optimizer = policy.config.get_optimizer_preset().build(policy.parameters())
    bfloat16 = policy.config.dtype == "bfloat16"

    def step() -> None:
        policy.train()
        with torch.autocast(policy.config.device, torch.bfloat16, enabled=bfloat16):
            loss, _ = policy.forward(batch)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), 1.0)
        optimizer.step()
        optimizer.zero_grad()

    return step


def _chunk(policy: Any, batch: dict[str, Any], *, cuda_graph: bool = True) -> Callable[[], Any]:
    import torch

    noise = torch.randn(len(batch["action"]), 10, 32, generator=torch.Generator().manual_seed(1)).to(
        policy.config.device
    )

    def chunk() -> Any:
        policy.config.cuda_graph = cuda_graph
        return policy.predict_action_chunk(batch, noise=noise)

    return chunk


def _time_s(work: Callable[[], Any], device: str) -> float:
    import torch

    if device == "cuda":
        torch.cuda.synchronize()
    start_s = time.perf_counter()
    work()
    if device == "cuda":
        torch.cuda.synchronize()
    return time.perf_counter() - start_s

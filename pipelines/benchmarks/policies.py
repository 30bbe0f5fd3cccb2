"""Figures of the tactile policy; ``make bench ONLY=touch_cost`` anywhere, ``make bench ONLY=full_size`` on a GPU.

Weights are random and observations made up: what is measured is time and memory, not how well it acts.
"""

import gc
import json
import math
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import mean, median
from typing import Any

from pipelines.benchmarks.rows import Row, benchmark, spread
from taccorl.robots import ROBOT

REPEATS = 5


@benchmark("touch_cost")
def touch_cost() -> Iterator[Row]:
    """Benchmark of the cost of touch in a training step and in a chunk of the small preset, with contact in all rows."""
    import torch

    device = "cuda" if torch.cuda.is_available() else "cpu"
    rows, repeats = (
        (32, 4 * REPEATS) if device == "cuda" else (2, REPEATS)
    )  # there they take 50 ms, as Python likes
    feeling, blind = (
        random_policy("small", device, tactile=tactile) for tactile in (True, False)
    )
    batch = random_batch(rows, device, prompt_tokens=200)
    for label, of in (("training step", _training_step), ("chunk", _chunk)):
        with_touch, without = (of(policy, batch) for policy in (feeling, blind))
        pairs = [
            (_time_s(with_touch, device), _time_s(without, device))
            for _ in range(repeats + 2)
        ][2:]
        added = [100 * (a / b - 1) for a, b in pairs]
        yield Row(
            name=f"touch in a {label} of the small preset, {rows} rows, {device}",
            value=median(added), unit="% more time", goal="≤ 15", n=repeats, spread=spread(added),
            rival="the same without touch, s", rival_value=mean([b for _, b in pairs]),
        )  # fmt: skip


@benchmark("full_size")
def full_size() -> Iterator[Row]:
    """Benchmark of π0.5's full size in bfloat16 on one GPU: a training step at batch 8, and a chunk of 4 denoising steps at
    batch 1."""
    import torch

    if not torch.cuda.is_available():
        print("  full_size needs a GPU: nothing measured")
        return
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.benchmark = (
        True  # as lerobot-train sets them
    )
    yield from _chunk_rows(torch.cuda.get_device_name())
    yield from _training_rows(torch.cuda.get_device_name())


def _chunk_rows(gpu: str) -> Iterator[Row]:
    policy, batch = (
        random_policy("full", "cuda", tactile=True),
        random_batch(1, "cuda", prompt_tokens=200),
    )
    graphed, eager = _chunk(policy, batch), _chunk(policy, batch, cuda_graph=False)
    ours, theirs = graphed(), eager()
    difference = float((ours - theirs).abs().max() / theirs.abs().max())
    yield Row.of(
        [difference],
        name=f"chunk as a graph against step by step, bf16, {gpu}: largest difference / largest action",
        unit="1",
        goal="≤ 0.02",
    )
    for label, compute, goal in (
        ("as one CUDA graph", graphed, "≤ 60"),
        ("step by step", eager, ""),
    ):
        times_ms = [1e3 * _time_s(compute, "cuda") for _ in range(REPEATS + 1)][1:]
        yield Row(
            name=f"one chunk, 4 denoising steps, batch 1, bf16, {label}, {gpu}",
            value=median(times_ms), unit="ms", goal=goal, n=REPEATS, spread=spread(times_ms),
        )  # fmt: skip


def _training_rows(gpu: str) -> Iterator[Row]:
    import torch

    policy, batch = (
        random_policy("full", "cuda", tactile=True),
        random_batch(8, "cuda", prompt_tokens=200),
    )
    torch.cuda.reset_peak_memory_stats()
    times_s = _step_times_s(policy, batch)
    peak_gb = torch.cuda.max_memory_allocated() / 1e9
    ours, theirs = _gradient_errors(
        policy, _contact_in_every_other({k: v[:2] for k, v in batch.items()})
    )
    del policy
    blind_s = median(_step_times_s(random_policy("full", "cuda", tactile=False), batch))
    lerobots_s = median(_step_times_s(_lerobots_pi05(), batch))
    yield Row(
        name=f"training step, batch 8, bf16, AdamW, {gpu}",
        value=median(times_s), unit="s", goal="≤ 0.36", n=REPEATS, spread=spread(times_s),
        rival="LeRobot's pi05, without touch or image randomisation, s", rival_value=lerobots_s,
    )  # fmt: skip
    yield Row.of(
        [peak_gb],
        name=f"weights, gradients, AdamW and activations of it, {gpu}",
        unit="GB",
    )
    added = [100 * (t / blind_s - 1) for t in times_s]
    yield Row(
        name=f"touch in that step, {gpu}",
        value=median(added), unit="% more time", goal="≤ 15", n=REPEATS, spread=spread(added),
        rival="the same without touch, s", rival_value=blind_s,
    )  # fmt: skip
    yield Row.of(
        [ours / theirs],
        name=f"gradient of a step, 2 rows, bf16 against float32, {gpu}: error of compiled layers / of LeRobot's forward",
        unit="1",
        goal="≤ 1.1",
        rival="norm of the latter / of the gradient",
        rival_value=theirs,
    )


@benchmark("full_adapters")
def full_adapters() -> Iterator[Row]:
    """Benchmark of training steps of adapters (LoRA) of π0.5's full size in bfloat16 at batch 32, on one GPU and on all."""
    import torch

    if not torch.cuda.is_available():
        print("  full_adapters needs a GPU: nothing measured")
        return
    yield from adapter_rows("full", 32, torch.cuda.get_device_name())


def adapter_rows(
    backbone: str, rows: int, where: str, device: str = "cuda"
) -> Iterator[Row]:
    """Time and memory of training steps of adapters and touch, as of ``lerobot-train --peft.method_type=LORA``, with ``rows``
    on each GPU; the rate of all GPUs over that of one. On a CPU two processes stand for GPUs."""
    import torch

    counts = {1, torch.cuda.device_count() if device == "cuda" else 2}
    per_gpu = {n: _adapter_steps(n, backbone, rows, device) for n in sorted(counts)}
    for n, (times_s, peak_gb) in per_gpu.items():
        name = f"training step of adapters (LoRA), batch {rows}, {n} × {where}"
        yield Row.of(times_s, name=name, unit="s")
        yield Row.of(
            [peak_gb],
            name=f"GPU memory of it, {n} × {where}",
            unit="GB",
            goal="< 80" * (device == "cuda"),
        )
    many = max(per_gpu)
    if many > 1:
        one_s = median(per_gpu[1][0])
        yield Row.of(
            [many * one_s / t for t in per_gpu[many][0]],
            name=f"rows/s of it on {many} over one, {where}", unit="×", goal="≥ 1.7" if many == 2 else "",
            rival="one, rows/s", rival_value=rows / one_s,
        )  # fmt: skip


def _adapter_steps(num: int, *arguments: Any) -> tuple[list[float], float]:
    """Times [s] of ``REPEATS`` steps of the first of ``num`` processes, one on each GPU, and its memory [GB]."""
    import torch.multiprocessing as mp

    with tempfile.TemporaryDirectory() as folder:
        mp.spawn(_adapter_process, (num, folder, *arguments), num)  # pyright: ignore[reportPrivateImportUsage]
        return tuple(json.loads((Path(folder) / "found.json").read_text()))


def _adapter_process(
    rank: int, num: int, folder: str, backbone: str, rows: int, device: str
) -> None:
    import torch
    from torch.nn.parallel import DistributedDataParallel

    cuda = device == "cuda"
    if cuda:
        torch.cuda.set_device(rank)
        torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.benchmark = True
    place = {"init_method": f"file://{folder}/store", "rank": rank, "world_size": num}
    torch.distributed.init_process_group("nccl" if cuda else "gloo", **place)
    policy = random_policy(
        backbone, device, tactile=True, gradient_checkpointing=True
    )  # as configs/cotrain
    policy.config.base_checkpoint = "random weights"
    adapted = policy.wrap_with_peft(peft_cli_overrides={"method_type": "LORA"})
    shared = (
        DistributedDataParallel(adapted, find_unused_parameters=True)
        if num > 1
        else adapted
    )  # as Accelerate's
    step, times_s = (
        _training_step(policy, random_batch(rows, device, prompt_tokens=200), shared),
        [],
    )
    for _ in range(REPEATS + 3):
        times_s.append(_time_s(step, device))
    peak_gb = torch.cuda.max_memory_allocated() / 1e9 if cuda else 0.0
    if rank == 0:
        (Path(folder) / "found.json").write_text(json.dumps((times_s[3:], peak_gb)))
    torch.distributed.destroy_process_group()


def random_policy(backbone: str, device: str, *, tactile: bool, **settings: Any) -> Any:
    """A ``TactilePI05Policy`` with random weights for the robot's state, actions, pads and three cameras at 224 × 224."""
    import torch
    from lerobot.configs import FeatureType, PolicyFeature

    from taccorl.policies.tactile_pi05.configuration_tactile_pi05 import (
        TACTILE,
        TactileFormat,
        TactilePI05Config,
    )
    from taccorl.policies.tactile_pi05.modeling_tactile_pi05 import TactilePI05Policy

    known = _features()
    config = TactilePI05Config(
        backbone=backbone,
        device=device,
        dtype="bfloat16" if device == "cuda" else "float32",
        tactile=tactile,
        tactile_format=TactileFormat(
            "flexitac_v2", ROBOT.pads, *ROBOT.pad.shape, "fixed_scale", 1 / 75
        ),
        input_features={
            **known["input_features"],
            TACTILE: PolicyFeature(FeatureType.STATE, (ROBOT.num_taxels,)),
        },
        output_features=known["output_features"],
        **settings,
    )
    torch.manual_seed(0)
    with torch.device(device):
        return TactilePI05Policy(config)


def _lerobots_pi05() -> Any:
    """LeRobot's own policy in the same size, unchanged."""
    import torch
    from lerobot.policies.pi05.configuration_pi05 import PI05Config
    from lerobot.policies.pi05.modeling_pi05 import PI05Policy

    config = PI05Config(
        device="cuda", dtype="bfloat16", chunk_size=10, n_action_steps=10, **_features()
    )
    torch.manual_seed(0)
    with torch.device("cuda"):
        return PI05Policy(config)


def _features() -> dict[str, Any]:
    """State, three cameras and actions."""
    from lerobot.configs import FeatureType, PolicyFeature

    images = {
        f"observation.images.{c}": PolicyFeature(FeatureType.VISUAL, (3, 224, 224))
        for c in ROBOT.cameras
    }
    return {
        "input_features": {
            "observation.state": PolicyFeature(FeatureType.STATE, (ROBOT.num_actions,)),
            **images,
        },
        "output_features": {
            "action": PolicyFeature(FeatureType.ACTION, (ROBOT.num_actions,))
        },
    }


def random_batch(rows: int, device: str, *, prompt_tokens: int) -> dict[str, Any]:
    """Random inputs of ``random_policy``, and actions. All rows are in contact; half of the prompt's tokens are valid."""
    import torch

    torch.manual_seed(0)
    with torch.device(device):
        return {
            **{
                f"observation.images.{c}": torch.rand(rows, 3, 224, 224)
                for c in ROBOT.cameras
            },
            "observation.state": torch.rand(rows, ROBOT.num_actions),
            "observation.language.tokens": torch.randint(2, 258, (rows, prompt_tokens)),
            "observation.language.attention_mask": (
                torch.arange(prompt_tokens) < prompt_tokens // 2
            ).expand(rows, -1),
            "observation.tactile": 2 * torch.rand(rows, 10, ROBOT.num_taxels),
            "action": torch.randn(rows, 10, ROBOT.num_actions),
        }


def _contact_in_every_other(batch: dict[str, Any]) -> dict[str, Any]:
    touch = batch["observation.tactile"].clone()
    touch[1::2] *= 0.1  # below the gate's threshold
    return {**batch, "observation.tactile": touch}


def _training_step(
    policy: Any, batch: dict[str, Any], called: Any = None
) -> Callable[[], Any]:
    """One step as ``update_policy`` of lerobot-train makes it: in autocast for the policy's dtype; loss and gradient norm are
    read for the log. ``called``: module whose forward is run, if it is not the policy itself but a wrapper (DDP)."""
    import torch

    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    scheduler = policy.config.get_scheduler_preset().build(optimizer, 3000)
    bfloat16 = policy.config.dtype == "bfloat16"

    def step() -> None:
        policy.train()
        with torch.autocast(policy.config.device, torch.bfloat16, enabled=bfloat16):
            loss, _ = (called or policy)(batch)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(policy.parameters(), 1.0)
        optimizer.step()
        optimizer.zero_grad()
        scheduler.step()
        loss.item()
        norm.item()

    return step


def _step_times_s(policy: Any, batch: dict[str, Any]) -> list[float]:
    """Of ``REPEATS`` training steps after three; the GPU's memory is free again when the policy is."""
    import torch

    step = _training_step(policy, batch)
    times_s = [_time_s(step, "cuda") for _ in range(REPEATS + 3)][3:]
    del step
    gc.collect()
    torch.cuda.empty_cache()
    return times_s


def _gradient_errors(policy: Any, batch: dict[str, Any]) -> tuple[float, float]:
    """Of compiled layers and of LeRobot's forward, both in bfloat16, against float32; the policy is in float32 after it."""
    import torch

    policy._change_images = None
    backbone = policy.model.paligemma_with_expert

    def gradient(*, compiled: bool) -> dict[str, Any]:
        backbone.compiles_layers = compiled
        torch.manual_seed(0)
        with torch.autocast(
            "cuda", torch.bfloat16, enabled=policy.config.dtype == "bfloat16"
        ):
            loss, _ = policy.train().forward(batch)
        loss.backward()
        gradients = {
            k: p.grad.float()
            for k, p in policy.named_parameters()
            if p.grad is not None
        }
        policy.zero_grad()
        return gradients

    ours, theirs = gradient(compiled=True), gradient(compiled=False)
    policy.float().config.dtype = "float32"
    torch.backends.cuda.matmul.allow_tf32 = False
    exact = gradient(compiled=False)
    torch.backends.cuda.matmul.allow_tf32 = True
    size = math.sqrt(sum(float(g.square().sum()) for g in exact.values()))

    def error(
        of: dict[str, Any],
    ) -> float:  # a weight that nothing needs has a gradient of zeros, or none
        return (
            math.sqrt(
                sum(float((g - of.get(k, 0)).square().sum()) for k, g in exact.items())
            )
            / size
        )

    return error(ours), error(theirs)


def _chunk(
    policy: Any, batch: dict[str, Any], *, cuda_graph: bool = True
) -> Callable[[], Any]:
    import torch

    noise = torch.randn(
        len(batch["action"]), 10, 32, generator=torch.Generator().manual_seed(1)
    ).to(policy.config.device)

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

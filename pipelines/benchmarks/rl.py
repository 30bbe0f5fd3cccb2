"""Figures of post-training: ``make bench ONLY=rollout_shards`` anywhere, ``make bench ONLY=full_post_training`` on a GPU."""

import dataclasses
import math
import os
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from statistics import median
from typing import Any

import numpy as np

from pipelines.benchmarks.rows import Row, benchmark, spread
from pipelines.benchmarks.sim import NUM_SIMS, REPEATS, holding
from taccorl.rl.shards import ProcessShard
from taccorl.rl.twin_shard import make_shard
from taccorl.sim.twin import TwinConfig
from taccorl.sim.vector_env import TaccorlVectorEnv

_ACTIONS = 16  # of a chunk


def _process_shard(numbers: np.ndarray, num_threads: int) -> ProcessShard:
    envs = {"task": "assembly_1", "num_envs": len(numbers), "twin": TwinConfig(), "num_threads": num_threads}
    return ProcessShard(partial(make_shard, envs, history=10, privileged=True, first=int(numbers[0])))


def call(shard: ProcessShard, method: str, *args: Any) -> Any:
    """Result of a method of a shard."""
    shard.start(method, *args)
    return shard.result()


@benchmark("rollout_shards")
def rollout_shards() -> Iterator[Row]:
    """Benchmark of chunks of 16 actions and the observations after them, with parts in both hands: in one process with all
    threads, and in as many processes as CPUs, relative to the physics steps alone in one process; wall time, in turns."""
    cpus = len(os.sched_getaffinity(0))
    sim, goal = holding()
    threaded = TaccorlVectorEnv("assembly_1", num_envs=NUM_SIMS, num_threads=cpus)
    threaded.reset(seed=0)
    steps = sim.config.physics.steps_per_control_step
    chunks = np.repeat(goal.astype(np.float32)[:, None], _ACTIONS, axis=1)
    held = sim.snapshot()

    def bare() -> float:
        threaded.sim.restore(held)
        before = time.perf_counter()
        for _ in range(_ACTIONS):
            threaded.sim.batch.step(nstep=steps)
        return time.perf_counter() - before

    def of_shards(num: int) -> tuple[Callable[[], float], Callable[[], None]]:
        parts = np.array_split(np.arange(NUM_SIMS), num)
        shards = [_process_shard(part, cpus // num) for part in parts]
        states = []
        for shard, part in zip(shards, parts, strict=True):
            call(shard, "restart", 0)
            snapshot = sim.snapshot(part)
            fields = {f.name: getattr(snapshot, f.name) for f in dataclasses.fields(snapshot)}
            states.append(call(shard, "state_dict") | {"snapshot": fields})

        def each(method: str, arguments: Sequence[tuple[Any, ...]]) -> None:
            for shard, args in zip(shards, arguments, strict=True):
                shard.start(method, *args)
            for shard in shards:
                shard.result()

        def measure() -> float:
            each("load_state_dict", [(state,) for state in states])
            before = time.perf_counter()
            each("act", [(chunks[part],) for part in parts])
            each("observe", [()] * num)
            return time.perf_counter() - before

        def close() -> None:
            for shard in shards:
                shard.close()

        return measure, close

    (one, close_one), (many, close_many) = of_shards(1), of_shards(cpus)
    for measure in (bare, one, many):
        measure()
    times = [(bare(), one(), many()) for _ in range(REPEATS)]
    close_one()
    close_many()
    threaded.close()
    rate = NUM_SIMS * _ACTIONS / median(b for b, _, _ in times)
    for column, what, goal_text in ((1, "one process", ""), (2, f"{cpus} processes", "≥ 0.9")):
        shares = [row[0] / row[column] for row in times]
        yield Row(
            name=f"control steps/s of {NUM_SIMS} environments in {what} over a bare Batch.step loop's, {cpus} CPUs, wall",
            value=median(shares),
            unit="1",
            goal=goal_text,
            rival="Batch.step, control steps/s",
            rival_value=rate,
            n=len(shares),
            spread=spread(shares),
        )


@benchmark("full_post_training")
def full_post_training() -> Iterator[Row]:
    """Benchmark of π0.5's full size on one GPU: a decision of 128 environments and the paper's optimiser step of 512 decisions,
    without the physics. Weights and observations are random: time and memory are measured."""
    import torch

    if not torch.cuda.is_available():
        print("  full_post_training needs a GPU: nothing measured")
        return
    gpu = torch.cuda.get_device_name()
    torch.backends.cuda.matmul.allow_tf32 = True  # --policy.tf32=true
    yield from post_training_rows("full", "cuda", f"TF32, {gpu}", num_envs=128, num_decisions=512)
    torch.backends.cuda.matmul.allow_tf32 = False
    yield from post_training_rows("full", "cuda", f"float32, {gpu}", num_envs=32, num_decisions=32)


def post_training_rows(backbone: str, device: str, where: str, *, num_envs: int, num_decisions: int) -> Iterator[Row]:
    """Rows of ``full_post_training``, of any backbone and device.

    Args:
        where: name of arithmetic and device in the rows.
        num_envs: number of environments, 128 in the paper.
        num_decisions: decisions of an optimiser step, 512 in the paper; a multiple of ``num_envs``.
    """
    import torch

    from pipelines.benchmarks.policies import random_batch, random_policy
    from taccorl.rl.critic import Critic
    from taccorl.rl.flow_policy import TactileFlowPolicy
    from taccorl.rl.flow_sde import FlowSDE
    from taccorl.rl.ppo import PPO, Decisions
    from taccorl.rl.settings import FlowSDESettings, PolicySettings, PPOSettings

    cuda = device.startswith("cuda")
    micro_batch = min(16, num_envs)
    policy = random_policy(backbone, device, tactile=True)
    sde = FlowSDE(FlowSDESettings())
    actor = TactileFlowPolicy(policy, PolicySettings(), sde.num_steps)
    batch = random_batch(num_envs, device, prompt_tokens=200)
    batch = {k: (x * 255).to(torch.uint8) if "images" in k else x for k, x in batch.items() if k != "action"}
    generator = torch.Generator().manual_seed(0)
    groups = [{k: x[rows] for k, x in batch.items()} for rows in torch.arange(num_envs).split(32)]  # in memory at once
    draws = sde.draw(num_envs, (policy.config.chunk_size, policy.config.max_action_dim), generator, device)

    def decide() -> tuple[Any, ...]:
        parts = torch.arange(num_envs, device=device).split(32)
        return tuple(actor.sample(group, sde, draws.rows(part)) for group, part in zip(groups, parts, strict=True))

    def timed(work: Callable[[], Any]) -> float:
        before = time.perf_counter()
        work()
        if cuda:
            torch.cuda.synchronize()
        return time.perf_counter() - before

    if cuda:
        torch.cuda.reset_peak_memory_stats()
    times_s = [timed(decide) for _ in range(4)][1:]
    label = f"{backbone}, {where}"
    yield Row(
        name=f"one decision of {num_envs} environments, policy alone, {label}",
        value=median(times_s), unit="s", n=len(times_s), spread=spread(times_s),
    )  # fmt: skip
    if cuda:
        peak_gb = torch.cuda.max_memory_allocated() / 1e9
        yield Row(name=f"GPU memory of it, {label}", value=peak_gb, unit="GB", n=1, spread=0.0)

    sampled, features = zip(*decide(), strict=True)
    repeats = num_decisions // num_envs
    many = torch.arange(num_envs, device=device).repeat(repeats)
    before, after, log_prob = (
        torch.cat([getattr(s, k) for s in sampled])[many] for k in ("before_BSHD", "after_BSHD", "log_prob_B")
    )
    decisions = Decisions(
        batch={k: x[many] for k, x in batch.items()},
        before_MSHD=before,
        after_MSHD=after,
        step_MS=draws.step_BS[many],
        log_prob_M=log_prob,
        features_MF=torch.cat(features)[many],
        privileged_MP=torch.zeros(num_decisions, 0, device=device),
        advantage_M=torch.randn(num_decisions, device=device),
        return_M=torch.rand(num_decisions, device=device),
    )
    critic = Critic(actor.num_features).to(device)
    ppo = PPO(
        actor,
        critic,
        sde,
        PPOSettings(batch_size=num_decisions, micro_batch=micro_batch, kl_stop=math.inf),
        ratio_guard=math.inf,
    )
    if cuda:
        torch.cuda.reset_peak_memory_stats()
    found: list[dict[str, float]] = []
    times_s = [timed(lambda: found.append(ppo.update(decisions, generator))) for _ in range(3)][1:]
    yield Row(
        name=f"one optimiser step of {num_decisions} decisions and the KL after it, micro-batches of {micro_batch}, {label}",
        value=median(times_s), unit="s", n=len(times_s), spread=spread(times_s),
    )  # fmt: skip
    yield Row(
        name=f"largest |ratio − 1| before the first step, {label}",
        value=found[0]["first_ratio_error"], unit="1", n=1, spread=0.0,
    )  # fmt: skip
    if cuda:
        peak_gb = torch.cuda.max_memory_allocated() / 1e9
        yield Row(
            name=f"GPU memory of it: weights, gradients, AdamW, activations, {label}",
            value=peak_gb,
            unit="GB",
            n=1,
            spread=0.0,
        )

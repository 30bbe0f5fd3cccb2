"""Figures of post-training: ``make bench ONLY=rollout_speed`` anywhere, ``make bench ONLY=full_post_training`` on a GPU."""

import dataclasses
import math
import os
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from pipelines.benchmarks.rows import Row, benchmark
from pipelines.benchmarks.sim import NUM_SIMS, REPEATS, holding
from taccorl.rl.shards import ProcessShard
from taccorl.rl.start_states import StartStates
from taccorl.rl.twin_shard import make_shard
from taccorl.sim.simulation import Simulation
from taccorl.sim.twin import TwinConfig
from taccorl.sim.vector_env import TaccorlVectorEnv

_CHUNKS = (8, 16)  # actions
_CPUS = len(os.sched_getaffinity(0))


class _Shards:
    """Environments of Assembly #1 with parts in both hands, in ``num`` worker processes that share all CPUs."""

    def __init__(self, sim: Simulation, num: int) -> None:
        self.parts = np.array_split(np.arange(NUM_SIMS), num)
        self.shards, self._states = [], []
        for part in self.parts:
            envs = {
                "task": "assembly_1",
                "num_envs": len(part),
                "twin": TwinConfig(),
                "num_threads": _CPUS // num,
            }
            make = partial(
                make_shard,
                envs,
                history=10,
                starts=StartStates(),
                privileged=True,
                first=int(part[0]),
            )
            self.shards.append(ProcessShard(make))
        self.each("restart", [(0,)] * num)
        for part, state in zip(
            self.parts, self.each("state_dict", [()] * num), strict=True
        ):
            snapshot = sim.snapshot(part)
            fields = {
                f.name: getattr(snapshot, f.name) for f in dataclasses.fields(snapshot)
            }
            self._states.append((state | {"snapshot": fields},))

    def each(self, method: str, arguments: Sequence[tuple[Any, ...]]) -> list[Any]:
        for shard, args in zip(self.shards, arguments, strict=True):
            shard.start(method, *args)
        return [shard.result() for shard in self.shards]

    def chunk_s(self, chunks: np.ndarray) -> tuple[float, float]:
        """Wall and CPU-seconds of all processes for one chunk and the observations after it, from the held parts."""
        self.each("load_state_dict", self._states)
        wall_s, cpu_s = time.perf_counter(), self._cpu_s()
        self.each("act", [(chunks[part],) for part in self.parts])
        self.each("observe", [()] * len(self.shards))
        return time.perf_counter() - wall_s, self._cpu_s() - cpu_s

    def _cpu_s(self) -> float:
        """CPU-seconds of this process and of the workers, all threads."""
        stats = [
            Path(f"/proc/{shard.process.pid}/stat")
            .read_text()
            .rpartition(")")[2]
            .split()
            for shard in self.shards
        ]
        ticks = sum(
            int(fields[11]) + int(fields[12]) for fields in stats
        )  # utime, stime
        return time.process_time() + ticks / os.sysconf("SC_CLK_TCK")

    def close(self) -> None:
        for shard in self.shards:
            shard.close()


@benchmark("rollout_speed")
def rollout_speed() -> Iterator[Row]:
    """Benchmark of chunks of actions and the observations after them, with parts in both hands: in one process with all threads,
    and in as many processes as CPUs, relative to the physics steps alone in one process with all threads. In turns."""
    sim, goal = holding(NUM_SIMS)
    threaded = TaccorlVectorEnv("assembly_1", num_envs=NUM_SIMS, num_threads=_CPUS)
    threaded.reset(seed=0)
    steps, held = sim.config.physics.steps_per_control_step, sim.snapshot()
    one, many = _Shards(sim, 1), _Shards(sim, _CPUS)

    def bare_s(num_actions: int) -> tuple[float, float]:
        threaded.sim.restore(held)
        wall_s, cpu_s = time.perf_counter(), time.process_time()
        for _ in range(num_actions):
            threaded.sim.batch.step(nstep=steps)
        return time.perf_counter() - wall_s, time.process_time() - cpu_s

    for num_actions in _CHUNKS:
        chunks = np.repeat(goal.astype(np.float32)[:, None], num_actions, axis=1)
        turns = [
            (bare_s(num_actions), one.chunk_s(chunks), many.chunk_s(chunks))
            for _ in range(1 + REPEATS)
        ][1:]
        for place, where, goal_text in (
            (1, "one process", ""),
            (2, f"{_CPUS} processes", "≥ 0.9"),
        ):
            for kind, time_of in enumerate(("wall time", "CPU time")):
                shares = [turn[0][kind] / turn[place][kind] for turn in turns]
                yield Row.of(
                    shares,
                    name=f"control steps of {NUM_SIMS} environments, chunks of {num_actions}, in {where}, over those of a bare "
                    f"Batch.step loop in the same {time_of}",
                    unit="1",
                    goal=goal_text if time_of == "CPU time" else "",
                    rival=f"Batch.step, control steps/s of {time_of}",
                    rival_value=NUM_SIMS
                    * num_actions
                    / median(turn[0][kind] for turn in turns),
                )
    one.close()
    many.close()
    threaded.close()


@benchmark("full_post_training")
def full_post_training() -> Iterator[Row]:
    """Benchmark of π0.5's full size on one GPU: a decision of 128 environments and the paper's optimiser step of 512 decisions,
    in micro-batches of 4, without the physics. Weights and observations are random: time and memory are measured."""
    import torch

    if not torch.cuda.is_available():
        print("  full_post_training needs a GPU: nothing measured")
        return
    gpu = torch.cuda.get_device_name()
    torch.backends.cuda.matmul.allow_tf32 = True  # --policy.tf32=true
    yield from post_training_rows(
        "full", "cuda", f"TF32, {gpu}", num_envs=128, num_decisions=512
    )
    torch.backends.cuda.matmul.allow_tf32 = False
    yield from post_training_rows(
        "full", "cuda", f"float32, {gpu}", num_envs=32, num_decisions=32
    )


def post_training_rows(
    backbone: str, device: str, where: str, *, num_envs: int, num_decisions: int
) -> Iterator[Row]:
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
    micro_batch = min(4, num_envs)
    policy = random_policy(backbone, device, tactile=True)
    sde = FlowSDE(FlowSDESettings())
    actor = TactileFlowPolicy(policy, PolicySettings(), sde.num_steps)
    batch = random_batch(num_envs, device, prompt_tokens=200)
    batch = {
        k: (x * 255).to(torch.uint8) if "images" in k else x
        for k, x in batch.items()
        if k != "action"
    }
    generator = torch.Generator().manual_seed(0)
    groups = [
        {k: x[rows] for k, x in batch.items()}
        for rows in torch.arange(num_envs).split(32)
    ]  # in memory at once
    draws = sde.draw(
        num_envs,
        (policy.config.chunk_size, policy.config.max_action_dim),
        generator,
        device,
    )

    def decide() -> tuple[Any, ...]:
        parts = torch.arange(num_envs, device=device).split(32)
        return tuple(
            actor.sample(group, sde, draws.rows(part))
            for group, part in zip(groups, parts, strict=True)
        )

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
    yield Row.of(
        times_s,
        name=f"one decision of {num_envs} environments, policy alone, {label}",
        unit="s",
    )
    if cuda:
        peak_gb = torch.cuda.max_memory_allocated() / 1e9
        yield Row.of([peak_gb], name=f"GPU memory of it, {label}", unit="GB")

    sampled, features = zip(*decide(), strict=True)
    repeats = num_decisions // num_envs
    many = torch.arange(num_envs, device=device).repeat(repeats)
    before, after, log_prob = (
        torch.cat([getattr(s, k) for s in sampled])[many]
        for k in ("before_BSHD", "after_BSHD", "log_prob_B")
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
        PPOSettings(
            batch_size=num_decisions, micro_batch=micro_batch, kl_stop=math.inf
        ),
    )
    ppo.ratio_guard = math.inf
    if cuda:
        torch.cuda.reset_peak_memory_stats()
    found: list[dict[str, float]] = []
    times_s = [
        timed(lambda: found.append(ppo.update(decisions, generator))) for _ in range(3)
    ][1:]
    yield Row.of(
        times_s,
        name=f"one optimiser step of {num_decisions} decisions and the KL after it, micro-batches of {micro_batch}, {label}",
        unit="s",
    )
    yield Row.of(
        [found[0]["first_ratio_error"]],
        name=f"largest |ratio − 1| before the first step, {label}",
        unit="1",
    )
    if cuda:
        peak_gb = torch.cuda.max_memory_allocated() / 1e9
        name = f"GPU memory of it: weights, gradients, AdamW, activations, {label}"
        yield Row.of([peak_gb], name=name, unit="GB", goal="< 80")

"""Benchmark of the environments that collect rollouts for post-training. ``make bench ONLY=rollout_shards``."""

import dataclasses
import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from statistics import median
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode

from taccorl.benchmark import Row, benchmark, spread
from taccorl.rl.remote_shards import ProcessShard
from taccorl.rl.twin_shard import Shard
from taccorl.sim.benchmarks import NUM_SIMS, REPEATS, holding
from taccorl.sim.twin import TwinConfig
from taccorl.sim.vector_env import TaccorlVectorEnv

_ACTIONS = 16  # of a chunk


def _process_shard(numbers: np.ndarray, num_threads: int) -> ProcessShard:
    envs: dict[str, Any] = {
        "task": "assembly_1",
        "num_envs": len(numbers),
        "twin": TwinConfig(),
        "num_threads": num_threads,
        "autoreset": AutoresetMode.DISABLED,
    }
    shard: dict[str, Any] = {"history": 10, "images": False, "privileged": True, "first": int(numbers[0])}
    return ProcessShard(envs, shard, (0.0, 1))


@benchmark("rollout_shards")
def rollout_shards() -> Iterator[Row]:
    """Chunks of 16 actions and what is observed after them, parts in both hands, in one process with all threads and in as many
    processes as CPUs, against the same physics steps alone in one process; wall time, in turns."""
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
        shards: Sequence[Shard] = [_process_shard(part, cpus // num) for part in parts]
        states = []
        for shard, part in zip(shards, parts, strict=True):
            shard.restart(0)
            snapshot = sim.snapshot(part)
            fields = {f.name: getattr(snapshot, f.name) for f in dataclasses.fields(snapshot)}
            states.append(shard.state_dict() | {"snapshot": fields})
        pool = ThreadPoolExecutor(num)

        def work(shard: Shard, part: np.ndarray) -> None:
            shard.act(chunks[part])
            shard.observe()

        def measure() -> float:
            list(pool.map(lambda shard, state: shard.load_state_dict(state), shards, states))
            before = time.perf_counter()
            list(pool.map(work, shards, parts))
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

"""One expert episode of assembly_1, made once: an action file, and states from its middle and from just before its success."""

import functools
from dataclasses import dataclass, fields

import numpy as np

from taccorl.sim.simulation import Simulation, Snapshot
from taccorl.sim.task import tasks
from taccorl.tasks.experts import expert_of

SEED = 0
MIDDLE = 240  # control steps: both parts are in the hands


@dataclass(frozen=True)
class ExpertEpisode:
    """Of scene ``SEED``."""

    actions: np.ndarray  # (T, 14) float32; the last one completes the task
    middle: Snapshot  # After ``MIDDLE`` actions
    late: Snapshot  # After all but three


@functools.cache
def expert_episode() -> ExpertEpisode:
    sim = Simulation(tasks.get("assembly_1")())
    sim.reset([SEED])
    expert = expert_of(sim.task)(sim, np.random.default_rng([SEED, 7]))
    expert.start()
    actions, states = [], []
    while not sim.judge.outcome.over[0]:
        states.append(sim.snapshot())
        actions.append(expert.act())
        sim.step(actions[-1][None])
    assert sim.judge.outcome.success[0], (
        "the expert's scene for these tests must be one where it succeeds"
    )
    return ExpertEpisode(np.array(actions), states[MIDDLE], states[-3])


def together(*states: Snapshot) -> Snapshot:
    """Rows of several snapshots as one."""

    def join(values: list) -> object:
        if isinstance(values[0], dict):
            return {name: join([v[name] for v in values]) for name in values[0]}
        return np.concatenate(values)

    return Snapshot(
        **{f.name: join([getattr(s, f.name) for s in states]) for f in fields(Snapshot)}
    )

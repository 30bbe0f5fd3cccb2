"""Evaluate a generation: yield under all acceptance criteria, cost, and whether kept episodes are reproduced. All simulated."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from pipelines.benchmarks.expert_score import Score
from taccorl.episodes.sources.mimicgen.attempt import Attempts, Generated
from taccorl.episodes.sources.mimicgen.source import Source, SourcePool
from taccorl.episodes.sources.mimicgen.spec import MimicSpec
from taccorl.episodes.sources.mimicgen.stored import state_digest
from taccorl.lineage.processes import cpu_s
from taccorl.sim.controller import ControllerConfig
from taccorl.sim.simulation import Simulation
from taccorl.sim.task import tasks
from taccorl.sim.twin import CONTROL_HZ, TwinConfig


def score_generation(
    spec: MimicSpec,
    sources: Sequence[Source],
    twin: TwinConfig,
    num_attempts: int,
    *,
    seed: int = 0,
    check: bool = False,
) -> Score:
    """Run attempts 0 … ``num_attempts`` − 1 in ``twin`` as ``taccorl augment`` does, without pictures, and return their score.

    Args:
        sources: source demonstrations, from any twin.
        check: execute kept attempts again in a second simulation, for ``Score.broken``.
    """
    sim, other = (Simulation(tasks.get(spec.task)(), twin) for _ in range(2))
    attempts, score = Attempts(SourcePool(spec, sources), sim, seed), Score()
    for k in range(num_attempts):
        before_s = cpu_s()
        done = attempts.run(k)
        score.cpu_s.append(cpu_s() - before_s)
        if done.success:
            score.duration_s.append(len(done.actions) / CONTROL_HZ)
            if check:
                score.broken += not _holds(other, done)
        score.outcomes.append(done.outcome)
    return score


def _holds(sim: Simulation, done: Generated) -> bool:
    """Whether an attempt's stored actions end where it did, in place."""
    sim.reset([done.scene_seed])
    for action in done.actions:
        sim.step(action[None].astype(np.float64))
    return bool(state_digest(sim) == done.last_state and sim.task.look(sim).goal[0])


def stiffened(twin: TwinConfig, factor: float) -> TwinConfig:
    """The twin with ``factor`` times the stiffness K_p in every joint of both arms; K_d and T_ref stay."""

    def controller(of: ControllerConfig) -> ControllerConfig:
        return dataclasses.replace(
            of, kp_nm_per_rad=[factor * kp for kp in of.kp_nm_per_rad]
        )

    arms = {arm: controller(of) for arm, of in twin.arm_controllers.items()}
    return dataclasses.replace(
        twin, controller=controller(twin.controller), arm_controllers=arms
    )

"""Evaluate a task's expert: success, cost, contact forces. All simulated."""

from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from taccorl.episodes.attempt import outcome_of
from taccorl.episodes.sources.collect import CollectPlan
from taccorl.episodes.sources.expert import ExpertSource
from taccorl.errors import UnreachableError
from taccorl.lineage.processes import cpu_s
from taccorl.sim.simulation import Watch
from taccorl.sim.twin import CONTROL_HZ
from taccorl.tasks.experts import expert_of


@dataclass
class Score:
    """Success, cost and contact forces of a number of episodes, or of attempts to generate one, of one task."""

    outcomes: list[str] = field(default_factory=list)
    cpu_s: list[float] = field(default_factory=list)
    """CPU time of each episode [s], without pictures."""
    duration_s: list[float] = field(default_factory=list)
    """Duration of each episode; of generated ones, of those that succeeded [s]."""
    corrections: list[int] = field(default_factory=list)
    """Number of corrections by touch in each episode."""
    penetration_m: list[float] = field(default_factory=list)
    """Deepest penetration between mating parts in each episode [m]."""
    force_n: list[float] = field(default_factory=list)
    """Largest force between mating parts in each episode [N]."""
    broken: int = 0
    """Number of generated episodes whose actions, in a new simulation, end in another state or without reaching the goal."""

    @property
    def success_rate(self) -> float:
        return self.outcomes.count("success") / len(self.outcomes)

    @property
    def failures(self) -> dict[str, int]:
        """Failure category, such as ``timeout`` or ``dropped`` → number of episodes that ended so, the most frequent first."""
        return dict(Counter(o for o in self.outcomes if o != "success").most_common())


def score_expert(
    task: str,
    num_episodes: int,
    *,
    difficulty: str = "train",
    seed: int = 0,
    every_step: bool = False,
) -> Score:
    """Run the expert of ``task`` as ``taccorl collect`` does, under the paper's randomisation, and return success, cost and
    contact forces.

    Args:
        every_step: measure contacts after every physics step, not only after every control step, since peaks last less than a
            millisecond. This adds half to the cost, so that costs are measured without it.
    """
    plan = CollectPlan(task=task, difficulty=difficulty, seed=seed)
    assert isinstance(plan.source, ExpertSource)
    sim = plan.make()
    score = Score()
    for k in range(num_episodes):
        before = cpu_s()
        episode_seed = plan.attempt_seed(k)
        sim.reset([episode_seed])
        expert = expert_of(sim.task)(
            sim, np.random.default_rng([episode_seed, 1]), plan.source.hands
        )
        expert.start()
        depth_m = force_n = 0.0

        def look(_: int) -> None:
            nonlocal depth_m, force_n
            for pair in sim.task.mating:
                contact = sim.contact(*pair)
                depth_m, force_n = (
                    max(depth_m, contact.penetration_m[0]),
                    max(force_n, contact.force_n[0]),
                )

        steps = (
            range(1, sim.config.physics.steps_per_control_step + 1)
            if every_step
            else ()
        )
        outcome = ""
        while not sim.judge.outcome.over[0] and not outcome:
            try:
                action = expert.act()
            except UnreachableError:
                outcome = "unreachable"
                continue
            sim.step(action[None].astype(float), watch=Watch(steps, look))
            look(0)
        score.outcomes.append(outcome or outcome_of(sim))
        score.cpu_s.append(cpu_s() - before)
        score.duration_s.append(sim.judge.steps[0] / CONTROL_HZ)
        score.corrections.append(len(expert.events))
        score.penetration_m.append(depth_m)
        score.force_n.append(force_n)
    return score

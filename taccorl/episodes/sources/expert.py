"""``--source.type=expert``: the task's scripted expert demonstrates."""

from dataclasses import dataclass, field

import numpy as np

from taccorl.episodes.attempt import Actions, Source, Targets
from taccorl.sim.simulation import Simulation
from taccorl.sim.twin import CONTROL_HZ
from taccorl.tasks.experts import expert_of
from taccorl.tasks.experts.hands import ScriptedExpertConfig
from taccorl.tasks.experts.scripted import ScriptedExpert

AFTER_S = 1.0  # an attempt whose demonstrator has finished is watched for so long


@Source.register_subclass("expert")
@dataclass(frozen=True, kw_only=True)
class ExpertSource(Source):
    """The task's scripted expert, with human-like errors that it corrects when it is blocked."""

    hands: ScriptedExpertConfig = field(default_factory=ScriptedExpertConfig)
    """Speeds and human-like errors of the expert's hands."""

    def actions(self, sim: Simulation, rng: np.random.Generator) -> Actions:
        expert = expert_of(sim.task)(sim, rng, self.hands)
        expert.start()
        yield from targets_of(expert)


def targets_of(expert: ScriptedExpert) -> Actions:
    """Targets of an expert that has been started, up to ``AFTER_S`` after it has finished."""
    after = 0
    while after < round(AFTER_S * CONTROL_HZ):
        after += expert.done
        action = expert.act()
        yield Targets(action, expert.intended(action))

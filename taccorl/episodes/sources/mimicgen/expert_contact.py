"""``contact_mode: closed_loop_expert``: in contact the task's scripted expert moves the hands instead of the source.

A source's motion does not react to contact. The expert detects a block from how far the hand is pushed back, backs off and aims
again, so that actions depend on contact. Its aiming error and tremor are drawn from the attempt's generator.
"""

from collections.abc import Mapping

import numpy as np

from taccorl.episodes.sources.mimicgen.director import ArmTarget
from taccorl.sim.simulation import Simulation
from taccorl.tasks.experts import expert_of


class ExpertContact:
    """``ContactHands`` by the scripted expert of one attempt. Returns poses of the hands; the caller corrects the steady-state
    joint offset."""

    def __init__(self, sim: Simulation, rng: np.random.Generator) -> None:
        """After a reset."""
        self._expert = expert_of(sim.task)(sim, rng)
        self._expert.stand_by()

    @property
    def corrections(self) -> list[tuple[int, str]]:
        return self._expert.events

    def take(self, arm: str, subtask: str, arm_target: ArmTarget) -> None:
        self._expert.take_over(arm, subtask, arm_target.goal, arm_target.opening_m)

    def step(self) -> Mapping[str, ArmTarget]:
        expert = self._expert
        if expert.done:
            expert.step_count += 1
            return {}
        expert.act()
        hands = {arm: expert.hands[arm] for arm in expert.running}
        return {
            arm: ArmTarget(
                goal=hand.goal, opening_m=hand.opening_m, contact=not hand.learns, noisy=False, intended=hand.intended
            )
            for arm, hand in hands.items()
        }

"""``contact_mode: closed_loop_expert``: the task's scripted expert moves the hands in contact, in the source's stead.

A source's motion feels nothing: what the pads read follows from the actions. The expert notices a block by how far the hand is
pushed back, backs off and aims again, so here actions follow from touch, too. It aims with a human error of its own, and its
hands tremble: both drawn from the attempt's generator.
"""

from collections.abc import Mapping

import numpy as np

from taccorl.demos.experts import experts
from taccorl.demos.mimicgen.director import Wish
from taccorl.sim.simulation import Simulation


class ExpertContact:
    """One attempt's expert. It says where the hands are to be; whoever executes it knows how far from a command they rest."""

    def __init__(self, sim: Simulation, rng: np.random.Generator) -> None:
        """After a reset."""
        self._expert = experts.get(sim.task.name)(sim, rng)
        self._expert.stand_by()

    @property
    def corrections(self) -> list[tuple[int, str]]:
        """(row of the action, what was felt)."""
        return self._expert.events

    def take(self, arm: str, subtask: str, wish: Wish) -> None:
        """From the coming control step to the end of that subtask; ``wish`` was the arm's last."""
        self._expert.take_over(arm, subtask, wish.goal, wish.opening_m)

    def step(self) -> Mapping[str, Wish]:
        """Once a control step: what each arm that has not finished is to do."""
        expert = self._expert
        if expert.done:
            expert.step_count += 1
            return {}
        expert.act()
        hands = {arm: expert.hands[arm] for arm in expert.running}
        return {
            arm: Wish(goal=hand.goal, opening_m=hand.opening_m, contact=not hand.learns, noisy=False)
            for arm, hand in hands.items()
        }

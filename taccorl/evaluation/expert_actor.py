"""The scripted expert of a task as an actor: a reference that sees the simulator's true poses."""

import numpy as np

from taccorl.episodes.attempt import Actions
from taccorl.episodes.sources.expert import ExpertSource
from taccorl.errors import UnreachableError
from taccorl.evaluation.rollouts import Acted
from taccorl.robots import ROBOT
from taccorl.sim.spaces import Observation
from taccorl.sim.vector_env import TaccorlVectorEnv

EXPERT = "expert"


class ExpertActor:
    """The scripted expert of a task as an ``Actor`` of rollouts, with the same random numbers in a scene as in ``taccorl
    collect``."""

    name = EXPERT
    needs_images = False
    needs_part_poses = False
    max_batch: int | None = 1
    """Largest number of environments: 1, because an expert drives one simulation."""

    def __init__(self) -> None:
        self._source = ExpertSource()
        self._actions: Actions = iter(())

    def looks_now(self) -> bool:
        """False: the expert uses no pictures."""
        return False

    def restart(self, stream: int = 0) -> None:
        """Does nothing: random numbers follow from the scene's seed."""

    def begin(self, envs: TaccorlVectorEnv, pictures: str) -> None:
        """Start the expert's script in the new episode. Raises TaccorlError: more than one environment, or a task without an
        expert."""
        self._actions = self._source.actions(
            envs.sim, np.random.default_rng([int(envs.sim.seeds[0]), 1])
        )

    def act(self, observation: Observation) -> Acted:
        """Next actions. At a pose that no joint angles reach the expert gives up as ``unreachable``, at the end of its script as
        ``unfinished``."""
        nothing = np.zeros((1, len(ROBOT.action_names)), dtype=np.float32)
        try:
            return Acted(np.asarray(next(self._actions).sent, dtype=np.float32)[None])
        except UnreachableError as error:
            return Acted(nothing, {0: ("unreachable", str(error))})
        except StopIteration:
            return Acted(
                nothing, {0: ("unfinished", "the script ended without success")}
            )

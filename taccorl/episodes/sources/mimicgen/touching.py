"""Contacts in a state of the twin, whether a hand grips a part, and whether something else holds that, too."""

import mujoco
import numpy as np

from taccorl.robots import ROBOT
from taccorl.sim.simulation import Simulation


class Touching:
    """Contacts of one stored state, computed by ``look``. Does not change the simulation."""

    def __init__(self, sim: Simulation) -> None:
        self.model, self.data, self._size = (
            sim.model,
            mujoco.MjData(sim.model),
            sim.batch.nstate,
        )
        bodies = [sim.model.body(i).name for i in sim.model.geom_bodyid]
        self._owner = [
            next((arm for arm in ROBOT.arms if name.startswith(arm)), name)
            for name in bodies
        ]
        """Geom → name of its owner: an arm, a part, a clamped body, or the table (``world``)."""
        pads = {f"{arm}_pad_{finger}" for arm in ROBOT.arms for finger in ROBOT.fingers}
        self._pad = [name if name in pads else "" for name in bodies]
        """Geom → its pad; "" for all others."""
        self._parts = sim.task.parts
        self.pairs: set[frozenset[str]] = set()
        self._padded: set[tuple[str, str]] = set()

    def look(self, row: np.ndarray) -> None:
        """Set ``data`` to a stored row (row_size,) of ``Simulation.state_rows``, and compute which bodies touch in it."""
        mujoco.mj_setState(
            self.model,
            self.data,
            row[1 : 1 + self._size],
            mujoco.mjtState.mjSTATE_INTEGRATION,
        )
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_collision(self.model, self.data)
        geoms = [contact.geom.tolist() for contact in self.data.contact]
        self.pairs = {frozenset((self._owner[a], self._owner[b])) for a, b in geoms}
        both = [*geoms, *((b, a) for a, b in geoms)]
        self._padded = {(self._pad[a], self._owner[b]) for a, b in both if self._pad[a]}

    def free(self, part: str) -> bool:
        """True if the body ``part`` touches nothing except arms."""
        return all(pair & set(ROBOT.arms) for pair in self.pairs if part in pair)

    def holds(self, arm: str, part: str) -> bool:
        """Whether both pads of the arm touch the body ``part``."""
        return all(
            (f"{arm}_pad_{finger}", part) in self._padded for finger in ROBOT.fingers
        )

    def holds_fast(self, arm: str) -> bool:
        """Whether the arm touches a part that something else touches too. Such a hand cannot reach its target, so that its
        offset must not be estimated: a corrected command would push ever harder."""
        held = [part for part in self._parts if {arm, part} in self.pairs]
        return any(
            part in pair and arm not in pair for part in held for pair in self.pairs
        )

"""Base of tasks in which the left hand lifts a part with a hole, the right hand a plug, and the plug is inserted in the air.

Both parts lie on the table at first, their axes along y.
"""

from abc import abstractmethod
from collections.abc import Callable

import mujoco
import numpy as np

from taccorl.sim.part import Fit, Part, add_part, measure_fit, on_table
from taccorl.sim.randomize import OBJECT_FRICTION, symmetric
from taccorl.sim.task import Reset, Scene, Subtask, Task, at_rest

HOLDER_AT_M, PLUG_AT_M = (0.30, 0.14), (0.30, -0.16)  # of their mating ends, nominal
LIFTED_M = 0.03
"""Height of a part's origin above the table above which it counts as lifted [m]."""


class AirAssembly(Task):
    """Base of both assembly tasks. Subclasses define the two parts, the hole, and when the plug is in place."""

    home_rad = {  # noqa: RUF012
        "left": (0.003, 1.732, -0.883, -0.528, 0.884, -1.213),
        "right": (-0.003, 1.732, -0.883, 0.528, 0.884, 1.213),
    }
    # The table says Δp ∈ [−0.03, 0.03] m for a part that stands on the table: x and y.
    rows = (
        OBJECT_FRICTION,
        symmetric("plug_position", (0.03, 0.03), "m"),
        symmetric("socket_position", (0.03, 0.03), "m"),
        symmetric("plug_mass", 0.03, "kg"),
        symmetric("socket_mass", 0.03, "kg"),
    )
    plug: Part
    """The part that is inserted, with the grasp ``head``."""
    holder: Part
    """The part with the hole, with the grasp ``tail``."""
    hole: str
    """Name of the hole in ``holder``."""

    @abstractmethod
    def is_in_place(self, scene: Scene, fit: Fit) -> np.ndarray:
        """(N,) bool: a released plug with these pose errors is where it belongs."""

    def add_parts(self, spec: mujoco.MjSpec) -> None:
        add_part(spec, self.plug)
        add_part(spec, self.holder)

    def reset(self, draw: dict[str, np.ndarray]) -> Reset:
        plug, holder = self.plug, self.holder
        return Reset(
            poses={
                plug.name: on_table(
                    plug, PLUG_AT_M + draw["plug_position"], -np.pi / 2
                ),
                holder.name: on_table(
                    holder, HOLDER_AT_M + draw["socket_position"], np.pi / 2
                ),
            },
            mass_change_kg={
                plug.name: float(draw["plug_mass"][0]),
                holder.name: float(draw["socket_mass"][0]),
            },
            friction=float(draw["friction"][0]),
        )

    def fit(self, scene: Scene) -> Fit:
        """Pose error of the plug in the hole, arrays (N,) for N simulations."""
        mate = self.plug.mate
        assert mate is not None
        hole = (
            scene.poses(self.holder.name) @ self.holder.holes[self.hole].part_from_hole
        )
        return measure_fit(
            hole, scene.poses(self.plug.name) @ mate.part_from_mate, mate.num_turns
        )

    def joined(self, scene: Scene) -> np.ndarray:
        """(N,) bool: the plug is in place, released and at rest."""
        done = np.asarray(~scene.pads_touching(self.plug.name).any(1))
        if done.any():
            done &= self.is_in_place(scene, self.fit(scene))
        return (
            done & at_rest(scene, self.plug.name, self.holder.name)
            if done.any()
            else done
        )

    def subtasks(self) -> dict[str, tuple[Subtask, ...]]:
        def lifted(part: str) -> Callable[[Scene], np.ndarray]:
            return lambda scene: scene.poses(part)[:, 2, 3] > LIFTED_M

        holder, plug = self.holder.name, self.plug.name
        return {
            "left": (
                Subtask(name=f"grasp {holder}", done=lifted(holder)),
                Subtask(name=f"hold {holder}", done=self.joined),
            ),
            "right": (
                Subtask(name=f"grasp {plug}", done=lifted(plug)),
                Subtask(name=f"insert {plug}", done=self.joined),
            ),
        }

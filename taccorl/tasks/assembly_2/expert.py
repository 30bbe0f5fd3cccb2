"""Assembly #2: the left hand holds the cradle, open side up; the right hand slides the plug in up to the stop, lowers it and
releases it."""

import numpy as np

from taccorl.tasks.air_assembly.expert import AirAssemblyExpert
from taccorl.tasks.experts.scripted import Mating, Script

_LET_DOWN_M, _LET_DOWN_MPS = (
    0.001,
    0.01,
)  # so that the cradle, not the hand, carries the plug before it is let go


class Assembly2Expert(AirAssemblyExpert):
    """Expert of assembly_2. The cradle is 34 mm deep; at its stop the plug's centre of mass is 15 mm inside."""

    enough_m = 0.032

    def world_from_level(self) -> np.ndarray:
        return np.array(
            [[-1.0, 0, 0], [0, 0, 1], [0, 1, 0]]
        ).T  # y, the open side, up; z into the cradle

    def push_in(self, mating: Mating) -> Script:
        yield from self.insert("right", mating, depth_m=0.036, enough_m=self.enough_m)
        down = self.hands["right"].pose.copy()
        down[2, 3] -= _LET_DOWN_M
        yield from self.move("right", down, speed_mps=_LET_DOWN_MPS)

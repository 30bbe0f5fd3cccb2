"""Scripted expert of assembly_1: the left hand holds the socket, the right hand inserts the plug by touch."""

import numpy as np

from taccorl.tasks.air_assembly.expert import AirAssemblyExpert
from taccorl.tasks.experts.scripted import Mating, Script


class Assembly1Expert(AirAssemblyExpert):
    """Expert of assembly_1. The mortise is 38 mm deep; the plug counts as inserted from 34 mm on."""

    enough_m = 0.0352

    def world_from_level(self) -> np.ndarray:
        return np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]).T  # x up, z into the hole

    def push_in(self, mating: Mating) -> Script:
        yield from self.insert("right", mating, depth_m=0.042, enough_m=self.enough_m)

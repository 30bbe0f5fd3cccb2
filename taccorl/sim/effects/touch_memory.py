"""Touch effects whose reading depends on earlier ones: one scan in the simulation, a whole recording in a replay."""

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from taccorl.sim.effects.effect import Memory, TouchEffect


@dataclass(kw_only=True)
class RememberingEffect(TouchEffect):
    """Base of touch effects with memory: they compute a whole sequence of scans at once; one scan is a sequence of length 1.

    A replay of a recording (``taccorl.alignment.touch.model``) thus needs one call instead of thousands, with the same code as
    the simulation. Other effects with a memory work too, called scan by scan.
    """

    holds_scan: ClassVar[bool] = True
    """True: the input is taken as constant since the scan before. False: it is taken as linear, or the path between scans has no
    influence."""

    @abstractmethod
    def scans(self, own: np.ndarray, memory: Memory, dt_s: np.ndarray) -> np.ndarray:
        """Readings of the chosen pads P in S consecutive scans, a new array (S, N, P, R, C) of the same type.

        Args:
            own: (S, N, P, R, C) readings of ideal pads.
            memory: arrays (N, …) with the state before the first scan; changed to the state after the last.
            dt_s: (S, N) time since the scan before.
        """

    def reading(self, reading: np.ndarray, memory: Memory, time_s: np.ndarray, dt_s: np.ndarray) -> np.ndarray:
        own = reading[:, self.slots]
        reading = reading.copy()
        reading[:, self.slots] = self.scans(own[None], memory, dt_s[None])[0]
        return reading

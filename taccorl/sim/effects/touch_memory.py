"""Touch effects whose reading depends on earlier ones: one scan in the simulation, a whole recording in a replay."""

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from taccorl.sim.effects.effect import Memory, TouchEffect


@dataclass(kw_only=True)
class RememberingEffect(TouchEffect):
    """Base of touch effects with memory: they compute a whole sequence of scans at once; one scan is a sequence of length 1.

    Thousands of calls for a recording become one (``taccorl.alignment.touch.model``), by the same code as in the simulation. An
    effect with a memory that is not of this class works as well, scan by scan.
    """

    holds_scan: ClassVar[bool] = True
    """Its input is held since the scan before; false where the path between scans changes nothing, or follows a line."""

    @abstractmethod
    def scans(self, own: np.ndarray, memory: Memory, dt_s: np.ndarray) -> np.ndarray:
        """Readings of the chosen pads P in S consecutive scans, a new array (S, N, P, R, C) of the same type.

        Args:
            own: (S, N, P, R, C) what ideal ones would read.
            memory: arrays (N, …) as before the first scan; left as after the last.
            dt_s: (S, N) since the scan before.
        """

    def reading(self, reading: np.ndarray, memory: Memory, time_s: np.ndarray, dt_s: np.ndarray) -> np.ndarray:
        own = reading[:, self.slots]
        reading = reading.copy()
        reading[:, self.slots] = self.scans(own[None], memory, dt_s[None])[0]
        return reading

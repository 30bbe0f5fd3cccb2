"""Recent positions of all bodies, for cameras whose pictures have a latency."""

import math

import mujoco
import numpy as np
from mujoco.batch import Batch

# states closer than this are not kept beside each other; between two, everything goes in a straight line
_GAP_S = 1 / 60


class PastScene:
    """Ring buffer with the positions of N simulations during the last ``longest_s``.

    Letters in shapes: H states kept, W numbers in each. ``batch``: the simulations' physics. ``longest_s``: age of the oldest
    positions that are requested [s]."""

    def __init__(self, batch: Batch, longest_s: float) -> None:
        self._live = [batch.bind(name) for name in ("qpos", "mocap_pos", "mocap_quat")]
        self._now_s = batch.bind("time")
        kept = math.ceil(longest_s / _GAP_S) + 2
        num_sims = len(self._now_s)
        self.positions = np.zeros(
            (num_sims, kept, self._positions(np.arange(num_sims)).shape[1])
        )
        """(N, H, W) positions, the newest last: joints, then clamped bodies."""
        self.time_s = np.zeros((num_sims, kept))
        """(N, H) times of the positions [s]."""

    def reset(self, ids: np.ndarray) -> None:
        """Fill the buffer of the simulations ``ids`` (n,) with the present positions: before the reset nothing moved."""
        self.positions[ids] = self._positions(ids)[:, None]
        self.time_s[ids] = (
            self._now_s[ids, None] - _GAP_S * np.arange(self.time_s.shape[1])[::-1]
        )

    def keep(self) -> None:
        """Store the present positions. They replace the newest stored ones until those are 1/60 s later than the ones before."""
        is_apart = (self.time_s[:, -1] - self.time_s[:, -2] >= _GAP_S * 0.999) & (
            self._now_s > self.time_s[:, -1]
        )
        for kept in (self.positions, self.time_s):
            kept[is_apart, :-1] = kept[is_apart, 1:]
        self.positions[:, -1] = self._positions(np.arange(len(self.time_s)))
        self.time_s[:, -1] = self._now_s

    def _positions(self, ids: np.ndarray) -> np.ndarray:
        return np.concatenate(
            [values[ids].reshape(len(ids), -1) for values in self._live], axis=1
        )


def place_past(
    data: mujoco.MjData, positions: np.ndarray, time_s: np.ndarray, age_s: float
) -> None:
    """Set the positions in ``data`` to those at ``age_s`` [s] before the newest of the stored states: ``positions`` (H, W) of one
    simulation of a ``PastScene``, with the times ``time_s`` (H,) [s]."""
    when = time_s[-1] - age_s
    after = int(np.clip(np.searchsorted(time_s, when), 1, len(time_s) - 1))
    span = time_s[after] - time_s[after - 1]
    share = np.clip((when - time_s[after - 1]) / span, 0.0, 1.0) if span > 0 else 1.0
    # Quaternions, too: MuJoCo normalises them, and in a sixtieth of a second they turn little.
    then = positions[after - 1] + share * (positions[after] - positions[after - 1])
    data.qpos[:], rest = then[: len(data.qpos)], then[len(data.qpos) :]
    data.mocap_pos[:] = rest[: data.mocap_pos.size].reshape(data.mocap_pos.shape)
    data.mocap_quat[:] = rest[data.mocap_pos.size :].reshape(data.mocap_quat.shape)

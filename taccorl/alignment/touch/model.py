"""Readings of the twin's pads in a matched contact replay: depth → law → effects → counts. Law (``normal_reading``) and
``reading`` hooks are those of the simulation. Effects that move a pad on its finger change the depth (``PadFrameEffect``);
effects on the mechanics of robot and parts have no influence, because all motion is the measured one.

Letters in shapes: T frames, P pads of the motion, B frames of a block, R × C taxels.
"""

import math
from collections.abc import Sequence

import numpy as np

from taccorl.alignment.touch.motion import TouchMotion
from taccorl.data.sensor_spec import load_sensor_spec
from taccorl.data.spec import find_spec
from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.effects.added import present
from taccorl.sim.effects.effect import Effect, Memory, TouchEffect
from taccorl.sim.effects.pads import PadFrameEffect
from taccorl.sim.effects.touch_memory import RememberingEffect
from taccorl.sim.sensors.flexitac import FlexiTacConfig, normal_reading
from taccorl.sim.twin import TwinConfig


class TouchModel:
    """The pads of a twin. ``config``: configuration of the twin, whose effects always act; those of ``simulate`` act in addition.
    Raises TaccorlError: the sensor is not FlexiTac."""

    def __init__(self, config: TwinConfig) -> None:
        if not isinstance(config.sensor, FlexiTacConfig):
            raise TaccorlError(
                f"touch model: only FlexiTac pads are supported, not {type(config.sensor).__name__}"
            )
        self.sensor = config.sensor
        self.spec = load_sensor_spec(find_spec(config.sensor.spec))
        self._own = list(config.effects)

    def simulate(
        self,
        motion: TouchMotion,
        stiffness_per_m: float,
        damping_s_per_m: float,
        effects: Sequence[Effect] = (),
        start_s: float | None = None,
    ) -> np.ndarray:
        """Simulate the readings (T, P, R, C) float32, scan by scan, from untouched pads.

        Args:
            stiffness_per_m: k_n [reading per metre].
            damping_s_per_m: k_d [reading per m/s].
            effects: effects besides the twin's own.
            start_s: start of the recording [s], if the motion lacks its first frames; by default the first frame.

        Raises TaccorlError: an effect is given twice for a pad, or an effect requires whole pads and the motion is cut."""
        acting = present([*self._own, *effects])
        depth, rate = motion.depth(_offsets(acting, motion.pads))
        shape = depth.shape[2:]
        acting = [e for e in acting if _reads(e)]
        if shape != motion.layout.shape:
            acting = [_within(e, motion.window) for e in acting]
        slots = [ROBOT.pads.index(pad) for pad in motion.pads]
        time_s = motion.time_s.mean(axis=1)
        time_s = time_s - (time_s[0] if start_s is None else start_s)
        dt_s = np.diff(time_s, prepend=time_s[0])
        memories = [_memory(effect, motion) for effect in acting]
        seen = np.empty(depth.shape, np.float32)
        # 0.4 MB, which a core's cache holds.
        at_once = 64 * ROBOT.num_taxels // (len(ROBOT.pads) * math.prod(shape))
        for start in range(0, len(time_s), at_once):
            some = slice(start, start + at_once)
            law = normal_reading(
                depth[some], rate[some], float(stiffness_per_m), float(damping_s_per_m)
            )
            if not acting:
                seen[some] = law
                continue
            reading = np.zeros((len(law), len(ROBOT.pads), *shape), np.float32)
            reading[:, slots] = law
            for effect, memory in zip(acting, memories, strict=True):
                reading = through(effect, reading, memory, time_s[some], dt_s[some])
            seen[some] = reading[:, slots]
        return seen

    def windowed(self, effects: Sequence[Effect]) -> bool:
        """True if a motion from ``TouchMotion.cut`` can be simulated with these effects in addition to the twin's own."""
        whole = (slice(None), slice(None))
        acting = [e for e in (*self._own, *effects) if _reads(e) and not e.is_absent]
        return all(
            isinstance(e, TouchEffect) and e.within(whole) is not None for e in acting
        )

    def remembers(self, effects: Sequence[Effect]) -> bool:
        """True if a frame's readings depend on earlier frames, through one of ``effects`` or of the twin's own."""
        shape = self.spec.rows, self.spec.columns
        return any(
            bool(e.memory(1, shape))
            for e in (*self._own, *effects)
            if _reads(e) and not e.is_absent
        )

    def counts(self, motion: TouchMotion, reading: np.ndarray) -> np.ndarray:
        """(T, P, R, C) counts above baseline for ``reading`` (T, P, R, C), without noise and rounding, limited to the ends of
        the converter."""
        low, high = -motion.baseline, self.spec.max_count - motion.baseline
        return np.clip(self.sensor.gain_count * reading, low, high, dtype=np.float32)


def _reads(effect: Effect) -> bool:
    """Whether it changes readings where the taxels' depths are known."""
    return type(effect).reading is not Effect.reading and effect.slot != "robot"


def _within(effect: Effect, window: tuple[slice, slice]) -> Effect:
    found = effect.within(window) if isinstance(effect, TouchEffect) else None
    if found is None:
        raise TaccorlError(
            f"touch model: effect {effect.name} requires whole pads, but the motion contains only a part of them"
        )
    return found


def _memory(effect: Effect, motion: TouchMotion) -> Memory:
    """State of the effects' memory before the first scan, for the taxels in the motion's window."""
    shape = motion.layout.shape
    return {
        name: np.ascontiguousarray(array[..., *motion.window])
        if array.shape[-2:] == shape
        else array
        for name, array in effect.memory(1, shape).items()
    }


def _offsets(
    effects: Sequence[Effect], pads: Sequence[str]
) -> tuple[tuple[float, float, float], ...]:
    """By how much the effects move the taxels of each pad, in its frame; empty if none does."""
    moving = [effect for effect in effects if isinstance(effect, PadFrameEffect)]
    if not moving:
        return ()
    own = ([e.offset_pad_m(pad) for e in moving if pad in e.pads] for pad in pads)
    return tuple(
        (float(x), float(y), float(z))
        for x, y, z in (np.sum([np.zeros(3), *o], axis=0) for o in own)
    )


def through(
    effect: Effect,
    reading: np.ndarray,
    memory: Memory,
    time_s: np.ndarray,
    dt_s: np.ndarray,
) -> np.ndarray:
    """Apply an effect to frames ``reading`` (B, P, R, C) of all pads, and advance its memory. Returns the changed frames.
    ``memory``: state after the frames before; {} for an effect without memory. Changed in place. ``time_s``, ``dt_s``: (B,) time
    since the first scan, and since the scan before [s]."""
    if not memory:
        return effect.reading(reading, memory, time_s, dt_s)
    if isinstance(effect, RememberingEffect):
        reading[:, effect.slots] = effect.scans(
            reading[:, effect.slots][:, None], memory, dt_s[:, None]
        )[:, 0]
        return reading
    rows = [slice(k, k + 1) for k in range(len(reading))]
    return np.concatenate(
        [effect.reading(reading[k], memory, time_s[k], dt_s[k]) for k in rows]
    )

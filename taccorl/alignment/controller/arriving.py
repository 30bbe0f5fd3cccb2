"""Commands that reach the control law after effects on targets (lag, loss, slew limit, delay), for ``joint_kernel``."""

import math
from typing import Any

import numba
import numpy as np

from taccorl.alignment.controller.drive_numbers import Drive
from taccorl.alignment.controller.lanes import LANES, compiled, decayed, holds, load, store, where
from taccorl.sim.effects import command

_PLACES = ("midpoint", "dropped_commands__seed", "command_delay__delay_s")
_MIDPOINT, _SEED, _DELAY = map(Drive._fields.index, _PLACES)
_mixed, _STRIDE = numba.njit(command.mixed), command.STRIDE


@compiled
def _uniform(seed: float, count: int) -> float:
    """``effects.command.uniform`` of one command, in episode 0."""
    bits = _mixed(_mixed(np.uint64(seed) << np.uint64(32)) + np.uint64(count + 1) * np.uint64(_STRIDE))
    return (bits >> np.uint64(11)) * 2.0**-53


@compiled
def arriving(p: Any, numbers: np.ndarray, sent: np.ndarray, hold: int, step_s: float) -> np.ndarray:
    """(S hold, LANES) what the controller works on in each physics step, of targets (S,) held for ``hold`` steps each."""
    held_s, count = hold * step_s, sent.size * hold
    lag_s, likely, apart = p.command_lag__time_constant_s, p.dropped_commands__probability, 1.0 / p.kp
    reached = where(lag_s > 0.0, 1.0 - decayed(held_s / max(lag_s, 1e-9))[0], 1.0)
    furthest, share = p.slew_limit__speed_rad_per_s * held_s, p.velocity_feedforward__share
    share = where((share != 0.0) & (p.kp > 0.0), share * p.kd * apart, 0.0)
    first = 0.0 * share + sent[0]
    lagging, goal, at, before = first, first, first, first
    commands, chance = np.empty((count, LANES)), np.ones((1, LANES))
    for k in range(sent.size):
        lagging += (sent[k] - lagging) * reached
        if holds(likely > 0.0):
            for lane in range(LANES):
                chance[0, lane] = _uniform(numbers[_SEED, lane], k)
        goal = where((likely <= 0.0) | (load(chance, 0) >= likely), lagging, goal)
        at = min(max(goal, at - furthest), at + furthest)
        now = at + share * (at - before) / held_s
        before = at
        for n in range(k * hold, (k + 1) * hold):
            store(commands, n, now)
    for lane in range(LANES):
        if numbers[_DELAY, lane] > 0.0:
            # MuJoCo reads its delay buffer before it writes the new value: the shortest delay is one physics step.
            late = max(numbers[_DELAY, lane] / step_s, 0.0 if numbers[_MIDPOINT, lane] > 0.0 else 1.0)
            whole = math.floor(late)
            own = commands[:, lane].copy()
            for n in range(count):
                newer = own[n - whole] if n >= whole else sent[0]
                older = own[n - whole - 1] if n > whole else sent[0]
                commands[n, lane] = newer + (older - newer) * (late - whole)
    return commands

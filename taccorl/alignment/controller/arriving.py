"""What reaches the control law, for ``joint_kernel``: commands after effects on targets (lag, loss, slew limit, delay), and how
late a sampled loop knows speed and position, by its transfer function to the second order in s.

A loop of period T takes its speed from two readings and holds its output; a filter of time constant τ may smooth the speed. Its
transfer function, 1 − D s + (τ² + τ T + 7/12 T²) s² with D = τ + T, is that of (1 − l s) / (1 + b s), which needs one state: a
low-pass w of the speed with time constant b. The damping acts on q̇ + (1 + l / b) (w − q̇). A difference of readings and a held
output have T² / 6 each, and T² / 4 together. A position that is held for T, K_p (q* − q + ½ T q̇ − T² / 6 q̈), is that of
``Drive`` but for an inertia.
"""

import math
from typing import Any

import numba
import numpy as np

from taccorl.alignment.controller.drive_numbers import Drive
from taccorl.alignment.controller.lanes import (
    LANES,
    compiled,
    decayed,
    holds,
    load,
    store,
    where,
)
from taccorl.sim.effects import command

_PLACES = ("midpoint", "dropped_commands__seed", "command_delay__delay_s")
_MIDPOINT, _SEED, _DELAY = map(Drive._fields.index, _PLACES)
_mixed, _STRIDE = numba.njit(command.mixed), command.STRIDE


@compiled
def _uniform(seed: float, count: int) -> float:
    """``effects.command.uniform`` of one command, in episode 0."""
    bits = _mixed(
        _mixed(np.uint64(seed) << np.uint64(32))
        + np.uint64(count + 1) * np.uint64(_STRIDE)
    )
    return (bits >> np.uint64(11)) * 2.0**-53


@compiled
def arriving(
    p: Any, numbers: np.ndarray, sent: np.ndarray, hold: int, step_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """(S hold, LANES) what the controller works on in each physics step, of targets (S,)
    held for ``hold`` steps each. In MuJoCo's twin, lag and slew limit act once per target;
    with ``Drive.midpoint`` they act within the drive: values at the middle of each step.

    Also (S hold, LANES) what its reported effort follows: the same, but no target is early
    (a delay below 0). Where a target steps, the effort of its row is still the old one's.
    """
    held_s, count = hold * step_s, sent.size * hold
    lag_s, likely, apart = (
        p.command_lag__time_constant_s,
        p.dropped_commands__probability,
        1.0 / p.kp,
    )
    reached = where(lag_s > 0.0, 1.0 - decayed(held_s / max(lag_s, 1e-9))[0], 1.0)
    furthest, share = (
        p.slew_limit__speed_rad_per_s * held_s,
        p.velocity_feedforward__share,
    )
    share = where((share != 0.0) & (p.kp > 0.0), share * p.kd * apart, 0.0)
    lagging = goal = at = before = 0.0 * share + sent[0]
    commands, chance = np.empty((count, LANES)), np.ones((1, LANES))
    in_drive = numbers[_MIDPOINT, 0] > 0.0 and (
        holds(lag_s > 0.0) or holds(furthest < math.inf)
    )
    for k in range(sent.size):
        lag_from, goal_from, at_from = lagging, goal, at
        lagging += (sent[k] - lagging) * reached
        if holds(likely > 0.0):
            for lane in range(LANES):
                chance[0, lane] = _uniform(numbers[_SEED, lane], k)
        comes = (likely <= 0.0) | (load(chance, 0) >= likely)
        goal = where(comes, lagging, goal)
        at = min(max(goal, at - furthest), at + furthest)
        lead = share * (at - before) / held_s
        now = at + lead
        before = at
        for n in range(hold):
            if in_drive:
                since = (n + 0.5) / hold
                left = decayed(since * held_s / max(lag_s, 1e-9))[0]
                now = sent[k] + (lag_from - sent[k]) * left
                now = where(comes, where(lag_s > 0.0, now, lagging), goal_from)
                reach = since * furthest
                now = min(max(now, at_from - reach), at_from + reach) + lead
            store(commands, k * hold + n, now)
    punctual = commands
    if np.any(numbers[_DELAY] < 0.0):
        punctual = commands.copy()
    for lane in range(LANES):
        late = numbers[_DELAY, lane] / step_s
        if late > 0.0 and numbers[_MIDPOINT, lane] <= 0.0:
            # MuJoCo reads its delay buffer before it writes the new value: the shortest delay is one physics step.
            late = max(late, 1.0)
        if late != 0.0:  # below 0: early
            whole = math.floor(late)
            own = commands[:, lane].copy()
            for n in range(count):
                at = min(n - whole, count - 1)
                newer = own[at] if at >= 0 else sent[0]
                older = own[at - 1] if at > 0 else sent[0]
                commands[n, lane] = newer + (older - newer) * (late - whole)
        if late > 0.0:
            punctual[:, lane] = commands[:, lane]
    return commands, punctual


@compiled
def late_speed(p: Any) -> Any:
    """Times and factors of ``Drive`` p: b [s]; 1 + l / b; lead of the speed [s], where its delay is below 0; inertia [s²] that
    each N·m/rad takes off. And of the effort that a row shows, one output that is older by ``effort_age``: the factor on q̇ − w,
    and the time [s] by which the speed's change is later than that."""
    smoothed, sampled = (
        max(p.speed_delay__delay_s, 0.0),
        p.speed_age + min(p.speed_delay__delay_s, 0.0),
    )
    sampled, lead_s = max(sampled, 0.0), min(sampled, 0.0)
    late_s = smoothed + sampled
    slow_s = (smoothed * late_s + 7.0 / 12.0 * sampled * sampled) / where(
        late_s > 0.0, late_s, 1.0
    )
    turned = where(slow_s > 0.0, late_s / where(slow_s > 0.0, slow_s, 1.0), 1.0)
    old_s = min(
        max(0.5 * sampled + p.effort_age, 0.0), 2.0 * sampled
    )  # of the mean speed of a period
    both_s = 0.5 * sampled + old_s
    second = (
        smoothed * (smoothed + both_s)
        + sampled * (sampled / 6.0 + 0.5 * old_s)
        + 0.5 * old_s * old_s
    )
    shown = where(
        sampled > 0.0, second / where(sampled > 0.0, slow_s * slow_s, 1.0), turned
    )
    stiff = sampled * (0.5 * late_s - sampled / 6.0)
    return (
        slow_s,
        turned,
        lead_s,
        stiff,
        shown,
        late_s + lead_s + p.effort_age - shown * slow_s,
    )

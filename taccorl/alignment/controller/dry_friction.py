"""Dry friction in a step of ``joint_kernel``, compiled with it: as good as rigid, and MuJoCo's own soft one."""

from typing import Any

from taccorl.alignment.controller.lanes import compiled, where
from taccorl.sim.effects.friction import (
    DRY_SHARE,
    DRY_TIME_S,
    SOFT_MOST,
    SOFT_SHARE,
    SOFT_TIME_S,
)

_FRICTION_RATE = 2.0 / (
    DRY_SHARE * DRY_TIME_S
)  # 1/s, MuJoCo's b = 2 / (d_max · time constant)
_FRICTION_SOFTNESS = (1.0 - DRY_SHARE) / DRY_SHARE
_SOFT_MASSES = SOFT_SHARE / (1.0 - SOFT_SHARE)


@compiled
def friction(
    force: Any, metric: Any, about: Any, v: Any, limit: Any, step_s: float
) -> Any:
    """MuJoCo's dry friction within ± ``limit`` on a mass ``metric`` under ``force``; ``about``: MuJoCo's estimate of it."""
    stiff = about * (1.0 / _FRICTION_SOFTNESS)
    reference = (-_FRICTION_RATE / (1.0 + step_s * _FRICTION_RATE)) * v
    return min(
        max((reference * metric - force) * stiff / (metric + stiff), -limit), limit
    )


@compiled
def soft_friction(
    p: Any,
    force: Any,
    metric: Any,
    about: Any,
    free: Any,
    v: Any,
    limit: Any,
    ahead_s: float,
    step_s: float,
) -> Any:
    """MuJoCo's soft dry friction f = −S (a + b v), within ± F, on a mass ``metric`` under ``force``
    beside rigid friction of ``friction`` within ± ``limit``. S is ``_SOFT_MASSES`` times ``free``,
    MuJoCo's estimate of the inertia; v is taken ``ahead_s`` later than now."""
    own_s = p.soft_friction__time_constant_s
    time_s = where(own_s > 0.0, max(own_s, 2.0 * step_s), SOFT_TIME_S)
    rate = 2.0 / (SOFT_MOST * time_s)
    later = 1.0 + ahead_s * rate
    stiff, reference = _SOFT_MASSES * later * free, -rate / later * v
    # Unclipped it is an inertia, under which the rigid friction is known. Beyond its limit it is
    # clipped in the solution as well, since the sum of both frictions falls with the acceleration.
    force += stiff * reference
    force += friction(force, metric + stiff, about, v, limit, step_s)
    soft = stiff * (reference - force / (metric + stiff))
    most = p.soft_friction__torque_nm
    return min(max(soft, -most), most)

"""How late a sampled loop knows speed and position: its transfer function to the second order in s, for ``joint_kernel``.

A loop of period T takes its speed from two readings and holds its output; a filter of time constant τ may smooth the speed. Its
transfer function, 1 − D s + (τ² + τ T + 7/12 T²) s² with D = τ + T, is that of (1 − l s) / (1 + b s), which needs one state: a
low-pass w of the speed with time constant b. The damping acts on q̇ + (1 + l / b) (w − q̇). A difference of readings and a held
output have T² / 6 each, and T² / 4 together. A position that is held for T, K_p (q* − q + ½ T q̇ − T² / 6 q̈), is that of
``Drive`` but for an inertia.
"""

from typing import Any

from taccorl.alignment.controller.lanes import compiled, where


@compiled
def late_speed(p: Any) -> Any:
    """Times and factors of ``Drive`` p: b [s]; 1 + l / b; lead of the speed [s], where its delay is below 0; inertia [s²] that
    each N·m/rad takes off. And of the effort that a row shows, one output that is older by ``effort_age``: the factor on q̇ − w,
    and the time [s] by which the speed's change is later than that."""
    smoothed, sampled = max(p.speed_delay__delay_s, 0.0), p.speed_age + min(p.speed_delay__delay_s, 0.0)
    sampled, lead_s = max(sampled, 0.0), min(sampled, 0.0)
    late_s = smoothed + sampled
    slow_s = (smoothed * late_s + 7.0 / 12.0 * sampled * sampled) / where(late_s > 0.0, late_s, 1.0)
    turned = where(slow_s > 0.0, late_s / where(slow_s > 0.0, slow_s, 1.0), 1.0)
    old_s = min(max(0.5 * sampled + p.effort_age, 0.0), 2.0 * sampled)  # of the mean speed of a period
    both_s = 0.5 * sampled + old_s
    second = smoothed * (smoothed + both_s) + sampled * (sampled / 6.0 + 0.5 * old_s) + 0.5 * old_s * old_s
    shown = where(sampled > 0.0, second / where(sampled > 0.0, slow_s * slow_s, 1.0), turned)
    stiff = sampled * (0.5 * late_s - sampled / 6.0)
    return slow_s, turned, lead_s, stiff, shown, late_s + lead_s + p.effort_age - shown * slow_s

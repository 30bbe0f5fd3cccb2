"""A sampled controller, as in real drives: finite difference of the encoder, low-pass, torque held between samples.

    w_k = w_{k−1} + a ((q_k − q_{k−1}) / T − w_{k−1}),   a = 1 − exp(−T / τ)
    u_k = K_p (q*_k − q_k) − K_d w_k + T_ref             held until k + 1

To first order in T and τ this is the continuous controller with K_d − K_p T / 2, on a joint of inertia J − K_d (T + τ): with
angles and a known J, all torques are overestimated by J / (J − K_d (T + τ)), and only their ratios to K_p are correct.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from taccorl.surrogate.plant import STEP_S

PERIODS_STEPS = (
    2,
    4,
    5,
    8,
    10,
    16,
)  # Numbers of integration steps between two samples: 4, 2, 1.6, 1, 0.8 and 0.5 kHz
FILTER_S = (3e-4, 3e-3)  # Range of the low-pass's time constant τ [s]: 530 to 53 Hz
MARGIN = 3.2
"""Factor on K_p and K_d at which the loop must still be stable: recordings at twice the gains, and 1.6 for hidden effects."""


@dataclass(frozen=True, kw_only=True)
class SampledLoop:
    """Timing of one drive's loop."""

    steps: int  # Number of integration steps (``STEP_S``) between two samples
    filter_s: float  # Time constant τ of the low-pass [s]

    @property
    def period_s(self) -> float:
        """Time between two samples, T [s]."""
        return self.steps * STEP_S

    @property
    def late_s(self) -> float:
        """Delay of the velocity due to period and low-pass [s], T + τ."""
        return self.period_s + self.filter_s


def draw_loop(rng: np.random.Generator, most_late_s: float = math.inf) -> SampledLoop:
    """Draw a loop with any rate and low-pass whose total delay is at most this. Stability with a drive is not checked."""
    periods = [
        steps for steps in PERIODS_STEPS if steps * STEP_S + FILTER_S[0] <= most_late_s
    ] or [PERIODS_STEPS[0]]
    steps = int(rng.choice(periods))
    longest_s = max(FILTER_S[0], min(FILTER_S[1], most_late_s - steps * STEP_S))
    return SampledLoop(
        steps=steps,
        filter_s=float(np.exp(rng.uniform(*np.log((FILTER_S[0], longest_s))))),
    )


def spectral_radius(
    loop: SampledLoop, kp: float, kd: float, inertia_kgm2: float
) -> float:
    """Largest modulus of the eigenvalues of the closed loop from one sample to the next; below 1 it is stable.

    State: angle, velocity, last reading, filtered velocity. Between samples the torque u is constant: q ← q + T v + T² u / 2J, v
    ← v + T u / J. ``kp``, ``kd``: K_p [N·m/rad] and K_d [N·m·s/rad]."""
    t, j = loop.period_s, inertia_kgm2
    a = 1.0 - math.exp(-t / loop.filter_s) if loop.filter_s > 0.0 else 1.0
    rate = np.array([a / t, 0.0, -a / t, 1.0 - a])
    torque = -kd * rate - np.array([kp, 0.0, 0.0, 0.0])
    step = np.array(
        [[1.0, t, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], rate]
    )
    step[0] += 0.5 * t**2 / j * torque
    step[1] += t / j * torque
    return float(np.abs(np.linalg.eigvals(step)).max())


def is_stable(
    loop: SampledLoop, kp: float, kd: float, inertias_kgm2: Sequence[float]
) -> bool:
    """True if the loop is stable at every gain up to ``MARGIN`` times these, for each inertia (in the play of a gear the motor
    moves alone). ``kp``, ``kd``: K_p [N·m/rad] and K_d [N·m·s/rad]."""
    gains = (1.0, 2.0, MARGIN)
    return all(
        spectral_radius(loop, f * kp, f * kd, inertia) < 1.0
        for f in gains
        for inertia in inertias_kgm2
    )

"""Flow-SDE: sampling of a flow-matching policy with a known probability (π_RL, arXiv 2510.25889, as the paper uses it).

LeRobot's flow runs from noise at t = 1 to the action at t = 0, in K Euler steps of length d = 1/K, t_k = 1 − k/K:

    x_t = t ε + (1 − t) a        v = dx_t/dt = ε − a        ε̂ = x_t + (1 − t) v        score = −ε̂ / t
    Euler        x ← x − d v
    stochastic   x ← x − d v − s_k² ε̂ / (2 t) + s_k N(0, 1),      s_k = level · √(d t / (1 − t))

with t = 1 read as t_1 in the denominator, so s_0 = level for every K; K = 4, level 0.5: s = 0.500, 0.433, 0.250, 0.144. Both
steps have the same marginals as K → ∞. A stochastic step is a Gaussian; its density is the policy's probability in PPO.

Noise is injected, and the density counted, in the scored numbers of a chunk only: executed steps, which are the first ones, and
real dimensions. Everything else takes Euler steps. With ``correlation`` ρ the noise of a dimension has the covariance
s_k² ((1 − ρ) I + ρ 1 1ᵀ) over its n executed steps: deviation s_k √(1 − ρ) about their mean, s_k √(1 + (n − 1) ρ) along it.
Without noise the result is that of the policy's own sampling, bit for bit.

Letters in shapes: B batch, H horizon, D padded action, K denoising steps, S stochastic steps (1 or K).
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from taccorl.rl.settings import FlowSDESettings

Velocity = Callable[[Tensor, Tensor], Tensor]
"""Velocity field: (x (B, H, D), t (B,)) → dx/dt (B, H, D)."""


class Draws(NamedTuple):
    """Random numbers of samples, drawn before sampling, so that rows can be computed in any grouping."""

    initial_BHD: Tensor
    """Initial noise: x at t = 1."""
    noise_BSHD: Tensor
    """Standard normal noise of the stochastic steps."""
    step_BS: Tensor
    """Index k of the denoising step that uses each noise, from 0; −1: unused."""

    def rows(self, rows: Any) -> "Draws":
        """The draws of the given rows (indices, mask or slice of B)."""
        return Draws(*(x[rows] for x in self))


class Sampled(NamedTuple):
    """Result of sampling; ``before`` and ``after`` are x around each stochastic step."""

    chunk_BHD: Tensor
    """Denoised chunk: x at t = 0, in normalised actions."""
    before_BSHD: Tensor
    after_BSHD: Tensor
    log_prob_B: Tensor
    """Log-density of the stochastic steps, summed over steps and scored numbers."""


class FlowSDE:
    """Sampler of action chunks by Flow-SDE: denoising in K steps, one or all of which add noise of known density. One function,
    ``mean``, gives the transition for sampling and for scoring."""

    def __init__(self, settings: FlowSDESettings) -> None:
        self.num_steps, self.level = settings.num_steps, settings.level
        self.correlation = settings.correlation
        every = range(settings.num_steps)
        self.steps = every[-1:] if settings.stochastic_steps == "last" else every
        """Indices k of the steps that may be stochastic."""
        self.num_stochastic = len(every) if settings.stochastic_steps == "all" else 1
        # Same operations, in the same order, as lerobot.policies.common.flow_matching.euler_integrate: results are bit-identical.
        self.dt = -1.0 / self.num_steps
        self.times = [1.0 + k * self.dt for k in range(self.num_steps)]

    @property
    def stds(self) -> list[float]:
        """Standard deviation s_k of the noise of each of the K denoising steps, in normalised actions."""
        rest = [1 - t if t < 1 else -self.dt for t in self.times]
        return [
            self.level * math.sqrt(-self.dt * t / r)
            for t, r in zip(self.times, rest, strict=True)
        ]

    def draw(
        self,
        num_rows: int,
        shape: tuple[int, ...],
        generator: torch.Generator,
        device: Any = "cpu",
    ) -> Draws:
        """Draw the random numbers for ``num_rows`` samples of ``shape`` (H, D), with ``generator`` on the CPU, so that they are
        the same for every device, and move them to ``device``."""
        initial = torch.randn(num_rows, *shape, generator=generator)
        noise = torch.randn(num_rows, self.num_stochastic, *shape, generator=generator)
        step = torch.arange(self.num_steps).expand(num_rows, -1)
        if self.num_stochastic == 1:
            step = torch.randint(
                self.steps[0], self.num_steps, (num_rows, 1), generator=generator
            )
        if self.level == 0:
            step = torch.full_like(step, -1)
        return Draws(initial.to(device), noise.to(device), step.to(device))

    def mean(
        self, x_BHD: Tensor, v_BHD: Tensor, k_B: Tensor, noisy_BHD: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return mean (B, H, D) and standard deviation (B, 1, 1) of a chunk after one denoising step, in normalised actions.

        ``x_BHD`` is the chunk before the step, ``v_BHD`` its velocity, ``k_B`` the index of the step for each chunk, from 0.
        Where ``noisy_BHD`` is False, the mean is that of Euler's step and the deviation does not apply."""
        t = torch.tensor(self.times, dtype=x_BHD.dtype, device=x_BHD.device)[k_B][
            :, None, None
        ]
        std = torch.tensor(self.stds, dtype=x_BHD.dtype, device=x_BHD.device)[k_B][
            :, None, None
        ]
        euler_BHD = x_BHD + self.dt * v_BHD
        noise_hat_BHD = x_BHD + (1 - t) * v_BHD
        return torch.where(
            noisy_BHD, euler_BHD - std**2 / (2 * t) * noise_hat_BHD, euler_BHD
        ), std

    def sample(self, velocity: Velocity, draws: Draws, scored_HD: Tensor) -> Sampled:
        """Sample chunks: denoise ``draws.initial_BHD`` with the stochastic steps of ``draws``. ``scored_HD`` (bool) marks the
        numbers of a chunk that get noise and count in the log-probability."""
        x, step_BS = draws.initial_BHD, draws.step_BS
        before, after = (
            torch.zeros_like(draws.noise_BSHD),
            torch.zeros_like(draws.noise_BSHD),
        )
        log_prob_B = x.new_zeros(len(x))
        for k in range(self.num_steps):
            s = k if self.num_stochastic > 1 else 0
            is_noisy_B11 = (step_BS[:, s] == k)[:, None, None]
            noisy_BHD, k_B = (
                is_noisy_B11 & scored_HD,
                torch.full((len(x),), k, device=x.device),
            )
            mean, std = self._step(velocity, x, k_B, noisy_BHD)
            noise_BHD = draws.noise_BSHD[:, s]
            if self.correlation:
                about, along = self._deviations(scored_HD)
                noise_BHD = _scaled(noise_BHD, scored_HD, about, along)
            new = torch.where(noisy_BHD, mean + std * noise_BHD, mean)
            before[:, s] = torch.where(is_noisy_B11, x, before[:, s])
            after[:, s] = torch.where(is_noisy_B11, new, after[:, s])
            log_prob_B = log_prob_B + self._log_density(
                new, mean, std, noisy_BHD, scored_HD
            )
            x = new
        return Sampled(x, before, after, log_prob_B)

    def log_prob(
        self,
        velocity: Velocity,
        before_BSHD: Tensor,
        after_BSHD: Tensor,
        step_BS: Tensor,
        scored_HD: Tensor,
    ) -> Tensor:
        """(B,) log-density of stored stochastic steps, summed over steps and scored numbers; differentiable in ``velocity``."""
        total_B = before_BSHD.new_zeros(len(before_BSHD))
        for s in range(self.num_stochastic):
            x, k_B = before_BSHD[:, s], step_BS[:, s]
            noisy_BHD = (k_B >= 0)[:, None, None] & scored_HD
            mean, std = self._step(velocity, x, k_B, noisy_BHD)
            total_B = total_B + self._log_density(
                after_BSHD[:, s], mean, std, noisy_BHD, scored_HD
            )
        return total_B

    def _step(
        self, velocity: Velocity, x_BHD: Tensor, k_B: Tensor, noisy_BHD: Tensor
    ) -> tuple[Tensor, Tensor]:
        t_B = torch.tensor(self.times, dtype=torch.float32, device=k_B.device)[k_B]
        return self.mean(x_BHD, velocity(x_BHD, t_B), k_B, noisy_BHD)

    def _deviations(self, scored_HD: Tensor) -> tuple[float, Tensor]:
        """Standard deviations of correlated noise, for s_k = 1: of a step about the mean of its dimension, and (D,) along it."""
        steps_D = scored_HD.sum(0)
        along_D = (1 + (steps_D - 1) * self.correlation).clamp(min=1.0).sqrt()
        return math.sqrt(1 - self.correlation), along_D

    def _log_density(
        self,
        x_BHD: Tensor,
        mean_BHD: Tensor,
        std: Tensor,
        counted_BHD: Tensor,
        scored_HD: Tensor,
    ) -> Tensor:
        """(B,) log-density of what is counted: all ``scored_HD`` of a row, or nothing of it."""
        # level 0: nothing is counted
        std = std.clamp(min=torch.finfo(x_BHD.dtype).tiny)
        z = (x_BHD - mean_BHD) / std
        wider_B = 0.0
        if self.correlation:
            about, along_D = self._deviations(scored_HD)
            z = _scaled(z, scored_HD, 1 / about, 1 / along_D)
            others_D = (scored_HD.sum(0) - 1).clamp(min=0)
            log_det = (others_D * math.log(about) + along_D.log()).sum()
            wider_B = counted_BHD.any(dim=2).any(dim=1) * log_det
        densities = -0.5 * z * z - std.log() - 0.5 * math.log(2 * math.pi)
        return torch.where(counted_BHD, densities, 0.0).sum(dim=(1, 2)) - wider_B


def _scaled(z_BHD: Tensor, scored_HD: Tensor, about: float, along_D: Tensor) -> Tensor:
    """Scale the scored steps of each dimension about their mean, and the mean: the root of a covariance of two values."""
    z_BHD = z_BHD * scored_HD
    mean_B1D = z_BHD.sum(1, keepdim=True) / scored_HD.sum(0).clamp(min=1)
    return about * (z_BHD - mean_B1D) + along_D * mean_B1D

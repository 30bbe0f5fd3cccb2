"""Contact gate of the paper (eq. 5): whether any pad is in contact."""

import torch

CONTACT_THRESHOLD = (
    0.4  # λ_f, paper's co-training table; with fixed_scale 1/75 a count it is 30 counts
)
MIN_ACTIVE = 1  # m, paper's co-training table

# B batch, L history, K taxels


def contact(
    readings_BLK: torch.Tensor, threshold: float, min_active: int
) -> torch.Tensor:
    """(B,) bool: c_t = [max over the window of Σ_k [|f_rk| > λ_f] ≥ m].

    Args:
        readings_BLK: normalised readings; all dimensions after L are taxels.
        threshold: λ_f, in normalised readings.
        min_active: m, number of taxels that must be above it in the same reading.
    """
    active_BL = (readings_BLK.abs() > threshold).flatten(2).sum(-1)
    return active_BL.amax(1) >= min_active

"""Find an encoder's resolution q from its readings alone [in their unit]: readings are offset + n · q with integers n."""

import numpy as np


def find_quantum(values: np.ndarray) -> float:
    """Step q of readings ``values`` (T,), in their unit; 0 if they show none (or have only one level). NaN are ignored.

    q is the smallest difference between two levels, refined over the differences d of all neighbouring levels: q = Σ d / Σ
    round(d / q).
    """
    values = np.asarray(values, dtype=float)
    values = values[np.isfinite(values)]
    if len(values) < 2:
        return 0.0
    levels = np.unique(values)
    # The same level computed in two ways differs in the last bits of a 64-bit number.
    apart = np.diff(levels) > 1e-12 * max(1.0, float(np.abs(levels).max()))
    levels = levels[np.concatenate([[True], apart])]
    steps = np.diff(levels)
    # Eight differences are whole multiples by chance once in 10⁸ (0.1⁸). Of fewer levels
    # each must occur ten times: noise without steps never gives one reading twice.
    if len(steps) == 0 or (len(steps) < 8 and len(values) < 10.0 * len(levels)):
        return 0.0
    quantum = float(steps.min())
    near = steps[
        steps < 10 * quantum
    ]  # where a rounded multiple is sure before the step is known well
    quantum = float(near.sum() / np.round(near / quantum).sum())
    counts = np.round(steps / quantum)
    quantum = float(steps.sum() / counts.sum())
    # A difference that deviates from a whole number of steps by less than 5 % of one
    # counts as such: readings stored as 32-bit numbers deviate by up to 1 % of 0.001°.
    return (
        quantum
        if (
            np.abs(steps / quantum - counts) < 0.05 * np.maximum(1.0, counts * 1e-3)
        ).all()
        else 0.0
    )

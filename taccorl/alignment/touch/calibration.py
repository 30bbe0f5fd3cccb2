"""Tactile calibration, paper App. B.2: λ_noise from readings without contact, then (k_n, k_d) on matched contact replays.

Counts of all taxels near the object are fitted (``alignment.least_squares``). The match
is measured, on recordings that were not used for the fit, by the five quantities that the
paper aligns (``touch.match``).

k_n and the sensor's gain (counts for a reading of 1) cannot be separated by counts, so that the gain is not fitted.

Letters in shapes: T frames, P pads, R × C taxels.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from taccorl.alignment.least_squares import Estimate, Free, Solution, Values, minimise
from taccorl.alignment.measurements.correlation import Rows, rate_of
from taccorl.alignment.touch.match import TouchMatch, touch_match
from taccorl.alignment.touch.model import TouchModel
from taccorl.alignment.touch.motion import TouchMotion
from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.twin import TwinConfig


@dataclass(frozen=True)
class NoiseLevel:
    """Readings of pads without contact: mean, noise and threshold."""

    pads: tuple[str, ...]  # Names of the pads, in the order of the arrays' first axis
    mean_count: np.ndarray  # (P, R, C) mean counts above baseline
    std_count: np.ndarray  # (P, R, C) standard deviation of each taxel's counts
    threshold_count: float  # λ_noise common to all taxels [counts]: the 0.999 quantile of their readings

    @property
    def pooled_std_count(self) -> float:
        """RMS over all taxels of ``std_count`` [counts]."""
        return float(np.sqrt(np.mean(np.square(self.std_count))))


@dataclass(frozen=True)
class TouchCalibration:
    """Result of ``calibrate_touch``: noise, k_n and k_d, and the match before and after."""

    noise: NoiseLevel  # Readings without contact
    stiffness: Estimate  # k_n [reading per metre]
    damping: Estimate  # k_d [reading per m/s]
    before: (
        TouchMatch  # Match on the validation recordings with the twin's own k_n and k_d
    )
    after: TouchMatch  # Match on the same recordings with the fitted k_n and k_d
    fitted_to: tuple[str, ...]
    validation: tuple[str, ...]
    trouble: str  # Reason why the result is not reliable; empty if there is none


def noise_level(motions: Sequence[TouchMotion]) -> NoiseLevel:
    """Estimate λ_noise from the frames in which nothing is near a pad, nor was in the second before. Raises TaccorlError: such
    frames last less than half a second, or the recordings are of different pads."""
    pads = _pads(motions)
    quiet = [(motion.measured, motion.undisturbed()) for motion in motions]
    still = [
        [counts[:, p][rows[:, p]].astype(float) for counts, rows in quiet]
        for p in range(len(pads))
    ]
    frames = [np.concatenate(of_pad) for of_pad in still]
    # A noise level takes half a second without contact.
    for short in (
        pad for pad, of_pad in zip(pads, frames, strict=True) if len(of_pad) < 50
    ):
        raise TaccorlError(
            f"touch calibration: pad {short} has {min(map(len, frames))} frames without contact in {_names(motions)}; record "
            "some seconds before the first touch"
        )
    means = np.array([of_pad.mean(axis=0) for of_pad in frames])
    # About the mean of each recording: baselines are taken anew for each.
    centred = [
        [one - one.mean(axis=0) for one in of_pad if len(one) > 1] for of_pad in still
    ]
    rest = [max(sum(map(len, of_pad)) - len(of_pad), 1) for of_pad in centred]
    squares = np.array(
        [sum(np.square(one).sum(axis=0) for one in of_pad) for of_pad in centred]
    )
    std = np.sqrt(squares / np.array(rest)[:, None, None])
    return NoiseLevel(
        pads=pads,
        mean_count=means,
        std_count=np.maximum(std, 1 / math.sqrt(12)),
        threshold_count=float(
            np.quantile(np.concatenate([f.ravel() for f in frames]), 0.999)
        ),
    )


def calibrate_touch(
    fit: Sequence[TouchMotion], validation: Sequence[TouchMotion], config: TwinConfig
) -> TouchCalibration:
    """Fit λ_noise and (k_n, k_d) to matched contact replays; the effects of ``config`` are included. Raises TaccorlError: there
    are no validation recordings, too few frames with or without contact, or the sensor is not FlexiTac."""
    if not fit or not validation:
        raise TaccorlError(
            f"touch calibration: {len(fit)} recordings for the fit and {len(validation)} for validation; give at least one of "
            "each"
        )
    model = TouchModel(config)
    noise = noise_level(fit)
    in_contact = [int(motion.near(0.0).any(axis=(1, 2, 3)).sum()) for motion in fit]
    if sum(in_contact) < 20:
        raise TaccorlError(
            f"touch calibration: {sum(in_contact)} frames in contact in {_names(fit)}; record presses of known depth"
        )
    found = _least_squares(fit, noise, model)
    stiffness, damping = found.estimates().values()
    own = model.sensor.normal_stiffness_per_m, model.sensor.normal_damping_s_per_m
    threshold = noise.threshold_count
    simulated = [
        [model.counts(m, model.simulate(m, *numbers)) for m in validation]
        for numbers in (own, (stiffness.value, damping.value))
    ]
    measured, pitch_m = [m.measured for m in validation], validation[0].layout.pitch_m
    before, after = (
        touch_match(measured, counts, threshold, pitch_m) for counts in simulated
    )
    if before.rms_count is None or after.rms_count is None:
        raise TaccorlError(
            f"touch: no taxel ever has a reading above λ_noise = {threshold:g} counts in {_names(validation)}"
        )
    return TouchCalibration(
        noise=noise,
        stiffness=stiffness,
        damping=damping,
        before=before,
        after=after,
        fitted_to=tuple(m.name for m in fit),
        validation=tuple(m.name for m in validation),
        trouble=_trouble(found, stiffness, damping),
    )


def _least_squares(
    motions: Sequence[TouchMotion], noise: NoiseLevel, model: TouchModel
) -> Solution:
    """Fit k_n and k_d to the counts of all taxels that come near the object."""
    # Taxels that the object comes within 0.3 mm of take part in the fit.
    taxels = [np.asarray(motion.near(3e-4).any(axis=0)) for motion in motions]
    k_n, k_d = model.sensor.normal_stiffness_per_m, model.sensor.normal_damping_s_per_m
    scale = max(k_d, 0.005 * k_n, 1e-3)
    numbers = [
        Free(name="k_n", unit="1/m", start=k_n, low=1.0, high=1e6, log=True),
        Free(name="k_d", unit="s/m", start=k_d, low=0.0, high=1e4, scale=scale),
    ]

    def residuals(values: Values) -> np.ndarray:
        rows = []
        for motion, own in zip(motions, taxels, strict=True):
            simulated = model.simulate(motion, values["k_n"], values["k_d"])
            counts = model.counts(motion, simulated)[:, own].astype(float)
            rows.append((counts - motion.measured[:, own]) / noise.std_count[own])
        return np.concatenate([one.ravel() for one in rows])

    return minimise(
        lambda cases: np.array([residuals(values) for values in cases]),
        numbers,
        {},
        [
            Rows(np.ones((len(m.time_s), own.sum()), bool), rate_of(m.time_s[:, 0]))
            for m, own in zip(motions, taxels, strict=True)
        ],
    )


def _trouble(found: Solution, stiffness: Estimate, damping: Estimate) -> str:
    said = []
    if found.trouble:
        said.append("not converged: still improving when it was stopped")
    if stiffness.at_bound:
        said.append(
            f"k_n is at its bound, {stiffness.value:g}: the taxels hardly read what depth says; check object and pose"
        )
    two_standard_errors = damping.high - damping.value
    if damping.value <= two_standard_errors / 2:
        said.append(
            "k_d is no more than its error: readings come late or the presses are too slow to show it"
        )
    return "; ".join(said)


def _pads(motions: Sequence[TouchMotion]) -> tuple[str, ...]:
    if not motions:
        raise TaccorlError("touch: no recording with contact")
    pads = motions[0].pads
    for other in (m for m in motions if m.pads != pads):
        raise TaccorlError(
            f"touch: {motions[0].name} touches {', '.join(pads)} and {other.name} {', '.join(other.pads)}, of "
            f"{', '.join(ROBOT.pads)}; calibrate them separately"
        )
    return pads


def _names(motions: Sequence[TouchMotion]) -> str:
    return ", ".join(m.name for m in motions)

"""Fit the numbers that the PiPER's twin has anyway to measurements: gains of joints, k_n and k_d of pads, poses of cameras.

No effect is added or searched for; that is ``taccorl diagnose``. The methods are the paper's App. B: ``alignment.controller``,
``alignment.touch`` and ``alignment.camera``. A result that is not trustworthy states why in ``trouble`` and is not written.
"""

import copy
import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from taccorl.alignment.camera.calibration import (
    CameraFrames,
    calibrate_camera,
    without_effects,
)
from taccorl.alignment.camera.episode import all_pictures, camera_frames, joint_rows
from taccorl.alignment.camera.light import camera_light
from taccorl.alignment.camera.timing import camera_latency
from taccorl.alignment.controller.identification import (
    ControllerFit,
    identify_controller,
)
from taccorl.alignment.controller.joint_model import JointModel
from taccorl.alignment.controller.joint_recording import joint_motion
from taccorl.alignment.controller.rigid_joint import Gains
from taccorl.alignment.measurements.folder import Measurements
from taccorl.alignment.touch.calibration import calibrate_touch
from taccorl.alignment.touch.match import TouchMatch
from taccorl.alignment.touch.motion import touch_motion
from taccorl.data.episode import Episode
from taccorl.data.spec import find_spec, load_dataset_spec
from taccorl.diagnosis.problems import joints, pads
from taccorl.errors import TaccorlError
from taccorl.sim.effects import make_effect
from taccorl.sim.effects.effect import Effect
from taccorl.sim.spaces import TACTILE_KEY
from taccorl.sim.twin import TwinConfig

_AXES = ("x", "y", "z")


@dataclass(frozen=True)
class FittedNumber:
    """One number before and after, with its 95 % interval."""

    name: str
    unit: str
    """Unit of all values of this number."""
    before: float
    """Value in the twin that was given; NaN if the twin has none."""
    value: float
    low: float
    high: float
    fixed: bool = False
    """True if the number was not fitted: ``value`` is what the recordings state, or the value in the twin."""


@dataclass(frozen=True, kw_only=True)
class Alignment:
    """Result for one part: a joint, the pads of one arm, or a camera."""

    part: str
    """Name of the part: ``left_joint5``, ``left pads``, ``camera front``."""
    numbers: tuple[FittedNumber, ...] = ()
    error_name: str = ""
    """Name of the error with its unit, such as ``RMS error of the angle, rad``."""
    before: float = math.nan
    """Error of the twin before the alignment, on the recordings ``judged_by``."""
    after: float = math.nan
    """The same error after the alignment."""
    floors_left: float = math.nan
    """For a joint: the remaining error after the alignment, in noise floors; NaN if its noise floor is not known."""
    judged_by: tuple[str, ...] = ()
    """Recordings (for cameras: frames) of the two errors. They are not those of the fit, unless there were no others."""
    fitted_to: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    """Remarks about the result, a sentence each."""
    trouble: str = ""
    """Reason why the numbers are not written into the twin; empty if they are written."""
    unchanged: bool = False
    """True if the twin keeps its numbers: they are inside the intervals, and the fitted ones are no better."""
    effects: tuple[Effect, ...] = ()
    """Effects whose parameters were fitted with the numbers: latency and exposure of a camera. They replace the twin's effects
    of the same name; an absent one (without influence) only removes the twin's."""
    touch_matches: tuple[TouchMatch, ...] = ()
    """For pads: the paper's five numbers before and after the alignment, on the recordings
    ``judged_by``; empty for others."""
    twin: TwinConfig | None = None
    """For a camera: the twin with its new pose."""
    overlays: Mapping[str, np.ndarray] = field(default_factory=dict)
    """For a camera: stage → picture with the outlines before and after, (rows, columns, 3) uint8 RGB."""

    def record(self) -> dict[str, Any]:
        """The result for a report, without pictures and the twin."""
        values = {
            f.name: getattr(self, f.name)
            for f in dataclasses.fields(self)
            if f.name not in _NOT_STORED
        }
        values["numbers"] = [dataclasses.asdict(n) for n in self.numbers]
        values["effects"] = [
            effect.name for effect in self.effects if not effect.is_absent
        ]
        if self.touch_matches:
            values["touch_match"] = {
                when: one.record()
                for when, one in zip(
                    ("before", "after"), self.touch_matches, strict=True
                )
            }
        return values


_NOT_STORED = ("numbers", "effects", "touch_matches", "twin", "overlays")


def align_part(
    part: str,
    config: TwinConfig,
    measurements: Measurements,
    *,
    fit_kp: bool = False,
    spsa_seed: int | None = None,
) -> Alignment:
    """Align one joint (``left_joint5``) or the pads of one arm (``left pads``); why it cannot be done is its ``trouble``.

    Args:
        fit_kp: fit K_p, too. Positions determine K_d / K_p and T_ref / K_p, and K_p only
            through small terms that other errors of the model change; without, K_p is what
            the recordings state, or the twin's.
        spsa_seed: seed of SPSA's random signs, the same for every joint; None: least
            squares.
    """
    try:
        if part in joints.SIGNALS:
            return _align_joint(part, config, measurements, fit_kp, spsa_seed)
        return _align_pads(part, config, measurements)
    except TaccorlError as error:
        return Alignment(part=part, trouble=str(error))


def align_parts(
    parts: Sequence[str],
    config: TwinConfig,
    measurements: Measurements,
    *,
    fit_kp: bool = False,
    spsa_seed: int | None = None,
    workers: int = 1,
    done: Callable[[str], None] = lambda part: None,
) -> list[Alignment]:
    """Align ``parts``, ``workers`` of them at the same time; return one alignment for each, in their order. The number of workers
    does not change the results. ``fit_kp``, ``spsa_seed``: as in ``align_part``. ``done``: function that is called with the name
    of each part that was aligned."""
    one = partial(
        align_part,
        config=config,
        measurements=measurements,
        fit_kp=fit_kp,
        spsa_seed=spsa_seed,
    )
    return joints.each(one, {part: part for part in parts}, workers, done)


def _align_joint(
    signal: str,
    config: TwinConfig,
    measurements: Measurements,
    fit_kp: bool,
    spsa_seed: int | None,
) -> Alignment:
    own = joints.of_joints(measurements, [signal])
    model = JointModel(config, signal)
    motions = [joint_motion(m, config, signal) for m in own.fit]
    free = ["torque_ff"]
    free += ["kd"] * (not all(m.kd_known for m in motions))
    free += ["kp"] * (fit_kp and not all(m.kp_known for m in motions))
    fit = identify_controller(
        motions,
        model,
        free=free,
        validation=[joint_motion(m, config, signal) for m in own.validation],
        spsa_rng=None if spsa_seed is None else np.random.default_rng(spsa_seed),
    )
    judged = [e for e in fit.errors if e.use == "validation"] or list(fit.errors)
    before, after = (
        float(np.sqrt(np.mean([getattr(e, name) ** 2 for e in judged])))
        for name in ("rmse_before", "rmse_after")
    )
    numbers = _gains(fit, model)
    trouble = (
        ""
        if fit.converged
        else "; ".join(r for r in fit.remarks if r.startswith("not converged"))
    )
    unchanged = (
        not trouble
        and after > before
        and all(n.fixed or n.low <= n.before <= n.high for n in numbers)
    )
    if not trouble and not unchanged and after > before:
        trouble = f"the error on {', '.join(e.name for e in judged)} is larger with the fitted gains"
    remarks = _limits_of_gains("kp" in free, all(m.kp_known for m in motions))
    if not own.validation:
        remarks.append(
            "no recording is for validation (measurements.yaml): both errors are those of the fit's recordings"
        )
    return Alignment(
        part=signal,
        numbers=numbers,
        error_name="RMS error of the angle, rad",
        before=before,
        after=after,
        judged_by=tuple(e.name for e in judged),
        fitted_to=tuple(e.name for e in fit.errors if e.use == "fit"),
        remarks=(
            *remarks,
            *(r for r in fit.remarks if not r.startswith("not converged")),
        ),
        trouble=trouble,
        unchanged=unchanged,
    )


def _limits_of_gains(kp_fitted: bool, kp_known: bool) -> list[str]:
    """What the intervals of K_p, K_d and T_ref leave out, where K_p is not commanded and known."""
    if kp_known:
        return []
    if not kp_fitted:
        return [
            "K_p is the twin's and was not measured: K_d and T_ref, with their intervals, hold for this K_p only and are "
            "proportional to it; K_d / K_p and T_ref / K_p hold for any. Commanded gains belong in measurements.yaml (kp)"
        ]
    return [
        "the intervals of K_p, K_d and T_ref contain the noise but no error of the model (inertia, pose, scale of torques), "
        "which changes all three in proportion, often by more; those of K_d / K_p and T_ref / K_p hardly depend on it"
    ]


def _gains(fit: ControllerFit, model: JointModel) -> tuple[FittedNumber, ...]:
    had = model.gains
    before = had._asdict() | {"lag": had.kd / had.kp, "offset": had.torque_ff / had.kp}
    words = {"lag": "kd/kp", "offset": "torque_ff/kp"}
    return tuple(
        FittedNumber(
            words.get(name, name),
            found.unit,
            before[name],
            found.value,
            found.low,
            found.high,
            found.fixed,
        )
        for name, found in fit.estimates.items()
        if name in before
    )


def _align_pads(part: str, config: TwinConfig, measurements: Measurements) -> Alignment:
    arm = part.removesuffix(" pads")
    fit, validation = (
        [
            touch_motion(m, config, m.pressed)
            for m in side
            if m.pressed is not None and pads.presses(m, arm, config)
        ]
        for side in (measurements.fit, measurements.validation)
    )
    found = calibrate_touch(fit, validation, config)
    trouble = found.trouble
    before, after = found.before.rms_count, found.after.rms_count
    assert before is not None and after is not None  # checked by calibrate_touch
    if not trouble and after > before:
        trouble = f"the error on {', '.join(found.validation)} is larger with the fitted numbers"
    sensor = config.sensor
    return Alignment(
        part=part,
        numbers=tuple(
            FittedNumber(
                name,
                n.unit,
                float(getattr(sensor, pads.FIELDS[name])),
                n.value,
                n.low,
                n.high,
            )
            for name, n in (("k_n", found.stiffness), ("k_d", found.damping))
        ),
        error_name="RMS error of the counts of active taxels",
        before=before,
        after=after,
        touch_matches=(found.before, found.after),
        judged_by=found.validation,
        fitted_to=found.fitted_to,
        remarks=(
            f"λ_noise {found.noise.threshold_count:g} counts, noise {found.noise.pooled_std_count:.2f} counts; a taxel above "
            "λ_noise is active",
            _as_option(found.noise.threshold_count),
        ),
        trouble=trouble,
    )


def _as_option(threshold_count: float) -> str:
    """λ_noise as the option of a policy, which takes it in normalised readings."""
    sensor = load_dataset_spec(find_spec("taccorl_bimanual")).sensors[TACTILE_KEY]
    reading = threshold_count * sensor.gain_per_count
    return (
        f"λ_noise for a policy, in training: --policy.noise_threshold={reading:.4g} ({threshold_count:g} counts × the gain "
        f"{sensor.gain_per_count:.6g} of {sensor.name}); give it with every dataset of these pads, recorded or simulated"
    )


def align_camera(camera: str, config: TwinConfig, episode: Episode) -> Alignment:
    """Fit pose, latency and exposure of one camera to an episode's pictures; why it cannot be done is its ``trouble``."""
    part = f"camera {camera}"
    try:
        return _align_camera(part, camera, config, episode)
    except TaccorlError as error:
        return Alignment(part=part, trouble=str(error))


def _align_camera(
    part: str, camera: str, config: TwinConfig, episode: Episode
) -> Alignment:
    had = [
        e
        for e in config.effects
        if e.name.startswith("camera_") and camera in e.acts_on()
    ]
    late = camera_latency(
        all_pictures(episode, camera),
        episode.time_s,
        joint_rows(episode),
        config,
        camera,
    )
    known_s = sum(float(getattr(e, "delay_s", 0.0)) for e in had)
    latency_s = known_s if late.problems else late.latency_s
    frames = camera_frames(episode, camera, latency_s=latency_s)
    fit = calibrate_camera(frames, config, camera)
    numbers = [
        FittedNumber(
            name=name,
            unit=unit,
            before=float(a),
            value=float(b),
            low=float(b - h),
            high=float(b + h),
        )
        for name, unit, a, b, h in zip(
            [*(f"turn_{x}" for x in _AXES), *(f"shift_{x}" for x in _AXES)],
            ["rad"] * 3 + ["m"] * 3,
            fit.start,
            fit.offset,
            fit.half_width,
            strict=True,
        )
    ]
    remarks, effects, twin = (
        [f"latency not fitted: {why}" for why in late.problems],
        [],
        None,
    )
    if not late.problems:
        low, high = late.interval_s
        numbers.append(
            FittedNumber(
                name="latency",
                unit="s",
                before=known_s,
                value=late.latency_s,
                low=low,
                high=high,
            )
        )
        is_late = low > 0.0
        if not is_late:
            remarks.append("the latency's interval contains 0: the new twin has none")
        effects.append(
            make_effect(
                "camera_latency",
                cameras=[camera],
                delay_s=late.latency_s,
                interval={"delay_s": (low, high)},
            )
            if is_late
            else make_effect("camera_latency", cameras=[camera], delay_s=0.0)
        )
    if fit.converged:
        twin = fit.twin(config)
        try:
            exposure, of_exposure, said = _exposure(camera, twin, frames, had)
        except TaccorlError as error:
            remarks.append(f"exposure not fitted: {error}")
        else:
            effects.append(exposure)
            numbers += of_exposure
            remarks.append(said)
    return Alignment(
        part=part,
        numbers=tuple(numbers),
        error_name="mean distance of the arms' outlines from the pictures' edges, px",
        before=fit.before_px,
        after=fit.after_px,
        judged_by=(f"{fit.num_held_out} frames of {fit.name}",),
        fitted_to=(f"{fit.num_frames} frames of {fit.name}",),
        remarks=tuple(remarks),
        trouble="; ".join(fit.problems),
        effects=tuple(effects),
        twin=twin,
        overlays=fit.overlays,
    )


def _exposure(
    camera: str, config: TwinConfig, frames: CameraFrames, had: Sequence[Effect]
) -> tuple[Effect, list[FittedNumber], str]:
    """Effect, its numbers, and how well the grey values match, for a camera whose pose in ``config`` is fitted."""
    light = camera_light(
        frames, without_effects(config, camera, ("camera_exposure",)), camera
    )
    ends = {
        "gain": light.gain_interval,
        "gamma": light.gamma_interval,
        "blur_px": light.blur_interval_px,
    }
    made = make_effect(
        "camera_exposure",
        cameras=[camera],
        gain=light.gain,
        gamma=light.gamma,
        blur_px=light.blur_px,
        interval=ends,
    )
    before = next(
        (e for e in had if e.name == made.name),
        make_effect(made.name, cameras=[camera]),
    )
    numbers = [
        FittedNumber(
            p.name,
            p.unit,
            float(getattr(before, p.name)),
            float(getattr(made, p.name)),
            *ends[p.name],
        )
        for p in made.parameters()
    ]
    said = f"grey values away from edges: mean difference {light.grey_before:.1f} → {light.grey_after:.1f} of 255"
    return made, numbers, said


def aligned(config: TwinConfig, found: Sequence[Alignment]) -> tuple[TwinConfig, str]:
    """Copy of the twin with the numbers of ``found`` that have no trouble, and text: why some of them could not be written; empty
    if all were.

    k_n and k_d are common to all pads: if two arms need different ones, the pads stay as they were.
    """
    config = copy.deepcopy(config)
    good = [a for a in found if not a.trouble and not a.unchanged]
    why = ""
    for a in good:
        values = {
            n.name: n.value
            for n in a.numbers
            if n.name in Gains._fields and not n.fixed
        }
        if a.part in joints.SIGNALS:
            joints.set_numbers(config, a.part, values)
        elif a.twin is not None:
            camera = a.part.removeprefix("camera ")
            new = next(c for c in a.twin.cameras if c.name == camera)
            config.cameras = [new if c.name == camera else c for c in config.cameras]
            gone = ("camera_pose", *(e.name for e in a.effects))
            config = without_effects(config, camera, gone)
            config.effects = [
                *config.effects,
                *(e for e in a.effects if not e.is_absent),
            ]
    of_pads = {
        a.part: (
            {n.name: n.value for n in a.numbers},
            {n.name: (n.low, n.high) for n in a.numbers},
        )
        for a in good
        if a.part.endswith(" pads")
    }
    if of_pads:
        try:
            pads.set_numbers(config, pads.agreed(of_pads))
        except TaccorlError as error:
            why = f"the pads are as they were: {error}"
    return config, why

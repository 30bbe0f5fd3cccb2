"""Simulate the commands of every recording in the twin, and compute the residual = measurement − replay. There are two ways.
**joint**: without contact and without a gripper command, each commanded joint is simulated alone in the one-joint model, while
the others move as measured, so that the error of one joint does not affect others. **twin**: otherwise (contact, grippers), the
whole twin follows the commands. Touch is a matched contact replay (``taccorl.alignment.touch.model``): the pads at their
measured poses, in an object whose pose is known.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np

from taccorl.alignment.checks.clock import beside_onsets, check_against_twin
from taccorl.alignment.checks.telemetry import MOVED
from taccorl.alignment.controller.arm_joint import HasJoints
from taccorl.alignment.controller.drive_law import FOLLOWED, DriveLaw
from taccorl.alignment.controller.joint_model import (
    JointModel,
    with_more_lead,
    with_other_numbers,
)
from taccorl.alignment.controller.joint_motion import JointMotion
from taccorl.alignment.controller.joint_recording import joint_motion, motion_of
from taccorl.alignment.measurements.folder import Measurements, Use
from taccorl.alignment.measurements.measurement import UNITS, Measurement
from taccorl.alignment.measurements.noise_floor import (
    SignalFloor,
    floors_by_motion,
    noise_floor,
    touch_floor,
)
from taccorl.alignment.measurements.pressed import PressedObject
from taccorl.alignment.touch.model import TouchModel
from taccorl.alignment.touch.motion import lacking_pads, twin_pads
from taccorl.data.finding import Finding, listed
from taccorl.diagnosis.comparison.replays import (
    BENCH_REST,
    Response,
    in_contact,
    matched_contact,
    replay_joints,
    replay_whole,
)
from taccorl.diagnosis.comparison.result import (
    USES,
    Comparison,
    Kind,
    TouchTrace,
    Trace,
)
from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.twin import TwinConfig

GRIPPERS = tuple(f"{arm}_gripper" for arm in ROBOT.arms)
"""Names of the gripper signals, in the order of the arms."""


type Floors = dict[str, dict[str, SignalFloor]]
"""Recording → signal → noise floor."""


def compare(
    config: TwinConfig,
    measurements: Measurements,
    *,
    name: str = "twin",
    pressed: PressedObject | None = None,
    progress: Callable[[str, int, int], None] = lambda name, done, total: None,
) -> Comparison:
    """Replay all recordings and compute their residuals.

    Args:
        name: name of the twin, for titles.
        pressed: object between the fingers, and its pose, for recordings with pads that do not state one. Touch is compared only
            if the object is known.
        progress: function that is called with (recording, number of recordings done, number in all).

    Raises TaccorlError: the robot lacks a signal, a recording has nothing to compare, or the pads contradict the stated
    object."""
    uses: list[tuple[Use, Measurement]] = [
        (use, m.on_robot(BENCH_REST))
        for use in USES
        for m in in_time(getattr(measurements, use))
    ]
    every = [m for _, m in uses]
    floors: dict[Kind, Floors] = {
        kind: floors_by_motion(every, kind) for kind in ("position", "effort")
    }
    traces: list[Trace] = []
    touches: list[TouchTrace] = []
    left_out: list[str] = []
    clock: dict[str, tuple[Finding, ...]] = {}
    levels = {signal: floor.value for signal, floor in noise_floor(every).items()}
    responses = replay_all(config, every, progress)
    for (use, m), response in zip(uses, responses, strict=True):
        traces += traces_of(m, use, response, floors)
        if np.isfinite(response.reported).any():
            changed = partial(_other_numbers, config, m)
            clock[m.name] = tuple(
                check_against_twin(
                    response.measurement, response.reported, levels, changed=changed
                )
            )
    for signal in GRIPPERS:
        names = [m.name for m in every if signal in held_up(m)]
        if names:
            left_out.append(
                f"{signal} of {', '.join(names)}: something was between the fingers, and nothing is in the twin"
            )
    if any(m.touch is not None for m in every):
        touches, why_not = _touches(config, uses, pressed)
        left_out += why_not
    left_out += _not_read(every)
    if not traces and not touches:
        why = "; ".join(left_out) or "no position was measured"
        raise TaccorlError(
            f"{', '.join(m.name for m in every)}: nothing to compare: {why}"
        )
    return Comparison(
        twin=name,
        effects=tuple(e.name for e in config.effects if not e.is_absent),
        traces=tuple(traces),
        touches=tuple(touches),
        split=measurements.record(),
        clock=beside_onsets(clock),
        left_out=tuple(left_out),
    )


def in_time(measurements: Sequence[Measurement]) -> list[Measurement]:
    """The recordings in the order of their clock; those of one start, as of tables that
    begin at 0, in their own order."""
    return sorted(measurements, key=lambda m: m.start_ns)


def compare_joints(
    machine: HasJoints,
    laws: Mapping[str, DriveLaw],
    measurements: Measurements,
    whole: Callable[[Measurement], Measurement],
    *,
    name: str,
    file: str,
    effects: tuple[str, ...],
    uncertain: Sequence[str],
    by_motion: bool,
    progress: Callable[[str, int, int], None],
) -> Comparison:
    """As ``compare``, for a machine whose joints have the ``laws`` of its ``file``: each is simulated alone.

    Args:
        whole: function that returns a recording with all signals of the machine.
        uncertain: joints whose drives have numbers that ``diagnose`` fits.
        by_motion: each recording has the noise floors of ``floors_by_motion``; if false, those of all recordings together. It
            is as the machine's own ``diagnose`` takes them.
    """
    uses: list[tuple[Use, Measurement]] = [
        (use, whole(m)) for use in USES for m in in_time(getattr(measurements, use))
    ]
    every = [m for _, m in uses]
    traces, clock, held, replayed, left = [], {}, set(), [], []
    for k, m in enumerate(every):
        progress(m.name, k, len(uses))
        moved = moving(m.with_position_targets(m.measured))
        known = [s for s in m.signals if s in laws and (s in moved or len(laws) == 1)]
        held |= {s for s in moved if s not in laws}
        replayed.append((known, response := replay_joints(machine, m, known)))
        followed = FOLLOWED * np.array(
            [m.target_kind(s) == "effort" for s in m.signals]
        )
        left.append(
            dataclasses.replace(
                m, effort=m.effort - followed * np.nan_to_num(response.effort)
            )
        )
    left *= any("effort" in m.target_kinds for m in every)
    pooled: dict[Kind, dict[str, SignalFloor]] = {"position": noise_floor(every)}
    pooled["effort"] = noise_floor(every, "effort", left)
    floors: dict[Kind, Floors] = {
        kind: dict.fromkeys((m.name for m in every), own)
        for kind, own in pooled.items()
    }
    if by_motion:
        floors = {
            "position": floors_by_motion(every),
            "effort": floors_by_motion(every, "effort", left),
        }
    levels = {signal: floor.value for signal, floor in pooled["position"].items()}
    for (use, m), (known, response) in zip(uses, replayed, strict=True):
        positions = m.with_position_targets(np.nan_to_num(response.reported))
        response.reported[
            :, [m.column(s) for s in known if laws[s].law == "effort"]
        ] = np.nan  # held where measured
        own = traces_of(
            positions, use, dataclasses.replace(response, measurement=positions), floors
        )
        traces += [t for t in own if t.signal in known]
        if not (known := [s for s in known if laws[s].law != "effort"]):
            continue
        commanded = m.with_position_targets(np.zeros(m.target.shape)).only(known)

        def with_more[T](
            change: Callable[[JointModel, JointMotion], T],
            signal: str,
            m: Measurement = m,
        ) -> T:
            model = JointModel(machine, signal)
            return change(model, motion_of(m, signal, model.joint))

        changed, rivals = (
            partial(with_more, with_other_numbers),
            partial(with_more, with_more_lead),
        )
        reported, fitted = (
            response.reported[:, [m.column(s) for s in known]],
            [s for s in known if s in uncertain],
        )
        clock[m.name] = tuple(
            check_against_twin(commanded, reported, levels, fitted, changed, rivals)
        )
    progress("", len(uses), len(uses))
    if not traces:
        why = f"no position of a joint that {file} names was measured in motion"
        raise TaccorlError(
            f"{', '.join(m.name for m in every)}: nothing to compare: {why}"
        )
    return Comparison(
        twin=name,
        effects=effects,
        traces=tuple(traces),
        split=measurements.record(),
        clock=beside_onsets(clock),
        left_out=(
            *(f"{s}: {file} does not name it under joints" for s in sorted(held)),
            *(
                f"touch of {m.name}: {file} has no pads"
                for m in every
                if m.touch is not None
            ),
            *_not_read(every),
        ),
    )


def _other_numbers(config: TwinConfig, m: Measurement, signal: str) -> list[np.ndarray]:
    """``with_other_numbers`` of one of the arms' joints; none for others, or if its
    recording cannot be replayed alone."""
    try:
        model = JointModel(config, signal)
        return with_other_numbers(model, joint_motion(m, config, signal))
    except TaccorlError:
        return []


def replay_all(
    config: TwinConfig,
    measurements: Sequence[Measurement],
    progress: Callable[[str, int, int], None],
) -> list[Response]:
    """One response per measurement, in their order: without contact and without a gripper command each moving joint is replayed
    alone in the one-joint model, otherwise the whole twin. A measurement without a signal to compare gets a response of NaN.
    ``progress``: function that is called with (recording, number of recordings done, number in all)."""
    found = []
    for k, m in enumerate(measurements):
        progress(m.name, k, len(measurements))
        moved = moving(m)
        if not compared(m):
            found.append(replay_joints(config, m, []))
        elif (
            moved and not in_contact(m).any() and not any("gripper" in s for s in moved)
        ):
            found.append(replay_joints(config, m, moved))
        else:
            found.append(replay_whole(config, m))
    progress("", len(measurements), len(measurements))
    return found


def moving(m: Measurement) -> list[str]:
    """Names of the signals whose targets move: by more than 0.02 rad or 2 mm."""
    spans = np.ptp(m.target, axis=0)
    return [
        s
        for s, unit, span in zip(m.signals, m.units, spans, strict=True)
        if span > MOVED[unit]
    ]


def compared(m: Measurement) -> list[str]:
    """Names of the signals to compare: those that are commanded to move (all, if none is), without grippers that an object
    holds open."""
    return [s for s in moving(m) or m.signals if s not in held_up(m)]


def held_up(m: Measurement) -> list[str]:
    """Names of the grippers of arms that press an object, as stated by the recording or shown by its pads: the twin's would close
    further."""
    touched = np.asarray(in_contact(m).any(axis=0))
    stated = [m.pressed is not None and m.pressed.arm == arm for arm in ROBOT.arms]
    return [
        signal
        for signal, held, said in zip(GRIPPERS, touched, stated, strict=True)
        if held or said
    ]


def traces_of(
    m: Measurement, use: Use, response: Response, floors: dict[Kind, Floors]
) -> list[Trace]:
    """Measured and replayed values over time: one trace for each compared signal, one for its effort if recorded. ``floors``:
    of each kind; signals without one are left out."""
    touched = in_contact(response.measurement)
    found = []
    even = response.measurement
    for signal in compared(m):
        j, arm = even.column(signal), signal.split("_", 1)[0]
        felt = (
            touched[:, ROBOT.arms.index(arm)]
            if arm in ROBOT.arms
            else np.zeros(even.num_rows, dtype=bool)
        )
        columns: dict[Kind, tuple[np.ndarray, np.ndarray]] = {
            "position": (even.measured[:, j], response.reported[:, j]),
            "effort": (even.effort[:, j], response.effort[:, j]),
        }
        for kind, (measured, replayed) in columns.items():
            known = bool(np.isfinite(measured).any() and np.isfinite(replayed).any())
            recorded = known if kind == "position" else even.has_effort()[j]
            if not recorded or signal not in floors[kind][m.name]:
                continue
            unit = even.units[j] if kind == "position" else UNITS[even.units[j]][1]
            found.append(
                Trace(
                    recording=m.name,
                    use=use,
                    signal=signal,
                    kind=kind,
                    unit=unit,
                    way=response.way,
                    time_s=even.time_s,
                    target=even.target[:, j],
                    position=even.measured[:, j],
                    measured=measured,
                    replayed=replayed,
                    torque=response.effort[:, j],
                    touched=felt,
                    floor=floors[kind][m.name][signal],
                    origin=m.origin,
                )
            )
    return found


def _not_read(measurements: Sequence[Measurement]) -> list[str]:
    """Touch of recordings that was not read, with the reasons."""
    return [
        f"touch of {m.name}: {f.text}"
        for m in measurements
        for f in m.findings
        if f.check == "touch_not_read"
    ]


def _other_pads(m: Measurement, config: TwinConfig) -> list[str]:
    """Text: pads of a recording that the twin does not have; empty if there are none."""
    pads = twin_pads(config).values()
    others = [] if m.touch is None else m.touch.without(list(pads))
    if not others:
        return []
    listed, twins = (", ".join(map(str, some)) for some in (others, pads))
    return [f"the twin has no pads {listed}; it has {twins}"]


def _arms_with_pads(m: Measurement, config: TwinConfig) -> list[str]:
    """Arms of which the recording has the twin's pads."""
    if m.touch is None:
        return []
    return [arm for arm in ROBOT.arms if not lacking_pads(m, config, arm)]


def _pad_floors(
    measurements: Sequence[Measurement], config: TwinConfig
) -> dict[str, np.ndarray] | None:
    """Name of a pad of the twin → (R, C) noise of its taxels [counts]; None if that of
    a recorded pad is not known."""
    floors = {}
    for name, pad in twin_pads(config).items():
        parts = [
            dataclasses.replace(m, touch=part)
            for m in measurements
            if m.touch is not None
            for own, part in m.touch.parts.items()
            if (own.name, own.shape) == (pad.name, pad.shape)
        ]
        if not parts:
            continue
        if (floor := touch_floor(parts)) is None:
            return None
        floors[name] = floor.reshape(pad.shape)
    return floors


def _touches(
    config: TwinConfig,
    uses: Sequence[tuple[Use, Measurement]],
    pressed: PressedObject | None,
) -> tuple[list[TouchTrace], list[str]]:
    """Matched contact replays, and why there are none of some recordings."""
    why_not = [
        f"touch of {m.name}: {line}" for _, m in uses for line in _other_pads(m, config)
    ]
    arms = {m.name: _arms_with_pads(m, config) for _, m in uses}
    felt: list[tuple[Use, Measurement]] = [(use, m) for use, m in uses if arms[m.name]]
    unknown = [m.name for _, m in felt if m.pressed is None and pressed is None]
    found = []
    if unknown:
        why_not.append(
            f"touch of {listed(unknown)}: what was pressed is not known; state it: `pressed` in measurements.yaml, or "
            "--pressed.shape=… --pressed.radius_m=…"
        )
    if len(unknown) == len(felt):
        return found, why_not
    model, sensor = TouchModel(config), TouchModel(config).sensor
    floors = _pad_floors([m for _, m in felt], config)
    if floors is None:
        names = ", ".join(m.name for _, m in felt)
        return [], [*why_not, f"touch of {names}: too few frames for a noise floor"]
    for use, m in felt:
        solid = m.pressed or pressed
        if solid is None:
            continue
        if lacking := lacking_pads(m, config, solid.arm):
            why_not.append(f"touch of {m.name}: {lacking}")
            continue
        try:
            motion = matched_contact(m, config, solid)
        except TaccorlError as error:
            if m.pressed is not None:
                raise
            why_not.append(f"touch: {error}")
            continue
        reading = model.simulate(
            motion, sensor.normal_stiffness_per_m, sensor.normal_damping_s_per_m
        )
        found.append(
            TouchTrace(
                recording=m.name,
                use=use,
                pads=motion.pads,
                time_s=motion.time_s,
                measured=motion.measured,
                replayed=model.counts(motion, reading),
                floor=np.stack([floors[pad] for pad in motion.pads]),
                origin=m.origin,
                pitch_m=motion.layout.pitch_m,
                touched=np.asarray((motion.depth()[0] > 0).any(axis=(2, 3))),
            )
        )
    return found, why_not

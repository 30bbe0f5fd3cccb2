"""Fits of one joint without taccorl, the peers of ``make bench ONLY=peers``.

``python -m pipelines.benchmarks.peer_fits sysid|scipy FOLDER`` fits the elbow of the arm
whose recordings ``peers.py`` wrote into FOLDER, and prints one line of JSON: the numbers,
half widths of their 95 % intervals, CPU-seconds of the imports and of the fit.

Both free the same numbers: a constant torque, armature, viscous damping, MuJoCo's
frictionloss and a delay; where the gains are unknown, K_p and K_d instead of damping, which
positions cannot tell from K_d.

Letters in shapes: T rows at 200 Hz, J joints, N numbers.
"""

import json
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import mujoco
import numpy as np
from mujoco import rollout
from scipy.optimize import least_squares

RATE_HZ, STEP_S = 200, 1e-3
"""Rate of the rows [Hz] and physics step of MuJoCo [s]."""
HOLD = round(1 / (RATE_HZ * STEP_S))
SETTLE_S = 3.0
"""Simulated time for which the arm holds the first target before its recording begins, so that it starts at rest [s]."""
ELBOW = 2
"""Index of the joint that moves."""
LONGEST_DELAY_S = 0.05

Numbers = Mapping[str, float]

START = {
    "torque_ff": (0.0, -5.0, 5.0),
    "armature": (0.06, 0.005, 0.6),
    "damping": (0.1, 0.0, 10.0),
    "frictionloss": (0.1, 0.0, 5.0),
    "delay_s": (5e-3, 0.0, LONGEST_DELAY_S),
}
"""Number of the elbow → start, lower and upper bound; SI units."""


def elbow_numbers(spec: mujoco.MjSpec, numbers: Numbers) -> None:
    """Write ``numbers`` of the elbow into ``spec``; its delay is left to who simulates."""
    motor, joint = spec.actuator("elbow"), spec.joint("elbow")
    kp = numbers.get("kp", motor.gainprm[0])
    kd = numbers.get("kd", -motor.biasprm[2])
    motor.gainprm[0] = kp
    motor.biasprm[:3] = [numbers.get("torque_ff", motor.biasprm[0]), -kp, -kd]
    joint.armature = numbers.get("armature", joint.armature)
    joint.damping = [numbers.get("damping", joint.damping[0]), 0.0, 0.0]
    joint.frictionloss = numbers.get("frictionloss", joint.frictionloss)


def simulated(xml: str, numbers: Numbers, target: np.ndarray) -> np.ndarray:
    """Angles (T, J) [rad] at the rows of ``target`` (T, J), before the row's target acts.

    MuJoCo moves the whole arm with steps of 1 ms from rest at the first target; a delay is
    that of MuJoCo's actuators, interpolated between steps.
    """
    spec = mujoco.MjSpec.from_string(xml)
    elbow_numbers(spec, numbers)
    motor = spec.actuator("elbow")
    motor.nsample, motor.interp = 64, 1
    motor.delay = numbers.get("delay_s", 0.0)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:] = data.ctrl[:] = target[0]
    past_s = np.arange(-64, 0) * STEP_S
    mujoco.mj_initCtrlHistory(model, data, ELBOW, past_s, np.full(64, target[0, ELBOW]))
    mujoco.mj_step(model, data, round(SETTLE_S / STEP_S))
    rows = np.empty_like(target)
    for k, row in enumerate(target):
        rows[k], data.ctrl[:] = data.qpos, row
        mujoco.mj_step(model, data, HOLD)
    return rows


def recorded(folder: Path) -> list[tuple[np.ndarray, np.ndarray]]:
    """Measured angles and targets, each (T, J) [rad], of the recordings to fit."""
    tables = [
        np.genfromtxt(
            folder / "sweeps" / f"{name}.csv", delimiter=",", names=True, skip_header=2
        )
        for name in ("one", "again", "triangle")
    ]
    joints = ("pan", "lift", "elbow")
    return [
        (
            np.column_stack([t[f"{joint}q"] for joint in joints]),
            np.column_stack([t[f"{joint}q_target"] for joint in joints]),
        )
        for t in tables
    ]


def by_sysid(
    folder: Path, free: Mapping[str, tuple[float, float, float]]
) -> tuple[np.ndarray, np.ndarray]:
    """Fit of MuJoCo's sysid: numbers (N,) and half widths of their intervals (N,)."""
    from mujoco import sysid

    def modifier(name: str) -> Callable[[mujoco.MjSpec, sysid.Parameter], None]:
        return lambda spec, p: elbow_numbers(spec, {name: float(p.value[0])})

    params = sysid.ParameterDict()
    for name, bounds in free.items():
        edit = None if name == "delay_s" else modifier(name)
        params.add(sysid.Parameter(name, *bounds, modifier=edit))
    transform = sysid.SignalTransform()
    transform.delay("elbow_pos", params["delay_s"])
    transform.enable_sensors(["elbow_pos"])
    xml = (folder / "arm.xml").read_text()
    sequences = []
    for k, (measured, target) in enumerate(recorded(folder)):
        model = mujoco.MjModel.from_xml_string(xml)
        held = np.repeat(target, HOLD, axis=0)
        # sysid states the sensors of a step at the step's end, where they hold at its begin.
        times = np.arange(len(measured)) / RATE_HZ + STEP_S
        sequences.append(
            sysid.ModelSequences(
                "arm",
                mujoco.MjSpec.from_string(xml),
                f"recording {k}",
                sysid.create_initial_state(model, measured[0], np.zeros(model.nv)),
                sysid.TimeSeries.from_control_names(
                    np.arange(len(held)) * STEP_S, held, model
                ),
                sysid.TimeSeries.from_names(
                    times[1:], measured[1:, [ELBOW]], model, names=["elbow_pos"]
                ),
            )
        )
    residual = sysid.build_residual_fn(
        models_sequences=sequences, modify_residual=transform.apply, n_threads=1
    )
    found, result = sysid.optimize(params, residual, verbose=False, x_scale="jac")
    rest, _, _ = residual(found.as_vector(), found)
    _, half = sysid.calculate_intervals(rest, result.jac)
    return found.as_vector(), half


def by_scipy(
    folder: Path, free: Mapping[str, tuple[float, float, float]]
) -> tuple[np.ndarray, np.ndarray]:
    """Fit of scipy with MuJoCo in the loop: numbers (N,), half widths of intervals (N,)."""
    xml = (folder / "arm.xml").read_text()
    made = recorded(folder)

    def residual(x: np.ndarray) -> np.ndarray:
        numbers = dict(zip(free, x, strict=True))
        spec = mujoco.MjSpec.from_string(xml)
        elbow_numbers(spec, numbers)
        model = spec.compile()
        data = mujoco.MjData(model)
        off = []
        for measured, target in made:
            data.qpos[:], data.qvel[:], data.time = measured[0], 0.0, 0.0
            state = np.empty(mujoco.mj_stateSize(model, _FULL))
            mujoco.mj_getState(model, data, state, _FULL)
            states, _ = rollout.rollout(model, data, state, np.repeat(target, HOLD, 0))
            angle = np.concatenate([measured[:1, ELBOW], states[0, :, 1 + ELBOW]])
            rows_s = np.arange(len(measured)) / RATE_HZ
            at_s = np.arange(len(angle)) * STEP_S
            off.append(np.interp(rows_s - numbers["delay_s"], at_s, angle))
            off[-1] -= measured[:, ELBOW]
        return np.concatenate(off)

    start, low, high = np.array(list(free.values())).T
    size = np.maximum(np.abs(start), 0.02 * (high - low))
    fit = least_squares(
        residual,
        start,
        bounds=(low, high),
        x_scale=size,
        diff_step=1e-4,
        xtol=1e-6,
        ftol=1e-6,
    )
    variance = fit.fun @ fit.fun / (len(fit.fun) - len(start))
    covariance = variance * np.linalg.pinv(fit.jac.T @ fit.jac)
    return fit.x, 1.96 * np.sqrt(np.diag(covariance))


_FULL = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)


def main(words: Sequence[str]) -> None:
    """Fit the arm of a folder by one peer."""
    peer, folder = words[0], Path(words[1])
    free = dict(START)
    gains = json.loads((folder / "gains.json").read_text())
    if gains["gains"] == "fitted":
        del free["damping"]
        for name in ("kp", "kd"):
            free[name] = (gains[name], gains[name] / 10, gains[name] * 10)
    if peer == "sysid":
        import mujoco.sysid
        import mujoco.sysid._src.residual  # noqa: F401, the error names what is missing
    imported_s = time.process_time()
    numbers, half = {"sysid": by_sysid, "scipy": by_scipy}[peer](folder, free)
    print(
        json.dumps(
            {
                "numbers": dict(zip(free, numbers.tolist(), strict=True)),
                "half": dict(zip(free, np.asarray(half).tolist(), strict=True)),
                "imports_s": imported_s,
                "fit_s": time.process_time() - imported_s,
            }
        )
    )


if __name__ == "__main__":
    main(sys.argv[1:])

"""Figures of the one-joint model and of controller identification. ``make bench ONLY=joint_model`` and ``ONLY=controller_sysid``.

The rival of identification is ``mujoco.sysid`` on the same recording. Its extra packages are not among ours; where they are not
installed (``pip install mujoco[sysid]``) its column stays empty.
"""

import contextlib
import dataclasses
import io
import math
import time
from collections.abc import Iterator
from statistics import median

import mujoco
import numpy as np

from pipelines.benchmarks import cameras as camera_benchmarks  # noqa: F401, registers its rows
from pipelines.benchmarks.rows import Row, against_reference, benchmark, cpu_times_s
from taccorl.alignment.controller import arm_bench
from taccorl.alignment.controller.identification import PAPER_BOUNDS, REFERENCE, identify_controller
from taccorl.alignment.controller.joint_model import JointModel
from taccorl.alignment.controller.joint_motion import JointMotion
from taccorl.alignment.controller.joint_recording import joint_motion
from taccorl.alignment.controller.rigid_joint import Gains
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.alignment.measurements.motions import SWEEP_HZ, SWEEP_S
from taccorl.robots import ROBOT
from taccorl.sim.bench import Bench
from taccorl.sim.controller import ControllerConfig
from taccorl.sim.effects import effects, make_effect
from taccorl.sim.effects.effect import Effect, JointEffect
from taccorl.sim.twin import TwinConfig

NOISE_RAD = 2e-4
RATE_HZ = 200.0


def sweep(signal: str, config: TwinConfig) -> tuple[JointMotion, np.ndarray]:
    """Simulated recording of the sweep of ``measurements.motions`` by MuJoCo, with the gains of ``config``.

    Returns:
        the motion, and (T,) what MuJoCo says without noise.
    """
    time_s = np.arange(round(SWEEP_S * RATE_HZ)) / RATE_HZ
    home = np.concatenate([[*Bench().home_rad[arm], 0.06] for arm in ROBOT.arms])
    target, column = np.tile(home, (len(time_s), 1)), ROBOT.action_names.index(signal)
    phase = 2 * np.pi * (SWEEP_HZ[0] * time_s + (SWEEP_HZ[1] - SWEEP_HZ[0]) * time_s**2 / (2 * SWEEP_S))
    target[:, column] += 0.25 * np.clip((time_s - 0.5) / 0.5, 0, 1) * np.sin(phase)
    gains = JointModel(config, signal).gains
    measured = target.copy()
    measured[:, column] += gains.torque_ff / gains.kp
    m = Measurement(name=f"simulated sweep of {signal}", time_s=time_s, target=target, measured=measured)
    true = in_mujoco(joint_motion(m, config, signal), signal, gains, config)
    measured[:, column] = true + NOISE_RAD * np.random.default_rng(column).normal(size=len(time_s))
    return joint_motion(m, config, signal), true


def in_mujoco(
    motion: JointMotion, signal: str, gains: Gains, config: TwinConfig, present: tuple[Effect, ...] = ()
) -> np.ndarray:
    """(T,) the joint's answer by MuJoCo's own steps."""
    hold = round(1 / (RATE_HZ * config.physics.timestep_s))
    return arm_bench.run(
        config,
        signal,
        motion.target,
        hold,
        np.zeros(len(motion.target) * hold),
        gains=gains,
        start=motion.start,
        pose=motion.pose,
        payload_kg=0.0,
        effects=arm_bench.of_joint(present, signal),
    )[0]


def _of_mujoco(name: str, times_s: list[float], rival_s: float) -> Row:
    shares, rival = [100 * t / rival_s for t in times_s], "MuJoCo, the arm with this joint alone, ms"
    return Row.of(shares, name=name, unit="% of MuJoCo's", goal="≤ 3", rival=rival, rival_value=1e3 * rival_s)


@benchmark("joint_model")
def joint_model() -> Iterator[Row]:
    """Cost of one simulated recording, and how far it is from MuJoCo."""
    config, signal = TwinConfig(), "left_joint2"
    model = JointModel(config, signal)
    motion, _ = sweep(signal, config)
    gains = model.gains._replace(torque_ff=0.0)  # in balance at its target
    motion = dataclasses.replace(motion, start=float(motion.target[0]))
    known: list[Effect] = []
    for name in effects:
        cls = effects.get(name)
        if issubclass(cls, JointEffect) and "joint2" in cls.possible:
            effect = make_effect(name, **{p.name: p.typical for p in cls.parameters()})
            known += [effect] * (effect.drive() is not None)
    replace = dataclasses.replace  # a model keeps the responses to a recording: each is simulated with a copy
    plain = cpu_times_s(lambda: model.simulate(replace(motion), gains), 20)
    rival = cpu_times_s(lambda: in_mujoco(motion, signal, gains, config), 5)
    yield _of_mujoco("one joint, 10 s at 200 Hz, 12 000 physics steps, CPU", plain, median(rival))
    costs = [median(cpu_times_s(lambda e=e: model.simulate(replace(motion), gains, [e]), 5)) for e in known]
    dearest = cpu_times_s(lambda: model.simulate(replace(motion), gains, [known[costs.index(max(costs))]]), 20)
    yield _of_mujoco(f"the same with the most expensive of {len(known)} effects of joints, CPU", dearest, median(rival))
    away = [
        float(
            np.abs(model.simulate(motion, gains, [e]).reported - in_mujoco(motion, signal, gains, config, (e,))).max()
        )
        for e in known
    ]
    worst = f"largest difference from MuJoCo in 10 s, any of {len(known)} effects at its typical strength"
    yield Row.of([1e6 * rad for rad in away], by=max, name=worst, unit="µrad", goal="≤ 10")


@benchmark("controller_sysid")
def controller_sysid() -> Iterator[Row]:
    """The paper's identification of all six joints from one simulated 10 s sweep each, with 0.2 mrad of noise."""
    config = TwinConfig()
    unknowing = TwinConfig(
        controller=ControllerConfig(
            kp_nm_per_rad=[REFERENCE.kp] * ROBOT.num_joints,
            kd_nms_per_rad=[REFERENCE.kd] * ROBOT.num_joints,
            torque_ff_nm=[REFERENCE.torque_ff] * ROBOT.num_joints,
        )
    )
    cost, ratio, rival_cost, rival_ratio, kp_off = ([] for _ in range(5))
    for joint in ROBOT.joints:
        signal = f"left_{joint}"
        truth = JointModel(config, signal).gains
        motion, _ = sweep(signal, config)
        model = JointModel(unknowing, signal)
        identify_controller([motion], model)  # compiled now
        begin = time.process_time()
        fit = identify_controller([motion], model)
        cost.append(time.process_time() - begin)
        ratio.append(_ratio_error(fit.gains, truth))
        kp_off.append(100.0 * abs(fit.gains.kp / truth.kp - 1.0))
        begin = time.process_time()
        found = _mujoco_sysid(motion, signal, unknowing)
        if found is not None:
            rival_cost.append(time.process_time() - begin)
            rival_ratio.append(_ratio_error(found, truth))
    rival = "mujoco.sysid, its scipy optimiser" if rival_cost else "mujoco.sysid is not installed"
    yield against_reference("controller of one joint from a 10 s sweep", cost, "≤ 300,000")
    if rival_cost:
        yield against_reference(f"the same by {rival}", rival_cost)
    name, worst = "K_d / K_p off by, worst of six joints", max(rival_ratio) if rival_ratio else None
    yield Row.of(ratio, by=max, name=name, unit="%", goal="≤ 1", rival=rival, rival_value=worst)
    yield Row.of(kp_off, by=max, name="K_p off by, worst of six joints", unit="%")


def _ratio_error(found: Gains, truth: Gains) -> float:
    """Of K_d / K_p, in percent."""
    return 100.0 * abs(found.kd / found.kp / (truth.kd / truth.kp) - 1.0)


def _mujoco_sysid(motion: JointMotion, signal: str, config: TwinConfig) -> Gains | None:
    """The same three numbers by MuJoCo's own tool, from the same start within the same bounds; None if it is not installed."""
    try:
        from mujoco import sysid

        parameters = sysid.ParameterDict()
    except (ImportError, AttributeError):
        return None
    arm, joint = arm_bench.split_signal(signal)
    spec = arm_bench.arm_spec(config, arm, motion.pose, [joint])

    def write(spec: mujoco.MjSpec, parameter) -> None:
        kp, kd, torque_ff = math.exp(parameter.value[0]), math.exp(parameter.value[1]), parameter.value[2]
        motor = spec.actuator(signal)
        motor.gainprm[0], motor.biasprm[:3] = kp, [torque_ff, -kp, -kd]

    low, high = np.array([PAPER_BOUNDS[name] for name in ("kp", "kd", "torque_ff")]).T
    logs = np.array([True, True, False])
    into = [np.where(logs, np.log(np.where(logs, ends, 1.0)), ends) for ends in (np.array(REFERENCE), low, high)]
    parameters.add(sysid.Parameter("eta", *into, modifier=write))
    model, step_s = spec.compile(), config.physics.timestep_s
    hold = round(1 / (RATE_HZ * step_s))
    command = np.repeat(motion.target, hold)[:, None]
    control = sysid.TimeSeries.from_control_names(np.arange(len(command)) * step_s, command, model)
    # It stamps what was before a step with the time after it.
    measured = sysid.TimeSeries.from_names(
        motion.time_s + step_s, motion.measured[:, None], model, names=[f"{signal}_pos"]
    )
    begin = sysid.create_initial_state(model, np.array([motion.start]), np.zeros(1))
    sequence = sysid.ModelSequences("arm", spec, "sweep", begin, control, measured)
    residual = sysid.build_residual_fn(models_sequences=[sequence])
    with contextlib.redirect_stdout(io.StringIO()):
        found, _ = sysid.optimize(initial_params=parameters, residual_fn=residual, optimizer="scipy", verbose=False)
    kp, kd, torque_ff = found["eta"].value
    return Gains(math.exp(kp), math.exp(kd), float(torque_ff))

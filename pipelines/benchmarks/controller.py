"""Figures of the one-joint model and of identification. ``make bench ONLY=joint_model`` and ``ONLY=controller_sysid``."""

import dataclasses
import time
from collections.abc import Iterator
from statistics import median

import mujoco
import numpy as np
from mujoco.batch import Batch

from pipelines.benchmarks import cameras as camera_benchmarks  # noqa: F401, registers its rows
from pipelines.benchmarks.one_joint import in_mujoco
from pipelines.benchmarks.rows import Row, against_reference, benchmark, cpu_times_s
from taccorl.alignment.controller.arm_joint import arm_spec, split_signal
from taccorl.alignment.controller.identification import REFERENCE, identify_controller
from taccorl.alignment.controller.joint_model import JointModel
from taccorl.alignment.controller.joint_motion import JointMotion
from taccorl.alignment.controller.joint_recording import joint_motion
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.alignment.measurements.motions import SWEEP_HZ, SWEEP_S
from taccorl.robots import ROBOT
from taccorl.sim.bench import Bench
from taccorl.sim.controller import ControllerConfig
from taccorl.sim.effects import effects, make_effect
from taccorl.sim.effects.effect import JointEffect
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
    phase = (
        2
        * np.pi
        * (
            SWEEP_HZ[0] * time_s
            + (SWEEP_HZ[1] - SWEEP_HZ[0]) * time_s**2 / (2 * SWEEP_S)
        )
    )
    target[:, column] += 0.25 * np.clip((time_s - 0.5) / 0.5, 0, 1) * np.sin(phase)
    gains = JointModel(config, signal).gains
    measured = target.copy()
    measured[:, column] += gains.torque_ff / gains.kp
    m = Measurement(
        name=f"simulated sweep of {signal}",
        time_s=time_s,
        target=target,
        measured=measured,
    )
    true = in_mujoco(
        joint_motion(m, config, signal), signal, gains, config=config
    ).reported
    measured[:, column] = true + NOISE_RAD * np.random.default_rng(column).normal(
        size=len(time_s)
    )
    return joint_motion(m, config, signal), true


def _rolled_out(motion: JointMotion, signal: str, config: TwinConfig) -> None:
    """Readings and, with the forces of each row, efforts of the arm with this joint alone, without effects, in MuJoCo."""
    arm, joint = split_signal(signal)
    model, hold = (
        arm_spec(config, arm, motion.pose, [joint]).compile(),
        round(1 / (RATE_HZ * config.physics.timestep_s)),
    )
    sent, state = (
        np.repeat(motion.target, hold)[None, :, None],
        int(mujoco.mjtState.mjSTATE_INTEGRATION),
    )
    done = Batch(model, 1, 1).rollout(
        sent.shape[1], sent, int(mujoco.mjtState.mjSTATE_CTRL), ("sensordata", state)
    )
    rows = Batch(model, len(motion.target), 1)
    rows.state[:] = done[state][0, ::hold]
    rows.forward()


def _of_mujoco(name: str, times_s: list[float], rival_s: float) -> Row:
    shares, rival = (
        [100 * t / rival_s for t in times_s],
        "MuJoCo, the arm with this joint alone, ms",
    )
    return Row.of(
        shares,
        name=name,
        unit="% of MuJoCo's",
        goal="≤ 3",
        rival=rival,
        rival_value=1e3 * rival_s,
    )


@benchmark("joint_model")
def joint_model() -> Iterator[Row]:
    """Cost of one simulated recording, and how far it is from MuJoCo."""
    config, signal = TwinConfig(), "left_joint2"
    model = JointModel(config, signal)
    motion, _ = sweep(signal, config)
    gains = model.gains._replace(torque_ff=0.0)  # in balance at its target
    motion = dataclasses.replace(motion, start=float(motion.target[0]))
    classes = {name: effects.get(name) for name in effects}
    possible = {
        name: c
        for name, c in classes.items()
        if issubclass(c, JointEffect) and "joint2" in c.possible
    }
    known = [
        make_effect(name, **{p.name: p.typical for p in c.parameters()})
        for name, c in possible.items()
    ]
    replace = (
        dataclasses.replace
    )  # a model keeps the responses to a recording: each is simulated with a copy
    plain = cpu_times_s(lambda: model.simulate(replace(motion), gains), 20)
    rival = cpu_times_s(lambda: _rolled_out(motion, signal, config), 5)
    yield _of_mujoco(
        "one joint, 10 s at 200 Hz, 12 000 physics steps, CPU", plain, median(rival)
    )
    costs = [
        median(cpu_times_s(lambda e=e: model.simulate(replace(motion), gains, [e]), 5))
        for e in known
    ]
    dearest = cpu_times_s(
        lambda: model.simulate(
            replace(motion), gains, [known[costs.index(max(costs))]]
        ),
        20,
    )
    yield _of_mujoco(
        f"the same with the most expensive of {len(known)} effects of joints, CPU",
        dearest,
        median(rival),
    )
    away = [
        np.abs(
            model.simulate(motion, gains, [e]).reported
            - in_mujoco(motion, signal, gains, [e]).reported
        ).max()
        for e in known
    ]
    worst = f"largest difference from MuJoCo in 10 s, any of {len(known)} effects at its typical strength"
    yield Row.of(
        [1e6 * float(rad) for rad in away], by=max, name=worst, unit="µrad", goal="≤ 10"
    )


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
    cost, ratio, kp_off = [], [], []
    for joint in ROBOT.joints:
        signal = f"left_{joint}"
        truth = JointModel(config, signal).gains
        motion, _ = sweep(signal, config)
        model = JointModel(unknowing, signal)
        identify_controller([motion], model)  # compiled now
        begin = time.process_time()
        fit = identify_controller([motion], model)
        cost.append(time.process_time() - begin)
        ratio.append(
            100.0 * abs(fit.gains.kd / fit.gains.kp / (truth.kd / truth.kp) - 1.0)
        )
        kp_off.append(100.0 * abs(fit.gains.kp / truth.kp - 1.0))
    yield against_reference(
        "controller of one joint from a 10 s sweep", cost, "≤ 300,000"
    )
    yield Row.of(
        ratio,
        by=max,
        name="K_d / K_p off by, worst of six joints",
        unit="%",
        goal="≤ 1",
    )
    yield Row.of(kp_off, by=max, name="K_p off by, worst of six joints", unit="%")

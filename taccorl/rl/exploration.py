"""Size of the exploration noise in physical units: joint targets [rad] and position of the hand [mm].

The policy's numbers are normalised, each step of a chunk by its own deviation; what a level of noise does to the arm follows only
after un-normalising. Here the same decisions are sampled twice from the same initial noise, with the stochastic step and without.

Letters in shapes: B decisions, n executed actions, A action.
"""

from typing import NamedTuple

import numpy as np
import torch

from taccorl.demos.experts.kinematics import ArmKinematics
from taccorl.evaluation.policy_actor import Processor
from taccorl.rl.flow_policy import Batch, FlowPolicy
from taccorl.rl.flow_sde import FlowSDE
from taccorl.robots import ROBOT
from taccorl.sim.robot import RobotConfig

_STEP_RAD = 1e-4  # of the finite difference of the forward kinematics


class Noise(NamedTuple):
    """Effect of exploration noise on actions and hands, as root mean squares over decisions, executed steps and both arms, for
    decisions whose stochastic denoising step is k."""

    step: int
    """Index k of the stochastic denoising step, from 0; −1: all steps are stochastic."""
    joints_rad: float
    """Change of the joint targets [rad]."""
    hand_mm: float
    """Displacement of the tool centre point [mm], by the arm's Jacobian at the targets."""
    offset_mm: float
    """Displacement of the tool centre point by the mean over a chunk [mm]."""
    gripper_mm: float
    """Change of the grippers' targets [mm]."""


def measure_noise(
    actor: FlowPolicy,
    sde: FlowSDE,
    batch: Batch,
    postprocess: Processor,
    robot: RobotConfig,
    generator: torch.Generator,
) -> list[Noise]:
    """Measure the noise of each denoising step (one stochastic step per decision), or give one entry with step −1 (all steps
    stochastic).

    Args:
        batch: preprocessed inputs of the policy, B rows.
        postprocess: the policy's postprocessor: actions (B, n, A) → targets [rad, m].
        robot: the twin's robot, for the kinematics of the arms.
        generator: random generator on the CPU.
    """
    draws = actor.draw(len(next(iter(batch.values()))), sde, generator)
    arms = [ArmKinematics(arm, robot) for arm in ROBOT.arms]

    def targets(step_BS: torch.Tensor) -> np.ndarray:
        """(B, n, A) [rad, m]."""
        sampled, _ = actor.sample(batch, sde, draws._replace(step_BS=step_BS))
        return postprocess(actor.actions(sampled.chunk_BHD)).to("cpu").numpy().astype(np.float64)

    def rms(x: np.ndarray) -> float:
        return float(np.sqrt((x**2).mean()))

    def hand_mm(noise: np.ndarray) -> float:
        return 1e3 * rms(np.stack([hand_shift_m(arm, plain, noise) for arm in arms]))

    plain, found = targets(torch.full_like(draws.step_BS, -1)), []
    for k in range(sde.num_steps) if sde.num_stochastic == 1 else [-1]:
        noise = targets(draws.step_BS if k < 0 else torch.full_like(draws.step_BS, k)) - plain
        joints, grippers = (noise.take(indices, axis=-1) for indices in (ROBOT.joint_indices, ROBOT.gripper_indices))
        offset_mm = hand_mm(noise.mean(axis=1, keepdims=True))
        found.append(Noise(k, rms(joints), hand_mm(noise), offset_mm, 1e3 * rms(grippers)))
    return found


def hand_shift_m(arm: ArmKinematics, targets_BnA: np.ndarray, noise_BnA: np.ndarray) -> np.ndarray:
    """Displacement of one arm's tool centre point by noise in its joint targets, (B,) [m].

    Root mean square over the n steps of |J δq|, with the Jacobian J at the last target of each chunk.

    Args:
        targets_BnA: targets of both arms without the noise [rad, m].
        noise_BnA: difference that the noise makes to them [rad, m].
    """
    own = ROBOT.joint_slice(arm.arm)
    shift_B = np.empty(len(targets_BnA))
    for b, (target, noise_nJ) in enumerate(zip(targets_BnA[:, -1, own], noise_BnA[:, :, own], strict=True)):
        columns = []
        for step in _STEP_RAD * np.eye(ROBOT.num_joints):
            columns.append((arm.pose(target + step)[:3, 3] - arm.pose(target - step)[:3, 3]) / (2 * _STEP_RAD))
        shift_B[b] = np.sqrt(((noise_nJ @ np.stack(columns)) ** 2).sum(-1).mean())
    return shift_B

"""Size of the exploration noise in physical units: joint targets [rad] and position of the hand [mm].

The policy's numbers are normalised, each step of a chunk by its own deviation; what a level of noise does to the arm follows only
after un-normalising. Here the same decisions are sampled twice from the same initial noise, with the stochastic step and without.

Letters in shapes: B decisions, n executed actions, A action.
"""

from dataclasses import dataclass

import numpy as np
import torch

from taccorl.demos.experts.kinematics import ArmKinematics
from taccorl.evaluation.policy_actor import Processor
from taccorl.rl.flow_policy import Batch, FlowPolicy
from taccorl.rl.flow_sde import Draws, FlowSDE
from taccorl.robots import ROBOT
from taccorl.sim.robot import RobotConfig

_STEP_RAD = 1e-4  # of the finite difference of the forward kinematics


@dataclass(frozen=True)
class Noise:
    """Effect of exploration noise, as root mean squares over decisions, executed steps and both arms, for decisions with the
    stochastic step k."""

    step: int
    joints_rad: float
    hand_mm: float
    """Displacement of the tool centre point [mm], by the arm's Jacobian at the targets."""
    offset_mm: float
    """Displacement of the tool centre point by the mean over a chunk [mm]."""
    gripper_mm: float


def measure_noise(
    actor: FlowPolicy,
    sde: FlowSDE,
    batch: Batch,
    postprocess: Processor,
    robot: RobotConfig,
    generator: torch.Generator,
) -> list[Noise]:
    """Measure the noise of each denoising step (one stochastic step per decision), or give one entry with step −1 (all steps
    stochastic)."""
    rows = len(next(iter(batch.values())))
    shape: tuple[int, int] = tuple(actor.scored_HD.shape)  # pyright: ignore[reportAssignmentType]
    draws = sde.draw(rows, shape, generator, actor.scored_HD.device)
    never = draws._replace(step_BS=torch.full_like(draws.step_BS, -1))
    plain = _targets(actor, sde, batch, never, postprocess)
    arms = [ArmKinematics(arm, robot) for arm in ROBOT.arms]
    found = []
    for k in sde.choices if sde.num_stochastic == 1 else [-1]:
        chosen = draws if k < 0 else draws._replace(step_BS=torch.full_like(draws.step_BS, k))
        noise = _targets(actor, sde, batch, chosen, postprocess) - plain
        joints, grippers = (noise.take(k, axis=-1) for k in (ROBOT.joint_indices, ROBOT.gripper_indices))
        hand_m = np.stack([hand_shift_m(arm, plain, noise) for arm in arms])
        mean = noise.mean(axis=1, keepdims=True)
        offset_m = np.stack([hand_shift_m(arm, plain, mean) for arm in arms])
        found.append(
            Noise(
                step=k,
                joints_rad=float(np.sqrt((joints**2).mean())),
                hand_mm=1e3 * float(np.sqrt((hand_m**2).mean())),
                offset_mm=1e3 * float(np.sqrt((offset_m**2).mean())),
                gripper_mm=1e3 * float(np.sqrt((grippers**2).mean())),
            )
        )
    return found


def hand_shift_m(arm: ArmKinematics, targets_BHA: np.ndarray, noise_BHA: np.ndarray) -> np.ndarray:
    """(B,) root mean square over the chunk of |J δq|, with the Jacobian J at the last target of each chunk."""
    own = ROBOT.joint_slice(arm.arm)
    shift_B = np.empty(len(targets_BHA))
    for b, (target, noise_HJ) in enumerate(zip(targets_BHA[:, -1, own], noise_BHA[:, :, own], strict=True)):
        columns = []
        for step in _STEP_RAD * np.eye(ROBOT.num_joints):
            columns.append((arm.pose(target + step)[:3, 3] - arm.pose(target - step)[:3, 3]) / (2 * _STEP_RAD))
        shift_B[b] = np.sqrt(((noise_HJ @ np.stack(columns)) ** 2).sum(-1).mean())
    return shift_B


def _targets(actor: FlowPolicy, sde: FlowSDE, batch: Batch, draws: Draws, postprocess: Processor) -> np.ndarray:
    """(B, n, A) [rad, m]."""
    sampled, _ = actor.sample(batch, sde, draws)
    return postprocess(actor.actions(sampled.chunk_BHD)).to("cpu").numpy().astype(np.float64)

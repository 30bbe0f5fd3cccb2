"""Size of the exploration noise in physical units: joint targets [rad] and position of the hand [mm].

The policy's numbers are normalised, each step of a chunk by its own deviation; what a level of noise does to the arm follows only
after un-normalising. Here the same decisions are sampled twice from the same initial noise, with the stochastic step and without.

Letters in shapes: B decisions, n executed actions, A action.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from taccorl.evaluation.policy_actor import Processor
from taccorl.policies.tactile_pi05.hand_poses import arm_chains, tcp_poses
from taccorl.rl.flow_policy import Batch, FlowPolicy
from taccorl.rl.flow_sde import FlowSDE
from taccorl.robots import ROBOT
from taccorl.sim.robot import RobotConfig


class Noise(NamedTuple):
    """Effect of exploration noise on actions and hands, as root mean squares over decisions, executed steps and both arms, for
    decisions whose stochastic denoising step is k."""

    step: int
    """Index k of the stochastic denoising step, from 0; −1: all steps are stochastic."""
    joints_rad: float
    """Change of the joint targets [rad]."""
    hand_mm: float
    """Displacement of the tool centre point at the targets [mm]."""
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
    seed: int,
) -> list[Noise]:
    """Measure the noise of each denoising step (one stochastic step per decision), or give one entry with step −1 (all steps
    stochastic).

    Args:
        batch: preprocessed inputs of the policy, B rows.
        postprocess: the policy's postprocessor: actions (B, n, A) → targets [rad, m].
        robot: the twin's robot, for the kinematics of the arms.
    """
    draws = actor.draw(
        len(next(iter(batch.values()))), sde, torch.Generator().manual_seed(seed)
    )

    def targets(step_BS: Tensor) -> Tensor:
        """(B, n, A) [rad, m]."""
        sampled, _ = actor.sample(batch, sde, draws._replace(step_BS=step_BS))
        return postprocess(actor.actions(sampled.chunk_BHD)).to("cpu", torch.float64)

    plain_BnA = targets(torch.full_like(draws.step_BS, -1))
    if sde.num_stochastic > 1:
        return [noise_of_targets(-1, robot, plain_BnA, targets(draws.step_BS))]
    noisy = [targets(torch.full_like(draws.step_BS, k)) for k in sde.steps]
    return [
        noise_of_targets(k, robot, plain_BnA, noisy_BnA)
        for k, noisy_BnA in zip(sde.steps, noisy, strict=True)
    ]


def noise_of_targets(
    step: int, robot: RobotConfig, plain_BnA: Tensor, noisy_BnA: Tensor
) -> Noise:
    """Compare targets with and without noise, (B, n, A) float64 each [rad, m]; ``step`` is that of ``Noise``."""
    chains = torch.tensor(arm_chains(robot), dtype=torch.float64)

    def hands_m(targets_BnA: Tensor) -> Tensor:
        """(arms, B, n, 3) positions of the tool centre points."""
        poses = torch.stack(tcp_poses(targets_BnA.flatten(0, 1), chains))
        return poses[:, :, :3, 3].unflatten(1, targets_BnA.shape[:2])

    def rms(x: Tensor) -> float:
        return float((x**2).mean().sqrt())

    noise, shift_mm = (
        noisy_BnA - plain_BnA,
        1e3 * (hands_m(noisy_BnA) - hands_m(plain_BnA)),
    )
    joints, grippers = (
        noise[:, :, list(indices)]
        for indices in (ROBOT.joint_indices, ROBOT.gripper_indices)
    )
    hand_mm, offset_mm = (
        rms(shift_mm.norm(dim=-1)),
        rms(shift_mm.mean(dim=2).norm(dim=-1)),
    )
    return Noise(step, rms(joints), hand_mm, offset_mm, 1e3 * rms(grippers))

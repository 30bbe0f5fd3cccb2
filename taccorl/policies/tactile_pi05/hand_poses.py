"""Poses of both hands from the joint angles: forward kinematics of the arms, in the policy's preprocessor.

A dataset's state is joint angles, and 1 mrad in each is 1 mm between two hands that meet. From scratch a policy does not learn
the arms' geometry to that accuracy, so it gets the poses (S features):

    left TCP, right TCP in the world; right TCP in the frame of the left       position and the first two columns of the rotation

The six numbers of a rotation are those of Zhou et al. 2019, On the Continuity of Rotation Representations in Neural Networks.
"""

import functools
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from lerobot.configs import PipelineFeatureType, PolicyFeature
from lerobot.processor import ObservationProcessorStep, ProcessorStep
from lerobot.utils.constants import OBS_STATE
from torch import Tensor

from taccorl.data.spec import find_spec, load_dataset_spec
from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT

if TYPE_CHECKING:
    from taccorl.sim.robot import RobotConfig

HAND_POSES = "observation.hand_poses"
"""Key of the hand poses, (B, 27): positions in units of ``WORLD_M`` and ``HAND_TO_HAND_M``, rotations without unit."""
NUM_HAND_POSES = 27
"""Size of ``HAND_POSES``."""
WORLD_M = 0.25
"""Unit of positions in the world frame [m]."""
HAND_TO_HAND_M = 0.1
"""Unit of the position of one hand in the other's frame [m]."""

# B batch, J joints


@functools.cache
def arm_names() -> tuple[str, ...]:
    """Return the names of the elements of state and action in datasets of the robot whose geometry is known, in their order."""
    names = load_dataset_spec(find_spec("taccorl_bimanual")).features["action"].names
    assert names is not None, "the data spec names its joints"
    return tuple(names)


def arm_chains(robot: "RobotConfig | None" = None) -> list[list[list[list[float]]]]:
    """Kinematic chain of each arm, lists of numbers as (arms, 7, 4, 4): pose of every link in its parent's frame at joint angle
    0 (the first in the world), then of the TCP in link 6 [m]. A joint turns about its own z axis. ``robot``: configuration
    of the robot; None: the nominal one."""
    import mujoco

    from taccorl.sim.robot import RobotConfig, add_arm

    chains = []
    for arm in ROBOT.arms:
        spec = mujoco.MjSpec()
        spec.compiler.degree = False
        add_arm(spec, arm, robot or RobotConfig())
        model = spec.compile()
        data = mujoco.MjData(model)
        data.qpos[:] = 0
        mujoco.mj_kinematics(model, data)
        joints = [model.joint(f"{arm}_{name}") for name in ROBOT.joints]
        frames = [
            _frame(data.xpos[j.bodyid[0]], data.xmat[j.bodyid[0]]) for j in joints
        ]
        site = model.site(f"{arm}_tcp").id
        frames.append(_frame(data.site_xpos[site], data.site_xmat[site]))
        before, chain = np.eye(4), []
        for frame in frames:
            chain.append(np.linalg.solve(before, frame).tolist())
            before = frame
        chains.append(chain)
    return chains


def _frame(position_m: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = matrix.reshape(3, 3), position_m
    return frame


def tcp_poses(state_BS: Tensor, chains: Tensor) -> list[Tensor]:
    """Return the poses world-from-TCP (B, 4, 4) [m], one tensor for each arm. ``state_BS``: joint angles [rad] and gripper
    openings [m], arm by arm. ``chains``: (arms, 7, 4, 4), see ``arm_chains``."""
    joints_BAJ = torch.stack(
        [state_BS[:, ROBOT.joint_slice(arm)] for arm in ROBOT.arms], dim=1
    )  # A arms, J joints
    cos_BAJ, sin_BAJ = joints_BAJ.cos(), joints_BAJ.sin()
    turns_BAJ44 = torch.eye(4, dtype=state_BS.dtype, device=state_BS.device).repeat(
        *joints_BAJ.shape, 1, 1
    )
    turns_BAJ44[..., 0, 0], turns_BAJ44[..., 0, 1] = cos_BAJ, -sin_BAJ
    turns_BAJ44[..., 1, 0], turns_BAJ44[..., 1, 1] = sin_BAJ, cos_BAJ
    steps_BAJ44 = _product(chains[:, :-1], turns_BAJ44)
    poses_BA44 = steps_BAJ44[:, :, 0]
    for j in range(1, ROBOT.num_joints):
        poses_BA44 = _product(poses_BA44, steps_BAJ44[:, :, j])
    return list(_product(poses_BA44, chains[:, -1]).unbind(1))


def _product(a: Tensor, b: Tensor) -> Tensor:
    """a @ b. On a GPU as products and sums: LeRobot allows matmul to round to ten bits (TF32), half a millimetre of half a
    metre."""
    return (a[..., :, :, None] * b[..., None, :, :]).sum(-2) if a.is_cuda else a @ b


def hand_poses(state_BS: Tensor, chains: Tensor) -> Tensor:
    """Hand poses (B, 27) as ``HAND_POSES`` describes. ``state_BS`` and ``chains`` as of ``tcp_poses``."""
    left_B44, right_B44 = tcp_poses(state_BS, chains)
    turn_B33 = left_B44[:, :3, :3].transpose(1, 2)
    between_B3 = _product(turn_B33, right_B44[:, :3, 3:] - left_B44[:, :3, 3:])[:, :, 0]
    told = []
    for position_B3, rotation_B33 in (
        (left_B44[:, :3, 3] / WORLD_M, left_B44[:, :3, :3]),
        (right_B44[:, :3, 3] / WORLD_M, right_B44[:, :3, :3]),
        (between_B3 / HAND_TO_HAND_M, _product(turn_B33, right_B44[:, :3, :3])),
    ):
        told += [position_B3, rotation_B33[:, :, 0], rotation_B33[:, :, 1]]
    return torch.cat(told, dim=1)


class KeepsFeatures(ProcessorStep):
    """A step after which a dataset's or policy's features are what they were."""

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        return features


@dataclass(kw_only=True)
class ArmStep(KeepsFeatures, ObservationProcessorStep):
    """Base of preprocessor steps that compute poses from a state that is not normalised yet. A checkpoint stores the arms'
    geometry."""

    chains: list[list[list[list[float]]]] = field(default_factory=arm_chains)
    """(arms, 7, 4, 4), see ``arm_chains``."""

    def __post_init__(self) -> None:
        self._chains: dict[torch.device, Tensor] = {}

    def states(self, observation: dict[str, Any], need: str) -> tuple[Tensor, Tensor]:
        """States (B, S) float32 of an observation, with all leading axes in one, and the chains on their device. Raises
        TaccorlError: the state has other joints than the arms; ``need`` says for what they are needed."""
        state_BS = torch.as_tensor(observation[OBS_STATE])
        if state_BS.shape[-1] != len(arm_names()):
            names = f"the {len(arm_names())} of {', '.join(arm_names())}"
            raise TaccorlError(
                f"{OBS_STATE} has {state_BS.shape[-1]} numbers, but {need.format(names)}"
            )
        chains = self._chains.get(state_BS.device)
        if chains is None:
            chains = self._chains[state_BS.device] = torch.tensor(
                self.chains, device=state_BS.device
            )
        return state_BS.reshape(-1, state_BS.shape[-1]).to(torch.float32), chains


@dataclass(kw_only=True)
class HandPosesStep(ArmStep):
    """Preprocessor step that adds ``HAND_POSES`` to an observation."""

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """Return the observation with ``HAND_POSES`` (…, 27) added, computed from its state (…, S). Raises TaccorlError: the
        state has other joints than the arms."""
        need = "hand poses are computed from {}: another robot needs --policy.hand_poses=false"
        told = hand_poses(*self.states(observation, need))
        return {
            **observation,
            HAND_POSES: told.reshape(
                *observation[OBS_STATE].shape[:-1], NUM_HAND_POSES
            ),
        }

    def get_config(self) -> dict[str, Any]:
        return {"chains": self.chains}

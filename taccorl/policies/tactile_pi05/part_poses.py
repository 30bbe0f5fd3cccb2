"""Poses of the task's parts for the state's token: absolute, between parts and relative to both hands, computed in the
preprocessor.

Of each body (P of them) the observation has its pose in the world, ``observation.environment_state``. The policy gets

    each body in the world                       p / 0.25 m and six numbers of the rotation                                  9 · P
    body i in the frame of body j, all i < j     d / 0.1 m, tanh(d / 10 mm), tanh(d / 2 mm) and six numbers   15 · P (P − 1) / 2
    each body in the frame of each TCP           p / 0.1 m and six numbers                                                  18 · P

The six numbers of a rotation are its first two columns (see ``hand_poses``). The two tanh keep fractions of a millimetre visible
where parts mate.
"""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from taccorl.errors import TaccorlError
from taccorl.policies.tactile_pi05.hand_poses import (
    HAND_TO_HAND_M,
    WORLD_M,
    ArmStep,
    tcp_poses,
)
from taccorl.sim.part_poses import PARTS_KEY, POSE_NAMES

PART_POSES = "observation.part_poses"
"""Key of the parts' poses, (B, ``num_part_numbers``), in the order of the module's table."""
PART_TO_PART_M = HAND_TO_HAND_M
"""Unit of positions in the frame of a body or a TCP [m]."""
FINE_M = (0.01, 0.002)
"""Units of positions between bodies within the tanh [m]."""
TARGET_M = 0.0025
"""Unit of errors in the loss of ``PoseHead`` [m]: standard deviation of a part's position in a hand that holds it, over many
grips."""
TARGET_BETA = 0.3
"""Error in units of ``TARGET_M`` below which the loss is quadratic: 0.75 mm. Finer errors decide whether parts mate."""
LEVER_M = 0.1
"""Length by which numbers of a rotation are multiplied [m]: 10 mrad count as 1 mm, as at the far end of a part in a hand."""
NEAR_M = 0.05
"""Distance at which the unit of errors has doubled [m]: a part that lies far from the hand matters less than one in it."""
_POSE = len(POSE_NAMES)
_PAIR = _POSE + 3 * len(FINE_M)
_ARMS = 2
_HIDDEN = 512

# B batch, S state, P bodies, Q pairs of bodies, D of a token, V vectors


def num_pairs(num_bodies: int) -> int:
    """Q: number of pairs of bodies."""
    return num_bodies * (num_bodies - 1) // 2


def num_part_numbers(num_bodies: int) -> int:
    """Size of ``PART_POSES`` for a task with ``num_bodies`` parts."""
    return (1 + _ARMS) * _POSE * num_bodies + _PAIR * num_pairs(num_bodies)


def part_poses(poses_BN: Tensor, tcps: list[Tensor]) -> Tensor:
    """Numbers (B, ``num_part_numbers``), float32, that the policy gets for the poses of P parts; the module's table lists them.
    ``poses_BN``: (B, 9 P) as from ``taccorl.sim.part_poses``. ``tcps``: pose world-from-TCP (B, 4, 4) of each arm."""
    poses_BP9 = poses_BN.to(torch.float32).unflatten(-1, (-1, _POSE))
    position_BP3 = poses_BP9[..., :3]
    x_BP3, y_BP3 = poses_BP9[..., 3:6], poses_BP9[..., 6:9]
    rotation_BP33 = torch.stack(
        [x_BP3, y_BP3, torch.linalg.cross(x_BP3, y_BP3)], dim=-1
    )
    numbers = [torch.cat([position_BP3 / WORLD_M, x_BP3, y_BP3], dim=-1).flatten(1)]

    i_Q, j_Q = torch.triu_indices(
        poses_BP9.shape[1], poses_BP9.shape[1], 1, device=poses_BP9.device
    )
    frame_BQ33 = rotation_BP33[:, j_Q]
    offset_BQ3 = _turned_back(frame_BQ33, position_BP3[:, i_Q] - position_BP3[:, j_Q])
    turn = [_turned_back(frame_BQ33, axis_BP3[:, i_Q]) for axis_BP3 in (x_BP3, y_BP3)]
    fine = [(offset_BQ3 / unit_m).tanh() for unit_m in FINE_M]
    numbers.append(
        torch.cat([offset_BQ3 / PART_TO_PART_M, *fine, *turn], dim=-1).flatten(1)
    )

    for tcp_B44 in tcps:
        frame_B133 = tcp_B44[:, None, :3, :3]
        offset_BP3 = _turned_back(frame_B133, position_BP3 - tcp_B44[:, None, :3, 3])
        turn = [_turned_back(frame_B133, axis_BP3) for axis_BP3 in (x_BP3, y_BP3)]
        numbers.append(
            torch.cat([offset_BP3 / PART_TO_PART_M, *turn], dim=-1).flatten(1)
        )
    return torch.cat(numbers, dim=1)


def _turned_back(rotation: Tensor, vector: Tensor) -> Tensor:
    """Rᵀ v. Products and sums, no matmul: a GPU's may round to ten bits (TF32), half a millimetre of half a metre."""
    return (rotation * vector[..., :, None]).sum(-2)


def relative_poses_m(part_poses_BN: Tensor, num_bodies: int) -> Tensor:
    """(B, V, 9) poses extracted from ``PART_POSES`` (B, N): body i in the frame of body j for each pair of ``num_bodies`` bodies,
    then the bodies in the frame of each TCP. Each is a position [m] and the first two columns of the rotation times ``LEVER_M``.
    """
    first, pairs = _POSE * num_bodies, num_pairs(num_bodies)
    in_hands_BV9 = part_poses_BN[:, first + _PAIR * pairs :].unflatten(-1, (-1, _POSE))
    if pairs:
        between_BQ = part_poses_BN[:, first : first + _PAIR * pairs].unflatten(
            -1, (pairs, _PAIR)
        )
        between_BQ9 = torch.cat(
            [between_BQ[..., :3], between_BQ[..., _PAIR - _POSE + 3 :]], dim=-1
        )
        in_hands_BV9 = torch.cat([between_BQ9, in_hands_BV9], dim=1)
    units_m = in_hands_BV9.new_tensor([PART_TO_PART_M] * 3 + [LEVER_M] * (_POSE - 3))
    return units_m * in_hands_BV9


@dataclass(kw_only=True)
class PartPosesStep(ArmStep):
    """Preprocessor step that adds ``PART_POSES`` to an observation."""

    names: list[str]
    """Names of the elements of ``observation.environment_state``."""
    required: bool = True
    """False: only training uses the poses (the pose loss), and an observation without them is accepted."""

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """Return the observation with ``PART_POSES`` (…, ``num_part_numbers``) added, computed from the parts' poses and its
        state. Raises TaccorlError: the observation has no poses of the parts, or those of other parts, or is of another
        robot."""
        if PARTS_KEY not in observation and not self.required:
            return observation
        if PARTS_KEY not in observation:
            raise TaccorlError(
                f"--policy.part_poses=true: the observation has no {PARTS_KEY}. Make datasets with taccorl collect "
                "--part_poses=true, and environments with part_poses=True (LeRobot's: --env.part_poses=true)"
            )
        poses = torch.as_tensor(observation[PARTS_KEY])
        if poses.shape[-1] != len(self.names):
            raise TaccorlError(
                f"{PARTS_KEY} has {poses.shape[-1]} numbers, but the policy was trained with the {len(self.names)} of "
                f"{', '.join(bodies_of(self.names))}: it is another task"
            )
        tcps = tcp_poses(*self.states(observation, "--policy.part_poses=true needs {}"))
        numbers_BN = part_poses(poses.reshape(-1, poses.shape[-1]), tcps)
        return {**observation, PART_POSES: numbers_BN.reshape(*poses.shape[:-1], -1)}

    def get_config(self) -> dict[str, Any]:
        return {"names": self.names, "required": self.required, "chains": self.chains}


def bodies_of(names: list[str]) -> list[str]:
    """Return the bodies named in the features' names, such as ``plug`` in ``plug.x``, each once and in their order."""
    return [name.rpartition(".")[0] for name in names[::_POSE]]


class PoseHead(nn.Module):
    """Network that predicts the poses of the parts relative to each other and to both hands (``relative_poses_m``) from the
    output of ``Fusion``. Used only in training, for an auxiliary loss."""

    def __init__(self, num_inputs: int, num_bodies: int) -> None:
        super().__init__()
        self.num_vectors = num_pairs(num_bodies) + _ARMS * num_bodies
        self.num_bodies = num_bodies
        self.hidden = nn.Linear(num_inputs, _HIDDEN)
        self.out = nn.Linear(_HIDDEN, _POSE * self.num_vectors)

    def forward(self, fused_BF: Tensor) -> Tensor:
        """Predict relative poses (B, V, 9), in units of ``PART_TO_PART_M``, from the fusion's output (B, F)."""
        return self.out(F.silu(self.hidden(fused_BF))).unflatten(
            -1, (self.num_vectors, _POSE)
        )

    def errors(self, fused_BF: Tensor, part_poses_BN: Tensor) -> tuple[Tensor, Tensor]:
        """Return the smooth L1 loss (B,), quadratic below ``TARGET_BETA``, of errors in units of ``TARGET_M`` · (1 + d /
        ``NEAR_M``) at distance d; and the root mean square error [mm] of the positions with d < ``NEAR_M``, a scalar.

        Rows with unknown poses (NaN, see ``training.cotrain``) have the loss 0, and the others are weighted so that the mean of
        all rows is that of the known ones."""
        known_B = part_poses_BN.isfinite().all(dim=1)
        weight_B = known_B * (len(known_B) / known_B.sum().clamp(min=1))
        target_BV9 = relative_poses_m(part_poses_BN, self.num_bodies).nan_to_num()
        error_BV9 = PART_TO_PART_M * self(fused_BF).to(torch.float32) - target_BV9
        distance_BV1 = target_BV9[..., :3].norm(dim=2, keepdim=True)
        scaled_BV9 = error_BV9 / (TARGET_M * (1 + distance_BV1 / NEAR_M))
        losses_BV9 = F.smooth_l1_loss(
            scaled_BV9, torch.zeros_like(scaled_BV9), beta=TARGET_BETA, reduction="none"
        )
        near_BV = (distance_BV1[..., 0] < NEAR_M) * known_B[:, None]
        squared_BV = error_BV9[..., :3].detach().square().sum(-1) * near_BV
        rms_m = (squared_BV.sum() / near_BV.sum().clamp(min=1)).sqrt()
        return losses_BV9.mean(dim=(1, 2)) * weight_B, 1e3 * rms_m

"""Flow-matching policy for PPO: sampling with Flow-SDE, log-probabilities of samples, and features for the critic.

Sampling and scoring run the same computation: one pass over the prefix, whose keys and values are kept, then the action expert
for each denoising step, in evaluation mode. So the ratio of probabilities before the first update is 1 up to the rounding of
float32.

Letters in shapes: B batch, T tokens of the prefix, H horizon, D padded action, A action, F features of the critic.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import torch
from lerobot.policies.pi05.modeling_pi05 import (
    make_att_2d_masks,
    prepare_attention_masks_4d,
)
from lerobot.utils.constants import (
    OBS_LANGUAGE_ATTENTION_MASK,
    OBS_LANGUAGE_TOKENS,
    OBS_STATE,
)
from torch import Tensor, nn

from taccorl.policies.tactile_pi05.cameras import NormReLU
from taccorl.policies.tactile_pi05.modeling_tactile_pi05 import TactilePI05Policy
from taccorl.policies.tactile_pi05.part_poses import PART_POSES, num_part_numbers
from taccorl.rl.flow_sde import Draws, FlowSDE, Sampled, Velocity
from taccorl.rl.settings import PolicySettings

Batch = dict[str, Tensor]
"""Preprocessed inputs of the policy: LeRobot key → tensor with B rows."""
Compute = Callable[[Any, Velocity, Tensor], tuple[Tensor, ...]]
"""Function (rows, velocity field of these rows, their features (n, F)) → tensors with n rows."""


class FlowPolicy(ABC):
    """Interface of a flow-matching policy for PPO: sampling of chunks, their log-probabilities, and features for the critic."""

    scored_HD: Tensor
    """(H, D) bool: numbers of a chunk that are executed, and so count in the log-probability."""

    @abstractmethod
    def each(self, batch: Batch, compute: Compute) -> tuple[Tensor, ...]:
        """Call ``compute`` for each group of rows that are computed together, and return its tensors, (B, …) each, in the order
        of the batch's B rows."""

    @abstractmethod
    def actions(self, chunk_BHD: Tensor) -> Tensor:
        """Executed actions (B, n, A) of a denoised chunk, before the postprocessor."""

    @abstractmethod
    def trained_parameters(self) -> list[nn.Parameter]:
        """The weights that the actor's optimiser changes."""

    def draw(self, num_rows: int, sde: FlowSDE, generator: torch.Generator) -> Draws:
        """Random numbers for ``sample`` of ``num_rows`` rows; ``generator`` is on the CPU, the result on the policy's device."""
        return sde.draw(
            num_rows, tuple(self.scored_HD.shape), generator, self.scored_HD.device
        )

    @torch.no_grad()
    def sample(
        self, batch: Batch, sde: FlowSDE, draws: Draws
    ) -> tuple[Sampled, Tensor]:
        """Sample chunks with their log-probabilities, and return them with the features (B, F) of the critic."""

        def compute(
            rows: Any, velocity: Velocity, features_BF: Tensor
        ) -> tuple[Tensor, ...]:
            return *sde.sample(velocity, draws.rows(rows), self.scored_HD), features_BF

        *sampled, features_BF = self.each(batch, compute)
        return Sampled(*sampled), features_BF

    @torch.no_grad()
    def features(self, batch: Batch) -> Tensor:
        """Features (B, F) of the B rows of ``batch``, inputs of the critic."""
        return self.each(batch, lambda rows, velocity, features_BF: (features_BF,))[0]

    def log_prob(
        self,
        batch: Batch,
        sde: FlowSDE,
        before_BSHD: Tensor,
        after_BSHD: Tensor,
        step_BS: Tensor,
    ) -> Tensor:
        """(B,) log-probability of stored stochastic steps; differentiable. The tensors are those of ``Sampled`` and ``Draws``."""

        def compute(
            rows: Any, velocity: Velocity, features_BF: Tensor
        ) -> tuple[Tensor, ...]:
            return (
                sde.log_prob(
                    velocity,
                    before_BSHD[rows],
                    after_BSHD[rows],
                    step_BS[rows],
                    self.scored_HD,
                ),
            )

        return self.each(batch, compute)[0]


class TactileFlowPolicy(FlowPolicy):
    """``TactilePI05Policy`` for PPO. It acts with the trained weights, not with their exponential mean, because PPO changes the
    former."""

    def __init__(
        self, policy: TactilePI05Policy, settings: PolicySettings, num_steps: int
    ) -> None:
        """
        Args:
            policy: is switched to evaluation mode; the weights with which it acts, possibly an exponential mean, become the
                trained ones.
            num_steps: K_denoise, also stored in the checkpoints.
        """
        policy.eval()
        config = policy.config
        policy.averaged, config.average_decay = None, 0.0
        policy.pose_head, config.pose_loss = (
            None,
            0.0,
        )  # the anchor is the loss of the flow alone
        config.num_inference_steps = num_steps
        self.policy, self.model = policy.float(), policy.model
        for module in self.model.modules():
            if isinstance(module, NormReLU):
                module.compiles_updates = settings.compile
        if settings.trained == "expert":
            self.model.paligemma_with_expert.paligemma.requires_grad_(False)
        self.scored_HD = torch.zeros(
            config.chunk_size,
            config.max_action_dim,
            dtype=torch.bool,
            device=config.device,
        )
        self.scored_HD[
            : config.n_action_steps, : (config.output_features or {})["action"].shape[0]
        ] = True

    @property
    def num_features(self) -> int:
        """F: size of the critic's features."""
        config = self.policy.config
        width = self.model.paligemma_with_expert.paligemma.model.language_model.config.hidden_size
        if config.has_discrete_state:
            return width
        num_poses = num_part_numbers(config.num_bodies) if config.part_poses else 0
        return width + (config.input_features or {})[OBS_STATE].shape[0] + num_poses

    def trained_parameters(self) -> list[nn.Parameter]:
        return [p for p in self.policy.parameters() if p.requires_grad]

    def actions(self, chunk_BHD: Tensor) -> Tensor:
        return self.policy._finished(chunk_BHD)[:, : self.policy.config.n_action_steps]

    def each(self, batch: Batch, compute: Compute) -> tuple[Tensor, ...]:
        policy, config = self.policy, self.policy.config
        assert not policy.training, (
            "sampling and scoring use the kernels of evaluation mode"
        )
        batch = {
            k: x.to(torch.float32) / 255 if x.dtype == torch.uint8 else x
            for k, x in batch.items()
        }
        images, image_masks = policy._preprocess_images(batch)
        images = policy._tokens(images)
        prompt = batch[OBS_LANGUAGE_TOKENS], batch[OBS_LANGUAGE_ATTENTION_MASK]

        def of_rows(rows: Any) -> tuple[Tensor, ...]:
            seen = (
                [image[rows] for image in images],
                [mask[rows] for mask in image_masks],
            )
            valid_BT, cache, features_BF = self._prefix(
                *seen, *(x[rows] for x in prompt)
            )
            if not config.has_discrete_state:  # else the prompt has it
                numbers = [OBS_STATE] + [PART_POSES] * config.part_poses
                features_BF = torch.cat(
                    [
                        features_BF,
                        *(batch[key][rows].to(torch.float32) for key in numbers),
                    ],
                    dim=1,
                )

            def velocity(x_BHD: Tensor, t_B: Tensor) -> Tensor:
                return self.model.denoise_step(valid_BT, cache, x_BHD, t_B)

            return compute(rows, velocity, features_BF)

        return policy._by_contact(batch, of_rows)[0]

    def _prefix(
        self,
        images: list[Tensor],
        masks: list[Tensor],
        tokens: Tensor,
        token_mask: Tensor,
    ) -> tuple[Tensor, Any, Tensor]:
        """Which tokens of the prefix are valid (B, T), its keys and values as LeRobot's ``sample_actions`` computes them, and its
        mean valid token (B, F)."""
        backbone = self.model.paligemma_with_expert
        embedded_BTD, valid_BT, starts_block_BT = self.model.embed_prefix(
            images, masks, tokens, token_mask
        )
        backbone.paligemma.model.language_model.config._attn_implementation = "eager"  # pyright: ignore
        (hidden_BTD, _), cache = backbone.forward(
            attention_mask=prepare_attention_masks_4d(
                make_att_2d_masks(valid_BT, starts_block_BT)
            ),
            position_ids=torch.cumsum(valid_BT, dim=1) - 1,
            past_key_values=None,
            inputs_embeds=[embedded_BTD, None],
            use_cache=True,
        )
        weight_BT = valid_BT.to(torch.float32) / valid_BT.sum(dim=1, keepdim=True)
        return (
            valid_BT,
            cache,
            (hidden_BTD.to(torch.float32) * weight_BT[:, :, None]).sum(dim=1).detach(),
        )

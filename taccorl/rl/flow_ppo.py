"""PPO as LeRobot's ``RLAlgorithm`` with the name ``flow_ppo``: its configuration, its update and its checkpoints.

Importing this registers it: LeRobot then makes its configuration by name (``make_algorithm_config("flow_ppo")``, 0.6.1). Its
``make_algorithm`` knows only ``sac``, its learner only replay buffers: build the algorithm by ``FlowPPO(policy, config)``.
The plug-in does not import it, as every command of LeRobot would load its own RL algorithms. ``taccorl post-train`` uses ``PPO``.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import torch
from lerobot.configs import PreTrainedConfig
from lerobot.rl.algorithms.base import RLAlgorithm
from lerobot.rl.algorithms.configs import RLAlgorithmConfig, TrainingStats
from torch import Tensor

from taccorl.policies.tactile_pi05.modeling_tactile_pi05 import TactilePI05Policy
from taccorl.rl.anchor import Anchor
from taccorl.rl.critic import Critic
from taccorl.rl.flow_policy import TactileFlowPolicy
from taccorl.rl.flow_sde import FlowSDE
from taccorl.rl.ppo import PPO, Decisions
from taccorl.rl.settings import FlowSDESettings, PolicySettings, PPOSettings


@RLAlgorithmConfig.register_subclass("flow_ppo")
@dataclass(kw_only=True)
class FlowPPOConfig(PPOSettings, RLAlgorithmConfig):
    """Settings of ``--ppo``, ``--policy`` and ``--noise`` of ``taccorl post-train``."""

    policy: PolicySettings = field(default_factory=PolicySettings)
    noise: FlowSDESettings = field(default_factory=FlowSDESettings)
    num_privileged: int = 0
    """Number of values of the simulator's state that are inputs of the critic."""
    seed: int = 0
    """Seed of the random order in which decisions are used, and of the choice of real rows for the anchor."""
    policy_config: PreTrainedConfig | None = None
    """LeRobot's configuration of the policy; its interface requires the field."""

    @classmethod
    def from_policy_config(cls, policy_cfg: Any) -> "FlowPPOConfig":
        return cls(policy_config=policy_cfg)


class FlowPPO(RLAlgorithm):
    """``PPO`` with LeRobot's interface. A batch is a rollout: ``Decisions``."""

    config_class, name = FlowPPOConfig, "flow_ppo"

    def __init__(self, policy: TactilePI05Policy, config: FlowPPOConfig, anchor: Anchor | None = None) -> None:
        self.config = config
        actor = TactileFlowPolicy(policy, config.policy, config.noise.num_steps)
        critic = Critic(actor.num_features, config.num_privileged).to(actor.scored_HD.device)
        self.policy, self.ppo = policy, PPO(actor, critic, FlowSDE(config.noise), config, anchor)
        self.generator = torch.Generator().manual_seed(config.seed)

    def update(self, batch_iterator: Iterator[Decisions]) -> TrainingStats:
        facts = self.ppo.update(next(batch_iterator), self.generator)
        self.optimization_step += 1
        losses = {name: facts.pop(name) for name in list(facts) if name.endswith("_loss")}
        return TrainingStats(losses, extra=facts)

    def make_optimizers_and_scheduler(self) -> dict[str, torch.optim.Optimizer]:
        return self.get_optimizers()

    def get_optimizers(self) -> dict[str, torch.optim.Optimizer]:
        return {"actor": self.ppo.actor_optimizer, "critic": self.ppo.critic_optimizer}

    def get_weights(self) -> dict[str, Any]:
        return self.policy.state_dict()

    def load_weights(self, weights: dict[str, Any], device: str | torch.device = "cpu") -> None:
        self.policy.load_state_dict(weights)

    def state_dict(self) -> dict[str, Tensor]:
        """Weights of the critic: ``critic.NAME`` → tensor of any shape."""
        return {f"critic.{name}": x for name, x in self.ppo.critic.state_dict().items()}

    def load_state_dict(self, state_dict: dict[str, Tensor], device: str | torch.device = "cpu") -> None:
        """Load weights as from ``state_dict``, tensors of any shape."""
        self.ppo.critic.load_state_dict({name.removeprefix("critic."): x for name, x in state_dict.items()})

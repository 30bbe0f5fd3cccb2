"""PPO as LeRobot's ``RLAlgorithm`` with the name ``flow_ppo``: its configuration, its update and its checkpoints.

``flow_ppo_config`` registers the configuration when it is imported, which LeRobot then makes by name
(``make_algorithm_config("flow_ppo")``, 0.6.1). Its ``make_algorithm`` knows only ``sac``,
its learner only replay buffers: build the algorithm by ``FlowPPO(policy, config)``. ``taccorl post-train`` uses ``PPO`` itself.
"""

from collections.abc import Iterator
from typing import Any

import torch
from lerobot.rl.algorithms.base import RLAlgorithm
from lerobot.rl.algorithms.configs import TrainingStats
from torch import Tensor

from taccorl.policies.tactile_pi05.modeling_tactile_pi05 import TactilePI05Policy
from taccorl.rl.anchor import Anchor
from taccorl.rl.critic import Critic
from taccorl.rl.flow_policy import TactileFlowPolicy
from taccorl.rl.flow_ppo_config import FlowPPOConfig
from taccorl.rl.flow_sde import FlowSDE
from taccorl.rl.ppo import PPO, Decisions


class FlowPPO(RLAlgorithm):
    """``PPO`` with LeRobot's interface. A batch is a rollout: ``Decisions``."""

    config_class, name = FlowPPOConfig, "flow_ppo"

    def __init__(self, policy: TactilePI05Policy, config: FlowPPOConfig, anchor: Anchor | None = None) -> None:
        self.config = config
        actor = TactileFlowPolicy(policy, config.policy, config.noise.num_steps)
        critic = Critic(actor.num_features, config.num_privileged).to(actor.scored_HD.device)
        self.ppo = PPO(actor, critic, FlowSDE(config.noise), config, anchor)
        self.generator = torch.Generator().manual_seed(config.seed)

    def update(self, batch_iterator: Iterator[Decisions]) -> TrainingStats:
        facts = self.ppo.update(next(batch_iterator), self.generator)
        self.optimization_step += 1
        losses = {name: facts.pop(name) for name in list(facts) if name.endswith("_loss")}
        norms = {
            name.removesuffix("_grad_norm"): facts.pop(name) for name in list(facts) if name.endswith("_grad_norm")
        }
        return TrainingStats(losses, norms, facts)

    def make_optimizers_and_scheduler(self) -> dict[str, torch.optim.Optimizer]:
        return self.get_optimizers()

    def get_optimizers(self) -> dict[str, torch.optim.Optimizer]:
        return {"actor": self.ppo.actor_optimizer, "critic": self.ppo.critic_optimizer}

    def get_weights(self) -> dict[str, Any]:
        return self.ppo.actor.policy.state_dict()  # pyright: ignore[reportAttributeAccessIssue]

    def load_weights(self, weights: dict[str, Any], device: str | torch.device = "cpu") -> None:
        self.ppo.actor.policy.load_state_dict(weights)  # pyright: ignore[reportAttributeAccessIssue]

    def state_dict(self) -> dict[str, Tensor]:
        return {f"critic.{name}": x for name, x in self.ppo.critic.state_dict().items()}

    def load_state_dict(self, state_dict: dict[str, Tensor], device: str | torch.device = "cpu") -> None:
        self.ppo.critic.load_state_dict({name.removeprefix("critic."): x for name, x in state_dict.items()})

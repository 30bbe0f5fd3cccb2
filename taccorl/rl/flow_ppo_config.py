"""``flow_ppo`` in LeRobot's registry of RL algorithms: importing this registers it. The plug-in does not import it, as every
command of LeRobot would load its own RL algorithms. The algorithm itself is in ``flow_ppo.py``, which loads policies.
"""

from dataclasses import dataclass, field
from typing import Any

from lerobot.configs import PreTrainedConfig
from lerobot.rl.algorithms.configs import RLAlgorithmConfig

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

    @classmethod
    def from_policy_config(cls, policy_cfg: Any) -> "FlowPPOConfig":
        return cls(policy_config=policy_cfg)

"""Settings of post-training; the defaults are the paper's table of post-training parameters. Free of torch."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from taccorl.errors import TaccorlError, nearest


@dataclass(kw_only=True)
class PolicySettings:
    """The policy to post-train."""

    path: Path | None = None
    """Folder ``pretrained_model`` of a checkpoint of tactile_pi05, trained by flow matching."""
    device: str | None = None
    """Device of the policy: cpu, cuda, …; as in the checkpoint if not given."""
    trained: str = "expert"
    """Weights that are trained. expert: those of action expert and touch, not of the vision-language model; all: every weight."""
    tf32: bool = False
    """On a GPU, multiply float32 matrices with 10-bit mantissas: faster, but ratios before the first update differ from 1."""
    compile: bool = False
    """On a GPU, compile what encoders of pictures compute between their convolutions, for updates; half a minute in the first
    one. Only for --policy.backbone=small, and best with batches that all have one size."""

    def __post_init__(self) -> None:
        _one_of("policy.trained", self.trained, ("expert", "all"))


@dataclass(kw_only=True)
class EnvSettings:
    """Settings of the environments: task, twin, number of environments and processes."""

    task: str | None = None
    """Task of the environments: {tasks}."""
    twin: Path | None = None
    """A twin.yaml; the nominal twin if not given."""
    num_envs: int = 128
    """N_env: number of environments."""
    shards: int = 1
    """Groups of environments. With more than one, each runs in a process of its own: in one process about 10 of 32 CPUs were busy
    (measured once). Scenes do not depend on it, except with start_share: each group stores states of its own."""
    threads: int | None = None
    """Threads of each shard; CPUs / shards if not given."""
    ray: bool = False
    """Shards are Ray actors: on this machine, or on those of the cluster that RAY_ADDRESS names. Needs the extra ray."""
    decisions: int = 36
    """C: chunks of actions of each environment in an iteration. Episodes continue in the next one."""
    physics: str = "c"
    """c: MuJoCo on the CPU; warp: MuJoCo Warp on a GPU (extra gpu). warp:device=cuda:1,contacts=128,constraints=512: settings."""
    difficulty: str = "train"
    """Clearance on each side of mating parts: easy 1.0 mm, train 0.5 mm, hard 0.3 mm."""
    randomization: float = 1.0
    """Factor on the paper's ranges of the randomisation at reset, 0 … 1; 0: the nominal scene."""
    pictures: str = "clear"
    """Pictures that the policy sees in rollouts. clear: as rendered; randomised: changed by the image rows of the paper's
    randomisation (crop, rotation, brightness, contrast, saturation, noise); each scene draws them once for each camera, noise
    anew in each picture. The anchor's images are changed as in training in either case."""
    episode_length: int | None = None
    """Control steps after which an episode ends; the task's own limit if not given. Rounded down to whole decisions."""
    start_share: float = 0.0
    """Share of episodes, 0 or more and below 1, that begin in a stored state of one of the policy's earlier episodes instead of a
    reset. The newest 256 states after each arm has grasped its part are stored. progress.jsonl counts these episodes apart
    (later_success)."""

    def __post_init__(self) -> None:
        _at_least("env.", self, num_envs=1, decisions=1, threads=1)
        _one_of("env.pictures", self.pictures, ("clear", "randomised"))
        if not 1 <= self.shards <= self.num_envs:
            raise TaccorlError(
                f"--env.shards={self.shards}: 1 to --env.num_envs={self.num_envs}"
            )
        if not 0 <= self.start_share < 1:
            raise TaccorlError(
                f"--env.start_share={self.start_share:g}: give a share, 0 or more and below 1"
            )


@dataclass(kw_only=True)
class FlowSDESettings:
    """Settings of the exploration noise."""

    num_steps: int = 4
    """K_denoise: number of denoising steps of a chunk. The policy's num_inference_steps is set to it."""
    level: float = 0.5
    """σ_SDE: standard deviation of the first stochastic step, in normalised actions. 0: no noise."""
    stochastic_steps: str = "one"
    """Steps of a decision that are stochastic; the others are Euler steps. one: a randomly drawn one (paper); all: every step;
    last: the last one. A policy that is sure of its action undoes the noise of earlier steps, so that decisions with it tell PPO
    nothing."""
    correlation: float = 0.0
    """Correlation of the noise of one joint between the executed actions of a chunk, 0 or more and below 1. 0: each action has
    noise of its own (paper), which the arm averages out; near 1: the whole chunk is displaced."""
    half_life: int = 0
    """Iterations in which the level falls to its half, counted from the first iteration that trains the actor. 0: the level stays
    (paper). A policy that learns with much noise may need it: without noise it then completes fewer scenes than with it."""

    def __post_init__(self) -> None:
        _at_least("noise.", self, num_steps=1, level=0, half_life=0)
        if not 0 <= self.correlation < 1:
            raise TaccorlError(
                f"--noise.correlation={self.correlation:g}: 0 or more, and below 1"
            )
        if not math.isfinite(self.level):
            raise TaccorlError(f"--noise.level={self.level:g}: is not finite")
        _one_of("noise.stochastic_steps", self.stochastic_steps, ("one", "all", "last"))

    def level_after(self, iterations: int) -> float:
        """The level after so many iterations that trained the actor."""
        if self.half_life == 0:
            return self.level
        return self.level * 0.5 ** (max(iterations, 0) / self.half_life)


@dataclass(kw_only=True)
class AnchorSettings:
    """Supervised loss on real data during PPO."""

    dataset: Path | None = None
    """Folder of a LeRobot dataset with real demonstrations; of a co-training dataset only its real rows are used."""
    weight: float = 1.0
    """β: weight of the supervised loss; 0: no anchor."""
    batch_size: int = 32
    """B_real: number of rows in every optimiser step."""
    allow_simulated: bool = False
    """Accept a dataset of simulated demonstrations."""
    cache: str = "none"
    """Cache of decoded pictures: none, disk, host or gpu (as --dataset.cache of lerobot-train)."""
    cache_store: Path = Path("outputs/store")
    """Folder of the cache of decoded pictures."""

    def __post_init__(self) -> None:
        _at_least("anchor.", self, weight=0, batch_size=1)


@dataclass(kw_only=True)
class PPOSettings:
    """PPO over decisions: one decision is one chunk of actions."""

    gamma: float = 0.99
    """γ: discount factor per decision."""
    gae_lambda: float = 0.95
    """λ_GAE: decay of generalised advantage estimation."""
    bootstrap_time_limit: bool = True
    """true: the value of the last observation counts where time ran out, so that waiting costs only γ. false: 0, as after a
    failure; the critic then needs the elapsed time (privileged_critic)."""
    clip: float = 0.2
    """ε_clip: clipping range of the probability ratio."""
    epochs: int = 1
    """E_update: epochs of updates per rollout."""
    batch_size: int = 512
    """B_RL: number of decisions in an optimiser step; the last one of an epoch may have fewer."""
    micro_batch: int = 128
    """Number of decisions in memory at the same time; results do not depend on it except for rounding."""
    actor_lr: float = 5e-6
    """η_π: learning rate of the actor."""
    critic_lr: float = 1e-4
    """η_V: learning rate of the critic."""
    weight_decay: float = 0.01
    """Weight decay of both optimisers, AdamW with β = (0.9, 0.95) as in RLinf."""
    max_grad_norm: float = 1.0
    """Gradients of actor and critic are clipped to this norm separately."""
    kl_stop: float = 0.05
    """KL limit: a step of the actor after which KL(old ‖ new) is larger is undone, and the remaining steps of the iteration are
    skipped."""
    adapt_lr: bool = False
    """Adapt the actor's learning rate: × 0.5 after an iteration whose first step was undone, × 0.7 if a later one was, × 1.2 if
    none was and the last KL is below kl_stop / 5, up to 10 × actor_lr. false: fixed (paper)."""
    critic_epochs: int = 1
    """Number of epochs of the critic; its inputs are stored, so that an epoch costs little."""
    critic_warmup: int = 0
    """Number of first iterations in which only the critic is trained."""
    privileged_critic: bool = False
    """True: the simulator's state is an input of the critic, which is discarded after training."""

    def __post_init__(self) -> None:
        _at_least("ppo.", self, epochs=1, batch_size=1, micro_batch=1, critic_epochs=1)
        _at_least(
            "ppo.", self, actor_lr=0, critic_lr=0, critic_warmup=0, kl_stop=0, clip=0
        )


@dataclass(kw_only=True)
class WandbSettings:
    """Weights & Biases, by the option names of ``lerobot-train``."""

    enable: bool = False
    """Also log the rows of progress.jsonl to Weights & Biases."""
    project: str = "lerobot"
    entity: str | None = None
    mode: str | None = None
    """online (the default), offline (files in OUT/wandb, for wandb sync), disabled."""


@dataclass(kw_only=True)
class PostTrainSettings:
    """Settings of a run of post-training."""

    policy: PolicySettings = field(default_factory=PolicySettings)
    """The policy, and which of its weights are trained."""
    env: EnvSettings = field(default_factory=EnvSettings)
    """Task, twin and number of environments."""
    noise: FlowSDESettings = field(default_factory=FlowSDESettings)
    """Exploration noise by Flow-SDE."""
    ppo: PPOSettings = field(default_factory=PPOSettings)
    """Settings of PPO: advantages, updates, critic."""
    anchor: AnchorSettings = field(default_factory=AnchorSettings)
    """Supervised loss on real data, which keeps the policy near its demonstrations."""
    wandb: WandbSettings = field(default_factory=WandbSettings)
    """Where progress is logged beside progress.jsonl."""
    iterations: int = 100
    """Number of iterations (a rollout and its update) of the whole run, also after --resume=true."""
    seed: int = 0
    """Seed of scenes, noise and the order of training."""
    out: Path = Path("outputs/post_trained")
    """Folder of checkpoints and progress.jsonl. It must be empty or not exist, unless --resume=true."""
    resume: bool = False
    """Continue from the last checkpoint in --out, with the settings of the run; --iterations, --save_freq and --keep_checkpoints
    may be changed."""
    save_freq: int = 10
    """Number of iterations between checkpoints."""
    keep_checkpoints: int = 3
    """Number of newest checkpoints that are kept, beside the best one; 0: all."""
    rerun: bool = True
    """After each checkpoint, write the first episode that ends in environment 0 to rollouts/iteration_NNNN.rrd."""
    noise_check: bool = True
    """Before the first iteration, compare success with and without noise, one episode in each environment."""
    collapse_iterations: int = 5
    """Number of iterations with less than half of the best success rate after which training returns to the best checkpoint,
    with half the learning rate. 0: never."""

    def __post_init__(self) -> None:
        _at_least("", self, iterations=1, seed=0, save_freq=1, keep_checkpoints=0)


def _at_least(prefix: str, settings: Any, **least: float) -> None:
    """Raises TaccorlError: a setting that is smaller, or no number."""
    for name, smallest in least.items():
        value = getattr(settings, name)
        if value is not None and not value >= smallest:
            raise TaccorlError(f"--{prefix}{name}={value:g}: at least {smallest}")


def _one_of(name: str, value: str, known: tuple[str, ...]) -> None:
    """Raises TaccorlError: the value is not known."""
    if value not in known:
        raise TaccorlError(f"--{name}={value}: {nearest(value, known)}")

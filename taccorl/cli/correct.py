"""``taccorl correct --policy.path=CHECKPOINT --task=assembly_2 [--episodes=128] [--out=outputs/assembly_2_corrections]``

DAgger by takeover: the policy acts in the twin; at a drawn time, or when it stalls for a second, the task's scripted expert
takes over and completes the task. The time is drawn after both parts are held or, if they never are, before the grasp. Only the
expert's rows become a LeRobot dataset, to be merged with the demonstrations (taccorl merge) and trained on (lerobot-train). Give
every round of corrections another --seed.

A thousand takeovers with pictures of every third row, to join demonstrations of taccorl collect --pictures=cache:

    taccorl correct --policy.path=CHECKPOINT --task=assembly_1 --takeover=all --episodes=256 \\
        --per_episode=4 --before_grasp=true --pictures=cache --resolution=84x112 --part_poses=true \\
        --engine.workers=16 --out=outputs/corrections
    taccorl merge --sim=outputs/many --sim=outputs/corrections --pictures=cache \\
        --resolution=84x112 --out=outputs/both

Each batch of the policy's episodes and each correction is kept in the store: a run that was stopped continues.
"""

import dataclasses
import functools
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from taccorl.cli.evaluate import PolicyChoice, open_policy, open_saved
from taccorl.cli.parse import parse
from taccorl.cli.produced import (
    PictureOptions,
    Place,
    RandomizedOptions,
    own_first,
    settings,
)
from taccorl.errors import TaccorlError
from taccorl.tasks.experts.hands import ScriptedExpertConfig

if TYPE_CHECKING:
    from taccorl.evaluation.rollouts import Actor


@own_first
@dataclass(kw_only=True)
class CorrectConfig(PictureOptions, RandomizedOptions):
    """Collect the expert's corrections of a policy. Its images option is of the dataset: a policy with camera inputs needs OpenGL
    even if that is false."""

    policy: PolicyChoice = field(default_factory=PolicyChoice)
    """The policy to correct: --policy.path=CHECKPOINT."""
    task: str
    """Task; it must have a scripted expert: {tasks}."""
    out: Path | None = None
    """The dataset's folder; outputs/TASK_corrections if not given. It must be empty or not exist."""
    episodes: int = 128
    """Number of scenes in which the policy acts; each gives --per_episode corrections at most."""
    num_envs: int = 64
    """Number of environments in which the policy acts at the same time; they bound the memory. Its random numbers
    depend on it."""
    policy_workers: int = 1
    """Number of processes in which the policy acts, each with its own policy and --num_envs environments."""
    takeover: str = "failures"
    """failures: correct only episodes in which the policy does not succeed by itself; all: correct all episodes."""
    per_episode: int = 1
    """Number of takeovers of each of the policy's episodes, at drawn times; each is an independent correction."""
    hands: ScriptedExpertConfig = field(default_factory=ScriptedExpertConfig)
    """Speeds and human-like errors of the expert's hands, as --source.hands of taccorl collect."""
    before_grasp: bool = False
    """true: draw takeovers over the whole episode; false: after both parts are held, if they ever are."""
    policy_pictures: str = "clear"
    """Pictures that the policy sees: clear; or randomised, as --pictures of taccorl evaluate. The dataset has clear ones."""
    episode_length: int | None = None
    """Control steps after which an episode of the policy ends; the task's own limit if not given."""


def main(argv: list[str]) -> int:
    """Run ``taccorl correct`` with the words ``argv`` after it; returns the exit status 0."""
    config = parse(CorrectConfig, argv, positional=None)
    os.environ.setdefault(
        "TQDM_DISABLE", "1"
    )  # read when tqdm is imported: LeRobot's bars
    from taccorl.cli.progress import Attempts, Steps
    from taccorl.episodes.produce import check_out, produce
    from taccorl.episodes.sources.correct import CorrectionPlan
    from taccorl.evaluation.policy_episodes import policy_episodes
    from taccorl.evaluation.rollouts import checked_pictures
    from taccorl.evaluation.statistics import wilson_interval

    plan = CorrectionPlan(
        **settings(config, CorrectionPlan, policy="", policy_digest="")
    )
    if config.policy.path is None:
        raise TaccorlError("missing --policy.path=CHECKPOINT, the policy to correct")
    for name in ("num_envs", "policy_workers"):
        if (value := getattr(config, name)) < 1:
            raise TaccorlError(f"--{name}={value}: at least 1")
    checked_pictures(config.policy_pictures, "--policy_pictures")
    place = Place.of(
        config, plan, config.out or Path("outputs") / f"{config.task}_corrections"
    )
    opened = open_policy(
        config.policy,
        plan.twin_config(),
        tasks=(plan.task,),
        pictures=config.policy_pictures,
    )
    plan = dataclasses.replace(plan, policy=opened.name, policy_digest=opened.digest)
    check_out(plan, place.out, place.store)  # before the policy acts
    load = functools.partial(
        load_actor, config.policy.path, config.policy.device, config.seed
    )
    acted = policy_episodes(
        plan,
        load,
        config.num_envs,
        place.store,
        Steps(every_s=10),
        workers=config.policy_workers,
    )
    plan = dataclasses.replace(plan, acted=tuple(acted))
    produced = produce(
        plan, place.out, place.store, Attempts(len(plan.takeovers()[0])), config.engine
    )
    report = produced.report
    over, successes = report["taken_over"], report["episodes"]
    low, high = (100 * end for end in wilson_interval(successes, over))
    lines = [
        f"policy:  {report['policy_successes']} of {report['policy_episodes']} episodes succeeded by themselves; "
        f"{report['kept_out']} kept out",
        f"takeovers: {over} ({', '.join(f'{cause} {count}' for cause, count in report['causes'].items())})",
        f"expert:  {successes} of {over} succeeded ({100 * successes / over:.1f} %, 95 %: {low:.1f} … {high:.1f})",
    ]
    place.written(plan, produced, lines)
    cached = f" --pictures=cache{f' --resolution={config.resolution}' * bool(config.resolution)}"
    merge = f"taccorl merge --sim=DEMONSTRATIONS --sim={place.out}{cached * (plan.cached_rows is not None)} --out=…"
    print(f"next:    {merge}, then lerobot-train")
    return 0


def load_actor(path: Path, device: str | None, seed: int) -> "Actor":
    """Load a checkpoint's policy, in this process or another one, with its random numbers drawn from ``seed``."""
    return open_saved(PolicyChoice(path=path, device=device)).load(seed)

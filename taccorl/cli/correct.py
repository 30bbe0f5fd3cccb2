"""``taccorl correct --policy.path=CHECKPOINT --task=assembly_2 [--episodes=128] [--out=outputs/assembly_2_corrections]``

DAgger by takeover: the policy acts in the twin; at a drawn time, or when it stalls for a second, the task's scripted expert
takes over and completes the task. The time is drawn after both parts are held or, if they never are, before the grasp. Only the
expert's rows become a LeRobot dataset, to be merged with the demonstrations (taccorl merge) and trained on (lerobot-train). Give
every round of corrections another --seed.

    --takeover=failures       skip episodes in which the policy succeeds by itself (all: correct these too)
    --engine.workers=8        number of processes that run experts
    --rows=actions            write only seeds and actions; taccorl execute makes one dataset of demonstrations and corrections

The policy's episodes and each correction are kept in the store: a run that was stopped continues.
"""

import dataclasses
import os
from dataclasses import dataclass, field
from pathlib import Path

from taccorl.cli.card import add_card
from taccorl.cli.evaluate import PolicyChoice, TextProgress, open_policy
from taccorl.cli.output_lock import hold
from taccorl.cli.parse import parse
from taccorl.errors import DatasetError, TaccorlError
from taccorl.lineage.engines import Engine, LocalEngine


@dataclass(kw_only=True)
class CorrectConfig:
    """Collect the expert's corrections of a policy."""

    policy: PolicyChoice = field(default_factory=PolicyChoice)
    """The policy to correct: --policy.path=CHECKPOINT."""
    task: str
    """Task; it must have a scripted expert: {tasks}."""
    out: Path | None = None
    """The dataset's folder; outputs/TASK_corrections if not given. It must be empty or not exist."""
    episodes: int = 128
    """Number of scenes in which the policy acts; each gives one correction at most."""
    num_envs: int = 64
    """Number of environments in which the policy acts at the same time."""
    seed: int = 0
    """Seed of scenes, takeovers and the policy's random numbers."""
    takeover: str = "failures"
    """failures: correct only episodes in which the policy does not succeed by itself; all: correct all episodes."""
    difficulty: str = "train"
    """Clearance on each side of mating parts: easy 1.0 mm, train 0.5 mm, hard 0.3 mm."""
    twin: Path | None = None
    """A twin.yaml; the nominal twin if not given."""
    randomization: float = 1.0
    """Factor on the ranges of the task's randomisation at reset, 0 … 1; 0: the nominal scene."""
    episode_length: int | None = None
    """Control steps after which an episode of the policy ends; the task's own limit if not given."""
    rows: str = "dataset"
    """Kind of output. dataset; or actions: only seeds and actions, for taccorl execute --source=DEMONSTRATIONS --source=OUT,
    which makes one dataset of both with frames for a GPU."""
    images: bool = True
    """Render the dataset's cameras (needs OpenGL). A policy with camera inputs needs OpenGL even if
    this is false."""
    part_poses: bool = False
    """Write the poses of the task's parts into every row, as taccorl execute --part_poses=true."""
    store: Path = Path("outputs/store")
    """Folder that keeps finished episodes, so that a second run continues where the first ended."""
    engine: Engine = field(default_factory=LocalEngine)
    """Where experts run: --engine.type=local --engine.workers=2, slurm, ray."""


def main(argv: list[str]) -> int:
    """Run ``taccorl correct`` with the words ``argv`` after it; returns the exit status 0."""
    config = parse(CorrectConfig, argv, positional=None)
    os.environ.setdefault("TQDM_DISABLE", "1")  # read when tqdm is imported: LeRobot's bars
    from taccorl.cli.tables import Attempts
    from taccorl.data.lerobot_format import check_path
    from taccorl.demos.correct import CorrectionPlan, check_out, correct
    from taccorl.evaluation.policy_episodes import policy_episodes
    from taccorl.evaluation.statistics import wilson_interval
    from taccorl.lineage.store import Store

    plan = CorrectionPlan(
        task=config.task,
        policy="",
        policy_digest="",
        episodes=config.episodes,
        difficulty=config.difficulty,
        twin=config.twin,
        randomization=config.randomization,
        episode_length=config.episode_length,
        takeover=config.takeover,
        rows=config.rows,
        images=config.images,
        part_poses=config.part_poses,
        seed=config.seed,
    )
    if config.policy.path is None:
        raise TaccorlError("missing --policy.path=CHECKPOINT, the policy to correct")
    if config.num_envs < 1:
        raise TaccorlError(f"--num_envs={config.num_envs}: at least 1")
    out = config.out or Path("outputs") / f"{config.task}_corrections"
    hold(out)
    check_path(out)
    if out.resolve().is_relative_to(config.store.resolve()) or config.store.resolve().is_relative_to(out.resolve()):
        raise DatasetError(f"--out={out} and --store={config.store} contain one another: choose another --out")
    opened = open_policy(config.policy, plan.twin_config())
    plan = dataclasses.replace(plan, policy=opened.name, policy_digest=opened.digest)
    check_out(plan, out)  # before the policy acts
    store = Store(config.store)
    acted = policy_episodes(plan, lambda: opened.load(config.seed), config.num_envs, store, TextProgress())
    report = correct(plan, acted, out, store, config.engine, Attempts(plan.episodes))
    print(f"policy:    {report['policy_successes']} of {report['attempts']} episodes succeeded by themselves")
    over, successes = report["taken_over"], report["episodes"]
    low, high = (100 * end for end in wilson_interval(successes, over))
    causes = ", ".join(f"{cause} {count}" for cause, count in report["causes"].items())
    print(f"kept out:  {report['kept_out']}, as the policy succeeded")
    print(f"takeovers: {over} ({causes})")
    print(f"expert:    {successes} of {over} succeeded ({100 * successes / over:.1f} %, 95 %: {low:.1f} … {high:.1f})")
    for outcome, count in report["outcomes"].items():
        print(f"           {outcome} {count}")
    said = f"{report['domain']}: {report['origin']}"
    print(f"{plan.rows + ':':11s}{out}  ({report['episodes']} episodes, {report['rows']} rows): {said}")
    if plan.rows == "dataset":
        add_card(out)
    join = "merge --sim=DEMONSTRATIONS --sim" if plan.rows == "dataset" else "execute --source=DEMONSTRATIONS --source"
    print(f"next:      taccorl {join}={out} --out=…, then lerobot-train")
    return 0

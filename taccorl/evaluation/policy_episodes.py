"""The policy's episodes for corrections (``demos/correct.py``), run in batches and kept in the store as seeds and actions."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from taccorl.demos.correct import CorrectionPlan, PolicyEpisode, write_policy_episodes
from taccorl.evaluation.evaluate import Scenes
from taccorl.evaluation.rollouts import Actor, Progress, roll_out
from taccorl.lineage.stage import Artefact, Stage
from taccorl.lineage.store import Store

VERSION = 3


def policy_episodes(
    plan: CorrectionPlan, load: Callable[[], Actor], num_envs: int, store: Store, progress: Progress | None = None
) -> Artefact:
    """Run the policy in the plan's scenes, unless the store has the episodes. The artefact holds the files of
    ``write_policy_episodes``.

    Args:
        load: function that creates the actor; called only if it must act.
        num_envs: number of environments at the same time.
    """

    def build(config: Any, inputs: list[Path], folder: Path) -> None:
        write_policy_episodes(_act(plan, load(), num_envs, progress), folder)

    config = plan.scene_config() | {
        "policy_digest": plan.policy_digest,
        "seed": plan.seed,
        "scene_seeds": plan.scene_seeds,
        "pictures": plan.pictures,
        "num_envs": num_envs,  # the policy's random numbers are drawn for a batch
    }
    return store.run(_STAGE.bound(build), config, [])


_STAGE = Stage("policy_episodes", version=VERSION)


def _act(plan: CorrectionPlan, actor: Actor, num_envs: int, progress: Progress | None) -> list[PolicyEpisode]:
    """In the order of the scenes."""
    scenes = Scenes(
        tasks=(plan.task,),
        seed=0,
        difficulty=plan.difficulty,
        twin=plan.twin,
        randomization=plan.randomization,
        episode_length=plan.episode_length,
    )
    size, found = min(num_envs, actor.max_batch or num_envs), []
    actor.restart()
    for first in range(0, plan.episodes, size):
        seeds = plan.scene_seeds[first : first + size]
        envs = scenes.environments(plan.task, len(seeds), images=actor.needs_images, part_poses=actor.needs_part_poses)
        try:
            rollouts = roll_out(envs, actor, seeds, progress, pictures=plan.pictures)
        finally:
            envs.close()
        found += [PolicyEpisode(r.row.seed, r.row.outcome, r.actions, r.states) for r in rollouts]
    return found

"""The policy's episodes for corrections (``episodes.sources.correct``), run in batches and kept in the store: seeds and actions.

A batch is the work of one process at a time and an artefact of its own: memory is bounded by ``num_envs``, and a run that was
stopped continues with the next batch.
"""

import functools
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from taccorl.episodes.plan import made_once
from taccorl.episodes.sources.correct import (
    CorrectionPlan,
    PolicyEpisode,
    write_policy_episodes,
)
from taccorl.evaluation.evaluate import Scenes
from taccorl.evaluation.rollouts import Actor, Progress, roll_out
from taccorl.lineage.engines import LocalEngine
from taccorl.lineage.stage import Artefact, Stage
from taccorl.lineage.store import Store

VERSION = 4


def policy_episodes(
    plan: CorrectionPlan,
    load: Callable[[], Actor],
    num_envs: int,
    store: Store,
    progress: Progress | None = None,
    *,
    workers: int = 1,
) -> list[Artefact]:
    """Run the policy in the plan's scenes, except those that the store has. Returns an artefact for each batch of ``num_envs``
    scenes, with the files of ``write_policy_episodes``.

    Args:
        load: function that creates the actor; called once in each process, only if it must act. With several workers it is
            pickled.
        workers: number of processes that run batches at the same time, each with a policy of its own.
    """
    num = -(-plan.episodes // num_envs)
    workers = min(workers, num)
    run = functools.partial(
        _run_batch,
        plan,
        load,
        num_envs,
        store,
        workers,
        progress if workers == 1 else None,
    )

    def said(batch: int, _: Artefact) -> None:
        if progress is not None and num > 1:
            progress(f"policy: batch {batch + 1} of {num} has acted")

    return LocalEngine(workers=workers).map(
        run, range(num), on_done=said, name=lambda batch: f"policy's batch {batch}"
    )


def _run_batch(
    plan: CorrectionPlan,
    load: Callable[[], Actor],
    num_envs: int,
    store: Store,
    workers: int,
    progress: Progress | None,
    batch: int,
) -> Artefact:
    seeds = plan.scene_seeds[batch * num_envs : (batch + 1) * num_envs]
    config = plan.scene_config() | {
        "policy_digest": plan.policy_digest,
        "seed": plan.seed,
        "scene_seeds": seeds,
        "policy_pictures": plan.policy_pictures,
        "batch": batch,  # its random numbers are those of a stream of its own
    }

    def build(config: Any, inputs: list[Path], folder: Path) -> None:
        actor = made_once(["policy", plan.policy_digest, plan.seed], load)
        num_threads = max(len(os.sched_getaffinity(0)) // workers, 1)
        write_policy_episodes(
            _act(plan, actor, batch, seeds, num_threads, progress), folder
        )

    return store.run(_STAGE.bound(build), config, [])


_STAGE = Stage("policy_episodes", version=VERSION)


def _act(
    plan: CorrectionPlan,
    actor: Actor,
    batch: int,
    seeds: list[int],
    num_threads: int,
    progress: Progress | None,
) -> list[PolicyEpisode]:
    """In the order of the scenes."""
    scenes = Scenes(
        tasks=(plan.task,),
        seed=0,
        difficulty=plan.difficulty,
        twin=plan.twin,
        randomization=plan.randomization,
        episode_length=plan.episode_length,
    )
    actor.restart(batch)
    seen = {"images": actor.needs_images, "part_poses": actor.needs_part_poses}
    envs = scenes.environments(plan.task, len(seeds), num_threads=num_threads, **seen)
    try:
        rollouts = roll_out(envs, actor, seeds, progress, pictures=plan.policy_pictures)
    finally:
        envs.close()
    return [
        PolicyEpisode(r.row.seed, r.row.outcome, r.actions, r.states, r.subtasks)
        for r in rollouts
    ]

"""Evaluate policies on tasks and scene seeds; read a stored evaluation of the same scenes for a comparison."""

import dataclasses
import itertools
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gymnasium.vector import AutoresetMode

from taccorl.errors import TaccorlError
from taccorl.evaluation.episodes import ROWS_FILE, SUMMARY_FILE, EpisodeRow, read_rows
from taccorl.evaluation.rollouts import (
    Actor,
    Progress,
    Rollout,
    checked_hidden,
    checked_pictures,
    roll_out,
)
from taccorl.sim.task import tasks
from taccorl.sim.twin import TwinConfig
from taccorl.sim.twin_file import load_twin
from taccorl.sim.vector_env import TaccorlVectorEnv
from taccorl.sim.warp_batch import WarpSettings

PAPER_EPISODES = 128
"""Number of scenes on which the paper evaluates every policy."""


@dataclass(frozen=True, kw_only=True)
class Scenes:
    """Tasks, scenes and twin on which policies are evaluated: the same for every policy."""

    tasks: tuple[str, ...]
    """Names of the tasks."""
    episodes: int = PAPER_EPISODES
    """Number of scenes of each task."""
    seed: int
    """Scene seed of the first episode; episode k has seed + k, as in ``lerobot-eval``."""
    difficulty: str = "train"
    """Clearance on each side of mating parts: ``easy`` 1.0 mm, ``train`` 0.5 mm, ``hard`` 0.3 mm."""
    twin: Path | None = None
    """A twin.yaml; None: the nominal twin."""
    randomization: float = 1.0
    """Factor on the ranges from which a reset of the task draws, from 0 (always the nominal scene) to 1 (the full ranges)."""
    episode_length: int | None = None
    """Control steps after which an episode ends; None: the task's own limit."""
    pictures: str = "clear"
    """How policies see the pictures: ``clear``, or ``randomised`` by the image rows of the paper's randomisation, with draws of
    the scene."""
    hidden: tuple[str, ...] = ()
    """What is hidden from policies, of ``HIDDEN``."""
    physics: str = "c"
    """``c``, or ``warp`` with ``WarpSettings``."""
    batch_size: int | None = None
    """Number of environments at the same time; None: all episodes in one batch. In a smaller last batch, a policy that draws
    noise gets other random numbers than in ``lerobot-eval``, which fills the batch with scenes that it discards."""

    def __post_init__(self) -> None:
        """Raises TaccorlError: there is no task, a task is unknown (the message names the nearest), or a number is below its
        range."""
        if not self.tasks:
            raise TaccorlError(
                f"missing --task=, one of {', '.join(tasks)}; --help says more"
            )
        for task in self.tasks:
            tasks.get(task)(self.difficulty)
        if len(set(self.tasks)) < len(self.tasks):
            raise TaccorlError(f"--task: {', '.join(self.tasks)}: give each task once")
        for name, least in (
            ("episodes", 1),
            ("seed", 0),
            ("episode_length", 1),
            ("batch_size", 1),
        ):
            value = getattr(self, name)
            if value is not None and value < least:
                raise TaccorlError(f"--{name}={value}: at least {least}")
        if not 0 <= self.randomization <= 1:
            raise TaccorlError(
                f"--randomization={self.randomization:g}: a share of the task's reset ranges, 0 … 1"
            )
        checked_pictures(self.pictures)
        checked_hidden(self.hidden)
        WarpSettings.parse(self.physics)

    @property
    def seeds(self) -> range:
        """Scene seeds of each task."""
        return range(self.seed, self.seed + self.episodes)

    def shares(self, workers: int) -> list["Scenes"]:
        """Scenes of each of ``workers`` processes, at least one of each task: parts of ``seeds``, of equal size but for one."""
        n = min(workers, self.episodes)
        ends = [self.episodes * k // n for k in range(n + 1)]
        return [
            dataclasses.replace(self, seed=self.seed + a, episodes=b - a)
            for a, b in itertools.pairwise(ends)
        ]

    def twin_config(self) -> TwinConfig:
        """Load the twin of these scenes. Raises TaccorlError: the twin's file cannot be read."""
        return load_twin(self.twin) if self.twin else TwinConfig()

    def environments(
        self,
        task: str,
        num_envs: int,
        *,
        images: bool,
        part_poses: bool = False,
        num_threads: int | None = None,
    ) -> TaccorlVectorEnv:
        """Make ``num_envs`` environments of ``task``, whose simulations are frozen after the end of their episode.

        Args:
            part_poses: observations have the true poses of the task's parts.
            num_threads: threads of the physics; None: as many as CPUs.

        Raises:
            TaccorlError: as ``TaccorlVectorEnv``.
        """
        return TaccorlVectorEnv(
            task,
            num_envs,
            difficulty=self.difficulty,
            twin=self.twin_config(),
            physics=self.physics,
            images="on_request" if images else "never",
            randomization=self.randomization,
            num_threads=min(num_envs, num_threads or len(os.sched_getaffinity(0))),
            autoreset=AutoresetMode.DISABLED,
            max_episode_steps=self.episode_length,
            part_poses=part_poses,
        )


def score(
    scenes: Scenes,
    actor: Actor,
    progress: Progress | None = None,
    *,
    stream: int = 0,
    num_threads: int | None = None,
) -> list[Rollout]:
    """Run all episodes of one policy; returns one ``Rollout`` per episode, task by task, in the order of their seeds.

    ``stream``: of the actor's random numbers. ``num_threads``: of the physics; None: as many as CPUs.

    Raises:
        TaccorlError: as ``roll_out`` and ``TaccorlVectorEnv``.
    """
    found: list[Rollout] = []
    for task in scenes.tasks:
        actor.restart(stream)
        size = min(
            scenes.batch_size or scenes.episodes,
            actor.max_batch or scenes.episodes,
            scenes.episodes,
        )
        seen: dict[str, Any] = {
            "images": actor.needs_images,
            "part_poses": actor.needs_part_poses,
        }
        seen["num_threads"] = num_threads
        envs = scenes.environments(task, size, **seen)
        try:
            for first in range(0, scenes.episodes, size):
                seeds = scenes.seeds[first : first + size]
                if len(seeds) < size:
                    envs.close()
                    envs = scenes.environments(task, len(seeds), **seen)
                shown = _with_prefix(
                    progress, f"{task}, seeds {seeds[0]} … {seeds[-1]}: "
                )
                found += roll_out(
                    envs,
                    actor,
                    seeds,
                    shown,
                    pictures=scenes.pictures,
                    hidden=scenes.hidden,
                )
        finally:
            envs.close()
    return found


def _with_prefix(progress: Progress | None, prefix: str) -> Progress | None:
    return None if progress is None else lambda text: progress(f"{prefix}{text}")


@dataclass(frozen=True)
class Stored:
    """Episodes of an earlier evaluation, read from its folder."""

    policy: str
    """Label: name of the first policy in that evaluation, followed by the folder in brackets."""
    rows: list[EpisodeRow]
    """Episodes of that policy."""


def is_stored(path: Path) -> bool:
    """Whether ``taccorl evaluate`` wrote that folder."""
    return (path / SUMMARY_FILE).is_file() and (path / ROWS_FILE).is_file()


def read_stored(folder: Path, scenes: Scenes) -> Stored:
    """Rows of the first policy of an earlier evaluation, for a comparison on ``scenes``.

    Twin, pictures and what is hidden may differ: the comparison is then also one of these. Raises TaccorlError: it was
    evaluated on other tasks, seeds, difficulty, randomisation or episode length."""
    summary = json.loads((folder / SUMMARY_FILE).read_text(encoding="utf-8"))
    policy, its = summary["policies"][0]["name"], summary["scenes"]
    ours = scenes_to_json(scenes)
    differing = [
        f"{name} {its[name]} there, {ours[name]} here"
        for name in (
            "tasks",
            "episodes",
            "seed",
            "difficulty",
            "randomization",
            "episode_length",
        )
        if its[name] != ours[name]
    ]
    if differing:
        raise TaccorlError(
            f"--against={folder}: was evaluated on other scenes: {'; '.join(differing)}"
        )
    other = its.get("physics", "c")
    name = f"{policy} ({folder}{f', physics {other}' * (other != scenes.physics)})"
    rows = [
        dataclasses.replace(row, policy=name)
        for row in read_rows(folder / ROWS_FILE)
        if row.policy == policy
    ]
    return Stored(name, rows)


def scenes_to_json(scenes: Scenes) -> dict[str, Any]:
    """The scenes as JSON values: name of each field → value; ``twin`` is its path or None."""
    return dataclasses.asdict(scenes) | {
        "tasks": list(scenes.tasks),
        "twin": str(scenes.twin) if scenes.twin else None,
        "hidden": list(scenes.hidden),
    }

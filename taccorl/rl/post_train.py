"""Post-training: alternate rollouts in the twin and updates; checkpoints continue bit for bit on a CPU.

``progress.jsonl`` in the run's folder has one line an iteration: success and outcomes of the episodes that ended in it, losses,
KL divergence, undone steps, learning rate, gradient norms, explained variance, seconds of each part.
"""

import contextlib
import dataclasses
import json
import math
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.utils.random_utils import get_rng_state, set_rng_state

from taccorl.data.episode import Episode
from taccorl.errors import TaccorlError
from taccorl.evaluation.episodes import SUCCESS
from taccorl.evaluation.evaluate import Scenes
from taccorl.evaluation.policy_actor import Checkpoint, needs_images, open_checkpoint
from taccorl.evaluation.preflight import preflight, refuse_differences
from taccorl.lineage.destinations import is_free
from taccorl.lineage.engines import start_ray
from taccorl.policies.tactile_pi05.scene_pictures import ScenePictures
from taccorl.policies.tactile_pi05.weights import load_checkpoint
from taccorl.rl import checkpoint, run_settings
from taccorl.rl.anchor import RealAnchor
from taccorl.rl.critic import Critic
from taccorl.rl.exploration import measure_noise
from taccorl.rl.flow_policy import TactileFlowPolicy
from taccorl.rl.flow_sde import FlowSDE
from taccorl.rl.ppo import PPO
from taccorl.rl.rollout import Clock, collect, first_episodes
from taccorl.rl.settings import PostTrainSettings
from taccorl.rl.shards import LocalShard, ProcessShard, RayShard, Shard
from taccorl.rl.start_states import NUM_STATES, StartStates
from taccorl.rl.twin_shard import DrawnPictures, make_shard
from taccorl.rl.twin_world import TwinWorld
from taccorl.rl.watched_episode import EpisodeWatch, executed_again
from taccorl.robots import ROBOT
from taccorl.sim.cameras import letterbox_window
from taccorl.sim.spaces import IMAGE_KEYS
from taccorl.sim.twin import TwinConfig
from taccorl.sim.twin_file import load_twin

PROGRESS, ROLLOUTS = "progress.jsonl", "rollouts"
_CHECK_SEED = 1_000_000_007  # added to the run's: scenes of the noise check are not those of training

Report = Callable[[str], None]
"""Function that is called with one line of text about the progress."""
SaveEpisode = Callable[[Episode, Path], None]
"""Function that writes an episode as a file at a path."""


def post_train(
    settings: PostTrainSettings,
    report: Report = print,
    save_episode: SaveEpisode | None = None,
) -> Path:
    """Run all iterations; returns the policy's folder of the last checkpoint. ``save_episode``: function that writes an episode
    of the rollouts as a file, such as ``views.episode.save_episode``. Raises TaccorlError: the policy, dataset, twin or
    folder does not fit, or GPU memory is exhausted."""
    try:
        run = PostTraining(settings, report, save_episode)
        with contextlib.closing(run.world):
            run.run()
    except torch.OutOfMemoryError as error:
        batch, num = settings.ppo.micro_batch, settings.env.num_envs
        way = f"Lower --ppo.micro_batch={batch} (results do not change), --env.num_envs={num} or the policy's image_resolution"
        raise TaccorlError(
            f"post-training: out of GPU memory: {str(error).splitlines()[0]} {way}"
        ) from error
    return checkpoint.policy_folder(settings.out)


class PostTraining:
    """One run of post-training: policy, environments, optimisers, checkpoints, and the loop of rollouts and updates."""

    def __init__(
        self,
        settings: PostTrainSettings,
        report: Report,
        save_episode: SaveEpisode | None = None,
    ) -> None:
        """Raises TaccorlError: as ``post_train``."""
        self.settings, self._report, self._save_episode = settings, report, save_episode
        _check_folder(settings)
        twin = load_twin(settings.env.twin) if settings.env.twin else TwinConfig()
        self._opened = _open(settings, twin)
        policy: Any = self._opened.load(settings.seed).policy
        torch.backends.cudnn.benchmark = False  # numbers of rows vary with the episodes that end; each would be tuned
        torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = (
            settings.policy.tf32
        )
        device = torch.device(str(policy.config.device))
        self._actor = TactileFlowPolicy(
            policy, settings.policy, settings.noise.num_steps
        )
        self._sde, self._clock = FlowSDE(settings.noise), Clock(device)
        self._generator = torch.Generator().manual_seed(settings.seed)
        pictures = None
        if settings.env.pictures == "randomised" and needs_images(policy.config):
            pictures = ScenePictures.of_policy(policy.config)
            report(f"pictures of the rollouts: {pictures.config}")
        elif settings.env.pictures == "randomised":
            report(
                "note: --env.pictures=randomised has no effect: the policy uses no cameras"
            )
        self.world = TwinWorld(
            _shards(settings, twin, policy.config), self._opened, self._clock, pictures
        )
        self.world.restart(settings.seed)
        self._report_pictures()
        critic = Critic(
            self._actor.num_features, self.world.observe().privileged_NP.shape[1]
        ).to(device)
        self._anchor = (
            RealAnchor(settings.anchor, policy, self._opened.preprocessor)
            if settings.anchor.dataset
            else None
        )
        anchor = self._anchor if settings.anchor.weight > 0 else None
        self._ppo = PPO(self._actor, critic, self._sde, settings.ppo, anchor)
        if settings.policy.tf32:
            self._ppo.ratio_guard = math.inf
        self._iteration, self._best = 0, 0.0
        self._recent: list[tuple[float, int]] = []
        """Success rate and number of episodes of the iterations, since the start or a collapse, in which episodes ended."""
        self._watch, self._wants_rerun = EpisodeWatch(), True
        self._episode_decisions = math.ceil(
            self.world.limit_steps / policy.config.n_action_steps
        )
        """Decisions of an episode at its time limit."""
        if settings.resume and checkpoint.exists(settings.out):
            state = checkpoint.load_state(self._opened.path)
            try:
                self._resume(state)
            except torch.OutOfMemoryError:
                raise
            except (
                LookupError,
                TypeError,
                ValueError,
                AttributeError,
                RuntimeError,
            ) as error:
                said = f"{type(error).__name__}: {' '.join(str(error).split())}"
                raise TaccorlError(
                    f"--resume=true: the state in {self._opened.path.parent} does not fit: {said}"
                ) from error
        else:
            if settings.resume:
                report(f"{settings.out} holds no checkpoint yet: the run begins again")
            self._begin(twin)

    def _begin(self, twin: TwinConfig) -> None:
        out = self.settings.out
        out.mkdir(parents=True, exist_ok=True)
        run_settings.write(self.settings)
        (out / PROGRESS).write_text("")
        num = sum(p.numel() for p in self._actor.trained_parameters())
        self._report(
            f"post-training {self.settings.policy.path}: {num / 1e6:.2f} million weights are trained"
        )
        if self._anchor is not None:
            self._report(
                f"flow loss on fixed rows of {self.settings.anchor.dataset}: {self._anchor.drift():.4f}"
            )
        if self._sde.level > 0:
            self._report_noise(twin)
            if self.settings.noise_check:
                self._check_noise()

    def _report_pictures(self) -> None:
        """Report how far pictures that a GPU draws are from those in which policies learn."""
        try:
            apart = self.world.picture_difference()
        except TaccorlError as error:
            self._report(
                f"pictures by ray tracing, not compared with OpenGL's: {error}"
            )
            return
        if apart is not None:
            self._report(
                f"pictures by ray tracing: {apart:.2f} of 255 from OpenGL's, which datasets have (mean of a few scenes); "
                "OpenGL: --env.physics=warp:mode=copied"
            )

    def _report_noise(self, twin: TwinConfig) -> None:
        batch, postprocess, seed = (
            self.world.observe().batch,
            self._opened.postprocessor,
            self.settings.seed,
        )
        for one in measure_noise(
            self._actor, self._sde, batch, postprocess, twin.robot, seed
        ):
            self._report(
                f"noise of level {self._sde.level:g} in {'all steps' if one.step < 0 else f'step {one.step}'}: "
                f"joints {1e3 * one.joints_rad:.2f} mrad, hand {one.hand_mm:.2f} mm and {one.offset_mm:.2f} mm in the mean of a "
                f"chunk, gripper {one.gripper_mm:.2f} mm (rms)"
            )

    def _check_noise(self) -> None:
        """Warn if noise costs the policy more than half of its successes."""
        settings, rates = self.settings, []
        for sde in (FlowSDE(dataclasses.replace(settings.noise, level=0.0)), self._sde):
            self.world.restart(settings.seed + _CHECK_SEED)
            generator = torch.Generator().manual_seed(settings.seed)
            found = first_episodes(
                self.world, self._actor, sde, generator, self._episode_decisions
            )
            rates.append(found.count(SUCCESS) / len(found))
        self.world.restart(settings.seed)
        self._clock.restart()
        text = f"success of the start over {settings.env.num_envs} episodes: {rates[0]:.1%} without noise, {rates[1]:.1%} with"
        if rates[1] < 0.5 * rates[0]:
            text += f"; warning: noise of level {self._sde.level:g} costs more than half: lower --noise.level"
        self._report(text)

    def _resume(self, state: dict[str, Any]) -> None:
        settings = self.settings
        progress, kept = (
            settings.out / PROGRESS,
            _progress_until(settings.out / PROGRESS, state["iteration"]),
        )
        self._ppo.load_state_dict(state["ppo"])
        self.world.load_state_dict(state["world"])
        vars(self._watch).update(state["world"]["watch"])
        self._generator.set_state(state["generator"])
        self._iteration, self._best, self._recent = (
            state["iteration"],
            state["best"],
            list(state["recent"]),
        )
        if self._iteration > settings.iterations:
            raise TaccorlError(
                f"--iterations={settings.iterations}: {self._iteration} are completed in {settings.out}"
            )
        progress.write_text(kept, encoding="utf-8")
        run_settings.write(settings)  # with other iterations, perhaps
        self._report(f"resumed at iteration {self._iteration} of {settings.iterations}")
        set_rng_state(state["random"])

    def run(self) -> None:
        """Run the remaining iterations."""
        settings, ppo, log = self.settings, self._ppo, _logger(self.settings)
        while self._iteration < settings.iterations:
            self._sde.level = settings.noise.level_after(
                self._iteration - settings.ppo.critic_warmup
            )
            rollout = collect(
                self.world,
                ppo,
                settings.env.decisions,
                self._generator,
                self._watch.see,
            )
            with self._clock.part("update"):
                facts = ppo.update(rollout.decisions, self._generator)
            if self._anchor is not None:
                with self._clock.part("drift"):
                    facts["drift"] = self._anchor.drift()
            self._iteration += 1
            row: dict[str, Any] = {
                "iteration": self._iteration,
                "decisions": self._iteration * len(rollout.decisions),
                "noise_level": self._sde.level,
            }
            seconds = {name: round(s, 3) for name, s in self._clock.restart().items()}
            row |= rollout.facts | facts | {"seconds": seconds}
            with (settings.out / PROGRESS).open("a", encoding="utf-8") as file:
                file.write(json.dumps(row) + "\n")
            log(row)
            self._report(_line(row))
            if (
                row["undone_steps"]
                and row["actor_steps"] == 1
                and not settings.ppo.adapt_lr
            ):
                undone = f"the first step at --ppo.actor_lr={row['actor_lr']:g} was undone, as KL > --ppo.kl_stop: no learning"
                self._report(
                    f"warning: {undone}. Lower it, or begin with --ppo.adapt_lr=true"
                )
            self._remember(row)
            self._guard_collapse()
            self._write_rerun()
            if (
                self._iteration % settings.save_freq == 0
                or self._iteration == settings.iterations
            ):
                self._save()

    def _remember(self, row: dict[str, Any]) -> None:
        """Keep the success of an iteration; not of the first ones, in which only short episodes can have ended."""
        if (
            row["episodes"]
            and self._iteration * self.settings.env.decisions >= self._episode_decisions
        ):
            self._recent.append((row["success"], row["episodes"]))

    def _write_rerun(self) -> None:
        """The first episode of environment 0 that ended after a checkpoint, or after the start."""
        watched = self._watch.ended
        if watched is None or not self._wants_rerun or self._save_episode is None:
            return
        out, env = self.settings.out, self.settings.env
        rrd = out / ROLLOUTS / f"iteration_{self._iteration:04d}.rrd"
        scenes = Scenes(
            tasks=(str(env.task),), episodes=1, seed=watched.seed, difficulty=env.difficulty, twin=env.twin,
            randomization=env.randomization, episode_length=self.world.limit_steps,
        )  # fmt: skip
        name = f"{out.name}, iteration {self._iteration}, with noise"
        try:
            with self._clock.part("rerun"):
                rrd.parent.mkdir(exist_ok=True)
                self._save_episode(
                    executed_again(
                        watched, scenes, name, images=needs_images(self._opened.config)
                    ),
                    rrd,
                )
        except TaccorlError as error:  # a run goes on without a file to look at
            self._report(f"warning: no {rrd}: {error}")
        self._wants_rerun = False

    def _save(self) -> None:
        self._watch.ended, self._wants_rerun = None, True
        recent = self._recent[-self.settings.save_freq :]
        score = sum(success * num for success, num in recent) / max(
            1, sum(num for _, num in recent)
        )
        is_best, self._best = score > self._best, max(score, self._best)
        state = {
            "ppo": self._ppo.state_dict(),
            "world": self.world.state_dict() | {"watch": vars(self._watch)},
            "generator": self._generator.get_state(),
            "random": get_rng_state(),
            "iteration": self._iteration,
            "best": self._best,
            "recent": self._recent,
        }
        checkpoint.save(
            self.settings.out,
            self._iteration,
            self._opened,
            self._actor.policy,
            state,
            is_best=is_best,
        )
        if self.settings.keep_checkpoints:
            checkpoint.prune(self.settings.out, self.settings.keep_checkpoints)

    def _guard_collapse(self) -> None:
        """Go back to the best checkpoint, with half of the learning rate, if success has fallen by half for long."""
        count = self.settings.collapse_iterations
        last = self._recent[-count:]
        if (
            not count
            or len(last) < count
            or self._best == 0
            or max(success for success, _ in last) >= 0.5 * self._best
        ):
            return
        folder = self.settings.out / "checkpoints" / checkpoint.BEST / checkpoint.POLICY
        load_checkpoint(self._actor.policy, str(folder))
        lr = 0.5 * self._ppo.actor_lr
        self._ppo.load_state_dict(
            {
                **checkpoint.load_state(folder)["ppo"],
                "num_updates": self._ppo.num_updates,
            }
        )
        self._ppo.actor_lr, self._recent = lr, []
        fallen = f"success was below half of the best ({self._best:.1%}) for {count} iterations"
        self._report(
            f"warning: {fallen}: back to {folder.parent.resolve().name}, learning rate of the actor now {lr:.2g}"
        )


def _open(settings: PostTrainSettings, twin: TwinConfig) -> Checkpoint:
    """Raises TaccorlError: no path, another kind of policy, or one that does not fit the environment."""
    resumed = settings.resume and checkpoint.exists(settings.out)
    path = checkpoint.policy_folder(settings.out) if resumed else settings.policy.path
    if path is None:
        raise TaccorlError(
            "missing --policy.path=…/pretrained_model, a checkpoint of tactile_pi05"
        )
    opened = open_checkpoint(path, settings.policy.device)
    config: Any = opened.config
    if config.type != "tactile_pi05":
        raise TaccorlError(
            f"--policy.path={path}: is of type {config.type}; post-training supports only tactile_pi05"
        )
    config.pretrained_path = (
        settings.policy.path
    )  # where the run began, also after it was resumed
    config.dtype = "float32"  # a step of 5e-6 is lost in bfloat16
    tasks = [] if settings.env.task is None else [settings.env.task]
    refuse_differences(
        preflight(opened.facts(), twin, tasks=tasks, pictures=settings.env.pictures),
        str(path),
    )
    return opened


def _shards(settings: PostTrainSettings, twin: TwinConfig, config: Any) -> list[Shard]:
    """Shards as equal in size as can be; each compiles the twin for itself, those in other processes at the same time."""
    env = settings.env
    if env.task is None:
        raise TaccorlError("missing --env.task=…, such as assembly_2")
    ray = start_ray() if env.ray else None
    num_threads = env.threads or max(1, len(os.sched_getaffinity(0)) // env.shards)

    def shard(numbers: np.ndarray) -> Shard:
        envs: dict[str, Any] = {
            "task": env.task,
            "num_envs": len(numbers),
            "difficulty": env.difficulty,
            "twin": twin,
            "randomization": env.randomization,
            "physics": env.physics,
            "num_threads": min(len(numbers), num_threads),
            "max_episode_steps": env.episode_length,
            "part_poses": config.part_poses,
            "images": "on_request" if needs_images(config) else "never",
        }
        make = partial(
            make_shard,
            envs,
            history=config.tactile_history,
            stride=config.tactile_stride,
            num_actions=config.n_action_steps,
            starts=StartStates(env.start_share, max(1, NUM_STATES // env.shards)),
            privileged=settings.ppo.privileged_critic,
            first=int(numbers[0]),
            drawn=_drawn(config, twin, on_host=ray is not None or env.shards > 1),
        )
        if ray is not None:
            return RayShard(ray, make, envs["num_threads"])
        return ProcessShard(make) if env.shards > 1 else LocalShard(make)

    return [
        shard(numbers)
        for numbers in np.array_split(np.arange(env.num_envs), env.shards)
    ]


def _drawn(config: Any, twin: TwinConfig, *, on_host: bool) -> DrawnPictures | None:
    """Pictures that a GPU may draw for the policy at its own size: letterboxed into a square, or of the cameras' aspect. None:
    other sizes, which are cut from larger pictures, and policies without cameras."""
    names = [n for n in ROBOT.cameras if IMAGE_KEYS[n] in config.input_features]
    rows, columns = size = tuple(config.image_resolution)
    for camera in twin.cameras:
        window = letterbox_window(camera.recording_size, size)
        if rows != columns and (window.rows, window.columns) != size:
            return None
    return DrawnPictures(names, size, on_host) if names else None


def _check_folder(settings: PostTrainSettings) -> None:
    """Raises TaccorlError: ``out`` is in use, or what is to be resumed had other settings, or an anchor has no dataset."""
    if settings.resume:
        run_settings.refuse_changes(settings)
        return
    if settings.anchor.weight > 0 and settings.anchor.dataset is None:
        raise TaccorlError(
            "missing --anchor.dataset=…, real demonstrations; without an anchor: --anchor.weight=0"
        )
    run_settings.remove_unfinished(settings.out)
    if not is_free(settings.out):
        raise TaccorlError(
            f"--out={settings.out}: holds files already: give another folder, or --resume=true to go on"
        )


def _progress_until(path: Path, iteration: int) -> str:
    """Lines of ``progress.jsonl`` up to ``iteration``; later ones have no checkpoint, and the last may be torn. Raises
    TaccorlError: one of them is not that of an iteration."""
    kept, done = "", 0
    for number, line in enumerate(
        path.read_bytes().splitlines() if path.is_file() else [], 1
    ):
        try:
            if (
                done == iteration
                or (done := int(json.loads(line)["iteration"])) > iteration
            ):
                break
            kept += line.decode() + "\n"
        except (ValueError, LookupError, TypeError, RecursionError) as error:
            way = "correct it from a copy, or remove the file: only the curve is lost"
            raise TaccorlError(
                f"--resume=true: {path}, line {number}: is damaged ({error}); {way}"
            ) from error
    return kept


def _logger(settings: PostTrainSettings) -> Callable[[dict[str, Any]], None]:
    """Return a function that logs a row of ``progress.jsonl`` to Weights & Biases, if asked for; a resumed run continues."""
    asked, out = settings.wandb, settings.out
    if not asked.enable:
        return lambda row: None
    import wandb

    run = wandb.init(
        id=_last_run(out),
        resume="allow", project=asked.project, entity=asked.entity, mode=asked.mode,  # type: ignore[arg-type]
        name=out.name, dir=out, job_type="post-train", config=run_settings.to_json(settings),
    )  # fmt: skip
    return lambda row: run.log(
        {name: value for name, value in row.items() if value is not None},
        step=row["iteration"],
    )


def _last_run(out: Path) -> str | None:
    """Name of the run of Weights & Biases in ``out/wandb/latest-run``; None: there is no
    run. Raises TaccorlError: there are several files of runs, or none."""
    if not (out / "wandb").is_dir():
        return None
    found = [*out.glob("wandb/latest-run/run-*.wandb")]
    if len(found) != 1:
        raise TaccorlError(
            f"{out / 'wandb' / 'latest-run'}: has {len(found)} files run-*.wandb, where one "
            "names the run that goes on; remove the folder wandb to begin another one"
        )
    return found[0].stem.removeprefix("run-")


def _line(row: dict[str, Any]) -> str:
    parts = ["no episode from a reset ended"]
    if row["episodes"]:
        parts = [f"success {row['success']:.1%} of {row['episodes']} episodes"]
    if "later_episodes" in row:
        parts[0] += (
            f" ({row['later_success']:.1%} of {row['later_episodes']:.0f} begun in earlier states)"
        )
    parts.append(f"explained variance {row['explained_variance']:.2f}")
    if "kl" in row:
        parts += [f"KL {row['last_kl']:.4f}", f"clipped {row['clip_fraction']:.1%}"]
    names = {"anchor_loss": "anchor", "drift": "flow loss on fixed real rows"}
    parts += [f"{text} {row[name]:.4f}" for name, text in names.items() if name in row]
    if row["undone_steps"]:
        parts.append(
            f"{row['undone_steps']} step undone at learning rate {row['actor_lr']:.2g}"
        )
    seconds = ", ".join(f"{name} {s:.1f}" for name, s in row["seconds"].items())
    return f"iteration {row['iteration']}: {', '.join(parts)}; seconds: {seconds}"

"""``taccorl evaluate --policy.path=CHECKPOINT --task=assembly_2 [--episodes=128] [--against=OTHER] [--twin=twin.yaml]``
``taccorl evaluate --policy.path=CHECKPOINT --task=assembly_2 --robot.type=taccorl_surrogate``

Evaluate a policy in the twin on new scenes: success rate with its interval, partial credit, failure categories and times, for
each episode. With the same --seed and batch size, scenes and success are the same as those of lerobot-eval.

Writes episodes.jsonl (one line an episode), evaluation.json, report.html and failures/*.rrd.
"""

import dataclasses
import functools
import itertools
import json
import os
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from taccorl.cli.parse import given_names, joined, parse, shared_fields
from taccorl.cli.printed import give
from taccorl.cli.progress import Steps
from taccorl.errors import TaccorlError, nearest
from taccorl.extras import require
from taccorl.lineage.destinations import check_writable, is_free
from taccorl.lineage.engines import LocalEngine
from taccorl.lineage.processes import worker_number
from taccorl.report.page import write
from taccorl.report.section import Section

if TYPE_CHECKING:
    from collections.abc import Sequence

    from taccorl.evaluation.evaluate import Scenes
    from taccorl.evaluation.preflight import Check
    from taccorl.evaluation.rollouts import Actor, Rollout
    from taccorl.report.evaluated import Evaluation
    from taccorl.sim.twin import TwinConfig

EXPERT = "expert"
"""Word that stands for the scripted expert in place of a checkpoint."""
ROBOT_TRIALS = 20
"""Trials of a task on a robot, as in the paper."""
_OF_TWIN = (
    "difficulty",
    "twin",
    "randomization",
    "pictures",
    "hide",
    "physics",
    "batch_size",
    "workers",
    "before_mate",
)
"""Options that configure the simulation, refused with a robot."""


@dataclass(kw_only=True)
class PolicyChoice:
    """The policy to evaluate: a checkpoint or the scripted expert."""

    path: Path | None = None
    """Folder ``pretrained_model`` of a checkpoint."""
    type: str | None = None
    """expert: the task's scripted expert instead of a checkpoint, as a reference."""
    device: str | None = None
    """Device of the policy: cpu, cuda, …; as in the checkpoint if not given."""
    n_action_steps: int | None = None
    """Number of actions of a chunk that are executed; as in the checkpoint if not given."""


@dataclass(kw_only=True)
class EvaluateConfig:
    """Evaluate a policy in the twin."""

    policy: PolicyChoice = field(default_factory=PolicyChoice)
    """The policy to evaluate: --policy.path=CHECKPOINT or --policy.type=expert."""
    task: list[str] = field(default_factory=list)
    """Task, or several by repeating the option: {tasks}."""
    against: str | None = None
    """Compare with this on the same scenes: a checkpoint, ``expert``, or the folder of an earlier evaluation. Difference of the
    success rates with its interval, McNemar's exact test."""
    episodes: int = 128
    """Number of scenes of each task; 128 is the paper's number."""
    seed: int = 1000
    """Scene seed of the first episode; episode k has seed + k. 1000 is lerobot-eval's default."""
    out: Path = Path("outputs/evaluation")
    """Folder of the results. It must not exist, or be empty."""
    difficulty: str = "train"
    """Clearance on each side of mating parts: easy 1.0 mm, train 0.5 mm, hard 0.3 mm."""
    twin: Path | None = None
    """A twin.yaml; the nominal twin if not given."""
    randomization: float = 1.0
    """Factor on the ranges from which a reset of the task draws, from 0 (always the nominal scene) to 1 (the full ranges)."""
    pictures: str = "clear"
    """Pictures that policies see. clear: as rendered; randomised: changed by the image rows of the paper's randomisation (crop,
    rotation, brightness, contrast, saturation, noise). Each scene draws them once for each camera, noise anew in each picture."""
    hide: list[str] = field(default_factory=list)
    """Hide a sensor from policies, which shows what they use when: touch, cameras; touch_at_mate, cameras_at_mate: from when each
    arm is in its last subtask. Policies then get zeros (no contact, black pictures). Repeat the option for several."""
    episode_length: int | None = None
    """Control steps until an episode is cut off; the task's own limit if not given."""
    physics: str = "c"
    """c: MuJoCo on the CPU; warp: MuJoCo Warp on a GPU (extra gpu), which cannot repeat an episode bit for bit: no failures are
    saved. warp:device=cuda:1,contacts=128: settings."""
    batch_size: int | None = None
    """Number of environments at the same time; all episodes of a task if not given."""
    workers: int = 1
    """Processes among which the scenes are divided, each with a policy of its own; several GPUs are used in turn. As with another
    batch_size, a policy that draws noise gets other random numbers."""
    before_mate: int = 0
    """Number of further scenes in which the expert brings a part before its mate, displaced by up to 4 mm, and policies are asked
    where they aim: how much of a displacement they keep (0: they aim at the axis) and how far the aims of different grips lie
    apart. In evaluation.json and on the page. 0: not asked."""
    failures: int = 4
    """Number of failed episodes that are saved with pictures as a Rerun file; 0: none."""
    robot: dict[str, Any] = field(default_factory=dict)
    """Evaluate on a robot instead, 20 trials, with its options of lerobot-rollout: --robot.type=bi_piper_flexitac, touch_robot or
    taccorl_surrogate. The key y or n judges a trial; a surrogate judges by itself. The same command goes on after a stop."""
    images: bool = True
    """Render the cameras for the saved failures (needs OpenGL). A policy with camera inputs needs OpenGL even if this is
    false."""


def main(argv: list[str]) -> int:
    """Run ``taccorl evaluate`` with the words ``argv`` after it; returns the exit status of ``run``."""
    argv, robot = with_robot(argv)
    config = parse(EvaluateConfig, argv, positional=None)
    config.robot |= robot
    given = given_names(argv)
    if config.robot and (
        useless := next((name for name in _OF_TWIN if name in given), None)
    ):
        raise TaccorlError(f"--{useless} has no effect with --robot.type: remove it")
    if config.physics != "c" and "failures" not in given:
        config.failures = 0
    if config.robot and "episodes" not in given:
        config.episodes = ROBOT_TRIALS
    return run(config)


def with_robot(argv: list[str]) -> tuple[list[str], dict[str, Any]]:
    """``argv`` without --robot.…; and the values of these, by name: {"type": …, "safety": {"stop_after_s": …}}."""
    import yaml

    argv, robot = joined(argv), {}
    for name, _, value in (
        word.removeprefix("--robot.").partition("=")
        for word in argv
        if word.startswith("--robot.")
    ):
        *outer, last = name.split(".")
        functools.reduce(lambda inner, key: inner.setdefault(key, {}), outer, robot)[
            last
        ] = yaml.safe_load(value)
    return [word for word in argv if not word.startswith("--robot.")], robot


def run(config: EvaluateConfig) -> int:
    """Evaluate the policy, and write the results. Returns the exit status 0."""
    _check_places(config)
    require("train")
    from taccorl.evaluation.episodes import ROWS_FILE, SUMMARY_FILE, compare, write_rows
    from taccorl.evaluation.evaluate import Scenes, is_stored, read_stored
    from taccorl.evaluation.rollouts import Rollout
    from taccorl.report.evaluated import Evaluation
    from taccorl.report.terminal import show

    own: dict[str, Any] = {"tasks": tuple(config.task), "hidden": tuple(config.hide)}
    scenes = Scenes(**shared_fields(config, Scenes) | own)
    scenes.twin_config()  # read it before anything is loaded
    against = Path(config.against) if config.against else None
    stored = (
        read_stored(against, scenes)
        if against is not None and is_stored(against)
        else None
    )
    other = None
    if against is not None and stored is None:
        if str(against) != EXPERT and not against.is_dir():
            raise TaccorlError(
                f"--against={against}: no such folder; give a checkpoint (pretrained_model), the folder of an earlier "
                f"evaluation, or {EXPERT}"
            )
        other = (
            PolicyChoice(type=EXPERT)
            if str(against) == EXPERT
            else PolicyChoice(path=against)
        )
        other.device = config.policy.device
    kind = config.robot.get("type")
    paired = kind == "taccorl_surrogate"  # a robot's scenes are never the same
    useless = (
        other
        or config.policy.path is None
        or len(scenes.tasks) > 1
        or (against and not paired)
    )
    if config.robot and (not kind or useless):
        line = "give it, one --policy.path, one --task; on a surrogate --against=FOLDER of an earlier evaluation at most"
        raise TaccorlError(f"--robot.type: {line}")
    env: dict[str, Any] = {"tasks": scenes.tasks, "pictures": scenes.pictures}
    twin = (
        None if kind == "touch_robot" else scenes.twin_config()
    )  # its robot is not the twin's
    opened = [open_policy(config.policy, twin, **env)]
    if other is not None:
        opened.append(open_policy(other, scenes.twin_config(), "--against", **env))
    if scenes.hidden and config.policy.path is None:
        raise TaccorlError("--hide: the expert reads no sensor; give --policy.path")
    if scenes.pictures == "randomised" and not any(
        c.what == "pictures" for one in opened for c in one.checks
    ):
        print(
            "note: --pictures=randomised has no effect: no policy that is evaluated here uses cameras"
        )
    names = [one.name for one in opened] + ([stored.policy] if stored else [])
    if len(set(names)) < len(names):
        raise TaccorlError(
            f"--against={config.against}: is the evaluated policy itself; give another policy"
        )
    if not is_free(config.out) and not config.robot:
        text = f"--out={config.out}: holds files already; nothing was changed: give another folder, or move it away"
        raise TaccorlError(text)
    check_writable(config.out)
    config.out.mkdir(parents=True, exist_ok=True)
    begun_s = time.monotonic()
    executed = {one.name: text for one in opened if (text := one.executed)}
    found = Evaluation(
        scenes=scenes, policies=opened, executed=executed, against=config.against
    )
    rollouts, rows = [], []
    if config.robot:
        from taccorl.robot_plugin.trials import evaluate_on_robot

        recordings = (
            config.out / "trials" if config.failures and config.images else None
        )
        found = evaluate_on_robot(
            found, opened[0].checkpoint.config, config.robot, config.out, recordings
        )
        rows, rollouts = [found.rows], [[*map(Rollout, found.rows)]]
    for one in () if config.robot else opened:
        rollouts.append(_scored(config, scenes, one))
        rows.append([rollout.row for rollout in rollouts[-1]])
        write_rows(
            [row for own in rows for row in own], config.out / ROWS_FILE
        )  # kept if the next policy fails
    aimed = {}
    if config.before_mate:
        from taccorl.evaluation.before_mate import aims_of

        asked = [one.checkpoint for one in opened if one.checkpoint is not None]
        aimed = aims_of(
            scenes,
            asked,
            config.before_mate,
            config.policy.device,
            config.seed,
            Steps(every_s=10),
        )
    wall_s = time.monotonic() - begun_s
    rows += [stored.rows] if stored else []
    found = dataclasses.replace(
        found,
        rows=[row for own in rows for row in own],
        comparisons=compare(rows[0], rows[1]) if len(rows) == 2 else {},
        aimed=aimed,
        wall_s=wall_s,
    )
    write_rows(found.rows, config.out / ROWS_FILE)
    write(
        {
            config.out / SUMMARY_FILE: json.dumps(
                found.to_json(), indent=1, ensure_ascii=False
            )
            + "\n"
        }
    )
    give(found.to_json)
    show(found.lines())
    show(_write_page(config, found, rollouts[0]))
    return 0


@dataclass
class OpenedPolicy:
    """Policy that was checked against the environment, before its weights are loaded."""

    name: str
    """Name for tables: ``expert``, or the checkpoint's path."""
    digest: str
    """Digest of the checkpoint; for the expert a description."""
    checks: "Sequence[Check]"
    """Results of the comparison of the checkpoint with the environment."""
    checkpoint: Any = None
    """The checkpoint; None for the expert."""
    choice: PolicyChoice = field(default_factory=PolicyChoice)
    """What it was opened with."""

    @property
    def executed(self) -> str:
        """``8 of 16``: executed actions of a chunk; empty if the policy states no chunks."""
        config = getattr(self.checkpoint, "config", None)
        executed, predicted = (
            getattr(config, name, None) for name in ("n_action_steps", "chunk_size")
        )
        return f"{executed} of {predicted}" if executed and predicted else ""

    def load(self, seed: int) -> "Actor":
        """The policy, ready to act, with its random numbers drawn from ``seed``."""
        if self.checkpoint is not None:
            return self.checkpoint.load(seed)
        from taccorl.evaluation.expert_actor import ExpertActor

        return ExpertActor()


def open_policy(
    choice: PolicyChoice,
    twin: "TwinConfig | None",
    option: str = "--policy.path",
    *,
    tasks: "Sequence[str]" = (),
    pictures: str = "clear",
) -> OpenedPolicy:
    """Print what the checkpoint and the environment (``twin``; None: another, not compared) state; ``option`` gave it, for
    messages. Raises TaccorlError: neither or both of policy.path and policy.type are given, or the checkpoint cannot be used or
    does not fit."""
    if (choice.path is None) == (choice.type is None):
        raise TaccorlError(
            "give --policy.path=CHECKPOINT or --policy.type=expert, one of them"
        )
    if choice.path is None:
        if choice.type != EXPERT:
            known = nearest(str(choice.type), [EXPERT])
            raise TaccorlError(
                f"--policy.type={choice.type}: {known}; a checkpoint is --policy.path=…"
            )
        if choice.n_action_steps is not None:
            raise TaccorlError(
                "--policy.n_action_steps has no effect with --policy.type=expert: remove it"
            )
        return OpenedPolicy(
            EXPERT, "the scripted expert, which sees the simulator's poses", []
        )
    from taccorl.evaluation.preflight import preflight, refuse_differences
    from taccorl.evaluation.rollouts import checked_pictures
    from taccorl.report.evaluated import preflight as checked
    from taccorl.report.terminal import show

    checkpoint = open_saved(choice, option)
    if twin is None:
        return OpenedPolicy(str(choice.path), checkpoint.digest, [], checkpoint, choice)
    checks = preflight(
        checkpoint.facts(), twin, tasks=tasks, pictures=checked_pictures(pictures)
    )
    show(checked(str(choice.path), checks))
    refuse_differences(checks, str(choice.path))
    return OpenedPolicy(str(choice.path), checkpoint.digest, checks, checkpoint, choice)


def register_policies() -> None:
    """Register our policies, and those of other packages, with LeRobot. Raises TaccorlError: a package for it is missing."""
    require("train")
    from lerobot.utils.import_utils import register_third_party_plugins

    import taccorl.lerobot_plugin  # noqa: F401  registers ours

    register_third_party_plugins()


def open_saved(choice: PolicyChoice, option: str = "--policy.path") -> Any:
    """Open the checkpoint that ``choice`` names. ``option``: the command-line option that gave it, for error messages."""
    register_policies()
    from taccorl.evaluation.policy_actor import open_checkpoint

    assert choice.path is not None
    return open_checkpoint(
        choice.path, choice.device, option, n_action_steps=choice.n_action_steps
    )


def _scored(
    config: EvaluateConfig, scenes: "Scenes", policy: OpenedPolicy
) -> "list[Rollout]":
    """All episodes of a policy, task by task, in the order of their seeds."""
    if config.workers == 1:
        return _score_share((scenes, policy, config.seed, 0, None))
    threads = max(1, len(os.sched_getaffinity(0)) // config.workers)
    sent = dataclasses.replace(
        policy, checks=[], checkpoint=None
    )  # the worker opens it
    items = [
        (part, sent, config.seed, k, threads)
        for k, part in enumerate(scenes.shares(config.workers))
    ]
    found = LocalEngine(workers=config.workers).map(
        _score_share, items, name=lambda item: str(item[0].seeds)
    )
    return sorted(
        itertools.chain.from_iterable(found),
        key=lambda one: (scenes.tasks.index(one.row.task), one.row.seed),
    )


def _score_share(
    item: "tuple[Scenes, OpenedPolicy, int, int, int | None]",
) -> "list[Rollout]":
    """Run episodes in this process. ``item``: scenes, policy, seed, stream of its random numbers, threads of the physics."""
    from taccorl.evaluation.evaluate import score

    scenes, policy, seed, stream, threads = item
    if policy.checkpoint is None and policy.choice.path is not None:
        policy.checkpoint = open_saved(policy.choice)
        import torch

        if policy.checkpoint.config.device == "cuda":
            # "cuda" then means this worker's GPU for weights and processors alike; a
            # processor states its device apart from the policy.
            torch.cuda.set_device((worker_number() or 0) % torch.cuda.device_count())
        torch.set_num_threads(
            threads or torch.get_num_threads()
        )  # its share of the cores, as for the physics
    return score(
        scenes, policy.load(seed), Steps(every_s=10), stream=stream, num_threads=threads
    )


def _check_places(config: EvaluateConfig) -> None:
    """Raises TaccorlError: a number is below its range, or --physics cannot be used here."""
    from taccorl.sim.warp_batch import WarpSettings, open_device

    if config.workers < 1:
        raise TaccorlError(f"--workers={config.workers}: at least 1")
    if config.failures < 0:
        raise TaccorlError(f"--failures={config.failures}: at least 0")
    warp = WarpSettings.parse(config.physics)
    if warp is not None and config.workers > 1:
        raise TaccorlError(
            f"--workers={config.workers}: --physics={config.physics} runs all episodes in one process: remove it"
        )
    if warp is not None and config.failures:
        line = f"--failures={config.failures}: --physics={config.physics} cannot repeat an episode: give --failures=0"
        raise TaccorlError(line)
    if warp is not None:
        open_device(warp.device)  # before weights are loaded
    if config.before_mate < 0 or config.before_mate == 1:
        raise TaccorlError(
            f"--before_mate={config.before_mate}: 0, or 2 or more, because grips are compared"
        )
    if config.before_mate and config.policy.path is None:
        line = f"--before_mate={config.before_mate}: asks a policy, and the expert is none: give --policy.path"
        raise TaccorlError(line)


def _write_page(config: EvaluateConfig, found: "Evaluation", rollouts: list) -> Section:
    """``report.html`` and ``failures/*.rrd``, and the line that names them."""
    from taccorl.evaluation.failed_episodes import (
        choose_failures,
        execute_again,
        recorded_failures,
    )
    from taccorl.views.episode import save_episode

    chosen, images, notes = (
        choose_failures(rollouts, config.failures),
        config.images,
        [],
    )
    if config.robot:
        write(
            {
                config.out / "report.html": found.html(
                    recorded_failures(chosen, config.out / "trials")
                )
            }
        )
        line = f"wrote {config.out}: episodes.jsonl, evaluation.json, report.html, trials/*.mcap"
        return Section(text=[line])
    try:
        failed = [execute_again(found.scenes, one, images=images) for one in chosen]
    except TaccorlError as error:
        if not images:
            raise
        notes = [f"note: failures have no pictures: {error}"]
        failed = [execute_again(found.scenes, one, images=False) for one in chosen]
    rrds = []
    for row, one in ((one.rollout.row, one) for one in failed):
        rrds.append(
            config.out / "failures" / f"{row.task}_seed_{row.seed}_{row.outcome}.rrd"
        )
        rrds[-1].parent.mkdir(exist_ok=True)
        assert one.episode is not None, "it was executed again"
        save_episode(one.episode, rrds[-1])
    write(
        {config.out / "report.html": found.html(list(zip(failed, rrds, strict=True)))}
    )
    files = [
        "episodes.jsonl",
        "evaluation.json",
        "report.html",
        *(str(p.relative_to(config.out)) for p in rrds),
    ]
    return Section(text=[*notes, f"wrote {config.out}: {', '.join(files)}"])

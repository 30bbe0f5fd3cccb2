"""``python -m pipelines.learn --task=assembly_1 [--small]``: a policy from scratch on one GPU, from nothing to its score::

    collect --pictures=cache ── lerobot-train --dataset.cache=gpu ── evaluate (which number of executed actions) ── evaluate

All of it is simulated: no robot is near. Everything lands in outputs/learn; a stopped run goes on where it was. It wants a GPU
and 16 cores for half an hour (docs/learning.md). ``--small`` shows the chain on a CPU in minutes and learns nothing.
"""

import json
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from pipelines.lerobot_commands import Training
from pipelines.steps import chosen, lerobot, parsed, step
from taccorl.cli import collect, evaluate
from taccorl.cli.collect import CollectConfig
from taccorl.cli.evaluate import EvaluateConfig, PolicyChoice
from taccorl.episodes.sources.expert import ExpertSource
from taccorl.errors import DatasetError, nearest
from taccorl.evaluation.rollouts import PICTURES
from taccorl.lineage.destinations import is_free
from taccorl.lineage.engines import LocalEngine
from taccorl.tasks.experts.hands import ScriptedExpertConfig

SMALL = ("--episodes=2", "--scored=2", "--validated=2", "--executed=[8]", "--episode_length=12", "--workers=1")
SMALL += ("--train=configs/learn/tiny.yaml", "--train_options=[--steps=2,--batch_size=2,--save_freq=2]", "--cache=host")
RESOLUTION = "84x112"
VALIDATION_SEED, SCORE_SEED = 40000, 50000


@dataclass(kw_only=True)
class LearnConfig:
    """Demonstrations of the twin → policy → score."""

    task: str = "assembly_1"
    """Task: {tasks}."""
    episodes: int = 3500
    """Demonstrations of the scripted expert, each with a grip of its own."""
    hands: ScriptedExpertConfig = field(
        default_factory=lambda: ScriptedExpertConfig(grasp_m=0.004, grasp_rad=0.06, pulse_rad=0.02)
    )
    """Spread of the grips, pulses, errors of the expert: --hands.grasp_m=0.004 …"""
    physics_steps: int = 20
    """Physics steps in a control step of the demonstrations; half of the twin's, for half of the time. Scores use the twin's."""
    difficulty: str = "train"
    """Clearance on each side of mating parts, in demonstrations and scores: easy 1.0 mm, train 0.5 mm, hard 0.3 mm."""
    workers: int = 16
    """Processes that make demonstrations."""
    train: Path = Path("configs/learn/small.yaml")
    """Config of lerobot-train."""
    train_options: list[str] = field(default_factory=list)
    """Further words for lerobot-train, such as [--seed=1,--policy.tactile=false]."""
    cache: str = "gpu"
    """Where frames are held: gpu, host, disk."""
    executed: list[int] = field(default_factory=lambda: [8, 16])
    """Candidates for the number of actions of a chunk that are executed; the one with most successes in validation is used."""
    validated: int = 64
    """Scenes of the validation, seeds 40000 and on."""
    scored: int = 512
    """Scenes of the score, seeds 50000 and on: nothing is chosen by them."""
    pictures: str = "clear"
    """Pictures that the policy sees in validation and score: clear, randomised (see taccorl evaluate)."""
    batch_size: int = 128
    """Scenes at the same time."""
    episode_length: int | None = None
    """Control steps after which a scored episode is cut off; the task's own limit if not given."""
    out: Path = Path("outputs/learn")
    """Folder of everything: the demonstrations are shared by all runs there, a policy's folder is named after its settings."""


class Learned(NamedTuple):
    """What a run made."""

    policy: Path
    """Folder pretrained_model."""
    dataset: Path
    store: Path
    """Of frames, too."""
    score: Path
    """Folder of the score."""


def main(words: list[str]) -> Learned:
    config = parsed(LearnConfig, chosen(words, SMALL), "python -m pipelines.learn")
    if not config.train.is_file():
        raise SystemExit(f"--train={config.train}: no such file")
    _check(config)  # before hours of demonstrations
    dataset, store = demonstrations(config)
    training = Training(config.train, dataset, _training_words(config, store), config.out / config.task)
    lerobot(training.command())
    executed = _chosen_executed(config, training)
    score = _evaluation(config, training, executed, config.scored, SCORE_SEED)
    print(f"\n--policy.path={training.policy} --policy.n_action_steps={executed}")
    print(f"score: {_rate(score)}; page: {score / 'report.html'}")
    return Learned(training.policy, dataset, store, score)


def _check(config: LearnConfig) -> None:
    """
    Raises:
        SystemExit: a value that a later step would refuse.
    """
    if not config.executed or min(config.executed) < 1:
        raise SystemExit(
            f"--executed={config.executed}: give numbers of executed actions of at least 1, such as [8,16]"
        )
    for name in ("episodes", "workers", "validated", "scored", "batch_size"):
        if getattr(config, name) < 1:
            raise SystemExit(f"--{name}={getattr(config, name)}: at least 1")
    for name, value, known in (
        ("pictures", config.pictures, PICTURES),
        ("cache", config.cache, ("gpu", "host", "disk")),
    ):
        if value not in known:
            raise SystemExit(f"--{name}={value}: {nearest(value, known)}")


def demonstrations(config: LearnConfig) -> tuple[Path, Path]:
    """Collect the demonstrations of ``config``, if they are not there. Returns the dataset's folder and the store."""
    folder, store = config.out / config.task, config.out / "store"
    twin = folder / f"twin_of_{config.physics_steps}_steps.yaml"
    dataset = folder / f"{config.difficulty}_{config.episodes}_{config.physics_steps}_steps"
    folder.mkdir(parents=True, exist_ok=True)
    twin.write_text(f"physics:\n  steps_per_control_step: {config.physics_steps}\neffects: []\n", encoding="utf-8")
    made = CollectConfig(
        task=config.task,
        source=ExpertSource(hands=config.hands),
        episodes=config.episodes,
        out=dataset,
        store=store,
        difficulty=config.difficulty,
        twin=twin,
        pictures="cache",
        resolution=RESOLUTION,
        part_poses=True,
        engine=LocalEngine(workers=config.workers),
    )
    try:
        step(collect.run, made)
    except DatasetError as error:
        raise SystemExit(f"{error}\nother demonstrations need another --out") from error
    return dataset, store


def _training_words(config: LearnConfig, store: Path) -> list[str]:
    return [
        f"--dataset.cache={config.cache}",
        f"--dataset.cache_store={store}",
        f"--policy.image_resolution=[{RESOLUTION.replace('x', ',')}]",
        *config.train_options,
    ]


def _chosen_executed(config: LearnConfig, training: Training) -> int:
    """Number of executed actions with the most successes in the validation scenes."""
    if len(config.executed) == 1:
        return config.executed[0]
    scores = {k: _evaluation(config, training, k, config.validated, VALIDATION_SEED) for k in config.executed}
    best = max(config.executed, key=lambda k: _successes(scores[k]))
    for k, folder in scores.items():
        print(f"validation, {k} actions executed: {_rate(folder)}{', chosen' if k == best else ''}")
    return best


def _evaluation(config: LearnConfig, training: Training, executed: int, scenes: int, seed: int) -> Path:
    """Score the trained policy, if that is not done yet. Returns the folder of the results."""
    seen = "" if config.pictures == "clear" else f"_{config.pictures}"
    length = "" if config.episode_length is None else f"_{config.episode_length}_steps"
    out = training.folder / f"score_{seed}_{scenes}_{executed}{seen}{length}"
    if not (out / "evaluation.json").is_file():
        if not is_free(out):
            raise SystemExit(f"{out}: holds the beginning of an evaluation that was stopped; remove it")
        asked = EvaluateConfig(
            policy=PolicyChoice(path=training.policy, n_action_steps=executed),
            task=[config.task],
            episodes=scenes,
            seed=seed,
            out=out,
            difficulty=config.difficulty,
            pictures=config.pictures,
            batch_size=min(config.batch_size, scenes),
            episode_length=config.episode_length,
        )
        step(evaluate.run, asked)
    return out


def _score(folder: Path) -> dict:
    (score,) = json.loads((folder / "evaluation.json").read_text(encoding="utf-8"))["scores"]
    return score


def _successes(folder: Path) -> int:
    return _score(folder)["successes"]


def _rate(folder: Path) -> str:
    score = _score(folder)
    low, high = (100 * end for end in score["interval_95"])
    return f"{score['successes']} of {score['n']} scenes, {100 * score['rate']:.0f} % (95 %: {low:.0f} … {high:.0f})"


if __name__ == "__main__":
    main(sys.argv[1:])

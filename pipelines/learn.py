"""``python -m pipelines.learn --task=assembly_2 [--small]``: a policy from scratch on one GPU, from sources to its score::

    collect ── augment --rows=actions ── execute --pictures=cache ── lerobot-train --dataset.cache=gpu ── evaluate

All of it is simulated: no robot is near. Everything lands in outputs/learn; a stopped run goes on where it was. It wants a GPU
(docs/learning.md). ``--small`` shows the chain on a CPU in minutes and learns nothing.
"""

import dataclasses
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import yaml

from pipelines.lerobot_commands import Training
from pipelines.steps import chosen, lerobot, parsed, step
from taccorl.cli import augment, collect, evaluate, execute
from taccorl.cli.augment import AugmentConfig
from taccorl.cli.collect import CollectConfig
from taccorl.cli.evaluate import EvaluateConfig, PolicyChoice
from taccorl.cli.execute import ExecuteConfig
from taccorl.demos.mimicgen.spec import mimic_spec_path
from taccorl.lineage.engines import LocalEngine

SMALL = ("--sources=1", "--episodes=1", "--scored=2", "--episode_length=12", "--workers=1")
SMALL += ("--train=configs/learn/tiny.yaml", "--train_options=[--steps=2,--batch_size=2,--save_freq=2]", "--cache=host")
HOW = {"contact_mode": "closed_loop_expert", "disturbance": {"joint_rad": 0.02}}
PX = 112
POSE_LOSS = 0.1  # docs/learning.md


@dataclass(kw_only=True)
class LearnConfig:
    """Demonstrations of the twin → policy → score."""

    task: str = "assembly_2"
    """Task: {tasks}."""
    sources: int = 10
    """Episodes of the scripted expert …"""
    episodes: int = 1000
    """… and made of them, disturbed in transport and closed-loop in contact."""
    workers: int = 16
    """Processes that make demonstrations."""
    train: Path = Path("configs/learn/small.yaml")
    """Config of lerobot-train."""
    train_options: list[str] = field(default_factory=list)
    """Further words for lerobot-train, such as [--seed=1,--steps=8000]."""
    cache: str = "gpu"
    """Where frames are held: gpu, host, disk."""
    scored: int = 512
    """Scenes of the score, seeds 50000 and on: nothing is chosen by them."""
    episode_length: int | None = None
    """Control steps after which a scored episode is cut off; the task's own limit if not given."""
    out: Path = Path("outputs/learn")


class Learned(NamedTuple):
    """What a run made."""

    policy: Path
    """Folder pretrained_model."""
    dataset: Path
    store: Path
    """Of frames, too."""


def main(words: list[str]) -> Learned:
    config = parsed(LearnConfig, chosen(words, SMALL), "python -m pipelines.learn")
    if not config.train.is_file():  # before hours of demonstrations
        raise SystemExit(f"--train={config.train}: no such file")
    out, task, store = config.out / config.task, config.task, config.out / "store"
    sources, actions, rows = out / "sources", out / f"actions_{config.episodes}", out / f"rows_{config.episodes}"
    spec, engine = out / "mimicgen.yaml", LocalEngine(workers=config.workers)
    out.mkdir(parents=True, exist_ok=True)
    told = yaml.safe_load(mimic_spec_path(task).read_text(encoding="utf-8"))
    spec.write_text(yaml.safe_dump(told | {"datagen_config": told.get("datagen_config", {}) | HOW}), encoding="utf-8")
    step(collect.run, CollectConfig(task=task, episodes=config.sources, images=False, out=sources, store=store))
    made = AugmentConfig(
        source=sources, task=task, episodes=config.episodes, rows="actions", spec=str(spec), out=actions
    )
    step(augment.run, dataclasses.replace(made, engine=engine, store=store))
    frames = ExecuteConfig(source=[actions], out=rows, pictures="cache", resolution=f"{PX}x{PX}", part_poses=True)
    step(execute.run, dataclasses.replace(frames, engine=engine, store=store))
    cached = [f"--dataset.cache={config.cache}", f"--dataset.cache_store={store}"]
    training = Training(config.train, rows, [*cached, f"--policy.pose_loss={POSE_LOSS}", *config.train_options], out)
    lerobot(training.command())
    score = out / f"score_{training.folder.name}"
    if not score.exists():
        policy = PolicyChoice(path=training.policy)
        scenes = EvaluateConfig(policy=policy, task=[task], episodes=config.scored, seed=50000, out=score)
        step(evaluate.run, dataclasses.replace(scenes, episode_length=config.episode_length))
    print(f"\nscore: {score / 'report.html'}")
    return Learned(training.policy, rows, store)


if __name__ == "__main__":
    main(sys.argv[1:])

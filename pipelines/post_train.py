"""``python -m pipelines.post_train [--task=assembly_2] [--small]``: post-training of a policy, and whether it helped::

    pipelines.learn (or --policy, --dataset) ── taccorl post-train ── taccorl evaluate: start and result on the same new scenes

All of it is simulated, the anchor's demonstrations included: no robot is near. Everything lands in outputs/post_train; a stopped
run goes on where it was. It wants a GPU and 16 cores or more. ``--small`` shows the chain on a CPU in minutes and learns nothing.
The start is scored as its checkpoint says, the result with the denoising steps of post-training (K_denoise).
"""

import dataclasses
import json
import shlex
import shutil
import sys
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path

from pipelines import learn
from pipelines.steps import chosen, parsed, step
from taccorl.cli import evaluate
from taccorl.cli import post_train as cli
from taccorl.cli.evaluate import EvaluateConfig, PolicyChoice

SMALL = ("--config=configs/post_train/tiny.yaml", "--learn=[--small]", "--learn_out=outputs/learn_small")
SMALL += ("--out=outputs/post_train_small", "--scored=2", "--episode_length=12", "--cache=host")
FIRST_SCENE = 60000
"""Seed of the first scored scene: not those of pipelines.learn, by which a policy may have been chosen, nor those of training."""


@dataclass(kw_only=True)
class PostTrainPipelineConfig:
    """Policy and demonstrations → post-training → paired scores."""

    task: str = "assembly_2"
    """Task: {tasks}."""
    policy: Path | None = None
    """Folder pretrained_model of the start; that of pipelines.learn if not given, made first if it is missing."""
    dataset: Path | None = None
    """Demonstrations of the anchor; those of pipelines.learn if not given."""
    learn: list[str] = field(default_factory=list)
    """Further words for pipelines.learn, such as [--episodes=300]."""
    learn_out: Path = Path("outputs/learn")
    """Folder of pipelines.learn."""
    config: Path = Path("configs/post_train/small.yaml")
    """Settings of taccorl post-train."""
    options: list[str] = field(default_factory=list)
    """Further words for taccorl post-train, such as [--iterations=50,--seed=1]."""
    cache: str = "gpu"
    """Where frames of the anchor are held: gpu, host, disk."""
    scored: int = 512
    """Scenes of the scores."""
    episode_length: int | None = None
    """Control steps after which an episode is cut off; the task's own limit if not given."""
    out: Path = Path("outputs/post_train")


def main(words: list[str]) -> None:
    config = parsed(PostTrainPipelineConfig, chosen(words, SMALL), "python -m pipelines.post_train")
    if not config.config.is_file():
        raise SystemExit(f"--config={config.config}: no such file")
    if (config.policy is None) != (config.dataset is None):
        raise SystemExit(
            "give both --policy and --dataset, or none of them: a policy is held to the data of its training"
        )
    if config.policy is not None and config.dataset is not None:
        start, dataset, store = config.policy, config.dataset, config.learn_out / "store"
    else:
        (made, *_) = learn.main([*config.learn, f"--task={config.task}", f"--out={config.learn_out}"])
        start, dataset, store = made.policy, made.dataset, made.store
    limit = [f"--env.episode_length={config.episode_length}"] if config.episode_length else []
    settings = [
        f"--config_path={config.config}",
        f"--policy.path={start}",
        f"--env.task={config.task}",
        *limit,
        f"--anchor.dataset={dataset}",
        "--anchor.allow_simulated=true",
        f"--anchor.cache={config.cache}",
        f"--anchor.cache_store={store}",
        *config.options,
    ]
    key = sha256("\n".join([config.config.read_text(encoding="utf-8"), *settings]).encode()).hexdigest()[:8]
    out = config.out / config.task / f"run_{key}"
    if not (out / "checkpoints/last").exists():  # a run that ended before its first checkpoint begins anew
        shutil.rmtree(out, ignore_errors=True)
        train([*settings, f"--out={out}"])
    elif not is_finished(out):
        train([f"--out={out}", "--resume=true"])
    result, score = out / "checkpoints/last/pretrained_model", out / f"score_{config.scored}"
    if not (score / "evaluation.json").exists():
        shutil.rmtree(score, ignore_errors=True)
        scenes = EvaluateConfig(task=[config.task], episodes=config.scored, seed=FIRST_SCENE, out=score)
        policy = PolicyChoice(path=result)
        length = config.episode_length
        step(evaluate.run, dataclasses.replace(scenes, policy=policy, against=str(start), episode_length=length))
    comparison = json.loads((score / "evaluation.json").read_text(encoding="utf-8"))["comparisons"][config.task]
    print(f"\nafter against before, simulated, {config.scored} scenes: {json.dumps(comparison)}")
    print(f"score: {score / 'report.html'}, curve: {out / 'progress.jsonl'}, episodes: {out / 'rollouts'}")


def train(words: list[str]) -> None:
    """``taccorl post-train``: its file of settings and the user's further words decide, so that it takes words."""
    print(f"\n$ {shlex.join(['taccorl', 'post-train', *words])}", flush=True)
    if code := cli.main(words):
        raise SystemExit(f"taccorl post-train ended with {code}")


def is_finished(out: Path) -> bool:
    """Whether the last checkpoint is that of the last iteration."""
    iterations = json.loads((out / "settings.json").read_text(encoding="utf-8"))["iterations"]
    return int((out / "checkpoints/last").resolve().name) >= iterations


if __name__ == "__main__":
    main(sys.argv[1:])

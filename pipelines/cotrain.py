"""``python -m pipelines.cotrain [--small] [--task=assembly_2] [--cache=gpu]``: demonstrations of both domains → policy → scores::

    collect on a surrogate robot ── recordings (MCAP) ── ingest ──┐
    collect in the twin ──┬───────────────────────────────────────┼── merge ── lerobot-train ── lerobot-eval in both
                          └─ augment ─────────────────────────────┘

There is no robot here. A twin with hidden effects, other cameras and another gain stands in for it; whatever is made from it says
surrogate, and every score is of a simulation. Its demonstrations are recorded as the robot's drivers would and ingested, so that
the real side goes the way of a robot's recordings. With ``--cache=gpu|host|disk`` no video of the twin is encoded: its frames are
rendered into the cache of training, those of the recordings are decoded into it, and rows have the parts' poses, which only the
twin knows. Everything lands in outputs/cotrain; a stopped run goes on where it was.
The paper's numbers want a GPU and π0.5's weights. ``--small`` shows the chain on a CPU in minutes and learns nothing.
"""

import dataclasses
import json
import shutil
import sys
from dataclasses import dataclass, field
from pathlib import Path

import yaml

from pipelines.lerobot_commands import FIRST_SEED, Scoring, Training
from pipelines.steps import chosen, lerobot, parsed, step
from pipelines.surrogate_twin import named
from taccorl.cli import augment, collect, ingest, merge
from taccorl.cli.augment import AugmentConfig
from taccorl.cli.collect import CollectConfig
from taccorl.cli.ingest import IngestConfig
from taccorl.cli.merge import MergeConfig
from taccorl.errors import TaccorlError
from taccorl.evaluation.statistics import told_rate, wilson_interval

ORIGIN = "twin with hidden effects and other cameras, not a robot"
"""Origin that datasets of the simulated robot state."""
RECORDING_SPEC = "piper_flexitac_mcap"
SMALL = (
    "--real=1",
    "--sources=1",
    "--augmented=1",
    "--scored=2",
    "--episode_length=12",
)
SMALL += (
    "--train=configs/learn/tiny.yaml",
    "--train_options=[--steps=4,--batch_size=4]",
)


@dataclass(kw_only=True)
class CotrainConfig:
    """Demonstrations of both domains → policy → scores. Numbers are the paper's."""

    task: str = "assembly_2"
    """Task: {tasks}."""
    robot: Path = Path("configs/surrogates/other_cameras.yaml")
    """Twin file of the simulated robot whose demonstrations stand for those of a real one."""
    real: int = 50
    """N_real: episodes of the surrogate robot."""
    sources: int = 20
    """Episodes collected in the twin …"""
    augmented: int = 180
    """… and made of them: N_sim = 200. With a cache only these are trained on."""
    train: Path | None = None
    """Config of lerobot-train; configs/cotrain/TASK.yaml if not given."""
    train_options: list[str] = field(default_factory=list)
    """Further options of lerobot-train, such as [--steps=4000,--policy.pose_loss=0.1]."""
    cache: str = "none"
    """Where frames are held in training. none: videos are read; gpu, host, disk: frames at the config's resolution."""
    scored: int = 50
    """Episodes in the twin, and as many on the surrogate robot."""
    episode_length: int | None = None
    """Control steps after which a scored episode is cut off; the task's own limit if not given."""
    out: Path = Path("outputs/cotrain")


def record(recordings: Path, config: CollectConfig) -> None:
    """Demonstrations as MCAP files in the folder ``recordings``, once; what an interrupted run left unfinished is made anew."""
    if recordings.exists():
        return
    unfinished = recordings.with_name(f"{recordings.name}.unfinished")
    shutil.rmtree(unfinished, ignore_errors=True)
    step(collect.run, dataclasses.replace(config, out=unfinished))
    unfinished.rename(recordings)


def main(words: list[str]) -> None:
    config = parsed(CotrainConfig, chosen(words, SMALL), "python -m pipelines.cotrain")
    out, task, store = config.out / config.task, config.task, config.out / "store"
    recipe = config.train or Path(f"configs/cotrain/{task}.yaml")
    if not recipe.is_file():  # before hours of collecting
        raise SystemExit(
            f"--train={recipe}: no such file; for a task of your own, copy one of configs/cotrain"
        )
    try:
        name = f"surrogate_{named(config.robot)}"  # another content of the file is another robot
    except TaccorlError as error:
        raise SystemExit(f"--robot: {error}; configs/surrogates has some") from error
    parts = (f"{name}_recordings_{config.real}", name, f"{name}_and_twin")
    recordings, real, both = (out / part for part in parts)
    sources, many = out / "sources", out / "augmented"
    out.mkdir(parents=True, exist_ok=True)
    shown = CollectConfig(
        task=task,
        episodes=config.real,
        as_recording=True,
        seed=1,
        twin=config.robot,
        origin=ORIGIN,
        store=store,
    )
    record(recordings, shown)  # seed 1: the two domains do not share their scenes
    step(
        ingest.run,
        IngestConfig(paths=[recordings], spec=RECORDING_SPEC, out=real, store=store),
    )
    cached = config.cache != "none"
    step(
        collect.run,
        CollectConfig(
            task=task,
            episodes=config.sources,
            images=not cached,
            out=sources,
            store=store,
        ),
    )
    made = AugmentConfig(
        source=sources, task=task, episodes=config.augmented, out=many, store=store
    )
    if cached:
        size = yaml.safe_load(recipe.read_text(encoding="utf-8"))["policy"].get(
            "image_resolution"
        )
        frames = {
            "pictures": "cache",
            "resolution": f"{size[0]}x{size[1]}" if size else None,
        }
        step(
            augment.run,
            dataclasses.replace(made, part_poses=True, rows_per_picture=1, **frames),
        )
        step(
            merge.run,
            MergeConfig(real=[real], sim=[many], out=both, store=store, **frames),
        )
        cache = [f"--dataset.cache={config.cache}", f"--dataset.cache_store={store}"]
    else:
        step(augment.run, made)
        step(
            merge.run,
            MergeConfig(real=[real], sim=[sources, many], out=both, store=store),
        )
        cache = []
    training = Training(recipe, both, [*cache, *config.train_options], out)
    lerobot(training.command())
    limit = (
        [f"--env.episode_length={config.episode_length}"]
        if config.episode_length
        else []
    )
    scored = {"twin": [f"--env.task={task}", *limit]}
    scored["surrogate"] = [*scored["twin"], f"--env.twin={config.robot}"]
    rows = []
    for name, place in scored.items():
        scoring = Scoring(training, place, config.scored)
        lerobot(scoring.command())
        told = {
            "task": task,
            "where": f"{name} (simulated)",
            "policy": str(training.policy),
        }
        rows += [
            told | {"seed": FIRST_SEED + k, "success": s}
            for k, s in enumerate(scoring.successes())
        ]
    write(rows, config, training, out)


def write(
    rows: list[dict], config: CotrainConfig, training: Training, out: Path
) -> None:
    """outcomes.json: a row an episode, and what they come to; outcomes.md: a table."""
    found: dict[str, list[bool]] = {}
    for row in rows:
        found.setdefault(row["where"], []).append(row["success"])
    counts = {where: (sum(each), len(each)) for where, each in found.items()}
    scores = {
        where: {
            "successes": k,
            "attempts": n,
            "rate": k / n,
            "interval_95": wilson_interval(k, n),
        }
        for where, (k, n) in counts.items()
    }
    of_twin = config.augmented + (config.sources if config.cache == "none" else 0)
    data = f"{config.real} episodes of a surrogate ({ORIGIN}); {of_twin} of the twin"
    told = {"data": data, "steps": training.steps, "scores": scores}
    text = json.dumps(told | {"outcomes": rows}, indent=1, ensure_ascii=False)
    (out / "outcomes.json").write_text(text + "\n", encoding="utf-8")
    lines = [
        f"{config.task}, {training.steps} steps on {data}. Nothing here is of a robot.",
        "",
    ]
    lines += ["| scored in | successes, 95 % after Wilson |", "|---|---|"]
    lines += [f"| {where} | {told_rate(*count)} |" for where, count in counts.items()]
    (out / "outcomes.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    print("\n" + "\n".join(lines))


if __name__ == "__main__":
    main(sys.argv[1:])

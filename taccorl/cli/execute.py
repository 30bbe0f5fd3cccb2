"""``taccorl execute --source=outputs/many_actions --out=outputs/many [--pictures=video|cache|none] [--resolution=112x112]
[--part_poses=true]``

Turn stored actions (``taccorl augment --rows=actions``; one --source for each folder) into one LeRobot dataset, on the machine
where it is needed: every demonstration is executed once, in --engine.workers processes. Demonstrations that do not succeed here
are left out and counted.

--pictures=cache encodes no video: frames are rendered into the cache from which lerobot-train --dataset.cache=gpu|host|disk reads
them, at the policy's resolution. Only with that option can such a dataset be trained on.
"""

import shlex
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from taccorl.cli.card import add_card
from taccorl.cli.output_lock import check_apart
from taccorl.cli.parse import cached_resolution, parse, shared_fields
from taccorl.lineage.engines import Engine, LocalEngine

if TYPE_CHECKING:
    from taccorl.lineage.store import Store
    from taccorl.training.rendered_frames import DrawnFrames


@dataclass(kw_only=True)
class ExecuteConfig:
    """Make a dataset from stored actions."""

    source: list[Path]
    """Folder of stored actions, written by taccorl augment --rows=actions; repeat the option for several."""
    out: Path
    """The dataset's folder. It must be empty or not exist."""
    store: Path = Path("outputs/store")
    """Folder that keeps finished episodes and rendered frames; lerobot-train finds the frames by --dataset.cache_store."""
    pictures: str = "video"
    """What becomes of pictures. video; cache: frames that only lerobot-train --dataset.cache can read; none."""
    part_poses: bool = False
    """Write the poses of the task's parts into every row (observation.environment_state), for
    --policy.part_poses and --policy.pose_loss."""
    rows_per_picture: int = 1
    """With --pictures=cache: only every k-th row has a picture, and training draws these rows. 3 suffices for many episodes."""
    resolution: str | None = None
    """Rows x columns of frames in the cache, such as 112x112, equal to --policy.image_resolution; the cameras' own 224x224 if
    not given."""
    engine: Engine = field(default_factory=LocalEngine)
    """Where demonstrations are executed: --engine.type=local --engine.workers=16, slurm, ray."""


def main(argv: list[str]) -> int:
    """Run ``taccorl execute`` with the words ``argv`` after it; returns the exit status of ``run``."""
    return run(parse(ExecuteConfig, argv, positional=None))


def run(config: ExecuteConfig) -> int:
    """Execute the demonstrations, and write the dataset. Returns the exit status, 0: executed, 1: executed, but demonstrations
    were left out."""
    resolution = cached_resolution(config.resolution, config.pictures)
    from taccorl.cli.progress import Attempts
    from taccorl.demos.mimicgen.execute import ExecutePlan, execute_stored
    from taccorl.lineage.store import Store

    plan = ExecutePlan(sources=tuple(config.source), **shared_fields(config, ExecutePlan))
    check_apart(config.out, (*(("--source", source) for source in config.source), ("--store", config.store)))
    store = Store(config.store)
    began_s = time.monotonic()
    report, seconds = execute_stored(plan, config.out, store, config.engine, Attempts())
    print(f"dataset made in {time.monotonic() - began_s:.0f} s")
    if plan.pictures == "cache":
        seconds |= render_cache(config.out, resolution, store, config.engine)
    said = f"{report['domain']}: {report['origin']}"
    print(f"dataset: {config.out}  ({report['episodes']} episodes, {report['rows']} rows): {said}")
    differs = f"{report['differs']} of {report['demonstrations']} end in another state here than when they were made"
    print(f"differs: {differs}")
    if report["dropped"]:
        print(f"dropped: {', '.join(f'{num} {outcome}' for outcome, num in report['dropped'].items())}")
    if seconds:
        print(f"took:    {', '.join(f'{part} {s:.2f} s' for part, s in seconds.items())} for each episode")
    add_card(config.out)
    if plan.pictures == "cache":
        print(f"next:    {training_command(config.out, resolution, config.store)}")
    else:
        print(f"next:    taccorl view {shlex.quote(str(config.out))} --episode=0")
    return int(bool(report["dropped"]))


def render_cache(
    root: Path,
    resolution: tuple[int, int] | None,
    store: "Store",
    engine: Engine,
    drawn: "DrawnFrames | None" = None,
) -> dict[str, float]:
    """Render the frames of the dataset at ``root`` into the frame cache, and print where they are and the memory that training
    takes for them. Returns part of the work → mean time of an episode [s].
    """
    from taccorl.training.rendered_frames import render_frames

    began_s = time.monotonic()
    frames, seconds = render_frames(root, resolution, store, engine, drawn=drawn)
    size = sum(path.stat().st_size for path in frames.path.glob("*.npy"))
    print(f"frames:  {frames.path}, {size / 1e9:.1f} GB, made in {time.monotonic() - began_s:.0f} s")
    return seconds


def training_command(root: Path, resolution: tuple[int, int] | None, store: Path) -> str:
    """Command that trains the policy ``small`` on the dataset at ``root`` and its cached frames."""
    size = [] if resolution is None else [f"--policy.image_resolution=[{resolution[0]},{resolution[1]}]"]
    words = [
        "lerobot-train",
        "--policy.type=tactile_pi05",
        "--policy.backbone=small",
        "--policy.push_to_hub=false",
        *size,
    ]
    words += [f"--dataset.repo_id=local/{root.name}", f"--dataset.root={root}"]
    return shlex.join([*words, "--dataset.cache=gpu", f"--dataset.cache_store={store}"])

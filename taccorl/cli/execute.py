"""``taccorl execute --source=outputs/many_actions --out=outputs/many [--pictures=video|cache|none] [--resolution=112x112]
[--part_poses=true]``

Turn stored actions (``taccorl augment --rows=actions``; one --source for each folder) into one LeRobot dataset, on the machine
where it is needed: every demonstration is executed once, in --engine.workers processes. Demonstrations that do not succeed here
are left out and counted.

--pictures=cache encodes no video: frames are rendered into the cache from which lerobot-train --dataset.cache=gpu|host|disk reads
them, at the policy's resolution. Only with that option can such a dataset be trained on.
"""

from dataclasses import dataclass
from pathlib import Path

from taccorl.cli.parse import verb
from taccorl.cli.produced import KeptOptions, PictureOptions, Place, own_first, settings


@own_first
@dataclass(kw_only=True)
class ExecuteConfig(PictureOptions, KeptOptions):
    """Make a dataset from stored actions."""

    source: list[Path]
    """Folder of stored actions, written by taccorl augment --rows=actions; repeat the option for several."""
    out: Path
    """The dataset's folder. It must be empty or not exist."""
    pictures: str = "video"
    """What becomes of pictures. video; cache: frames that only lerobot-train --dataset.cache can read; none."""
    rows_per_picture: int | None = 1
    """With --pictures=cache: only every k-th row has a picture, and training draws these rows. 3 suffices for many episodes."""


@verb(ExecuteConfig)
def run(config: ExecuteConfig) -> int:
    """Execute the demonstrations, and write the dataset. Returns the exit status, 0: executed, 1: executed, but demonstrations
    were left out."""
    from taccorl.cli.progress import Attempts
    from taccorl.episodes.produce import produce
    from taccorl.episodes.sources.mimicgen.execute import ExecutePlan, stored_sources
    from taccorl.lineage.store import Store

    plan = ExecutePlan(**settings(config, ExecutePlan, sources=stored_sources(config.source, Store(config.store))))
    place = Place.of(config, plan, config.out, config.source)
    produced = produce(plan, place.out, place.store, Attempts(len(plan.items)), config.engine)
    report = produced.report
    differs = f"{report['differs']} of {report['demonstrations']} end in another state here than when they were made"
    place.written(plan, produced, [f"differs: {differs}"])
    print(f"next:    {place.next_command(plan)}")
    return int(bool(report["dropped"]))

"""``taccorl merge --real=outputs/recorded --sim=outputs/sources --sim=outputs/many --out=outputs/both``

Merge datasets of the robot and of the twin into one for co-training. Every row is marked with its domain
(``observation.is_sim``), by which ``lerobot-train --policy.type=tactile_pi05 --policy.sim_weight=0.5`` weights it. Statistics
are computed anew over all rows.

``--pictures=cache --resolution=112x112`` writes no videos: frames of all datasets are put into the cache from which
``lerobot-train --dataset.cache=gpu|host|disk`` reads them, also those of ``taccorl collect --pictures=cache``. Only with that
option can such a dataset be trained on.
"""

import os
from dataclasses import dataclass, field
from pathlib import Path

from taccorl.cli.card import add_card
from taccorl.cli.output_lock import check_apart
from taccorl.cli.parse import cached_resolution, verb
from taccorl.errors import DatasetError, InTheWayError, TaccorlError, nearest
from taccorl.sim.part_poses import PARTS_KEY


@dataclass(kw_only=True)
class MergeConfig:
    """Merge datasets of the robot and of the twin into one."""

    out: Path
    """The dataset's folder. It must be empty or not exist."""
    replace: bool = False
    """If `out` holds something else, move that aside (out.old-1, …) and publish the new dataset."""
    real: list[Path] = field(default_factory=list)
    """Dataset of the robot, or of a surrogate in its place; repeat the option for several."""
    sim: list[Path] = field(default_factory=list)
    """Dataset of the twin, collected or augmented; repeat the option for several."""
    store: Path = Path("outputs/store")
    """Folder that keeps finished work, its lineage and frames; lerobot-train finds the frames by --dataset.cache_store."""
    pictures: str = "video"
    """What becomes of pictures. video; cache: frames that only lerobot-train --dataset.cache can read."""
    resolution: str | None = None
    """Rows x columns of frames in the cache, such as 112x112, equal to --policy.image_resolution; the cameras' own size if not
    given."""


@verb(MergeConfig)
def run(config: MergeConfig) -> int:
    """Merge the datasets. Returns the exit status 0."""
    os.environ.setdefault(
        "TQDM_DISABLE", "1"
    )  # read when tqdm is imported, which PyTorch does: LeRobot's bars
    from taccorl.cli.progress import Bars
    from taccorl.data.dataset import Dataset
    from taccorl.data.ingest import moved_aside
    from taccorl.lineage.store import Store
    from taccorl.training.cotrain import Part, check_domains, publish

    if config.pictures not in ("video", "cache"):
        raise TaccorlError(
            f"--pictures={config.pictures}: {nearest(config.pictures, ('video', 'cache'))}"
        )
    resolution = cached_resolution(config.resolution, config.pictures)
    _check_places(config)
    store = Store(config.store)
    cached = config.pictures == "cache"
    if cached:
        from taccorl.training.frame_cache import join_frames, require_joinable

        check_domains(config.real, config.sim)
        require_joinable([*config.real, *config.sim], resolution, store)
    with Bars(1, "comparing digests") as bars:

        def made() -> list[Part]:
            return publish(
                config.real,
                config.sim,
                config.out,
                store,
                bars.update,
                videos=not cached,
            )

        try:
            parts = made()
        except InTheWayError as error:
            if not config.replace:
                raise InTheWayError(
                    f"{error} --replace=true moves it aside."
                ) from error
            with moved_aside(config.out) as aside:
                parts = made()
            print(f"what was at {config.out} is now at {aside}")

    def told(of: list[Part]) -> str:
        origins = sorted({str(origin) for part in of for origin in part.origins})
        said = f" ({'; '.join(origins)})" if origins else ""
        return f"{sum(p.episodes for p in of)} episodes, {sum(p.rows for p in of)} rows{said}"

    domains = {
        "real": [p for p in parts if not p.is_sim],
        "simulated": [p for p in parts if p.is_sim],
    }
    print(f"dataset:   {config.out}")
    if lack := _without_poses(config):
        lacking = ", ".join(map(str, lack))
        print(
            f"left out:  the parts' poses ({PARTS_KEY}), which {lacking} lacks: --part_poses=true there"
        )
    for name, of in domains.items():
        print(f"{name + ':':11s}{told(of)}")
    add_card(config.out)
    size, frames = "", ""
    if cached:
        folder = join_frames(config.out, [*config.real, *config.sim], resolution, store)
        print(f"frames:    {folder}")
        frames = f" --dataset.cache=gpu --dataset.cache_store={config.store}"
        size = (
            ""
            if resolution is None
            else f" --policy.image_resolution=[{resolution[0]},{resolution[1]}]"
        )
    alone = (
        ""
        if all(domains.values())
        else f" --policy.sim_weight={1 if domains['simulated'] else 0}"
    )
    policy = (
        f"tactile_pi05 --policy.backbone={'small' if cached else 'tiny'}{alone}{size}"
    )
    if not any(
        key.startswith("observation.tactile")
        for key in Dataset(config.out).spec.features
    ):
        policy = "act"  # one with touch would refuse it
    print(
        f"next:      lerobot-train --policy.type={policy} --policy.push_to_hub=false "
        f"--dataset.repo_id=local/{config.out.name} --dataset.root={config.out}{frames}"
    )
    return 0


def _without_poses(config: MergeConfig) -> list[Path]:
    """Datasets of the twin without the poses of parts that another one of the twin has."""
    from taccorl.data.dataset import Dataset

    has = {root: PARTS_KEY in Dataset(root).info["features"] for root in config.sim}
    return [root for root, there in has.items() if not there and any(has.values())]


def _check_places(config: MergeConfig) -> None:
    given = [
        *(("--real", place) for place in config.real),
        *(("--sim", place) for place in config.sim),
    ]
    check_apart(config.out, given)
    places = [place.resolve() for _, place in given]
    if twice := [str(place) for place in places if places.count(place) > 1]:
        raise DatasetError(f"{twice[0]} is given twice: give each dataset once")

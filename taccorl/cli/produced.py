"""What the verbs that produce episodes (collect, augment, correct) have in common: options, places, and the end."""

import shlex
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from taccorl.cli.card import add_card
from taccorl.cli.output_lock import check_apart, hold
from taccorl.cli.parse import cached_resolution, shared_fields
from taccorl.data.origin import TWIN_ORIGIN, Origin
from taccorl.lineage.destinations import is_free
from taccorl.lineage.engines import Engine, LocalEngine

if TYPE_CHECKING:
    from taccorl.episodes.plan import Plan
    from taccorl.episodes.produce import Produced
    from taccorl.lineage.store import Store
    from taccorl.training.rendered_frames import DrawnFrames


@dataclass(kw_only=True)
class KeptOptions:
    """Where work is done, and kept."""

    store: Path = Path("outputs/store")
    """Folder of intermediate results. Finished attempts are kept there, so that a stopped run continues; with --pictures=cache
    also the frames, which lerobot-train reads with --dataset.cache_store."""
    engine: Engine = field(default_factory=LocalEngine)
    """Where attempts run: --engine.type=local --engine.workers=16, or ray."""


@dataclass(kw_only=True)
class SceneOptions(KeptOptions):
    """Scenes in the twin."""

    difficulty: str = "train"
    """Clearance on each side of mating parts: easy 1.0 mm, train 0.5 mm, hard 0.3 mm."""
    twin: Path | None = None
    """A twin.yaml; the nominal twin if not given."""
    images: bool = True
    """Render the dataset's three cameras (needs OpenGL)."""
    seed: int = 0
    """Seed of all attempts, at least 0; another seed gives other scenes."""


@dataclass(kw_only=True)
class RandomizedOptions(SceneOptions):
    """Scenes whose spread can be chosen."""

    randomization: float = 1.0
    """Factor on the ranges from which a reset of the task draws, from 0 (always the nominal scene) to 1 (the full ranges)."""


@dataclass(kw_only=True)
class PictureOptions:
    """How rows are stored."""

    pictures: str = "video"
    """What becomes of pictures. video; cache: frames that only lerobot-train --dataset.cache can read."""
    rows_per_picture: int | None = None
    """With --pictures=cache: only every k-th row has a picture, and training draws these rows; 3 if not given. Datasets that are
    merged need the same."""
    resolution: str | None = None
    """Rows x columns of frames in the cache, such as 112x112, equal to --policy.image_resolution; the cameras' own 224x224 if
    not given."""
    part_poses: bool = False
    """Write the poses of the task's parts into every row (observation.environment_state), for
    --policy.part_poses and --policy.pose_loss."""


@dataclass(kw_only=True)
class OriginOptions:
    """What outputs say of their origin."""

    domain: Literal["twin", "surrogate"] = "twin"
    """Domain of all outputs; ``surrogate``: the twin stands in for the robot, as recordings always do."""
    origin: str = TWIN_ORIGIN.text
    """Description of the origin in all outputs."""


def own_first[ConfigT](config_class: type[ConfigT]) -> type[ConfigT]:
    """Decorator of a configuration: help and commands name its own options before those that it shares with other verbs."""
    every = vars(config_class)["__dataclass_fields__"]
    names = [
        name
        for one in config_class.__mro__
        for name in vars(one).get("__annotations__", ())
        if name in every
    ]
    config_class.__dataclass_fields__ = {name: every[name] for name in names}  # pyright: ignore[reportAttributeAccessIssue]
    return config_class


def settings(config: Any, kind: type, **own: Any) -> dict[str, Any]:
    """Fields with which the plan ``kind`` is made: those of ``config`` with the same name, and ``own``."""
    values = shared_fields(config, kind)
    if isinstance(config, PictureOptions) and config.rows_per_picture is None:
        values["rows_per_picture"] = 3 if config.pictures == "cache" else 1
    if isinstance(config, OriginOptions):
        values["origin"] = Origin(config.domain, config.origin)
    return values | own


@dataclass
class Place:
    """Where the dataset goes."""

    out: Path
    store: "Store"
    engine: Engine
    resolution: tuple[int, int] | None
    """Rows and columns of cached frames; None: the cameras' own."""
    was_there: bool
    """Whether something is at ``out`` before the run; ``produce`` then accepts only the result of this plan."""

    @classmethod
    def of(
        cls, config: Any, plan: "Plan", out: Path, sources: Sequence[Path] = ()
    ) -> "Place":
        """Lock the place ``out`` until the command ends. Raises TaccorlError: ``out`` and the store or one of ``sources``
        contain one another, or --resolution has no effect."""
        from taccorl.lineage.store import Store

        resolution = cached_resolution(
            getattr(config, "resolution", None), plan.stored_as
        )
        hold(out)
        check_apart(
            out,
            [*(("--source", source) for source in sources), ("--store", config.store)],
        )
        return cls(
            out, Store(config.store), config.engine, resolution, not is_free(out)
        )

    def written(
        self,
        plan: "Plan",
        produced: "Produced",
        lines: Sequence[str] = (),
        drawn: "DrawnFrames | None" = None,
    ) -> None:
        """Say what was made, render the frames of a dataset with cached pictures, and write its card. ``lines``: what the verb
        says of its own. ``drawn``: frames that were drawn while attempts ran."""
        from taccorl.report.section import Section
        from taccorl.report.terminal import show

        report, seconds = produced.report, produced.seconds
        if plan.cached_rows is not None:
            seconds |= self._render(drawn)
        made = f"({report['episodes']} episodes, {report['rows']} rows): {report['domain']}: {report['origin']}"
        counts = report.get("outcomes", {}) | report.get("dropped", {})
        failed = ", ".join(
            f"{num} {outcome}"
            for outcome, num in counts.items()
            if outcome != "success"
        )
        took = ", ".join(f"{part} {s:.2f} s" for part, s in seconds.items()) * (
            not self.was_there
        )
        own = [f"failed:  {failed}"] * bool(failed) + [
            f"took:    {took} for each episode"
        ] * bool(took)
        is_dataset = (self.out / "meta" / "info.json").is_file()
        kind = (
            "dataset" if is_dataset else "actions"
        ) + ", made before" * self.was_there
        show(Section(text=[f"{kind}: {self.out}  {made}", *lines, *own]))
        if is_dataset:
            add_card(self.out)

    def _render(self, drawn: "DrawnFrames | None") -> dict[str, float]:
        """Part of the work → mean time of an episode [s]."""
        from taccorl.training.rendered_frames import render_frames

        began_s = time.monotonic()
        frames, seconds = render_frames(
            self.out, self.resolution, self.store, self.engine, drawn=drawn
        )
        size = sum(path.stat().st_size for path in frames.path.glob("*.npy"))
        print(
            f"frames:  {frames.path}, {size / 1e9:.1f} GB, made in {time.monotonic() - began_s:.0f} s"
        )
        return seconds

    def next_command(self, plan: "Plan") -> str:
        """Command that trains the policy ``small`` on the dataset and its cached frames, or shows an episode of one with
        videos."""
        if plan.cached_rows is None:
            return shlex.join(["taccorl", "view", str(self.out), "--episode=0"])
        words = [
            "lerobot-train",
            "--policy.type=tactile_pi05",
            "--policy.backbone=small",
            "--policy.push_to_hub=false",
        ]
        if self.resolution is not None:
            words.append("--policy.image_resolution=[{},{}]".format(*self.resolution))
        words += [
            f"--dataset.repo_id=local/{self.out.name}",
            f"--dataset.root={self.out}",
        ]
        return shlex.join(
            [*words, "--dataset.cache=gpu", f"--dataset.cache_store={self.store.root}"]
        )

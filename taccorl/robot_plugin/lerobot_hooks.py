"""Arrays of touch in LeRobot's record and rollout, whose version 0.6.1 knows joints and pictures only; corrects its chunks.

``install`` replaces seven functions by ones that pass touch on and leave everything else to LeRobot's own:
``hw_to_dataset_features`` and ``build_dataset_frame`` (an array is neither joint nor picture), ``create`` and ``finalize`` of
``LeRobotDataset`` (units, frames, origin and baselines as ingest states them, so that datasets merge), the loader of rollout's
policies (to know their window of touch, and whether they fit the robot), and the loops over the rows of an episode in
lerobot-record and rollout's episodic strategy (a surrogate resets its scene before). It also mends real-time chunking, which
miscounts actions and competes with the loop for cores, and the loop's sleep, whose overshoot is never regained. With
``TACCORL_NO_PATCH=1``, or another version of LeRobot, nothing is replaced.
"""

import atexit
import contextlib
import dataclasses
import functools
import json
import logging
import os
import shutil
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from lerobot import __version__ as lerobot_version
from lerobot.configs import FeatureType, RGBEncoderConfig

from taccorl.data.dataset import (
    BOOKKEEPING,
    DOMAINS,
    PROVENANCE,
    Dataset,
    dataset_spec_to_json,
    write_records,
)
from taccorl.data.lerobot_format import (
    ENCODERS,
    LARGE_FEATURE,
    lerobot_features,
    write_exact_statistics,
)
from taccorl.data.origin import Origin
from taccorl.data.spec import find_spec, load_dataset_spec
from taccorl.errors import TaccorlError, printable
from taccorl.lineage.manifest import DATASET_MANIFEST, read_manifest, seal_checkpoint
from taccorl.robots import ROBOT

if TYPE_CHECKING:
    from taccorl.robot_plugin.pads import Pads

SPEC = "taccorl_bimanual"
TACTILE = "observation.tactile"
COMPARED_VERSION = "0.6.1"
_FULL_BYTES = 1 << 20  # free on a disk: too few for the next pictures
RECORDED = "recorded"
"""Stage of the manifest of a dataset that LeRobot has recorded with touch."""
_DATASETS = (
    "lerobot.scripts.lerobot_record",
    "__main__",
    *(
        f"lerobot.rollout.strategies.{name}"
        for name in ("episodic", "sentry", "highlight", "dagger")
    ),
)
_POLICIES = (
    "lerobot.rollout.strategies.core",
    "lerobot.rollout.strategies.base",
    "lerobot.rollout.inference.rtc",
)
_NICENESS = 5  # of the thread that predicts chunks: a third of the loop's weight where both want the same core
_MOST_LATE_S = 0.02  # of a sleep, that the next one regains
_touch: Any = (
    None  # feature of the robot that LeRobot has made, before it makes a dataset
)
_policy: Any = None  # configuration of the policy that rollout has loaded, before it makes the robot


@dataclass(frozen=True)
class TouchReading:
    """Touch in an observation: no array, which LeRobot's live view would plot as 1536 curves."""

    newest: np.ndarray
    """(K,) int16 counts above baseline: a row of a dataset."""
    window: np.ndarray
    """(L, K) int16, oldest first: what a policy gets, at the policy's rate whatever the loop does."""
    picture: Callable[[], np.ndarray]
    """Function that draws the pads, (rows, columns, 3) uint8 RGB."""


class TouchFeature(tuple):
    """A robot's feature of touch, (K,); a tuple, as LeRobot's context keeps no other kinds."""

    described: dict[str, Any]
    """The dataset's feature, as in ``meta/info.json``."""
    pads: "Pads"
    origin: Origin

    def __deepcopy__(self, _: Any) -> "TouchFeature":
        return self  # LeRobot copies features; the pads stay the robot's

    @classmethod
    def of(cls, pads: "Pads", origin: Origin) -> "TouchFeature":
        """Feature of these pads; of the data spec, if they are its pads."""
        found = cls((pads.num_taxels,))
        found.pads, found.origin = pads, origin
        found.described = dict(
            lerobot_features(load_dataset_spec(find_spec(SPEC)), [TACTILE])[TACTILE]
        )
        if pads.names != ROBOT.pads:
            touch = found.described["tactile"] | {
                "layout": [1, *pads.layout],
                "pads": list(pads.names),
            }
            found.described |= {"shape": (pads.num_taxels,), "tactile": touch}
        if origin.domain is not None:
            found.described[DOMAINS] = [origin.domain]
        return found


def window() -> tuple[int, int]:
    """Window of touch of the policy that rollout has loaded: number of readings, and of its steps from one to the next."""
    is_felt = getattr(_policy, "tactile", False)
    return (_policy.tactile_history, _policy.tactile_stride) if is_felt else (1, 1)


def check_policy(
    features: dict[str, Any], names: Sequence[str], pads: "Pads | None", fps: float
) -> None:
    """Check the policy that rollout has loaded, if there is one, against the robot: its ``features`` of observations, the
    ``names`` of its actions, its pads and its rate [Hz]. Raises TaccorlError: they are others."""
    if (policy := _policy) is None:
        return
    for key, feature in (policy.input_features or {}).items():
        camera = key.removeprefix("observation.images.")
        if feature.type is not FeatureType.VISUAL:
            continue
        there = features.get(camera)
        if there is None:
            others = (
                ", ".join(
                    k
                    for k, v in features.items()
                    if isinstance(v, tuple) and len(v) == 3
                )
                or "none"
            )
            raise TaccorlError(
                f"the policy was trained with the camera {camera}, the robot has {others}"
            )
        if tuple(feature.shape) not in ((there[2], *there[:2]), there):
            raise TaccorlError(
                f"camera {camera}: the policy takes {tuple(feature.shape)}, the robot gives {there}"
            )
    theirs = list(getattr(policy, "action_feature_names", None) or names)
    if set(theirs) != set(names):
        other = sorted(set(theirs) ^ set(names))
        raise TaccorlError(
            f"the policy's actions differ from the robot's: {', '.join(other[:4])}; use its own robot"
        )
    if theirs != list(names):
        raise TaccorlError(
            f"the policy's actions are in another order than the robot's: {', '.join(theirs[:3])} …"
        )
    rate = getattr(policy, "fps", None)
    if rate is not None and rate != fps:
        raise TaccorlError(
            f"the policy was trained at {rate:g} Hz, --robot.fps={fps:g}: give its rate to both"
        )
    touch = getattr(policy, "tactile_format", None)
    if getattr(policy, "tactile", False) and pads is None:
        raise TaccorlError(
            "the policy was trained with touch, but the robot has no pads: give --robot.pads"
        )
    if (
        touch is not None
        and pads is not None
        and (list(touch.layout), touch.pads) != (pads.layout, pads.names)
    ):
        own = f"{', '.join(pads.names)} of {pads.layout[1:]}"
        raise TaccorlError(
            f"the policy takes the pads {', '.join(touch.pads)} of {list(touch.layout[1:])}, not {own}"
        )


def check_units() -> None:
    """Check that the policy that rollout has loaded acts in rad and m, as far as the statistics of its folder show it. Raises
    TaccorlError: its training data lie far beyond the PiPER's limits, as angles in degrees do."""
    from taccorl.evaluation.policy_actor import open_checkpoint
    from taccorl.evaluation.preflight import preflight, refuse_differences
    from taccorl.sim.twin import TwinConfig

    path = Path(getattr(_policy, "pretrained_path", None) or os.devnull)
    checks = (
        preflight(open_checkpoint(path, "cpu").facts(), TwinConfig())
        if path.is_dir()
        else ()
    )
    refuse_differences(
        [check for check in checks if check.what.startswith("range of")], str(path)
    )


def install() -> bool:
    """Replace the functions in what LeRobot has loaded so far; each call adds what was loaded since. Returns False if LeRobot
    was not changed."""
    if os.environ.get("TACCORL_NO_PATCH") == "1" or lerobot_version != COMPARED_VERSION:
        return False
    for module in ("lerobot.datasets.pipeline_features", "lerobot.rollout.context"):
        _replace(sys.modules.get(module), "hw_to_dataset_features", _with_touch)
    _replace(sys, "excepthook", _in_a_sentence)
    _replace(
        sys.modules.get("lerobot.rollout.context"),
        "_load_pretrained_policy",
        _remembered,
    )
    _replace(
        sys.modules.get("lerobot.rollout.context"), "create_inference_engine", _paced
    )
    rtc = sys.modules.get("lerobot.rollout.inference.rtc")
    queue, tracker = (
        getattr(rtc, "ActionQueue", None),
        getattr(rtc, "LatencyTracker", None),
    )
    _replace(queue, "get_left_over", _from_now("original_queue"))
    _replace(queue, "get_processed_left_over", _from_now("queue"))
    _replace(
        queue, "get_action_index", lambda _: lambda self: max(0, self.last_index - 1)
    )
    # 0.6.1 drops of a chunk what its latency lasts, up to 2 more than was executed meanwhile; guides what is beyond the last
    # chunk's end towards 0; and never forgets the latency of the first chunk, which loads kernels (its pull request 4454).
    _replace(
        queue,
        "_check_and_resolve_delays",
        lambda _: lambda self, _, before: self.last_index - before,
    )
    _replace(queue, "_replace_actions_queue", _kept_from_now)
    # A chunk is begun so early that none is executed beyond its first ``n_action_steps``, if it takes as long as the last.
    _replace(
        queue,
        "qsize",
        lambda theirs: (
            lambda self: theirs(self) - max(0, getattr(self, "executed", 0) - 1)
        ),
    )
    _replace(
        rtc,
        "_normalize_prev_actions_length",
        lambda _: lambda actions, target_steps: actions[:target_steps],
    )
    _replace(
        tracker,
        "max",
        lambda _: (
            lambda self: max([*self._values][1:][-20:] or self._values, default=0.0)
        ),
    )
    _replace(getattr(rtc, "RTCInferenceEngine", None), "_rtc_loop", _at_lower_priority)
    for names, field in ((_DATASETS, "newest"), (_POLICIES, "window")):
        for module in names:
            _replace(sys.modules.get(module), "log_visualization_data", _with_pads)
            _replace(sys.modules.get(module), "precise_sleep", _regained)
            _replace(
                sys.modules.get(module),
                "build_dataset_frame",
                functools.partial(_framed, field=field),
            )
            _replace(sys.modules.get(module), "record_loop", _in_order)
    episodic = getattr(
        sys.modules.get("lerobot.rollout.strategies.episodic"), "EpisodicStrategy", None
    )
    _replace(episodic, "_policy_loop", _in_order)
    dataset = getattr(
        sys.modules.get("lerobot.datasets.lerobot_dataset"), "LeRobotDataset", None
    )
    if dataset is not None and not hasattr(dataset.create.__func__, "theirs"):
        dataset.create = classmethod(_marked(dataset.create.__func__, _with_units))
    _replace(dataset, "finalize", _with_provenance)
    return True


def _replace(owner: Any, name: str, wrap: Callable[[Callable], Callable]) -> None:
    theirs = getattr(owner, name, None)
    if theirs is not None and not hasattr(theirs, "theirs"):
        setattr(owner, name, _marked(theirs, wrap))


def _marked(theirs: Any, wrap: Callable[[Callable], Callable]) -> Any:
    ours: Any = wrap(theirs)
    ours.theirs = theirs
    return ours


def _in_a_sentence(theirs: Callable) -> Callable:
    def show(kind: type[BaseException], error: BaseException, trace: Any) -> None:
        """Print an error of ours as ``taccorl`` does, without LeRobot's traceback."""
        if isinstance(error, TaccorlError):
            print(f"{Path(sys.argv[0]).name}: {printable(error)}", file=sys.stderr)
        else:
            theirs(kind, error, trace)

    return show


def _remembered(theirs: Callable) -> Callable:
    def load(policy_config: Any) -> Any:
        global _policy
        policy, _policy = theirs(policy_config), policy_config
        if policy_config.device == "cpu":
            torch.set_num_threads(
                1
            )  # more would take the CPUs of the loop, and wait for each other on a busy machine
        return policy.requires_grad_(
            False
        )  # guidance differentiates by the actions only

    return load


def _paced(theirs: Callable) -> Callable:
    """Have the next chunk when ``n_action_steps`` of the last are executed. LeRobot's default (30 left) begins it
    at once if chunks have 30 actions or fewer: guided actions then guide the next, and observations have little effect."""

    def create(config: Any, *, policy: Any, **more: Any) -> Any:
        chunk, taken = (
            getattr(policy.config, name, None)
            for name in ("chunk_size", "n_action_steps")
        )
        if chunk and taken and hasattr(config, "queue_threshold"):
            config.queue_threshold = min(
                config.queue_threshold, chunk - taken if taken < chunk else chunk // 2
            )
        engine, robot = (
            theirs(config, policy=policy, **more),
            getattr(more["robot_wrapper"], "inner", None),
        )
        if robot is not None and hasattr(robot, "guard"):
            robot.instruct(more["task"])
            engine.get_action = _none_past_a_hold(
                engine, lambda: robot.guard
            )  # each connection has its own
        return engine

    return create


def _none_past_a_hold(engine: Any, guard: Callable[[], Any]) -> Callable:
    """``engine.get_action``, but while the arms hold because an observation is old, no action is taken from the queue: the newest
    is repeated, which the guard does not pass on. Afterwards the next action follows, not one that lies ahead by the hold."""
    theirs, newest = engine.get_action, None

    def get_action(frame: dict | None) -> torch.Tensor | None:
        nonlocal newest
        if newest is not None and guard().holding and guard().is_late:
            return newest
        newest = newest if (found := theirs(frame)) is None else found
        return found

    return get_action


def _from_now(name: str) -> Callable[[Any], Callable]:
    """What is left of a queue, from the action of the newest observation's period on (executed already), as in the next chunk."""
    return lambda _: (
        lambda self: (
            q
            if (q := getattr(self, name)) is None
            else q[max(0, self.last_index - 1) :].clone()
        )
    )


def _kept_from_now(theirs: Callable) -> Callable:
    def replace(
        self: Any, original: torch.Tensor, processed: torch.Tensor, executed: int
    ) -> None:
        """Keep the action of the newest observation's period (executed, but of the last chunk): the next may begin with it."""
        theirs(self, original, processed, max(0, executed - 1))
        self.executed, self.last_index = executed, min(executed, 1)

    return replace


def _at_lower_priority(theirs: Callable) -> Callable:
    def predict(self: Any) -> None:
        if sys.platform == "linux":  # where a thread has a niceness of its own
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICENESS)
        theirs(self)

    return predict


def _regained(theirs: Callable) -> Callable:
    """Shorten a sleep by how much the last one was too long: LeRobot's periods begin at its end, and would all be longer."""
    late_s = 0.0

    def sleep(seconds: float) -> None:
        nonlocal late_s
        end_s = time.perf_counter() + seconds - late_s
        theirs(max(seconds - late_s, 0.0))
        late_s = min(max(time.perf_counter() - end_s, 0.0), _MOST_LATE_S)

    return sleep


def _with_pads(theirs: Callable) -> Callable:
    def show(mode: str, observation: Any = None, **more: Any) -> None:
        touch = [
            value.picture()
            for value in (observation or {}).values()
            if isinstance(value, TouchReading)
        ]
        theirs(
            mode,
            observation=observation | {"touch": touch[0]} if touch else observation,
            **more,
        )

    return show


def _in_order(theirs: Callable) -> Callable:
    def loop(*strategy: Any, robot: Any, dataset: Any = None, **more: Any) -> None:
        begin = getattr(getattr(robot, "inner", robot), "begin_episode", None)
        if (
            begin is not None and dataset is not None
        ):  # without a dataset it is the time between episodes
            getattr(robot, "inner", robot).instruct(more.get("single_task") or "")
            for one in strategy:
                one._engine.stop()  # real-time chunking would begin with a chunk of the last episode's end
            begin()
            for one in strategy:
                one._engine.reset()
                one._engine.start()
                one._engine.resume()
        theirs(*strategy, robot=robot, dataset=dataset, **more)

    return loop


def _with_units(theirs: Callable) -> Callable:
    def create(
        cls: Any, repo_id: str, fps: int, features: dict, *args: Any, **kwargs: Any
    ) -> Any:
        is_ours = (
            "tactile" in features.get(TACTILE, {}) and "names" not in features[TACTILE]
        )
        if not is_ours:
            return theirs(cls, repo_id, fps, features, *args, **kwargs)
        if kwargs.get("rgb_encoder") == RGBEncoderConfig():
            # Videos of several codecs do not merge; LeRobot's default also costs three times as much.
            kwargs["rgb_encoder"] = RGBEncoderConfig(
                **ENCODERS[load_dataset_spec(find_spec(SPEC)).video_codec]
            )
        made = theirs(cls, repo_id, fps, _stated(features), *args, **kwargs)
        made.is_recorded = True
        atexit.register(
            remove_empty, made.root, made.root.stat().st_ino
        )  # not even finalized if nothing connects
        return made

    return create


def remove_empty(root: Path, inode: int) -> None:
    """Remove the folder of a dataset that was made here and has no episode, which LeRobot would refuse in the next try. A folder
    that took its place, one with an episode on disk, and files that are not LeRobot's stay."""
    with contextlib.suppress(OSError, ValueError, KeyError):
        is_empty = (
            json.loads((root / "meta" / "info.json").read_bytes())["total_episodes"]
            == 0
        )
        if (
            is_empty
            and root.stat().st_ino == inode
            and not [*root.rglob("*.parquet"), *root.rglob("*.mp4")]
        ):
            for name in ("data", "images", "meta", "videos"):
                shutil.rmtree(root / name, ignore_errors=True)
            root.rmdir()


def _with_provenance(theirs: Callable) -> Callable:
    def finalize(self: Any) -> None:
        is_done = self._is_finalized or self.writer is None
        is_ours = (
            hasattr(self, "is_recorded")
            or read_manifest(self.root).get("stage") == RECORDED
        )  # --resume
        with contextlib.suppress(OSError):
            if (
                is_ours
                and not is_done
                and shutil.disk_usage(self.root).free < _FULL_BYTES
            ):
                again = (
                    "with --resume=true"
                    if self.meta.total_episodes
                    else "by the same command"
                )
                logging.error(
                    f"{self.root}: its disk is full, an episode is lost; make room and record again, {again}"
                )
        theirs(self)
        if is_done or self.writer is None or not is_ours:
            return
        self.writer.cleanup_interrupted_episode(self.meta.total_episodes)
        if self.meta.total_episodes and _touch is not None:
            state_provenance(self.root, _touch)

    return finalize


def state_provenance(root: Path, touch: TouchFeature) -> None:
    """Add to a recorded dataset what LeRobot's files cannot state (units, ranges, origin, baselines), as ``taccorl ingest`` does,
    and exact statistics: those of 0.6.1 are wrong for what hardly moves. Nothing is added to a dataset of other joints."""
    path = root / PROVENANCE / "episodes.json"
    records = (
        json.loads(path.read_text(encoding="utf-8")) if path.is_file() else []
    )  # of earlier sessions: --resume
    (root / DATASET_MANIFEST).unlink(missing_ok=True)
    spec, dataset = load_dataset_spec(find_spec(SPEC)), Dataset(root)
    own = [key for key in dataset.info["features"] if key not in BOOKKEEPING]
    stated = lerobot_features(spec, [key for key in own if key in spec.features])
    write_exact_statistics(root, smaller_than=LARGE_FEATURE)
    if set(own) - set(stated) or any(
        dataset.info["features"][k]["names"] != f["names"] for k, f in stated.items()
    ):
        return
    assert touch.pads.baseline is not None, (
        "episodes come from a robot that was connected"
    )
    known = {
        "part": None,
        "source_digest": "",
        "start_ns": 0,
        "success": None,
        "timing": [],
        "stages": [],
    }
    known |= {
        "simulation": None,
        "baselines": {TACTILE: touch.pads.baseline.tolist()},
    } | touch.origin.record()
    for k in range(len(records), dataset.num_episodes):
        what = {
            "recording": f"lerobot episode {k}",
            "rows": dataset.num_rows(k),
            "instruction": dataset.tasks(k)[0][1],
        }
        records.append(what | known)
    write_records(root, records)
    text = json.dumps(
        dataset_spec_to_json(
            dataclasses.replace(spec, features={k: spec.features[k] for k in own})
        )
    )
    (root / PROVENANCE / "dataset_spec.json").write_text(text, encoding="utf-8")
    seal_checkpoint(root, stage=RECORDED, place=DATASET_MANIFEST)


def _with_touch(theirs: Callable) -> Callable:
    def to_features(
        hw_features: dict[str, Any], prefix: str, use_video: bool = True
    ) -> dict[str, dict]:
        global _touch
        touch = {
            key: value
            for key, value in hw_features.items()
            if isinstance(value, TouchFeature)
        }
        _touch = next(iter(touch.values()), _touch)
        features = theirs(
            {k: v for k, v in hw_features.items() if k not in touch}, prefix, use_video
        )
        # Without names: LeRobot would merge those of vectors.
        own = {
            key: {k: v for k, v in f.described.items() if k != "names"}
            for key, f in touch.items()
        }
        return features | {f"{prefix}.{key}": feature for key, feature in own.items()}

    return to_features


def _framed(theirs: Callable, field: str) -> Callable:
    def frame(
        ds_features: dict[str, dict], values: dict[str, Any], prefix: str
    ) -> dict[str, np.ndarray]:
        found = theirs(ds_features, values, prefix)
        for key, value in values.items():
            if isinstance(value, TouchReading) and f"{prefix}.{key}" in ds_features:
                found[f"{prefix}.{key}"] = getattr(value, field)
        return found

    return frame


def _stated(features: dict[str, dict]) -> dict[str, dict]:
    """Features of a dataset with touch as the data spec states them, where they are those of the data spec."""
    domains = (
        {DOMAINS: features[TACTILE][DOMAINS]} if DOMAINS in features[TACTILE] else {}
    )
    spec = load_dataset_spec(find_spec(SPEC))
    stated = lerobot_features(spec, ["observation.state", "action"])
    found = {key: dict(feature) for key, feature in features.items()}
    for key, ours in stated.items():
        if key in found and list(found[key]["names"] or ()) == ours["names"]:
            found[key] = ours | domains
    found[TACTILE] |= {"names": None}
    order = [
        *(k for k in spec.features if k in found),
        *(k for k in found if k not in spec.features),
    ]
    return {key: found[key] for key in order}

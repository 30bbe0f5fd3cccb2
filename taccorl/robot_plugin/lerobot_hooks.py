"""Arrays of touch in LeRobot's record and rollout, whose version 0.6.1 knows joints and pictures only.

``install`` replaces four functions by ones that pass touch on and leave everything else to LeRobot's own:
``hw_to_dataset_features`` and ``build_dataset_frame`` (an array is neither joint nor picture), ``LeRobotDataset.create`` (units,
frames and domains as in the data spec, so that datasets merge) and the loader of rollout's policies (to know their window of
touch, and whether they fit the robot). With ``TACCORL_NO_PATCH=1``, or another version of LeRobot, nothing is replaced.
"""

import functools
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from lerobot import __version__ as lerobot_version
from lerobot.configs import FeatureType

from taccorl.data.dataset import DOMAINS
from taccorl.data.lerobot_format import lerobot_features
from taccorl.data.origin import Origin
from taccorl.data.spec import find_spec, load_dataset_spec
from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT

if TYPE_CHECKING:
    from taccorl.robot_plugin.pads import Pads

SPEC = "taccorl_bimanual"
TACTILE = "observation.tactile"
COMPARED_VERSION = "0.6.1"
_DATASETS = (
    "lerobot.scripts.lerobot_record",
    "__main__",
    *(f"lerobot.rollout.strategies.{name}" for name in ("episodic", "sentry", "highlight", "dagger")),
)
_POLICIES = ("lerobot.rollout.strategies.core", "lerobot.rollout.inference.rtc")
_policy: Any = None  # configuration of the policy that rollout has loaded, before it makes the robot


@dataclass(frozen=True)
class TouchReading:
    """Touch in an observation: no array, which LeRobot's live view would plot as 1536 curves."""

    newest: np.ndarray
    """(K,) int16 counts above baseline: a row of a dataset."""
    window: np.ndarray
    """(L, K) int16, oldest first: what a policy gets, at the policy's rate whatever the loop does."""


class TouchFeature(tuple):
    """A robot's feature of touch, (K,); a tuple, as LeRobot's context keeps no other kinds."""

    described: dict[str, Any]
    """The dataset's feature, as in ``meta/info.json``."""

    @classmethod
    def of(cls, pads: "Pads", origin: Origin) -> "TouchFeature":
        """Feature of these pads; of the data spec, if they are its pads."""
        found = cls((pads.num_taxels,))
        found.described = dict(lerobot_features(load_dataset_spec(find_spec(SPEC)), [TACTILE])[TACTILE])
        if pads.names != ROBOT.pads:
            touch = found.described["tactile"] | {"layout": [1, *pads.layout], "pads": list(pads.names)}
            found.described |= {"shape": (pads.num_taxels,), "tactile": touch}
        if origin.domain is not None:
            found.described[DOMAINS] = [origin.domain]
        return found


@dataclass(frozen=True)
class Window:
    """Window of touch that the loaded policy takes: readings, and the number of its steps between them."""

    rows: int = 1
    stride: int = 1


def window() -> Window:
    """Window of the policy that rollout has loaded; one reading without one."""
    if _policy is None or not getattr(_policy, "tactile", False):
        return Window()
    return Window(_policy.tactile_history, _policy.tactile_stride)


def check_policy(features: dict[str, Any], names: Sequence[str], pads: "Pads | None", fps: float) -> None:
    """Check the policy that rollout has loaded, if there is one, against the robot: its ``features`` of observations, the
    ``names`` of its actions, its pads and its rate [Hz]. Raises TaccorlError: they are others."""
    if _policy is not None:
        require_fit(_policy, features, names, pads, fps)


def require_fit(policy: Any, features: dict[str, Any], names: Sequence[str], pads: "Pads | None", fps: float) -> None:
    """Check the configuration of a policy against a robot. Raises TaccorlError: as ``check_policy``."""
    inputs = policy.input_features or {}
    for key, feature in inputs.items():
        camera = key.removeprefix("observation.images.")
        if feature.type is not FeatureType.VISUAL:
            continue
        there = features.get(camera)
        if there is None:
            others = ", ".join(k for k, v in features.items() if isinstance(v, tuple) and len(v) == 3) or "none"
            raise TaccorlError(f"the policy was trained with the camera {camera}, the robot has {others}")
        if tuple(feature.shape) not in ((there[2], *there[:2]), there):
            raise TaccorlError(f"camera {camera}: the policy takes {tuple(feature.shape)}, the robot gives {there}")
    theirs = list(getattr(policy, "action_feature_names", None) or names)
    if set(theirs) != set(names):
        other = sorted(set(theirs) ^ set(names))
        raise TaccorlError(f"the policy's actions differ from the robot's: {', '.join(other[:4])}; use its own robot")
    if theirs != list(names):
        raise TaccorlError(f"the policy's actions are in another order than the robot's: {', '.join(theirs[:3])} …")
    rate = getattr(policy, "fps", None)
    if rate is not None and rate != fps:
        raise TaccorlError(f"the policy was trained at {rate:g} Hz, --robot.fps={fps:g}: give its rate to both")
    touch = getattr(policy, "tactile_format", None)
    if getattr(policy, "tactile", False) and pads is None:
        raise TaccorlError("the policy was trained with touch, but the robot has no pads: give --robot.pads")
    if touch is not None and pads is not None and (list(touch.layout), touch.pads) != (pads.layout, pads.names):
        own = f"{', '.join(pads.names)} of {pads.layout[1:]}"
        raise TaccorlError(f"the policy takes the pads {', '.join(touch.pads)} of {list(touch.layout[1:])}, not {own}")


def install() -> bool:
    """Replace the functions in what LeRobot has loaded so far; each call adds what was loaded since. Returns False if LeRobot
    was not changed."""
    if os.environ.get("TACCORL_NO_PATCH") == "1" or lerobot_version != COMPARED_VERSION:
        return False
    for module in ("lerobot.datasets.pipeline_features", "lerobot.rollout.context"):
        _replace(module, "hw_to_dataset_features", _with_touch)
    _replace("lerobot.rollout.context", "_load_pretrained_policy", _remembered)
    for names, field in ((_DATASETS, "newest"), (_POLICIES, "window")):
        for module in names:
            _replace(module, "build_dataset_frame", functools.partial(_framed, field=field))
    dataset = getattr(sys.modules.get("lerobot.datasets.lerobot_dataset"), "LeRobotDataset", None)
    if dataset is not None and not hasattr(dataset.create.__func__, "theirs"):
        dataset.create = classmethod(_marked(dataset.create.__func__, _with_units))
    return True


def _replace(module: str, name: str, wrap: Callable[[Callable], Callable]) -> None:
    theirs = getattr(sys.modules.get(module), name, None)
    if theirs is not None and not hasattr(theirs, "theirs"):
        setattr(sys.modules[module], name, _marked(theirs, wrap))


def _marked(theirs: Any, wrap: Callable[[Callable], Callable]) -> Any:
    ours: Any = wrap(theirs)
    ours.theirs = theirs
    return ours


def _remembered(theirs: Callable) -> Callable:
    def load(policy_config: Any) -> Any:
        global _policy
        policy, _policy = theirs(policy_config), policy_config
        return policy

    return load


def _with_units(theirs: Callable) -> Callable:
    def create(cls: Any, repo_id: str, fps: int, features: dict, *args: Any, **kwargs: Any) -> Any:
        return theirs(cls, repo_id, fps, _stated(features), *args, **kwargs)

    return create


def _with_touch(theirs: Callable) -> Callable:
    def to_features(hw_features: dict[str, Any], prefix: str, use_video: bool = True) -> dict[str, dict]:
        touch = {key: value for key, value in hw_features.items() if isinstance(value, TouchFeature)}
        features = theirs({k: v for k, v in hw_features.items() if k not in touch}, prefix, use_video)
        # Without names: LeRobot would merge those of vectors.
        own = {key: {k: v for k, v in f.described.items() if k != "names"} for key, f in touch.items()}
        return features | {f"{prefix}.{key}": feature for key, feature in own.items()}

    return to_features


def _framed(theirs: Callable, field: str) -> Callable:
    def frame(ds_features: dict[str, dict], values: dict[str, Any], prefix: str) -> dict[str, np.ndarray]:
        found = theirs(ds_features, values, prefix)
        for key, value in values.items():
            if isinstance(value, TouchReading) and f"{prefix}.{key}" in ds_features:
                found[f"{prefix}.{key}"] = getattr(value, field)
        return found

    return frame


def _stated(features: dict[str, dict]) -> dict[str, dict]:
    """Features of a dataset with touch as the data spec states them, where they are those of the data spec."""
    if TACTILE not in features or "tactile" not in features[TACTILE]:
        return features
    domains = {DOMAINS: features[TACTILE][DOMAINS]} if DOMAINS in features[TACTILE] else {}
    spec = load_dataset_spec(find_spec(SPEC))
    stated = lerobot_features(spec, ["observation.state", "action"])
    found = {key: dict(feature) for key, feature in features.items()}
    for key, ours in stated.items():
        if key in found and list(found[key]["names"] or ()) == ours["names"]:
            found[key] = ours | domains
    found[TACTILE] |= {"names": None}
    return {
        key: found[key]
        for key in [*(k for k in spec.features if k in found), *(k for k in found if k not in spec.features)]
    }

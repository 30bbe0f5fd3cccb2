"""What a policy takes from its dataset, or compares with what its checkpoint states: touch, rate, joints, parts, cameras.

``config`` is a ``TactilePI05Config``, whose module imports this one.
"""

import dataclasses
import logging
from collections.abc import Mapping
from typing import Any

import numpy as np
from lerobot.configs import FeatureType
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE

from taccorl.errors import TaccorlError
from taccorl.policies.tactile_pi05.part_poses import bodies_of
from taccorl.policies.tactile_pi05.touch_format import (
    TACTILE,
    TactileFormat,
    by,
    is_touch,
    layout_of,
    metadata_of,
    touch_of,
)
from taccorl.sim.part_poses import PARTS_KEY

_log = logging.getLogger(__name__)


def match_dataset(config: Any, meta: Any) -> None:
    """Take the format of touch, the rate and the names of state and actions from ``meta``, LeRobot's metadata of a dataset, or
    compare them with those already known. Raises TaccorlError: the dataset has no touch, another format, rate or order of
    joints than the checkpoint, or episodes shorter than the window."""
    where = f"dataset {meta.repo_id} ({meta.root})"
    if config.fps is not None and config.fps != meta.fps:
        raise TaccorlError(
            f"{where} has {meta.fps} rows per second, but the checkpoint was trained with {config.fps}: its action chunks "
            f"would last for another time. Ingest the recordings at {config.fps}, or train a new policy"
        )
    config.fps = int(meta.fps)
    _match_joints(config, meta, where)
    _match_parts(config, meta, where)
    if not config.tactile:
        return
    _match_touch(config, meta, where)
    lengths = list(meta.episodes["length"])
    if min(lengths) < config.window_rows:
        shortest = lengths.index(min(lengths))
        raise TaccorlError(
            f"{where}: episode {shortest} has {min(lengths)} rows, but the window of touch has {config.window_rows}: "
            "remove the episode (lerobot-edit-dataset, --operation.type=delete_episodes), or give a smaller "
            "--policy.tactile_history or --policy.tactile_stride"
        )


def match_cameras(config: Any, meta: Any, renamed: Mapping[str, str]) -> None:
    """Check that the dataset has every camera that a checkpoint was trained with; ``renamed`` maps a feature of the dataset to
    its name for the policy (``--rename_map``). Raises TaccorlError: one is missing; without this, the full backbone would
    see a black picture in its place."""
    known = [
        k
        for k, f in (config.input_features or {}).items()
        if f.type is FeatureType.VISUAL and config.pictures
    ]
    known = [k for k in known if not k.startswith(f"{OBS_IMAGES}.empty_camera_")]
    found = {renamed.get(key, key) for key in meta.camera_keys}
    if missing := [key for key in known if key not in found]:
        raise TaccorlError(
            f"dataset {meta.repo_id} ({meta.root}) has no {', '.join(missing)}, with which the checkpoint was trained. It "
            f"has: {', '.join(meta.camera_keys) or 'no camera'}. Where a camera has another name there: "
            f'--rename_map=\'{{"name in the dataset": "{missing[0]}"}}\'; without it: train a new policy'
        )
    if known and (unused := sorted(found - set(known))):
        _log.warning(
            "dataset %s: %s is not used, because the checkpoint was trained without it",
            meta.repo_id,
            ", ".join(unused),
        )


def _match_touch(config: Any, meta: Any, where: str) -> None:
    """Take the features of touch and their formats from the dataset, or compare them with those already known."""
    touch, known = touch_of(meta.features), config.known_touch
    if missing := [
        key for key in known or (() if touch else (TACTILE,)) if key not in touch
    ]:
        raise TaccorlError(
            f"{where} has no {', '.join(missing)}, which --policy.tactile=true needs: --policy.tactile=false trains on "
            f"vision only; taccorl ingest makes datasets with touch. "
            f"It has: {', '.join(k for k in meta.features if k.startswith('observation.'))}"
        )
    layouts: Mapping[str, list[int] | None] = config.tactile_layouts or {}
    if config.tactile_format or (not known and metadata_of(touch.get(TACTILE, {}))):
        _match_format(config, touch[TACTILE], where)
    if not known:
        layouts = {key: None for key in touch if key not in config.known_touch}
    layouts = {
        key: layout_of(touch[key], shape, f"{where}: {key}")
        for key, shape in layouts.items()
    }
    config.tactile_layouts = layouts or None
    for key, shape in layouts.items():
        _log.info(
            "%s: %s (%s) has no stated unit: normalised by its statistics",
            where,
            key,
            by(shape),
        )
    unused = [
        k
        for k, f in meta.features.items()
        if is_touch(k, f) and k not in config.known_touch
    ]
    if unused:
        _log.warning("%s: the policy does not use %s", where, ", ".join(unused))
    own = (
        []
        if config.tactile_format and not layouts
        else ["contact_threshold", "contact_min_active"]
    )
    own += [] if config.tactile_format else ["noise_threshold"]
    for name in own:
        if getattr(config, name) != getattr(type(config), name):
            raise TaccorlError(
                f"--policy.{name}={getattr(config, name)} has no effect: {where} does not state the unit of "
                f"{', '.join(layouts)}, with which every row is in contact: remove the option"
            )


def _match_format(config: Any, feature: dict[str, Any], where: str) -> None:
    found = TactileFormat.of_feature(feature, where)
    if config.tactile_format is not None and config.tactile_format != found:
        ours, theirs = (
            dataclasses.asdict(config.tactile_format),
            dataclasses.asdict(found),
        )
        said = "; ".join(
            f"{k}: {theirs[k]} there, {ours[k]} in the checkpoint"
            for k in ours
            if ours[k] != theirs[k]
        )
        raise TaccorlError(
            f"{where}: its format of touch differs from that of the checkpoint: {said}. Ingest the recordings in the "
            "same format, or train a new policy"
        )
    config.tactile_format = found


def _match_joints(config: Any, meta: Any, where: str) -> None:
    """Take the names of the elements of state and action from the dataset, or compare with those known already."""
    known, found = dict(config.joint_names or {}), {}
    if config.action_names_given and config.action_names_given != list(
        meta.features.get(ACTION, {}).get("names") or ()
    ):
        known.setdefault(
            ACTION, config.action_names_given
        )  # all that a checkpoint of an earlier taccorl states
    for key in (ACTION, OBS_STATE):
        names = _names_of(meta.features.get(key, {}))
        if not names:
            if key in known:
                _log.warning(
                    "%s does not name the elements of %s: whether they are in the checkpoint's order, %s, is not known",
                    *(where, key, ", ".join(known[key])),
                )
                found[key] = known[key]
            continue
        found[key] = names
        if key in known and known[key] != names:
            what = (
                "in another order" if sorted(known[key]) == sorted(names) else "others"
            )
            raise TaccorlError(
                f"{where}: the elements of {key} are {what} than those of the checkpoint, which would learn and send each "
                f"value for another joint. Dataset: {', '.join(names)}. Checkpoint: {', '.join(known[key])}. Ingest the "
                "recordings in the checkpoint's order (the features' names in the data spec), or train a new policy; the "
                "same joints under other names: rename them in meta/info.json of a copy of the dataset"
            )
    config.joint_names = found or None


def _match_parts(config: Any, meta: Any, where: str) -> None:
    """Take the names of the parts' poses from the dataset, or compare with those known already."""
    if not config.part_poses and not config.pose_loss:
        return
    if PARTS_KEY not in meta.features:
        if not config.part_poses and config.part_names is not None:
            return  # a checkpoint goes on without its pose loss
        option = (
            "--policy.part_poses=true"
            if config.part_poses
            else f"--policy.pose_loss={config.pose_loss:g}"
        )
        raise TaccorlError(
            f"{option}: {where} has no {PARTS_KEY}: make it with taccorl collect --part_poses=true. It has: "
            f"{', '.join(k for k in meta.features if k.startswith('observation.'))}"
        )
    names = list(meta.features[PARTS_KEY]["names"])
    if config.part_names is not None and config.part_names != names:
        raise TaccorlError(
            f"{where}: its {PARTS_KEY} is of {', '.join(bodies_of(names))}, but that of the checkpoint is of "
            f"{', '.join(bodies_of(config.part_names))}: it is another task"
        )
    rows = (
        int(np.ravel(meta.stats[PARTS_KEY]["count"])[0])
        if PARTS_KEY in (meta.stats or {})
        else meta.total_frames
    )
    if config.part_poses and rows < meta.total_frames:
        raise TaccorlError(
            f"--policy.part_poses=true: {where} has no {PARTS_KEY} in {meta.total_frames - rows} of {meta.total_frames} "
            "rows, those of the robot: only --policy.pose_loss can use it"
        )
    config.part_names = names


def _names_of(feature: Mapping[str, Any]) -> list[str]:
    """Names of a feature's elements; LeRobot also has them grouped, as in ``{"motors": […]}``. Empty: the dataset states none."""
    names = feature.get("names") or []
    if isinstance(names, Mapping):
        names = [
            name
            for group in names.values()
            for name in (group if isinstance(group, list) else [group])
        ]
    return [str(name) for name in names]

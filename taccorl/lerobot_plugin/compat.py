"""LeRobot versions after 0.6.1: which of the replaced functions kept their parameters.

What can take both is written where it is used: ``embed_prefix`` passes further arguments on,
shipped tokenizers have ``save_pretrained``, a histogram is flattened, the run of Weights &
Biases is read from its own files. What LeRobot's own functions are replaced by
(``training.reading``, ``robot_plugin.lerobot_hooks``) is compared here by its parameters.
"""

import importlib
import inspect
import logging
from collections.abc import Mapping
from typing import Any

import lerobot

from taccorl.robot_plugin import lerobot_hooks
from taccorl.training import reading

_log = logging.getLogger(__name__)
REPLACED: Mapping[str, str] = {
    "lerobot.datasets.factory:resolve_delta_timestamps": "cfg, ds_meta",
    "lerobot.datasets.factory:make_dataset": "cfg",
    "lerobot.datasets.dataset_reader:DatasetReader.__init__": "meta, root, …",
    "lerobot.datasets.dataset_reader:DatasetReader.get_item": "idx",
    "lerobot.datasets.lerobot_dataset:LeRobotDataset.create": "repo_id, fps, features, …",
    "lerobot.datasets.lerobot_dataset:LeRobotDataset.finalize": "",
    "lerobot.datasets.video_utils:get_safe_default_video_backend": "",
    "lerobot.processor:DataProcessorPipeline._save_pretrained": "save_directory, **kwargs",
    "lerobot.datasets.pipeline_features:hw_to_dataset_features": "hw_features, prefix, use_video=True",
    "lerobot.rollout.context:_load_pretrained_policy": "policy_config",
    "lerobot.rollout.context:create_inference_engine": "config, policy, …",
    "lerobot.rollout.inference.rtc:ActionQueue.get_left_over": "",
    "lerobot.rollout.inference.rtc:ActionQueue.get_processed_left_over": "",
    "lerobot.rollout.inference.rtc:ActionQueue.get_action_index": "",
    "lerobot.rollout.inference.rtc:ActionQueue._check_and_resolve_delays": "real_delay, action_index_before_inference=None",
    "lerobot.rollout.inference.rtc:ActionQueue._replace_actions_queue": "original_actions, processed_actions, real_delay",
    "lerobot.rollout.inference.rtc:ActionQueue.qsize": "",
    "lerobot.rollout.inference.rtc:_normalize_prev_actions_length": "prev_actions, target_steps",
    "lerobot.rollout.inference.rtc:LatencyTracker.max": "",
    "lerobot.rollout.inference.rtc:RTCInferenceEngine._rtc_loop": "",
    "lerobot.rollout.strategies.core:build_dataset_frame": "ds_features, values, prefix",
    "lerobot.rollout.strategies.core:precise_sleep": "seconds, …",
    "lerobot.rollout.strategies.core:log_visualization_data": "display_mode, observation=None, …",
    "lerobot.rollout.strategies.episodic:EpisodicStrategy._policy_loop": "ctx, robot, …",
}
"""Function that taccorl replaces → its parameters in LeRobot 0.6.1; "…": what replaces it
passes all others on."""


def changed(replaced: Mapping[str, str] = REPLACED) -> list[str]:
    """A line for each of the ``replaced`` functions that the installed LeRobot does not have
    with these parameters."""
    lines = []
    for place, parameters in replaced.items():
        now = _parameters(place)
        first, dots, _ = parameters.partition("…")
        if not (now.startswith(first) if dots else now == parameters):
            lines.append(f"{place}({now}) was {place}({parameters})")
    return lines


def follow() -> bool:
    """Have the replacements accept a LeRobot that is not 0.6.1, if all functions have the
    parameters of 0.6.1. Returns whether they do; else the functions are named."""
    version = lerobot.__version__
    if version == reading.COMPARED_VERSION:
        return True
    if lines := changed():
        _log.warning("LeRobot %s has other parameters: %s", version, "; ".join(lines))
        return False
    _log.warning(
        "LeRobot %s: taccorl was compared with %s; what it replaces has the same parameters",
        version,
        reading.COMPARED_VERSION,
    )
    reading.COMPARED_VERSION = lerobot_hooks.COMPARED_VERSION = version
    return True


def _parameters(place: str) -> str:
    """Parameters of ``module:name`` as text; "absent" where the installed LeRobot has no
    such function."""
    module, _, name = place.partition(":")
    try:
        found: Any = importlib.import_module(module)
        for part in name.split("."):
            found = getattr(found, part)
    except (ImportError, AttributeError):
        return "absent"
    found = getattr(found, "theirs", found)  # of a function that is replaced already
    signature = inspect.signature(found)
    parameters = [
        str(parameter.replace(annotation=parameter.empty))
        for name, parameter in signature.parameters.items()
        if name not in ("self", "cls")
    ]
    return ", ".join(parameters)

"""Load weights from files and raise on any mismatch; LeRobot's loader for pi05 prints it and continues with random weights."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from huggingface_hub import hf_hub_download
from lerobot.policies.pi05.modeling_pi05 import PI05Policy
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

from taccorl.errors import TaccorlError
from taccorl.lineage.manifest import require_checkpoint

WEIGHTS = "model.safetensors"
_TACTILE = "model.tactile."
_UNUSED = "lm_head.weight"
_POSE_HEAD = "pose_head."


def load_base_weights(policy: PI05Policy, source: str) -> None:
    """Load plain π0.5 weights into ``policy``: all except those of touch. The language heads of the source are not used.
    ``source``: folder, file or hub id, such as lerobot/pi05_base. Raises TaccorlError: the source cannot be read, or does
    not match; nothing is loaded then."""
    stored = _read(source, f"--policy.base_checkpoint={source}")
    fixed = policy._fix_pytorch_state_dict_keys(
        stored, policy.config
    )  # older names; the embedding out of the language head
    weights = {k if k.startswith("model.") else f"model.{k}": v for k, v in fixed.items() if not k.endswith(_UNUSED)}
    _load(policy, weights, f"--policy.base_checkpoint={source}", may_miss=_TACTILE)


def load_checkpoint(policy: PI05Policy, source: str, **hub: Any) -> None:
    """Load the policy's own weights from ``source`` (folder, file or hub id): all of them and no others, except the pose head,
    which actions do not need. Raises TaccorlError: they cannot be read, or do not match; nothing is loaded then."""
    weights = _read(source, f"checkpoint {source}", **hub)
    here = policy.state_dict()
    if not any(key.startswith(_POSE_HEAD) for key in here):
        weights = {key: value for key, value in weights.items() if not key.startswith(_POSE_HEAD)}
    _load(policy, weights, f"checkpoint {source}", may_miss=_POSE_HEAD)


def _read(source: str, said: str, **hub: Any) -> dict[str, Tensor]:
    path = Path(source).expanduser()
    try:
        if path.is_dir():
            require_checkpoint(path, said)
            path = path / WEIGHTS
        elif not path.is_file():
            path = Path(hf_hub_download(source, WEIGHTS, **hub))
        return load_file(path)
    except (OSError, ValueError, SafetensorError) as error:  # the hub's own errors are OSErrors or ValueErrors
        first = next(iter(str(error).splitlines()), type(error).__name__)
        raise TaccorlError(
            f"{said}: no weights to read: {first} Give a folder with {WEIGHTS}, that file, or a hub id (which needs network, "
            "HF_HUB_OFFLINE unset)"
        ) from error


def _load(policy: PI05Policy, weights: dict[str, Tensor], said: str, *, may_miss: str) -> None:
    wanted = {k: v.shape for k, v in policy.state_dict().items()}
    missing = [k for k in wanted if k not in weights and not k.startswith(may_miss)]
    unknown = [k for k in weights if k not in wanted]
    other = [
        f"{k} {tuple(v.shape)} there, {tuple(wanted[k])} here"
        for k, v in weights.items()
        if k in wanted and v.shape != wanted[k]
    ]
    faults = [("missing", missing), ("unknown here", unknown), ("of another shape", other)]
    if any(names for _, names in faults):
        config: Any = policy.config
        told = "; ".join(f"{len(names)} {what}, first {_first(names)}" for what, names in faults if names)
        if config.backbone != "full":
            told += f"; an earlier taccorl's {config.backbone} had other layers (CHANGELOG.md): train anew"
        raise TaccorlError(
            f"{said}: its weights do not match this policy (--policy.backbone={config.backbone}, "
            f"--policy.tactile={str(config.tactile).lower()}, "
            f"--policy.discrete_state_input={str(config.has_discrete_state).lower()}): {told}. Nothing was loaded"
        )
    policy.load_state_dict(weights, strict=False)


def _first(names: Iterable[str]) -> str:
    return next(iter(names))

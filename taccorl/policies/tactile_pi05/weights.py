"""Load weights from files and raise on any mismatch; LeRobot's loader for pi05 prints it and continues with random weights.

An adapter (PEFT) has the weights that ``lerobot-train --peft.…`` changed, and names its base policy, which has the others.
"""

import json
from pathlib import Path
from typing import Any

from huggingface_hub import hf_hub_download
from lerobot.policies.pi05.modeling_pi05 import PI05Policy
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file
from torch import Tensor

from taccorl.errors import TaccorlError
from taccorl.extras import OnUse, require
from taccorl.lineage.manifest import require_checkpoint

WEIGHTS, ADAPTER, _ADAPTER_WEIGHTS = (
    "model.safetensors",
    "adapter_config.json",
    "adapter_model.safetensors",
)
_TACTILE = "model.tactile."
_UNUSED = "lm_head.weight"
_POSE_HEAD = "pose_head."
_peft: Any = OnUse("peft")


def find_weights(source: str, said: str, **hub: Any) -> Path:
    """Return the file of weights of ``source`` (folder, file or hub id, such as lerobot/pi05_base); called before a network of
    gigabytes is built. Raises TaccorlError, which begins with ``said``: there is none, or it is damaged."""
    path = Path(source).expanduser()
    try:
        if path.is_dir():
            require_checkpoint(path, said)
            path = path / WEIGHTS
        elif not path.is_file():
            path = Path(hf_hub_download(source, WEIGHTS, **hub))
        with safe_open(path, framework="pt"):
            return path
    except (
        OSError,
        ValueError,
        SafetensorError,
    ) as error:  # the hub's own errors are OSErrors or ValueErrors
        first = next(iter(str(error).splitlines()), type(error).__name__)
        raise TaccorlError(
            f"{said}: no weights to read: {first} Give a folder with {WEIGHTS}, that file, or a hub id (which needs network, "
            "HF_HUB_OFFLINE unset)"
        ) from error


def load_base_weights(policy: PI05Policy, source: str) -> None:
    """Load plain π0.5 weights into ``policy``: all except those of touch. The language heads of the source are not used.
    ``source``: as for ``find_weights``. Raises TaccorlError: it cannot be read, or does not match; nothing is loaded then."""
    stored = load_file(
        find_weights(source, said := f"--policy.base_checkpoint={source}")
    )
    # older names; the embedding out of the language head
    fixed = policy._fix_pytorch_state_dict_keys(stored, policy.config)
    weights = {
        k if k.startswith("model.") else f"model.{k}": v
        for k, v in fixed.items()
        if not k.endswith(_UNUSED)
    }
    _load(policy, weights, said, may_miss=_TACTILE)


def load_checkpoint(policy: PI05Policy, source: str, **hub: Any) -> None:
    """Load the policy's own weights from ``source``: all of them and no others, except the pose head, which actions do not need.
    Raises TaccorlError: as ``load_base_weights``."""
    weights = load_file(find_weights(source, said := f"checkpoint {source}", **hub))
    here = policy.state_dict()
    if not any(key.startswith(_POSE_HEAD) for key in here):
        weights = {
            key: value
            for key, value in weights.items()
            if not key.startswith(_POSE_HEAD)
        }
    _load(policy, weights, said, may_miss=_POSE_HEAD)


def base_of(folder: Path) -> str | None:
    """Return the folder or hub id of the base policy of the adapter in ``folder``; None: ``folder`` has no adapter. Raises
    TaccorlError: the adapter names no base, or its base or the package peft is missing."""
    if not (folder / ADAPTER).is_file():
        return None
    require("peft")
    try:
        base = json.loads((folder / ADAPTER).read_text(encoding="utf-8"))[
            "base_model_name_or_path"
        ]
        if Path(base).is_absolute() and not Path(base).exists():
            raise ValueError(
                f"its base policy {base} does not exist: move it back, or put a link there"
            )
    except (OSError, ValueError, LookupError, TypeError, RecursionError) as error:
        raise TaccorlError(f"{folder}: adapter (PEFT) without base: {error}") from error
    return base


def load_merged(policy_class: Any, folder: Path, config: Any, **kwargs: Any) -> Any:
    """Load the adapter in ``folder`` and its base, and merge them: W + (α / r) B A for LoRA. Returns a policy with plain weights,
    of which those are trainable that are without an adapter. ``config``: of the policy, changed to that of one without adapter.
    ``kwargs``: further arguments of ``policy_class.from_pretrained``. Raises TaccorlError: as ``base_of``; or the adapter's
    weights are missing, or are not exactly those that the base needs."""
    base = base_of(folder)
    require_checkpoint(folder, f"checkpoint {folder}")
    if not (path := folder / _ADAPTER_WEIGHTS).is_file():
        raise TaccorlError(
            f"{folder}: adapter (PEFT) without {_ADAPTER_WEIGHTS}: copy the checkpoint again"
        )
    policy = policy_class.from_pretrained(base, config=config, **kwargs)
    policy.name_or_path = base  # PEFT compares it
    trainable = {
        name for name, weight in policy.named_parameters() if weight.requires_grad
    }
    try:
        adapted, stored = (
            _peft.get_peft_model(policy, _peft.PeftConfig.from_pretrained(str(folder))),
            load_file(path),
        )
        # PEFT only warns, and goes on with random ones
        if (
            odd := stored.keys()
            ^ _peft.get_peft_model_state_dict(
                adapted, save_embedding_layers=False
            ).keys()
        ):
            raise ValueError(
                f"{len(odd)} weights are missing or unknown, first {min(odd)}"
            )
        _peft.set_peft_model_state_dict(adapted, stored)
        policy = adapted.merge_and_unload()
    except (
        OSError,
        ValueError,
        RuntimeError,
        LookupError,
        TypeError,
        AttributeError,
        SafetensorError,
    ) as error:
        said = " ".join(str(error).split())
        raise TaccorlError(
            f"{folder}: adapter (PEFT) does not fit its base policy {base}: {said}"
        ) from error
    for name, weight in policy.named_parameters():
        weight.requires_grad_(name in trainable)
    config.use_peft = False
    return policy


def _load(
    policy: PI05Policy, weights: dict[str, Tensor], said: str, *, may_miss: str
) -> None:
    wanted = {k: v.shape for k, v in policy.state_dict().items()}
    missing = [k for k in wanted if k not in weights and not k.startswith(may_miss)]
    unknown = [k for k in weights if k not in wanted]
    other = [
        f"{k} {tuple(v.shape)} there, {tuple(wanted[k])} here"
        for k, v in weights.items()
        if k in wanted and v.shape != wanted[k]
    ]
    faults = [
        ("missing", missing),
        ("unknown here", unknown),
        ("of another shape", other),
    ]
    if any(names for _, names in faults):
        config: Any = policy.config
        told = "; ".join(
            f"{len(names)} {what}, first {names[0]}" for what, names in faults if names
        )
        if config.backbone != "full":
            told += f"; an earlier taccorl's {config.backbone} had other layers (CHANGELOG.md): train anew"
        raise TaccorlError(
            f"{said}: its weights do not match this policy (--policy.backbone={config.backbone}, "
            f"--policy.tactile={str(config.tactile).lower()}, "
            f"--policy.discrete_state_input={str(config.has_discrete_state).lower()}): {told}. Nothing was loaded"
        )
    policy.load_state_dict(weights, strict=False)

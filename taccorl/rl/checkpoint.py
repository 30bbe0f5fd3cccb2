"""Checkpoints of post-training: a LeRobot policy folder, and the state from which a run continues bit for bit.

    checkpoints/000010/pretrained_model/                policy and processors, as lerobot-train writes them
    checkpoints/000010/training_state/state.safetensors critic, optimisers, random states, environments, counters
    checkpoints/last, checkpoints/best                  links

A checkpoint is written beside its place and renamed: a process that is killed leaves the last one whole. ``manifest.json`` in
both folders has the digests of their files. Nothing is pickled: a foreign run's folder executes nothing.
"""

import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from taccorl.errors import TaccorlError
from taccorl.evaluation.policy_actor import Checkpoint
from taccorl.lineage.manifest import require_checkpoint, seal_checkpoint
from taccorl.policies.tactile_pi05.weights import WEIGHTS

LAST, BEST = "last", "best"
POLICY, _STATE = "pretrained_model", Path("training_state") / "state.safetensors"
_TRAIN_CONFIG = "train_config.json"  # lerobot-train's; names the dataset that the policy was trained on
_TREE = "state"  # metadata of the file: JSON of everything but the tensors


def save(
    out: Path,
    iteration: int,
    opened: Checkpoint,
    policy: Any,
    state: dict[str, Any],
    *,
    is_best: bool,
) -> None:
    """Write ``checkpoints/<iteration>``.

    Args:
        opened: the checkpoint that post-training began or resumed from, for its processors.
        state: everything else from which the run continues, as ``write_state`` takes it.
        is_best: link ``best`` to it, too; before ``last``, so that a process killed in between writes both again.

    Raises:
        TaccorlError: it cannot be written, for example on a full disk.
    """
    folder = out / "checkpoints" / f"{iteration:06d}"
    unfinished = folder.with_name(f".{folder.name}.unfinished")
    try:
        shutil.rmtree(unfinished, ignore_errors=True)
        unfinished.mkdir(parents=True)
        policy.save_pretrained(unfinished / POLICY)
        for processor in (opened.preprocessor, opened.postprocessor):
            processor.save_pretrained(unfinished / POLICY)
        if (opened.path / _TRAIN_CONFIG).is_file():
            shutil.copy(opened.path / _TRAIN_CONFIG, unfinished / POLICY)
        seal_checkpoint(unfinished / POLICY, keep=[WEIGHTS])
        write_state(unfinished / POLICY, state)
    # torch and safetensors have errors of their own for a full disk
    except (OSError, RuntimeError, SafetensorError) as error:
        shutil.rmtree(unfinished, ignore_errors=True)
        why = f"cannot be written ({str(error).splitlines()[0]}): is the disk full? Earlier checkpoints are complete"
        raise TaccorlError(
            f"{folder}: {why}; free space and continue: --resume=true"
        ) from error
    shutil.rmtree(folder, ignore_errors=True)
    unfinished.rename(folder)
    for name in (BEST, LAST) if is_best else (LAST,):
        _link(folder, name)


def exists(out: Path) -> bool:
    """Whether a run's folder has a last checkpoint, also if it is damaged."""
    return os.path.lexists(out / "checkpoints" / LAST)


def _link(folder: Path, name: str) -> None:
    """Make the link ``checkpoints/<name>`` to ``folder``, atomically."""
    new = folder.with_name(f".{name}.new")
    new.unlink(missing_ok=True)
    new.symlink_to(folder.name)
    new.replace(folder.with_name(name))


def policy_folder(out: Path) -> Path:
    """Path of the policy (LeRobot's ``pretrained_model``) of the last checkpoint in a run's folder; it need not exist."""
    return out / "checkpoints" / LAST / POLICY


def write_state(policy_path: Path, state: dict[str, Any]) -> None:
    """Write ``state`` beside the policy folder ``policy_path``: dicts, lists, tuples, tensors, arrays, numbers, strings, None."""
    path, tensors = policy_path.parent / _STATE, {}
    tree = _without_tensors(state, tensors)
    path.parent.mkdir(parents=True)
    save_file(tensors, path, metadata={_TREE: json.dumps(tree)})
    seal_checkpoint(path.parent)


def load_state(policy_path: Path) -> dict[str, Any]:
    """Return the dict ``state`` that ``write_state`` wrote beside the policy folder ``policy_path``; its tensors are on the
    CPU. Raises TaccorlError: it does not exist, is damaged, or was written by an earlier taccorl."""
    path = policy_path.parent / _STATE
    if path.exists():
        require_checkpoint(path.parent, str(path.parent))
    try:
        with safe_open(path, framework="pt") as file:
            return _with_tensors(json.loads(file.metadata()[_TREE]), file)
    except (
        OSError,
        SafetensorError,
        ValueError,
        KeyError,
        TypeError,
        RecursionError,
    ) as error:
        why = f"cannot be read ({' '.join(str(error).split()) or type(error).__name__})"
        if not path.exists():
            old = path.with_name("state.pt").exists()
            why = "does not exist" + (
                ": an earlier taccorl pickled it, and nothing is unpickled"
                if old
                else ""
            )
        way = f"start a new run from its policy, --policy.path={policy_path}"
        raise TaccorlError(
            f"{path}: {why}; {way}, or link checkpoints/{LAST} to an earlier checkpoint"
        ) from error


def _without_tensors(value: Any, tensors: dict[str, Tensor]) -> Any:
    """JSON of ``value``, with the names of its tensors and arrays, which are put into ``tensors``. A container or tensor is the
    object {kind: content}, so that an int stays an int as a key, and a tuple a tuple."""
    if isinstance(value, np.ndarray) and value.dtype == object:  # names and None
        return {
            "objects": [
                list(value.shape),
                [_without_tensors(part, tensors) for part in value.flat],
            ]
        }
    if isinstance(value, Tensor | np.ndarray):
        name = str(len(tensors))
        is_tensor = isinstance(value, Tensor)
        tensor = (
            value.detach().to("cpu", copy=True)
            if is_tensor
            else torch.from_numpy(value.copy())
        )
        tensors[name] = tensor.contiguous()
        return {"tensor" if is_tensor else "array": name}
    if isinstance(value, dict):
        return {
            "dict": [
                [_without_tensors(part, tensors) for part in item]
                for item in value.items()
            ]
        }
    if isinstance(value, list | tuple):
        return {
            type(value).__name__: [_without_tensors(part, tensors) for part in value]
        }
    if value is None or isinstance(value, int | float | str):
        return value
    raise TypeError(
        f"a checkpoint's state holds a {type(value).__name__}, which has no form in JSON"
    )


def _with_tensors(tree: Any, file: Any) -> Any:
    """Inverse of ``_without_tensors``; ``file`` is the open safetensors file."""
    if not isinstance(tree, dict):
        return tree
    ((kind, content),) = tree.items()
    if kind in ("tensor", "array"):
        tensor = file.get_tensor(content)
        return tensor if kind == "tensor" else tensor.numpy()
    if kind == "objects":
        return np.fromiter(
            (_with_tensors(part, file) for part in content[1]), dtype=object
        ).reshape(content[0])
    if kind == "dict":
        return {
            _with_tensors(key, file): _with_tensors(part, file) for key, part in content
        }
    parts = [_with_tensors(part, file) for part in content]
    return tuple(parts) if kind == "tuple" else parts


def prune(out: Path, keep: int) -> None:
    """Delete all checkpoints except the newest ``keep`` and those with a link."""
    root = out / "checkpoints"
    linked = {(root / name).resolve() for name in (LAST, BEST)}
    folders = sorted(p for p in root.iterdir() if p.name.isdigit())
    for folder in folders[: -keep or None]:
        if folder.resolve() not in linked:
            shutil.rmtree(folder)

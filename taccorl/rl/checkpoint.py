"""Checkpoints of post-training: a LeRobot policy folder, and the state from which a run continues bit for bit.

    checkpoints/000010/pretrained_model/       policy and processors, as lerobot-train writes them
    checkpoints/000010/training_state/state.pt critic, optimisers, random states, environments, counters
    checkpoints/last, checkpoints/best         links

A checkpoint is written beside its place and renamed: a process that is killed leaves the last one whole.
"""

import shutil
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError

from taccorl.errors import TaccorlError
from taccorl.evaluation.policy_actor import Checkpoint

LAST, BEST = "last", "best"
POLICY, _STATE = "pretrained_model", Path("training_state") / "state.pt"
_TRAIN_CONFIG = "train_config.json"  # lerobot-train's; names the dataset that the policy was trained on


def save(out: Path, iteration: int, opened: Checkpoint, policy: Any, state: dict[str, Any], *, is_best: bool) -> None:
    """Write ``checkpoints/<iteration>``.

    Args:
        out: folder of the run.
        opened: the checkpoint that post-training began or resumed from, for its processors.
        policy: policy with its present weights.
        state: everything else from which the run continues; ``load_state`` returns it.
        is_best: link ``best`` to it, too; before ``last``, so that a process killed in between writes both again.

    Raises:
        TaccorlError: it cannot be written, for example on a full disk.
    """
    folder = out / "checkpoints" / f"{iteration:06d}"
    unfinished = folder.with_name(f".{folder.name}.unfinished")
    try:
        shutil.rmtree(unfinished, ignore_errors=True)
        (unfinished / _STATE).parent.mkdir(parents=True)
        policy.save_pretrained(unfinished / POLICY)
        for processor in (opened.preprocessor, opened.postprocessor):
            processor.save_pretrained(unfinished / POLICY)
        if (opened.path / _TRAIN_CONFIG).is_file():
            shutil.copy(opened.path / _TRAIN_CONFIG, unfinished / POLICY)
        torch.save(state, unfinished / _STATE)
    # torch and safetensors have errors of their own for a full disk
    except (OSError, RuntimeError, SafetensorError) as error:
        shutil.rmtree(unfinished, ignore_errors=True)
        why = f"cannot be written ({str(error).splitlines()[0]}): is the disk full? The last checkpoint is complete"
        raise TaccorlError(f"{folder}: {why}; free space and continue: --resume=true") from error
    shutil.rmtree(folder, ignore_errors=True)
    unfinished.rename(folder)
    for name in (BEST, LAST) if is_best else (LAST,):
        _link(folder, name)


def exists(out: Path) -> bool:
    """Whether a run's folder holds a checkpoint to continue from."""
    return (out / "checkpoints" / LAST / _STATE).is_file()


def _link(folder: Path, name: str) -> None:
    """Make the link ``checkpoints/<name>`` to ``folder``, atomically."""
    new = folder.with_name(f".{name}.new")
    new.unlink(missing_ok=True)
    new.symlink_to(folder.name)
    new.replace(folder.with_name(name))


def policy_folder(out: Path) -> Path:
    """Path of the policy (LeRobot's ``pretrained_model``) of the last checkpoint in a run's folder; it need not exist."""
    return out / "checkpoints" / LAST / POLICY


def load_state(policy_path: Path) -> dict[str, Any]:
    """Return the dict ``state`` that ``save`` wrote beside the policy folder ``policy_path``; its tensors are on the CPU.

    It is a pickle file: load only files that you wrote.
    """
    return torch.load(policy_path.parent / _STATE, map_location="cpu", weights_only=False)


def prune(out: Path, keep: int) -> None:
    """Delete all checkpoints except the newest ``keep`` and those with a link."""
    root = out / "checkpoints"
    linked = {(root / name).resolve() for name in (LAST, BEST)}
    folders = sorted(p for p in root.iterdir() if p.name.isdigit())
    for folder in folders[: -keep or None]:
        if folder.resolve() not in linked:
            shutil.rmtree(folder)

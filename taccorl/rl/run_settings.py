"""``settings.json`` in a run's folder: the settings with which a run of post-training was started, used when it is resumed."""

import dataclasses
import json
from collections.abc import Collection
from pathlib import Path
from typing import Any

from taccorl.errors import TaccorlError
from taccorl.lineage.digest import digest_file
from taccorl.rl.settings import PostTrainSettings
from taccorl.sim.twin_file import write_whole

SETTINGS = "settings.json"
_NOT_STORED = ("out", "resume", "policy.device")
_MAY_CHANGE = ("iterations", "save_freq", "keep_checkpoints", "rerun", "noise_check")
_MAY_CHANGE += ("wandb.enable", "wandb.project", "wandb.entity", "wandb.mode")
_TWIN_DIGEST = "env.twin_sha256"


def write(settings: PostTrainSettings) -> None:
    """Write the settings atomically: on a full disk the previous file remains. Raises TaccorlError: they cannot be written."""
    write_whole(settings.out / SETTINGS, json.dumps(to_json(settings), indent=1) + "\n")


def remove_unfinished(out: Path) -> None:
    """Remove what a process leaves that was killed while it wrote its first settings."""
    if not (out / SETTINGS).exists():
        (out / f".{SETTINGS}.new").unlink(missing_ok=True)  # write_whole's


def stored_options(out: Path, given: Collection[str]) -> list[str]:
    """Options (``--ppo.clip=0.2``) with which the run in ``out`` was begun, except those whose names are ``given``. Raises
    TaccorlError: there is no run in ``out``."""
    names = to_json(PostTrainSettings()).keys() - {_TWIN_DIGEST, *given}
    stored = {
        name: value
        for name, value in _read(out).items()
        if name in names and value is not None
    }
    return [
        f"--{name}={json.dumps(value)}" for name, value in stored.items()
    ]  # JSON is YAML


def refuse_changes(settings: PostTrainSettings) -> None:
    """Check that a run can be resumed with these settings. Raises TaccorlError: there is no run in ``settings.out``, it has
    other settings, or its twin has changed."""
    before, now = to_json(PostTrainSettings()) | _read(settings.out), to_json(settings)
    if gone := [
        f"--{name}={value}" for name, value in before.items() if name not in now
    ]:
        way = "start a new run from its policy, --policy.path=…/checkpoints/last/pretrained_model"
        raise TaccorlError(
            f"--resume=true: {settings.out} has {', '.join(gone)}, which no longer exists: {way}"
        )
    changed = [
        name for name in now if name not in _MAY_CHANGE and before[name] != now[name]
    ]
    if changed:
        differences = "; ".join(
            f"--{name} {before[name]} there, {now[name]} here" for name in changed
        )
        raise TaccorlError(
            f"--resume=true: {settings.out}: {differences}. Give the settings of its start, or none"
        )


def _read(out: Path) -> dict[str, Any]:
    """Raises TaccorlError: there is no such file, or it does not hold settings."""
    try:
        return dict(json.loads((out / SETTINGS).read_text(encoding="utf-8")))
    except FileNotFoundError:
        raise TaccorlError(
            f"--resume=true: {out} holds no post-training ({SETTINGS}); leave --resume out to start one"
        ) from None
    except (ValueError, TypeError) as error:
        raise TaccorlError(
            f"--resume=true: {out / SETTINGS}: is not JSON of the settings of a run: {error}"
        ) from error


def to_json(settings: PostTrainSettings) -> dict[str, Any]:
    """Name, such as ``ppo.clip``, → value; paths are absolute."""
    values: dict[str, Any] = {}
    for name, value in dataclasses.asdict(settings).items():
        values |= (
            {f"{name}.{inner}": v for inner, v in value.items()}
            if isinstance(value, dict)
            else {name: value}
        )
    values = {name: value for name, value in values.items() if name not in _NOT_STORED}
    values[_TWIN_DIGEST] = digest_file(settings.env.twin) if settings.env.twin else None
    return {
        name: str(v.resolve()) if isinstance(v, Path) else v
        for name, v in values.items()
    }

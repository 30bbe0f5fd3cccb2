"""``settings.json`` in a run's folder: the settings with which a run of post-training was started, used when it is resumed."""

import dataclasses
import json
from collections.abc import Collection
from pathlib import Path
from typing import Any

from taccorl.errors import TaccorlError
from taccorl.lineage.digest import digest_file
from taccorl.rl.settings import PostTrainSettings

SETTINGS = "settings.json"
_UNFINISHED = f".{SETTINGS}.new"
_NOT_STORED = ("out", "resume", "policy.device")
_MAY_CHANGE = ("iterations", "save_freq", "keep_checkpoints", "rerun", "noise_check")
_TWIN_DIGEST = "env.twin_sha256"
_REMOVED = {"noise.correlation": (0.0,), "env.stagger": (True, False), "env.start_states": (256,)}
"""Settings of older versions, and the values with which a run goes on as it did; they no longer exist since 23 November 2026."""


def write(settings: PostTrainSettings) -> None:
    """Write the settings atomically: on a full disk the previous file remains."""
    new = settings.out / _UNFINISHED
    new.write_text(json.dumps(_to_json(settings), indent=1) + "\n", encoding="utf-8")
    new.replace(settings.out / SETTINGS)


def remove_unfinished(out: Path) -> None:
    """Remove what a process leaves that was killed while it wrote its first settings."""
    if not (out / SETTINGS).exists():
        (out / _UNFINISHED).unlink(missing_ok=True)


def stored_options(out: Path, given: Collection[str]) -> list[str]:
    """Options (``--ppo.clip=0.2``) with which the run in ``out`` was begun, except those whose names are ``given``.

    Raises:
        TaccorlError: there is no run in ``out``.
    """
    names = _to_json(PostTrainSettings()).keys() - {_TWIN_DIGEST, *given}
    stored = {name: value for name, value in _read(out).items() if name in names and value is not None}
    return [f"--{name}={json.dumps(value)}" for name, value in stored.items()]  # JSON is YAML


def refuse_changes(settings: PostTrainSettings) -> None:
    """Check that a run can be resumed with these settings.

    Raises:
        TaccorlError: there is no run in ``settings.out``, it has other settings, or its twin has changed.
    """
    before, now = _to_json(PostTrainSettings()) | _read(settings.out), _to_json(settings)
    gone = [f"--{name}={before[name]}" for name, same in _REMOVED.items() if before.get(name, same[0]) not in same]
    if gone:
        raise TaccorlError(
            f"--resume=true: {settings.out} was started with {', '.join(gone)}, which this version does not have: start a new "
            "run from its policy, --policy.path=…/checkpoints/last/pretrained_model"
        )
    fixed = [name for name in now if name not in _MAY_CHANGE]
    if changed := [f"--{name} {before[name]} there, {now[name]} here" for name in fixed if before[name] != now[name]]:
        raise TaccorlError(
            f"--resume=true: {settings.out} was started with other settings: {'; '.join(changed)}. Give the original settings, "
            "or none"
        )


def _read(out: Path) -> dict[str, Any]:
    """
    Raises:
        TaccorlError: there is no such file, or it is not JSON.
    """
    try:
        found = json.loads((out / SETTINGS).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise TaccorlError(
            f"--resume=true: {out} holds no post-training ({SETTINGS}); remove --resume to start a new run"
        ) from None
    except ValueError as error:
        raise TaccorlError(f"--resume=true: {out / SETTINGS}: is not JSON: {error}") from error
    if not isinstance(found, dict):
        raise TaccorlError(
            f"--resume=true: {out / SETTINGS}: contains a {type(found).__name__} instead of the settings of a run"
        )
    return found


def _to_json(settings: PostTrainSettings) -> dict[str, Any]:
    """Name, such as ``ppo.clip``, → value; paths are absolute."""
    values: dict[str, Any] = {}
    for name, value in dataclasses.asdict(settings).items():
        values |= {f"{name}.{inner}": v for inner, v in value.items()} if isinstance(value, dict) else {name: value}
    values = {name: value for name, value in values.items() if name not in _NOT_STORED}
    values[_TWIN_DIGEST] = digest_file(settings.env.twin) if settings.env.twin else None
    return {name: str(v.resolve()) if isinstance(v, Path) else v for name, v in values.items()}

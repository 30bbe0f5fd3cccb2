"""Digest of a scene, stored with each state as one number, because a state can only be restored into its own scene."""

import dataclasses
import hashlib
from typing import TYPE_CHECKING

from taccorl.errors import TaccorlError
from taccorl.lineage.canonical import canonical_text
from taccorl.sim.twin_file import twin_text

if TYPE_CHECKING:
    from taccorl.sim.task import Task
    from taccorl.sim.twin import TwinConfig

_BITS = 52  # a float64 holds so many exactly


def scene_digest(task: "Task", config: "TwinConfig", scale: float) -> float:
    """Return the digest of task, difficulty, twin and randomisation: k / 2⁵², 0 ≤ k < 2⁵², from SHA-256. Equal scenes have equal
    bits.

    An effect's interval and evidence are not included: they do not change the motion. A fraction, so that it stays within the
    range that a dataset declares for ``sim.state``. ``scale`` is the factor on the ranges of the randomisation."""
    bare = [
        dataclasses.replace(effect, interval={}, evidence="")
        for effect in config.effects
    ]
    config = dataclasses.replace(config, effects=bare)
    try:
        twin = twin_text(config)
    except TaccorlError:
        twin = repr(config)  # classes that are not registered: no file can name them
    scene = {
        "task": task.name,
        "difficulty": task.difficulty,
        "twin": twin,
        "randomization": float(scale),
    }
    digest = hashlib.sha256(canonical_text(scene).encode()).digest()
    return (int.from_bytes(digest[:8], "big") >> (64 - _BITS)) / 2**_BITS

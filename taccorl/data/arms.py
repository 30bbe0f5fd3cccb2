"""Assign the elements of ``observation.state`` and ``action`` to arms by name and unit, never by position."""

from dataclasses import dataclass

import numpy as np

from taccorl.data.episode import Episode
from taccorl.data.spec import ACTION

__all__ = ["ACTION", "STATE"]

STATE = "observation.state"  # Key of the robot's state, which names the arms


@dataclass(frozen=True)
class Arm:
    """Indices of the elements of ``observation.state`` and ``action`` that belong to one arm."""

    name: str
    """Prefix of the elements' names (``left``, ``right``), without the underscore; empty for a robot with one arm."""
    joints: np.ndarray
    """(n,) indices of the elements that are joint angles [rad], from base to wrist."""
    gripper: int | None
    """Index of the element that is the gripper's opening [m]; None without a gripper."""


def find_arms(names: tuple[str, ...], units: tuple[str, ...]) -> list[Arm]:
    """Return the arms, found by the prefixes ``left_`` and ``right_`` of the elements' names; elements without a prefix belong to
    the arm without a name.

    ``names`` and ``units`` have one entry for each element.
    """
    arms = []
    prefixes = [next((p for p in ("left", "right") if n.startswith(f"{p}_")), "") for n in names]
    for prefix in sorted(set(prefixes)):
        own = [i for i, p in enumerate(prefixes) if p == prefix]
        grippers = [i for i in own if units[i] == "m" and names[i].endswith("gripper.pos")]
        joints = np.array([i for i in own if units[i] == "rad"], dtype=int)
        arms.append(Arm(prefix, joints, grippers[0] if grippers else None))
    return arms


def element_units(episode: Episode, key: str) -> tuple[str, ...]:
    """Return the unit of every element of the feature ``key``, in their order."""
    feature = episode.spec.features[key]
    return (feature.unit,) * feature.size if isinstance(feature.unit, str) else feature.unit


def element_names(episode: Episode, key: str) -> tuple[str, ...]:
    """Return the name of every element of a feature, in their order; ``key[0]``, ``key[1]`` … where the spec names none."""
    feature = episode.spec.features[key]
    return feature.names or tuple(f"{key}[{i}]" for i in range(feature.size))


def episode_arms(episode: Episode) -> list[Arm]:
    """Return the arms of an episode whose state and command have the same names; an empty list if they differ or one is
    missing."""
    if STATE not in episode.arrays or ACTION not in episode.arrays:
        return []
    if element_names(episode, STATE) != episode.spec.features[ACTION].names:
        return []
    return find_arms(element_names(episode, STATE), element_units(episode, STATE))

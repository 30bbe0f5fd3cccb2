"""Group the elements of a vector into plots: same unit, same arm, short names."""

import re
from dataclasses import dataclass

from taccorl.data.episode import Episode
from taccorl.data.spec import FeatureSpec
from taccorl.robots import ROBOT

MOST_NUMBERS = 64
"""Most numbers of a feature that is shown as curves."""
MOST_LINES = 8
"""Most lines in one plot; more are split by the first word of their names (left, right)."""


@dataclass(frozen=True)
class Group:
    """Elements of a vector that share one plot: name, unit, indices and labels."""

    name: str
    """Name of the group, such as ``left arm`` or ``joints``."""
    unit: str
    """Unit of all its elements; empty if there is none."""
    columns: tuple[int, ...]
    """Indices of the elements in the feature."""
    labels: tuple[str, ...]
    """Short names of the elements."""

    @property
    def title(self) -> str:
        """Name and unit, such as ``left arm [rad]``."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name

    @property
    def path(self) -> str:
        """Last part of the group's entity path, such as ``left_arm_rad``."""
        return re.sub(r"\W+", "_", self.title).strip("_")


def short_name(key: str) -> str:
    """Last part of a feature's key: ``observation.images.front`` → ``front``."""
    return (
        key.removeprefix("observation.images.")
        .removeprefix("observation.")
        .replace(".", "_")
    )


def vector_keys(episode: Episode) -> list[str]:
    """Return the keys of the features that are shown as curves: state and action first."""
    keys = [key for key in episode.spec.keys("vector") if key in episode.arrays]
    shown = [key for key in keys if episode.spec.features[key].size <= MOST_NUMBERS]
    return sorted(shown, key=("observation.state", "action", *shown).index)


def element_names(feature: FeatureSpec) -> tuple[str, ...]:
    """Return the name of every element, in their order, without ``.pos``; its number where the feature states no names."""
    names = feature.names or tuple(str(i) for i in range(feature.size))
    return tuple(re.sub(r"\.(pos|position)$", "", name) for name in names)


def groups_of(feature: FeatureSpec) -> list[Group]:
    """Return the groups of the elements of ``feature``: every element is in one group, and a group has one unit."""
    units, names = feature.units, element_names(feature)
    groups = []
    for unit in dict.fromkeys(units):
        columns = [i for i, u in enumerate(units) if u == unit]
        sides = dict.fromkeys(names[i].split("_")[0] for i in columns)
        if len(columns) > MOST_LINES and 1 < len(sides) < len(columns):
            for side in sides:
                of_side = tuple(i for i in columns if names[i].split("_")[0] == side)
                labels = tuple(names[i].removeprefix(f"{side}_") for i in of_side)
                name = f"{side} arm" if side in ROBOT.arms else side
                groups.append(Group(name, unit, of_side, labels))
        else:
            kind = (
                "grippers" if all("gripper" in names[i] for i in columns) else "joints"
            )
            labels = tuple(names[i].removesuffix("_gripper") for i in columns)
            groups.append(Group(kind, unit, tuple(columns), labels))
    return groups

"""Formats of touch in a dataset: pads with a stated unit, and any other array of numbers, normalised by its statistics."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from taccorl.errors import TaccorlError

TACTILE = "observation.tactile"
_STATED = {
    "sensor",
    "layout",
    "pads",
    "scheme",
    "gain_per_count",
}  # keys of the format that taccorl ingest writes


class TouchInput(NamedTuple):
    """One feature of touch as the policy reads it."""

    layout: tuple[int, ...]
    """Pads, rows and columns; pads and values where a pad is a vector."""
    gain_per_count: float | None
    """Normalised reading of one count. None: its unit is not stated, it is normalised by the dataset's statistics."""

    @property
    def num_values(self) -> int:
        """K: number of values of one reading of all pads."""
        return math.prod(self.layout)


@dataclass(frozen=True)
class TactileFormat:
    """Format of touch in a dataset: ``tactile`` of the feature in its ``meta/info.json``."""

    sensor: str
    """Name of the sensor."""
    pads: tuple[str, ...]
    """Names of the pads, in their order."""
    rows: int
    columns: int
    scheme: str
    """Rule from counts to readings; only ``fixed_scale``."""
    gain_per_count: float
    """Normalised reading = (counts − baseline) × gain."""

    @property
    def layout(self) -> tuple[int, int, int]:
        """Number of pads, rows and columns, in this order."""
        return len(self.pads), self.rows, self.columns

    @classmethod
    def of_feature(cls, feature: dict[str, Any], where: str) -> "TactileFormat":
        """Read the format from a feature of the dataset ``where``. Raises TaccorlError: the feature does not state its format,
        or states one that contradicts its shape."""
        told = feature.get("tactile")
        if not isinstance(told, dict):
            raise TaccorlError(
                f"{where}: {TACTILE} does not state what its {feature.get('shape')} numbers are (no 'tactile' with layout, "
                "scheme and gain in meta/info.json): write the dataset with taccorl ingest, which also converts other LeRobot "
                "datasets"
            )
        history, pads, rows, columns = told["layout"]
        if history != 1 or math.prod(told["layout"]) != math.prod(feature["shape"]):
            raise TaccorlError(
                f"{where}: {TACTILE} has shape {feature['shape']}, but its layout states {told['layout']}"
            )
        names = tuple(told["pads"])
        if len(names) != pads:
            raise TaccorlError(
                f"{where}: {TACTILE} names the pads {', '.join(names)}, but its layout states {pads}"
            )
        return cls(
            told["sensor"],
            names,
            rows,
            columns,
            told["scheme"],
            float(told["gain_per_count"]),
        )


def is_touch(key: str, feature: Mapping[str, Any]) -> bool:
    """Pictures of a tactile sensor are cameras of the policy."""
    return key.startswith(TACTILE) and feature["dtype"] not in ("image", "video")


def touch_of(features: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """A dataset's features of touch; those that hold a window of several readings a row are left out."""
    touch = {k: f for k, f in features.items() if is_touch(k, f)}
    return {
        k: f
        for k, f in touch.items()
        if k == TACTILE or metadata_of(f).get("layout", [1])[0] == 1
    }


def metadata_of(feature: Mapping[str, Any]) -> dict[str, Any]:
    """Format as taccorl ingest writes it; empty: not stated, or another program's."""
    told = feature.get("tactile")
    return told if isinstance(told, dict) and told.keys() >= _STATED else {}


def layout_of(
    feature: Mapping[str, Any], known: Sequence[int] | None, where: str
) -> list[int]:
    """Shape of a reading that the dataset states, or ``known`` if it fits. Raises TaccorlError: no numbers, or another shape
    than that known."""
    if not re.fullmatch(r"bool|u?int\d+|float\d+", str(feature["dtype"])):
        raise TaccorlError(
            f"{where} holds {feature['dtype']}, not numbers, so that it is no touch. Leave it out: lerobot-edit-dataset "
            "--operation.type=remove_feature, or list the others in --policy.tactile_layouts"
        )
    shape, told = list(feature["shape"]), metadata_of(feature)
    stated = told["layout"][1:] if told else feature.get("layout")
    found = shape
    if isinstance(stated, list | tuple) and all(isinstance(n, int) for n in stated):
        found = list(stated) if math.prod(stated) == math.prod(shape) else shape
    if known is None:
        return found
    if (
        not known
        or math.prod(known) != math.prod(shape)
        or (list(known) != found and len(found) > 1)
    ):
        raise TaccorlError(
            f"{where} has readings of {by(found)}, but the policy (tactile_layouts) takes {by(known)}"
        )
    return list(known)


def by(shape: Sequence[int]) -> str:
    return " × ".join(map(str, shape))

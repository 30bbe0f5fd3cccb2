"""Places at which a probe presses a sensor of cells: which rows of a recording belong to which place.

A press is a stretch of rows with more than ``PRESSED`` of the rated load. Its place is the median position during it. Presses of
the fit recordings that are no farther apart than ``same_place_mm`` of the cells file are one place, and each cell has a gain of
its own for each place: how the load spreads over the cells is then fitted, not modelled. Rows between two presses belong to
the nearer one. A press that moves by more than ``same_place_mm``, or that is at no place of the fit recordings, is not used.

Letters in shapes: T rows.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from taccorl.alignment.machines.cell_tables import CellMeasurement, cells_of
from taccorl.alignment.machines.cells_file import CellsConfig
from taccorl.alignment.measurements.folder import Measurements
from taccorl.data.finding import Finding, listed
from taccorl.data.timing import runs
from taccorl.errors import TaccorlError

PRESSED = 0.05  # Share of the rated load above which a row is part of a press
MOST_PLACES = (
    200  # Most places of a sensor: each is a number a cell, and a column of every fit
)


def with_places(config: CellsConfig, measurements: Measurements) -> Measurements:
    """``measurements`` with the place of every row; unchanged if the cells file has no ``same_place_mm``, or they have places.
    Raises TaccorlError: a recording has no position, no press of the fit recordings stays at its place, or there are more than
    ``MOST_PLACES`` places."""
    if config.same_place_mm is None or all(
        m.place.size for m in cells_of(measurements.all)
    ):
        return measurements
    lacking = [m.name for m in cells_of(measurements.all) if not m.position_mm.size]
    if lacking:
        raise TaccorlError(
            f"{lacking[0]}: has no position of the probe, but {config.name} has same_place_mm"
        )
    places: list[np.ndarray] = []
    found = [press for m in cells_of(measurements.fit) for press in presses(config, m)]
    for _, _, at, moved in found:
        if (
            moved <= config.same_place_mm
            and _nearest(at, places, config.same_place_mm) < 0
        ):
            places.append(at)
    if found and not places:
        raise TaccorlError(
            f"{config.name}: no press of the fit recordings stays within same_place_mm {config.same_place_mm:g} mm: record "
            "presses that do not slide, or correct the unit of the position in the columns file"
        )
    if len(places) > MOST_PLACES:
        raise TaccorlError(
            f"{config.name}: the fit recordings press {len(places)} places, more than {MOST_PLACES}: press fewer places, each "
            f"several times, or write a larger same_place_mm than {config.same_place_mm:g} mm in the cells file"
        )
    sides = {
        side: tuple(
            _placed(config, m, places) for m in cells_of(getattr(measurements, side))
        )
        for side in ("fit", "validation", "test")
    }
    for m in (m for side in sides.values() for m in side if (m.place < 0).all()):
        raise TaccorlError(
            f"{m.name}: no press is at a place of the fit recordings and stays within same_place_mm {config.same_place_mm:g} mm: "
            f"{len(places)} places are known; press them in every recording, correct the position's unit, or leave this one out"
        )
    return dataclasses.replace(measurements, **sides)


def presses(
    config: CellsConfig, m: CellMeasurement
) -> list[tuple[int, int, np.ndarray, float]]:
    """Every press: first row, last row + 1, place (2,) [mm], and its largest distance from that place [mm]."""
    found = []
    for first, end in runs(m.target[:, 0] > PRESSED * config.load.rated):
        own = m.position_mm[first:end]
        at = np.median(own, axis=0)
        found.append((first, end, at, float(np.linalg.norm(own - at, axis=1).max())))
    return found


def place_findings(config: CellsConfig, m: CellMeasurement) -> list[Finding]:
    """A warning that names the presses of ``m``, which has places, that are not used; empty if there are none."""
    if not m.place.size:
        return []
    unused = [
        (first, at, moved)
        for first, _, at, moved in presses(config, m)
        if m.place[first] < 0
    ]
    if not unused:
        return []
    which = listed(
        [
            f"at {m.time_s[first]:.4g} s ({at[0]:.4g}, {at[1]:.4g} mm)"
            for first, at, _ in unused
        ]
    )
    slid = sum(moved > (config.same_place_mm or 0.0) for _, _, moved in unused)
    text = (
        f"{len(unused)} presses are not used: {which}; {slid} of them move by more than same_place_mm {config.same_place_mm:g} "
        f"mm, {len(unused) - slid} are at places that no fit recording presses. Press still, at the same places in each recording"
    )
    return [Finding("other_places", "warning", "position", text)]


def _placed(
    config: CellsConfig, m: CellMeasurement, places: Sequence[np.ndarray]
) -> CellMeasurement:
    found = presses(config, m)
    place = np.full(m.num_rows, 0 if not found else -1)
    for k, (first, end, at, moved) in enumerate(found):
        begin = (found[k - 1][1] + first) // 2 if k else 0
        until = (end + found[k + 1][0]) // 2 if k + 1 < len(found) else m.num_rows
        same = config.same_place_mm or 0.0
        place[begin:until] = _nearest(at, places, same) if moved <= same else -1
    return dataclasses.replace(m, place=place, num_places=max(len(places), 1))


def _nearest(at: np.ndarray, places: Sequence[np.ndarray], same_mm: float) -> int:
    """Number of the nearest place that is no farther away than ``same_mm``; −1 if there is none."""
    far = [float(np.linalg.norm(at - place)) for place in places]
    return int(np.argmin(far)) if far and min(far) <= same_mm else -1

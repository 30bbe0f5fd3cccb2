"""The file of a sensor with one or more cells that known loads press; ``docs/your_robot.md`` has one with its keys.

Once they are fitted, the gain and offset of each cell stand there, too (``gain: [41.2]``, ``offset: [12.0]``). The model is y =
clip(g r + o, lowest … highest): the effects make r of the load, each cell has its gain g and offset o. In the unit ``reading``,
in which effects have their numbers, 1 is a tenth of the rated load. Clipping at the converter's ends is described by the file,
not by an effect.
"""

import dataclasses
import hashlib
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import yaml

from taccorl.data.strict_yaml import Rules
from taccorl.errors import TaccorlError, nearest, plain_name
from taccorl.sim.effects import make_effect
from taccorl.sim.effects.added import present
from taccorl.sim.effects.effect import CELLS, Effect, TouchEffect
from taccorl.sim.twin_file import EffectsDocument, effect_entry, write_whole

_PREFIXES = {
    "": 1.0,
    "f": 1e-15,
    "p": 1e-12,
    "n": 1e-9,
    "u": 1e-6,
    "µ": 1e-6,
    "m": 1e-3,
    "h": 1e2,
    "k": 1e3,
    "M": 1e6,
}


def _units(quantity: str = "", **prefixes: str) -> dict[str, tuple[str, float]]:
    """Unit, and the unit with each of these prefixes → ``quantity``, or the unit, and the
    factor to it."""
    return {
        f"{p}{unit}": (quantity or unit, _PREFIXES[p])
        for unit, some in prefixes.items()
        for p in ("", *some)
    }


LOADS: dict[str, tuple[str, float]] = {
    **_units("force_n", N="mk"),
    **_units("pressure_pa", Pa="hkM"),
    **_units("depth_m", m="muµ"),
    "gf": ("force_n", 9.80665e-3),
    "kgf": ("force_n", 9.80665),
    "lbf": ("force_n", 4.4482216),
    "mbar": ("pressure_pa", 1e2),
    "bar": ("pressure_pa", 1e5),
    "psi": ("pressure_pa", 6894.757),
}
"""Unit of a load → its column in tables without a columns file, and the factor to that column's unit."""
READINGS: dict[str, tuple[str, float]] = {
    **_units(count="", V="muµ", ohm="kM", S="muµ", F="npf", A="muµ", N="m", Pa="k"),
    "Ω": ("ohm", 1.0),
    "kΩ": ("ohm", 1e3),
}
"""Unit of a reading → the quantity's own unit and the factor to it."""
READINGS_OF_RATED = 10.0
"""Reading of the rated load in the unit ``reading``. Touch effects have bounds for readings of this size."""
_HEADER = "# A sensor of cells. taccorl/alignment/machines/cells_file.py says what may stand here.\n"


MOST_CELLS = 100_000  # Most cells of a sensor


@dataclass(kw_only=True)
class Load:
    """Settings of the load on the cells in a cells file: unit, rated value, and whether all cells share it."""

    unit: str  # Unit of the load, a key of ``LOADS``
    rated: float  # Greatest load for which the sensor is made, in ``unit``
    shared: bool = True  # True: all cells have the load of one column; false: each cell has its own column


@dataclass(kw_only=True)
class Reading:
    """Unit, converter range and direction of the readings, the same for all cells."""

    unit: str  # Unit of the readings, a key of ``READINGS``
    lowest: float | None = (
        None  # Lower end of the converter, in ``unit``; none if not given
    )
    highest: float | None = (
        None  # Upper end of the converter, in ``unit``; none if not given
    )
    falls: bool = False  # True if the reading decreases under load, like a resistance
    below_rest: bool = False
    """True if readings can be below the offset after a release, as where a soft layer relaxes: creep then acts there, too. With
    ``falls`` above it."""


@dataclass(kw_only=True)
class CellsConfig:
    """Content of a cells file."""

    kind: Literal["cells"] = "cells"
    name: str = (
        ""  # Name of the sensor in tables and reports; the file's stem if not given
    )
    cells: list[str] = field(
        default_factory=list
    )  # Names of cells that are not in a grid
    rows: int | None = None  # Number of rows of a grid; None if the cells have names
    columns: int | None = None  # Number of columns of a grid
    load: Load
    reading: Reading
    rate_hz: float | None = (
        None  # Row rate of the recordings [Hz]; not checked if not given
    )
    same_place_mm: float | None = None
    """Largest distance of presses at one place [mm], for recordings with the position of a probe. Each cell then has a gain for
    each place. None: all presses are at one place, and recordings have no position."""
    gain: list[float] = field(default_factory=list)
    """Gain of each cell, row after row [unit of the reading per unit of the load]; fitted if not given."""
    offset: list[float] = field(
        default_factory=list
    )  # Offset of each cell: reading without load
    effects: list[Effect] = field(
        default_factory=list
    )  # Effects between load and reading; empty if there are none

    def __post_init__(self) -> None:
        for wrong, key, text in self._rules():
            if wrong:
                raise TaccorlError(f"{key}: {text}")
        self.effects = [_of_cells(effect) for effect in self.effects]
        present(self.effects)

    def _rules(self) -> Rules:
        grid, load, reading = (
            f"rows {self.rows} and columns {self.columns}",
            self.load.unit,
            self.reading.unit,
        )
        has_grid, rows, columns = (
            (self.rows, self.columns) != (None, None),
            self.rows or 0,
            self.columns or 0,
        )
        yield (
            bool(self.cells) == has_grid,
            "cells",
            "give names, `cells: [thumb]`, or a grid, `rows: 4` and `columns: 6`",
        )
        yield (
            not self.cells and min(rows, columns) < 1,
            grid,
            "a grid needs both, 1 or more",
        )
        yield (
            rows * columns > MOST_CELLS,
            grid,
            f"more than {MOST_CELLS:,} cells; correct them",
        )
        for name in self.cells:
            plain_name(name, "cells")
        yield (
            len(set(self.cells)) < len(self.cells),
            "cells",
            f"{self.cells}: each name must occur once",
        )
        none = f"{load!r} is not a unit of force, pressure or depth; {nearest(load, LOADS)}"
        yield load not in LOADS, "load", none
        rated = f"rated {self.load.rated:g} {load}; give the greatest load, above 0"
        yield not 0 < self.load.rated < math.inf, "load", rated
        none = f"{reading!r} is not a unit of a reading; {nearest(reading, READINGS)}"
        yield reading not in READINGS, "reading", none
        yield (
            self.low >= self.high,
            "reading",
            f"lowest {self.low:g} is not below highest {self.high:g}",
        )
        for key, value in (
            ("rate_hz", self.rate_hz),
            ("same_place_mm", self.same_place_mm),
        ):
            if value is not None:
                yield not 0 < value < math.inf, key, f"{value:g} is not above 0"
        both, by_place = "gain and offset", self.same_place_mm is not None
        shared = "is for one load that all cells share; remove it, or `shared: false`"
        yield by_place and not self.load.shared, "same_place_mm", shared
        fitted = "remove both; with same_place_mm a cell has a gain for each place, and is fitted"
        yield by_place and (self.gain or self.offset), both, fitted
        for key, numbers in (("gain", self.gain), ("offset", self.offset)):
            each = f"{len(numbers)} numbers for {self.num_cells} cells; give one for each cell, or none"
            yield numbers and len(numbers) != self.num_cells, key, each
        yield (
            bool(self.gain) != bool(self.offset),
            both,
            "give both, or neither (they are then fitted)",
        )

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of rows and columns; cells with names are one row."""
        return (
            (1, len(self.cells)) if self.cells else (self.rows or 0, self.columns or 0)
        )

    @property
    def num_cells(self) -> int:
        """K = rows × columns."""
        return math.prod(self.shape)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the cells, row after row."""
        rows, columns = self.shape
        return tuple(self.cells) or tuple(
            f"r{i}c{j}" for i in range(rows) for j in range(columns)
        )

    @property
    def known_facts(self) -> tuple[str, ...]:
        """Facts that recordings of this sensor can contain, except for the temperature, as keys of
        ``taccorl.sim.effects.effect.NEEDS``."""
        one_place = (
            self.same_place_mm is None
        )  # what spreads to neighbours is part of the gains of a place
        return (
            ("reading", "neighbours")
            if not self.cells and self.num_cells > 1 and one_place
            else ("reading",)
        )

    @property
    def low(self) -> float:
        """Lower end of the converter in the reading's unit; −∞ if the file states none."""
        return -math.inf if self.reading.lowest is None else self.reading.lowest

    @property
    def high(self) -> float:
        """Upper end of the converter in the reading's unit; ∞ if the file states none."""
        return math.inf if self.reading.highest is None else self.reading.highest

    @property
    def sign(self) -> float:
        """−1 if the reading decreases under load, else 1."""
        return -1.0 if self.reading.falls else 1.0

    @property
    def load_of_reading(self) -> float:
        """Load [``load.unit``] that corresponds to 1 in the unit ``reading``."""
        return self.load.rated / READINGS_OF_RATED

    def in_load_units(self, value: float, unit: str) -> tuple[float, str]:
        """Convert a number from a unit based on ``reading`` to one based on load, and return it with that unit: (0.4,
        "reading/min") → (0.8, "N/min") at 20 N rated."""
        if "reading" not in unit:
            return value, unit
        return value * self.load_of_reading, unit.replace("reading", self.load.unit)


def make_cells_effect(name: str, **values: Any) -> Effect:
    """Make the effect ``name`` of a sensor of cells with the parameters ``values``, in the units of the registry. Raises
    TaccorlError: as ``make_effect``, or the effect does not act on cells."""
    return _of_cells(make_effect(name, **values))


def _of_cells(effect: Effect) -> Effect:
    if "cells" not in effect.kinds() or not isinstance(effect, TouchEffect):
        raise TaccorlError(
            f"effects: {effect.name} acts on {', '.join(effect.kinds())}, not on cells; taccorl effects --for=cells lists the "
            "effects on cells"
        )
    return dataclasses.replace(effect, pads=[CELLS])


def load_cells(path: Path) -> CellsConfig:
    """Load a cells file. Raises SpecError: it is invalid; the message names file, line and key."""
    path = Path(path)
    document = EffectsDocument(CellsConfig, path)
    config: CellsConfig = document.value
    for k, effect in enumerate(config.effects):
        for word in effect.needs:
            text = (
                f"{effect.name} needs {word}; give rows and columns, not same_place_mm"
            )
            document.refuse(
                [
                    (
                        word not in (*config.known_facts, "temperature"),
                        f"effects/{k}",
                        text,
                    )
                ]
            )
    config.name = config.name or path.stem
    return config


def cells_text(config: CellsConfig) -> str:
    """YAML text of a cells file for ``config``."""
    plain = {
        f.name: value
        for f in dataclasses.fields(config)
        if f.name not in ("effects", "load", "reading")
        and (value := getattr(config, f.name)) not in (None, [])
    }
    plain |= {"load": _short(config.load), "reading": _short(config.reading)}
    for key in ("gain", "offset"):
        if key in plain:
            plain[key] = [float(f"{x:.12g}") for x in plain[key]]
    plain["effects"] = [
        {k: v for k, v in effect_entry(e).items() if k != "pads"}
        for e in config.effects
    ]
    return _HEADER + yaml.safe_dump(
        plain, sort_keys=False, allow_unicode=True, default_flow_style=None, width=120
    )


def _short(note: Load | Reading) -> dict[str, Any]:
    return {
        f.name: v
        for f in dataclasses.fields(note)
        if (v := getattr(note, f.name)) is not None
    }


def cells_digest(config: CellsConfig) -> str:
    """Digest of a sensor, 16 hexadecimal digits; only equal sensors have equal digests."""
    return hashlib.sha256(cells_text(config).encode()).hexdigest()[:16]


def save_cells(config: CellsConfig, path: Path) -> None:
    """Write ``cells_text`` to a file, which is replaced as a whole or not at all. Raises TaccorlError: it is read-only."""
    write_whole(path, cells_text(config))

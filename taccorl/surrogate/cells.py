"""A simulated sensor of force cells that is pressed, held and released; hidden effects act at 1 kHz, by independent equations.

    f → material → wires → gain, offset → temperature, drift → noise → converter (0 … 1023 counts)

The recorded load has its own noise, time stamps jitter by 1 ms, and half of the sensors have coloured noise. All files state
that they are simulated.

Letters in shapes: M milliseconds, T rows, K cells, R × C the grid.
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import fftconvolve

from taccorl.alignment.machines.cell_model import of_file
from taccorl.alignment.machines.cell_tables import CellMeasurement
from taccorl.alignment.machines.cells_file import (
    LOADS,
    CellsConfig,
    Load,
    Reading,
    save_cells,
)
from taccorl.alignment.measurements.folder import Measurements
from taccorl.alignment.measurements.presses import Knots, in_turn
from taccorl.data.origin import Origin
from taccorl.errors import TaccorlError, nearest
from taccorl.surrogate.robot import coloured
from taccorl.surrogate.touch_hidden import MILLISECOND, Values, material, spread
from taccorl.surrogate.writing import PRESSES, write_tables

ORIGIN = "simulated force cells"  # Text of the origin of every file
SENSOR = "taxel.yaml"  # Name of the cells file
RATE_HZ = 100.0  # Row rate of the recordings [Hz]
RATED_N = 20.0  # Rated load [N]
HIGHEST_COUNT = 1023  # Upper end of the converter [counts]
LOAD_NOISE = 5e-4  # Noise of the load cell, as a share of the rated load
HIDDEN: dict[str, Callable[[np.random.Generator], Values]] = {
    "taxel_saturation": lambda rng: {"limit": _between(rng, 8, 60)},
    "taxel_power_law": lambda rng: {
        "exponent": float(_between(rng, 1.1, 1.6) ** rng.choice([-1.0, 1.0]))
    },
    "taxel_threshold": lambda rng: {"threshold": _between(rng, 0.15, 1.0)},
    "taxel_hysteresis": lambda rng: {"half_width": _between(rng, 0.02, 0.15)},
    "taxel_play": lambda rng: {"half_width": _between(rng, 0.05, 0.6)},
    "taxel_creep": lambda rng: {
        "share": _either(rng, 0.05, 0.4),
        "time_constant_s": _between(rng, 0.3, 4.0),
    },
    "touch_lag": lambda rng: {"time_constant_s": _between(rng, 0.02, 0.15)},
    "touch_delay": lambda rng: {"delay_s": _between(rng, 0.02, 0.1)},
    "baseline_drift": lambda rng: {"rate_per_min": _either(rng, 0.1, 1.0)},
    "taxel_log_creep": lambda rng: {"share": _either(rng, 0.02, 0.08)},
    "taxel_temperature": lambda rng: {
        "gain_per_k": _either(rng, 0.003, 0.02),
        "zero_per_k": _either(rng, 0.01, 0.1),
    },
    "taxel_crosstalk": lambda rng: {"share": _between(rng, 0.05, 0.4)},
    "taxel_ghosting": lambda rng: {"share": _between(rng, 0.005, 0.05)},
}
"""Name of a hidden effect → function that draws its parameters, in the units of the registry; a reading of 10 is the rated
load."""
OF_GRIDS = (
    "taxel_crosstalk",
    "taxel_ghosting",
)  # Effects that only neighbouring cells can show


def _between(rng: np.random.Generator, low: float, high: float) -> float:
    """Evenly on a logarithmic scale."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _either(rng: np.random.Generator, low: float, high: float) -> float:
    """The same of either sign."""
    return float(rng.choice([-1.0, 1.0])) * _between(rng, low, high)


def _presses(*each: tuple[float, float, float]) -> Knots:
    """Presses one after the other: (share of the rated load, seconds of loading and unloading, seconds of hold)."""
    return in_turn(*each, rest_s=3.0, before_s=3.0)


_LOOPS: Knots = (
    *(
        (0.0, 0.0),
        (2.0, 0.0),
        (6.0, 0.6),
        (8.0, 0.3),
        (10.0, 0.8),
        (12.0, 0.5),
        (14.0, 0.95),
    ),
    *((34.0, 0.95), (36.0, 0.4), (38.0, 0.7), (42.0, 0.0), (52.0, 0.0)),
)
RECORDINGS: dict[str, tuple[str, Knots]] = {
    "presses": (
        "fit",
        _presses((0.3, 0.15, 3), (0.6, 0.4, 4), (0.95, 0.15, 4), (0.5, 2.0, 2)),
    ),
    "presses_again": (
        "fit",
        _presses((0.3, 0.15, 3), (0.6, 0.4, 4), (0.95, 0.15, 4), (0.5, 2.0, 2)),
    ),
    "loops": ("fit", _LOOPS),
    "other_presses": (
        "validation",
        _presses((0.85, 0.25, 3), (0.2, 0.1, 2), (0.7, 1.0, 5), (0.4, 0.15, 2)),
    ),
    "long_hold": ("validation", _presses((0.5, 3.0, 15), (0.9, 0.2, 2))),
    "last_presses": ("test", _presses((0.45, 0.2, 4), (0.9, 0.6, 6), (0.15, 0.5, 2))),
}
"""Name of a recording → use and load; presses_again repeats presses."""


@dataclass(frozen=True, kw_only=True)
class CellsCase:
    """One simulated sensor of force cells with its hidden effect."""

    seed: int  # Seed of everything that is drawn
    shape: tuple[int, int] = (1, 1)  # Rows and columns of the cells
    hidden: str = ""  # Name of the hidden effect, a key of ``HIDDEN``; empty for a sensor without one
    values: Values = field(
        default_factory=dict
    )  # Parameters of the hidden effect, in the units of the registry
    sensor: CellsConfig | None = (
        None  # Sensor of a user's file; None: a fingertip of 20 N with 0 … 1023 counts
    )

    def config(self) -> CellsConfig:
        """The sensor as known to its user: without the hidden effect."""
        if self.sensor is not None:
            return self.sensor
        rows, columns = self.shape
        grid: dict[str, Any] = (
            {"cells": ["thumb"]}
            if self.shape == (1, 1)
            else {"rows": rows, "columns": columns}
        )
        return CellsConfig(
            name="fingertip",
            **grid,
            load=Load(unit="N", rated=RATED_N, shared=self.shape == (1, 1)),
            reading=Reading(unit="count", lowest=0.0, highest=float(HIGHEST_COUNT)),
            rate_hz=RATE_HZ,
        )


def draw_cells(hidden: str, seed: int, sensor: CellsConfig | None = None) -> CellsCase:
    """Draw a sensor with the effect ``hidden`` (empty: none). It has 3 × 4 cells if only neighbours can show the effect.
    ``sensor``: sensor of a user's file, which then has the effect. Raises TaccorlError: there is no hidden effect of that
    name, or the user's sensor cannot have it."""
    if hidden and hidden not in HIDDEN:
        raise TaccorlError(
            f"simulated cells: no hidden effect {hidden!r}; {nearest(hidden, HIDDEN)}"
        )
    rng = np.random.default_rng([seed, 77])
    shape = (3, 4) if hidden in OF_GRIDS else (1, 1)
    if sensor is not None:
        shape = sensor.shape
        if hidden in OF_GRIDS and (min(shape) < 2 or sensor.load.shared):
            raise TaccorlError(
                f"{sensor.name}: {hidden} needs a grid of cells with a load each (rows, columns, shared: false); choose another"
            )
        name, known_size = (
            sensor.name,
            sensor.gain or math.isfinite(sensor.high - sensor.low),
        )
        if sensor.same_place_mm is not None:
            raise TaccorlError(
                f"{name}: simulated cells are pressed at one place; give the file without same_place_mm"
            )
        if sensor.effects:
            raise TaccorlError(
                f"{name}: its file has {sensor.effects[0].name}; give the file without effects"
            )
        if not known_size:
            raise TaccorlError(
                f"{name}: nothing states the size of its readings; write lowest and highest, or gain"
            )
    values = HIDDEN[hidden](rng) if hidden else {}
    return CellsCase(
        seed=seed, shape=shape, hidden=hidden, values=values, sensor=sensor
    )


def simulated(case: CellsCase) -> Measurements:
    """Simulated recordings of the sensor (``RECORDINGS``), divided into fit, validation and test."""
    sides: dict[str, list[CellMeasurement]] = {"fit": [], "validation": [], "test": []}
    for name, (use, _) in RECORDINGS.items():
        sides[use].append(record(case, name))
    return Measurements(
        *(tuple(sides[use]) for use in ("fit", "validation", "test")), rule="by name"
    )


def record(case: CellsCase, name: str) -> CellMeasurement:
    """Simulate the recording ``name``, a key of ``RECORDINGS``: the load as measured by a load cell, and readings; 100 rows per
    second if the file states no rate."""
    board = np.random.default_rng([case.seed, 1])
    cells = math.prod(case.shape)
    gain = board.uniform(45, 85) * np.exp(
        0.15 * board.standard_normal(cells)
    )  # counts for 1/10 of the rated load
    offset = board.uniform(5, 60, cells)
    noise_count = board.uniform(0.5, 1.5)
    coloured_count = noise_count if board.random() < 0.5 else 0.0
    config = case.config()
    rate_hz, rated = config.rate_hz or RATE_HZ, config.load.rated
    counted = config.reading.unit == "count"
    if case.sensor is not None:
        calibration, step = of_file(config), (config.high - config.low) / HIGHEST_COUNT
        step = (
            step
            if math.isfinite(step)
            else float(np.abs(calibration.gain).mean()) / 65.0
            if calibration
            else 1.0
        )
        gain, offset = calibration or (
            config.sign * step * gain,
            (config.low if config.sign > 0 else config.high)
            + config.sign * step * offset,
        )
        noise_count, coloured_count = step * noise_count, step * coloured_count
    rng = np.random.default_rng([case.seed, 2, list(RECORDINGS).index(name)])

    knots = np.array(RECORDINGS[name][1])
    stretched = knots[:, 0] * (
        1.0 + 0.002 * rng.standard_normal()
    )  # no two presses are alike
    time_ms = np.arange(0.0, stretched[-1], MILLISECOND)
    load = _rounded(
        np.interp(
            time_ms, stretched, knots[:, 1] * (1.0 + 0.005 * rng.standard_normal())
        )
    )
    places = np.linspace(0, 2 * np.pi, cells, endpoint=False)
    moves = 0.5 + 0.5 * np.sin(2 * np.pi * time_ms[:, None] / 11.0 + places)
    pressed = (
        10.0 * load[:, None] * (np.ones_like(moves) if config.load.shared else moves)
    )  # (M, K)
    warm_k = 5.0 + 6.0 * np.sin(2 * np.pi * time_ms / 37.0 + rng.uniform(0, 6))

    true = _hidden(case, pressed, time_ms, warm_k)
    stamps = np.arange(0.005, time_ms[-1] - 0.01, 1 / rate_hz) + 1e-3 * rng.uniform(
        -1, 1
    )
    rows = np.clip(
        np.unique(np.round(stamps / MILLISECOND).astype(int)), 0, len(time_ms) - 1
    )
    noise = noise_count * rng.standard_normal(
        (len(rows), cells)
    ) + coloured_count * _coloured(rng, len(rows), cells)
    value = gain * true[rows] + offset + noise
    count = np.clip(np.round(value) if counted else value, config.low, config.high)
    load_noise = rng.standard_normal((len(rows), 1 if config.load.shared else cells))
    force = pressed[rows] / 10.0 * rated + LOAD_NOISE * rated * load_noise
    measured = CellMeasurement(
        name=name,
        time_s=time_ms[rows] - time_ms[rows[0]],
        target=force,
        measured=count,
        signals=config.names,
        units=(config.reading.unit,) * cells,
        quantum=np.full(cells, float(counted)),
        origin=Origin("surrogate", ORIGIN),
        repeat_of="presses" if name == "presses_again" else None,
        temperature_c=20.0 + warm_k[rows],
    )
    return measured.resampled(rate_hz)


def write_cells(case: CellsCase, folder: Path) -> int:
    """Write the recordings and files of a simulated sensor of force cells, and its hidden effect in a sealed file, as
    ``taccorl.surrogate.writing`` does for robots.

    FOLDER/presses/*.csv, measurements.yaml, columns.yaml    for ``taccorl compare`` and ``diagnose``
    FOLDER/taxel.yaml                                        the sensor as known to its user; not of a user's own file

    Returns number of recordings. Raises FileExistsError: the folder exists."""
    config, made = case.config(), simulated(case)
    kind, unit, shared = (
        LOADS[config.load.unit][0],
        config.reading.unit,
        config.load.shared,
    )
    load = [kind] if shared else [f"{name}.{kind}" for name in config.names]

    def of(column: str, unit: str) -> dict[str, str]:
        return {"column": column, "unit": unit}

    spec: dict[str, Any] = {
        "time": of("t", "s"),
        "temperature": {"column": "temperature_c"},
    }
    spec |= {"domain": "surrogate", "origin": ORIGIN} | (
        {"load": of(kind, config.load.unit)} if shared else {}
    )
    own = {
        name: {} if shared else {"load": of(f"{name}.{kind}", config.load.unit)}
        for name in config.names
    }
    spec["cells"] = {
        name: {"reading": of(f"{name}.reading", unit)} | pressed
        for name, pressed in own.items()
    }

    def table(m: CellMeasurement) -> dict[str, np.ndarray]:
        readings = {
            f"{cell}.reading": own
            for cell, own in zip(config.names, m.measured.T, strict=True)
        }
        pressed = dict(zip(load, m.target.T, strict=False))
        return {"t": m.time_s} | pressed | readings | {"temperature_c": m.temperature_c}

    truth = {
        "data": ORIGIN,
        "seed": case.seed,
        "hidden": case.hidden,
        "values": case.values,
    }
    write_tables(folder, PRESSES, spec, made, table, truth)
    if case.sensor is None:
        save_cells(config, folder / SENSOR)
    return len(RECORDINGS)


def _hidden(
    case: CellsCase, pressed: np.ndarray, time_s: np.ndarray, warm_k: np.ndarray
) -> np.ndarray:
    """(M, K) what the cells read, in tenths of the rated load, with the hidden effect."""
    match case.hidden:
        case "":
            return pressed
        case "baseline_drift":
            return pressed + case.values["rate_per_min"] * (time_s / 60.0)[:, None]
        case "taxel_temperature":
            warmer = warm_k[:, None]
            return (
                pressed * (1 + case.values["gain_per_k"] * warmer)
                + case.values["zero_per_k"] * warmer
            )
        case "taxel_play":
            return _from_turning_points(pressed, case.values["half_width"])
        case "taxel_log_creep":
            return _boltzmann(pressed, case.values["share"])
        case "taxel_crosstalk" | "taxel_ghosting":
            frames = pressed.reshape(-1, *case.shape)
            return spread(case.hidden, case.values, frames).reshape(pressed.shape)
    return material(
        case.hidden, case.values, pressed, np.gradient(pressed, MILLISECOND, axis=0)
    )


def _from_turning_points(pressed: np.ndarray, half_width: float) -> np.ndarray:
    """Play, branch by branch: from each turning point of the load the reading stays until the load has gone back by the width."""
    out = np.empty_like(pressed)
    for k, load in enumerate(pressed.T):
        steps = np.sign(np.diff(load))
        moving = np.flatnonzero(steps)
        turns = moving[1:][np.diff(steps[moving]) != 0]
        ends, held = [0, *turns.tolist(), len(load)], 0.0
        for begin, end in itertools.pairwise(ends):
            branch = load[begin:end]
            rising = branch[-1] >= branch[0]
            own = (
                np.maximum(held, branch - half_width)
                if rising
                else np.minimum(held, branch + half_width)
            )
            out[begin:end, k] = own
            held = own[-1]
    return out


def _boltzmann(pressed: np.ndarray, share: float) -> np.ndarray:
    """Reading under ``pressed``: the sum of its steps, each times 1 + a log₁₀(1 + t / 0.018 s) after t seconds."""
    kernel = 1.0 + share * np.log10(1.0 + np.arange(len(pressed)) * MILLISECOND / 0.018)
    steps = np.diff(pressed, axis=0, prepend=0.0)
    return np.maximum(fftconvolve(steps, kernel[:, None], axes=0)[: len(pressed)], 0.0)


def _rounded(load: np.ndarray) -> np.ndarray:
    """Corners rounded over 50 ms: nothing presses with a kink."""
    width = 50
    padded = np.concatenate([np.full(width, load[0]), load, np.full(width, load[-1])])
    kernel = np.hanning(width + 2)[1:-1]
    return np.convolve(padded, kernel / kernel.sum(), mode="same")[width:-width]


def _coloured(rng: np.random.Generator, rows: int, cells: int) -> np.ndarray:
    """(T, K) of standard deviation 1 that is correlated over 0.1 s, from 0 on."""
    drawn = rng.standard_normal((rows, cells))
    drawn[0] = 0.0
    return coloured(drawn, math.exp(-1 / (0.1 * RATE_HZ)))

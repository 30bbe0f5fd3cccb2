"""Data spec of a tactile sensor: its taxels, the format of its frames, the rules from counts to readings; units of data specs."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from taccorl.data.strict_yaml import Document, Rules, check_version
from taccorl.errors import nearest

UNITS = (
    *(
        "rad",
        "rad/s",
        "rad/s2",
        "m",
        "m/s",
        "m/s2",
        "wxyz",
        "N",
        "Nm",
        "Pa",
        "kg",
        "A",
        "V",
        "W",
        "K",
        "s",
        "Hz",
        "1",
    ),
    *("T", "adc_count", "rgb8", "unknown"),
)
"""Units of features and sensors: SI; wxyz: a unit quaternion; 1: a number without unit; unknown: of others' datasets."""
OTHER_UNITS = {
    **dict.fromkeys(("deg", "degs", "degree", "degrees", "°"), ("rad", "0.0174533")),
    **dict.fromkeys(("deg/s", "degrees/s", "°/s", "dps"), ("rad/s", "0.0174533")),
    **dict.fromkeys(("mm", "millimetre", "millimeter"), ("m", "0.001")),
    **dict.fromkeys(("cm", "centimetre", "centimeter"), ("m", "0.01")),
    **{
        u: (si, "0.001")
        for u, si in {"mm/s": "m/s", "mA": "A", "mV": "V", "mT": "T", "ms": "s"}.items()
    },
    "rpm": ("rad/s", "0.104720"),
    "Ncm": ("Nm", "0.01"),
    "kPa": ("Pa", "1000"),
    "%": ("1", "0.01"),
}
"""Unit that drivers send → the unit of the dataset and the factor to it."""


@dataclass(frozen=True, kw_only=True)
class WireSpec:
    """Format of one pad frame as sent by the sensor: ``rows × columns`` values of ``dtype``, row after row. ``transpose``: wire
    rows are pad columns, so the frame is transposed to the pad's rows × columns."""

    rows: int
    columns: int
    dtype: Literal["uint8", "uint16"]
    transpose: bool


@dataclass(frozen=True, kw_only=True)
class BaselineSpec:
    """Rule for the counts without contact: per taxel, the median of the recording's first ``frames`` frames. A pad whose frames
    spread more about it [counts, 0.99 quantile] is not at rest and gets no baseline."""

    rule: Literal["median_of_first"]
    frames: int
    max_spread_count: float


@dataclass(frozen=True, kw_only=True)
class SensorSpec:
    """One kind of tactile pad: its taxels, the format of its frames, and how converter counts become normalised readings."""

    spec_version: int
    name: str
    rows: int
    columns: int
    wire: WireSpec
    adc_bits: int
    wire_shift_bits: int
    """The firmware drops this many low bits of the ADC before sending (10-bit ADC as a byte: 2)."""
    rate_hz: float
    scan_time_s: float
    """Time to scan the whole pad [s]; the stamp is its end. ``rate_hz``: scans of a pad per second."""
    unit: str
    baseline: BaselineSpec
    noise_count: float
    """Largest value of an untouched taxel [counts above baseline]."""
    scheme: Literal["fixed_scale"]
    gain_per_count: float
    """Normalised reading = (counts − baseline) × gain. Datasets store counts; the policy's preprocessor applies the gain."""

    @property
    def max_count(self) -> int:
        """Largest count that the sensor sends: (2^bits − 1) >> shift."""
        return (2**self.adc_bits - 1) >> self.wire_shift_bits


def load_sensor_spec(path: Path) -> SensorSpec:
    """Load a sensor file, as those in ``data_specs/sensors``. Raises SpecError: with file, line, key and value."""
    document = Document(SensorSpec, path)
    check_version(document, document.value.spec_version)
    document.refuse(_sensor_rules(document.value))
    return document.value


def _sensor_rules(spec: SensorSpec) -> Rules:
    for key in (
        "rows",
        "columns",
        "adc_bits",
        "rate_hz",
        "scan_time_s",
        "gain_per_count",
        "baseline/frames",
    ):
        value = spec.baseline.frames if "/" in key else getattr(spec, key)
        yield value <= 0, key, f"{value:g} is not above 0"
    bits = f"{spec.wire_shift_bits} of {spec.adc_bits} bits leave no bit for the count"
    yield not 0 <= spec.wire_shift_bits < spec.adc_bits <= 32, "wire_shift_bits", bits
    pad, wire = (spec.rows, spec.columns), (spec.wire.rows, spec.wire.columns)
    text = f"{wire[0]}×{wire[1]} with transpose: {spec.wire.transpose} does not give the pad's {pad[0]}×{pad[1]}"
    yield (wire[::-1] if spec.wire.transpose else wire) != pad, "wire", text
    yield unit_rule("unit", spec.unit)
    counts, dtype = f"{spec.max_count} counts do not fit the", spec.wire.dtype
    yield spec.max_count > np.iinfo(dtype).max, "wire/dtype", f"{counts} wire's {dtype}"
    yield (
        spec.max_count > np.iinfo(np.int16).max,
        "adc_bits",
        f"{counts} dataset's int16",
    )


def unit_rule(where: str, unit: str) -> tuple[bool, str, str]:
    text = f"{unit!r} is not a unit of datasets; {nearest(unit, UNITS)}"
    if unit in OTHER_UNITS:
        other, factor = OTHER_UNITS[unit]
        text = f"{unit!r}: datasets hold {other}; convert with `scale: [{factor}]` on the channel (one factor for each "
        text += f"value that it picks) and write {other} here"
    return unit not in UNITS, where, text

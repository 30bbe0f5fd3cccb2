"""FlexiTac-V2: 32 × 12 taxels a pad, normal channel only, one byte a taxel, about 100 scans a second.

Law (paper eq. 10): f = [k_n δ + k_d δ̇]₊ where δ > 0. The reading f has the unit of the policy's normalised reading: with the
default gain 1 is 75 counts, since the data spec's gain is 1/75 a count, and contact is f > λ_f = 0.4, 30 counts.

k_n and the gain are a choice, not a measurement: 10 N on a whole sprung pad (2e4 N/m: 0.5 mm) read f = 0.6 at the deepest
taxel, 45 counts; 40 N, all that the gripper has, read 180, which every taxel can still send.
No force calibration of these boards
is known to us; alignment fits both on a robot.

Board and wire: data_specs/sensors/flexitac_v2.yaml. Letters in shapes: as in ``taccorl.sim.sensors``, S samples.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np

from taccorl.data.sensor_spec import SensorSpec, load_sensor_spec
from taccorl.data.spec import find_spec
from taccorl.errors import TaccorlError
from taccorl.sim.sensors import (
    Noise,
    Sensor,
    SensorConfig,
    Transform,
    as_wire,
    sensors,
    standard_normal,
)


def normal_reading(
    depth_m: np.ndarray,
    depth_rate_mps: np.ndarray,
    stiffness_per_m: float,
    damping_s_per_m: float,
) -> np.ndarray:
    """Reading of a spring-damper taxel, paper eq. 10: [k_n δ + k_d δ̇]₊, and 0 where δ is 0. It is never negative.

    ``depth_m`` δ and ``depth_rate_mps`` δ̇ have one shape (…), which is that of the result; ``stiffness_per_m`` is k_n,
    ``damping_s_per_m`` k_d. A reading has no unit."""
    reading = stiffness_per_m * depth_m + damping_s_per_m * depth_rate_mps
    return np.maximum(reading, 0) * (depth_m > 0)


def scan_instants_s(spec: SensorSpec) -> np.ndarray:
    """Times (wire rows,) before the stamp at which each row of the wire is read: middles of equal parts of the scan [s]."""
    share = (np.arange(spec.wire.rows) + 0.5) / spec.wire.rows
    return (share - 1) * spec.scan_time_s


def at_scan_instants(
    samples: np.ndarray, time_s: np.ndarray, spec: SensorSpec
) -> np.ndarray:
    """``samples`` (S, ..., R, C) at times ``time_s`` (S,) [s] → (..., R, C): each row of the wire at its own instant, by linear
    interpolation. Raises TaccorlError: times are not ascending, or do not cover the scan."""
    instants_s = scan_instants_s(spec)
    times = np.asarray(time_s, float)
    if (
        times.shape != samples.shape[:1]
        or (np.diff(times) <= 0).any()
        or times[0] > instants_s[0]
        or times[-1] < instants_s[-1]
    ):
        raise TaccorlError(
            f"sensor {spec.name}: {len(samples)} samples at {times.tolist()} s; times must be ascending and cover the scan, "
            f"{instants_s[0]:.4f} to {instants_s[-1]:.4f} s before the stamp"
        )
    after = np.clip(np.searchsorted(times, instants_s, side="right"), 1, len(times) - 1)
    weight = (
        (instants_s - times[after - 1]) / (times[after] - times[after - 1])
    ).astype(samples.dtype)
    on_wire = as_wire(samples, spec)
    row = np.arange(spec.wire.rows)
    # Both picks stand first: (wire rows, ..., wire columns)
    earlier, later = on_wire[after - 1, ..., row, :], on_wire[after, ..., row, :]
    weight = weight.reshape(-1, *[1] * (earlier.ndim - 1))
    return as_wire(np.moveaxis(earlier + weight * (later - earlier), 0, -2), spec)


class FlexiTac(Sensor):
    """FlexiTac pads with the settings of ``FlexiTacConfig``. They have no state except for that of transforms with a memory."""

    def __init__(
        self,
        config: "FlexiTacConfig",
        spec: SensorSpec,
        pads: Sequence[str],
        transforms: Sequence[Transform],
    ) -> None:
        shape = (len(pads), spec.rows, spec.columns)
        low, high = config.resting_count
        # In the middle of a step of the converter, so that a reading of ± ½ count does not show.
        self._resting = (
            np.random.default_rng(config.seed).integers(low, high + 1, shape) + 0.5
        )
        super().__init__(
            spec, pads, np.floor(self._resting).astype(np.int64), transforms
        )
        self._config = config

    def reading(
        self, depth_m: np.ndarray, depth_rate_mps: np.ndarray, time_s: np.ndarray | None
    ) -> np.ndarray:
        shape = (*depth_m.shape[:-1], self.spec.rows, self.spec.columns)
        if time_s is None and depth_m.dtype == depth_rate_mps.dtype == np.float32:
            reading = np.empty(shape, np.float32)
            stiffness, damping = (
                self._config.normal_stiffness_per_m,
                self._config.normal_damping_s_per_m,
            )
            _read(
                depth_m.ravel(),
                depth_rate_mps.ravel(),
                np.float32(stiffness),
                np.float32(damping),
                reading.ravel(),
            )
            return reading
        grids = [a.reshape(shape) for a in (depth_m, depth_rate_mps)]
        if time_s is not None:
            grids = [at_scan_instants(grid, time_s, self.spec) for grid in grids]
        return normal_reading(
            *grids,
            self._config.normal_stiffness_per_m,
            self._config.normal_damping_s_per_m,
        )

    def clean_counts(self, reading: np.ndarray) -> np.ndarray:
        return self._config.gain_count * reading

    def digitise(self, reading: np.ndarray, noise: Noise) -> np.ndarray:
        normal = standard_normal(noise, reading.shape)
        if normal is None:
            normal = np.zeros(reading.shape, np.float32)
        counts = np.empty(reading.shape, self.spec.wire.dtype)
        settings = (
            np.float32(self._config.gain_count),
            np.float32(self._config.noise_std_count),
        )
        flat = (len(reading), self._resting.size)
        _convert(
            reading.reshape(flat),
            normal.reshape(flat),
            self._resting.astype(np.float32).ravel(),
            *settings,
            np.float32(self.spec.max_count),
            counts.reshape(flat),
        )
        return counts


# Compiled for batches: without Python's lock, and each number is read once.
@numba.njit(nogil=True, cache=True)
def _read(
    depth: np.ndarray,
    rate: np.ndarray,
    stiffness: np.float32,
    damping: np.float32,
    reading: np.ndarray,
) -> None:
    """``normal_reading``, all flat float32."""
    for k in range(depth.size):
        force = stiffness * depth[k] + damping * rate[k]
        reading[k] = force if depth[k] > 0 and force > 0 else np.float32(0)


@numba.njit(nogil=True, cache=True)
def _convert(
    reading: np.ndarray,
    normal: np.ndarray,
    resting: np.ndarray,
    gain: np.float32,
    noise_std: np.float32,
    most: np.float32,
    counts: np.ndarray,
) -> None:
    """Counts (N, P K) of readings, noise and resting counts (P K,)."""
    for n in range(len(reading)):
        for k in range(resting.size):
            value = (gain * reading[n, k] + resting[k]) + noise_std * normal[n, k]
            # The converter cuts off what is below its step, and sends all but its low bits: in counts of the wire, floor.
            counts[n, k] = int(min(max(value, np.float32(0)), most))


@sensors.register("flexitac")
@dataclass(kw_only=True)
class FlexiTacConfig(SensorConfig):
    """Settings of simulated FlexiTac-V2 pads: sensor file, law, gain, resting counts, noise."""

    spec: str = "flexitac_v2"
    """Sensor file with taxels, wire format, converter and scan: a name in data_specs/sensors, or a path."""
    normal_stiffness_per_m: float = 1200.0
    """k_n: reading per metre of depth. A choice; the module's docstring gives the reason."""
    normal_damping_s_per_m: float = 6.0
    """k_d: reading per m/s of depth rate. A choice: k_d / k_n = 5 ms, 5 counts at a closing speed of 10 mm/s."""
    gain_count: float = 75.0
    """Counts per reading of 1."""
    resting_count: tuple[int, int] = (10, 40)
    """Lowest and highest resting count of a taxel; each taxel draws its own from ``seed``."""
    noise_std_count: float = 1.3
    """Standard deviation of a taxel's noise [counts], independent between scans. A choice, as in the stand-in recordings; the
    boards' own no-contact threshold is 15 counts."""

    def build(
        self, pads: Sequence[str], transforms: Sequence[Transform] = ()
    ) -> FlexiTac:
        """Build the sensor of these pads, in their order. ``transforms`` (effects) act on the reading: after the law, before
        gain and noise. Raises TaccorlError: a setting is not possible for a board."""
        spec = load_sensor_spec(find_spec(self.spec))
        low, high = self.resting_count
        if not 0 <= low <= high < spec.max_count:
            raise TaccorlError(
                f"flexitac: resting_count {low} … {high}; needs 0 ≤ lowest ≤ highest < {spec.max_count}"
            )
        for name in (
            "normal_stiffness_per_m",
            "normal_damping_s_per_m",
            "gain_count",
            "noise_std_count",
        ):
            if not 0 <= getattr(self, name) < np.inf:
                raise TaccorlError(
                    f"flexitac: {name} {getattr(self, name)}; needs 0 or more"
                )
        return FlexiTac(self, spec, pads, transforms)

"""Effects of pads and of sensors of cells: mount, material, wiring and baseline; those with a memory are in ``touch_memory``."""

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import field
from typing import TYPE_CHECKING, ClassVar

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.effects.effect import BoardEffect, Memory, TouchEffect, effect, number

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig

NOMINAL_C = 20.0
"""Temperature at which ``taxel_temperature`` does nothing [°C]; simulations have this temperature."""


class PadFrameEffect(TouchEffect):
    """Base of effects that move the frame of a pad's taxels in the finger, and the pad's box with it if the effect says so.

    ``edit`` changes the twin's model. The calibration of touch (``taccorl.alignment.touch.model``) works without that model: it
    evaluates the depths at positions displaced by ``offset_pad_m``."""

    def offset_pad_m(self, pad: str) -> np.ndarray:
        """(3,) displacement of the taxels of ``pad`` [m] in the pad's frame: across, from palm to tip, out of the pad. The
        direction "across" is +x of the TCP for fingers a and −x for fingers b."""
        raise NotImplementedError

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for pad in self.pads:
            offset, site = self.offset_pad_m(pad), spec.site(pad)
            finger_from_pad = Rotation.from_quat(site.quat, scalar_first=True)
            site.pos += finger_from_pad.apply(offset)
            # The box's body has the finger's orientation. A film glued on askew does not take its backing along.
            spec.geom(pad).pos += finger_from_pad.apply([0.0, 0.0, offset[2]])


@effect("depth_offset", slot="robot", needs="depth")
class DepthOffset(PadFrameEffect):
    """Offset of the depth: δ = δ_model + d, as by a pad (box and taxels) that is thicker by d and touches at an opening that is
    greater by d.

    In a replay of a measured opening, every taxel is deeper by d. In the simulation, contact begins earlier, and the same
    command presses harder."""

    offset_m: float = number(
        "d",
        "m",
        0,
        1e-4,
        (-1e-3, 1e-3),
        "a choice: pads are cut by hand, 3.6 mm thick (FlexiTac simulation settings)",
    )

    def offset_pad_m(self, pad: str) -> np.ndarray:
        return np.array([0.0, 0.0, self.offset_m])


@effect("pad_shift", slot="robot", needs="depth")
class PadShift(PadFrameEffect):
    """Displacement of the taxels on the pad: each taxel reads what is s further along x of the TCP (across the hand) and t
    further towards the finger tips. The rubber is not displaced.

    On both pads of a hand, an object that is displaced by (−s, −t) from its assumed position has the same effect."""

    across_m: float = number("s", "m", 0, 2e-3, (-6e-3, 6e-3), "a choice: a taxel")
    along_m: float = number("t", "m", 0, 2e-3, (-6e-3, 6e-3), "a choice: a taxel")

    @classmethod
    def starts(cls, seen: Mapping[str, float]) -> list[dict[str, float]]:
        """Start values of a search, parameter → value each: half a taxel in each direction. At larger shifts contact areas
        that do not overlap give no gradient."""
        half = 1e-3
        return [
            {"across_m": s, "along_m": t}
            for s, t in ((half, 0.0), (-half, 0.0), (0.0, half), (0.0, -half))
        ]

    def offset_pad_m(self, pad: str) -> np.ndarray:
        return np.array(
            [(1.0 if pad.endswith("_a") else -1.0) * self.across_m, self.along_m, 0.0]
        )


@effect("pad_compliance", slot="robot", needs="contact")
class PadCompliance(TouchEffect):
    """Stiffness of a pad: k times ``robot.pad_stiffness_n_per_m``. The same force compresses the pad by 1 / k of the depth.

    A sensor's gain changes readings in the same way; only the opening of the fingers distinguishes the two."""

    stiffness_factor: float = number(
        "k", "1", 1, 0.5, (0.05, 20), "a choice, as the nominal stiffness is"
    )

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        if config.robot.pads != "sprung":
            raise TaccorlError(
                f"effect pad_compliance: pads are {config.robot.pads}; set robot.pads to sprung"
            )
        for pad in self.pads:
            for joint in spec.joint(f"{pad}_spring").parent.joints:
                joint.stiffness[0] *= self.stiffness_factor


class _ScanEffect(TouchEffect):
    """Base of touch effects without a memory."""

    windows: ClassVar = True

    def law(self, own: np.ndarray, time_s: np.ndarray) -> np.ndarray:
        """Readings (N, P, R, C) of the chosen pads for those of ideal ones, ``own``; ``time_s`` as in ``reading``."""
        raise NotImplementedError

    def reading(
        self, reading: np.ndarray, memory: Memory, time_s: np.ndarray, dt_s: np.ndarray
    ) -> np.ndarray:
        reading, own = reading.copy(), reading[:, self.slots]
        reading[:, self.slots] = self.law(own, time_s)
        return reading


@effect("taxel_power_law", slot="material")
class TaxelPowerLaw(_ScanEffect):
    """Nonlinear characteristic of the taxels: r = f₀ (f / f₀)^p. Readings equal to f₀ do not change.

    p > 1 is steeper at high pressure, as for a ball on a soft half-space (Hertz); p < 1 is flatter, as for resistive foils."""

    exponent: float = number(
        "p", "1", 1, 1.5, (0.3, 3), "Hertz: 3/2 for a ball on a half-space"
    )
    reference: float = number(
        "f₀", "reading", None, 1, (0.1, 10),
        "a choice: where the linear law was calibrated; a reading of 1 is 75 counts",
    )  # fmt: skip

    @classmethod
    def starts(cls, seen: Mapping[str, float]) -> list[dict[str, float]]:
        """Start values of a search, parameter → value each: steeper and flatter. The reference f₀ has one start only, because
        changing it is equivalent to changing k_n."""
        return [{"exponent": 1.4}, {"exponent": 0.75}]

    def law(self, own: np.ndarray, time_s: np.ndarray) -> np.ndarray:
        with np.errstate(
            divide="ignore", invalid="ignore"
        ):  # 0 and less to a power, where nothing touches
            return own * np.where(
                own > 0, (own / self.reference) ** (self.exponent - 1.0), 1.0
            )


@effect("taxel_saturation", slot="material")
class TaxelSaturation(_ScanEffect):
    """Saturation of the taxels: r = f / (1 + f / f_s), which is the output of a voltage divider whose other resistor equals the
    taxel's at f = f_s. r remains below f_s."""

    limit: float = number(
        "f_s", "reading", math.inf, 4, (0.05, 2000),
        "a choice: 300 counts, above what the converter sends; resistive taxels saturate by their voltage divider",
    )  # fmt: skip

    @classmethod
    def starts(cls, seen: Mapping[str, float]) -> list[dict[str, float]]:
        """Start values of a search, parameter → value each: strong and weak saturation relative to the largest reading in the
        recordings (``peak_reading``)."""
        return [
            {"limit": cls.clipped("limit", share * seen.get("peak_reading", 1.0))}
            for share in (1.0, 4.0)
        ]

    def law(self, own: np.ndarray, time_s: np.ndarray) -> np.ndarray:
        return own / (1.0 + np.abs(own) / own.dtype.type(self.limit))


@effect("taxel_threshold", slot="material")
class TaxelThreshold(_ScanEffect):
    """Threshold of the readings: r = [f − t]₊, because foils touch each other only from t on, or because a driver cuts off small
    values."""

    threshold: float = number(
        "t",
        "reading",
        0,
        0.1,
        (0, 3),
        "a choice: 7.5 counts, half of the boards' threshold",
    )

    def law(self, own: np.ndarray, time_s: np.ndarray) -> np.ndarray:
        return np.maximum(own - own.dtype.type(self.threshold), 0)


@effect("taxel_crosstalk", slot="spread", needs=("reading", "neighbours"))
class TaxelCrosstalk(_ScanEffect):
    """Crosstalk between neighbouring taxels of a row or column: r = f + c/4 Σ (f_neighbour − f). A taxel keeps 1 − c of its
    reading and adds c/4 of it to each neighbour.

    At the edge a taxel keeps the shares of missing neighbours, so that the sum over a pad does not change."""

    share: float = number(
        "c",
        "1",
        0,
        0.1,
        (0, 0.8),
        "a choice; covers carry load sideways, taxels share wires",
    )

    def law(self, own: np.ndarray, time_s: np.ndarray) -> np.ndarray:
        spread = own.copy()
        for axis in (2, 3):
            flow = (
                0.25 * self.share * np.diff(own, axis=axis)
            )  # from each taxel's next one into it
            first = (slice(None),) * axis
            spread[*first, :-1] += flow
            spread[*first, 1:] -= flow
        return spread


@effect("taxel_ghosting", slot="spread", needs=("reading", "neighbours"))
class TaxelGhosting(_ScanEffect):
    """Ghosting along the wires of rows and columns: r_ij = f_ij + g (Σ_k f_ik + Σ_k f_kj − 2 f_ij). Every other taxel on a
    taxel's two wires adds the share g of its reading."""

    share: float = number(
        "g",
        "1",
        0,
        0.01,
        (0, 0.2),
        "a choice; some 5 to 20 taxels of a row are pressed at once",
    )

    def law(self, own: np.ndarray, time_s: np.ndarray) -> np.ndarray:
        others = (
            own.sum(axis=3, keepdims=True) + own.sum(axis=2, keepdims=True) - 2 * own
        )
        return own + own.dtype.type(self.share) * others


@effect("baseline_drift", slot="baseline")
class BaselineDrift(_ScanEffect):
    """Linear drift of the readings: r = f + b t, with the time t since the reset, at which the baseline was taken.

    A reading of 1 is 75 counts. Counts cannot fall below the converter's 0."""

    rate_per_min: float = number(
        "b", "reading/min", 0, 0.1, (-2, 2),
        "a choice: 7.5 counts a minute, half of the no-contact threshold in two",
    )  # fmt: skip

    def law(self, own: np.ndarray, time_s: np.ndarray) -> np.ndarray:
        return own + (self.rate_per_min / 60.0 * time_s)[:, None, None, None].astype(
            own.dtype
        )


@effect("taxel_temperature", slot="baseline", needs=("reading", "temperature"))
class TaxelTemperature(_ScanEffect):
    """Influence of the temperature ϑ on the readings: r = (1 + α (ϑ − 20 °C)) f + β (ϑ − 20 °C). ϑ is recorded together with the
    readings."""

    only: ClassVar = ("cells",)  # recordings of pads hold no temperature
    gain_per_k: float = number(
        "α", "1/K", 0, 0.005, (-0.1, 0.1), "a choice: half a per cent a kelvin"
    )
    zero_per_k: float = number("β", "reading/K", 0, 0.02, (-1, 1))

    def __post_init__(self) -> None:
        super().__post_init__()
        self._above_nominal_k = np.zeros(1)

    @classmethod
    def starts(cls, seen: Mapping[str, float]) -> list[dict[str, float]]:
        """Start values of a search, parameter → value each: gain up and down, zero up and down."""
        pairs = ((0.005, 0.0), (-0.005, 0.0), (0.0, 0.02), (0.0, -0.02))
        return [{"gain_per_k": gain, "zero_per_k": zero} for gain, zero in pairs]

    def at(self, temperature_c: np.ndarray) -> "TaxelTemperature":
        """The effect for readings (N, P, R, C) of N simulations at ``temperature_c`` (N,) [°C]."""
        found = copy.copy(self)
        found._above_nominal_k = np.asarray(temperature_c, dtype=float) - NOMINAL_C
        return found

    def law(self, own: np.ndarray, time_s: np.ndarray) -> np.ndarray:
        warmer = self._above_nominal_k[:, None, None, None].astype(own.dtype)
        return own + warmer * (
            own.dtype.type(self.gain_per_k) * own + own.dtype.type(self.zero_per_k)
        )


@effect("dead_taxels", slot="taxel")
class DeadTaxels(BoardEffect):
    """Taxels that always read 0: a share of each pad's taxels, drawn once from ``seed``. The dead taxels of a smaller share are
    also dead at a greater one."""

    share: float = number("s", "1", 0, 0.05, (0, 1))

    def dead(self, shape: tuple[int, int, int]) -> np.ndarray:
        """(pads, rows, columns) bool, of the given ``shape``: round(s · taxels) dead taxels of each pad, also of pads that are
        not selected."""
        num_pads, num_taxels = shape[0], math.prod(shape[1:])
        rank = np.random.default_rng(self.seed).permuted(
            np.tile(np.arange(num_taxels), (num_pads, 1)), axis=1
        )
        return (rank < round(self.share * num_taxels)).reshape(shape)

    def reading(
        self, reading: np.ndarray, memory: Memory, time_s: np.ndarray, dt_s: np.ndarray
    ) -> np.ndarray:
        reading = reading.copy()
        reading[:, self.slots] *= ~self.dead(reading.shape[1:])[self.slots]
        return reading


@effect("taxel_gain_spread", slot="taxel")
class TaxelGainSpread(BoardEffect):
    """Random gain of each taxel: r_i = g_i f_i, where ln g_i is normally distributed with mean 0 and standard deviation s, drawn
    once from ``seed``."""

    log_std: float = number("s", "1", 0, 0.15, (0, 0.7))

    def reading(
        self, reading: np.ndarray, memory: Memory, time_s: np.ndarray, dt_s: np.ndarray
    ) -> np.ndarray:
        log_gain = np.random.default_rng(self.seed).standard_normal(reading.shape[1:])[
            self.slots
        ]
        reading = reading.copy()
        reading[:, self.slots] *= np.exp(self.log_std * log_gain).astype(reading.dtype)
        return reading


@effect("taxel_gain_map", slot="taxel")
class TaxelGainMap(_ScanEffect):
    """Gain of each taxel: r_i = (1 + s (g_i − 1)) f_i, with the known gains g_i of these boards. ``taxel_gain_spread`` draws
    gains of similar boards instead."""

    only: ClassVar = ("pads",)  # gains of a sensor of cells are always fitted
    windows: ClassVar = False
    share: float = number(
        "s", "1", 0, 1, (0, 1), "1 is the map as it was measured; less fades it out"
    )
    gains: list[float] = field(default_factory=lambda: [0.0])
    """g_i: one gain per taxel, row after row from palm to tip, pad after pad; or one gain for all. The default 0 is a pad that
    is not connected."""

    def __post_init__(self) -> None:
        super().__post_init__()
        expected = len(self.pads) * ROBOT.pad.num_taxels
        if len(self.gains) not in (1, expected):
            raise TaccorlError(
                f"effect {self.name}: {len(self.gains)} gains for {expected} taxels: one each, or one"
            )
        bad = [
            g
            for g in self.gains
            if isinstance(g, bool) or not isinstance(g, int | float | np.number)
        ]
        bad += [g for g in self.gains if not bad and not 0 <= g < math.inf]
        if bad:
            raise TaccorlError(
                f"effect {self.name}: gains contain {bad[0]!r}; give numbers of 0 or more"
            )
        self.gains = [float(g) for g in self.gains]
        self._window = (slice(None), slice(None))

    @classmethod
    def of(cls, gains: np.ndarray, pads: Sequence[str]) -> "TaxelGainMap":
        """The effect with the gains (P, R, C), rounded to six digits."""
        return cls(
            share=1.0,
            pads=list(pads),
            gains=np.round(np.asarray(gains, float), 6).reshape(-1).tolist(),
        )

    def within(self, window: tuple[slice, slice]) -> "TaxelGainMap":
        found = copy.copy(self)
        found._window = window
        return found

    def law(self, own: np.ndarray, time_s: np.ndarray) -> np.ndarray:
        gains = np.broadcast_to(
            self.gains, len(self.pads) * ROBOT.pad.num_taxels
        ).reshape(-1, *ROBOT.pad.shape)
        return own * (1.0 + self.share * (gains[:, *self._window] - 1.0)).astype(
            own.dtype
        )

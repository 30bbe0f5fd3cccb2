"""Effects of pads and of sensors of cells: mount, material, wiring, timing and baseline of the taxels."""

import copy
import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import field
from typing import TYPE_CHECKING, ClassVar

import mujoco
import numba
import numpy as np
from scipy.spatial.transform import Rotation

from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.effects.effect import BoardEffect, Kind, Memory, TouchEffect, effect, number

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig

NOMINAL_C = 20.0
"""Temperature at which ``taxel_temperature`` does nothing [°C]; simulations have this temperature."""
TIMES_S = (0.1, 1.0, 10.0, 100.0, 1000.0)
"""Time constants of the parts whose sum is logarithmic creep (a Prony series, one part for each decade of time)."""
_GAP_S = 0.008  # readings closer than this are not kept beside each other; pads are scanned 100 times a second


# mount and rubber -----------------------------------------------------------------------------------------------------


class PadFrameEffect(TouchEffect):
    """Base of effects that move the frame of a pad's taxels in the finger, and the pad's box with it if the effect says so.

    ``edit`` changes the twin's model. The calibration of touch (``taccorl.alignment.touch.model``) works without that model: it
    evaluates the depths at positions displaced by ``offset_pad_m``.
    """

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
    command presses harder.
    """

    offset_m: float = number(
        "d", "m", 0, 1e-4, (-1e-3, 1e-3), "a choice: pads are cut by hand, 3.6 mm thick (FlexiTac simulation settings)"
    )

    def offset_pad_m(self, pad: str) -> np.ndarray:
        return np.array([0.0, 0.0, self.offset_m])


@effect("pad_shift", slot="robot", needs="depth")
class PadShift(PadFrameEffect):
    """Displacement of the taxels on the pad: each taxel reads what is s further along x of the TCP (across the hand) and t
    further towards the finger tips. The rubber is not displaced.

    On both pads of a hand, an object that is displaced by (−s, −t) from its assumed position has the same effect.
    """

    across_m: float = number("s", "m", 0, 2e-3, (-6e-3, 6e-3), "a choice: a taxel")
    along_m: float = number("t", "m", 0, 2e-3, (-6e-3, 6e-3), "a choice: a taxel")

    @classmethod
    def starts(cls, seen: Mapping[str, float]) -> list[dict[str, float]]:
        """Start values of a search, parameter → value each: half a taxel in each direction. At larger shifts contact areas
        that do not overlap give no gradient.
        """
        half = 1e-3
        return [{"across_m": s, "along_m": t} for s, t in ((half, 0.0), (-half, 0.0), (0.0, half), (0.0, -half))]

    def offset_pad_m(self, pad: str) -> np.ndarray:
        side = 1.0 if pad.endswith("_a") else -1.0
        return np.array([side * self.across_m, self.along_m, 0.0])


@effect("pad_compliance", slot="robot", needs="contact")
class PadCompliance(TouchEffect):
    """Stiffness of a pad: k times ``robot.pad_stiffness_n_per_m``. The same force compresses the pad by 1 / k of the depth.

    A sensor's gain changes readings in the same way; only the opening of the fingers distinguishes the two.
    """

    stiffness_factor: float = number("k", "1", 1, 0.5, (0.05, 20), "a choice, as the nominal stiffness is")

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        if config.robot.pads != "sprung":
            raise TaccorlError(
                f"effect pad_compliance: the twin's pads are {config.robot.pads}, without stiffness; set robot.pads to sprung"
            )
        for pad in self.pads:
            for joint in spec.joint(f"{pad}_spring").parent.joints:
                joint.stiffness[0] *= self.stiffness_factor


# one scan at a time ---------------------------------------------------------------------------------------------------


class _ScanEffect(TouchEffect):
    """Base of touch effects without a memory."""

    windows: ClassVar = True

    def law(self, own: np.ndarray, time_s: np.ndarray) -> np.ndarray:
        """Readings (N, P, R, C) of the chosen pads for those of ideal ones, ``own``; ``time_s`` as in ``reading``."""
        raise NotImplementedError

    def reading(self, reading: np.ndarray, memory: Memory, time_s: np.ndarray, dt_s: np.ndarray) -> np.ndarray:
        reading, own = reading.copy(), reading[:, self.slots]
        reading[:, self.slots] = self.law(own, time_s)
        return reading


@effect("taxel_power_law", slot="material")
class TaxelPowerLaw(_ScanEffect):
    """Nonlinear characteristic of the taxels: r = f₀ (f / f₀)^p. Readings equal to f₀ do not change.

    p > 1 is steeper at high pressure, as for a ball on a soft half-space (Hertz); p < 1 is flatter, as for resistive foils.
    """

    exponent: float = number("p", "1", 1, 1.5, (0.3, 3), "Hertz: 3/2 for a ball on a half-space")
    reference: float = number(
        "f₀", "reading", None, 1, (0.1, 10),
        "a choice: where the linear law was calibrated; a reading of 1 is 75 counts",
    )  # fmt: skip

    @classmethod
    def starts(cls, seen: Mapping[str, float]) -> list[dict[str, float]]:
        """Start values of a search, parameter → value each: steeper and flatter. The reference f₀ has one start only, because
        changing it is equivalent to changing k_n.
        """
        return [{"exponent": 1.4}, {"exponent": 0.75}]

    def law(self, own: np.ndarray, time_s: np.ndarray) -> np.ndarray:
        with np.errstate(divide="ignore", invalid="ignore"):  # 0 and less to a power, where nothing touches
            return own * np.where(own > 0, (own / self.reference) ** (self.exponent - 1.0), 1.0)


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
        recordings (``peak_reading``).
        """
        return [{"limit": cls.clipped("limit", share * seen.get("peak_reading", 1.0))} for share in (1.0, 4.0)]

    def law(self, own: np.ndarray, time_s: np.ndarray) -> np.ndarray:
        return own / (1.0 + np.abs(own) / own.dtype.type(self.limit))


@effect("taxel_threshold", slot="material")
class TaxelThreshold(_ScanEffect):
    """Threshold of the readings: r = [f − t]₊, because foils touch each other only from t on, or because a driver cuts off small
    values."""

    threshold: float = number(
        "t", "reading", 0, 0.1, (0, 3), "a choice: 7.5 counts, half of the boards' own no-contact threshold"
    )

    def law(self, own: np.ndarray, time_s: np.ndarray) -> np.ndarray:
        return np.maximum(own - own.dtype.type(self.threshold), 0)


@effect("taxel_crosstalk", slot="spread", needs=("reading", "neighbours"))
class TaxelCrosstalk(_ScanEffect):
    """Crosstalk between neighbouring taxels of a row or column: r = f + c/4 Σ (f_neighbour − f). A taxel keeps 1 − c of its
    reading and adds c/4 of it to each neighbour.

    At the edge a taxel keeps the shares of missing neighbours, so that the sum over a pad does not change.
    """

    share: float = number("c", "1", 0, 0.1, (0, 0.8), "a choice; covers carry load sideways, taxels share wires")

    def law(self, own: np.ndarray, time_s: np.ndarray) -> np.ndarray:
        spread = own.copy()
        for axis in (2, 3):
            flow = 0.25 * self.share * np.diff(own, axis=axis)  # from each taxel's next one into it
            first = (slice(None),) * axis
            spread[*first, :-1] += flow
            spread[*first, 1:] -= flow
        return spread


@effect("taxel_ghosting", slot="spread", needs=("reading", "neighbours"))
class TaxelGhosting(_ScanEffect):
    """Ghosting along the wires of rows and columns: r_ij = f_ij + g (Σ_k f_ik + Σ_k f_kj − 2 f_ij). Every other taxel on a
    taxel's two wires adds the share g of its reading."""

    share: float = number("g", "1", 0, 0.01, (0, 0.2), "a choice; some 5 to 20 taxels of a row are pressed at once")

    def law(self, own: np.ndarray, time_s: np.ndarray) -> np.ndarray:
        others = own.sum(axis=3, keepdims=True) + own.sum(axis=2, keepdims=True) - 2 * own
        return own + own.dtype.type(self.share) * others


@effect("baseline_drift", slot="baseline")
class BaselineDrift(_ScanEffect):
    """Linear drift of the readings: r = f + b t, with the time t since the reset, at which the baseline was taken.

    A reading of 1 is 75 counts. Counts cannot fall below the converter's 0.
    """

    rate_per_min: float = number(
        "b", "reading/min", 0, 0.1, (-2, 2),
        "a choice: 7.5 counts a minute, half of the no-contact threshold in two",
    )  # fmt: skip

    def law(self, own: np.ndarray, time_s: np.ndarray) -> np.ndarray:
        return own + (self.rate_per_min / 60.0 * time_s)[:, None, None, None].astype(own.dtype)


@effect("taxel_temperature", slot="baseline", needs=("reading", "temperature"))
class TaxelTemperature(_ScanEffect):
    """Influence of the temperature ϑ on the readings: r = (1 + α (ϑ − 20 °C)) f + β (ϑ − 20 °C). ϑ is recorded together with the
    readings."""

    gain_per_k: float = number("α", "1/K", 0, 0.005, (-0.1, 0.1), "a choice: half a per cent a kelvin")
    zero_per_k: float = number("β", "reading/K", 0, 0.02, (-1, 1))

    def __post_init__(self) -> None:
        super().__post_init__()
        self._above_nominal_k = np.zeros(1)

    @classmethod
    def kinds(cls) -> tuple[Kind, ...]:
        """Kinds of parts on which it can act; not pads, whose recordings hold no temperature."""
        return ("cells",)

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
        return own + warmer * (own.dtype.type(self.gain_per_k) * own + own.dtype.type(self.zero_per_k))


# single taxels --------------------------------------------------------------------------------------------------------


@effect("dead_taxels", slot="taxel")
class DeadTaxels(BoardEffect):
    """Taxels that always read 0: a share of each pad's taxels, drawn once from ``seed``. The dead taxels of a smaller share are
    also dead at a greater one."""

    share: float = number("s", "1", 0, 0.05, (0, 1))

    def dead(self, shape: tuple[int, int, int]) -> np.ndarray:
        """(pads, rows, columns) bool, of the given ``shape``: round(s · taxels) dead taxels of each pad, also of pads that are
        not selected."""
        num_pads, num_taxels = shape[0], math.prod(shape[1:])
        rank = np.random.default_rng(self.seed).permuted(np.tile(np.arange(num_taxels), (num_pads, 1)), axis=1)
        return (rank < round(self.share * num_taxels)).reshape(shape)

    def reading(self, reading: np.ndarray, memory: Memory, time_s: np.ndarray, dt_s: np.ndarray) -> np.ndarray:
        reading = reading.copy()
        reading[:, self.slots] *= ~self.dead(reading.shape[1:])[self.slots]
        return reading


@effect("taxel_gain_spread", slot="taxel")
class TaxelGainSpread(BoardEffect):
    """Random gain of each taxel: r_i = g_i f_i, where ln g_i is normally distributed with mean 0 and standard deviation s, drawn
    once from ``seed``."""

    log_std: float = number("s", "1", 0, 0.15, (0, 0.7))

    def reading(self, reading: np.ndarray, memory: Memory, time_s: np.ndarray, dt_s: np.ndarray) -> np.ndarray:
        log_gain = np.random.default_rng(self.seed).standard_normal(reading.shape[1:])[self.slots]
        reading = reading.copy()
        reading[:, self.slots] *= np.exp(self.log_std * log_gain).astype(reading.dtype)
        return reading


@effect("taxel_gain_map", slot="taxel")
class TaxelGainMap(_ScanEffect):
    """Gain of each taxel: r_i = (1 + s (g_i − 1)) f_i, with the known gains g_i of these boards. ``taxel_gain_spread`` draws
    gains of similar boards instead."""

    windows: ClassVar = False
    share: float = number("s", "1", 0, 1, (0, 1), "1 is the map as it was measured; less fades it out")
    gains: list[float] = field(default_factory=lambda: [0.0])
    """g_i: one gain per taxel, row after row from palm to tip, pad after pad; or one gain for all. The default 0 is a pad that
    is not connected."""

    @classmethod
    def kinds(cls) -> tuple[Kind, ...]:
        """Kinds of parts on which it can act; not a sensor of cells, whose gains are always fitted."""
        return ("pads",)

    def __post_init__(self) -> None:
        super().__post_init__()
        expected = len(self.pads) * ROBOT.pad.num_taxels
        if len(self.gains) not in (1, expected):
            raise TaccorlError(
                f"effect {self.name}: there are {len(self.gains)} gains, but the pads {', '.join(self.pads)} have {expected} "
                "taxels: give one gain per taxel, or one for all"
            )
        bad = [g for g in self.gains if isinstance(g, bool) or not isinstance(g, int | float | np.number)]
        bad += [g for g in self.gains if not bad and not 0 <= g < math.inf]
        if bad:
            raise TaccorlError(f"effect {self.name}: gains contain {bad[0]!r}; give numbers of 0 or more")
        self.gains = [float(g) for g in self.gains]
        self._window = (slice(None), slice(None))

    @classmethod
    def of(cls, gains: np.ndarray, pads: Sequence[str]) -> "TaxelGainMap":
        """The effect with the gains (P, R, C), rounded to six digits."""
        return cls(share=1.0, pads=list(pads), gains=np.round(np.asarray(gains, float), 6).reshape(-1).tolist())

    def within(self, window: tuple[slice, slice]) -> "TaxelGainMap":
        found = copy.copy(self)
        found._window = window
        return found

    def law(self, own: np.ndarray, time_s: np.ndarray) -> np.ndarray:
        gains = np.broadcast_to(self.gains, len(self.pads) * ROBOT.pad.num_taxels).reshape(-1, *ROBOT.pad.shape)
        return own * (1.0 + self.share * (gains[:, *self._window] - 1.0)).astype(own.dtype)


# with a memory --------------------------------------------------------------------------------------------------------


class RememberingEffect(TouchEffect):
    """Base of touch effects with memory: they compute a whole sequence of scans at once; one scan is a sequence of length 1.

    A replay of a recording (``taccorl.alignment.touch.model``) thus needs one call instead of thousands, with the same code as
    the simulation. Other effects with a memory work too, called scan by scan.

    Letters in shapes: S scans, K taxels of all chosen pads.
    """

    windows: ClassVar = True
    holds_scan: ClassVar[bool] = True
    """True: the input is taken as constant since the scan before. False: it is taken as linear, or the path between scans has no
    influence."""
    kept: ClassVar[str] = "held"
    """Name of the array (N, P, R, C) in the memory."""

    def memory(self, num_sims: int, pad_shape: tuple[int, int]) -> Memory:
        return {self.kept: np.zeros((num_sims, len(self.pads), *pad_shape), np.float32)}

    @abstractmethod
    def fill(self, own: np.ndarray, memory: Memory, dt_s: np.ndarray, seen: np.ndarray) -> None:
        """Fill ``seen`` (S, N, K) with the readings in consecutive scans, from those of ideal pads, ``own`` (S, N, K); change
        ``memory`` from its state before the first scan to that after the last. ``dt_s`` (S, N) is the time since the scan
        before."""

    def scans(self, own: np.ndarray, memory: Memory, dt_s: np.ndarray) -> np.ndarray:
        """Readings of the chosen pads P in S consecutive scans, a new array (S, N, P, R, C) of the same type.

        Args:
            own: (S, N, P, R, C) readings of ideal pads.
            memory: arrays (N, …) with the state before the first scan; changed to the state after the last.
            dt_s: (S, N) time since the scan before.
        """
        seen, flat = np.empty(own.shape, own.dtype), (*own.shape[:2], -1)  # in order, so that its flat form is a view
        self.fill(own.reshape(flat), memory, dt_s, seen.reshape(flat))
        return seen

    def reading(self, reading: np.ndarray, memory: Memory, time_s: np.ndarray, dt_s: np.ndarray) -> np.ndarray:
        reading, own = reading.copy(), reading[:, self.slots]
        reading[:, self.slots] = self.scans(own[None], memory, dt_s[None])[0]
        return reading


class CreepingEffect(RememberingEffect):
    """Base class of the effects of creep. The reading is r = f + a Σ mᵢ with ṁᵢ = (f − mᵢ) / τᵢ: f is the reading without creep,
    a the share of the creep, τᵢ [s] its time constants. r is at least 0, unless ``below_rest`` is true.

    The equation is solved exactly for a reading that was constant since the last scan.
    """

    kept: ClassVar = "crept"
    share: float
    """a; a parameter of each effect, with its own range."""
    below_rest: bool
    """True: after a release readings may be below 0 where a < 0; for sensors whose reading at rest is no lower end."""

    @property
    @abstractmethod
    def times_s(self) -> tuple[float, ...]:
        """Time constants τᵢ [s]."""

    def memory(self, num_sims: int, pad_shape: tuple[int, int]) -> Memory:
        return {"crept": np.zeros((num_sims, len(self.times_s), len(self.pads), *pad_shape), np.float32)}

    def fill(self, own: np.ndarray, memory: Memory, dt_s: np.ndarray, seen: np.ndarray) -> None:
        reached = -np.expm1(-dt_s[..., None] / np.array(self.times_s)).astype(own.dtype)
        crept = memory["crept"].reshape(own.shape[1], len(self.times_s), -1)
        _creep(own, reached, np.float32(self.share), np.float32(-np.inf if self.below_rest else 0.0), crept, seen)


@effect("taxel_creep", slot="material")
class TaxelCreep(CreepingEffect):
    """Creep of the readings: r = f + a m with ṁ = (f − m) / τ. The reading is f at once and (1 + a) f after a long time; after
    release a m remains and decays. Standard linear solid. a < 0 is relaxation: the reading decreases under a constant load."""

    below_rest: bool = False
    share: float = number(
        "a", "1", 0, 0.2, (-0.8, 2), "fitted to a Velostat taxel: 0.29 in 0.77 s (Lupasic/tactile-sensor-velostat)"
    )
    time_constant_s: float = number("τ", "s", None, 0.8, (0.05, 30), "the same Velostat taxel")

    @property
    def times_s(self) -> tuple[float, ...]:
        return (self.time_constant_s,)

    @classmethod
    def starts(cls, seen: Mapping[str, float]) -> list[dict[str, float]]:
        """Start values of a search, parameter → value each: a fast increase, a slow increase, a decrease."""
        return [{"share": a, "time_constant_s": tau_s} for a, tau_s in ((0.3, 0.3), (0.3, 3.0), (-0.3, 1.0))]


@effect("taxel_log_creep", slot="material")
class TaxelLogCreep(CreepingEffect):
    """Creep over many time scales: r = f + a Σ mᵢ with ṁᵢ = (f − mᵢ) / τᵢ, τᵢ = 0.1 s … 1000 s. After t seconds of load r is
    about (1 + a log₁₀(t / 0.06 s)) f. a < 0 is relaxation."""

    below_rest: bool = False
    share: float = number("a", "1", 0, 0.05, (-0.15, 0.3), "a choice: 5 % a decade")

    @classmethod
    def kinds(cls) -> tuple[Kind, ...]:
        """Kinds of parts on which it can act; not pads, whose presses are too short to tell it from ``taxel_creep``."""
        return ("cells",)

    @property
    def times_s(self) -> tuple[float, ...]:
        return TIMES_S

    @classmethod
    def starts(cls, seen: Mapping[str, float]) -> list[dict[str, float]]:
        """Start values of a search, parameter → value each: an increase and a decrease."""
        return [{"share": 0.05}, {"share": -0.05}]


@effect("taxel_hysteresis", slot="material")
class TaxelHysteresis(RememberingEffect):
    """Hysteresis of the readings: r stays constant while (1 − h) f ≤ r ≤ (1 + h) f, and follows the limit that it reaches
    (Prandtl's play with a width in proportion to f).

    The reading is (1 − h) f during loading, (1 + h) f during unloading, and 0 without contact.
    """

    holds_scan: ClassVar = False
    half_width: float = number("h", "1", 0, 0.1, (0, 0.5))

    def fill(self, own: np.ndarray, memory: Memory, dt_s: np.ndarray, seen: np.ndarray) -> None:
        low, high = np.float32(1.0 - self.half_width), np.float32(1.0 + self.half_width)
        _carry_along(own, low, high, np.float32(0.0), memory["held"].reshape(own.shape[1], -1), seen)


@effect("taxel_play", slot="material")
class TaxelPlay(RememberingEffect):
    """Hysteresis of fixed width: r stays constant while |f − r| ≤ w, and is carried along at the ends of this band (Prandtl's
    play operator).

    The reading is f − w during loading and f + w during unloading, at any speed, and w remains after release. A band in
    proportion to the load is ``taxel_hysteresis``. A search looks for it in sensors of cells only: pads were studied without it.
    Noise of a measured load widens the fitted band by about half of its standard deviation.
    """

    holds_scan: ClassVar = False
    half_width: float = number("w", "reading", 0, 0.2, (0, 3), "a choice: 2 % of the rated load of a sensor of cells")

    @classmethod
    def kinds(cls) -> tuple[Kind, ...]:
        return ("cells",)

    def fill(self, own: np.ndarray, memory: Memory, dt_s: np.ndarray, seen: np.ndarray) -> None:
        one, width = np.float32(1.0), np.float32(self.half_width)
        _carry_along(own, one, one, width, memory["held"].reshape(own.shape[1], -1), seen)


@effect("touch_delay", slot="taxel")
class TouchDelay(RememberingEffect):
    """Delay of the readings: r(t) = f(t − d), with linear interpolation between scans. Before the reset readings count as 0."""

    holds_scan: ClassVar = False
    delay_s: float = number("d", "s", 0, 0.03, (0, 0.2), "a choice: three scans")

    def memory(self, num_sims: int, pad_shape: tuple[int, int]) -> Memory:
        shape = (num_sims, math.ceil(self.delay_s / _GAP_S) + 2)
        return {"past": np.zeros((*shape, len(self.pads), *pad_shape), np.float32), "age_s": np.zeros(shape)}

    def fill(self, own: np.ndarray, memory: Memory, dt_s: np.ndarray, seen: np.ndarray) -> None:
        past = memory["past"].reshape(*memory["past"].shape[:2], -1)
        _recall(own, np.asarray(dt_s, float), past, memory["age_s"], float(self.delay_s), seen)


@effect("touch_lag", slot="taxel")
class TouchLag(RememberingEffect):
    """Low-pass of the readings: ṙ = (f − r) / T. Solved exactly for a reading that was constant since the last scan."""

    kept: ClassVar = "smooth"
    time_constant_s: float = number("T", "s", 0, 0.03, (0, 0.5), "a choice: three scans")

    def fill(self, own: np.ndarray, memory: Memory, dt_s: np.ndarray, seen: np.ndarray) -> None:
        reached = -np.expm1(-dt_s / self.time_constant_s).astype(own.dtype)
        _follow(own, reached, memory["smooth"].reshape(own.shape[1], -1), seen)


@numba.njit(cache=True)
def _creep(
    own: np.ndarray, reached: np.ndarray, share: np.float32, lowest: np.float32, crept: np.ndarray, seen: np.ndarray
) -> None:
    """Each part of ``crept`` (N, M, K) goes its share ``reached`` (S, N, M) of the way to ``own`` (S, N, K) in every scan;
    ``seen`` (S, N, K) is at least ``lowest``."""
    for s in range(own.shape[0]):
        for n in range(own.shape[1]):
            for k in range(own.shape[2]):
                total = np.float32(0)
                for m in range(crept.shape[1]):
                    crept[n, m, k] += (own[s, n, k] - crept[n, m, k]) * reached[s, n, m]
                    total += crept[n, m, k]
                seen[s, n, k] = max(own[s, n, k] + share * total, lowest)


@numba.njit(cache=True)
def _carry_along(
    own: np.ndarray, low: np.float32, high: np.float32, width: np.float32, held: np.ndarray, seen: np.ndarray
) -> None:
    """``held`` (N, K) is kept between ``low`` and ``high`` times ``own`` (S, N, K), ∓ ``width``, in every scan."""
    for s in range(own.shape[0]):
        for n in range(own.shape[1]):
            for k in range(own.shape[2]):
                held[n, k] = min(max(held[n, k], low * own[s, n, k] - width), high * own[s, n, k] + width)
                seen[s, n, k] = held[n, k]


@numba.njit(cache=True)
def _recall(
    own: np.ndarray, dt_s: np.ndarray, past: np.ndarray, age_s: np.ndarray, delay_s: float, seen: np.ndarray
) -> None:
    """``past`` (N, H, K), the newest first, takes up ``own`` (S, N, K); ``seen`` is what there was ``delay_s`` ago.

    A simulation that stands still (dt 0), and scans that follow each other quickly, replace the newest.
    """
    last = past.shape[1] - 1
    for s in range(own.shape[0]):
        for n in range(own.shape[1]):
            is_apart = dt_s[s, n] > 0.0 and age_s[n, 1] - age_s[n, 0] >= _GAP_S
            age_s[n] += dt_s[s, n]
            if is_apart:
                for h in range(last, 0, -1):
                    age_s[n, h] = age_s[n, h - 1]
                    past[n, h] = past[n, h - 1]
            age_s[n, 0] = 0.0
            past[n, 0] = own[s, n]
            h = 0
            while h < last - 1 and age_s[n, h + 1] < delay_s:
                h += 1
            span = age_s[n, h + 1] - age_s[n, h]
            share = min((delay_s - age_s[n, h]) / span, 1.0) if span > 0.0 else 0.0
            for k in range(own.shape[2]):
                seen[s, n, k] = past[n, h, k] + share * (past[n, h + 1, k] - past[n, h, k])


@numba.njit(cache=True)
def _follow(own: np.ndarray, reached: np.ndarray, smooth: np.ndarray, seen: np.ndarray) -> None:
    """``smooth`` (N, K) goes the share ``reached`` (S, N) of its way to ``own`` (S, N, K) in every scan."""
    for s in range(own.shape[0]):
        for n in range(own.shape[1]):
            for k in range(own.shape[2]):
                smooth[n, k] += (own[s, n, k] - smooth[n, k]) * reached[s, n]
                seen[s, n, k] = smooth[n, k]

"""Joint effects in the size and the units of another machine: 20 N of dry friction on a slide instead of 0.4 N·m on a small arm.

Bounds, typical values and starts of effects are those of joints of an arm. ``scaled`` makes a class of the same effect whose
bounds are multiplied by the machine's scale and whose units are the machine's; its numbers are in those units.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import Effect, Parameter

_POWERS = {  # of force unit and length unit in each unit of a parameter
    "N·m": (1, 0),
    "rad": (0, 1),
    "rad/s": (0, 1),
    "N·m/rad": (1, -1),
    "N·m·s/rad": (1, -1),
    "N·m·s²/rad²": (1, -2),
    "kg·m²": (1, -1),
    "rad/(N·m)": (-1, 1),
}
"""Units that are not here (1, s, 1/s …) are the same on every machine."""
_SLIDE = {"N·m": "N", "rad": "m", "kg·m²": "kg"}
OF_A_TURN = ("encoder_eccentricity", "unbalance")
"""Effects that repeat with each turn of a joint; a linear axis does not have them."""
SOFT = 5.0
"""Compliance that a gear may have in multiples of the drive's; of series elastic actuators it is 0.1 to 3. A choice."""
WAVE_SHARE = 0.25
"""Share w of a slide's length unit that stands for 1 rad in periodic forces (magnets, a screw): wave numbers 2π / pitch are
6 / w … 800 / w, pitches 0.2 to 26 % of a stroke. A choice."""
FINER = 4.0
"""Factor on the largest wave number of a slide's periodic forces: a screw's pitch of
5 mm is 0.5 % of a stroke of 1 m. A choice."""


@dataclass(frozen=True, kw_only=True)
class Scale:
    """Size of a machine's forces and motions relative to a joint of a small arm."""

    unit: Literal["rad", "m"] = "rad"
    force: float = 1.0
    """Factor on forces, N·m or N."""
    length: float = 1.0
    """Factor on positions, rad or m."""
    drive: float = 0.0
    """Compliance of the drive, 1 / K_p [rad/(N·m) or m/N]; a gear may be ``SOFT`` times as soft whatever its force. 0: none."""

    @property
    def wave(self) -> float:
        """Factor on positions by which wave numbers of periodic forces are divided: 1 for a turning joint."""
        return WAVE_SHARE * self.length if self.unit == "m" else 1.0

    def of(self, effect: str, p: Parameter) -> tuple[float, str]:
        """Return factor and unit of a parameter: value for this machine = factor · value for a small arm. ``effect``: name of
        the effect. ``p``: its parameter, as for a small arm."""
        if effect == "cogging" and p.name == "periods":
            return 1.0 / self.wave, "rad/m" if self.unit == "m" else p.unit
        if p.name.startswith("phase") or p.name == "hangs_at_rad":
            return 1.0, p.unit
        return self.factor(p.unit), self.unit_of(p.unit)

    def factor(self, unit: str) -> float:
        """Factor on parameters in ``unit``: value for this machine / value for a small arm."""
        force, length = _POWERS.get(unit, (0, 0))
        return self.force**force * self.length**length

    def unit_of(self, unit: str) -> str:
        """Unit on this machine of a parameter in ``unit``: for a slide N instead of N·m, m instead of rad."""
        if self.unit == "m":
            for angular, linear in _SLIDE.items():
                unit = unit.replace(angular, linear)
        return unit.replace("(N)", "N")


@functools.cache
def scaled(name: str, scale: Scale) -> type[Effect]:
    """Class of the effect with bounds and units for a machine of that size. Raises TaccorlError: no such effect."""
    base = effects.get(name)
    if scale == Scale():
        return base
    factors = {p.name: scale.of(name, p)[0] for p in base.parameters()}
    changed = {}
    for p in base.parameters():
        ends = {key: getattr(p, key) for key in ("absent", "low", "high", "typical")}
        number: dict[str, Any] = {
            k: v if v is None or not math.isfinite(v) else v * factors[p.name]
            for k, v in ends.items()
        }
        if p.unit == "rad/(N·m)":
            number["high"] = max(p.high * factors[p.name], SOFT * scale.drive)
        if name == "cogging" and p.name == "periods" and scale.unit == "m":
            number["high"] *= FINER
        changed[p.name] = number | {"unit": scale.of(name, p)[1]}

    def starts(cls: type[Effect], seen: Mapping[str, float]) -> list[dict[str, float]]:
        units = {
            "rad_per_nm": scale.length / scale.force,
            "nm": scale.force,
            "rad": scale.length,
        }
        units["rad_per_s"] = scale.length
        own = {
            k: v / next((u for end, u in units.items() if k.endswith(f"_{end}")), 1.0)
            for k, v in seen.items()
        }
        return [
            {key: value * factors[key] for key, value in start.items()}
            for start in base.starts(own)
        ]

    by = "; `force_unit_n` and `length_unit_m` of the joint set such bounds"
    return _changed(
        base, changed, (scaled, name, scale), starts=classmethod(starts), range_by=by
    )


@functools.cache
def bounded(name: str, bounds: tuple[tuple[str, float, float], ...]) -> type[Effect]:
    """Class of the effect in which these parameters have other bounds. ``bounds``: (parameter, low, high); a typical value
    beyond them becomes their middle. Raises TaccorlError: no such effect."""
    base, changed = effects.get(name), {}
    typical = {p.name: p.typical for p in base.parameters()}
    for key, low, high in bounds:
        middle = typical[key] if low <= typical[key] <= high else 0.5 * (low + high)
        changed[key] = {"low": low, "high": high, "typical": middle}
    return _changed(base, changed, (bounded, name, bounds))


def _changed(
    base: type[Effect],
    changed: Mapping[str, dict[str, Any]],
    made: tuple,
    **members: Any,
) -> type[Effect]:
    """Subclass of ``base`` with other values of ``number`` for some parameters; ``made`` is the call that returns it."""
    fields: dict[str, Any] = {
        "__module__": base.__module__,
        "__annotations__": dict.fromkeys(changed, float),
    }
    for f in dataclasses.fields(base):
        if f.name in changed:
            meta = f.metadata["parameter"] | changed[f.name]
            default = meta["typical"] if meta["absent"] is None else meta["absent"]
            fields[f.name] = dataclasses.field(
                default=default, metadata={"parameter": meta}
            )

    def again(
        self: Effect,
    ) -> tuple[Any, ...]:  # such a class has no name that pickle could import
        return _remade, (
            *made,
            {f.name: getattr(self, f.name) for f in dataclasses.fields(self)},
        )

    return dataclass(kw_only=True)(
        type(base.__name__, (base,), fields | members | {"__reduce__": again})
    )


def _remade(
    function: Callable[..., type[Effect]],
    name: str,
    argument: Any,
    values: dict[str, Any],
) -> Effect:
    return function(name, argument)(**values)

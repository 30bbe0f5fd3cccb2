"""An axis file: one driven axis by itself, such as a slide on a bench, a wheel, or a servo with a pendulum.

::

    kind: axis
    name: drive            # signal: columns drive.q, drive.q_target, drive.qd, drive.tau, drive.load
    unit: m                # of its position: rad, or m of a slide; forces are then N for N·m, masses kg for kg·m²
    inertia: 95.0          # kg, or kg·m²: where the fit starts
    law: cascade           # what the drive does with its target; impedance if not given
    kp: 160.18
    kd: 8557.4
    limits: [-0.01, 0.26]  # stroke
    effort_limit: 350.0    # N or N·m that the drive can give
    effects:               # physics beyond that; taccorl add-effect writes them
    - {effect: coulomb_friction, torque_nm: 20.4}    # in N on a slide

==============  =================================================  ========================================================
law             motor's torque                                     meaning of the target
==============  =================================================  ========================================================
``impedance``   kp (q* − q) − kd q̇ + torque_ff                     position; kp in N·m/rad, kd in N·m·s/rad
``cascade``     kd (kp (q* − q) − q̇) + torque_ff                   position; kp in 1/s, kd in N·m·s/rad
``velocity``    kd (q̇* − q̇) + torque_ff                            velocity; no kp
``torque``      τ* + torque_ff                                     torque; no gains. 0: the motor is off
``pwm``         k_t (V d − k_e q̇) / R,  d = kp (q* − q) − kd q̇     position; duty d is clipped to ± 1, kp in 1/rad, kd in s/rad
                within ± 1
==============  =================================================  ========================================================

Targets stand in the column ``q_target``; of law velocity in ``qd_target``, of law torque in ``tau_target``. V is ``supply_v`` of
the file, or of a recording (``NAME.supply``, or measurements.yaml). While ``NAME.enabled`` is 0 the motor neither drives nor
brakes. What a recording mounts on a turning axis is m l² of inertia and m g l sin(q − q₀) of weight: ``payload_kg`` at
``lever_m``, and an arm of ``arm_kg``, a uniform rod of that length.
"""

import dataclasses
import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
import yaml

from taccorl.alignment.joint_kernel import POSITION, TORQUE, VELOCITY
from taccorl.alignment.measurement import Measurement, TargetKind
from taccorl.alignment.rigid_joint import Gains, Rigid, RigidJoint, Surroundings
from taccorl.data.strict_yaml import Document
from taccorl.errors import TaccorlError, nearest
from taccorl.sim.effects import effects as registry
from taccorl.sim.effects.effect import Effect, JointEffect
from taccorl.sim.effects.scaled import OF_A_TURN, Scale, scaled
from taccorl.sim.settings import check_numbers

if TYPE_CHECKING:
    from taccorl.alignment.joint_motion import JointMotion

GRAVITY_M_PER_S2 = 9.81
LONGEST_STEP_S, SHORTEST_STEP_S = 1e-3, 1e-4
"""Of the physics."""
STEP_SHARE = 0.05
"""Of inertia / K_d. Steps are of second order: a PWM servo's step of 0.8 rad is then off by 0.1 mrad."""
Law = Literal["impedance", "cascade", "velocity", "torque", "pwm"]
_COMMANDS = {"velocity": VELOCITY, "torque": TORQUE}
_HEADER = "# An axis: taccorl/alignment/axis_file.py says what may stand here.\n"


@dataclass(frozen=True)
class EffectEntry:
    """An effect as the file has it, in the units of the axis."""

    name: str
    values: Mapping[str, Any]


@dataclass(kw_only=True)
class AxisConfig:
    """One driven axis. Units are those of a turning one; of a slide N for N·m, m for rad, kg for kg·m²."""

    kind: Literal["axis"] = "axis"
    name: str
    """Of its signal in the recordings."""
    unit: Literal["rad", "m"]
    inertia: float
    """kg·m²."""
    law: Law = "impedance"
    kp: float = 0.0
    """In the unit that the law asks for, over ``kp_factor``; commanded, unless a recording states another one."""
    kd: float = 0.0
    kp_factor: float = 1.0
    """``kp`` times this is in the law's unit, here and in measurements.yaml: what one step of a gain's register is worth."""
    kd_factor: float = 1.0
    torque_ff: float = 0.0
    """N·m."""
    supply_v: float | None = None
    """V: of law pwm."""
    resistance_ohm: float | None = None
    """Ω: of the winding, law pwm."""
    torque_nm_per_a: float | None = None
    """k_t at the axis, gear included [N·m/A], law pwm."""
    emf_v_s_per_rad: float | None = None
    """k_e at the axis [V·s/rad], law pwm; k_t if not given, which it is in SI units."""
    weight_sin: float = 0.0
    """S [N·m] in the torque S sin q + C cos q that holds the axis's own weight."""
    weight_cos: float = 0.0
    """C [N·m]."""
    lever_m: float = 0.0
    """Distance from the axis at which a recording's ``payload_kg`` is held, unless the recording states another one; a slide
    has none."""
    arm_kg: float = 0.0
    """Of the arm that holds the payload, unless a recording states another one: a uniform rod as long as the lever."""
    hangs_at_rad: float = 0.0
    """Angle at which that payload hangs straight down."""
    command_hz: float | None = None
    """Rate at which the drive receives targets, where they are logged more slowly: a replay joins the rows by straight
    lines of such steps. If not given, rows slower than 150 Hz are joined so, if targets are positions; others are held."""
    limits: tuple[float, float] | None = None
    """Lowest and highest position [rad]."""
    effort_limit: float | None = None
    """N·m at which the drive's torque is clipped."""
    force_unit_n: float | None = None
    """N·m that are for this axis what 1 N·m is for a joint of a small arm: effects are searched for within bounds that grow with
    it. A tenth of effort_limit if not given, else 1."""
    length_unit_m: float | None = None
    """The same for 1 rad; the stroke of a slide if not given, else 1."""
    effects: tuple[EffectEntry, ...] = ()

    def __post_init__(self) -> None:
        check_numbers("axis", self, positive=("inertia", "kp_factor", "kd_factor"))
        check_numbers("axis", self, not_negative=("kp", "kd", "lever_m", "arm_kg"))
        check_numbers("axis", self, finite=("torque_ff", "weight_sin", "weight_cos", "hangs_at_rad"))
        of_pwm = ("supply_v", "resistance_ohm", "torque_nm_per_a", "emf_v_s_per_rad")
        optional = (*of_pwm, "effort_limit", "command_hz", "force_unit_n", "length_unit_m")
        check_numbers("axis", self, positive=[name for name in optional if getattr(self, name) is not None])
        needed = {
            "impedance": ("kp",),
            "cascade": ("kp", "kd"),
            "velocity": ("kd",),
            "torque": (),
            "pwm": ("kp", *of_pwm[:3]),
        }
        for name in needed[self.law]:
            if not getattr(self, name):
                raise TaccorlError(f"axis.{name}: law {self.law} needs it; write `{name}: …`")
        foreign = [] if self.law == "pwm" else [name for name in of_pwm if getattr(self, name) is not None]
        foreign += [
            name for name in {"velocity": ("kp",), "torque": ("kp", "kd")}.get(self.law, ()) if getattr(self, name)
        ]
        if foreign:
            raise TaccorlError(f"axis.{foreign[0]}: law {self.law} has none; remove it, or mend the law")
        if self.limits is not None and not self.limits[0] < self.limits[1]:
            raise TaccorlError(f"axis.limits: {list(self.limits)} must rise; write the lowest position first")
        of_turning = ("weight_sin", "weight_cos", "lever_m", "arm_kg", "hangs_at_rad")
        of_turning = [name for name in of_turning if getattr(self, name)]
        if self.unit == "m" and of_turning:
            raise TaccorlError(
                f"axis.{of_turning[0]}: a slide has none; a constant weight is part of torque_ff, which is fitted"
            )

    @property
    def scale(self) -> Scale:
        """Size of the axis, for the bounds of effects."""
        force = self.force_unit_n or (self.effort_limit or 10.0) / 10.0
        stroke = self.limits[1] - self.limits[0] if self.limits and self.unit == "m" else 1.0
        return Scale(unit=self.unit, force=force, length=self.length_unit_m or stroke)

    @property
    def stall_nm(self) -> float:
        """V k_t / R of law pwm [N·m]."""
        return (self.supply_v or 0.0) * (self.torque_nm_per_a or 0.0) / (self.resistance_ohm or 1.0)

    @property
    def back_emf(self) -> float:
        """k_t k_e / R of law pwm [N·m·s/rad]."""
        emf = self.torque_nm_per_a if self.emf_v_s_per_rad is None else self.emf_v_s_per_rad
        return (self.torque_nm_per_a or 0.0) * (emf or 0.0) / (self.resistance_ohm or 1.0)

    @property
    def gains(self) -> Gains:
        """Of the position error and the velocity [N·m/rad, N·m·s/rad, N·m], whatever the law."""
        kp, kd = self.kp * self.kp_factor, self.kd * self.kd_factor
        if self.law == "cascade":
            return Gains(kp * kd, kd, self.torque_ff)
        if self.law == "pwm":
            return Gains(kp * self.stall_nm, kd * self.stall_nm, self.torque_ff)
        return Gains(kp, kd, self.torque_ff)

    def effect_class(self, name: str) -> type[Effect] | None:
        """The effect in the size and units of this axis; None if an axis cannot have it.

        Raises:
            TaccorlError: no such effect.
        """
        cls = registry.get(name)
        if not issubclass(cls, JointEffect) or (self.unit == "m" and name in OF_A_TURN):
            return None
        own = scaled(name, self.scale)
        numbers: dict[str, Any] = {p.name: p.typical for p in own.parameters()}
        return own if own(**numbers).drive() else None

    def made(self) -> list[Effect]:
        """The effects of the file."""
        found = []
        for entry in self.effects:
            cls = self.effect_class(entry.name)
            if cls is None:
                raise TaccorlError(f"effects: {entry.name} cannot act on an axis; remove it")
            for key in entry.values:
                if key not in _settings(cls):
                    raise TaccorlError(
                        f"effects: {entry.name} has no parameter {key!r}; {nearest(key, _settings(cls))}"
                    )
            values: dict[str, Any] = dict(entry.values)
            found.append(cls(**values))
        return found

    def with_numbers(self, base: Mapping[str, float]) -> "AxisConfig":
        """With fitted numbers, which are called as in ``AxisProblem``."""
        new = {name: base[name] for name in ("inertia", "torque_ff", "weight_sin", "weight_cos") if name in base}
        if self.law == "pwm" and "stall_nm" in base:
            volts, ohms = self.supply_v or 1.0, self.resistance_ohm or 1.0
            new["torque_nm_per_a"] = base["stall_nm"] * ohms / volts
            new["emf_v_s_per_rad"] = base["back_emf"] * ohms / new["torque_nm_per_a"]
        elif "kd" in base and "kp" in base:
            new["kd"] = base["kd"] / self.kd_factor
            new["kp"] = (base["kp"] / base["kd"] if self.law == "cascade" else base["kp"]) / self.kp_factor
        elif "kd" in base:
            new["kd"] = base["kd"] / self.kd_factor
        elif "kp" in base:
            new["kp"] = base["kp"] / self.kp_factor
        return dataclasses.replace(self, **{name: float(value) for name, value in new.items()})

    def with_effects(self, found: Sequence[Effect]) -> "AxisConfig":
        """With these effects; one of the same name is replaced."""
        names = {e.name for e in found}
        entries = [e for e in self.effects if e.name not in names]
        entries += [EffectEntry(e.name, _values(e)) for e in found]
        return dataclasses.replace(self, effects=tuple(entries))


def _settings(cls: type[Effect]) -> list[str]:
    return [*(p.name for p in cls.parameters()), "interval", "evidence"]


def _values(effect: Effect) -> dict[str, Any]:
    values: dict[str, Any] = {p.name: float(getattr(effect, p.name)) for p in effect.parameters()}
    if effect.interval:
        values["interval"] = {name: (float(low), float(high)) for name, (low, high) in effect.interval.items()}
    if effect.evidence:
        values["evidence"] = effect.evidence
    return values


# the file --------------------------------------------------------------------------------------------------------------


def load_axis(path: Path) -> AxisConfig:
    """An axis's file.

    Raises:
        SpecError: a wrong key or value; with file and line.
    """
    return _AxisDocument(AxisConfig, path).value


class _AxisDocument(Document[AxisConfig]):
    """With effects, and the line of what the config itself refuses."""

    def _build(self, kind: Any, node: yaml.Node, key: str) -> Any:
        if kind is EffectEntry:
            return self._entry(node, key)
        return super()._build(kind, node, key)

    def _dataclass(self, cls: Any, node: yaml.Node, key: str) -> Any:
        try:
            config = super()._dataclass(cls, node, key)
            if isinstance(config, AxisConfig):
                config.made()
            return config
        except TaccorlError as error:
            text = str(error)
            if text.startswith(str(self.path)):
                raise
            if text.startswith("axis."):
                raise self.error(text.split(":", 1)[0].removeprefix("axis."), text.split(": ", 1)[1]) from error
            raise self.error("effects", text.removeprefix("effects: ")) from error

    def _entry(self, node: yaml.Node, key: str) -> EffectEntry:
        self._lines.setdefault(key, node.start_mark.line + 1)
        items = dict(self._items(node, key))
        if "effect" not in items:
            raise self.error(key, "key 'effect' is missing; it names the effect: taccorl effects lists them")
        name = self._scalar(str, items.pop("effect"), f"{key}/effect")
        if name not in registry:
            raise self.error(f"{key}/effect", f"no effect {name!r}; {nearest(name, registry)}")
        kinds: dict[str, Any] = {"interval": dict[str, tuple[float, float]], "evidence": str}
        values = {k: self._build(kinds.get(k, float), child, f"{key}/{k}") for k, child in items.items()}
        return EffectEntry(name, values)


def axis_text(config: AxisConfig) -> str:
    """As a file has it: keys at their defaults are left out."""
    content: dict[str, Any] = {"kind": "axis"}
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if field.name not in ("kind", "effects") and value != field.default:
            content[field.name] = list(value) if isinstance(value, tuple) else value
    if config.effects:
        content["effects"] = [{"effect": e.name} | _plain(e.values) for e in config.effects]
    return _HEADER + yaml.safe_dump(content, sort_keys=False, allow_unicode=True, default_flow_style=None, width=120)


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, tuple | list) else value


def axis_digest(config: AxisConfig) -> str:
    """16 hexadecimal digits that two axes share only if they are the same."""
    return hashlib.sha256(axis_text(config).encode()).hexdigest()[:16]


# the model -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class DrivenAxis(RigidJoint):
    """The axis of a file as the one-joint model sees it."""

    config: AxisConfig
    follows_line: ClassVar[bool] = True

    @property
    def signal(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.config.name

    @property
    def unit(self) -> Literal["rad", "m"]:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.config.unit

    @property
    def gains(self) -> Gains:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.config.gains

    @property
    def command_hz(self) -> float:  # pyright: ignore[reportIncompatibleVariableOverride]
        """A target that is no position is held until the next one."""
        if self.config.command_hz is not None:
            return self.config.command_hz
        return 0.0 if self.config.law in _COMMANDS else 150.0

    @property
    def target_kind(self) -> TargetKind:  # pyright: ignore[reportIncompatibleVariableOverride]
        kinds: dict[str, TargetKind] = {"velocity": "velocity", "torque": "torque"}
        return kinds.get(self.config.law, "position")

    @property
    def facts(self) -> dict[str, float]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Numbers of ``joint_kernel.Drive`` that the file knows."""
        c = self.config
        found: dict[str, float] = {"command": _COMMANDS.get(c.law, POSITION), "midpoint": 1.0}
        limit = math.inf if c.effort_limit is None else c.effort_limit
        if c.law == "pwm":
            found |= {"duty_torque": c.stall_nm, "back_emf": c.back_emf}
        if math.isfinite(limit):
            found["torque_max"] = limit
        return found

    def timestep_s(self, rate_hz: float) -> float:
        c = self.config
        damping = c.gains.kd + (c.back_emf if c.law == "pwm" else 0.0)
        wanted = min(LONGEST_STEP_S, max(SHORTEST_STEP_S, STEP_SHARE * c.inertia / max(damping, 1e-9)))
        return 1.0 / (rate_hz * math.ceil(1.0 / (wanted * rate_hz) - 1e-6))

    def rigid(self, motion: "JointMotion", bodies: Sequence[Effect]) -> Rigid:
        c = self.config
        weight = motion.moment_kgm * GRAVITY_M_PER_S2  # m l g sin(q − q₀)
        sine, cosine = weight * math.cos(c.hangs_at_rad), -weight * math.sin(c.hangs_at_rad)
        return Rigid(c.inertia + motion.mounted_kgm2, 0.0, c.weight_sin + sine, c.weight_cos + cosine)

    def surroundings(self, m: Measurement) -> Surroundings:
        """The known external force, with the sign of what must be held against it, what is mounted, and the motor's supply.

        Raises:
            TaccorlError: a payload without a lever, an arm on a slide, a supply voltage that the law has no use for.
        """
        c, name = self.config, self.signal
        payload, lever, arm = (
            getattr(m, key).get(name, getattr(c, key, 0.0)) for key in ("payload_kg", "lever_m", "arm_kg")
        )
        if c.unit == "m" and (lever or arm):
            raise TaccorlError(f"{m.name}: lever_m or arm_kg of {name} is stated, and a slide has none; remove it")
        if c.unit == "rad" and payload + arm > 0.0 and lever == 0.0:
            raise TaccorlError(
                f"{m.name}: payload_kg or arm_kg of {name} is stated, and nothing says how long its arm is; write `lever_m: …` "
                f"in the axis file, or `lever_m: {{{name}: …}}` in measurements.yaml"
            )
        return Surroundings(
            coupling_nm=-m.known_load(name),
            supply=self._supply(m),
            payload_kg=payload,
            payload_at_known=True,
            moment_kgm=payload * lever + 0.5 * arm * lever,
            mounted_kgm2=payload * lever**2 + arm * lever**2 / 3.0 if c.unit == "rad" else payload,
        )

    def _supply(self, m: Measurement) -> np.ndarray:
        """(T,) voltage over that of the file; NaN while the motor is off."""
        j, share = m.column(self.signal), np.ones(m.num_rows)
        if m.supply_v.size and np.isfinite(m.supply_v[:, j]).any():
            if self.config.supply_v is None:
                raise TaccorlError(
                    f"{m.name}: a supply voltage of {self.signal} is stated, and law {self.config.law} has no use for it; "
                    "remove it"
                )
            share = np.nan_to_num(m.supply_v[:, j] / self.config.supply_v, nan=1.0)
        return np.where(m.enabled[:, j] == 0.0, np.nan, share) if m.enabled.size else share

    def effects(self, more: Sequence[Effect]) -> list[Effect]:
        own = {e.name: e for e in (*self.config.made(), *more)}
        return [effect for effect in own.values() if not effect.is_absent]

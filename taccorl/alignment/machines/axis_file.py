"""An axis file: a single driven axis, such as a slide on a bench, a wheel, or a servo with a pendulum. ``docs/your_robot.md`` has
one with its keys. Laws and targets are those of ``drive_law``.

A mass that a recording mounts on a turning axis adds the inertia m l² and the weight m g l sin(q − q₀): ``payload_kg`` at
``lever_m``, and an arm of ``arm_kg``, a uniform rod of that length.
"""

import copy
import dataclasses
import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import yaml

from taccorl.alignment.controller.drive_law import WINDING, DriveJoint, DriveLaw
from taccorl.alignment.controller.joint_motion import JointMotion, Surroundings
from taccorl.alignment.controller.rigid_joint import NEED_ROTOR, Rigid
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.data.strict_yaml import Document
from taccorl.errors import TaccorlError, nearest, plain_name
from taccorl.sim.effects import effects as registry
from taccorl.sim.effects.effect import Effect, JointEffect
from taccorl.sim.effects.scaled import OF_A_TURN, Scale, scaled
from taccorl.sim.settings import check_numbers

GRAVITY_M_PER_S2 = 9.81
_HEADER = (
    "# An axis: taccorl/alignment/machines/axis_file.py says what may stand here.\n"
)


@dataclass(frozen=True)
class EffectEntry:
    """An effect as in the file, in the units of the axis."""

    name: str
    values: Mapping[str, Any]  # Parameter → value


@dataclass(kw_only=True)
class AxisConfig(DriveLaw):
    """One driven axis. Its gains apply unless a recording states others. Units are for a turning axis; for a slide read N for
    N·m, m for rad, kg for kg·m²."""

    kind: Literal["axis"] = "axis"
    name: str
    unit: Literal[
        "rad", "m"
    ]  # Unit of its position: rad of a turning axis, m of a slide
    inertia: float  # Inertia about the axis [kg·m²], at which a fit starts
    gains: Literal["commanded", "fitted"] = "commanded"
    """``commanded``: the drive runs kp and kd. ``fitted``: nobody knows them, they are the start of a fit, which without efforts
    leaves ``inertia`` as it is, because positions determine ratios only. Not for law pwm, whose motor is fitted."""
    rotor_inertia: float = 0.0
    """Share of ``inertia`` on the motor's side of the gear [kg·m²]; without it play and compliance are not searched."""
    weight_sin: float = (
        0.0  # S [N·m] in the torque S sin q + C cos q that holds the axis's own weight
    )
    weight_cos: float = 0.0
    """C [N·m] in the torque S sin q + C cos q that holds the weight of a turning axis at angle q; of a slide, its weight [N]."""
    payload_kg: float = 0.0
    """Mass that the axis carries [kg], unless a recording states another one; not part of ``inertia``."""
    lever_m: float = 0.0
    """Distance from the axis at which ``payload_kg`` is held, unless a recording states another one; not for slides."""
    arm_kg: float = 0.0
    """Mass of the arm that holds the payload [kg], unless a recording states another one: a uniform rod as long as the lever."""
    hangs_at_rad: float = (
        0.0  # Angle at which the payload of ``lever_m`` hangs straight down [rad]
    )
    loop_hz: float | None = None
    """Rate of the drive's control loop [Hz], if known. The model then holds the loop's output for a period, and computes the
    speed as a difference of samples."""
    command_hz: float | None = None
    """Rate at which the drive receives targets [Hz], if they are logged at a lower rate: a replay then interpolates the rows
    linearly at this rate. If not given, a target is held until the next one."""
    target_late_s: float = 0.0
    """Delay from the time of a target's row until it acts [s], including transport and reading of the position. ``diagnose``
    fits up to 3 ms of it; a longer delay is an effect."""
    speed_late_s: float = 0.0
    """Delay of the speed in the drive's loop [s] beyond that of a difference of two samples: its filter. Write minus half a
    period if the drive measures the speed. ``diagnose`` fits up to two periods; without efforts up to 3 ms, if that is more."""
    limits: tuple[float, float] | None = None  # Lowest and highest position [rad]
    force_unit_n: float | None = None
    """Torque of this axis [N·m] that corresponds to 1 N·m at a joint of a small arm; the bounds of effects are multiplied by it.
    If not given: a tenth of effort_limit, or 1 without that."""
    length_unit_m: float | None = None
    """Position range [rad] that corresponds to 1 rad at a joint of a small arm. If not given: the stroke of a slide, or 1."""
    effects: tuple[
        EffectEntry, ...
    ] = ()  # Effects beyond inertia, weight and control law; empty if there are none
    FITTED: ClassVar[tuple[str, ...]] = (
        *DriveLaw.FITTED,
        *WINDING,
        *("inertia", "weight_sin", "weight_cos", "target_late_s", "speed_late_s"),
    )

    def __post_init__(self) -> None:
        plain_name(self.name, "axis.name")
        check_numbers("axis", self, positive=("inertia",))
        check_numbers(
            "axis",
            self,
            not_negative=(
                "payload_kg",
                "lever_m",
                "arm_kg",
                "rotor_inertia",
                "target_late_s",
            ),
        )
        if self.rotor_inertia > self.inertia:
            raise TaccorlError(
                f"axis.rotor_inertia: {self.rotor_inertia:g} is greater than inertia, {self.inertia:g}, of which it is a part; "
                "correct one of them"
            )
        check_numbers("axis", self, finite=("weight_sin", "weight_cos", "hangs_at_rad"))
        optional = ("loop_hz", "command_hz", "force_unit_n", "length_unit_m")
        check_numbers(
            "axis",
            self,
            positive=[name for name in optional if getattr(self, name) is not None],
        )
        if not self.speed_late_s >= (
            newest := -0.5 / self.loop_hz if self.loop_hz else 0.0
        ):
            raise TaccorlError(
                f"axis.speed_late_s: is {self.speed_late_s:g} s; write at least {newest:g} s, minus half a period of "
                "loop_hz: the value of a measured speed"
            )
        self.check_law("axis")
        self.check_known(
            "axis",
            {
                e.name: [p.name for p in registry.get(e.name).parameters()]
                for e in self.effects
            },
        )
        if self.gains == "fitted" and not (self.gain_names and self.law != "pwm"):
            raise TaccorlError(
                f"axis.gains: law {self.law} has no gains to fit; remove this key"
            )
        if self.limits is not None and not self.limits[0] < self.limits[1]:
            raise TaccorlError(
                f"axis.limits: {list(self.limits)} must be ascending; write the lowest position first"
            )
        of_turning = ("weight_sin", "lever_m", "arm_kg", "hangs_at_rad")
        of_turning = [name for name in of_turning if getattr(self, name)]
        if self.unit == "m" and of_turning:
            raise TaccorlError(
                f"axis.{of_turning[0]}: does not apply to a slide, whose weight [N] is weight_cos; remove this key"
            )

    @property
    def scale(self) -> Scale:
        """Size of the axis's forces and motions relative to a joint of a small arm; bounds of effects are multiplied by it."""
        force = self.force_unit_n or (self.effort_limit or 10.0) / 10.0
        stroke = (
            self.limits[1] - self.limits[0] if self.limits and self.unit == "m" else 1.0
        )
        drive = (
            1.0 / self.loop_gains.kp
            if self.loop_gains.kp > 0.0 and self.law != "effort"
            else 0.0
        )
        return Scale(
            unit=self.unit,
            force=force,
            length=self.length_unit_m or stroke,
            drive=drive,
        )

    def effect_class(self, name: str) -> type[Effect] | None:
        """Class of the effect ``name`` with the size and units of this axis; None if an axis cannot have it. Raises TaccorlError:
        there is no such effect."""
        cls = registry.get(name)
        if (
            not issubclass(cls, JointEffect)
            or (self.unit == "m" and name in OF_A_TURN)
            or not self.allows_effect(name)
        ):
            return None
        own = scaled(name, self.scale)
        numbers: dict[str, Any] = {p.name: p.typical for p in own.parameters()}
        return (
            own
            if own(**numbers).drive() and (self.rotor_inertia or name not in NEED_ROTOR)
            else None
        )

    def made(self) -> list[Effect]:
        """The effects of the file, as objects, in the order of the file. Raises TaccorlError: an effect cannot act on this axis,
        or has no such parameter."""
        found = []
        for entry in self.effects:
            name, values = entry.name, dict[str, Any](entry.values)
            if name in [effect.name for effect in found]:
                raise TaccorlError(
                    f"effects: {name} stands twice, and an axis has one of each effect; remove one"
                )
            cls = self.effect_class(name)
            if cls is None and name in NEED_ROTOR and not self.rotor_inertia:
                raise TaccorlError(
                    f"effects: {name} needs the motor's share of inertia: write `rotor_inertia: …`"
                )
            if cls is None:
                raise TaccorlError(f"effects: {name} cannot act on an axis; remove it")
            settings = [*(p.name for p in cls.parameters()), "interval", "evidence"]
            for key in values:
                if key not in settings:
                    raise TaccorlError(
                        f"effects: {name} has no parameter {key!r}; {nearest(key, settings)}"
                    )
            found.append(cls(**values))
        return found

    def with_numbers(self, base: Mapping[str, float]) -> "AxisConfig":
        """Copy of the axis with fitted numbers: ``base`` maps names as in ``AxisProblem`` to values."""
        same = ("inertia", "weight_sin", "weight_cos", "target_late_s", "speed_late_s")
        new = {name: base[name] for name in same if name in base}
        new |= self.law_numbers(base)
        if base.get("loop_s", 0.0) > 0.0:
            new["loop_hz"] = 1.0 / base["loop_s"]
        if "inertia" in new:
            new["rotor_inertia"] = new["inertia"] * min(
                self.rotor_inertia / self.inertia, 1.0
            )
        changed = copy.copy(self)
        for name, value in new.items():
            object.__setattr__(
                changed, name, float(value)
            )  # without the checks, which take as long as a simulation
        return changed

    def with_effects(self, found: Sequence[Effect]) -> "AxisConfig":
        """Copy of the axis with these effects in addition; one of the same name is replaced, and one that is absent taken out."""
        names = {e.name for e in found}
        entries = [e for e in self.effects if e.name not in names]
        entries += [EffectEntry(e.name, _values(e)) for e in found if not e.is_absent]
        return dataclasses.replace(self, effects=tuple(entries))


def _values(effect: Effect) -> dict[str, Any]:
    values: dict[str, Any] = {
        p.name: float(getattr(effect, p.name)) for p in effect.parameters()
    }
    if effect.interval:
        values["interval"] = {
            name: (float(low), float(high))
            for name, (low, high) in effect.interval.items()
        }
    if effect.evidence:
        values["evidence"] = effect.evidence
    return values


def load_axis(path: Path) -> AxisConfig:
    """Load an axis file. Raises SpecError: a key or value is wrong; the message names file and line."""
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
                raise self.error(
                    text.split(":", 1)[0].removeprefix("axis."), text.split(": ", 1)[1]
                ) from error
            raise self.error("effects", text.removeprefix("effects: ")) from error

    def _entry(self, node: yaml.Node, key: str) -> EffectEntry:
        self._lines.setdefault(key, node.start_mark.line + 1)
        items = dict(self._items(node, key))
        if "effect" not in items:
            raise self.error(
                key,
                "key 'effect' is missing; it names the effect (`taccorl effects` lists all)",
            )
        name = self._scalar(str, items.pop("effect"), f"{key}/effect")
        if name not in registry:
            raise self.error(
                f"{key}/effect", f"no effect {name!r}; {nearest(name, registry)}"
            )
        kinds: dict[str, Any] = {
            "interval": dict[str, tuple[float, float]],
            "evidence": str,
        }
        values = {
            k: self._build(kinds.get(k, float), child, f"{key}/{k}")
            for k, child in items.items()
        }
        return EffectEntry(name, values)


def axis_text(config: AxisConfig) -> str:
    """YAML text of an axis file; keys with default values are left out."""
    content: dict[str, Any] = {"kind": "axis"}
    law = {f.name for f in dataclasses.fields(DriveLaw)}
    for field in sorted(dataclasses.fields(config), key=lambda f: f.name in law):
        value = getattr(config, field.name)
        if field.name not in ("kind", "effects") and value != field.default:
            content[field.name] = list(value) if isinstance(value, tuple) else value
    if config.effects:
        content["effects"] = [
            {"effect": e.name} | _plain(e.values) for e in config.effects
        ]
    return _HEADER + yaml.safe_dump(
        content, sort_keys=False, allow_unicode=True, default_flow_style=None, width=120
    )


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    return (
        [_plain(item) for item in value] if isinstance(value, tuple | list) else value
    )


def axis_digest(config: AxisConfig) -> str:
    """Digest of an axis, 16 hexadecimal digits; only equal axes have equal digests."""
    return hashlib.sha256(axis_text(config).encode()).hexdigest()[:16]


class DrivenAxis(DriveJoint):
    """The axis of a file for the one-joint model."""

    def __init__(self, config: AxisConfig, stated: AxisConfig | None = None) -> None:
        """``stated``: axis as its file has it, if numbers of ``config`` are fitted; a fitted ``loop_hz`` does not change the
        physics step."""
        super().__init__(
            config, config.name, config.unit, config.loop_hz, config.command_hz
        )
        self.config, self._stated, self.target_late_s = (
            config,
            stated or config,
            config.target_late_s,
        )
        late_s = config.speed_late_s if config.loop_hz and config.kd else 0.0
        self.facts = {
            **self.facts,
            "speed_age": self.speed_delay_s,
            "speed_delay__delay_s": late_s,
        }
        self.speed_delay_s = self.speed_delay_s + late_s if config.kd else 0.0

    def joint(self, signal: str) -> "DrivenAxis":
        """The axis itself, which is its only joint (interface ``HasJoints``)."""
        return self

    def timestep_s(self, motion: JointMotion) -> float:
        return self.config.timestep_s(
            motion.rate_hz, self.config.inertia, motion.kp_scale, self._stated.loop_hz
        )

    def rigid(self, motion: JointMotion, bodies: Sequence[Effect]) -> Rigid:
        c = self.config
        if c.unit == "m":
            return Rigid(
                c.inertia + motion.mounted_kgm2, c.rotor_inertia, weight_n=c.weight_cos
            )
        weight = motion.moment_kgm * GRAVITY_M_PER_S2  # m l g sin(q − q₀)
        sine, cosine = (
            weight * math.cos(c.hangs_at_rad),
            -weight * math.sin(c.hangs_at_rad),
        )
        return Rigid(
            c.inertia + motion.mounted_kgm2,
            c.rotor_inertia,
            c.weight_sin + sine,
            c.weight_cos + cosine,
        )

    def surroundings(self, m: Measurement) -> Surroundings:
        """Mounted masses besides. Raises TaccorlError: there is a payload without a lever, or an arm on a slide."""
        c, name = self.config, self.signal
        payload, lever, arm = (
            getattr(m, key).get(name, getattr(c, key))
            for key in ("payload_kg", "lever_m", "arm_kg")
        )
        if c.unit == "m" and (lever or arm):
            raise TaccorlError(
                f"{m.name}: lever_m or arm_kg of {name} is stated, but a slide has no lever; remove it"
            )
        if c.unit == "rad" and payload + arm > 0.0 and lever == 0.0:
            raise TaccorlError(
                f"{m.name}: payload_kg or arm_kg of {name} is stated, but the length of its lever is not; write `lever_m: …` "
                f"in the axis file, or `lever_m: {{{name}: …}}` in measurements.yaml"
            )
        return dataclasses.replace(
            super().surroundings(m),
            payload_kg=payload,
            payload_at_known=True,
            moment_kgm=payload * lever + 0.5 * arm * lever,
            mounted_kgm2=payload * lever**2 + arm * lever**2 / 3.0
            if c.unit == "rad"
            else payload,
        )

    def effects(self, more: Sequence[Effect]) -> list[Effect]:
        own = {e.name: e for e in (*self.config.made(), *more)}
        return [effect for effect in own.values() if not effect.is_absent]

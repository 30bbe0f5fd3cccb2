"""Base classes of effects: a physical mechanism with parameters, each with unit, bounds and the value at which it is absent.

An effect acts through as few of the hooks of ``Effect`` as it needs, ``edit`` to ``picture_age_s``, and keeps what they must
know later in ``memory``, which is part of ``Simulation.snapshot``, so that runs go on bit-exactly.

An effect all of whose parameters stand at their absent values is not built at all: no joint, no buffer, no hook. That makes
the twin with it bit-identical to the twin without it. What remains to be shown is that the absent value is where the effect
fades out, and ``tests/sim/effects/test_every_effect.py`` shows both for every registered class, outside packages' included.

A twin with an effect that rewrites makes its physics steps one by one and looks at the forces after each. A control step takes
2.4 times as long with 16 simulations, and 4 times with one: this is for what no element of MuJoCo does.

Two entries of one effect may not act on the same joint or pad. Entries act in the order of ``SLOTS``, then by name: how the
file lists them does not matter. The one-joint model (``alignment.controller.joint_kernel``) computes the effects of
``JOINT_SLOTS`` by itself; its fields are named after them (``Effect.drive``).

Letters in shapes: N simulations, A numbers of an action, P pads, R rows and C columns of a pad.
"""

import dataclasses
import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import (
    TYPE_CHECKING,
    Any,
    ClassVar,
    Literal,
    cast,
    dataclass_transform,
    get_args,
)

import mujoco
import numpy as np

from taccorl.errors import TaccorlError, nearest
from taccorl.plugins import Registry
from taccorl.robots import ROBOT
from taccorl.sim.effects.prose import prose

if TYPE_CHECKING:
    from taccorl.sim.effects.live_model import LiveModel
    from taccorl.sim.twin import TwinConfig

    ArmChoice = str
else:  # the names that a twin.yaml may give: others are an error with its line
    ArmChoice = Literal[*ROBOT.arms, "both"]

Kind = Literal["joint", "pads", "camera", "cells", "scene"]
"""Kind of a part on which effects act: a driven joint of any robot or axis, the pads of a hand, a camera, a sensor of cells, or
loose parts."""
KINDS: tuple[Kind, ...] = ("joint", "pads", "camera", "cells", "scene")
NEEDS = {
    "target": "commands that are sent to the joint's controller",
    "position": "the joint's position",
    "velocity": "the joint's velocity",
    "acceleration": "the joint's acceleration",
    "effort": "the torque or force that the motor gives",
    "load": "the torque or force that the gear passes on to the load",
    "dry_friction": "dry friction that the joint's file states",
    "weight": "a controller that compensates the weight",
    "bodies": "a model of all moving bodies",
    "contact": "a model of the touched parts",
    "depth": "how deep each taxel is in a known object",
    "reading": "readings of taxels or cells",
    "neighbours": "more than one cell",
    "temperature": "the temperature beside the readings",
    "picture": "pictures of a camera",
}
"""Word in ``Effect.needs`` → knowledge that a model must have for the effect to be computed."""
Memory = dict[str, np.ndarray]
"""State of an effect between steps: name → array (N, …), changed in place."""
CELLS = "cells"
"""Value of ``TouchEffect.pads`` for an effect on a sensor of cells, which a cells file describes."""
Slot = Literal[
    "body", "command", "encoder", "law", "torque", "gear", "friction", "load",
    "robot", "material", "spread", "taxel", "baseline", "camera",
]  # fmt: skip
"""Place in the chain from the command to the picture at which an effect acts: masses; the command's way; what the controller
sees, its law and the motor's torque; gear, friction and what else turns a joint; other parts of a robot; a pad's rubber before
its wiring, and the wiring before the subtraction of the baseline; cameras."""
SLOTS: tuple[Slot, ...] = get_args(Slot)
"""Order in which effects act."""
JOINT_SLOTS: tuple[Slot, ...] = SLOTS[SLOTS.index("command") : SLOTS.index("robot")]
"""Slots of the project's effects that the one-joint model computes; an effect of one's own takes ``robot``."""
TOUCH_SLOTS: tuple[Slot, ...] = SLOTS[SLOTS.index("material") : SLOTS.index("camera")]
"""Slots of effects on readings."""


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """One parameter of an effect: its name, unit, bounds, and the value at which the effect is absent."""

    name: str  # Name of the effect's field, with the unit as suffix
    unit: str  # Unit as text, such as ``N·m`` or ``1``
    symbol: str  # Symbol in the effect's equation
    absent: float | None
    """Value at which the effect does nothing. None: the parameter only shapes the effect, and has no meaning while the effect is
    absent."""
    low: float  # Lower bound
    high: float  # Upper bound; with ``low`` the range for fitting. Other values are rejected (``Effect.accepted``)
    typical: float  # Value for a robot such as the PiPER, at which a search starts
    source: str  # Where ``typical`` and the bounds come from
    over: Literal["", "kp"] = ""
    """``kp``: a torque, stiffness, damping, inertia or mass. From positions alone only (value − absent) / K_p is identifiable
    (``diagnosis.search.identifiable``). Empty: a time, an angle, a speed or a share, which positions identify by itself."""


def number(
    symbol: str,
    unit: str,
    absent: float | None,
    typical: float,
    bounds: tuple[float, float],
    source: str = "a choice",
    *,
    over_kp: bool = False,
) -> Any:
    """A dataclass field that holds a ``Parameter`` with these values; its default is the absent value, or else the typical
    one. ``over_kp`` is ``Parameter.over``."""
    low, high = map(float, bounds)
    meta = {
        "unit": unit,
        "symbol": symbol,
        "absent": None if absent is None else float(absent),
    }
    meta |= {
        "low": low,
        "high": high,
        "typical": float(typical),
        "source": source,
        "over": "kp" if over_kp else "",
    }
    return field(
        default=float(typical if absent is None else absent),
        metadata={"parameter": meta},
    )


class _Text:
    """A text about an effect from the page of effects, read when it is first asked for."""

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, effect: "Effect | None", cls: "type[Effect]") -> Any:
        return getattr(prose(getattr(cls, "name", "")), self._name)


@dataclass(kw_only=True)
class Effect:
    """Base of all effects. An effect is a physical mechanism that a twin may have or lack, here a dataclass of its parameters,
    with their intervals and the evidence."""

    name: ClassVar[str]
    """Name under which the effect is registered."""
    slot: ClassVar[Slot]
    """Place in the order ``SLOTS`` in which effects act."""
    needs: ClassVar[tuple[str, ...]]
    """Facts that a model of the part must have so that the effect can be computed, as keys of ``NEEDS``."""
    # Texts for reports and docs/effects.md; by default read from the effect's section of effects.md in this folder.
    equation: ClassVar[str] = cast("str", _Text())
    in_words: ClassVar[str] = cast("str", _Text())
    """Description of the effect on a robot, for readers who do not know it."""
    at_a_policy: ClassVar[str] = cast("str", _Text())
    """Influence on a policy that was trained without the effect."""
    to_record: ClassVar[str] = cast("str", _Text())
    """Recording that shows the effect."""
    near_twins: ClassVar[Mapping[str, str]] = cast("dict[str, str]", _Text())
    """Name of another effect, or of a number that is always fitted (kp, kd, torque_ff, k_n, k_d) → why measurements can hardly
    tell them apart, and which recording can."""

    range_by: ClassVar[str] = ""
    """End of the message for a parameter outside its bounds: the keys of the joint's file that set them; empty if none does."""
    reduces_to: ClassVar[dict[str, str]] = {}
    """Name of a simpler effect → parameter of this effect, without unit; at its lower bound both effects are equal. A fitted
    value less than 0.1 above that bound is rejected in favour of the simpler effect."""
    equals_when_wide: ClassVar[dict[str, str]] = {}
    """Name of a simpler effect → parameter of this effect; at its upper bound both effects are equal."""
    same_with_torque_ff: ClassVar[tuple[str, ...]] = ()
    """Names of effects that give the same positions in every motion if a constant torque (``torque_ff``) is fitted, too: only
    the motor's effort tells them apart."""
    optional: ClassVar[dict[str, str]] = {}
    """Parameter that a fit may leave out → effect of the same meaning, beside which it is left out, or "". Else it is fitted
    where that is clearly better."""
    fitted: ClassVar[bool] = True
    """Whether a search may fit the effect. False for effects that differ between recordings of the same motion: least squares
    cannot fit them, so that they are not candidates, and a twin keeps its own unchanged."""
    rewrites: ClassVar[tuple[str, ...]] = ()
    """Fields of ``mujoco.MjModel``, or ``qfrc_applied`` of ``mujoco.MjData``, that ``rewrite`` changes."""

    interval: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Parameter → 95 % interval of its estimate, in the parameter's unit."""
    evidence: str = ""
    """Text: the measurements that show the effect, and the error before and after."""

    def __post_init__(self) -> None:
        if "__dataclass_fields__" not in type(self).__dict__:
            raise TaccorlError(
                f"effect {self.name}: class {type(self).__name__} lacks its @dataclass(kw_only=True)"
            )
        known = {p.name: p for p in self.parameters()}
        for p in known.values():
            setattr(self, p.name, self._checked(p, getattr(self, p.name)))
        for name, ends in self.interval.items():
            if name not in known:
                raise TaccorlError(
                    f"effect {self.name}: interval of no parameter, {name!r}; {nearest(name, known)}"
                )
            if len(ends) != 2 or not all(map(math.isfinite, ends)) or ends[0] > ends[1]:
                raise TaccorlError(
                    f"effect {self.name}: interval of {name} is {ends}; give two numbers, low and high"
                )
        self.interval = {
            name: (float(low), float(high))
            for name, (low, high) in self.interval.items()
        }

    def _checked(self, p: Parameter, value: float) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float | np.number):
            raise TaccorlError(
                f"effect {self.name}: {p.name} is {value!r}; give a number in {p.unit}"
            )
        low, high = self.accepted(p)
        if value != p.absent and not low <= value <= high:
            unit = "" if p.unit == "1" else f" {p.unit}"
            range_ = f"{low:g} … {high:g}{unit}{self.range_by}"
            raise TaccorlError(
                f"effect {self.name}: {p.name} is {value:g}{unit}, outside of {range_}"
            )
        return float(value)

    @classmethod
    def accepted(cls, p: Parameter) -> tuple[float, float]:
        """Lowest and highest value that a file may state: the bounds, except of effects whose bounds depend on the machine."""
        return p.low, p.high

    @classmethod
    @cache  # a search makes thousands of effects of a class
    def parameters(cls) -> tuple[Parameter, ...]:
        """Parameters of the effect, in the order of the class's fields."""
        fields = [f for f in dataclasses.fields(cls) if "parameter" in f.metadata]
        if all(f.metadata["parameter"]["absent"] is None for f in fields):
            raise TaccorlError(
                f"effect {cls.name}: one of its parameters must have an absent value ({cls.__module__})"
            )
        return tuple(Parameter(name=f.name, **f.metadata["parameter"]) for f in fields)

    @classmethod
    def clipped(cls, name: str, value: float) -> float:
        """``value`` within the bounds of the parameter ``name``."""
        p = next(p for p in cls.parameters() if p.name == name)
        return float(min(max(value, p.low), p.high))

    @classmethod
    def settings(cls) -> list[str]:
        """Names of all fields that can be set: parameters, selectors, intervals and evidence."""
        return [f.name for f in dataclasses.fields(cls)]

    @classmethod
    def kinds(cls) -> tuple[Kind, ...]:
        """Kinds of parts on which it can act, in words of ``KINDS``; ``scene`` unless a subclass states others."""
        return ("scene",)

    @classmethod
    def works_with(cls, gives: Collection[str]) -> bool:
        """Whether a model that has the facts ``gives`` (keys of ``NEEDS``) can compute the effect."""
        return set(cls.needs) <= set(gives)

    @property
    def is_absent(self) -> bool:
        """Whether all parameters that have an absent value have it."""
        return all(
            getattr(self, p.name) == p.absent
            for p in self.parameters()
            if p.absent is not None
        )

    @property
    def reads_as(self) -> str:
        """What the values of the parameters mean, in words, where the effect's name does not say it; else empty."""
        return ""

    @classmethod
    def starts(cls, seen: Mapping[str, float]) -> list[dict[str, float]]:
        """Start values of a search: one dict of parameters for each start; parameters left out have their typical values.

        By default a third of, equal to and three times the typical strength, with both signs if the parameter has two; for a
        torque 3, 10 and 30 % of the largest commanded torque. ``seen``: facts of the recordings on which start values may
        depend. Of joints: ``peak_torque_nm`` that the twin's controller commands, ``peak_motor_nm`` including gravity
        compensation, ``peak_measured_nm`` of efforts, ``peak_speed_rad_per_s`` and ``span_rad`` of the targets,
        ``lowest_rad`` and ``highest_rad`` that were measured, ``duration_s``."""
        strength, absent = next(
            (p, p.absent) for p in cls.parameters() if p.absent is not None
        )
        if not math.isfinite(absent):
            return [{}]
        shift = strength.typical - absent
        two_sided = (
            strength.low <= absent - abs(shift) and absent + abs(shift) <= strength.high
        )
        shares = (-1.0, 1.0) if two_sided else (1 / 3, 1.0, 3.0)
        if strength.unit == "N·m" and seen.get("peak_torque_nm", 0.0) > 0:
            shift, shares = min(seen["peak_torque_nm"], strength.high), (0.03, 0.1, 0.3)
        values = [absent + share * shift for share in shares]
        return [
            {strength.name: v} for v in values if strength.low <= v <= strength.high
        ]

    def drive(self) -> dict[str, float] | None:
        """Field of ``Drive`` in ``alignment.controller.joint_kernel``, ``EFFECT__PARAMETER``, → value. An effect of one's own may
        return fields of the project's effects.

        None: the one-joint model does not have the effect, and identification uses MuJoCo. Empty: the effect changes bodies only,
        and inertia and weight are read from the compiled model."""
        if self.slot == "body":
            return {}
        own = {
            f"{self.name}__{p.name}": getattr(self, p.name) for p in self.parameters()
        }
        return own if self.slot in JOINT_SLOTS else None

    def acts_on(self) -> list[str]:
        """Names of the joints, arms or pads on which the effect acts."""
        raise NotImplementedError

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        """Change the twin's model specification ``spec``, which is complete: arms, parts, sensors. MuJoCo then does the work."""

    def friction(self, friction: float) -> float:
        """Sliding friction coefficient of parts and fixtures for the scene's coefficient ``friction``; called at every reset."""
        return friction

    def memory(self, num_sims: int, pad_shape: tuple[int, int]) -> Memory:
        """Name → array (N, …) as it is after a reset of ``num_sims`` simulations, before ``command`` receives the targets at
        rest. ``pad_shape`` are rows and columns of the sensor's pads."""
        return {}

    def begin(self, memory: Memory, ids: np.ndarray, seeds: np.ndarray) -> None:
        """Prepare ``memory`` for new episodes of the simulations ``ids`` (n,), after a reset to its initial state. ``seeds`` (n,)
        are the seeds of the episodes, for effects that draw random numbers; 0 in simulations for a diagnosis."""

    def command(
        self, targets: np.ndarray, memory: Memory, dt_s: np.ndarray
    ) -> np.ndarray:
        """Targets (N, A) [rad, m] that arrive at the controllers when ``targets`` (N, A) are sent, 150 times a second.

        ``dt_s`` (N,) is the time for which they will be held [s]: 0 for simulations that do not advance, whose memory must not
        change; and after a reset, when the targets are those at rest."""
        return targets

    def feel(
        self, live: "LiveModel", memory: Memory, ids: np.ndarray, dt_s: float
    ) -> None:
        """Called after a physics step of ``dt_s`` [s]: store in ``memory`` what ``rewrite`` needs of the simulations ``ids``
        (n,). Forces are current. ``dt_s`` is 0 after a reset, when the state counts as constant in the past; if no effect of
        the twin has ``rewrites``, the hook is called after resets only."""

    def rewrite(self, live: "LiveModel", memory: Memory) -> None:
        """Write new values into ``live.own(field)`` for each field of ``rewrites``, of all simulations at once.

        Called after a reset and after each physics step, for the next step. Before the call the fields have the compiled model's
        values (``qfrc_applied``: zero) with the changes of earlier effects. The new values may depend only on the memory and the
        simulations' time, so that a restored simulation continues identically."""

    def encoder(self, values: np.ndarray) -> np.ndarray:
        """Reported values (N, A) [rad, m] for the true joint angles and openings ``values`` (N, A)."""
        return values

    def reading(
        self, reading: np.ndarray, memory: Memory, time_s: np.ndarray, dt_s: np.ndarray
    ) -> np.ndarray:
        """Readings of the pads with the effect. ``reading`` (N, P, R, C) are those of ideal pads: from the sensor's law, 0
        without contact, before gain, noise and rounding. Returns a new array of the same shape and float type.

        ``time_s`` (N,) is the time since the reset, ``dt_s`` (N,) since the last scan [s]. ``memory`` is kept from one scan to
        the next. Calls outside of scans get a copy of it, and with ``dt_s`` = 0 must return the reading of the last scan."""
        return reading

    def picture(self, picture: np.ndarray, scale: float) -> np.ndarray:
        """Picture with the effect, same shape, from ``picture`` (rows, columns, 3), float32, 0 … 255, of a camera in ``acts_on``,
        without black bars. ``scale``: its columns over those that the camera records, 0.35 for 224 of 640."""
        return picture

    def picture_age_s(self) -> float:
        """Age [s] of the pictures of the cameras in ``acts_on``."""
        return 0.0


@dataclass(kw_only=True)
class ArmEffect(Effect):
    """Base of effects on whole arms."""

    slot: ClassVar[Slot] = "robot"
    arm: ArmChoice = "both"
    """Name of one arm of the robot, or ``both`` for all of them."""

    @classmethod
    def kinds(cls) -> tuple[Kind, ...]:
        return ("joint",)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.arm not in (*ROBOT.arms, "both"):
            raise TaccorlError(
                f"effect {self.name}: no arm {self.arm!r}; {nearest(self.arm, (*ROBOT.arms, 'both'))}"
            )

    def arms(self) -> list[str]:
        return [arm for arm in ROBOT.arms if self.arm in (arm, "both")]

    def acts_on(self) -> list[str]:
        return self.arms()


@dataclass(kw_only=True)
class JointEffect(ArmEffect):
    """Base of effects on single joints, with the same parameters for all chosen joints. Joints with different parameters need
    one entry each."""

    possible: ClassVar[tuple[str, ...]] = ROBOT.joints
    """Names that ``joints`` may contain."""
    kept: ClassVar[tuple[str, ...]] = ()
    """Names of arrays (N, number of chosen joints) in the memory, zeros after a reset, which ``look`` renews after each physics
    step."""
    joints: list[str] = field(default_factory=lambda: list(ROBOT.joints))
    """``joint1`` … ``joint6``, which the paper calls J0 … J5; for some effects ``gripper``, too."""

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_chosen(self.name, "joint", self.joints, self.possible)

    def acts_on(self) -> list[str]:
        return [f"{arm}_{joint}" for arm in self.arms() for joint in self.joints]

    @property
    def columns(self) -> list[int]:
        """Indices of the chosen joints in the vectors (A,) of targets and reported values."""
        return [ROBOT.action_names.index(name) for name in self.acts_on()]

    def memory(self, num_sims: int, pad_shape: tuple[int, int]) -> Memory:
        return {name: np.zeros((num_sims, len(self.acts_on()))) for name in self.kept}

    def look(self, live: "LiveModel") -> Sequence[np.ndarray]:
        """New values (N, number of chosen joints) of the arrays ``kept``."""
        return ()

    def feel(
        self, live: "LiveModel", memory: Memory, ids: np.ndarray, dt_s: float
    ) -> None:
        for name, values in zip(self.kept, self.look(live), strict=True):
            memory[name][ids] = values[ids]

    def chosen(self, spec: mujoco.MjSpec) -> Iterator[mujoco.MjsJoint]:
        """Yield the joints of the model specification on which the effect acts."""
        for name in self.acts_on():
            yield spec.joint(name)


@dataclass(kw_only=True)
class TouchEffect(Effect):
    """Base of effects on pads or on their taxels."""

    needs: ClassVar = ("reading",)
    only: ClassVar[tuple[Kind, ...]] = ()
    """Kinds of parts on which it can act, if not on all with readings."""
    windows: ClassVar[bool] = False
    """Whether ``reading`` and ``memory`` are also correct for a rectangle of each pad's taxels, if nothing touches taxels
    outside of it."""
    pads: list[str] = field(default_factory=lambda: list(ROBOT.pads))
    """Names of pads, ``left_a`` … ``right_b``; or ``CELLS`` alone."""

    @classmethod
    def kinds(cls) -> tuple[Kind, ...]:
        """``only``; else ``pads``, and ``cells`` if the class overrides ``reading``: a sensor of cells has nothing else."""
        return cls.only or (
            ("pads", "cells") if cls.reading is not Effect.reading else ("pads",)
        )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.pads != [CELLS]:
            _check_chosen(self.name, "pad", self.pads, ROBOT.pads)

    def acts_on(self) -> list[str]:
        return list(self.pads)

    @property
    def slots(self) -> list[int]:
        """Indices of the chosen pads in the P pads of a reading; a sensor of cells is the only entry of its reading."""
        return (
            [0]
            if self.pads == [CELLS]
            else [ROBOT.pads.index(pad) for pad in self.pads]
        )

    def within(self, window: tuple[slice, slice]) -> "TouchEffect | None":
        """The effect for readings of these rows and columns only; None if it requires whole pads (``windows``)."""
        return self if self.windows else None


@dataclass(kw_only=True)
class BoardEffect(TouchEffect):
    """Base of effects whose random numbers are drawn once per board."""

    only: ClassVar = ("pads",)
    seed: int = 0
    """Seed of these boards' random numbers: of which taxels are dead, or of each taxel's gain."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if (
            isinstance(self.seed, bool)
            or not isinstance(self.seed, int)
            or self.seed < 0
        ):
            raise TaccorlError(
                f"effect {self.name}: seed is {self.seed!r}; give a whole number of 0 or more"
            )


effects: Registry[type[Effect]] = Registry("effect", "taccorl.sim.effects")


@dataclass_transform(kw_only_default=True, field_specifiers=(number, field))
def effect[E: Effect](
    name: str, slot: Slot, needs: tuple[str, ...] | str = ()
) -> Callable[[type[E]], type[E]]:
    """Class decorator of an effect: makes a keyword-only dataclass of it and registers it under ``name``. ``needs``:
    ``Effect.needs``, one word or several; those of the base class if not given."""

    def add(cls: type[E]) -> type[E]:
        cls.name, cls.slot = name, slot
        if needs:
            cls.needs = (needs,) if isinstance(needs, str) else needs
        for word, known in (
            (slot, SLOTS),
            *((word, tuple(NEEDS)) for word in getattr(cls, "needs", ())),
        ):
            if word not in known:
                raise TaccorlError(f"effect {name}: {word!r}: {nearest(word, known)}")
        return effects.register(name)(dataclass(kw_only=True)(cls))

    return add


def _check_chosen(
    effect: str, kind: str, chosen: list[str], possible: tuple[str, ...]
) -> None:
    for name in chosen:
        if name not in possible:
            raise TaccorlError(
                f"effect {effect}: {kind}s: no {kind} {name!r}; {nearest(name, possible)}"
            )
    if not chosen or len(set(chosen)) < len(chosen):
        raise TaccorlError(
            f"effect {effect}: {kind}s are {chosen}; name at least one, each once"
        )

"""Effects that can be hidden in the surrogate robot: those of the registry by name and parameters, and some outside of it.

Each kind states its range of strength (``severity``), the parameters in the registry's terms for a severity, and the
corresponding numbers of the surrogate's own plant. The registry's classes (``taccorl.sim.effects``) define the meaning of the
names; their code is not used.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from typing import Any

import numpy as np

from taccorl.errors import TaccorlError, nearest
from taccorl.robots import ROBOT
from taccorl.sim.effects import effects, make_effect
from taccorl.sim.effects.effect import Effect
from taccorl.sim.robot import RobotConfig
from taccorl.sim.twin import TwinConfig
from taccorl.surrogate.plant import Change, Values


@dataclass(frozen=True, kw_only=True)
class Scale:
    """Reference values of the joint under test (gains, inertia, torque, speed, centre), by which effects are sized."""

    kp: float  # K_p [N·m/rad]
    kd: float  # K_d [N·m·s/rad]
    inertia: float  # Inertia, rotor included [kg·m²]
    torque: (
        float  # Largest torque of the drive in the recordings, weight included [N·m]
    )
    speed: float  # Highest speed of the chirp's target [rad/s]
    centre: float  # Angle about which the joint is moved [rad]
    sweep: float = 0.35  # Amplitude of the chirp [rad]
    reach: float = 0.35  # Largest distance from that angle in the recordings [rad]


@dataclass(frozen=True, kw_only=True)
class Kind:
    """One kind of hidden effect: its range of strength, its parameters for a strength, and what it changes in the plant."""

    severity: Callable[[Scale], tuple[float, float]]
    """Function that returns the range of severities, from hardly visible to the largest realistic one; the error grows with the
    severity."""
    values: Callable[[float, Scale, Values], Values]
    """Function (severity, scale, shape) → parameters, with the registry's names if it has the effect."""
    plant: Callable[
        [Values], Change
    ]  # Function from these parameters to the change of the plant
    shape: Callable[[np.random.Generator, Scale], Values] = lambda rng, scale: {}
    """Function that draws parameters which determine the effect's form, not its strength."""
    joints: tuple[int, ...] = tuple(range(1, ROBOT.num_joints + 1))
    """Numbers of the joints, 1 to 6, on which it can be seen."""
    stiff: bool = True  # Whether it can be seen on drives that are as stiff and as damped as the paper's
    registered: bool = True  # True: the effect is in the registry
    near: tuple[str, ...] = ()
    """For kinds outside the registry: effects of the registry with nearly the same consequences, which a diagnosis may name
    instead."""
    whole_arm: bool = (
        False  # True: the effect acts on every joint of the arm under test
    )


@dataclass(frozen=True, kw_only=True)
class Hidden:
    """One hidden effect, as it is in the sealed truth."""

    name: str  # Name of the effect, a key of ``KINDS`` (on pads of ``touch_hidden.TOUCH_KINDS``)
    values: Values  # Its parameters
    severity: float  # Its strength, on the scale of ``Kind.severity``
    registered: bool
    """True: the effect is in the registry. False: a diagnosis cannot name it, and should report "something else"."""
    selectors: Mapping[str, Any] = field(default_factory=dict)
    """Arguments that select where it acts: arm, joints or pads → value; empty for an effect outside of the registry."""

    @property
    def change(self) -> Change:
        """Change of the plant by the effect."""
        return KINDS[self.name].plant(self.values)

    def effect(self) -> Effect:
        """The hidden effect as an effect of the registry. Raises TaccorlError: it lies outside the registry."""
        if not self.registered:
            raise TaccorlError(
                f"{self.name} is not in the registry of effects, so that it cannot be made"
            )
        return make_effect(self.name, **self.selectors, **self.values)


def kind(name: str) -> Kind:
    """The kind of hidden effect of that name. Raises TaccorlError: there is no hidden effect of that name."""
    if name not in KINDS:
        raise TaccorlError(f"no hidden effect {name!r}; {nearest(name, KINDS)}")
    return KINDS[name]


def selectors(name: str, signal: str) -> dict[str, Any]:
    """Arguments (``arm``, ``joints``) with which the registry's effect ``name`` acts on ``signal``; empty for effects outside
    of it."""
    if not KINDS[name].registered:
        return {}
    arm, _, joint = signal.partition("_")
    return {"arm": arm} if KINDS[name].whole_arm else {"arm": arm, "joints": [joint]}


def hidden_in(
    config: TwinConfig, places: Sequence[str], known: Sequence[str]
) -> tuple[Hidden, ...]:
    """Effects of a twin at these joints, arms or pads, to be hidden in a surrogate with their parameters. ``known``: names that
    can be. Raises TaccorlError: another effect acts there, or the arm's bodies are not the nominal ones."""
    if config.robot != RobotConfig():
        raise TaccorlError(
            "robot: a surrogate has the nominal arm; hide effects instead, such as payload or armature"
        )
    found = []
    for effect in (e for e in config.effects if {*places} & {*e.acts_on()}):
        if effect.name not in known:
            raise TaccorlError(
                f"{effect.name} of {places[0]}: no surrogate has it; {nearest(effect.name, known)}"
            )
        values = {p.name: float(getattr(effect, p.name)) for p in effect.parameters()}
        at = {
            key: getattr(effect, key)
            for key in ("arm", "joints", "pads")
            if hasattr(effect, key)
        }
        found.append(
            Hidden(
                name=effect.name,
                values=values,
                severity=0.0,
                registered=True,
                selectors=at,
            )
        )
    return tuple(found)


def within_bounds(name: str, values: Values) -> Values:
    """``values`` clipped to the bounds of the registry; those of effects outside of it are returned unchanged."""
    if name not in effects:
        return values
    known = {p.name: p for p in effects.get(name).parameters()}
    return {
        key: min(max(value, known[key].low), known[key].high)
        for key, value in values.items()
    }


def _range(low: float, high: float) -> Callable[[Scale], tuple[float, float]]:
    return lambda scale: (low, high)


def _uniform(
    **ranges: tuple[float, float],
) -> Callable[[np.random.Generator, Scale], Values]:
    return lambda rng, scale: {
        name: float(rng.uniform(*ends)) for name, ends in ranges.items()
    }


def _signed(
    **ranges: tuple[float, float],
) -> Callable[[np.random.Generator, Scale], Values]:
    return lambda rng, scale: (
        {"sign": float(rng.choice([-1.0, 1.0]))} | _uniform(**ranges)(rng, scale)
    )


_SLIP = _range(2e-4, 0.1)  # rad by which a torque turns the joint against its K_p
_PHASE = (-math.pi, math.pi)
_KP = attrgetter("kp")


def _wave(least: int, most: int) -> Callable[[np.random.Generator, Scale], Values]:
    return lambda rng, scale: (
        {"periods": float(rng.integers(least, most + 1))}
        | _uniform(phase_rad=_PHASE)(rng, scale)
    )


def _drive(**fields: float) -> Change:
    return Change(drive=fields)


def _kind(
    fields: Mapping[str, str],
    severity: Callable[[Scale], tuple[float, float]],
    size: Callable[[Scale], float] = lambda c: 1.0,
    **rest: Any,
) -> Kind:
    """The kind whose first parameter is its severity times ``size``, beside those of its shape. ``fields``: parameter → field of
    the drive."""
    first = next(iter(fields))
    return Kind(
        severity=severity,
        values=lambda s, c, shape: {first: s * size(c), **shape},
        plant=lambda v: _drive(**{field: v[name] for name, field in fields.items()}),
        **rest,
    )


def _either_way(
    parameter: str,
    field: str,
    low: float,
    high: float,
    absent: float = 0.0,
    **rest: Any,
) -> Kind:
    """The kind with one parameter, which lies above or below its absent value by its severity."""
    return Kind(
        severity=_range(low, high),
        shape=_signed(),
        values=lambda s, c, shape: {parameter: absent + shape["sign"] * s},
        plant=lambda v: _drive(**{field: v[parameter]}),
        **rest,
    )


_OUTSIDE: dict[str, Any] = {"registered": False}
_SOFT_OUTSIDE: dict[str, Any] = {"registered": False, "stiff": False}
_WAVE = {
    "amplitude_rad": "encoder_wave",
    "periods": "encoder_waves",
    "phase_rad": "encoder_phase",
}

KINDS: dict[str, Kind] = {
    # friction
    "viscous_friction": _kind(
        {"damping_nms_per_rad": "viscous"}, _range(0.02, 1.0), lambda c: c.kd
    ),
    "coulomb_friction": Kind(
        severity=_SLIP,
        values=lambda s, c, shape: {"torque_nm": s * c.kp},
        plant=lambda v: _drive(
            coulomb=v["torque_nm"],
            **({"presliding": x} if (x := v.get("presliding_rad")) else {}),
        ),
    ),
    "stribeck_friction": Kind(
        severity=_SLIP,
        shape=_uniform(
            stiction_share=(1.0, 3.0),
            stribeck_rad_per_s=(0.05, 0.25),
            presliding_rad=(2e-4, 1e-3),
        ),
        values=lambda s, c, shape: {
            "torque_nm": s * c.kp / (1.0 + shape["stiction_share"]),
            **shape,
        },
        plant=lambda v: _drive(
            coulomb=v["torque_nm"],
            stribeck=v["torque_nm"] * v["stiction_share"],
            stribeck_speed=v["stribeck_rad_per_s"],
            presliding=v["presliding_rad"],
        ),
    ),
    "asymmetric_friction": Kind(
        severity=_SLIP,
        shape=_signed(asymmetry=(0.3, 0.7)),
        values=lambda s, c, shape: {
            "torque_nm": s * c.kp,
            "asymmetry": shape["sign"] * shape["asymmetry"],
        },
        plant=lambda v: _drive(coulomb=v["torque_nm"], asymmetry=v["asymmetry"]),
    ),
    "load_friction": _kind({"share": "load_share"}, _range(0.005, 0.5)),
    "gear_friction": _kind({"share": "gear_share"}, _range(0.005, 0.5)),
    "quadratic_drag": _kind(
        {"drag_nms2_per_rad2": "quadratic"}, _range(0.01, 1.0), lambda c: c.kd / c.speed
    ),
    "position_dependent_friction": Kind(
        severity=_SLIP,
        shape=_uniform(place=(-0.6, 0.6), width_rad=(0.05, 0.3)),
        values=lambda s, c, shape: {
            "torque_nm": s * c.kp,
            "angle_rad": c.centre + shape["place"] * c.sweep,
            "width_rad": shape["width_rad"],
        },
        plant=lambda v: _drive(
            spot=v["torque_nm"], spot_angle=v["angle_rad"], spot_width=v["width_rad"]
        ),
    ),
    # bodies and torques that hang on the angle
    "end_stop": Kind(
        severity=lambda c: (
            0.02,
            1.0 - 0.5 * c.sweep / c.reach,
        ),  # test motions start 0.4 of the sweep from the middle
        shape=_signed(stiffness=(3.0, 30.0)),
        values=lambda s, c, shape: {
            "angle_rad": c.centre + shape["sign"] * (1.0 - s) * c.reach,
            "stiffness_nm_per_rad": shape["stiffness"] * c.kp,
        },
        plant=lambda v: _drive(
            stop=v["stiffness_nm_per_rad"], stop_angle=v["angle_rad"]
        ),
    ),
    "armature": _kind(
        {"added_kgm2": "motor_inertia"},
        _range(0.02, 3.0),
        lambda c: c.inertia,
        stiff=False,
    ),
    "gravity_mismatch": Kind(
        severity=_range(0.005, 1.0),
        shape=_signed(),
        values=lambda s, c, shape: {"share": 1.0 + shape["sign"] * s},
        plant=lambda v: Change(carried=v["share"]),
        whole_arm=True,
        joints=(2, 3, 5),
    ),
    "payload": Kind(
        severity=_range(0.01, 1.5),
        shape=_uniform(x_m=(-0.03, 0.03), y_m=(-0.03, 0.03), z_m=(0.05, 0.2)),
        values=lambda s, c, shape: {"mass_kg": s, **shape},
        plant=lambda v: Change(ball=(v["mass_kg"], v["x_m"], v["y_m"], v["z_m"])),
        whole_arm=True,
        joints=(2, 3, 5),
    ),
    "cable_spring": Kind(
        severity=_range(0.003, 1.0),
        shape=_signed(off=(0.3, 1.2)),
        values=lambda s, c, shape: {
            "stiffness_nm_per_rad": s * c.kp,
            "rest_rad": c.centre + shape["sign"] * shape["off"],
        },
        plant=lambda v: _drive(
            spring=v["stiffness_nm_per_rad"], spring_rest=v["rest_rad"]
        ),
    ),
    "cogging": _kind(
        {
            "torque_nm": "cogging",
            "periods": "cogging_periods",
            "phase_rad": "cogging_phase",
        },
        _SLIP,
        _KP,
        shape=_wave(8, 32),
    ),
    # the command's way
    "command_delay": _kind({"delay_s": "delay"}, _range(5e-4, 0.1)),
    "command_lag": _kind({"time_constant_s": "lag"}, _range(1e-3, 0.2)),
    "slew_limit": Kind(
        severity=_range(0.02, 0.85),
        values=lambda s, c, shape: {"speed_rad_per_s": (1.0 - s) * c.speed},
        plant=lambda v: _drive(slew=v["speed_rad_per_s"]),
    ),
    "velocity_feedforward": _kind({"share": "feedforward"}, _range(0.02, 1.0)),
    "dropped_commands": Kind(
        severity=_range(0.01, 0.1),
        values=lambda s, c, shape: {"probability": s},
        plant=lambda v: Change(dropped=v["probability"]),
    ),
    # the loop
    "error_deadband": _kind({"width_rad": "deadband"}, _range(2e-4, 0.05)),
    "integral_action": _kind({"rate_per_s": "integral"}, _range(0.02, 5.0)),
    # From K_d / K_p on it would oscillate.
    "torque_lag": _kind(
        {"time_constant_s": "torque_lag"},
        lambda c: (2e-4, 0.5 * c.kd / c.kp),
        stiff=False,
    ),
    # Without weight it is a factor of all gains.
    "torque_scale": _either_way(
        "factor", "torque_scale", 0.02, 0.5, absent=1.0, joints=(2, 3, 5)
    ),
    "torque_saturation": Kind(
        severity=_range(0.02, 0.7),
        values=lambda s, c, shape: {"torque_max_nm": (1.0 - s) * c.torque},
        plant=lambda v: _drive(torque_max=v["torque_max_nm"]),
        stiff=False,
    ),
    "torque_speed_limit": Kind(
        severity=_range(0.3, 1.6),
        shape=_uniform(stall=(1.0, 1.5)),
        values=lambda s, c, shape: {
            "stall_nm": shape["stall"] * c.torque,
            "no_load_rad_per_s": c.speed / s,
        },
        plant=lambda v: _drive(stall=v["stall_nm"], no_load=v["no_load_rad_per_s"]),
        stiff=False,
    ),
    "torque_fade": Kind(
        severity=_range(5e-4, 0.049),
        values=lambda s, c, shape: {"rate_per_min": 60.0 * s},
        plant=lambda v: _drive(fade=v["rate_per_min"] / 60.0),
    ),
    # the gear
    # Behind it there must be more than the rotor.
    "backlash": _kind(
        {"play_rad": "play"}, _range(3e-4, 0.03), joints=(1, 2, 3), stiff=False
    ),
    "joint_compliance": Kind(
        severity=_range(0.005, 2.0),
        shape=_uniform(damping_s=(0.001, 0.004)),
        values=lambda s, c, shape: {"compliance_rad_per_nm": s / c.kp, **shape},
        plant=lambda v: _drive(
            compliance=v["compliance_rad_per_nm"], compliance_damping=v["damping_s"]
        ),
        joints=(1, 2, 3),
        stiff=False,
    ),
    # the encoder
    "encoder_scale": _either_way("factor", "encoder_scale", 5e-4, 0.1, absent=1.0),
    "encoder_bias": _either_way("bias_rad", "encoder_bias", 1e-3, 0.2),
    "encoder_eccentricity": Kind(
        severity=_range(5e-4, 0.05),
        shape=_uniform(phase_rad=_PHASE),
        values=lambda s, c, shape: {"amplitude_rad": s, **shape},
        plant=lambda v: _drive(
            encoder_wave=v["amplitude_rad"],
            encoder_waves=1.0,
            encoder_phase=v["phase_rad"],
        ),
    ),
    "sensor_delay": Kind(
        severity=_range(5e-4, 0.1),
        values=lambda s, c, shape: {"delay_s": s},
        plant=lambda v: Change(report_delay_s=v["delay_s"]),
    ),
    # outside the registry
    "loop_delay": _kind(  # from about J / K_d on it would oscillate
        {"delay_s": "loop_delay"},
        lambda c: (1e-4, 0.5 * c.inertia / c.kd),
        near=("torque_lag",),
        **_SOFT_OUTSIDE,
    ),
    "angle_friction": _kind(
        {"torque_nm": "coulomb", "share": "angle_share", "phase_rad": "angle_phase"},
        _SLIP,
        _KP,
        shape=_uniform(share=(0.6, 0.95), phase_rad=_PHASE),
        near=("position_dependent_friction", "coulomb_friction"),
        **_OUTSIDE,
    ),
    "gear_error": _kind(
        _WAVE,
        _range(5e-4, 0.05),
        shape=_wave(5, 11),
        near=("encoder_eccentricity", "cogging"),
        **_OUTSIDE,
    ),
    "magnetic_hysteresis": _kind(
        {"torque_nm": "hysteresis", "width_rad": "hysteresis_width"},
        _SLIP,
        _KP,
        shape=_uniform(width_rad=(0.04, 0.2)),
        near=(
            "coulomb_friction",
            "stribeck_friction",
        ),  # which slide only after some travel, too
        **_OUTSIDE,
    ),
    "warming_friction": _kind(
        {"torque_nm": "coulomb", "rate_per_s": "warm_up"},
        _SLIP,
        _KP,
        shape=_uniform(rate_per_s=(0.04, 0.065)),
        near=("coulomb_friction", "torque_fade"),
        **_OUTSIDE,
    ),
    "slow_velocity_filter": Kind(
        severity=lambda c: (1e-3, 2.0 * c.inertia / c.kd),
        values=lambda s, c, shape: {"time_constant_s": s},
        plant=lambda v: _drive(loop_steps=8, velocity_filter=v["time_constant_s"]),
        near=(
            "torque_lag",
            "armature",
        ),  # at low frequencies it is an inertia of −K_d τ
        **_SOFT_OUTSIDE,
    ),
    "hung_mass": Kind(  # a tool or cable that swings on the link
        severity=_range(0.02, 1.0),
        shape=_uniform(hz=(3.0, 9.0), damping=(0.02, 0.1)),
        values=lambda s, c, shape: {"inertia_kgm2": s * c.inertia, **shape},
        plant=lambda v: _drive(
            hung_inertia=v["inertia_kgm2"],
            hung_rad_per_s=2 * math.pi * v["hz"],
            hung_damping=v["damping"],
        ),
        near=("armature", "payload", "joint_compliance"),
        **_SOFT_OUTSIDE,
    ),
    "voltage_sag": Kind(
        severity=_range(0.05, 5.0),
        shape=_uniform(time_s=(0.02, 0.1)),
        values=lambda s, c, shape: {"per_w": s / (c.torque * c.speed), **shape},
        plant=lambda v: _drive(sag=v["per_w"], sag_time=v["time_s"]),
        near=("torque_speed_limit", "torque_saturation"),
        **_SOFT_OUTSIDE,
    ),
    "encoder_interpolation": _kind(  # between the lines of its disc
        _WAVE,
        _range(1e-4, 5e-3),
        shape=_wave(40, 120),
        near=("encoder_eccentricity", "cogging"),
        **_OUTSIDE,
    ),
    "one_way_gains": _either_way(
        "share", "one_way", 0.01, 0.5, near=("asymmetric_friction",), **_SOFT_OUTSIDE
    ),
}
"""Name → kind of hidden effect."""
NOT_FITTED = ("dropped_commands",)
"""Effects that differ between recordings of one motion: no fit can find them, but the checks of recordings can."""
REGISTERED = tuple(
    name for name, k in KINDS.items() if k.registered and name not in NOT_FITTED
)
"""Names of the kinds that a search can find."""
OUTSIDE = tuple(
    name for name, k in KINDS.items() if not k.registered and name not in NOT_FITTED
)
"""Names of the kinds outside the registry."""

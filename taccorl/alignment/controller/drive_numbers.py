"""Numbers of one joint with its drive, for the compiled one-joint model (``joint_kernel``)."""

import math
from collections import namedtuple
from typing import NamedTuple

from taccorl.alignment.controller.rigid_joint import Gains, Rigid
from taccorl.sim.effects import command, drive, encoder, friction, gear, load
from taccorl.sim.effects.effect import JOINT_SLOTS, ArmEffect

FAMILIES = (
    command,
    drive,
    encoder,
    friction,
    gear,
    load,
)  # Modules of the effects that the model has
POSITION, VELOCITY, TORQUE = 0.0, 1.0, 2.0
"""Values of ``Drive.command``: which quantity of the joint commands set, its position, velocity or torque."""


class _Own(NamedTuple):
    """Fields of ``Drive`` besides those of ``Gains`` and ``Rigid`` that no effect sets, in SI units, N·m and rad (for a sliding
    axis N and m)."""

    command: float = POSITION
    """Quantity that a command states: ``POSITION``, ``VELOCITY`` (τ = K_d (q̇* − q̇) + T_ref) or ``TORQUE`` (τ = τ* + T_ref)."""
    commands_speed: float = 0.0
    """1: the command is a speed, q̇* or K_p (q* − y) / K_d, as of a velocity loop or a cascade; 0: it is a torque."""
    duty_torque: float = math.inf
    """Torque of the whole supply voltage at rest [N·m], V k_t / R, to which the controller's torque is clipped
    before the back-EMF is subtracted."""
    back_emf: float = (
        0.0  # Torque per speed that the back-EMF takes, k_t k_e / R [N·m·s/rad]
    )
    effort_after: float = 0.0
    """1: the reported effort of a row was measured after the row's command acted; 1 + n: after a command that acts n parts of the
    row late; 0: before."""
    effort_holds_weight: float = 0.0
    """1: the reported effort includes the torque of the gravity compensation; 0: it does not."""
    effort_age: float = 0.0
    """Mean age of the reported effort relative to the acting one [s]: a sampled loop holds its output."""
    speed_age: float = 0.0
    """Mean age of the speed that K_d multiplies in a sampled loop [s], its period: to the first order an inertia smaller by K_d ·
    age, except while the motor's torque is at its limit. The motor supplies this torque, so that the effort contains it."""
    start_nm: float = math.inf
    """Effort at rest at the start [N·m]: an integral may give any within the dry friction. inf: as if there were no friction."""
    midpoint: float = 0.0
    """1: midpoint steps, weight compensated at the encoder's angle; 0: as MuJoCo: semi-implicit Euler, at the true angle."""
    dropped_commands__seed: float = 0.0  # Seed of the commands that are lost


def _numbers() -> dict[str, float]:
    """``EFFECT__PARAMETER`` → value that does nothing, of all effects that this model has: what ``Effect.drive`` gives."""
    families = [vars(family).values() for family in FAMILIES]
    own = {
        cls
        for members in families
        for cls in members
        if isinstance(cls, type) and issubclass(cls, ArmEffect)
    }
    absent = [cls() for cls in own if cls.slot in JOINT_SLOTS]
    return dict(
        sorted(pair for effect in absent for pair in (effect.drive() or {}).items())
    )


_BODY = [name for name in Rigid._fields if name != "weight_n"]
_DEFAULTS = {
    name: Rigid._field_defaults[name] for name in _BODY[1:]
} | _Own._field_defaults
_DEFAULTS |= {
    name: value for name, value in _numbers().items() if name not in _DEFAULTS
}
Drive = namedtuple(
    "Drive", (*Gains._fields, _BODY[0], *_DEFAULTS), defaults=_DEFAULTS.values()
)
"""One joint with its drive: the fields of ``Gains``, ``Rigid`` and ``_Own``, and ``EFFECT__PARAMETER`` of the effects, which do
nothing by default.

``speed_delay__delay_s`` is the time constant of a low-pass on the speed that K_d multiplies; below 0 it adds to ``speed_age``."""

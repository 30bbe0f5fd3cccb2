"""Control law of the drive of a joint of a robot file.

A controller that computes its torque elsewhere (a PD on a torque interface) is law ``impedance`` where its position target was
logged, and law ``torque`` where the torque was. Targets stand in the column ``q_target``; of law velocity in ``qd_target``, of
law torque in ``tau_target``. Law ``effort`` is for logs without a command: the recorded effort drives the model, a spring and
damper hold it at the measured position, and what they must give is the error of the effort, up to about ``FOLLOW_HZ``. Their
stiffness follows from the recording alone (``joint_recording.holding_stiffness``), so that no number of the model changes it. V
is ``supply_v`` of the file, or of a recording (``NAME.supply``, or measurements.yaml). While ``NAME.enabled`` is 0 the motor
neither drives nor brakes. The equations are in the table of ``docs/your_robot.md``, An axis.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from taccorl.alignment.controller.drive_numbers import POSITION, TORQUE, VELOCITY
from taccorl.alignment.controller.rigid_joint import Gains
from taccorl.alignment.measurements.measurement import Measurement, TargetKind
from taccorl.errors import TaccorlError, nearest
from taccorl.sim.effects import effects as registry
from taccorl.sim.settings import check_numbers

Law = Literal["impedance", "cascade", "velocity", "torque", "effort", "pwm"]
WINDING = ("supply_v", "resistance_ohm", "torque_nm_per_a", "emf_v_s_per_rad")
"""Fields of ``DriveLaw`` that describe the motor of law pwm."""
NEEDED: Mapping[Law, tuple[str, ...]] = {
    "impedance": ("kp", "kd"),
    "cascade": ("kp", "kd"),
    "velocity": ("kd",),
    "torque": (),
    "effort": (),
    "pwm": ("kp", *WINDING[:3]),
}
"""Law → fields of ``DriveLaw`` that it requires."""
LONGEST_STEP_S, SHORTEST_STEP_S = 1e-3, 1e-4  # Range of the physics step [s]
WINDING_WITHIN = 3.0
"""Factor within which stall torque and back-EMF of law pwm are fitted, relative to the file's; data sheets are no better."""
GAIN_UNITS: Mapping[Law, tuple[str, str]] = {
    "cascade": ("1/s", "N·m·s/rad"),
    "pwm": ("1/rad", "s/rad"),
}
"""Law → units of ``kp`` and ``kd``; of other laws N·m/rad and N·m·s/rad."""
_COMMANDS: Mapping[Law, float] = {"velocity": VELOCITY, "torque": TORQUE}
_KINDS: Mapping[Law, TargetKind] = {
    "velocity": "velocity",
    "torque": "torque",
    "effort": "effort",
}
FOLLOW_HZ = 10.0
"""Rate of the spring and damper that hold a model of law effort at the measured position [Hz]: K and 2 K / ω. A choice: with
K = ω² J, noise of 0.1 mrad is an effort of 0.4 N·m for each kg·m²."""
FOLLOWED = 0.5
"""Share of the twin's effort that is subtracted from recorded efforts before repeats of unlike motions are compared, under law
effort. A choice, tried on one simulated arm: at a frequency f the model misses (f / FOLLOW_HZ)² of the effort, half at 7 Hz."""
MECHANICAL = ("velocity", "acceleration", "load", "position")
"""Needs of effects that a model of law effort can have: it has no controller."""
OF_READINGS = ("encoder_bias", "encoder_eccentricity", "encoder_scale", "sensor_delay")
"""Effects on the reported position, which is the input of law effort."""
_OF_LOOPS: Mapping[str, tuple[TargetKind, ...]] = {
    "integral_action": ("position", "velocity"),
    "error_deadband": ("position",),
    "velocity_feedforward": ("position",),
}
"""Effects in a controller → kinds of targets whose controllers can have them."""
_OF_LAWS: Mapping[str, tuple[Law, ...]] = {"position_integral": ("cascade",)}
"""Effects in a controller → laws that can have them; under law impedance it is ``integral_action``."""


@dataclass(kw_only=True)
class DriveLaw:
    """Control law and numbers of one drive. Units are for a hinge; for a sliding joint read N for N·m and m for rad."""

    law: Law = "impedance"  # Control law, a row of the table in ``docs/your_robot.md``
    kp: float | None = (
        None  # Gain in the law's unit divided by ``kp_factor``; None for laws without it
    )
    kd: float | None = (
        None  # Gain in the law's unit divided by ``kd_factor``; None for laws without it
    )
    kp_factor: float = 1.0
    """Factor from ``kp``, here and in measurements.yaml, to the law's unit: the value of one step of a gain's register."""
    kd_factor: float = 1.0  # The same for ``kd``
    torque_ff: float = 0.0  # Constant torque of the controller [N·m]
    supply_v: float | None = None  # Voltage of the motor's supply [V]; law pwm
    resistance_ohm: float | None = None  # Resistance of the winding [Ω]; law pwm
    torque_nm_per_a: float | None = (
        None  # k_t at the axis or joint, gear included [N·m/A], law pwm
    )
    emf_v_s_per_rad: float | None = None
    """k_e at the axis or joint [V·s/rad], law pwm; k_t if not given (both are equal in SI units)."""
    effort_limit: float | None = (
        None  # Torque at which the drive's output is clipped [N·m]; None: not clipped
    )
    effort_after_target: bool = False
    """True: the logged effort of a row already responds to the row's target. False: it was measured before that target acts."""
    known: tuple[str, ...] = ()
    """What ``diagnose`` leaves as the file has it: names of numbers that it fits otherwise (``FITTED``), ``EFFECT.PARAMETER`` of
    an effect of the file, or an effect: all of its parameters, or that it is absent where the file does not have it."""
    FITTED: ClassVar[tuple[str, ...]] = (
        "kp",
        "kd",
        "torque_ff",
        "stall_nm",
        "back_emf",
    )
    """Numbers of the drive that ``diagnose`` fits for some law or recordings; subclasses add theirs."""

    def check_law(self, owner: str) -> None:
        """Check that the numbers fit the law. Raises TaccorlError, which begins with ``OWNER.KEY``: a number is wrong, is missing
        for the law, or is not used by it."""
        stated = [
            name
            for name in ("kp", "kd", *WINDING, "effort_limit")
            if getattr(self, name) is not None
        ]
        unused = {
            "velocity": ("kp",),
            "torque": ("kp", "kd"),
            "effort": ("kp", "kd", "effort_limit"),
        }
        foreign = (() if self.law == "pwm" else WINDING) + unused.get(self.law, ())
        for name in (name for name in foreign if name in stated):
            raise TaccorlError(
                f"{owner}.{name}: law {self.law} does not use this number; remove it, or correct the law"
            )
        positive = [
            "kp_factor",
            "kd_factor",
            *(name for name in stated if name != "kd"),
        ]
        check_numbers(
            owner,
            self,
            finite=("torque_ff",),
            not_negative=["kd"] * ("kd" in stated),
            positive=positive,
        )
        for name in NEEDED[self.law]:
            if getattr(self, name) is None or (
                self.law != "impedance" and not getattr(self, name)
            ):
                raise TaccorlError(
                    f"{owner}.{name}: law {self.law} requires this number; write `{name}: …`"
                )
        if self.law == "effort":
            for name in (
                "loop_hz",
                "command_hz",
                "target_late_s",
                "effort_after_target",
            ):
                if getattr(self, name, None):
                    raise TaccorlError(
                        f"{owner}.{name}: law effort has no drive; remove it"
                    )

    def check_known(self, owner: str, effects: Mapping[str, Sequence[str]]) -> None:
        """Check the names in ``known``; ``effects``: effect of the file → its parameters. Raises TaccorlError, which begins with
        ``OWNER.known``: a name is none of a number that ``diagnose`` moves."""
        numbers = [
            *self.FITTED,
            *(f"{name}.{p}" for name, own in effects.items() for p in own),
        ]
        for name in self.known:
            if name in numbers or name in registry:
                continue
            effect = name.split(".")[0]
            why = (
                f"the file has no effect {effect}; add it with its numbers"
                if effect in registry and effect not in effects
                else f"no diagnosis moves a number of this name; remove it. {nearest(name, numbers)}"
            )
            raise TaccorlError(f"{owner}.known: {name}: {why}")

    @property
    def gain_names(self) -> tuple[str, ...]:
        """Those of "kp" and "kd" that the law has."""
        return tuple(name for name in ("kp", "kd") if getattr(self, name))

    @property
    def target_kind(self) -> TargetKind:
        """Quantity that a target of this law commands: position, velocity, torque, or effort (no target)."""
        return _KINDS.get(self.law, "position")

    @property
    def stall_nm(self) -> float:
        """Torque at rest and full duty, V k_t / R, of law pwm [N·m]."""
        return (
            (self.supply_v or 0.0)
            * (self.torque_nm_per_a or 0.0)
            / (self.resistance_ohm or 1.0)
        )

    @property
    def back_emf(self) -> float:
        """Torque per speed that the back-EMF takes, k_t k_e / R, of law pwm [N·m·s/rad]; 0 for other laws."""
        emf = (
            self.torque_nm_per_a
            if self.emf_v_s_per_rad is None
            else self.emf_v_s_per_rad
        )
        return (
            (self.torque_nm_per_a or 0.0) * (emf or 0.0) / (self.resistance_ohm or 1.0)
        )

    @property
    def following(self) -> Gains:
        """``loop_gains``; with law effort those that hold a model at the measured position, for a stiffness of 1 N·m/rad: a
        recording's own is its ``kp_scale``."""
        if self.law != "effort":
            return self.loop_gains
        return Gains(1.0, 1.0 / (math.pi * FOLLOW_HZ), self.torque_ff)

    @property
    def loop_gains(self) -> Gains:
        """Gains of position error and velocity, and the constant torque [N·m/rad, N·m·s/rad, N·m], alike for every law."""
        kp, kd = (self.kp or 0.0) * self.kp_factor, (self.kd or 0.0) * self.kd_factor
        if self.law == "cascade":
            return Gains(kp * kd, kd, self.torque_ff)
        if self.law == "pwm":
            return Gains(kp * self.stall_nm, kd * self.stall_nm, self.torque_ff)
        return Gains(kp, kd, self.torque_ff)

    @property
    def facts(self) -> dict[str, float]:
        """Fields of ``drive_numbers.Drive`` that follow from the law and its numbers: field → value."""
        found: dict[str, float] = {
            "command": _COMMANDS.get(self.law, POSITION),
            "midpoint": 1.0,
        }
        found["effort_after"] = float(self.effort_after_target)
        found["commands_speed"] = float(self.law in ("cascade", "velocity"))
        if self.law == "pwm":
            found |= {"duty_torque": self.stall_nm, "back_emf": self.back_emf}
        if self.effort_limit is not None:
            found["torque_saturation__torque_max_nm"] = self.effort_limit
        return found

    def timestep_s(
        self, rate_hz: float, inertia: float, held: float, loop_hz: float | None
    ) -> float:
        """Physics step of the one-joint model [s], of which a whole number fits between two rows of a recording.

        Args:
            rate_hz: rows of the recording in a second.
            inertia: of the joint [kg·m²].
            held: stiffness that holds the joint at its measured position, for law ``effort`` [N·m/rad].
            loop_hz: rate of the drive's loop that the file states; None if it states none. A step is at most one period long,
                so that a target that arrives between two rows acts in the right period.
        """
        damping = (
            self.following.kd * (held if self.law == "effort" else 1.0) + self.back_emf
        )
        # Steps are of second order: with 5 % of inertia / K_d a PWM servo's step of 0.8 rad
        # is off by 0.1 mrad.
        wanted = min(
            LONGEST_STEP_S, max(SHORTEST_STEP_S, 0.05 * inertia / max(damping, 1e-9))
        )
        # Loops of a shorter period get a step of 0.25 ms, which limits the time of a
        # simulation. A choice.
        wanted = min(wanted, max(1.0 / loop_hz, 2.5e-4)) if loop_hz else wanted
        return 1.0 / (rate_hz * math.ceil(1.0 / (wanted * rate_hz) - 1e-6))

    def allows_effect(self, effect: str) -> bool:
        """Whether an effect of this name is possible under this control law: ``integral_action`` is not under law torque."""
        if self.law == "effort":
            needs = {*registry.get(effect).needs}
            return effect == "payload" or (
                bool(needs) and needs <= {*MECHANICAL} and effect not in OF_READINGS
            )
        return self.law in _OF_LAWS.get(effect, (self.law,)) and (
            self.target_kind in _OF_LOOPS.get(effect, (self.target_kind,))
        )

    @property
    def numbers(self) -> dict[str, tuple[float, str]]:
        """Field → (value, unit) of the numbers that a fit can change (``law_numbers``). The unit of a gain for which the file
        states a factor (``kp_factor``, ``kd_factor``) is that of the drive's own setting."""
        units = dict(
            zip(
                ("kp", "kd"),
                GAIN_UNITS.get(self.law, ("N·m/rad", "N·m·s/rad")),
                strict=True,
            )
        )
        units |= {
            name: "steps" for name in units if getattr(self, f"{name}_factor") != 1.0
        }
        units |= {
            "supply_v": "V",
            "resistance_ohm": "Ω",
            "torque_ff": "N·m",
            "torque_nm_per_a": "N·m/A",
            "emf_v_s_per_rad": "V·s/rad",
        }
        return {
            name: (getattr(self, name), unit)
            for name, unit in units.items()
            if getattr(self, name) is not None
        }

    def law_numbers(self, base: Mapping[str, float]) -> dict[str, float]:
        """Convert fitted values, by parameter name, into values of this class's fields. ``base``: those of ``torque_ff`` [N·m],
        ``kp`` and ``kd`` (as in ``loop_gains``), ``stall_nm`` and ``back_emf``, or of fields of the motor in place of these two.
        Returns field → value in the unit of the file; only fields that follow from ``base``."""
        new = {"torque_ff": base["torque_ff"]} if "torque_ff" in base else {}
        if self.law == "pwm" and (
            of_motor := {name: base[name] for name in WINDING if name in base}
        ):
            return new | of_motor
        if self.law == "pwm" and {"stall_nm", "back_emf"} & {*base}:
            volts, ohms = self.supply_v or 1.0, self.resistance_ohm or 1.0
            new["torque_nm_per_a"] = base.get("stall_nm", self.stall_nm) * ohms / volts
            new["emf_v_s_per_rad"] = (
                base.get("back_emf", self.back_emf) * ohms / new["torque_nm_per_a"]
            )
            return new
        if "kd" in base:
            new["kd"] = base["kd"] / self.kd_factor
        if "kp" in base:
            over = base.get("kd", self.loop_gains.kd) if self.law == "cascade" else 1.0
            new["kp"] = base["kp"] / over / self.kp_factor
        return new

    def gain_scales(self, signal: str, m: Measurement) -> tuple[float, float]:
        """Ratios of a recording's loop gains to those of the file: (for the position error, for the velocity); 1 if none is
        stated. Raises TaccorlError: the recording states a gain that the file does not have."""
        scales = {}
        for name in ("kp", "kd"):
            stated, own = getattr(m, name).get(signal), getattr(self, name)
            if stated is not None and not own:
                raise TaccorlError(
                    f"{m.name}: {name} of {signal} is stated, but the file of the joint, with law {self.law}, has no {name}; "
                    "remove it from measurements.yaml, or add it to the file"
                )
            scales[name] = (
                m.gain_scale.get(signal, 1.0) if stated is None else stated / own
            )
        # Of a cascade K_p is the product of both gains.
        product = scales["kd"] if self.law == "cascade" and signal in m.kd else 1.0
        return scales["kp"] * product, scales["kd"]

    def supply(self, signal: str, m: Measurement) -> np.ndarray | None:
        """(T,) supply voltage divided by that of the file; None if the recording has none. The voltage from a row on is the one
        measured at the next row, because the current that its target causes makes the supply sag. Raises TaccorlError: the
        recording has a voltage, which the law does not use."""
        volts = (
            m.supply_v[:, m.column(signal)]
            if m.supply_v.size
            else np.full(m.num_rows, np.nan)
        )
        if not np.isfinite(volts).any():
            return None
        if self.supply_v is None:
            raise TaccorlError(
                f"{m.name}: a supply voltage of {signal} is stated, but law {self.law} does not use it; remove it"
            )
        return np.nan_to_num(np.append(volts[1:], volts[-1]) / self.supply_v, nan=1.0)


def with_gains(m: Measurement, laws: Mapping[str, DriveLaw]) -> Measurement:
    """``m`` with the gains that the ``laws`` of its signals state, where its own statement has none."""
    stated: dict[str, dict[str, float]] = {"kp": dict(m.kp), "kd": dict(m.kd)}
    for name, law in laws.items():
        for key in law.gain_names:
            stated[key].setdefault(
                name, m.gain_scale.get(name, 1.0) * getattr(law, key)
            )
    return dataclasses.replace(m, kp=stated["kp"], kd=stated["kd"])

"""Drive and passive forces of one joint of an MJCF model, in the terms of a robot file:
a control law with numbers, and effects.

An actuator of gear g on a hinge or slide has the length g q. With a gain G on its control
u, gains k_p and k_d, and a constant c, it gives the joint

    τ = g (G u − k_p g q − k_d g q̇ + c)
      = g² k_p (q* − q) − g² k_d q̇ + g c,    q* = G u / (k_p g)

so that a target, as a robot file has it, is the control times G / (k_p g). Actuators are
read from the compiled model, where defaults, ``dampratio`` and the shortcuts are resolved.
Each function takes from the ``StatedFields`` what it expresses; the rest gives a remark.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import mujoco

from taccorl.alignment.controller.drive_law import Law
from taccorl.alignment.machines.stated_fields import StatedFields
from taccorl.errors import TaccorlError
from taccorl.sim.effects import make_effect
from taccorl.sim.effects.effect import Effect
from taccorl.sim.effects.friction import BRISTLE_DAMPING_S, DRY_TIME_S

_GAIN, _BIAS, _DYN = mujoco.mjtGain, mujoco.mjtBias, mujoco.mjtDyn
_POS, _VEL, _FF, _VOLTAGE, _NO_INPUT = 1, 2, 4, 8, 16
"""Inputs of an actuator, mjtCtrlInput of mjtype.h, for which Python has no name."""
_FILTERS = (_DYN.mjDYN_FILTER, _DYN.mjDYN_FILTEREXACT)
_ALIKE = 1e-6  # Relative difference of two numbers that is rounding

Kind = Literal["position", "velocity", "voltage", "torque", "passive", "other"]
"""What an actuator does with its control. ``passive``: it has none. ``other``: it has no
control law that a robot file states."""
_MAIN: tuple[Kind, ...] = ("position", "velocity", "voltage", "torque")
"""Kinds in the order in which one of several actuators of a joint counts as its drive."""
_LAWS: dict[Kind, Law] = {"velocity": "velocity", "voltage": "pwm"}
_COLUMNS: dict[Kind, str] = {"velocity": "qd_target", "torque": "tau_target"}
"""Kind → column of a recording that holds its target; q_target for all others."""


@dataclass
class Actuator:
    """One actuator of a joint, with its gains at the joint."""

    name: str
    kind: Kind
    fields: StatedFields
    gear: float = 1.0
    kp: float = 0.0  # Position gain [N·m/rad or N/m]
    kd: float = 0.0  # Velocity gain [N·m·s/rad or N·s/m]
    torque_ff: float = 0.0  # Constant torque or force [N·m or N]
    per_control: float = 1.0
    """Target of the joint per control [rad, rad/s, N·m …], gear included."""
    integral: float = 0.0  # Gain of the integrated position error over ``kp`` [1/s]
    slew: float = 0.0  # Largest speed of the target at the joint; 0: unlimited
    supply_v: float = 0.0
    """Largest voltage of a controller in the motor [V]; then ``kp`` and ``kd`` are those of
    law pwm. 0: unlimited."""

    @property
    def has_target(self) -> bool:
        """Whether its control is a position or a speed."""
        return self.kind in ("position", "velocity") or self.supply_v > 0.0


Share = tuple[StatedFields, tuple[str, ...], float]
"""Who states a share of a coefficient of a joint, in which of its fields, and its value at
the joint [N·m·s/rad or N·m·s²/rad²; of a slide N and m]."""


@dataclass(frozen=True, kw_only=True)
class DriveFacts:
    """Control law and numbers of a joint as its model has them."""

    law: Law = "impedance"
    numbers: dict[str, float] = field(default_factory=dict)
    """Key of ``JointConfig`` → number; the model does not state those that the law needs
    and that are not here."""
    actuators: tuple[str, ...] = ()  # Names of the actuators that give the numbers


class JointDraft:
    """Collects what a robot file says of one joint. ``joint``: its fields."""

    def __init__(self, joint: StatedFields) -> None:
        self.joint, self.effects = joint, dict[str, Effect]()
        self.remarks: list[str] = []
        self._limits: list[float] = []

    def add(
        self, source: StatedFields, taken: Sequence[str], name: str, **values: float
    ) -> None:
        """Add an effect that stands for the fields ``taken`` of ``source``. These stay, with
        an explanation, if there is one of this name, or if a value is out of bounds."""
        try:
            if name in self.effects:
                raise TaccorlError(f"effect {name}: a joint has one of each effect")
            self.effects[name] = make_effect(name, **values)
        except TaccorlError as error:
            source.explain(str(error))
        else:
            source.take(*taken)

    def add_sum(self, shares: Sequence[Share], name: str, parameter: str) -> None:
        """Add one effect whose parameter is what ``shares`` add up to."""
        total = sum(value for _, _, value in shares)
        for source, taken, value in shares:
            if value and name in self.effects:
                source.take(*taken)
            elif value:
                self.add(source, taken, name, **{parameter: total})

    def limit(
        self, source: StatedFields, switch: str, range_: str, scale: float
    ) -> None:
        """Take a range of forces, times ``scale`` at the joint, as a limit of the effort,
        if it is the same to both sides."""
        low, high = source.pair(range_)
        if not source.get(switch) or scale == 0.0:
            return
        if not (high > 0.0 and math.isclose(-low, high, rel_tol=_ALIKE)):
            source.explain("effort_limit clips both directions alike")
            return
        source.take(switch, range_)
        self._limits.append(abs(scale) * high)

    @property
    def limits(self) -> dict[str, float]:
        """``effort_limit``, the least of the limits [N·m or N]; empty without any."""
        return {"effort_limit": min(self._limits)} if self._limits else {}


def actuator_of(
    model: mujoco.MjModel, a: int, place: str, limits: tuple[float, float] | None
) -> Actuator:
    """Actuator ``a`` of a compiled model, with its name and line ``place``, on a joint with
    these ``limits``. What its kind and gains express is taken from its fields."""
    fields = StatedFields(model, "actuator", a, place)
    gear = fields.get("actuator_gear")
    one = Actuator(model.actuator(a).name or str(a), "other", fields, gear)
    gain, bias, dyn = (
        int(fields.get(f"actuator_{kind}type")) for kind in ("gain", "bias", "dyn")
    )
    linear = bias in (_BIAS.mjBIAS_NONE, _BIAS.mjBIAS_AFFINE)
    if gear == 0.0:
        fields.explain("a gear of 0 moves nothing")
    elif model.opt.disableactuator >> int(model.actuator_group[a]) & 1:
        fields.explain("actuatorgroupdisable switches it off")
    elif (
        gain == _GAIN.mjGAIN_FIXED
        and linear
        and dyn in (_DYN.mjDYN_NONE, _DYN.mjDYN_INTEGRATOR, *_FILTERS)
    ):
        _of_fixed_gain(one)
    elif gain == _GAIN.mjGAIN_PID and linear:
        _of_pid(one)
    elif gain == _GAIN.mjGAIN_DCMOTOR:
        _of_motor(one)
    if dyn == _DYN.mjDYN_NONE and fields.get("actuator_dynprm[0]") == 1.0:
        fields.take("actuator_dynprm[0]")
    if gain == _GAIN.mjGAIN_MUSCLE:
        fields.take("actuator_gainprm", "actuator_biasprm", "actuator_dynprm")
    if one.kind == "other":
        fields.explain("no law of a robot file is that of this actuator")
        return one
    fields.take("actuator_gear", "actuator_gaintype", "actuator_dyntype")
    fields.take("actuator_ctrlspec", "actuator_biastype")
    if one.has_target:
        _take_unclipped(one, limits)
    return one


def _of_fixed_gain(one: Actuator) -> None:
    """MuJoCo's general actuator and its shortcuts ``motor`` to ``cylinder``."""
    fields, g = one.fields, one.gear
    affine = int(fields.get("actuator_biastype")) == _BIAS.mjBIAS_AFFINE
    dyn = int(fields.get("actuator_dyntype"))
    gain = fields.get("actuator_gainprm[0]")
    constant, kp, kd = (
        sign * fields.get(f"actuator_biasprm[{i}]") if affine else 0.0
        for i, sign in enumerate((1.0, -1.0, -1.0))
    )
    if kp < 0.0 or kd < 0.0:
        fields.explain("a gain that drives away from the target")
        return
    if kp > 0.0 and gain != 0.0:
        one.kind, one.per_control = "position", gain / kp / g
    elif kp == 0.0 and kd > 0.0 and gain != 0.0 and dyn != _DYN.mjDYN_INTEGRATOR:
        one.kind, one.per_control = "velocity", gain / kd / g
    elif kp == 0.0 and kd == 0.0 and dyn != _DYN.mjDYN_INTEGRATOR:
        one.kind, one.per_control = "torque", gain * g
    else:
        return
    one.kp, one.kd, one.torque_ff = g**2 * kp + 0.0, g**2 * kd + 0.0, g * constant
    fields.take("actuator_gainprm[0]")
    if affine:
        fields.take(*(f"actuator_biasprm[{i}]" for i in range(3)))
    if dyn not in _FILTERS:
        fields.take("actuator_dynprm[0]")


def _of_pid(one: Actuator) -> None:
    """MuJoCo's ``pid``: gainprm k_i; dynprm imax and slewmax; biasprm c, −k_p and −k_d."""
    fields, g = one.fields, one.gear
    constant, kp, kd = (
        sign * fields.get(f"actuator_biasprm[{i}]")
        for i, sign in enumerate((1.0, -1.0, -1.0))
    )
    spec = int(fields.get("actuator_ctrlspec"))
    if kp < 0.0 or kd < 0.0 or (kp > 0.0 and not spec & _POS):
        fields.explain("a gain that drives away from the target, or to 0")
        return
    if kp == 0.0 and kd == 0.0:
        return
    one.kind = "position" if kp > 0.0 else "velocity"
    one.kp, one.kd, one.torque_ff = g**2 * kp, g**2 * kd + 0.0, g * constant
    one.per_control = 1.0 / g
    one.integral = fields.get("actuator_gainprm[0]") / kp if kp else 0.0
    one.slew = fields.get("actuator_dynprm[1]") / abs(g)
    if fields.get("actuator_dynprm[0]"):
        fields.explain("imax, a limit of the integral")
    fields.take(*(f"actuator_biasprm[{i}]" for i in range(3)))


def _of_motor(one: Actuator) -> None:
    """MuJoCo's ``dcmotor`` (places of the numbers found by compiling each attribute):

    gainprm: R, K, temperature coefficient, its reference, k_p, k_i, k_d, V_max
    dynprm: L / R, greatest current rate, thermal resistance, capacitance and ambient,
        σ₀, σ₁, slew_max, I_max
    biasprm: amplitude, poles and phase of the cogging; sliding and static friction, and
        speed, of the LuGre model
    """
    fields, g = one.fields, one.gear
    spec = int(fields.get("actuator_ctrlspec"))
    resistance, constant = _winding_of(fields)
    kp, kd = (fields.get(f"actuator_gainprm[{i}]") for i in (4, 6))
    if resistance <= 0.0:
        return
    if spec == _NO_INPUT:
        one.kind = "passive"
    elif spec == _VOLTAGE and constant > 0.0:
        one.kind = "voltage"
    elif spec & _POS and not spec & _VOLTAGE and min(kp, constant) > 0.0 <= kd:
        one.kind, one.per_control = "position", 1.0 / g
        one.kp, one.kd = g**2 * kp, g**2 * kd
        one.integral = fields.get("actuator_gainprm[5]") / kp
        one.slew = fields.get("actuator_dynprm[7]") / abs(g)
        fields.take(*(f"actuator_gainprm[{i}]" for i in (0, 1, 4, 6)))
        _within_voltage(one)


def _winding_of(fields: StatedFields) -> tuple[float, float]:
    """R [Ω] and K [N·m/A] of a DC motor."""
    return fields.get("actuator_gainprm[0]"), fields.get("actuator_gainprm[1]")


def _within_voltage(one: Actuator) -> None:
    """Gains of law pwm for a controller whose voltage (R / K) τ + K g q̇ is clipped at V_max,
    where they are not negative."""
    fields = one.fields
    resistance, constant = _winding_of(fields)
    most_v = fields.get("actuator_gainprm[7]")
    if most_v <= 0.0:
        return
    per_nm = resistance / (abs(one.gear) * constant * most_v)  # duty
    kd = per_nm * one.kd - abs(one.gear) * constant / most_v
    if kd < 0.0:
        fields.explain("law pwm has no kd below 0")
        return
    one.kind, one.supply_v = "voltage", most_v
    one.kp, one.kd = per_nm * one.kp, kd
    fields.take("actuator_gainprm[7]")


def _take_unclipped(one: Actuator, limits: tuple[float, float] | None) -> None:
    """Take a range of targets that contains the joint's limits: it clips no target that the
    joint can reach."""
    integrates = int(one.fields.get("actuator_dyntype")) == _DYN.mjDYN_INTEGRATOR
    range_, switch = (
        ("actuator_actrange", "actuator_actlimited")
        if integrates
        else ("actuator_ctrlrange", "actuator_ctrllimited")
    )
    first = f"{switch}[0]" if one.fields.get(f"{switch}[0]") else switch
    if not one.fields.get(first):
        return
    low, high = sorted(end * one.per_control for end in one.fields.pair(range_))
    if limits is not None and one.kind != "velocity":
        slack = 1e-4 * (limits[1] - limits[0])
        if low <= limits[0] + slack and high >= limits[1] - slack:
            one.fields.take(first, f"{range_}[0]", f"{range_}[1]")
            return
    unit = "speeds" if one.kind == "velocity" else "targets"
    one.fields.explain(
        f"it clips {unit} to {low:.4g} … {high:.4g} at the joint; clip those of a recording "
        "that goes beyond"
    )


def drive_of(draft: JointDraft, every: Sequence[Actuator]) -> DriveFacts:
    """Drive that the actuators ``every`` of a joint make together; their effects go into
    ``draft``."""
    draft.limit(draft.joint, "jnt_actfrclimited", "jnt_actfrcrange", 1.0)
    _passive(draft, every)
    main = next((a for kind in _MAIN for a in every if a.kind == kind), None)
    if main is None:
        return DriveFacts(numbers=draft.limits)
    others = [a for a in every if a is not main and _is_added(draft, main, a)]
    servos = [main, *(a for a in others if a.kind != "torque")]
    numbers: dict[str, float] = {}
    if main.kind == "voltage":
        numbers |= _winding(main)
    if main.kind == "position":
        numbers["kp"] = sum(a.kp for a in servos)
    if main.kind in ("position", "velocity"):
        numbers["kd"] = sum(a.kd for a in servos)
    if constant := sum(a.torque_ff for a in (main, *others)):
        numbers["torque_ff"] = constant
    _command(draft, main)
    draft.remarks += _on_targets(main)
    _limit(draft, main, servos)
    names = tuple(a.name for a in servos)
    law = _LAWS.get(main.kind, "impedance")
    return DriveFacts(law=law, numbers=numbers | draft.limits, actuators=names)


def _is_added(draft: JointDraft, main: Actuator, other: Actuator) -> bool:
    """Whether the numbers of another actuator of the joint add to those of ``main``; a
    remark says how it counts."""
    place = other.fields.place
    if other.kind == "torque":
        draft.remarks.append(
            f"{place} adds {other.per_control:g} times its control to the joint's torque: "
            "a column NAME.torque_ff of a recording has it, else it counts as 0"
        )
        return True
    servos = ("position", "velocity")
    if main.kind in servos and other.kind in servos:
        at = "the same target" if other.kind == main.kind else "a speed of 0"
        draft.remarks.append(
            f"{place} acts on the joint beside {main.name}: kp and kd are the sums of "
            f"both, with {at} for it"
        )
        return True
    if other.kind == "voltage":
        draft.remarks.append(
            f"{place} acts on the joint beside {main.name}, and is left out"
        )
    return False


def _limit(draft: JointDraft, main: Actuator, added: Sequence[Actuator]) -> None:
    """Take the limit of the force, if one actuator gives all of it."""
    limited = [a for a in added if a.fields.get("actuator_forcelimited")]
    if len(added) > 1:
        for one in limited:
            one.fields.explain("it clips this actuator's force, not the sum")
        return
    draft.limit(main.fields, "actuator_forcelimited", "actuator_forcerange", main.gear)
    if main.kind == "torque":
        draft.limit(
            main.fields, "actuator_ctrllimited", "actuator_ctrlrange", main.per_control
        )


def _winding(main: Actuator) -> dict[str, float]:
    """Numbers of law pwm. The supply is that of the controller in the motor, else the range
    of the voltage."""
    fields = main.fields
    resistance, constant = _winding_of(fields)
    numbers = {"resistance_ohm": resistance}
    numbers["torque_nm_per_a"] = abs(main.gear) * constant
    fields.take("actuator_gainprm[0]", "actuator_gainprm[1]")
    low, high = fields.pair("actuator_ctrlrange")
    if main.supply_v:
        numbers |= {"kp": main.kp, "kd": main.kd, "supply_v": main.supply_v}
    elif high > 0.0 and math.isclose(-low, high, rel_tol=_ALIKE):
        fields.take("actuator_ctrllimited", "actuator_ctrlrange")
        numbers["supply_v"] = high
    elif fields.get("actuator_ctrllimited"):
        fields.explain("supply_v drives both directions alike")
    return numbers


def _command(draft: JointDraft, main: Actuator) -> None:
    """Add effects on the way from the control to the force of the drive."""
    fields = main.fields
    dyn = int(fields.get("actuator_dyntype"))
    time_s, delay_s = fields.get("actuator_dynprm[0]"), fields.get("actuator_delay")
    is_motor = dyn == _DYN.mjDYN_DCMOTOR
    if dyn in _FILTERS or (is_motor and time_s > 0.0):
        name = "torque_lag" if is_motor or not main.has_target else "command_lag"
        draft.add(fields, ("actuator_dynprm[0]",), name, time_constant_s=time_s)
    held_s = fields.longest_delay_s
    if delay_s > held_s * (1.0 + _ALIKE):
        fields.explain(
            f"MuJoCo delays by {held_s:g} s, which is all that nsample keeps; with a larger "
            "nsample or this delay in the file, it is command_delay"
        )
    elif delay_s > 0.0 and main.has_target:
        draft.add(fields, ("actuator_delay",), "command_delay", delay_s=delay_s)
    elif delay_s > 0.0:
        fields.explain("the delayed control is no target, but a torque or a voltage")
    if main.slew > 0.0:
        slew = f"actuator_dynprm[{7 if is_motor else 1}]"
        draft.add(fields, (slew,), "slew_limit", speed_rad_per_s=main.slew)
    if main.integral > 0.0:
        gain = f"actuator_gainprm[{5 if is_motor else 0}]"
        draft.add(fields, (gain,), "integral_action", rate_per_s=main.integral)


def _on_targets(main: Actuator) -> Iterator[str]:
    """Remarks on what a recording must hold as target, if not the control itself."""
    fields, place = main.fields, main.fields.place
    spec, times = int(fields.get("actuator_ctrlspec")), f"{main.per_control:.6g}"
    if int(fields.get("actuator_dyntype")) == _DYN.mjDYN_INTEGRATOR:
        yield (
            f"{place} integrates its control: the target, q_target, is {times} times the "
            "integral, which moves between rows: write command_hz"
        )
    elif not math.isclose(main.per_control, 1.0, rel_tol=_ALIKE):
        column = _COLUMNS.get(main.kind, "q_target")
        yield (
            f"{place}: the target of the joint is {times} times its control: in a columns "
            f"file, read a {column} that is the control with `factor: {times}`"
        )
    if main.kd > 0.0 and spec & _POS and spec & _VEL:
        yield (
            f"{place} also has a control for the speed, which counts as 0: if speeds are "
            "sent, add `{effect: velocity_feedforward, share: 1.0}` to the joint"
        )
    if main.has_target and spec & _FF:
        yield (
            f"{place} also has a control for a torque, which counts as 0 without a column "
            "NAME.torque_ff"
        )


def _passive(draft: JointDraft, every: Sequence[Actuator]) -> None:
    """Add friction and cogging of the joint, with what its actuators add to them."""
    joint = draft.joint
    for name, effect, parameter in (
        ("damping", "viscous_friction", "damping_nms_per_rad"),
        ("dampingpoly[0]", "quadratic_drag", "drag_nms2_per_rad2"),
    ):
        own = f"actuator_{name}"
        shares = [(joint, (f"dof_{name}",), joint.get(f"dof_{name}"))]
        shares += [(a.fields, (own,), a.gear**2 * a.fields.get(own)) for a in every]
        if name == "damping":
            shares += [_braking(a) for a in every if a.kind == "passive"]
        draft.add_sum(shares, effect, parameter)
    if (friction := joint.get("dof_frictionloss")) > 0.0:
        if joint.get("dof_solref[0]") == DRY_TIME_S:  # as stiff as the twin's own
            joint.take("dof_solref", "dof_solimp")
        draft.add(joint, ("dof_frictionloss",), "coulomb_friction", torque_nm=friction)
    for a in every:
        is_motor = int(a.fields.get("actuator_gaintype")) == _GAIN.mjGAIN_DCMOTOR
        if is_motor and a.kind != "other":
            _of_device(draft, a)


def spring(draft: JointDraft, rest: float) -> None:
    """Add the spring of the joint, relaxed at ``rest`` [rad or m]. Its higher powers and
    its yield stay among the fields."""
    if stiffness := draft.joint.get("jnt_stiffness"):
        values = {"stiffness_nm_per_rad": stiffness, "rest_rad": rest}
        draft.add(draft.joint, ("jnt_stiffness",), "cable_spring", **values)


def _braking(one: Actuator) -> Share:
    """Damping by the back-EMF of a motor whose terminals are connected, K² / R."""
    resistance, constant = _winding_of(one.fields)
    if constant == 0.0:
        one.fields.take("actuator_gainprm[0]")  # no current flows
    braking = (one.gear * constant) ** 2 / resistance
    return one.fields, ("actuator_gainprm[0]", "actuator_gainprm[1]"), braking


def _of_device(draft: JointDraft, a: Actuator) -> None:
    """Cogging and LuGre friction of a DC motor, at the joint."""
    fields, g = a.fields, abs(a.gear)
    cogging = [fields.get(f"actuator_biasprm[{i}]") for i in range(3)]
    amplitude, poles, phase = cogging
    lugre = [fields.get(f"actuator_biasprm[{i}]") for i in range(3, 6)]
    sliding, static, slow = lugre
    if amplitude > 0.0:
        names = [f"actuator_biasprm[{i}]" for i in range(3)]
        values: dict[str, Any] = {"torque_nm": g * amplitude, "periods": g * poles}
        values["phase_rad"] = math.copysign(1.0, a.gear) * phase
        draft.add(fields, names, "cogging", **values)
    stiffness, damping = (fields.get(f"actuator_dynprm[{i}]") for i in (5, 6))
    if stiffness <= 0.0 or sliding <= 0.0:
        return
    names = [f"actuator_biasprm[{i}]" for i in (3, 4, 5)] + ["actuator_dynprm[5]"]
    if math.isclose(damping, BRISTLE_DAMPING_S * stiffness, rel_tol=0.5):
        names.append("actuator_dynprm[6]")
    draft.add(
        fields,
        names,
        "stribeck_friction",
        torque_nm=g * sliding,
        stiction_share=static / sliding - 1.0,
        stribeck_rad_per_s=slow / g,
        presliding_rad=static / stiffness / g,
    )

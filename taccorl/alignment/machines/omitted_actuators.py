"""Actuators of an MJCF file that no robot file can state, because they do not act on one joint alone: on tendons, between sites,
through a crank, by adhesion, or on a joint that is held fixed.

A robot file gives each joint a drive of its own. Position actuators i with gains kp_i on fixed tendons of length
l_i = Σ_j c_ij q_j give the joints the stiffness K = Σ_i kp_i c_i c_iᵀ (and kd likewise). Where K of a joint has nothing beside
its diagonal, as of a CoreXY gantry with equal motors, the diagonal is what a drive of that joint would have.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import mujoco
import numpy as np

from taccorl.data.finding import listed
from taccorl.errors import TaccorlError

_TRN = mujoco.mjtTrn
ON_JOINT = (_TRN.mjTRN_JOINT, _TRN.mjTRN_JOINTINPARENT)
"""Transmissions that act on one joint; for hinges and slides both are the same."""
_KIND = {
    _TRN.mjTRN_TENDON: "tendon",
    _TRN.mjTRN_SITE: "site",
    _TRN.mjTRN_BODY: "body",
    _TRN.mjTRN_SLIDERCRANK: "slider-crank",
}
_STATED = ("forcerange", "ctrlrange", "delay", "damping", "armature")
_NOTHING = 1e-9  # share of the diagonal below which an element beside it is rounding


@dataclass(frozen=True)
class OmittedActuator:
    """An actuator that does not act on one joint alone."""

    name: str
    transmission: str  # What it acts on, with its name in the file
    levers: dict[str, float | None]
    """Joint that it moves → change of its length per motion of the joint, gear included [rad/rad, m/rad, …]; None where this
    depends on the pose."""
    kp: float  # Position gain at its own length; 0 for a motor
    kd: float  # Velocity gain at its own length; NaN if it is stated as a ``dampratio``
    more: str = ""  # What else it states, in MuJoCo's words

    @property
    def text(self) -> str:
        """Sentence that names the actuator, its transmission, and the joints that it moves."""
        moved = [
            name if lever is None else f"{name} ({lever:g})"
            for name, lever in self.levers.items()
        ]
        where = (
            f"moves {listed(moved, len(moved))}"
            if moved
            else "moves no hinge or slide by itself"
        )
        more = f"; so is its {self.more}" if self.more else ""
        return f"actuator {self.name} is left out: it acts on {self.transmission}, which {where}{more}"


def omitted_actuators(spec: mujoco.MjSpec) -> list[OmittedActuator]:
    """Actuators of ``spec`` that do not act on one hinge or slide, in the order of the file. Raises TaccorlError: such an
    actuator acts on something that the file does not have."""
    omitted = []
    for k, actuator in enumerate(spec.actuators):
        name, kind = (
            actuator.name or f"{k} (no name)",
            _KIND.get(actuator.trntype, str(actuator.trntype)),
        )
        gear = float(actuator.gear[0])
        if actuator.trntype in ON_JOINT:
            joint = spec.joint(actuator.target)
            if joint is None or _moves(joint):
                continue
            transmission, levers = (
                f"joint {joint.name}, a ball or free joint that is held fixed",
                {},
            )
        elif actuator.trntype == _TRN.mjTRN_TENDON:
            transmission = f"{kind} {actuator.target}"
            pairs = _of_tendon(
                _present(spec.tendon(actuator.target), f"actuator {name}", transmission)
            )
            levers = {
                joint: None if lever is None else gear * lever for joint, lever in pairs
            }
        else:
            second = actuator.refsite or actuator.slidersite
            transmission = f"{kind} {actuator.target}" + (
                f" and {second}" if second else ""
            )
            if actuator.trntype == _TRN.mjTRN_BODY:
                _present(spec.body(actuator.target), f"actuator {name}", transmission)
                bodies: list[
                    mujoco.MjsBody
                ] = []  # adhesion pulls at what the body touches
            else:
                of = [at for at in (actuator.target, second) if at]
                bodies = [
                    _present(spec.site(at), f"actuator {name}", f"site {at}").parent
                    for at in of
                ]
            # A lone site is pushed against the world.
            levers = dict.fromkeys(
                _between(bodies if second else [*bodies, spec.worldbody])
            )
        affine = actuator.biastype == mujoco.mjtBias.mjBIAS_AFFINE
        kp, kd = (-float(actuator.biasprm[p]) if affine else 0.0 for p in (1, 2))
        if kd < 0.0:
            kd = math.nan
        numbers = (kp + 0.0, kd + 0.0)
        omitted.append(
            OmittedActuator(name, transmission, levers, *numbers, _more(actuator))
        )
    return omitted


def _more(actuator: mujoco.MjsActuator) -> str:
    """Limits, delay, friction, inertia and dynamics of an actuator, in MuJoCo's words."""
    stated = {name: np.ravel(getattr(actuator, name)) for name in _STATED}
    texts = [
        f"{name} {' '.join(f'{x:g}' for x in values)}"
        for name, values in stated.items()
        if values.any()
    ]
    if actuator.dyntype != mujoco.mjtDyn.mjDYN_NONE:
        texts.append(f"dyntype {actuator.dyntype.name}")
    if actuator.biasprm[2] > 0.0:
        texts.append(f"dampratio {actuator.biasprm[2]:g}")
    return ", ".join(texts)


def joint_gains(
    omitted: list[OmittedActuator], joint: str
) -> tuple[float, float, dict[str, float]] | None:
    """kp and kd with which all of ``omitted`` together hold one joint [N·m/rad, N·m·s/rad; N/m, N·s/m], and other joint → kp that
    couples it with that joint. None if no actuator holds it, or if the lever of one that does depends on the pose."""
    own = [a for a in omitted if joint in a.levers]
    if not own or any(lever is None for a in own for lever in a.levers.values()):
        return None
    if any(math.isnan(a.kd) for a in own):
        return None
    stiffness: dict[str, float] = {}
    damping = 0.0
    for actuator in own:
        at = actuator.levers[joint] or 0.0
        damping += actuator.kd * at * at
        for other, lever in actuator.levers.items():
            stiffness[other] = stiffness.get(other, 0.0) + actuator.kp * at * (
                lever or 0.0
            )
    held = stiffness.pop(joint)
    if held <= 0.0:
        return None
    return (
        held,
        damping,
        {name: kp for name, kp in stiffness.items() if abs(kp) > _NOTHING * held},
    )


def remarks_on(omitted: list[OmittedActuator]) -> list[str]:
    """One remark for each actuator, and one that says what a robot file can state instead."""
    if not omitted:
        return []
    said = [actuator.text for actuator in omitted]
    moved = list(dict.fromkeys(name for a in omitted for name in a.levers))
    if not moved:
        return said
    gains = []
    for name in moved:
        found = joint_gains(omitted, name)
        if found and found[2]:
            beside = ", ".join(f"{kp:g} with {other}" for other, kp in found[2].items())
            gains.append(
                f"{name}: kp {found[0]:g}, kd {found[1]:g}, and kp {beside}, which no robot file holds"
            )
        elif found:
            gains.append(
                f"{name}: kp {found[0]:g}, kd {found[1]:g}, not coupled with another joint"
            )
    shared = list(
        dict.fromkeys(name for a in omitted if len(a.levers) > 1 for name in a.levers)
    )
    said.append(
        "a robot file gives each joint a drive of its own and states no other transmission. "
        + (f"Together these actuators hold {'; '.join(gains)}. " if gains else "")
        + "Write the kp and kd that a joint feels while the others rest, and as its efforts the forces at the joint, not "
        "the motors'"
    )
    if shared:
        said.append(
            f"an actuator moves several of {listed(shared, len(shared))}: its friction, play and inertia act on all that it "
            "moves, which a robot file cannot state, and what diagnose names at one of them may be in the motor. Record motions "
            "in which one motor turns alone, and describe that motor by a robot file without a model"
        )
    return said


def _moves(joint: mujoco.MjsJoint) -> bool:
    return joint.type in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)


def _present[ThingT](thing: ThingT | None, which: str, on: str) -> ThingT:
    """``thing``, which ``which`` acts on, if the file has it."""
    if thing is None:
        raise TaccorlError(
            f"{which} acts on {on}, which the file does not have; correct the name there"
        )
    return thing


def _of_tendon(tendon: mujoco.MjsTendon) -> Iterator[tuple[str, float | None]]:
    """Pairs (joint, coefficient) of the joints that a tendon moves: change of the tendon's length per motion of the joint
    [m/rad, m/m]; None for a spatial tendon, whose coefficients depend on the pose."""
    path = [wrap for wrap in tendon.path if wrap.type != mujoco.mjtWrap.mjWRAP_PULLEY]
    for k, wrap in enumerate(path):
        _present(
            wrap.target,
            f"tendon {tendon.name}",
            f"a joint, site or geom at its place {k}, counted from 0",
        )
    fixed = [wrap for wrap in path if wrap.type == mujoco.mjtWrap.mjWRAP_JOINT]
    for wrap in fixed:
        yield wrap.target.name, float(wrap.coef)
    if not fixed:
        yield from (
            (joint, None) for joint in _between([wrap.target.parent for wrap in path])
        )


def _between(bodies: list[mujoco.MjsBody]) -> list[str]:
    """Hinges and slides that move some of the bodies and not all of them, from the base on."""
    chains = [list(_chain(body)) for body in bodies]
    names = list(dict.fromkeys(name for chain in chains for name in chain))
    return [name for name in names if not all(name in chain for chain in chains)]


def _chain(body: mujoco.MjsBody) -> list[str]:
    """Hinges and slides that move a body, from the base on."""
    names: list[str] = []
    at: mujoco.MjsBody | None = body
    while at is not None:
        names = [joint.name for joint in at.joints if _moves(joint)] + names
        at = at.parent if at.name != "world" else None
    return names


def held_by(
    omitted: list[OmittedActuator], joint: str
) -> tuple[str, float, float] | None:
    """(names of the actuators, kp, kd) of a joint that actuators hold together and without coupling; else None."""
    found = joint_gains(omitted, joint)
    if found is None or found[2]:
        return None
    names = [a.name for a in omitted if joint in a.levers]
    return listed(names, len(names)), found[0], found[1]


def without(spec: mujoco.MjSpec, omitted: list[OmittedActuator]) -> None:
    """Remove from ``spec`` what ``omitted_actuators`` returned."""
    names = {a.name for a in omitted}
    for k, actuator in reversed(list(enumerate(spec.actuators))):
        if (actuator.name or f"{k} (no name)") in names:
            spec.delete(actuator)

"""Actuators of an MJCF file that do not act on one hinge or slide: on tendons, between sites,
through a crank, by adhesion, or on a joint that is held fixed. A robot file gives each joint
a drive of its own, so they are left out, with a remark on each."""

from collections.abc import Iterator

import mujoco
import numpy as np

from taccorl.alignment.machines.model_xml import Element
from taccorl.errors import TaccorlError

_TRN = mujoco.mjtTrn
_ON_JOINT = (_TRN.mjTRN_JOINT, _TRN.mjTRN_JOINTINPARENT)
"""Transmissions that act on one joint; for hinges and slides both are the same."""
_MOVING = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
_STATED = ("forcerange", "ctrlrange", "delay", "damping", "armature")
WAY_OUT = (
    "a robot file gives each joint a drive of its own: write the kp and kd that each joint "
    "feels while the others rest, and as its efforts the forces at the joint"
)


def leave_out(spec: mujoco.MjSpec, root: Element) -> list[str]:
    """Remove actuators that do not act on one hinge or slide from ``spec``. Returns a remark
    on each, and what to write instead. ``root``: the elements of its file.

    Raises TaccorlError: such an actuator acts on something that the file does not have."""
    lines = [one for section in root.all("actuator") for one in section.children]
    has_lines = len(lines) == len(spec.actuators)  # not of replicated ones
    remarks: list[str] = []
    for k, actuator in reversed(list(enumerate(spec.actuators))):
        joint = spec.joint(actuator.target)
        on_joint = actuator.trntype in _ON_JOINT
        if on_joint and (joint is None or joint.type in _MOVING):
            continue
        name = actuator.name or f"{k} (no name)"
        place = f" ({lines[k].near})" if has_lines else ""
        where = _transmission(spec, actuator, f"actuator {name}")
        stated = ", ".join(_stated(actuator))
        also = f"; so is its {stated}" if stated else ""
        remarks.insert(
            0, f"actuator {name}{place} is left out: it acts on {where}{also}"
        )
        spec.delete(actuator)
    return [*remarks, WAY_OUT] if remarks else []


def _transmission(spec: mujoco.MjSpec, actuator: mujoco.MjsActuator, which: str) -> str:
    """What an actuator acts on, with its name, and the levers of a fixed tendon."""
    target = actuator.target
    if actuator.trntype in _ON_JOINT:
        return f"joint {target}, a ball or free joint that is held fixed"
    if actuator.trntype == _TRN.mjTRN_BODY:
        _require(spec.body(target), which, f"body {target}")
        return f"body {target}"
    if actuator.trntype == _TRN.mjTRN_TENDON:
        tendon = spec.tendon(target)
        _require(tendon, which, f"tendon {target}")
        path = [w for w in tendon.path if w.type != mujoco.mjtWrap.mjWRAP_PULLEY]
        for k, wrap in enumerate(path):
            _require(
                wrap.target,
                f"tendon {target}",
                f"a joint, site or geom at its place {k}, counted from 0",
            )
        levers = [
            f"{wrap.target.name} ({actuator.gear[0] * wrap.coef:g})"
            for wrap in path
            if wrap.type == mujoco.mjtWrap.mjWRAP_JOINT
        ]
        return f"tendon {target}" + (f" of {', '.join(levers)}" if levers else "")
    second = actuator.refsite or actuator.slidersite
    sites = [site for site in (target, second) if site]
    for site in sites:
        _require(spec.site(site), which, f"site {site}")
    kind = "slider-crank" if actuator.trntype == _TRN.mjTRN_SLIDERCRANK else "site"
    return f"{kind} {' and '.join(sites)}"


def _require(thing: object | None, which: str, on: str) -> None:
    if thing is None:
        raise TaccorlError(
            f"{which} acts on {on}, which the file does not have; correct the name there"
        )


def _stated(actuator: mujoco.MjsActuator) -> Iterator[str]:
    """Limits, delay, friction, inertia and dynamics of an actuator, in MuJoCo's words."""
    for name in _STATED:
        values = np.ravel(getattr(actuator, name))
        if values.any():
            yield f"{name} {' '.join(f'{x:g}' for x in values)}"
    if actuator.dyntype != mujoco.mjtDyn.mjDYN_NONE:
        yield f"dyntype {actuator.dyntype.name}"
    if actuator.biasprm[2] > 0.0:
        yield f"dampratio {actuator.biasprm[2]:g}"

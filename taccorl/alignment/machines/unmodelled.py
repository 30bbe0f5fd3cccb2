"""Parts of an MJCF file that a robot file does not state, besides its joints and the
actuators of one joint: remarks that quote each with its line. A robot file gives each
joint a drive of its own, so actuators on anything else are left out."""

import mujoco

from taccorl.alignment.machines.model_xml import Element
from taccorl.errors import printable

WAY_OUT = (
    "a robot file gives each joint a drive of its own: write the kp and kd that each joint "
    "feels while the others rest, and as its efforts the forces at the joint"
)
_MOVING = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
_TENDONS = "MuJoCo simulates this, and a robot file has no tendons"
_OF_TENDONS = ("stiffness", "damping", "frictionloss", "armature", "range")
_UNMODELLED = {
    "body": (
        ("gravcomp",),
        "MuJoCo carries this share of the weight; here gravity_compensation says what the "
        "controller carries",
    ),
    "tendon": (_OF_TENDONS, _TENDONS),
    "fixed": (_OF_TENDONS, _TENDONS),
    "spatial": (_OF_TENDONS, _TENDONS),
    "option": (("density", "viscosity", "wind"), "forces of a medium are not modelled"),
    "flag": (
        ("damper", "spring", "clampctrl", "frictionloss", "actuation"),
        "a switch of MuJoCo, which a robot file does not have",
    ),
}
"""Tag → attributes that act on joints, and what that means for a robot file."""


def remarks_on_unmodelled(spec: mujoco.MjSpec, root: Element) -> list[str]:
    """Remarks on weight compensation, tendons, options, and equalities of one joint.
    ``root``: the elements of the file of ``spec``."""
    places: dict[tuple[str, str], list[str]] = {}
    for one in root.all(*_UNMODELLED):
        keys, meaning = _UNMODELLED[one.tag]
        stated = [
            f"{key} {value}"
            for key in keys
            if (value := one.get(key)) and not {*value.split()} <= {"0", "enable"}
        ]
        if stated:
            name = " ".join(filter(None, (one.tag, one.get("name"))))
            places.setdefault((", ".join(stated), meaning), []).append(
                f"{name} ({one.near})"
            )
    remarks = [
        f"{', '.join(where)}: {stated}: {meaning}"
        for (stated, meaning), where in places.items()
    ]
    for one in spec.equalities:
        if one.type == mujoco.mjtEq.mjEQ_JOINT and one.active and not one.name2:
            lines = [e.near for e in root.all("joint") if e.get("joint1") == one.name1]
            remarks.append(
                f"joint {one.name1} ({', '.join(lines)}): an <equality> holds it at "
                f"{one.data[0]:g}; remove it from the robot file"
            )
    return remarks


def leave_out(spec: mujoco.MjSpec, root: Element) -> list[str]:
    """Remove actuators that do not act on one hinge or slide from ``spec``. Returns a remark
    on each, which quotes its element, and what to write instead."""
    elements = [one for section in root.all("actuator") for one in section.children]
    has_lines = len(elements) == len(spec.actuators)  # not of replicated ones
    remarks: list[str] = []
    for k, actuator in reversed(list(enumerate(spec.actuators))):
        joint = spec.joint(actuator.target)
        kind = actuator.trntype.name.removeprefix("mjTRN_").lower()
        # Of one joint; for hinges and slides both kinds are the same.
        on_joint = kind in ("joint", "jointinparent")
        if on_joint and (joint is None or joint.type in _MOVING):
            continue
        text = f"actuator {actuator.name or f'{k} (no name)'}"
        stated = ""
        if has_lines:
            numbers = (f"{n} {v}" for n, v in elements[k].attributes.items())
            text, stated = f"{text} ({elements[k].near})", f": {', '.join(numbers)}"
        where = f"it acts on {kind} {actuator.target}, not on one joint"
        remarks.insert(0, printable(f"{text} is left out: {where}{stated}"))
        spec.delete(actuator)
    return [*remarks, WAY_OUT] if remarks else []

"""Parts of an MJCF file besides its joints and their actuators that a robot file does not
state: remarks with the line of each."""

from collections.abc import Iterator

import mujoco
import numpy as np

from taccorl.alignment.machines.model_xml import Element

_DISABLED = ("DAMPER", "SPRING", "CLAMPCTRL", "FRICTIONLOSS", "ACTUATION")
"""Flags of MuJoCo that switch off what acts on a joint."""
_MEDIUM = ("density", "viscosity", "wind")
_OF_TENDON = ("stiffness", "damping", "frictionloss", "armature", "range")


def remarks_on_unmodelled(spec: mujoco.MjSpec, root: Element) -> list[str]:
    """Remarks on what ``spec`` states of weight compensation, tendons, equalities of
    one joint, and options. ``root``: the elements of its file."""
    parts = (_bodies, _tendons, _held_joints, _options)
    return [remark for part in parts for remark in part(spec, root)]


def _place(root: Element, key: str, value: str, *tags: str) -> str:
    """Line of the first element with one of these tags and this attribute, in brackets;
    empty if there is none."""
    found = (one for one in root.all(*tags) if one.get(key) == value)
    return next((f" ({one.near})" for one in found), "")


def _bodies(spec: mujoco.MjSpec, root: Element) -> Iterator[str]:
    places: dict[float, list[str]] = {}
    for body in spec.bodies:
        if body.gravcomp:
            place = _place(root, "name", body.name, "body")
            places.setdefault(float(body.gravcomp), []).append(f"{body.name}{place}")
    for share, where in places.items():
        yield (
            f"body {', '.join(where)}: gravcomp {share:g}: MuJoCo carries this share of "
            "the weight; here gravity_compensation says what the controller carries"
        )


def _tendons(spec: mujoco.MjSpec, root: Element) -> Iterator[str]:
    for tendon in spec.tendons:
        stated = {name: np.ravel(getattr(tendon, name)) for name in _OF_TENDON}
        texts = [
            f"{name} {_numbers(values)}"
            for name, values in stated.items()
            if values.any()
        ]
        if texts:
            place = _place(root, "name", tendon.name, "fixed", "spatial")
            yield (
                f"tendon {tendon.name}{place}: {', '.join(texts)}: MuJoCo simulates "
                "this, and a robot file has no tendons"
            )


def _held_joints(spec: mujoco.MjSpec, root: Element) -> Iterator[str]:
    for one in spec.equalities:
        if one.type == mujoco.mjtEq.mjEQ_JOINT and one.active and not one.name2:
            place = _place(root, "joint1", one.name1, "joint")
            yield (
                f"joint {one.name1}{place}: an <equality> holds it at {one.data[0]:g}; "
                "remove it from the robot file"
            )


def _options(spec: mujoco.MjSpec, root: Element) -> Iterator[str]:
    for name in _MEDIUM:
        value = np.ravel(getattr(spec.option, name))
        if value.any():
            places = [one.near for one in root.all("option") if one.get(name)]
            yield (
                f"option {name} {_numbers(value)} ({', '.join(places)}): forces of a "
                "medium are not modelled"
            )
    for name in _DISABLED:
        if spec.option.disableflags & getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}"):
            flag = name.lower()
            places = [one.near for one in root.all("flag") if one.get(flag)]
            yield (
                f"flag {flag} ({', '.join(places)}): disabled in MuJoCo, not in the "
                "robot file"
            )


def _numbers(values: np.ndarray) -> str:
    return " ".join(f"{x:g}" for x in values)

"""Any robot of an MJCF or URDF file as rigid bodies: the kinematic tree, masses, inertias, gravity, and further facts about its
joints.

Meshes are not needed: mesh, texture and material entries are removed before the model is compiled, and their files may be
missing. So a moving link needs its inertia in the file (``<inertial>``), or, in MJCF, geoms that are primitives. A floating base
is held fixed, and so are ball joints. Joints that a closed chain ties together are refused: inverse dynamics of a tree would be
wrong for them.

Passive forces of the file (damping, dry friction, springs) and its actuators are not part of the rigid-body model;
``joint_facts`` returns them, and ``taccorl init-robot`` writes them into the robot file, where they can be seen, fitted and
removed.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import mujoco
import numpy as np

from taccorl.alignment.machines.model_drive import (
    DriveFacts,
    JointDraft,
    actuator_of,
    drive_of,
    spring,
)
from taccorl.alignment.machines.model_xml import (
    Element,
    Places,
    joints_of,
    read_model,
    unbalanced,
)
from taccorl.alignment.machines.stated_fields import StatedFields, remarks_on_rest
from taccorl.alignment.machines.unmodelled import leave_out, remarks_on_unmodelled
from taccorl.data.finding import listed
from taccorl.errors import TaccorlError
from taccorl.sim.effects.effect import Effect

_HINGE, _SLIDE = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE
MOST_TURNS = (
    3.0  # Turns to a side of a hinge beyond which its limits are probably in degrees
)
_CLOSING = {mujoco.mjtEq.mjEQ_CONNECT: "connect", mujoco.mjtEq.mjEQ_WELD: "weld"}
_REMOVED = (
    "sensors",
    "keys",
    "equalities",
    "tendons",
    "pairs",
    "excludes",
    "skins",
    "lights",
    "cameras",
)


@dataclass(frozen=True, kw_only=True)
class JointFacts:
    """Facts about one joint in a model file: limits, inertia, passive forces, actuators."""

    name: str
    unit: Literal["rad", "m"]  # Unit of its position: rad of a hinge, m of a slide
    limits: (
        tuple[float, float] | None
    )  # Lowest and highest position [rad or m]; None if unlimited
    inertia: float
    """Inertia of all bodies that the joint moves, with other joints at the model's zero pose [kg·m² or kg]; without armature."""
    armature: float  # Rotor inertia at the joint, of joint and actuators [kg·m² or kg]
    drive: DriveFacts
    """Drive by the actuators of the joint."""
    effects: tuple[Effect, ...]  # Friction, springs and effects in the drive


@dataclass(frozen=True)
class RobotModel:
    """A compiled tree of rigid bodies without contact, passive forces and armature."""

    path: Path  # Path of the MJCF or URDF file
    model: mujoco.MjModel
    joints: dict[
        str, JointFacts
    ]  # Name → facts of the hinge and slide joints, in the order of the tree
    remarks: tuple[str, ...]
    """Parts of the file that were left out, and what that means for the robot file."""


def load_robot_model(path: Path, gravity_compensation: float = 0.0) -> RobotModel:
    """Read an MJCF or URDF file. ``gravity_compensation``: share of the weight that the controller compensates. Raises
    TaccorlError: the file cannot be read; a moving link has no inertia, or one that requires a mesh; there is a closed chain, a
    joint without a name, or no joint."""
    path = Path(path)
    spec, root, remarks, mimics = _spec(path)
    spec.memory = -1  # of contacts, which are not computed
    _refuse_closed_chains(path, spec)
    remarks += leave_out(spec, root)
    remarks += remarks_on_unmodelled(spec, root)
    remarks += _without_meshes(path, spec)
    remarks += _held_base(spec)
    for body in spec.bodies:
        body.gravcomp = gravity_compensation
    model = _compiled(path, spec, root)
    names = [model.joint(k).name for k in range(model.njnt)]
    if "" in names:
        k = names.index("")
        body = model.body(model.jnt_bodyid[k]).name or "without a name"
        raise TaccorlError(
            f"{path}: joint {k + 1} of {model.njnt}, of body {body}, has no name; give it one"
        )
    joints, of_joints = _joint_facts(model, names, root)
    remarks += of_joints
    remarks += [
        remark for facts in joints.values() for remark in _of_limits(root, facts)
    ]
    remarks += [
        _of_mimic(joints[name], *mimic)
        for name, mimic in mimics.items()
        if name in joints
    ]
    if not joints:
        raise TaccorlError(
            f"{path}: the file has neither hinge nor slide joints; is it the whole robot?"
        )
    model.opt.disableflags |= (
        mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_ACTUATION
    )
    # Fields that the rigid-body model lacks, because the robot file has them.
    for field in (
        "dof_damping",
        "dof_frictionloss",
        "dof_armature",
        "jnt_stiffness",
        "actuator_armature",
        "actuator_damping",
    ):
        getattr(model, field)[:] = 0.0
    # MuJoCo stores the inertia of a body on one slide when it compiles, with the armature.
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return RobotModel(path, model, joints, tuple(remarks))


def _spec(
    path: Path,
) -> tuple[mujoco.MjSpec, Element, list[str], dict[str, tuple[str, float]]]:
    """The model, the file's elements, remarks, and joint → (joint that it follows, multiplier) of a URDF's <mimic> or an MJCF's
    <equality>."""
    root = read_model(path)
    if root.tag not in ("mujoco", "robot"):
        hint = (
            "; expand it first: xacro robot.urdf.xacro > robot.urdf"
            if "xacro" in path.name
            else ""
        )
        raise TaccorlError(
            f"{path}: <{root.tag}> is neither MJCF (<mujoco>) nor URDF (<robot>){hint}"
        )
    if root.tag == "robot" and any(
        "xacro" in element.tag for element in root.iterate()
    ):
        raise TaccorlError(
            f"{path}: holds xacro macros; expand it first: xacro {path.name} > robot.urdf"
        )
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        mimics = {
            joint.get("name"): (mimic.get("joint"), float(mimic.get("multiplier", "1")))
            for joint in root.all("joint")
            if (mimic := joint.child("mimic")) is not None
        }
    except (ValueError, mujoco.FatalError) as error:
        raise TaccorlError(
            f"{_placed(path, error)}: MuJoCo cannot read it: {_one_line(error)}"
        ) from error
    if root.tag == "mujoco":
        # MuJoCo moves the model for minutes to find the range of a muscle.
        spec.compiler.LRopt.mode = int(mujoco.mjtLRMode.mjLRMODE_NONE)
        tied = (
            e
            for e in spec.equalities
            if e.type == mujoco.mjtEq.mjEQ_JOINT and e.active and e.name2
        )
        return spec, root, [], {e.name1: (e.name2, float(e.data[1])) for e in tied}
    for geom in list(spec.geoms):  # no link has its inertia from them
        spec.delete(geom)
    remarks = _with_one_limit(spec, root)
    if shapes := len(root.all("visual", "collision")):
        text = f"{shapes} visual and collision shapes of the URDF are not used"
        remarks.insert(0, text)
    return spec, root, remarks, mimics


def _with_one_limit(spec: mujoco.MjSpec, root: Element) -> list[str]:
    """Switch on limits of a URDF with ``lower`` or ``upper`` alone, the other being 0:
    MuJoCo switches them off. Returns remarks."""
    remarks = []
    for name, element in joints_of(root).items():
        limit = element.child("limit")
        joint = spec.joint(name)
        if joint is None or limit is None or not joint.range[0] < joint.range[1]:
            continue
        stated = [key for key in ("lower", "upper") if limit.get(key)]
        if len(stated) == 1:
            joint.limited = mujoco.mjtLimited.mjLIMITED_TRUE
            remarks.append(
                f"joint {name} ({limit.near}): the limit states {stated[0]} alone; the "
                "other one is 0 by the rules of URDF"
            )
    return remarks


def _placed(path: Path, error: Exception) -> str:
    """The file, with the line that MuJoCo names."""
    found = re.search(r"line (\d+)", str(error))
    return f"{path}:{found[1]}" if found else str(path)


def _of_limits(root: Element, facts: JointFacts) -> list[str]:
    """A remark on limits of a hinge that are more than three turns to a side."""
    if (
        facts.unit != "rad"
        or facts.limits is None
        or max(map(abs, facts.limits)) <= MOST_TURNS * 2.0 * math.pi
    ):
        return []
    element = joints_of(root).get(facts.name)
    limit = element and (element.child("limit") or element)
    low, high = facts.limits
    return [
        f"joint {facts.name}{f' (line {limit.line})' if limit else ''}: limits {low:.4g} … {high:.4g} rad are more than "
        f"{MOST_TURNS:g} turns. Are they degrees? Then write {math.radians(low):.4g} and {math.radians(high):.4g}: a wrong limit "
        "finds no position beyond it"
    ]


def _of_mimic(facts: JointFacts, follows: str, multiplier: float) -> str:
    quantity, unit = ("mass", "kg") if facts.unit == "m" else ("inertia", "kg·m²")
    return (
        f"joint {facts.name} follows {follows} (<mimic> or <equality>), which is not modelled: it is taken for one of its own. "
        f"If nothing drives it, leave it out of the robot file; {follows} then lacks the {quantity} that its motor moves there, "
        f"{abs(multiplier):g}² × {facts.inertia:.3g} = {multiplier**2 * facts.inertia:.3g} {unit}: add it to the links of "
        f"{follows} in the model file"
    )


def _refuse_closed_chains(path: Path, spec: mujoco.MjSpec) -> None:
    closing = {
        e: _CLOSING[e.type] for e in spec.equalities if e.type in _CLOSING and e.active
    }
    if closing:
        names = [
            f"{t} {e.name or '(no name)'} between {e.name1} and {e.name2 or 'world'}"
            for e, t in closing.items()
        ]
        raise TaccorlError(
            f"{path}: closed chain: {listed(names)}. Only trees are supported: remove <{next(iter(closing.values()))}> and the "
            "links that close the loop, and add the inertia of the removed links to those that remain"
        )


def _without_meshes(path: Path, spec: mujoco.MjSpec) -> list[str]:
    """Remove meshes and all that refers to them. Raises TaccorlError: a moving body has its inertia from a mesh."""
    always = (
        spec.compiler.inertiafromgeom
        == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    )
    groups = spec.compiler.inertiagrouprange
    from_mesh: dict[str, str] = {}
    moving = _moving(spec)
    meshes = 0
    for geom in list(spec.geoms):
        geom.material = ""
        if not geom.meshname and geom.type not in (
            mujoco.mjtGeom.mjGEOM_MESH,
            mujoco.mjtGeom.mjGEOM_HFIELD,
        ):
            continue
        body = geom.parent
        weightless = geom.mass == 0 or (math.isnan(geom.mass) and geom.density == 0)
        counts = groups[0] <= geom.group <= groups[1] and not weightless
        if body.name in moving and counts and (always or not body.explicitinertial):
            from_mesh.setdefault(body.name or "(no name)", geom.meshname)
        spec.delete(geom)
        meshes += 1
    if from_mesh:
        body, mesh = next(iter(from_mesh.items()))
        others = (
            f" The same holds for {listed(list(from_mesh)[1:])}."
            if len(from_mesh) > 1
            else ""
        )
        why = ' (the file says inertiafromgeom="true")' if always else ""
        raise TaccorlError(
            f"{path}: body {body} has its inertia from mesh {mesh!r}{why}, but meshes are not read. State it: <inertial "
            f'pos="x y z" mass="kg" diaginertia="Ixx Iyy Izz"/> in <body name="{body}">.{others} A model that MuJoCo '
            "has compiled once has them: save it with mj_saveLastXML"
        )
    for kind in (*_REMOVED, "materials", "textures", "meshes", "hfields"):
        for thing in list(getattr(spec, kind)):
            spec.delete(thing)
    return [f"{meshes} mesh geoms are not used; inertias are those of the file"] * bool(
        meshes
    )


def _moving(spec: mujoco.MjSpec) -> set[str]:
    """Bodies that a hinge, slide or ball joint moves."""
    own = [
        joint.parent
        for joint in spec.joints
        if joint.type != mujoco.mjtJoint.mjJNT_FREE
    ]
    return {body.name for first in own for body in (first, *first.find_all("body"))}


def _held_base(spec: mujoco.MjSpec) -> list[str]:
    """Remove free and ball joints: what they move is held where the file has it."""
    remarks = []
    for joint in list(spec.joints):
        if joint.type not in (_HINGE, _SLIDE):
            what = "free" if joint.type == mujoco.mjtJoint.mjJNT_FREE else "ball"
            remarks.append(
                f"{what} joint {joint.name or 'of ' + joint.parent.name}: held fixed"
            )
            spec.delete(joint)
    return remarks


def _compiled(path: Path, spec: mujoco.MjSpec, root: Element) -> mujoco.MjModel:
    try:
        return spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        text = _one_line(error)
        if "mass and inertia of moving bodies" in text:
            named = text.partition("Element name '")[2].partition("'")[0]
            inertial = (
                '<inertial><origin xyz="x y z"/><mass value="kg"/><inertia ixx="" iyy="" izz="" ixy="0" ixz="0" iyz="0"/>'
                f'</inertial> in <link name="{named}">'
                if path.suffix == ".urdf"
                else f'<inertial pos="x y z" mass="kg" diaginertia="Ixx Iyy Izz"/> in <body name="{named}">'
            )
            link = named or "without a name (give it one)"
            raise TaccorlError(
                f"{path}: link {link} moves and has no mass or inertia; write {inertial}, from CAD or the data sheet"
            ) from error
        if "inertia" in text and (why := unbalanced(root)):
            raise TaccorlError(why) from error
        raise TaccorlError(
            f"{_placed(path, error)}: MuJoCo cannot compile it: {text}"
        ) from error


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())


def _inertias(model: mujoco.MjModel) -> np.ndarray:
    """(V,) inertia of each degree of freedom with all bodies that it moves, at the zero pose [kg·m², kg]."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    mass = np.empty((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    return np.diag(mass)


def _joint_facts(
    model: mujoco.MjModel, names: Sequence[str], root: Element
) -> tuple[dict[str, JointFacts], list[str]]:
    """Facts of each joint, and remarks on what the model states beyond them."""
    places, inertias = Places(root), _inertias(model)
    found: dict[str, JointFacts] = {}
    remarks: list[str] = []
    fields: list[StatedFields] = []
    for k, name in enumerate(names):
        own = StatedFields(model, "joint", k, places.joint(name))
        draft = JointDraft(own)
        limits = own.pair("jnt_range") if own.get("jnt_limited") else None
        every = [
            actuator_of(model, a, places.actuator(model, a), limits)
            for a in range(model.nactuator)
            if model.actuator_trnid[a, 0] == k
        ]
        drive = drive_of(draft, every)
        rotors = [a.gear**2 * a.fields.get("actuator_armature") for a in every]
        armature = own.get("dof_armature") + sum(rotors)
        spring(draft, float(model.qpos_spring[model.jnt_qposadr[k]]))
        own.take("jnt_limited", "jnt_range", "jnt_actgravcomp", "dof_armature")
        for one in every:
            one.fields.take("actuator_armature")
        found[name] = JointFacts(
            name=name,
            unit="m" if model.jnt_type[k] == _SLIDE else "rad",
            limits=limits,
            inertia=float(inertias[model.jnt_dofadr[k]]) - armature,
            armature=armature,
            drive=drive,
            effects=tuple(draft.effects.values()),
        )
        remarks += draft.remarks
        fields += [own, *(one.fields for one in every)]
    return found, [*remarks, *remarks_on_rest(fields)]

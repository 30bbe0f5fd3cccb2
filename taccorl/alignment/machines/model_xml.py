"""An MJCF or URDF file as a tree of elements with their lines, read and checked before MuJoCo reads it.

MuJoCo expands what a file asks for before it says anything: nested ``<replicate>`` of a few hundred bytes fill the memory. Its
lines are those of the text it was given. So sizes, nesting, names and inertias are checked here, with the lines of the user's
file.
"""

import math
import re
import stat
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

import mujoco
import numpy as np

from taccorl.errors import TaccorlError, no_such_path, plain_name

MOST_BYTES = 1 << 24  # Largest model file that is read
MOST_DEEP = 200  # Most elements within one another
MOST_ELEMENTS = 20_000
"""Most elements of a file. MuJoCo takes minutes for ten times as many."""
MOST_MADE = 5000
"""Most elements that ``<replicate>`` and attributes ``count`` make. MuJoCo 4.0 takes a
time that grows with their square: 7 s for 15 000."""
MOST_JOINTS = 1000  # Most joints of a robot
MOST_VALUES = 4_000_000
"""Most values of an array whose size attributes state, and of all arrays of ``<size>``."""
MOST_FILES = 20  # Most files that a model includes
_SIZES = {
    "hfield": ("nrow", "ncol"),
    "texture": ("width", "height"),
    "numeric": ("size",),
    "mesh": ("params",),
}
"""XML tag → attributes that state the size of its array. Their product is the number of values that MuJoCo allocates."""
_NAMED = {"joint": "joint", "freejoint": "joint", "body": "body", "link": "body"}


@dataclass(eq=False)
class Element:
    """One element of the file."""

    tag: str
    attributes: dict[str, str]
    path: Path  # File in which it is
    line: int  # Line of that file, from 1
    parent: "Element | None"
    children: "list[Element]" = field(default_factory=list)

    def iterate(self) -> Iterator["Element"]:
        """This element and all in it, in the order of the file."""
        waiting: list[Element] = [self]
        while waiting:
            one = waiting.pop()
            yield one
            waiting += reversed(one.children)

    def all(self, *tags: str) -> "list[Element]":
        """Elements in it with one of these tags."""
        return [one for one in self.iterate() if one.tag in tags]

    def child(self, tag: str) -> "Element | None":
        """Its first child with this tag."""
        return next((one for one in self.children if one.tag == tag), None)

    def get(self, key: str, default: str = "") -> str:
        """Attribute ``key``, or ``default``."""
        return self.attributes.get(key, default)

    @property
    def is_there(self) -> bool:
        """Whether a joint or body is part of the tree; others only refer to one."""
        around = ("robot", "body", "worldbody", "frame", "replicate")
        return self.parent is not None and self.parent.tag in around

    @property
    def place(self) -> str:
        """File and line."""
        return f"{self.path}:{self.line}"

    @property
    def near(self) -> str:
        """Name of the file, and line."""
        return f"{self.path.name}:{self.line}"


def read_model(path: Path) -> Element:
    """Read and check a model file, with all files that it includes. Returns its root. Raises TaccorlError: it
    cannot be read, is not XML, is too large or nested too deeply, or two joints or links have one name; the message names file
    and line."""
    root = _parsed(path)
    if root.tag != "robot":
        _include(root)
    _refuse_large(root)
    _refuse_names(root)
    return root


def _parsed(path: Path) -> Element:
    try:
        found = path.stat()
        if not stat.S_ISREG(found.st_mode):
            raise TaccorlError(f"{path}: is no regular file; give an MJCF or URDF file")
        if found.st_size > MOST_BYTES:
            raise TaccorlError(
                f"{path}: is larger than {MOST_BYTES:,} bytes; is it a model file?"
            )
        content = path.read_bytes()
    except FileNotFoundError as error:
        raise TaccorlError(no_such_path(path)) from error
    except OSError as error:
        raise TaccorlError(
            f"{path}: cannot be read: {error.strerror or error}"
        ) from error
    parser = expat.ParserCreate()
    top: list[Element] = []
    inside: list[Element] = []
    elements = 0

    def begin(tag: str, attributes: dict[str, str]) -> None:
        parent = inside[-1] if inside else None
        one = Element(tag, attributes, path, parser.CurrentLineNumber, parent)
        if len(inside) >= MOST_DEEP:
            raise TaccorlError(
                f"{one.place}: <{tag}> is nested deeper than {MOST_DEEP} elements; is it a model file?"
            )
        nonlocal elements
        elements += 1
        if elements > MOST_ELEMENTS:
            raise TaccorlError(
                f"{one.place}: <{tag}> is one of more than {MOST_ELEMENTS:,} elements; is it the model of one robot?"
            )
        (parent.children if parent is not None else top).append(one)
        inside.append(one)

    parser.StartElementHandler = begin
    parser.EndElementHandler = lambda tag: inside.pop()
    try:
        parser.Parse(content, True)
    except expat.ExpatError as error:
        raise TaccorlError(
            f"{path}:{error.lineno}: is not XML: {error}; give an MJCF or URDF file"
        ) from error
    except (ValueError, LookupError) as error:  # of Python's codec for its encoding
        raise TaccorlError(
            f"{path}:1: the encoding that it states is not read: {error}; save it as UTF-8, and state that or none"
        ) from error
    try:
        content.decode("utf-8")  # as which MuJoCo takes it, whatever it states
    except UnicodeDecodeError as error:
        raise TaccorlError(
            f"{path}: is not a text in UTF-8: {error}; save it as UTF-8"
        ) from error
    return top[0]


def _include(root: Element) -> None:
    """Below each ``include`` and ``model`` element of an MJCF file (MuJoCo's XML), add the content of the file that it names."""
    files = 0
    waiting = root.all("include", "model")
    while waiting:
        one = waiting.pop()
        if not one.get("file"):
            continue
        files += 1
        if files > MOST_FILES:
            raise TaccorlError(
                f"{one.place}: includes more than {MOST_FILES} files; does one include itself?"
            )
        try:
            # MuJoCo looks beside the first file.
            included = _parsed(root.path.parent / one.get("file"))
        except TaccorlError as error:
            raise TaccorlError(f"{one.place}: <{one.tag}>: {error}") from error
        one.children.append(included)
        included.parent = one
        waiting += included.all("include", "model")


def _refuse_large(root: Element) -> None:
    """Refuse what MuJoCo would expand without end, by the numbers that the file states."""
    made = joints = 0
    waiting = [(root, 1)]
    while waiting:
        one, times = waiting.pop()
        counted = times * _product(one, "count")
        times = counted if one.tag == "replicate" else times
        made += counted if counted > 1 else 0
        joints += counted if one.tag in ("joint", "freejoint", "composite") else 0
        values = _product(one, *_SIZES.get(one.tag, ())) * times
        if one.tag == "size":  # of each element, or of each joint in a key
            values = MOST_JOINTS * max(_product(one, k) for k in ("", *one.attributes))
        if made > MOST_MADE or joints > MOST_JOINTS or values > MOST_VALUES:
            raise TaccorlError(
                f"{one.place}: <{one.tag}> makes more than {MOST_MADE:,} elements by "
                f"counts, {MOST_JOINTS:,} joints of this file or {MOST_VALUES:,} values; "
                "is it one robot? Give the model that it makes, or smaller numbers"
            )
        waiting += [(child, times) for child in one.children]


def _product(one: Element, *keys: str) -> int:
    """Product of the whole numbers of attributes; others are left to MuJoCo."""
    words = [word for key in keys for word in one.get(key).split() if key != "memory"]
    whole = [int(w[:19]) for w in words if re.fullmatch(r"\+?\d+", w)]
    return math.prod(max(number, 1) for number in whole)


def ends_of(joint: Element) -> tuple[str, str]:
    """Parent and child link of a URDF's joint, or body around and body of an MJCF's; empty where there is none."""
    if joint.child("child") is not None or joint.child("parent") is not None:
        ends = (joint.child("parent"), joint.child("child"))
        return tuple(one.get("link") if one is not None else "" for one in ends)  # pyright: ignore[reportReturnType]
    around = []
    one = joint.parent
    while one is not None and len(around) < 2:
        around += [
            "world" if one.tag == "worldbody" else one.get("name") or "(no name)"
        ] * (one.tag in ("body", "worldbody"))
        one = one.parent
    return (
        (around[1] if len(around) > 1 else "world", around[0]) if around else ("", "")
    )


def joints_of(root: Element) -> dict[str, Element]:
    """Name → element of the joints, without those of ``<default>``, ``<equality>`` and other sections that only refer to one."""
    found = {}
    for one in root.all("joint"):
        if one.get("name") and one.is_there:
            found.setdefault(one.get("name"), one)
    return found


class Places:
    """Texts that name a joint or actuator with the line of the file in which it is."""

    def __init__(self, root: Element) -> None:
        self._joints = joints_of(root)
        self._named: dict[str, list[Element]] = {}
        for section in root.all("actuator"):
            for element in section.children:
                self._named.setdefault(element.get("name"), []).append(element)

    def joint(self, name: str) -> str:
        """Text for a joint."""
        element = self._joints.get(name)
        return f"joint {name}" + (f" ({element.near})" if element else "")

    def actuator(self, model: mujoco.MjModel, a: int) -> str:
        """Text for an actuator of a joint in the compiled model. Actuators without a name
        are found by their order at the joint."""
        name, joint = model.actuator(a).name, model.actuator_trnid[a, 0]
        same, before = self._named.get(name, []), 0
        if not name:
            on = model.joint(joint).name
            same = [e for e in same if e.get("joint", e.get("jointinparent")) == on]
            beside = np.flatnonzero(model.actuator_trnid[:a, 0] == joint)
            before = sum(not model.actuator(b).name for b in beside)
        line = f" ({same[before].near})" if before < len(same) else ""
        return f"actuator {name or a}{line}"


def _refuse_names(root: Element) -> None:
    seen: dict[tuple[str, str], Element] = {}
    for one in root.iterate():
        name = one.get("name")
        if not name:
            continue
        plain_name(name, f"{one.place}: <{one.tag}>")
        kind = _NAMED.get(one.tag)
        if kind is None or not one.is_there:
            continue
        first = seen.setdefault((kind, name), one)
        if first is one:
            continue
        if kind == "joint":
            ends = [" → ".join(ends_of(each)) for each in (first, one)]
            between = f"between {ends[0]} (line {first.line}) and between {ends[1]}"
        else:
            between = f"in line {first.line} and here"
        raise TaccorlError(
            f"{one.place}: two <{one.tag}> have the name {name!r}, {between}; rename one"
        )


def unbalanced(root: Element) -> str:
    """Text on the first link whose inertia no body can have: place, link, principal moments, and what to write; empty: none."""
    for inertia in root.all("inertia"):
        try:
            full = [
                [float(inertia.get(f"i{min(a, b)}{max(a, b)}", "0")) for a in "xyz"]
                for b in "xyz"
            ]
            moments = np.linalg.eigvalsh(np.array(full))
        except (ValueError, np.linalg.LinAlgError):
            continue
        if moments[0] > 0.0 and moments[0] + moments[1] >= moments[2]:
            continue
        link = inertia.parent.parent if inertia.parent is not None else None
        name = link.get("name") if link is not None else ""
        numbers = ", ".join(f"{x:.4g}" for x in moments)
        return (
            f"{inertia.place}: link {name}: no body has the principal inertias {numbers} kg·m²: each must be above 0, and the "
            f"largest at most the sum of the others, {moments[0] + moments[1]:.4g}. Correct the number, or write "
            '<mujoco><compiler balanceinertia="true"/></mujoco> inside <robot>: MuJoCo then '
            "takes their mean for all three"
        )
    return ""

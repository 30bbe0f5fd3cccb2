"""Numbers that a model file states about a joint or an actuator: fields of the compiled
model that differ from MuJoCo's defaults.

What a robot file can express is taken from them, field by field. What is left gives a remark
with the line of the file, so that an attribute that nobody thought of is named as well.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import cache

import mujoco
import numpy as np
from mujoco.introspect.ast_nodes import StructFieldDecl
from mujoco.introspect.structs import STRUCTS

_ROWS = {
    "njnt": lambda model, k: [k],
    "nv": lambda model, k: [model.jnt_dofadr[k]],
    "nactuator": lambda model, k: [k],
    "nu": lambda model, k: _block(model.actuator_ctrladr, model.actuator_ctrlnum, k),
    "nout": lambda model, k: _block(model.actuator_outadr, model.actuator_outnum, k),
}
"""Size of a field's first dimension → its rows that belong to joint or actuator k."""
_OTHERS = (
    *("jnt_type", "jnt_pos", "jnt_axis", "actuator_trntype", "actuator_cranklength"),
    "dof_invweight0",
    "dof_M0",
    "dof_length",
    "actuator_acc0",
    "actuator_length0",
    "actuator_lengthrange",
    "actuator_history",
    "actuator_actearly",
)
"""Fields of the tree, which the twin keeps, and of the transmission; fields that the
compiler computes from others, or of the order of a physics step."""
_PARAMETERS = ("actuator_gainprm", "actuator_dynprm", "actuator_biasprm")
"""Fields whose meaning depends on the actuator's type, so that a default of 1 says nothing:
numbers other than 0 are stated."""
_RANGES = {
    "jnt_limited": ("jnt_range", "jnt_margin", "jnt_solref", "jnt_solimp"),
    "jnt_actfrclimited": ("jnt_actfrcrange",),
    "actuator_ctrllimited": ("actuator_ctrlrange",),
    "actuator_forcelimited": ("actuator_forcerange",),
    "actuator_actlimited": ("actuator_actrange",),
    "dof_frictionloss": ("dof_solref", "dof_solimp"),
}
"""Field that switches others on → these; they mean nothing while it is 0."""
_TYPES = {
    "actuator_dyntype": mujoco.mjtDyn,
    "actuator_gaintype": mujoco.mjtGain,
    "actuator_biastype": mujoco.mjtBias,
}


class StatedFields:
    """Numbers of one joint or actuator of a compiled model that differ from MuJoCo's
    defaults. ``kind``: joint or actuator; ``k``: its id in ``model``; ``place``: its name
    and line, for remarks. ``longest_delay_s``: as long as an actuator's delay can be, with
    the samples that it keeps; 0 of a joint."""

    def __init__(self, model: mujoco.MjModel, kind: str, k: int, place: str) -> None:
        self.place = place
        num_samples = model.actuator_history[k, 0] if kind == "actuator" else 0
        self.longest_delay_s = float(num_samples * model.opt.timestep)
        self._numbers = dict(_numbers(model, kind, k))
        default = _defaults(kind)
        self._left = {
            name: value
            for name, value in self._numbers.items()
            if value != _default(default, name)
        }
        for switch, fields in _RANGES.items():
            if not any(self.get(name) for name in self._matching([switch])):
                self.take(*fields)
        self._reasons: list[str] = []

    def get(self, name: str) -> float:
        """Number ``field[i]``, or ``field`` of a field with one number, also if it equals the
        default; 0 if there is none."""
        return self._numbers.get(name, 0.0)

    def pair(self, name: str) -> tuple[float, float]:
        """Lower and upper end of a range."""
        return self.get(f"{name}[0]"), self.get(f"{name}[1]")

    def take(self, *names: str) -> None:
        """Note that the robot file expresses these fields, or single numbers ``field[i]``."""
        for name in self._matching(names):
            self._left.pop(name, None)

    def explain(self, reason: str) -> None:
        """Add a reason why fields are left."""
        self._reasons.append(reason)

    def left(self) -> tuple[str, str]:
        """Fields that are left, with their values, and the reasons; empty: none is left."""
        stated = ", ".join(
            f"{name} {_value(name, x)}" for name, x in self._left.items()
        )
        return stated, "; ".join(self._reasons)

    def _matching(self, names: Collection[str]) -> list[str]:
        return [n for n in self._numbers if n in names or n.partition("[")[0] in names]


def remarks_on_rest(every: Sequence[StatedFields]) -> list[str]:
    """One remark for all of ``every`` of which the same is left, with their places."""
    places: dict[tuple[str, str], list[str]] = {}
    for one in every:
        if one.left()[0]:
            places.setdefault(one.left(), []).append(one.place)
    return [
        f"{', '.join(where)}: {stated}: MuJoCo simulates this, and the robot file does not "
        "state it" + (f": {reason}" if reason else "")
        for (stated, reason), where in places.items()
    ]


def _numbers(model: mujoco.MjModel, kind: str, k: int) -> Iterator[tuple[str, float]]:
    for name, size in _fields(kind):
        rows = _ROWS[size](model, k)
        values = np.ravel(getattr(model, name)[rows]).astype(float)
        if name == "actuator_gear":
            values = values[:1]  # of a hinge or slide the others have no meaning
        for i, value in enumerate(values):
            yield (name if len(values) == 1 else f"{name}[{i}]"), float(value)


@cache
def _fields(kind: str) -> tuple[tuple[str, str], ...]:
    """Fields of joints or actuators that matter, each with the name of its first size."""
    prefixes = ("actuator_",) if kind == "actuator" else ("jnt_", "dof_")
    labels = ("id", "adr", "num", "group", "user")  # ends of the names of addresses
    arrays = [
        (field.name, str(field.array_extent[0]))
        for field in STRUCTS["mjModel"].fields
        if isinstance(field, StructFieldDecl) and field.array_extent
    ]
    return tuple(
        (name, size)
        for name, size in arrays
        if name.startswith(prefixes)
        and not name.endswith(labels)
        and name not in _OTHERS
    )


def _default(default: Mapping[str, float], name: str) -> float:
    return 0.0 if name.startswith(_PARAMETERS) else default.get(name, 0.0)


def _block(first: np.ndarray, count: np.ndarray, k: int) -> list[int]:
    return list(range(first[k], first[k] + count[k]))


def _value(name: str, value: float) -> str:
    return _TYPES[name](int(value)).name if name in _TYPES else f"{value:g}"


@cache
def _defaults(kind: str) -> dict[str, float]:
    empty = """<mujoco><worldbody><body><joint name="j"/><geom size="1"/></body></worldbody>
    <actuator><general joint="j"/></actuator></mujoco>"""
    return dict(_numbers(mujoco.MjModel.from_xml_string(empty), kind, 0))

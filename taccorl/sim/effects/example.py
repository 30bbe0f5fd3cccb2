"""The text of an example: a file with one effect and its test, to be changed into an effect of one's own."""

from typing import Literal

_HEAD = '''"""{title}: EXAMPLE, replace the law and every sentence by your own.

Run its test:      python -m pytest {module}.py
Register it, in the pyproject.toml of the package that holds this module:

    [project.entry-points."taccorl.plugins"]
    {name} = "{module}"
"""

'''
_SENTENCES = """    in_words: ClassVar = "{in_words}"
    at_a_policy: ClassVar = "{at_a_policy}"
    to_record: ClassVar = "{to_record}"
    near_twins: ClassVar = {{}}
"""
_TEST = """

def test_{name}_is_absent_at_its_absent_value_and_fades_out_towards_it():
    check_effect({cls})


def test_{name}_does_what_its_equation_says():
{arithmetic}
"""
_JOINT = '''from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import mujoco

from taccorl.alignment.checks.effects import check_effect
from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import JointEffect, parameter

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig


@effects.register("{name}")
@dataclass(kw_only=True)
class {cls}(JointEffect):
    """τ = −k q: a spring that pulls the joint back to its zero."""

    name: ClassVar = "{name}"
    needs: ClassVar = ("position",)
    equation: ClassVar = "τ = −k q"
{sentences}    stiffness_nm_per_rad: float = parameter(
        unit="N·m/rad",
        symbol="k",
        absent=0.0,  # at this value the effect is not there
        low=0.0,
        high=50.0,
        typical=1.0,
        over="kp",
        source="a choice",
    )

    def drive(self) -> dict[str, float]:
        """Its numbers in the model of one joint (``Drive`` of joint_kernel.py): compare and diagnose use them on any
        joint of any robot, and on an axis."""
        return {{"spring_stiffness": self.stiffness_nm_per_rad, "spring_rest": 0.0}}

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        """The same in MuJoCo, for the simulation of the whole robot."""
        for joint in self.chosen(spec):
            joint.stiffness[0], joint.springref = self.stiffness_nm_per_rad, 0.0
'''
_CELLS = '''from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from taccorl.alignment.checks.effects import check_effect
from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import Memory, TouchEffect, parameter


@effects.register("{name}")
@dataclass(kw_only=True)
class {cls}(TouchEffect):
    """r = f + c f²: a cell that becomes more sensitive under load."""

    name: ClassVar = "{name}"
    layer: ClassVar = "material"
    windows: ClassVar = True
    equation: ClassVar = "r = f + c f²"
{sentences}    curvature: float = parameter(
        unit="1",
        symbol="c",
        absent=0.0,  # at this value the effect is not there
        low=0.0,
        high=0.5,
        typical=0.05,
        source="a choice",
    )

    def reading(self, reading: np.ndarray, memory: Memory, time_s: np.ndarray, dt_s: np.ndarray) -> np.ndarray:
        """What the chosen pads or cells read where ideal ones would read ``reading`` (N, P, R, C)."""
        own = reading[:, self.slots]
        reading = reading.copy()
        reading[:, self.slots] = own + reading.dtype.type(self.curvature) * own * own
        return reading
'''
_SPRING = """    effect = {cls}(stiffness_nm_per_rad=2.0)
    assert effect.drive() == {{"spring_stiffness": 2.0, "spring_rest": 0.0}}"""
_CURVE = """    effect = {cls}(curvature=0.1)
    two = np.full((1, len(effect.pads), 3, 4), 2.0, np.float32)
    told = effect.reading(two, {{}}, np.zeros(1), np.zeros(1))
    np.testing.assert_allclose(told, 2.4, rtol=1e-6)  # 2 + 0.1 · 2²"""
_SAID = {
    "joint": {
        "in_words": "A spring on the joint pulls it back to its zero.",
        "at_a_policy": "Targets away from the zero are not quite reached.",
        "to_record": "A slow triangle over the whole range of the joint.",
    },
    "cells": {
        "in_words": "The harder a cell is pressed, the more its reading grows with the load.",
        "at_a_policy": "Firm touches read too much.",
        "to_record": "Slow presses to three loads, a light one included.",
    },
}


def example(name: str, module: str, kind: Literal["joint", "cells"]) -> str:
    """Return the Python source of a module ``module`` with the effect ``name`` and two tests of it, of a joint or of cells."""
    cls = "".join(word.capitalize() for word in name.split("_"))
    title = name.replace("_", " ").capitalize()
    law, arithmetic = {"joint": (_JOINT, _SPRING), "cells": (_CELLS, _CURVE)}[kind]
    sentences = _SENTENCES.format(**_SAID[kind])
    text = _HEAD.format(title=title, name=name, module=module) + law.format(name=name, cls=cls, sentences=sentences)
    return text + _TEST.format(name=name, cls=cls, arithmetic=arithmetic.format(cls=cls))

"""The text of an example: a file with one effect and its test, to be changed into an effect of one's own."""

from typing import Literal

_HEAD = '''"""{title}: EXAMPLE, replace the law and every sentence by your own.

Run its test:      python -m pytest {module}.py
Register it, in the pyproject.toml of the package that holds this module:

    [project.entry-points."taccorl.plugins"]
    {name} = "{module}"
"""

'''
_TEST = """

def test_{name}_is_absent_at_its_absent_value_and_fades_out_towards_it():
    check_effect({cls})


def test_{name}_does_what_its_equation_says():
"""
_JOINT = '''from typing import TYPE_CHECKING, ClassVar

import mujoco

from taccorl.alignment.checks.effects import check_effect
from taccorl.sim.effects.effect import JointEffect, effect, number

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig


@effect("{name}", slot="robot", needs="position")
class {cls}(JointEffect):
    """τ = −k q: a spring that pulls the joint back to its zero."""

    equation: ClassVar = "τ = −k q"
    in_words: ClassVar = "A spring on the joint pulls it back to its zero."
    at_a_policy: ClassVar = "Targets away from the zero are not quite reached."
    to_record: ClassVar = "A slow triangle over the whole range of the joint."
    # symbol, unit, the value at which the effect is not there, a typical one, bounds, where they come from
    stiffness_nm_per_rad: float = number("k", "N·m/rad", 0, 1, (0, 50), "a choice", over_kp=True)

    def drive(self) -> dict[str, float]:
        """Its numbers in the model of one joint, as those of an effect that the model has (``Drive`` of joint_kernel.py):
        compare and diagnose use them on any joint of any robot, and on an axis."""
        return {{"cable_spring__stiffness_nm_per_rad": self.stiffness_nm_per_rad, "cable_spring__rest_rad": 0.0}}

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        """The same in MuJoCo, for the simulation of the whole robot."""
        for joint in self.chosen(spec):
            joint.stiffness[0], joint.springref = self.stiffness_nm_per_rad, 0.0
'''
_SPRING = """    effect = {cls}(stiffness_nm_per_rad=2.0)
    assert effect.drive() == {{"cable_spring__stiffness_nm_per_rad": 2.0, "cable_spring__rest_rad": 0.0}}
"""
_CELLS = '''from typing import ClassVar

import numpy as np

from taccorl.alignment.checks.effects import check_effect
from taccorl.sim.effects.effect import Memory, TouchEffect, effect, number


@effect("{name}", slot="material")
class {cls}(TouchEffect):
    """r = f + c f²: a cell that becomes more sensitive under load."""

    equation: ClassVar = "r = f + c f²"
    in_words: ClassVar = "The harder a cell is pressed, the more its reading grows with the load."
    at_a_policy: ClassVar = "Firm touches read too much."
    to_record: ClassVar = "Slow presses to three loads, a light one included."
    windows: ClassVar = True
    # symbol, unit, the value at which the effect is not there, a typical one, bounds, where they come from
    curvature: float = number("c", "1", 0, 0.05, (0, 0.5), "a choice")

    def reading(self, reading: np.ndarray, memory: Memory, time_s: np.ndarray, dt_s: np.ndarray) -> np.ndarray:
        """What the chosen pads or cells read where ideal ones would read ``reading`` (N, P, R, C)."""
        own = reading[:, self.slots]
        reading = reading.copy()
        reading[:, self.slots] = own + reading.dtype.type(self.curvature) * own * own
        return reading
'''
_CURVE = """    effect = {cls}(curvature=0.1)
    two = np.full((1, len(effect.pads), 3, 4), 2.0, np.float32)
    told = effect.reading(two, {{}}, np.zeros(1), np.zeros(1))
    np.testing.assert_allclose(told, 2.4, rtol=1e-6)  # 2 + 0.1 · 2²
"""


def example(name: str, module: str, kind: Literal["joint", "cells"]) -> str:
    """Return the Python source of a module ``module`` with the effect ``name`` and two tests of it, of a joint or of cells."""
    law, arithmetic = {"joint": (_JOINT, _SPRING), "cells": (_CELLS, _CURVE)}[kind]
    cls, title = (
        "".join(word.capitalize() for word in name.split("_")),
        name.replace("_", " ").capitalize(),
    )
    return (_HEAD + law + _TEST + arithmetic).format(
        name=name, module=module, cls=cls, title=title
    )

"""Test whether one tilt of the robot's base explains the errors of several joints.

A tilt is two numbers, the direction of gravity in the base, and changes the load of every hinge that is not parallel to gravity.
So both numbers are fitted to all these joints at once, and the tilt is proposed only if the error is small at each of them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from taccorl.alignment.controller.rigid_joint import rigid_terms
from taccorl.alignment.machines.robot_file import Robot
from taccorl.alignment.machines.robot_joint import under_gravity
from taccorl.diagnosis.problems.joint_problem import JointProblem
from taccorl.diagnosis.problems.joints import Leaned
from taccorl.diagnosis.problems.one_mass import (
    OneMassProblem,
    error_of,
    fitted_numbers,
    holds_at,
    is_explained,
)
from taccorl.diagnosis.problems.tilted_base import MOST_RAD
from taccorl.diagnosis.search.fit import FINE, Fit, fit, over_own_scale
from taccorl.diagnosis.search.problem import Recording, candidate, split_rows
from taccorl.diagnosis.search.result import Diagnosis
from taccorl.sim.effects.effect import Effect, number
from taccorl.sim.effects.scaled import bounded

_STEPS = 40
_UNBALANCE = bounded("unbalance", (("torque_nm", 0.0, np.inf),))


@dataclass(kw_only=True)
class Leaning(Effect):
    """Gravity whose direction is ĝ + a e₁ + b e₂ where the robot file has ĝ, with unit vectors e₁ and e₂ across it."""

    name: ClassVar = "leaning"
    a: float = number("a", "1", 0, 0.01, (-MOST_RAD, MOST_RAD))
    b: float = number("b", "1", 0, 0.01, (-MOST_RAD, MOST_RAD))


class OneTiltProblem(OneMassProblem):
    """Search problem of several joints under one gravity that leans. Names are those of ``OneMassProblem``; the numbers of the
    tilt are ``leaning.a`` and ``leaning.b``. Other joints of a recording count as held where they were at its beginning."""

    def __init__(
        self,
        robot: Robot,
        problems: Mapping[str, JointProblem],
        names: Mapping[str, Sequence[str]],
    ) -> None:
        super().__init__(problems, names, candidate(Leaning, {}))
        self._robot = robot
        now = robot.rigid.model.opt.gravity + robot.more_gravity
        self.down, self._g_mps2 = now / np.linalg.norm(now), float(np.linalg.norm(now))
        nearest = np.eye(3)[np.argsort(np.abs(self.down), kind="stable")[:2]]
        across = np.linalg.qr(np.column_stack([self.down, *nearest]))[0][:, 1:].T
        self.across = np.array(
            [e * np.sign(e @ n) for e, n in zip(across, nearest, strict=True)]
        )
        """(2, 3) e₁ and e₂: the axes of the model, where gravity is along one of them."""
        self._weights: dict[tuple[str, bytes], np.ndarray] = {}

    def at(
        self, joint: str, own: Recording, effects: Sequence[Effect]
    ) -> Sequence[Effect]:
        (lean,) = effects
        assert isinstance(lean, Leaning)
        key = (joint, own.data.pose.tobytes())
        if key not in self._weights:
            columns = []
            for e in self.across:
                model = under_gravity(self._robot.rigid.model, self._g_mps2 * e)
                terms = rigid_terms(model, joint, own.data.pose)
                columns.append((terms.gravity_sin, terms.gravity_cos))
            self._weights[key] = np.array(columns).T
        sine, cosine = self._weights[key] @ (lean.a, lean.b)
        size, angle = float(np.hypot(sine, cosine)), float(np.arctan2(-cosine, sine))
        return [_UNBALANCE(**dict[str, Any](torque_nm=size, hangs_at_rad=angle))]


@dataclass(frozen=True)
class OneTilt:
    """One tilt fitted to several joints, beside what was found at each of them alone."""

    model: Fit
    disagree: Mapping[str, tuple[float, float]]
    """Joints that it leaves with a larger error than what was found there alone → validation error alone and with the tilt [noise
    floors]."""
    is_simpler: bool
    """Whether its two numbers are fewer than those of effects in whose place it stands, and constant torques that it explains."""
    direction: np.ndarray
    """(3,) unit vector along gravity in the model's frame."""
    low: np.ndarray
    """(3,) lower ends of the 95 % intervals of its components."""
    high: np.ndarray
    """(3,) upper ends."""
    joints: Mapping[str, Leaned]
    """Joint → its numbers with the tilt."""

    down: np.ndarray
    """(3,) that vector without the tilt."""

    def words(self, stands_for: Mapping[str, Sequence[str]], file: str) -> str:
        """Text on the tilt in place of the effects ``stands_for`` of each joint."""
        leans = np.degrees(np.arccos(np.clip(self.direction @ self.down, -1.0, 1.0)))
        ends = [
            (axis, low, high)
            for axis, low, high in zip("xyz", self.low, self.high, strict=True)
            if high - low > 1e-6
        ]
        what = [
            f"{' and '.join(names)} of {part}" for part, names in stands_for.items()
        ]
        return (
            f"one tilt of the base by {leans:.2g}° explains as much at {' and '.join(self.joints)} as {', '.join(what)}, with "
            f"fewer numbers: write `gravity: [{', '.join(f'{x:.4f}' for x in self.direction + 0.0)}]` (95 %: "
            f"{', '.join(f'{axis} {low:.4f} … {high:.4f}' for axis, low, high in ends)}) into {file} instead "
            "(--until=noise_floor does so), and check it with a level"
        )


def one_tilt(
    robot: Robot,
    problems: Mapping[str, JointProblem],
    alone: Mapping[str, Diagnosis],
    stands_for: Mapping[str, Sequence[str]],
) -> OneTilt:
    """Fit one direction of gravity to all joints in place of the effects that it may stand for.

    Args:
        problems: joint → its problem; all are hinges.
        alone: joint → what was found at it alone.
        stands_for: joint → added effects in whose place a tilt may do as well.
    """
    names = {
        j: [n for n in d.names if n not in stands_for.get(j, ())]
        for j, d in alone.items()
    }
    whole = OneTiltProblem(robot, problems, names)
    split = {
        j: (p.fit, p.validation) if p.validation else split_rows(p.fit)
        for j, p in problems.items()
    }
    fit_to = [r for j, (own, _) in split.items() for r in whole.recordings(j, own)]
    start = {
        f"{j}/{name}": value
        for j, d in alone.items()
        for name, value in fitted_numbers(d).items()
    }
    model = fit(
        whole,
        fit_to,
        ("leaning",),
        start | {"leaning.a": 0.0, "leaning.b": 0.0},
        _STEPS,
    )
    model = over_own_scale(
        whole, fit(whole, fit_to, ("leaning",), model.values, _STEPS, FINE), fit_to
    )[0]
    disagree, before = {}, 0
    for j, d in alone.items():
        (own, with_it), holds = holds_at(whole, model, problems[j], d, j, split[j][1])
        disagree |= {} if holds else {j: (error_of(own), error_of(with_it))}
        before += sum(
            f.name.split(".")[0] in stands_for.get(j, ()) for f in d.after.frees
        )
        before += is_explained(d, model.values.get(f"{j}/torque_ff"))
    ends = np.array([model.intervals()[f"leaning.{name}"] for name in "ab"])
    lean = np.array([model.values["leaning.a"], model.values["leaning.b"]])
    direction = whole.down + lean @ whole.across
    sides = np.sort(
        [whole.across * (ends[:, k] - lean)[:, None] for k in (0, 1)], axis=0
    ).sum(axis=1)
    length = float(np.linalg.norm(direction))
    x, y, z = map(float, direction / length)
    leaned = {}
    for j in problems:
        effects, base, intervals = whole.own(j, model)
        leaned[j] = Leaned(
            gravity=(x, y, z), effects=effects, base=base, intervals=intervals
        )
    low, high = ((direction + side) / length for side in sides)
    return OneTilt(
        model, disagree, before > 2, direction / length, low, high, leaned, whole.down
    )

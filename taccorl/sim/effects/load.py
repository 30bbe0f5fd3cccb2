"""What else turns a joint: inertia, weight, springs, a stop, and torques that come back with the angle."""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, ClassVar

import mujoco
import numpy as np

from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.effects.effect import (
    ArmEffect,
    JointEffect,
    Memory,
    Parameter,
    effect,
    number,
)
from taccorl.sim.effects.friction import add_passive_torque
from taccorl.sim.effects.live_model import LiveModel

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig

STOP_DAMPING_S = 0.005
"""Damping of ``end_stop`` over its stiffness [s]: a choice. The drive's own K_d damps motion against the stop far more."""
FARTHEST_M = 2.0
"""Largest distance of a ``payload`` that a file may state [m]: bounds of its place are those of a search on the PiPER."""
_RADIUS_M = 0.02  # of the payload's ball, for its inertia
_MOST_PERIODS, _MOST_STARTS = (
    60.0,
    32,
)  # where a search for cogging ends; enough for a span of π
FINEST_PER_M = 1e5
"""Largest wave number of ``cogging`` that a file may state: of a slide it is in
rad/m, and a pitch of 0.1 mm has 6e4."""
_QUARTERS = (0.0, math.pi / 2, math.pi, -math.pi / 2)  # sine and cosine of both signs


@effect("armature", slot="load", needs="acceleration")
class Armature(JointEffect):
    """Additional inertia of the motor's rotor: (M + ΔJ) q̈ with ΔJ = J_rotor · (gear ratio)². Its torque grows with the square
    of the motion's frequency."""

    added_kgm2: float = number(
        "ΔJ", "kg·m²", 0, 0.05, (0, 1000),
        "a choice; 0.007–0.020 fitted to a Unitree Go2 (iit-DLSLab/sim2real-robot-identification)", over_kp=True,
    )  # fmt: skip

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for joint in self.chosen(spec):
            joint.armature += self.added_kgm2


@effect("cable_spring", slot="load", needs="position")
class CableSpring(JointEffect):
    """Spring of cables at a joint: τ = −k (q − q₀), relaxed at q₀. At rest the joint deviates from its target by k (q₀ − q) /
    K_p, which grows with the distance from q₀. Implemented as MuJoCo's joint spring."""

    stiffness_nm_per_rad: float = number("k", "N·m/rad", 0, 1, (0, 50), over_kp=True)
    rest_rad: float = number(
        "q₀",
        "rad",
        None,
        0,
        (-3.2, 3.2),
        "a choice: cables are laid with the arm straight",
    )

    @classmethod
    def starts(cls, seen: Mapping[str, float]) -> list[dict[str, float]]:
        """Start values of a search: a weak and a strong spring, each relaxed at either end. Recordings determine k and k q₀."""
        pairs = ((1 / 3, 0.0), (3.0, 0.0), (1.0, -1.0), (1.0, 1.0))
        return [{"stiffness_nm_per_rad": k, "rest_rad": rest} for k, rest in pairs]

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for joint in self.chosen(spec):
            joint.stiffness[0], joint.springref = (
                self.stiffness_nm_per_rad,
                self.rest_rad,
            )


@effect("cogging", slot="load", needs="position")
class Cogging(JointEffect):
    """Cogging torque of the motor's magnets or of gear teeth: τ = +A sin(N q + φ), with N periods per turn of the joint.

    Implemented by the cogging term of a passive MuJoCo DC motor. Efforts do not include the torque."""

    torque_nm: float = number(
        "A", "N·m", 0, 0.3, (0, 5), "a choice: as much as friction", over_kp=True
    )
    periods: float = number(
        "N", "1", None, 24, (6, 200),
        "a choice: fewer are weight or a cable; of the joint's turn, so a gear's ratio times the motor's periods",
    )  # fmt: skip
    phase_rad: float = number("φ", "rad", None, 0, (-math.tau, math.tau))

    @classmethod
    def accepted(cls, p: Parameter) -> tuple[float, float]:
        if p.name != "periods":
            return p.low, p.high
        return min(p.low, 1.0), max(p.high, FINEST_PER_M)

    @classmethod
    def starts(cls, seen: Mapping[str, float]) -> list[dict[str, float]]:
        """Start values of a search: sine and cosine of both signs; numbers of periods in steps of half the resolution of a
        recording over ``span_rad``, from half a period in it on; a twentieth of the torque that the controller commands. Of
        recordings of many turns periods ``wave_periods_1`` …, phases ``wave_phase_1`` … and π/4 to both sides."""
        apart = max(
            0.5 * math.pi / max(seen["span_rad"], 0.05), _MOST_PERIODS / _MOST_STARTS
        )
        periods = np.arange(
            min(max(2 * apart, 6.0), _MOST_PERIODS), _MOST_PERIODS + 1e-9, apart
        )
        waves = [
            (seen[f"wave_periods_{k}"], seen[f"wave_phase_{k}"])
            for k in (1, 2, 3)
            if f"wave_periods_{k}" in seen
        ]
        turns = (0.0, -0.25 * math.pi, 0.25 * math.pi)
        pairs = [
            (n, math.remainder(phase + turn, math.tau))
            for n, phase in waves
            for turn in turns
        ]
        pairs = pairs or [(float(n), phase) for n in periods for phase in _QUARTERS]
        torque_nm = min(max(0.05 * seen["peak_torque_nm"], 1e-3), 5.0)
        return [
            {"torque_nm": torque_nm, "periods": n, "phase_rad": phase}
            for n, phase in pairs
        ]

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for name in self.acts_on():
            add_passive_torque(
                spec,
                name,
                "cogging",
                cogging=[self.torque_nm, self.periods, self.phase_rad],
            )


@effect("end_stop", slot="load", needs=("position", "velocity"))
class EndStop(JointEffect):
    """Mechanical stop at the angle q_e: τ = ∓[k δ + b δ̇]₊ with δ = ±(q − q_e) beyond the stop, b = k · 5 ms. It pushes and
    never pulls.

    A spring-damper contact (Kelvin-Voigt, as in Gilardi and Sharf, "Literature survey of contact dynamics modelling", 2002) on
    one side: the joint is free on the side of q_e on which it is at the reset. q is the motor's angle. Whether the joint touches
    the stop is determined at the end of each physics step, for the next step."""

    rewrites: ClassVar = ("jnt_stiffness", "qpos_spring", "dof_damping")
    kept: ClassVar = ("side", "touches")
    stiffness_nm_per_rad: float = number(
        "k", "N·m/rad", 0, 1e3, (0, 1e5),
        "a choice: a plastic cover; of steel it is as stiff as the arm, above 1e4", over_kp=True,
    )  # fmt: skip
    angle_rad: float = number(
        "q_e",
        "rad",
        None,
        0.55,
        (-4, 4),
        "a choice; a search takes it from the recordings",
    )

    @classmethod
    def starts(cls, seen: Mapping[str, float]) -> list[dict[str, float]]:
        """Start values of a search: stops at and within either recorded end, which yield by 2 or 20 % of the range at most."""
        span = max(seen["span_rad"], 0.02)
        low = seen.get("lowest_rad", -0.5 * span)
        high = seen.get("highest_rad", low + span)
        reach, torque_nm = max(high - low, 1e-3), max(seen["peak_torque_nm"], 0.01)
        return [
            {
                "stiffness_nm_per_rad": cls.clipped(
                    "stiffness_nm_per_rad", max(torque_nm / (gives * reach), 1.0)
                ),
                "angle_rad": cls.clipped("angle_rad", place),
            }
            for inside, gives in ((0.02, 0.02), (0.1, 0.1), (0.3, 0.2))
            for place in (low + inside * reach, high - inside * reach)
        ]

    def memory(self, num_sims: int, pad_shape: tuple[int, int]) -> Memory:
        memory = super().memory(num_sims, pad_shape)
        memory["side"] += 1.0
        return memory

    def feel(
        self, live: LiveModel, memory: Memory, ids: np.ndarray, dt_s: float
    ) -> None:
        angle = live.seen("qpos")[:, live.angles(self.acts_on())][ids]
        if dt_s == 0:
            memory["side"][ids] = np.where(angle <= self.angle_rad, 1.0, -1.0)
        side = memory["side"][ids]
        deep = side * (angle - self.angle_rad)
        rate = side * live.of_joints("qvel", self.acts_on())[ids]
        memory["touches"][ids] = (deep > 0) & (deep + STOP_DAMPING_S * rate > 0)

    def rewrite(self, live: LiveModel, memory: Memory) -> None:
        dofs, angles = live.dofs(self.acts_on()), live.angles(self.acts_on())
        joints = live.model.dof_jntid[dofs]
        stiffness, rest = live.own("jnt_stiffness"), live.own("qpos_spring")
        own, added = stiffness[:, joints], self.stiffness_nm_per_rad * memory["touches"]
        both = own + added
        # Two springs are one that rests in between: cable_spring may be there, too.
        middle = np.divide(
            own * rest[:, angles] + added * self.angle_rad,
            both,
            out=rest[:, angles],
            where=added > 0,
        )
        stiffness[:, joints], rest[:, angles] = both, middle
        live.own("dof_damping")[:, dofs] += STOP_DAMPING_S * added


@effect("payload", slot="body", needs="bodies")
class Payload(ArmEffect):
    """Unknown payload: a ball of mass m fixed to the last body at c, along that body's axes. It adds the torque m g × lever arm
    to every joint, and its inertia. It has no contacts. In a robot file, m < 0: what the robot lacks of the model."""

    mass_kg: float = number(
        "m",
        "kg",
        0,
        0.2,
        (0, 1.5),
        "a choice; rated: 1.5 kg (PiPER manual)",
        over_kp=True,
    )
    x_m: float = number(
        "c_x", "m", None, 0, (-0.15, 0.15), "a choice: middle of the hand"
    )
    y_m: float = number(
        "c_y", "m", None, 0, (-0.15, 0.15), "a choice: middle of the hand"
    )
    z_m: float = number(
        "c_z",
        "m",
        None,
        0.1,
        (-0.05, 0.25),
        "a choice: between flange and pads (TCP at 0.168)",
    )
    link: str = ""
    """Body of a robot file's model to which it is fixed; empty: the last one that the joint moves, of the PiPER the hand."""
    like_link: bool = False
    """Whether its mass is spread as that of its body: a link of another density. Else it is a point."""

    @classmethod
    def accepted(cls, p: Parameter) -> tuple[float, float]:
        return (-FARTHEST_M, FARTHEST_M) if p.unit == "m" else (-p.high, p.high)

    @classmethod
    def starts(cls, seen: Mapping[str, float]) -> list[dict[str, float]]:
        """Start values of a search: the mass at its typical place, or a quarter of the range beside it along one axis."""
        masses, places = (
            super().starts(seen),
            [p for p in cls.parameters() if p.unit == "m"],
        )
        sides = [(p, side) for p in places for side in (-0.25, 0.25)]
        return masses + [
            masses[-1] | {p.name: p.typical + side * (p.high - p.low)}
            for p, side in sides
        ]

    @property
    def reads_as(self) -> str:
        so = (
            "heavier throughout"
            if self.mass_kg > 0.0
            else "lighter" + " throughout" * self.like_link
        )
        text = f"{self.link or 'the last link that it moves'} is {so} than its model"
        return text * (self.mass_kg < 0.0 or self.like_link)

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        below = f"mass_kg is {self.mass_kg:g} kg, below 0" * (self.mass_kg < 0.0)
        stated = [
            below,
            f"link is {self.link!r}" * bool(self.link),
            "like_link is true" * self.like_link,
        ]
        if what := " and ".join(filter(None, stated)):
            raise TaccorlError(
                f"effect payload: {what}, which only robot files can state; remove it"
            )
        for arm in self.arms():
            ball = spec.body(f"{arm}_{ROBOT.hand}").add_body(name=f"{arm}_payload")
            ball.mass, ball.explicitinertial = self.mass_kg, True
            ball.ipos = [self.x_m, self.y_m, self.z_m]
            ball.inertia = [0.4 * self.mass_kg * _RADIUS_M**2] * 3


@effect("unbalance", slot="load", needs="position")
class Unbalance(JointEffect):
    """Gravity torque that the model lacks: τ = −A sin(q − q₀), of a part whose centre of mass lies beside its axis, or of a base
    that is mounted tilted. A = m g l cos β with the mass m that the joint moves, the distance l of its centre of mass from the
    axis and the inclination β of the axis from the horizontal; a vertical axis has β = 90° and A = 0, and A = m g l sin α if its
    base is tilted by α. At q = q₀ the centre of mass is lowest. Its inertia belongs to the inertia of the axis.

    A candidate for turning axes and for the hinges of robot files; l, and so A and q₀, change with the pose of the joints behind
    it. Implemented by the cogging term of a passive MuJoCo DC motor, with one period a turn. Efforts do not include the torque.
    """

    torque_nm: float = number(
        "A", "N·m", 0, 0.5, (0, 10), "a choice: 0.5 kg at 0.1 m", over_kp=True
    )
    hangs_at_rad: float = number("q₀", "rad", None, 0, (-math.tau, math.tau))

    @classmethod
    def starts(cls, seen: Mapping[str, float]) -> list[dict[str, float]]:
        """Start values of a search: sine and cosine of both signs, with a tenth of the largest commanded torque."""
        torque_nm = min(max(0.1 * seen.get("peak_torque_nm", 0.0), 1e-3), 10.0)
        return [{"torque_nm": torque_nm, "hangs_at_rad": angle} for angle in _QUARTERS]

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for name in self.acts_on():
            add_passive_torque(
                spec,
                name,
                "unbalance",
                cogging=[self.torque_nm, 1.0, math.pi - self.hangs_at_rad],
            )

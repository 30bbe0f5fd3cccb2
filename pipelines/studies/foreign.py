"""Simulated robots of other makes, for tests of ``taccorl diagnose`` with robot files: an arm of seven joints, a leg whose
joints move at the same time, a SCARA of two joints. Recordings are computed independently of the one-joint model: MuJoCo moves
the whole robot with steps of 0.25 ms and ``implicitfast``; every joint has a drive of its own that samples a quantised encoder
at 1 kHz, differentiates it, filters the velocity and holds its torque. Hidden effects are written out here, not taken from
``taccorl.sim.effects``. **Simulated: no recording here is of a real robot.**

Letters in shapes: T rows at 200 Hz, J joints.
"""

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import mujoco
import numpy as np

from taccorl.alignment.machines.robot_file import Robot, load_robot
from taccorl.alignment.measurements.folder import Measurements
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.alignment.measurements.table_files import origin_lines
from taccorl.data.origin import Origin
from taccorl.errors import TaccorlError

ORIGIN = "simulated robot (pipelines.studies.foreign)"
RATE_HZ, LOOP_HZ, STEP_S = 200, 1000, 0.25e-3
"""Row rate of recordings [Hz], rate of the drives' loops [Hz], physics step [s]."""
FILTER_S = 1e-3
"""Time constant of the low-pass filter of each drive's velocity [s]."""
QUANTUM_RAD = 2 * math.pi / 2**17
"""Step of the encoders [rad]."""
NOISE_RAD, NOISE_SHARE = 1e-4, 2e-3
"""Noise of logged angles [rad], and of logged efforts as a share of the largest one."""
DISTURBANCE_SHARE = 1e-3
"""Standard deviation of a coloured disturbance (50 ms) at every joint, as a share of the torque for 0.1 rad."""
KINDS = {
    "coulomb_friction": (0.01, 0.06),
    "viscous_friction": (0.1, 0.5),
    "stribeck_friction": (0.01, 0.04),
    "gear_friction": (0.05, 0.2),
    "armature": (0.15, 0.6),
    "cable_spring": (0.04, 0.2),
    "torque_scale": (0.08, 0.25),
    "torque_saturation": (0.55, 0.85),
    "command_delay": (0.008, 0.04),
    "command_lag": (0.01, 0.06),
    "slew_limit": (0.4, 0.75),
    "velocity_feedforward": (0.2, 0.8),
    "integral_action": (0.3, 1.5),
    "error_deadband": (0.004, 0.015),
    "torque_lag": (0.008, 0.03),
    "cogging": (0.01, 0.04),
    "backlash": (0.008, 0.03),
    "joint_compliance": (0.05, 0.2),
    "encoder_scale": (0.02, 0.06),
}
"""Name of a hidden effect → range of its strength (``Case.strength``)."""


@dataclass(frozen=True)
class Link:
    """One joint and the link that it moves; the next link is at ``end_m``."""

    joint: str
    """Name of the joint, a hinge."""
    axis: tuple[int, int, int]
    """Unit vector of the hinge in the link's frame."""
    end_m: tuple[float, float, float]
    """Origin of the next link in this link's frame [m]."""
    mass_kg: float
    """Mass [kg]."""
    armature: float
    """Rotor inertia at the joint [kg·m²]."""
    middle_rad: float = 0.0
    """Angle about which the joint moves [rad]."""


_ARM7 = tuple(
    Link(f"a{k + 1}", axis, end, mass, armature, middle)
    for k, (axis, end, mass, armature, middle) in enumerate(
        (
            ((0, 0, 1), (0, 0, 0.20), 3.0, 0.25, 0.2),
            ((0, 1, 0), (0, 0, 0.21), 2.7, 0.25, 0.5),
            ((0, 0, 1), (0, 0, 0.20), 2.2, 0.15, -0.3),
            ((0, -1, 0), (0, 0, 0.20), 2.0, 0.15, 1.2),
            ((0, 0, 1), (0, 0, 0.18), 1.4, 0.06, 0.1),
            ((0, 1, 0), (0.05, 0, 0.08), 1.2, 0.05, -0.6),
            ((0, 0, 1), (0.04, 0, 0.10), 0.8, 0.03, 0.0),
        )
    )
)
_LEG3 = (
    Link("hip_roll", (1, 0, 0), (0.0, 0.08, 0.0), 0.9, 0.012, 0.0),
    Link("hip_pitch", (0, 1, 0), (0.0, 0.0, -0.21), 1.1, 0.012, 0.7),
    Link("knee", (0, 1, 0), (0.0, 0.0, -0.21), 0.25, 0.02, -1.4),
)
_SCARA2 = (
    Link("scara_1", (0, 0, 1), (0.30, 0, 0), 4.0, 0.08, 0.4),
    Link("scara_2", (0, 0, 1), (0.25, 0, 0), 2.5, 0.04, -0.6),
)
ROBOTS: Mapping[str, tuple[Link, ...]] = {
    "arm of 7 joints": _ARM7,
    "leg": _LEG3,
    "SCARA": _SCARA2,
}
"""Name of a robot → its links, from the base."""
EXAMPLE = "arm of 6 joints"
"""Robot of the example in docs/your_robot.md."""
_ARM6 = (
    Link("shoulder_pan", (0, 0, 1), (0, 0, 0.12), 2.5, 0.10, 0.3),
    Link("shoulder_lift", (0, 1, 0), (0.30, 0, 0.02), 2.8, 0.10, -0.5),
    Link("elbow", (0, 1, 0), (0.28, 0, 0), 1.8, 0.06, 1.0),
    Link("wrist_1", (0, 1, 0), (0, 0, 0.09), 0.7, 0.02, 0.4),
    Link("wrist_2", (0, 0, 1), (0.08, 0, 0), 0.6, 0.02, -0.3),
    Link("wrist_3", (1, 0, 0), (0.10, 0, 0), 0.6, 0.01, 0.0),
)
MOVE_TOGETHER = ("leg",)
"""Robots whose joints all move in each recording."""
SHORT = "arm of 3 joints"
"""The first three joints of the example."""
CARRIES_WEIGHT = ("arm of 7 joints", EXAMPLE, SHORT)
"""Robots whose controllers compensate gravity."""


def _mjcf(links: Sequence[Link], gear: Mapping[str, str] = {}) -> str:
    """Text of a robot's MJCF file, without passive forces; ``armature`` is the rotor's inertia.

    Args:
        links: links from the base.
        gear: joint → attributes of a second hinge between its motor and its link.
    """
    inner = ""
    for k, link in reversed(list(enumerate(links))):
        at = links[k - 1].end_m if k else (0.0, 0.0, 0.5)
        com = np.array(link.end_m) / 2
        length = float(np.linalg.norm(link.end_m))
        thick = link.mass_kg * (0.04**2) / 2
        long = link.mass_kg * length**2 / 12 + thick / 2
        along = np.argmax(np.abs(link.end_m))
        inertia = [thick if i == along else long for i in range(3)]
        axis, pos = " ".join(map(str, link.axis)), " ".join(f"{x:g}" for x in at)
        inertial = (
            f'<inertial pos="{com[0]:g} {com[1]:g} {com[2]:g}" mass="{link.mass_kg:g}" '
            f'diaginertia="{inertia[0]:.6g} {inertia[1]:.6g} {inertia[2]:.6g}"/>'
        )
        joint = f'<joint name="{link.joint}" axis="{axis}" range="-3 3" armature="{link.armature:g}"/>'
        if link.joint in gear:
            second = (
                f'<joint name="{link.joint}_gear" axis="{axis}" {gear[link.joint]}/>'
            )
            small = '<inertial pos="0 0 0" mass="1e-3" diaginertia="1e-6 1e-6 1e-6"/>'
            inner = f'<body pos="{pos}">{joint}{small}<body>{second}{inertial}{inner}</body></body>'
        else:
            inner = f'<body name="{link.joint}_link" pos="{pos}">{joint}{inertial}{inner}</body>'
    return f'<mujoco><compiler angle="radian"/><worldbody><body name="base">{inner}</body></worldbody></mujoco>'


@dataclass(frozen=True, kw_only=True)
class Case:
    """One simulated robot with hidden effects in one joint."""

    robot: str
    """Name of the robot."""
    joint: str
    """Name of the joint that moves and has the effect."""
    hidden: str
    """Name of the effect; empty: none."""
    strength: float
    """Strength of the hidden effect as a share of a reference value: K_p · 0.35 rad for torques, K_d for dampings, J for
    inertias, K_p for springs and 1 / compliance … (``_numbers``)."""
    seed: int
    """Seed of everything that is drawn."""
    effort: bool
    """True: efforts are logged."""
    beside: tuple[tuple[str, float], ...] = ()
    """Further effects that are hidden in the same joint, with their strengths."""
    changes: tuple[tuple[str, str], ...] = ()
    """(text, new text) in the MJCF of the robot that moves, not in that of its user."""

    @property
    def links(self) -> tuple[Link, ...]:
        """Links of the robot, from the base."""
        return {EXAMPLE: _ARM6, SHORT: _ARM6[:3], **ROBOTS}[self.robot]

    @property
    def name(self) -> str:
        """Text for tables: effect, joint, robot and seed."""
        return f"{self.hidden or 'nothing'} in {self.joint} of the {self.robot}, seed {self.seed}"


def draw(seed: int, hidden: str) -> Case:
    """Draw a case with the effect ``hidden`` (a key of ``KINDS``; empty: none): robot, joint and strength follow from the
    seed."""
    rng = np.random.default_rng([seed, 77])
    robot = list(ROBOTS)[seed % len(ROBOTS)]
    strength = float(np.exp(rng.uniform(*np.log(KINDS.get(hidden, (1.0, 1.0))))))
    joint = ROBOTS[robot][int(rng.integers(len(ROBOTS[robot])))].joint
    return Case(
        robot=robot,
        joint=joint,
        hidden=hidden,
        strength=strength,
        seed=seed,
        effort=bool(rng.integers(2)),
    )


@dataclass
class Plant:
    """The simulated robot of a case, with its hidden effect; its user has only ``robot_file``."""

    case: Case
    kp: np.ndarray = field(init=False)
    """(J,) K_p of the drives [N·m/rad]."""
    kd: np.ndarray = field(init=False)
    """(J,) K_d of the drives [N·m·s/rad]."""

    def __post_init__(self) -> None:
        links, rng = self.case.links, np.random.default_rng([self.case.seed, 78])
        model = mujoco.MjModel.from_xml_string(_mjcf(links))
        data = mujoco.MjData(model)
        data.qpos[:] = [link.middle_rad for link in links]
        mujoco.mj_forward(model, data)
        mass = np.empty((model.nv, model.nv))
        mujoco.mj_fullM(model, data, mass)
        self.inertia = np.diag(mass).copy()
        omega, zeta = (
            rng.uniform(14.0, 26.0, len(links)),
            rng.uniform(0.6, 1.1, len(links)),
        )
        self.kp, self.kd = (
            np.round(self.inertia * omega**2, 4),
            np.round(2 * zeta * self.inertia * omega, 4),
        )
        self.carries = float(self.case.robot in CARRIES_WEIGHT)

    def robot_file(self, folder: Path) -> Path:
        """Write the user's model and robot file into ``folder``: without the hidden effect, with the commanded gains. Returns the
        path of the robot file."""
        (folder / "robot.xml").write_text(_mjcf(self.case.links), encoding="utf-8")
        lines = [
            "kind: robot",
            "model: robot.xml",
            f"gravity_compensation: {self.carries}",
            "joints:",
        ]
        for link, kp, kd in zip(self.case.links, self.kp, self.kd, strict=True):
            known = f"kp: {kp}, kd: {kd}, rotor_inertia: {link.armature}, loop_hz: {LOOP_HZ}.0"
            lines.append(f"  {link.joint}: {{{known}}}")
        path = folder / "robot.yaml"
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
        return path

    def record(
        self, name: str, target: np.ndarray, seed: int, repeat_of: str | None = None
    ) -> Measurement:
        """Simulate a recording of the targets ``target`` (T, J) [rad].

        Args:
            name: name of the measurement.
            seed: seed of noise and disturbances.
            repeat_of: name of the recording that it repeats; None if it is no repeat.
        """
        measured, effort = _simulate(
            self, target, np.random.default_rng([self.case.seed, seed])
        )
        return Measurement(
            name=name,
            time_s=np.arange(len(target)) / RATE_HZ,
            target=target,
            measured=measured,
            effort=effort if self.case.effort else np.full_like(effort, np.nan),
            signals=tuple(link.joint for link in self.case.links),
            units=("rad",) * len(self.case.links),
            repeat_of=repeat_of,
            origin=Origin("surrogate", ORIGIN),
        )


def recordings(plant: Plant) -> Measurements:
    """Simulate all recordings: a chirp (twice) and a triangle for the fit, another chirp and steps for validation."""
    chirp = _targets(plant, _chirp(9.0, 0.1, 2.5, 0.3))
    return Measurements(
        fit=(
            plant.record("chirp", chirp, 1),
            plant.record("chirp_again", chirp, 2, repeat_of="chirp"),
            plant.record("triangle", _targets(plant, _triangle(8.0, 0.5)), 3),
        ),
        validation=(
            plant.record(
                "held_chirp", _targets(plant, _chirp(8.0, 0.15, 2.0, 0.25)), 4
            ),
            plant.record(
                "held_steps",
                _targets(plant, _steps((0.0, 0.2, -0.25, 0.35, 0.3, -0.35, 0.1, 0.0))),
                5,
            ),
        ),
        rule="by name",
    )


def unseen_sweep(plant: Plant) -> Measurement:
    """Simulate a chirp that is neither fitted nor used to choose."""
    return plant.record("test_sweep", _targets(plant, _chirp(8.0, 0.1, 2.2, 0.28)), 6)


def with_robot(case: Case, folder: Path) -> tuple[Robot, Measurements]:
    """Write the user's robot file into ``folder``; returns it with the recordings of the case's robot."""
    plant = Plant(case)
    return load_robot(plant.robot_file(folder)), recordings(plant)


def _targets(plant: Plant, motion: np.ndarray) -> np.ndarray:
    links = plant.case.links
    rows = np.tile([link.middle_rad for link in links], (len(motion), 1))
    for j, link in enumerate(links):
        if link.joint == plant.case.joint:
            rows[:, j] += motion
        elif plant.case.robot in MOVE_TOGETHER:  # slower, and not in step
            time_s = np.arange(len(motion)) / RATE_HZ
            rows[:, j] += (
                0.25
                * np.sin(2 * np.pi * (0.5 + 0.23 * j) * time_s)
                * np.clip(time_s - 0.5, 0.0, 1.0)
            )
    return rows


def _chirp(
    seconds: float, low_hz: float, high_hz: float, amplitude: float
) -> np.ndarray:
    time_s = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    active = np.clip(time_s - 0.5, 0.0, None)
    phase = (
        2 * np.pi * (low_hz * active + (high_hz - low_hz) * active**2 / (2 * seconds))
    )
    return (
        amplitude
        * np.sin(phase)
        * np.clip(active / 0.5, 0.0, 1.0)
        * np.clip((seconds - time_s) / 0.5, 0.0, 1.0)
    )


def _triangle(seconds: float, amplitude: float) -> np.ndarray:
    share = np.clip(
        (np.arange(round(seconds * RATE_HZ)) / RATE_HZ - 0.5) / (seconds - 1.0),
        0.0,
        1.0,
    )
    return amplitude * np.interp(
        2 * share % 1.0, [0.0, 0.25, 0.75, 1.0], [0.0, 1.0, -1.0, 0.0]
    )


def _steps(levels: Sequence[float]) -> np.ndarray:
    most, at, rows = 4.0 / RATE_HZ, 0.0, []
    for level in levels:
        for _ in range(RATE_HZ):
            at += min(max(level - at, -most), most)
            rows.append(at)
    return np.array(rows)


def _numbers(plant: Plant, j: int) -> dict[str, float]:
    """Strengths of the hidden effects in SI units of joint ``j``."""
    every = ((plant.case.hidden, plant.case.strength), *plant.case.beside)
    numbers = [
        _number(name, strength, plant.kp[j], plant.kd[j], plant.inertia[j])
        for name, strength in every
    ]
    return {key: value for own in numbers for key, value in own.items()}


def _number(
    name: str, s: float, kp: float, kd: float, inertia: float
) -> dict[str, float]:
    torque = 0.35 * kp * s
    return {
        "coulomb_friction": {"coulomb": torque},
        "viscous_friction": {"viscous": s * kd},
        "stribeck_friction": {"coulomb": torque, "stick": torque},
        "asymmetric_friction": {"coulomb": torque, "one_way": 0.4},
        "power_law_friction": {"grease": torque, "exponent": 0.4},
        "gear_friction": {"gear_share": s},
        "armature": {"armature": s * inertia},
        "cable_spring": {"spring": s * kp},
        "torque_scale": {"scale": 1.0 - s},
        "torque_saturation": {"torque_share": s},
        "command_delay": {"delay_s": s},
        "command_lag": {"lag_s": s},
        "slew_limit": {"slew": s * 4.0},
        "velocity_feedforward": {"feedforward": s},
        "integral_action": {"integral": s},
        "error_deadband": {"deadband": s},
        "torque_lag": {"torque_lag_s": s},
        "cogging": {"cogging": torque},
        "backlash": {"play": s},
        "joint_compliance": {"compliance": s / kp},
        "encoder_scale": {"encoder_scale": 1.0 + s},
        "gravity_mismatch": {"carried": 1.0 - s},
        "link_mass": {"heavier": 1.0 + s},
        "": {},
    }[name]


def _simulate(
    plant: Plant, target: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """(T, J) logged angles and (T, J) efforts: row k before target k acts. From rest at the first target."""
    links, num = plant.case.links, len(plant.case.links)
    j = [link.joint for link in links].index(plant.case.joint)
    h = _numbers(plant, j)
    gear = {}
    if "play" in h:
        limits = f'limited="true" range="{-h["play"] / 2} {h["play"] / 2}"'
        gear[links[j].joint] = f'{limits} solreflimit="0.003 1" damping="1e-3"'
    if "compliance" in h:
        gear[links[j].joint] = (
            f'stiffness="{1 / h["compliance"]}" damping="{0.003 / h["compliance"]}"'
        )
    text = _mjcf(links, gear)
    for old, new in plant.case.changes:
        text = text.replace(old, new, 1)
    model = mujoco.MjModel.from_xml_string(text)
    model.opt.timestep, model.opt.integrator = (
        STEP_S,
        mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    )
    believed = mujoco.MjModel.from_xml_string(_mjcf(links))
    data, belief = mujoco.MjData(model), mujoco.MjData(believed)
    dofs = np.array([model.joint(link.joint).dofadr[0] for link in links])
    own = dofs[j]
    model.dof_armature[own] += h.get("armature", 0.0)
    model.dof_damping[own] += h.get("viscous", 0.0)
    for sizes in (model.body_mass, model.body_inertia):
        sizes[model.dof_bodyid[own]] *= h.get("heavier", 1.0)
    model.dof_solref[own], model.dof_solimp[own, :2] = (0.001, 1.0), (0.999, 0.999)
    kp, kd = plant.kp, plant.kd
    goal = target[0].copy()
    data.qpos[dofs] = goal
    subs, per_row = round(1 / (LOOP_HZ * STEP_S)), LOOP_HZ // RATE_HZ
    lead = LOOP_HZ  # a second in which everything comes to rest
    share = 1.0 - math.exp(-1.0 / (LOOP_HZ * FILTER_S))
    scale = h.get("encoder_scale", 1.0)
    seen, speed = data.qpos[dofs].copy(), np.zeros(num)
    seen[j] *= scale
    lagging, slewed, filtered, integral = goal[j], goal[j], None, 0.0
    disturbance, colour = np.zeros(num), math.exp(-1.0 / (LOOP_HZ * 0.05))
    sizes = DISTURBANCE_SHARE * 0.1 * kp * math.sqrt(1 - colour**2)
    resting = abs(_weight(believed, belief, target[0])[j])
    peak = h.get("torque_share", math.inf) * (kp[j] * 0.2 + resting)
    torque = np.zeros(num)
    measured, effort = np.empty_like(target), np.empty_like(target)
    kicks = rng.normal(size=(lead + len(target) * per_row, num)) * sizes
    for n in range(-lead, len(target) * per_row):
        true = data.qpos[dofs].copy()
        true[j] *= scale
        now = np.round(true / QUANTUM_RAD) * QUANTUM_RAD
        speed += share * ((now - seen) * LOOP_HZ - speed)
        seen = now
        if n >= 0 and n % per_row == 0:
            measured[n // per_row], effort[n // per_row] = now, torque
        goal = target[max(n, 0) // per_row].copy()
        late = n - h.get("delay_s", 0.0) * LOOP_HZ
        goal[j] = target[min(max(math.floor(late / per_row), 0), len(target) - 1), j]
        if "lag_s" in h:
            lagging += (goal[j] - lagging) * (
                1.0 - math.exp(-1.0 / (LOOP_HZ * h["lag_s"]))
            )
            goal[j] = lagging
        if "slew" in h:
            slewed += min(
                max(goal[j] - slewed, -h["slew"] / LOOP_HZ), h["slew"] / LOOP_HZ
            )
            goal[j] = slewed
        error = goal - now
        if "deadband" in h:
            error[j] = math.copysign(max(abs(error[j]) - h["deadband"], 0.0), error[j])
        torque = kp * error - kd * speed
        if "feedforward" in h:  # of the rows, as the driver knows them
            row = max(n, 0) // per_row
            torque[j] += (
                h["feedforward"]
                * kd[j]
                * (target[row, j] - target[max(row - 1, 0), j])
                * RATE_HZ
            )
        if "integral" in h:
            integral += h["integral"] * kp[j] * error[j] / LOOP_HZ
            torque[j] += integral
        if plant.carries:
            weight = plant.carries * _weight(believed, belief, now)
            weight[j] *= h.get("carried", 1.0)
            torque = torque + weight
        torque[j] *= h.get("scale", 1.0)
        if "torque_lag_s" in h:
            filtered = torque[j] if filtered is None else filtered
            filtered += (torque[j] - filtered) * (
                1.0 - math.exp(-1.0 / (LOOP_HZ * h["torque_lag_s"]))
            )
            torque[j] = filtered
        if peak < math.inf:
            torque[j] = min(max(torque[j], -peak), peak)
        disturbance = colour * disturbance + kicks[n + lead]
        applied = torque + disturbance
        q, v = data.qpos[own], data.qvel[own]
        if "spring" in h:
            applied[j] -= h["spring"] * (q - links[j].middle_rad)
        if "cogging" in h:
            applied[j] += h["cogging"] * math.sin(24.0 * q + 0.7)
        limit = h.get("coulomb", 0.0) + h.get("stick", 0.0) * math.exp(
            -((v / 0.06) ** 2)
        )
        limit += h.get("grease", 0.0) * abs(v / 0.1) ** h.get("exponent", 1.0)
        limit *= 1.0 + math.copysign(h.get("one_way", 0.0), v)
        if "gear_share" in h:
            limit += h["gear_share"] * abs(torque[j])
        model.dof_frictionloss[own] = limit
        data.qfrc_applied[dofs] = applied
        mujoco.mj_step(model, data, subs)
    measured += NOISE_RAD * rng.normal(size=measured.shape)
    effort += NOISE_SHARE * np.abs(effort).max(axis=0) * rng.normal(size=effort.shape)
    return measured, effort


def _weight(
    model: mujoco.MjModel, data: mujoco.MjData, angles: np.ndarray
) -> np.ndarray:
    data.qpos[:], data.qvel[:] = angles, 0.0
    mujoco.mj_fwdPosition(model, data)
    mujoco.mj_fwdVelocity(model, data)
    return data.qfrc_bias.copy()


# the example -----------------------------------------------------------------------------------------------------------


def write_example(folder: Path) -> Plant:
    """Write the files that the user of an arm with six joints has: ``arm.xml``, and ``sweeps/`` of its elbow as tables. The
    hidden effect is dry friction.

    Raises:
        TaccorlError: the folder exists.
    """
    case = Case(
        robot=EXAMPLE,
        joint="elbow",
        hidden="coulomb_friction",
        strength=0.02,
        seed=6,
        effort=True,
    )
    plant = Plant(case)
    if folder.exists():
        raise TaccorlError(f"{folder}: already exists; name a new folder")
    folder.mkdir(parents=True)
    text = f"Everything here is simulated: {ORIGIN}. No robot was near.\n"
    (folder / "SIMULATED.txt").write_text(text, encoding="utf-8")
    (folder / "arm.xml").write_text(_mjcf(case.links), encoding="utf-8")
    write_sweeps(plant, folder)
    return plant


def write_sweeps(plant: Plant, folder: Path) -> None:
    """Write all recordings into ``folder``/sweeps as tables."""
    made = recordings(plant)
    (folder / "sweeps").mkdir()
    lines = ["recordings:"]
    for use, side in (("fit", made.fit), ("validation", made.validation)):
        for m in side:
            lines.append(
                f"  {m.name}.csv: {{use: {use}{f', repeat_of: {m.repeat_of}.csv' * bool(m.repeat_of)}}}"
            )
            keys = {"q": m.measured, "q_target": m.target}
            if plant.case.effort:
                keys["tau"] = m.effort
            header = ["t", *(f"{name}.{key}" for name in m.signals for key in keys)]
            rows = [
                m.time_s,
                *(
                    values[:, j]
                    for j in range(len(m.signals))
                    for values in keys.values()
                ),
            ]
            np.savetxt(
                folder / "sweeps" / f"{m.name}.csv",
                np.column_stack(rows),
                fmt="%.7g",
                delimiter=",",
                header=origin_lines(m.origin) + ",".join(header),
                comments="",
            )
    (folder / "sweeps" / "measurements.yaml").write_text(
        "\n".join(lines) + "\n", encoding="utf-8"
    )


def main(argv: Sequence[str]) -> int:
    """Command line ``python -m pipelines.studies.foreign my_arm``: write the example, and print the gains of its drives. Returns
    the exit status 0."""
    plant = write_example(Path(argv[0]))
    print(
        f"wrote {argv[0]}: arm.xml and sweeps/ of its elbow; simulated, not measured on a robot. Its drives run:"
    )
    for link, kp, kd in zip(plant.case.links, plant.kp, plant.kd, strict=True):
        print(f"  {link.joint}: kp: {kp}, kd: {kd}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

"""Surrogate robot: the plant with sensors and disturbances, at rest before a motion.

Letters in shapes: T rows (200 Hz), M milliseconds.
"""

import math
from collections.abc import Sequence

import numpy as np
from scipy.signal import lfilter

from taccorl.alignment.measurements.motions import OPENING_M, Motion, Room, joint_number
from taccorl.robots import ROBOT
from taccorl.sim.robot import RobotConfig
from taccorl.sim.twin import PhysicsConfig
from taccorl.surrogate.arm import GRAVITY, bodies, mass_matrix, torques
from taccorl.surrogate.plant import (
    COMMAND_MS,
    SUBSTEPS,
    Arm,
    Change,
    Drive,
    Run,
    changed,
    encoder,
    simulate,
)
from taccorl.surrogate.sampled_loop import SampledLoop

LEAD_MS = 1500  # Time in which the arm comes to rest at the first target before a recording [ms]
APPROACH_RAD = 0.01
"""Distance from which it approaches that target, from either side [rad]: with friction it then rests beside the target."""
NOISE_RAD = 2e-4  # Standard deviation of an encoder's noise [rad]
QUANTUM_RAD = math.radians(0.001)  # Step of PiPER's reported angles [rad]
JITTER_S = 2e-4  # Standard deviation of the jitter of the controller's cycles [s]
TWIN_LATE_S = 0.5 * PhysicsConfig().timestep_s
LATE_S = 0.5e-3 + TWIN_LATE_S
"""Delay that is included in the stated gains [s], so that they are valid for the twin. A controller that samples positions every
millisecond acts half a millisecond late, which reduces the damping by K_p · 0.5 ms (a sampled loop: half of its period); the
twin's implicit steps add half a step of K_p."""
PAYLOAD_LINK6_M = (0.0, 0.0, ROBOT.tcp_from_hand_m)
"""Nominal centre of a held mass in link 6's frame [m]: the middle between the pads."""
PAYLOAD_OFF_M = 0.002
"""Standard deviation, along each axis and between robots, of the true centre from the nominal one [m]: no weight is gripped
exactly in its middle."""
LOST_RUN = (
    0.8,
    0.15,
    0.05,
)  # Probabilities that one, two or three consecutive commands are lost together
DISTURBANCE_SHARE = 0.01  # Unmodelled disturbance torque, as a share of the torque for weight and a motion at 1.5 Hz
DISTURBANCE_HZ = 5.0  # Bandwidth of that torque [Hz]


class Robot:
    """The plant with its sensors: simulates reports for commands. ``gains``: K_p, K_d, T_ref of the equivalent continuous
    controller. ``loop``: timing of the loop of the joint under test; None: its velocity loop is continuous. ``payload_m``: (3,)
    true position of known masses in link 6's frame."""

    def __init__(
        self,
        signal: str,
        gains: tuple[float, float, float],
        changes: Sequence[Change],
        pose: tuple[float, ...],
        *,
        loop: SampledLoop | None = None,
        payload_m: tuple[float, float, float] = PAYLOAD_LINK6_M,
    ) -> None:
        self.joint = joint_number(signal) - 1
        self.arm = ROBOT.arms.index(signal.partition("_")[0])
        self.pose = np.array(pose)
        config = RobotConfig()
        self._config, self._changes = config, list(changes)
        self._payload_m = payload_m
        kp, kd, torque_ff = gains
        late_s = LATE_S if loop is None else 0.5 * loop.period_s + TWIN_LATE_S
        drive = Drive(
            kp=kp,
            kd=kd + kp * late_s,
            torque_ff=torque_ff,
            motor_inertia=config.armature_kgm2,
        )
        if loop is not None:
            drive = drive._replace(loop_steps=loop.steps, velocity_filter=loop.filter_s)
        self.drive = changed(drive, self._changes)
        self._believed = bodies(config, OPENING_M)

    def run(
        self,
        motion: Motion,
        room: Room,
        rng: np.random.Generator | None = None,
        **drive: float,
    ) -> Run:
        """Simulate the true motion; without ``rng`` there are no disturbances. ``drive``: changed fields of ``Drive`` for this
        run."""
        own = motion.target(room)
        target = np.tile(self.pose, (len(own), 1))
        target[:, self.joint] = own
        d = self.drive._replace(**drive)
        lost = self._lost(
            len(own), np.random.default_rng(len(own)) if rng is None else rng
        )
        target[:, self.joint] = own[lost]
        d = d._replace(kp=d.kp * motion.gain, kd=d.kd * motion.gain)
        total = LEAD_MS + COMMAND_MS * len(target)
        start = target[0].copy()
        disturbance, jitter = (
            np.zeros((total, ROBOT.num_joints)),
            np.zeros(total, np.int64),
        )
        if rng is not None:
            start[self.joint] += APPROACH_RAD * rng.choice([-1.0, 1.0])
            disturbance = _disturbance(rng, total, self._disturbed_nm(room))
            if d.loop_steps == 0:
                jitter = np.clip(
                    np.rint(rng.normal(0, JITTER_S * SUBSTEPS * 1e3, total)), -3, 3
                ).astype(np.int64)
        arm = self._arm(motion)
        start[self.joint] += self._rest(arm, d, target[0])
        return simulate(arm, self.joint, d, target, start, disturbance, jitter, LEAD_MS)

    def _lost(self, rows: int, rng: np.random.Generator) -> np.ndarray:
        """(T,) which command is in force at each row: where one is lost, the one before it is held."""
        share = sum(c.dropped for c in self._changes)
        arrived = np.arange(rows)
        if share == 0.0:
            return arrived
        runs = np.arange(1, len(LOST_RUN) + 1)
        begins = np.flatnonzero(rng.random(rows) < share / (runs @ LOST_RUN))
        for begin, run in zip(
            begins, rng.choice(runs, len(begins), p=LOST_RUN), strict=True
        ):
            arrived[begin : begin + run] = arrived[max(begin - 1, 0)]
        return arrived

    def _arm(self, motion: Motion) -> Arm:
        balls = tuple(c.ball for c in self._changes if c.ball is not None)
        if motion.payload_kg > 0:
            balls += ((motion.payload_kg, *self._payload_m),)
        carried = (
            math.prod(c.carried for c in self._changes)
            * self._config.gravity_compensation
        )
        armature = np.full(ROBOT.num_joints, self._config.armature_kgm2)
        gains = (
            np.array(g)
            for g in (ROBOT.kp_nm_per_rad, ROBOT.kd_nms_per_rad, ROBOT.torque_ff_nm)
        )
        return Arm(
            bodies(self._config, OPENING_M, balls),
            self._believed,
            carried,
            armature,
            *gains,
        )

    def _disturbed_nm(self, room: Room) -> np.ndarray:
        zero = np.zeros(ROBOT.num_joints)
        weight = np.abs(torques(self._believed, self.pose, zero, zero, GRAVITY))
        inertia = (
            mass_matrix(self._believed, self.pose)[self.joint, self.joint]
            + self._config.armature_kgm2
        )
        weight[self.joint] += 0.5 * inertia * room.sweep_rad * (2 * np.pi * 1.5) ** 2
        return DISTURBANCE_SHARE * weight

    def carried_nm(self, run: Run) -> np.ndarray:
        """(M,) torque of the gravity compensation at the joint under test [N·m]."""
        angle, zero, moved = (
            self.pose.copy(),
            np.zeros(ROBOT.num_joints),
            run.angle[:, self.joint],
        )
        coarse, weight = np.linspace(moved.min(), moved.max(), 50), []
        for angle[self.joint] in coarse:
            weight.append(
                torques(self._believed, angle, zero, zero, GRAVITY)[self.joint]
            )
        return np.interp(moved, coarse, weight)

    def reported(self, run: Run) -> np.ndarray:
        """(T, 6) angles reported by the encoders at each row, without noise [rad]."""
        late_ms = 1e3 * sum(c.report_delay_s for c in self._changes)
        ms = np.arange(len(run.angle), dtype=float)
        rows = ms[::COMMAND_MS] - late_ms
        angle = run.angle[::COMMAND_MS].copy()
        if late_ms > 0:
            angle[:, self.joint] = np.interp(rows, ms, run.angle[:, self.joint])
        angle[:, self.joint] = encoder(self.drive, angle[:, self.joint])
        return angle

    def _rest(self, arm: Arm, d: Drive, target: np.ndarray) -> float:
        """Where the joint under test balances, from its target; friction aside."""
        at, zero = target.copy(), np.zeros(ROBOT.num_joints)
        for _ in range(20):
            weight = torques(arm.bodies, at, zero, zero, GRAVITY)[self.joint]
            carried = (
                d.torque_scale
                * arm.carried
                * torques(arm.believed, at, zero, zero, GRAVITY)[self.joint]
            )
            left = carried - weight - d.spring * (at[self.joint] - d.spring_rest)
            error = -(left / d.torque_scale + d.torque_ff) / d.kp * (d.integral <= 0.0)
            at[self.joint] += target[self.joint] - error - encoder(d, at[self.joint])
        return float(at[self.joint] - target[self.joint])


def inertia_and_weight(
    pose: np.ndarray, joint: int, payload_kg: float = 0.0
) -> tuple[float, float]:
    """Inertia with rotor [kg·m²] and weight's torque [N·m] of joint 1 to 6 at ``pose`` (6,) [rad], with the other joints held."""
    config = RobotConfig()
    arm = bodies(config, OPENING_M, ((payload_kg, *PAYLOAD_LINK6_M),))
    inertia = mass_matrix(arm, pose)[joint - 1, joint - 1] + config.armature_kgm2
    zero = np.zeros(ROBOT.num_joints)
    return float(inertia), float(torques(arm, pose, zero, zero, GRAVITY)[joint - 1])


def free_inertia(pose: np.ndarray, joint: int) -> float:
    """Inertia of joint 1 to 6 at ``pose`` (6,) [rad] with the other joints free [kg·m²], 1 / (M⁻¹)_jj: the one that matters to a
    fast loop."""
    config = RobotConfig()
    moved = mass_matrix(
        bodies(config, OPENING_M), pose
    ) + config.armature_kgm2 * np.eye(ROBOT.num_joints)
    return float(1.0 / np.linalg.inv(moved)[joint - 1, joint - 1])


def _disturbance(
    rng: np.random.Generator, milliseconds: int, sizes_nm: np.ndarray
) -> np.ndarray:
    """(M, 6) N·m of standard deviations ``sizes_nm`` (6,), in straight lines' worth of ``DISTURBANCE_HZ``."""
    keep = math.exp(-2 * math.pi * DISTURBANCE_HZ * 1e-3)
    return sizes_nm * coloured(
        rng.standard_normal((milliseconds, ROBOT.num_joints)), keep
    )


def coloured(white: np.ndarray, keep: float) -> np.ndarray:
    """``white`` noise (T, …) of variance 1 with the correlation ``keep`` between neighbouring rows and the same variance."""
    share = math.sqrt(1 - keep**2)
    return np.asarray(
        lfilter(
            [share],
            [1.0, -keep],
            np.concatenate([white[:1] / share, white[1:]]),
            axis=0,
        )
    )

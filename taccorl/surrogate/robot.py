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
from taccorl.surrogate.hidden import Change, changed
from taccorl.surrogate.plant import COMMAND_MS, SUBSTEPS, Arm, Drive, Run, encoder, simulate
from taccorl.surrogate.sampled_loop import SampledLoop

LEAD_MS = 1500
"""Before a recording begins the arm comes to rest at its first target …"""
APPROACH_RAD = 0.01
"""… from so far off, on either side: with friction it rests beside it."""
NOISE_RAD = 2e-4
"""Of an encoder's reading."""
QUANTUM_RAD = math.radians(0.001)
"""PiPER's step of angles."""
SPEED_NOISE_RAD_PER_S, SPEED_QUANTUM_RAD_PER_S = 5e-3, 1e-3
EFFORT_NOISE_SHARE, EFFORT_QUANTUM_NM = 0.01, 1e-3
"""Noise of efforts over the joint's largest on the chirp: a choice. PiPER reports N·m in steps of a thousandth."""
JITTER_S = 2e-4
"""Of each of the controller's milliseconds."""
TWIN_LATE_S = 0.5 * PhysicsConfig().timestep_s
LATE_S = 0.5e-3 + TWIN_LATE_S
"""Gains are stated as the twin would need them. A controller that samples positions a millisecond apart acts half of one late,
which takes K_p · 0.5 ms of damping (a sampled loop: half of its period); the twin's implicit steps add half a step of K_p."""
PAYLOAD_LINK6_M = (0.0, 0.0, ROBOT.tcp_from_hand_m)
"""Where a known mass is held: its centre in the middle between the pads …"""
PAYLOAD_OFF_M = 0.002
"""… but for so much (standard deviation along each axis, of one robot to the next): nobody grips a weight in its very middle."""
LOST_RUN = (0.8, 0.15, 0.05)
"""Shares of one, two, three commands lost in a row."""
DISTURBANCE_SHARE = 0.01
"""Torque that nobody accounts for, over the one that weight and a swing at 1.5 Hz take."""
DISTURBANCE_HZ = 5.0


class Robot:
    """The plant with its sensors: commands in, reports out.

    Args:
        gains: K_p, K_d, T_ref as a continuous controller's.
        loop: of the joint under test; None is the drive whose velocity loop is continuous.
        payload_m: (3,) where known masses are held, in link 6.
    """

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
        drive = Drive(kp=kp, kd=kd + kp * late_s, torque_ff=torque_ff, motor_inertia=config.armature_kgm2)
        if loop is not None:
            drive = drive._replace(loop_steps=loop.steps, velocity_filter=loop.filter_s)
        self.drive = changed(drive, self._changes)
        self._believed = bodies(config, OPENING_M)

    def run(self, motion: Motion, room: Room, rng: np.random.Generator | None = None, **drive: float) -> Run:
        """The true motion; without ``rng`` nothing disturbs it.

        Args:
            drive: fields of ``Drive`` that are changed for this run.
        """
        own = motion.target(room)
        target = np.tile(self.pose, (len(own), 1))
        target[:, self.joint] = own
        d = self.drive._replace(**drive)
        lost = self._lost(len(own), np.random.default_rng(len(own)) if rng is None else rng)
        target[:, self.joint] = own[lost]
        d = d._replace(kp=d.kp * motion.gain, kd=d.kd * motion.gain)
        total = LEAD_MS + COMMAND_MS * len(target)
        start = target[0].copy()
        disturbance, jitter = np.zeros((total, ROBOT.num_joints)), np.zeros(total, np.int64)
        if rng is not None:
            start[self.joint] += APPROACH_RAD * rng.choice([-1.0, 1.0])
            disturbance = _disturbance(rng, total, self._disturbed_nm(room))
            if d.loop_steps == 0:
                jitter = np.clip(np.rint(rng.normal(0, JITTER_S * SUBSTEPS * 1e3, total)), -3, 3).astype(np.int64)
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
        for begin, run in zip(begins, rng.choice(runs, len(begins), p=LOST_RUN), strict=True):
            arrived[begin : begin + run] = arrived[max(begin - 1, 0)]
        return arrived

    def _arm(self, motion: Motion) -> Arm:
        balls = tuple(c.ball for c in self._changes if c.ball is not None)
        if motion.payload_kg > 0:
            balls += ((motion.payload_kg, *self._payload_m),)
        carried = math.prod(c.carried for c in self._changes) * self._config.gravity_compensation
        armature = np.full(ROBOT.num_joints, self._config.armature_kgm2)
        gains = (np.array(g) for g in (ROBOT.kp_nm_per_rad, ROBOT.kd_nms_per_rad, ROBOT.torque_ff_nm))
        return Arm(bodies(self._config, OPENING_M, balls), self._believed, carried, armature, *gains)

    def _disturbed_nm(self, room: Room) -> np.ndarray:
        zero = np.zeros(ROBOT.num_joints)
        weight = np.abs(torques(self._believed, self.pose, zero, zero, GRAVITY))
        inertia = mass_matrix(self._believed, self.pose)[self.joint, self.joint] + self._config.armature_kgm2
        weight[self.joint] += 0.5 * inertia * room.sweep_rad * (2 * np.pi * 1.5) ** 2
        return DISTURBANCE_SHARE * weight

    def carried_nm(self, run: Run) -> np.ndarray:
        """(M,) weight of the joint under test that its motor carries."""
        angle, zero = self.pose.copy(), np.zeros(ROBOT.num_joints)
        coarse = np.linspace(run.angle[:, self.joint].min(), run.angle[:, self.joint].max(), 50)
        weight = []
        for angle[self.joint] in coarse:
            weight.append(torques(self._believed, angle, zero, zero, GRAVITY)[self.joint])
        return np.interp(run.angle[:, self.joint], coarse, weight)

    def reported(self, run: Run) -> np.ndarray:
        """(T, 6) rad reported by the encoders at each row, without noise."""
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
            carried = d.torque_scale * arm.carried * torques(arm.believed, at, zero, zero, GRAVITY)[self.joint]
            left = carried - weight - d.spring * (at[self.joint] - d.spring_rest)
            error = -(left / d.torque_scale + d.torque_ff) / d.kp * (d.integral <= 0.0)
            at[self.joint] += target[self.joint] - error - encoder(d, at[self.joint])
        return float(at[self.joint] - target[self.joint])


def inertia_and_weight(pose: np.ndarray, joint: int, payload_kg: float = 0.0) -> tuple[float, float]:
    """kg·m² with rotor, and N·m, of joint 1 to 6 at ``pose`` (6,) while the others stand still."""
    config = RobotConfig()
    arm = bodies(config, OPENING_M, ((payload_kg, *PAYLOAD_LINK6_M),))
    inertia = mass_matrix(arm, pose)[joint - 1, joint - 1] + config.armature_kgm2
    zero = np.zeros(ROBOT.num_joints)
    return float(inertia), float(torques(arm, pose, zero, zero, GRAVITY)[joint - 1])


def free_inertia(pose: np.ndarray, joint: int) -> float:
    """kg·m² of joint 1 to 6 at ``pose`` while the others give way: what a fast loop moves; 1 / (M⁻¹)_jj."""
    config = RobotConfig()
    moved = mass_matrix(bodies(config, OPENING_M), pose) + config.armature_kgm2 * np.eye(ROBOT.num_joints)
    return float(1.0 / np.linalg.inv(moved)[joint - 1, joint - 1])


def _disturbance(rng: np.random.Generator, milliseconds: int, sizes_nm: np.ndarray) -> np.ndarray:
    """(M, 6) N·m of standard deviations ``sizes_nm`` (6,), in straight lines' worth of ``DISTURBANCE_HZ``."""
    keep = math.exp(-2 * math.pi * DISTURBANCE_HZ * 1e-3)
    white = rng.standard_normal((milliseconds, ROBOT.num_joints))
    white[0] /= math.sqrt(1 - keep**2)
    return sizes_nm * math.sqrt(1 - keep**2) * lfilter([1.0], [1.0, -keep], white, axis=0)

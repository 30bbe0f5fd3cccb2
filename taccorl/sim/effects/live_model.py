"""Numbers of MuJoCo's model that effects change between two physics steps, each simulation its own."""

from collections.abc import Sequence

import mujoco
import numpy as np
from mujoco.batch import Batch


class LiveModel:
    """Access to N simulations for the hooks ``feel`` and ``rewrite`` of effects: state that they read, and model fields that
    they change.

    ``joints`` are names of joints of the model; results have them in the same order."""

    def __init__(self, batch: Batch, rewritten: Sequence[str]) -> None:
        self.model: mujoco.MjModel = batch.model
        self._batch = batch
        self._own = {}
        self._nominal = {}
        for name in rewritten:
            applied = name == "qfrc_applied"
            self._own[name] = batch.bind(name) if applied else batch.expand(name)
            self._nominal[name] = 0.0 if applied else getattr(batch.model, name).copy()
        self._seen: dict[str, np.ndarray] = {}
        self._indices: dict[
            tuple[str, ...], tuple[np.ndarray, np.ndarray, np.ndarray]
        ] = {}

    def own(self, name: str) -> np.ndarray:
        """(N, …) values of a rewritten field of the model, writable."""
        return self._own[name]

    def seen(self, name: str) -> np.ndarray:
        """(N, …) values of a field of ``mujoco.MjData`` after the newest physics step."""
        if name not in self._seen:
            self._seen[name] = self._batch.bind(name)
            self._batch.forward()  # a field is zeros from its binding to the next step
        return self._seen[name]

    def of_joints(self, name: str, joints: Sequence[str]) -> np.ndarray:
        """(N, number of joints) values of a field of ``mujoco.MjData`` with a number for each degree of freedom."""
        return self.seen(name)[:, self.dofs(joints)]

    def make_nominal(self) -> None:
        """Reset every rewritten field to the compiled model's values."""
        for name, values in self._own.items():
            values[:] = self._nominal[name]

    def dofs(self, joints: Sequence[str]) -> np.ndarray:
        """(number of joints,) indices of the joints in ``qvel``, ``qfrc_bias``, ``dof_frictionloss``."""
        return self._of(joints)[0]

    def angles(self, joints: Sequence[str]) -> np.ndarray:
        """(number of joints,) indices of the joints in ``qpos``."""
        return self._of(joints)[1]

    def actuators(self, joints: Sequence[str]) -> np.ndarray:
        """(number of joints,) ids of the joints' motors."""
        return self._of(joints)[2]

    def _of(self, joints: Sequence[str]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        key = tuple(joints)
        if key not in self._indices:
            of = [self.model.joint(name) for name in key]
            motors = np.array([self.model.actuator(name).id for name in key])
            self._indices[key] = (
                np.array([j.dofadr[0] for j in of]),
                np.array([j.qposadr[0] for j in of]),
                motors,
            )
        return self._indices[key]

    def integrates(self, joints: Sequence[str]) -> np.ndarray:
        """(number of joints,) bool: the joint's motor is MuJoCo's PID actuator, whose ``gainprm`` are those of the integral."""
        return (
            self.model.actuator_gaintype[self.actuators(joints)]
            == mujoco.mjtGain.mjGAIN_PID
        )

    def integrals(self, joints: Sequence[str]) -> np.ndarray:
        """(number of motors with an integral,) indices of the integrals in ``act``."""
        return self.model.actuator_actadr[
            self.actuators(joints)[self.integrates(joints)]
        ]

    def error_rad(self, joints: Sequence[str]) -> np.ndarray:
        """(N, number of joints) position error q* − y [rad] as the controllers see it, computed from the motors' force. For
        effects that rewrite ``actuator_gainprm`` and ``actuator_biasprm``."""
        motors, pid = self.actuators(joints), self.integrates(joints)
        gain, bias = (
            self.own("actuator_gainprm")[:, motors, 0],
            self.own("actuator_biasprm")[:, motors],
        )
        speed = (
            self.model.actuator_gear[motors, 0]
            * self.seen("qvel")[:, self.dofs(joints)]
        )
        left = (
            self.seen("actuator_force")[:, motors] - bias[..., 0] - bias[..., 2] * speed
        )
        left[:, pid] -= gain[:, pid] * self.seen("act")[:, self.integrals(joints)]
        kp = np.where(pid, -bias[..., 1], gain)
        return np.divide(left, kp, out=np.zeros_like(left), where=kp > 0)

    def motor_torque_nm(self, joints: Sequence[str]) -> np.ndarray:
        """(N, number of joints) torque of the motors [N·m], including gravity compensation."""
        dofs = self.dofs(joints)
        torque = (
            self.seen("qfrc_actuator")[:, dofs] + self.seen("qfrc_applied")[:, dofs]
        )
        apart = (
            self.model.jnt_actgravcomp[self.model.dof_jntid[dofs]] == 0
        )  # else it is in qfrc_actuator already
        return torque + np.where(apart, self.seen("qfrc_gravcomp")[:, dofs], 0.0)

    def scale_carried(
        self, joints: Sequence[str], carried_nm: np.ndarray, factor: np.ndarray | float
    ) -> None:
        """Scale the motors' gravity compensation by ``factor``, (N, number of joints) or one number.

        ``carried_nm`` (N, number of joints) is the compensation torque that MuJoCo already applies [N·m]."""
        applied, dofs = self.own("qfrc_applied"), self.dofs(joints)
        applied[:, dofs] = factor * (applied[:, dofs] + carried_nm) - carried_nm

"""Record of one simulation at 200 Hz, the rate of the robot's joint drivers, from which recordings and replays are made.

Letters in shapes: T samples.
"""

from dataclasses import dataclass, field

import numpy as np

from taccorl.sim.simulation import Simulation, Watch
from taccorl.sim.twin import CONTROL_HZ

SAMPLE_HZ = 200  # piper_ros publishes joint states at 200 Hz (data_specs/recordings/piper_flexitac_mcap.yaml)


@dataclass(frozen=True)
class Trajectory:
    """T samples of one simulation at exact times, 200 a second; ``targets[k]`` is the command in force from ``time_s[k]`` on."""

    time_s: np.ndarray  # (T,) since the episode began
    qpos: np.ndarray  # (T, nq) true positions, in MuJoCo's order
    qvel: np.ndarray  # (T, nv) true velocities, in MuJoCo's order
    mocap: np.ndarray  # (nmocap, 7) poses of clamped bodies; they do not move
    reported: np.ndarray
    """(T, 14) joint angles [rad] and gripper openings [m] as the encoders report them, at exactly ``time_s``."""
    targets: np.ndarray  # (T, 14) commanded targets [rad, m]
    reading: (
        np.ndarray
    )  # (T, 4, 32, 12) float32 readings of the pads before gain, noise and rounding
    effort: np.ndarray
    """(T, 14) motor torque of joints [N·m] and closing force of the gripper's motor [N], in the physics step before the
    sample."""


@dataclass
class DenseRecorder:
    """Collects a ``Trajectory`` of simulation 0 while it is stepped, without changing it."""

    sim: Simulation
    _rows: list[tuple[np.ndarray, ...]] = field(default_factory=list)
    _steps: int = 0
    """Physics steps since the episode began."""

    def __post_init__(self) -> None:
        self._every = (
            self.sim.config.physics.steps_per_control_step * CONTROL_HZ // SAMPLE_HZ
        )
        self._see(0)

    def watch(self, num_steps: int | None = None) -> Watch:
        """``Watch`` that records the samples of the next control step, or of the next ``num_steps`` physics steps of
        ``Simulation.advance``."""
        num_steps = num_steps or self.sim.config.physics.steps_per_control_step
        before, self._steps = self._steps, self._steps + num_steps
        first = -before % self._every or self._every
        return Watch(range(first, num_steps + 1, self._every), lambda _: self._see(0))

    def _see(self, i: int) -> None:
        arrays, actuators = self.sim.arrays, self.sim.action_actuators
        row = (
            *(arrays["qpos"][i], arrays["qvel"][i], self.sim.proprioception()[i]),
            *(
                arrays["ctrl"][i, actuators],
                self.sim.reading()[i],
                self.sim.effort()[i],
            ),
        )
        self._rows.append(tuple(np.array(values) for values in row))

    def trajectory(self) -> Trajectory:
        """The trajectory recorded so far."""
        qpos, qvel, reported, targets, reading, effort = (
            np.stack(column) for column in zip(*self._rows, strict=True)
        )
        # A sample is taken at the end of a command's stretch; the command in force from then on is the next sample's.
        targets = np.concatenate([targets[1:], targets[-1:]])
        mocap = np.concatenate(
            [self.sim.arrays["mocap_pos"][0], self.sim.arrays["mocap_quat"][0]], axis=1
        )
        time_s = np.arange(len(qpos)) / SAMPLE_HZ
        return Trajectory(time_s, qpos, qvel, mocap, reported, targets, reading, effort)

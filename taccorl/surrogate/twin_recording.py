"""Write a demonstration in the twin as a recording of the robot's drivers: MCAP with their rates and jitter.

Joints at 200 Hz, pads at 100 Hz with their rolling scan, pictures at 30 Hz from the state at their own stamps. No picture is lost
on the way: two lost in a row would split the episode. Nothing here comes from a robot; the file's metadata states that.
"""

import functools
import json
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import mujoco
import numpy as np

from taccorl.data.origin import Origin, labelled
from taccorl.sim.rendering import Renderer
from taccorl.sim.simulation import Simulation
from taccorl.sim.trajectory import SAMPLE_HZ, Trajectory
from taccorl.surrogate.drivers import (
    PADS,
    DriverConfig,
    Marks,
    Streams,
    TrueSignals,
    publish,
)

LEAD_S = 1.0  # Time of rest before and after the demonstration [s]: the first frames of a pad are its baseline


class TwinStory(TrueSignals):
    """True signals of a trajectory at any time of the recording. Before and after the trajectory everything is at rest."""

    def __init__(self, sim: Simulation, trajectory: Trajectory, outcome: str) -> None:
        self.sim, self.trajectory = sim, trajectory
        self.duration_s = float(trajectory.time_s[-1]) + 2 * LEAD_S
        self.plans = [Marks(LEAD_S / 2, self.duration_s - LEAD_S / 2, outcome)]
        self._rows = {
            "state": trajectory.reported,
            "command": trajectory.targets,
            "effort": trajectory.effort,
        }
        self._rows["velocity"] = np.gradient(trajectory.reported, 1 / SAMPLE_HZ, axis=0)
        # (T, 4, 12, 32) counts above baseline, without noise and rounding, in wire order
        self._counts = self.sim.sensor.clean_counts(trajectory.reading).swapaxes(2, 3)

    def clean_counts(self, pad: str, time_s: np.ndarray) -> np.ndarray:
        """Counts (N, 12, 32) above baseline in wire order: the pad's columns are the wire's rows. ``time_s`` [s] is (N,), or (N,
        12) with one instant per row of the wire."""
        counts = self._counts[:, PADS.index(pad)]
        rows = np.broadcast_to(
            np.asarray(time_s, float).reshape(len(time_s), -1), (len(time_s), 12)
        )
        before, share = self._place(rows)
        row = np.arange(12)
        low, high = (
            counts[before, row],
            counts[np.minimum(before + 1, len(counts) - 1), row],
        )
        return low + share[..., None] * (high - low)

    def _place(self, time_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Sample before an instant, and the share of the way to the next."""
        at = np.clip(
            (np.asarray(time_s) - LEAD_S) * SAMPLE_HZ,
            0,
            len(self.trajectory.time_s) - 1,
        )
        before = np.minimum(at.astype(int), max(len(self.trajectory.time_s) - 2, 0))
        return before, at - before

    def at(self, signal: str, time_s: np.ndarray) -> np.ndarray:
        """(N, 14), as ``TrueSignals``; the state [rad, m] is what the encoders report."""
        values, (before, share) = self._rows[signal], self._place(time_s)
        low, high = values[before], values[np.minimum(before + 1, len(values) - 1)]
        return low + share[:, None] * (high - low)

    def data_at(self, time_s: float, data: mujoco.MjData) -> None:
        """Set the positions of ``data`` to those at ``time_s`` since the start of the recording (those of the sample before,
        extrapolated with its velocity), so that it can be rendered. Velocities and contacts are not set."""
        before, share = self._place(np.array(time_s))
        data.qpos[:] = self.trajectory.qpos[before]
        mujoco.mj_integratePos(
            self.sim.model,
            data.qpos,
            self.trajectory.qvel[before],
            float(share) / SAMPLE_HZ,
        )
        data.mocap_pos[:], data.mocap_quat[:] = (
            self.trajectory.mocap[:, :3],
            self.trajectory.mocap[:, 3:],
        )
        mujoco.mj_kinematics(self.sim.model, data)
        mujoco.mj_comPos(self.sim.model, data)
        mujoco.mj_camlight(self.sim.model, data)


@functools.lru_cache(maxsize=2)
def sensor_noise(rows: int, columns: int) -> np.ndarray:
    """(rows + 32, columns + 32, 3) uint8, 0 … 30 with mean 9: noise, larger than a picture so that every picture can cut its
    own piece."""
    noise = np.random.default_rng(9).normal(9.0, 5.2, (rows + 32, columns + 32, 3))
    return np.clip(np.round(noise), 0, 30).astype(np.uint8)


class TwinScene:
    """Pictures of the twin's cameras, with the noise of a colour sensor."""

    def __init__(self, story: TwinStory, camera_size: tuple[int, int]) -> None:
        self.story, self.size = story, camera_size
        self._data = mujoco.MjData(story.sim.model)
        self._renderers: dict[str, Renderer] = {}

    def pictures_bgr(
        self, camera: str, time_s: np.ndarray, frame_ids: np.ndarray
    ) -> Iterator[np.ndarray]:
        """Iterate over pictures of ``camera``, one uint8 (rows, columns, 3) in BGR for each of the times ``time_s`` (N,) [s].
        ``frame_ids``: (N,) numbers of the frames, which choose the noise."""
        if camera not in self._renderers:
            self._renderers[camera] = Renderer(
                self.story.sim.model, (camera,), *self.size
            )
        (rows, columns), sim = self.size, self.story.sim
        age_s = sim.effects.picture_age_s(camera)
        config = next(c for c in sim.config.cameras if c.name == camera)
        noise = sensor_noise(rows, columns)
        for when, k in zip(time_s.tolist(), frame_ids.tolist(), strict=True):
            self.story.data_at(when - age_s, self._data)
            picture = sim.effects.picture(
                self._renderers[camera].render([self._data])[0], config
            )[0, :, :, ::-1]
            piece = noise[k * 7 % 32 :, k * 13 % 32 :][:rows, :columns]
            yield np.clip(picture.astype(np.int16) + piece - 9, 0, 255).astype(np.uint8)

    def close(self) -> None:
        """Free OpenGL contexts."""
        for renderer in self._renderers.values():
            renderer.close()


def write_twin_mcap(
    path: Path,
    sim: Simulation,
    trajectory: Trajectory,
    *,
    success: bool,
    origin: Origin,
) -> None:
    """Write one episode as one recording; an existing file is replaced. ``success``: outcome that the closing marker states.
    ``origin``: stored in the file and in every dataset made from it."""
    story = TwinStory(sim, trajectory, "success" if success else "failure")
    config = DriverConfig(
        duration_s=story.duration_s,
        seed=int(sim.seeds[0]),
        instruction=sim.task.instruction,
        camera_loss_probability=0.0,
        pad_gain_spread=0.0,
    )
    scene = TwinScene(story, config.camera_size)
    try:
        label = labelled(origin) | {
            "task": sim.task.name,
            "seed": str(config.seed),
            "instruction": config.instruction,
        }
        label["drivers"] = json.dumps(
            {k: v for k, v in asdict(config).items() if isinstance(v, int | float)}
        )
        publish(path, Streams(config, story, scene), label)
    finally:
        scene.close()

"""Read-only accessors of N simulations: joint states, touch, images, and privileged poses and contacts for predicates."""

from collections.abc import Iterator, Sequence
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import Batch

from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.blocks import Blocks
from taccorl.sim.controller import MotorEffort
from taccorl.sim.effects.added import PAST_POSITIONS, PAST_TIME_S, AddedEffects
from taccorl.sim.effects.camera_past import place_past
from taccorl.sim.pad import KINEMATIC_FIELDS, PadArray
from taccorl.sim.ray_renderer import Positions, RayRenderer
from taccorl.sim.rendering import Renderer
from taccorl.sim.sensors import Noise, Sensor
from taccorl.sim.sensors.noise import ScanNoise
from taccorl.sim.spaces import IMAGE_SHAPE
from taccorl.sim.task import Contact, Task
from taccorl.sim.twin import TwinConfig
from taccorl.sim.warp_batch import WarpBatch

DRAWN_TOGETHER = 64
"""Number of stored states whose pictures are read back from OpenGL at once."""


class SeenScene:
    """Read-only accessors of ``Simulation``, its subclass, which sets these attributes. No method changes a simulation."""

    task: Task
    config: TwinConfig
    num_sims: int
    model: mujoco.MjModel
    batch: Batch
    arrays: dict[str, np.ndarray]
    """Field of ``mujoco.MjData`` → its live values (N, …)."""
    effects: AddedEffects
    pads: PadArray
    sensor: Sensor
    blocks: Blocks
    """Thread pool for computations that are independent between simulations."""
    action_actuators: np.ndarray
    """(14,) ids of the model's actuators, in the order of actions."""
    _effort: MotorEffort
    _encoders: np.ndarray
    _bodies: dict[str, int]
    _tcp_sites: dict[str, int]
    _touching: dict[str, np.ndarray]
    _mating: dict[tuple[str, str], tuple[int, int]]
    _renderers: dict[tuple, Renderer]
    _ray_renderers: dict[tuple, RayRenderer]

    @property
    def row_size(self) -> int:
        """Number of values in a stored state; implemented by ``Simulation``."""
        raise NotImplementedError

    def row_memory(self, rows: np.ndarray) -> dict[str, np.ndarray]:
        """Memory of effects in stored states; implemented by ``Simulation``. ``rows`` (n, row_size) → name → (n, …)."""
        raise NotImplementedError

    def proprioception(self) -> np.ndarray:
        """(N, 14) joint angles [rad] and gripper openings [m] as the encoders report them, in the order of actions."""
        return self.effects.encoder(self.arrays["sensordata"][:, self._encoders])

    def effort(self) -> np.ndarray:
        """(N, 14) torque of the joints' motors [N·m] and force of the grippers' [N] in the newest physics step."""
        return self._effort()

    def reading(self, ids: np.ndarray | None = None) -> np.ndarray:
        """(n, 4, 32, 12) float32 readings of the pads of the simulations ``ids`` (n,) (all by default) before gain, noise and
        rounding: a function of the state and of the memory of effects only."""
        spec = self.sensor.spec
        num = self.num_sims if ids is None else len(ids)
        state: Any = self.batch
        if ids is not None:
            rows = {name: getattr(self.batch, name)[ids] for name in KINEMATIC_FIELDS}
            state = SimpleNamespace(**rows)
        reading = np.empty((num, len(ROBOT.pads), spec.rows, spec.columns), np.float32)

        def read(start: int, end: int) -> None:
            reading[start:end] = self.sensor.reading(
                *self.pads.touch(state, start, end), None
            )

        self.blocks.run(read, num)
        for transform in self.sensor.transforms:
            reading = transform(reading) if ids is None else transform(reading, ids)
        return reading

    def touch(self, noise: Noise = None, ids: np.ndarray | None = None) -> np.ndarray:
        """(n, 1536) int16 counts above baseline of the simulations ``ids`` (n,) (all by default) at the present state. ``noise``:
        one random generator, or one per simulation; without it no noise is added."""
        reading = self.reading(ids)
        if not isinstance(noise, ScanNoise):
            return self.sensor.above_baseline(self.sensor.digitise(reading, noise))
        above = np.empty((len(reading), reading[0].size), np.int16)

        def convert(start: int, end: int) -> None:
            above[start:end] = self.sensor.above_baseline(
                self.sensor.digitise(reading[start:end], noise.of(start, end))
            )

        self.blocks.run(convert, len(reading))
        return above

    def render(
        self,
        cameras: Sequence[str] | None = None,
        ids: np.ndarray | None = None,
        size: tuple[int, int] = (224, 224),
    ) -> dict[str, np.ndarray]:
        """Camera → (n, rows, columns, 3) uint8 RGB, letterboxed as in a dataset.

        Args:
            cameras: names; None: all of the twin.
            ids: (n,) simulations; None: all.
            size: rows and columns.
        """
        names = tuple(cameras or (camera.name for camera in self.config.cameras))
        found, past = {}, self.effects.past
        for age_s, same in self._by_age(names):

            def late(sim: int, data: mujoco.MjData, age_s: float = age_s) -> None:
                if past:
                    place_past(data, past.positions[sim], past.time_s[sim], age_s)

            rays = None if age_s else self._rays(same, size)
            if rays is not None:
                pictures = rays.render_batch(self.batch, ids)
            else:
                pictures = self._renderer(same, size).render_batch(
                    self.batch, ids, late if age_s else None
                )
            found |= {name: pictures[:, k] for k, name in enumerate(same)}
        return {name: self._given(name, found[name]) for name in names}

    @property
    def draws_on_device(self) -> bool:
        """True if ``draw_on_device`` gives what ``render`` does: physics and ray tracer on a device, and no effect that
        changes pictures."""
        names = [camera.name for camera in self.config.cameras]
        return (
            isinstance(self.batch, WarpBatch)
            and self.batch.is_resident
            and not any(self.effects.changes_pictures(name) for name in names)
        )

    def draw_on_device(
        self, cameras: Sequence[str], ids: np.ndarray, size: tuple[int, int]
    ) -> Any:
        """Torch tensor (n, cameras, 3, rows, columns) uint8 RGB of the simulations ``ids`` (n,), letterboxed into ``size``
        (rows, columns), on the device of the physics; only if ``draws_on_device``."""
        rays = self._rays(tuple(cameras), size)
        assert rays is not None
        return rays.draw(Positions.of(self.batch, ids))

    def render_by_opengl(
        self, cameras: Sequence[str], ids: np.ndarray
    ) -> dict[str, np.ndarray]:
        """As ``render`` at the size of a dataset's pictures, by OpenGL whatever the physics, without effects on pictures."""
        names = tuple(cameras)
        pictures = self._renderer(names, IMAGE_SHAPE[:2]).render_batch(self.batch, ids)
        return {name: pictures[:, k] for k, name in enumerate(names)}

    def _rays(
        self, cameras: tuple[str, ...], size: tuple[int, int]
    ) -> RayRenderer | None:
        if not (isinstance(self.batch, WarpBatch) and self.batch.is_resident):
            return None
        if (cameras, size) not in self._ray_renderers:
            self._ray_renderers[cameras, size] = RayRenderer(
                self.model, cameras, *size, device=self.batch.settings.device
            )
        return self._ray_renderers[cameras, size]

    def render_states(
        self,
        states: np.ndarray,
        cameras: Sequence[str],
        size: tuple[int, int] = (224, 224),
    ) -> Iterator[dict[str, np.ndarray]]:
        """Camera → (rows, columns, 3) uint8 RGB for each of the stored ``states`` (T, row_size), one after the other. As
        ``draw_states``, with the memory of ``DRAWN_TOGETHER`` of them."""
        for first in range(0, max(len(states), 1), DRAWN_TOGETHER):
            part = states[first : first + DRAWN_TOGETHER]
            drawn = self.draw_states(part, cameras, size)
            yield from (
                {name: pictures[k] for name, pictures in drawn.items()}
                for k in range(len(part))
            )

    def draw_states(
        self,
        states: np.ndarray,
        cameras: Sequence[str],
        size: tuple[int, int] = (224, 224),
    ) -> dict[str, np.ndarray]:
        """Render ``states`` (T, row_size) as ``state_rows`` returns them. Returns each camera's name → (T, rows, columns, 3)
        uint8 RGB.

        The simulations do not change. States of a twin with other cameras are accepted. Raises TaccorlError: rows of another
        size."""
        states = np.asarray(states)
        if states.ndim != 2 or states.shape[1] != self.row_size:
            raise TaccorlError(
                f"states to draw: rows (T, {self.row_size}) of state_rows, found {states.shape}"
            )
        memory = self.row_memory(states) if self.effects.past else {}
        data = mujoco.MjData(self.model)

        def placed(age_s: float) -> Iterator[mujoco.MjData]:
            for k, physics in enumerate(states[:, 1 : 1 + self.batch.nstate]):
                mujoco.mj_setState(
                    self.model, data, physics, mujoco.mjtState.mjSTATE_INTEGRATION
                )
                if age_s:
                    place_past(
                        data, memory[PAST_POSITIONS][k], memory[PAST_TIME_S][k], age_s
                    )
                mujoco.mj_kinematics(self.model, data)
                mujoco.mj_comPos(self.model, data)
                mujoco.mj_camlight(self.model, data)
                yield data

        found = {}
        for age_s, same in self._by_age(tuple(cameras)):
            pictures = self._renderer(same, size).render(placed(age_s), len(states))
            found |= {name: pictures[:, k] for k, name in enumerate(same)}
        return {name: self._given(name, found[name]) for name in cameras}

    def _by_age(self, cameras: tuple[str, ...]) -> list[tuple[float, tuple[str, ...]]]:
        """(how late their pictures are, cameras): all at once where none is late."""
        ages = {name: self.effects.picture_age_s(name) for name in cameras}
        return [
            (age, tuple(n for n in cameras if ages[n] == age))
            for age in dict.fromkeys(ages.values())
        ]

    def _given(self, camera: str, pictures: np.ndarray) -> np.ndarray:
        """What a camera gives of pictures (n, rows, columns, 3) that were drawn of it."""
        config = next(c for c in self.config.cameras if c.name == camera)
        return self.effects.picture(pictures, config)

    def require_cameras(self, names: Sequence[str]) -> None:
        """Check that the twin has these cameras. Raises TaccorlError: some are missing; the message names them."""
        known = [camera.name for camera in self.config.cameras]
        if missing := [name for name in names if name not in known]:
            raise TaccorlError(
                f"pictures: the twin has no camera {', '.join(missing)}; it has {', '.join(known) or 'none'}. The pictures of "
                "a dataset require it: add it to the twin's cameras, or request no images"
            )

    def _renderer(self, cameras: tuple[str, ...], size: tuple[int, int]) -> Renderer:
        if (cameras, size) not in self._renderers:
            self._renderers[cameras, size] = Renderer(self.model, cameras, *size)
        return self._renderers[cameras, size]

    def close(self) -> None:
        """Free OpenGL contexts and threads."""
        self.blocks.close()
        for renderers in (self._renderers, self._ray_renderers):
            for renderer in renderers.values():
                renderer.close()
            renderers.clear()

    def poses(self, body: str) -> np.ndarray:
        """World-from-body poses (N, 4, 4) of ``body`` in N simulations."""
        return self._placed("", self._body(body))

    def tcp(self, arm: str) -> np.ndarray:
        """World-from-TCP poses (N, 4, 4) of an arm in N simulations: z = approach direction, y = closing direction."""
        return self._placed("site_", self._tcp_sites[arm])

    def _placed(self, kind: str, k: int) -> np.ndarray:
        pose = np.zeros((self.num_sims, 4, 4))
        pose[:, :3, :3] = self.arrays[f"{kind}xmat"][:, k].reshape(-1, 3, 3)
        pose[:, :3, 3], pose[:, 3, 3] = self.arrays[f"{kind}xpos"][:, k], 1.0
        return pose

    def velocities(self, body: str) -> np.ndarray:
        """(N, 3) linear velocity of the origin of the body's frame in N simulations, in world coordinates [m/s]."""
        k = self._body(body)
        spatial = self.arrays["cvel"][:, k]
        turn, arm = (
            spatial[:, :3],
            self.arrays["xpos"][:, k]
            - self.arrays["subtree_com"][:, self.model.body_rootid[k]],
        )
        # Written out: np.cross costs ten times as much on a few rows.
        across = (
            turn[:, [1, 2, 0]] * arm[:, [2, 0, 1]]
            - turn[:, [2, 0, 1]] * arm[:, [1, 2, 0]]
        )
        return spatial[:, 3:] + across

    def pads_touching(self, body: str) -> np.ndarray:
        """(N, 4) bool for N simulations: which of the 4 pads touch ``body``, in the order of ``ROBOT.pads``."""
        return self.arrays["sensordata"][:, self._touching[body]] > 0

    def contact(self, body: str, other: str) -> Contact:
        """Contact of a pair of bodies in ``task.mating``, each (N,): whether they touch, deepest penetration [m] and net
        normal force [N]."""
        if (body, other) not in self._mating:
            raise TaccorlError(
                f"contact {body}–{other}: task {self.task.name} has only the pairs {list(self._mating)}"
            )
        data, at, force = self.arrays["sensordata"], *self._mating[body, other]
        net_n = np.linalg.norm(data[:, force : force + 3], axis=1)
        return Contact(data[:, at] > 0, np.maximum(-data[:, at + 1], 0.0), net_n)

    def _body(self, name: str) -> int:
        return self._bodies[name] if name in self._bodies else self.model.body(name).id

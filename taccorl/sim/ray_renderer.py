"""Pictures by MuJoCo Warp's ray tracer: on a GPU, of many simulations at once, which may stay there.

The same cameras, lights, textures and black bars as ``rendering``'s OpenGL. Where a picture is smaller than a dataset's,
each pixel is the mean of as many rays as the dataset has pixels there, as policies see pictures that were stored and then
reduced. Mean difference from OpenGL's pictures, reduced from 224² to 84 × 112: 0.5 … 0.6 of 255 (docs/training.md).

Letters in shapes: n pictures of each camera, R rows, C columns.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np
from mujoco.batch import Batch

from taccorl.errors import TaccorlError, nearest
from taccorl.extras import OnUse
from taccorl.sim.cameras import Window, letterbox_window
from taccorl.sim.spaces import IMAGE_SHAPE
from taccorl.sim.warp_batch import _for_warp, open_device

mjw: Any = OnUse("mujoco_warp")
wp: Any = OnUse("warp")
torch: Any = OnUse("torch")

WORLDS_AT_ONCE = 512
"""Simulations that are drawn together; their buffers take 250 MB at 84 × 112 pixels."""
_SHOWN = (
    *("body_pos", "body_quat", "jnt_pos", "jnt_axis", "qpos0"),
    *("geom_pos", "geom_quat", "geom_size", "geom_rgba", "geom_matid", "mat_rgba"),
    *("cam_pos", "cam_quat", "cam_fovy", "cam_intrinsic", "cam_sensorsize"),
    *("light_pos", "light_dir", "light_active", "light_diffuse", "light_ambient"),
)
"""Fields of the model that pictures depend on."""
_WAY_OUT = "use physics=warp:mode=copied"


class Positions(NamedTuple):
    """What pictures of n simulations depend on."""

    qpos: np.ndarray
    """(n, nq)"""
    mocap_pos: np.ndarray
    """(n, nmocap, 3) [m]"""
    mocap_quat: np.ndarray
    """(n, nmocap, 4) wxyz"""

    @classmethod
    def of(cls, batch: Batch, ids: np.ndarray) -> "Positions":
        """Those of the simulations ``ids`` (n,). Raises TaccorlError: what pictures show of the model differs between the
        simulations."""
        for name in _SHOWN:
            if batch.expanded(name) is not None:
                raise TaccorlError(
                    f"physics=warp: {name} differs between simulations, which the ray tracer does not draw; {_WAY_OUT}"
                )
        return cls(*(batch.bind(name)[ids] for name in cls._fields))


class RayRenderer:
    """Draws the same cameras of any number of simulations into letterboxed frames."""

    def __init__(
        self,
        model: mujoco.MjModel,
        cameras: Sequence[str],
        rows: int = IMAGE_SHAPE[0],
        columns: int = IMAGE_SHAPE[1],
        *,
        device: str = "cuda:0",
    ) -> None:
        """``model``: compiled, with ``cameras`` in it. ``rows``, ``columns``: size of a frame [pixels]. ``device``: Warp's name
        of it.

        Raises:
            TaccorlError: no camera of such a name, no such device, or MuJoCo Warp cannot draw the model.
        """
        open_device(device)
        self._shape, self._names = (rows, columns), tuple(cameras)
        self._device = wp.get_device(device)
        self._model = _for_warp(model)
        self._windows = [_window(model, name, self._shape) for name in cameras]
        try:
            with wp.ScopedDevice(self._device):
                self._warp_model = mjw.put_model(self._model)
                self._data = mjw.make_data(
                    self._model, nworld=WORLDS_AT_ONCE, nconmax=1, njmax=self._model.nv
                )
                self._context = self._make_context()
                self._render()  # compiles the kernels
        except (NotImplementedError, ValueError, RuntimeError) as error:
            raise TaccorlError(
                f"physics=warp: MuJoCo Warp cannot draw {', '.join(cameras)} on {device} ({error}); {_WAY_OUT}"
            ) from error
        flat = {
            name: wp.to_torch(getattr(self._data, name)) for name in Positions._fields
        }
        self._inputs = Positions(**flat)
        self._packed = wp.to_torch(self._context.rgb_data.view(wp.int32))

    def _make_context(self) -> Any:
        first = self._windows[0]
        wanted = letterbox_window((first.rows, first.columns), IMAGE_SHAPE[:2])
        return mjw.create_render_context(
            self._model,
            nworld=WORLDS_AT_ONCE,
            cam_res=[(w.columns, w.rows) for w in self._windows],
            cam_active=list(self._names),
            render_rgb=True,
            render_depth=False,
            render_seg=False,
            render_skybox=True,
            samples_per_pixel=max(1, round(wanted.rows / first.rows)),
        )

    def _render(self) -> None:
        """Draw the positions in ``_inputs``, and wait: Torch and Warp have streams of their own."""
        with wp.ScopedDevice(self._device):
            self._work()
            wp.synchronize_device(self._device)

    def _work(self) -> None:
        model, data, context = self._warp_model, self._data, self._context
        mjw.kinematics(model, data)
        mjw.com_pos(model, data)  # for lights and cameras that follow a centre of mass
        mjw.camlight(model, data)
        mjw.refit_bvh(model, data, context)
        mjw.render(model, data, context)

    def draw(self, positions: Positions) -> Any:
        """Torch tensor (n, cameras, 3, R, C) uint8 RGB on the device. Simulations with a position that is not finite are drawn
        as in the model's reference position."""
        num = len(positions.qpos)
        is_sound = np.isfinite(positions.qpos).all(axis=1, keepdims=True)
        qpos = np.where(is_sound, positions.qpos, self._model.qpos0)
        of_host = positions._replace(qpos=qpos)
        device = self._inputs.qpos.device
        waiting = Positions(
            *(torch.from_numpy(x.astype(np.float32)).to(device) for x in of_host)
        )
        out = torch.zeros(
            (num, len(self._names), 3, *self._shape), dtype=torch.uint8, device=device
        )
        for first in range(0, num, WORLDS_AT_ONCE):
            part = slice(first, min(first + WORLDS_AT_ONCE, num))
            for values, new in zip(self._inputs, waiting, strict=True):
                values[: part.stop - first] = new[part]
            if self._device.is_cuda:
                torch.cuda.synchronize(device)
            self._render()
            self._unpack(out[part])
        return out

    def _unpack(self, out: Any) -> None:
        """Write the pictures of the first simulations into ``out`` (n, cameras, 3, R, C) uint8."""
        at = 0
        for k, window in enumerate(self._windows):
            num_px = window.rows * window.columns
            packed = self._packed[: len(out), at : at + num_px].contiguous()
            at += num_px
            bgra = packed.view(torch.uint8).view(
                len(out), window.rows, window.columns, 4
            )
            rgb = bgra[..., [2, 1, 0]].permute(0, 3, 1, 2)
            down = slice(window.top, window.top + window.rows)
            across = slice(window.left, window.left + window.columns)
            out[:, k, :, down, across] = rgb

    def render_batch(
        self, batch: Batch, ids: Sequence[int] | np.ndarray | None = None
    ) -> np.ndarray:
        """As ``Renderer.render_batch``: (n, cameras, R, C, 3) uint8, a new array."""
        chosen = np.arange(batch.nsim) if ids is None else np.asarray(ids)
        drawn = self.draw(Positions.of(batch, chosen))
        return drawn.permute(0, 1, 3, 4, 2).contiguous().cpu().numpy()

    def close(self) -> None:
        """Free the device's memory."""
        vars(self).clear()


def _window(model: mujoco.MjModel, name: str, shape: tuple[int, int]) -> Window:
    """The part of a frame of ``shape`` (rows, columns) that the camera's picture fills."""
    index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, name)
    if index < 0:
        names = (model.camera(i).name for i in range(model.ncam))
        raise TaccorlError(f"no camera {name!r}; {nearest(name, names)}")
    columns, rows = (int(n) for n in model.cam_resolution[index])
    # (1, 1) is MuJoCo's "not stated": the camera fills the frame
    return letterbox_window(
        shape if (rows, columns) == (1, 1) else (rows, columns), shape
    )

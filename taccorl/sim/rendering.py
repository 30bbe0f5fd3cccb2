"""Rendered images of many simulations in the format that ingest stores: each view is drawn alone, copied to one sheet, read
back once.

Classic renderer without shadows, reflections or multisampling, which cost 3 to 20 times as much in software (llvmpipe,
measured). OpenGL comes through EGL unless MUJOCO_GL names another, and is touched only when the first picture is asked for.
The same state gives the same bytes whether drawn alone or with others; another OpenGL driver may round pixels differently.
"""

import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Self

import mujoco
import numpy as np
from mujoco.batch import Batch

from taccorl.errors import TaccorlError, nearest
from taccorl.sim.cameras import letterbox_window
from taccorl.sim.offscreen import Canvas, View

Place = Callable[[int, mujoco.MjData], None]
"""Function of a simulation's number and a copy of its data, whose positions it may change before it is drawn."""


class Renderer:
    """Draws the same cameras of any number of simulations into letterboxed frames.

    The OpenGL context is made by the first ``render`` and freed by ``close`` (or ``with``). Workers make their own: start
    them before the first picture, or with ``spawn``."""

    def __init__(
        self,
        model: mujoco.MjModel,
        cameras: Sequence[str],
        rows: int = 224,
        columns: int = 224,
        max_sheet_px: int = 4096,
    ) -> None:
        """Meshes, textures and cameras are those of ``model``; simulations with other models must have the same assets.

        Args:
            model: compiled, with ``cameras`` in it (``taccorl.sim.cameras.add_cameras``).
            cameras: names, in the order of the pictures.
            rows, columns: size of a frame [pixels].
            max_sheet_px: longest side of the sheet on which views are collected; more views than fit take several sheets.

        Raises:
            TaccorlError: the model has no camera of such a name.
        """
        self._model = model
        self._shape = (rows, columns)
        self._max_sheet_px = max_sheet_px
        self._views = [_view(model, name, (rows, columns)) for name in cameras]
        self._gl: Canvas | None = None
        self._scratch: tuple[Batch, mujoco.MjModel, mujoco.MjData] | None = None

    def render(
        self, datas: Iterable[mujoco.MjData], num: int | None = None
    ) -> np.ndarray:
        """Pictures (simulations, cameras, rows, columns, 3) uint8, a new array.

        Args:
            num: number of ``datas``, if each is drawn before the next is asked for: they may then be one and the same object.

        Each state is drawn with its own model (``data.model``) and must have been forwarded: mj_forward, or at least
        mj_kinematics and mj_camlight. As by MuJoCo's default, geoms of groups 0–2 are drawn; sites and contacts are not.

        Raises:
            TaccorlError: OpenGL is not available, or a model has other assets.
        """
        if num is None:
            num = len(datas := list(datas))
        return self._draw(((data.model, data) for data in datas), num)

    def render_batch(
        self,
        batch: Batch,
        ids: Sequence[int] | np.ndarray | None = None,
        place: Place | None = None,
    ) -> np.ndarray:
        """Pictures of the current states of a batch's simulations: (simulations, cameras, rows, columns, 3) uint8, a new array.

        Each simulation is drawn with its own colours, lights and cameras.

        Args:
            ids: simulations to draw, as numbers or as a mask (nsim,); None: all.
            place: called with a simulation's number and a copy of its data, whose positions it may change before it is drawn.

        Raises:
            TaccorlError: OpenGL is not available, or a model has other assets.
        """
        chosen = np.arange(batch.nsim) if ids is None else np.asarray(ids)
        if chosen.dtype == bool:
            chosen = np.flatnonzero(chosen)
        return self._draw(self._states(batch, chosen, place), len(chosen))

    def labels(self, data: mujoco.MjData) -> list[tuple[np.ndarray, np.ndarray]]:
        """For each camera, in their order: id of the geom that each pixel shows, (rows, columns) int32, −1 for none and in the
        black bars, and its depth [m] along the optical axis, (rows, columns), infinite where the id is −1.

        Required state and errors: as ``render``."""
        canvas, found = self._canvas(), []
        with canvas.current():
            for view in self._views:
                geoms, depth_m = (
                    np.full(self._shape, -1, np.int32),
                    np.full(self._shape, np.inf),
                )
                window = view.window
                inside = np.s_[
                    window.top : window.top + window.rows,
                    window.left : window.left + window.columns,
                ]
                geoms[inside], depth = canvas.labels(data.model, data, view)
                depth_m[inside] = np.where(geoms[inside] >= 0, depth, np.inf)
                found.append((geoms, depth_m))
        return found

    def _states(
        self, batch: Batch, ids: np.ndarray, place: Place | None
    ) -> Iterator[tuple[mujoco.MjModel, mujoco.MjData]]:
        if self._scratch is None or self._scratch[0] is not batch:
            self._scratch = (batch, batch.get_model(0), batch.get_data(0))
        _, model, data = self._scratch
        for sim in ids.tolist():
            batch.get_model(sim, model)
            batch.get_data(sim, data)
            if place:
                place(sim, data)
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(
                model, data
            )  # for cameras and lights that follow a centre of mass
            mujoco.mj_camlight(model, data)
            yield model, data

    def _draw(
        self, sims: Iterable[tuple[mujoco.MjModel, mujoco.MjData]], num_sims: int
    ) -> np.ndarray:
        out = np.zeros(
            (len(self._views), num_sims, *self._shape, 3), np.uint8
        )  # each camera's pictures are contiguous
        if out.size:
            canvas = self._canvas()
            with canvas.current():
                canvas.draw(sims, self._views, out)
        return out.swapaxes(0, 1)

    def _canvas(self) -> "Canvas":
        if self._gl is None:
            cell = (
                max(v.window.rows for v in self._views),
                max(v.window.columns for v in self._views),
            )
            self._gl = Canvas(self._model, cell, self._max_sheet_px)
        return self._gl

    @property
    def driver(self) -> str:
        """Name and version of the OpenGL renderer, for provenance."""
        return self._canvas().driver

    def close(self) -> None:
        """Free the OpenGL context. A later ``render`` makes a new one."""
        gl, self._gl, self._scratch = self._gl, None, None
        if gl is not None:
            gl.free()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def __del__(self) -> None:
        # When Python shuts down, OpenGL's modules may be gone already, and the process ends anyway.
        if not sys.is_finalizing() and getattr(self, "_gl", None) is not None:
            self.close()


def _view(model: mujoco.MjModel, name: str, shape: tuple[int, int]) -> View:
    index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, name)
    if index < 0:
        raise TaccorlError(
            f"no camera {name!r}; {nearest(name, (model.camera(i).name for i in range(model.ncam)))}"
        )
    camera = mujoco.MjvCamera()
    camera.type, camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, index
    columns, rows = (int(n) for n in model.cam_resolution[index])
    if (rows, columns) == (1, 1):  # MuJoCo's "not said": the camera fills the frame
        rows, columns = shape
    return View(camera, letterbox_window((rows, columns), shape))


TABLE = "table"  # geom that carries the working surface, and the material that `style` gives it


def style(spec: mujoco.MjSpec) -> None:
    """Set light, background and table so that parts are easy to distinguish. Physics does not change.

    Call it when table and parts are in. Two directional lights (no shadows) from unlike sides give each face of a box its
    own brightness; the table, if a geom of that name is there, gets a faint grain in its own colour, so that motion over
    it shows. Curved shapes are drawn with 20 × 10 facets (MuJoCo: 28 × 16): a third less work for a software renderer."""
    visual = spec.visual
    visual.quality.offsamples = visual.quality.shadowsize = 0
    visual.quality.numslices, visual.quality.numstacks = 20, 10
    visual.global_.offwidth, visual.global_.offheight = 1280, 960
    visual.headlight.ambient, visual.headlight.diffuse, visual.headlight.specular = (
        [0.30] * 3,
        [0.20] * 3,
        [0.0] * 3,
    )
    spec.stat.extent = 1.0  # [m]; the clipping distances are its multiples
    visual.map.znear, visual.map.zfar = 0.01, 10.0
    for name, direction, strength in (
        ("key", (-0.4, -0.6, -1.0), 0.55),
        ("fill", (0.5, 0.7, -0.6), 0.15),
    ):
        spec.worldbody.add_light(
            name=f"{name}_light",
            type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
            dir=direction,
            diffuse=[strength] * 3,
            ambient=[0.0] * 3,
            specular=[0.1] * 3,
            castshadow=False,
        )
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.62, 0.66, 0.70],
        rgb2=[0.30, 0.31, 0.33],
        width=32,
        height=192,
    )
    table = spec.geom(TABLE)
    if table is not None:
        table.material = _table_material(spec).name


def _table_material(spec: mujoco.MjSpec) -> mujoco.MjsMaterial:
    """A grey grain, 0.25 m wide and repeated, that multiplies the geom's own colour by 0.9 … 1."""
    size = 128
    coarse = np.random.default_rng(0).uniform(0.9, 1.0, (size // 8, size // 8))
    grain = np.kron(coarse, np.ones((8, 8)))
    texture = spec.add_texture(
        name=TABLE,
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        width=size,
        height=size,
        nchannel=3,
    )
    texture.data = np.repeat(
        np.round(255 * grain).astype(np.uint8)[..., None], 3, axis=-1
    ).tobytes()
    material = spec.add_material(
        name=TABLE, texuniform=True, texrepeat=[4, 4], specular=0.0
    )
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = TABLE
    return material

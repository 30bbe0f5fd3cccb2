"""OpenGL part of rendering: a context without a window, MuJoCo's drawing of one view, and a sheet on which many views are
collected.

No OpenGL library is loaded before the first picture is rendered.
"""

import contextlib
import copy
import ctypes
import os
import platform
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import mujoco
import numpy as np

from taccorl.errors import TaccorlError
from taccorl.lineage.processes import worker_number
from taccorl.sim.cameras import Window

# Debian 12, found by hiding one library after the other: the loader, and Mesa's driver for machines without a card.
# (libegl1 brings Mesa's EGL, libegl-mesa0, along; libGL itself is not needed.)
_DEBIAN_EGL = "libegl1 libgl1-mesa-dri"
_DEVICE = "MUJOCO_EGL_DEVICE_ID"
# The process that first made a context. Its drawing threads do not survive a fork, and Mesa would wait for them for ever.
_gl_process: int | None = None
_left_to_parent: list[
    Any
] = []  # contexts that a forked child inherited: freeing them there would wait as well


class View(NamedTuple):
    """One camera, and the area of the frame that its picture fills."""

    camera: mujoco.MjvCamera
    window: Window
    """Area of the frame that the picture fills [pixels]."""


class Canvas:
    """OpenGL buffers: MuJoCo's own buffer, as large as one view, and the sheet on which views are collected."""

    def __init__(
        self, model: mujoco.MjModel, cell: tuple[int, int], max_sheet_px: int
    ) -> None:
        self._process = os.getpid()
        self._cell = cell
        self._assets = _assets(model)
        self._sheet: _Sheet | None = None
        self._option = mujoco.MjvOption()
        self._option.sitegroup[:] = 0
        self._scene = mujoco.MjvScene(model, maxgeom=max(1, model.ngeom))
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
        self._context, self._mjr = _open(model, cell)
        with self.current():
            from OpenGL import GL

            self.driver = f"{_text(GL.GL_RENDERER)}, OpenGL {_text(GL.GL_VERSION)}"
            longest = min(
                max_sheet_px, int(GL.glGetIntegerv(GL.GL_MAX_RENDERBUFFER_SIZE))
            )
        self._most = (longest // cell[0], longest // cell[1])  # cells down and across
        if not all(self._most):
            self.free()
            raise TaccorlError(
                f"pictures of {cell[0]}×{cell[1]} pixels: the largest sheet here is {longest} wide"
            )

    @contextlib.contextmanager
    def current(self) -> Iterator[None]:
        """Context manager: make this OpenGL context current in this thread, and restore the previous one afterwards."""
        if self._process != os.getpid():
            raise _forked()
        with self._context.as_current():
            yield

    def draw(
        self,
        sims: Iterable[tuple[mujoco.MjModel, mujoco.MjData]],
        views: list[View],
        out: np.ndarray,
    ) -> None:
        """Render the views of each of ``sims`` (model, data) and write them to ``out`` (cameras, simulations, rows, columns, 3)
        uint8 RGB."""
        count = len(views) * out.shape[1]
        sheet = self._sheet_for(count)
        first = held = 0
        for model, data in sims:
            if _assets(model) != self._assets:
                raise TaccorlError(
                    f"a simulation's model has {_assets(model)} geoms, meshes, textures and materials, but the renderer's "
                    f"model has {self._assets}: make a renderer for each such model"
                )
            for view in views:
                self._draw_view(model, data, view)
                sheet.keep(held, self._mjr)
                held += 1
                if held == sheet.capacity or first + held == count:
                    _deal(sheet.read(held, self._mjr), views, out, first)
                    first, held = first + held, 0

    def _draw_view(
        self, model: mujoco.MjModel, data: mujoco.MjData, view: View
    ) -> None:
        # Without decoration (contacts, tendons …), as without sites above: no camera sees them.
        seen = mujoco.mjtCatBit.mjCAT_STATIC | mujoco.mjtCatBit.mjCAT_DYNAMIC
        mujoco.mjv_updateScene(
            model, data, self._option, None, view.camera, seen, self._scene
        )
        mujoco.mjr_render(
            mujoco.MjrRect(0, 0, view.window.columns, view.window.rows),
            self._scene,
            self._mjr,
        )

    def labels(
        self, model: mujoco.MjModel, data: mujoco.MjData, view: View
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the id of the geom that each pixel of a view's window shows, (rows, columns) int32, −1 for none, and its depth
        along the optical axis, (rows, columns) float64 [m]."""
        flags, rows, columns = (
            self._scene.flags.copy(),
            view.window.rows,
            view.window.columns,
        )
        self._scene.flags[
            [int(mujoco.mjtRndFlag.mjRND_SEGMENT), int(mujoco.mjtRndFlag.mjRND_IDCOLOR)]
        ] = 1
        try:
            self._draw_view(model, data, view)
        finally:
            self._scene.flags[:] = flags
        color, depth = (
            np.empty((rows, columns, 3), np.uint8),
            np.empty((rows, columns), np.float32),
        )
        self._mjr.readDepthMap = int(
            mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        )  # reversed, as it is kept: nothing is lost
        mujoco.mjr_readPixels(
            color, depth, mujoco.MjrRect(0, 0, columns, rows), self._mjr
        )
        shown = self._scene.geoms[: self._scene.ngeom]
        geom_of = np.full(len(shown) + 1, -1, np.int32)
        geom_of[[geom.segid + 1 for geom in shown]] = [geom.objid for geom in shown]
        number = color.astype(np.int32) @ np.array([1, 1 << 8, 1 << 16], np.int32)
        near, far = (
            float(z) * model.stat.extent
            for z in (model.vis.map.znear, model.vis.map.zfar)
        )
        depth_m = near * far / (near + depth.astype(float) * (far - near))
        return geom_of[number[::-1]], depth_m[::-1]

    def _sheet_for(self, num_views: int) -> "_Sheet":
        """Sheet for ``num_views`` views, or for the most that one sheet can hold."""
        across = min(num_views, self._most[1])
        down = min(-(-num_views // across), self._most[0])
        if self._sheet is None or self._sheet.capacity < down * across:
            if self._sheet is not None:
                self._sheet.free()
            self._sheet = _Sheet(self._cell, down, across)
            mujoco.mjr_restoreBuffer(self._mjr)
        return self._sheet

    def free(self) -> None:
        """Free the OpenGL context and its buffers."""
        if self._process != os.getpid():
            _left_to_parent.append((self._context, self._mjr))
            return
        with self.current():
            if self._sheet is not None:
                self._sheet.free()
            self._mjr.free()
        self._context.free()


class _Sheet:
    """A colour buffer on the GPU with ``down`` × ``across`` cells, filled row by row from the bottom left.

    Views are copied here, not drawn here: the place of a viewport enters the rounding of every vertex, so that a picture
    would depend on its neighbours (measured on llvmpipe: 85 of 96 pictures differed, by 459 pixels in all)."""

    def __init__(self, cell: tuple[int, int], down: int, across: int) -> None:
        from OpenGL import GL

        self._gl, self._cell, self._across, self.capacity = (
            GL,
            cell,
            across,
            down * across,
        )
        self._pixels = np.empty((down * cell[0], across * cell[1], 3), np.uint8)
        self._color, self._frame = GL.glGenRenderbuffers(1), GL.glGenFramebuffers(1)
        GL.glBindRenderbuffer(GL.GL_RENDERBUFFER, self._color)
        GL.glRenderbufferStorage(
            GL.GL_RENDERBUFFER, GL.GL_RGBA8, across * cell[1], down * cell[0]
        )
        GL.glBindFramebuffer(GL.GL_FRAMEBUFFER, self._frame)
        GL.glFramebufferRenderbuffer(
            GL.GL_FRAMEBUFFER, GL.GL_COLOR_ATTACHMENT0, GL.GL_RENDERBUFFER, self._color
        )

    def keep(self, number: int, mjr: mujoco.MjrContext) -> None:
        """Copy what lies in MuJoCo's buffer to cell ``number``."""
        gl, (rows, columns) = self._gl, self._cell
        x, y = number % self._across * columns, number // self._across * rows
        gl.glBindFramebuffer(gl.GL_DRAW_FRAMEBUFFER, self._frame)
        gl.glBlitFramebuffer(
            0,
            0,
            columns,
            rows,
            x,
            y,
            x + columns,
            y + rows,
            gl.GL_COLOR_BUFFER_BIT,
            gl.GL_NEAREST,
        )
        gl.glBindFramebuffer(gl.GL_DRAW_FRAMEBUFFER, mjr.offFBO)

    def read(self, count: int, mjr: mujoco.MjrContext) -> list[np.ndarray]:
        """The pictures in the first ``count`` cells, upright: for each row of the sheet an array (cells, rows, columns, 3). They
        are views of a buffer that the next call overwrites."""
        gl, (rows, columns), across = self._gl, self._cell, min(count, self._across)
        shape = (-(-count // across) * rows, across * columns, 3)
        pixels = self._pixels.reshape(-1)[: np.prod(shape)].reshape(shape)
        gl.glBindFramebuffer(gl.GL_READ_FRAMEBUFFER, self._frame)
        gl.glPixelStorei(gl.GL_PACK_ALIGNMENT, 1)
        gl.glReadPixels(
            0,
            0,
            pixels.shape[1],
            pixels.shape[0],
            gl.GL_RGB,
            gl.GL_UNSIGNED_BYTE,
            pixels,
        )
        mujoco.mjr_restoreBuffer(mjr)
        strips = pixels.reshape(-1, rows, across, columns, 3)[:, ::-1].swapaxes(
            1, 2
        )  # OpenGL's rows go upwards
        return [strip[: count - i * across] for i, strip in enumerate(strips)]

    def free(self) -> None:
        self._gl.glDeleteFramebuffers(1, [self._frame])
        self._gl.glDeleteRenderbuffers(1, [self._color])


def _deal(
    strips: list[np.ndarray], views: list[View], out: np.ndarray, first: int
) -> None:
    """Put cells, the first of which is view ``first`` of all simulations' views, into their cameras' windows of ``out``, as
    ``Canvas.draw`` has it; bars stay black."""
    for cells in strips:
        for number, view in enumerate(views):
            mine, window = (number - first) % len(views), view.window
            drawn = cells[
                mine :: len(views), -window.rows :, : window.columns
            ]  # into the cell's lower left
            frames = out[number, (first + mine) // len(views) :][: len(drawn)]
            frames[
                :,
                window.top : window.top + window.rows,
                window.left : window.left + window.columns,
            ] = drawn
        first += len(cells)


def _text(name: Any) -> str:
    from OpenGL import GL

    return (GL.glGetString(name) or b"unknown").decode()


def _assets(model: mujoco.MjModel) -> tuple[int, int, int, int]:
    return model.ngeom, model.nmesh, model.ntex, model.nmat


def _open(
    model: mujoco.MjModel, cell: tuple[int, int]
) -> tuple[Any, mujoco.MjrContext]:
    """An OpenGL context and MuJoCo's resources in it, with an off-screen buffer of one view. Raises TaccorlError: names what is
    missing."""
    global _gl_process
    if _gl_process not in (None, os.getpid()):
        raise _forked()
    plain = copy.copy(model)
    plain.vis.global_.offwidth, plain.vis.global_.offheight = cell[1], cell[0]
    plain.vis.quality.offsamples = plain.vis.quality.shadowsize = (
        0  # no multisampling, no shadows
    )
    wanted = os.environ.get("MUJOCO_GL", "").strip().lower()
    if wanted in ("disable", "disabled", "off", "false", "0"):
        raise TaccorlError(
            f"pictures: MUJOCO_GL={wanted} switches OpenGL off: unset it, or request no images"
        )
    try:
        context = _new_context(wanted, cell)
        _gl_process = os.getpid()
        with context.as_current():
            mjr = mujoco.MjrContext(plain, mujoco.mjtFontScale.mjFONTSCALE_50)
            mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, mjr)
    except Exception as error:  # PyOpenGL fails in many ways: ImportError, AttributeError of None, GLError …
        raise TaccorlError(_missing(wanted, error)) from error
    return context, mjr


def _context_class(wanted: str) -> Any:
    """MuJoCo's context class for MUJOCO_GL=``wanted``; EGL, which needs no display, where nothing is wanted."""
    if wanted == "osmesa":
        from mujoco.osmesa import GLContext
    elif wanted in ("", "egl") and platform.system() == "Linux":
        from mujoco.egl import GLContext
    else:
        from mujoco.rendering.classic.gl_context import GLContext
    return GLContext


def _new_context(wanted: str, cell: tuple[int, int]) -> Any:
    """A context of MuJoCo's class. Where EGL offers several NVIDIA cards, worker processes take them in turn (``worker_number``):
    MuJoCo takes the first in all. MUJOCO_EGL_DEVICE_ID and CUDA_VISIBLE_DEVICES hold for both."""
    make, number = _context_class(wanted), worker_number()
    is_free = make.__module__ == "mujoco.egl" and _DEVICE not in os.environ
    if is_free and number is not None and (cards := _num_cards()) > 1:
        os.environ[_DEVICE] = str(number % cards)
        try:
            return make(cell[1], cell[0])
        except Exception:  # a card of the host that is not for this container, say: MuJoCo looks for one that is
            pass
        finally:
            del os.environ[_DEVICE]
    return make(cell[1], cell[0])


def _num_cards() -> int:
    """Number of NVIDIA cards that EGL offers, and of those that CUDA_VISIBLE_DEVICES names if it does."""
    from mujoco.egl import egl_ext

    cards = 0
    for device in egl_ext.eglQueryDevicesEXT():
        with contextlib.suppress(
            Exception
        ):  # PyOpenGL's, for a device without CUDA, such as Mesa's
            egl_ext.eglQueryDeviceAttribEXT(device, egl_ext.EGL_CUDA_DEVICE_NV)
            cards += 1
    visible = [
        card
        for card in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",")
        if card.strip().isdecimal()
    ]
    return min(cards, len(visible) or cards)


def _missing(wanted: str, error: Exception) -> str:
    platform_set = os.environ.get("PYOPENGL_PLATFORM", "")
    if wanted == "osmesa":
        what, remedy = (
            "no OpenGL through OSMesa (MUJOCO_GL=osmesa)",
            "On Debian: apt-get install libosmesa6",
        )
    elif wanted not in ("", "egl"):
        what, remedy = (
            f"no OpenGL through a window (MUJOCO_GL={wanted})",
            "MUJOCO_GL=egl needs no display",
        )
    elif platform_set not in ("", "egl"):
        what, remedy = f"PYOPENGL_PLATFORM={platform_set} keeps EGL out", "Unset it"
    else:
        what = "EGL opens neither a graphics card nor a driver that draws in software"
        try:
            ctypes.CDLL("libEGL.so.1")
        except OSError:
            what = "libEGL.so.1 is not installed"
        remedy = f"On Debian: apt-get install {_DEBIAN_EGL}, or the EGL part of NVIDIA's driver"
    said = str(error).strip().split("\n")[0]
    return (
        f"pictures cannot be drawn: {what}. {remedy}. Everything but images works without. "
        f"({type(error).__name__}: {said})"
    )


def _forked() -> TaccorlError:
    return TaccorlError(
        "pictures were drawn before this process was forked, and OpenGL does not survive a fork: start workers before the "
        'first picture, or with multiprocessing.get_context("spawn")'
    )

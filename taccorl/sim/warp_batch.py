"""``mujoco.batch.Batch`` whose physics steps are MuJoCo Warp's, on a GPU: float32, all worlds in each kernel.

Resets, placed scenes and constants of the model are MuJoCo C's; ``step`` copies what has changed to the device, runs there, and
copies back what is bound. MuJoCo Warp and Torch are imported at the first use. Letters in shapes: N simulations ("worlds").
"""

import copy
import dataclasses
import re
from collections.abc import Callable, Mapping
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import MODEL_FIELDS, Batch

from taccorl.errors import TaccorlError, nearest
from taccorl.extras import OnUse, require
from taccorl.sim.rendering import TABLE

mjw: Any = OnUse("mujoco_warp")
wp: Any = OnUse("warp")
torch: Any = OnUse("torch")
kernels: Any = OnUse("taccorl.sim.warp_kernels")

_INPUTS = (
    "ctrl",
    "qfrc_applied",
    "xfrc_applied",
    "mocap_pos",
    "mocap_quat",
    "eq_active",
)
_STATE = ("qpos", "qvel", "act", "history", "qacc_warmstart", *_INPUTS)
_NONE = mujoco.mjtStage.mjSTAGE_NONE.value
_LARGEST = 1e10  # mjMAXVAL: beyond it MuJoCo C warns of a bad state
_BAD_STATE = int(mujoco.mjtWarning.mjWARN_BADQACC)
_ROWS = 16
"""MuJoCo Warp 4.0.0 pads rows of constraints to this, and reads beyond the others when more are needed (constraint.py,
``_regularize_constraint``): without padding it counts them, and ``overflow`` reports it."""
_FEW = (16, 64)  # worlds whose memory is measured
_WAY_OUT = "use physics=c"
MODES = ("copied", "resident")
"""Values of ``WarpSettings.mode``."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class WarpSettings:
    """Device and sizes of buffers of MuJoCo Warp: what follows the colon in ``warp:device=cuda:1,contacts=128``."""

    device: str = "cuda:0"
    """Warp's name of the device; ``cpu`` is slow, for trials without a GPU."""
    contacts: int = 64
    """Contacts, and pairs of geoms close to each other, for which each world has room; worlds share the sum. The experts of the
    four tasks need up to 23."""
    constraints: int = 576
    """Rows of the constraint solver for which each world has room. Experts need up to 94, a learnt policy of the puzzle 283."""
    iterations: int = 0
    """Most iterations of the constraint solver in a step; 0: the model's own limit. All worlds wait for the one that needs most:
    the mean is 1.8. A world that reaches the limit goes on with what it has, as in MuJoCo C."""
    mode: str = "copied"
    """What stays on the device. copied: states are copied back five times a control step, OpenGL draws. resident: a control step
    is one launch, and MuJoCo Warp's ray tracer draws; states and pictures were those of the copied mode on an H200, but of
    192 scenes a weak policy completed fewer (docs/training.md)."""

    @classmethod
    def parse(cls, physics: str) -> "WarpSettings | None":
        """Settings of ``physics``; None for MuJoCo C (``c``). Raises TaccorlError: neither ``c`` nor ``warp[:key=value,…]``."""
        kind, _, options = physics.partition(":")
        if physics == "c":
            return None
        if kind != "warp":
            raise TaccorlError(f"physics={physics}: {nearest(physics, ('c', 'warp'))}")
        values: dict[str, Any] = {}
        for option in filter(None, options.split(",")):
            key, _, value = option.partition("=")
            names = [f.name for f in dataclasses.fields(cls)]
            if key not in names:
                raise TaccorlError(
                    f"physics={physics}: no setting {key!r}; {nearest(key, names)}"
                )
            is_text = key in ("device", "mode")
            if not is_text and not (value.isdecimal() and int(value) > 0):
                raise TaccorlError(
                    f"physics={physics}: {key}={value!r} is no whole number ≥ 1"
                )
            if key == "mode" and value not in MODES:
                raise TaccorlError(
                    f"physics={physics}: mode={value!r}; {nearest(value, MODES)}"
                )
            values[key] = value if is_text else int(value)
        return cls(**values)


def make_batch(
    model: mujoco.MjModel, num_sims: int, num_threads: int, physics: str = "c"
) -> Batch:
    """Physics of ``num_sims`` simulations of ``model``: ``c``, or ``warp`` with the settings of ``WarpSettings``.

    Raises:
        TaccorlError: unknown physics or settings; for ``warp`` also: the extra is not installed, there is no such device, its
            memory is too small, or MuJoCo Warp does not support something in the model (``Unsupported``).
    """
    settings = WarpSettings.parse(physics)
    if settings is None:
        return Batch(model, num_sims, num_threads)
    return WarpBatch(model, num_sims, num_threads, settings=settings)


class Unsupported(TaccorlError):
    """A model that MuJoCo Warp cannot run."""


def check_supported(model: mujoco.MjModel) -> None:
    """Raises Unsupported: MuJoCo Warp does not support something in the model."""
    try:
        with wp.ScopedDevice("cpu"):
            mjw.put_model(_for_warp(model))
    except (NotImplementedError, ValueError) as error:
        what = (
            ", ".join(sorted(set(re.findall(r"mj\w+", str(error))))) or error
        )  # its lists name each actuator
        raise Unsupported(
            f"physics=warp: MuJoCo Warp does not support {what}; {_WAY_OUT}"
        ) from error


def _for_warp(model: mujoco.MjModel) -> mujoco.MjModel:
    """``model`` without the flag that MuJoCo Warp does not know (it never resets a diverged world by itself), and with the one by
    which its boxes collide as in MuJoCo C (``mjc_BoxBox``); without it their normals are those of another algorithm. The table is
    a plane, without edges: of a cylinder 1 … 10 µm deep in so large a box MuJoCo Warp 4.0.0 finds no contact in 7 % of 20 000
    poses, and in 6 of them one 0.9 m deep, which throws the part off. MuJoCo Warp chooses its own form of the Jacobian, sparse
    from 33 degrees of freedom on; so it agreed with MuJoCo C to 2e-5 rad (``.ci/gpu/replayed.py``)."""
    model, flags = copy.copy(model), mujoco.mjtDisableBit
    model.opt.jacobian = mujoco.mjtJacobian.mjJAC_AUTO
    model.opt.disableflags = model.opt.disableflags & ~int(
        flags.mjDSBL_AUTORESET
    ) | int(flags.mjDSBL_NATIVECCD)
    if (table := mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, TABLE)) >= 0:
        model.geom_pos[table, 2] += model.geom_size[table, 2]
        model.geom_type[table], model.geom_rbound[table] = (
            mujoco.mjtGeom.mjGEOM_PLANE,
            0.0,
        )
    return model


class WarpBatch(Batch):
    """N worlds on a device behind the interface of ``Batch``; ``nthread`` threads for what MuJoCo C does.

    After ``step`` with ``mjSTAGE_NONE`` the arrays are not refreshed, except for clocks, until the next ``step`` with a stage, or
    ``refresh``: worlds stay on the device, and of what is written to the arrays only controls and forces reach it. A world that
    diverges is a NaN for itself: its ``warning`` counts it, and from the next step on its place on the device computes a copy of
    a sound world. So does one in which MuJoCo Warp gave up a contact of two convex shapes."""

    def __init__(
        self,
        model: mujoco.MjModel,
        nsim: int,
        nthread: int = 0,
        *,
        settings: WarpSettings,
    ) -> None:
        super().__init__(model, nsim, nthread)
        self.settings = settings
        open_device(settings.device)
        check_supported(model)
        if settings.constraints < model.nv:  # friction and limits alone
            raise TaccorlError(
                f"physics=warp:constraints={settings.constraints}: at least {model.nv} here"
            )
        self._columns = {
            name: flat for name in _STATE if (flat := self._flat(self.bind(name))).size
        }
        self._time_s = self.bind("time")
        self._moving = np.flatnonzero(model.body_weldid[model.geom_bodyid] > 0)
        """Geoms that may move. The others keep the poses of MuJoCo C: the device has another table (``_for_warp``)."""
        self._world: _Worlds | None = None
        self._lost = np.ones(nsim, dtype=bool)
        """(N,) bool: the device has another state than the simulation."""
        self._behind = np.zeros(nsim, dtype=bool)
        """(N,) bool: the arrays have an older state than the device."""
        self._partial = np.zeros(nsim, dtype=bool)
        """(N,) bool: only some of the derived fields are of the device's state."""
        self._unsound = np.ones(nsim, dtype=bool)
        """(N,) bool: the device's state is NaN, or none of the twin's."""
        self._refreshed_s = np.zeros(nsim)
        """(N,) clocks [s] of the arrays of worlds that are ``_behind``."""
        self._known: dict[str, np.ndarray] = {}
        """What the device was told of states and of the model: name → (N, …)."""
        self._varied: dict[str, np.ndarray] | None = None

    @property
    def is_resident(self) -> bool:
        """True if a control step is one launch, and the device draws."""
        return self.settings.mode == "resident"

    def _flat(self, values: np.ndarray) -> np.ndarray:
        return values.reshape(self.nsim, -1)

    # interface of Batch -------------------------------------------------------------------------------------------------

    def bind(self, name: str) -> np.ndarray:
        """As ``Batch.bind``: (N, …). Raises TaccorlError: MuJoCo Warp does not compute the field."""
        if name not in mjw.Data.__dataclass_fields__:
            raise TaccorlError(
                f"physics=warp: MuJoCo Warp has no field {name}; {_WAY_OUT}"
            )
        return super().bind(name)

    def expand(self, name: str) -> np.ndarray:
        """As ``Batch.expand``: (N, …). Raises TaccorlError: the field is the same in all of MuJoCo Warp's worlds."""
        if not _varies(name):
            raise TaccorlError(
                f"physics=warp: {name} must be the same in all worlds of MuJoCo Warp, but this twin varies it; {_WAY_OUT}"
            )
        self._varied = None
        return super().expand(name)

    def set_const(self, ids: Any = None) -> None:
        """As ``Batch.set_const``, by MuJoCo C."""
        super().set_const(ids)
        self._varied = None

    def reset(self, ids: Any = None, *arguments: Any, **named: Any) -> None:
        """As ``Batch.reset``, by MuJoCo C."""
        self._overwritten(ids)
        super().reset(ids, *arguments, **named)

    def forward(self, ids: Any = None, *arguments: Any, **named: Any) -> None:
        """As ``Batch.forward``, by MuJoCo C."""
        self._pull_state(self._behind & self._mask(ids))
        super().forward(ids, *arguments, **named)

    def step(self, ids: Any = None, nstep: int = 1, stage: int = _NONE) -> None:
        """As ``Batch.step``, by MuJoCo Warp.

        Raises:
            TaccorlError: more contacts or constraints than the buffers hold; the message states the setting to raise. The
                worlds are then as they were when they were last refreshed.
        """
        is_refreshed = int(stage) != _NONE

        def work(worlds: "_Worlds", run: np.ndarray) -> None:
            worlds.run(nstep, refresh=is_refreshed)

        fields = dict.fromkeys(self._bound) if is_refreshed else {}
        self._advance(ids, nstep, work, fields, with_state=is_refreshed)

    def step_targets(
        self,
        ids: Any,
        columns: np.ndarray,
        targets_SNA: np.ndarray,
        nstep: int,
        fields: Mapping[str, np.ndarray] | None = None,
    ) -> None:
        """S times: write ``targets_SNA[s]`` into the controls ``columns`` (A,) and take ``nstep`` physics steps. One launch and
        one wait for all of it; the model's sensors are computed once, at the end.

        Args:
            ids: simulations that step, as in ``Batch.step``; their rows of ``targets_SNA`` (S, N, A) are used.
            fields: derived fields that are current afterwards, among those that are bound → which of their rows (bodies,
                sites, numbers of sensors) in each simulation; the states stay on the device, as after a ``step`` with
                ``mjSTAGE_NONE``. None: all of them, and the states.

        Raises:
            TaccorlError: as ``step``.
        """

        def work(worlds: "_Worlds", run: np.ndarray) -> None:
            worlds.run_targets(columns, targets_SNA, nstep)
            controls = self._columns["ctrl"]
            rows = np.flatnonzero(run)
            controls[rows[:, None], columns] = targets_SNA[-1][rows]
            self._known["ctrl"][run] = controls[run]

        chosen = dict.fromkeys(self._bound) if fields is None else fields
        num = nstep * len(targets_SNA)
        self._advance(ids, num, work, chosen, with_state=fields is None)

    def _advance(
        self,
        ids: Any,
        num_steps: int,
        work: Callable[["_Worlds", np.ndarray], None],
        fields: Mapping[str, np.ndarray | None],
        *,
        with_state: bool,
    ) -> None:
        """Take ``num_steps`` physics steps by ``work``, then copy ``fields`` back, and with ``with_state`` the states."""
        chosen = self._mask(ids)
        sound = np.isfinite(self._columns["qpos"]).all(1) & np.isfinite(
            self._columns["qvel"]
        ).all(1)
        run = chosen & sound
        if run.any():
            self._pull(self._behind & ~run)
            worlds = self._worlds()
            self._push(worlds, run)
            self._park(worlds, ~run, int(np.argmax(run)))
            self._fitting(lambda: work(worlds, run))
            self._lost |= ~run
            finite = worlds.finite()
            full, unfound = worlds.overflow(run & finite)
            if full:
                self._time_s[self._behind] = self._refreshed_s[self._behind]
                self._lost[:], self._behind[:] = True, False
                raise TaccorlError(full)
            self._lost &= ~run
            self._tick(run, num_steps)
            self._unsound = bad = ~finite | unfound
            self._behind |= run
            self._pull_state(run if with_state else run & bad)
            self._pull_fields(worlds, run, fields)
            self._partial[run] = bool(fields) and not with_state
            self._lost |= bad
            sound &= ~bad
        self.warning[chosen & ~sound, _BAD_STATE, 1] += 1

    def refresh(self) -> None:
        """Copy what steps left on the device: the states of all worlds, and the derived fields that ``step_targets`` was not
        asked for."""
        self._pull(self._behind)

    def tensor(self, name: str) -> Any:
        """The device's own values of a field of ``mujoco.MjData`` as a Torch tensor (N, …) of float32, not a copy; for reading.
        Raises TaccorlError: MuJoCo Warp does not compute the field."""
        self.bind(name)
        return self._worlds().tensor(name)

    # between host and device ---------------------------------------------------------------------------------------------

    def _mask(self, ids: Any) -> np.ndarray:
        chosen = np.zeros(self.nsim, dtype=bool)
        chosen[slice(None) if ids is None else ids] = True
        return chosen

    def _overwritten(self, ids: Any) -> None:
        rows = self._mask(ids)
        self._lost |= rows & self._behind
        self._behind &= ~rows

    def _tick(self, run: np.ndarray, nstep: int) -> None:
        """Clocks are MuJoCo C's: a float32 loses a step within minutes."""
        fresh, time_s = run & ~self._behind, self._time_s[run]
        self._refreshed_s[fresh] = self._time_s[fresh]
        for _ in range(nstep):
            time_s += self.model.opt.timestep
        self._time_s[run] = time_s

    def _worlds(self) -> "_Worlds":
        """The worlds on the device, made anew when another field of the model varies between them."""
        if self._varied is None:
            of_model = {
                name: self.expanded(name) for name in MODEL_FIELDS if _varies(name)
            }
            self._varied = {
                name: self._flat(values)
                for name, values in of_model.items()
                if values is not None
            }
        varied = self._varied
        if self._world is None or self._world.varied != varied.keys():
            self._pull_state(self._behind)
            self._world = None
            self._world = self._fitting(
                lambda: _Worlds(
                    _for_warp(self.model), self.nsim, self.settings, list(varied)
                )
            )
            self._lost[:] = self._unsound[:] = True
            of_state = {
                name: np.zeros_like(values) for name, values in self._columns.items()
            }
            self._known = of_state | {
                name: np.full_like(values, np.nan) for name, values in varied.items()
            }
        return self._world

    def _fitting[T](self, work: Callable[[], T]) -> T:
        """What ``work`` returns. Raises TaccorlError: it needs more memory than the device has; the message says how many worlds
        fit, from the peak memory of steps of a few."""
        try:
            return work()
        except RuntimeError as error:
            if not re.search("alloc|memory", str(error)):
                raise
            fault = error
        if self._world is not None:
            vars(self._world).clear()  # its memory, whoever holds it
        self._world, device = None, wp.get_device(self.settings.device)
        wp.synchronize_device(device)
        model, free_mb = _for_warp(self.model), device.free_memory / 2**20
        peaks_mb = np.array(
            [
                _peak_mb(lambda n=n: _Worlds(model, n, self.settings, []).run(1))
                for n in _FEW
            ]
        )
        each_mb = np.diff(peaks_mb)[0] / np.diff(_FEW)[0]
        raise TaccorlError(
            f"physics=warp: {self.nsim} worlds do not fit the memory of {self.settings.device} ({fault}): about "
            f"{free_mb / each_mb:.0f} fit, at {each_mb:.2g} MB each. Lower the number of environments, contacts or constraints"
        ) from fault

    def _push(self, worlds: "_Worlds", run: np.ndarray) -> None:
        lost, current = run & self._lost, run & ~self._behind
        for name, values in self._columns.items():
            may = run if name in _INPUTS else current
            rows = (
                may & (values != self._known[name]).any(1) | lost if may.any() else lost
            )
            self._write(worlds, worlds.tensor(name), name, rows, values)
        if current.any():
            for name, values in (self._varied or {}).items():
                self._write(
                    worlds,
                    worlds.of_model[name],
                    name,
                    (values != self._known[name]).any(1),
                    values,
                )
        worlds.write(worlds.tensor("time"), run, self._time_s)
        self._unsound &= ~run

    def _write(
        self,
        worlds: "_Worlds",
        tensor: Any,
        name: str,
        rows: np.ndarray,
        values: np.ndarray,
    ) -> None:
        if rows.any():
            worlds.write(tensor, rows, values)
            self._known[name][rows] = values[rows]

    def _park(self, worlds: "_Worlds", rows: np.ndarray, sound: int) -> None:
        """Places of worlds that do not step, and hold no state that could, get a copy of world ``sound``."""
        rows = rows & self._unsound
        if rows.any():
            for name in self._columns:
                worlds.copy_row(worlds.tensor(name), sound, rows)
            self._unsound &= ~rows

    def _pull(self, rows: np.ndarray) -> None:
        """States of ``rows`` (N,) bool, and those derived fields of theirs that are older."""
        partial = rows & self._partial
        if partial.any() and self._world is not None:
            self._pull_fields(self._world, partial, dict.fromkeys(self._bound))
            self._partial &= ~partial
        self._pull_state(rows)

    def _pull_state(self, rows: np.ndarray) -> None:
        if rows.any() and self._world is not None:
            for name, values in self._columns.items():
                if name not in _INPUTS:
                    self._world.read(self._world.tensor(name), rows, values)
                    self._known[name][rows] = values[rows]
            self._behind &= ~rows

    def _pull_fields(
        self,
        worlds: "_Worlds",
        rows: np.ndarray,
        fields: Mapping[str, np.ndarray | None],
    ) -> None:
        for name, parts in fields.items():
            values = self._bound[name]
            if parts is None and name.startswith("geom_"):
                parts = self._moving
            values.flags.writeable = True
            worlds.read(worlds.tensor(name), rows, values, parts)
            values.flags.writeable = False


class _Worlds:
    """Model and states on the device, Torch's views of them, and the captured graphs of steps."""

    def __init__(
        self,
        model: mujoco.MjModel,
        num_worlds: int,
        settings: WarpSettings,
        varied: list[str],
    ) -> None:
        self.varied = set(varied)
        self._settings, self._num = settings, num_worlds
        self._device = wp.get_device(settings.device)
        with wp.ScopedDevice(self._device):
            self._model = mjw.put_model(
                model, batch_sizes=dict.fromkeys(varied, num_worlds)
            )
            self._model.opt.warn_overflow = False  # ``overflow`` reads it
            # of one world, where ``contacts`` is a mean over worlds
            self._model.opt.contact_sensor_maxmatch = max(
                self._model.opt.contact_sensor_maxmatch, settings.contacts
            )
            if settings.iterations:
                self._model.opt.iterations = settings.iterations
            if self._device.is_cuda and not wp.is_conditional_graph_supported():
                self._model.opt.graph_conditional = False  # a driver before CUDA 12.4
            self._data = self._allocate(model)
        self.of_model = {
            name: wp.to_torch(getattr(self._model, name)) for name in varied
        }
        self._index_of: tuple[bytes, Any] = (b"", None)
        self._tensors: dict[str, Any] = {}
        self._graphs: dict[tuple[Any, ...], Any] = {}
        self._quiet = self._without_sensors()
        self._targets: Any = None

    def _allocate(self, model: mujoco.MjModel) -> Any:
        rows = -(-self._settings.constraints // _ROWS) * _ROWS
        return mjw.make_data(
            model, nworld=self._num, nconmax=self._settings.contacts, njmax=rows
        )

    def tensor(self, name: str) -> Any:
        """Torch's view (N, …) of a field of the device's data."""
        if name not in self._tensors:
            self._tensors[name] = wp.to_torch(getattr(self._data, name))
        return self._tensors[name]

    def _without_sensors(self) -> Any:
        """The model for steps whose sensors nobody reads; it shares all arrays. Delayed sensors need every step."""
        if self._model.nhistory:
            return self._model
        quiet = copy.copy(self._model)
        quiet.opt = copy.copy(self._model.opt)
        quiet.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
        return quiet

    def run(self, nstep: int, *, refresh: bool | None = None) -> None:
        """``nstep`` physics steps, then with ``refresh`` what follows from the new positions and velocities; on a GPU as a
        captured graph, but for ``refresh=None``."""
        if refresh is None:
            with wp.ScopedDevice(self._device):
                self._steps(nstep, False)
            return
        self._launch((nstep, refresh), lambda: self._steps(nstep, refresh))

    def run_targets(
        self, columns: np.ndarray, targets_SNA: np.ndarray, nstep: int
    ) -> None:
        """S times: write a target into the controls ``columns`` (A,) of all worlds, then ``nstep`` steps; at the end what
        follows from the new positions and velocities."""
        with wp.ScopedDevice(self._device):
            new = wp.array(np.ascontiguousarray(targets_SNA, np.float32), dtype=float)
            if self._targets is None or self._targets.shape != new.shape:
                self._targets = wp.clone(new)
                self._columns = wp.array(columns.astype(np.int32), dtype=int)
            else:
                wp.copy(self._targets, new)
            wp.synchronize_device(self._device)

        def work() -> None:
            for s in range(len(targets_SNA)):
                wp.launch(
                    kernels.put_targets,
                    dim=self._targets.shape[1:],
                    inputs=[self._targets, s, self._columns],
                    outputs=[self._data.ctrl],
                )
                for _ in range(nstep):
                    mjw.step(self._quiet, self._data)
            mjw.forward(self._model, self._data)

        self._launch(("targets", len(targets_SNA), nstep), work)

    def _launch(self, key: tuple[Any, ...], work: Callable[[], None]) -> None:
        """Do ``work``, and wait; on a GPU as a captured graph, which ``key`` names."""
        with wp.ScopedDevice(self._device):
            if not self._device.is_cuda:
                work()
                return
            torch.cuda.synchronize(self._settings.device)
            if key not in self._graphs:
                self._graphs[key] = self._captured(work)
            wp.capture_launch(self._graphs[key])
            wp.synchronize_device(self._device)

    def _steps(self, nstep: int, refresh: bool) -> None:
        for _ in range(nstep):
            mjw.step(self._model, self._data)
        if refresh:
            mjw.forward(self._model, self._data)

    def _captured(self, work: Callable[[], None]) -> Any:
        """Graph of ``work``. All kernels are compiled first: what they change of the state is put back."""
        tensors = [
            self.tensor(name)
            for name in ("time", *_STATE)
            if getattr(self._data, name).size
        ]
        kept = [(tensor, tensor.clone()) for tensor in tensors]
        # Torch and Warp have streams of their own
        torch.cuda.synchronize(self._settings.device)
        work()
        wp.synchronize_device(self._device)
        for tensor, values in kept:
            tensor.copy_(values)
        self._data.overflow.zero_()
        torch.cuda.synchronize(self._settings.device)
        with wp.ScopedCapture() as capture:
            work()
        return capture.graph

    def finite(self) -> np.ndarray:
        """(N,) bool: positions and velocities are numbers that MuJoCo C, too, would accept."""
        of_state = self.tensor("qpos"), self.tensor("qvel")
        if (
            not self._device.is_cuda
        ):  # Torch's threads wait for each other on a busy machine
            of_state = of_state[0].numpy(), of_state[1].numpy()
        ok = [(abs(values) < _LARGEST).all(1) for values in of_state]
        return np.asarray(
            (ok[0] & ok[1]).cpu() if self._device.is_cuda else ok[0] & ok[1]
        )

    def overflow(self, run: np.ndarray) -> tuple[str, np.ndarray]:
        """Text of which buffer was too small in one of the worlds ``run`` (N,) bool, if one was; and (N,) bool: those of them in
        which a contact of two convex shapes was not found, which no setting helps. The flags are cleared."""
        kinds, flags = mjw.OverflowType, self._data.overflow.numpy()
        unfound = run & ((flags & int(kinds.EPA_HORIZON)) != 0)
        run, ignored = (
            run & ~unfound,
            kinds.ITERATIONS | kinds.LS_ITERATIONS,
        )  # as in MuJoCo C
        found = (
            int(np.bitwise_or.reduce(flags[run])) & ~int(ignored) if run.any() else 0
        )
        contacts = (
            max(int(self._data.nacon.numpy()[0]), int(self._data.ncollision.numpy()[0]))
            / self._num
        )
        needed = {
            "contacts": int(np.ceil(contacts)),
            "constraints": int(self._data.nefc.numpy()[run].max(initial=0)),
        }
        # ``forward`` sets no flag for the first two buffers.
        few = {"constraints": found & int(kinds.NEFC | kinds.NJMAX_NNZ)}
        few["contacts"] = found & ~few["constraints"]
        if flags.any():
            self._data.overflow.zero_()
        for name, flag in few.items():
            have = getattr(self._settings, name)
            if flag & int(kinds.CONTACT_MATCH):
                have = self._model.opt.contact_sensor_maxmatch
            if flag or needed[name] > have:
                words = (
                    f"physics=warp: a world needs room for more than {have} {name} ({needed[name]} at the last step; "
                    f"{kinds(flag).name or 'counted'}). Raise it: physics=warp:{name}={2 * max(have, needed[name])}"
                )
                return words, unfound
        return "", unfound

    def write(self, tensor: Any, rows: np.ndarray, values: np.ndarray) -> None:
        """Write ``values`` (N, …) of ``rows`` (N,) bool into a device's tensor (N, …)."""
        new = torch.from_numpy(values[rows].astype(np.float32)).to(
            tensor.device, tensor.dtype
        )
        tensor[self._index(rows)] = new.reshape(-1, *tensor.shape[1:])

    def copy_row(self, tensor: Any, source: int, rows: np.ndarray) -> None:
        """Write the row ``source`` of a tensor into ``rows`` (N,) bool."""
        tensor[self._index(rows)] = tensor[source].clone()

    def read(
        self,
        tensor: Any,
        rows: np.ndarray,
        values: np.ndarray,
        parts: np.ndarray | None = None,
    ) -> None:
        """Read a device's tensor (N, …) into ``rows`` (N,) bool of ``values`` (N, …); with ``parts`` (k,) only those along the
        second axis."""
        found = tensor[self._index(rows)]
        if parts is not None:
            found = found[:, torch.from_numpy(parts).to(found.device)]
            into = np.flatnonzero(rows)[:, None], parts
            values[into] = found.cpu().numpy().reshape(-1, *values[:1, parts].shape[1:])
            return
        chosen = slice(None) if rows.all() else rows  # a mask costs three times a copy
        values[chosen] = found.cpu().numpy().reshape(-1, *values.shape[1:])

    def _index(self, rows: np.ndarray) -> Any:
        if rows.all():
            return slice(None)
        if self._index_of[0] != rows.tobytes():
            index = torch.from_numpy(np.flatnonzero(rows)).to(
                wp.device_to_torch(self._device)
            )
            self._index_of = rows.tobytes(), index
        return self._index_of[1]


def _peak_mb(work: Callable[[], object]) -> float:
    """Largest memory [MB] of Warp's arrays while ``work`` runs, without what was there before."""
    texts: list[str] = []
    with wp.ScopedMemoryTracker(report_func=texts.append) as tracker:
        tracker.clear()
        work()
    number, unit = re.findall(r"Peak usage:\s+\S+\s+([\d.]+) ([KMG]?)B", texts[-1])[0]
    return float(number) * 1024.0 ** (" KMG".index(unit or " ") - 2)


def _varies(name: str) -> bool:
    """True if each of MuJoCo Warp's worlds may have its own values of this field of the model."""
    entry = mjw.Model.__dataclass_fields__.get(name)
    return entry is not None and getattr(entry.type, "shape", ("",))[:1] == ("*",)


def open_device(device: str) -> None:
    """Start Warp. Raises TaccorlError: the extra is not installed, or there is no such device."""
    require("gpu")
    wp.config.log_level = wp.LOG_ERROR
    wp.init()
    known = [str(d) for d in wp.get_devices()]
    if device not in known:
        raise TaccorlError(
            f"physics=warp: no device {device!r}; Warp finds {', '.join(known)}. It needs an NVIDIA GPU with a driver "
            f"of the R580 series or newer: {_WAY_OUT}, or physics=warp:device=cpu to try it slowly"
        )

"""Penetration depth δ [m] and depth rate δ̇ [m/s] of every taxel, relative to the undeformed pad surface: a pure function of
(qpos, qvel). Batched over simulations; exact (``touch_kernel``), because MuJoCo's ``<tactile>`` is 34–78 % off on boxes.

Names in the model, for pad ``P``: site ``P`` on the finger, the taxel frame in the middle of the undeformed surface (z out
of the pad towards the other finger, y from palm to tip, x across), and geom ``P``, the pad's box. The pad is sprung if its
box has a body of its own on joints with springs, undeformed at qpos0; which joints does not matter here.

Contact in MuJoCo is softer under a light part than under a heavy one, so plain depth tells the part's mass: 2.4 mm at 10 g
and 0.4 mm at 300 g under the same 10 N (measured). A sprung plate yields by x = N / K whatever the mass, but the
part still sinks by r into it. r is what the taxels have beyond the plate, so it is taken off all of them: the one that is
furthest beyond reads the spring, the others how much less they are pressed. Rigid pads have nothing to go by and read plain
depth.

Letters in shapes: N sims, P pads, K taxels, G geoms, n pairs of a pad and a geom near it.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple, Protocol

import mujoco
import numpy as np

from taccorl.errors import TaccorlError, nearest
from taccorl.robots import ROBOT
from taccorl.robots.robot_spec import PadLayout
from taccorl.sim.felt_shapes import shapes_of
from taccorl.sim.touch_kernel import FeltGeoms, Fields, Pads, compression, penetration

KINEMATIC_FIELDS = (
    "site_xpos",
    "site_xmat",
    "geom_xpos",
    "geom_xmat",
    "cvel",
    "subtree_com",
)
"""Fields of ``mujoco.MjData`` from which touch is computed."""


class Kinematics(Protocol):
    """Positions, velocities and poses of N simulations: the fields of ``KINEMATIC_FIELDS``, each with a leading axis N.

    Shapes and units are those of ``mujoco.MjData``: ``site_xpos`` (N, nsite, 3) [m], ``site_xmat`` (N, nsite, 9), the same of
    geoms, ``cvel`` (N, nbody, 6) [rad/s, m/s] and ``subtree_com`` (N, nbody, 3) [m].

    A ``mujoco.batch.Batch`` provides them: bind the fields before its first step, and step with ``stage=mjSTAGE_VEL``, else they
    are one substep behind. ``OneSim`` provides them for an ``MjData``."""

    @property
    def site_xpos(self) -> np.ndarray: ...
    @property
    def site_xmat(self) -> np.ndarray: ...
    @property
    def geom_xpos(self) -> np.ndarray: ...
    @property
    def geom_xmat(self) -> np.ndarray: ...
    @property
    def cvel(self) -> np.ndarray: ...
    @property
    def subtree_com(self) -> np.ndarray: ...


class OneSim:
    """``Kinematics`` of one ``MjData`` (N = 1). Its arrays follow the data; ``mj_forward`` updates them."""

    site_xpos: np.ndarray
    site_xmat: np.ndarray
    geom_xpos: np.ndarray
    geom_xmat: np.ndarray
    cvel: np.ndarray
    subtree_com: np.ndarray

    def __init__(self, data: mujoco.MjData) -> None:
        for field in KINEMATIC_FIELDS:
            values = getattr(data, field)[None]
            values.flags.writeable = False  # as a batch's
            setattr(self, field, values)


class Touch(NamedTuple):
    """Depth [m] and depth rate [m/s], each (N, P, K) float32 for N simulations, P pads and K taxels of a pad; taxel = row ·
    columns + column. Both are 0 without contact."""

    depth_m: np.ndarray
    depth_rate_mps: np.ndarray


class PadArray:
    """The pads of one model, in the order of their names.

    Each detects every colliding geom (contype or conaffinity) except those of its own arm, that is of its kinematic tree; of its
    own arm it detects only the boxes of the other pads. Sizes are those of the compiled model, the same in all sims; poses
    are not.

    Solids of one body that touch or overlap are one part, whose inner faces are no surface; of other shapes that overlap (a
    cylinder in a box) the greater depth is used, which near their common line is less than the depth in both together.

    Depth is the distance to the nearest surface (paper App. B.2), with two consequences. In a wall it is never more than
    half its thickness: pressed in further, the taxel is nearer to the wall's back. And near an edge it is the distance to
    the edge's sides: a sharp one between two rows of taxels causes little or no depth. ``layout``: arrangement of the taxels
    on every pad. Raises TaccorlError: a pad has no site or no geom, or a geom is of a kind whose depth is not implemented
    (``shapes_of``)."""

    def __init__(
        self, model: mujoco.MjModel, pads: Sequence[str], layout: PadLayout = ROBOT.pad
    ) -> None:
        self.pads = tuple(pads)
        x, y = layout.taxel_axes_m()
        self.taxel_pos_pad = np.stack(
            [
                np.tile(x, layout.rows),
                np.repeat(y, layout.columns),
                np.zeros(layout.num_taxels),
            ],
            axis=1,
        )
        """(K, 3) m."""
        self._site = np.array([_id(model, "site", pad) for pad in pads])
        self._box = np.array([_id(model, "geom", pad) for pad in pads])
        self._finger = model.site_bodyid[self._site]
        self._plate = model.geom_bodyid[self._box]
        self._sprung = np.flatnonzero(
            model.body_weldid[self._plate] != model.body_weldid[self._finger]
        )
        self._plate_point, self._plate_normal = self._undeformed(model)
        felt = self._felt_geoms(model)
        self._shapes = shapes_of(model, np.flatnonzero(felt.any(axis=0)).tolist())
        geom = self._shapes.geom
        is_plane = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE
        self._geoms = FeltGeoms(
            geom=geom,
            body=model.geom_bodyid[geom],
            feels=felt[:, geom],
            bound_m=np.where(is_plane, np.inf, model.geom_rbound[geom]),
            centre_m=model.geom_aabb[geom, :3],
            extent_m=model.geom_aabb[geom, 3:],
        )
        self._pads = Pads(
            site=self._site,
            box=self._box,
            finger=self._finger,
            plate=self._plate,
            sprung=self._sprung,
            plate_point_m=self._plate_point,
            plate_normal=self._plate_normal,
            root=model.body_rootid.copy(),
            half_m=np.array([x.max(), y.max(), 0.0]),
            grid=np.stack(
                [*self.taxel_pos_pad[:, :2].T, np.ones(layout.num_taxels)]
            ).astype(np.float32),
        )

    @property
    def sprung(self) -> tuple[str, ...]:
        """Names of the pads whose plate is on springs, in the order of ``pads``."""
        return tuple(self.pads[p] for p in self._sprung)

    def _undeformed(self, model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
        """(P', 3) each: a point and the normal of the sprung pads' surfaces, in the frames of their boxes."""
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        site, box = self._site[self._sprung], self._box[self._sprung]
        geom_mat = data.geom_xmat[box].reshape(-1, 3, 3)
        normal = data.site_xmat[site].reshape(-1, 3, 3)[:, :, 2]
        away = data.site_xpos[site] - data.geom_xpos[box]
        return (away[:, None] @ geom_mat)[:, 0], (normal[:, None] @ geom_mat)[:, 0]

    def _felt_geoms(self, model: mujoco.MjModel) -> np.ndarray:
        """(P, ngeom) bool."""
        collides = (model.geom_contype | model.geom_conaffinity) != 0
        tree, weld = (
            model.body_treeid[model.geom_bodyid],
            model.body_weldid[model.geom_bodyid],
        )
        felt = np.empty((len(self.pads), model.ngeom), bool)
        for p, finger in enumerate(self._finger):
            own = (weld == model.body_weldid[finger]) | (
                (tree == model.body_treeid[finger]) & (tree >= 0)
            )
            own[np.delete(self._box, p)] = False
            own[self._box[p]] = True
            felt[p] = collides & ~own
        return felt

    def touch(self, state: Kinematics, start: int = 0, end: int | None = None) -> Touch:
        """Depth and depth rate, the input of the sensor's law; on sprung pads without the part's penetration into the plate.
        ``start``: first of the simulations ``start`` … ``end`` to compute (all by default); several threads may compute
        different blocks."""
        return self._past_surface(state, start, end, off_sinking=True)

    def penetration(self, state: Kinematics) -> Touch:
        """Depth D and rate relative to the undeformed surface, including the part's penetration into the plate. Raises
        TaccorlError: the fields are all zero, because they were bound after the batch's last call."""
        return self._past_surface(state, 0, None, off_sinking=False)

    def compression(self, state: Kinematics) -> Touch:
        """Compression [m] and compression rate [m/s] of the sprung pads' plates at each taxel: (N, P', K) float32.

        In the taxel frame a plate is the plane n · p = n · p₀, so c(x, y) = (n_x x + n_y y − n · p₀) / n_z. Its points move with
        v + ω × p, so that at a fixed taxel ċ = −(n · v + (n × ω) · p) / n_z with p = (x, y, −c)."""
        fields = self._fields(state)
        touch = Touch(
            *np.empty(
                (2, len(fields.cvel), len(self._sprung), self._pads.grid.shape[1]),
                np.float32,
            )
        )
        compression(self._pads, fields, *touch)
        return touch

    def _past_surface(
        self, state: Kinematics, start: int, end: int | None, *, off_sinking: bool
    ) -> Touch:
        fields = self._fields(state, start, end)
        touch = Touch(
            *np.zeros(
                (2, len(fields.cvel), len(self.pads), self._pads.grid.shape[1]),
                np.float32,
            )
        )
        penetration(self._geoms, self._shapes, self._pads, fields, off_sinking, *touch)
        return touch

    def _fields(
        self, state: Kinematics, start: int = 0, end: int | None = None
    ) -> Fields:
        views = [getattr(state, name)[start:end] for name in KINEMATIC_FIELDS]
        for view in views:
            view.flags.writeable = False  # of all states alike, or Numba compiles the kernel once more (12 s)
        fields = Fields(*views)
        if not fields.site_xmat[:, self._site[0], 2::3].any(axis=1).all():
            raise TaccorlError(
                f"site {self.pads[0]!r} has no orientation: bind {', '.join(KINEMATIC_FIELDS)} before the batch's last step, "
                "forward or reset"
            )
        return fields


def _id(model: mujoco.MjModel, kind: Literal["site", "geom"], pad: str) -> int:
    names = [getattr(model, kind)(i).name for i in range(getattr(model, f"n{kind}"))]
    if pad not in names:
        raise TaccorlError(
            f"pad {pad!r}: the model has no {kind} of that name; {nearest(pad, names)}"
        )
    return names.index(pad)

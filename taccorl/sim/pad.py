"""What the taxels of the pads feel: depth δ [m] and rate δ̇ [m/s] of the parts past the undeformed pad, a pure function of
(qpos, qvel). Batched over sims; exact (``signed_distance``), because MuJoCo's ``<tactile>`` is 34–78 % off on boxes.

Names in the model, for pad ``P``: site ``P`` on the finger, the taxel frame in the middle of the undeformed surface (z out
of the pad towards the other finger, y from palm to tip, x across), and geom ``P``, the pad's box. The pad is sprung if its
box has a body of its own on joints with springs, undeformed at qpos0; which joints does not matter here.

Contact in MuJoCo is softer under a light part than under a heavy one, so plain depth tells the part's mass: 2.4 mm at 10 g
and 0.4 mm at 300 g under the same 10 N (research/mujoco.md §1). A sprung plate yields by x = N / K whatever the mass, but the
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
from taccorl.sim.felt_shapes import shapes_of
from taccorl.sim.robot import PAD_TAXELS, TAXEL_PITCH_M

KINEMATIC_FIELDS = ("site_xpos", "site_xmat", "geom_xpos", "geom_xmat", "cvel", "subtree_com")
"""Fields of ``mujoco.MjData`` that touch is made from."""


class Kinematics(Protocol):
    """The fields of ``KINEMATIC_FIELDS``, each with a leading axis N.

    A ``mujoco.batch.Batch`` is one: bind the fields before its first step, and step with ``stage=mjSTAGE_VEL``, else they are
    one substep behind. ``OneSim`` makes one of an ``MjData``.
    """

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
    """An ``MjData`` as ``Kinematics`` with N = 1. Live: made once, it follows the data; ``mj_forward`` brings it up to date."""

    site_xpos: np.ndarray
    site_xmat: np.ndarray
    geom_xpos: np.ndarray
    geom_xmat: np.ndarray
    cvel: np.ndarray
    subtree_com: np.ndarray

    def __init__(self, data: mujoco.MjData) -> None:
        for field in KINEMATIC_FIELDS:
            setattr(self, field, getattr(data, field)[None])


class Touch(NamedTuple):
    """(N, P, K) float32; taxel = row · columns + column. Both are 0 where nothing touches."""

    depth_m: np.ndarray
    depth_rate_mps: np.ndarray


def without_sinking(touch: Touch, plate: Touch) -> Touch:
    """Sprung pads: δ = [D − r]₊ with r = [max (D − c)]₊, and δ̇ = Ḋ − ṙ. D is ``touch``, c how far the ``plate`` is pressed in.

    The taxel with the greatest D − c gets (c, ċ): on a plate that does not tilt the spring's own compression, N / K in
    balance. Where the taxels miss the summit of a small round part they all read up to that much less (0.1 mm for a sphere of
    10 mm), and that much of the sinking, which depends on the mass, stays in.
    """
    depth, rate = touch
    beyond = np.where(depth > 0, depth - plate.depth_m, -np.inf)
    furthest = beyond.argmax(axis=-1)[..., None]
    sunk, part_rate, plate_rate = (np.take_along_axis(a, furthest, -1) for a in (beyond, rate, plate.depth_rate_mps))
    depth = depth - np.maximum(sunk, 0)
    rate = rate - np.where(sunk > 0, part_rate - plate_rate, 0)
    return Touch(np.where(depth > 0, depth, 0), np.where(depth > 0, rate, 0))


class PadArray:
    """The pads of one model, in the order of their names.

    Each feels every colliding geom (contype or conaffinity) but those of its own arm, that is of its kinematic tree; of its
    own arm it feels the boxes of the other pads. Sizes are those of the compiled model, the same in all sims; poses are not.

    Solids of one body that touch or overlap are one part, whose inner faces are no surface; of other shapes that overlap (a
    cylinder in a box) the deeper one is felt, which near their common line is less than the depth in both together.

    Depth is the distance to the nearest surface (paper App. B.2), with two consequences. In a wall it is never more than half
    its thickness: pressed in further, the taxel is nearer to the wall's back. And near an edge it is the distance to the
    edge's sides: a sharp one between two rows of taxels is felt little or not at all.

    Raises:
        TaccorlError: a pad without site or geom; a geom of a kind that pads cannot feel (``shapes_of``).
    """

    def __init__(self, model: mujoco.MjModel, pads: Sequence[str]) -> None:
        self.pads = tuple(pads)
        rows, columns = PAD_TAXELS
        x = (np.arange(columns) - (columns - 1) / 2) * TAXEL_PITCH_M
        y = (np.arange(rows) - (rows - 1) / 2) * TAXEL_PITCH_M
        self.taxel_pos_pad = np.stack([np.tile(x, rows), np.repeat(y, columns), np.zeros(rows * columns)], axis=1)
        """(K, 3) m."""
        self._grid = np.stack([*self.taxel_pos_pad[:, :2].T, np.ones(rows * columns)]).astype(np.float32)
        self._half = np.array([x.max(), y.max(), 0.0])
        self._site = np.array([_id(model, "site", pad) for pad in pads])
        self._box = np.array([_id(model, "geom", pad) for pad in pads])
        self._finger = model.site_bodyid[self._site]
        self._plate = model.geom_bodyid[self._box]
        self._sprung = np.nonzero(model.body_weldid[self._plate] != model.body_weldid[self._finger])[0]
        self._plate_point, self._plate_normal = self._undeformed(model)
        felt = self._felt_geoms(model)
        self._geom = np.nonzero(felt.any(axis=0))[0]
        self._feels = felt[:, self._geom]
        self._body = model.geom_bodyid[self._geom]
        self._root = model.body_rootid
        self._shapes = shapes_of(model, self._geom.tolist())
        kind, number = np.zeros(model.ngeom, int), np.zeros(model.ngeom, int)
        for k, shapes in enumerate(self._shapes):
            kind[shapes.geoms], number[shapes.geoms] = k, np.arange(len(shapes.geoms))
        self._kind, self._number = kind[self._geom], number[self._geom]
        is_plane = model.geom_type[self._geom] == mujoco.mjtGeom.mjGEOM_PLANE
        self._radius = np.where(is_plane, np.inf, model.geom_rbound[self._geom])
        self._centre, self._extent = model.geom_aabb[self._geom, :3], model.geom_aabb[self._geom, 3:]

    @property
    def sprung(self) -> tuple[str, ...]:
        """Names of the pads that are on springs."""
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
        tree, weld = model.body_treeid[model.geom_bodyid], model.body_weldid[model.geom_bodyid]
        felt = np.empty((len(self.pads), model.ngeom), bool)
        for p, finger in enumerate(self._finger):
            own = (weld == model.body_weldid[finger]) | ((tree == model.body_treeid[finger]) & (tree >= 0))
            own[np.delete(self._box, p)] = False
            own[self._box[p]] = True
            felt[p] = collides & ~own
        return felt

    def touch(self, state: Kinematics) -> Touch:
        """What the sensor's law works on: depth and rate, on sprung pads without the part's sinking into the plate."""
        touch = self.penetration(state)
        if len(self._sprung) and touch.depth_m.any():
            of_sprung = Touch(touch.depth_m[:, self._sprung], touch.depth_rate_mps[:, self._sprung])
            for whole, part in zip(touch, without_sinking(of_sprung, self.compression(state)), strict=True):
                whole[:, self._sprung] = part
        return touch

    def compression(self, state: Kinematics) -> Touch:
        """How far the plates of the sprung pads are pressed in at each taxel, and how fast: (N, P', K) float32.

        In the taxel frame a plate is the plane n · p = n · p₀, so c(x, y) = (n_x x + n_y y − n · p₀) / n_z. Its points move with
        v + ω × p, so that at a fixed taxel ċ = −(n · v + (n × ω) · p) / n_z with p = (x, y, −c).
        """
        site, box = self._site[self._sprung], self._box[self._sprung]
        num_sims, num_pads = len(state.site_xpos), len(site)
        site_pos = state.site_xpos[:, site].reshape(-1, 3)
        site_mat = state.site_xmat[:, site].reshape(-1, 3, 3)
        world_from_box = state.geom_xmat[:, box].reshape(-1, 3, 3).swapaxes(1, 2)  # of row vectors
        point, normal = (np.tile(a, (num_sims, 1))[:, None] for a in (self._plate_point, self._plate_normal))
        n = (normal @ world_from_box @ site_mat)[:, 0]
        n_z = n[:, 2:]
        plate_pos = state.geom_xpos[:, box].reshape(-1, 1, 3) + point @ world_from_box
        p0 = ((plate_pos - site_pos[:, None]) @ site_mat)[:, 0]
        depth = np.concatenate([n[:, :2], -_dot(n, p0)], axis=1) / n_z
        sim = np.repeat(np.arange(num_sims), num_pads)
        turn_1, shift_1 = self._motion(state, sim, np.tile(self._plate[self._sprung], num_sims), site_pos)
        turn_2, shift_2 = self._motion(state, sim, np.tile(self._finger[self._sprung], num_sims), site_pos)
        turn, shift = (((a - b)[:, None] @ site_mat)[:, 0] for a, b in ((turn_1, turn_2), (shift_1, shift_2)))
        m = _cross(n, turn)
        rate = (m[:, 2:] * depth - np.concatenate([m[:, :2], _dot(n, shift)], axis=1)) / n_z
        per_taxel = (a.astype(np.float32)[:, None] @ self._grid for a in (depth, rate))
        return Touch(*(a.reshape(num_sims, num_pads, -1) for a in per_taxel))

    def penetration(self, state: Kinematics) -> Touch:
        """Depth D and rate past the undeformed surface, the part's sinking into the plate included.

        Raises:
            TaccorlError: the fields are all zero: bound after the batch's last call.
        """
        site_pos = state.site_xpos[:, self._site]
        site_mat = state.site_xmat[:, self._site].reshape(len(site_pos), -1, 3, 3)
        if not site_mat[:, 0, 2].any(axis=1).all():
            raise TaccorlError(
                f"site {self.pads[0]!r} has no orientation: bind {', '.join(KINEMATIC_FIELDS)} before the batch's last step, "
                "forward or reset"
            )
        num_sims, num_pads = site_pos.shape[:2]
        depth = np.zeros((num_sims * num_pads, self._grid.shape[1]), np.float32)
        rate = np.zeros_like(depth)
        sim, pad, geom, position = self._near(state, site_pos, site_mat)
        if len(sim):
            velocity = self._velocity(state, sim, pad, geom, site_pos, position)
            position = position[:, :, [0, 1, 3]].astype(np.float32)
            self._feel(depth, rate, sim * num_pads + pad, geom, position, velocity)
        shape = (num_sims, num_pads, -1)
        return Touch(depth.reshape(shape), rate.reshape(shape))

    def _near(
        self, state: Kinematics, site_pos: np.ndarray, site_mat: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Pairs whose boxes meet: sim, pad, geom (n,) and the pad in the geom's frame, (n, 3, 4): axes x, y, z and origin."""
        away = state.geom_xpos[:, None, self._geom] - site_pos[:, :, None]  # (N, P, G, 3)
        away_pad = np.abs(away @ site_mat)
        reach = self._radius[:, None] + self._half
        sim, pad, geom = np.nonzero((away_pad < reach).all(axis=-1) & self._feels)
        geom_mat = state.geom_xmat[sim, self._geom[geom]].reshape(-1, 3, 3).swapaxes(1, 2)
        axes = geom_mat @ site_mat[sim, pad]
        origin = -(geom_mat @ away[sim, pad, geom][:, :, None])
        # Two boxes are apart if they are so along an axis of the one or the other; the edges' cross products are not tried.
        spread = np.abs(axes)
        centre = self._centre[geom] - origin[:, :, 0]
        centre_pad = np.abs(centre[:, None, :] @ axes)[:, 0]
        reach_pad = self._half + (self._extent[geom][:, None, :] @ spread)[:, 0]
        reach_geom = self._extent[geom] + (spread @ self._half[:, None])[:, :, 0]
        meet = (centre_pad < reach_pad).all(axis=1) & (np.abs(centre) < reach_geom).all(axis=1)
        return sim[meet], pad[meet], geom[meet], np.concatenate([axes[meet], origin[meet]], axis=2)

    def _velocity(
        self,
        state: Kinematics,
        sim: np.ndarray,
        pad: np.ndarray,
        geom: np.ndarray,
        site_pos: np.ndarray,
        position: np.ndarray,
    ) -> np.ndarray:
        """How the pads move in the geoms' frames, (n, 3, 3): velocity is linear in a taxel's (x, y, 1)."""
        site = site_pos[sim, pad]
        turn_1, shift_1 = self._motion(state, sim, self._finger[pad], site)
        turn_2, shift_2 = self._motion(state, sim, self._body[geom], site)
        geom_mat = state.geom_xmat[sim, self._geom[geom]].reshape(-1, 3, 3)
        turn, shift = (((a - b)[:, None, :] @ geom_mat)[:, 0] for a, b in ((turn_1, turn_2), (shift_1, shift_2)))
        velocity = np.stack([_cross(turn, position[:, :, 0]), _cross(turn, position[:, :, 1]), shift], axis=2)
        return velocity.astype(np.float32)

    def _motion(
        self, state: Kinematics, sim: np.ndarray, body: np.ndarray, point: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Angular velocity, and velocity of the body at a point (n, 3), in the world; cvel is (ω, v at subtree_com[root])."""
        cvel = state.cvel[sim, body]
        return cvel[:, :3], cvel[:, 3:] + _cross(cvel[:, :3], point - state.subtree_com[sim, self._root[body]])

    def _feel(
        self,
        depth: np.ndarray,
        rate: np.ndarray,
        slot: np.ndarray,
        geom: np.ndarray,
        position: np.ndarray,
        velocity: np.ndarray,
    ) -> None:
        """Fills (N · P, K) depth and rate: each taxel's deepest shape. ``slot`` (n,), in order, is the row that a pair is for."""
        kind, number = self._kind[geom], self._number[geom]
        for k in np.unique(kind):
            mine = np.nonzero(kind == k)[0]
            felt = self._shapes[k].feel(number[mine], position[mine], velocity[mine], self._grid)
            rows = slot[mine]
            first = np.nonzero(np.diff(rows, prepend=-1))[0]
            rank = np.arange(len(rows)) - np.repeat(first, np.diff(first, append=len(rows)))
            for r in range(rank.max() + 1):  # pairs of one pad take turns
                turn = np.nonzero(rank == r)[0]
                row, deepest = rows[turn], felt.depth_m[turn]
                deeper = deepest > depth[row]
                depth[row] = np.where(deeper, deepest, depth[row])
                rate[row] = np.where(deeper, felt.depth_rate_mps[turn], rate[row])


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """np.cross of (n, 3), ten times faster on few rows."""
    x, y, z = (
        a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1],
        a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2],
        a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0],
    )
    return np.stack([x, y, z], axis=1)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(n, 1) of (n, 3) and (n, 3)."""
    return a[:, :1] * b[:, :1] + a[:, 1:2] * b[:, 1:2] + a[:, 2:] * b[:, 2:]


def _id(model: mujoco.MjModel, kind: Literal["site", "geom"], pad: str) -> int:
    names = [getattr(model, kind)(i).name for i in range(getattr(model, f"n{kind}"))]
    if pad not in names:
        raise TaccorlError(f"pad {pad!r}: the model has no {kind} of that name; {nearest(pad, names)}")
    return names.index(pad)

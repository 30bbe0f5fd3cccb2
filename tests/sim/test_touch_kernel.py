"""Touch as compiled loops against plain NumPy in double precision: every pair of pad and geom, every face, piece and edge."""

import itertools
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from taccorl.robots import ROBOT
from taccorl.sim.felt_shapes import CAPSULE, CYLINDER, ShapeTables, shapes_of
from taccorl.sim.pad import KINEMATIC_FIELDS, OneSim, PadArray
from taccorl.sim.task import tasks
from taccorl.sim.twin import TwinConfig, build_spec

NUM_SIMS = 4


def scattered(task: str) -> tuple[mujoco.MjModel, SimpleNamespace]:
    """A task's scene whose taxel frames lie anywhere at its parts, and where every body moves somehow."""
    model = build_spec(TwinConfig(), tasks.get(task)()).compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    state = SimpleNamespace(**{f: np.repeat(getattr(OneSim(data), f), NUM_SIMS, axis=0) for f in KINEMATIC_FIELDS})
    rng = np.random.default_rng(5)
    on_parts = np.flatnonzero((model.body_dofnum[model.geom_bodyid] == 6) & (model.geom_contype > 0))
    for n in range(NUM_SIMS):
        for pad in ROBOT.pads:
            site, geom = model.site(pad).id, rng.choice(on_parts)
            state.site_xpos[n, site] = data.geom_xpos[geom] + rng.normal(0, 0.004, 3)
            state.site_xmat[n, site] = Rotation.random(rng=rng).as_matrix().ravel()
    state.cvel[:] = rng.normal(0, 0.1, state.cvel.shape)
    for field in KINEMATIC_FIELDS:
        getattr(state, field).flags.writeable = False  # as a batch's: nothing is compiled for this test alone
    return model, state


def depth_in(s: ShapeTables, g: int, p: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(S,) depth of points p (S, 3) in shape g, in its frame, and its rate if they move with v; negative outside."""
    if s.kind[g] in (CAPSULE, CYLINDER):
        half, radius = s.half_m[g], s.radius_m[g]
        off = p - [0, 0, 1] * (np.clip(p[:, 2:], -half, half) if s.kind[g] == CAPSULE else p[:, 2:])
        distance = np.linalg.norm(off, axis=1)
        depth, rate = radius - distance, -(off * v).sum(axis=1) / distance
        under_end = half - np.abs(p[:, 2])
        at_end = (s.kind[g] == CYLINDER) & (under_end < depth)
        return np.where(at_end, under_end, depth), np.where(at_end, -v[:, 2] * np.sign(p[:, 2]), rate)
    normals, offsets, covered = (a[slice(*s.faces[g])] for a in (s.normals, s.offsets_m, s.covered))
    under = offsets - p @ normals.T
    face = under.argmin(axis=1)
    depth, rate = under.min(axis=1), -(v @ normals.T)[np.arange(len(p)), face]
    at_seam = covered[face]
    for r in range(*s.seams[g]):
        off = np.abs(p @ s.seam_axes[r].T - s.seam_centres_m[r])
        at_seam = at_seam | ((face == s.seam_face[r]) & (off < s.seam_halves_m[r]).all(axis=1))
    at_seam &= depth > 0
    if s.surface[g] >= 0 and at_seam.any():
        turn, shift = s.body_from_geom[g, :, :3], s.body_from_geom[g, :, 3]
        p, v = p[at_seam] @ turn.T + shift, v[at_seam] @ turn.T
        depth[at_seam], inward = to_surface(s, s.surface[g], p)
        rate[at_seam] = (inward * v).sum(axis=1)
    return depth, rate


def to_surface(s: ShapeTables, u: int, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(S,) distance of points (S, 3) to surface u, and the direction (S, 3) away from it: of all its edges and pieces."""
    depth, inward = np.full(len(p), np.inf), np.zeros(p.shape)
    for start, along in s.edges[slice(*s.own_edges[u])].reshape(-1, 2, 3):
        off = p - start - np.clip((p - start) @ along / (along @ along), 0, 1)[:, None] * along
        distance = np.linalg.norm(off, axis=1)
        nearer = distance < depth
        depth[nearer], inward[nearer] = distance[nearer], (off / np.maximum(distance, 1e-12)[:, None])[nearer]
    for q in range(*s.own_pieces[u]):
        under = s.pieces[q, 3] - p @ s.pieces[q, :3]
        nearer = (under > -2e-6) & (under < depth)
        nearer &= (p @ s.side_normals[q].T - s.side_offsets_m[q] < 1e-7).all(axis=1)
        depth[nearer], inward[nearer] = under[nearer], -s.pieces[q, :3]
    return depth, inward


def reference(model: mujoco.MjModel, state: SimpleNamespace) -> tuple[np.ndarray, np.ndarray]:
    """(N, P, K) depth and rate: the deepest of all shapes that are not of the pad's own arm."""
    taxels = PadArray(model, ROBOT.pads).taxel_pos_pad
    shapes = shapes_of(model, np.flatnonzero(model.geom_contype | model.geom_conaffinity).tolist(), np.float64)
    depth, rate = np.zeros((2, NUM_SIMS, len(ROBOT.pads), len(taxels)))
    boxes = {model.geom(pad).id for pad in ROBOT.pads}

    def velocity_at(n: int, body: int, points: np.ndarray) -> np.ndarray:
        cvel, com = state.cvel[n, body], state.subtree_com[n, model.body_rootid[body]]
        return cvel[3:] + np.cross(cvel[:3], points - com)

    for n, (p, pad), (g, geom) in itertools.product(
        range(NUM_SIMS), enumerate(ROBOT.pads), enumerate(shapes.geom.tolist())
    ):
        site, body = model.site(pad).id, model.geom_bodyid[geom]
        finger = model.site_bodyid[site]
        is_other_pad = geom in boxes and geom != model.geom(pad).id
        if model.body_treeid[body] == model.body_treeid[finger] and not is_other_pad:
            continue
        points = state.site_xpos[n, site] + taxels @ state.site_xmat[n, site].reshape(3, 3).T
        mat = state.geom_xmat[n, geom].reshape(3, 3)
        # A taxel is fixed to the finger, and its velocity is asked in the frame of the geom, which moves as well.
        speed = velocity_at(n, finger, points) - velocity_at(n, body, points)
        deep, faster = depth_in(shapes, g, (points - state.geom_xpos[n, geom]) @ mat, speed @ mat)
        deeper = deep > depth[n, p]
        depth[n, p, deeper], rate[n, p, deeper] = deep[deeper], faster[deeper]
    return depth, rate


@pytest.mark.parametrize("task", ["assembly_1", "test_tube"])
def test_compiled_touch_is_that_of_the_shapes(task: str) -> None:
    model, state = scattered(task)
    pads = PadArray(model, ROBOT.pads)
    found, expected = pads.penetration(state), reference(model, state)
    touched = expected[0] > 0
    assert touched.sum() > 1000 and np.abs(expected[1][touched]).max() > 0.02
    assert np.array_equal(found.depth_m > 0, touched)
    # Single precision against double.
    assert np.abs(found.depth_m - expected[0]).max() < 2e-8
    assert (np.abs(found.depth_rate_mps - expected[1]) > 1e-6).mean() < 1e-4  # ties of faces at an edge
    half = [pads.touch(state, *block) for block in ((0, 1), (1, NUM_SIMS))]
    assert np.array_equal(np.concatenate([h.depth_m for h in half]), pads.touch(state).depth_m)

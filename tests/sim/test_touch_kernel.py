"""Touch as compiled loops against the shapes' own NumPy equations, pair by pair, without any rule for what is near."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from taccorl.robots import ROBOT
from taccorl.sim.felt_shapes import shapes_of
from taccorl.sim.pad import KINEMATIC_FIELDS, OneSim, PadArray
from taccorl.sim.task import tasks
from taccorl.sim.twin import TwinConfig, build_spec

NUM_SIMS = 12


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


def reference(model: mujoco.MjModel, state: SimpleNamespace) -> tuple[np.ndarray, np.ndarray]:
    """(N, P, K) depth and rate: the deepest of all shapes that are not of the pad's own arm."""
    x, y, _ = PadArray(model, ROBOT.pads).taxel_pos_pad.T
    grid = np.stack([x, y, np.ones_like(x)]).astype(np.float32)
    colliding = np.flatnonzero(model.geom_contype | model.geom_conaffinity)
    depth, rate = np.zeros((2, NUM_SIMS, len(ROBOT.pads), len(x)), np.float32)
    own = {pad: model.body_treeid[model.site(pad).bodyid[0]] for pad in ROBOT.pads}
    mounts = {pad: {model.geom(p).id for p in ROBOT.pads if p != pad} for pad in ROBOT.pads}

    def velocity_at(body: int, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        turn, shift = state.cvel[:, body, :3], state.cvel[:, body, 3:]
        return turn, shift + np.cross(turn, point - state.subtree_com[:, model.body_rootid[body]])

    for shapes in shapes_of(model, colliding.tolist()):
        for number, geom in sorted(enumerate(shapes.geoms), key=lambda one: one[1]):
            mat = state.geom_xmat[:, geom].reshape(-1, 3, 3).swapaxes(1, 2)
            for p, pad in enumerate(ROBOT.pads):
                if model.body_treeid[model.geom_bodyid[geom]] == own[pad] and geom not in mounts[pad]:
                    continue
                site = model.site(pad).id
                at = state.site_xpos[:, site]
                axes = mat @ state.site_xmat[:, site].reshape(-1, 3, 3)
                origin = mat @ (at - state.geom_xpos[:, geom])[:, :, None]
                one, other = (velocity_at(b, at) for b in (model.site(pad).bodyid[0], model.geom_bodyid[geom]))
                turn, shift = ((mat @ (a - b)[:, :, None])[:, :, 0] for a, b in zip(one, other, strict=True))
                across = [np.cross(turn, axes[:, :, k]) for k in range(2)]
                position = np.concatenate([axes[:, :, :2], origin], axis=2).astype(np.float32)
                velocity = np.stack([*across, shift], axis=2).astype(np.float32)
                felt = shapes.feel(np.full(NUM_SIMS, number), position, velocity, grid)
                deeper = felt.depth_m > depth[:, p]
                depth[:, p] = np.where(deeper, felt.depth_m, depth[:, p])
                rate[:, p] = np.where(deeper, felt.depth_rate_mps, rate[:, p])
    return depth, rate


@pytest.mark.parametrize("task", ["assembly_1", "test_tube"])
def test_compiled_touch_is_that_of_the_shapes(task: str) -> None:
    model, state = scattered(task)
    pads = PadArray(model, ROBOT.pads)
    found, expected = pads.penetration(state), reference(model, state)
    touched = expected[0] > 0
    assert touched.sum() > 1000 and np.abs(expected[1][touched]).max() > 0.02
    assert np.array_equal(found.depth_m > 0, touched)
    # Bits differ only where the BLAS of this machine adds in another order.
    assert np.abs(found.depth_m - expected[0]).max() < 2e-8
    assert (np.abs(found.depth_rate_mps - expected[1]) > 1e-7).mean() < 1e-4  # ties of faces at an edge
    half = [pads.touch(state, *block) for block in ((0, 5), (5, NUM_SIMS))]
    assert np.array_equal(np.concatenate([h.depth_m for h in half]), pads.touch(state).depth_m)

"""Is the resident mode right on this device? python .ci/gpu/modes.py [DEVICE [ENVS [DECISIONS [TASK]]]]

The same random targets, smooth in time, in MuJoCo C, and in both modes of MuJoCo Warp; after each decision of 8 control steps
one line of JSON: largest differences of joints [rad, m], parts [m] and touch [counts], and pictures beside OpenGL's.
Rows ``graph=false`` launch every kernel by itself. Exit 1 where the resident mode differs from the copied one by more than
two runs of the copied mode do, or pictures differ by more than 1 of 255.
"""

import json
import sys
import time

import numpy as np

from taccorl.robots import ROBOT
from taccorl.sim import ray_renderer, warp_batch
from taccorl.sim.spaces import TACTILE_KEY
from taccorl.sim.vector_env import TaccorlVectorEnv
from taccorl.training.frame_cache import resized

GIVEN = dict(enumerate(sys.argv[1:]))
device, num, decisions, task = (
    GIVEN.get(k, default)
    for k, default in enumerate(("cuda:0", "64", "12", "assembly_1"))
)
num, decisions = int(num), int(decisions)
SIZE = (84, 112)
STEPS = 8
ray_renderer.WORLDS_AT_ONCE = min(ray_renderer.WORLDS_AT_ONCE, 24)
captured = warp_batch._Worlds._launch


def direct(self, key, work):
    """Instead of a graph: the kernels one by one."""
    import torch
    import warp as wp

    with wp.ScopedDevice(self._device):
        if self._device.is_cuda:
            torch.cuda.synchronize(self._settings.device)
        work()
        wp.synchronize_device(self._device)


def targets(home):
    random = np.random.default_rng(5)
    span = 0.25 * (ROBOT.action_high - ROBOT.action_low)
    knots = home + random.uniform(-1, 1, (decisions + 1, num, len(span))) * np.minimum(
        span, 0.15
    )
    knots[0] = home
    part = np.arange(1, STEPS + 1)[None, :, None] / STEPS
    return [
        np.clip(
            knots[k][:, None] + (knots[k + 1] - knots[k])[:, None] * part,
            ROBOT.action_low,
            ROBOT.action_high,
        )
        for k in range(decisions)
    ]


def run(physics, touch_every, *, graph=True):
    warp_batch._Worlds._launch = captured if graph else direct
    envs = TaccorlVectorEnv(task, num, physics=physics, images="on_request")
    envs.reset(seed=list(range(num)))
    home = envs.sim.targets.copy()
    found, start = [], time.perf_counter()
    for chunk in targets(home):
        done = envs.step_chunk(chunk, touch_every=touch_every)
        sim = envs.sim
        parts = np.stack([sim.poses(name)[:, :3, 3] for name in sim.task.parts], 1)
        pictures = None
        if sim.draws_on_device:
            ids = np.arange(num)
            drawn = sim.draw_on_device(ROBOT.cameras, ids, SIZE).cpu().numpy()
            opengl = sim.render_by_opengl(ROBOT.cameras, ids)
            whole = sim.render(ROBOT.cameras, ids)
            apart = [
                np.abs(drawn[:, k].astype(int) - resized(opengl[name], SIZE))
                for k, name in enumerate(ROBOT.cameras)
            ]
            at_224 = [
                np.abs(whole[name].astype(int) - opengl[name].astype(int))
                for name in ROBOT.cameras
            ]
            pictures = {
                "policy_size": [round(float(x.mean()), 3) for x in apart],
                "worst_of_an_env": round(
                    max(float(x.mean((1, 2, 3)).max()) for x in apart), 3
                ),
                "at_224": [round(float(x.mean()), 3) for x in at_224],
            }
        found.append(
            (
                done.observation["observation.state"].copy(),
                parts,
                done.observation[TACTILE_KEY].astype(int),
                sim.arrays["qpos"].copy(),
                pictures,
            )
        )
    seconds = time.perf_counter() - start
    envs.close()
    return found, seconds


def beside(name, ours, theirs, seconds):
    rows = []
    for k, (a, b) in enumerate(zip(ours, theirs, strict=True)):
        row = {
            "run": name,
            "decision": k + 1,
            "joints": float(np.abs(a[0] - b[0]).max()),
            "parts_m": float(np.abs(a[1] - b[1]).max()),
            "parts_mean_m": float(np.abs(a[1] - b[1]).mean()),
            "touch": int(np.abs(a[2] - b[2]).max()),
            "qpos": float(np.nanmax(np.abs(a[3] - b[3]))),
            "pictures": a[4],
            "seconds": round(seconds, 2),
        }
        rows.append(row)
        print(json.dumps(row), flush=True)
    return rows


warp = f"warp:device={device}"
c, seconds = run("c", STEPS)
print(f"C: {seconds:.2f} s", flush=True)
first, seconds = run(warp, STEPS)
beside("copied beside C", first, c, seconds)
again, seconds = run(warp, 1)
noise = beside("copied beside copied", again, first, seconds)
bad = False
for graph in (True, False):
    name = f"resident beside copied, graph={graph}".lower()
    found, seconds = run(warp + ",mode=resident", STEPS, graph=graph)
    rows = beside(name, found, first, seconds)
    # Contacts part worlds within a few decisions: the first three, and means.
    states = any(
        row["joints"] > 1e-4 + 3 * other["joints"]
        or row["parts_mean_m"] > 1e-5 + 3 * other["parts_mean_m"]
        for row, other in zip(rows, noise, strict=True)
    )
    pictures = any(max(row["pictures"]["policy_size"]) > 1.0 for row in rows)
    print(json.dumps({"run": name, "states_wrong": states, "pictures_wrong": pictures}))
    bad |= graph and (states or pictures)
sys.exit(bad)

"""Why does a policy act otherwise in the resident mode? python .ci/gpu/replayed.py POLICY [DEVICE [ENVS [DECISIONS [TASK]]]]

A policy acts in MuJoCo C; its targets are then replayed in both modes of MuJoCo Warp: largest and mean differences of what
a policy sees and of what the judge says, a line of JSON a decision. Then the policy acts by itself in each mode, with the
pictures of either renderer: when the parts are grasped.
"""

import json
import sys
import time
from pathlib import Path

import numpy as np

from taccorl.cli.evaluate import register_policies
from taccorl.evaluation.policy_actor import open_checkpoint
from taccorl.robots import ROBOT
from taccorl.sim.spaces import IMAGE_KEYS, STATE_KEY, TACTILE_KEY
from taccorl.sim.vector_env import TaccorlVectorEnv

GIVEN = dict(enumerate(sys.argv[1:]))
policy, device, num, decisions, task = (
    GIVEN.get(k, default)
    for k, default in enumerate(("", "cuda:0", "32", "30", "assembly_1"))
)
num, decisions = int(num), int(decisions)
STEPS = 8
SEEDS = list(range(70000, 70000 + num))
IDS = np.arange(num)
register_policies()
checkpoint = open_checkpoint(
    Path(policy), device.partition(":")[0], n_action_steps=STEPS
)
actor = checkpoint.load(0)


def say(**facts):
    print(json.dumps(facts), flush=True)


def opened(physics):
    envs = TaccorlVectorEnv(task, num, physics=physics, images="on_request")
    observation, _ = envs.reset(seed=SEEDS)
    return envs, observation


def facts_of(envs, observation):
    sim = envs.sim
    parts = np.stack([sim.poses(name)[:, :3, 3] for name in sim.task.parts], 1)
    return {
        "state": observation[STATE_KEY].astype(float),
        "parts": parts.copy(),
        "touch": observation[TACTILE_KEY].astype(int),
        "qpos": sim.arrays["qpos"].copy(),
        "qvel": sim.arrays["qvel"].copy(),
        "subtask": sim.judge.subtask.copy(),
    }


def closed_loop(physics, pictures=None):
    """The policy acts. Targets (decisions, N, 8, 14), facts after each decision."""
    start = time.perf_counter()
    envs, observation = opened(physics)
    actor.restart()
    actor.begin(envs)
    asked, found = [], []
    for _ in range(decisions):
        if pictures == "opengl":
            drawn = envs.sim.render_by_opengl(ROBOT.cameras, IDS)
            views = {IMAGE_KEYS[name]: x for name, x in drawn.items()}
        else:
            views = envs.observe(images=True)
        chunk = []
        for _k in range(STEPS):
            acted = actor.act({**views, **observation})
            chunk.append(np.asarray(acted.actions, np.float32))
            observation, *_ = envs.step(chunk[-1])
        asked.append(np.stack(chunk, 1))
        found.append(facts_of(envs, observation))
    grasped = np.array([(one["subtask"] >= 1).all(1) for one in found])
    say(
        run=f"closed loop {physics} {pictures or ''}",
        grasped_of=num,
        grasped=[int(x) for x in grasped.sum(1)],
        seconds=round(time.perf_counter() - start, 1),
    )
    envs.close()
    return asked, found


def replay(physics, asked, touch_every):
    start = time.perf_counter()
    envs, _ = opened(physics)
    found = []
    for chunk in asked:
        if touch_every:
            observation = envs.step_chunk(chunk, touch_every=touch_every).observation
        else:
            for k in range(STEPS):
                observation, *_ = envs.step(chunk[:, k])
        found.append(facts_of(envs, observation))
    envs.close()
    return found, time.perf_counter() - start


def beside(name, ours, theirs, seconds):
    for k, (a, b) in enumerate(zip(ours, theirs, strict=True)):
        apart = {key: np.abs(a[key] - b[key]) for key in a}
        say(
            run=name,
            decision=k + 1,
            worst={key: round(float(np.nanmax(x)), 7) for key, x in apart.items()},
            mean={key: round(float(np.nanmean(x)), 8) for key, x in apart.items()},
            grasped=[int((x["subtask"] >= 1).all(1).sum()) for x in (a, b)],
            seconds=round(seconds, 1),
        )


asked, c = closed_loop("c")
again, seconds = replay("c", asked, 0)
beside("c beside c", again[-1:], c[-1:], seconds)
warp = f"warp:device={device}"
for name, physics, touch_every in (
    ("copied", warp, 0),
    ("resident", f"{warp},mode=resident", 0),
    ("resident in chunks", f"{warp},mode=resident", STEPS),
):
    found, seconds = replay(physics, asked, touch_every)
    beside(f"{name} beside c", found, c, seconds)
closed_loop(f"{warp},mode=resident")
closed_loop(f"{warp},mode=resident", "opengl")
closed_loop(warp)

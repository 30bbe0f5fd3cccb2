"""MuJoCo Warp's ray tracer beside OpenGL, on a GPU or Warp's CPU device; touch and targets of a chunk that stay there."""

import dataclasses

import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode

from taccorl.errors import TaccorlError
from taccorl.rl.start_states import StartStates
from taccorl.rl.twin_shard import DrawnPictures, TwinShard
from taccorl.robots import ROBOT
from taccorl.sim import ray_renderer
from taccorl.sim.effects import make_effect
from taccorl.sim.ray_renderer import Positions, RayRenderer
from taccorl.sim.simulation import Simulation
from taccorl.sim.spaces import IMAGE_KEYS, TACTILE_KEY
from taccorl.sim.task import tasks
from taccorl.sim.twin import TwinConfig
from taccorl.sim.vector_env import TaccorlVectorEnv
from taccorl.sim.warp_batch import WarpSettings

DEVICE = "cuda:0" if torch.cuda.is_available() else "cpu"
"""Where there is a GPU these tests are of it: pictures and physics have been wrong there alone."""
WARP = f"warp:device={DEVICE},mode=resident"
SIZE = (84, 112)
"""Rows and columns of a policy's pictures."""


@pytest.fixture
def few_worlds(monkeypatch):
    pytest.importorskip("mujoco_warp", reason="needs the extra gpu")
    monkeypatch.setattr(ray_renderer, "WORLDS_AT_ONCE", 2)


def scenes(num: int, physics: str = WARP, **settings) -> Simulation:
    sim = Simulation(
        tasks.get("assembly_1")(), num_sims=num, physics=physics, **settings
    )
    sim.reset(range(num))
    return sim


def halved(pictures: np.ndarray) -> np.ndarray:
    """Mean of 2 × 2 pixels of what is between the black bars of pictures (…, 224, 224, 3)."""
    inside = pictures[..., 28:196, :, :].astype(float)
    rows = inside[..., ::2, :, :] + inside[..., 1::2, :, :]
    return (rows[..., ::2, :] + rows[..., 1::2, :]) / 4


@pytest.mark.slow
def test_pictures_are_those_of_opengl(few_worlds):
    """Three simulations, two together: also the last one, which is drawn alone."""
    sim = scenes(3)
    rays = sim.render(ROBOT.cameras)
    opengl = sim._renderer(ROBOT.cameras, (224, 224)).render_batch(sim.batch)
    small = sim.draw_on_device(ROBOT.cameras, np.arange(3), SIZE)
    assert (
        small.shape == (3, 3, 3, *SIZE)
        and small.device.type == torch.device(DEVICE).type
    )
    for k, name in enumerate(ROBOT.cameras):
        assert rays[name].shape == (3, 224, 224, 3) and rays[name].dtype == np.uint8
        assert not rays[name][:, :28].any()  # a black bar
        apart = np.abs(rays[name].astype(int) - opengl[:, k].astype(int))
        assert apart.mean() < 1.0  # of 255; 0.4 … 0.5 measured
        assert (apart.max(-1) > 48).mean() < 0.002
        mean_of_four = halved(opengl[:, k])
        assert (
            np.abs(small[:, k].permute(0, 2, 3, 1).cpu().numpy() - mean_of_four).mean()
            < 1.0
        )
        others = np.abs(rays[name][0].astype(int) - rays[name][1].astype(int))
        # Scenes differ by more than renderers do.
        assert (others.max(-1) > 48).mean() > 3 * (apart.max(-1) > 48).mean()


@pytest.mark.slow
def test_order_and_company_change_no_pixel(few_worlds):
    sim = scenes(3)
    all_of_them = sim.draw_on_device(ROBOT.cameras[:1], np.arange(3), SIZE)
    some = sim.draw_on_device(ROBOT.cameras[:1], np.array([2, 0]), SIZE)
    assert (some == all_of_them[[2, 0]]).all()


@pytest.mark.slow
def test_every_group_shows_its_own_simulations_in_every_draw(few_worlds):
    """Three groups of two, drawn again and again after the parts have moved: each part is where OpenGL shows it."""
    sim = scenes(6)
    for shift_m in (0.0, 0.03, -0.05):
        part = sim.model.joint(sim.task.parts[0]).qposadr[0]
        sim.arrays["qpos"][:, part] += shift_m * np.linspace(-1, 1, 6)
        sim.batch.forward()
        drawn = sim.draw_on_device(ROBOT.cameras[:1], np.arange(6), SIZE)[:, 0]
        rays = drawn.permute(0, 2, 3, 1).cpu().numpy()
        opengl = halved(sim.render_by_opengl(ROBOT.cameras[:1], np.arange(6))["front"])
        far = (np.abs(rays - opengl).max(-1) > 48).mean((1, 2))
        assert far.max() < 0.001
        others = (np.abs(rays - np.roll(opengl, 1, axis=0)).max(-1) > 48).mean((1, 2))
        assert others.min() > 0.002  # of another simulation it would be seen


@pytest.mark.slow
def test_a_diverged_world_is_drawn_and_harms_no_other(few_worlds):
    sim = scenes(2)
    before = sim.draw_on_device(ROBOT.cameras[:1], np.array([1]), SIZE)
    sim.arrays["qpos"][0] = np.nan
    after = sim.draw_on_device(ROBOT.cameras[:1], np.arange(2), SIZE)
    assert (after[1] == before[0]).all()


@pytest.mark.slow
def test_what_the_ray_tracer_does_not_draw_is_refused_with_the_way_out(few_worlds):
    sim = scenes(2)
    sim.batch.expand("geom_rgba")
    with pytest.raises(TaccorlError, match=r"geom_rgba.*mode=copied"):
        Positions.of(sim.batch, np.arange(2))
    with pytest.raises(TaccorlError, match=r"frnt.*front"):
        RayRenderer(sim.model, ["frnt"], device=DEVICE)


@pytest.mark.slow
def test_late_pictures_are_left_to_opengl(few_worlds):
    late = make_effect("camera_latency", delay_s=0.1)
    sim = scenes(1, config=TwinConfig(effects=[late]))
    assert not sim.draws_on_device
    assert sim.render(["front"])["front"].any()


def test_what_stays_on_the_device_is_a_setting():
    assert WarpSettings.parse("warp:mode=resident") == WarpSettings(mode="resident")
    with pytest.raises(TaccorlError, match="did you mean 'resident'"):
        WarpSettings.parse("warp:mode=residen")


def shard(physics: str, num_actions: int, drawn: DrawnPictures | None) -> TwinShard:
    envs = TaccorlVectorEnv(
        "assembly_1",
        2,
        physics=physics,
        images="on_request",
        autoreset=AutoresetMode.DISABLED,
        max_episode_steps=8,
        num_threads=1,
    )
    made = TwinShard(
        envs,
        history=2,
        stride=4,
        num_actions=num_actions,
        starts=StartStates(0.0, 1),
        privileged=True,
        drawn=drawn,
    )
    made.restart(5)
    return made


@pytest.mark.slow
def test_decisions_that_stay_on_the_device_give_what_single_steps_do(few_worlds):
    """Two decisions of four control steps, the second one up to the time limit, and the resets after it."""
    drawn = DrawnPictures(ROBOT.cameras, SIZE)
    whole, single = shard(WARP, 4, drawn), shard(WARP, 1, None)
    c = shard("c", 4, drawn)
    assert c._drawn is None  # MuJoCo C's pictures are OpenGL's
    targets = whole.envs.sim.targets[:, None] + 0.01
    for number in range(2):
        chunk = np.repeat(targets, 4, axis=1)
        acted = [one.act(chunk) for one in (whole, single, c)]
        seen = [one.observe() for one in (whole, single, c)]
        for key in (TACTILE_KEY, "observation.state", "privileged"):
            np.testing.assert_array_equal(seen[0][key], seen[1][key])
        assert (
            np.abs(seen[0]["observation.state"] - seen[2]["observation.state"]).max()
            < 1e-5
        )
        assert acted[0].truncated_N.all() == (number == 1)
        assert acted[0].num_steps_N.tolist() == [4, 4]
        np.testing.assert_array_equal(acted[0].seed_N, acted[2].seed_N)
    last = acted[0].last
    key = IMAGE_KEYS["front"]
    assert last[key].shape == (2, 3, *SIZE)
    opengl = halved(acted[1].last[key])
    rays = last[key].permute(0, 2, 3, 1).cpu().numpy()
    assert np.abs(rays - opengl).mean() < 1.0
    new = halved(seen[1][key])  # of the episodes that follow
    assert np.abs(seen[0][key].permute(0, 2, 3, 1).cpu().numpy() - new).mean() < 1.0
    assert np.abs(new - opengl).mean() > 1.0
    for one in (whole, single, c):
        one.close()


@pytest.mark.slow
def test_an_episode_that_ends_within_a_decision_keeps_its_own_reading(few_worlds):
    """A bad action ends one of two: its state, touch and picture are of its last step, whatever the device went on with."""
    whole = shard(WARP, 4, DrawnPictures(ROBOT.cameras[:1], SIZE))
    single = shard(WARP, 1, None)
    chunk = np.repeat(whole.envs.sim.targets[:, None] + 0.01, 4, axis=1)
    chunk[0, 2:] = np.nan
    whole.envs.step_chunk(chunk, touch_every=4)
    single.envs.step_chunk(chunk)
    for one in (whole, single):
        assert one.envs.facts()["steps"].tolist() == [2, 4]
    np.testing.assert_array_equal(
        whole.envs.observe()[TACTILE_KEY], single.envs.observe()[TACTILE_KEY]
    )
    for field in dataclasses.fields(whole.envs.sim.snapshot()):
        ours, theirs = (
            getattr(x.envs.sim.snapshot(), field.name) for x in (whole, single)
        )
        if isinstance(ours, np.ndarray):
            np.testing.assert_array_equal(ours, theirs)
    for one in (whole, single):
        one.close()

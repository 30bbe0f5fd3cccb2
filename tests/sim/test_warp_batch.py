"""Physics of MuJoCo Warp on its CPU device against MuJoCo C. Without Warp's cache the first step compiles for a minute."""

import re
from typing import Any

import mujoco
import numpy as np
import pytest

from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.effects import effects, make_effect
from taccorl.sim.effects.effect import Effect
from taccorl.sim.pad import KINEMATIC_FIELDS
from taccorl.sim.simulation import Simulation
from taccorl.sim.task import tasks
from taccorl.sim.twin import PhysicsConfig, TwinConfig
from taccorl.sim.warp_batch import WarpBatch, WarpSettings, _for_warp, _Worlds
from tests.sim.expert_episode import MIDDLE, SEED, expert_episode, together

ON_CPU = "warp:device=cpu"


@pytest.fixture
def warp():
    return pytest.importorskip("mujoco_warp", reason="needs the extra gpu")


def mating(physics: str, **settings) -> tuple[Simulation, np.ndarray]:
    """Two worlds with both parts in the hands, the second one just before they mate, and the expert's next actions."""
    episode = expert_episode()
    sim = Simulation(tasks.get("assembly_1")(), num_sims=2, physics=physics, **settings)
    sim.reset([5, 6])
    sim.restore(together(episode.middle, episode.late))
    return sim, episode.actions[[MIDDLE, -3]]


def parts(sim: Simulation) -> np.ndarray:
    """(N, parts, 3) positions [m]."""
    return np.stack([sim.poses(part)[:, :3, 3] for part in sim.task.parts], axis=1)


def worlds(sim: Simulation) -> WarpBatch:
    assert isinstance(sim.batch, WarpBatch)
    return sim.batch


@pytest.mark.slow
def test_parts_in_hands_move_as_in_mujoco_c(warp):
    (ours, goal), (c, _) = mating(ON_CPU), mating("c")
    before = parts(c)
    for _ in range(2):
        ours.step(goal)
        c.step(goal)
    assert np.abs(parts(c) - before).max() > 1e-3  # otherwise standing still would pass
    free, mating_m = np.abs(parts(ours) - parts(c)).max((1, 2))
    assert (
        free < 1e-6 and mating_m < 1e-5
    )  # 2e-5 with the normals of another collision of boxes
    assert np.median(np.abs(ours.arrays["qpos"] - c.arrays["qpos"])) < 1e-6
    np.testing.assert_array_equal(ours.arrays["time"], c.arrays["time"])
    np.testing.assert_array_equal(ours.pads_touching("plug"), c.pads_touching("plug"))
    np.testing.assert_allclose(ours.touch(), c.touch(), rtol=0, atol=2)
    assert c.touch().max() > 50
    free, mating_nm = np.abs(ours.effort() - c.effort()).max(1)
    assert free < 1e-3 and mating_nm < 0.1


@pytest.mark.slow
def test_pads_near_the_table_feel_what_they_do_in_mujoco_c(warp):
    """The device's table is a plane at the height of the box's face; pads feel the box where it was."""
    sim = Simulation(tasks.get("assembly_1")())
    sim.reset([SEED])
    actions, lowest = expert_episode().actions, (np.inf, sim.snapshot(), 0)
    pads = [sim.model.site(pad).id for pad in ROBOT.pads]
    for k, action in enumerate(actions[:MIDDLE]):
        sim.step(action[None])
        height = sim.batch.site_xpos[0, pads, 2].min()
        if height < lowest[0]:
            lowest = height, sim.snapshot(), k + 1
    height, state, k = lowest
    assert height < 0.04  # of their middles: edges within the half thickness, 0.02
    ours = Simulation(sim.task, physics=ON_CPU)
    ours.reset([SEED])
    for one in (ours, sim):
        one.restore(state)
        one.step(actions[k][None])
    for name in KINEMATIC_FIELDS:
        np.testing.assert_allclose(
            getattr(ours.batch, name), getattr(sim.batch, name), rtol=0, atol=1e-4
        )
    np.testing.assert_allclose(ours.touch(), sim.touch(), rtol=0, atol=3)


@pytest.mark.slow
def test_each_world_has_its_own_mass_and_friction(warp):
    ours, _ = mating(ON_CPU)
    ours.reset([0, 1])
    ours.step(ours.targets)
    plug, model = ours.model.body("plug").id, worlds(ours)._worlds().of_model
    masses = ours.batch.expand("body_mass")[:, plug]
    assert masses[0] != masses[1]
    np.testing.assert_allclose(model["body_mass"][:, plug].numpy(), masses, rtol=1e-6)
    friction = ours.batch.expand("geom_friction")
    assert (friction[0] != friction[1]).any()
    np.testing.assert_allclose(model["geom_friction"].numpy(), friction, rtol=1e-6)


@pytest.mark.slow
def test_a_tensor_is_the_device_s_own_memory(warp):
    ours, goal = mating(ON_CPU)
    ours.step(goal)
    batch = worlds(ours)
    qpos = batch.tensor("qpos")
    assert qpos.data_ptr() == batch._worlds()._data.qpos.ptr
    np.testing.assert_array_equal(qpos.numpy(), ours.arrays["qpos"].astype(np.float32))
    ours.step(goal)
    np.testing.assert_array_equal(qpos.numpy(), ours.arrays["qpos"].astype(np.float32))


@pytest.mark.slow
def test_a_world_of_nan_ends_alone_and_a_reset_revives_it(warp):
    (ours, goal), (others, _) = mating(ON_CPU), mating(ON_CPU)
    ours.arrays["qvel"][0, 3] = np.nan
    for sim in (ours, others):
        sim.step(goal)
        sim.step(goal, None if sim is others else np.array([1]))
    assert ours.diverged.tolist() == [True, False]
    np.testing.assert_array_equal(ours.arrays["qpos"][1], others.arrays["qpos"][1])
    ours.reset([9], np.array([0]))
    fresh = Simulation(tasks.get("assembly_1")(), physics=ON_CPU)
    fresh.reset([9])
    ours.step(ours.targets)
    fresh.step(fresh.targets)
    assert not ours.diverged.any()
    np.testing.assert_allclose(
        ours.arrays["qpos"][0], fresh.arrays["qpos"][0], rtol=0, atol=1e-9
    )


@pytest.mark.slow
def test_a_world_that_diverges_on_the_device_is_reported(warp):
    ours, goal = mating(ON_CPU)
    ours.arrays["qvel"][0] = (
        1e7  # finite for MuJoCo C's check, and no more after a few steps
    )
    ours.step(goal)
    assert ours.diverged.tolist() == [True, False]
    assert np.isfinite(ours.arrays["qpos"][1]).all()


@pytest.mark.slow
def test_a_frozen_world_stays_as_it_is_and_goes_on_from_there(warp):
    (ours, goal), (whole, _) = mating(ON_CPU), mating(ON_CPU)
    before = ours.batch.state[0].copy()
    ours.step(goal, np.array([1]))
    np.testing.assert_array_equal(ours.batch.state[0], before)
    ours.step(goal, np.array([0]))
    whole.step(goal)
    np.testing.assert_array_equal(ours.arrays["qpos"], whole.arrays["qpos"])
    np.testing.assert_array_equal(ours.arrays["sensordata"], whole.arrays["sensordata"])


@pytest.mark.slow
@pytest.mark.parametrize(("name", "few"), [("contacts", 4), ("constraints", 40)])
def test_full_buffers_are_an_error_that_states_a_setting_which_is_enough(
    warp, name, few
):
    def on_the_table(physics: str) -> Simulation:
        sim = Simulation(tasks.get("assembly_1")(), num_sims=2, physics=physics)
        sim.reset([0, 1])
        return sim

    ours = on_the_table(f"{ON_CPU},{name}={few}")
    before = ours.arrays["qpos"].copy()
    with pytest.raises(
        TaccorlError, match=f"room for more than {few} {name} .*Raise it: .*{name}="
    ) as error:
        ours.step(ours.targets)
    np.testing.assert_array_equal(ours.arrays["qpos"], before)
    np.testing.assert_array_equal(ours.arrays["time"], 0.0)
    enough, whole = (
        on_the_table(f"{ON_CPU},{name}={str(error.value).rpartition('=')[2]}"),
        on_the_table(ON_CPU),
    )
    for sim in (enough, whole):
        sim.step(ours.targets)
    np.testing.assert_array_equal(parts(enough), parts(whole))


@pytest.mark.slow
def test_a_cylinder_on_the_table_touches_it_and_is_not_thrown_off(warp):
    """1 … 10 µm deep, tilted by 0.3 mrad: none of 4000 may be without contact, as many are beside a box, or as deep as 1 mm."""
    rng, n, part = (
        np.random.default_rng(1),
        4000,
        '<body><freejoint/><geom type="cylinder" size="0.02 0.01"/></body>',
    )
    table = '<geom name="table" type="box" size="0.5 0.7 0.02" pos="0.35 0 -0.02"/>'
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody>{table}{part}</worldbody></mujoco>"
    )
    made, yaw = _for_warp(model), rng.uniform(0, 2 * np.pi, n)
    poses = [
        rng.uniform(0, 0.6, n),
        rng.uniform(-0.3, 0.3, n),
        0.01 - rng.uniform(1e-6, 1e-5, n),
        np.cos(yaw / 2),
    ]
    poses += [*(1.5e-4 * rng.normal(size=(2, n))), np.sin(yaw / 2)]
    settings = WarpSettings(device="cpu", contacts=8)
    worlds = _Worlds(made, n, settings, [])
    worlds.write(worlds.tensor("qpos"), np.ones(n, bool), np.stack(poses, axis=1))
    warp.kinematics(worlds._model, worlds._data)
    warp.collision(worlds._model, worlds._data)
    count = int(worlds._data.nacon.numpy()[0])
    assert {*worlds._data.contact.worldid.numpy()[:count].tolist()} == {*range(n)}
    assert worlds._data.contact.dist.numpy()[:count].min() > -1e-3


@pytest.mark.slow
def test_a_world_whose_contact_is_given_up_has_diverged_and_stops_no_other(
    warp, monkeypatch
):
    """Room for two edges of EPA's horizon: the cylinder in the box of the first world is not found; the second one's falls."""
    part = '<body><freejoint/><geom type="cylinder" size="0.02 0.01"/></body><geom type="box" size="0.1 0.1 0.01"/>'
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody>{part}</worldbody></mujoco>"
    )

    def falling(edges: int) -> tuple[list[int], np.ndarray]:
        monkeypatch.setattr(
            "mujoco_warp._src.collision_convex.MJ_MAX_EPAHORIZON", edges
        )
        batch = WarpBatch(model, 2, 1, settings=WarpSettings(device="cpu", contacts=8))
        batch.bind("qpos")[:] = [
            [0.0, 0.02, 0.019, 1.0, 0.0, 0.0, 0.0],
            [0.0, 0.02, 1.0, 1.0, 0.0, 0.0, 0.0],
        ]
        batch.step(nstep=5, stage=mujoco.mjtStage.mjSTAGE_POS)
        return batch.warning[
            :, int(mujoco.mjtWarning.mjWARN_BADQACC), 1
        ].tolist(), batch.bind("qpos")[1].copy()

    (lost, fell), (none, whole) = falling(2), falling(24)
    assert lost == [1, 0] and none == [0, 0]
    np.testing.assert_array_equal(fell, whole)


@pytest.mark.slow
def test_one_world_may_have_more_contacts_than_worlds_have_room_for_in_the_mean(warp):
    """Twelve boxes on a table touch it at 48 corners, in the other world at none: 24 in the mean, room for 32."""
    boxes = "".join(
        f'<body pos="{0.1 * k} 0 0.01"><freejoint/><geom type="box" size="0.01 0.01 0.01"/></body>'
        for k in range(12)
    )
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><geom name="floor" type="plane" size="9 9 1"/>{boxes}</worldbody>'
        '<sensor><contact geom1="floor" data="found"/></sensor></mujoco>'
    )
    settings = WarpSettings(device="cpu", contacts=32, constraints=512)
    batch = WarpBatch(model, 2, 1, settings=settings)
    found = batch.bind("sensordata")
    batch.bind("qpos")[1, 2::7] = 1.0
    batch.step(nstep=2, stage=mujoco.mjtStage.mjSTAGE_ACC)
    assert found.ravel().tolist() == [48.0, 0.0]


# A delay in MuJoCo's history, a friction of the model, further joints, and what is rewritten after each physics step.
@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["command_delay", "coulomb_friction", "joint_compliance", "torque_lag"]
)
def test_an_effect_acts_as_in_mujoco_c(warp, name):
    def swung(physics: str, *present: Effect) -> np.ndarray:
        config = TwinConfig(
            physics=PhysicsConfig(steps_per_control_step=20), effects=list(present)
        )
        sim = Simulation(tasks.get("assembly_1")(), config, physics=physics)
        sim.reset([3])
        start, is_joint = sim.targets.copy(), np.arange(14) % 7 != 6
        for k in range(3):
            sim.step(
                start + 0.2 * np.sin(0.7 * (k + 1)) * np.cos(np.arange(14)) * is_joint
            )
        return sim.proprioception()[0]

    effect = make_effect(
        name, **{p.name: p.typical for p in effects.get(name).parameters()}
    )
    acts = np.abs(swung("c", effect) - swung("c")).max()
    assert acts > 1e-4  # 30 times the tolerance
    np.testing.assert_allclose(
        swung(ON_CPU, effect), swung("c", effect), rtol=0, atol=3e-6
    )


def test_an_effect_that_mujoco_warp_lacks_is_refused_by_name(warp):
    effect = make_effect("integral_action", rate_per_s=0.5)
    others = [
        make_effect("coulomb_friction", torque_nm=0.4),
        make_effect("taxel_saturation", limit=4.0),
    ]
    with pytest.raises(
        TaccorlError,
        match=r"integral_action: .*does not support mjDYN_PID; use physics=c",
    ):
        Simulation(
            tasks.get("assembly_1")(),
            TwinConfig(effects=[*others, effect]),
            physics=ON_CPU,
        )


@pytest.mark.slow
def test_worlds_that_do_not_fit_are_an_error_that_says_how_many_do(warp, monkeypatch):
    """An allocation that fails as Warp's do, on a device with 2048 MB free."""
    monkeypatch.setattr("taccorl.sim.warp_batch._FEW", (1, 2))
    monkeypatch.setattr(
        type(__import__("warp").get_device("cpu")),
        "free_memory",
        property(lambda device: 2**31),
    )
    allocate = _Worlds._allocate

    def failing(self: _Worlds, model: mujoco.MjModel) -> Any:
        if self._num > 2:
            raise RuntimeError("Failed to allocate 3000 bytes on device 'cpu'")
        return allocate(self, model)

    monkeypatch.setattr(_Worlds, "_allocate", failing)
    sim = Simulation(tasks.get("assembly_1")(), num_sims=3, physics=ON_CPU)
    sim.reset([0, 1, 2])
    with pytest.raises(
        TaccorlError,
        match=r"3 worlds do not fit the memory of cpu .*about \d+ fit, at \S+ MB each",
    ) as error:
        sim.step(sim.targets)
    fit, each_mb = (
        float(x)
        for x in re.findall(r"about (\d+) fit, at (\S+) MB", str(error.value))[0]
    )
    assert 0.1 < each_mb < 5
    assert abs(fit * each_mb - 2048) < 0.06 * 2048


def test_settings_are_read_from_one_word():
    assert WarpSettings.parse("c") is None
    assert WarpSettings.parse("warp") == WarpSettings()
    assert WarpSettings.parse("warp:device=cuda:1,contacts=128") == WarpSettings(
        device="cuda:1", contacts=128
    )


@pytest.mark.parametrize(
    ("physics", "named"),
    [
        ("gpu", "known: c, warp"),
        ("wrap", "did you mean 'warp'"),
        ("warp:contact=3", "did you mean 'contacts'"),
        ("warp:contacts=0", "contacts='0' is no whole number ≥ 1"),
        ("warp:contacts=many", "contacts='many'"),
    ],
)
def test_wrong_physics_is_an_error_that_names_the_nearest(physics, named):
    with pytest.raises(TaccorlError, match=named):
        Simulation(tasks.get("assembly_1")(), physics=physics)


def test_a_missing_device_is_named_with_the_ways_out(warp):
    with pytest.raises(
        TaccorlError,
        match=r"no device 'cuda:7'; Warp finds .*physics=c, or .*device=cpu",
    ):
        Simulation(tasks.get("assembly_1")(), physics="warp:device=cuda:7")


def test_a_missing_extra_is_named_with_the_command_that_installs_it(monkeypatch):
    monkeypatch.setattr(
        "taccorl.extras._is_installed", lambda module: module != "mujoco_warp"
    )
    with pytest.raises(TaccorlError, match=r"needs mujoco_warp.*pip install .*\[gpu\]"):
        Simulation(tasks.get("assembly_1")(), physics="warp")

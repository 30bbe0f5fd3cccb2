"""Each effect of the pads against its closed form, on readings written down here; pads in the order left_a … right_b."""

from dataclasses import replace

import numpy as np
import pytest
from press_bench import BLOCK_M, perform, start, typical_effect

from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.effects import effects, make_effect
from taccorl.sim.effects.added import AddedEffects
from taccorl.sim.effects.effect import Effect
from taccorl.sim.effects.pads import DeadTaxels, TaxelGainMap
from taccorl.sim.robot import RobotConfig
from taccorl.sim.simulation import Watch
from taccorl.sim.twin import TwinConfig, empty_bench

SHAPE = (1, len(ROBOT.pads), *ROBOT.pad.shape)


class Pads:
    """Effects on the pads of one simulation, with a clock that is set by hand."""

    def __init__(self, *effects: Effect) -> None:
        self.time_s = np.zeros(1)
        self.added = AddedEffects(effects, self.time_s)

    def read(self, reading: np.ndarray | float, after_s: float = 0.0) -> np.ndarray:
        """(4, 32, 12) where ideal pads read ``reading``."""
        self.time_s += after_s
        given = np.broadcast_to(np.float32(reading), SHAPE).copy()
        before = given.copy()
        seen = self.added(given)
        self.added.scan(given, np.arange(1))
        np.testing.assert_array_equal(
            self.added(given), seen, err_msg="after its scan it reads something else"
        )
        np.testing.assert_array_equal(
            given, before, err_msg="what the sensor handed over was changed"
        )
        assert seen.dtype == np.float32 and seen.shape == SHAPE
        return seen[0]


def bumps() -> np.ndarray:
    """(4, 32, 12) some readings of 0 … 3, with 0 where nothing touches."""
    return np.maximum(np.random.default_rng(0).uniform(-2, 3, SHAPE[1:]), 0).astype(
        np.float32
    )


@pytest.mark.parametrize(
    ("name", "values", "path", "expected"),
    [
        (
            "taxel_power_law",
            {"exponent": 1.5, "reference": 0.5},
            [0.5, 1.0, 0.0],
            [0.5, 0.5 * 2**1.5, 0.0],
        ),
        (
            "taxel_power_law",
            {"exponent": 0.5, "reference": 0.5},
            [0.5, 1.0, 0.0],
            [0.5, 0.5 * 2**0.5, 0.0],
        ),
        (
            "taxel_power_law",
            {"exponent": 2.0, "reference": 0.5},
            [0.5, 1.0, 0.0],
            [0.5, 0.5 * 4.0, 0.0],
        ),
        (
            "taxel_saturation",
            {"limit": 2.0},
            [0.0, 0.5, 2.0, 6.0, 1998.0],
            [0.0, 0.4, 1.0, 1.5, 1.998],
        ),
        (
            "taxel_threshold",
            {"threshold": 0.3},
            [0.0, 0.2, 0.3, 1.0],
            [0.0, 0.0, 0.0, 0.7],
        ),
        # Loading 0.9 f; at 1.9 the play of 1.71 … 2.09 holds 1.8; unloading 1.1 f; at 1.05 its 0.945 … 1.155 holds 1.1.
        (
            "taxel_hysteresis",
            {"half_width": 0.1},
            [0, 1, 2, 1.9, 1, 1.05, 0, 1],
            [0, 0.9, 1.8, 1.8, 1.1, 1.1, 0, 0.9],
        ),
        # Below 0, as by noise of a measured load, nothing pulls.
        (
            "taxel_play",
            {"half_width": 0.1},
            [-1.0, 1.0, 2.0, 1.9, 1.0, -1.0],
            [0.0, 0.9, 1.9, 1.9, 1.1, 0.1],
        ),
        # Mean of the load and of a play of half width 0.2, which reads 0, 0.8, 1.8, 1.8, 1.2, 0.2.
        (
            "taxel_play",
            {"half_width": 0.1, "elastic": 0.5},
            [0, 1, 2, 1.9, 1, 0],
            [0, 0.9, 1.9, 1.85, 1.1, 0.1],
        ),
        # Eight plays, w = 0.3, 0.5 … 1.7. Loaded to 2 each reads 2 − w; at 0.5 the first three read 0.5 + w, the others hold:
        # 0.8 + 1.0 + 1.2, and 1.1 + 0.9 + 0.7 + 0.5 + 0.3.
        (
            "taxel_play",
            {"half_width": 1.0, "spread": 0.7},
            [0, 2, 0.5],
            [0, 1.0, 6.5 / 8],
        ),
        # Relaxation sinks under a load that stays, and never pulls: −0.5 · 2 (1 − e^(−0.01 / 0.5)) after a scan.
        (
            "taxel_creep",
            {"share": -0.5, "time_constant_s": 0.5},
            [2.0, 0.0],
            [2.0 - (1 - np.exp(-0.02)), 0.0],
        ),
    ],
)
def test_a_taxel_reads_what_the_law_says(name, values, path, expected):
    pads = Pads(make_effect(name, **values))
    np.testing.assert_allclose(
        [pads.read(f, 0.01)[2, 3, 4] for f in path], expected, rtol=1e-5, atol=1e-6
    )


@pytest.mark.parametrize(
    ("name", "values", "scan_s", "given", "expected"),
    [
        *(
            (
                "taxel_creep",
                {"share": 0.3, "time_constant_s": 0.8},
                s,
                lambda t: 2.0,
                creep,
            )
            for s in (0.01, 0.04)
            for creep in [lambda t: 2.0 * (1 + 0.3 * (1 - np.exp(-t / 0.8)))]
        ),
        *(
            (
                "touch_lag",
                {"time_constant_s": 0.1},
                s,
                lambda t: 2.0,
                lambda t: 2.0 * (1 - np.exp(-t / 0.1)),
            )
            for s in (0.01, 0.033)
        ),
        # A reading that rises evenly is late by the delay; before the first scan there was nothing.
        *(
            (
                "touch_delay",
                {"delay_s": d},
                s,
                lambda t: 3.0 * t,
                lambda t, d=d: 3.0 * np.maximum(t - d, 0.0),
            )
            for s, d in ((0.01, 0.025), (0.01, 0.2), (0.005, 0.04), (0.0333, 0.02))
        ),
    ],
)
def test_a_memory_follows_its_law_at_any_scan_rate(
    name: str, values: dict[str, float], scan_s: float, given, expected
):
    pads = Pads(make_effect(name, **values))
    time_s = scan_s * np.arange(1, 61)
    seen = [pads.read(np.float32(given(t)), scan_s)[3, 31, 11] for t in time_s]
    np.testing.assert_allclose(seen, expected(time_s), rtol=1e-5, atol=1e-5)


def test_ghosting_adds_its_share_of_each_taxel_to_the_others_of_its_row_and_column() -> (
    None
):
    pads = Pads(make_effect("taxel_ghosting", share=0.05))
    field = np.zeros(SHAPE[1:], np.float32)
    field[2, 10, 5], field[2, 10, 7] = 2.0, 1.0
    seen = pads.read(field)[2]
    expected = np.zeros(ROBOT.pad.shape)
    expected[10] = 0.05 * 3.0  # both are in this row
    expected[10, 5], expected[10, 7] = 2.0 + 0.05 * 1.0, 1.0 + 0.05 * 2.0
    expected[:, 5] += 0.1 * (np.arange(32) != 10)
    expected[:, 7] += 0.05 * (np.arange(32) != 10)
    np.testing.assert_allclose(seen, expected, atol=1e-6)


def test_a_gain_map_is_of_the_taxels_it_names_and_a_share_of_it_fades_out() -> None:
    gains = np.random.default_rng(0).uniform(0.0, 2.0, (2, *ROBOT.pad.shape))
    gains[0, 3, 4] = 0.0
    chosen = ["right_a", "left_b"]
    effect = TaxelGainMap.of(gains, chosen)
    seen = Pads(effect).read(bumps())
    np.testing.assert_allclose(seen[2], gains[0] * bumps()[2], atol=1e-5)
    np.testing.assert_allclose(seen[1], gains[1] * bumps()[1], atol=1e-5)
    np.testing.assert_array_equal(seen[[0, 3]], bumps()[[0, 3]])
    half = make_effect("taxel_gain_map", share=0.5, gains=[0.8])
    np.testing.assert_allclose(Pads(half).read(2.0), 1.8, rtol=1e-6)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"gains": [1.0] * 10}, "10 gains.*1536 taxels"),
        ({"gains": [-1.0]}, "-1.0"),
        ({"gains": ["x"]}, "'x'"),
    ],
)
def test_a_map_that_fits_no_pads_is_refused(values: dict, message: str) -> None:
    with pytest.raises(TaccorlError, match=rf"taxel_gain_map.*{message}"):
        make_effect("taxel_gain_map", share=1.0, **values)


@pytest.mark.parametrize("offset_m", [3e-4, -3e-4])
def test_a_thicker_pad_touches_at_an_opening_that_is_greater_by_its_offset(
    offset_m: float,
) -> None:
    """Each pad stands d further out: it feels what the nominal one feels at an opening that is 2 d less."""
    effect = make_effect("depth_offset", offset_m=offset_m)

    def pressed(opening_m: float, *effects: Effect) -> np.ndarray:
        sim = start(*effects)
        joints = sim.proprioception()[0].copy()
        joints[6] = opening_m
        sim.place_arms(joints, sim.targets[0])
        return sim.pads.penetration(sim.batch).depth_m[0, :2]

    opening_m = BLOCK_M - 8e-4
    expected = pressed(opening_m - 2 * offset_m)
    assert expected.max() == pytest.approx(4e-4 + offset_m, abs=2e-5)
    np.testing.assert_allclose(pressed(opening_m, effect), expected, atol=1e-6)


def test_a_shifted_pad_feels_with_each_taxel_what_the_next_one_would() -> None:
    """Two millimetres are one taxel. Across the hand is +x on pad a and −x on pad b, which looks at it from the other side."""

    def reading(*effects: Effect) -> np.ndarray:
        sim = start(*effects)
        joints = sim.proprioception()[0].copy()
        joints[6] = BLOCK_M - 8e-4
        sim.place_arms(joints, sim.targets[0])
        return (
            sim.pads.penetration(sim.batch).depth_m[0, :2].reshape(2, *ROBOT.pad.shape)
        )

    plain, shifted = (
        reading(),
        reading(make_effect("pad_shift", across_m=2e-3, along_m=-4e-3)),
    )
    assert plain.max() > 3e-4
    np.testing.assert_allclose(shifted[0, 2:, :-1], plain[0, :-2, 1:], atol=1e-7)
    np.testing.assert_allclose(shifted[1, 2:, 1:], plain[1, :-2, :-1], atol=1e-7)


def squeezed(effect: str, factor: float, steps: int):
    sim = start(make_effect(effect, stiffness_factor=factor))
    targets = sim.targets.copy()
    targets[0, 6] = BLOCK_M - 0.008
    for _ in range(steps):
        sim.step(targets)
    return sim


def test_a_softer_part_is_pressed_in_further_by_the_same_command() -> None:
    opening = {
        f: squeezed("contact_compliance", f, 10).proprioception()[0, 6]
        for f in (1.0, 0.02)
    }
    assert opening[0.02] < opening[1.0] - 1e-4


def test_crosstalk_gives_a_quarter_of_its_share_to_each_neighbour_and_keeps_the_sum() -> (
    None
):
    pads = Pads(make_effect("taxel_crosstalk", share=0.2))
    alone = np.zeros(SHAPE[1:], np.float32)
    alone[1, 10, 5] = alone[1, 0, 0] = 1.0
    seen = pads.read(alone)
    expected = np.zeros(ROBOT.pad.shape)
    expected[10, 5], expected[0, 0] = (
        0.8,
        0.9,
    )  # the corner has two neighbours and keeps two quarters
    for row, column in ((9, 5), (11, 5), (10, 4), (10, 6), (1, 0), (0, 1)):
        expected[row, column] = 0.05
    np.testing.assert_allclose(seen[1], expected, atol=1e-7)
    field = bumps()
    np.testing.assert_allclose(
        pads.read(field).sum(axis=(1, 2)), field.sum(axis=(1, 2)), rtol=1e-5
    )


def test_gain_spread_is_of_the_stated_width_and_belongs_to_the_board() -> None:
    one, same, other = (
        Pads(make_effect("taxel_gain_spread", log_std=0.2, seed=s)) for s in (3, 3, 4)
    )
    gain = one.read(1.0)
    log = np.log(gain)
    # 1536 draws: standard errors 0.2 / √1536 = 0.005 of the mean, 0.0036 of the deviation; four of them allowed
    assert abs(log.mean()) < 0.02 and log.std() == pytest.approx(0.2, abs=0.015)
    np.testing.assert_array_equal(same.read(1.0), gain)
    assert (other.read(1.0) != gain).all()
    np.testing.assert_allclose(one.read(bumps()), bumps() * gain, rtol=1e-6)


def test_dead_taxels_are_as_many_as_stated_and_a_greater_share_adds_to_them() -> None:
    few, more = DeadTaxels(share=0.05, seed=1), DeadTaxels(share=0.10, seed=1)
    some, others = few.dead(SHAPE[1:]), more.dead(SHAPE[1:])
    assert some.sum(axis=(1, 2)).tolist() == [19] * 4  # round(0.05 · 384)
    assert others.sum(axis=(1, 2)).tolist() == [38] * 4 and others[some].all()
    assert (some[0] != some[1]).any()
    np.testing.assert_array_equal(Pads(few).read(1.0) == 0.0, some)
    np.testing.assert_array_equal(Pads(DeadTaxels(share=1.0)).read(1.0), 0.0)


def test_the_baseline_drifts_by_its_rate_even_where_taxels_are_dead() -> None:
    pads = Pads(make_effect("baseline_drift", rate_per_min=0.5), DeadTaxels(share=1.0))
    assert pads.read(1.0)[0, 0, 0] == 0.0
    np.testing.assert_allclose(pads.read(1.0, 90.0), 0.75, rtol=1e-6)


def test_effects_act_from_the_material_outwards_whatever_their_order_in_the_file() -> (
    None
):
    """Spread before gain: a taxel's neighbour gets c/4 of the load, times its own gain."""
    effects = [
        make_effect("taxel_gain_spread", log_std=0.3),
        make_effect("taxel_crosstalk", share=0.2),
        make_effect("taxel_power_law", exponent=2.0, reference=1.0),
    ]
    gain = Pads(effects[0]).read(1.0)
    field = np.zeros(SHAPE[1:], np.float32)
    field[0, 10, 5] = 3.0
    for order in (effects, effects[::-1]):
        seen = Pads(*order).read(field)
        assert seen[0, 10, 6] == pytest.approx(0.05 * 9.0 * gain[0, 10, 6], rel=1e-5)


OF_READINGS = [
    name
    for name in effects
    if "cells" in effects.get(name).kinds() or effects.get(name).slot == "taxel"
]


@pytest.mark.parametrize(
    "name",
    [name for name in OF_READINGS if "temperature" not in effects.get(name).needs],
)
def test_only_the_chosen_pads_change_and_do_so_as_they_would_among_all(
    name: str,
) -> None:
    everything = typical_effect(name)
    some, everything = (
        Pads(replace(everything, pads=["right_a", "left_b"])),
        Pads(everything),
    )
    for _ in range(2):
        seen, full = some.read(bumps(), 0.01), everything.read(bumps(), 0.01)
        np.testing.assert_array_equal(seen[[0, 3]], bumps()[[0, 3]])
        np.testing.assert_array_equal(seen[[1, 2]], full[[1, 2]])
        assert (full != bumps()).any()


def test_a_softer_pad_gives_way_by_the_inverse_of_its_stiffness_under_the_same_force() -> (
    None
):
    pressed = {}
    for factor in (1.0, 0.5):
        sim = squeezed("pad_compliance", factor, 15)
        compression = [sim.batch.joint(f"left_{f}_spring").qpos[0, 0] for f in "ab"]
        pressed[factor] = np.mean(compression) / sim.effort()[0, 6]
    assert pressed[0.5] / pressed[1.0] == pytest.approx(2.0, rel=0.03)


def test_pads_without_springs_cannot_be_made_softer() -> None:
    config = TwinConfig(robot=RobotConfig(pads="rigid"))
    with pytest.raises(TaccorlError, match=r"pad_compliance.*rigid.*robot\.pads"):
        make_effect("pad_compliance", stiffness_factor=0.5).edit(
            empty_bench(config), config
        )


def test_touch_of_a_simulation_passes_through_the_effects() -> None:
    plain = perform(start())
    assert plain["reading"].max() > 0.5
    dead = DeadTaxels(share=0.3, seed=2)
    seen = perform(start(dead))
    np.testing.assert_array_equal(
        seen["reading"], plain["reading"] * ~dead.dead(SHAPE[1:])
    )
    assert (seen["touch"] != plain["touch"]).any()


def test_creep_goes_on_whether_somebody_looks_or_not() -> None:
    effect = make_effect("taxel_creep", share=0.5, time_constant_s=0.1)
    watched, alone = start(effect), start(effect)

    def look(_: int) -> None:
        watched.touch()

    targets = watched.targets.copy()
    targets[0, 6] = BLOCK_M - 0.008
    for _ in range(6):
        watched.step(targets, watch=Watch([10, 25], look))
        watched.touch()
        alone.step(targets)
    assert (alone.reading() > 0).any()
    np.testing.assert_array_equal(alone.reading(), watched.reading())


@pytest.mark.parametrize(
    "name", ["touch_lag", "touch_delay", "taxel_creep", "taxel_hysteresis"]
)
def test_an_effect_with_memory_takes_pads_of_any_size(name: str) -> None:
    """The taxels do not interact: a pad of 16 × 16 reads what the first 256 taxels of a pad of 32 × 12 read."""
    rng = np.random.default_rng(0)
    scans = rng.uniform(0.0, 2.0, (5, 1, len(ROBOT.pads), ROBOT.pad.num_taxels)).astype(
        np.float32
    )
    seen = {}
    for shape in (ROBOT.pad.shape, (16, 16)):
        time_s = np.zeros(1)
        added = AddedEffects([typical_effect(name)], time_s, pad_shape=shape)
        frames = []
        for scan in scans[..., : shape[0] * shape[1]]:
            reading = scan.reshape(1, -1, *shape)
            frames.append(added(reading).reshape(1, len(ROBOT.pads), -1)[..., :256])
            added.scan(reading, np.arange(1))
            time_s += 0.01
        seen[shape] = np.array(frames)
    np.testing.assert_array_equal(seen[16, 16], seen[ROBOT.pad.shape])

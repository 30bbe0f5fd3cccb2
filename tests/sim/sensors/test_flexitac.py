"""FlexiTac pads: law, scan, converter, noise; what they send goes through ingest and comes back as the same counts."""

from collections.abc import Sequence
from pathlib import Path

import h5py
import numpy as np
import pytest

from taccorl.data.cutting import open_episodes
from taccorl.data.sensor_spec import load_sensor_spec
from taccorl.data.spec import data_specs_folder, find_spec
from taccorl.errors import TaccorlError
from taccorl.sim.robot import RobotConfig
from taccorl.sim.sensors import Sensor, as_wire, sensors, standard_normal
from taccorl.sim.sensors.flexitac import (
    FlexiTacConfig,
    at_scan_instants,
    normal_reading,
    scan_instants_s,
)
from taccorl.sim.sensors.noise import ScanNoise

PADS = ("left_a", "left_b", "right_a", "right_b")
SPEC = load_sensor_spec(find_spec("flexitac_v2"))


def touch(
    num_sims: int = 1, seed: int = 0, deepest_m: float = 0.0009
) -> tuple[np.ndarray, np.ndarray]:
    """(N, 4, 384) depth and rate: every second taxel pressed."""
    rng = np.random.default_rng(seed)
    shape = (num_sims, 4, 384)
    pressed = rng.random(shape) < 0.5
    depth = (rng.uniform(0, deepest_m, shape) * pressed).astype(np.float32)
    return depth, (rng.normal(0, 0.005, shape) * pressed).astype(np.float32)


def sense(
    sensor: Sensor,
    depth: np.ndarray,
    rate: np.ndarray | None = None,
    noise=None,
    time_s=None,
) -> np.ndarray:
    """(N, 4, 32, 12) counts on the wire."""
    reading = sensor.reading(
        depth, np.zeros_like(depth) if rate is None else rate, time_s
    )
    for transform in sensor.transforms:
        reading = transform(reading)
    return sensor.digitise(reading, noise)


def above(sensor: Sensor, *touch, **settings) -> np.ndarray:
    return sensor.above_baseline(sense(sensor, *touch, **settings))


# ---- every registered sensor ----


@pytest.mark.parametrize("name", list(sensors))
def test_nothing_is_sent_without_contact(name: str) -> None:
    sensor = sensors.get(name)().build(PADS)
    num_taxels = sensor.spec.rows * sensor.spec.columns
    nothing = np.zeros((3, 4, num_taxels), np.float32)
    frames = sense(sensor, nothing, nothing, None)
    assert sensor.above_baseline(frames).dtype == np.int16
    assert sensor.above_baseline(frames).shape == (3, 4 * num_taxels)
    assert not sensor.above_baseline(frames).any()


@pytest.mark.parametrize("name", list(sensors))
def test_same_generators_give_the_same_bits_alone_and_in_a_batch(name: str) -> None:
    sensor = sensors.get(name)().build(PADS)
    depth, rate = touch(5)
    together = sense(
        sensor, depth, rate, [np.random.default_rng([7, i]) for i in range(5)]
    )
    again = sense(
        sensor, depth, rate, [np.random.default_rng([7, i]) for i in range(5)]
    )
    assert together.tobytes() == again.tobytes()
    for i in range(5):
        one = depth[i : i + 1], rate[i : i + 1]
        assert (
            sense(sensor, *one, [np.random.default_rng([7, i])]).tobytes()
            == together[i].tobytes()
        )
        assert (
            sense(sensor, *one, np.random.default_rng([7, i])).tobytes()
            == together[i].tobytes()
        )
    assert (
        sense(sensor, depth, rate, [np.random.default_rng([8, i]) for i in range(5)])
        != together
    ).any()


@pytest.mark.parametrize("name", list(sensors))
def test_transforms_act_in_order_and_none_leaves_every_bit(name: str) -> None:
    depth, rate = touch(2)
    config = sensors.get(name)()
    plain = sense(config.build(PADS), depth, rate, np.random.default_rng(1))
    untouched = sense(
        config.build(PADS, transforms=[lambda reading: reading]),
        depth,
        rate,
        np.random.default_rng(1),
    )
    assert untouched.tobytes() == plain.tobytes()
    half = config.build(PADS, transforms=[lambda r: r + 0.2, lambda r: 0.5 * r])
    other = config.build(PADS, transforms=[lambda r: 0.5 * r, lambda r: r + 0.1])
    assert (
        above(half, depth, rate) == above(other, depth, rate)
    ).mean() > 0.999  # but for rounding
    assert (above(half, depth, rate) != above(config.build(PADS), depth, rate)).any()


# ---- law ----


def test_reading_is_a_spring_and_a_damper_that_never_pulls() -> None:
    """k_n = 2000 /m, k_d = 10 s/m: 0.5 mm at 20 mm/s: 1 + 0.2; at −150 mm/s: 1 − 1.5 < 0; out of contact: 0."""
    depth = np.array([0.0005, 0.0005, 0.0005, 0.0])
    rate = np.array([0.0, 0.02, -0.15, 0.3])
    assert normal_reading(depth, rate, 2000.0, 10.0) == pytest.approx(
        [1.0, 1.2, 0.0, 0.0]
    )


def test_a_millimetre_is_90_counts_and_ten_newtons_on_the_twins_pad_are_45() -> None:
    """1200 /m · 1 mm = 1.2; · 75 = 90 counts, which the policy reads as 1.2 again. 10 N / 2e4 N/m = 0.5 mm."""
    depth = np.zeros((1, 4, 384), np.float32)
    depth[0, 2, 100] = 0.001
    counts = above(FlexiTacConfig().build(PADS), depth)
    assert counts[0, 2 * 384 + 100] == 90
    assert np.count_nonzero(counts) == 1
    assert 90 * SPEC.gain_per_count == pytest.approx(1.2)
    ten_newtons_m = 10.0 / RobotConfig().pad_stiffness_n_per_m
    assert (
        above(
            FlexiTacConfig().build(PADS),
            depth / np.float32(0.001) * np.float32(ten_newtons_m),
        ).max()
        == 45
    )
    # 40 N, all that the gripper has: 180 counts, and with the highest resting count, 40, still below the wire's 255.
    assert above(FlexiTacConfig().build(PADS), 2 * depth).max() == 180


# ---- converter ----


def test_counts_are_the_nearest_whole_number_above_rest() -> None:
    depth, rate = touch()
    sensor = FlexiTacConfig().build(PADS)
    exact = 75 * normal_reading(depth.astype(float), rate, 1200.0, 6.0).reshape(1, -1)
    counts = above(sensor, depth, rate)
    inside = exact < 200
    assert inside.mean() > 0.9
    assert np.abs(counts - exact)[inside].max() <= 0.5 + 1e-4


def test_pressed_hard_the_wire_sends_its_maximum_and_never_wraps() -> None:
    depth = np.full((1, 4, 384), 0.01, np.float32)
    sensor = FlexiTacConfig().build(PADS)
    frames = sense(sensor, depth, np.zeros_like(depth), np.random.default_rng(0))
    assert frames.dtype == np.uint8
    assert (frames == 255).all()
    assert (sensor.above_baseline(frames) == 255 - sensor.baseline.reshape(1, -1)).all()


def test_noise_cannot_push_a_count_below_zero() -> None:
    sensor = FlexiTacConfig(noise_std_count=50.0).build(PADS)
    nothing = np.zeros((4, 4, 384), np.float32)
    frames = sense(sensor, nothing, nothing, np.random.default_rng(0))
    assert frames.min() == 0
    assert (frames == 0).mean() > 0.2
    assert (sensor.above_baseline(frames) >= -sensor.baseline.reshape(1, -1)).all()


def test_resting_counts_belong_to_the_unit() -> None:
    one, same, other = (
        FlexiTacConfig(seed=seed).build(PADS).baseline for seed in (3, 3, 4)
    )
    assert (one == same).all()
    assert (one != other).mean() > 0.9
    assert (one.min(), one.max()) == (10, 40)
    assert one.shape == (4, 32, 12)


# ---- noise ----


def test_noise_has_the_stated_spread_and_no_pattern() -> None:
    """σ = 2 counts, rounded to whole ones: variance 4 + 1/12. Taxels and scans are independent."""
    sensor = FlexiTacConfig(noise_std_count=2.0).build(PADS)
    nothing = np.zeros((400, 4, 384), np.float32)
    counts = above(sensor, nothing, noise=np.random.default_rng(5)).astype(float)
    # 614 400 values: the variance is known to 1.8e-3 of itself (one σ), the mean to 2.6e-3.
    assert counts.mean() == pytest.approx(0.0, abs=0.015)
    assert counts.var() == pytest.approx(4 + 1 / 12, rel=0.01)
    assert np.abs(counts.var(axis=0) / counts.var() - 1).max() < 0.4
    assert np.corrcoef(counts[:, :-1].ravel(), counts[:, 1:].ravel())[
        0, 1
    ] == pytest.approx(0, abs=0.01)
    assert np.corrcoef(counts[:-1].ravel(), counts[1:].ravel())[0, 1] == pytest.approx(
        0, abs=0.01
    )


def test_default_noise_stays_within_the_boards_no_contact_threshold() -> None:
    nothing = np.zeros((100, 4, 384), np.float32)
    counts = above(
        FlexiTacConfig().build(PADS), nothing, noise=np.random.default_rng(6)
    )
    assert counts.any()
    assert np.abs(counts).max() < SPEC.noise_count


# ---- scan ----


def ramp_m(time_s: np.ndarray) -> np.ndarray:
    """(S, 1, 4, 384) every taxel pressed in at 50 mm/s, 0.8 mm at the stamp."""
    return np.broadcast_to(
        (0.0008 + 0.05 * time_s)[:, None, None, None], (len(time_s), 1, 4, 384)
    ).astype(np.float32)


@pytest.mark.parametrize(
    "time_s", [[-0.01, 0.0], [-0.02, -0.0125, -0.007, -0.003, 0.0], [-0.0099, -0.0002]]
)
def test_each_row_of_the_wire_reads_at_its_own_instant(time_s: list[float]) -> None:
    """12 rows in 10 ms: row i is read 10 − (i + ½) · 10/12 ms before the stamp. Wire rows are the pad's columns."""
    times = np.array(time_s)
    depth = ramp_m(times)
    sensor = FlexiTacConfig(normal_damping_s_per_m=0.0).build(PADS)
    instants_s = np.array([-0.010 + (i + 0.5) * 0.010 / 12 for i in range(12)])
    assert scan_instants_s(SPEC) == pytest.approx(instants_s)
    reading = sensor.reading(depth, np.zeros_like(depth), times)
    assert reading.shape == (1, 4, 32, 12)
    expected = 1200 * (0.0008 + 0.05 * instants_s)
    assert reading == pytest.approx(np.broadcast_to(expected, (1, 4, 32, 12)), abs=1e-6)
    frames = sense(sensor, depth, np.zeros_like(depth), None, times)
    # The first row on the wire is the oldest: 0.0008 − 0.05 · 9.58e-3 = 0.321 mm, 28.9 counts; the last 0.779 mm, 70.1.
    wire = as_wire(frames, SPEC)[0, 2].astype(int) - sensor.baseline[2].T
    assert set(wire[0].tolist()) <= {29}
    assert set(wire[11].tolist()) <= {70}


@pytest.mark.parametrize(
    "time_s", [[-0.009, 0.0], [-0.01, -0.001], [0.0, -0.01], [-0.01, -0.01]]
)
def test_history_that_leaves_out_part_of_the_scan_is_refused(
    time_s: list[float],
) -> None:
    samples = np.zeros((2, 1, 4, 32, 12), np.float32)
    with pytest.raises(
        TaccorlError, match=r"times must.*cover.*scan, -0.0096.*-0.0004 s before.*stamp"
    ):
        at_scan_instants(samples, np.array(time_s), SPEC)


# ---- wire and ingest ----


def ingested(
    folder: Path, frames: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """What ``taccorl.data`` makes of wire frames recorded one after the other: counts above baseline (T, 1536), baseline."""
    (folder / "dataset.yaml").write_text(
        "spec_version: 1\nname: pads\nrobot_type: pads\nfps: 100\nfeatures:\n  observation.tactile: {dtype: int16, "
        "shape: [1536], unit: adc_count, frame: pad, rate_hz: 100, range: [-255, 255], "
        f"sensor: {data_specs_folder() / 'sensors' / 'flexitac_v2.yaml'}, pads: [{', '.join(PADS)}]}}\n"
    )
    channels = "".join(
        f"  {pad}: {{topic: /{pad}, rate_hz: 100, max_age_s: 0.04}}\n" for pad in PADS
    )
    (folder / "recording.yaml").write_text(
        "spec_version: 1\ndataset: dataset.yaml\nreader: hdf5\nclock: log\nepisodes: {by: whole_file, min_s: 0.1}\n"
        f"instruction: {{from: spec, text: press}}\nchannels:\n{channels}"
        f"features:\n  observation.tactile: {{channels: [{', '.join(PADS)}], align: asof}}\n"
    )
    with h5py.File(folder / "pads.hdf5", "w") as file:
        for p, pad in enumerate(PADS):
            file[pad] = np.concatenate([as_wire(frame, SPEC)[:, p] for frame in frames])
    with open_episodes(folder / "pads.hdf5", folder / "recording.yaml") as [episode]:
        return episode.arrays["observation.tactile"], episode.baselines[
            "observation.tactile"
        ]


def pressed_after_rest(
    sensor: Sensor, noise: np.random.Generator | None
) -> list[np.ndarray]:
    nothing = np.zeros((1, 4, 384), np.float32)
    rest = [sense(sensor, nothing, nothing, noise) for _ in range(30)]
    return rest + [sense(sensor, *touch(seed=k), noise) for k in range(30)]


def test_ingest_gives_back_the_counts_of_the_twin(tmp_path: Path) -> None:
    sensor = FlexiTacConfig().build(PADS)
    frames = pressed_after_rest(sensor, None)
    counts, baseline = ingested(tmp_path, frames)
    assert (baseline == sensor.baseline.reshape(-1)).all()
    assert counts.dtype == np.int16
    assert (counts == np.concatenate([sensor.above_baseline(f) for f in frames])).all()
    assert counts[30:].max() > 80


# ---- bad input ----


def test_an_unknown_sensor_and_wrong_numbers_of_generators_are_refused() -> None:
    with pytest.raises(
        TaccorlError, match="no sensor 'flexitack'; did you mean 'flexitac'"
    ):
        sensors.get("flexitack")
    with pytest.raises(TaccorlError, match=r"2 generators.*1"):
        sense(
            FlexiTacConfig().build(PADS),
            *touch(),
            [np.random.default_rng(0), np.random.default_rng(1)],
        )


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("resting_count", (40, 10)),
        ("resting_count", (0, 255)),
        ("noise_std_count", -1.0),
        ("gain_count", float("nan")),
    ],
)
def test_settings_that_no_board_has_are_refused(setting: str, value: object) -> None:
    with pytest.raises(TaccorlError, match=f"flexitac: {setting}"):
        FlexiTacConfig(**{setting: value}).build(PADS)  # type: ignore[arg-type]


def test_noise_is_numpys_bit_for_bit() -> None:
    """470 000 numbers, so that the rare branch of the ziggurat algorithm (1 number in 3700, beyond 3.65) is drawn, too. The seeds
    are below and above 2³², which NumPy hashes as one and as two 32-bit words."""
    rng = np.random.default_rng(0)
    seeds = np.r_[
        0,
        1,
        2**32 - 1,
        2**32,
        2**63 - 1,
        rng.integers(0, 2**63, 150),
        rng.integers(0, 2**32, 150),
    ]
    steps = np.r_[0, 0, 1, 5, 2**32 - 1, rng.integers(0, 900, 300)]
    expected = [
        np.random.default_rng(of).standard_normal(1536, np.float32)
        for of in zip(seeds, steps, strict=True)
    ]
    noise = ScanNoise(seeds, steps)
    drawn = noise.draw((len(seeds), 4, 32, 12))
    assert np.abs(drawn).max() > 3.7 and np.array_equal(
        drawn.reshape(len(seeds), -1), np.stack(expected)
    )
    assert np.array_equal(noise.of(3, 7).draw((4, 1536)), drawn.reshape(-1, 1536)[3:7])


def test_as_many_seeds_as_simulations_are_wanted() -> None:
    with pytest.raises(TaccorlError, match="2 generators for 3"):
        standard_normal(ScanNoise(np.arange(2), np.arange(2)), (3, 4, 32, 12))

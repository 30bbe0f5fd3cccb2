"""Noise floors: a known noise is found again, whichever way it can be; and nothing is ever exact."""

import dataclasses
import math

import numpy as np
import pytest
from made_rows import of_signal
from made_sweep import (
    ARMS_JOINTS,
    RATE_HZ,
    answer,
    chirp,
    measured,
    rested,
    shifted,
    sweep,
)

from taccorl.alignment.measurements.measurement import Measurement, TargetKind, Touch
from taccorl.alignment.measurements.noise_floor import (
    floors_by_motion,
    motion_hz,
    noise_floor,
    rest_stretches,
    touch_floor,
)
from taccorl.alignment.measurements.quantisation import find_quantum
from taccorl.alignment.measurements.repeats import cycles, overlay
from taccorl.errors import TaccorlError

NOISE = 2e-4


@pytest.fixture(scope="module")
def motion() -> tuple[np.ndarray, np.ndarray]:
    """Targets and true answers of a 6 s sweep of all arm joints, with 2 s of rest before and 3 s after."""
    target = rested(
        chirp(
            6.0, np.where(np.isin(np.arange(14), ARMS_JOINTS), 0.2, 0.0), np.zeros(14)
        ),
        2.0,
        3.0,
    )
    return target, answer(target)


def by_method(floor) -> dict[str, float]:
    return {e.method: e.value for e in floor.estimates}


def test_rest_residue_and_repeats_each_recover_a_known_noise(motion):
    rng = np.random.default_rng(0)
    first, second = (measured(*motion, rng, NOISE, name=name) for name in "ab")
    floors = noise_floor([first, dataclasses.replace(second, repeat_of="a")])
    found = {method: [] for method in ("repeats", "rest", "residue")}
    for signal in first.signals:
        assert (
            floors[signal].used.method == "repeats" and not floors[signal].lower_bound
        )
        for method, value in by_method(floors[signal]).items():
            found[method].append(value)
    # 14 independent signals each; a block of 48 white samples knows σ to 10 %, 80 of them to 1 %.
    for method, values in found.items():
        assert np.mean(values) == pytest.approx(NOISE, rel=0.03), method
        assert np.max(np.abs(np.array(values) / NOISE - 1)) < 0.15, method


def test_a_copy_is_no_repeat(motion):
    rng = np.random.default_rng(0)
    first, second = (measured(*motion, rng, NOISE, name=name) for name in "ab")
    alone = noise_floor([first])["left_joint5"]
    copy = dataclasses.replace(first, name="c", repeat_of="a")
    floor = noise_floor([first, copy])["left_joint5"]
    assert floor.lower_bound and floor.value == pytest.approx(alone.value, rel=0.05)
    again = dataclasses.replace(second, repeat_of="a")
    both, three = (
        {k: f.used for k, f in noise_floor(of).items()}
        for of in ([first, again], [first, copy, again])
    )
    assert both == three


def test_rows_that_are_lost_all_over_leave_the_floor_as_it_is(motion):
    """One row of 20 in each: every block of 50 rows has gaps."""
    pair = [
        measured(*motion, np.random.default_rng(k), NOISE, name=name)
        for k, name in enumerate("ab")
    ]
    for k, m in enumerate(pair):
        m.measured[7 * k :: 20] = np.nan
    floor = noise_floor([pair[0], dataclasses.replace(pair[1], repeat_of="a")])[
        "left_joint5"
    ]
    assert floor.used.method == "repeats" and floor.value == pytest.approx(
        NOISE, rel=0.15
    )
    assert by_method(floor)["residue"] == pytest.approx(NOISE, rel=0.15)


def test_interval_holds_the_truth_about_as_often_as_it_says(motion):
    held, total = {"rest": 0, "residue": 0}, 0
    for seed in range(20):
        floors = noise_floor([measured(*motion, np.random.default_rng(seed), NOISE)])
        total += len(floors)
        for floor in floors.values():
            for e in floor.estimates:
                held[e.method] += e.low <= NOISE <= e.high
    for method, count in held.items():
        assert 0.90 <= count / total <= 0.995, (method, count, total)  # n = 280


def test_without_repeats_the_floor_is_a_lower_bound_and_says_so(motion):
    floor = noise_floor([measured(*motion, np.random.default_rng(0), NOISE)])[
        "left_joint5"
    ]
    assert floor.lower_bound
    assert floor.used.method in ("rest", "residue")
    assert "record the motion twice" in floor.words() and "mrad" in floor.words()


def test_repeats_see_what_the_robot_does_not_repeat(motion):
    # A slow disturbance of 1 mrad, another one each time: neither rest nor residue can tell it from motion.
    target, true = motion
    rng = np.random.default_rng(1)
    time_s = np.arange(len(target)) / RATE_HZ

    def once(name: str) -> Measurement:
        wave = (
            1e-3
            * math.sqrt(2)
            * np.sin(2 * np.pi * 0.7 * time_s + rng.uniform(0, 6.28))
        )
        return measured(target, true + wave[:, None], rng, NOISE, name=name)

    alone = noise_floor([once("a")])["left_joint2"].value
    pairs = [
        noise_floor([once("a"), dataclasses.replace(once("b"), repeat_of="a")])[
            "left_joint2"
        ]
        for _ in range(12)
    ]
    # ⟨(A sin(x + φ₁) − A sin(x + φ₂))²⟩ / 2 over phases is A² / 2 = 1 mrad², plus the noise.
    assert math.sqrt(np.mean([f.value**2 for f in pairs])) == pytest.approx(
        math.sqrt(1e-6 + NOISE**2), rel=0.35
    )
    assert alone < 0.5e-3


def test_noise_far_below_the_encoder_s_step_leaves_the_rounding(motion):
    step = math.radians(0.01)
    floors = noise_floor([measured(*motion, np.random.default_rng(2), 1e-7, step)])
    moving, resting = floors["left_joint1"], floors["left_gripper"]
    assert moving.value == pytest.approx(step / math.sqrt(12), rel=0.1)
    # rounding is noise while it moves
    assert by_method(moving)["residue"] == pytest.approx(step / math.sqrt(12), rel=0.1)
    assert by_method(moving)["rest"] < 0.1 * step / math.sqrt(
        12
    )  # and a constant while it rests
    assert resting.value > 0


def test_noise_and_rounding_add_as_squares(motion):
    step = math.radians(0.05)
    floor = noise_floor([measured(*motion, np.random.default_rng(3), 5e-4, step)])[
        "right_joint3"
    ]
    assert floor.value == pytest.approx(math.sqrt(5e-4**2 + step**2 / 12), rel=0.06)


def test_floor_is_above_zero_for_perfect_numbers(motion):
    target, _ = motion
    perfect = measured(
        target, np.tile(target[:1], (len(target), 1)), np.random.default_rng(0), 0.0
    )
    assert all(f.value > 0 for f in noise_floor([perfect]).values())
    assert noise_floor([perfect])["left_joint1"].used.method == "number"


def test_residue_is_not_made_of_motion(motion):
    # Noise of 5 µrad under a motion of 0.2 rad, 40 000 times as large.
    floor = noise_floor([measured(*motion, np.random.default_rng(4), 5e-6)])[
        "left_joint1"
    ]
    assert by_method(floor)["residue"] == pytest.approx(5e-6, rel=0.1)


def test_residue_is_refused_where_rows_are_too_slow_for_the_motion(motion):
    # At 20 rows a second the smooth follows up to 6.1 Hz; a fifth of that is 1.2 Hz, and the sweep goes to 2 Hz.
    target, true = (x[::10] for x in motion)
    slow = measured(target, true, np.random.default_rng(5), NOISE, rate_hz=20)
    assert motion_hz(slow)[0] > 1.22
    methods = by_method(noise_floor([slow])["left_joint1"])
    assert "residue" not in methods
    assert methods["rest"] == pytest.approx(NOISE, rel=0.35)
    assert "residue" in by_method(noise_floor([slow])["left_gripper"])  # which rests


def test_rest_begins_after_the_joints_have_arrived():
    target = np.zeros((1000, 14))
    target[400:, 0] = 0.1
    m = measured(target, target, np.random.default_rng(0), NOISE)
    assert rest_stretches(m) == [(0, 400), (700, 1000)]  # 1.5 s at 200 Hz


def test_effort_has_a_floor_where_it_was_recorded(motion):
    rng = np.random.default_rng(6)
    m = measured(*motion, rng, NOISE)
    effort = np.full(m.measured.shape, np.nan)
    effort[:, 1] = (
        3.0 + np.sin(np.arange(m.num_rows) / 200) + 0.02 * rng.normal(size=m.num_rows)
    )
    floors = noise_floor([dataclasses.replace(m, effort=effort)], "effort")
    assert list(floors) == ["left_joint2"]
    assert floors["left_joint2"].value == pytest.approx(0.02, rel=0.1)
    assert floors["left_joint2"].unit == "N·m"


def test_jumps_of_an_effort_with_its_target_are_no_noise():
    """A target steps by 0.2 rad every 0.6 s, in 30 of 50 rows a second: the effort jumps by
    12 N·m and decays in 0.16 s. Its noise is 0.05 N·m; with the jumps it would be 2 N·m."""
    rng = np.random.default_rng(7)
    since = np.arange(600) % 30
    target = 0.2 * (np.arange(600) // 30 % 2)
    way = np.where(target > 0.0, 1.0, -1.0)
    moved = np.where(np.arange(600) < 30, 0.0, way * np.exp(-since / 8.0))
    answer, effort = target - 0.2 * moved, 12.0 * moved + 0.05 * rng.normal(size=600)
    made = {"target": target, "measured": answer, "effort": effort}
    m = of_signal("steps", 50.0, signal="j", **made)
    floor = floors_by_motion([m], "effort")["steps"]["j"]
    assert floor.used.method == "residue"
    assert floor.value == pytest.approx(0.05, rel=0.25)


def test_touch_floor_of_every_taxel():
    rng, sigma = np.random.default_rng(7), np.where(np.arange(1536) < 768, 1.3, 0.0)
    counts = np.round(rng.normal(size=(1000, 1536)) * sigma).astype(np.int16)
    counts[300:500] += 80  # a touch
    touch = Touch(
        time_s=np.repeat(np.arange(1000)[:, None] / 100, 4, axis=1),
        counts=counts,
        baseline=np.zeros(1536),
    )
    floor = touch_floor([dataclasses.replace(sweep(0, seconds=1.0), touch=touch)])
    assert floor[:768].mean() == pytest.approx(math.sqrt(1.3**2 + 1 / 12), rel=0.05)
    np.testing.assert_allclose(floor[768:], 1 / math.sqrt(12))


@pytest.mark.parametrize("parts", [0.0, 0.25, 0.5])
def test_repeats_that_began_at_another_time_are_laid_over_each_other(parts):
    # The same motion 0.3 s and ``parts`` of a row later; sampled from the closed form, so the shift is exact.
    late_s = 0.3 + parts / RATE_HZ
    time_s = np.arange(1600) / RATE_HZ

    def at(start_s: float, seed: int, name: str) -> Measurement:
        x = np.clip(time_s - start_s, 0, 6.0)
        motion = 0.2 * (1 - np.cos(2 * np.pi * x / 2)) * np.ones((1, 14)).T
        return measured(
            motion.T, motion.T, np.random.default_rng(seed), NOISE, name=name
        )

    first, second = at(0.5, 0, "a"), at(0.5 + late_s, 1, "b")
    assert overlay(first, second).shift_s == pytest.approx(late_s, abs=2e-5)
    floors = noise_floor([first, dataclasses.replace(second, repeat_of="a")])
    values = [by_method(f)["repeats"] for f in floors.values()]
    assert np.mean(values) == pytest.approx(
        NOISE, rel=0.04
    )  # without the weights' correction 10 % less at half a row


def test_stamps_that_jitter_make_no_other_motion():
    """At 1.8 rad/s (RMS) stamps off by up to 2.4 ms shift commands by 3.5 mrad, a hundredth of the motion is 1.4 mrad."""
    time_s, rng = np.arange(1600) / RATE_HZ, np.random.default_rng(3)
    motion = 0.2 * np.cos(4 * np.pi * time_s)[:, None] * np.ones(14)
    first = measured(motion, motion, rng, NOISE, name="a")
    late = dataclasses.replace(
        first, name="b", time_s=time_s + rng.uniform(-0.0024, 0.0024, 1600)
    )
    assert overlay(first, late).shift_s == pytest.approx(0.0, abs=2e-4)
    other = dataclasses.replace(late, target=1.05 * late.target)
    with pytest.raises(TaccorlError, match="their commands differ"):
        overlay(first, other)


def test_repeats_of_unlike_motions_count_by_what_a_twin_leaves_of_their_efforts():
    """2 kg·m² that a wobble of 0.3 mrad at 30 rad/s shakes in one of two recordings: 0.54 N·m, of which repeats have the RMS
    0.54 / 2. Noise is 0.1 N·m; what a twin that smooths leaves may have less, and the noise of rows is the least."""
    rng, time_s, made = np.random.default_rng(0), np.arange(4000) / 200, []
    for k in range(2):
        q = 0.4 * np.sin(2.0 * time_s) + 3e-4 * k * np.sin(30.0 * time_s)
        torque = -2.0 * (1.6 * np.sin(2.0 * time_s) + 0.27 * k * np.sin(30.0 * time_s))
        effort = torque + 0.1 * rng.standard_normal(4000)
        m = of_signal(
            f"m{k}",
            200.0,
            q,
            q,
            "hip",
            target_kinds=("effort",),
            effort=effort,
            repeat_of="m0" * k or None,
        )
        made.append((m, torque[:, None]))
    every = [m for m, _ in made]
    assert noise_floor(every, "effort")["hip"].value == pytest.approx(
        np.hypot(0.27, 0.1), rel=0.05
    )
    for share in (0.0, 1.0):  # of the noise that is left
        left = [
            dataclasses.replace(m, effort=share * (m.effort - torque))
            for m, torque in made
        ]
        assert noise_floor(every, "effort", left)["hip"].value == pytest.approx(
            0.1, rel=0.05
        )


def test_what_does_not_repeat_is_refused(motion):
    rng = np.random.default_rng(0)
    first = measured(*motion, rng, NOISE, name="a")
    target, true = 2 * motion[0] - motion[0][0], motion[1]
    other = measured(target, true, rng, NOISE, name="b", repeat_of="a")
    with pytest.raises(
        TaccorlError, match="b does not repeat a: their commands differ by"
    ):
        noise_floor([first, other])


def test_two_repeats_of_a_recording_that_is_not_at_hand_are_repeats_of_each_other(
    motion,
):
    rng = np.random.default_rng(0)
    pair = [
        measured(*motion, rng, NOISE, name=name, repeat_of="elsewhere") for name in "ab"
    ]
    assert noise_floor(pair)["left_joint1"].used.method == "repeats"
    assert noise_floor(pair[:1])["left_joint1"].lower_bound


def test_a_cut_repeat_still_counts(motion):
    rng = np.random.default_rng(8)
    first = measured(*motion, rng, NOISE, name="a")
    second = shifted(measured(*motion, rng, NOISE, name="b", repeat_of="a"), 0)
    short = dataclasses.replace(
        second,
        **{
            k: getattr(second, k)[100:1500]
            for k in ("time_s", "target", "measured", "velocity", "effort")
        },
    )
    assert overlay(first, short).shift_s == pytest.approx(0.0, abs=1e-6)


def test_step_of_readings_is_found_and_noise_has_none():
    rng = np.random.default_rng(0)
    smooth = 0.3 * np.sin(np.arange(3000) / 300) + 1e-4 * rng.normal(size=3000)
    step = math.radians(0.001)
    assert find_quantum(np.round(smooth / step) * step) == pytest.approx(step, rel=1e-6)
    assert find_quantum(
        (np.round(smooth / step) * step).astype(np.float32)
    ) == pytest.approx(step, rel=1e-3)
    assert find_quantum(0.7 + np.round(smooth / 0.01) * 0.01) == pytest.approx(
        0.01, rel=1e-9
    )
    assert find_quantum(smooth) == 0.0
    assert find_quantum(np.full(100, 1.5)) == 0.0
    assert find_quantum(np.array([0.0, 0.1] * 50)) == pytest.approx(0.1)
    assert (
        sum(
            find_quantum(np.random.default_rng(k).normal(size=500)) > 0
            for k in range(50)
        )
        == 0
    )


def test_a_joint_that_began_elsewhere_does_not_raise_the_floor_nor_does_one_late_slip(
    motion,
):
    """With dry friction a joint rests 10 mrad off until it first moves. A rare slip is reported by ``alignment.unrepeated``; it
    does not raise the floor of the whole motion."""
    rng = np.random.default_rng(5)
    first, second = (measured(*motion, rng, NOISE, name=name) for name in "ab")
    again = dataclasses.replace(second, repeat_of="a")
    plain = noise_floor([first, again])["left_joint1"].value
    j, rows = first.column("left_joint1"), round(3.0 * first.rate_hz)
    elsewhere = again.measured.copy()
    elsewhere[:rows, j] += 0.01
    assert noise_floor([first, dataclasses.replace(again, measured=elsewhere)])[
        "left_joint1"
    ].value == pytest.approx(plain, rel=0.2)
    slipped = again.measured.copy()
    slipped[-rows:, j] += 0.01
    floor = noise_floor([first, dataclasses.replace(again, measured=slipped)])[
        "left_joint1"
    ]
    assert floor.used.without_bursts
    assert floor.value == pytest.approx(plain, rel=0.2)
    half = again.measured.copy()
    half[len(half) // 2 :, j] += 0.01
    often = noise_floor([first, dataclasses.replace(again, measured=half)])[
        "left_joint1"
    ]
    assert often.value > 3 * plain  # half of the time is no burst


@pytest.mark.parametrize(
    "changed",
    [
        {"kp": {"left_joint1": 80.0}},
        {"gain_scale": {"left_joint1": 2.0}},
        {"payload_kg": {"left": 0.3}},
    ],
)
def test_the_same_commands_with_other_gains_or_a_payload_are_no_repeat(motion, changed):
    first, second = (
        dataclasses.replace(
            measured(*motion, np.random.default_rng(k), NOISE, name=name),
            kp={"left_joint1": 40.0},
        )
        for k, name in enumerate("ab")
    )
    assert overlay(first, second).noise_gain >= 1.0
    other = dataclasses.replace(second, **changed)
    with pytest.raises(
        TaccorlError, match=f"b does not repeat a: {next(iter(changed))}"
    ):
        noise_floor([first, dataclasses.replace(other, repeat_of="a")])


# equal cycles ----------------------------------------------------------------------------------------------------------

CYCLE_ROWS, VARIATION = 400, 5e-4


def cycling(
    *,
    variation: float = VARIATION,
    cycles: int = 5,
    kinds: tuple[TargetKind, ...] = ("position",),
    seed: int = 0,
) -> Measurement:
    """2 s of rest, then sines of 2 s at 200 Hz; each cycle is off by a wave of its own (RMS ``variation``, slower than the rows'
    noise), and the first by 20 mrad that fade, as from rest. Noise of one row: 0.2 mrad."""
    rng = np.random.default_rng(seed)
    phase = 2 * np.pi * np.arange(CYCLE_ROWS) / CYCLE_ROWS
    target = np.concatenate([np.zeros(400), *[0.3 * np.sin(phase)] * cycles])
    waves = [
        math.sqrt(2) * variation * np.sin(3 * phase + rng.uniform(0, 2 * np.pi))
        for _ in range(cycles)
    ]
    true = target + np.concatenate([np.zeros(400), *waves])
    true[400:800] += 0.02 * np.exp(-np.arange(400) / 80)
    measured = true + NOISE * rng.standard_normal(len(target))
    return of_signal("cycles", 200.0, target, measured, "axis", target_kinds=kinds)


def test_equal_cycles_of_one_recording_show_what_the_machine_does_not_repeat():
    """⟨(A sin(x + φ₁) − A sin(x + φ₂))²⟩ / 2 over phases is A² / 2, here 0.5² mrad², beside 0.2² of the rows; not the 20 mrad of
    the first cycle."""
    floors = [noise_floor([cycling(seed=seed)])["axis"] for seed in range(12)]
    assert {f.used.method for f in floors} == {"cycles"} and not any(
        f.lower_bound for f in floors
    )
    assert math.sqrt(np.mean([f.value**2 for f in floors])) == pytest.approx(
        math.hypot(VARIATION, NOISE), rel=0.2
    )
    found = cycles(cycling())
    assert found is not None and (found.period_rows, found.first, found.end) == (
        400,
        800,
        2000,
    )


def test_cycles_that_agree_by_chance_do_not_lower_the_floor_below_the_noise_of_rows():
    m = cycling(variation=0.0)
    m.measured[1200:] = np.tile(m.measured[800:1200], (3, 1))  # equal to the last bit
    floor = noise_floor([m])["axis"]
    assert by_method(floor)["cycles"] == 0.0
    assert floor.used.method in ("rest", "residue") and floor.value == pytest.approx(
        NOISE, rel=0.15
    )


def test_repeats_are_used_where_there_are_both():
    first, again = (
        cycling(),
        dataclasses.replace(cycling(seed=1), name="again", repeat_of="cycles"),
    )
    floor = noise_floor([first, again])["axis"]
    assert floor.used.method == "repeats" and "cycles" in by_method(floor)


@pytest.mark.parametrize("repeated", [False, True])
def test_equal_rows_that_are_fewer_than_a_block_leave_the_other_estimates(
    repeated: bool,
):
    """Three cycles of 7 rows, then one jump: 14 of 22 rows have equal targets one period later, a block has 24."""
    target = np.concatenate([np.tile([0.0, 0.2, 0.3, 0.2, 0.0, -0.3, -0.1], 3), [0.7]])
    rng = np.random.default_rng(0)
    both = [
        of_signal(
            name,
            50.0,
            target,
            target + NOISE * rng.standard_normal(len(target)),
            "axis",
            repeat_of=of,
        )
        for name, of in (("a", None), ("b", "a"))[: 1 + repeated]
    ]
    found = cycles(both[0])
    assert found is not None and found.end - found.first == 7
    floor = noise_floor(both)["axis"]
    assert (
        not {"cycles", "repeats"} & set(by_method(floor))
        and floor.lower_bound
        and floor.value > 0.0
    )


def test_what_is_no_three_equal_cycles_is_none(motion):
    """Two cycles; one target that differs by 1 µrad in each; velocities, from which positions drift; uneven rows; a sweep; a hold
    between two moves."""
    assert cycles(cycling(cycles=2)) is None and cycles(cycling(cycles=3)) is not None
    assert cycles(cycling(kinds=("velocity",))) is None
    m = cycling()
    m.target[500::400] += 1e-6 * np.arange(5)[:, None]
    assert cycles(m) is None
    jitter = np.random.default_rng(0).uniform(0, 1e-4, m.num_rows)
    assert (
        cycles(dataclasses.replace(cycling(), time_s=cycling().time_s + jitter)) is None
    )
    assert cycles(measured(*motion, np.random.default_rng(0), NOISE)) is None
    held = cycling()
    held.target[500:1900] = held.target[500]
    assert cycles(held) is None
    assert (
        cycles(
            dataclasses.replace(cycling(), load=np.linspace(0.0, 1.0, 2400)[:, None])
        )
        is None
    )

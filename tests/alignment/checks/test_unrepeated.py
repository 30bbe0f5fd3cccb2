"""Dropped commands are found where they are known to be, and what else does not repeat is not called dropped commands."""

import dataclasses
import math

import numpy as np
import pytest
from made_rows import of_signal, play

from taccorl.alignment.checks.held_commands import find_dropped
from taccorl.alignment.checks.telemetry import check_measurements
from taccorl.alignment.checks.unrepeated import check_repeatability
from taccorl.alignment.controller.drive_numbers import Drive
from taccorl.alignment.controller.joint_kernel import simulate
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.alignment.measurements.noise_floor import noise_floor
from taccorl.sim.effects import make_effect

NOISE_RAD = 1e-4
SUBSTEPS = 8


def sweep(rate_hz: float, seconds: float = 10.0) -> np.ndarray:
    """(T,) rad: 0.1 to 2 Hz, at rest for a second at both ends."""
    t = np.arange(round(seconds * rate_hz)) / rate_hz
    angle = 2 * np.pi * (0.1 * t + 1.9 * t**2 / (2 * seconds))
    wave = 0.3 * np.sin(angle) * np.clip(t, 0, 1) * np.clip(seconds - t, 0, 1)
    rest = np.zeros(round(rate_hz))
    return np.concatenate([rest, wave, rest])


def held(
    target: np.ndarray, rate: float, longest: int, rng: np.random.Generator
) -> np.ndarray:
    """``target`` as the drive has it when it misses a share ``rate`` of the commands, 1 to ``longest`` in a row."""
    out, k = target.copy(), 1
    while k < len(out):
        missed = (
            int(rng.integers(1, longest + 1))
            if rng.random() < rate * 2 / (1 + longest)
            else 0
        )
        out[k : k + missed] = out[k - 1]
        k += max(missed, 1)
    return out


def joint(
    applied: np.ndarray,
    rate_hz: float,
    rng: np.random.Generator,
    *,
    disturbed=0.0,
    friction=0.0,
    omega=16.0,
    zeta=1.0,
) -> np.ndarray:
    """(T,) q̈ = ω² (q* − q) − 2 ζ ω q̇ − friction + disturbance [rad/s²], with an encoder's noise."""
    h = 1 / (rate_hz * SUBSTEPS)
    keep = math.exp(-2 * math.pi * 3.0 * h)  # disturbance of 3 Hz
    q, v, d, out = float(applied[0]), 0.0, 0.0, np.empty(len(applied))
    kicks = (
        disturbed * math.sqrt(1 - keep**2) * rng.normal(size=(len(applied), SUBSTEPS))
    )
    for k, goal in enumerate(applied.tolist()):
        out[k] = q
        for kick in kicks[k].tolist():
            d = keep * d + kick
            v += h * (
                omega**2 * (goal - q)
                - 2 * zeta * omega * v
                - friction * math.tanh(v / 2e-3)
                + d
            )
            q += h * v
    return out + NOISE_RAD * rng.normal(size=len(out))


def recording(
    name: str,
    seed: int,
    *,
    drop=0.0,
    longest=1,
    rate_hz=200.0,
    repeat_of=None,
    **physics,
) -> Measurement:
    rng, target = np.random.default_rng(seed), sweep(rate_hz)
    measured = joint(held(target, drop, longest, rng), rate_hz, rng, **physics)
    return of_signal(
        name, rate_hz, target, measured, "left_joint5", repeat_of=repeat_of
    )


def pair(seed: int, **how) -> list[Measurement]:
    return [
        recording("a", 2 * seed, **how),
        recording("b", 2 * seed + 1, repeat_of="a", **how),
    ]


def said(measurements: list[Measurement]) -> set[str]:
    return {f.check for _, f in check_repeatability(measurements)}


@pytest.mark.parametrize("how", [
    {"drop": 0.02, "longest": 8},
    {"drop": 0.03, "longest": 4},
    {"drop": 0.05, "longest": 3, "rate_hz": 100.0},
    {"drop": 0.05, "longest": 2, "rate_hz": 60.0, "omega": 25.0},
    {"drop": 0.03, "longest": 3, "omega": 60.0, "zeta": 3.0},
])  # fmt: skip
def test_dropped_commands_are_reported(how):
    for seed in range(2):
        assert "dropped_commands" in said(pair(seed, **how)), seed


def test_play_that_holds_a_joint_where_its_target_turns_is_not_called_dropped_commands():
    """The link stays within a play of 6 mrad about a motor that follows its target, and stands still after each turn."""
    made = []
    for name, seed in (("a", 1), ("b", 2), ("c", 3)):
        m = recording(name, seed, omega=25.0)
        link = play(m.measured[:, 0], 3e-3) + NOISE_RAD * np.random.default_rng(
            seed
        ).normal(size=m.num_rows)
        made.append(dataclasses.replace(m, measured=link[:, None]))
    dropped = find_dropped(made, 0)
    assert dropped.found >= 6 + 4 * dropped.mirrored, (
        "the check sees holds, or this test shows nothing"
    )
    assert not dropped.certain and "dropped_commands" not in said(made)


@pytest.mark.parametrize(("kp", "kd"), [(60.0, 8.0), (200.0, 10.0)])
def test_backlash_that_holds_a_joint_once_between_turns_is_not_called_dropped_commands(
    kp: float, kd: float
):
    m = recording("a", 1)
    ones, none = np.ones(m.num_rows), np.zeros(m.num_rows)
    numbers = make_effect("backlash", play_rad=5e-3).drive() or {}
    drive = Drive(
        kp=kp, kd=kd, torque_ff=1.7, inertia=0.2, gravity_sin=2.0, compensation_sin=1.5
    )._replace(**numbers)
    at = simulate(
        drive, m.target[:, 0], none, none, ones, ones, none, 0.0, 6, 1, 1 / 1200, 0.0
    )[0]
    at = at + NOISE_RAD / 10 * np.random.default_rng(1).normal(size=len(at))
    dropped = find_dropped([dataclasses.replace(m, measured=at[:, None])], 0)
    assert (
        dropped is not None
        and dropped.found >= 6 + 4 * dropped.mirrored
        and not dropped.certain
    )


def test_a_repeat_that_differs_far_more_than_the_others_is_left_out_of_the_floor_and_named():
    """10 rows late, or a drift of 12 floors: its RMS is 12 / √2, over √2 of two recordings' noise: 6 times the others'."""
    made = [
        recording("a", 1),
        recording("b", 2, repeat_of="a"),
        recording("c", 3, repeat_of="a"),
    ]
    at, drift = made[1].measured, 12 * NOISE_RAD * np.sin(np.arange(2400) / 50)[:, None]
    for measured in (np.roll(at, 10, axis=0), at + drift):
        every = [*made, dataclasses.replace(made[1], name="odd", measured=measured)]
        floor = noise_floor(every)["left_joint5"].used
        assert [name for name, _ in floor.left_out] == [
            "odd"
        ] and floor.value == noise_floor(made)["left_joint5"].value
        (text,) = (
            f.text
            for name, f in check_repeatability(every)
            if (name, f.check) == ("odd", "does_not_repeat")
        )
        assert (
            f"odd from a {floor.left_out[0][1]:.0f} times" in text
            and "without odd" in text
        )
    assert floor.left_out[0][1] == pytest.approx(
        6.0, rel=0.25
    )  # with the noise: √(6² + 1)


def test_the_first_recording_may_be_the_odd_one_and_of_two_nothing_tells_which_is():
    """The drift of 12 floors is in the recording that the others repeat; of a single pair it is 6 times the noise of rows."""
    a, *others = [
        recording("a", 1),
        recording("b", 2, repeat_of="a"),
        recording("c", 3, repeat_of="a"),
    ]
    odd = dataclasses.replace(
        a, measured=a.measured + 12 * NOISE_RAD * np.sin(np.arange(2400) / 50)[:, None]
    )
    floor = noise_floor([odd, *others])["left_joint5"]
    assert [name for name, _ in floor.used.left_out] == [
        "a"
    ] and floor.value == pytest.approx(NOISE_RAD, rel=0.1)
    assert [
        "a from b" in f.text
        for name, f in check_repeatability([odd, *others])
        if name == "a"
    ] == [True]
    alone, fine = (noise_floor([first, others[0]])["left_joint5"] for first in (odd, a))
    assert (
        alone.is_unknown
        and "not known" in alone.words()
        and not floor.is_unknown
        and not fine.is_unknown
    )


def test_dropped_commands_are_reported_with_times_and_share_in_a_single_recording():
    m = recording("a", 3, drop=0.05, longest=4)
    dropped = find_dropped([m], 0)
    assert (
        dropped.certain and 0.01 < dropped.rate < 0.10
    )  # 5 % were dropped; slow parts do not show it
    findings = check_measurements([m])["a"]
    ((text, severity),) = (
        (f.text, f.severity) for f in findings if f.check == "dropped_commands"
    )
    assert "previous target" in text and severity == "warning"
    assert any("repeat_of" in f.text for f in findings if f.check == "not_judged")


def test_a_single_long_hold_is_found_where_it_was():
    target = sweep(200.0)
    applied, truth = target.copy(), [500, 900, 1100, 1300, 1500, 1700, 1900]
    for row in truth:
        applied[row : row + 6] = applied[row - 1]
    m, measured = recording("a", 0), joint(applied, 200.0, np.random.default_rng(0))
    dropped = find_dropped([dataclasses.replace(m, measured=measured[:, None])], 0)
    found = np.array(dropped.times_s["a"])
    near = [np.abs(found - row / 200.0).min() < 0.03 for row in truth]
    assert sum(near) >= 6  # one may lie where the sweep turns back


@pytest.mark.parametrize(
    "how",
    [{}, {"disturbed": 3.0}, {"friction": 2.0}, {"friction": 2.0, "disturbed": 1.5}],
)
def test_robots_that_drop_nothing_are_not_said_to(how):
    for seed in range(3):
        assert "dropped_commands" not in said(pair(seed, **how)), seed


def test_disturbance_torque_does_not_repeat_and_nothing_else():
    made = pair(0, disturbed=3.0)
    ((_, finding),) = check_repeatability(made)
    assert finding.check == "does_not_repeat"
    assert "all the time" in finding.text and "most b from a" in finding.text
    assert "do not explain it" in finding.text
    floor = noise_floor(made)["left_joint5"]
    assert not floor.used.without_bursts and floor.value > 5 * NOISE_RAD


def test_a_robot_that_repeats_is_silent():
    assert said(pair(0)) == set()


def test_a_joint_that_rests_elsewhere_until_it_is_moved_repeats():
    """Dry friction holds it 20 mrad aside for 1.5 s: 50 times the noise in all."""
    first, second = pair(2)
    aside = second.measured + 20e-3 * (second.time_s[:, None] < 1.5)
    assert said([first, dataclasses.replace(second, measured=aside)]) == set()
    assert said([first, dataclasses.replace(second, measured=aside[::-1])]) == {
        "does_not_repeat"
    }


def test_positions_that_differ_without_a_target_are_another_motion():
    made = []
    for k, m in enumerate(pair(3)):
        at = m.measured + 2e-3 * k * np.sin(20 * m.time_s)[:, None]
        made.append(dataclasses.replace(m, measured=at, target=at))
    assert said(made) == {"does_not_repeat"}  # as if these positions had been asked for
    assert (
        said([dataclasses.replace(m, target_kinds=("effort",)) for m in made]) == set()
    )


def test_rare_bursts_are_left_out_of_the_floor_and_reported_with_their_times():
    first, second = pair(1)
    bump = 8e-3 * np.exp(-(((first.time_s - 6.0) / 0.05) ** 2))
    second = dataclasses.replace(second, measured=second.measured + bump[:, None])
    floor = noise_floor([first, second])["left_joint5"]
    assert floor.used.method == "repeats"
    assert floor.used.without_bursts
    assert floor.value == pytest.approx(NOISE_RAD, rel=0.2)  # with the burst: 0.4 mrad
    assert "bursts left out" in floor.words()
    ((_, finding),) = check_repeatability([first, second])
    assert finding.check == "does_not_repeat"
    assert "in bursts" in finding.text
    assert (
        "5.5" in finding.text or "6.0" in finding.text
    )  # begin of the half second that holds it

"""Planted faults are caught and named; clean sweeps stay clean, whatever the seed, the friction and the noise."""

import dataclasses
import itertools
import math
import re
from pathlib import Path

import numpy as np
import pytest
from axes import altered, axis_answer, axis_motion, axis_of
from made_rows import of_signal, play
from made_sweep import (
    ARMS_JOINTS,
    HOME,
    RATE_HZ,
    answer,
    chirp,
    measured,
    rested,
    shifted,
    sweep,
)
from scipy.signal import cont2discrete, lfilter, lsim

from taccorl.alignment.checks.clock import (
    beside_onsets,
    check_against_twin,
    check_clock,
)
from taccorl.alignment.checks.effort_time import check_effort_time, target_share
from taccorl.alignment.checks.first_order import (
    fit_first_order,
    left_by_change,
    onset_delay,
    pure_shift,
)
from taccorl.alignment.checks.motion import _answers_a_jump, check_start
from taccorl.alignment.checks.registry import CHECKS, find
from taccorl.alignment.checks.telemetry import (
    check_measurement,
    check_measurements,
    check_names,
)
from taccorl.alignment.checks.trial import Trial
from taccorl.alignment.controller.drive_law import DriveLaw
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.alignment.measurements.noise_floor import noise_floor
from taccorl.data.episode import ChannelTiming
from taccorl.data.finding import Finding
from taccorl.errors import TaccorlError
from taccorl.sim.bench import Bench
from taccorl.sim.effects import effects, make_effect
from taccorl.sim.effects.effect import JointEffect
from taccorl.sim.replay import replay
from taccorl.sim.simulation import Simulation
from taccorl.sim.twin import TwinConfig


@pytest.fixture(scope="module")
def clean() -> Measurement:
    return sweep(0)


def found(m: Measurement, **kwargs) -> dict[str, list[str]]:
    """check → features."""
    by: dict[str, list[str]] = {}
    for f in check_measurement(m, **kwargs):
        by.setdefault(f.check, []).append(f.feature)
    return by


def text_of(m: Measurement, check: str) -> str:
    return next(f.text for f in check_measurement(m) if f.check == check)


def with_column(
    m: Measurement, name: str, values: np.ndarray, field: str = "measured"
) -> Measurement:
    columns = getattr(m, field).copy()
    columns[:, m.column(name)] = values
    return dataclasses.replace(m, **{field: columns})


def steps(joint: int, size_rad: float, rows: int = 1200) -> np.ndarray:
    """(T, 14) targets of which one jumps to and fro every 200 rows."""
    target = np.tile(HOME, (rows, 1))
    target[:, joint] += size_rad * (np.arange(rows) // 200 % 2)
    return target


def some(m: Measurement, rows: slice | np.ndarray) -> Measurement:
    """These rows only."""
    names = ("time_s", "target", "measured", "velocity", "effort")
    return dataclasses.replace(m, **{name: getattr(m, name)[rows] for name in names})


def floors(m: Measurement) -> dict[str, float]:
    return {name: f.value for name, f in noise_floor([m]).items()}


# The first six have every choice of joints with every resolution.
@pytest.mark.parametrize(
    "seed", [pytest.param(k, marks=[pytest.mark.slow] * (k >= 6)) for k in range(12)]
)
def test_clean_sweeps_stay_clean(seed):
    rng = np.random.default_rng(seed)
    joints = [[4], ARMS_JOINTS[:6], ARMS_JOINTS][seed % 3]
    step = (0.0, math.radians(0.001))[seed % 2]
    m = sweep(
        seed,
        joints=joints,
        noise_rad=10 ** rng.uniform(-5, -3),
        quantum_rad=step,
        seconds=5.0,
    )
    assert found(m) == {}


@pytest.mark.parametrize(
    "friction_nm", [*(pytest.param(f, marks=pytest.mark.slow) for f in (0.3, 1.0)), 3.0]
)
def test_friction_is_no_fault_of_the_telemetry(friction_nm):
    for seed in range(3):
        m = sweep(seed, friction_nm=friction_nm, seconds=6.0)
        assert set(found(m)) <= {"not_judged", "late_answer"}
        assert not any(f.severity != "note" for f in check_measurement(m))


def test_steps_and_holds_are_clean_too():
    target = steps(3, 0.1, rows=1400)
    assert found(measured(target, answer(target), np.random.default_rng(0), 2e-4)) == {}


@pytest.mark.parametrize("rows", [1, 2, 5])
@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in (1, 2))]
)
def test_positions_one_row_early_are_an_error_at_every_joint(seed, rows):
    m = shifted(sweep(seed), rows)
    assert len(found(m)["measured_before_command"]) == len(ARMS_JOINTS)
    assert all(
        f.severity == "error"
        for f in check_measurement(m)
        if f.check == "measured_before_command"
    )


@pytest.mark.parametrize(
    ("rows", "hz", "early"), [(1, 1000.0, False), (2, 1000.0, True), (1, 150.0, True)]
)
def test_targets_that_are_sent_between_rows_of_200_hz_lead_by_a_row_and_no_more(
    clean, rows: int, hz: float, early: bool
):
    target = steps(4, 0.15)
    stepped = measured(target, answer(target), np.random.default_rng(0), 2e-4)
    for m, joints in ((clean, len(ARMS_JOINTS)), (stepped, 1)):
        errors = found(shifted(m, rows), rates=dict.fromkeys(m.signals, hz))
        assert len(errors.get("measured_before_command", ())) == joints * early


def test_lead_names_joint_time_and_way_out(clean):
    recorded = text_of(shifted(clean, 2), "measured_before_command")
    assert "answers" in recorded and "ms" in recorded
    assert "latency_s" in recorded and "target_rows_late" not in recorded
    table = text_of(
        dataclasses.replace(shifted(clean, 2), source=Path("a.csv")),
        "measured_before_command",
    )
    assert "target_rows_late: 2" in table and "latency_s" not in table


def resonant(motion: np.ndarray, rate_hz: float, zeta: float = 0.1) -> Measurement:
    """ω = 20 rad/s, with noise."""
    b, a, _ = cont2discrete(([400.0], [1.0, 40.0 * zeta, 400.0]), 1 / rate_hz)
    seen = lfilter(np.ravel(b), a, motion - motion[0]) + motion[0]
    noise = 1e-4 * np.random.default_rng(0).standard_normal(len(motion))
    return of_signal(
        "made", rate_hz, motion, seen + noise, "table", source=Path("a.csv")
    )


def test_exchanged_columns_of_target_and_position_are_no_latency():
    clean, time_s = sweep(0, joints=[2, 4], seconds=5.0), np.arange(1000) / 100
    sways = resonant(0.3 * np.minimum(time_s, 1.0) * np.sin(3.0 * time_s), 100.0)
    phase = 2 * np.pi * (0.1 + 0.12 * time_s) * time_s
    each = [
        resonant(0.3 * np.minimum(time_s, 1.0) * np.sin(phase + late), 100.0, 1.0)
        for late in (0.0, 0.7, 1.9)
    ]
    columns = {
        key: np.hstack([getattr(m, key) for m in each])
        for key in ("target", "measured")
    }
    alike = Measurement(
        name="alike",
        time_s=time_s,
        signals=("a", "b", "c"),
        units=("rad",) * 3,
        **columns,
    )
    assert not any(f.severity == "error" for f in check_measurement(alike)), (
        "of one motion, one after the other"
    )
    rough = sweep(0, joints=[2, 4], friction_nm=0.3, seconds=5.0)
    for m, joints in ((clean, 2), (rough, 2), (sways, 1), (alike, 3)):
        swapped = dataclasses.replace(
            m, target=m.measured, measured=m.target, source=Path("a.csv")
        )
        errors = [f for f in check_measurement(swapped) if f.severity == "error"]
        assert {f.check for f in errors} == {"exchanged_target"} and len(
            errors
        ) == joints
        assert all(
            "exchanged" in f.text and f"{f.feature}.q_target" in f.text for f in errors
        )
    for rows in (1, 5, 20):  # a clock that is off is none
        for m in (clean, sweep(0, joints=[2, 4], friction_nm=2.0, seconds=5.0), sways):
            assert "exchanged_target" not in found(shifted(m, rows))


@pytest.mark.parametrize(
    ("hz", "sent_every", "told"),
    [(0.0, 1, True), (500.0, 1, False), (0.0, 5, False), (None, 1, False)],
)
def test_a_recording_with_fewer_rows_than_targets_of_another_names_both_rates(
    hz: float, sent_every: int, told: bool
):
    """500 rows a second, and every fifth of them; the drive's rate may be stated, or each target be sent five rows long."""
    motion = 0.3 * np.sin(np.arange(4000) // sent_every * sent_every / 200.0)
    fast = resonant(motion, 500.0)
    slow = of_signal("slow", 100.0, motion[::5], fast.measured[::5, 0], "table")
    said = check_measurements([fast, slow], rates={} if hz is None else {"table": hz})
    texts = [f.text for f in said["slow"] if f.check == "slower_rows"]
    assert len(texts) == told and not any(
        f.check == "slower_rows" for f in said["made"]
    )
    words = ("100 rows", "500 targets", "made", "`command_hz: 500`", "table")
    assert all(word in text for text in texts for word in words)


def test_positions_one_row_late_could_be_a_delay_and_the_note_says_that_it_cannot_be_told(
    clean,
):
    # A late clock and a real delay give the same rows: both get the same note, and no error.
    late, delayed = shifted(clean, -1), sweep(0, delay_s=0.005)
    for m in (late, delayed):
        assert set(found(m)) == {"late_answer"} and "cannot tell apart" in text_of(
            m, "late_answer"
        )
        assert {f.severity for f in check_measurement(m)} == {"note"}
    for repeat, said in (
        (shifted(sweep(1), -1), 2),
        (sweep(1), 0),
    ):  # one of two repeats is no delay of the drive
        pair = (
            dataclasses.replace(late, name="a"),
            dataclasses.replace(repeat, name="b", repeat_of="a"),
        )
        every = [
            f.feature
            for own in check_measurements(pair).values()
            for f in own
            if f.check == "late_answer"
        ]
        assert len(every) == said * len(set(every))


@pytest.mark.parametrize("delay_ms", [12.0, 18.2, 24.0, 31.0])
def test_a_late_answer_states_no_interval_that_the_inertia_s_share_breaks(delay_ms):
    """Inertia over damping delays a motion as a delay does, by some milliseconds."""
    m = sweep(0, joints=[1], delay_s=1e-3 * delay_ms)
    text = text_of(m, "late_answer")
    late_ms = float(re.search(r"target ([0-9.]+) ms", text).group(1))
    assert delay_ms - 0.5 < late_ms < delay_ms + 10.0 and "±" not in text


@pytest.mark.parametrize("late_s", [0.2, 0.5, 1.5])
@pytest.mark.parametrize("friction_nm", [0.0, 1.0])
def test_positions_far_too_late_are_told_in_all_recordings_or_in_the_one(
    late_s: float, friction_nm: float
):
    sound = [
        sweep(k, joints=[4], friction_nm=friction_nm, name=name)
        for k, name in enumerate("abc")
    ]
    late = [
        dataclasses.replace(shifted(m, -round(late_s * RATE_HZ)), name=m.name)
        for m in sound
    ]

    def told(recordings: list[Measurement]) -> dict[str, list[tuple[str, str]]]:
        every = check_measurements(recordings)
        of = {
            n: [f for f in own if f.check.startswith("late") and f.severity != "note"]
            for n, own in every.items()
        }
        for f in (f for own in of.values() for f in own):
            assert (
                f.feature == "left_joint5"
                and f"{late_s:.1f}" in f.text
                and "latency_s" in f.text
            )
        return {n: [(f.check, f.severity) for f in own] for n, own in of.items()}

    assert told(sound) == {"a": [], "b": [], "c": []}
    assert told(late) == {n: [("late_answer", "warning")] for n in "abc"}
    assert told([*sound[:2], late[2]]) == {
        "a": [],
        "b": [],
        "c": [("late_recording", "error")],
    }


@pytest.mark.parametrize("play_rad", [0.0, 0.02, 0.1])
@pytest.mark.parametrize("lag_s", [0.1, 0.5])
def test_play_and_slow_joints_are_no_clock(play_rad: float, lag_s: float):
    """Triangles of ± 0.2 rad at 0.1 rad/s: play of 0.1 rad alone comes 0.05 / 0.1 = 0.5 s late, as a clock does."""
    at = np.arange(4800) / RATE_HZ
    target = np.tile(HOME, (4800, 1))
    target[:, 4] += 0.2 - np.abs(at % 8.0 - 4.0) / 10.0
    keep, held = math.exp(-1 / RATE_HZ / lag_s), HOME.copy()
    true = lfilter([1 - keep], [1, -keep], target, axis=0, zi=keep * target[:1])[0]
    for row in true:
        row[:] = held = np.clip(held, row - play_rad / 2, row + play_rad / 2)
    every = check_measurement(
        measured(target[1:], true[:-1], np.random.default_rng(0), 2e-4)
    )
    assert {f.severity for f in every} <= {"note"}


def test_a_step_from_rest_shows_one_row_under_any_friction():
    # The step's own row must still be at rest. Friction keeps the lag from describing the joint; the step does not care.
    target = steps(4, 0.15)
    m = measured(
        target, answer(target, friction_nm=1.0), np.random.default_rng(0), 2e-4
    )
    assert "measured_before_command" not in found(m)
    early = [
        f
        for f in check_measurement(shifted(m, 1))
        if f.check == "measured_before_command"
    ]
    assert [f.feature for f in early] == ["left_joint5"]
    assert early[0].rows == (200, 201) and "row 200 (1.000 s)" in early[0].text


def test_where_nothing_can_be_known_it_says_so():
    m = shifted(sweep(2, friction_nm=3.0, joints=[4, 5]), 1)
    findings = list(check_clock(Trial(m)))
    assert [(f.check, f.feature) for f in findings] == [
        ("not_judged", "left_joint5"),
        ("not_judged", "left_joint6"),
    ]
    for f in findings:
        # A first row of 8 floors where the lag is 0.12 s: 8 · floor · 0.12 s / 5 ms.
        least = 8 * floors(m)[f.feature] * 0.12 / 0.005
        assert (
            "one row (5.0 ms) could not be checked" in f.text
            and f"two of {least:.2g} rad" in f.text
            and len(f.text) <= 120
        )


def test_first_order_fit_recovers_lag_and_delay_within_its_interval():
    # τ = 90 ms, d = 3.7 ms, gain 0.98: q(t) in closed form for held commands, from a fine grid.
    rng, fine = np.random.default_rng(0), 50
    target = rested(chirp(6.0, np.full(14, 0.2), np.zeros(14)))[:, 0]
    target = target - target[0]
    held, keep = np.repeat(target, fine), math.exp(-1 / RATE_HZ / fine / 0.09)
    q = np.zeros(len(held) + 1)
    for k, u in enumerate(held):
        q[k + 1] = u + (q[k] - u) * keep
    late = round(0.0037 * RATE_HZ * fine)
    true = 0.98 * np.concatenate([np.zeros(late), q])[: len(held) : fine] + 0.01
    hits = []
    for _ in range(20):
        fit = fit_first_order(
            target, true + 2e-4 * rng.normal(size=len(true)), 1 / RATE_HZ
        )
        assert fit.delay_s == pytest.approx(
            0.0037, abs=2e-4
        ) and fit.time_constant_s == pytest.approx(0.09, rel=0.01)
        assert fit.gain == pytest.approx(0.98, abs=1e-3)
        hits.append(abs(fit.delay_s - 0.0037) < 3 * fit.delay_sd_s)
    assert np.mean(hits) >= 0.9


def test_of_many_rows_an_even_selection_begins_the_fit_and_all_of_them_end_it():
    """25 s at 1 kHz, τ = 50 ms exactly for held targets, 12 rows late, noise of 10 µm."""
    keep, time_s = math.exp(-1e-3 / 0.05), np.arange(25_000) / 1000
    target = 0.1 * np.sin(0.5 * time_s**1.5)
    answers = lfilter(
        [0.0, 1 - keep], [1, -keep], np.concatenate([np.zeros(12), target[:-12]])
    )
    fit = fit_first_order(
        target, answers + 1e-5 * np.random.default_rng(0).standard_normal(25_000), 1e-3
    )
    assert fit.time_constant_s == pytest.approx(0.05, rel=1e-3)
    assert abs(
        fit.delay_s - 0.012
    ) < 3 * fit.delay_sd_s < 1e-4 and fit.rms == pytest.approx(1e-5, rel=0.02)


def test_rows_of_a_dataset_are_read_as_commands_that_moved_on():
    # 30 Hz rows of a 180 Hz command: held for a whole row it would look 17 ms early.
    target = rested(
        chirp(
            6.0, np.where(np.isin(np.arange(14), ARMS_JOINTS), 0.2, 0.0), np.zeros(14)
        )
    )
    at = np.arange(len(target) * 30 // RATE_HZ)
    rows = np.stack(
        [np.interp(at / 30, np.arange(len(target)) / RATE_HZ, c) for c in target.T],
        axis=1,
    )
    share = np.arange(1, 7)[:, None] / 6
    following = np.concatenate([rows[1:], rows[-1:]])
    sub = (rows[:, None] + share * (following - rows)[:, None]).reshape(-1, 14)
    m = measured(rows, _at_180(sub)[::6], np.random.default_rng(0), 2e-4, rate_hz=30)
    assert not {"measured_before_command", "late_answer"} & set(found(m))
    assert "measured_before_command" in found(shifted(m, 1))


def _at_180(target: np.ndarray) -> np.ndarray:
    """(T, 14) first-order answers with τ = 0.1 s, exact for held commands."""
    keep, q, rows = math.exp(-1 / 180 / 0.1), target[0], []
    for u in target:
        rows.append(q)
        q = u + (q - u) * keep
    return np.array(rows)


def test_what_a_shift_and_a_change_leave_is_measured_without_other_numbers():
    """0.1 sin(ωt) that comes 2.5 rows late, beside a constant; a change of which the difference has − 3 times."""
    at = np.arange(1000) / RATE_HZ
    replay, late = (0.1 * np.sin(2 * np.pi * (at - d / RATE_HZ)) for d in (0.0, 2.5))
    apart = 0.1 * 2 * math.sin(math.pi * 2.5 / RATE_HZ) / math.sqrt(2)
    assert np.std(late - replay) == pytest.approx(apart, rel=1e-3)
    found = pure_shift(late + 0.3, replay, 1 / RATE_HZ)
    assert found.rms < 0.01 * apart and found.delay_s == pytest.approx(
        2.5 / RATE_HZ, rel=0.01
    )
    change = at**2
    assert left_by_change(replay - 3 * change + 0.3, replay, replay + change) < 1e-9
    assert left_by_change(late, replay, replay) == pytest.approx(apart, rel=1e-3), (
        "no change explains nothing"
    )


def gripper_on_a_part(opens: bool, rows_early: int = 0) -> Measurement:
    """A gripper that closes by 5.1 mm in a row of 30 Hz, as in ``taccorl collect``, half a row behind its command; a part of 29
    mm stops it, and gives way by 2.5 mm while the command goes on to 8.4 mm and stays there."""
    target = np.concatenate(
        [np.full(60, 0.065), np.arange(0.065, 0.0084, -0.0051), np.full(240, 0.0084)]
    )
    if opens:
        target = np.concatenate(
            [target, np.arange(0.0084, 0.065, 0.0051), np.full(60, 0.065)]
        )
    behind = np.interp(np.arange(len(target)) - 0.5, np.arange(len(target)), target)
    held = np.where(
        behind < 0.029, 0.029 - 0.0025 / (0.029 - 0.0084) * (0.029 - behind), behind
    )
    held += 1e-5 * np.random.default_rng(0).standard_normal(len(held))
    held = np.concatenate([held[rows_early:], np.full(rows_early, held[-1])])
    columns = {
        "target": target[:, None],
        "measured": held[:, None],
        "time_s": np.arange(len(target)) / 30,
    }
    return Measurement(name="grip", signals=("left_gripper",), units=("m",), **columns)


@pytest.mark.parametrize("opens", [False, True])
def test_a_gripper_that_a_part_stops_is_no_fault_of_the_clock_and_one_that_is_early_is(
    opens: bool,
):
    assert not [
        f for f in check_measurement(gripper_on_a_part(opens)) if f.severity == "error"
    ]
    assert found(gripper_on_a_part(opens, rows_early=2))["measured_before_command"] == [
        "left_gripper"
    ]


def test_one_row_off_the_twin_is_found_even_when_its_gains_are_wrong(clean):
    slower = answer(clean.target, damping=1.3)
    for rows, severity in ((1, "error"), (-1, "warning")):
        m = shifted(clean, rows)
        keep = slice(max(-rows, 0), max(-rows, 0) + m.num_rows)
        findings = [
            f
            for f in check_against_twin(m, slower[keep], floors(m))
            if f.check == "shifted_from_twin"
        ]
        assert len(findings) == len(ARMS_JOINTS), rows
        assert {f.severity for f in findings} == {severity}
        rows_off = [float(f.text.split(" rows)")[0].split("(")[-1]) for f in findings]
        assert rows_off == pytest.approx([1.0] * 12, abs=0.21)
    assert check_against_twin(clean, slower, floors(clean)) == []


def test_a_common_delay_of_slow_motions_is_one_number_for_all_joints():
    """Two joints with friction and other inertias answer 60 ms late: two rows less a fifth, at 30 rows a second."""
    time_s, rng = np.arange(0, 18, 1 / 30), np.random.default_rng(0)

    def slow(
        late_s: float, tau_s: float, phase: float
    ) -> tuple[np.ndarray, np.ndarray]:
        fine = np.arange(-5.0, 18, 1e-3)
        wanted = 0.5 * np.tanh(2 * np.sin(0.5 * (fine - late_s) + phase))
        position = (
            lfilter(
                [1 - math.exp(-1e-3 / tau_s)],
                [1, -math.exp(-1e-3 / tau_s)],
                wanted - wanted[0],
            )
            + wanted[0]
        )
        position = play(
            position, 3e-3, position[0]
        )  # dry friction: it stands until the target is 3 mrad away
        return np.interp(
            time_s, fine, 0.5 * np.tanh(2 * np.sin(0.5 * fine + phase))
        ), np.interp(time_s, fine, position)

    both = [
        [slow(late_s, tau_s, phase) for tau_s, phase in ((0.05, 0.0), (0.12, 1.3))]
        for late_s in (0.06, 0.0)
    ]
    target, measured = (np.column_stack([pair[k] for pair in both[0]]) for k in (0, 1))
    twin = np.column_stack([pair[1] for pair in both[1]])
    rows = {
        "time_s": time_s,
        "target": target,
        "measured": measured + rng.normal(0, 5e-4, measured.shape),
    }
    m = Measurement(
        name="slow",
        signals=("left_joint1", "left_joint2"),
        units=("rad", "rad"),
        **rows,
    )
    findings = check_against_twin(m, twin, dict.fromkeys(m.signals, 5e-4))
    assert [(f.check, f.feature, f.topic) for f in findings] == [
        ("shifted_from_twin", s, "late") for s in m.signals
    ]
    for f in findings:
        assert float(
            f.text.split(" ms")[0].split("comes ")[1].split(" ±")[0]
        ) == pytest.approx(60, abs=4)
        assert "2 joints are late alike" in f.text


def test_a_lead_is_a_warning_where_the_drive_s_numbers_are_uncertain(clean):
    early = shifted(clean, 1)
    twin = answer(clean.target, damping=1.3)[: early.num_rows]
    one, *others = [clean.signals[j] for j in ARMS_JOINTS]
    findings = check_against_twin(early, twin, floors(early), uncertain=[one])
    assert {f.feature: f.severity for f in findings} == dict.fromkeys(
        others, "error"
    ) | {one: "warning"}
    assert [f.feature for f in findings if "numbers in the file" in f.text] == [one]


def test_a_missing_effect_keeps_the_shift_from_the_twin_unjudged(clean):
    m = sweep(0, friction_nm=3.0, joints=[4])
    twin = answer(m.target)
    findings = check_against_twin(shifted(m, 1), twin[:-1], floors(m))
    assert [f.check for f in findings] == [
        "not_judged"
    ] and "look for the missing effect first" in findings[0].text


def test_friction_that_trails_the_twin_does_not_lead_it() -> None:
    """A slide at 53 mm/s whose 14 N take 14 / (30 · 600) m = 0.8 mm, 15 ms; beside other gains a shift of −4 ms fits better."""
    time_s = np.arange(2500) / 250
    target = 0.24 / np.pi * np.arcsin(np.sin(2 * np.pi * time_s / 9))
    motion = dataclasses.replace(servo(time_s, 0.0 * time_s, target), units=("m",))
    axis = axis_of(
        name="servo", unit="m", law="cascade", inertia=12.0, kp=30.0, kd=600.0
    )

    def slide(force_n: float = 0.0, **own: float) -> np.ndarray:
        made = altered(axis, **own)
        return axis_answer(
            made,
            axis_motion(made, motion),
            [make_effect("coulomb_friction", torque_nm=force_n)],
        ).reported

    twin, changed = (
        slide(),
        [slide(inertia=15.0).ravel(), slide(kp=33.0).ravel(), slide(kd=660.0).ravel()],
    )
    real = slide(14.0).reshape(-1, 1)
    assert pure_shift(real[:, 0], twin.ravel(), 0.004).delay_s == pytest.approx(
        14 / (30 * 600) / 0.0533, rel=0.2
    )
    m, floor = dataclasses.replace(motion, measured=real), {"servo": 1.44e-6}
    (finding,) = check_against_twin(
        m, twin.reshape(-1, 1), floor, changed=lambda _: changed
    )
    assert finding.check == "not_judged"


@pytest.mark.parametrize(
    ("rows_late", "friction_nm"), [(0, 1.0), (0, 3.0), (2, 1.0), (2, 3.0)]
)
def test_onsets_of_steps_show_a_late_measurement_under_any_friction(
    rows_late: int, friction_nm: float
) -> None:
    """Dry friction takes torque, and so acceleration; a joint begins when its target steps all the same."""
    target = steps(4, 0.2)
    m = measured(
        target, answer(target, friction_nm=friction_nm), np.random.default_rng(0), 1e-4
    )
    late = dataclasses.replace(
        m, measured=m.measured[np.maximum(np.arange(m.num_rows) - rows_late, 0)]
    )
    twin = answer(target)
    (finding,) = (
        f
        for f in check_against_twin(late, twin, floors(m))
        if f.feature == "left_joint5"
    )
    expected = ("shifted_from_twin", "warning") if rows_late else ("same_onset", "note")
    assert (finding.check, finding.severity) == expected
    delay = onset_delay(late, "left_joint5", twin[:, 4], floors(m)["left_joint5"])
    assert delay is not None and delay.num_steps == 5
    assert delay.delay_s == pytest.approx(0.005 * rows_late, abs=0.5e-3)


def test_leads_beside_steps_on_one_clock_are_gains_but_one_lead_alone_is_its_file_s_clock() -> (
    None
):
    led = find(
        "shifted_from_twin",
        "a",
        "a: it leads the twin's replay by 24 ms (4.8 rows): stamped too early",
    )
    unsure = find(
        "clock_or_effect", "a", "a leads, which velocity_feedforward explains as well"
    )
    onset = find("same_onset", "a", "a begins its steps on one clock")
    other = dataclasses.replace(led, feature="b")
    found = beside_onsets({"1": [led, other], "2": [led, other], "steps": [onset]})
    assert [f.severity for f in found["1"]] == ["warning", "error"] and found[
        "steps"
    ] == (onset,)
    assert (
        "24 ms (4.8 rows), though" in found["2"][0].text
        and "gains: fitted" in found["2"][0].text
    )
    assert beside_onsets({"1": [unsure, other], "2": [unsure], "steps": [onset]})[
        "1"
    ] == (other,)
    assert all(
        beside_onsets({"1": [alone], "steps": [onset]})["1"] == (alone,)
        for alone in (led, unsure)
    )


def test_onsets_whose_shape_differs_are_not_judged() -> None:
    """As with play: the first 20 mrad of 0.2 rad go by at once, from either end."""
    target = steps(4, 0.2)
    twin = answer(target)
    gone = twin - twin[0]
    quick = 0.02 * (np.tanh(gone / 0.005) + np.tanh((gone - 0.2) / 0.005) + 1.0)
    m = measured(
        target,
        twin + (np.ptp(target, axis=0) > 0) * quick,
        np.random.default_rng(0),
        1e-4,
    )
    assert onset_delay(m, "left_joint5", twin[:, 4], floors(m)["left_joint5"]) is None


def test_swapped_joints_are_named(clean):
    # The chirps differ in sign and size only, so joint 1 gets a motion of its own.
    target = clean.target.copy()
    target[:, 0] = rested(chirp(8.0, np.full(14, 0.2), np.zeros(14), high_hz=1.1))[:, 0]
    own = measured(target, answer(target), np.random.default_rng(0), 2e-4)
    m = with_column(
        with_column(own, "left_joint1", own.measured[:, 3]),
        "left_joint4",
        own.measured[:, 0],
    )
    swaps = [f for f in check_measurement(m) if f.check == "swapped_joints"]
    assert "left_joint1" in {
        f.feature for f in swaps
    } and "measured_before_command" not in found(m)
    assert (
        "their columns are exchanged. Pick elements by name in the recording spec"
        in swaps[0].text
    )
    table = dataclasses.replace(m, source=Path("a.csv"))
    (first, *_) = (
        f.text for f in check_measurement(table) if f.check == "swapped_joints"
    )
    assert (
        "`changes: {left_joint1.q: {column: left_joint4.q}, left_joint4.q: {column: left_joint1.q}}`"
        in first
    )


def test_swapped_arms_are_one_finding_and_both_moving_alike_none():
    swapped = dataclasses.replace(
        m := sweep(0, joints=[0, 1, 2, 3, 4, 5]),
        measured=np.roll(m.measured, 7, axis=1),
    )
    assert found(swapped)["swapped_arms"] == ["left_joint1"]
    assert "left and right are exchanged" in text_of(swapped, "swapped_arms")
    target = rested(
        chirp(6.0, np.tile(np.where(np.arange(7) == 6, 0.0, 0.2), 2), np.zeros(14))
    )
    assert found(measured(target, answer(target), np.random.default_rng(0), 2e-4)) == {}


WRONG_COLUMNS = [
    (
        "reversed",
        "right_joint6",
        "right_joint6 moves against its command",
        lambda q, u: (2 * HOME[12] - q, u),
    ),
    ("unit", "left_joint2", "degrees", lambda q, u: (np.degrees(q), u)),
    ("unit", "left_joint2", "degrees", lambda q, u: (q, np.degrees(u))),
    (
        "unit",
        "left_joint2",
        "degrees",
        lambda q, u: (np.degrees(q), np.degrees(u)),
    ),  # where the robot cannot be
    ("unit", "left_gripper", "in mm?", lambda q, u: (q * 1e3, u * 1e3)),
    ("start_offset", "right_joint2", "stands +0.199", lambda q, u: (q + 0.2, u)),
    (
        "dead_channel",
        "left_joint3",
        "the same number all the time",
        lambda q, u: (0.0 * q + HOME[2], u),
    ),
]
"""Check, signal, words of its text, and what is wrong in the signal's positions and targets."""


@pytest.mark.parametrize(("check", "name", "words", "wrong"), WRONG_COLUMNS)
def test_a_column_that_is_wrong_is_named(
    clean, check: str, name: str, words: str, wrong
):
    j = clean.column(name)
    q, target = wrong(clean.measured[:, j], clean.target[:, j])
    m = with_column(with_column(clean, name, q), name, target, "target")
    assert (
        found(m)[check] == [name]
        and words in text_of(m, check)
        and not {"unit", "dead_channel"} <= found(m).keys()
    )


@pytest.mark.parametrize(
    ("field", "times"), [("measured", "59.5"), ("target", "0.0181")]
)
def test_degrees_near_zero_are_seen_by_the_gain(field: str, times: str):
    # ±0.5° about zero lies within the joint's limits even when it is read as radians.
    m = sweep(0, joints=[0])
    target = HOME + (m.target - HOME) * 0.15
    small = measured(target, answer(target), np.random.default_rng(0), 1e-5)
    wrong = with_column(
        small, "left_joint1", np.degrees(getattr(small, field)[:, 0]), field
    )
    assert found(wrong)["unit"] == ["left_joint1"] and "dead_channel" not in found(
        wrong
    )
    # 57.3 or 1 / 57.3, times 1.04 for a lag of 88 ms where 100 were assumed
    assert f"goes {times} times" in text_of(wrong, "unit")


def test_velocity_in_rpm_is_named(clean):
    slope = np.gradient(clean.measured, 1 / RATE_HZ, axis=0)
    assert "velocity_unit" not in found(dataclasses.replace(clean, velocity=slope))
    assert "rpm?" in text_of(
        dataclasses.replace(clean, velocity=slope * 60 / (2 * math.pi)), "velocity_unit"
    )


@pytest.mark.filterwarnings("error")
def test_the_time_of_efforts_is_not_judged_where_the_dither_of_readings_outweighs_the_motion():
    """Readings that alternate by d have fourth differences of 16 d, a noise of 1.4826 · 16 d / √70 = 2.8 d, and hide in central
    differences: more noise is taken off the squared velocity than is in it."""
    time_s = np.arange(1600) / 200
    target = 1e-3 * np.sin(np.pi * time_s)
    reading = target + 3.9e-6 * (-1.0) ** np.arange(1600)
    effort = np.random.default_rng(0).standard_normal((1600, 1))
    m = dataclasses.replace(servo(time_s, reading, target), effort=effort)
    assert (
        target_share(DriveLaw(law="impedance", kp=100.0, kd=5.0), [m], "servo") is None
    )


def moved_by_law(seed: int, kp: float = 100.0) -> Measurement:
    """0.4 kg·m² q̈ = ``kp`` (q* − q) − 8 q̇, rows of 5 ms; efforts were not recorded."""
    time_s = np.arange(2000) / 200
    target = 0.1 * np.sin(
        2 * np.pi * (0.1 * time_s + 0.12 * time_s**2)
    ) + 0.2 * np.sign(np.sin((4.0 + seed) * time_s))
    q = lsim(([kp], [0.4, 8.0, kp]), np.repeat(target, 5)[:-4], np.arange(9996) / 1000)[
        1
    ][::5]
    q = q + 5e-5 * np.random.default_rng(seed).standard_normal(2000)
    return dataclasses.replace(servo(time_s, q, target), name=f"{seed}.csv")


@pytest.mark.parametrize("kp", [25.0, 400.0, 100.0])
@pytest.mark.parametrize("kd", [8.0, 2.0])
def test_positions_show_a_wrong_kp_but_not_both_gains_off_alike_as_of_another_inertia(
    kp: float, kd: float
):
    m = dataclasses.replace(moved_by_law(0), kp={"servo": kp}, kd={"servo": kd})
    law, findings = DriveLaw(law="impedance", kp=kp, kd=kd), {"0.csv": []}
    check_effort_time(law, [m], findings, "servo", "servo.yaml", lambda _: 0.4)
    named = abs(math.log(100.0 / kp)) > 1.0 and kp / kd != 100.0 / 8.0
    assert [f.check for f in findings["0.csv"]] == ["other_gains"] * named
    found = [
        float(x)
        for f in findings["0.csv"]
        for x in re.findall(r"k[pd]: ([\d.]+)", f.text)
    ]
    assert found == pytest.approx([100.0, 8.0] * named, rel=0.05)


@pytest.mark.parametrize(
    ("kp", "far", "named"),
    [(100.0, 0.0, False), (200.0, 0.0, True), (200.0, 0.3, False)],
)
def test_recordings_of_two_machines_are_told_by_what_differs(
    kp: float, far: float, named: bool
):
    """No efforts are recorded. A second joint moves by 0.3 rad, and its accelerations act on the first: that is no finding."""
    every = [moved_by_law(0), moved_by_law(1), moved_by_law(2, kp)]
    for k, m in enumerate(every):
        second = {
            name: np.hstack([getattr(m, name), far * np.sin(m.time_s)[:, None]])
            for name in ("target", "measured")
        }
        about = {
            "signals": ("servo", "second"),
            "units": ("rad", "rad"),
            "quantum": np.zeros(2),
        }
        every[k] = Measurement(name=m.name, time_s=m.time_s, **about, **second)
    law, findings = (
        DriveLaw(law="impedance", kp=120.0, kd=8.0),
        {m.name: [] for m in every},
    )
    check_effort_time(law, every, findings, "servo", "servo.yaml", lambda _: 0.4)
    assert ["2 times as large in 2.csv as in" in f.text for f in findings["0.csv"]] == [
        True
    ] * named


def test_a_slow_triangle_does_not_date_the_efforts_of_other_recordings():
    """K_p v / rate = 100 · 0.04 / 200 = 0.02 N·m, as much as a torque with the sign of the motion: r would be 1 instead of 0."""
    time_s, law, rng = (
        np.arange(4000) / 200,
        DriveLaw(law="impedance", kp=100.0, kd=5.0),
        np.random.default_rng(0),
    )

    def logged(name: str, target: np.ndarray) -> Measurement:
        q = lfilter([0.05], [1, -0.95], target)
        effort = 100.0 * (np.append(target[:1], target[:-1]) - q) - 5.0 * np.gradient(
            q, 0.005
        )
        effort += 0.02 * np.sign(np.gradient(q)) + 0.002 * rng.standard_normal(4000)
        gains = {"kp": {"servo": 100.0}, "kd": {"servo": 5.0}}
        return dataclasses.replace(
            servo(time_s, q, target), name=name, effort=effort[:, None], **gains
        )

    triangle = logged("tri", 0.2 - np.abs(0.04 * (time_s % 10) - 0.2))
    chirp = logged("chirp", 0.1 * np.sin(np.pi * time_s**2 / 10))
    share, sd = target_share(law, [triangle], "servo") or (0.0, np.inf)
    assert sd > 0.1 or abs(share) < 0.3
    share, sd = target_share(law, [triangle, chirp], "servo") or (1.0, np.inf)
    assert abs(share) < 0.1 and sd < 0.1
    late, findings = (
        DriveLaw(law="impedance", kp=100.0, kd=5.0, effort_after_target=True),
        {"tri": [], "chirp": []},
    )
    check_effort_time(
        law, [triangle, chirp], findings, "servo", "servo.yaml", lambda m: 0.02
    )
    assert findings == {"tri": [], "chirp": []}
    check_effort_time(
        late, [triangle, chirp], findings, "servo", "servo.yaml", lambda m: 0.02
    )
    assert [[f.check for f in own] for own in findings.values()] == [
        ["effort_time"],
        ["effort_time"],
    ]
    early = dataclasses.replace(
        chirp, effort=np.roll(chirp.effort, -3, axis=0)
    )  # the position is late, too
    check_effort_time(
        law, [early], findings := {"chirp": []}, "servo", "servo.yaml", lambda m: 0.02
    )
    (said,) = findings["chirp"]
    assert (
        said.check == "effort_time"
        and "3 rows (15 ms)" in said.text
        and "Write `effort_after" not in said.text
    )


def test_a_frozen_effort_is_placed_where_its_joint_goes_to_and_fro(clean):
    stuck, rng = 600, np.random.default_rng(0)
    effort = np.gradient(clean.measured, axis=0) + rng.normal(
        0, 1e-3, clean.measured.shape
    )
    assert "frozen_effort" not in found(dataclasses.replace(clean, effort=effort))
    effort[stuck:, 2] = effort[stuck, 2]
    m = dataclasses.replace(clean, effort=effort)
    assert found(m)["frozen_effort"] == ["left_joint3"]
    finding = next(f for f in check_measurement(m) if f.check == "frozen_effort")
    assert (
        finding.rows == (stuck, clean.num_rows)
        and "effort_scale: {left_joint3: 0}" in finding.text
    )
    steady = np.round(effort[:, 3], 1) + np.where(
        np.arange(clean.num_rows) % 1000 < 500, 1.0, -1.0
    )  # friction
    effort[:, 2], effort[:, 3] = rng.normal(0, 1, clean.num_rows), steady
    assert "frozen_effort" not in found(dataclasses.replace(clean, effort=effort))


def test_a_joint_at_rest_until_its_command_jumps_is_not_frozen(clean):
    """600 rows at 200 Hz, one encoder reading; the command jumps by 1 rad in the row before the joint answers."""
    target, values = clean.target[:, 1].copy(), clean.measured[:, 1].copy()
    target[:601], values[:601] = values[0], values[0]
    target[600:], values[601:] = (
        values[0] + 1.0,
        values[0] + 1.0 - np.exp(-np.arange(len(values) - 601) / 20.0),
    )
    m = with_column(
        with_column(clean, "left_joint2", values), "left_joint2", target, "target"
    )
    assert "left_joint2" not in found(m).get("frozen_channel", []) + found(m).get(
        "saturated_channel", []
    )
    late = m.target.copy()
    late[400:, 1] = values[0] + 1.0  # one second without an answer
    assert "left_joint2" in found(dataclasses.replace(m, target=late)).get(
        "saturated_channel", []
    )


def sticking_servo(
    hz: float, friction_nm: float, seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(time_s, q, target) of a servo with J = 6 g m², K_p = 0.8 N·m/rad that sticks at each reversal, logged at 95 Hz with
    jitter in steps of 2π / 4096: equations of this test."""
    time_s = np.arange(6000) * 1e-3
    goal = 0.4 * np.sin(2 * np.pi * hz * time_s)
    q = np.empty(len(goal))
    at = speed = 0.0
    for k, target in enumerate(goal.tolist()):
        torque = 0.8 * (target - at) - 0.05 * speed
        if speed == 0.0 and abs(torque) < friction_nm:
            torque = 0.0
        else:
            side = math.copysign(1.0, speed or torque)
            faster = speed + 1e-3 * (torque - friction_nm * side) / 0.006
            speed = 0.0 if faster * side < 0.0 else faster
        at += 1e-3 * speed
        q[k] = at
    logged = np.cumsum(0.0105 + 0.001 * np.random.default_rng(seed).uniform(-1, 1, 560))
    step = 2 * math.pi / 4096
    return (
        logged,
        np.round(np.interp(logged, time_s, q) / step) * step,
        np.interp(logged, time_s, goal),
    )


def servo(
    time_s: np.ndarray, q: np.ndarray, target: np.ndarray, quantum: float = 0.0
) -> Measurement:
    columns = {
        "target": target[:, None],
        "measured": q[:, None],
        "quantum": np.array([quantum]),
    }
    return Measurement(
        name="swing", time_s=time_s, signals=("servo",), units=("rad",), **columns
    )


@pytest.mark.parametrize("friction_nm", [0.1, 0.16])
@pytest.mark.parametrize("rate_hz", [50, 200, 1000])
@pytest.mark.parametrize("hz", [pytest.param(0.3, marks=pytest.mark.slow), 0.5])
def test_a_servo_that_sticks_is_data_at_whatever_rate_its_log_was_brought(
    friction_nm: float, rate_hz: int, hz: float
):
    """Positions of 95 Hz repeat exactly on an even grid while it sticks, and move between the encoder's steps elsewhere. It also
    sticks to the end of a recording. Where a driver repeated a value, the joint is 0.2 rad further afterwards: an error."""
    logged, q, target = sticking_servo(hz, friction_nm, 0)
    grid = np.arange(0.0, logged[-1], 1 / rate_hz)
    even = servo(grid, np.interp(grid, logged, q), np.interp(grid, logged, target))
    by = found(even)
    assert {"sticking_joint", "blocked"} & by.keys() and not {
        "frozen_channel",
        "saturated_channel",
    } & by.keys()
    _, end = next(
        f.rows
        for f in check_measurement(even)
        if f.check in ("sticking_joint", "blocked") and f.rows
    )
    rows = slice(0, end - round(0.05 * rate_hz))
    cut = servo(grid[rows], even.measured[rows, 0], even.target[rows, 0])
    assert not {"frozen_channel", "saturated_channel"} & found(cut).keys()
    rising = int(
        np.argmax(
            np.diff(even.measured[:, 0]) > 0.9 * np.diff(even.measured[:, 0]).max()
        )
    )
    repeated = even.measured[:, 0].copy()
    held = slice(rising, rising + round(0.4 * rate_hz))
    assert abs(repeated[held.stop] - repeated[rising]) > 0.1
    repeated[held] = repeated[rising]
    assert found(servo(grid, repeated, even.target[:, 0]))["frozen_channel"] == [
        "servo"
    ]


@pytest.mark.parametrize("rest_rows", [0, 10])
@pytest.mark.parametrize("step_rad", [1.0, -0.5])
def test_a_step_from_rest_is_data_whether_its_target_jumps_in_the_first_row_or_later(
    rest_rows: int, step_rad: float
):
    """J = 0.02 kg·m², K_p = 10 N·m/rad, K_d = 0.8 N·m·s/rad; 1 s at 50 Hz. The file has these numbers, so that little remains."""
    goal = np.where(np.arange(50 + rest_rows) >= rest_rows, step_rad, 0.0)
    at = speed = 0.0
    q = np.empty(len(goal))
    for k, target in enumerate(goal.tolist()):
        q[k] = at
        for _ in range(200):
            speed += 1e-4 * (10.0 * (target - at) - 0.8 * speed) / 0.02
            at += 1e-4 * speed
    m = servo(np.arange(len(goal)) / 50, np.round(q / 0.0015) * 0.0015, goal, 0.0015)
    seen = check_measurement(m)
    assert not [f for f in seen if f.severity == "error"]
    assert not {"no_motion", "not_at_rest", "start_offset"} & {f.check for f in seen}
    axis = axis_of(name="servo", unit="rad", inertia=0.02, kp=10.0, kd=0.8)
    answer_rad = axis_answer(axis, axis_motion(axis, m), []).reported
    assert np.sqrt(np.mean((answer_rad - q) ** 2)) < 0.01 * abs(step_rad)


def test_an_accepted_error_is_a_warning_that_stays(clean):
    values = clean.measured[:, 1].copy()
    values[600:700] = values[600]
    m = with_column(clean, "left_joint2", values)
    (finding,) = [
        f
        for f in check_measurement(m, accept=["frozen_channel"])
        if f.check == "frozen_channel"
    ]
    assert (
        finding.severity == "warning"
        and "accepted by --accept=frozen_channel" in finding.text
    )
    with pytest.raises(
        TaccorlError, match=r"--accept=frozen_chanel: no check.*frozen_channel"
    ):
        check_names(["frozen_chanel"])
    check_names([name for name, listed in CHECKS.items() if listed.severity == "error"])


@pytest.mark.parametrize(
    ("unit", "factor"), [pytest.param("rad", 1.0, marks=pytest.mark.slow), ("m", 0.1)]
)
@pytest.mark.parametrize(
    "fault",
    [
        "frozen_channel",
        "saturated_channel",
        "sticking_joint",
        "blocked",
        "noisy blocked",
        "",
    ],
)
def test_a_slide_is_checked_as_a_hinge_with_a_tenth_of_each_distance(
    clean, unit: str, factor: float, fault: str
):
    j, top = 1, float(np.quantile(answer(clean.target)[:, 1], 0.8))
    q = answer(clean.target, highest_rad=top if fault == "blocked" else np.inf)[:, j]
    if fault == "frozen_channel":
        q[600:700] = q[600]
    noisy = np.minimum(
        q, top + 2e-4 * np.random.default_rng(0).normal(size=clean.num_rows)
    )
    sticks = play(
        clean.target[:, j], 0.06, clean.measured[0, j]
    )  # by dry friction, until its target is 0.06 rad away
    q = {
        "saturated_channel": np.minimum(q, top),
        "sticking_joint": sticks,
        "noisy blocked": noisy,
    }.get(fault, q)
    step = math.radians(0.001) * (fault in ("frozen_channel", "sticking_joint"))
    q = np.round(q / step) * step if step else q
    m = dataclasses.replace(
        servo(clean.time_s, factor * q, factor * clean.target[:, j], factor * step),
        units=(unit,),
    )
    stands = "frozen_channel", "saturated_channel", "sticking_joint", "blocked"
    assert {c: on for c, on in found(m).items() if c in stands} == (
        {fault.split()[-1]: ["servo"]} if fault else {}
    )
    severity = {f.severity for f in check_measurement(m) if f.check in stands}
    assert severity == (
        {"warning" if fault[:5] in ("stick", "block", "noisy") else "error"}
        if fault
        else set()
    )
    assert fault != "frozen_channel" or next(
        f.rows for f in check_measurement(m) if f.check == fault
    ) == (600, 700)
    assert (
        fault != "saturated_channel"
        or f"reads {factor * top:.4f} {unit} without" in text_of(m, fault)
    )
    assert fault != "sticking_joint" or "dry friction" in text_of(m, fault)


@pytest.mark.parametrize("end", ["upper", "lower"])
def test_a_stop_is_a_warning_that_names_its_effect_and_an_end_of_the_readings_an_error(
    clean, end
):
    """Both give equal readings at one end; only the joint at a stop moves as soon as its command is back."""
    high = np.quantile(clean.measured, 0.75, axis=0)
    step = 2 * math.pi / 4096
    at_stop, cut = (
        answer(clean.target, highest_rad=high),
        np.minimum(answer(clean.target), high),
    )
    sign = {"upper": 1.0, "lower": -1.0}[
        end
    ]  # mirrored about the home pose, so that joints stay within their limits
    seen = {}
    for name, true in (("stop", at_stop), ("cut", cut)):
        columns = {"target": clean.target, "measured": step * np.round(true / step)}
        mirrored = {
            key: HOME + sign * (values - HOME) for key, values in columns.items()
        }
        seen[name] = check_measurement(dataclasses.replace(clean, **mirrored))
    joints = {clean.signals[j] for j in ARMS_JOINTS}
    assert {f.feature for f in seen["stop"] if f.check == "blocked"} == joints
    assert not [f for f in seen["stop"] if f.severity == "error"]
    assert all("end_stop" in f.text for f in seen["stop"] if f.check == "blocked")
    assert {f.feature for f in seen["cut"] if f.check == "saturated_channel"} == joints
    assert not [f for f in seen["cut"] if f.check == "blocked"]


def test_effort_at_its_limit_is_a_note_and_dead_effort_a_warning(clean):
    effort = np.full(clean.measured.shape, np.nan)
    effort[:, 4] = np.clip(20 * (clean.target - clean.measured)[:, 4], -0.5, 0.5)
    effort[:, 5] = 7.0
    m = dataclasses.replace(clean, effort=effort)
    assert found(m)["effort_limit"] == ["left_joint5"] and "exactly ±0.5" in text_of(
        m, "effort_limit"
    )
    assert found(m)["dead_effort"] == ["left_joint6"]
    nothing = np.full(effort.shape, np.nan)
    nothing[:, 5] = 0.0
    zeros = dataclasses.replace(clean, effort=nothing, source=Path("run.csv"))
    assert found(zeros)["dead_effort"] == ["left_joint6"]
    assert "left_joint6.tau out of run.csv" in text_of(zeros, "dead_effort")
    # With the noise of a sensor no two rows are equal; without a limit the same noise is no plateau.
    noise = 0.01 * np.random.default_rng(0).normal(size=clean.num_rows)
    asked = 20 * (clean.target - clean.measured)[:, 4]
    for limit, notes in ((0.5, ["left_joint5"]), (100.0, [])):
        effort[:, 4] = np.clip(asked, -limit, limit) + noise
        m = dataclasses.replace(clean, effort=effort)
        assert found(m).get("effort_limit", []) == notes
        assert not notes or "±0.5 (within 0.009" in text_of(m, "effort_limit")
        for stated, left in ((limit, []), (1.1 * limit, notes)):
            told = check_measurement(m, limits={"left_joint5": stated})
            assert [f.feature for f in told if f.check == "effort_limit"] == left, (
                "the file states that limit"
            )


def test_a_sweep_that_never_moves_the_joint():
    m = sweep(0, joints=[4])
    assert "s: record a sweep" in text_of(
        dataclasses.replace(m, target=np.tile(HOME, (m.num_rows, 1))), "no_motion"
    )
    in_degrees = dataclasses.replace(m, target=HOME + np.deg2rad(m.target - HOME))
    assert "joint5 moves further: are its targets in another unit" in text_of(
        in_degrees, "no_motion"
    )


def test_too_short(clean):
    assert "of motion in 140 rows" in text_of(some(clean, slice(180, 320)), "too_short")
    assert found(sweep(0, seconds=2.0))["short"] == [""]


@pytest.mark.parametrize("kp", [40.0, 150.0, 600.0])
@pytest.mark.parametrize("rate_hz", [100, 200, 500])
@pytest.mark.parametrize("steps", [True, False])
def test_a_step_of_the_target_in_row_0_is_no_speed_at_row_0(kp, rate_hz, steps):
    """A mass of 0.05 kg·m², well damped, at rest: its target steps by 0.2 rad in row 0. Or on its way with a target that
    moves on at 0.6 rad/s. q by the exact solution of its equation."""
    from scipy.linalg import expm

    inertia, kd = 0.05, 1.4 * np.sqrt(kp * 0.05)
    step = expm(np.array([[0.0, 1.0], [-kp / inertia, -kd / inertia]]) / rate_hz)
    time_s = np.arange(30) / rate_hz
    lag = 0.0 if steps else 0.6 * kd / kp  # of the mass behind a moving target
    target = 0.2 + (0.0 if steps else 0.6) * time_s
    state, rows = np.array([-0.2 if steps else 0.0, 0.0]), []
    for goal in target:
        rows.append(goal - lag + state[0])
        state = step @ state
    assert _answers_a_jump(target, np.array(rows)) == steps


def test_not_at_rest_at_the_start(clean):
    m = some(clean, slice(900, None))
    m = dataclasses.replace(m, time_s=m.time_s - m.time_s[0])
    assert "not_at_rest" in found(
        m
    ) and "begin the recording a second before the motion" in text_of(m, "not_at_rest")


def followed(target: np.ndarray, rate_hz: float, kp: float, kd: float) -> Measurement:
    """A joint of 0.05 kg·m² at rest that follows ``target`` (T,) from row 0 on, with noise."""
    step_s, q, v, rows = 1e-4, 0.0, 0.0, []
    for goal in target.tolist():
        rows.append(q)
        for _ in range(round(1.0 / (rate_hz * step_s))):
            v += step_s * (kp * (goal - q) - kd * v) / 0.05
            q += step_s * v
    noise = 1e-4 * np.random.default_rng(0).standard_normal(len(target))
    return of_signal("made", rate_hz, target, np.array(rows) + noise, "elbow")


@pytest.mark.parametrize(("kp", "kd"), [(20.0, 1.5), (150.0, 5.0), (5.0, 0.3)])
@pytest.mark.parametrize("rate_hz", [50, 100, 200, 500])
def test_a_jump_of_the_target_in_the_first_rows_is_no_motion_before_row_0(
    rate_hz, kp, kd
):
    rows = np.arange(rate_hz)
    for row, size in itertools.product((0, 1, 2, 5), (0.02, 0.3)):
        target = np.where(rows < row, 0.0, size) * (rows < rate_hz // 2)
        trial = Trial(followed(target, rate_hz, kp, kd))
        assert not [f for f in check_start(trial) if f.check == "not_at_rest"]
    whole = followed(0.3 * np.sin(2 * np.pi * rows / rate_hz), rate_hz, kp, kd)
    trial = Trial(some(whole, slice(rate_hz // 2, None)))
    assert [f.check for f in check_start(trial)] == ["not_at_rest"]


def test_time_that_runs_backwards_or_in_milliseconds_stops_everything_else(clean):
    time_s = clean.time_s.copy()
    time_s[500] = time_s[498]
    m = dataclasses.replace(clean, time_s=time_s)
    assert found(m) == {"time_backwards": ["time"]} and "at row 500" in text_of(
        m, "time_backwards"
    )
    time_s[500] = time_s[499] = 2.495
    twice = text_of(dataclasses.replace(clean, time_s=time_s), "time_backwards")
    assert (
        "stands still at 2.495" in twice
        and "goes from" not in twice
        and "1 such" in twice
    )
    assert found(dataclasses.replace(clean, time_s=-clean.time_s)) == {
        "time_backwards": ["time"]
    }  # not short, too
    assert found(dataclasses.replace(clean, time_s=clean.time_s * 1e3)) == {
        "time_unit": ["time"]
    }


@pytest.mark.parametrize("epoch_s", [1.76e9, 2e5])
def test_times_that_32_bits_made_equal_are_named_with_the_reason(clean, epoch_s):
    """Numbers of 32 bits near 1.76e9 are 128 apart, near 2e5 1/64 = 0.0156."""
    stored = (epoch_s + clean.time_s).astype(np.float32).astype(float)
    first_ns = round(stored[0] * 1e9)
    m = dataclasses.replace(clean, time_s=stored - stored[0], start_ns=first_ns)
    spacing = "128" if epoch_s > 1e9 else "0.015625"
    assert f"32 bits are {spacing} s apart" in text_of(m, "time_backwards")


@pytest.mark.parametrize("time_s", [5.0, 0.0])
def test_times_that_are_all_equal_stop_everything_else(clean, time_s):
    stamps = np.full(clean.num_rows, time_s)
    m = dataclasses.replace(clean, time_s=stamps, start_ns=round(time_s * 1e9))
    assert found(m) == {"time_backwards": ["time"]}
    assert "stands still" in text_of(m, "time_backwards")
    assert "32 bits" not in text_of(m, "time_backwards")


def test_a_wrapped_angle_is_named_and_a_fast_joint_is_not(clean):
    turned = clean.measured[:, 4] + np.pi - clean.measured[:, 4].mean()
    m = with_column(clean, clean.signals[4], (turned + np.pi) % (2 * np.pi) - np.pi)
    assert found(m)["wrapped"] == ["left_joint5"]
    table = dataclasses.replace(m, source=Path("a.csv"))
    lines = "left_joint5.q: {unwrap: true}, left_joint5.q_target: {unwrap: true}"
    assert f"`changes: {{{lines}}}`" in text_of(table, "wrapped")
    assert "wrapped" not in found(clean)


@pytest.mark.parametrize("row", [0, 700, -1])
def test_a_row_that_a_logger_filled_with_zero_is_named_and_a_joint_that_breaks_free_is_not(
    clean, row
):
    values = (
        clean.measured[:, 4] - clean.measured[:, 4].mean() + 0.9
    )  # the joint moves by less than that
    row %= clean.num_rows
    filled = with_column(
        clean, clean.signals[4], np.where(np.arange(clean.num_rows) == row, 0.0, values)
    )
    (finding,) = (f for f in check_measurement(filled) if f.severity == "error")
    assert (finding.check, finding.rows) == ("not_finite", (row, row + 1))
    free = with_column(
        clean, clean.signals[4], values + 0.5 * (np.arange(clean.num_rows) > 700)
    )
    assert "not_finite" not in found(free)


def test_dropped_rows_are_counted_and_placed(clean):
    keep = np.delete(np.arange(clean.num_rows), [*range(700, 712), 900])
    text = text_of(some(clean, keep), "dropped_rows")
    assert text.startswith(
        "13 rows are missing in 2 gaps, the longest 65.0 ms after row 699 (3.495 s)"
    )
    table = dataclasses.replace(
        some(clean, keep), source=Path("a.csv")
    )  # which no replay takes
    for m, severity in ((some(clean, keep), "warning"), (table, "error")):
        assert {
            f.severity for f in check_measurement(m) if f.check == "dropped_rows"
        } == {severity}


@pytest.mark.parametrize(("jitter_s", "caught"), [(1e-5, False), (2e-3, True)])
def test_jitter_of_row_times(clean, jitter_s, caught):
    time_s = clean.time_s + jitter_s * np.random.default_rng(0).uniform(
        -0.5, 0.5, clean.num_rows
    )
    assert (
        "jitter" in found(dataclasses.replace(clean, time_s=time_s - time_s[0]))
    ) is caught


def test_holes_and_nan_are_errors_with_their_place(clean):
    m = with_column(
        clean,
        "left_joint5",
        np.where(np.arange(clean.num_rows) // 50 == 12, np.nan, clean.measured[:, 4]),
    )
    hole = next(f for f in check_measurement(m) if f.check == "lost_samples")
    assert (hole.feature, hole.rows) == (
        "left_joint5",
        (600, 650),
    ) and "load on the logger" in hole.text
    cut = text_of(
        dataclasses.replace(m, findings=(Finding("damaged", "warning", "file", "x"),)),
        "lost_samples",
    )
    assert "copy it again" in cut and "load on the logger" not in cut
    bad = with_column(clean, "left_joint5", np.full(clean.num_rows, np.nan), "target")
    assert found(bad)["not_finite"] == ["left_joint5"]


def test_channels_of_a_recording_speak_for_themselves(clean):
    base = ChannelTiming(
        "left_command", "action", "line", 100.0, 0, 0.01, 0.0, 0.0, nominal_hz=200.0
    )
    often = round(0.3 * 200.0 * (clean.time_s[-1] - clean.time_s[0]))
    state = dataclasses.replace(
        base, channel="left_state", rate_hz=200.0, out_of_order=3, duplicates=often
    )
    m = dataclasses.replace(clean, timing=(base, state))
    assert found(m) == {
        "low_rate": ["left_command"],
        "out_of_order": ["left_state"],
        "duplicates": ["left_state"],
    }
    assert text_of(m, "duplicates").startswith(f"{often} samples of left_state repeat")
    assert (
        found(
            dataclasses.replace(
                clean,
                timing=(dataclasses.replace(state, out_of_order=0, duplicates=9),),
            )
        )
        == {}
    )
    apart = dataclasses.replace(base, rate_hz=200.0, age_median_s=0.002)
    assert found(dataclasses.replace(clean, timing=(apart,))) == {
        "jitter": ["left_command"]
    }
    assert found(dataclasses.replace(clean, time_error_s=0.005)) == {
        "row_times": ["time"]
    }


@pytest.mark.slow
def test_an_untold_repeat_is_pointed_out(clean):
    noise = np.random.default_rng(1).normal(0, 2e-5, clean.measured.shape)
    again = dataclasses.replace(clean, name="again", measured=clean.measured + noise)
    other = dataclasses.replace(sweep(3), name="other")
    by = check_measurements([clean, again, other])
    assert [f.check for f in by["again"]] == [
        "same_motion"
    ] and "repeat_of: sweep" in by["again"][0].text
    assert by["other"] == []
    assert [f.check for f in by["sweep"]] == [
        "not_judged"
    ]  # what does not repeat, without repeats
    told = dataclasses.replace(again, repeat_of="sweep")
    assert check_measurements([clean, told]) == {"sweep": [], "again": []}
    (f,) = check_measurements(
        [clean, dataclasses.replace(told, measured=clean.measured)]
    )["again"]
    assert (
        f.check == "copied_recording" and "again is sweep, number for number" in f.text
    )
    copy = dataclasses.replace(
        clean, name="a_copy"
    )  # the one that nothing says anything of goes, whatever its name
    checks = {
        name: [f.check for f in own]
        for name, own in check_measurements([copy, clean, told]).items()
    }
    assert checks == {"a_copy": ["copied_recording"], "sweep": [], "again": []}


def test_same_commands_with_another_answer_ask_about_gains_and_payload_not_for_repeat_of(
    clean,
):
    slower = np.apply_along_axis(
        lambda c: np.interp(clean.time_s - 0.02, clean.time_s, c), 0, clean.measured
    )
    found = check_measurements(
        [clean, dataclasses.replace(clean, name="other", measured=slower)]
    )["other"]
    assert "same_motion" not in {f.check for f in found}
    (f,) = [f for f in found if f.check == "same_commands"]
    assert f.severity == "warning"
    assert "other: {gain_scale: {left_joint" in f.text and "payload_kg: {left" in f.text
    assert "Only if nothing was changed" in f.text


def test_same_commands_of_an_axis_ask_for_its_own_payload_and_lever(clean):
    knee = dataclasses.replace(clean.only(["left_joint5"]), signals=("knee",))
    slower = np.interp(knee.time_s - 0.02, knee.time_s, knee.measured[:, 0])[:, None]
    found = check_measurements(
        [knee, dataclasses.replace(knee, name="other", measured=slower)]
    )["other"]
    (f,) = [f for f in found if f.check == "same_commands"]
    assert (
        "payload_kg: {knee: 0.5}" in f.text
        and "lever_m" in f.text
        and "left" not in f.text
    )


JOINT_EFFECTS = [name for name in effects if issubclass(effects.get(name), JointEffect)]


# A joint at its stop deserves a warning, for the motion beyond is not in the recording; one that names the effect.
@pytest.mark.slow
@pytest.mark.parametrize("name", JOINT_EFFECTS)
def test_no_joint_effect_of_the_registry_is_taken_for_a_fault_of_the_telemetry(name):
    effect = make_effect(
        name, **{p.name: p.typical for p in effects.get(name).parameters()}
    )
    amplitude = np.where(np.isin(np.arange(14), ARMS_JOINTS), 0.12, 0.0)
    motion = rested(chirp(6.0, amplitude, np.pi * (np.arange(14) % 2))) - HOME
    sim = Simulation(Bench(), TwinConfig(effects=[effect]))
    sim.reset([0])
    target = sim.targets[0] + motion
    for _ in range(40):
        sim.advance(target[0][None, None], 30)
    done = replay(sim, target, float(RATE_HZ), sim.proprioception()[0])
    m = measured(
        target, done.reported, np.random.default_rng(0), 2e-4, effort=done.effort
    )
    worse = [f for f in check_measurement(m) if f.severity != "note"]
    assert [f for f in worse if f.severity == "error" or name not in f.text] == []

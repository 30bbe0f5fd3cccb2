"""Planted faults of pads are found on the planted taxels and pads; touch that is merely unusual is left in peace."""

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
from synthetic_episode import ACTION, GRIPPER, PADS, SPEC, STATE, TOUCH, base, copies, make, with_arrays

from taccorl.data import grip_checks, touch_checks
from taccorl.data.checks import check_episode, check_recording_episodes
from taccorl.data.episode import Episode
from taccorl.data.finding import Finding

FPS = SPEC.fps
NUM_SEEDS = 30
FEW_SEEDS = 2
SEEDS = [pytest.param(k, marks=[pytest.mark.slow] * (k >= 2)) for k in range(5)]
LEFT_A, LEFT_B, RIGHT_A, RIGHT_B = range(4)


def flat(touch: np.ndarray) -> np.ndarray:
    return touch.reshape(len(touch), -1)


def found(episode: Episode, check: str) -> list[Finding]:
    return [f for f in check_episode(episode, pictures=False) if f.check == check]


def one(episode: Episode, check: str) -> Finding:
    findings = found(episode, check)
    assert len(findings) == 1, findings
    return findings[0]


def serious(episode: Episode) -> list[Finding]:
    return [f for f in check_episode(episode, pictures=False) if f.severity != "note"]


def pad(episode: Episode, name: str) -> touch_checks.Pad:
    return next(p for p in touch_checks.read_pads(episode, TOUCH) if p.name == name)


def wire(episode: Episode, counts: np.ndarray) -> Episode:
    """The episode with (T, 4, 32, 12) counts on the wire in place of its own; the baseline stays."""
    return with_arrays(episode, touch=flat(counts) - episode.baselines[TOUCH].astype(np.int16))


def on_wire(episode: Episode) -> np.ndarray:
    """(T, 4, 32, 12) counts as they came over the wire."""
    return (episode.arrays[TOUCH] + episode.baselines[TOUCH]).reshape(-1, 4, 32, 12)


def rebased(episode: Episode, counts: np.ndarray) -> Episode:
    """``counts`` on the wire with the baseline that ingest would take: the median of the first 30 frames."""
    baseline = np.round(np.median(flat(counts)[:30], axis=0)).astype(np.int64)
    touch = (flat(counts) - baseline).astype(np.int16)
    return dataclasses.replace(with_arrays(episode, touch=touch), baselines={TOUCH: baseline})


def deepest(episode: Episode, p: int) -> tuple[int, int]:
    """(row, column) of the taxel that feels most, away from the pad's edge."""
    peak = episode.arrays[TOUCH].reshape(-1, 4, 32, 12)[:, p].mean(axis=0)
    peak[[0, -1]], peak[:, [0, -1]] = 0, 0
    r, c = np.unravel_index(np.argmax(peak), peak.shape)
    return int(r), int(c)


@pytest.fixture(scope="module")
def good() -> Episode:
    return make(seed=100)


# ---- unusual, but not wrong ----


def test_contact_coverage_is_told(good: Episode) -> None:
    text = one(good, "contact_coverage").text
    for name in PADS:
        share = pad(good, name).contact.mean()
        assert 0.2 < share < 0.8
        assert f"{name} in {share:.0%} of the rows" in text


@pytest.mark.parametrize("seed", SEEDS)
def test_one_armed_task_gives_nothing(seed: int) -> None:
    episode = make(seed=seed, duration_s=10.0)
    state, action, touch = copies(episode)
    state[:, 7:], action[:, 7:] = state[0, 7:], action[0, 7:]
    touch[:, 2:] = np.random.default_rng(seed).normal(0, 1.3, touch[:, 2:].shape).round()
    assert serious(with_arrays(episode, state=state, action=action, touch=flat(touch))) == []


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("changes", [{"part_m": {"left": 0.0, "right": 0.0}}, {"noise_count": 0.0}])
def test_grippers_that_close_on_nothing_and_twins_without_noise_give_nothing(changes: dict, seed: int) -> None:
    assert serious(make(seed=seed, duration_s=10.0, **changes)) == []


def test_part_held_from_start_to_end_gives_nothing(good: Episode) -> None:
    held = slice(170, 250)  # 5.7 to 8.3 s of 12 s: both hold
    episode = with_arrays(
        good, state=good.arrays[STATE][held], action=good.arrays[ACTION][held], touch=good.arrays[TOUCH][held]
    )
    assert serious(dataclasses.replace(episode, picture_keys=())) == []


def test_contact_over_the_whole_pad_gives_nothing(good: Episode) -> None:
    _, _, touch = copies(good)
    strength = touch.max(axis=(2, 3), keepdims=True) * (touch.max(axis=(2, 3), keepdims=True) > 15)
    noise = np.random.default_rng(0).normal(0, 1.5, touch.shape).round()
    row = np.linspace(0.6, 1.0, 32)[:, None]  # firmer at the tip
    assert serious(with_arrays(good, touch=flat((strength * row + noise).astype(np.int16)))) == []


def test_soft_part_felt_while_the_gripper_still_closes_gives_nothing() -> None:
    """A sponge gives: the state creeps on for half a second after the first contact."""
    episode = make(seed=11)
    state, _, _ = copies(episode)
    for arm in GRIPPER:
        for hold in grip_checks.read_grippers(episode).holds[arm]:  # type: ignore[union-attr]
            rows = np.arange(hold.first, hold.end)
            state[rows, GRIPPER[arm]] += 0.0008 * np.exp(-(rows - hold.first) / 15)
    assert [f for f in serious(with_arrays(episode, state=state)) if f.check == "touch_lag"] == []


def test_episode_without_baselines_is_judged_but_for_saturation(good: Episode) -> None:
    findings = check_episode(dataclasses.replace(good, baselines={}), pictures=False)
    assert {f.severity for f in findings} == {"note"}
    assert any("saturation not judged" in f.text for f in findings)


def test_window_feature_is_judged_by_its_newest_reading(good: Episode) -> None:
    history = 3
    feature = dataclasses.replace(SPEC.features[TOUCH], shape=(history * 1536,), history=history)
    spec = dataclasses.replace(SPEC, features=SPEC.features | {TOUCH: feature})
    older = np.zeros((good.num_rows, 2 * 1536), np.int16)
    episode = dataclasses.replace(
        with_arrays(good, touch=np.concatenate([older, good.arrays[TOUCH]], axis=1)), spec=spec
    )
    assert one(episode, "contact_coverage").text == one(good, "contact_coverage").text
    assert serious(episode) == []


# ---- measures ----


def test_constant_runs_count_rows_and_keep_the_value() -> None:
    counts = np.array([[1, 1, 1, 2, 2, 3], [0, 1, 0, 1, 0, 1], [7, 7, 7, 7, 7, 7]]).T
    length, value = touch_checks.constant_runs(counts)
    assert length.tolist() == [3, 1, 6]
    assert value.tolist() == [1, 0, 7]


def test_enclosed_taxels_ought_to_show_the_lesser_neighbour() -> None:
    frame = np.zeros((1, 5, 7))
    frame[0, 2, [1, 3]] = 50, 80  # one taxel between
    frame[0, 4, [2, 5]] = 60, 40  # two taxels between
    frame[0, 0, [0, 4]] = 90, 90  # three taxels between: may be a hollow of the part
    expected = touch_checks.inside_contact(frame)[0]
    assert expected[2].tolist() == [0, 0, 50, 0, 0, 0, 0]
    assert expected[4].tolist() == [0, 0, 0, 40, 40, 0, 0]
    assert expected[0].max() == 0


def test_inner_corner_of_an_l_shaped_contact_is_not_enclosed() -> None:
    frame = np.zeros((1, 6, 6))
    frame[0, 1:5, 1], frame[0, 4, 1:5] = 80, 80
    assert touch_checks.inside_contact(frame)[0, 3, 2] == 0


def test_holds_are_where_the_command_passes_a_stalled_state() -> None:
    time_s = np.arange(240) / FPS
    command = np.interp(time_s, [0, 2, 2.5, 6, 6.5, 8], [0.065, 0.065, 0.015, 0.015, 0.065, 0.065])
    state = np.maximum(np.interp(time_s - 0.08, time_s, command), 0.025)  # part of 25 mm, met at 2.08 + 0.4 s
    (hold,) = grip_checks.find_holds(state, command, FPS)
    # 1 mm before the part at 100 mm/s is 10 ms earlier.
    assert hold.stop_s == pytest.approx(2.47, abs=0.02)
    assert hold.first / FPS == pytest.approx(2.5, abs=0.1)
    assert hold.end / FPS == pytest.approx(6.1, abs=0.1)
    assert grip_checks.find_holds(state, state, FPS) == []


def test_hold_from_the_first_row_has_no_stop() -> None:
    (hold,) = grip_checks.find_holds(np.full(90, 0.02), np.full(90, 0.01), FPS)
    assert (hold.first, hold.end, hold.stop_s) == (0, 90, None)


# ---- taxels ----


@pytest.mark.parametrize("value", [0, 20])
@pytest.mark.parametrize("p", range(4))
def test_dead_taxel_in_a_contact_is_found(good: Episode, p: int, value: int) -> None:
    r, c = deepest(good, p)
    counts = on_wire(good)
    counts[:, p, r, c] = value
    finding = one(rebased(good, counts), "dead_taxel")
    assert finding.severity == "warning"
    assert finding.text.startswith(PADS[p])
    assert f"1 taxel (row, column): ({r}, {c}):" in finding.text


def test_dead_taxel_that_still_shows_noise_is_found_by_its_neighbours(good: Episode) -> None:
    _, _, touch = copies(good)
    r, c = deepest(good, RIGHT_A)
    touch[:, RIGHT_A, r, c] = np.random.default_rng(0).normal(0, 1.5, len(touch)).round()
    assert f"({r}, {c})" in one(with_arrays(good, touch=flat(touch)), "dead_taxel").text


def test_dead_column_is_named_as_one() -> None:
    episode = make(seed=100)
    _, _, touch = copies(episode)
    touch[:, LEFT_A, :, 4] = 0
    assert "32 taxels (row, column): column 4:" in one(with_arrays(episode, touch=flat(touch)), "dead_taxel").text


def test_weak_taxel_is_not_dead(good: Episode) -> None:
    _, _, touch = copies(good)
    r, c = deepest(good, RIGHT_A)
    touch[:, RIGHT_A, r, c] //= 3
    assert found(with_arrays(good, touch=flat(touch)), "dead_taxel") == []


def test_untouched_taxels_are_not_called_dead(good: Episode) -> None:
    """Noise too small for the wire: untouched taxels never change, which says nothing."""
    _, _, touch = copies(good)
    touch[np.abs(touch) < 12] = 0
    assert serious(with_arrays(good, touch=flat(touch))) == []


def test_hollow_of_a_part_is_not_dead(good: Episode) -> None:
    """A ring with a hole of three taxels."""
    _, _, touch = copies(good)
    r, c = 16, 6
    touch[:, LEFT_A] = np.where(np.arange(good.num_rows)[:, None, None] % 360 > 150, 60, 0)
    touch[:, LEFT_A, r - 1 : r + 2, c - 1 : c + 2] = 0
    touch[:, LEFT_A] += np.random.default_rng(0).normal(0, 1.5, touch[:, LEFT_A].shape).round().astype(np.int16)
    text = " ".join(f.text for f in found(with_arrays(good, touch=flat(touch)), "dead_taxel"))
    assert f"({r}, {c})" not in text


@pytest.mark.parametrize("value", [60, 120, 200])
def test_taxel_stuck_from_the_start_is_found_although_the_baseline_hides_it(good: Episode, value: int) -> None:
    counts = on_wire(good)
    counts[:, LEFT_B, 20, 3] = value
    episode = rebased(good, counts)
    assert (episode.arrays[TOUCH].reshape(-1, 4, 32, 12)[:, LEFT_B, 20, 3] == 0).all()
    finding = one(episode, "stuck_taxel")
    assert finding.severity == "warning"
    assert f"left_b: stuck at {value} counts on the wire, 1 taxel (row, column): (20, 3)" in finding.text
    assert found(episode, "dead_taxel") == []


def test_taxel_that_sticks_later_is_found(good: Episode) -> None:
    _, _, touch = copies(good)
    touch[200:, RIGHT_B, 5, 5] = 90
    assert "(5, 5)" in one(with_arrays(good, touch=flat(touch)), "stuck_taxel").text


def test_taxel_that_reads_touch_at_all_times_is_stuck_even_with_noise(good: Episode) -> None:
    _, _, touch = copies(good)
    for r, c in ((2, 2), (30, 9)):
        touch[:, RIGHT_B, r, c] = 60 + np.random.default_rng(r).normal(0, 2, len(touch)).round()
    assert "2 taxels (row, column): (2, 2), (30, 9)" in one(with_arrays(good, touch=flat(touch)), "stuck_taxel").text


def test_stuck_taxel_is_no_contact(good: Episode) -> None:
    _, _, touch = copies(good)
    before = pad(good, "right_b").contact
    touch[:, RIGHT_B, 5, 5] = 200
    after = pad(with_arrays(good, touch=flat(touch)), "right_b").contact
    assert (before != after).mean() < 0.02


def test_taxel_always_at_the_maximum_is_saturated(good: Episode) -> None:
    counts = on_wire(good)
    counts[:, RIGHT_A, 8, 8] = 255
    finding = one(rebased(good, counts), "saturated")
    assert finding.severity == "warning"
    assert "right_a: always at the wire's maximum (255 counts), 1 taxel (row, column): (8, 8)" in finding.text


@pytest.mark.parametrize(("factor", "severity"), [(1.0, None), (4.0, "warning")])
def test_contact_beyond_the_wire_is_saturated(good: Episode, factor: float, severity: str | None) -> None:
    baseline = good.baselines[TOUCH]
    touch = np.minimum(good.arrays[TOUCH] * factor, 255 - baseline).astype(np.int16)
    findings = found(with_arrays(good, touch=touch), "saturated")
    assert {f.severity for f in findings} == ({severity} if severity else set())
    if severity:
        assert len(findings) == 4
        assert all(f.rows is not None and f.rows[0] > 80 for f in findings)


def test_a_few_saturated_rows_are_a_note(good: Episode) -> None:
    counts = on_wire(good)
    r, c = deepest(good, LEFT_A)
    counts[200:203, LEFT_A, r, c] = 255
    finding = one(wire(good, counts), "saturated")
    assert (finding.severity, finding.rows) == ("note", (200, 203))


@pytest.mark.parametrize(("std", "is_found"), [(2.0, False), (4.5, False), (5.5, True), (12.0, True)])
def test_noise_above_a_third_of_the_sensors_noise_count_is_found(std: float, is_found: bool) -> None:
    episode = make(seed=8, noise_count=std)  # noise_count 15: 5 counts
    assert {f.text.split(":")[0] for f in found(episode, "noisy_pad")} == (set(PADS) if is_found else set())


def test_frames_that_repeat_are_found(good: Episode) -> None:
    _, _, touch = copies(good)
    touch[60:100, LEFT_B] = touch[60, LEFT_B]
    finding = one(with_arrays(good, touch=flat(touch)), "frozen_touch")
    assert (finding.severity, finding.rows) == ("warning", (60, 100))
    assert finding.text.startswith("left_b")


def test_frozen_frames_in_a_contact_are_not_stuck_taxels(good: Episode) -> None:
    _, _, touch = copies(good)
    touch[170:260, RIGHT_A] = touch[170, RIGHT_A]
    checks = {f.check for f in serious(with_arrays(good, touch=flat(touch)))}
    assert "frozen_touch" in checks
    assert "stuck_taxel" not in checks


# ---- drift ----


@pytest.mark.parametrize("rate", [-1.0, -0.4, 0.0, 0.4, 1.0])
def test_drift_is_found_above_five_counts_an_episode(rate: float) -> None:
    # The left gripper rests open from 0 to 3 s and from 11.2 s on, the right one from 9.5 s on: 10 and 9 s between.
    findings = found(make(seed=12, drift_count_per_s=rate), "baseline_drift")
    if abs(rate) < 0.5:
        assert findings == []
    else:
        assert f"{rate:+.2f} counts/s" in findings[0].text or f"{rate * 1.01:+.2f} counts/s" in findings[0].text
        assert all(name in findings[0].text for name in PADS)


def test_residue_of_the_film_is_not_drift(good: Episode) -> None:
    """Touched taxels keep 8 counts after the release; the untouched half of the pad says that nothing drifted."""
    _, _, touch = copies(good)
    touched = (touch > 30).any(axis=0)
    touch[330:] += (8 * touched).astype(np.int16)
    assert found(with_arrays(good, touch=flat(touch)), "baseline_drift") == []


def test_baseline_taken_while_touched_is_found(good: Episode) -> None:
    _, _, touch = copies(good)
    pressed = touch[200, LEFT_A]
    touch[:, LEFT_A] -= pressed
    finding = one(with_arrays(good, touch=flat(touch)), "baseline_offset")
    assert finding.severity == "warning"
    assert "left_a" in finding.text
    assert "touched while the baseline" in finding.text


@pytest.mark.parametrize(("step", "is_found"), [(1.5, False), (4.0, True)])
def test_drift_between_episodes_is_found(step: float, is_found: bool) -> None:
    episodes = []
    for k in range(3):
        episode = make(seed=k, duration_s=8.0)
        touch = episode.arrays[TOUCH] + np.int16(round(k * step))  # 3 or 8 counts from the first to the last
        episodes.append(with_arrays(episode, touch=touch))
    findings = [f for f in check_recording_episodes(episodes) if f.check == "baseline_drift"]
    assert bool(findings) == is_found
    if is_found:
        assert "synthetic 0" in findings[0].text
        assert "synthetic 2" in findings[0].text


# ---- touch against grippers ----


def reorder(episode: Episode, order: list[int]) -> Episode:
    _, _, touch = copies(episode)
    touch = touch[:, order]
    baseline = episode.baselines[TOUCH].reshape(4, -1)[order].reshape(-1)
    return dataclasses.replace(with_arrays(episode, touch=flat(touch)), baselines={TOUCH: baseline})


@pytest.mark.parametrize(
    ("order", "named"),
    [
        ([RIGHT_A, RIGHT_B, LEFT_A, LEFT_B], set(PADS)),
        ([RIGHT_A, LEFT_B, LEFT_A, RIGHT_B], {"left_a", "right_a"}),
        ([LEFT_A, RIGHT_A, LEFT_B, RIGHT_B], {"left_b", "right_a"}),
    ],
)
def test_pads_of_the_other_arm_are_an_error(good: Episode, order: list[int], named: set[str]) -> None:
    finding = one(reorder(good, order), "swapped_pads")
    assert finding.severity == "error"
    assert {name for name in PADS if name in finding.text} == named


def test_pads_of_one_gripper_exchanged_cannot_be_seen_and_are_not_guessed_at(good: Episode) -> None:
    assert serious(reorder(good, [LEFT_B, LEFT_A, RIGHT_A, RIGHT_B])) == []


def test_swap_is_seen_when_one_arm_alone_holds(good: Episode) -> None:
    episode = make(seed=13, part_m={"left": 0.0, "right": 0.02})
    assert serious(episode) == []
    assert one(reorder(episode, [RIGHT_A, RIGHT_B, LEFT_A, LEFT_B]), "swapped_pads").severity == "error"


def test_exchanged_arms_show_as_exchanged_pads(good: Episode) -> None:
    """State and command both from the other arm: only touch can tell."""
    state, action, _ = copies(good)
    episode = with_arrays(good, state=np.roll(state, 7, axis=1), action=np.roll(action, 7, axis=1))
    assert one(episode, "swapped_pads").severity == "error"


def test_grippers_that_hold_together_cannot_tell_pads_apart(good: Episode) -> None:
    state, action, touch = copies(good)
    state[:, GRIPPER["left"]], action[:, GRIPPER["left"]] = state[:, GRIPPER["right"]], action[:, GRIPPER["right"]]
    touch[:, :2] = touch[:, 2:]
    episode = with_arrays(good, state=state, action=action, touch=flat(touch))
    assert serious(episode) == []
    assert any("swapped pads" in f.text for f in found(episode, "not_judged"))


@pytest.mark.parametrize("std", [0.0, 1.5, 8.0, 25.0])
def test_touch_that_is_only_noise_is_an_error(good: Episode, std: float) -> None:
    noise = np.random.default_rng(0).normal(0, std, good.arrays[TOUCH].shape).round().astype(np.int16)
    finding = one(with_arrays(good, touch=noise), "noise_only")
    assert finding.severity == "error"


@pytest.mark.parametrize("p", range(4))
def test_unplugged_pad_is_found(good: Episode, p: int) -> None:
    _, _, touch = copies(good)
    touch[:, p] = np.random.default_rng(p).normal(0, 1.3, touch[:, p].shape).round()
    finding = one(with_arrays(good, touch=flat(touch)), "silent_pad")
    assert finding.severity == "warning"
    assert [name for name in PADS if name in finding.text] == [PADS[p]]


@pytest.mark.parametrize(
    ("clock_s", "is_found"), [(0.0, False), (0.05, False), (0.25, True), (0.6, True), (-0.25, True)]
)
def test_touch_on_another_clock_is_found(clock_s: float, is_found: bool) -> None:
    episode = make(seed=14, touch_clock_s=dict.fromkeys(PADS, clock_s))
    findings = found(episode, "touch_lag")
    assert bool(findings) == is_found
    if is_found:
        assert findings[0].severity == "warning"
        assert all(name in findings[0].text for name in PADS)
        assert ("after" if clock_s > 0 else "before") in findings[0].text


@pytest.mark.parametrize("late", [0.03, 0.2, 0.4])
def test_one_pad_on_another_clock_is_named(late: float) -> None:
    episode = make(seed=15, touch_clock_s={"right_b": late})
    findings = found(episode, "pad_lag")
    assert bool(findings) == (late > 0.1)
    if findings:
        assert findings[0].text.startswith("right_b feels everything 0.")


def test_lag_of_a_whole_recording_is_judged_without_a_rows_slack() -> None:
    # 0.13 s and 20 to 50 ms of grip building up: inside the window of one episode (0.15 s + 1 row), not of all together.
    late = [make(seed=s, duration_s=8.0, touch_delay_s=0.13) for s in range(4)]
    assert all(found(e, "touch_lag") == [] for e in late)
    assert [f.check for f in check_recording_episodes(late)] == ["touch_lag"]


def test_wrong_joints_leave_touch_against_grippers_unjudged(good: Episode) -> None:
    state, _, _ = copies(good)
    state[:, GRIPPER["left"]] *= 1000
    findings = check_episode(with_arrays(good, state=state), pictures=False)
    assert not any(f.check in ("touch_lag", "swapped_pads", "noise_only") for f in findings)
    assert any(f.check == "not_judged" and "touch against grippers" in f.text for f in findings)


# ---- how often faults are found ----


def _dead(seed: int) -> Episode:
    episode = base(seed)
    counts = on_wire(episode)
    r, c = deepest(episode, RIGHT_A)
    counts[:, RIGHT_A, r, c] = 0
    return rebased(episode, counts)


def _stuck(seed: int) -> Episode:
    episode = base(seed)
    counts = on_wire(episode)
    r, c = np.random.default_rng(seed).integers(0, (32, 12))
    counts[:, LEFT_B, r, c] = 60 + 4 * seed
    return rebased(episode, counts)


def _noise_only(seed: int) -> Episode:
    episode = base(seed)
    std = np.random.default_rng(seed).uniform(0.5, 20)
    touch = np.random.default_rng(seed).normal(0, std, episode.arrays[TOUCH].shape).round().astype(np.int16)
    return with_arrays(episode, touch=touch)


FAULTS: dict[str, tuple[str, Callable[[int], Episode]]] = {
    "taxel dead": ("dead_taxel", _dead),
    "taxel stuck": ("stuck_taxel", _stuck),
    "saturated": ("saturated", lambda s: wire(base(s), np.minimum(on_wire(base(s)) * 4, 255))),
    "arms swapped": ("swapped_pads", lambda s: reorder(base(s), [RIGHT_A, RIGHT_B, LEFT_A, LEFT_B])),
    "one pad swapped": ("swapped_pads", lambda s: reorder(base(s), [RIGHT_A, LEFT_B, LEFT_A, RIGHT_B])),
    "noise only": ("noise_only", _noise_only),
    "touch late": ("touch_lag", lambda s: make(seed=s, duration_s=8.0, touch_clock_s=dict.fromkeys(PADS, 0.3))),
    "touch early": ("touch_lag", lambda s: make(seed=s, duration_s=8.0, touch_clock_s=dict.fromkeys(PADS, -0.3))),
    "one pad late": ("pad_lag", lambda s: make(seed=s, duration_s=8.0, touch_clock_s={"left_a": 0.25})),
    "drift": ("baseline_drift", lambda s: make(seed=s, duration_s=8.0, drift_count_per_s=1.0)),
    "noisy": ("noisy_pad", lambda s: make(seed=s, duration_s=8.0, noise_count=7.0)),
}


@pytest.mark.parametrize("name", FAULTS)
@pytest.mark.parametrize("num_episodes", [FEW_SEEDS, pytest.param(NUM_SEEDS, marks=pytest.mark.slow)])
def test_fault_is_found_in_at_least_95_per_cent_of_random_episodes(name: str, num_episodes: int) -> None:
    check, fault = FAULTS[name]
    hits = sum(any(f.severity != "note" for f in found(fault(seed), check)) for seed in range(num_episodes))
    assert hits >= 0.95 * num_episodes, f"{hits} of {num_episodes}"

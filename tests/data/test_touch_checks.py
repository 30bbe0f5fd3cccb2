"""Planted faults of pads are found on the planted taxels and pads; touch that is merely unusual is left in peace."""

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
from synthetic_episode import (
    ACTION,
    GRIPPER,
    PADS,
    SPEC,
    STATE,
    TOUCH,
    base,
    copies,
    found,
    make,
    one,
    serious,
    with_arrays,
)

from taccorl.data import grip_checks, touch_checks
from taccorl.data.checks import check_episode, check_recording_episodes
from taccorl.data.episode import Episode
from taccorl.data.finding import Finding

FPS = SPEC.fps
NUM_SEEDS = 30
FEW_SEEDS = 2
SEEDS = (100, *range(5))
LEFT_A, LEFT_B, RIGHT_A, RIGHT_B = range(4)
Change = Callable[[np.ndarray], object]  # Modifies (T, 4, 32, 12) counts in place


def flat(touch: np.ndarray) -> np.ndarray:
    return touch.reshape(len(touch), -1)


def serious_of(episode: Episode) -> list[Finding]:
    return serious(check_episode(episode, pictures=False))


def pad(episode: Episode, name: str) -> touch_checks.Pad:
    return next(p for p in touch_checks.read_pads(episode, TOUCH) if p.name == name)


def touched(episode: Episode, change: Change) -> Episode:
    """``episode`` after ``change`` has altered its counts above baseline, (T, pads, rows, columns), in place."""
    _, _, touch = copies(episode)
    change(touch)
    return with_arrays(episode, touch=flat(touch))


def on_wire(episode: Episode) -> np.ndarray:
    """(T, 4, 32, 12) counts as they came over the wire."""
    return (episode.arrays[TOUCH] + episode.baselines[TOUCH]).reshape(-1, 4, 32, 12)


def rewired(episode: Episode, change: Change) -> Episode:
    """The episode with its counts on the wire changed and the baseline that ingest would take: the median of 30 frames."""
    counts = flat(on_wire(episode))
    change(counts.reshape(-1, 4, 32, 12))
    baseline = np.round(np.median(counts[:30], axis=0)).astype(np.int64)
    touch = (counts - baseline).astype(np.int16)
    return dataclasses.replace(
        with_arrays(episode, touch=touch), baselines={TOUCH: baseline}
    )


def put(where: tuple, value: object) -> Change:
    return lambda touch: touch.__setitem__(where, value)


def noise(where: tuple, std: float, mean: float = 0.0) -> Change:
    def change(touch: np.ndarray) -> None:
        touch[where] = (
            np.random.default_rng(0).normal(mean, std, touch[where].shape).round()
        )

    return change


def repeat(first: int, end: int, p: int) -> Change:
    return lambda touch: np.copyto(touch[first:end, p], touch[first, p].copy())


def reorder(episode: Episode, order: list[int]) -> Episode:
    baseline = episode.baselines[TOUCH].reshape(4, -1)[order].reshape(-1)
    swapped = touched(episode, lambda touch: np.copyto(touch, touch[:, order]))
    return dataclasses.replace(swapped, baselines={TOUCH: baseline})


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


def _one_arm(episode: Episode) -> Episode:
    state, action, _ = copies(episode)
    state[:, 7:], action[:, 7:] = state[0, 7:], action[0, 7:]
    return touched(
        with_arrays(episode, state=state, action=action), noise(np.s_[:, 2:], 1.3)
    )


def _whole_pads(touch: np.ndarray) -> None:
    strength = touch.max(axis=(2, 3), keepdims=True) * (
        touch.max(axis=(2, 3), keepdims=True) > 15
    )
    firmer_at_the_tip = np.linspace(0.6, 1.0, 32)[:, None]
    touch[:] = (
        strength * firmer_at_the_tip
        + np.random.default_rng(0).normal(0, 1.5, touch.shape).round()
    )


def _hold_together(episode: Episode) -> Episode:
    state, action, _ = copies(episode)
    for values in (state, action):
        values[:, GRIPPER["left"]] = values[:, GRIPPER["right"]]
    return touched(
        with_arrays(episode, state=state, action=action),
        lambda t: np.copyto(t[:, :2], t[:, 2:]),
    )


def _window(episode: Episode) -> Episode:
    """Windows of three readings; the older two are zeros."""
    feature = dataclasses.replace(SPEC.features[TOUCH], shape=(3 * 1536,), history=3)
    spec = dataclasses.replace(SPEC, features=SPEC.features | {TOUCH: feature})
    touch = np.pad(episode.arrays[TOUCH], ((0, 0), (2 * 1536, 0)))
    return dataclasses.replace(with_arrays(episode, touch=touch), spec=spec)


UNUSUAL: dict[str, Callable[[Episode], Episode]] = {
    "one arm works": _one_arm,
    "contact over the whole pad": lambda e: touched(e, _whole_pads),
    "untouched taxels never change": lambda e: touched(
        e, lambda t: np.copyto(t, 0, where=np.abs(t) < 12)
    ),
    "grippers hold together": _hold_together,
    "pads of one gripper exchanged": lambda e: reorder(
        e, [LEFT_B, LEFT_A, RIGHT_A, RIGHT_B]
    ),
    "no baselines": lambda e: dataclasses.replace(e, baselines={}),
    "windows": _window,
}


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", UNUSUAL)
def test_touch_that_is_merely_unusual_gives_nothing(name: str, seed: int) -> None:
    assert serious_of(UNUSUAL[name](make(seed=seed))) == []


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(
    "changes", [{"part_m": {"left": 0.0, "right": 0.0}}, {"noise_count": 0.0}]
)
def test_grippers_that_close_on_nothing_and_twins_without_noise_give_nothing(
    changes: dict, seed: int
) -> None:
    assert serious_of(make(seed=seed, **changes)) == []


def test_part_held_from_start_to_end_gives_nothing(good: Episode) -> None:
    held = slice(170, 250)  # 5.7 to 8.3 s of 12 s: both hold
    arrays = {key: values[held] for key, values in good.arrays.items()}
    assert serious_of(dataclasses.replace(good, arrays=arrays, picture_keys=())) == []


def test_contact_coverage_is_told_and_of_windows_that_of_the_newest_reading(
    good: Episode,
) -> None:
    text = one(good, "contact_coverage").text
    for name in PADS:
        share = pad(good, name).contact.mean()
        assert 0.2 < share < 0.8 and f"{name} in {share:.0%} of the rows" in text
    assert one(_window(good), "contact_coverage").text == text


def test_soft_part_felt_while_the_gripper_still_closes_gives_nothing() -> None:
    """A sponge gives: the state creeps on for half a second after the first contact."""
    episode = make(seed=11)
    state, _, _ = copies(episode)
    for arm in GRIPPER:
        for hold in grip_checks.read_grippers(episode).holds[arm]:  # type: ignore[union-attr]
            rows = np.arange(hold.first, hold.end)
            state[rows, GRIPPER[arm]] += 0.0008 * np.exp(-(rows - hold.first) / 15)
    assert [
        f
        for f in serious_of(with_arrays(episode, state=state))
        if f.check == "touch_lag"
    ] == []


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("no baselines", "saturation could not be checked"),
        ("grippers hold together", "swapped pads"),
    ],
)
def test_what_cannot_be_judged_is_said(good: Episode, name: str, words: str) -> None:
    assert any(words in f.text for f in found(UNUSUAL[name](good), "not_judged"))


# ---- measures ----


def test_enclosed_taxels_ought_to_show_the_lesser_neighbour() -> None:
    frame = np.zeros((1, 5, 7))
    frame[0, 2, [1, 3]] = 50, 80  # one taxel between
    frame[0, 4, [2, 5]] = 60, 40  # two taxels between
    frame[0, 0, [0, 4]] = 90, 90  # three taxels between: may be a hollow of the part
    expected = touch_checks.inside_contact(frame)[0]
    assert expected[2].tolist() == [0, 0, 50, 0, 0, 0, 0] and expected[4].tolist() == [
        0,
        0,
        0,
        40,
        40,
        0,
        0,
    ]
    assert expected[0].max() == 0
    corner = np.zeros((1, 6, 6))
    corner[0, 1:5, 1], corner[0, 4, 1:5] = 80, 80
    assert touch_checks.inside_contact(corner)[0, 3, 2] == 0, (
        "the inner corner of an L is not enclosed"
    )


def test_holds_are_where_the_command_passes_a_stalled_state() -> None:
    time_s = np.arange(240) / FPS
    command = np.interp(
        time_s, [0, 2, 2.5, 6, 6.5, 8], [0.065, 0.065, 0.015, 0.015, 0.065, 0.065]
    )
    state = np.maximum(
        np.interp(time_s - 0.08, time_s, command), 0.025
    )  # part of 25 mm, met at 2.08 + 0.4 s
    (hold,) = grip_checks.find_holds(state, command, FPS)
    # 1 mm before the part at 100 mm/s is 10 ms earlier.
    assert hold.stop_s == pytest.approx(2.47, abs=0.02)
    assert hold.first / FPS == pytest.approx(2.5, abs=0.1)
    assert hold.end / FPS == pytest.approx(6.1, abs=0.1)
    assert grip_checks.find_holds(state, state, FPS) == []
    (hold,) = grip_checks.find_holds(np.full(90, 0.02), np.full(90, 0.01), FPS)
    assert (hold.first, hold.end, hold.stop_s) == (0, 90, None), (
        "a hold from the first row has no stop"
    )


# ---- taxels ----


@pytest.mark.parametrize("value", [0, 20, None])
@pytest.mark.parametrize("p", range(4))
def test_dead_taxel_in_a_contact_is_found(
    good: Episode, p: int, value: int | None
) -> None:
    """Also one that still shows noise (None): its neighbours feel the part."""
    r, c = deepest(good, p)
    where = np.s_[:, p, r, c]
    finding = one(
        touched(good, noise(where, 1.5))
        if value is None
        else rewired(good, put(where, value)),
        "dead_taxel",
    )
    assert finding.severity == "warning"
    assert finding.text.startswith(PADS[p])
    assert f"1 taxel (row, column): ({r}, {c}):" in finding.text


@pytest.mark.parametrize("value", [60, 120, 200])
def test_taxel_stuck_from_the_start_is_found_although_the_baseline_hides_it(
    good: Episode, value: int
) -> None:
    episode = rewired(good, put(np.s_[:, LEFT_B, 20, 3], value))
    assert (episode.arrays[TOUCH].reshape(-1, 4, 32, 12)[:, LEFT_B, 20, 3] == 0).all()
    [finding] = serious_of(episode)
    assert (finding.check, finding.severity) == ("stuck_taxel", "warning")
    assert (
        f"left_b: stuck at {value} counts on the wire, 1 taxel (row, column): (20, 3)"
        in finding.text
    )


def _constantly_touched(touch: np.ndarray) -> None:
    for r, c in ((2, 2), (30, 9)):
        noise(np.s_[:, RIGHT_B, r, c], 2, mean=60)(touch)


PLANTED: dict[str, tuple[Callable[[Episode], Episode], str, tuple[int, int] | None, str]] = {
    "dead column": (
        lambda e: touched(e, put(np.s_[:, LEFT_A, :, 4], 0)),
        "dead_taxel", None, "32 taxels (row, column): column 4:",
    ),
    "a taxel sticks later": (lambda e: touched(e, put(np.s_[200:, RIGHT_B, 5, 5], 90)), "stuck_taxel", None, "(5, 5)"),
    "two taxels always touched": (
        lambda e: touched(e, _constantly_touched),
        "stuck_taxel", None, "2 taxels (row, column): (2, 2), (30, 9)",
    ),
    "a taxel at the maximum": (
        lambda e: rewired(e, put(np.s_[:, RIGHT_A, 8, 8], 255)),
        "saturated", None, "right_a: always at the wire's maximum (255 counts), 1 taxel (row, column): (8, 8)",
    ),
    "frames repeat": (lambda e: touched(e, repeat(60, 100, LEFT_B)), "frozen_touch", (60, 100), "left_b"),
    "frames repeat in a contact": (lambda e: touched(e, repeat(170, 260, RIGHT_A)), "frozen_touch", (170, 260), "right_a"),
    "baseline taken while touched": (
        lambda e: touched(e, lambda t: np.subtract(t, t[200], out=t, where=np.arange(4)[:, None, None] == LEFT_A)),
        "baseline_offset", None, "touched while the baseline",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", PLANTED)
def test_a_planted_fault_is_the_only_thing_found(good: Episode, name: str) -> None:
    plant, check, rows, words = PLANTED[name]
    [finding] = serious_of(plant(good))
    assert (finding.check, finding.severity) == (check, "warning")
    assert rows is None or finding.rows == rows
    assert words in finding.text


def _weak(episode: Episode) -> Episode:
    r, c = deepest(episode, RIGHT_A)
    return touched(
        episode,
        lambda touch: touch.__setitem__(
            np.s_[:, RIGHT_A, r, c], touch[:, RIGHT_A, r, c] // 3
        ),
    )


def _ring(touch: np.ndarray) -> None:
    """With a hole of three taxels."""
    touch[:, LEFT_A] = np.where(np.arange(len(touch))[:, None, None] % 360 > 150, 60, 0)
    touch[:, LEFT_A, 15:18, 5:8] = 0
    touch[:, LEFT_A] += (
        np.random.default_rng(0)
        .normal(0, 1.5, touch[:, LEFT_A].shape)
        .round()
        .astype(np.int16)
    )


def _residue(touch: np.ndarray) -> None:
    """Touched taxels keep 8 counts after the release; the untouched half of the pad says that nothing drifted."""
    touch[330:] += (8 * (touch > 30).any(axis=0)).astype(np.int16)


@pytest.mark.parametrize(
    ("plant", "check", "words"),
    [
        (_weak, "dead_taxel", ""),
        (lambda e: touched(e, _ring), "dead_taxel", "(16, 6)"),
        (lambda e: touched(e, _residue), "baseline_drift", ""),
    ],
)
def test_what_resembles_a_fault_is_none(
    good: Episode, plant: Callable, check: str, words: str
) -> None:
    assert not [f for f in found(plant(good), check) if words in f.text]


def test_stuck_taxel_is_no_contact(good: Episode) -> None:
    before = pad(good, "right_b").contact
    after = pad(touched(good, put(np.s_[:, RIGHT_B, 5, 5], 200)), "right_b").contact
    assert (before != after).mean() < 0.02


@pytest.mark.parametrize(("factor", "severity"), [(1.0, None), (4.0, "warning")])
def test_contact_beyond_the_wire_is_saturated(
    good: Episode, factor: float, severity: str | None
) -> None:
    baseline = good.baselines[TOUCH]
    touch = np.minimum(good.arrays[TOUCH] * factor, 255 - baseline).astype(np.int16)
    findings = found(with_arrays(good, touch=touch), "saturated")
    assert [f.severity for f in findings] == [severity] * (4 if severity else 0)
    assert all(f.rows is not None and f.rows[0] > 80 for f in findings)


def test_a_few_saturated_rows_are_a_note(good: Episode) -> None:
    where = np.s_[200:203, LEFT_A, *deepest(good, LEFT_A)]
    finding = one(rewired(good, put(where, 255)), "saturated")
    assert (finding.severity, finding.rows) == ("note", (200, 203))


@pytest.mark.parametrize(
    ("std", "is_found"), [(2.0, False), (4.5, False), (5.5, True), (12.0, True)]
)
def test_noise_above_a_third_of_the_sensors_noise_count_is_found(
    std: float, is_found: bool
) -> None:
    episode = make(seed=8, noise_count=std)  # noise_count 15: 5 counts
    assert {f.text.split(":")[0] for f in found(episode, "noisy_pad")} == (
        set(PADS) if is_found else set()
    )


# ---- drift ----


@pytest.mark.parametrize("rate", [-1.0, -0.4, 0.0, 0.4, 1.0])
def test_drift_is_found_above_five_counts_an_episode(rate: float) -> None:
    # The left gripper rests open from 0 to 3 s and from 11.2 s on, the right one from 9.5 s on: 10 and 9 s between.
    findings = found(make(seed=12, drift_count_per_s=rate), "baseline_drift")
    if abs(rate) < 0.5:
        assert findings == []
    else:
        assert (
            f"{rate:+.2f} counts/s" in findings[0].text
            or f"{rate * 1.01:+.2f} counts/s" in findings[0].text
        )
        assert all(name in findings[0].text for name in PADS)


@pytest.mark.parametrize(("step", "is_found"), [(1.5, False), (4.0, True)])
def test_drift_between_episodes_is_found(step: float, is_found: bool) -> None:
    episodes = [
        make(seed=k, duration_s=8.0) for k in range(3)
    ]  # 3 or 8 counts from the first to the last
    episodes = [
        with_arrays(e, touch=e.arrays[TOUCH] + np.int16(round(k * step)))
        for k, e in enumerate(episodes)
    ]
    texts = [
        f.text
        for f in check_recording_episodes(episodes)
        if f.check == "baseline_drift"
    ]
    assert bool(texts) == is_found
    assert all("synthetic 0" in text and "synthetic 2" in text for text in texts)


# ---- touch against grippers ----


@pytest.mark.parametrize(
    ("order", "named"),
    [
        ([RIGHT_A, RIGHT_B, LEFT_A, LEFT_B], set(PADS)),
        ([RIGHT_A, LEFT_B, LEFT_A, RIGHT_B], {"left_a", "right_a"}),
        ([LEFT_A, RIGHT_A, LEFT_B, RIGHT_B], {"left_b", "right_a"}),
    ],
)
def test_pads_of_the_other_arm_are_an_error(
    good: Episode, order: list[int], named: set[str]
) -> None:
    finding = one(reorder(good, order), "swapped_pads")
    assert finding.severity == "error"
    assert {name for name in PADS if name in finding.text} == named


def test_swap_is_seen_when_one_arm_alone_holds() -> None:
    episode = make(seed=13, part_m={"left": 0.0, "right": 0.02})
    assert serious_of(episode) == []
    assert (
        one(
            reorder(episode, [RIGHT_A, RIGHT_B, LEFT_A, LEFT_B]), "swapped_pads"
        ).severity
        == "error"
    )


def test_exchanged_arms_show_as_exchanged_pads(good: Episode) -> None:
    """State and command both from the other arm: only touch can tell."""
    state, action, _ = copies(good)
    episode = with_arrays(
        good, state=np.roll(state, 7, axis=1), action=np.roll(action, 7, axis=1)
    )
    assert one(episode, "swapped_pads").severity == "error"


@pytest.mark.parametrize("p", range(4))
def test_unplugged_pad_is_found(good: Episode, p: int) -> None:
    finding = one(touched(good, noise(np.s_[:, p], 1.3)), "silent_pad")
    assert finding.severity == "warning"
    assert [name for name in PADS if name in finding.text] == [PADS[p]]


@pytest.mark.parametrize(
    ("clock_s", "is_found"),
    [(0, False), (0.05, False), (0.25, True), (0.6, True), (-0.25, True)],
)
def test_touch_on_another_clock_is_found(clock_s: float, is_found: bool) -> None:
    findings = found(
        make(seed=14, touch_clock_s=dict.fromkeys(PADS, clock_s)), "touch_lag"
    )
    assert bool(findings) == is_found
    for finding in findings:
        assert finding.severity == "warning"
        assert all(name in finding.text for name in PADS)
        assert ("after" if clock_s > 0 else "before") in finding.text


@pytest.mark.parametrize("late", [0.03, 0.2, 0.4])
def test_one_pad_on_another_clock_is_named(late: float) -> None:
    findings = found(make(seed=15, touch_clock_s={"right_b": late}), "pad_lag")
    assert [f.text.startswith("right_b feels everything 0.") for f in findings] == [
        True
    ] * (late > 0.1)


def test_short_stretches_of_presses_show_no_pad_late() -> None:
    for seed in (22, 24, 26):
        arrays = make(seed=seed).arrays
        for first in range(124, 249, 31):
            state, action, touch = (
                arrays[key][first : first + 63] for key in (STATE, ACTION, TOUCH)
            )
            assert not found(
                with_arrays(make(seed=seed), state=state, action=action, touch=touch),
                "pad_lag",
            )


def test_lag_of_a_whole_recording_is_judged_without_a_rows_slack() -> None:
    # 0.13 s and 20 to 50 ms of grip building up: inside the window of one episode (0.15 s + 1 row), not of all together.
    late = [make(seed=s, duration_s=8.0, touch_delay_s=0.13) for s in range(4)]
    assert all(found(e, "touch_lag") == [] for e in late)
    assert [f.check for f in check_recording_episodes(late)] == ["touch_lag"]


def test_wrong_joints_leave_touch_against_grippers_unjudged(good: Episode) -> None:
    state, _, _ = copies(good)
    state[:, GRIPPER["left"]] *= 1000
    findings = check_episode(with_arrays(good, state=state), pictures=False)
    assert not any(
        f.check in ("touch_lag", "swapped_pads", "noise_only") for f in findings
    )
    assert any(
        f.check == "not_judged" and "touch against grippers" in f.text for f in findings
    )


# ---- how often faults are found ----


def _stuck(seed: int) -> Episode:
    r, c = np.random.default_rng(seed).integers(0, (32, 12))
    return rewired(base(seed), put(np.s_[:, LEFT_B, r, c], 60 + 4 * seed))


def _saturated(seed: int) -> Episode:
    touch = np.minimum(on_wire(base(seed)) * 4, 255).reshape(base(seed).num_rows, -1)
    return with_arrays(
        base(seed), touch=touch - base(seed).baselines[TOUCH].astype(np.int16)
    )


FAULTS: dict[str, tuple[str, Callable[[int], Episode]]] = {
    "taxel dead": (
        "dead_taxel",
        lambda s: rewired(
            base(s), put(np.s_[:, RIGHT_A, *deepest(base(s), RIGHT_A)], 0)
        ),
    ),
    "taxel stuck": ("stuck_taxel", _stuck),
    "saturated": ("saturated", _saturated),
    "arms swapped": (
        "swapped_pads",
        lambda s: reorder(base(s), [RIGHT_A, RIGHT_B, LEFT_A, LEFT_B]),
    ),
    "one pad swapped": (
        "swapped_pads",
        lambda s: reorder(base(s), [RIGHT_A, LEFT_B, LEFT_A, RIGHT_B]),
    ),
    "noise only": (
        "noise_only",
        lambda s: touched(
            base(s), noise(np.s_[:], np.random.default_rng(s).uniform(0.5, 20))
        ),
    ),
    "touch late": (
        "touch_lag",
        lambda s: make(seed=s, duration_s=8.0, touch_clock_s=dict.fromkeys(PADS, 0.3)),
    ),
    "touch early": (
        "touch_lag",
        lambda s: make(seed=s, duration_s=8.0, touch_clock_s=dict.fromkeys(PADS, -0.3)),
    ),
    "one pad late": (
        "pad_lag",
        lambda s: make(seed=s, duration_s=8.0, touch_clock_s={"left_a": 0.25}),
    ),
    "drift": (
        "baseline_drift",
        lambda s: make(seed=s, duration_s=8.0, drift_count_per_s=1.0),
    ),
    "noisy": ("noisy_pad", lambda s: make(seed=s, duration_s=8.0, noise_count=7.0)),
}


@pytest.mark.parametrize("name", FAULTS)
@pytest.mark.parametrize(
    "num_episodes", [FEW_SEEDS, pytest.param(NUM_SEEDS, marks=pytest.mark.slow)]
)
def test_fault_is_found_in_at_least_95_per_cent_of_random_episodes(
    name: str, num_episodes: int
) -> None:
    check, fault = FAULTS[name]
    hits = sum(bool(serious(found(fault(seed), check))) for seed in range(num_episodes))
    assert hits >= 0.95 * num_episodes, f"{hits} of {num_episodes}"

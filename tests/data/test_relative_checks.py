"""Checks that need no unit: planted faults in joints and touch of datasets that state none, and clean ones of many kinds."""

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from taccorl.data.episode import Episode
from taccorl.data.relative_checks import (
    RestingLevels,
    check_relative_motion,
    check_relative_touch,
)
from taccorl.data.spec import ACTION, STATE
from tests.data.synthetic_episode import NAMES, SPEC, copies, make, with_arrays

FPS = 30
DEGREES = 180.0 / np.pi
TICKS = 4096 / (2 * np.pi)
KEY = "observation.tactile.primary"


def unstated(episode: Episode, state: np.ndarray, action: np.ndarray) -> Episode:
    """``episode`` with these joints, in a unit that nobody states."""
    features = dict(episode.spec.features)
    for key in (STATE, ACTION):
        features[key] = dataclasses.replace(features[key], unit="unknown")
    spec = dataclasses.replace(episode.spec, features=features)
    episode = dataclasses.replace(episode, spec=spec)
    return with_arrays(
        episode, state=state.astype(np.float32), action=action.astype(np.float32)
    )


def quantised(values: np.ndarray, scale: float, quantum: float) -> np.ndarray:
    return np.round(values * scale / quantum) * quantum


SCALES = {"degrees": (DEGREES, 0.088), "ticks": (TICKS, 1.0), "rad": (1.0, 1e-7)}


@pytest.fixture(params=SCALES.values(), ids=list(SCALES), scope="module")
def joints(request) -> tuple[Episode, np.ndarray, np.ndarray]:
    episode = make(seed=3)
    state, action, _ = copies(episode)
    return episode, quantised(state, *request.param), quantised(action, *request.param)


def checks(episode: Episode) -> list[str]:
    return [f.check for f in check_relative_motion(episode)]


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize(("scale", "quantum"), SCALES.values(), ids=SCALES)
def test_clean_episodes_have_no_finding(seed, scale, quantum):
    episode = make(seed=seed, duration_s=4.0 + seed % 7)
    state, action, _ = copies(episode)
    own = quantised(state, scale, quantum), quantised(action, scale, quantum)
    assert checks(unstated(episode, *own)) == []


LIFT, GRIPPER = NAMES.index("left_joint_2.pos"), NAMES.index("right_gripper.pos")
ROWS = slice(60, 60 + round(0.7 * FPS))


def all_zero(s, a):
    s[:] = 0.0


def dead_joint(s, a):
    s[:, LIFT] = s[0, LIFT]


def repeated_rows(s, a):
    first = busiest(a, round(0.7 * FPS))
    s[first : first + round(0.7 * FPS)] = s[first]


def frozen_joint(s, a):
    first = busiest(a[:, [LIFT]], 2 * FPS)
    s[first : first + 2 * FPS, LIFT] = s[first, LIFT]


def dead_gripper_command(s, a):
    a[:, GRIPPER] = 0.0


def one_command_for_both(s, a):
    half = len(NAMES) // 2
    a[:, half:] = a[:, :half]


def full_turn(s, a):
    for x in (s, a):
        turn = 360.0 if np.ptp(s) > 20 else 2 * np.pi
        turn = 4096.0 if np.ptp(s) > 400 else turn
        # from just below half a turn to beyond it
        x[:, LIFT] += 0.98 * turn / 2 - x[:, LIFT].mean()
        x[:, LIFT] = (x[:, LIFT] + turn / 2) % turn - turn / 2


def busiest(values: np.ndarray, width: int) -> int:
    """First row of the ``width`` rows in which ``values`` (T, J) move most, relative to their ranges."""
    span = np.maximum(np.ptp(values, axis=0), 1e-9)
    moved = [
        (np.ptp(values[k : k + width], axis=0) / span).max()
        for k in range(len(values) - width)
    ]
    return int(np.argmax(moved))


PLANTED: dict[str, tuple[Callable, str, str]] = {
    "all of the state 0": (all_zero, "dead_state", "left_joint_2"),
    "one joint dead": (dead_joint, "dead_state", "left_joint_2"),
    "rows repeated for 0.7 s": (repeated_rows, "frozen_state", "0.70 s"),
    "one joint frozen": (frozen_joint, "frozen_state", "left_joint_2"),
    "a gripper's command 0": (dead_gripper_command, "dead_command", "right_gripper"),
    "one command for both arms": (one_command_for_both, "same_command", "left_joint_2"),
    "an angle that passes a turn": (full_turn, "jump", "left_joint_2"),
}


@pytest.mark.parametrize(("plant", "check", "word"), PLANTED.values(), ids=PLANTED)
def test_a_planted_fault_of_joints_is_named(plant, check, word, joints):
    episode, state, action = joints[0], joints[1].copy(), joints[2].copy()
    plant(state, action)
    found = list(check_relative_motion(unstated(episode, state, action)))
    assert [f.check for f in found].count(check) == 1
    assert word in next(f.text for f in found if f.check == check)


def test_a_full_turn_is_named_with_its_size(joints):
    episode, state, action = joints[0], joints[1].copy(), joints[2].copy()
    full_turn(state, action)
    (found,) = check_relative_motion(unstated(episode, state, action))
    assert any(turn in found.text for turn in ("360 degrees", "6.283 rad", "4096"))


def test_a_held_gripper_and_a_tremor_of_the_leader_are_no_faults():
    """A part stops the gripper while its command closes on; a wrist at rest has a trembling command."""
    episode = make(seed=3)
    state, action, _ = copies(episode)
    rng = np.random.default_rng(0)
    wrist = NAMES.index("left_joint_6.pos")
    state[:, wrist] = 0.3
    action[:, wrist] = 0.3 + 0.0015 * rng.integers(-1, 2, len(action))
    state[60:, GRIPPER] = state[60, GRIPPER]
    assert checks(unstated(episode, state, action)) == []


# ---- touch ----

RNG = np.random.default_rng(7)
WEIGHTS, REST = RNG.normal(0, 100, 15), RNG.normal(0, 40, 15)


def pressed(times: np.ndarray, phase: float = 0.0) -> np.ndarray:
    """(T,) force of presses with rests between them."""
    return np.maximum(0.0, np.sin(2.2 * times + phase)) ** 2


def magnets(episode: int, rows: int = 150, forces: float = 1.0) -> np.ndarray:
    """(T, 15) values of five magnetometers of an episode."""
    rng = np.random.default_rng(episode)
    times = 10.0 * episode + np.arange(rows) / FPS
    force = forces * pressed(times) * (0.7 + 0.3 * np.sin(0.31 * times))
    return REST + WEIGHTS * force[:, None] + rng.normal(0, 1, (rows, 15))


def held(episode: int, rows: int = 150) -> np.ndarray:
    """As ``magnets``, of an episode that ends with a part held by a force of its own."""
    rng = np.random.default_rng(100 + episode)
    values = magnets(episode, rows)
    grip = rng.uniform(0.3, 1.0) + 0.02 * rng.standard_normal(rows // 2).cumsum()
    values[rows - rows // 2 :] = (
        REST + WEIGHTS * grip[:, None] + rng.normal(0, 1, (rows // 2, 15))
    )
    return values


def counts(episode: int, rows: int = 150) -> np.ndarray:
    """(T, 64) whole counts at or above 0 of a grid, with noise of one count."""
    rng = np.random.default_rng(200 + episode)
    y, x = np.mgrid[:8, :8]
    bump = np.exp(-((y - 4) ** 2 + (x - 3) ** 2) / 6).ravel()
    force = pressed(10.0 * episode + np.arange(rows) / FPS, 0.4)
    noisy = 300 * force[:, None] * bump + rng.normal(2, 1, (rows, 64))
    return np.maximum(np.round(noisy), 0)


def binary(episode: int, rows: int = 150) -> np.ndarray:
    return (magnets(episode, rows) > REST + 0.3 * np.abs(WEIGHTS)).astype(float)


def found_in(values: list[np.ndarray]) -> list[str]:
    base, levels, names = make(seed=0), RestingLevels(), []
    feature = dataclasses.replace(SPEC.features[STATE], names=(), unit="unknown")
    for k, own in enumerate(values):
        levels.add(f"episode {k}", own, FPS)
        spec = dataclasses.replace(
            base.spec, features=base.spec.features | {KEY: feature}
        )
        episode = dataclasses.replace(
            base, spec=spec, arrays=base.arrays | {KEY: own.astype(np.float32)}
        )
        names += [f.check for f in check_relative_touch(episode, KEY)]
    return [*dict.fromkeys([*names, *(f.check for f in levels.finding(KEY))])]


CLEAN = {
    "presses": [magnets(k) for k in range(6)],
    "parts held at the end": [held(k) for k in range(8)],
    "counts": [counts(k) for k in range(6)],
    "binary": [binary(k) for k in range(6)],
    "nothing touched": [magnets(k, forces=0.0) for k in range(4)],
    "one episode": [magnets(0, 600)],
    "one episode of held parts": [np.concatenate([held(k, 150) for k in range(5)])],
}


@pytest.mark.parametrize("values", CLEAN.values(), ids=CLEAN)
def test_clean_touch_has_no_finding(values):
    assert found_in(values) == []


def stepped() -> list[np.ndarray]:
    values = [magnets(k) for k in range(4)]
    values[1][75:] += 0.5 * np.abs(WEIGHTS) * np.sign(REST)
    for later in values[2:]:
        later += 0.5 * np.abs(WEIGHTS) * np.sign(REST)
    return values


def stepped_between() -> list[np.ndarray]:
    values = [magnets(k) for k in range(4)]
    return [*values[:2], *(own + 0.5 * WEIGHTS[::-1] for own in values[2:])]


def drifting() -> list[np.ndarray]:
    rows = np.arange(150)[:, None]
    return [magnets(k) + (150 * k + rows) / 600 * 0.8 * WEIGHTS[::-1] for k in range(4)]


def by_peak() -> list[np.ndarray]:
    values = [counts(k) for k in range(3)]
    return [
        (v - v.min(1, keepdims=True)) / np.ptp(v, axis=1, keepdims=True) for v in values
    ]


def clipped() -> list[np.ndarray]:
    return [np.minimum(counts(k), 190) for k in range(3)]


def rebooted() -> list[np.ndarray]:
    values = [magnets(k) for k in range(3)]
    values[1][50:65] = 0.0
    return values


FAULTS = {
    "a step within an episode": (stepped, "baseline_drift"),
    "a step between episodes": (stepped_between, "baseline_drift"),
    "a drift": (drifting, "baseline_drift"),
    "divided by the peak": (by_peak, "touch_by_peak"),
    "cut off": (clipped, "saturated"),
    "half a second of zeros": (rebooted, "touch_zeros"),
}


@pytest.mark.parametrize(("made", "check"), FAULTS.values(), ids=FAULTS)
def test_a_planted_fault_of_touch_is_named(made, check):
    assert check in found_in(made())

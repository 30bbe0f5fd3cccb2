"""Pads whose gain changes between two recordings of one press. Presses are made, not a robot's."""

import dataclasses

import numpy as np
import pytest
from made_press import K_N, Law, ball_at, plain, press

from taccorl.alignment.measurements.measurement import Measurement
from taccorl.alignment.touch.motion import touch_motion
from taccorl.diagnosis.problems.pads import drifts_of
from taccorl.diagnosis.problems.touch_problem import TouchProblem
from taccorl.diagnosis.search.drift import Drift
from taccorl.sim.twin import TwinConfig

CONFIG, MINUTES = TwinConfig(), 8
BALL = ball_at(0.001, 0.003)


def weaker(share: float) -> Law:
    def law(depth: np.ndarray, rate: np.ndarray, time_s: np.ndarray) -> np.ndarray:
        return share * plain(depth, rate, time_s)

    return law


def again(law: Law = plain) -> Measurement:
    later = press(7, law=law, motion_seed=0, repeat_of="press_0", name="later")
    return dataclasses.replace(later, start_ns=round(MINUTES * 60e9))


def found(second: Measurement) -> tuple[bool, list[Drift]]:
    """Whether two recordings of one press differ by more than noise, and which numbers of the
    pad changed between them."""
    motions = [touch_motion(m, CONFIG, BALL) for m in (press(0), second)]
    return TouchProblem(motions, CONFIG).repeats_differ, drifts_of(motions, CONFIG)


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.7, 0.85, 1.25])
def test_a_gain_that_changed_is_named_with_both_values(share: float) -> None:
    differ, (drift,) = found(again(weaker(share)))
    assert differ
    assert drift.number == "k_n"
    assert drift.before == pytest.approx(K_N, rel=0.02)
    assert drift.after == pytest.approx(share * K_N, rel=0.02)
    assert (drift.first, drift.second) == ("press_0", "later")
    assert drift.over_s == pytest.approx(480.0)


def test_pads_that_repeat_drift_in_nothing() -> None:
    differ, drifts = found(again())
    assert not differ
    assert not drifts

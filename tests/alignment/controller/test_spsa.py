"""The paper's search for gains (App. B.1): SPSA and the loss of eq. 9, by hand and on a
recording of the simulated twin whose gains are known."""

import math

import numpy as np
import pytest
from one_joint import REFERENCE_TWIN, TWIN, recorded

from taccorl.alignment.controller import spsa
from taccorl.alignment.controller.identification import identify_controller
from taccorl.alignment.controller.joint_model import JointModel
from taccorl.alignment.controller.joint_recording import joint_motion

NAN = math.nan
FIRST_STEP = 0.15 / 21**0.602  # a / (1 + A)^α


class Watched:
    """A loss of one variable that keeps where it was evaluated."""

    def __init__(self, slope: float) -> None:
        self.slope = slope
        self.places: list[float] = []

    def __call__(self, x: np.ndarray) -> float:
        self.places.append(float(x[0]))
        return self.slope * float(x[0])

    def minimised(self, start: float, seed: int = 0) -> spsa.Spsa:
        bound = np.array([9.0])
        rng = np.random.default_rng(seed)
        return spsa.minimise(self, np.array([start]), -bound, bound, rng)


def test_the_loss_of_eq_9_by_hand() -> None:
    # Errors of tracking differ by 0.1, −0.2, 0.1: 0.4 in all, and 0.1 · (0.3 + 0.3).
    simulated, measured = np.array([1.1, 1.8, 3.1]), np.array([1.0, 2.0, 3.0])
    assert spsa.paper_loss(simulated, measured) == pytest.approx(0.4 + 0.06)
    assert spsa.paper_loss(measured, measured) == 0.0


def test_rows_that_were_not_measured_add_nothing_to_the_loss() -> None:
    # Left are 0.1 and 0.1 in the last rows, which do not change.
    simulated, measured = np.array([1.1, 1.8, 3.1, 4.1]), np.array([1.0, NAN, 3.0, 4.0])
    assert spsa.paper_loss(simulated, measured) == pytest.approx(0.3)


@pytest.mark.parametrize(
    ("start", "ends"),
    [(1.0, [0.92, 1.08]), pytest.param(9.0, [8.92, 9.0], id="at a bound")],
)
def test_the_first_step_by_hand(start: float, ends: list[float]) -> None:
    """L = 3 x: two ends c = 0.08 away differ by 0.48, slope 3; an end beyond a bound is
    moved onto it, and the slope stays right."""
    loss = Watched(3.0)
    loss.minimised(start)
    assert loss.places[0] == start
    assert sorted(loss.places[1:3]) == pytest.approx(ends)
    assert loss.places[3] == pytest.approx(start - 3.0 * FIRST_STEP)


def test_a_steep_slope_is_clipped_at_5() -> None:
    loss = Watched(1e6)
    found = loss.minimised(1.0)
    assert loss.places[3] == pytest.approx(1.0 - 5.0 * FIRST_STEP)
    assert found.x[0] == -9.0  # the bound


def test_it_ends_after_20_iterations_without_a_better_iterate() -> None:
    found = Watched(0.0).minimised(1.0)
    assert (found.iterations, found.out_of_patience) == (20, True)
    assert (found.x[0], found.loss, found.start_loss) == (1.0, 0.0, 0.0)


def test_what_still_improves_is_cut_off_and_says_so(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(spsa, "MAX_ITERATIONS", 7)
    found = Watched(1e-3).minimised(1.0)
    assert (found.iterations, found.out_of_patience) == (7, False)


def test_the_result_is_the_best_iterate_not_a_perturbed_point() -> None:
    places = []

    def cubed(x: np.ndarray) -> float:
        places.append(float(x[0]))
        return abs(float(x[0])) ** 3

    bound = np.ones(1)
    rng = np.random.default_rng(0)
    found = spsa.minimise(cubed, np.array([0.5]), -bound, bound, rng)
    iterates = [places[0], *places[3::3]]
    assert len(iterates) == found.iterations + 1
    assert found.x[0] == min(iterates, key=abs)
    assert found.loss == abs(found.x[0]) ** 3


@pytest.mark.parametrize(
    ("signal", "seed"),
    [
        ("left_joint4", 0),
        *(
            pytest.param(f"left_joint{j}", seed, marks=pytest.mark.slow)
            for j in range(1, 7)
            for seed in range(3)
        ),
    ],
)
def test_the_paper_s_gains_come_out_of_its_sweep(signal: str, seed: int) -> None:
    truth, model = JointModel(TWIN, signal).gains, JointModel(REFERENCE_TWIN, signal)
    sweep, validation = (
        joint_motion(recorded(signal, k, high_hz=hz), REFERENCE_TWIN, signal)
        for k, hz in ((0, 2.0), (1, 1.0))
    )
    fit = identify_controller(
        [sweep], model, validation=[validation], spsa_rng=np.random.default_rng(seed)
    )
    assert fit.converged and fit.remarks[0].startswith("SPSA: loss (eq. 9)")
    error = fit.errors[-1]
    # Measured before the search came back: 0.20 … 1.19 mrad of 4.7 … 13.2, ratio in 2 %.
    assert 4.6e-3 < error.rmse_before < 13.3e-3
    assert 0.19e-3 < error.rmse_after < 1.2e-3
    assert fit.gains.kd / fit.gains.kp == pytest.approx(truth.kd / truth.kp, rel=0.02)
    true = {"kp": truth.kp, "lag": truth.kd / truth.kp}
    true["offset"] = truth.torque_ff / truth.kp
    for name, value in true.items():
        assert fit.estimates[name].low < value < fit.estimates[name].high


def test_the_same_seed_gives_the_same_gains_and_another_one_others() -> None:
    model = JointModel(REFERENCE_TWIN, "left_joint4")
    motion = recorded("left_joint4", 0, seconds=3.0)
    sweep = joint_motion(motion, REFERENCE_TWIN, "left_joint4")
    gains = [
        identify_controller([sweep], model, spsa_rng=np.random.default_rng(seed)).gains
        for seed in (0, 0, 1)
    ]
    assert gains[0] == gains[1] != gains[2]


def test_commanded_gains_stay_and_a_twin_that_fits_is_left_alone() -> None:
    signal = "left_joint4"
    truth, model = JointModel(TWIN, signal).gains, JointModel(TWIN, signal)
    motion = recorded(signal, 0, seconds=3.0, noise_rad=0.0)
    sweep = joint_motion(motion, TWIN, signal)
    rng = np.random.default_rng(0)
    fit = identify_controller([sweep], model, free=["kd", "torque_ff"], spsa_rng=rng)
    assert fit.gains.kp == truth.kp and fit.estimates["kp"].fixed
    assert fit.gains.kd == pytest.approx(truth.kd, rel=1e-6)

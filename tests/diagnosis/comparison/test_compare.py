"""Residuals whose size was known beforehand; the two ways agree; what a recording knows is used; uses stay apart."""

import dataclasses

import made_press
import numpy as np
import pytest
from made_traces import FLOOR_RAD, alike, comparison, floor, swing, trace
from simulated_sweeps import NOISE_RAD, SIGNAL, chirp, friction, recorded, sweeps

from taccorl.alignment.measurements.folder import Measurements
from taccorl.diagnosis.comparison.compare import compare, moving, replay_all
from taccorl.diagnosis.comparison.replays import evened, replay_joints, replay_whole
from taccorl.diagnosis.comparison.result import only, shown
from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.effects import make_effect
from taccorl.sim.sensors.flexitac import FlexiTacConfig
from taccorl.sim.twin import TwinConfig

FRICTION_NM = 1.0


@pytest.fixture(scope="module")
def measured() -> Measurements:
    return sweeps(friction(FRICTION_NM))


def test_twin_with_the_hidden_effect_is_at_the_floor_and_without_it_off_by_friction_over_stiffness(
    measured,
):
    nominal, true = (
        compare(TwinConfig(), measured),
        compare(friction(FRICTION_NM), measured),
    )
    for use in ("fit", "validation"):
        score = true.score(SIGNAL, "position", use)
        assert score is not None and 0.9 < score.ratio < 1.1
        assert score.floor == pytest.approx(NOISE_RAD, rel=0.1), (
            "from the repeated recording"
        )
    # Dry friction holds the joint F / K_p behind where the nominal twin is, on the side that it comes from.
    residual = np.concatenate([t.residual for t in nominal.of(SIGNAL)])
    behind = FRICTION_NM / ROBOT.kp_nm_per_rad[4]
    assert np.quantile(np.abs(residual), 0.99) == pytest.approx(behind, rel=0.08)
    effort = nominal.score(SIGNAL, "effort", "validation")
    assert effort is not None and effort.unit == "N·m" and effort.ratio > 5


def test_both_ways_of_replaying_agree_where_both_may_be_used():
    m = recorded(friction(), chirp(3, seconds=3.0), 3)
    alone, whole = replay_joints(friction(), m, [SIGNAL]), replay_whole(friction(), m)
    j = m.column(SIGNAL)
    assert (
        np.abs(alone.reported[:, j] - whole.reported[:, j]).max() < 5e-5
    )  # rad, the contract of the one-joint model
    assert (
        np.nanmax(np.abs(alone.effort[1:, j] - whole.effort[1:, j])) < 0.05
    )  # N·m of 1


def test_one_joint_s_error_stays_with_it_while_another_moves():
    both = ("left_joint5", "left_joint4")
    m = recorded(friction(), chirp(4, seconds=3.0, signals=both), 4)
    found = compare(TwinConfig(), Measurements((m,)))
    wrong, right = (found.score(s, "position", "fit") for s in both)
    assert wrong is not None and right is not None
    assert wrong.ratio > 10 and right.ratio < 1.5


def test_gripper_or_contact_takes_the_whole_twin():
    target = chirp(5, seconds=1.0)
    free, target = recorded(TwinConfig(), target, 5), target.copy()
    target[300:, 6] -= 0.02
    gripping = recorded(TwinConfig(), target, 6)
    assert [
        r.way for r in replay_all(TwinConfig(), [free, gripping], lambda *_: None)
    ] == ["joint", "twin"]
    assert moving(gripping) == [SIGNAL, "left_gripper"]
    found = compare(TwinConfig(), Measurements((gripping,)))
    assert [s for s, kind in found.signals if kind == "position"] == [
        SIGNAL,
        "left_gripper",
    ]
    assert all(s.ratio < 2.0 for s in found.scores() if s.kind == "position")


@pytest.mark.parametrize("gripping", [False, True], ids=["joint", "whole twin"])
def test_known_payload_and_commanded_gains_are_those_of_the_recording(gripping):
    k = 4
    gains = {
        "kp_nm_per_rad": [
            v * (2 if j == k else 1) for j, v in enumerate(ROBOT.kp_nm_per_rad)
        ],
        "kd_nms_per_rad": [
            v * (2 if j == k else 1) for j, v in enumerate(ROBOT.kd_nms_per_rad)
        ],
    }
    robot = TwinConfig(effects=[make_effect("payload", arm="left", mass_kg=0.4)])
    robot = dataclasses.replace(
        robot, controller=dataclasses.replace(robot.controller, **gains)
    )
    target = chirp(6, seconds=2.0)
    if gripping:
        target[300:, 6] -= 0.02
    m = recorded(robot, target, 8)
    known = dataclasses.replace(
        m,
        kp={SIGNAL: 2 * ROBOT.kp_nm_per_rad[k]},
        kd={SIGNAL: 2 * ROBOT.kd_nms_per_rad[k]},
        payload_kg={"left": 0.4},
    )
    ratios = []
    for one in (m, known):
        score = compare(TwinConfig(), Measurements((one,))).score(
            SIGNAL, "position", "fit"
        )
        ratios.append(score.ratio)
    assert ratios[0] > 5
    assert ratios[1] < 1.5


def test_rows_at_an_odd_rate_are_brought_to_whole_physics_steps():
    m = recorded(TwinConfig(), chirp(7, seconds=1.0), 9)
    odd = dataclasses.replace(m, time_s=m.time_s * 1.0005)  # 199.9 Hz
    even = evened(odd, TwinConfig())
    assert evened(m, TwinConfig()) is m
    assert even.rate_hz == 200.0
    assert even.time_s[-1] == pytest.approx(odd.time_s[-1], abs=0.01)
    with pytest.raises(TaccorlError, match="rows per second"):
        evened(dataclasses.replace(m, time_s=m.time_s / 10), TwinConfig())


def test_a_measurement_that_leads_its_replay_by_two_rows_is_an_error_of_the_clock():
    m = recorded(TwinConfig(), chirp(8, seconds=4.0), 10)
    early = dataclasses.replace(
        m,
        **{n: getattr(m, n)[:-2] for n in ("time_s", "target")},
        **{n: getattr(m, n)[2:] for n in ("measured", "effort", "velocity")},
    )
    found = compare(TwinConfig(), Measurements((early,))).clock[m.name]
    assert [(f.check, f.severity) for f in found] == [("shifted_from_twin", "error")]
    assert compare(TwinConfig(), Measurements((m,))).clock[m.name] == ()


def test_score_is_the_arithmetic_written_out():
    time_s, position = swing(seconds=4.0, hz=0.5)
    residual = np.where(np.arange(len(time_s)) % 2 == 0, 3e-3, -3e-3)
    residual[:200] = np.nan  # not measured for a second
    measured = np.where(np.isnan(residual), np.nan, position)
    one = trace(np.nan_to_num(residual), position, measured=measured)
    score = comparison(one).score("left_joint5", "position", "validation")
    assert score.rmse == pytest.approx(3e-3)
    assert score.ratio == pytest.approx(3e-3 / FLOOR_RAD)  # 15
    assert score.nrmse == pytest.approx(3e-3 / np.nanstd(measured))
    assert score.n == 600
    np.testing.assert_allclose(score.interval, 3e-3)  # every block has the same error
    assert shown(score.rmse, score.unit) == "3 mrad"


def test_uses_are_kept_apart():
    _, position = swing()
    good, bad = np.full(len(position), 1e-3), np.full(len(position), 5e-3)
    found = comparison(
        trace(good, position, use="fit"), trace(bad, position, use="test")
    )
    assert found.uses == ("fit", "test")
    assert [s.rmse for s in found.scores()] == pytest.approx([1e-3, 5e-3])
    assert found.score("left_joint5", "position", "validation") is None


def test_interval_holds_the_truth_although_neighbours_are_alike():
    # 60 recordings of 20 s of noise of RMS 1 mrad with a correlation time of 0.1 s: 95 % intervals hold 1 mrad in at least
    # 50 (binomial: fewer than 51 of 60 has probability 0.002 at 95 %). Rows taken as independent would hold it in few.
    rng = np.random.default_rng(0)
    _, position = swing(seconds=20.0)
    held = 0
    for _ in range(60):
        score = comparison(trace(1e-3 * alike(rng, len(position)), position)).scores()[
            0
        ]
        held += score.interval[0] <= 1e-3 <= score.interval[1]
    assert held >= 50


def test_only_some_joints_and_a_wrong_name():
    _, position = swing(2.0)
    found = comparison(
        *[
            trace(0 * position, position, signal=s)
            for s in ("left_joint4", "left_joint5")
        ]
    )
    assert [s for s, _ in only(found, ["left_joint5"]).signals] == ["left_joint5"]
    with pytest.raises(TaccorlError, match=r"left_joint6.*left_joint5"):
        only(found, ["left_joint6"])
    assert floor().words().startswith("0.2 mrad")


@pytest.fixture(scope="module")
def presses() -> Measurements:
    return Measurements((made_press.press(0),), (made_press.press(1),))


def test_pads_of_the_right_law_are_at_their_noise_and_of_another_stiffness_are_not(
    presses,
):
    right = FlexiTacConfig(
        normal_stiffness_per_m=made_press.K_N, normal_damping_s_per_m=made_press.K_D
    )
    ball = made_press.ball_at(0.001, 0.003)
    scores = {}
    for name, sensor in (("right", right), ("nominal", FlexiTacConfig())):
        found = compare(TwinConfig(sensor=sensor), presses, pressed=ball)
        scores[name] = [s for s in found.scores() if s.kind == "touch"]
        assert [s.use for s in scores[name]] == ["fit", "validation"]
        # Something was between the fingers: where the gripper stands is not held against the twin, and that is said.
        assert found.signals == () and "left_gripper of press_0" in found.left_out[0]
    assert all(0.9 < s.ratio < 1.1 for s in scores["right"])
    assert all(s.ratio > 5 for s in scores["nominal"])
    # Held readings are 900 δ measured and 1200 δ in the nominal twin: off by a third of what was measured.
    held = found.touches[0]
    felt = held.replayed > 20
    assert np.median(
        (held.replayed / np.maximum(held.measured, 1))[felt]
    ) == pytest.approx(1200 / 900, rel=0.05)


@pytest.mark.slow
def test_touch_of_an_unknown_object_is_not_compared_and_says_so(presses):
    with pytest.raises(
        TaccorlError,
        match=r"nothing to compare: left_gripper.*what was pressed is not known",
    ):
        compare(TwinConfig(), presses)  # nothing but touch in it
    m = presses.fit[0]
    target = m.target.copy()
    target[:, 0] += 0.1 * np.sin(np.arange(m.num_rows) / 100)
    mixed = dataclasses.replace(m, target=target, measured=target)
    found = compare(TwinConfig(), Measurements((mixed,)))
    assert any("what was pressed is not known" in line for line in found.left_out)
    assert found.touches == ()


def test_the_error_of_a_part_counts_each_row_in_floors_of_its_own_recording():
    """Rows of 2 floors and of 1 floor, twice as many: √((2² · 200 + 1² · 400) / 600) = √2."""
    _, one = swing(1.0)
    _, other = swing(2.0)
    coarse = floor(10 * FLOOR_RAD)
    c = comparison(
        trace(np.full(len(one), 2 * FLOOR_RAD), one),
        trace(np.full(len(other), 10 * FLOOR_RAD), other, recording="b", floor=coarse),
    )
    assert c.error("left_joint5", "validation") == pytest.approx(2**0.5)
    assert c.error("left_joint5", "fit") is None
    assert c.error("right_joint5", "validation") is None

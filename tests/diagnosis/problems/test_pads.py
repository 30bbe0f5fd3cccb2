"""Pads arm by arm, and the twin that comes out of it; what contradicts itself is named. Presses are made, not a robot's."""

import dataclasses

import numpy as np
import pytest
from made_press import K_D, K_N, Law, ball_at, plain, press

from taccorl.alignment.measurements.folder import Measurements
from taccorl.alignment.measurements.measurement import Measurement
from taccorl.alignment.measurements.pressed import indenter
from taccorl.diagnosis.comparison.compare import compare
from taccorl.diagnosis.machines.machine import Addition, diagnose_parts
from taccorl.diagnosis.machines.piper import PiperTwin
from taccorl.diagnosis.problems.joints import moves, swept_joints
from taccorl.diagnosis.problems.pads import agreed, diagnose_arm, pressed_arms
from taccorl.diagnosis.search.result import Evidence, SearchConfig
from taccorl.diagnosis.search.solve import PartFinding
from taccorl.errors import TaccorlError
from taccorl.report.evidence import grade
from taccorl.sim.effects import effects, make_effect
from taccorl.sim.sensors.flexitac import FlexiTacConfig
from taccorl.sim.twin import TwinConfig

LIMIT = 2.0
CONSIDERED = ("taxel_saturation", "taxel_crosstalk", "touch_lag")
WITHOUT = [name for name in effects if name not in CONSIDERED]
ONE = SearchConfig(max_effects=1)


def saturated(depth: np.ndarray, rate: np.ndarray, time_s: np.ndarray) -> np.ndarray:
    reading = plain(depth, rate, time_s)
    return reading / (1 + reading / LIMIT)


def made(seed: int, law: Law = plain, **fields) -> Measurement:
    m = press(seed, law=law)
    return dataclasses.replace(m, **{"pressed": ball_at(0.001, 0.003)} | fields)


def on_the_right(m: Measurement) -> Measurement:
    """The same press by the other hand."""
    counts = np.roll(
        m.touch.counts.reshape(len(m.touch.counts), 4, -1), 2, axis=1
    ).reshape(len(m.touch.counts), -1)
    turned = {
        name: np.roll(getattr(m, name), 7, axis=1) for name in ("target", "measured")
    }
    return dataclasses.replace(
        m,
        name=f"right_{m.name}",
        touch=dataclasses.replace(m.touch, counts=counts),
        pressed=indenter("sphere", 0.012, "right", position_m=(0.001, 0.0, 0.003)),
        **turned,
    )


@pytest.fixture(scope="module")
def measured() -> Measurements:
    return Measurements((made(0, saturated), made(2, saturated)), (made(1, saturated),))


@pytest.fixture(scope="module")
def finding(measured: Measurements) -> PartFinding:
    return diagnose_arm(TwinConfig(), "left", measured, search=ONE, without=WITHOUT)


def test_the_bent_law_is_found_with_its_numbers(finding: PartFinding):
    d = finding.diagnosis
    assert finding.part == "left pads"
    assert d.names == ("taxel_saturation",) and d.effects[0].acts_on() == [
        "left_a",
        "left_b",
    ]
    assert vars(d.effects[0])["limit"] == pytest.approx(LIMIT, rel=0.03)
    assert d.base["k_n"] == pytest.approx(K_N, rel=0.02) and d.base[
        "k_d"
    ] == pytest.approx(K_D, rel=0.1)
    assert (
        d.errors["fitted"]["validation"] > 2.0
        and d.errors["after"]["validation"] < 1.25
    )
    assert finding.recordings == {
        "fit": ("press_0", "press_2"),
        "validation": ("press_1",),
        "test": (),
    }
    # 1.3 counts of noise, rounded: √(1.3² + 1/12) / √5 = 0.60 for the mean over five frames
    assert finding.noise.endswith("lower bound: record a press twice)")
    assert float(finding.noise.split()[0]) == pytest.approx(0.60, rel=0.05)
    assert set(finding.can_tell.visible) >= {"taxel_saturation", "baseline_drift"}
    assert [name for name in d.base if name.startswith("zero_")] == [
        "zero_left_a",
        "zero_left_b",
    ]


def test_the_mended_twin_has_the_effect_and_the_refitted_numbers_and_its_error_falls(
    finding, measured
):
    twin = TwinConfig()
    new = PiperTwin(twin).mended([finding])[0].config
    assert twin == TwinConfig(), "the old one stays"
    assert new.sensor.normal_stiffness_per_m == finding.diagnosis.base["k_n"]
    assert new.sensor.normal_damping_s_per_m == finding.diagnosis.base["k_d"]
    assert new.sensor.gain_count == FlexiTacConfig().gain_count
    assert [e.name for e in new.effects] == ["taxel_saturation"]
    before, after = compare(twin, measured), compare(new, measured)
    for one, other in zip(before.pad_scores(), after.pad_scores(), strict=True):
        assert (
            (one.signal, one.use) == (other.signal, other.use)
            and one.ratio > 4.0
            and other.ratio < 1.2
        )
    assert {s.signal for s in before.pad_scores()} == {"left_a", "left_b"}
    assert PiperTwin(twin).mended([])[0].config == twin


def test_an_effect_that_the_twin_has_on_these_pads_is_refitted_and_replaced(
    measured: Measurements,
):
    pads = ["left_a", "left_b"]
    wrong = TwinConfig(effects=[make_effect("taxel_saturation", limit=1.0, pads=pads)])
    found = diagnose_arm(wrong, "left", measured, search=ONE, without=WITHOUT)
    assert found.diagnosis.present == ("taxel_saturation",)
    assert found.diagnosis.status == "numbers_off"  # the limit of the twin was
    (effect,) = PiperTwin(wrong).mended([found])[0].config.effects
    assert vars(effect)["limit"] == pytest.approx(LIMIT, rel=0.03)


@pytest.mark.slow
def test_pads_of_both_arms_are_found_and_each_by_itself(measured: Measurements):
    alone = measured.fit[0]
    both = Measurements((alone, on_the_right(alone)))
    assert pressed_arms(both, TwinConfig()) == ("left", "right")
    found = diagnose_parts(
        PiperTwin.nominal(),
        ("left pads", "right pads"),
        both,
        search=ONE,
        without=WITHOUT,
    )
    assert [f.part for f in found] == ["left pads", "right pads"]
    assert all(f.rows_split for f in found)
    assert found[0].diagnosis.base["k_n"] == pytest.approx(
        found[1].diagnosis.base["k_n"], rel=1e-3
    )
    twin = PiperTwin(TwinConfig()).mended(found)[0].config
    assert [e.acts_on() for e in twin.effects] == [
        ["left_a", "left_b"],
        ["right_a", "right_b"],
    ]


def test_numbers_that_agree_are_averaged_by_their_intervals():
    fitted = {
        "left pads": (
            {"k_n": 1000.0, "k_d": 5.0},
            {"k_n": (990.0, 1010.0), "k_d": (4.0, 6.0)},
        ),
        "right pads": (
            {"k_n": 1030.0, "k_d": 5.0},
            {"k_n": (1000.0, 1040.0), "k_d": (4.0, 6.0)},
        ),
    }
    # widths 20 and 40: weights 4 to 1
    assert agreed(fitted) == pytest.approx({"k_n": (4 * 1000 + 1030) / 5, "k_d": 5.0})
    assert agreed({"left pads": ({"k_n": 900.0, "k_d": 9.0}, {})}) == {
        "k_n": 900.0,
        "k_d": 9.0,
    }


def test_numbers_that_do_not_agree_are_no_guess(finding: PartFinding):
    d = finding.diagnosis
    low, high = d.intervals["k_n"]
    stiffer = dataclasses.replace(
        d,
        base=d.base | {"k_n": 2 * d.base["k_n"]},
        intervals=d.intervals | {"k_n": (2 * low, 2 * high)},
    )
    other = dataclasses.replace(finding, part="right pads", diagnosis=stiffer)
    said = r"k_n of left pads .*right pads .*one value for all.*--pads=left or --pads=right"
    with pytest.raises(TaccorlError, match=said):
        PiperTwin(TwinConfig()).with_additions(
            [
                Addition(
                    f.part, f.diagnosis.effects, f.diagnosis.base, f.diagnosis.intervals
                )
                for f in (finding, other)
            ]
        )


def test_a_press_is_no_sweep_of_its_arm_s_joints_and_of_the_other_s_it_is():
    m = made(0)
    target = m.target.copy()
    target[:, [1, 8]] += 0.3 * np.sin(np.arange(m.num_rows) / 50)[:, None]
    moved = dataclasses.replace(m, target=target)
    assert not moves(moved, "left_joint2") and moves(moved, "right_joint2")
    assert moves(dataclasses.replace(moved, pressed=None), "left_joint2")
    assert swept_joints(Measurements((moved,))) == ("right_joint2",)
    assert swept_joints(Measurements((m,))) == (), (
        "the gripper is no joint that is diagnosed"
    )


def test_recordings_of_different_pads_are_named():
    # Fingers that are 6 mm beside the middle: one pad in the ball, the other 5 mm and more away.
    one = made(0)
    gone = one.measured.copy()
    gone[:, 6] += 0.012
    aside = dataclasses.replace(
        one,
        name="aside",
        measured=gone,
        pressed=indenter("sphere", 0.012, "left", position_m=(0.001, 0.006, 0.003)),
    )
    with pytest.raises(
        TaccorlError, match=r"press_0 presses left_a.*left_b, aside left_a:.*folders"
    ):
        diagnose_arm(TwinConfig(), "left", Measurements((one, aside)))


@pytest.mark.parametrize(
    ("radius_m", "message"),
    [
        (0.0115, r"press_0: the object comes near the pads of the left arm and never touches .*up to \d+ counts.*radius_m"),
        (0.004, r"press_0:.*object never comes within 1 mm.*check.*size"),
    ],
)  # fmt: skip
def test_an_object_that_is_not_touched_is_named_with_the_way_out(
    radius_m: float, message: str
):
    m = made(
        0, pressed=indenter("sphere", radius_m, "left", position_m=(0.001, 0.0, 0.003))
    )
    if (
        radius_m > 0.01
    ):  # 12 mm were 1 mm deep; 11.5 mm are 0.5, and with each finger 0.8 mm further off 0.3 mm away
        m = dataclasses.replace(
            m, measured=m.measured + np.where(np.arange(14) == 6, 1.6e-3, 0.0)
        )
    for look in (
        lambda: compare(TwinConfig(), Measurements((m,))),
        lambda: diagnose_arm(TwinConfig(), "left", Measurements((m,))),
    ):
        with pytest.raises(TaccorlError, match=message):
            look()


def test_a_pad_that_is_not_plugged_in_is_named():
    m = made(
        0,
        lambda depth, rate, time_s: (
            plain(depth, rate, time_s) * np.array([1.0, 0.0])[:, None, None]
        ),
    )
    said = r"press_0: left_b should penetrate the object by 1.\d\d mm.*read nothing; .*connected"
    with pytest.raises(TaccorlError, match=said):
        compare(TwinConfig(), Measurements((m,)))


def test_of_an_arm_that_presses_nothing_known_there_is_nothing_to_say():
    said = "right pads: no fit recording states what the pads pressed; state `pressed`"
    with pytest.raises(TaccorlError, match=said):
        diagnose_arm(TwinConfig(), "right", Measurements((made(0),)))


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({}, "overwhelming"),
        ({"score": 3.0}, "strong"),
        ({"bic": 40.0}, "strong"),
        ({"bic": 8.0}, "strong"),  # sure on the recordings that judge
        ({"bic": 8.0, "gain": 0.3}, "strong"),
        ({"bic": 8.0, "gain": 0.3, "score": 2.5}, "weak"),
        ({"gain": 0.05}, "weak"),  # however great the ΔBIC of what it was fitted to
        ({"gain": 0.3, "score": 1.0}, "weak"),
        ({"gain": -0.2}, "none"),
        ({"bic": -3.0}, "none"),
    ],
)
def test_evidence_in_words(fields: dict, words: str):
    numbers = {
        "explained": 0.5,
        "fit_error": 1.0,
        "validation_error": 1.1,
        "gain": 0.8,
        "score": 6.0,
        "bic": 5000.0,
    }
    texts = {"name": "touch_lag", "trouble": "", "verdict": ""}
    assert (
        grade(Evidence(values={}, base={}, at_bound=(), **texts, **numbers | fields))
        == words
    )

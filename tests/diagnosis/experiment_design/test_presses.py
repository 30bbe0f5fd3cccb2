"""Which press to record next: what tells effects of pads apart, what must not be pressed, what a press commands."""

import dataclasses

import numpy as np
import pytest
from made_press import ball_at, press

from taccorl.alignment.measurements.folder import Measurements
from taccorl.alignment.measurements.presses import PRESS_REST_S
from taccorl.diagnosis.experiment_design import presses
from taccorl.diagnosis.experiment_design.plan import TELLS, Plan, plan
from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.effects import make_effect
from taccorl.sim.robot import RobotConfig
from taccorl.sim.sensors.flexitac import FlexiTacConfig
from taccorl.sim.twin import TwinConfig

OF_NAME = {p.name: p for p in presses.LIBRARY}
FLOOR_COUNT = np.sqrt(
    (1.3**2 + 1 / 12) / 5
)  # noise and rounding in the mean of five frames


def planned(
    *rivals: str,
    of: tuple[str, ...],
    config: TwinConfig | None = None,
    measurements=None,
    fitted=None,
) -> Plan:
    part = presses.PadsPart(config or TwinConfig(), "left", measurements)
    part.library = [OF_NAME[name] for name in of]
    return plan(part, rivals, fitted)


def ways(found: Plan) -> dict[str, tuple[float, float]]:
    """Press → floors where the first rival is the truth, and where the second is."""
    return {p.name: next(iter(p.ways.values())) for p in found.planned}


@pytest.mark.slow
def test_creep_shows_in_a_long_hold_and_a_lag_in_quick_taps():
    """In a hold of 8 s creep with τ = 3 s goes on, and no lag does. A lag of 30 ms is gone by then: creep that is over in 50 ms
    and doubles the reading of half a k_n is nearly the same, but for the first scans of each tap."""
    found = planned("taxel_creep", "touch_lag", of=("long_hold", "quick_taps"))
    hold, taps = (ways(found)[name] for name in ("long_hold", "quick_taps"))
    assert hold[0] > 2 * taps[0] > 2 * TELLS
    assert taps[1] > 2 * hold[1]
    assert [p.worst for p in found.planned] == [min(taps), min(hold)], (
        "nobody knows which is true: the lesser counts"
    )
    assert found.part == "left pads" and found.floor == pytest.approx(FLOOR_COUNT)


def test_delay_and_lag_are_told_apart_by_quick_taps():
    found = planned("touch_delay", "touch_lag", of=("long_hold", "quick_taps"))
    assert [p.name for p in found.planned] == ["quick_taps", "long_hold"]
    assert found.planned[0].worst > 2 * TELLS and found.planned[1].worst < TELLS
    assert found.hopeless == ()


@pytest.mark.slow
def test_recordings_that_are_there_count_and_say_the_floor():
    """Light touches alone leave k_n free, which takes up most of how saturation bends the law; a press of 1 mm says k_n."""
    one = dataclasses.replace(press(0, noise_count=2.6), pressed=ball_at(0.001, 0.003))
    rivals = "taxel_saturation", "taxel_power_law"
    alone = planned(*rivals, of=("light_touches",))
    known = planned(*rivals, of=("light_touches",), measurements=Measurements((one,)))
    assert known.floor == pytest.approx(np.sqrt((2.6**2 + 1 / 12) / 5), rel=0.05)
    assert (
        known.planned[0].worst * known.floor > 2 * alone.planned[0].worst * alone.floor
    )


def test_taxels_beside_the_object_count_where_a_rival_makes_them_read():
    """Ghosts of 5 % are all over the rows and columns of a patch, crosstalk at its rim."""
    strong = {"taxel_ghosting": {"taxel_ghosting.share": 0.05}}
    found = planned(
        "taxel_ghosting", "taxel_crosstalk", of=("light_touches",), fitted=strong
    )
    typical = planned("taxel_ghosting", "taxel_crosstalk", of=("light_touches",))
    assert ways(found)["light_touches"][0] > 3 * ways(typical)["light_touches"][0]


def test_a_gain_map_that_nobody_knows_is_drawn():
    found = planned("taxel_gain_map", "taxel_saturation", of=("rod_across",))
    assert found.planned[0].worst > TELLS


def test_every_press_of_the_library_keeps_the_twin_s_limits_and_rests_at_both_ends():
    for p in presses.LIBRARY:
        opening, (force, target) = p.opening_m(), presses.grip(RobotConfig(), p)
        assert (
            target.min() >= 0
            and max(opening.max(), target.max()) <= ROBOT.opening_max_m
        ), p.name
        assert (
            np.abs(np.diff(opening)).max() * 200 / 2 <= presses.FINGER_SPEED_M_PER_S
        ), p.name
        assert 0 < p.penetration_m().max() < presses.travel_m(RobotConfig()), p.name
        assert force.max() <= 40.0, p.name
        rest = round((PRESS_REST_S - 0.1) * 200)
        assert np.ptp(opening[:rest]) < 1e-12 and np.ptp(opening[-rest:]) < 1e-12, (
            p.name
        )


def test_commands_lie_below_the_opening_by_what_the_gripper_yields():
    """A pad of 20 kN/m pressed in by 0.8 mm pushes back with 16 N: a gripper of 2 kN/m yields by 8 mm."""
    hold, middle = OF_NAME["long_hold"], round((PRESS_REST_S + 4.0) * 200)
    force, target = presses.grip(RobotConfig(), hold)
    assert force[middle] == pytest.approx(16.0)
    assert hold.opening_m()[middle] == pytest.approx(2 * (0.012 - 0.0008))
    assert target[middle] == pytest.approx(2 * (0.012 - 0.0008) - 0.008)
    assert force[0] == 0.0 and target[0] == hold.opening_m()[0] == pytest.approx(
        2 * (0.012 - presses.AWAY_M)
    )
    force, target = presses.grip(RobotConfig(pads="rigid"), hold)
    assert force.max() == 0.0 and (target == hold.opening_m()).all()


@pytest.mark.parametrize(
    ("robot", "refused"),
    [
        # 20 N on 20 kN/m: 1 mm; the ball goes in by 1.6 mm
        ({"grip_force_max_n": 20.0}, "goes 1.60 mm deep, the pads' travel is 1.00 mm"),
        # 32 N on 1 kN/m: 32 mm below an opening of 20.8 mm
        (
            {"grip_stiffness_n_per_m": 1000.0},
            r"needs commands of -11.2 … 26.0 mm, the gripper takes 0 … 70 mm",
        ),
    ],
)
def test_a_press_beyond_a_limit_is_refused(robot: dict, refused: str):
    config = TwinConfig(robot=RobotConfig(**robot))
    found = planned(
        "touch_delay", "touch_lag", of=("deep_presses", "quick_taps"), config=config
    )
    assert [p.name for p in found.planned] == ["quick_taps"]
    assert found.refused == {"deep_presses": refused}


def test_fingers_that_were_too_fast_are_refused(monkeypatch: pytest.MonkeyPatch):
    """Taps go 2 mm in 60 ms, with corners rounded over 65 ms: 2 / 0.065 = 31 mm/s."""
    monkeypatch.setattr(presses, "FINGER_SPEED_M_PER_S", 0.03)
    found = planned("touch_delay", "touch_lag", of=("quick_taps",))
    assert found.planned == () and found.hopeless == ("touch_delay | touch_lag",)
    assert found.refused["quick_taps"].startswith("moves each finger at 31 mm/s of 30")


def test_an_imagined_press_says_so_and_has_the_twin_s_noise():
    config = TwinConfig(sensor=FlexiTacConfig(noise_std_count=2.0))
    motion = presses.imagined_press(config, "right", OF_NAME["rests"])
    assert (
        motion.pads == ("right_a", "right_b")
        and "imagined" in motion.measurement.origin.text
    )
    quiet = motion.measured[motion.time_s[:, 0] < 9.0]
    assert np.std(quiet) == pytest.approx(np.sqrt(2.0**2 + 1 / 12), rel=0.01)
    # 0.6 mm less what the nearest taxel lies beside the top: k_n δ in counts
    assert motion.measured.max() == pytest.approx(75 * 1200 * 6e-4, rel=0.2)


@pytest.mark.parametrize(
    ("rivals", "message"),
    [
        (("touch_lag", "backlash"), "backlash is not an effect of pads"),
        (("touch_lag", "touch_dely"), r"no effect 'touch_dely'.*touch_delay"),
        (
            ("touch_lag", "taxel_gain_spread"),
            r"taxel_gain_spread.*these.*have:.*taxel_creep",
        ),
    ],
)
def test_rivals_that_pads_cannot_show_are_named(rivals: tuple[str, ...], message: str):
    with pytest.raises(TaccorlError, match=message):
        planned(*rivals, of=("quick_taps",))


def test_an_effect_that_the_twin_has_is_no_rival_and_is_refitted_beside_them():
    twin = TwinConfig(
        effects=[
            make_effect("touch_lag", time_constant_s=0.02, pads=["left_a", "left_b"])
        ]
    )
    with pytest.raises(TaccorlError, match=r"twin.*touch_lag.*left pads already;"):
        planned("touch_lag", "touch_delay", of=("quick_taps",), config=twin)
    found = planned("touch_delay", "taxel_saturation", of=("quick_taps",), config=twin)
    plain = planned("touch_delay", "taxel_saturation", of=("quick_taps",))
    assert 0 < found.planned[0].worst < plain.planned[0].worst, (
        "the lag takes up some of the delay"
    )


def test_without_a_word_of_what_was_pressed_recordings_do_not_count():
    said = r"left pads: no fit recording states what the pads pressed; state `pressed`"
    with pytest.raises(TaccorlError, match=said):
        planned(
            "touch_lag",
            "touch_delay",
            of=("quick_taps",),
            measurements=Measurements((press(0),)),
        )


def test_there_are_no_pads_of_another_arm():
    with pytest.raises(
        TaccorlError, match=r"no pads of an arm 'lft'; did you mean 'left'"
    ):
        presses.PadsPart(TwinConfig(), "lft")

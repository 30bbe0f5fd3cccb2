"""Surrogate pads: what can be said of them beforehand, and what the twin's replay makes of their recordings."""

import numpy as np
import pytest

from taccorl.alignment.touch.model import TouchModel
from taccorl.alignment.touch.motion import touch_motion
from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.sensors.flexitac import FlexiTacConfig
from taccorl.sim.twin import TwinConfig
from taccorl.surrogate import touch
from taccorl.surrogate.touch import (
    FIT,
    TouchCase,
    draw_touch_case,
    record_touch,
    touch_recordings,
)
from taccorl.surrogate.touch_hidden import (
    REGISTERED_TOUCH,
    TOUCH_KINDS,
    board,
    material,
)

QUICK = touch.Press(
    name="quick",
    knots=(
        (0, -1e-3),
        (1.5, -1e-3),
        (1.8, 8e-4),
        (3.0, 8e-4),
        (3.2, -1e-3),
        (4.2, -1e-3),
    ),
)


def load(values: list[tuple[float, float]], end_s: float) -> np.ndarray:
    """(M, 1) readings at 1 kHz through the given (s, reading)."""
    return np.interp(np.arange(round(end_s * 1e3)) / 1e3, *zip(*values, strict=True))[
        :, None
    ]


def through(name: str, reading: np.ndarray, **values: float) -> np.ndarray:
    return material(name, values, reading, np.zeros_like(reading))[:, 0]


def replayed(
    case: TouchCase, press: touch.Press, hidden=()
) -> tuple[np.ndarray, np.ndarray]:
    """Counts that the twin with the true k_n, k_d says, and those that were recorded."""
    twin = TwinConfig(
        sensor=FlexiTacConfig(
            normal_stiffness_per_m=case.k_n, normal_damping_s_per_m=case.k_d
        )
    )
    motion = touch_motion(
        record_touch(case, press), twin, press.pressed(case.arm).made()
    )
    model = TouchModel(twin)
    return model.counts(
        motion, model.simulate(motion, case.k_n, case.k_d, hidden)
    ), motion.measured.astype(float)


def rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(x**2)))


@pytest.mark.parametrize("press", [FIT[2], FIT[3], QUICK], ids=lambda p: p.name)
@pytest.mark.parametrize("arm", ["left", "right"])
def test_without_effects_the_twins_replay_is_at_the_noise(press, arm):
    twin, recorded = replayed(draw_touch_case([], 1, arm=arm), press)
    assert twin.max() > 40
    # 1.3 counts, rounding of 0.29, and a median of resting counts that is up to half a count off: 1.33 to 1.45;
    # 8 µm of depth, 75 · 1500/m · 8e-6 = 0.9, count where something is pressed, a few taxels for a part of the time.
    assert 1.25 < rms(twin - recorded) < 1.5


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [n for n in REGISTERED_TOUCH if TOUCH_KINDS[n].stage != "board"]
)
def test_the_registrys_effect_with_the_true_numbers_explains_what_is_hidden(name):
    case = draw_touch_case([name], 3, strength=6.0)
    for press in (FIT[2], FIT[0]):
        without, recorded = replayed(case, press)
        with_it, _ = replayed(case, press, [h.effect() for h in case.hidden])
        pressed = (without > 3).any(axis=0) | (with_it > 3).any(axis=0)
        before, after = (
            rms((without - recorded)[:, pressed]),
            rms((with_it - recorded)[:, pressed]),
        )
        assert after < 0.75 * before or before < 1.6
        assert after < 2.2


def test_boards_have_the_spread_and_the_dead_taxels_of_their_numbers():
    rng = np.random.default_rng(0)
    assert np.log(
        board("taxel_gain_spread", {"log_std": 0.3}, rng, ROBOT.pad.shape)
    ).std() == pytest.approx(0.3, rel=0.15)
    assert (
        board("dead_taxels", {"share": 0.25}, rng, ROBOT.pad.shape) == 0
    ).mean() == pytest.approx(0.25, abs=0.08)


@pytest.mark.parametrize("name", TOUCH_KINDS)
def test_every_hidden_effect_changes_what_is_recorded(name):
    plain = draw_touch_case([], 2, arm="left")
    k = TOUCH_KINDS[name]
    values = k.values(k.severity[1], np.random.default_rng(0))
    hidden = touch.Hidden(
        name=name, values=values, severity=1.0, registered=k.registered
    )
    marked = touch.dataclasses.replace(plain, hidden=(hidden,))
    time_s, depth = touch._penetration(QUICK)
    stamps = np.arange(0.02, 4.1, 0.01)
    one, other = (
        touch._readings(case, QUICK, time_s, depth, stamps) for case in (plain, marked)
    )
    assert np.isfinite(other).all() and np.abs(75 * (other - one)).max() > 3.0
    np.testing.assert_array_equal(other[:, 2:], 0.0)  # the other arm's pads


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "depth_offset",
        *(
            pytest.param(n, marks=pytest.mark.slow)
            for n in ("taxel_creep", "taxel_ghosting")
        ),
    ],
)
def test_an_effect_is_as_strong_as_asked(name):
    assert draw_touch_case([name], 1, strength=3.0).left_floors == pytest.approx(
        3.0, rel=0.25
    )


@pytest.mark.slow
def test_the_same_seed_gives_the_same_pads_and_recordings_bit_for_bit():
    one, other = (draw_touch_case(["taxel_creep"], 4) for _ in range(2))
    assert one.truth() == other.truth()
    a, b = record_touch(one, QUICK), record_touch(other, QUICK)
    np.testing.assert_array_equal(a.touch.counts, b.touch.counts)
    np.testing.assert_array_equal(a.measured, b.measured)


@pytest.mark.slow
def test_recordings_are_what_the_touch_problem_takes():
    case = draw_touch_case([], 5)
    made = touch_recordings(case)
    assert [len(side) for side in (made.fit, made.validation, made.test)] == [4, 2, 1]
    assert made.fit[1].repeat_of == made.fit[0].name
    for motion in (touch_motion(m, case.twin, m.pressed) for m in made.all):
        assert motion.pads == tuple(case.pads)
        assert motion.undisturbed().mean() > 0.05
    press = made.fit[0]
    quiet_s = press.time_s[
        np.flatnonzero(press.target[:, 7 * (case.arm == "right") + 6] < 0.0255)[[0, -1]]
    ]
    assert quiet_s[0] > 9.5 and press.time_s[-1] - quiet_s[1] > 9.5


def test_a_name_that_is_none_is_refused():
    with pytest.raises(TaccorlError, match="taxel_creep"):
        draw_touch_case(["taxel_crep"], 0)


def test_every_touch_effect_of_the_registry_that_a_replay_shows_can_be_hidden():
    from taccorl.sim.effects import effects
    from taccorl.sim.effects.effect import TouchEffect

    kinds = {name: effects.get(name) for name in effects}
    shown = {
        name
        for name, kind in kinds.items()
        if issubclass(kind, TouchEffect) and "pads" in kind.kinds()
    }
    # A gain map is what one measures of a board with spread or dead taxels; compliances act on the mechanics.
    assert shown - set(REGISTERED_TOUCH) <= {
        "taxel_gain_map",
        "pad_compliance",
        "contact_compliance",
        "contact_friction",
    }

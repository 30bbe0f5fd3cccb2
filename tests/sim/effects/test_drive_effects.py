"""Effects of drives: values at which a fit of them starts, what counts as torque of the motor, commands, and the first reset."""

import numpy as np
import pytest
from joint_bench import COLUMN, asked_nm, drive, on_joint5
from press_bench import RIGHT_HOME, start

from taccorl.sim.bench import Bench
from taccorl.sim.effects import effects, make_effect
from taccorl.sim.simulation import Simulation
from taccorl.sim.twin import TwinConfig


def test_the_constant_part_of_asymmetric_friction_is_not_the_motors() -> None:
    sim = start(on_joint5("asymmetric_friction", torque_nm=0.5, asymmetry=0.3))
    motion = drive(sim, 1.0, lambda t: 0.05 * t)
    assert sim.effort()[0, COLUMN] == pytest.approx(asked_nm(motion)[-1], abs=1e-9)


@pytest.mark.parametrize("balanced", [True, False])
def test_integral_action_has_balanced_what_acts_on_a_joint_at_its_target(balanced: bool) -> None:
    half = make_effect("gravity_mismatch", share=0.5, arm="right")
    sim = start(half, *[on_joint5("integral_action", rate_per_s=2.0)] * balanced)
    joints = sim.proprioception()[0].copy()
    sim.place_arms(joints, joints)
    moved = np.abs(drive(sim, 0.5)["q"] - RIGHT_HOME[4]).max()
    assert moved < 1e-4 if balanced else moved > 1e-3  # the other joints sag a little, and change its load


SEEN = {"peak_torque_nm": 4.0, "peak_speed_rad_per_s": 0.8, "span_rad": 1.5, "duration_s": 10.0}


@pytest.mark.parametrize(
    ("name", "parameter", "expected"),
    [
        ("torque_saturation", "torque_max_nm", [2.2, 3.0, 3.52, 3.88]),
        ("slew_limit", "speed_rad_per_s", [0.28, 0.48, 0.64, 0.736, 0.784]),
        ("coulomb_friction", "torque_nm", [0.12, 0.4, 1.2]),
        ("viscous_friction", "damping_nms_per_rad", [1 / 3, 1.0, 3.0]),
        ("torque_scale", "factor", [1.2, 0.8]),
    ],
)
def test_a_search_starts_where_the_recordings_say(name: str, parameter: str, expected: list[float]) -> None:
    assert [values[parameter] for values in effects.get(name).starts(SEEN)] == pytest.approx(expected)


@pytest.mark.parametrize("periods", [6.1, 7.3, 24.0, 57.4])
def test_a_search_for_cogging_starts_near_enough_to_see_any_number_of_periods(periods: float) -> None:
    """Over the span one of the starts explains most of the wave: it does not run out of step."""
    q = np.linspace(0.0, SEEN["span_rad"], 400)
    wave = np.sin(periods * q + 0.9)
    starts = effects.get("cogging").starts(SEEN)
    explained = []
    for n in {values["periods"] for values in starts}:
        basis = np.column_stack([np.sin(n * q), np.cos(n * q)])
        left = wave - basis @ np.linalg.lstsq(basis, wave, rcond=None)[0]
        explained.append(1 - np.sum(left**2) / np.sum(wave**2))
    assert max(explained) > 0.7
    assert {values["phase_rad"] for values in starts} == {0.0, np.pi / 2, np.pi, -np.pi / 2}


def test_commands_may_be_sent_one_by_one_or_together() -> None:
    names = {
        "load_friction": {"share": 0.1},
        "torque_lag": {"time_constant_s": 0.005},
        "command_delay": {"delay_s": 0.01},
    }
    together, apart = (start(*(make_effect(name, **values) for name, values in names.items())) for _ in range(2))
    commands = together.targets + 0.05 * np.sin(np.arange(1, 9))[:, None, None]
    together.advance(commands, 6)
    for command in commands:
        apart.advance(command[None], 6)
    np.testing.assert_array_equal(together.arrays["qpos"], apart.arrays["qpos"])


@pytest.mark.parametrize("name", ["torque_scale", "torque_lag", "load_friction"])
def test_the_first_reset_of_a_simulation_is_like_every_other(name: str) -> None:
    """What an effect feels at a reset must not depend on whether the simulation has been reset before."""
    effect = make_effect(name, joints=["joint2"])
    strength = next(p for p in effect.parameters() if p.absent is not None)
    setattr(effect, strength.name, strength.typical)
    config = TwinConfig(effects=[effect])
    sim = Simulation(Bench(), config)
    seen = []
    for _ in range(2):
        sim.reset([0])
        sim.step(sim.targets + 0.05)
        seen.append(sim.proprioception()[0].copy())
    np.testing.assert_array_equal(*seen)

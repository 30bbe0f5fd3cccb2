"""Start values, weakened starts and scaled starts of the search stay within the bounds of their effect, whatever the machine."""

import itertools

import numpy as np
import pytest

from taccorl.diagnosis.search.problem import candidate
from taccorl.diagnosis.search.screen import WEAKENED, Probe, _weaker
from taccorl.sim.effects import effects
from taccorl.sim.effects.effect import Effect
from taccorl.sim.effects.scaled import Scale, scaled

SIZES = (0.01, 1.0, 1000.0)
"""Forces and strokes of a machine relative to a joint of the PiPER."""
AMOUNTS = (1e-3, 1.0, 1e3)
"""Forces, motions and durations of recordings relative to the machine's size."""


def classes(name: str) -> list[tuple[type[Effect], float, float]]:
    """(class, force unit, length unit) of the effect ``name`` for hinges and slides of all sizes; of pads and cells as it is."""
    if "joint" not in effects.get(name).kinds():
        return [(effects.get(name), 1.0, 1.0)]
    sizes = itertools.product(("rad", "m"), SIZES, SIZES)
    return [
        (scaled(name, Scale(unit=unit, force=n, length=m, drive=1e-3 * m / n)), n, m)
        for unit, n, m in sizes
    ]


def facts(newtons: float, metres: float, amount: float) -> dict[str, float]:
    """Facts of recordings as ``Effect.starts`` is given them; the fit found the drive five times as soft as its file has it."""
    return {
        "peak_torque_nm": amount * newtons,
        "peak_motor_nm": 2.0 * amount * newtons,
        "peak_measured_nm": 3.0 * amount * newtons,
        "peak_speed_rad_per_s": amount * metres,
        "span_rad": amount * metres,
        "lowest_rad": -amount * metres,
        "highest_rad": 2.0 * amount * metres,
        "duration_s": 10.0 * amount,
        "drive_rad_per_nm": 5e-3 * metres / newtons,
        "peak_reading": 1e3 * amount,
        "wave_periods_1": 500.0 / (amount * metres),
        "wave_phase_1": 3.0,
    }


@pytest.mark.parametrize("name", [n for n in effects if effects.get(n).fitted])
def test_an_effect_can_be_made_with_each_of_its_probes_on_a_machine_of_any_size(
    name: str,
) -> None:
    """``Candidate.make`` refuses a number beyond its bounds."""
    for (cls, newtons, metres), amount in itertools.product(classes(name), AMOUNTS):
        c = candidate(cls, facts(newtons, metres, amount))
        typical = {f.name: f.start for f in c.frees}
        for start in c.starts:
            c.make(typical | start)
            for multiple in (1e-3, 1.0, 1e3):
                probe = Probe(c.name, start, np.zeros(1), 0.5, multiple)
                c.make(probe.scaled(c))
            weaker = start
            for _ in range(WEAKENED):
                weaker = _weaker(c, weaker, 0.01)
                if weaker is None:
                    break
                c.make(typical | weaker)


def test_a_gear_as_soft_as_a_drive_that_is_softer_than_its_file_says_starts_at_its_bound() -> (
    None
):
    """K_p of the file 1000 N·m/rad, so that the bound is 5 / 1000; the fit found 100, and a start is 3 / 100."""
    gear = scaled("joint_compliance", Scale(force=100.0, drive=1.0 / 1000.0))
    c = candidate(gear, {"drive_rad_per_nm": 1.0 / 100.0})
    softest = max(start["joint_compliance.compliance_rad_per_nm"] for start in c.starts)
    assert softest == pytest.approx(5.0 / 1000.0)

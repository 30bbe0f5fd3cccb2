"""Which load to apply next to a sensor of cells: what separates which effects, and the limits of load and speed."""

import dataclasses

import numpy as np
import pytest

from taccorl.alignment.measurements.folder import Measurements
from taccorl.diagnosis.experiment_design.loads import (
    LIBRARY,
    REST_S,
    CellsPart,
    LoadProfile,
    LoadRange,
    load_range,
)
from taccorl.diagnosis.experiment_design.plan import TELLS, Plan, plan
from taccorl.errors import TaccorlError
from taccorl.surrogate.cells import CellsCase, draw_cells, simulated

OF_NAME = {p.name: p for p in LIBRARY}


@pytest.fixture(scope="module")
def pressed() -> tuple[CellsCase, Measurements]:
    case = draw_cells("taxel_creep", 3)
    return case, simulated(case)


def planned(
    case: CellsCase,
    known: Measurements,
    *rivals: str,
    of: tuple[str, ...],
    allowed: LoadRange | None = None,
) -> Plan:
    part = CellsPart(case.config(), known, allowed or load_range(case.config(), known))
    part.library = [p for p in part.library if p.name in of]
    return plan(part, rivals)


def test_a_ramp_takes_as_long_as_its_speed_needs():
    """0 … 12 N at 4 N/s is 3 s, where the corner's 0.5 s would be 24 N/s; the hold and the rests stay."""
    profile = LoadProfile(
        name="x", knots=((0.0, 0.0), (1.0, 0.0), (1.5, 1.0), (3.5, 1.0), (9.5, 0.0))
    )
    load = profile.load(12.0, 4.0, 100.0)
    assert len(load) == 100 * (1 + 3 + 2 + 6) + 1
    assert np.abs(np.diff(load)).max() * 100.0 == pytest.approx(4.0)
    assert (
        (load[:101] == 0).all()
        and load[400:601] == pytest.approx(12.0)
        and load[-1] == 0
    )


@pytest.mark.parametrize("profile", LIBRARY, ids=[p.name for p in LIBRARY])
def test_a_press_begins_and_ends_at_rest_and_within_the_load(profile: LoadProfile):
    load = profile.load(20.0, 50.0, 100.0)
    rest = round((0.5 if profile.name == "taps" else REST_S) * 100)
    assert (load[:rest] == 0).all() and load[-1] == 0 and load.min() == 0
    assert 0 < load.max() <= 20.0 + 1e-9


def test_load_and_speed_are_those_of_the_recordings_unless_given(pressed):
    """The surrogate's fastest ramp is 19 N (0.95 of 20 N) in 0.15 s: 127 N/s, less what 50 ms average at its corners."""
    case, known = pressed
    found = load_range(case.config(), known)
    assert found.highest == pytest.approx(19.0, rel=0.02)
    assert found.speed == pytest.approx(127.0, rel=0.1)
    assert load_range(case.config(), known, span=[0, 5], speed=2.0) == LoadRange(
        highest=5.0, speed=2.0
    )
    for options, said in (
        ({"span": [1, 5]}, r"--span=\[1, 5\].*--span=\[0, 20\]"),
        ({"span": [0, 21]}, "rated 20 N"),
        ({"speed": 0.0}, "--speed=0.*N/s"),
    ):
        with pytest.raises(TaccorlError, match=said):
            load_range(case.config(), known, **options)


def test_taps_separate_a_delay_from_a_lag_and_a_slow_ramp_does_not(pressed):
    """On a ramp of 2 N/s both move the reading by a constant: gain and offset and the other's parameter absorb it."""
    case, known = pressed
    found = planned(case, known, "touch_lag", "touch_delay", of=("slow_ramp", "taps"))
    assert [p.name for p in found.planned] == ["taps", "slow_ramp"]
    taps, ramp = (p.worst for p in found.planned)
    assert taps > 2 * TELLS and ramp < 0.5
    assert not found.hopeless and found.floor == pytest.approx(1.0, abs=0.5)  # count


def test_the_score_is_of_the_load_that_may_be_applied(pressed):
    """A tenth of the load leaves less than a tenth of the difference: noise is the same, creep is linear."""
    case, known = pressed
    whole, tenth = (
        planned(
            *(case, known, "taxel_creep", "touch_lag"),
            of=("three_loads",),
            allowed=LoadRange(highest=n, speed=100.0),
        ).planned[0]
        for n in (15.0, 1.5)
    )
    assert tenth.made.target.max() == pytest.approx(
        1.5
    ) and whole.made.target.max() == pytest.approx(15.0)
    assert tenth.worst < 0.2 * whole.worst


def test_a_press_lasts_as_long_at_any_rate_of_the_recordings(pressed):
    """Recordings of 1 kHz are reduced to 200 rows per second; the planned rows have that rate, and the press its 9.5 s."""
    case, known = pressed

    def at_1_khz(m):
        fast = m.resampled(1000.0)
        return dataclasses.replace(
            fast, temperature_c=np.interp(fast.time_s, m.time_s, m.temperature_c)
        )

    fast = Measurements(
        tuple(map(at_1_khz, known.fit)), tuple(map(at_1_khz, known.validation))
    )
    (slow_press,), (fast_press,) = (
        planned(case, m, "touch_lag", "touch_delay", of=("taps",)).planned
        for m in (known, fast)
    )
    assert (slow_press.made.rate_hz, fast_press.made.rate_hz) == (
        pytest.approx(100.0),
        pytest.approx(200.0),
    )
    slow_s, fast_s = (
        (len(p.made.target) - 1) / p.made.rate_hz for p in (slow_press, fast_press)
    )
    assert fast_s == pytest.approx(slow_s, abs=0.1) == pytest.approx(9.5, abs=0.1)


def test_one_cell_alone_is_for_cells_with_loads_of_their_own():
    case = draw_cells("taxel_crosstalk", 4)
    found = planned(
        case,
        simulated(case),
        "taxel_crosstalk",
        "taxel_saturation",
        of=("three_loads", "one_cell"),
    )
    alone = next(p for p in found.planned if p.name == "one_cell")
    assert (alone.made.target.max(axis=0) > 0).sum() == 1
    both = next(p for p in found.planned if p.name == "three_loads")
    assert (both.made.target == both.made.target[:, :1]).all()
    assert alone.worst > TELLS

    shared = draw_cells("taxel_creep", 3)
    found = planned(
        shared, simulated(shared), "taxel_creep", "touch_lag", of=("one_cell", "taps")
    )
    assert [p.name for p in found.planned] == ["taps"]


def test_rivals_must_act_on_the_sensor(pressed):
    case, known = pressed
    with pytest.raises(TaccorlError, match="coulomb_friction"):
        planned(case, known, "taxel_creep", "coulomb_friction", of=("taps",))


def test_the_planned_press_settles_a_tie_of_independent_data():
    """A surrogate with a delay of 60 ms: slow presses alone do not show whether it is that or a lag, planned taps do."""
    from taccorl.diagnosis.machines.cells import CellsMachine
    from taccorl.surrogate import cells

    case = CellsCase(seed=5, hidden="touch_delay", values={"delay_s": 0.06})
    slow, taps = cells._presses((0.4, 3.0, 2.0), (0.9, 4.0, 2.0)), OF_NAME["taps"].knots
    names = {
        "slow": ("fit", slow),
        "slow_again": ("fit", slow),
        "other": ("validation", slow),
        "taps": ("fit", taps),
    }
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cells, "RECORDINGS", names | {"taps_too": ("validation", taps)})
        recorded = {name: cells.record(case, name) for name in cells.RECORDINGS}
    recorded["slow_again"] = dataclasses.replace(
        recorded["slow_again"], repeat_of="slow"
    )
    machine = CellsMachine(case.config())
    before = Measurements(
        (recorded["slow"], recorded["slow_again"]), (recorded["other"],)
    )
    after = Measurements(
        (*before.fit, recorded["taps"]), (*before.validation, recorded["taps_too"])
    )
    tied, settled = (
        machine.diagnose(machine.config.name, m).diagnosis for m in (before, after)
    )
    assert settled.names == ("touch_delay",) and not settled.rivals.get("touch_delay")
    ((first, others),) = tied.rivals.items()
    assert {"touch_lag", "touch_delay"} <= {first, *others}

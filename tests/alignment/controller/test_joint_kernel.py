"""The compiled one-joint model: its vectorised functions, simulations side by side that must not mix, compilation anew."""

import math
import shutil
import sys
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest

from taccorl.alignment.controller import lanes
from taccorl.alignment.controller.drive_numbers import Drive
from taccorl.alignment.controller.joint_kernel import simulate, simulate_all
from tests.fresh_python import ROOT, printed

ROWS = 200
SENT = 0.3 * np.sin(0.1 * np.arange(ROWS))
NONE, ONES = np.zeros(ROWS), np.ones(ROWS)
MORE: tuple[Any, ...] = (NONE, ONES, ONES, NONE, 0.0, 5, 1, 0.001, 0.0)
"""Of ``simulate``: nothing carried or added, the whole supply, always on, from rest at 0, five steps of 1 ms a row."""
JOINT = {"kp": 30.0, "kd": 1.0, "torque_ff": 0.0, "inertia": 0.1}
SWING = """from tests.alignment.controller.test_joint_kernel import *
steep = {"power_law_friction__torque_nm": 1.0, "power_law_friction__exponent": 1.5}
print(np.ptp(simulate(Drive(**JOINT, **steep), SENT, NONE, *MORE)[0]))"""


@numba.njit
def _of_lanes(x: np.ndarray, exponent: np.ndarray, found: np.ndarray) -> None:
    value = lanes.load(x, 0)
    sine, cosine = lanes.sine_and_cosine(value)
    kept, share = lanes.decayed(value)
    lanes.store(found, 0, sine)
    lanes.store(found, 1, cosine)
    lanes.store(found, 2, kept)
    lanes.store(found, 3, share)
    lanes.store(found, 4, lanes.power(abs(value), lanes.load(exponent, 0)))


def test_functions_of_lanes_are_those_of_math() -> None:
    rng, far = np.random.default_rng(0), np.zeros(5)
    for scale in (1e-9, 1e-3, 0.1, 1.0, 10.0):
        for _ in range(200):
            x, exponent = (
                scale * rng.uniform(-1, 1, (1, lanes.LANES)),
                rng.uniform(0.1, 3.0, (1, lanes.LANES)),
            )
            found = np.empty((5, lanes.LANES))
            _of_lanes(x, exponent, found)
            for k, (v, e) in enumerate(zip(x[0], exponent[0], strict=True)):
                share = (
                    -math.expm1(-v) / v if v > 0 else math.nan
                )  # not stated for x < 0
                grown = abs(v) ** e * (1 + abs(e * math.log(abs(v))))
                errors = found[:, k] - (
                    math.sin(v),
                    math.cos(v),
                    math.exp(-v),
                    share,
                    abs(v) ** e,
                )
                far = np.fmax(far, abs(errors) / (1.0, 1.0, math.exp(-v), share, grown))
    assert (far[:3] < 1e-15).all() and far[3] < 1e-12 and far[4] < 1e-15, far


def test_a_lane_does_not_depend_on_the_others() -> None:
    """Fourteen joints: eight, then six whose other lanes are filled; each with other effects, some without any."""
    effects: list[dict[str, float]] = [
        {},
        {"coulomb_friction__torque_nm": 0.5},
        {"soft_friction__torque_nm": 0.5},
        {"soft_friction__torque_nm": 0.4, "coulomb_friction__torque_nm": 0.1},
        {"stribeck_friction__torque_nm": 0.5, "stribeck_friction__stiction_share": 0.5},
        {"command_delay__delay_s": 0.0123},
        {"sensor_delay__delay_s": 0.004},
        {"cogging__torque_nm": 0.2},
        {"power_law_friction__torque_nm": 0.4, "power_law_friction__exponent": 1.3},
        {"load_friction__share": 0.2, "gravity_cos": 1.0},
        {"gear_friction__share": 0.2, "gravity_cos": 1.0},
        {"torque_lag__time_constant_s": 0.01},
        {"integral_action__rate_per_s": 2.0},
        {"position_integral__rate_per_s": 5.0},
        {"end_stop__stiffness_nm_per_rad": 200.0, "end_stop__angle_rad": 0.2},
    ]
    drives = [Drive(**(JOINT | effect)) for effect in effects]
    couplings = [np.full(ROWS, 0.01 * k) for k in range(len(drives))]
    together = simulate_all(drives, SENT, couplings, *MORE, 0)
    for drive, coupling, (reported, effort) in zip(
        drives, couplings, together, strict=True
    ):
        alone = simulate(drive, SENT, coupling, *MORE)
        assert np.allclose(alone[0], reported, rtol=0, atol=1e-12) and np.allclose(
            alone[1], effort, rtol=0, atol=1e-9
        )
    apart = [np.ptp(reported) for reported, _ in together]
    assert len({round(float(one), 9) for one in apart}) == len(
        apart
    )  # each effect does something


COGS = {"cogging__torque_nm": 5.0, "cogging__periods": 30.0}


@pytest.mark.parametrize(
    "effect",
    [
        {"torque_saturation__torque_max_nm": 10.0},
        {"load_friction__share": 0.2},
        {"gear_friction__share": 0.2},
        COGS,
    ],
)
def test_steps_of_half_a_millisecond_are_nearly_as_good_as_those_of_a_twentieth(
    effect: dict[str, float],
) -> None:
    sent, none, ones = (
        0.3 * np.sin(0.02 * np.arange(1000)),
        np.zeros(1000),
        np.ones(1000),
    )
    drive, more = (
        Drive(400.0, 10.0, 0.0, 0.1, gravity_cos=3.0, midpoint=1.0, **effect),
        (none, none, ones, ones, none),
    )
    half, fine = (
        simulate(drive, sent, *more, 0.0, n, 1, 1e-3 / n, 0.0)[0] for n in (2, 20)
    )
    assert np.std(half - fine) < 1.1e-4, "of 0.3 rad at 3.2 Hz"


@pytest.mark.slow
def test_a_change_of_an_imported_source_reaches_the_compiled_kernel(
    tmp_path: Path,
) -> None:
    """The speed at which a power-law friction is stated, a tenth of it in a copy whose compiled kernel is kept."""
    for folder in ("taccorl", "tests/alignment/controller"):
        shutil.copytree(
            ROOT / folder,
            tmp_path / folder,
            ignore=shutil.ignore_patterns("__pycache__"),
        )
    for name in ("tests/__init__.py", "tests/fresh_python.py"):
        shutil.copy2(ROOT / name, tmp_path / name)

    def swing() -> float:
        where = {
            "NUMBA_CACHE_DIR": str(tmp_path / "cache"),
            "PYTHONPATH": str(tmp_path),
        }
        return float(printed(sys.executable, "-c", SWING, cwd=tmp_path, **where))

    before, source = swing(), tmp_path / "taccorl/sim/effects/friction.py"
    source.write_text(
        source.read_text().replace("\nAT_RAD_PER_S = 0.1\n", "\nAT_RAD_PER_S = 0.01\n")
    )
    assert swing() < 0.8 * before  # thirty times the friction


def test_a_row_shows_the_effort_before_its_target_however_early_that_acts() -> None:
    """The target steps by 0.1 rad at row 100 and acts 0.3 ms early: 3 N·m / 0.1 kg·m² for
    that time make 9 mrad/s, of which K_d makes 0.009 N·m. Its own 0.3 of 3 N·m is not shown."""
    sent = np.where(np.arange(ROWS) < 100, 0.0, 0.1)
    early = {"command_delay__delay_s": -3e-4}
    drives = [Drive(**JOINT, midpoint=1.0, **more) for more in (early, {})]
    (_, shown), (_, punctual) = simulate_all(drives, sent, [NONE] * 2, *MORE, 0)
    assert punctual[100] == 0.0 and -0.02 < shown[100] < 0.0
    assert shown[101] == pytest.approx(punctual[101], rel=0.05)
    after = [drive._replace(effort_after=1.0) for drive in drives]
    (_, shown), (_, punctual) = simulate_all(after, sent, [NONE] * 2, *MORE, 0)
    assert shown[99] == punctual[99] == 0.0
    assert shown[100] == pytest.approx(punctual[100], abs=0.02) and punctual[100] == 3.0

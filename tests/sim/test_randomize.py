"""The paper's table of domain randomisation, row by row."""

import math

import numpy as np
import pytest

from taccorl.sim.randomize import Row, draw
from taccorl.sim.task import tasks

DEG = math.pi / 180
TABLE = {  # half ranges, as printed in the paper's appendix E
    "assembly_1": {"plug_position": 0.03, "socket_position": 0.03, "plug_mass": 0.03, "socket_mass": 0.03},
    "assembly_2": {"plug_position": 0.03, "socket_position": 0.03, "plug_mass": 0.03, "socket_mass": 0.03},
    "puzzle": {
        "tray_position": 0.005,
        "tray_yaw": 5 * DEG,
        **{f"{piece}_position": 0.01 for piece in ("circle", "heart", "triangle")},
        **{f"{piece}_yaw": 10 * DEG for piece in ("circle", "heart", "triangle")},
        "circle_support": (0.03, 0.03),
        "heart_support": (0.03, 0.027),
        "triangle_support": (0.03, 0.027),
    },
    "test_tube": {"tube_position": 0.02, "tube_yaw": 20 * DEG, "holder_position": 0.005},
}


@pytest.mark.parametrize("task", TABLE)
def test_rows_are_the_paper_s(task):
    rows = {row.name: row for row in tasks.get(task).rows}
    assert (rows.pop("friction").low, tasks.get(task).rows[0].high) == ((0.3,), (0.7,))
    assert set(rows) == set(TABLE[task])
    for name, half in TABLE[task].items():
        np.testing.assert_allclose(rows[name].high, np.broadcast_to(half, len(rows[name].high)))
        np.testing.assert_allclose(rows[name].low, -np.array(rows[name].high))
        assert rows[name].probability == 1.0


def test_draws_fill_their_range_and_never_leave_it():
    rng = np.random.default_rng(0)
    frictions = np.array([draw(tasks.get("test_tube").rows, rng)["friction"][0] for _ in range(2000)])
    assert 0.3 <= frictions.min() < 0.301
    assert 0.699 < frictions.max() <= 0.7
    assert frictions.mean() == pytest.approx(0.5, abs=3 * 0.4 / math.sqrt(12 * 2000))  # three standard errors


def test_scale_zero_is_the_nominal_scene_and_one_half_halves_the_spread():
    rows = tasks.get("puzzle").rows
    whole, half, none = (draw(rows, np.random.default_rng(5), scale) for scale in (1.0, 0.5, 0.0))
    for row in rows:
        np.testing.assert_allclose(none[row.name], row.absent)
        np.testing.assert_allclose(half[row.name] - row.absent, 0.5 * (whole[row.name] - row.absent), atol=1e-15)


def test_a_row_that_is_not_drawn_does_not_move_the_rows_after_it():
    def rows(probability: float) -> tuple[Row, ...]:
        first = Row(name="first", low=(0.0,), high=(1.0,), unit="1", probability=probability)
        return (first, Row(name="second", low=(0.0,), high=(1.0,), unit="1"))

    never, always = (draw(rows(p), np.random.default_rng(1)) for p in (0.0, 1.0))
    assert never["first"] == 0.5  # the middle
    assert always["first"] != 0.5
    assert never["second"] == always["second"]

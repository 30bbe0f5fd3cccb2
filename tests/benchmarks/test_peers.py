"""The arm that contestants fit, and how their answers become rows."""

import json
from pathlib import Path

import numpy as np
import pytest

from pipelines.benchmarks import peer_fits
from pipelines.benchmarks.peers import Arm, Outcome, rows_of, steps, targets


def outcome(*named: str, floors: float, fit_s: float) -> Outcome:
    return Outcome({}, frozenset(named), floors, fit_s, 1.0, 0.5 * fit_s)


def test_rows_are_ratios_to_each_peer_and_shares_of_right_names() -> None:
    """3 over 6 CPU-s, 1.0 over 2.0 floors; one of two arms is named right."""
    right = {
        "taccorl": outcome("frictionloss", floors=1.0, fit_s=3.0),
        "sysid": outcome("frictionloss", "damping", floors=2.0, fit_s=6.0),
        "scipy": outcome(floors=4.0, fit_s=12.0),
    }
    wrong = right | {"taccorl": outcome("backlash", floors=1.0, fit_s=3.0)}
    rows = {
        row.name: row
        for row in rows_of({Arm("friction", 0): right, Arm("friction", 1): wrong})
    }
    cost = rows["friction: CPU-s of diagnose over sysid's, without imports"]
    assert (cost.value, cost.n, cost.rival_value) == (0.5, 2, 6.0)
    assert rows["friction: CPU-s of its search alone over sysid's"].value == 0.25
    assert rows["friction: error on held-out motions over scipy's"].value == 0.25
    name = "arms of which {} names what is hidden and nothing else"
    shares = [rows[name.format(who)].value for who in ("taccorl", "sysid", "scipy")]
    assert shares == [50.0, 0.0, 0.0]


def test_a_hidden_delay_moves_the_answer_by_itself() -> None:
    arm = Arm("delay", 0)
    target = targets(0.3 * np.sin(np.linspace(0.0, 6.0, 400)) ** 2)
    plain, late = arm.move(target, arm.gains), arm.move(target, arm.gains | arm.hidden)
    rows_s = np.arange(len(target)) / peer_fits.RATE_HZ
    shifted = np.interp(rows_s - 0.0248, rows_s, plain[:, peer_fits.ELBOW])
    assert late[:, peer_fits.ELBOW] == pytest.approx(shifted, abs=5e-5)
    assert np.ptp(plain[:, peer_fits.ELBOW]) > 0.2


def test_levels_are_reached_at_four_radians_a_second() -> None:
    rows = steps((0.0, 0.2, -0.2))
    assert len(rows) == 3 * peer_fits.RATE_HZ
    assert rows[199] == 0.0 and rows[210] == pytest.approx(0.2)
    assert rows[399] == pytest.approx(0.2) and rows[-1] == pytest.approx(-0.2)


@pytest.mark.parametrize("case", ["clean", "soft friction and damping"])
def test_the_user_s_files_state_nothing_that_is_hidden(
    case: str, tmp_path: Path
) -> None:
    arm = Arm(case, 0)
    folder = tmp_path / "arm"
    arm.write(folder)
    text = (folder / "arm.xml").read_text() + (folder / "arm.yaml").read_text()
    for value in arm.hidden.values():
        assert f"{value:.3g}" not in text
    stated = json.loads((folder / "gains.json").read_text())
    assert (stated["kp"] == arm.gains["kp"]) == (case != "clean")
    assert len(peer_fits.recorded(folder)) == 3

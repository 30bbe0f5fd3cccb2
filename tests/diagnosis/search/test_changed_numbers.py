"""Wrong numbers of a machine's file: named with old and new value, and with the error that the old one leaves."""

import dataclasses
import math
from typing import Any, ClassVar

import numpy as np
import pytest
from made_problem import Bump, Hidden, MadeProblem, Ripple, Square, Squire, record

from taccorl.diagnosis.search.changed_numbers import STATED
from taccorl.diagnosis.search.result import Diagnosis
from taccorl.diagnosis.search.search import diagnose
from taccorl.sim.effects.effect import number

NOISE = 0.1  # one floor


def found(*classes: Any, hidden: list[Any], stated: dict[str, float]) -> Diagnosis:
    recordings = [record(k, *hidden, noise=NOISE) for k in range(3)]
    present = tuple(dict.fromkeys(name.split(".")[0] for name in stated if "." in name))
    start = {"gain": 3.0, "offset": 0.4, **stated}
    return diagnose(
        MadeProblem(*classes),
        recordings[:1],
        recordings[1:2],
        recordings[2:],
        start=start,
        present=present,
    )


def test_a_wrong_strength_in_the_file_is_the_result_and_not_nothing():
    """The file has a ripple of 0.5, the recordings 2.0: 1.5 sin(40 t) is left, an RMS of 1.5 / √2 beside the noise."""
    d = found(
        Ripple, Square, hidden=[Ripple(strength=2.0)], stated={"ripple.strength": 0.5}
    )
    assert d.status == "numbers_off" and d.names == d.present == ("ripple",)
    (c,) = d.changed
    assert (c.name, c.effect, c.before) == ("ripple.strength", "ripple", 0.5)
    low, high = d.intervals["ripple.strength"]
    assert low < 2.0 < high and c.after == d.after.values[
        "ripple.strength"
    ] == pytest.approx(2.0, abs=0.02)
    assert c.without == pytest.approx(
        math.hypot(1.5 / math.sqrt(2.0) / NOISE, 1.0), rel=0.02
    )
    assert d.errors["before"]["validation"] == pytest.approx(c.without, rel=0.02)


@pytest.mark.parametrize("stated", [2.0, 1.99])
def test_a_right_strength_is_not_named(stated: float):
    """0.01 sin(40 t) is an RMS of 0.07 floors."""
    d = found(
        Ripple,
        Square,
        hidden=[Ripple(strength=2.0)],
        stated={"ripple.strength": stated},
    )
    assert d.status == "nothing_missing" and d.changed == ()


def test_of_two_numbers_that_make_up_for_each_other_one_is_named_and_a_right_one_beside_them_is_not():
    """Together 3 of one signal are recorded, and the file has 1 + 0; its ripple is right."""
    stated = {
        "ripple.strength": 1.0,
        "square.strength": 1.0,
        "squire.strength": 0.0,
        "squire.idle": 1.0,
    }
    d = found(
        Ripple,
        Square,
        Squire,
        hidden=[Ripple(strength=1.0), Square(strength=3.0)],
        stated=stated,
    )
    assert d.status == "numbers_off"
    named = {c.effect for c in d.changed}
    assert len(named) == 1 and named < {"square", "squire"}
    total = d.after.values["square.strength"] + d.after.values["squire.strength"]
    assert total == pytest.approx(3.0, abs=0.02)


def test_an_effect_that_is_missing_and_a_wrong_number_of_the_file_are_told_apart():
    d = found(
        Ripple,
        Bump,
        hidden=[Ripple(strength=2.0), Bump(strength=3.0)],
        stated={"ripple.strength": 0.5},
    )
    assert d.names == ("ripple", "bump") and d.status == "at_floor"
    assert [c.name for c in d.changed] == ["ripple.strength"]
    # 1.5 sin(40 t) is left beside the bump and the noise
    left = math.hypot(1.5 / math.sqrt(2.0) / NOISE, 1.0)
    assert d.changed[0].without == pytest.approx(left, rel=0.02)
    right = found(
        Ripple,
        Bump,
        hidden=[Ripple(strength=2.0), Bump(strength=3.0)],
        stated={"ripple.strength": 2.0},
    )
    assert right.names == ("ripple", "bump") and right.changed == ()


@dataclasses.dataclass(kw_only=True)
class Bristled(Ripple):
    """A ripple that may have a slower bump of its own."""

    name: ClassVar = "bristled"
    optional: ClassVar = {"bent": ""}
    bent: float = number("b", "1", 0, 1.0, (0, 50), "made up")

    def signal(self, t: np.ndarray, seed: int) -> np.ndarray:
        return np.sin(40.0 * t + seed) + self.bent * np.exp(-(((t - 0.6) / 0.2) ** 2))


def test_a_number_that_only_one_of_the_fits_has_is_judged_by_the_value_that_the_other_one_has():
    """The file's ripple has no bump of its own. It takes one until the real bump is there, and then none, as the file says."""
    hidden = [Bristled(strength=2.0), Bump(strength=6.0)]
    d = found(
        Bristled,
        Bump,
        hidden=hidden,
        stated={"bristled.strength": 0.5, "bristled.bent": 0.0},
    )
    assert set(d.names) == {"bristled", "bump"} and [c.name for c in d.changed] == [
        "bristled.strength"
    ]


def test_a_number_of_the_drive_that_moved_is_named(monkeypatch: pytest.MonkeyPatch):
    """The recordings have a gain of 3, the file 2."""
    monkeypatch.setitem(STATED, "gain", "gain")
    d = found(Ripple, Hidden, hidden=[], stated={"gain": 2.0})
    (c,) = d.changed
    assert (d.status, d.names) == ("numbers_off", ())
    assert (c.name, c.before) == ("gain", 2.0)
    assert c.after == pytest.approx(3.0, abs=0.01)

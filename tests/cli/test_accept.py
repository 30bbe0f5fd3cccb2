"""What stops a verb that reads measurements, and the one option that accepts all of it."""

from typing import Any

import numpy as np
import pytest
from made_traces import comparison, trace

from taccorl.cli import measured
from taccorl.cli.measured import OTHER_GAINS, of_asked, recordings_with_errors, refusal
from taccorl.data.finding import Finding

PARTS = ("shoulder", "elbow")
FOUND = [
    Finding("wrong_inertia", "error", "shoulder", "another inertia"),
    Finding("frozen_channel", "error", "elbow", "the same rows"),
    Finding("uneven", "error", "time", "rows go back"),
    Finding("jitter", "warning", "time", "rows differ"),
]


@pytest.mark.parametrize(
    ("only", "errors"),
    [
        ((), ["wrong_inertia", "frozen_channel", "uneven"]),
        (("elbow",), ["frozen_channel", "uneven"]),
        (("shoulder",), ["wrong_inertia", "frozen_channel", "uneven"]),
        (PARTS, ["wrong_inertia", "frozen_channel", "uneven"]),
    ],
)
def test_errors_of_the_efforts_of_joints_that_are_not_asked_for_are_warnings(
    only, errors
):
    judged = of_asked(FOUND, only, PARTS)
    assert [f.check for f in judged if f.severity == "error"] == errors
    assert [f.check for f in judged] == [f.check for f in FOUND], "none is dropped"


def test_one_option_accepts_all_that_stops_a_verb():
    gains = Finding(OTHER_GAINS, "warning", "elbow", "other gains")
    found = {"a.csv": FOUND[:1], "b.csv": [FOUND[1], FOUND[3], gains], "c.csv": []}
    assert recordings_with_errors(found) == ["a.csv", "b.csv"]
    line = refusal("not diagnosed", ["a.csv", "b.csv"], found)
    option = f"--accept=wrong_inertia,frozen_channel,{OTHER_GAINS}"
    assert line.endswith(option) and line.startswith("not diagnosed: ")


def test_errors_before_and_of_the_replay_are_accepted_at_once(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """Rows that stand still are found before the replay, late positions by it."""
    position = 0.3 * np.sin(np.arange(400) / 30)
    late = Finding("shifted_from_twin", "error", "elbow", "leads by 6 rows")
    replay = comparison(trace(0 * position, position), clock={"a.csv": (late,)})
    before = {"a.csv": [FOUND[1]]}
    monkeypatch.setattr(measured, "checked", lambda *args: before)
    made: Any = None
    assert measured.replayed(made, made, "not compared", (), lambda: replay) is None
    shown = capsys.readouterr().out.rstrip()
    assert shown.endswith("--accept=frozen_channel,shifted_from_twin")

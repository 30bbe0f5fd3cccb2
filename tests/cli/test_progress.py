"""What verbs print while they work."""

import pickle

from taccorl.cli import progress as tables


def test_progress_without_a_terminal_is_a_line_now_and_then_with_rate_and_time_left(monkeypatch, capsys) -> None:
    now_s = 100.0
    monkeypatch.setattr(tables.time, "monotonic", lambda: now_s)
    with tables.Bars(2) as bars:
        for second in range(13):  # 50 rows a second
            now_s = 100.0 + second
            bars.update("a.mcap", 50 * second, 1000)
        now_s = 117.0
        bars.update("b.mcap", 0, 400)
    lines = capsys.readouterr().err.splitlines()
    assert lines == [
        "a.mcap: 250 of 1000, 50/s, 15 s left",  # 750 rows at 50/s
        "a.mcap: 500 of 1000, 50/s, 10 s left",
        "b.mcap: 0 of 400",
    ]


def test_steps_of_a_search_are_a_line_now_and_then_also_from_another_process(monkeypatch, capsys) -> None:
    now_s = 100.0
    monkeypatch.setattr(tables.time, "monotonic", lambda: now_s)
    steps = pickle.loads(pickle.dumps(tables.Steps()))
    for second in (1, 4, 6, 8, 12):
        now_s = 100.0 + second
        steps("elbow", f"step {second}")
    assert capsys.readouterr().err.splitlines() == ["elbow: step 6 (6 s)", "elbow: step 12 (12 s)"]

"""A comparison as an .rrd file, read back with Rerun's own reader: its lines are the comparison's numbers."""

from pathlib import Path

import numpy as np
from made_traces import FLOOR_RAD, ORIGIN, comparison, swing, trace
from rerun.experimental import RrdReader

from taccorl.diagnosis.comparison.result import Comparison, TouchTrace
from taccorl.views.compare_view import MOST_ROWS, comparison_blueprint, save_comparison

_, POSITION = swing(seconds=3.0)
LEFT = np.where(np.gradient(POSITION) >= 0, 2e-3, -2e-3)


def read(path: Path) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Entity path → (times [s], scalars) of what changes over time."""
    found: dict[str, list[tuple[float, float]]] = {}
    for chunk in RrdReader(path).store().stream():
        batch = chunk.to_record_batch()
        if chunk.is_static or "Scalars:scalars" not in batch.schema.names:
            continue
        times_s = batch.column("time").cast("int64").to_numpy() / 1e9
        values = [v[0] for v in batch.column("Scalars:scalars").to_pylist()]
        found.setdefault(chunk.entity_path, []).extend(zip(times_s, values, strict=True))
    return {name: tuple(np.array(sorted(rows)).T) for name, rows in found.items()}  # pyright: ignore[reportReturnType]


def touch() -> TouchTrace:
    measured = np.zeros((50, 2, 32, 12))
    measured[10:40, 1, 5:9, 2:6] = 60
    return TouchTrace(
        recording="press 1.mcap",
        use="validation",
        pads=("left_a", "left_b"),
        time_s=np.tile((np.arange(50) / 100)[:, None], (1, 2)),
        measured=measured,
        replayed=measured * 0.9,
        floor=np.full((2, 32, 12), 1.3),
        origin=ORIGIN,
    )


def pair() -> tuple[Comparison, Comparison]:
    measured = POSITION.copy()
    measured[100:150] = np.nan
    fields = {"measured": measured, "recording": "sweep 1.mcap"}
    return (
        comparison(trace(LEFT, POSITION, **fields), touches=(touch(),)),
        comparison(trace(0.1 * LEFT, POSITION, **fields), touches=(touch(),), twin="corrected twin"),
    )


def test_lines_are_the_comparison_s_numbers(tmp_path: Path):
    before, after = pair()
    save_comparison(before, tmp_path / "x.rrd", after)
    found = read(tmp_path / "x.rrd")
    path, known = "/sweep_1_mcap/left_joint5/position", np.isfinite(before.traces[0].measured)
    for name, expected in (
        (f"{path}/command", POSITION),
        (f"{path}/measured", POSITION[known]),
        (f"{path}/twin", POSITION - LEFT),
        (f"{path}/corrected", POSITION - 0.1 * LEFT),
        (f"{path}/residual/twin", 1e3 * LEFT[known]),  # mrad
        (f"{path}/residual/corrected", 1e2 * LEFT[known]),
        (f"{path}/residual/floor_high", [2e3 * FLOOR_RAD] * 2),
        (f"{path}/residual/floor_low", [-2e3 * FLOOR_RAD] * 2),
    ):
        np.testing.assert_allclose(found[name][1], expected, rtol=1e-9, atol=1e-12, err_msg=name)
    np.testing.assert_allclose(found[f"{path}/measured"][0], before.traces[0].time_s[known], atol=1e-9)


def test_file_says_where_its_data_is_from_and_shows_the_pads(tmp_path: Path):
    before, after = pair()
    save_comparison(before, tmp_path / "x.rrd", after)
    text, images = "", {}
    for chunk in RrdReader(tmp_path / "x.rrd").store().stream():
        batch = chunk.to_record_batch()
        if "TextDocument:text" in batch.schema.names:
            text = batch.column("TextDocument:text").to_pylist()[0][0]
        if "DepthImage:buffer" in batch.schema.names:
            images[chunk.entity_path] = batch.column("DepthImage:buffer").to_pylist()
    assert text.startswith(f"**data: {ORIGIN}**") and "corrected twin" in text and "2 mrad" in text
    assert set(images) == {f"/press_1_mcap/touch/{name}" for name in ("measured", "twin", "corrected")}
    frame = np.array(images["/press_1_mcap/touch/measured"][20][0], np.uint8).view(np.uint16).reshape(32, 2 * 12 + 3)
    np.testing.assert_array_equal(frame[:, 15:], touch().measured[20, 1])


def test_many_recordings_are_spread_over_tabs():
    traces = [trace(LEFT, POSITION, recording=f"sweep_{k}") for k in range(2 * MOST_ROWS + 1)]
    tabs = comparison_blueprint(comparison(*traces)).root_container
    assert len(tabs.contents) == 3 + 1  # three tabs of curves and the provenance

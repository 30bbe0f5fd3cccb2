"""Two episodes on one time line: what is logged is read back, with times, differences and colours known beforehand.

Touch of a made episode is gripped from 40 % of its rows on. A has 90 rows at 30 rows a second; B 40 rows at 10 rows a second.
"""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import rerun.blueprint as rrb
from made_traces import FLOOR_RAD, comparison, swing, trace
from made_traces import ORIGIN as OF_TRACES
from rerun.experimental import RrdReader

from taccorl.data.episode import Episode
from taccorl.data.origin import Origin
from taccorl.diagnosis.comparison.result import Comparison, TouchTrace
from taccorl.errors import TaccorlError
from taccorl.views.colors import PAIR_COLORS
from taccorl.views.compare_view import MOST_ROWS, comparison_blueprint, save_comparison
from taccorl.views.pair import Align, Pair, page_of
from taccorl.views.pair_view import difference_colors, pair_blueprint, save_shown
from taccorl.views.screenshot import screenshot
from taccorl.views.touch import contact_gate, pads_of

from .made_episode import ORIGIN, TOUCH, made_episode, without
from .readback import Column, read_rrd
from .regions import contents
from .test_episode_in_rerun import assert_no_view_is_empty, views
from .test_screenshot import TABLE, needs_vulkan, share

TWIN = Origin("twin", "MuJoCo twin, not a robot")
Logged = dict[str, dict[str, Column]]


def slower(num_rows: int = 40, fps: int = 10) -> Episode:
    """B: another length and rate, the same features."""
    other = made_episode(num_rows, picture_size=64)
    return dataclasses.replace(
        other,
        name="twin, episode 3",
        spec=dataclasses.replace(other.spec, fps=fps),
        origin=TWIN,
    )


A, B = made_episode(90, picture_size=64), slower()


def logged(pair: Pair, folder: Path, at_s: float | None = None) -> Logged:
    save_shown(pair, folder / "pair.rrd", at_s=at_s)
    return read_rrd(folder / "pair.rrd")


@pytest.mark.parametrize("align", ["start", "contact"])
def test_row_0_or_the_first_contact_of_both_is_at_0_s(align: Align, tmp_path: Path):
    found = logged(Pair(A, B, align), tmp_path)
    for root, episode in (("a", A), ("b", B)):
        contact_s = float(
            episode.time_s[np.flatnonzero(contact_gate(pads_of(episode)))[0]]
        )
        assert contact_s > 0.9  # at 40 % of 3 s and of 4 s
        expected = episode.time_s - (contact_s if align == "contact" else 0.0)
        for path in (
            "curves/observation/state/left_joint_1_rad",
            "observation/images/front",
            "touch/sum/left_a",
        ):
            column = next(c for c in found[f"/{root}/{path}"].values() if len(c.time_s))
            np.testing.assert_allclose(column.time_s, expected, atol=1e-8)
        gate = found[f"/{root}/events/contact_gate"]["StateChange:state"]
        opened = gate.time_s[[v[0] for v in gate.values].index("contact")]
        assert opened == pytest.approx(
            0.0 if align == "contact" else contact_s, abs=1e-8
        )


def test_difference_is_b_minus_a_at_the_newest_row_of_b(tmp_path: Path):
    """A: 10 counts everywhere. B: 10 + 20 · row on left_a, at a third of A's rate: 20 · ⌊row of A / 3⌋ is the difference."""
    counts_a = np.full((90, 4, 32, 12), 10, np.int16)
    counts_b = np.repeat(
        np.repeat(10 + 20 * np.arange(8, dtype=np.int16)[:, None, None], 32, axis=1),
        12,
        axis=2,
    )
    counts_b = np.stack([counts_b, *[np.full((8, 32, 12), 10, np.int16)] * 3], axis=1)
    a = dataclasses.replace(A, arrays=A.arrays | {TOUCH: counts_a.reshape(90, -1)})
    b = slower(8)
    b = dataclasses.replace(b, arrays=b.arrays | {TOUCH: counts_b.reshape(8, -1)})
    pair = Pair(a, b)
    assert pair.full_difference == 140.0  # row 7 of B
    images = logged(pair, tmp_path)["/difference/pads/left_a"]["Image:buffer"]
    np.testing.assert_allclose(
        images.time_s, np.arange(24) / 30, atol=1e-8
    )  # B lasts 0.8 s
    shown = np.array([np.array(v[0], np.uint8) for v in images.values]).reshape(
        24, 32, 12, 3
    )
    for row, image in enumerate(shown):
        np.testing.assert_array_equal(
            image,
            np.broadcast_to(difference_colors(np.array(row // 3 / 7)), (32, 12, 3)),
        )
    np.testing.assert_array_equal(shown[-1, 0, 0], PAIR_COLORS[1])


def test_differences_have_the_colour_of_the_one_that_has_more():
    colors = difference_colors(np.array([-2.0, -1.0, 0.0, 0.5, 1.0]))
    np.testing.assert_array_equal(
        colors[[0, 1, 4]], [PAIR_COLORS[0], PAIR_COLORS[0], PAIR_COLORS[1]]
    )
    np.testing.assert_allclose(
        colors[3], (colors[2] + np.array(PAIR_COLORS[1])) / 2, atol=0.5
    )


def test_every_joint_has_one_plot_with_state_and_action_of_both(tmp_path: Path):
    found = logged(Pair(A, B), tmp_path)
    plots = {
        v.name: v
        for v in views(pair_blueprint(Pair(A, B)).root_container)
        if isinstance(v, rrb.TimeSeriesView)
    }
    for i, name in enumerate(("left_joint_1 [rad]", "left_joint_2 [rad]")):
        entities = [str(c) for c in plots[name].contents]
        assert len(entities) == 4
        for entity, episode, key in zip(
            entities,
            (A, A, B, B),
            ("observation.state", "action", "observation.state", "action"),
            strict=True,
        ):
            values = np.array(
                found[entity]["Scalars:scalars"].values, dtype=np.float32
            )[:, 0]
            np.testing.assert_array_equal(values, episode.arrays[key][:, i])
        names = [found[e]["SeriesLines:names"].values[0][0] for e in entities]
        assert names == ["A", "A action", "B", "B action"]
        colors = {found[e]["SeriesLines:colors"].values[0][0] >> 8 for e in entities}
        assert colors == {(r << 16) + (g << 8) + b for r, g, b in PAIR_COLORS}
    assert len([n for n in plots if "joint" in n or "gripper" in n]) == 14


def test_what_one_lacks_is_said_and_the_rest_is_shown_together(tmp_path: Path):
    """B: no wrist cameras, no touch, the left arm in degrees and no right arm."""
    bare = without(
        B, TOUCH, "observation.images.left_wrist", "observation.images.right_wrist"
    )
    state = dataclasses.replace(
        bare.spec.features["observation.state"],
        shape=(7,),
        names=(*(f"left_joint_{i}.pos" for i in range(1, 7)), "left_gripper.pos"),
        unit=("deg",) * 6 + ("m",),
        range=(-999.0, 999.0),
    )
    spec = dataclasses.replace(
        bare.spec,
        features={**bare.spec.features, "observation.state": state, "action": state},
    )
    arrays = {
        key: np.ascontiguousarray(values[:, :7]) for key, values in bare.arrays.items()
    }
    pair = Pair(A, dataclasses.replace(bare, spec=spec, arrays=arrays))
    names = assert_no_view_is_empty(logged(pair, tmp_path), pair_blueprint(pair))
    assert {
        "A front",
        "B front",
        "A left_wrist",
        "left_joint_1 [rad]",
        "left_joint_1 [deg]",
        "left_gripper [m]",
    } <= names
    assert "B left_wrist" not in names
    page = page_of(pair)
    for words in (
        "only in A: cameras left_wrist, right_wrist",
        "only in A: pads left_a, left_b, right_a, right_b",
        "only in A: curves left_joint_1 [rad], left_joint_2 [rad], left_joint_3 [rad], left_joint_4 [rad] and 9 more",
        "only in B: curves left_joint_1 [deg]",
    ):
        assert words in page, words
    assert (
        str(ORIGIN) in page
        and str(TWIN) in page
        and "first contact at" in page
        and "no touch" in page
    )


def test_pads_of_another_layout_are_not_subtracted(tmp_path: Path):
    sensor = dataclasses.replace(B.spec.sensors[TOUCH], gain_per_count=0.5)
    other = dataclasses.replace(
        B, spec=dataclasses.replace(B.spec, sensors={TOUCH: sensor})
    )
    pair = Pair(A, other)
    assert not [
        path for path in logged(pair, tmp_path) if path.startswith("/difference")
    ]
    assert (
        "no difference of right_b: A has 32 × 12, 0.01333 a count, B 32 × 12, 0.5 a count"
        in page_of(pair)
    )


def test_alignment_at_contact_is_refused_where_one_has_none():
    with pytest.raises(TaccorlError, match=r"twin, episode 3.*--align=start"):
        Pair(A, without(B, TOUCH), "contact")
    quiet = dataclasses.replace(
        B, arrays=B.arrays | {TOUCH: np.minimum(B.arrays[TOUCH], 30)}
    )
    with pytest.raises(
        TaccorlError,
        match=r"twin, episode 3: no taxel beyond 0\.4 \(30 counts\) in 40 rows",
    ):
        Pair(A, quiet, "contact")


def test_a_still_picture_needs_one_row_of_pictures_and_pads(tmp_path: Path):
    found = logged(Pair(A, B), tmp_path, at_s=1.84)  # row 55 of A, 18 of B
    for root, row_s in (("a", 55 / 30), ("b", 1.8), ("difference/pads", 55 / 30)):
        path = (
            f"/{root}/left_a"
            if "pads" in root
            else f"/{root}/observation/tactile/left_a"
        )
        (column,) = [c for name, c in found[path].items() if name.endswith("buffer")]
        np.testing.assert_allclose(column.time_s, [row_s], atol=1e-8)
    assert len(found["/a/observation/images/front"]["EncodedImage:blob"].values) == 1


@pytest.mark.slow
@needs_vulkan
def test_the_rerun_program_draws_both(tmp_path: Path):
    pair, png = Pair(made_episode(90), B), tmp_path / "pair.png"
    screenshot(pair, png)
    shown = contents(png, pair_blueprint(pair))
    for name in ("A front", "B front"):
        assert share(shown[name], TABLE) > 0.2, name
    row = round(30 * pair.best_time_s)  # A grips firmly, B not yet
    patch = 20, 5  # a taxel of the left pads' patch
    (a, b), (rows_a, rows_b) = pair.shared_pads()[0], pair.common_rows()
    difference = int(b.counts[rows_b[list(rows_a).index(row)]][patch]) - int(
        a.counts[row][patch]
    )
    assert difference < -40
    color = difference_colors(np.array(difference / pair.full_difference))
    assert (
        share(shown["touch: counts above baseline"], tuple(map(int, color)), 25) > 0.005
    )
    for name in ("left_joint_1 [rad]", "right_gripper [m]"):
        for color in PAIR_COLORS:
            assert share(shown[name], color, 60) > 0.002, f"{name}: nothing in {color}"


# ---- taccorl compare ----

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
        found.setdefault(chunk.entity_path, []).extend(
            zip(times_s, values, strict=True)
        )
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
        origin=OF_TRACES,
    )


def pair() -> tuple[Comparison, Comparison]:
    measured = POSITION.copy()
    measured[100:150] = np.nan
    fields = {"measured": measured, "recording": "sweep 1.mcap"}
    return (
        comparison(trace(LEFT, POSITION, **fields), touches=(touch(),)),
        comparison(
            trace(0.1 * LEFT, POSITION, **fields),
            touches=(touch(),),
            twin="corrected twin",
        ),
    )


def test_lines_are_the_comparison_s_numbers(tmp_path: Path):
    before, after = pair()
    save_comparison(before, tmp_path / "x.rrd", after)
    found = read(tmp_path / "x.rrd")
    path, known = (
        "/sweep_1_mcap/left_joint5/position",
        np.isfinite(before.traces[0].measured),
    )
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
        np.testing.assert_allclose(
            found[name][1], expected, rtol=1e-9, atol=1e-12, err_msg=name
        )
    np.testing.assert_allclose(
        found[f"{path}/measured"][0], before.traces[0].time_s[known], atol=1e-9
    )


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
    assert (
        text.startswith(f"**data: {OF_TRACES}**")
        and "corrected twin" in text
        and "2 mrad" in text
    )
    assert set(images) == {
        f"/press_1_mcap/touch/{name}" for name in ("measured", "twin", "corrected")
    }
    frame = (
        np.array(images["/press_1_mcap/touch/measured"][20][0], np.uint8)
        .view(np.uint16)
        .reshape(32, 2 * 12 + 3)
    )
    np.testing.assert_array_equal(frame[:, 15:], touch().measured[20, 1])


def test_many_recordings_are_spread_over_tabs():
    traces = [
        trace(LEFT, POSITION, recording=f"sweep_{k}") for k in range(2 * MOST_ROWS + 1)
    ]
    tabs = comparison_blueprint(comparison(*traces)).root_container
    assert len(tabs.contents) == 3 + 1  # three tabs of curves and the provenance

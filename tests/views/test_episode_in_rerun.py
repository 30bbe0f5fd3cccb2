"""What was logged is read back with Rerun's own reader and compared with the episode, number by number."""

import dataclasses
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
import pytest
import rerun.blueprint as rrb

from taccorl.data.episode import Episode
from taccorl.data.origin import UNSTATED
from taccorl.data.spec import FeatureSpec
from taccorl.views.blueprint import episode_blueprint
from taccorl.views.episode import save_episode

from .made_episode import (
    ORIGIN,
    TOUCH,
    draw,
    in_dataset,
    made_episode,
    touch_counts,
    without,
)
from .readback import Column, read_rrd

ROWS, SIZE = 90, 64
Logged = dict[str, dict[str, Column]]


def logged(episode: Episode, folder: Path, **options: bool) -> Logged:
    path = folder / "episode.rrd"
    save_episode(episode, path, **options)
    return read_rrd(path)


@pytest.fixture(scope="module")
def episode() -> Episode:
    return made_episode(ROWS, picture_size=SIZE)


@pytest.fixture(scope="module")
def from_recording(
    episode: Episode, tmp_path_factory: pytest.TempPathFactory
) -> Logged:
    return logged(episode, tmp_path_factory.mktemp("recording"))


@pytest.fixture(scope="module")
def in_file(episode: Episode, tmp_path_factory: pytest.TempPathFactory) -> Episode:
    return in_dataset(episode, tmp_path_factory.mktemp("mp4"), rows_before=7)


@pytest.fixture(scope="module")
def from_dataset(in_file: Episode, tmp_path_factory: pytest.TempPathFactory) -> Logged:
    return logged(in_file, tmp_path_factory.mktemp("dataset"))


@pytest.mark.parametrize("pad", range(4))
def test_heatmaps_hold_the_counts_with_negative_ones_drawn_as_zero(
    from_recording: Logged, pad: int
):
    name = ("left_a", "left_b", "right_a", "right_b")[pad]
    column = from_recording[f"/observation/tactile/{name}"]["DepthImage:buffer"]
    shown = np.array([np.array(v[0], np.uint8) for v in column.values]).reshape(
        ROWS, 32, 12
    )
    assert np.array_equal(shown, np.maximum(touch_counts(ROWS)[:, pad], 0))
    assert column.frame_index == list(range(ROWS))


def test_colour_scale_is_fixed_for_all_pads_and_rows(from_recording: Logged):
    for name in ("left_a", "left_b", "right_a", "right_b", "scale"):
        column = from_recording[f"/observation/tactile/{name}"][
            "DepthImage:depth_range"
        ]
        assert column.frame_index == [], "said once, not per frame"
        assert column.values == [[[0.0, 255.0]]]  # 0 … (2^10 − 1) >> 2 counts


@pytest.mark.parametrize("key", ["observation.state", "action"])
def test_joints_are_the_datasets_numbers_in_plots_of_one_unit(
    episode: Episode, from_recording: Logged, key: str
):
    root = "/" + key.replace(".", "/")
    groups = {
        "left_arm_rad": list(range(6)),
        "right_arm_rad": list(range(7, 13)),
        "grippers_m": [6, 13],
    }
    for group, columns in groups.items():
        values = np.array(from_recording[f"{root}/{group}"]["Scalars:scalars"].values)
        assert np.array_equal(
            values.astype(np.float32), episode.arrays[key][:, columns]
        )
    names = from_recording[f"{root}/grippers_m"]["SeriesLines:names"].values
    assert names == [["left", "right"]]


def test_touch_curves_are_sum_peak_and_active_taxels(from_recording: Logged):
    counts = touch_counts(ROWS)[:, 2].astype(int)
    active = counts > 15
    for name, expected in (
        ("sum", np.where(active, counts, 0).sum(axis=(1, 2))),
        ("peak", counts.max(axis=(1, 2))),
        ("active", active.sum(axis=(1, 2))),
    ):
        values = np.array(
            from_recording[f"/touch/{name}/right_a"]["Scalars:scalars"].values
        )[:, 0]
        assert np.array_equal(values, expected), name


def test_noise_floor_and_contact_threshold_are_drawn_with_the_peak(
    from_recording: Logged,
):
    lines = {p: c for p, c in from_recording.items() if p.startswith("/touch/peak/")}
    for path, count in (
        ("/touch/peak/noise_floor_15", 15.0),
        ("/touch/peak/contact_30", 30.0),
    ):
        assert np.allclose(lines[path]["Scalars:scalars"].values, count, atol=1e-6)


def test_gate_stage_and_outcome_change_where_the_episode_says(from_recording: Logged):
    over = (np.abs(touch_counts(ROWS)) > 30).any(axis=(1, 2, 3))
    opens, closes = np.flatnonzero(np.diff(over.astype(int))) + 1
    gate = from_recording["/events/contact_gate"]["StateChange:state"]
    assert [v[0] for v in gate.values] == ["no contact", "contact", "no contact"]
    assert gate.frame_index == [0, opens, closes]
    stage = from_recording["/events/stage"]["StateChange:state"]
    assert [v[0] for v in stage.values] == ["reach", "hold", "release"]
    assert stage.frame_index == [0, int(0.4 * ROWS), int(0.8 * ROWS)]
    assert from_recording["/events/outcome"]["StateChange:state"].values == [
        ["success"]
    ]


@pytest.mark.parametrize(
    ("shown_from", "most"), [("from_recording", 3), ("from_dataset", 6)]
)
def test_every_row_shows_its_own_picture_as_jpeg(
    request: pytest.FixtureRequest, shown_from: str, most: float
):
    """The dataset's episode begins at frame 7 of its videos, which is no keyframe."""
    for camera in ("front", "left_wrist", "right_wrist"):
        column = request.getfixturevalue(shown_from)[f"/observation/images/{camera}"][
            "EncodedImage:blob"
        ]
        assert column.frame_index == list(range(ROWS))
        for row in (0, 63, 64, ROWS - 1):  # 64 rows a batch
            shown = cv2.imdecode(
                np.array(column.values[row][0], np.uint8), cv2.IMREAD_COLOR
            )[..., ::-1]
            truth = draw(f"observation.images.{camera}", row, ROWS, SIZE)
            assert np.abs(shown.astype(int) - truth).mean() < most


def test_fingers_in_the_figure_open_as_the_state_says(
    episode: Episode, from_recording: Logged
):
    a, b = (
        np.array(
            from_recording[f"/figure/left/finger_{f}"]["Transform3D:translation"].values
        )[:, 0]
        for f in "ab"
    )
    assert np.allclose(
        np.linalg.norm(a - b, axis=1),
        episode.arrays["observation.state"][:, 6],
        atol=1e-6,
    )


VIEWS = {
    "arms (schematic): joints in the plots' colours",
    f"provenance · {ORIGIN}",
    "front",
    "left_wrist",
    "right_wrist",
    "touch: counts above baseline, 0 … 255, fixed colours",
    f"contact gate, outcome, stage · {ORIGIN}",
    "touch sum of active taxels [counts above baseline]",
    "touch peak [counts above baseline]",
    "active taxels, above the noise floor [of 384 a pad]",
    "left arm [rad]: action thin",
    "right arm [rad]: action thin",
    "grippers [m]: action thin",
}


def views(part: object) -> list[rrb.View]:
    if isinstance(part, rrb.Container):
        return [view for child in part.contents for view in views(child)]
    assert isinstance(part, rrb.View)
    return [part]


def assert_no_view_is_empty(found: Iterable[str], blueprint: rrb.Blueprint) -> set[str]:
    """``found``: paths of what was logged. Gives the views' names."""
    shown = views(blueprint.root_container)
    for view in shown:
        contents = (
            view.contents if isinstance(view.contents, list) else [f"{view.origin}/**"]
        )
        roots = [str(content).removesuffix("/**") for content in contents]
        assert any(p == r or p.startswith(f"{r}/") for p in found for r in roots), (
            f"{view.name}: nothing"
        )
    return {str(view.name) for view in shown}


def test_episode_without_touch_opens_without_touch_views(
    episode: Episode, tmp_path: Path
):
    names = assert_no_view_is_empty(
        logged(without(episode, TOUCH), tmp_path),
        episode_blueprint(without(episode, TOUCH)),
    )
    assert not any(
        "touch" in name or "taxel" in name or "contact" in name for name in names
    )
    assert f"outcome, stage · {ORIGIN}" in names


def test_episode_of_numbers_only_opens(episode: Episode, tmp_path: Path):
    bare = without(episode, TOUCH, *episode.picture_keys)
    bare = dataclasses.replace(
        bare, stages=(), success=None, origin=UNSTATED, timing=(), instruction=""
    )
    names = assert_no_view_is_empty(logged(bare, tmp_path), episode_blueprint(bare))
    assert "provenance" in names
    assert not any("outcome" in name for name in names)


def test_somebody_elses_robot_opens(tmp_path: Path, episode: Episode):
    """16 unnamed joints without unit, another camera, velocities, and a feature too large for curves."""
    spec = episode.spec

    def numbers(size: int) -> FeatureSpec:
        return FeatureSpec(
            dtype="float32", shape=(size,), unit="", frame="", rate_hz=10, range=(-9, 9)
        )

    camera = dataclasses.replace(
        spec.features["observation.images.front"], shape=(48, SIZE, 3)
    )
    features = {
        "observation.state": numbers(16),
        "action": numbers(16),
        "observation.velocity": numbers(6),
        "observation.embedding": numbers(512),
        "observation.images.top": camera,
    }
    rng = np.random.default_rng(0)
    arrays = {
        key: rng.normal(size=(20, f.size)).astype(np.float32)
        for key, f in features.items()
        if f.dtype == "float32"
    }
    picture = {"observation.images.top": np.full((48, SIZE, 3), 90, np.uint8)}
    other = Episode(
        name="theirs",
        spec=dataclasses.replace(
            spec,
            name="theirs",
            robot_type="so101",
            fps=10,
            features=features,
            sensors={},
        ),
        start_ns=0,
        arrays=arrays,
        pictures=lambda: iter([picture] * 20),
        picture_keys=("observation.images.top",),
        instruction="do it",
    )
    names = assert_no_view_is_empty(logged(other, tmp_path), episode_blueprint(other))
    assert names == {"provenance", "top", "joints: action thin", "velocity: joints"}


OTHER_TOUCH: dict[str, tuple[str, tuple[int, ...]]] = {
    "observation.tactile.primary": ("float32", (12, 32)),  # LeFlexiTac
    "observation.tactile.left": ("uint8", (2, 16, 16)),  # two pads
    "observation.tactile.skin": ("float64", (96,)),  # too many for curves
    "observation.tactile.magnets": ("float32", (15,)),  # eFlesh, AnySkin
}


def with_other_touch(episode: Episode) -> tuple[Episode, dict[str, np.ndarray]]:
    rng, arrays, features = np.random.default_rng(0), {}, dict(episode.spec.features)
    for key, (dtype, shape) in OTHER_TOUCH.items():
        arrays[key] = (
            rng.uniform(-20 if dtype[0] == "f" else 0, 200, (ROWS, *shape))
        ).astype(dtype)
        size = int(np.prod(shape))
        told = {"unit": "", "frame": "", "rate_hz": 30, "range": (-999, 999)}
        features[key] = FeatureSpec(
            dtype=dtype, shape=(size,), layout=shape if len(shape) > 1 else (), **told
        )
    flat = {key: values.reshape(ROWS, -1) for key, values in arrays.items()}
    spec = dataclasses.replace(episode.spec, features=features)
    return dataclasses.replace(episode, spec=spec, arrays=episode.arrays | flat), arrays


def test_touch_that_no_sensor_spec_describes_is_shown_to_the_number(
    episode: Episode, tmp_path: Path
):
    other, arrays = with_other_touch(without(episode, TOUCH))
    arrays["observation.tactile.primary"][3, 0, 0] = np.nan  # of an unplugged row
    found = logged(other, tmp_path)
    for key, (_, shape) in OTHER_TOUCH.items():
        values, name = (
            arrays[key].astype(np.float32),
            key.removeprefix("observation.").replace(".", "_"),
        )
        if key == "observation.tactile.magnets":
            (path,) = [
                path
                for path in found
                if path.startswith("/observation/tactile/magnets")
            ]
            assert np.array_equal(
                np.array(found[path]["Scalars:scalars"].values, np.float32), values
            )
            continue
        *_, rows, columns = (1, *shape)
        pads = values.reshape(ROWS, -1, rows, columns)
        for pad in range(pads.shape[1]):
            entity = found[f"/touch_values/{name}/{pad}"]
            shown = np.array(
                [np.array(v[0], np.uint8) for v in entity["DepthImage:buffer"].values]
            )
            assert np.array_equal(
                shown.view(np.float32).reshape(ROWS, rows, columns),
                pads[:, pad],
                equal_nan=True,
            )
            assert entity["DepthImage:buffer"].frame_index == list(range(ROWS))
            (low, high) = entity["DepthImage:depth_range"].values[0][0]
            assert (low, high) == (np.nanmin(values), np.nanmax(values))
            (format_,) = entity["DepthImage:format"].values[0]
            assert (format_["width"], format_["height"]) == (columns, rows)
    names = assert_no_view_is_empty(logged(other, tmp_path), episode_blueprint(other))
    for key in OTHER_TOUCH:
        short = key.removeprefix("observation.").replace(".", "_")
        assert (
            sum(key in name or name.startswith(f"{short}: values") for name in names)
            == 1
        ), key


def test_touch_of_both_kinds_is_shown_side_by_side(episode: Episode, tmp_path: Path):
    other, _ = with_other_touch(episode)
    names = assert_no_view_is_empty(logged(other, tmp_path), episode_blueprint(other))
    assert any("counts above baseline" in name for name in names) and any(
        "primary" in name for name in names
    )


def test_a_picture_at_one_time_has_the_colours_of_the_whole_episode(
    episode: Episode, tmp_path: Path
):
    other, arrays = with_other_touch(without(episode, TOUCH))
    save_episode(other, tmp_path / "one.rrd", at_s=1.0)
    entity = read_rrd(tmp_path / "one.rrd")["/touch_values/tactile_primary/0"]
    values = arrays["observation.tactile.primary"]
    assert len(entity["DepthImage:buffer"].values) == 1
    assert tuple(entity["DepthImage:depth_range"].values[0][0]) == (
        values.min(),
        values.max(),
    )

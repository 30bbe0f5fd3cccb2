"""Active taxels, sum, peak and contact gate on numbers small enough to add up by hand; the arms of the figure."""

import dataclasses

import numpy as np

from taccorl.data.sensor_spec import load_sensor_spec
from taccorl.data.spec import data_specs_folder
from taccorl.views.colors import heat
from taccorl.views.figure import arms_of, pad_colors
from taccorl.views.touch import (
    CONTACT_THRESHOLD,
    MIN_ACTIVE_TAXELS,
    Pad,
    contact_gate,
    pads_of,
    peak_row,
)

from .made_episode import TOUCH, made_episode, without

FLEXITAC = load_sensor_spec(data_specs_folder() / "sensors" / "flexitac_v2.yaml")
SMALL = dataclasses.replace(FLEXITAC, rows=2, columns=2)


def pad(*frames: list[list[int]]) -> Pad:
    return Pad("left_a", SMALL, np.array(frames, dtype=np.int16))


def test_active_sum_and_peak_are_what_one_adds_up_by_hand():
    assert SMALL.noise_count == 15
    rows = pad([[16, 15], [-40, 31]], [[0, 3], [14, 15]])
    assert rows.num_active.tolist() == [2, 0]  # 16 and 31 are above 15; 15 is not
    assert rows.sum_count.tolist() == [16 + 31, 0] and rows.peak_count.tolist() == [
        31,
        15,
    ]
    full = Pad("left_a", FLEXITAC, np.full((1, 32, 12), 255, dtype=np.int16))
    assert full.sum_count.tolist() == [32 * 12 * 255]  # 97920 > 32767


def test_gate_opens_beyond_30_counts_of_any_pad_which_is_the_papers_threshold():
    assert (CONTACT_THRESHOLD, MIN_ACTIVE_TAXELS) == (0.4, 1)
    assert np.isclose(pad([[0, 0], [0, 0]]).gate_count, 30.0)  # 0.4 / (1/75)
    rows = pad(
        [[30, 30], [30, 30]], [[31, 0], [0, 0]], [[0, 0], [0, -31]], [[0, 0], [0, 0]]
    )
    assert contact_gate([rows]).tolist() == [
        False,
        True,
        True,
        False,
    ]  # |f|: the paper's eq. counts both signs
    quiet, loud = pad([[0, 0], [0, 0]]), pad([[0, 0], [0, 90]])
    assert contact_gate([quiet, loud]).tolist() == [True]
    assert contact_gate([quiet, quiet]).tolist() == [False]


def test_a_window_feature_shows_its_newest_reading_and_no_pad_twice():
    episode = made_episode(5, picture_size=32)
    spec, counts = episode.spec, episode.arrays[TOUCH]
    window = np.zeros((5, 10, 1536), dtype=np.int16)
    window[:, -1] = counts
    feature = dataclasses.replace(spec.features[TOUCH], shape=(15360,), history=10)
    both = dataclasses.replace(
        episode,
        spec=dataclasses.replace(
            spec,
            features={**spec.features, "observation.tactile_window": feature},
            sensors={**spec.sensors, "observation.tactile_window": spec.sensors[TOUCH]},
        ),
        arrays={**episode.arrays, "observation.tactile_window": window.reshape(5, -1)},
    )
    assert [p.name for p in pads_of(both)] == ["left_a", "left_b", "right_a", "right_b"]
    only_window = pads_of(without(both, TOUCH))
    assert np.array_equal(only_window[2].counts, pads_of(episode)[2].counts)


def test_peak_row_is_where_the_grip_is_firmest():
    pads = pads_of(made_episode(101, picture_size=32))
    assert abs(peak_row(pads) - 60) <= 1  # made so: at 60 % of the episode
    assert peak_row([]) == 0


RNG = np.random.default_rng(3)


def test_arms_are_found_by_name_whatever_their_order():
    episode = made_episode(10, picture_size=32)
    feature = episode.spec.features["observation.state"]
    order = RNG.permutation(14)
    shuffled = dataclasses.replace(
        episode,
        spec=dataclasses.replace(
            episode.spec,
            features={
                **episode.spec.features,
                "observation.state": dataclasses.replace(
                    feature, names=tuple(feature.names[i] for i in order)
                ),
            },
        ),
        arrays={
            **episode.arrays,
            "observation.state": episode.arrays["observation.state"][:, order],
        },
    )
    for side in ("left", "right"):
        assert np.array_equal(arms_of(shuffled)[side], arms_of(episode)[side])


def test_other_robots_have_no_piper_figure():
    episode = made_episode(10, picture_size=32)
    other = dataclasses.replace(
        episode, spec=dataclasses.replace(episode.spec, robot_type="aloha")
    )
    assert arms_of(other) == {}


def test_pads_wear_the_heatmaps_colours_by_their_sum():
    pads = pads_of(made_episode(101, picture_size=32))
    colors = pad_colors(pads[2])
    assert colors.dtype == np.uint32
    red, green, blue = (int(c) for c in heat(np.array(0.0)))
    assert colors[0] == (red << 24 | green << 16 | blue << 8 | 255), (
        "nothing touches: the scale's zero"
    )
    share = pads[2].sum_count[60] / pads[2].full_sum_count
    assert 0.1 < share < 1
    red, green, blue = (int(c) for c in heat(np.array(share)))
    assert colors[60] == (red << 24 | green << 16 | blue << 8 | 255)

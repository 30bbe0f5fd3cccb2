"""The figure's kinematics against arithmetic, symmetry and the twin's."""

import dataclasses

import numpy as np

from taccorl.views.colors import heat
from taccorl.views.figure import arms_of, pad_colors
from taccorl.views.touch import pads_of

from .made_episode import made_episode

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
                "observation.state": dataclasses.replace(feature, names=tuple(feature.names[i] for i in order)),
            },
        ),
        arrays={**episode.arrays, "observation.state": episode.arrays["observation.state"][:, order]},
    )
    for side in ("left", "right"):
        assert np.array_equal(arms_of(shuffled)[side], arms_of(episode)[side])


def test_other_robots_have_no_piper_figure():
    episode = made_episode(10, picture_size=32)
    other = dataclasses.replace(episode, spec=dataclasses.replace(episode.spec, robot_type="aloha"))
    assert arms_of(other) == {}


def test_pads_wear_the_heatmaps_colours_by_their_sum():
    pads = pads_of(made_episode(101, picture_size=32))
    colors = pad_colors(pads[2])
    assert colors.dtype == np.uint32
    red, green, blue = (int(c) for c in heat(np.array(0.0)))
    assert colors[0] == (red << 24 | green << 16 | blue << 8 | 255), "nothing touches: the scale's zero"
    share = pads[2].sum_count[60] / pads[2].full_sum_count
    assert 0.1 < share < 1
    red, green, blue = (int(c) for c in heat(np.array(share)))
    assert colors[60] == (red << 24 | green << 16 | blue << 8 | 255)

"""Draws of scenes: constant in an episode, each camera's own, the same in any company; the same picture as in training."""

import numpy as np
import pytest
import torch
from tiny_policies import batch_of, tiny_config, tiny_policy

from taccorl.policies.tactile_pi05.image_randomization import PICTURES_CHANGED, ImageRandomizationConfig, at_resolution
from taccorl.policies.tactile_pi05.scene_pictures import ScenePictures, scene_draws
from taccorl.sim.spaces import IMAGE_KEYS

FRONT, LEFT, _ = IMAGE_KEYS.values()
SEEDS, STEPS = np.array([3, 2**62 + 1, 3, 40]), np.array([0, 0, 10, 7])


def pictures(n: int = 4, px: int = 56) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    one = rng.integers(0, 256, (1, px, px, 3), dtype=np.uint8)
    return {key: np.repeat(one, n, axis=0) for key in IMAGE_KEYS.values()}  # the same for all: draws alone differ


def test_draws_are_the_scenes_own_for_each_camera_and_uniform():
    draws, _ = scene_draws(FRONT, SEEDS)
    assert np.array_equal(draws[:, 0], draws[:, 2]) and not np.array_equal(draws[:, 0], draws[:, 1])
    front, left = (scene_draws(key, np.arange(4000))[0] for key in (FRONT, LEFT))
    assert abs(front.mean(axis=1) - 0.5).max() < 4 * np.sqrt(1 / 12 / 4000)  # 4 standard errors of the mean
    assert abs(front.std(axis=1) - np.sqrt(1 / 12)).max() < 0.01
    for one, other in zip(front, left, strict=True):
        assert abs(np.corrcoef(one, other)[0, 1]) < 4 / np.sqrt(4000)


def test_within_an_episode_only_the_noise_changes_and_company_changes_nothing():
    config = ImageRandomizationConfig(noise_std=0.03)
    quiet, noisy = ScenePictures(ImageRandomizationConfig()), ScenePictures(config)
    still, found = quiet(pictures(), SEEDS, STEPS), noisy(pictures(), SEEDS, STEPS)
    for key in IMAGE_KEYS.values():
        assert torch.equal(still[key][0], still[key][2]) and not torch.equal(still[key][0], still[key][1])
        inside = (still[key] > 30) & (still[key] < 225)  # 3 σ from the ends, where values are clipped
        noise = (found[key].float() - still[key].float())[inside]
        assert abs(noise.std() / 255 - 0.03) < 0.001 and abs(noise.mean()) < 0.3
        assert not torch.equal(found[key][0], found[key][2])
    assert not torch.equal(still[FRONT][0], still[LEFT][0])
    some = [3, 0]
    alone = noisy({key: x[some] for key, x in pictures().items()}, SEEDS[some], STEPS[some])
    assert all(torch.equal(alone[key], found[key][some]) for key in alone)
    again = noisy(pictures(), SEEDS, STEPS)
    assert all(torch.equal(again[key], found[key]) for key in found)


@pytest.mark.parametrize("px", [56, 112])
def test_a_picture_is_that_of_training_by_the_same_numbers_and_is_cropped_once(px: int):
    """Up to the rounding to whole values, at the size of cached frames; the policy takes no crop of it again."""
    policy = tiny_policy(image_crop=0.9)
    changes = ScenePictures.of_policy(policy.config)
    assert changes.config == ImageRandomizationConfig(crop=0.9, noise_std=0.03)
    changes = ScenePictures(ImageRandomizationConfig(crop=0.9), resolution=policy.config.image_resolution)
    found = changes(pictures(px=px), SEEDS, STEPS)
    batch = batch_of(True, False, True, False)
    seen = {**batch, **{key: x / 255 for key, x in found.items()}, PICTURES_CHANGED: torch.ones(4, dtype=torch.bool)}
    for (key, clear), picture in zip(pictures(px=px).items(), policy._preprocess_images(seen)[0], strict=True):
        images = at_resolution(torch.from_numpy(clear).permute(0, 3, 1, 2) / 255, (56, 56))
        draws = torch.from_numpy(scene_draws(key, SEEDS)[0]).float()
        training = ImageRandomizationConfig(crop=0.9).build().with_draws(images, draws)
        assert ((picture + 1) / 2 - training).abs().max() <= 0.5 / 255 + 1e-6


def test_a_policy_that_sees_whole_pictures_in_training_sees_whole_ones():
    for config in ({"image_crop": 1.0}, {"image_randomization": False}):
        assert ScenePictures.of_policy(tiny_config(**config)).config.crop == 1.0

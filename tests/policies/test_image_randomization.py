"""Each row against arithmetic done beforehand and against torchvision; all rows absent against the identity; in the policy."""

import math
from itertools import permutations

import numpy as np
import pytest
import torch
from tiny_policies import batch_of, chunk, losses, plain_pi05, tiny_config, tiny_policy
from torchvision.transforms import InterpolationMode
from torchvision.transforms.v2 import functional

from taccorl.errors import TaccorlError
from taccorl.policies.tactile_pi05.image_randomization import (
    COTRAINING_NOISE_STD,
    PICTURES_CHANGED,
    ImageRandomizationConfig,
    _jittered,
    at_resolution,
)
from taccorl.policies.tactile_pi05.scene_pictures import ScenePictures, scene_draws
from taccorl.sim.spaces import IMAGE_KEYS

ABSENT = {
    "crop": 1.0,
    "rotation_deg": 0.0,
    "brightness": (1, 1),
    "contrast": (1, 1),
    "saturation": (1, 1),
}


def only(**row):
    return ImageRandomizationConfig(**{**ABSENT, **row}).build()


def flat_image(*rgb: float, size: int = 8) -> torch.Tensor:
    return torch.tensor(rgb).reshape(3, 1, 1).expand(3, size, size).contiguous()


def test_with_every_row_absent_images_stay_bit_identical_and_an_empty_batch_stays_empty():
    images = torch.rand(4, 3, 32, 48)
    assert torch.equal(only()(images), images)
    assert ImageRandomizationConfig().build()(torch.zeros(0, 3, 8, 8)).shape == (
        0,
        3,
        8,
        8,
    )


@pytest.mark.parametrize(
    ("row", "low", "high"),
    [("brightness", 0.7, 1.3), ("contrast", 0.6, 1.4), ("saturation", 0.5, 1.5)],
)
def test_factors_fill_the_papers_range_uniformly(row: str, low: float, high: float):
    torch.manual_seed(0)
    n = 400
    # Grey 0.5 except for one bright and one dark column; every factor can be read off without clipping.
    if row == "brightness":
        images, read = (
            flat_image(0.5, 0.5, 0.5).expand(n, 3, 8, 8),
            lambda x: x[:, 0, 0, 0] / 0.5,
        )
    elif row == "contrast":
        image = torch.full((3, 8, 8), 0.4)
        image[:, :, 4:] = 0.6
        images, read = (
            image.expand(n, 3, 8, 8),
            lambda x: (x[:, 0, 0, 7] - x[:, 0, 0, 0]) / 0.2,
        )
    else:
        images, read = (
            flat_image(0.6, 0.5, 0.4).expand(n, 3, 8, 8),
            lambda x: (x[:, 0, 0, 0] - x[:, 2, 0, 0]) / 0.2,
        )
    drawn = read(
        ImageRandomizationConfig(
            **{name: ABSENT[name] for name in ABSENT if name != row}
        ).build()(images)
    )
    assert drawn.min() >= low - 1e-4 and drawn.max() <= high + 1e-4
    width = high - low
    assert (
        drawn.min() < low + 0.05 * width and drawn.max() > high - 0.05 * width
    )  # missed with 0.95^400 = 1e-9
    standard_error = width / math.sqrt(12 * n)
    assert abs(drawn.mean() - 1.0) < 4 * standard_error
    assert abs(drawn.std() - width / math.sqrt(12)) < 0.1 * width


def test_crop_of_0_95_keeps_212_of_224_pixels_and_reaches_every_corner():
    torch.manual_seed(0)
    ramp = torch.arange(224.0) / 255
    image = torch.stack(
        [ramp.expand(224, 224), ramp.expand(224, 224).T, torch.zeros(224, 224)]
    )  # red: u, green: v
    changed = only(crop=0.95)(image.expand(250, 3, 224, 224)) * 255
    # Output pixel o shows source pixel shift + (o + ½)·212/224 − ½: 9.4375 + shift at o = 10, 202.5625 on at o = 214.
    shift_u, shift_v = changed[:, 0, 10, 10] - 9.4375, changed[:, 1, 10, 10] - 9.4375
    for shift in (shift_u, shift_v):
        assert torch.allclose(shift, shift.round(), atol=1e-3)
        assert set(shift.round().int().tolist()) == set(
            range(13)
        )  # 224 − 212 = 12 is the last; all drawn
    span = 204 * 212 / 224
    assert torch.allclose(
        changed[:, 0, 10, 214] - changed[:, 0, 10, 10], torch.tensor(span), atol=1e-3
    )
    assert (
        abs(torch.corrcoef(torch.stack([shift_u, shift_v]))[0, 1]) < 0.25
    )  # drawn apart


def test_noise_has_the_co_training_deviation_and_stays_within_the_range():
    torch.manual_seed(0)
    noisy = only(noise_std=COTRAINING_NOISE_STD)(torch.full((3, 200, 200), 0.5))
    assert noisy.std().item() == pytest.approx(
        0.03, rel=0.02
    )  # n = 120 000: standard error 0.2 %
    assert noisy.mean().item() == pytest.approx(0.5, abs=4 * 0.03 / math.sqrt(120_000))
    white = only(noise_std=COTRAINING_NOISE_STD)(torch.ones(3, 50, 50))
    assert white.max() <= 1.0 and white.min() < 1.0


def test_each_image_of_a_batch_is_drawn_for_itself_and_a_seed_repeats_them():
    change = ImageRandomizationConfig(noise_std=0.03).build()
    image = torch.rand(3, 32, 32)
    torch.manual_seed(7)
    batch = change(image.expand(2, 3, 3, 32, 32))
    assert batch.shape == (2, 3, 3, 32, 32) and batch.dtype == torch.float32
    assert (
        len({picture.numpy().tobytes() for picture in batch.reshape(6, 3, 32, 32)}) == 6
    )
    torch.manual_seed(7)
    one_by_one = torch.stack([change(image) for _ in range(6)])
    assert torch.equal(one_by_one.reshape(batch.shape), batch)


@pytest.mark.parametrize(
    ("fields", "named"),
    [
        ({"crop": 1.2}, "crop is 1.2"),
        ({"crop": 0.0}, "crop is 0.0"),
        ({"rotation_deg": -5.0}, "rotation_deg is -5.0"),
        ({"brightness": (1.3, 0.7)}, "brightness is (1.3, 0.7)"),
        ({"saturation": (-0.5, 1.5)}, "saturation is (-0.5, 1.5)"),
        ({"contrast": (0.6, math.nan)}, "contrast is (0.6, nan)"),
        ({"noise_std": -0.1}, "noise_std is -0.1"),
    ],
)
def test_values_that_mean_nothing_are_refused_by_name(fields: dict, named: str):
    with pytest.raises(TaccorlError) as caught:
        ImageRandomizationConfig(**fields)
    assert named in str(caught.value)


@pytest.mark.parametrize(
    "images",
    [torch.zeros(3, 8, 8, dtype=torch.uint8), torch.zeros(8, 8, 3), torch.zeros(8, 8)],
)
def test_counts_and_colours_in_the_wrong_place_are_refused(images: torch.Tensor):
    with pytest.raises(TaccorlError, match="float in"):
        ImageRandomizationConfig().build()(images)


# what torchvision makes of an image -----------------------------------------------------------------------------------


def smooth_image(size: int = 224) -> torch.Tensor:
    v, u = torch.meshgrid(
        torch.arange(float(size)), torch.arange(float(size)), indexing="ij"
    )
    return (
        torch.stack(
            [
                torch.sin(v / 17) * torch.cos(u / 23),
                torch.cos(v / 29 + 1),
                torch.sin((v + u) / 31),
            ]
        )
        * 0.4
        + 0.5
    )


@pytest.mark.parametrize(
    ("size", "down", "right", "turn", "tolerance"),
    [
        ((224, 224), 0.0, 0.0, 0.5, 1e-6),
        ((224, 224), 0.99, 0.5, 0.5, 1e-6),
        ((224, 224), 0.0, 0.99, 1.0, 1e-3),
        ((224, 224), 0.7, 0.2, 0.1, 1e-3),
        ((120, 200), 0.5, 0.5, 0.9, 1e-3),
    ],
)
def test_crop_and_rotation_are_torchvisions_within_the_stated_tolerance(
    size, down, right, turn, tolerance
):
    rows, columns = size
    image, draws = (
        smooth_image()[:, :rows, :columns],
        [torch.tensor([draw]) for draw in (down, right, turn)],
    )
    ours = ImageRandomizationConfig().build()._cut_and_turned(image[None], *draws)[0]
    height, width = (
        int(0.95 * rows),
        int(0.95 * columns),
    )  # of 224: 212, 224 − 212 + 1 = 13 places
    top, left, angle_deg = (
        int((rows - height + 1) * down),
        int((columns - width + 1) * right),
        10 * turn - 5,
    )
    cut = functional.resized_crop(
        image, top, left, height, width, [rows, columns], antialias=True
    )
    theirs = functional.rotate(cut, angle_deg, interpolation=InterpolationMode.BILINEAR)
    assert (ours - theirs).abs().max() <= tolerance and (
        ours - image
    ).abs().max() > 0.02


def test_colours_are_torchvisions_in_each_order():
    torch.manual_seed(0)
    image = torch.rand(3, 24, 32)
    changes = [
        functional.adjust_brightness,
        functional.adjust_contrast,
        functional.adjust_saturation,
    ]
    factors = torch.tensor([1.25, 0.65, 1.4])
    found = []
    for number, order in enumerate(permutations(range(3))):
        theirs = image
        for which in order:
            theirs = changes[which](theirs, factors[which].item())
        ours = _jittered(image[None], factors[:, None], torch.tensor([number]))[0]
        assert (ours - theirs).abs().max() <= 1e-6
        found.append(ours)
    assert all(
        (a - b).abs().max() > 1e-3 for k, a in enumerate(found) for b in found[:k]
    )  # the order matters


def test_a_batch_at_once_as_on_a_gpu_is_what_its_images_are_one_by_one():
    torch.manual_seed(0)
    images, change = torch.rand(5, 3, 40, 48), ImageRandomizationConfig().build()
    draws, factors, orders = (
        torch.rand(3, 5),
        0.5 + torch.rand(3, 5),
        torch.tensor([0, 5, 2, 4, 1]),
    )
    turned = change._cut_and_turned(images, *draws)
    together = _jittered(turned, factors, orders)
    for k in range(5):
        alone = change._cut_and_turned(images[k : k + 1], *draws[:, k : k + 1])
        torch.testing.assert_close(turned[k : k + 1], alone, rtol=0, atol=1e-6)
        alone = _jittered(alone, factors[:, k : k + 1], orders[k : k + 1])
        torch.testing.assert_close(together[k : k + 1], alone, rtol=0, atol=1e-6)
    assert change._changed(images, *change._draw(images)).shape == images.shape


# in the policy --------------------------------------------------------------------------------------------------------


def test_the_policy_changes_images_in_training_and_never_else():
    policy, batch = tiny_policy(), batch_of(True, False)
    seen = losses(policy.eval(), batch)
    first, second = losses(policy.train(), batch), losses(policy.train(), batch, seed=8)
    assert not torch.equal(first, seen) and torch.equal(
        first, losses(policy.train(), batch)
    )
    assert not torch.equal(first, second)
    assert torch.equal(chunk(policy.train(), batch), chunk(policy.eval(), batch))
    assert torch.equal(losses(policy.eval(), batch), seen)


@pytest.mark.parametrize("noise_std", [0.0, 0.03])
def test_cameras_that_are_computed_together_are_as_one_after_the_other(
    noise_std: float,
):
    """As on a GPU, where a batch is computed at once: bit by bit, with the same random numbers, and as many drawn."""
    change = ImageRandomizationConfig(noise_std=noise_std).build()
    cameras = [torch.rand(n, 3, 20, 24) for n in (4, 4, 2)]
    torch.manual_seed(5)
    expected = [change._changed(images, *change._draw(images)) for images in cameras]
    after = torch.get_rng_state()
    torch.manual_seed(5)
    found = change._together(cameras)
    assert torch.equal(torch.get_rng_state(), after)
    assert all(
        torch.equal(one, other) for one, other in zip(found, expected, strict=True)
    )
    torch.manual_seed(5)
    own = change.of_cameras(cameras)
    torch.manual_seed(5)
    assert all(
        torch.equal(one, change(images))
        for one, images in zip(own, cameras, strict=True)
    )


def test_the_training_loss_is_that_of_images_changed_beforehand():
    policy, batch = tiny_policy().train(), batch_of(True, False)
    on = losses(policy, batch)
    torch.manual_seed(7)
    change = ImageRandomizationConfig(noise_std=0.03).build()
    keys = list(policy.config.image_features)
    changed = {
        **batch,
        **{key: change(batch[key]) for key in keys},
        PICTURES_CHANGED: torch.ones(2, dtype=torch.bool),
    }
    assert torch.equal(policy.eval().forward(changed, "none")[0], on)
    assert all(
        torch.equal(batch[k], v) for k, v in batch_of(True, False).items()
    )  # the batch itself stays


def cameras_of(batch: dict[str, torch.Tensor]) -> list[str]:
    return [key for key in batch if key.startswith("observation.images.")]


def test_in_use_a_picture_is_the_one_of_training_with_middle_draws():
    """Zero rotation, factors 1, the crop in the middle: the training transform itself, and torchvision's crop and resize."""
    crop = 0.9  # 50 of 56 pixels, from the fourth on
    policy, batch = tiny_policy(image_crop=crop), batch_of(True, False)
    changes = ImageRandomizationConfig(
        **{**ABSENT, "crop": crop, "rotation_deg": 5.0}
    ).build()
    drawn = {
        key: changes.with_draws(batch[key], torch.full((7, 2), 0.5))
        for key in cameras_of(batch)
    }
    marked = {**batch, **drawn, PICTURES_CHANGED: torch.ones(2, dtype=torch.bool)}
    assert torch.equal(chunk(policy, batch), chunk(policy, marked))
    for key, picture in zip(
        cameras_of(batch), policy._preprocess_images(batch)[0], strict=True
    ):
        theirs = functional.resize(
            batch[key][..., 3:53, 3:53], [56, 56], antialias=False
        )
        assert ((picture + 1) / 2 - theirs).abs().max() <= 1e-5


def test_without_crop_pictures_in_use_are_whole():
    """Also without the randomisation, whatever the crop's default."""
    batch = batch_of(True, False)
    for config in ({"image_crop": 1.0}, {"image_randomization": False}):
        seen, _ = tiny_policy(**config)._preprocess_images(batch)
        assert all(
            torch.equal(x, 2 * batch[key] - 1)
            for key, x in zip(cameras_of(batch), seen, strict=True)
        )


def test_pictures_in_training_and_in_use_are_those_of_cached_frames():
    """Frames come at the size of the dataset or, cached, at that of the policy: both are changed and cropped at the latter."""
    policy, small = tiny_policy(), batch_of(True, False)
    large = {
        key: small[key].repeat_interleave(2, -1).repeat_interleave(2, -2)
        for key in cameras_of(small)
    }
    large = {**small, **large}
    for mode in (True, False):
        assert torch.equal(
            losses(policy.train(mode), large), losses(policy.train(mode), small)
        )


def test_switched_off_the_training_loss_is_lerobots_pi05s_bit_by_bit(monkeypatch):
    policy = tiny_policy(image_randomization=False, image_noise_std=0.0).train()
    batch = batch_of(False, False)
    assert torch.equal(
        losses(policy, batch), losses(plain_pi05(policy, monkeypatch).train(), batch)
    )


def test_noise_alone_and_rows_alone_can_be_asked_for():
    assert tiny_config().image_changes() == ImageRandomizationConfig(noise_std=0.03)
    assert tiny_config(image_noise_std=0).image_changes() == ImageRandomizationConfig()
    noise = tiny_config(image_randomization=False).image_changes()
    assert noise is not None and noise == ImageRandomizationConfig(
        **ABSENT, noise_std=0.03
    )
    colours = tiny_config(
        image_crop=1.0, image_rotation_deg=0.0, image_noise_std=0.0
    ).image_changes()
    assert colours == ImageRandomizationConfig(crop=1.0, rotation_deg=0.0)
    with pytest.raises(TaccorlError, match="noise_std is -1"):
        tiny_config(image_noise_std=-1)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"image_crop": 0.0}, "crop is 0.0"),
        (
            {"image_crop": 0.9, "image_randomization": False},
            r"--policy\.image_crop=0\.9 has no effect",
        ),
        (
            {"image_rotation_deg": 2.0, "image_randomization": False},
            r"--policy\.image_rotation_deg=2 has no effect",
        ),
    ],
)
def test_a_crop_or_rotation_that_is_impossible_or_without_effect_is_refused(
    options, said
):
    with pytest.raises(TaccorlError, match=said):
        tiny_config(**options)


# draws of scenes: constant in an episode, each camera's own, the same in any company ------------------------------------

FRONT, LEFT, _ = IMAGE_KEYS.values()
SEEDS, STEPS = np.array([3, 2**62 + 1, 3, 40]), np.array([0, 0, 10, 7])


def pictures(n: int = 4, px: int = 56) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    one = rng.integers(0, 256, (1, px, px, 3), dtype=np.uint8)
    return {
        key: np.repeat(one, n, axis=0) for key in IMAGE_KEYS.values()
    }  # the same for all: draws alone differ


def test_draws_are_the_scenes_own_for_each_camera_and_uniform():
    draws, _ = scene_draws(FRONT, SEEDS)
    assert np.array_equal(draws[:, 0], draws[:, 2]) and not np.array_equal(
        draws[:, 0], draws[:, 1]
    )
    front, left = (scene_draws(key, np.arange(4000))[0] for key in (FRONT, LEFT))
    assert abs(front.mean(axis=1) - 0.5).max() < 4 * np.sqrt(
        1 / 12 / 4000
    )  # 4 standard errors of the mean
    assert abs(front.std(axis=1) - np.sqrt(1 / 12)).max() < 0.01
    for one, other in zip(front, left, strict=True):
        assert abs(np.corrcoef(one, other)[0, 1]) < 4 / np.sqrt(4000)


def test_within_an_episode_only_the_noise_changes_and_company_changes_nothing():
    config = ImageRandomizationConfig(noise_std=0.03)
    quiet, noisy = ScenePictures(ImageRandomizationConfig()), ScenePictures(config)
    still, found = quiet(pictures(), SEEDS, STEPS), noisy(pictures(), SEEDS, STEPS)
    for key in IMAGE_KEYS.values():
        assert torch.equal(still[key][0], still[key][2]) and not torch.equal(
            still[key][0], still[key][1]
        )
        inside = (still[key] > 30) & (
            still[key] < 225
        )  # 3 σ from the ends, where values are clipped
        noise = (found[key].float() - still[key].float())[inside]
        assert abs(noise.std() / 255 - 0.03) < 0.001 and abs(noise.mean()) < 0.3
        assert not torch.equal(found[key][0], found[key][2])
    assert not torch.equal(still[FRONT][0], still[LEFT][0])
    some = [3, 0]
    alone = noisy(
        {key: x[some] for key, x in pictures().items()}, SEEDS[some], STEPS[some]
    )
    assert all(torch.equal(alone[key], found[key][some]) for key in alone)
    again = noisy(pictures(), SEEDS, STEPS)
    assert all(torch.equal(again[key], found[key]) for key in found)


@pytest.mark.parametrize("px", [56, 112])
def test_a_picture_is_that_of_training_by_the_same_numbers_and_is_cropped_once(px: int):
    """Up to the rounding to whole values, at the size of cached frames; the policy takes no crop of it again."""
    policy = tiny_policy(image_crop=0.9)
    changes = ScenePictures.of_policy(policy.config)
    assert changes.config == ImageRandomizationConfig(crop=0.9, noise_std=0.03)
    changes = ScenePictures(
        ImageRandomizationConfig(crop=0.9), resolution=policy.config.image_resolution
    )
    found = changes(pictures(px=px), SEEDS, STEPS)
    batch = batch_of(True, False, True, False)
    seen = {
        **batch,
        **{key: x / 255 for key, x in found.items()},
        PICTURES_CHANGED: torch.ones(4, dtype=torch.bool),
    }
    for (key, clear), picture in zip(
        pictures(px=px).items(), policy._preprocess_images(seen)[0], strict=True
    ):
        images = at_resolution(
            torch.from_numpy(clear).permute(0, 3, 1, 2) / 255, (56, 56)
        )
        draws = torch.from_numpy(scene_draws(key, SEEDS)[0]).float()
        training = ImageRandomizationConfig(crop=0.9).build().with_draws(images, draws)
        assert ((picture + 1) / 2 - training).abs().max() <= 0.5 / 255 + 1e-6


def test_a_policy_that_sees_whole_pictures_in_training_sees_whole_ones():
    for config in ({"image_crop": 1.0}, {"image_randomization": False}):
        assert ScenePictures.of_policy(tiny_config(**config)).config.crop == 1.0

"""Gain, gamma and blur of pictures that were made with known ones."""

import numpy as np
import pytest

from pipelines.benchmarks.cameras import random_poses, surrogate_pictures
from taccorl.alignment.camera.calibration import CameraFrames
from taccorl.alignment.camera.light import camera_light
from taccorl.errors import TaccorlError
from taccorl.sim.effects.cameras import blurred, toned
from taccorl.sim.twin import TwinConfig

SIZE = (224, 224)


def test_gain_gamma_and_blur_are_found():
    rng = np.random.default_rng(2)
    joints = random_poses(rng, 4)
    plain = surrogate_pictures(
        "front", np.zeros(6), joints, rng, SIZE, plain=True
    ).astype(np.float32)
    inside = plain[:, 28:-28]  # without the bars of the letterbox
    soft = np.stack(
        [blurred(toned(inside[k], 0.8, 1.3), 1.2 * 224 / 640) for k in range(4)]
    )
    seen = np.pad(
        soft + rng.normal(0, 3, inside.shape), ((0, 0), (28, 28), (0, 0), (0, 0))
    )
    pictures = np.clip(np.round(seen), 0, 255).astype(np.uint8)
    fit = camera_light(
        CameraFrames(pictures=pictures, joints=joints), TwinConfig(), "front"
    )
    assert fit.gain == pytest.approx(0.8, rel=0.05) and fit.gamma == pytest.approx(
        1.3, rel=0.05
    )
    assert fit.blur_px == pytest.approx(1.2, abs=0.25)
    assert fit.grey_after < 0.2 * fit.grey_before


def test_what_cannot_be_judged_is_named():
    rng = np.random.default_rng(2)
    joints = random_poses(rng, 4)
    plain = surrogate_pictures("front", np.zeros(6), joints, rng, SIZE, plain=True)
    two = CameraFrames(pictures=plain[:2], joints=joints[:2])
    with pytest.raises(
        TaccorlError, match="2 frames; brightness and blur need at least three"
    ):
        camera_light(two, TwinConfig(), "front")
    dark = CameraFrames(pictures=plain // 60, joints=joints)
    with pytest.raises(TaccorlError, match="neither black nor white"):
        camera_light(dark, TwinConfig(), "front")
    inverted = 255 - plain
    inverted[:, :28] = inverted[:, -28:] = 0
    with pytest.raises(
        TaccorlError, match="bright in the twin are dark in the pictures"
    ):
        camera_light(
            CameraFrames(pictures=inverted, joints=joints), TwinConfig(), "front"
        )

"""Pictures of rollouts, changed as ``image_randomization`` changes images in training: ``--pictures=randomised``.

The paper lists these rows in the randomisation of its simulation (App. E). A scene draws place of the crop, rotation and colours
once for each camera, as of a mount that is off and of another exposure; noise is drawn anew in each picture. All draws follow
from scene seed, camera and control step alone, on every device, so that neither the other environments nor their processes
change them.

Letters in shapes: N environments, R rows, C columns.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from taccorl.policies.tactile_pi05.black_bars import without_bars
from taccorl.policies.tactile_pi05.configuration_tactile_pi05 import TactilePI05Config
from taccorl.policies.tactile_pi05.image_randomization import (
    COTRAINING_NOISE_STD,
    NUM_DRAWS,
    ImageRandomizationConfig,
    at_resolution,
)
from taccorl.robots import ROBOT
from taccorl.sim.sensors.noise import ScanNoise
from taccorl.sim.spaces import IMAGE_KEYS

_OWN_STREAM = (
    0x70696374  # apart from the pads' noise, whose generators have (seed, step)
)


class ScenePictures:
    """Changes pictures of N environments by the draws of their scenes."""

    def __init__(
        self,
        changes: ImageRandomizationConfig,
        *,
        device: Any = "cpu",
        resolution: tuple[int, int] | None = None,
    ) -> None:
        """``device``: torch device on which pictures are changed. ``resolution``: rows and columns to which they are resized
        before; None: they keep their size."""
        self.config, self._changes = changes, changes.build()
        self._device, self._resolution = torch.device(str(device)), resolution

    @classmethod
    def of_policy(cls, config: Any) -> "ScenePictures":
        """With the paper's ranges and its σ_v as noise, and with the crop and at the resolution that the policy had in
        training; for policies other than tactile_pi05, which do not state a crop, with the paper's crop and at the pictures'
        own size. ``config``: the policy's configuration."""
        if not isinstance(config, TactilePI05Config):
            return cls(
                ImageRandomizationConfig(noise_std=COTRAINING_NOISE_STD),
                device=config.device,
            )
        # The policy enlarges this crop in any case: another one would show objects at another size than in training.
        changes = ImageRandomizationConfig(
            crop=config.crop_in_use, noise_std=COTRAINING_NOISE_STD
        )
        return cls(changes, device=config.device, resolution=config.image_resolution)

    @torch.no_grad()
    def __call__(
        self,
        pictures: Mapping[str, np.ndarray | Tensor],
        seeds_N: np.ndarray,
        steps_N: np.ndarray,
    ) -> dict[str, Tensor]:
        """Changed pictures, (N, 3, R, C) uint8 on the device, of each camera. Whole values, as a camera's: what is stored is what
        the policy saw. ``pictures``: key of the camera (``IMAGE_KEYS``) → as in ``channels_first``. ``seeds_N``, ``steps_N``:
        scene seed of each environment, and number of control steps since the scene's start."""
        return {
            key: self._of_camera(key, clear, seeds_N, steps_N)
            for key, clear in pictures.items()
        }

    def _of_camera(
        self,
        key: str,
        clear: np.ndarray | Tensor,
        seeds_N: np.ndarray,
        steps_N: np.ndarray,
    ) -> Tensor:
        draws_7N, noise_seeds_N = scene_draws(key, seeds_N)
        images_N3RC = (
            channels_first(clear, self._device).contiguous().to(torch.float32) / 255
        )
        if self._resolution is not None:
            images_N3RC = at_resolution(
                without_bars(images_N3RC, self._resolution, key), self._resolution
            )
        noise = (
            ScanNoise(noise_seeds_N, steps_N).draw(tuple(images_N3RC.shape))
            if self.config.noise_std
            else None
        )
        changed_N3RC = self._changes.with_draws(
            images_N3RC,
            torch.from_numpy(draws_7N).to(images_N3RC),
            None if noise is None else torch.from_numpy(noise).to(self._device),
        )
        return (changed_N3RC * 255).round().to(torch.uint8)


def channels_first(pictures: np.ndarray | Tensor, device: Any) -> Tensor:
    """(N, 3, R, C) uint8 on ``device``, of an array (N, R, C, 3) of uint8 as OpenGL's are; tensors, which a device has drawn, are
    (N, 3, R, C) already."""
    if isinstance(pictures, Tensor):
        return pictures.to(device)
    return torch.from_numpy(pictures).to(device).permute(0, 3, 1, 2)


def scene_draws(key: str, seeds_N: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Random numbers of scenes for one camera: (7, N) uniform numbers as ``ImageRandomization.with_draws`` takes them, and (N,)
    seeds of the noise. ``key``: key of the camera (``IMAGE_KEYS``)."""
    camera = [IMAGE_KEYS[name] for name in ROBOT.cameras].index(key)
    draws_7N, noise_seeds_N = (
        np.empty((NUM_DRAWS, len(seeds_N))),
        np.empty(len(seeds_N), np.int64),
    )
    for i, seed in enumerate(seeds_N):
        rng = np.random.default_rng((int(seed), _OWN_STREAM, camera))
        draws_7N[:, i], noise_seeds_N[i] = rng.random(NUM_DRAWS), rng.integers(2**63)
    return draws_7N, noise_seeds_N

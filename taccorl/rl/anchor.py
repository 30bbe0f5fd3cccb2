"""The real-data anchor, paper §3.4: L = L_PPO + β · E_real[ℓ_flow], with B_real rows in every optimiser step.

The flow loss is that of co-training: images are randomised and touch is hidden from the share ``touch_dropout`` of the rows, as
in ``lerobot-train``. PPO's rollouts and ratios hide no touch, and their images are those of ``env.pictures``. Steps of a chunk
beyond an episode's end do not count.
"""

import logging
from types import SimpleNamespace
from typing import Any, Protocol

import torch
from lerobot.configs.default import DatasetConfig
from lerobot.datasets import factory
from lerobot.utils.random_utils import get_rng_state, set_rng_state
from torch import Tensor
from torch.utils.data import default_collate

from taccorl.data.dataset import Dataset
from taccorl.errors import TaccorlError
from taccorl.policies.tactile_pi05.mixture import IS_SIM
from taccorl.policies.tactile_pi05.modeling_tactile_pi05 import TactilePI05Policy
from taccorl.rl.settings import AnchorSettings
from taccorl.training import reading
from taccorl.training.cotrain import check_domains, origins_of

_FIXED_BATCHES = 4
_log = logging.getLogger(__name__)


class Anchor(Protocol):
    """Interface of a loss that adds its gradient to that of PPO."""

    def backward(self, generator: torch.Generator, micro_batch: int) -> float:
        """Add the gradient of β · ℓ for the rows of one optimiser step, and return the loss ℓ, without β.

        ``generator`` (on the CPU) draws the rows; ``micro_batch`` is the number of rows computed at the same time."""
        ...


class RealAnchor:
    """Anchor with rows of a LeRobot dataset, drawn with replacement and passed through the policy's own preprocessor."""

    def __init__(
        self, settings: AnchorSettings, policy: TactilePI05Policy, preprocessor: Any
    ) -> None:
        """Raises TaccorlError: the dataset does not exist, is simulated, or has other features than the policy."""
        self._policy, self._preprocessor, self._settings = (
            policy,
            preprocessor,
            settings,
        )
        root = settings.dataset
        if root is None or not (root / "meta" / "info.json").is_file():
            raise TaccorlError(
                f"--anchor.dataset={root}: no LeRobot dataset (meta/info.json) there"
            )
        features = Dataset(root).info["features"]
        if missing := [
            key for key in policy.config.input_features or {} if key not in features
        ]:
            raise TaccorlError(
                f"--anchor.dataset={root}: has no {', '.join(missing)}, inputs of the policy"
            )
        if IS_SIM not in features and not settings.allow_simulated:
            if twin := [
                origin
                for origin in origins_of(Dataset(root))
                if origin.domain == "twin"
            ]:
                raise TaccorlError(
                    f"--anchor.dataset={root}: its episodes are {twin[0]}, not real. Give recordings (taccorl ingest) or "
                    "those of a surrogate (taccorl collect --domain=surrogate); --anchor.allow_simulated=true takes these "
                    "all the same, and --anchor.weight=0 trains without an anchor"
                )
            check_domains([root], [])
        reading.install()
        named: Any = DatasetConfig(repo_id="local/anchor", root=str(root))
        named.cache, named.cache_store = settings.cache, str(settings.cache_store)
        # What LeRobot's make_dataset and our cache read from a training's configuration.
        read: dict[str, Any] = {"tolerance_s": 1e-4, "num_workers": 0, "rename_map": {}}
        options: Any = SimpleNamespace(
            dataset=named, trainable_config=policy.config, **read
        )
        self._dataset: Any = factory.make_dataset(options)
        policy.config.match_dataset(self._dataset.meta)
        self.rows = torch.arange(len(self._dataset))
        if IS_SIM in features:
            is_sim = torch.as_tensor(
                self._dataset.hf_dataset.data.column(IS_SIM)
                .to_numpy()
                .astype("float32")
            )
            self.rows = torch.nonzero(is_sim.reshape(-1) < 0.5)[:, 0]
            if not len(self.rows):
                raise TaccorlError(
                    f"--anchor.dataset={root}: all of its rows are simulated ({IS_SIM})"
                )
        fixed = self._draw(
            _FIXED_BATCHES * settings.batch_size, torch.Generator().manual_seed(0)
        )
        # Frames that are missing are noticed now, not after hours of rollouts.
        self._fixed = [
            preprocessor(self._batch(part)) for part in fixed.split(settings.batch_size)
        ]
        _log.info("anchor: %d rows of %s", len(self.rows), root)

    def backward(self, generator: torch.Generator, micro_batch: int) -> float:
        rows = self._draw(self._settings.batch_size, generator)
        self._policy.train()
        loss = 0.0
        for part in rows.split(micro_batch):
            share = self._policy.forward(self._preprocessor(self._batch(part)))[0] * (
                len(part) / len(rows)
            )
            (self._settings.weight * share).backward()
            loss += float(share.detach())
        self._policy.eval()
        return loss

    @torch.no_grad()
    def drift(self) -> float:
        """Flow loss ℓ (mean, without unit), in evaluation mode, of 4 · B_real rows. Rows and noise are the same in each call and
        each run, so that the values of a run show how far its policy moves away from the real data."""
        state = get_rng_state()
        torch.manual_seed(0)
        losses = [float(self._policy.forward(dict(batch))[0]) for batch in self._fixed]
        set_rng_state(state)
        return sum(losses) / len(losses)

    def _draw(self, num_rows: int, generator: torch.Generator) -> Tensor:
        return self.rows[
            torch.randint(len(self.rows), (num_rows,), generator=generator)
        ]

    def _batch(self, rows: Tensor) -> dict[str, Any]:
        batch = default_collate(self._dataset.__getitems__(rows.tolist()))
        for key in self._dataset.meta.camera_keys:
            if key in batch and batch[key].dtype == torch.uint8:
                batch[key] = batch[key].to(torch.float32) / 255.0
        return batch

"""LeRobot's own commands as steps of a pipeline: a finished run is not repeated, a stopped one continues."""

import json
import shutil
from collections.abc import Sequence
from hashlib import sha256
from pathlib import Path

from taccorl.data.dataset import PROVENANCE
from taccorl.errors import DatasetError
from taccorl.lineage.manifest import read_manifest

FIRST_SEED = 1000
"""Seed of the first episode that lerobot-eval scores (its default); each further episode has the next seed."""


class Training:
    """One run of lerobot-train.

    The name of its folder depends on data, recipe and options, so that a run with other settings never uses its policy.
    """

    def __init__(
        self, recipe: Path, dataset: Path, words: Sequence[str], out: Path
    ) -> None:
        """
        Args:
            recipe: file for ``--config_path``, such as those in configs/cotrain.
            dataset: dataset written by ``taccorl merge``.
            words: further options, which override the recipe.
            out: parent folder of the run's folder.

        Raises:
            DatasetError: the dataset was not published by a taccorl verb.
        """
        manifest = read_manifest(dataset)
        if not manifest:
            raise DatasetError(
                f"{dataset}: has no {PROVENANCE}/manifest.json; merge it with taccorl merge"
            )
        decides = [manifest["digest"], recipe.read_text(encoding="utf-8"), *words]
        self.folder = (
            out / f"policy_{sha256('\n'.join(decides).encode()).hexdigest()[:8]}"
        )
        self._recipe, self._dataset, self._words = recipe, dataset, words

    @property
    def policy(self) -> Path:
        """Folder of the last checkpoint, for ``--policy.path``."""
        return self.folder / "checkpoints/last/pretrained_model"

    @property
    def steps(self) -> int:
        """Number of training steps done so far."""
        told = self.folder / "checkpoints/last/training_state/training_step.json"
        return (
            int(json.loads(told.read_text(encoding="utf-8"))["step"])
            if told.is_file()
            else 0
        )

    def command(self) -> list[str]:
        """Command that runs the rest of the training; empty if it is finished. A run that ended before its first checkpoint
        is removed."""
        begun = self.policy / "train_config.json"
        if not begun.is_file():
            shutil.rmtree(self.folder, ignore_errors=True)
            data = (
                f"--dataset.repo_id=local/{self._dataset.name}",
                f"--dataset.root={self._dataset}",
            )
            return [
                "lerobot-train",
                f"--config_path={self._recipe}",
                *data,
                *self._words,
                f"--output_dir={self.folder}",
            ]
        if self.steps < json.loads(begun.read_text(encoding="utf-8"))["steps"]:
            return [
                "lerobot-train",
                f"--config_path={begun}",
                "--resume=true",
                f"--output_dir={self.folder}",
            ]
        return []


class Scoring:
    """One run of lerobot-eval in the twin; its folder lies beside the policy's checkpoints."""

    def __init__(self, training: Training, words: Sequence[str], episodes: int) -> None:
        """
        Args:
            words: options of the environment: ``--env.task=…``, ``--env.twin=…``.
        """
        self._words = [
            *words,
            f"--eval.n_episodes={episodes}",
            f"--eval.batch_size={min(episodes, 10)}",
        ]
        self._policy, key = (
            training.policy,
            sha256("\n".join([*self._words, str(training.steps)]).encode()).hexdigest(),
        )
        self.folder = training.folder / f"scored_{key[:8]}"

    def command(self) -> list[str]:
        """Command that runs the evaluation; empty if it is finished."""
        if (self.folder / "eval_info.json").is_file():
            return []
        env = (
            "--env.type=taccorl",
            "--eval.use_async_envs=false",
            f"--seed={FIRST_SEED}",
        )
        return [
            "lerobot-eval",
            f"--policy.path={self._policy}",
            *env,
            *self._words,
            f"--output_dir={self.folder}",
        ]

    def successes(self) -> list[bool]:
        """Success of each episode, in the order of their seeds."""
        told = json.loads((self.folder / "eval_info.json").read_text(encoding="utf-8"))
        return [
            bool(success)
            for run in told["per_task"]
            for success in run["metrics"]["successes"]
        ]

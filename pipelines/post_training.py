"""``taccorl post-train`` as a step of a pipeline: a finished run is not repeated, a stopped one continues."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

_STATED = "--iterations="
"""Option that a run needs: a run has a number of iterations, it does not stop by the clock."""


@dataclass(frozen=True)
class PostTraining:
    """One run of PPO from a policy's last checkpoint. It has ``policy``, ``folder`` and ``steps`` as ``Training`` has."""

    start: Path
    """Folder ``pretrained_model`` of the policy with which it begins."""
    folder: Path
    """Folder of the run, named after its settings."""
    settings: str
    """Name of the file of settings, and their digest."""
    words: tuple[str, ...]
    """Words of the command after ``--config_path``, among them ``--iterations``."""
    config: Path
    steps: int
    """Training steps of the policy with which it begins."""

    @classmethod
    def of(
        cls, start: Path, beside: Path, config: Path, words: Sequence[str], steps: int
    ) -> "PostTraining":
        """
        Args:
            start: folder ``pretrained_model``.
            beside: folder in which the run's folder lies.
            config: file for ``--config_path``.
            words: further options, which override it.
            steps: training steps of the policy.

        Raises:
            SystemExit: ``words`` state no number of iterations.
        """
        if not any(word.startswith(_STATED) for word in words):
            raise SystemExit(
                f"--post_train={config}: also give --post_train_options=[{_STATED}30], or so many"
            )
        decides = "\n".join([config.read_text(encoding="utf-8"), *words])
        name = f"{config.stem}_{sha256(decides.encode()).hexdigest()[:8]}"
        return cls(start, beside / f"ppo_{name}", name, tuple(words), config, steps)

    @property
    def policy(self) -> Path:
        """Folder of the last checkpoint, for ``--policy.path``."""
        return self.folder / "checkpoints/last/pretrained_model"

    @property
    def rows(self) -> list[dict]:
        """Rows of ``progress.jsonl``, one for each iteration that ended."""
        path = self.folder / "progress.jsonl"
        lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
        return [json.loads(line) for line in lines]

    @property
    def iterations(self) -> int:
        """Number of iterations that the run has at its end."""
        (stated,) = [word for word in self.words if word.startswith(_STATED)]
        return int(stated.removeprefix(_STATED))

    def command(self, options: Sequence[str]) -> list[str]:
        """Words of the command that runs the rest; empty if nothing is missing. ``options``: task, twin, seed of a new run."""
        if len(self.rows) >= self.iterations:
            return []
        if self.policy.exists():
            return ["post-train", "--resume=true", f"--out={self.folder}"]
        return [
            "post-train",
            f"--config_path={self.config}",
            f"--policy.path={self.start}",
            *options,
            *self.words,
            f"--out={self.folder}",
        ]

    def about(self) -> dict:
        """Facts of a score's row: settings, decisions of the environments, iterations that changed the policy, seconds."""
        rows = self.rows
        seconds = sum(sum(row["seconds"].values()) for row in rows)
        return {
            "stage": "ppo",
            "settings": self.settings,
            "decisions": rows[-1]["decisions"],
            "updates": sum(row["actor_steps"] > 0 for row in rows),
            "ppo_s": round(seconds),
        }

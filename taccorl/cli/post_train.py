"""``taccorl post-train --policy.path=CHECKPOINT --env.task=assembly_2 --anchor.dataset=DATASET [--env.twin=twin.yaml]``

Improve a co-trained policy with PPO in the twin; a supervised term (the anchor) keeps it close to real demonstrations (paper
§3.4).

Defaults are the paper's table of post-training parameters; --config_path=FILE reads others, such as
configs/post_train/small.yaml. OUT/checkpoints/last/pretrained_model is a LeRobot policy, progress.jsonl has a line an iteration.
"""

from dataclasses import dataclass

from taccorl.cli.evaluate import register_policies
from taccorl.cli.parse import given_names, parse
from taccorl.errors import TaccorlError
from taccorl.rl.settings import PostTrainSettings


@dataclass(kw_only=True)
class PostTrainConfig(PostTrainSettings):
    """Post-train a policy in the twin."""


def main(argv: list[str]) -> int:
    """Run ``taccorl post-train`` with the words ``argv`` after it; returns the exit status 0. Raises TaccorlError: an option
    is unknown, or the run cannot begin or go on (``taccorl.rl.post_train``)."""
    _refuse_touch(argv)
    config = parse(PostTrainConfig, argv, positional=None, prog="taccorl post-train")
    if config.resume:
        from taccorl.rl import run_settings

        config = parse(
            PostTrainConfig,
            [*argv, *run_settings.stored_options(config.out, given_names(argv))],
        )
    import logging
    import shutil

    register_policies()
    from taccorl.rl.post_train import post_train
    from taccorl.views.episode import save_episode

    logging.basicConfig(level=logging.INFO, format="%(message)s")
    try:
        folder = post_train(
            config,
            lambda text: print(text, flush=True),
            save_episode if config.rerun else None,
        )
    finally:
        for left in (config.out / "checkpoints").glob(
            ".*.unfinished"
        ):  # of a checkpoint that a signal ended
            shutil.rmtree(left, ignore_errors=True)
    print(f"wrote {folder}")
    return 0


def _refuse_touch(argv: list[str]) -> None:
    """Raises TaccorlError: ``--policy.tactile`` is given, an option of ``lerobot-train``."""
    path = next(
        (word for word in argv if word.startswith("--policy.path=")), "--policy.path"
    )
    for word in argv:
        if word.partition("=")[0] == "--policy.tactile":
            raise TaccorlError(
                f"{word}: whether a policy uses touch is fixed by its checkpoint ({path}); remove the option, or train another "
                "policy by lerobot-train with it"
            )

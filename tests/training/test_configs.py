"""Every file of configs/ can be loaded by what reads it; those of the paper's co-training hold its table."""

import re
import sys
from pathlib import Path
from typing import Any

import pytest
from lerobot.configs.train import TrainPipelineConfig

from taccorl.alignment.machines.robot_file import load_robot
from taccorl.cli.parse import parse
from taccorl.cli.post_train import PostTrainConfig
from taccorl.sim.twin_file import load_twin

CONFIGS = Path(__file__).parents[2] / "configs"
ALL = sorted(path.relative_to(CONFIGS).as_posix() for path in CONFIGS.rglob("*.yaml"))


def lerobot_train(
    path: Path | None, monkeypatch: pytest.MonkeyPatch, *words: str
) -> Any:
    """The configuration that ``lerobot-train --config_path=PATH`` would run; without a path, ``words`` alone."""
    from lerobot.configs import parser

    import taccorl.lerobot_plugin  # noqa: F401

    @parser.wrap()
    def main(cfg: TrainPipelineConfig) -> TrainPipelineConfig:
        cfg.validate()
        return cfg

    given = (
        (f"--config_path={path}", "--dataset.repo_id=local/both", "--dataset.root=both")
        if path
        else ()
    )
    monkeypatch.setattr(
        sys, "argv", ["lerobot-train", *given, "--output_dir=outputs/not_there", *words]
    )
    return main()  # pyright: ignore[reportCallIssue]


def test_the_lines_of_the_readme_download_no_weights(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pages = [
        (CONFIGS.parent / name).read_text(encoding="utf-8")
        for name in ("README.md", "docs/training.md")
    ]
    lines = re.findall(
        r"^(?:\|.*`)?(lerobot-train --policy\.type=[^`\n]*)",
        "\n".join(pages),
        re.MULTILINE,
    )
    kinds = {}
    for line in lines:
        config = lerobot_train(None, monkeypatch, *line.split()[1:])
        kinds[config.policy.type] = config.policy
    assert (
        kinds["act"].pretrained_backbone_weights is None
        and kinds["tactile_pi05"].base_checkpoint is None
    )


@pytest.mark.parametrize("name", ALL)
def test_every_file_is_loaded_by_what_reads_it(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    readers = {
        "twin.yaml": load_twin,
        "diagnose": load_robot,
        **dict.fromkeys(("surrogates", "randomised"), load_twin),
        "cotrain": lambda path: lerobot_train(path, monkeypatch),
        "post_train": lambda path: parse(PostTrainConfig, [f"--config_path={path}"]),
        "learn": lambda path: lerobot_train(path, monkeypatch),
    }
    assert readers[name.split("/")[0]](CONFIGS / name) is not None


@pytest.mark.parametrize(
    ("task", "steps"),
    [
        ("assembly_2", 1000),
        ("test_tube", 3000),
        *(pytest.param(task, steps, marks=pytest.mark.slow) for task, steps in (("assembly_1", 1000), ("puzzle", 3000))),
    ],
)  # fmt: skip
def test_the_papers_co_training_is_the_papers_table(
    task: str, steps: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = lerobot_train(CONFIGS / "cotrain" / f"{task}.yaml", monkeypatch)
    policy = config.policy
    assert (config.steps, config.batch_size) == (steps, 192)  # T_co, B
    assert (
        policy.base_checkpoint == "lerobot/pi05_base" and policy.backbone == "full"
    )  # θ₀
    assert (policy.tactile_history, policy.prefix_tokens, policy.suffix_tokens) == (
        10,
        8,
        8,
    )  # L, M_pre, M_suf
    assert (policy.contact_threshold, policy.contact_min_active) == (0.4, 1)  # λ_f, m
    assert (policy.chunk_size, policy.sim_weight) == (10, 0.5)  # H, α
    assert (
        policy.image_noise_std == 0.03 and policy.image_randomization
    )  # σ_v, image rows of App. E
    assert (
        config.optimizer.lr == 2.5e-5 and "adamw" in config.optimizer.type
    )  # η_max, O
    scheduler = config.scheduler
    # T_warm, η_max, η_min
    assert (scheduler.num_warmup_steps, scheduler.peak_lr, scheduler.decay_lr) == (
        100,
        2.5e-5,
        5e-6,
    )

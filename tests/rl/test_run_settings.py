"""``--resume=true``: which settings are read from the run's settings.json, and which changed ones are refused."""

import dataclasses
import json
from pathlib import Path

import pytest

from taccorl.cli.parse import given_names, parse
from taccorl.cli.post_train import PostTrainConfig
from taccorl.errors import TaccorlError
from taccorl.rl import run_settings

BEGUN = [
    "--policy.path=outputs/a #3",
    "--env.task=puzzle",
    "--ppo.actor_lr=4e-6",
    "--anchor.weight=0",
    "--iterations=30",
]


def resumed(*argv: str) -> PostTrainConfig:
    stored = run_settings.stored_options(parse(PostTrainConfig, argv).out, given_names(argv))
    return parse(PostTrainConfig, [*argv, *stored])


@pytest.fixture
def out(tmp_path: Path) -> Path:
    config = dataclasses.replace(parse(PostTrainConfig, BEGUN), out=tmp_path)
    config.policy.path = Path("outputs/a #3")  # YAML would end at the number sign
    run_settings.write(config)
    return tmp_path


def test_everything_comes_from_the_run_but_what_is_given(out: Path) -> None:
    found = resumed(f"--out={out}", "--resume=true", "--iterations=50", "--policy.device=cpu")
    assert isinstance(found, PostTrainConfig) and found.resume and found.out == out
    assert found.policy.path == Path("outputs/a #3").resolve() and found.policy.device == "cpu"
    assert (found.env.task, found.ppo.actor_lr, found.anchor.weight) == ("puzzle", 4e-6, 0)
    assert found.env.twin is None and found.iterations == 50
    run_settings.refuse_changes(found)
    assert resumed(f"--out={out}", "--resume=true").iterations == 30


def test_other_settings_are_refused_by_name(out: Path, tmp_path: Path) -> None:
    with pytest.raises(TaccorlError, match=r"--ppo\.clip 0\.2 there, 0\.3 here.* or none"):
        run_settings.refuse_changes(resumed(f"--out={out}", "--ppo.clip=0.3"))
    file = tmp_path / "other.yaml"
    file.write_text("ppo: {clip: 0.1}\nnoise:\n  level: 0.2\n")
    with pytest.raises(TaccorlError, match=r"--noise\.level 0\.5 there, 0\.2 here; --ppo\.clip 0\.2 there, 0\.1 here"):
        run_settings.refuse_changes(resumed(f"--out={out}", f"--config_path={file}"))
    run_settings.refuse_changes(resumed(f"--out={out}", "--save_freq=3", "--env.task=puzzle"))


def test_settings_that_a_run_of_an_older_version_lacks_have_their_defaults(out: Path) -> None:
    file = out / "settings.json"
    file.write_text(file.read_text().replace('"ppo.adapt_lr": false,', "").replace('"iterations": 30,', ""))
    found = resumed(f"--out={out}")
    run_settings.refuse_changes(found)
    assert found.iterations == 100 and not found.ppo.adapt_lr


def test_a_run_with_a_setting_that_no_longer_exists_is_refused(out: Path) -> None:
    file = out / "settings.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"noise.correlation": 0.9}))
    with pytest.raises(TaccorlError, match=r"noise\.correlation=0\.9"):
        run_settings.refuse_changes(resumed(f"--out={out}"))


def test_a_changed_twin_is_refused(tmp_path: Path) -> None:
    twin = tmp_path / "twin.yaml"
    twin.write_text("seed: 1\n")
    run_settings.write(parse(PostTrainConfig, [f"--env.twin={twin}", f"--out={tmp_path}"]))
    run_settings.refuse_changes(resumed(f"--out={tmp_path}"))
    twin.write_text("seed: 2\n")
    with pytest.raises(TaccorlError, match=r"twin_sha256"):
        run_settings.refuse_changes(resumed(f"--out={tmp_path}"))


def test_a_folder_without_a_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(TaccorlError, match=r"holds no post-training"):
        resumed(f"--out={tmp_path}")
    (tmp_path / "settings.json").write_text("{")
    with pytest.raises(TaccorlError, match=r"is not JSON"):
        resumed(f"--out={tmp_path}")

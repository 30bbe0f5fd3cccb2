"""What a run leaves beside its policy: state that comes back as it was, and settings from which ``--resume=true`` goes on."""

import dataclasses
import json
import pickle
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from taccorl.cli.parse import given_names, parse
from taccorl.cli.post_train import PostTrainConfig
from taccorl.errors import TaccorlError
from taccorl.rl import checkpoint, run_settings


class Hostile:
    """Writes a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return Path.touch, (self.path,)


def same(a: Any, b: Any) -> bool:
    """Equal in type, shape and every bit."""
    if isinstance(a, torch.Tensor | np.ndarray):
        arrays = [np.asarray(x) for x in (a, b)]
        equal = (
            arrays[0].dtype == arrays[1].dtype and arrays[0].shape == arrays[1].shape
        )
        bits = [x.tolist() if x.dtype == object else x.tobytes() for x in arrays]
        return type(a) is type(b) and equal and bits[0] == bits[1]
    if isinstance(a, dict):
        return (
            list(a) == list(b)
            and list(map(type, a)) == list(map(type, b))
            and all(same(a[k], b[k]) for k in a)
        )
    if isinstance(a, list | tuple):
        return type(a) is type(b) and len(a) == len(b) and all(map(same, a, b))
    return type(a) is type(b) and repr(a) == repr(b)


def made_state() -> dict[str, Any]:
    """What optimisers, generators and environments hold: ints as keys, tuples, 128-bit integers, views, empty arrays, NaN."""
    weight = torch.nn.Parameter(torch.linspace(-1, 1, 12).reshape(3, 4))
    optimizer = torch.optim.AdamW([weight], lr=1e-3, betas=(0.9, 0.95))
    weight.square().sum().backward()
    optimizer.step()
    numbers = np.arange(24, dtype=np.float32).reshape(4, 6)
    return {
        "optimizer": optimizer.state_dict(),
        "random": random.getstate(),
        "numpy": np.random.RandomState(3).get_state(),
        "torch": torch.get_rng_state(),
        "generator": np.random.default_rng(1).bit_generator.state,
        "kept": [
            (
                {"seeds": np.array([2**63 - 1]), "flags": np.array([True, False])},
                numbers.T[1:],
            )
        ],
        "views": [numbers[1:], numbers[1:], torch.zeros(2, 3).T],
        "names": np.array([["dropped", None], [None, "a"]], dtype=object),
        "empty": (np.zeros((0, 7)), [], {}, ""),
        "others": [
            float("nan"),
            float("-inf"),
            0.1,
            -0.0,
            True,
            None,
            {"tensor": "0"},
            {"dict": []},
        ],
    }


def test_every_value_comes_back_as_it_was(tmp_path: Path) -> None:
    state = made_state()
    checkpoint.write_state(tmp_path / "pretrained_model", state)
    assert same(checkpoint.load_state(tmp_path / "pretrained_model"), state)


def test_a_value_without_a_form_in_json_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="Hostile"):
        checkpoint.write_state(tmp_path / "pretrained_model", {"x": Hostile(tmp_path)})
    assert not list(tmp_path.rglob("*.safetensors"))


@pytest.mark.parametrize("name", ["state.pt", "state.safetensors"])
def test_a_pickle_in_a_run_is_not_executed(tmp_path: Path, name: str) -> None:
    folder, mark = tmp_path / "training_state", tmp_path / "executed"
    folder.mkdir()
    (folder / name).write_bytes(pickle.dumps(Hostile(mark)))
    with pytest.raises(TaccorlError, match=r"state\.safetensors"):
        checkpoint.load_state(tmp_path / "pretrained_model")
    assert not mark.exists()
    pickle.loads((folder / name).read_bytes())
    assert mark.exists(), "the file was able to do it"


def test_a_damaged_state_is_one_error(tmp_path: Path) -> None:
    """Truncated at 40 places, a bit flipped at 200 in the part that is parsed: numbers' bits are the business of digests."""
    checkpoint.write_state(tmp_path / "pretrained_model", made_state())
    path = tmp_path / "training_state" / "state.safetensors"
    whole, rng = path.read_bytes(), np.random.default_rng(0)
    header = 8 + int.from_bytes(whole[:8], "little")
    for size in rng.integers(0, len(whole), 40):
        path.write_bytes(whole[:size])
        with pytest.raises(TaccorlError, match=r"state\.safetensors"):
            checkpoint.load_state(tmp_path / "pretrained_model")
    for place, bit in rng.integers([0, 0], [header, 8], (200, 2)):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << bit
        path.write_bytes(damaged)
        try:
            checkpoint.load_state(tmp_path / "pretrained_model")
        except TaccorlError as error:
            assert "\n" not in str(error)


# ---- settings ----

BEGUN = [
    "--policy.path=outputs/a #3",
    "--env.task=puzzle",
    "--ppo.actor_lr=4e-6",
    "--anchor.weight=0",
    "--iterations=30",
]


def resumed(*argv: str) -> PostTrainConfig:
    stored = run_settings.stored_options(
        parse(PostTrainConfig, argv).out, given_names(argv)
    )
    return parse(PostTrainConfig, [*argv, *stored])


@pytest.fixture
def out(tmp_path: Path) -> Path:
    config = dataclasses.replace(parse(PostTrainConfig, BEGUN), out=tmp_path)
    config.policy.path = Path("outputs/a #3")  # YAML would end at the number sign
    run_settings.write(config)
    return tmp_path


def test_everything_comes_from_the_run_but_what_is_given(out: Path) -> None:
    found = resumed(
        f"--out={out}", "--resume=true", "--iterations=50", "--policy.device=cpu"
    )
    assert isinstance(found, PostTrainConfig) and found.resume and found.out == out
    assert (
        found.policy.path == Path("outputs/a #3").resolve()
        and found.policy.device == "cpu"
    )
    assert (found.env.task, found.ppo.actor_lr, found.anchor.weight) == (
        "puzzle",
        4e-6,
        0,
    )
    assert found.env.twin is None and found.iterations == 50
    run_settings.refuse_changes(found)
    assert resumed(f"--out={out}", "--resume=true").iterations == 30


def test_other_settings_are_refused_by_name(out: Path, tmp_path: Path) -> None:
    with pytest.raises(
        TaccorlError, match=r"--ppo\.clip 0\.2 there, 0\.3 here.* or none"
    ):
        run_settings.refuse_changes(resumed(f"--out={out}", "--ppo.clip=0.3"))
    file = tmp_path / "other.yaml"
    file.write_text("ppo: {clip: 0.1}\nnoise:\n  level: 0.2\n")
    with pytest.raises(
        TaccorlError,
        match=r"--noise\.level 0\.5 there, 0\.2 here; --ppo\.clip 0\.2 there, 0\.1 here",
    ):
        run_settings.refuse_changes(resumed(f"--out={out}", f"--config_path={file}"))
    run_settings.refuse_changes(
        resumed(f"--out={out}", "--save_freq=3", "--env.task=puzzle")
    )


def test_settings_that_a_run_of_an_older_version_lacks_have_their_defaults(
    out: Path,
) -> None:
    file = out / "settings.json"
    file.write_text(
        file.read_text()
        .replace('"ppo.adapt_lr": false,', "")
        .replace('"iterations": 30,', "")
    )
    found = resumed(f"--out={out}")
    run_settings.refuse_changes(found)
    assert found.iterations == 100 and not found.ppo.adapt_lr


def test_a_run_with_a_setting_that_no_longer_exists_is_refused(out: Path) -> None:
    file = out / "settings.json"
    file.write_text(
        json.dumps(json.loads(file.read_text()) | {"noise.correlation_time": 0.9})
    )
    with pytest.raises(TaccorlError, match=r"noise\.correlation_time=0\.9"):
        run_settings.refuse_changes(resumed(f"--out={out}"))


def test_a_changed_twin_is_refused(tmp_path: Path) -> None:
    twin = tmp_path / "twin.yaml"
    twin.write_text("seed: 1\n")
    run_settings.write(
        parse(PostTrainConfig, [f"--env.twin={twin}", f"--out={tmp_path}"])
    )
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

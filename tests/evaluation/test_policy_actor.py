"""A checkpoint's own processors, the same numbers as lerobot-eval's rollout, and the preflight of what does not fit."""

import dataclasses
import json
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.envs import preprocess_observation
from lerobot.scripts.lerobot_eval import rollout

from taccorl.data.dataset import Dataset
from taccorl.errors import TaccorlError
from taccorl.evaluation.evaluate import Scenes, score
from taccorl.evaluation.policy_actor import open_checkpoint, pictures_on
from taccorl.evaluation.preflight import PolicyFacts, preflight, refuse_differences
from taccorl.lerobot_plugin.env import TaccorlEnvConfig
from taccorl.lineage.manifest import seal_checkpoint
from taccorl.robots import ROBOT
from taccorl.sim.task import tasks
from taccorl.sim.twin import TwinConfig
from taccorl.sim.vector_env import TaccorlVectorEnv

STEPS = 7
SEED = 1000
PLUG, CRADLE = (tasks.get(name).instruction for name in ("assembly_1", "assembly_2"))


def facts(**changes: Any) -> PolicyFacts:
    """What a checkpoint states that fits the environment."""
    inputs = {
        "observation.state": (14,),
        "observation.tactile": (1536,),
        "observation.images.front": (3, 224, 224),
    }
    fitting = PolicyFacts(
        inputs=inputs,
        action_shape=(14,),
        fps=30,
        robot_type="bi_piper_flexitac",
        touch_gain_per_count=1 / 75,
        touch_layout=(4, 32, 12),
        ranges={"action": (ROBOT.action_low, ROBOT.action_high)},
        instructions=(PLUG,),
        pictures_in_training="crop 95 %",
        pictures_in_use={
            "clear": "clear, their middle 95 %",
            "randomised": "crop 95 %",
        },
    )
    return dataclasses.replace(fitting, **changes)


def test_pictures_become_the_numbers_of_lerobots_conversion():
    pictures = np.arange(2 * 16 * 8 * 3, dtype=np.uint8).reshape(2, 16, 8, 3)
    theirs = preprocess_observation(
        {"pixels": {"front": pictures}, "agent_pos": np.zeros((2, 14))}
    )
    ours = pictures_on(torch.device("cpu"), pictures)
    assert (
        torch.equal(ours, theirs["observation.images.front"]) and ours.is_contiguous()
    )


def test_a_policy_that_fits_passes():
    """What is compared by containment is not called the same: one of three cameras, data within the limits."""
    checks = preflight(facts(), TwinConfig(), tasks=["assembly_1"])
    assert {c.what for c in checks if c.verdict == "within"} == {
        "cameras",
        "pictures",
        "range of action",
    }
    assert {c.verdict for c in checks} == {"same", "within"}
    refuse_differences(checks, "policy")
    assert {c.what for c in checks} >= {
        "task",
        "cameras",
        "state",
        "touch",
        "touch gain",
        "action",
        "robot",
        "rate",
    }


@pytest.mark.parametrize(
    ("instructions", "tasks", "verdict"),
    [
        ((PLUG,), ["assembly_1"], "same"),
        ((PLUG, CRADLE), ["assembly_1"], "within"),
        ((PLUG, CRADLE), ["assembly_2", "assembly_1"], "same"),
        ((CRADLE,), ["assembly_1"], "differs"),
        ((PLUG,), ["assembly_1", "assembly_2"], "differs"),
        (
            ("plug it in",),
            ["assembly_1"],
            "not stated",
        ),  # words of a recording, which may be of this task
        (("plug it in", CRADLE), ["assembly_1"], "not stated"),
        (None, ["assembly_1"], "not stated"),
    ],
)
def test_a_policy_of_another_task_is_found_by_its_instructions(
    instructions, tasks, verdict
):
    checks = preflight(facts(instructions=instructions), TwinConfig(), tasks=tasks)
    (check,) = [c for c in checks if c.what == "task"]
    assert check.verdict == verdict and check.environment == ", ".join(tasks)
    assert (check.policy == "task not stated") == (instructions is None)
    assert ("assembly_2" in check.policy) == (CRADLE in (instructions or ()))
    if verdict == "differs":
        with pytest.raises(
            TaccorlError,
            match=f"task: {check.policy} in the checkpoint, {check.environment} in the env",
        ):
            refuse_differences(checks, "policy")


def test_pictures_that_differ_from_training_are_said_and_never_refused():
    for training, pictures, verdict in (
        ("crop 95 %", "randomised", "same"),
        ("crop 95 %", "clear", "within"),
        ("clear", "randomised", "chosen"),
        (None, "randomised", "not stated"),
    ):
        checks = preflight(
            facts(pictures_in_training=training), TwinConfig(), pictures=pictures
        )
        (check,) = [c for c in checks if c.what == "pictures"]
        assert (
            check.verdict == verdict
            and check.environment == facts().pictures_in_use[pictures]
        )
        refuse_differences(checks, "policy")


def test_what_a_checkpoint_does_not_state_is_no_difference():
    checks = preflight(PolicyFacts(inputs={}, action_shape=(14,)), TwinConfig())
    refuse_differences(checks, "policy")
    assert {c.what for c in checks if c.verdict == "not stated"} == {"robot", "rate"}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"inputs": {"observation.images.top": (3, 224, 224)}}, "cameras: top 224×224 in the checkpoint, front 224×224"),
        ({"inputs": {"observation.images.front": (3, 96, 96)}}, "cameras: front 96×96"),
        ({"inputs": {"observation.state": (7,)}}, "state: 7 in the checkpoint, 14 in the environment"),
        ({"inputs": {"observation.tactile": (768,)}}, "touch: 768 in the checkpoint, 1536"),
        ({"inputs": {"observation.force": (6,)}}, "other inputs: observation.force"),
        ({"action_shape": (7,)}, "action: 7 in the checkpoint, 14"),
        ({"fps": 50}, "rate: 50 Hz in the checkpoint, 30 Hz in the environment"),
        ({"robot_type": "aloha"}, "robot: aloha in the checkpoint, bi_piper_flexitac"),
        ({"action_names": tuple("abcdefghijklmn")}, "action names: a, b, c"),
        ({"touch_gain_per_count": 1 / 255}, "touch gain: counts × 0.00392157 in the checkpoint, counts × 0.0133333"),
        ({"touch_has_unit": False}, "unit of touch: statistics of its dataset in the checkpoint, counts above baseline"),
        ({"touch_layout": (2, 16, 16)}, "touch layout: 2 × 16 × 16 in the checkpoint, 4 × 32 × 12"),
        ({"ranges": {"action": (np.degrees(ROBOT.action_low), np.degrees(ROBOT.action_high))}}, "range of action: -170 … 180 in"),
        ({"unnormalised": ("action",)}, "normalisation: no statistics of action"),
    ],
)  # fmt: skip
def test_each_difference_is_named_with_both_sides(changes, words):
    checks = preflight(facts(**changes), TwinConfig())
    with pytest.raises(
        TaccorlError, match="policy does not fit the environment"
    ) as error:
        refuse_differences(checks, "policy")
    assert words in str(error.value) and str(error.value).endswith("Nothing was run")


def test_a_twin_without_the_camera_does_not_fit():
    blind = dataclasses.replace(
        TwinConfig(), cameras=[c for c in TwinConfig().cameras if c.name != "front"]
    )
    with pytest.raises(
        TaccorlError,
        match="cameras: front 224×224 in the checkpoint, left_wrist 224×224",
    ):
        refuse_differences(preflight(facts(), blind), "policy")


def test_a_checkpoint_states_its_facts(checkpoint):
    opened = open_checkpoint(checkpoint, "cpu")
    found = opened.facts()
    assert (
        found.inputs["observation.images.front"] == (3, 224, 224)
        and found.action_shape == (14,)
        and found.fps == 30
    )
    assert found.touch_layout == (
        4,
        32,
        12,
    ) and found.touch_gain_per_count == pytest.approx(1 / 75)
    low, high = found.ranges["action"]
    assert (
        high - low == pytest.approx(np.full(14, 0.1), abs=1e-5)
        and found.unnormalised == ()
    )
    refuse_differences(preflight(found, TwinConfig()), "policy")
    assert found.pictures_in_training == found.pictures_in_use["randomised"]
    assert str(found.pictures_in_training).startswith("crop 95 %, rotation ± 5°, ")
    assert (
        len(opened.digest) == 64
        and opened.digest == open_checkpoint(checkpoint, "cpu").digest
    )


def test_executed_actions_are_at_most_a_chunk(checkpoint):
    chunk = open_checkpoint(checkpoint, "cpu").config.chunk_size
    assert (
        open_checkpoint(checkpoint, "cpu", n_action_steps=1).config.n_action_steps == 1
    )
    for wrong in (0, -1, chunk + 1):
        with pytest.raises(
            TaccorlError, match=rf"--policy\.n_action_steps={wrong}: .*1 to {chunk}"
        ):
            open_checkpoint(checkpoint, "cpu", n_action_steps=wrong)


def test_instructions_are_those_of_the_dataset_that_the_training_names(
    checkpoint, tmp_path
):
    from tiny_dataset import write_tiny

    trained = shutil.copytree(checkpoint, tmp_path / "trained")
    assert open_checkpoint(trained, "cpu").facts().instructions is None
    (trained / "train_config.json").write_text(
        json.dumps({"dataset": {"root": str(tmp_path / "dataset")}})
    )
    assert (
        open_checkpoint(trained, "cpu").facts().instructions is None
    )  # not on this machine
    root = write_tiny(tmp_path / "dataset", cameras=3)
    assert (
        open_checkpoint(trained, "cpu").facts().instructions
        == Dataset(root).instructions
        != ()
    )


def test_statistics_that_are_missing_are_found(checkpoint, tmp_path):
    from lerobot.policies.factory import make_pre_post_processors

    bare = shutil.copytree(checkpoint, tmp_path / "bare")
    for processor in make_pre_post_processors(
        open_checkpoint(checkpoint, "cpu").config
    ):
        processor.save_pretrained(bare)
    found = open_checkpoint(bare, "cpu").facts()
    assert set(found.unnormalised) == {"observation.state", "action"}


def test_folders_that_are_no_checkpoint_are_refused(checkpoint, tmp_path):
    with pytest.raises(
        TaccorlError, match=r"no config\.json there; give the folder pretrained_model"
    ):
        open_checkpoint(tmp_path)
    with pytest.raises(TaccorlError, match=f"did you mean {checkpoint}"):
        open_checkpoint(checkpoint.parent)
    other = shutil.copytree(checkpoint, tmp_path / "other")
    config = json.loads((other / "config.json").read_text())
    (other / "manifest.json").unlink()
    (other / "config.json").write_text(json.dumps({**config, "type": "no_such_policy"}))
    with pytest.raises(TaccorlError, match="Policy type 'no_such_policy'"):
        open_checkpoint(other)
    weightless = shutil.copytree(checkpoint, tmp_path / "weightless")
    (weightless / "manifest.json").unlink()
    (weightless / "model.safetensors").unlink()
    with pytest.raises(TaccorlError, match="weightless"):
        open_checkpoint(weightless, "cpu").load(SEED)
    (weightless / "policy_preprocessor.json").unlink()
    with pytest.raises(TaccorlError, match=r"has no policy_preprocessor\.json"):
        open_checkpoint(weightless, "cpu")


def lerobot_rollout(path: Path, task: str, n: int, length: int | None) -> Any:
    """LeRobot's own evaluation in its own order: seed, environments, policy, processors, rollout."""
    import torch
    from lerobot.configs import PreTrainedConfig
    from lerobot.envs import make_env, make_env_pre_post_processors
    from lerobot.policies import make_policy, make_pre_post_processors
    from lerobot.utils.random_utils import set_seed

    set_seed(SEED)
    env_config = TaccorlEnvConfig(task=task, episode_length=length)
    envs = make_env(env_config, n_envs=n)["taccorl"][0]
    config = PreTrainedConfig.from_pretrained(path, cli_overrides=["--device=cpu"])
    config.pretrained_path = path
    policy = make_policy(config, env_cfg=env_config).eval()
    before, after = make_pre_post_processors(
        config,
        pretrained_path=str(path),
        preprocessor_overrides={"device_processor": {"device": "cpu"}},
    )
    env_before, env_after = make_env_pre_post_processors(env_config, config)
    with torch.no_grad():
        done = rollout(
            envs,
            policy,
            env_before,
            env_after,
            before,
            after,
            seeds=list(range(SEED, SEED + n)),
        )
    envs.close()
    return done


@pytest.mark.slow
def test_actions_are_those_of_lerobot_eval(checkpoint, monkeypatch):
    """Flow matching draws noise: equal actions show equal observations, processors, weights and random numbers."""
    theirs = lerobot_rollout(checkpoint, "assembly_1", 2, STEPS)
    where = Scenes(tasks=("assembly_1",), episodes=2, seed=SEED, episode_length=STEPS)
    actor = open_checkpoint(checkpoint, "cpu").load(SEED)
    rendered: list[int] = []
    look = TaccorlVectorEnv.observe

    def observe(envs: TaccorlVectorEnv, images: bool = False) -> Any:
        if images:
            rendered.append(int(envs.sim.judge.steps[0]))
        return look(envs, images)

    with monkeypatch.context() as patch:
        patch.setattr(TaccorlVectorEnv, "observe", observe)
        ours = score(where, actor)
    assert np.array_equal(np.stack([r.actions for r in ours]), theirs["action"].numpy())
    assert [r.row.success for r in ours] == theirs["success"].any(1).tolist()
    # Pictures were rendered for the two chunks only: n_action_steps is 5, the episode has 7 steps.
    assert (
        rendered == [0, 5] and np.ptp(theirs["action"].numpy(), axis=1).max() > 1e-3
    )  # it moves
    # A second task of the same run, and a second run, begin with the same random numbers.
    again = score(where, actor)
    assert all(
        np.array_equal(a.actions, b.actions) for a, b in zip(ours, again, strict=True)
    )


@pytest.mark.parametrize(
    "named", ["subprocess.Popen", "taccorl.lineage.store.Store", "no_such_package.Step"]
)
def test_a_class_that_is_no_step_is_not_called(checkpoint, tmp_path, named):
    """LeRobot imports and calls the class that a processor's file names."""
    foreign, mark = (
        shutil.copytree(checkpoint, tmp_path / "foreign"),
        tmp_path / "executed",
    )
    file = foreign / "policy_postprocessor.json"
    told = json.loads(file.read_text())
    told["steps"].append({"class": named, "config": {"args": ["touch", str(mark)]}})
    file.write_text(json.dumps(told))
    (foreign / "manifest.json").unlink(missing_ok=True)
    with pytest.raises(TaccorlError, match=named):
        open_checkpoint(foreign, "cpu")
    time.sleep(0.1)  # of a process that was started
    assert not mark.exists()


FILES = [
    "config.json",
    "model.safetensors",
    "policy_preprocessor.json",
    "policy_postprocessor.json",
    "train_config.json",
]
FILES += [
    "manifest.json",
    "*normalizer_processor.safetensors",
    "*unnormalizer_processor.safetensors",
]


@pytest.fixture(scope="module")
def trained(checkpoint: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = shutil.copytree(
        checkpoint, tmp_path_factory.mktemp("trained") / "checkpoint"
    )
    (folder / "train_config.json").write_text(
        json.dumps({"dataset": {"root": "/nowhere"}, "steps": 10})
    )
    seal_checkpoint(folder)
    return folder


def damaged(data: bytes, how: str, rng: np.random.Generator) -> bytes:
    place = int(rng.integers(len(data)))
    if how == "truncated":
        return data[:place]
    flipped = data[place] ^ 1 << int(rng.integers(8))
    return data[:place] + bytes([flipped]) + data[place + 1 :]


@pytest.mark.parametrize("how", ["flipped", "truncated"])
@pytest.mark.parametrize("name", FILES)
def test_every_damage_of_a_checkpoint_is_found_and_one_line(
    trained, tmp_path, name, how
):
    """A flipped bit of the manifest that is in no digest may be any: the checkpoint is then whole."""
    folder, rng = shutil.copytree(trained, tmp_path / "copy"), np.random.default_rng(0)
    file = next(folder.glob(name))
    whole, digest = file.read_bytes(), open_checkpoint(folder, "cpu").digest
    for _ in range(5):
        file.write_bytes(damaged(whole, how, rng))
        if (name, how) == ("manifest.json", "flipped"):
            try:
                assert open_checkpoint(folder, "cpu").digest == digest
            except TaccorlError as error:
                assert str(folder) in str(error) and "\n" not in str(error)
            continue
        with pytest.raises(TaccorlError, match=rf"copy.*{file.name}") as caught:
            open_checkpoint(folder, "cpu")
        assert "\n" not in str(caught.value)
    file.write_bytes(whole)
    assert open_checkpoint(folder, "cpu").digest == digest


@pytest.mark.parametrize("how", ["flipped", "truncated"])
@pytest.mark.parametrize("name", [name for name in FILES if name != "manifest.json"])
def test_damage_without_digests_is_never_a_traceback(
    trained, tmp_path, name, how, caplog
):
    """Of a foreign checkpoint that can be read all the same, a note says that nothing was compared."""
    folder, rng = shutil.copytree(trained, tmp_path / "copy"), np.random.default_rng(1)
    file = next(folder.glob(name))
    whole = file.read_bytes()
    (folder / "manifest.json").unlink(missing_ok=True)
    for _ in range(4):
        file.write_bytes(damaged(whole, how, rng))
        caplog.clear()
        try:
            opened = open_checkpoint(folder, "cpu")
            preflight(opened.facts(), TwinConfig())
            opened.load(SEED)
        except TaccorlError as error:
            assert "\n" not in str(error)
        else:
            assert how == "flipped" or name == "train_config.json"
        assert f"{folder}: config.json, model.safetensors" in caplog.text


KILLED = """
import sys
from pathlib import Path
sys.path[:0] = sys.argv[2:]
import torch
torch.set_num_threads(1)
from lineage.kill_points import survives
import taccorl.lerobot_plugin
from taccorl.evaluation.policy_actor import open_checkpoint, pictures_on
folder = Path(sys.argv[1])
opened = open_checkpoint(folder / "whole", "cpu")
policy = opened.load(0).policy

def save(folder):
    policy.save_pretrained(folder)
    for processor in (opened.preprocessor, opened.postprocessor):
        processor.save_pretrained(folder)

for kill_at in range(1, 1000):
    if survives(kill_at, lambda: save(folder / f"at_{kill_at}")):
        print(kill_at - 1)
        break
"""


@pytest.mark.slow
def test_killed_between_any_two_files_a_checkpoint_is_refused_or_whole(
    checkpoint, tmp_path, caplog
):
    shutil.copytree(checkpoint, tmp_path / "whole")
    tests = Path(__file__).parents[1]
    words = [
        sys.executable,
        "-c",
        KILLED,
        str(tmp_path),
        str(tests),
        str(tests / "lineage"),
    ]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    points, refused = int(done.stdout.split()[-1]), 0
    expected = open_checkpoint(tmp_path / f"at_{points + 1}", "cpu").digest
    assert points > 15 and "without digests" not in caplog.text
    for kill_at in range(1, points + 1):
        folder = tmp_path / f"at_{kill_at}"
        try:
            opened = open_checkpoint(folder, "cpu")
            opened.load(SEED)
        except TaccorlError as error:
            assert "\n" not in str(error)
            refused += 1
        else:
            assert opened.digest == expected
    assert refused > 10

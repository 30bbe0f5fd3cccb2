"""The pipelines learn and cotrain, small: from nothing (simulated) to a score, and again without doing anything anew."""

import dataclasses
import json
import subprocess
from pathlib import Path

import numpy as np
import pytest

from pipelines import cotrain, learn
from pipelines.paper_tables import row_of
from pipelines.post_training import PostTraining
from pipelines.surrogate_twin import named
from taccorl.data.dataset import Dataset
from taccorl.data.origin import Origin
from taccorl.policies.tactile_pi05.configuration_tactile_pi05 import TactilePI05Config
from taccorl.sim.part_poses import PARTS_KEY
from taccorl.sim.twin import TwinConfig
from taccorl.sim.twin_file import load_twin
from taccorl.training.cotrain import origins_of

LATE = "configs/surrogates/late.yaml"


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_chain_ends_in_a_score_and_goes_on_where_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = [
        "--small",
        "--task=assembly_2",
        f"--out={tmp_path}",
        "--episodes=[1,2]",
        "--sources=[0,2]",
    ]
    less, done, *_ = learn.main(words)
    dataset = Dataset(done.dataset)
    stored = dataset.num_episodes, dataset.rows_per_picture, len(dataset.unstored)
    assert stored == (2, 3, 3)  # three cameras whose frames are in the cache alone
    made = dataset.episode_facts(0)["provenance"]["simulation"]
    assert (
        made["source"]["hands"]["grasp_m"] == 0.004
        and made["source"]["hands"]["pulse_rad"] == 0.02
    )
    config = TactilePI05Config.from_pretrained(done.policy)
    assert tuple(config.image_resolution) == (84, 112)
    processor = json.loads((done.policy / "policy_preprocessor.json").read_text())
    assert any(
        "HandPosesStep" in json.dumps(step) for step in processor["steps"]
    )  # from the names of the dataset
    assert json.loads((less.policy / "train_config.json").read_text())["dataset"][
        "episodes"
    ] == [0]
    told = [
        json.loads((folder / "evaluation.json").read_text()) for folder in done.scores
    ]
    assert [(one["scenes"]["seed"], one["scores"][0]["n"]) for one in told] == [
        (learn.SCORE_SEED, 2)
    ]
    rows = [
        row.split(" | ")
        for row in (tmp_path / "scores.md").read_text().splitlines()
        if row.startswith("| assembly_2")
    ]
    made = ("1", "2", "1 of 2 sources", "2 of 2 sources")
    assert [(row[2], row[6], row[8]) for row in rows] == [
        (n, "8", "0 of 2") for n in made
    ]
    commands: list[str] = []
    monkeypatch.setattr(
        learn,
        "step",
        lambda verb, _: commands.append(verb.__module__.rpartition(".")[2]),
    )
    monkeypatch.setattr(
        subprocess, "run", lambda *_, **__: pytest.fail("LeRobot was run again")
    )
    assert learn.main(words)[:2] == [less, done]
    assert commands == [
        "collect",
        "collect",
        "augment",
    ]  # which find what they made; no training


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_policy_is_post_trained_and_scored_in_the_same_scenes_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = [
        "--small",
        "--post_train=[configs/post_train/tiny.yaml]",
        "--post_train_options=[--iterations=1,--anchor.weight=0,--rerun=false]",
        f"--out={tmp_path}",
    ]
    (done,) = learn.main(words)
    start, after = (row_of(score) for score in done.scores)
    same = ("task", "n", "first_scene", "seed", "demonstrations", "steps", "executed")
    assert [start[name] for name in same] == [after[name] for name in same]
    assert "stage" not in start
    assert after["stage"] == "ppo"
    assert after["settings"].startswith("tiny_")
    assert after["decisions"] == 4 * 6  # environments, decisions of each
    assert after["updates"] == 1
    assert len(after["curve"]) == 1
    assert after["key"] != start["key"]
    monkeypatch.setattr(learn, "step", lambda *_: None)
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: pytest.fail("run again"))
    assert learn.main(words) == [done]


def test_a_stopped_run_of_post_training_goes_on_and_a_finished_one_does_not(tmp_path):
    config = Path("configs/post_train/tiny.yaml")
    words = ["--iterations=2", "--anchor.weight=0"]
    run = PostTraining.of(tmp_path / "start", tmp_path, config, words, 7)
    assert run.command(["--env.task=puzzle"])[:2] == [
        "post-train",
        f"--config_path={config}",
    ]
    run.policy.mkdir(parents=True)
    row = {"decisions": 24, "actor_steps": 0, "seconds": {"physics": 1.5}}
    (run.folder / "progress.jsonl").write_text(json.dumps(row) + "\n")
    resumed = run.command(["--env.task=puzzle"])
    assert resumed == ["post-train", "--resume=true", f"--out={run.folder}"]
    with (run.folder / "progress.jsonl").open("a") as file:
        file.write(json.dumps(row | {"decisions": 48, "actor_steps": 3}) + "\n")
    assert run.command([]) == []
    assert run.about() == {
        "stage": "ppo",
        "settings": run.settings,
        "decisions": 48,
        "updates": 1,
        "ppo_s": 3,
    }
    other = PostTraining.of(tmp_path / "start", tmp_path, config, words[:1], 7)
    assert other.folder != run.folder
    with pytest.raises(SystemExit, match="--iterations=30"):
        PostTraining.of(tmp_path / "start", tmp_path, config, words[1:], 7)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_demonstrations_of_a_surrogate_are_merged_as_the_robot_s(
    tmp_path: Path,
) -> None:
    words = [
        "--small",
        f"--scored_in=[{LATE}]",
        "--twins=[nominal,surrogate]",
        "--real=1",
        "--sim_weight=[0,0.5]",
    ]
    alone, mixed, other = learn.main(
        [*words, "--episodes=1", f"--out={tmp_path}"]
    )  # of the surrogate alone: once
    about = [
        json.loads((one.scores[0] / "settings.json").read_text())
        for one in (alone, mixed, other)
    ]
    assert [(a["demonstrations"], a["real"], a["sim_weight"]) for a in about] == [
        (0, 1, 0),
        (1, 1, 0.5),
        (1, 1, 0.5),
    ]
    assert [a["twin"].rpartition("_")[0] for a in about] == ["", "", "late"]
    assert [
        TactilePI05Config.from_pretrained(one.policy).sim_weight
        for one in (alone, mixed)
    ] == [0, 0.5]
    assert [origin.domain for origin in origins_of(Dataset(mixed.dataset))] == [
        "surrogate",
        "twin",
    ]
    poses = (
        Dataset(mixed.dataset).episode(0).arrays[PARTS_KEY],
        Dataset(mixed.dataset).episode(1).arrays[PARTS_KEY],
    )
    assert np.isnan(poses[0]).all() and np.isfinite(poses[1]).all()
    assert PARTS_KEY not in Dataset(alone.dataset).info["features"]


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_second_policy_learns_from_the_demonstrations_and_from_corrections_of_the_first(
    tmp_path: Path,
) -> None:
    words = ["--small", "--episodes=[1,2]", "--corrections=2", f"--out={tmp_path}"]
    first, _ = learn.main(words)
    about = [
        json.loads((score / "settings.json").read_text()) for score in first.scores
    ]
    assert [(one["demonstrations"], one.get("corrected")) for one in about] == [
        (1, None),
        (3, 1),
    ]
    config = json.loads(
        (
            first.scores[1].parent
            / "checkpoints/last/pretrained_model/train_config.json"
        ).read_text()
    )
    assert config["dataset"]["episodes"] == [
        0,
        2,
        3,
    ]  # of two demonstrations the first; what is behind them
    learnt = Dataset(root := Path(config["dataset"]["root"]))
    fixes = Dataset(root.with_name(root.name.removesuffix("_too")))
    for k, part in ((0, Dataset(first.dataset)), (2, fixes)):
        assert np.array_equal(
            learnt.episode(k).arrays["action"], part.episode(0).arrays["action"]
        )
    assert (
        "takeover_step"
        in fixes.episode_facts(0)["provenance"]["simulation"]["correction"]
    )


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--corrections=-1"], "corrections=-1: at least 0"),
        (
            [f"--scored_in=[{LATE}]", "--real=5", "--corrections=9"],
            "corrections=9: takes no --real",
        ),
        (["--train=configs/learn/smal.yaml"], "no such file"),
        (["--executed=17"], "at most 16, the chunk_size"),
        (["--seeds=[]"], "seeds=.*: at least 0"),
        (["--difficulty=[train,hrd]"], "difficulty=hrd"),
        (["--hide=[]"], "give one of nothing, touch"),
        (["--sources=[-1]"], "at least 0"),
        (["--twins=[nominal,mendd]"], "did you mean 'mended'"),
        (["--twins=[mended]"], "of which surrogate"),
        (["--singly=true"], "--singly: of which surrogate"),
        (["--scored_in=[no_such.yaml]"], "no_such.yaml"),
        (["--real=5"], "--real=5: of which surrogate"),
        (["--real=-1"], "real=-1: at least 0"),
        (
            [f"--scored_in=[{LATE}]", "--real=5", "--episodes=[1,2]"],
            "one number of --episodes",
        ),
        (
            [f"--scored_in=[{LATE}]", "--real=5", "--twins=[configs/randomised]"],
            "no folder of --twins",
        ),
        (["--sim_weight=[0.5]"], r"beside that of --real=50"),
        (["--sim_weight=[0.5,2]"], r"sim_weight=\[0.5, 2.0\]: .*0 … 1"),
    ],
)
def test_what_it_does_not_know_is_named(words: list[str], said: str) -> None:
    with pytest.raises(SystemExit, match=said):
        learn.main(words)


def test_policies_of_the_nominal_twin_are_scored_in_every_surrogate_and_in_each_of_its_effects_alone(
    tmp_path,
):
    friction = [
        {"effect": "coulomb_friction", "arm": arm, "joints": ["joint1"], "torque_nm": 2}
        for arm in ("left", "right")
    ]
    delay = {"effect": "command_delay", "arm": "left", "delay_s": 0.03}
    robot, other = tmp_path / "robot.yaml", Path("configs/surrogates/late.yaml")
    robot.write_text(
        json.dumps(
            {"sensor": {"normal_stiffness_per_m": 600}, "effects": [*friction, delay]}
        )
    )
    asked = learn.LearnConfig(
        twins=["nominal", "surrogate"], scored_in=[robot, other], out=tmp_path
    )
    assert learn._twins(asked) == {None: [robot, other], robot: [robot], other: [other]}
    several = dataclasses.replace(asked, twins=["configs/randomised"])
    assert learn._twins(several) == {Path("configs/randomised"): [robot, other]}
    scored = learn._twins(dataclasses.replace(asked, scored_in=[robot], singly=True))
    assert scored[robot] == [robot] and scored[None][:2] == [robot, None]
    alone = {path.stem: load_twin(path) for path in scored[None][2:] if path}
    whole, nominal = load_twin(robot), TwinConfig()
    assert alone == {
        "sensor_of_robot": dataclasses.replace(nominal, sensor=whole.sensor),
        "coulomb_friction_of_robot": dataclasses.replace(
            nominal, effects=whole.effects[:2]
        ),
        "command_delay_of_robot": dataclasses.replace(
            nominal, effects=whole.effects[2:]
        ),
    }


def test_only_gpus_that_the_user_allows_are_used(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "2,3")
    assert learn._gpus() == ["2", "3"]


ROOT = Path(__file__).parents[2]
TWIN = Origin("twin", "MuJoCo twin, not a robot")


@pytest.mark.slow
@pytest.mark.timeout(1500)
@pytest.mark.parametrize("cache", ["none", "host"])
def test_demonstrations_of_both_domains_become_a_policy_and_its_scores(
    cache, tmp_path, monkeypatch
):
    monkeypatch.chdir(ROOT)
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    words = ["--small", f"--out={tmp_path}", f"--cache={cache}"]
    if cache == "host":
        words.append(
            "--train_options=[--steps=4,--batch_size=4,--policy.pose_loss=0.1]"
        )
    cotrain.main(words)
    out = tmp_path / "assembly_2"

    name = f"surrogate_{named(cotrain.CotrainConfig().robot)}"
    both = Dataset(out / f"{name}_and_twin")
    origins = [both.episode(k).origin for k in range(both.num_episodes)]
    num_sim = 2 if cache == "none" else 1
    assert origins[0].domain == "surrogate" and origins[1:] == [TWIN] * num_sim
    assert (
        bool(both.unstored)
        == (cache == "host")
        == ("observation.environment_state" in both.info["features"])
    )
    assert both.spec.action_time == "next_row"
    real = Dataset(out / name)
    assert (
        real.provenance is not None and real.provenance["stage"] == "dataset"
    )  # through recordings and ingest
    is_sim = [
        both.values(k, ["observation.is_sim"])["observation.is_sim"].mean()
        for k in range(1 + num_sim)
    ]
    assert is_sim == [0.0] + [1.0] * num_sim
    (trained,) = out.glob(
        "policy_*/checkpoints/last/pretrained_model/train_config.json"
    )
    config = json.loads(trained.read_text())
    assert config["steps"] == 4 and config["policy"]["sim_weight"] == 0.5
    of_tiny_yaml = {"chunk_size": 16, "image_randomization": False}
    assert of_tiny_yaml.items() <= config["policy"].items()
    assert "surrogate" in config["dataset"]["repo_id"]

    told = json.loads((out / "outcomes.json").read_text())
    assert "surrogate" in told["data"] and told["steps"] == 4
    assert [(row["where"], row["seed"]) for row in told["outcomes"]] == [
        (f"{name} (simulated)", seed)
        for name in ("twin", "surrogate")
        for seed in (1000, 1001)
    ]
    for score in told["scores"].values():  # four steps of training insert nothing
        assert (score["successes"], score["attempts"]) == (0, 2)
        assert score["interval_95"][1] == pytest.approx(
            1.96**2 / (2 + 1.96**2), abs=1e-3
        )  # Wilson's end for 0 of 2
    page = (out / "outcomes.md").read_text()
    assert (
        "| surrogate (simulated) | 0 of 2: 0 % (95 %: 0 … 66) |" in page
        and "Nothing here is of a robot" in page
    )

    made = {
        path: path.stat().st_mtime_ns
        for path in out.rglob("*")
        if path.is_file() and path.parent != out
    }
    monkeypatch.setattr(
        subprocess, "run", lambda *_, **__: pytest.fail("LeRobot was run again")
    )
    cotrain.main(words)
    again = {
        path: path.stat().st_mtime_ns
        for path in out.rglob("*")
        if path.is_file() and path.parent != out
    }
    assert again == made
    assert json.loads((out / "outcomes.json").read_text()) == told


def test_what_the_pipeline_does_not_know_is_named() -> None:
    with pytest.raises(SystemExit, match=r"did you mean 'robot'\?"):
        cotrain.main(["--robto=a.yaml"])
    with pytest.raises(
        SystemExit,
        match=r"--robot: a\.yaml: no such file.*; configs/surrogates has some",
    ):
        cotrain.main(["--robot=a.yaml"])

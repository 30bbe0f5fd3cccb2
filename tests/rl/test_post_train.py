"""The command: a run at its smallest, its folders, a run that is stopped and goes on, and input that does not fit."""

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import wandb
from tiny_checkpoint import write_checkpoint
from wandb.proto import wandb_internal_pb2
from wandb.sdk.internal.datastore import DataStore

from taccorl.cli.main import main
from taccorl.evaluation.policy_actor import open_checkpoint
from taccorl.lineage.manifest import require_checkpoint, seal_checkpoint
from taccorl.rl.settings import AnchorSettings

GAIN = ("0.013333333333333334", "0.0133333333")  # the tests' policies, and datasets


@pytest.fixture(scope="module")
def start(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return with_gain(write_checkpoint(tmp_path_factory.mktemp("start")))


def with_gain(folder: Path) -> Path:
    for file in folder.glob("*.json"):
        file.write_text(file.read_text().replace(*GAIN))
    seal_checkpoint(folder)
    return folder


def options(start: Path, real: Path, out: Path, **changes: Any) -> list[str]:
    given = {
        "policy.path": start,
        "env.task": "assembly_2",
        "env.num_envs": 2,
        "env.decisions": 2,
        "env.episode_length": 12,
        "anchor.dataset": real,
        "anchor.batch_size": 2,
        "ppo.actor_lr": 1e-5,
        "noise_check": False,
        "iterations": 1,
        "save_freq": 1,
        "out": out,
        **changes,
    }
    return ["post-train", *(f"--{name}={value}" for name, value in given.items())]


def progress(out: Path) -> list[dict[str, Any]]:
    return [
        json.loads(line) for line in (out / "progress.jsonl").read_text().splitlines()
    ]


def weights(out: Path) -> dict[str, torch.Tensor]:
    return (
        open_checkpoint(out / "checkpoints" / "last" / "pretrained_model", "cpu")
        .load(0)
        .policy.state_dict()
    )


def logged(file: Path) -> list[dict[str, Any]]:
    """Rows that a run of Weights & Biases has on this disk."""
    store, rows = DataStore(), []
    store.open_for_scan(str(file))
    for data in iter(store.scan_data, None):
        record = wandb_internal_pb2.Record.FromString(data)
        items = {
            ".".join(item.nested_key) or item.key: json.loads(item.value_json)
            for item in record.history.item
        }
        rows += [items] if items else []
    return rows


def test_one_iteration_leaves_a_policy_folder_and_a_line(start, real, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(options(start, real, out)) == 0
    printed = capsys.readouterr().out
    assert "mrad" in printed and "mm" in printed
    (row,) = progress(out)
    assert (
        row["decisions"] == 4
        and row["first_ratio_error"] < 1e-5
        and row["anchor_loss"] > 0
        and row["drift"] > 0
    )
    assert printed.count(f"{row['drift']:.4f}") == 1
    assert set(row["seconds"]) == {"pictures", "policy", "physics", "update", "drift"}
    before, after = (
        open_checkpoint(start, "cpu").load(0).policy.state_dict(),
        weights(out),
    )
    moved = [
        name for name, value in before.items() if not torch.equal(value, after[name])
    ]
    assert moved and not any("paligemma.model" in name for name in moved)
    assert main(options(start, real, out)) == 2  # in use
    assert "--resume=true" in capsys.readouterr().err
    last = out / "checkpoints" / "last"
    assert (
        require_checkpoint(last / "pretrained_model", "")
        == require_checkpoint(last / "training_state", "")
        == []
    )


@pytest.mark.slow
def test_damage_of_a_run_is_one_line_and_the_way_out_works(
    start, real, tmp_path, capsys
):
    out = tmp_path / "out"
    assert main(options(start, real, out)) == 0
    last, _ = out / "checkpoints" / "last", capsys.readouterr()
    again = [
        "post-train",
        f"--out={out}",
        "--resume=true",
        "--iterations=1",
        "--noise_check=false",
    ]
    rng = np.random.default_rng(0)
    for name in (
        "training_state/state.safetensors",
        "pretrained_model/model.safetensors",
        "pretrained_model/config.json",
    ):
        whole = (last / name).read_bytes()
        data = bytearray(whole)
        data[rng.integers(len(data))] ^= 1 << rng.integers(8)
        (last / name).write_bytes(data)
        assert main(again) == 2 and Path(name).name in capsys.readouterr().err
        (last / name).write_bytes(whole)
    (out / "progress.jsonl").write_bytes(
        b"\xff" + (out / "progress.jsonl").read_bytes()
    )
    assert main(again) == 2 and "progress.jsonl, line 1" in capsys.readouterr().err
    (out / "progress.jsonl").unlink()
    assert main(again) == 0  # the way out that it names


@pytest.mark.slow
def test_a_policy_without_touch_is_post_trained_and_resumed(real, tmp_path):
    """One iteration, then a second after a resume, with an anchor whose rows have touch and with randomised pictures; Weights &
    Biases gets the rows of both, of one run."""
    blind = with_gain(write_checkpoint(tmp_path / "blind", tactile=False))
    out = tmp_path / "out"
    asked = {
        "env.pictures": "randomised",
        "wandb.enable": True,
        "wandb.mode": "offline",
    }
    assert main(options(blind, real, out, **asked)) == 0
    wandb.finish()
    assert main(["post-train", f"--out={out}", "--resume=true", "--iterations=2"]) == 0
    assert (
        json.loads((out / "settings.json").read_text())["env.pictures"] == "randomised"
    )
    rows = progress(out)
    assert [row["iteration"] for row in rows] == [1, 2]
    assert all(
        row["first_ratio_error"] < 1e-5 and row["anchor_loss"] > 0 for row in rows
    )
    wandb.finish()
    files = sorted((out / "wandb").glob("offline-run-*/run-*.wandb"))
    assert len({file.name for file in files}) == 1 < len(files)
    assert [logged(file)[0]["anchor_loss"] for file in files] == [
        row["anchor_loss"] for row in rows
    ]
    made: Any = open_checkpoint(
        out / "checkpoints" / "last" / "pretrained_model", "cpu"
    )
    assert (
        made.config.tactile is False
        and "observation.tactile" not in made.facts().inputs
    )
    before, after = (
        open_checkpoint(blind, "cpu").load(0).policy.state_dict(),
        weights(out),
    )
    assert before.keys() == after.keys() and any(
        not torch.equal(value, after[name]) for name, value in before.items()
    )


def test_input_that_does_not_fit_is_refused_before_anything_is_written(
    start, real, tmp_path, capsys
):
    out = tmp_path / "out"
    cases = [
        ({"env.task": "asembly_2"}, "assembly_2"),
        ({"env.pictures": "blurred"}, "clear, randomised"),
        ({"anchor.dataset": tmp_path}, "--anchor.dataset"),
        ({"policy.path": tmp_path}, "--policy.path"),
        ({"resume": True}, "--resume=true"),
        ({"noise.level": -1}, "--noise.level=-1"),
    ]
    for changes, word in cases:
        assert main(options(start, real, out, **changes)) == 2
        assert word in capsys.readouterr().err and not out.exists()
    touch = [*options(start, real, out), "--policy.tactile=true"]
    assert main(touch) == 2 and not out.exists()
    error = capsys.readouterr().err
    assert all(
        word in error for word in ("--policy.tactile=true", str(start), "lerobot-train")
    )
    without = [o for o in options(start, real, out) if "anchor.dataset" not in o]
    assert main(without) == 2 and "--anchor.weight=0" in capsys.readouterr().err


@pytest.mark.slow
def test_killed_and_resumed_is_the_same_bit_for_bit(start, real, tmp_path, capsys):
    """Two iterations at once, and one, kill -9, a line that was written without its checkpoint, and one more."""
    more = {
        "ppo.privileged_critic": True,
        "ppo.adapt_lr": True,
        "noise.level": 0.4,
        "noise.half_life": 1,
    }
    assert main(options(start, real, tmp_path / "once", iterations=2, **more)) == 0
    out = tmp_path / "twice"
    command = [
        sys.executable,
        "-m",
        "taccorl.cli.main",
        *options(start, real, out, iterations=2, **more),
    ]
    running = subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    while not (out / "checkpoints" / "last").exists() and running.poll() is None:
        time.sleep(0.01)
    running.kill()
    running.wait()
    assert [row["iteration"] for row in progress(out)][:1] == [1]
    with (out / "progress.jsonl").open("a") as file:
        file.write('{"iteration": 2}\n')
    assert (
        main(
            options(
                start, real, out, iterations=2, resume=True, **{**more, "ppo.clip": 0.3}
            )
        )
        == 2
    )
    assert "ppo.clip" in capsys.readouterr().err
    assert (
        main(["post-train", f"--out={out}", "--resume=true"]) == 0
    )  # the rest is in settings.json
    once, twice = weights(tmp_path / "once"), weights(out)
    assert all(torch.equal(value, twice[name]) for name, value in once.items())
    rows = [
        [{k: v for k, v in row.items() if k != "seconds"} for row in progress(p)]
        for p in (tmp_path / "once", out)
    ]
    assert rows[0] == rows[1] and len(rows[0]) == 2
    assert [row["noise_level"] for row in rows[0]] == [0.4, 0.2]
    assert (
        rows[0][0]["actor_lr"] != rows[0][1]["actor_lr"]
    )  # adapted, and resumed with it


@pytest.mark.slow
def test_rerun_files_of_rollouts_change_nothing(start, tmp_path):
    """Two iterations of two decisions of 5 steps, episodes of 12 steps: the first ends in the second iteration."""
    from taccorl.views.episode import save_episode

    shown: list[Any] = []

    def save(episode: Any, rrd: Path) -> None:
        shown.append(episode)
        save_episode(episode, rrd)

    found = []
    for name, saver in (("with", save), ("without", None)):
        made = run(start, tmp_path / name, [], saver, noise_check=False, iterations=2)
        made.run()
        rows = [
            {k: v for k, v in row.items() if k != "seconds"}
            for row in progress(tmp_path / name)
        ]
        found.append(
            (rows, made._actor.policy.state_dict(), made._generator.get_state())
        )
        made.world.close()
    (rows, policy, state), (other_rows, other_policy, other_state) = found
    assert rows == other_rows and torch.equal(state, other_state)
    assert all(torch.equal(value, other_policy[name]) for name, value in policy.items())
    assert [p.name for p in (tmp_path / "with" / "rollouts").iterdir()] == [
        "iteration_0002.rrd"
    ]
    (episode,) = shown
    assert episode.num_rows == 12 and len(episode.picture_keys) == 3
    values = episode.arrays["rl.value"][:, 0]
    assert (
        np.isfinite(values).all() and len(np.unique(values)) == 3
    )  # of three decisions
    assert len(np.unique(values[:5])) == len(np.unique(values[5:10])) == 1
    assert not (tmp_path / "without" / "rollouts").exists()


def test_the_watched_episode_is_the_one_that_ended_and_no_later_state_of_another():
    """Three episodes of environment 0: of 2 + 1 steps, then one that began in a stored state, then one of 2 steps."""
    from taccorl.rl.twin_shard import Acted
    from taccorl.rl.watched_episode import EpisodeWatch

    watch, actions, n = (
        EpisodeWatch(),
        np.arange(4 * 2 * 14, dtype=np.float32).reshape(4, 1, 2, 14),
        np.array,
    )
    decisions = (
        (2, None, False),
        (1, "timeout", False),
        (2, "success", True),
        (2, "success", False),
    )
    for k, (steps, outcome, later) in enumerate(decisions):
        fields = (
            n([0.0]),
            n([False]),
            n([False]),
            None,
            n([outcome], object),
            n([later]),
            n([steps]),
            n([k]),
            n([k]),
        )
        watch.see(Acted(*fields, actions[k]), torch.tensor([float(k)]))
        if k == 1:
            first, watch.ended = watch.ended, None
    assert first is not None and (first.seed, first.outcome, first.partial) == (
        1,
        "timeout",
        1,
    )
    np.testing.assert_array_equal(first.actions_TA, [*actions[0, 0], actions[1, 0, 0]])
    assert (
        first.values_T.tolist() == [0, 0, 1]
        and watch.ended is not None
        and watch.ended.seed == 3
    )
    np.testing.assert_array_equal(watch.ended.actions_TA, actions[3, 0])


def run(
    start: Path, out: Path, lines: list[str], save: Any = None, **changes: Any
) -> Any:
    from taccorl.rl.post_train import PostTraining
    from taccorl.rl.settings import EnvSettings, PolicySettings, PostTrainSettings

    settings = PostTrainSettings(
        policy=PolicySettings(path=start),
        env=EnvSettings(task="assembly_2", num_envs=2, decisions=2, episode_length=15),
        out=out,
        **{"anchor": AnchorSettings(weight=0), **changes},
    )
    return PostTraining(settings, lines.append, save)


def test_a_collapse_goes_back_to_the_best_checkpoint(start, tmp_path):
    lines: list[str] = []
    made = run(start, tmp_path / "out", lines, noise_check=False, keep_checkpoints=1)
    # 2 decisions of 5 of 15 steps: only short episodes have ended
    for iteration, counted in ((1, []), (2, [(1.0, 4)])):
        made._iteration = iteration
        made._remember({"episodes": 4, "success": 1.0})
        assert made._recent == counted
    bias = made._actor.model.action_out_proj.bias
    for iteration, success in ((10, 0.6), (20, 0.8), (30, 0.5)):
        with torch.no_grad():
            bias.fill_(iteration)
        made._iteration, made._recent = iteration, [(success, 8)] * 5
        made._guard_collapse()
        made._save()
    assert sorted(p.name for p in (tmp_path / "out" / "checkpoints").iterdir()) == [
        "000020",
        "000030",
        "best",
        "last",
    ]
    assert bias.unique().tolist() == [30]  # 0.5 is no collapse
    made._recent = [(x, 8) for x in (0.39, 0.0, 0.1, 0.2, 0.41)]
    made._guard_collapse()
    assert bias.unique().tolist() == [30] and not any(
        "warning" in line for line in lines
    )
    made._recent = [(x, 8) for x in (0.39, 0.0, 0.1, 0.2, 0.3)]
    made._guard_collapse()
    assert bias.unique().tolist() == [20] and "000020" in lines[-1]
    assert made._ppo.actor_optimizer.param_groups[0]["lr"] == pytest.approx(2.5e-6)
    made.world.close()


def test_a_learning_rate_that_is_much_too_large_leaves_the_policy_as_it_was(
    start, real, tmp_path
):
    """With β = 0 the loss on the dataset is logged all the same, and is that of before, too."""
    from taccorl.rl.settings import PPOSettings

    anchor = AnchorSettings(dataset=real, weight=0, batch_size=2)

    lines: list[str] = []
    for adapt_lr in (True, False):
        out = tmp_path / str(adapt_lr)
        ppo = PPOSettings(actor_lr=1e-2, adapt_lr=adapt_lr)
        made = run(
            start, out, lines, noise_check=False, iterations=1, ppo=ppo, anchor=anchor
        )
        drift = made._anchor.drift()
        before = {
            name: value.clone()
            for name, value in made._actor.policy.state_dict().items()
        }
        made.run()
        assert all(
            torch.equal(value, before[name])
            for name, value in made._actor.policy.state_dict().items()
        )
        (row,) = progress(out)
        assert row["drift"] == drift > 0 and "anchor_loss" not in row
        assert (
            row["undone_steps"] == 1
            and row["actor_lr"] == 1e-2
            and row["last_kl"] < 1e-6
        )
        assert made._ppo.actor_lr == (5e-3 if adapt_lr else 1e-2)
        assert (
            "--ppo.adapt_lr=true" in lines[-1]
        ) is not adapt_lr and "1 step undone" in "".join(lines)
        made.world.close()


def test_noise_that_ruins_the_policy_is_reported(start, tmp_path, monkeypatch):
    from taccorl.rl import post_train

    lines: list[str] = []
    made = run(start, tmp_path / "out", lines, noise_check=False)
    for with_noise, warned in (("timeout", True), ("success", False)):
        found = iter([["success", "success"], ["timeout", with_noise]])
        monkeypatch.setattr(
            post_train, "first_episodes", lambda *_, found=found: next(found)
        )
        lines.clear()
        made._check_noise()
        assert any("--noise.level" in line for line in lines) is warned
        assert "100.0% without" in "".join(lines)
    made.world.close()


def test_noise_at_the_hand_is_that_of_the_kinematics():
    """2e-2 rad at one joint of the left arm and 3 mm at its gripper, in a chunk of two steps: root mean squares over twelve
    joints, two hands, two grippers, of which one moves. With opposite noise in the steps the mean displacement is nearly 0."""
    from taccorl.rl.exploration import noise_of_targets
    from taccorl.robots import ROBOT
    from taccorl.sim.robot import RobotConfig
    from taccorl.tasks.experts.kinematics import ArmKinematics

    robot, plain = RobotConfig(), torch.zeros(1, 2, 14, dtype=torch.float64)
    plain[:, :, :6] = torch.tensor([0.3, 1.2, -1.0, 0.1, 0.4, 0.2])
    same = plain.clone()
    same[:, :, 1] += 2e-2
    same[:, :, ROBOT.gripper_index("left")] += 3e-3
    arm = ArmKinematics("left", robot)
    moved_mm = 1e3 * np.linalg.norm(
        arm.pose(same[0, 0, :6].numpy())[:3, 3]
        - arm.pose(plain[0, 0, :6].numpy())[:3, 3]
    )
    assert moved_mm > 5
    found = noise_of_targets(3, robot, plain, same)
    assert found == (
        3,
        *(
            pytest.approx(x)
            for x in (2e-2 / 12**0.5, *2 * [moved_mm / 2**0.5], 3 / 2**0.5)
        ),
    )
    opposite = plain.clone()
    opposite[:, :, 1] += torch.tensor([2e-2, -2e-2])
    found = noise_of_targets(3, robot, plain, opposite)
    assert (
        found.hand_mm == pytest.approx(moved_mm / 2**0.5, rel=0.02)
        and found.offset_mm < 0.02 * found.hand_mm
    )


def test_every_configuration_of_post_training_is_read():
    from taccorl.cli.parse import parse
    from taccorl.cli.post_train import PostTrainConfig

    files = sorted(
        (Path(__file__).parents[2] / "configs" / "post_train").glob("*.yaml")
    )
    assert {f.stem for f in files} >= {"paper", "small", "tiny"}
    found = {f.stem: parse(PostTrainConfig, [f"--config_path={f}"]) for f in files}
    assert found["paper"] == PostTrainConfig()

"""LeRobot's own record and rollout with a robot in simulated time: datasets, recordings and policies with touch."""

import functools
import itertools
import json
import shutil
import threading
import time
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from simulated_robot import SimulatedRobot
from tiny_checkpoint import write_checkpoint

from taccorl.alignment.measurements.recorded import read_recording
from taccorl.cli.main import main as taccorl
from taccorl.data.dataset import Dataset
from taccorl.data.recording import find_sources
from taccorl.data.spec import load_recording_spec
from taccorl.errors import TaccorlError
from taccorl.robot_plugin import lerobot_hooks
from taccorl.robot_plugin.bodies import ARM_NAMES
from taccorl.robot_plugin.config_robots import SurrogateLeaderConfig
from taccorl.robot_plugin.robots import SurrogateLeader

ROWS, SPEC = 50, "piper_flexitac_mcap"


class Leader(SurrogateLeader):
    """Leader arms that move two joints slowly."""

    is_connected = True

    def __init__(self, robot: SimulatedRobot) -> None:
        super().__init__(SurrogateLeaderConfig())
        self.robot = robot
        self.begin = robot.simulated._target.copy()

    def get_action(self) -> dict[str, float]:
        now = self.begin.copy()
        now[[0, 8]] += 0.2 * np.sin(2 * np.pi * 0.5 * self.robot.now_s)
        return dict(zip(ARM_NAMES, now.tolist(), strict=True))

    def connect(self, calibrate: bool = True) -> None: ...


def record(
    robot: SimulatedRobot, root: Path, patch: pytest.MonkeyPatch, episodes: int = 1
) -> None:
    """``lerobot-record``'s own function, whose clock is the robot's."""
    from lerobot.configs.dataset import DatasetRecordConfig
    from lerobot.scripts import lerobot_record

    lerobot_hooks.install()  # the robot was made before the scripts were loaded
    clock: Any = type("Clock", (), {"perf_counter": staticmethod(lambda: robot.now_s)})
    patch.setattr(lerobot_record, "make_robot_from_config", lambda _: robot)
    patch.setattr(
        lerobot_record, "make_teleoperator_from_config", lambda _: Leader(robot)
    )
    patch.setattr(lerobot_record, "time", clock)
    patch.setattr(lerobot_record, "precise_sleep", lambda _: None)
    keys = dict.fromkeys(("exit_early", "rerecord_episode", "stop_recording"), False)
    patch.setattr(lerobot_record, "init_keyboard_listener", lambda: (None, keys))
    what = {
        "repo_id": "local/recorded",
        "root": root,
        "single_task": "move",
        "num_episodes": episodes,
    }
    times = {"episode_time_s": ROWS / 30, "reset_time_s": 0}
    dataset: Any = DatasetRecordConfig(
        **what, **times, push_to_hub=False, no_stamp=True
    )
    leader = SurrogateLeaderConfig()
    config = lerobot_record.RecordConfig(
        robot=robot.config, teleop=leader, dataset=dataset, play_sounds=False
    )
    lerobot_record.record(config)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Dataset and MCAP file of two episodes."""
    folder = tmp_path_factory.mktemp("recorded")
    robot = SimulatedRobot(
        folder / "calibration", camera_px=64, paced=True, record=folder / "run.mcap"
    )
    with pytest.MonkeyPatch.context() as patch:
        record(robot, folder / "dataset", patch, episodes=2)
    assert robot.simulated.scene_seed == 2, (
        "0 was connected to, and each episode has one of its own"
    )
    assert (folder / "calibration" / "taccorl_surrogate_pads.json").is_file(), (
        "without an id"
    )
    return folder / "dataset", folder / "run.mcap"


def test_check_calls_a_recorded_dataset_ok(recorded, capsys):
    assert taccorl(["check", str(recorded[0])]) == 0, capsys.readouterr().out
    episode = Dataset(recorded[0]).episode(0)
    assert (
        ROWS <= episode.num_rows <= 1.15 * ROWS and episode.origin.domain == "surrogate"
    )
    info = json.loads((recorded[0] / "meta/info.json").read_text())
    assert info["robot_type"] == "bi_piper_flexitac"
    assert info["features"]["observation.tactile"]["domains"] == ["surrogate"]
    states = [
        Dataset(recorded[0]).values(k, ["observation.state"])["observation.state"]
        for k in (0, 1)
    ]
    assert (
        np.ptp(states[0][:, 0]) > 0.2 and abs(states[0][-1, 0] - states[0][0, 0]) > 0.05
    )
    np.testing.assert_allclose(
        states[1][0],
        states[0][0],
        atol=2e-3,
        err_msg="the scene is reset before each episode",
    )


def test_it_merges_with_an_ingested_dataset(recorded, dataset, tmp_path):
    words = [
        "merge",
        f"--real={recorded[0]}",
        f"--real={dataset}",
        f"--out={tmp_path / 'both'}",
    ]
    assert taccorl([*words, f"--store={tmp_path / 'store'}"]) == 0
    assert Dataset(tmp_path / "both").num_episodes == 2 + Dataset(dataset).num_episodes


def test_what_ran_is_ingested_as_any_recording(recorded, tmp_path, capsys):
    out = tmp_path / "ingested"
    taccorl(
        [
            "ingest",
            str(recorded[1]),
            f"--spec={SPEC}",
            f"--out={out}",
            f"--store={tmp_path / 'store'}",
        ]
    )
    assert (
        "1 written, 0 split" in (shown := capsys.readouterr().out)
        and "lost" not in shown
    ), shown
    assert "low_rate" not in shown and "old_samples" not in shown, (
        "commands come with the loop, at 30 Hz"
    )
    episodes = [Dataset(out).episode(k) for k in range(Dataset(out).num_episodes)]
    assert len(episodes) == 2 and episodes[0].origin.domain == "surrogate"
    assert Dataset(out).tasks(0)[0][1] == "move", (
        "as the user of lerobot-record has it, not the surrogate"
    )
    assert all(0.9 * ROWS <= episode.num_rows <= 1.15 * ROWS for episode in episodes)
    ours, theirs = (
        np.ptp(Dataset(d).values(0, ["action"])["action"][:, 0])
        for d in (out, recorded[0])
    )
    assert abs(ours - theirs) < 0.01
    measured = read_recording(
        find_sources(recorded[1], skipped=[])[0][1], load_recording_spec(SPEC)
    )
    assert [t.nominal_hz for t in measured.timing] == [200, 200, 30, 30]
    assert (
        np.isfinite(measured.effort[:ROWS]).all() and np.isnan(measured.velocity).all()
    ), "unmeasured, not zero"


def test_a_full_disk_is_named_and_the_episodes_before_it_are_whole(
    tmp_path, monkeypatch, capsys
):
    robot = SimulatedRobot(tmp_path / "calibration", camera_px=64, paced=True)
    theirs = robot.get_observation
    monkeypatch.setattr(
        lerobot_hooks, "_FULL_BYTES", 1 << 60
    )  # no disk of today has more
    monkeypatch.setattr(
        robot,
        "get_observation",
        lambda: theirs() if robot.now_s < 3.7 else robot.no_picture,
    )
    with pytest.raises(AttributeError, match="no_picture"):  # within the second episode
        record(robot, tmp_path / "dataset", monkeypatch, episodes=2)
    assert "its disk is full, an episode is lost" in "".join(capsys.readouterr())
    lerobot_hooks.remove_empty(
        made := tmp_path / "dataset", made.stat().st_ino
    )  # an episode is there: it stays
    assert taccorl(["check", str(made)]) == 0, capsys.readouterr().out


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_checkpoint(
        tmp_path_factory.mktemp("checkpoint"), tactile_history=4, tactile_stride=2
    )


def roll(
    robot: SimulatedRobot,
    checkpoint: Path,
    periods: int,
    patch: pytest.MonkeyPatch,
    inference: Any = None,
) -> None:
    """``lerobot-rollout``'s own functions, without its signal handler."""
    from lerobot.configs import PreTrainedConfig
    from lerobot.rollout import (
        RolloutConfig,
        build_rollout_context,
        context,
        create_strategy,
    )

    import taccorl.lerobot_plugin  # noqa: F401

    policy = PreTrainedConfig.from_pretrained(checkpoint)
    policy.pretrained_path = checkpoint
    patch.setattr(lerobot_hooks, "_policy", None)  # forgotten after the test
    patch.setattr(
        RolloutConfig, "__post_init__", lambda self: None
    )  # it reads the command line
    patch.setattr(context, "make_robot_from_config", lambda _: robot)
    more = {} if inference is None else {"inference": inference}
    config = RolloutConfig(
        robot=robot.config, policy=policy, device="cpu", task="move", **more
    )
    config.return_to_initial_position = False
    lerobot_hooks.install()
    ended, theirs, calls = threading.Event(), robot.get_observation, itertools.count(1)

    def counted() -> dict[str, Any]:
        if next(calls) > periods:
            ended.set()
        return theirs()

    patch.setattr(robot, "get_observation", counted)
    made = build_rollout_context(config, ended)
    strategy = create_strategy(config.strategy)
    strategy.setup(made)
    try:
        strategy.run(made)
    finally:
        strategy.teardown(made)


def test_rollout_runs_our_policy_with_its_window_of_touch(
    checkpoint, tmp_path, monkeypatch
):
    from taccorl.policies.tactile_pi05.modeling_tactile_pi05 import TactilePI05Policy

    felt: list[tuple[int, ...]] = []
    theirs = TactilePI05Policy._readings

    def seen(self: Any, batch: dict) -> Any:
        felt.append(tuple(batch["observation.tactile"].shape))
        return theirs(self, batch)

    monkeypatch.setattr(TactilePI05Policy, "_readings", seen)
    robot = SimulatedRobot(tmp_path, camera_px=224, paced=True)
    roll(robot, checkpoint, 10, monkeypatch)
    assert robot.commands >= 8 and not robot.guard.stopped
    assert set(felt) == {(1, 4, 1536)}
    assert any("period" in line for line in robot.summary())


def test_real_time_chunking_runs_it_too(checkpoint, tmp_path, monkeypatch):
    """A thread of LeRobot's predicts chunks, whose window of touch is in the observation; the loop only takes actions."""
    from lerobot.rollout.inference import RTCInferenceConfig

    robot = SimulatedRobot(tmp_path, camera_px=224, paced=True)
    roll(robot, checkpoint, 45, monkeypatch, RTCInferenceConfig())
    assert robot.commands > 5 and not robot.guard.stopped


def test_real_time_chunking_executes_each_action_at_its_time():
    """The state is the number of the period, and chunks go on counting. LeRobot 0.6.1 is 1 to 2 actions ahead after each chunk,
    and guides a chunk towards 0 beyond what is left of the last."""
    from lerobot.rollout import context
    from lerobot.rollout.inference import RTCInferenceConfig

    lerobot_hooks.install()
    left: list[np.ndarray] = []

    def predict(
        batch: dict, inference_delay: int, prev_chunk_left_over: Any
    ) -> torch.Tensor:
        now = batch["observation.state"]
        if prev_chunk_left_over is not None:
            left.append((prev_chunk_left_over - now)[:, 0].numpy())
        time.sleep(0.03 * (1 + len(left) % 3) if len(left) < 8 else 0.05)
        return torch.stack([now + torch.arange(16.0), now.expand(1, 16)], dim=-1)

    same: Any = type(
        "Same",
        (),
        {
            "steps": [],
            "__call__": lambda _, x: x,
            "reset": lambda _: None,
            "robot_type": "",
        },
    )()
    same.config, same.predict_action_chunk = (
        types.SimpleNamespace(chunk_size=16, n_action_steps=8),
        predict,
    )
    parts: Any = dict.fromkeys(
        ("policy", "preprocessor", "postprocessor", "robot_wrapper"), same
    )
    names = {"observation.state": {"dtype": "float32", "shape": (1,), "names": ["x"]}}
    parts |= dict.fromkeys(("hw_features", "dataset_features"), names)
    parts |= {"ordered_action_keys": ["x"], "task": "", "device": "cpu"}
    engine = context.create_inference_engine(RTCInferenceConfig(), **parts, fps=50.0)
    engine.start()
    engine.resume()
    late, begun_at = np.full(100, np.nan), np.full(100, np.nan)
    for period in range(100):
        engine.notify_observation({"x": float(period)})
        if (action := engine.get_action(None)) is not None:
            late[period], begun_at[period] = period - action[0], action[1]
        time.sleep(0.02)
    engine.stop()
    begun = np.flatnonzero(np.isfinite(late))[0]
    assert (late[begun : begun + 8] == begun).all(), (
        "nothing is cut from the first chunk, while nothing moves"
    )
    assert (late[begun + 16 :] == 0).all(), (
        "also where a chunk begins at once, between two actions"
    )
    index = np.arange(100)[60:] - begun_at[60:]
    assert index.min() >= 2 and np.quantile(index, 0.9) <= 8, (
        "the first 8 of a chunk, not those behind"
    )
    for one in left[1:]:
        np.testing.assert_array_equal(
            one, np.arange(len(one)), "as long as what is left, from now on"
        )


@pytest.mark.parametrize(
    ("camera_px", "change", "said"),
    [
        (
            64,
            {},
            r"camera front: the policy takes \(3, 224, 224\), the robot gives \(64, 64, 3\)",
        ),
        (0, {}, "trained with the camera front, the robot has none"),
        (224, {"fps": 15}, "trained at 15 Hz"),
        (224, {"action_feature_names": list(ARM_NAMES[::-1])}, "another order"),
        (
            224,
            {"action_feature_names": [*ARM_NAMES[:-1], "right_hand.pos"]},
            "right_hand.pos",
        ),
        (
            224,
            {},
            "range of action: .* in the checkpoint, -2.97 … 3.14 rad",
        ),  # its data are in degrees
    ],
)
def test_a_policy_of_another_robot_is_refused(
    camera_px, change, said, checkpoint, tmp_path, monkeypatch
):
    from lerobot.configs import PreTrainedConfig
    from safetensors.numpy import load_file, save_file

    import taccorl.lerobot_plugin  # noqa: F401

    policy: Any = PreTrainedConfig.from_pretrained(checkpoint)
    policy.pretrained_path = shutil.copytree(checkpoint, tmp_path / "degrees")
    (policy.pretrained_path / "manifest.json").unlink()
    for path in policy.pretrained_path.glob("*normalizer_processor.safetensors"):
        save_file({key: 57.3 * value for key, value in load_file(path).items()}, path)
    for name, value in change.items():
        setattr(policy, name, value)
    robot = SimulatedRobot(tmp_path, camera_px=camera_px, picture_px=0)
    monkeypatch.setattr(lerobot_hooks, "_policy", policy)
    with pytest.raises(TaccorlError, match=said):
        robot.connect()


def test_an_episodic_rollout_begins_each_episode_in_a_new_scene_with_new_inference():
    from lerobot.rollout.strategies.episodic import EpisodicStrategy

    lerobot_hooks.install()
    done: list[str] = []
    steps = {
        name: functools.partial(done.append, name)
        for name in ("stop", "reset", "start", "resume", "begin_episode")
    }
    what = types.SimpleNamespace(**steps, instruct=done.append)
    loop = lerobot_hooks._in_order(lambda *_, **__: done.append("loop"))
    loop(
        types.SimpleNamespace(_engine=what),
        robot=types.SimpleNamespace(inner=what),
        dataset=what,
        single_task="t",
    )
    loop(robot=what, dataset=None)  # the time between episodes
    assert done == [
        "t",
        "stop",
        "begin_episode",
        "reset",
        "start",
        "resume",
        "loop",
        "loop",
    ]
    assert hasattr(EpisodicStrategy._policy_loop, "theirs")


def test_no_action_is_consumed_while_the_arms_hold_an_old_observation():
    """Actions count. Without this, the first action after a hold of 5 periods is the 9th, not the 4th."""
    actions, guard = (
        iter(torch.arange(16.0)),
        types.SimpleNamespace(holding="", is_late=False),
    )
    engine = types.SimpleNamespace(get_action=lambda _: next(actions))
    take = lerobot_hooks._none_past_a_hold(engine, lambda: guard)
    assert [take(None).item() for _ in range(4)] == [0, 1, 2, 3]
    guard.holding = guard.is_late = True
    assert [take(None).item() for _ in range(5)] == [3] * 5
    guard.is_late = False  # it is still held, until an action comes
    assert take(None).item() == 4
    guard.holding = (
        "no action for 0.2 s"  # of a policy that is late, not of an observation
    )
    assert take(None).item() == 5


def test_a_sleep_that_is_too_long_is_regained_by_the_next(monkeypatch):
    now, begun = [0.0], list[float]()
    monkeypatch.setattr(
        lerobot_hooks, "time", types.SimpleNamespace(perf_counter=lambda: now[0])
    )

    too_long_s = iter([0.002] * 4 + [10.0, 0.0])
    sleep = lerobot_hooks._regained(
        lambda seconds: now.__setitem__(0, now[0] + seconds + next(too_long_s))
    )
    for work_s in (0.01, 0.01, 0.02, 0.01):
        begun.append(now[0])
        now[0] += work_s
        sleep(0.1 - work_s)
    assert [*begun, now[0]] == pytest.approx(
        [0, 0.102, 0.202, 0.302, 0.402]
    )  # without it: 0.408
    sleep(0.1)
    sleep(0.1)
    assert now[0] == pytest.approx(10.5 + 0.08), (
        "of the 10 s of a suspended computer 20 ms are regained"
    )


def test_an_error_of_ours_is_one_sentence_in_lerobots_commands(capsys):
    theirs: list[Any] = []
    show = lerobot_hooks._in_a_sentence(lambda *error: theirs.append(error))
    show(TaccorlError, TaccorlError("no surrogate answers"), None)
    show(ValueError, other := ValueError("x"), None)
    assert capsys.readouterr().err.endswith(": no surrogate answers\n") and theirs == [
        (ValueError, other, None)
    ]
    with pytest.raises(TaccorlError, match="no surrogate answers on port 99999"):
        SurrogateLeader(SurrogateLeaderConfig(port=99999)).connect()

"""Teleoperation without a window: leader arms → actions; action files that survive and give the same bits."""

import dataclasses
import json
import math
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from taccorl.episodes.attempt import Actions, outcome_of
from taccorl.episodes.recorder import EpisodeRecorder, row_spec
from taccorl.episodes.sources import teleop
from taccorl.episodes.sources.collect import CollectPlan, attempt
from taccorl.episodes.sources.expert import ExpertSource
from taccorl.episodes.sources.teleop import Command, LeaderHands, LeaderSource
from taccorl.episodes.sources.teleop_actions import (
    ActionFile,
    find_finished,
    scene_of,
    write_actions,
)
from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.simulation import Simulation
from taccorl.sim.task import tasks
from taccorl.tasks.experts.hands import EXACT
from tests.fresh_python import fresh_python

ENTER, F9 = [Command.GO], [Command.DISCARD]


@pytest.fixture(scope="module")
def bench() -> Simulation:
    return Simulation(tasks.get("bench")())


@pytest.fixture
def sim(bench: Simulation) -> Simulation:
    bench.reset([5])
    return bench


def test_none_of_our_keys_means_something_to_mujocos_viewer():
    toggles = [*mujoco.mjVISSTRING, *mujoco.mjRNDSTRING]  # name, default, key
    theirs = {ord(key) for _, _, key in toggles if key}
    theirs |= set(range(ord("0"), ord("6")))  # groups of geoms, with shift of sites
    theirs |= {
        256,
        258,
        259,
        266,
        ord("["),
        ord("]"),
        *range(290, 297),
    }  # Esc Tab Backspace Page Up, cameras, F1–F7
    assert set(map(ord, "ABCDEFGHIJKLMNOPQRSTUVWXYZ")) <= theirs, (
        "no letter is free: the lists above are complete"
    )
    assert theirs.isdisjoint(command.code for command in Command)


# whole attempts, with a window and leader arms that follow a script -------------------------------------------------------


class ScriptedWindow:
    """Presses the keys of one list at each control step, and moves a joint of each arm; when the script is over, it is closed.
    Also stands in for the leader arms."""

    def __init__(self, script: Iterable[Sequence[Command]]) -> None:
        self.script, self.now, self.shown = iter(script), [], []
        self.target = np.array([0.0, 1.6, -1.0, 0.0, 0.9, 0.0, 0.035] * 2)

    def tick(self, sim: Simulation, lines: Sequence[str]) -> None:
        self.shown.append(" | ".join(lines))
        keys = next(self.script, None)
        if keys is None:
            raise TaccorlError("the window was closed")
        self.now = list(keys)

    def commands(self) -> list[Command]:
        taken, self.now = self.now, []
        return taken

    def read(self) -> np.ndarray:
        self.target = self.target + 0.001 * np.eye(14)[0] + 0.0005 * np.eye(14)[7]
        return self.target

    def close(self) -> None:
        self.script = iter(())


def with_script(
    monkeypatch: pytest.MonkeyPatch, script: Iterable[Sequence[Command]]
) -> ScriptedWindow:
    window = ScriptedWindow(script)
    monkeypatch.setattr(teleop, "ViewerWindow", lambda sim: window)
    teleop.use_leader_driver(lambda source: window)
    teleop._sessions.clear()
    return window


def run(plan: CollectPlan, sim: Simulation, k: int = 0) -> EpisodeRecorder:
    done = attempt(plan, sim, row_spec(sim, pictures=False), k)
    assert done.recorder is not None
    return done.recorder


def column(recorder: EpisodeRecorder, key: str) -> np.ndarray:
    return np.stack([row[key] for row in recorder.rows])


def test_attempt_is_the_re_execution_of_the_file_it_left(tmp_path, bench, monkeypatch):
    window = with_script(monkeypatch, [[], ENTER, *[[]] * 7, ENTER, *[[]] * 40])
    plan = CollectPlan(task="bench", source=LeaderSource(folder=str(tmp_path)), seed=3)
    recorder = run(plan, bench)
    (path,) = tmp_path.iterdir()
    file = ActionFile.read(path)
    assert path.name == f"bench_{plan.attempt_seed(0)}_000.jsonl"
    assert (file.end, file.outcome) == ("finished", "unfinished")
    assert file.header.items() >= scene_of(bench).items()
    assert len(recorder.rows) == len(file.actions) == 7 + 30, (
        "what was driven, and a second in which all holds still"
    )
    np.testing.assert_array_equal(column(recorder, "action"), file.actions)
    assert (file.actions[-30:] == file.actions[-31]).all()
    assert (np.diff(file.actions[:7, [0, 7]], axis=0) > 0).all(), "both arms follow"
    driven = teleop._sessions[bench].sim
    # live and re-executed: the same bits
    np.testing.assert_array_equal(
        driven.arrays["qpos"], bench.arrays["qpos"], strict=True
    )
    assert "begin" in window.shown[0]

    with_script(monkeypatch, [])  # a person who is not there
    again = run(plan, bench)
    for key in recorder.rows[0]:
        np.testing.assert_array_equal(column(again, key), column(recorder, key))
    with pytest.raises(TaccorlError, match="window was closed"):
        run(plan, bench, k=1)  # but another scene needs the person


def test_discarded_and_interrupted_attempts_leave_nothing_and_the_scene_begins_anew(
    tmp_path, bench, monkeypatch
):
    plan = CollectPlan(task="bench", source=LeaderSource(folder=str(tmp_path)), seed=3)
    with_script(monkeypatch, [ENTER, [], [], []])
    with pytest.raises(TaccorlError, match="window was closed"):
        run(plan, bench)
    assert list(tmp_path.iterdir()) == []
    with_script(monkeypatch, [ENTER, [], [], F9, ENTER, [], ENTER, *[[]] * 40])
    recorder = run(plan, bench)
    (path,) = tmp_path.iterdir()
    assert len(ActionFile.read(path).actions) == 1 + 30
    np.testing.assert_array_equal(
        column(recorder, "action"), ActionFile.read(path).actions
    )


def test_failure_waits_for_the_person_who_tries_again_or_keeps_it(
    tmp_path, monkeypatch
):
    script = [ENTER, *[[]] * 6, [], [], F9, ENTER, *[[]] * 6, [], ENTER]
    window = with_script(monkeypatch, script)
    sim = Simulation(tasks.get("bench")())
    recorder = run(
        CollectPlan(
            task="bench", source=LeaderSource(folder=str(tmp_path), time_limit_s=0.2)
        ),
        sim,
    )
    (file,) = map(ActionFile.read, tmp_path.iterdir())
    assert (file.end, file.outcome, len(file.actions)) == ("finished", "timeout", 6)
    assert len(recorder.rows) == 6
    assert outcome_of(sim) == "timeout"
    assert any("timeout! F9: again; Enter: keep" in shown for shown in window.shown)


def test_person_has_more_time_than_the_task_gives_an_expert_and_so_has_the_re_execution(
    tmp_path, monkeypatch
):
    hasty = type(
        "Hasty", (tasks.get("bench"),), {"time_limit_s": 0.2}
    )  # out of time after 6 control steps
    sim = Simulation(hasty())
    with_script(monkeypatch, [ENTER, *[[]] * 10, ENTER, *[[]] * 40])
    plan = CollectPlan(task="bench", source=LeaderSource(folder=str(tmp_path)))
    assert len(run(plan, sim).rows) == 10 + 30
    assert outcome_of(sim) == "unfinished"
    with_script(monkeypatch, [])
    assert len(run(plan, Simulation(hasty())).rows) == 40


# action files ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Overheard(ExpertSource):
    """The expert, whose every action is kept before it acts."""

    sent: list[np.ndarray]

    def actions(self, sim: Simulation, rng: np.random.Generator) -> Actions:
        for targets in super().actions(sim, rng):
            self.sent.append(targets.sent)
            yield targets


def test_experts_actions_re_executed_give_bit_identical_rows(tmp_path):
    plan = CollectPlan(task="assembly_1", randomization=0.5)
    sim = plan.make()
    expert = Overheard(
        sent=[], hands=dataclasses.replace(EXACT, speed=2.0)
    )  # hasty: a short episode does
    original = run(dataclasses.replace(plan, source=expert), sim)
    write_actions(tmp_path, sim, expert.sent)
    assert outcome_of(sim) == "success", (
        "choose another seed: this one is to show a success"
    )
    other = plan.make()
    again = run(
        dataclasses.replace(plan, source=LeaderSource(folder=str(tmp_path))), other
    )
    assert outcome_of(other) == "success" and len(again.rows) == len(original.rows)
    for key in original.rows[0]:
        np.testing.assert_array_equal(
            column(again, key), column(original, key), err_msg=key, strict=True
        )


def random_actions(num: int) -> np.ndarray:
    return (
        np.random.default_rng(0)
        .uniform(ROBOT.action_low, ROBOT.action_high, (num, 14))
        .astype(np.float32)
    )


def test_float32_actions_come_back_bit_for_bit(tmp_path, sim):
    actions = random_actions(40)
    actions[3, :3] = (
        np.float32(1) / 3,
        np.nextafter(np.float32(0.1), np.float32(1)),
        -0.0,
    )
    file = ActionFile.read(write_actions(tmp_path, sim, actions))
    assert file.actions.tobytes() == actions.tobytes()
    assert (file.end, file.outcome) == ("finished", "unfinished")


def test_damaged_and_foreign_files_are_refused_by_line(tmp_path, sim):
    path = write_actions(tmp_path, sim, random_actions(3))
    lines = path.read_text().splitlines()
    for number, line, says in (
        (3, "[1, 2", "damaged"),
        (3, "[1, 2]", "expected 14 numbers"),
        (1, "{}", "is not an action file"),
    ):
        path.write_text(
            "\n".join(line if k == number else text for k, text in enumerate(lines, 1))
            + "\n"
        )
        with pytest.raises(TaccorlError, match=says) as caught:
            ActionFile.read(path)
        assert number == 1 or f":{number}:" in str(caught.value)
    path.write_bytes(b"")
    with pytest.raises(TaccorlError, match="is not an action file"):
        ActionFile.read(path)


def test_only_a_finished_demonstration_of_the_very_scene_is_taken_for_one(
    tmp_path, sim
):
    scene = scene_of(sim)
    for cut in (
        "",
        '{"end": "discarded", "outcome": "timeout"}\n',
        "[0.1, 0.",
    ):  # as earlier versions left them
        path = write_actions(tmp_path, sim, random_actions(2))
        path.write_text(path.read_text()[: path.read_text().index('{"end"')] + cut)
    assert find_finished(tmp_path, scene) is None
    path = write_actions(tmp_path, sim, random_actions(2))
    found = find_finished(tmp_path, scene)
    assert (
        found is not None
        and found.path == path
        and path.name == f"bench_{scene['seed']}_003.jsonl"
    )
    for key, other in (
        ("difficulty", "hard"),
        ("twin", "effects: [x]"),
        ("randomization", 0.5),
    ):
        assert find_finished(tmp_path, {**scene, key: other}) is None, key
    path.write_text(
        path.read_text().replace(
            f'"mujoco": "{mujoco.__version__}"', '"mujoco": "3.9.0"'
        )
    )
    assert find_finished(tmp_path, scene) is None, (
        "another MuJoCo: not surely the same bits"
    )


def test_re_execution_that_does_not_end_as_recorded_is_an_error(tmp_path, sim):
    plan = CollectPlan(task="bench", source=LeaderSource(folder=str(tmp_path)))
    sim.reset([plan.attempt_seed(0)])
    path = write_actions(tmp_path, sim, random_actions(3) * 0)
    path.write_text(
        path.read_text().replace('"outcome": "unfinished"', '"outcome": "success"')
    )
    with pytest.raises(
        TaccorlError, match=r"recorded as success after 3 .* unfinished"
    ):
        run(plan, sim)


# display -----------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_without_a_display_the_command_says_so_and_the_way_out(tmp_path):
    command = [
        "-m",
        "taccorl.cli.main",
        "collect",
        "--task=bench",
        "--source.type=leader",
        "--images=false",
    ]
    done = fresh_python(
        *command,
        "--store=store",
        "--out=out",
        cwd=tmp_path,
        without=("DISPLAY", "WAYLAND_DISPLAY"),
    )
    assert (
        done.returncode == 2
        and "DISPLAY and WAYLAND_DISPLAY are not set" in done.stderr
    )
    assert "--source.type=expert" in done.stderr and "Traceback" not in done.stderr


@pytest.mark.skipif(sys.platform != "linux", reason="X11")
def test_display_that_does_not_answer_is_an_error_and_not_a_wait(monkeypatch):
    monkeypatch.setenv("DISPLAY", ":7777")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(TaccorlError, match=r"DISPLAY=:7777 does not respond \(.+\)"):
        teleop._check_display()


# leader arms -------------------------------------------------------------------------------------------------------------

ARM = ("joint_1", "joint_2", "joint_3", "joint_4", "joint_5", "joint_6", "gripper")
NAMES = [f"{side}_{joint}.pos" for side in ("left", "right") for joint in ARM]
HOME_DEG = [math.degrees(x) for x in (0.0, 1.6, -1.0, 0.0, 0.9, 0.0)]


@pytest.fixture(scope="module")
def leader_kind() -> Any:
    """The smallest LeRobot teleoperator that gives 14 values: degrees, and grippers in 0 … 100."""
    from lerobot.teleoperators import Teleoperator, TeleoperatorConfig

    @TeleoperatorConfig.register_subclass("test_pair_of_arms")
    @dataclass(kw_only=True)
    class PairOfArmsConfig(TeleoperatorConfig):
        port: str
        names: list[str]

    class PairOfArms(Teleoperator):
        config_class = PairOfArmsConfig
        name = "test_pair_of_arms"
        action_features = property(lambda self: dict.fromkeys(self.config.names, float))
        feedback_features = property(lambda self: {})
        is_connected = property(lambda self: self.connected)
        is_calibrated = property(lambda self: True)

        def __init__(self, config: Any) -> None:
            super().__init__(config)
            self.config, self.connected = config, False
            self.values = dict(zip(NAMES, [*HOME_DEG, 50.0] * 2, strict=True))

        def connect(self, calibrate: bool = True) -> None:
            if self.config.port == "nowhere":
                raise ConnectionError("no such port")
            self.connected = True

        def disconnect(self) -> None:
            self.connected = False

        def get_action(self) -> dict[str, float]:
            return {name: self.values.get(name, 0.0) for name in self.config.names}

        def calibrate(self) -> None: ...

        def configure(self) -> None: ...

        def send_feedback(self, feedback: dict[str, Any]) -> None: ...

    PairOfArms.__abstractmethods__ = frozenset()
    # LeRobot finds a device's class in its config's module, by the name without "Config"
    setattr(sys.modules[__name__], "PairOfArms", PairOfArms)  # noqa: B010
    return PairOfArms


def options(
    tmp_path: Path, names: Sequence[str] = NAMES, port: str = "/dev/null"
) -> Path:
    path = tmp_path / "leader.yaml"
    path.write_text(
        json.dumps(
            {
                "port": port,
                "names": list(names),
                "calibration_dir": str(tmp_path / "calibration"),
            }
        )
    )
    return path


def pair(
    tmp_path: Path,
    names: Sequence[str] = NAMES,
    port: str = "/dev/null",
    **settings: Any,
) -> LeaderSource:
    said = {"joint_unit": "deg", "gripper_unit": "range_0_100", **settings}
    path = str(options(tmp_path, names, port))
    return LeaderSource(
        teleop="test_pair_of_arms",
        options=path,
        folder=str(tmp_path / "teleop"),
        **said,
    )


def test_leader_in_degrees_and_percent_is_read_in_rad_and_m(tmp_path, leader_kind):
    from taccorl.lerobot_plugin.leader import open_leader

    leader = open_leader(pair(tmp_path, NAMES[::-1]))  # LeRobot promises no order
    np.testing.assert_allclose(
        leader.read(), [0, 1.6, -1, 0, 0.9, 0, 0.035] * 2, atol=1e-12
    )
    leader.close()


def test_normalised_range_spans_the_twins_own_joint_range():
    from taccorl.lerobot_plugin.leader import to_twin

    low, high = (
        to_twin(np.full(14, -100.0), "range_m100_100", "m"),
        to_twin(np.full(14, 100.0), "range_m100_100", "m"),
    )
    np.testing.assert_allclose(low[[0, 1, 2]], (-2.618, 0.0, -2.967), atol=1e-6)
    np.testing.assert_allclose(high[[0, 1, 2]], (2.618, 3.14, 0.0), atol=1e-6)
    np.testing.assert_array_equal(to_twin(np.arange(14.0), "rad", "m"), np.arange(14.0))


def test_values_missing_and_left_over_are_named_and_can_be_renamed(
    tmp_path, leader_kind
):
    from taccorl.lerobot_plugin.leader import match_names, open_leader

    given = [*NAMES[:5], "left_wrist_roll.pos", *NAMES[6:], "left_joint_7.pos"]
    with pytest.raises(TaccorlError) as caught:
        open_leader(pair(tmp_path, given))
    said = str(caught.value)
    assert "15 values" in said
    assert "Missing: left_joint_6.pos;" in said
    assert "left over: left_wrist_roll.pos, left_joint_7.pos." in said
    renamed = {"left_wrist_roll.pos": "left_joint_6.pos", "left_joint_7.pos": None}
    assert match_names(given, renamed, "x") == [
        *NAMES[:5],
        "left_wrist_roll.pos",
        *NAMES[6:],
    ]
    with pytest.raises(
        TaccorlError, match=r"15 values, but.*twin.*14. Left over: left_joint_7.pos"
    ):
        match_names([*NAMES, "left_joint_7.pos"], {}, "x")
    with pytest.raises(
        TaccorlError, match=r"for the same value: left_joint_1.pos, left_joint_2.pos"
    ):
        match_names(NAMES, {"left_joint_2.pos": "left_joint_1.pos"}, "x")
    with pytest.raises(
        TaccorlError, match=r"'left_jiont_2.pos'; did you mean 'left_joint_2.pos'"
    ):
        match_names(NAMES, {"left_jiont_2.pos": None}, "x")


def test_units_have_to_be_said_and_wrong_ones_are_refused_at_the_first_reading(
    tmp_path, leader_kind
):
    from taccorl.lerobot_plugin.leader import open_leader

    with pytest.raises(
        TaccorlError, match=r"joint_unit=rad\|deg\|range_m100_100: it has to be said"
    ):
        open_leader(pair(tmp_path, joint_unit=""))
    with pytest.raises(TaccorlError, match="'mm' is none of them"):
        open_leader(pair(tmp_path, gripper_unit="mm"))
    with pytest.raises(
        TaccorlError,
        match=r"left_joint_2.pos reads 91.6732 rad, far beyond .*another unit",
    ):
        open_leader(pair(tmp_path, joint_unit="rad")).read()
    with pytest.raises(
        TaccorlError, match=r"left_gripper.pos reads 50 m, far beyond 0 … 0.07 m"
    ):
        open_leader(pair(tmp_path, gripper_unit="m")).read()


def test_unknown_leader_wrong_options_and_dead_port_are_told(tmp_path, leader_kind):
    from taccorl.lerobot_plugin.leader import open_leader, teleoperator_config

    with pytest.raises(TaccorlError, match="did you mean 'bi_so_leader'"):
        teleoperator_config("bi_so_leder")
    with pytest.raises(TaccorlError, match="does not fit"):
        teleoperator_config("test_pair_of_arms")  # no port
    with pytest.raises(
        TaccorlError, match=r"cannot connect: ConnectionError: no such port"
    ):
        open_leader(pair(tmp_path, port="nowhere"))


def test_arms_catch_up_with_the_leader_slowly_and_then_follow_at_once(sim):
    class Still:
        target = np.array([*(0.0, 1.6, -1.0, 0.0, 0.9, 0.0, 0.035)] * 2)

        def read(self) -> np.ndarray:
            return self.target

        def close(self) -> None: ...

    leader = Still()
    hands = LeaderHands(sim, leader)
    start = sim.targets[0].copy()
    actions = [hands.read() for _ in range(90)]
    steps = np.abs(np.diff([start, *actions], axis=0))
    assert steps[:, [0, 1, 2, 3, 4, 5]].max() == pytest.approx(0.6 / 30, abs=1e-6)
    np.testing.assert_allclose(actions[-1], leader.target, atol=1e-6)
    leader.target = leader.target + np.eye(14)[0] * 0.3
    np.testing.assert_allclose(hands.read(), leader.target, atol=1e-6)
    leader.target = leader.target + np.eye(14)[1] * 2.0  # beyond the joint's limit
    assert hands.read()[1] == np.float32(ROBOT.action_high[1])
    assert "beyond the twin's range: left_joint2" in hands.lines[0]


def test_leader_drives_a_whole_attempt(tmp_path, bench, leader_kind, monkeypatch):
    from taccorl.lerobot_plugin.leader import open_leader

    with_script(monkeypatch, [ENTER, *[[]] * 70, ENTER, *[[]] * 40])
    teleop.use_leader_driver(open_leader)
    recorder = run(CollectPlan(task="bench", source=pair(tmp_path)), bench)
    assert len(recorder.rows) == 70 + 30
    np.testing.assert_allclose(
        column(recorder, "action")[-1], [0, 1.6, -1, 0, 0.9, 0, 0.035] * 2, atol=1e-6
    )

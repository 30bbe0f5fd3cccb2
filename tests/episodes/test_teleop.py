"""Teleoperation without a window: keys and leader arms → actions; action files that survive and give the same bits."""

import dataclasses
import json
import math
import os
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
from taccorl.episodes.sources.teleop import KeyboardSource, LeaderHands, LeaderSource
from taccorl.episodes.sources.teleop_actions import ActionFile, ActionLog, ActionsSource, find_finished, scene_of
from taccorl.episodes.sources.teleop_jog import AXES, COMMAND_KEYS, Command, Jogger, Keyboard
from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.simulation import Simulation
from taccorl.sim.task import tasks
from taccorl.tasks.experts.hands import EXACT
from taccorl.tasks.experts.se3 import rotvec
from tests.fresh_python import fresh_python

UP, DOWN, LEFT, RIGHT, HOME, END = 265, 264, 263, 262, 268, 269  # mjui.h, the same as GLFW's
INSERT, DELETE, PAGE_DOWN, ENTER, F9, SPACE = 260, 261, 267, 257, 298, 32
DT_S = 1 / 30


@pytest.fixture(scope="module")
def bench() -> Simulation:
    return Simulation(tasks.get("bench")())


@pytest.fixture
def sim(bench: Simulation) -> Simulation:
    bench.reset([5])
    return bench


@pytest.fixture
def jogger(sim: Simulation) -> Jogger:
    return Jogger(sim, no_keys)


def no_keys(taps: Sequence[int]) -> tuple[np.ndarray, list[Command]]:
    return np.zeros(7), []


def tap(jogger: Jogger, *codes: int) -> None:
    """Press keys, one after the other."""
    keyboard = Keyboard()
    for code in codes:
        jogger.jog(keyboard.requested_steps([code], ())[0])


def settle(sim: Simulation, jogger: Jogger, seconds: float = 1.5) -> None:
    for _ in range(round(seconds / DT_S)):
        sim.step(jogger.targets()[None])


# keys ------------------------------------------------------------------------------------------------------------------


def test_none_of_our_keys_means_something_to_mujocos_viewer():
    toggles = [*mujoco.mjVISSTRING, *mujoco.mjRNDSTRING]  # name, default, key
    theirs = {ord(key) for _, _, key in toggles if key}
    theirs |= set(range(ord("0"), ord("6")))  # groups of geoms, with shift of sites
    theirs |= {256, 258, 259, 266, ord("["), ord("]"), *range(290, 297)}  # Esc Tab Backspace Page Up, cameras, F1–F7
    assert set(map(ord, "ABCDEFGHIJKLMNOPQRSTUVWXYZ")) <= theirs, "no letter is free: the lists above are complete"
    ours = [code for axis in AXES for code in (*axis.more, *axis.less)] + list(COMMAND_KEYS)
    assert not theirs & set(ours)
    assert len(set(ours)) == len(ours) == 6 * 2 + 6 + 2 + 4  # moves twice (keypad), turns, gripper, commands


@pytest.mark.parametrize(
    ("code", "moved_mm"),
    [(UP, (5, 0, 0)), (DOWN, (-5, 0, 0)), (LEFT, (0, 5, 0)), (RIGHT, (0, -5, 0)), (HOME, (0, 0, 5)), (END, (0, 0, -5))],
)
def test_tap_moves_goal_by_a_step_along_the_bench(jogger, code, moved_mm):
    before, other = jogger.hands["left"].goal.copy(), jogger.hands["right"].goal.copy()
    tap(jogger, code)
    after = jogger.hands["left"].goal
    np.testing.assert_allclose((after - before)[:3, 3] * 1e3, moved_mm, atol=1e-9)
    np.testing.assert_array_equal(after[:3, :3], before[:3, :3])
    np.testing.assert_array_equal(jogger.hands["right"].goal, other)


@pytest.mark.parametrize(("codes", "axis"), [("67", 2), ("89", 1), ("-=", 0)])
def test_turn_is_about_the_hands_own_axis_and_leaves_the_tcp_where_it_is(jogger, codes, axis):
    before = jogger.hands["left"].goal.copy()
    tap(jogger, ord(codes[0]))
    after = jogger.hands["left"].goal.copy()
    expected = np.zeros(3)
    expected[axis] = 0.05
    np.testing.assert_allclose(rotvec(before, after), expected, atol=1e-9)
    np.testing.assert_array_equal(after[:3, 3], before[:3, 3])
    tap(jogger, ord(codes[1]))
    np.testing.assert_allclose(jogger.hands["left"].goal, before, atol=1e-12)


def test_space_switches_the_arm_and_page_down_the_step(jogger):
    keyboard = Keyboard()
    assert keyboard.requested_steps([SPACE, PAGE_DOWN], ())[1] == [Command.SWITCH_ARM, Command.STEP_SIZE]
    jogger.switch_arm()
    jogger.next_size()
    left, right = jogger.hands["left"].goal.copy(), jogger.hands["right"].goal.copy()
    tap(jogger, HOME)
    np.testing.assert_array_equal(jogger.hands["left"].goal, left)
    np.testing.assert_allclose((jogger.hands["right"].goal - right)[:3, 3], (0, 0, 0.02), atol=1e-12)
    jogger.switch_arm()
    jogger.next_size()
    assert (jogger.arm, jogger.size.move_m) == ("left", 0.001)


def test_held_key_goes_on_at_eight_steps_a_second_after_a_quarter():
    keyboard = Keyboard()
    total = keyboard.requested_steps([LEFT], {LEFT})[0]
    for _ in range(29):
        total = total + keyboard.requested_steps([], {LEFT})[0]
    assert total[1] == pytest.approx(1 + (30 - 8) * 8 / 30)
    assert not keyboard.requested_steps([], ())[0].any(), "let go: nothing moves on"
    assert not keyboard.requested_steps([], {LEFT})[0].any(), "down again: a new quarter of a second"


def test_gripper_stays_in_its_range_and_squeezes_with_no_more_than_30_n(sim, jogger):
    hand = jogger.hands["left"]
    tap(jogger, *[INSERT] * 3)
    assert hand.opening_m == ROBOT.opening_max_m
    tap(jogger, *[DELETE] * 14)
    # 30 N / 2000 N/m = 15 mm below what the gripper has reached, whatever is asked for
    assert hand.opening_m == pytest.approx(sim.proprioception()[0, 6] - 0.015)
    for _ in range(40):
        tap(jogger, DELETE)
        sim.step(jogger.targets()[None])
    assert hand.opening_m == 0.0
    assert sim.proprioception()[0, 6] == pytest.approx(0.0, abs=1e-3)
    assert sim.proprioception()[0, 13] == pytest.approx(ROBOT.opening_max_m, abs=1e-3), "the other one is still open"


def test_target_out_of_reach_is_refused_with_its_error_and_does_not_run_away(jogger):
    jogger.next_size()
    tap(jogger, *[UP] * 60)  # 1.2 m: the arm is 0.6 m long
    hand, kinematics = jogger.hands["left"], jogger.kinematics["left"]
    assert "out of reach by" in jogger.notice
    assert 0.02 < hand.goal[0, 3] < 0.8
    assert kinematics.solve(hand.goal, hand.joints_rad)[1] < 5e-4
    edge = hand.goal.copy()
    tap(jogger, UP)
    np.testing.assert_array_equal(hand.goal, edge)
    tap(jogger, DOWN)
    assert jogger.notice == ""
    assert hand.goal[0, 3] == pytest.approx(edge[0, 3] - 0.02), "one step back is one step back"


def test_hand_follows_its_goal_no_faster_than_a_quarter_metre_a_second(jogger):
    jogger.next_size()
    tap(jogger, *[HOME] * 3)  # 60 mm at once
    hand, kinematics = jogger.hands["left"], jogger.kinematics["left"]
    heights = [hand.pose[2, 3]]
    for _ in range(10):
        jogger.targets()
        heights.append(kinematics.pose(hand.joints_rad)[2, 3])
    assert np.diff(heights).max() == pytest.approx(0.25 / 30, rel=0.01)
    assert heights[-1] - heights[0] == pytest.approx(0.06, abs=2e-5)


# whole attempts, with a window that a script types into ------------------------------------------------------------------


class ScriptedWindow:
    """Types some keys at each control step; when it knows no more, it is closed."""

    def __init__(self, script: Iterable[Sequence[int]]) -> None:
        self.script, self.now, self.shown = iter(script), [], []

    def tick(self, sim: Simulation, lines: Sequence[str], goals: Sequence[np.ndarray]) -> None:
        self.shown.append(" | ".join(lines))
        keys = next(self.script, None)
        if keys is None:
            raise teleop._WindowClosed("the window was closed")
        self.now = list(keys)

    def taps(self) -> list[int]:
        taken, self.now = self.now, []
        return taken

    def held(self, codes: Iterable[int]) -> set[int]:
        return set()

    def close(self) -> None:
        self.script = iter(())


def with_script(monkeypatch: pytest.MonkeyPatch, script: Iterable[Sequence[int]]) -> ScriptedWindow:
    window = ScriptedWindow(script)
    monkeypatch.setattr(teleop, "ViewerWindow", lambda sim: window)
    teleop._sessions.clear()
    return window


def run(plan: CollectPlan, sim: Simulation, k: int = 0) -> EpisodeRecorder:
    done = attempt(plan, sim, row_spec(sim, pictures=False), k)
    assert done.recorder is not None
    return done.recorder


def column(recorder: EpisodeRecorder, key: str) -> np.ndarray:
    return np.stack([row[key] for row in recorder.rows])


DRIVE = [[UP], [UP], [], [SPACE], [HOME], [DELETE], []]


def test_keyboard_attempt_is_the_re_execution_of_the_file_it_left(tmp_path, bench, monkeypatch):
    window = with_script(monkeypatch, [[], [LEFT], [ENTER], *DRIVE, [ENTER], *[[UP]] * 40])
    plan = CollectPlan(task="bench", source=KeyboardSource(folder=str(tmp_path)), seed=3)
    recorder = run(plan, bench)
    (path,) = tmp_path.iterdir()
    file = ActionFile.read(path)
    assert path.name == f"bench_{plan.attempt_seed(0)}_000.jsonl"
    assert (file.end, file.outcome, file.header["source"]) == ("finished", "unfinished", "keyboard")
    assert file.scene == scene_of(bench)
    assert len(recorder.rows) == len(file.actions) == len(DRIVE) + 30, (
        "what was driven, and a second in which all holds still"
    )
    np.testing.assert_array_equal(column(recorder, "action"), file.actions)
    assert (file.actions[-30:] == file.actions[-31]).all()
    assert np.ptp(file.actions[:, :6], axis=0).max() > 0.01
    assert np.ptp(file.actions[:, 7:13], axis=0).max() > 0.005, "the right hand was raised"
    driven = teleop._sessions[bench].sim
    # live and re-executed: the same bits
    np.testing.assert_array_equal(driven.arrays["qpos"], bench.arrays["qpos"], strict=True)
    assert "begin" in window.shown[0]
    assert any("right hand, step medium" in shown for shown in window.shown)

    with_script(monkeypatch, [])  # a person who is not there
    again = run(plan, bench)
    for key in recorder.rows[0]:
        np.testing.assert_array_equal(column(again, key), column(recorder, key))
    with pytest.raises(TaccorlError, match="window was closed"):
        run(plan, bench, k=1)  # but another scene needs the person


def test_discarded_attempt_is_kept_apart_and_the_scene_begins_anew(tmp_path, bench, monkeypatch):
    with_script(monkeypatch, [[ENTER], [UP], [UP], [F9], [ENTER], [LEFT], [ENTER], *[[]] * 40])
    source = KeyboardSource(folder=str(tmp_path))
    recorder = run(CollectPlan(task="bench", source=source, seed=3), bench)
    first, second = (ActionFile.read(path) for path in sorted(tmp_path.iterdir()))
    assert (first.end, len(first.actions)) == ("discarded", 2)
    assert (second.end, len(second.actions)) == ("finished", 1 + 30)
    assert first.header["seed"] == second.header["seed"]
    np.testing.assert_array_equal(column(recorder, "action"), second.actions)
    assert ActionsSource(path=str(tmp_path)).files()[0].path == second.path, "a folder's discarded files are left out"


def test_window_closed_in_the_middle_loses_nothing_and_asks_anew_next_time(tmp_path, bench, monkeypatch):
    plan = CollectPlan(task="bench", source=KeyboardSource(folder=str(tmp_path)), seed=3)
    with_script(monkeypatch, [[ENTER], [UP], [UP], [UP]])
    with pytest.raises(TaccorlError, match=r"3 actions are in .*_000\.jsonl"):
        run(plan, bench)
    cut = ActionFile.read(next(tmp_path.iterdir()))
    assert (cut.end, len(cut.actions)) == (None, 3)
    with_script(monkeypatch, [[ENTER], [LEFT], [ENTER], *[[]] * 40])
    assert len(run(plan, bench).rows) == 31


def test_failure_waits_for_the_person_who_tries_again_or_keeps_it(tmp_path, monkeypatch):
    script = [[ENTER], *[[UP]] * 6, [], [], [F9], [ENTER], *[[LEFT]] * 6, [], [ENTER]]
    window = with_script(monkeypatch, script)
    sim = Simulation(tasks.get("bench")())
    recorder = run(CollectPlan(task="bench", source=KeyboardSource(folder=str(tmp_path), time_limit_s=0.2)), sim)
    ends = [(file.end, file.outcome, len(file.actions)) for file in map(ActionFile.read, sorted(tmp_path.iterdir()))]
    assert ends == [("discarded", "timeout", 6), ("finished", "timeout", 6)]
    assert len(recorder.rows) == 6
    assert outcome_of(sim) == "timeout"
    assert any("timeout! F9: again; Enter: keep" in shown for shown in window.shown)


def test_person_has_more_time_than_the_task_gives_an_expert_and_so_has_the_re_execution(tmp_path, monkeypatch):
    hasty = type("Hasty", (tasks.get("bench"),), {"time_limit_s": 0.2})  # out of time after 6 control steps
    sim = Simulation(hasty())
    with_script(monkeypatch, [[ENTER], *[[UP]] * 10, [ENTER], *[[]] * 40])
    recorder = run(CollectPlan(task="bench", source=KeyboardSource(folder=str(tmp_path))), sim)
    assert len(recorder.rows) == 10 + 30
    assert outcome_of(sim) == "unfinished"
    (path,) = tmp_path.iterdir()
    other = Simulation(hasty())
    assert len(run(ActionsSource(path=str(path)).plan(CollectPlan(task="")), other).rows) == 40


# action files ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Overheard(ExpertSource):
    """The expert, with every action it gives written down before it acts."""

    log: Any = None

    def actions(self, sim: Simulation, rng: np.random.Generator) -> Actions:
        for targets in super().actions(sim, rng):
            self.log.append(targets.sent)
            yield targets


def test_experts_actions_re_executed_give_bit_identical_rows(tmp_path):
    plan = CollectPlan(task="assembly_1", randomization=0.5)
    sim = plan.make()
    sim.reset([plan.attempt_seed(0)])
    with ActionLog(tmp_path, sim, "expert") as log:
        expert = Overheard(log=log, hands=dataclasses.replace(EXACT, speed=2.0))  # hasty: a short episode does
        original = run(dataclasses.replace(plan, source=expert), sim)
        log.end("finished", outcome_of(sim))
    assert outcome_of(sim) == "success", "choose another seed: this one is to show a success"
    replayed = ActionsSource(path=str(log.path)).plan(CollectPlan(task=""))
    assert (replayed.task, replayed.randomization, replayed.episodes) == ("assembly_1", 0.5, 1)
    assert replayed.attempt_seed(0) == plan.attempt_seed(0)
    other = replayed.make()
    again = run(replayed, other)
    assert outcome_of(other) == "success"
    assert len(again.rows) == len(original.rows)
    for key in original.rows[0]:
        np.testing.assert_array_equal(column(again, key), column(original, key), err_msg=key, strict=True)
    with pytest.raises(TaccorlError, match="all 1 action files"):
        replayed.attempt_seed(1)


def write(folder: Path, sim: Simulation, actions: np.ndarray, end: str | None, outcome: str = "unfinished") -> Path:
    with ActionLog(folder, sim, "keyboard") as log:
        for action in actions:
            log.append(action)
        if end:
            log.end(end, outcome)
    return log.path


def random_actions(num: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(ROBOT.action_low, ROBOT.action_high, (num, 14)).astype(np.float32)


def test_float32_actions_come_back_bit_for_bit_wherever_the_file_is_cut(tmp_path, sim):
    actions = random_actions(40)
    actions[3, :3] = np.float32(1) / 3, np.nextafter(np.float32(0.1), np.float32(1)), -0.0
    whole = write(tmp_path, sim, actions, "finished", "success")
    file = ActionFile.read(whole)
    assert file.actions.tobytes() == actions.tobytes()
    assert (file.end, file.outcome) == ("finished", "success")
    content = whole.read_bytes()
    first = content.index(b"\n") + 1
    for size in range(first, len(content), 97):
        whole.write_bytes(content[:size])
        cut = ActionFile.read(whole)
        assert len(cut.actions) == min(content[first:size].count(b"\n"), 40)
        assert cut.actions.tobytes() == actions[: len(cut.actions)].tobytes()
        assert cut.end is None


def test_actions_reach_the_file_at_once_and_the_disk_each_second(tmp_path, sim, monkeypatch):
    log = ActionLog(tmp_path, sim, "keyboard")
    synced: list[int] = []
    monkeypatch.setattr(os, "fsync", lambda descriptor: synced.append(log.num_actions))
    for k, action in enumerate(random_actions(75)):
        log.append(action)
        assert len(ActionFile.read(log.path).actions) == k + 1, "a process that is killed loses none"
    assert synced == [30, 60]
    log.close()
    assert synced == [30, 60, 75]


def test_damaged_and_foreign_files_are_refused_by_line(tmp_path, sim):
    path = write(tmp_path, sim, random_actions(3), "finished")
    lines = path.read_text().splitlines()
    for number, line, says in (
        (3, "[1, 2", "damaged"),
        (3, "[1, 2]", "expected 14 numbers"),
        (1, "{}", "is not an action file"),
    ):
        path.write_text("\n".join(line if k == number else text for k, text in enumerate(lines, 1)) + "\n")
        with pytest.raises(TaccorlError, match=says) as caught:
            ActionFile.read(path)
        assert number == 1 or f":{number}:" in str(caught.value)
    path.write_bytes(b"")
    with pytest.raises(TaccorlError, match="is not an action file"):
        ActionFile.read(path)


def test_only_a_finished_demonstration_of_the_very_scene_is_taken_for_one(tmp_path, sim):
    scene = scene_of(sim)
    write(tmp_path, sim, random_actions(2), "discarded")
    write(tmp_path, sim, random_actions(2), None)
    assert find_finished(tmp_path, scene, "keyboard") is None
    path = write(tmp_path, sim, random_actions(2), "finished")
    found = find_finished(tmp_path, scene, "keyboard")
    assert found is not None and found.path == path
    assert find_finished(tmp_path, scene, "leader") is None
    for key, other in (("difficulty", "hard"), ("twin", "effects: [x]"), ("randomization", 0.5)):
        assert find_finished(tmp_path, {**scene, key: other}, "keyboard") is None, key
    path.write_text(path.read_text().replace(f'"mujoco": "{mujoco.__version__}"', '"mujoco": "3.9.0"'))
    assert find_finished(tmp_path, scene, "keyboard") is None, "another MuJoCo: not surely the same bits"


def test_re_execution_that_does_not_end_as_recorded_is_an_error(tmp_path, sim):
    plan = ActionsSource(path=str(write(tmp_path, sim, random_actions(3) * 0, "finished", "success"))).plan(
        CollectPlan(task="")
    )
    with pytest.raises(TaccorlError, match=r"recorded as success after 3 .* unfinished"):
        run(plan, sim)


def test_plan_of_action_files_is_theirs_and_says_where_the_command_line_differs(tmp_path, sim):
    paths = [write(tmp_path, sim, random_actions(2), "finished", outcome) for outcome in ("unfinished", "success")]
    source = ActionsSource(path=str(tmp_path))
    plan = source.plan(CollectPlan(task="bench"))
    assert plan.episodes == 1
    assert [file.path for file in plan.files] == [paths[1], paths[0]], "a success first: that is what is collected"
    assert [f.path for f in source.plan(CollectPlan(task="", keep_failures=True)).files] == paths
    for wrong, says in (
        (CollectPlan(task="puzzle"), "--task=puzzle"),
        (CollectPlan(task="", difficulty="hard"), "--difficulty"),
    ):
        with pytest.raises(TaccorlError, match=says):
            source.plan(wrong)
    with pytest.raises(TaccorlError, match="2 action files"):
        run(plan, sim)  # two of one scene
    with pytest.raises(TaccorlError, match="is not there"):
        ActionsSource(path=str(tmp_path / "nothing")).plan(CollectPlan(task=""))


def test_other_actions_under_the_same_path_are_another_source(tmp_path, sim):
    path = write(tmp_path, sim, random_actions(2), "finished")
    before = ActionsSource(path=str(path))
    path.write_bytes(path.read_bytes().replace(b'"finished"', b'"discarded"'))
    assert before != ActionsSource(path=str(path))


# display -----------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_without_a_display_the_command_says_so_and_the_way_out(tmp_path):
    command = ["-m", "taccorl.cli.main", "collect", "--task=bench", "--source.type=keyboard", "--images=false"]
    done = fresh_python(*command, "--store=store", "--out=out", cwd=tmp_path, without=("DISPLAY", "WAYLAND_DISPLAY"))
    assert done.returncode == 2
    assert "no display: DISPLAY and WAYLAND_DISPLAY are not set" in done.stderr
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


def options(tmp_path: Path, names: Sequence[str] = NAMES, port: str = "/dev/null") -> Path:
    path = tmp_path / "leader.yaml"
    path.write_text(json.dumps({"port": port, "names": list(names), "calibration_dir": str(tmp_path / "calibration")}))
    return path


def pair(tmp_path: Path, names: Sequence[str] = NAMES, port: str = "/dev/null", **settings: Any) -> LeaderSource:
    said = {"joint_unit": "deg", "gripper_unit": "range_0_100", **settings}
    path = str(options(tmp_path, names, port))
    return LeaderSource(teleop="test_pair_of_arms", options=path, folder=str(tmp_path / "teleop"), **said)


def test_leader_in_degrees_and_percent_is_read_in_rad_and_m(tmp_path, leader_kind):
    from taccorl.lerobot_plugin.leader import open_leader

    leader = open_leader(pair(tmp_path, NAMES[::-1]))  # LeRobot promises no order
    np.testing.assert_allclose(leader.read(), [0, 1.6, -1, 0, 0.9, 0, 0.035] * 2, atol=1e-12)
    leader.close()


def test_normalised_range_spans_the_twins_own_joint_range():
    from taccorl.lerobot_plugin.leader import to_twin

    low, high = to_twin(np.full(14, -100.0), "range_m100_100", "m"), to_twin(np.full(14, 100.0), "range_m100_100", "m")
    np.testing.assert_allclose(low[[0, 1, 2]], (-2.618, 0.0, -2.967), atol=1e-6)
    np.testing.assert_allclose(high[[0, 1, 2]], (2.618, 3.14, 0.0), atol=1e-6)
    np.testing.assert_array_equal(to_twin(np.arange(14.0), "rad", "m"), np.arange(14.0))


def test_values_missing_and_left_over_are_named_and_can_be_renamed(tmp_path, leader_kind):
    from taccorl.lerobot_plugin.leader import match_names, open_leader

    given = [*NAMES[:5], "left_wrist_roll.pos", *NAMES[6:], "left_joint_7.pos"]
    with pytest.raises(TaccorlError) as caught:
        open_leader(pair(tmp_path, given))
    said = str(caught.value)
    assert "15 values" in said
    assert "Missing: left_joint_6.pos;" in said
    assert "left over: left_wrist_roll.pos, left_joint_7.pos." in said
    renamed = {"left_wrist_roll.pos": "left_joint_6.pos", "left_joint_7.pos": None}
    assert match_names(given, renamed, "x") == [*NAMES[:5], "left_wrist_roll.pos", *NAMES[6:]]
    with pytest.raises(TaccorlError, match=r"15 values, but.*twin.*14. Left over: left_joint_7.pos"):
        match_names([*NAMES, "left_joint_7.pos"], {}, "x")
    with pytest.raises(TaccorlError, match=r"for the same value: left_joint_1.pos, left_joint_2.pos"):
        match_names(NAMES, {"left_joint_2.pos": "left_joint_1.pos"}, "x")
    with pytest.raises(TaccorlError, match=r"'left_jiont_2.pos'; did you mean 'left_joint_2.pos'"):
        match_names(NAMES, {"left_jiont_2.pos": None}, "x")


def test_units_have_to_be_said_and_wrong_ones_are_refused_at_the_first_reading(tmp_path, leader_kind):
    from taccorl.lerobot_plugin.leader import open_leader

    with pytest.raises(TaccorlError, match=r"joint_unit=rad\|deg\|range_m100_100: it has to be said"):
        open_leader(pair(tmp_path, joint_unit=""))
    with pytest.raises(TaccorlError, match="'mm' is none of them"):
        open_leader(pair(tmp_path, gripper_unit="mm"))
    with pytest.raises(TaccorlError, match=r"left_joint_2.pos reads 91.6732 rad, far beyond .*another unit"):
        open_leader(pair(tmp_path, joint_unit="rad")).read()
    with pytest.raises(TaccorlError, match=r"left_gripper.pos reads 50 m, far beyond 0 … 0.07 m"):
        open_leader(pair(tmp_path, gripper_unit="m")).read()


def test_unknown_leader_wrong_options_and_dead_port_are_told(tmp_path, leader_kind):
    from taccorl.lerobot_plugin.leader import open_leader, teleoperator_config

    with pytest.raises(TaccorlError, match="did you mean 'bi_so_leader'"):
        teleoperator_config("bi_so_leder")
    with pytest.raises(TaccorlError, match="does not fit"):
        teleoperator_config("test_pair_of_arms")  # no port
    with pytest.raises(TaccorlError, match=r"cannot connect: ConnectionError: no such port"):
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
    actions = [hands.act([])[0] for _ in range(90)]
    steps = np.abs(np.diff([start, *actions], axis=0))
    assert steps[:, [0, 1, 2, 3, 4, 5]].max() == pytest.approx(0.6 / 30, abs=1e-6)
    np.testing.assert_allclose(actions[-1], leader.target, atol=1e-6)
    leader.target = leader.target + np.eye(14)[0] * 0.3
    np.testing.assert_allclose(hands.act([])[0], leader.target, atol=1e-6)
    leader.target = leader.target + np.eye(14)[1] * 2.0  # beyond the joint's limit
    assert hands.act([])[0][1] == np.float32(ROBOT.action_high[1])
    assert "beyond the twin's range: left_joint2" in hands.lines()[0]


def test_leader_drives_a_whole_attempt(tmp_path, bench, leader_kind, monkeypatch):
    from taccorl.lerobot_plugin.leader import open_leader

    teleop.use_leader_driver(open_leader)
    with_script(monkeypatch, [[ENTER], *[[]] * 70, [ENTER], *[[]] * 40])
    recorder = run(CollectPlan(task="bench", source=pair(tmp_path)), bench)
    assert len(recorder.rows) == 70 + 30
    np.testing.assert_allclose(column(recorder, "action")[-1], [0, 1.6, -1, 0, 0.9, 0, 0.035] * 2, atol=1e-6)
    assert ActionFile.read(next((tmp_path / "teleop").iterdir())).header["source"] == "leader"

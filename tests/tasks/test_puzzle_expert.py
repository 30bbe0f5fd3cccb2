"""The demonstrator of Do Puzzle: every place in reach, one hand at the tray, pieces felt in and picked up again."""

import itertools

import numpy as np
import pytest

from taccorl.robots import ROBOT
from taccorl.sim.robot import RobotConfig
from taccorl.sim.simulation import Simulation
from taccorl.tasks.experts.hands import EXACT, ScriptedExpertConfig
from taccorl.tasks.experts.kinematics import ArmKinematics
from taccorl.tasks.experts.se3 import transform, turn
from taccorl.tasks.puzzle import expert as puzzle
from taccorl.tasks.puzzle.expert import PuzzleExpert
from taccorl.tasks.puzzle.scene import PIECES_AT_M, TRAY_AT_M, Puzzle

ARM_OF = {"circle": "left", "heart": "right", "triangle": "right"}
GRIP_ABOVE_M = 0.056 + 0.001  # TCP over a piece's underside when it is gripped


@pytest.fixture(scope="module")
def sim() -> Simulation:
    return Simulation(Puzzle())


class Episode:
    """One run to its end, and what was seen meanwhile."""

    def __init__(self, sim: Simulation, seed: int, config: ScriptedExpertConfig | None = None) -> None:
        sim.reset([seed])
        self.expert = PuzzleExpert(sim, np.random.default_rng([seed, 7]), config)
        self.expert.start()
        self.penetration_m, self.hands_m, self.lost_steps = 0.0, [], 0
        while not sim.judge.outcome.over[0]:
            sim.step(self.expert.act()[None])
            deepest = max(sim.contact(*pair).penetration_m[0] for pair in sim.task.mating)
            self.penetration_m = max(self.penetration_m, deepest)
            self.hands_m.append([sim.tcp(arm)[0, :3, 3] for arm in ROBOT.arms])
            self.lost_steps = max(self.lost_steps, sim.judge.lasted[0].max())
        self.outcome, self.subtask = sim.judge.outcome, sim.judge.subtask[0].tolist()
        self.duration_s = len(self.hands_m) / 30

    def noted(self, what: str) -> int:
        return sum(what in event for _, event in self.expert.events)


def places() -> list[tuple[str, tuple[float, float, float]]]:
    """Arm and TCP position of every grasp and every placing at the ends of the ranges."""
    found = []
    for piece, arm in ARM_OF.items():
        x, y = PIECES_AT_M[piece]
        reach_y = 0.040 if piece == "circle" else 0.037
        for dx, dy, z in itertools.product((-0.040, 0.040), (-reach_y, reach_y), (0.0, 0.06)):
            found.append((arm, (x + dx, y + dy, GRIP_ABOVE_M + z)))
        (tray_x, tray_y), row = TRAY_AT_M, {"circle": 0.060, "heart": 0.0, "triangle": -0.060}[piece]
        # 5 mm of position; 5° of yaw move a hole 60 mm out by 5 mm more.
        for dx, dy, z in itertools.product((-0.010, 0.010), (-0.005, 0.005), (0.004, 0.014 + 0.045)):
            found.append((arm, (tray_x + dx, tray_y + row + dy, GRIP_ABOVE_M + z)))
    return found


def test_every_place_is_a_fifth_of_a_radian_from_the_joint_limits():
    low, high = np.array([link.range_rad for link in ROBOT.links]).T
    down = np.diag([-1.0, 1, -1])
    arms = {arm: ArmKinematics(arm, RobotConfig()) for arm in ROBOT.arms}
    for arm, pos in places():
        for yaw_rad in np.deg2rad((-15, 15)):  # of a piece and the tray together
            joints = arms[arm].search(transform(pos, down) @ turn((0, 0, yaw_rad)), np.random.default_rng(0), tries=8)
            assert np.minimum(joints - low, high - joints).min() > 0.2, (arm, pos)
            assert abs(joints[4]) > 0.15, (arm, pos)  # the wrist is not stretched out


def test_home_is_a_fifth_of_a_radian_from_the_joint_limits():
    low, high = np.array([link.range_rad for link in ROBOT.links]).T
    for arm in ROBOT.arms:
        home = np.array(Puzzle.home_rad[arm])
        assert np.minimum(home - low, high - home).min() > 0.2


@pytest.mark.slow
def test_exact_hands_need_no_correction(sim):
    episode = Episode(sim, 0, EXACT)
    assert episode.outcome.success[0]
    assert episode.outcome.partial[0] == 3
    assert episode.expert.events == []
    assert episode.subtask == [2, 4]
    assert episode.penetration_m < 2e-4
    assert episode.expert.unreachable_m < 1e-3
    assert episode.duration_s < 25


@pytest.mark.slow
def test_human_hands_feel_the_rim_and_one_is_at_the_tray_at_a_time(sim):
    episode = Episode(sim, 1)
    assert episode.outcome.success[0]
    assert episode.noted("blocked") > 0
    assert episode.penetration_m < 2e-4
    assert episode.duration_s < 40
    # Over the tray: less than 60 mm above it, and above the row of holes.
    hands = np.array(episode.hands_m) - (*TRAY_AT_M, 0.014)
    at_tray = (np.abs(hands[..., 0]) < 0.04) & (np.abs(hands[..., 1]) < 0.09) & (hands[..., 2] < 0.10)
    assert at_tray.any(axis=0).all()
    assert not at_tray.all(axis=1).any()
    assert np.linalg.norm(hands[:, 0] - hands[:, 1], axis=1).min() > 0.09


@pytest.mark.slow
def test_a_piece_that_rests_on_the_rim_is_picked_up_again_before_it_is_lost(sim, monkeypatch):
    monkeypatch.setattr(puzzle, "_LONGEST_S", 1.0)  # no patience: it lets go on the rim
    episodes = [Episode(sim, seed) for seed in (0, 1, 7)]
    assert sum(episode.noted("rests on the rim") for episode in episodes) >= 2
    for episode in episodes:
        assert episode.outcome.success[0]
        assert episode.lost_steps < 30

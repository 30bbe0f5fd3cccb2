"""Where a policy aims before the mate: the regression written out, and hands whose answers are known."""

import numpy as np
import pytest

from taccorl.errors import TaccorlError
from taccorl.evaluation.before_mate import Aim, aimed, aims
from taccorl.evaluation.evaluate import Scenes
from taccorl.evaluation.rollouts import Acted
from taccorl.robots import ROBOT
from taccorl.sim.spaces import STATE_KEY
from taccorl.sim.twin import TwinConfig
from taccorl.tasks.experts.kinematics import ArmKinematics


class KnownHands:
    """Moves the right hand by a constant in the world, everything else stays."""

    name, needs_images, needs_part_poses, max_batch = "known hands", False, False, None

    def __init__(self, moved_m: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> None:
        self.moved_m, self.acts = moved_m, 0
        self.kinematics = ArmKinematics("right", TwinConfig().robot)

    def looks_now(self) -> bool:
        return False

    def restart(self, stream: int = 0) -> None:
        self.acts = 0

    def begin(self, envs, pictures: str) -> None:
        assert self.acts == 0

    def act(self, observation) -> Acted:
        self.acts += 1
        target, own = (
            observation[STATE_KEY][0].astype(float),
            ROBOT.joint_slice("right"),
        )
        goal = self.kinematics.pose(target[own])
        goal[:3, 3] += self.moved_m
        target[own] = self.kinematics.solve(goal, target[own])[0]
        return Acted(target[None].astype(np.float32))


def test_the_regression_written_out():
    """Two grips, 0.5 of each displacement is kept, errors +1 and −1 mm in x: 0 ± 2 mm → 1 ± 1 and −1 ± 1 mm. The standard
    deviation of +1 and −1 is √2; y, which both grips meet exactly, keeps all."""
    answers = [
        Aim(seed, np.array([x, y]), np.array([0.5 * x + error, y]))
        for seed, error in ((1, 0.001), (2, -0.001))
        for x, y in ((-0.002, 0.0), (0.002, 0.0), (0.0, 0.003), (0.0, 0.0))
    ]
    found = aimed(answers)
    np.testing.assert_allclose(found.kept, [0.5, 1.0], atol=1e-12)
    np.testing.assert_allclose(found.error_m, [0.001 * np.sqrt(2), 0.0], atol=1e-12)
    assert found.grips == 2 and "0.50 and 1.00" in str(found)


@pytest.mark.parametrize(
    "task",
    [
        *(pytest.param(t, marks=pytest.mark.slow) for t in ("assembly_1", "test_tube")),
        "puzzle",
    ],
)
def test_hands_that_stay_keep_a_displacement_and_moved_ones_add_to_it(task):
    scenes = Scenes(tasks=(task,), episodes=2, seed=7)
    across_m = ((-0.003, 0.0), (0.003, 0.0), (0.0, 0.003))
    stay = aims(scenes, task, KnownHands(), 3, across_m=across_m)
    assert [answer.seed for answer in stay] == [7, 7, 7, 8, 8, 8]
    for answer, wanted in zip(stay, 2 * across_m, strict=True):
        np.testing.assert_allclose(
            answer.displaced_m, wanted, atol=0.0005
        )  # what the arm's droop and the servo leave
        np.testing.assert_allclose(answer.aim_m, answer.displaced_m, atol=1e-5)
    np.testing.assert_allclose(aimed(stay).kept, 1.0, atol=0.01)
    moved = aims(
        Scenes(tasks=(task,), episodes=1, seed=7),
        task,
        KnownHands((0.0, 0.0, 0.002)),
        3,
        across_m=across_m[:1],
    )
    beside = np.array([m.aim_m - m.displaced_m for m in moved])
    assert np.all(np.linalg.norm(beside, axis=1) <= 0.00201)
    if task == "assembly_1":  # its holes lie level: up is across the axis
        np.testing.assert_allclose(np.linalg.norm(beside, axis=1), 0.002, atol=1e-4)
    else:  # down is along it
        np.testing.assert_allclose(beside, 0.0, atol=1e-4)


def test_a_task_whose_expert_never_gets_there_is_named():
    scenes = Scenes(tasks=("assembly_1",), episodes=1, seed=7, episode_length=30)
    with pytest.raises(TaccorlError, match="assembly_1: in none of 1 scenes"):
        aims(scenes, "assembly_1", KnownHands(), 3)

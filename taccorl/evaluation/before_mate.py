"""Where a policy aims when a part that it holds before its mate is displaced: how much of what it sees reaches its actions.

The scripted expert grips, with a grip of its own in each scene, and brings the part before the hole. Its hand is then displaced
across the hole's axis and held still, and the policy is asked for its next action. The *aim* is where the part's leading end
would be, in the hole's frame, if both hands reached the targets of that action with everything fixed in them. Of all grips

    aim = kept · displacement + error of the grip            kept 0: aims at the axis; 1: stays where it is

The arms' droop under gravity is in the aim, the same for every policy.
"""

import dataclasses
import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from taccorl.errors import TaccorlError
from taccorl.evaluation.evaluate import Scenes
from taccorl.evaluation.policy_actor import Checkpoint, open_checkpoint
from taccorl.evaluation.rollouts import Actor
from taccorl.robots import ROBOT
from taccorl.sim.simulation import Snapshot
from taccorl.sim.spaces import STATE_KEY, Observation
from taccorl.sim.vector_env import TaccorlVectorEnv
from taccorl.tasks.experts import expert_of
from taccorl.tasks.experts.hands import ScriptedExpertConfig
from taccorl.tasks.experts.mating import Mating
from taccorl.tasks.experts.scripted import ScriptedExpert
from taccorl.tasks.experts.se3 import inverse

ACROSS_M = (
    (0.0, 0.0),
    (-0.004, 0.0),
    (-0.002, 0.0),
    (0.002, 0.0),
    (0.004, 0.0),
    (0.0, -0.003),
    (0.0, 0.003),
)
"""Displacements across the hole's axis, x and y in its frame [m]."""
MANY_GRIPS = ScriptedExpertConfig(grasp_m=0.004, grasp_rad=0.06)
"""Grips as wide apart as those of ``pipelines.learn``."""
EXECUTED = 10
"""Actions of a chunk that are executed: few predictions are needed, only to fill the window of touch."""
BEFORE_M = 0.018
"""Distance of the leading end before the hole's mouth [m]."""
_WITHIN_M = 0.004  # of the axis, when the expert has brought the part
_BEFORE_RANGE_M = (0.014, 0.024)
_SERVO_STEPS, _STILL_STEPS = 32, 13
_SERVO_GAIN, _LARGEST_M = (
    0.25,
    0.004,
)  # share of the remaining displacement that a step corrects, and its limit


@dataclass(frozen=True)
class Aim:
    """Answer of a policy to one displacement."""

    seed: int
    """Of the scene and its grip."""
    displaced_m: np.ndarray
    """(2,) where the leading end is, across the hole's axis [m]."""
    aim_m: np.ndarray
    """(2,) where the policy's next action would bring it [m]."""


@dataclass(frozen=True)
class Aimed:
    """Aims of a policy over many grips, x and y across the hole's axis."""

    kept: np.ndarray
    """(2,) share of a displacement that remains in the aim."""
    error_m: np.ndarray
    """(2,) standard deviation over grips of the aim without a displacement [m]; NaN for a single grip."""
    grips: int

    def __str__(self) -> str:
        (x, y), (error_x, error_y) = self.kept, 1e3 * self.error_m
        errors = f"error of a grip {error_x:.2f} and {error_y:.2f} mm"
        return f"keeps {x:.2f} and {y:.2f} of a displacement, {errors} ({self.grips} grips)"


def aims(
    scenes: Scenes,
    task: str,
    actor: Actor,
    executed: int,
    window: int = 1,
    hands: ScriptedExpertConfig = MANY_GRIPS,
    across_m: Sequence[tuple[float, float]] = ACROSS_M,
    progress: Callable[[str], None] = lambda text: None,
) -> list[Aim]:
    """Ask a policy at each displacement of each of the ``scenes.episodes`` grips.

    Args:
        actor: predicts in every ``executed``-th control step.
        window: rows that the policy must have felt when it is asked.
        hands: spread of the expert's grips.

    Raises:
        TaccorlError: the expert of the task mates nothing, or brings no part before its hole in any of the scenes.
    """
    found: list[Aim] = []
    rows = executed * max(1, math.ceil((window - 1) / executed)) + 1
    env = scenes.environments(
        task, 1, images=actor.needs_images, part_poses=actor.needs_part_poses
    )
    try:
        for seed in scenes.seeds:
            held = _Held.bring(env, seed, hands)
            answers = (
                []
                if held is None
                else [held.ask(actor, rows, scenes.pictures, seed, m) for m in across_m]
            )
            asked = [answer for answer in answers if answer is not None]
            if held is not None and len(asked) == len(answers):
                found += asked
            ended = "asked" if asked else "not brought before its mate"
            progress(
                f"{task}, grip {seed}: {ended if len(asked) == len(answers) else 'lost when it was displaced'}"
            )
    finally:
        env.close()
    if not found:
        raise TaccorlError(
            f"{task}: in none of {scenes.episodes} scenes the expert brought a part before its mate"
        )
    return found


def aims_of(
    scenes: Scenes,
    checkpoints: Sequence[Checkpoint],
    grips: int,
    device: str | None,
    seed: int,
    progress: Callable[[str], None],
) -> dict[str, dict[str, Any]]:
    """Path of a checkpoint → task → its aims of ``grips`` further scenes, which are also printed."""
    held = dataclasses.replace(
        scenes, episodes=grips, seed=scenes.seeds.stop, episode_length=None
    )
    found: dict[str, dict[str, Any]] = {}
    for one in checkpoints:
        predicted = getattr(one.config, "chunk_size", None)
        steps = None if predicted is None else min(EXECUTED, predicted)
        checkpoint, name = (
            open_checkpoint(one.path, device, n_action_steps=steps),
            str(one.path),
        )
        found[name] = {}
        for task in scenes.tasks:
            rows = {
                "executed": steps or 1,
                "window": getattr(one.config, "window_rows", 1),
            }
            try:
                answers = aimed(
                    aims(held, task, checkpoint.load(seed), **rows, progress=progress)
                )
            except TaccorlError as error:  # the scores are still written
                print(f"note: --before_mate: {error}")
                continue
            print(f"{name}, {task}, before the mate: {answers}")
            numbers = {
                "kept": answers.kept.tolist(),
                "error_m": answers.error_m.tolist(),
            }
            found[name][task] = {
                **numbers,
                "grips": answers.grips,
                "text": str(answers),
            }
    return found


def aimed(answers: Sequence[Aim]) -> Aimed:
    """Regression of ``aims``: displacements along x count for x, those along y for y."""
    displaced_m = np.array([answer.displaced_m for answer in answers])
    aim_m = np.array([answer.aim_m for answer in answers])
    seeds, grip = np.unique([answer.seed for answer in answers], return_inverse=True)
    kept, error_m = np.empty(2), np.empty(2)
    for axis in range(2):
        x, y = displaced_m[:, axis], aim_m[:, axis]
        means = [np.bincount(grip, v) / np.bincount(grip) for v in (x, y)]
        kept[axis] = (
            (x - means[0][grip])
            @ (y - means[1][grip])
            / ((x - means[0][grip]) @ (x - means[0][grip]))
        )
        error_m[axis] = (
            (means[1] - kept[axis] * means[0]).std(ddof=1) if len(seeds) > 1 else np.nan
        )
    return Aimed(kept, error_m, len(seeds))


@dataclass
class _Held:
    """A part in the expert's hand before its mate."""

    env: TaccorlVectorEnv
    expert: ScriptedExpert
    arm: str
    mating: Mating
    action: np.ndarray
    """(14,) last action."""
    state: Snapshot

    @classmethod
    def bring(
        cls, env: TaccorlVectorEnv, seed: int, hands: ScriptedExpertConfig
    ) -> "_Held | None":
        """Let the expert act until a part is before its mate; None if that does not happen."""
        env.reset(seed=[seed])
        expert = expert_of(env.sim.task)(
            env.sim, np.random.default_rng([seed, 1]), hands
        )
        expert.start()
        while not expert.done:
            action = expert.act()
            *_, terminated, truncated, _ = env.step(action[None])
            if terminated.any() or truncated.any():
                return None
            for arm, hand in expert.hands.items():
                if hand.mating is None or arm not in expert.running:
                    continue
                fit, (least_m, most_m) = hand.mating.fit(expert), _BEFORE_RANGE_M
                if fit.lateral_m < _WITHIN_M and least_m < -fit.depth_m < most_m:
                    return cls(
                        env,
                        expert,
                        arm,
                        hand.mating,
                        action.astype(float),
                        env.sim.snapshot(),
                    )
        return None

    def ask(
        self,
        actor: Actor,
        rows: int,
        pictures: str,
        seed: int,
        across_m: tuple[float, float],
    ) -> Aim | None:
        """Displace the hand, hold it still, and ask the policy after ``rows`` rows; None if the episode ends."""
        own, kinematics = ROBOT.joint_slice(self.arm), self.expert.kinematics[self.arm]
        self.env.reset(options={"state": self.state})
        action, seen = self.action.copy(), deque[Observation](maxlen=rows)
        for k in range(_SERVO_STEPS + _STILL_STEPS):
            if k < _SERVO_STEPS:
                hole, tip = self._hole(), self._tip()
                off_m = np.array((*across_m, -BEFORE_M)) - (inverse(hole) @ tip)[:3, 3]
                goal = kinematics.pose(action[own])
                goal[:3, 3] += hole[:3, :3] @ (
                    _SERVO_GAIN * np.clip(off_m, -_LARGEST_M, _LARGEST_M)
                )
                action[own] = kinematics.solve(goal, action[own])[0]
            observation, _, terminated, truncated, _ = self.env.step(
                action[None].astype(np.float32)
            )
            if terminated.any() or truncated.any():
                return None
            seen.append(observation)
        shown = self.env.observe(images=True) if actor.needs_images else {}
        actor.restart()
        actor.begin(self.env, pictures)
        for observation in seen:
            target = actor.act({**shown, **observation}).actions[0].astype(float)
        return Aim(
            seed,
            self._relative_m(self._hole(), self._tip()),
            self._aim_m(target, seen[-1][STATE_KEY][0]),
        )

    def _aim_m(self, target: np.ndarray, state: np.ndarray) -> np.ndarray:
        hole, tip, sim = self._hole(), self._tip(), self.expert.sim
        num = len(ROBOT.fingers)
        pads = {arm: slice(num * k, num * (k + 1)) for k, arm in enumerate(ROBOT.arms)}
        for arm in ROBOT.arms:
            own, kinematics = ROBOT.joint_slice(arm), self.expert.kinematics[arm]
            moved = kinematics.pose(target[own]) @ inverse(
                kinematics.pose(state[own].astype(float))
            )
            if arm == self.arm:
                tip = moved @ tip
            elif (
                self.mating.holder in sim.task.parts
                and sim.pads_touching(self.mating.holder)[0, pads[arm]].all()
            ):
                hole = moved @ hole
        return self._relative_m(hole, tip)

    def _relative_m(self, hole: np.ndarray, tip: np.ndarray) -> np.ndarray:
        return (inverse(hole) @ tip)[:2, 3]

    def _hole(self) -> np.ndarray:
        return self.expert.body(self.mating.holder) @ self.mating.holder_from_hole

    def _tip(self) -> np.ndarray:
        return self.expert.body(self.mating.held) @ self.mating.held_from_mate

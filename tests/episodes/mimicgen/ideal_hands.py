"""A world without physics: hands are where they were sent, what a closed hand grips moves with it. And a demonstration in it.

Two hands, two boxes: each grips its own, then both meet in the air; the right one lets go. The same story as assembly_2.
"""

from dataclasses import dataclass, field

import numpy as np

from taccorl.episodes.sources.mimicgen.director import Director
from taccorl.episodes.sources.mimicgen.schedule import ConstraintSpec
from taccorl.episodes.sources.mimicgen.source import ArmTrack, Source, SourcePool
from taccorl.episodes.sources.mimicgen.spec import (
    GenerationSpec,
    MimicSpec,
    SubtaskSpec,
)
from taccorl.tasks.experts.se3 import between, inverse, transform, turn

OPEN_M, CLOSED_M = 0.07, 0.02
NUM_ROWS, GRIP_ROW, LIFTED_ROW, LET_GO_ROW, TOUCH_ROW = (
    60,
    {"left": 18, "right": 22},
    {"left": 26, "right": 30},
    52,
    44,
)
BOX = {"left": "cradle", "right": "plug"}
OTHER = {"left": "plug", "right": "cradle"}
HZ = 30.0
SETTLES = ("num_settle_steps_before_gripper", "num_settle_steps_before_contact")
REST = transform(
    (0, 0, 0.003)
)  # From a hand's goal to what is commanded for it: an arm hangs


def pose(x: float, y: float, z: float, *rotvec: float) -> np.ndarray:
    return transform((x, y, z)) @ turn(rotvec or (0.0, 0.0, 0.0))


@dataclass
class IdealHands:
    """The scene, and whoever executes arm_targets in it."""

    tcps: dict[str, np.ndarray]
    bodies: dict[str, np.ndarray]
    openings: dict[str, float] = field(
        default_factory=lambda: {"left": OPEN_M, "right": OPEN_M}
    )

    def tcp(self, arm: str) -> np.ndarray:
        return self.tcps[arm]

    def body(self, name: str) -> np.ndarray:
        return self.bodies[name]

    def mated(self, name: str) -> bool:
        return False

    def execute(self, arm: str, goal: np.ndarray, opening_m: float) -> None:
        """The box moves with a hand that is closed before and after."""
        gripped = self.openings[arm] == CLOSED_M and opening_m == CLOSED_M
        if gripped:
            body = goal @ inverse(self.tcps[arm]) @ self.bodies[BOX[arm]]
            u, _, v = np.linalg.svd(body[:3, :3])  # or rounding adds up over steps
            body[:3, :3] = u @ v
            self.bodies[BOX[arm]] = body
        self.tcps[arm], self.openings[arm] = goal, opening_m

    def moved(self, g: np.ndarray) -> "IdealHands":
        """The whole scene, hands included, elsewhere."""
        tcps, bodies = (
            {name: g @ p for name, p in poses.items()}
            for poses in (self.tcps, self.bodies)
        )
        return IdealHands(tcps, bodies, dict(self.openings))


def scene(
    plug: np.ndarray | None = None, cradle: np.ndarray | None = None
) -> IdealHands:
    """Hands at home."""
    bodies = {
        "plug": pose(0.30, -0.16, 0.02) if plug is None else plug,
        "cradle": pose(0.30, 0.14, 0.02, 0, 0, 0.3) if cradle is None else cradle,
    }
    return IdealHands(
        {
            "left": pose(0.2, 0.3, 0.2, 3.1, 0, 0),
            "right": pose(0.2, -0.3, 0.2, 3.1, 0, 0),
        },
        bodies,
    )


def demonstration(start: IdealHands, name: str = "demo 0") -> Source:
    """Row t: the scene, then the action."""
    world, home = start.moved(np.eye(4)), dict(start.tcps)
    grasp = {
        arm: world.bodies[BOX[arm]] @ pose(0.002, 0.001, 0.03, 3.1, 0.02, 0)
        for arm in BOX
    }
    meet = {
        "left": pose(0.32, 0.06, 0.16, 3.0, 0.1, 0),
        "right": pose(0.32, -0.04, 0.17, 3.0, -0.1, 0.2),
    }
    rows = {key: [] for key in ("plug", "cradle")}
    tracks = {arm: {"tcp": [], "goal": [], "opening": []} for arm in BOX}
    for t in range(NUM_ROWS):
        for body, poses in rows.items():
            poses.append(world.bodies[body])
        for arm in BOX:
            goal = _goal(t, arm, home[arm], grasp[arm], meet[arm])
            opening = (
                CLOSED_M
                if GRIP_ROW[arm] <= t and not (arm == "right" and t >= LET_GO_ROW)
                else OPEN_M
            )
            tracks[arm]["tcp"].append(world.tcps[arm])
            tracks[arm]["goal"].append(goal)
            tracks[arm]["opening"].append(opening)
            world.execute(arm, goal, opening)
    t = np.arange(NUM_ROWS)
    signals = {
        arm: {
            f"grasp {BOX[arm]}": t >= LIFTED_ROW[arm],
            f"join {BOX[arm]}": t >= LET_GO_ROW + 2,
        }
        for arm in BOX
    }
    arms = {
        arm: ArmTrack(
            tcp=np.stack(v["tcp"]),
            goal=np.stack(v["goal"]),
            joints_rad=np.zeros((NUM_ROWS, 6)),
            opening_m=np.array(v["opening"]),
            command=np.stack(v["goal"]) @ REST,
            command_rad=np.zeros((NUM_ROWS, 6)),
        )
        for arm, v in tracks.items()
    }
    touching = t >= TOUCH_ROW
    return Source(
        name,
        arms,
        {k: np.stack(v) for k, v in rows.items()},
        signals,
        mated={"plug": touching, "cradle": touching},
        free={"plug": ~touching, "cradle": ~touching},
        held={arm: {BOX[arm]: t >= LIFTED_ROW[arm], OTHER[arm]: t < 0} for arm in BOX},
    )


def _goal(
    t: int, arm: str, home: np.ndarray, grasp: np.ndarray, meet: np.ndarray
) -> np.ndarray:
    grip, lifted = GRIP_ROW[arm], LIFTED_ROW[arm]
    if t < grip:
        return between(home, grasp, min((t + 1) / (grip - 2), 1.0))
    up = grasp.copy()
    up[2, 3] += 0.06 * min(max(t - grip - 1, 0) / (lifted - grip - 1), 1.0)
    return (
        up
        if t < lifted
        else between(up, meet, min((t - lifted + 1) / (TOUCH_ROW - lifted), 1.0))
    )


def mimic_spec(
    scheme: str = "replay", *, synchronize_start: bool = False, **generation
) -> MimicSpec:
    """Of the boxes."""

    def subtasks(arm: str) -> tuple[SubtaskSpec, ...]:
        own, other = BOX[arm], OTHER[arm]
        return (
            SubtaskSpec(subtask_term_signal=f"grasp {own}", object_ref=own),
            SubtaskSpec(
                subtask_term_signal=f"join {own}", object_ref=other, held_object=own
            ),
        )

    constraint = ConstraintSpec(
        eef_subtask_constraint_tuple=(("left", 1), ("right", 1)),
        constraint_type="coordination",
        coordination_scheme=scheme,  # pyright: ignore[reportArgumentType]
        coordination_synchronize_start=synchronize_start,
    )
    return MimicSpec(
        spec_version=1,
        task="boxes",
        subtask_configs={arm: subtasks(arm) for arm in BOX},
        task_constraint_configs=(constraint,) if scheme != "none" else (),
        datagen_config=GenerationSpec(**dict.fromkeys(SETTLES, 0) | generation),
    )


@dataclass
class Generated:
    """What a director did with ideal hands."""

    goals: dict[str, np.ndarray]
    openings: dict[str, np.ndarray]
    objects: dict[str, np.ndarray]  # Before each step
    director: Director


def generate(
    pool: SourcePool,
    world: IdealHands,
    seed: int = 0,
    grip_slip: dict[str, np.ndarray] | None = None,
) -> Generated:
    """Until the director has nothing left to do.

    ``grip_slip``: arm → how its box turns and shifts in the hand when it closes.
    """
    world = world.moved(np.eye(4))
    director = Director(pool, world, world.openings, np.random.default_rng(seed), hz=HZ)
    goals, openings = {arm: [] for arm in BOX}, {arm: [] for arm in BOX}
    objects = {body: [] for body in world.bodies}
    while not director.done:
        for body, poses in objects.items():
            poses.append(world.bodies[body])
        for arm, arm_target in director.step(world).items():
            closes = world.openings[arm] == OPEN_M and arm_target.opening_m == CLOSED_M
            world.execute(arm, arm_target.goal, arm_target.opening_m)
            if closes and grip_slip:
                world.bodies[BOX[arm]] = world.bodies[BOX[arm]] @ grip_slip[arm]
            goals[arm].append(arm_target.goal)
            openings[arm].append(arm_target.opening_m)
    stacked = (
        {k: np.array(v) for k, v in of.items()} for of in (goals, openings, objects)
    )
    return Generated(*stacked, director)
